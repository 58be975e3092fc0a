//! When bytes may go out, and when they are out.
//!
//! One transmission at a time: what waits behind it waits in the topic, whose writers are told when it is full. On a
//! half-duplex line a transmission waits until the line was silent for 3.5 characters, until the reply delay after a
//! received frame and the turnaround after an own one are over.

use ipc_types::payload::{CHUNK_BYTES, serial_flag};
use serde::Serialize;

use super::timing::Timing;

/// What a transmission carries besides its bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Head {
    /// Of the message on `tx`.
    pub seq: u64,
    /// Of the message on `tx`.
    pub writer: u32,
    /// Of the message on `tx`.
    pub generation: u32,
    /// Not sent any more after this time, ns; 0 = no limit of its own.
    pub deadline_ns: u64,
    /// [`serial_flag`]s.
    pub flags: u32,
}

/// How a [`Sender`] works.
#[derive(Debug, Clone, Copy)]
pub struct Settings {
    /// Times of the line.
    pub timing: Timing,
    /// Wait for silence before sending.
    pub half_duplex: bool,
    /// Silence before sending, ns.
    pub silence_ns: u64,
    /// Least time between the last byte received and the first sent, ns.
    pub reply_delay_ns: u64,
    /// Least time between two own transmissions, ns.
    pub turnaround_ns: u64,
    /// Longest wait for silence, and for a port that takes no bytes, ns.
    pub give_up_ns: u64,
    /// This process switches the transmitter: pauses before the first and after the last byte, ns.
    pub rts: Option<(u64, u64)>,
    /// Bytes leave at the line's pace (real lines, paced terminals); otherwise at once.
    pub timed: bool,
    /// Hand bytes to the port only as fast as the line would take them.
    pub paced: bool,
}

/// What the driver must do next.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Step {
    /// Nothing to send.
    Idle,
    /// Call again at this time, ns.
    Wait(u64),
    /// Switch RTS to sending (true) or receiving, then call again.
    Rts(bool),
    /// Write these bytes of the transmission, report with [`Sender::wrote`].
    Write(usize, usize),
    /// Ask whether the port has sent all bytes, report with [`Sender::drained`].
    Probe,
    /// The transmission has ended.
    Done(Outcome),
}

/// Why bytes were not sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NotSent {
    /// Its deadline was over before the line was free.
    Deadline,
    /// The line was never silent.
    LineBusy,
    /// The port takes no bytes.
    Blocked,
    /// The port is gone.
    PortGone,
}

/// How a transmission ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Outcome {
    /// First bit on the line, ns.
    pub first_ns: u64,
    /// Last bit on the line, ns.
    pub end_ns: u64,
    /// `None`: sent.
    pub not_sent: Option<NotSent>,
}

/// What a [`Sender`] counted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
pub struct SendCounters {
    /// Bytes sent.
    pub bytes: u64,
    /// Transmissions sent whole.
    pub frames: u64,
    /// Not sent: their deadline was over.
    pub expired: u64,
    /// Not sent: the line was never silent.
    pub line_busy: u64,
    /// Not sent: the port took no bytes.
    pub blocked: u64,
    /// Not sent: the port was gone.
    pub port_gone: u64,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum State {
    Idle,
    Waiting { since_ns: u64 },
    RtsOn,
    RtsLead { until_ns: u64 },
    Writing { started_ns: u64, written: usize, progress_ns: u64, retry_ns: u64 },
    Draining { started_ns: u64, due_ns: u64, limit_ns: u64 },
    RtsTrail { started_ns: u64, end_ns: u64, until_ns: u64 },
    RtsOff { outcome: Outcome },
}

/// See the module.
#[derive(Debug)]
pub struct Sender {
    settings: Settings,
    state: State,
    head: Head,
    bytes: Box<[u8; CHUNK_BYTES]>,
    len: usize,
    /// End of the last own transmission.
    last_ns: Option<u64>,
    /// The transmission before was a part of a frame that goes on.
    goes_on: bool,
    counters: SendCounters,
}

impl Sender {
    /// Nothing sent yet.
    pub fn new(settings: Settings) -> Self {
        Self {
            settings,
            state: State::Idle,
            head: Head::default(),
            bytes: Box::new([0; CHUNK_BYTES]),
            len: 0,
            last_ns: None,
            goes_on: false,
            counters: SendCounters::default(),
        }
    }

    /// Whether a transmission waits until the line was silent.
    pub fn keeps_silence(&self) -> bool {
        self.settings.half_duplex
    }

