//! What a driver costs when its bus is full: 1 Mbit/s, every bit time used, on a paced virtual bus.
//!
//! A paced bus wakes for each frame as an interface of the kernel does, stamps it, publishes it and rings a reader's
//! bell; only the system call that would take the frame from the kernel is missing, and a timer stands in its place.

use super::machine::CpuMeter;
use super::stack::BenchStack;
use super::{Bench, Goal};
use anyhow::{anyhow, ensure};
use ipc_types::Context;
use ipc_types::payload::CanFrame;
use ipc_types::port::SendError;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Name of the bus in the stack.
pub const BUS: &str = "full";
const SECONDS: u64 = 5;
/// The driver has 512 frames and the topic 1024: 60 ms and more.
const REFILL: Duration = Duration::from_millis(20);
/// Before the meter starts: queues are full by then.
const WARM: Duration = Duration::from_millis(500);

pub fn run(bench: &mut Bench, stack: &mut BenchStack, ctx: &mut Context) -> anyhow::Result<()> {
    let span = Duration::from_secs(bench.seconds(SECONDS));
    let mut rx = ctx.subscriber::<CanFrame>(&format!("{BUS}/rx"))?;
    let stop = &AtomicBool::new(false);
    let root = ctx.stack.root.clone();
    let (frames, seconds, cpu) = std::thread::scope(|scope| -> anyhow::Result<_> {
        let sender = scope.spawn(move || fill(&root, stop));
        let watched = (|| {
            std::thread::sleep(WARM);
            while rx.drain(8192, |_, _| ()) > 0 {}
            let meter = CpuMeter::start(stack.processes()?);
            let began = Instant::now();
            let mut frames = 0;
            while began.elapsed() < span {
                std::thread::sleep(Duration::from_millis(10));
                frames += rx.drain(8192, |_, _| ());
                stack.check()?;
            }
            Ok((frames, began.elapsed().as_secs_f64(), meter.stop()))
        })();
        stop.store(true, Ordering::Relaxed);
        sender.join().map_err(|_| anyhow!("the sender panicked"))??;
        watched
    })?;
    ensure!(frames > 0, "no frame was on the full bus");
    bench.info("1 Mbit/s full: rate", frames as f64 / seconds, "frames/s");
    let percent = cpu.iter().find(|(name, _)| name == BUS).map_or(f64::NAN, |(_, percent)| *percent);
    bench.goal("1 Mbit/s full: CPU of the driver", percent, "%", Goal::Below(10.0));
    Ok(())
}

/// Keeps the driver's queue full.
fn fill(root: &Path, stop: &AtomicBool) -> anyhow::Result<()> {
    let mut ctx = Context::observer(root)?;
    let mut tx = ctx.publisher::<CanFrame>(&format!("{BUS}/tx"))?;
    let mut counter = 0u64;
    while !stop.load(Ordering::Relaxed) {
        loop {
            // Bytes as they are on real buses: some change, some never do.
            let data = (counter.wrapping_mul(0x9E37_79B9) & 0x00FF_00FF_FFFF_FFFF).to_le_bytes();
            match tx.send(CanFrame::classic(0x100 + (counter % 64) as u32, &data)) {
                Ok(_) => counter += 1,
                Err(SendError::Full(_) | SendError::NoReader(_)) => break,
                Err(other) => return Err(other.into()),
            }
        }
        tx.ring();
        std::thread::sleep(REFILL);
    }
    Ok(())
}
