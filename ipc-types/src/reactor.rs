//! Waiting for descriptors and clocks: epoll, with absolute timerfds as clocks (iceoryx2's own intervals are
//! rounded up to whole milliseconds and drift, measured 1.097 ms for 1 ms).

use rustix::event::epoll;
use rustix::time::{Itimerspec, TimerfdClockId, TimerfdFlags, TimerfdTimerFlags, Timespec};
use std::io;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::time::Duration;

/// Names a source of wake-ups.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Wake(u64);

/// Most sources of one reactor, and most wake-ups of one wait.
const MAX_SOURCES: usize = 64;

/// An epoll set with its timers.
pub struct Reactor {
    epoll: OwnedFd,
    next: u64,
    timers: Vec<(Wake, OwnedFd)>,
    events: Vec<epoll::Event>,
    woken: Vec<Wake>,
}

fn timespec(d: Duration) -> Timespec {
    Timespec { tv_sec: d.as_secs() as i64, tv_nsec: i64::from(d.subsec_nanos()) }
}

impl Reactor {
    pub fn new() -> io::Result<Self> {
        Ok(Self {
            epoll: epoll::create(epoll::CreateFlags::CLOEXEC)?,
            next: 0,
            timers: Vec::new(),
            events: Vec::with_capacity(MAX_SOURCES),
            woken: Vec::with_capacity(MAX_SOURCES),
        })
    }

    /// Wakes while `fd` is readable (level-triggered). The descriptor must live as long as the reactor waits.
    pub fn add(&mut self, fd: BorrowedFd<'_>) -> io::Result<Wake> {
        let wake = Wake(self.next);
        self.next += 1;
        epoll::add(&self.epoll, fd, epoll::EventData::new_u64(wake.0), epoll::EventFlags::IN)?;
        Ok(wake)
    }

    /// Stops waking for `fd`.
    pub fn remove(&mut self, fd: BorrowedFd<'_>) -> io::Result<()> {
        Ok(epoll::delete(&self.epoll, fd)?)
    }

    /// A clock that wakes every `period`, the first time after one period, without drift.
    pub fn add_timer(&mut self, period: Duration) -> io::Result<Wake> {
        let wake = self.add_alarm()?;
        self.set_timer(wake, period, period)?;
        Ok(wake)
    }

    /// A clock that is not running yet; see [`Self::set_alarm`].
    pub fn add_alarm(&mut self) -> io::Result<Wake> {
        let fd = rustix::time::timerfd_create(
            TimerfdClockId::Monotonic,
            TimerfdFlags::NONBLOCK | TimerfdFlags::CLOEXEC,
        )?;
        let wake = self.add(fd.as_fd())?;
        self.timers.push((wake, fd));
        Ok(wake)
    }

    /// Sets a clock to `first` from now and then every `period` (0 = once). `first` 0 stops it.
    pub fn set_timer(&mut self, wake: Wake, first: Duration, period: Duration) -> io::Result<()> {
        let spec = Itimerspec { it_value: timespec(first), it_interval: timespec(period) };
        self.set(wake, TimerfdTimerFlags::empty(), &spec)
    }

    /// Lets a clock wake once at this CLOCK_MONOTONIC time in ns; at once when that is past.
    pub fn set_alarm(&mut self, wake: Wake, at_ns: u64) -> io::Result<()> {
        let spec = Itimerspec {
            it_value: timespec(Duration::from_nanos(at_ns.max(1))),
            it_interval: timespec(Duration::ZERO),
        };
        self.set(wake, TimerfdTimerFlags::ABSTIME, &spec)
    }

    fn set(&mut self, wake: Wake, flags: TimerfdTimerFlags, spec: &Itimerspec) -> io::Result<()> {
        let Some((_, fd)) = self.timers.iter().find(|(w, _)| *w == wake) else {
            return Err(io::Error::new(io::ErrorKind::NotFound, "no such clock in this reactor"));
        };
        rustix::time::timerfd_settime(fd, flags, spec)?;
        Ok(())
    }

