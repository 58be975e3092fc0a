//! The one table of topics: which payload, how deep, what happens when a reader is late.
//!
//! Services name topics `<service>/<suffix>`; the launcher creates every one with these limits before it starts
//! a process and holds it, so that a service that dies while it starts can never leave a half-made one.

use crate::payload::{
    CHUNK_BYTES, CanFrame, Encoding, Event, Health, Image, ImageWrite, Inputs, Job, JobResult, PART_BYTES,
    Payload, ScanPart, SerialChunk, Status,
};
use serde::{Deserialize, Serialize};

/// What happens to a message when a reader's queue is full.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum WhenFull {
    /// The oldest message is replaced; the reader sees a gap in `seq`. The writer never waits.
    Oldest,
    /// The new message is refused and the writer is told. Such a topic has exactly one reader, its consumer:
    /// a slow second one would stop the writers.
    Refuse,
}

/// The kinds of topics.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TopicKind {
    CanRx,
    CanTx,
    SerialRx,
    SerialTx,
    Inputs,
    Image,
    Writes,
    Scan,
    Keyframe,
    Jobs,
    Results,
    Health,
    Status,
    Events,
}

/// One row of the table.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TopicRow {
    /// Second part of the topic's name.
    pub suffix: &'static str,
    /// Type name of the payload.
    pub payload: &'static str,
    /// Messages a reader's queue holds. A rate times 0.5 s for bus frames.
    pub depth: u32,
    /// Largest tail in bytes; 0 for headers without tail.
    pub max_tail: u32,
    pub when_full: WhenFull,
    /// The newest message is handed to a reader that comes late. Its writer repeats it every 100 ms at least,
    /// because iceoryx2 hands history over only when the writer sends.
    pub history: bool,
    /// Becomes a channel of the recording.
    pub recorded: bool,
}

/// Calls `$body` with `$t` bound to the payload type of `$kind`.
#[macro_export]
macro_rules! with_payload {
    ($kind:expr, $t:ident => $body:expr) => {
        match $kind {
            $crate::topic::TopicKind::CanRx | $crate::topic::TopicKind::CanTx => {
                type $t = $crate::payload::CanFrame;
                $body
            }
            $crate::topic::TopicKind::SerialRx | $crate::topic::TopicKind::SerialTx => {
                type $t = $crate::payload::SerialChunk;
                $body
            }
            $crate::topic::TopicKind::Inputs => {
                type $t = $crate::payload::Inputs;
                $body
            }
            $crate::topic::TopicKind::Image => {
                type $t = $crate::payload::Image;
                $body
            }
            $crate::topic::TopicKind::Writes => {
                type $t = $crate::payload::ImageWrite;
                $body
            }
            $crate::topic::TopicKind::Scan | $crate::topic::TopicKind::Keyframe => {
                type $t = $crate::payload::ScanPart;
                $body
            }
            $crate::topic::TopicKind::Jobs => {
                type $t = $crate::payload::Job;
                $body
            }
            $crate::topic::TopicKind::Results => {
                type $t = $crate::payload::JobResult;
                $body
            }
            $crate::topic::TopicKind::Health => {
                type $t = $crate::payload::Health;
                $body
            }
            $crate::topic::TopicKind::Status => {
                type $t = $crate::payload::Status;
                $body
            }
            $crate::topic::TopicKind::Events => {
                type $t = $crate::payload::Event;
                $body
            }
        }
    };
}

impl TopicKind {
    /// Every kind, for tables and tests.
    pub const ALL: [Self; 14] = [
        Self::CanRx,
        Self::CanTx,
        Self::SerialRx,
        Self::SerialTx,
        Self::Inputs,
        Self::Image,
        Self::Writes,
        Self::Scan,
        Self::Keyframe,
        Self::Jobs,
        Self::Results,
        Self::Health,
        Self::Status,
        Self::Events,
    ];

