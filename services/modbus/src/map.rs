//! The register map: which bits and bytes of the process image the four Modbus tables show.
//!
//! A map is, per table, a sorted list of ranges. It knows nothing of freshness, queues or the rail: it reads
//! from byte slices and turns writes into a [`WriteSet`]. Registers are 16-bit values: the word at %MW0, whose
//! bytes lie low byte first in memory, goes out high byte first as the protocol asks.

use crate::map_config::{MapEntry, MapError, Preset};
use crate::protocol::pdu::Exception;
use crate::server::{Access, Table, Write};
use crate::write_set::WriteSet;
use dinrail_iec::Addressing;
use ipc_types::wiring::{Area, AreaSizes};

/// A run of entries of one table that lie in one area.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Range {
    /// First entry, 0-based.
    pub at: u32,
    /// Number of entries.
    pub count: u32,
    pub area: Area,
    /// Place of the first entry: a bit number in bit tables, a byte offset in word tables.
    pub base: u32,
    /// Registers of one value: 1, 2 (32 bits) or 4 (64 bits).
    pub group: u32,
    /// Whether the high word of a value comes first.
    pub high_first: bool,
    /// Whether the two bytes of each register are exchanged.
    pub swap_bytes: bool,
    /// Whether the server owns these bytes of %I.
    pub own: bool,
    /// Whether clients may not write it whatever it shows.
    pub read_only: bool,
}

impl Range {
    fn end(&self) -> u32 {
        self.at + self.count
    }

    /// Word of the range that register `k` shows, and back: the exchange is its own inverse.
    fn word(&self, k: u32) -> u32 {
        if self.high_first { k - k % self.group + (self.group - 1 - k % self.group) } else { k }
    }

    pub(crate) fn writable(&self) -> bool {
        self.own || (self.area != Area::Input && !self.read_only)
    }
}

/// The bytes a map reads. What lies beyond a slice reads as zero.
#[derive(Clone, Copy, Debug, Default)]
pub struct Memory<'a> {
    /// %I as the PLC has it.
    pub input: &'a [u8],
    /// %Q
    pub output: &'a [u8],
    /// %M
    pub marker: &'a [u8],
    /// %I as the server itself last wrote it, for the ranges it owns.
    pub own_input: &'a [u8],
}

impl<'a> Memory<'a> {
    /// An area as the PLC has it.
    pub fn area(&self, area: Area) -> &'a [u8] {
        match area {
            Area::Input => self.input,
            Area::Output => self.output,
            Area::Marker => self.marker,
        }
    }

    fn of(&self, range: &Range) -> &'a [u8] {
        match range.area {
            Area::Input if range.own => self.own_input,
            area => self.area(area),
        }
    }
}

/// A register map, checked against the sizes of the areas.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RegisterMap {
    tables: [Vec<Range>; 4],
    sizes: AreaSizes,
}

impl RegisterMap {
    /// One of the two ready maps, clipped to the sizes of the areas.
    pub fn preset(preset: Preset, sizes: AreaSizes, addressing: Addressing) -> Self {
        crate::map_config::preset(preset, sizes, addressing)
    }

    /// A map from tables of the stack file.
    pub fn from_entries(
        entries: &[MapEntry],
        sizes: AreaSizes,
        addressing: Addressing,
    ) -> Result<Self, MapError> {
        crate::map_config::from_entries(entries, sizes, addressing)
    }

    pub(crate) fn from_ranges(tables: [Vec<Range>; 4], sizes: AreaSizes) -> Self {
        Self { tables, sizes }
    }

    /// Sizes of the areas that entries must lie in.
    pub fn sizes(&self) -> AreaSizes {
        self.sizes
    }

    /// Tells the map how large the PLC's areas really are; entries beyond get exception 02.
    pub fn set_sizes(&mut self, sizes: AreaSizes) {
        self.sizes = sizes;
    }

    /// Entries of a range that lie within its area.
    pub(crate) fn entries_inside(&self, table: Table, range: &Range) -> u32 {
        let size = self.sizes.of(range.area);
        if table.is_bits() {
            (size * 8).saturating_sub(range.base).min(range.count)
        } else {
            (size.saturating_sub(range.base) / 2).min(range.count) / range.group * range.group
        }
    }

