//! Serial lines: how much of a line's budget the master uses. What the gateway adds is in [`super::modbus_gateway`].
//!
//! The line is a pseudo-terminal that the serial driver holds to the times of 115200 baud, with a
//! [`super::modbus_unit`] at its other end.

use super::modbus_unit::{PRIORITY, Unit};
use super::stack::BenchStack;
use super::{Bench, Goal, What};
use crate::supervise::sys::may_fifo;
use anyhow::ensure;
use std::time::{Duration, Instant};

pub const REGISTERS: u16 = 10;
/// Silence before a frame above 19200 baud (serial line guide V1.02, 2.5.1.1).
pub const T35_US: f64 = 1750.0;
/// Exchanges that do not count, at the beginning.
pub const WARM: usize = 20;
/// Bits of a character: start, 8, parity, stop.
const BITS: f64 = 11.0;
const BAUD: f64 = 115_200.0;

/// Time of a request for registers and of its answer on the line, without silences.
pub fn frames_us(registers: u16) -> f64 {
    let characters = 8.0 + 5.0 + 2.0 * f64::from(registers);
    characters * BITS / BAUD * 1e6
}

/// Time that a line needs for a request and its answer, with a unit that answers at once: the frames and the silence
/// before each.
fn cycle_us(registers: u16) -> f64 {
    frames_us(registers) + 2.0 * T35_US
}

const MASTER: &str = r#"
[stack]
name = "NAME"

[[service]]
name = "com1"
kind = "serial"
device = "pty:line"
baud = 115200
pace = true

[[service]]
name = "plc"
kind = "plc"
cycle = "10ms"

[[service]]
name = "master"
kind = "modbus-client"
serial = "com1"

[[service.read]]
unit = 1
table = "holding_registers"
at = 0
count = 10
to = "%IW0"
period = "0s"
"#;

/// Starts a stack with a line and a unit on it.
pub fn up(bench: &Bench, what: &str, toml: &str) -> anyhow::Result<(BenchStack, Unit)> {
    let mut stack = BenchStack::up(&bench.dir, what, toml, &[])?;
    let line = stack.dir().join("line");
    stack.wait("the pseudo-terminal", |_| line.exists().then_some(()))?;
    let unit = Unit::start(&line)?;
    Ok((stack, unit))
}

pub fn run(bench: &mut Bench, span: Duration) -> anyhow::Result<()> {
    bench.parts(&What::MODBUS_PARTS)?;
    if !may_fifo(PRIORITY) {
        bench.note("this user may not use SCHED_FIFO: unit, client and services ran without it");
    }
    master(bench, span / 2)
}

fn master(bench: &mut Bench, span: Duration) -> anyhow::Result<()> {
    let (mut stack, unit) = up(bench, "mbmaster", MASTER)?;
    stack.wait("polls", |_| (unit.answered() > WARM as u64).then_some(()))?;
    let (first, began) = (unit.answered(), Instant::now());
    while began.elapsed() < span {
        stack.check()?;
        std::thread::sleep(Duration::from_millis(50));
    }
    let rate = (unit.answered() - first) as f64 / began.elapsed().as_secs_f64();
    ensure!(rate > 0.0, "the master stopped polling");
    let budget = 1e6 / cycle_us(REGISTERS);
    bench.info("RTU line at 115200, FC3 x 10", rate, "requests/s");
    bench.goal("of the line's budget", rate / budget * 100.0, "%", Goal::AtLeast(90.0));
    drop(unit);
    stack.down()?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_budget_is_that_of_the_standard() {
        for (registers, requests) in [(1, 203.0), (10, 150.0), (50, 70.0), (125, 35.0)] {
            let budget: f64 = 1e6 / cycle_us(registers);
            assert!((budget - requests).abs() < 1.0, "{registers}: {budget}");
        }
    }
}
