//! When to start, signal, restart, hold and give up: decided here, done elsewhere.
//!
//! Sans-I/O: facts and the time (CLOCK_MONOTONIC in ns) go in, [`Action`]s come out. No clock, process, file or
//! middleware may be touched in this module, so that every rule of supervision is tested in virtual time.
//!
//! The life of a service:
//!
//! ```text
//! Idle -> Starting -> Running -> (death) -> Cleaning -> Starting        first restart at once
//!                  \-> Aborting -> Killed /          \-> Waiting -> Starting   later ones after a back-off
//!                                                     \-> Held          budget used up, or the stack fails
//! Stopping -> Ended                                  in reverse order, recorders last
//! ```

mod ending;
mod model;

pub use model::{Action, Death, Exhausted, HEALTHY_NS, Kill, Notice, Phase, Rule, Slot, UNSTABLE_AFTER};

use ipc_types::event::{EventKind, Level};
use ipc_types::payload::HealthState;
use serde_json::{Value, json};

/// Between SIGABRT, which leaves a core and a backtrace, and SIGKILL.
pub const ABORT_GRACE_NS: u64 = 500_000_000;
/// So many clean-ups of dead nodes may fail in a row before the stack fails.
pub const CLEAN_ATTEMPTS: u32 = 3;
/// Pause before a clean-up that failed is tried again: what hindered it (no process to be had, no memory) lasts longer
/// than three attempts in a row.
pub const CLEAN_PAUSE_NS: u64 = 250_000_000;
/// Heartbeats are read every 20 ms. What passes beyond this between two readings is time in which the machine stood
/// still (frozen, stopped, paused as a virtual machine), or the reader: it counts as nobody's silence.
pub const READ_PAUSE_NS: u64 = 100_000_000;
/// A process that has not ended so long after SIGKILL waits inside the kernel (a driver, a dead network disk): it is
/// told, and the end of the stack does not wait for it any longer.
pub const UNKILLABLE_NS: u64 = 5_000_000_000;
/// A second wish to stop within this time is the first one, delivered twice: a closing terminal and `timeout` send their
/// signal to the process and to its group.
pub const STOP_AGAIN_NS: u64 = 500_000_000;
/// Pause between two clean-ups while /dev/shm is full.
const NO_ROOM_PAUSE_NS: u64 = 500_000_000;
/// How long the other services wait for the recorders at the start of a stack. A recorder is ready after some
/// 20 ms, on a slow machine with much to do after 1 s (measured); one that is not must not keep a plant from running.
pub const RECORDER_HEAD_START_NS: u64 = 3_000_000_000;

/// The supervision of one stack.
#[derive(Debug)]
pub struct Policy {
    slots: Vec<Slot>,
    order: Vec<usize>,
    stopping: bool,
    stop_at: u64,
    failed: Option<String>,
    ended: bool,
    clean_running: bool,
    clean_again: bool,
    clean_round: u64,
    clean_failures: u32,
    /// When a clean-up that failed or found no room is tried again.
    clean_retry_at: Option<u64>,
    no_room: bool,
    /// When heartbeats were read last.
    read_at: Option<u64>,
    term_grace_ns: u64,
    out: Vec<Action>,
}

impl Policy {
    /// Services in the order of the stack file; `term_grace_ns` passes between SIGTERM and SIGKILL.
    pub fn new(services: Vec<(String, Rule)>, term_grace_ns: u64) -> Self {
        let slots: Vec<Slot> = services.into_iter().map(|(name, rule)| Slot::new(name, rule)).collect();
        let (recorders, others): (Vec<_>, Vec<_>) = (0..slots.len()).partition(|&i| slots[i].rule.recorder);
        Self {
            slots,
            order: recorders.into_iter().chain(others).collect(),
            stopping: false,
            stop_at: 0,
            failed: None,
            ended: false,
            clean_running: false,
            clean_again: false,
            clean_round: 0,
            clean_failures: 0,
            clean_retry_at: None,
            no_room: false,
            read_at: None,
            term_grace_ns,
            out: Vec::new(),
        }
    }

