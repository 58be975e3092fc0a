//! What the master sends by its clock: SYNC with its PDOs, heartbeat, TIME.

use super::Network;
use crate::protocol::cob_id::predefined;
use crate::protocol::io::Outbox;
use ipc_types::payload::CanFrame;

/// A status of 127 nodes takes about a millisecond.
const SYNC_NEAR_NS: u64 = 2_000_000;

impl Network {
    /// The outputs once more before the master ends: synchronous ones behind a last SYNC.
    pub fn last_outputs(&mut self, now_ns: u64, out: &mut Outbox) {
        if self.settings.sync_period_ns.is_some() && !self.bus_off {
            self.next_sync_ns = Some(now_ns);
            self.sync_and_pdos(now_ns, out);
        }
        self.exchange.on_time(now_ns, out);
    }

    /// The SYNC, if it is due, and how late it is: for the beginning of a wake, before frames are taken that waited, and
    /// for the pauses of a long one. Its PDOs are for the caller to ask for, with [`Self::sync_pdos`], when the SYNC is
    /// with the driver: nothing goes before it. A window that ends meanwhile ends in [`Self::on_time`], when what came
    /// inside of it has been taken.
    pub fn sync(&mut self, now_ns: u64, out: &mut Outbox) -> Option<u64> {
        let (at_ns, period_ns) = (self.next_sync_ns?, self.settings.sync_period_ns?);
        if now_ns < at_ns || period_ns == 0 {
            return None;
        }
        let late_ns = now_ns - at_ns;
        let behind = late_ns / period_ns;
        self.counters.syncs_missed += behind;
        self.next_sync_ns = Some(at_ns.saturating_add(period_ns.saturating_mul(behind + 1)));
        let mut frame = CanFrame { can_id: self.settings.sync_cob_id, ..CanFrame::default() };
        if self.settings.sync_overflow > 0 {
            // The counter runs from 1 to the overflow value (CiA 301 V4.2, clause 7.5.2.22).
            self.sync_counter =
                if self.sync_counter >= self.settings.sync_overflow { 1 } else { self.sync_counter + 1 };
            (frame.len, frame.data[0]) = (1, self.sync_counter);
        }
        self.counters.syncs += 1;
        out.push(frame);
        Some(late_ns)
    }

    /// The synchronous PDOs of the SYNC that [`Self::sync`] has just given.
    pub fn sync_pdos(&mut self, now_ns: u64, out: &mut Outbox) {
        self.exchange.sync_pdos(now_ns, out);
    }

    /// Both in one, for callers that send nothing in between.
    pub(super) fn sync_and_pdos(&mut self, now_ns: u64, out: &mut Outbox) {
        if self.sync(now_ns, out).is_some() {
            self.sync_pdos(now_ns, out);
        }
    }

    /// Whether the next SYNC is so near that work which can wait had better wait for it: within 2 ms, and never more
    /// than half the period, so that there is always time behind a SYNC.
    pub fn is_sync_near(&self, now_ns: u64) -> bool {
        let (Some(at_ns), Some(period_ns)) = (self.next_sync_ns, self.settings.sync_period_ns) else {
            return false;
        };
        at_ns.saturating_sub(now_ns) < SYNC_NEAR_NS.min(period_ns / 2)
    }

    pub(super) fn produce(&mut self, now_ns: u64, out: &mut Outbox) {
        if self.next_heartbeat_ns.is_some_and(|at_ns| now_ns >= at_ns) {
            self.next_heartbeat_ns = Some(now_ns.saturating_add(self.settings.heartbeat_ns));
            out.push(CanFrame::classic(
                predefined::ERROR_CONTROL + u32::from(self.settings.node_id),
                &[self.state],
            ));
        }
    }

    /// The TIME message due now, if any: the caller knows the calendar. `ms` since midnight, `days` since 1984-01-01.
    pub fn take_time_due(&mut self, now_ns: u64) -> bool {
        let (Some(at_ns), Some(period_ns)) = (self.next_time_ns, self.settings.time_period_ns) else {
            return false;
        };
        let due = now_ns >= at_ns && !self.bus_off;
        if due {
            self.next_time_ns = Some(now_ns.saturating_add(period_ns));
        }
        due
    }
}
