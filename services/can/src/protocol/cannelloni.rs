//! The cannelloni protocol over TCP: a greeting each way, then frames in binary. Both directions are the same.
//!
//! A frame is the identifier with flags as u32, highest byte first, a length byte whose highest bit says CAN FD (a byte
//! of FD flags follows then), and the data; a remote frame has a length and no data. Source: the protocol as its
//! documentation describes it, and the bytes of the package can-cannelloni 0.1.0, measured.

use super::frame::{FD_BRS, FD_ESI, FD_FDF, Frame};

/// What each end sends first.
pub const GREETING: &[u8] = b"CANNELLONIv1";
/// Longest frame: identifier, length, flags, 64 bytes.
pub const MAX_BYTES: usize = 70;
const FD: u8 = 0x80;

/// What came in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Item {
    /// The other end greeted.
    Greeted,
    /// A frame.
    Frame(Frame),
    /// Nothing after this can be understood, because frames have no mark to find the next one: end the connection.
    Lost(&'static str),
}

/// Takes a byte stream apart. Holds at most one frame.
#[derive(Debug, Clone)]
pub struct Decoder {
    buffer: [u8; MAX_BYTES],
    len: usize,
    state: State,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum State {
    Greeting,
    Frames,
    Lost,
}

impl Default for Decoder {
    fn default() -> Self {
        Self { buffer: [0; MAX_BYTES], len: 0, state: State::Greeting }
    }
}

impl Decoder {
    /// Takes bytes from `input` until something is complete; `None` when all bytes are used up. Call again with
    /// the rest. After [`Item::Lost`] everything is thrown away.
    pub fn next(&mut self, input: &mut &[u8]) -> Option<Item> {
        if self.state == State::Lost {
            *input = &[];
            return None;
        }
        loop {
            let needed = match self.needed() {
                Ok(needed) => needed,
                Err(why) => {
                    self.state = State::Lost;
                    *input = &[];
                    return Some(Item::Lost(why));
                }
            };
            if self.len >= needed {
                return Some(self.complete());
            }
            let take = (needed - self.len).min(input.len());
            if take == 0 {
                return None;
            }
            let (bytes, rest) = input.split_at(take);
            self.buffer[self.len..self.len + take].copy_from_slice(bytes);
            self.len += take;
            *input = rest;
        }
    }

    /// Bytes that the present item has, as far as is known yet.
    fn needed(&self) -> Result<usize, &'static str> {
        if self.state == State::Greeting {
            return if GREETING.starts_with(&self.buffer[..self.len]) {
                Ok(GREETING.len())
            } else {
                Err("it does not greet with CANNELLONIv1")
            };
        }
        if self.len < 5 {
            return Ok(5);
        }
        let length = self.buffer[4];
        let fd = length & FD != 0;
        let bytes = usize::from(length & !FD);
        if bytes > if fd { 64 } else { 8 } {
            return Err("a frame is longer than CAN allows");
        }
        let remote = self.buffer[0] & 0x40 != 0;
        Ok(5 + usize::from(fd) + if remote { 0 } else { bytes })
    }

    fn complete(&mut self) -> Item {
        self.len = 0;
        if self.state == State::Greeting {
            self.state = State::Frames;
            return Item::Greeted;
        }
        let b = &self.buffer;
        let fd = b[4] & FD != 0;
        let mut frame = Frame {
            can_id: u32::from_be_bytes([b[0], b[1], b[2], b[3]]),
            len: b[4] & !FD,
            fd: if fd { FD_FDF | (b[5] & (FD_BRS | FD_ESI)) } else { 0 },
            data: [0; 64],
        };
        let start = 5 + usize::from(fd);
        if !frame.is_remote() {
            let len = usize::from(frame.len);
            frame.data[..len].copy_from_slice(&b[start..start + len]);
        }
        match frame.validate() {
            Ok(()) => Item::Frame(frame),
            Err(_) => {
                self.state = State::Lost;
                Item::Lost("a frame has an identifier or length that CAN does not allow")
            }
        }
    }
}

/// Writes a frame and returns its length. A remote frame goes with length 0: clients differ in whether data follow a
/// length there (can-cannelloni 0.1.0 waits for them), and without a length they agree.
pub fn encode(frame: &Frame, out: &mut [u8; MAX_BYTES]) -> usize {
    out[..4].copy_from_slice(&frame.can_id.to_be_bytes());
    out[4] = if frame.is_remote() { 0 } else { frame.len.min(64) };
    let mut n = 5;
    if frame.is_fd() {
        out[4] |= FD;
        out[5] = frame.fd;
        n = 6;
    }
    let payload = frame.payload();
    out[n..n + payload.len()].copy_from_slice(payload);
    n + payload.len()
}

