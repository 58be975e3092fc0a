//! Logs in Vector's ASC format, read and written line by line.
//!
//! Read: classic, remote, error and CAN FD frames in hexadecimal or decimal base, absolute and relative stamps, dates
//! of header and trigger block. Everything else of a measurement (statistics, comments, J1939 summaries) is passed
//! over. Written: what CANalyzer 8.5 and later and python-can read. A date has no time zone in this format; here it
//! is UTC. An error frame in ASC says only that there was one. Source: behaviour of python-can 4.6.1 and of public
//! descriptions of the format.

use std::fmt::Write as _;

use thiserror::Error;

use super::civil;
use super::frame::{ERR_FLAG, FD_BRS, FD_ESI, FD_LENGTHS, Frame, FrameError};
use super::hex;
use super::logfile::seconds;

/// Longest line taken, without its line end; longer ones carry J1939 summaries and are no frame.
pub const MAX_LINE: usize = 16 * 1024;

/// Class of an error frame whose reason is not told: bus error.
const CLASS_BUS_ERROR: u32 = 0x80;

/// Flag bit of a `CANFD` line: this is a CAN FD frame, not a classic one in the wide form.
const LINE_FDF: u32 = 1 << 12;
const LINE_BRS: u32 = 1 << 13;
const LINE_ESI: u32 = 1 << 14;
/// Flag bit of a `CANFD` line that holds a classic frame: remote.
const LINE_RTR: u32 = 1 << 4;

/// Why a line that should be a frame is none.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum AscError {
    /// No identifier.
    #[error("identifier `{0}` must be a number in the file's base, with x behind it when it has 29 bits")]
    Identifier(String),
    /// Neither data nor remote.
    #[error("`{0}` must be d (data) or r (remote)")]
    Kind(String),
    /// No data length code.
    #[error("data length `{0}` must be a data length code, 0 to F")]
    Length(String),
    /// Fewer bytes than announced, or no bytes.
    #[error("the line announces {announced} data bytes, byte {at} is `{text}`")]
    Data {
        /// By the length of the line.
        announced: usize,
        /// From 1.
        at: usize,
        /// What stands there.
        text: String,
    },
    /// Not 0 or 1.
    #[error("`{0}` must be 0 or 1: bit rate switch and error state of a CAN FD frame")]
    FdFlag(String),
    /// Not CANFD data length.
    #[error("code {code:X} means {by_code} data bytes, the line says {said}")]
    FdLength {
        /// Data length code.
        code: u8,
        /// Bytes by it.
        by_code: u8,
        /// Bytes the line says.
        said: String,
    },
    /// No such frame on a CAN bus.
    #[error(transparent)]
    Frame(#[from] FrameError),
    /// Date of the header.
    #[error("date `{0}` must be like `Sat Sep 30 15:06:13.191 2017` or `Sep 30 03:06:13 pm 2017`")]
    Date(String),
    /// Base of the header.
    #[error("base `{0}` must be hex or dec")]
    Base(String),
    /// Longer than [`MAX_LINE`].
    #[error("line of {0} characters: the longest ASC line has 16384")]
    TooLong(usize),
}

/// A frame of a log.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct AscFrame {
    /// UTC in ns when the log has a date, else since its start.
    pub t_ns: u64,
    /// From 1.
    pub channel: u16,
    /// The frame.
    pub frame: Frame,
    /// Sent by the one who logged.
    pub tx: bool,
}

/// Reads a log line by line.
#[derive(Debug, Clone, Default)]
pub struct Reader {
    decimal: bool,
    relative: bool,
    start_ns: u64,
    /// Sum of relative stamps.
    elapsed_ns: u64,
    begun: bool,
}

impl Reader {
    /// The frame on a line, if one is there.
    pub fn line(&mut self, line: &str) -> Result<Option<AscFrame>, AscError> {
        if line.len() > MAX_LINE {
            return Err(AscError::TooLong(line.len()));
        }
        let mut words = line.split_ascii_whitespace();
        let Some(first) = words.next() else { return Ok(None) };
        match seconds(first) {
            Some(stamp_ns) if first.contains('.') => self.event(stamp_ns, words),
            _ => self.header(first, words).map(|()| None),
        }
    }

