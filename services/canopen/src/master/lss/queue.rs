//! LSS calls of jobs: one at a time on the bus, the others wait.

use super::call::LssCall;
use super::run::{LssError, LssLine, LssOutcome};
use crate::protocol::io::Outbox;
use ipc_types::payload::CanFrame;
use std::collections::VecDeque;

/// Calls that wait; more are refused.
pub const MAX_CALLS: usize = 16;

/// The queue is full.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("{MAX_CALLS} LSS jobs wait already; try again")]
pub struct QueueFull;

#[derive(Debug)]
struct Waiting {
    job: u64,
    call: LssCall,
    deadline_ns: u64,
}

/// See the module.
#[derive(Debug, Default)]
pub struct LssJobs {
    line: LssLine,
    /// The job under way.
    current: u64,
    queue: VecDeque<Waiting>,
    ends: VecDeque<(u64, LssOutcome)>,
}

impl LssJobs {
    /// Queues a call; its end comes with the number `job`. Frames go out at the next [`Self::on_time`].
    pub fn ask(&mut self, job: u64, call: LssCall, deadline_ns: u64) -> Result<(), QueueFull> {
        if self.queue.len() >= MAX_CALLS {
            return Err(QueueFull);
        }
        self.queue.push_back(Waiting { job, call, deadline_ns });
        Ok(())
    }

    fn end(&mut self, outcome: LssOutcome) {
        self.ends.push_back((self.current, outcome));
    }

    pub fn on_frame(&mut self, t_ns: u64, frame: &CanFrame) {
        if let Some(outcome) = self.line.on_frame(t_ns, frame) {
            self.end(outcome);
        }
    }

    pub fn on_time(&mut self, now_ns: u64, out: &mut Outbox) {
        loop {
            if let Some(outcome) = self.line.on_time(now_ns, out) {
                self.end(outcome);
            }
            if self.line.is_busy() {
                break;
            }
            let Some(next) = self.queue.pop_front() else { break };
            self.current = next.job;
            if let Err(outcome) = self.line.start(now_ns, next.call, next.deadline_ns) {
                self.end(outcome);
            }
        }
        // Who waits is told in time, also behind a long call.
        while let Some(at) = self.queue.iter().position(|w| now_ns >= w.deadline_ns) {
            if let Some(late) = self.queue.remove(at) {
                self.ends.push_back((late.job, LssOutcome::late()));
            }
        }
    }

    /// The bus is off: nobody will answer.
    pub fn bus_off(&mut self) {
        if let Some(outcome) = self.line.abandon(LssError::BusOff) {
            self.end(outcome);
        }
    }

    pub fn next_deadline(&self) -> Option<u64> {
        let waiting = self.queue.iter().map(|w| w.deadline_ns);
        let start = (!self.line.is_busy() && !self.queue.is_empty()).then_some(0);
        waiting.chain(self.line.next_deadline()).chain(start).min()
    }

    /// Calls on the bus and in the queue.
    pub fn waiting(&self) -> usize {
        self.queue.len() + usize::from(self.line.is_busy())
    }

    pub fn take_end(&mut self) -> Option<(u64, LssOutcome)> {
        self.ends.pop_front()
    }
}
