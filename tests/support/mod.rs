//! What the cross-process tests share: a stack of one's own, foreign programs, waiting for conditions.
#![allow(dead_code, clippy::unwrap_used, clippy::expect_used, clippy::panic)]

pub mod c_peer;
pub mod canopen;
pub mod car;
pub mod commands;
pub mod modbus;
pub mod pcap;
pub mod peers;
pub mod python;
pub mod rtu_line;
pub mod socketcand;
pub mod uml;

pub use python::skip;
use serde_json::Value;
use std::fs;
use std::io::Read;
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};
use std::thread::sleep;
use std::time::{Duration, Instant};

/// How long a test waits for something that must happen: generous, because the machine is shared.
pub const PATIENCE: Duration = Duration::from_secs(30);

/// Waits until `check` gives a value; panics with `what` when it never does.
pub fn wait_for<T>(what: &str, limit: Duration, mut check: impl FnMut() -> Option<T>) -> T {
    let start = Instant::now();
    loop {
        if let Some(value) = check() {
            return value;
        }
        assert!(start.elapsed() < limit, "waited {limit:?} in vain for: {what}");
        sleep(Duration::from_millis(10));
    }
}

/// A TCP port that nobody uses now, and that neither another call nor the kernel gives to anybody else: each port of this
/// process once, below those that the kernel takes for outgoing connections.
pub fn free_port() -> u16 {
    const FIRST: u32 = 10_000;
    static GIVEN: AtomicU32 = AtomicU32::new(0);
    let range = fs::read_to_string("/proc/sys/net/ipv4/ip_local_port_range").unwrap_or_default();
    let kernels = range.split_whitespace().next().and_then(|n| n.parse().ok()).unwrap_or(32_768);
    let places = if kernels > FIRST + 1000 { kernels - FIRST } else { 50_000 };
    // Test programs that run at the same time begin at other places.
    let begin = std::process::id().wrapping_mul(7919);
    wait_for("a free port", PATIENCE, || {
        let place = begin.wrapping_add(GIVEN.fetch_add(1, Ordering::Relaxed)) % places;
        let port = u16::try_from(FIRST + place).unwrap();
        TcpListener::bind(("127.0.0.1", port)).is_ok().then_some(port)
    })
}

/// The public cases that are no part of the project, or `None` after saying loudly that the test is skipped.
pub fn cases() -> Option<PathBuf> {
    let beside = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/cases");
    let dir = std::env::var_os("DINRAIL_CASES").map_or(beside, PathBuf::from);
    if dir.is_dir() {
        return Some(dir);
    }
    skip(&format!("no cases at {}; set DINRAIL_CASES", dir.display()));
    None
}

/// The executable under test.
pub fn dinrail() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_dinrail"));
    command.stdin(Stdio::null());
    command
}

static NEXT: AtomicU32 = AtomicU32::new(0);

/// A folder of its own for a test, removed when dropped.
pub struct Scratch(pub PathBuf);

impl Scratch {
    pub fn new(name: &str) -> Self {
        let dir = std::env::temp_dir().join(format!(
            "dinrail-{name}-{}-{}",
            std::process::id(),
            NEXT.fetch_add(1, Ordering::Relaxed)
        ));
        let _ = fs::remove_dir_all(&dir);
        fs::create_dir_all(&dir).unwrap();
        Self(dir)
    }
    pub fn write(&self, name: &str, text: impl AsRef<[u8]>) -> PathBuf {
        let path = self.0.join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(&path, text).unwrap();
        path
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        if std::env::var_os("DINRAIL_KEEP").is_none() {
            let _ = fs::remove_dir_all(&self.0);
        }
    }
}

/// A running stack under a launcher of its own. Dropped: taken down, and checked that nothing is left.
pub struct Stack {
    pub name: String,
    pub scratch: Scratch,
    pub launcher: Child,
    root: PathBuf,
    prefix: String,
    down: bool,
}

