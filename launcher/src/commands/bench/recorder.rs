//! Four buses at 8,000 frames/s each, with a PLC that takes its inputs from all of them, everything recorded.
//!
//! One thread sends on the four buses by an absolute schedule, one frame each every 125 us. What was sent, what
//! was on the buses and what stands in the finished recording must be the same numbers.

use super::idle::recordings_in;
use super::machine::{CpuMeter, cpu_seconds};
use super::stack::{BenchStack, PATIENCE};
use super::{Bench, Goal};
use anyhow::{Context as _, ensure};
use ipc_types::Context;
use ipc_types::clock::mono_ns;
use ipc_types::payload::{CanFrame, Status};
use ipc_types::port::{Publisher, SendError, Subscriber};
use ipc_types::reactor::Reactor;
use std::fmt::Write;
use std::path::PathBuf;
use std::time::Duration;

const SECONDS: u64 = 10;
const BUSES: usize = 4;
const RATE: u64 = 8000;
const PERIOD: Duration = Duration::from_micros(125);
const CAN_ID: u32 = 0x100;

const PROGRAM: &str = "
PROGRAM Main
  VAR
    Sum AT %MD0 : UDINT;
  END_VAR
  Sum := Counter0 + Counter1 + Counter2 + Counter3;
END_PROGRAM
";

fn stack_toml() -> String {
    let mut text =
        String::from("[stack]\nname = \"NAME\"\n\n[[service]]\nname = \"rec\"\nkind = \"recorder\"\n");
    for i in 0..BUSES {
        let _ = write!(
            text,
            "\n[[service]]\nname = \"can{i}\"\nkind = \"can\"\nbackend = \"virtual\"\nbitrate = \"1M\"\n\
             \n[[service]]\nname = \"io{i}\"\nkind = \"can-io\"\nbus = \"can{i}\"\necho = true\n\
             in = [{{ id = {CAN_ID}, start = 0, len = 32, to = \"%ID{i}\", type = \"UDINT\", symbol = \"Counter{i}\" }}]\n"
        );
    }
    text + "\n[[service]]\nname = \"plc\"\nkind = \"plc\"\nprogram = [\"main.st\"]\ncycle = \"10ms\"\n"
}

pub fn run(bench: &mut Bench) -> anyhow::Result<()> {
    let seconds = bench.seconds(SECONDS);
    let mut stack = BenchStack::up(&bench.dir, "recorder", &stack_toml(), &[("main.st", PROGRAM)])?;
    let (traffic, cpu) = {
        let mut ctx = stack.join()?;
        let mut buses = (0..BUSES).map(|i| Bus::open(&mut ctx, i)).collect::<anyhow::Result<Vec<_>>>()?;
        let own = cpu_seconds(std::process::id()).unwrap_or_default();
        let cpu = CpuMeter::start(stack.processes()?);
        let traffic = send(&mut stack, &mut buses, RATE * seconds)?;
        let mut cpu = cpu.stop();
        let own = cpu_seconds(std::process::id()).unwrap_or_default() - own;
        cpu.push(("the sender, no part of the stack".to_owned(), own / traffic.seconds * 100.0));
        wait_for_buses(&mut stack, &mut buses)?;
        (traffic, cpu)
    };
    let (scratch, status) = stack.down()?;
    let recorded = Recorded::read(&recordings_in(&scratch.path().join("recordings")))?;
    let sent = traffic.sent * BUSES as u64;
    let rate = traffic.sent as f64 / traffic.seconds;
    // The clock of the last frame is not the bus's: a thousandth is not a missed goal.
    bench.goal("each of four buses", rate, "frames/s", Goal::AtLeast(RATE as f64 * 0.999));
    bench.info("frames sent", sent as f64, "");
    bench.goal("frames not in the recording", sent.abs_diff(recorded.frames) as f64, "", Goal::AtMost(0.0));
    bench.goal("messages missed, all topics", recorded.missed as f64, "", Goal::AtMost(0.0));
    bench.info("recording", recorded.bytes as f64 / 1e6 / traffic.seconds, "MB/s");
    bench.info("of which raw messages would be", recorded.raw_bytes as f64 / 1e6 / traffic.seconds, "MB/s");
    bench.info("refusals of a full transmit queue", traffic.refused as f64, "");
    bench.info("sender behind its schedule, most", traffic.late_ns as f64 / 1e6, "ms");
    for (name, percent) in cpu {
        bench.info(format!("CPU of {name}"), percent, "%");
    }
    if !status.success() {
        bench.note(format!("the launcher ended with {status}"));
    }
    Ok(())
}

