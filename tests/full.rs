//! What is full: /dev/shm before and while a stack runs, and the disk of the recorder. Runs in a mount namespace of
//! its own with small file systems, so that the machine's are untouched.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod support;

use serde_json::Value;
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};
use std::thread::sleep;
use std::time::{Duration, Instant};
use support::modbus::{Answer, Client};
use support::{Scratch, free_port, skip, wait_for};

/// A launcher in a mount namespace of its own.
struct Boxed {
    child: Child,
    scratch: Scratch,
    name: String,
}

impl Boxed {
    /// `mounts` are shell commands that run before the launcher, in the scratch folder.
    fn up(name: &str, mounts: &str, toml: &str) -> Option<Self> {
        if !namespaces_work() {
            skip("no mount namespaces here: run as root, or allow unprivileged user namespaces");
            return None;
        }
        let scratch = Scratch::new(name);
        let name = format!("{name}-{}", std::process::id());
        scratch.write("conveyor.log", include_str!("../recordings/conveyor.log"));
        scratch.write("stack.toml", toml.replace("NAME", &name));
        std::fs::create_dir_all(scratch.0.join("recordings")).unwrap();
        let log = std::fs::File::create(scratch.0.join("launcher.log")).unwrap();
        let child = unshare()
            .args(["sh", "-c", &format!("{mounts} && exec {} up stack.toml", env!("CARGO_BIN_EXE_dinrail"))])
            .current_dir(&scratch.0)
            .stdin(Stdio::null())
            .stdout(log.try_clone().unwrap())
            .stderr(log)
            .spawn()
            .unwrap();
        Some(Self { child, scratch, name })
    }

    fn log(&self) -> String {
        std::fs::read_to_string(self.scratch.0.join("launcher.log")).unwrap()
    }

    /// A shell command where the launcher sees the world.
    fn inside(&self, command: &str) -> Output {
        Command::new("nsenter")
            .args(["-t", &self.child.id().to_string(), "-m", "--", "sh", "-c", command])
            .current_dir(&self.scratch.0)
            .output()
            .unwrap()
    }

    fn ps(&self) -> Vec<Value> {
        let output =
            self.inside(&format!("{} ps --json --stack {}", env!("CARGO_BIN_EXE_dinrail"), self.name));
        serde_json::from_slice::<Value>(&output.stdout)
            .ok()
            .and_then(|v| v.as_array().cloned())
            .unwrap_or_default()
    }

    fn row(&self, service: &str) -> Option<Value> {
        self.ps().into_iter().find(|r| r["service"] == service)
    }

    fn wait<T>(&self, what: &str, mut check: impl FnMut() -> Option<T>) -> T {
        wait_for(&format!("{what}\n{}", self.log()), Duration::from_secs(40), || {
            sleep(Duration::from_millis(30));
            check()
        })
    }

    fn wait_ready(&self) {
        self.wait("all ready", || {
            let rows = self.ps();
            (!rows.is_empty() && rows.iter().all(|r| r["health"] == "ready" && r["state"] == "running"))
                .then_some(())
        });
    }

    fn end(mut self) -> i32 {
        let pid = rustix::process::Pid::from_child(&self.child);
        rustix::process::kill_process(pid, rustix::process::Signal::TERM).unwrap();
        wait_for("the launcher ends", Duration::from_secs(20), || self.child.try_wait().unwrap())
            .code()
            .unwrap_or(-1)
    }
}

