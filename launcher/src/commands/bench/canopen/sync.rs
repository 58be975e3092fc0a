//! How punctual the SYNC is, beside a timer loop of this bench at the same time.
//!
//! The stamp of a SYNC holds two wakes, the master's and the driver's; the loop's figure one. The loop does what
//! cyclictest does (sleep with `clock_nanosleep` until an absolute time, see how late it is), but is the bench's own.

use super::super::stack::BenchStack;
use super::super::stats::{Samples, Sorted};
use super::super::{Bench, Goal};
use super::observe;
use crate::supervise::sys::{may_fifo, set_fifo};
use anyhow::{anyhow, ensure};
use ipc_types::clock::mono_ns;
use ipc_types::payload::CanFrame;
use rustix::thread::{ClockId, clock_nanosleep_absolute};
use std::time::Duration;

const SECONDS: u64 = 15;
const PERIOD_NS: u64 = 10_000_000;
const PRIORITY: u32 = 80;
/// The first ones are of a process that just started.
const WARM: Duration = Duration::from_millis(500);
const SYNC: u32 = 0x80;

const STACK: &str = r#"
[stack]
name = "NAME"

[[service]]
name = "can0"
kind = "can"
backend = "virtual"
MORE

[[service]]
name = "io"
kind = "canopen-master"
sync_period = "10ms"
heartbeat = "0ms"
MORE
"#;

/// Under the normal scheduler.
pub fn other(bench: &mut Bench) -> anyhow::Result<()> {
    run(bench, None, 1000.0)
}

/// With real-time priority.
pub fn fifo(bench: &mut Bench) -> anyhow::Result<()> {
    run(bench, Some(PRIORITY), 100.0)
}

fn run(bench: &mut Bench, priority: Option<u32>, limit_us: f64) -> anyhow::Result<()> {
    let span = Duration::from_secs(bench.seconds(SECONDS));
    let more = priority.map_or_else(String::new, |p| format!("priority = {p}"));
    let mut stack = BenchStack::up(&bench.dir, "sync", &STACK.replace("MORE", &more), &[])?;
    let (mut stamps, mut timer) = (Vec::new(), Ok(Samples::default()));
    {
        let ctx = stack.join()?;
        let mut rx = ctx.subscriber::<CanFrame>("can0/rx")?;
        observe(&mut stack, &mut rx, WARM, |_, _| ())?;
        std::thread::scope(|scope| -> anyhow::Result<()> {
            let looping = scope.spawn(move || timer_loop(span, priority));
            observe(&mut stack, &mut rx, span, |t_ns, frame| {
                if frame.id() == SYNC {
                    stamps.push(t_ns);
                }
            })?;
            timer = looping.join().map_err(|_| anyhow!("the timer loop panicked"))?;
            Ok(())
        })?;
    }
    stack.down()?;
    let scheduler = if priority.is_some() { "SCHED_FIFO" } else { "SCHED_OTHER" };
    let late = lateness(&stamps)?;
    let wanted = span.as_nanos() as f64 / PERIOD_NS as f64;
    bench.goal(format!("SYNC jitter, {scheduler}, p99"), late.p99(), "us", Goal::Below(limit_us));
    bench.info(format!("SYNC jitter, {scheduler}, max"), late.max(), "us");
    bench.info(format!("SYNCs seen, {scheduler}"), stamps.len() as f64 / wanted * 100.0, "%");
    match timer {
        Ok(timer) => {
            let timer = timer.sorted();
            bench.info(format!("timer loop of this bench, {scheduler}, p99"), timer.p99(), "us");
            bench.info(format!("timer loop of this bench, {scheduler}, max"), timer.max(), "us");
        }
        Err(e) => bench.note(format!("no timer loop beside the SYNC of {scheduler}: {e}")),
    }
    if priority.is_some() && !may_fifo(PRIORITY) {
        bench.note("this user may not use SCHED_FIFO: the services ran without it");
    }
    Ok(())
}

/// How late each SYNC is on the grid of the earliest, in us. The grid's phase is found from the stamps: behind the
/// largest gap in their phases the earliest begins.
fn lateness(stamps: &[u64]) -> anyhow::Result<Sorted> {
    let mut phases: Vec<u64> = stamps.iter().map(|t_ns| t_ns % PERIOD_NS).collect();
    phases.sort_unstable();
    let last = phases.last().copied().unwrap_or(0);
    ensure!(phases.len() > 1, "{} SYNCs were on the bus", phases.len());
    let before = std::iter::once(last.wrapping_sub(PERIOD_NS)).chain(phases.iter().copied());
    let gaps = before.zip(&phases).map(|(before, phase)| (phase.wrapping_sub(before), *phase));
    let (_, first) = gaps.max().unwrap_or((0, 0));
    let late = phases.iter().map(|phase| ((phase + PERIOD_NS - first) % PERIOD_NS) as f64 / 1e3);
    Ok(late.collect::<Samples>().sorted())
}

fn timer_loop(span: Duration, priority: Option<u32>) -> anyhow::Result<Samples> {
    if let Some(priority) = priority {
        set_fifo(priority)?;
    }
    let mut samples = Samples::default();
    let (mut at_ns, end_ns) = (mono_ns() + PERIOD_NS, mono_ns() + span.as_nanos() as u64);
    while at_ns < end_ns {
        let at = rustix::thread::Timespec {
            tv_sec: (at_ns / 1_000_000_000) as i64,
            tv_nsec: (at_ns % 1_000_000_000) as _,
        };
        clock_nanosleep_absolute(ClockId::Monotonic, &at)?;
        let late_ns = mono_ns().saturating_sub(at_ns);
        samples.push(late_ns as f64 / 1e3);
        at_ns += PERIOD_NS * (1 + late_ns / PERIOD_NS);
    }
    Ok(samples)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lateness_counts_from_the_earliest_also_over_the_end_of_a_period() {
        let late = |offsets: &[u64]| {
            let stamps: Vec<u64> =
                offsets.iter().enumerate().map(|(i, o)| i as u64 * PERIOD_NS + o).collect();
            lateness(&stamps).unwrap()
        };
        let some = late(&[50_000, 20_000, 120_000]);
        assert_eq!((some.p50(), some.max()), (30.0, 100.0));
        // 9.99 ms, 10.02 ms: the second is 30 us late, not the first nearly a period.
        let over = late(&[9_990_000, 10_020_000, 9_991_000]);
        assert_eq!((over.p50(), over.max()), (1.0, 30.0));
        assert!(lateness(&[1]).is_err());
    }
}
