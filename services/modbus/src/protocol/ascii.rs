//! Modbus ASCII: a colon, address, PDU and LRC as pairs of hexadecimal digits, CR and LF (serial line guide V1.02,
//! 2.5.2).
//!
//! [`decode`] reads one whole frame; [`Receiver`] finds frames in the characters of a line. A colon inside a frame
//! begins a new one: whatever stood before it was cut off.

use super::pdu::MAX_PDU;
pub use super::rtu::FrameError;

/// Longest frame: colon, 255 pairs (address, PDU, LRC), CR, LF (V1.02, 2.5.2.1).
pub const MAX_ADU: usize = 513;
/// Shortest frame: colon, pairs of address, function code and LRC, CR, LF.
pub const MIN_ADU: usize = 9;
/// The delimiter behind CR until sub-function 3 of function 8 sets another one.
pub const LF: u8 = b'\n';

/// Check of address and PDU: the two's complement of the sum of the bytes (V1.02, 6.2.1).
pub fn lrc(bytes: &[u8]) -> u8 {
    bytes.iter().fold(0_u8, |sum, byte| sum.wrapping_add(*byte)).wrapping_neg()
}

/// Writes a frame into `out` and returns its length; 0 if the PDU has not 1 to 253 bytes.
pub fn encode(unit: u8, pdu: &[u8], out: &mut [u8; MAX_ADU]) -> usize {
    encode_with(unit, pdu, LF, out)
}

/// [`encode`] with another delimiter behind CR.
pub fn encode_with(unit: u8, pdu: &[u8], delimiter: u8, out: &mut [u8; MAX_ADU]) -> usize {
    if !(1..=MAX_PDU).contains(&pdu.len()) {
        return 0;
    }
    let check = lrc(pdu).wrapping_sub(unit);
    out[0] = b':';
    let bytes = std::iter::once(unit).chain(pdu.iter().copied()).chain([check]);
    let mut len = 1;
    for (byte, pair) in bytes.zip(out[1..].chunks_exact_mut(2)) {
        pair.copy_from_slice(&[digit(byte >> 4), digit(byte & 15)]);
        len += 2;
    }
    out[len] = b'\r';
    out[len + 1] = delimiter;
    len + 2
}

/// Unit of a whole frame, and its PDU, written to the beginning of `out`.
pub fn decode<'o>(frame: &[u8], out: &'o mut [u8; 256]) -> Result<(u8, &'o [u8]), FrameError> {
    decode_with(frame, LF, out)
}

/// [`decode`] with another delimiter behind CR. Small letters count as digits too.
pub fn decode_with<'o>(
    frame: &[u8],
    delimiter: u8,
    out: &'o mut [u8; 256],
) -> Result<(u8, &'o [u8]), FrameError> {
    let got = frame.len();
    if got > MAX_ADU {
        return Err(FrameError::Long { got, max: MAX_ADU });
    }
    if got < MIN_ADU {
        return Err(FrameError::Short { got, min: MIN_ADU });
    }
    let digits = frame.strip_prefix(b":").ok_or(FrameError::Start)?;
    let digits = digits.strip_suffix(&[b'\r', delimiter]).ok_or(FrameError::End)?;
    let mut len = 0;
    for (pair, slot) in digits.chunks(2).zip(out.iter_mut()) {
        let at = 1 + len * 2;
        let &[high, low] = pair else { return Err(FrameError::Digit { at }) };
        let high = value(high).ok_or(FrameError::Digit { at })?;
        let low = value(low).ok_or(FrameError::Digit { at: at + 1 })?;
        *slot = high << 4 | low;
        len += 1;
    }
    // 255 pairs at most: frame and buffer have the same limit.
    let Some((&check, body)) = out.get(..len).and_then(<[u8]>::split_last) else {
        return Err(FrameError::Short { got, min: MIN_ADU });
    };
    let expected = lrc(body);
    if check != expected {
        return Err(FrameError::Lrc { got: check, expected });
    }
    match body.split_first() {
        Some((&unit, pdu)) if !pdu.is_empty() => Ok((unit, pdu)),
        _ => Err(FrameError::Short { got, min: MIN_ADU }),
    }
}

