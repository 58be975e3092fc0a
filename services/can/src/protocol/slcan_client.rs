//! SLCAN, client side: the driver of an adapter that speaks it.
//!
//! Adapters differ: some acknowledge every command, some none; some refuse a full queue with BEL, which is also all
//! that one in bus-off says. So a missing answer is no fault while the channel is set up, frames count as sent when
//! written if the adapter has never acknowledged one, and many BEL in a row are met by closing and opening the channel.
//! Sources: Lawicel CANUSB manual 1.0D; CANable 2.0 firmware commands `d D b B Y`.

use std::collections::VecDeque;

use super::error_frame::ControllerState;
use super::frame::Frame;
use super::hex;
use super::peer::{Heard, Peer};
use super::slcan::{self, MAX_LINE, MAX_TEXT};

/// Most frames the adapter is given before it acknowledges the first.
pub const FLIGHT: usize = 8;
/// How long an answer to a set-up command is waited for.
const STEP_NS: u64 = 300_000_000;
/// The channel is taken for closed when the adapter has been silent for so long.
const SETTLE_NS: u64 = 50_000_000;
/// How long the acknowledgement of a frame is waited for.
const ACK_NS: u64 = 1_000_000_000;
/// Pause between two questions for the status flags.
const POLL_NS: u64 = 1_000_000_000;
/// So many refused frames in a row mean bus-off.
const REFUSALS: u32 = 8;
/// So much nonsense before the first sensible line means that this is no SLCAN adapter.
const GARBAGE: u32 = 8;
/// Longest pause before the channel is opened again.
const MAX_RESTART_NS: u64 = 5_000_000_000;

/// One thing the adapter said.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Answer {
    /// CR alone.
    Ok,
    /// BEL.
    Bell,
    /// `z` or `Z`: frame taken.
    Sent,
    /// A frame of the bus, with the adapter's stamp in ms if it gives one.
    Frame(Frame, Option<u16>),
    /// Status flags.
    Flags(u8),
    /// Version or serial number.
    Info,
    /// Anything else.
    Garbage,
}

/// Splits what the adapter says. Holds at most one line.
#[derive(Debug, Clone)]
pub struct Decoder {
    line: [u8; MAX_LINE],
    len: usize,
    overlong: bool,
}

impl Default for Decoder {
    fn default() -> Self {
        Self { line: [0; MAX_LINE], len: 0, overlong: false }
    }
}

impl Decoder {
    /// Takes bytes from `input` until one answer is complete; `None` when all are used up.
    pub fn next(&mut self, input: &mut &[u8]) -> Option<Answer> {
        while let Some((&byte, rest)) = input.split_first() {
            *input = rest;
            match byte {
                b'\r' => {
                    let answer = if self.overlong { Answer::Garbage } else { parse(&self.line[..self.len]) };
                    self.len = 0;
                    self.overlong = false;
                    return Some(answer);
                }
                0x07 => {
                    self.len = 0;
                    self.overlong = false;
                    return Some(Answer::Bell);
                }
                b'\n' => {}
                _ if self.len < MAX_LINE => {
                    self.line[self.len] = byte;
                    self.len += 1;
                }
                // Said once: a stream without line ends must not look silent.
                _ if !self.overlong => {
                    self.overlong = true;
                    return Some(Answer::Garbage);
                }
                _ => {}
            }
        }
        None
    }

    /// The line that is not complete, for messages.
    fn rest(&self) -> &[u8] {
        &self.line[..self.len]
    }
}

