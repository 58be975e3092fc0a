//! One process of the stack, seen from the launcher: spawned from the launcher's own executable, watched through
//! a pidfd, its output read from a pipe.
//!
//! Everything here is called from the launcher's main thread: PDEATHSIG follows the *thread* that spawned.

use super::policy::Kill;
use crate::stackfile::LaunchOptions;
use rustix::fs::OFlags;
use rustix::io::FdFlags;
use rustix::process::{Pid, PidfdFlags, Signal, WaitId, WaitIdOptions};
use std::fmt;
use std::fs::File;
use std::io;
use std::os::fd::{AsFd, AsRawFd, BorrowedFd, OwnedFd};
use std::os::unix::fs::MetadataExt;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// Room for output of a child while the launcher is busy.
const PIPE_BYTES: usize = 256 * 1024;
/// Most bytes read of a child that has ended: what its pipe held. A process that it left may go on writing.
const REST_BYTES: usize = 2 * PIPE_BYTES;

/// The launcher's executable, held since its start: an upgrade on disk never mixes versions.
#[derive(Debug)]
pub struct Executable {
    file: File,
    identity: String,
}

impl Executable {
    /// Opens the executable of this very process.
    pub fn own() -> io::Result<Self> {
        let file = File::open("/proc/self/exe")?;
        let found = file.metadata()?;
        let identity = (found.dev(), found.ino(), found.size(), found.mtime(), found.mtime_nsec());
        let hash = xxhash_rust::xxh3::xxh3_64(format!("{identity:?}").as_bytes());
        Ok(Self { file, identity: format!("{}-{hash:016x}", env!("CARGO_PKG_VERSION")) })
    }

    /// Version, and which file this is: a child that runs another one refuses. Cheap enough for every start,
    /// unlike the hash of the content that `Stack::build_id` is.
    pub fn identity(&self) -> &str {
        &self.identity
    }

    fn command(&self) -> Command {
        let mut command = Command::new(format!("/proc/self/fd/{}", self.file.as_raw_fd()));
        command
            .arg0("dinrail")
            .process_group(0)
            .stdin(Stdio::null())
            .env_remove("NOTIFY_SOCKET")
            .env_remove("WATCHDOG_USEC")
            .env_remove("WATCHDOG_PID");
        command
    }

    /// Starts a service with its inherited descriptors.
    pub fn spawn_service(
        &self,
        root: &Path,
        name: &str,
        generation: u32,
        options: &LaunchOptions,
        fds: &[(String, BorrowedFd<'_>)],
    ) -> io::Result<Child> {
        let mut command = self.command();
        command.arg("__service");
        command.arg("--root").arg(root).args(["--name", name, "--build-id", &self.identity]);
        command.arg("--generation").arg(generation.to_string());
        command.arg("--parent").arg(std::process::id().to_string());
        command.args(["--log-level", &options.log_level]);
        if let Some(nice) = options.nice {
            command.arg(format!("--nice={nice}"));
        }
        if let Some(priority) = options.fifo_priority {
            command.arg(format!("--fifo={priority}"));
        }
        if !options.cpus.is_empty() {
            let list: Vec<String> = options.cpus.iter().map(u32::to_string).collect();
            command.arg(format!("--cpus={}", list.join(",")));
        }
        if let Some(limit) = options.memory_limit {
            command.arg(format!("--memory={}", limit.0));
        }
        for (name, fd) in fds {
            command.arg(format!("--fd={name}={}", fd.as_raw_fd()));
        }
        command.envs(&options.env);
        // Inheritable only while this thread spawns: no other thread of the launcher ever does.
        let inherited: Vec<BorrowedFd<'_>> = fds.iter().map(|(_, fd)| *fd).collect();
        set_inheritable(&inherited, true)?;
        let child = Child::spawn(command);
        set_inheritable(&inherited, false)?;
        child
    }

    /// Starts the helper that cleans up after dead processes.
    pub fn spawn_cleaner(&self, root: &Path) -> io::Result<Child> {
        let mut command = self.command();
        command.arg("__clean").arg("--root").arg(root);
        command.arg("--parent").arg(std::process::id().to_string());
        Child::spawn(command)
    }
}

fn set_inheritable(fds: &[BorrowedFd<'_>], inheritable: bool) -> io::Result<()> {
    for fd in fds {
        let flags = if inheritable { FdFlags::empty() } else { FdFlags::CLOEXEC };
        rustix::io::fcntl_setfd(fd, flags)?;
    }
    Ok(())
}

/// What a reading of a child's output left behind.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Left {
    /// There may be more.
    More,
    /// Nothing for now.
    Nothing,
    /// Nothing any more.
    End,
}

/// A child process.
#[derive(Debug)]
pub struct Child {
    pub pid: u32,
    pidfd: OwnedFd,
    output: OwnedFd,
}

impl Child {
    fn spawn(mut command: Command) -> io::Result<Self> {
        let (output, theirs) = rustix::pipe::pipe_with(rustix::pipe::PipeFlags::CLOEXEC)?;
        let _ = rustix::pipe::fcntl_setpipe_size(&output, PIPE_BYTES);
        rustix::fs::fcntl_setfl(&output, OFlags::NONBLOCK)?;
        let mut child =
            command.stdout(Stdio::from(theirs.try_clone()?)).stderr(Stdio::from(theirs)).spawn()?;
        let pid = child.id();
        // Not reaped yet, so the number still means this process.
        let watched = Pid::from_raw(pid as i32)
            .ok_or_else(|| io::Error::other("pid 0"))
            .and_then(|raw| Ok(rustix::process::pidfd_open(raw, PidfdFlags::empty())?));
        match watched {
            Ok(pidfd) => Ok(Self { pid, pidfd, output }),
            Err(e) => {
                // Nobody could watch it: a second one would soon run beside it.
                let _ = child.kill();
                let _ = child.wait();
                Err(e)
            }
        }
    }

    /// Ends a process that cannot be watched, for good.
    pub fn end(self) {
        self.signal(Kill::Now);
        let _ = rustix::process::waitid(WaitId::PidFd(self.pidfd.as_fd()), WaitIdOptions::EXITED);
    }

    /// Readable when the process has ended.
    pub fn pidfd(&self) -> BorrowedFd<'_> {
        self.pidfd.as_fd()
    }

    /// What it prints.
    pub fn output(&self) -> BorrowedFd<'_> {
        self.output.as_fd()
    }

