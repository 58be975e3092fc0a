//! SYNC: producer and consumer, counter (1019h), window (1007h) (CiA 301 V4.2, 7.2.5).
//!
//! The producer stays on the grid of its first SYNC: lateness of a caller never adds up.

use ipc_types::payload::CanFrame;

use super::cob_id::{BIT_31, CobId};
use super::io::Outbox;

/// Largest synchronous counter overflow value (CiA 301 V4.2, 7.5.2.22).
pub const COUNTER_MAX: u8 = 240;

/// The objects that rule SYNC.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SyncParams {
    /// 1005h: identifier; bit 30 = produce.
    pub cob: CobId,
    /// 1006h communication cycle period in us; 0 = no production, no supervision.
    pub period_us: u32,
    /// 1007h synchronous window length in us; 0 = no window.
    pub window_us: u32,
    /// 1019h synchronous counter overflow value: 0 = no counter, 2-240.
    pub overflow: u8,
}

impl Default for SyncParams {
    fn default() -> Self {
        // Without 1005h there is no SYNC: bit 31 stands for that here.
        Self { cob: CobId(BIT_31), period_us: 0, window_us: 0, overflow: 0 }
    }
}

impl SyncParams {
    pub fn produces(&self) -> bool {
        self.cob.exists() && self.cob.bit30() && self.period_us > 0
    }
    fn period_ns(&self) -> u64 {
        u64::from(self.period_us) * 1000
    }
}

/// What SYNC did.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SyncEvent {
    /// A SYNC, received or produced. `counter`: 1-240, 0 without counter.
    Sync { counter: u8 },
    /// A SYNC whose length does not fit 1019h; it does not count (EMCY 8240h).
    Length { got: u8, expected: u8 },
    /// No SYNC for one and a half periods.
    Timeout,
    /// SYNC is there again after a timeout.
    Resolved,
}

/// Producer and consumer in one: a device is either.
#[derive(Debug, Clone, Default)]
pub struct Sync {
    params: SyncParams,
    counter: u8,
    next_ns: Option<u64>,
    /// When the window of the last SYNC closes.
    window_ends_ns: Option<u64>,
    seen: bool,
    timeout_ns: Option<u64>,
    timed_out: bool,
}

