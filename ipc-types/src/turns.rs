//! The turns of a field service that lives on epoll: what wakes it, its heartbeat, when it has to come again.
//!
//! ```no_run
//! # use ipc_types::{Context, turns::Turns};
//! # fn work(_: &mut Context) -> Option<u64> { None }
//! # fn status(_: &mut Context) {}
//! # fn run(mut ctx: Context) -> Result<(), Box<dyn std::error::Error>> {
//! let mut turns = Turns::new(ctx.inbox()?, ctx.shutdown_fd())?;
//! loop {
//!     let due = turns.wait()?;
//!     if due.stop { return Ok(()) }
//!     turns.drain();                        // before the topics are read
//!     let next_ns = work(&mut ctx);         // the work
//!     if due.beat { ctx.beat() }
//!     if due.status { status(&mut ctx) }
//!     turns.come_again(next_ns)?;
//! }
//! # }
//! ```

use crate::inbox::Inbox;
use crate::reactor::{Reactor, Wake};
use std::io;
use std::os::fd::BorrowedFd;
use std::time::Duration;

/// Heartbeat; the launcher wants one every 100 ms.
pub const BEAT: Duration = Duration::from_millis(50);
/// Beats from one status to the next: one second.
pub const STATUS_BEATS: u32 = 20;

/// Why a turn came. All false: only the inbox or the clock of [`Turns::come_again`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Turn {
    /// The service shall end.
    pub stop: bool,
    /// A heartbeat is due.
    pub beat: bool,
    /// The status is due, with a heartbeat.
    pub status: bool,
}

/// See the module.
pub struct Turns {
    reactor: Reactor,
    inbox: Inbox,
    inbox_wake: Wake,
    stop: Wake,
    beat: Wake,
    alarm: Wake,
    rang: bool,
    beats: u32,
    /// What the alarm is set to.
    alarm_ns: Option<u64>,
}

impl Turns {
    /// Of [`crate::Context::inbox`] and [`crate::Context::shutdown_fd`]; the heartbeat clock runs from now on.
    pub fn new(inbox: Inbox, stop: BorrowedFd<'_>) -> io::Result<Self> {
        let mut reactor = Reactor::new()?;
        Ok(Self {
            inbox_wake: reactor.add(inbox.fd())?,
            stop: reactor.add(stop)?,
            beat: reactor.add_timer(BEAT)?,
            alarm: reactor.add_alarm()?,
            reactor,
            inbox,
            rang: false,
            beats: 0,
            alarm_ns: None,
        })
    }

    /// Waits until there is something to do.
    pub fn wait(&mut self) -> io::Result<Turn> {
        let mut turn = Turn::default();
        for &wake in self.reactor.wait(None)? {
            self.rang |= wake == self.inbox_wake;
            turn.stop |= wake == self.stop;
            turn.beat |= wake == self.beat;
            if wake == self.alarm {
                self.alarm_ns = None;
            }
        }
        if turn.beat {
            self.beats = self.beats.wrapping_add(1);
            turn.status = self.beats.is_multiple_of(STATUS_BEATS);
        }
        Ok(turn)
    }

    /// Empties the inbox, if it rang. Topics are read after that, in every turn: also what was left of the last one, and
    /// what a lost ring would leave.
    pub fn drain(&mut self) {
        if std::mem::take(&mut self.rang) {
            self.inbox.drain();
        }
    }

    /// Sets the alarm: at this CLOCK_MONOTONIC time in ns there is something to do, at once when that is past. `None`
    /// leaves it as it is: a turn too many does no harm.
    pub fn come_again(&mut self, next_ns: Option<u64>) -> io::Result<()> {
        if let Some(next_ns) = next_ns
            && self.alarm_ns != Some(next_ns)
        {
            self.reactor.set_alarm(self.alarm, next_ns)?;
            self.alarm_ns = Some(next_ns);
        }
        Ok(())
    }
}