    fn header<'a>(&mut self, first: &str, mut words: impl Iterator<Item = &'a str>) -> Result<(), AscError> {
        let is = |word: &str, what: &str| word.eq_ignore_ascii_case(what);
        if is(first, "date") {
            self.start_ns = date(words)?;
        } else if is(first, "base") {
            let base = words.next().unwrap_or_default();
            self.decimal = match base {
                _ if is(base, "dec") => true,
                _ if is(base, "hex") => false,
                _ => return Err(AscError::Base(short(base))),
            };
            self.relative = words.any(|word| is(word, "relative"));
        } else if is(first, "begin") && words.next().is_some_and(|word| is(word, "triggerblock")) {
            let mut rest = words.peekable();
            // The date of a later block is that of its trigger; its stamps still count from the start.
            if rest.peek().is_some() && !self.begun {
                self.start_ns = date(rest)?;
            }
        }
        Ok(())
    }

    fn event<'a>(
        &mut self,
        stamp_ns: u64,
        mut words: impl Iterator<Item = &'a str>,
    ) -> Result<Option<AscFrame>, AscError> {
        let since_ns = if self.relative {
            // Every event counts, also those that are no frame.
            self.elapsed_ns = self.elapsed_ns.saturating_add(stamp_ns);
            self.elapsed_ns
        } else {
            stamp_ns
        };
        let Some(kind) = words.next() else { return Ok(None) };
        let fd = kind.eq_ignore_ascii_case("CANFD");
        let channel = if fd { words.next().unwrap_or_default() } else { kind };
        let Ok(channel) = channel.parse::<u16>() else { return Ok(None) };
        let Some(found) = (if fd { self.wide(words)? } else { self.classic(words)? }) else {
            return Ok(None);
        };
        self.begun = true;
        let (frame, tx) = found;
        frame.validate()?;
        Ok(Some(AscFrame { t_ns: self.start_ns.saturating_add(since_ns), channel, frame, tx }))
    }

    /// `ID Rx d LENGTH BYTES`, `ID Rx r LENGTH` or `ErrorFrame`.
    fn classic<'a>(
        &self,
        mut words: impl Iterator<Item = &'a str>,
    ) -> Result<Option<(Frame, bool)>, AscError> {
        let Some(id) = words.next() else { return Ok(None) };
        if id.eq_ignore_ascii_case("ErrorFrame") {
            return Ok(Some((error_frame(), false)));
        }
        let Some(tx) = words.next().and_then(direction) else { return Ok(None) };
        let (id, extended) = self.identifier(id)?;
        let kind = words.next().unwrap_or_default();
        let frame = if kind.eq_ignore_ascii_case("r") {
            // Before version 8.5 there was no length.
            let len = match words.next().filter(|word| word.bytes().all(|c| c.is_ascii_hexdigit())) {
                Some(word) => self.code(word)?.min(8),
                None => 0,
            };
            Frame::remote(id, extended, len)?
        } else if kind.eq_ignore_ascii_case("d") {
            let len = usize::from(self.code(words.next().unwrap_or_default())?.min(8));
            let mut data = [0; 64];
            self.bytes(&mut words, &mut data[..len])?;
            Frame::data(id, extended, &data[..len])?
        } else {
            return Err(AscError::Kind(short(kind)));
        };
        Ok(Some((frame, tx)))
    }

    /// `Rx ID [NAME] BRS ESI CODE LENGTH BYTES DURATION BITS FLAGS ...` or `Rx ErrorFrame`.
    fn wide<'a>(&self, mut words: impl Iterator<Item = &'a str>) -> Result<Option<(Frame, bool)>, AscError> {
        let Some(tx) = words.next().and_then(direction) else { return Ok(None) };
        let id = words.next().unwrap_or_default();
        if id.eq_ignore_ascii_case("ErrorFrame") {
            return Ok(Some((error_frame(), tx)));
        }
        let (id, extended) = self.identifier(id)?;
        let bit = |word: &str| match word {
            "0" => Ok(false),
            "1" => Ok(true),
            _ => Err(AscError::FdFlag(short(word))),
        };
        let mut word = words.next().unwrap_or_default();
        if !word.starts_with(|c: char| c.is_ascii_digit()) {
            // A symbolic name.
            word = words.next().unwrap_or_default();
        }
        let brs = bit(word)?;
        let esi = bit(words.next().unwrap_or_default())?;
        let code = self.code(words.next().unwrap_or_default())?;
        let said = words.next().unwrap_or_default();
        let len = said.parse::<usize>().ok().filter(|len| *len <= 64);
        let Some(len) = len else { return Err(Self::length_mismatch(code, said)) };
        let mut data = [0; 64];
        self.bytes(&mut words, &mut data[..len])?;
        let flags = words.nth(2).and_then(|word| u32::from_str_radix(word, 16).ok());
        let frame = match flags {
            // Some writers leave the flags out; a classic frame is short and does not switch rates.
            Some(flags) if flags & LINE_FDF == 0 && len <= 8 && !brs => {
                let remote = flags & LINE_RTR != 0 || (len == 0 && code > 0);
                if remote {
                    Frame::remote(id, extended, code.min(8))?
                } else {
                    Frame::data(id, extended, &data[..len])?
                }
            }
            _ if usize::from(FD_LENGTHS[usize::from(code & 0xF)]) != len => {
                return Err(Self::length_mismatch(code, said));
            }
            _ => {
                let fd = if brs { FD_BRS } else { 0 } | if esi { FD_ESI } else { 0 };
                Frame::fd(id, extended, fd, &data[..len])?
            }
        };
        Ok(Some((frame, tx)))
    }

    fn length_mismatch(code: u8, said: &str) -> AscError {
        AscError::FdLength { code, by_code: FD_LENGTHS[usize::from(code & 0xF)], said: short(said) }
    }

    fn number(&self, text: &str) -> Option<u32> {
        if self.decimal {
            hex::decimal(text.as_bytes()).and_then(|n| u32::try_from(n).ok())
        } else {
            hex::number(text.as_bytes())
        }
    }

    fn identifier(&self, text: &str) -> Result<(u32, bool), AscError> {
        let extended = text.ends_with(['x', 'X']);
        let digits = if extended { &text[..text.len() - 1] } else { text };
        let id = self.number(digits).ok_or_else(|| AscError::Identifier(short(text)))?;
        Ok((id, extended))
    }

    fn code(&self, text: &str) -> Result<u8, AscError> {
        // Always a single hexadecimal digit in the data's base; "10" and above only stand in decimal files.
        let code = self.number(text).and_then(|n| u8::try_from(n).ok()).filter(|n| *n <= 15);
        code.ok_or_else(|| AscError::Length(short(text)))
    }

    fn bytes<'a>(&self, words: &mut impl Iterator<Item = &'a str>, data: &mut [u8]) -> Result<(), AscError> {
        let announced = data.len();
        for (i, byte) in data.iter_mut().enumerate() {
            let text = words.next().unwrap_or_default();
            let value = self.number(text).and_then(|n| u8::try_from(n).ok());
            *byte = value.ok_or_else(|| AscError::Data { announced, at: i + 1, text: short(text) })?;
        }
        Ok(())
    }
}

