//! Command bytes and frames of the SDO protocols (CiA 301 V4.2, 7.2.4.3.3-7.2.4.3.17).

use crate::protocol::abort::Abort;
use crate::protocol::io::Outbox;
use ipc_types::payload::{CanFrame, id_flag};

/// Client command specifiers, bits 7-5 of the first byte.
pub(super) mod ccs {
    /// Download segment (7.2.4.3.4).
    pub const DOWN_SEGMENT: u8 = 0;
    /// Initiate download (7.2.4.3.3).
    pub const DOWN: u8 = 1;
    /// Initiate upload (7.2.4.3.5).
    pub const UP: u8 = 2;
    /// Upload segment (7.2.4.3.6).
    pub const UP_SEGMENT: u8 = 3;
    /// Block upload (7.2.4.3.12-15).
    pub const BLOCK_UP: u8 = 5;
    /// Block download (7.2.4.3.8-11).
    pub const BLOCK_DOWN: u8 = 6;
}

/// Server command specifiers, bits 7-5 of the first byte.
pub(super) mod scs {
    /// Upload segment (7.2.4.3.6).
    pub const UP_SEGMENT: u8 = 0;
    /// Download segment (7.2.4.3.4).
    pub const DOWN_SEGMENT: u8 = 1;
    /// Initiate upload (7.2.4.3.5).
    pub const UP: u8 = 2;
    /// Initiate download (7.2.4.3.3).
    pub const DOWN: u8 = 3;
    /// Block download (7.2.4.3.8-11).
    pub const BLOCK_DOWN: u8 = 5;
    /// Block upload (7.2.4.3.12-15).
    pub const BLOCK_UP: u8 = 6;
}

/// Abort transfer, the whole first byte (7.2.4.3.17).
pub(super) const ABORT: u8 = 0x80;
/// Sub-command of a block transfer, bits 1-0: initiate.
pub(super) const BLOCK_INIT: u8 = 0;
/// Sub-command of a block transfer: end. A client's block download has it in bit 0 alone.
pub(super) const BLOCK_END: u8 = 1;
/// Sub-command of a block transfer: acknowledge of a sub-block.
pub(super) const BLOCK_ACK: u8 = 2;
/// Sub-command of a block upload: start.
pub(super) const BLOCK_START: u8 = 3;
/// Data bytes of a segment.
pub(super) const SEGMENT: usize = 7;
/// Most segments of a sub-block (7.2.4.3.8: 0 < blksize < 128).
pub(super) const MAX_BLOCK: u8 = 127;

/// Eight bytes of an SDO frame.
pub(super) type Bytes = [u8; 8];

/// Object and sub-index that a transfer is about.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub(super) struct Mux {
    pub index: u16,
    pub sub: u8,
}

impl Mux {
    pub fn of(bytes: &Bytes) -> Self {
        Self { index: u16::from_le_bytes([bytes[1], bytes[2]]), sub: bytes[3] }
    }
}

/// A frame with command, multiplexor and four bytes.
pub(super) fn with_mux(command: u8, mux: Mux, value: u32) -> Bytes {
    let [low, high] = mux.index.to_le_bytes();
    let [a, b, c, d] = value.to_le_bytes();
    [command, low, high, mux.sub, a, b, c, d]
}

pub(super) fn value_of(bytes: &Bytes) -> u32 {
    u32::from_le_bytes([bytes[4], bytes[5], bytes[6], bytes[7]])
}

pub(super) fn abort_frame(mux: Mux, abort: Abort) -> Bytes {
    with_mux(ABORT, mux, abort.code())
}

pub(super) fn send(out: &mut Outbox, can_id: u32, bytes: Bytes) {
    let mut frame = CanFrame { can_id, len: 8, ..CanFrame::default() };
    frame.data[..8].copy_from_slice(&bytes);
    out.push(frame);
}

/// The eight bytes of a classic data frame on `can_id`; SDO frames always have eight (7.2.4.3).
pub(super) fn receive(frame: &CanFrame, can_id: u32) -> Option<Result<Bytes, ()>> {
    if frame.can_id != can_id || frame.can_id & (id_flag::RTR | id_flag::ERR) != 0 {
        return None;
    }
    if frame.is_fd() || frame.len != 8 {
        return Some(Err(()));
    }
    let mut bytes = [0; 8];
    bytes.copy_from_slice(&frame.data[..8]);
    Some(Ok(bytes))
}

/// Expedited data: command bits n, e, s and the four bytes.
pub(super) fn expedited(command: u8, mux: Mux, data: &[u8]) -> Bytes {
    let len = data.len().min(4);
    let mut bytes = with_mux((command << 5) | ((4 - len as u8) << 2) | 0b11, mux, 0);
    bytes[4..4 + len].copy_from_slice(&data[..len]);
    bytes
}

/// A segment of `data` from `at` on: command bits from `head`, n and c added. Returns the frame and whether it is
/// the last.
pub(super) fn segment(head: u8, data: &[u8], at: usize) -> (Bytes, bool) {
    let rest = data.get(at..).unwrap_or(&[]);
    let len = rest.len().min(SEGMENT);
    let last = rest.len() <= SEGMENT;
    let mut bytes = [0; 8];
    bytes[0] = head | ((SEGMENT - len) as u8) << 1 | u8::from(last);
    bytes[1..=len].copy_from_slice(&rest[..len]);
    (bytes, last)
}

/// The data bytes of a segment and whether it is the last.
pub(super) fn segment_data(bytes: &Bytes) -> (&[u8], bool) {
    let unused = usize::from((bytes[0] >> 1) & 7);
    (&bytes[1..8 - unused], bytes[0] & 1 != 0)
}
