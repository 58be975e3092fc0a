//! Whose turn it is.

use super::types::Pdu;
use super::unit::Unit;
use super::{
    Ended, Failure, Flight, Job, LONE_PROBE_NS, Line, Origin, PROBE_SHARE, Phase, SlotKind, Step, UnitState,
    WRITES_IN_A_ROW,
};

impl Line {
    /// Ends jobs that nobody waits for or that cannot be tried; one at a time, wherever they stand.
    pub(super) fn jobs_that_fail(&mut self, now_ns: u64) {
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
    pub(super) fn choose(&self, now_ns: u64) -> Result<Origin, Option<u64>> {
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

    pub(super) fn send(&mut self, origin: Origin, now_ns: u64) -> Step<'_> {
        let (unit, pdu, tries) = match origin {
            Origin::Slot(i) => {
                let slot = &mut self.slots[i];
                slot.changed = false;
                match slot.kind {
                    SlotKind::Write => self.writes_in_a_row += 1,
                    SlotKind::Read => (self.writes_in_a_row, self.job_had_turn) = (0, false),
                }
                // Its first turn is the beginning of its periods, however long the clock runs.
                if slot.due_ns == Some(0) {
                    slot.due_ns = Some(now_ns);
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
