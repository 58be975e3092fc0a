//! How punctual the SYNC is, beside timer loops of this bench in the same run.
//!
//! All figures have one definition: how late a stamp is on the grid of its period, counted from the earliest stamp of the
//! run. The stamp of a SYNC is the driver's, so it holds two wakes: the master's by its clock, the driver's by the master.
//! The loops are two threads of the same period and the same priorities: the first sleeps until an absolute time as
//! cyclictest does, then wakes the second. They run half a period away from the SYNC, so that neither waits for the other.

use super::super::stack::BenchStack;
use super::super::stats::{Samples, Sorted};
use super::super::{Bench, Goal};
use super::observe;
use crate::supervise::sys::{may_fifo, set_fifo};
use anyhow::{anyhow, ensure};
use ipc_types::clock::mono_ns;
use ipc_types::payload::CanFrame;
use rustix::thread::{ClockId, clock_nanosleep_absolute};
use std::io::{Read as _, Write as _};
use std::os::unix::net::UnixStream;
use std::time::Duration;

const SECONDS: u64 = 15;
const PERIOD_NS: u64 = 10_000_000;
/// Nothing came for so long before the earliest of its period.
const GAP_NS: u64 = PERIOD_NS / 10;
/// Of the master. The driver's is one above: whom the master wakes shall not wait until it sleeps.
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
DRIVER

