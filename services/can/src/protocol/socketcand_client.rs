//! The socketcand protocol, client side: a bus of another machine as ours.
//!
//! Source: socketcand `doc/protocol.md`. The protocol confirms no frame, so one counts as sent when it is written, and
//! it knows neither CAN FD nor the remote side's clock: frames are stamped when they arrive.

use super::frame::{ERR_FLAG, FD_LENGTHS, Frame};
use super::hex::{self, Writer};
use super::peer::{Heard, Peer};
use super::socketcand::{MAX_COMMAND, identifier};

/// How long an answer is waited for.
const ANSWER_NS: u64 = 5_000_000_000;
/// Longest command written.
const MAX_SEND: usize = 64;
/// Frames given before the socket has taken the first.
const FLIGHT: usize = 64;

/// One thing the server said.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Answer {
    /// `< hi >`
    Hi,
    /// `< ok >`
    Ok,
    /// `< echo >`
    Echo,
    /// `< frame .. >`, `< rtr .. >`, `< error ID .. >`
    Frame(Frame),
    /// `< error TEXT >`
    Error,
    /// Anything else.
    Garbage,
}

/// Splits what the server says. Holds at most one answer.
#[derive(Debug, Clone)]
pub struct Decoder {
    text: [u8; MAX_COMMAND],
    len: usize,
    inside: bool,
}

impl Default for Decoder {
    fn default() -> Self {
        Self { text: [0; MAX_COMMAND], len: 0, inside: false }
    }
}

impl Decoder {
    /// Takes bytes from `input` until one answer is complete; `None` when all are used up.
    pub fn next(&mut self, input: &mut &[u8]) -> Option<Answer> {
        while let Some((&byte, rest)) = input.split_first() {
            *input = rest;
            match (self.inside, byte) {
                (_, b'<') => {
                    self.inside = true;
                    self.len = 0;
                }
                (true, b'>') => {
                    self.inside = false;
                    return Some(parse(&self.text[..self.len]));
                }
                (true, _) if self.len < MAX_COMMAND => {
                    self.text[self.len] = byte;
                    self.len += 1;
                }
                (true, _) => {
                    self.inside = false;
                    return Some(Answer::Garbage);
                }
                (false, _) => {
                    // Said once a piece, not once a byte.
                    let end = input.iter().position(|&c| c == b'<').unwrap_or(input.len());
                    let blank =
                        byte.is_ascii_whitespace() && input[..end].iter().all(u8::is_ascii_whitespace);
                    *input = &input[end..];
                    if !blank {
                        return Some(Answer::Garbage);
                    }
                }
            }
        }
        None
    }

    fn text(&self) -> String {
        String::from_utf8_lossy(&self.text[..self.len]).trim().to_owned()
    }
}

fn parse(text: &[u8]) -> Answer {
    let mut words = text.split(|c| c.is_ascii_whitespace()).filter(|w| !w.is_empty());
    match words.next() {
        Some(b"hi") => Answer::Hi,
        Some(b"ok") => Answer::Ok,
        Some(b"echo") => Answer::Echo,
        Some(b"frame") => data(&mut words).map_or(Answer::Garbage, Answer::Frame),
        Some(b"rtr") => remote(&mut words).map_or(Answer::Garbage, Answer::Frame),
        Some(b"error") => error(&mut words).map_or(Answer::Error, Answer::Frame),
        _ => Answer::Garbage,
    }
}

fn data<'a>(words: &mut impl Iterator<Item = &'a [u8]>) -> Option<Frame> {
    let (id, extended) = identifier(words.next()?)?;
    words.next().filter(|stamp| is_stamp(stamp))?;
    let mut bytes = [0u8; 64];
    let mut len = 0;
    // Some servers write blanks between the bytes.
    for word in words {
        len += hex::bytes(word, &mut bytes[len..])?;
    }
    if len <= 8 {
        return Frame::data(id, extended, &bytes[..len]).ok();
    }
    FD_LENGTHS.contains(&(len as u8)).then(|| Frame::fd(id, extended, 0, &bytes[..len]).ok())?
}

fn remote<'a>(words: &mut impl Iterator<Item = &'a [u8]>) -> Option<Frame> {
    let (id, extended) = identifier(words.next()?)?;
    words.next().filter(|stamp| is_stamp(stamp))?;
    Frame::remote(id, extended, hex::number(words.next()?)?.min(255) as u8).ok()
}

/// An error frame: its class as eight digits, perhaps with the flag, and a stamp. The details do not travel.
fn error<'a>(words: &mut impl Iterator<Item = &'a [u8]>) -> Option<Frame> {
    let word = words.next().filter(|w| w.len() >= 3)?;
    let class = hex::number(word)?;
    words.next().filter(|stamp| is_stamp(stamp))?;
    Some(Frame { can_id: ERR_FLAG | (class & 0x1FFF_FFFF), len: 8, ..Frame::default() })
}

