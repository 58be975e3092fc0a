//! A writer thread without a rail, and messages to feed it.
#![allow(dead_code, reason = "each test file uses a part of it")]

use dinrail_recorder::batch::{Batch, Pool, QUEUE};
use dinrail_recorder::format::recorded_topics;
use dinrail_recorder::writer::{Notice, Progress, Shared, ToWriter, Writer};
use dinrail_recorder::{Config, disk};
use ipc_types::clock;
use ipc_types::payload::{
    CanFrame, Event, Inputs, JobResult, Payload, ScanPart, Stamp, Status, as_bytes, fd_flag,
};
use ipc_types::port::ReadCounters;
use ipc_types::stack::{ServiceEntry, Stack, TopicEntry};
use ipc_types::topic::{EVENTS, TopicKind};
use ipc_types::wiring::Wiring;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, channel, sync_channel};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

pub struct TempDir(PathBuf);

impl TempDir {
    pub fn new(name: &str) -> Self {
        Self::below(&std::env::temp_dir(), name)
    }
    /// In memory: for tests that sync many small files.
    pub fn fast(name: &str) -> Self {
        let shm = Path::new("/dev/shm");
        if shm.is_dir() { Self::below(shm, name) } else { Self::new(name) }
    }
    fn below(parent: &Path, name: &str) -> Self {
        static COUNT: AtomicU32 = AtomicU32::new(0);
        let n = COUNT.fetch_add(1, Ordering::Relaxed);
        let path = parent.join(format!("dinrail-rec-it-{}-{name}-{n}", std::process::id()));
        std::fs::create_dir_all(&path).unwrap();
        Self(path)
    }
    pub fn path(&self) -> &Path {
        &self.0
    }
}

