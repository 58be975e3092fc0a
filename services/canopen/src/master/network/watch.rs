//! Error control: which nodes are alive, what is done about one that is not, and the signs of two devices with one
//! node-id (CiA 301 V4.2, clause 7.2.8.3.2).

use super::{Event, Network, Sign};
use crate::config::ErrorPolicy;
use crate::master::boot::ErrorControl;
use crate::master::transfers::Owner;
use crate::protocol::cob_id::predefined;
use crate::protocol::io::Outbox;
use crate::protocol::nmt::NmtCommand;
use ipc_types::payload::{CanFrame, id_flag};

/// A started node that tells another state is started again after this time.
const RESTART_NS: u64 = 1_000_000_000;
/// State changes without command within [`DUPLICATE_NS`] that only two devices can make.
const DUPLICATE_CHANGES: u8 = 4;
const DUPLICATE_NS: u64 = 2_000_000_000;
/// Heartbeats within [`BEATS_PERIODS`] periods that only two devices can send: one sends 8, and a few with its changes
/// of state.
const DUPLICATE_BEATS: u8 = 14;
const BEATS_PERIODS: u64 = 8;

#[derive(Debug, Clone, Copy)]
pub(super) struct Watch {
    /// Lost at this time when nothing comes.
    pub(super) lost_at_ns: u64,
    span_ns: u64,
    pub(super) guard: Option<Guard>,
}

impl Watch {
    /// The node begins again: it is lost when nothing comes for its time, and for `least_ns` at least.
    pub(super) fn renew(&mut self, now_ns: u64, least_ns: u64) {
        self.lost_at_ns = now_ns.saturating_add(self.span_ns.max(least_ns));
        if let Some(guard) = &mut self.guard {
            guard.toggle = None;
        }
    }
}

#[derive(Debug, Clone, Copy)]
pub(super) struct Guard {
    every_ns: u64,
    pub(super) next_ns: u64,
    /// Toggle bit of the last answer.
    toggle: Option<bool>,
}

impl Network {
    pub(super) fn on_error_control(&mut self, t_ns: u64, id: u8, payload: &[u8]) {
        let Some(&byte) = payload.first() else { return };
        if byte == 0 {
            self.emcys.booted(t_ns, id);
        }
        let Some(i) = self.find(id) else {
            if byte == 0 && id != self.settings.node_id && self.unknown_told >> id & 1 == 0 {
                self.unknown_told |= 1 << id;
                self.tell(Event::Unknown { node: id });
            }
            return;
        };
        if byte == 0 {
            return self.on_boot_up(t_ns, i);
        }
        let state = byte & 0x7F;
        let node = &mut self.nodes[i];
        if let Some(watch) = &mut node.watch {
            if let Some(guard) = &mut watch.guard {
                let toggle = byte & 0x80 != 0;
                // An answer with the same toggle bit is an old one (CiA 301 clause 7.2.8.3.2.1).
                if guard.toggle.replace(toggle) == Some(toggle) {
                    return;
                }
            }
            watch.lost_at_ns = t_ns.saturating_add(watch.span_ns);
        }
        let before = node.state.replace(state);
        node.boot.on_alive(t_ns, state);
        self.count_beat(t_ns, i);
        if before.is_some_and(|before| before != state) {
            self.count_change(t_ns, i);
        }
        let node = &mut self.nodes[i];
        if node.boot.is_running() && state != node.wanted {
            if before != Some(state) && node.restart_at_ns.is_none() {
                let wanted = node.wanted;
                node.restart_at_ns = Some(t_ns.saturating_add(RESTART_NS));
                // The first heartbeat after a command may still tell the state before it.
                if before.is_some() && before == Some(wanted) {
                    self.tell(Event::State { node: id, state, wanted });
                }
            }
        } else {
            node.restart_at_ns = None;
        }
        self.gate(t_ns, i);
    }

    /// Two devices with one node-id tell two states in turn.
    pub(super) fn count_change(&mut self, t_ns: u64, i: usize) {
        let node = &mut self.nodes[i];
        if t_ns.saturating_sub(node.changes_since_ns) > DUPLICATE_NS {
            (node.changes, node.changes_since_ns) = (0, t_ns);
        }
        node.changes = node.changes.saturating_add(1);
        if node.changes >= DUPLICATE_CHANGES {
            self.tell_duplicate(i, Sign::States);
        }
    }

