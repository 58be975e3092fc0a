//! Received values of one PDO, each of which shall reach exactly one scan, in order. Sans-I/O.
//!
//! One value at a time is shown in the inputs; it gives way to the next only when a scan that ran a task took its
//! inputs after it was sent. Until then values wait in a ring of fixed size; when that is full the oldest of them is
//! dropped and counted. The shown value cannot be dropped: a scan may be looking at it.

use super::PDO_BYTES;

/// What became of the value that the inputs show.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Shown {
    /// A scan took it, or there was none yet.
    Taken,
    /// It is in the inputs, which have not been sent since.
    Unsent,
    /// It was sent at this time at the latest.
    Sent(u64),
}

/// See the module.
#[derive(Debug, Clone)]
pub(super) struct Queue {
    ring: Box<[[u8; PDO_BYTES]]>,
    first: usize,
    waiting: usize,
    shown: Shown,
    most: usize,
    dropped: u64,
}

/// A queue as the status shows it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
pub struct QueueState {
    pub node: u8,
    pub cob_id: u32,
    /// Values that can wait.
    pub size: usize,
    /// Values that wait for a scan, without the one that the inputs show.
    pub waiting: usize,
    /// Most that ever waited.
    pub most: usize,
    /// Values that were never shown, because the queue was full.
    pub dropped: u64,
}

impl Queue {
    /// With room for `size` values that wait; the only allocation.
    pub(super) fn new(size: usize) -> Self {
        let ring = vec![[0; PDO_BYTES]; size.max(1)].into();
        Self { ring, first: 0, waiting: 0, shown: Shown::Taken, most: 0, dropped: 0 }
    }

    /// A value was received. True when it is to be shown now; otherwise it waits.
    pub(super) fn push(&mut self, data: [u8; PDO_BYTES]) -> bool {
        if self.shown == Shown::Taken {
            self.shown = Shown::Unsent;
            return true;
        }
        let size = self.ring.len();
        if self.waiting == size {
            self.first = (self.first + 1) % size;
            self.waiting -= 1;
            self.dropped += 1;
        }
        if let Some(place) = self.ring.get_mut((self.first + self.waiting) % size) {
            *place = data;
        }
        self.waiting += 1;
        self.most = self.most.max(self.waiting);
        false
    }

    /// The inputs were sent, and were with the readers at this time.
    pub(super) fn sent(&mut self, t_ns: u64) {
        if self.shown == Shown::Unsent {
            self.shown = Shown::Sent(t_ns);
        }
    }

    /// A scan that ran a task took its inputs after this time. The value to be shown now, if it is another.
    pub(super) fn scanned(&mut self, inputs_t_ns: u64) -> Option<[u8; PDO_BYTES]> {
        let Shown::Sent(sent_ns) = self.shown else { return None };
        if inputs_t_ns <= sent_ns {
            return None;
        }
        if self.waiting == 0 {
            self.shown = Shown::Taken;
            return None;
        }
        let data = self.ring.get(self.first).copied();
        self.first = (self.first + 1) % self.ring.len();
        self.waiting -= 1;
        self.shown = Shown::Unsent;
        data
    }

    pub(super) fn state(&self, node: u8, cob_id: u32) -> QueueState {
        let Self { waiting, most, dropped, .. } = *self;
        QueueState { node, cob_id, size: self.ring.len(), waiting, most, dropped }
    }
}
