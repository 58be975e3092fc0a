//! CAN frames in files: candump logs, Vector ASC, MCAP recordings. Streamed, never whole in memory.

use super::merge::Merge;
use dinrail_can::protocol::frame::Frame;
use dinrail_can::protocol::logfile::{self, Format, Reader};
use dinrail_recorder::Recording;
use dinrail_recorder::format::META_RECORDING;
use dinrail_recorder::reader::Item;
use ipc_types::payload::{CanFrame, can_flag, from_bytes};
use ipc_types::topic::TopicKind;
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};

/// What MCAP files begin with.
const MCAP_MAGIC: &[u8; 8] = b"\x89MCAP0\r\n";
/// Topics of a recording are written in batches: a frame of one bus may stand so much behind a later one of another.
const HOLD_NS: u64 = 2_000_000_000;
/// Key of a recording's metadata, and its value where frames do not tell who sent them.
pub const DIRECTION: &str = "direction";
pub const DIRECTION_UNKNOWN: &str = "unknown";
/// Most buses of a file.
pub const MAX_BUSES: usize = 256;

/// A frame of a file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Logged {
    /// UTC in ns, if the file has it.
    pub t_ns: u64,
    pub bus: String,
    pub frame: Frame,
    /// Sent by the one who logged.
    pub tx: bool,
    /// Whether the file tells that; if not, `tx` says nothing.
    pub directed: bool,
}

enum Kind {
    Log {
        file: BufReader<File>,
        reader: Reader,
        number: u64,
        line: Vec<u8>,
    },
    Recording {
        recording: Box<Recording>,
        merge: Option<Merge<Logged>>,
        buses: Vec<String>,
        newest_ns: u64,
        ended: bool,
        /// Not in what was imported from a log without it.
        directed: bool,
    },
}

/// A file being read.
pub struct Source {
    path: PathBuf,
    kind: Kind,
}

impl Source {
    pub fn open(path: &Path) -> anyhow::Result<Self> {
        let cannot = |e: std::io::Error| anyhow::anyhow!("cannot read {}: {e}", path.display());
        let file = File::open(path).map_err(cannot)?;
        anyhow::ensure!(
            !file.metadata().map_err(cannot)?.is_dir(),
            "{} is a folder: name a file in it",
            path.display()
        );
        let mut file = BufReader::with_capacity(256 * 1024, file);
        if let Some(way) = unpacked_by(file.fill_buf().map_err(cannot)?) {
            anyhow::bail!("{} is compressed: unpack it first, with `{way} {0}`", path.display());
        }
        let kind = if file.fill_buf().map_err(cannot)?.starts_with(MCAP_MAGIC) {
            let recording = Box::new(Recording::open(path)?);
            Kind::Recording {
                recording,
                merge: None,
                buses: Vec::new(),
                newest_ns: 0,
                ended: false,
                directed: true,
            }
        } else {
            Kind::Log { file, reader: Reader::default(), number: 0, line: Vec::new() }
        };
        Ok(Self { path: path.to_owned(), kind })
    }

    /// `candump log`, `ASC file` or `recording`; of a log known once a frame was read.
    pub fn what(&self) -> &'static str {
        match &self.kind {
            Kind::Recording { .. } => "recording",
            Kind::Log { reader, .. } if reader.format() == Some(Format::Asc) => "ASC file",
            Kind::Log { .. } => "candump log",
        }
    }

    /// Whether it is an MCAP recording.
    pub fn is_recording(&self) -> bool {
        matches!(self.kind, Kind::Recording { .. })
    }

    /// The next frame: of a log in the order of its lines, of a recording each bus in its order and all by time.
    pub fn next_frame(&mut self) -> anyhow::Result<Option<Logged>> {
        match &mut self.kind {
            Kind::Log { file, reader, number, line } => next_line(&self.path, file, reader, number, line),
            Kind::Recording { recording, merge, buses, newest_ns, ended, directed } => {
                next_recorded(recording, merge, buses, newest_ns, ended, directed)
            }
        }
    }

    /// Places of a recording that could not be read, once it is at its end.
    pub fn damage(&self) -> Option<String> {
        let Kind::Recording { recording, .. } = &self.kind else { return None };
        let end = recording.end();
        (end.damaged > 0 || end.unread > 0).then(|| {
            let bytes = end.damaged_bytes + end.unread;
            let why = end.reason.as_deref().unwrap_or("damaged");
            format!("{}: {bytes} bytes could not be read ({why})", self.path.display())
        })
    }
}

/// What unpacks a file that begins like this; `None` when it is not packed.
fn unpacked_by(begin: &[u8]) -> Option<&'static str> {
    const PACKED: [(&[u8], &str); 5] = [
        (b"\x1f\x8b", "gunzip -k"),
        (b"BZh", "bunzip2 -k"),
        (b"\xfd7zXZ\0", "unxz -k"),
        (b"\x28\xb5\x2f\xfd", "unzstd"),
        (b"PK\x03\x04", "unzip"),
    ];
    PACKED.iter().find(|(magic, _)| begin.starts_with(magic)).map(|(_, way)| *way)
}

