//! Frames handed to a driver that have not been on the bus yet, and the order they will get there. Sans-I/O.
//!
//! A driver sends by identifier, first in first out within one. So frames keep their order exactly if those under way
//! never have a falling identifier: a run of rising ones travels together, a lower one waits until all before it have
//! been seen on the bus.

use dinrail_can::protocol::frame::Frame;
use ipc_types::payload::CanFrame;
use std::collections::{HashSet, VecDeque};
use std::hash::{DefaultHasher, Hash, Hasher};

use super::to_frame;

/// Frames under way at most when order counts.
const EXACT_WINDOW: usize = 64;
/// Frames under way at most when it does not.
const LOOSE_WINDOW: usize = 256;
/// Different frames that are remembered once they were seen.
const MAX_CONTENTS: usize = 65_536;

/// What becomes of the order of frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Order {
    /// As given.
    Exact,
    /// As the driver likes: by identifier.
    ByIdentifier,
}

/// What a frame that the stack had sent was.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Sight {
    /// One of these, in its turn.
    Ours,
    /// Equal to one of these whose turn it is not: somebody else's, or ours out of order.
    Early,
    /// Equal to one that was sent, with none left to be seen: somebody else's.
    Equal,
    /// None of these.
    Other,
}

#[derive(Debug)]
struct Waiting {
    key: u32,
    frame: Frame,
    /// How often an equal frame was seen before its turn.
    early: u64,
}

/// See the module.
#[derive(Debug)]
pub struct Flight {
    order: Order,
    waiting: VecDeque<Waiting>,
    contents: HashSet<u64>,
    echoed: u64,
    out_of_order: u64,
    equal: u64,
    first_early: Option<Frame>,
}

impl Flight {
    pub fn new(order: Order) -> Self {
        Self {
            order,
            waiting: VecDeque::with_capacity(LOOSE_WINDOW),
            contents: HashSet::new(),
            echoed: 0,
            out_of_order: 0,
            equal: 0,
            first_early: None,
        }
    }

    /// Whether a frame may go now.
    pub fn has_room(&self, frame: &CanFrame) -> bool {
        match self.order {
            Order::ByIdentifier => self.waiting.len() < LOOSE_WINDOW,
            Order::Exact => {
                let key = to_frame(frame).arbitration_key();
                self.waiting.len() < EXACT_WINDOW && self.waiting.back().is_none_or(|last| key >= last.key)
            }
        }
    }

    /// A frame went.
    pub fn sent(&mut self, frame: &CanFrame) {
        let frame = to_frame(frame);
        if self.contents.len() < MAX_CONTENTS {
            self.contents.insert(content(&frame));
        }
        self.waiting.push_back(Waiting { key: frame.arbitration_key(), frame, early: 0 });
    }

    /// A frame of the stack was on the bus.
    ///
    /// An echo does not tell for certain which process sent it. So when order counts a frame is taken for ours only in its
    /// turn; an equal one before that may be somebody else's and is remembered: see [`Self::accept_early`].
    pub fn seen(&mut self, message: &CanFrame) -> Sight {
        let seen = to_frame(message);
        match self.waiting.iter().position(|w| w.frame == seen) {
            Some(at) if at > 0 && self.order == Order::Exact => {
                self.waiting[at].early += 1;
                Sight::Early
            }
            Some(at) => {
                // Seen in its turn: what was seen before was not it.
                self.equal += self.waiting.remove(at).map_or(0, |w| w.early);
                self.echoed += 1;
                Sight::Ours
            }
            None if self.contents.contains(&content(&seen)) => {
                self.equal += 1;
                Sight::Equal
            }
            None => Sight::Other,
        }
    }

    /// A frame was on the bus that certainly another process of the stack sent.
    pub fn seen_of_another(&mut self, message: &CanFrame) {
        self.equal += u64::from(self.contents.contains(&content(&to_frame(message))));
    }

    /// Whether it is the turn of a frame that was seen, but earlier.
    pub fn is_early(&self) -> bool {
        self.waiting.front().is_some_and(|w| w.early > 0)
    }

    /// It was not seen in its turn: what was seen early was it, out of order.
    pub fn accept_early(&mut self) {
        if !self.is_early() {
            return;
        }
        if let Some(first) = self.waiting.pop_front() {
            self.echoed += 1;
            self.out_of_order += 1;
            self.equal += first.early.saturating_sub(1);
            self.first_early.get_or_insert(first.frame);
        }
    }

    /// The frame that has waited longest.
    pub fn oldest(&self) -> Option<&Frame> {
        self.waiting.front().map(|w| &w.frame)
    }

    /// Frames that have not been seen.
    pub fn len(&self) -> usize {
        self.waiting.len()
    }

    /// Frames that were seen.
    pub fn echoed(&self) -> u64 {
        self.echoed
    }

    /// Of these, before one that was given earlier.
    pub fn out_of_order(&self) -> u64 {
        self.out_of_order
    }

    /// The first of [`Self::out_of_order`].
    pub fn first_out_of_order(&self) -> Option<&Frame> {
        self.first_early.as_ref()
    }

    /// Frames equal to these that somebody else of the stack sent meanwhile. Of the first [`MAX_CONTENTS`] different
    /// frames.
    pub fn equal(&self) -> u64 {
        self.equal
    }
}

