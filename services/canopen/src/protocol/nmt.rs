//! NMT of a slave: state machine, commands, boot-up (CiA 301 V4.2, 7.2.8 and 7.3.2).
//!
//! The machine knows states and commands only. What a reset does to objects and communication is its owner's matter.

use ipc_types::payload::CanFrame;

use super::cob_id::predefined;

/// States, with the value that heartbeats carry (CiA 301 V4.2, 7.2.8.3.2.2).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[repr(u8)]
pub enum NmtState {
    /// Initialisation; as heartbeat value: boot-up.
    #[default]
    Initialising = 0x00,
    Stopped = 0x04,
    Operational = 0x05,
    PreOperational = 0x7F,
}

impl NmtState {
    /// The state that a heartbeat or guarding answer tells, toggle bit aside.
    pub fn from_wire(value: u8) -> Option<Self> {
        Some(match value & 0x7F {
            0x00 => Self::Initialising,
            0x04 => Self::Stopped,
            0x05 => Self::Operational,
            0x7F => Self::PreOperational,
            _ => return None,
        })
    }
    pub fn wire(self) -> u8 {
        self as u8
    }
    /// May SDO, SYNC, TIME and EMCY be used (CiA 301 V4.2, 7.3.2.3, table 37)?
    pub fn communicates(self) -> bool {
        matches!(self, Self::PreOperational | Self::Operational)
    }
    /// May PDOs be used (table 37)?
    pub fn has_pdo(self) -> bool {
        self == Self::Operational
    }
    /// The field's word for it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Initialising => "initialising",
            Self::Stopped => "stopped",
            Self::Operational => "operational",
            Self::PreOperational => "pre-operational",
        }
    }
}

/// Node control services, with their command specifier (CiA 301 V4.2, 7.2.8.3.1).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum NmtCommand {
    Start = 1,
    Stop = 2,
    EnterPreOperational = 128,
    ResetNode = 129,
    ResetCommunication = 130,
}

impl NmtCommand {
    pub fn from_wire(value: u8) -> Option<Self> {
        Some(match value {
            1 => Self::Start,
            2 => Self::Stop,
            128 => Self::EnterPreOperational,
            129 => Self::ResetNode,
            130 => Self::ResetCommunication,
            _ => return None,
        })
    }
    /// The field's word for it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Start => "start",
            Self::Stop => "stop",
            Self::EnterPreOperational => "enter pre-operational",
            Self::ResetNode => "reset node",
            Self::ResetCommunication => "reset communication",
        }
    }
    /// The frame that an NMT master sends. Node 0 = all nodes.
    pub fn frame(self, node_id: u8) -> CanFrame {
        CanFrame::classic(predefined::NMT, &[self as u8, node_id])
    }
    /// Command and node-id (0 = all) of an NMT frame.
    pub fn parse(frame: &CanFrame) -> Option<(Self, u8)> {
        if frame.can_id != predefined::NMT {
            return None;
        }
        match frame.payload() {
            [command, node_id] if *node_id <= 127 => Some((Self::from_wire(*command)?, *node_id)),
            _ => None,
        }
    }
}

/// Boot-up message: 700h + node-id, one byte 0 (CiA 301 V4.2, 7.2.8.3.3).
pub fn boot_up_frame(node_id: u8) -> CanFrame {
    heartbeat_frame(node_id, NmtState::Initialising)
}

/// Heartbeat: 700h + node-id, the state (CiA 301 V4.2, 7.2.8.3.2.2).
pub fn heartbeat_frame(node_id: u8, state: NmtState) -> CanFrame {
    CanFrame::classic(predefined::ERROR_CONTROL + u32::from(node_id), &[state.wire()])
}

/// Bits of 1F80h NMT startup (CiA 302-2 V4.1, object 1F80h).
pub mod startup {
    /// The device is NMT master.
    pub const MASTER: u32 = 1;
    /// Start all nodes with one command.
    pub const START_ALL: u32 = 1 << 1;
    /// Set: the device does not enter operational by itself.
    pub const NO_SELF_START: u32 = 1 << 2;
    /// Set: the NMT master does not start the slaves; the application does.
    pub const NO_SLAVE_START: u32 = 1 << 3;
    /// A lost mandatory slave resets all nodes.
    pub const RESET_ALL: u32 = 1 << 4;
    /// Flying master.
    pub const FLYING: u32 = 1 << 5;
    /// A lost mandatory slave stops all nodes. Wins over [`RESET_ALL`].
    pub const STOP_ALL: u32 = 1 << 6;
}