fn parse(line: &[u8]) -> Answer {
    let Some((&letter, rest)) = line.split_first() else { return Answer::Ok };
    match letter {
        b'z' | b'Z' if rest.is_empty() => Answer::Sent,
        b't' | b'T' | b'r' | b'R' | b'd' | b'D' | b'b' | b'B' => {
            let Some(frame) = slcan::transmit(letter, rest) else { return Answer::Garbage };
            let used = if frame.is_extended() { 9 } else { 4 } + 2 * frame.payload().len();
            match rest.get(used..) {
                Some([]) => Answer::Frame(frame, None),
                Some(stamp) if stamp.len() == 4 => match hex::number(stamp) {
                    Some(ms) => Answer::Frame(frame, Some(ms as u16)),
                    None => Answer::Garbage,
                },
                _ => Answer::Garbage,
            }
        }
        b'F' if rest.len() == 2 => hex::number(rest).map_or(Answer::Garbage, |n| Answer::Flags(n as u8)),
        b'V' | b'v' | b'N' if rest.len() >= 2 && rest.iter().all(u8::is_ascii_graphic) => Answer::Info,
        _ => Answer::Garbage,
    }
}

/// Turns the adapter's milliseconds (modulo 60,000) into time of this machine: the least delay seen between adapter
/// and us counts as none, and the clocks may drift by 200 ppm.
#[derive(Debug, Clone, Copy, Default)]
pub struct StampMap {
    last: Option<Last>,
}

#[derive(Debug, Clone, Copy)]
struct Last {
    ms: u16,
    adapter_ns: u64,
    arrived_ns: u64,
    offset_ns: i64,
}

impl StampMap {
    /// CLOCK_MONOTONIC in ns of a stamp that arrived at `now_ns`; never later than that.
    pub fn map(&mut self, ms: u16, now_ns: u64) -> u64 {
        let fresh = Last { ms, adapter_ns: 0, arrived_ns: now_ns, offset_ns: now_ns as i64 };
        let Some(last) = self.last else {
            self.last = Some(fresh);
            return now_ns;
        };
        let elapsed_ns = now_ns.saturating_sub(last.arrived_ns);
        let step_ms = (u64::from(ms) + 60_000 - u64::from(last.ms) % 60_000) % 60_000;
        let adapter_ns = last.adapter_ns + step_ms * 1_000_000;
        let offset_ns = (last.offset_ns + (elapsed_ns / 5000) as i64).min(now_ns as i64 - adapter_ns as i64);
        let at_ns = (adapter_ns as i64 + offset_ns).max(0) as u64;
        // After a long silence the number of minutes is not known; and no adapter holds frames for seconds.
        if elapsed_ns > 30_000_000_000 || ms >= 60_000 || now_ns.saturating_sub(at_ns) > 5_000_000_000 {
            self.last = Some(fresh);
            return now_ns;
        }
        self.last = Some(Last { ms, adapter_ns, arrived_ns: now_ns, offset_ns });
        at_ns.min(now_ns)
    }
}

/// How the channel is opened.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Channel {
    /// Digit of `S`.
    pub rate_code: u8,
    /// Digit of `Y`, for CAN FD.
    pub data_rate_code: Option<u8>,
    /// Ask for stamps.
    pub timestamps: bool,
    /// First pause before the channel is opened again after bus-off; 0 = never.
    pub restart_ns: u64,
}

/// Digit of `S` for a bit rate; S7 is 800 kbit/s with Lawicel and 750 kbit/s with CANable.
pub fn rate_code(bitrate: u32) -> Option<u8> {
    let codes = [10, 20, 50, 100, 125, 250, 500, 750, 1000];
    let code = codes.iter().position(|&k| k * 1000 == bitrate).map(|i| i as u8);
    code.or(match bitrate {
        800_000 => Some(7),
        83_300 => Some(9),
        _ => None,
    })
}

