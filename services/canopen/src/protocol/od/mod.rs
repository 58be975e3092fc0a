//! The object dictionary (CiA 301 V4.2, 7.4): objects, their sub-objects and their values.
//!
//! Built once by an [`OdBuilder`] (by hand, or from an EDS); after that its structure is fixed and only values
//! change. All values lie in one buffer, each sub-object with a fixed capacity, so that neither reading nor writing
//! allocates. It must never know what an object is for: what a value means is checked by [`Hooks`] of the owner.
//!
//! Two doors: [`read`](ObjectDictionary::read) and [`write`](ObjectDictionary::write) are the network's, with
//! access rights, lengths and limits; [`get`](ObjectDictionary::get), [`set`](ObjectDictionary::set) and the typed
//! forms are the device's own, which may also write what is read-only.

mod build;
mod hooks;
#[cfg(test)]
mod tests;
mod typed;

pub use build::{EntryDef, ObjectDef, OdBuilder, OdError, limit};
pub use hooks::{Accept, Hooks, NoHooks};

use super::abort::Abort;
use super::data_type::{DataType, Number};
use std::ops::RangeInclusive;

/// What an object is (CiA 301 V4.2, 7.4.3, table 42).
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum ObjectCode {
    Null = 0,
    Domain = 2,
    DefType = 5,
    DefStruct = 6,
    Var = 7,
    Array = 8,
    Record = 9,
}

impl ObjectCode {
    /// The object code with this number.
    pub fn from_code(code: u8) -> Option<Self> {
        Some(match code {
            0 => Self::Null,
            2 => Self::Domain,
            5 => Self::DefType,
            6 => Self::DefStruct,
            7 => Self::Var,
            8 => Self::Array,
            9 => Self::Record,
            _ => return None,
        })
    }
    /// The standard's name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Null => "NULL",
            Self::Domain => "DOMAIN",
            Self::DefType => "DEFTYPE",
            Self::DefStruct => "DEFSTRUCT",
            Self::Var => "VAR",
            Self::Array => "ARRAY",
            Self::Record => "RECORD",
        }
    }
    /// Has sub-objects behind sub-index 0.
    pub fn has_subs(self) -> bool {
        matches!(self, Self::Array | Self::Record | Self::DefStruct)
    }
}

/// Access rights (CiA 301 V4.2, 7.4.5, table 43; `rwr` and `rww` CiA 306-1).
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Access {
    Ro,
    Wo,
    Rw,
    /// Read and write; in a PDO an input of the process: TPDO only.
    Rwr,
    /// Read and write; in a PDO an output of the process: RPDO only.
    Rww,
    /// Read-only, and the value does not change after the device is on.
    Const,
}

impl Access {
    /// May be read by the network.
    pub fn readable(self) -> bool {
        self != Self::Wo
    }
    /// May be written by the network.
    pub fn writable(self) -> bool {
        !matches!(self, Self::Ro | Self::Const)
    }
    /// May be mapped into a TPDO, if it is mappable at all.
    pub fn in_tpdo(self) -> bool {
        matches!(self, Self::Ro | Self::Rw | Self::Rwr | Self::Const)
    }
    /// May be mapped into an RPDO, if it is mappable at all.
    pub fn in_rpdo(self) -> bool {
        matches!(self, Self::Wo | Self::Rw | Self::Rww)
    }
    /// The word an EDS uses.
    pub fn word(self) -> &'static str {
        match self {
            Self::Ro => "ro",
            Self::Wo => "wo",
            Self::Rw => "rw",
            Self::Rwr => "rwr",
            Self::Rww => "rww",
            Self::Const => "const",
        }
    }
    /// The access a word of an EDS stands for, in any case.
    pub fn from_word(word: &str) -> Option<Self> {
        [Self::Ro, Self::Wo, Self::Rw, Self::Rwr, Self::Rww, Self::Const]
            .into_iter()
            .find(|access| word.eq_ignore_ascii_case(access.word()))
    }
}

