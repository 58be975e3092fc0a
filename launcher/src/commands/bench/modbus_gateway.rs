//! What the transparent gateway adds to the line's own time, and cached reads.
//!
//! The line's own time of an exchange is what a logic analyser would show: the request's characters, the time that the
//! unit took to answer, the answer's characters; where the line was used just before, what was left of the 3.5
//! characters of silence when the request came. Everything else between the request in the gateway's socket and the
//! answer in the client's hands counts as added: two sockets, two ways over the rail, the driver's wake-ups and timers,
//! its finding the end of the answer, the client's own wake-up, and what pseudo-terminal and driver need to take the
//! answer in. The stamps are those of the driver, on `<serial>/rx`, and of the [unit](super::modbus_unit).
//!
//! A process belongs to one rail for its whole life: each part runs in a process of its own.

use super::modbus::Client;
use super::modbus_lines::{REGISTERS, T35_US, WARM, frames_us, up};
use super::modbus_unit::{Log, PRIORITY};
use super::stack::{BenchStack, free_port};
use super::stats::Samples;
use super::{Bench, Goal};
use crate::supervise::sys::set_fifo;
use anyhow::{Context as _, ensure};
use ipc_types::clock::mono_ns;
use ipc_types::payload::{SerialChunk, serial_flag};
use ipc_types::port::Subscriber;
use ipc_types::topic::TopicKind;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

const SECONDS: u64 = 10;
/// Pauses before a request, in turns: without one the line is still to be silent, after others it has been for long.
const PAUSES_MS: [u64; 8] = [0, 3, 0, 5, 0, 7, 0, 11];

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
"#;

/// By itself: a poll of the cache takes the line when it is due, and who asks then waits for a whole exchange.
const CACHE: &str =
    r#"cache = [ { unit = 1, table = "holding_registers", at = 100, count = 20, period = "1s" } ]"#;

pub fn other(bench: &mut Bench) -> anyhow::Result<()> {
    gateway(bench, None)
}

pub fn fifo(bench: &mut Bench) -> anyhow::Result<()> {
    gateway(bench, Some(PRIORITY))
}

/// `priority`: of the gateway and of the line's driver.
fn gateway(bench: &mut Bench, priority: Option<u32>) -> anyhow::Result<()> {
    let span = Duration::from_secs(bench.seconds(SECONDS));
    let port = free_port()?;
    let more = priority.map_or_else(String::new, |p| format!("priority = {p}"));
    let toml = GATEWAY.replace("PORT", &port.to_string()).replace("MORE", &more);
    let with = if priority.is_some() { ", SCHED_FIFO" } else { "" };

    let (mut stack, unit) = up(bench, "mbgateway", &toml)?;
    stack.wait("an answer through the gateway", |_| Client::connect(port).ok()?.holding(0, 1).ok())?;
    let measured = std::thread::scope(|scope| {
        // The master is a device of its own, too.
        let measuring = || {
            let _ = set_fifo(PRIORITY);
            transparent(&stack, &unit.log, port, span)
        };
        scope.spawn(measuring).join().map_err(|_| anyhow::anyhow!("the measuring thread panicked"))?
    })?;
    stack.check()?;
    measured.tell(bench, with);
    drop(unit);
    stack.down()?;

    let (mut stack, unit) = up(bench, "mbcache", &format!("{toml}{CACHE}"))?;
    let cached = cached(&mut stack, port, span / 4)?.sorted();
    bench.info(format!("cached read{with}, p50"), cached.p50(), "us");
    bench.goal(format!("cached read{with}, p99"), cached.p99(), "us", Goal::Below(100.0));
    drop(unit);
    stack.down()?;
    Ok(())
}

/// All in us.
#[derive(Default)]
struct Measured {
    added: Samples,
    /// Of it: from when the request could have begun on the line to its first bit.
    before: Samples,
    /// Of it: so much later than its characters take did the request's last one leave.
    sending: Samples,
    /// Of it: from the unit's write to when the driver has read the answer's first byte: kernel worker and wake-up.
    taken_in: Samples,
    /// Of it: from the last bit of the answer to the client.
    behind: Samples,
    /// The unit's answer, later than 3.5 characters after the request. Not added by the gateway.
    unit_late: Samples,
    timer_late: Samples,
    /// As if the unit had answered in time.
    with_unit: Samples,
}

