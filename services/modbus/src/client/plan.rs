//! From the stack file to lines, requests and ranges: every address and unit resolved, every mistake named.
//!
//! Reads of the same unit, table and period whose gaps are at most `max_gap` become one request of at most
//! `max_batch` registers. When the unit answers that request by exception 02 or 03, which gaps may cause, its ranges
//! are read one by one from then on ([`Batch::alone`]).

mod batches;
mod place;
mod ranges;
mod units;

use self::batches::{batches, overlaps};
use self::ranges::{plan_read, plan_write};
pub use self::units::find_unit;
use self::units::{own_target, plan_unit};
use super::config::{Config, MAX_READS, MAX_UNITS, MAX_WRITES, Mode, OnBad};
use super::line::UnitSettings;
use super::order::Order;
use crate::protocol::pdu::MAX_READ_WORDS;
use crate::server::Table;
use dinrail_iec::Addressing;
use ipc_types::Finding;
use ipc_types::units::Span;
use ipc_types::wiring::Area;
use std::net::SocketAddr;

/// Something wrong in the service's table.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Mistake {
    /// Path of the key: `read[2].to`.
    pub key: String,
    pub message: String,
    pub help: String,
}

impl Mistake {
    /// As `check` tells it.
    pub fn finding(&self, service: &str) -> Finding {
        Finding::error(service, &self.key, &self.message, &self.help)
    }
}

/// Where a line goes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Target {
    /// Through a serial service of the stack.
    Serial { service: String, ascii: bool },
    /// Modbus TCP.
    Tcp(SocketAddr),
    /// RTU frames on a TCP connection.
    RtuOverTcp(SocketAddr),
}

impl std::fmt::Display for Target {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Serial { service, ascii: false } => write!(f, "{service} (RTU)"),
            Self::Serial { service, ascii: true } => write!(f, "{service} (ASCII)"),
            Self::Tcp(address) => write!(f, "tcp://{address}"),
            Self::RtuOverTcp(address) => write!(f, "rtu-over-tcp://{address}"),
        }
    }
}

/// A unit on its line.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct UnitPlan {
    pub unit: u8,
    pub name: Option<String>,
    pub settings: UnitSettings,
}

/// A line with its units and requests.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LinePlan {
    pub target: Target,
    pub units: Vec<UnitPlan>,
    pub batches: Vec<Batch>,
}

/// A read request.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Batch {
    pub unit: u8,
    pub table: Table,
    pub at: u16,
    pub count: u16,
    pub period_ns: u64,
    /// Ranges in it: index of [`Plan::reads`], entries from the batch's begin.
    pub members: Vec<(usize, u16)>,
    /// Batches of the line to use instead when the unit does not like this one.
    pub alone: Vec<usize>,
    /// False: only after the batch that it is a part of was refused.
    pub enabled: bool,
}

/// What is read into %I.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ReadRange {
    /// Of its `[[service.read]]`.
    pub index: usize,
    pub line: usize,
    pub unit: u8,
    pub table: Table,
    pub at: u16,
    /// Bits or registers.
    pub count: u16,
    /// First byte of %I.
    pub byte: u32,
    /// A single bit.
    pub bit: Option<u8>,
    /// Bytes of %I.
    pub bytes: u32,
    /// Registers of a value: 1, 2, 4.
    pub group: usize,
    pub order: Order,
    pub period_ns: u64,
    pub timeout_ns: u64,
    pub on_bad: OnBad,
    pub status_byte: Option<u32>,
}

/// What is written from %Q or %M.
#[derive(Debug, Clone, PartialEq)]
pub struct WriteRange {
    pub index: usize,
    pub line: usize,
    pub unit: u8,
    pub table: Table,
    pub at: u16,
    pub count: u16,
    pub area: Area,
    pub byte: u32,
    /// First bit, for coils.
    pub bit: u8,
    pub bytes: u32,
    pub group: usize,
    pub order: Order,
    pub on_change: bool,
    pub period_ns: Option<u64>,
    pub multiple: bool,
    /// Values of the safe state as they go on the wire; `None`: nothing is written.
    pub safe: Option<Vec<u8>>,
}

