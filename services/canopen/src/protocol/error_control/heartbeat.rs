//! Heartbeat producer (1017h) and consumer (1016h).

use ipc_types::payload::CanFrame;

use super::MS;
use crate::protocol::cob_id::predefined;
use crate::protocol::io::Outbox;
use crate::protocol::nmt::{NmtState, heartbeat_frame};

/// Nodes that a consumer can watch: all others of a bus (CiA 301 V4.2, 7.5.2.19: sub-indices 1-127).
pub const CONSUMERS: usize = 127;

/// Producer: 1017h in ms, 0 = off (CiA 301 V4.2, 7.5.2.20).
#[derive(Debug, Clone, Default)]
pub struct HeartbeatProducer {
    period_ns: u64,
    next_ns: Option<u64>,
}

impl HeartbeatProducer {
    /// Takes what was written; the first heartbeat is due at once (7.2.8.3.2.2: the protocol begins immediately).
    pub fn configure(&mut self, t_ns: u64, period_ms: u16) {
        self.period_ns = u64::from(period_ms) * MS;
        self.next_ns = self.is_on().then_some(t_ns);
    }
    /// The boot-up message goes out now and stands for the first heartbeat (7.2.8.3.2.2).
    pub fn boot_up(&mut self, t_ns: u64) {
        self.next_ns = self.is_on().then(|| t_ns.saturating_add(self.period_ns));
    }
    pub fn is_on(&self) -> bool {
        self.period_ns > 0
    }
    /// Initialisation: nothing is due until [`Self::configure`].
    pub fn stop(&mut self) {
        *self = Self::default();
    }
    /// The state changed: a running producer tells at once and starts a new period,
    /// so that consumers learn of the change without waiting for it.
    pub fn state_changed(&mut self, t_ns: u64, node_id: u8, state: NmtState, out: &mut Outbox) {
        if self.is_on() {
            out.push(heartbeat_frame(node_id, state));
            self.next_ns = Some(t_ns.saturating_add(self.period_ns));
        }
    }
    pub fn next_deadline(&self) -> Option<u64> {
        self.next_ns
    }
    /// Sends what is due. The clock stays on its grid; a caller that comes later than a period sends one heartbeat,
    /// not several.
    pub fn on_time(&mut self, t_ns: u64, node_id: u8, state: NmtState, out: &mut Outbox) {
        let Some(due) = self.next_ns else { return };
        if t_ns < due {
            return;
        }
        out.push(heartbeat_frame(node_id, state));
        let grid = due.saturating_add(self.period_ns);
        self.next_ns = Some(if grid > t_ns { grid } else { t_ns.saturating_add(self.period_ns) });
    }
}

/// What a consumer has seen.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum HeartbeatEvent {
    /// First heartbeat of a node since it is watched, or the first after it was lost.
    Resolved { node_id: u8, state: NmtState },
    /// No heartbeat within the consumer time.
    Lost { node_id: u8 },
    /// A watched node's state differs from its last one.
    State { node_id: u8, from: NmtState, to: NmtState },
    /// A watched node that was active has booted up: it was reset.
    BootUp { node_id: u8 },
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
enum Watch {
    /// Monitoring starts with the first heartbeat (CiA 301 V4.2, 7.2.8.3.2.2).
    #[default]
    Waiting,
    Active,
    Lost,
}

#[derive(Debug, Clone, Copy, Default)]
struct Consumer {
    node_id: u8,
    time_ns: u64,
    watch: Watch,
    state: NmtState,
    deadline_ns: u64,
}

/// Value of 1016h sub n: bits 16-23 node-id, bits 0-15 time in ms (CiA 301 V4.2, 7.5.2.19, figure 64).
pub fn split_consumer_time(value: u32) -> (u8, u16) {
    ((value >> 16) as u8, value as u16)
}

/// Is the entry used: node-id 1-127 and a time? Others are allowed and ignored.
pub fn is_used(value: u32) -> bool {
    let (node_id, time_ms) = split_consumer_time(value);
    value >> 24 == 0 && (1..=127).contains(&node_id) && time_ms > 0
}

