//! Messages on their way from the rail to the writer, in buffers that are made once.
//!
//! The rail has an order within a topic and none between topics. Readers of a file expect time order. So the
//! writer merges a batch by stamp without ever changing the order within a topic, and a message that was
//! stamped after the last look at the topics began waits for the next batch: an older one of another topic may
//! not have been seen yet.

use ipc_types::payload::Stamp;
use ipc_types::port::ReadCounters;
use std::sync::Mutex;

/// Bytes after which a batch is handed over.
pub const BATCH_BYTES: usize = 128 * 1024;
/// Messages after which a batch is handed over.
pub const BATCH_MESSAGES: usize = 2048;
/// Batches of the queue between the two threads: about 8 MiB, 2 s at 4 MB/s.
pub const QUEUE: usize = 64;
/// Batches whose memory stays when they were used: twice what is on its way when nothing stalls.
const KEPT: usize = 8;

/// One message of a batch.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Entry {
    /// Index among the recorded topics.
    pub topic: u16,
    /// Bytes of the header, then the tail follows.
    pub header: u16,
    start: u32,
    len: u32,
    pub seq: u64,
    pub t_ns: u64,
    /// Stamp for sorting: never before an earlier message of the same topic.
    key: u64,
}

/// A batch.
#[derive(Debug)]
pub struct Batch {
    bytes: Vec<u8>,
    pub entries: Vec<Entry>,
    /// Per topic, when the batch was handed over.
    pub counters: Vec<ReadCounters>,
    last_key: Vec<u64>,
    /// UTC - CLOCK_MONOTONIC in ns.
    pub utc_offset_ns: i64,
    byte_limit: usize,
}

impl Batch {
    /// For so many topics, the largest message being `max_message` bytes.
    pub fn new(topics: usize, max_message: usize) -> Self {
        let byte_limit = 2 * BATCH_BYTES.max(max_message);
        Self {
            bytes: Vec::with_capacity(byte_limit),
            entries: Vec::with_capacity(2 * BATCH_MESSAGES),
            counters: vec![ReadCounters::default(); topics],
            last_key: vec![0; topics],
            utc_offset_ns: 0,
            byte_limit,
        }
    }

    /// Messages of at most `max_message` bytes that still fit.
    pub fn room(&self, max_message: usize) -> usize {
        let by_bytes = (self.byte_limit - self.bytes.len()) / max_message.max(1);
        by_bytes.min(2 * BATCH_MESSAGES - self.entries.len())
    }

    /// Whether it is time to hand it over.
    pub fn is_full(&self) -> bool {
        self.bytes.len() >= BATCH_BYTES || self.entries.len() >= BATCH_MESSAGES
    }

    /// Copies a message in; `false`, and nothing copied, when it does not fit.
    #[must_use]
    pub fn push(&mut self, topic: u16, stamp: &Stamp, header: &[u8], tail: &[u8]) -> bool {
        let (len, index) = (header.len() + tail.len(), usize::from(topic));
        if self.bytes.len() + len > self.byte_limit
            || self.entries.len() >= 2 * BATCH_MESSAGES
            || index >= self.last_key.len()
        {
            return false;
        }
        let start = self.bytes.len() as u32;
        self.bytes.extend_from_slice(header);
        self.bytes.extend_from_slice(tail);
        let key = stamp.t_ns.max(self.last_key[index]);
        self.last_key[index] = key;
        let (header, len) = (header.len() as u16, len as u32);
        self.entries.push(Entry { topic, header, start, len, seq: stamp.seq, t_ns: stamp.t_ns, key });
        true
    }

    /// Header and tail of a message.
    pub fn message(&self, entry: &Entry) -> (&[u8], &[u8]) {
        let all = self.data(entry);
        all.split_at(usize::from(entry.header).min(all.len()))
    }

    /// Header and tail in one piece.
    pub fn data(&self, entry: &Entry) -> &[u8] {
        let start = entry.start as usize;
        self.bytes.get(start..start + entry.len as usize).unwrap_or_default()
    }

    /// Moves what was stamped after `until_ns`, among the messages from `first` on, to `next`, with all that
    /// follows it in its topic. What does not fit there stays.
    pub fn carry(&mut self, first: usize, until_ns: u64, next: &mut Self) {
        let first = first.min(self.entries.len());
        let mut kept = first;
        for i in first..self.entries.len() {
            let entry = self.entries[i];
            let (header, tail) = self.message(&entry);
            let stamp = Stamp { seq: entry.seq, t_ns: entry.t_ns, ..Stamp::default() };
            // `key` only grows within a topic, so the first late message takes the rest of its topic with it.
            if entry.key <= until_ns || !next.push(entry.topic, &stamp, header, tail) {
                self.entries[kept] = entry;
                kept += 1;
            }
        }
        self.entries.truncate(kept);
    }

    /// Puts the messages in order of their stamps; within a topic nothing changes its place.
    pub fn merge(&mut self) {
        // `start` grows with arrival, which makes the unstable sort (no allocation) a stable one.
        self.entries.sort_unstable_by_key(|e| (e.key, e.start));
    }

