//! How long an RTU frame that begins with these bytes will be.
//!
//! Used for two things only: to wait a little longer for a frame that a USB adapter delivers in parts, and to cut
//! apart frames that an adapter delivered as one. Whether a frame is good is the CRC's to say.

/// Longest RTU frame: unit, 253 bytes of PDU, CRC (V1.02, 2.5.1).
pub const MAX_RTU: usize = 256;

/// What can be said about a length.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Length {
    /// The whole frame, CRC included.
    Bytes(usize),
    /// More bytes are needed to know.
    More,
    /// Nothing is known about this function code.
    Unknown,
}

/// `unit function .. count bytes.. CRC`, with the byte that counts at `at`.
fn counted(frame: &[u8], at: usize) -> Length {
    match frame.get(at) {
        Some(n) => Length::Bytes(at + 1 + usize::from(*n) + 2),
        None => Length::More,
    }
}

/// The frame as a request of a master.
pub fn request(frame: &[u8]) -> Length {
    let Some(function) = frame.get(1) else { return Length::More };
    match function {
        1..=6 | 8 => Length::Bytes(8),
        7 | 11 | 12 | 17 => Length::Bytes(4),
        15 | 16 => counted(frame, 6),
        20 | 21 => counted(frame, 2),
        22 => Length::Bytes(10),
        23 => counted(frame, 10),
        24 => Length::Bytes(6),
        43 if frame.get(2) == Some(&14) => Length::Bytes(7),
        _ => Length::Unknown,
    }
}

/// The frame as an answer of a slave.
pub fn response(frame: &[u8]) -> Length {
    let Some(function) = frame.get(1) else { return Length::More };
    match function {
        1..=4 | 12 | 17 | 20 | 21 | 23 => counted(frame, 2),
        5 | 6 | 8 | 11 | 15 | 16 => Length::Bytes(8),
        7 => Length::Bytes(5),
        22 => Length::Bytes(10),
        24 => match frame.get(2..4) {
            Some(n) => Length::Bytes(4 + usize::from(u16::from_be_bytes([n[0], n[1]])) + 2),
            None => Length::More,
        },
        0x80..=0xFF => Length::Bytes(5),
        _ => Length::Unknown,
    }
}

/// Whether more bytes may belong to these: the beginning of a request or an answer that is not all there yet. An
/// unknown function may go on up to [`MAX_RTU`].
pub fn may_go_on(frame: &[u8]) -> bool {
    if frame.len() >= MAX_RTU {
        return false;
    }
    if frame.len() < 4 {
        return true;
    }
    let longer = |length| match length {
        Length::Bytes(n) => n > frame.len() && n <= MAX_RTU,
        Length::More => true,
        Length::Unknown => false,
    };
    let (request, response) = (request(frame), response(frame));
    (request == Length::Unknown && response == Length::Unknown) || longer(request) || longer(response)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn known_frames() {
        for (frame, as_request, as_response) in [
            (&[1, 3][..], Length::Bytes(8), Length::More),
            (&[1, 3, 4], Length::Bytes(8), Length::Bytes(9)),
            (&[1, 16, 0, 0, 0, 2, 4], Length::Bytes(13), Length::Bytes(8)),
            (&[1, 0x83, 2], Length::Unknown, Length::Bytes(5)),
            (&[1, 23, 0, 0, 0, 1, 0, 0, 0, 1, 2], Length::Bytes(15), Length::Bytes(5)),
            (&[1, 24, 0, 6], Length::Bytes(6), Length::Bytes(12)),
            (&[1, 99], Length::Unknown, Length::Unknown),
            (&[1], Length::More, Length::More),
        ] {
            assert_eq!((request(frame), response(frame)), (as_request, as_response), "{frame:?}");
        }
        assert!(may_go_on(&[1, 3, 0, 0, 0, 1, 0]), "7 of 8 bytes");
        assert!(may_go_on(&[1, 3, 20, 0, 0, 1, 0, 0]), "an answer of 25 bytes");
        assert!(!may_go_on(&[1, 3, 0, 0, 0, 1, 0, 0, 0]), "longer than both");
        assert!(may_go_on(&[1, 99, 0, 0, 0, 1, 0, 0, 0]));
    }

    proptest! {
        #[test]
        fn never_panics(frame in proptest::collection::vec(any::<u8>(), 0..300)) {
            let _ = may_go_on(&frame);
        }
    }
}
