//! Ranges that the gateway polls by itself, so that masters who read them wait for no line.
//!
//! A read that lies wholly in a cached range is answered from it while it is younger than its `max_age`; anything
//! else goes to the unit. A write to the unit takes its ranges out of the cache until they were read again after it.

use crate::client::image::read_request;
use crate::protocol::pdu::{EXCEPTION_BIT, bytes_for_bits};
use crate::server::Table;

/// A polled range.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CacheRange {
    pub line: usize,
    /// On the line.
    pub unit: u8,
    pub table: Table,
    pub at: u16,
    pub count: u16,
    pub period_ns: u64,
    pub max_age_ns: u64,
}

struct Entry {
    range: CacheRange,
    slot: Option<usize>,
    data: Vec<u8>,
    /// When it was read; `None`: not usable.
    read_ns: Option<u64>,
    /// Writes to the unit that are under way.
    writes: u32,
}

/// See the module.
#[derive(Default)]
pub struct Cache {
    entries: Vec<Entry>,
}

impl Cache {
    pub fn new(ranges: &[CacheRange]) -> Self {
        let entry = |range: &CacheRange| {
            let count = usize::from(range.count);
            let len = if range.table.is_bits() { count.div_ceil(8) } else { count * 2 };
            Entry { range: range.clone(), slot: None, data: vec![0; len], read_ns: None, writes: 0 }
        };
        Self { entries: ranges.iter().map(entry).collect() }
    }

    /// Puts the polls into the schedules of their lines: line, unit, request, period.
    pub fn add_slots(&mut self, mut add: impl FnMut(usize, u8, &[u8], u64) -> Option<usize>) {
        for entry in &mut self.entries {
            let CacheRange { line, unit, table, at, count, period_ns, .. } = entry.range;
            entry.slot = add(line, unit, &read_request(table, at, count), period_ns);
        }
    }

    /// A poll has ended: answer PDU or nothing.
    pub fn polled(&mut self, line: usize, slot: usize, answer: Option<&[u8]>, now_ns: u64) {
        let entry = self.entries.iter_mut().find(|e| e.range.line == line && e.slot == Some(slot));
        let Some(entry) = entry else { return };
        // One request is in flight at a time: a poll that began before a write ended ends before it.
        let good = answer
            .filter(|a| a[0] & EXCEPTION_BIT == 0 && a.len() == entry.data.len() + 2 && entry.writes == 0);
        match good {
            Some(answer) => {
                entry.data.copy_from_slice(&answer[2..]);
                entry.read_ns = Some(now_ns);
            }
            None => entry.read_ns = None,
        }
    }

    /// A write to the unit waits or is under way.
    pub fn write_begins(&mut self, line: usize, unit: u8) {
        for entry in self.of(line, unit) {
            entry.writes += 1;
            entry.read_ns = None;
        }
    }

    /// ... and has ended, however.
    pub fn write_ends(&mut self, line: usize, unit: u8) {
        for entry in self.of(line, unit) {
            entry.writes = entry.writes.saturating_sub(1);
        }
    }

    /// Ranges of a unit; all of the line for a broadcast.
    fn of(&mut self, line: usize, unit: u8) -> impl Iterator<Item = &mut Entry> {
        let is = move |e: &&mut Entry| e.range.line == line && (e.range.unit == unit || unit == 0);
        self.entries.iter_mut().filter(is)
    }

    /// Writes the answer to a read into `out` if the cache has it; its length.
    pub fn answer(&self, line: usize, unit: u8, pdu: &[u8], now_ns: u64, out: &mut [u8]) -> Option<usize> {
        let &[function, a1, a0, q1, q0] = pdu else { return None };
        if self.entries.is_empty() || !(1..=4).contains(&function) {
            return None;
        }
        let (at, quantity) = (u16::from_be_bytes([a1, a0]), u16::from_be_bytes([q1, q0]));
        let bits = function <= 2;
        if quantity == 0 || quantity > if bits { 2000 } else { 125 } {
            return None;
        }
        let table = match function {
            1 => Table::Coils,
            2 => Table::DiscreteInputs,
            3 => Table::HoldingRegisters,
            _ => Table::InputRegisters,
        };
        let entry = self.entries.iter().find(|e| {
            let r = &e.range;
            (r.line, r.unit, r.table) == (line, unit, table)
                && r.at <= at
                && u32::from(at) + u32::from(quantity) <= u32::from(r.at) + u32::from(r.count)
                && e.read_ns.is_some_and(|read_ns| now_ns.saturating_sub(read_ns) <= r.max_age_ns)
        })?;
        let skip = usize::from(at - entry.range.at);
        let count = usize::from(quantity);
        let len = if bits { bytes_for_bits(quantity) } else { count * 2 };
        let body = out.get_mut(..len + 2)?;
        body[0] = function;
        body[1] = len as u8;
        if bits {
            body[2..].fill(0);
            for i in 0..count {
                body[2 + i / 8] |= (entry.data[(skip + i) / 8] >> ((skip + i) % 8) & 1) << (i % 8);
            }
        } else {
            body[2..].copy_from_slice(&entry.data[skip * 2..skip * 2 + len]);
        }
        Some(len + 2)
    }
}
