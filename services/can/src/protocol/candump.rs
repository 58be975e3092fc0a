//! Text forms of frames used by can-utils: `123#DEADBEEF` (cansend, the log), the log line of `candump -L`
//! and the screen line of `candump`.
//!
//! Forms: `ID#HEX` classic, `ID#R` or `ID#R4` remote, `ID##F HEX` (no blank) FD with one hex digit of flags.
//! Three digits are an 11-bit identifier, eight a 29-bit one; eight digits with bit 29 (20000000) are an error
//! frame. Source: behaviour of can-utils and of python-can's log reader.

use thiserror::Error;

use super::frame::{EFF_FLAG, EFF_MASK, ERR_FLAG, FD_FDF, Frame, FrameError};
use super::hex::{self, Writer};

/// Longest text of [`encode`].
pub const MAX_FRAME_TEXT: usize = 144;

/// Longest log line taken, without its line end.
pub const MAX_LINE: usize = 512;

/// Why a text is not a frame or not a log line.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum ParseError {
    /// No `#` between identifier and data.
    #[error("`{0}` is not a frame: write ID#DATA, for example 123#DEADBEEF, 123#R or 12345678##1AABB")]
    NoSeparator(String),
    /// Identifier has neither 3 nor 8 hex digits.
    #[error("identifier `{0}` must have 3 hex digits (11 bits) or 8 (29 bits)")]
    Identifier(String),
    /// Data is not pairs of hex digits.
    #[error("data `{0}` must be pairs of hex digits, at most 64 bytes")]
    Data(String),
    /// The digit after `##` is missing or no hex digit.
    #[error(
        "after ## one hex digit of CAN FD flags is needed: 0 none, 1 bit rate switch, 2 error state, 3 both"
    )]
    FdFlags,
    /// `R` is followed by something other than one digit 0-8.
    #[error("remote frame length `{0}` must be one digit, 0-8")]
    RemoteLength(String),
    /// No such frame on a CAN bus.
    #[error(transparent)]
    Frame(#[from] FrameError),
    /// The stamp is not `(seconds.fraction)`.
    #[error("stamp `{0}` must be (SECONDS.FRACTION), for example (1543509533.000838)")]
    Stamp(String),
    /// Not stamp, bus and frame.
    #[error("a candump log line is `(SECONDS.FRACTION) BUS ID#DATA`")]
    Columns,
    /// Longer than [`MAX_LINE`].
    #[error("line of {0} characters: the longest candump log line has 512")]
    TooLong(usize),
}

/// One line of a candump log.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LogLine<'a> {
    /// Stamp in nanoseconds, UTC if the log was made by `candump -L`.
    pub t_ns: u64,
    /// Name of the bus.
    pub bus: &'a str,
    /// The frame.
    pub frame: Frame,
    /// Marked `T`: sent by the one who logged.
    pub tx: bool,
}

/// Reads `123#DEADBEEF` and its relatives; dots between data bytes are allowed as in cansend.
pub fn parse(text: &str) -> Result<Frame, ParseError> {
    let (id_text, body) =
        text.split_once('#').ok_or_else(|| ParseError::NoSeparator(text.chars().take(40).collect()))?;
    let bad_id = || ParseError::Identifier(id_text.chars().take(40).collect());
    let id = hex::number(id_text.as_bytes()).ok_or_else(bad_id)?;
    let extended = match id_text.len() {
        3 => false,
        8 => true,
        _ => return Err(bad_id()),
    };
    if extended && id & ERR_FLAG != 0 && id & !(ERR_FLAG | EFF_MASK) == 0 {
        let mut frame = Frame { can_id: id, ..Frame::default() };
        frame.len = payload(body, &mut frame.data)?;
        frame.validate()?;
        return Ok(frame);
    }
    if extended && id > EFF_MASK {
        return Err(FrameError::ExtendedId(id).into());
    }
    let mut data = [0u8; 64];
    if let Some(fd) = body.strip_prefix('#') {
        let flags = fd.bytes().next().and_then(hex::nibble).ok_or(ParseError::FdFlags)?;
        let len = payload(&fd[1..], &mut data)?;
        return Ok(Frame::fd(id, extended, flags, &data[..len as usize])?);
    }
    if let Some(len) = body.strip_prefix(['R', 'r']) {
        let len = match len.as_bytes() {
            [] => 0,
            [d @ b'0'..=b'8'] => d - b'0',
            _ => return Err(ParseError::RemoteLength(len.chars().take(40).collect())),
        };
        return Ok(Frame::remote(id, extended, len)?);
    }
    let len = payload(body, &mut data)?;
    Ok(Frame::data(id, extended, &data[..len as usize])?)
}

