//! The launcher's own keys of a stack file: those of `[stack]` and those that every `[[service]]` has.

use ipc_types::units::{Size, Span};
use serde::Deserialize;
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::Duration;

/// Keys of a `[[service]]` table that are not passed on to the service.
pub const SERVICE_KEYS: [&str; 13] = [
    "name",
    "kind",
    "restart",
    "hang_timeout",
    "ready_timeout",
    "nice",
    "priority",
    "cpus",
    "memory_limit",
    "critical",
    "env",
    "log_level",
    "exec",
];

/// What happens when the restart budget of a service is used up.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum OnExhausted {
    /// The service stays down, its listeners are closed, its neighbours go on.
    #[default]
    Hold,
    /// The whole stack is stopped and `up` exits with 1.
    FailStack,
}

/// How often a service is started again. The first restart comes at once, the second after `backoff_first`, and
/// each further one after twice the time before it, at most `backoff_max`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Restart {
    /// Restarts allowed in `within`; 0 = never restarted.
    pub max: u32,
    pub within: Duration,
    pub backoff_first: Duration,
    pub backoff_max: Duration,
    pub on_exhausted: OnExhausted,
}

impl Default for Restart {
    fn default() -> Self {
        RestartTable::default().into()
    }
}

/// How the launcher runs one service.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LaunchOptions {
    pub restart: Restart,
    /// A ready service without a heartbeat for so long is killed and started again.
    pub hang_timeout: Duration,
    /// A service that is not ready so long after its start is killed and started again; key `ready_timeout`, for
    /// a plc's `start_timeout` is something else.
    pub start_timeout: Duration,
    /// -20 to 19.
    pub nice: Option<i32>,
    /// SCHED_FIFO priority, 1 to 99; key `priority`.
    pub fifo_priority: Option<u32>,
    /// CPUs it may run on; empty = all.
    pub cpus: Vec<u32>,
    /// Most memory of its own (address space without the rail is not told apart: RLIMIT_DATA).
    pub memory_limit: Option<Size>,
    /// `/dev/watchdog` is fed only while all critical services are healthy.
    pub critical: bool,
    /// Added to the environment of the process.
    pub env: BTreeMap<String, String>,
    /// Filter of its log: `error`, `warn`, `info`, `debug`, `trace`; of the service, else of `[stack]`.
    pub log_level: String,
}

impl Default for LaunchOptions {
    fn default() -> Self {
        LaunchTable::default().options(&StackTable::default().log_level)
    }
}

/// The `[stack]` table but for its name.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StackSettings {
    pub description: String,
    /// How long a service may take to end at `down` before it is killed.
    pub stop_timeout: Duration,
    /// The hardware watchdog that is fed while all critical services are healthy.
    pub watchdog: Option<PathBuf>,
}

impl Default for StackSettings {
    fn default() -> Self {
        StackTable::default().settings()
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum LogLevel {
    Error,
    Warn,
    #[default]
    Info,
    Debug,
    Trace,
}

impl LogLevel {
    fn text(self) -> &'static str {
        match self {
            Self::Error => "error",
            Self::Warn => "warn",
            Self::Info => "info",
            Self::Debug => "debug",
            Self::Trace => "trace",
        }
    }
}

/// `[stack]` as written.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct StackTable {
    pub name: String,
    pub description: String,
    pub stop_timeout: Span,
    pub log_level: LogLevel,
    pub watchdog: Option<PathBuf>,
}

impl Default for StackTable {
    fn default() -> Self {
        Self {
            name: String::new(),
            description: String::new(),
            stop_timeout: Span::from_ms(2000),
            log_level: LogLevel::Info,
            watchdog: None,
        }
    }
}

impl StackTable {
    pub fn settings(&self) -> StackSettings {
        StackSettings {
            description: self.description.clone(),
            stop_timeout: self.stop_timeout.duration(),
            watchdog: self.watchdog.clone(),
        }
    }
}

/// `restart = { ... }` as written.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct RestartTable {
    max: u32,
    within: Span,
    backoff_first: Span,
    backoff_max: Span,
    on_exhausted: OnExhausted,
}

impl Default for RestartTable {
    fn default() -> Self {
        Self {
            max: 5,
            within: Span::from_ms(10_000),
            backoff_first: Span::from_ms(50),
            backoff_max: Span::from_ms(5_000),
            on_exhausted: OnExhausted::Hold,
        }
    }
}