    pub(crate) fn ranges(&self, table: Table) -> &[Range] {
        &self.tables[table as usize]
    }

    /// The ranges of %I that the server owns: byte offset and length, sorted, neighbours joined.
    pub fn own_inputs(&self) -> Vec<(u32, u32)> {
        let mut owned: Vec<(u32, u32)> = Table::ALL
            .iter()
            .flat_map(|&table| self.ranges(table).iter().map(move |range| (table, range)))
            .filter(|(_, range)| range.own)
            .map(|(table, range)| byte_span(table, range))
            .collect();
        owned.sort_unstable();
        let mut joined: Vec<(u32, u32)> = Vec::new();
        for (start, end) in owned {
            match joined.last_mut() {
                Some(last) if start <= last.1 => last.1 = last.1.max(end),
                _ => joined.push((start, end)),
            }
        }
        joined.iter().map(|&(start, end)| (start, end - start)).collect()
    }

    /// Splits `[address, address + quantity)` at the borders of ranges and calls `each` with a range, the first
    /// entry in it, and the number of entries. Exception 02 at the first entry that no range has.
    fn parts<'s>(
        &'s self,
        table: Table,
        address: u16,
        quantity: u32,
        mut each: impl FnMut(&'s Range, u32, u32) -> Result<(), Exception>,
    ) -> Result<(), Exception> {
        let ranges = self.ranges(table);
        let mut at = u32::from(address);
        let end = at + quantity;
        let mut i = ranges.partition_point(|range| range.end() <= at);
        while at < end {
            let range = ranges.get(i).filter(|range| range.at <= at).ok_or(Exception::IllegalDataAddress)?;
            let n = end.min(range.end()) - at;
            each(range, at - range.at, n)?;
            at += n;
            i += 1;
        }
        Ok(())
    }

    /// Whether all entries exist and lie within the areas, and for a write, whether all may be written and go to one destination: a
    /// request that crosses from %Q or %M into %I owned by the server could not be applied whole.
    pub fn check(&self, access: Access, table: Table, address: u16, quantity: u16) -> Result<(), Exception> {
        let mut own = None;
        self.parts(table, address, u32::from(quantity), |range, first, n| {
            if first + n > self.entries_inside(table, range) {
                return Err(Exception::IllegalDataAddress);
            }
            if access == Access::Write && (!range.writable() || *own.get_or_insert(range.own) != range.own) {
                return Err(Exception::IllegalDataAddress);
            }
            Ok(())
        })
    }

    /// Packs bits into `out`, low bit first; unused bits are zero.
    pub fn read_bits(
        &self,
        memory: &Memory<'_>,
        table: Table,
        address: u16,
        quantity: u16,
        out: &mut [u8],
    ) -> Result<(), Exception> {
        out.fill(0);
        let mut done = 0;
        self.parts(table, address, u32::from(quantity), |range, first, n| {
            copy_bits(memory.of(range), range.base + first, out, done, n);
            done += n;
            Ok(())
        })
    }

    /// Puts as many words as `out` holds into it, high byte first.
    pub fn read_words(
        &self,
        memory: &Memory<'_>,
        table: Table,
        address: u16,
        out: &mut [u8],
    ) -> Result<(), Exception> {
        let mut words = out.chunks_exact_mut(2);
        let quantity = words.len() as u32;
        self.parts(table, address, quantity, |range, first, n| {
            let bytes = memory.of(range);
            for (k, word) in (first..first + n).zip(&mut words) {
                let at = (range.base + range.word(k) * 2) as usize;
                let low = bytes.get(at).copied().unwrap_or(0);
                let high = bytes.get(at + 1).copied().unwrap_or(0);
                word.copy_from_slice(&if range.swap_bytes { [low, high] } else { [high, low] });
            }
            Ok(())
        })
    }

