//! The boot-up of one node (CiA 302-2 V4.1, figures 4 to 11, "Boot NMT slave"), sans-I/O.
//!
//! The machine asks for SDO transfers and NMT commands through [`Action`] and is told how they ended. It never waits
//! by itself and never gives up for good: a node that failed is tried again, because a plant is repaired while it runs.

mod letter;
mod model;

pub use letter::Letter;
pub use model::{Action, ErrorControl, Failure, Identity, Loaded, Plan, SdoEnd, Write};

/// Wait between two tries of a node that does not answer or was refused.
pub const RETRY_NS: u64 = 1_000_000_000;
/// Longest wait for the boot-up message after a reset.
pub const BOOT_UP_NS: u64 = 1_000_000_000;
/// "load" as 1011h wants it (CiA 301 V4.2, clause 7.5.2.14).
pub const LOAD_SIGNATURE: [u8; 4] = *b"load";

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Step {
    Idle,
    DeviceType,
    Vendor,
    Product,
    Revision,
    Serial,
    /// Waits for a heartbeat or guarding answer that tells the state.
    State,
    /// Waits for the boot-up message; then `after`.
    Reset {
        restored: bool,
    },
    Restore,
    ConfigDate,
    ConfigTime,
    Download(usize),
    StampDate,
    StampTime,
    ErrorControl,
    Running,
    /// Failed: tried again at this time.
    Pause,
}

/// See the module.
#[derive(Debug, Clone)]
pub struct Boot {
    plan: Plan,
    step: Step,
    attempt: u32,
    /// Tries of the last boot-up that went well.
    took: u32,
    /// Tries of the current transfer.
    tries: u8,
    began_ns: u64,
    at_ns: Option<u64>,
    /// The node's boot-up message was the last news of it: it needs no reset.
    fresh: bool,
    /// Last NMT state it told.
    state: Option<u8>,
    kept: bool,
    /// Date of its configuration (1020h:01), while the time is asked for.
    had_date: u32,
    loaded: Option<Loaded>,
    actions: Vec<Action>,
}

/// NMT state in a heartbeat (CiA 301 V4.2, clause 7.2.8.3.2.2).
pub const OPERATIONAL: u8 = 5;

impl Boot {
    pub fn new(plan: Plan) -> Self {
        Self {
            plan,
            step: Step::Idle,
            attempt: 0,
            took: 0,
            tries: 0,
            began_ns: 0,
            at_ns: None,
            fresh: false,
            state: None,
            kept: false,
            had_date: 0,
            loaded: None,
            actions: Vec::with_capacity(4),
        }
    }

