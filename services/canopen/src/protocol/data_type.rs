//! The data types of the object dictionary (CiA 301 V4.2, 7.1.4 for their encoding, 7.4.7 table 44 for their
//! indices) and integers and reals as they lie in an object: little-endian, 1 to 8 bytes.

use std::fmt;

/// A data type by its index in the object dictionary (CiA 301 V4.2, 7.4.7, table 44).
#[derive(Clone, Copy, PartialEq, Eq, Debug, Hash, PartialOrd, Ord)]
pub enum DataType {
    Boolean,
    Integer8,
    Integer16,
    Integer32,
    Unsigned8,
    Unsigned16,
    Unsigned32,
    Real32,
    VisibleString,
    OctetString,
    UnicodeString,
    /// 48 bits: ms after midnight (28 bits), reserved (4), days since 1984-01-01 (16) (CiA 301 V4.2, 7.1.6.6).
    TimeOfDay,
    /// 48 bits: ms (28), reserved (4), days (16) (CiA 301 V4.2, 7.1.6.7).
    TimeDifference,
    Domain,
    Integer24,
    Real64,
    Integer40,
    Integer48,
    Integer56,
    Integer64,
    Unsigned24,
    Unsigned40,
    Unsigned48,
    Unsigned56,
    Unsigned64,
    /// Record type 20h (CiA 301 V4.2, 7.4.8.1).
    PdoCommunicationParameter,
    /// Record type 21h (CiA 301 V4.2, 7.4.8.2).
    PdoMapping,
    /// Record type 22h (CiA 301 V4.2, 7.4.8.3).
    SdoParameter,
    /// Record type 23h (CiA 301 V4.2, 7.4.8.4).
    Identity,
    /// A type of the manufacturer or of a device profile (0040h-0FFFh), or one that no standard gives. Its
    /// values are bytes of any number up to the object's capacity.
    Other(u16),
}

#[allow(clippy::enum_glob_use)] // thirty names of the standard that mean nothing else here
use DataType::*;

/// Type, index, name, bits (0 = not fixed).
const TABLE: &[(DataType, u16, &str, u8)] = &[
    (Boolean, 0x01, "BOOLEAN", 1),
    (Integer8, 0x02, "INTEGER8", 8),
    (Integer16, 0x03, "INTEGER16", 16),
    (Integer32, 0x04, "INTEGER32", 32),
    (Unsigned8, 0x05, "UNSIGNED8", 8),
    (Unsigned16, 0x06, "UNSIGNED16", 16),
    (Unsigned32, 0x07, "UNSIGNED32", 32),
    (Real32, 0x08, "REAL32", 32),
    (VisibleString, 0x09, "VISIBLE_STRING", 0),
    (OctetString, 0x0A, "OCTET_STRING", 0),
    (UnicodeString, 0x0B, "UNICODE_STRING", 0),
    (TimeOfDay, 0x0C, "TIME_OF_DAY", 48),
    (TimeDifference, 0x0D, "TIME_DIFFERENCE", 48),
    (Domain, 0x0F, "DOMAIN", 0),
    (Integer24, 0x10, "INTEGER24", 24),
    (Real64, 0x11, "REAL64", 64),
    (Integer40, 0x12, "INTEGER40", 40),
    (Integer48, 0x13, "INTEGER48", 48),
    (Integer56, 0x14, "INTEGER56", 56),
    (Integer64, 0x15, "INTEGER64", 64),
    (Unsigned24, 0x16, "UNSIGNED24", 24),
    (Unsigned40, 0x18, "UNSIGNED40", 40),
    (Unsigned48, 0x19, "UNSIGNED48", 48),
    (Unsigned56, 0x1A, "UNSIGNED56", 56),
    (Unsigned64, 0x1B, "UNSIGNED64", 64),
    (PdoCommunicationParameter, 0x20, "PDO_COMMUNICATION_PARAMETER", 0),
    (PdoMapping, 0x21, "PDO_MAPPING", 0),
    (SdoParameter, 0x22, "SDO_PARAMETER", 0),
    (Identity, 0x23, "IDENTITY", 0),
];

