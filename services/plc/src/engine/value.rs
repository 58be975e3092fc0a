//! Variables by name: where they lie, their values as text and JSON, and patches that set them.

use crate::setup::External;
use dinrail_iec::artifact::{AreaKind, DebugMap, ElemType, Storage, Symbol};
use dinrail_iec::types::elementary;
use dinrail_iec::{AddressSize, Addressing, parse_address};
use ipc_types::scan_record::Patch;
use serde_json::Value as Json;

/// One elementary value in memory.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Cell {
    pub offset: u32,
    pub elem: ElemType,
    pub storage: Storage,
}

/// Why a variable cannot be read or set.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum VarError {
    #[error("no variable '{path}'{hint}")]
    Unknown { path: String, hint: String },
    #[error("'{path}' is an array {bounds}: write an element, like {path}[{first}]")]
    Array { path: String, bounds: String, first: i64 },
    #[error("'{path}': index {index} lies outside {bounds}")]
    Index { path: String, index: i64, bounds: String },
    #[error("{0}")]
    Percent(String),
    #[error("'{path}': {message}")]
    Address { path: String, message: String },
    #[error("'{path}' is {type_name}; {value} does not fit: give {expect}")]
    Value { path: String, type_name: &'static str, value: String, expect: &'static str },
}

/// Offsets of the image in memory.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct Image {
    pub input: dinrail_iec::artifact::Area,
    pub output: dinrail_iec::artifact::Area,
    pub marker: dinrail_iec::artifact::Area,
}

impl Image {
    /// Offset in memory of `bytes` bytes from `byte` on; `None` outside the area.
    pub fn place(&self, area: AreaKind, byte: u32, bytes: u32) -> Option<u32> {
        let area = match area {
            AreaKind::Input => self.input,
            AreaKind::Output => self.output,
            AreaKind::Marker => self.marker,
            AreaKind::Retain | AreaKind::Data => return None,
        };
        (byte.checked_add(bytes)? <= area.bytes).then_some(area.offset + byte)
    }
}

/// Finds `%QX0.3`, `prg.speed`, `speed` (when it is the only one) or `prg.table[3]`.
pub fn resolve(
    map: Option<&DebugMap>,
    image: &Image,
    addressing: Addressing,
    path: &str,
) -> Result<Cell, VarError> {
    let path = path.trim();
    if path.starts_with('%') {
        return located(image, addressing, path);
    }
    // Members of structures in arrays have an index within their name.
    let whole = map.and_then(|map| find(map, path));
    let (name, indices) = if whole.is_some() { (path, Vec::new()) } else { split_indices(path)? };
    let unknown = || VarError::Unknown { path: path.to_owned(), hint: nearest(map, name) };
    let symbol = map.and_then(|map| find(map, name)).ok_or_else(unknown)?;
    element(symbol, path, &indices)
}

/// A symbol of the stack file, for an engine whose program does not have it.
pub fn of_stack(externals: &[External], image: &Image, addressing: Addressing, path: &str) -> Option<Cell> {
    let path = path.trim();
    let external = externals.iter().find(|e| e.name.eq_ignore_ascii_case(path))?;
    let elem = elementary(&external.type_name)?;
    let place = located(image, addressing, &external.address).ok()?;
    let storage = match place.storage {
        Storage::Plain if elem == ElemType::Time && place.bytes() == 4 => Storage::Millis32,
        storage => storage,
    };
    let cell = Cell { elem, storage, ..place };
    (cell.bytes() == place.bytes()).then_some(cell)
}

/// The symbol of this path; of several with this ending, the one of a program instance.
pub fn find<'a>(map: &'a DebugMap, name: &str) -> Option<&'a Symbol> {
    if let Some(found) = map.symbol(name) {
        return Some(found);
    }
    let mut owned = map.tasks.iter().flat_map(|task| &task.programs).filter_map(|program| {
        let path = format!("{program}.{name}");
        map.symbols.iter().find(|s| s.path.eq_ignore_ascii_case(&path))
    });
    let first = owned.next()?;
    owned.next().is_none().then_some(first)
}