/// A handle to a sub-object: found once, then reached without a search. Good for the life of the dictionary.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Hash)]
pub struct EntryRef(u32);

/// A sub-object without its value.
#[derive(Clone, PartialEq, Debug)]
pub struct Entry {
    pub index: u16,
    pub sub: u8,
    pub data_type: DataType,
    pub access: Access,
    /// May be mapped into a PDO (in the direction that `access` allows).
    pub mappable: bool,
    /// The default depends on the node-id (`$NODEID+...` in an EDS).
    pub node_relative: bool,
    /// Most bytes a value may have. Of a type with a fixed length: that length.
    pub capacity: u32,
    /// Smallest value the network may write.
    pub low: Option<Number>,
    /// Largest value the network may write.
    pub high: Option<Number>,
    at: u32,
    len: u32,
    default_at: u32,
    default_len: u32,
    /// Of `node_relative`: the part of the default without the node-id.
    base: u64,
}

impl Entry {
    /// Length in a PDO in bits: of a type with a fixed length its own, else 8 x capacity up to 64 bits.
    pub fn pdo_bits(&self) -> Option<u8> {
        match self.data_type.bits() {
            Some(bits) => Some(bits),
            None if (1..=8).contains(&self.capacity) => Some(8 * self.capacity as u8),
            None => None,
        }
    }
}

/// An object: its sub-objects lie side by side.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Object {
    pub index: u16,
    pub code: ObjectCode,
    first: u32,
    count: u32,
}

/// The object dictionary of one node.
#[derive(Clone, Debug)]
pub struct ObjectDictionary {
    objects: Vec<Object>,
    /// `index << 8 | sub`, ascending, beside `entries`.
    keys: Vec<u32>,
    entries: Vec<Entry>,
    bytes: Vec<u8>,
    defaults: Vec<u8>,
    node_id: u8,
    /// Bit n: the dummy object 000n may be mapped.
    dummies: u8,
}

const fn key(index: u16, sub: u8) -> u32 {
    (index as u32) << 8 | sub as u32
}

impl ObjectDictionary {
    /// The handle of a sub-object; [`Abort::NO_OBJECT`] or [`Abort::NO_SUB_INDEX`] without one.
    pub fn find(&self, index: u16, sub: u8) -> Result<EntryRef, Abort> {
        match self.keys.binary_search(&key(index, sub)) {
            Ok(at) => Ok(EntryRef(at as u32)),
            Err(_) if self.object(index).is_some() => Err(Abort::NO_SUB_INDEX),
            Err(_) => Err(Abort::NO_OBJECT),
        }
    }
    /// The object at `index`.
    pub fn object(&self, index: u16) -> Option<&Object> {
        self.objects.binary_search_by_key(&index, |object| object.index).ok().map(|at| &self.objects[at])
    }
    /// All objects, ascending.
    pub fn objects(&self) -> &[Object] {
        &self.objects
    }
    /// All sub-objects, ascending, with their handles.
    pub fn entries(&self) -> impl Iterator<Item = (EntryRef, &Entry)> {
        self.entries.iter().enumerate().map(|(at, entry)| (EntryRef(at as u32), entry))
    }
    /// The sub-objects of one object, ascending, with their handles; none if it does not exist.
    pub fn entries_of(&self, index: u16) -> impl Iterator<Item = (EntryRef, &Entry)> {
        let (first, count) = self.object(index).map_or((0, 0), |object| (object.first, object.count));
        self.entries().skip(first as usize).take(count as usize)
    }
    /// What is known of a sub-object. `None` only for a handle of another dictionary.
    pub fn entry(&self, entry: EntryRef) -> Option<&Entry> {
        self.entries.get(entry.0 as usize)
    }
    /// Largest capacity of all sub-objects, in bytes: what a transfer buffer has to hold.
    pub fn largest(&self) -> usize {
        self.entries.iter().map(|entry| entry.capacity as usize).max().unwrap_or(0)
    }

