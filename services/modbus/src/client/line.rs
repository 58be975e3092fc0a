//! The master's side of one line: which request goes out next, and what becomes of it.
//!
//! Virtual time in, steps out. A line is a serial port with its units, or one TCP connection. Never more than one
//! request is in flight. Order: writes first, then jobs and due reads in turns, so that neither starves.
//!
//! A unit that does not answer [`DEAD_AFTER`] times in a row, or of which a gateway says so (exceptions 0A, 0B), is left
//! alone for growing intervals ("dead"), so that it costs the others little: after a try that took `cost` of line time
//! the next one comes after at least [`PROBE_SHARE`] times `cost`, as long as another unit is alive. Fewer failures cost
//! their own time and nothing else. While a request is being repeated, the others have their turn, and nothing else is
//! sent to the silent unit.
//!
//! Late answers: on a serial line an answer has no number. What does not fit the request in flight (unit, function,
//! byte count, echoed values) is discarded. After a timeout a request that the late answer would fit as well is held
//! back until the unit can be expected to have finished. On a connection the owner drops it ([`Step::Reset`]).
//!
//! Nothing in here allocates after [`Line::new`], but the queue of jobs when it grows for the first time.

use crate::protocol::client_fit::{Fit, fit};
use std::collections::VecDeque;

mod outcome;
mod schedule;
mod types;
mod unit;

use types::Pdu;
pub use types::{
    Failure, LineCounters, Origin, QueueFull, Settings, SlotKind, Step, UnitCounters, UnitNews, UnitSettings,
    UnitState, UnitView,
};
use unit::Unit;

/// Most jobs that wait for a line.
pub const MAX_JOBS: usize = 64;
/// A unit counts as dead when it has not answered so many tries in a row, repetitions counted, and the last request
/// is given up: one lost answer is no reason to leave it alone.
pub const DEAD_AFTER: u32 = 3;
/// A dead unit is tried again after this many times the line time that its last failure took.
pub const PROBE_SHARE: u64 = 25;
/// Longest interval between tries of a unit that has the line for itself.
pub const LONE_PROBE_NS: u64 = 5_000_000_000;
/// Writes after which a due read has its turn.
const WRITES_IN_A_ROW: u32 = 8;
/// Shortest and longest pause after the port or connection failed.
const LINK_PAUSE_NS: (u64, u64) = (100_000_000, 5_000_000_000);

/// Whether a gateway says by this exception that it does not reach the unit: then the unit has not answered.
fn is_of_gateway(exception: Option<u8>) -> bool {
    use crate::protocol::pdu::Exception::{GatewayPathUnavailable, GatewayTargetFailedToRespond};
    let codes = [GatewayPathUnavailable.code(), GatewayTargetFailedToRespond.code()];
    exception.is_some_and(|code| codes.contains(&code))
}

struct Slot {
    unit: usize,
    kind: SlotKind,
    pdu: Pdu,
    period_ns: Option<u64>,
    /// Read: when. Write: since when it waits. `None`: not now.
    due_ns: Option<u64>,
    /// What a write carried when it went out is not what it carries now.
    changed: bool,
    tries: u8,
    enabled: bool,
}

struct Job {
    id: u64,
    unit: usize,
    pdu: Pdu,
    deadline_ns: u64,
    fail_fast: bool,
    tries: u8,
}

enum Phase {
    Sending,
    Waiting,
    Turnaround,
}

struct Flight {
    origin: Origin,
    unit: usize,
    pdu: Pdu,
    phase: Phase,
    begun_ns: u64,
    sent_ns: u64,
    until_ns: u64,
    /// Bytes came that were no frame: most likely the answer, so none is to come late.
    damaged: bool,
}

enum Ended {
    Answer(usize),
    Failed(Failure),
}

/// See the module.
pub struct Line {
    settings: Settings,
    default_unit: UnitSettings,
    units: Vec<Unit>,
    index: [u16; 256],
    slots: Vec<Slot>,
    jobs: VecDeque<Job>,
    flight: Option<Flight>,
    ended: Option<(Origin, usize, Ended)>,
    answer: [u8; 256],
    reset: bool,
    link_until_ns: u64,
    link_level: u32,
    /// The port or connection did not work when it was last used.
    link_down: bool,
    /// A unit has gone dead or come back.
    news: bool,
    writes_in_a_row: u32,
    job_had_turn: bool,
    counters: LineCounters,
}

impl Line {
    /// A line without slots. `default_unit` is for units that only jobs name.
    pub fn new(settings: Settings, default_unit: UnitSettings) -> Self {
        Self {
            settings,
            default_unit,
            units: Vec::new(),
            index: [u16::MAX; 256],
            slots: Vec::new(),
            jobs: VecDeque::with_capacity(MAX_JOBS),
            flight: None,
            ended: None,
            answer: [0; 256],
            reset: false,
            link_until_ns: 0,
            link_level: 0,
            link_down: false,
            news: false,
            writes_in_a_row: 0,
            job_had_turn: false,
            counters: LineCounters::default(),
        }
    }