/// Everything the service does.
#[derive(Debug, Clone, Default)]
pub struct Plan {
    pub lines: Vec<LinePlan>,
    pub reads: Vec<ReadRange>,
    pub writes: Vec<WriteRange>,
    /// Empty: the plan can run.
    pub mistakes: Vec<Mistake>,
}

impl Plan {
    fn wrong(&mut self, key: impl Into<String>, message: impl Into<String>, help: impl Into<String>) {
        self.mistakes.push(Mistake { key: key.into(), message: message.into(), help: help.into() });
    }
}

/// Resolves the table; its addresses count as those of the plc. Entries with a mistake are left out.
pub fn plan(config: &Config, addressing: Addressing) -> Plan {
    let mut plan = Plan::default();
    check_whole(config, &mut plan);
    if let Some(target) = own_target(config) {
        plan.lines.push(LinePlan { target, units: Vec::new(), batches: Vec::new() });
    }
    for (i, unit) in config.units.iter().take(MAX_UNITS).enumerate() {
        plan_unit(config, i, unit, &mut plan);
    }
    for (index, read) in config.reads.iter().take(MAX_READS).enumerate() {
        if let Some(range) = plan_read(config, addressing, index, read, &mut plan) {
            plan.reads.push(range);
        }
    }
    for (index, write) in config.writes.iter().take(MAX_WRITES).enumerate() {
        if let Some(range) = plan_write(config, addressing, index, write, &mut plan) {
            plan.writes.push(range);
        }
    }
    overlaps(&mut plan);
    for line in 0..plan.lines.len() {
        plan.lines[line].batches = batches(config, &plan.reads, line);
    }
    plan
}

fn check_whole(config: &Config, plan: &mut Plan) {
    let limits = [
        ("read", config.reads.len(), MAX_READS),
        ("write", config.writes.len(), MAX_WRITES),
        ("unit", config.units.len(), MAX_UNITS),
    ];
    for (what, count, limit) in limits {
        if count > limit {
            let message = format!("{count} entries: a modbus-client has at most {limit}");
            plan.wrong(what, message, "split them over two modbus-client services");
        }
    }
    match (&config.serial, config.tcp, config.mode) {
        (Some(_), Some(_), _) => {
            plan.wrong("tcp", "the service has a serial line and a connection", "remove serial or tcp");
        }
        (Some(_), None, Some(Mode::Tcp)) => {
            plan.wrong(
                "mode",
                "mode \"tcp\" is for connections",
                "use \"rtu\" or \"ascii\" on a serial line",
            );
        }
        (None, _, Some(Mode::Ascii)) => {
            let help = "use \"tcp\", or \"rtu\" for a converter that passes RTU frames on";
            plan.wrong("mode", "mode \"ascii\" is for serial lines", help);
        }
        (None, None, _) if config.units.iter().all(|unit| unit.tcp.is_none()) => {
            let help = "add serial = \"NAME\", or tcp = \"ADDRESS:502\"";
            plan.wrong("", "the service has no line: neither serial nor tcp", help);
        }
        _ => {}
    }
    let words = 1..=MAX_READ_WORDS;
    if !words.contains(&config.max_batch) {
        plan.wrong(
            "max_batch",
            format!("max_batch = {} is not 1 to 125", config.max_batch),
            "125 is the default",
        );
    }
    for (key, span) in [("response_timeout", config.response_timeout), ("probe_min", config.probe_min)] {
        if span < Span::from_ms(1) {
            plan.wrong(key, format!("{key} = {span} is too short"), "use at least 1ms; 1s is the default");
        }
    }
    if config.probe_max < config.probe_min {
        plan.wrong("probe_max", "probe_max is shorter than probe_min", "exchange them, or leave them out");
    }
}

#[cfg(test)]
#[path = "plan_tests.rs"]
mod tests;
