//! The two halves of a block transfer that client and server share: who sends sub-blocks and who receives them
//! (CiA 301 V4.2, 7.2.4.3.9 and 7.2.4.3.13).

use super::frame::{Bytes, MAX_BLOCK, SEGMENT, send};
use crate::protocol::abort::Abort;
use crate::protocol::io::Outbox;

/// Acknowledges in a row that confirm nothing before the sender gives up.
const FRUITLESS: u8 = 16;

/// Sends sub-blocks of up to 127 segments and repeats what was not confirmed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct BlockSender {
    /// Bytes that were confirmed.
    pub at: usize,
    /// Segments the receiver takes in one sub-block.
    pub size: u8,
    /// Segments of the present sub-block.
    pub sent: u8,
    fruitless: u8,
}

impl BlockSender {
    /// A transfer at its start; [`Abort::BLOCK_SIZE`] unless `size` is 1-127.
    pub fn new(size: u8) -> Result<Self, Abort> {
        check_size(size)?;
        Ok(Self { at: 0, size, sent: 0, fruitless: 0 })
    }
    /// Sends the sub-block behind what was confirmed. Empty data is one segment.
    pub fn send(&mut self, data: &[u8], can_id: u32, out: &mut Outbox) {
        let rest = data.get(self.at..).unwrap_or(&[]);
        let segments = rest.len().div_ceil(SEGMENT).max(1);
        self.sent = segments.min(usize::from(self.size)) as u8;
        for seq in 1..=self.sent {
            let from = usize::from(seq - 1) * SEGMENT;
            let part = &rest[from..(from + SEGMENT).min(rest.len())];
            let mut bytes: Bytes = [0; 8];
            let last = usize::from(seq) == segments;
            bytes[0] = seq | if last { 0x80 } else { 0 };
            bytes[1..=part.len()].copy_from_slice(part);
            send(out, can_id, bytes);
        }
    }
    /// Takes an acknowledge: `Ok(true)` when everything is confirmed, `Ok(false)` when the next sub-block is to be
    /// sent. [`Abort::SEQUENCE`] if it confirms what was never sent, or nothing too often.
    pub fn acknowledge(&mut self, seq: u8, size: u8, len: usize) -> Result<bool, Abort> {
        if seq > self.sent {
            return Err(Abort::SEQUENCE);
        }
        if seq == 0 {
            self.fruitless += 1;
            if self.fruitless >= FRUITLESS {
                return Err(Abort::SEQUENCE);
            }
        } else {
            self.fruitless = 0;
        }
        self.at += usize::from(seq) * SEGMENT;
        if self.at >= len.max(1) {
            return Ok(true);
        }
        check_size(size)?;
        self.size = size;
        Ok(false)
    }
    /// Bytes of the last segment that carry no data.
    pub fn unused(len: usize) -> u8 {
        (len.div_ceil(SEGMENT).max(1) * SEGMENT - len) as u8
    }
}

/// [`Abort::BLOCK_SIZE`] unless 1-127.
pub(super) fn check_size(size: u8) -> Result<(), Abort> {
    if (1..=MAX_BLOCK).contains(&size) { Ok(()) } else { Err(Abort::BLOCK_SIZE) }
}

/// What a segment led to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Step {
    /// The sub-block goes on.
    Wait,
    /// The sub-block is over: acknowledge this sequence number and wait for the next.
    Acknowledge(u8),
    /// The last segment is in: acknowledge this sequence number and wait for the end.
    Complete(u8),
}

/// Receives sub-blocks in order; what comes behind a gap is dropped and not confirmed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct BlockReceiver {
    /// Segments we take in one sub-block.
    pub size: u8,
    /// Last sequence number that came in order.
    good: u8,
    /// Something of this sub-block came.
    pub seen: bool,
    /// Last sequence number of the sub-block before: a repeated frame of it is none of this one.
    before: u8,
}

