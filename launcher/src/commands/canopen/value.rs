//! Values of objects as they are typed and shown.

use super::super::UsageError;
use dinrail_canopen::protocol::data_type::{DataType, Number};

/// The types a user may name.
const TYPES: &[(&str, DataType)] = &[
    ("bool", DataType::Boolean),
    ("u8", DataType::Unsigned8),
    ("u16", DataType::Unsigned16),
    ("u24", DataType::Unsigned24),
    ("u32", DataType::Unsigned32),
    ("u64", DataType::Unsigned64),
    ("i8", DataType::Integer8),
    ("i16", DataType::Integer16),
    ("i24", DataType::Integer24),
    ("i32", DataType::Integer32),
    ("i64", DataType::Integer64),
    ("f32", DataType::Real32),
    ("f64", DataType::Real64),
    ("string", DataType::VisibleString),
    ("hex", DataType::Domain),
];

fn named(name: &str) -> Result<DataType, UsageError> {
    TYPES.iter().find(|(n, _)| n.eq_ignore_ascii_case(name)).map(|(_, t)| *t).ok_or_else(|| {
        let all: Vec<&str> = TYPES.iter().map(|(n, _)| *n).collect();
        UsageError(format!("there is no type '{name}'; the types are {}", all.join(", ")))
    })
}

/// Bytes of a value of a named type.
pub fn bytes(text: &str, kind: &str) -> Result<Vec<u8>, UsageError> {
    let data_type = named(kind)?;
    let wrong = || UsageError(format!("'{text}' is no {kind}"));
    match data_type {
        DataType::VisibleString => return Ok(text.as_bytes().to_vec()),
        DataType::Domain => {
            let digits: Option<Vec<u32>> =
                text.chars().filter(|c| !c.is_whitespace()).map(|c| c.to_digit(16)).collect();
            let digits = digits.filter(|d| d.len() % 2 == 0).ok_or_else(wrong)?;
            return Ok(digits.chunks(2).map(|pair| (pair[0] * 16 + pair[1]) as u8).collect());
        }
        _ => {}
    }
    let number = if data_type.is_real() {
        Number::Real(text.parse().map_err(|_| wrong())?)
    } else {
        let int = match (text.strip_prefix("0x"), text) {
            (Some(hex), _) => i128::from_str_radix(hex, 16).map_err(|_| wrong())?,
            (None, "true") => 1,
            (None, "false") => 0,
            (None, text) => text.parse().map_err(|_| wrong())?,
        };
        Number::Int(int)
    };
    let mut out = [0; 8];
    let size = data_type.encode(number, &mut out).ok_or_else(wrong)?;
    Ok(out[..size].to_vec())
}

/// A value of a named type in words; hex where it does not fit.
pub fn text(data: &[u8], kind: &str) -> Result<String, UsageError> {
    let data_type = named(kind)?;
    Ok(match data_type {
        DataType::VisibleString => String::from_utf8_lossy(data).into_owned(),
        DataType::Domain => hex(data),
        _ if data_type.size() == Some(data.len()) => {
            data_type.number(data).map_or_else(|| hex(data), |n| n.to_string())
        }
        _ => {
            return Err(UsageError(format!(
                "the value has {} bytes, which is no {kind}: {}",
                data.len(),
                hex(data)
            )));
        }
    })
}

pub fn hex(data: &[u8]) -> String {
    data.iter().map(|b| format!("{b:02X}")).collect::<Vec<_>>().join(" ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_are_typed_and_shown() {
        for (typed, kind, expected, shown) in [
            ("5", "u8", vec![5], "5"),
            ("-2", "i16", vec![0xFE, 0xFF], "-2"),
            ("0x1234", "U32", vec![0x34, 0x12, 0, 0], "4660"),
            ("1.5", "f32", vec![0, 0, 0xC0, 0x3F], "1.5"),
            ("true", "bool", vec![1], "1"),
            ("ab", "string", b"ab".to_vec(), "ab"),
            ("0A ff", "hex", vec![10, 255], "0A FF"),
        ] {
            let data = bytes(typed, kind).unwrap();
            assert_eq!(data, expected, "{typed}");
            assert_eq!(text(&data, kind).unwrap(), shown);
        }
        for (typed, kind) in [("300", "u8"), ("x", "u8"), ("0", "hex"), ("1", "u9"), ("a", "f32")] {
            assert!(bytes(typed, kind).is_err(), "{typed}");
        }
        assert!(text(&[1], "u16").unwrap_err().to_string().contains("1 bytes"));
    }
}
