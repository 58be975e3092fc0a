//! SDO abort codes: every code of CiA 301 V4.2, 7.2.4.3.17, table 22, with its name and plain words for people.
//!
//! A foreign device may send any other number; [`Abort`] keeps it as it came and says that it is none of the
//! standard's.

use std::fmt;

/// An SDO abort code as it travels in bytes 4-7 of the abort transfer (CiA 301 V4.2, 7.2.4.3.17).
#[derive(Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Abort(pub u32);

/// One line of the table: code, name of the constant, words.
struct Line(u32, &'static str, &'static str);

macro_rules! aborts {
    ($($(#[$doc:meta])* $name:ident = $code:literal, $text:literal;)*) => {
        impl Abort {
            $($(#[$doc])* #[doc = $text] pub const $name: Self = Self($code);)*
            /// Every code of the standard, ascending.
            pub const ALL: &'static [Self] = &[$(Self($code)),*];
        }
        /// CiA 301 V4.2, 7.2.4.3.17, table 22.
        const TABLE: &[Line] = &[$(Line($code, stringify!($name), $text)),*];
    };
}

aborts! {
    TOGGLE = 0x0503_0000, "the toggle bit did not alternate";
    TIMEOUT = 0x0504_0000, "the other side did not answer in time";
    COMMAND = 0x0504_0001, "the command specifier is unknown or not allowed here";
    BLOCK_SIZE = 0x0504_0002, "the block size is not 1 to 127";
    SEQUENCE = 0x0504_0003, "the sequence number is not valid";
    CRC = 0x0504_0004, "the CRC of the block transfer is wrong: the data was damaged on its way";
    MEMORY = 0x0504_0005, "out of memory";
    UNSUPPORTED_ACCESS = 0x0601_0000, "the object does not support this access";
    WRITE_ONLY = 0x0601_0001, "the object is write-only and cannot be read";
    READ_ONLY = 0x0601_0002, "the object is read-only and cannot be written";
    NO_OBJECT = 0x0602_0000, "the object does not exist in the object dictionary";
    NOT_MAPPABLE = 0x0604_0041, "the object cannot be mapped to the PDO";
    PDO_LENGTH = 0x0604_0042, "the mapped objects are more or longer than the PDO can hold";
    PARAMETER = 0x0604_0043, "the parameters do not fit together";
    INTERNAL = 0x0604_0047, "the device found an internal incompatibility";
    HARDWARE = 0x0606_0000, "the access failed because of a hardware error";
    TYPE_MISMATCH = 0x0607_0010, "the data type or its length does not match";
    TOO_LONG = 0x0607_0012, "the data is longer than the object";
    TOO_SHORT = 0x0607_0013, "the data is shorter than the object";
    NO_SUB_INDEX = 0x0609_0011, "the object has no such sub-index";
    INVALID_VALUE = 0x0609_0030, "the value is not valid for this object";
    TOO_HIGH = 0x0609_0031, "the value is above the object's high limit";
    TOO_LOW = 0x0609_0032, "the value is below the object's low limit";
    MAX_BELOW_MIN = 0x0609_0036, "the maximum is below the minimum";
    NO_RESOURCE = 0x060A_0023, "the SDO connection is not available";
    GENERAL = 0x0800_0000, "general error";
    CANNOT_STORE = 0x0800_0020, "the data cannot be transferred or stored";
    LOCAL_CONTROL = 0x0800_0021, "the data cannot be transferred or stored because the device is under local control";
    DEVICE_STATE = 0x0800_0022, "the data cannot be transferred or stored in the device's present state";
    NO_DICTIONARY = 0x0800_0023, "the object dictionary is missing or could not be made";
    NO_DATA = 0x0800_0024, "no data is available";
}

impl Abort {
    fn line(self) -> Option<&'static Line> {
        TABLE.binary_search_by_key(&self.0, |line| line.0).ok().map(|at| &TABLE[at])
    }
    /// The code's short name, `None` if it is none of the standard's.
    pub fn name(self) -> Option<&'static str> {
        self.line().map(|line| line.1)
    }
    /// The code in plain words.
    pub fn text(self) -> &'static str {
        self.line().map_or("a code that CiA 301 does not define; see the device's manual", |line| line.2)
    }
    /// The number.
    pub const fn code(self) -> u32 {
        self.0
    }
}

impl fmt::Display for Abort {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "abort {:08X}h: {}", self.0, self.text())
    }
}

impl fmt::Debug for Abort {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Abort({:08X}h {})", self.0, self.name().unwrap_or("?"))
    }
}

impl std::error::Error for Abort {}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table_is_whole_and_sorted() {
        assert_eq!(Abort::ALL.len(), 31);
        assert!(Abort::ALL.windows(2).all(|pair| pair[0] < pair[1]));
        for abort in Abort::ALL {
            assert!(abort.name().is_some() && !abort.text().is_empty());
        }
    }

    #[test]
    fn codes_speak() {
        assert_eq!(Abort::NO_OBJECT.code(), 0x0602_0000);
        assert_eq!(Abort::TOGGLE.to_string(), "abort 05030000h: the toggle bit did not alternate");
        assert_eq!(
            Abort(0x1234).to_string(),
            "abort 00001234h: a code that CiA 301 does not define; see the device's manual"
        );
        assert_eq!(format!("{:?}", Abort::CRC), "Abort(05040004h CRC)");
    }
}