fn digit(nibble: u8) -> u8 {
    match nibble {
        0..=9 => b'0' + nibble,
        _ => b'A' + (nibble - 10),
    }
}

fn value(character: u8) -> Option<u8> {
    match character {
        b'0'..=b'9' => Some(character - b'0'),
        b'A'..=b'F' => Some(character - b'A' + 10),
        b'a'..=b'f' => Some(character - b'a' + 10),
        _ => None,
    }
}

/// What a character did to a [`Receiver`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Received {
    /// A frame goes on, or there is none.
    Nothing,
    /// A frame is whole: [`Receiver::frame`].
    Frame,
    /// A frame was begun and is lost: another colon came, or it is too long.
    Broken,
}

/// Finds frames in the characters of a line.
pub struct Receiver {
    bytes: [u8; MAX_ADU],
    len: usize,
    whole: bool,
    delimiter: u8,
}

impl Default for Receiver {
    fn default() -> Self {
        Self { bytes: [0; MAX_ADU], len: 0, whole: false, delimiter: LF }
    }
}

impl Receiver {
    /// The next character. Ends the validity of [`Receiver::frame`].
    pub fn push(&mut self, character: u8) -> Received {
        if std::mem::take(&mut self.whole) {
            self.len = 0;
        }
        if character == b':' {
            let broken = self.len > 0;
            self.bytes[0] = character;
            self.len = 1;
            return if broken { Received::Broken } else { Received::Nothing };
        }
        if self.len == 0 {
            return Received::Nothing;
        }
        let Some(slot) = self.bytes.get_mut(self.len) else {
            self.len = 0;
            return Received::Broken;
        };
        *slot = character;
        self.len += 1;
        self.whole = character == self.delimiter && self.bytes.get(self.len - 2) == Some(&b'\r');
        if self.whole { Received::Frame } else { Received::Nothing }
    }

    /// The whole frame after [`Received::Frame`], colon to delimiter.
    pub fn frame(&self) -> &[u8] {
        &self.bytes[..self.len]
    }

    /// Whether a frame is begun and not whole.
    pub fn is_inside(&self) -> bool {
        self.len > 0 && !self.whole
    }

    /// Drops what was begun: the line was silent for too long. Returns whether something was.
    pub fn reset(&mut self) -> bool {
        let inside = self.is_inside();
        self.len = 0;
        inside
    }

    /// The delimiter behind CR.
    pub fn delimiter(&self) -> u8 {
        self.delimiter
    }

