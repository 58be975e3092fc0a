//! Values as they are written in an EDS or DCF (CiA 306-1): numbers decimal, hexadecimal (`0x`) or
//! octal (leading 0), formulas with `$NODEID`, text, bytes.

use crate::protocol::data_type::{DataType, Number};
use crate::protocol::od::Entry;

/// A value of an object.
#[derive(Clone, Debug, PartialEq)]
pub struct Value {
    /// As it lies in memory; empty: an empty string. Without the node-id.
    pub bytes: Vec<u8>,
    /// The node-id is added.
    pub node_relative: bool,
}

/// A value, or why there is none; with a remark where it was taken although it is not written as it should be.
pub(super) type Parsed<T> = Result<(T, Option<String>), String>;

/// A whole number without a sign, decimal, hexadecimal or octal. `Some` remark: taken, but written in a way that
/// CiA 306 does not know.
pub fn unsigned(text: &str) -> Parsed<u64> {
    let (value, remark) = integer(text)?;
    u64::try_from(value).map(|value| (value, remark)).map_err(|_| format!("'{text}' is out of range"))
}

/// A whole number, maybe with a sign.
pub(super) fn integer(text: &str) -> Parsed<i128> {
    let (number, mut remark) = strip(text);
    let (negative, digits) = match number.strip_prefix('-') {
        Some(rest) => (true, rest.trim_start()),
        None => (false, number.strip_prefix('+').unwrap_or(number)),
    };
    let digits = digits.strip_suffix(['u', 'U', 'l', 'L']).unwrap_or(digits);
    let hex = |digits: &str| digits.bytes().all(|b| b.is_ascii_hexdigit());
    let (radix, digits) = match digits.get(..2) {
        Some("0x" | "0X") => (16, digits[2..].strip_suffix(['h', 'H']).unwrap_or(&digits[2..])),
        _ if digits.len() > 1 && digits.ends_with(['h', 'H']) && hex(&digits[..digits.len() - 1]) => {
            remark = Some(format!("'{text}' ends with h: taken as hexadecimal"));
            (16, &digits[..digits.len() - 1])
        }
        // `000F0191` can be nothing else; `1E3`, `FADE` could.
        _ if digits.starts_with('0')
            && digits.len() >= 4
            && hex(digits)
            && !digits.bytes().all(|b| b.is_ascii_digit()) =>
        {
            remark = Some(format!("'{text}' has no 0x in front: taken as hexadecimal"));
            (16, digits)
        }
        _ if digits.len() > 1 && digits.starts_with('0') && digits.bytes().all(|b| b.is_ascii_digit()) => {
            if digits.bytes().all(|byte| byte < b'8') {
                (8, &digits[1..])
            } else {
                remark = Some(format!("'{text}' begins with 0 but is not octal: taken as decimal"));
                (10, digits)
            }
        }
        _ => (10, digits),
    };
    if digits.is_empty() || digits.starts_with(['+', '-']) {
        return Err(format!("'{}' is no number", super::ini::short(text)));
    }
    let value = i128::from_str_radix(digits, radix)
        .map_err(|_| format!("'{}' is no number", super::ini::short(text)))?;
    Ok((if negative { -value } else { value }, remark))
}

/// Cuts a comment behind a number.
fn strip(text: &str) -> (&str, Option<String>) {
    match text.find([';', '#']) {
        Some(at) => {
            let note = format!("'{}' behind the number is ignored", super::ini::short(&text[at..]));
            (text[..at].trim(), Some(note))
        }
        None => (text.trim(), None),
    }
}