/// Pairs of hex digits, single dots between pairs allowed.
fn payload(text: &str, data: &mut [u8; 64]) -> Result<u8, ParseError> {
    let bad = || ParseError::Data(text.chars().take(140).collect());
    let mut rest = text.as_bytes();
    let mut len = 0usize;
    while !rest.is_empty() {
        if len > 0 && rest[0] == b'.' {
            rest = &rest[1..];
        }
        let pair = rest.get(..2).ok_or_else(bad)?;
        let slot = data.get_mut(len).ok_or_else(bad)?;
        hex::bytes(pair, std::slice::from_mut(slot)).ok_or_else(bad)?;
        rest = &rest[2..];
        len += 1;
    }
    Ok(len as u8)
}

/// Writes `123#DEADBEEF` and its relatives; returns the length.
pub fn encode(frame: &Frame, out: &mut [u8; MAX_FRAME_TEXT]) -> usize {
    let mut w = Writer::new(out);
    if frame.is_error() {
        w.hex(frame.can_id & (ERR_FLAG | EFF_MASK), 8);
    } else if frame.can_id & EFF_FLAG != 0 {
        w.hex(frame.id(), 8);
    } else {
        w.hex(frame.id(), 3);
    }
    w.byte(b'#');
    if frame.is_fd() {
        w.byte(b'#');
        w.hex(u32::from(frame.fd & !FD_FDF), 1);
    }
    if frame.is_remote() && !frame.is_error() {
        w.byte(b'R');
        if frame.len > 0 {
            w.decimal(u64::from(frame.len), 1);
        }
    } else {
        w.hex_bytes(frame.payload());
    }
    w.len()
}

/// `123#DEADBEEF` and its relatives, as a string.
pub fn format(frame: &Frame) -> String {
    let mut out = [0; MAX_FRAME_TEXT];
    let n = encode(frame, &mut out);
    String::from_utf8_lossy(&out[..n]).into_owned()
}

/// Reads one line of a candump log. Empty lines and lines that begin with `#` are `None`; a trailing `R` or `T`
/// is the direction (`candump -x`, python-can). Stamp digits beyond nanoseconds are left out.
pub fn parse_log_line(line: &str) -> Result<Option<LogLine<'_>>, ParseError> {
    if line.len() > MAX_LINE {
        return Err(ParseError::TooLong(line.len()));
    }
    let mut words = line.split_ascii_whitespace();
    let Some(stamp) = words.next() else { return Ok(None) };
    if stamp.starts_with('#') {
        return Ok(None);
    }
    let t_ns = parse_stamp(stamp)?;
    let (Some(bus), Some(text)) = (words.next(), words.next()) else { return Err(ParseError::Columns) };
    let tx = match (words.next(), words.next()) {
        (None | Some("R" | "r"), None) => false,
        (Some("T" | "t"), None) => true,
        _ => return Err(ParseError::Columns),
    };
    Ok(Some(LogLine { t_ns, bus, frame: parse(text)?, tx }))
}

fn parse_stamp(text: &str) -> Result<u64, ParseError> {
    let inner = text.strip_prefix('(').and_then(|t| t.strip_suffix(')'));
    inner.and_then(super::logfile::seconds).ok_or_else(|| ParseError::Stamp(text.chars().take(40).collect()))
}

/// One line as `candump -L` writes it, without line end.
pub fn format_log_line(t_ns: u64, bus: &str, frame: &Frame) -> String {
    let mut stamp = [0; 32];
    let mut w = Writer::new(&mut stamp);
    w.seconds(t_ns, 10);
    let n = w.len();
    format!("({}) {bus} {}", String::from_utf8_lossy(&stamp[..n]), format(frame))
}

