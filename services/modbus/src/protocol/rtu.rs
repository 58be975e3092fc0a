//! Modbus RTU: address, PDU, CRC (serial line guide V1.02, 2.5.1).
//!
//! Where a frame ends is said by the line's silence, which the serial driver sees; here a frame is whole or it is
//! not one. Nothing in here guesses lengths, except [`request_length`] for RTU on a TCP stream, which has no silence.

use super::pdu::{MAX_PDU, function};
use dinrail_serial::protocol::crc::crc16;

/// Address of a broadcast: every unit carries the request out, none answers (V1.02, 2.1).
pub const BROADCAST: u8 = 0;
/// Shortest frame: address, function code, CRC.
pub const MIN_ADU: usize = 4;
/// Longest frame (V1.02, 2.5.1.1).
pub const MAX_ADU: usize = 256;

/// Bytes that are no frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum FrameError {
    /// Fewer bytes than any frame has.
    #[error("{got} bytes are too few for a frame, which has at least {min}")]
    Short { got: usize, min: usize },
    /// More bytes than any frame has.
    #[error("{got} bytes are too many for a frame, which has at most {max}")]
    Long { got: usize, max: usize },
    /// RTU: the check at the end is another one than that of the bytes before it.
    #[error(
        "the CRC is {got:04X}h but that of the bytes is {expected:04X}h: the frame was damaged on the line"
    )]
    Crc { got: u16, expected: u16 },
    /// ASCII: no colon at the beginning.
    #[error("the frame does not begin with ':'")]
    Start,
    /// ASCII: no CR LF, or another delimiter, at the end.
    #[error("the frame does not end with CR and its delimiter")]
    End,
    /// ASCII: a character that is no hexadecimal digit, or half a byte.
    #[error("character {at} is no hexadecimal digit, or its pair is missing")]
    Digit { at: usize },
    /// ASCII: the check at the end is another one than that of the bytes before it.
    #[error(
        "the LRC is {got:02X}h but that of the bytes is {expected:02X}h: the frame was damaged on the line"
    )]
    Lrc { got: u8, expected: u8 },
}

/// Writes a frame into `out` and returns its length; 0 if the PDU has not 1 to 253 bytes.
pub fn encode(unit: u8, pdu: &[u8], out: &mut [u8; MAX_ADU]) -> usize {
    if !(1..=MAX_PDU).contains(&pdu.len()) {
        return 0;
    }
    let len = pdu.len() + 1;
    out[0] = unit;
    out[1..len].copy_from_slice(pdu);
    let crc = crc16(&out[..len]).to_le_bytes();
    out[len..len + 2].copy_from_slice(&crc);
    len + 2
}

/// Unit and PDU of a whole frame.
pub fn decode(frame: &[u8]) -> Result<(u8, &[u8]), FrameError> {
    let got = frame.len();
    if got > MAX_ADU {
        return Err(FrameError::Long { got, max: MAX_ADU });
    }
    let Some((body, &[low, high])) = frame.split_last_chunk::<2>() else {
        return Err(FrameError::Short { got, min: MIN_ADU });
    };
    let Some((&unit, pdu)) = body.split_first().filter(|(_, pdu)| !pdu.is_empty()) else {
        return Err(FrameError::Short { got, min: MIN_ADU });
    };
    let (crc, expected) = (u16::from_le_bytes([low, high]), crc16(body));
    if crc != expected {
        return Err(FrameError::Crc { got: crc, expected });
    }
    Ok((unit, pdu))
}

/// Length of the request frame that begins with these bytes, as its function code and byte count tell it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RequestLength {
    /// So many bytes, unit and CRC included; may be more than [`MAX_ADU`], then it is no frame.
    Bytes(usize),
    /// The bytes that tell it are still to come.
    More,
    /// The function code has no length that could be known.
    Unknown,
}

/// See [`RequestLength`]. For RTU on a stream, where no silence ends a frame.
pub fn request_length(frame: &[u8]) -> RequestLength {
    let Some(&code) = frame.get(1) else { return RequestLength::More };
    let counted = |at: usize| match frame.get(at) {
        Some(&count) => RequestLength::Bytes(at + 1 + usize::from(count) + 2),
        None => RequestLength::More,
    };
    match code {
        function::READ_COILS..=function::WRITE_SINGLE_REGISTER => RequestLength::Bytes(8),
        function::READ_EXCEPTION_STATUS
        | function::GET_COMM_EVENT_COUNTER
        | function::GET_COMM_EVENT_LOG
        | function::REPORT_SERVER_ID => RequestLength::Bytes(4),
        // The data of sub-function 0 may be longer; such frames are found by their CRC.
        function::DIAGNOSTICS => RequestLength::Bytes(8),
        function::WRITE_MULTIPLE_COILS | function::WRITE_MULTIPLE_REGISTERS => counted(6),
        function::READ_FILE_RECORD | function::WRITE_FILE_RECORD => counted(2),
        function::MASK_WRITE_REGISTER => RequestLength::Bytes(10),
        function::READ_WRITE_MULTIPLE_REGISTERS => counted(10),
        function::READ_FIFO_QUEUE => RequestLength::Bytes(6),
        function::ENCAPSULATED_INTERFACE => match frame.get(2) {
            Some(&super::identification::MEI_DEVICE_IDENTIFICATION) => RequestLength::Bytes(7),
            Some(_) => RequestLength::Unknown,
            None => RequestLength::More,
        },
        _ => RequestLength::Unknown,
    }
}

