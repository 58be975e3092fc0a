//! Content of scan records and keyframes: everything a scan of the PLC was a function of, and what came out.
//!
//! A **scan record** holds one scan: stamps, consumed inputs by value, writes, control commands, forces, tasks
//! that ran, outcome, changed memory and a hash of the memory, in order of application. With the program and a
//! **keyframe** (the whole memory at one moment) every later scan can be computed again, bit for bit, from its
//! record alone. Both travel as [`crate::payload::ScanPart`]s of 2 KiB, see [`parts`] and [`Joiner`].
//!
//! # Layout
//!
//! All little-endian, packed:
//!
//! ```text
//! head      80 bytes, see [`Head`]
//! section*  { tag u8, a u8, b u16, len u32 } + len bytes, in order of application
//! ```
//!
//! Offsets of memory are those of the engine's memory: SYSTEM (256 bytes), %I, %Q, %M, RETAIN, DATA, each at a
//! multiple of 8; the sizes stand in the keyframe's SETUP section.
//!
//! What this module must never do: allocate in [`Writer`] once it exists, or panic on bytes it reads.

mod join;
mod read;
mod write;

pub use join::{Gap, JoinStep, Joiner, Whole, part_header, parts};
pub use read::{Changes, Content, InputRanges, Section, Sections};
pub use write::Writer;

/// Version of the layout; another one is refused.
pub const VERSION: u8 = 1;
/// Bytes of the head.
pub const HEAD_BYTES: usize = 80;
/// Bytes of a section's head.
pub const SECTION_BYTES: usize = 8;
/// Largest scan record. What does not fit is left out, and the record says so ([`flag::INCOMPLETE`]).
pub const MAX_RECORD_BYTES: usize = 512 * 1024;
/// Largest keyframe: the compiler's limit of memory, the image and some kilobytes.
pub const MAX_KEYFRAME_BYTES: usize = 18 * 1024 * 1024;
/// Most forced variables.
pub const MAX_FORCES: usize = 256;

/// Bits of [`Head::flags`].
pub mod flag {
    /// The record did not fit: the scan cannot be verified.
    pub const INCOMPLETE: u16 = 1;
    /// First scan after a cold or warm start.
    pub const FIRST_SCAN: u16 = 2;
    /// Changed DATA was cut at its limit; the memory hash still covers all of it.
    pub const DATA_CUT: u16 = 4;
}

/// Tags of sections. Numbers are never used again.
pub mod tag {
    pub const CONTROL: u8 = 1;
    pub const INPUT: u8 = 2;
    pub const WRITE: u8 = 3;
    pub const FORCES: u8 = 4;
    pub const SKIPPED: u8 = 5;
    pub const FAULT: u8 = 6;
    pub const CHANGES: u8 = 7;
    /// Reserved for frames that the program received.
    pub const FRAMES: u8 = 8;
    /// Reserved for results of jobs that the program asked for.
    pub const RESULTS: u8 = 9;
    pub const TRIGGER: u8 = 10;
    pub const SETUP: u8 = 16;
    pub const MEMORY: u8 = 17;
    pub const FIELD: u8 = 18;
    pub const SCHEDULE: u8 = 19;
    pub const QUALITY: u8 = 20;
}

/// Whether a content is a scan record or a keyframe.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum Kind {
    Scan = 1,
    Keyframe = 2,
}

/// Kinds of start.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
#[repr(u8)]
pub enum Start {
    /// Everything initial, RETAIN too.
    Cold = 1,
    /// RETAIN kept, the rest initial.
    Warm = 2,
    /// Everything kept.
    Hot = 3,
}

impl Start {
    pub fn from_u8(n: u8) -> Option<Self> {
        Some(match n {
            1 => Self::Cold,
            2 => Self::Warm,
            3 => Self::Hot,
            _ => return None,
        })
    }
    pub fn word(self) -> &'static str {
        match self {
            Self::Cold => "cold",
            Self::Warm => "warm",
            Self::Hot => "hot",
        }
    }
}

/// What became of a scan's tasks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum Outcome {
    /// All due tasks ran to their end.
    Ok = 0,
    /// A task faulted; the FAULT section says how. Watchdog too.
    Trap = 1,
    /// The engine is stopped, faulted or has no program: no task ran.
    Idle = 2,
}

/// Why a keyframe was taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
#[repr(u8)]
pub enum Reason {
    EngineStart = 1,
    Load = 2,
    Trap = 3,
    /// Every 10 s.
    Periodic = 4,
    Request = 5,
}

