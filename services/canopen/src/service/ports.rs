//! The ports that master and slave have alike: the bus, the image, the inputs.

use crate::protocol::io::Outbox;
use ipc_types::can_queue::{CanQueue, Handed};
use ipc_types::inputs::InputsPort;
use ipc_types::outputs::{Guard, OutputImage};
use ipc_types::payload::CanFrame;
use ipc_types::port::{Publisher, Subscriber};
use ipc_types::rail::RailError;
use ipc_types::topic::TopicKind;
use ipc_types::{Context, Wiring, clock};

/// Frames that wait for room in the driver's queue; more are dropped and counted.
const MAX_WAITING: usize = 1024;
/// So long the first frames wait for a driver that still starts: the reset of all nodes and a device's boot-up message
/// must not be lost.
const DRIVER_NS: u64 = 1_000_000_000;

/// See the module. What the wiring does not name is not there.
pub struct Ports {
    pub rx: Option<Subscriber<CanFrame>>,
    tx: Option<Publisher<CanFrame>>,
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
        let tx = wiring.writes.first().map(|(topic, _)| ctx.publisher(topic)).transpose()?;
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
        Ok(Self {
            rx,
            tx,
            queue: CanQueue::new(MAX_WAITING).until_driver(clock::mono_ns() + DRIVER_NS),
            image,
            inputs: InputsPort::new(inputs),
        })
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
    pub fn send(&mut self, out: &mut Outbox, sent: impl FnMut(&CanFrame)) -> Handed {
        let Some(tx) = &mut self.tx else { return Handed::On };
        self.queue.add(out.drain());
        self.queue.send(clock::mono_ns(), tx, sent).unwrap_or_else(|e| {
            tracing::warn!("{e}");
            Handed::On
        })
    }
}
