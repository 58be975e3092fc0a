//! The thread that writes: files, rotation, quota, gap counters, and what happens when the disk is full.
//!
//! It must never be waited for: the drain thread hands over batches and goes on. When the disk fails, batches
//! are counted and thrown away, and a new file is tried every 5 s.

use crate::batch::{Batch, Entry, Pool};
use crate::config::Config;
use crate::disk;
use crate::file::{ChannelSpec, RecordingFile};
use crate::format::{
    self, AttachedFile, Gaps, META_CLOCK, META_RECORDING, RESOLVED_STACK, STACK_TEXT, TopicGaps, utc_of,
};
use crate::seal;
use crate::sync::{Command, Syncer};
use ipc_types::clock;
use ipc_types::payload::{Encoding, ScanPart, from_bytes};
use ipc_types::port::ReadCounters;
use ipc_types::stack::Stack;
use ipc_types::topic::TopicKind;
use mcap::records::MessageHeader;
use mcap::{McapError, McapResult};
use serde::Serialize;
use std::collections::BTreeSet;
use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

/// Time between attempts to record again after the disk failed.
const RETRY: Duration = Duration::from_secs(5);
/// How often, and how long between, a file to be made whole is looked at again while it is in use: 10 s.
const SEAL_LOOKS: u32 = 50;
const SEAL_PAUSE: Duration = Duration::from_millis(200);
/// A file that is due is ended when a keyframe comes, at the latest after this.
const KEYFRAME_WAIT: Duration = Duration::from_millis(500);
/// Gap counters are written this often although nothing was lost.
const GAPS_PERIOD: Duration = Duration::from_secs(10);
const HOUSEKEEPING: Duration = Duration::from_secs(1);

/// From the drain thread.
pub enum ToWriter {
    Batch(Batch),
    /// Finish the file and end.
    Stop,
}

/// To the drain thread, which has the rail.
#[derive(Debug, Clone)]
pub struct Notice {
    pub fault: bool,
    pub message: String,
    pub detail: serde_json::Value,
}

/// What the recorder shows of itself.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Progress {
    /// Current file; empty while paused.
    pub file: String,
    /// Bytes of the current file.
    pub bytes: u64,
    /// Bytes of all files since start.
    pub bytes_total: u64,
    /// Messages written since start.
    pub messages: u64,
    /// Messages read and thrown away, because the disk was full, since start.
    pub dropped: u64,
    /// Files begun since start.
    pub files: u32,
    /// Unfinished files of earlier runs that were made whole.
    pub sealed: u32,
    /// Why nothing is recorded now.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub paused: Option<String>,
}

/// What both threads see.
#[derive(Debug)]
pub struct Shared {
    pub pool: Pool,
    pub progress: Mutex<Progress>,
    /// Somebody must ask the plcs for a keyframe.
    pub keyframe_wanted: AtomicBool,
}

/// A recorded topic, as the writer needs it.
struct Topic {
    spec: ChannelSpec,
    kind: TopicKind,
    json: bool,
    channel: u16,
    /// Messages of the current file, and dropped since the last one ended.
    recorded: u64,
    dropped: u64,
    /// Counters when the current file began.
    base: ReadCounters,
    now: ReadCounters,
    /// A keyframe of this topic stands in the current file.
    keyframe: bool,
}

impl Topic {
    fn gaps(&self) -> TopicGaps {
        TopicGaps {
            recorded: self.recorded,
            lost: self.now.lost - self.base.lost,
            old: self.now.old - self.base.old,
            malformed: self.now.malformed - self.base.malformed,
            dropped: self.dropped,
        }
    }
}

struct Open {
    mcap: RecordingFile,
    file: Arc<File>,
    path: PathBuf,
    since: Instant,
    /// Of the file without a message.
    empty_bytes: u64,
    gaps_channel: u16,
    gaps_seq: u32,
    /// What was written last.
    gaps_missed: u64,
    gaps_at: Instant,
    /// Shall end at the next keyframe.
    due: Option<Instant>,
    utc_offset_ns: i64,
}

