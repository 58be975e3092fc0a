//! Answers to bytes of %I with their quality; bytes of %Q and %M to write requests. Sans-I/O.

use super::config::OnBad;
use super::plan::{ReadRange, WriteRange};
use crate::protocol::pdu::{COIL_ON, MAX_PDU, function};
use crate::server::Table;
use ipc_types::payload::Quality;
use ipc_types::wiring::Area;

/// A range whose quality changed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct QualityChange {
    /// Index of the plan's read.
    pub read: usize,
    pub quality: Quality,
}

struct Row {
    /// In the tail.
    at: usize,
    last_ns: Option<u64>,
    quality: Quality,
}

/// The service's part of %I.
pub struct InputTable {
    ranges: Vec<ReadRange>,
    rows: Vec<Row>,
    tail: Vec<u8>,
    data_t_ns: u64,
    changes: Vec<QualityChange>,
}

impl InputTable {
    /// Nothing has come yet.
    pub fn new(ranges: &[ReadRange]) -> Self {
        let mut rows = Vec::with_capacity(ranges.len());
        let mut tail = Vec::new();
        for range in ranges {
            rows.push(Row { at: tail.len(), last_ns: None, quality: Quality::NoData });
            tail.resize(tail.len() + range.bytes as usize, 0);
        }
        tail.resize(tail.len() + ranges.len(), Quality::NoData as u8);
        Self { ranges: ranges.to_vec(), rows, tail, data_t_ns: 0, changes: Vec::with_capacity(ranges.len()) }
    }

    /// Bytes of all ranges, then their qualities.
    pub fn tail(&self) -> &[u8] {
        &self.tail
    }

    pub fn data_t_ns(&self) -> u64 {
        self.data_t_ns
    }

    /// Quality of a range.
    pub fn quality(&self, read: usize) -> Quality {
        self.rows.get(read).map_or(Quality::NoData, |row| row.quality)
    }

    /// Data of an answer, behind its byte count, in which the range begins at entry `skip`. `false`: too short.
    pub fn data(&mut self, read: usize, data: &[u8], skip: u16, now_ns: u64) -> bool {
        let (Some(range), Some(row)) = (self.ranges.get(read), self.rows.get_mut(read)) else { return false };
        let out = &mut self.tail[row.at..row.at + range.bytes as usize];
        let (skip, count) = (usize::from(skip), usize::from(range.count));
        if range.table.is_bits() {
            if (skip + count).div_ceil(8) > data.len() {
                return false;
            }
            out.fill(0);
            for i in 0..count {
                let bit = data[(skip + i) / 8] >> ((skip + i) % 8) & 1;
                out[i / 8] |= bit << (i % 8);
            }
        } else {
            let Some(words) = data.get(skip * 2..(skip + count) * 2) else { return false };
            out.copy_from_slice(words);
            range.order.turn(range.group, out);
        }
        row.last_ns = Some(now_ns);
        self.data_t_ns = now_ns;
        self.set(read, Quality::Good);
        true
    }

    /// The range could not be read.
    pub fn failed(&mut self, read: usize) {
        if self.rows.get(read).is_some_and(|row| row.quality == Quality::Good) {
            self.set(read, Quality::Stale);
        }
    }

    /// Marks what is too old. Returns when to look again.
    pub fn check(&mut self, now_ns: u64) -> Option<u64> {
        let mut next_ns: Option<u64> = None;
        for i in 0..self.rows.len() {
            let (row, range) = (&self.rows[i], &self.ranges[i]);
            let Some(last_ns) = row.last_ns.filter(|_| row.quality == Quality::Good) else { continue };
            let end_ns = last_ns.saturating_add(range.timeout_ns);
            if end_ns <= now_ns {
                self.set(i, Quality::Stale);
            } else {
                next_ns = Some(next_ns.map_or(end_ns, |n| n.min(end_ns)));
            }
        }
        next_ns
    }

    fn set(&mut self, read: usize, quality: Quality) {
        let row = &mut self.rows[read];
        if row.quality == quality {
            return;
        }
        row.quality = quality;
        let (at, bytes) = (row.at, self.ranges[read].bytes as usize);
        if quality != Quality::Good && self.ranges[read].on_bad == OnBad::Zero {
            self.tail[at..at + bytes].fill(0);
        }
        let first = self.tail.len() - self.rows.len();
        self.tail[first + read] = quality as u8;
        if self.changes.len() < self.changes.capacity() {
            self.changes.push(QualityChange { read, quality });
        }
    }

    /// Whether quality changed since the last [`Self::drain_changes`].
    pub fn has_changes(&self) -> bool {
        !self.changes.is_empty()
    }

    /// What changed since the last call.
    pub fn drain_changes(&mut self) -> impl Iterator<Item = QualityChange> + '_ {
        self.changes.drain(..)
    }
}

struct Output {
    range: WriteRange,
    /// As last handed to the line, on the wire's order.
    handed: Option<Vec<u8>>,
    values: Vec<u8>,
    due_ns: Option<u64>,
}

/// What follows %Q and %M.
pub struct WriteTable {
    outputs: Vec<Output>,
    running: bool,
    /// Images too small for an address.
    outside: u64,
}

impl WriteTable {
    /// Silent until the first image of a running program.
    pub fn new(ranges: &[WriteRange]) -> Self {
        let outputs = ranges
            .iter()
            .map(|range| {
                let bytes = if range.table.is_bits() { range.count.div_ceil(8) } else { range.count * 2 };
                Output {
                    range: range.clone(),
                    handed: None,
                    values: vec![0; usize::from(bytes)],
                    due_ns: None,
                }
            })
            .collect();
        Self { outputs, running: false, outside: 0 }
    }

