//! Which PDO of a node carries which object.
//!
//! A mapped object is carried by the PDO whose mapping in the EDS contains it; otherwise the first free PDO is
//! configured for it. Sans-I/O; source of layouts: CiA 301 V4.2, clauses 7.5.2.35 to 7.5.2.38.

use super::super::boot::Write;
use super::super::exchange::transmission;
use super::cob_ids::is_for_pdo;
use crate::config::{Node, Pdo as Wanted};
use crate::device::Device;
use crate::mistakes::Mistakes;
use crate::protocol::cob_id::{BIT_31, CobId};
use crate::protocol::data_type::unsigned;
use std::collections::BTreeSet;

/// PDOs of each direction that a node may have (CiA 301 V4.2, clause 7.5.2.35).
pub const MAX_PDOS: u16 = 512;
/// Most objects in a PDO (CiA 301 V4.2, clause 7.5.2.36).
const MAX_ENTRIES: usize = 64;
/// Bits of a PDO on classic CAN.
const PDO_BITS: u32 = 64;

/// Seen from the node, as everywhere in CANopen.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Direction {
    /// The node sends it.
    Tpdo,
    /// The node receives it.
    Rpdo,
}

impl Direction {
    /// Communication parameters of PDO 1.
    pub const fn communication(self) -> u16 {
        match self {
            Self::Rpdo => 0x1400,
            Self::Tpdo => 0x1800,
        }
    }
    /// Mapping parameters of PDO 1.
    pub const fn mapping(self) -> u16 {
        self.communication() + 0x200
    }
    /// First identifier of the predefined connection set (CiA 301 V4.2, table 39).
    const fn predefined(self) -> u32 {
        match self {
            Self::Tpdo => 0x180,
            Self::Rpdo => 0x200,
        }
    }
    pub const fn name(self) -> &'static str {
        match self {
            Self::Tpdo => "TPDO",
            Self::Rpdo => "RPDO",
        }
    }
}

/// An object in a PDO.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
pub struct Mapped {
    pub index: u16,
    pub sub: u8,
    pub bits: u8,
}

impl Mapped {
    fn from_u32(word: u32) -> Self {
        Self { index: (word >> 16) as u16, sub: (word >> 8) as u8, bits: word as u8 }
    }
    fn word(self) -> u32 {
        u32::from(self.index) << 16 | u32::from(self.sub) << 8 | u32::from(self.bits)
    }
}

/// A PDO as it shall be.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize)]
pub struct Pdo {
    pub direction: Direction,
    /// From 1.
    pub number: u16,
    /// Value of sub-index 1.
    pub cob_id: u32,
    pub transmission: u8,
    /// In steps of 100 us.
    pub inhibit: u16,
    /// In ms.
    pub event: u16,
    pub sync_start: u8,
    pub mapping: Vec<Mapped>,
    /// The mapping is another than the EDS's.
    pub remapped: bool,
    /// The master needs it, or the stack file sets something of it.
    pub used: bool,
}

impl Pdo {
    pub fn is_active(&self) -> bool {
        self.cob_id & BIT_31 == 0
    }
    pub fn bits(&self) -> u32 {
        self.mapping.iter().map(|m| u32::from(m.bits)).sum()
    }
    pub fn bytes(&self) -> u8 {
        self.bits().div_ceil(8).min(255) as u8
    }
    /// First bit of an object in it.
    pub fn bit_of(&self, index: u16, sub: u8) -> Option<u16> {
        let mut at = 0u16;
        for mapped in &self.mapping {
            if (mapped.index, mapped.sub) == (index, sub) {
                return Some(at);
            }
            at = at.saturating_add(u16::from(mapped.bits));
        }
        None
    }
}

/// What the EDS says about the PDOs of a direction.
fn defaults(device: &Device, direction: Direction) -> Vec<Pdo> {
    let od = &device.od;
    let number = |index, sub| od.find(index, sub).ok().map(|e| unsigned(od.default_of(e)));
    let mut all = Vec::new();
    for number_from_0 in 0..MAX_PDOS {
        let (comm, map) = (direction.communication() + number_from_0, direction.mapping() + number_from_0);
        if od.object(comm).is_none() || od.object(map).is_none() {
            continue;
        }
        let count = number(map, 0).unwrap_or(0).min(MAX_ENTRIES as u64) as u8;
        let mapping = (1..=count)
            .filter_map(|sub| number(map, sub))
            .map(|word| Mapped::from_u32(word as u32))
            .collect();
        all.push(Pdo {
            direction,
            number: number_from_0 + 1,
            cob_id: number(comm, 1).map_or(BIT_31, |v| v as u32),
            transmission: number(comm, 2).map_or(transmission::EVENT, |v| v as u8),
            inhibit: number(comm, 3).unwrap_or(0) as u16,
            event: number(comm, 5).unwrap_or(0) as u16,
            sync_start: number(comm, 6).unwrap_or(0) as u8,
            mapping,
            remapped: false,
            used: false,
        });
    }
    all
}

