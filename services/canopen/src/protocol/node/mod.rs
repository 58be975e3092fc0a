//! A whole CANopen device: object dictionary, SDO servers, PDO, NMT, error control, EMCY, SYNC, TIME, LSS, store and
//! restore (CiA 301 V4.2, CiA 305 V3.0).
//!
//! A [`Node`] is sans-I/O: its owner hands in frames and times, sends what is in the outbox, and takes the events. The
//! owner never hands in the node's own frames. Objects of the communication profile take effect when they are written.
//! The application's objects are the owner's: [`Node::write`] and [`Node::read`].

mod app;
mod com;
mod event;
mod objects;
#[cfg(test)]
mod tests;

pub use event::{EVENTS, NodeEvent};
pub use objects::{check_write, object};

use com::{Com, pdo_event};
use ipc_types::payload::CanFrame;

use super::cob_id::predefined;
use super::emcy::{self, EmcyProducer};
use super::error_control::ErrorBehaviour;
use super::error_control::guarding::GuardedSlave;
use super::error_control::heartbeat::{HeartbeatConsumer, HeartbeatProducer};
use super::io::Outbox;
use super::lss::slave::{LssAbilities, LssSlave, LssSlaveEvent};
use super::lss::{LssAddress, UNCONFIGURED};
use super::nmt::{NmtAction, NmtCommand, NmtSlave, NmtState, boot_up_frame, self_starts};
use super::od::ObjectDictionary;
use super::pdo::Pdos;
use super::sdo::{SdoServers, ServerConfig};
use super::store::{Store, StoreError};
use super::sync::{Sync, SyncEvent};
use super::time_stamp::TimeStamp;
use objects::object::*;

/// How a node behaves, besides its objects.
#[derive(Debug, Clone, Copy)]
pub struct NodeParams {
    /// 1-127, or FFh: without node-id; then only LSS is served until a master gives one.
    pub node_id: u8,
    pub sdo: ServerConfig,
    /// None: no LSS slave.
    pub lss: Option<LssAbilities>,
}

impl NodeParams {
    pub fn new(node_id: u8) -> Self {
        Self { node_id, sdo: ServerConfig::default(), lss: Some(LssAbilities::default()) }
    }
}

/// Why a node cannot be made.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum NodeError {
    #[error("node-id {0} is none: it must be 1 to 127, or 255 for a device that LSS gives one")]
    NodeId(u8),
    #[error(transparent)]
    Store(#[from] StoreError),
}

/// A CANopen device.
#[derive(Debug, Clone)]
pub struct Node {
    od: ObjectDictionary,
    servers: SdoServers,
    com: Com,
}

