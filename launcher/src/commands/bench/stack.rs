//! A stack of a bench's own: scratch folder, launcher process, readiness, end.

use crate::supervise::client::{Client, find};
use crate::supervise::control::{Reply, Request, ServiceRow};
use anyhow::{Context as _, bail, ensure};
use ipc_types::Context;
use ipc_types::rail;
use rustix::process::{Pid, Signal};
use std::fs::{self, File};
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

/// This very executable, even when the file was replaced since.
pub const OWN_EXECUTABLE: &str = "/proc/self/exe";
/// How long something may take that must happen; generous, because the machine may be busy.
pub const PATIENCE: Duration = Duration::from_secs(30);
/// Time between two looks at a condition that nothing announces.
const LOOK: Duration = Duration::from_millis(5);
const LOG_FILE: &str = "launcher.log";
/// Lines of the log shown when a stack fails.
const LOG_LINES: usize = 30;

/// A TCP port that nobody uses now.
pub fn free_port() -> anyhow::Result<u16> {
    Ok(TcpListener::bind("127.0.0.1:0")?.local_addr()?.port())
}

/// A folder that is removed when dropped.
pub struct Scratch(PathBuf);

impl Scratch {
    /// `name` becomes part of the folder's name.
    pub fn new(parent: &Path, name: &str) -> anyhow::Result<Self> {
        let dir = parent.join(format!("dinrail-{name}"));
        let _ = fs::remove_dir_all(&dir);
        fs::create_dir_all(&dir).with_context(|| format!("making {}", dir.display()))?;
        Ok(Self(dir))
    }

    pub fn path(&self) -> &Path {
        &self.0
    }

    pub fn write(&self, name: &str, text: &str) -> anyhow::Result<PathBuf> {
        let path = self.0.join(name);
        fs::write(&path, text).with_context(|| format!("writing {}", path.display()))?;
        Ok(path)
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.0);
    }
}

/// A running stack under a launcher of its own.
pub struct BenchStack {
    name: String,
    scratch: Scratch,
    launcher: Child,
    root: PathBuf,
    prefix: String,
    ended: bool,
}

/// A name that no other stack has: `bench-WHAT-PID`.
pub fn unique_name(what: &str) -> String {
    format!("bench-{what}-{}", std::process::id())
}

impl BenchStack {
    /// Writes the files, starts the stack and waits until every service is ready. `NAME` in `stack.toml` becomes
    /// a name of its own.
    pub fn up(parent: &Path, what: &str, toml: &str, files: &[(&str, &str)]) -> anyhow::Result<Self> {
        let mut stack = Self::up_unready(parent, what, toml, files)?;
        stack.wait_ready()?;
        Ok(stack)
    }

    /// As [`Self::up`], but waits only until every service runs: for those that get ready by what the bench does.
    pub fn up_unready(parent: &Path, what: &str, toml: &str, files: &[(&str, &str)]) -> anyhow::Result<Self> {
        let name = unique_name(what);
        let scratch = Scratch::new(parent, &name)?;
        scratch.write("stack.toml", &toml.replace("NAME", &name))?;
        for (file, text) in files {
            scratch.write(file, text)?;
        }
        let mut stack = Self::spawn(scratch, &name)?;
        stack.wait("every service running", |stack| {
            let rows = stack.ps().ok()?;
            (!rows.is_empty() && rows.iter().all(|row| row.state == "running" && row.health != "starting"))
                .then_some(())
        })?;
        Ok(stack)
    }

    /// Starts the `stack.toml` of a prepared folder, which must name the stack `name`.
    pub fn spawn(scratch: Scratch, name: &str) -> anyhow::Result<Self> {
        let log = File::create(scratch.path().join(LOG_FILE))?;
        let launcher = Command::new(OWN_EXECUTABLE)
            .arg("up")
            .arg(scratch.path().join("stack.toml"))
            .stdin(Stdio::null())
            .stdout(log.try_clone()?)
            .stderr(log)
            .spawn()
            .context("starting the stack")?;
        let (root, prefix) = rail::place(rustix::process::getuid().as_raw(), name);
        Ok(Self { name: name.to_owned(), scratch, launcher, root, prefix, ended: false })
    }

    pub fn dir(&self) -> &Path {
        self.scratch.path()
    }

    /// This process on the stack's rail. A process belongs to one rail for its whole life.
    pub fn join(&self) -> anyhow::Result<Context> {
        Ok(Context::observer(&self.root)?)
    }

