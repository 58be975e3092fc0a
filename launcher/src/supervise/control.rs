//! The control socket of a running stack: `<root>/control.sock`, one JSON object a line in both directions.
//!
//! Never blocks and never grows without bound: a client that does not read is dropped.

use super::logbook::Line;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, Read, Write};
use std::os::fd::{AsFd, BorrowedFd};
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::Path;

/// Clients at once.
pub const CLIENTS_MAX: usize = 16;
/// Longest request line.
pub const REQUEST_BYTES_MAX: usize = 64 * 1024;
/// Answers that may wait for a client.
pub const OUTPUT_BYTES_MAX: usize = 16 * 1024 * 1024;

/// What a client asks.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "do", rename_all = "snake_case", deny_unknown_fields)]
pub enum Request {
    /// One row a service.
    Ps {},
    /// The stack as a whole.
    Status {},
    /// The last lines of one service or of all, and with `follow` those that come.
    Logs {
        #[serde(default)]
        service: Option<String>,
        lines: u32,
        #[serde(default)]
        follow: bool,
    },
    /// Ends one process and starts it again; answered when the new one is ready.
    Restart { service: String },
    /// Stops the stack; the connection is closed when everything is gone.
    Down {},
}

/// A service in `ps`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ServiceRow {
    pub service: String,
    pub kind: String,
    /// `starting`, `running`, `hung`, `restarting`, `back-off`, `held`, `stopping`, `ended`.
    pub state: String,
    /// What the service says of itself: `starting`, `ready`, `degraded`, `stopping`.
    pub health: String,
    /// 0 while there is no process.
    pub pid: u32,
    pub generation: u32,
    pub restarts: u32,
    pub uptime_ms: u64,
    /// Of one CPU, over the last second.
    pub cpu_percent: f64,
    pub rss_bytes: u64,
    /// Unplanned deaths since it was last healthy, that is, ready for a minute.
    #[serde(default)]
    pub deaths: u32,
    /// It dies again and again, too seldom to be held for it.
    #[serde(default)]
    pub unstable: bool,
}

/// The stack as a whole.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StackStatus {
    pub stack: String,
    pub pid: u32,
    pub build_id: String,
    /// `starting`, `running`, `degraded`, `stopping`, `failed`.
    pub state: String,
    pub uptime_ms: u64,
    pub services: u32,
    pub ready: u32,
    pub held: Vec<String>,
    /// Services that die again and again, too seldom to be held for it.
    #[serde(default)]
    pub unstable: Vec<String>,
    /// Services at work that say of themselves that something is not as it should be.
    #[serde(default)]
    pub degraded: Vec<String>,
    pub failed: Option<String>,
}

/// A line of a service's log.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct LogLine {
    pub utc_ns: i64,
    pub service: String,
    pub line: String,
}

/// An answer.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Reply {
    Ps(Vec<ServiceRow>),
    Status(StackStatus),
    Log(LogLine),
    Restarted {
        service: String,
        generation: u32,
        after_ms: u64,
    },
    Stopping {
        pid: u32,
    },
    /// Nothing more comes.
    End,
    Error(String),
}

/// Which new log lines a client wants.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Follows {
    None,
    One(usize),
    All,
}

struct Client {
    stream: UnixStream,
    input: Vec<u8>,
    output: Vec<u8>,
    follows: Follows,
}

/// What came of reading a client.
#[derive(Debug, PartialEq, Eq)]
pub enum Heard {
    Requests(Vec<Result<Request, String>>),
    Gone,
}

/// New clients taken in one turn.
const ACCEPT_MAX: usize = 64;

/// What came of taking new clients.
#[derive(Debug, Default, PartialEq, Eq)]
pub struct Accepted {
    pub ids: Vec<u64>,
    /// Clients that were turned away because the process has no descriptor left.
    pub turned_away: u32,
    /// Why nobody could be taken, not even to be turned away: the socket stays readable, so it must not be waited for
    /// until a little later.
    pub stuck: Option<String>,
}

/// The listening end.
pub struct ControlServer {
    listener: UnixListener,
    clients: BTreeMap<u64, Client>,
    next: u64,
    /// Let go of for a moment when there is no descriptor left, so that a client can be told.
    spare: Option<File>,
}

