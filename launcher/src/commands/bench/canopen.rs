//! CANopen: SDO over the virtual bus, the SYNC's punctuality, process data, a full network.
//!
//! A process belongs to one rail for its whole life, so each part is a bench of its own, hidden from the command line,
//! in a process of its own. Times are the driver's stamps of frames on the bus: looking at them late does not count.
//! A virtual bus needs no time for a frame; where the bus is the limit, it is paced.

mod network;
mod sdo;
mod sync;

use super::stack::{BenchStack, PATIENCE};
use super::{Bench, What};
use anyhow::{Context as _, bail, ensure};
use dinrail_canopen::config::Simulation;
use dinrail_canopen::service::fleet::Player;
use dinrail_canopen::slave::fleet::Fleet;
use ipc_types::clock::mono_ns;
use ipc_types::payload::{CanFrame, Job, JobResult};
use ipc_types::port::{Publisher, Subscriber};
use ipc_types::{Context, topic::TopicKind};
use serde_json::{Value, json};
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

pub use network::{full, process_data};
pub use sdo::run as sdo;
pub use sync::{fifo, other};

/// The device of all nodes.
const EDS: &str = dinrail_canopen::slave::simulation::CIA_401_EDS;
const EDS_FILE: &str = "io401.eds";
const LOOK: Duration = Duration::from_millis(1);

/// All parts, one after the other.
pub fn run(bench: &mut Bench) -> anyhow::Result<()> {
    bench.parts(&What::CANOPEN_PARTS)
}

/// A canopen-master of the stack, asked from here.
struct Master {
    writer: u32,
    jobs: Publisher<Job>,
    results: Subscriber<JobResult>,
}

impl Master {
    fn open(ctx: &mut Context, service: &str) -> anyhow::Result<Self> {
        // First the ear, then the mouth: the answer may come at once.
        let results = ctx.subscriber(&TopicKind::Results.of(service))?;
        let jobs = ctx.publisher(&TopicKind::Jobs.of(service))?;
        Ok(Self { writer: ctx.writer, jobs, results })
    }

    fn send(&mut self, job: &Value) -> anyhow::Result<()> {
        let header = Job { deadline_t_ns: mono_ns() + 4 * PATIENCE.as_nanos() as u64, ..Job::default() };
        self.jobs.send_tail(header, &serde_json::to_vec(job)?)?;
        Ok(())
    }

    /// Sends jobs at once and waits for all answers; `meanwhile` is called while it waits.
    fn ask(&mut self, jobs: &[Value], mut meanwhile: impl FnMut()) -> anyhow::Result<Vec<Value>> {
        for job in jobs {
            self.send(job)?;
        }
        self.jobs.ring();
        let (mut answers, writer) = (Vec::with_capacity(jobs.len()), self.writer);
        let began = Instant::now();
        while answers.len() < jobs.len() {
            self.results.drain(64, |result, tail| {
                if result.job_writer == writer {
                    answers.push((result.code, serde_json::from_slice::<Value>(tail).unwrap_or(Value::Null)));
                }
            });
            meanwhile();
            ensure!(began.elapsed() < 4 * PATIENCE, "the master does not answer {}", jobs[0]);
            std::thread::sleep(LOOK);
        }
        let values = answers.into_iter().map(|(code, mut body)| match code {
            0 => Ok(body["ok"].take()),
            _ => bail!("the master refused {}: {body}", jobs[0]),
        });
        values.collect()
    }

    fn status(&mut self) -> anyhow::Result<Value> {
        let mut answers = self.ask(&[json!({ "do": "status" })], || ())?;
        answers.pop().context("no state of the network")
    }

    /// Waits until so many nodes exchange process data.
    fn wait_operational(&mut self, stack: &mut BenchStack, nodes: usize) -> anyhow::Result<()> {
        let began = Instant::now();
        loop {
            let status = self.status()?;
            let list = status["nodes"].as_array().map_or(&[][..], Vec::as_slice);
            let up = list.iter().filter(|n| n["operational"] == true).count();
            if up == nodes {
                return Ok(());
            }
            stack.check()?;
            ensure!(began.elapsed() < PATIENCE, "only {up} of {nodes} nodes are operational: {status}");
            std::thread::sleep(Duration::from_millis(20));
        }
    }
}

/// Simulated devices on a bus while `work` runs, played by a thread with a place of its own on the rail.
fn with_fleet<T>(
    root: &Path,
    bus: &str,
    ids: std::ops::RangeInclusive<u8>,
    work: impl FnOnce() -> anyhow::Result<T>,
) -> anyhow::Result<T> {
    let stop = &AtomicBool::new(false);
    std::thread::scope(|scope| {
        let player = scope.spawn(move || -> anyhow::Result<u64> {
            let mut fleet = Fleet::new(Simulation::Cia401, ids)?;
            let mut ctx = Context::observer(root)?;
            let mut player = Player::open(&mut ctx, bus)?;
            let mut on = false;
            player.play(&mut fleet, |fleet, now_ns, out| {
                if !std::mem::replace(&mut on, true) {
                    let ids: Vec<u8> = fleet.ids().collect();
                    for id in ids {
                        fleet.power_on(now_ns, id, out);
                    }
                }
                !stop.load(Ordering::Relaxed)
            })?;
            Ok(player.dropped)
        });
        let done = work();
        stop.store(true, Ordering::Relaxed);
        let dropped = player.join().map_err(|_| anyhow::anyhow!("the simulated nodes panicked"))??;
        ensure!(
            dropped == 0 || done.is_err(),
            "the simulated nodes lost {dropped} frames: the bus did not take them"
        );
        done
    })
}

/// Looks at a bus for so long.
fn observe(
    stack: &mut BenchStack,
    rx: &mut Subscriber<CanFrame>,
    span: Duration,
    mut each: impl FnMut(u64, &CanFrame),
) -> anyhow::Result<()> {
    let began = Instant::now();
    while began.elapsed() < span {
        rx.drain(8192, |frame, _| {
            if frame.fault().is_none() {
                each(frame.stamp.t_ns, frame);
            }
        });
        stack.check()?;
        std::thread::sleep(Duration::from_millis(5));
    }
    Ok(())
}
