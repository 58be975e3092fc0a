//! Maps as the stack file writes them, the two ready ones, and how `dinrail map` shows them.

use crate::map::{Range, RegisterMap};
use crate::server::Table;
use dinrail_iec::artifact::AreaKind;
use dinrail_iec::{AddressError, AddressSize, Addressing, LocatedAddress, parse_address};
use ipc_types::wiring::{Area, AreaSizes};
use serde::{Deserialize, Deserializer, Serialize, de};
use std::fmt;

/// Entries of a table: addresses 0 to 65535 (V1.1b3 clause 4.4).
const TABLE_ENTRIES: u32 = 65536;
/// Most ranges of a map.
pub const MAX_RANGES: usize = 1024;

/// A ready map.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Preset {
    /// Coils %QX0.0.., discrete inputs %IX0.0.., input registers %IW0.., holding registers 0-32767 %MW0..,
    /// 32768.. %QW0..
    #[default]
    Dinrail,
    /// As OpenPLC: coils %QX0.0.., discrete inputs %IX0.0.., input registers 0-1023 %IW0.., holding registers
    /// 0-1023 %QW0.., 1024-2047 %MW0.., 2048-4095 %MD0.., 4096-8191 %ML0.., high word first.
    Openplc,
}

/// Order of the registers of one 32-bit or 64-bit value.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum WordOrder {
    /// The low word has the lower address, as in memory.
    #[default]
    LowFirst,
    /// The high word has the lower address.
    HighFirst,
}

/// Order of the bytes of a value on the wire, A the most significant. A 16-bit value is AB or BA; of 32-bit values
/// all four are in use, and 64-bit values follow the same two choices: which word comes first, and whether the bytes
/// of each word are exchanged.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "UPPERCASE")]
pub enum ByteOrder {
    /// As the protocol has it.
    Ab,
    /// Bytes exchanged.
    Ba,
    /// High word first.
    Abcd,
    /// Low word first.
    Cdab,
    /// High word first, bytes exchanged.
    Badc,
    /// Low word first, bytes exchanged.
    Dcba,
}

impl ByteOrder {
    /// As in the stack file.
    pub fn name(self) -> &'static str {
        match self {
            Self::Ab => "AB",
            Self::Ba => "BA",
            Self::Abcd => "ABCD",
            Self::Cdab => "CDAB",
            Self::Badc => "BADC",
            Self::Dcba => "DCBA",
        }
    }

    /// Whether the high word comes first, if the value has more than one; whether the bytes of a word are exchanged.
    pub fn parts(self) -> (Option<WordOrder>, bool) {
        match self {
            Self::Ab => (None, false),
            Self::Ba => (None, true),
            Self::Abcd => (Some(WordOrder::HighFirst), false),
            Self::Cdab => (Some(WordOrder::LowFirst), false),
            Self::Badc => (Some(WordOrder::HighFirst), true),
            Self::Dcba => (Some(WordOrder::LowFirst), true),
        }
    }
}

/// One `[[service.map]]` table.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MapEntry {
    /// `coils`, `discrete_inputs`, `input_registers` or `holding_registers`.
    pub table: Table,
    /// First address, 0-based.
    pub at: u32,
    /// Number of bits or registers.
    pub count: u32,
    /// %-address of the first one.
    pub area: String,
    /// Only for %xD and %xL areas.
    #[serde(default)]
    pub word_order: Option<WordOrder>,
    /// Exchanges the two bytes of every register.
    #[serde(default)]
    pub swap_bytes: bool,
    /// Both of it in one word, in place of `word_order` and `swap_bytes`.
    #[serde(default)]
    pub order: Option<ByteOrder>,
    /// The server owns this part of %I: clients write it, the program reads it.
    #[serde(default)]
    pub own: bool,
    /// Clients may not write it.
    #[serde(default)]
    pub read_only: bool,
}

