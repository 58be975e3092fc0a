//! The server on a serial line without the line: chunks of `<port>/rx` in, frames for `<port>/tx` out.
//!
//! On a shared line most traffic is not for us. Only a frame that the driver saw end and that is undamaged counts;
//! everything else is counted and forgotten. An answer of another unit carries that unit's address, so nothing that
//! stands in a foreign dialog can be taken for a request to us. What this service sent itself comes back as an echo:
//! it confirms the answer and is never read as a request. An adapter that sends back what it is given, and is not
//! configured so in the serial service, must not make us talk to ourselves: a frame equal to our last answer that is
//! no request, or came while or right behind that left, is dropped. No clock, no allocation.

use crate::device::{Device, Served};
use crate::line_state::LineFault;
use crate::protocol::ascii::{self, Received, Receiver};
use crate::protocol::pdu::{Exception, MAX_PDU, decode_request};
use crate::protocol::rtu::{self, FrameError};
use crate::rights::Peer;
use crate::server::{Image, Outcome};
use crate::session::MAX_EXCEPTION;
use ipc_types::payload::{SerialChunk, serial_flag};
use serde::{Deserialize, Serialize};

/// How frames look on the line.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Mode {
    #[default]
    Rtu,
    Ascii,
}

/// Counters of a line since the service started. Nothing on the line clears them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct LineCounters {
    /// Undamaged frames, to whomever.
    pub bus_messages: u64,
    /// Frames to units of ours, broadcasts included.
    pub addressed: u64,
    pub broadcasts: u64,
    /// Frames of other units.
    pub foreign: u64,
    pub answers: u64,
    /// Of these, exceptions.
    pub exceptions: u64,
    /// By exception code, index 0 unused.
    pub by_exception: [u64; MAX_EXCEPTION + 1],
    /// Frames to us without an answer: broadcasts, listen-only mode.
    pub no_response: u64,
    /// Answered with exception 07.
    pub nak: u64,
    /// Answered with exception 06.
    pub busy: u64,
    /// Wrong CRC or LRC.
    pub crc_errors: u64,
    /// Too short, too long, or no frame at all.
    pub malformed: u64,
    pub parity: u64,
    pub framing: u64,
    pub breaks: u64,
    pub overrun: u64,
    /// Frames with a silence of more than 1.5 characters inside.
    pub gaps: u64,
    /// Parts of frames lost between the driver and this service.
    pub lost: u64,
    /// Answers that left the port.
    pub sent: u64,
    /// Answers that could not be sent: the port was gone, its queue full, or it was too late.
    pub not_sent: u64,
    /// Requests that came before the answer to the one before had left.
    pub overlapped: u64,
    /// Frames that were our own answer, sent back by the adapter.
    pub own_answers: u64,
}

/// A copy of our own answer may come back so long after that has left; USB adapters hold bytes back.
const ECHO_NS: u64 = 50_000_000;

/// Takes a frame to send; `false` when it cannot.
pub type Send<'a> = dyn FnMut(&[u8]) -> bool + 'a;

/// The state of one line.
pub struct Line {
    mode: Mode,
    /// Index of the line in the key `serial`.
    index: usize,
    /// This service on the rail, whose echoes are its own.
    writer: u32,
    generation: u32,
    device: Device,
    /// RTU: the frame received so far; more than fits is counted only.
    buffer: Box<[u8; rtu::MAX_ADU]>,
    len: usize,
    /// Flags of all chunks of the frame.
    flags: u32,
    receiver: Box<Receiver>,
    next_seq: Option<(u32, u64)>,
    /// Answers handed over whose echo has not come.
    waiting: u32,
    last_answer: Box<[u8; rtu::MAX_ADU]>,
    last_len: usize,
    /// Time of one character, 0 where bytes take none.
    char_ns: u64,
    /// The last answer, once it has left: until when its bytes were on the line, and when that was told.
    sent_ns: Option<(u64, u64)>,
    /// Our own answers come back, as one of them has proved.
    echoing: bool,
    /// When the frame that is being received began.
    first_ns: u64,
    counters: LineCounters,
}

impl Line {
    /// A silent line. `writer` and `generation` are this service's on the rail.
    pub fn new(mode: Mode, index: usize, device: Device, writer: u32, generation: u32) -> Self {
        Self {
            mode,
            index,
            writer,
            generation,
            device,
            buffer: Box::new([0; rtu::MAX_ADU]),
            len: 0,
            flags: 0,
            receiver: Box::default(),
            next_seq: None,
            waiting: 0,
            last_answer: Box::new([0; rtu::MAX_ADU]),
            last_len: 0,
            char_ns: 0,
            sent_ns: None,
            echoing: false,
            first_ns: 0,
            counters: LineCounters::default(),
        }
    }

