//! A recorded log played onto the virtual bus by its stamps.
//!
//! [`Log`] holds the whole log in memory (about 40 bytes a frame), so playing never waits for a disk. [`Player`]
//! is sans-I/O: it is told the time and says when it wants to be called again.

use std::io::BufRead;
use std::path::{Path, PathBuf};

use thiserror::Error;

use crate::protocol::Frame;
use crate::protocol::candump::{self, ParseError};
use crate::virtual_bus::TURN_FRAMES;

/// Most frames of a log.
pub const MAX_FRAMES: usize = 1_000_000;

/// Why a log cannot be played.
#[derive(Debug, Error)]
pub enum FeedError {
    /// Cannot be opened or read.
    #[error("feed: cannot read {path}: {source}")]
    Read {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// A line is no candump line.
    #[error("feed: {path}:{line}: {source}")]
    Line {
        /// The file.
        path: PathBuf,
        /// From 1.
        line: usize,
        /// What is wrong with it.
        source: ParseError,
    },
    /// No frame in it.
    #[error("feed: {path} holds no frame{}", .bus.as_ref().map(|b| format!(" of bus '{b}'")).unwrap_or_default())]
    Empty {
        /// The file.
        path: PathBuf,
        /// The bus asked for.
        bus: Option<String>,
    },
    /// More than [`MAX_FRAMES`].
    #[error("feed: {path} holds more than 1000000 frames: cut it")]
    TooLong {
        /// The file.
        path: PathBuf,
    },
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Entry {
    /// Since the first frame.
    t_ns: u64,
    can_id: u32,
    data: u32,
    len: u8,
    fd: u8,
}

/// A log in memory.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Log {
    entries: Vec<Entry>,
    data: Vec<u8>,
}

impl Log {
    /// Reads a candump log; `bus` takes only lines of that bus. Stamps that go backwards count as the stamp before.
    pub fn load(path: &Path, bus: Option<&str>) -> Result<Self, FeedError> {
        let read = |source| FeedError::Read { path: path.to_owned(), source };
        let file = std::fs::File::open(path).map_err(read)?;
        Self::read(std::io::BufReader::new(file), path, bus)
    }

    fn read(mut reader: impl BufRead, path: &Path, bus: Option<&str>) -> Result<Self, FeedError> {
        let path = || path.to_owned();
        let mut log = Self { entries: Vec::new(), data: Vec::new() };
        let mut first_ns = None;
        let mut last_ns = 0;
        let mut line = Vec::new();
        for number in 1.. {
            line.clear();
            // Bounded, so that a file without line ends is no danger.
            let limit = candump::MAX_LINE as u64 + 2;
            let n = std::io::Read::take(&mut reader, limit)
                .read_until(b'\n', &mut line)
                .map_err(|source| FeedError::Read { path: path(), source })?;
            if n == 0 {
                break;
            }
            let text = String::from_utf8_lossy(&line);
            let parsed = candump::parse_log_line(text.trim_end_matches(['\r', '\n']))
                .map_err(|source| FeedError::Line { path: path(), line: number, source })?;
            let Some(parsed) = parsed else { continue };
            if bus.is_some_and(|bus| bus != parsed.bus) {
                continue;
            }
            if log.entries.len() == MAX_FRAMES {
                return Err(FeedError::TooLong { path: path() });
            }
            let start = *first_ns.get_or_insert(parsed.t_ns);
            last_ns = parsed.t_ns.saturating_sub(start).max(last_ns);
            let frame = parsed.frame;
            log.entries.push(Entry {
                t_ns: last_ns,
                can_id: frame.can_id,
                data: log.data.len() as u32,
                len: frame.len,
                fd: frame.fd,
            });
            log.data.extend_from_slice(frame.payload());
        }
        if log.entries.is_empty() {
            return Err(FeedError::Empty { path: path(), bus: bus.map(str::to_owned) });
        }
        Ok(log)
    }

    /// Number of frames.
    pub fn len(&self) -> usize {
        self.entries.len()
    }

    /// Never true: a log holds at least one frame.
    pub fn is_empty(&self) -> bool {
        self.entries.is_empty()
    }

    fn frame(&self, index: usize) -> Option<(u64, Frame)> {
        let entry = self.entries.get(index)?;
        let mut frame = Frame { can_id: entry.can_id, len: entry.len, fd: entry.fd, data: [0; 64] };
        let n = frame.payload().len();
        frame.data[..n].copy_from_slice(&self.data[entry.data as usize..entry.data as usize + n]);
        Some((entry.t_ns, frame))
    }
}

/// Plays a log.
#[derive(Debug)]
pub struct Player {
    log: Log,
    speed: f64,
    repeat: bool,
    gap_ns: u64,
    start_ns: u64,
    index: usize,
    rounds: u64,
}

impl Player {
    /// Starts at `now_ns`. `speed` outside 0.01 - 1000 and gaps below 1 ms are brought into range.
    pub fn new(log: Log, speed: f64, repeat: bool, gap_ns: u64, now_ns: u64) -> Self {
        let speed = if speed.is_finite() { speed.clamp(0.01, 1000.0) } else { 1.0 };
        Self { log, speed, repeat, gap_ns: gap_ns.max(1_000_000), start_ns: now_ns, index: 0, rounds: 0 }
    }

