//! Reading one or several buses of a running stack as an observer.

use super::merge::Merge;
use super::{place, topic};
use ipc_types::payload::CanFrame;
use ipc_types::port::Subscriber;
use ipc_types::topic::TopicKind;
use ipc_types::{Context, clock};
use std::time::Duration;

/// Observers have no inbox: they look this often.
pub const LOOK: Duration = Duration::from_millis(5);
/// Frames taken of a bus at one look.
const BATCH: usize = 4096;
/// With several buses: how long a frame waits for an earlier one of another bus. Covers [`LOOK`] and the drivers' own
/// delay between the stamp of a frame and its message.
const HOLD_NS: u64 = 30_000_000;

/// Several buses.
pub struct Listener {
    pub buses: Vec<String>,
    readers: Vec<Subscriber<CanFrame>>,
    merge: Merge<CanFrame>,
}

impl Listener {
    pub fn new(ctx: &Context, buses: Vec<String>) -> anyhow::Result<Self> {
        let mut readers = Vec::new();
        for bus in &buses {
            let name = topic(ctx, bus, TopicKind::CanRx)?;
            readers.push(place(&ctx.stack, || ctx.subscriber::<CanFrame>(&name))?);
        }
        let merge = Merge::new(buses.len(), HOLD_NS);
        Ok(Self { buses, readers, merge })
    }

    /// Hands over what is there, in order of time: index of the bus and frame. `ended`: nothing more is waited for.
    /// `take` says whether it wants more.
    pub fn look(&mut self, ended: bool, mut take: impl FnMut(usize, &CanFrame) -> bool) {
        for (bus, reader) in self.readers.iter_mut().enumerate() {
            reader.drain(BATCH, |message, _| self.merge.push(bus, message.stamp.t_ns, *message));
        }
        let now_ns = if ended { u64::MAX } else { clock::mono_ns() };
        while let Some((bus, _, message)) = self.merge.pop(now_ns) {
            if !take(bus, &message) {
                return;
            }
        }
    }

    /// Frames that were replaced before they were read, per bus.
    pub fn lost(&self) -> Vec<u64> {
        self.readers.iter().map(|r| r.counters().lost).collect()
    }

    /// What to say about frames that were not seen; `None` when there are none.
    pub fn loss_text(&self) -> Option<String> {
        let lost = self.lost();
        let total: u64 = lost.iter().sum();
        if total == 0 {
            return None;
        }
        let each = self.buses.iter().zip(&lost).filter(|(_, n)| **n > 0);
        let each = each.map(|(bus, n)| format!("{bus} {n}")).collect::<Vec<_>>().join(", ");
        Some(format!(
            "{total} frames were not seen ({each}): this terminal is slower than the bus; write to a file, use --filter or --log FILE"
        ))
    }
}

/// Widest name, for a column.
pub fn widest(buses: &[String]) -> usize {
    buses.iter().map(String::len).max().unwrap_or(0)
}
