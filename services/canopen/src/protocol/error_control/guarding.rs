//! Node guarding: a master asks by RTR, a slave answers with its state and a toggle bit; life guarding: the slave
//! watches that its master asks (CiA 301 V4.2, 7.2.8.3.2.1, 100Ch and 100Dh).

use ipc_types::payload::CanFrame;

use super::MS;
use crate::protocol::cob_id::{CobId, predefined};
use crate::protocol::io::Outbox;
use crate::protocol::nmt::NmtState;

/// Toggle bit of a guarding answer.
const TOGGLE: u8 = 0x80;

fn cob(node_id: u8) -> CobId {
    CobId(predefined::ERROR_CONTROL + u32::from(node_id))
}

/// Life guarding as seen by the slave.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LifeEvent {
    /// No RTR within guard time x life time factor.
    Lost,
    /// The master asks again.
    Resolved,
}

/// Slave side.
#[derive(Debug, Clone, Default)]
pub struct GuardedSlave {
    life_ns: u64,
    toggle: bool,
    deadline_ns: Option<u64>,
    lost: bool,
}

impl GuardedSlave {
    /// Takes 100Ch (ms) and 100Dh; life guarding is off when either is 0 (CiA 301 V4.2, 7.5.2.11 and 7.5.2.12). It
    /// starts with the next RTR.
    pub fn configure(&mut self, guard_time_ms: u16, life_time_factor: u8) {
        let life_ns = u64::from(guard_time_ms) * u64::from(life_time_factor) * MS;
        if life_ns != self.life_ns {
            self.life_ns = life_ns;
            self.deadline_ns = None;
            self.lost = false;
        }
    }
    /// The heartbeat producer was turned on: nobody asks any more, and nobody is missed.
    pub fn stand_down(&mut self) {
        self.deadline_ns = None;
        self.lost = false;
    }
    /// Initialisation: the first answer has toggle 0 again.
    pub fn reset(&mut self) {
        *self = Self { life_ns: self.life_ns, ..Self::default() };
    }
    /// Answers a guarding RTR of the own node. Not to be called while the heartbeat producer is on: then the RTR is
    /// ignored (CiA 301 V4.2, 7.2.8.2.2: heartbeat wins over guarding).
    pub fn on_frame(
        &mut self,
        t_ns: u64,
        node_id: u8,
        state: NmtState,
        frame: &CanFrame,
        out: &mut Outbox,
    ) -> Option<LifeEvent> {
        if !frame.is_remote() || !cob(node_id).matches(frame) {
            return None;
        }
        let toggle = if self.toggle { TOGGLE } else { 0 };
        out.push(cob(node_id).frame(&[toggle | state.wire()]));
        self.toggle = !self.toggle;
        if self.life_ns > 0 {
            self.deadline_ns = Some(t_ns.saturating_add(self.life_ns));
        }
        std::mem::take(&mut self.lost).then_some(LifeEvent::Resolved)
    }
    pub fn next_deadline(&self) -> Option<u64> {
        self.deadline_ns
    }
    pub fn on_time(&mut self, t_ns: u64) -> Option<LifeEvent> {
        if self.deadline_ns? > t_ns {
            return None;
        }
        self.deadline_ns = None;
        self.lost = true;
        Some(LifeEvent::Lost)
    }
}

/// What a guarding master sees.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum GuardEvent {
    /// An answer with the right toggle bit, the first or the first after a loss.
    Resolved { node_id: u8, state: NmtState },
    /// The state differs from the last answer's.
    State { node_id: u8, from: NmtState, to: NmtState },
    /// No answer within the node life time.
    Lost { node_id: u8 },
    /// Answer with the wrong toggle bit: the node was reset, or somebody else asks too. Such an answer does not count.
    Toggle { node_id: u8 },
}

/// Master side of one node.
#[derive(Debug, Clone)]
pub struct Guard {
    node_id: u8,
    period_ns: u64,
    life_ns: u64,
    next_ns: u64,
    deadline_ns: u64,
    toggle: bool,
    state: Option<NmtState>,
    lost: bool,
}

