//! What every key of a stack file means: one table for `dinrail explain`, the help of error messages and the JSON
//! schema for editors. A test compares it with the types that read the keys, so neither can have a key alone.

mod canopen;
mod fields;
mod gateway;
mod logic;
mod modbus_client;
mod serial;

pub use canopen::{CANOPEN_MASTER, CANOPEN_SLAVE};
pub use fields::{CAN, CAN_IO};
pub use gateway::{MODBUS_SERVER, RECORDER, REPLAY};
pub use logic::PLC;
pub use modbus_client::{MODBUS_CLIENT, MODBUS_GATEWAY};
pub use serial::SERIAL;

/// What a key takes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum ValueKind {
    /// true or false
    Bool,
    /// A whole number of this range.
    Int(i64, i64),
    /// Any number.
    Number,
    /// A text.
    Text,
    /// "10ms"
    Duration,
    /// "100MiB"
    Size,
    /// "500k"
    BitRate,
    /// "%IW3"
    Address,
    /// "127.0.0.1:502"
    Socket,
    /// "192.168.1.10"
    Ip,
    /// A path, from the stack file's folder on.
    File,
    /// Name of another service of this kind.
    Service(&'static str),
    /// One of these texts.
    Choice(&'static [&'static str]),
    /// A list of such values.
    List(&'static ValueKind),
    /// One of several forms.
    OneOf(&'static [ValueKind]),
    /// A table; its keys follow as `key.inner`.
    Table,
    /// A list of tables; their keys follow as `key[].inner`.
    Tables,
    /// A table of texts with free keys.
    Texts,
}

impl ValueKind {
    /// In words, with the unit.
    pub fn words(&self) -> String {
        match self {
            Self::Bool => "true or false".to_owned(),
            Self::Int(low, high) if *high == i64::MAX => format!("a whole number from {low} up"),
            Self::Int(low, high) => format!("a whole number from {low} to {high}"),
            Self::Number => "a number".to_owned(),
            Self::Text => "a text".to_owned(),
            Self::Duration => "a duration: number and unit ns, us, ms, s, min or h, e.g. \"10ms\"".to_owned(),
            Self::Size => "a size: bytes, or number and unit KiB, MiB, GiB, e.g. \"100MiB\"".to_owned(),
            Self::BitRate => "a bit rate in bit/s, e.g. \"500k\"".to_owned(),
            Self::Address => "a %-address, e.g. \"%IW3\" or \"%QX0.5\"".to_owned(),
            Self::Socket => "an address and a port, e.g. \"127.0.0.1:1502\"".to_owned(),
            Self::Ip => "an IP address, e.g. \"192.168.1.10\"".to_owned(),
            Self::File => "a path; relative ones start at the folder of the stack file".to_owned(),
            Self::Service("") => "the name of a service".to_owned(),
            Self::Service(kind) => format!("the name of a {kind} service"),
            Self::Choice(values) => {
                values.iter().map(|v| format!("\"{v}\"")).collect::<Vec<_>>().join(" or ")
            }
            Self::List(inner) => format!("a list, each element {}", inner.words()),
            Self::OneOf(forms) => forms.iter().map(ValueKind::words).collect::<Vec<_>>().join("; or "),
            Self::Table => "a table".to_owned(),
            Self::Tables => "a list of tables".to_owned(),
            Self::Texts => "a table of texts".to_owned(),
        }
    }
}

/// What holds when a key is absent.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Default {
    /// It must stand.
    Required,
    /// Nothing; the text says what that means.
    Absent(&'static str),
    /// This value, as it would be written.
    Is(&'static str),
}

/// Documentation of one key.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct KeyDoc {
    /// `tcp.port`; inner keys of lists as `map[].area`.
    pub key: &'static str,
    pub value: ValueKind,
    pub default: Default,
    /// One or two sentences.
    pub meaning: &'static str,
}

impl KeyDoc {
    /// Meaning, value and default in one line, for the help of an error.
    pub fn one_line(&self) -> String {
        format!("{} Takes {}; {}.", self.meaning, self.value.words(), self.default_words())
    }

    /// `default "10ms"`, `required`.
    pub fn default_words(&self) -> String {
        match self.default {
            Default::Required => "required".to_owned(),
            Default::Absent("") => "absent by default".to_owned(),
            Default::Absent(meaning) => format!("absent by default: {meaning}"),
            Default::Is(value) => format!("default {value}"),
        }
    }
}

/// A required key.
const fn need(key: &'static str, value: ValueKind, meaning: &'static str) -> KeyDoc {
    KeyDoc { key, value, default: Default::Required, meaning }
}

/// A key with a default value.
const fn with(key: &'static str, value: ValueKind, default: &'static str, meaning: &'static str) -> KeyDoc {
    KeyDoc { key, value, default: Default::Is(default), meaning }
}

/// A key that may be absent.
const fn may(key: &'static str, value: ValueKind, absent: &'static str, meaning: &'static str) -> KeyDoc {
    KeyDoc { key, value, default: Default::Absent(absent), meaning }
}

/// The documentation of a key by its path: `in[2].to` is found as `in[].to`.
pub fn find_key<'a>(keys: &'a [KeyDoc], path: &str) -> Option<&'a KeyDoc> {
    let path = general(path);
    keys.iter().find(|k| k.key == path)
}