    /// Sets what is true for a unit; before its first request.
    pub fn set_unit(&mut self, unit: u8, settings: UnitSettings) {
        let i = self.unit_index(unit);
        self.units[i].settings = settings;
    }

    /// Adds a read (due at once, then every `period_ns`, 0 = as often as possible) or a write. Its number.
    pub fn add_slot(&mut self, unit: u8, kind: SlotKind, pdu: &[u8], period_ns: Option<u64>) -> usize {
        let unit = self.unit_index(unit);
        let due_ns = (kind == SlotKind::Read).then_some(0);
        let pdu = Pdu::new(pdu);
        self.slots.push(Slot { unit, kind, pdu, period_ns, due_ns, changed: false, tries: 0, enabled: true });
        self.slots.len() - 1
    }

    /// Takes a slot out of the schedule or puts it back.
    pub fn enable(&mut self, slot: usize, enabled: bool, now_ns: u64) {
        self.forget_retry(Origin::Slot(slot));
        if let Some(slot) = self.slots.get_mut(slot) {
            slot.enabled = enabled;
            slot.due_ns = (enabled && slot.kind == SlotKind::Read).then_some(now_ns);
        }
    }

    /// The newest value of a write: it waits for its turn; what waited before is replaced.
    pub fn set_write(&mut self, slot: usize, pdu: &[u8], now_ns: u64) {
        if let Some(slot) = self.slots.get_mut(slot) {
            slot.pdu = Pdu::new(pdu);
            slot.changed = true;
            slot.due_ns = Some(slot.due_ns.map_or(now_ns, |due_ns| due_ns.min(now_ns)));
        }
    }

    /// Forgets a write that waits. What is in flight goes on.
    pub fn drop_write(&mut self, slot: usize) {
        if self.flight.as_ref().is_none_or(|f| f.origin != Origin::Slot(slot)) {
            self.forget_retry(Origin::Slot(slot));
        }
        if let Some(slot) = self.slots.get_mut(slot) {
            slot.due_ns = None;
            slot.changed = false;
        }
    }

    /// Whether a write waits or is under way.
    pub fn is_waiting(&self, slot: usize) -> bool {
        self.slots.get(slot).is_some_and(|s| s.due_ns.is_some())
            || self.flight.as_ref().is_some_and(|f| f.origin == Origin::Slot(slot))
    }

    /// One request for whoever asks; it ends by [`Step::Done`], in any case. `fail_fast`: a unit known to be dead
    /// is not tried before its time.
    pub fn push_job(
        &mut self,
        id: u64,
        unit: u8,
        pdu: &[u8],
        deadline_ns: u64,
        fail_fast: bool,
    ) -> Result<(), QueueFull> {
        if self.jobs.len() >= MAX_JOBS {
            return Err(QueueFull);
        }
        let unit = self.unit_index(unit);
        self.jobs.push_back(Job { id, unit, pdu: Pdu::new(pdu), deadline_ns, fail_fast, tries: 0 });
        Ok(())
    }

    /// Forgets a job that has not been sent; it ends without a [`Step::Done`]. `false`: it is in flight or over.
    pub fn cancel(&mut self, id: u64) -> bool {
        let origin = Origin::Job(id);
        if self.flight.as_ref().is_some_and(|f| f.origin == origin) {
            return false;
        }
        let Some(at) = self.jobs.iter().position(|job| job.id == id) else { return false };
        if self.ended.as_ref().is_some_and(|(ended, ..)| *ended == origin) {
            return false;
        }
        self.forget_retry(origin);
        self.jobs.remove(at);
        true
    }

    /// Jobs that wait.
    pub fn jobs(&self) -> usize {
        self.jobs.len()
    }

    /// Whether a request is in flight.
    pub fn is_busy(&self) -> bool {
        self.flight.is_some()
    }

