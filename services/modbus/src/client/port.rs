//! A serial service's line as a master uses it: frames out on `<serial>/tx`, echoes and frames in on `<serial>/rx`.
//!
//! The driver does what needs exact time: silence before a frame, the end of a frame. The echo of a request says when
//! its last byte has left, so the response timeout counts from there.

use crate::protocol::{ascii, rtu};
use ipc_types::payload::{SerialChunk, serial_flag};
use ipc_types::port::{Publisher, ReadCounters, SendError, Subscriber};

/// The driver must have begun to send a request within this time.
pub const START_LIMIT_NS: u64 = 2_000_000_000;
/// ... and have ended it within this: 256 bytes at 1200 baud take 2.4 s.
pub const SEND_LIMIT_NS: u64 = 6_000_000_000;
/// Longest frame: ASCII, 513 characters.
const MAX_FRAME: usize = ascii::MAX_ADU;
/// Bytes in front of an answer that do not count: on a line that nothing holds idle, the switching of a direction makes
/// one or two. Only a master may do so: it knows what answer it waits for.
const GLITCH: usize = 2;
/// Chunks taken at a time.
const TAKE: usize = 256;

/// What came from the line.
#[derive(Debug, PartialEq, Eq)]
pub enum Incoming<'a> {
    /// The last request has left; when.
    Sent {
        t_ns: u64,
    },
    /// The last request did not leave.
    NotSent,
    Frame {
        unit: u8,
        pdu: &'a [u8],
        t_ns: u64,
    },
    /// Bytes that are no frame.
    Garbage,
}

/// See the module.
pub struct SerialPort {
    tx: Publisher<SerialChunk>,
    rx: Subscriber<SerialChunk>,
    assembler: Assembler,
    writer: u32,
    generation: u32,
    awaited: Option<u64>,
}

impl SerialPort {
    /// `writer` and `generation` are the service's own.
    pub fn new(
        tx: Publisher<SerialChunk>,
        rx: Subscriber<SerialChunk>,
        ascii: bool,
        writer: u32,
        generation: u32,
    ) -> Self {
        Self { tx, rx, assembler: Assembler::new(ascii), writer, generation, awaited: None }
    }

    /// Hands a request to the driver.
    pub fn send(&mut self, unit: u8, pdu: &[u8], now_ns: u64) -> Result<(), SendError> {
        let header = SerialChunk {
            first_t_ns: now_ns.saturating_add(START_LIMIT_NS),
            flags: serial_flag::END | serial_flag::EXPECT_ANSWER,
            ..SerialChunk::default()
        };
        let seq = if self.assembler.ascii {
            let mut frame = [0; ascii::MAX_ADU];
            let len = ascii::encode(unit, pdu, &mut frame);
            self.tx.send_tail(header, &frame[..len])?
        } else {
            let mut frame = [0; rtu::MAX_ADU];
            let len = rtu::encode(unit, pdu, &mut frame);
            self.tx.send_tail(header, &frame[..len])?
        };
        self.tx.ring();
        self.awaited = Some(seq);
        Ok(())
    }

    /// Hands over what came; `false`: there may be more.
    pub fn drain(&mut self, mut take: impl FnMut(Incoming<'_>)) -> bool {
        let Self { rx, assembler, writer, generation, awaited, .. } = self;
        let taken = rx.drain(TAKE, |chunk, bytes| {
            if chunk.flags & serial_flag::TX_ECHO == 0 {
                assembler.chunk(chunk.flags, bytes, chunk.stamp.t_ns, &mut take);
                return;
            }
            // Somebody else's on the same line: what came before belongs to nothing any more.
            assembler.len = 0;
            if chunk.tx_writer != *writer
                || chunk.tx_generation != *generation
                || Some(chunk.tx_seq) != *awaited
            {
                return;
            }
            if chunk.flags & serial_flag::NOT_SENT != 0 {
                *awaited = None;
                take(Incoming::NotSent);
            } else if chunk.flags & serial_flag::END != 0 {
                *awaited = None;
                take(Incoming::Sent { t_ns: chunk.stamp.t_ns });
            }
        });
        taken < TAKE
    }

    pub fn counters(&self) -> ReadCounters {
        self.rx.counters()
    }
}

/// Puts chunks together to frames.
pub struct Assembler {
    ascii: bool,
    frame: [u8; MAX_FRAME],
    len: usize,
    /// A part of the frame was damaged or did not fit.
    bad: bool,
}

impl Assembler {
    pub fn new(ascii: bool) -> Self {
        Self { ascii, frame: [0; MAX_FRAME], len: 0, bad: false }
    }