/// One bus as the sender has it.
struct Bus {
    name: String,
    tx: Publisher<CanFrame>,
    status: Subscriber<Status>,
    sent: u64,
    /// Of these, on the bus by the driver's word.
    arrived: u64,
}

impl Bus {
    fn open(ctx: &mut Context, i: usize) -> anyhow::Result<Self> {
        let name = format!("can{i}");
        Ok(Self {
            tx: ctx.publisher(&format!("{name}/tx"))?,
            status: ctx.subscriber(&format!("{name}/status"))?,
            name,
            sent: 0,
            arrived: 0,
        })
    }

    /// Sends up to a number of frames; counts refusals.
    fn send_to(&mut self, due: u64) -> anyhow::Result<u64> {
        let before = self.sent;
        while self.sent < due {
            match self.tx.send(CanFrame::classic(CAN_ID, &self.sent.to_le_bytes())) {
                Ok(_) => self.sent += 1,
                // Also "no reader": so it looks until the driver has read for the first time.
                Err(SendError::Full(_) | SendError::NoReader(_)) => {
                    self.tx.ring();
                    return Ok(1);
                }
                Err(other) => return Err(other.into()),
            }
        }
        if self.sent > before {
            self.tx.ring();
        }
        Ok(0)
    }
}

struct Traffic {
    /// Frames of each bus.
    sent: u64,
    seconds: f64,
    refused: u64,
    late_ns: u64,
}

/// Sends so many frames on each bus.
fn send(stack: &mut BenchStack, buses: &mut [Bus], total: u64) -> anyhow::Result<Traffic> {
    let mut reactor = Reactor::new()?;
    reactor.add_timer(PERIOD)?;
    let began_ns = mono_ns();
    let (mut refused, mut late_ns, mut turns) = (0, 0, 0u64);
    let mut last_ns = began_ns;
    while buses.iter().any(|bus| bus.sent < total) {
        reactor.wait(Some(PATIENCE))?;
        let now_ns = mono_ns();
        let due = ((u128::from(now_ns - began_ns) * u128::from(RATE)) / 1_000_000_000) as u64;
        for bus in buses.iter_mut() {
            refused += bus.send_to(due.min(total))?;
        }
        late_ns = late_ns.max((now_ns - last_ns).saturating_sub(PERIOD.as_nanos() as u64));
        last_ns = now_ns;
        turns += 1;
        if turns.is_multiple_of(RATE) {
            stack.check()?;
        }
        ensure!(
            now_ns - began_ns < 10 * total / RATE * 1_000_000_000 + PATIENCE.as_nanos() as u64,
            "the buses take less than a tenth of {RATE} frames/s"
        );
    }
    Ok(Traffic { sent: total, seconds: (mono_ns() - began_ns) as f64 / 1e9, refused, late_ns })
}

/// Waits until each driver says that all frames were on its bus.
fn wait_for_buses(stack: &mut BenchStack, buses: &mut [Bus]) -> anyhow::Result<()> {
    for bus in buses {
        let (name, sent) = (bus.name.clone(), bus.sent);
        stack.wait(&format!("{sent} frames on {name}"), |_| {
            bus.status.newest(|_, tail| {
                let status: serde_json::Value = serde_json::from_slice(tail).unwrap_or_default();
                bus.arrived = status["bus"]["from_rail"].as_u64().unwrap_or(bus.arrived);
            });
            (bus.arrived == sent).then_some(())
        })?;
    }
    Ok(())
}

#[derive(Default)]
struct Recorded {
    frames: u64,
    missed: u64,
    bytes: u64,
    raw_bytes: u64,
}

impl Recorded {
    fn read(files: &[PathBuf]) -> anyhow::Result<Self> {
        let mut sum = Self::default();
        for file in files {
            let info = dinrail_recorder::info(file)?;
            ensure!(info.finished, "{} was not finished", file.display());
            sum.bytes += info.bytes;
            sum.raw_bytes += info.channels.iter().map(|c| c.bytes).sum::<u64>();
            sum.frames +=
                info.channels.iter().filter(|c| c.topic.ends_with("/rx")).map(|c| c.messages).sum::<u64>();
            let gaps: u64 = info.channels.iter().filter_map(|c| c.gaps).sum();
            let last = info.gaps.filter(|g| g.last).context("the recorder's last word is missing")?;
            sum.missed += last.missed.max(gaps);
        }
        ensure!(!files.is_empty(), "there is no recording");
        Ok(sum)
    }
}
