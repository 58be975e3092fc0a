//! The virtual bus: a CAN bus inside the driver process.
//!
//! Sans-I/O. Nodes of the bus are the rail (all processes of the stack together, through a [`TxQueue`]), the
//! feed (a recorded log) and the clients (foreign tools on TCP, in their own text protocol). Every frame that a
//! node gives is put into one true order, stamped, told to the [`Tap`] (which publishes it on the rail) and
//! written to every other client. Without pace a frame is on the bus the moment it is given, as long as the bus
//! carries no more than `max_rate` frames a second. With pace the bus is busy as long as the frame takes on a wire.
//! When frames have to wait, the node whose first frame wins arbitration goes next.
//!
//! What a client sends is never dropped: when its queue is full the caller stops reading its socket. What a
//! client does not read is: frames that do not fit its output buffer are dropped for it alone, and counted.
//! A slow client never delays the bus. Nothing allocates between a frame in and a frame out.

use std::collections::VecDeque;

use crate::protocol::busload::{LoadMeter, Stuffing, bits};
use crate::protocol::{Frame, cannelloni, slcan, socketcand};
use crate::txqueue::{Pushed, TxCounters, TxQueue};

mod texts;
mod wire_side;
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
/// How long frames are held back after the `< ok >` that answers `< rawmode >`, unless the client speaks first:
/// python-can compares its whole receive buffer with `< ok >`, so a frame behind it would break the handshake.
pub const HANDSHAKE_HOLD_NS: u64 = 100_000_000;
/// Answers to a client are dropped when its output buffer has less than this left, so frames go first.
const REPLY_RESERVE: usize = 256;

/// Where a frame came from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Origin {
    /// A process of the stack.
    Rail,
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

/// What a client speaks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Dialect {
    /// See [`crate::protocol::socketcand`].
    Socketcand,
    /// See [`crate::protocol::slcan`].
    Slcan,
    /// See [`crate::protocol::cannelloni`].
    Cannelloni,
}

impl Dialect {
    /// As keys and messages name it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Socketcand => "socketcand",
            Self::Slcan => "slcan",
            Self::Cannelloni => "cannelloni",
        }
    }
}

#[derive(Debug)]
enum Talk {
    Socketcand { decoder: Box<socketcand::Decoder>, session: socketcand::Session },
    Slcan { decoder: Box<slcan::Decoder>, session: slcan::Session },
    Cannelloni { decoder: Box<cannelloni::Decoder>, greeted: bool },
}

/// Counters of one client.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, serde::Serialize)]
pub struct ClientCounters {
    /// Frames it put on the bus.
    pub sent: u64,
    /// Frames written to it.
    pub received: u64,
    /// Frames dropped because it did not read.
    pub dropped: u64,
    /// Commands answered with an error or BEL.
    pub refused: u64,
}

#[derive(Debug)]
struct Client {
    talk: Talk,
    /// Frames waiting for a paced bus, with their arrival.
    waiting: VecDeque<(Frame, u64)>,
    out: VecDeque<u8>,
    /// Bytes of `out` that may be written before the hold ends.
    hold: Option<(usize, u64)>,
    /// Gone, but not all it sent is used yet: nothing is written for it any more.
    muted: bool,
    counters: ClientCounters,
}

/// What [`VirtualBus::take`] did with a client's bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Taken {
    /// Bytes used; give the rest again later.
    pub used: usize,
    /// Why not all were used.
    pub stopped: Option<Stopped>,
}

