//! Sending on a bus of a running stack without loss: what the driver refuses is offered again, and every frame is
//! followed until it was on the bus.

use super::flight::{Flight, Order, Sight};
use super::{place, topic};
use dinrail_can::protocol::candump;
use ipc_types::Context;
use ipc_types::payload::{CanFrame, can_flag};
use ipc_types::port::{Publisher, SendError, Subscriber};
use ipc_types::topic::TopicKind;
use std::num::NonZeroU64;
use std::time::{Duration, Instant};

/// A frame must be seen on the bus, or the driver take one, within this time. Longer than the 2 s after which a driver
/// throws away what could not be sent.
const PATIENCE: Duration = Duration::from_secs(3);
/// An equal frame was seen before its turn: so long the real one is awaited. The second is for a driver that has shown
/// that it keeps another order.
const TURN: [Duration; 2] = [Duration::from_secs(1), Duration::from_millis(20)];
/// Others sent equal frames: the last of ours may still be on its way.
const LINGER: Duration = Duration::from_millis(50);
/// Frames taken at one look.
const BATCH: usize = 4096;

/// What was done so far.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, serde::Serialize)]
pub struct Counts {
    /// Taken by the driver.
    pub sent: u64,
    /// Offered while the driver had no room; offered again later.
    pub refused: u64,
    /// Seen on the bus.
    pub echoed: u64,
    /// Seen before one that was given earlier.
    pub out_of_order: u64,
    /// Equal to these, but sent by somebody else of the stack meanwhile.
    pub equal_from_others: u64,
    /// Frames of the bus that were replaced before they were read: echoes may be among them.
    pub unseen: u64,
}

/// See the module.
pub struct Sender {
    bus: String,
    /// Number of this process on the rail.
    writer: u32,
    /// Services of the stack that may send on the bus, too.
    others: Vec<String>,
    rx: Subscriber<CanFrame>,
    tx: Publisher<CanFrame>,
    flight: Flight,
    sent: u64,
    refused: u64,
    rung: bool,
    /// When something last went forward.
    progress: Instant,
    /// Nothing was taken since then although it was offered.
    held_up: bool,
    idle: u32,
}

impl Sender {
    pub fn new(ctx: &mut Context, bus: &str, order: Order) -> anyhow::Result<Self> {
        let others =
            ctx.stack.topic(&TopicKind::CanTx.of(bus)).map(|t| t.writers.clone()).unwrap_or_default();
        let (rx, tx) = (topic(ctx, bus, TopicKind::CanRx)?, topic(ctx, bus, TopicKind::CanTx)?);
        let stack = ctx.stack.clone();
        let rx = place(&stack, || ctx.subscriber::<CanFrame>(&rx))?;
        let tx = place(&stack, || ctx.publisher::<CanFrame>(&tx))?;
        // Short waits shall be short. Where it is refused they are a little longer.
        let _ = rustix::thread::set_current_timer_slack(NonZeroU64::new(1000));
        Ok(Self {
            bus: bus.to_owned(),
            writer: ctx.writer,
            others,
            rx,
            tx,
            flight: Flight::new(order),
            sent: 0,
            refused: 0,
            rung: true,
            progress: Instant::now(),
            held_up: false,
            idle: 0,
        })
    }

    /// Hands a frame over if it may go now; false: offer it again after [`Self::look`].
    pub fn offer(&mut self, frame: &CanFrame) -> anyhow::Result<bool> {
        if !self.flight.has_room(frame) {
            return Ok(false);
        }
        match self.tx.send(*frame) {
            Ok(_) => {
                if self.flight.len() == 0 {
                    self.progress = Instant::now();
                }
                self.flight.sent(frame);
                self.sent += 1;
                (self.rung, self.held_up) = (false, false);
                Ok(true)
            }
            Err(SendError::Full(_) | SendError::NoReader(_)) => {
                self.refused += 1;
                if !self.held_up && self.flight.len() == 0 {
                    self.progress = Instant::now();
                }
                self.held_up = true;
                Ok(false)
            }
            Err(e) => Err(e.into()),
        }
    }