    /// Gives the memory that it used back to the system.
    fn renew(&mut self) {
        self.bytes = Vec::new();
        self.bytes = Vec::with_capacity(self.byte_limit);
        self.entries = Vec::new();
        self.entries = Vec::with_capacity(2 * BATCH_MESSAGES);
    }

    /// Empties it for its next use.
    pub fn clear(&mut self) {
        self.bytes.clear();
        self.entries.clear();
        self.last_key.fill(0);
    }
}

/// Batches that wait to be filled. The last one back is the first out, so that memory which was never needed is never
/// touched; what a disk that stood still made necessary, 0.5 MiB a batch, is given back afterwards.
#[derive(Debug)]
pub struct Pool {
    free: Mutex<Vec<Batch>>,
    count: usize,
}

impl Pool {
    /// `count` batches.
    pub fn new(count: usize, topics: usize, max_message: usize) -> Self {
        let batches = (0..count).map(|_| Batch::new(topics, max_message)).collect();
        Self { free: Mutex::new(batches), count }
    }

    /// An empty batch, if one is free.
    pub fn take(&self) -> Option<Batch> {
        self.free.lock().ok()?.pop()
    }

    /// Gives a batch back.
    pub fn give(&self, mut batch: Batch) {
        batch.clear();
        if self.free() + KEPT < self.count {
            batch.renew();
        }
        if let Ok(mut free) = self.free.lock() {
            free.push(batch);
        }
    }

    /// Batches that are free.
    pub fn free(&self) -> usize {
        self.free.lock().map_or(0, |free| free.len())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn stamp(seq: u64, t_ns: u64) -> Stamp {
        Stamp { seq, t_ns, generation: 1, writer: 1 }
    }

    #[test]
    fn messages_come_in_time_order_and_late_ones_wait() {
        let mut batch = Batch::new(2, 100);
        let mut next = Batch::new(2, 100);
        for (topic, seq, t) in
            [(0, 1, 10), (0, 2, 30), (0, 3, 5), (0, 4, 70), (0, 5, 60), (1, 1, 20), (1, 2, 65)]
        {
            assert!(batch.push(topic, &stamp(seq, t), &[topic as u8, seq as u8], b"tail"));
        }
        batch.carry(0, 62, &mut next);
        batch.merge();
        next.merge();
        let order = |b: &Batch| b.entries.iter().map(|e| (e.topic, e.seq)).collect::<Vec<_>>();
        // 3 was stamped before 2 but sent after it: the topic's order wins.
        assert_eq!(order(&batch), [(0, 1), (1, 1), (0, 2), (0, 3)]);
        assert_eq!(order(&next), [(1, 2), (0, 4), (0, 5)]);
        assert_eq!(next.message(&next.entries[1]), (&[0u8, 4][..], &b"tail"[..]));
    }

    #[test]
    fn at_the_limit_a_message_is_refused() {
        let mut batch = Batch::new(1, 10);
        let body = vec![0u8; BATCH_BYTES];
        assert!(batch.push(0, &stamp(1, 1), &[], &body));
        assert!(batch.is_full());
        assert!(batch.push(0, &stamp(2, 1), &[], &body));
        assert_eq!(batch.room(1), 0);
        assert!(!batch.push(0, &stamp(3, 1), &[1], &[]));
        assert!(!Batch::new(1, 10).push(1, &stamp(1, 1), &[1], &[]), "no such topic");
        let mut small = Batch::new(1, 10);
        for _ in 0..2 * BATCH_MESSAGES {
            assert!(small.push(0, &stamp(1, 1), &[], &[]));
        }
        assert!(!small.push(0, &stamp(1, 1), &[], &[]));
    }

    #[test]
    fn the_pool_hands_out_the_last_one_first() {
        let pool = Pool::new(2, 1, 10);
        let mut one = pool.take().unwrap();
        assert!(one.push(0, &stamp(1, 1), &[1], &[]));
        let two = pool.take().unwrap();
        assert!(pool.take().is_none());
        pool.give(two);
        pool.give(one);
        assert_eq!(pool.free(), 2);
        assert!(pool.take().unwrap().entries.is_empty());
    }

    proptest! {
        #[test]
        fn nothing_is_lost_doubled_or_overtaken(
            messages in proptest::collection::vec((0u16..4, 0u64..100), 0..200), first in 0usize..200, until in 0u64..100,
        ) {
            let mut batch = Batch::new(4, 16);
            let mut next = Batch::new(4, 16);
            let mut seq = [0u64; 4];
            for (topic, t) in &messages {
                seq[usize::from(*topic)] += 1;
                prop_assert!(batch.push(*topic, &stamp(seq[usize::from(*topic)], *t), &[*topic as u8], &[]));
            }
            batch.carry(first, until, &mut next);
            batch.merge();
            next.merge();
            prop_assert_eq!(batch.entries.len() + next.entries.len(), messages.len());
            for topic in 0..4 {
                let order: Vec<_> =
                    batch.entries.iter().chain(&next.entries).filter(|e| e.topic == topic).map(|e| e.seq).collect();
                prop_assert_eq!(order, (1..=seq[usize::from(topic)]).collect::<Vec<_>>());
            }
        }
    }
}