fn next_line(
    path: &Path,
    file: &mut BufReader<File>,
    reader: &mut Reader,
    number: &mut u64,
    line: &mut Vec<u8>,
) -> anyhow::Result<Option<Logged>> {
    loop {
        line.clear();
        // Bounded, so that a file without line ends is no danger.
        let limit = logfile::MAX_LINE as u64 + 2;
        let read = Read::take(&mut *file, limit).read_until(b'\n', line);
        if read.map_err(|e| anyhow::anyhow!("reading {}: {e}", path.display()))? == 0 {
            return Ok(None);
        }
        *number += 1;
        let text = String::from_utf8_lossy(line);
        let found = reader.line(&text).map_err(|e| anyhow::anyhow!("{}:{number}: {e}", path.display()))?;
        if let Some(found) = found {
            return Ok(Some(Logged {
                t_ns: found.t_ns,
                bus: found.bus.to_string(),
                frame: found.frame,
                tx: found.tx,
                directed: has_direction(reader.format(), &text),
            }));
        }
    }
}

/// ASC has a column for it, a candump log may have a fourth (`candump -x`).
fn has_direction(format: Option<Format>, line: &str) -> bool {
    format != Some(Format::Candump) || line.split_ascii_whitespace().nth(3).is_some()
}

fn next_recorded(
    recording: &mut Recording,
    merge: &mut Option<Merge<Logged>>,
    buses: &mut Vec<String>,
    newest_ns: &mut u64,
    ended: &mut bool,
    directed: &mut bool,
) -> anyhow::Result<Option<Logged>> {
    loop {
        let now_ns = if *ended { u64::MAX } else { *newest_ns };
        if let Some((.., logged)) = merge.as_mut().and_then(|m| m.pop(now_ns)) {
            return Ok(Some(logged));
        }
        if *ended {
            return Ok(None);
        }
        let Some(item) = recording.next_item()? else {
            *ended = true;
            continue;
        };
        let message = match item {
            Item::Message(message) => message,
            Item::Metadata(meta) if meta.name == META_RECORDING => {
                *directed = meta.entries.get(DIRECTION).is_none_or(|v| v != DIRECTION_UNKNOWN);
                continue;
            }
            _ => continue,
        };
        if message.channel.kind != Some(TopicKind::CanRx) {
            continue;
        }
        let Some(frame) = from_bytes::<CanFrame>(message.header) else { continue };
        // What was recorded is as little trusted as what is on the rail.
        if frame.fault().is_some() {
            continue;
        }
        let topic = message.topic();
        let bus = topic.strip_suffix("/rx").unwrap_or(topic);
        let at = buses.iter().position(|b| b == bus).unwrap_or_else(|| {
            buses.push(bus.to_owned());
            buses.len() - 1
        });
        let t_ns = message.log_time;
        let tx = frame.flags & can_flag::TX_ECHO != 0;
        let logged =
            Logged { t_ns, bus: bus.to_owned(), frame: super::to_frame(&frame), tx, directed: *directed };
        *newest_ns = t_ns.max(*newest_ns);
        let channels = || recording.channels().filter(|c| c.kind == Some(TopicKind::CanRx)).count();
        merge.get_or_insert_with(|| Merge::new(channels(), HOLD_NS)).push(at, t_ns, logged);
    }
}

/// What a file holds.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Contents {
    /// See [`Source::what`].
    pub what: &'static str,
    /// Frames of each bus.
    pub buses: BTreeMap<String, u64>,
    /// Buses in the order of their first frame.
    pub order: Vec<String>,
    pub frames: u64,
    /// Of these, error frames.
    pub errors: u64,
    /// Of these, without a word about who sent them.
    pub undirected: u64,
    /// Earliest and latest.
    pub first_ns: u64,
    pub last_ns: u64,
}

/// Reads a file through: after that no line of it comes as a surprise.
pub fn contents(path: &Path) -> anyhow::Result<Contents> {
    let mut source = Source::open(path)?;
    let mut contents = Contents { first_ns: u64::MAX, ..Contents::default() };
    while let Some(logged) = source.next_frame()? {
        contents.frames += 1;
        contents.errors += u64::from(logged.frame.is_error());
        contents.undirected += u64::from(!logged.directed);
        contents.first_ns = contents.first_ns.min(logged.t_ns);
        contents.last_ns = contents.last_ns.max(logged.t_ns);
        if let Some(count) = contents.buses.get_mut(&logged.bus) {
            *count += 1;
            continue;
        }
        anyhow::ensure!(contents.order.len() < MAX_BUSES, "{}: more than {MAX_BUSES} buses", path.display());
        contents.order.push(logged.bus.clone());
        contents.buses.insert(logged.bus, 1);
    }
    contents.what = source.what();
    anyhow::ensure!(contents.frames > 0, "{} holds no CAN frame", path.display());
    Ok(contents)
}