impl From<RestartTable> for Restart {
    fn from(table: RestartTable) -> Self {
        Self {
            max: table.max,
            within: table.within.duration(),
            backoff_first: table.backoff_first.duration(),
            backoff_max: table.backoff_max.duration(),
            on_exhausted: table.on_exhausted,
        }
    }
}

/// The launcher's keys of a `[[service]]` as written, without name and kind.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(super) struct LaunchTable {
    restart: RestartTable,
    hang_timeout: Span,
    ready_timeout: Span,
    nice: Option<i32>,
    priority: Option<u32>,
    cpus: Vec<u32>,
    memory_limit: Option<Size>,
    critical: bool,
    env: BTreeMap<String, String>,
    log_level: Option<LogLevel>,
}

impl Default for LaunchTable {
    fn default() -> Self {
        Self {
            restart: RestartTable::default(),
            hang_timeout: Span::from_ms(2000),
            ready_timeout: Span::from_ms(10_000),
            nice: None,
            priority: None,
            cpus: Vec::new(),
            memory_limit: None,
            critical: true,
            env: BTreeMap::new(),
            log_level: None,
        }
    }
}

/// Shortest `hang_timeout`: services beat every 100 ms.
const HANG_MIN: Span = Span::from_ms(300);
/// Below this a service cannot even start.
const MEMORY_MIN: u64 = 16 << 20;
/// CPUs that a Linux affinity mask of the usual size can name.
const CPU_MAX: u32 = 1023;

impl LaunchTable {
    /// What is wrong with the values: key, message, help.
    pub fn faults(&self) -> Vec<(&'static str, String, &'static str)> {
        let mut list = Vec::new();
        if let Some(nice) = self.nice.filter(|n| !(-20..=19).contains(n)) {
            list.push(("nice", format!("nice {nice} is out of range"), "write -20 (most CPU) to 19 (least)"));
        }
        if let Some(priority) = self.priority.filter(|p| !(1..=99).contains(p)) {
            list.push((
                "priority",
                format!("priority {priority} is out of range"),
                "SCHED_FIFO has 1 (lowest) to 99 (highest); leave the key out for normal scheduling",
            ));
        }
        if let Some(cpu) = self.cpus.iter().find(|&&c| c > CPU_MAX) {
            list.push(("cpus", format!("there is no CPU {cpu}"), "CPUs count from 0 to 1023"));
        }
        if self.hang_timeout < HANG_MIN {
            list.push((
                "hang_timeout",
                format!("hang_timeout {} is too short", self.hang_timeout),
                "services beat every 100 ms; allow at least \"300ms\"",
            ));
        }
        if self.ready_timeout < HANG_MIN {
            list.push((
                "ready_timeout",
                format!("ready_timeout {} is too short", self.ready_timeout),
                "allow at least \"300ms\"",
            ));
        }
        if let Some(limit) = self.memory_limit.filter(|l| l.0 < MEMORY_MIN) {
            list.push((
                "memory_limit",
                format!("memory_limit {limit} is too small for any service"),
                "allow at least \"16MiB\"",
            ));
        }
        if self.restart.within.ns() == 0 {
            list.push(("restart.within", "restart.within is 0".to_owned(), "write e.g. within = \"10s\""));
        }
        if self.restart.backoff_first > self.restart.backoff_max {
            list.push((
                "restart.backoff_first",
                format!(
                    "restart.backoff_first {} is longer than restart.backoff_max {}",
                    self.restart.backoff_first, self.restart.backoff_max
                ),
                "the time between restarts grows from backoff_first to backoff_max",
            ));
        }
        if let Some((name, _)) =
            self.env.iter().find(|(n, v)| n.is_empty() || n.contains(['=', '\0']) || v.contains('\0'))
        {
            list.push((
                "env",
                format!("'{}' is no environment variable", name.escape_default()),
                "names have no '=', neither name nor value a NUL",
            ));
        }
        list
    }

    /// With the log level of the stack where the service has none.
    pub fn options(&self, stack_level: &LogLevel) -> LaunchOptions {
        LaunchOptions {
            restart: self.restart.clone().into(),
            hang_timeout: self.hang_timeout.duration(),
            start_timeout: self.ready_timeout.duration(),
            nice: self.nice,
            fifo_priority: self.priority,
            cpus: self.cpus.clone(),
            memory_limit: self.memory_limit,
            critical: self.critical,
            env: self.env.clone(),
            log_level: self.log_level.unwrap_or(*stack_level).text().to_owned(),
        }
    }
}