fn located(image: &Image, addressing: Addressing, path: &str) -> Result<Cell, VarError> {
    let error = |message: String| VarError::Address { path: path.to_owned(), message };
    let address = parse_address(path, addressing).map_err(|e| VarError::Percent(e.to_string()))?;
    let offset = image
        .place(address.area, address.byte, address.size.bytes())
        .ok_or_else(|| error("this place is beyond the end of its area".to_owned()))?;
    let elem = match address.size {
        AddressSize::Bit => ElemType::Bool,
        AddressSize::Byte => ElemType::Usint,
        AddressSize::Word => ElemType::Uint,
        AddressSize::Dword => ElemType::Udint,
        AddressSize::Lword => ElemType::Ulint,
    };
    let storage = address.bit.map_or(Storage::Plain, Storage::Bit);
    Ok(Cell { offset, elem, storage })
}

fn split_indices(path: &str) -> Result<(&str, Vec<i64>), VarError> {
    let Some((name, rest)) = path.rsplit_once('[') else { return Ok((path, Vec::new())) };
    if rest.contains("].") {
        return Ok((path, Vec::new()));
    }
    let bad = || VarError::Address {
        path: path.to_owned(),
        message: "write an index like [3] or [1,2]".to_owned(),
    };
    let inner = rest.strip_suffix(']').ok_or_else(bad)?;
    let indices: Result<Vec<i64>, _> = inner.split(',').map(|i| i.trim().parse::<i64>()).collect();
    Ok((name, indices.map_err(|_| bad())?))
}

fn bounds_text(symbol: &Symbol) -> String {
    let dims: Vec<String> = symbol.dims.iter().map(|(lo, hi)| format!("{lo}..{hi}")).collect();
    format!("[{}]", dims.join(", "))
}

fn element(symbol: &Symbol, path: &str, indices: &[i64]) -> Result<Cell, VarError> {
    let bounds = || bounds_text(symbol);
    if indices.len() != symbol.dims.len() {
        if symbol.dims.is_empty() {
            let message = "is no array".to_owned();
            return Err(VarError::Address { path: path.to_owned(), message });
        }
        let first = symbol.dims.first().map_or(0, |d| d.0);
        return Err(VarError::Array { path: symbol.path.clone(), bounds: bounds(), first });
    }
    let mut at: i64 = 0;
    for (index, (lo, hi)) in indices.iter().zip(&symbol.dims) {
        if index < lo || index > hi {
            return Err(VarError::Index { path: symbol.path.clone(), index: *index, bounds: bounds() });
        }
        at = at * (hi - lo + 1) + (index - lo);
    }
    let offset = symbol.offset + at as u32 * symbol.elem.bytes();
    Ok(Cell { offset, elem: symbol.elem, storage: symbol.storage })
}

fn nearest(map: Option<&DebugMap>, name: &str) -> String {
    let Some(map) = map else {
        return "; there is no program, only %-addresses and the symbols of the stack file".to_owned();
    };
    let wanted = name.to_ascii_lowercase();
    let tail = wanted.rsplit('.').next().unwrap_or(&wanted).to_owned();
    let several: Vec<&str> = map
        .symbols
        .iter()
        .filter(|s| s.path.rsplit('.').next().is_some_and(|last| last.eq_ignore_ascii_case(&tail)))
        .map(|s| s.path.as_str())
        .take(4)
        .collect();
    if several.is_empty() { String::new() } else { format!("; did you mean {}?", several.join(" or ")) }
}

impl Cell {
    /// Bytes in memory.
    pub fn bytes(&self) -> u32 {
        match self.storage {
            Storage::Plain => self.elem.bytes(),
            Storage::Bit(_) => 1,
            Storage::Millis32 => 4,
        }
    }

    fn raw(&self, memory: &[u8]) -> Option<u64> {
        let start = self.offset as usize;
        let bytes = memory.get(start..start + self.bytes() as usize)?;
        let mut all = [0u8; 8];
        all[..bytes.len()].copy_from_slice(bytes);
        Some(u64::from_le_bytes(all))
    }

