//! Serial lines: what the transparent gateway adds to the wire's time, cached reads, and how much of a line's budget
//! the master uses. The line is a pseudo-terminal that the serial driver holds to the times of 115200 baud; the unit
//! at its other end is a thread of the bench that answers after 3.5 characters of silence, as RTU demands. Where the user
//! may, that thread has real-time priority: a unit is a device of its own, whose lateness is not the gateway's.

use super::modbus::Client;
use super::stack::{BenchStack, free_port};
use super::stats::Samples;
use super::{Bench, Goal};
use crate::supervise::sys::{may_fifo, set_fifo};
use anyhow::{Context as _, ensure};
use dinrail_modbus::protocol::rtu;
use dinrail_serial::Config as SerialConfig;
use dinrail_serial::port::{Port, Read};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

const REGISTERS: u16 = 10;
/// Bits of a character: start, 8, parity, stop.
const BITS: f64 = 11.0;
const BAUD: f64 = 115_200.0;
/// Silence before a frame above 19200 baud (serial line guide V1.02, 2.5.1.1).
const T35_US: f64 = 1750.0;
const WARM: usize = 20;
/// Real-time priority, of what has one here.
const PRIORITY: u32 = 4;

/// Time of a request for registers and its answer on the line, with a unit that answers at once.
fn wire_us(registers: u16) -> f64 {
    let characters = 8.0 + 5.0 + 2.0 * f64::from(registers);
    characters * BITS / BAUD * 1e6 + 2.0 * T35_US
}

const GATEWAY: &str = r#"
[stack]
name = "NAME"

[[service]]
name = "com1"
kind = "serial"
device = "pty:line"
baud = 115200
pace = true
MORE

[[service]]
name = "gateway"
kind = "modbus-gateway"
serial = "com1"
MORE
tcp = { address = "127.0.0.1", port = PORT }
cache = [ { unit = 1, table = "holding_registers", at = 100, count = 20, period = "1s" } ]
"#;

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

/// A unit that answers reads of holding registers at once; ends when dropped.
pub(super) struct Unit {
    stop: Arc<AtomicBool>,
    pub(super) answered: Arc<AtomicU64>,
    thread: Option<JoinHandle<()>>,
}

impl Unit {
    pub(super) fn start(line: &Path) -> anyhow::Result<Self> {
        let mut config = SerialConfig::of_device(&line.display().to_string());
        config.verify = false;
        config.exclusive = false;
        let options = config.options(Path::new("/")).context("the pseudo-terminal has no path")?;
        let port = Port::open(&options)?;
        let (stop, answered) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicU64::new(0)));
        let (ended, count) = (stop.clone(), answered.clone());
        let thread = std::thread::spawn(move || serve(port, &ended, &count));
        Ok(Self { stop, answered, thread: Some(thread) })
    }
}

