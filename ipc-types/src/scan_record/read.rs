//! Reading a record where it lies, without believing a byte of it.

use super::write::{PATCH_BYTES, SOURCE_BYTES};
use super::*;

/// A validated content.
#[derive(Debug, Clone, Copy)]
pub struct Content<'a> {
    pub head: Head,
    bytes: &'a [u8],
}

/// One section.
#[derive(Debug, Clone)]
pub enum Section<'a> {
    Control {
        source: Source,
        command: Command<'a>,
    },
    /// A message of an input's owner: the ranges that changed.
    Input {
        source: Source,
        ranges: InputRanges<'a>,
    },
    /// A write request: applied iff `result` is 0.
    Write {
        source: Source,
        result: u32,
        tail: &'a [u8],
    },
    /// The force table after a change of it, whole.
    Forces(Vec<Patch>),
    Skipped {
        task: u16,
        periods: u64,
    },
    /// The tasks that wait for an event are due.
    Trigger(Trigger),
    Fault(Fault<'a>),
    Changes(Changes<'a>),
    Setup(&'a [u8]),
    Memory {
        offset: u32,
        bytes: &'a [u8],
    },
    Field(&'a [u8]),
    Schedule(TaskState),
    Quality(&'a [u8]),
    /// Of a later version; to be skipped.
    Unknown {
        tag: u8,
    },
}

impl<'a> Content<'a> {
    /// Validates head and every section.
    pub fn parse(bytes: &'a [u8]) -> Result<Self, RecordError> {
        let content = Self { head: head(bytes)?, bytes };
        let mut at = HEAD_BYTES;
        while at < bytes.len() {
            at = section(bytes, at)?.1;
        }
        Ok(content)
    }

    /// The sections, in order of application.
    pub fn sections(&self) -> Sections<'a> {
        Sections { bytes: self.bytes, at: HEAD_BYTES }
    }

    /// The bytes, whole.
    pub fn bytes(&self) -> &'a [u8] {
        self.bytes
    }

    /// Who the start, force or write came from is in the sections; this is the start itself.
    pub fn start(&self) -> Option<Start> {
        (self.head.kind == Kind::Scan).then(|| Start::from_u8(self.head.start)).flatten()
    }
}

/// Iterator over sections.
#[derive(Debug, Clone)]
pub struct Sections<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl<'a> Iterator for Sections<'a> {
    type Item = Section<'a>;
    fn next(&mut self) -> Option<Section<'a>> {
        if self.at >= self.bytes.len() {
            return None;
        }
        let (section, next) = section(self.bytes, self.at).ok()?;
        self.at = next;
        Some(section)
    }
}

/// `(range, quality, first byte within the range, bytes)` of an INPUT section.
#[derive(Debug, Clone)]
pub struct InputRanges<'a>(&'a [u8]);

impl<'a> Iterator for InputRanges<'a> {
    type Item = (u16, u8, u32, &'a [u8]);
    fn next(&mut self) -> Option<Self::Item> {
        let head = self.0.get(..12)?;
        let start = u32_at(head, 4)?;
        let len = u32_at(head, 8)? as usize;
        let bytes = self.0.get(12..12usize.checked_add(len)?)?;
        let item = (u16::from_le_bytes([head[0], head[1]]), head[2], start, bytes);
        self.0 = &self.0[12 + len..];
        Some(item)
    }
}

/// `(offset, bytes after the scan)` of a CHANGES section, rising.
#[derive(Debug, Clone)]
pub struct Changes<'a>(&'a [u8]);

