//! Making an unfinished recording whole: everything readable goes into a new file with index and end, which
//! then takes the old one's place. At no moment is there less than before.

use crate::config::Compression;
use crate::disk;
use crate::file::RecordingFile;
use crate::format::META_SEALED;
use crate::reader::{End, Item, ReadError, Recording};
use ipc_types::clock;
use mcap::McapError;
use mcap::records::MessageHeader;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::fs::{File, OpenOptions};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// What [`recover`] did.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize)]
pub struct Report {
    /// Messages that were kept.
    pub messages: u64,
    /// Bytes of data that could not be read.
    pub bytes_lost: u64,
    /// The file was whole already and is as it was.
    pub already_sealed: bool,
    /// Why the old file ended early.
    pub reason: Option<String>,
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.already_sealed {
            return write!(f, "{} messages, nothing to do", self.messages);
        }
        write!(f, "{} messages kept, {} bytes lost", self.messages, self.bytes_lost)?;
        self.reason.as_ref().map_or(Ok(()), |reason| write!(f, " ({reason})"))
    }
}

/// Why a file could not be made whole. The old file is then as it was.
#[derive(Debug, thiserror::Error)]
pub enum SealError {
    #[error(transparent)]
    Read(#[from] ReadError),
    #[error("{0} is being written by a running recorder; it will finish the file itself")]
    InUse(PathBuf),
    #[error(
        "cannot write {path}: {source}; free space there (about the size of the recording) and try again"
    )]
    Write { path: PathBuf, source: io::Error },
}

/// Makes a recording whole, in its place. A file that is damaged in the middle is written anew without the
/// damaged chunks; one that is whole is left alone.
pub fn recover(path: &Path) -> Result<Report, SealError> {
    let open = |source| SealError::Read(ReadError::Open { path: path.to_owned(), source });
    let guard = File::open(path).map_err(open)?;
    if !disk::lock(&guard) {
        return Err(SealError::InUse(path.to_owned()));
    }
    let mut recording = Recording::open(path)?;
    if disk::is_finished(path) {
        let messages = count(&mut recording)?;
        let end = recording.end();
        if end.finished && end.damaged == 0 {
            return Ok(Report { messages, bytes_lost: 0, already_sealed: true, reason: None });
        }
        recording = Recording::open(path)?;
    }
    let mut name = path.as_os_str().to_owned();
    name.push(".sealing");
    let copy = PathBuf::from(name);
    let failed = |source| SealError::Write { path: copy.clone(), source };
    let file = OpenOptions::new().read(true).write(true).create(true).truncate(true).open(&copy);
    let file = Arc::new(file.map_err(failed)?);
    disk::lock(&file);
    let result = rewrite(&mut recording, &file).and_then(|report| {
        file.sync_all().map_err(RewriteError::Write)?;
        std::fs::rename(&copy, path).map_err(RewriteError::Write)?;
        Ok(report)
    });
    match result {
        Ok(report) => {
            // The new name is only on the medium when its folder is.
            if let Some(folder) = path.parent().and_then(|p| File::open(p).ok()) {
                let _ = folder.sync_all();
            }
            Ok(report)
        }
        Err(error) => {
            let _ = std::fs::remove_file(&copy);
            Err(match error {
                RewriteError::Read(error) => error.into(),
                RewriteError::Write(source) => failed(source),
            })
        }
    }
}

fn count(recording: &mut Recording) -> Result<u64, ReadError> {
    let mut messages = 0;
    while let Some(item) = recording.next_item()? {
        messages += u64::from(matches!(item, Item::Message(_)));
    }
    Ok(messages)
}

enum RewriteError {
    Read(ReadError),
    Write(io::Error),
}

impl From<ReadError> for RewriteError {
    fn from(error: ReadError) -> Self {
        Self::Read(error)
    }
}

impl From<McapError> for RewriteError {
    fn from(error: McapError) -> Self {
        Self::Write(match error {
            McapError::Io(e) => e,
            other => io::Error::other(other.to_string()),
        })
    }
}

fn rewrite(recording: &mut Recording, file: &Arc<File>) -> Result<Report, RewriteError> {
    let mut out = RecordingFile::new(file.clone(), Compression::Zstd, true)?;
    let result = copy_items(recording, &mut out);
    let messages = match result {
        Ok(messages) => messages,
        Err(error) => {
            out.abandon();
            return Err(error);
        }
    };
    let end = recording.end().clone();
    let report = Report {
        messages,
        bytes_lost: end.unread + end.damaged_bytes,
        already_sealed: false,
        reason: reason(&end),
    };
    let entries = BTreeMap::from([
        ("utc_ns".to_owned(), clock::utc_ns().to_string()),
        ("messages".to_owned(), messages.to_string()),
        ("bytes_lost".to_owned(), report.bytes_lost.to_string()),
        ("reason".to_owned(), report.reason.clone().unwrap_or_default()),
    ]);
    out.metadata(META_SEALED, entries)?;
    out.finish()?;
    Ok(report)
}

fn reason(end: &End) -> Option<String> {
    let first = end.damages.first().map(|d| format!("{} at byte {}", d.reason, d.offset));
    match (&end.reason, first) {
        (Some(reason), Some(damage)) => Some(format!("{reason} at byte {}; {damage}", end.offset)),
        (Some(reason), None) => Some(format!("{reason} at byte {}", end.offset)),
        (None, damage) => damage,
    }
}

fn copy_items(recording: &mut Recording, out: &mut RecordingFile) -> Result<u64, RewriteError> {
    let mut known = BTreeSet::new();
    let mut messages = 0;
    while let Some(item) = recording.next_item()? {
        match item {
            Item::Message(message) => {
                if known.insert(message.channel.id) {
                    out.copy_channel(message.channel)?;
                }
                let head = MessageHeader {
                    channel_id: message.channel.id,
                    sequence: message.sequence,
                    log_time: message.log_time,
                    publish_time: message.publish_time,
                };
                out.message_chunked(&head, message.data)?;
                messages += 1;
            }
            Item::Attachment(a) => out.attach(a.name, a.media_type, a.log_time, a.data)?,
            Item::Metadata(m) => out.metadata(&m.name, m.entries)?,
        }
    }
    // Channels without a message stay known too.
    let silent: Vec<_> = recording.channels().filter(|c| !known.contains(&c.id)).cloned().collect();
    for channel in &silent {
        out.copy_channel(channel)?;
    }
    out.close_chunk()?;
    Ok(messages)
}