    /// Wakes the driver and takes what was on the bus; `each` is told every frame of ours that was seen. Whether
    /// there was one.
    pub fn look_at(&mut self, mut each: impl FnMut(&CanFrame)) -> bool {
        if !self.rung {
            self.tx.ring();
            self.rung = true;
        }
        let (flight, mut any) = (&mut self.flight, false);
        let writer = self.writer;
        self.rx.drain(BATCH, |seen, _| {
            if seen.flags & can_flag::TX_ECHO == 0 {
                return;
            }
            if seen.echo_of(writer) == Some(false) {
                flight.seen_of_another(seen);
            } else if flight.seen(seen) == Sight::Ours {
                any = true;
                each(seen);
            }
        });
        let turn = TURN[usize::from(self.flight.out_of_order() > 0)];
        if !any && self.flight.is_early() && self.progress.elapsed() > turn {
            self.flight.accept_early();
            any = true;
        }
        if any {
            self.progress = Instant::now();
        }
        any
    }

    /// [`Self::look_at`] without being told.
    pub fn look(&mut self) -> bool {
        self.look_at(|_| ())
    }

    /// Waits a moment: the shorter, the less long nothing has happened.
    pub fn rest(&mut self, busy: bool) {
        self.idle = if busy { 0 } else { self.idle.saturating_add(1) };
        match self.idle {
            0 => {}
            1..=20 => std::thread::yield_now(),
            21..=2000 => std::thread::sleep(Duration::from_micros(20)),
            _ => std::thread::sleep(Duration::from_millis(1)),
        }
    }

    /// Why it makes no sense to wait any longer.
    pub fn stalled(&self) -> Option<String> {
        if self.progress.elapsed() <= PATIENCE {
            return None;
        }
        let seconds = PATIENCE.as_secs();
        if let Some(frame) = self.flight.oldest() {
            let frame = candump::format(frame);
            return Some(format!(
                "{frame}: not seen on bus '{}' within {seconds} s: nobody acknowledges (termination, bit rate, partner?), the bus cannot carry it, or the driver is down (`dinrail ps`)",
                self.bus
            ));
        }
        self.held_up.then(|| {
            format!(
                "bus '{}': its driver takes nothing since {seconds} s; `dinrail ps` says how it is",
                self.bus
            )
        })
    }

    /// Whether frames are under way.
    pub fn is_waiting(&self) -> bool {
        self.flight.len() > 0
    }

    pub fn counts(&self) -> Counts {
        Counts {
            sent: self.sent,
            refused: self.refused,
            echoed: self.flight.echoed(),
            out_of_order: self.flight.out_of_order(),
            equal_from_others: self.flight.equal(),
            unseen: self.rx.counters().lost,
        }
    }

    /// What there is to say about the order and about others; a sentence each.
    pub fn remarks(&self) -> Vec<String> {
        let mut remarks = Vec::new();
        let Counts { out_of_order, equal_from_others, .. } = self.counts();
        if let Some(first) = self.flight.first_out_of_order() {
            remarks.push(format!(
                "bus '{}': {out_of_order} frames were seen before one that was given earlier, and not again in their turn; the first is {}",
                self.bus,
                candump::format(first)
            ));
        }
        if equal_from_others > 0 {
            let who = match self.others.as_slice() {
                [] => "another tool, because no service of the stack sends there".to_owned(),
                others => format!("{} or another tool", others.join(", ")),
            };
            remarks.push(format!(
                "bus '{}': {equal_from_others} frames equal to these came from another sender of the stack ({who})",
                self.bus
            ));
        }
        remarks
    }

    /// Services of the stack that may send on the bus, too.
    pub fn others(&self) -> &[String] {
        &self.others
    }

    /// Waits until everything sent was seen; otherwise says why that took too long.
    pub fn finish(&mut self) -> Option<String> {
        while self.is_waiting() {
            let busy = self.look();
            if let Some(why) = self.stalled() {
                return Some(why);
            }
            self.rest(busy);
        }
        if self.flight.equal() > 0 {
            std::thread::sleep(LINGER);
            self.look();
        }
        None
    }
}
