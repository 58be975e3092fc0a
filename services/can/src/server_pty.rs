//! SLCAN on a pseudo-terminal, for tools that want a serial port: can-utils' slcand, SavvyCAN, python-can by device.
//!
//! The terminal exists as long as the service; a symbolic link of a name of the user's choice leads to it. One client at
//! a time: who opens it finds a closed channel, as on an adapter that was just plugged in.

use std::io;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::rc::Rc;
use std::time::Duration;

use rustix::fs::inotify;
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{ControlModes, OptionalActions, tcgetattr, tcsetattr};
use tokio::io::unix::AsyncFd;

use crate::server::{Host, Hub};
use crate::virtual_bus::Dialect;
use crate::watch;
use crate::wire::port::Port;

/// What a client that has closed the terminal left behind is used for so long.
const LAST_WORDS: Duration = Duration::from_millis(50);

/// Openings less closings since the last look: at its end, and at its lowest in between.
#[derive(Debug, Clone, Copy)]
struct Change {
    sum: i32,
    low: i32,
}

impl Change {
    /// How many have it open after this, when there were `open` before, and whether there was nobody in between. Never less
    /// than none: the kernel tells two openings in a row as one, and a count below none would hide the next client.
    fn after(self, open: i32) -> (i32, bool) {
        ((open + self.sum).max(0), open + self.low <= 0)
    }
}

/// A pseudo-terminal with its link.
pub struct Pty {
    port: Port,
    /// Held open, so that the terminal survives its clients and keeps its settings.
    slave: OwnedFd,
    watch: AsyncFd<OwnedFd>,
    device: PathBuf,
    link: PathBuf,
}

impl Pty {
    /// Makes a terminal and the link to it. A link that is there is replaced; anything else there is an error.
    pub fn new(link: &Path) -> io::Result<Self> {
        let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC)?;
        grantpt(&master)?;
        unlockpt(&master)?;
        rustix::fs::fcntl_setfl(&master, rustix::fs::OFlags::NONBLOCK)?;
        let name = ptsname(&master, Vec::new())?;
        let device = PathBuf::from(name.to_string_lossy().into_owned());
        let slave = std::fs::OpenOptions::new()
            .read(true)
            .write(true)
            .custom_flags(libc::O_NOCTTY | libc::O_NONBLOCK | libc::O_CLOEXEC)
            .open(&device)?;
        make_raw(slave.as_fd())?;
        let notify = inotify::init(inotify::CreateFlags::CLOEXEC | inotify::CreateFlags::NONBLOCK)?;
        let events =
            inotify::WatchFlags::OPEN | inotify::WatchFlags::CLOSE_WRITE | inotify::WatchFlags::CLOSE_NOWRITE;
        inotify::add_watch(&notify, &device, events)?;
        match std::fs::symlink_metadata(link) {
            Ok(found) if found.file_type().is_symlink() => std::fs::remove_file(link)?,
            Ok(_) => {
                return Err(io::Error::new(
                    io::ErrorKind::AlreadyExists,
                    "something that is no link is there",
                ));
            }
            Err(_) => {}
        }
        std::os::unix::fs::symlink(&device, link)?;
        let link = link.to_owned();
        Ok(Self {
            port: Port::Tty(watch::both(master)?),
            slave: slave.into(),
            watch: watch::readable(notify)?,
            device,
            link,
        })
    }

    /// Serves clients for ever. Must run inside a `LocalSet`.
    pub async fn serve<H: Host + 'static>(self, hub: Rc<Hub<H>>) -> io::Result<()> {
        let peer = self.link.display().to_string();
        let mut open = 0i32;
        loop {
            while open == 0 {
                open = self.events().await?.after(open).0;
            }
            let Some(number) = hub.enter(&peer, Dialect::Slcan) else {
                tokio::time::sleep(Duration::from_millis(100)).await;
                continue;
            };
            let mut end = Ok(());
            let mut gone = false;
            tokio::select! {
                broken = hub.converse(&self.port, number) => end = broken,
                events = self.closed(&mut open) => { events?; gone = true; }
            }
            // The next one may be there already: nothing of the last one's is for it.
            hub.look(|bus, _| bus.mute(number));
            self.discard();
            if gone && open == 0 {
                tokio::select! {
                    biased;
                    events = self.events() => open = events?.after(open).0,
                    _ = tokio::time::timeout(LAST_WORDS, hub.converse(&self.port, number)) => {}
                }
            }
            hub.leave(&peer, number, Dialect::Slcan, end);
        }
    }

    /// Until the last of those who had it open has closed it, even when somebody opened it again since.
    async fn closed(&self, open: &mut i32) -> io::Result<()> {
        loop {
            let (now, nobody) = self.events().await?.after(*open);
            *open = now;
            if nobody {
                return Ok(());
            }
        }
    }

    /// Waits for openings (+1) and closings (-1).
    async fn events(&self) -> io::Result<Change> {
        loop {
            let mut guard = self.watch.readable().await?;
            let mut buffer = [std::mem::MaybeUninit::uninit(); 4096];
            let mut reader = inotify::Reader::new(self.watch.get_ref(), &mut buffer);
            let mut change = None;
            loop {
                match reader.next() {
                    // Too many to be told: which is not known.
                    Ok(event) if event.events().contains(inotify::ReadFlags::QUEUE_OVERFLOW) => {}
                    Ok(event) => {
                        let step = if event.events().contains(inotify::ReadFlags::OPEN) { 1 } else { -1 };
                        let Change { sum, low } = change.get_or_insert(Change { sum: 0, low: 0 });
                        *sum += step;
                        *low = (*low).min(*sum);
                    }
                    Err(rustix::io::Errno::AGAIN) => break,
                    Err(rustix::io::Errno::INTR) => {}
                    Err(e) => return Err(e.into()),
                }
            }
            guard.clear_ready();
            if let Some(change) = change {
                return Ok(change);
            }
        }
    }

    /// Throws away what the last client did not read.
    fn discard(&self) {
        let mut buffer = [0u8; 4096];
        while matches!(rustix::io::read(&self.slave, &mut buffer), Ok(n) if n > 0) {}
    }
}

