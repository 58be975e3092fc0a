//! Which writes to PDO parameters are allowed (CiA 301 V4.2, 7.5.2.35-38).
//!
//! The lock-step of the standard: make the PDO invalid (bit 31 of the COB-ID), set the mapping's sub-index 0 to 0,
//! write the entries, write their number, make the PDO valid.

use super::mapping::{self, Mapping, MappingEntry};
use super::{Direction, role, sub};
use crate::protocol::abort::Abort;
use crate::protocol::cob_id::CobId;
use crate::protocol::data_type::unsigned;
use crate::protocol::od::ObjectDictionary;

/// Checks a write by the network to `index`, `sub`. Indices that are no PDO parameters pass.
pub fn write(od: &ObjectDictionary, index: u16, sub: u8, data: &[u8]) -> Result<(), Abort> {
    let Some((direction, number, is_mapping)) = role(index) else { return Ok(()) };
    let value = unsigned(data.get(..4).unwrap_or(data)) as u32;
    let communication = direction.communication(number);
    let cob = CobId(od.u32(communication, sub::COB_ID).unwrap_or(crate::protocol::cob_id::BIT_31));
    if is_mapping {
        // While the PDO exists its mapping is read-only.
        if cob.exists() {
            return Err(Abort::UNSUPPORTED_ACCESS);
        }
        return if sub == 0 {
            count(od, index, value, direction)
        } else {
            entry(od, index, value, direction)
        };
    }
    match sub {
        sub::COB_ID => cob_id(cob, CobId(value)),
        sub::TRANSMISSION_TYPE => transmission_type(value, direction),
        // "The value shall not be changed while the PDO exists."
        sub::INHIBIT_TIME | sub::SYNC_START if cob.exists() => Err(Abort::INVALID_VALUE),
        sub::SYNC_START if value > 240 => Err(Abort::INVALID_VALUE),
        _ => Ok(()),
    }
}

/// A COB-ID object that bit 31 switches: bits 0-29 keep while it exists, and what exists has no restricted
/// identifier.
pub fn cob_id(old: CobId, new: CobId) -> Result<(), Abort> {
    let moved = old.exists() && new.exists() && old.identity() != new.identity();
    if moved || (new.exists() && new.fault().is_some()) {
        return Err(Abort::INVALID_VALUE);
    }
    Ok(())
}

fn transmission_type(value: u32, direction: Direction) -> Result<(), Abort> {
    let reserved = match direction {
        // Tables 72 and 76.
        Direction::Receive => 241..=253,
        Direction::Transmit => 241..=251,
    };
    if reserved.contains(&value) { Err(Abort::INVALID_VALUE) } else { Ok(()) }
}

fn count(od: &ObjectDictionary, index: u16, value: u32, direction: Direction) -> Result<(), Abort> {
    let count = u8::try_from(value).map_err(|_| Abort::PDO_LENGTH)?;
    Mapping::load(od, index, count, direction).map(|_| ())
}

fn entry(od: &ObjectDictionary, index: u16, value: u32, direction: Direction) -> Result<(), Abort> {
    if od.u8(index, 0).unwrap_or(0) != 0 {
        return Err(Abort::UNSUPPORTED_ACCESS);
    }
    let wanted = MappingEntry::from_object(value);
    // 0 empties an entry. Longer than a whole PDO says so.
    if value == 0 {
        return Ok(());
    }
    if wanted.bits > 64 {
        return Err(Abort::PDO_LENGTH);
    }
    mapping::check_entry(od, value, direction)
}
