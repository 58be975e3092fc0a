//! What may not grow: the recorder's memory and descriptors from file to file, the launcher's and the neighbours' while
//! a service is killed and started again.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod support;

use rustix::process::Signal;
use std::collections::BTreeMap;
use std::fs;
use std::process::{Child, Stdio};
use support::{PATIENCE, Stack, dinrail, wait_for};

/// Recordings of the smallest size, so that they rotate often; a PLC, so that they do at a keyframe.
const STACK: &str = r#"
[stack]
name = "NAME"

[[service]]
name = "rec"
kind = "recorder"
dir = "recordings"
max_size = "1MiB"
keep = "4MiB"

[[service]]
name = "can0"
kind = "can"
backend = "virtual"

[[service]]
name = "plc"
kind = "plc"
cycle = "10ms"
restart = { max = 1000, within = "10s", backoff_first = "1ms", backoff_max = "1ms" }
"#;

/// Recordings when the baseline is taken: the recorder has asked the PLC for keyframes, which connects it. Every buffer
/// of a file was made, given back and made again.
const WARM: usize = 4;
/// Recordings at the end.
const END: usize = 14;
/// What a process may own more than at the baseline. A file needs about 5 MiB; a descriptor, a buffer or an index that
/// stays behind with each of ten files is found.
const GROWTH: u64 = 1 << 20;
const KILLS: usize = 20;

/// What a process holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Held {
    /// Anonymous memory in bytes: not the rail's, not the executable's.
    own: u64,
    descriptors: usize,
    threads: usize,
}

fn held(pid: i32) -> Held {
    let status = fs::read_to_string(format!("/proc/{pid}/status")).unwrap();
    let line = status.lines().find(|line| line.starts_with("RssAnon:")).unwrap();
    let kib: u64 = line.split_whitespace().nth(1).unwrap().parse().unwrap();
    let entries = |what: &str| fs::read_dir(format!("/proc/{pid}/{what}")).unwrap().count();
    Held { own: kib * 1024, descriptors: entries("fd"), threads: entries("task") }
}

/// Number of the newest recording.
fn files(stack: &Stack) -> usize {
    let number = |path: &std::path::PathBuf| -> Option<usize> {
        path.file_stem()?.to_str()?.rsplit_once('-')?.1.parse().ok()
    };
    stack.recordings().iter().filter_map(number).max().unwrap_or(0)
}

/// Random frames, 25 000 a second as long as the machine keeps up.
struct Frames(Child);

impl Frames {
    /// Sends until the recorder has begun this recording.
    fn until(stack: &Stack, wanted: usize) {
        let mut generator = dinrail();
        generator.args(["can", "gen", "can0", "--gap", "40us", "--in-order", "--stack", &stack.name]);
        let mut frames = Self(generator.stdout(Stdio::null()).spawn().unwrap());
        for n in files(stack)..wanted {
            stack.wait(&format!("recording {}", n + 1), || {
                assert!(frames.0.try_wait().unwrap().is_none(), "the generator ended");
                (files(stack) > n).then_some(())
            });
        }
    }
}

impl Drop for Frames {
    fn drop(&mut self) {
        // Not SIGKILL: a tool gives its place on the rail back.
        let _ = rustix::process::kill_process(rustix::process::Pid::from_child(&self.0), Signal::INT);
        let _ = self.0.wait();
    }
}

/// Waits until a process holds no more than at the baseline; a finished file is open until it is on the disk.
fn holds_no_more(stack: &Stack, name: &str, pid: i32, before: Held) {
    let mut now = before;
    let check = || {
        now = held(pid);
        let same = now.descriptors <= before.descriptors && now.threads <= before.threads;
        (same && now.own < before.own + GROWTH).then_some(())
    };
    let limit = PATIENCE / 2;
    let back = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| wait_for(name, limit, check)));
    assert!(back.is_ok(), "{name} held {before:?} and now {now:?}\n{}", stack.log());
}

#[test]
fn the_recorder_holds_after_many_files_what_it_held_after_a_few() {
    let stack = Stack::up("soakrec", STACK, &[]);
    let pid = stack.pid("rec");
    Frames::until(&stack, WARM);
    // Descriptors of the files before are closed when those are on the disk.
    let mut last = held(pid);
    let before = stack.wait("the files to be on the disk", || {
        let now = held(pid);
        let still = now.descriptors == last.descriptors;
        last = now;
        std::thread::sleep(std::time::Duration::from_millis(500));
        still.then_some(now)
    });
    Frames::until(&stack, END);
    holds_no_more(&stack, "rec", pid, before);
    assert_eq!(stack.pid("rec"), pid, "the recorder was restarted");
    eprintln!("rec: {before:?}, {} files later {:?}", END - WARM, held(pid));
}

#[test]
fn kills_leave_nothing_with_the_launcher_and_the_neighbours() {
    let stack = Stack::up("soakkill", STACK, &[]);
    let launcher = stack.launcher.id() as i32;
    // Neighbours connect to a new process when they next have something for it, so the first kills are no baseline.
    let kill = |times: usize| {
        for _ in 0..times {
            let generation = stack.generation("plc");
            stack.kill("plc", Signal::KILL);
            stack.wait_generation_above("plc", generation);
        }
    };
    kill(3);
    let pids: BTreeMap<&str, i32> =
        [("launcher", launcher), ("rec", stack.pid("rec")), ("can0", stack.pid("can0"))].into();
    let before: BTreeMap<&str, Held> = pids.iter().map(|(name, pid)| (*name, held(*pid))).collect();
    let objects = stack.leftovers().len();
    kill(KILLS);
    for (name, pid) in &pids {
        let mut allowed = before[name];
        // Connections to a process that is gone are closed with the next message.
        allowed.descriptors += 6;
        holds_no_more(&stack, name, *pid, allowed);
        eprintln!("{name}: {:?}, {KILLS} kills later {:?}", before[name], held(*pid));
    }
    let now = stack.leftovers().len();
    assert!(now <= objects + 16, "{objects} objects in shared memory, {now} after {KILLS} kills");
}
