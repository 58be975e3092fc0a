//! RTU frames in a stream of bytes, which has no silence between frames.
//!
//! A frame is what its function code says is as long as it is and whose CRC is right. What is neither is noise and
//! skipped byte by byte, except that a frame that begins with a unit of ours and is not whole yet is waited for, until
//! the caller says that the stream fell silent: then what came is a frame if its CRC is right. Frames of other units, requests and answers, are recognized whole, so that
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

/// Looks for the first frame. `ours`: whether a unit is served here (broadcast too). `silent`: nothing more came for
/// so long that nothing will.
pub fn find(bytes: &[u8], silent: bool, ours: impl Fn(u8) -> bool) -> Found {
    for skip in 0..bytes.len() {
        let rest = &bytes[skip..];
        let Some(&unit) = rest.first() else { break };
        let whole = |len: usize| rest.get(..len).is_some_and(rtu::is_frame);
        let length = rtu::request_length(rest);
        if let RequestLength::Bytes(len) = length
            && whole(len)
        {
            return Found::Frame { skip, len };
        }
        // A frame of unknown length, or of a wrong one, is what came at once.
        let open = matches!(length, RequestLength::Bytes(len) if rest.len() < len && len <= rtu::MAX_ADU)
            || length == RequestLength::More;
        if (silent || !open) && rest.len() <= rtu::MAX_ADU && rtu::is_frame(rest) {
            return Found::Frame { skip, len: rest.len() };
        }
        if ours(unit) {
            if open && !silent {
                return Found::Nothing { skip };
            }
        } else if let Some(len) = rtu::response_length(rest).filter(|len| whole(*len)) {
            return Found::Frame { skip, len };
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
                match find(&bytes[at..], false, ours) {
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
            assert_eq!(find(&long[..cut], false, ours), Found::Nothing { skip: 0 }, "{cut}");
        }
        assert_eq!(find(&long, false, ours), Found::Frame { skip: 0, len: long.len() });
        assert_eq!(find(&[5, 3, 9, 9, 9, 9, 0xAA, 0xAA], false, ours), Found::Nothing { skip: 8 });
        // Silence ends every wait, and makes a frame of what has a CRC.
        assert_eq!(find(&long[..6], true, ours), Found::Nothing { skip: 6 });
        let short = frame(5, "03 0000 00");
        assert_eq!(find(&short, false, ours), Found::Nothing { skip: 0 });
        assert_eq!(find(&short, true, ours), Found::Frame { skip: 0, len: short.len() });
        assert_eq!(find(&[], false, ours), Found::Nothing { skip: 0 });
        // Codes without a known length: one read is one frame.
        for pdu in ["63 01 02 03", "08 0000 0102 0304", "2B 0D 00", "09", "83 02"] {
            let bytes = frame(5, pdu);
            assert_eq!(find(&bytes, false, ours), Found::Frame { skip: 0, len: bytes.len() }, "{pdu}");
        }
    }

    proptest! {
        #[test]
        fn any_bytes_never_panic_and_progress_is_made(bytes in proptest::collection::vec(0_u8..30, 0..700)) {
            match find(&bytes, false, ours) {
                Found::Frame { skip, len } => prop_assert!(rtu::is_frame(&bytes[skip..skip + len])),
                // What is left is the beginning of a frame.
                Found::Nothing { skip } => prop_assert!(bytes.len() - skip < rtu::MAX_ADU),
            }
        }
    }
}