impl BlockReceiver {
    pub fn new(size: u8) -> Self {
        Self { size, good: 0, seen: false, before: 0 }
    }
    /// Takes a segment and appends its data to `buffer`, which never grows above `limit` + 6 bytes; `None` if it
    /// would.
    pub fn segment(
        &mut self,
        bytes: &Bytes,
        buffer: &mut Vec<u8>,
        limit: usize,
    ) -> Option<Result<Step, Abort>> {
        let (seq, last) = (bytes[0] & 0x7F, bytes[0] & 0x80 != 0);
        if seq == 0 || seq > self.size {
            return Some(Err(Abort::SEQUENCE));
        }
        if self.good == 0 && seq != 1 && seq == self.before {
            self.before = 0;
            self.seen = true;
            return Some(Ok(Step::Wait));
        }
        self.seen = true;
        if seq <= self.good {
            return Some(Ok(Step::Wait));
        }
        let in_order = seq == self.good + 1;
        if in_order {
            if buffer.len() >= limit.max(1) {
                return None;
            }
            buffer.extend_from_slice(&bytes[1..8]);
            self.good = seq;
        }
        Some(Ok(match (last, in_order) {
            (true, true) => Step::Complete(self.good),
            (false, _) if seq < self.size => Step::Wait,
            _ => Step::Acknowledge(self.next()),
        }))
    }
    /// Ends the sub-block: the sequence number to acknowledge.
    pub fn next(&mut self) -> u8 {
        self.before = self.good;
        self.seen = false;
        std::mem::take(&mut self.good)
    }
    /// The last segment that came in order, for telling a repeated one.
    pub fn last(&self) -> u8 {
        self.good
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unused_bytes() {
        for (len, unused) in [(0, 7), (1, 6), (6, 1), (7, 0), (8, 6), (14, 0)] {
            assert_eq!(BlockSender::unused(len), unused, "{len}");
        }
    }

    #[test]
    fn what_is_lost_is_sent_again() {
        let data: Vec<u8> = (0..100).collect();
        let (mut sender, mut receiver) = (BlockSender::new(5).unwrap(), BlockReceiver::new(5));
        let (mut got, mut round) = (Vec::new(), 0);
        loop {
            let mut out = Outbox::default();
            sender.send(&data, 0x600, &mut out);
            let mut acknowledge = None;
            for (at, frame) in out.frames().iter().enumerate() {
                if round % 3 == 0 && at == 2 {
                    continue; // lost
                }
                let bytes: Bytes = frame.data[..8].try_into().unwrap();
                match receiver.segment(&bytes, &mut got, 100).unwrap().unwrap() {
                    Step::Wait => {}
                    Step::Acknowledge(seq) | Step::Complete(seq) => acknowledge = Some(seq),
                }
            }
            round += 1;
            let seq = acknowledge.unwrap_or_else(|| receiver.next()); // the end was lost
            if sender.acknowledge(seq, 5, data.len()).unwrap() {
                break;
            }
        }
        assert!(round > 4);
        assert_eq!(&got[..100], &data[..]);
        assert_eq!(got.len(), 105);
    }

    #[test]
    fn faults() {
        assert_eq!(BlockSender::new(0), Err(Abort::BLOCK_SIZE));
        assert_eq!(BlockSender::new(128), Err(Abort::BLOCK_SIZE));
        let mut out = Outbox::default();
        let mut sender = BlockSender::new(127).unwrap();
        sender.send(&[1; 20], 1, &mut out);
        assert_eq!(sender.sent, 3);
        assert_eq!(sender.acknowledge(4, 127, 20), Err(Abort::SEQUENCE));
        assert_eq!(sender.acknowledge(1, 0, 20), Err(Abort::BLOCK_SIZE));
        let mut sender = BlockSender::new(127).unwrap();
        sender.send(&[1; 20], 1, &mut out);
        let fruitless = (0..20).map(|_| sender.acknowledge(0, 127, 20)).find(Result::is_err);
        assert_eq!(fruitless, Some(Err(Abort::SEQUENCE)));
        let mut receiver = BlockReceiver::new(4);
        let mut buffer = Vec::new();
        assert_eq!(receiver.segment(&[0; 8], &mut buffer, 9), Some(Err(Abort::SEQUENCE)));
        assert_eq!(receiver.segment(&[5; 8], &mut buffer, 9), Some(Err(Abort::SEQUENCE)));
        assert_eq!(receiver.segment(&[1; 8], &mut buffer, 9), Some(Ok(Step::Wait)));
        assert_eq!(receiver.segment(&[2; 8], &mut buffer, 9), Some(Ok(Step::Wait)));
        assert_eq!(receiver.segment(&[3; 8], &mut buffer, 9), None);
    }
}
