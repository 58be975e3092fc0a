//! Takes the marks that the kernel puts before damaged bytes (termios PARMRK) out of the stream.
//!
//! `FF FF` is the byte FFh, `FF 00 x` a byte x with a parity or framing error, `FF 00 00` a break. State is kept over
//! reads.

use ipc_types::payload::serial_flag;

#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
enum State {
    #[default]
    Plain,
    Marked,
    Damaged,
}

/// See the module.
#[derive(Debug, Clone, Copy, Default)]
pub struct Unmark {
    state: State,
}

impl Unmark {
    /// Decodes in place; returns how many bytes remain, and [`serial_flag`]s: BREAK, or PARITY for a damaged byte
    /// (which of parity and framing it was, the counters of the UART know).
    pub fn decode(&mut self, bytes: &mut [u8]) -> (usize, u32) {
        let (mut kept, mut flags) = (0, 0);
        for i in 0..bytes.len() {
            let byte = bytes[i];
            let put = match (self.state, byte) {
                (State::Plain, 0xFF) => {
                    self.state = State::Marked;
                    None
                }
                (State::Plain, byte) => Some(byte),
                (State::Marked, 0) => {
                    self.state = State::Damaged;
                    None
                }
                // FF FF; anything else the kernel does not write.
                (State::Marked, byte) => {
                    self.state = State::Plain;
                    Some(byte)
                }
                (State::Damaged, 0) => {
                    self.state = State::Plain;
                    flags |= serial_flag::BREAK;
                    None
                }
                (State::Damaged, byte) => {
                    self.state = State::Plain;
                    flags |= serial_flag::PARITY;
                    Some(byte)
                }
            };
            if let Some(byte) = put {
                bytes[kept] = byte;
                kept += 1;
            }
        }
        (kept, flags)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn marks_are_taken_out() {
        let mut bytes = [1, 0xFF, 0xFF, 2, 0xFF, 0, 7, 0xFF, 0, 0, 3, 0xFF];
        let mut unmark = Unmark::default();
        let (n, flags) = unmark.decode(&mut bytes);
        assert_eq!(&bytes[..n], [1, 0xFF, 2, 7, 3]);
        assert_eq!(flags, serial_flag::PARITY | serial_flag::BREAK);
        // The last mark goes on in the next read.
        let mut rest = [0xFF, 9];
        let (n, flags) = unmark.decode(&mut rest);
        assert_eq!((&rest[..n], flags), (&[0xFF, 9][..], 0));
    }

    proptest! {
        #[test]
        fn round_trip(bytes in proptest::collection::vec(any::<u8>(), 0..100), at in 1usize..50) {
            let mut coded: Vec<u8> =
                bytes.iter().flat_map(|b| if *b == 0xFF { vec![0xFF, 0xFF] } else { vec![*b] }).collect();
            let mut unmark = Unmark::default();
            let mut plain = Vec::new();
            for part in coded.chunks_mut(at) {
                let (n, flags) = unmark.decode(part);
                prop_assert_eq!(flags, 0);
                plain.extend_from_slice(&part[..n]);
            }
            prop_assert_eq!(plain, bytes);
        }

        #[test]
        fn never_longer(mut bytes in proptest::collection::vec(any::<u8>(), 0..100)) {
            let len = bytes.len();
            prop_assert!(Unmark::default().decode(&mut bytes).0 <= len);
        }
    }
}
