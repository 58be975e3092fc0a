//! The answer that a Modbus request will get, as far as the request fixes it.
//!
//! With it an answer is known to be whole at its last byte: unit, function, length and CRC fit. Waiting for the silence
//! behind it would only tell that nothing follows, and costs 3.5 characters a request. It serves masters alone, and only
//! functions whose answers have a length that the request fixes; everything else ends by silence.

use super::crc;
use super::length::{self, Length};

/// Unit, function, code, CRC.
const EXCEPTION: usize = 5;
const EXCEPTION_BIT: u8 = 0x80;

/// See the module.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Expected {
    unit: u8,
    function: u8,
    len: usize,
    /// Value of the third byte where it counts the bytes of data.
    count: Option<u8>,
}

impl Expected {
    /// What answers this RTU request, CRC included. `None`: nobody answers it (broadcast), it is no request, or its
    /// answer has no fixed length.
    pub fn of(request: &[u8]) -> Option<Self> {
        if length::request(request) != Length::Bytes(request.len()) || !crc::fits(request) || request[0] == 0
        {
            return None;
        }
        let (unit, function) = (request[0], request[1]);
        let quantity = u16::from_be_bytes([*request.get(4)?, *request.get(5)?]);
        let count = match function {
            1 | 2 => Some(u8::try_from(quantity.div_ceil(8)).ok()?),
            3 | 4 | 23 => Some(u8::try_from(quantity.checked_mul(2)?).ok()?),
            5 | 6 | 15 | 16 | 22 => None,
            _ => return None,
        };
        let len = match (count, function) {
            (Some(count), _) => EXCEPTION + usize::from(count),
            (None, 22) => 10,
            (None, _) => 8,
        };
        Some(Self { unit, function, len, count })
    }

    /// Whether this is the whole answer, or the exception in its place.
    pub fn fits(&self, frame: &[u8]) -> bool {
        let answer = frame.len() == self.len
            && frame[1] == self.function
            && self.count.is_none_or(|count| frame[2] == count);
        let exception = frame.len() == EXCEPTION && frame[1] == self.function | EXCEPTION_BIT;
        (answer || exception) && frame[0] == self.unit && crc::fits(frame)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn frame(bytes: &[u8]) -> Vec<u8> {
        let mut frame = bytes.to_vec();
        frame.extend(crc::crc16(bytes).to_le_bytes());
        frame
    }

    #[test]
    fn answers_of_known_length() {
        for (request, answer) in [
            (&[1, 1, 0, 0, 0, 9][..], Some(&[1, 1, 2, 0xFF, 1][..])),
            (&[1, 2, 0, 0, 0, 8], Some(&[1, 2, 1, 7])),
            (&[9, 3, 0, 0, 0, 2], Some(&[9, 3, 4, 1, 2, 3, 4])),
            (&[9, 4, 0, 0, 0, 1], Some(&[9, 4, 2, 1, 2])),
            (&[1, 5, 0, 7, 0xFF, 0], Some(&[1, 5, 0, 7, 0xFF, 0])),
            (&[1, 6, 0, 7, 1, 2], Some(&[1, 6, 0, 7, 1, 2])),
            (&[1, 15, 0, 0, 0, 3, 1, 5], Some(&[1, 15, 0, 0, 0, 3])),
            (&[1, 16, 0, 0, 0, 1, 2, 3, 4], Some(&[1, 16, 0, 0, 0, 1])),
            (&[1, 22, 0, 0, 0, 1, 0, 2], Some(&[1, 22, 0, 0, 0, 1, 0, 2])),
            (&[1, 23, 0, 0, 0, 1, 0, 0, 0, 1, 2, 3, 4], Some(&[1, 23, 2, 8, 9])),
            (&[0, 6, 0, 7, 1, 2], None),
            (&[1, 17], None),
            (&[1, 8, 0, 0, 1, 2], None),
            (&[1, 3, 0, 0, 0xFF, 0xFF], None),
            (&[1, 99, 0, 0, 0, 1], None),
            // As long as a request, but an answer.
            (&[1, 3, 4, 0, 1, 0, 2], None),
        ] {
            let expected = Expected::of(&frame(request));
            assert_eq!(expected.is_some(), answer.is_some(), "{request:?}");
            let (Some(expected), Some(answer)) = (expected, answer) else { continue };
            let whole = frame(answer);
            assert!(expected.fits(&whole), "{request:?}");
            assert!(expected.fits(&frame(&[answer[0], answer[1] | 0x80, 2])), "{request:?}");
            for (i, bit) in (0..whole.len()).flat_map(|i| (0..8).map(move |b| (i, b))) {
                let mut broken = whole.clone();
                broken[i] ^= 1 << bit;
                assert!(!expected.fits(&broken), "{request:?}");
            }
            for n in 0..whole.len() {
                assert!(!expected.fits(&whole[..n]), "{request:?}");
            }
            let mut other = answer.to_vec();
            other[0] += 1;
            assert!(!expected.fits(&frame(&other)), "another unit's");
        }
        let mut damaged = frame(&[1, 3, 0, 0, 0, 1]);
        damaged[7] ^= 1;
        assert_eq!(Expected::of(&damaged), None);
        // Another number of registers than was asked for.
        let two = Expected::of(&frame(&[1, 3, 0, 0, 0, 2])).unwrap();
        assert!(!two.fits(&frame(&[1, 3, 2, 0, 0, 0, 0])));
    }

    proptest! {
        #[test]
        fn never_panics(request in proptest::collection::vec(any::<u8>(), 0..40), bytes in proptest::collection::vec(any::<u8>(), 0..300)) {
            if let Some(expected) = Expected::of(&frame(&request)) {
                let _ = expected.fits(&bytes);
            }
            prop_assert_eq!(Expected::of(&request[..request.len().min(3)]), None);
        }
    }
}
