//! Sending on a bus of a running stack without loss: what the driver refuses is offered again, and every frame is
//! followed until it was on the bus.

use super::flight::{Flight, Order};
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
    /// Frames of the bus that were replaced before they were read: echoes may be among them.
    pub unseen: u64,
}

/// See the module.
pub struct Sender {
    bus: String,
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
        let (rx, tx) = (topic(ctx, bus, TopicKind::CanRx)?, topic(ctx, bus, TopicKind::CanTx)?);
        let rx = place(ctx, ctx.subscriber::<CanFrame>(&rx))?;
        let tx = ctx.publisher::<CanFrame>(&tx);
        let tx = place(ctx, tx)?;
        // Short waits shall be short. Where it is refused they are a little longer.
        let _ = rustix::thread::set_current_timer_slack(NonZeroU64::new(1000));
        Ok(Self {
            bus: bus.to_owned(),
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
        self.rx.drain(BATCH, |seen, _| {
            if seen.flags & can_flag::TX_ECHO != 0 && flight.seen(seen) {
                any = true;
                each(seen);
            }
        });
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
            unseen: self.rx.counters().lost,
        }
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
        None
    }
}