    /// The units that were ever named.
    pub fn units(&self) -> impl Iterator<Item = UnitView> + '_ {
        self.units.iter().map(|u| UnitView {
            unit: u.number,
            state: if self.link_down { UnitState::NoConnection } else { u.state },
            counters: u.counters,
            last_exception: u.last_exception,
            last_rtt_ns: u.last_rtt_ns,
            max_rtt_ns: u.max_rtt_ns,
        })
    }

    /// A unit that has gone dead or come back since it was last told of; to be called until `None`.
    pub fn unit_news(&mut self) -> Option<UnitNews> {
        if !self.news {
            return None;
        }
        for unit in &mut self.units {
            let dead = unit.state == UnitState::Dead;
            if unit.told_dead != dead {
                unit.told_dead = dead;
                let by_gateway = unit.last_exception.filter(|_| unit.by_gateway).map(|(code, _)| code);
                return Some(UnitNews { unit: unit.number, dead, by_gateway });
            }
        }
        self.news = false;
        None
    }

    /// Whether the port or connection did not work when it was last used.
    pub fn is_link_down(&self) -> bool {
        self.link_down
    }

    /// State of a unit, whatever the port or connection does.
    pub fn unit_state(&self, unit: u8) -> UnitState {
        self.units.get(usize::from(self.index[usize::from(unit)])).map_or(UnitState::Unknown, |u| u.state)
    }

    pub fn counters(&self) -> LineCounters {
        self.counters
    }

    fn unit_index(&mut self, unit: u8) -> usize {
        let known = usize::from(self.index[usize::from(unit)]);
        if known < self.units.len() {
            return known;
        }
        self.index[usize::from(unit)] = self.units.len() as u16;
        self.units.push(Unit::new(unit, self.default_unit));
        self.units.len() - 1
    }

    /// The request in flight is on the line, whole. The response timeout counts from here.
    pub fn sent(&mut self, now_ns: u64) {
        let Some(flight) = &mut self.flight else { return };
        if !matches!(flight.phase, Phase::Sending) {
            return;
        }
        flight.sent_ns = now_ns;
        self.link_down = false;
        let unit = &self.units[flight.unit];
        match self.settings.turnaround_ns.filter(|_| unit.number == 0) {
            Some(turnaround_ns) => {
                flight.phase = Phase::Turnaround;
                flight.until_ns = now_ns.saturating_add(turnaround_ns);
            }
            None => {
                flight.phase = Phase::Waiting;
                flight.until_ns = now_ns.saturating_add(unit.settings.response_timeout_ns);
            }
        }
    }

    /// A frame came from the line, or the answer with the right transaction number from the connection.
    pub fn answer(&mut self, unit: u8, pdu: &[u8], now_ns: u64) {
        let Some(flight) = &self.flight else {
            self.late(unit, pdu);
            return;
        };
        let asked = &mut self.units[flight.unit];
        // Before the request has left, nobody can have answered it: a copy of an earlier answer.
        let awaited = match flight.phase {
            Phase::Waiting => true,
            Phase::Sending => !self.settings.serial,
            Phase::Turnaround => false,
        };
        let fitting = if asked.number == unit && awaited { fit(flight.pdu.get(), pdu) } else { Fit::No };
        match fitting {
            Fit::No if self.settings.serial => {
                if asked.number == unit {
                    asked.discarded(pdu);
                } else {
                    self.late(unit, pdu);
                }
                return;
            }
            Fit::No => {
                asked.counters.discarded += 1;
                self.reset = true;
                self.fail(Failure::Mismatch, now_ns);
                return;
            }
            Fit::Answer => {}
            Fit::Exception(code) => {
                asked.counters.exceptions += 1;
                asked.last_exception = Some((code, flight.pdu.get().first().copied().unwrap_or(0)));
            }
        }
        let exception = match fitting {
            Fit::Exception(code) => Some(code),
            _ => None,
        };
        if is_of_gateway(exception) && matches!(flight.origin, Origin::Slot(_)) {
            return self.unreachable(now_ns);
        }
        let len = pdu.len().min(self.answer.len());
        self.answer[..len].copy_from_slice(&pdu[..len]);
        self.succeed(len, exception, now_ns);
    }

    fn late(&mut self, unit: u8, pdu: &[u8]) {
        self.counters.late += 1;
        let i = usize::from(self.index[usize::from(unit)]);
        if let Some(unit) = self.units.get_mut(i) {
            unit.discarded(pdu);
        }
    }

    /// Bytes came that are no frame.
    pub fn garbage(&mut self) {
        self.counters.garbage += 1;
        if let Some(flight) = self.flight.as_mut().filter(|f| matches!(f.phase, Phase::Waiting)) {
            flight.damaged = true;
        }
    }

    /// What to do now. To be called again until it says [`Step::Wait`], after everything that happened.
    pub fn step(&mut self, now_ns: u64) -> Step<'_> {
        self.expire(now_ns);
        if self.reset {
            self.reset = false;
            return Step::Reset;
        }
        if self.ended.is_none() {
            self.jobs_that_fail(now_ns);
        }
        if let Some((origin, unit, ended)) = self.ended.take() {
            if let Origin::Job(id) = origin
                && self.jobs.front().is_some_and(|job| job.id == id)
            {
                self.jobs.pop_front();
            }
            let unit = self.units[unit].number;
            let result = match ended {
                Ended::Answer(len) => Ok(&self.answer[..len]),
                Ended::Failed(failure) => Err(failure),
            };
            return Step::Done { origin, unit, result };
        }
        if let Some(flight) = &self.flight {
            return Step::Wait(Some(flight.until_ns));
        }
        if now_ns < self.link_until_ns {
            return Step::Wait(Some(self.link_until_ns));
        }
        match self.choose(now_ns) {
            Ok(origin) => self.send(origin, now_ns),
            Err(next_ns) => Step::Wait(next_ns),
        }
    }
}

#[cfg(test)]
#[path = "line_tests.rs"]
mod tests;
