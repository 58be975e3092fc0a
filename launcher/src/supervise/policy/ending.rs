//! How a stack ends: one service after the other, and who does not.

use super::*;

impl Policy {
    /// Ends the stack: one service after the other, in reverse order. Asked again after [`STOP_AGAIN_NS`], kills what is
    /// left.
    pub fn stop(&mut self, why: &str, now: u64) {
        if self.stopping {
            if now.saturating_sub(self.stop_at) < STOP_AGAIN_NS {
                return;
            }
            for service in 0..self.slots.len() {
                if self.slots[service].phase.alive() {
                    self.slots[service].phase = Phase::Leaving { until: now + UNKILLABLE_NS };
                    self.out.push(Action::Signal { service, signal: Kill::Now });
                }
            }
            return;
        }
        self.tell(None, EventKind::Stopping, Level::Info, format!("stopping: {why}"), Value::Null);
        self.begin_stop(now);
    }

    /// Ends the stack as failed: exit code 1.
    pub fn fail(&mut self, why: String, now: u64) {
        if self.failed.is_none() {
            self.tell(None, EventKind::StackFailed, Level::Fault, why.clone(), Value::Null);
            self.failed = Some(why);
        }
        if !self.stopping {
            self.begin_stop(now);
        }
    }

    fn begin_stop(&mut self, now: u64) {
        self.stopping = true;
        self.stop_at = now;
        self.stop_next(now);
    }

    pub(super) fn stop_next(&mut self, now: u64) {
        let grace = self.term_grace_ns;
        for service in self.order.clone().into_iter().rev() {
            let slot = &mut self.slots[service];
            match slot.phase {
                Phase::Ended => {}
                Phase::Stopping { .. } | Phase::Leaving { .. } => return,
                phase if phase.alive() => {
                    slot.phase = Phase::Stopping { kill_at: now + grace };
                    self.out.push(Action::Signal { service, signal: Kill::Term });
                    return;
                }
                // A held one stays visible as held: the stack did not end healthy.
                Phase::Held => {}
                _ => slot.phase = Phase::Ended,
            }
        }
        if !self.ended {
            self.ended = true;
            self.out.push(Action::Ended);
        }
    }

    pub(super) fn tell_unkillable(&mut self, service: usize, then: &str) {
        let message = format!(
            "has not ended {} s after SIGKILL: it waits inside the kernel, for a driver or a disk (`ps -o stat,wchan PID`); \
             {then}",
            UNKILLABLE_NS / 1_000_000_000
        );
        self.tell(Some(service), EventKind::Hung, Level::Fault, message, Value::Null);
    }
}