/// The PDOs of one node, both directions.
#[derive(Debug)]
pub struct PdoPlanner<'a> {
    device: &'a Device,
    node: u8,
    /// Key of the node in the stack file: `node[2]`.
    key: String,
    has_sync: bool,
    pub pdos: Vec<Pdo>,
    /// PDOs whose mapping this planner made: objects may be added to them.
    own: BTreeSet<(Direction, u16)>,
    /// PDOs whose mapping the stack file writes.
    written: BTreeSet<(Direction, u16)>,
}

impl<'a> PdoPlanner<'a> {
    /// The EDS's PDOs with what the stack file changes.
    pub fn new(device: &'a Device, node: &Node, key: &str, has_sync: bool, mistakes: &mut Mistakes) -> Self {
        let mut pdos = defaults(device, Direction::Tpdo);
        pdos.extend(defaults(device, Direction::Rpdo));
        let (own, written) = (BTreeSet::new(), BTreeSet::new());
        let mut planner = Self { device, node: node.id, key: key.to_owned(), has_sync, pdos, own, written };
        for (direction, wanted) in [(Direction::Tpdo, &node.tpdo), (Direction::Rpdo, &node.rpdo)] {
            for (i, wanted) in wanted.iter().enumerate() {
                let at = format!("{key}.{}[{i}]", direction.name().to_ascii_lowercase());
                planner.change(direction, wanted, &at, mistakes);
            }
        }
        planner
    }

    fn position(&self, direction: Direction, number: u16) -> Option<usize> {
        self.pdos.iter().position(|p| (p.direction, p.number) == (direction, number))
    }

    fn change(&mut self, direction: Direction, wanted: &Wanted, key: &str, mistakes: &mut Mistakes) {
        let Some(at) = self.position(direction, wanted.number) else {
            let has: Vec<String> = self
                .pdos
                .iter()
                .filter(|p| p.direction == direction)
                .map(|p| p.number.to_string())
                .take(16)
                .collect();
            let has = if has.is_empty() { "none".to_owned() } else { has.join(", ") };
            let message = format!("the EDS has no {} {}; it has {has}", direction.name(), wanted.number);
            mistakes.add(&format!("{key}.number"), message, "take one of those, or another EDS");
            return;
        };
        let mapping = wanted.mapping.as_ref().map(|objects| {
            let mut mapping = Vec::new();
            for (i, object) in objects.iter().enumerate() {
                match self.device.resolve(object).and_then(|o| self.mappable(direction, o)) {
                    Ok(mapped) => mapping.push(mapped),
                    Err(message) => {
                        mistakes.add(&format!("{key}.mapping[{i}]"), message, "map another object");
                    }
                }
            }
            mapping
        });
        let cob_id = wanted.cob_id.as_ref().map(|n| (n, n.identifier(self.node)));
        let pdo = &mut self.pdos[at];
        pdo.used = true;
        match cob_id {
            None => {}
            Some((_, Some(id))) if (0..=0x7FF).contains(&id) && is_for_pdo(CobId(id as u32)) => {
                pdo.cob_id = id as u32;
            }
            Some((written, id)) => {
                // Told in hex, as standards and help say it, also where the file says it in decimal.
                let what =
                    id.filter(|id| *id >= 0).map_or_else(|| written.to_string(), |id| format!("{id:X}h"));
                let message = format!("{what} is no COB-ID that a PDO may have");
                let help = "take 181h to 57Fh, or 680h to 6DFh (CiA 301 clause 7.3.5)";
                mistakes.add(&format!("{key}.cob_id"), message, help);
            }
        }
        if let Some(kind) = wanted.transmission {
            pdo.transmission = kind.number();
            if (241..=251).contains(&pdo.transmission) {
                let message = format!("transmission type {} is reserved", pdo.transmission);
                mistakes.add(
                    &format!("{key}.transmission"),
                    message,
                    "take 0-240 or 252-255 (CiA 301 table 69)",
                );
            }
        } else if self.has_sync {
            pdo.transmission = 1;
        }
        if let Some(span) = wanted.inhibit_time {
            pdo.inhibit = (span.ns() / 100_000).min(u64::from(u16::MAX)) as u16;
        }
        if let Some(span) = wanted.event_timer {
            pdo.event = (span.ns() / 1_000_000).min(u64::from(u16::MAX)) as u16;
        }
        if let Some(start) = wanted.sync_start {
            pdo.sync_start = start;
        }
        if let Some(mapping) = mapping {
            pdo.remapped |= pdo.mapping != mapping;
            pdo.mapping = mapping;
        }
        let bits = pdo.bits();
        if wanted.mapping.is_some() {
            self.written.insert((direction, wanted.number));
        }
        if bits > PDO_BITS && wanted.mapping.is_some() {
            let bytes = bits.div_ceil(8);
            let message = format!("{} {} has {bytes} bytes by this mapping", direction.name(), wanted.number);
            mistakes.add(
                &format!("{key}.mapping"),
                message,
                "a PDO carries 8 bytes: move objects to another one",
            );
        }
        if wanted.enabled {
            self.activate(at, key, mistakes);
        } else {
            self.pdos[at].cob_id |= BIT_31;
        }
    }

