//! The ports that master and slave have alike: the bus, the image, the inputs.

use ipc_types::can_queue::{CanQueue, Handed};
use ipc_types::event::{EventKind, Level};
use ipc_types::inputs::InputsPort;
use ipc_types::outputs::{Guard, OutputImage};
use ipc_types::payload::CanFrame;
use ipc_types::port::{Publisher, Subscriber};
use ipc_types::rail::RailError;
use ipc_types::topic::TopicKind;
use ipc_types::turns::{Turn, Turns};
use ipc_types::{Context, Wiring, clock};
use serde_json::{Value, json};
use std::io;

/// Frames that wait for room in the driver's queue; more are dropped and counted.
const MAX_WAITING: usize = 1024;
/// A driver that starts with the service is there within this time; later than that, the user is told.
const LATE_NS: u64 = 1_000_000_000;
/// So often one looks for it until then.
const LOOK_NS: u64 = 1_000_000;

/// See the module. What the wiring does not name is not there.
pub struct Ports {
    pub rx: Option<Subscriber<CanFrame>>,
    tx: Option<Publisher<CanFrame>>,
    /// Name of the bus.
    bus: String,
    /// What waits for room in the driver's queue.
    pub queue: CanQueue,
    pub image: OutputImage,
    pub inputs: InputsPort,
}

impl Ports {
    pub fn open(ctx: &mut Context, wiring: &Wiring, guard: Guard) -> Result<Self, RailError> {
        let read =
            |suffix: &str| wiring.reads.iter().find(|r| r.topic.ends_with(suffix)).map(|r| r.topic.as_str());
        let rx = read("/rx").map(|topic| ctx.subscriber(topic)).transpose()?;
        let image = read("/image").map(|topic| ctx.subscriber(topic)).transpose()?;
        let to_driver = wiring.writes.first().map(|(topic, _)| topic.as_str());
        let bus = to_driver.and_then(|topic| topic.split('/').next()).unwrap_or_default().to_owned();
        let tx = to_driver.map(|topic| ctx.publisher(topic)).transpose()?;
        let inputs = if wiring.inputs.is_empty() {
            None
        } else {
            let topic = TopicKind::Inputs.of(&ctx.service);
            Some(ctx.publisher(&topic)?)
        };
        let mut image = OutputImage::new(image, guard);
        if wiring.outputs.is_empty() {
            image = image.without_outputs();
        }
        Ok(Self { rx, tx, bus, queue: CanQueue::new(MAX_WAITING), image, inputs: InputsPort::new(inputs) })
    }

    /// Looks for the driver of the bus. The caller begins once it is there: what is sent before is lost, the reset of all
    /// nodes or a device's boot-up message.
    pub fn find_driver(&self, search: &mut Search, now_ns: u64, ctx: &mut Context) -> bool {
        let found = search.look(now_ns, self.tx.as_ref().is_none_or(Publisher::has_reader));
        match found {
            Found::No | Found::Yes { after_ns: None } => {}
            Found::Late => ctx.event(
                EventKind::BusState,
                Level::Warning,
                format!("bus '{}' has no driver yet: nothing is sent until it is there", self.bus),
                Value::Null,
            ),
            Found::Yes { after_ns: Some(after_ns) } => {
                let after_ms = after_ns / 1_000_000;
                let message =
                    format!("the driver of bus '{}' is there, after {after_ms} ms: it begins", self.bus);
                ctx.event(EventKind::BusState, Level::Info, message, json!({ "after_ms": after_ms }));
            }
        }
        matches!(found, Found::Yes { .. })
    }

    /// When there is something to do: at once where frames of the bus may wait (`more`), else at the next deadline of the
    /// image, the queue and the node or network (`of_node`).
    pub fn next_ns(&self, now_ns: u64, more: bool, of_node: Option<u64>) -> Option<u64> {
        if more {
            return Some(now_ns);
        }
        let deadlines = [of_node, self.image.next_deadline(), self.queue.next_deadline(now_ns)];
        // Never in the past: the clock would ring for ever.
        deadlines.into_iter().flatten().min().map(|at_ns| at_ns.max(now_ns + 1))
    }

