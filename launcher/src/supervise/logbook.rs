//! What the services printed: the last lines of each, kept over restarts.
//!
//! Bounded in lines and in bytes a line; nothing here may block or touch a file.

use std::collections::VecDeque;

/// Lines kept of each service.
pub const LINES_MAX: usize = 2000;
/// Longest line in bytes; a longer one is cut into several.
pub const LINE_BYTES_MAX: usize = 2048;

/// A line with its time.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Line {
    /// Number over all services, from 1.
    pub number: u64,
    /// UTC in ns.
    pub utc_ns: i64,
    pub service: usize,
    pub text: String,
}

impl Line {
    /// `12:34:56.789`, UTC.
    pub fn clock(&self) -> String {
        clock(self.utc_ns)
    }
}

/// Time of day in UTC with milliseconds.
pub fn clock(utc_ns: i64) -> String {
    let ms = utc_ns.div_euclid(1_000_000).rem_euclid(86_400_000);
    format!("{:02}:{:02}:{:02}.{:03}", ms / 3_600_000, ms / 60_000 % 60, ms / 1000 % 60, ms % 1000)
}

/// The logs of all services of a stack.
#[derive(Debug)]
pub struct Logbook {
    rings: Vec<VecDeque<Line>>,
    partial: Vec<Vec<u8>>,
    next: u64,
}

impl Logbook {
    pub fn new(services: usize) -> Self {
        Self { rings: vec![VecDeque::new(); services], partial: vec![Vec::new(); services], next: 1 }
    }

    /// Adds a whole line of the launcher's own, e.g. that a service was restarted.
    pub fn note(&mut self, service: usize, text: &str, utc_ns: i64) -> Line {
        let text = clean(text.as_bytes());
        let line = Line { number: self.next, utc_ns, service, text };
        self.next += 1;
        let ring = &mut self.rings[service];
        if ring.len() == LINES_MAX {
            ring.pop_front();
        }
        ring.push_back(line.clone());
        line
    }

    /// Adds bytes as they came out of the pipe; hands over the lines that they complete.
    pub fn feed(&mut self, service: usize, bytes: &[u8], utc_ns: i64, mut line: impl FnMut(&Line)) {
        for &byte in bytes {
            if byte != b'\n' {
                self.partial[service].push(byte);
            }
            if byte == b'\n' || self.partial[service].len() >= LINE_BYTES_MAX {
                line(&self.end_line(service, utc_ns));
            }
        }
    }

    /// Ends an unfinished line: the process is gone.
    pub fn flush(&mut self, service: usize, utc_ns: i64) -> Option<Line> {
        (!self.partial[service].is_empty()).then(|| self.end_line(service, utc_ns))
    }

    fn end_line(&mut self, service: usize, utc_ns: i64) -> Line {
        let bytes = std::mem::take(&mut self.partial[service]);
        let line = self.note(service, &clean(&bytes), utc_ns);
        // The buffer is used again.
        self.partial[service] = bytes;
        self.partial[service].clear();
        line
    }

    /// The last `count` lines of one service, or of all in order of arrival.
    pub fn tail(&self, service: Option<usize>, count: usize) -> Vec<&Line> {
        let mut lines: Vec<&Line> = match service {
            Some(service) => self.rings[service].iter().collect(),
            None => self.rings.iter().flatten().collect(),
        };
        lines.sort_by_key(|line| line.number);
        lines.split_off(lines.len().saturating_sub(count))
    }
}

/// Text without control characters, so that a log line cannot steer a terminal; tabs stay.
fn clean(bytes: &[u8]) -> String {
    let text = String::from_utf8_lossy(bytes);
    text.trim_end_matches('\r')
        .chars()
        .map(|c| if c.is_control() && c != '\t' { char::REPLACEMENT_CHARACTER } else { c })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn texts(book: &Logbook, service: Option<usize>, count: usize) -> Vec<String> {
        book.tail(service, count).iter().map(|l| l.text.clone()).collect()
    }

    #[test]
    fn lines_are_joined_over_reads_and_kept_in_order() {
        let mut book = Logbook::new(2);
        let mut seen = 0;
        book.feed(0, b"one\ntw", 0, |_| seen += 1);
        book.feed(1, b"other\n", 0, |_| seen += 1);
        book.feed(0, b"o\r\nthree", 0, |_| seen += 1);
        assert_eq!(seen, 3);
        assert_eq!(texts(&book, None, 10), ["one", "other", "two"]);
        book.flush(0, 0);
        assert_eq!(texts(&book, Some(0), 2), ["two", "three"]);
        assert!(book.flush(0, 0).is_none());
    }

    #[test]
    fn memory_is_bounded() {
        let mut book = Logbook::new(1);
        for n in 0..LINES_MAX + 10 {
            book.feed(0, format!("{n}\n").as_bytes(), 0, |_| {});
        }
        assert_eq!(book.tail(None, usize::MAX).len(), LINES_MAX);
        assert_eq!(book.tail(None, usize::MAX)[0].text, "10");
        let mut cut = Vec::new();
        book.feed(0, &vec![b'x'; LINE_BYTES_MAX * 2 + 1], 0, |l| cut.push(l.text.len()));
        assert_eq!(cut, [LINE_BYTES_MAX, LINE_BYTES_MAX]);
    }

    #[test]
    fn escape_sequences_do_not_reach_the_terminal() {
        let mut book = Logbook::new(1);
        book.feed(0, b"\x1b[2Jhi\tthere \xff\n", 0, |_| {});
        assert_eq!(texts(&book, None, 1), ["\u{fffd}[2Jhi\tthere \u{fffd}"]);
    }

    #[test]
    fn the_clock_is_utc() {
        assert_eq!(clock(1_700_000_000_123_456_789), "22:13:20.123");
        assert_eq!(clock(-1_000_000), "23:59:59.999");
    }
}
