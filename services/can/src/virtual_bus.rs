//! The virtual bus: a CAN bus inside the driver process.
//!
//! Sans-I/O. Nodes of the bus are the rail (all processes of the stack together, through a [`TxQueue`]), the
//! feed (a recorded log) and the clients (foreign tools on TCP, in their own text protocol). Every frame that a
//! node gives is put into one true order, stamped, told to the [`Tap`] (which publishes it on the rail) and
//! written to every other client. Without pace a frame is on the bus the moment it is given, as long as the bus
//! carries no more than `max_rate` frames a second. With pace the bus is busy as long as the frame takes on a wire.
//! When frames have to wait, the node whose first frame wins arbitration goes next.
//!
//! What a client sends is never dropped: when its queue is full the caller stops reading its socket. Only when a wire
//! behind the bus has taken nothing for [`STALE_NS`] does the oldest frame go for each new one, so that clients that are
//! gone are noticed and leave their places. What a client does not read is dropped: frames that do not fit its output buffer are dropped for it alone, and counted.
//! A slow client never delays the bus. Nothing allocates between a frame in and a frame out.

use std::collections::VecDeque;

use crate::protocol::busload::{LoadMeter, Stuffing, bits};
use crate::protocol::{Frame, cannelloni, slcan, socketcand};
use crate::txqueue::{Pushed, TxCounters, TxQueue};

mod clients;
mod texts;
mod wire_side;
use clients::{Client, Talk};
pub use clients::{ClientCounters, Dialect, HANDSHAKE_HOLD_NS, Stopped, Taken};
use texts::Texts;
use wire_side::WireSide;
pub use wire_side::{STALE_NS, WireCounters};

/// Most clients of one bus.
pub const MAX_CLIENTS: usize = 32;
/// Frames of one client (or of the feed) that wait for a paced bus.
pub const CLIENT_QUEUE: usize = 256;
/// Frames put on the bus in one turn, so that other work of the driver is not delayed for long.
pub const TURN_FRAMES: usize = 256;
/// Frames that may exceed `max_rate` in one burst.
pub const RATE_BURST: u64 = 1024;
/// Where a frame came from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Origin {
    /// A process of the stack, with the low bits of its number; 0: which is not known.
    Rail(u8),
    /// The recorded log.
    Feed,
    /// The client with this number.
    Client(usize),
    /// The wire behind the bus.
    Wire,
}

/// Is told every frame in the bus's one true order.
pub trait Tap {
    /// `t_ns`: CLOCK_MONOTONIC at the end of the frame.
    fn frame(&mut self, frame: &Frame, t_ns: u64, origin: Origin);
}

/// How the bus behaves.
#[derive(Debug, Clone)]
pub struct Settings {
    /// Name that socketcand clients open.
    pub name: String,
    /// Nominal bit rate in bit/s.
    pub bitrate: u32,
    /// Data bit rate of CAN FD in bit/s.
    pub data_bitrate: u32,
    /// Hold frames to the time they take on a wire.
    pub pace: bool,
    /// Without pace: most frames a second (0 counts as 1), so that a reader that sleeps for a moment loses nothing.
    pub max_rate: u32,
    /// Frames of the rail that may wait.
    pub tx_queue: usize,
    /// Bytes that may wait for a client.
    pub client_buffer: usize,
}

/// Counters of the bus.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, serde::Serialize)]
pub struct BusCounters {
    /// Frames on the bus.
    pub frames: u64,
    /// Of these, sent by processes of the stack.
    pub from_rail: u64,
    /// Of these, from the feed.
    pub from_feed: u64,
    /// Frames that clients did not read in time, all clients together.
    pub client_drops: u64,
}

/// See the module.
#[derive(Debug)]
pub struct VirtualBus {
    settings: Settings,
    rail: TxQueue,
    feed: VecDeque<(Frame, u64)>,
    clients: Vec<Option<Client>>,
    connected: usize,
    /// The frame on the wire of a paced bus, when it ends, and how long it takes.
    on_wire: Option<(Frame, Origin, u64, u64)>,
    free_at_ns: u64,
    /// Without pace: time up to which the allowed frames are used up (generic cell rate algorithm).
    used_until_ns: u64,
    frame_ns: u64,
    load: LoadMeter,
    counters: BusCounters,
    wire: Option<WireSide>,
    utc_offset_ns: i64,
    /// Clients that have new output, and clients whose queue has room again, one bit each.
    output_ready: u32,
    room_again: u32,
    /// The queue of the rail was full and is not any more.
    rail_room_again: bool,
    /// A frame of the feed was refused since the last look, and one that waited has gone since.
    feed_refused: bool,
    feed_room_again: bool,
}

