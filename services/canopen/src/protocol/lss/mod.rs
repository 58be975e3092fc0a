//! LSS: node-ids and bit timing over the bus (CiA 305 V3.0).
//!
//! Both sides speak frames of 8 bytes with the command specifier in byte 0; unused bytes are 0.

pub mod master;
pub mod slave;

use ipc_types::payload::CanFrame;
use serde::{Deserialize, Serialize};

use super::cob_id::predefined;

/// Node-id of a device that has none (CiA 305 V3.0).
pub const UNCONFIGURED: u8 = 0xFF;

/// Command specifiers (CiA 305 V3.0, 6.3 to 6.7, figures 31 to 46).
pub mod cs {
    pub const SWITCH_GLOBAL: u8 = 0x04;
    pub const CONFIGURE_NODE_ID: u8 = 0x11;
    pub const CONFIGURE_BIT_TIMING: u8 = 0x13;
    pub const ACTIVATE_BIT_TIMING: u8 = 0x15;
    pub const STORE: u8 = 0x17;
    pub const SWITCH_SELECTIVE_VENDOR: u8 = 0x40;
    pub const SWITCH_SELECTIVE_PRODUCT: u8 = 0x41;
    pub const SWITCH_SELECTIVE_REVISION: u8 = 0x42;
    pub const SWITCH_SELECTIVE_SERIAL: u8 = 0x43;
    pub const SWITCH_SELECTIVE_ANSWER: u8 = 0x44;
    pub const IDENTIFY_VENDOR: u8 = 0x46;
    pub const IDENTIFY_PRODUCT: u8 = 0x47;
    pub const IDENTIFY_REVISION_LOW: u8 = 0x48;
    pub const IDENTIFY_REVISION_HIGH: u8 = 0x49;
    pub const IDENTIFY_SERIAL_LOW: u8 = 0x4A;
    pub const IDENTIFY_SERIAL_HIGH: u8 = 0x4B;
    pub const IDENTIFY_NON_CONFIGURED: u8 = 0x4C;
    pub const IDENTIFY_ANSWER: u8 = 0x4F;
    pub const NON_CONFIGURED_ANSWER: u8 = 0x50;
    pub const FASTSCAN: u8 = 0x51;
    pub const INQUIRE_VENDOR: u8 = 0x5A;
    pub const INQUIRE_PRODUCT: u8 = 0x5B;
    pub const INQUIRE_REVISION: u8 = 0x5C;
    pub const INQUIRE_SERIAL: u8 = 0x5D;
    pub const INQUIRE_NODE_ID: u8 = 0x5E;
}

/// Bit timing table 0 (CiA 305 V3.0, 6.4.3): index -> kbit/s; 0 = reserved.
pub const BIT_TIMING_KBIT: [u16; 10] = [1000, 800, 500, 250, 125, 0, 50, 20, 10, 0];
/// Index of automatic bit rate detection.
pub const BIT_TIMING_AUTO: u8 = 9;

/// The LSS address: the identity object 1018h (CiA 305 V3.0).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Hash, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LssAddress {
    pub vendor: u32,
    pub product: u32,
    pub revision: u32,
    pub serial: u32,
}

impl LssAddress {
    /// In the order of fastscan: vendor, product, revision, serial.
    pub fn parts(&self) -> [u32; 4] {
        [self.vendor, self.product, self.revision, self.serial]
    }
    pub fn from_parts([vendor, product, revision, serial]: [u32; 4]) -> Self {
        Self { vendor, product, revision, serial }
    }
}

/// States of an LSS slave (CiA 305 V3.0).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[repr(u8)]
pub enum LssState {
    #[default]
    Waiting = 0,
    Configuration = 1,
}

fn frame(id: u32, cs: u8, rest: [u8; 7]) -> CanFrame {
    let mut data = [cs; 8];
    data[1..].copy_from_slice(&rest);
    CanFrame::classic(id, &data)
}

/// Command of a master, value in bytes 1-4.
fn command_u32(cs: u8, value: u32) -> CanFrame {
    let [a, b, c, d] = value.to_le_bytes();
    frame(predefined::LSS_MASTER, cs, [a, b, c, d, 0, 0, 0])
}

/// The 8 bytes of an LSS frame with this identifier.
fn parse(frame: &CanFrame, id: u32) -> Option<[u8; 8]> {
    if frame.can_id != id {
        return None;
    }
    frame.payload().try_into().ok()
}

fn u32_of(data: &[u8; 8]) -> u32 {
    u32::from_le_bytes([data[1], data[2], data[3], data[4]])
}

#[cfg(test)]
mod tests;