#[cfg(test)]
mod tests {
    use super::super::frame::tests::any_frame;
    use super::*;
    use proptest::prelude::*;

    fn all(bytes: &[u8]) -> Vec<Item> {
        let (mut decoder, mut rest, mut items) = (Decoder::default(), bytes, Vec::new());
        while let Some(item) = decoder.next(&mut rest) {
            items.push(item);
        }
        assert!(rest.is_empty());
        items
    }

    #[test]
    fn frames_as_they_stand_on_the_wire() {
        let table: [(Frame, &[u8]); 5] = [
            (Frame::data(0x123, false, &[1, 2]).unwrap(), &[0, 0, 1, 0x23, 2, 1, 2]),
            (Frame::data(0x1ABC_DEF0, true, &[]).unwrap(), &[0x9A, 0xBC, 0xDE, 0xF0, 0]),
            (Frame::remote(0x123, false, 0).unwrap(), &[0x40, 0, 1, 0x23, 0]),
            (Frame::fd(1, false, FD_BRS, &[9]).unwrap(), &[0, 0, 0, 1, 0x81, 5, 9]),
            (Frame::fd(1, false, 0, &[]).unwrap(), &[0, 0, 0, 1, 0x80, 4]),
        ];
        for (frame, bytes) in table {
            let mut out = [0; MAX_BYTES];
            let n = encode(&frame, &mut out);
            assert_eq!(&out[..n], bytes);
            assert_eq!(all(&[GREETING, bytes].concat()), [Item::Greeted, Item::Frame(frame)]);
        }
    }

    #[test]
    fn a_remote_frame_with_a_length_is_read_and_written_without() {
        let frame = Frame::remote(0x123, false, 4).unwrap();
        let mut out = [0; MAX_BYTES];
        let n = encode(&frame, &mut out);
        assert_eq!(&out[..n], [0x40, 0, 1, 0x23, 0]);
        assert_eq!(all(b"CANNELLONIv1\x40\0\x01\x23\x04"), [Item::Greeted, Item::Frame(frame)]);
    }

    #[test]
    fn nonsense_ends_it() {
        for (bytes, greeted) in [
            (&b"GET / HTTP/1.1\r\n"[..], false),
            (b"CANNELLONIv2", false),
            (b"CANNELLONIv1\0\0\0\x01\x09", true),
            (b"CANNELLONIv1\0\0\0\x01\xC1", true),
            // 9 bytes of FD, an 11-bit identifier of 12 bits, a remote FD frame.
            (b"CANNELLONIv1\0\0\0\x01\x89\x04123456789", true),
            (b"CANNELLONIv1\0\0\x08\0\0", true),
            (b"CANNELLONIv1\x40\0\0\x01\x80\x04", true),
        ] {
            let items = all(bytes);
            assert_eq!(items.len(), 1 + usize::from(greeted), "{bytes:?}");
            assert!(matches!(items.last(), Some(Item::Lost(_))), "{bytes:?}");
        }
    }

    proptest! {
        #[test]
        fn round_trip_in_any_pieces(frames in prop::collection::vec(any_frame(true), 0..20), cut in 0usize..1400) {
            let mut bytes = GREETING.to_vec();
            for frame in &frames {
                let mut out = [0; MAX_BYTES];
                let n = encode(frame, &mut out);
                bytes.extend_from_slice(&out[..n]);
            }
            let mut decoder = Decoder::default();
            let mut got = Vec::new();
            let (left, right) = bytes.split_at(cut.min(bytes.len()));
            for mut part in [left, right] {
                while let Some(item) = decoder.next(&mut part) {
                    got.push(item);
                }
            }
            let without_length = |mut f: Frame| {
                f.len = if f.is_remote() { 0 } else { f.len };
                Item::Frame(f)
            };
            let expected: Vec<_> = std::iter::once(Item::Greeted).chain(frames.into_iter().map(without_length)).collect();
            prop_assert_eq!(got, expected);
        }

        #[test]
        fn never_panics(bytes in prop::collection::vec(any::<u8>(), 0..400), greet in any::<bool>()) {
            let mut all_bytes = if greet { GREETING.to_vec() } else { Vec::new() };
            all_bytes.extend(bytes);
            all(&all_bytes);
        }
    }
}
