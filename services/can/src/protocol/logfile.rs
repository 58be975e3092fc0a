//! Which format a log has, and its frames whatever the format: candump's log and Vector's ASC.

use thiserror::Error;

use super::frame::Frame;
use super::{asc, candump, hex};

/// Longest line of any log, without its line end.
pub const MAX_LINE: usize = asc::MAX_LINE;

/// A format of logs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// `(1436509052.249713) can0 123#DEADBEEF`, see [`candump`].
    Candump,
    /// See [`asc`].
    Asc,
}

/// Why a line cannot be read.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum LogError {
    /// In a candump log.
    #[error(transparent)]
    Candump(#[from] candump::ParseError),
    /// In an ASC file.
    #[error(transparent)]
    Asc(#[from] asc::AscError),
    /// Before the format is known.
    #[error(
        "`{0}` begins neither a candump log, `(SECONDS.FRACTION) BUS ID#DATA`, nor Vector's ASC, `date ...`; other formats are not supported: python-can's `can_logconvert` makes one of these of them"
    )]
    Unknown(String),
}

/// Where a frame was logged.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BusName<'a> {
    /// By name.
    Name(&'a str),
    /// By number, from 1.
    Channel(u16),
}

impl std::fmt::Display for BusName<'_> {
    /// Channel 1 is `can0`: logs count from 1, interfaces from 0.
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Name(name) => f.write_str(name),
            Self::Channel(channel) => write!(f, "can{}", channel.saturating_sub(1)),
        }
    }
}

/// A frame of a log.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LogFrame<'a> {
    /// In ns; UTC if the log has it.
    pub t_ns: u64,
    /// Where.
    pub bus: BusName<'a>,
    /// The frame.
    pub frame: Frame,
    /// Sent by the one who logged, if the log says so.
    pub tx: bool,
}

/// Reads a log line by line; its first line says which format it has.
#[derive(Debug, Clone, Default)]
pub struct Reader {
    format: Option<Format>,
    asc: asc::Reader,
}

impl Reader {
    /// The format, once known.
    pub fn format(&self) -> Option<Format> {
        self.format
    }

    /// The frame on a line, if one is there.
    pub fn line<'a>(&mut self, line: &'a str) -> Result<Option<LogFrame<'a>>, LogError> {
        let text = line.trim_start_matches('\u{feff}').trim();
        if text.is_empty() {
            return Ok(None);
        }
        let format = match self.format {
            Some(format) => format,
            // Comments of either format say nothing.
            None if text.starts_with('#') || text.starts_with("//") => return Ok(None),
            None => recognise(text).ok_or_else(|| LogError::Unknown(text.chars().take(40).collect()))?,
        };
        self.format = Some(format);
        match format {
            Format::Candump => Ok(candump::parse_log_line(text)?.map(|found| LogFrame {
                t_ns: found.t_ns,
                bus: BusName::Name(found.bus),
                frame: found.frame,
                tx: found.tx,
            })),
            Format::Asc => Ok(self.asc.line(text)?.map(|found| LogFrame {
                t_ns: found.t_ns,
                bus: BusName::Channel(found.channel),
                frame: found.frame,
                tx: found.tx,
            })),
        }
    }
}

fn recognise(line: &str) -> Option<Format> {
    if line.starts_with('(') {
        return Some(Format::Candump);
    }
    let mut words = line.split_ascii_whitespace();
    let first = words.next()?;
    let asc = ["date", "base", "begin", "internal", "no"].iter().any(|word| first.eq_ignore_ascii_case(word));
    // Some tools leave the header out.
    let bare = seconds(first).is_some() && first.contains('.') && words.next().is_some();
    (asc || bare).then_some(Format::Asc)
}

/// `12.345678` in ns; digits behind the ninth are left out.
pub(super) fn seconds(text: &str) -> Option<u64> {
    let (seconds, fraction) = text.split_once('.').unwrap_or((text, "0"));
    let seconds = hex::decimal(seconds.as_bytes())?;
    if !fraction.bytes().all(|c| c.is_ascii_digit()) {
        return None;
    }
    let nine = fraction.get(..9).unwrap_or(fraction);
    let scale = 10u64.pow(9 - u32::try_from(nine.len()).ok()?);
    let fraction_ns = hex::decimal(nine.as_bytes())? * scale;
    seconds.checked_mul(1_000_000_000)?.checked_add(fraction_ns)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn all(text: &str) -> Vec<String> {
        let mut reader = Reader::default();
        let lines = text.lines().filter_map(|line| match reader.line(line) {
            Ok(None) => None,
            Ok(Some(f)) => {
                Some(format!("{} {} {:?}{}", f.t_ns, f.bus, f.frame, if f.tx { " tx" } else { "" }))
            }
            Err(e) => Some(e.to_string()),
        });
        lines.collect()
    }

    #[test]
    fn the_first_line_says_which_format() {
        assert_eq!(
            all("\u{feff}# by hand\n\n(1.5) can7 123#01 T\n(2.0) can8 00000123#R2\n"),
            ["1500000000 can7 123#01 tx", "2000000000 can8 00000123#R2"]
        );
        assert_eq!(
            all("// by hand\nbase dec timestamps absolute\n0.5 2 291x Tx d 1 255\n"),
            ["500000000 can1 00000123#FF tx"]
        );
        assert_eq!(all("   0.100000 1  123   Rx   d 1 0A"), ["100000000 can0 123#0A"]);
        let unknown = all("Time Stamp,ID,Extended,Bus,LEN,D1");
        assert!(unknown[0].starts_with("`Time Stamp,ID,Extended,Bus,LEN,D1` begins neither"), "{unknown:?}");
    }
}
