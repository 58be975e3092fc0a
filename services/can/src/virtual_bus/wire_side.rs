//! The bus with a wire: a real interface, an adapter or a remote bus behind it.
//!
//! What the nodes of this side give is then not on the bus by itself: the caller takes it by [`VirtualBus::wire_next`]
//! in order of arbitration, at most a few frames at a time so that a later frame of a lower identifier still goes
//! first, and reports when it has been on the wire. What comes from the wire is reported as it comes. So the order of
//! [`Tap`] is the order of the wire.

use super::*;

/// Frames of a wire that came back may have waited this long; older ones are dropped.
pub const STALE_NS: u64 = 2_000_000_000;
/// How long a sent frame is waited for after the kernel dropped frames: its echo may be among them.
const SUSPECT_NS: u64 = 500_000_000;

/// Counters of the wire.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, serde::Serialize)]
pub struct WireCounters {
    /// Frames of this side that were on the wire.
    pub sent: u64,
    /// Frames of others, error frames not counted.
    pub received: u64,
    /// Error frames.
    pub errors: u64,
    /// Frames of this side dropped because they had waited for longer than [`STALE_NS`] when the wire came back, or
    /// because newer ones of the same client came while it took nothing for so long.
    pub stale: u64,
    /// Frames of this side that the wire took and lost: refused by the adapter, or it went down.
    pub lost: u64,
    /// Frames of this side that this wire cannot carry.
    pub unfit: u64,
}

#[derive(Debug)]
struct Flight {
    frame: Frame,
    origin: Origin,
    sent_ns: u64,
    suspect: bool,
}

#[derive(Debug)]
pub(super) struct WireSide {
    flight: VecDeque<Flight>,
    limit: usize,
    up: bool,
    stale_before_ns: u64,
    /// When it took a frame last, or came up.
    moved_ns: u64,
    /// Since when a client (or the feed) cannot queue any more.
    full_since_ns: Option<u64>,
    /// Both last for longer than [`STALE_NS`].
    held: bool,
    counters: WireCounters,
}

/// The time at which the wire counts as held is rounded up to this, so that a busy one moves no clock at each frame.
const HELD_GRID_NS: u64 = 100_000_000;

impl WireSide {
    /// It has taken nothing for so long that what waits is stale.
    pub(super) fn is_held(&self) -> bool {
        self.held
    }

    /// Whether the oldest frame of a full queue goes for a new one; counts it then.
    pub(super) fn sheds(&mut self) -> bool {
        self.counters.stale += u64::from(self.held);
        self.held
    }

    fn moves(&mut self, now_ns: u64) {
        self.moved_ns = now_ns;
        self.full_since_ns = None;
        self.held = false;
    }
}

/// Same frame as sent; drivers set ESI themselves.
fn same(a: &Frame, b: &Frame) -> bool {
    const ESI: u8 = crate::protocol::frame::FD_ESI;
    a.can_id == b.can_id && a.len == b.len && a.fd & !ESI == b.fd & !ESI && a.data == b.data
}

impl VirtualBus {
    /// Puts a wire behind the bus, down at first. `limit`: most frames on their way at once.
    pub fn attach_wire(&mut self, limit: usize) {
        let limit = limit.max(1);
        self.wire = Some(WireSide {
            flight: VecDeque::with_capacity(limit),
            limit,
            up: false,
            stale_before_ns: 0,
            moved_ns: 0,
            full_since_ns: None,
            held: false,
            counters: WireCounters::default(),
        });
    }

    /// Whether a wire is behind the bus.
    pub fn has_wire(&self) -> bool {
        self.wire.is_some()
    }

    /// The wire carries frames from now on.
    pub fn wire_up(&mut self, now_ns: u64) {
        if let Some(wire) = &mut self.wire {
            wire.up = true;
            wire.moves(now_ns);
            wire.stale_before_ns = now_ns.saturating_sub(STALE_NS);
        }
    }

    /// The wire carries nothing from now on; what is on its way is lost, what waits goes on waiting.
    pub fn wire_down(&mut self) {
        if let Some(wire) = &mut self.wire {
            wire.up = false;
        }
        self.wire_flush();
    }

    /// What is on its way is lost (bus-off).
    pub fn wire_flush(&mut self) {
        if let Some(wire) = &mut self.wire {
            wire.counters.lost += wire.flight.len() as u64;
            wire.flight.clear();
        }
    }

    /// True when [`Self::wire_next`] has something.
    pub fn wire_wants(&self) -> bool {
        let free = self.wire.as_ref().is_some_and(|wire| wire.up && wire.flight.len() < wire.limit);
        free && self.any_waiting()
    }