    /// A chunk with its [`serial_flag`]s.
    pub fn chunk(&mut self, flags: u32, bytes: &[u8], t_ns: u64, take: &mut impl FnMut(Incoming<'_>)) {
        if flags & serial_flag::DAMAGED != 0 {
            self.bad = true;
        }
        let room = bytes.len().min(MAX_FRAME - self.len);
        self.bad |= room < bytes.len();
        self.frame[self.len..self.len + room].copy_from_slice(&bytes[..room]);
        self.len += room;
        if flags & serial_flag::END == 0 {
            return;
        }
        let (len, bad) = (std::mem::take(&mut self.len), std::mem::take(&mut self.bad));
        let frame = &self.frame[..len];
        if bad {
            return take(Incoming::Garbage);
        }
        if self.ascii {
            let mut pdu = [0; 256];
            // A colon restarts a frame (V1.02, 2.5.2.1): noise before it does not count.
            let frame = frame.iter().rposition(|&b| b == b':').map_or(frame, |at| &frame[at..]);
            match ascii::decode(frame, &mut pdu) {
                Ok((unit, pdu)) => take(Incoming::Frame { unit, pdu, t_ns }),
                Err(_) => take(Incoming::Garbage),
            }
        } else {
            let found = (0..=GLITCH).find_map(|skip| rtu::decode(frame.get(skip..)?).ok());
            match found {
                Some((unit, pdu)) => take(Incoming::Frame { unit, pdu, t_ns }),
                None => take(Incoming::Garbage),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn told(assembler: &mut Assembler, flags: u32, bytes: &[u8]) -> Vec<String> {
        let mut said = Vec::new();
        assembler.chunk(flags, bytes, 7, &mut |incoming| said.push(format!("{incoming:02X?}")));
        said
    }

    #[test]
    fn frames_in_one_or_more_chunks() {
        let mut frame = [0; rtu::MAX_ADU];
        let len = rtu::encode(5, &[3, 2, 0, 7], &mut frame);
        let (a, b) = frame[..len].split_at(3);
        let mut line = Assembler::new(false);
        let whole = ["Frame { unit: 05, pdu: [03, 02, 00, 07], t_ns: 07 }"];
        assert_eq!(told(&mut line, serial_flag::END, &frame[..len]), whole);
        assert!(told(&mut line, 0, a).is_empty());
        assert_eq!(told(&mut line, serial_flag::END, b), whole);
        assert_eq!(told(&mut line, serial_flag::END, b), ["Garbage"]);
        assert_eq!(told(&mut line, serial_flag::END | serial_flag::PARITY, &frame[..len]), ["Garbage"]);
        assert!(told(&mut line, 0, &[1; 600]).is_empty());
        assert_eq!(told(&mut line, serial_flag::END, &[]), ["Garbage"]);
        assert_eq!(told(&mut line, serial_flag::END, &frame[..len]), whole);
        // What the switching of a direction puts in front of it.
        for (glitch, answer) in
            [(&[0xFF][..], &whole[..]), (&[0, 0xFF], &whole[..]), (&[0, 0, 0], &["Garbage"])]
        {
            let bytes = [glitch, &frame[..len]].concat();
            assert_eq!(told(&mut line, serial_flag::END, &bytes), answer);
        }
        assert_eq!(told(&mut line, serial_flag::END, &[0xFF]), ["Garbage"]);
        let mut frame = [0; ascii::MAX_ADU];
        let len = ascii::encode(5, &[3, 2, 0, 7], &mut frame);
        let mut line = Assembler::new(true);
        let mut noisy = b"\xFF:03".to_vec();
        noisy.extend(&frame[..len]);
        assert_eq!(told(&mut line, serial_flag::END, &noisy), whole);
    }

    proptest! {
        #[test]
        fn any_bytes(chunks in prop::collection::vec((any::<u32>(), prop::collection::vec(any::<u8>(), 0..300)), 0..20), ascii: bool) {
            let mut line = Assembler::new(ascii);
            for (flags, bytes) in chunks {
                let _ = told(&mut line, flags, &bytes);
            }
        }
    }
}
