//! LSS slave.

use ipc_types::payload::CanFrame;

use super::{BIT_TIMING_AUTO, BIT_TIMING_KBIT, LssAddress, LssState, UNCONFIGURED, cs, frame, parse, u32_of};
use crate::protocol::cob_id::predefined;
use crate::protocol::io::Outbox;

/// What the owner has to do, or may want to know.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LssSlaveEvent {
    /// The device had no node-id and has one now: it starts with it (CiA 305 V3.0).
    NodeIdActive { node_id: u8 },
    /// Another node-id was given; it takes effect at the next reset communication.
    NodeIdPending { node_id: u8 },
    /// Another bit timing was chosen; it takes effect with [`LssSlaveEvent::ActivateBitTiming`].
    BitTimingPending { kbit: u16 },
    /// Stop sending, change the bit timing after `delay_ms`, send again after another `delay_ms`.
    ActivateBitTiming { kbit: u16, delay_ms: u16 },
    /// Keep node-id and bit timing over power-off (kbit 0: never configured).
    Store { node_id: u8, kbit: u16 },
    /// The LSS state changed.
    State(LssState),
}

/// What the device can do.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LssAbilities {
    /// Node-id and bit timing can be kept.
    pub store: bool,
    /// Bit rates of table 0 that can be chosen: bit n = index n. 0: bit timing cannot be configured.
    pub bit_timing: u16,
}

impl Default for LssAbilities {
    fn default() -> Self {
        Self { store: true, bit_timing: 0b1_1101_1111 }
    }
}

/// One LSS slave.
#[derive(Debug, Clone)]
pub struct LssSlave {
    address: LssAddress,
    abilities: LssAbilities,
    state: LssState,
    active_node_id: u8,
    pending_node_id: u8,
    pending_kbit: u16,
    /// Parts of the address that matched so far: switch state selective.
    selected: u8,
    /// Parts that matched so far: identify remote slave.
    identified: u8,
    fastscan_at: u8,
}

