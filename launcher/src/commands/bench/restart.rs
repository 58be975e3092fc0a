//! From SIGKILL of a service to its next generation at work, in the demo stack with its traffic.
//!
//! At work means: of the PLC, the first image of the new generation; of any other service, the first heartbeat
//! that says `ready`. Both are stamped by the service, so looking at them late does not count.

use super::demo::{self, Changes};
use super::stack::{BenchStack, is_ready, sigkill};
use super::stats::Samples;
use super::{Bench, Goal};
use anyhow::Context as _;
use ipc_types::Context;
use ipc_types::clock::mono_ns;
use ipc_types::payload::{Health, HealthState, Image};
use ipc_types::topic::TopicKind;
use std::time::{Duration, Instant};

const KILLS: u64 = 20;
/// What the last restart stirred up has settled. The stack's restart rule has no back-off.
const PAUSE: Duration = Duration::from_millis(1200);

pub fn run(bench: &mut Bench) -> anyhow::Result<()> {
    let changes = Changes { restarts: true, ..Changes::default() };
    let mut stack = demo::spawn(&bench.dir, "restart", changes)?;
    stack.wait_ready()?;
    {
        let ctx = stack.join()?;
        let services: Vec<(String, String)> =
            ctx.stack.services.iter().map(|s| (s.name.clone(), s.kind.clone())).collect();
        for (name, kind) in services {
            let mut all = Samples::default();
            for _ in 0..bench.seconds(KILLS) {
                all.push(one(&mut stack, &ctx, &name, &kind)?);
            }
            let all = all.sorted();
            bench.goal(format!("SIGKILL of {name} -> at work, p50"), all.p50(), "ms", Goal::Below(100.0));
            bench.info(format!("SIGKILL of {name} -> at work, max"), all.max(), "ms");
        }
    }
    stack.down()?;
    Ok(())
}

fn one(stack: &mut BenchStack, ctx: &Context, name: &str, kind: &str) -> anyhow::Result<f64> {
    let quiet = Instant::now();
    let victim = stack.wait(&format!("{name} ready for some time"), |stack| {
        let row = stack.ps().ok()?.into_iter().find(|row| row.service == name)?;
        (is_ready(&row) && quiet.elapsed() >= PAUSE).then_some(row)
    })?;
    let mut back = Back::watch(ctx, name, kind, victim.generation)?;
    // What waits in the queues is of the old generation.
    back.look();
    let killed_ns = mono_ns();
    sigkill(victim.pid).with_context(|| format!("killing {name}"))?;
    let back_ns = stack.wait(&format!("{name} at work after SIGKILL"), |_| back.look())?;
    Ok(back_ns.saturating_sub(killed_ns) as f64 / 1e6)
}

/// Looks for the first sign of a new generation.
enum Back {
    Image(ipc_types::port::Subscriber<Image>, u32),
    Health(ipc_types::port::Subscriber<Health>, u32),
}

impl Back {
    fn watch(ctx: &Context, name: &str, kind: &str, generation: u32) -> anyhow::Result<Self> {
        Ok(if kind == "plc" {
            Self::Image(ctx.subscriber(&TopicKind::Image.of(name))?, generation)
        } else {
            Self::Health(ctx.subscriber(&TopicKind::Health.of(name))?, generation)
        })
    }

    /// When it came.
    fn look(&mut self) -> Option<u64> {
        let mut first = None;
        match self {
            Self::Image(port, old) => port.drain(16, |image, _| {
                if image.stamp.generation > *old && image.scan > 0 && first.is_none() {
                    first = Some(image.stamp.t_ns);
                }
            }),
            Self::Health(port, old) => port.drain(64, |health, _| {
                let ready = HealthState::from_u32(health.state) == HealthState::Ready;
                if health.stamp.generation > *old && ready && first.is_none() {
                    first = Some(health.stamp.t_ns);
                }
            }),
        };
        first
    }
}
