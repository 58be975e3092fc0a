//! The driver's transmit queue: what the processes of the stack want on the bus and is not there yet.
//!
//! Sans-I/O. Order: the lowest identifier in arbitration order first, first in first out within an identifier.
//! A frame marked *newest value* (cyclic PDO or parameter group) takes the place of one with the same identifier
//! that still waits, so a slow bus sends the present value and not the history. Full means refused: the caller
//! leaves the rest with its writer, who is told. Nothing allocates after [`TxQueue::new`].

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use crate::protocol::Frame;

/// A frame that waits for the bus.
#[derive(Debug, Clone, Copy)]
pub struct Waiting {
    /// The frame.
    pub frame: Frame,
    /// CLOCK_MONOTONIC in ns at which it (or the value it replaced) was queued.
    pub arrived_ns: u64,
    /// CLOCK_MONOTONIC in ns at which its present value was queued.
    pub fresh_ns: u64,
    /// Low bits of the number of the process that sent its present value.
    pub sender: u8,
    newest: bool,
}

/// What became of a frame that was pushed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Pushed {
    /// It waits.
    Queued,
    /// It took the place of an older value of its identifier.
    Replaced,
    /// The queue is full; it was not taken.
    Refused,
}

/// Counters since start.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, serde::Serialize)]
pub struct TxCounters {
    /// Frames taken.
    pub queued: u64,
    /// Older values that a newer one replaced before they were sent.
    pub replaced: u64,
    /// Frames refused because the queue was full.
    pub refused: u64,
    /// Most frames that ever waited at once.
    pub peak: u32,
}

/// Identifier with flags, or this for a slot that is free or holds no newest-value frame.
const NO_ID: u32 = u32::MAX;

/// See the module.
#[derive(Debug)]
pub struct TxQueue {
    slots: Vec<Waiting>,
    /// Identifier of the newest-value frame in each slot; scanned in one sweep, 2 KiB at the default size.
    newest_ids: Vec<u32>,
    free: Vec<u32>,
    /// (arbitration key, order of arrival, slot), smallest first.
    order: BinaryHeap<Reverse<(u32, u64, u32)>>,
    arrivals: u64,
    counters: TxCounters,
}

impl TxQueue {
    /// A queue for at most `capacity` frames (at least 1).
    pub fn new(capacity: usize) -> Self {
        let capacity = capacity.max(1);
        let empty = Waiting { frame: Frame::default(), arrived_ns: 0, fresh_ns: 0, sender: 0, newest: false };
        Self {
            slots: vec![empty; capacity],
            newest_ids: vec![NO_ID; capacity],
            free: (0..capacity as u32).rev().collect(),
            order: BinaryHeap::with_capacity(capacity),
            arrivals: 0,
            counters: TxCounters::default(),
        }
    }

    /// Frames waiting.
    pub fn len(&self) -> usize {
        self.order.len()
    }

    /// True when nothing waits.
    pub fn is_empty(&self) -> bool {
        self.order.is_empty()
    }

    /// Frames that can still be pushed for sure.
    pub fn room(&self) -> usize {
        self.free.len()
    }

    /// Counters since start.
    pub fn counters(&self) -> TxCounters {
        self.counters
    }

    /// Queues a frame; `newest` lets it replace a waiting newest-value frame of the same identifier and kind.
    pub fn push(&mut self, frame: &Frame, newest: bool, now_ns: u64, sender: u8) -> Pushed {
        if newest && let Some(slot) = self.newest_ids.iter().position(|&id| id == frame.can_id) {
            self.slots[slot].frame = *frame;
            self.slots[slot].fresh_ns = now_ns;
            self.slots[slot].sender = sender;
            self.counters.replaced += 1;
            return Pushed::Replaced;
        }
        let Some(slot) = self.free.pop() else {
            self.counters.refused += 1;
            return Pushed::Refused;
        };
        self.slots[slot as usize] =
            Waiting { frame: *frame, arrived_ns: now_ns, fresh_ns: now_ns, sender, newest };
        if newest {
            self.newest_ids[slot as usize] = frame.can_id;
        }
        self.order.push(Reverse((frame.arbitration_key(), self.arrivals, slot)));
        self.arrivals += 1;
        self.counters.queued += 1;
        self.counters.peak = self.counters.peak.max(self.order.len() as u32);
        Pushed::Queued
    }

    /// The frame that goes next.
    pub fn peek(&self) -> Option<&Waiting> {
        self.order.peek().map(|Reverse((_, _, slot))| &self.slots[*slot as usize])
    }