impl MapEntry {
    /// Word order and exchange of bytes, however they are written.
    fn parts(&self) -> (Option<WordOrder>, bool) {
        self.order.map_or((self.word_order, self.swap_bytes), ByteOrder::parts)
    }
}

/// The key `map`: the name of a ready map, or tables.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[serde(untagged)]
pub enum MapConfig {
    Preset(Preset),
    Tables(Vec<MapEntry>),
}

impl Default for MapConfig {
    fn default() -> Self {
        Self::Preset(Preset::Dinrail)
    }
}

impl<'de> Deserialize<'de> for MapConfig {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Visit;
        impl<'de> de::Visitor<'de> for Visit {
            type Value = MapConfig;
            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("\"dinrail\", \"openplc\", or [[service.map]] tables")
            }
            fn visit_str<E: de::Error>(self, text: &str) -> Result<MapConfig, E> {
                match text {
                    "dinrail" => Ok(MapConfig::Preset(Preset::Dinrail)),
                    "openplc" => Ok(MapConfig::Preset(Preset::Openplc)),
                    other => Err(E::custom(format!(
                        "there is no map '{other}': write \"dinrail\", \"openplc\", or [[service.map]] tables"
                    ))),
                }
            }
            fn visit_seq<A: de::SeqAccess<'de>>(self, seq: A) -> Result<MapConfig, A::Error> {
                Vec::deserialize(de::value::SeqAccessDeserializer::new(seq)).map(MapConfig::Tables)
            }
        }
        deserializer.deserialize_any(Visit)
    }
}

impl MapConfig {
    /// The map for areas of these sizes.
    pub fn build(&self, sizes: AreaSizes, addressing: Addressing) -> Result<RegisterMap, MapError> {
        match self {
            Self::Preset(chosen) => Ok(preset(*chosen, sizes, addressing)),
            Self::Tables(entries) => from_entries(entries, sizes, addressing),
        }
    }
}

/// A map that cannot be built. `entry` counts `[[service.map]]` tables from 1.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum MapError {
    #[error("map table {entry}: {source}")]
    Address { entry: usize, source: AddressError },
    #[error("map table {entry}: count is 0; leave the table out or give it at least 1")]
    Empty { entry: usize },
    #[error("map table {entry}: {table} {at} to {last} does not fit; Modbus addresses end at 65535")]
    PastTable { entry: usize, table: &'static str, at: u32, last: u64 },
    #[error(
        "map table {entry}: {table} {at} to {last} reaches byte {end} of %{area}, which has {size}; lower count or raise the size of %{area} in the plc service"
    )]
    PastArea { entry: usize, table: &'static str, at: u32, last: u32, end: u64, area: char, size: u32 },
    #[error(
        "map table {entry}: {table} shows single bits, so area must be %{area}X... or %{area}B...; got {got}"
    )]
    NotBits { entry: usize, table: &'static str, area: char, got: String },
    #[error("map table {entry}: {table} shows 16-bit words, so area must be %{area}B, W, D or L; got {got}")]
    NotWords { entry: usize, table: &'static str, area: char, got: String },
    #[error(
        "map table {entry}: word_order needs values of 32 or 64 bits; write area as %xD or %xL, got {got}"
    )]
    WordOrder { entry: usize, got: String },
    #[error("map table {entry}: count {count} splits a value; %xD needs a multiple of 2, %xL of 4")]
    SplitsValue { entry: usize, count: u32 },
    #[error("map table {entry}: order and swap_bytes are for registers, {table} shows single bits")]
    SwapBits { entry: usize, table: &'static str },
    #[error("map table {entry}: order says what word_order and swap_bytes say; keep one of them")]
    OrderTwice { entry: usize },
    #[error(
        "map table {entry}: order {order} is for values of {bits} bits, but {got} has others; write AB or BA for %xW, ABCD, CDAB, BADC or DCBA for %xD and %xL"
    )]
    Order { entry: usize, order: &'static str, bits: &'static str, got: String },
    #[error(
        "map table {entry}: own = true lets clients write what read_only = true forbids; keep one of them"
    )]
    OwnReadOnly { entry: usize },
    #[error(
        "map table {entry}: own = true is for %I in coils or holding_registers, which clients can write; got {got} in {table}"
    )]
    Own { entry: usize, table: &'static str, got: String },
    #[error("map tables {first} and {second} both show {table} {at}; a register has one place")]
    Overlap { first: usize, second: usize, table: &'static str, at: u32 },
    #[error(
        "map table {entry}: bits of %I owned by the server are owned by whole bytes; begin at bit 0 and give a multiple of 8"
    )]
    OwnBits { entry: usize },
    #[error("the map has {got} tables; at most {MAX_RANGES} are allowed")]
    TooMany { got: usize },
}