    /// Hands frames to the driver, in order; what finds no room waits. `sent` is told each that it took.
    pub fn send(
        &mut self,
        frames: impl IntoIterator<Item = CanFrame>,
        sent: impl FnMut(&CanFrame),
    ) -> Handed {
        let Some(tx) = &mut self.tx else { return Handed::On };
        self.queue.add(frames);
        self.queue.send(tx, sent).unwrap_or_else(|e| {
            tracing::warn!("{e}");
            Handed::On
        })
    }
}

/// What master and slave do alike before they begin, and with each heartbeat.
pub trait Station {
    fn parts(&mut self) -> (&mut Ports, &mut Context);

    /// Sends all inputs. `fresh`: news, so the plc is woken; otherwise a repetition.
    fn publish(&mut self, fresh: bool);

    /// Sends the status.
    fn status(&mut self);

    /// Tells the plc that its inputs have no data yet, so that its first scan need not wait.
    fn introduce(&mut self) {
        self.publish(true);
        self.parts().1.ready();
        self.status();
    }

    /// Until the driver of the bus is there; false: the service shall end.
    fn await_driver(&mut self, turns: &mut Turns) -> io::Result<bool> {
        let mut search = Search::new(clock::mono_ns());
        loop {
            let now_ns = clock::mono_ns();
            let (ports, ctx) = self.parts();
            if ports.find_driver(&mut search, now_ns, ctx) {
                return Ok(true);
            }
            turns.come_again(search.next_ns(now_ns))?;
            let due = turns.wait()?;
            if due.stop {
                return Ok(false);
            }
            turns.drain();
            self.regular(due);
        }
    }

    /// What comes with the heartbeat.
    fn regular(&mut self, due: Turn) {
        if due.beat {
            let (ports, ctx) = self.parts();
            ctx.beat();
            if ports.inputs.is_due(clock::mono_ns()) {
                self.publish(false);
            }
        }
        if due.status {
            self.status();
        }
    }
}

/// The search for the driver of the bus, from the start of the service on. Sans-I/O.
#[derive(Debug)]
pub struct Search {
    since_ns: u64,
    late: bool,
}

/// What a look for the driver gave.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Found {
    No,
    /// Not yet, and the user is to be told.
    Late,
    /// `after_ns`: it was late.
    Yes {
        after_ns: Option<u64>,
    },
}

impl Search {
    pub fn new(now_ns: u64) -> Self {
        Self { since_ns: now_ns, late: false }
    }

    fn look(&mut self, now_ns: u64, there: bool) -> Found {
        let after_ns = now_ns.saturating_sub(self.since_ns);
        if there {
            Found::Yes { after_ns: self.late.then_some(after_ns) }
        } else if after_ns >= LATE_NS && !std::mem::replace(&mut self.late, true) {
            Found::Late
        } else {
            Found::No
        }
    }

    /// When to look again; `None`: with the next heartbeat.
    pub fn next_ns(&self, now_ns: u64) -> Option<u64> {
        (!self.late).then(|| now_ns.saturating_add(LOOK_NS))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: u64 = 1_000_000;

    #[test]
    fn a_driver_that_is_there_in_time_is_not_worth_a_word() {
        let mut search = Search::new(5 * MS);
        assert_eq!(search.look(5 * MS, false), Found::No);
        assert_eq!(search.next_ns(5 * MS), Some(6 * MS));
        assert_eq!(search.look(1004 * MS, false), Found::No);
        assert_eq!(search.look(1004 * MS, true), Found::Yes { after_ns: None });
    }

    #[test]
    fn a_late_driver_is_told_of_once_and_awaited_for_ever() {
        let mut search = Search::new(5 * MS);
        assert_eq!(search.look(1005 * MS, false), Found::Late);
        assert_eq!(search.next_ns(1005 * MS), None, "the heartbeat is often enough");
        for s in 2..1000 {
            assert_eq!(search.look(s * 1000 * MS, false), Found::No);
        }
        assert_eq!(search.look(1_000_005 * MS, true), Found::Yes { after_ns: Some(1_000_000 * MS) });
    }
}