    /// The next frame for the wire; it is on its way until reported. `fits` says what the wire can carry.
    pub fn wire_next(&mut self, now_ns: u64, fits: impl Fn(&Frame) -> bool) -> Option<Frame> {
        while self.wire_wants() {
            let (frame, origin, arrived_ns) = self.next_frame()?;
            let wire = self.wire.as_mut()?;
            if frame.is_error() || !fits(&frame) {
                wire.counters.unfit += 1;
            } else if arrived_ns < wire.stale_before_ns {
                wire.counters.stale += 1;
            } else {
                wire.moves(now_ns);
                wire.flight.push_back(Flight { frame, origin, sent_ns: now_ns, suspect: false });
                return Some(frame);
            }
        }
        None
    }

    /// A frame of this side has been on the wire (its echo came).
    pub fn wire_echo(&mut self, frame: &Frame, t_ns: u64, tap: &mut impl Tap) {
        let Some(wire) = &mut self.wire else { return };
        wire.counters.sent += 1;
        let place = wire.flight.iter().position(|f| same(&f.frame, frame));
        // Not on our list: given up before. It is ours all the same.
        let origin = place.and_then(|i| wire.flight.remove(i)).map_or(Origin::Rail(0), |f| f.origin);
        self.on_bus(frame, origin, t_ns, tap);
    }

    /// The oldest frame on its way has been on the wire, for wires that confirm in order without saying what.
    pub fn wire_sent(&mut self, t_ns: u64, tap: &mut impl Tap) {
        let Some(wire) = &mut self.wire else { return };
        if let Some(flight) = wire.flight.pop_front() {
            wire.counters.sent += 1;
            self.on_bus(&flight.frame, flight.origin, t_ns, tap);
        }
    }

    /// The oldest frame on its way was refused.
    pub fn wire_refused(&mut self) {
        if let Some(wire) = &mut self.wire
            && wire.flight.pop_front().is_some()
        {
            wire.counters.lost += 1;
        }
    }

    /// The wire did not take the frame that [`Self::wire_next`] gave last.
    pub fn wire_not_taken(&mut self) {
        if let Some(wire) = &mut self.wire
            && wire.flight.pop_back().is_some()
        {
            wire.counters.lost += 1;
        }
    }

    /// A frame came from the wire.
    pub fn wire_received(&mut self, frame: &Frame, t_ns: u64, tap: &mut impl Tap) {
        let Some(wire) = &mut self.wire else { return };
        if frame.is_error() {
            wire.counters.errors += 1;
        } else {
            wire.counters.received += 1;
        }
        self.on_bus(frame, Origin::Wire, t_ns, tap);
    }

    /// The kernel dropped what it should have given us: echoes may be among it.
    pub fn wire_dropped(&mut self) {
        for flight in self.wire.iter_mut().flat_map(|wire| &mut wire.flight) {
            flight.suspect = true;
        }
    }

    /// Gives up frames whose echo was probably dropped. Returns since when the oldest frame is on its way.
    pub fn wire_overdue(&mut self, now_ns: u64) -> Option<u64> {
        let wire = self.wire.as_mut()?;
        let before = wire.flight.len();
        wire.flight.retain(|f| !f.suspect || f.sent_ns + SUSPECT_NS > now_ns);
        wire.counters.lost += (before - wire.flight.len()) as u64;
        wire.flight.iter().map(|f| f.sent_ns).min()
    }

    /// Finds out whether the wire holds up its clients for too long. Returns when to look again.
    pub(super) fn wire_holds(&mut self, now_ns: u64) -> Option<u64> {
        let wire = self.wire.as_mut()?;
        if wire.held {
            return None;
        }
        let mut full = 0;
        if self.connected > 0 {
            for (number, client) in self.clients.iter().enumerate() {
                let is_full = client.as_ref().is_some_and(|c| c.waiting.len() >= CLIENT_QUEUE);
                full |= u32::from(is_full) << number;
            }
        }
        if full == 0 && !self.feed_refused {
            wire.full_since_ns = None;
            return None;
        }
        let since_ns = wire.moved_ns.max(*wire.full_since_ns.get_or_insert(now_ns));
        let due_ns = (since_ns + STALE_NS).next_multiple_of(HELD_GRID_NS);
        if now_ns < due_ns {
            return Some(due_ns);
        }
        wire.held = true;
        self.room_again |= full;
        self.feed_room_again |= std::mem::take(&mut self.feed_refused);
        None
    }

    /// A client is gone: what it has on its way belongs to nobody.
    pub(super) fn wire_disown(&mut self, number: usize) {
        for flight in self.wire.iter_mut().flat_map(|wire| &mut wire.flight) {
            if flight.origin == Origin::Client(number) {
                flight.origin = Origin::Wire;
            }
        }
    }

    /// Counters of the wire.
    pub fn wire_counters(&self) -> Option<WireCounters> {
        self.wire.as_ref().map(|wire| wire.counters)
    }
}

#[cfg(test)]
#[path = "wire_side_tests.rs"]
mod tests;