impl Stack {
    /// Starts a stack; `NAME` in the text becomes a name of its own. Waits until every service is ready.
    pub fn up(name: &str, toml: &str, files: &[(&str, &str)]) -> Self {
        let stack = Self::spawn(name, toml, files);
        stack.wait_ready();
        stack
    }

    /// Starts a stack and does not wait.
    pub fn spawn(name: &str, toml: &str, files: &[(&str, &str)]) -> Self {
        let scratch = Scratch::new(name);
        for (file, text) in files {
            scratch.write(file, text);
        }
        Self::spawn_in(name, toml, scratch, &[])
    }

    /// Starts a stack in a folder that is already prepared, with more arguments.
    pub fn spawn_in(name: &str, toml: &str, scratch: Scratch, args: &[&str]) -> Self {
        let unique = format!("{name}-{}-{}", std::process::id(), NEXT.fetch_add(1, Ordering::Relaxed));
        let file = scratch.write("stack.toml", toml.replace("NAME", &unique));
        let log = fs::File::create(scratch.0.join("launcher.log")).unwrap();
        let launcher = dinrail()
            .arg("up")
            .arg(&file)
            .args(args)
            .env("DINRAIL_INJECT", "1")
            .stdout(log.try_clone().unwrap())
            .stderr(log)
            .spawn()
            .unwrap();
        let (root, prefix) = ipc_types::rail::place(rustix::process::getuid().as_raw(), &unique);
        Self { name: unique, scratch, launcher, root, prefix, down: false }
    }

    pub fn root(&self) -> &Path {
        &self.root
    }

    /// Everything the launcher and the services printed.
    pub fn log(&self) -> String {
        fs::read_to_string(self.scratch.0.join("launcher.log")).unwrap_or_default()
    }

    /// Runs a command on this stack.
    pub fn cli(&self, args: &[&str]) -> Output {
        dinrail().args(args).args(["--stack", &self.name]).output().unwrap()
    }

    /// Runs a command that must succeed and gives what it printed.
    pub fn ok(&self, args: &[&str]) -> String {
        let output = self.cli(args);
        assert!(
            output.status.success(),
            "dinrail {args:?}: {:?}\n{}\n--- launcher:\n{}",
            output.status,
            String::from_utf8_lossy(&output.stderr),
            self.log()
        );
        String::from_utf8(output.stdout).unwrap()
    }

    /// `dinrail ps --json`, the row of each service.
    pub fn ps(&self) -> Vec<Value> {
        let output = self.cli(&["ps", "--json"]);
        let value: Value = serde_json::from_slice(&output.stdout).unwrap_or(Value::Null);
        value.as_array().cloned().unwrap_or_default()
    }

    pub fn service(&self, name: &str) -> Option<Value> {
        self.ps().into_iter().find(|row| row["service"] == name)
    }

    pub fn pid(&self, name: &str) -> i32 {
        self.wait(&format!("a pid of {name}"), || self.service(name)?["pid"].as_i64()) as i32
    }

    pub fn generation(&self, name: &str) -> u64 {
        self.service(name).and_then(|row| row["generation"].as_u64()).unwrap_or(0)
    }

    pub fn is_ready(&self, name: &str) -> bool {
        self.service(name).is_some_and(|row| row["health"] == "ready" && row["state"] == "running")
    }

    pub fn wait_ready(&self) {
        self.wait("all services ready", || {
            let rows = self.ps();
            (!rows.is_empty() && rows.iter().all(|row| row["health"] == "ready" && row["state"] == "running"))
                .then_some(())
        });
    }

    /// Waits until a service works again in a later generation.
    pub fn wait_generation_above(&self, name: &str, generation: u64) {
        self.wait(&format!("{name} back at work after generation {generation}"), || {
            let row = self.service(name)?;
            (row["generation"].as_u64()? > generation
                && row["health"] == "ready"
                && row["state"] == "running")
                .then_some(())
        });
    }

