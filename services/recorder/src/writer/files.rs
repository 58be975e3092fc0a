//! Which file: begun, due, finished, broken, gone; and the pause when the disk takes none.

use super::attach::{attach_changed, attach_modules};
use super::{HOUSEKEEPING, Open, Writer};
use crate::batch::{Batch, Entry};
use crate::disk;
use crate::file::RecordingFile;
use crate::format::{self, AttachedFile, META_CLOCK, META_RECORDING, RESOLVED_STACK, STACK_TEXT};
use crate::sync::Command;
use ipc_types::clock;
use ipc_types::payload::{ScanPart, from_bytes};
use ipc_types::topic::TopicKind;
use mcap::{McapError, McapResult};
use std::fs::File;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

/// Time between attempts to record again after the disk failed.
const RETRY: Duration = Duration::from_secs(5);
/// A file that is due is ended when a keyframe comes, at the latest after this.
const KEYFRAME_WAIT: Duration = Duration::from_millis(500);

impl Writer {
    /// A new file begins at this message: the first part of a keyframe, so that the file verifies alone.
    pub(super) fn rotates_before(&mut self, batch: &Batch, entry: &Entry, now: Instant) -> bool {
        let Some(open) = &mut self.open else { return false };
        let aged = self.config.max_time.is_some_and(|t| now.duration_since(open.since) >= t.duration());
        let full = open.mcap.bytes() >= self.config.max_size.0 || open.mcap.is_full();
        if open.due.is_none() && (aged || full) {
            open.due = Some(now);
            let plcs = self.topics.iter().any(|t| t.kind == TopicKind::Keyframe);
            self.shared.keyframe_wanted.store(plcs, Ordering::Relaxed);
            if !plcs {
                return true;
            }
        }
        let Some(due) = open.due else { return false };
        let kind = self.topics.get(usize::from(entry.topic)).map(|t| t.kind);
        let first_part = || from_bytes::<ScanPart>(batch.message(entry).0).is_some_and(|p| p.part == 0);
        kind == Some(TopicKind::Keyframe) && first_part() || now.duration_since(due) >= KEYFRAME_WAIT
    }

    pub(super) fn rotate(&mut self) {
        self.finish_file();
        self.try_open();
    }

    pub(super) fn finish_file(&mut self) {
        if self.open.is_none() {
            return;
        }
        // A last chunk that does not fit is a disk that failed: what was in memory only is counted as lost.
        let close = |open: &mut Open| open.mcap.close_chunk();
        let closed = self.write_gaps(true).and_then(|()| self.open.as_mut().map_or(Ok(()), close));
        if let Err(error) = closed {
            return self.fail(&error);
        }
        let Some(open) = self.open.take() else { return };
        match open.mcap.finish() {
            Ok(()) => {
                let bytes = open.file.metadata().map_or(0, |m| m.len());
                self.finished_bytes += bytes;
                self.shelf.put(&open.path, bytes);
                self.sync(Command::Finished(open.path, open.file));
            }
            Err(error) => {
                self.broken.push(open.path.clone());
                self.pause(&open.path, &error.to_string());
            }
        }
        self.begin_counting();
    }

    fn begin_counting(&mut self) {
        for topic in &mut self.topics {
            self.finished_messages += topic.recorded;
            topic.base = topic.now;
            topic.recorded = 0;
            topic.dropped = 0;
            topic.pending = 0;
            topic.keyframe = false;
        }
    }

    /// After a file that was given up: what was still in memory is not in it.
    fn begin_counting_without_pending(&mut self) {
        let pending: Vec<u64> = self.topics.iter().map(|topic| topic.pending).collect();
        self.begin_counting();
        for (topic, pending) in self.topics.iter_mut().zip(pending) {
            topic.dropped = pending;
            self.dropped += pending;
            self.finished_messages = self.finished_messages.saturating_sub(pending);
        }
    }

    fn sync(&self, command: Command) {
        if let Some(sync) = &self.sync {
            let _ = sync.commands.send(command);
        }
    }

    /// The disk failed in the middle of a file.
    pub(super) fn fail(&mut self, error: &McapError) {
        let Some(open) = self.open.take() else { return };
        let bytes = open.mcap.bytes();
        open.mcap.abandon();
        self.finished_bytes += bytes;
        if bytes <= open.empty_bytes {
            // A disk that takes the beginning of a file and no more would be covered with beginnings.
            let _ = std::fs::remove_file(&open.path);
        } else {
            self.broken.push(open.path.clone());
        }
        self.begin_counting_without_pending();
        // An I/O error is the source; the crate's own text only says "I/O error".
        let cause = match error {
            McapError::Io(e) => e.to_string(),
            other => other.to_string(),
        };
        self.pause(&open.path, &cause);
    }

    /// Stops recording until the next attempt; told once per outage.
    fn pause(&mut self, path: &Path, cause: &str) {
        if self.retry_at.replace(Instant::now() + RETRY).is_some() {
            return;
        }
        let free =
            disk::free_bytes(&self.dir).map_or_else(String::new, |f| format!(" ({} free)", disk::human(f)));
        let message = format!(
            "recording stopped: cannot write {}: {cause}{free}; free space there or lower 'keep'; \
             trying again every {} s",
            path.display(),
            RETRY.as_secs()
        );
        if let Ok(mut progress) = self.shared.progress.lock() {
            progress.file.clear();
            progress.bytes = 0;
            progress.paused = Some(message.clone());
        }
        let detail = serde_json::json!({ "path": path.display().to_string(), "cause": cause });
        self.tell(true, message, detail);
    }

