//! COB-IDs: those that a stack file may give away, and two of a network that are one.

use super::pdo::{Direction, Pdo};
use super::{One, Taken};
use crate::config::MasterConfig as Config;
use crate::mistakes::Mistakes;
use crate::protocol::abort::Abort;
use crate::protocol::cob_id::{CobId, predefined};
use crate::protocol::data_type::unsigned;

const NODE_IDS: std::ops::RangeInclusive<u32> = 1..=127;

/// Whether a PDO may have the identifier: not restricted, and nothing else's by the predefined connection set (CiA 301
/// V4.2, clauses 7.3.3 and 7.3.5).
pub(super) fn is_for_pdo(cob: CobId) -> bool {
    cob.is_extended() || matches!(cob.id(), 0x181..=0x57F | 0x680..=0x6DF)
}

/// The SYNC's.
pub(super) fn check_sync(config: &Config, mistakes: &mut Mistakes) {
    let id = u32::from(config.sync_cob_id);
    let node = id.wrapping_sub(predefined::EMCY);
    let message = if let Some(fault) = CobId(id).fault() {
        format!("{id:X}h cannot be the COB-ID of the SYNC: {fault}")
    } else if id == predefined::TIME {
        format!("{id:X}h cannot be the COB-ID of the SYNC: it is that of TIME")
    } else if NODE_IDS.contains(&node)
        && (node == u32::from(config.node_id) || config.nodes.iter().any(|n| u32::from(n.id) == node))
    {
        format!("{id:X}h cannot be the COB-ID of the SYNC: emergencies of node {node} have it")
    } else if matches!(id, predefined::SDO_TX | predefined::SDO_RX | predefined::ERROR_CONTROL) {
        format!("{id:X}h cannot be the COB-ID of the SYNC: it lies among those of SDO and heartbeat")
    } else {
        return;
    };
    mistakes.add(
        "sync_cob_id",
        message,
        "leave it out for 080h, or take 181h to 57Fh (CiA 301 clause 7.3.5)",
    );
}

/// What the network has before its PDOs. An emergency is taken for what the predefined connection set says it is.
pub(super) fn taken(config: &Config) -> Taken {
    let mut taken = Taken::new();
    if config.sync_period.is_some() {
        taken.insert(u32::from(config.sync_cob_id), ("the SYNC".to_owned(), Some("sync_cob_id".to_owned())));
    }
    taken
}

/// Whether an object holds the COB-ID of SYNC, TIME, EMCY or a PDO. Those of SDO channels are left to the device: a client
/// of default servers has restricted ones.
fn is_cob_id(index: u16, sub: u8) -> bool {
    match index {
        0x1005 | 0x1012 | 0x1014 => sub == 0,
        0x1400..=0x15FF | 0x1800..=0x19FF => sub == 1,
        _ => false,
    }
}

impl One<'_> {
    /// A COB-ID that the stack file writes by `sdo`, and that every device has to refuse.
    pub(super) fn check_cob_id(&mut self, index: u16, sub: u8, data: &[u8], key: &str) {
        if !is_cob_id(index, sub) {
            return;
        }
        let cob = CobId(unsigned(data.get(..4).unwrap_or(data)) as u32);
        // In 1005h and 1012h bit 31 does not switch the object off.
        let switched_off = !matches!(index, 0x1005 | 0x1012) && !cob.exists();
        if let Some(fault) = cob.fault().filter(|_| !switched_off) {
            let message = format!(
                "{index:04X}:{sub:02X} cannot be {:X}h: {fault}; a device refuses it by abort {:08X}h",
                cob.id(),
                Abort::INVALID_VALUE.0
            );
            let help = "take 181h to 57Fh, or 680h to 6DFh (CiA 301 clause 7.3.5)";
            self.mistakes.add(&format!("{key}.value"), message, help);
        }
    }

    /// The SYNC's COB-ID, where a node does not listen to it by itself. An EDS that leaves it open says 0, which no SYNC
    /// can have: then it is the usual one.
    pub(super) fn sync_cob_id_default(&self, default: u32) -> Option<u32> {
        let wanted = u32::from(self.config.sync_cob_id);
        let own = match CobId(default).can_id() {
            0 => predefined::SYNC,
            id => id,
        };
        (own != wanted).then_some(wanted)
    }

    /// Two PDOs of the network with one COB-ID, or one with the SYNC's.
    pub(super) fn doubled(&mut self, pdos: &[Pdo], taken: &mut Taken) {
        for pdo in pdos.iter().filter(|p| p.is_active() && (p.used || p.direction == Direction::Tpdo)) {
            let id = CobId(pdo.cob_id).can_id();
            let what = format!("{} {} of node {}", pdo.direction.name(), pdo.number, self.node.id);
            let key = self.cob_id_key(pdo);
            if let Some((other, key_of_other)) = taken.get(&id) {
                let message =
                    format!("{what} and {other} have the same COB-ID {:03X}h", CobId(pdo.cob_id).id());
                let key = key.as_ref().or(key_of_other.as_ref()).map_or(self.key, String::as_str);
                self.mistakes.add(key, message, "give one of them another with cob_id");
            } else {
                taken.insert(id, (what, key));
            }
        }
    }

    /// Where the stack file writes the COB-ID of a PDO.
    fn cob_id_key(&self, pdo: &Pdo) -> Option<String> {
        let (table, written) = match pdo.direction {
            Direction::Tpdo => ("tpdo", &self.node.tpdo),
            Direction::Rpdo => ("rpdo", &self.node.rpdo),
        };
        let at = written.iter().position(|w| w.number == pdo.number && w.cob_id.is_some())?;
        Some(format!("{}.{table}[{at}].cob_id", self.key))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::protocol::cob_id::{BIT_31, is_restricted};

    #[test]
    fn a_pdo_never_has_an_identifier_of_another_kind() {
        for id in 0..0x800 {
            if is_for_pdo(CobId(id)) {
                assert!(!is_restricted(id) && id > predefined::TIME, "{id:03X}");
                let kind = id & 0x780;
                assert!(kind != predefined::SDO_TX && kind != predefined::ERROR_CONTROL, "{id:03X}");
            }
        }
        assert!(is_for_pdo(CobId(0x2000_0005)), "29 bits: nothing is given away there");
        assert!(!is_for_pdo(CobId(BIT_31)));
    }
}