    pub fn slots(&self) -> &[Slot] {
        &self.slots
    }
    /// Why the stack failed, if it did.
    pub fn failed(&self) -> Option<&str> {
        self.failed.as_deref()
    }
    pub fn stopping(&self) -> bool {
        self.stopping
    }
    pub fn ended(&self) -> bool {
        self.ended
    }
    /// Takes what is to be done.
    pub fn take(&mut self) -> Vec<Action> {
        std::mem::take(&mut self.out)
    }

    /// Starts every service in the order of the stack file, recorders first: the others wait until these are
    /// ready, so that the first scan and its keyframe are in the recording, but not for ever.
    pub fn start(&mut self, now: u64) {
        let recorded = self.slots.iter().any(|slot| slot.rule.recorder);
        for service in self.order.clone() {
            if recorded && !self.slots[service].rule.recorder {
                self.slots[service].phase = Phase::Waiting { until: now + RECORDER_HEAD_START_NS };
            } else {
                self.spawn(service, now);
            }
        }
    }

    /// Starts what still waits for the recorders' first start, once none of these is on its way any more.
    fn recorders_are_up(&mut self, now: u64) {
        if self.stopping || self.slots.iter().any(|s| s.rule.recorder && s.phase == Phase::Starting) {
            return;
        }
        for service in self.order.clone() {
            let slot = &self.slots[service];
            if slot.generation == 0 && matches!(slot.phase, Phase::Waiting { .. }) {
                self.spawn(service, now);
            }
        }
    }

    fn spawn(&mut self, service: usize, now: u64) {
        let slot = &mut self.slots[service];
        slot.generation += 1;
        slot.phase = Phase::Starting;
        slot.since = now;
        slot.ready_at = 0;
        slot.silent_from = now;
        let generation = slot.generation;
        self.out.push(Action::Spawn { service, generation });
    }

    fn tell(
        &mut self,
        service: Option<usize>,
        kind: EventKind,
        level: Level,
        message: String,
        detail: Value,
    ) {
        self.out.push(Action::Tell(Notice { service, kind, level, message, detail }));
    }

    /// The process exists.
    pub fn started(&mut self, service: usize, pid: u32) {
        let generation = self.slots[service].generation;
        self.tell(
            Some(service),
            EventKind::Started,
            Level::Info,
            format!("started, pid {pid}"),
            json!({ "pid": pid, "generation": generation }),
        );
    }

    /// A heartbeat was seen.
    pub fn beat(&mut self, service: usize, generation: u32, state: HealthState, now: u64) {
        let Some(slot) = self.slots.get_mut(service) else { return };
        if slot.generation != generation || !slot.phase.alive() {
            return;
        }
        let ready = matches!(state, HealthState::Ready | HealthState::Degraded);
        // A start counts from its beginning until it is ready.
        if slot.phase != Phase::Starting || ready {
            slot.silent_from = now;
        }
        if slot.phase == Phase::Starting && ready {
            slot.phase = Phase::Running;
            slot.ready_at = now;
            let after_ms = now.saturating_sub(slot.since) / 1_000_000;
            self.tell(
                Some(service),
                EventKind::Ready,
                Level::Info,
                format!("ready after {after_ms} ms"),
                json!({ "generation": generation, "after_ms": after_ms }),
            );
            self.recorders_are_up(now);
        } else if self.slots[service].is_healthy(now) {
            self.recovered(service);
        }
    }

    /// It has been ready for a while: whatever was before is over.
    fn recovered(&mut self, service: usize) {
        let slot = &mut self.slots[service];
        let (deaths, was_unstable) = (slot.deaths(), slot.unstable());
        slot.forgive();
        if was_unstable {
            let for_s = HEALTHY_NS.max(slot.rule.within_ns) / 1_000_000_000;
            self.tell(
                Some(service),
                EventKind::Unstable,
                Level::Info,
                format!("healthy again: ready for {for_s} s after {deaths} deaths"),
                json!({ "deaths": deaths, "healthy": true }),
            );
        }
    }