/// The thread's state.
pub struct Writer {
    config: Config,
    stack: Arc<Stack>,
    service: String,
    generation: u32,
    dir: PathBuf,
    topics: Vec<Topic>,
    attached: Vec<AttachedFile>,
    /// Compiled programs that stand in the current file.
    modules: BTreeSet<String>,
    /// A plc has loaded a program: it may be one that the current file lacks.
    loaded: bool,
    shared: Arc<Shared>,
    notices: Sender<Notice>,
    sync: Option<Syncer>,
    open: Option<Open>,
    /// A file that a failing disk left unfinished.
    broken: Vec<PathBuf>,
    /// When to try again, while paused.
    retry_at: Option<Instant>,
    housekeeping_at: Instant,
    /// Number of the file begun last; counts on where the files of the folder end.
    n: u64,
    finished_bytes: u64,
    finished_messages: u64,
    dropped: u64,
    utc_offset_ns: i64,
}

impl Writer {
    /// Nothing is opened yet. `utc_offset_ns` is that of the first batch.
    pub fn new(
        config: Config,
        stack: Arc<Stack>,
        service: &str,
        generation: u32,
        shared: Arc<Shared>,
        notices: Sender<Notice>,
        utc_offset_ns: i64,
    ) -> Self {
        let dir = config.folder(&stack.dir);
        let topics = format::recorded_topics(&stack, &config.exclude)
            .into_iter()
            .map(|entry| Topic {
                spec: format::channel(entry),
                kind: entry.kind,
                json: entry.kind.encoding() == Encoding::Json,
                channel: 0,
                recorded: 0,
                dropped: 0,
                base: ReadCounters::default(),
                now: ReadCounters::default(),
                keyframe: false,
            })
            .collect();
        Self {
            attached: format::attached_files(&stack),
            modules: BTreeSet::new(),
            loaded: false,
            config,
            stack,
            service: service.to_owned(),
            generation,
            dir,
            topics,
            shared,
            notices,
            sync: None,
            open: None,
            broken: Vec::new(),
            retry_at: None,
            housekeeping_at: Instant::now() + HOUSEKEEPING,
            n: 0,
            finished_bytes: 0,
            finished_messages: 0,
            dropped: 0,
            utc_offset_ns,
        }
    }

    /// Writes what comes until [`ToWriter::Stop`], then finishes the file. Unfinished files that lay in the
    /// folder before are made whole in the background.
    pub fn run(mut self, inbox: &Receiver<ToWriter>) {
        let failed = self.notices.clone();
        self.sync = Syncer::start(move |path, error| {
            let message = format!("{}: fdatasync failed: {error}; the medium may be dying", path.display());
            let _ = failed.send(Notice { fault: true, message, detail: serde_json::Value::Null });
        })
        .ok();
        let old: Vec<_> = disk::recordings(&self.dir, &self.stack.name).into_iter().map(|f| f.path).collect();
        disk::remove_half_sealed(&self.dir, &self.stack.name);
        self.n = disk::last_number(&self.dir, &self.stack.name);
        self.try_open();
        self.seal_in_background(old);
        loop {
            match inbox.recv_timeout(HOUSEKEEPING) {
                Ok(ToWriter::Batch(mut batch)) => {
                    self.take(&mut batch);
                    self.shared.pool.give(batch);
                }
                Ok(ToWriter::Stop) | Err(RecvTimeoutError::Disconnected) => break,
                Err(RecvTimeoutError::Timeout) => {}
            }
            if Instant::now() >= self.housekeeping_at {
                self.housekeeping();
            }
        }
        self.finish_file();
        self.show();
        if let Some(sync) = self.sync.take() {
            drop(sync.commands);
            let _ = sync.thread.join();
        }
    }

    /// Writes one batch.
    pub fn take(&mut self, batch: &mut Batch) {
        batch.merge();
        for (topic, counters) in self.topics.iter_mut().zip(&batch.counters) {
            topic.now = *counters;
        }
        self.clock_jump(batch.utc_offset_ns);
        let now = Instant::now();
        for i in 0..batch.entries.len() {
            let entry = batch.entries[i];
            if self.rotates_before(batch, &entry, now) {
                self.rotate();
            }
            if let Err(error) = self.message(batch, &entry, now) {
                self.fail(&error);
            }
        }
        if let Err(error) = self.attach_loaded().and_then(|()| self.flush(now)) {
            self.fail(&error);
        }
        self.show();
    }