    /// What was counted so far.
    pub fn counters(&self) -> SendCounters {
        self.counters
    }

    /// Whether a new transmission can be loaded.
    pub fn is_idle(&self) -> bool {
        self.state == State::Idle
    }

    /// Whether bytes are going out.
    pub fn is_sending(&self) -> bool {
        !matches!(self.state, State::Idle | State::Waiting { .. })
    }

    /// Takes a transmission. False, and nothing taken, when one is under way or the bytes are none or too many.
    pub fn load(&mut self, head: Head, bytes: &[u8], now_ns: u64) -> bool {
        if !self.is_idle() || bytes.is_empty() || bytes.len() > CHUNK_BYTES {
            return false;
        }
        self.bytes[..bytes.len()].copy_from_slice(bytes);
        self.len = bytes.len();
        self.head = head;
        self.state = State::Waiting { since_ns: now_ns };
        true
    }

    /// The transmission that was loaded last.
    pub fn current(&self) -> (&Head, &[u8]) {
        (&self.head, &self.bytes[..self.len])
    }

    /// What to do now. `heard_ns` is when the last byte was received, `receiving` whether a frame has begun and not
    /// ended.
    pub fn step(&mut self, now_ns: u64, heard_ns: Option<u64>, receiving: bool) -> Step {
        match self.state {
            State::Idle => Step::Idle,
            State::Waiting { since_ns } => self.wait(now_ns, since_ns, heard_ns, receiving),
            State::RtsOn => {
                let (before, _) = self.settings.rts.unwrap_or_default();
                self.state = State::RtsLead { until_ns: now_ns + before };
                Step::Rts(true)
            }
            State::RtsLead { until_ns } if now_ns < until_ns => Step::Wait(until_ns),
            State::RtsLead { .. } => {
                self.begin(now_ns);
                self.write(now_ns)
            }
            State::Writing { .. } => self.write(now_ns),
            State::Draining { due_ns, .. } if now_ns < due_ns => Step::Wait(due_ns),
            State::Draining { .. } => Step::Probe,
            State::RtsTrail { until_ns, .. } if now_ns < until_ns => Step::Wait(until_ns),
            State::RtsTrail { started_ns, end_ns, .. } => {
                let outcome = Outcome { first_ns: started_ns, end_ns, not_sent: None };
                self.state = State::RtsOff { outcome };
                Step::Rts(false)
            }
            State::RtsOff { outcome } => self.done(outcome),
        }
    }

    fn wait(&mut self, now_ns: u64, since_ns: u64, heard_ns: Option<u64>, receiving: bool) -> Step {
        let deadline_ns = match self.head.deadline_ns {
            0 => u64::MAX,
            deadline => deadline,
        };
        if now_ns > deadline_ns {
            return self.give_up(now_ns, NotSent::Deadline);
        }
        let s = &self.settings;
        let free_ns = if self.head.flags & serial_flag::AT_ONCE != 0 || self.goes_on {
            0
        } else {
            let own = self.last_ns.map_or(0, |last| {
                last.saturating_add(s.turnaround_ns.max(if s.half_duplex { s.silence_ns } else { 0 }))
            });
            let heard = heard_ns.map_or(0, |heard| {
                let silence = if s.half_duplex { s.silence_ns } else { 0 };
                heard.saturating_add(s.reply_delay_ns.max(silence))
            });
            own.max(heard)
        };
        let busy = receiving && s.half_duplex && !self.goes_on && self.head.flags & serial_flag::AT_ONCE == 0;
        if !busy && now_ns >= free_ns {
            if s.rts.is_some() {
                self.state = State::RtsOn;
                return self.step(now_ns, heard_ns, receiving);
            }
            self.begin(now_ns);
            return self.write(now_ns);
        }
        let give_up_ns = since_ns.saturating_add(s.give_up_ns);
        // Its own delays are no reason to give up: only a line that others keep busy is.
        if busy && now_ns >= give_up_ns {
            return self.give_up(now_ns, NotSent::LineBusy);
        }
        let look_again = if busy { give_up_ns } else { free_ns };
        Step::Wait(look_again.min(deadline_ns.saturating_add(1)).max(now_ns + 1))
    }

    fn begin(&mut self, now_ns: u64) {
        self.state = State::Writing { started_ns: now_ns, written: 0, progress_ns: now_ns, retry_ns: now_ns };
    }

