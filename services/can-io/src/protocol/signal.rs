//! Bits of a frame as an integer, in the numbering of DBC files.
//!
//! A DBC file numbers bits `8 * byte + bit`, bit 0 being the least significant of its byte. An Intel
//! (little-endian) signal starts at its *least* significant bit and grows with the numbers. A Motorola (big-endian)
//! signal starts at its *most* significant bit; from there it runs down to bit 0 of that byte and goes on with bit 7
//! of the next byte. The table test below holds values made with cantools 45.1.0.

use serde::{Deserialize, Serialize};
use thiserror::Error;

/// Longest frame in bytes (CAN FD).
pub const MAX_FRAME: usize = 64;

/// Order of the bytes of a signal.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ByteOrder {
    /// Little-endian; the start bit is the least significant.
    #[default]
    Intel,
    /// Big-endian; the start bit is the most significant.
    Motorola,
}

/// Why there is no such signal.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
pub enum SignalError {
    /// Length 0 or above 64.
    #[error("len {0} is not possible: a signal has 1 to 64 bits")]
    Length(u32),
    /// Beyond bit 511.
    #[error("a signal of {len} bits from bit {start} needs {bytes} bytes: a frame has at most 64")]
    Beyond {
        /// Start bit.
        start: u32,
        /// Length in bits.
        len: u32,
        /// Bytes the frame would need.
        bytes: u32,
    },
}

/// Where a signal lies in a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Signal {
    order: ByteOrder,
    len: u8,
    /// First byte that holds bits of it.
    first: u8,
    /// Bytes that hold bits of it, 1-9.
    bytes: u8,
    /// Bits to shift right once those bytes are one integer in the signal's order.
    shift: u8,
}

impl Signal {
    /// A signal of `len` bits (1-64) from DBC bit `start` (0-511).
    pub fn new(start: u32, len: u32, order: ByteOrder) -> Result<Self, SignalError> {
        if !(1..=64).contains(&len) {
            return Err(SignalError::Length(len));
        }
        let first = start / 8;
        // Bits of the first byte that lie before the signal, seen in its direction.
        let before = match order {
            ByteOrder::Intel => start % 8,
            ByteOrder::Motorola => 7 - start % 8,
        };
        let bytes = (before + len).div_ceil(8);
        let needed = first.saturating_add(bytes);
        if needed > MAX_FRAME as u32 {
            return Err(SignalError::Beyond { start, len, bytes: needed });
        }
        let shift = match order {
            ByteOrder::Intel => before,
            ByteOrder::Motorola => 8 * bytes - before - len,
        };
        Ok(Self { order, len: len as u8, first: first as u8, bytes: bytes as u8, shift: shift as u8 })
    }

    /// Length in bits.
    pub fn len(&self) -> u32 {
        u32::from(self.len)
    }

    /// Never true: a signal has at least one bit.
    pub fn is_empty(&self) -> bool {
        false
    }

    /// Bytes a frame must have to hold the whole signal.
    pub fn frame_bytes(&self) -> usize {
        usize::from(self.first) + usize::from(self.bytes)
    }

    fn mask(&self) -> u64 {
        u64::MAX >> (64 - u32::from(self.len))
    }

    /// The signal's bits, unsigned; `None` when the frame is too short for it.
    pub fn extract(&self, frame: &[u8]) -> Option<u64> {
        let part = frame.get(usize::from(self.first)..self.frame_bytes())?;
        Some((self.join(part) >> self.shift) as u64 & self.mask())
    }

    /// The signal's bits, sign-extended.
    pub fn extract_signed(&self, frame: &[u8]) -> Option<i64> {
        let unused = 64 - u32::from(self.len);
        self.extract(frame).map(|raw| (raw << unused) as i64 >> unused)
    }

    /// Writes the low bits of `raw`, leaving all other bits; false when the frame is too short.
    pub fn insert(&self, frame: &mut [u8], raw: u64) -> bool {
        let Some(part) = frame.get_mut(usize::from(self.first)..self.frame_bytes()) else { return false };
        let mask = u128::from(self.mask()) << self.shift;
        let joined = (self.join(part) & !mask) | (u128::from(raw & self.mask()) << self.shift);
        match self.order {
            ByteOrder::Intel => {
                for (i, byte) in part.iter_mut().enumerate() {
                    *byte = (joined >> (8 * i)) as u8;
                }
            }
            ByteOrder::Motorola => {
                for (i, byte) in part.iter_mut().rev().enumerate() {
                    *byte = (joined >> (8 * i)) as u8;
                }
            }
        }
        true
    }

    fn join(&self, part: &[u8]) -> u128 {
        match self.order {
            ByteOrder::Intel => part.iter().rev().fold(0, |n, &byte| (n << 8) | u128::from(byte)),
            ByteOrder::Motorola => part.iter().fold(0, |n, &byte| (n << 8) | u128::from(byte)),
        }
    }

