//! %-addresses of the stack file and where their bytes are.

pub use ipc_types::wiring::Area;

use serde::{Deserialize, Serialize};
use std::fmt;

/// Bytes of each area, at most 64 KiB.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct AreaSizes {
    pub input: u32,
    pub output: u32,
    pub marker: u32,
}

impl AreaSizes {
    /// Size of one area in bytes.
    pub fn of(self, area: Area) -> u32 {
        match area {
            Area::Input => self.input,
            Area::Output => self.output,
            Area::Marker => self.marker,
        }
    }
}

impl AreaSizes {
    /// The largest areas a plc service can have.
    pub const MAX: Self = Self { input: 65536, output: 65536, marker: 65536 };
}

impl Default for AreaSizes {
    /// 4 KiB each, the plc service's default.
    fn default() -> Self {
        Self { input: 4096, output: 4096, marker: 4096 }
    }
}

/// Size of the value a %-address names.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Width {
    /// X: one bit.
    Bit,
    /// B: one byte.
    Byte,
    /// W: two bytes.
    Word,
    /// D: four bytes.
    Double,
    /// L: eight bytes.
    Long,
}

impl Width {
    /// Bytes of a value; a bit counts as 1.
    pub fn bytes(self) -> u32 {
        match self {
            Self::Bit | Self::Byte => 1,
            Self::Word => 2,
            Self::Double => 4,
            Self::Long => 8,
        }
    }

    fn letter(self) -> char {
        match self {
            Self::Bit => 'X',
            Self::Byte => 'B',
            Self::Word => 'W',
            Self::Double => 'D',
            Self::Long => 'L',
        }
    }
}

/// How the number in %IW1 is counted.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Addressing {
    /// In elements: %IW1 = bytes 2-3 (CODESYS V3).
    #[default]
    Element,
    /// In bytes: %IW2 = bytes 2-3 (OpenPCS, Siemens).
    Byte,
    /// As OpenPLC: each size has a table of its own with 1024 elements; they lie behind one another in the area
    /// (X from byte 0, W from 1024, B from 3072, D from 4096, L from 8192).
    Openplc,
}

/// Elements of each of OpenPLC's tables (bytes of them for bits).
pub const OPENPLC_ELEMENTS: u32 = 1024;

impl Addressing {
    /// First byte of the values of a width.
    pub fn base(self, width: Width) -> u32 {
        match (self, width) {
            (Self::Element | Self::Byte, _) | (Self::Openplc, Width::Bit) => 0,
            (Self::Openplc, Width::Word) => 1024,
            (Self::Openplc, Width::Byte) => 3072,
            (Self::Openplc, Width::Double) => 4096,
            (Self::Openplc, Width::Long) => 8192,
        }
    }

    /// Bytes that the values of a width may take in an area of `size` bytes, from [`Addressing::base`] on.
    pub fn room(self, width: Width, size: u32) -> u32 {
        let room = size.saturating_sub(self.base(width));
        match self {
            Self::Element | Self::Byte => room,
            Self::Openplc => room.min(OPENPLC_ELEMENTS * width.bytes()),
        }
    }
}

/// A %-address resolved to bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Address {
    pub area: Area,
    pub width: Width,
    /// Offset of its first byte.
    pub byte: u32,
    /// Bit in that byte, 0-7; 0 unless `width` is [`Width::Bit`].
    pub bit: u8,
}

/// A text that is no %-address.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum AddressError {
    #[error(
        "'{0}' is not a %-address; write %, I, Q or M, then X, B, W, D or L, then a number, e.g. \"%MW0\" or \"%QX0.3\""
    )]
    Form(String),
    #[error("'{text}': bits are 0 to 7; bit {bit} of byte {byte} is {meant}")]
    Bit { text: String, byte: u32, bit: u32, meant: String },
    #[error("'{0}': OpenPLC's tables have {OPENPLC_ELEMENTS} elements, 0 to 1023")]
    OutsideTable(String),
}

