//! One TCP connection without the TCP: bytes in, bytes and a verdict out.
//!
//! A session owns a receive and a transmit buffer, both made once. It answers pipelined requests in their
//! order, at most [`MAX_BATCH`] at a time, and gathers their answers so that one read costs one write.

use crate::protocol::mbap::{self, MAX_ADU, MAX_RECEIVED, Scan};
use crate::protocol::pdu::{Exception, MAX_PDU};
use crate::server::{Image, Outcome, answer, refuse};

/// Most requests answered before the answers are written and others get their turn.
pub const MAX_BATCH: usize = 16;
const BUFFER: usize = MAX_BATCH * MAX_ADU;
/// Highest exception code counted by itself (V1.1b3 clause 7).
pub const MAX_EXCEPTION: usize = 0x0B;

/// Which unit identifiers are served.
///
/// Units 0 and 255 address the device itself and are always served (Guide V1.0b clause 4.4.2.2: on TCP the
/// unit is not used to address a device that is reached by its IP address). Others get exception 0A.
#[derive(Clone, Debug, PartialEq, Eq, Default)]
pub struct UnitRule {
    only: Option<[u64; 4]>,
}

impl UnitRule {
    /// Every unit is served.
    pub fn any() -> Self {
        Self { only: None }
    }

    /// These, 0 and 255 are served.
    pub fn only(units: &[u8]) -> Self {
        let mut set = [0_u64; 4];
        for unit in units.iter().copied().chain([0, 255]) {
            if let Some(word) = set.get_mut(usize::from(unit / 64)) {
                *word |= 1 << (unit % 64);
            }
        }
        Self { only: Some(set) }
    }

    /// Whether a unit is served.
    pub fn serves(&self, unit: u8) -> bool {
        self.only.is_none_or(|set| {
            set.get(usize::from(unit / 64)).is_some_and(|word| word >> (unit % 64) & 1 == 1)
        })
    }
}

/// What a session has seen since it began.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize)]
pub struct SessionCounts {
    /// Requests answered, exceptions included.
    pub requests: u64,
    /// Requests answered by an exception.
    pub exceptions: u64,
    /// Of these, by exception code; index 0 is unused.
    pub by_exception: [u64; MAX_EXCEPTION + 1],
    /// Frames of another protocol, dropped without an answer.
    pub foreign: u64,
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
        Self::new()
    }
}

impl Session {
    /// A fresh connection; makes its two buffers (8320 bytes).
    pub fn new() -> Self {
        Self {
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
    pub fn process(&mut self, units: &UnitRule, image: &mut dyn Image) -> Next {
        (self.output_len, self.output_sent) = (0, 0);
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
            let outcome = if units.serves(frame.unit) {
                answer(frame.pdu, image, body)
            } else {
                refuse(frame.pdu.first().copied().unwrap_or(0), Exception::GatewayPathUnavailable, body)
            };
            *head = mbap::header(frame.transaction, frame.unit, outcome.len);
            self.output_len += mbap::HEADER + outcome.len;
            self.start += used;
            let unit = frame.unit;
            self.count(unit, &outcome);
        }
    }

    fn count(&mut self, unit: u8, outcome: &Outcome) {
        self.counts.requests += 1;
        self.counts.last_unit = unit;
        self.counts.last_function = outcome.function;
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