[[service]]
name = "io"
kind = "canopen-master"
sync_period = "10ms"
heartbeat = "0ms"
MASTER
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
    let key = |more| priority.map_or_else(String::new, |p| format!("priority = {}", p + more));
    let text = STACK.replace("DRIVER", &key(1)).replace("MASTER", &key(0));
    let mut stack = BenchStack::up(&bench.dir, "sync", &text, &[])?;
    let (mut stamps, mut loops) = (Vec::new(), Ok(Loops::default()));
    {
        let ctx = stack.join()?;
        let mut rx = ctx.subscriber::<CanFrame>("can0/rx")?;
        let mut warm_ns = mono_ns();
        observe(&mut stack, &mut rx, WARM, |t_ns, frame| {
            if frame.id() == SYNC {
                warm_ns = t_ns;
            }
        })?;
        std::thread::scope(|scope| -> anyhow::Result<()> {
            let looping = scope.spawn(move || timer_loops(warm_ns + PERIOD_NS / 2, span, priority));
            observe(&mut stack, &mut rx, span, |t_ns, frame| {
                if frame.id() == SYNC {
                    stamps.push(t_ns);
                }
            })?;
            loops = looping.join().map_err(|_| anyhow!("the timer loop panicked"))?;
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
    match loops {
        Ok(loops) => {
            for (what, stamps) in
                [("timer loop", &loops.woken), ("timer loop that wakes a thread", &loops.passed_on)]
            {
                let late = lateness(stamps)?;
                bench.info(format!("{what}, {scheduler}, p99"), late.p99(), "us");
                bench.info(format!("{what}, {scheduler}, max"), late.max(), "us");
            }
        }
        Err(e) => bench.note(format!("no timer loop beside the SYNC of {scheduler}: {e}")),
    }
    if priority.is_some() && !may_fifo(PRIORITY + 1) {
        bench.note("this user may not use SCHED_FIFO: the services ran without it");
    }
    Ok(())
}

/// How late each stamp is on the grid of the earliest, in us. The grid's phase is found from the stamps: the earliest one
/// comes behind a gap in their phases, and most stamps come soon behind it. The largest gap alone would not do: one stamp
/// that is late by more than half a period makes two.
fn lateness(stamps: &[u64]) -> anyhow::Result<Sorted> {
    let mut phases: Vec<u64> = stamps.iter().map(|t_ns| t_ns % PERIOD_NS).collect();
    phases.sort_unstable();
    let last = phases.last().copied().unwrap_or(0);
    ensure!(phases.len() > 1, "{} stamps are too few", phases.len());
    let before = std::iter::once(last.wrapping_sub(PERIOD_NS)).chain(phases.iter().copied());
    let gaps: Vec<(u64, u64)> =
        before.zip(&phases).map(|(before, phase)| (phase.wrapping_sub(before), *phase)).collect();
    let widest = gaps.iter().map(|(gap, _)| *gap).max().unwrap_or(0);
    let behind = |first: u64| {
        let late = phases.iter().map(move |phase| ((phase + PERIOD_NS - first) % PERIOD_NS) as f64 / 1e3);
        late.collect::<Samples>().sorted()
    };
    let grids = gaps.iter().filter(|(gap, _)| *gap >= widest.min(GAP_NS)).map(|(_, first)| behind(*first));
    grids.min_by(|a, b| a.p50().total_cmp(&b.p50())).ok_or_else(|| anyhow!("no stamps"))
}

/// Stamps of the loops.
#[derive(Default)]
struct Loops {
    /// The first thread is awake.
    woken: Vec<u64>,
    /// The second is.
    passed_on: Vec<u64>,
}

/// From `first_ns` on, for so long.
fn timer_loops(first_ns: u64, span: Duration, priority: Option<u32>) -> anyhow::Result<Loops> {
    let (bell, mut ear) = UnixStream::pair()?;
    let listener = std::thread::spawn(move || -> anyhow::Result<Vec<u64>> {
        if let Some(priority) = priority {
            set_fifo(priority + 1)?;
        }
        let mut stamps = Vec::with_capacity((span.as_nanos() as u64 / PERIOD_NS) as usize + 1);
        // Nothing to read any more: the bell is gone.
        while ear.read(&mut [0])? > 0 {
            stamps.push(mono_ns());
        }
        Ok(stamps)
    });
    let woken = ring(first_ns, span, priority, bell);
    let passed_on = listener.join().map_err(|_| anyhow!("the second thread panicked"))?;
    Ok(Loops { woken: woken?, passed_on: passed_on? })
}

fn ring(
    mut at_ns: u64,
    span: Duration,
    priority: Option<u32>,
    mut bell: UnixStream,
) -> anyhow::Result<Vec<u64>> {
    if let Some(priority) = priority {
        set_fifo(priority)?;
    }
    let end_ns = at_ns + span.as_nanos() as u64;
    let mut stamps = Vec::with_capacity((span.as_nanos() as u64 / PERIOD_NS) as usize + 1);
    while at_ns < end_ns {
        let at = rustix::thread::Timespec {
            tv_sec: (at_ns / 1_000_000_000) as i64,
            tv_nsec: (at_ns % 1_000_000_000) as _,
        };
        clock_nanosleep_absolute(ClockId::Monotonic, &at)?;
        let now_ns = mono_ns();
        stamps.push(now_ns);
        bell.write_all(&[1])?;
        at_ns += PERIOD_NS * (1 + now_ns.saturating_sub(at_ns) / PERIOD_NS);
    }
    Ok(stamps)
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
        // One that is late by more than half a period is no earliest one.
        let mut one_late = vec![20_000; 50];
        (one_late[3], one_late[7], one_late[9]) = (5_920_000, 60_000, 25_000);
        let one_late = late(&one_late);
        assert_eq!((one_late.p50(), one_late.percentile(98.0), one_late.max()), (0.0, 40.0, 5_900.0));
        assert!(lateness(&[1]).is_err());
    }

    #[test]
    fn both_loops_stamp_every_period() {
        let loops = timer_loops(mono_ns() + PERIOD_NS, Duration::from_nanos(5 * PERIOD_NS), None).unwrap();
        assert_eq!(loops.woken.len(), loops.passed_on.len());
        assert!((1..=5).contains(&loops.woken.len()), "{}", loops.woken.len());
        assert!(loops.woken.iter().zip(&loops.passed_on).all(|(first, second)| first <= second));
    }
}