/// Does a slave with this 1F80h enter operational by itself behind its boot-up (CiA 301 V4.2, 7.3.2.2, figure 41;
/// CiA 302-2 V4.1, object 1F80h bit 2)? Without the object it waits for its master.
pub fn self_starts(nmt_startup: Option<u32>) -> bool {
    nmt_startup.is_some_and(|value| value & startup::NO_SELF_START == 0)
}

/// What a command makes of the node.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NmtAction {
    /// From state, to state.
    Changed(NmtState, NmtState),
    ResetNode,
    ResetCommunication,
}

/// State machine of one slave.
#[derive(Debug, Clone, Default)]
pub struct NmtSlave {
    state: NmtState,
}

impl NmtSlave {
    pub fn state(&self) -> NmtState {
        self.state
    }
    /// Initialisation begins: power-on or one of the resets.
    pub fn initialise(&mut self) {
        self.state = NmtState::Initialising;
    }
    /// Initialisation is over: the boot-up message is due, the node is pre-operational.
    pub fn initialised(&mut self) -> NmtAction {
        self.enter(NmtState::PreOperational)
    }
    /// Changes state without a command: self-start, error behaviour.
    pub fn enter(&mut self, state: NmtState) -> NmtAction {
        let from = std::mem::replace(&mut self.state, state);
        NmtAction::Changed(from, state)
    }
    /// A frame of the bus, if it is a command for `node_id`. No command is obeyed during initialisation.
    pub fn on_frame(&mut self, node_id: u8, frame: &CanFrame) -> Option<NmtAction> {
        let (command, addressed) = NmtCommand::parse(frame)?;
        (addressed == 0 || addressed == node_id).then(|| self.command(command)).flatten()
    }
    /// A command, from the bus or from the device itself.
    pub fn command(&mut self, command: NmtCommand) -> Option<NmtAction> {
        if self.state == NmtState::Initialising {
            return None;
        }
        let to = match command {
            NmtCommand::Start => NmtState::Operational,
            NmtCommand::Stop => NmtState::Stopped,
            NmtCommand::EnterPreOperational => NmtState::PreOperational,
            NmtCommand::ResetNode => return Some(NmtAction::ResetNode),
            NmtCommand::ResetCommunication => return Some(NmtAction::ResetCommunication),
        };
        (to != self.state).then(|| self.enter(to))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(state: NmtState) -> NmtSlave {
        NmtSlave { state }
    }

    #[test]
    fn every_state_obeys_every_command() {
        use NmtState::{Operational, PreOperational, Stopped};
        for state in [Stopped, Operational, PreOperational] {
            for (command, to) in [
                (NmtCommand::Start, Operational),
                (NmtCommand::Stop, Stopped),
                (NmtCommand::EnterPreOperational, PreOperational),
            ] {
                let mut nmt = at(state);
                let action = nmt.on_frame(4, &command.frame(4));
                assert_eq!(action, (state != to).then_some(NmtAction::Changed(state, to)));
                assert_eq!(nmt.state(), to);
            }
            assert_eq!(at(state).on_frame(4, &NmtCommand::ResetNode.frame(0)), Some(NmtAction::ResetNode));
            let reset = at(state).on_frame(4, &NmtCommand::ResetCommunication.frame(4));
            assert_eq!(reset, Some(NmtAction::ResetCommunication));
        }
    }

    #[test]
    fn other_nodes_commands_and_malformed_ones_do_nothing() {
        for frame in [
            NmtCommand::Start.frame(5),
            CanFrame::classic(0, &[]),
            CanFrame::classic(0, &[1]),
            CanFrame::classic(0, &[1, 4, 0]),
            CanFrame::classic(0, &[1, 0x84]),
            CanFrame::classic(0, &[3, 4]),
            CanFrame { can_id: ipc_types::payload::id_flag::EFF, ..NmtCommand::Start.frame(4) },
        ] {
            let mut nmt = at(NmtState::PreOperational);
            assert_eq!(nmt.on_frame(4, &frame), None, "{frame:?}");
            assert_eq!(nmt.state(), NmtState::PreOperational);
        }
        assert_eq!(at(NmtState::Initialising).on_frame(4, &NmtCommand::Start.frame(0)), None);
    }

    #[test]
    fn self_start_is_bit_2_of_1f80() {
        assert!(!self_starts(None));
        assert!(self_starts(Some(0)) && self_starts(Some(8)));
        assert!(!self_starts(Some(4)) && !self_starts(Some(startup::MASTER | startup::NO_SELF_START)));
    }
}