/// Consumer of up to [`CONSUMERS`] nodes.
#[derive(Debug, Clone)]
pub struct HeartbeatConsumer {
    entries: [Consumer; CONSUMERS],
    used: usize,
}

impl Default for HeartbeatConsumer {
    fn default() -> Self {
        Self { entries: [Consumer::default(); CONSUMERS], used: 0 }
    }
}

impl HeartbeatConsumer {
    /// Takes the value of sub-index `sub` (1-127). An entry that is written, even with the same value, waits for
    /// its first heartbeat again.
    pub fn configure(&mut self, sub: u8, value: u32) {
        let Some(entry) = usize::from(sub).checked_sub(1).and_then(|at| self.entries.get_mut(at)) else {
            return;
        };
        let (node_id, time_ms) = split_consumer_time(value);
        *entry = Consumer::default();
        if is_used(value) {
            entry.node_id = node_id;
            entry.time_ns = u64::from(time_ms) * MS;
        }
        self.used = self.entries.iter().rposition(|entry| entry.time_ns > 0).map_or(0, |at| at + 1);
    }
    /// The node that sub-index `sub` watches.
    pub fn node_of(&self, sub: u8) -> Option<u8> {
        let entry = self.entries.get(usize::from(sub).checked_sub(1)?)?;
        (entry.time_ns > 0).then_some(entry.node_id)
    }
    /// Every entry waits for its first heartbeat: initialisation.
    pub fn restart(&mut self) {
        for entry in &mut self.entries {
            entry.watch = Watch::Waiting;
        }
    }
    /// Last known state of a watched node; None: not watched or never heard.
    pub fn state(&self, node_id: u8) -> Option<NmtState> {
        self.entries[..self.used]
            .iter()
            .find(|entry| entry.time_ns > 0 && entry.node_id == node_id && entry.watch == Watch::Active)
            .map(|entry| entry.state)
    }
    /// A frame, if it is the heartbeat or boot-up of a watched node.
    pub fn on_frame(&mut self, t_ns: u64, frame: &CanFrame) -> Option<HeartbeatEvent> {
        let node_id =
            frame.can_id.checked_sub(predefined::ERROR_CONTROL).filter(|id| (1..=127).contains(id))? as u8;
        let [value] = frame.payload() else { return None };
        let state = NmtState::from_wire(*value)?;
        let entry = self.entries[..self.used]
            .iter_mut()
            .find(|entry| entry.time_ns > 0 && entry.node_id == node_id)?;
        if state == NmtState::Initialising {
            // A boot-up message is no heartbeat (7.2.8.3.3): it neither starts nor feeds the monitoring. Of a node
            // that was active it says that the node was reset; it is lost again if no heartbeat follows in time.
            if entry.watch == Watch::Active {
                entry.state = state;
                return Some(HeartbeatEvent::BootUp { node_id });
            }
            return None;
        }
        entry.deadline_ns = t_ns.saturating_add(entry.time_ns);
        let from = std::mem::replace(&mut entry.state, state);
        let watch = std::mem::replace(&mut entry.watch, Watch::Active);
        match watch {
            Watch::Waiting | Watch::Lost => Some(HeartbeatEvent::Resolved { node_id, state }),
            Watch::Active => (from != state).then_some(HeartbeatEvent::State { node_id, from, to: state }),
        }
    }
    pub fn next_deadline(&self) -> Option<u64> {
        self.entries[..self.used]
            .iter()
            .filter(|entry| entry.watch == Watch::Active && entry.time_ns > 0)
            .map(|entry| entry.deadline_ns)
            .min()
    }
    /// The next loss that is due; call until None.
    pub fn on_time(&mut self, t_ns: u64) -> Option<HeartbeatEvent> {
        let entry = self.entries[..self.used]
            .iter_mut()
            .find(|entry| entry.watch == Watch::Active && entry.time_ns > 0 && t_ns >= entry.deadline_ns)?;
        entry.watch = Watch::Lost;
        Some(HeartbeatEvent::Lost { node_id: entry.node_id })
    }
    /// Is any watched node lost?
    pub fn any_lost(&self) -> bool {
        self.entries[..self.used].iter().any(|entry| entry.watch == Watch::Lost)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn producer_keeps_its_grid_and_never_sends_a_burst() {
        let mut out = Outbox::default();
        let mut producer = HeartbeatProducer::default();
        producer.configure(0, 100);
        assert_eq!(producer.next_deadline(), Some(0));
        producer.boot_up(0);
        assert_eq!(producer.next_deadline(), Some(100 * MS));
        producer.on_time(101 * MS, 4, NmtState::PreOperational, &mut out);
        assert_eq!(producer.next_deadline(), Some(200 * MS), "lateness does not add up");
        producer.on_time(950 * MS, 4, NmtState::PreOperational, &mut out);
        assert_eq!(producer.next_deadline(), Some(1050 * MS));
        producer.state_changed(1000 * MS, 4, NmtState::Operational, &mut out);
        assert_eq!(producer.next_deadline(), Some(1100 * MS));
        let sent: Vec<_> = out.drain().map(|frame| (frame.id(), frame.payload().to_vec())).collect();
        assert_eq!(sent, [(0x704, vec![0x7F]), (0x704, vec![0x7F]), (0x704, vec![0x05])]);
        producer.configure(1000 * MS, 0);
        assert_eq!(producer.next_deadline(), None);
    }

    #[test]
    fn consumer_waits_loses_and_finds() {
        let mut consumer = HeartbeatConsumer::default();
        consumer.configure(2, 0x0005_0064);
        assert_eq!(consumer.next_deadline(), None, "starts with the first heartbeat");
        assert_eq!(consumer.on_frame(0, &heartbeat_frame(5, NmtState::Initialising)), None);
        let resolved = HeartbeatEvent::Resolved { node_id: 5, state: NmtState::PreOperational };
        assert_eq!(consumer.on_frame(MS, &heartbeat_frame(5, NmtState::PreOperational)), Some(resolved));
        assert_eq!(consumer.next_deadline(), Some(101 * MS));
        assert_eq!(consumer.on_time(100 * MS), None);
        assert_eq!(consumer.on_frame(50 * MS, &heartbeat_frame(6, NmtState::PreOperational)), None);
        assert_eq!(
            consumer.on_frame(100 * MS, &heartbeat_frame(5, NmtState::Operational)),
            Some(HeartbeatEvent::State {
                node_id: 5,
                from: NmtState::PreOperational,
                to: NmtState::Operational
            })
        );
        let boot = consumer.on_frame(150 * MS, &heartbeat_frame(5, NmtState::Initialising));
        assert_eq!(boot, Some(HeartbeatEvent::BootUp { node_id: 5 }));
        assert_eq!(consumer.on_time(200 * MS), Some(HeartbeatEvent::Lost { node_id: 5 }));
        assert_eq!(consumer.on_time(200 * MS), None);
        assert!(consumer.any_lost());
        assert_eq!(
            consumer.on_frame(300 * MS, &heartbeat_frame(5, NmtState::PreOperational)),
            Some(resolved)
        );
        assert!(!consumer.any_lost());
    }

    #[test]
    fn all_127_entries_work_and_unused_values_are_ignored() {
        let mut consumer = HeartbeatConsumer::default();
        for node_id in 1..=127u8 {
            consumer.configure(node_id, u32::from(node_id) << 16 | 0xA);
        }
        for node_id in 1..=127u8 {
            assert!(
                consumer.on_frame(u64::from(node_id), &heartbeat_frame(node_id, NmtState::Stopped)).is_some()
            );
        }
        let lost = std::iter::from_fn(|| consumer.on_time(11 * MS)).count();
        assert_eq!(lost, 127);
        for value in [0, 0x0080_0064, 0x0005_0000, 0x0105_0064, u32::MAX] {
            assert!(!is_used(value), "{value:08X}");
        }
        consumer.configure(0, 0x0005_0064);
        consumer.configure(200, 0x0005_0064);
    }
}
