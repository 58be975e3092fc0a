//! The master's side of one line: which request goes out next, and what becomes of it.
//!
//! Virtual time in, steps out. A line is a serial port with its units, or one TCP connection. Never more than one
//! request is in flight. Order: writes first, then jobs and due reads in turns, so that neither starves.
//!
//! A unit that does not answer is left alone for growing intervals ("dead"), so that it costs the others little:
//! after a failure that took `cost` of line time the next try comes after at least [`PROBE_SHARE`] times `cost`, as
//! long as another unit is alive. While a request is being repeated, the others have their turn, and nothing else is
//! sent to the silent unit.
//!
//! Late answers: on a serial line an answer has no number. What does not fit the request in flight (unit, function,
//! byte count, echoed values) is discarded. After a timeout a request that the late answer would fit as well is held
//! back until the unit can be expected to have finished. On a connection the owner drops it ([`Step::Reset`]).
//!
//! Nothing in here allocates after [`Line::new`], but the queue of jobs when it grows for the first time.

use crate::protocol::client_fit::{Fit, fit};
use std::collections::VecDeque;

mod types;

use types::Pdu;
pub use types::{
    Failure, LineCounters, Origin, QueueFull, Settings, SlotKind, Step, UnitCounters, UnitSettings,
    UnitState, UnitView,
};

/// Most jobs that wait for a line.
pub const MAX_JOBS: usize = 64;
/// A dead unit is tried again after this many times the line time that its last failure took.
pub const PROBE_SHARE: u64 = 25;
/// Longest interval between tries of a unit that has the line for itself.
pub const LONE_PROBE_NS: u64 = 5_000_000_000;
/// Writes after which a due read has its turn.
const WRITES_IN_A_ROW: u32 = 8;
/// Shortest and longest pause after the port or connection failed.
const LINK_PAUSE_NS: (u64, u64) = (100_000_000, 5_000_000_000);

struct Unit {
    number: u8,
    settings: UnitSettings,
    state: UnitState,
    /// The request that is being repeated: nothing else goes to the unit.
    retrying: Option<Origin>,
    failed_ns: u64,
    level: u32,
    /// Line time of the tries since the unit was last well, of the last failure when dead.
    cost_ns: u64,
    /// Requests whose late answers may still come.
    suspects: [Suspect; SUSPECTS],
    counters: UnitCounters,
    last_exception: Option<u8>,
    last_rtt_ns: Option<u64>,
    max_rtt_ns: u64,
}

/// Requests of a unit that are remembered because of their late answers.
const SUSPECTS: usize = 4;

#[derive(Clone, Copy)]
struct Suspect {
    pdu: Pdu,
    until_ns: u64,
    /// Answers that may still come.
    outstanding: u8,
    /// A repetition was answered, by whichever answer: not even the same request goes out before the other one came.
    answered: bool,
}

impl Unit {
    /// A request was given up; its answer may come until then.
    fn suspect(&mut self, pdu: &Pdu, now_ns: u64, until_ns: u64) {
        let known = self.suspects.iter().position(|s| s.is_active(now_ns) && s.pdu.get() == pdu.get());
        let at = known.unwrap_or_else(|| {
            (0..SUSPECTS)
                .min_by_key(|&i| (self.suspects[i].outstanding > 0, self.suspects[i].until_ns))
                .unwrap_or(0)
        });
        let outstanding = if known.is_some() { self.suspects[at].outstanding.saturating_add(1) } else { 1 };
        self.suspects[at] = Suspect { pdu: *pdu, until_ns, outstanding, answered: false };
    }

    /// A frame was discarded: if it is a late answer, that one has come.
    fn discarded(&mut self, answer: &[u8]) {
        self.counters.discarded += 1;
        let late = |s: &&mut Suspect| s.outstanding > 0 && fit(s.pdu.get(), answer) != Fit::No;
        if let Some(suspect) = self.suspects.iter_mut().find(late) {
            suspect.outstanding -= 1;
        }
    }

    /// A repeated request was answered, perhaps by the late answer to an earlier try: then its own is still to come.
    fn answered(&mut self, pdu: &Pdu, now_ns: u64, until_ns: u64) {
        for suspect in self.suspects.iter_mut().filter(|s| s.is_active(now_ns) && s.pdu.get() == pdu.get()) {
            suspect.until_ns = suspect.until_ns.max(until_ns);
            suspect.answered = true;
        }
    }
}