    /// The value. Empty for a handle of another dictionary.
    pub fn get(&self, entry: EntryRef) -> &[u8] {
        self.entries.get(entry.0 as usize).map_or(&[], |entry| {
            let at = entry.at as usize;
            &self.bytes[at..at + entry.len as usize]
        })
    }
    /// The value in place: for types of fixed length, such as PDO data.
    pub fn get_mut(&mut self, entry: EntryRef) -> &mut [u8] {
        match self.entries.get(entry.0 as usize) {
            Some(entry) => {
                let at = entry.at as usize;
                &mut self.bytes[at..at + entry.len as usize]
            }
            None => &mut [],
        }
    }
    /// Sets the value as the device itself may: only its length is checked.
    pub fn set(&mut self, entry: EntryRef, data: &[u8]) -> Result<(), Abort> {
        let entry = self.entries.get_mut(entry.0 as usize).ok_or(Abort::INTERNAL)?;
        check_length(entry, data.len())?;
        let at = entry.at as usize;
        self.bytes[at..at + data.len()].copy_from_slice(data);
        entry.len = data.len() as u32;
        Ok(())
    }

    /// May the network read it? [`Abort::WRITE_ONLY`] otherwise.
    pub fn check_read(&self, entry: EntryRef) -> Result<(), Abort> {
        let entry = self.entry(entry).ok_or(Abort::INTERNAL)?;
        if entry.access.readable() { Ok(()) } else { Err(Abort::WRITE_ONLY) }
    }
    /// May the network write it, whatever the value? [`Abort::READ_ONLY`] otherwise.
    pub fn check_access(&self, entry: EntryRef) -> Result<(), Abort> {
        let entry = self.entry(entry).ok_or(Abort::INTERNAL)?;
        if entry.access.writable() { Ok(()) } else { Err(Abort::READ_ONLY) }
    }
    /// May the value have `len` bytes? [`Abort::TOO_LONG`], [`Abort::TOO_SHORT`] or [`Abort::TYPE_MISMATCH`]
    /// otherwise.
    pub fn check_length(&self, entry: EntryRef, len: usize) -> Result<(), Abort> {
        check_length(self.entry(entry).ok_or(Abort::INTERNAL)?, len)
    }
    /// Everything the dictionary can check of a write by the network, in the standard's order: access right,
    /// length, value and limits.
    pub fn check_write(&self, entry: EntryRef, data: &[u8]) -> Result<(), Abort> {
        self.check_access(entry)?;
        self.check_length(entry, data.len())?;
        check_value(self.entry(entry).ok_or(Abort::INTERNAL)?, data)
    }

    /// Reads as the network does: existence, then access right.
    pub fn read(&self, index: u16, sub: u8) -> Result<&[u8], Abort> {
        let entry = self.find(index, sub)?;
        self.check_read(entry)?;
        Ok(self.get(entry))
    }
    /// Writes as the network does, with every check of [`check_write`](Self::check_write) but no hooks.
    pub fn write(&mut self, index: u16, sub: u8, data: &[u8]) -> Result<(), Abort> {
        let entry = self.find(index, sub)?;
        self.check_write(entry, data)?;
        self.set(entry, data)
    }
    /// Reads as the network does and lets the owner refresh the value or refuse.
    pub fn read_hooked(&mut self, hooks: &mut dyn Hooks, index: u16, sub: u8) -> Result<&[u8], Abort> {
        let entry = self.find(index, sub)?;
        self.check_read(entry)?;
        hooks.before_read(self, index, sub)?;
        Ok(self.get(entry))
    }
    /// Writes as the network does and lets the owner validate, refuse or take the value itself.
    pub fn write_hooked(
        &mut self,
        hooks: &mut dyn Hooks,
        index: u16,
        sub: u8,
        data: &[u8],
    ) -> Result<(), Abort> {
        let entry = self.find(index, sub)?;
        self.check_write(entry, data)?;
        if hooks.before_write(self, index, sub, data)? == Accept::Store {
            self.set(entry, data)?;
        }
        hooks.after_write(self, index, sub);
        Ok(())
    }

