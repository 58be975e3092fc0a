//! The socketcand protocol (TCP, text in angle brackets), server side.
//!
//! [`Decoder`] turns bytes into [`Command`]s, [`Session`] answers them and says which frames to transmit,
//! [`encode`] writes a received frame. Source: socketcand `doc/protocol.md`; behaviour of python-can 4.6.1,
//! measured: its handshake compares one whole `recv` with `< hi >` or `< ok >`, so each of these must reach it
//! as a TCP segment of its own, and no frame may follow `< ok >` in the same segment.
//!
//! The protocol has no CAN FD: FD frames go out as data frames with up to 64 bytes, flags lost.
//! Broadcast-manager jobs, control mode and ISO-TP are answered with an error.

use super::frame::{EFF_MASK, FD_LENGTHS, Frame, SFF_MASK};
use super::hex::{self, Writer};

/// Greeting, sent when a client connects.
pub const HI: &[u8] = b"< hi >";
/// Positive answer.
pub const OK: &[u8] = b"< ok >";
/// Echo answer.
pub const ECHO: &[u8] = b"< echo >";

/// Longest command taken between `<` and `>`: `send`, 8 digits, length and 64 bytes of three characters, with
/// room for blanks. Longer ones are answered with an error and skipped.
pub const MAX_COMMAND: usize = 256;

/// Longest text [`encode`] writes.
pub const MAX_TEXT: usize = 192;

/// One command of a client.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Command {
    /// `< open BUS >`; the name is cut at 16 bytes (the protocol's limit), longer ones are [`Command::Nonsense`].
    Open(BusName),
    /// `< rawmode >`: every frame from now on.
    RawMode,
    /// `< bcmmode >`: no frames from now on.
    BcmMode,
    /// `< echo >`.
    Echo,
    /// `< send ID LEN B.. >` or `< sendrtr ID LEN >`.
    Send(Frame),
    /// A command of the protocol that this server does not offer.
    Unsupported,
    /// Anything else; the text says why.
    Nonsense(&'static [u8]),
}

/// Name of a bus as a client wrote it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BusName {
    bytes: [u8; 16],
    len: u8,
}

impl BusName {
    /// The name's bytes.
    pub fn as_bytes(&self) -> &[u8] {
        &self.bytes[..self.len as usize]
    }

    fn new(text: &[u8]) -> Option<Self> {
        let mut bytes = [0; 16];
        bytes.get_mut(..text.len())?.copy_from_slice(text);
        Some(Self { bytes, len: text.len() as u8 })
    }
}

const UNKNOWN: &[u8] = b"< error unknown command >";
const UNSUPPORTED: &[u8] =
    b"< error not supported: this server offers open, rawmode, bcmmode, send, sendrtr, echo >";
const OVERLONG: &[u8] = b"< error command longer than 256 characters >";
const OUTSIDE: &[u8] = b"< error text outside of angle brackets >";
const BAD_SEND: &[u8] = b"< error send: expected ID LEN and LEN bytes in hex >";
const BAD_RTR: &[u8] = b"< error sendrtr: expected ID and a length of 0-8 >";
const BAD_OPEN: &[u8] = b"< error open: expected one bus name of at most 16 characters >";
const NOT_OPEN: &[u8] = b"< error open a bus first >";
const ALREADY_OPEN: &[u8] = b"< error a bus is open already >";
const NO_SUCH_BUS: &[u8] = b"< error no such bus on this server >";

