//! What a line is told and what it tells.

use super::MAX_JOBS;
use crate::protocol::pdu::MAX_PDU;

/// What is true for the whole line.
#[derive(Debug, Clone, Copy)]
pub struct Settings {
    /// Answers have no transaction number: a serial line.
    pub serial: bool,
    /// Unit 0 is a broadcast: nobody answers, and this long nothing is sent behind it. `None`: unit 0 is a unit.
    pub turnaround_ns: Option<u64>,
    /// A request that is not sent after this time has failed.
    pub send_limit_ns: u64,
}

/// What is true for a unit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct UnitSettings {
    /// From the end of the request to the end of the answer.
    pub response_timeout_ns: u64,
    /// Repetitions after the first try.
    pub retries: u8,
    /// First interval between tries of a dead unit; doubled each time.
    pub probe_min_ns: u64,
    /// Largest one.
    pub probe_max_ns: u64,
}

impl Default for UnitSettings {
    fn default() -> Self {
        Self {
            response_timeout_ns: 1_000_000_000,
            retries: 1,
            probe_min_ns: 1_000_000_000,
            probe_max_ns: 60_000_000_000,
        }
    }
}

/// What a slot is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SlotKind {
    /// Sent every period.
    Read,
    /// Sent when it was set ([`Line::set_write`]), before reads.
    Write,
}

/// Who asked.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Origin {
    /// Number from [`Line::add_slot`].
    Slot(usize),
    /// Number given to [`Line::push_job`].
    Job(u64),
}

/// Why a request got no answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Failure {
    /// Not in time, also when repeated.
    NoAnswer,
    /// Not tried: the unit did not answer lately and its next try is not due.
    UnitDown,
    /// The port or the connection does not work.
    Link,
    /// Nobody waits any more.
    Expired,
    /// An answer came that cannot be the one to this request.
    Mismatch,
}

/// What the owner of the line has to do.
#[derive(Debug, PartialEq, Eq)]
pub enum Step<'a> {
    /// Send this; then say [`Line::sent`] or [`Line::link_failed`].
    Send { unit: u8, pdu: &'a [u8], origin: Origin },
    /// A request has ended: answer PDU (exceptions too; empty for a broadcast) or failure.
    Done { origin: Origin, unit: u8, result: Result<&'a [u8], Failure> },
    /// Drop the connection: an answer may still come on it.
    Reset,
    /// Nothing before this time, unless something happens.
    Wait(Option<u64>),
}

/// Why a job is not taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("{MAX_JOBS} requests wait for the line already; ask again later")]
pub struct QueueFull;

/// State of a unit in words.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum UnitState {
    /// Not asked yet.
    Unknown,
    Ok,
    /// The last try was not answered.
    Failing,
    /// Left alone between tries.
    Dead,
    /// The port or connection does not work; only [`UnitView`] says so.
    #[serde(rename = "no connection")]
    NoConnection,
}

/// Counters of a unit.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, serde::Serialize)]
pub struct UnitCounters {
    /// Requests sent, repetitions too.
    pub requests: u64,
    /// Answers that fitted, exceptions too.
    pub answers: u64,
    pub exceptions: u64,
    pub timeouts: u64,
    pub retries: u64,
    /// Answers that did not fit the request in flight.
    pub discarded: u64,
}

/// A unit that has gone dead or come back.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct UnitNews {
    pub unit: u8,
    pub dead: bool,
    /// A gateway says that it does not reach the unit, by this exception.
    pub by_gateway: Option<u8>,
}

/// A unit as the status shows it.
#[derive(Debug, Clone, Copy)]
pub struct UnitView {
    pub unit: u8,
    pub state: UnitState,
    pub counters: UnitCounters,
    /// Code of the last exception, and function of the request that it answered.
    pub last_exception: Option<(u8, u8)>,
    pub last_rtt_ns: Option<u64>,
    pub max_rtt_ns: u64,
}

/// Counters of a line.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, serde::Serialize)]
pub struct LineCounters {
    /// Frames of units that were not asked, or with nothing in flight.
    pub late: u64,
    /// Frames that are none: CRC, LRC, line errors.
    pub garbage: u64,
    pub link_failures: u64,
    /// Periods of reads that passed without a turn.
    pub missed_periods: u64,
}

#[derive(Clone, Copy)]
pub(super) struct Pdu {
    bytes: [u8; MAX_PDU],
    len: u8,
}

impl Pdu {
    pub(super) fn new(pdu: &[u8]) -> Self {
        let mut bytes = [0; MAX_PDU];
        let len = pdu.len().min(MAX_PDU);
        bytes[..len].copy_from_slice(&pdu[..len]);
        Self { bytes, len: len as u8 }
    }
    pub(super) fn get(&self) -> &[u8] {
        &self.bytes[..usize::from(self.len)]
    }
    /// Whether a late answer to `self` would be taken for one to `other`; the same request counts only if `same`.
    pub(super) fn confusable(&self, other: &[u8], same: bool) -> bool {
        // The answer to a read tells the quantity only, and an exception nothing but the function.
        self.get().first() == other.first() && (same || self.get() != other)
    }
}
