//! PDO mapping: which objects lie where in the up to 64 bits of a PDO (CiA 301 V4.2, 7.5.2.36 and 7.5.2.38).

use super::Direction;
use crate::protocol::abort::Abort;
use crate::protocol::data_type::{DataType, unsigned};
use crate::protocol::od::{EntryRef, ObjectDictionary};

/// Entries of a mapping: 64 of one bit each.
pub const ENTRIES: usize = 64;
/// Bits of a PDO on a classic bus.
pub const BITS: u16 = 64;

/// One mapping entry: `index << 16 | sub << 8 | bits` (CiA 301 V4.2, 7.5.2.36, figure 73).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MappingEntry {
    pub index: u16,
    pub sub: u8,
    pub bits: u8,
}

impl MappingEntry {
    pub fn from_object(value: u32) -> Self {
        Self { index: (value >> 16) as u16, sub: (value >> 8) as u8, bits: value as u8 }
    }
    pub fn to_object(self) -> u32 {
        u32::from(self.index) << 16 | u32::from(self.sub) << 8 | u32::from(self.bits)
    }
}

#[derive(Debug, Clone, Copy)]
struct Mapped {
    /// None: a dummy that skips bits.
    entry: Option<EntryRef>,
    bits: u8,
}

/// A checked mapping.
#[derive(Debug, Clone)]
pub struct Mapping {
    items: [Mapped; ENTRIES],
    count: usize,
    bits: u16,
}

impl Default for Mapping {
    fn default() -> Self {
        Self { items: [Mapped { entry: None, bits: 0 }; ENTRIES], count: 0, bits: 0 }
    }
}

/// May this object be mapped in this direction with this length?
pub fn check_entry(od: &ObjectDictionary, value: u32, direction: Direction) -> Result<(), Abort> {
    resolve(od, value, direction).map(|_| ())
}

fn resolve(od: &ObjectDictionary, value: u32, direction: Direction) -> Result<Mapped, Abort> {
    let wanted = MappingEntry::from_object(value);
    if wanted.index <= 7 {
        // Dummy mapping (7.4.7): data types as place holders, in RPDOs.
        let bits = DataType::from_index(wanted.index).bits();
        let fits = wanted.sub == 0 && bits == Some(wanted.bits);
        return if direction == Direction::Receive && od.dummy_allowed(wanted.index) && fits {
            Ok(Mapped { entry: None, bits: wanted.bits })
        } else {
            Err(Abort::NOT_MAPPABLE)
        };
    }
    let at = od.find(wanted.index, wanted.sub).map_err(|_| Abort::NO_OBJECT)?;
    let entry = od.entry(at).ok_or(Abort::INTERNAL)?;
    let way = match direction {
        Direction::Receive => entry.access.in_rpdo(),
        Direction::Transmit => entry.access.in_tpdo(),
    };
    if !entry.mappable || !way || entry.pdo_bits() != Some(wanted.bits) {
        return Err(Abort::NOT_MAPPABLE);
    }
    Ok(Mapped { entry: Some(at), bits: wanted.bits })
}

impl Mapping {
    /// Reads and checks the first `count` entries of the mapping parameter at `index`.
    pub fn load(od: &ObjectDictionary, index: u16, count: u8, direction: Direction) -> Result<Self, Abort> {
        let mut mapping = Self::default();
        if usize::from(count) > ENTRIES {
            return Err(Abort::PDO_LENGTH);
        }
        for sub in 1..=count {
            let value = od.u32(index, sub).ok_or(Abort::PDO_LENGTH)?;
            let item = resolve(od, value, direction)?;
            mapping.bits += u16::from(item.bits);
            if mapping.bits > BITS {
                return Err(Abort::PDO_LENGTH);
            }
            mapping.items[mapping.count] = item;
            mapping.count += 1;
        }
        Ok(mapping)
    }
    /// Nothing is mapped.
    pub fn is_empty(&self) -> bool {
        self.bits == 0
    }
    /// Length of the PDO in bytes.
    pub fn bytes(&self) -> u8 {
        self.bits.div_ceil(8) as u8
    }
    /// The mapped sub-objects, dummies left out.
    pub fn entries(&self) -> impl Iterator<Item = EntryRef> + '_ {
        self.items[..self.count].iter().filter_map(|item| item.entry)
    }
    /// The values as they lie in the PDO: first entry in the lowest bits (7.2.2.6).
    pub fn pack(&self, od: &ObjectDictionary) -> [u8; 8] {
        let (mut data, mut at) = (0u64, 0u32);
        for item in &self.items[..self.count] {
            if let Some(entry) = item.entry {
                let value = unsigned(od.get(entry).get(..8).unwrap_or(od.get(entry)));
                data |= (value & mask(item.bits)).checked_shl(at).unwrap_or(0);
            }
            at += u32::from(item.bits);
        }
        data.to_le_bytes()
    }
    /// Writes the values of a PDO into the dictionary.
    pub fn unpack(&self, od: &mut ObjectDictionary, data: [u8; 8]) {
        let data = u64::from_le_bytes(data);
        let mut at = 0u32;
        for item in &self.items[..self.count] {
            if let Some(entry) = item.entry {
                let value = data.checked_shr(at).unwrap_or(0) & mask(item.bits);
                let bytes = value.to_le_bytes();
                let len = usize::from(item.bits.div_ceil(8)).min(8);
                // The length was checked when the mapping was made.
                let _ = od.set(entry, &bytes[..len]);
            }
            at += u32::from(item.bits);
        }
    }
}

fn mask(bits: u8) -> u64 {
    if bits >= 64 { u64::MAX } else { (1u64 << bits) - 1 }
}
