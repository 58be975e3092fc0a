//! One TCP connection without the TCP: bytes in, bytes and a verdict out.
//!
//! A session owns a receive and a transmit buffer, both made once. It answers pipelined requests in their
//! order, at most [`MAX_BATCH`] at a time, and gathers their answers so that one read costs one write. It speaks
//! Modbus TCP, or RTU frames on the stream as a port server sends them.

use crate::device::{Device, Served};
use crate::protocol::mbap::{self, MAX_ADU, MAX_RECEIVED, Scan};
use crate::protocol::pdu::MAX_PDU;
use crate::protocol::rtu;
use crate::rights::Peer;
use crate::server::{Image, Outcome};
use crate::stream::{self, Found};

/// Most requests answered before the answers are written and others get their turn.
pub const MAX_BATCH: usize = 16;
const BUFFER: usize = MAX_BATCH * MAX_ADU;
/// Highest exception code counted by itself (V1.1b3 clause 7).
pub const MAX_EXCEPTION: usize = 0x0B;

/// How frames lie in the stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum Framing {
    /// Modbus TCP.
    #[default]
    Tcp,
    /// RTU frames one behind the other.
    Rtu,
}

/// What a session has seen since it began.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize)]
pub struct SessionCounts {
    /// Requests taken, exceptions and those without an answer included.
    pub requests: u64,
    /// Requests answered by an exception.
    pub exceptions: u64,
    /// Of these, by exception code; index 0 is unused.
    pub by_exception: [u64; MAX_EXCEPTION + 1],
    /// Frames of another protocol, and of other units on RTU over TCP, dropped without an answer.
    pub foreign: u64,
    /// Requests carried out that have no answer: broadcasts, listen-only mode.
    pub silent: u64,
    /// RTU over TCP: bytes that belonged to no frame.
    pub noise: u64,
    /// Unit of the last request.
    pub last_unit: u8,
    /// Function code of the last request.
    pub last_function: u8,
}

/// What to do after [`Session::process`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Next {
    /// Write the output, then read.
    Read,
    /// Write the output, let others have their turn, then process again: more requests are waiting.
    Again,
    /// Write the output, then close: the length field of a header was impossible.
    BadLength(u16),
}

/// The state of one connection.
pub struct Session {
    framing: Framing,
    /// RTU over TCP: nothing came for so long that what was received is all there is.
    silent: bool,
    received: Box<[u8]>,
    start: usize,
    end: usize,
    output: Box<[u8]>,
    output_len: usize,
    output_sent: usize,
    counts: SessionCounts,
}

impl Default for Session {
    fn default() -> Self {
        Self::new(Framing::Tcp)
    }
}

impl Session {
    /// A fresh connection; makes its two buffers (8320 bytes).
    pub fn new(framing: Framing) -> Self {
        Self {
            framing,
            silent: false,
            received: vec![0; BUFFER].into_boxed_slice(),
            start: 0,
            end: 0,
            output: vec![0; BUFFER].into_boxed_slice(),
            output_len: 0,
            output_sent: 0,
            counts: SessionCounts::default(),
        }
    }

    /// Room for received bytes. Never empty once [`Session::process`] has said [`Next::Read`].
    pub fn space(&mut self) -> &mut [u8] {
        if self.start == self.end {
            (self.start, self.end) = (0, 0);
        } else if self.start > 0 && BUFFER - self.end < MAX_RECEIVED {
            self.received.copy_within(self.start..self.end, 0);
            (self.start, self.end) = (0, self.end - self.start);
        }
        &mut self.received[self.end..]
    }

    /// Says that `n` bytes were put into [`Session::space`].
    pub fn received(&mut self, n: usize) {
        self.silent = false;
        self.end = (self.end + n).min(BUFFER);
    }

    /// What is to be written to the peer.
    pub fn output(&self) -> &[u8] {
        &self.output[self.output_sent..self.output_len]
    }

    /// Says that `n` bytes of the output were written.
    pub fn sent(&mut self, n: usize) {
        self.output_sent = (self.output_sent + n).min(self.output_len);
    }

    /// What was seen so far.
    pub fn counts(&self) -> &SessionCounts {
        &self.counts
    }