fn is_stamp(word: &[u8]) -> bool {
    let mut parts = word.split(|&c| c == b'.');
    let digits = |p: Option<&[u8]>| p.is_some_and(|p| !p.is_empty() && p.iter().all(u8::is_ascii_digit));
    digits(parts.next()) && digits(parts.next()) && parts.next().is_none()
}

/// Writes the command that sends a frame.
fn encode(frame: &Frame, out: &mut [u8; MAX_SEND]) -> usize {
    let mut w = Writer::new(out);
    w.text(if frame.is_remote() { b"< sendrtr " } else { b"< send " });
    w.hex(frame.id(), if frame.is_extended() { 8 } else { 3 });
    w.byte(b' ');
    w.decimal(u64::from(frame.len.min(8)), 1);
    for &byte in frame.payload().iter().take(8) {
        w.byte(b' ');
        w.hex(u32::from(byte), 2);
    }
    w.text(b" >");
    w.len()
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum State {
    Hi,
    Open,
    Raw,
    Up,
    Dead,
}

/// See the module.
#[derive(Debug)]
pub struct Client {
    bus: String,
    decoder: Decoder,
    state: State,
    until_ns: u64,
}

impl Client {
    /// A client that opens this bus of the server.
    pub fn new(bus: &str) -> Self {
        Self { bus: bus.to_owned(), decoder: Decoder::default(), state: State::Hi, until_ns: 0 }
    }

    fn fault(&mut self, why: String, heard: &mut dyn FnMut(Heard)) {
        self.state = State::Dead;
        heard(Heard::Fault(why));
    }
}

impl Peer for Client {
    fn connected(&mut self, now_ns: u64, _out: &mut Vec<u8>) {
        *self = Self::new(&self.bus);
        self.until_ns = now_ns + ANSWER_NS;
    }

    fn receive(&mut self, bytes: &[u8], now_ns: u64, out: &mut Vec<u8>, heard: &mut dyn FnMut(Heard)) {
        let mut rest = bytes;
        while let Some(answer) = self.decoder.next(&mut rest) {
            match (self.state, answer) {
                (State::Dead, _) => return,
                (State::Up, Answer::Frame(frame)) => heard(Heard::Frame(frame, now_ns)),
                (State::Hi, Answer::Hi) => {
                    out.extend(b"< open ");
                    out.extend(self.bus.as_bytes());
                    out.extend(b" >");
                    self.state = State::Open;
                    self.until_ns = now_ns + ANSWER_NS;
                }
                (State::Open, Answer::Ok) => {
                    out.extend(b"< rawmode >");
                    self.state = State::Raw;
                    self.until_ns = now_ns + ANSWER_NS;
                }
                (State::Raw, Answer::Ok) => {
                    self.state = State::Up;
                    heard(Heard::Up);
                }
                (State::Open, Answer::Error) => {
                    return self.fault(
                        format!(
                            "the server does not open bus '{}': it says '{}'",
                            self.bus,
                            self.decoder.text()
                        ),
                        heard,
                    );
                }
                (_, Answer::Error) => {
                    heard(Heard::Note(format!("the server says '{}'", self.decoder.text())));
                }
                (State::Hi, _) => {
                    return self
                        .fault("what answers is no socketcand: it does not greet with < hi >".into(), heard);
                }
                // Whatever else it says is not the answer that is waited for.
                _ => {}
            }
        }
    }

    fn tick(&mut self, now_ns: u64, _out: &mut Vec<u8>, heard: &mut dyn FnMut(Heard)) {
        if self.deadline_ns().is_some_and(|at_ns| at_ns <= now_ns) {
            let what = match self.state {
                State::Hi => "a greeting",
                State::Open => "the answer to open",
                _ => "the answer to rawmode",
            };
            self.fault(format!("the server did not give {what} within 5 s"), heard);
        }
    }

    fn deadline_ns(&self) -> Option<u64> {
        (!matches!(self.state, State::Up | State::Dead)).then_some(self.until_ns)
    }

    fn fits(&self, frame: &Frame) -> bool {
        !frame.is_fd()
    }

    fn send(&mut self, frame: &Frame, _now_ns: u64, out: &mut Vec<u8>, heard: &mut dyn FnMut(Heard)) {
        let mut text = [0; MAX_SEND];
        let n = encode(frame, &mut text);
        out.extend(&text[..n]);
        heard(Heard::Sent);
    }

    fn flight(&self) -> usize {
        FLIGHT
    }

    fn farewell(&self) -> &'static [u8] {
        &[]
    }
}

#[cfg(test)]
mod tests {
    use super::super::candump::parse as frame;
    use super::super::frame::tests::any_classic;
    use super::super::socketcand;
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn only_the_answer_that_is_waited_for_ends_the_wait() {
        let (mut client, mut out, mut heard) = (Client::new("can0"), Vec::new(), Vec::new());
        client.connected(0, &mut out);
        client.receive(b"< hi >", 1, &mut out, &mut |h| heard.push(h));
        for second in 1..10 {
            client.receive(b"< frame 123 1.0 11 >", second * 1_000_000_000, &mut out, &mut |h| heard.push(h));
            client.tick(second * 1_000_000_000, &mut out, &mut |h| heard.push(h));
        }
        assert_eq!(heard, [Heard::Fault("the server did not give the answer to open within 5 s".into())]);
    }

