//! SLCAN, the text protocol of Lawicel adapters and their CAN FD extension (CANable), server side.
//!
//! [`Decoder`] turns bytes into [`Command`]s, [`Session`] answers them and says which frames to transmit,
//! [`encode`] writes a received frame. Sources: Lawicel CANUSB manual 1.0D; CANable 2.0 firmware commands
//! `d D b B Y`; behaviour of python-can 4.6.1 and of can-utils' slcanpty, measured.
//!
//! What a client sends is never lost here; what it asks for in nonsense is answered with BEL.

use super::frame::{EFF_MASK, FD_BRS, FD_LENGTHS, Frame, SFF_MASK};
use super::hex::{self, Writer};

/// Positive answer.
pub const OK: &[u8] = b"\r";
/// Negative answer.
pub const BEL: &[u8] = b"\x07";

/// Longest line taken: `B` + 8 + 1 + 128 digits and room for a stamp. Longer lines are answered with BEL.
pub const MAX_LINE: usize = 160;

/// Longest text [`encode`] writes, with stamp and CR.
pub const MAX_TEXT: usize = 144;

/// One line of a client.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Command {
    /// Empty line: harmless, used by clients to flush.
    Empty,
    /// `t T r R d D b B`: put this frame on the bus.
    Transmit(Frame),
    /// `O` or `L`: open the channel, `L` to listen only.
    Open {
        /// True for `L`.
        listen_only: bool,
    },
    /// `C`: close the channel.
    Close,
    /// `S0`-`S9`: bit rate in bit/s.
    Bitrate(u32),
    /// `sxxyy`: bit timing registers BTR0 and BTR1.
    BitTiming(u16),
    /// `Y0`-`Y9`: CAN FD data bit rate in Mbit/s (0 = none).
    DataBitrate(u8),
    /// `V`: hardware and software version.
    Version,
    /// `v`: detailed version.
    DetailedVersion,
    /// `N`: serial number.
    SerialNumber,
    /// `F`: status flags.
    StatusFlags,
    /// `Z0`, `Z1`: stamps after received frames off or on.
    Timestamps(bool),
    /// `Mxxxxxxxx`: acceptance code.
    AcceptanceCode(u32),
    /// `mxxxxxxxx`: acceptance mask.
    AcceptanceMask(u32),
    /// Anything else, or a line that is too long.
    Nonsense,
}

/// Bit rates of `S0`-`S8` (Lawicel) and `S9` (python-can, CANable).
const BITRATES: [u32; 10] =
    [10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 750_000, 1_000_000, 83_300];

/// Splits a byte stream into commands. Holds at most one line.
#[derive(Debug, Clone)]
pub struct Decoder {
    line: [u8; MAX_LINE],
    len: usize,
    overlong: bool,
}

impl Default for Decoder {
    fn default() -> Self {
        Self { line: [0; MAX_LINE], len: 0, overlong: false }
    }
}

impl Decoder {
    /// Takes bytes from `input` until one command is complete; `None` when all bytes are used up.
    /// Call again with the rest.
    pub fn next(&mut self, input: &mut &[u8]) -> Option<Command> {
        while let Some((&byte, rest)) = input.split_first() {
            *input = rest;
            match byte {
                b'\r' => {
                    let command =
                        if self.overlong { Command::Nonsense } else { parse(&self.line[..self.len]) };
                    self.len = 0;
                    self.overlong = false;
                    return Some(command);
                }
                // Terminals send CR LF; the protocol knows CR only.
                b'\n' => {}
                _ if self.len < MAX_LINE => {
                    self.line[self.len] = byte;
                    self.len += 1;
                }
                _ => self.overlong = true,
            }
        }
        None
    }
}