impl Sync {
    pub fn params(&self) -> &SyncParams {
        &self.params
    }
    /// Takes new parameters. The first SYNC of a producer goes out one period later (within one cycle: 7.5.2.5).
    pub fn configure(&mut self, t_ns: u64, params: SyncParams) {
        let old = std::mem::replace(&mut self.params, params);
        if params.overflow != old.overflow {
            self.counter = 0;
        }
        if !params.produces() {
            self.next_ns = None;
        } else if !old.produces() || old.period_us != params.period_us {
            if !old.produces() {
                self.counter = 0;
            }
            self.next_ns = Some(t_ns.saturating_add(params.period_ns()));
        }
        if params.produces() || params.period_us == 0 || !params.cob.exists() {
            self.forget();
        } else if params.period_us != old.period_us || params.cob != old.cob {
            // What was awaited by the old period or identifier is awaited no more.
            self.forget();
        }
        if params.window_us == 0 {
            self.window_ends_ns = None;
        }
    }
    /// The counter starts at 1 again: the node left the state stopped or initialisation (7.5.2.22).
    pub fn restart_counter(&mut self) {
        self.counter = 0;
    }
    /// Supervision starts anew with the next SYNC.
    pub fn forget(&mut self) {
        self.seen = false;
        self.timeout_ns = None;
        self.timed_out = false;
    }
    /// Is SYNC missing?
    pub fn is_timed_out(&self) -> bool {
        self.timed_out
    }
    /// May a synchronous PDO still be handled at `t_ns` (7.5.2.7)?
    pub fn in_window(&self, t_ns: u64) -> bool {
        self.window_ends_ns.is_none_or(|end| t_ns <= end)
    }
    /// A frame of the bus, if it is a SYNC of others. A producer ignores others' SYNCs.
    pub fn on_frame(&mut self, t_ns: u64, frame: &CanFrame) -> Option<SyncEvent> {
        if frame.is_remote()
            || !self.params.cob.exists()
            || !self.params.cob.matches(frame)
            || self.params.produces()
        {
            return None;
        }
        let expected = u8::from(self.params.overflow > 0);
        let data = frame.payload();
        if data.len() != usize::from(expected) {
            return Some(SyncEvent::Length { got: frame.len, expected });
        }
        self.happened(t_ns);
        if self.params.period_us > 0 {
            let limit = self.params.period_ns() + self.params.period_ns() / 2;
            self.seen = true;
            self.timeout_ns = Some(t_ns.saturating_add(limit));
        }
        Some(SyncEvent::Sync { counter: data.first().copied().unwrap_or(0) })
    }
    /// After a SYNC: was it the first after a timeout?
    pub fn take_resolved(&mut self) -> Option<SyncEvent> {
        (self.timed_out && self.timeout_ns.is_some()).then(|| {
            self.timed_out = false;
            SyncEvent::Resolved
        })
    }
    fn happened(&mut self, t_ns: u64) {
        let window_ns = u64::from(self.params.window_us) * 1000;
        self.window_ends_ns = (window_ns > 0).then(|| t_ns.saturating_add(window_ns));
    }
    pub fn next_deadline(&self) -> Option<u64> {
        match (self.next_ns, self.timeout_ns) {
            (Some(a), Some(b)) => Some(a.min(b)),
            (a, b) => a.or(b),
        }
    }
    /// Produces a SYNC that is due, or tells that one is missing. `allowed`: the NMT state lets SYNC out.
    pub fn on_time(&mut self, t_ns: u64, allowed: bool, out: &mut Outbox) -> Option<SyncEvent> {
        if self.timeout_ns.is_some_and(|due| t_ns >= due) {
            self.timeout_ns = None;
            let first = !std::mem::replace(&mut self.timed_out, true);
            return first.then_some(SyncEvent::Timeout);
        }
        let due = self.next_ns.filter(|&due| t_ns >= due)?;
        let period = self.params.period_ns();
        // Missed periods are skipped, never caught up.
        let missed = (t_ns - due) / period;
        self.next_ns = Some(due.saturating_add(period.saturating_mul(missed + 1)));
        if !allowed {
            return None;
        }
        self.happened(t_ns);
        if self.params.overflow > 0 {
            self.counter = if self.counter >= self.params.overflow { 1 } else { self.counter + 1 };
            out.push(self.params.cob.frame(&[self.counter]));
        } else {
            out.push(self.params.cob.frame(&[]));
        }
        Some(SyncEvent::Sync { counter: if self.params.overflow > 0 { self.counter } else { 0 } })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    const MS: u64 = 1_000_000;

    fn produce(overflow: u8) -> SyncParams {
        SyncParams { cob: CobId(0x4000_0080), period_us: 10_000, window_us: 0, overflow }
    }

    #[test]
    fn producer_counts_and_keeps_its_grid() {
        let mut out = Outbox::default();
        let mut sync = Sync::default();
        sync.configure(0, produce(3));
        for late in [0u64, 3, 9, 1, 0] {
            let due = sync.next_deadline().unwrap();
            assert_eq!(due % (10 * MS), 0);
            assert!(sync.on_time(due + late * MS, true, &mut out).is_some());
        }
        let counters: Vec<_> = out.drain().map(|frame| frame.payload().to_vec()).collect();
        assert_eq!(counters, [[1], [2], [3], [1], [2]]);
        // 55 ms late: five periods are skipped.
        sync.on_time(115 * MS, true, &mut out);
        assert_eq!(sync.next_deadline(), Some(120 * MS));
        assert_eq!(out.drain().count(), 1);
        sync.restart_counter();
        sync.on_time(120 * MS, false, &mut out);
        assert!(out.is_empty(), "not in stopped");
        assert_eq!(sync.on_time(130 * MS, true, &mut out), Some(SyncEvent::Sync { counter: 1 }));
        sync.configure(130 * MS, SyncParams { cob: CobId(0x80), ..produce(3) });
        assert_eq!(sync.next_deadline(), None);
    }

    #[test]
    fn consumer_checks_length_window_and_presence() {
        let mut out = Outbox::default();
        let mut sync = Sync::default();
        let cob = CobId(0x80);
        sync.configure(0, SyncParams { cob, period_us: 10_000, window_us: 2_000, overflow: 4 });
        assert_eq!(sync.next_deadline(), None, "supervision starts with the first SYNC");
        assert_eq!(sync.on_frame(0, &cob.frame(&[])), Some(SyncEvent::Length { got: 0, expected: 1 }));
        assert_eq!(sync.on_frame(MS, &cob.frame(&[4])), Some(SyncEvent::Sync { counter: 4 }));
        assert!(sync.in_window(3 * MS) && !sync.in_window(3 * MS + 1));
        assert_eq!(sync.next_deadline(), Some(16 * MS));
        assert_eq!(sync.on_time(16 * MS, true, &mut out), Some(SyncEvent::Timeout));
        assert_eq!(sync.on_time(17 * MS, true, &mut out), None);
        assert_eq!(sync.on_frame(20 * MS, &cob.frame(&[1])), Some(SyncEvent::Sync { counter: 1 }));
        assert_eq!(sync.take_resolved(), Some(SyncEvent::Resolved));
        assert_eq!(sync.take_resolved(), None);
        assert_eq!(sync.on_frame(21 * MS, &cob.remote(0)), None);
        assert!(out.is_empty());
    }

    #[test]
    fn a_slower_sync_is_not_missed_by_the_period_of_before() {
        let mut out = Outbox::default();
        let mut sync = Sync::default();
        let params = SyncParams { cob: CobId(0x80), period_us: 10_000, window_us: 0, overflow: 0 };
        sync.configure(0, params);
        sync.on_frame(MS, &params.cob.frame(&[]));
        sync.configure(2 * MS, params);
        assert_eq!(sync.next_deadline(), Some(16 * MS), "the same again changes nothing");
        let slower = SyncParams { period_us: 100_000, ..params };
        sync.configure(2 * MS, slower);
        assert_eq!((sync.next_deadline(), sync.on_time(16 * MS, true, &mut out)), (None, None));
        sync.on_frame(101 * MS, &params.cob.frame(&[]));
        assert_eq!(sync.next_deadline(), Some(251 * MS));
        // Nor by an identifier that nobody sends any more.
        sync.configure(102 * MS, SyncParams { cob: CobId(0x90), ..slower });
        assert_eq!(sync.next_deadline(), None);
    }
}