impl Guard {
    /// Asks at once and then every guard time. A guard time of 0 counts as 1 ms, a factor of 0 as 1.
    pub fn new(t_ns: u64, node_id: u8, guard_time_ms: u16, life_time_factor: u8) -> Self {
        let period_ns = u64::from(guard_time_ms.max(1)) * MS;
        let life_ns = period_ns * u64::from(life_time_factor.max(1));
        Self {
            node_id,
            period_ns,
            life_ns,
            next_ns: t_ns,
            deadline_ns: t_ns.saturating_add(life_ns),
            toggle: false,
            state: None,
            lost: false,
        }
    }
    pub fn node_id(&self) -> u8 {
        self.node_id
    }
    /// State of the last good answer; None before it and after a loss.
    pub fn state(&self) -> Option<NmtState> {
        self.state
    }
    pub fn on_frame(&mut self, t_ns: u64, frame: &CanFrame) -> Option<GuardEvent> {
        if frame.is_remote() || !cob(self.node_id).matches(frame) {
            return None;
        }
        let [value] = *frame.payload() else { return None };
        let to = NmtState::from_wire(value)?;
        let node_id = self.node_id;
        if value == 0 {
            // Boot-up: the node's toggle starts anew.
            self.toggle = false;
            return None;
        }
        if (value & TOGGLE != 0) != self.toggle && self.state.is_some() {
            return Some(GuardEvent::Toggle { node_id });
        }
        // The first answer sets the toggle: the node may have been asked before we were.
        self.toggle = value & TOGGLE == 0;
        self.deadline_ns = t_ns.saturating_add(self.life_ns);
        self.lost = false;
        match self.state.replace(to) {
            None => Some(GuardEvent::Resolved { node_id, state: to }),
            Some(from) if from != to => Some(GuardEvent::State { node_id, from, to }),
            Some(_) => None,
        }
    }
    pub fn next_deadline(&self) -> Option<u64> {
        Some(if self.lost { self.next_ns } else { self.next_ns.min(self.deadline_ns) })
    }
    pub fn on_time(&mut self, t_ns: u64, out: &mut Outbox) -> Option<GuardEvent> {
        if t_ns >= self.next_ns {
            out.push(cob(self.node_id).remote(1));
            let grid = self.next_ns.saturating_add(self.period_ns);
            self.next_ns = if grid > t_ns { grid } else { t_ns.saturating_add(self.period_ns) };
        }
        if self.lost || t_ns < self.deadline_ns {
            return None;
        }
        self.lost = true;
        self.state = None;
        Some(GuardEvent::Lost { node_id: self.node_id })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn master_and_slave_toggle_together_until_one_falls_silent() {
        let mut out = Outbox::default();
        let mut slave = GuardedSlave::default();
        slave.configure(100, 3);
        let mut master = Guard::new(0, 5, 100, 3);
        let mut events = Vec::new();
        for step in 0..5u64 {
            let t = step * 100 * MS;
            events.extend(master.on_time(t, &mut out));
            let asked: Vec<_> = out.drain().collect();
            assert_eq!(asked.len(), 1);
            assert!(asked[0].is_remote());
            assert_eq!(slave.on_frame(t, 5, NmtState::PreOperational, &asked[0], &mut out), None);
            let answer: Vec<_> = out.drain().collect();
            assert_eq!(answer[0].payload(), [if step % 2 == 0 { 0x7F } else { 0xFF }]);
            events.extend(master.on_frame(t, &answer[0]));
        }
        assert_eq!(events, [GuardEvent::Resolved { node_id: 5, state: NmtState::PreOperational }]);
        // The master is silent: life guarding strikes once.
        assert_eq!(slave.next_deadline(), Some(700 * MS));
        assert_eq!(slave.on_time(699 * MS), None);
        assert_eq!(slave.on_time(700 * MS), Some(LifeEvent::Lost));
        assert_eq!(slave.next_deadline(), None);
        // The slave is silent: lost once, asked further.
        let lost: Vec<_> = (5..12).filter_map(|step| master.on_time(step * 100 * MS, &mut out)).collect();
        assert_eq!(lost, [GuardEvent::Lost { node_id: 5 }]);
        assert_eq!(out.len(), 7);
        // Both come back.
        let rtr = cob(5).remote(1);
        out.drain().count();
        assert_eq!(
            slave.on_frame(1300 * MS, 5, NmtState::Operational, &rtr, &mut out),
            Some(LifeEvent::Resolved)
        );
        let answer: Vec<_> = out.drain().collect();
        let back = master.on_frame(1300 * MS, &answer[0]);
        assert_eq!(back, Some(GuardEvent::Resolved { node_id: 5, state: NmtState::Operational }));
    }

    #[test]
    fn a_wrong_toggle_does_not_count_and_a_boot_up_starts_it_anew() {
        let mut out = Outbox::default();
        let mut master = Guard::new(0, 5, 100, 3);
        let answer = |value: u8| cob(5).frame(&[value]);
        assert!(master.on_frame(0, &answer(0xFF)).is_some(), "any toggle at first");
        assert_eq!(master.on_frame(1, &answer(0xFF)), Some(GuardEvent::Toggle { node_id: 5 }));
        assert_eq!(master.on_frame(2, &answer(0x7F)), None);
        assert_eq!(master.on_frame(3, &answer(0x00)), None);
        assert_eq!(master.on_frame(4, &answer(0x7F)), None);
        for bad in [cob(6).frame(&[0x7F]), cob(5).frame(&[]), cob(5).frame(&[1, 2]), cob(5).frame(&[0x33])] {
            assert_eq!(master.on_frame(5, &bad), None);
        }
        master.on_time(u64::MAX, &mut out);
    }
}
