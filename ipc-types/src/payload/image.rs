//! The process image and the record of what the PLC did with it.

use super::payload;

/// Bytes of a part of a scan record or keyframe.
pub const PART_BYTES: usize = 2048;
/// Writers whose acknowledgements an image carries.
pub const MAX_ACKS: usize = 32;

payload! {
    /// A field service's part of %I, whole, on `<svc>/inputs`.
    ///
    /// Tail: the bytes of each of the service's input ranges (`ServiceEntry::wiring.inputs`) in order, then one
    /// [`Quality`] byte a range.
    pub struct Inputs: "dinrail.Inputs/2", tail, Ros1 {
        /// CLOCK_MONOTONIC in ns of the newest field data in it.
        pub data_t_ns: u64,
        /// Samples that this service has published at the end of SYNC windows since its start: one more with each
        /// SYNC whose sample was published. 0: none yet, or not a service with SYNC.
        pub samples: u64,
        /// Number of ranges, so many quality bytes end the tail.
        pub ranges: u32,
        /// Bytes of the tail.
        pub n: u32,
    }
}

/// How far an input range can be trusted; larger is worse.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
#[repr(u8)]
pub enum Quality {
    Good = 0,
    /// The last value is older than the range's timeout.
    Stale = 1,
    /// Nothing has ever come.
    NoData = 2,
    /// The service that delivers it is dead or gone.
    OwnerDead = 3,
}

impl Quality {
    /// From a byte of a message; unknown values are the worst.
    pub fn from_u8(byte: u8) -> Self {
        match byte {
            0 => Self::Good,
            1 => Self::Stale,
            2 => Self::NoData,
            _ => Self::OwnerDead,
        }
    }
}

/// State of the scan engine. Only in [`PlcState::Run`] are outputs the program's.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
#[repr(u32)]
pub enum PlcState {
    /// No scan has been finished yet.
    Starting = 0,
    Run = 1,
    /// Stopped by command; inputs and writes are still taken.
    Stop = 2,
    /// The program faulted.
    Fault = 3,
    /// Halted at a breakpoint.
    Halted = 4,
}

impl PlcState {
    pub fn from_u32(n: u32) -> Self {
        match n {
            0 => Self::Starting,
            1 => Self::Run,
            2 => Self::Stop,
            4 => Self::Halted,
            _ => Self::Fault,
        }
    }
}

payload! {
    /// The whole process image after a scan, on `<plc>/image`. Not recorded (the scan record holds it).
    ///
    /// Tail: %I, %Q, %M, whole, in this order.
    pub struct Image: "dinrail.Image/2", tail, Ros1 {
        /// Number of the scan, from 1; 0 before the first.
        pub scan: u64,
        /// PLC time of the scan in ns.
        pub plc_time_ns: i64,
        /// UTC of the scan in ns.
        pub utc_ns: i64,
        /// `Artifact::hash` of the running program; 0 without program.
        pub program_hash: u64,
        /// CLOCK_MONOTONIC in ns just before the newest scan that ran a task (without program: that moved routes)
        /// took its inputs: what was published before has reached the program. 0: none since the start of the service.
        pub inputs_t_ns: u64,
        /// Highest write taken of each writer: `seq`.
        pub ack_seq: [u64; MAX_ACKS],
        /// ... writer, 0 = free entry (writer 0 is the launcher, which writes no image).
        pub ack_writer: [u32; MAX_ACKS],
        /// ... its generation.
        pub ack_generation: [u32; MAX_ACKS],
        /// ... result of that last write: 0 applied, 1 too old, 2 older generation, 3 malformed, 4 outside the image.
        pub ack_result: [u32; MAX_ACKS],
        /// [`PlcState`].
        pub state: u32,
        /// Bytes of %I in the tail.
        pub input_bytes: u32,
        /// Bytes of %Q in the tail.
        pub output_bytes: u32,
        /// Bytes of %M in the tail.
        pub marker_bytes: u32,
        /// Trap id of the fault, 0 = none.
        pub trap: u32,
        /// Bytes of the tail.
        pub n: u32,
    }
}

impl Image {
    /// The three areas of a tail; `None` when the header's lengths don't fit it.
    pub fn areas<'a>(&self, tail: &'a [u8]) -> Option<(&'a [u8], &'a [u8], &'a [u8])> {
        let (i, q, m) = (self.input_bytes as usize, self.output_bytes as usize, self.marker_bytes as usize);
        if i.checked_add(q)?.checked_add(m)? != tail.len() {
            return None;
        }
        Some((&tail[..i], &tail[i..i + q], &tail[i + q..]))
    }
    /// The state.
    pub fn plc_state(&self) -> PlcState {
        PlcState::from_u32(self.state)
    }
}

/// One acknowledgement of an [`Image`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct AckEntry {
    pub writer: u32,
    pub generation: u32,
    /// All writes of (writer, generation) up to and with this one have been taken.
    pub seq: u64,
    pub result: u32,
}

/// The acknowledgements of an image.
pub fn acks(image: &Image) -> impl Iterator<Item = AckEntry> + '_ {
    (0..MAX_ACKS).filter(|&i| image.ack_writer[i] != 0).map(|i| AckEntry {
        writer: image.ack_writer[i],
        generation: image.ack_generation[i],
        seq: image.ack_seq[i],
        result: image.ack_result[i],
    })
}

payload! {
    /// One request to change %Q or %M, on `<plc>/writes`: applied whole in one scan.
    ///
    /// Tail: operations, see [`crate::image_write`].
    pub struct ImageWrite: "dinrail.ImageWrite/1", tail, Ros1 {
        /// Number of operations.
        pub ops: u32,
        /// Bytes of the tail.
        pub n: u32,
    }
}

payload! {
    /// A part of a scan record or keyframe on `<plc>/scan`, `<plc>/keyframe`: `part` of `parts`, in order.
    /// All parts of one record carry the same `scan`; see [`crate::scan_record`] for the joined content.
    pub struct ScanPart: "dinrail.ScanPart/1", tail, Ros1 {
        /// Scan that the record is about.
        pub scan: u64,
        /// Index of this part, from 0.
        pub part: u32,
        /// Number of parts.
        pub parts: u32,
        /// Length of the joined content in bytes.
        pub total: u32,
        /// Bytes of the tail, at most [`PART_BYTES`].
        pub n: u32,
    }
}