/// The area of an address. Addresses name no others than these three.
pub(crate) fn area_of(address: LocatedAddress) -> Area {
    match address.area {
        AreaKind::Input => Area::Input,
        AreaKind::Output => Area::Output,
        AreaKind::Marker | AreaKind::Retain | AreaKind::Data => Area::Marker,
    }
}

pub(crate) fn preset(preset: Preset, sizes: AreaSizes, addressing: Addressing) -> RegisterMap {
    let range = |at, most: u32, area, size: AddressSize| {
        let entry_bits = if size == AddressSize::Bit { 1 } else { 16 };
        let group = (size.bytes() / 2).max(1);
        let count = most.min(addressing.room(size, sizes.of(area)) * 8 / entry_bits) / group * group;
        let base = addressing.base(size);
        let high_first = group > 1;
        Range { at, count, area, base, group, high_first, swap_bytes: false, own: false, read_only: false }
    };
    let coils = range(0, TABLE_ENTRIES, Area::Output, AddressSize::Bit);
    let discrete = range(0, TABLE_ENTRIES, Area::Input, AddressSize::Bit);
    let (input, holding) = match preset {
        Preset::Dinrail => (
            range(0, TABLE_ENTRIES, Area::Input, AddressSize::Word),
            vec![
                range(0, 32768, Area::Marker, AddressSize::Word),
                range(32768, 32768, Area::Output, AddressSize::Word),
            ],
        ),
        Preset::Openplc => (
            range(0, 1024, Area::Input, AddressSize::Word),
            vec![
                range(0, 1024, Area::Output, AddressSize::Word),
                range(1024, 1024, Area::Marker, AddressSize::Word),
                range(2048, 2048, Area::Marker, AddressSize::Dword),
                range(4096, 4096, Area::Marker, AddressSize::Lword),
            ],
        ),
    };
    let mut tables = [vec![coils], vec![discrete], vec![input], holding];
    for ranges in &mut tables {
        ranges.retain(|range| range.count > 0);
    }
    RegisterMap::from_ranges(tables, sizes)
}

pub(crate) fn from_entries(
    entries: &[MapEntry],
    sizes: AreaSizes,
    addressing: Addressing,
) -> Result<RegisterMap, MapError> {
    if entries.len() > MAX_RANGES {
        return Err(MapError::TooMany { got: entries.len() });
    }
    let mut numbered: [Vec<(usize, Range)>; 4] = Default::default();
    for (i, entry) in entries.iter().enumerate() {
        let range = entry_range(i + 1, entry, sizes, addressing)?;
        numbered[entry.table as usize].push((i + 1, range));
    }
    for (ranges, table) in numbered.iter_mut().zip(Table::ALL) {
        ranges.sort_by_key(|(_, range)| range.at);
        for pair in ranges.windows(2) {
            if let [(first, a), (second, b)] = pair
                && b.at < a.at + a.count
            {
                return Err(MapError::Overlap {
                    first: *first,
                    second: *second,
                    table: table.name(),
                    at: b.at,
                });
            }
        }
    }
    let tables = numbered.map(|ranges| ranges.into_iter().map(|(_, range)| range).collect());
    Ok(RegisterMap::from_ranges(tables, sizes))
}