    /// The program that was just loaded goes into the file, before its file may be gone.
    fn attach_loaded(&mut self) -> McapResult<()> {
        match &mut self.open {
            Some(open) if std::mem::take(&mut self.loaded) => {
                attach_modules(&mut open.mcap, &self.stack, &mut self.modules, &self.notices)
            }
            _ => Ok(()),
        }
    }

    fn message(&mut self, batch: &Batch, entry: &Entry, now: Instant) -> McapResult<()> {
        let Some(topic) = self.topics.get_mut(usize::from(entry.topic)) else { return Ok(()) };
        let Some(open) = &mut self.open else {
            topic.dropped += 1;
            self.dropped += 1;
            return Ok(());
        };
        let utc = utc_of(entry.t_ns, self.utc_offset_ns);
        let head = MessageHeader {
            channel_id: topic.channel,
            sequence: entry.seq as u32,
            log_time: utc,
            publish_time: utc,
        };
        let data = if topic.json { batch.message(entry).1 } else { batch.data(entry) };
        open.mcap.message(&head, data, now)?;
        topic.recorded += 1;
        self.loaded |= topic.kind == TopicKind::Events && format::says_loaded(data);
        if topic.kind == TopicKind::Keyframe && !topic.keyframe {
            topic.keyframe = true;
            let missing = self.topics.iter().any(|t| t.kind == TopicKind::Keyframe && !t.keyframe);
            self.shared.keyframe_wanted.store(missing, Ordering::Relaxed);
        }
        Ok(())
    }

    fn flush(&mut self, now: Instant) -> McapResult<()> {
        let Some(open) = &mut self.open else { return Ok(()) };
        let missed: u64 = self.topics.iter().map(|t| t.gaps().missed()).sum();
        let changed = missed != open.gaps_missed && now.duration_since(open.gaps_at) >= HOUSEKEEPING;
        if changed || now.duration_since(open.gaps_at) >= GAPS_PERIOD {
            self.write_gaps(false)?;
        }
        self.open.as_mut().map_or(Ok(()), |open| open.mcap.flush(now))
    }

    fn write_gaps(&mut self, last: bool) -> McapResult<()> {
        let gaps = Gaps::new(self.topics.iter().map(|t| (t.spec.topic.clone(), t.gaps())), last);
        let Some(open) = &mut self.open else { return Ok(()) };
        open.gaps_missed = gaps.missed;
        open.gaps_at = Instant::now();
        open.gaps_seq += 1;
        let utc = utc_of(clock::mono_ns(), self.utc_offset_ns);
        let head = MessageHeader {
            channel_id: open.gaps_channel,
            sequence: open.gaps_seq,
            log_time: utc,
            publish_time: utc,
        };
        open.mcap.message(&head, &serde_json::to_vec(&gaps).unwrap_or_default(), open.gaps_at)
    }

    fn clock_jump(&mut self, utc_offset_ns: i64) {
        self.utc_offset_ns = utc_offset_ns;
        let Some(open) = &mut self.open else { return };
        if open.utc_offset_ns != utc_offset_ns {
            open.utc_offset_ns = utc_offset_ns;
            let entries = format::clock_metadata(utc_offset_ns, clock::mono_ns(), "jump");
            if let Err(error) = open.mcap.metadata(META_CLOCK, entries) {
                self.fail(&error);
            }
        }
    }