impl Address {
    /// Reads `%MW10`, `%QX0.3`, `%ID2`; in byte addressing also `%I0.0`.
    pub fn parse(text: &str, addressing: Addressing) -> Result<Self, AddressError> {
        let form = || AddressError::Form(text.to_owned());
        let rest = text.strip_prefix('%').ok_or_else(form)?;
        let mut chars = rest.chars();
        let area = match chars.next().map(|c| c.to_ascii_uppercase()) {
            Some('I') => Area::Input,
            Some('Q') => Area::Output,
            Some('M') => Area::Marker,
            _ => return Err(form()),
        };
        let rest = chars.as_str();
        let width = match rest.chars().next().map(|c| c.to_ascii_uppercase()) {
            Some('X') => Width::Bit,
            Some('B') => Width::Byte,
            Some('W') => Width::Word,
            Some('D') => Width::Double,
            Some('L') => Width::Long,
            Some(c) if c.is_ascii_digit() && addressing == Addressing::Byte => Width::Bit,
            _ => return Err(form()),
        };
        let number = rest.strip_prefix(|c: char| c.is_ascii_alphabetic()).unwrap_or(rest);
        if width == Width::Bit {
            let (byte, bit) = number.split_once('.').ok_or_else(form)?;
            let (byte, bit) = (decimal(byte).ok_or_else(form)?, decimal(bit).ok_or_else(form)?);
            if addressing == Addressing::Openplc && byte >= OPENPLC_ELEMENTS {
                return Err(AddressError::OutsideTable(text.to_owned()));
            }
            if bit > 7 {
                let meant = format!("%{}X{}.{}", area.letter(), byte.saturating_add(bit / 8), bit % 8);
                return Err(AddressError::Bit { text: text.to_owned(), byte, bit, meant });
            }
            return Ok(Self { area, width, byte, bit: bit as u8 });
        }
        let number = decimal(number).ok_or_else(form)?;
        if addressing == Addressing::Openplc && number >= OPENPLC_ELEMENTS {
            return Err(AddressError::OutsideTable(text.to_owned()));
        }
        let byte = match addressing {
            Addressing::Byte => number,
            Addressing::Element | Addressing::Openplc => addressing.base(width) + number * width.bytes(),
        };
        Ok(Self { area, width, byte, bit: 0 })
    }

    /// The address as text, in the given way of counting.
    pub fn text(self, addressing: Addressing) -> String {
        let n = match addressing {
            Addressing::Byte => self.byte,
            Addressing::Element | Addressing::Openplc => {
                self.byte.saturating_sub(addressing.base(self.width)) / self.width.bytes()
            }
        };
        match self.width {
            Width::Bit => format!("%{}X{}.{}", self.area.letter(), self.byte, self.bit),
            width => format!("%{}{}{n}", self.area.letter(), width.letter()),
        }
    }
}

impl fmt::Display for Address {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.text(Addressing::Element))
    }
}

/// Digits only, up to 7 of them (areas end at 64 KiB = 524288 bits).
fn decimal(text: &str) -> Option<u32> {
    let digits = !text.is_empty() && text.len() <= 7 && text.bytes().all(|b| b.is_ascii_digit());
    if digits { text.parse().ok() } else { None }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_are_read_in_both_ways_of_counting() {
        for (text, addressing, area, byte, bit) in [
            ("%MW10", Addressing::Element, Area::Marker, 20, 0),
            ("%MW10", Addressing::Byte, Area::Marker, 10, 0),
            ("%ID2", Addressing::Element, Area::Input, 8, 0),
            ("%QL1", Addressing::Element, Area::Output, 8, 0),
            ("%QB7", Addressing::Element, Area::Output, 7, 0),
            ("%QX3.7", Addressing::Element, Area::Output, 3, 7),
            ("%I0.5", Addressing::Byte, Area::Input, 0, 5),
            ("%qx1.0", Addressing::Byte, Area::Output, 1, 0),
            ("%QX1.0", Addressing::Openplc, Area::Output, 1, 0),
            ("%MW1", Addressing::Openplc, Area::Marker, 1026, 0),
            ("%MD1", Addressing::Openplc, Area::Marker, 4100, 0),
            ("%ML1", Addressing::Openplc, Area::Marker, 8200, 0),
        ] {
            let address = Address::parse(text, addressing).unwrap();
            assert_eq!((address.area, address.byte, address.bit), (area, byte, bit), "{text}");
        }
    }

    #[test]
    fn a_bad_address_says_what_is_meant() {
        let error = |text| Address::parse(text, Addressing::Element).unwrap_err().to_string();
        assert_eq!(error("%QX0.12"), "'%QX0.12': bits are 0 to 7; bit 12 of byte 0 is %QX1.4");
        for bad in [
            "",
            "%",
            "MW1",
            "%MW",
            "%XW1",
            "%M",
            "%MW1.2",
            "%MW-1",
            "%QX0",
            "%QX.1",
            "%MW99999999",
            "%I0.5",
            "%MWW1",
            "%é1",
        ] {
            assert!(error(bad).contains("e.g. \"%MW0\""), "{bad}: {}", error(bad));
        }
    }

    #[test]
    fn openplc_tables_end() {
        for text in ["%MW1024", "%QX1024.0"] {
            let error = Address::parse(text, Addressing::Openplc).unwrap_err();
            assert_eq!(error, AddressError::OutsideTable(text.to_owned()));
        }
    }

    #[test]
    fn text_is_parsed_back() {
        for addressing in [Addressing::Element, Addressing::Byte, Addressing::Openplc] {
            for text in ["%MW10", "%QX3.7", "%IB9", "%MD3", "%ML2"] {
                assert_eq!(Address::parse(text, addressing).unwrap().text(addressing), text);
            }
        }
    }
}
