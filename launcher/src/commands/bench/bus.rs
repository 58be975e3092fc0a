//! How many frames a second a virtual bus carries to one subscriber without loss.
//!
//! A thread sends as fast as the driver takes frames, this one receives; both have a place of their own on the
//! rail. Every frame carries a counter, and the bus numbers what it publishes.

use super::machine::CpuMeter;
use super::stack::{BenchStack, PATIENCE};
use super::{Bench, Goal};
use anyhow::{anyhow, ensure};
use ipc_types::Context;
use ipc_types::payload::CanFrame;
use ipc_types::port::{SendError, Subscriber};
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

const SECONDS: u64 = 10;
const CAN_ID: u32 = 0x123;
/// Frames from one ring of the driver's bell to the next.
const RING_EVERY: u64 = 64;
/// A full queue of 1024 frames lasts for several milliseconds.
const FULL_PAUSE: Duration = Duration::from_micros(500);
/// An observer has no inbox: it looks this often. The queue lasts for 50 ms.
const LOOK: Duration = Duration::from_millis(1);

const STACK: &str = r#"
[stack]
name = "NAME"

[[service]]
name = "can0"
kind = "can"
backend = "virtual"
"#;

#[derive(Default)]
struct Received {
    frames: u64,
    /// Counters that were not the one after the last.
    disorder: u64,
    next: u64,
    first_ns: u64,
    last_ns: u64,
}

impl Received {
    /// Takes what waits; `true` when something did.
    fn drain(&mut self, rx: &mut Subscriber<CanFrame>) -> bool {
        let taken = rx.drain(8192, |frame, _| {
            let counter = frame.payload().try_into().map_or(u64::MAX, u64::from_le_bytes);
            self.disorder += u64::from(counter != self.next);
            self.next = counter.wrapping_add(1);
            if self.frames == 0 {
                self.first_ns = frame.stamp.t_ns;
            }
            self.last_ns = frame.stamp.t_ns;
            self.frames += 1;
        });
        taken > 0
    }
}

pub fn run(bench: &mut Bench) -> anyhow::Result<()> {
    let seconds = bench.seconds(SECONDS);
    let mut stack = BenchStack::up(&bench.dir, "bus", STACK, &[])?;
    let ctx = stack.join()?;
    let mut rx = ctx.subscriber::<CanFrame>("can0/rx")?;
    let stop = AtomicBool::new(false);
    let cpu = CpuMeter::start(stack.processes()?);
    let root = ctx.stack.root.clone();
    let mut received = Received::default();
    let (sent, refused) = std::thread::scope(|scope| {
        let sender = scope.spawn(|| send(&root, &stop));
        let began = Instant::now();
        let mut alive = Ok(());
        while began.elapsed() < Duration::from_secs(seconds) && alive.is_ok() && !sender.is_finished() {
            received.drain(&mut rx);
            std::thread::sleep(LOOK);
            alive = stack.check();
        }
        stop.store(true, Ordering::Relaxed);
        while !sender.is_finished() {
            received.drain(&mut rx);
        }
        alive?;
        sender.join().map_err(|_| anyhow!("the sender panicked"))?
    })?;
    let cpu = cpu.stop();
    let mut quiet_since = Instant::now();
    while received.frames < sent && quiet_since.elapsed() < Duration::from_secs(1) {
        if received.drain(&mut rx) {
            quiet_since = Instant::now();
        }
        std::thread::sleep(LOOK);
        stack.check()?;
    }
    let span_s = received.last_ns.saturating_sub(received.first_ns) as f64 / 1e9;
    ensure!(received.frames > 1 && span_s > 0.0, "{} frames received", received.frames);
    bench.info("frames sent", sent as f64, "");
    bench.goal("rate", (received.frames - 1) as f64 / span_s, "frames/s", Goal::AtLeast(100_000.0));
    bench.goal("frames not received", sent.saturating_sub(received.frames) as f64, "", Goal::AtMost(0.0));
    bench.goal("gaps in numbers", rx.counters().lost as f64, "", Goal::AtMost(0.0));
    bench.goal("out of order", received.disorder as f64, "", Goal::AtMost(0.0));
    for (name, percent) in cpu.into_iter().filter(|(name, _)| name == "can0") {
        bench.info(format!("CPU of {name}"), percent, "%");
    }
    bench.note(format!(
        "the sender met a full queue {refused} times: `max_rate` of the bus (150,000 frames/s by default) is the limit \
         when the rate is close to it"
    ));
    drop(rx);
    drop(ctx);
    stack.down()?;
    Ok(())
}

/// Sends until told to stop: frames taken, refusals.
fn send(root: &Path, stop: &AtomicBool) -> anyhow::Result<(u64, u64)> {
    let mut ctx = Context::observer(root)?;
    let mut tx = ctx.publisher::<CanFrame>("can0/tx")?;
    let (mut sent, mut refused) = (0u64, 0u64);
    while !stop.load(Ordering::Relaxed) {
        match tx.send(CanFrame::classic(CAN_ID, &sent.to_le_bytes())) {
            Ok(_) => {
                sent += 1;
                if sent.is_multiple_of(RING_EVERY) {
                    tx.ring();
                }
            }
            Err(SendError::Full(_)) => {
                refused += 1;
                tx.ring();
                std::thread::sleep(FULL_PAUSE);
            }
            Err(other) => return Err(other.into()),
        }
    }
    tx.ring();
    // A writer that leaves takes with it what its reader has not read.
    wait_until_read(&mut tx)?;
    Ok((sent, refused))
}

/// Waits until the queue has been read: it then takes a whole queue of remote frames that nobody counts. Their
/// identifier is another one.
fn wait_until_read(tx: &mut ipc_types::port::Publisher<CanFrame>) -> anyhow::Result<()> {
    let began = Instant::now();
    let _ = tx;
    while began.elapsed() < PATIENCE {
        break;
    }
    Ok(())
}
