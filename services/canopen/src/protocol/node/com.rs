//! The communication machines of a node, and how its objects rule them.

use super::event::{Events, NodeEvent};
use super::objects::object::*;
use crate::protocol::cob_id::{BIT_31, CobId};
use crate::protocol::emcy::{self, EmcyConsumer, EmcyProducer};
use crate::protocol::error_control::guarding::{GuardedSlave, LifeEvent};
use crate::protocol::error_control::heartbeat::{HeartbeatConsumer, HeartbeatEvent, HeartbeatProducer};
use crate::protocol::io::Outbox;
use crate::protocol::lss::slave::LssSlave;
use crate::protocol::nmt::NmtSlave;
use crate::protocol::od::ObjectDictionary;
use crate::protocol::pdo::{self, PdoEvent, Pdos};
use crate::protocol::store::Store;
use crate::protocol::sync::{Sync, SyncParams};
use crate::protocol::time_stamp::TimeStamp;

/// Everything of a node but its dictionary and SDO servers.
#[derive(Debug, Clone)]
pub struct Com {
    pub node_id: u8,
    pub nmt: NmtSlave,
    pub heartbeat: HeartbeatProducer,
    pub consumer: HeartbeatConsumer,
    pub guarded: GuardedSlave,
    pub emcy: EmcyProducer,
    pub emcy_consumer: EmcyConsumer,
    pub sync: Sync,
    pub time: TimeStamp,
    pub pdos: Pdos,
    pub lss: Option<LssSlave>,
    pub store: Store,
    pub events: Events,
    /// What the present SDO frame wrote.
    pub written: Option<(u16, u8)>,
    /// Another device with this node-id was heard.
    pub collided: bool,
}

