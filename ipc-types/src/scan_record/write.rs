//! Writing a record into a buffer that exists already.

use super::*;

/// Builds one content at a time in a buffer of fixed size.
#[derive(Debug)]
pub struct Writer {
    buffer: Vec<u8>,
    limit: usize,
    overflowed: bool,
}

impl Writer {
    /// With room for `limit` bytes; the only allocation. `limit` is raised to one head at least.
    pub fn new(limit: usize) -> Self {
        let limit = limit.max(HEAD_BYTES);
        Self { buffer: Vec::with_capacity(limit), limit, overflowed: false }
    }

    /// Starts a new content; the head is filled by [`Self::finish`].
    pub fn begin(&mut self) {
        self.buffer.clear();
        self.buffer.resize(HEAD_BYTES, 0);
        self.overflowed = false;
    }

    /// Whether a section was left out since [`Self::begin`].
    pub fn overflowed(&self) -> bool {
        self.overflowed
    }

    /// Writes the head in front and hands out the content.
    pub fn finish(&mut self, head: &Head) -> &[u8] {
        let mut head = *head;
        if self.overflowed {
            head.flags |= flag::INCOMPLETE;
        }
        let bytes = encode_head(&head);
        if let Some(place) = self.buffer.get_mut(..HEAD_BYTES) {
            place.copy_from_slice(&bytes);
        }
        &self.buffer
    }

    /// The content as finished last.
    pub fn content(&self) -> &[u8] {
        &self.buffer
    }

    fn section(&mut self, tag: u8, a: u8, b: u16, parts: &[&[u8]]) {
        let len: usize = parts.iter().map(|p| p.len()).sum();
        if !self.open(tag, a, b, len) {
            return;
        }
        for part in parts {
            self.buffer.extend_from_slice(part);
        }
    }

    fn open(&mut self, tag: u8, a: u8, b: u16, len: usize) -> bool {
        if self.buffer.len() + SECTION_BYTES + len > self.limit {
            self.overflowed = true;
            return false;
        }
        self.buffer.extend_from_slice(&[tag, a]);
        self.buffer.extend_from_slice(&b.to_le_bytes());
        self.buffer.extend_from_slice(&(len as u32).to_le_bytes());
        true
    }

    pub fn control(&mut self, source: &Source, command: &Command<'_>) {
        let source = encode_source(source);
        match command {
            Command::Stop => self.section(tag::CONTROL, 1, 0, &[&source]),
            Command::Start(kind) => self.section(tag::CONTROL, 2, *kind as u16, &[&source]),
            Command::Force { patch, path } => {
                self.section(tag::CONTROL, 3, 0, &[&source, &encode_patch(patch), path.as_bytes()]);
            }
            Command::Unforce { patch, path } => {
                self.section(tag::CONTROL, 4, 0, &[&source, &encode_patch(patch), path.as_bytes()]);
            }
            Command::UnforceAll => self.section(tag::CONTROL, 5, 0, &[&source]),
            Command::Set { patch, path } => {
                self.section(tag::CONTROL, 6, 0, &[&source, &encode_patch(patch), path.as_bytes()]);
            }
            Command::Load { program_hash } => {
                self.section(tag::CONTROL, 7, 0, &[&source, &program_hash.to_le_bytes()]);
            }
        }
    }

    /// Opens an INPUT section; [`Self::input_range`]s follow until [`Self::input_end`].
    pub fn input_begin(&mut self, source: &Source) -> usize {
        let at = self.buffer.len();
        self.section(tag::INPUT, 0, 0, &[&encode_source(source)]);
        at
    }

    /// One range of the open INPUT section: quality and the bytes of it that changed, from byte `start` of it.
    pub fn input_range(&mut self, range: u16, quality: u8, start: u32, bytes: &[u8]) {
        if self.overflowed || self.buffer.len() + 12 + bytes.len() > self.limit {
            self.overflowed = true;
            return;
        }
        self.buffer.extend_from_slice(&range.to_le_bytes());
        self.buffer.extend_from_slice(&[quality, 0]);
        self.buffer.extend_from_slice(&start.to_le_bytes());
        self.buffer.extend_from_slice(&(bytes.len() as u32).to_le_bytes());
        self.buffer.extend_from_slice(bytes);
    }

    /// Closes the INPUT section that was opened at `at`.
    pub fn input_end(&mut self, at: usize) {
        let len = self.buffer.len().saturating_sub(at + SECTION_BYTES) as u32;
        if let Some(place) = self.buffer.get_mut(at + 4..at + 8) {
            place.copy_from_slice(&len.to_le_bytes());
        }
    }

    /// `result` as in `payload::Image::ack_result`; the tail as it came.
    pub fn write(&mut self, source: &Source, result: u32, tail: &[u8]) {
        self.section(tag::WRITE, result as u8, 0, &[&encode_source(source), tail]);
    }

    /// The whole force table.
    pub fn forces(&mut self, table: &[Patch]) {
        let table = &table[..table.len().min(MAX_FORCES)];
        if !self.open(tag::FORCES, 0, table.len() as u16, table.len() * PATCH_BYTES) {
            return;
        }
        for patch in table {
            self.buffer.extend_from_slice(&encode_patch(patch));
        }
    }

    /// A task that came late: so many of its periods were skipped in this scan.
    pub fn skipped(&mut self, task: u16, periods: u64) {
        self.section(tag::SKIPPED, 0, task, &[&periods.to_le_bytes()]);
    }

