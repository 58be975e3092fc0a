//! Frames on their way to a bus driver: what `<can>/tx` has no room for waits here, in order, within a limit.
//!
//! For services whose frames must go out in the order they were made (CANopen). Where only the newest value counts, a
//! refused frame is better made anew.

use crate::payload::CanFrame;
use crate::port::{Publisher, SendError};
use std::collections::VecDeque;

/// A full queue of the driver is tried again after this time.
pub const RETRY_NS: u64 = 1_000_000;

/// What became of the frames that waited.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Handed {
    /// They are with the driver, or wait on.
    On,
    /// Nobody reads `<can>/tx`: the driver is down, and old frames are of no use to anybody. All were dropped.
    Dropped,
}

/// See the module. Allocates nothing after [`CanQueue::new`].
#[derive(Debug)]
pub struct CanQueue {
    waiting: VecDeque<CanFrame>,
    limit: usize,
    dropped: u64,
}

impl CanQueue {
    /// At most `limit` frames wait; those that come then are dropped and counted.
    pub fn new(limit: usize) -> Self {
        Self { waiting: VecDeque::with_capacity(limit), limit, dropped: 0 }
    }

    /// Puts frames behind those that wait.
    pub fn add(&mut self, frames: impl IntoIterator<Item = CanFrame>) {
        for frame in frames {
            if self.waiting.len() < self.limit {
                self.waiting.push_back(frame);
            } else {
                self.dropped += 1;
            }
        }
    }

    /// Hands frames to the driver and wakes it; `sent` is told each that it took. An error other than a full queue and
    /// a missing driver costs the frame it is about; the others wait for the next call.
    pub fn send(
        &mut self,
        tx: &mut Publisher<CanFrame>,
        sent: impl FnMut(&CanFrame),
    ) -> Result<Handed, SendError> {
        let before = tx.next_seq();
        let handed = self.hand(|frame| tx.send(*frame).map(|_| ()), sent);
        if tx.next_seq() != before {
            tx.ring();
        }
        handed
    }

    fn hand(
        &mut self,
        mut send: impl FnMut(&CanFrame) -> Result<(), SendError>,
        mut sent: impl FnMut(&CanFrame),
    ) -> Result<Handed, SendError> {
        while let Some(frame) = self.waiting.front() {
            match send(frame) {
                Ok(()) => {
                    sent(frame);
                    self.waiting.pop_front();
                }
                Err(SendError::NoReader(_)) => {
                    self.dropped += self.waiting.len() as u64;
                    self.waiting.clear();
                    return Ok(Handed::Dropped);
                }
                Err(SendError::Full(_)) => break,
                Err(e) => {
                    self.dropped += 1;
                    self.waiting.pop_front();
                    return Err(e);
                }
            }
        }
        Ok(Handed::On)
    }

    /// Frames that wait.
    pub fn len(&self) -> usize {
        self.waiting.len()
    }
    pub fn is_empty(&self) -> bool {
        self.waiting.is_empty()
    }
    /// Frames that were never sent.
    pub fn dropped(&self) -> u64 {
        self.dropped
    }
    /// When to call [`Self::send`] again; `None`: nothing waits.
    pub fn next_deadline(&self, now_ns: u64) -> Option<u64> {
        (!self.waiting.is_empty()).then(|| now_ns.saturating_add(RETRY_NS))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frames(ids: std::ops::Range<u32>) -> impl Iterator<Item = CanFrame> {
        ids.map(|id| CanFrame::classic(id, &[]))
    }

    fn full() -> SendError {
        SendError::Full("can0/tx".to_owned())
    }

    fn no_reader() -> SendError {
        SendError::NoReader("can0/tx".to_owned())
    }

    /// Hands over with a driver that takes `room` frames, then answers `then`.
    fn hand(
        queue: &mut CanQueue,
        mut room: usize,
        then: fn() -> SendError,
    ) -> (Result<Handed, SendError>, Vec<u32>) {
        let mut taken = Vec::new();
        let send = |_: &CanFrame| {
            room = room.checked_sub(1).ok_or_else(then)?;
            Ok(())
        };
        (queue.hand(send, |frame| taken.push(frame.id())), taken)
    }

    #[test]
    fn what_finds_no_room_waits_in_order() {
        let mut queue = CanQueue::new(4);
        queue.add(frames(1..4));
        assert_eq!(hand(&mut queue, 2, full), (Ok(Handed::On), vec![1, 2]));
        assert_eq!((queue.len(), queue.next_deadline(7)), (1, Some(7 + RETRY_NS)));
        // Behind the one that waits; what is above the limit is dropped and counted.
        queue.add(frames(4..9));
        assert_eq!((queue.len(), queue.dropped()), (4, 2));
        assert_eq!(hand(&mut queue, 9, full), (Ok(Handed::On), vec![3, 4, 5, 6]));
        assert!(queue.is_empty());
        assert_eq!(queue.next_deadline(7), None);
    }

    #[test]
    fn without_a_driver_frames_are_dropped() {
        let mut queue = CanQueue::new(4);
        queue.add(frames(1..3));
        assert_eq!(hand(&mut queue, 0, no_reader), (Ok(Handed::Dropped), vec![]));
        assert_eq!((queue.len(), queue.dropped()), (0, 2));
        // Nothing to hand over: nobody notices that the driver is away.
        assert_eq!(hand(&mut queue, 0, no_reader), (Ok(Handed::On), vec![]));
    }

    #[test]
    fn a_frame_that_cannot_be_sent_does_not_hold_up_the_others() {
        let broken = || SendError::Middleware { topic: "can0/tx".to_owned(), cause: "x".to_owned() };
        let mut queue = CanQueue::new(4);
        queue.add(frames(1..4));
        assert_eq!(hand(&mut queue, 1, broken), (Err(broken()), vec![1]));
        assert_eq!(hand(&mut queue, 9, broken), (Ok(Handed::On), vec![3]));
        assert_eq!(queue.dropped(), 1);
    }
}