    pub fn signal(&self, signal: Kill) {
        let signal = match signal {
            Kill::Term => Signal::TERM,
            Kill::Abort => Signal::ABORT,
            Kill::Now => Signal::KILL,
        };
        let _ = rustix::process::pidfd_send_signal(&self.pidfd, signal);
    }

    /// How it ended, once it has.
    pub fn reap(&self) -> io::Result<Option<Exit>> {
        let options = WaitIdOptions::EXITED | WaitIdOptions::NOHANG;
        let Some(status) = rustix::process::waitid(WaitId::PidFd(self.pidfd.as_fd()), options)? else {
            return Ok(None);
        };
        Ok(Some(match (status.exit_status(), status.terminating_signal()) {
            (Some(code), _) => Exit::Code(code),
            (None, Some(number)) => Exit::Signal { number, core: status.dumped() },
            (None, None) => Exit::Code(-1),
        }))
    }

    /// Reads what it printed, without waiting.
    pub fn read(&self, buffer: &mut [u8], mut take: impl FnMut(&[u8])) -> Left {
        // Bounded a turn, so that a chatty service cannot keep the launcher from its neighbours.
        for _ in 0..8 {
            match rustix::io::read(&self.output, &mut *buffer) {
                Ok(0) => return Left::End,
                Ok(n) => take(&buffer[..n]),
                Err(rustix::io::Errno::INTR) => {}
                Err(rustix::io::Errno::AGAIN) => return Left::Nothing,
                Err(_) => return Left::End,
            }
        }
        Left::More
    }

    /// Reads all that it printed before its end: its last lines say why.
    pub fn read_rest(&self, buffer: &mut [u8], mut take: impl FnMut(&[u8])) {
        let mut taken = 0;
        while taken < REST_BYTES {
            let left = self.read(buffer, |bytes| {
                taken += bytes.len();
                take(bytes);
            });
            if left != Left::More {
                return;
            }
        }
    }
}

/// How a process ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Exit {
    Code(i32),
    Signal { number: i32, core: bool },
}

impl Exit {
    /// `SIGTERM`.
    pub fn signal_word(self) -> String {
        match self {
            Self::Signal { number, .. } => signal_name(number),
            Self::Code(code) => format!("exit code {code}"),
        }
    }

    /// For the event's detail.
    pub fn json(self) -> serde_json::Value {
        match self {
            Self::Code(code) => serde_json::json!({ "exit_code": code }),
            Self::Signal { number, core } => {
                serde_json::json!({ "signal": signal_name(number), "signal_number": number, "core": core })
            }
        }
    }
}

impl fmt::Display for Exit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::Code(code) => write!(f, "exit code {code}"),
            Self::Signal { number, core } => {
                write!(f, "killed by {}{}", signal_name(number), if core { ", core dumped" } else { "" })
            }
        }
    }
}

