//! Ends `top` with its terminal and by signals, whatever the rest of it is doing.
//!
//! A thread of its own waits for both. The loop looks at it and ends in order; a loop that is stuck, in a read of keys on a
//! terminal that is gone or in a write to one that takes no output, is given a moment, then the process ends without it.

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::Errno;
use std::os::fd::OwnedFd;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

/// How long the loop may take to end once it was asked to.
const GRACE: Duration = Duration::from_secs(2);
/// How long the terminal may take to be put right when the loop does not.
const RESTORE: Duration = Duration::from_millis(500);
/// The terminal is gone.
const GONE: PollFlags = PollFlags::HUP.union(PollFlags::ERR).union(PollFlags::NVAL);

/// Says when it is time to end.
pub struct Guard(Arc<AtomicBool>);

impl Guard {
    /// `signals` becomes readable with one that shall end the process.
    pub fn start(signals: OwnedFd) -> std::io::Result<Self> {
        let asked = Arc::new(AtomicBool::new(false));
        let tell = asked.clone();
        std::thread::Builder::new().name("guard".into()).spawn(move || {
            wait_for_end(&signals);
            tell.store(true, Ordering::Release);
            std::thread::sleep(GRACE);
            give_up();
        })?;
        Ok(Self(asked))
    }

    /// Whether a signal came or the terminal went.
    pub fn asked(&self) -> bool {
        self.0.load(Ordering::Acquire)
    }
}

fn wait_for_end(signals: &OwnedFd) {
    let keys = std::io::stdin();
    let screen = std::io::stdout();
    let mut fds = [
        PollFd::new(signals, PollFlags::IN),
        PollFd::new(&keys, PollFlags::empty()),
        PollFd::new(&screen, PollFlags::empty()),
    ];
    loop {
        match poll(&mut fds, None) {
            Ok(1..) if fds.iter().any(|fd| !fd.revents().is_empty()) => return,
            Ok(_) | Err(Errno::INTR) => {}
            // Without it nothing would end the process any more.
            Err(_) => return,
        }
    }
}

/// Ends the process without its loop. What was not given back on the rail is cleaned up by whoever needs the place.
fn give_up() -> ! {
    // This one does not wait for the terminal, the sequences that follow may.
    let _ = ratatui::crossterm::terminal::disable_raw_mode();
    let (done, wait) = std::sync::mpsc::channel();
    let restore = move || {
        let _ = ratatui::try_restore();
        let _ = done.send(());
    };
    if std::thread::Builder::new().spawn(restore).is_ok() {
        let _ = wait.recv_timeout(RESTORE);
    }
    std::process::exit(1)
}

/// Whether the terminal is gone.
pub fn is_gone() -> bool {
    let keys = std::io::stdin();
    let mut fds = [PollFd::new(&keys, PollFlags::empty())];
    poll(&mut fds, Some(&Timespec { tv_sec: 0, tv_nsec: 0 })).is_ok() && fds[0].revents().intersects(GONE)
}

/// Waits until a key can be read, at most `limit`; false when the terminal is gone.
pub fn wait_for_keys(limit: Duration) -> bool {
    let keys = std::io::stdin();
    let mut fds = [PollFd::new(&keys, PollFlags::IN)];
    let limit = Timespec { tv_sec: limit.as_secs() as i64, tv_nsec: i64::from(limit.subsec_nanos()) };
    match poll(&mut fds, Some(&limit)) {
        Ok(0) | Err(Errno::INTR) => true,
        Ok(_) if fds[0].revents().intersects(GONE) => false,
        // Readable, but nothing there to read: its other end is closed.
        Ok(_) => rustix::io::ioctl_fionread(&keys).is_ok_and(|bytes| bytes > 0),
        Err(_) => false,
    }
}
