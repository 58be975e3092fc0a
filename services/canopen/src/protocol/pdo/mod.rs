//! PDO: communication and mapping parameters, transmission types, reception and transmission (CiA 301 V4.2, 7.2.2 and
//! 7.5.2.35-38).
//!
//! [`Pdos`] holds all PDOs of a device. Its objects 1400h-15FFh, 1600h-17FFh, 1800h-19FFh and 1A00h-1BFFh are the
//! dictionary's; [`check`] says which writes to them are allowed, [`Pdos::after_write`] makes them take effect.
//! Multiplex PDOs (SAM, DAM) are not supported: a sub-index 0 of 254 or 255 is refused.

pub mod check;
pub mod mapping;
pub mod rpdo;
pub mod set;
pub mod tpdo;

pub use set::Pdos;

use crate::protocol::od::ObjectDictionary;

/// RPDOs and TPDOs that a device can have each (CiA 301 V4.2, 7.5.2.35: 1400h-15FFh).
pub const PDOS: u16 = 512;
/// RPDO communication parameter.
pub const RPDO_COMMUNICATION: u16 = 0x1400;
/// RPDO mapping parameter.
pub const RPDO_MAPPING: u16 = 0x1600;
/// TPDO communication parameter.
pub const TPDO_COMMUNICATION: u16 = 0x1800;
/// TPDO mapping parameter.
pub const TPDO_MAPPING: u16 = 0x1A00;

/// Sub-indices of a communication parameter (CiA 301 V4.2, 7.4.8.1, object 0020h).
pub mod sub {
    pub const COB_ID: u8 = 1;
    pub const TRANSMISSION_TYPE: u8 = 2;
    /// In 100 us. TPDO only.
    pub const INHIBIT_TIME: u8 = 3;
    /// In ms. Of an RPDO: deadline.
    pub const EVENT_TIMER: u8 = 5;
    /// TPDO only.
    pub const SYNC_START: u8 = 6;
}

/// Which way a PDO goes, as seen by the device.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Direction {
    /// RPDO.
    Receive,
    /// TPDO.
    Transmit,
}

impl Direction {
    /// Index of the communication parameter of PDO `number` (0-based).
    pub fn communication(self, number: u16) -> u16 {
        number + if self == Self::Receive { RPDO_COMMUNICATION } else { TPDO_COMMUNICATION }
    }
    /// Index of the mapping parameter of PDO `number` (0-based).
    pub fn mapping(self, number: u16) -> u16 {
        number + if self == Self::Receive { RPDO_MAPPING } else { TPDO_MAPPING }
    }
}

/// What an index in 1400h-1BFFh is: direction, number of the PDO (0-based), is it the mapping parameter?
pub fn role(index: u16) -> Option<(Direction, u16, bool)> {
    let number = index & (PDOS - 1);
    Some(match index & !(PDOS - 1) {
        RPDO_COMMUNICATION => (Direction::Receive, number, false),
        RPDO_MAPPING => (Direction::Receive, number, true),
        TPDO_COMMUNICATION => (Direction::Transmit, number, false),
        TPDO_MAPPING => (Direction::Transmit, number, true),
        _ => return None,
    })
}

/// What happened to a PDO. `number` is 0-based: RPDO 1 of 1400h is 0.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PdoEvent {
    /// The values of an RPDO are in the dictionary (of a synchronous one: since this SYNC).
    Received { number: u16 },
    /// Shorter than its mapping: not processed (EMCY 8210h).
    TooShort { number: u16, id: u32, got: u8, mapped: u8 },
    /// Longer than its mapping: the first bytes were processed (EMCY 8220h).
    TooLong { number: u16, id: u32, got: u8, mapped: u8 },
    /// An RPDO whose length was wrong has the right one again.
    LengthRight { number: u16 },
    /// No RPDO within its event timer (EMCY 8250h).
    Timeout { number: u16, id: u32 },
    /// An RPDO that had timed out is back.
    Resumed { number: u16 },
    /// A synchronous RPDO behind the synchronous window was thrown away (CiA 301 V4.2, 7.5.2.7).
    OutsideWindow { number: u16 },
}

/// Communication parameters of one PDO, as the dictionary has them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Communication {
    pub cob: super::cob_id::CobId,
    pub transmission_type: u8,
    pub inhibit_100us: u16,
    pub event_timer_ms: u16,
    pub sync_start: u8,
}

impl Communication {
    /// Reads the communication parameter at `index`; what it lacks has the standard's default (type 255, timers 0).
    pub fn load(od: &ObjectDictionary, index: u16) -> Self {
        Self {
            cob: super::cob_id::CobId(od.u32(index, sub::COB_ID).unwrap_or(super::cob_id::BIT_31)),
            transmission_type: od.u8(index, sub::TRANSMISSION_TYPE).unwrap_or(255),
            inhibit_100us: od.u16(index, sub::INHIBIT_TIME).unwrap_or(0),
            event_timer_ms: od.u16(index, sub::EVENT_TIMER).unwrap_or(0),
            sync_start: od.u8(index, sub::SYNC_START).unwrap_or(0),
        }
    }
}