/// Splits a byte stream into commands. Holds at most one command.
#[derive(Debug, Clone)]
pub struct Decoder {
    text: [u8; MAX_COMMAND],
    len: usize,
    state: State,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum State {
    Outside,
    /// Garbage between commands, reported once.
    Garbage,
    Inside,
    Overlong,
}

impl Default for Decoder {
    fn default() -> Self {
        Self { text: [0; MAX_COMMAND], len: 0, state: State::Outside }
    }
}

impl Decoder {
    /// Takes bytes from `input` until one command is complete; `None` when all bytes are used up.
    /// Call again with the rest.
    pub fn next(&mut self, input: &mut &[u8]) -> Option<Command> {
        while let Some((&byte, rest)) = input.split_first() {
            *input = rest;
            match (self.state, byte) {
                // A new `<` always starts a new command, so a client recovers from half a command.
                (_, b'<') => {
                    self.state = State::Inside;
                    self.len = 0;
                }
                (State::Inside, b'>') => {
                    self.state = State::Outside;
                    return Some(parse(&self.text[..self.len]));
                }
                (State::Overlong, b'>') => {
                    self.state = State::Outside;
                    return Some(Command::Nonsense(OVERLONG));
                }
                (State::Inside, _) if self.len < MAX_COMMAND => {
                    self.text[self.len] = byte;
                    self.len += 1;
                }
                (State::Inside, _) => self.state = State::Overlong,
                (State::Outside, c) if !c.is_ascii_whitespace() => {
                    self.state = State::Garbage;
                    return Some(Command::Nonsense(OUTSIDE));
                }
                _ => {}
            }
        }
        None
    }
}

fn parse(text: &[u8]) -> Command {
    let mut words = text.split(|c| c.is_ascii_whitespace()).filter(|w| !w.is_empty());
    match words.next() {
        Some(b"send") => send(&mut words).map_or(Command::Nonsense(BAD_SEND), Command::Send),
        Some(b"sendrtr") => remote(&mut words).map_or(Command::Nonsense(BAD_RTR), Command::Send),
        Some(b"open") => match (words.next().and_then(BusName::new), words.next()) {
            (Some(name), None) => Command::Open(name),
            _ => Command::Nonsense(BAD_OPEN),
        },
        Some(b"rawmode") => Command::RawMode,
        Some(b"bcmmode") => Command::BcmMode,
        Some(b"echo") => Command::Echo,
        Some(
            b"add" | b"update" | b"delete" | b"filter" | b"muxfilter" | b"subscribe" | b"unsubscribe"
            | b"controlmode" | b"statistics" | b"isotpmode" | b"isotpconf" | b"sendpdu",
        ) => Command::Unsupported,
        _ => Command::Nonsense(UNKNOWN),
    }
}

/// Identifier in hex: up to 3 digits standard, 4-8 extended (python-can pads to 3 and 8).
pub(super) fn identifier(word: &[u8]) -> Option<(u32, bool)> {
    let id = hex::number(word)?;
    let extended = word.len() > 3;
    (id <= if extended { EFF_MASK } else { SFF_MASK }).then_some((id, extended))
}

fn send<'a>(words: &mut impl Iterator<Item = &'a [u8]>) -> Option<Frame> {
    let (id, extended) = identifier(words.next()?)?;
    let len = hex::number(words.next()?)? as usize;
    let mut data = [0u8; 64];
    for byte in data.get_mut(..len)? {
        *byte = u8::try_from(hex::number(words.next()?)?).ok()?;
    }
    if words.next().is_some() {
        return None;
    }
    if len <= 8 {
        Frame::data(id, extended, &data[..len]).ok()
    } else if FD_LENGTHS.contains(&(len as u8)) {
        Frame::fd(id, extended, 0, &data[..len]).ok()
    } else {
        None
    }
}

fn remote<'a>(words: &mut impl Iterator<Item = &'a [u8]>) -> Option<Frame> {
    let (id, extended) = identifier(words.next()?)?;
    let len = u8::try_from(hex::number(words.next()?)?).ok()?;
    if words.next().is_some() {
        return None;
    }
    Frame::remote(id, extended, len).ok()
}