    /// The object as a PDO of this direction carries it.
    fn mappable(&self, direction: Direction, (index, sub): (u16, u8)) -> Result<Mapped, String> {
        let od = &self.device.od;
        let Some(entry) = od.find(index, sub).ok().and_then(|e| od.entry(e)) else {
            return Err(format!("the EDS has no object {index:04X}:{sub:02X}"));
        };
        let right = match direction {
            Direction::Tpdo => entry.access.in_tpdo(),
            Direction::Rpdo => entry.access.in_rpdo(),
        };
        if !entry.mappable {
            return Err(format!("the EDS says that {index:04X}:{sub:02X} cannot be mapped into a PDO"));
        }
        if !right {
            let way = if direction == Direction::Tpdo { "sent by the node" } else { "received by the node" };
            return Err(format!(
                "{index:04X}:{sub:02X} has access '{}': it cannot be {way}",
                entry.access.word()
            ));
        }
        match entry.pdo_bits() {
            Some(bits) => Ok(Mapped { index, sub, bits }),
            None => Err(format!("{index:04X}:{sub:02X} has no fixed length: it cannot be mapped into a PDO")),
        }
    }

    /// Gives it a COB-ID that exists.
    fn activate(&mut self, at: usize, key: &str, mistakes: &mut Mistakes) {
        let pdo = &mut self.pdos[at];
        // A device without a COB-ID for it gives 0 or a bare flag.
        if is_for_pdo(CobId(pdo.cob_id)) {
            pdo.cob_id &= !BIT_31;
        } else if pdo.number <= 4 {
            pdo.cob_id =
                pdo.direction.predefined() + 0x100 * u32::from(pdo.number - 1) + u32::from(self.node);
        } else {
            let what = format!("{} {}", pdo.direction.name(), pdo.number);
            let message =
                format!("{what} has no COB-ID in the EDS, and only the first four have a predefined one");
            let table = pdo.direction.name().to_ascii_lowercase();
            let help = format!("set it: [[service.node.{table}]] number = {} cob_id = 0x680", pdo.number);
            mistakes.add(key, message, help);
        }
    }

    /// The PDO that carries an object; configures one if need be. Index in `pdos`.
    pub fn place(
        &mut self,
        direction: Direction,
        object: (u16, u8),
        key: &str,
        mistakes: &mut Mistakes,
    ) -> Option<usize> {
        let mapped = match self.mappable(direction, object) {
            Ok(mapped) => mapped,
            Err(message) => {
                mistakes.add(key, message, "map another object");
                return None;
            }
        };
        let carries = |p: &&Pdo| p.direction == direction && p.bit_of(object.0, object.1).is_some();
        let found = self
            .pdos
            .iter()
            .filter(carries)
            .find(|p| p.is_active())
            .or_else(|| self.pdos.iter().find(carries))
            .map(|p| (p.direction, p.number));
        let at = match found.and_then(|(d, n)| self.position(d, n)) {
            Some(at) => at,
            None => self.make_room(mapped, direction, key, mistakes)?,
        };
        if !self.pdos[at].used {
            self.pdos[at].used = true;
            if self.has_sync {
                self.pdos[at].transmission = 1;
            }
        }
        if !self.pdos[at].is_active() {
            self.activate(at, key, mistakes);
        }
        Some(at)
    }

