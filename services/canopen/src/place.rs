//! Objects and the places of the process image that take them.

use crate::protocol::data_type::DataType;
use crate::protocol::od::Entry;
use dinrail_iec::LocatedAddress;

/// Whether a place can take the object's value; `text` is the address as it was written.
pub fn fits(entry: &Entry, at: LocatedAddress, text: &str) -> Result<(), String> {
    let (index, sub) = (entry.index, entry.sub);
    match entry.pdo_bits() {
        None => Err(format!(
            "{index:04X}:{sub:02X} is a {} of no fixed length: the image has no place for it",
            entry.data_type
        )),
        Some(bits) if u32::from(bits) > at.size.bits() => {
            Err(format!("{index:04X}:{sub:02X} has {bits} bits, {text} has {}", at.size.bits()))
        }
        Some(_) => Ok(()),
    }
}

/// IEC type of an object at a place of this size.
pub fn iec_type(data_type: DataType, at: LocatedAddress) -> &'static str {
    let bits = at.size.bits();
    match (data_type, bits) {
        (_, 1) => "BOOL",
        (DataType::Real32, 32) => "REAL",
        (DataType::Real64, 64) => "LREAL",
        _ if data_type.is_signed() => match bits {
            8 => "SINT",
            16 => "INT",
            32 => "DINT",
            _ => "LINT",
        },
        _ if data_type.is_unsigned() => match bits {
            8 => "USINT",
            16 => "UINT",
            32 => "UDINT",
            _ => "ULINT",
        },
        _ => match bits {
            8 => "BYTE",
            16 => "WORD",
            32 => "DWORD",
            _ => "LWORD",
        },
    }
}