impl Drop for TempDir {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

pub fn wait_for(what: &str, mut condition: impl FnMut() -> bool) {
    let limit = Instant::now() + Duration::from_mins(1);
    while !condition() {
        assert!(Instant::now() < limit, "waited 60 s for {what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

pub fn topic(name: &str, kind: TopicKind) -> TopicEntry {
    let writer = name.split('/').next().unwrap_or_default().to_owned();
    TopicEntry {
        name: name.into(),
        kind,
        depth: kind.row().depth,
        max_tail: kind.row().max_tail,
        writers: vec![writer],
        readers: Vec::new(),
        wakes: Vec::new(),
        max_publishers: 6,
        max_subscribers: 6,
    }
}

pub fn service(name: &str, kind: &str, index: u32, config: serde_json::Value) -> ServiceEntry {
    ServiceEntry { name: name.into(), kind: kind.into(), index, config, wiring: Wiring::default() }
}

/// A stack with a bus, an input service and a plc, in a folder with its program.
pub fn stack(dir: &Path) -> Stack {
    std::fs::write(dir.join("main.st"), "PROGRAM main END_PROGRAM").unwrap();
    let mut plc = service("plc", "plc", 3, serde_json::json!({ "program": ["main.st"] }));
    plc.wiring.files = vec![("main.st".into(), "program[0]".into())];
    let kinds = [
        ("can0", TopicKind::CanRx),
        ("io", TopicKind::Inputs),
        ("plc", TopicKind::Scan),
        ("plc", TopicKind::Keyframe),
        ("plc", TopicKind::Results),
        ("can0", TopicKind::Status),
    ];
    let mut topics: Vec<_> = kinds.iter().map(|(svc, kind)| topic(&kind.of(svc), *kind)).collect();
    topics.push(topic(EVENTS, TopicKind::Events));
    Stack {
        name: "test".into(),
        file: dir.join("stack.toml"),
        dir: dir.to_owned(),
        text: "[stack]\nname = \"test\"\n".into(),
        build_id: "build-1".into(),
        root: dir.join("root"),
        prefix: "none_".into(),
        services: vec![
            service("can0", "can", 1, serde_json::json!({})),
            service("io", "can-io", 2, serde_json::json!({})),
            plc,
            service("rec", "recorder", 4, serde_json::json!({})),
        ],
        topics,
    }
}

pub struct Message {
    pub topic: String,
    pub stamp: Stamp,
    pub header: Vec<u8>,
    pub tail: Vec<u8>,
}

pub fn message<H: Payload>(topic: &str, mut header: H, tail: &[u8], seq: u64, t_ns: u64) -> Message {
    let stamp = Stamp { seq, t_ns, generation: 1, writer: 1 };
    *header.stamp_mut() = stamp;
    header.set_tail_len(tail.len() as u32);
    Message { topic: topic.into(), stamp, header: as_bytes(&header).to_vec(), tail: tail.to_vec() }
}

pub fn frame(seq: u64, t_ns: u64) -> Message {
    let frame = CanFrame::classic(0x100 + (seq % 64) as u32, &seq.to_le_bytes());
    message("can0/rx", frame, &[], seq, t_ns)
}

pub fn keyframe(seq: u64, t_ns: u64) -> Message {
    let part = ScanPart { scan: seq, part: 0, parts: 1, total: 3, ..ScanPart::default() };
    message("plc/keyframe", part, b"key", seq, t_ns)
}

/// One of every recorded kind, with values that a decoder can be asked for.
pub fn one_of_each(t: u64) -> Vec<Message> {
    let mut fd = CanFrame {
        can_id: 0x9ABC_DEF0,
        len: 12,
        fd_flags: fd_flag::FDF | fd_flag::BRS,
        ..CanFrame::default()
    };
    fd.data[..12].copy_from_slice(b"hello, CAN!!");
    let inputs = Inputs { data_t_ns: t - 5, ranges: 2, ..Inputs::default() };
    let scan = ScanPart { scan: 77, part: 1, parts: 2, total: 5, ..ScanPart::default() };
    let result = JobResult { job_seq: 9, job_writer: 4, job_generation: 2, code: 3, ..JobResult::default() };
    vec![
        message("can0/rx", CanFrame::classic(0x1A0, &[0xDE, 0xAD]), &[], 1, t),
        message("can0/rx", fd, &[], 2, t + 1),
        message("io/inputs", inputs, &[1, 2, 3, 0, 1], 1, t + 2),
        message("plc/scan", scan, &[9, 8, 7], 0x1_0000_0005, t + 3),
        keyframe(1, t + 4),
        message("plc/results", result, br#"{"ok":true}"#, 1, t + 5),
        message("can0/status", Status::default(), br#"{"load":0.25}"#, 1, t + 6),
        message(EVENTS, Event::default(), r#"{"event":"died","message":"Überlast"}"#.as_bytes(), 1, t + 7),
    ]
}

/// A running writer thread.
pub struct Rig {
    pub shared: Arc<Shared>,
    pub notices: Receiver<Notice>,
    pub stack: Arc<Stack>,
    pub dir: PathBuf,
    to_writer: SyncSender<ToWriter>,
    thread: JoinHandle<()>,
    topics: Vec<String>,
    pub counters: Vec<ReadCounters>,
    pub utc_offset_ns: i64,
}

impl Rig {
    pub fn start(stack: Stack, config: Config) -> Self {
        let stack = Arc::new(stack);
        let topics: Vec<_> =
            recorded_topics(&stack, &config.exclude).iter().map(|t| t.name.clone()).collect();
        let shared = Arc::new(Shared {
            pool: Pool::new(QUEUE, topics.len(), 20_000),
            progress: Mutex::new(Progress::default()),
            keyframe_wanted: AtomicBool::new(false),
        });
        let (to_writer, inbox) = sync_channel(QUEUE + 1);
        let (notice, notices) = channel();
        let dir = config.folder(&stack.dir);
        let utc_offset_ns = clock::utc_offset_ns();
        let writer = Writer::new(config, stack.clone(), "rec", 1, shared.clone(), notice, utc_offset_ns);
        let thread = std::thread::spawn(move || writer.run(&inbox));
        let counters = vec![ReadCounters::default(); topics.len()];
        Self { shared, notices, stack, dir, to_writer, thread, topics, counters, utc_offset_ns }
    }

    pub fn index(&self, topic: &str) -> usize {
        self.topics.iter().position(|t| t == topic).unwrap()
    }

    /// Hands messages over as the drain thread does; waits for buffers.
    pub fn send(&mut self, messages: &[Message]) {
        let mut batch = self.take();
        for m in messages {
            let index = self.index(&m.topic);
            if !batch.push(index as u16, &m.stamp, &m.header, &m.tail) {
                let full = std::mem::replace(&mut batch, self.take());
                self.hand_over(full);
                assert!(batch.push(index as u16, &m.stamp, &m.header, &m.tail));
            }
            self.counters[index].received += 1;
        }
        self.hand_over(batch);
    }

    fn take(&self) -> Batch {
        let mut taken = None;
        wait_for("a free buffer", || {
            taken = self.shared.pool.take();
            taken.is_some()
        });
        taken.unwrap()
    }

    fn hand_over(&self, mut batch: Batch) {
        batch.counters.copy_from_slice(&self.counters);
        batch.utc_offset_ns = self.utc_offset_ns;
        assert!(self.to_writer.send(ToWriter::Batch(batch)).is_ok());
    }

    /// Waits until everything handed over is written.
    pub fn settle(&self) {
        wait_for("the writer", || self.shared.pool.free() == QUEUE);
    }

    pub fn progress(&self) -> Progress {
        self.shared.progress.lock().unwrap().clone()
    }

    pub fn files(&self) -> Vec<PathBuf> {
        disk::recordings(&self.dir, &self.stack.name).into_iter().map(|f| f.path).collect()
    }

    /// Ends the writer; the files.
    pub fn stop(self) -> Vec<PathBuf> {
        assert!(self.to_writer.send(ToWriter::Stop).is_ok());
        self.thread.join().unwrap();
        disk::recordings(&self.dir, &self.stack.name).into_iter().map(|f| f.path).collect()
    }
}
