//! Wake-ups: every consumer has one inbox, a datagram socket in the stack's root; who wrote into one of its topics rings.
//!
//! Not iceoryx2's events: a notifier of 0.10 that finds the state "notified" sends nothing, and a listener that empties its
//! socket takes one datagram of several and can leave that state behind with nothing to read. Whoever waits for arrivals
//! (edge-triggered epoll, as tokio does) then never wakes again; four writers that ring as fast as they are heard need
//! less than a second (`tests/wakeups.rs`). Here every ring is a datagram, and a reader takes all of them.
//!
//! The root belongs to the user alone (mode 0700). A ring says only that something is new, never what: a full socket drops
//! rings, and those that wait in it wake as well.

use crate::rail::RailError;
use std::io;
use std::os::fd::{AsFd, BorrowedFd};
use std::os::unix::net::UnixDatagram;
use std::path::{Path, PathBuf};

/// The socket of a service's inbox.
fn place(root: &Path, service: &str) -> PathBuf {
    root.join(format!("inbox_{service}"))
}

/// The receiving end.
#[derive(Debug)]
pub struct Inbox {
    socket: UnixDatagram,
}

impl Inbox {
    /// Takes the place of a predecessor, whose inbox is forgotten: only one process at a time is a service.
    pub(crate) fn open(root: &Path, service: &str) -> Result<Self, RailError> {
        let path = place(root, service);
        let bound = (|| {
            match std::fs::remove_file(&path) {
                Err(e) if e.kind() != io::ErrorKind::NotFound => return Err(e),
                _ => {}
            }
            let socket = UnixDatagram::bind(&path)?;
            socket.set_nonblocking(true)?;
            Ok(socket)
        })();
        let socket = bound.map_err(|source| RailError::Write { path, source })?;
        Ok(Self { socket })
    }

    /// Readable while wake-ups wait. [`Self::drain`] after each wake, then look at every topic.
    pub fn fd(&self) -> BorrowedFd<'_> {
        self.socket.as_fd()
    }

    /// Takes all waiting wake-ups; whether there was one. What rings from now on makes the descriptor readable again.
    pub fn drain(&mut self) -> bool {
        let mut rang = false;
        loop {
            match self.socket.recv(&mut [0]) {
                Ok(_) => rang = true,
                Err(e) if e.kind() == io::ErrorKind::Interrupted => {}
                Err(_) => return rang,
            }
        }
    }
}

/// The ringing end to one inbox.
#[derive(Debug)]
pub struct Bell {
    /// Connected to the inbox of the consumer that was last there: looking its path up at each ring costs a fifth of it.
    socket: UnixDatagram,
    inbox: PathBuf,
}

impl Bell {
    pub(crate) fn open(root: &Path, service: &str) -> Result<Self, RailError> {
        let socket = UnixDatagram::unbound()?;
        socket.set_nonblocking(true)?;
        Ok(Self { socket, inbox: place(root, service) })
    }

    /// Wakes the consumer. A dead one is no error: its successor reads the queue when it starts. Nor is a full socket:
    /// there are rings in it.
    pub fn ring(&self) {
        let mut looked_up = false;
        while let Err(e) = self.socket.send(&[1]) {
            match e.kind() {
                io::ErrorKind::Interrupted => {}
                io::ErrorKind::WouldBlock => return,
                // Not connected yet, or to one that is gone: a restarted consumer has another socket in its place.
                _ if !looked_up && self.socket.connect(&self.inbox).is_ok() => looked_up = true,
                _ => return,
            }
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may end like this")]
    use super::*;

    #[test]
    fn a_bell_finds_the_successor_and_rings_that_meet_a_full_socket_wake_as_well() {
        let root = std::env::temp_dir().join(format!("dinrail-inbox-{}", std::process::id()));
        std::fs::create_dir_all(&root).unwrap();
        let bell = Bell::open(&root, "plc").unwrap();
        bell.ring();
        let mut first = Inbox::open(&root, "plc").unwrap();
        assert!(!first.drain(), "what rang before is not there");
        bell.ring();
        assert!(first.drain() && !first.drain());
        // More than any socket holds.
        (0..100_000).for_each(|_| bell.ring());
        assert!(first.drain() && !first.drain());
        bell.ring();
        drop(first);
        bell.ring();
        for _ in 0..3 {
            let mut next = Inbox::open(&root, "plc").unwrap();
            assert!(!next.drain());
            bell.ring();
            assert!(next.drain());
        }
        std::fs::remove_dir_all(&root).unwrap();
    }
}