    /// Times the log was played to its end.
    pub fn rounds(&self) -> u64 {
        self.rounds
    }

    /// Hands what is due to `push` (false: no room now), at most [`TURN_FRAMES`]. Returns when to call again:
    /// `now_ns` when more is due, `None` at the end of a log that does not repeat and when there is no room: then call
    /// again when there is.
    pub fn play(&mut self, now_ns: u64, mut push: impl FnMut(&Frame) -> bool) -> Option<u64> {
        for _ in 0..TURN_FRAMES {
            let (t_ns, frame) = self.log.frame(self.index)?;
            let due_ns = self.start_ns + (t_ns as f64 / self.speed) as u64;
            if due_ns > now_ns {
                return Some(due_ns);
            }
            if !push(&frame) {
                return None;
            }
            self.index += 1;
            if self.index == self.log.len() {
                self.rounds += 1;
                if !self.repeat {
                    return None;
                }
                self.index = 0;
                self.start_ns = due_ns.max(now_ns.saturating_sub(self.gap_ns)) + self.gap_ns;
            }
        }
        Some(now_ns)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::protocol::candump::format;

    fn log(text: &str, bus: Option<&str>) -> Result<Log, FeedError> {
        Log::read(text.as_bytes(), Path::new("x.log"), bus)
    }

    const THREE: &str =
        "(100.0) can0 001#01\n\n# made by hand\n(100.010) can1 002#R4\r\n(100.005) can0 003##1AABB\n";

    #[test]
    fn by_stamp_and_again() {
        let mut player = Player::new(log(THREE, None).unwrap(), 2.0, true, 1_000_000, 1000);
        let mut seen = Vec::new();
        let mut now = 1000;
        for _ in 0..6 {
            let next = player.play(now, |f| {
                seen.push((now, format(f)));
                true
            });
            now = next.unwrap();
        }
        let seen: Vec<String> = seen.iter().map(|(t, f)| format!("{t} {f}")).collect();
        // 10 ms at double speed are 5 ms; the stamp that goes backwards counts as the one before.
        let expected = [
            "1000 001#01",
            "5001000 002#R4",
            "5001000 003##1AABB",
            "6001000 001#01",
            "11001000 002#R4",
            "11001000 003##1AABB",
            "12001000 001#01",
            "17001000 002#R4",
            "17001000 003##1AABB",
        ];
        assert_eq!(seen, expected);
        assert_eq!(player.rounds(), 3);
    }

    #[test]
    fn once_one_bus_and_a_full_queue() {
        let mut player = Player::new(log(THREE, Some("can0")).unwrap(), 1.0, false, 0, 0);
        assert_eq!(player.play(10_000_000, |_| false), None);
        let mut seen = Vec::new();
        assert_eq!(
            player.play(10_000_000, |f| {
                seen.push(format(f));
                true
            }),
            None
        );
        assert_eq!(seen, ["001#01", "003##1AABB"]);
        assert_eq!(player.play(20_000_000, |_| panic!("ended")), None);
    }

    #[test]
    fn a_burst_is_played_in_turns() {
        let text = "(1.0) can0 001#01\n".repeat(1000);
        let mut player = Player::new(log(&text, None).unwrap(), 1.0, false, 0, 0);
        let mut count = 0;
        assert_eq!(
            player.play(5, |_| {
                count += 1;
                true
            }),
            Some(5)
        );
        assert_eq!(count, TURN_FRAMES);
    }

    #[test]
    fn mistakes_name_the_line() {
        let long = "x".repeat(2000);
        let said: Vec<String> = [
            log("(1.0) can0 001#01\n(1.0) can0 1#01\n", None),
            log("# nothing\n", None),
            log("(1.0) can0 001#01\n", Some("can7")),
            log(&long, None),
            log("ä#", None),
        ]
        .into_iter()
        .map(|result| result.unwrap_err().to_string())
        .collect();
        insta::assert_snapshot!(said.join("\n"), @r#"
        feed: x.log:2: identifier `1` must have 3 hex digits (11 bits) or 8 (29 bits)
        feed: x.log holds no frame
        feed: x.log holds no frame of bus 'can7'
        feed: x.log:1: line of 514 characters: the longest candump log line has 512
        feed: x.log:1: stamp `ä#` must be (SECONDS.FRACTION), for example (1543509533.000838)
        "#);
        let missing = Log::load(Path::new("/nonexistent/x.log"), None).unwrap_err().to_string();
        assert!(missing.starts_with("feed: cannot read /nonexistent/x.log: "), "{missing}");
    }
}