    /// Begins a file, or pauses.
    pub(super) fn try_open(&mut self) {
        self.keep_quota();
        let free = disk::free_bytes(&self.dir).unwrap_or(u64::MAX);
        if free < self.config.min_free.0 {
            let dir = self.dir.clone();
            return self.pause(&dir, &format!("less free space than min_free = {}", self.config.min_free));
        }
        let path = self.dir.clone();
        let made = std::fs::create_dir_all(&path)
            .and_then(|()| disk::create(&path, &self.stack.name, clock::utc_ns(), &mut self.n));
        let (path, file) = match made {
            Ok(made) => made,
            Err(e) => return self.pause(&path, &e.to_string()),
        };
        let file = Arc::new(file);
        match self.begin(&path, file.clone()) {
            Ok(open) => self.opened(open),
            Err(error) => {
                let cause = match &error {
                    McapError::Io(e) => e.to_string(),
                    other => other.to_string(),
                };
                // Nothing of it is worth keeping.
                let _ = std::fs::remove_file(&path);
                self.pause(&path, &cause);
            }
        }
    }

    fn opened(&mut self, open: Open) {
        self.sync(Command::Current(open.path.clone(), open.file.clone()));
        if let Ok(mut progress) = self.shared.progress.lock() {
            progress.files += 1;
            progress.paused = None;
            progress.file = open.path.display().to_string();
        }
        let plcs = self.topics.iter().any(|t| t.kind == TopicKind::Keyframe);
        self.shared.keyframe_wanted.store(plcs, Ordering::Relaxed);
        if self.retry_at.take().is_some() {
            let dropped: u64 = self.topics.iter().map(|t| t.dropped).sum();
            let message =
                format!("recording again, into {}; {dropped} messages were lost", open.path.display());
            self.tell(false, message, serde_json::Value::Null);
            let broken = std::mem::take(&mut self.broken);
            self.open = Some(open);
            self.seal_in_background(broken);
        } else {
            self.open = Some(open);
        }
    }

    /// Configuration, programs, channels, counters.
    fn begin(&mut self, path: &Path, file: Arc<File>) -> McapResult<Open> {
        let mut mcap = RecordingFile::new(file.clone(), self.config.compression, self.config.index)?;
        let (utc, t_ns) = (clock::utc_ns().max(0) as u64, clock::mono_ns());
        let about = format::recording_metadata(&self.stack, &self.service, self.generation, self.n);
        mcap.metadata(META_RECORDING, about)?;
        mcap.metadata(META_CLOCK, format::clock_metadata(self.utc_offset_ns, t_ns, "start"))?;
        mcap.attach(STACK_TEXT, "application/toml", utc, self.stack.text.as_bytes())?;
        let resolved = serde_json::to_vec_pretty(&*self.stack).unwrap_or_default();
        mcap.attach(RESOLVED_STACK, "application/json", utc, &resolved)?;
        self.attached.iter_mut().for_each(AttachedFile::forget);
        attach_changed(&mut mcap, &mut self.attached, &self.notices)?;
        self.modules.clear();
        attach_modules(&mut mcap, &self.stack, &mut self.modules, &self.notices)?;
        for topic in &mut self.topics {
            topic.channel = mcap.add_channel(&topic.spec)?;
        }
        let gaps_channel = mcap.add_channel(&format::gaps_channel())?;
        mcap.close_chunk()?;
        let now = Instant::now();
        Ok(Open {
            empty_bytes: mcap.bytes(),
            mcap,
            file,
            path: path.to_owned(),
            since: now,
            gaps_channel,
            gaps_seq: 0,
            gaps_missed: 0,
            gaps_at: now,
            due: None,
            utc_offset_ns: self.utc_offset_ns,
        })
    }

    pub(super) fn housekeeping(&mut self) {
        let now = Instant::now();
        self.housekeeping_at = now + HOUSEKEEPING;
        if self.retry_at.is_some_and(|at| now >= at) {
            self.retry_at = Some(now + RETRY);
            self.try_open();
        }
        self.replace_deleted();
        let Some(open) = &mut self.open else { return };
        let current = open.path.clone();
        if let Err(error) = attach_changed(&mut open.mcap, &mut self.attached, &self.notices) {
            self.fail(&error);
        } else if let Err(error) = self.flush(now) {
            self.fail(&error);
        }
        self.keep_quota();
        let free = disk::free_bytes(&self.dir).unwrap_or(u64::MAX);
        if free < self.config.min_free.0 && self.open.is_some() {
            self.finish_file();
            self.pause(&current, &format!("less free space than min_free = {}", self.config.min_free));
        }
        // A stack without traffic rotates too.
        let aged = |open: &Open| {
            self.config.max_time.is_some_and(|t| now - open.since >= t.duration() + KEYFRAME_WAIT)
        };
        if self.open.as_ref().is_some_and(aged) {
            self.rotate();
        }
    }

    /// A file that somebody deleted, or whose folder, takes what is written to it along when it is closed.
    fn replace_deleted(&mut self) {
        use std::os::unix::fs::MetadataExt;
        // Some file systems count no links: there the name decides.
        let deleted = |open: &Open| open.file.metadata().is_ok_and(|m| m.nlink() == 0) && !open.path.exists();
        let Some(open) = self.open.take_if(|open| deleted(open)) else { return };
        self.sync(Command::Gone(open.path.clone()));
        self.shelf.forget(&open.path);
        let recorded: u64 = self.topics.iter().map(|topic| topic.recorded).sum();
        let message = format!(
            "{} was deleted while it was written, with {recorded} messages; recording goes on in a new file",
            open.path.display()
        );
        open.mcap.abandon();
        self.begin_counting();
        self.tell(true, message, serde_json::json!({ "path": open.path.display().to_string() }));
        self.try_open();
    }
}
