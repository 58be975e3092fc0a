//! Big-endian fields in a caller's buffer. Never panics: what does not fit is an error.

use super::pdu::EncodeError;

/// Reads two bytes, high byte first (V1.1b3 clause 4.2), at `at`.
pub(super) fn u16_at(bytes: &[u8], at: usize) -> Option<u16> {
    match bytes.get(at..at + 2) {
        Some(&[high, low]) => Some(u16::from_be_bytes([high, low])),
        _ => None,
    }
}

/// Appends fields to a caller's buffer.
pub(super) struct Writer<'a> {
    out: &'a mut [u8],
    len: usize,
}

impl<'a> Writer<'a> {
    pub(super) fn new(out: &'a mut [u8]) -> Self {
        Self { out, len: 0 }
    }

    pub(super) fn bytes(&mut self, bytes: &[u8]) -> Result<(), EncodeError> {
        let end = self.len + bytes.len();
        let Some(slot) = self.out.get_mut(self.len..end) else {
            return Err(EncodeError::Buffer { needed: end, got: self.out.len() });
        };
        slot.copy_from_slice(bytes);
        self.len = end;
        Ok(())
    }

    pub(super) fn u8(&mut self, value: u8) -> Result<(), EncodeError> {
        self.bytes(&[value])
    }

    pub(super) fn u16(&mut self, value: u16) -> Result<(), EncodeError> {
        self.bytes(&value.to_be_bytes())
    }

    pub(super) fn len(&self) -> usize {
        self.len
    }
}