impl Node {
    /// A device that is not yet on: [`Self::start`] boots it. `stored`: the image that [`Self::store_image`] gave last,
    /// empty for a new device.
    pub fn new(mut od: ObjectDictionary, params: NodeParams, stored: &[u8]) -> Result<Self, NodeError> {
        if !matches!(params.node_id, 1..=127 | UNCONFIGURED) {
            return Err(NodeError::NodeId(params.node_id));
        }
        let store = Store::load(&od, stored)?;
        if params.node_id != UNCONFIGURED {
            od.set_node_id(params.node_id);
            reset_objects(&mut od, 0x1000, 0xFFFF);
        }
        let address = lss_address(&od);
        let history = od.entries_of(ERROR_FIELD).count().saturating_sub(1);
        let com = Com {
            node_id: params.node_id,
            nmt: NmtSlave::default(),
            heartbeat: HeartbeatProducer::default(),
            consumer: HeartbeatConsumer::default(),
            guarded: GuardedSlave::default(),
            emcy: EmcyProducer::new(history),
            emcy_consumer: super::emcy::EmcyConsumer::default(),
            sync: Sync::default(),
            time: TimeStamp::default(),
            pdos: Pdos::new(&od),
            lss: params.lss.map(|abilities| LssSlave::new(address, params.node_id, abilities)),
            store,
            events: event::Events::default(),
            written: None,
            collided: false,
        };
        let servers = SdoServers::new(&od, params.sdo);
        Ok(Self { od, servers, com })
    }
    /// Power-on: boots, unless the node has no node-id.
    pub fn start(&mut self, t_ns: u64, out: &mut Outbox) {
        self.reset(t_ns, true, out);
        self.flush(t_ns, out);
    }
    /// Initialisation (7.3.2.2.1): defaults, stored values, boot-up message, pre-operational, perhaps operational.
    fn reset(&mut self, t_ns: u64, application: bool, out: &mut Outbox) {
        let com = &mut self.com;
        com.nmt.initialise();
        com.collided = false;
        if let Some(lss) = &mut com.lss {
            com.node_id = lss.pending_node_id();
            if let Some(event) = lss.reset() {
                com.events.push(NodeEvent::Lss(event));
            }
        }
        self.servers.reset();
        if com.node_id == UNCONFIGURED {
            com.pdos.stop();
            return;
        }
        self.od.set_node_id(com.node_id);
        let last = if application { 0xFFFF } else { 0x1FFF };
        reset_objects(&mut self.od, 0x1000, last);
        com.store.apply(&mut self.od, &(0x1000..=last));
        com.configure_all(t_ns, &self.od);
        self.servers.refresh_all(&self.od);
        com.events.push(NodeEvent::Reset { application });
        out.push(boot_up_frame(com.node_id));
        com.heartbeat.boot_up(t_ns);
        let action = com.nmt.initialised();
        self.act(t_ns, action, out);
        if self_starts(self.od.u32(NMT_STARTUP, 0)) {
            let action = self.com.nmt.enter(NmtState::Operational);
            self.act(t_ns, action, out);
        }
    }
    fn act(&mut self, t_ns: u64, action: NmtAction, out: &mut Outbox) {
        match action {
            NmtAction::ResetNode => self.reset(t_ns, true, out),
            NmtAction::ResetCommunication => self.reset(t_ns, false, out),
            NmtAction::Changed(from, to) => self.entered(t_ns, from, to, out),
        }
    }
    fn entered(&mut self, t_ns: u64, from: NmtState, to: NmtState, out: &mut Outbox) {
        let com = &mut self.com;
        com.events.push(NodeEvent::State { from, to });
        if from == NmtState::Operational {
            com.pdos.stop();
            com.clear_pdo_errors();
        }
        if !from.communicates() {
            com.sync.restart_counter();
        }
        if !to.communicates() {
            self.servers.reset();
            com.sync.forget();
            com.clear(emcy::code::COMMUNICATION, 0);
        }
        if from != NmtState::Initialising {
            com.heartbeat.state_changed(t_ns, com.node_id, to, out);
        }
        if to == NmtState::Operational {
            com.pdos.start(t_ns, &self.od, out);
        }
    }
    /// The error behaviour of 1029h sub 1: communication errors.
    fn communication_error(&mut self, t_ns: u64, out: &mut Outbox) {
        self.error_behaviour(t_ns, 1, out);
    }
    fn error_behaviour(&mut self, t_ns: u64, sub: u8, out: &mut Outbox) {
        let value = self.od.u8(ERROR_BEHAVIOUR, sub).unwrap_or(0);
        let behaviour = ErrorBehaviour::from_object(value).unwrap_or_default();
        if let Some(to) = behaviour.target(self.com.nmt.state()) {
            let action = self.com.nmt.enter(to);
            self.act(t_ns, action, out);
        }
    }