    /// Adds an object to a PDO of this planner's own, or begins one.
    fn make_room(
        &mut self,
        mapped: Mapped,
        direction: Direction,
        key: &str,
        mistakes: &mut Mistakes,
    ) -> Option<usize> {
        let bits = u32::from(mapped.bits);
        let roomy = |p: &Pdo| p.bits() + bits <= PDO_BITS && p.mapping.len() < MAX_ENTRIES;
        let own = self
            .pdos
            .iter()
            .position(|p| p.direction == direction && self.own.contains(&(direction, p.number)) && roomy(p));
        let at = own.or_else(|| self.free(direction));
        let Some(at) = at else {
            let count = self.pdos.iter().filter(|p| p.direction == direction).count();
            let message = format!(
                "no {} of node {} is left for {:04X}:{:02X}: the EDS has {count}, all are used",
                direction.name(),
                self.node,
                mapped.index,
                mapped.sub
            );
            mistakes.add(key, message, "read or write it by SDO, or map fewer objects");
            return None;
        };
        if own.is_none() {
            self.pdos[at].mapping.clear();
            self.own.insert((direction, self.pdos[at].number));
        }
        self.pdos[at].mapping.push(mapped);
        self.pdos[at].remapped = true;
        Some(at)
    }

    /// The first PDO that nothing needs: one without mapping, or a disabled one, or any other.
    fn free(&self, direction: Direction) -> Option<usize> {
        let changeable = |p: &Pdo| {
            let od = &self.device.od;
            let first = od.find(direction.mapping() + p.number - 1, 0).ok().and_then(|e| od.entry(e));
            p.direction == direction && !p.used && first.is_some_and(|e| e.access.writable())
        };
        let find = |wanted: &dyn Fn(&Pdo) -> bool| self.pdos.iter().position(|p| changeable(p) && wanted(p));
        find(&|p| p.mapping.is_empty()).or_else(|| find(&|p| !p.is_active())).or_else(|| find(&|_| true))
    }

    /// Type checks that need the whole network's settings.
    pub fn check(&self, mistakes: &mut Mistakes) {
        for pdo in self.pdos.iter().filter(|p| p.used && p.is_active()) {
            let what = format!("{} {} of node {}", pdo.direction.name(), pdo.number, self.node);
            let synchronous =
                transmission::is_synchronous(pdo.transmission) || pdo.transmission == transmission::SYNC_RTR;
            if synchronous && !self.has_sync {
                let message = format!(
                    "{what} is synchronous (type {}), but the master sends no SYNC",
                    pdo.transmission
                );
                mistakes.warn(
                    &self.key,
                    message,
                    "set sync_period, or transmission = \"event\" for this PDO",
                );
            }
            if pdo.bits() > PDO_BITS && !self.written.contains(&(pdo.direction, pdo.number)) {
                let message = format!("{what} has {} bytes by its EDS", pdo.bits().div_ceil(8));
                mistakes.add(&self.key, message, "give it another mapping of at most 8 bytes");
            }
        }
    }

    /// The objects that make the node's PDOs what they shall be, in the standard's lock-step (CiA 301 V4.2, clause
    /// 7.5.2.36): switch off, count 0, objects, count, parameters, switch on.
    pub fn writes(&self) -> Vec<Write> {
        let mut all = Vec::new();
        for pdo in self.pdos.iter().filter(|p| p.used) {
            self.write_pdo(pdo, &mut all);
        }
        all
    }

    fn write_pdo(&self, pdo: &Pdo, all: &mut Vec<Write>) {
        let od = &self.device.od;
        let (comm, map) =
            (pdo.direction.communication() + pdo.number - 1, pdo.direction.mapping() + pdo.number - 1);
        let mut put = |index: u16, sub: u8, value: u32| {
            let Some(entry) = od.find(index, sub).ok().and_then(|e| od.entry(e)) else { return };
            if entry.access.writable() {
                let size = entry.data_type.size().unwrap_or(4).min(4);
                all.push(Write { index, sub, data: value.to_le_bytes()[..size].to_vec() });
            }
        };
        put(comm, 1, pdo.cob_id | BIT_31);
        if pdo.is_active() {
            if pdo.remapped {
                put(map, 0, 0);
                for (i, mapped) in pdo.mapping.iter().enumerate() {
                    put(map, i as u8 + 1, mapped.word());
                }
                put(map, 0, pdo.mapping.len() as u32);
            }
            put(comm, 2, u32::from(pdo.transmission));
            if pdo.direction == Direction::Tpdo {
                put(comm, 3, u32::from(pdo.inhibit));
            }
            put(comm, 5, u32::from(pdo.event));
            if pdo.direction == Direction::Tpdo && transmission::is_synchronous(pdo.transmission) {
                put(comm, 6, u32::from(pdo.sync_start));
            }
            put(comm, 1, pdo.cob_id);
        }
    }
}