fn short(text: &str) -> String {
    text.chars().take(40).collect()
}

fn direction(word: &str) -> Option<bool> {
    // TxRq, a request to send, is followed by the frame itself.
    match word {
        _ if word.eq_ignore_ascii_case("Tx") => Some(true),
        _ if word.eq_ignore_ascii_case("Rx") => Some(false),
        _ => None,
    }
}

fn error_frame() -> Frame {
    Frame { can_id: ERR_FLAG | CLASS_BUS_ERROR, len: 8, ..Frame::default() }
}

/// UTC in ns of `[WEEKDAY] MONTH DAY HH:MM:SS[.fraction] [am|pm] YEAR`.
fn date<'a>(words: impl Iterator<Item = &'a str>) -> Result<u64, AscError> {
    let words: Vec<&str> = words.take(8).collect();
    read_date(&words).ok_or_else(|| AscError::Date(words.join(" ").chars().take(60).collect()))
}

fn read_date(words: &[&str]) -> Option<u64> {
    // German tools write the weekday and the month in German.
    const MONTHS: [&[&str]; 12] = [
        &["jan"],
        &["feb"],
        &["mar", "mär", "mrz"],
        &["apr"],
        &["may", "mai"],
        &["jun"],
        &["jul"],
        &["aug"],
        &["sep"],
        &["oct", "okt"],
        &["nov"],
        &["dec", "dez"],
    ];
    let month_of = |word: &str| {
        let start: String = word.to_lowercase().chars().take(3).collect();
        MONTHS.iter().position(|names| names.contains(&start.as_str())).map(|i| i as u32 + 1)
    };
    let rest = match words {
        [first, ..] if month_of(first).is_some() => words,
        [_weekday, rest @ ..] => rest,
        [] => return None,
    };
    let (month, rest) = (month_of(rest.first()?)?, &rest[1..]);
    let [day, time, rest @ ..] = rest else { return None };
    let day: u32 = day.parse().ok()?;
    let mut parts = time.split(':');
    let mut hour: u64 = parts.next()?.parse().ok()?;
    let minute: u64 = parts.next()?.parse().ok()?;
    let second_ns = seconds(parts.next()?)?;
    let rest = match rest {
        [half, rest @ ..] if half.eq_ignore_ascii_case("pm") => {
            hour = hour % 12 + 12;
            rest
        }
        [half, rest @ ..] if half.eq_ignore_ascii_case("am") => {
            hour %= 12;
            rest
        }
        rest => rest,
    };
    let year: i32 = rest.first()?.parse().ok()?;
    if hour > 23 || minute > 59 || second_ns >= 61_000_000_000 || parts.next().is_some() {
        return None;
    }
    let days = civil::days(year, month, day)?;
    days.checked_mul(86_400_000_000_000)?.checked_add((hour * 3600 + minute * 60) * 1_000_000_000 + second_ns)
}