impl Drop for Boxed {
    fn drop(&mut self) {
        // Gently first: a launcher that is killed leaves its shared memory to the next `up`.
        let pid = rustix::process::Pid::from_child(&self.child);
        if matches!(self.child.try_wait(), Ok(None)) {
            let _ = rustix::process::kill_process(pid, rustix::process::Signal::TERM);
            sleep(Duration::from_secs(3));
        }
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn unshare() -> Command {
    let mut command = Command::new("unshare");
    command.arg(if rustix::process::getuid().is_root() { "-m" } else { "-Urm" });
    command
}

fn namespaces_work() -> bool {
    unshare().args(["mount", "-t", "tmpfs", "tmpfs", "/mnt"]).output().is_ok_and(|o| o.status.success())
}

fn text(port: u16, recorder: &str) -> String {
    format!(
        r#"
[stack]
name = "NAME"
{recorder}
[[service]]
name = "can0"
kind = "can"
backend = "virtual"
feed = {{ file = "conveyor.log", loop = true }}

[[service]]
name = "io"
kind = "can-io"
bus = "can0"
restart = {{ max = 1000, within = "10s", backoff_max = "200ms" }}
[[service.in]]
id = 0x1A0
start = 24
len = 8
to = "%IW0"
type = "UINT"

[[service]]
name = "plc"
kind = "plc"
cycle = "10ms"
[[service.route]]
from = "%IW0"
to = "%MW1"
type = "UINT"

[[service]]
name = "modbus"
kind = "modbus-server"
tcp = {{ address = "127.0.0.1", port = {port} }}
"#
    )
}

const RECORDER: &str = "
[[service]]
name = \"rec\"
kind = \"recorder\"
dir = \"recordings\"
min_free = \"0\"
";

fn register(port: u16) -> Option<u16> {
    match Client::connect(port).ok()?.holding(1, 1).ok()? {
        Answer::Registers(values) => Some(values[0]),
        _ => None,
    }
}

#[test]
fn a_stack_that_needs_more_than_half_of_dev_shm_is_refused() {
    let mounts = "mount -t tmpfs -o size=8m tmpfs /dev/shm";
    let Some(mut boxed) = Boxed::up("shmsmall", mounts, &text(free_port(), "")) else { return };
    let code =
        wait_for("the launcher ends", Duration::from_secs(20), || boxed.child.try_wait().unwrap()).code();
    assert_eq!(code, Some(1));
    let said = boxed.log();
    for part in ["shared memory", "/dev/shm", "MiB"] {
        assert!(said.contains(part), "'{part}' is missing in: {said}");
    }
}

#[test]
fn dev_shm_that_fills_up_stops_no_neighbour_and_the_stack_is_whole_when_there_is_room_again() {
    let port = free_port();
    let mounts = "mount -t tmpfs -o size=512m tmpfs /dev/shm";
    let Some(boxed) = Boxed::up("shmfull", mounts, &text(port, "")) else { return };
    boxed.wait_ready();
    boxed.wait("a frame in a register", || register(port).filter(|v| *v > 5));
    let objects = boxed.inside("find /dev/shm -name 'dr*_*' -type f -printf '%s %b %f\\n'").stdout;
    let objects = String::from_utf8_lossy(&objects);
    assert!(objects.lines().count() > 50, "{objects}");
    for object in objects.lines() {
        let mut parts = object.split(' ').map_while(|part| part.parse::<u64>().ok());
        let (size, blocks) = (parts.next().unwrap(), parts.next().unwrap());
        assert!(blocks * 512 >= size, "pages are missing: {object}");
    }
    // Not a byte is left, but each process has what it will ever use, touched or not.
    boxed.inside("head -c 600M /dev/zero > /dev/shm/fill");
    boxed.inside(&format!("kill -9 {}", boxed.row("io").unwrap()["pid"]));
    boxed.wait("io cannot start and says why", || boxed.log().contains("/dev/shm full").then_some(()));
    // The others go on, while the queue of the dead reader, which nobody empties, holds more and more messages.
    let end = Instant::now() + Duration::from_secs(10);
    while Instant::now() < end {
        assert!(register(port).is_some(), "modbus and plc go on\n{}", boxed.log());
        sleep(Duration::from_millis(50));
    }
    for service in ["can0", "plc", "modbus"] {
        assert_eq!(boxed.row(service).unwrap()["generation"], 1, "{service}\n{}", boxed.log());
    }
    boxed.inside("rm /dev/shm/fill");
    boxed.wait_ready();
    let before = boxed.wait("a register", || register(port));
    boxed.wait("frames reach the register again", || register(port).filter(|v| *v != before));
    assert_eq!(boxed.end(), 0);
}

#[test]
fn a_full_disk_stops_the_recording_with_path_and_remedy_and_nothing_else() {
    let port = free_port();
    let mounts = "mount -t tmpfs -o size=1m tmpfs recordings";
    let Some(boxed) = Boxed::up("disk", mounts, &text(port, RECORDER)) else { return };
    boxed.wait_ready();
    let fill = boxed.scratch.0.join("recordings/fill");
    boxed.inside(&format!("head -c 4M /dev/zero > {}", fill.display()));
    boxed.wait("the recorder says so", || {
        let log = boxed.log().to_lowercase();
        (log.contains("no space left") && log.contains("recordings")).then_some(())
    });
    let before = boxed.wait("a register", || register(port));
    boxed.wait("frames reach the register", || register(port).filter(|v| *v != before));
    for row in boxed.ps() {
        assert_eq!(row["generation"], 1, "{row}\n{}", boxed.log());
    }
    boxed.inside(&format!("rm {}", fill.display()));
    let files = || {
        let list = boxed.inside(&format!("ls {}", fill.with_file_name("").display()));
        String::from_utf8_lossy(&list.stdout)
            .lines()
            .filter(|l| Path::new(l).extension().is_some_and(|e| e == "mcap"))
            .count()
    };
    boxed.wait("a new file is begun", || (files() >= 2).then_some(()));
    // Data was lost, and that is said.
    assert_eq!(boxed.end(), 3);
}
