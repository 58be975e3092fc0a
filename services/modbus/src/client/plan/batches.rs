//! Which ranges are read by one request.

use super::super::config::Config;
use super::{Batch, Plan, ReadRange};
use crate::protocol::pdu::MAX_READ_BITS;

/// Two reads on one place; the launcher finds those of two services.
pub(super) fn overlaps(plan: &mut Plan) {
    let span = |range: &ReadRange| {
        let first = range.byte * 8 + u32::from(range.bit.unwrap_or(0));
        (first, first + if range.bit.is_some() { 1 } else { range.bytes * 8 })
    };
    let mut sorted: Vec<&ReadRange> = plan.reads.iter().collect();
    sorted.sort_by_key(|range| (span(range), range.index));
    let mut found = Vec::new();
    for pair in sorted.windows(2) {
        if let [a, b] = pair
            && span(b).0 < span(a).1
        {
            found.push((a.index.min(b.index), a.index.max(b.index)));
        }
    }
    for (low, high) in found {
        let message = format!("lies over read[{low}].to");
        plan.wrong(format!("read[{high}].to"), message, "give every bit of %I to one read only");
    }
}

/// The requests of a line: big ones first in the list, then those to be used when a unit refuses one.
pub(super) fn batches(config: &Config, reads: &[ReadRange], line: usize) -> Vec<Batch> {
    let mut mine: Vec<usize> = (0..reads.len()).filter(|&i| reads[i].line == line).collect();
    mine.sort_by_key(|&i| (reads[i].unit, reads[i].table, reads[i].period_ns, reads[i].at, i));
    let mut batches: Vec<Batch> = Vec::new();
    for &i in &mine {
        let range = &reads[i];
        let limit = if range.table.is_bits() {
            (u32::from(config.max_batch) * 16).min(u32::from(MAX_READ_BITS))
        } else {
            u32::from(config.max_batch)
        };
        let end = u32::from(range.at) + u32::from(range.count);
        if let Some(last) = batches.last_mut() {
            let last_end = u32::from(last.at) + u32::from(last.count);
            let same = (last.unit, last.table, last.period_ns) == (range.unit, range.table, range.period_ns);
            let near = u32::from(range.at) <= last_end + u32::from(config.max_gap);
            let whole = last_end.max(end) - u32::from(last.at);
            if same && near && whole <= limit {
                last.members.push((i, range.at - last.at));
                last.count = whole as u16;
                continue;
            }
        }
        batches.push(single(range, i, true));
    }
    let big = batches.len();
    for b in 0..big {
        if batches[b].members.len() > 1 {
            let members: Vec<usize> = batches[b].members.iter().map(|m| m.0).collect();
            for i in members {
                let own = batches.len();
                batches[b].alone.push(own);
                batches.push(single(&reads[i], i, false));
            }
        }
    }
    batches
}

fn single(range: &ReadRange, i: usize, enabled: bool) -> Batch {
    Batch {
        unit: range.unit,
        table: range.table,
        at: range.at,
        count: range.count,
        period_ns: range.period_ns,
        members: vec![(i, 0)],
        alone: Vec::new(),
        enabled,
    }
}
