//! Frames in, bytes of %I out, with the quality of every input.
//!
//! Sans-I/O: told frames and time, it keeps the tail of the `inputs` message. Nothing allocates after
//! [`InputTable::new`].

use ipc_types::payload::Quality;

use crate::plan::{EFF_FLAG, InputPoint};

/// Quality changes kept for reporting; more in one turn are counted only.
const MAX_CHANGES: usize = 64;
/// No row for this identifier.
const NO_ROW: u16 = u16::MAX;

/// All inputs of one frame.
#[derive(Debug, Clone)]
struct Row {
    can_id: u32,
    /// Range in `order`.
    first: usize,
    count: usize,
    frames: u64,
    last_t_ns: u64,
}

#[derive(Debug, Clone)]
struct Slot {
    point: InputPoint,
    /// Offset of its bytes in the tail.
    at: usize,
    row: u16,
}

/// A frame whose inputs became bad or good.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct QualityChange {
    /// Identifier with [`EFF_FLAG`].
    pub can_id: u32,
    /// Index of the first `[[service.in]]` concerned.
    pub index: usize,
    /// What it is now.
    pub quality: Quality,
    /// Time since the frame's last arrival.
    pub age_ns: u64,
}

/// Counters since start.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, serde::Serialize)]
pub struct InputCounters {
    /// Frames with inputs.
    pub frames: u64,
    /// Inputs not taken because the frame was too short.
    pub short: u64,
    /// Times an input became stale.
    pub stale: u64,
}

/// State of one frame, for the status.
#[derive(Debug, Clone, serde::Serialize)]
pub struct RowStatus {
    /// Bare identifier in hex.
    pub id: String,
    /// Frames since start.
    pub frames: u64,
    /// Worst quality of its inputs.
    pub quality: Quality,
}

/// See the module.
#[derive(Debug, Clone)]
pub struct InputTable {
    slots: Vec<Slot>,
    rows: Vec<Row>,
    /// Slots sorted by identifier.
    order: Vec<u16>,
    standard: Vec<u16>,
    extended: Vec<(u32, u16)>,
    /// Values, then one quality byte a slot.
    tail: Vec<u8>,
    data_t_ns: u64,
    /// Not before this time anything can become stale.
    next_check_ns: Option<u64>,
    changes: Vec<QualityChange>,
    counters: InputCounters,
}

impl InputTable {
    /// All inputs without data: their substitute or zero, [`Quality::NoData`].
    pub fn new(points: &[InputPoint]) -> Self {
        let mut at = 0;
        let mut slots: Vec<Slot> = Vec::with_capacity(points.len());
        for point in points {
            slots.push(Slot { point: point.clone(), at, row: 0 });
            at += point.codec.iec.bytes();
        }
        let mut order: Vec<u16> = (0..slots.len() as u16).collect();
        order.sort_by_key(|&i| (slots[i as usize].point.can_id, i));
        let mut rows: Vec<Row> = Vec::new();
        for (position, &i) in order.iter().enumerate() {
            let can_id = slots[i as usize].point.can_id;
            match rows.last_mut() {
                Some(row) if row.can_id == can_id => row.count += 1,
                _ => rows.push(Row { can_id, first: position, count: 1, frames: 0, last_t_ns: 0 }),
            }
            slots[i as usize].row = rows.len() as u16 - 1;
        }
        let mut standard = vec![NO_ROW; 0x800];
        let mut extended = Vec::new();
        for (i, row) in rows.iter().enumerate() {
            match standard.get_mut(row.can_id as usize) {
                Some(entry) => *entry = i as u16,
                None => extended.push((row.can_id, i as u16)),
            }
        }
        let mut tail = vec![0; at + slots.len()];
        tail[at..].fill(Quality::NoData as u8);
        let mut table = Self {
            slots,
            rows,
            order,
            standard,
            extended,
            tail,
            data_t_ns: 0,
            next_check_ns: None,
            changes: Vec::with_capacity(MAX_CHANGES),
            counters: InputCounters::default(),
        };
        for i in 0..table.slots.len() {
            table.substitute(i);
        }
        table
    }

