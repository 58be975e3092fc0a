//! Counts the events of the service that the stack file names as trigger: which are new, which no scan was
//! triggered by, and how long none came.

use ipc_types::scan_record::{Source, Trigger};

/// Counters since the start of the service.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct WatchCounters {
    /// Scans that an event triggered.
    pub events: u64,
    /// Events that triggered none, because another came before the next scan.
    pub missed: u64,
    /// Scans in which no event had come for `max_interval`.
    pub overdue: u64,
}

/// See the module. It has no clock: times are handed in.
#[derive(Debug, Clone, Default)]
pub(super) struct Watch {
    /// Index of the service among the input sources.
    pub at: usize,
    max_interval_ns: u64,
    known: bool,
    /// Events of this generation of the service up to and with this one are done with.
    generation: u32,
    done: u64,
    last_ns: u64,
    pub counters: WatchCounters,
}

impl Watch {
    pub(super) fn new(at: usize, max_interval_ns: u64) -> Self {
        Self { at, max_interval_ns, ..Self::default() }
    }

    /// Events so far count as done with: the first scan runs anyway.
    pub(super) fn begin(&mut self, now_ns: u64, source: &Source, samples: u64) {
        self.look(source, samples);
        self.done = samples;
        self.last_ns = now_ns;
    }

    /// The implicit task runs in this scan for another reason.
    pub(super) fn started(&mut self, now_ns: u64) {
        self.last_ns = now_ns;
    }

    /// New events, when the newest message of the service carries this count. Generation 0: it never sent one.
    ///
    /// Of a service that was there before this one only what follows is new; of its next generation everything is.
    pub(super) fn look(&mut self, source: &Source, samples: u64) -> u64 {
        if source.generation == 0 || source.generation < self.generation {
            return 0;
        }
        if source.generation > self.generation {
            self.done = if self.known { 0 } else { samples };
            (self.generation, self.known) = (source.generation, true);
        }
        samples.saturating_sub(self.done)
    }

    /// What triggers the scan of now, if anything does.
    pub(super) fn take(&mut self, now_ns: u64, source: &Source, samples: u64) -> Option<Trigger> {
        let new = self.look(source, samples);
        let overdue = new == 0;
        if overdue && now_ns < self.due_ns() {
            return None;
        }
        let missed = new.saturating_sub(1);
        self.last_ns = now_ns;
        self.counters.missed += missed;
        if overdue {
            self.counters.overdue += 1;
        } else {
            self.counters.events += 1;
            self.done = samples;
        }
        Some(Trigger { source: *source, count: samples, missed, overdue })
    }

    /// When a scan is due without any event.
    pub(super) fn due_ns(&self) -> u64 {
        self.last_ns.saturating_add(self.max_interval_ns)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: u64 = 1_000_000;

    fn from(generation: u32) -> Source {
        Source { writer: 3, generation, seq: 9 }
    }

    #[test]
    fn each_event_triggers_one_scan_and_missed_ones_are_counted() {
        let mut watch = Watch::new(0, 100 * MS);
        let mut take = |t_ms: u64, generation, samples| {
            watch.take(t_ms * MS, &from(generation), samples).map(|t| (t.count, t.missed, t.overdue))
        };
        assert_eq!(take(1, 0, 0), None);
        // It ran long before this engine: only what follows is new.
        assert_eq!(take(2, 1, 500), None);
        assert_eq!(take(3, 1, 501), Some((501, 0, false)));
        assert_eq!(take(4, 1, 501), None);
        assert_eq!(take(5, 1, 505), Some((505, 3, false)));
        // A restart counts from the first; a message of the old generation says nothing.
        assert_eq!(take(6, 2, 2), Some((2, 1, false)));
        assert_eq!(take(7, 1, 506), None);
        assert_eq!(take(8, 2, 3), Some((3, 0, false)));
        assert_eq!(watch.counters, WatchCounters { events: 4, missed: 4, overdue: 0 });
    }

    #[test]
    fn without_events_a_scan_is_due_after_the_longest_interval() {
        let mut watch = Watch::new(0, 100 * MS);
        watch.begin(10 * MS, &from(1), 7);
        assert_eq!(watch.due_ns(), 110 * MS);
        assert_eq!(watch.take(109 * MS, &from(1), 7), None);
        let overdue = Trigger { source: from(1), count: 7, missed: 0, overdue: true };
        assert_eq!(watch.take(110 * MS, &from(1), 7), Some(overdue));
        assert_eq!(watch.take(209 * MS, &from(1), 7), None);
        watch.started(200 * MS);
        assert_eq!(watch.take(299 * MS, &from(1), 7), None);
        assert_eq!(watch.take(299 * MS, &from(1), 8).map(|t| t.overdue), Some(false));
        assert_eq!(watch.due_ns(), 399 * MS);
        assert_eq!(watch.counters, WatchCounters { events: 1, missed: 0, overdue: 1 });
    }
}