    /// Value as JSON: BOOL true/false, numbers, TIME in milliseconds. REALs that JSON lacks are text.
    pub fn json(&self, memory: &[u8]) -> Json {
        let Some(raw) = self.raw(memory) else { return Json::Null };
        let real =
            |x: f64| serde_json::Number::from_f64(x).map_or_else(|| Json::from(format!("{x}")), Json::Number);
        match (self.storage, self.elem) {
            (Storage::Bit(bit), _) => Json::from(raw >> bit & 1 == 1),
            (Storage::Millis32, _) => Json::from(raw as i32),
            (_, ElemType::Bool) => Json::from(raw != 0),
            (_, ElemType::Sint) => Json::from(raw as i8),
            (_, ElemType::Int) => Json::from(raw as i16),
            (_, ElemType::Dint) => Json::from(raw as i32),
            (_, ElemType::Lint) => Json::from(raw as i64),
            // The shortest text that gives the REAL again, not its LREAL expansion.
            (_, ElemType::Real) => {
                let x = f32::from_bits(raw as u32);
                real(x.to_string().parse().unwrap_or(f64::from(x)))
            }
            (_, ElemType::Lreal) => real(f64::from_bits(raw)),
            (_, ElemType::Time) => {
                let ns = raw as i64;
                if ns % 1_000_000 == 0 { Json::from(ns / 1_000_000) } else { real(ns as f64 / 1e6) }
            }
            _ => Json::from(raw),
        }
    }

    /// Value as the user of an IEC program reads it.
    pub fn text(&self, memory: &[u8]) -> String {
        match (self.elem, self.json(memory)) {
            (ElemType::Bool, Json::Bool(b)) => if b { "TRUE" } else { "FALSE" }.to_owned(),
            (ElemType::Time, value) => format!("T#{value}ms"),
            (_, Json::String(text)) => text,
            (_, value) => value.to_string(),
        }
    }

    /// The patch that gives the variable this value. TIME: milliseconds, or text like `"1.5s"`.
    pub fn patch(&self, path: &str, value: &Json) -> Result<Patch, VarError> {
        let error = |expect: &'static str| VarError::Value {
            path: path.to_owned(),
            type_name: self.elem.name(),
            value: value.to_string(),
            expect,
        };
        let len = self.bytes();
        let mut mask = [0u8; 8];
        mask[..len as usize].fill(0xFF);
        let raw: u64 = match self.elem {
            ElemType::Bool => {
                let on = boolean(value).ok_or_else(|| error("true or false"))?;
                if let Storage::Bit(bit) = self.storage {
                    mask[0] = 1 << bit;
                    u64::from(on) << bit
                } else {
                    u64::from(on)
                }
            }
            ElemType::Real => {
                let x = number(value).ok_or_else(|| error("a number"))?;
                if x.is_finite() && (x as f32).is_infinite() {
                    return Err(error("a number up to 3.4e38"));
                }
                u64::from((x as f32).to_bits())
            }
            ElemType::Lreal => number(value).ok_or_else(|| error("a number"))?.to_bits(),
            ElemType::Time => {
                let ns = time_ns(value).ok_or_else(|| error("milliseconds or a text like \"1.5s\""))?;
                if self.storage == Storage::Millis32 {
                    i32::try_from(ns / 1_000_000).map_err(|_| error("a time of at most 24 days"))? as u32
                        as u64
                } else {
                    ns as u64
                }
            }
            _ => integer(value, self.elem).ok_or_else(|| error("a whole number in its range"))?,
        };
        Ok(Patch { offset: self.offset, len: len as u8, mask, value: raw.to_le_bytes() })
    }
}

fn boolean(value: &Json) -> Option<bool> {
    match value {
        Json::Bool(b) => Some(*b),
        Json::Number(n) => match n.as_i64() {
            Some(0) => Some(false),
            Some(1) => Some(true),
            _ => None,
        },
        Json::String(s) => match s.to_ascii_uppercase().as_str() {
            "TRUE" | "1" => Some(true),
            "FALSE" | "0" => Some(false),
            _ => None,
        },
        _ => None,
    }
}

fn number(value: &Json) -> Option<f64> {
    match value {
        Json::Number(n) => n.as_f64(),
        Json::String(s) => s.trim().parse().ok(),
        _ => None,
    }
}

