//! The thread that writes: messages, gap counters, and what it shows of itself. Which file they go to, and what happens
//! when there is none, is in `files`; what goes into a file beside them in `attach`; what is done about files of
//! others' making in `sealing`.
//!
//! It must never be waited for: the drain thread hands over batches and goes on. When the disk fails, batches
//! are counted and thrown away, and a new file is tried every 5 s.

mod attach;
mod files;
mod sealing;

use attach::attach_modules;

use crate::batch::{Batch, Entry, Pool};
use crate::config::Config;
use crate::file::{ChannelSpec, RecordingFile};
use crate::format::{self, AttachedFile, Gaps, META_CLOCK, TopicGaps, utc_of};
use crate::shelf::Shelf;
use crate::sync::Syncer;
use ipc_types::clock;
use ipc_types::payload::Encoding;
use ipc_types::port::ReadCounters;
use ipc_types::stack::Stack;
use ipc_types::topic::TopicKind;
use mcap::McapResult;
use mcap::records::MessageHeader;
use serde::Serialize;
use std::collections::BTreeSet;
use std::fs::File;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

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
    /// Of the recorded ones, those that are in memory only.
    pending: u64,
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
    /// What lies in the folder.
    shelf: Shelf,
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
                pending: 0,
                base: ReadCounters::default(),
                now: ReadCounters::default(),
                keyframe: false,
            })
            .collect();
        Self {
            shelf: Shelf::new(&dir, &stack.name),
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
        // Names alone, which are quick to read: what comes meanwhile waits for the file.
        self.n = self.shelf.last_number();
        self.try_open();
        self.tidy();
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
                self.drop_one(usize::from(entry.topic));
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
        let index = usize::from(entry.topic);
        let Some(topic) = self.topics.get(index) else { return Ok(()) };
        let Some(open) = &mut self.open else {
            self.drop_one(index);
            return Ok(());
        };
        let (kind, json, utc) = (topic.kind, topic.json, utc_of(entry.t_ns, self.utc_offset_ns));
        let head = MessageHeader {
            channel_id: topic.channel,
            sequence: entry.seq as u32,
            log_time: utc,
            publish_time: utc,
        };
        let data = if json { batch.message(entry).1 } else { batch.data(entry) };
        let chunks = open.mcap.chunks();
        open.mcap.message(&head, data, now)?;
        if open.mcap.chunks() != chunks {
            self.all_in_file();
        }
        self.loaded |= kind == TopicKind::Events && format::says_loaded(data);
        let Some(topic) = self.topics.get_mut(index) else { return Ok(()) };
        topic.recorded += 1;
        topic.pending += 1;
        if kind == TopicKind::Keyframe && !topic.keyframe {
            topic.keyframe = true;
            let missing = self.topics.iter().any(|t| t.kind == TopicKind::Keyframe && !t.keyframe);
            self.shared.keyframe_wanted.store(missing, Ordering::Relaxed);
        }
        Ok(())
    }

    /// A message that is not in the recording.
    fn drop_one(&mut self, topic: usize) {
        if let Some(topic) = self.topics.get_mut(topic) {
            topic.dropped += 1;
            self.dropped += 1;
        }
    }

    fn all_in_file(&mut self) {
        self.topics.iter_mut().for_each(|topic| topic.pending = 0);
    }

    fn flush(&mut self, now: Instant) -> McapResult<()> {
        let Some(open) = &mut self.open else { return Ok(()) };
        let missed: u64 = self.topics.iter().map(|t| t.gaps().missed()).sum();
        let changed = missed != open.gaps_missed && now.duration_since(open.gaps_at) >= HOUSEKEEPING;
        if changed || now.duration_since(open.gaps_at) >= GAPS_PERIOD {
            self.write_gaps(false)?;
        }
        let Some(open) = &mut self.open else { return Ok(()) };
        open.mcap.flush(now)?;
        self.all_in_file();
        Ok(())
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

    fn show(&self) {
        let Ok(mut progress) = self.shared.progress.lock() else { return };
        progress.bytes = self.open.as_ref().map_or(0, |open| open.mcap.bytes());
        progress.bytes_total = self.finished_bytes + progress.bytes;
        progress.dropped = self.dropped;
        progress.messages = self.finished_messages + self.topics.iter().map(|t| t.recorded).sum::<u64>();
    }
    fn tell(&self, fault: bool, message: String, detail: serde_json::Value) {
        let _ = self.notices.send(Notice { fault, message, detail });
    }
}