fn parse(line: &[u8]) -> Command {
    let Some((&letter, rest)) = line.split_first() else { return Command::Empty };
    let command = match letter {
        b't' | b'T' | b'r' | b'R' | b'd' | b'D' | b'b' | b'B' => {
            transmit(letter, rest).map(Command::Transmit)
        }
        b'O' if rest.is_empty() => Some(Command::Open { listen_only: false }),
        b'L' if rest.is_empty() => Some(Command::Open { listen_only: true }),
        b'C' if rest.is_empty() => Some(Command::Close),
        b'S' => single_digit(rest).map(|d| Command::Bitrate(BITRATES[d as usize])),
        b's' if rest.len() == 4 => hex::number(rest).map(|n| Command::BitTiming(n as u16)),
        b'Y' => single_digit(rest).map(Command::DataBitrate),
        b'V' if rest.is_empty() => Some(Command::Version),
        b'v' if rest.is_empty() => Some(Command::DetailedVersion),
        b'N' if rest.is_empty() => Some(Command::SerialNumber),
        b'F' if rest.is_empty() => Some(Command::StatusFlags),
        b'Z' if rest == b"0" => Some(Command::Timestamps(false)),
        b'Z' if rest == b"1" => Some(Command::Timestamps(true)),
        b'M' if rest.len() == 8 => hex::number(rest).map(Command::AcceptanceCode),
        b'm' if rest.len() == 8 => hex::number(rest).map(Command::AcceptanceMask),
        _ => None,
    };
    command.unwrap_or(Command::Nonsense)
}

fn single_digit(text: &[u8]) -> Option<u8> {
    match text {
        [d @ b'0'..=b'9'] => Some(d - b'0'),
        _ => None,
    }
}

/// Identifier, data length code, data; text after the data (a stamp) is ignored.
pub(super) fn transmit(letter: u8, rest: &[u8]) -> Option<Frame> {
    let extended = letter.is_ascii_uppercase();
    let (id_text, rest) = rest.split_at_checked(if extended { 8 } else { 3 })?;
    let id = hex::number(id_text).filter(|&id| id <= if extended { EFF_MASK } else { SFF_MASK })?;
    let (&code, text) = rest.split_first()?;
    let code = hex::nibble(code)?;
    let mut data = [0u8; 64];
    let kind = letter.to_ascii_lowercase();
    match kind {
        b'r' => Frame::remote(id, extended, code).ok(),
        b't' if code <= 8 => {
            let n = hex::bytes(text.get(..2 * code as usize)?, &mut data)?;
            Frame::data(id, extended, &data[..n]).ok()
        }
        b'd' | b'b' => {
            let len = FD_LENGTHS[code as usize] as usize;
            let n = hex::bytes(text.get(..2 * len)?, &mut data)?;
            Frame::fd(id, extended, if kind == b'b' { FD_BRS } else { 0 }, &data[..n]).ok()
        }
        _ => None,
    }
}

/// What the server does with a command.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Action {
    /// Send this answer.
    Reply(&'static [u8]),
    /// Put the frame on the bus, then send `ack`.
    Transmit {
        /// The frame.
        frame: Frame,
        /// `z` or `Z` with CR.
        ack: &'static [u8],
    },
}

/// State of one SLCAN client: channel open or closed, stamps on or off.
///
/// Bit rate, bit timing and acceptance commands are answered and have no effect: the bus has one bit rate, set
/// in the stack file, and every client gets every frame.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Session {
    open: bool,
    listen_only: bool,
    timestamps: bool,
}

impl Session {
    /// True while frames of the bus go to this client.
    pub fn receives(&self) -> bool {
        self.open
    }

    /// True when [`encode`] shall append stamps.
    pub fn timestamps(&self) -> bool {
        self.timestamps
    }

    /// Answers one command. Transmission needs an open channel that is not listen-only, set-up commands a
    /// closed one (Lawicel manual, each command's "only active if"); stamps may be switched at any time.
    pub fn handle(&mut self, command: &Command) -> Action {
        let reply = match *command {
            Command::Transmit(frame) => {
                if !self.open || self.listen_only {
                    return Action::Reply(BEL);
                }
                let ack: &[u8] = if frame.is_extended() { b"Z\r" } else { b"z\r" };
                return Action::Transmit { frame, ack };
            }
            Command::Empty => OK,
            Command::Open { listen_only } => {
                self.open = true;
                self.listen_only = listen_only;
                OK
            }
            Command::Close => {
                self.open = false;
                OK
            }
            Command::Bitrate(_) | Command::BitTiming(_) | Command::DataBitrate(_) => {
                if self.open {
                    BEL
                } else {
                    OK
                }
            }
            Command::Timestamps(on) => {
                self.timestamps = on;
                OK
            }
            Command::AcceptanceCode(_) | Command::AcceptanceMask(_) => OK,
            Command::Version => b"V1013\r",
            Command::DetailedVersion => b"v1014\r",
            Command::SerialNumber => b"NDR01\r",
            Command::StatusFlags => b"F00\r",
            Command::Nonsense => BEL,
        };
        Action::Reply(reply)
    }
}

