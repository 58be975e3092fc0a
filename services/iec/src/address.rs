//! `%`-addresses: one reader and one writer for sources, stack files, routes, register maps and `dinrail map`.

use crate::artifact::AreaKind;
use serde::{Deserialize, Serialize};

/// Elements of each of OpenPLC's tables; of the bit table, bytes.
pub const OPENPLC_ELEMENTS: u32 = 1024;
/// Largest area.
const AREA_BYTES: u64 = 65_536;
/// Characters of a wrong address that a message shows.
const SHOWN: usize = 40;

/// How the number in `%IW2` counts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
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

impl Addressing {
    /// Name as in the stack file.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Element => "element",
            Self::Byte => "byte",
            Self::OpenPlc => "openplc",
        }
    }
    /// From the name in the stack file.
    pub fn from_name(name: &str) -> Option<Self> {
        [Self::Element, Self::Byte, Self::OpenPlc].into_iter().find(|a| a.name() == name)
    }
    /// First byte of the values of a size: 0 but for OpenPLC's tables.
    pub const fn base(self, size: AddressSize) -> u32 {
        match self {
            Self::Element | Self::Byte => 0,
            Self::OpenPlc => size.openplc_base(),
        }
    }
    /// Bytes that the values of a size may take in an area of `area_bytes`, from [`Addressing::base`] on.
    pub fn room(self, size: AddressSize, area_bytes: u32) -> u32 {
        let room = area_bytes.saturating_sub(self.base(size));
        match self {
            Self::Element | Self::Byte => room,
            Self::OpenPlc => room.min(OPENPLC_ELEMENTS * size.bytes()),
        }
    }
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
    /// 1, 8, 16, 32 or 64.
    pub const fn bits(self) -> u32 {
        match self {
            Self::Bit => 1,
            _ => self.bytes() * 8,
        }
    }
    /// First byte of this size's own table with [`Addressing::OpenPlc`].
    const fn openplc_base(self) -> u32 {
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

impl LocatedAddress {
    /// The place of one bit, or of `bytes` bytes. `area` is `I`, `Q` or `M`. `None` when no address has this form.
    pub fn new(area: char, byte: u32, bit: Option<u8>, bytes: u32) -> Option<Self> {
        let area = match area {
            'I' => AreaKind::Input,
            'Q' => AreaKind::Output,
            'M' => AreaKind::Marker,
            _ => return None,
        };
        let size = match (bit, bytes) {
            (Some(0..=7), _) => AddressSize::Bit,
            (None, 1) => AddressSize::Byte,
            (None, 2) => AddressSize::Word,
            (None, 4) => AddressSize::Dword,
            (None, 8) => AddressSize::Lword,
            _ => return None,
        };
        (u64::from(byte) + u64::from(size.bytes()) <= AREA_BYTES).then_some(Self { area, byte, bit, size })
    }

    /// The text that [`parse_address`] reads as this place. `None` when this way to count has no number for it:
    /// a value that does not begin at a multiple of its size, or lies outside OpenPLC's table of its size.
    pub fn text(self, addressing: Addressing) -> Option<String> {
        let (area, letter) = (area_letter(self.area), self.size.letter());
        let unit = match addressing {
            Addressing::Byte => 1,
            Addressing::Element | Addressing::OpenPlc => self.size.bytes(),
        };
        let from_base = self.byte.checked_sub(addressing.base(self.size))?;
        let number = from_base.is_multiple_of(unit).then_some(from_base / unit)?;
        if addressing == Addressing::OpenPlc && number >= OPENPLC_ELEMENTS {
            return None;
        }
        Some(match self.bit {
            Some(bit) => format!("%{area}{letter}{number}.{bit}"),
            None => format!("%{area}{letter}{number}"),
        })
    }
}

/// Why a text is no address.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum AddressError {
    #[error(
        "`{text}` is not an address: write %I, %Q or %M, a size X, B, W, D or L, and a number, like %IX0.3 or %QW2"
    )]
    Form { text: String },
    #[error("`{text}`: a byte has the bits 0 to 7; bit {bit} of byte {byte} is {meant}")]
    Bit { text: String, byte: u32, bit: u32, meant: String },
    #[error("`{text}` names a bit without its byte: write {meant}")]
    BareBit { text: String, meant: String },
    #[error("`{text}`: addresses of this size have no bit; the bit you may mean is {meant}")]
    BitOfWord { text: String, meant: String },
    #[error(
        "`{text}`: without a size letter only a bit is meant, like %IX0.0 (`addressing = \"byte\"` also takes %I0.0)"
    )]
    NoSize { text: String },
    #[error("`{text}` is an incomplete address (`*`): VAR_CONFIG is not supported, write the address")]
    Incomplete { text: String },
    #[error("`{text}`: the number is too large, an area has at most 65536 bytes")]
    TooLarge { text: String },
    #[error("`{text}`: OpenPLC's tables have {OPENPLC_ELEMENTS} elements, 0 to {}", OPENPLC_ELEMENTS - 1)]
    OutsideTable { text: String },
}