/// A hash of the whole frame.
fn content(frame: &Frame) -> u64 {
    let mut hasher = DefaultHasher::new();
    (frame.can_id, frame.len, frame.fd, frame.payload()).hash(&mut hasher);
    hasher.finish()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::commands::can::from_frame;
    use dinrail_can::protocol::candump::parse;
    use dinrail_can::txqueue::TxQueue;
    use proptest::prelude::*;

    fn frame(text: &str) -> CanFrame {
        from_frame(&parse(text).unwrap())
    }

    #[test]
    fn rising_identifiers_travel_together() {
        let mut flight = Flight::new(Order::Exact);
        for text in ["100#01", "100#02", "200#03", "08000000#04", "7FF#05"] {
            assert!(flight.has_room(&frame(text)), "{text}");
            flight.sent(&frame(text));
        }
        assert!(!flight.has_room(&frame("100#06")));
        // Not ours: other data.
        assert_eq!(flight.seen(&frame("100#07")), Sight::Other);
        for text in ["100#01", "100#02", "200#03", "08000000#04"] {
            assert!(flight.seen(&frame(text)) == Sight::Ours && !flight.has_room(&frame("100#06")));
        }
        assert!(flight.seen(&frame("7FF#05")) == Sight::Ours && flight.has_room(&frame("100#06")));
        assert_eq!((flight.len(), flight.echoed(), flight.out_of_order()), (0, 5, 0));
    }

    /// Sends the first list, sees the second: what was seen, and the counts echoed, out of order, equal.
    fn flown(order: Order, sent: &str, seen: &str) -> (String, [u64; 3]) {
        let mut flight = Flight::new(order);
        sent.split(' ').for_each(|text| flight.sent(&frame(text)));
        let sights = seen.split(' ').map(|text| match flight.seen(&frame(text)) {
            Sight::Ours => 'o',
            Sight::Early => 'e',
            Sight::Equal => '=',
            Sight::Other => '-',
        });
        let sights = sights.collect();
        while flight.is_early() {
            flight.accept_early();
        }
        (sights, [flight.echoed(), flight.out_of_order(), flight.equal()])
    }

    #[test]
    fn what_overtakes_is_counted_apart_from_equal_frames_of_others() {
        for (sent, seen, sights, counts) in [
            ("100#01 100#02", "100#01 100#02", "oo", [2, 0, 0]),
            // Ours, the other way round.
            ("100#01 100#02", "100#02 100#01", "eo", [2, 1, 0]),
            // Somebody else's between ours, before ours and behind ours.
            ("100#01 100#02", "100#02 100#01 100#02", "eoo", [2, 0, 1]),
            ("100#01 100#02", "100#01 100#01 100#02 100#02", "o=o=", [2, 0, 2]),
            ("100#01 100#02", "100#02 100#02 100#01", "eeo", [2, 1, 1]),
            ("100#01 100#01", "100#01 100#01 100#01", "oo=", [2, 0, 1]),
            // Not seen at all, and something else.
            ("100#01 100#02", "100#02 101#02", "e-", [0, 0, 0]),
        ] {
            assert_eq!(flown(Order::Exact, sent, seen), (sights.to_owned(), counts), "{sent} | {seen}");
        }
        assert_eq!(
            flown(Order::ByIdentifier, "200#01 100#01", "100#01 200#01 100#01"),
            ("oo=".to_owned(), [2, 0, 1])
        );
    }

    #[test]
    fn the_memory_for_frames_has_a_limit() {
        let mut flight = Flight::new(Order::ByIdentifier);
        for i in 0..=MAX_CONTENTS as u32 {
            let frame = CanFrame::classic(0x100, &i.to_le_bytes());
            flight.sent(&frame);
            assert_eq!(flight.seen(&frame), Sight::Ours);
        }
        assert_eq!(flight.contents.len(), MAX_CONTENTS);
        assert_eq!(flight.seen(&CanFrame::classic(0x100, &[0; 4])), Sight::Equal);
    }

    proptest! {
        /// Through the driver's own queue, drained at any pace.
        #[test]
        fn the_order_is_exact(
            ids in prop::collection::vec((0u32..5, any::<bool>(), any::<bool>()), 1..300),
            pace in prop::collection::vec(0usize..4, 1..50),
        ) {
            let frames: Vec<CanFrame> = ids.iter().enumerate().map(|(i, (id, extended, remote))| {
                let data = (i as u32).to_le_bytes();
                let frame = if *remote { Frame::remote(*id, *extended, (i % 9) as u8) } else { Frame::data(*id, *extended, &data) };
                from_frame(&frame.unwrap())
            }).collect();
            let (mut flight, mut queue, mut out) = (Flight::new(Order::Exact), TxQueue::new(512), Vec::new());
            let mut next = 0;
            for step in 0.. {
                while next < frames.len() && flight.has_room(&frames[next]) {
                    flight.sent(&frames[next]);
                    queue.push(&to_frame(&frames[next]), false, 0, 0);
                    next += 1;
                }
                if queue.is_empty() {
                    break;
                }
                for _ in 0..pace[step % pace.len()].max(usize::from(step % 7 == 0)) {
                    if let Some(waiting) = queue.pop() {
                        prop_assert_eq!(flight.seen(&from_frame(&waiting.frame)), Sight::Ours);
                        out.push(waiting.frame);
                    }
                }
            }
            prop_assert_eq!(out, frames.iter().map(to_frame).collect::<Vec<_>>());
            prop_assert_eq!((flight.len(), flight.out_of_order()), (0, 0));
        }
    }
}
