//! The operations of an [`crate::payload::ImageWrite`]: `{area u8, op u8, 0 u16, offset u32, len u32, bytes}`.
//!
//! `op` 0 sets `len` bytes. `op` 1 changes bits: `len` AND bytes, then `len` OR bytes: `new = (old & and) | or`.
//! All operations of one message are applied in one scan, in order, or none.

use crate::wiring::Area;

/// Largest tail; a Modbus request of 123 registers or 1968 coils fits in one operation.
pub const MAX_BYTES: usize = 512;
/// Most operations of one message.
pub const MAX_OPS: usize = 16;
const HEAD: usize = 12;

/// One operation, borrowed from the tail.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Op<'a> {
    /// Sets bytes.
    Set { area: Area, offset: u32, bytes: &'a [u8] },
    /// `new = (old & and) | or`; both have the same length.
    Mask { area: Area, offset: u32, and: &'a [u8], or: &'a [u8] },
}

impl Op<'_> {
    pub fn area(&self) -> Area {
        match self {
            Op::Set { area, .. } | Op::Mask { area, .. } => *area,
        }
    }
    pub fn offset(&self) -> u32 {
        match self {
            Op::Set { offset, .. } | Op::Mask { offset, .. } => *offset,
        }
    }
    /// Bytes of the image that it touches.
    pub fn len(&self) -> usize {
        match self {
            Op::Set { bytes, .. } => bytes.len(),
            Op::Mask { and, .. } => and.len(),
        }
    }
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
    /// Applies it to the bytes of its area. `false`, and nothing changed, when it reaches beyond them.
    #[must_use]
    pub fn apply(&self, area: &mut [u8]) -> bool {
        let start = self.offset() as usize;
        let Some(target) = start.checked_add(self.len()).and_then(|end| area.get_mut(start..end)) else {
            return false;
        };
        match self {
            Op::Set { bytes, .. } => target.copy_from_slice(bytes),
            Op::Mask { and, or, .. } => {
                for ((old, and), or) in target.iter_mut().zip(*and).zip(*or) {
                    *old = (*old & and) | or;
                }
            }
        }
        true
    }
}

/// Why a tail is no list of operations.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum WriteError {
    #[error("image write: the message ends in the middle of an operation")]
    Truncated,
    #[error("image write: unknown area or operation")]
    Unknown,
    #[error("image write: more than {MAX_OPS} operations or {MAX_BYTES} bytes")]
    TooLong,
}

/// Builds a tail in a fixed buffer.
#[derive(Debug, Clone)]
pub struct Builder {
    buffer: [u8; MAX_BYTES],
    len: usize,
    ops: u32,
}

impl Default for Builder {
    fn default() -> Self {
        Self { buffer: [0; MAX_BYTES], len: 0, ops: 0 }
    }
}

impl Builder {
    /// Adds an operation; refuses, changing nothing, what does not fit.
    pub fn push(&mut self, op: &Op<'_>) -> Result<(), WriteError> {
        let (code, parts): (u8, [&[u8]; 2]) = match op {
            Op::Set { bytes, .. } => (0, [bytes, &[]]),
            Op::Mask { and, or, .. } if and.len() == or.len() => (1, [and, or]),
            Op::Mask { .. } => return Err(WriteError::Unknown),
        };
        let need = HEAD + parts[0].len() + parts[1].len();
        if self.ops as usize == MAX_OPS || self.len + need > MAX_BYTES {
            return Err(WriteError::TooLong);
        }
        let head = &mut self.buffer[self.len..self.len + HEAD];
        head[0] = op.area() as u8;
        head[1] = code;
        head[4..8].copy_from_slice(&op.offset().to_le_bytes());
        head[8..12].copy_from_slice(&(op.len() as u32).to_le_bytes());
        let mut at = self.len + HEAD;
        for part in parts {
            self.buffer[at..at + part.len()].copy_from_slice(part);
            at += part.len();
        }
        self.len = at;
        self.ops += 1;
        Ok(())
    }
    /// Forgets all operations.
    pub fn clear(&mut self) {
        *self = Self::default();
    }
    pub fn ops(&self) -> u32 {
        self.ops
    }
    pub fn tail(&self) -> &[u8] {
        &self.buffer[..self.len]
    }
}

/// Reads a tail. Every operation is validated before the first is handed out.
pub fn parse(tail: &[u8]) -> Result<impl Iterator<Item = Op<'_>>, WriteError> {
    let mut at = 0;
    let mut count = 0;
    while at < tail.len() {
        let (_, next) = one(tail, at)?;
        at = next;
        count += 1;
        if count > MAX_OPS {
            return Err(WriteError::TooLong);
        }
    }
    let mut at = 0;
    Ok(std::iter::from_fn(move || {
        let (op, next) = one(tail, at).ok()?;
        at = next;
        Some(op)
    }))
}

fn one(tail: &[u8], at: usize) -> Result<(Op<'_>, usize), WriteError> {
    let head = tail.get(at..at + HEAD).ok_or(WriteError::Truncated)?;
    let area = Area::from_u8(head[0]).ok_or(WriteError::Unknown)?;
    let offset = u32::from_le_bytes([head[4], head[5], head[6], head[7]]);
    let len = u32::from_le_bytes([head[8], head[9], head[10], head[11]]) as usize;
    let body = &tail[at + HEAD..];
    let bytes = body.get(..len).ok_or(WriteError::Truncated)?;
    match head[1] {
        0 => Ok((Op::Set { area, offset, bytes }, at + HEAD + len)),
        1 => {
            let or = len.checked_mul(2).and_then(|end| body.get(len..end)).ok_or(WriteError::Truncated)?;
            Ok((Op::Mask { area, offset, and: bytes, or }, at + HEAD + 2 * len))
        }
        _ => Err(WriteError::Unknown),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn operations_are_applied_in_order() {
        let mut builder = Builder::default();
        builder.push(&Op::Set { area: Area::Marker, offset: 1, bytes: &[0xF0, 0x0F] }).unwrap();
        builder.push(&Op::Mask { area: Area::Marker, offset: 2, and: &[0xFE], or: &[0x80] }).unwrap();
        let mut marker = [0xFF; 4];
        for op in parse(builder.tail()).unwrap() {
            assert!(op.apply(&mut marker));
        }
        assert_eq!(marker, [0xFF, 0xF0, 0x8E, 0xFF]);
    }

    #[test]
    fn what_reaches_beyond_the_area_changes_nothing() {
        let mut area = [7u8; 4];
        for offset in [3, 4, u32::MAX] {
            assert!(!Op::Set { area: Area::Output, offset, bytes: &[1, 2] }.apply(&mut area));
        }
        assert_eq!(area, [7; 4]);
    }

    proptest! {
        #[test]
        fn any_bytes_are_parsed_without_panic(tail in prop::collection::vec(any::<u8>(), 0..600)) {
            if let Ok(ops) = parse(&tail) {
                let mut area = [0u8; 64];
                for op in ops { let _ = op.apply(&mut area); }
            }
        }
        #[test]
        fn round_trip(offset in any::<u32>(), bytes in prop::collection::vec(any::<u8>(), 1..200)) {
            let mut builder = Builder::default();
            let op = Op::Set { area: Area::Output, offset, bytes: &bytes };
            builder.push(&op).unwrap();
            prop_assert_eq!(parse(builder.tail()).unwrap().next().unwrap(), op);
        }
    }
}