/// Writes `frame` as an SLCAN client expects it, with CR, and returns the length. `stamp_ms` (any value, taken
/// modulo 60,000) is appended as four digits. Error frames have no form in SLCAN: 0 bytes.
pub fn encode(frame: &Frame, stamp_ms: Option<u64>, out: &mut [u8; MAX_TEXT]) -> usize {
    if frame.is_error() {
        return 0;
    }
    let mut w = Writer::new(out);
    let letter = match (frame.is_fd(), frame.fd & FD_BRS != 0, frame.is_remote()) {
        (true, true, _) => b'b',
        (true, false, _) => b'd',
        (false, _, true) => b'r',
        (false, _, false) => b't',
    };
    if frame.is_extended() {
        w.byte(letter.to_ascii_uppercase());
        w.hex(frame.id(), 8);
    } else {
        w.byte(letter);
        w.hex(frame.id(), 3);
    }
    w.hex(u32::from(frame.dlc()), 1);
    w.hex_bytes(frame.payload());
    if let Some(ms) = stamp_ms {
        w.hex((ms % 60_000) as u32, 4);
    }
    w.byte(b'\r');
    w.len()
}

#[cfg(test)]
mod tests {
    use super::super::frame::{FD_ESI, tests::any_frame};
    use super::*;
    use proptest::prelude::*;

    fn one(text: &[u8]) -> Command {
        let mut decoder = Decoder::default();
        let mut rest = text;
        let command = decoder.next(&mut rest).unwrap();
        assert!(rest.is_empty());
        command
    }

    fn text(frame: &Frame, stamp: Option<u64>) -> String {
        let mut out = [0; MAX_TEXT];
        let n = encode(frame, stamp, &mut out);
        String::from_utf8(out[..n].to_vec()).unwrap()
    }

    #[test]
    fn commands() {
        let table: &[(&str, Command)] = &[
            ("\r", Command::Empty),
            ("O\r", Command::Open { listen_only: false }),
            ("L\r", Command::Open { listen_only: true }),
            ("C\r", Command::Close),
            ("S0\r", Command::Bitrate(10_000)),
            ("S6\r", Command::Bitrate(500_000)),
            ("S8\r", Command::Bitrate(1_000_000)),
            ("S9\r", Command::Bitrate(83_300)),
            ("s011C\r", Command::BitTiming(0x011C)),
            ("Y2\r", Command::DataBitrate(2)),
            ("Y5\r", Command::DataBitrate(5)),
            ("V\r", Command::Version),
            ("v\r", Command::DetailedVersion),
            ("N\r", Command::SerialNumber),
            ("F\r", Command::StatusFlags),
            ("Z0\r", Command::Timestamps(false)),
            ("Z1\r", Command::Timestamps(true)),
            ("M00000000\r", Command::AcceptanceCode(0)),
            ("mFFFFFFFF\r", Command::AcceptanceMask(0xFFFF_FFFF)),
            ("\nO\r", Command::Open { listen_only: false }),
        ];
        for (line, expected) in table {
            assert_eq!(one(line.as_bytes()), *expected, "{line:?}");
        }
    }

