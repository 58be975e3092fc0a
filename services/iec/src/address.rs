//! `%`-addresses: one reader for sources, stack files, routes and `dinrail map`.

use crate::artifact::AreaKind;

/// How the number in `%IW2` counts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum Addressing {
    /// In elements of the named size, as CODESYS V3: `%IW1` = bytes 2-3, `%IX3.1` = bit 1 of byte 3.
    #[default]
    Element,
    /// In bytes, as OpenPCS and Siemens: `%IW2` = bytes 2-3; `%I0.0` and `%IW2.0` are accepted too.
    Byte,
    /// As OpenPLC, where bits, bytes, words, double and long words are separate tables of 1024 elements that do
    /// not overlap. Here they lie behind each other in the area: `%xX` in bytes 0-1023, `%xW` 1024-3071, `%xB`
    /// 3072-4095, `%xD` 4096-8191, `%xL` 8192-16383 (so `%xD` and `%xL` need an area larger than the default).
    OpenPlc,
}

/// Size letter of an address.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum AddressSize {
    /// `X`: one bit.
    Bit,
    /// `B`: 1 byte.
    Byte,
    /// `W`: 2 bytes.
    Word,
    /// `D`: 4 bytes.
    Dword,
    /// `L`: 8 bytes.
    Lword,
}

impl AddressSize {
    /// Bytes touched.
    pub const fn bytes(self) -> u32 {
        match self {
            Self::Bit | Self::Byte => 1,
            Self::Word => 2,
            Self::Dword => 4,
            Self::Lword => 8,
        }
    }
    /// First byte of this size's own table with [`Addressing::OpenPlc`].
    const fn openplc_base(self) -> u64 {
        match self {
            Self::Bit => 0,
            Self::Word => 1024,
            Self::Byte => 3072,
            Self::Dword => 4096,
            Self::Lword => 8192,
        }
    }
    /// The letter.
    pub const fn letter(self) -> char {
        match self {
            Self::Bit => 'X',
            Self::Byte => 'B',
            Self::Word => 'W',
            Self::Dword => 'D',
            Self::Lword => 'L',
        }
    }
}

/// A place in %I, %Q or %M.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct LocatedAddress {
    /// [`AreaKind::Input`], [`AreaKind::Output`] or [`AreaKind::Marker`].
    pub area: AreaKind,
    /// First byte, counted from the start of the area.
    pub byte: u32,
    /// Bit 0-7 of that byte, for [`AddressSize::Bit`] only.
    pub bit: Option<u8>,
    pub size: AddressSize,
}

/// Why a text is no address.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum AddressError {
    #[error("`{text}` is not an address: write %I, %Q or %M, a size X, B, W, D or L, and a number, like %IX0.3 or %QW2")]
    Form { text: String },
    #[error("`{text}`: a byte has the bits 0 to 7; bit {bit} of byte {byte} is {meant}")]
    Bit { text: String, byte: u32, bit: u32, meant: String },
    #[error("`{text}` names a bit without its byte: write {meant}")]
    BareBit { text: String, meant: String },
    #[error("`{text}`: addresses of this size have no bit; the bit you may mean is {meant}")]
    BitOfWord { text: String, meant: String },
    #[error("`{text}`: without a size letter only a bit is meant, like %IX0.0 (`addressing = \"byte\"` also takes %I0.0)")]
    NoSize { text: String },
    #[error("`{text}` is an incomplete address (`*`): VAR_CONFIG is not supported, write the address")]
    Incomplete { text: String },
    #[error("`{text}`: the number is too large, an area has at most 65536 bytes")]
    TooLarge { text: String },
    #[error("`{text}`: OpenPLC's tables have 1024 elements, 0 to 1023")]
    OutsideTable { text: String },
}