    /// Sets the delimiter behind CR for frames from now on.
    pub fn set_delimiter(&mut self, delimiter: u8) {
        self.delimiter = delimiter;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{DEVICE_FRAMES, hex, rows};
    use proptest::prelude::*;

    #[test]
    fn the_frame_of_the_serial_line_guide_and_of_the_devices() {
        // V1.02, 6.2.1: the LRC is the two's complement of the sum.
        let mut out = [0; MAX_ADU];
        let len = encode(0xF7, &hex("03 1389 000A"), &mut out);
        assert_eq!(std::str::from_utf8(&out[..len]).unwrap(), ":F7031389000A60\r\n");
        let mut pdu = [0; 256];
        assert_eq!(decode(b":f7031389000a60\r\n", &mut pdu), Ok((0xF7, &hex("03 1389 000A")[..])));
        // The devices' PDUs in ASCII.
        for row in rows(DEVICE_FRAMES).filter(|row| row[1] == "rtu") {
            let adu = hex(row[3]);
            let len = encode(adu[0], &adu[1..adu.len() - 2], &mut out);
            assert_eq!(decode(&out[..len], &mut pdu), Ok((adu[0], &adu[1..adu.len() - 2])));
        }
    }

    #[test]
    fn what_is_no_frame() {
        let mut pdu = [0; 256];
        let mut error = |text: &str| decode(text.as_bytes(), &mut pdu).unwrap_err();
        assert_eq!(error(""), FrameError::Short { got: 0, min: 9 });
        assert_eq!(error(":0103FC\r"), FrameError::Short { got: 8, min: 9 });
        assert_eq!(error(&"0".repeat(514)), FrameError::Long { got: 514, max: 513 });
        assert_eq!(error("x0103FC\r\n"), FrameError::Start);
        assert_eq!(error(":0103FC\n\n"), FrameError::End);
        assert_eq!(error(":0103FC\r\r"), FrameError::End);
        assert_eq!(error(":0103GC\r\n"), FrameError::Digit { at: 5 });
        assert_eq!(error(":0103F \r\n"), FrameError::Digit { at: 6 });
        assert_eq!(error(":0103FC0\r\n"), FrameError::Digit { at: 7 });
        assert_eq!(error(":0103FD\r\n"), FrameError::Lrc { got: 0xFD, expected: 0xFC });
        let mut out = [0; MAX_ADU];
        assert_eq!((encode(1, &[], &mut out), encode(1, &[0; 254], &mut out)), (0, 0));
        assert_eq!(encode(1, &[0; 253], &mut out), 513);
    }

    fn receive(receiver: &mut Receiver, text: &[u8]) -> (Vec<Vec<u8>>, usize) {
        let (mut frames, mut broken) = (Vec::new(), 0);
        for &character in text {
            match receiver.push(character) {
                Received::Frame => frames.push(receiver.frame().to_vec()),
                Received::Broken => broken += 1,
                Received::Nothing => {}
            }
        }
        (frames, broken)
    }

    #[test]
    fn frames_are_found_between_noise_and_a_colon_begins_anew() {
        let mut receiver = Receiver::default();
        let (frames, broken) = receive(&mut receiver, b"x\r\n:01:0103FC\r\n\r\nyy:0203FB\r\n:0");
        assert_eq!(frames, [&b":0103FC\r\n"[..], b":0203FB\r\n"]);
        assert_eq!(
            (broken, receiver.is_inside(), receiver.reset(), receiver.reset()),
            (1, true, true, false)
        );
        let long = [&b":"[..], &[b'0'; 513]].concat();
        assert_eq!(receive(&mut receiver, &long), (vec![], 1));
        receiver.set_delimiter(b'!');
        let (frames, _) = receive(&mut receiver, b":0103FC\r!");
        assert_eq!(decode_with(&frames[0], b'!', &mut [0; 256]), Ok((1, &[3][..])));
        assert_eq!(decode(&frames[0], &mut [0; 256]), Err(FrameError::End));
    }

    proptest! {
        #[test]
        fn any_characters_are_received_without_panic(
            text in proptest::collection::vec(prop_oneof![any::<u8>(), prop::sample::select(&b":0123456789ABCDEF\r\n"[..])], 0..1200),
        ) {
            let (frames, _) = receive(&mut Receiver::default(), &text);
            for frame in frames {
                prop_assert!(frame.len() <= MAX_ADU && frame[0] == b':' && frame.ends_with(b"\r\n"));
                let _ = decode(&frame, &mut [0; 256]);
            }
            let _ = decode(&text, &mut [0; 256]);
        }

        #[test]
        fn round_trip_and_every_changed_byte_is_seen(
            unit: u8, pdu in proptest::collection::vec(any::<u8>(), 1..=MAX_PDU), at: u16, xor in 1_u8..,
        ) {
            let mut out = [0; MAX_ADU];
            let len = encode(unit, &pdu, &mut out);
            let (frames, broken) = receive(&mut Receiver::default(), &out[..len]);
            prop_assert_eq!((frames.len(), broken), (1, 0));
            let mut buffer = [0; 256];
            prop_assert_eq!(decode(&frames[0], &mut buffer), Ok((unit, &pdu[..])));
            let at = usize::from(at) % (len - 3) + 1;
            out[at] ^= xor;
            let same_digit = value(out[at]).is_some() && value(out[at]) == value(out[at] ^ xor);
            prop_assert!(same_digit || decode(&out[..len], &mut buffer).is_err());
        }
    }
}
