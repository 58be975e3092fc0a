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
use std::os::unix::net::{SocketAddr, UnixDatagram};
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
    socket: UnixDatagram,
    /// Looked up at each ring: a restarted consumer has another socket there.
    inbox: SocketAddr,
}

impl Bell {
    pub(crate) fn open(root: &Path, service: &str) -> Result<Self, RailError> {
        let socket = UnixDatagram::unbound()?;
        socket.set_nonblocking(true)?;
        Ok(Self { socket, inbox: SocketAddr::from_pathname(place(root, service))? })
    }

    /// Wakes the consumer. A dead one is no error: its successor reads the queue when it starts. Nor is a full socket:
    /// there are rings in it.
    pub fn ring(&self) {
        while let Err(e) = self.socket.send_to_addr(&[1], &self.inbox) {
            if e.kind() != io::ErrorKind::Interrupted {
                return;
            }
        }
    }
}
