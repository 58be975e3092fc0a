//! Recorder and replay on a real rail in one process: four buses, a plc that answers keyframe requests, traffic,
//! SIGTERM, then the recording replayed in a driver's place.
//!
//! `DINRAIL_RAIL_SECONDS` lengthens the traffic (default 2 s); the processor time of the recorder's threads is
//! printed, not asserted.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a test that fails")]

mod common;

use common::{TempDir, wait_for};
use dinrail_recorder::reader::Recording;
use dinrail_recorder::{config, info, replay, scan_contents, service as recorder};
use ipc_types::payload::{CanFrame, Job, ScanPart};
use ipc_types::reactor::signals;
use ipc_types::testing::{TestRail, service, topic};
use ipc_types::topic::{EVENTS, TopicKind};
use ipc_types::{Context, Wiring, clock};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread;
use std::time::{Duration, Instant};

const BUSES: usize = 4;
const FRAMES_PER_S: u64 = 8000;

fn make_rail(dir: &Path) -> TestRail {
    std::fs::write(dir.join("main.st"), "PROGRAM main END_PROGRAM").unwrap();
    let (mut services, mut topics) = (Vec::new(), Vec::new());
    for bus in 0..BUSES {
        let name = format!("can{bus}");
        topics.extend([topic(TopicKind::CanRx, &name), topic(TopicKind::CanTx, &name)]);
        services.push(service(&name, "can", serde_json::json!({}), Wiring::default()));
    }
    let files = vec![("main.st".into(), "program[0]".into())];
    services.push(service("plc", "plc", serde_json::json!({}), Wiring { files, ..Wiring::default() }));
    let table = serde_json::json!({ "dir": "recordings", "keep": "1GiB" });
    services.push(service("rec", "recorder", table, Wiring::default()));
    topics.extend([TopicKind::Scan, TopicKind::Keyframe, TopicKind::Jobs].map(|kind| topic(kind, "plc")));
    TestRail::in_folder(dir, "recordertest", services, topics)
}

fn context(root: &Path, name: &str, generation: u32) -> Context {
    Context::service(root, name, generation, BTreeMap::new()).unwrap()
}

/// Processor time of a thread of this process by its name, in ms.
fn thread_ms(name: &str) -> u64 {
    let mut total = 0;
    for task in std::fs::read_dir("/proc/self/task").unwrap().flatten() {
        let comm = std::fs::read_to_string(task.path().join("comm")).unwrap_or_default();
        if comm.trim() == name {
            let stat = std::fs::read_to_string(task.path().join("stat")).unwrap_or_default();
            let fields: Vec<_> = stat.rsplit(')').next().unwrap_or_default().split_whitespace().collect();
            total += fields[11].parse::<u64>().unwrap() + fields[12].parse::<u64>().unwrap();
        }
    }
    total * 10
}

/// Sends frames of all buses at their rate and a scan record every 10 ms; how many of each bus.
fn traffic(root: PathBuf, seconds: u64) -> u64 {
    let mut ctx = context(&root, "can0", 1);
    let mut buses: Vec<_> =
        (0..BUSES).map(|b| ctx.publisher::<CanFrame>(&format!("can{b}/rx")).unwrap()).collect();
    let mut scans = ctx.publisher::<ScanPart>("plc/scan").unwrap();
    let start = Instant::now();
    let (mut sent, mut scanned) = (0u64, 0u64);
    while start.elapsed() < Duration::from_secs(seconds) {
        // After a pause of this thread it catches up slowly: a burst above a queue's depth would be lost rightly.
        let due = (start.elapsed().as_millis() as u64 * FRAMES_PER_S / 1000).min(sent + 64);
        while sent < due {
            sent += 1;
            for (b, bus) in buses.iter_mut().enumerate() {
                let value = (sent as f64 * 0.01).sin() * 1000.0;
                let data = [
                    (sent >> 3) as u8,
                    b as u8,
                    value as i16 as u8,
                    (value as i16 >> 8) as u8,
                    0,
                    0,
                    0,
                    sent as u8,
                ];
                bus.send(CanFrame::classic(0x100 + (sent % 40) as u32, &data)).unwrap();
            }
        }
        if scanned < start.elapsed().as_millis() as u64 / 10 {
            scanned += 1;
            let part = ScanPart { scan: scanned, part: 0, parts: 1, total: 96, ..ScanPart::default() };
            scans.send_tail(part, &[scanned as u8; 96]).unwrap();
        }
        thread::sleep(Duration::from_millis(1));
    }
    sent
}