    /// Takes a data frame; `can_id` with [`EFF_FLAG`], other flags clear. True when it holds inputs.
    pub fn frame(&mut self, can_id: u32, payload: &[u8], t_ns: u64) -> bool {
        let row = match self.standard.get(can_id as usize) {
            Some(&row) => row,
            None => match self.extended.binary_search_by_key(&can_id, |(id, _)| *id) {
                Ok(i) => self.extended[i].1,
                Err(_) => NO_ROW,
            },
        };
        let Some(row) = self.rows.get_mut(usize::from(row)) else { return false };
        self.counters.frames += 1;
        row.frames += 1;
        row.last_t_ns = t_ns;
        let (can_id, first, count) = (row.can_id, row.first, row.count);
        self.data_t_ns = self.data_t_ns.max(t_ns);
        let mut recovered = None;
        let values = self.tail.len() - self.slots.len();
        for &i in &self.order[first..first + count] {
            let slot = &self.slots[usize::from(i)];
            let Some(value) = slot.point.codec.decode(payload) else {
                self.counters.short += 1;
                continue;
            };
            let bytes = slot.point.codec.iec.bytes();
            self.tail[slot.at..slot.at + bytes].copy_from_slice(&value[..bytes]);
            let quality = &mut self.tail[values + usize::from(i)];
            if *quality == Quality::Stale as u8 {
                recovered.get_or_insert(slot.point.index);
            }
            *quality = Quality::Good as u8;
            if let Some(timeout_ns) = slot.point.timeout_ns {
                let stale_ns = t_ns.saturating_add(timeout_ns);
                self.next_check_ns = Some(self.next_check_ns.map_or(stale_ns, |next| next.min(stale_ns)));
            }
        }
        if let Some(index) = recovered {
            self.note(QualityChange { can_id, index, quality: Quality::Good, age_ns: 0 });
        }
        true
    }

    fn note(&mut self, change: QualityChange) {
        if self.changes.len() < MAX_CHANGES {
            self.changes.push(change);
        }
    }

    /// Marks what has become stale. True when something did.
    pub fn check(&mut self, now_ns: u64) -> bool {
        if self.next_check_ns.is_none_or(|next_ns| now_ns < next_ns) {
            return false;
        }
        self.next_check_ns = None;
        let values = self.tail.len() - self.slots.len();
        let mut any = false;
        let mut noted = None;
        for position in 0..self.order.len() {
            let i = usize::from(self.order[position]);
            let slot = &self.slots[i];
            let Some(timeout_ns) = slot.point.timeout_ns else { continue };
            if self.tail[values + i] != Quality::Good as u8 {
                continue;
            }
            let last_ns = self.rows[usize::from(slot.row)].last_t_ns;
            let stale_ns = last_ns.saturating_add(timeout_ns);
            if now_ns < stale_ns {
                self.next_check_ns = Some(self.next_check_ns.map_or(stale_ns, |next| next.min(stale_ns)));
                continue;
            }
            let (row, can_id, index) = (slot.row, slot.point.can_id, slot.point.index);
            self.tail[values + i] = Quality::Stale as u8;
            self.counters.stale += 1;
            self.substitute(i);
            any = true;
            // One report a frame.
            if noted != Some(row) {
                noted = Some(row);
                let age_ns = now_ns.saturating_sub(last_ns);
                self.note(QualityChange { can_id, index, quality: Quality::Stale, age_ns });
            }
        }
        any
    }

    fn substitute(&mut self, i: usize) {
        let slot = &self.slots[i];
        if let Some(value) = slot.point.substitute {
            let bytes = slot.point.codec.iec.bytes();
            self.tail[slot.at..slot.at + bytes].copy_from_slice(&value[..bytes]);
        }
    }

    /// When to call [`Self::check`] next.
    pub fn next_check_ns(&self) -> Option<u64> {
        self.next_check_ns
    }

    /// Tail of the `inputs` message.
    pub fn tail(&self) -> &[u8] {
        &self.tail
    }

    /// Stamp of the newest data.
    pub fn data_t_ns(&self) -> u64 {
        self.data_t_ns
    }

    /// Number of inputs.
    pub fn ranges(&self) -> u32 {
        self.slots.len() as u32
    }