fn whole(value: &Json) -> Option<i128> {
    match value {
        Json::Number(n) => n.as_i64().map(i128::from).or_else(|| n.as_u64().map(i128::from)),
        Json::String(s) => {
            let s = s.trim();
            match s.split_once('#') {
                Some(("16", hex)) => i128::from_str_radix(hex, 16).ok(),
                Some(("2", bits)) => i128::from_str_radix(bits, 2).ok(),
                Some(_) => None,
                None => s.parse().ok(),
            }
        }
        _ => None,
    }
}

fn integer(value: &Json, elem: ElemType) -> Option<u64> {
    let n = whole(value)?;
    let bits = elem.bytes() * 8;
    let signed = matches!(elem, ElemType::Sint | ElemType::Int | ElemType::Dint | ElemType::Lint);
    let (lo, hi) =
        if signed { (-(1i128 << (bits - 1)), (1i128 << (bits - 1)) - 1) } else { (0, (1i128 << bits) - 1) };
    (lo <= n && n <= hi).then_some(n as u64)
}

fn time_ns(value: &Json) -> Option<i64> {
    match value {
        Json::Number(n) => {
            let ms = n.as_f64()?;
            (ms.abs() < 9e12).then_some((ms * 1e6).round() as i64)
        }
        Json::String(s) => {
            let lower = s.trim().to_ascii_lowercase();
            let body = ["t#", "time#", "lt#", "ltime#"].iter().find_map(|p| lower.strip_prefix(p));
            let body = body.unwrap_or(&lower);
            let span = || body.parse::<ipc_types::units::Span>().ok().map(|span| span.ns() as i64);
            literal_ns(body).or_else(span)
        }
        _ => None,
    }
}

/// `1h30m`, `-2.5s`, `1s500ms`: the parts of a duration literal, in falling units.
fn literal_ns(text: &str) -> Option<i64> {
    const UNITS: [(&str, f64); 7] =
        [("d", 86400e9), ("h", 3600e9), ("m", 60e9), ("s", 1e9), ("ms", 1e6), ("us", 1e3), ("ns", 1.0)];
    let text = text.replace('_', "");
    let (sign, mut rest) = text.strip_prefix('-').map_or((1.0, text.as_str()), |rest| (-1.0, rest));
    let (mut sum, mut next) = (0.0, 0);
    while !rest.is_empty() {
        let end = rest.find(|c: char| !(c.is_ascii_digit() || c == '.'))?;
        let number: f64 = rest[..end].parse().ok()?;
        rest = &rest[end..];
        let end = rest.find(|c: char| !c.is_ascii_alphabetic()).unwrap_or(rest.len());
        let at = UNITS.iter().position(|(unit, _)| *unit == &rest[..end]).filter(|at| *at >= next)?;
        (sum, next, rest) = (sum + number * UNITS[at].1, at + 1, &rest[end..]);
    }
    (next > 0 && sum < 9e18).then_some((sign * sum).round() as i64)
}

/// Milliseconds as a duration literal: `T#500ms`, `T#2m3.25s`, `T#1d`.
pub fn time_text(ms: f64) -> String {
    let sign = if ms < 0.0 { "-" } else { "" };
    let ns = (ms.abs() * 1e6).round() as u64;
    let fraction = |ns: u64, unit: u64| {
        let text = format!("{}.{:09}", ns / unit, ns % unit * (1_000_000_000 / unit));
        text.trim_end_matches('0').trim_end_matches('.').to_owned()
    };
    let mut text = format!("T#{sign}");
    if ns < 1_000_000_000 {
        return text + &fraction(ns, 1_000_000) + "ms";
    }
    let mut left = ns;
    for (unit, name) in [(86_400_000_000_000, "d"), (3_600_000_000_000, "h"), (60_000_000_000, "m")] {
        if left >= unit {
            text += &format!("{}{name}", left / unit);
            left %= unit;
        }
    }
    if left > 0 {
        text += &(fraction(left, 1_000_000_000) + "s");
    }
    text
}