    /// The row of this kind.
    pub const fn row(self) -> TopicRow {
        use WhenFull::{Oldest, Refuse};
        const fn row(
            suffix: &'static str,
            payload: &'static str,
            depth: u32,
            max_tail: u32,
            when_full: WhenFull,
            history: bool,
            recorded: bool,
        ) -> TopicRow {
            TopicRow { suffix, payload, depth, max_tail, when_full, history, recorded }
        }
        match self {
            Self::CanRx => row("rx", CanFrame::NAME, 4096, 0, Oldest, false, true),
            Self::CanTx => row("tx", CanFrame::NAME, 1024, 0, Refuse, false, false),
            // 0.5 s of the shortest RTU frames at 115200 baud are some 200; short raw chunks come faster.
            Self::SerialRx => row("rx", SerialChunk::NAME, 1024, CHUNK_BYTES as u32, Oldest, false, true),
            Self::SerialTx => row("tx", SerialChunk::NAME, 64, CHUNK_BYTES as u32, Refuse, false, false),
            Self::Inputs => row("inputs", Inputs::NAME, 256, 4096, Oldest, true, true),
            Self::Image => row("image", Image::NAME, 2, 3 * 4096, Oldest, true, false),
            Self::Writes => row("writes", ImageWrite::NAME, 256, 512, Refuse, false, false),
            Self::Scan => row("scan", ScanPart::NAME, 4096, PART_BYTES as u32, Oldest, false, true),
            Self::Keyframe => row("keyframe", ScanPart::NAME, 256, PART_BYTES as u32, Oldest, false, true),
            Self::Jobs => row("jobs", Job::NAME, 64, 4096, Refuse, false, false),
            Self::Results => row("results", JobResult::NAME, 64, 4096, Oldest, false, true),
            Self::Health => row("health", Health::NAME, 4, 0, Oldest, true, false),
            Self::Status => row("status", Status::NAME, 4, 16384, Oldest, true, true),
            Self::Events => row("events", Event::NAME, 256, 2048, Oldest, false, true),
        }
    }

    /// Name of this topic of a service.
    pub fn of(self, service: &str) -> String {
        format!("{service}/{}", self.row().suffix)
    }

    /// Bytes of the header.
    pub fn header_bytes(self) -> usize {
        with_payload!(self, T => size_of::<T>())
    }

    /// `ros1msg` text of the payload.
    pub fn ros1msg(self) -> String {
        with_payload!(self, T => T::ros1msg())
    }

    /// How it stands in a recording.
    pub fn encoding(self) -> Encoding {
        with_payload!(self, T => T::ENCODING)
    }
}

/// Name of the topic that every process may write what happened to.
pub const EVENTS: &str = "stack/events";
/// Reader and writer slots beyond those of the stack file: command line, console, a restarted process whose
/// dead predecessor is not cleaned up yet.
pub const SPARE_PORTS: u32 = 4;
/// Processes that may hold a topic at once.
pub const MAX_NODES: u32 = 64;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table_agrees_with_the_types() {
        for kind in TopicKind::ALL {
            let row = kind.row();
            with_payload!(kind, T => {
                assert_eq!(row.payload, T::NAME, "{kind:?}");
                assert_eq!(row.max_tail > 0, T::TAIL, "{kind:?}");
            });
            assert!(row.depth > 0);
            // What was refused has no true order on the rail: the consumer records it instead.
            assert!(!(row.recorded && row.when_full == WhenFull::Refuse), "{kind:?}");
        }
    }

    #[test]
    fn the_schema_is_the_struct() {
        assert_eq!(
            TopicKind::CanRx.ros1msg(),
            "uint64 seq\nuint64 t_ns\nuint32 generation\nuint32 writer\nuint32 can_id\nuint8 len\nuint8 fd_flags\n\
             uint8 flags\nuint8 sender\nuint8[64] data\n"
        );
        assert!(TopicKind::Scan.ros1msg().ends_with("uint32 total\nuint8[] data\n"));
        assert_eq!(TopicKind::CanRx.header_bytes(), 96);
    }
}
