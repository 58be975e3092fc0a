//! Which bytes of memory a scan changed.

use ipc_types::scan_record::Writer;

/// Bytes compared at once.
const BLOCK: usize = 64;
/// Equal bytes between two changes that are recorded with them, because a range of their own costs 6 bytes.
const MERGE: usize = 6;

/// Writes every range of `now` that differs from `prev` and makes `prev` equal. Offsets count from `base`.
/// From `limit_from` on at most `limit` bytes are written; returns whether something was left out.
pub(crate) fn record(
    writer: &mut Writer,
    prev: &mut [u8],
    now: &[u8],
    base: u32,
    limit_from: usize,
    limit: usize,
) -> bool {
    let mut left = limit;
    let mut cut = false;
    let mut open: Option<(usize, usize)> = None;
    let section = writer.changes_begin();
    let mut close = |writer: &mut Writer, (start, end): (usize, usize)| {
        let mut end = end;
        if end > limit_from {
            let counted = end - start.max(limit_from);
            if counted > left {
                cut = true;
                end -= counted - left;
                left = 0;
            } else {
                left -= counted;
            }
        }
        if end > start {
            writer.change(base + start as u32, &now[start..end]);
        }
    };
    let len = prev.len().min(now.len());
    let mut at = 0;
    while at < len {
        let end = (at + BLOCK).min(len);
        let (old, new) = (&mut prev[at..end], &now[at..end]);
        if old != new {
            for i in 0..new.len() {
                if old[i] == new[i] {
                    continue;
                }
                let here = at + i;
                match &mut open {
                    // A range never crosses into the limited part, so that the limit cuts nothing else.
                    Some((start, last))
                        if here - *last <= MERGE && (*start >= limit_from || here < limit_from) =>
                    {
                        *last = here + 1;
                    }
                    _ => {
                        if let Some(range) = open.replace((here, here + 1)) {
                            close(writer, range);
                        }
                    }
                }
            }
            old.copy_from_slice(new);
        }
        at = end;
    }
    if let Some(range) = open {
        close(writer, range);
    }
    writer.changes_end(section);
    cut
}

#[cfg(test)]
mod tests {
    use super::*;
    use ipc_types::scan_record::{Content, Head, Section};
    use proptest::prelude::*;

    type Ranges = Vec<(u32, Vec<u8>)>;

    fn changes(prev: &mut [u8], now: &[u8], limit_from: usize, limit: usize) -> (Ranges, bool) {
        let mut writer = Writer::new(1 << 20);
        writer.begin();
        let cut = record(&mut writer, prev, now, 256, limit_from, limit);
        let bytes = writer.finish(&Head::default()).to_vec();
        let content = Content::parse(&bytes).unwrap();
        let ranges = content
            .sections()
            .flat_map(|s| match s {
                Section::Changes(c) => c.map(|(at, b)| (at, b.to_vec())).collect(),
                _ => Vec::new(),
            })
            .collect();
        (ranges, cut)
    }

    #[test]
    fn near_changes_are_one_range_and_far_ones_two() {
        let mut prev = vec![0; 300];
        let mut now = prev.clone();
        for at in [3, 6, 40, 299] {
            now[at] = 1;
        }
        let (ranges, cut) = changes(&mut prev, &now, 1000, 0);
        assert_eq!(ranges, [(259, vec![1, 0, 0, 1]), (296, vec![1]), (555, vec![1])]);
        assert!(!cut);
        assert_eq!(prev, now);
    }

    #[test]
    fn the_limit_holds_only_behind_its_start() {
        let mut prev = vec![0; 400];
        let now = vec![1; 400];
        let (ranges, cut) = changes(&mut prev, &now, 200, 16);
        assert_eq!(ranges, [(256, vec![1; 200]), (456, vec![1; 16])]);
        assert!(cut);
    }

    proptest! {
        #[test]
        fn the_ranges_turn_the_old_memory_into_the_new(
            pairs in prop::collection::vec((any::<u8>(), prop::bool::weighted(0.1), any::<u8>()), 1..400)
        ) {
            let mut prev: Vec<u8> = pairs.iter().map(|p| p.0).collect();
            let now: Vec<u8> = pairs.iter().map(|p| if p.1 { p.2 } else { p.0 }).collect();
            let mut patched = prev.clone();
            let (ranges, cut) = changes(&mut prev, &now, 200, 1000);
            prop_assert!(!cut);
            for (at, bytes) in ranges {
                let at = at as usize - 256;
                patched[at..at + bytes.len()].copy_from_slice(&bytes);
            }
            prop_assert_eq!(&patched, &now);
            prop_assert_eq!(&prev, &now);
        }
    }
}