/// One line as `candump` shows it on a screen: `  can0  123   [4]  DE AD BE EF`; with `t_ns`, as `candump -ta`.
pub fn format_screen(t_ns: Option<u64>, bus: &str, frame: &Frame) -> String {
    use std::fmt::Write as _;
    let mut line = String::with_capacity(256);
    if let Some(t_ns) = t_ns {
        let mut stamp = [0; 32];
        let mut w = Writer::new(&mut stamp);
        w.seconds(t_ns, 10);
        let n = w.len();
        let _ = write!(line, " ({})", String::from_utf8_lossy(&stamp[..n]));
    }
    let _ = write!(line, "  {bus}  ");
    if frame.is_error() {
        let _ = write!(line, "{:08X}", frame.can_id & (ERR_FLAG | EFF_MASK));
    } else if frame.is_extended() {
        let _ = write!(line, "{:08X}", frame.id());
    } else {
        let _ = write!(line, "{:03X}", frame.id());
    }
    if frame.is_fd() {
        let _ = write!(line, "  [{:02}] ", frame.len);
    } else {
        let _ = write!(line, "   [{}] ", frame.len);
    }
    if frame.is_remote() && !frame.is_error() {
        line.push_str(" remote request");
    }
    for byte in frame.payload() {
        let _ = write!(line, " {byte:02X}");
    }
    if frame.is_error() {
        line.push_str("   ERRORFRAME");
    }
    line
}

#[cfg(test)]
mod tests {
    use super::super::frame::{FD_BRS, FD_ESI, tests::any_frame};
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn text_forms() {
        let table = [
            ("123#DEADBEEF", Frame::data(0x123, false, &[0xDE, 0xAD, 0xBE, 0xEF])),
            ("7FF#", Frame::data(0x7FF, false, &[])),
            ("00000123#01", Frame::data(0x123, true, &[1])),
            ("123#R", Frame::remote(0x123, false, 0)),
            ("1FFFFFFF#R8", Frame::remote(0x1FFF_FFFF, true, 8)),
            ("123##1AABB", Frame::fd(0x123, false, FD_BRS, &[0xAA, 0xBB])),
            ("123##0", Frame::fd(0x123, false, 0, &[])),
            (
                "12345678##3010203040506070809101112",
                Frame::fd(0x1234_5678, true, FD_BRS | FD_ESI, &[1, 2, 3, 4, 5, 6, 7, 8, 9, 0x10, 0x11, 0x12]),
            ),
        ];
        for (text, frame) in table {
            let frame = frame.unwrap();
            assert_eq!(parse(text), Ok(frame), "{text}");
            assert_eq!(format(&frame), text);
        }
        assert_eq!(parse("123#de.ad.BE.EF"), parse("123#DEADBEEF"));
        assert_eq!(parse("123#r0"), parse("123#R"));
        let error = parse("20000080#0000000000000000").unwrap();
        assert!(error.is_error() && error.len == 8);
        assert_eq!(format(&error), "20000080#0000000000000000");
    }

