//! A unit of a line: its state, and the requests whose late answers may still come.

use super::Origin;
use super::types::{Pdu, UnitCounters, UnitSettings, UnitState};
use crate::protocol::client_fit::{Fit, fit};

pub(super) struct Unit {
    pub(super) number: u8,
    pub(super) settings: UnitSettings,
    pub(super) state: UnitState,
    /// The request that is being repeated: nothing else goes to the unit.
    pub(super) retrying: Option<Origin>,
    pub(super) failed_ns: u64,
    pub(super) level: u32,
    /// Tries since the unit was last well.
    pub(super) failures: u32,
    /// That it is dead was told.
    pub(super) told_dead: bool,
    /// The last try failed because a gateway does not reach the unit.
    pub(super) by_gateway: bool,
    /// Line time of the last try without an answer.
    pub(super) cost_ns: u64,
    /// Requests whose late answers may still come.
    pub(super) suspects: [Suspect; SUSPECTS],
    pub(super) counters: UnitCounters,
    pub(super) last_exception: Option<(u8, u8)>,
    pub(super) last_rtt_ns: Option<u64>,
    pub(super) max_rtt_ns: u64,
}

/// Requests of a unit that are remembered because of their late answers.
pub(super) const SUSPECTS: usize = 4;

#[derive(Clone, Copy)]
pub(super) struct Suspect {
    pub(super) pdu: Pdu,
    pub(super) until_ns: u64,
    /// Answers that may still come.
    pub(super) outstanding: u8,
    /// A repetition was answered, by whichever answer: not even the same request goes out before the other one came.
    pub(super) answered: bool,
}

impl Unit {
    /// Nothing is known of it yet.
    pub(super) fn new(number: u8, settings: UnitSettings) -> Self {
        Self {
            number,
            settings,
            state: UnitState::Unknown,
            retrying: None,
            failed_ns: 0,
            level: 0,
            failures: 0,
            told_dead: false,
            by_gateway: false,
            cost_ns: 0,
            suspects: [Suspect { pdu: Pdu::new(&[]), until_ns: 0, outstanding: 0, answered: false };
                SUSPECTS],
            counters: UnitCounters::default(),
            last_exception: None,
            last_rtt_ns: None,
            max_rtt_ns: 0,
        }
    }

    /// A request was given up; its answer may come until then.
    pub(super) fn suspect(&mut self, pdu: &Pdu, now_ns: u64, until_ns: u64) {
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
    pub(super) fn discarded(&mut self, answer: &[u8]) {
        self.counters.discarded += 1;
        let late = |s: &&mut Suspect| s.outstanding > 0 && fit(s.pdu.get(), answer) != Fit::No;
        if let Some(suspect) = self.suspects.iter_mut().find(late) {
            suspect.outstanding -= 1;
        }
    }

    /// A repeated request was answered, perhaps by the late answer to an earlier try: then its own is still to come.
    pub(super) fn answered(&mut self, pdu: &Pdu, now_ns: u64, until_ns: u64) {
        for suspect in self.suspects.iter_mut().filter(|s| s.is_active(now_ns) && s.pdu.get() == pdu.get()) {
            suspect.until_ns = suspect.until_ns.max(until_ns);
            suspect.answered = true;
        }
    }
}

impl Suspect {
    pub(super) fn is_active(&self, now_ns: u64) -> bool {
        self.outstanding > 0 && self.until_ns > now_ns
    }
}
