//! Frames handed to a driver that have not been on the bus yet, and the order they will get there. Sans-I/O.
//!
//! A driver sends by identifier, first in first out within one. So frames keep their order exactly if those under way
//! never have a falling identifier: a run of rising ones travels together, a lower one waits until all before it have
//! been seen on the bus.

use dinrail_can::protocol::frame::Frame;
use ipc_types::payload::CanFrame;
use std::collections::VecDeque;

use super::to_frame;

/// Frames under way at most when order counts.
const EXACT_WINDOW: usize = 64;
/// Frames under way at most when it does not.
const LOOSE_WINDOW: usize = 256;

/// What becomes of the order of frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Order {
    /// As given.
    Exact,
    /// As the driver likes: by identifier.
    ByIdentifier,
}

/// See the module.
#[derive(Debug)]
pub struct Flight {
    order: Order,
    waiting: VecDeque<(u32, Frame)>,
    echoed: u64,
    out_of_order: u64,
}

impl Flight {
    pub fn new(order: Order) -> Self {
        Self { order, waiting: VecDeque::with_capacity(LOOSE_WINDOW), echoed: 0, out_of_order: 0 }
    }

    /// Whether a frame may go now.
    pub fn has_room(&self, frame: &CanFrame) -> bool {
        match self.order {
            Order::ByIdentifier => self.waiting.len() < LOOSE_WINDOW,
            Order::Exact => {
                let key = to_frame(frame).arbitration_key();
                self.waiting.len() < EXACT_WINDOW && self.waiting.back().is_none_or(|(last, _)| key >= *last)
            }
        }
    }

    /// A frame went.
    pub fn sent(&mut self, frame: &CanFrame) {
        let frame = to_frame(frame);
        self.waiting.push_back((frame.arbitration_key(), frame));
    }

    /// A frame of the stack was on the bus. Whether it was one of these.
    pub fn seen(&mut self, message: &CanFrame) -> bool {
        let seen = to_frame(message);
        let Some(at) = self.waiting.iter().position(|(_, frame)| *frame == seen) else { return false };
        self.waiting.remove(at);
        self.echoed += 1;
        if at > 0 && self.order == Order::Exact {
            self.out_of_order += 1;
        }
        true
    }

    /// The frame that has waited longest.
    pub fn oldest(&self) -> Option<&Frame> {
        self.waiting.front().map(|(_, frame)| frame)
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
        assert!(!flight.seen(&frame("100#07")));
        for text in ["100#01", "100#02", "200#03", "08000000#04"] {
            assert!(flight.seen(&frame(text)) && !flight.has_room(&frame("100#06")));
        }
        assert!(flight.seen(&frame("7FF#05")) && flight.has_room(&frame("100#06")));
        assert_eq!((flight.len(), flight.echoed(), flight.out_of_order()), (0, 5, 0));
    }

    #[test]
    fn what_overtakes_is_counted() {
        let mut flight = Flight::new(Order::Exact);
        flight.sent(&frame("100#01"));
        flight.sent(&frame("100#02"));
        assert!(flight.seen(&frame("100#02")) && flight.seen(&frame("100#01")));
        assert_eq!((flight.echoed(), flight.out_of_order()), (2, 1));
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
                    queue.push(&to_frame(&frames[next]), false, 0);
                    next += 1;
                }
                if queue.is_empty() {
                    break;
                }
                for _ in 0..pace[step % pace.len()].max(usize::from(step % 7 == 0)) {
                    if let Some(waiting) = queue.pop() {
                        prop_assert!(flight.seen(&from_frame(&waiting.frame)));
                        out.push(waiting.frame);
                    }
                }
            }
            prop_assert_eq!(out, frames.iter().map(to_frame).collect::<Vec<_>>());
            prop_assert_eq!((flight.len(), flight.out_of_order()), (0, 0));
        }
    }
}