/// Name and cell of what lies at this byte: `prg.a[3]`, else `%IB5`, else `DATA+12`.
pub fn name_of(map: Option<&DebugMap>, image: &Image, offset: u32) -> (String, Cell) {
    let plain = Cell { offset, elem: ElemType::Usint, storage: Storage::Plain };
    if let Some(map) = map {
        for symbol in &map.symbols {
            let step = match symbol.storage {
                Storage::Plain => symbol.elem.bytes(),
                Storage::Bit(_) => 1,
                Storage::Millis32 => 4,
            };
            let bytes = u64::from(step) * symbol.elements();
            if offset < symbol.offset || u64::from(offset - symbol.offset) >= bytes {
                continue;
            }
            let at = (offset - symbol.offset) / step;
            let cell = Cell { offset: symbol.offset + at * step, elem: symbol.elem, storage: symbol.storage };
            return (format!("{}{}", symbol.path, index_text(symbol, i64::from(at))), cell);
        }
    }
    for (letter, area) in [('I', image.input), ('Q', image.output), ('M', image.marker)] {
        if offset >= area.offset && offset < area.offset + area.bytes {
            return (format!("%{letter}B{}", offset - area.offset), plain);
        }
    }
    if offset < dinrail_iec::artifact::sys::BYTES {
        return ("the scan's stamp".to_owned(), plain);
    }
    (format!("memory byte {offset}"), plain)
}

fn index_text(symbol: &Symbol, at: i64) -> String {
    if symbol.dims.is_empty() {
        return String::new();
    }
    let mut rest = at;
    let mut indices = vec![0i64; symbol.dims.len()];
    for (place, (lo, hi)) in indices.iter_mut().zip(&symbol.dims).rev() {
        let count = (hi - lo + 1).max(1);
        *place = lo + rest % count;
        rest /= count;
    }
    let texts: Vec<String> = indices.iter().map(i64::to_string).collect();
    format!("[{}]", texts.join(","))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn durations_are_written_and_read_as_the_language_has_them() {
        for (ms, text) in [
            (0.0, "T#0ms"),
            (500.0, "T#500ms"),
            (0.0015, "T#0.0015ms"),
            (1500.0, "T#1.5s"),
            (60_000.0, "T#1m"),
            (123_250.0, "T#2m3.25s"),
            (90_061_000.0, "T#1d1h1m1s"),
            (-250.0, "T#-250ms"),
        ] {
            assert_eq!(time_text(ms), text);
            assert_eq!(time_ns(&Json::from(text)), Some((ms * 1e6_f64).round() as i64), "{text}");
        }
        for (text, ns) in [
            ("1.5s", Some(1_500_000_000)),
            ("TIME#1s_500ms", Some(1_500_000_000)),
            ("LT#2us", Some(2000)),
            ("5min", Some(300_000_000_000)),
            ("T#1ms1s", None),
            ("T#", None),
            ("soon", None),
            ("T#1", None),
        ] {
            assert_eq!(time_ns(&Json::from(text)), ns, "{text}");
        }
    }

    #[test]
    fn symbols_of_the_stack_file_are_known_without_a_program() {
        let setup = crate::setup::Setup::default();
        let external = |name: &str, address: &str, type_name: &str| External {
            name: name.to_owned(),
            address: address.to_owned(),
            type_name: type_name.to_owned(),
            origin: String::new(),
        };
        let externals = [
            external("Level", "%ID1", "REAL"),
            external("Pump", "%QX0.3", "BOOL"),
            external("Delay", "%MD2", "TIME"),
            external("Odd", "%QB1", "REAL"),
        ];
        let image = setup.plain_image();
        let found = |name: &str| of_stack(&externals, &image, Addressing::Element, name);
        let level = found("level").unwrap();
        assert_eq!((level.offset - image.input.offset, level.elem), (4, ElemType::Real));
        assert_eq!(found("Pump").unwrap().storage, Storage::Bit(3));
        assert_eq!(found("Delay").unwrap().storage, Storage::Millis32);
        assert_eq!((found("Odd"), found("Nothing")), (None, None));
    }

    proptest! {
        #[test]
        fn any_time_is_read_as_it_was_written(ms in -1e9_f64..1e9) {
            let ns = (ms * 1e6).round();
            prop_assert_eq!(time_ns(&Json::from(time_text(ns / 1e6))), Some(ns as i64));
        }
        #[test]
        fn no_text_is_too_odd(text in "\\PC{0,30}") {
            let _ = time_ns(&Json::from(text));
        }
    }
}