/// The default or parameter value `text` of a type; `Ok(None)`: nothing is written.
pub(super) fn parse(text: &str, data_type: DataType) -> Parsed<Option<Value>> {
    if text.is_empty() {
        return Ok((None, None));
    }
    let plain = |bytes| Some(Value { bytes, node_relative: false });
    match data_type {
        DataType::VisibleString => Ok((plain(text.as_bytes().to_vec()), None)),
        DataType::UnicodeString => {
            Ok((plain(text.encode_utf16().flat_map(u16::to_le_bytes).collect()), None))
        }
        DataType::TimeOfDay | DataType::TimeDifference => {
            let (value, remark) = unsigned(text)?;
            if value >> 48 != 0 {
                return Err(format!("'{text}' has more than 48 bits"));
            }
            Ok((plain(value.to_le_bytes()[..6].to_vec()), remark))
        }
        _ if data_type.is_real() => {
            let (bytes, remark) = real(text, data_type)?;
            Ok((bytes.and_then(plain), remark))
        }
        DataType::Boolean if text.eq_ignore_ascii_case("true") => Ok((plain(vec![1]), None)),
        DataType::Boolean if text.eq_ignore_ascii_case("false") => Ok((plain(vec![0]), None)),
        _ if data_type.is_integer() => {
            let (number, node_relative, remark) = formula(text)?;
            let bytes = fit(number, text, data_type)?;
            Ok((Some(Value { bytes, node_relative }), remark))
        }
        _ => Ok(match hex(text) {
            Some(bytes) => (plain(bytes), None),
            None => {
                let remark = format!("'{}' is not hexadecimal: taken as text", super::ini::short(text));
                let tells = matches!(data_type, DataType::OctetString);
                (plain(text.as_bytes().to_vec()), Some(remark).filter(|_| tells))
            }
        }),
    }
}

/// A limit of a number; `Ok(None)`: nothing is written, or the type is none that is limited.
pub(super) fn limit(text: &str, data_type: DataType) -> Parsed<Option<Number>> {
    if text.is_empty() || !(data_type.is_integer() || data_type.is_real()) {
        return Ok((None, None));
    }
    let (value, remark) = parse(text, data_type)?;
    let Some(value) = value else { return Ok((None, remark)) };
    if value.node_relative {
        return Err("a limit cannot depend on the node-id".to_owned());
    }
    Ok((data_type.number(&value.bytes), remark))
}

fn encode(number: Number, data_type: DataType) -> Option<Vec<u8>> {
    let mut bytes = [0; 8];
    data_type.encode(number, &mut bytes).map(|size| bytes[..size].to_vec())
}

/// An integer of the type; hexadecimal may give a negative one as its bits.
fn fit(number: i128, text: &str, data_type: DataType) -> Result<Vec<u8>, String> {
    if let Some(bytes) = encode(Number::Int(number), data_type) {
        return Ok(bytes);
    }
    let bits = u32::from(data_type.bits().unwrap_or(0));
    if data_type.is_signed() && number >= 0 && number < 1 << bits && text.to_ascii_lowercase().contains("0x")
    {
        return Ok(number.to_le_bytes()[..(bits / 8) as usize].to_vec());
    }
    Err(format!("'{}' does not fit a {data_type}", super::ini::short(text)))
}

/// The sum of numbers and, at most once, `$NODEID`.
fn formula(text: &str) -> Result<(i128, bool, Option<String>), String> {
    let upper = text.to_ascii_uppercase();
    let Some((at, len)) = upper.find("$NODEID").map(|at| (at, 7)).or(upper.find("NODEID").map(|at| (at, 6)))
    else {
        let (number, remark) = integer(text).or_else(|fault| whole_real(text).ok_or(fault))?;
        return Ok((number, false, remark));
    };
    let (before, behind) = (text[..at].trim(), text[at + len..].trim());
    let bad = || format!("'{}' is no sum of a number and $NODEID", super::ini::short(text));
    let (mut sum, mut remark) = (0, (len == 6).then(|| "NODEID without '$': taken as $NODEID".to_owned()));
    for part in [before.strip_suffix('+').unwrap_or(before), behind.strip_prefix('+').unwrap_or(behind)] {
        if part.trim().is_empty() {
            continue;
        }
        for term in part.split('+') {
            let (number, note) = integer(term).map_err(|_| bad())?;
            sum += number;
            remark = remark.or(note);
        }
    }
    if (!before.is_empty() && !before.ends_with('+'))
        || (!behind.is_empty() && !behind.starts_with(['+', ';']))
    {
        return Err(bad());
    }
    Ok((sum, true, remark))
}

