//! What becomes of the request in flight: answered, repeated, given up.

use super::{
    DEAD_AFTER, Ended, Failure, Flight, LINK_PAUSE_NS, Line, Origin, Phase, SlotKind, UnitState,
    is_of_gateway,
};
use crate::protocol::pdu::Exception;

/// Whether the same request may be carried out later: the device failed at it now, or is busy.
fn is_for_now(exception: Option<u8>) -> bool {
    let codes = [Exception::ServerDeviceFailure.code(), Exception::ServerDeviceBusy.code()];
    exception.is_some_and(|code| codes.contains(&code))
}

impl Line {
    /// The port or connection does not work: what is in flight fails, and nothing is sent for a while.
    pub fn link_failed(&mut self, now_ns: u64) {
        self.counters.link_failures += 1;
        self.link_down = true;
        let pause = (LINK_PAUSE_NS.0 << self.link_level.min(10)).min(LINK_PAUSE_NS.1);
        self.link_level += 1;
        self.link_until_ns = now_ns.saturating_add(pause);
        if let Some(flight) = self.flight.take() {
            self.forget_retry(flight.origin);
            self.put_back(flight.origin, now_ns);
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

    /// The request in flight was answered, perhaps by an exception.
    pub(super) fn succeed(&mut self, len: usize, exception: Option<u8>, now_ns: u64) {
        let Some(flight) = self.flight.take() else { return };
        let rtt_ns = now_ns.saturating_sub(flight.sent_ns.max(flight.begun_ns));
        let unit = &mut self.units[flight.unit];
        let timeout_ns = unit.settings.response_timeout_ns;
        unit.answered(&flight.pdu, now_ns, flight.sent_ns.saturating_add(2 * timeout_ns));
        // What a gateway answers in its place tells nothing of the unit.
        let came_from_it = !is_of_gateway(exception);
        let was_dead = came_from_it && unit.state == UnitState::Dead;
        if came_from_it {
            unit.state = UnitState::Ok;
            (unit.level, unit.failures, unit.cost_ns) = (0, 0, 0);
            self.news |= was_dead;
        }
        let retry_ns = now_ns.saturating_add(unit.settings.probe_min_ns);
        unit.counters.answers += 1;
        unit.last_rtt_ns = Some(rtt_ns);
        unit.max_rtt_ns = unit.max_rtt_ns.max(rtt_ns);
        (self.link_level, self.link_down) = (0, false);
        self.forget_retry(flight.origin);
        match flight.origin {
            // Not now, says the unit: its newest value is written later.
            Origin::Slot(i) if is_for_now(exception) && self.is_wanted_write(i) && !self.slots[i].changed => {
                self.slots[i].due_ns = Some(retry_ns);
            }
            origin => self.rest(origin, now_ns),
        }
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

    /// Puts a slot back after its request has failed. The newest value of a write stays to be written.
    fn put_back(&mut self, origin: Origin, now_ns: u64) {
        match origin {
            Origin::Slot(i) if self.is_wanted_write(i) => self.slots[i].due_ns = Some(now_ns),
            origin => self.rest(origin, now_ns),
        }
    }

    /// Whether a slot is a write that nobody has forgotten while it was in flight.
    fn is_wanted_write(&self, slot: usize) -> bool {
        let slot = &self.slots[slot];
        slot.kind == SlotKind::Write && slot.due_ns.is_some()
    }

    /// A gateway answered that it does not reach the unit. It has repeated the request itself.
    pub(super) fn unreachable(&mut self, now_ns: u64) {
        let Some(flight) = self.flight.take() else { return };
        let unit = &mut self.units[flight.unit];
        unit.failures = unit.failures.saturating_add(1);
        unit.by_gateway = true;
        unit.cost_ns = now_ns.saturating_sub(flight.begun_ns);
        (self.link_level, self.link_down) = (0, false);
        self.give_up(&flight, Failure::NoAnswer, now_ns);
    }

    /// The try in flight has failed: repeated, or told.
    pub(super) fn fail(&mut self, failure: Failure, now_ns: u64) {
        let Some(flight) = self.flight.take() else { return };
        let unit = &mut self.units[flight.unit];
        unit.counters.timeouts += u64::from(failure == Failure::NoAnswer);
        let was_dead = unit.state == UnitState::Dead;
        unit.failures = unit.failures.saturating_add(1);
        unit.by_gateway = false;
        unit.cost_ns = now_ns.saturating_sub(flight.begun_ns);
        if self.settings.serial && failure == Failure::NoAnswer && !flight.damaged {
            let until_ns = now_ns.saturating_add(unit.settings.response_timeout_ns);
            unit.suspect(&flight.pdu, now_ns, until_ns);
        }
        let retries = if was_dead { 0 } else { unit.settings.retries };
        let tries = match flight.origin {
            Origin::Slot(i) => {
                self.slots[i].tries = self.slots[i].tries.saturating_add(1);
                self.slots[i].tries
            }
            // Jobs in flight stand first in the queue.
            Origin::Job(_) => self.jobs.front_mut().map_or(u8::MAX, |job| {
                job.tries = job.tries.saturating_add(1);
                job.tries
            }),
        };
        // A write that was forgotten while it was under way, a read that was taken out: nobody wants it repeated.
        let forgotten = matches!(flight.origin, Origin::Slot(i) if self.slots[i].due_ns.is_none());
        if forgotten && !was_dead {
            self.forget_retry(flight.origin);
            self.ended = Some((flight.origin, flight.unit, Ended::Failed(failure)));
            return;
        }
        if tries <= retries && tries < u8::MAX {
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
        self.give_up(&flight, failure, now_ns);
    }

    fn give_up(&mut self, flight: &Flight, failure: Failure, now_ns: u64) {
        let unit = &mut self.units[flight.unit];
        if unit.failures >= DEAD_AFTER {
            self.news |= unit.state != UnitState::Dead;
            unit.state = UnitState::Dead;
            unit.failed_ns = now_ns;
            unit.level = unit.level.saturating_add(1);
        } else {
            unit.state = UnitState::Failing;
        }
        self.forget_retry(flight.origin);
        self.put_back(flight.origin, now_ns);
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