    /// With the time that one character takes on the line.
    #[must_use]
    pub fn with_char_ns(mut self, char_ns: u64) -> Self {
        self.char_ns = char_ns;
        self
    }

    /// The counters.
    pub fn counters(&self) -> &LineCounters {
        &self.counters
    }

    /// Forgets what was received, and what was sent and not confirmed: the server was switched off, and sees nothing
    /// of the line meanwhile.
    pub fn switched_off(&mut self) {
        self.reset();
        (self.next_seq, self.waiting) = (None, 0);
    }

    fn reset(&mut self) {
        (self.len, self.flags) = (0, 0);
        self.receiver.reset();
    }

    /// Takes a chunk and answers what it completes, at most one frame in RTU, several in ASCII.
    pub fn chunk(&mut self, chunk: &SerialChunk, bytes: &[u8], image: &mut dyn Image, send: &mut Send<'_>) {
        self.follow(chunk);
        if chunk.flags & serial_flag::TX_ECHO != 0 {
            return self.echo(chunk, bytes.len());
        }
        if self.len == 0 {
            self.first_ns = chunk.first_t_ns;
        }
        self.flags |= chunk.flags;
        match self.mode {
            Mode::Rtu => self.rtu(chunk.flags & serial_flag::END != 0, bytes, image, send),
            Mode::Ascii => self.ascii(chunk.flags, bytes, image, send),
        }
    }

    /// A gap in the driver's numbers: what was begun is not whole.
    fn follow(&mut self, chunk: &SerialChunk) {
        let (generation, seq) = (chunk.stamp.generation, chunk.stamp.seq);
        if let Some((known, next)) = self.next_seq
            && (known != generation || next != seq)
        {
            if known == generation && seq > next {
                self.counters.lost += seq - next;
            }
            // The echo of an answer may be among what was lost.
            self.waiting = 0;
            self.reset();
        }
        self.next_seq = Some((generation, seq.wrapping_add(1)));
    }

    fn echo(&mut self, chunk: &SerialChunk, len: usize) {
        if chunk.tx_writer != self.writer || chunk.tx_generation != self.generation {
            return;
        }
        // A long answer comes back in parts; the last one ends it.
        if chunk.flags & serial_flag::NOT_SENT != 0 {
            self.counters.not_sent += 1;
        } else if chunk.flags & serial_flag::END != 0 {
            self.counters.sent += 1;
            // The driver may notice the end late, and a pseudo-terminal takes no time at all.
            let took_ns = chunk.stamp.t_ns.saturating_sub(chunk.first_t_ns);
            let on_line_ns = took_ns.min(self.char_ns.saturating_mul(len as u64));
            self.sent_ns = Some((chunk.first_t_ns.saturating_add(on_line_ns), chunk.stamp.t_ns));
        } else {
            return;
        }
        self.waiting = self.waiting.saturating_sub(1);
    }

    fn rtu(&mut self, end: bool, bytes: &[u8], image: &mut dyn Image, send: &mut Send<'_>) {
        let room = self.buffer.len() - self.len.min(self.buffer.len());
        let taken = bytes.len().min(room);
        if taken > 0 {
            self.buffer[self.len..self.len + taken].copy_from_slice(&bytes[..taken]);
        }
        // Beyond the buffer only the length goes on.
        self.len = self.len.saturating_add(bytes.len());
        if !end {
            return;
        }
        let len = std::mem::take(&mut self.len);
        let flags = std::mem::take(&mut self.flags);
        if len == 0 || self.is_damaged(flags) {
            return;
        }
        let mut pdu = [0; MAX_PDU];
        let decoded = match self.buffer.get(..len) {
            None => Err(FrameError::Long { got: len, max: rtu::MAX_ADU }),
            Some(frame) => rtu::decode(frame).map(|(unit, found)| {
                pdu[..found.len()].copy_from_slice(found);
                (unit, found.len())
            }),
        };
        match decoded {
            Ok((unit, len)) => self.frame(unit, &pdu[..len], image, send),
            Err(error) => self.broken(&error),
        }
    }

    fn ascii(&mut self, flags: u32, bytes: &[u8], image: &mut dyn Image, send: &mut Send<'_>) {
        for &character in bytes {
            if character == b':' {
                // Damage before the beginning of a frame is not its own.
                self.flags = flags;
            }
            match self.receiver.push(character) {
                Received::Nothing => {}
                Received::Broken => self.broken(&FrameError::End),
                Received::Frame => {
                    let flags = self.flags;
                    if self.is_damaged(flags) {
                        continue;
                    }
                    let mut out = [0; 256];
                    let delimiter = self.receiver.delimiter();
                    match ascii::decode_with(self.receiver.frame(), delimiter, &mut out) {
                        Ok((unit, pdu)) => self.frame(unit, pdu, image, send),
                        Err(error) => self.broken(&error),
                    }
                }
            }
        }
        if flags & serial_flag::END != 0 && self.receiver.reset() {
            // The driver gave it up: silent for too long, or too long.
            self.broken(&FrameError::End);
        }
        if !self.receiver.is_inside() {
            self.flags = 0;
        }
    }