    /// All heartbeats up to `now` were read: whoever is silent since too long hangs. The time is the reader's,
    /// so that a late reader kills nobody.
    pub fn heartbeats_read(&mut self, now: u64) {
        let away = self.read_at.map_or(0, |at| now.saturating_sub(at).saturating_sub(READ_PAUSE_NS));
        self.read_at = Some(now);
        if self.stopping {
            return;
        }
        for service in 0..self.slots.len() {
            let slot = &mut self.slots[service];
            let limit = match slot.phase {
                Phase::Starting => slot.rule.start_timeout_ns,
                Phase::Running => slot.rule.hang_timeout_ns,
                _ => continue,
            };
            slot.silent_from = slot.silent_from.saturating_add(away).min(now);
            let waited = now.saturating_sub(slot.silent_from);
            if waited <= limit {
                continue;
            }
            let ms = waited / 1_000_000;
            let message = if slot.phase == Phase::Starting {
                format!("not ready {ms} ms after its start: it hangs and is killed")
            } else {
                format!("no heartbeat for {ms} ms: it hangs and is killed")
            };
            slot.phase = Phase::Aborting { kill_at: now + ABORT_GRACE_NS };
            self.tell(Some(service), EventKind::Hung, Level::Fault, message, json!({ "waited_ms": ms }));
            self.out.push(Action::Signal { service, signal: Kill::Abort });
        }
    }

    /// The process ended, or could not be started.
    pub fn died(&mut self, service: usize, death: Death, now: u64) {
        let slot = &mut self.slots[service];
        let phase = slot.phase;
        let ran_ms = now.saturating_sub(slot.since) / 1_000_000;
        if self.stopping {
            slot.phase = Phase::Ended;
            if !matches!(phase, Phase::Stopping { .. } | Phase::Leaving { .. } | Phase::Ended) {
                self.tell_death(service, death, ran_ms);
            }
            self.stop_next(now);
            return;
        }
        let planned = matches!(phase, Phase::Restarting { .. });
        if !planned {
            if slot.is_healthy(now) {
                slot.forgive();
            }
            slot.row = slot.row.saturating_add(1);
            slot.unready = if slot.ready_at > 0 { 0 } else { slot.unready.saturating_add(1) };
            self.tell_death(service, death, ran_ms);
        }
        let round = self.request_clean();
        self.slots[service].phase = Phase::Cleaning { round, planned };
    }

    fn tell_death(&mut self, service: usize, death: Death, ran_ms: u64) {
        let mut detail = death.detail;
        if let Some(map) = detail.as_object_mut() {
            map.insert("generation".into(), self.slots[service].generation.into());
            map.insert("ran_ms".into(), ran_ms.into());
        }
        let message = format!("died: {}, after {ran_ms} ms", death.how);
        self.tell(Some(service), EventKind::Died, Level::Fault, message, detail);
    }

    /// Asks for a clean-up that begins after this moment; returns its number.
    fn request_clean(&mut self) -> u64 {
        if self.clean_retry_at.is_some() {
            return self.clean_round + 1;
        }
        if self.clean_running {
            self.clean_again = true;
            self.clean_round + 1
        } else {
            self.clean_running = true;
            self.clean_round += 1;
            self.out.push(Action::Clean);
            self.clean_round
        }
    }

    /// Asks for a clean-up without a death of ours: what a killed command-line tool left.
    pub fn housekeeping(&mut self) {
        if !self.stopping && !self.clean_running {
            self.request_clean();
        }
    }

    /// The clean-up could not even begin because /dev/shm is full. That is no fault of what it would clean: it is
    /// tried again until there is room, and who died waits for it without using up a budget.
    pub fn clean_has_no_room(&mut self, now: u64) {
        self.clean_running = false;
        if self.stopping {
            return;
        }
        if !std::mem::replace(&mut self.no_room, true) {
            let message = "/dev/shm full: what died is cleaned up and started again when there is room; remove files \
                           there or make it larger";
            self.tell(None, EventKind::NoRoom, Level::Fault, message.to_owned(), Value::Null);
        }
        self.repeat_round();
        self.clean_retry_at = Some(now + NO_ROOM_PAUSE_NS);
    }

    /// The services that wait for the failed round wait for its repetition.
    fn repeat_round(&mut self) {
        self.clean_round -= 1;
        self.clean_again = false;
        for slot in &mut self.slots {
            if let Phase::Cleaning { round, .. } = &mut slot.phase {
                *round = self.clean_round + 1;
            }
        }
    }