    /// A frame of the bus. What is no frame for this node does nothing.
    pub fn on_frame(&mut self, t_ns: u64, frame: &CanFrame, out: &mut Outbox) {
        if frame.is_error() || frame.is_fd() || frame.fault().is_some() {
            return;
        }
        if frame.can_id == predefined::LSS_MASTER {
            self.on_lss(t_ns, frame, out);
        } else if self.com.nmt.state() != NmtState::Initialising {
            self.on_network(t_ns, frame, out);
        }
        self.flush(t_ns, out);
    }
    fn on_lss(&mut self, t_ns: u64, frame: &CanFrame, out: &mut Outbox) {
        let Some(event) = self.com.lss.as_mut().and_then(|lss| lss.on_frame(frame, out)) else { return };
        self.com.events.push(NodeEvent::Lss(event));
        if matches!(event, LssSlaveEvent::NodeIdActive { .. }) {
            self.reset(t_ns, true, out);
        }
    }
    fn on_network(&mut self, t_ns: u64, frame: &CanFrame, out: &mut Outbox) {
        if let Some(action) = self.com.nmt.on_frame(self.com.node_id, frame) {
            self.act(t_ns, action, out);
            return;
        }
        let id = frame.can_id & !ipc_types::payload::id_flag::RTR;
        if (predefined::ERROR_CONTROL + 1..=predefined::ERROR_CONTROL + 127).contains(&id) {
            self.on_error_control(t_ns, frame, out);
        }
        if !self.com.nmt.state().communicates() {
            return;
        }
        if let Some(event) = self.com.sync.on_frame(t_ns, frame) {
            self.on_sync(t_ns, event, out);
            return;
        }
        let com = &mut self.com;
        if let Some(time) = com.time.on_frame(frame) {
            com.events.push(NodeEvent::Time(time));
            return;
        }
        if let Some((node_id, emcy)) = com.emcy_consumer.on_frame(frame) {
            com.events.push(NodeEvent::EmcyReceived { node_id, emcy });
            return;
        }
        if self.servers.on_frame(t_ns, frame, &mut self.od, com, out) {
            self.after_sdo(t_ns, out);
            return;
        }
        let in_window = self.com.sync.in_window(t_ns);
        let Com { pdos, emcy, events, .. } = &mut self.com;
        pdos.on_frame(t_ns, &mut self.od, frame, in_window, out, &mut |event| pdo_event(emcy, events, event));
    }
    fn after_sdo(&mut self, t_ns: u64, out: &mut Outbox) {
        if let Some((index, sub)) = self.com.written.take() {
            self.com.events.push(NodeEvent::Written { index, sub });
            self.apply(t_ns, index, sub, out);
        }
    }
    /// An object was written: makes it take effect.
    fn apply(&mut self, t_ns: u64, index: u16, sub: u8, out: &mut Outbox) {
        match index {
            0x1200..=0x127F => {
                if let Some(channel) = SdoServers::channel_of(index) {
                    self.servers.refresh(&self.od, channel);
                }
            }
            IDENTITY => {
                if let Some(lss) = &mut self.com.lss {
                    lss.set_address(lss_address(&self.od));
                }
            }
            0x1400..=0x1BFF => self.com.configure_pdo(t_ns, &self.od, index, sub, out),
            _ => self.com.configure(t_ns, &self.od, index, sub),
        }
    }
    fn on_error_control(&mut self, t_ns: u64, frame: &CanFrame, out: &mut Outbox) {
        let com = &mut self.com;
        let (node_id, state) = (com.node_id, com.nmt.state());
        let mut failed = false;
        if frame.is_remote() {
            // Heartbeat and guarding exclude each other; heartbeat wins (7.2.8.2.2).
            if !com.heartbeat.is_on() {
                let event = com.guarded.on_frame(t_ns, node_id, state, frame, out);
                failed = event.is_some_and(|event| com.life_event(event));
            }
        } else if frame.can_id == predefined::ERROR_CONTROL + u32::from(node_id) {
            // Once until the next reset: the other device's every heartbeat tells the same.
            if std::mem::replace(&mut com.collided, true) {
                return;
            }
            com.events.push(NodeEvent::DuplicateNodeId { node_id });
            let message = com.emcy.report(
                emcy::code::ID_COLLISION,
                emcy::register::COMMUNICATION,
                [node_id, 0, 0, 0, 0],
            );
            com.events.push(NodeEvent::EmcyRaised(message));
        } else if let Some(event) = com.consumer.on_frame(t_ns, frame) {
            failed = com.heartbeat_event(event);
        }
        if failed {
            self.communication_error(t_ns, out);
        }
    }
    fn on_sync(&mut self, t_ns: u64, event: SyncEvent, out: &mut Outbox) {
        let com = &mut self.com;
        match event {
            SyncEvent::Sync { counter } => {
                if com.sync.take_resolved().is_some() {
                    com.clear(emcy::code::COMMUNICATION, 0);
                    com.events.push(NodeEvent::SyncResolved);
                }
                com.clear(emcy::code::SYNC_LENGTH, 0);
                let Com { pdos, emcy, events, .. } = com;
                let od = &mut self.od;
                pdos.on_sync(t_ns, od, counter, out, &mut |event| pdo_event(emcy, events, event));
                events.push(NodeEvent::Sync { counter });
            }
            SyncEvent::Length { got, expected } => {
                let info = [got, expected, 0, 0, 0];
                com.raise(emcy::code::SYNC_LENGTH, 0, emcy::register::COMMUNICATION, info);
            }
            SyncEvent::Timeout => {
                com.raise(emcy::code::COMMUNICATION, 0, emcy::register::COMMUNICATION, [0; 5]);
                com.events.push(NodeEvent::SyncTimeout);
            }
            SyncEvent::Resolved => {}
        }
    }
    /// Sends EMCYs that may go, and keeps 1001h up to date.
    fn flush(&mut self, t_ns: u64, out: &mut Outbox) {
        let com = &mut self.com;
        if let Ok(entry) = self.od.find(ERROR_REGISTER, 0) {
            let register = com.emcy.register();
            if self.od.get(entry) != [register] && self.od.set(entry, &[register]).is_ok() {
                com.pdos.object_changed(t_ns, &self.od, ERROR_REGISTER, 0, out);
            }
        }
        let allowed = com.nmt.state().communicates();
        com.emcy.on_time(t_ns, allowed, out);
    }