    /// Quality changes since the last call.
    pub fn drain_changes(&mut self) -> std::vec::Drain<'_, QualityChange> {
        self.changes.drain(..)
    }

    /// Counters since start.
    pub fn counters(&self) -> InputCounters {
        self.counters
    }

    /// State of at most `max` frames.
    pub fn rows(&self, max: usize) -> Vec<RowStatus> {
        let values = self.tail.len() - self.slots.len();
        let worst = |row: &Row| {
            let own = self.order[row.first..row.first + row.count].iter();
            own.map(|&i| Quality::from_u8(self.tail[values + usize::from(i)]))
                .max()
                .unwrap_or(Quality::NoData)
        };
        let rows = self.rows.iter().take(max);
        rows.map(|row| RowStatus {
            id: if row.can_id & EFF_FLAG != 0 {
                format!("{:08X}", row.can_id & !EFF_FLAG)
            } else {
                format!("{:03X}", row.can_id)
            },
            frames: row.frames,
            quality: worst(row),
        })
        .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::plan;
    use proptest::prelude::*;
    use serde_json::json;

    const MS: u64 = 1_000_000;

    fn table() -> InputTable {
        let config = json!({ "in": [
            { "id": 0x1A0, "start": 0, "len": 16, "to": "%IW0", "timeout": "100ms" },
            { "id": "000001A0", "start": 7, "len": 16, "order": "motorola", "signed": true, "to": "%IW1" },
            { "id": 0x1A0, "start": 16, "len": 1, "to": "%IX4.0", "timeout": "50ms", "on_bad": "zero" },
            { "id": 0x7FF, "start": 0, "len": 8, "to": "%IB5", "timeout": "100ms", "on_bad": 7 },
        ] });
        let plan = plan(&serde_json::from_value(config).unwrap(), dinrail_iec::Addressing::Element);
        assert_eq!(plan.mistakes, []);
        InputTable::new(&plan.inputs)
    }

    const NO_DATA: u8 = Quality::NoData as u8;
    const STALE: u8 = Quality::Stale as u8;

    #[test]
    fn frames_become_bytes() {
        let mut table = table();
        assert_eq!(table.tail(), [0, 0, 0, 0, 0, 7, NO_DATA, NO_DATA, NO_DATA, NO_DATA]);
        assert!(!table.check(u64::MAX));
        assert!(table.frame(0x1A0, &[0x34, 0x12, 0x01], 10 * MS));
        assert_eq!(table.tail(), [0x34, 0x12, 0, 0, 1, 7, 0, NO_DATA, 0, NO_DATA]);
        assert!(table.frame(EFF_FLAG | 0x1A0, &[0xFF, 0xFE], 11 * MS));
        assert_eq!(table.tail(), [0x34, 0x12, 0xFE, 0xFF, 1, 7, 0, 0, 0, NO_DATA]);
        assert!(!table.frame(0x1A1, &[0; 8], 12 * MS));
        assert!(!table.frame(EFF_FLAG | 0x7FF, &[0; 8], 12 * MS));
        assert_eq!(table.data_t_ns(), 11 * MS);
        // Too short for the bit: the word is taken, the bit keeps value and age.
        table.frame(0x1A0, &[1, 0], 12 * MS);
        assert_eq!(table.tail()[..5], [1, 0, 0xFE, 0xFF, 1]);
        assert_eq!(table.counters(), InputCounters { frames: 3, short: 1, stale: 0 });
    }

    #[test]
    fn old_values_turn_bad_and_good_again() {
        let mut table = table();
        table.frame(0x1A0, &[1, 2, 1], 0);
        table.frame(EFF_FLAG | 0x1A0, &[1, 2], 0);
        table.frame(0x7FF, &[9], 20 * MS);
        assert_eq!(table.next_check_ns(), Some(50 * MS));
        assert!(!table.check(50 * MS - 1));
        assert!(table.check(50 * MS));
        // The bit is zero and stale, its frame's word is not yet.
        assert_eq!(table.tail(), [1, 2, 2, 1, 0, 9, 0, 0, STALE, 0]);
        assert_eq!(table.next_check_ns(), Some(100 * MS));
        // A frame late: nothing was stale in between, so nothing is reported.
        table.frame(0x7FF, &[10], 60 * MS);
        assert!(table.check(130 * MS));
        // Held; the other frame is still fresh; no timeout means never.
        assert_eq!(table.tail(), [1, 2, 2, 1, 0, 10, STALE, 0, STALE, 0]);
        assert!(table.check(1000 * MS));
        assert_eq!(table.tail(), [1, 2, 2, 1, 0, 7, STALE, 0, STALE, STALE]);
        assert_eq!(table.next_check_ns(), None);
        table.frame(0x1A0, &[5, 6, 1], 1001 * MS);
        assert_eq!(table.tail(), [5, 6, 2, 1, 1, 7, 0, 0, 0, STALE]);
        let changes: Vec<_> = table.drain_changes().map(|c| (c.can_id, c.index, c.quality)).collect();
        assert_eq!(
            changes,
            [
                (0x1A0, 2, Quality::Stale),
                (0x1A0, 0, Quality::Stale),
                (0x7FF, 3, Quality::Stale),
                (0x1A0, 0, Quality::Good)
            ]
        );
        assert_eq!(table.rows(9)[0].quality, Quality::Good);
    }

    proptest! {
        #[test]
        fn any_frame_any_time(
            frames in prop::collection::vec((any::<u32>(), prop::collection::vec(any::<u8>(), 0..=64), any::<u64>()), 0..50),
        ) {
            let mut table = table();
            for (can_id, payload, t_ns) in frames {
                table.frame((can_id % 0x200) | (can_id & EFF_FLAG), &payload, t_ns);
                table.check(t_ns.wrapping_add(MS));
                prop_assert_eq!(table.tail().len(), 10);
                prop_assert!(table.changes.len() <= MAX_CHANGES);
            }
        }
    }
}
