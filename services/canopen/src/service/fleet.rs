//! A fleet of simulated devices on the bus of a running stack, played by an observer: benches and tests.

use super::TAKE_FRAMES;
use crate::protocol::io::Outbox;
use crate::slave::fleet::Fleet;
use ipc_types::can_queue::CanQueue;
use ipc_types::payload::CanFrame;
use ipc_types::port::{Publisher, SendError, Subscriber};
use ipc_types::rail::RailError;
use ipc_types::topic::TopicKind;
use ipc_types::{Context, clock};
use std::time::Duration;

/// An observer has no inbox: it looks this often.
const LOOK: Duration = Duration::from_micros(200);
/// Frames that wait for room in the driver's queue; more are dropped and counted.
const MAX_WAITING: usize = 4096;

/// The bus as the fleet sees it.
pub struct Player {
    rx: Subscriber<CanFrame>,
    tx: Publisher<CanFrame>,
    queue: CanQueue,
    out: Outbox,
    /// Frames that were never sent: they found no room, or no driver.
    pub dropped: u64,
}

impl Player {
    /// `bus`: name of the can service.
    pub fn open(ctx: &mut Context, bus: &str) -> Result<Self, RailError> {
        let rx = ctx.subscriber(&TopicKind::CanRx.of(bus))?;
        let tx = ctx.publisher(&TopicKind::CanTx.of(bus))?;
        Ok(Self { rx, tx, queue: CanQueue::new(MAX_WAITING), out: Outbox::default(), dropped: 0 })
    }

    /// Plays until `step` says that it is enough: `step` is called between looks at the bus, with now, and may switch
    /// devices on and off.
    pub fn play(
        &mut self,
        fleet: &mut Fleet,
        mut step: impl FnMut(&mut Fleet, u64, &mut Outbox) -> bool,
    ) -> Result<(), SendError> {
        loop {
            let now_ns = clock::mono_ns();
            if !step(fleet, now_ns, &mut self.out) {
                return Ok(());
            }
            self.send()?;
            let taken = self.take(fleet)?;
            if fleet.next_deadline().is_some_and(|at_ns| clock::mono_ns() >= at_ns) {
                fleet.on_time(clock::mono_ns(), &mut self.out);
                self.send()?;
            }
            if taken < TAKE_FRAMES {
                std::thread::sleep(LOOK);
            }
        }
    }

    fn take(&mut self, fleet: &mut Fleet) -> Result<usize, SendError> {
        let (out, queue) = (&mut self.out, &mut self.queue);
        let taken = self.rx.drain(TAKE_FRAMES, |frame, _| {
            if frame.fault().is_none() {
                fleet.on_frame(clock::mono_ns(), frame, out);
                queue.add(out.drain());
            }
        });
        self.send()?;
        Ok(taken)
    }

    fn send(&mut self) -> Result<(), SendError> {
        self.queue.add(self.out.drain());
        let handed = self.queue.send(&mut self.tx, |_| {});
        self.dropped = self.queue.dropped();
        handed.map(|_| ())
    }
}