/// Answers requests for a keyframe.
fn plc(root: PathBuf, end: Arc<AtomicBool>, keyframes: Arc<AtomicU64>) {
    let mut ctx = context(&root, "plc", 1);
    let mut jobs = ctx.subscriber::<Job>("plc/jobs").unwrap();
    let mut port = ctx.publisher::<ScanPart>("plc/keyframe").unwrap();
    while !end.load(Ordering::Relaxed) {
        let mut asked = false;
        jobs.drain(16, |job, tail| {
            assert!(job.deadline_t_ns > clock::mono_ns() - 1_000_000_000);
            let job: serde_json::Value = serde_json::from_slice(tail).unwrap();
            asked |= job["do"] == "keyframe";
        });
        if asked {
            keyframes.fetch_add(1, Ordering::Relaxed);
            port.send_tail(ScanPart { parts: 1, total: 4, ..ScanPart::default() }, b"keys").unwrap();
        }
        thread::sleep(Duration::from_millis(2));
    }
}

fn record(root: &Path, seconds: u64) -> u64 {
    let end = Arc::new(AtomicBool::new(false));
    let keyframes = Arc::new(AtomicU64::new(0));
    let engine = {
        let (root, end, keyframes) = (root.to_owned(), end.clone(), keyframes.clone());
        thread::spawn(move || plc(root, end, keyframes))
    };
    let of = root.to_owned();
    let rec = thread::Builder::new().name("rec-main".into());
    let rec = rec.spawn(move || recorder::run(context(&of, "rec", 1))).unwrap();
    wait_for("the first keyframe", || keyframes.load(Ordering::Relaxed) > 0);
    let of = root.to_owned();
    let sent = thread::spawn(move || traffic(of, seconds)).join().unwrap();
    let wall = seconds * 1000;
    for name in ["rec-main", "rec-writer", "rec-sync"] {
        let ms = thread_ms(name);
        println!("{name}: {ms} ms of processor in {wall} ms = {:.1} %", ms as f64 * 100.0 / wall as f64);
    }
    terminate();
    let began = Instant::now();
    rec.join().unwrap().unwrap();
    println!("finished {} ms after SIGTERM", began.elapsed().as_millis());
    end.store(true, Ordering::Relaxed);
    engine.join().unwrap();
    sent
}

#[allow(unsafe_code)]
fn terminate() {
    // SAFETY: signals this very process; every thread blocks the signal, descriptors read it.
    unsafe { libc::kill(libc::getpid(), libc::SIGTERM) };
}

fn check_recording(file: &Path, sent: u64) {
    let found = info(file).unwrap();
    println!("{found}");
    assert!(found.finished);
    for bus in 0..BUSES {
        let topic = format!("can{bus}/rx");
        let channel = found.channels.iter().find(|c| c.topic == topic).unwrap();
        assert_eq!((channel.messages, channel.gaps, channel.missed), (sent, Some(0), 0), "{topic}");
    }
    let gaps = found.gaps.as_ref().unwrap();
    assert!(gaps.last && gaps.missed == 0, "{}", gaps.text);
    assert!(found.channels.iter().any(|c| c.topic == "rec/status" && c.messages > 0));
    let parts: Vec<_> = scan_contents(file, "plc").unwrap().map(Result::unwrap).collect();
    assert!(parts.iter().any(|p| p.keyframe && p.tail == b"keys"));
    assert!(parts.iter().filter(|p| !p.keyframe).count() as u64 > 10);
    // Between topics the file is in order of the stamps.
    let times: Vec<_> = Recording::open(file)
        .unwrap()
        .messages()
        .map(Result::unwrap)
        .filter(|m| m.topic != "recorder/gaps")
        .map(|m| m.stamp.t_ns)
        .collect();
    let falling = times.windows(2).filter(|w| w[1] < w[0]).count();
    println!("{falling} of {} messages stand before an older one", times.len());
    // Only a sender that was interrupted between stamp and sending can cause one.
    assert!(falling * 100 <= times.len(), "time order");
}