/// `in[2].to` as `in[].to`.
pub fn general(path: &str) -> String {
    let mut out = String::with_capacity(path.len());
    let mut inside = false;
    for c in path.chars() {
        match c {
            '[' => {
                inside = true;
                out.push('[');
            }
            ']' => {
                inside = false;
                out.push(']');
            }
            _ if inside => {}
            c => out.push(c),
        }
    }
    // A list of plain values is documented as the list.
    if out.ends_with("[]") { out[..out.len() - 2].to_owned() } else { out }
}

#[allow(clippy::enum_glob_use, reason = "tables of one line a key")]
use ValueKind::*;

/// Keys of `[stack]`.
pub const STACK_DOCS: &[KeyDoc] = &[
    need(
        "name",
        Text,
        "Name of the stack: two stacks of one user run side by side when their names differ. 1 to 32 of a-z 0-9 _ -, beginning with a letter.",
    ),
    with("description", Text, "\"\"", "One sentence about the stack, shown by `check`."),
    with(
        "stop_timeout",
        Duration,
        "\"2s\"",
        "How long a service may take to end at `down` before it is killed.",
    ),
    with(
        "log_level",
        Choice(&["error", "warn", "info", "debug", "trace"]),
        "\"info\"",
        "What the services log; a service's own log_level goes before it.",
    ),
    may(
        "watchdog",
        File,
        "none is fed",
        "Hardware watchdog, e.g. \"/dev/watchdog\": fed only while every critical service is healthy, so that the machine restarts when one stays down.",
    ),
];

/// Keys that every `[[service]]` has; the launcher reads them.
pub const SERVICE_DOCS: &[KeyDoc] = &[
    need(
        "name",
        Text,
        "Name of the service; its topics, logs and messages carry it. 1 to 32 of a-z 0-9 _ -, beginning with a letter.",
    ),
    need("kind", Text, "What the service is; `dinrail explain` lists the kinds."),
    with(
        "restart",
        Table,
        "{ max = 5, within = \"10s\" }",
        "How often a service that died is started again. The first restart comes at once.",
    ),
    with(
        "restart.max",
        Int(0, u32::MAX as i64),
        "5",
        "Restarts allowed within `restart.within`, and failed starts in a row; 0 = it is never started again.",
    ),
    with("restart.within", Duration, "\"10s\"", "The time in which `restart.max` restarts are allowed."),
    with(
        "restart.backoff_first",
        Duration,
        "\"50ms\"",
        "Wait before the second restart since it was ready for a minute; doubled for each further one.",
    ),
    with("restart.backoff_max", Duration, "\"5s\"", "Longest wait before a restart."),
    with(
        "restart.on_exhausted",
        Choice(&["hold", "fail-stack"]),
        "\"hold\"",
        "What happens when the restarts are used up: the service stays down while its neighbours go on, or the whole stack stops with exit code 1.",
    ),
    with(
        "hang_timeout",
        Duration,
        "\"2s\"",
        "A ready service without a heartbeat for so long is killed and started again; at least 300ms.",
    ),
    with(
        "ready_timeout",
        Duration,
        "\"10s\"",
        "A service that is not ready so long after its start is killed and started again; at least 300ms.",
    ),
    may(
        "nice",
        Int(-20, 19),
        "that of the launcher",
        "Scheduling priority among normal processes: -20 gets most CPU, 19 least. Below 0 needs privilege.",
    ),
    may(
        "priority",
        Int(1, 99),
        "normal scheduling",
        "Real-time priority (SCHED_FIFO); runs before every normal process. Needs privilege (CAP_SYS_NICE or a limit RTPRIO).",
    ),
    with("cpus", List(&Int(0, 1023)), "[]", "CPUs the service may run on; [] = all."),
    may(
        "memory_limit",
        Size,
        "no limit",
        "Most memory the service may take for its data (RLIMIT_DATA), at least 16MiB; beyond it allocations fail and the service is started again. Shared memory of the rail does not count.",
    ),
    with(
        "critical",
        Bool,
        "true",
        "Whether the hardware watchdog (`stack.watchdog`) stops being fed when this service is down.",
    ),
    with("env", Texts, "{}", "Variables added to the environment of the service."),
    may(
        "log_level",
        Choice(&["error", "warn", "info", "debug", "trace"]),
        "that of [stack]",
        "What this service logs.",
    ),
    may(
        "exec",
        List(&Text),
        "",
        "Command line of a foreign program in place of a service of this executable. Not supported yet.",
    ),
];

#[cfg(test)]
mod tests;