    fn write(&mut self, now_ns: u64) -> Step {
        let State::Writing { started_ns, written, progress_ns, retry_ns } = self.state else {
            return Step::Idle;
        };
        if now_ns >= progress_ns.saturating_add(self.settings.give_up_ns.max(1)) {
            return self.give_up(now_ns, NotSent::Blocked);
        }
        let char_ns = self.settings.timing.char_ns.max(1);
        let allowed = if self.settings.paced {
            usize::try_from((now_ns - started_ns) / char_ns).unwrap_or(usize::MAX).min(self.len)
        } else {
            self.len
        };
        if allowed <= written {
            // Some bytes at once, so that a fast line does not wake for each.
            let next = (written + (1_000_000 / char_ns) as usize).clamp(written + 1, self.len);
            return Step::Wait(started_ns + char_ns * next as u64);
        }
        if now_ns < retry_ns {
            return Step::Wait(retry_ns);
        }
        Step::Write(written, allowed)
    }

    /// So many bytes went into the port; 0: it takes none now.
    pub fn wrote(&mut self, n: usize, now_ns: u64) {
        let State::Writing { started_ns, written, progress_ns, .. } = self.state else { return };
        let written = (written + n).min(self.len);
        let on_line = self.settings.timing.of(self.len);
        if written < self.len {
            let char_ns = self.settings.timing.char_ns;
            let (progress_ns, retry_ns) = if n > 0 && !self.settings.paced {
                (now_ns, now_ns + (char_ns * 8).max(200_000))
            } else if n > 0 {
                (now_ns, now_ns)
            } else {
                (progress_ns, now_ns + (char_ns * 8).clamp(200_000, 20_000_000))
            };
            self.state = State::Writing { started_ns, written, progress_ns, retry_ns };
            return;
        }
        let due_ns = if self.settings.timed { (started_ns + on_line).max(now_ns) } else { now_ns };
        // Twice its time and a second: what is not out by then is stuck (flow control, a dead adapter).
        let limit_ns = due_ns + on_line * 2 + self.settings.give_up_ns;
        self.state = State::Draining { started_ns, due_ns, limit_ns };
    }

    /// Whether the port has sent all bytes.
    pub fn drained(&mut self, empty: bool, now_ns: u64) {
        let State::Draining { started_ns, limit_ns, .. } = self.state else { return };
        if empty {
            let until_ns = now_ns + self.settings.rts.map_or(0, |(_, after)| after);
            self.state = State::RtsTrail { started_ns, end_ns: now_ns, until_ns };
            if self.settings.rts.is_none() {
                let outcome = Outcome { first_ns: started_ns, end_ns: now_ns, not_sent: None };
                self.state = State::RtsOff { outcome };
            }
        } else if now_ns >= limit_ns {
            let outcome = Outcome { first_ns: started_ns, end_ns: now_ns, not_sent: Some(NotSent::Blocked) };
            self.state = State::RtsOff { outcome };
        } else {
            let due_ns = now_ns + self.settings.timing.char_ns.clamp(50_000, 2_000_000);
            self.state = State::Draining { started_ns, due_ns, limit_ns };
        }
    }

    /// Ends what is under way: the port is gone. The outcome comes with the next [`Self::step`].
    pub fn port_gone(&mut self, now_ns: u64) {
        if !self.is_idle() {
            let outcome = Outcome { first_ns: now_ns, end_ns: now_ns, not_sent: Some(NotSent::PortGone) };
            self.state = State::RtsOff { outcome };
        }
    }

    fn give_up(&mut self, now_ns: u64, why: NotSent) -> Step {
        let outcome = Outcome { first_ns: now_ns, end_ns: now_ns, not_sent: Some(why) };
        if self.is_sending() && self.settings.rts.is_some() {
            self.state = State::RtsOff { outcome };
            return Step::Rts(false);
        }
        self.done(outcome)
    }

    fn done(&mut self, outcome: Outcome) -> Step {
        match outcome.not_sent {
            None => {
                self.counters.frames += 1;
                self.counters.bytes += self.len as u64;
                self.last_ns = Some(outcome.end_ns);
            }
            Some(NotSent::Deadline) => self.counters.expired += 1,
            Some(NotSent::LineBusy) => self.counters.line_busy += 1,
            Some(NotSent::Blocked) => self.counters.blocked += 1,
            Some(NotSent::PortGone) => self.counters.port_gone += 1,
        }
        // Only a full chunk can be a part of a longer frame.
        self.goes_on =
            outcome.not_sent.is_none() && self.len == CHUNK_BYTES && self.head.flags & serial_flag::END == 0;
        self.state = State::Idle;
        Step::Done(outcome)
    }
}