impl Drop for Unit {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

fn serve(mut port: Port, stop: &AtomicBool, answered: &AtomicU64) {
    // The report says so where the user may not.
    let _ = set_fifo(PRIORITY);
    let mut bytes: Vec<u8> = Vec::with_capacity(512);
    let mut some = [0; 256];
    while !stop.load(Ordering::Relaxed) {
        let wait = Timespec { tv_sec: 0, tv_nsec: 100_000_000 };
        let mut fds = [PollFd::from_borrowed_fd(port.fd(), PollFlags::IN)];
        let _ = poll(&mut fds, Some(&wait));
        match port.read(&mut some) {
            Ok(Read::Bytes(n, _)) => bytes.extend_from_slice(&some[..n]),
            Ok(Read::Nothing | Read::Nobody) => {}
            Err(_) => return,
        }
        // Requests of the bench all have 8 bytes.
        while bytes.len() >= 8 {
            let Ok((unit, &[3, _, _, _, count])) = rtu::decode(&bytes[..8]) else {
                bytes.remove(0);
                continue;
            };
            // A unit knows the end of a request by the silence behind it.
            silence();
            let mut pdu = vec![3, count * 2];
            pdu.resize(2 + usize::from(count) * 2, 0x11);
            bytes.drain(..8);
            let mut frame = [0; rtu::MAX_ADU];
            let len = rtu::encode(unit, &pdu, &mut frame);
            let mut left = &frame[..len];
            while !left.is_empty() {
                match port.write(left) {
                    Ok(n) => left = &left[n..],
                    Err(_) => return,
                }
            }
            answered.fetch_add(1, Ordering::Relaxed);
        }
    }
}

/// Waits for 3.5 characters, to the microsecond: a sleep alone takes longer by the time of the scheduler.
fn silence() {
    let end = Instant::now() + Duration::from_micros(T35_US as u64);
    std::thread::sleep(Duration::from_micros(T35_US as u64 - 250));
    while Instant::now() < end {
        std::hint::spin_loop();
    }
}

/// Starts a stack with a line and a unit on it.
fn up(bench: &Bench, what: &str, toml: &str) -> anyhow::Result<(BenchStack, Unit)> {
    let mut stack = BenchStack::up(&bench.dir, what, toml, &[])?;
    let line = stack.dir().join("line");
    stack.wait("the pseudo-terminal", |_| line.exists().then_some(()))?;
    let unit = Unit::start(&line)?;
    Ok((stack, unit))
}

pub fn run(bench: &mut Bench, span: Duration) -> anyhow::Result<()> {
    gateway(bench, span / 2, None)?;
    gateway(bench, span / 2, Some(PRIORITY))?;
    if !may_fifo(PRIORITY) {
        bench.note("this user may not use SCHED_FIFO: the unit and the services ran without it");
    }
    master(bench, span / 2)
}

/// `priority`: of the gateway and of the line's driver.
fn gateway(bench: &mut Bench, span: Duration, priority: Option<u32>) -> anyhow::Result<()> {
    let port = free_port()?;
    let more = priority.map_or_else(String::new, |p| format!("priority = {p}"));
    let toml = GATEWAY.replace("PORT", &port.to_string()).replace("MORE", &more);
    let (mut stack, unit) = up(bench, "mbgateway", &toml)?;
    let mut client = Client::connect(port)?;
    stack.wait("an answer through the gateway", |_| Client::connect(port).ok()?.holding(0, 1).ok())?;
    for _ in 0..WARM {
        client.holding(0, REGISTERS)?;
    }
    let mut added = Samples::default();
    let wire = wire_us(REGISTERS);
    let began = Instant::now();
    while began.elapsed() < span {
        let sent = Instant::now();
        client.holding(0, REGISTERS)?;
        added.push(sent.elapsed().as_nanos() as f64 / 1e3 - wire);
        stack.check()?;
    }
    // Cached registers: until the first poll they come from the unit.
    stack.wait("the cache", |_| {
        let sent = Instant::now();
        Client::connect(port).ok()?.holding(100, REGISTERS).ok()?;
        (sent.elapsed() < Duration::from_millis(2)).then_some(())
    })?;
    let mut cached = Samples::default();
    let began = Instant::now();
    while began.elapsed() < span / 2 {
        let sent = Instant::now();
        client.holding(100, REGISTERS)?;
        cached.push(sent.elapsed().as_nanos() as f64 / 1e3);
        stack.check()?;
    }
    let (added, cached) = (added.sorted(), cached.sorted());
    let with = if priority.is_some() { ", SCHED_FIFO" } else { "" };
    bench.info(format!("gateway{with}, wire time of FC3 x 10 at 115200"), wire, "us");
    bench.info(format!("gateway{with} adds, p50"), added.p50(), "us");
    bench.goal(format!("gateway{with} adds, p99"), added.p99(), "us", Goal::Below(1000.0));
    bench.info(format!("cached read{with}, p50"), cached.p50(), "us");
    bench.goal(format!("cached read{with}, p99"), cached.p99(), "us", Goal::Below(100.0));
    drop(unit);
    stack.down()?;
    Ok(())
}

fn master(bench: &mut Bench, span: Duration) -> anyhow::Result<()> {
    let (mut stack, unit) = up(bench, "mbmaster", MASTER)?;
    stack.wait("polls", |_| (unit.answered.load(Ordering::Relaxed) > WARM as u64).then_some(()))?;
    let (first, began) = (unit.answered.load(Ordering::Relaxed), Instant::now());
    while began.elapsed() < span {
        stack.check()?;
        std::thread::sleep(Duration::from_millis(50));
    }
    let rate = (unit.answered.load(Ordering::Relaxed) - first) as f64 / began.elapsed().as_secs_f64();
    ensure!(rate > 0.0, "the master stopped polling");
    let budget = 1e6 / wire_us(REGISTERS);
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
            let budget: f64 = 1e6 / wire_us(registers);
            assert!((budget - requests).abs() < 1.0, "{registers}: {budget}");
        }
    }
}