    /// Waits for a condition; the launcher's log is shown when it never comes.
    pub fn wait<T>(&self, what: &str, mut check: impl FnMut() -> Option<T>) -> T {
        let start = Instant::now();
        loop {
            if let Some(value) = check() {
                return value;
            }
            assert!(
                start.elapsed() < PATIENCE,
                "{}: waited {PATIENCE:?} in vain for: {what}\n--- launcher:\n{}",
                self.name,
                self.log()
            );
            sleep(Duration::from_millis(20));
        }
    }

    /// Sends a signal to a service.
    pub fn kill(&self, name: &str, signal: rustix::process::Signal) {
        let pid = rustix::process::Pid::from_raw(self.pid(name)).unwrap();
        rustix::process::kill_process(pid, signal).unwrap();
    }

    /// Value of a variable of the running program.
    pub fn read(&self, variable: &str) -> Value {
        let text = self.ok(&["plc", "read", variable, "--json"]);
        let value: Value = serde_json::from_str(&text).unwrap();
        value["value"].clone()
    }

    /// Takes the stack down and gives the launcher's exit code.
    pub fn take_down(&mut self) -> i32 {
        let output = self.cli(&["down"]);
        assert!(output.status.success(), "down: {}", String::from_utf8_lossy(&output.stderr));
        self.wait_end()
    }

    /// Waits until the launcher has ended and gives its exit code.
    pub fn wait_end(&mut self) -> i32 {
        let start = Instant::now();
        loop {
            if let Some(status) = self.launcher.try_wait().unwrap() {
                self.down = true;
                return status.code().unwrap_or(-1);
            }
            assert!(start.elapsed() < PATIENCE, "the launcher does not end\n{}", self.log());
            sleep(Duration::from_millis(10));
        }
    }

    /// Objects of this stack in shared memory.
    pub fn leftovers(&self) -> Vec<String> {
        let own = self.prefix.trim_end_matches('_');
        fs::read_dir("/dev/shm")
            .unwrap()
            .flatten()
            .map(|e| e.file_name().to_string_lossy().into_owned())
            .filter(|name| name.starts_with(own))
            .collect()
    }

    /// Recordings, oldest first.
    pub fn recordings(&self) -> Vec<PathBuf> {
        recordings_in(&self.scratch.0.join("recordings"))
    }
}

/// Events of all recordings of a stack.
pub fn recorded_events(stack: &Stack) -> Vec<Value> {
    let mut all = Vec::new();
    for recording in stack.recordings() {
        let output = dinrail()
            .args(["recordings", "cat", "--topic", "stack/events", "--json"])
            .arg(&recording)
            .output()
            .unwrap();
        for line in String::from_utf8_lossy(&output.stdout).lines() {
            let value: Value = serde_json::from_str(line).unwrap();
            all.push(value.get("body").cloned().unwrap_or(value));
        }
    }
    all
}

pub fn recordings_in(dir: &Path) -> Vec<PathBuf> {
    let mut files: Vec<_> =
        fs::read_dir(dir).map(|entries| entries.flatten().map(|e| e.path()).collect()).unwrap_or_default();
    files.retain(|f| f.extension().is_some_and(|e| e == "mcap"));
    files.sort();
    files
}

impl Drop for Stack {
    fn drop(&mut self) {
        if self.down {
            if !std::thread::panicking() {
                assert_eq!(self.leftovers(), Vec::<String>::new(), "left in /dev/shm after down");
            }
            return;
        }
        let pid = rustix::process::Pid::from_child(&self.launcher);
        let _ = rustix::process::kill_process(pid, rustix::process::Signal::TERM);
        let start = Instant::now();
        while start.elapsed() < Duration::from_secs(10) {
            if matches!(self.launcher.try_wait(), Ok(Some(_))) {
                return;
            }
            sleep(Duration::from_millis(10));
        }
        let _ = self.launcher.kill();
        let _ = self.launcher.wait();
    }
}

/// Output of a child that must end by itself.
pub fn read_all(mut from: impl Read) -> String {
    let mut text = String::new();
    let _ = from.read_to_string(&mut text);
    text
}
