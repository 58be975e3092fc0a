//! Variables by name: where they lie, their values as text and JSON, and patches that set them.

use dinrail_iec::artifact::{AreaKind, DebugMap, ElemType, Storage, Symbol};
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
    let (name, indices) = split_indices(path)?;
    let unknown = || VarError::Unknown { path: path.to_owned(), hint: nearest(map, name) };
    let symbol = map.and_then(|map| find(map, name)).ok_or_else(unknown)?;
    element(symbol, path, &indices)
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
    let Some((name, rest)) = path.split_once('[') else { return Ok((path, Vec::new())) };
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
    let Some(map) = map else { return "; there is no program, only %-addresses".to_owned() };
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
                let x = number(value).ok_or_else(|| error("a number"))? as f32;
                u64::from(x.to_bits())
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
            let upper = s.trim().to_ascii_uppercase();
            let body = upper.strip_prefix("T#").or_else(|| upper.strip_prefix("TIME#")).unwrap_or(&upper);
            body.to_ascii_lowercase().parse::<ipc_types::units::Span>().ok().map(|span| span.ns() as i64)
        }
        _ => None,
    }
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
