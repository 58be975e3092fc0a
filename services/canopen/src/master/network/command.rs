//! NMT commands: queued, sent in order with the inhibit time between them.

use super::Network;
use crate::master::boot::{ErrorControl, OPERATIONAL};
use crate::protocol::io::Outbox;
use crate::protocol::nmt::{NmtCommand, NmtState};

/// NMT commands that wait for their inhibit time.
pub(super) const MAX_COMMANDS: usize = 512;

/// The state that a command leads to, as a heartbeat tells it; `None` for resets.
pub(super) fn state_after(command: NmtCommand) -> Option<u8> {
    match command {
        NmtCommand::Start => Some(NmtState::Operational.wire()),
        NmtCommand::Stop => Some(NmtState::Stopped.wire()),
        NmtCommand::EnterPreOperational => Some(NmtState::PreOperational.wire()),
        NmtCommand::ResetNode | NmtCommand::ResetCommunication => None,
    }
}

/// Name of an NMT state as a heartbeat tells it.
pub fn state_name(state: u8) -> &'static str {
    NmtState::from_wire(state).map_or("unknown", NmtState::name)
}

/// A node that a user resets may be silent so long before it counts as lost: drives take seconds to begin again.
const RESET_NS: u64 = 10_000_000_000;

impl Network {
    /// Queues an NMT command; node 0 is all.
    pub(super) fn command(&mut self, command: NmtCommand, node: u8) {
        if self.commands.len() < MAX_COMMANDS {
            self.commands.push_back((command, node));
        }
    }

    /// An NMT command of a user or a program; node 0 is all.
    pub fn nmt(&mut self, now_ns: u64, command: NmtCommand, node: u8, out: &mut Outbox) {
        for i in 0..self.nodes.len() {
            if node != 0 && self.nodes[i].id() != node {
                continue;
            }
            match state_after(command) {
                Some(state) => self.nodes[i].wanted = state,
                None => {
                    let node = &mut self.nodes[i];
                    // It is silent while it begins again; one that stays silent is lost.
                    if let Some(watch) = &mut node.watch {
                        watch.renew(now_ns, RESET_NS);
                    }
                    node.state = None;
                }
            }
            // The last word on it, also when the safe state ends.
            self.nodes[i].held = false;
            self.gate(now_ns, i);
        }
        self.command(command, node);
        self.settle(now_ns, out);
    }

    /// The safe state of the outputs by NMT; `None` leaves it: nodes that it held are started again, others stay as they
    /// are.
    pub fn set_safe(&mut self, now_ns: u64, safe: Option<NmtCommand>, out: &mut Outbox) {
        if self.safe == safe {
            return;
        }
        self.safe = safe;
        for i in 0..self.nodes.len() {
            let node = &mut self.nodes[i];
            if !node.boot.is_running() {
                node.held = false;
                continue;
            }
            match safe {
                Some(command) if node.held || node.wanted == OPERATIONAL => self.hold(now_ns, i, command),
                None if std::mem::take(&mut node.held) => {
                    node.wanted = OPERATIONAL;
                    if node.settings.plan.error_control == ErrorControl::None {
                        // Nobody will tell another state.
                        node.state = None;
                    }
                    let id = node.id();
                    self.command(NmtCommand::Start, id);
                    self.gate(now_ns, i);
                }
                _ => {}
            }
        }
        self.settle(now_ns, out);
    }

    /// Sends a node that runs, or is to run, into the safe state.
    pub(super) fn hold(&mut self, now_ns: u64, i: usize, command: NmtCommand) {
        let node = &mut self.nodes[i];
        node.held = true;
        node.wanted = state_after(command).unwrap_or(127);
        let id = node.id();
        self.command(command, id);
        self.gate(now_ns, i);
    }

    pub(super) fn send_commands(&mut self, now_ns: u64, out: &mut Outbox) {
        while !self.commands.is_empty() && now_ns >= self.next_command_ns && !self.bus_off {
            let Some((command, node)) = self.commands.pop_front() else { break };
            self.next_command_ns = now_ns.saturating_add(self.settings.nmt_inhibit_ns);
            self.counters.nmt_commands += 1;
            out.push(command.frame(node));
        }
    }
}