impl VirtualBus {
    /// An idle bus without clients.
    pub fn new(settings: Settings) -> Self {
        Self {
            rail: TxQueue::new(settings.tx_queue),
            feed: VecDeque::with_capacity(CLIENT_QUEUE),
            clients: (0..MAX_CLIENTS).map(|_| None).collect(),
            connected: 0,
            on_wire: None,
            free_at_ns: 0,
            used_until_ns: 0,
            frame_ns: 1_000_000_000 / u64::from(settings.max_rate.max(1)),
            load: LoadMeter::default(),
            counters: BusCounters::default(),
            wire: None,
            utc_offset_ns: 0,
            output_ready: 0,
            room_again: 0,
            rail_room_again: false,
            feed_refused: false,
            feed_room_again: false,
            settings,
        }
    }

    /// Difference of UTC to CLOCK_MONOTONIC, for the stamps that socketcand clients see.
    pub fn set_utc_offset(&mut self, utc_offset_ns: i64) {
        self.utc_offset_ns = utc_offset_ns;
    }

    /// Queues a frame of a process of the stack, `sender` being the low bits of its number.
    pub fn push_rail(&mut self, frame: &Frame, newest: bool, now_ns: u64, sender: u8) -> Pushed {
        self.rail.push(frame, newest, now_ns, sender)
    }

    /// Frames of the rail that can still be queued.
    pub fn rail_room(&self) -> usize {
        self.rail.room()
    }

    /// Frames of the rail that wait.
    pub fn rail_waiting(&self) -> usize {
        self.rail.len()
    }

    /// Queues a frame of the feed; false: full, give it again when there is room ([`Self::take_feed_room_again`]).
    pub fn push_feed(&mut self, frame: &Frame, now_ns: u64) -> bool {
        if self.feed.len() >= CLIENT_QUEUE {
            if !self.wire.as_mut().is_some_and(WireSide::sheds) {
                self.feed_refused = true;
                return false;
            }
            self.feed.pop_front();
        }
        self.feed.push_back((*frame, now_ns));
        true
    }

    /// Puts on the bus what can be there by now. Returns when to call again (CLOCK_MONOTONIC ns; `now_ns` itself
    /// when this turn's share is used up), or `None` when nothing waits.
    pub fn run(&mut self, now_ns: u64, tap: &mut impl Tap) -> Option<u64> {
        if self.wire.is_some() {
            // The wire takes what waits when it can.
            return self.wire_holds(now_ns);
        }
        for _ in 0..TURN_FRAMES {
            if let Some((frame, origin, end_ns, wire_ns)) = self.on_wire {
                if end_ns > now_ns {
                    return Some(end_ns);
                }
                self.on_wire = None;
                if !frame.is_error() {
                    self.load.add(end_ns, wire_ns);
                }
                self.tell(&frame, origin, end_ns, tap);
            }
            if !self.settings.pace && !self.may_allow(now_ns) {
                // Not for every single frame: a wake for a quarter of the burst is cheap and still smooth.
                let some_ns = self.frame_ns * RATE_BURST * 3 / 4;
                return self
                    .any_waiting()
                    .then_some(self.used_until_ns.saturating_sub(some_ns).max(now_ns + 1));
            }
            let (frame, origin, arrived_ns) = self.next_frame()?;
            if self.settings.pace {
                let start_ns = self.free_at_ns.max(arrived_ns);
                let wire_ns = self.wire_ns(&frame);
                self.free_at_ns = start_ns + wire_ns;
                self.on_wire = Some((frame, origin, self.free_at_ns, wire_ns));
            } else {
                self.allow(now_ns);
                self.on_bus(&frame, origin, now_ns, tap);
            }
        }
        Some(now_ns)
    }

    fn may_allow(&self, now_ns: u64) -> bool {
        self.used_until_ns <= now_ns.saturating_add(self.frame_ns * RATE_BURST)
    }

    /// Whether another frame is within `max_rate`; uses it up.
    fn allow(&mut self, now_ns: u64) -> bool {
        let allowed = self.may_allow(now_ns);
        if allowed {
            self.used_until_ns = self.used_until_ns.max(now_ns) + self.frame_ns;
        }
        allowed
    }