    /// The clean-up ended; an error says why it failed.
    pub fn clean_done(&mut self, result: Result<(), String>, now: u64) {
        self.clean_running = false;
        self.no_room = false;
        if self.stopping {
            return;
        }
        if let Err(cause) = result {
            if !self.slots.iter().any(|slot| matches!(slot.phase, Phase::Cleaning { .. })) {
                // Only tools had left something: the stack lives without that clean-up, and tries again later.
                return;
            }
            self.clean_failures += 1;
            if self.clean_failures >= CLEAN_ATTEMPTS {
                self.fail(
                    format!(
                        "cleaning up after dead processes failed {CLEAN_ATTEMPTS} times in a row ({cause}): the shared \
                         memory of the stack cannot be trusted any more"
                    ),
                    now,
                );
                return;
            }
            self.repeat_round();
            self.clean_retry_at = Some(now + CLEAN_PAUSE_NS);
            return;
        }
        self.clean_failures = 0;
        let done = self.clean_round;
        if std::mem::take(&mut self.clean_again) {
            self.request_clean();
        }
        for service in 0..self.slots.len() {
            if let Phase::Cleaning { round, planned } = self.slots[service].phase
                && round <= done
            {
                if planned {
                    self.spawn(service, now);
                } else {
                    self.decide(service, now);
                }
                if self.stopping {
                    return;
                }
            }
        }
    }

    /// After a failure: again at once, later, or not at all.
    fn decide(&mut self, service: usize, now: u64) {
        let slot = &mut self.slots[service];
        let rule = slot.rule.clone();
        while slot.recent.front().is_some_and(|&t| now.saturating_sub(t) > rule.within_ns) {
            slot.recent.pop_front();
        }
        if slot.recent.len() >= rule.max as usize || slot.unready > rule.max {
            self.exhausted(service, now);
            return;
        }
        let delay = match slot.row {
            0 | 1 => 0,
            n => rule.backoff_first_ns.saturating_mul(1 << (n - 2).min(32)).min(rule.backoff_max_ns),
        };
        slot.recent.push_back(now + delay);
        let count = slot.recent.len();
        let delay_ms = delay / 1_000_000;
        let when = if delay == 0 { "at once".to_owned() } else { format!("in {delay_ms} ms") };
        let message = format!(
            "starting again {when} ({count} of {} restarts in {} s)",
            rule.max,
            rule.within_ns / 1_000_000_000
        );
        slot.phase = Phase::Waiting { until: now + delay };
        let next = slot.generation + 1;
        self.tell(
            Some(service),
            EventKind::Restarting,
            Level::Warning,
            message,
            json!({ "delay_ms": delay_ms, "generation": next }),
        );
        self.tell_unstable(service);
        if delay == 0 {
            self.spawn(service, now);
        }
    }

    /// Loud, but ever more seldom: at the fifth death since it was healthy, the tenth, the twentieth.
    fn tell_unstable(&mut self, service: usize) {
        let slot = &self.slots[service];
        let (deaths, name) = (slot.deaths(), &slot.name);
        if deaths % UNSTABLE_AFTER != 0 || !(deaths / UNSTABLE_AFTER).is_power_of_two() {
            return;
        }
        let healthy_s = HEALTHY_NS.max(slot.rule.within_ns) / 1_000_000_000;
        let message = format!(
            "unstable: died {deaths} times and was never ready for {healthy_s} s in between; `dinrail logs {name}` says \
             why. It is started again all the same, up to {} ms after each death",
            slot.rule.backoff_max_ns / 1_000_000
        );
        self.tell(
            Some(service),
            EventKind::Unstable,
            Level::Fault,
            message,
            json!({ "deaths": deaths, "healthy": false }),
        );
    }

