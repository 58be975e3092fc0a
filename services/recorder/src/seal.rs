//! Making an unfinished recording whole: everything readable goes into a new file with index and end, which
//! then takes the old one's place. At no moment is there less than before.

use crate::config::Compression;
use crate::disk;
use crate::file::RecordingFile;
use crate::format::META_SEALED;
use crate::reader::{End, Item, ReadError, Recording};
use crate::sync::sync_folder;
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
    /// Places that were left out or altered.
    pub damaged: u64,
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
        "{path} cannot be locked: {source}; whether a recorder writes it cannot be told, so copy it to a local file system \
         and recover the copy"
    )]
    NoLock { path: PathBuf, source: io::Error },
    #[error(
        "cannot write {path}: {source}; free space there (about the size of the recording) and try again"
    )]
    Write { path: PathBuf, source: io::Error },
}

/// Makes a recording whole, in its place; of a link, in the place it leads to. A file that is damaged in the middle is
/// written anew without the damaged chunks; one that is whole is left alone.
pub fn recover(path: &Path) -> Result<Report, SealError> {
    make_whole(path, false)
}

/// As [`recover`], of a file that a recorder knows to be nobody's: also where files cannot be locked.
pub fn recover_own(path: &Path) -> Result<Report, SealError> {
    make_whole(path, true)
}

fn make_whole(named: &Path, own: bool) -> Result<Report, SealError> {
    let open = |source| SealError::Read(ReadError::Open { path: named.to_owned(), source });
    let path = std::fs::canonicalize(named).map_err(open)?;
    let (guard, lock) = disk::open_locked(&path).map_err(open)?;
    match lock {
        disk::Lock::InUse => return Err(SealError::InUse(named.to_owned())),
        disk::Lock::Unknown(source) if !own => {
            return Err(SealError::NoLock { path: named.to_owned(), source });
        }
        disk::Lock::Taken | disk::Lock::Unknown(_) => {}
    }
    let mut recording = Recording::open(&path)?;
    if disk::is_finished(&path) {
        let messages = count(&mut recording)?;
        let end = recording.end();
        if end.finished && end.damaged == 0 {
            return Ok(Report { messages, bytes_lost: 0, damaged: 0, already_sealed: true, reason: None });
        }
        recording = Recording::open(&path)?;
    }
    let mut name = path.as_os_str().to_owned();
    name.push(".sealing");
    let copy = PathBuf::from(name);
    let failed = |source| SealError::Write { path: copy.clone(), source };
    let file = Arc::new(create_copy(&copy).map_err(failed)?);
    let result = rewrite(&mut recording, &file).and_then(|report| {
        // Who could read the recording can read it on.
        let _ = guard.metadata().and_then(|meta| file.set_permissions(meta.permissions()));
        file.sync_all().map_err(RewriteError::Write)?;
        std::fs::rename(&copy, &path).map_err(RewriteError::Write)?;
        Ok(report)
    });
    match result {
        Ok(report) => {
            // The new name is only on the medium when its folder is.
            let _ = sync_folder(&path);
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

/// Creates the copy, locked. One that a killed sealing left is taken away before; a link is never followed.
fn create_copy(path: &Path) -> io::Result<File> {
    let create = || OpenOptions::new().read(true).write(true).create_new(true).open(path);
    let file = match create() {
        Err(e) if e.kind() == io::ErrorKind::AlreadyExists => {
            let is_file = std::fs::symlink_metadata(path)?.is_file();
            let free = is_file && !matches!(disk::open_locked(path)?.1, disk::Lock::InUse);
            if !free {
                return Err(io::Error::new(e.kind(), "it is there and in use, or no file"));
            }
            std::fs::remove_file(path)?;
            create()?
        }
        result => result?,
    };
    disk::lock(&file);
    Ok(file)
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
        damaged: end.damaged,
        already_sealed: false,
        reason: reason(&end),
    };
    let entries = BTreeMap::from([
        ("utc_ns".to_owned(), clock::utc_ns().to_string()),
        ("messages".to_owned(), messages.to_string()),
        ("bytes_lost".to_owned(), report.bytes_lost.to_string()),
        ("damaged".to_owned(), end.damaged.to_string()),
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