impl LssSlave {
    /// `node_id`: 1-127, or [`UNCONFIGURED`].
    pub fn new(address: LssAddress, node_id: u8, abilities: LssAbilities) -> Self {
        Self {
            address,
            abilities,
            state: LssState::Waiting,
            active_node_id: node_id,
            pending_node_id: node_id,
            pending_kbit: 0,
            selected: 0,
            identified: 0,
            fastscan_at: 0,
        }
    }
    /// The identity object changed: the application knows the serial number.
    pub fn set_address(&mut self, address: LssAddress) {
        self.address = address;
    }
    pub fn state(&self) -> LssState {
        self.state
    }
    /// Node-id that the next reset communication takes.
    pub fn pending_node_id(&self) -> u8 {
        self.pending_node_id
    }
    /// The node was reset: the pending node-id is the active one, and a slave that was being configured waits again.
    pub fn reset(&mut self) -> Option<LssSlaveEvent> {
        self.active_node_id = self.pending_node_id;
        (self.identified, self.fastscan_at) = (0, 0);
        self.enter(LssState::Waiting)
    }
    fn enter(&mut self, state: LssState) -> Option<LssSlaveEvent> {
        self.selected = 0;
        let from = std::mem::replace(&mut self.state, state);
        if from == LssState::Configuration
            && state == LssState::Waiting
            && self.active_node_id == UNCONFIGURED
            && self.pending_node_id != UNCONFIGURED
        {
            self.active_node_id = self.pending_node_id;
            return Some(LssSlaveEvent::NodeIdActive { node_id: self.active_node_id });
        }
        (from != state).then_some(LssSlaveEvent::State(state))
    }
    /// A frame of the bus.
    pub fn on_frame(&mut self, frame: &CanFrame, out: &mut Outbox) -> Option<LssSlaveEvent> {
        let data = parse(frame, predefined::LSS_MASTER)?;
        match data[0] {
            cs::SWITCH_GLOBAL => match data[1] {
                0 => self.enter(LssState::Waiting),
                1 => self.enter(LssState::Configuration),
                _ => None,
            },
            cs::SWITCH_SELECTIVE_VENDOR..=cs::SWITCH_SELECTIVE_SERIAL => self.switch_selective(&data, out),
            cs::IDENTIFY_VENDOR..=cs::IDENTIFY_SERIAL_HIGH => {
                self.identify(&data, out);
                None
            }
            cs::IDENTIFY_NON_CONFIGURED => {
                // Answered by devices without node-id, neither active nor pending (CiA 305 V3.0, figure 44).
                if self.active_node_id == UNCONFIGURED && self.pending_node_id == UNCONFIGURED {
                    answer(cs::NON_CONFIGURED_ANSWER, [0; 7], out);
                }
                None
            }
            cs::FASTSCAN => self.fastscan(&data, out),
            _ if self.state == LssState::Configuration => self.configure(&data, out),
            _ => None,
        }
    }
    /// Vendor, product, revision, serial, in this order; a wrong one starts it anew (CiA 305 V3.0, figure 32).
    fn switch_selective(&mut self, data: &[u8; 8], out: &mut Outbox) -> Option<LssSlaveEvent> {
        if self.state != LssState::Waiting {
            return None;
        }
        let part = data[0] - cs::SWITCH_SELECTIVE_VENDOR;
        let right = self.address.parts().get(usize::from(part)) == Some(&u32_of(data));
        if part == 0 {
            self.selected = u8::from(right);
        } else if right && self.selected == part {
            self.selected += 1;
        } else {
            self.selected = 0;
        }
        if self.selected < 4 {
            return None;
        }
        let event = self.enter(LssState::Configuration);
        answer(cs::SWITCH_SELECTIVE_ANSWER, [0; 7], out);
        event
    }
    /// Vendor and product exactly, revision and serial within a range (CiA 305 V3.0, figure 42).
    fn identify(&mut self, data: &[u8; 8], out: &mut Outbox) {
        let value = u32_of(data);
        let own = &self.address;
        let (step, right) = match data[0] {
            cs::IDENTIFY_VENDOR => (0, value == own.vendor),
            cs::IDENTIFY_PRODUCT => (1, value == own.product),
            cs::IDENTIFY_REVISION_LOW => (2, own.revision >= value),
            cs::IDENTIFY_REVISION_HIGH => (3, own.revision <= value),
            cs::IDENTIFY_SERIAL_LOW => (4, own.serial >= value),
            _ => (5, own.serial <= value),
        };
        self.identified = match (right, step) {
            (true, 0) => 1,
            (true, step) if self.identified == step => step + 1,
            _ => 0,
        };
        if self.identified == 6 {
            self.identified = 0;
            answer(cs::IDENTIFY_ANSWER, [0; 7], out);
        }
    }
    /// Takes part while without node-id and waiting (CiA 305 V3.0, 6.7, figure 46). Bytes: IDNumber, BitCheck, LSSSub,
    /// LSSNext.
    fn fastscan(&mut self, data: &[u8; 8], out: &mut Outbox) -> Option<LssSlaveEvent> {
        if self.active_node_id != UNCONFIGURED
            || self.pending_node_id != UNCONFIGURED
            || self.state != LssState::Waiting
        {
            return None;
        }
        let (bit_check, sub, next) = (data[5], data[6], data[7]);
        if bit_check == 0x80 {
            self.fastscan_at = 0;
            answer(cs::IDENTIFY_ANSWER, [0; 7], out);
            return None;
        }
        if bit_check > 31 || sub > 3 || next > 3 || sub != self.fastscan_at {
            return None;
        }
        let own = self.address.parts()[usize::from(sub)];
        if (own ^ u32_of(data)) >> bit_check != 0 {
            return None;
        }
        let mut event = None;
        self.fastscan_at = next;
        if bit_check == 0 && next < sub {
            // The last part matched whole: this slave is the one.
            event = self.enter(LssState::Configuration);
        }
        answer(cs::IDENTIFY_ANSWER, [0; 7], out);
        event
    }
    fn configure(&mut self, data: &[u8; 8], out: &mut Outbox) -> Option<LssSlaveEvent> {
        let own = self.address;
        match data[0] {
            cs::CONFIGURE_NODE_ID => {
                // Figure 33: error code 1 = node-id out of range.
                let right = matches!(data[1], 1..=127 | UNCONFIGURED);
                if right {
                    self.pending_node_id = data[1];
                }
                answer(cs::CONFIGURE_NODE_ID, [u8::from(!right), 0, 0, 0, 0, 0, 0], out);
                right.then_some(LssSlaveEvent::NodeIdPending { node_id: data[1] })
            }
            cs::CONFIGURE_BIT_TIMING => {
                // Figure 34: error code 1 = bit timing not supported. Table selector 0 = CiA.
                let (table, index) = (data[1], data[2]);
                let right = table == 0 && index < 16 && self.abilities.bit_timing & (1 << index) != 0;
                let kbit = BIT_TIMING_KBIT.get(usize::from(index)).copied().unwrap_or(0);
                let right = right && (kbit > 0 || index == BIT_TIMING_AUTO);
                if right {
                    self.pending_kbit = kbit;
                }
                answer(cs::CONFIGURE_BIT_TIMING, [u8::from(!right), 0, 0, 0, 0, 0, 0], out);
                right.then_some(LssSlaveEvent::BitTimingPending { kbit })
            }
            cs::ACTIVATE_BIT_TIMING => {
                let delay_ms = u16::from_le_bytes([data[1], data[2]]);
                (self.pending_kbit > 0)
                    .then_some(LssSlaveEvent::ActivateBitTiming { kbit: self.pending_kbit, delay_ms })
            }
            cs::STORE => {
                // Figure 36: error code 1 = storing not supported.
                answer(cs::STORE, [u8::from(!self.abilities.store), 0, 0, 0, 0, 0, 0], out);
                let (node_id, kbit) = (self.pending_node_id, self.pending_kbit);
                self.abilities.store.then_some(LssSlaveEvent::Store { node_id, kbit })
            }
            cs @ cs::INQUIRE_VENDOR..=cs::INQUIRE_SERIAL => {
                let part = own.parts()[usize::from(cs - cs::INQUIRE_VENDOR)];
                answer_u32(cs, part, out);
                None
            }
            cs::INQUIRE_NODE_ID => {
                // A device that has no node-id yet tells the one it is going to have (6.5.3).
                let configured = self.active_node_id != UNCONFIGURED;
                let node_id = if configured { self.active_node_id } else { self.pending_node_id };
                answer(cs::INQUIRE_NODE_ID, [node_id, 0, 0, 0, 0, 0, 0], out);
                None
            }
            _ => None,
        }
    }
}

fn answer(cs: u8, rest: [u8; 7], out: &mut Outbox) {
    out.push(frame(predefined::LSS_SLAVE, cs, rest));
}

fn answer_u32(cs: u8, value: u32, out: &mut Outbox) {
    let [a, b, c, d] = value.to_le_bytes();
    answer(cs, [a, b, c, d, 0, 0, 0], out);
}
