//! One TPDO.

use super::mapping::Mapping;
use super::rpdo::SYNCHRONOUS_MAX;
use super::{Communication, Direction};
use crate::protocol::emcy::INHIBIT_UNIT_NS;
use crate::protocol::error_control::MS;
use crate::protocol::io::Outbox;
use crate::protocol::od::ObjectDictionary;
use ipc_types::payload::can_flag;

/// Transmission types of a TPDO (CiA 301 V4.2, 7.5.2.37, table 76).
mod kind {
    pub const SYNC_ACYCLIC: u8 = 0;
    pub const RTR_SYNC: u8 = 252;
    pub const EVENT: u8 = 254;
}

/// One TPDO.
#[derive(Debug, Clone)]
pub struct Tpdo {
    /// 0-based: 1800h is 0.
    pub number: u16,
    pub(super) communication: Communication,
    pub(super) mapping: Mapping,
    /// An event waits for SYNC (type 0) or for the end of the inhibit time (254, 255).
    event: bool,
    /// Several objects change as one, and this PDO maps some of them.
    marked: bool,
    /// Of type 252: what the last SYNC sampled.
    sample: Option<[u8; 8]>,
    inhibited_until_ns: u64,
    event_timer_ns: Option<u64>,
    /// Type 1-240: SYNCs since the last transmission.
    syncs: u8,
    /// Type 1-240: waits for the SYNC start value.
    awaits_start: bool,
}

