//! NMT commands: queued, sent in order with the inhibit time between them.

use super::Network;
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
                    node.watch = None;
                    node.state = None;
                }
            }
            self.gate(now_ns, i);
        }
        self.command(command, node);
        self.settle(now_ns, out);
    }

    /// The safe state of the outputs by NMT; `None` leaves it.
    pub fn set_safe(&mut self, now_ns: u64, safe: Option<NmtCommand>, out: &mut Outbox) {
        if self.safe == safe {
            return;
        }
        self.safe = safe;
        let command = safe.unwrap_or(NmtCommand::Start);
        for i in 0..self.nodes.len() {
            if self.nodes[i].boot.is_running() {
                self.nodes[i].wanted = state_after(command).unwrap_or(127);
                let id = self.nodes[i].id();
                self.command(command, id);
                self.gate(now_ns, i);
            }
        }
        self.settle(now_ns, out);
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