impl Measured {
    fn tell(self, bench: &mut Bench, with: &str) {
        let wire = frames_us(REGISTERS) + T35_US;
        bench.info(format!("gateway{with}, line's own time of FC3 x 10 at 115200"), wire, "us");
        let added = self.added.sorted();
        bench.info(format!("gateway{with} adds, p50"), added.p50(), "us");
        bench.goal(format!("gateway{with} adds, p99"), added.p99(), "us", Goal::Below(1000.0));
        for (what, samples) in [
            ("of it before the request", self.before),
            ("of it sending the request", self.sending),
            ("of it unit's terminal to driver", self.taken_in),
            ("of it behind the answer", self.behind),
        ] {
            let samples = samples.sorted();
            bench.info(format!("gateway{with}, {what}, p50"), samples.p50(), "us");
            bench.info(format!("gateway{with}, {what}, p99"), samples.p99(), "us");
        }
        let late = self.unit_late.sorted();
        bench.info(format!("simulated unit{with} late, not counted above, p50"), late.p50(), "us");
        bench.info(format!("simulated unit{with} late, not counted above, p99"), late.p99(), "us");
        bench.info(format!("its timer{with} late, p99"), self.timer_late.sorted().p99(), "us");
        bench.info(format!("gateway{with} and unit's lateness, p99"), self.with_unit.sorted().p99(), "us");
    }
}

/// What the driver said of an exchange, ns.
#[derive(Default)]
struct OnLine {
    /// First and last bit of the request.
    request: Option<(u64, u64)>,
    /// First bit of the answer.
    answer_ns: Option<u64>,
}

impl OnLine {
    fn read(rx: &mut Subscriber<SerialChunk>) -> Self {
        let mut seen = Self::default();
        rx.drain(usize::MAX, |chunk, _| {
            if chunk.flags & serial_flag::TX_ECHO != 0 {
                seen.request = Some((chunk.first_t_ns, chunk.stamp.t_ns));
            } else {
                seen.answer_ns = Some(chunk.first_t_ns);
            }
        });
        seen
    }
}

fn transparent(stack: &BenchStack, unit: &Log, port: u16, span: Duration) -> anyhow::Result<Measured> {
    let ctx = stack.join()?;
    let mut rx: Subscriber<SerialChunk> = ctx.subscriber(&TopicKind::SerialRx.of("com1"))?;
    let mut client = Client::connect(port)?;
    for _ in 0..WARM {
        client.holding(0, REGISTERS)?;
    }
    std::thread::sleep(Duration::from_millis(20));
    OnLine::read(&mut rx);
    let us = |from_ns: u64, to_ns: u64| (to_ns as f64 - from_ns as f64) / 1e3;
    let answer_ns = ((5.0 + 2.0 * f64::from(REGISTERS)) / (13.0 + 2.0 * f64::from(REGISTERS))
        * frames_us(REGISTERS)
        * 1e3) as u64;
    let silence_ns = (T35_US * 1e3) as u64;
    let (mut measured, mut free_ns) = (Measured::default(), 0);
    let began = Instant::now();
    for pause_ms in PAUSES_MS.iter().cycle() {
        if began.elapsed() >= span {
            break;
        }
        if *pause_ms > 0 {
            std::thread::sleep(Duration::from_millis(*pause_ms));
        }
        let sent_ns = mono_ns();
        client.holding(0, REGISTERS)?;
        let answered_ns = mono_ns();
        let seen = OnLine::read(&mut rx);
        let (first_ns, end_ns) = seen.request.context("the driver did not say that it sent a request")?;
        let answer_first_ns = seen.answer_ns.context("the driver did not say that it received an answer")?;
        let unit_ns = unit.answer_ns.load(Ordering::Acquire);
        ensure!(unit_ns >= end_ns && answer_first_ns >= unit_ns, "stamps of an exchange are out of order");
        // When the line was free, or the request there.
        let could_ns = sent_ns.max(free_ns);
        let unit_us = us(end_ns, unit_ns);
        let added = us(could_ns, answered_ns) - frames_us(REGISTERS) - unit_us;
        measured.added.push(added);
        measured.with_unit.push(added + unit_us - T35_US);
        measured.before.push(us(could_ns, first_ns));
        measured.sending.push(us(first_ns, end_ns) - (frames_us(REGISTERS) - answer_ns as f64 / 1e3));
        measured.taken_in.push(us(unit_ns, answer_first_ns));
        measured.behind.push(us(answer_first_ns + answer_ns, answered_ns));
        measured.unit_late.push(unit_us - T35_US);
        measured.timer_late.push(unit.timer_late_ns.load(Ordering::Acquire) as f64 / 1e3);
        free_ns = answer_first_ns + answer_ns + silence_ns;
    }
    Ok(measured)
}

fn cached(stack: &mut BenchStack, port: u16, span: Duration) -> anyhow::Result<Samples> {
    // Until the first poll they come from the unit.
    stack.wait("the cache", |_| {
        let sent = Instant::now();
        Client::connect(port).ok()?.holding(100, REGISTERS).ok()?;
        (sent.elapsed() < Duration::from_millis(2)).then_some(())
    })?;
    let mut client = Client::connect(port)?;
    let mut samples = Samples::default();
    let began = Instant::now();
    while began.elapsed() < span {
        let sent = Instant::now();
        client.holding(100, REGISTERS)?;
        samples.push(sent.elapsed().as_nanos() as f64 / 1e3);
        stack.check()?;
    }
    Ok(samples)
}