fn replayed(rail: &mut TestRail, file: &Path, sent: u64) {
    let stack = &mut rail.stack;
    let me = stack.services.iter_mut().find(|s| s.name == "can0").unwrap();
    me.kind = "replay".into();
    me.config = serde_json::json!({ "file": file, "source": "can1/rx", "speed": 1.0 });
    let me = me.clone();
    let stack_now = stack.clone();
    let table: replay::Config = serde_json::from_value(me.config.clone()).unwrap();
    assert_eq!(replay::check(&table, &stack_now, &me), vec![]);
    let wrong = replay::Config { source: Some("can9/rx".into()), ..table.clone() };
    let findings = replay::check(&wrong, &stack_now, &me);
    assert!(findings[0].help.contains("can0/rx, can1/rx"), "{findings:?}");
    rail.rewrite();
    let root = rail.root();
    let observer = Context::observer(root).unwrap();
    let mut rx = observer.subscriber::<CanFrame>("can0/rx").unwrap();
    let mut events = observer.subscriber::<ipc_types::payload::Event>(EVENTS).unwrap();
    let of = root.to_owned();
    let player = thread::spawn(move || replay::run(context(&of, "can0", 2)));
    let expected: Vec<_> = Recording::open(file)
        .unwrap()
        .messages()
        .map(Result::unwrap)
        .filter(|m| m.topic == "can1/rx")
        .collect();
    assert_eq!(expected.len() as u64, sent);
    let (mut got, mut ended) = (Vec::new(), false);
    wait_for("the end of the replay", || {
        rx.drain(4096, |frame, _| got.push(*frame));
        events.drain(64, |_, tail| ended |= String::from_utf8_lossy(tail).contains("replay of"));
        ended && got.len() >= expected.len()
    });
    assert_eq!(rx.counters().lost, 0);
    assert_eq!(got.len(), expected.len());
    let (t0, r0) = (got[0].stamp.t_ns, expected[0].stamp.t_ns);
    for (frame, was) in got.iter().zip(&expected) {
        let was_frame: CanFrame = ipc_types::payload::from_bytes(&was.header).unwrap();
        assert_eq!((frame.can_id, frame.data), (was_frame.can_id, was_frame.data));
        let (spaced, recorded) = (frame.stamp.t_ns - t0, was.stamp.t_ns - r0);
        assert!(spaced.abs_diff(recorded) <= 1, "{spaced} {recorded}");
    }
    terminate();
    player.join().unwrap().unwrap();
}

fn main() {
    // Before any thread: they all inherit the blocked signal.
    let signal = signals::descriptor(&[libc::SIGTERM, libc::SIGINT]).unwrap();
    let dir = TempDir::new("rail");
    let mut rail = make_rail(dir.path());
    let me = rail.stack.service("rec").unwrap().clone();
    let table: config::Config = serde_json::from_value(me.config.clone()).unwrap();
    assert_eq!(config::check(&table, &rail.stack, &me), vec![]);

    let seconds = std::env::var("DINRAIL_RAIL_SECONDS").ok().and_then(|s| s.parse().ok()).unwrap_or(2);
    let sent = record(rail.root(), seconds);
    let files = recorder::files(&table, &rail.stack);
    assert_eq!(files.len(), 1);
    check_recording(&files[0].path, sent);
    assert_eq!(signals::take(&signal), Some(libc::SIGTERM));
    replayed(&mut rail, &files[0].path, sent);
    println!("rail: ok");
}
