//! Talking to a running stack: which one is meant, and the other end of its control socket.

use super::control::{Reply, Request};
use super::state_dir::{self, RunningStack, SOCKET};
use ipc_types::Context;
use ipc_types::rail::RailError;
use std::io::{self, BufRead, BufReader, Write};
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

/// Longest line of an answer.
const REPLY_BYTES_MAX: u64 = 16 * 1024 * 1024;

/// Why a running stack could not be asked.
#[derive(Debug, thiserror::Error)]
pub enum ClientError {
    #[error("no stack is running; `dinrail up STACK.toml` or `dinrail demo` starts one")]
    NoneRunning,
    #[error("no stack '{0}' is running, nor any other; `dinrail up STACK.toml` or `dinrail demo` starts one")]
    NotThisNorAny(String),
    #[error("no stack '{asked}' is running; running: {running}")]
    NotRunning { asked: String, running: String },
    #[error("several stacks are running: {0}; say which one with --stack NAME")]
    Several(String),
    #[error("stack '{stack}': its launcher, pid {pid}, does not answer: {source}")]
    Io { stack: String, pid: u32, source: io::Error },
    #[error("stack '{stack}': {message}")]
    Refused { stack: String, message: String },
}

/// The stack of this name, or the only one that runs.
pub fn find(name: Option<&str>) -> Result<RunningStack, ClientError> {
    choose(state_dir::running(), name)
}

fn choose(mut running: Vec<RunningStack>, name: Option<&str>) -> Result<RunningStack, ClientError> {
    let names = |list: &[RunningStack]| list.iter().map(|s| s.stack.as_str()).collect::<Vec<_>>().join(", ");
    if running.is_empty() {
        return Err(name.map_or(ClientError::NoneRunning, |n| ClientError::NotThisNorAny(n.to_owned())));
    }
    match name {
        Some(name) => match running.iter().position(|s| s.stack == name) {
            Some(i) => Ok(running.swap_remove(i)),
            None => Err(ClientError::NotRunning { asked: name.to_owned(), running: names(&running) }),
        },
        None if running.len() == 1 => Ok(running.swap_remove(0)),
        None => Err(ClientError::Several(names(&running))),
    }
}

/// How long a clean-up of what dead tools left may take.
const CLEAN_LIMIT: Duration = Duration::from_secs(2);

/// Joins the rail of a running stack as a tool. Once a process.
pub fn observe(stack: &RunningStack) -> Result<Context, RailError> {
    with_room(&stack.root, || Context::observer(&stack.root))
}

/// Takes a place on the rail. Tools that were killed keep theirs until somebody cleans up after them: when there is none
/// left, that is done, and it is tried again.
pub fn with_room<T>(root: &Path, mut take: impl FnMut() -> Result<T, RailError>) -> Result<T, RailError> {
    match take() {
        Err(e) if is_full(&e) => clean_up(root),
        result => return result,
    }
    take()
}

/// Whether a topic has no place left for one more tool.
pub fn is_full(error: &RailError) -> bool {
    error.to_string().contains("ExceedsMaxSupported")
}

/// In a process of its own, because it can hang.
fn clean_up(root: &Path) {
    let Ok(own) = std::env::current_exe() else { return };
    let mut command = Command::new(own);
    command.arg("__clean").arg("--root").arg(root).arg("--parent").arg(std::process::id().to_string());
    let spawned = command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null()).spawn();
    let Ok(mut child) = spawned else { return };
    let begin = Instant::now();
    while begin.elapsed() < CLEAN_LIMIT {
        if !matches!(child.try_wait(), Ok(None)) {
            return;
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    let _ = child.kill();
    let _ = child.wait();
}

/// A connection to a launcher.
pub struct Client {
    pub stack: RunningStack,
    stream: BufReader<UnixStream>,
}

impl Client {
    pub fn connect(stack: RunningStack) -> Result<Self, ClientError> {
        match UnixStream::connect(stack.root.join(SOCKET)) {
            Ok(stream) => Ok(Self { stack, stream: BufReader::new(stream) }),
            Err(source) => Err(ClientError::Io { stack: stack.stack, pid: stack.pid, source }),
        }
    }

    /// Sends a request.
    pub fn ask(&mut self, request: &Request) -> Result<(), ClientError> {
        let mut text = serde_json::to_vec(request).map_err(|e| self.failed(io::Error::other(e)))?;
        text.push(b'\n');
        self.stream.get_mut().write_all(&text).map_err(|e| self.failed(e))
    }

    /// The next answer; `None` when the launcher closed the connection. `limit` `None` waits for ever.
    pub fn next(&mut self, limit: Option<Duration>) -> Result<Option<Reply>, ClientError> {
        self.stream.get_ref().set_read_timeout(limit).map_err(|e| self.failed(e))?;
        let mut line = Vec::new();
        let read = io::Read::take(&mut self.stream, REPLY_BYTES_MAX).read_until(b'\n', &mut line);
        match read {
            Ok(0) => Ok(None),
            Err(e) if e.kind() == io::ErrorKind::ConnectionReset => Ok(None),
            Err(e) => Err(self.failed(e)),
            Ok(_) => match serde_json::from_slice(&line) {
                Ok(Reply::Error(message)) => {
                    Err(ClientError::Refused { stack: self.stack.stack.clone(), message })
                }
                Ok(reply) => Ok(Some(reply)),
                Err(e) => Err(self.failed(io::Error::other(e))),
            },
        }
    }

    /// Request and one answer.
    pub fn call(&mut self, request: &Request, limit: Duration) -> Result<Reply, ClientError> {
        self.ask(request)?;
        let closed = || io::Error::from(io::ErrorKind::UnexpectedEof);
        self.next(Some(limit))?.ok_or_else(|| self.failed(closed()))
    }

    fn failed(&self, source: io::Error) -> ClientError {
        ClientError::Io { stack: self.stack.stack.clone(), pid: self.stack.pid, source }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_only_one_is_meant_and_several_are_listed() {
        let stack = |name: &str| RunningStack {
            stack: name.into(),
            pid: 1,
            root: "/".into(),
            since_utc_ns: 0,
            file: "x".into(),
        };
        assert_eq!(choose(vec![stack("a")], None).unwrap().stack, "a");
        assert_eq!(choose(vec![stack("a"), stack("b")], Some("b")).unwrap().stack, "b");
        for (running, name, message) in [
            (vec![], None, "no stack is running; `dinrail up STACK.toml` or `dinrail demo` starts one"),
            (
                vec![],
                Some("x"),
                "no stack 'x' is running, nor any other; `dinrail up STACK.toml` or `dinrail demo` starts one",
            ),
            (
                vec![stack("a"), stack("b")],
                None,
                "several stacks are running: a, b; say which one with --stack NAME",
            ),
            (vec![stack("a")], Some("x"), "no stack 'x' is running; running: a"),
        ] {
            assert_eq!(choose(running, name).unwrap_err().to_string(), message);
        }
    }
}