/// Reads `%IX0.3`, `%QW2`, `%MD4`, `%IB5` (any case).
pub fn parse_address(text: &str, addressing: Addressing) -> Result<LocatedAddress, AddressError> {
    let owned = || text.to_owned();
    let form = || AddressError::Form { text: text.to_owned() };
    let mut rest = text.trim().strip_prefix('%').ok_or_else(form)?.chars().peekable();
    let area_letter = rest.next().map(|c| c.to_ascii_uppercase()).ok_or_else(form)?;
    let area = match area_letter {
        'I' => AreaKind::Input,
        'Q' => AreaKind::Output,
        'M' => AreaKind::Marker,
        _ => return Err(form()),
    };
    let size = match rest.peek().map(|c| c.to_ascii_uppercase()) {
        Some('X') => Some(AddressSize::Bit),
        Some('B') => Some(AddressSize::Byte),
        Some('W') => Some(AddressSize::Word),
        Some('D') => Some(AddressSize::Dword),
        Some('L') => Some(AddressSize::Lword),
        Some('*') => return Err(AddressError::Incomplete { text: owned() }),
        Some(c) if c.is_ascii_digit() => None,
        _ => return Err(form()),
    };
    if size.is_some() {
        rest.next();
    }
    let digits: String = rest.collect();
    if digits == "*" {
        return Err(AddressError::Incomplete { text: owned() });
    }
    let mut parts = digits.split('.');
    let mut number = || -> Result<Option<u32>, AddressError> {
        match parts.next() {
            None => Ok(None),
            Some(p) if !p.is_empty() && p.bytes().all(|b| b.is_ascii_digit()) => {
                p.parse::<u32>().map(Some).map_err(|_| AddressError::TooLarge { text: text.to_owned() })
            }
            Some(_) => Err(AddressError::Form { text: text.to_owned() }),
        }
    };
    let (first, second, third) = (number()?.ok_or_else(form)?, number()?, number()?);
    if third.is_some() {
        return Err(form());
    }
    let limit = |byte: u64| -> Result<u32, AddressError> {
        u32::try_from(byte).ok().filter(|b| *b < 65_536).ok_or(AddressError::TooLarge { text: text.to_owned() })
    };
    let bit_of = |byte: u32, bit: u32| -> Result<LocatedAddress, AddressError> {
        if bit > 7 {
            let meant = format!("%{area_letter}X{}.{}", u64::from(byte) + u64::from(bit / 8), bit % 8);
            return Err(AddressError::Bit { text: text.to_owned(), byte, bit, meant });
        }
        Ok(LocatedAddress { area, byte: limit(u64::from(byte))?, bit: Some(bit as u8), size: AddressSize::Bit })
    };
    if addressing == Addressing::OpenPlc && first >= 1024 && size.is_some() {
        return Err(AddressError::OutsideTable { text: owned() });
    }
    match (size, second) {
        (Some(AddressSize::Bit), Some(bit)) => bit_of(first, bit),
        (None, Some(bit)) if addressing == Addressing::Byte => bit_of(first, bit),
        (Some(AddressSize::Bit), None) => {
            Err(AddressError::BareBit { text: owned(), meant: format!("%{area_letter}X{}.{}", first / 8, first % 8) })
        }
        (None, _) => Err(AddressError::NoSize { text: owned() }),
        (Some(size), None) => {
            let byte = match addressing {
                Addressing::Byte => u64::from(first),
                Addressing::Element => u64::from(first) * u64::from(size.bytes()),
                Addressing::OpenPlc => size.openplc_base() + u64::from(first) * u64::from(size.bytes()),
            };
            Ok(LocatedAddress { area, byte: limit(byte)?, bit: None, size })
        }
        // `%IW2.0`, byte addressing: a bit of the word that starts at byte 2, bit 8 being bit 0 of byte 3.
        (Some(size), Some(bit)) => {
            let start = match addressing {
                Addressing::Byte => first,
                Addressing::Element | Addressing::OpenPlc => first.saturating_mul(size.bytes()),
            };
            if bit >= size.bytes() * 8 {
                let meant = format!("%{area_letter}X{}.{}", u64::from(start) + u64::from(bit / 8), bit % 8);
                return Err(AddressError::Bit { text: owned(), byte: start, bit, meant });
            }
            if addressing != Addressing::Byte {
                let meant = format!("%{area_letter}X{}.{}", u64::from(start) + u64::from(bit / 8), bit % 8);
                return Err(AddressError::BitOfWord { text: owned(), meant });
            }
            bit_of(start.saturating_add(bit / 8), bit % 8)
        }
    }
}