fn entry_range(
    entry: usize,
    config: &MapEntry,
    sizes: AreaSizes,
    addressing: Addressing,
) -> Result<Range, MapError> {
    let address =
        parse_address(&config.area, addressing).map_err(|source| MapError::Address { entry, source })?;
    let area_at = area_of(address);
    let (table, area) = (config.table.name(), area_at.letter());
    let got = || config.area.clone();
    let bits = config.table.is_bits();
    if config.count == 0 {
        return Err(MapError::Empty { entry });
    }
    let end = u64::from(config.at) + u64::from(config.count);
    if end > u64::from(TABLE_ENTRIES) {
        return Err(MapError::PastTable { entry, table, at: config.at, last: end - 1 });
    }
    match address.size {
        AddressSize::Bit | AddressSize::Byte if bits => {}
        _ if bits => return Err(MapError::NotBits { entry, table, area, got: got() }),
        AddressSize::Bit => return Err(MapError::NotWords { entry, table, area, got: got() }),
        _ => {}
    }
    let group = if bits { 1 } else { (address.size.bytes() / 2).max(1) };
    if bits && (config.swap_bytes || config.order.is_some()) {
        return Err(MapError::SwapBits { entry, table });
    }
    if let Some(order) = config.order {
        if config.word_order.is_some() || config.swap_bytes {
            return Err(MapError::OrderTwice { entry });
        }
        if order.parts().0.is_some() != (group > 1) {
            let bits = if group > 1 { "16" } else { "32 or 64" };
            return Err(MapError::Order { entry, order: order.name(), bits, got: got() });
        }
    }
    let (word_order, swap_bytes) = config.parts();
    if word_order.is_some() && group == 1 {
        return Err(MapError::WordOrder { entry, got: got() });
    }
    if config.own && config.read_only {
        return Err(MapError::OwnReadOnly { entry });
    }
    if !config.count.is_multiple_of(group) {
        return Err(MapError::SplitsValue { entry, count: config.count });
    }
    let bit = address.bit.unwrap_or(0);
    let first_bit = u64::from(address.byte) * 8 + u64::from(bit);
    let end_bit = first_bit + u64::from(config.count) * if bits { 1 } else { 16 };
    let end_byte = end_bit.div_ceil(8);
    let size = sizes.of(area_at);
    if end_byte > u64::from(size) {
        let (at, last) = (config.at, (end - 1) as u32);
        return Err(MapError::PastArea { entry, table, at, last, end: end_byte, area, size });
    }
    if config.own {
        let client_writes = matches!(config.table, Table::Coils | Table::HoldingRegisters);
        if area_at != Area::Input || !client_writes {
            return Err(MapError::Own { entry, table, got: got() });
        }
        if bits && (bit != 0 || !config.count.is_multiple_of(8)) {
            return Err(MapError::OwnBits { entry });
        }
    }
    Ok(Range {
        at: config.at,
        count: config.count,
        area: area_at,
        base: if bits { first_bit as u32 } else { address.byte },
        group,
        high_first: word_order == Some(WordOrder::HighFirst),
        swap_bytes,
        own: config.own,
        read_only: config.read_only,
    })
}

/// One line of a map as `dinrail map` prints it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct MapRow {
    pub table: Table,
    /// First and last address, 0-based as in the PDU.
    pub first: u16,
    pub last: u16,
    /// The same as traditional numbers, from 1, with the table's digit: "40001".
    pub first_number: String,
    pub last_number: String,
    /// %-addresses of the first and last value.
    pub first_address: String,
    pub last_address: String,
    /// `high_first` or `low_first` for values of more than one register.
    pub word_order: Option<WordOrder>,
    pub swap_bytes: bool,
    /// Whether clients may write.
    pub writable: bool,
    /// Whether the server owns these bytes of %I.
    pub own: bool,
}

