//! Clients of the bus: foreign tools, each in its own text protocol.

use super::*;

/// How long frames are held back after the `< ok >` that answers `< rawmode >`, unless the client speaks first:
/// python-can compares its whole receive buffer with `< ok >`, so a frame behind it would break the handshake.
pub const HANDSHAKE_HOLD_NS: u64 = 100_000_000;
/// Answers to a client are dropped when its output buffer has less than this left, so frames go first.
const REPLY_RESERVE: usize = 256;

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
pub(super) enum Talk {
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
pub(super) struct Client {
    pub(super) talk: Talk,
    /// Frames waiting for a paced bus, with their arrival.
    pub(super) waiting: VecDeque<(Frame, u64)>,
    pub(super) out: VecDeque<u8>,
    /// Bytes of `out` that may be written before the hold ends.
    pub(super) hold: Option<(usize, u64)>,
    /// Gone, but not all it sent is used yet: nothing is written for it any more.
    pub(super) muted: bool,
    pub(super) counters: ClientCounters,
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

impl VirtualBus {
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
            if client.waiting.len() >= CLIENT_QUEUE && !self.wire.as_ref().is_some_and(WireSide::is_held) {
                stopped = Some(Stopped::QueueFull);
                break;
            }
            let (step, frame) = client.step(&mut rest, &self.settings, now_ns);
            if let Some(frame) = frame {
                client.counters.sent += 1;
                let waits = self.settings.pace || self.wire.is_some() || !client.waiting.is_empty();
                if waits || !self.allow(now_ns) {
                    if let Some(client) = &mut self.clients[number] {
                        if client.waiting.len() >= CLIENT_QUEUE
                            && self.wire.as_mut().is_some_and(WireSide::sheds)
                        {
                            client.waiting.pop_front();
                        }
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
