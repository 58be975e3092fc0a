//! Two memories, and which variables differ between them.

use crate::engine::Engine;
use crate::engine::value::{Cell, name_of};
use dinrail_iec::artifact::{Storage, Symbol};
use serde::Serialize;

/// A variable with two values.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct VarDiff {
    pub variable: String,
    pub expected: String,
    pub got: String,
}

/// The first variables that differ from `from` on, where `known` allows a judgement.
pub(super) fn differences(
    engine: &Engine,
    expected: &[u8],
    got: &[u8],
    from: u32,
    known: impl Fn(u32) -> bool,
    max: usize,
) -> Vec<VarDiff> {
    let mut rows: Vec<VarDiff> = Vec::new();
    for (at, (a, b)) in expected.iter().zip(got).enumerate().skip(from as usize) {
        let at = at as u32;
        if a == b || !known(at) {
            continue;
        }
        let row = name_difference(engine, at, expected, got);
        if !rows.iter().any(|r| r.variable == row.variable) {
            rows.push(row);
            if rows.len() == max {
                break;
            }
        }
    }
    rows
}

fn name_difference(engine: &Engine, at: u32, expected: &[u8], got: &[u8]) -> VarDiff {
    let row = |variable: String, cell: &Cell| VarDiff {
        variable,
        expected: cell.text(expected),
        got: cell.text(got),
    };
    // Several variables may lie at one byte (AT): the one that shows the difference.
    for symbol in engine.map().map_or(&[][..], |m| &m.symbols) {
        if let Storage::Bit(_) = symbol.storage
            && symbol.offset == at
        {
            let cell = Cell { offset: at, elem: symbol.elem, storage: symbol.storage };
            if cell.text(expected) != cell.text(got) {
                return row(symbol.path.clone(), &cell);
            }
        }
    }
    let (name, cell) = name_of(engine.map(), engine.image(), at);
    if matches!(cell.storage, Storage::Bit(_)) && cell.text(expected) == cell.text(got) {
        let (name, cell) = name_of(None, engine.image(), at);
        return row(name, &cell);
    }
    row(name, &cell)
}

fn alike(a: &Symbol, b: &Symbol) -> bool {
    a.path.eq_ignore_ascii_case(&b.path) && a.elem == b.elem && a.dims == b.dims && a.storage == b.storage
}

/// Symbols that both programs have: (symbol here, offset there).
pub(crate) fn common<'a>(a: &'a Engine, b: &'a Engine) -> Vec<(&'a Symbol, u32)> {
    let (Some(map_a), Some(map_b)) = (a.map(), b.map()) else { return Vec::new() };
    let by_path: std::collections::HashMap<String, &Symbol> =
        map_b.symbols.iter().map(|s| (s.path.to_ascii_lowercase(), s)).collect();
    map_a
        .symbols
        .iter()
        .filter_map(|s| {
            by_path.get(&s.path.to_ascii_lowercase()).filter(|o| alike(s, o)).map(|o| (s, o.offset))
        })
        .collect()
}

/// Bytes of a symbol.
pub(crate) fn bytes_of(symbol: &Symbol) -> usize {
    let step = match symbol.storage {
        Storage::Plain => symbol.elem.bytes(),
        Storage::Bit(_) => 1,
        Storage::Millis32 => 4,
    };
    (u64::from(step) * symbol.elements()) as usize
}

/// Image and common variables of two engines that did the same scan: outputs first.
pub(super) fn between(a: &Engine, b: &Engine, max: usize) -> Vec<VarDiff> {
    let (memory_a, memory_b) = (a.memory(), b.memory());
    let mut rows = Vec::new();
    let end = (a.image().marker.offset + a.image().marker.bytes) as usize;
    if memory_a[a.image().input.offset as usize..end] != memory_b[b.image().input.offset as usize..end] {
        rows = differences(a, &memory_a[..end], &memory_b[..end], a.image().input.offset, |_| true, max);
    }
    if a.same_layout(b) {
        let (from, to) = (end as u32, a.state_end() as usize);
        if rows.len() < max && memory_a[end..to] != memory_b[end..to] {
            let left = max - rows.len();
            rows.append(&mut differences(a, &memory_a[..to], &memory_b[..to], from, |_| true, left));
        }
        return rows;
    }
    for (symbol, offset) in common(a, b) {
        let len = bytes_of(symbol);
        let here = memory_a.get(symbol.offset as usize..symbol.offset as usize + len);
        let there = memory_b.get(offset as usize..offset as usize + len);
        let (Some(here), Some(there)) = (here, there) else { continue };
        if here == there || rows.len() == max || (symbol.offset as usize) < end {
            continue;
        }
        let at = here.iter().zip(there).position(|(x, y)| x != y).unwrap_or(0) as u32;
        let (name, cell) = name_of(a.map(), a.image(), symbol.offset + at);
        let other = Cell { offset: cell.offset - symbol.offset + offset, ..cell };
        rows.push(VarDiff { variable: name, expected: cell.text(memory_a), got: other.text(memory_b) });
    }
    rows
}
