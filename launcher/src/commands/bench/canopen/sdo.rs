//! SDO: expedited round trips; blocks on a bus without pace and on one of 1 Mbit/s.

use super::super::stack::BenchStack;
use super::super::stats::Samples;
use super::super::{Bench, Goal};
use super::{EDS, EDS_FILE, Master};
use anyhow::ensure;
use ipc_types::payload::CanFrame;
use ipc_types::port::Subscriber;
use serde_json::json;

/// Transfers that the master queues for one node.
const BATCH: usize = 30;
const BATCHES: u64 = 100;
const WARM: u64 = 5;
/// Largest value of the simulated device.
const LONG: usize = 1 << 20;
/// 4 s at 60 kB/s.
const PACED: usize = 240_000;
/// What a bus of 1 Mbit/s allows: 127 segments of 7 bytes in about 128 frames.
const BUS_LIMIT_KB_S: f64 = 60.0;
const SDO_RX: u32 = 0x602;
const SDO_TX: u32 = 0x582;

const STACK: &str = r#"
[stack]
name = "NAME"

[[service]]
name = "fast"
kind = "can"
backend = "virtual"
max_rate = 1000000                     # the default of 150,000 frames/s would be the limit: 1.05 MB/s

[[service]]
name = "wire"
kind = "can"
backend = "virtual"
bitrate = "1M"
pace = true

[[service]]
name = "fastnode"
kind = "canopen-slave"
bus = "fast"
node_id = 2
simulate = "401"

[[service]]
name = "wirenode"
kind = "canopen-slave"
bus = "wire"
node_id = 2
simulate = "401"

[[service]]
name = "fastmaster"
kind = "canopen-master"
bus = "fast"
heartbeat = "0ms"

[[service.node]]
id = 2
eds = "io401.eds"

[[service]]
name = "wiremaster"
kind = "canopen-master"
bus = "wire"
heartbeat = "0ms"

[[service.node]]
id = 2
eds = "io401.eds"
"#;

pub fn run(bench: &mut Bench) -> anyhow::Result<()> {
    let mut stack = BenchStack::up(&bench.dir, "sdo", STACK, &[(EDS_FILE, EDS)])?;
    {
        let mut ctx = stack.join()?;
        let mut fast = Side::open(&mut ctx, "fast")?;
        let mut wire = Side::open(&mut ctx, "wire")?;
        fast.master.wait_operational(&mut stack, 1)?;
        wire.master.wait_operational(&mut stack, 1)?;
        expedited(bench, &mut fast)?;
        let (up, down) = fast.blocks(&stack, LONG)?;
        bench.goal("block SDO to the node, no pace", up / 1e6, "MB/s", Goal::AtLeast(2.0));
        bench.goal("block SDO from the node, no pace", down / 1e6, "MB/s", Goal::AtLeast(2.0));
        let (up, down) = wire.blocks(&stack, PACED)?;
        let limit = Goal::AtLeast(BUS_LIMIT_KB_S * 0.9);
        bench.goal("block SDO to the node, 1 Mbit/s", up / 1e3, "kB/s", limit);
        bench.goal("block SDO from the node, 1 Mbit/s", down / 1e3, "kB/s", limit);
    }
    stack.down()?;
    Ok(())
}

/// A bus, its master and its node.
struct Side {
    name: &'static str,
    master: Master,
    rx: Subscriber<CanFrame>,
}

impl Side {
    fn open(ctx: &mut ipc_types::Context, name: &'static str) -> anyhow::Result<Self> {
        let master = Master::open(ctx, &format!("{name}master"))?;
        Ok(Self { name, master, rx: ctx.subscriber(&format!("{name}/rx"))? })
    }

    /// A value to the node and back: bytes a second on the bus, each way.
    fn blocks(&mut self, stack: &BenchStack, bytes: usize) -> anyhow::Result<(f64, f64)> {
        let value: Vec<u8> = (0..bytes as u32).map(|i| (i.wrapping_mul(0x9E37_79B9) >> 24) as u8).collect();
        let (from, to) = (stack.dir().join("value"), stack.dir().join("back"));
        std::fs::write(&from, &value)?;
        let node = json!({ "node": 2, "object": "2000", "mode": "block" });
        let job = |what: &str, file: &std::path::Path| {
            let mut job = node.clone();
            (job["do"], job["file"]) = (json!(what), json!(file));
            job
        };
        let up = self.rate(&job("sdo_write", &from), bytes)?;
        let down = self.rate(&job("sdo_read", &to), bytes)?;
        ensure!(std::fs::read(&to)? == value, "another value came back");
        Ok((up, down))
    }

    fn rate(&mut self, job: &serde_json::Value, bytes: usize) -> anyhow::Result<f64> {
        self.rx.drain(8192, |_, _| ());
        let (mut first, mut last, mut frames) = (u64::MAX, 0, 0u64);
        let rx = &mut self.rx;
        let mut look = || {
            rx.drain(8192, |frame, _| {
                if matches!(frame.id(), SDO_RX | SDO_TX) {
                    (first, last, frames) =
                        (first.min(frame.stamp.t_ns), last.max(frame.stamp.t_ns), frames + 1);
                }
            });
        };
        self.master.ask(std::slice::from_ref(job), &mut look)?;
        // What the answer overtook. First and last frame tell the time; some between may have been missed here.
        look();
        ensure!(frames > 2 && last > first, "{}: no transfer was seen on the bus", self.name);
        Ok(bytes as f64 / ((last - first) as f64 / 1e9))
    }
}

/// Reads of four bytes one behind the other: from one request on the bus to the next is a whole round trip, through
/// driver, node, driver and master.
fn expedited(bench: &mut Bench, side: &mut Side) -> anyhow::Result<()> {
    let read = json!({ "do": "sdo_read", "node": 2, "object": "1018:01", "mode": "segmented" });
    let batch = vec![read; BATCH];
    let (mut round, mut answer) = (Samples::default(), Samples::default());
    for run in 0..WARM + bench.seconds.map_or(BATCHES, |s| s * 20) {
        side.rx.drain(8192, |_, _| ());
        let answers = side.master.ask(&batch, || ())?;
        ensure!(answers.iter().all(|a| a["bytes"] == 4), "unexpected answer {:?}", answers[0]);
        let (mut asked_ns, mut asked) = (None, 0);
        side.rx.drain(8192, |frame, _| match (frame.id(), asked_ns) {
            (SDO_RX, before) => {
                let now_ns = frame.stamp.t_ns;
                if let Some(before) = before.filter(|_| run >= WARM) {
                    round.push((now_ns - before) as f64 / 1e3);
                }
                (asked_ns, asked) = (Some(now_ns), asked + 1);
            }
            (SDO_TX, Some(before)) if run >= WARM => {
                answer.push((frame.stamp.t_ns - before) as f64 / 1e3);
            }
            _ => {}
        });
        ensure!(asked == BATCH, "{asked} of {BATCH} requests were on the bus");
    }
    bench.info("expedited SDO reads", answer.len() as f64, "");
    let (round, answer) = (round.sorted(), answer.sorted());
    bench.goal("expedited SDO round trip, p50", round.p50(), "us", Goal::AtMost(250.0));
    bench.info("expedited SDO round trip, p99", round.p99(), "us");
    bench.info("expedited SDO, request -> answer on the bus, p50", answer.p50(), "us");
    Ok(())
}
