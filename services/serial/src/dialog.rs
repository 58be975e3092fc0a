//! A recorded line as a virtual slave: what was answered to a request is answered again, in the order and after the
//! time it was recorded, and from the beginning when it is over. Knows no protocol: requests are compared byte by byte.

use std::collections::HashMap;

use ipc_types::payload::{SerialChunk, serial_flag};
use serde::Serialize;

/// Most different requests.
pub const MAX_REQUESTS: usize = 65_536;
/// Most answers of one request; later ones are not kept.
pub const MAX_ANSWERS: usize = 65_536;
/// Most bytes of all requests and answers.
pub const MAX_BYTES: usize = 64 << 20;
/// Most frames of one answer.
pub const MAX_FRAMES: usize = 64;
/// An answer later than this after its request is none, ns.
pub const ANSWER_LIMIT_NS: u64 = 5_000_000_000;
/// Longest frame.
const MAX_FRAME: usize = 65_536;

/// Which frames of the recording are the slave's.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Side {
    /// Those that others sent: the recorded stack was the master.
    Others,
    /// Those that the recorded stack sent: it was the slave.
    Own,
    /// The stack only listened: every frame that is no answer is a request; an answer begins with the same byte (the
    /// slave's address) as its request.
    Listened,
}

/// A frame of an answer.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Frame {
    /// Time from the end of the request, or of the frame before, to its first byte, ns.
    pub delay_ns: u64,
    /// Its bytes.
    pub bytes: Vec<u8>,
}

#[derive(Debug, Default)]
struct Entry {
    answers: Vec<Vec<Frame>>,
    next: usize,
}

/// What a table holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
pub struct Contents {
    /// Different requests.
    pub requests: usize,
    /// Answers, silence included.
    pub answers: usize,
    /// Answers of silence.
    pub silent: usize,
    /// Frames of the recording that belong to no request, or are beyond a limit.
    pub left_out: u64,
}

/// The table; see the module.
#[derive(Debug, Default)]
pub struct Dialog {
    entries: HashMap<Vec<u8>, Entry>,
    bytes: usize,
    left_out: u64,
}

impl Dialog {
    /// What to answer now: no frames for silence; `None` when this request was never recorded.
    pub fn answer(&mut self, request: &[u8]) -> Option<&[Frame]> {
        let entry = self.entries.get_mut(request)?;
        let at = entry.next;
        entry.next = (at + 1) % entry.answers.len().max(1);
        entry.answers.get(at).map(Vec::as_slice)
    }

    /// What it holds.
    pub fn contents(&self) -> Contents {
        let all = || self.entries.values().flat_map(|e| &e.answers);
        Contents {
            requests: self.entries.len(),
            answers: all().count(),
            silent: all().filter(|a| a.is_empty()).count(),
            left_out: self.left_out,
        }
    }

    fn add(&mut self, request: Vec<u8>, answer: Vec<Frame>) {
        let bytes = request.len() + answer.iter().map(|f| f.bytes.len()).sum::<usize>();
        let room = self.bytes + bytes <= MAX_BYTES;
        let known = self.entries.contains_key(&request);
        if !room || (!known && self.entries.len() >= MAX_REQUESTS) {
            self.left_out += 1 + answer.len() as u64;
            return;
        }
        let entry = self.entries.entry(request).or_default();
        if entry.answers.len() >= MAX_ANSWERS {
            self.left_out += 1 + answer.len() as u64;
            return;
        }
        self.bytes += bytes;
        entry.answers.push(answer);
    }
}

/// Builds a [`Dialog`] from the chunks of `<serial>/rx` in the order of the recording.
#[derive(Debug)]
pub struct Builder {
    side: Side,
    dialog: Dialog,
    /// The frame that is not whole yet: first byte's time, sent by us, bytes.
    part: Option<(u64, bool, Vec<u8>)>,
    /// The request that waits for its answer, its end, and the answer so far with its end.
    open: Option<(Vec<u8>, u64, Vec<Frame>)>,
    own: u64,
    others: u64,
}

impl Builder {
    /// Nothing recorded yet.
    pub fn new(side: Side) -> Self {
        Self { side, dialog: Dialog::default(), part: None, open: None, own: 0, others: 0 }
    }

    /// The next chunk. Damaged frames, and those that were not sent, are left out.
    pub fn push(&mut self, header: &SerialChunk, bytes: &[u8]) {
        let own = header.flags & serial_flag::TX_ECHO != 0;
        if header.flags & (serial_flag::DAMAGED | serial_flag::NOT_SENT) != 0 {
            self.part = None;
            self.dialog.left_out += 1;
            return;
        }
        let (first_ns, was_own, mut whole) =
            self.part.take().unwrap_or_else(|| (header.first_t_ns, own, Vec::new()));
        if was_own == own && whole.len() + bytes.len() <= MAX_FRAME {
            whole.extend_from_slice(bytes);
        } else {
            self.dialog.left_out += 1;
            whole = bytes.to_vec();
        }
        if header.flags & serial_flag::END == 0 {
            self.part = Some((first_ns, own, whole));
            return;
        }
        *(if own { &mut self.own } else { &mut self.others }) += 1;
        self.frame(first_ns, header.stamp.t_ns, own, whole);
    }

