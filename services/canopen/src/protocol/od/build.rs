//! Making an object dictionary.

use super::{Abort, Access, Entry, Object, ObjectCode, ObjectDictionary, key};
use crate::protocol::data_type::{DataType, Number};
use std::collections::BTreeMap;

/// Limits of a dictionary.
pub mod limit {
    /// Most sub-objects of a dictionary.
    pub const ENTRIES: usize = 200_000;
    /// Most bytes of all values together.
    pub const BYTES: usize = 64 << 20;
    /// Capacity of a string without one of its own, in bytes (or its default's length, if that is more).
    pub const STRING: u32 = 256;
    /// Capacity of a domain or a value of unknown type without one of its own, in bytes.
    pub const DOMAIN: u32 = 4096;
    /// Largest capacity of one value, in bytes.
    pub const VALUE: u32 = 16 << 20;
}

/// Why a dictionary could not be made.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum OdError {
    #[error("object {0:04X}h is there twice: give it once")]
    TwiceObject(u16),
    #[error("object {0:04X}h has sub-index {1:02X}h twice: give it once")]
    TwiceSub(u16, u8),
    #[error("object {0:04X}h has no sub-object: give it at least sub-index 00h")]
    Empty(u16),
    #[error("object {index:04X}h:{sub:02X}: the default has {len} bytes, a {data_type} has {size}")]
    Default { index: u16, sub: u8, data_type: DataType, len: usize, size: usize },
    #[error("object {index:04X}h:{sub:02X}: {data_type} is a record type, no value can have it")]
    RecordType { index: u16, sub: u8, data_type: DataType },
    #[error("object {index:04X}h:{sub:02X}: a capacity of {capacity} bytes is more than the limit of {max}", max = limit::VALUE)]
    Capacity { index: u16, sub: u8, capacity: u32 },
    #[error(
        "object {index:04X}h:{sub:02X}: only an integer of 1 to 8 bytes can depend on the node-id, not a {data_type}"
    )]
    NodeRelative { index: u16, sub: u8, data_type: DataType },
    #[error("more than {max} sub-objects: a device has far fewer, is the file right?", max = limit::ENTRIES)]
    Entries,
    #[error("the values need more than {max} bytes: lower the capacities", max = limit::BYTES)]
    Bytes,
}

/// A sub-object to be made. Starts with [`EntryDef::new`] as an unmapped, unlimited value of zero.
#[derive(Clone, PartialEq, Debug)]
pub struct EntryDef {
    pub data_type: DataType,
    pub access: Access,
    pub mappable: bool,
    /// Default value; empty: zero, or the empty string.
    pub default: Vec<u8>,
    /// The node-id is added to the default.
    pub node_relative: bool,
    /// Most bytes of a value without a fixed length; 0: [`limit::STRING`] or [`limit::DOMAIN`].
    pub capacity: u32,
    pub low: Option<Number>,
    pub high: Option<Number>,
}

impl EntryDef {
    /// A value of zero (or an empty string) that no PDO maps.
    pub fn new(data_type: DataType, access: Access) -> Self {
        Self {
            data_type,
            access,
            mappable: false,
            default: Vec::new(),
            node_relative: false,
            capacity: 0,
            low: None,
            high: None,
        }
    }
    /// Default: an integer. A value that does not fit is cut to the type.
    #[must_use]
    pub fn value(mut self, value: i64) -> Self {
        let mut bytes = [0; 8];
        let size = if self.data_type.is_real() {
            self.data_type.encode(Number::Int(i128::from(value)), &mut bytes).unwrap_or(0)
        } else {
            bytes = value.to_le_bytes();
            self.data_type.size().unwrap_or(8).min(8)
        };
        self.default = bytes[..size].to_vec();
        self
    }
    /// Default: an integer plus the node-id.
    #[must_use]
    pub fn value_plus_node_id(self, value: u32) -> Self {
        let mut def = self.value(i64::from(value));
        def.node_relative = true;
        def
    }
    /// Default: bytes as they lie in memory, text included.
    #[must_use]
    pub fn bytes(mut self, bytes: &[u8]) -> Self {
        self.default = bytes.to_vec();
        self
    }
    /// May be mapped into a PDO.
    #[must_use]
    pub fn mappable(mut self) -> Self {
        self.mappable = true;
        self
    }
    /// Most bytes of a value without a fixed length.
    #[must_use]
    pub fn capacity(mut self, bytes: u32) -> Self {
        self.capacity = bytes;
        self
    }
    /// Limits of what the network may write.
    #[must_use]
    pub fn limits(mut self, low: Number, high: Number) -> Self {
        self.low = Some(low);
        self.high = Some(high);
        self
    }
}

/// An object to be made.
#[derive(Clone, PartialEq, Debug)]
pub struct ObjectDef {
    pub index: u16,
    pub code: ObjectCode,
    /// Sub-index and sub-object; a VAR has 00h alone.
    pub subs: Vec<(u8, EntryDef)>,
}

/// Collects objects in any order and makes a dictionary of them.
#[derive(Clone, Debug, Default)]
pub struct OdBuilder {
    objects: Vec<ObjectDef>,
    dummies: u8,
}

