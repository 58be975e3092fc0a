//! %-addresses of the stack file as byte offsets of the process image.

use ipc_types::wiring::Area;
use serde::{Deserialize, Serialize};
use thiserror::Error;

/// How the number in `%IW1` is counted; must be that of the plc service.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Addressing {
    /// In elements: %IW1 = bytes 2-3 (CODESYS V3).
    #[default]
    Element,
    /// In bytes: %IW2 = bytes 2-3 (OpenPCS, Siemens). Also accepts %I0.0.
    Byte,
    /// As OpenPLC: each width has 1024 elements of its own, behind one another.
    Openplc,
}

impl Addressing {
    /// Name as in the stack file.
    pub fn name(self) -> &'static str {
        match self {
            Self::Element => "element",
            Self::Byte => "byte",
            Self::Openplc => "openplc",
        }
    }
}

/// A place in the process image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Address {
    /// Area.
    pub area: Area,
    /// First byte.
    pub byte: u32,
    /// Bit of that byte, for `X` addresses.
    pub bit: Option<u8>,
    /// 1, 8, 16, 32 or 64.
    pub bits: u32,
}

/// Why a text is no address.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum AddressError {
    /// Not `%`, area, width, number.
    #[error(
        "'{0}' is not an address: write %, I or Q or M, then X, B, W, D or L, then a number, as %IW0 or %QX0.3"
    )]
    Form(String),
    /// Bit above 7.
    #[error("'{text}': bits are 0 to 7; you probably mean {meant}")]
    Bit {
        /// As written.
        text: String,
        /// The same bit, right.
        meant: String,
    },
    /// Behind the largest area.
    #[error("'{0}' lies behind the end: an area has at most 64 KiB")]
    Beyond(String),
}

/// Largest area in bytes.
const AREA_BYTES: u32 = 65_536;
/// Elements of each width in OpenPLC's numbering.
const OPENPLC_ELEMENTS: u32 = 1024;

/// Reads `%IW1`, `%QX0.3`, in byte addressing also `%I0.3`.
pub fn parse(text: &str, addressing: Addressing) -> Result<Address, AddressError> {
    let shown = || text.chars().take(40).collect::<String>();
    let form = || AddressError::Form(shown());
    let upper = text.trim().to_ascii_uppercase();
    let rest = upper.strip_prefix('%').ok_or_else(form)?;
    let area = match rest.bytes().next() {
        Some(b'I') => Area::Input,
        Some(b'Q') => Area::Output,
        Some(b'M') => Area::Marker,
        _ => return Err(form()),
    };
    let rest = &rest[1..];
    let (bits, number) = match rest.bytes().next() {
        Some(b'X') => (1u32, &rest[1..]),
        Some(b'B') => (8, &rest[1..]),
        Some(b'W') => (16, &rest[1..]),
        Some(b'D') => (32, &rest[1..]),
        Some(b'L') => (64, &rest[1..]),
        Some(b'0'..=b'9') if addressing == Addressing::Byte => (1, rest),
        _ => return Err(form()),
    };
    let (number, bit) = match number.split_once('.') {
        Some((number, bit)) if bits == 1 || (addressing == Addressing::Byte && bit == "0") => {
            (number, Some(bit))
        }
        None if bits > 1 => (number, None),
        _ => return Err(form()),
    };
    let number = decimal(number).ok_or_else(form)?;
    let bit = bit.map(|bit| decimal(bit).ok_or_else(form)).transpose()?.filter(|_| bits == 1);
    if let Some(bit @ 8..) = bit {
        let meant = format!("%{}X{}.{}", area.letter(), number.saturating_add(bit / 8), bit % 8);
        return Err(AddressError::Bit { text: shown(), meant });
    }
    let width = bits.div_ceil(8);
    let byte = match addressing {
        Addressing::Byte => number,
        Addressing::Element => number.saturating_mul(width),
        Addressing::Openplc if number >= OPENPLC_ELEMENTS => return Err(AddressError::Beyond(shown())),
        // Bits, words, bytes, doubles, longs lie behind one another in tables of their own.
        Addressing::Openplc => {
            let base = match bits {
                1 => 0,
                8 => 3072,
                16 => 1024,
                32 => 4096,
                _ => 8192,
            };
            base + number * width
        }
    };
    if byte.saturating_add(width) > AREA_BYTES {
        return Err(AddressError::Beyond(shown()));
    }
    Ok(Address { area, byte, bit: bit.map(|bit| bit as u8), bits })
}

fn decimal(text: &str) -> Option<u32> {
    let digits = !text.is_empty() && text.len() <= 7 && text.bytes().all(|c| c.is_ascii_digit());
    digits.then(|| text.parse().ok()).flatten()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn addresses() {
        use Addressing::{Byte, Element, Openplc};
        let table = [
            ("%IW1", Element, Area::Input, 2, None, 16),
            ("%IW2", Byte, Area::Input, 2, None, 16),
            ("%IW2.0", Byte, Area::Input, 2, None, 16),
            ("%QX3.7", Element, Area::Output, 3, Some(7), 1),
            ("%I0.5", Byte, Area::Input, 0, Some(5), 1),
            ("%md1", Element, Area::Marker, 4, None, 32),
            ("%QB9", Element, Area::Output, 9, None, 8),
            ("%IL1", Element, Area::Input, 8, None, 64),
            ("%IW1", Openplc, Area::Input, 1026, None, 16),
            ("%QX1.0", Openplc, Area::Output, 1, Some(0), 1),
            ("%IL8191", Element, Area::Input, 65528, None, 64),
        ];
        for (text, addressing, area, byte, bit, bits) in table {
            assert_eq!(parse(text, addressing), Ok(Address { area, byte, bit, bits }), "{text}");
        }
    }

    #[test]
    fn mistakes() {
        let said = |text, addressing| parse(text, addressing).unwrap_err().to_string();
        for text in
            ["", "%", "IW1", "%IW", "%XW1", "%IW1.2", "%IX1", "%IX1.", "%I0.0", "%IW-1", "%IWé", "%QX0.0.0"]
        {
            assert!(said(text, Addressing::Element).contains("is not an address"), "{text}");
        }
        assert_eq!(
            said("%QX0.12", Addressing::Element),
            "'%QX0.12': bits are 0 to 7; you probably mean %QX1.4"
        );
        for (text, addressing) in [
            ("%IL8192", Addressing::Element),
            ("%IW65535", Addressing::Byte),
            ("%IW1024", Addressing::Openplc),
        ] {
            assert!(said(text, addressing).contains("behind the end"), "{text}");
        }
    }

    proptest! {
        #[test]
        fn never_panics(text in "%?[IQMiqm]?[XBWDLxb]?[0-9]{0,12}\\.?[0-9]{0,12}", any in "\\PC{0,20}") {
            for addressing in [Addressing::Element, Addressing::Byte, Addressing::Openplc] {
                let _ = parse(&text, addressing);
                let _ = parse(&any, addressing);
            }
        }
    }
}