    /// Answers the requests received so far, at most [`MAX_BATCH`]. Call it only when the output of the last
    /// call was written.
    pub fn process(&mut self, device: &mut Device, peer: &Peer, image: &mut dyn Image) -> Next {
        (self.output_len, self.output_sent) = (0, 0);
        match self.framing {
            Framing::Tcp => self.process_tcp(device, peer, image),
            Framing::Rtu => self.process_rtu(device, peer, image),
        }
    }

    fn process_tcp(&mut self, device: &mut Device, peer: &Peer, image: &mut dyn Image) -> Next {
        let mut left = MAX_BATCH;
        loop {
            let (frame, used) = match mbap::scan(&self.received[self.start..self.end]) {
                Scan::Incomplete => return Next::Read,
                Scan::BadLength { length } => return Next::BadLength(length),
                Scan::Foreign { used } => {
                    self.start += used;
                    self.counts.foreign += 1;
                    continue;
                }
                Scan::Frame { frame, used } => (frame, used),
            };
            if left == 0 {
                return Next::Again;
            }
            left -= 1;
            let slot = self.output[self.output_len..].first_chunk_mut::<MAX_ADU>();
            let Some((head, body)) = slot.and_then(|slot| slot.split_first_chunk_mut::<{ mbap::HEADER }>())
            else {
                return Next::Again; // not reached: the buffer holds MAX_BATCH answers of any size
            };
            let Some(body) = body.first_chunk_mut::<MAX_PDU>() else { return Next::Again };
            let unit = frame.unit;
            let served = device.serve(unit, frame.pdu, peer, image, body);
            if let Served::Answer(outcome) = served {
                *head = mbap::header(frame.transaction, unit, outcome.len);
                self.output_len += mbap::HEADER + outcome.len;
            }
            let function = frame.pdu.first().copied().unwrap_or(0);
            self.start += used;
            self.count(unit, function, served);
        }
    }

    fn process_rtu(&mut self, device: &mut Device, peer: &Peer, image: &mut dyn Image) -> Next {
        let mut left = MAX_BATCH;
        loop {
            let bytes = &self.received[self.start..self.end];
            let (skipped, len) = match stream::find(bytes, self.silent, |unit| device.serves(unit)) {
                Found::Nothing { skip } => {
                    self.start += skip;
                    self.counts.noise += skip as u64;
                    return Next::Read;
                }
                Found::Frame { skip, len } => (skip, len),
            };
            if left == 0 {
                return Next::Again;
            }
            left -= 1;
            let Ok((unit, pdu)) = rtu::decode(bytes.get(skipped..skipped + len).unwrap_or_default()) else {
                return Next::Read; // not reached: it was found by its CRC
            };
            let mut answer = [0; MAX_PDU];
            let served = device.serve(unit, pdu, peer, image, &mut answer);
            let function = pdu.first().copied().unwrap_or(0);
            if let Served::Answer(outcome) = served
                && let Some(out) = self.output[self.output_len..].first_chunk_mut()
            {
                self.output_len += rtu::encode(unit, &answer[..outcome.len], out);
            }
            self.start += skipped + len;
            self.counts.noise += skipped as u64;
            self.count(unit, function, served);
        }
    }

    /// Whether a frame was begun and its end is missing. Only RTU on a stream needs to know: the end may never come.
    pub fn is_waiting(&self) -> bool {
        self.framing == Framing::Rtu && self.start < self.end
    }

    /// The stream was silent for so long that what was begun will not go on: [`Session::process`] makes of it what it
    /// can and drops the rest.
    pub fn silence(&mut self) {
        self.silent = self.is_waiting();
    }

    fn count(&mut self, unit: u8, function: u8, served: Served) {
        match served {
            Served::NotOurs => {
                self.counts.foreign += 1;
                return;
            }
            Served::Silent(_) => self.counts.silent += 1,
            Served::Answer(outcome) => self.count_answer(&outcome),
        }
        self.counts.requests += 1;
        self.counts.last_unit = unit;
        self.counts.last_function = function;
    }

    fn count_answer(&mut self, outcome: &Outcome) {
        if let Some(exception) = outcome.exception {
            self.counts.exceptions += 1;
            if let Some(count) = self.counts.by_exception.get_mut(usize::from(exception.code())) {
                *count += 1;
            }
        }
    }
}

#[cfg(test)]
#[path = "session_tests.rs"]
mod tests;