    /// Text for maps and messages: `bits 8..23 intel`.
    pub fn label(&self) -> String {
        let (order, start) = match self.order {
            ByteOrder::Intel => ("intel", u32::from(self.first) * 8 + u32::from(self.shift)),
            ByteOrder::Motorola => {
                let before = u32::from(self.bytes) * 8 - u32::from(self.len) - u32::from(self.shift);
                ("motorola", u32::from(self.first) * 8 + 7 - before)
            }
        };
        format!("{} bit{} from {start} {order}", self.len, if self.len == 1 { "" } else { "s" })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[allow(clippy::unreadable_literal, reason = "written by a tool")]
    mod table {
        include!("signal_table.rs");
    }
    use table::CANTOOLS;

    /// Bit by bit as the DBC rule reads: the oracle of the property test.
    fn bit_by_bit(frame: &[u8], start: u32, len: u32, order: ByteOrder) -> u64 {
        let mut raw = 0u64;
        let mut bit = start;
        for i in 0..len {
            let value = u64::from(frame[bit as usize / 8] >> (bit % 8)) & 1;
            match order {
                ByteOrder::Intel => {
                    raw |= value << i;
                    bit += 1;
                }
                ByteOrder::Motorola => {
                    raw = raw << 1 | value;
                    bit = if bit.is_multiple_of(8) { bit + 15 } else { bit - 1 };
                }
            }
        }
        raw
    }

    fn any_signal() -> impl Strategy<Value = (u32, u32, ByteOrder)> {
        let order = prop_oneof![Just(ByteOrder::Intel), Just(ByteOrder::Motorola)];
        (0u32..520, 0u32..70, order)
    }

    proptest! {
        #[test]
        fn reads_as_the_rule_says(
            (start, len, order) in any_signal(),
            frame in prop::collection::vec(any::<u8>(), 0..=64),
        ) {
            let Ok(signal) = Signal::new(start, len, order) else { return Ok(()) };
            let expected =
                (signal.frame_bytes() <= frame.len()).then(|| bit_by_bit(&frame, start, len, order));
            prop_assert_eq!(signal.extract(&frame), expected);
        }

        #[test]
        fn round_trip_touches_nothing_else(
            (start, len, order) in any_signal(),
            before in any::<[u8; 32]>(),
            raw in any::<u64>(),
        ) {
            let Ok(signal) = Signal::new(start, len, order) else { return Ok(()) };
            let before = [before, before].concat();
            let mut frame = before.clone();
            prop_assert!(signal.insert(&mut frame, raw));
            prop_assert_eq!(signal.extract(&frame), Some(raw & (u64::MAX >> (64 - len))));
            let old = signal.extract(&before).unwrap();
            signal.insert(&mut frame, old);
            prop_assert_eq!(frame, before);
        }

        #[test]
        fn fits_exactly_when_every_bit_is_inside((start, len, order) in any_signal()) {
            let mut last = start;
            for _ in 1..len {
                last = match order {
                    ByteOrder::Intel => last + 1,
                    ByteOrder::Motorola => if last.is_multiple_of(8) { last + 15 } else { last - 1 },
                };
            }
            let possible = (1..=64).contains(&len) && start < 512 && last < 512;
            prop_assert_eq!(Signal::new(start, len, order).is_ok(), possible);
        }
    }

    #[test]
    fn mistakes_are_named() {
        assert_eq!(Signal::new(0, 0, ByteOrder::Intel), Err(SignalError::Length(0)));
        assert_eq!(Signal::new(0, 65, ByteOrder::Intel), Err(SignalError::Length(65)));
        let beyond = Signal::new(510, 3, ByteOrder::Intel).unwrap_err();
        assert_eq!(
            beyond.to_string(),
            "a signal of 3 bits from bit 510 needs 65 bytes: a frame has at most 64"
        );
        assert!(Signal::new(u32::MAX, 64, ByteOrder::Motorola).is_err());
        // A frame too short is no panic and changes nothing.
        let signal = Signal::new(8, 16, ByteOrder::Intel).unwrap();
        let mut short = [1, 2];
        assert_eq!((signal.extract(&short), signal.insert(&mut short, 0), short), (None, false, [1, 2]));
        assert_eq!(signal.label(), "16 bits from 8 intel");
        assert_eq!(Signal::new(7, 16, ByteOrder::Motorola).unwrap().label(), "16 bits from 7 motorola");
        assert_eq!(Signal::new(4, 1, ByteOrder::Motorola).unwrap().label(), "1 bit from 4 motorola");
    }

    #[test]
    fn as_cantools_packs() {
        for &(start, len, motorola, signed, value, hex) in CANTOOLS {
            let order = if motorola { ByteOrder::Motorola } else { ByteOrder::Intel };
            let expected: Vec<u8> =
                (0..hex.len()).step_by(2).map(|i| u8::from_str_radix(&hex[i..i + 2], 16).unwrap()).collect();
            let signal = Signal::new(start, len, order).unwrap();
            let mut frame = vec![0; expected.len()];
            assert!(signal.insert(&mut frame, value as u64));
            assert_eq!(frame, expected, "{start}|{len} {order:?} of {value}");
            let read = if signed {
                i128::from(signal.extract_signed(&frame).unwrap())
            } else {
                i128::from(signal.extract(&frame).unwrap())
            };
            assert_eq!(read, value, "{start}|{len} {order:?}");
        }
    }
}