    /// When [`Self::on_time`] wants to be called. May lie in the past: then at once.
    pub fn next_deadline(&self) -> Option<u64> {
        let com = &self.com;
        if com.nmt.state() == NmtState::Initialising {
            return None;
        }
        let allowed = com.nmt.state().communicates();
        [
            com.heartbeat.next_deadline(),
            com.consumer.next_deadline(),
            com.guarded.next_deadline(),
            com.emcy.next_deadline(allowed),
            com.sync.next_deadline(),
            com.pdos.next_deadline(),
            self.servers.next_deadline(),
        ]
        .into_iter()
        .flatten()
        .min()
    }
    /// A time has come: does all that is due. SYNC goes first, so that nothing delays it.
    pub fn on_time(&mut self, t_ns: u64, out: &mut Outbox) {
        if self.com.nmt.state() == NmtState::Initialising {
            return;
        }
        let allowed = self.com.nmt.state().communicates();
        if let Some(event) = self.com.sync.on_time(t_ns, allowed, out) {
            self.on_sync(t_ns, event, out);
        }
        let com = &mut self.com;
        com.heartbeat.on_time(t_ns, com.node_id, com.nmt.state(), out);
        let mut failed = false;
        while let Some(event) = com.consumer.on_time(t_ns) {
            failed |= com.heartbeat_event(event);
        }
        if let Some(event) = com.guarded.on_time(t_ns) {
            failed |= com.life_event(event);
        }
        if failed {
            self.communication_error(t_ns, out);
        }
        self.servers.on_time(t_ns, out);
        let Com { pdos, emcy, events, .. } = &mut self.com;
        pdos.on_time(t_ns, &self.od, out, &mut |event| pdo_event(emcy, events, event));
        self.flush(t_ns, out);
    }
    /// A command of the device itself, or of an NMT master in the same device.
    pub fn command(&mut self, t_ns: u64, command: NmtCommand, out: &mut Outbox) {
        if let Some(action) = self.com.nmt.command(command) {
            self.act(t_ns, action, out);
        }
        self.flush(t_ns, out);
    }
}

fn lss_address(od: &ObjectDictionary) -> LssAddress {
    LssAddress::from_parts([1, 2, 3, 4].map(|sub| od.u32(IDENTITY, sub).unwrap_or(0)))
}

/// Gives the objects from `first` to `last` their defaults. Objects that the network cannot write keep their values:
/// names, versions, process inputs are the application's; except where they hang on the node-id.
fn reset_objects(od: &mut ObjectDictionary, first: u16, last: u16) {
    let mut run: Option<(u16, u16)> = None;
    for at in 0..od.objects().len() {
        let index = od.objects()[at].index;
        let ours = (first..=last).contains(&index)
            && od.entries_of(index).any(|(_, entry)| entry.access.writable() || entry.node_relative);
        run = match (run, ours) {
            (None, true) => Some((index, index)),
            (Some((from, _)), true) => Some((from, index)),
            (Some((from, to)), false) => {
                od.reset_to_defaults(from..=to);
                None
            }
            (None, false) => None,
        };
    }
    if let Some((from, to)) = run {
        od.reset_to_defaults(from..=to);
    }
}