    /// Takes the frame that goes next.
    pub fn pop(&mut self) -> Option<Waiting> {
        let Reverse((_, _, slot)) = self.order.pop()?;
        let waiting = self.slots[slot as usize];
        if waiting.newest {
            self.newest_ids[slot as usize] = NO_ID;
        }
        self.free.push(slot);
        Some(waiting)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::protocol::candump::{format, parse};
    use proptest::prelude::*;

    #[test]
    fn a_newest_value_is_of_who_sent_it_last() {
        let mut queue = TxQueue::new(16);
        for (text, sender) in [("123#01", 3), ("123#02", 7)] {
            queue.push(&parse(text).unwrap(), true, 0, sender);
        }
        let waiting = queue.pop().unwrap();
        assert_eq!((format(&waiting.frame).as_str(), waiting.sender), ("123#02", 7));
    }

    fn sent(queue: &mut TxQueue) -> String {
        let mut out = Vec::new();
        while let Some(waiting) = queue.pop() {
            out.push(format(&waiting.frame));
        }
        out.join(" ")
    }

    #[test]
    fn by_identifier_then_by_arrival() {
        let mut queue = TxQueue::new(16);
        for text in ["300#01", "00000000#01", "100#01", "000#R", "300#02", "100#02", "000#01"] {
            assert_eq!(queue.push(&parse(text).unwrap(), false, 0, 0), Pushed::Queued);
        }
        assert_eq!(sent(&mut queue), "000#01 000#R 00000000#01 100#01 100#02 300#01 300#02");
    }

    #[test]
    fn newest_value_takes_the_place_of_the_waiting_one() {
        let mut queue = TxQueue::new(4);
        let push = |queue: &mut TxQueue, text: &str, newest| queue.push(&parse(text).unwrap(), newest, 7, 0);
        assert_eq!(push(&mut queue, "200#01", true), Pushed::Queued);
        assert_eq!(push(&mut queue, "200#FF", false), Pushed::Queued);
        assert_eq!(push(&mut queue, "200#02", true), Pushed::Replaced);
        assert_eq!(push(&mut queue, "100#01", true), Pushed::Queued);
        assert_eq!(push(&mut queue, "200#R", true), Pushed::Queued);
        // Full: only what replaces is taken.
        assert_eq!(push(&mut queue, "201#01", true), Pushed::Refused);
        assert_eq!(push(&mut queue, "200#03", true), Pushed::Replaced);
        assert_eq!(queue.room(), 0);
        assert_eq!(sent(&mut queue), "100#01 200#03 200#FF 200#R");
        // Once sent, the slot is free again.
        assert_eq!(push(&mut queue, "200#04", true), Pushed::Queued);
        let counters = queue.counters();
        assert_eq!((counters.queued, counters.replaced, counters.refused, counters.peak), (5, 2, 1, 4));
    }

    proptest! {
        #[test]
        fn loses_nothing_and_keeps_order(
            frames in prop::collection::vec((0u32..6, any::<bool>(), 0u8..=255), 0..200),
            capacity in 1usize..40,
        ) {
            let mut queue = TxQueue::new(capacity);
            let mut model: Vec<(u32, u64, u8, bool)> = Vec::new();
            for (i, &(id, newest, value)) in frames.iter().enumerate() {
                let frame = Frame::data(id, false, &[value]).unwrap();
                let waiting = model.iter_mut().find(|m| newest && m.3 && m.0 == id);
                let expected = if let Some(waiting) = waiting {
                    waiting.2 = value;
                    Pushed::Replaced
                } else if model.len() == capacity {
                    Pushed::Refused
                } else {
                    model.push((id, i as u64, value, newest));
                    Pushed::Queued
                };
                prop_assert_eq!(queue.push(&frame, newest, 0, 0), expected);
                prop_assert_eq!(queue.len(), model.len());
                if i % 7 == 6 && !model.is_empty() {
                    model.sort_unstable();
                    let first = model.remove(0);
                    let popped = queue.pop().unwrap();
                    prop_assert_eq!((popped.frame.id(), popped.frame.data[0]), (first.0, first.2));
                }
            }
            model.sort_unstable();
            for (id, _, value, _) in model {
                let popped = queue.pop().unwrap();
                prop_assert_eq!((popped.frame.id(), popped.frame.data[0]), (id, value));
            }
            prop_assert!(queue.is_empty());
        }
    }
}