fn signal_name(number: i32) -> String {
    let name = match number {
        libc::SIGHUP => "SIGHUP",
        libc::SIGINT => "SIGINT",
        libc::SIGQUIT => "SIGQUIT",
        libc::SIGILL => "SIGILL",
        libc::SIGTRAP => "SIGTRAP",
        libc::SIGABRT => "SIGABRT",
        libc::SIGBUS => "SIGBUS",
        libc::SIGFPE => "SIGFPE",
        libc::SIGKILL => "SIGKILL",
        libc::SIGUSR1 => "SIGUSR1",
        libc::SIGSEGV => "SIGSEGV",
        libc::SIGUSR2 => "SIGUSR2",
        libc::SIGPIPE => "SIGPIPE",
        libc::SIGALRM => "SIGALRM",
        libc::SIGTERM => "SIGTERM",
        libc::SIGXCPU => "SIGXCPU",
        libc::SIGSYS => "SIGSYS",
        _ => return format!("signal {number}"),
    };
    name.to_owned()
}

/// What `/proc` says about a process.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Usage {
    /// User and system time in [`TICKS_PER_S`].
    pub cpu_ticks: u64,
    pub rss_bytes: u64,
}

/// Unit of CPU times in `/proc`: USER_HZ is 100 on every Linux that dinrail runs on.
pub const TICKS_PER_S: u64 = 100;

/// CPU time and resident memory of a process, `None` when it is gone.
pub fn usage(pid: u32) -> Option<Usage> {
    let folder = PathBuf::from(format!("/proc/{pid}"));
    let stat = std::fs::read_to_string(folder.join("stat")).ok()?;
    let status = std::fs::read_to_string(folder.join("status")).ok()?;
    parse_usage(&stat, &status)
}

fn parse_usage(stat: &str, status: &str) -> Option<Usage> {
    // The name in parentheses may hold anything; state is the first field after it, utime the 12th.
    let mut fields = stat.rsplit_once(')')?.1.split_whitespace().skip(11);
    let cpu_ticks = fields.next()?.parse::<u64>().ok()? + fields.next()?.parse::<u64>().ok()?;
    let rss = status.lines().find_map(|line| line.strip_prefix("VmRSS:"))?;
    let kib: u64 = rss.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(Usage { cpu_ticks, rss_bytes: kib * 1024 })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn wait(child: &Child) -> Exit {
        let mut fds = [rustix::event::PollFd::new(&child.pidfd, rustix::event::PollFlags::IN)];
        let limit = rustix::event::Timespec { tv_sec: 30, tv_nsec: 0 };
        rustix::event::poll(&mut fds, Some(&limit)).unwrap();
        child.reap().unwrap().expect("has ended")
    }

    fn sh(script: &str) -> Child {
        let mut command = Command::new("/bin/sh");
        command.args(["-c", script]);
        Child::spawn(command).unwrap()
    }

    #[test]
    fn exit_codes_and_signals_are_told_apart_and_output_is_read() {
        let child = sh("echo out; echo err >&2; exit 3");
        assert_eq!(wait(&child), Exit::Code(3));
        let mut text = Vec::new();
        // A process that another test just starts may hold the pipe until it executes its program.
        while child.read(&mut [0; 64], |bytes| text.extend_from_slice(bytes)) != Left::End {
            std::thread::sleep(std::time::Duration::from_millis(1));
        }
        assert_eq!(text, b"out\nerr\n");
        assert_eq!(wait(&sh("kill -9 $$")), Exit::Signal { number: 9, core: false });
        let child = sh("read line; sleep 60");
        assert_eq!(child.reap().unwrap(), None);
        child.signal(Kill::Now);
        assert_eq!(wait(&child).to_string(), "killed by SIGKILL");
    }

    #[test]
    fn the_last_words_of_one_that_printed_much_are_read() {
        let child = sh(
            "i=0; while [ $i -lt 2000 ]; do echo $i'0123456789012345678901234567890123456789012345678901234567890123456789'; i=$((i+1)); done; echo last; exit 1",
        );
        assert_eq!(wait(&child), Exit::Code(1));
        let mut text = Vec::new();
        child.read_rest(&mut [0; 8192], |bytes| text.extend_from_slice(bytes));
        assert!(text.len() > 8 * 8192 && text.ends_with(b"\nlast\n"), "{} bytes", text.len());
    }

    #[test]
    fn one_that_cannot_be_watched_is_gone_at_once() {
        let child = sh("trap '' TERM; sleep 60");
        let proc = PathBuf::from(format!("/proc/{}", child.pid));
        assert!(proc.exists());
        child.end();
        assert!(!proc.exists(), "neither running nor a zombie");
    }

    #[test]
    fn usage_is_read_past_strange_names() {
        let stat =
            "7 (a) b) S 1 7 7 0 -1 4194304 80 0 0 0 12 30 0 0 20 0 1 0 55 1000 200 18446744073709551615";
        let usage = parse_usage(stat, "Name:\ta) b\nVmHWM:\t  300 kB\nVmRSS:\t  250 kB\n").unwrap();
        assert_eq!(usage, Usage { cpu_ticks: 42, rss_bytes: 256_000 });
        assert!(super::usage(std::process::id()).unwrap().rss_bytes > 0);
        assert_eq!(parse_usage("", ""), None);
    }
}