    pub fn plan(&self) -> &Plan {
        &self.plan
    }
    /// Tries of the boot-up under way; of a node that runs, the tries it took.
    pub fn attempts(&self) -> u32 {
        if self.attempt > 0 { self.attempt } else { self.took }
    }
    /// Why the configuration was loaded in this try or the one that went well; `None`: it was not, or its date does not
    /// count.
    pub fn loaded(&self) -> Option<Loaded> {
        self.loaded
    }
    /// When the last try began; 0: none did.
    pub fn began_ns(&self) -> u64 {
        self.began_ns
    }
    /// Between the first question and the end.
    pub fn is_busy(&self) -> bool {
        !matches!(self.step, Step::Idle | Step::Running | Step::Pause)
    }
    pub fn is_running(&self) -> bool {
        self.step == Step::Running
    }
    /// Takes the actions asked for since the last call.
    pub fn drain(&mut self) -> std::vec::Drain<'_, Action> {
        self.actions.drain(..)
    }
    /// When [`Self::on_time`] has something to do.
    pub fn next_deadline(&self) -> Option<u64> {
        self.at_ns
    }
    /// In words, for the status.
    pub fn step_text(&self) -> &'static str {
        match self.step {
            Step::Idle => "idle",
            Step::DeviceType => "reading its device type",
            Step::Vendor | Step::Product | Step::Revision | Step::Serial => "checking its identity",
            Step::State => "asking for its state",
            Step::Reset { .. } => "waiting for its boot-up message",
            Step::Restore => "restoring its defaults",
            Step::ConfigDate | Step::ConfigTime => "comparing its configuration date",
            Step::Download(_) | Step::StampDate | Step::StampTime => "loading its configuration",
            Step::ErrorControl => "starting error control",
            Step::Running => "booted",
            Step::Pause => "waiting for the next try",
        }
    }

    /// Starts, or starts again.
    pub fn start(&mut self, now_ns: u64) {
        self.attempt = self.attempt.saturating_add(1);
        (self.began_ns, self.at_ns, self.kept, self.loaded) = (now_ns, None, false, None);
        self.read(Step::DeviceType);
    }

    /// Ends everything: the node is not booted by this master any more until [`Self::start`].
    pub fn stop(&mut self) {
        (self.step, self.at_ns, self.attempt, self.took) = (Step::Idle, None, 0, 0);
        self.actions.clear();
    }

    fn read(&mut self, step: Step) {
        self.tries = 0;
        self.step = step;
        self.ask();
    }

    /// Asks for the transfer of the current step.
    fn ask(&mut self) {
        let read = |index, sub| Action::Read { index, sub };
        let write = |index, sub, data: Vec<u8>| Action::Write(Write { index, sub, data });
        let stamp = self.plan.config_stamp.unwrap_or((0, 0));
        let action = match self.step {
            Step::DeviceType => read(0x1000, 0),
            Step::Vendor => read(0x1018, 1),
            Step::Product => read(0x1018, 2),
            Step::Revision => read(0x1018, 3),
            Step::Serial => read(0x1018, 4),
            Step::Restore => write(0x1011, self.plan.restore.unwrap_or(1), LOAD_SIGNATURE.to_vec()),
            Step::ConfigDate => read(0x1020, 1),
            Step::ConfigTime => read(0x1020, 2),
            Step::StampDate => write(0x1020, 1, stamp.0.to_le_bytes().to_vec()),
            Step::StampTime => write(0x1020, 2, stamp.1.to_le_bytes().to_vec()),
            Step::Download(i) => match self.plan.writes.get(i) {
                Some(write) => Action::Write(write.clone()),
                None => return,
            },
            Step::Idle
            | Step::State
            | Step::Reset { .. }
            | Step::ErrorControl
            | Step::Running
            | Step::Pause => return,
        };
        self.actions.push(action);
    }

    fn fail(&mut self, now_ns: u64, letter: Letter, detail: impl FnOnce(&mut Failure)) {
        let mut failure = Failure {
            letter,
            attempt: self.attempt,
            expected: None,
            got: None,
            object: None,
            abort: None,
            after_ns: now_ns.saturating_sub(self.began_ns),
        };
        detail(&mut failure);
        self.step = Step::Pause;
        self.fresh = false;
        self.at_ns = Some(now_ns.saturating_add(RETRY_NS));
        self.actions.push(Action::Failed(failure));
    }

    /// The transfer last asked for ended.
    pub fn on_sdo(&mut self, now_ns: u64, end: &SdoEnd) {
        if matches!(end, SdoEnd::Timeout) {
            self.tries += 1;
            if self.tries < self.plan.sdo_tries.max(1) {
                return self.ask();
            }
        }
        let abort = match end {
            SdoEnd::Abort(code) => Some(*code),
            _ => None,
        };
        let value = match end {
            SdoEnd::Read(data) => {
                let mut bytes = [0; 4];
                let n = data.len().min(4);
                bytes[..n].copy_from_slice(&data[..n]);
                Some(u32::from_le_bytes(bytes))
            }
            _ => None,
        };
        let identity = self.plan.identity;
        match self.step {
            Step::DeviceType => match value {
                Some(_) => self.compare(now_ns, Letter::C, identity.device_type, value),
                None => self.fail(now_ns, Letter::B, |f| f.abort = abort),
            },
            Step::Vendor => self.compare(now_ns, Letter::D, identity.vendor, value),
            Step::Product => self.compare(now_ns, Letter::M, identity.product, value),
            Step::Revision => self.compare(now_ns, Letter::N, identity.revision, value),
            Step::Serial => self.compare(now_ns, Letter::O, identity.serial, value),
            Step::Restore if matches!(end, SdoEnd::Written) => self.reset(now_ns, true),
            Step::Restore => {
                let sub = self.plan.restore.unwrap_or(1);
                self.fail(now_ns, Letter::J, |f| (f.object, f.abort) = (Some((0x1011, sub)), abort));
            }
            Step::ConfigDate => match value {
                Some(date) => {
                    self.had_date = date;
                    self.read(Step::ConfigTime);
                }
                None => self.load(now_ns, None),
            },
            Step::ConfigTime => {
                let had = value.map(|time| (self.had_date, time));
                match had {
                    Some(_) if had == self.plan.config_stamp => self.start_error_control(now_ns),
                    _ => self.load(now_ns, had),
                }
            }
            Step::Download(i) if matches!(end, SdoEnd::Written) => self.download(now_ns, i + 1),
            Step::Download(i) => {
                let object = self.plan.writes.get(i).map(|w| (w.index, w.sub));
                self.fail(now_ns, Letter::J, |f| (f.object, f.abort) = (object, abort));
            }
            Step::StampDate if matches!(end, SdoEnd::Written) => self.read(Step::StampTime),
            Step::StampTime if matches!(end, SdoEnd::Written) => self.start_error_control(now_ns),
            Step::StampDate | Step::StampTime => {
                let sub = if self.step == Step::StampDate { 1 } else { 2 };
                self.fail(now_ns, Letter::J, |f| (f.object, f.abort) = (Some((0x1020, sub)), abort));
            }
            Step::Idle
            | Step::State
            | Step::Reset { .. }
            | Step::ErrorControl
            | Step::Running
            | Step::Pause => {}
        }
    }

    fn compare(&mut self, now_ns: u64, letter: Letter, expected: Option<u32>, got: Option<u32>) {
        if expected.is_some() && got != expected {
            return self.fail(now_ns, letter, |f| (f.expected, f.got) = (expected, got));
        }
        let identity = self.plan.identity;
        let order = [
            (Step::Vendor, identity.vendor),
            (Step::Product, identity.product),
            (Step::Revision, identity.revision),
            (Step::Serial, identity.serial),
        ];
        let done = order.iter().position(|(step, _)| *step == self.step).map_or(0, |i| i + 1);
        if let Some((step, _)) = order[done..].iter().find(|(_, expected)| expected.is_some()) {
            return self.read(*step);
        }
        self.identified(now_ns);
    }

    /// It is the right device: leave it running, or begin from its reset.
    fn identified(&mut self, now_ns: u64) {
        if !self.plan.keep_alive {
            return self.reset_or_go_on(now_ns);
        }
        match self.state {
            Some(OPERATIONAL) => self.keep(now_ns),
            Some(_) => self.reset_or_go_on(now_ns),
            None => {
                // Its heartbeat tells, or the answer to a guarding request.
                self.step = Step::State;
                let wait_ns = match self.plan.error_control {
                    ErrorControl::Heartbeat { consumer_ns } => consumer_ns,
                    ErrorControl::Guarding { guard_ns, .. } => guard_ns.saturating_mul(2),
                    ErrorControl::None => 0,
                };
                self.at_ns = Some(now_ns.saturating_add(wait_ns));
                if !matches!(self.plan.error_control, ErrorControl::None) {
                    self.actions.push(Action::StartErrorControl);
                }
            }
        }
    }

    fn keep(&mut self, now_ns: u64) {
        self.kept = true;
        self.start_error_control(now_ns);
    }

    fn reset_or_go_on(&mut self, now_ns: u64) {
        if self.fresh { self.restore_or_configure(now_ns, false) } else { self.reset(now_ns, false) }
    }

    fn reset(&mut self, now_ns: u64, restored: bool) {
        self.fresh = false;
        self.step = Step::Reset { restored };
        self.at_ns = Some(now_ns.saturating_add(BOOT_UP_NS));
        self.actions.push(Action::ResetCommunication);
    }

    fn restore_or_configure(&mut self, now_ns: u64, restored: bool) {
        self.at_ns = None;
        if self.plan.restore.is_some() && !restored {
            return self.read(Step::Restore);
        }
        if self.plan.config_stamp.is_some() && !restored {
            return self.read(Step::ConfigDate);
        }
        self.download(now_ns, 0);
    }

    /// The node has another configuration, or none.
    fn load(&mut self, now_ns: u64, had: Option<(u32, u32)>) {
        self.loaded = self.plan.config_stamp.map(|expected| Loaded { had, expected });
        self.download(now_ns, 0);
    }

    fn download(&mut self, now_ns: u64, next: usize) {
        if next < self.plan.writes.len() {
            self.read(Step::Download(next));
        } else if self.plan.config_stamp.is_some() {
            self.read(Step::StampDate);
        } else {
            self.start_error_control(now_ns);
        }
    }

    fn start_error_control(&mut self, now_ns: u64) {
        let wait_ns = match self.plan.error_control {
            ErrorControl::None => return self.done(),
            ErrorControl::Heartbeat { consumer_ns } => consumer_ns,
            ErrorControl::Guarding { guard_ns, factor } => guard_ns.saturating_mul(u64::from(factor.max(1))),
        };
        self.step = Step::ErrorControl;
        self.at_ns = Some(now_ns.saturating_add(wait_ns));
        self.actions.push(Action::StartErrorControl);
    }

    fn done(&mut self) {
        self.step = Step::Running;
        (self.at_ns, self.fresh) = (None, false);
        (self.took, self.attempt) = (self.attempt, 0);
        self.actions.push(Action::Done { kept: self.kept });
    }

    /// The node sent its boot-up message.
    pub fn on_boot_up(&mut self, now_ns: u64) {
        self.fresh = true;
        self.state = Some(127);
        match self.step {
            Step::Reset { restored } => self.restore_or_configure(now_ns, restored),
            Step::Idle => {}
            // The reset at the start of the network, or one by somebody else, before anything was written: the same try.
            Step::DeviceType | Step::Vendor | Step::Product | Step::Revision | Step::Serial | Step::State => {
                self.actions.clear();
                self.attempt = self.attempt.saturating_sub(1);
                self.start(now_ns);
            }
            // It was reset by somebody while it was configured or ran: begin again.
            _ => {
                self.actions.clear();
                self.start(now_ns);
            }
        }
    }

    /// Its heartbeat or guarding answer told this state.
    pub fn on_alive(&mut self, now_ns: u64, state: u8) {
        self.state = Some(state);
        match self.step {
            Step::State if state == OPERATIONAL => self.keep(now_ns),
            Step::State => self.reset_or_go_on(now_ns),
            Step::ErrorControl => self.done(),
            // It was there before its pause was over.
            Step::Pause if self.attempt > 0 => {}
            _ => {}
        }
    }

    /// Error control found the node missing.
    pub fn on_lost(&mut self, now_ns: u64) {
        self.state = None;
        self.fresh = false;
        match self.step {
            Step::ErrorControl => self.fail(now_ns, Letter::K, |_| {}),
            Step::Running => {
                self.step = Step::Pause;
                self.at_ns = Some(now_ns.saturating_add(RETRY_NS));
            }
            _ => {}
        }
    }

    pub fn on_time(&mut self, now_ns: u64) {
        if self.at_ns.is_none_or(|at_ns| now_ns < at_ns) {
            return;
        }
        self.at_ns = None;
        match self.step {
            Step::State => self.reset_or_go_on(now_ns),
            Step::Reset { .. } => self.fail(now_ns, Letter::B, |_| {}),
            Step::ErrorControl => {
                let letter = match self.plan.error_control {
                    ErrorControl::Guarding { .. } => Letter::F,
                    ErrorControl::Heartbeat { .. } | ErrorControl::None => Letter::E,
                };
                self.fail(now_ns, letter, |_| {});
            }
            Step::Pause => self.start(now_ns),
            _ => {}
        }
    }
}

#[cfg(test)]
#[path = "boot_tests.rs"]
mod tests;