    /// The tasks that wait for an event are due.
    pub fn trigger(&mut self, trigger: &Trigger) {
        self.section(
            tag::TRIGGER,
            u8::from(trigger.overdue),
            0,
            &[&encode_source(&trigger.source), &trigger.count.to_le_bytes(), &trigger.missed.to_le_bytes()],
        );
    }

    pub fn fault(&mut self, fault: &Fault<'_>) {
        self.section(
            tag::FAULT,
            fault.task,
            0,
            &[
                &fault.trap.to_le_bytes(),
                &fault.statement.to_le_bytes(),
                &fault.instance.to_le_bytes(),
                &fault.value.to_le_bytes(),
                &fault.real.to_bits().to_le_bytes(),
                fault.text.as_bytes(),
            ],
        );
    }

    /// Opens a CHANGES section; [`Self::change`]s follow until [`Self::changes_end`].
    pub fn changes_begin(&mut self) -> usize {
        let at = self.buffer.len();
        self.section(tag::CHANGES, 0, 0, &[]);
        at
    }

    /// Bytes of memory after the scan that differ from those before it.
    pub fn change(&mut self, offset: u32, bytes: &[u8]) {
        let mut offset = offset;
        for piece in bytes.chunks(usize::from(u16::MAX)) {
            if self.overflowed || self.buffer.len() + 6 + piece.len() > self.limit {
                self.overflowed = true;
                return;
            }
            self.buffer.extend_from_slice(&offset.to_le_bytes());
            self.buffer.extend_from_slice(&(piece.len() as u16).to_le_bytes());
            self.buffer.extend_from_slice(piece);
            offset += piece.len() as u32;
        }
    }

    /// Closes the CHANGES section that was opened at `at`; an empty one vanishes.
    pub fn changes_end(&mut self, at: usize) {
        let len = self.buffer.len().saturating_sub(at + SECTION_BYTES);
        if len == 0 && self.buffer.len() >= at + SECTION_BYTES {
            self.buffer.truncate(at);
        } else if let Some(place) = self.buffer.get_mut(at + 4..at + 8) {
            place.copy_from_slice(&(len as u32).to_le_bytes());
        }
    }

    /// Keyframe: how the engine is set up, JSON.
    pub fn setup(&mut self, json: &[u8]) {
        self.section(tag::SETUP, 0, 0, &[json]);
    }
    /// Keyframe: memory from `offset`.
    pub fn memory(&mut self, offset: u32, bytes: &[u8]) {
        self.section(tag::MEMORY, 0, 0, &[&offset.to_le_bytes(), bytes]);
    }
    /// Keyframe: %I as the field delivered it, without forces.
    pub fn field(&mut self, bytes: &[u8]) {
        self.section(tag::FIELD, 0, 0, &[bytes]);
    }
    /// Keyframe: schedule of a task.
    pub fn schedule(&mut self, task: &TaskState) {
        self.section(
            tag::SCHEDULE,
            u8::from(task.single),
            task.task,
            &[&task.next_ns.to_le_bytes(), &task.skipped.to_le_bytes()],
        );
    }
    /// Keyframe: quality of every input range.
    pub fn quality(&mut self, ranges: &[u8]) {
        self.section(tag::QUALITY, 0, 0, &[ranges]);
    }
}

pub(super) const PATCH_BYTES: usize = 24;
pub(super) const SOURCE_BYTES: usize = 16;

fn encode_head(head: &Head) -> [u8; HEAD_BYTES] {
    let mut out = [0u8; HEAD_BYTES];
    out[0] = VERSION;
    out[1] = head.kind as u8;
    out[2] = head.state_before;
    out[3] = head.state_after;
    out[4] = head.start;
    out[5] = head.outcome;
    out[6..8].copy_from_slice(&head.flags.to_le_bytes());
    out[8..16].copy_from_slice(&head.scan.to_le_bytes());
    out[16..24].copy_from_slice(&head.plc_time_ns.to_le_bytes());
    out[24..32].copy_from_slice(&head.t_ns.to_le_bytes());
    out[32..40].copy_from_slice(&head.utc_ns.to_le_bytes());
    out[40..48].copy_from_slice(&head.program_hash.to_le_bytes());
    out[48..56].copy_from_slice(&head.memory_hash.to_le_bytes());
    out[56..60].copy_from_slice(&head.hash_offset.to_le_bytes());
    out[60..64].copy_from_slice(&head.hash_len.to_le_bytes());
    out[64..72].copy_from_slice(&head.tasks_ran.to_le_bytes());
    out[72..76].copy_from_slice(&head.warnings.to_le_bytes());
    out
}

fn encode_source(source: &Source) -> [u8; SOURCE_BYTES] {
    let mut out = [0u8; SOURCE_BYTES];
    out[..4].copy_from_slice(&source.writer.to_le_bytes());
    out[4..8].copy_from_slice(&source.generation.to_le_bytes());
    out[8..].copy_from_slice(&source.seq.to_le_bytes());
    out
}

fn encode_patch(patch: &Patch) -> [u8; PATCH_BYTES] {
    let mut out = [0u8; PATCH_BYTES];
    out[..4].copy_from_slice(&patch.offset.to_le_bytes());
    out[4] = patch.len;
    out[8..16].copy_from_slice(&patch.mask);
    out[16..].copy_from_slice(&patch.value);
    out
}
