//! One RPDO.

use super::mapping::Mapping;
use super::{Communication, Direction, PdoEvent};
use crate::protocol::error_control::MS;
use crate::protocol::od::ObjectDictionary;
use ipc_types::payload::CanFrame;

/// Largest transmission type that waits for SYNC (CiA 301 V4.2, 7.5.2.35, table 72).
pub const SYNCHRONOUS_MAX: u8 = 240;

/// One RPDO.
#[derive(Debug, Clone)]
pub struct Rpdo {
    /// 0-based: 1400h is 0.
    pub number: u16,
    pub(super) communication: Communication,
    pub(super) mapping: Mapping,
    pending: Option<[u8; 8]>,
    deadline_ns: Option<u64>,
    timed_out: bool,
    length_wrong: bool,
}

impl Rpdo {
    pub fn new(od: &ObjectDictionary, number: u16) -> Self {
        let mut rpdo = Self {
            number,
            communication: Communication::load(od, Direction::Receive.communication(number)),
            mapping: Mapping::default(),
            pending: None,
            deadline_ns: None,
            timed_out: false,
            length_wrong: false,
        };
        rpdo.load(od);
        rpdo
    }
    /// Reads the parameters again. A mapping that is not right (a bad default in an EDS) maps nothing.
    pub fn load(&mut self, od: &ObjectDictionary) {
        let old = self.communication;
        self.communication = Communication::load(od, Direction::Receive.communication(self.number));
        let index = Direction::Receive.mapping(self.number);
        self.mapping =
            Mapping::load(od, index, od.u8(index, 0).unwrap_or(0), Direction::Receive).unwrap_or_default();
        if old != self.communication {
            self.quiet();
        }
    }
    /// Received and processed at all?
    pub fn is_active(&self) -> bool {
        self.communication.cob.exists() && !self.mapping.is_empty()
    }
    /// Nothing is pending, nothing is watched.
    pub fn quiet(&mut self) {
        self.pending = None;
        self.deadline_ns = None;
        self.timed_out = false;
        self.length_wrong = false;
    }
    /// Its event timer ran out, and no PDO came since.
    pub fn is_overdue(&self) -> bool {
        self.timed_out
    }
    fn is_synchronous(&self) -> bool {
        self.communication.transmission_type <= SYNCHRONOUS_MAX
    }
    /// The frame carries this RPDO's identifier.
    pub(super) fn on_frame(
        &mut self,
        t_ns: u64,
        od: &mut ObjectDictionary,
        frame: &CanFrame,
        in_window: bool,
        event: &mut dyn FnMut(PdoEvent),
    ) {
        let data = frame.payload();
        let (number, id, got, mapped) = (self.number, frame.id(), frame.len, self.mapping.bytes());
        if data.len() < usize::from(mapped) {
            self.length_wrong = true;
            event(PdoEvent::TooShort { number, id, got, mapped });
            return;
        }
        if data.len() > usize::from(mapped) {
            self.length_wrong = true;
            event(PdoEvent::TooLong { number, id, got, mapped });
        } else if std::mem::take(&mut self.length_wrong) {
            event(PdoEvent::LengthRight { number });
        }
        let timer = u64::from(self.communication.event_timer_ms) * MS;
        self.deadline_ns = (timer > 0).then(|| t_ns.saturating_add(timer));
        if std::mem::take(&mut self.timed_out) {
            event(PdoEvent::Resumed { number });
        }
        let mut bytes = [0; 8];
        let len = data.len().min(8);
        bytes[..len].copy_from_slice(&data[..len]);
        if !self.is_synchronous() {
            self.mapping.unpack(od, bytes);
            event(PdoEvent::Received { number });
        } else if in_window {
            self.pending = Some(bytes);
        } else {
            event(PdoEvent::OutsideWindow { number });
        }
    }
    /// A SYNC: what came before it takes effect.
    pub(super) fn on_sync(&mut self, od: &mut ObjectDictionary, event: &mut dyn FnMut(PdoEvent)) {
        if let Some(bytes) = self.pending.take() {
            self.mapping.unpack(od, bytes);
            event(PdoEvent::Received { number: self.number });
        }
    }
    pub(super) fn deadline(&self) -> Option<u64> {
        self.deadline_ns
    }
    pub(super) fn on_time(&mut self, t_ns: u64, event: &mut dyn FnMut(PdoEvent)) {
        if self.deadline_ns.is_some_and(|due| t_ns >= due) {
            self.deadline_ns = None;
            self.timed_out = true;
            event(PdoEvent::Timeout { number: self.number, id: self.communication.cob.id() });
        }
    }
}