    /// Puts the bytes a write changes into `set` (emptied first) and says whether they are the server's own %I.
    /// Exception 04 when the write touches more separate places than a [`WriteSet`] holds.
    pub fn plan(&self, write: &Write<'_>, set: &mut WriteSet) -> Result<Destination, Exception> {
        set.clear();
        let mut own = false;
        match *write {
            Write::Coils { address, quantity, values } => {
                let mut done = 0;
                self.parts(Table::Coils, address, u32::from(quantity), |range, first, n| {
                    own = range.own;
                    plan_bits(range, first, n, values, done, set)?;
                    done += n;
                    Ok(())
                })?;
            }
            Write::Registers { address, values } => {
                let mut done = 0;
                let quantity = (values.len() / 2) as u32;
                self.parts(Table::HoldingRegisters, address, quantity, |range, first, n| {
                    own = range.own;
                    plan_words(range, first, n, |k| word_of(values, done + (k - first)), set)?;
                    done += n;
                    Ok(())
                })?;
            }
            Write::Mask { address, and_mask, or_mask } => {
                self.parts(Table::HoldingRegisters, address, 1, |range, first, n| {
                    own = range.own;
                    plan_words(range, first, n, |_| (and_mask, or_mask & !and_mask), set)
                })?;
            }
        }
        Ok(if own { Destination::OwnInputs } else { Destination::Plc })
    }
}

/// Where the bytes of a write go.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Destination {
    /// To the PLC's queue of writes.
    Plc,
    /// Into the server's own part of %I.
    OwnInputs,
}

fn byte_span(table: Table, range: &Range) -> (u32, u32) {
    if table.is_bits() {
        (range.base / 8, (range.base + range.count).div_ceil(8))
    } else {
        (range.base, range.base + range.count * 2)
    }
}

/// And-mask and or-mask of word `index` of big-endian `values`.
fn word_of(values: &[u8], index: u32) -> (u16, u16) {
    let at = index as usize * 2;
    let value = match values.get(at..at + 2) {
        Some(&[high, low]) => u16::from_be_bytes([high, low]),
        _ => 0,
    };
    (0, value)
}

/// Plans registers `first..first + n` of a range in the order of memory, so that neighbours join.
fn plan_words(
    range: &Range,
    first: u32,
    n: u32,
    masks: impl Fn(u32) -> (u16, u16),
    set: &mut WriteSet,
) -> Result<(), Exception> {
    let from = first - first % range.group;
    let to = (first + n).next_multiple_of(range.group);
    for word in from..to {
        let k = range.word(word);
        if !(first..first + n).contains(&k) {
            continue;
        }
        let (and, or) = masks(k);
        let (mut and, mut or) = (and.to_le_bytes(), or.to_le_bytes());
        if range.swap_bytes {
            and.reverse();
            or.reverse();
        }
        let at = range.base + word * 2;
        let fits = set.push(range.area, at, and[0], or[0]) && set.push(range.area, at + 1, and[1], or[1]);
        if !fits {
            return Err(Exception::ServerDeviceFailure);
        }
    }
    Ok(())
}

/// Plans bits `first..first + n` of a range from bit `source` of `values` on.
fn plan_bits(
    range: &Range,
    first: u32,
    n: u32,
    values: &[u8],
    source: u32,
    set: &mut WriteSet,
) -> Result<(), Exception> {
    let start = range.base + first;
    let mut done = 0;
    while done < n {
        let bit = start + done;
        let take = (8 - bit % 8).min(n - done);
        let mask = (((1_u16 << take) - 1) << (bit % 8)) as u8;
        let value = (bits_at(values, source + done) << (bit % 8)) & mask;
        if !set.push(range.area, bit / 8, !mask, value) {
            return Err(Exception::ServerDeviceFailure);
        }
        done += take;
    }
    Ok(())
}

/// Eight bits from bit number `bit` on; zero beyond the end.
fn bits_at(bytes: &[u8], bit: u32) -> u8 {
    let byte = |i: usize| u16::from(bytes.get(i).copied().unwrap_or(0));
    let i = (bit / 8) as usize;
    ((byte(i) | byte(i + 1) << 8) >> (bit % 8)) as u8
}

/// Ors `n` bits from bit `from` of `source` into `out` from bit `to` on.
fn copy_bits(source: &[u8], from: u32, out: &mut [u8], to: u32, n: u32) {
    let mut done = 0;
    while done < n {
        let bit = to + done;
        let take = (8 - bit % 8).min(n - done);
        let mask = ((1_u16 << take) - 1) as u8;
        if let Some(byte) = out.get_mut((bit / 8) as usize) {
            *byte |= (bits_at(source, from + done) & mask) << (bit % 8);
        }
        done += take;
    }
}

#[cfg(test)]
#[path = "map_tests.rs"]
mod tests;