    #[test]
    fn mistakes_are_named() {
        let said: Vec<String> = [
            "123",
            "12#00",
            "1234#00",
            "XYZ#00",
            "800#00",
            "40000000#00",
            "123#0",
            "123#00.",
            "123#0G",
            "123#R9",
            "123#Rx",
            "123#001122334455667788",
            "123##",
            "123##x",
            "123##0001122334455667788",
            "123##8",
            "123#11_E",
        ]
        .iter()
        .map(|text| format!("{text}: {}", parse(text).unwrap_err()))
        .collect();
        insta::assert_snapshot!(said.join("\n"), @r#"
        123: `123` is not a frame: write ID#DATA, for example 123#DEADBEEF, 123#R or 12345678##1AABB
        12#00: identifier `12` must have 3 hex digits (11 bits) or 8 (29 bits)
        1234#00: identifier `1234` must have 3 hex digits (11 bits) or 8 (29 bits)
        XYZ#00: identifier `XYZ` must have 3 hex digits (11 bits) or 8 (29 bits)
        800#00: identifier 800 needs 29 bits: write it with 8 digits, or use at most 7FF for 11 bits
        40000000#00: identifier 40000000 is above 1FFFFFFF, the largest 29-bit identifier
        123#0: data `0` must be pairs of hex digits, at most 64 bytes
        123#00.: data `00.` must be pairs of hex digits, at most 64 bytes
        123#0G: data `0G` must be pairs of hex digits, at most 64 bytes
        123#R9: remote frame length `9` must be one digit, 0-8
        123#Rx: remote frame length `x` must be one digit, 0-8
        123#001122334455667788: 9 data bytes: a classic frame carries at most 8, only CAN FD carries more
        123##: after ## one hex digit of CAN FD flags is needed: 0 none, 1 bit rate switch, 2 error state, 3 both
        123##x: after ## one hex digit of CAN FD flags is needed: 0 none, 1 bit rate switch, 2 error state, 3 both
        123##0001122334455667788: 9 data bytes: CAN FD carries 0-8, 12, 16, 20, 24, 32, 48 or 64
        123##8: CAN FD flags 0C are not valid: FDF (04) is missing or bits above 07 are set
        123#11_E: data `11_E` must be pairs of hex digits, at most 64 bytes
        "#);
    }

    #[test]
    fn log_lines() {
        let line = "(1543509533.000838) can0 10FDA300#FFFF07FFFFFFFFFF";
        let parsed = parse_log_line(line).unwrap().unwrap();
        assert_eq!((parsed.t_ns, parsed.bus), (1_543_509_533_000_838_000, "can0"));
        assert_eq!(format_log_line(parsed.t_ns, parsed.bus, &parsed.frame), line);
        for (line, t_ns) in [
            ("(166.000000) vcan0 21A#FE3612FE690507AD\r\n", 166_000_000_000),
            ("(14.9447040558) can0 1CECFF00#20220005FFE3FE00", 14_944_704_055),
            ("(0.1) vcan0 123# R", 100_000_000),
            ("(7) vcan0 123#R T", 7_000_000_000),
        ] {
            assert_eq!(parse_log_line(line).unwrap().unwrap().t_ns, t_ns, "{line}");
        }
        assert_eq!(parse_log_line("  \r\n"), Ok(None));
        assert_eq!(parse_log_line("# made by hand"), Ok(None));
        let long = format!("(1.0) can0 123#{}", "0".repeat(600));
        let said: Vec<String> = [
            "1 (1612543138.000000) vcan0 18EF000B#00",
            "(x) can0 123#00",
            "(1.-5) can0 123#00",
            "(1.00000000é) can0 123#00",
            "(1.0) can0",
            "(1.0) can0 123#00 Q",
            "(99999999999999.0) can0 123#00",
            "(1.0) can0 123#0",
            &long,
        ]
        .iter()
        .map(|text| format!("{}", parse_log_line(text).unwrap_err()))
        .collect();
        insta::assert_snapshot!(said.join("\n"), @r#"
        stamp `1` must be (SECONDS.FRACTION), for example (1543509533.000838)
        stamp `(x)` must be (SECONDS.FRACTION), for example (1543509533.000838)
        stamp `(1.-5)` must be (SECONDS.FRACTION), for example (1543509533.000838)
        stamp `(1.00000000é)` must be (SECONDS.FRACTION), for example (1543509533.000838)
        a candump log line is `(SECONDS.FRACTION) BUS ID#DATA`
        a candump log line is `(SECONDS.FRACTION) BUS ID#DATA`
        stamp `(99999999999999.0)` must be (SECONDS.FRACTION), for example (1543509533.000838)
        data `0` must be pairs of hex digits, at most 64 bytes
        line of 615 characters: the longest candump log line has 512
        "#);
    }

    #[test]
    fn screen_lines() {
        let said: Vec<String> =
            ["123#DEADBEEF", "12345678#01", "123#R4", "123##1AABB", "20000004#0004000000000000"]
                .iter()
                .map(|text| format_screen(None, "can0", &parse(text).unwrap()))
                .collect();
        insta::assert_snapshot!(said.join("\n"), @r#"
        can0  123   [4]  DE AD BE EF
        can0  12345678   [1]  01
        can0  123   [4]  remote request
        can0  123  [02]  AA BB
        can0  20000004   [8]  00 04 00 00 00 00 00 00   ERRORFRAME
        "#);
        let with_stamp = format_screen(Some(166_000_000_000), "can0", &parse("123#01").unwrap());
        assert_eq!(with_stamp, " (0000000166.000000)  can0  123   [1]  01");
    }

    proptest! {
        #[test]
        fn round_trip(frame in any_frame(true), t_us in 0u64..4_000_000_000_000_000) {
            prop_assert_eq!(parse(&format(&frame)), Ok(frame));
            let line = format_log_line(t_us * 1000, "can0", &frame);
            let expected = LogLine { t_ns: t_us * 1000, bus: "can0", frame, tx: false };
            prop_assert_eq!(parse_log_line(&line), Ok(Some(expected)));
        }

        #[test]
        fn never_panics(text in "\\PC{0,80}", near in "\\(?[0-9.]{0,24}\\)? ?[a-z0-9 ]{0,8} [0-9A-F]{0,9}#{0,2}[R0-9A-F.]{0,20}") {
            let _ = parse(&text);
            let _ = parse_log_line(&text);
            let _ = parse_log_line(&near);
        }
    }
}
