//! Frames of several buses in one order of time.
//!
//! Each bus keeps its own order, whatever its stamps say. A frame waits until every other bus has a later one, or
//! until none earlier can come any more.

use std::collections::VecDeque;

/// Items that wait at most; beyond that the earliest goes at once.
const LIMIT: usize = 65_536;

/// See the module.
pub struct Merge<T> {
    queues: Vec<VecDeque<(u64, T)>>,
    waiting: usize,
    hold_ns: u64,
}

impl<T> Merge<T> {
    /// So many buses; what is younger than `hold_ns` may still have an earlier one to come.
    pub fn new(buses: usize, hold_ns: u64) -> Self {
        Self { queues: (0..buses).map(|_| VecDeque::new()).collect(), waiting: 0, hold_ns }
    }

    /// Takes an item of a bus.
    pub fn push(&mut self, bus: usize, t_ns: u64, item: T) {
        while self.queues.len() <= bus {
            self.queues.push(VecDeque::new());
        }
        self.queues[bus].push_back((t_ns, item));
        self.waiting += 1;
    }

    /// The next item, if it is certain at this time that it is the next; `u64::MAX` takes what is there.
    pub fn pop(&mut self, now_ns: u64) -> Option<(usize, u64, T)> {
        let heads = self.queues.iter().enumerate().filter_map(|(bus, q)| Some((q.front()?.0, bus)));
        let (t_ns, bus) = heads.min()?;
        let certain = self.queues.iter().all(|q| !q.is_empty())
            || t_ns.saturating_add(self.hold_ns) <= now_ns
            || self.waiting > LIMIT;
        if !certain {
            return None;
        }
        let (t_ns, item) = self.queues[bus].pop_front()?;
        self.waiting -= 1;
        Some((bus, t_ns, item))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn all(merge: &mut Merge<char>, now: u64) -> String {
        std::iter::from_fn(|| merge.pop(now)).map(|(_, _, c)| c).collect()
    }

    #[test]
    fn a_frame_waits_for_earlier_ones_of_other_buses() {
        let mut merge = Merge::new(2, 20);
        merge.push(0, 100, 'a');
        assert_eq!(all(&mut merge, 110), "");
        merge.push(1, 90, 'b');
        assert_eq!(all(&mut merge, 110), "b");
        assert_eq!(all(&mut merge, 120), "a");
        // A bus keeps its order, whatever its stamps say.
        for (bus, t, item) in [(0, 200, 'c'), (0, 190, 'd'), (1, 195, 'e'), (1, 300, 'f')] {
            merge.push(bus, t, item);
        }
        assert_eq!(all(&mut merge, 0), "ecd");
        assert_eq!(all(&mut merge, u64::MAX), "f");
        assert_eq!(merge.waiting, 0);
    }

    #[test]
    fn one_bus_waits_for_nothing_and_nobody_waits_for_ever() {
        let mut one = Merge::new(1, 1000);
        one.push(0, 5, 'x');
        assert_eq!(all(&mut one, 0), "x");
        let mut two = Merge::new(2, u64::MAX);
        for _ in 0..=LIMIT {
            two.push(0, 5, 'x');
        }
        assert_eq!(all(&mut two, 0).len(), 1);
    }
}
