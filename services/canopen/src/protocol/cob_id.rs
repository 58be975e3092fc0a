//! COB-IDs as objects hold them, and the identifiers that CiA 301 gives away beforehand.

use ipc_types::payload::{CanFrame, id_flag};

/// Bit 31 of most COB-ID objects: set = the communication object does not exist (CiA 301 V4.2, 7.5.2.17 for EMCY,
/// 7.5.2.33-38 for SDO and PDO). In 1012h the bit has another meaning: the device consumes TIME.
pub const BIT_31: u32 = 0x8000_0000;
/// Bit 30: 1005h and 1012h: the device produces SYNC, TIME (CiA 301 V4.2, 7.5.2.5 and 7.5.2.15); 1800h sub 1: no RTR
/// allowed (7.5.2.37).
pub const BIT_30: u32 = 0x4000_0000;
/// Bit 29: the identifier has 29 bits.
pub const BIT_FRAME: u32 = 0x2000_0000;

/// The predefined connection set (CiA 301 V4.2, 7.3.3, tables 38 and 39).
pub mod predefined {
    /// NMT node control.
    pub const NMT: u32 = 0x000;
    /// SYNC.
    pub const SYNC: u32 = 0x080;
    /// EMCY: plus node-id.
    pub const EMCY: u32 = 0x080;
    /// TIME.
    pub const TIME: u32 = 0x100;
    /// TPDO 1: plus node-id; the next TPDOs 100h apart.
    pub const TPDO: u32 = 0x180;
    /// RPDO 1: plus node-id; the next RPDOs 100h apart.
    pub const RPDO: u32 = 0x200;
    /// SDO server to client: plus node-id.
    pub const SDO_TX: u32 = 0x580;
    /// SDO client to server: plus node-id.
    pub const SDO_RX: u32 = 0x600;
    /// NMT error control: plus node-id.
    pub const ERROR_CONTROL: u32 = 0x700;
    /// LSS slave to master (CiA 305 V3.0).
    pub const LSS_SLAVE: u32 = 0x7E4;
    /// LSS master to slave (CiA 305 V3.0).
    pub const LSS_MASTER: u32 = 0x7E5;
}

/// The value of a COB-ID object.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct CobId(pub u32);

impl CobId {
    /// Bit 31 is clear.
    pub fn exists(self) -> bool {
        self.0 & BIT_31 == 0
    }
    /// Bit 30 is set.
    pub fn bit30(self) -> bool {
        self.0 & BIT_30 != 0
    }
    /// The identifier alone.
    pub fn id(self) -> u32 {
        if self.is_extended() { self.0 & id_flag::EFF_MASK } else { self.0 & id_flag::SFF_MASK }
    }
    pub fn is_extended(self) -> bool {
        self.0 & BIT_FRAME != 0
    }
    /// Frame format and identifier, without what bits 30 and 31 say: bits 0-29, which may not change while the
    /// object exists.
    pub fn identity(self) -> u32 {
        self.0 & !(BIT_31 | BIT_30)
    }
    /// `can_id` of a data frame with this identifier.
    pub fn can_id(self) -> u32 {
        if self.is_extended() { self.id() | id_flag::EFF } else { self.id() }
    }
    /// Data or remote frame, does it carry this identifier?
    pub fn matches(self, frame: &CanFrame) -> bool {
        !frame.is_error() && frame.can_id & !id_flag::RTR == self.can_id()
    }
    /// Why the identifier cannot be given to a communication object, if so: bits set that the frame format does not
    /// have, or a restricted CAN-ID (CiA 301 V4.2, 7.3.5, table 40).
    pub fn fault(self) -> Option<&'static str> {
        if self.is_extended() {
            return None;
        }
        if self.0 & id_flag::EFF_MASK > id_flag::SFF_MASK {
            return Some("identifier above 7FFh without the bit for 29-bit identifiers");
        }
        is_restricted(self.id()).then_some("restricted CAN-ID")
    }
    /// A data frame with this identifier.
    pub fn frame(self, data: &[u8]) -> CanFrame {
        let mut frame = CanFrame::classic(self.id(), data);
        frame.can_id = self.can_id();
        frame
    }
    /// A remote frame with this identifier that asks for `len` bytes.
    pub fn remote(self, len: u8) -> CanFrame {
        CanFrame { can_id: self.can_id() | id_flag::RTR, len: len.min(8), ..CanFrame::default() }
    }
}

/// Restricted CAN-IDs: they shall not be used as CAN-ID by any configurable communication object (CiA 301 V4.2,
/// 7.3.5, table 40).
pub fn is_restricted(id: u32) -> bool {
    matches!(id,
        0x000..=0x07F | 0x101..=0x180 | 0x581..=0x5FF | 0x601..=0x67F | 0x6E0..=0x6FF | 0x701..=0x7FF)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn restricted_identifiers_of_table_40() {
        let free: Vec<u32> = (0..0x800).filter(|&id| !is_restricted(id)).collect();
        assert_eq!(free.len(), 0x800 - 797, "the conformance tool tries 797 of them");
        for id in [0x080, 0x081, 0x100, 0x181, 0x57F, 0x580, 0x600, 0x680, 0x6DF, 0x700] {
            assert!(!is_restricted(id), "{id:03X}");
        }
    }

    #[test]
    fn identifiers_and_frames() {
        let cob = CobId(0x4000_0184);
        assert!(cob.exists() && cob.bit30());
        assert_eq!(cob.can_id(), 0x184);
        assert!(cob.matches(&cob.frame(&[1])) && cob.matches(&cob.remote(2)));
        assert_eq!(
            CobId(0x0000_2EA6).fault(),
            Some("identifier above 7FFh without the bit for 29-bit identifiers")
        );
        let extended = CobId(0x2000_0184);
        assert!(!extended.matches(&cob.frame(&[])) && extended.matches(&extended.frame(&[])));
        assert!(!cob.exists() || CobId(0x8000_0184).fault().is_none());
    }
}