/// The fixed head of both kinds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Head {
    pub kind: Kind,
    /// `PlcState` before the scan; of a keyframe: the state.
    pub state_before: u8,
    /// `PlcState` after the scan.
    pub state_after: u8,
    /// [`Start`] that happened in the scan, 0 = none; of a keyframe: [`Reason`].
    pub start: u8,
    /// [`Outcome`].
    pub outcome: u8,
    /// [`flag`]s.
    pub flags: u16,
    /// Number of the scan, from 1; 0 = before the first.
    pub scan: u64,
    /// PLC time of the scan.
    pub plc_time_ns: i64,
    /// CLOCK_MONOTONIC of the scan.
    pub t_ns: u64,
    /// UTC of the scan.
    pub utc_ns: i64,
    /// XXH3-64 of the program's module; 0 without program.
    pub program_hash: u64,
    /// XXH3-64 of `hash_len` bytes of memory from `hash_offset`, after the scan.
    pub memory_hash: u64,
    pub hash_offset: u32,
    pub hash_len: u32,
    /// Tasks that ran, bit by index in the task table.
    pub tasks_ran: u64,
    /// Warnings of the program since its start (MOD by zero).
    pub warnings: u32,
}

impl Default for Head {
    fn default() -> Self {
        Self {
            kind: Kind::Scan,
            state_before: 0,
            state_after: 0,
            start: 0,
            outcome: 0,
            flags: 0,
            scan: 0,
            plc_time_ns: 0,
            t_ns: 0,
            utc_ns: 0,
            program_hash: 0,
            memory_hash: 0,
            hash_offset: 0,
            hash_len: 0,
            tasks_ran: 0,
            warnings: 0,
        }
    }
}

/// Who sent what was applied.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Source {
    pub writer: u32,
    pub generation: u32,
    pub seq: u64,
}

/// At most 8 bytes of memory with the bits that count: a forced or set value.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Patch {
    pub offset: u32,
    /// 1-8.
    pub len: u8,
    pub mask: [u8; 8],
    pub value: [u8; 8],
}

impl Patch {
    /// `new = (old & !mask) | (value & mask)`. `false`, and nothing changed, outside the memory.
    #[must_use]
    pub fn apply(&self, memory: &mut [u8]) -> bool {
        let start = self.offset as usize;
        let len = usize::from(self.len).min(8);
        let Some(target) = start.checked_add(len).and_then(|end| memory.get_mut(start..end)) else {
            return false;
        };
        for (i, old) in target.iter_mut().enumerate() {
            *old = (*old & !self.mask[i]) | (self.value[i] & self.mask[i]);
        }
        true
    }
    /// Whether both patches concern the same bits.
    pub fn same_place(&self, other: &Self) -> bool {
        self.offset == other.offset && self.len == other.len && self.mask == other.mask
    }
}

/// A control command.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Command<'a> {
    Stop,
    Start(Start),
    Force {
        patch: Patch,
        path: &'a str,
    },
    Unforce {
        patch: Patch,
        path: &'a str,
    },
    UnforceAll,
    /// A variable is set once.
    Set {
        patch: Patch,
        path: &'a str,
    },
    /// A program was loaded before this scan; a keyframe precedes it.
    Load {
        program_hash: u64,
    },
}

/// What stopped a task.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Fault<'a> {
    /// Index in the task table.
    pub task: u8,
    /// Number of the compiler's `TrapId`.
    pub trap: u32,
    pub statement: u32,
    pub instance: u32,
    pub value: i64,
    pub real: f64,
    /// The fault as the user reads it.
    pub text: &'a str,
}

/// The tasks without INTERVAL and SINGLE are due in this scan: the event came that the stack file names as trigger,
/// or it has not come for too long.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Trigger {
    /// Message that told of it; without event: the last one of the service.
    pub source: Source,
    /// Number of the event since the start of that service.
    pub count: u64,
    /// Events before it, since the last scan that was triggered, that no scan was triggered by.
    pub missed: u64,
    /// No event: `max_interval` is over.
    pub overdue: bool,
}

/// Where a task stands in its schedule.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct TaskState {
    pub task: u16,
    /// PLC time from which it is due; of a task that waits for an event: the largest number.
    pub next_ns: i64,
    /// Last value of its SINGLE.
    pub single: bool,
    /// Periods skipped since the start.
    pub skipped: u64,
}

/// Why bytes are no record.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum RecordError {
    #[error("scan record: {0} bytes are too few for a head")]
    Short(usize),
    #[error("scan record: layout version {0}; this program reads version {VERSION}")]
    Version(u8),
    #[error("scan record: kind {0} is neither scan nor keyframe")]
    Kind(u8),
    #[error("scan record: the section at byte {0} reaches beyond the end")]
    Truncated(usize),
    #[error("scan record: the section at byte {at} (tag {tag}) is malformed")]
    Malformed { at: usize, tag: u8 },
}

#[cfg(test)]
mod tests;