    fn any_waiting(&self) -> bool {
        !self.rail.is_empty()
            || !self.feed.is_empty()
            || self.clients.iter().flatten().any(|client| !client.waiting.is_empty())
    }

    fn wire_ns(&self, frame: &Frame) -> u64 {
        bits(frame, Stuffing::Exact).time_ns(self.settings.bitrate, self.settings.data_bitrate)
    }

    /// The frame that wins arbitration among the first of every node.
    fn next_frame(&mut self) -> Option<(Frame, Origin, u64)> {
        let rail = self.rail.peek().map(|w| (w.frame.arbitration_key(), Origin::Rail(w.sender)));
        let feed = self.feed.front().map(|(f, _)| (f.arbitration_key(), Origin::Feed));
        let clients = self.clients.iter().enumerate().filter_map(|(number, client)| {
            let (frame, _) = client.as_ref()?.waiting.front()?;
            Some((frame.arbitration_key(), Origin::Client(number)))
        });
        let (_, origin) = rail.into_iter().chain(feed).chain(clients).min_by_key(|(key, _)| *key)?;
        let (frame, arrived_ns) = match origin {
            Origin::Rail(_) => {
                self.rail_room_again |= self.rail.room() == 0;
                self.rail.pop().map(|w| (w.frame, w.fresh_ns))?
            }
            Origin::Feed => {
                self.feed_room_again |= std::mem::take(&mut self.feed_refused);
                self.feed.pop_front()?
            }
            Origin::Client(number) => {
                let client = self.clients[number].as_mut()?;
                self.room_again |= 1 << number;
                client.waiting.pop_front()?
            }
            Origin::Wire => return None,
        };
        Some((frame, origin, arrived_ns))
    }

    /// The frame has been on the bus: stamp, count, tell everyone but its sender.
    fn on_bus(&mut self, frame: &Frame, origin: Origin, t_ns: u64, tap: &mut impl Tap) {
        if !frame.is_error() {
            let wire_ns = self.wire_ns(frame);
            self.load.add(t_ns, wire_ns);
        }
        self.tell(frame, origin, t_ns, tap);
    }

    fn tell(&mut self, frame: &Frame, origin: Origin, t_ns: u64, tap: &mut impl Tap) {
        self.counters.frames += 1;
        match origin {
            Origin::Rail(_) => self.counters.from_rail += 1,
            Origin::Feed => self.counters.from_feed += 1,
            Origin::Client(_) | Origin::Wire => {}
        }
        tap.frame(frame, t_ns, origin);
        if self.connected == 0 {
            return;
        }
        let utc_ns = t_ns.saturating_add_signed(self.utc_offset_ns);
        let mut texts = Texts::default();
        for (number, client) in self.clients.iter_mut().enumerate() {
            let Some(client) = client else { continue };
            if origin == Origin::Client(number) || client.muted {
                continue;
            }
            let text = match &client.talk {
                Talk::Socketcand { session, .. } if session.receives() => texts.socketcand(frame, utc_ns),
                Talk::Slcan { session, .. } if session.receives() => {
                    texts.slcan(frame, session.timestamps().then_some(t_ns / 1_000_000))
                }
                Talk::Cannelloni { greeted: true, .. } => texts.cannelloni(frame),
                _ => continue,
            };
            if text.is_empty() {
                // Its protocol has no form for this frame.
                continue;
            }
            if client.out.len() + text.len() > self.settings.client_buffer {
                client.counters.dropped += 1;
                self.counters.client_drops += 1;
            } else {
                client.out.extend(text);
                client.counters.received += 1;
                self.output_ready |= 1 << number;
            }
        }
    }

    /// Whether the queue of the rail was full and has room again since the last call.
    pub fn take_rail_room_again(&mut self) -> bool {
        std::mem::take(&mut self.rail_room_again)
    }

    /// Whether the queue of the feed was full and has room again since the last call.
    pub fn take_feed_room_again(&mut self) -> bool {
        std::mem::take(&mut self.feed_room_again)
    }

    /// Load in per mille of the last second.
    pub fn load_permille(&mut self, now_ns: u64) -> u32 {
        self.load.permille(now_ns)
    }

    /// Counters of the bus.
    pub fn counters(&self) -> BusCounters {
        self.counters
    }

    /// Counters of the rail's transmit queue.
    pub fn tx_counters(&self) -> TxCounters {
        self.rail.counters()
    }
}

#[cfg(test)]
#[path = "virtual_bus_tests.rs"]
mod tests;