    fn exhausted(&mut self, service: usize, now: u64) {
        let slot = &mut self.slots[service];
        slot.phase = Phase::Held;
        let within_s = slot.rule.within_ns as f64 / 1e9;
        let budget = match slot.rule.max {
            0 => "it ended, and `restart = { max = 0 }` allows no restart".to_owned(),
            max if slot.recent.len() < max as usize => {
                format!(
                    "it did not get ready in {} starts in a row, which is the budget of {max} restarts",
                    slot.unready
                )
            }
            max => format!("the budget of {max} restarts in {within_s} s is used up"),
        };
        let (name, on_exhausted) = (slot.name.clone(), slot.rule.on_exhausted);
        self.out.push(Action::CloseListeners { service });
        match on_exhausted {
            Exhausted::Hold => {
                let message = format!("{budget}: held; `dinrail restart {name}` starts it again");
                self.tell(Some(service), EventKind::Held, Level::Fault, message, Value::Null);
            }
            Exhausted::FailStack => self.fail(format!("service '{name}': {budget}"), now),
        }
    }

    /// `restart SERVICE`: costs no budget and ends a hold. Returns the generation that will run.
    pub fn restart(&mut self, service: usize, now: u64) -> Result<u32, String> {
        if self.stopping {
            return Err("the stack is stopping".into());
        }
        let grace = self.term_grace_ns;
        let slot = &mut self.slots[service];
        let next = slot.generation + 1;
        match slot.phase {
            Phase::Starting | Phase::Running => {
                slot.forgive();
                slot.phase = Phase::Restarting { kill_at: now + grace };
                let name = slot.name.clone();
                self.tell(
                    Some(service),
                    EventKind::Restarting,
                    Level::Info,
                    format!("restarting '{name}' by command"),
                    json!({ "generation": next }),
                );
                self.out.push(Action::Signal { service, signal: Kill::Term });
            }
            Phase::Waiting { .. } | Phase::Held => {
                slot.forgive();
                self.spawn(service, now);
            }
            _ => return Err(format!("service '{}' is {} already", slot.name, slot.phase.word())),
        }
        Ok(next)
    }

    /// Deadlines that have passed by `now`.
    pub fn tick(&mut self, now: u64) {
        if self.clean_retry_at.is_some_and(|at| now >= at) && !self.stopping {
            self.clean_retry_at = None;
            self.request_clean();
        }
        for service in 0..self.slots.len() {
            match self.slots[service].phase {
                Phase::Aborting { kill_at } if now >= kill_at => {
                    self.slots[service].phase = Phase::Killed { overdue_at: now + UNKILLABLE_NS };
                    self.out.push(Action::Signal { service, signal: Kill::Now });
                }
                Phase::Killed { overdue_at } if now >= overdue_at => {
                    self.slots[service].phase = Phase::Killed { overdue_at: u64::MAX };
                    self.tell_unkillable(service, "it is started again when it has ended");
                }
                Phase::Restarting { kill_at } if now >= kill_at => {
                    self.slots[service].phase = Phase::Restarting { kill_at: u64::MAX };
                    self.out.push(Action::Signal { service, signal: Kill::Now });
                }
                Phase::Leaving { until } if now >= until => {
                    self.slots[service].phase = Phase::Ended;
                    self.tell_unkillable(service, "the stack ends without it");
                    self.stop_next(now);
                }
                Phase::Stopping { kill_at } if now >= kill_at => {
                    self.slots[service].phase = Phase::Leaving { until: now + UNKILLABLE_NS };
                    let message = format!(
                        "did not end within {} ms of SIGTERM: killed",
                        self.term_grace_ns / 1_000_000
                    );
                    self.tell(Some(service), EventKind::Hung, Level::Warning, message, Value::Null);
                    self.out.push(Action::Signal { service, signal: Kill::Now });
                }
                Phase::Waiting { until } if now >= until && !self.stopping => self.spawn(service, now),
                _ => {}
            }
        }
    }

    /// When [`Self::tick`] has something to do next.
    pub fn next_deadline(&self) -> Option<u64> {
        let due = |slot: &Slot| match slot.phase {
            Phase::Aborting { kill_at } | Phase::Restarting { kill_at } | Phase::Stopping { kill_at } => {
                Some(kill_at)
            }
            Phase::Killed { overdue_at: at } | Phase::Leaving { until: at } => Some(at),
            // At the end nothing is started any more: a deadline that nobody meets would wake for ever.
            Phase::Waiting { until } if !self.stopping => Some(until),
            _ => None,
        };
        let retry = self.clean_retry_at.filter(|_| !self.stopping);
        self.slots.iter().filter_map(due).filter(|&t| t != u64::MAX).chain(retry).min()
    }
}