/// A real without a fraction where an integer belongs (`0.0`).
fn whole_real(text: &str) -> Option<(i128, Option<String>)> {
    let (number, _) = strip(text);
    let value: f64 = number.parse().ok()?;
    let whole = number.contains('.') && value.fract() == 0.0 && value.abs() < 9e15;
    whole.then(|| {
        (value as i128, Some(format!("'{number}' is a real, the object an integer: taken as {value:.0}")))
    })
}

/// A real, decimal or as its bits in hexadecimal. Bits are taken as they are: a conversion would make a signalling
/// NaN a quiet one.
fn real(text: &str, data_type: DataType) -> Parsed<Option<Vec<u8>>> {
    let (number, remark) = strip(text);
    if let Some(digits) = number.strip_prefix("0x").or_else(|| number.strip_prefix("0X")) {
        let bits = u64::from_str_radix(digits, 16).map_err(|_| format!("'{number}' is no number"))?;
        let size = data_type.size().unwrap_or(8);
        if size < 8 && bits >> (8 * size) != 0 {
            return Err(format!("'{number}' has more than {} bits", 8 * size));
        }
        return Ok((Some(bits.to_le_bytes()[..size].to_vec()), remark));
    }
    let encoded = |value| encode(Number::Real(value), data_type);
    if let Ok(value) = number.parse() {
        return Ok((encoded(value), remark));
    }
    let dotted = number.replace(',', ".");
    let value = dotted.parse().map_err(|_| format!("'{}' is no number", super::ini::short(text)))?;
    Ok((encoded(value), Some(format!("'{number}' has a decimal comma: taken as a point"))))
}

/// Pairs of hexadecimal digits, with or without blanks between them or a `0x` in front.
fn hex(text: &str) -> Option<Vec<u8>> {
    let text = text.strip_prefix("0x").or_else(|| text.strip_prefix("0X")).unwrap_or(text);
    let digits: Vec<u32> =
        text.chars().filter(|c| !c.is_whitespace()).map(|c| c.to_digit(16)).collect::<Option<_>>()?;
    digits
        .len()
        .is_multiple_of(2)
        .then(|| digits.chunks(2).map(|pair| (pair[0] * 16 + pair[1]) as u8).collect())
}

/// A value as a DCF has it: integers and booleans decimal or hexadecimal, reals decimal, strings as text, the rest
/// as pairs of hexadecimal digits. `None` if the bytes are no value of the type, or text that one line cannot hold.
pub fn format(data_type: DataType, bytes: &[u8]) -> Option<String> {
    let text = match data_type {
        DataType::VisibleString => String::from_utf8(bytes.to_vec()).ok()?,
        DataType::UnicodeString => {
            let units: Vec<u16> = bytes.chunks(2).map(|pair| super::unsigned_of(pair) as u16).collect();
            String::from_utf16(&units).ok()?
        }
        DataType::TimeOfDay | DataType::TimeDifference if bytes.len() == 6 => {
            return Some(format!("0x{:012X}", super::unsigned_of(bytes)));
        }
        _ => {
            return Some(match data_type.number(bytes) {
                // A real whose decimal form would not be read back as the same bits goes as bits.
                Some(Number::Real(value)) if value.is_finite() => format!("{value:?}"),
                Some(Number::Real(_)) => format!("0x{:X}", super::unsigned_of(bytes)),
                Some(Number::Int(value)) if data_type.is_unsigned() && value > 9 => {
                    format!("0x{value:0width$X}", width = 2 * bytes.len())
                }
                Some(Number::Int(value)) => value.to_string(),
                None if data_type.size().is_some() => return None,
                None => hex_digits(bytes),
            });
        }
    };
    let whole = text == text.trim() && !text.contains(['\n', '\r', '\0']);
    whole.then_some(text)
}

fn hex_digits(bytes: &[u8]) -> String {
    use std::fmt::Write;
    bytes.iter().fold(String::with_capacity(2 * bytes.len()), |mut text, byte| {
        let _ = write!(text, "{byte:02X}");
        text
    })
}

/// Text that says why a write of `bytes` to `entry` is not possible, if so.
pub(super) fn fault(entry: &Entry, bytes: &[u8]) -> Option<String> {
    match entry.data_type.size() {
        Some(size) if size != bytes.len() => {
            Some(format!("{} bytes are no {}, which has {size}", bytes.len(), entry.data_type))
        }
        _ => None,
    }
}
