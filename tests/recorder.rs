//! kill -9 of the recorder under load, again and again: little is lost, every file can be read by a foreign
//! reader and is made whole afterwards.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod support;

use rustix::process::Signal;
use serde_json::Value;
use std::path::Path;
use std::thread::sleep;
use std::time::{Duration, SystemTime, UNIX_EPOCH};
use support::socketcand::Load;
use support::{Scratch, Stack, dinrail, free_port, peers};

const KILLS: usize = 50;
/// More bytes than a recording of these stacks has before its first frame: with a keyframe some 30 KiB.
const BEGINNING: u64 = 96 << 10;

fn text(can_port: u16) -> String {
    format!(
        r#"
[stack]
name = "NAME"

[[service]]
name = "rec"
kind = "recorder"
dir = "recordings"
restart = {{ max = 1000, within = "10s", backoff_first = "1ms", backoff_max = "1ms" }}

[[service]]
name = "can0"
kind = "can"
backend = "virtual"
serve = {{ socketcand = "127.0.0.1:{can_port}" }}

[[service]]
name = "plc"
kind = "plc"
cycle = "10ms"
"#
    )
}

fn info(recording: &Path) -> Value {
    let output = dinrail().args(["recordings", "info", "--json"]).arg(recording).output().unwrap();
    serde_json::from_slice(&output.stdout).unwrap_or_else(|e| {
        panic!("{}: {e}: {}", recording.display(), String::from_utf8_lossy(&output.stderr))
    })
}

/// First and last stamp of the frames of a recording.
fn span(recording: &Path) -> Option<(i64, i64)> {
    let info = info(recording);
    let frames = info["channels"].as_array()?.iter().find(|c| c["topic"] == "can0/rx")?.clone();
    (frames["messages"].as_u64()? > 0).then_some(())?;
    Some((frames["first_ns"].as_i64()?, frames["last_ns"].as_i64()?))
}

/// Waits until so many files are there and the last of them holds more than its beginning: frames.
fn recorded(stack: &Stack, files: usize) {
    stack.wait(&format!("frames in file {files}"), || {
        let all = stack.recordings();
        let size = all.last().and_then(|file| file.metadata().ok()).map_or(0, |m| m.len());
        (all.len() == files && size > BEGINNING).then_some(())
    });
}

#[test]
fn fifty_kills_under_20_000_frames_a_second_lose_little_and_every_file_is_made_whole() {
    let can_port = free_port();
    let scratch = Scratch::new("reckill");
    let mut stack = Stack::spawn_in("reckill", &text(can_port), scratch, &[]);
    stack.wait_ready();
    let load = Load::start(can_port, 20_000);
    let mut random = 88_172_645_463_325_252_u64;
    let mut killed_ns = Vec::new();
    for kill in 0..KILLS {
        recorded(&stack, kill + 1);
        random ^= random << 13;
        random ^= random >> 7;
        random ^= random << 17;
        sleep(Duration::from_millis(random % 400));
        let generation = stack.generation("rec");
        stack.kill("rec", Signal::KILL);
        killed_ns.push(SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_nanos() as i64);
        stack.wait_generation_above("rec", generation);
    }
    recorded(&stack, KILLS + 1);
    load.end();
    stack.wait("the last cut file is made whole", || {
        let files = stack.recordings();
        let open = files.iter().filter(|f| info(f)["finished"] == false).count();
        (open <= 1).then_some(())
    });
    assert_eq!(stack.take_down(), 0, "{}", stack.log());

    let recordings = stack.recordings();
    assert_eq!(recordings.len(), KILLS + 1);
    for recording in &recordings {
        assert_eq!(info(recording)["finished"], true, "{}", recording.display());
    }
    let spans: Vec<_> = recordings.iter().map(|r| span(r).expect("frames in every file")).collect();
    let sorted = |mut ms: Vec<f64>| {
        ms.sort_by(f64::total_cmp);
        (ms[ms.len() / 2], ms)
    };
    let (gap, gaps) = sorted(spans.windows(2).map(|pair| (pair[1].0 - pair[0].1) as f64 / 1e6).collect());
    let (lost, all_lost) = sorted(
        spans.iter().zip(&killed_ns).map(|((_, last), killed)| (killed - last) as f64 / 1e6).collect(),
    );
    println!("in ms: median gap {gap:.1}, largest {:.1}; median loss {lost:.1}", gaps[gaps.len() - 1]);
    // On a quiet machine 80 and 30. What is limited here is what no slow machine explains: a buffer that is not flushed.
    assert!(lost <= 500.0, "frames of the last {lost} ms before a kill are lost: {all_lost:?}");
    assert!(gap <= 1000.0, "median gap {gap} ms: {gaps:?}");

    let Some(mut python) = peers::peer("readable.py") else { return };
    // python's reader does some 20,000 messages a second: a sample of the files.
    let sample: Vec<_> = recordings.iter().step_by(10).collect();
    let output = python.args(&sample).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    assert_eq!(String::from_utf8_lossy(&output.stdout).lines().count(), sample.len());
}

#[test]
fn an_unfinished_file_is_read_by_a_foreign_reader_before_it_is_made_whole() {
    let can_port = free_port();
    let scratch = Scratch::new("cut");
    // No restart: the file stays as the killed recorder left it.
    let toml = text(can_port).replace("max = 1000", "max = 0");
    let mut stack = Stack::spawn_in("cut", &toml, scratch, &[]);
    stack.wait_ready();
    let load = Load::start(can_port, 5_000);
    stack.wait("4000 messages", || {
        let recording = stack.recordings().pop()?;
        (info(&recording)["messages"].as_u64()? >= 4000).then_some(())
    });
    stack.kill("rec", Signal::KILL);
    load.end();
    stack.wait("the recorder is held", || (stack.service("rec")?["state"] == "held").then_some(()));
    let recording = stack.recordings().remove(0);
    assert_eq!(info(&recording)["finished"], false);
    let Some(mut python) = peers::peer("readable.py") else { return };
    let output = python.arg(&recording).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let count: u64 = String::from_utf8_lossy(&output.stdout).split(' ').next().unwrap().parse().unwrap();
    assert_eq!(Some(count), info(&recording)["messages"].as_u64(), "python reads what we read");
    assert!(count > 3000, "{count}");
    let recovered = dinrail().args(["recordings", "recover"]).arg(&recording).output().unwrap();
    assert!(matches!(recovered.status.code(), Some(0 | 3)), "{}", String::from_utf8_lossy(&recovered.stderr));
    assert_eq!(info(&recording)["finished"], true);
    assert_eq!(Some(count), info(&recording)["messages"].as_u64());
    assert_eq!(stack.take_down(), 1, "a held service is no healthy end");
}

#[test]
fn a_recording_truncated_at_any_byte_opens() {
    let can_port = free_port();
    let scratch = Scratch::new("trunc");
    let mut stack = Stack::spawn_in("trunc", &text(can_port), scratch, &[]);
    stack.wait_ready();
    let load = Load::start(can_port, 2_000);
    sleep(Duration::from_millis(800));
    load.end();
    assert_eq!(stack.take_down(), 0);
    let whole = std::fs::read(stack.recordings().remove(0)).unwrap();
    let step = (whole.len() / 40).max(1);
    for cut in (0..whole.len()).step_by(step) {
        let path = stack.scratch.write("cut.mcap", &whole[..cut]);
        let output = dinrail().args(["recordings", "info"]).arg(&path).output().unwrap();
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(!said.contains("panicked"), "cut at {cut}: {said}");
        assert_eq!(output.status.code(), Some(0), "cut at {cut}: {said}");
    }
}
