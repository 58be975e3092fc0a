//! One clock of a service on tokio that is exact to the microsecond: tokio's own timers count whole milliseconds.

use crate::readable;
use rustix::time::{
    Itimerspec, TimerfdClockId, TimerfdFlags, TimerfdTimerFlags, Timespec, timerfd_create, timerfd_settime,
};
use std::io;
use std::os::fd::OwnedFd;
use tokio::io::unix::AsyncFd;

/// See the module.
pub struct Alarm {
    fd: AsyncFd<OwnedFd>,
    set_ns: Option<u64>,
}

impl Alarm {
    pub fn new() -> io::Result<Self> {
        let fd = timerfd_create(TimerfdClockId::Monotonic, TimerfdFlags::NONBLOCK | TimerfdFlags::CLOEXEC)?;
        Ok(Self { fd: readable::watch(fd)?, set_ns: None })
    }

    /// Rings once at this CLOCK_MONOTONIC time in ns, at once when it is past; `None`: it need not ring. It may ring
    /// at an earlier time that it was set to before: most are set for a timeout that does not come to pass, and
    /// one ring too many costs less than a call to the system for every request. So set it after each ring.
    pub fn set(&mut self, at_ns: Option<u64>) -> io::Result<()> {
        let Some(at_ns) = at_ns.filter(|at_ns| self.set_ns.is_none_or(|set_ns| *at_ns < set_ns)) else {
            return Ok(());
        };
        let at = at_ns.max(1);
        let value = Timespec { tv_sec: (at / 1_000_000_000) as i64, tv_nsec: (at % 1_000_000_000) as i64 };
        let once = Itimerspec { it_interval: Timespec { tv_sec: 0, tv_nsec: 0 }, it_value: value };
        timerfd_settime(self.fd.get_ref(), TimerfdTimerFlags::ABSTIME, &once)?;
        self.set_ns = Some(at_ns);
        Ok(())
    }

    /// Waits until it rings.
    pub async fn rang(&mut self) -> io::Result<()> {
        loop {
            let mut ready = self.fd.readable().await?;
            let mut count = [0; 8];
            match rustix::io::read(ready.get_inner(), &mut count) {
                Ok(_) => {
                    drop(ready);
                    self.set_ns = None;
                    return Ok(());
                }
                Err(rustix::io::Errno::AGAIN) => ready.clear_ready(),
                Err(rustix::io::Errno::INTR) => {}
                Err(e) => return Err(e.into()),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ipc_types::clock::mono_ns;

    #[test]
    fn it_rings_at_the_earliest_of_its_times_and_again() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_io().build().unwrap();
        runtime.block_on(async {
            let mut alarm = Alarm::new().unwrap();
            for ms in [5, 0, 3] {
                let at_ns = mono_ns() + ms * 1_000_000;
                // An hour is no time that a test waits for.
                for set_ns in [Some(at_ns + 3_600_000_000_000), Some(at_ns), None, Some(at_ns + 1)] {
                    alarm.set(set_ns).unwrap();
                }
                alarm.rang().await.unwrap();
                assert!(mono_ns() >= at_ns);
            }
        });
    }
}
