//! A number of the stack file as the bytes of an object.

use crate::config::Number as Written;
use crate::protocol::data_type::{DataType, Number};
use crate::protocol::od::Entry;

/// The bytes of `value` for this object, or why it has none.
pub fn encode(value: &Written, entry: &Entry, node_id: u8) -> Result<Vec<u8>, String> {
    let data_type = entry.data_type;
    let number = if data_type.is_real() {
        let real = match value {
            Written::Float(v) => Some(*v),
            Written::Text(text) => text.trim().parse().ok(),
            other => other.integer(node_id).map(|v| v as f64),
        };
        Number::Real(real.ok_or_else(|| format!("{value} is no number, the object is a {data_type}"))?)
    } else if data_type.is_integer() || data_type == DataType::Boolean {
        let int = value.integer(node_id);
        Number::Int(i128::from(
            int.ok_or_else(|| format!("{value} is no integer, the object is a {data_type}"))?,
        ))
    } else if let Written::Text(text) = value {
        return text_bytes(text, entry);
    } else {
        return Err(format!("{value} must be written as text, the object is a {data_type}"));
    };
    let mut bytes = [0; 8];
    let size = data_type.encode(number, &mut bytes).ok_or_else(|| match data_type.range() {
        Some((low, high)) => format!("{value} does not fit a {data_type}, which takes {low} to {high}"),
        None => format!("{value} does not fit a {data_type}"),
    })?;
    let outside = |limit: Option<Number>, wrong: std::cmp::Ordering| {
        limit.filter(|&limit| number.compare(limit) == Some(wrong))
    };
    if let Some(high) = outside(entry.high, std::cmp::Ordering::Greater) {
        return Err(format!("{value} is above the object's high limit {high}"));
    }
    if let Some(low) = outside(entry.low, std::cmp::Ordering::Less) {
        return Err(format!("{value} is below the object's low limit {low}"));
    }
    Ok(bytes[..size].to_vec())
}

/// Text as it is; of a domain or octet string that begins with `hex:` the bytes.
fn text_bytes(text: &str, entry: &Entry) -> Result<Vec<u8>, String> {
    let bytes = match text.strip_prefix("hex:") {
        Some(digits) if !matches!(entry.data_type, DataType::VisibleString | DataType::UnicodeString) => {
            let digits: Vec<u32> = digits
                .chars()
                .filter(|c| !c.is_whitespace())
                .map(|c| c.to_digit(16))
                .collect::<Option<_>>()
                .ok_or_else(|| format!("'{text}' has characters that are no hex digits"))?;
            if digits.len() % 2 == 1 {
                return Err(format!("'{text}' has an odd number of hex digits"));
            }
            digits.chunks(2).map(|pair| (pair[0] * 16 + pair[1]) as u8).collect()
        }
        _ if entry.data_type == DataType::UnicodeString => {
            text.encode_utf16().flat_map(u16::to_le_bytes).collect()
        }
        _ => text.as_bytes().to_vec(),
    };
    if bytes.len() > entry.capacity as usize {
        return Err(format!("{} bytes are more than the object takes, {}", bytes.len(), entry.capacity));
    }
    Ok(bytes)
}