impl std::fmt::Display for LocatedAddress {
    /// In byte-wise form: `%IX0.3`, `bytes 2-3 of %I`.
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let area = area_letter(self.area);
        match self.bit {
            Some(bit) => write!(f, "%{area}X{}.{bit}", self.byte),
            None if self.size == AddressSize::Byte => write!(f, "%{area}B{}", self.byte),
            None => write!(f, "bytes {}-{} of %{area}", self.byte, self.byte + self.size.bytes() - 1),
        }
    }
}

/// `I`, `Q` or `M`.
pub(crate) fn area_letter(area: AreaKind) -> char {
    match area {
        AreaKind::Input => 'I',
        AreaKind::Output => 'Q',
        AreaKind::Marker | AreaKind::Retain | AreaKind::Data => 'M',
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(text: &str, a: Addressing) -> (AreaKind, u32, Option<u8>, u32) {
        let l = parse_address(text, a).unwrap_or_else(|e| panic!("{e}"));
        (l.area, l.byte, l.bit, l.size.bytes())
    }

    #[test]
    fn the_three_ways_to_count() {
        use Addressing::*;
        assert_eq!(at("%IX0.3", Element), (AreaKind::Input, 0, Some(3), 1));
        assert_eq!(at("%qw2", Element), (AreaKind::Output, 4, None, 2));
        assert_eq!(at("%QW2", Byte), (AreaKind::Output, 2, None, 2));
        assert_eq!(at("%MD4", Element), (AreaKind::Marker, 16, None, 4));
        assert_eq!(at("%MD4", OpenPlc), (AreaKind::Marker, 4096 + 16, None, 4));
        assert_eq!(at("%QW0", OpenPlc), (AreaKind::Output, 1024, None, 2));
        assert_eq!(at("%QX0.0", OpenPlc), (AreaKind::Output, 0, Some(0), 1));
        assert_eq!(at("%ML1", Element), (AreaKind::Marker, 8, None, 8));
        assert_eq!(at("%IB5", Element), (AreaKind::Input, 5, None, 1));
        assert_eq!(at("%I1.7", Byte), (AreaKind::Input, 1, Some(7), 1));
        assert_eq!(at("%IW2.0", Byte), (AreaKind::Input, 2, Some(0), 1));
        assert_eq!(at("%IW2.9", Byte), (AreaKind::Input, 3, Some(1), 1));
    }

    #[test]
    fn errors_name_the_address_meant() {
        let e = |t: &str, a| parse_address(t, a).unwrap_err().to_string();
        assert!(e("%IX0.8", Addressing::Element).contains("%IX1.0"));
        assert!(e("%QX2.17", Addressing::Element).contains("%QX4.1"));
        assert!(e("%IX9", Addressing::Element).contains("%IX1.1"));
        assert!(e("%IW1.9", Addressing::Element).contains("%IX3.1"));
        assert!(e("%I0.0", Addressing::Element).contains("size letter"));
        for bad in ["", "%", "IX0.0", "%ZX0.0", "%IX", "%IX0.", "%IX.1", "%IX0.0.0", "%IW-1", "%IX0.0 1", "%IQ1"] {
            assert!(matches!(parse_address(bad, Addressing::Byte), Err(AddressError::Form { .. })), "{bad}");
        }
        assert!(matches!(parse_address("%IB65536", Addressing::Byte), Err(AddressError::TooLarge { .. })));
        assert!(matches!(parse_address("%IB99999999999", Addressing::Byte), Err(AddressError::TooLarge { .. })));
        assert!(matches!(parse_address("%ID4294967295", Addressing::Element), Err(AddressError::TooLarge { .. })));
        assert!(matches!(parse_address("%I*", Addressing::Byte), Err(AddressError::Incomplete { .. })));
        assert!(matches!(parse_address("%QW*", Addressing::Byte), Err(AddressError::Incomplete { .. })));
    }

    proptest::proptest! {
        #[test]
        fn never_panics(text in "\\PC{0,12}") {
            let _ = parse_address(&text, Addressing::Element);
            let _ = parse_address(&text, Addressing::Byte);
        }
        #[test]
        fn never_panics_on_near_addresses(text in "%[IQMiqm*][XBWDLxbwdl*]?[0-9]{0,11}(\\.[0-9]{0,11}){0,2}") {
            let _ = parse_address(&text, Addressing::Element);
            let _ = parse_address(&text, Addressing::Byte);
        }
    }
}