impl Suspect {
    fn is_active(&self, now_ns: u64) -> bool {
        self.outstanding > 0 && self.until_ns > now_ns
    }
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
            slot.due_ns.get_or_insert(now_ns);
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
            state: u.state,
            counters: u.counters,
            last_exception: u.last_exception,
            last_rtt_ns: u.last_rtt_ns,
            max_rtt_ns: u.max_rtt_ns,
        })
    }

    /// State of a unit.
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
        self.units.push(Unit {
            number: unit,
            settings: self.default_unit,
            state: UnitState::Unknown,
            retrying: None,
            failed_ns: 0,
            level: 0,
            cost_ns: 0,
            suspects: [Suspect { pdu: Pdu::new(&[]), until_ns: 0, outstanding: 0, answered: false };
                SUSPECTS],
            counters: UnitCounters::default(),
            last_exception: None,
            last_rtt_ns: None,
            max_rtt_ns: 0,
        });
        self.units.len() - 1
    }

    /// The request in flight is on the line, whole. The response timeout counts from here.
    pub fn sent(&mut self, now_ns: u64) {
        let Some(flight) = &mut self.flight else { return };
        if !matches!(flight.phase, Phase::Sending) {
            return;
        }
        flight.sent_ns = now_ns;
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
                asked.last_exception = Some(code);
            }
        }
        let len = pdu.len().min(self.answer.len());
        self.answer[..len].copy_from_slice(&pdu[..len]);
        self.succeed(len, now_ns);
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

    /// The port or connection does not work: what is in flight fails, and nothing is sent for a while.
    pub fn link_failed(&mut self, now_ns: u64) {
        self.counters.link_failures += 1;
        let pause = (LINK_PAUSE_NS.0 << self.link_level.min(10)).min(LINK_PAUSE_NS.1);
        self.link_level += 1;
        self.link_until_ns = now_ns.saturating_add(pause);
        if let Some(flight) = self.flight.take() {
            self.forget_retry(flight.origin);
            self.rest(flight.origin, now_ns);
            self.ended = Some((flight.origin, flight.unit, Ended::Failed(Failure::Link)));
        }
    }

    fn forget_retry(&mut self, origin: Origin) {
        for unit in &mut self.units {
            if unit.retrying == Some(origin) {
                unit.retrying = None;
            }
        }
        if let Origin::Slot(i) = origin
            && let Some(slot) = self.slots.get_mut(i)
        {
            slot.tries = 0;
        }
    }

    fn succeed(&mut self, len: usize, now_ns: u64) {
        let Some(flight) = self.flight.take() else { return };
        let rtt_ns = now_ns.saturating_sub(flight.sent_ns.max(flight.begun_ns));
        let unit = &mut self.units[flight.unit];
        let timeout_ns = unit.settings.response_timeout_ns;
        unit.answered(&flight.pdu, now_ns, flight.sent_ns.saturating_add(2 * timeout_ns));
        let was_dead = unit.state == UnitState::Dead;
        unit.state = UnitState::Ok;
        (unit.level, unit.cost_ns) = (0, 0);
        unit.counters.answers += 1;
        unit.last_rtt_ns = Some(rtt_ns);
        unit.max_rtt_ns = unit.max_rtt_ns.max(rtt_ns);
        self.link_level = 0;
        self.forget_retry(flight.origin);
        self.rest(flight.origin, now_ns);
        if was_dead {
            for slot in self.slots.iter_mut().filter(|s| s.unit == flight.unit && s.enabled) {
                if slot.kind == SlotKind::Read && slot.due_ns.is_none_or(|due_ns| due_ns > now_ns) {
                    slot.due_ns = Some(now_ns);
                }
            }
        }
        self.ended = Some((flight.origin, flight.unit, Ended::Answer(len)));
    }

    /// Puts a slot back into the schedule after its turn, whatever came of it.
    fn rest(&mut self, origin: Origin, now_ns: u64) {
        let Origin::Slot(i) = origin else { return };
        let slot = &mut self.slots[i];
        match slot.kind {
            SlotKind::Read => {
                let period_ns = slot.period_ns.unwrap_or(0);
                let planned = slot.due_ns.unwrap_or(now_ns).saturating_add(period_ns);
                slot.due_ns = Some(planned.max(now_ns));
                if planned < now_ns && period_ns > 0 {
                    self.counters.missed_periods += (now_ns - planned) / period_ns;
                }
            }
            SlotKind::Write => {
                if slot.changed {
                    slot.due_ns = Some(now_ns);
                } else {
                    slot.due_ns = None;
                }
            }
        }
    }

    /// The try in flight has failed: repeated, or told.
    fn fail(&mut self, failure: Failure, now_ns: u64) {
        let Some(flight) = self.flight.take() else { return };
        let spent_ns = now_ns.saturating_sub(flight.begun_ns);
        let unit = &mut self.units[flight.unit];
        unit.counters.timeouts += u64::from(failure == Failure::NoAnswer);
        let was_dead = unit.state == UnitState::Dead;
        unit.cost_ns = if was_dead { spent_ns } else { unit.cost_ns.saturating_add(spent_ns) };
        if self.settings.serial && failure == Failure::NoAnswer && !flight.damaged {
            let until_ns = now_ns.saturating_add(unit.settings.response_timeout_ns);
            unit.suspect(&flight.pdu, now_ns, until_ns);
        }
        let retries = if was_dead { 0 } else { unit.settings.retries };
        let tries = match flight.origin {
            Origin::Slot(i) => {
                self.slots[i].tries += 1;
                self.slots[i].tries
            }
            // Jobs in flight stand first in the queue.
            Origin::Job(_) => self.jobs.front_mut().map_or(u8::MAX, |job| {
                job.tries += 1;
                job.tries
            }),
        };
        if tries <= retries {
            unit.state = UnitState::Failing;
            unit.retrying = Some(flight.origin);
            if let Origin::Slot(i) = flight.origin
                && self.slots[i].due_ns.is_some()
            {
                // Behind those that are due already.
                self.slots[i].due_ns = Some(now_ns);
            }
            return;
        }
        unit.state = UnitState::Dead;
        unit.failed_ns = now_ns;
        unit.level = unit.level.saturating_add(1);
        self.forget_retry(flight.origin);
        match flight.origin {
            // The newest value stays to be written when the unit is back.
            Origin::Slot(i) if self.slots[i].kind == SlotKind::Write && self.slots[i].due_ns.is_some() => {
                self.slots[i].due_ns = Some(now_ns);
            }
            origin => self.rest(origin, now_ns),
        }
        self.ended = Some((flight.origin, flight.unit, Ended::Failed(failure)));
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

    fn expire(&mut self, now_ns: u64) {
        let Some(flight) = &self.flight else { return };
        if now_ns < flight.until_ns {
            return;
        }
        match flight.phase {
            Phase::Sending => self.link_failed(now_ns),
            Phase::Waiting => {
                // The answer may still come, and there is no telling which one it is.
                self.reset = !self.settings.serial;
                self.fail(Failure::NoAnswer, now_ns);
            }
            Phase::Turnaround => {
                if let Some(flight) = self.flight.take() {
                    self.units[flight.unit].state = UnitState::Ok;
                    self.forget_retry(flight.origin);
                    self.rest(flight.origin, now_ns);
                    self.ended = Some((flight.origin, flight.unit, Ended::Answer(0)));
                }
            }
        }
    }

    /// Ends jobs that nobody waits for or that cannot be tried; one at a time, wherever they stand.
    fn jobs_that_fail(&mut self, now_ns: u64) {
        let in_flight = |job: &Job| self.flight.as_ref().is_some_and(|f| f.origin == Origin::Job(job.id));
        let link_down = self.flight.is_none() && now_ns < self.link_until_ns;
        let mut found = None;
        for (i, job) in self.jobs.iter().enumerate() {
            if in_flight(job) {
                continue;
            }
            let failure = if now_ns >= job.deadline_ns {
                Failure::Expired
            } else if link_down {
                Failure::Link
            } else if job.fail_fast && job.tries == 0 && !self.may_probe(job.unit, now_ns) {
                Failure::UnitDown
            } else {
                continue;
            };
            found = Some((i, failure));
            break;
        }
        if let Some((i, failure)) = found
            && let Some(job) = self.jobs.remove(i)
        {
            self.forget_retry(Origin::Job(job.id));
            self.ended = Some((Origin::Job(job.id), job.unit, Ended::Failed(failure)));
        }
    }

    /// When a dead unit is tried again.
    fn probe_ns(&self, unit: &Unit) -> u64 {
        let others = self.units.iter().enumerate().any(|(i, other)| {
            other.number != unit.number
                && other.state != UnitState::Dead
                && self.slots.iter().any(|slot| slot.unit == i && slot.enabled)
        }) || (self.slots.is_empty() && self.units.iter().any(|u| u.state == UnitState::Ok));
        let grown = unit.settings.probe_min_ns << unit.level.saturating_sub(1).min(16);
        let interval = if others {
            let fair = unit.cost_ns.saturating_mul(PROBE_SHARE);
            grown.min(unit.settings.probe_max_ns).max(fair)
        } else {
            grown.min(unit.settings.probe_max_ns.min(LONE_PROBE_NS))
        };
        unit.failed_ns.saturating_add(interval)
    }

    fn may_probe(&self, unit: usize, now_ns: u64) -> bool {
        let unit = &self.units[unit];
        unit.state != UnitState::Dead || self.probe_ns(unit) <= now_ns
    }

    /// When a request may go to its unit: now, or not before.
    fn free_ns(&self, origin: Origin, unit: usize, pdu: &Pdu, patient: bool, now_ns: u64) -> Option<u64> {
        let state = &self.units[unit];
        if state.retrying.is_some_and(|other| other != origin) {
            return None;
        }
        let mut free_ns = 0;
        if state.state == UnitState::Dead && patient {
            free_ns = self.probe_ns(state);
        }
        for suspect in state.suspects.iter().filter(|s| s.is_active(now_ns)) {
            if suspect.pdu.confusable(pdu.get(), suspect.answered) {
                free_ns = free_ns.max(suspect.until_ns);
            }
        }
        Some(free_ns)
    }

    /// The request whose turn it is, or when there may be one.
    fn choose(&self, now_ns: u64) -> Result<Origin, Option<u64>> {
        let mut next_ns: Option<u64> = None;
        let mut write: Option<(u64, usize)> = None;
        let mut read: Option<(u64, usize)> = None;
        for (i, slot) in self.slots.iter().enumerate() {
            let Some(due_ns) = slot.due_ns.filter(|_| slot.enabled) else { continue };
            let Some(free_ns) = self.free_ns(Origin::Slot(i), slot.unit, &slot.pdu, true, now_ns) else {
                continue;
            };
            let at_ns = due_ns.max(free_ns);
            if at_ns > now_ns {
                next_ns = Some(next_ns.map_or(at_ns, |n| n.min(at_ns)));
                continue;
            }
            let best = if slot.kind == SlotKind::Write { &mut write } else { &mut read };
            if best.is_none_or(|(best_ns, _)| due_ns < best_ns) {
                *best = Some((due_ns, i));
            }
        }
        let mut job = None;
        for (i, waiting) in self.jobs.iter().enumerate() {
            next_ns = Some(next_ns.map_or(waiting.deadline_ns, |n| n.min(waiting.deadline_ns)));
            let origin = Origin::Job(waiting.id);
            match self.free_ns(origin, waiting.unit, &waiting.pdu, false, now_ns) {
                Some(free_ns) if free_ns <= now_ns => {
                    job = Some(i);
                    break;
                }
                Some(free_ns) => next_ns = next_ns.map(|n| n.min(free_ns)),
                None => {}
            }
        }
        let turn_of_reads = self.writes_in_a_row >= WRITES_IN_A_ROW && (read.is_some() || job.is_some());
        if let Some((_, i)) = write.filter(|_| !turn_of_reads) {
            return Ok(Origin::Slot(i));
        }
        match (job, read) {
            (Some(i), None) => Ok(Origin::Job(self.jobs[i].id)),
            (Some(i), Some(_)) if !self.job_had_turn => Ok(Origin::Job(self.jobs[i].id)),
            (_, Some((_, i))) => Ok(Origin::Slot(i)),
            (None, None) => Err(next_ns),
        }
    }

    fn send(&mut self, origin: Origin, now_ns: u64) -> Step<'_> {
        let (unit, pdu, tries) = match origin {
            Origin::Slot(i) => {
                let slot = &mut self.slots[i];
                slot.changed = false;
                match slot.kind {
                    SlotKind::Write => self.writes_in_a_row += 1,
                    SlotKind::Read => (self.writes_in_a_row, self.job_had_turn) = (0, false),
                }
                (slot.unit, slot.pdu, slot.tries)
            }
            Origin::Job(id) => {
                (self.writes_in_a_row, self.job_had_turn) = (0, true);
                // The job in flight stands first.
                let at = self.jobs.iter().position(|job| job.id == id).unwrap_or(0);
                self.jobs.make_contiguous()[..=at].rotate_right(1);
                (self.jobs[0].unit, self.jobs[0].pdu, self.jobs[0].tries)
            }
        };
        let state = &mut self.units[unit];
        state.counters.requests += 1;
        state.counters.retries += u64::from(tries > 0);
        let until_ns = now_ns.saturating_add(self.settings.send_limit_ns);
        let flight = self.flight.insert(Flight {
            origin,
            unit,
            pdu,
            phase: Phase::Sending,
            begun_ns: now_ns,
            sent_ns: 0,
            until_ns,
            damaged: false,
        });
        Step::Send { unit: state.number, pdu: flight.pdu.get(), origin }
    }
}

#[cfg(test)]
#[path = "line_tests.rs"]
mod tests;
