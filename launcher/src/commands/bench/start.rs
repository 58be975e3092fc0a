//! From `up` of the demo stack to its PLC's first scan.
//!
//! PLC time is 0 in the first scan of a cold start and runs with CLOCK_MONOTONIC, so any later image tells when
//! the first scan was: nobody has to watch, and disturb, the start.

use super::demo::{self, Changes};
use super::stats::Samples;
use super::{Bench, Goal};
use ipc_types::clock::mono_ns;
use ipc_types::payload::{Image, PlcState};

const RUNS: u64 = 10;

pub fn run(bench: &mut Bench) -> anyhow::Result<()> {
    let mut all = Samples::default();
    for _ in 0..bench.seconds(RUNS) {
        all.push(one(bench)?);
    }
    bench.info("starts of the demo stack", all.len() as f64, "");
    let all = all.sorted();
    bench.goal("`up` -> first scan, p50", all.p50(), "ms", Goal::Below(500.0));
    bench.goal("`up` -> first scan, max", all.max(), "ms", Goal::Below(500.0));
    Ok(())
}

fn one(bench: &Bench) -> anyhow::Result<f64> {
    let began_ns = mono_ns();
    let mut stack = demo::spawn(&bench.dir, "start", Changes::default())?;
    stack.wait_ready()?;
    let first_ns = {
        let ctx = stack.join()?;
        let mut image = ctx.subscriber::<Image>("plc/image")?;
        let mut first_ns = None;
        stack.wait("an image of the running program", |_| {
            image.newest(|image, _| {
                if image.scan > 0 && image.plc_state() == PlcState::Run {
                    first_ns = image.stamp.t_ns.checked_sub(image.plc_time_ns.max(0) as u64);
                }
            });
            first_ns
        })?
    };
    stack.down()?;
    Ok(first_ns.saturating_sub(began_ns) as f64 / 1e6)
}