impl DataType {
    /// Every type the standard gives an index.
    pub fn all() -> impl Iterator<Item = Self> {
        TABLE.iter().map(|line| line.0)
    }
    /// The type at `index` (0001h-0023h); [`DataType::Other`] for every number without a name.
    pub fn from_index(index: u16) -> Self {
        TABLE.iter().find(|line| line.1 == index).map_or(Other(index), |line| line.0)
    }
    fn line(self) -> Option<&'static (Self, u16, &'static str, u8)> {
        TABLE.iter().find(|line| line.0 == self)
    }
    /// Index of the type in the object dictionary.
    pub fn index(self) -> u16 {
        match self {
            Other(index) => index,
            known => known.line().map_or(0, |line| line.1),
        }
    }
    /// The standard's name.
    pub fn name(self) -> &'static str {
        self.line().map_or("manufacturer-specific type", |line| line.2)
    }
    /// Length in a PDO in bits, `None` where the length is not fixed.
    pub const fn bits(self) -> Option<u8> {
        Some(match self {
            Boolean => 1,
            Integer8 | Unsigned8 => 8,
            Integer16 | Unsigned16 => 16,
            Integer24 | Unsigned24 => 24,
            Integer32 | Unsigned32 | Real32 => 32,
            Integer40 | Unsigned40 => 40,
            Integer48 | Unsigned48 | TimeOfDay | TimeDifference => 48,
            Integer56 | Unsigned56 => 56,
            Integer64 | Unsigned64 | Real64 => 64,
            _ => return None,
        })
    }
    /// Length in an SDO and in memory in bytes, `None` where it is not fixed.
    pub const fn size(self) -> Option<usize> {
        match self.bits() {
            Some(bits) => Some((bits as usize).div_ceil(8)),
            None => None,
        }
    }
    pub const fn is_signed(self) -> bool {
        matches!(
            self,
            Integer8 | Integer16 | Integer24 | Integer32 | Integer40 | Integer48 | Integer56 | Integer64
        )
    }
    pub const fn is_unsigned(self) -> bool {
        matches!(
            self,
            Unsigned8
                | Unsigned16
                | Unsigned24
                | Unsigned32
                | Unsigned40
                | Unsigned48
                | Unsigned56
                | Unsigned64
        )
    }
    /// An integer of either sign or a boolean.
    pub const fn is_integer(self) -> bool {
        self.is_signed() || self.is_unsigned() || matches!(self, Boolean)
    }
    pub const fn is_real(self) -> bool {
        matches!(self, Real32 | Real64)
    }
    /// Text or bytes of any length.
    pub const fn is_string(self) -> bool {
        matches!(self, VisibleString | OctetString | UnicodeString)
    }
    /// A record type: it describes an object, no value has it.
    pub const fn is_record(self) -> bool {
        matches!(self, PdoCommunicationParameter | PdoMapping | SdoParameter | Identity)
    }
    /// Smallest and largest integer of the type; `None` for everything else.
    pub const fn range(self) -> Option<(i128, i128)> {
        let Some(bits) = self.bits() else { return None };
        if self.is_signed() {
            Some((-(1i128 << (bits - 1)), (1i128 << (bits - 1)) - 1))
        } else if self.is_unsigned() || matches!(self, Boolean) {
            Some((0, (1i128 << bits) - 1))
        } else {
            None
        }
    }
    /// The value in `bytes` as a number: integers, booleans (not 0 is 1) and reals; `None` for other types or
    /// when the length is wrong.
    pub fn number(self, bytes: &[u8]) -> Option<Number> {
        if Some(bytes.len()) != self.size() {
            return None;
        }
        Some(match self {
            Boolean => Number::Int(i128::from(bytes[0] != 0)),
            Real32 => Number::Real(f64::from(f32::from_le_bytes(bytes.try_into().ok()?))),
            Real64 => Number::Real(f64::from_le_bytes(bytes.try_into().ok()?)),
            _ if self.is_signed() => Number::Int(i128::from(signed(bytes))),
            _ if self.is_unsigned() => Number::Int(i128::from(unsigned(bytes))),
            _ => return None,
        })
    }
    /// `number` as bytes of this type in `out`; returns how many. `None` if the type is no number or the value
    /// does not fit; a real is rounded to the type, an integer given for a real is converted.
    pub fn encode(self, number: Number, out: &mut [u8; 8]) -> Option<usize> {
        let size = self.size()?;
        if self.is_real() {
            let value = match number {
                Number::Real(value) => value,
                Number::Int(value) => value as f64,
            };
            if matches!(self, Real32) {
                out[..4].copy_from_slice(&(value as f32).to_le_bytes());
            } else {
                out.copy_from_slice(&value.to_le_bytes());
            }
            return Some(size);
        }
        let (low, high) = self.range()?;
        let Number::Int(value) = number else { return None };
        if value < low || value > high {
            return None;
        }
        out[..size].copy_from_slice(&value.to_le_bytes()[..size]);
        Some(size)
    }
}

