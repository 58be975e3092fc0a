//! Foreign programs: python scripts in the project's own environment, and programs of the system.

use super::python::python;
use super::{skip, wait_for};
use std::io::{BufRead, BufReader, Read, Write};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::Duration;

/// Transfers of a megabyte by interpreted programs, on a machine that is shared.
const LONG: Duration = Duration::from_mins(2);

/// A command that runs one of `tests/peers/*.py`.
pub fn peer(script: &str) -> Option<Command> {
    let mut command = Command::new(python()?);
    command.args(["-u", "-B"]).arg(Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/peers").join(script));
    Some(command)
}

/// A program of the system, or `None` after saying loudly that the test is skipped.
pub fn program(name: &str, package: &str) -> Option<Command> {
    let found = std::env::var_os("PATH")
        .is_some_and(|path| std::env::split_paths(&path).any(|dir| dir.join(name).is_file()));
    if found {
        return Some(Command::new(name));
    }
    skip(&format!("no {name} here: apt-get install {package}"));
    None
}

/// A foreign program with what it said so far; killed when dropped.
pub struct Peer {
    child: Child,
    said: Arc<Mutex<Vec<String>>>,
    /// Threads that read what it says.
    readers: Vec<JoinHandle<()>>,
    /// Lines already waited for.
    taken: usize,
}

impl Peer {
    pub fn start(mut command: Command) -> Self {
        let mut child =
            command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        let said = Arc::new(Mutex::new(Vec::new()));
        let pipes: [Box<dyn Read + Send>; 2] =
            [Box::new(child.stdout.take().unwrap()), Box::new(child.stderr.take().unwrap())];
        let read = |pipe: Box<dyn Read + Send>| {
            let said = Arc::clone(&said);
            std::thread::spawn(move || {
                for line in BufReader::new(pipe).lines().map_while(Result::ok) {
                    said.lock().unwrap().push(line);
                }
            })
        };
        let readers = pipes.into_iter().map(read).collect();
        Self { child, said, readers, taken: 0 }
    }

    pub fn all(&self) -> Vec<String> {
        self.said.lock().unwrap().clone()
    }

    /// Waits until it says this line, after those waited for before.
    pub fn says(&mut self, line: &str) {
        let start = std::time::Instant::now();
        loop {
            // Asked before what it said: the last line may be read after its end.
            let ended = self.readers.iter().all(JoinHandle::is_finished);
            let said = self.all();
            if let Some(at) = said[self.taken..].iter().position(|l| l == line) {
                self.taken += at + 1;
                return;
            }
            assert!(
                !ended && start.elapsed() < LONG,
                "waited in vain for '{line}'; the peer {}said:\n{}",
                if ended { "ended and " } else { "" },
                said.join("\n")
            );
            std::thread::sleep(Duration::from_millis(10));
        }
    }

    pub fn tell(&mut self, line: &str) {
        let pipe = self.child.stdin.as_mut().unwrap();
        writeln!(pipe, "{line}").unwrap();
        pipe.flush().unwrap();
    }

    /// Waits until it ends well.
    pub fn ends(mut self) {
        let status = wait_for("the end of the peer", LONG, || self.child.try_wait().unwrap());
        assert!(status.success(), "{}", self.all().join("\n"));
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