    /// Counts what the UART saw. Whether the frame is lost.
    fn is_damaged(&mut self, flags: u32) -> bool {
        let counters = &mut self.counters;
        for (flag, counter) in [
            (serial_flag::GAP, &mut counters.gaps),
            (serial_flag::PARITY, &mut counters.parity),
            (serial_flag::FRAMING, &mut counters.framing),
            (serial_flag::BREAK, &mut counters.breaks),
            (serial_flag::OVERRUN, &mut counters.overrun),
        ] {
            *counter += u64::from(flags & flag != 0);
        }
        if flags & serial_flag::OVERRUN != 0 {
            self.device.fault(LineFault::Overrun);
        }
        if flags & (serial_flag::DAMAGED & !serial_flag::OVERRUN) != 0 {
            self.device.fault(LineFault::Damaged);
        }
        flags & serial_flag::DAMAGED != 0
    }

    fn broken(&mut self, error: &FrameError) {
        match error {
            FrameError::Crc { .. } | FrameError::Lrc { .. } => self.counters.crc_errors += 1,
            _ => self.counters.malformed += 1,
        }
        self.device.fault(LineFault::Damaged);
    }

    /// Whether this is our last answer, sent back by the adapter. Some answers look like their requests (functions 5,
    /// 6, 8, 21, 22), and a master may repeat a request at any time: such a one is an echo if it began before our
    /// answer had left, and, where the adapter is known to send back, if it came right behind that.
    fn is_own(&mut self, unit: u8, pdu: &[u8]) -> bool {
        let last = &self.last_answer[..self.last_len];
        if last.split_first() != Some((&unit, pdu)) {
            return false;
        }
        let began_before = |end_ns: u64| self.first_ns < end_ns;
        if decode_request(pdu).is_err() || self.sent_ns.is_some_and(|(end_ns, _)| began_before(end_ns)) {
            self.echoing = true;
            return true;
        }
        // Not yet told to have left: in ASCII the copy may be whole before that.
        let right_behind =
            self.sent_ns.is_none_or(|(_, told_ns)| began_before(told_ns.saturating_add(ECHO_NS)));
        self.echoing && right_behind
    }

    /// An undamaged frame.
    fn frame(&mut self, unit: u8, pdu: &[u8], image: &mut dyn Image, send: &mut Send<'_>) {
        if self.is_own(unit, pdu) {
            self.counters.own_answers += 1;
            return;
        }
        self.counters.bus_messages += 1;
        let mut out = [0; MAX_PDU];
        let served = self.device.serve(unit, pdu, &Peer::Line(self.index), image, &mut out);
        if served == Served::NotOurs {
            self.counters.foreign += 1;
            return;
        }
        self.counters.addressed += 1;
        self.counters.overlapped += u64::from(self.waiting > 0);
        match served {
            Served::Answer(outcome) => self.answer(unit, &out, &outcome, send),
            _ => {
                self.counters.no_response += 1;
                self.counters.broadcasts += u64::from(unit == rtu::BROADCAST);
            }
        }
        if let Some(delimiter) = self.device.take_delimiter() {
            self.receiver.set_delimiter(delimiter);
        }
    }

    fn answer(&mut self, unit: u8, pdu: &[u8; MAX_PDU], outcome: &Outcome, send: &mut Send<'_>) {
        let pdu = &pdu[..outcome.len];
        let sent = match self.mode {
            Mode::Rtu => {
                let mut frame = [0; rtu::MAX_ADU];
                let len = rtu::encode(unit, pdu, &mut frame);
                send(&frame[..len])
            }
            Mode::Ascii => {
                let mut frame = [0; ascii::MAX_ADU];
                let len = ascii::encode_with(unit, pdu, self.receiver.delimiter(), &mut frame);
                send(&frame[..len])
            }
        };
        self.last_answer[0] = unit;
        self.last_answer[1..=pdu.len()].copy_from_slice(pdu);
        self.last_len = pdu.len() + 1;
        self.sent_ns = None;
        self.counters.answers += 1;
        if sent {
            self.waiting += 1;
        } else {
            self.counters.not_sent += 1;
        }
        if let Some(exception) = outcome.exception {
            self.counters.exceptions += 1;
            self.counters.busy += u64::from(exception == Exception::ServerDeviceBusy);
            self.counters.nak += u64::from(exception == Exception::NegativeAcknowledge);
            if let Some(count) = self.counters.by_exception.get_mut(usize::from(exception.code())) {
                *count += 1;
            }
        }
    }
}

#[cfg(test)]
#[path = "line_tests.rs"]
mod tests;