impl OdBuilder {
    pub fn new() -> Self {
        Self::default()
    }
    /// Adds an object as it is.
    pub fn object(&mut self, object: ObjectDef) -> &mut Self {
        self.objects.push(object);
        self
    }
    /// Adds a VAR.
    pub fn var(&mut self, index: u16, entry: EntryDef) -> &mut Self {
        self.object(ObjectDef { index, code: ObjectCode::Var, subs: vec![(0, entry)] })
    }
    /// Adds an ARRAY with sub-index 0 (UNSIGNED8, ro, the number of elements) and `count` equal elements.
    pub fn array(&mut self, index: u16, count: u8, element: EntryDef) -> &mut Self {
        let count = count.min(0xFE);
        let mut subs = vec![(0, highest(count, Access::Ro))];
        subs.extend((1..=count).map(|sub| (sub, element.clone())));
        self.object(ObjectDef { index, code: ObjectCode::Array, subs })
    }
    /// Adds a RECORD with sub-index 0 (UNSIGNED8, `highest_access`, the highest sub-index) and these sub-objects.
    pub fn record(&mut self, index: u16, highest_access: Access, fields: Vec<(u8, EntryDef)>) -> &mut Self {
        let last = fields.iter().map(|field| field.0).max().unwrap_or(0);
        let mut subs = vec![(0, highest(last, highest_access))];
        subs.extend(fields);
        self.object(ObjectDef { index, code: ObjectCode::Record, subs })
    }
    /// Allows the dummy object `index` (0001-0007h) in RPDO mappings.
    pub fn dummy(&mut self, index: u16) -> &mut Self {
        if (1..=7).contains(&index) {
            self.dummies |= 1 << index;
        }
        self
    }
    /// The object that was added last at `index`, to change it before the dictionary is made.
    pub fn object_mut(&mut self, index: u16) -> Option<&mut ObjectDef> {
        self.objects.iter_mut().rev().find(|object| object.index == index)
    }
    /// Makes the dictionary; `$NODEID` defaults are resolved with `node_id` (0: none yet).
    pub fn build(&self, node_id: u8) -> Result<ObjectDictionary, OdError> {
        let mut sorted: BTreeMap<u16, &ObjectDef> = BTreeMap::new();
        for object in &self.objects {
            if sorted.insert(object.index, object).is_some() {
                return Err(OdError::TwiceObject(object.index));
            }
        }
        let count: usize = sorted.values().map(|object| object.subs.len()).sum();
        if count > limit::ENTRIES {
            return Err(OdError::Entries);
        }
        let mut od = ObjectDictionary {
            objects: Vec::with_capacity(sorted.len()),
            keys: Vec::with_capacity(count),
            entries: Vec::with_capacity(count),
            bytes: Vec::new(),
            defaults: Vec::new(),
            node_id,
            dummies: self.dummies,
        };
        for object in sorted.into_values() {
            add(&mut od, object)?;
        }
        od.set_node_id(node_id);
        od.reset_to_defaults(0..=0xFFFF);
        Ok(od)
    }
}

fn highest(sub: u8, access: Access) -> EntryDef {
    EntryDef::new(DataType::Unsigned8, access).value(i64::from(sub))
}

fn add(od: &mut ObjectDictionary, object: &ObjectDef) -> Result<(), OdError> {
    let first = od.entries.len() as u32;
    let mut subs: BTreeMap<u8, &EntryDef> = BTreeMap::new();
    for (sub, def) in &object.subs {
        if subs.insert(*sub, def).is_some() {
            return Err(OdError::TwiceSub(object.index, *sub));
        }
    }
    if subs.is_empty() {
        return Err(OdError::Empty(object.index));
    }
    let count = subs.len() as u32;
    for (sub, def) in subs {
        let entry = entry_of(od, object.index, sub, def)?;
        od.keys.push(key(object.index, sub));
        od.entries.push(entry);
    }
    od.objects.push(Object { index: object.index, code: object.code, first, count });
    Ok(())
}

fn entry_of(od: &mut ObjectDictionary, index: u16, sub: u8, def: &EntryDef) -> Result<Entry, OdError> {
    let data_type = def.data_type;
    if data_type.is_record() {
        return Err(OdError::RecordType { index, sub, data_type });
    }
    let (capacity, default_len) = match data_type.size() {
        Some(size) if def.default.is_empty() || def.default.len() == size => (size as u32, size),
        Some(size) => return Err(OdError::Default { index, sub, data_type, len: def.default.len(), size }),
        None => {
            let usual = if data_type.is_string() { limit::STRING } else { limit::DOMAIN };
            let wanted = if def.capacity == 0 { usual } else { def.capacity };
            (wanted.max(u32::try_from(def.default.len()).unwrap_or(u32::MAX)), def.default.len())
        }
    };
    if capacity > limit::VALUE {
        return Err(OdError::Capacity { index, sub, capacity });
    }
    if def.node_relative && !data_type.is_unsigned() && !data_type.is_signed() {
        return Err(OdError::NodeRelative { index, sub, data_type });
    }
    let (at, default_at) = (od.bytes.len(), od.defaults.len());
    if at + capacity as usize > limit::BYTES || default_at + default_len > limit::BYTES {
        return Err(OdError::Bytes);
    }
    od.bytes.resize(at + capacity as usize, 0);
    od.defaults.extend_from_slice(&def.default);
    od.defaults.resize(default_at + default_len, 0);
    Ok(Entry {
        index,
        sub,
        data_type,
        access: def.access,
        mappable: def.mappable,
        node_relative: def.node_relative,
        capacity,
        low: def.low,
        high: def.high,
        at: at as u32,
        len: default_len as u32,
        default_at: default_at as u32,
        default_len: default_len as u32,
        base: crate::protocol::data_type::unsigned(&od.defaults[default_at..default_at + default_len]),
    })
}

impl From<OdError> for Abort {
    fn from(_: OdError) -> Self {
        Self::NO_DICTIONARY
    }
}
