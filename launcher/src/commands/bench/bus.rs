//! How many frames a second a virtual bus carries to one subscriber without loss; then a full bus and the foreign programs.
//!
//! A thread sends as fast as the driver takes frames, this one receives; both have a place of their own on the
//! rail. Every frame carries a counter, and the bus numbers what it publishes.

use super::machine::CpuMeter;
use super::stack::{BenchStack, free_port};
use super::{Bench, Goal, bus_full, bus_peers};
use anyhow::{anyhow, ensure};
use ipc_types::Context;
use ipc_types::payload::CanFrame;
use ipc_types::port::{SendError, Subscriber};
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::time::{Duration, Instant};

const SECONDS: u64 = 10;
const CAN_ID: u32 = 0x123;
/// Frames from one ring of the driver's bell to the next.
const RING_EVERY: u64 = 64;
/// A full queue of 1024 frames lasts for several milliseconds.
const FULL_PAUSE: Duration = Duration::from_micros(500);
/// An observer has no inbox: it looks this often. The queue lasts for 50 ms.
const LOOK: Duration = Duration::from_millis(1);
/// Frames that do not come within this time are lost.
const QUIET: Duration = Duration::from_secs(2);

const STACK: &str = r#"
[stack]
name = "NAME"

[[service]]
name = "can0"
kind = "can"
backend = "virtual"
serve = { cannelloni = "127.0.0.1:CANNELLONI", socketcand = "127.0.0.1:SOCKETCAND", slcan = "127.0.0.1:SLCAN" }

[[service]]
name = "full"
kind = "can"
backend = "virtual"
bitrate = "1M"
pace = true

[[service]]
name = "io"
kind = "can-io"
bus = "full"

[[service.in]]
id = 0x100
start = 0
len = 16
to = "%IW0"
type = "UINT"

[[service]]
name = "plc"
kind = "plc"
cycle = "10ms"
"#;

#[derive(Default)]
struct Received {
    frames: u64,
    /// Counters below the one after the last; above it are gaps, which the bus's numbers show as well.
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
            self.disorder += u64::from(counter < self.next);
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
    let ports = bus_peers::Ports { cannelloni: free_port()?, socketcand: free_port()?, slcan: free_port()? };
    let toml = STACK
        .replace("CANNELLONI", &ports.cannelloni.to_string())
        .replace("SOCKETCAND", &ports.socketcand.to_string())
        .replace("SLCAN", &ports.slcan.to_string());
    let mut stack = BenchStack::up(&bench.dir, "bus", &toml, &[])?;
    {
        let mut ctx = stack.join()?;
        let mut rx = ctx.subscriber::<CanFrame>("can0/rx")?;
        let cpu = CpuMeter::start(stack.processes()?);
        let (sent, received) = traffic(&mut stack, &ctx.stack.root, &mut rx, Duration::from_secs(seconds))?;
        let cpu = cpu.stop();
        let span_s = received.last_ns.saturating_sub(received.first_ns) as f64 / 1e9;
        ensure!(received.frames > 1 && span_s > 0.0, "only {} frames were received", received.frames);
        bench.info("frames sent", sent as f64, "");
        bench.goal("rate", (received.frames - 1) as f64 / span_s, "frames/s", Goal::AtLeast(100_000.0));
        let missing = sent.saturating_sub(received.frames);
        bench.goal("frames not received", missing as f64, "", Goal::AtMost(0.0));
        bench.goal("gaps in the bus's numbers", rx.counters().lost as f64, "", Goal::AtMost(0.0));
        bench.goal("frames out of order", received.disorder as f64, "", Goal::AtMost(0.0));
        for (name, percent) in cpu.into_iter().filter(|(name, _)| name == "can0") {
            bench.info(format!("CPU of {name}"), percent, "%");
        }
        drop(rx);
        bus_full::run(bench, &mut stack, &mut ctx)?;
        let dir = stack.dir().to_owned();
        bus_peers::run(bench, &ports, &dir)?;
    }
    stack.down()?;
    Ok(())
}

/// Sends and receives for so long: frames sent, what was received.
fn traffic(
    stack: &mut BenchStack,
    root: &Path,
    rx: &mut Subscriber<CanFrame>,
    span: Duration,
) -> anyhow::Result<(u64, Received)> {
    let stop = &AtomicBool::new(false);
    let (tell, told) = channel();
    let (leave, left) = channel::<()>();
    let mut received = Received::default();
    // Takes `leave` along: however it ends, the sender is told to leave.
    std::thread::scope(move |scope| {
        let sender = scope.spawn(move || send(root, stop, &tell, &left));
        let began = Instant::now();
        let mut alive = Ok(());
        while began.elapsed() < span && alive.is_ok() && !sender.is_finished() {
            received.drain(rx);
            std::thread::sleep(LOOK);
            alive = stack.check();
        }
        stop.store(true, Ordering::Relaxed);
        alive?;
        let mut sent = None;
        let mut quiet_since = Instant::now();
        while sent.is_none_or(|sent| received.frames < sent)
            && !sender.is_finished()
            && quiet_since.elapsed() < QUIET
        {
            sent = sent.or_else(|| told.try_recv().ok());
            if received.drain(rx) {
                quiet_since = Instant::now();
            }
            std::thread::sleep(LOOK);
        }
        drop(leave);
        sender.join().map_err(|_| anyhow!("the sender panicked"))??;
        Ok((sent.ok_or_else(|| anyhow!("the sender did not stop"))?, received))
    })
}

/// Sends until told to stop, tells how many frames were taken, and stays until told to leave: what a writer that
/// is gone has left unread may be lost with it.
fn send(root: &Path, stop: &AtomicBool, tell: &Sender<u64>, left: &Receiver<()>) -> anyhow::Result<()> {
    let mut ctx = Context::observer(root)?;
    let mut tx = ctx.publisher::<CanFrame>("can0/tx")?;
    let mut sent = 0u64;
    while !stop.load(Ordering::Relaxed) {
        match tx.send(CanFrame::classic(CAN_ID, &sent.to_le_bytes())) {
            Ok(_) => {
                sent += 1;
                if sent.is_multiple_of(RING_EVERY) {
                    tx.ring();
                }
            }
            // Also "no reader": so it looks until the driver has read for the first time.
            Err(SendError::Full(_) | SendError::NoReader(_)) => {
                tx.ring();
                std::thread::sleep(FULL_PAUSE);
            }
            Err(other) => return Err(other.into()),
        }
    }
    tx.ring();
    let _ = tell.send(sent);
    let _ = left.recv();
    Ok(())
}