/// Neither this process nor the system has a descriptor left.
fn no_descriptor(error: &io::Error) -> bool {
    matches!(error.raw_os_error(), Some(libc::EMFILE | libc::ENFILE))
}

impl ControlServer {
    pub fn open(path: &Path) -> io::Result<Self> {
        let listener = UnixListener::bind(path)?;
        listener.set_nonblocking(true)?;
        Ok(Self { listener, clients: BTreeMap::new(), next: 0, spare: File::open("/dev/null").ok() })
    }

    pub fn fd(&self) -> BorrowedFd<'_> {
        self.listener.as_fd()
    }

    pub fn client_fd(&self, id: u64) -> Option<BorrowedFd<'_>> {
        self.clients.get(&id).map(|c| c.stream.as_fd())
    }

    /// Takes new clients; those above the limit are told and closed.
    pub fn accept(&mut self) -> Accepted {
        let mut accepted = Accepted::default();
        for _ in 0..ACCEPT_MAX {
            let mut stream = match self.listener.accept() {
                Ok((stream, _)) => stream,
                Err(e) if e.kind() == io::ErrorKind::WouldBlock => break,
                // It was gone before it was taken.
                Err(e)
                    if matches!(e.kind(), io::ErrorKind::Interrupted | io::ErrorKind::ConnectionAborted) =>
                {
                    continue;
                }
                Err(e) if no_descriptor(&e) => match self.turn_away() {
                    Ok(()) => {
                        accepted.turned_away += 1;
                        continue;
                    }
                    // The system looks for a descriptor before it looks for a client.
                    Err(e) if e.kind() == io::ErrorKind::WouldBlock => break,
                    Err(e) => {
                        accepted.stuck = Some(e.to_string());
                        break;
                    }
                },
                Err(e) => {
                    accepted.stuck = Some(e.to_string());
                    break;
                }
            };
            if stream.set_nonblocking(true).is_err() {
                continue;
            }
            if self.clients.len() >= CLIENTS_MAX {
                let _ = stream.write_all(b"{\"error\":\"16 clients are connected already\"}\n");
                continue;
            }
            self.next += 1;
            self.clients.insert(
                self.next,
                Client { stream, input: Vec::new(), output: Vec::new(), follows: Follows::None },
            );
            accepted.ids.push(self.next);
        }
        accepted
    }

    /// Tells one client that there is no descriptor for it, with the spare one.
    fn turn_away(&mut self) -> io::Result<()> {
        drop(self.spare.take());
        let told = self.listener.accept().map(|(mut stream, _)| {
            let _ = stream.set_nonblocking(true);
            let _ =
                stream.write_all(b"{\"error\":\"the launcher has no file descriptor left (ulimit -n)\"}\n");
        });
        self.spare = File::open("/dev/null").ok();
        told
    }

    /// Reads what a client sent.
    pub fn hear(&mut self, id: u64) -> Heard {
        let Some(client) = self.clients.get_mut(&id) else { return Heard::Gone };
        let mut chunk = [0u8; 4096];
        // Bounded a turn, like everything in the launcher's loop.
        for _ in 0..32 {
            match client.stream.read(&mut chunk) {
                Ok(0) => return Heard::Gone,
                Ok(n) => client.input.extend_from_slice(&chunk[..n]),
                Err(e) if e.kind() == io::ErrorKind::WouldBlock => break,
                Err(e) if e.kind() == io::ErrorKind::Interrupted => {}
                Err(_) => return Heard::Gone,
            }
            if client.input.len() > REQUEST_BYTES_MAX {
                break;
            }
        }
        let mut requests = Vec::new();
        while let Some(end) = client.input.iter().position(|b| *b == b'\n') {
            let line: Vec<u8> = client.input.drain(..=end).collect();
            requests.push(serde_json::from_slice(&line).map_err(|e| format!("request not understood: {e}")));
        }
        if client.input.len() > REQUEST_BYTES_MAX {
            return Heard::Gone;
        }
        Heard::Requests(requests)
    }

    /// Answers; `false` when the client does not read and should be dropped.
    pub fn answer(&mut self, id: u64, reply: &Reply) -> bool {
        let Some(client) = self.clients.get_mut(&id) else { return false };
        let Ok(text) = serde_json::to_vec(reply) else { return false };
        client.output.extend_from_slice(&text);
        client.output.push(b'\n');
        client.output.len() <= OUTPUT_BYTES_MAX
    }

    pub fn follow(&mut self, id: u64, service: Option<usize>) {
        if let Some(client) = self.clients.get_mut(&id) {
            client.follows = service.map_or(Follows::All, Follows::One);
        }
    }

    /// Passes a new log line to those who follow; returns those to drop.
    pub fn publish(&mut self, line: &Line, name: &str) -> Vec<u64> {
        let ids: Vec<u64> = self
            .clients
            .iter()
            .filter(|(_, c)| c.follows == Follows::All || c.follows == Follows::One(line.service))
            .map(|(id, _)| *id)
            .collect();
        let reply =
            Reply::Log(LogLine { utc_ns: line.utc_ns, service: name.to_owned(), line: line.text.clone() });
        ids.into_iter().filter(|id| !self.answer(*id, &reply)).collect()
    }

    /// Writes what waits; returns whether something still waits, and whom to drop.
    pub fn flush(&mut self) -> (bool, Vec<u64>) {
        let (mut waits, mut broken) = (false, Vec::new());
        for (id, client) in &mut self.clients {
            while !client.output.is_empty() {
                match client.stream.write(&client.output) {
                    Ok(n) => drop(client.output.drain(..n)),
                    Err(e) if e.kind() == io::ErrorKind::WouldBlock => {
                        waits = true;
                        break;
                    }
                    Err(_) => {
                        broken.push(*id);
                        break;
                    }
                }
            }
        }
        (waits, broken)
    }

    pub fn drop_client(&mut self, id: u64) {
        self.clients.remove(&id);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::{BufRead, BufReader};

    fn pair(name: &str) -> (ControlServer, UnixStream, std::path::PathBuf) {
        let path = std::env::temp_dir().join(format!("dinrail-control-{}-{name}", std::process::id()));
        let _ = std::fs::remove_file(&path);
        let server = ControlServer::open(&path).unwrap();
        let client = UnixStream::connect(&path).unwrap();
        (server, client, path)
    }

    #[test]
    fn requests_come_in_pieces_and_answers_go_out() {
        let (mut server, mut client, path) = pair("pieces");
        let ids = server.accept().ids;
        client.write_all(b"{\"do\":\"ps\"}\n{\"do\":\"fly\"}\n{\"do\":\"rest").unwrap();
        let Heard::Requests(heard) = server.hear(ids[0]) else { panic!("gone") };
        assert_eq!(heard[0], Ok(Request::Ps {}));
        assert!(heard[1].as_ref().unwrap_err().contains("unknown variant `fly`"));
        client.write_all(b"art\",\"service\":\"plc\"}\n").unwrap();
        assert_eq!(
            server.hear(ids[0]),
            Heard::Requests(vec![Ok(Request::Restart { service: "plc".into() })])
        );
        assert!(server.answer(ids[0], &Reply::End));
        assert_eq!(server.flush(), (false, vec![]));
        let mut line = String::new();
        BufReader::new(&client).read_line(&mut line).unwrap();
        assert_eq!(line, "\"end\"\n");
        drop(client);
        assert_eq!(server.hear(ids[0]), Heard::Gone);
        std::fs::remove_file(path).unwrap();
    }

    #[test]
    fn a_client_that_never_ends_its_line_or_never_reads_is_dropped() {
        let (mut server, mut client, path) = pair("flood");
        let id = server.accept().ids[0];
        client.set_nonblocking(true).unwrap();
        let mut gone = false;
        for _ in 0..100 {
            let _ = client.write(&[b'x'; 4096]);
            gone |= server.hear(id) == Heard::Gone;
        }
        assert!(gone);
        let reply = Reply::Error("x".repeat(1 << 20));
        assert!((0..20).any(|_| !server.answer(id, &reply)));
        std::fs::remove_file(path).unwrap();
    }

    #[test]
    fn the_seventeenth_client_is_told() {
        let (mut server, first, path) = pair("crowd");
        let more: Vec<_> = (0..CLIENTS_MAX).map(|_| UnixStream::connect(&path).unwrap()).collect();
        assert_eq!(server.accept().ids.len(), CLIENTS_MAX);
        let mut line = String::new();
        BufReader::new(more.last().unwrap()).read_line(&mut line).unwrap();
        assert!(line.contains("16 clients"));
        drop(first);
        std::fs::remove_file(path).unwrap();
    }
}