impl<'a> Iterator for Changes<'a> {
    type Item = (u32, &'a [u8]);
    fn next(&mut self) -> Option<Self::Item> {
        let offset = u32_at(self.0, 0)?;
        let len = usize::from(u16::from_le_bytes([*self.0.get(4)?, *self.0.get(5)?]));
        let bytes = self.0.get(6..6 + len)?;
        self.0 = &self.0[6 + len..];
        Some((offset, bytes))
    }
}

fn u32_at(bytes: &[u8], at: usize) -> Option<u32> {
    Some(u32::from_le_bytes(bytes.get(at..at + 4)?.try_into().ok()?))
}
fn u64_at(bytes: &[u8], at: usize) -> Option<u64> {
    Some(u64::from_le_bytes(bytes.get(at..at + 8)?.try_into().ok()?))
}

fn head(bytes: &[u8]) -> Result<Head, RecordError> {
    let short = RecordError::Short(bytes.len());
    let head = bytes.get(..HEAD_BYTES).ok_or(short)?;
    if head[0] != VERSION {
        return Err(RecordError::Version(head[0]));
    }
    let kind = match head[1] {
        1 => Kind::Scan,
        2 => Kind::Keyframe,
        other => return Err(RecordError::Kind(other)),
    };
    let long = |at| u64_at(head, at).ok_or(short);
    let word = |at| u32_at(head, at).ok_or(short);
    Ok(Head {
        kind,
        state_before: head[2],
        state_after: head[3],
        start: head[4],
        outcome: head[5],
        flags: u16::from_le_bytes([head[6], head[7]]),
        scan: long(8)?,
        plc_time_ns: long(16)? as i64,
        t_ns: long(24)?,
        utc_ns: long(32)? as i64,
        program_hash: long(40)?,
        memory_hash: long(48)?,
        hash_offset: word(56)?,
        hash_len: word(60)?,
        tasks_ran: long(64)?,
        warnings: word(72)?,
    })
}

fn section(bytes: &[u8], at: usize) -> Result<(Section<'_>, usize), RecordError> {
    let truncated = RecordError::Truncated(at);
    let head = bytes.get(at..at + SECTION_BYTES).ok_or(truncated)?;
    let (tag, a, b) = (head[0], head[1], u16::from_le_bytes([head[2], head[3]]));
    let len = u32_at(head, 4).ok_or(truncated)? as usize;
    let start = at + SECTION_BYTES;
    let end = start.checked_add(len).ok_or(truncated)?;
    let body = bytes.get(start..end).ok_or(truncated)?;
    let section = decode(tag, a, b, body).ok_or(RecordError::Malformed { at, tag })?;
    Ok((section, end))
}

fn decode(tag: u8, a: u8, b: u16, body: &[u8]) -> Option<Section<'_>> {
    Some(match tag {
        tag::CONTROL => {
            Section::Control { source: source(body)?, command: command(a, b, &body[SOURCE_BYTES..])? }
        }
        tag::INPUT => {
            let ranges = InputRanges(body.get(SOURCE_BYTES..)?);
            let used: usize = ranges.clone().map(|(_, _, _, bytes)| 12 + bytes.len()).sum();
            if used != ranges.0.len() {
                return None;
            }
            Section::Input { source: source(body)?, ranges }
        }
        tag::WRITE => {
            Section::Write { source: source(body)?, result: u32::from(a), tail: body.get(SOURCE_BYTES..)? }
        }
        tag::FORCES => {
            if body.len() != usize::from(b) * PATCH_BYTES || usize::from(b) > MAX_FORCES {
                return None;
            }
            Section::Forces(body.chunks_exact(PATCH_BYTES).map(patch).collect::<Option<_>>()?)
        }
        tag::SKIPPED => Section::Skipped { task: b, periods: u64_at(body, 0)? },
        tag::TRIGGER => Section::Trigger(Trigger {
            source: source(body)?,
            count: u64_at(body, SOURCE_BYTES)?,
            missed: u64_at(body, SOURCE_BYTES + 8)?,
            overdue: a != 0,
        }),
        tag::FAULT => Section::Fault(Fault {
            task: a,
            trap: u32_at(body, 0)?,
            statement: u32_at(body, 4)?,
            instance: u32_at(body, 8)?,
            value: u64_at(body, 12)? as i64,
            real: f64::from_bits(u64_at(body, 20)?),
            text: std::str::from_utf8(body.get(28..)?).ok()?,
        }),
        tag::CHANGES => {
            let changes = Changes(body);
            let used: usize = changes.clone().map(|(_, bytes)| 6 + bytes.len()).sum();
            if used != body.len() {
                return None;
            }
            Section::Changes(changes)
        }
        tag::SETUP => Section::Setup(body),
        tag::MEMORY => Section::Memory { offset: u32_at(body, 0)?, bytes: &body[4..] },
        tag::FIELD => Section::Field(body),
        tag::SCHEDULE => Section::Schedule(TaskState {
            task: b,
            single: a != 0,
            next_ns: u64_at(body, 0)? as i64,
            skipped: u64_at(body, 8)?,
        }),
        tag::QUALITY => Section::Quality(body),
        tag => Section::Unknown { tag },
    })
}

fn source(body: &[u8]) -> Option<Source> {
    Some(Source { writer: u32_at(body, 0)?, generation: u32_at(body, 4)?, seq: u64_at(body, 8)? })
}

fn patch(body: &[u8]) -> Option<Patch> {
    let len = *body.get(4)?;
    if !(1..=8).contains(&len) {
        return None;
    }
    Some(Patch {
        offset: u32_at(body, 0)?,
        len,
        mask: body.get(8..16)?.try_into().ok()?,
        value: body.get(16..24)?.try_into().ok()?,
    })
}

fn command(code: u8, b: u16, rest: &[u8]) -> Option<Command<'_>> {
    let placed = || -> Option<(Patch, &str)> {
        Some((patch(rest)?, std::str::from_utf8(rest.get(PATCH_BYTES..)?).ok()?))
    };
    Some(match code {
        1 => Command::Stop,
        2 => Command::Start(Start::from_u8(u8::try_from(b).ok()?)?),
        3 => placed().map(|(patch, path)| Command::Force { patch, path })?,
        4 => placed().map(|(patch, path)| Command::Unforce { patch, path })?,
        5 => Command::UnforceAll,
        6 => placed().map(|(patch, path)| Command::Set { patch, path })?,
        7 => Command::Load { program_hash: u64_at(rest, 0)? },
        _ => return None,
    })
}