    /// Waits until something wakes, at most `timeout`. Clocks are read, so that they wake once a tick.
    pub fn wait(&mut self, timeout: Option<Duration>) -> io::Result<&[Wake]> {
        self.woken.clear();
        self.events.clear();
        let timeout = timeout.map(timespec);
        match epoll::wait(&self.epoll, rustix::buffer::spare_capacity(&mut self.events), timeout.as_ref()) {
            Ok(_) => {}
            Err(rustix::io::Errno::INTR) => return Ok(&self.woken),
            Err(e) => return Err(e.into()),
        }
        for event in &self.events {
            let wake = Wake(event.data.u64());
            if let Some((_, fd)) = self.timers.iter().find(|(w, _)| *w == wake) {
                let mut ticks = [0u8; 8];
                if rustix::io::read(fd, &mut ticks).is_err() {
                    continue;
                }
            }
            self.woken.push(wake);
        }
        Ok(&self.woken)
    }
}

/// SIGTERM and SIGINT as a descriptor.
pub mod signals {
    #![allow(unsafe_code)]
    use std::io;
    use std::os::fd::{FromRawFd, OwnedFd};

    /// Blocks these signals in this thread and its future children threads and returns a descriptor that
    /// becomes readable when one arrives. Call before any other thread starts.
    pub fn descriptor(signals: &[i32]) -> io::Result<OwnedFd> {
        // SAFETY: sigset_t is plain data that sigemptyset initialises; all pointers are to live locals; the
        // returned descriptor is new and owned by nobody else.
        unsafe {
            let mut set = std::mem::zeroed::<libc::sigset_t>();
            libc::sigemptyset(&raw mut set);
            for signal in signals {
                libc::sigaddset(&raw mut set, *signal);
            }
            if libc::pthread_sigmask(libc::SIG_BLOCK, &raw const set, std::ptr::null_mut()) != 0 {
                return Err(io::Error::last_os_error());
            }
            let fd = libc::signalfd(-1, &raw const set, libc::SFD_CLOEXEC | libc::SFD_NONBLOCK);
            if fd < 0 {
                return Err(io::Error::last_os_error());
            }
            Ok(OwnedFd::from_raw_fd(fd))
        }
    }

    /// Takes one signal number from the descriptor, if one waits.
    pub fn take(fd: &OwnedFd) -> Option<i32> {
        let mut info = [0u8; 128];
        match rustix::io::read(fd, &mut info) {
            Ok(128) => Some(i32::from_ne_bytes([info[0], info[1], info[2], info[3]])),
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn descriptors_and_clocks_wake() {
        let (a, b) = rustix::pipe::pipe().unwrap();
        let mut reactor = Reactor::new().unwrap();
        let pipe = reactor.add(a.as_fd()).unwrap();
        let tick = reactor.add_timer(Duration::from_millis(5)).unwrap();
        let mut ticks = 0;
        while ticks < 3 {
            ticks +=
                reactor.wait(Some(Duration::from_secs(10))).unwrap().iter().filter(|w| **w == tick).count();
        }
        rustix::io::write(&b, b"x").unwrap();
        let mut seen = false;
        for _ in 0..1000 {
            seen |= reactor.wait(Some(Duration::from_secs(10))).unwrap().contains(&pipe);
            if seen {
                break;
            }
        }
        assert!(seen);
    }

    #[test]
    fn an_alarm_in_the_past_wakes_at_once() {
        let mut reactor = Reactor::new().unwrap();
        let alarm = reactor.add_alarm().unwrap();
        reactor.set_alarm(alarm, 1).unwrap();
        assert_eq!(reactor.wait(Some(Duration::from_secs(10))).unwrap(), &[alarm]);
        assert!(reactor.wait(Some(Duration::ZERO)).unwrap().is_empty());
    }
}
