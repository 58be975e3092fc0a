//! What clients are written, in each of their protocols.

use crate::protocol::{Frame, cannelloni, slcan, socketcand};

/// The texts of one frame, each written when the first client needs it.
pub(super) struct Texts {
    socketcand: ([u8; socketcand::MAX_TEXT], usize),
    slcan: ([u8; slcan::MAX_TEXT], usize),
    slcan_stamped: ([u8; slcan::MAX_TEXT], usize),
    cannelloni: ([u8; cannelloni::MAX_BYTES], usize),
}

impl Default for Texts {
    fn default() -> Self {
        Self {
            socketcand: ([0; socketcand::MAX_TEXT], usize::MAX),
            slcan: ([0; slcan::MAX_TEXT], usize::MAX),
            slcan_stamped: ([0; slcan::MAX_TEXT], usize::MAX),
            cannelloni: ([0; cannelloni::MAX_BYTES], usize::MAX),
        }
    }
}

impl Texts {
    pub(super) fn socketcand(&mut self, frame: &Frame, utc_ns: u64) -> &[u8] {
        let (text, len) = &mut self.socketcand;
        if *len == usize::MAX {
            *len = socketcand::encode(frame, utc_ns, text);
        }
        &text[..*len]
    }

    pub(super) fn cannelloni(&mut self, frame: &Frame) -> &[u8] {
        let (bytes, len) = &mut self.cannelloni;
        if *len == usize::MAX {
            *len = cannelloni::encode(frame, bytes);
        }
        &bytes[..*len]
    }

    pub(super) fn slcan(&mut self, frame: &Frame, stamp_ms: Option<u64>) -> &[u8] {
        let (text, len) = if stamp_ms.is_some() { &mut self.slcan_stamped } else { &mut self.slcan };
        if *len == usize::MAX {
            *len = slcan::encode(frame, stamp_ms, text);
        }
        &text[..*len]
    }
}