    #[test]
    fn frames_both_ways() {
        let table = [
            ("t1230\r", Frame::data(0x123, false, &[]).unwrap()),
            (
                "t7FF81122334455667788\r",
                Frame::data(0x7FF, false, &[0x11, 0x22, 0x33, 0x44, 0x55, 0x66, 0x77, 0x88]).unwrap(),
            ),
            ("T000001232ABCD\r", Frame::data(0x123, true, &[0xAB, 0xCD]).unwrap()),
            ("T1FFFFFFF0\r", Frame::data(0x1FFF_FFFF, true, &[]).unwrap()),
            ("r1234\r", Frame::remote(0x123, false, 4).unwrap()),
            ("R123456788\r", Frame::remote(0x1234_5678, true, 8).unwrap()),
            (
                "d1239000102030405060708090A0B\r",
                Frame::fd(0x123, false, 0, &[0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11]).unwrap(),
            ),
            ("D000001230\r", Frame::fd(0x123, true, 0, &[]).unwrap()),
            ("b0012AABB\r", Frame::fd(1, false, FD_BRS, &[0xAA, 0xBB]).unwrap()),
            ("B1FFFFFFF15A\r", Frame::fd(0x1FFF_FFFF, true, FD_BRS, &[0x5A]).unwrap()),
        ];
        for (line, frame) in table {
            assert_eq!(one(line.as_bytes()), Command::Transmit(frame), "{line:?}");
            assert_eq!(text(&frame, None), line);
        }
        // A stamp after the data is ignored.
        assert_eq!(one(b"t1231AA1F40\r"), Command::Transmit(Frame::data(0x123, false, &[0xAA]).unwrap()));
        assert_eq!(
            text(&Frame::data(0x123, false, &[0xAA]).unwrap(), Some(60_000 + 0x1F40)),
            "t1231AA1F40\r"
        );
        let error = Frame { can_id: super::super::frame::ERR_FLAG | 0x40, len: 8, ..Frame::default() };
        assert_eq!(text(&error, None), "");
        // SLCAN has no place for ESI.
        assert_eq!(text(&Frame::fd(1, false, FD_ESI, &[]).unwrap(), None), "d0010\r");
    }

    #[test]
    fn nonsense_is_refused() {
        let overlong = format!("t{}\r", "0".repeat(500));
        for line in [
            "x\r",
            "t\r",
            "t12\r",
            "t123\r",
            "t1231\r",
            "t1231A\r",
            "t1239\r",
            "t8000\r",
            "tXYZ0\r",
            "T200000000\r",
            "r1239\r",
            "S\r",
            "SA\r",
            "S10\r",
            "Z2\r",
            "OO\r",
            "d123F00\r",
            "m0\r",
            "s1\r",
            "Yx\r",
            "t1231GG\r",
            overlong.as_str(),
        ] {
            assert_eq!(one(line.as_bytes()), Command::Nonsense, "{line:?}");
        }
        // After an overlong line the next one is good again.
        let mut decoder = Decoder::default();
        let all = format!("{overlong}t1230\r");
        let mut rest = all.as_bytes();
        assert_eq!(decoder.next(&mut rest), Some(Command::Nonsense));
        assert!(matches!(decoder.next(&mut rest), Some(Command::Transmit(_))));
    }

    #[test]
    fn session_of_python_can() {
        let mut session = Session::default();
        let mut decoder = Decoder::default();
        let mut rest: &[u8] = b"C\rS8\r\rO\rt1230\rT000001230\rC\rt1230\rL\rt1230\rS6\rZ1\r";
        let mut answers = Vec::new();
        while let Some(command) = decoder.next(&mut rest) {
            answers.push(match session.handle(&command) {
                Action::Reply(reply) => reply,
                Action::Transmit { ack, .. } => ack,
            });
        }
        let expected: [&[u8]; 12] = [OK, OK, OK, OK, b"z\r", b"Z\r", OK, BEL, OK, BEL, BEL, OK];
        assert_eq!(answers, expected);
        assert!(session.receives() && session.timestamps());
    }

    proptest! {
        #[test]
        fn round_trip(frame in any_frame(false), stamp in prop::option::of(any::<u64>())) {
            prop_assert_eq!(one(text(&frame, stamp).as_bytes()), Command::Transmit(frame));
        }

        #[test]
        fn never_panics_and_cuts_the_same_everywhere(
            bytes in prop::collection::vec(prop_oneof![any::<u8>(), prop::sample::select(b"tTrRdDbBOCS0123\r".to_vec())], 0..400),
            cut in 0usize..400,
        ) {
            let mut whole = Vec::new();
            let mut decoder = Decoder::default();
            let mut rest = &bytes[..];
            while let Some(command) = decoder.next(&mut rest) {
                whole.push(command);
            }
            let mut parts = Vec::new();
            let mut decoder = Decoder::default();
            let (left, right) = bytes.split_at(cut.min(bytes.len()));
            for mut part in [left, right] {
                while let Some(command) = decoder.next(&mut part) {
                    parts.push(command);
                }
            }
            prop_assert_eq!(whole, parts);
        }
    }
}