    fn frame(&mut self, first_ns: u64, end_ns: u64, own: bool, bytes: Vec<u8>) {
        let answers = match self.side {
            Side::Others => !own,
            Side::Own => own,
            Side::Listened => self.open.as_ref().is_some_and(|(request, request_end_ns, answer)| {
                answer.is_empty()
                    && request.first() == bytes.first()
                    && first_ns.saturating_sub(*request_end_ns) <= ANSWER_LIMIT_NS
            }),
        };
        if !answers {
            self.close();
            self.open = Some((bytes, end_ns, Vec::new()));
            return;
        }
        match &mut self.open {
            Some((_, last_ns, answer))
                if answer.len() < MAX_FRAMES && first_ns.saturating_sub(*last_ns) <= ANSWER_LIMIT_NS =>
            {
                answer.push(Frame { delay_ns: first_ns.saturating_sub(*last_ns), bytes });
                *last_ns = end_ns;
            }
            _ => self.dialog.left_out += 1,
        }
    }

    fn close(&mut self) {
        if let Some((request, _, answer)) = self.open.take() {
            self.dialog.add(request, answer);
        }
    }

    /// Frames of the recorded stack and of others so far.
    pub fn seen(&self) -> (u64, u64) {
        (self.own, self.others)
    }

    /// The table.
    pub fn finish(mut self) -> Dialog {
        self.close();
        self.dialog
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ipc_types::payload::Stamp;
    use proptest::prelude::*;

    fn chunk(first_ms: u64, end_ms: u64, flags: u32) -> SerialChunk {
        let stamp = Stamp { t_ns: end_ms * 1_000_000, ..Stamp::default() };
        SerialChunk { stamp, first_t_ns: first_ms * 1_000_000, flags, ..SerialChunk::default() }
    }

    const END: u32 = serial_flag::END;
    const OWN: u32 = serial_flag::END | serial_flag::TX_ECHO;

    fn frame(delay_ms: u64, bytes: &[u8]) -> Frame {
        Frame { delay_ns: delay_ms * 1_000_000, bytes: bytes.to_vec() }
    }

    #[test]
    fn answers_come_in_their_order_again_and_again() {
        let mut b = Builder::new(Side::Others);
        b.push(&chunk(0, 0, END), b"before any request");
        b.push(&chunk(10, 18, OWN), b"ask");
        b.push(&chunk(30, 33, END), b"one");
        b.push(&chunk(50, 58, OWN), b"ask");
        b.push(&chunk(60, 63, 0), b"t");
        b.push(&chunk(60, 63, END), b"wo");
        b.push(&chunk(68, 70, END), b"more");
        b.push(&chunk(100, 108, OWN), b"ask");
        b.push(&chunk(200, 208, OWN), b"other");
        b.push(&chunk(210, 218, END | serial_flag::PARITY), b"torn");
        b.push(&chunk(300, 308, OWN | serial_flag::NOT_SENT), b"never");
        assert_eq!(b.seen(), (4, 4));
        let mut dialog = b.finish();
        assert_eq!(dialog.contents(), Contents { requests: 2, answers: 4, silent: 2, left_out: 3 });
        for _ in 0..2 {
            assert_eq!(dialog.answer(b"ask"), Some(&[frame(12, b"one")][..]));
            assert_eq!(dialog.answer(b"ask"), Some(&[frame(2, b"two"), frame(5, b"more")][..]));
            assert_eq!(dialog.answer(b"ask"), Some(&[][..]));
        }
        assert_eq!(dialog.answer(b"other"), Some(&[][..]));
        assert_eq!(dialog.answer(b"never"), None);
    }

    #[test]
    fn the_recorded_stack_was_the_slave_or_only_listened() {
        let mut b = Builder::new(Side::Own);
        b.push(&chunk(10, 18, END), b"ask");
        b.push(&chunk(20, 25, OWN), b"answer");
        assert_eq!(b.finish().answer(b"ask"), Some(&[frame(2, b"answer")][..]));

        let mut b = Builder::new(Side::Listened);
        b.push(&chunk(0, 8, END), b"\x01ask");
        b.push(&chunk(20, 25, END), b"\x01answer");
        b.push(&chunk(30, 38, END), b"\x02ask");
        b.push(&chunk(60, 68, END), b"\x01ask");
        b.push(&chunk(6000, 6008, END), b"\x01ask");
        let mut dialog = b.finish();
        assert_eq!(dialog.answer(b"\x01ask"), Some(&[frame(12, b"\x01answer")][..]));
        assert_eq!(dialog.answer(b"\x02ask"), Some(&[][..]));
        assert_eq!(dialog.contents().answers, 4);
    }

    proptest! {
        #[test]
        fn never_panics(chunks in prop::collection::vec(
            (0u64..9000, 0u64..9000, any::<u32>(), prop::collection::vec(any::<u8>(), 0..4)), 0..60)) {
            for side in [Side::Others, Side::Own, Side::Listened] {
                let mut b = Builder::new(side);
                for (first, end, flags, bytes) in &chunks {
                    b.push(&chunk(*first, *end, *flags & 0x1FF), bytes);
                }
                let mut dialog = b.finish();
                for (_, _, _, bytes) in &chunks {
                    let _ = dialog.answer(bytes);
                }
            }
        }
    }
}