/// Writes a log line by line.
#[derive(Debug, Clone)]
pub struct Writer {
    start_ns: u64,
}

impl Writer {
    /// A log whose first frame has this stamp, UTC in ns. Stamps before it are written as 0.
    pub fn new(first_ns: u64) -> Self {
        // The header's date has milliseconds.
        Self { start_ns: first_ns - first_ns % 1_000_000 }
    }

    /// What stands before the first frame.
    pub fn header(&self) -> String {
        let date = civil::asc_date(self.start_ns);
        format!(
            "date {date}\nbase hex  timestamps absolute\ninternal events logged\nBegin Triggerblock {date}\n   0.000000 Start of measurement\n"
        )
    }

    /// One frame, with line end. `channel` counts from 1.
    pub fn line(&self, t_ns: u64, channel: u16, frame: &Frame, tx: bool) -> String {
        let us = t_ns.saturating_sub(self.start_ns) / 1000;
        let mut line = String::with_capacity(320);
        let _ = write!(line, "{:>4}.{:06} ", us / 1_000_000, us % 1_000_000);
        if frame.is_error() {
            let _ = writeln!(line, "{channel}  ErrorFrame");
            return line;
        }
        let direction = if tx { "Tx" } else { "Rx" };
        let id = format!("{:X}{}", frame.id(), if frame.is_extended() { "x" } else { "" });
        if frame.is_fd() {
            let (brs, esi) = (frame.fd & FD_BRS != 0, frame.fd & FD_ESI != 0);
            let flags = LINE_FDF | if brs { LINE_BRS } else { 0 } | if esi { LINE_ESI } else { 0 };
            let (brs, esi, code, len) = (u8::from(brs), u8::from(esi), frame.dlc(), frame.len);
            let _ = write!(line, "CANFD {channel:>3} {direction:<4} {id:>8}  {:>32} {brs} {esi} ", "");
            let _ = write!(line, "{code:x} {len:>2}");
            bytes(&mut line, frame);
            // Duration, bits, flags, CRC and four bit timings.
            let _ =
                writeln!(line, " {:>8} {:>4} {flags:>8X} {:>8} {:>8} {:>8} {:>8} {:>8}", 0, 0, 0, 0, 0, 0, 0);
        } else {
            let kind = if frame.is_remote() { 'r' } else { 'd' };
            let _ = write!(line, "{channel}  {id:<15} {direction:<4} {kind} {:x}", frame.len);
            bytes(&mut line, frame);
            line.push('\n');
        }
        line
    }

    /// What stands behind the last frame.
    pub fn footer(&self) -> &'static str {
        "End TriggerBlock\n"
    }
}

fn bytes(line: &mut String, frame: &Frame) {
    for byte in frame.payload() {
        let _ = write!(line, " {byte:02X}");
    }
}

#[cfg(test)]
#[path = "asc_tests.rs"]
mod tests;