/// Why a client's bytes were not all used.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Stopped {
    /// Its frames fill its queue: go on when the bus has taken some.
    QueueFull,
    /// An answer must leave as a segment of its own: go on when all output is written.
    WriteFirst,
    /// Write what is there, then close the connection.
    Close,
    /// Enough for one turn: go on after others had theirs.
    Turn,
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
            settings,
        }
    }

    /// Difference of UTC to CLOCK_MONOTONIC, for the stamps that socketcand clients see.
    pub fn set_utc_offset(&mut self, utc_offset_ns: i64) {
        self.utc_offset_ns = utc_offset_ns;
    }

    /// A client came. `None`: [`MAX_CLIENTS`] are connected.
    pub fn connect(&mut self, dialect: Dialect) -> Option<usize> {
        let number = self.clients.iter().position(Option::is_none)?;
        let limit = self.settings.client_buffer;
        let mut client = Client {
            talk: match dialect {
                Dialect::Socketcand => {
                    Talk::Socketcand { decoder: Box::default(), session: socketcand::Session::default() }
                }
                Dialect::Slcan => Talk::Slcan { decoder: Box::default(), session: slcan::Session::default() },
                Dialect::Cannelloni => Talk::Cannelloni { decoder: Box::default(), greeted: false },
            },
            waiting: VecDeque::with_capacity(CLIENT_QUEUE),
            out: VecDeque::with_capacity(limit),
            hold: None,
            muted: false,
            counters: ClientCounters::default(),
        };
        let first: &[u8] = match dialect {
            Dialect::Socketcand => socketcand::HI,
            Dialect::Cannelloni => cannelloni::GREETING,
            Dialect::Slcan => &[],
        };
        if !first.is_empty() {
            client.out.extend(first);
            self.output_ready |= 1 << number;
        }
        self.clients[number] = Some(client);
        self.connected += 1;
        Some(number)
    }

    /// A client reads nothing any more; what it sent may still come.
    pub fn mute(&mut self, number: usize) {
        if let Some(client) = self.clients.get_mut(number).and_then(Option::as_mut) {
            client.muted = true;
            client.out.clear();
            client.hold = None;
        }
    }

    /// A client is gone; its waiting frames go with it.
    pub fn disconnect(&mut self, number: usize) -> ClientCounters {
        self.wire_disown(number);
        let gone = self.clients.get_mut(number).and_then(Option::take);
        self.connected -= usize::from(gone.is_some());
        gone.map(|client| client.counters).unwrap_or_default()
    }

    /// Uses bytes that a client sent: answers go to its output, frames on the bus.
    pub fn take(&mut self, number: usize, bytes: &[u8], now_ns: u64, tap: &mut impl Tap) -> Taken {
        let mut rest = bytes;
        let mut stopped = None;
        for _ in 0..TURN_FRAMES {
            let Some(client) = self.clients.get_mut(number).and_then(Option::as_mut) else {
                return Taken { used: bytes.len(), stopped: Some(Stopped::Close) };
            };
            if client.waiting.len() >= CLIENT_QUEUE {
                stopped = Some(Stopped::QueueFull);
                break;
            }
            let (step, frame) = client.step(&mut rest, &self.settings, now_ns);
            if let Some(frame) = frame {
                client.counters.sent += 1;
                let waits = self.settings.pace || self.wire.is_some() || !client.waiting.is_empty();
                if waits || !self.allow(now_ns) {
                    if let Some(client) = &mut self.clients[number] {
                        client.waiting.push_back((frame, now_ns));
                    }
                } else {
                    self.on_bus(&frame, Origin::Client(number), now_ns, tap);
                }
            }
            match step {
                Step::More => {}
                Step::Empty => break,
                Step::Stop(why) => {
                    stopped = Some(why);
                    break;
                }
            }
        }
        if let Some(client) = self.clients[number].as_ref()
            && !client.out.is_empty()
        {
            self.output_ready |= 1 << number;
        }
        if stopped.is_none() && !rest.is_empty() {
            stopped = Some(Stopped::Turn);
        }
        Taken { used: bytes.len() - rest.len(), stopped }
    }

    /// Queues a frame of a process of the stack.
    pub fn push_rail(&mut self, frame: &Frame, newest: bool, now_ns: u64) -> Pushed {
        self.rail.push(frame, newest, now_ns)
    }

    /// Frames of the rail that can still be queued.
    pub fn rail_room(&self) -> usize {
        self.rail.room()
    }

    /// Frames of the rail that wait.
    pub fn rail_waiting(&self) -> usize {
        self.rail.len()
    }

    /// Queues a frame of the feed; false: full, give it again later.
    pub fn push_feed(&mut self, frame: &Frame, now_ns: u64) -> bool {
        if self.feed.len() >= CLIENT_QUEUE {
            return false;
        }
        self.feed.push_back((*frame, now_ns));
        true
    }

    /// Puts on the bus what can be there by now. Returns when to call again (CLOCK_MONOTONIC ns; `now_ns` itself
    /// when this turn's share is used up), or `None` when nothing waits.
    pub fn run(&mut self, now_ns: u64, tap: &mut impl Tap) -> Option<u64> {
        if self.wire.is_some() {
            // The wire takes what waits when it can.
            return None;
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
        let rail = self.rail.peek().map(|w| (w.frame.arbitration_key(), Origin::Rail));
        let feed = self.feed.front().map(|(f, _)| (f.arbitration_key(), Origin::Feed));
        let clients = self.clients.iter().enumerate().filter_map(|(number, client)| {
            let (frame, _) = client.as_ref()?.waiting.front()?;
            Some((frame.arbitration_key(), Origin::Client(number)))
        });
        let (_, origin) = rail.into_iter().chain(feed).chain(clients).min_by_key(|(key, _)| *key)?;
        let (frame, arrived_ns) = match origin {
            Origin::Rail => {
                self.rail_room_again |= self.rail.room() == 0;
                self.rail.pop().map(|w| (w.frame, w.fresh_ns))?
            }
            Origin::Feed => self.feed.pop_front()?,
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
            Origin::Rail => self.counters.from_rail += 1,
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

    /// Bytes to write to a client now, in one piece; empty when there are none.
    pub fn output(&mut self, number: usize, now_ns: u64) -> &[u8] {
        let Some(client) = self.clients.get_mut(number).and_then(Option::as_mut) else { return &[] };
        let mut limit = usize::MAX;
        match client.hold {
            Some((_, until_ns)) if until_ns <= now_ns => client.hold = None,
            Some((bytes, _)) => limit = bytes,
            None => {}
        }
        let (first, _) = client.out.as_slices();
        &first[..first.len().min(limit)]
    }

    /// So many bytes of [`Self::output`] have been written.
    pub fn written(&mut self, number: usize, count: usize) {
        if let Some(client) = self.clients.get_mut(number).and_then(Option::as_mut) {
            client.out.drain(..count.min(client.out.len()));
            if let Some((bytes, _)) = &mut client.hold {
                *bytes = bytes.saturating_sub(count);
            }
        }
    }

    /// When the hold on a client's output ends, if there is one.
    pub fn held_until(&self, number: usize) -> Option<u64> {
        self.clients.get(number)?.as_ref()?.hold.map(|(_, until_ns)| until_ns)
    }

    /// Clients with new output since the last call, one bit each.
    pub fn take_output_ready(&mut self) -> u32 {
        std::mem::take(&mut self.output_ready)
    }

    /// Clients whose queue has room again since the last call, one bit each.
    pub fn take_room_again(&mut self) -> u32 {
        std::mem::take(&mut self.room_again)
    }

    /// Whether the queue of the rail was full and has room again since the last call.
    pub fn take_rail_room_again(&mut self) -> bool {
        std::mem::take(&mut self.rail_room_again)
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

    /// Counters of one client.
    pub fn client_counters(&self, number: usize) -> Option<ClientCounters> {
        self.clients.get(number)?.as_ref().map(|client| client.counters)
    }
}

enum Step {
    /// A command was used.
    More,
    /// All bytes are used.
    Empty,
    Stop(Stopped),
}

impl Client {
    /// Uses one command from `rest`.
    fn step(&mut self, rest: &mut &[u8], settings: &Settings, now_ns: u64) -> (Step, Option<Frame>) {
        match &mut self.talk {
            Talk::Socketcand { decoder, session } => {
                let Some(command) = decoder.next(rest) else { return (Step::Empty, None) };
                // It speaks, so it has read the answer to its last command.
                self.hold = None;
                match session.handle(&command, &settings.name) {
                    socketcand::Action::Transmit(frame) => (Step::More, Some(frame)),
                    socketcand::Action::Refused => {
                        self.counters.refused += 1;
                        (Step::More, None)
                    }
                    socketcand::Action::Reply(text) => {
                        self.counters.refused += u64::from(text.starts_with(b"< error"));
                        if self.reply(text, settings) && command == socketcand::Command::RawMode {
                            self.hold = Some((self.out.len(), now_ns + HANDSHAKE_HOLD_NS));
                        }
                        (Step::Stop(Stopped::WriteFirst), None)
                    }
                    socketcand::Action::ReplyAndClose(text) => {
                        self.counters.refused += 1;
                        self.reply(text, settings);
                        (Step::Stop(Stopped::Close), None)
                    }
                }
            }
            Talk::Slcan { decoder, session } => {
                let Some(command) = decoder.next(rest) else { return (Step::Empty, None) };
                let (text, frame) = match session.handle(&command) {
                    slcan::Action::Reply(text) => (text, None),
                    slcan::Action::Transmit { frame, ack } => (ack, Some(frame)),
                };
                self.counters.refused += u64::from(text == slcan::BEL);
                self.reply(text, settings);
                (Step::More, frame)
            }
            Talk::Cannelloni { decoder, greeted } => match decoder.next(rest) {
                None => (Step::Empty, None),
                Some(cannelloni::Item::Greeted) => {
                    *greeted = true;
                    (Step::More, None)
                }
                // Nobody puts an error on a bus on purpose: the far side reports its own, which are none of ours.
                Some(cannelloni::Item::Frame(frame)) if frame.is_error() => (Step::More, None),
                Some(cannelloni::Item::Frame(frame)) => (Step::More, Some(frame)),
                Some(cannelloni::Item::Lost(_)) => {
                    self.counters.refused += 1;
                    (Step::Stop(Stopped::Close), None)
                }
            },
        }
    }

    /// False: dropped, because the client reads nothing. It cannot wait for what it does not read.
    fn reply(&mut self, text: &[u8], settings: &Settings) -> bool {
        let fits = !self.muted && self.out.len() + text.len() + REPLY_RESERVE <= settings.client_buffer;
        if fits {
            self.out.extend(text);
        }
        fits
    }
}

#[cfg(test)]
#[path = "virtual_bus_tests.rs"]
mod tests;