    fn all(text: &[u8]) -> Vec<Answer> {
        let (mut decoder, mut rest, mut answers) = (Decoder::default(), text, Vec::new());
        while let Some(answer) = decoder.next(&mut rest) {
            answers.push(answer);
        }
        answers
    }

    fn sent(frame: &Frame) -> String {
        let mut out = Vec::new();
        Client::new("can0").send(frame, 0, &mut out, &mut |_| {});
        String::from_utf8(out).unwrap()
    }

    #[test]
    fn answers() {
        let table: &[(&str, Answer)] = &[
            ("< hi >", Answer::Hi),
            ("< ok >", Answer::Ok),
            ("< echo >", Answer::Echo),
            ("< frame 123 1543509533.000838 DEAD >", Answer::Frame(frame("123#DEAD").unwrap())),
            ("< frame 123 23.424242 11 22 33 >", Answer::Frame(frame("123#112233").unwrap())),
            ("< frame 0000001F 0.000000  >", Answer::Frame(frame("0000001F#").unwrap())),
            ("< rtr 7FF 1.5 8 >", Answer::Frame(frame("7FF#R8").unwrap())),
            ("< error 20000080 1.5 >", Answer::Frame(frame("20000080#0000000000000000").unwrap())),
            ("< error could not open bus >", Answer::Error),
            ("< frame 123 nonsense DE >", Answer::Garbage),
            ("< frame 123 1.0 DEA >", Answer::Garbage),
            ("< frame 123 1.0 00112233445566778899 >", Answer::Garbage),
            ("< fly >", Answer::Garbage),
            ("HTTP/1.1 400 Bad Request\r\n\r\n", Answer::Garbage),
        ];
        for (text, expected) in table {
            assert_eq!(all(text.as_bytes()), [*expected], "{text}");
        }
    }

    #[test]
    fn a_whole_conversation() {
        let mut client = Client::new("vcan7");
        let (mut out, mut heard) = (Vec::new(), Vec::new());
        client.connected(0, &mut out);
        let mut say = |h| heard.push(h);
        client.receive(b"< hi >", 1, &mut out, &mut say);
        assert_eq!(String::from_utf8(std::mem::take(&mut out)).unwrap(), "< open vcan7 >");
        client.receive(b"< ok >", 2, &mut out, &mut say);
        assert_eq!(String::from_utf8(std::mem::take(&mut out)).unwrap(), "< rawmode >");
        client.receive(b"< ok >< frame 1 0.0 AA >", 3, &mut out, &mut say);
        client.send(&frame("12345678#0A").unwrap(), 4, &mut out, &mut say);
        assert_eq!(String::from_utf8(out).unwrap(), "< send 12345678 1 0A >");
        assert_eq!(heard, [Heard::Up, Heard::Frame(frame("001#AA").unwrap(), 3), Heard::Sent]);
        assert!(!client.fits(&frame("123##0AA").unwrap()));
    }

    #[test]
    fn who_is_no_socketcand_is_told() {
        let fault = |text: &[&[u8]], late: bool| {
            let mut client = Client::new("vcan7");
            let (mut out, mut heard) = (Vec::new(), Vec::new());
            client.connected(0, &mut out);
            for piece in text {
                client.receive(piece, 0, &mut out, &mut |h| heard.push(format!("{h:?}")));
            }
            if late {
                client.tick(ANSWER_NS, &mut out, &mut |h| heard.push(format!("{h:?}")));
            }
            heard.join("\n")
        };
        let all = [
            fault(&[b"SSH-2.0-OpenSSH_9.2\r\n"], false),
            fault(&[b"< hi >", b"< error could not open bus >"], false),
            fault(&[], true),
            fault(&[b"< hi >"], true),
        ];
        insta::assert_snapshot!(all.join("\n"), @r#"
        Fault("what answers is no socketcand: it does not greet with < hi >")
        Fault("the server does not open bus 'vcan7': it says 'error could not open bus'")
        Fault("the server did not give a greeting within 5 s")
        Fault("the server did not give the answer to open within 5 s")
        "#);
    }

    proptest! {
        #[test]
        fn our_own_server_understands_it_and_it_our_server(f in any_classic(), utc_ns in any::<u64>()) {
            let text = sent(&f);
            let mut rest = text.as_bytes();
            let got = socketcand::Decoder::default().next(&mut rest);
            prop_assert_eq!(got, Some(socketcand::Command::Send(f)));
            let mut out = [0; socketcand::MAX_TEXT];
            let n = socketcand::encode(&f, utc_ns, &mut out);
            prop_assert_eq!(all(&out[..n]), vec![Answer::Frame(f)]);
        }

        #[test]
        fn never_panics(bytes in prop::collection::vec(prop_oneof![any::<u8>(), prop::sample::select(b"<> framertohi 12.f".to_vec())], 0..600)) {
            all(&bytes);
        }
    }
}