/// Traditional number of an entry: the table's digit and the address counted from 1, five digits where they
/// suffice, else six ("40001", "432769").
pub fn traditional_number(table: Table, address: u16) -> String {
    let number = u32::from(address) + 1;
    if number <= 9999 {
        format!("{}{number:04}", table.digit())
    } else {
        format!("{}{number:05}", table.digit())
    }
}

impl MapError {
    /// The `[[service.map]]` table it is about, from 1.
    pub fn entry(&self) -> Option<usize> {
        match self {
            Self::Address { entry, .. }
            | Self::Empty { entry }
            | Self::PastTable { entry, .. }
            | Self::PastArea { entry, .. }
            | Self::NotBits { entry, .. }
            | Self::NotWords { entry, .. }
            | Self::WordOrder { entry, .. }
            | Self::SplitsValue { entry, .. }
            | Self::SwapBits { entry, .. }
            | Self::OrderTwice { entry }
            | Self::Order { entry, .. }
            | Self::OwnReadOnly { entry }
            | Self::Own { entry, .. }
            | Self::OwnBits { entry } => Some(*entry),
            Self::Overlap { second, .. } => Some(*second),
            Self::TooMany { .. } => None,
        }
    }
}

impl RegisterMap {
    /// All ranges, table by table, as far as they lie within the areas.
    pub fn rows(&self, addressing: Addressing) -> Vec<MapRow> {
        let mut rows = Vec::new();
        for table in Table::ALL {
            for range in self.ranges(table) {
                let count = self.entries_inside(table, range);
                if count == 0 {
                    continue;
                }
                let (first, last) = (range.at as u16, (range.at + count - 1) as u16);
                rows.push(MapRow {
                    table,
                    first,
                    last,
                    first_number: traditional_number(table, first),
                    last_number: traditional_number(table, last),
                    first_address: place(table, range, 0, addressing),
                    last_address: place(table, range, count - 1, addressing),
                    word_order: (range.group > 1).then_some(if range.high_first {
                        WordOrder::HighFirst
                    } else {
                        WordOrder::LowFirst
                    }),
                    swap_bytes: range.swap_bytes,
                    writable: matches!(table, Table::Coils | Table::HoldingRegisters) && range.writable(),
                    own: range.own,
                });
            }
        }
        rows
    }

    /// The entries that show a place of the image: coils and discrete inputs for a bit, for a byte or more the
    /// register where a value that begins there begins (with `high_first` still the lowest of its registers).
    pub fn entries_at(&self, area: Area, byte: u32, bit: Option<u8>) -> Vec<(Table, u16)> {
        let mut found = Vec::new();
        for table in Table::ALL {
            if table.is_bits() != bit.is_some() {
                continue;
            }
            for range in self.ranges(table).iter().filter(|range| range.area == area) {
                let unit = if table.is_bits() { 1 } else { 2 * range.group };
                let place = bit.map_or(byte, |bit| byte * 8 + u32::from(bit));
                let Some(distance) = place.checked_sub(range.base) else { continue };
                let step = if table.is_bits() { 1 } else { range.group };
                let k = distance / unit * step + if range.high_first { 0 } else { distance % unit / 2 };
                if k < range.count {
                    found.push((table, (range.at + k) as u16));
                }
            }
        }
        found
    }
}

/// Entry `k` of a range as the address of its value; of its first byte where no address names all of it.
fn place(table: Table, range: &Range, k: u32, addressing: Addressing) -> String {
    let at = |byte, bit, bytes| LocatedAddress::new(range.area.letter(), byte, bit, bytes);
    let (whole, first) = if table.is_bits() {
        let bit = range.base + k;
        (at(bit / 8, Some((bit % 8) as u8), 1), None)
    } else {
        let byte = range.base + k / range.group * range.group * 2;
        (at(byte, None, range.group * 2), at(byte, None, 1))
    };
    let text = whole.and_then(|at| at.text(addressing)).or_else(|| first?.text(addressing));
    text.or_else(|| Some(whole?.to_string())).unwrap_or_default()
}

#[cfg(test)]
#[path = "map_config_tests.rs"]
mod tests;