/// What the server does with a command.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Action {
    /// Send this answer, as a TCP segment of its own.
    Reply(&'static [u8]),
    /// Send this answer and end the connection (protocol.md: after a refused `open`).
    ReplyAndClose(&'static [u8]),
    /// Put the frame on the bus; there is no answer.
    Transmit(Frame),
    /// A frame that cannot be sent, in raw mode: there is no answer, as with the original. python-can takes one for a
    /// frame and never reads anything again.
    Refused,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Mode {
    NoBus,
    Bcm,
    Raw,
}

/// State of one socketcand client.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Session {
    mode: Mode,
}

impl Default for Session {
    fn default() -> Self {
        Self { mode: Mode::NoBus }
    }
}

impl Session {
    /// True while frames of the bus go to this client.
    pub fn receives(&self) -> bool {
        self.mode == Mode::Raw
    }

    /// Answers one command; `bus` is the one bus this server has.
    pub fn handle(&mut self, command: &Command, bus: &str) -> Action {
        match *command {
            Command::Nonsense(BAD_SEND | BAD_RTR) if self.mode == Mode::Raw => Action::Refused,
            Command::Nonsense(why) => Action::Reply(why),
            Command::Echo => Action::Reply(ECHO),
            Command::Open(name) if self.mode == Mode::NoBus => {
                if name.as_bytes() == bus.as_bytes() {
                    self.mode = Mode::Bcm;
                    Action::Reply(OK)
                } else {
                    Action::ReplyAndClose(NO_SUCH_BUS)
                }
            }
            Command::Open(_) => Action::Reply(ALREADY_OPEN),
            _ if self.mode == Mode::NoBus => Action::Reply(NOT_OPEN),
            Command::RawMode => {
                self.mode = Mode::Raw;
                Action::Reply(OK)
            }
            Command::BcmMode => {
                self.mode = Mode::Bcm;
                Action::Reply(OK)
            }
            Command::Send(frame) => Action::Transmit(frame),
            Command::Unsupported => Action::Reply(UNSUPPORTED),
        }
    }
}

/// Writes `frame` as a socketcand client expects it and returns the length; `utc_ns` is its stamp.
///
/// `< frame ID sec.usec HEX >` with 3 digits for a standard and 8 for an extended identifier, no blanks in the
/// data (length 0 leaves two blanks before `>`), `< rtr ID sec.usec LEN >`, `< error ID sec.usec >`.
pub fn encode(frame: &Frame, utc_ns: u64, out: &mut [u8; MAX_TEXT]) -> usize {
    let mut w = Writer::new(out);
    w.text(match (frame.is_error(), frame.is_remote()) {
        (true, _) => b"< error ",
        (false, true) => b"< rtr ",
        (false, false) => b"< frame ",
    });
    if frame.is_error() {
        w.hex(frame.can_id & (super::frame::ERR_FLAG | EFF_MASK), 8);
    } else {
        w.hex(frame.id(), if frame.is_extended() { 8 } else { 3 });
    }
    w.byte(b' ');
    w.seconds(utc_ns, 1);
    w.byte(b' ');
    if !frame.is_error() {
        if frame.is_remote() {
            w.decimal(u64::from(frame.len), 1);
        } else {
            w.hex_bytes(frame.payload());
        }
        w.byte(b' ');
    }
    w.byte(b'>');
    w.len()
}

#[cfg(test)]
mod tests {
    use super::super::frame::{ERR_FLAG, tests::any_classic};
    use super::*;
    use proptest::prelude::*;

    fn all(text: &[u8]) -> Vec<Command> {
        let mut decoder = Decoder::default();
        let mut rest = text;
        let mut commands = Vec::new();
        while let Some(command) = decoder.next(&mut rest) {
            commands.push(command);
        }
        commands
    }

    fn text(frame: &Frame, utc_ns: u64) -> String {
        let mut out = [0; MAX_TEXT];
        let n = encode(frame, utc_ns, &mut out);
        String::from_utf8(out[..n].to_vec()).unwrap()
    }

    #[test]
    fn commands() {
        let open = |name: &str| Command::Open(BusName::new(name.as_bytes()).unwrap());
        let table: &[(&str, Command)] = &[
            ("< open can0 >", open("can0")),
            ("<open can0>", open("can0")),
            ("< rawmode >", Command::RawMode),
            ("< bcmmode >", Command::BcmMode),
            ("< echo >", Command::Echo),
            ("< send 123 0  >", Command::Send(Frame::data(0x123, false, &[]).unwrap())),
            ("< send 123 3 1 a ff >", Command::Send(Frame::data(0x123, false, &[1, 0xA, 0xFF]).unwrap())),
            ("< send 1AAAAAAA 2 1 F1 >", Command::Send(Frame::data(0x1AAA_AAAA, true, &[1, 0xF1]).unwrap())),
            ("< send 00000123 0 >", Command::Send(Frame::data(0x123, true, &[]).unwrap())),
            ("< sendrtr 123 4 >", Command::Send(Frame::remote(0x123, false, 4).unwrap())),
            (
                "< send 123 C 0 1 2 3 4 5 6 7 8 9 a b >",
                Command::Send(Frame::fd(0x123, false, 0, &[0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11]).unwrap()),
            ),
            ("< subscribe 0 0 123 >", Command::Unsupported),
            ("< isotpmode >", Command::Unsupported),
        ];
        for (line, expected) in table {
            assert_eq!(all(line.as_bytes()), vec![*expected], "{line}");
        }
        // Commands follow one another with or without white space, and half a command is given up.
        assert_eq!(all(b"< open can0 >< rawmode >\r\n < echo >").len(), 3);
        assert_eq!(all(b"< send 12< echo >"), vec![Command::Echo]);
    }

    #[test]
    fn nonsense_is_named() {
        let overlong = format!("< send {} >", "1 ".repeat(400));
        let table: &[(&str, &[u8])] = &[
            ("<>", UNKNOWN),
            ("< fly >", UNKNOWN),
            ("< send >", BAD_SEND),
            ("< send 123 >", BAD_SEND),
            // python-can 4.6.1 writes a remote frame like this: no bytes for its length.
            ("< send 123 4  >", BAD_SEND),
            ("< send 123 1 100 >", BAD_SEND),
            ("< send 123 1 1 2 >", BAD_SEND),
            ("< send 123 9 1 2 3 4 5 6 7 8 9 >", BAD_SEND),
            ("< send 800 0 >", BAD_SEND),
            ("< send 20000000 0 >", BAD_SEND),
            ("< sendrtr 123 9 >", BAD_RTR),
            ("< open >", BAD_OPEN),
            ("< open a b >", BAD_OPEN),
            ("< open a2345678901234567 >", BAD_OPEN),
            ("hello", OUTSIDE),
            (&overlong, OVERLONG),
        ];
        for (line, expected) in table {
            assert_eq!(all(line.as_bytes()), vec![Command::Nonsense(expected)], "{line}");
        }
        assert_eq!(all(b"GET / HTTP/1.1\r\n\r\n< echo >"), vec![Command::Nonsense(OUTSIDE), Command::Echo]);
    }

    #[test]
    fn frames_out() {
        let stamp = 1_543_509_533_000_838_999;
        let data = Frame::data(0x123, false, &[0xDE, 0xAD]).unwrap();
        assert_eq!(text(&data, stamp), "< frame 123 1543509533.000838 DEAD >");
        let empty = Frame::data(0x1F, true, &[]).unwrap();
        assert_eq!(text(&empty, 0), "< frame 0000001F 0.000000  >");
        let remote = Frame::remote(0x7FF, false, 8).unwrap();
        assert_eq!(text(&remote, stamp), "< rtr 7FF 1543509533.000838 8 >");
        let error = Frame { can_id: ERR_FLAG | 0x80, len: 8, ..Frame::default() };
        assert_eq!(text(&error, stamp), "< error 20000080 1543509533.000838 >");
        let long = Frame::fd(0x1FFF_FFFF, true, 0, &[0xFF; 64]).unwrap();
        assert!(text(&long, u64::MAX).ends_with(" >"));
    }

    #[test]
    fn session_of_python_can() {
        let mut session = Session::default();
        let mut answers = Vec::new();
        for command in
            all(b"< rawmode >< send 1 0 >< open can0 >< open can0 >< rawmode >< send 1 0 >< add >< bcmmode >")
        {
            answers.push((session.handle(&command, "can0"), session.receives()));
        }
        let frame = Frame::data(1, false, &[]).unwrap();
        assert_eq!(
            answers,
            vec![
                (Action::Reply(NOT_OPEN), false),
                (Action::Reply(NOT_OPEN), false),
                (Action::Reply(OK), false),
                (Action::Reply(ALREADY_OPEN), false),
                (Action::Reply(OK), true),
                (Action::Transmit(frame), true),
                (Action::Reply(UNSUPPORTED), true),
                (Action::Reply(OK), false),
            ]
        );
        let mut other = Session::default();
        assert_eq!(other.handle(&all(b"< open vcan7 >")[0], "can0"), Action::ReplyAndClose(NO_SUCH_BUS));
    }

    proptest! {
        #[test]
        fn what_python_can_sends_arrives(frame in any_classic()) {
            let id = if frame.is_extended() { format!("{:08X}", frame.id()) } else { format!("{:03X}", frame.id()) };
            let bytes: Vec<String> = frame.payload().iter().map(|b| format!("{b:x}")).collect();
            let line = format!("< send {id} {:X} {} >", frame.len, bytes.join(" "));
            prop_assert_eq!(all(line.as_bytes()), vec![Command::Send(frame)]);
        }

        #[test]
        fn never_panics_and_cuts_the_same_everywhere(
            bytes in prop::collection::vec(prop_oneof![any::<u8>(), prop::sample::select(b"<> sendrtr 12f".to_vec())], 0..600),
            cut in 0usize..600,
        ) {
            let whole = all(&bytes);
            let mut parts = Vec::new();
            let mut decoder = Decoder::default();
            let (left, right) = bytes.split_at(cut.min(bytes.len()));
            for mut part in [left, right] {
                while let Some(command) = decoder.next(&mut part) {
                    parts.push(command);
                }
            }
            prop_assert_eq!(whole, parts);
        }
    }
}