impl fmt::Display for DataType {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Other(index) => write!(f, "type {index:04X}h"),
            known => f.write_str(known.name()),
        }
    }
}

/// A number on its way into or out of an object.
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum Number {
    Int(i128),
    Real(f64),
}

impl Number {
    /// Order of two numbers of one kind; `None` against NaN or between kinds.
    pub fn compare(self, other: Self) -> Option<std::cmp::Ordering> {
        match (self, other) {
            (Self::Int(a), Self::Int(b)) => Some(a.cmp(&b)),
            (Self::Real(a), Self::Real(b)) => a.partial_cmp(&b),
            _ => None,
        }
    }
}

impl fmt::Display for Number {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Int(value) => write!(f, "{value}"),
            Self::Real(value) => write!(f, "{value:?}"),
        }
    }
}

/// 0-8 little-endian bytes as an unsigned integer; more bytes are ignored.
pub fn unsigned(bytes: &[u8]) -> u64 {
    bytes.iter().take(8).rev().fold(0, |value, &byte| (value << 8) | u64::from(byte))
}

/// 1-8 little-endian bytes as a signed integer: the topmost bit is the sign.
pub fn signed(bytes: &[u8]) -> i64 {
    let unused = 64 - 8 * bytes.len().clamp(1, 8) as u32;
    ((unsigned(bytes) << unused) as i64) >> unused
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn the_table_and_the_methods_agree() {
        for &(data_type, index, name, bits) in TABLE {
            assert_eq!(DataType::from_index(index), data_type);
            assert_eq!((data_type.index(), data_type.name()), (index, name));
            assert_eq!(data_type.bits().unwrap_or(0), bits, "{name}");
        }
        assert_eq!(DataType::from_index(0x17), Other(0x17));
        assert_eq!(DataType::from_index(0x41).index(), 0x41);
        assert_eq!(Other(0x41).to_string(), "type 0041h");
        assert_eq!(Boolean.size(), Some(1));
        assert_eq!(Integer24.range(), Some((-8_388_608, 8_388_607)));
    }

    #[test]
    fn edges_of_every_integer() {
        for data_type in DataType::all() {
            let Some((low, high)) = data_type.range() else { continue };
            for value in [low, high, 0, high / 2] {
                let mut bytes = [0; 8];
                let size = data_type.encode(Number::Int(value), &mut bytes).unwrap();
                assert_eq!(data_type.number(&bytes[..size]), Some(Number::Int(value)), "{data_type}");
            }
            let mut bytes = [0; 8];
            assert_eq!(data_type.encode(Number::Int(low - 1), &mut bytes), None);
            assert_eq!(data_type.encode(Number::Int(high + 1), &mut bytes), None);
        }
    }

    proptest! {
        #[test]
        fn reals_keep_their_bits(value: f64, single: f32) {
            let mut bytes = [0; 8];
            Real64.encode(Number::Real(value), &mut bytes).unwrap();
            prop_assert_eq!(f64::from_le_bytes(bytes).to_bits(), value.to_bits());
            Real32.encode(Number::Real(f64::from(single)), &mut bytes).unwrap();
            let back = f32::from_le_bytes(bytes[..4].try_into().unwrap());
            prop_assert!(back == single || back.is_nan() && single.is_nan());
        }
        #[test]
        fn any_bytes_are_some_number_or_none(index in 0u16..0x50, bytes: Vec<u8>) {
            let data_type = DataType::from_index(index);
            if let Some(number) = data_type.number(&bytes) {
                let mut out = [0; 8];
                prop_assert!(data_type.encode(number, &mut out).is_some());
            }
        }
    }
}