    pub fn is_empty(&self) -> bool {
        self.outputs.is_empty()
    }
    /// Whether writes follow the image.
    pub fn is_running(&self) -> bool {
        self.running
    }
    /// Images too small for an address.
    pub fn outside(&self) -> u64 {
        self.outside
    }

    /// A new image of a program whose outputs count. `write` gets the index of the range and its request.
    pub fn image(&mut self, q: &[u8], m: &[u8], now_ns: u64, mut write: impl FnMut(usize, &[u8])) {
        self.running = true;
        for (i, output) in self.outputs.iter_mut().enumerate() {
            let area = if output.range.area == Area::Marker { m } else { q };
            let range = &output.range;
            let bytes = area.get(range.byte as usize..(range.byte + range.bytes) as usize);
            let Some(bytes) = bytes else {
                self.outside += 1;
                continue;
            };
            take(range, bytes, &mut output.values);
            let changed = output.handed.as_ref() != Some(&output.values);
            if range.on_change && changed || output.handed.is_none() {
                output.hand_over(i, now_ns, &mut write);
            }
        }
    }

    /// Hands over what is due by its period. Returns when to call again.
    pub fn due(&mut self, now_ns: u64, mut write: impl FnMut(usize, &[u8])) -> Option<u64> {
        if !self.running {
            return None;
        }
        let mut next_ns: Option<u64> = None;
        for (i, output) in self.outputs.iter_mut().enumerate() {
            if output.due_ns.is_some_and(|due_ns| due_ns <= now_ns) {
                output.hand_over(i, now_ns, &mut write);
            }
            next_ns = next_ns.into_iter().chain(output.due_ns).min();
        }
        next_ns
    }

    /// The unit was gone and is back, or with `None` the connection of all its units: they get all values again.
    pub fn again(&mut self, line: usize, unit: Option<u8>, now_ns: u64, mut write: impl FnMut(usize, &[u8])) {
        for (i, output) in self.outputs.iter_mut().enumerate() {
            if self.running
                && output.range.line == line
                && unit.is_none_or(|unit| output.range.unit == unit)
                && output.handed.is_some()
            {
                output.hand_over(i, now_ns, &mut write);
            }
        }
    }

    /// The image is stale or the program does not run. `act` gets every range: its waiting writes are to be forgotten,
    /// and this request, if there is one, is to be written.
    pub fn safe(&mut self, mut act: impl FnMut(usize, Option<&[u8]>)) {
        if !self.running {
            return;
        }
        self.running = false;
        for (i, output) in self.outputs.iter_mut().enumerate() {
            output.due_ns = None;
            // The first image afterwards is written, whatever it holds.
            output.handed = None;
            let mut pdu = [0; MAX_PDU];
            let len = output.range.safe.as_ref().map(|safe| request(&output.range, safe, &mut pdu));
            act(i, len.map(|len| &pdu[..len]));
        }
    }
}

impl Output {
    fn hand_over(&mut self, i: usize, now_ns: u64, write: &mut impl FnMut(usize, &[u8])) {
        let mut pdu = [0; MAX_PDU];
        let len = request(&self.range, &self.values, &mut pdu);
        write(i, &pdu[..len]);
        match &mut self.handed {
            Some(handed) => handed.copy_from_slice(&self.values),
            None => self.handed = Some(self.values.clone()),
        }
        self.due_ns = self.range.period_ns.map(|period_ns| now_ns.saturating_add(period_ns));
    }
}

/// Bytes of the image as they go on the wire.
fn take(range: &WriteRange, bytes: &[u8], out: &mut [u8]) {
    if range.table.is_bits() {
        out.fill(0);
        for i in 0..usize::from(range.count) {
            let at = usize::from(range.bit) + i;
            out[i / 8] |= (bytes[at / 8] >> (at % 8) & 1) << (i % 8);
        }
    } else {
        out.copy_from_slice(bytes);
        range.order.turn(range.group, out);
    }
}

/// The request that writes these values (as on the wire) to the range; its length.
fn request(range: &WriteRange, values: &[u8], out: &mut [u8; MAX_PDU]) -> usize {
    let [a1, a0] = range.at.to_be_bytes();
    let [c1, c0] = range.count.to_be_bytes();
    let bits = range.table == Table::Coils;
    if range.count == 1 && !range.multiple {
        let value = if bits {
            if values[0] & 1 == 1 { COIL_ON.to_be_bytes() } else { [0, 0] }
        } else {
            [values[0], values[1]]
        };
        let code = if bits { function::WRITE_SINGLE_COIL } else { function::WRITE_SINGLE_REGISTER };
        out[..5].copy_from_slice(&[code, a1, a0, value[0], value[1]]);
        return 5;
    }
    let code = if bits { function::WRITE_MULTIPLE_COILS } else { function::WRITE_MULTIPLE_REGISTERS };
    out[..6].copy_from_slice(&[code, a1, a0, c1, c0, values.len() as u8]);
    out[6..6 + values.len()].copy_from_slice(values);
    6 + values.len()
}

/// The request that reads these entries.
pub fn read_request(table: Table, at: u16, count: u16) -> [u8; 5] {
    let code = match table {
        Table::Coils => function::READ_COILS,
        Table::DiscreteInputs => function::READ_DISCRETE_INPUTS,
        Table::InputRegisters => function::READ_INPUT_REGISTERS,
        Table::HoldingRegisters => function::READ_HOLDING_REGISTERS,
    };
    let ([a1, a0], [c1, c0]) = (at.to_be_bytes(), count.to_be_bytes());
    [code, a1, a0, c1, c0]
}

#[cfg(test)]
#[path = "image_tests.rs"]
mod tests;
