//! What an [`super::Exchange`] is made from, and what it counts.

/// PDO transmission types (CiA 301 V4.2, tables 69 and 73).
pub mod transmission {
    /// Synchronous, when something changed.
    pub const ACYCLIC: u8 = 0;
    /// Synchronous, every n-th SYNC: 1 to this.
    pub const CYCLIC_MAX: u8 = 240;
    /// Sampled at SYNC, sent on a remote frame.
    pub const SYNC_RTR: u8 = 252;
    /// Sent on a remote frame.
    pub const RTR: u8 = 253;
    /// By an event of the manufacturer.
    pub const EVENT_MANUFACTURER: u8 = 254;
    /// By an event of the device profile.
    pub const EVENT: u8 = 255;

    /// Types 0 to 240.
    pub fn is_synchronous(n: u8) -> bool {
        n <= CYCLIC_MAX
    }
}

/// A value in a PDO and its place in the flat image buffer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Field {
    /// First bit in the PDO, bit 0 = lowest of byte 0 (CiA 301 clause 7.4.7.1).
    pub pdo_bit: u16,
    /// 1 - 64.
    pub bits: u16,
    /// First byte in the flat buffer: the `inputs` tail, or the gathered outputs.
    pub at: u32,
    /// Bytes there: 1, 2, 4 or 8. A BOOL takes one byte of 0 or 1.
    pub bytes: u8,
    /// Narrower signed values are extended.
    pub signed: bool,
    /// Index of the range whose quality it is; unused for outputs.
    pub range: u16,
}

/// A PDO that a node sends.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RxPdo {
    /// With [`ipc_types::payload::id_flag::EFF`] for 29 bits.
    pub cob_id: u32,
    pub node: u8,
    /// Bytes the mapping needs; shorter frames are refused (CiA 301 clause 7.2.2.5: PDO length error).
    pub length: u8,
    pub transmission: u8,
    /// Without a frame for this long its inputs are stale.
    pub deadline_ns: Option<u64>,
    /// Remote frames are sent this often, for types 252 and 253.
    pub poll_ns: Option<u64>,
    pub fields: Vec<Field>,
}

/// A PDO that a node receives.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TxPdo {
    /// With [`ipc_types::payload::id_flag::EFF`] for 29 bits.
    pub cob_id: u32,
    pub node: u8,
    pub length: u8,
    pub transmission: u8,
    /// Least time between two.
    pub inhibit_ns: u64,
    /// Sent after this time also without change.
    pub event_ns: Option<u64>,
    pub fields: Vec<Field>,
}

/// All PDOs of a network.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Plan {
    pub rx: Vec<RxPdo>,
    pub tx: Vec<TxPdo>,
    /// Ranges of the `inputs` tail: bytes of each.
    pub input_bytes: Vec<u8>,
    /// Bytes of the gathered outputs.
    pub output_bytes: usize,
    /// Of each node that shows its NMT state: node, offset in the tail, range.
    pub states: Vec<(u8, u32, u16)>,
    /// PDOs whose every value reaches a scan: index in `rx`, values that can wait.
    pub queues: Vec<(u16, u8)>,
}

/// Counters since start.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, serde::Serialize)]
pub struct Counters {
    pub rx_pdos: u64,
    pub tx_pdos: u64,
    /// PDOs shorter than their mapping.
    pub short: u64,
    /// PDOs of nodes that are not operational.
    pub not_operational: u64,
    /// Samples published for a SYNC with everything in it that was due: what comes every n-th SYNC when it is its turn,
    /// what comes with a change (type 0) never.
    pub complete_samples: u64,
    /// Samples published at the end of the window, with something missing that was due.
    pub incomplete_samples: u64,
    /// Synchronous PDOs that came outside of the window of any SYNC.
    pub outside_window: u64,
    /// Times an input became stale.
    pub stale: u64,
}