/// Length of the response frame that begins with these bytes, if it can be told; for traffic of other units on a
/// stream.
pub fn response_length(frame: &[u8]) -> Option<usize> {
    let &[_, code, third, ..] = frame else { return None };
    Some(match code {
        0x80.. => 5,
        function::READ_COILS..=function::READ_INPUT_REGISTERS
        | function::READ_WRITE_MULTIPLE_REGISTERS
        | function::GET_COMM_EVENT_LOG
        | function::REPORT_SERVER_ID
        | function::READ_FILE_RECORD
        | function::WRITE_FILE_RECORD => 5 + usize::from(third),
        function::READ_EXCEPTION_STATUS => 5,
        function::WRITE_SINGLE_COIL
        | function::WRITE_SINGLE_REGISTER
        | function::DIAGNOSTICS
        | function::GET_COMM_EVENT_COUNTER
        | function::WRITE_MULTIPLE_COILS
        | function::WRITE_MULTIPLE_REGISTERS => 8,
        function::MASK_WRITE_REGISTER => 10,
        _ => return None,
    })
}

/// Whether these bytes are one whole frame.
pub fn is_frame(bytes: &[u8]) -> bool {
    decode(bytes).is_ok()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{DEVICE_FRAMES, hex, rows, to_hex};
    use proptest::prelude::*;

    #[test]
    fn frames_of_the_replaced_devices_byte_for_byte() {
        let mut frames = 0;
        for row in rows(DEVICE_FRAMES).filter(|row| row[1] == "rtu") {
            for text in [row[3], row[4]].into_iter().filter(|text| *text != "-") {
                let bytes = hex(text);
                let (unit, pdu) = decode(&bytes).unwrap();
                let mut out = [0; MAX_ADU];
                let len = encode(unit, pdu, &mut out);
                assert_eq!(to_hex(&out[..len]), text);
                frames += 1;
            }
            if row[3] != "-" {
                let bytes = hex(row[3]);
                assert_eq!(request_length(&bytes), RequestLength::Bytes(bytes.len()), "{row:?}");
            }
        }
        assert_eq!(frames, 29);
    }

    #[test]
    fn what_is_no_frame() {
        for len in 0..4 {
            assert_eq!(decode(&vec![0; len]), Err(FrameError::Short { got: len, min: 4 }));
        }
        assert_eq!(decode(&[0; 257]), Err(FrameError::Long { got: 257, max: 256 }));
        let mut frame = hex("0101000000083DCC");
        frame[3] ^= 1;
        assert!(matches!(decode(&frame), Err(FrameError::Crc { got: 0xCC3D, .. })));
        let mut out = [0; MAX_ADU];
        assert_eq!((encode(1, &[], &mut out), encode(1, &[0; 254], &mut out)), (0, 0));
        assert_eq!(encode(1, &[0; 253], &mut out), 256);
    }

    proptest! {
        #[test]
        fn any_bytes_are_decoded_without_panic(bytes in proptest::collection::vec(any::<u8>(), 0..300)) {
            if let Ok((unit, pdu)) = decode(&bytes) {
                let mut out = [0; MAX_ADU];
                let len = encode(unit, pdu, &mut out);
                prop_assert_eq!(&out[..len], &bytes[..]);
            }
            let _ = request_length(&bytes);
        }

        #[test]
        fn round_trip_and_every_flipped_bit_is_seen(
            unit: u8, pdu in proptest::collection::vec(any::<u8>(), 1..=MAX_PDU), at: u16, bit in 0..8,
        ) {
            let mut out = [0; MAX_ADU];
            let len = encode(unit, &pdu, &mut out);
            prop_assert_eq!(decode(&out[..len]), Ok((unit, &pdu[..])));
            out[usize::from(at) % len] ^= 1_u8 << bit;
            prop_assert!(decode(&out[..len]).is_err());
        }
    }
}