/// Digit of `Y` for a data bit rate.
pub fn data_rate_code(bitrate: u32) -> Option<u8> {
    let whole = bitrate.is_multiple_of(1_000_000) && (1_000_000..=8_000_000).contains(&bitrate);
    whole.then_some((bitrate / 1_000_000) as u8)
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Step {
    Close,
    Rate,
    DataRate,
    Timestamps,
    Open,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum State {
    Idle,
    Setup(Step, u64),
    Open,
    /// Closed until then.
    Restart(u64),
    Dead,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Expect {
    Frame,
    Flags,
}

/// See the module.
#[derive(Debug)]
pub struct Client {
    channel: Channel,
    decoder: Decoder,
    stamps: StampMap,
    state: State,
    pending: VecDeque<(Expect, u64)>,
    /// None: not known yet.
    acknowledges: Option<bool>,
    answered_setup: bool,
    polls: bool,
    next_poll_ns: u64,
    refusals: u32,
    restarts: u32,
    garbage: u32,
    sensible: bool,
    flags: u8,
}

impl Client {
    /// A client of an adapter that is not connected yet.
    pub fn new(channel: Channel) -> Self {
        Self {
            channel,
            decoder: Decoder::default(),
            stamps: StampMap::default(),
            state: State::Idle,
            pending: VecDeque::with_capacity(FLIGHT + 1),
            acknowledges: None,
            answered_setup: false,
            polls: true,
            next_poll_ns: 0,
            refusals: 0,
            restarts: 0,
            garbage: 0,
            sensible: false,
            flags: 0,
        }
    }

    fn step(&mut self, step: Step, now_ns: u64, out: &mut Vec<u8>) {
        match step {
            // Empty lines end whatever stood half in the adapter's buffer.
            Step::Close => out.extend(b"\r\r\rC\r"),
            Step::Rate => out.extend([b'S', b'0' + self.channel.rate_code, b'\r']),
            Step::DataRate => out.extend([b'Y', b'0' + self.channel.data_rate_code.unwrap_or(2), b'\r']),
            Step::Timestamps => out.extend([b'Z', b'0' + u8::from(self.channel.timestamps), b'\r']),
            Step::Open => out.extend(b"O\r"),
        }
        self.state = State::Setup(step, now_ns + STEP_NS);
    }

    fn after(&self, step: Step) -> Option<Step> {
        match step {
            Step::Close => Some(Step::Rate),
            Step::Rate if self.channel.data_rate_code.is_some() => Some(Step::DataRate),
            Step::Rate | Step::DataRate if self.channel.timestamps => Some(Step::Timestamps),
            Step::Rate | Step::DataRate | Step::Timestamps => Some(Step::Open),
            Step::Open => None,
        }
    }

    /// The present step is answered (`Some(positive)`) or not (`None`).
    fn advance(
        &mut self,
        step: Step,
        answer: Option<bool>,
        now_ns: u64,
        out: &mut Vec<u8>,
        heard: &mut dyn FnMut(Heard),
    ) {
        self.answered_setup |= answer.is_some();
        if answer == Some(false) {
            let refused = match step {
                Step::Close => None,
                Step::Rate => Some("the adapter refuses the bit rate (BEL): choose one that it has"),
                Step::Open => {
                    Some("the adapter refuses to open its channel (BEL): is another program using it?")
                }
                Step::DataRate => {
                    heard(Heard::Note(
                        "the adapter refuses the data bit rate (BEL): it has no CAN FD, set fd = false"
                            .into(),
                    ));
                    None
                }
                Step::Timestamps => {
                    heard(Heard::Note(
                        "the adapter refuses timestamps (BEL): frames are stamped when they arrive".into(),
                    ));
                    None
                }
            };
            if let Some(why) = refused {
                return self.fault(why.to_owned(), heard);
            }
        }
        if let Some(next) = self.after(step) {
            return self.step(next, now_ns, out);
        }
        if !self.answered_setup && self.acknowledges.is_none() {
            self.acknowledges = Some(false);
            self.polls = false;
            heard(Heard::Note(
                "the adapter acknowledges nothing: frames count as sent when they are written".into(),
            ));
        }
        self.state = State::Open;
        self.refusals = 0;
        self.next_poll_ns = now_ns + POLL_NS;
        heard(Heard::Up);
    }

    fn fault(&mut self, why: String, heard: &mut dyn FnMut(Heard)) {
        self.state = State::Dead;
        heard(Heard::Fault(why));
    }

    fn nonsense(&mut self, heard: &mut dyn FnMut(Heard)) {
        self.garbage += 1;
        if !self.sensible && self.garbage >= GARBAGE {
            let what = String::from_utf8_lossy(self.decoder.rest()).into_owned();
            let shown = if what.is_empty() { String::new() } else { format!(" ({what:?})") };
            self.fault(
                format!("what answers is no SLCAN adapter: nothing but nonsense came{shown}; check `interface` and `baud`"),
                heard,
            );
        }
    }

    fn answered(&mut self, positive: bool, now_ns: u64, out: &mut Vec<u8>, heard: &mut dyn FnMut(Heard)) {
        match self.pending.pop_front() {
            Some((Expect::Frame, _)) if positive => {
                self.acknowledges = Some(true);
                self.refusals = 0;
                self.restarts = 0;
                heard(Heard::Sent);
            }
            Some((Expect::Frame, _)) => {
                heard(Heard::Refused);
                self.refusals += 1;
                if self.refusals >= REFUSALS {
                    self.recover(now_ns, out, heard);
                }
            }
            // It does not know the question.
            Some((Expect::Flags, _)) => self.polls = false,
            None => {}
        }
    }

    fn recover(&mut self, now_ns: u64, out: &mut Vec<u8>, heard: &mut dyn FnMut(Heard)) {
        for (what, _) in self.pending.drain(..) {
            if what == Expect::Frame {
                heard(Heard::Refused);
            }
        }
        out.extend(b"C\r");
        heard(Heard::State(
            ControllerState::BusOff,
            format!(
                "the adapter refused {REFUSALS} frames in a row: bus-off, or nobody acknowledges (termination, bit rate, partner?)"
            ),
        ));
        if self.channel.restart_ns == 0 {
            self.state = State::Dead;
            return heard(Heard::Restarting(
                "closed, and stays so because bus_off_restart = \"0ms\"; restart the service".into(),
            ));
        }
        let pause_ns = (self.channel.restart_ns << self.restarts.min(16))
            .min(MAX_RESTART_NS.max(self.channel.restart_ns));
        self.restarts += 1;
        self.state = State::Restart(now_ns + pause_ns);
        heard(Heard::Restarting(format!("closed, to be opened again in {} ms", pause_ns / 1_000_000)));
    }

    fn flags(&mut self, flags: u8, heard: &mut dyn FnMut(Heard)) {
        if self.pending.front().is_some_and(|(what, _)| *what == Expect::Flags) {
            self.pending.pop_front();
        }
        if flags == self.flags {
            return;
        }
        self.flags = flags;
        let state = match flags {
            f if f & 0x20 != 0 => ControllerState::Passive,
            f if f & 0x04 != 0 => ControllerState::Warning,
            _ => ControllerState::Active,
        };
        heard(Heard::State(state, flag_words(flags)));
    }
}

/// Status flags of the adapter in words (Lawicel manual, command F).
pub fn flag_words(flags: u8) -> String {
    const NAMES: [&str; 8] = [
        "receive queue full",
        "transmit queue full",
        "error warning",
        "data overrun",
        "unknown flag 4",
        "error passive",
        "arbitration lost",
        "bus error",
    ];
    let set: Vec<&str> = (0..8).filter(|bit| flags & (1 << bit) != 0).map(|bit| NAMES[bit]).collect();
    if set.is_empty() { "error active".to_owned() } else { set.join("; ") }
}

impl Peer for Client {
    fn connected(&mut self, now_ns: u64, out: &mut Vec<u8>) {
        *self = Self::new(self.channel);
        self.step(Step::Close, now_ns, out);
    }

    fn receive(&mut self, bytes: &[u8], now_ns: u64, out: &mut Vec<u8>, heard: &mut dyn FnMut(Heard)) {
        let mut rest = bytes;
        while let Some(answer) = self.decoder.next(&mut rest) {
            self.sensible |= !matches!(answer, Answer::Garbage | Answer::Ok | Answer::Bell);
            match (answer, self.state) {
                (Answer::Garbage, _) => self.nonsense(heard),
                (Answer::Frame(frame, stamp), State::Open) => {
                    let t_ns = stamp.map_or(now_ns, |ms| self.stamps.map(ms, now_ns));
                    heard(Heard::Frame(frame, t_ns));
                }
                (Answer::Flags(flags), State::Open) => self.flags(flags, heard),
                // The empty lines before `C` may be answered or not, and `C` on a closed channel may be refused.
                (Answer::Ok | Answer::Bell, State::Setup(Step::Close, _)) => {
                    self.answered_setup = true;
                    self.state = State::Setup(Step::Close, now_ns + SETTLE_NS);
                }
                (Answer::Ok, State::Setup(step, _)) => self.advance(step, Some(true), now_ns, out, heard),
                (Answer::Bell, State::Setup(step, _)) => self.advance(step, Some(false), now_ns, out, heard),
                (Answer::Ok | Answer::Sent, State::Open) => self.answered(true, now_ns, out, heard),
                (Answer::Bell, State::Open) => self.answered(false, now_ns, out, heard),
                _ => {}
            }
        }
    }

    fn tick(&mut self, now_ns: u64, out: &mut Vec<u8>, heard: &mut dyn FnMut(Heard)) {
        match self.state {
            State::Setup(step, until_ns) if until_ns <= now_ns => {
                self.advance(step, None, now_ns, out, heard);
            }
            State::Restart(until_ns) if until_ns <= now_ns => self.step(Step::Close, now_ns, out),
            State::Open => {
                if let Some(&(what, since_ns)) = self.pending.front()
                    && since_ns + ACK_NS <= now_ns
                {
                    if what == Expect::Flags {
                        self.polls = false;
                        self.pending.pop_front();
                    } else if self.acknowledges.is_none() {
                        // It answered commands, but never a frame.
                        self.acknowledges = Some(false);
                        for (what, _) in std::mem::take(&mut self.pending) {
                            if what == Expect::Frame {
                                heard(Heard::Sent);
                            }
                        }
                    } else {
                        self.answered(false, now_ns, out, heard);
                    }
                }
                if self.polls && self.state == State::Open && self.next_poll_ns <= now_ns {
                    self.next_poll_ns = now_ns + POLL_NS;
                    if self.pending.is_empty() {
                        out.extend(b"F\r");
                        self.pending.push_back((Expect::Flags, now_ns));
                    }
                }
            }
            _ => {}
        }
    }

    fn deadline_ns(&self) -> Option<u64> {
        match self.state {
            State::Setup(_, until_ns) | State::Restart(until_ns) => Some(until_ns),
            State::Open => {
                let ack_ns = self.pending.front().map(|(_, since_ns)| since_ns + ACK_NS);
                ack_ns.into_iter().chain(self.polls.then_some(self.next_poll_ns)).min()
            }
            State::Idle | State::Dead => None,
        }
    }

    fn fits(&self, frame: &Frame) -> bool {
        !frame.is_fd() || self.channel.data_rate_code.is_some()
    }

    fn send(&mut self, frame: &Frame, now_ns: u64, out: &mut Vec<u8>, heard: &mut dyn FnMut(Heard)) {
        let mut text = [0; MAX_TEXT];
        let n = slcan::encode(frame, None, &mut text);
        out.extend(&text[..n]);
        if self.acknowledges == Some(false) {
            heard(Heard::Sent);
        } else {
            self.pending.push_back((Expect::Frame, now_ns));
        }
    }

    fn flight(&self) -> usize {
        FLIGHT
    }

    fn farewell(&self) -> &'static [u8] {
        b"C\r"
    }
}

#[cfg(test)]
#[path = "slcan_client_tests.rs"]
mod tests;