impl Drop for Pty {
    fn drop(&mut self) {
        if std::fs::read_link(&self.link).is_ok_and(|to| to == self.device) {
            let _ = std::fs::remove_file(&self.link);
        }
    }
}

/// Makes a terminal a plain pipe of bytes: no echo, no translation.
fn make_raw(fd: BorrowedFd<'_>) -> io::Result<()> {
    let mut settings = tcgetattr(fd)?;
    settings.make_raw();
    settings.control_modes |= ControlModes::CLOCAL | ControlModes::CREAD;
    settings.control_modes -= ControlModes::CRTSCTS | ControlModes::CSTOPB;
    Ok(tcsetattr(fd, OptionalActions::Now, &settings)?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn openings_told_as_one_hide_nobody() {
        let opened = Change { sum: 1, low: 0 };
        let closed = Change { sum: -1, low: -1 };
        // Two openings at once, then two closings, each told by itself.
        let (open, _) = opened.after(0);
        assert_eq!((open, closed.after(open)), (1, (0, true)));
        let (open, _) = closed.after(0);
        assert_eq!(opened.after(open).0, 1, "the next client is seen");
        assert_eq!(Change { sum: 0, low: -1 }.after(1), (1, true), "gone and here again");
        assert_eq!(Change { sum: 0, low: 0 }.after(1), (1, false), "a second one came and went");
    }

    #[test]
    fn a_terminal_becomes_a_pipe() {
        let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).unwrap();
        grantpt(&master).unwrap();
        unlockpt(&master).unwrap();
        let name = ptsname(&master, Vec::new()).unwrap();
        let slave = std::fs::OpenOptions::new().read(true).write(true).open(name.to_str().unwrap()).unwrap();
        make_raw(slave.as_fd()).unwrap();
        rustix::io::write(&master, b"a\r\x07\x03").unwrap();
        let mut bytes = [0; 16];
        let n = rustix::io::read(&slave, &mut bytes).unwrap();
        assert_eq!(&bytes[..n], b"a\r\x07\x03");
        let (pipe, _) = rustix::pipe::pipe().unwrap();
        assert!(make_raw(pipe.as_fd()).is_err());
    }
}
