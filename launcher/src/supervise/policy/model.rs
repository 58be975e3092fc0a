//! What supervision speaks of: rules, phases, actions.

use ipc_types::event::{EventKind, Level};
use serde_json::Value;
use std::collections::VecDeque;

/// What happens when the restart budget is used up.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Exhausted {
    /// The service stays down, its inherited listeners are closed; the others go on.
    #[default]
    Hold,
    /// The whole stack stops with exit code 1.
    FailStack,
}

/// A service that was ready for so long without a break is healthy, and what it did before is forgotten.
pub const HEALTHY_NS: u64 = 60_000_000_000;
/// A service that died so often since it was last healthy is told to be unstable, and again at each doubling.
pub const UNSTABLE_AFTER: u32 = 5;

/// How one service is supervised.
///
/// Two things use up the budget: more than `max` restarts within `within_ns`, and more than `max` starts in a row that
/// never got ready, however long each of them took: one that hangs in its start for 10 s has no five restarts in 10 s.
/// Who dies more seldom than that is started again for ever, with a delay that grows until it was healthy
/// ([`HEALTHY_NS`], or `within_ns` if that is longer), and is told to be unstable.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Rule {
    /// So many restarts...
    pub max: u32,
    /// ... within this time.
    pub within_ns: u64,
    /// Delay of the second restart since it was healthy; doubles up to `backoff_max_ns`. The first one has no delay.
    pub backoff_first_ns: u64,
    pub backoff_max_ns: u64,
    pub on_exhausted: Exhausted,
    /// Silence after which a service that was ready counts as hanging.
    pub hang_timeout_ns: u64,
    /// A service that has not reported ready so long after its start counts as hanging: longer, because
    /// compiling a large program comes before.
    pub start_timeout_ns: u64,
    /// Started first and stopped last, so that a recording holds everything.
    pub recorder: bool,
}

impl Default for Rule {
    fn default() -> Self {
        Self {
            max: 5,
            within_ns: 10_000_000_000,
            backoff_first_ns: 50_000_000,
            backoff_max_ns: 5_000_000_000,
            on_exhausted: Exhausted::Hold,
            hang_timeout_ns: 2_000_000_000,
            start_timeout_ns: 10_000_000_000,
            recorder: false,
        }
    }
}

/// Signals that supervision sends.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kill {
    /// SIGTERM: end in order.
    Term,
    /// SIGABRT: end with a core and a backtrace.
    Abort,
    /// SIGKILL.
    Now,
}

/// Something that happened, for the rail, the recording and the log.
#[derive(Debug, Clone, PartialEq)]
pub struct Notice {
    /// Index of the service it is about; `None` = the stack.
    pub service: Option<usize>,
    pub kind: EventKind,
    pub level: Level,
    pub message: String,
    pub detail: Value,
}

/// What the caller has to do, in order.
#[derive(Debug, Clone, PartialEq)]
pub enum Action {
    /// Start the process; report with [`Policy::started`] or [`Policy::died`].
    Spawn {
        service: usize,
        generation: u32,
    },
    Signal {
        service: usize,
        signal: Kill,
    },
    /// Run the helper that cleans dead nodes; report with [`Policy::clean_done`].
    Clean,
    /// Close the listeners that the service would inherit, so that clients are refused, not kept waiting.
    CloseListeners {
        service: usize,
    },
    Tell(Notice),
    /// Every process has ended.
    Ended,
}

/// How a process ended.
#[derive(Debug, Clone, PartialEq)]
pub struct Death {
    /// `killed by SIGKILL`, `exit code 1`.
    pub how: String,
    /// Signal, exit code, last log lines.
    pub detail: Value,
}

/// Where a service is in its life.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Phase {
    Idle,
    Starting,
    Running,
    /// SIGABRT was sent because it hangs.
    Aborting {
        kill_at: u64,
    },
    /// SIGKILL was sent because it hangs.
    Killed {
        overdue_at: u64,
    },
    /// SIGTERM was sent by `restart`.
    Restarting {
        kill_at: u64,
    },
    /// Dead; the clean-up number `round` comes before the restart.
    Cleaning {
        round: u64,
        planned: bool,
    },
    /// Dead; started again at this time.
    Waiting {
        until: u64,
    },
    Held,
    /// SIGTERM was sent by the end of the stack.
    Stopping {
        kill_at: u64,
    },
    /// SIGKILL was sent by the end of the stack, which waits for it no longer than until then.
    Leaving {
        until: u64,
    },
    Ended,
}

impl Phase {
    /// A process exists.
    pub fn alive(self) -> bool {
        matches!(
            self,
            Self::Starting
                | Self::Running
                | Self::Aborting { .. }
                | Self::Killed { .. }
                | Self::Restarting { .. }
                | Self::Stopping { .. }
                | Self::Leaving { .. }
        )
    }

    /// Word in `ps`.
    pub fn word(self) -> &'static str {
        match self {
            Self::Idle => "idle",
            Self::Starting => "starting",
            Self::Running => "running",
            Self::Aborting { .. } | Self::Killed { .. } => "hung",
            Self::Restarting { .. } | Self::Cleaning { .. } => "restarting",
            Self::Waiting { .. } => "back-off",
            Self::Held => "held",
            Self::Stopping { .. } | Self::Leaving { .. } => "stopping",
            Self::Ended => "ended",
        }
    }
}

/// A supervised service.
#[derive(Debug, Clone)]
pub struct Slot {
    pub name: String,
    pub rule: Rule,
    pub phase: Phase,
    /// 1 at the first start.
    pub generation: u32,
    /// When the present process was started.
    pub since: u64,
    /// When the present process reported ready; 0 = not yet.
    pub ready_at: u64,
    /// From when on its silence counts: its start until it is ready, then its last heartbeat.
    pub(super) silent_from: u64,
    /// Times of unplanned restarts within the budget's window.
    pub(super) recent: VecDeque<u64>,
    /// Deaths since it was last healthy.
    pub(super) row: u32,
    /// Starts in a row that ended before they were ready.
    pub(super) unready: u32,
}

impl Slot {
    pub(super) fn new(name: String, rule: Rule) -> Self {
        Self {
            name,
            rule,
            phase: Phase::Idle,
            generation: 0,
            since: 0,
            ready_at: 0,
            silent_from: 0,
            recent: VecDeque::new(),
            row: 0,
            unready: 0,
        }
    }

    /// Unplanned deaths since it was last healthy, or started by hand.
    pub fn deaths(&self) -> u32 {
        self.row
    }

    /// It dies again and again, too seldom to be held for it.
    pub fn unstable(&self) -> bool {
        self.row >= UNSTABLE_AFTER
    }

    /// It has been ready for long enough that its next death is a first one.
    pub(super) fn is_healthy(&self, now: u64) -> bool {
        self.ready_at > 0 && now.saturating_sub(self.ready_at) >= HEALTHY_NS.max(self.rule.within_ns)
    }

    /// A fresh budget.
    pub(super) fn forgive(&mut self) {
        self.row = 0;
        self.unready = 0;
        self.recent.clear();
    }
}