    /// Fails, with the end of its log, when the launcher has ended.
    pub fn check(&mut self) -> anyhow::Result<()> {
        if let Some(status) = self.launcher.try_wait()? {
            self.ended = true;
            bail!("the stack ended early, {status}:\n{}", self.log_end());
        }
        Ok(())
    }

    fn log_end(&self) -> String {
        let text = fs::read_to_string(self.dir().join(LOG_FILE)).unwrap_or_default();
        let lines: Vec<&str> = text.lines().collect();
        lines[lines.len().saturating_sub(LOG_LINES)..].join("\n")
    }

    /// Looks until a condition gives a value; fails when it never does or the stack ends.
    pub fn wait<T>(&mut self, what: &str, mut look: impl FnMut(&Self) -> Option<T>) -> anyhow::Result<T> {
        let began = Instant::now();
        loop {
            if let Some(value) = look(self) {
                return Ok(value);
            }
            self.check()?;
            ensure!(
                began.elapsed() < PATIENCE,
                "waited {} s in vain for: {what}\n{}",
                PATIENCE.as_secs(),
                self.log_end()
            );
            std::thread::sleep(LOOK);
        }
    }

    /// Waits until every service says that it is ready.
    pub fn wait_ready(&mut self) -> anyhow::Result<()> {
        self.wait("every service ready", |stack| {
            let rows = stack.ps().ok()?;
            (!rows.is_empty() && rows.iter().all(is_ready)).then_some(())
        })
    }

    /// One row a service.
    pub fn ps(&self) -> anyhow::Result<Vec<ServiceRow>> {
        let mut client = Client::connect(find(Some(&self.name))?)?;
        match client.call(&Request::Ps {}, PATIENCE)? {
            Reply::Ps(rows) => Ok(rows),
            other => bail!("the launcher answered {other:?} to ps"),
        }
    }

    /// Name and pid of every process, the launcher first.
    pub fn processes(&self) -> anyhow::Result<Vec<(String, u32)>> {
        let mut all = vec![("launcher".to_owned(), self.launcher.id())];
        all.extend(self.ps()?.into_iter().filter(|row| row.pid != 0).map(|row| (row.service, row.pid)));
        Ok(all)
    }

    /// Takes the stack down by SIGTERM and makes sure that nothing of it is left in shared memory. Gives back
    /// its folder.
    pub fn down(mut self) -> anyhow::Result<(Scratch, ExitStatus)> {
        let status = self.end(PATIENCE)?;
        let left = self.leftovers();
        ensure!(left.is_empty(), "left in /dev/shm after the end: {}", left.join(", "));
        let empty = Scratch(PathBuf::new());
        Ok((std::mem::replace(&mut self.scratch, empty), status))
    }

    fn end(&mut self, limit: Duration) -> anyhow::Result<ExitStatus> {
        self.check()?;
        rustix::process::kill_process(Pid::from_child(&self.launcher), Signal::TERM)?;
        let began = Instant::now();
        loop {
            if let Some(status) = self.launcher.try_wait()? {
                self.ended = true;
                return Ok(status);
            }
            ensure!(began.elapsed() < limit, "the launcher does not end:\n{}", self.log_end());
            std::thread::sleep(LOOK);
        }
    }

    /// Names of the stack's objects in shared memory.
    pub fn leftovers(&self) -> Vec<String> {
        let own = self.prefix.trim_end_matches('_');
        let entries = fs::read_dir("/dev/shm").into_iter().flatten().flatten();
        let names = entries.map(|e| e.file_name().to_string_lossy().into_owned());
        names.filter(|name| name.starts_with(own)).collect()
    }
}

impl Drop for BenchStack {
    fn drop(&mut self) {
        if !self.ended {
            // The bench failed: what the stack said may tell why.
            eprintln!("the stack's log ends with:\n{}", self.log_end());
            let _ = self.end(Duration::from_secs(10));
        }
        if !self.ended {
            let _ = self.launcher.kill();
            let _ = self.launcher.wait();
        }
    }
}

/// Whether a service works.
pub fn is_ready(row: &ServiceRow) -> bool {
    row.state == "running" && row.health == "ready"
}

/// Kills a process that belongs to the bench's own stack.
pub fn sigkill(pid: u32) -> anyhow::Result<()> {
    let pid = i32::try_from(pid).ok().and_then(Pid::from_raw).context("no process to kill")?;
    Ok(rustix::process::kill_process(pid, Signal::KILL)?)
}