    /// A new file begins at this message: the first part of a keyframe, so that the file verifies alone.
    fn rotates_before(&mut self, batch: &Batch, entry: &Entry, now: Instant) -> bool {
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

    fn rotate(&mut self) {
        self.finish_file();
        self.try_open();
    }

    fn finish_file(&mut self) {
        if self.open.is_none() {
            return;
        }
        if let Err(error) = self.write_gaps(true) {
            return self.fail(&error);
        }
        let Some(open) = self.open.take() else { return };
        match open.mcap.finish() {
            Ok(()) => {
                self.finished_bytes += open.file.metadata().map_or(0, |m| m.len());
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
            topic.keyframe = false;
        }
    }

    fn sync(&self, command: Command) {
        if let Some(sync) = &self.sync {
            let _ = sync.commands.send(command);
        }
    }

    /// The disk failed in the middle of a file.
    fn fail(&mut self, error: &McapError) {
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
        self.begin_counting();
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
        let _ = self.notices.send(Notice { fault: true, message, detail });
    }

    /// Begins a file, or pauses.
    fn try_open(&mut self) {
        let deleted = disk::enforce_quota(&self.dir, &self.stack.name, self.config.keep.0, None);
        for found in deleted {
            tracing::info!("deleted {} to stay below keep = {}", found.path.display(), self.config.keep);
        }
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
            let _ = self.notices.send(Notice { fault: false, message, detail: serde_json::Value::Null });
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

    fn housekeeping(&mut self) {
        let now = Instant::now();
        self.housekeeping_at = now + HOUSEKEEPING;
        if self.retry_at.is_some_and(|at| now >= at) {
            self.retry_at = Some(now + RETRY);
            self.try_open();
        }
        let Some(open) = &mut self.open else { return };
        let current = open.path.clone();
        if let Err(error) = attach_changed(&mut open.mcap, &mut self.attached, &self.notices) {
            self.fail(&error);
        } else if let Err(error) = self.flush(now) {
            self.fail(&error);
        }
        disk::enforce_quota(&self.dir, &self.stack.name, self.config.keep.0, Some(&current));
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

    fn show(&self) {
        let Ok(mut progress) = self.shared.progress.lock() else { return };
        progress.bytes = self.open.as_ref().map_or(0, |open| open.mcap.bytes());
        progress.bytes_total = self.finished_bytes + progress.bytes;
        progress.dropped = self.dropped;
        progress.messages = self.finished_messages + self.topics.iter().map(|t| t.recorded).sum::<u64>();
    }

    /// Makes unfinished files whole that nobody is writing.
    fn seal_in_background(&self, files: Vec<PathBuf>) {
        let files: Vec<_> = files.into_iter().filter(|path| !disk::is_finished(path)).collect();
        if files.is_empty() {
            return;
        }
        let (notices, shared) = (self.notices.clone(), self.shared.clone());
        let work = move || {
            for path in files {
                let (fault, message) = match recover_when_free(&path) {
                    Ok(report) => (false, format!("made {} whole: {report}", path.display())),
                    Err(seal::SealError::InUse(_)) => continue,
                    Err(error) => (true, error.to_string()),
                };
                if let Ok(mut progress) = shared.progress.lock() {
                    progress.sealed += u32::from(!fault);
                }
                let detail = serde_json::json!({ "path": path.display().to_string() });
                let _ = notices.send(Notice { fault, message, detail });
            }
        };
        let _ = std::thread::Builder::new().name("rec-seal".into()).spawn(work);
    }
}

/// A file that is given up may be in use for as long as its last data takes to the disk; one that is in use for longer is
/// another recorder's.
fn recover_when_free(path: &Path) -> Result<seal::Report, seal::SealError> {
    let mut looks = SEAL_LOOKS;
    loop {
        match seal::recover(path) {
            Err(seal::SealError::InUse(_)) if looks > 0 => {
                looks -= 1;
                std::thread::sleep(SEAL_PAUSE);
            }
            result => return result,
        }
    }
}

/// Adds what changed on disk since it was added last.
fn attach_changed(
    mcap: &mut RecordingFile,
    files: &mut [AttachedFile],
    notices: &Sender<Notice>,
) -> McapResult<()> {
    let utc = clock::utc_ns().max(0) as u64;
    for file in files {
        match file.read_if_changed() {
            Some(Ok(data)) => mcap.attach(&file.name, format::media_type(&file.name), utc, &data)?,
            Some(Err(message)) => {
                let detail = serde_json::Value::Null;
                let _ = notices.send(Notice { fault: true, message, detail });
            }
            None => {}
        }
    }
    Ok(())
}

/// Adds the compiled programs that the file lacks. One that cannot be read is told, once a file.
fn attach_modules(
    mcap: &mut RecordingFile,
    stack: &Stack,
    there: &mut BTreeSet<String>,
    notices: &Sender<Notice>,
) -> McapResult<()> {
    let utc = clock::utc_ns().max(0) as u64;
    for (name, path) in format::modules(stack) {
        if !there.insert(name.clone()) {
            continue;
        }
        match format::read_attachment(&path) {
            Ok(data) => mcap.attach(&name, format::media_type(&name), utc, &data)?,
            Err(message) => {
                let _ = notices.send(Notice { fault: true, message, detail: serde_json::Value::Null });
            }
        }
    }
    Ok(())
}
