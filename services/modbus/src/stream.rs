//! RTU frames in a stream of bytes, which has no silence between frames.
//!
//! A frame is what its function code says is as long as it is and whose CRC is right. What is neither is noise and
//! skipped byte by byte, except that a frame that begins with a unit of ours and is not whole yet is waited for; the
//! caller ends that wait after a silence. Frames of other units, requests and answers, are recognized whole, so that
//! nothing inside of them is taken for a request to us.

use crate::protocol::rtu::{self, RequestLength};

/// See [`find`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Found {
    /// A whole frame of `len` bytes behind `skip` bytes of noise.
    Frame { skip: usize, len: usize },
    /// No frame yet; the first `skip` bytes are noise.
    Nothing { skip: usize },
}

/// Looks for the first frame. `ours`: whether a unit is served here (broadcast too).
pub fn find(bytes: &[u8], ours: impl Fn(u8) -> bool) -> Found {
    for skip in 0..bytes.len() {
        let rest = &bytes[skip..];
        let Some(&unit) = rest.first() else { break };
        let whole = |len: usize| rest.get(..len).is_some_and(rtu::is_frame);
        // Frames of unknown length are one read; so are echo tests with much data.
        let all = rest.len() <= rtu::MAX_ADU && rtu::is_frame(rest);
        match rtu::request_length(rest) {
            RequestLength::Bytes(len) if whole(len) => return Found::Frame { skip, len },
            _ if all => return Found::Frame { skip, len: rest.len() },
            _ if ours(unit) => {}
            _ => {
                if let Some(len) = rtu::response_length(rest).filter(|len| whole(*len)) {
                    return Found::Frame { skip, len };
                }
                continue;
            }
        }
        match rtu::request_length(rest) {
            RequestLength::Bytes(len) if len <= rtu::MAX_ADU && rest.len() < len => {
                return Found::Nothing { skip };
            }
            RequestLength::More => return Found::Nothing { skip },
            _ => {}
        }
    }
    Found::Nothing { skip: bytes.len() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::hex;
    use proptest::prelude::*;

    fn frame(unit: u8, pdu: &str) -> Vec<u8> {
        let mut out = [0; rtu::MAX_ADU];
        let len = rtu::encode(unit, &hex(pdu), &mut out);
        out[..len].to_vec()
    }

    fn ours(unit: u8) -> bool {
        matches!(unit, 0 | 5)
    }

    #[test]
    fn frames_behind_noise_and_other_units() {
        let good = frame(5, "03 0000 0001");
        for noise in [
            vec![],
            vec![0xFF; 40],
            vec![0x09; 3],
            b"hello".to_vec(),
            frame(7, "03 04 05030000"),
            frame(7, "10 0000 0001 02 0503"),
        ] {
            let bytes = [&noise[..], &good].concat();
            let mut at = 0;
            loop {
                match find(&bytes[at..], ours) {
                    Found::Frame { skip, len } if bytes[at + skip] == 5 => {
                        assert_eq!(bytes[at + skip..at + skip + len], good, "{noise:02X?}");
                        break;
                    }
                    Found::Frame { skip, len } => at += skip + len,
                    Found::Nothing { .. } => panic!("{noise:02X?}"),
                }
            }
        }
    }

    #[test]
    fn a_begun_frame_is_waited_for_and_an_impossible_one_is_not() {
        let long = frame(5, "10 0000 0002 04 00010002");
        for cut in 1..long.len() {
            assert_eq!(find(&long[..cut], ours), Found::Nothing { skip: 0 }, "{cut}");
        }
        assert_eq!(find(&long, ours), Found::Frame { skip: 0, len: long.len() });
        assert_eq!(find(&[5, 3, 0, 0, 0, 1, 0xAA, 0xAA], ours), Found::Nothing { skip: 8 });
        assert_eq!(find(&[], ours), Found::Nothing { skip: 0 });
        // Codes without a known length: one read is one frame.
        for pdu in ["63 01 02 03", "08 0000 0102 0304", "2B 0D 00", "09", "83 02"] {
            let bytes = frame(5, pdu);
            assert_eq!(find(&bytes, ours), Found::Frame { skip: 0, len: bytes.len() }, "{pdu}");
        }
    }

    proptest! {
        #[test]
        fn any_bytes_never_panic_and_progress_is_made(bytes in proptest::collection::vec(0_u8..30, 0..700)) {
            match find(&bytes, ours) {
                Found::Frame { skip, len } => prop_assert!(rtu::is_frame(&bytes[skip..skip + len])),
                // What is left is the beginning of a frame.
                Found::Nothing { skip } => prop_assert!(bytes.len() - skip < rtu::MAX_ADU),
            }
        }
    }
}
