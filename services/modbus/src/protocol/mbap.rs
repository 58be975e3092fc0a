//! Modbus on a TCP stream: the MBAP header (Guide V1.0b clause 3.1.3) and the way back from a stream of
//! bytes, cut anywhere, to frames.
//!
//! A header with another protocol identifier than 0 is dropped with its frame and nothing is answered (Guide
//! V1.0b clause 4.4.2.2, MBAP header check). A length of 0, 1 or more than [`MAX_LENGTH`] leaves no way to find
//! the next header, so the stream ends there.

use super::pdu::MAX_PDU;

/// Bytes of the header: transaction, protocol, length, unit.
pub const HEADER: usize = 7;
/// Largest frame: header and PDU (V1.1b3 clause 4.1: 260 bytes).
pub const MAX_ADU: usize = HEADER + MAX_PDU;
/// Largest length field that is still believed. Legal are 2 to 254: unit id and a PDU of 1 to 253 bytes. A write
/// whose one-byte byte count is too large makes a PDU of at most 265 bytes (function 23: 10 bytes and 255
/// values); such a frame is whole, so its sender gets exception 03 and keeps its connection.
pub const MAX_LENGTH: u16 = 266;
/// Most bytes that one received frame takes.
pub const MAX_RECEIVED: usize = HEADER - 1 + MAX_LENGTH as usize;

/// One frame, its PDU where the caller's bytes have it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Frame<'a> {
    /// Transaction identifier, repeated in the answer.
    pub transaction: u16,
    /// Unit identifier, repeated in the answer.
    pub unit: u8,
    /// 1 to 265 bytes; more than 253 are no legal request.
    pub pdu: &'a [u8],
}

/// What the beginning of a byte stream is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scan<'a> {
    /// Not a whole frame yet; no byte is consumed.
    Incomplete,
    /// A frame; `used` bytes are consumed.
    Frame { frame: Frame<'a>, used: usize },
    /// A whole frame of another protocol: drop `used` bytes, answer nothing.
    Foreign { used: usize },
    /// The length field is impossible: no later byte of this stream can be trusted.
    BadLength { length: u16 },
}

/// Looks at the beginning of a stream.
pub fn scan(bytes: &[u8]) -> Scan<'_> {
    let &[t1, t0, p1, p0, l1, l0, ref rest @ ..] = bytes else { return Scan::Incomplete };
    let length = u16::from_be_bytes([l1, l0]);
    if !(2..=MAX_LENGTH).contains(&length) {
        return Scan::BadLength { length };
    }
    let Some(body) = rest.get(..usize::from(length)) else { return Scan::Incomplete };
    let Some((&unit, pdu)) = body.split_first() else { return Scan::BadLength { length } };
    let used = HEADER - 1 + usize::from(length);
    if (p1, p0) != (0, 0) {
        return Scan::Foreign { used };
    }
    Scan::Frame { frame: Frame { transaction: u16::from_be_bytes([t1, t0]), unit, pdu }, used }
}

/// The header in front of a PDU of `pdu_len` bytes (1 to 253).
pub fn header(transaction: u16, unit: u8, pdu_len: usize) -> [u8; HEADER] {
    debug_assert!((1..=MAX_PDU).contains(&pdu_len));
    let [t1, t0] = transaction.to_be_bytes();
    let [l1, l0] = (pdu_len as u16 + 1).to_be_bytes();
    [t1, t0, 0, 0, l1, l0, unit]
}

/// A whole frame in a caller's buffer, for clients and tests. `None` if the PDU is empty, too long, or the
/// buffer too small.
pub fn encode(transaction: u16, unit: u8, pdu: &[u8], out: &mut [u8]) -> Option<usize> {
    if !(1..=MAX_PDU).contains(&pdu.len()) {
        return None;
    }
    let len = HEADER + pdu.len();
    let out = out.get_mut(..len)?;
    let (head, body) = out.split_at_mut(HEADER);
    head.copy_from_slice(&header(transaction, unit, pdu.len()));
    body.copy_from_slice(pdu);
    Some(len)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn lengths_at_the_limits() {
        let with_length = |length: u16| {
            let mut b = vec![0, 1, 0, 0];
            b.extend(length.to_be_bytes());
            b.extend(vec![3; 300]);
            b
        };
        for length in [0, 1, 267, 300, 0xFFFF] {
            assert_eq!(scan(&with_length(length)), Scan::BadLength { length }, "{length}");
        }
        for length in [2, 3, 254, 255, 266] {
            let bytes = with_length(length);
            let Scan::Frame { frame, used } = scan(&bytes) else { panic!("{length} is legal") };
            assert_eq!((frame.pdu.len(), used), (usize::from(length) - 1, usize::from(length) + 6));
        }
    }

    #[test]
    fn a_bad_length_is_seen_before_its_body() {
        assert_eq!(scan(&[0, 1, 0, 0, 0x01, 0x2C]), Scan::BadLength { length: 300 });
    }

    #[test]
    fn a_foreign_protocol_is_skipped_whole() {
        let bytes = [0, 1, 0, 1, 0, 6, 1, 3, 0, 0, 0, 1, 0xAA];
        assert_eq!(scan(&bytes), Scan::Foreign { used: 12 });
        assert_eq!(scan(&bytes[..11]), Scan::Incomplete);
    }

    proptest! {
        #[test]
        fn any_bytes_give_an_answer_within_them(bytes in proptest::collection::vec(any::<u8>(), 0..600)) {
            match scan(&bytes) {
                Scan::Frame { frame, used } => {
                    prop_assert!(used <= bytes.len() && used <= MAX_RECEIVED);
                    prop_assert_eq!(frame.pdu.len() + HEADER, used);
                }
                Scan::Foreign { used } => prop_assert!(used >= HEADER && used <= bytes.len()),
                Scan::Incomplete => prop_assert!(bytes.len() < MAX_RECEIVED),
                Scan::BadLength { length } => prop_assert!(!(2..=266).contains(&length)),
            }
        }

        #[test]
        fn round_trip_and_every_prefix_is_incomplete(
            transaction: u16, unit: u8, pdu in proptest::collection::vec(any::<u8>(), 1..=MAX_PDU),
        ) {
            let mut out = [0; MAX_ADU];
            let len = encode(transaction, unit, &pdu, &mut out).unwrap();
            let expected = Scan::Frame { frame: Frame { transaction, unit, pdu: &pdu }, used: len };
            prop_assert_eq!(scan(&out[..len]), expected);
            for cut in 0..len {
                prop_assert_eq!(scan(&out[..cut]), Scan::Incomplete);
            }
        }
    }
}