    /// Two devices with one node-id send twice the heartbeats that one was told to send.
    pub(super) fn count_beat(&mut self, t_ns: u64, i: usize) {
        let node = &mut self.nodes[i];
        let ErrorControl::Heartbeat { consumer_ns } = node.settings.plan.error_control else { return };
        // The consumer time is three periods.
        if t_ns.saturating_sub(node.beats_since_ns) > consumer_ns / 3 * BEATS_PERIODS {
            (node.beats, node.beats_since_ns) = (0, t_ns);
        }
        node.beats = node.beats.saturating_add(1);
        if node.beats >= DUPLICATE_BEATS && node.boot.is_running() {
            self.tell_duplicate(i, Sign::Heartbeats);
        }
    }

    pub(super) fn tell_duplicate(&mut self, i: usize, sign: Sign) {
        let node = &mut self.nodes[i];
        if !std::mem::replace(&mut node.told_duplicate, true) {
            let node = node.id();
            self.tell(Event::Duplicate { node, sign });
        }
    }

    pub(super) fn on_boot_up(&mut self, t_ns: u64, i: usize) {
        let was_running = self.nodes[i].boot.is_running();
        self.count_change(t_ns, i);
        let node = &mut self.nodes[i];
        let id = node.id();
        (node.watch, node.state, node.wanted, node.restart_at_ns) = (None, Some(127), 127, None);
        if node.settings.boot {
            self.transfers.cancel(id, Owner::Boot);
            node.boot.on_boot_up(t_ns);
        }
        if was_running {
            self.tell(Event::Rebooted { node: id });
        }
        self.gate(t_ns, i);
    }

    pub(super) fn guard(&mut self, now_ns: u64, i: usize, out: &mut Outbox) {
        let node = &mut self.nodes[i];
        let Some(watch) = &mut node.watch else { return };
        if let Some(guard) = &mut watch.guard
            && now_ns >= guard.next_ns
        {
            guard.next_ns = now_ns.saturating_add(guard.every_ns);
            let can_id = (predefined::ERROR_CONTROL + u32::from(node.settings.plan.id)) | id_flag::RTR;
            out.push(CanFrame { can_id, len: 1, ..CanFrame::default() });
        }
        if now_ns >= watch.lost_at_ns {
            self.lose(now_ns, i);
        }
    }

    pub(super) fn lose(&mut self, now_ns: u64, i: usize) {
        let node = &mut self.nodes[i];
        let guarding = node.watch.is_some_and(|w| w.guard.is_some());
        let (id, was_running) = (node.id(), node.boot.is_running());
        node.watch = None;
        if !was_running {
            return;
        }
        node.losses += 1;
        node.state = None;
        self.transfers.cancel(id, Owner::Boot);
        self.nodes[i].boot.on_lost(now_ns);
        self.tell(Event::Lost { node: id, guarding });
        let (policy, mandatory) = (self.nodes[i].settings.on_error, self.nodes[i].settings.mandatory);
        if policy != ErrorPolicy::Ignore {
            self.exchange.set_operational(id, false, now_ns);
        }
        self.exchange.show_state(id, 0);
        if policy == ErrorPolicy::Stop || (mandatory && self.settings.stop_all_nodes) {
            for node in &mut self.nodes {
                node.wanted = 4;
            }
            self.command(NmtCommand::Stop, 0);
            for i in 0..self.nodes.len() {
                self.gate(now_ns, i);
            }
        } else if mandatory && self.settings.reset_all_nodes {
            self.command(NmtCommand::ResetCommunication, 0);
            self.boot_all(now_ns);
        }
    }

    pub(super) fn watch(&mut self, now_ns: u64, i: usize) {
        let node = &mut self.nodes[i];
        node.watch = match node.settings.plan.error_control {
            ErrorControl::None => None,
            ErrorControl::Heartbeat { consumer_ns } => Some(Watch {
                lost_at_ns: now_ns.saturating_add(consumer_ns),
                span_ns: consumer_ns,
                guard: None,
            }),
            ErrorControl::Guarding { guard_ns, factor } => {
                let span_ns = guard_ns.saturating_mul(u64::from(factor.max(1)));
                let guard = Guard { every_ns: guard_ns, next_ns: now_ns, toggle: None };
                Some(Watch { lost_at_ns: now_ns.saturating_add(span_ns), span_ns, guard: Some(guard) })
            }
        };
    }
}