impl Tpdo {
    pub fn new(od: &ObjectDictionary, number: u16) -> Self {
        let mut tpdo = Self {
            number,
            communication: Communication::load(od, Direction::Transmit.communication(number)),
            mapping: Mapping::default(),
            event: false,
            marked: false,
            sample: None,
            inhibited_until_ns: 0,
            event_timer_ns: None,
            syncs: 0,
            awaits_start: false,
        };
        tpdo.load(od);
        tpdo
    }
    /// Reads the parameters again. A mapping that is not right (a bad default in an EDS) maps nothing.
    pub fn load(&mut self, od: &ObjectDictionary) {
        self.communication = Communication::load(od, Direction::Transmit.communication(self.number));
        let index = Direction::Transmit.mapping(self.number);
        self.mapping =
            Mapping::load(od, index, od.u8(index, 0).unwrap_or(0), Direction::Transmit).unwrap_or_default();
    }
    pub fn is_active(&self) -> bool {
        self.communication.cob.exists() && !self.mapping.is_empty()
    }
    fn is_event_driven(&self) -> bool {
        self.communication.transmission_type >= kind::EVENT
    }
    fn is_cyclic(&self) -> bool {
        (1..=SYNCHRONOUS_MAX).contains(&self.communication.transmission_type)
    }
    /// The node leaves operational, or the parameters changed.
    pub fn quiet(&mut self) {
        self.event = false;
        self.sample = None;
        self.event_timer_ns = None;
        self.inhibited_until_ns = 0;
        self.syncs = 0;
    }
    /// The PDO starts: the node became operational, or the PDO valid. Event-driven ones tell their values at once, so
    /// that consumers need not wait for the first change; type 0 does so at the next SYNC.
    pub(super) fn start(&mut self, t_ns: u64, od: &ObjectDictionary, counted: bool, out: &mut Outbox) {
        self.quiet();
        self.awaits_start = self.is_cyclic() && self.communication.sync_start > 0 && counted;
        if self.is_active() {
            self.trigger(t_ns, od, out);
        }
    }
    fn send(&mut self, t_ns: u64, data: [u8; 8], out: &mut Outbox) {
        if out.is_full() {
            // It comes when there is room: an event-driven one at once, type 0 behind the next SYNC. A cyclic one comes again.
            self.event |=
                self.is_event_driven() || self.communication.transmission_type == kind::SYNC_ACYCLIC;
            return;
        }
        let len = usize::from(self.mapping.bytes());
        let mut frame = self.communication.cob.frame(&data[..len]);
        if self.is_cyclic() {
            frame.flags |= can_flag::NEWEST;
        }
        out.push(frame);
        self.event = false;
        let inhibit = u64::from(self.communication.inhibit_100us) * INHIBIT_UNIT_NS;
        self.inhibited_until_ns = if inhibit > 0 { t_ns.saturating_add(inhibit) } else { 0 };
        self.arm(t_ns);
    }
    fn arm(&mut self, t_ns: u64) {
        let timer = u64::from(self.communication.event_timer_ms) * MS;
        self.event_timer_ns = (timer > 0 && self.is_event_driven()).then(|| t_ns.saturating_add(timer));
    }
    /// The event timer was written: it runs anew.
    pub(super) fn rearm(&mut self, t_ns: u64) {
        self.arm(t_ns);
    }
    /// The event of the device profile or application.
    pub(super) fn trigger(&mut self, t_ns: u64, od: &ObjectDictionary, out: &mut Outbox) {
        if self.communication.transmission_type == kind::SYNC_ACYCLIC {
            self.event = true;
        } else if self.is_event_driven() {
            if t_ns >= self.inhibited_until_ns {
                self.send(t_ns, self.mapping.pack(od), out);
            } else {
                self.event = true;
            }
        }
    }
    /// An event of several objects is about this PDO too.
    pub(super) fn mark(&mut self) {
        self.marked = true;
    }
    /// The event, if it is about this PDO.
    pub(super) fn trigger_marked(&mut self, t_ns: u64, od: &ObjectDictionary, out: &mut Outbox) {
        if std::mem::take(&mut self.marked) {
            self.trigger(t_ns, od, out);
        }
    }
    /// A remote frame asks for the PDO (7.2.2.5.2), unless bit 30 of the COB-ID forbids it. Type 252 answers with
    /// what the last SYNC sampled, and not before the first; all others with the present values.
    pub(super) fn on_request(&mut self, t_ns: u64, od: &ObjectDictionary, out: &mut Outbox) {
        if self.communication.cob.bit30() {
            return;
        }
        if self.communication.transmission_type == kind::RTR_SYNC {
            if let Some(data) = self.sample {
                self.send(t_ns, data, out);
            }
        } else {
            self.send(t_ns, self.mapping.pack(od), out);
        }
    }
    /// A SYNC. The SYNC that carries the start value sends, as the first of its cycle (7.5.2.37, sub-index 6);
    /// without start value the n-th SYNC sends.
    pub(super) fn on_sync(&mut self, t_ns: u64, od: &ObjectDictionary, counter: u8, out: &mut Outbox) {
        let kind = self.communication.transmission_type;
        if kind == kind::RTR_SYNC {
            self.sample = Some(self.mapping.pack(od));
        } else if kind == kind::SYNC_ACYCLIC {
            if self.event {
                self.send(t_ns, self.mapping.pack(od), out);
            }
        } else if self.is_cyclic() {
            if self.awaits_start {
                if counter != self.communication.sync_start {
                    return;
                }
                self.awaits_start = false;
                self.syncs = kind;
            } else {
                self.syncs = self.syncs.saturating_add(1);
            }
            if self.syncs >= kind {
                self.syncs = 0;
                self.send(t_ns, self.mapping.pack(od), out);
            }
        }
    }
    pub(super) fn deadline(&self) -> Option<u64> {
        let inhibit = (self.event && self.is_event_driven()).then_some(self.inhibited_until_ns);
        // The event timer is not faster than the inhibit time.
        let timer = self.event_timer_ns.map(|due| due.max(self.inhibited_until_ns));
        match (inhibit, timer) {
            (Some(a), Some(b)) => Some(a.min(b)),
            (a, b) => a.or(b),
        }
    }
    pub(super) fn on_time(&mut self, t_ns: u64, od: &ObjectDictionary, out: &mut Outbox) {
        if self.deadline().is_some_and(|due| t_ns >= due) {
            self.send(t_ns, self.mapping.pack(od), out);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::protocol::data_type::DataType;
    use crate::protocol::od::{Access, EntryDef, OdBuilder};
    use ipc_types::payload::CanFrame;

    fn tpdo(transmission: u8) -> (ObjectDictionary, Tpdo) {
        let rw = |data_type| EntryDef::new(data_type, Access::Rw);
        let (u8_, u32_) = (DataType::Unsigned8, DataType::Unsigned32);
        let mut b = OdBuilder::new();
        b.record(
            0x1800,
            Access::Ro,
            vec![(1, rw(u32_).value(0x185)), (2, rw(u8_).value(transmission.into()))],
        );
        b.record(0x1A00, Access::Rw, vec![(1, rw(u32_).value(0x2000_0008))]);
        b.var(0x2000, rw(u8_).value(7).mappable());
        let od = b.build(5).unwrap();
        let tpdo = Tpdo::new(&od, 0);
        assert!(tpdo.is_active());
        (od, tpdo)
    }

    #[test]
    fn what_finds_no_room_is_sent_later() {
        for kind in [0, 1, 255] {
            let (od, mut tpdo) = tpdo(kind);
            let mut out = Outbox::default();
            while !out.is_full() {
                out.push(CanFrame::default());
            }
            tpdo.start(1, &od, false, &mut out);
            tpdo.on_sync(2, &od, 0, &mut out);
            assert_eq!(tpdo.deadline().is_some(), kind == 255, "type {kind}");
            out.drain().for_each(drop);
            tpdo.on_time(3, &od, &mut out);
            tpdo.on_sync(4, &od, 0, &mut out);
            let sent: Vec<_> = out.drain().map(|frame| (frame.can_id, frame.payload().to_vec())).collect();
            assert_eq!((sent, out.dropped), (vec![(0x185, vec![7])], 0), "type {kind}");
            assert_eq!(tpdo.deadline(), None, "type {kind}");
        }
    }
}
