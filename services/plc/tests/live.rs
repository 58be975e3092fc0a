//! The service on a real rail, in a process of its own, from its first scan over faults and loads to its death
//! and return; and what it recorded meanwhile verifies exactly.
//!
//! This process plays launcher, field service and recorder; the same executable, started again with a variable
//! set, is the plc service.
#![allow(unsafe_code)]
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use dinrail_plc::engine::Program;
use dinrail_plc::verify::Verifier;
use dinrail_plc::{program, retain};
use ipc_types::event::{EventBody, EventKind};
use ipc_types::image_write::{Builder, Op};
use ipc_types::payload::{Event, Image, ImageWrite, Inputs, Job, JobResult, PlcState, ScanPart, acks};
use ipc_types::port::{Publisher, Subscriber};
use ipc_types::scan_record::{Joiner, MAX_KEYFRAME_BYTES, MAX_RECORD_BYTES};
use ipc_types::stack::{ServiceEntry, Stack, TopicEntry};
use ipc_types::topic::{EVENTS, TopicKind};
use ipc_types::wiring::{Area, ImageRange, Neighbours, OnBad};
use ipc_types::{Context, Wiring, clock, rail};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::os::fd::{AsRawFd, FromRawFd, OwnedFd};
use std::path::{Path, PathBuf};
use std::process::{Child, Command};
use std::time::{Duration, Instant};

const ROOT: &str = "DINRAIL_PLC_TEST_ROOT";
const GENERATION: &str = "DINRAIL_PLC_TEST_GENERATION";
const RETAIN: &str = "DINRAIL_PLC_TEST_RETAIN";
const PATIENCE: Duration = Duration::from_mins(1);

const MAIN: &str = "PROGRAM main
VAR out AT %QW0 : UINT; setpoint AT %MW0 : UINT; sel : INT; zero : INT; r : INT; t : TON; scans : UDINT;
  a : INT; b : INT; torn : INT; END_VAR