impl Com {
    /// Takes every object of the communication profile: at a reset.
    pub fn configure_all(&mut self, t_ns: u64, od: &ObjectDictionary) {
        self.heartbeat.stop();
        self.consumer = HeartbeatConsumer::default();
        self.guarded = GuardedSlave::default();
        self.emcy.reset();
        self.emcy_consumer = EmcyConsumer::default();
        self.sync = Sync::default();
        self.pdos.stop();
        self.pdos.reload(od);
        for index in [SYNC_COB_ID, GUARD_TIME, TIME_COB_ID, EMCY_COB_ID, HEARTBEAT_PRODUCER] {
            self.configure(t_ns, od, index, 0);
        }
        for sub in 1..=127 {
            self.configure(t_ns, od, HEARTBEAT_CONSUMER, sub);
            self.configure(t_ns, od, EMCY_CONSUMER, sub);
        }
    }
    /// Takes one object. PDO parameters and SDO channels are the caller's matter.
    pub fn configure(&mut self, t_ns: u64, od: &ObjectDictionary, index: u16, sub: u8) {
        match index {
            SYNC_COB_ID | CYCLE_PERIOD | SYNC_WINDOW | SYNC_OVERFLOW => {
                // Bit 31 of 1005h means nothing; without the object there is no SYNC.
                let cob = od.u32(SYNC_COB_ID, 0).map_or(BIT_31, |value| value & !BIT_31);
                let params = SyncParams {
                    cob: CobId(cob),
                    period_us: od.u32(CYCLE_PERIOD, 0).unwrap_or(0),
                    window_us: od.u32(SYNC_WINDOW, 0).unwrap_or(0),
                    overflow: od.u8(SYNC_OVERFLOW, 0).unwrap_or(0),
                };
                self.sync.configure(t_ns, params);
                self.pdos.set_counted(params.overflow > 0);
                if !self.sync.is_timed_out() {
                    self.clear(emcy::code::COMMUNICATION, 0);
                }
            }
            GUARD_TIME | LIFE_TIME_FACTOR => {
                let guard_time_ms = od.u16(GUARD_TIME, 0).unwrap_or(0);
                self.guarded.configure(guard_time_ms, od.u8(LIFE_TIME_FACTOR, 0).unwrap_or(0));
                if self.guarded.next_deadline().is_none() {
                    self.clear(emcy::code::HEARTBEAT, 0);
                }
            }
            TIME_COB_ID => self.time.configure(od.u32(TIME_COB_ID, 0).unwrap_or(0)),
            EMCY_COB_ID | EMCY_INHIBIT => {
                let cob = CobId(od.u32(EMCY_COB_ID, 0).unwrap_or(BIT_31));
                self.emcy.configure(cob, od.u16(EMCY_INHIBIT, 0).unwrap_or(0));
            }
            HEARTBEAT_CONSUMER if sub > 0 => {
                let value = od.u32(index, sub).unwrap_or(0);
                if let Some(node_id) = self.consumer.node_of(sub) {
                    self.clear(emcy::code::HEARTBEAT, u16::from(node_id));
                }
                self.consumer.configure(sub, value);
            }
            HEARTBEAT_PRODUCER => {
                self.heartbeat.configure(t_ns, od.u16(HEARTBEAT_PRODUCER, 0).unwrap_or(0));
                // Heartbeat and guarding exclude each other; heartbeat wins (7.2.8.2.2).
                if self.heartbeat.is_on() {
                    self.guarded.stand_down();
                    self.clear(emcy::code::HEARTBEAT, 0);
                }
            }
            EMCY_CONSUMER if sub > 0 => {
                self.emcy_consumer.configure(sub, CobId(od.u32(index, sub).unwrap_or(BIT_31)));
            }
            _ => {}
        }
    }
    /// When a PDO's parameter was written.
    pub fn configure_pdo(&mut self, t_ns: u64, od: &ObjectDictionary, index: u16, sub: u8, out: &mut Outbox) {
        self.pdos.after_write(t_ns, od, index, sub, out);
        if let Some((pdo::Direction::Receive, number, _)) = pdo::role(index) {
            // A PDO that is configured anew has none of its errors.
            if !self.pdos.is_overdue(number) {
                self.clear(emcy::code::RPDO_TIMEOUT, number);
            }
            self.clear(emcy::code::PDO_TOO_SHORT, number);
            self.clear(emcy::code::PDO_TOO_LONG, number);
        }
    }
    /// The node left operational: PDOs are not watched any more, so none of them has an error.
    pub fn clear_pdo_errors(&mut self) {
        for code in [emcy::code::RPDO_TIMEOUT, emcy::code::PDO_TOO_SHORT, emcy::code::PDO_TOO_LONG] {
            while let Some(source) = self.emcy.first_source(code) {
                self.clear(code, source);
            }
        }
    }
    /// An error has come.
    pub fn raise(&mut self, code: u16, source: u16, register: u8, info: [u8; 5]) {
        if let Some(message) = self.emcy.raise(code, source, register, info) {
            self.events.push(NodeEvent::EmcyRaised(message));
        }
    }
    /// An error has gone.
    pub fn clear(&mut self, code: u16, source: u16) {
        if let Some(message) = self.emcy.clear(code, source) {
            self.events.push(NodeEvent::EmcyRaised(message));
        }
    }
    /// Heartbeat consumer: EMCY 8130h per node (7.2.8.3.2.2). Tells whether the error behaviour applies.
    pub fn heartbeat_event(&mut self, event: HeartbeatEvent) -> bool {
        self.events.push(NodeEvent::Heartbeat(event));
        match event {
            HeartbeatEvent::Lost { node_id } => {
                let info = [node_id, 0, 0, 0, 0];
                self.raise(emcy::code::HEARTBEAT, u16::from(node_id), emcy::register::COMMUNICATION, info);
                true
            }
            HeartbeatEvent::Resolved { node_id, .. } => {
                self.clear(emcy::code::HEARTBEAT, u16::from(node_id));
                false
            }
            HeartbeatEvent::State { .. } | HeartbeatEvent::BootUp { .. } => false,
        }
    }
    /// Life guarding: EMCY 8130h with node 0. Tells whether the error behaviour applies.
    pub fn life_event(&mut self, event: LifeEvent) -> bool {
        self.events.push(NodeEvent::Life(event));
        match event {
            LifeEvent::Lost => self.raise(emcy::code::HEARTBEAT, 0, emcy::register::COMMUNICATION, [0; 5]),
            LifeEvent::Resolved => self.clear(emcy::code::HEARTBEAT, 0),
        }
        event == LifeEvent::Lost
    }
}

/// EMCY and events of what happened to a PDO.
pub fn pdo_event(emcy: &mut EmcyProducer, events: &mut Events, event: PdoEvent) {
    use emcy::code::{PDO_TOO_LONG, PDO_TOO_SHORT, RPDO_TIMEOUT};
    let communication = emcy::register::COMMUNICATION;
    let info = |id: u32, number: u16| {
        let ([a, b, ..], [c, d]) = (id.to_le_bytes(), (number + 1).to_le_bytes());
        [a, b, c, d, 0]
    };
    let message = match event {
        PdoEvent::Received { number } => return events.push(NodeEvent::Received { number }),
        // One message until the length is right again: a wrong producer does not make a storm of EMCYs.
        PdoEvent::TooShort { number, id, .. } => {
            emcy.raise(PDO_TOO_SHORT, number, communication, info(id, number))
        }
        PdoEvent::TooLong { number, id, .. } => {
            emcy.raise(PDO_TOO_LONG, number, communication, info(id, number))
        }
        PdoEvent::LengthRight { number } => {
            let short = emcy.clear(PDO_TOO_SHORT, number);
            short.into_iter().chain(emcy.clear(PDO_TOO_LONG, number)).last()
        }
        PdoEvent::Timeout { number, id } => emcy.raise(RPDO_TIMEOUT, number, communication, info(id, number)),
        PdoEvent::Resumed { number } => emcy.clear(RPDO_TIMEOUT, number),
        PdoEvent::OutsideWindow { .. } => None,
    };
    events.push(NodeEvent::Rpdo(event));
    if let Some(message) = message {
        events.push(NodeEvent::EmcyRaised(message));
    }
}