    /// Node-id that the `$NODEID` defaults were resolved with; 0 or FFh: none.
    pub fn node_id(&self) -> u8 {
        self.node_id
    }
    /// Resolves the `$NODEID` defaults with another node-id. Values stay; a reset of the communication
    /// parameters takes the new defaults over.
    pub fn set_node_id(&mut self, node_id: u8) {
        self.node_id = node_id;
        for entry in &self.entries {
            if entry.node_relative {
                let value = entry.base.wrapping_add(u64::from(node_id)).to_le_bytes();
                let (at, len) = (entry.default_at as usize, entry.default_len as usize);
                self.defaults[at..at + len].copy_from_slice(&value[..len.min(8)]);
            }
        }
    }
    /// The value a sub-object has after power-on when nothing was stored.
    pub fn default_of(&self, entry: EntryRef) -> &[u8] {
        self.entries.get(entry.0 as usize).map_or(&[], |entry| {
            let at = entry.default_at as usize;
            &self.defaults[at..at + entry.default_len as usize]
        })
    }
    /// Gives every sub-object of the objects in `range` its default, as reset communication (1000-1FFFh) and
    /// reset node (all) do (CiA 301 V4.2, 7.3.2.2.1).
    pub fn reset_to_defaults(&mut self, range: RangeInclusive<u16>) {
        for entry in &mut self.entries {
            if range.contains(&entry.index) {
                let (from, len) = (entry.default_at as usize, entry.default_len as usize);
                let at = entry.at as usize;
                self.bytes[at..at + len].copy_from_slice(&self.defaults[from..from + len]);
                entry.len = entry.default_len;
            }
        }
    }
    /// May the dummy object `index` (0001-0007h) be mapped into an RPDO to skip bits (CiA 301 V4.2, 7.4.7)?
    pub fn dummy_allowed(&self, index: u16) -> bool {
        (1..=7).contains(&index) && self.dummies & (1 << index) != 0
    }
}

/// Lengths (CiA 301 V4.2, 7.2.4.3.17: 0607 0012h too high, 0607 0013h too low, 0607 0010h does not match).
fn check_length(entry: &Entry, len: usize) -> Result<(), Abort> {
    let capacity = entry.capacity as usize;
    if len > capacity {
        Err(Abort::TOO_LONG)
    } else if entry.data_type.size().is_some() && len < capacity {
        Err(Abort::TOO_SHORT)
    } else if entry.data_type == DataType::UnicodeString && len % 2 == 1 {
        Err(Abort::TYPE_MISMATCH)
    } else {
        Ok(())
    }
}

/// Values: a boolean is 0 or 1 (CiA 301 V4.2, 7.1.4.2), then the limits of the object; NaN is within none.
fn check_value(entry: &Entry, data: &[u8]) -> Result<(), Abort> {
    if entry.data_type == DataType::Boolean && data.first().is_some_and(|&byte| byte > 1) {
        return Err(Abort::INVALID_VALUE);
    }
    if entry.low.is_none() && entry.high.is_none() {
        return Ok(());
    }
    let Some(value) = entry.data_type.number(data) else { return Ok(()) };
    if let Some(high) = entry.high {
        match value.compare(high) {
            None => return Err(Abort::INVALID_VALUE),
            Some(order) if order.is_gt() => return Err(Abort::TOO_HIGH),
            Some(_) => {}
        }
    }
    if let Some(low) = entry.low {
        match value.compare(low) {
            None => return Err(Abort::INVALID_VALUE),
            Some(order) if order.is_lt() => return Err(Abort::TOO_LOW),
            Some(_) => {}
        }
    }
    Ok(())
}