VAR RETAIN kept : UDINT; END_VAR
  scans := scans + 1; kept := kept + 1;
  t(IN := TRUE, PT := T#1h);
  out := Level * 2 + setpoint;
  IF sel = 1 THEN r := 10 / zero; END_IF;
  IF a <> b THEN torn := torn + 1; END_IF;
END_PROGRAM";

/// The plc service, when this executable is started as it.
#[test]
fn child() {
    let Some(root) = std::env::var_os(ROOT) else { return };
    let parent = std::os::unix::process::parent_id();
    std::thread::spawn(move || {
        // A test that was killed leaves nobody behind.
        while std::os::unix::process::parent_id() == parent {
            std::thread::sleep(Duration::from_millis(200));
        }
        std::process::exit(1);
    });
    let number = |name: &str| std::env::var(name).unwrap().parse::<i32>().unwrap();
    // SAFETY: the parent passed this descriptor and nobody else in this process knows it.
    let fd = unsafe { OwnedFd::from_raw_fd(number(RETAIN)) };
    let fds = BTreeMap::from([("retain".to_owned(), fd)]);
    let ctx = Context::service(Path::new(&root), "plc", number(GENERATION) as u32, fds).unwrap();
    dinrail_plc::run(ctx).unwrap();
}

struct Ground {
    root: PathBuf,
    prefix: String,
    dir: PathBuf,
    child: Option<Child>,
}

impl Ground {
    fn start(&mut self, generation: u32, retain: &OwnedFd) {
        self.kill();
        let child = Command::new(std::env::current_exe().unwrap())
            .args(["--exact", "child", "--nocapture"])
            .env(ROOT, &self.root)
            .env(GENERATION, generation.to_string())
            .env(RETAIN, retain.as_raw_fd().to_string())
            .spawn()
            .unwrap();
        self.child = Some(child);
    }
    fn kill(&mut self) {
        if let Some(mut child) = self.child.take() {
            child.kill().unwrap();
            child.wait().unwrap();
        }
    }
}

impl Drop for Ground {
    fn drop(&mut self) {
        self.kill();
        let _ = std::fs::remove_dir_all(&self.root);
        let _ = std::fs::remove_dir_all(&self.dir);
        for entry in std::fs::read_dir("/dev/shm").unwrap().flatten() {
            if entry.file_name().to_string_lossy().starts_with(&self.prefix) {
                let _ = std::fs::remove_file(entry.path());
            }
        }
    }
}

fn level_range() -> ImageRange {
    ImageRange {
        area: Area::Input,
        byte: 0,
        bit: None,
        bytes: 2,
        type_name: Some("UINT".into()),
        symbol: Some("Level".into()),
        label: "level".into(),
        key: "in[0].to".into(),
        on_bad: OnBad::Zero,
        status_byte: Some(10),
    }
}

fn stack(name: &str, root: &Path, prefix: &str, dir: &Path, config: &Value) -> Stack {
    let plc_config: dinrail_plc::Config = serde_json::from_value(config.clone()).unwrap();
    let neighbours = Neighbours { name: "plc".into(), ..Neighbours::default() };
    let plc = dinrail_plc::topics(&plc_config, &neighbours);
    let io = Wiring { plc: Some("plc".into()), inputs: vec![level_range()], ..Wiring::default() };
    let mut topics = Vec::new();
    let mut add = |name: String, kind: TopicKind, depth: u32, max_tail: u32, wakes: Vec<String>| {
        let (max_publishers, max_subscribers) = rail::port_limits(kind, 3, 3);
        let (writers, readers) = (Vec::new(), Vec::new());
        topics.push(TopicEntry {
            name,
            kind,
            depth,
            max_tail,
            writers,
            readers,
            wakes,
            max_publishers,
            max_subscribers,
        });
    };
    for decl in &plc.topics {
        let wakes = match decl.kind {
            TopicKind::Writes => vec!["plc".into()],
            TopicKind::Jobs => vec!["plc".into()],
            _ => Vec::new(),
        };
        add(decl.kind.of("plc"), decl.kind, decl.depth, decl.max_tail, wakes);
    }
    for (kind, service) in [
        (TopicKind::Health, "plc"),
        (TopicKind::Status, "plc"),
        (TopicKind::Health, "io"),
        (TopicKind::Status, "io"),
    ] {
        add(kind.of(service), kind, kind.row().depth, kind.row().max_tail, Vec::new());
    }
    add("io/inputs".into(), TopicKind::Inputs, 4, 4096, vec!["plc".into()]);
    add(EVENTS.into(), TopicKind::Events, 256, 8192, Vec::new());
    let entry = |name: &str, index: u32, config: Value, wiring: Wiring| ServiceEntry {
        name: name.into(),
        kind: name.into(),
        index,
        config,
        wiring,
    };
    Stack {
        name: name.into(),
        file: dir.join("stack.toml"),
        dir: dir.to_owned(),
        text: String::new(),
        build_id: String::new(),
        root: root.to_owned(),
        prefix: prefix.into(),
        services: vec![entry("io", 1, Value::Null, io), entry("plc", 2, config.clone(), plc)],
        topics,
    }
}

/// Field service, client and recorder in one.
struct World {
    inputs: Publisher<Inputs>,
    writes: Publisher<ImageWrite>,
    jobs: Publisher<Job>,
    images: Subscriber<Image>,
    scans: Subscriber<ScanPart>,
    keyframes: Subscriber<ScanPart>,
    results: Subscriber<JobResult>,
    events: Subscriber<Event>,
    joiners: (Joiner, Joiner),
    /// Joined contents with generation.
    recorded: Vec<(u32, Vec<u8>)>,
    gaps: u64,
    seen: Vec<EventBody>,
    answers: Vec<(u64, u32, Value)>,
    image: Image,
    area: Vec<u8>,
    generation: u32,
    level: Option<u16>,
    sent: Instant,
}

impl World {
    fn open(ctx: &mut Context) -> Self {
        Self {
            inputs: ctx.publisher("io/inputs").unwrap(),
            writes: ctx.publisher("plc/writes").unwrap(),
            jobs: ctx.publisher("plc/jobs").unwrap(),
            images: ctx.subscriber("plc/image").unwrap(),
            scans: ctx.subscriber("plc/scan").unwrap(),
            keyframes: ctx.subscriber("plc/keyframe").unwrap(),
            results: ctx.subscriber("plc/results").unwrap(),
            events: ctx.subscriber(EVENTS).unwrap(),
            joiners: (Joiner::new(MAX_RECORD_BYTES), Joiner::new(MAX_KEYFRAME_BYTES)),
            recorded: Vec::new(),
            gaps: 0,
            seen: Vec::new(),
            answers: Vec::new(),
            image: Image::default(),
            area: Vec::new(),
            generation: 0,
            level: None,
            sent: Instant::now(),
        }
    }

    /// One turn: repeats the inputs, takes everything that came.
    fn turn(&mut self) {
        if let Some(level) = self.level
            && self.sent.elapsed() > Duration::from_millis(20)
        {
            self.sent = Instant::now();
            let [a, b] = level.to_le_bytes();
            self.inputs.send_tail(Inputs { ranges: 1, ..Inputs::default() }, &[a, b, 0]).unwrap();
            self.inputs.ring();
        }
        let Self {
            images, scans, keyframes, results, events, joiners, recorded, gaps, seen, answers, ..
        } = self;
        for (port, joiner) in [(keyframes, &mut joiners.1), (scans, &mut joiners.0)] {
            port.drain(100_000, |header, tail| {
                let step = joiner.push(header, tail);
                *gaps += u64::from(step.gap.is_some());
                if let Some(whole) = step.whole {
                    recorded.push((whole.generation, whole.bytes.to_vec()));
                }
            });
        }
        results
            .drain(100, |r, tail| answers.push((r.job_seq, r.code, serde_json::from_slice(tail).unwrap())));
        events.drain(1000, |_, tail| seen.push(serde_json::from_slice(tail).unwrap()));
        let (image, area, generation) = (&mut self.image, &mut self.area, &mut self.generation);
        images.newest(|header, tail| {
            *image = *header;
            *generation = header.stamp.generation;
            area.clear();
            area.extend_from_slice(tail);
        });
        std::thread::sleep(Duration::from_millis(2));
    }

    fn until(&mut self, what: &str, mut check: impl FnMut(&Self) -> bool) {
        let limit = Instant::now() + PATIENCE;
        while !check(self) {
            assert!(
                Instant::now() < limit,
                "waited in vain for: {what}; image {:?}, events {:#?}",
                self.image.state,
                self.seen
            );
            self.turn();
        }
    }

    fn out(&self) -> Option<u16> {
        let (_, q, _) = self.image.areas(&self.area)?;
        Some(u16::from_le_bytes([q[0], q[1]]))
    }

    fn job(&mut self, job: &Value) -> (u32, Value) {
        let header = Job { deadline_t_ns: clock::mono_ns() + 30_000_000_000, ..Job::default() };
        let seq = self.jobs.send_tail(header, &serde_json::to_vec(job).unwrap()).unwrap();
        self.jobs.ring();
        self.until("the answer to a job", |w| w.answers.iter().any(|(s, _, _)| *s == seq));
        let (_, code, body) = self.answers.iter().find(|(s, _, _)| *s == seq).unwrap().clone();
        (code, body)
    }

    fn read(&mut self, var: &str) -> Value {
        self.job(&json!({ "do": "read", "var": var })).1["ok"]["value"].clone()
    }

    fn event(&mut self, kind: EventKind) -> EventBody {
        self.until("an event", |w| w.seen.iter().any(|e| e.event == kind));
        let at = self.seen.iter().position(|e| e.event == kind).unwrap();
        self.seen.remove(at)
    }
}

#[test]
fn a_plc_service_from_its_first_scan_to_its_return_from_death() {
    if std::env::var_os(ROOT).is_some() {
        return;
    }
    let name = format!("plclive{}", std::process::id());
    let (root, prefix) = rail::place(0, &name);
    let dir = std::env::temp_dir().join(&name);
    let mut ground = Ground { root: root.clone(), prefix: prefix.clone(), dir: dir.clone(), child: None };
    std::fs::create_dir_all(&root).unwrap();
    std::fs::create_dir_all(&dir).unwrap();
    std::fs::write(dir.join("main.st"), MAIN).unwrap();
    std::fs::write(dir.join("other.st"), MAIN.replace("Level * 2", "Level * 3")).unwrap();
    std::fs::write(dir.join("broken.st"), "PROGRAM main x := 1; END_PROGRAM").unwrap();
    std::fs::write(root.join(rail::CONFIG_FILE), rail::config_text(&root, &prefix)).unwrap();
    let config = json!({ "program": ["main.st"], "trigger": "inputs", "on_fault": "restart_warm",
                         "start_timeout": "60s", "max_interval": "40ms" });
    let stack = stack(&name, &root, &prefix, &dir, &config);
    std::fs::write(root.join(rail::STACK_FILE), serde_json::to_vec(&stack).unwrap()).unwrap();
    rail::join(&root).unwrap();
    let launcher = rail::node("launcher").unwrap();
    let _held: Vec<_> = stack.topics.iter().map(|t| rail::create_topic(&launcher, t).unwrap()).collect();
    let retain_fd = rustix::fs::memfd_create("retain", rustix::fs::MemfdFlags::empty()).unwrap();
    rustix::fs::ftruncate(&retain_fd, retain::MEMORY_BYTES as u64).unwrap();
    let mut ctx = Context::service(&root, "io", 1, BTreeMap::new()).unwrap();
    let mut world = World::open(&mut ctx);

    // No scan before the inputs are there.
    ground.start(1, &retain_fd);
    world.until("an image", |w| w.generation == 1);
    for _ in 0..100 {
        world.turn();
    }
    assert_eq!((world.image.plc_state(), world.image.scan), (PlcState::Starting, 0));
    world.level = Some(21);
    world.until("the first scans", |w| w.image.plc_state() == PlcState::Run && w.out() == Some(42));
    assert_eq!(world.event(EventKind::PlcStarted).detail["start"], "cold");

    // A write is applied, acknowledged and visible.
    let mut ops = Builder::default();
    ops.push(&Op::Set { area: Area::Marker, offset: 0, bytes: &[100, 0] }).unwrap();
    let header = ImageWrite { ops: ops.ops(), ..ImageWrite::default() };
    let seq = world.writes.send_tail(header, ops.tail()).unwrap();
    world.writes.ring();
    world
        .until("the acknowledgement", |w| acks(&w.image).any(|a| (a.writer, a.seq, a.result) == (1, seq, 0)));
    world.until("the write's effect", |w| w.out() == Some(142));

    // Jobs.
    assert_eq!(world.read("Level"), json!(21));
    assert_eq!(world.job(&json!({ "do": "force", "var": "out", "value": 7 })), (0, json!({ "ok": true })));
    world.until("the force", |w| w.out() == Some(7));
    assert_eq!(world.event(EventKind::Forced).detail["var"], "out");
    assert_eq!(world.job(&json!({ "do": "unforce", "var": "out" })).0, 0);
    world.until("the end of the force", |w| w.out() == Some(142));
    assert_eq!(world.job(&json!({ "do": "dance" })).0, 3);

    // Several variables are written in one scan or not at all; forces too.
    let both = |a: i32, b: i32| json!([{ "var": "a", "value": a }, { "var": "b", "value": b }]);
    for value in 1..=20 {
        let job = json!({ "do": "write", "set": both(value, value) });
        assert_eq!(world.job(&job), (0, json!({ "ok": true })));
    }
    let (code, body) = world.job(&json!({ "do": "write", "set": both(1, 70_000) }));
    assert_eq!(code, 1, "{body}");
    assert_eq!((world.read("a"), world.read("b"), world.read("torn")), (json!(20), json!(20), json!(0)));
    assert_eq!(world.job(&json!({ "do": "force", "set": both(5, 5) })).0, 0);
    assert_eq!(world.job(&json!({ "do": "status" })).1["ok"]["forces"], json!(["a", "b"]));
    assert_eq!((world.read("a"), world.read("b"), world.read("torn")), (json!(5), json!(5), json!(0)));
    assert_eq!(world.job(&json!({ "do": "unforce_all" })).0, 0);
    let (code, body) = world.job(&json!({ "do": "read", "var": "outt" }));
    assert_eq!((code, body["error"].as_str().unwrap()), (1, "no variable 'outt'"));
    assert_eq!(world.job(&json!({ "do": "status" })).1["ok"]["state"], "run");
    assert_eq!(world.job(&json!({ "do": "stop" })).0, 0);
    world.until("the stop", |w| w.image.plc_state() == PlcState::Stop);
    assert_eq!(world.job(&json!({ "do": "run" })).0, 0);
    world.until("going on", |w| w.image.plc_state() == PlcState::Run);

    // The field service falls silent: zero and the quality, until it speaks again.
    world.level = None;
    world.until("bad inputs", |w| w.out() == Some(100) && w.area[10] == 3);
    assert_eq!(world.event(EventKind::InputQuality).service, "io");
    world.level = Some(5);
    world.until("good inputs", |w| w.out() == Some(110) && w.area[10] == 0);

    // Who stops a faulted program keeps it so, whatever the policy.
    world.seen.clear();
    assert_eq!(world.job(&json!({ "do": "write", "var": "sel", "value": 1 })).0, 0);
    world.event(EventKind::ProgramFault);
    assert_eq!(world.job(&json!({ "do": "stop" })).0, 0);
    let stopped_ns = world.image.stamp.t_ns;
    world.until("more than the pause before a start", |w| w.image.stamp.t_ns > stopped_ns + 1_500_000_000);
    assert_eq!(world.image.plc_state(), PlcState::Fault);
    assert_eq!(world.job(&json!({ "do": "run" })).0, 0);
    world.until("the start by hand", |w| w.image.plc_state() == PlcState::Run && w.out() == Some(10));
    world.seen.clear();

    // A fault, named, and the warm start of the policy.
    let kept = world.read("kept").as_u64().unwrap();
    assert_eq!(world.job(&json!({ "do": "write", "var": "sel", "value": 1 })).0, 0);
    let fault = world.event(EventKind::ProgramFault);
    assert_eq!((&fault.detail["file"], &fault.detail["line"]), (&json!("main.st"), &json!(8)));
    world.until("the warm start", |w| {
        w.image.plc_state() == PlcState::Run && w.seen.iter().any(|e| e.detail["start"] == "warm")
    });
    assert!(world.read("kept").as_u64().unwrap() >= kept);
    world.seen.clear();

    // Another program, and one that is none.
    let (code, body) = world.job(&json!({ "do": "load", "path": "broken.st" }));
    assert_eq!(code, 1);
    assert!(body["error"].as_str().unwrap().contains("broken.st:1:"), "{body}");
    let before = world.image.program_hash;
    assert_eq!(world.job(&json!({ "do": "load", "path": "other.st" })).0, 0);
    world.until("the new program", |w| w.image.program_hash != before && w.out() == Some(15));
    assert!(world.read("kept").as_u64().unwrap() > kept, "RETAIN of the same layout is kept");

    // Death and return: the old program again, RETAIN from the held memory.
    let kept = world.read("kept").as_u64().unwrap();
    ground.start(2, &retain_fd);
    world.until("the return", |w| {
        w.generation == 2 && w.image.plc_state() == PlcState::Run && w.out() == Some(10)
    });
    assert!(world.read("kept").as_u64().unwrap() >= kept);
    assert!(world.read("scans").as_u64().unwrap() < kept);
    assert_eq!(world.job(&json!({ "do": "keyframe" })).0, 0);
    for _ in 0..20 {
        world.turn();
    }
    ground.kill();
    world.turn();

    // All of it again, from the records alone.
    let setup = program::setup(&serde_json::from_value(config).unwrap(), &stack, "plc");
    let provider = |hash: u64, _: &dinrail_plc::setup::Setup| {
        ["main.st", "other.st"].iter().find_map(|file| -> Option<std::sync::Arc<Program>> {
            let program = program::load(&dir, &[PathBuf::from(file)], &setup).unwrap().program;
            (program.artifact.hash() == hash).then_some(program)
        })
    };
    assert_eq!(world.gaps, 0);
    let mut verifier = Verifier::new(Box::new(provider)).unwrap();
    for (generation, bytes) in &world.recorded {
        verifier.push(*generation, bytes).unwrap();
    }
    let report = verifier.finish().unwrap();
    assert_eq!(report.exit_code(), 0, "{report:#?}");
    assert!(report.scans > 20 && report.scans == report.scans_verified);
}
