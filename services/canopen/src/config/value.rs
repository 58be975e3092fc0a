//! Objects and numbers as they are written in a stack file.

use serde::{Deserialize, Deserializer, Serialize, Serializer, de};
use std::fmt;
use std::str::FromStr;

/// An object: `"6000:01"`, `"0x1018:4"` or `"1000"` (sub-index 0). Both parts are hexadecimal, as in an EDS. A word
/// that is no such number is the name of an object in the node's EDS.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub enum ObjectRef {
    Number {
        index: u16,
        /// 0 when not written.
        sub: u8,
        /// Whether a sub-index was written.
        has_sub: bool,
    },
    Name(String),
}

impl ObjectRef {
    /// Index and sub-index; `None` for a name.
    pub fn number(&self) -> Option<(u16, u8)> {
        match self {
            Self::Number { index, sub, .. } => Some((*index, *sub)),
            Self::Name(_) => None,
        }
    }
}

fn hex(text: &str) -> Option<u32> {
    let digits = text.strip_prefix("0x").or_else(|| text.strip_prefix("0X")).unwrap_or(text);
    let digits = digits.strip_suffix(['h', 'H']).unwrap_or(digits);
    let fine = !digits.is_empty() && digits.len() <= 4 && digits.bytes().all(|c| c.is_ascii_hexdigit());
    fine.then(|| u32::from_str_radix(digits, 16).ok()).flatten()
}

impl FromStr for ObjectRef {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let text = text.trim();
        if text.is_empty() {
            return Err("an object is written as \"6000:01\" or by its name in the EDS".to_owned());
        }
        let (index, sub) = text.split_once(':').map_or((text, None), |(i, s)| (i, Some(s)));
        match (hex(index), sub.map(hex)) {
            (Some(index), None) if text.len() >= 4 => {
                Ok(Self::Number { index: index as u16, sub: 0, has_sub: false })
            }
            (Some(index), Some(Some(sub))) if sub <= 0xFF => {
                Ok(Self::Number { index: index as u16, sub: sub as u8, has_sub: true })
            }
            (Some(_), Some(_)) => Err(format!(
                "the sub-index of '{text}' must be 0 to FF; an object is written as \"6000:01\", both parts in hex"
            )),
            _ => Ok(Self::Name(text.to_owned())),
        }
    }
}

impl fmt::Display for ObjectRef {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Number { index, sub, .. } => write!(f, "{index:04X}:{sub:02X}"),
            Self::Name(name) => f.write_str(name),
        }
    }
}

impl Serialize for ObjectRef {
    fn serialize<S: Serializer>(&self, s: S) -> Result<S::Ok, S::Error> {
        match self {
            Self::Number { index, has_sub: false, .. } => s.collect_str(&format_args!("{index:04X}")),
            _ => s.collect_str(self),
        }
    }
}

impl<'de> Deserialize<'de> for ObjectRef {
    fn deserialize<D: Deserializer<'de>>(d: D) -> Result<Self, D::Error> {
        String::deserialize(d)?.parse().map_err(de::Error::custom)
    }
}

/// A value to write: a number, `"0x1F"`, `"$NODEID+0x180"`, or text and bytes where the object is a string.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(untagged, expecting = "a number, true, false or text")]
pub enum Number {
    Bool(bool),
    Int(i64),
    Float(f64),
    Text(String),
}

impl fmt::Display for Number {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Bool(v) => write!(f, "{v}"),
            Self::Int(v) => write!(f, "{v}"),
            Self::Float(v) => write!(f, "{v}"),
            Self::Text(v) => write!(f, "{v}"),
        }
    }
}

impl Number {
    /// As an identifier: what [`Self::integer`] gives, but true and false are none.
    pub fn identifier(&self, node_id: u8) -> Option<i64> {
        if matches!(self, Self::Bool(_)) { None } else { self.integer(node_id) }
    }
    /// As an integer: `$NODEID` stands for the node's id. `None` when it is none.
    pub fn integer(&self, node_id: u8) -> Option<i64> {
        match self {
            Self::Bool(v) => Some(i64::from(*v)),
            Self::Int(v) => Some(*v),
            Self::Float(_) => None,
            Self::Text(text) => {
                let mut sum = 0i64;
                for part in text.split('+') {
                    let part = part.trim();
                    let value = if part.eq_ignore_ascii_case("$NODEID") {
                        i64::from(node_id)
                    } else if let Some(digits) = part.strip_prefix("0x").or_else(|| part.strip_prefix("0X")) {
                        i64::from_str_radix(digits, 16).ok()?
                    } else {
                        part.parse().ok()?
                    };
                    sum = sum.checked_add(value)?;
                }
                Some(sum)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn objects() {
        let number = |text: &str| text.parse::<ObjectRef>().unwrap();
        for (text, expected) in [
            ("6000:01", (0x6000, 1)),
            ("0x6000:0x1", (0x6000, 1)),
            ("1018:4", (0x1018, 4)),
            ("1000", (0x1000, 0)),
            ("1A00h:FF", (0x1A00, 0xFF)),
        ] {
            assert_eq!(number(text).number(), Some(expected), "{text}");
        }
        for name in ["Buttons", "Digital inputs 1", "fee", "60000:01"] {
            assert_eq!(number(name), ObjectRef::Name(name.to_owned()), "{name}");
        }
        for wrong in ["", " ", "6000:100", "6000:xy"] {
            assert!(wrong.parse::<ObjectRef>().is_err(), "{wrong}");
        }
        for text in ["6000:01", "1000", "Buttons"] {
            let json = serde_json::to_string(&number(text)).unwrap();
            assert_eq!(serde_json::from_str::<ObjectRef>(&json).unwrap(), number(text));
        }
    }

    #[test]
    fn numbers() {
        let text = |t: &str| Number::Text(t.to_owned());
        for (number, expected) in [
            (Number::Int(-5), Some(-5)),
            (Number::Bool(true), Some(1)),
            (text("0x1F"), Some(31)),
            (text("$NODEID+0x180"), Some(0x185)),
            (text("0x180 + $nodeid"), Some(0x185)),
            (text("12"), Some(12)),
            (text("twelve"), None),
            (text(""), None),
            (Number::Float(1.5), None),
            (text("9223372036854775807+1"), None),
        ] {
            assert_eq!(number.integer(5), expected, "{number}");
            let identifier = expected.filter(|_| !matches!(number, Number::Bool(_)));
            assert_eq!(number.identifier(5), identifier, "{number}");
        }
    }
}