/// Reads `%IX0.3`, `%QW2`, `%MD4`, `%IB5` (any case).
pub fn parse_address(text: &str, addressing: Addressing) -> Result<LocatedAddress, AddressError> {
    let owned = || text.chars().take(SHOWN).collect::<String>();
    let form = || AddressError::Form { text: owned() };
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
                p.parse::<u32>().map(Some).map_err(|_| AddressError::TooLarge { text: owned() })
            }
            Some(_) => Err(form()),
        }
    };
    let (first, second, third) = (number()?.ok_or_else(form)?, number()?, number()?);
    if third.is_some() {
        return Err(form());
    }
    let limit = |byte: u64, size: AddressSize| -> Result<u32, AddressError> {
        let end = byte.saturating_add(u64::from(size.bytes()));
        if end <= AREA_BYTES { Ok(byte as u32) } else { Err(AddressError::TooLarge { text: owned() }) }
    };
    let bit_of = |byte: u32, bit: u32| -> Result<LocatedAddress, AddressError> {
        if bit > 7 {
            let meant = format!("%{area_letter}X{}.{}", u64::from(byte) + u64::from(bit / 8), bit % 8);
            return Err(AddressError::Bit { text: owned(), byte, bit, meant });
        }
        Ok(LocatedAddress {
            area,
            byte: limit(u64::from(byte), AddressSize::Bit)?,
            bit: Some(bit as u8),
            size: AddressSize::Bit,
        })
    };
    if addressing == Addressing::OpenPlc && first >= OPENPLC_ELEMENTS && size.is_some() {
        return Err(AddressError::OutsideTable { text: owned() });
    }
    match (size, second) {
        (Some(AddressSize::Bit), Some(bit)) => bit_of(first, bit),
        (None, Some(bit)) if addressing == Addressing::Byte => bit_of(first, bit),
        (Some(AddressSize::Bit), None) => Err(AddressError::BareBit {
            text: owned(),
            meant: format!("%{area_letter}X{}.{}", first / 8, first % 8),
        }),
        (None, _) => Err(AddressError::NoSize { text: owned() }),
        (Some(size), None) => {
            let unit = if addressing == Addressing::Byte { 1 } else { size.bytes() };
            let byte = u64::from(addressing.base(size)) + u64::from(first) * u64::from(unit);
            Ok(LocatedAddress { area, byte: limit(byte, size)?, bit: None, size })
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
        for bad in
            ["", "%", "IX0.0", "%ZX0.0", "%IX", "%IX0.", "%IX.1", "%IX0.0.0", "%IW-1", "%IX0.0 1", "%IQ1"]
        {
            assert!(matches!(parse_address(bad, Addressing::Byte), Err(AddressError::Form { .. })), "{bad}");
        }
        assert!(matches!(parse_address("%IB65536", Addressing::Byte), Err(AddressError::TooLarge { .. })));
        assert!(matches!(
            parse_address("%IB99999999999", Addressing::Byte),
            Err(AddressError::TooLarge { .. })
        ));
        assert!(matches!(
            parse_address("%ID4294967295", Addressing::Element),
            Err(AddressError::TooLarge { .. })
        ));
        assert!(matches!(parse_address("%IW65535", Addressing::Byte), Err(AddressError::TooLarge { .. })));
        assert!(matches!(parse_address("%IL8192", Addressing::Element), Err(AddressError::TooLarge { .. })));
        assert_eq!(at("%IL8191", Addressing::Element).1, 65_528);
        assert_eq!(at("%IX65535.7", Addressing::Element).1, 65_535);
        assert!(matches!(parse_address("%I*", Addressing::Byte), Err(AddressError::Incomplete { .. })));
        assert!(matches!(parse_address("%QW*", Addressing::Byte), Err(AddressError::Incomplete { .. })));
    }

    #[test]
    fn openplc_tables_end() {
        for text in ["%MW1024", "%QX1024.0", "%ML1024"] {
            assert_eq!(
                parse_address(text, Addressing::OpenPlc),
                Err(AddressError::OutsideTable { text: text.to_owned() })
            );
        }
        for (size, base, room) in [
            (AddressSize::Bit, 0, 1024),
            (AddressSize::Word, 1024, 2048),
            (AddressSize::Byte, 3072, 1024),
            (AddressSize::Dword, 4096, 0),
            (AddressSize::Lword, 8192, 0),
        ] {
            assert_eq!((Addressing::OpenPlc.base(size), Addressing::OpenPlc.room(size, 4096)), (base, room));
            assert_eq!((Addressing::Element.base(size), Addressing::Element.room(size, 4096)), (0, 4096));
        }
        assert_eq!(Addressing::OpenPlc.room(AddressSize::Lword, 65_536), 8192);
    }

    #[test]
    fn names_are_those_of_the_stack_file() {
        for addressing in [Addressing::Element, Addressing::Byte, Addressing::OpenPlc] {
            let json = serde_json::to_value(addressing).unwrap();
            assert_eq!(json, addressing.name());
            assert_eq!(serde_json::from_value::<Addressing>(json).unwrap(), addressing);
            assert_eq!(Addressing::from_name(addressing.name()), Some(addressing));
        }
        assert_eq!(Addressing::from_name("words"), None);
    }

    #[test]
    fn places_without_a_text() {
        let new = LocatedAddress::new;
        for (area, byte, bit, bytes) in [
            ('X', 0, None, 1),
            ('I', 0, None, 3),
            ('I', 0, None, 0),
            ('I', 0, Some(8), 1),
            ('I', 65_535, None, 2),
            ('I', u32::MAX, None, 8),
        ] {
            assert_eq!(new(area, byte, bit, bytes), None, "{area} {byte} {bit:?} {bytes}");
        }
        let text = |byte, bit, bytes, addressing| new('M', byte, bit, bytes).unwrap().text(addressing);
        assert_eq!(text(3, None, 2, Addressing::Element), None);
        assert_eq!(text(3, None, 2, Addressing::Byte).as_deref(), Some("%MW3"));
        assert_eq!(text(3, None, 2, Addressing::OpenPlc), None);
        assert_eq!(text(1026, None, 2, Addressing::OpenPlc).as_deref(), Some("%MW1"));
        assert_eq!(text(3072, None, 2, Addressing::OpenPlc), None);
        assert_eq!(text(1024, Some(0), 1, Addressing::OpenPlc), None);
    }

    #[test]
    fn messages_show_no_more_than_40_characters() {
        let long = "%IW0.é".repeat(1000);
        let error = parse_address(&long, Addressing::Byte).unwrap_err().to_string();
        assert!(error.chars().count() < 200, "{error}");
    }

    proptest::proptest! {
        #[test]
        fn text_is_parsed_back(
            area in "[IQM]", byte in 0..65_536_u32, bit in proptest::option::of(0..8_u8), size in 0..4_u32,
        ) {
            let bytes = if bit.is_some() { 1 } else { 1 << size };
            let Some(place) = LocatedAddress::new(area.chars().next().unwrap(), byte, bit, bytes) else {
                return Ok(());
            };
            for addressing in [Addressing::Element, Addressing::Byte, Addressing::OpenPlc] {
                if let Some(text) = place.text(addressing) {
                    proptest::prop_assert_eq!(parse_address(&text, addressing), Ok(place));
                }
            }
            proptest::prop_assert!(place.text(Addressing::Byte).is_some());
        }
        #[test]
        fn never_panics(text in "\\PC{0,12}") {
            let _ = parse_address(&text, Addressing::Element);
            let _ = parse_address(&text, Addressing::Byte);
            let _ = parse_address(&text, Addressing::OpenPlc);
        }
        #[test]
        fn never_panics_on_near_addresses(text in "%[IQMiqm*][XBWDLxbwdl*]?[0-9]{0,11}(\\.[0-9]{0,11}){0,2}") {
            let _ = parse_address(&text, Addressing::Element);
            let _ = parse_address(&text, Addressing::Byte);
            let _ = parse_address(&text, Addressing::OpenPlc);
        }
    }
}
