//! What becomes of the request in flight: answered, repeated, given up.

use super::{Ended, Failure, LINK_PAUSE_NS, Line, Origin, Phase, SlotKind, UnitState};

impl Line {
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

    pub(super) fn forget_retry(&mut self, origin: Origin) {
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

    pub(super) fn succeed(&mut self, len: usize, now_ns: u64) {
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
    pub(super) fn rest(&mut self, origin: Origin, now_ns: u64) {
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
    pub(super) fn fail(&mut self, failure: Failure, now_ns: u64) {
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

    pub(super) fn expire(&mut self, now_ns: u64) {
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
}
