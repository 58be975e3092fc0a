//! Records in parts of 2 KiB on the rail and in recordings, and whole again.

use crate::payload::{PART_BYTES, ScanPart, Stamp};

/// The parts of a content, in order; at least one.
pub fn parts(content: &[u8]) -> impl ExactSizeIterator<Item = &[u8]> {
    let count = content.len().div_ceil(PART_BYTES).max(1);
    (0..count).map(move |i| &content[i * PART_BYTES..content.len().min((i + 1) * PART_BYTES)])
}

/// Header of part `part` of a content of `total` bytes; port and tail length fill the rest.
pub fn part_header(scan: u64, part: usize, total: usize) -> ScanPart {
    ScanPart {
        scan,
        part: part as u32,
        parts: total.div_ceil(PART_BYTES).max(1) as u32,
        total: total as u32,
        ..ScanPart::default()
    }
}

/// A joined content.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Whole<'a> {
    pub writer: u32,
    pub generation: u32,
    pub scan: u64,
    pub bytes: &'a [u8],
}

/// Something is missing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Gap {
    /// Last content that was whole: (generation, scan); zeros when there was none.
    pub after: (u32, u64),
    /// Content at which the loss was seen: (generation, scan).
    pub before: (u32, u64),
    /// Messages lost by their numbers; 0 when a writer died in the middle of a content.
    pub messages: u64,
}

/// What [`Joiner::push`] found.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct JoinStep<'a> {
    pub gap: Option<Gap>,
    pub whole: Option<Whole<'a>>,
}

/// Joins the parts of one topic. Contents above `max_bytes` are dropped and reported as a gap.
#[derive(Debug)]
pub struct Joiner {
    buffer: Vec<u8>,
    max_bytes: usize,
    last: Stamp,
    current: Option<(u64, u32, u32)>,
    next_part: u32,
    done: (u32, u64),
}

impl Joiner {
    pub fn new(max_bytes: usize) -> Self {
        Self {
            buffer: Vec::new(),
            max_bytes,
            last: Stamp::default(),
            current: None,
            next_part: 0,
            done: (0, 0),
        }
    }

    /// Takes one message of the topic, in order of `seq`.
    pub fn push(&mut self, header: &ScanPart, tail: &[u8]) -> JoinStep<'_> {
        let stamp = header.stamp;
        let before = (stamp.generation, header.scan);
        let mut lost = 0;
        let mut broken = false;
        let same_writer = stamp.writer == self.last.writer && stamp.generation == self.last.generation;
        if same_writer {
            lost = stamp.seq.saturating_sub(self.last.seq.saturating_add(1));
        }
        if lost > 0 || !same_writer {
            broken |= self.current.take().is_some();
        }
        self.last = stamp;
        let identity = (header.scan, header.parts, header.total);
        let fits = header.parts as usize == (header.total as usize).div_ceil(PART_BYTES).max(1)
            && header.total as usize <= self.max_bytes
            && header.part < header.parts
            && tail.len() == expected_len(header);
        if !fits {
            broken = true;
            self.current = None;
        } else if header.part == 0 {
            broken |= self.current.is_some();
            self.buffer.clear();
            self.current = Some(identity);
            self.next_part = 0;
        } else if self.current != Some(identity) || self.next_part != header.part {
            // The middle of something whose beginning was lost; the loss itself was counted by `seq`, or is
            // the first thing seen at all.
            broken |= self.current.take().is_some() || !same_writer;
        }
        let gap = (lost > 0 || broken).then_some(Gap { after: self.done, before, messages: lost });
        let mut whole = None;
        if self.current == Some(identity) {
            self.buffer.extend_from_slice(tail);
            self.next_part += 1;
            if self.next_part == header.parts {
                self.current = None;
                self.done = before;
                whole = Some(Whole {
                    writer: stamp.writer,
                    generation: stamp.generation,
                    scan: header.scan,
                    bytes: &self.buffer,
                });
            }
        }
        JoinStep { gap, whole }
    }
}

fn expected_len(header: &ScanPart) -> usize {
    let start = header.part as usize * PART_BYTES;
    (header.total as usize).saturating_sub(start).min(PART_BYTES)
}
