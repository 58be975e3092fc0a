//! The network as its master sees it: who is there, in which state, and what is done about it. Sans-I/O.
//!
//! Frames and time in, frames and [`Event`]s out. The boot-up of each node is [`super::boot`], process data is
//! [`super::exchange`], SDO transfers are [`super::transfers`]; this module decides between them.

use super::boot::{Action, Boot, ErrorControl, Failure, OPERATIONAL, SdoEnd, Write};
use super::exchange::Exchange;
use super::transfers::{Owner, Transfers};
use crate::config::ErrorPolicy;
use crate::protocol::cob_id::predefined;
use crate::protocol::io::Outbox;
use crate::protocol::nmt::{NmtCommand, NmtState};
use ipc_types::payload::{CanFrame, id_flag};
use std::collections::VecDeque;

/// The state that a command leads to, as a heartbeat tells it; `None` for resets.
fn state_after(command: NmtCommand) -> Option<u8> {
    match command {
        NmtCommand::Start => Some(NmtState::Operational.wire()),
        NmtCommand::Stop => Some(NmtState::Stopped.wire()),
        NmtCommand::EnterPreOperational => Some(NmtState::PreOperational.wire()),
        NmtCommand::ResetNode | NmtCommand::ResetCommunication => None,
    }
}

/// Name of an NMT state as a heartbeat tells it.
pub fn state_name(state: u8) -> &'static str {
    NmtState::from_wire(state).map_or("unknown", NmtState::name)
}

/// Events kept until the caller takes them; more are counted.
const MAX_EVENTS: usize = 256;
/// NMT commands that wait for their inhibit time.
const MAX_COMMANDS: usize = 512;
/// A started node that tells another state is started again after this time.
const RESTART_NS: u64 = 1_000_000_000;
/// State changes without command within [`DUPLICATE_NS`] that only two devices can make.
const DUPLICATE_CHANGES: u8 = 4;
const DUPLICATE_NS: u64 = 2_000_000_000;
/// Heartbeats within [`BEATS_PERIODS`] periods that only two devices can send: one sends 8, and a few with its changes
/// of state.
const DUPLICATE_BEATS: u8 = 14;
const BEATS_PERIODS: u64 = 8;
/// Emergency code of a device that hears its own identifiers (CiA 301 V4.2, table 26).
const EMCY_COLLISION: u16 = 0x8150;

/// How the network is run.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Settings {
    pub node_id: u8,
    pub sync_period_ns: Option<u64>,
    /// 0: no counter.
    pub sync_overflow: u8,
    pub sync_cob_id: u32,
    pub time_period_ns: Option<u64>,
    /// 0: none.
    pub heartbeat_ns: u64,
    pub start_nodes: bool,
    pub start_all_nodes: bool,
    pub reset_all_nodes: bool,
    pub stop_all_nodes: bool,
    /// 0: for ever.
    pub boot_time_ns: u64,
    pub nmt_inhibit_ns: u64,
    /// An earlier process of this master ran the network: nodes that are operational are left running.
    pub takeover: bool,
}

/// One node.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NodeSettings {
    pub plan: super::boot::Plan,
    pub mandatory: bool,
    pub boot: bool,
    pub on_error: ErrorPolicy,
}

/// Something the user is told.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Event {
    /// A node is booted; `kept`: it was running already and was left alone.
    Booted {
        node: u8,
        attempts: u32,
        kept: bool,
    },
    BootFailed {
        node: u8,
        failure: Failure,
    },
    /// Error control lost it.
    Lost {
        node: u8,
        guarding: bool,
    },
    /// It told another NMT state than it should have.
    State {
        node: u8,
        state: u8,
        wanted: u8,
    },
    /// A boot-up message of a node that ran.
    Rebooted {
        node: u8,
    },
    Emcy {
        node: u8,
        code: u16,
        register: u8,
        vendor: [u8; 5],
    },
    /// A node that is not in the list sent its boot-up message (letter A).
    Unknown {
        node: u8,
    },
    /// Two devices seem to have this node-id.
    Duplicate {
        node: u8,
        sign: Sign,
    },
    /// Mandatory nodes were not booted in time; the first of them.
    MandatoryMissing {
        node: u8,
        missing: u8,
    },
    /// All mandatory nodes are booted.
    NetworkStarted,
    BusOff,
    BusBack,
}

/// What tells that two devices have one node-id.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Sign {
    /// States without command, or boot-up messages in a row.
    States,
    /// Twice as many heartbeats as asked for.
    Heartbeats,
    /// The devices say so.
    Emcy,
}

/// What is known of a node.
#[derive(Debug, Clone)]
pub struct NodeRun {
    pub settings: NodeSettings,
    pub boot: Boot,
    /// NMT state it last told.
    pub state: Option<u8>,
    /// NMT state it was commanded to.
    pub wanted: u8,
    pub last_failure: Option<Failure>,
    pub emcys: u64,
    pub last_emcy: Option<(u16, u8)>,
    /// Times it was lost.
    pub losses: u64,
    watch: Option<Watch>,
    restart_at_ns: Option<u64>,
    changes: u8,
    changes_since_ns: u64,
    beats: u8,
    beats_since_ns: u64,
    told_duplicate: bool,
}

#[derive(Debug, Clone, Copy)]
struct Watch {
    /// Lost at this time when nothing comes.
    lost_at_ns: u64,
    span_ns: u64,
    guard: Option<Guard>,
}

#[derive(Debug, Clone, Copy)]
struct Guard {
    every_ns: u64,
    next_ns: u64,
    /// Toggle bit of the last answer.
    toggle: Option<bool>,
}

impl NodeRun {
    fn new(mut settings: NodeSettings, takeover: bool) -> Self {
        settings.plan.keep_alive |= takeover;
        let boot = Boot::new(settings.plan.clone());
        Self {
            settings,
            boot,
            state: None,
            wanted: 127,
            last_failure: None,
            emcys: 0,
            last_emcy: None,
            losses: 0,
            watch: None,
            restart_at_ns: None,
            changes: 0,
            changes_since_ns: 0,
            beats: 0,
            beats_since_ns: 0,
            told_duplicate: false,
        }
    }
    pub fn id(&self) -> u8 {
        self.settings.plan.id
    }
    /// Process data is exchanged with it.
    pub fn is_operational(&self) -> bool {
        self.boot.is_running() && self.wanted == OPERATIONAL && self.state.is_none_or(|s| s == OPERATIONAL)
    }
}

/// Counters since start.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, serde::Serialize)]
pub struct Counters {
    pub syncs: u64,
    /// SYNCs left out because the process was late by a period or more.
    pub syncs_missed: u64,
    pub bus_offs: u64,
    pub nmt_commands: u64,
    /// Events that nobody took in time.
    pub events_dropped: u64,
}

/// See the module.
#[derive(Debug)]
pub struct Network {
    settings: Settings,
    nodes: Vec<NodeRun>,
    /// Place in `nodes` of each node-id.
    place: [u8; 128],
    pub exchange: Exchange,
    pub transfers: Transfers,
    events: VecDeque<Event>,
    commands: VecDeque<(NmtCommand, u8)>,
    next_command_ns: u64,
    next_sync_ns: Option<u64>,
    sync_counter: u8,
    next_time_ns: Option<u64>,
    next_heartbeat_ns: Option<u64>,
    /// The master's own NMT state.
    state: u8,
    boot_until_ns: Option<u64>,
    started: bool,
    bus_off: bool,
    /// The safe state sent the nodes there.
    safe: Option<NmtCommand>,
    counters: Counters,
    unknown_told: u128,
}

const NOWHERE: u8 = u8::MAX;

impl Network {
    /// Nodes beyond 126 and with ids outside 1 - 127 are left out; `check` has refused them.
    pub fn new(
        settings: Settings,
        nodes: Vec<NodeSettings>,
        exchange: Exchange,
        transfers: Transfers,
    ) -> Self {
        let mut place = [NOWHERE; 128];
        let mut list = Vec::with_capacity(nodes.len());
        for node in nodes {
            let id = usize::from(node.plan.id);
            if (1..128).contains(&id) && place[id] == NOWHERE {
                place[id] = list.len() as u8;
                list.push(NodeRun::new(node, settings.takeover));
            }
        }
        Self {
            settings,
            nodes: list,
            place,
            exchange,
            transfers,
            events: VecDeque::with_capacity(MAX_EVENTS),
            commands: VecDeque::with_capacity(MAX_COMMANDS),
            next_command_ns: 0,
            next_sync_ns: None,
            sync_counter: 0,
            next_time_ns: None,
            next_heartbeat_ns: None,
            state: 127,
            boot_until_ns: None,
            started: false,
            bus_off: false,
            safe: None,
            counters: Counters::default(),
            unknown_told: 0,
        }
    }

    pub fn nodes(&self) -> &[NodeRun] {
        &self.nodes
    }
    pub fn counters(&self) -> Counters {
        self.counters
    }
    /// The master's own NMT state: pre-operational until all mandatory nodes are booted.
    pub fn state(&self) -> u8 {
        self.state
    }
    /// Whether every mandatory node is booted.
    pub fn is_started(&self) -> bool {
        self.started
    }
    /// Whether the network was started and no mandatory node has been lost since.
    pub fn is_whole(&self) -> bool {
        self.started && self.nodes.iter().all(|n| !n.settings.mandatory || n.boot.is_running())
    }
    pub fn is_bus_off(&self) -> bool {
        self.bus_off
    }
    pub fn drain_events(&mut self) -> impl Iterator<Item = Event> + '_ {
        self.events.drain(..)
    }

    fn tell(&mut self, event: Event) {
        if self.events.len() < MAX_EVENTS {
            self.events.push_back(event);
        } else {
            self.counters.events_dropped += 1;
        }
    }

    fn find(&self, node: u8) -> Option<usize> {
        let at = *self.place.get(usize::from(node))?;
        (at != NOWHERE).then_some(usize::from(at))
    }

    /// Begins: a cold start resets the communication of all nodes first, a takeover disturbs nobody.
    pub fn start(&mut self, now_ns: u64, out: &mut Outbox) {
        let keeps = self.nodes.iter().any(|n| n.settings.plan.keep_alive);
        if !self.settings.takeover && !keeps {
            self.command(NmtCommand::ResetCommunication, 0);
        }
        self.next_sync_ns = self.settings.sync_period_ns.map(|_| now_ns);
        self.next_time_ns = self.settings.time_period_ns.map(|_| now_ns);
        self.next_heartbeat_ns = (self.settings.heartbeat_ns > 0).then_some(now_ns);
        self.boot_all(now_ns);
        self.settle(now_ns, out);
    }

    fn boot_all(&mut self, now_ns: u64) {
        // A master without nodes has nothing to wait for.
        self.started = self.nodes.is_empty();
        self.state = if self.started { OPERATIONAL } else { 127 };
        self.boot_until_ns =
            (self.settings.boot_time_ns > 0).then(|| now_ns.saturating_add(self.settings.boot_time_ns));
        for node in &mut self.nodes {
            if node.settings.boot {
                node.boot.stop();
                node.boot.start(now_ns);
            }
        }
    }

    /// Queues an NMT command; node 0 is all.
    fn command(&mut self, command: NmtCommand, node: u8) {
        if self.commands.len() < MAX_COMMANDS {
            self.commands.push_back((command, node));
        }
    }

    /// An NMT command of a user or a program; node 0 is all.
    pub fn nmt(&mut self, now_ns: u64, command: NmtCommand, node: u8, out: &mut Outbox) {
        for i in 0..self.nodes.len() {
            if node != 0 && self.nodes[i].id() != node {
                continue;
            }
            match state_after(command) {
                Some(state) => self.nodes[i].wanted = state,
                None => {
                    let node = &mut self.nodes[i];
                    node.watch = None;
                    node.state = None;
                }
            }
            self.gate(now_ns, i);
        }
        self.command(command, node);
        self.settle(now_ns, out);
    }

    /// Boots a node from the beginning, as a user asks; false when there is no such node.
    pub fn boot_again(&mut self, now_ns: u64, node: u8, out: &mut Outbox) -> bool {
        let Some(i) = self.find(node) else { return false };
        self.transfers.cancel(node, Owner::Boot);
        let run = &mut self.nodes[i];
        (run.watch, run.state, run.last_failure) = (None, None, None);
        run.boot.stop();
        run.boot.start(now_ns);
        self.gate(now_ns, i);
        self.settle(now_ns, out);
        true
    }

    /// The outputs once more before the master ends: synchronous ones behind a last SYNC.
    pub fn last_outputs(&mut self, now_ns: u64, out: &mut Outbox) {
        if self.settings.sync_period_ns.is_some() && !self.bus_off {
            self.next_sync_ns = Some(now_ns);
            self.sync(now_ns, out);
        }
        self.exchange.on_time(now_ns, out);
    }

    /// The safe state of the outputs by NMT; `None` leaves it.
    pub fn set_safe(&mut self, now_ns: u64, safe: Option<NmtCommand>, out: &mut Outbox) {
        if self.safe == safe {
            return;
        }
        self.safe = safe;
        let command = safe.unwrap_or(NmtCommand::Start);
        for i in 0..self.nodes.len() {
            if self.nodes[i].boot.is_running() {
                self.nodes[i].wanted = state_after(command).unwrap_or(127);
                let id = self.nodes[i].id();
                self.command(command, id);
                self.gate(now_ns, i);
            }
        }
        self.settle(now_ns, out);
    }

    /// Opens or closes the node's process data.
    fn gate(&mut self, now_ns: u64, i: usize) {
        let node = &self.nodes[i];
        let on = node.is_operational() && !self.bus_off;
        self.exchange.set_operational(node.id(), on, now_ns);
        self.exchange.show_state(node.id(), node.state.unwrap_or(0));
    }

    /// Takes a frame of the bus, our own echoes too: our SYNC opens a window when it is on the bus, not when it is
    /// sent. `t_ns` is when it was on the bus.
    pub fn on_frame(&mut self, t_ns: u64, frame: &CanFrame, out: &mut Outbox) {
        if frame.is_error() {
            self.on_error_frame(t_ns, frame);
            return self.settle(t_ns, out);
        }
        if self.bus_off {
            self.bus_back(t_ns);
        }
        if frame.is_extended() || frame.is_fd() {
            self.exchange.on_frame(t_ns, frame);
            return;
        }
        let id = frame.id();
        if id == self.settings.sync_cob_id && !frame.is_remote() {
            self.exchange.on_sync(t_ns);
            return;
        }
        let node = (id & 0x7F) as u8;
        match id & 0x780 {
            predefined::SDO_TX => self.transfers.on_frame(t_ns, node, frame, out),
            predefined::ERROR_CONTROL if !frame.is_remote() && node != 0 => {
                self.on_error_control(t_ns, node, frame.payload());
            }
            predefined::EMCY if node != 0 => self.on_emcy(node, frame.payload()),
            _ => {
                self.exchange.on_frame(t_ns, frame);
                return;
            }
        }
        self.settle(t_ns, out);
    }

    fn on_error_frame(&mut self, t_ns: u64, frame: &CanFrame) {
        // Classes of linux/can/error.h.
        const BUS_OFF: u32 = 0x40;
        const RESTARTED: u32 = 0x100;
        if frame.can_id & BUS_OFF != 0 && !self.bus_off {
            self.bus_off = true;
            self.counters.bus_offs += 1;
            self.next_sync_ns = None;
            for i in 0..self.nodes.len() {
                self.nodes[i].boot.stop();
                self.nodes[i].watch = None;
                self.gate(t_ns, i);
            }
            self.tell(Event::BusOff);
        } else if frame.can_id & RESTARTED != 0 && self.bus_off {
            self.bus_back(t_ns);
        }
    }

    fn bus_back(&mut self, now_ns: u64) {
        self.bus_off = false;
        self.next_sync_ns = self.settings.sync_period_ns.map(|_| now_ns);
        self.tell(Event::BusBack);
        self.boot_all(now_ns);
    }

    fn on_error_control(&mut self, t_ns: u64, id: u8, payload: &[u8]) {
        let Some(&byte) = payload.first() else { return };
        let Some(i) = self.find(id) else {
            if byte == 0 && id != self.settings.node_id && self.unknown_told >> id & 1 == 0 {
                self.unknown_told |= 1 << id;
                self.tell(Event::Unknown { node: id });
            }
            return;
        };
        if byte == 0 {
            return self.on_boot_up(t_ns, i);
        }
        let state = byte & 0x7F;
        let node = &mut self.nodes[i];
        if let Some(watch) = &mut node.watch {
            if let Some(guard) = &mut watch.guard {
                let toggle = byte & 0x80 != 0;
                // An answer with the same toggle bit is an old one (CiA 301 clause 7.2.8.3.2.1).
                if guard.toggle.replace(toggle) == Some(toggle) {
                    return;
                }
            }
            watch.lost_at_ns = t_ns.saturating_add(watch.span_ns);
        }
        let before = node.state.replace(state);
        node.boot.on_alive(t_ns, state);
        self.count_beat(t_ns, i);
        if before.is_some_and(|before| before != state) {
            self.count_change(t_ns, i);
        }
        let node = &mut self.nodes[i];
        if node.boot.is_running() && state != node.wanted {
            if before != Some(state) && node.restart_at_ns.is_none() {
                let wanted = node.wanted;
                node.restart_at_ns = Some(t_ns.saturating_add(RESTART_NS));
                // The first heartbeat after a command may still tell the state before it.
                if before.is_some() && before == Some(wanted) {
                    self.tell(Event::State { node: id, state, wanted });
                }
            }
        } else {
            node.restart_at_ns = None;
        }
        self.gate(t_ns, i);
    }

    /// Two devices with one node-id tell two states in turn.
    fn count_change(&mut self, t_ns: u64, i: usize) {
        let node = &mut self.nodes[i];
        if t_ns.saturating_sub(node.changes_since_ns) > DUPLICATE_NS {
            (node.changes, node.changes_since_ns) = (0, t_ns);
        }
        node.changes = node.changes.saturating_add(1);
        if node.changes >= DUPLICATE_CHANGES {
            self.tell_duplicate(i, Sign::States);
        }
    }

    /// Two devices with one node-id send twice the heartbeats that one was told to send.
    fn count_beat(&mut self, t_ns: u64, i: usize) {
        let node = &mut self.nodes[i];
        let ErrorControl::Heartbeat { consumer_ns } = node.settings.plan.error_control else { return };
        // The consumer time is three periods.
        if t_ns.saturating_sub(node.beats_since_ns) > consumer_ns / 3 * BEATS_PERIODS {
            (node.beats, node.beats_since_ns) = (0, t_ns);
        }
        node.beats = node.beats.saturating_add(1);
        if node.beats >= DUPLICATE_BEATS && node.boot.is_running() {
            self.tell_duplicate(i, Sign::Heartbeats);
        }
    }

    fn tell_duplicate(&mut self, i: usize, sign: Sign) {
        let node = &mut self.nodes[i];
        if !std::mem::replace(&mut node.told_duplicate, true) {
            let node = node.id();
            self.tell(Event::Duplicate { node, sign });
        }
    }

    fn on_boot_up(&mut self, t_ns: u64, i: usize) {
        let was_running = self.nodes[i].boot.is_running();
        self.count_change(t_ns, i);
        let node = &mut self.nodes[i];
        let id = node.id();
        (node.watch, node.state, node.wanted, node.restart_at_ns) = (None, Some(127), 127, None);
        if node.settings.boot {
            self.transfers.cancel(id, Owner::Boot);
            node.boot.on_boot_up(t_ns);
        }
        if was_running {
            self.tell(Event::Rebooted { node: id });
        }
        self.gate(t_ns, i);
    }

    fn on_emcy(&mut self, id: u8, payload: &[u8]) {
        let Some(i) = self.find(id) else { return };
        let &[low, high, register, ref vendor @ ..] = payload else { return };
        let mut bytes = [0; 5];
        let n = vendor.len().min(5);
        bytes[..n].copy_from_slice(&vendor[..n]);
        let code = u16::from_le_bytes([low, high]);
        let node = &mut self.nodes[i];
        node.emcys += 1;
        node.last_emcy = Some((code, register));
        self.tell(Event::Emcy { node: id, code, register, vendor: bytes });
        if code == EMCY_COLLISION {
            self.tell_duplicate(i, Sign::Emcy);
        }
    }

    /// Whatever time has brought. Sends SYNC first, so that nothing delays it.
    pub fn on_time(&mut self, now_ns: u64, out: &mut Outbox) {
        self.sync(now_ns, out);
        if !self.bus_off {
            self.produce(now_ns, out);
        }
        self.transfers.on_time(now_ns, out);
        self.exchange.on_time(now_ns, out);
        for i in 0..self.nodes.len() {
            self.nodes[i].boot.on_time(now_ns);
            self.guard(now_ns, i, out);
            let node = &mut self.nodes[i];
            if node.restart_at_ns.is_some_and(|at_ns| now_ns >= at_ns) {
                node.restart_at_ns = None;
                if node.boot.is_running() && node.wanted == OPERATIONAL {
                    let id = node.id();
                    self.command(NmtCommand::Start, id);
                }
            }
        }
        if self.boot_until_ns.is_some_and(|until_ns| now_ns >= until_ns) {
            self.boot_until_ns = None;
            let missing = |n: &&NodeRun| n.settings.mandatory && !n.boot.is_running();
            let count = self.nodes.iter().filter(missing).count();
            if let Some(first) = self.nodes.iter().find(missing).map(NodeRun::id) {
                self.tell(Event::MandatoryMissing { node: first, missing: count as u8 });
            }
        }
        self.settle(now_ns, out);
    }

    /// The SYNC alone, if it is due: for the beginning of a wake, before frames are taken that waited. A window that
    /// ends meanwhile ends in [`Self::on_time`], when what came inside of it has been taken.
    pub fn sync(&mut self, now_ns: u64, out: &mut Outbox) {
        let (Some(at_ns), Some(period_ns)) = (self.next_sync_ns, self.settings.sync_period_ns) else {
            return;
        };
        if now_ns < at_ns || period_ns == 0 {
            return;
        }
        let behind = (now_ns - at_ns) / period_ns;
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
        self.exchange.sync_pdos(now_ns, out);
    }

    fn produce(&mut self, now_ns: u64, out: &mut Outbox) {
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

    fn guard(&mut self, now_ns: u64, i: usize, out: &mut Outbox) {
        let node = &mut self.nodes[i];
        let Some(watch) = &mut node.watch else { return };
        if let Some(guard) = &mut watch.guard
            && now_ns >= guard.next_ns
        {
            guard.next_ns = now_ns.saturating_add(guard.every_ns);
            let can_id = (predefined::ERROR_CONTROL + u32::from(node.settings.plan.id)) | id_flag::RTR;
            out.push(CanFrame { can_id, len: 1, ..CanFrame::default() });
        }
        if now_ns >= watch.lost_at_ns {
            self.lose(now_ns, i);
        }
    }

    fn lose(&mut self, now_ns: u64, i: usize) {
        let node = &mut self.nodes[i];
        let guarding = node.watch.is_some_and(|w| w.guard.is_some());
        let (id, was_running) = (node.id(), node.boot.is_running());
        node.watch = None;
        if !was_running {
            return;
        }
        node.losses += 1;
        node.state = None;
        self.transfers.cancel(id, Owner::Boot);
        self.nodes[i].boot.on_lost(now_ns);
        self.tell(Event::Lost { node: id, guarding });
        let (policy, mandatory) = (self.nodes[i].settings.on_error, self.nodes[i].settings.mandatory);
        if policy != ErrorPolicy::Ignore {
            self.exchange.set_operational(id, false, now_ns);
        }
        self.exchange.show_state(id, 0);
        if policy == ErrorPolicy::Stop || (mandatory && self.settings.stop_all_nodes) {
            for node in &mut self.nodes {
                node.wanted = 4;
            }
            self.command(NmtCommand::Stop, 0);
            for i in 0..self.nodes.len() {
                self.gate(now_ns, i);
            }
        } else if mandatory && self.settings.reset_all_nodes {
            self.command(NmtCommand::ResetCommunication, 0);
            self.boot_all(now_ns);
        }
    }

    /// Passes what one part asks for to the others until nobody asks any more.
    fn settle(&mut self, now_ns: u64, out: &mut Outbox) {
        loop {
            let mut any = false;
            while let Some((node, end)) = self.transfers.take_boot_end() {
                any = true;
                if let Some(i) = self.find(node) {
                    self.nodes[i].boot.on_sdo(now_ns, &end);
                }
            }
            for i in 0..self.nodes.len() {
                let actions: Vec<Action> = self.nodes[i].boot.drain().collect();
                for action in actions {
                    any = true;
                    self.act(now_ns, i, action, out);
                }
            }
            if !any {
                break;
            }
        }
        self.send_commands(now_ns, out);
    }

    fn act(&mut self, now_ns: u64, i: usize, action: Action, out: &mut Outbox) {
        let id = self.nodes[i].id();
        match action {
            Action::Read { index, sub } => self.transfers.read(now_ns, id, index, sub, Owner::Boot, out),
            Action::Write(Write { index, sub, data }) => {
                self.transfers.write(now_ns, id, index, sub, data, Owner::Boot, out);
            }
            Action::ResetCommunication => {
                self.nodes[i].watch = None;
                self.command(NmtCommand::ResetCommunication, id);
            }
            Action::StartErrorControl => self.watch(now_ns, i),
            Action::Done { kept } => {
                let attempts = self.nodes[i].boot.attempts().max(1);
                self.nodes[i].last_failure = None;
                self.nodes[i].told_duplicate = false;
                self.tell(Event::Booted { node: id, attempts, kept });
                self.booted(now_ns, i, kept);
            }
            Action::Failed(failure) => {
                self.nodes[i].watch = None;
                let before = self.nodes[i].last_failure.replace(failure);
                let same = |a: Failure| (a.letter, a.expected, a.got, a.object, a.abort);
                // The same trouble is told once, not once a second.
                if before.map(same) != Some(same(failure)) {
                    self.tell(Event::BootFailed { node: id, failure });
                }
            }
        }
    }

    fn watch(&mut self, now_ns: u64, i: usize) {
        let node = &mut self.nodes[i];
        node.watch = match node.settings.plan.error_control {
            ErrorControl::None => None,
            ErrorControl::Heartbeat { consumer_ns } => Some(Watch {
                lost_at_ns: now_ns.saturating_add(consumer_ns),
                span_ns: consumer_ns,
                guard: None,
            }),
            ErrorControl::Guarding { guard_ns, factor } => {
                let span_ns = guard_ns.saturating_mul(u64::from(factor.max(1)));
                let guard = Guard { every_ns: guard_ns, next_ns: now_ns, toggle: None };
                Some(Watch { lost_at_ns: now_ns.saturating_add(span_ns), span_ns, guard: Some(guard) })
            }
        };
    }

    fn booted(&mut self, now_ns: u64, i: usize, kept: bool) {
        let id = self.nodes[i].id();
        if kept {
            self.nodes[i].wanted = OPERATIONAL;
        }
        let was_started = self.started;
        self.started = self.nodes.iter().all(|n| !n.settings.mandatory || n.boot.is_running());
        if self.started {
            self.boot_until_ns = None;
            self.state = OPERATIONAL;
        }
        if self.started && !was_started {
            self.tell(Event::NetworkStarted);
            if self.settings.start_all_nodes && self.settings.start_nodes && self.safe.is_none() {
                for node in &mut self.nodes {
                    if node.boot.is_running() {
                        node.wanted = OPERATIONAL;
                    }
                }
                self.command(NmtCommand::Start, 0);
                for i in 0..self.nodes.len() {
                    self.gate(now_ns, i);
                }
                return;
            }
        }
        let wait_for_all = self.settings.start_all_nodes && !self.started;
        if !kept && self.settings.start_nodes && !wait_for_all {
            let command = self.safe.unwrap_or(NmtCommand::Start);
            self.nodes[i].wanted = state_after(command).unwrap_or(127);
            // What it told before it was started does not keep its process data closed.
            self.nodes[i].state = None;
            self.command(command, id);
        }
        self.gate(now_ns, i);
    }

    fn send_commands(&mut self, now_ns: u64, out: &mut Outbox) {
        while !self.commands.is_empty() && now_ns >= self.next_command_ns && !self.bus_off {
            let Some((command, node)) = self.commands.pop_front() else { break };
            self.next_command_ns = now_ns.saturating_add(self.settings.nmt_inhibit_ns);
            self.counters.nmt_commands += 1;
            out.push(command.frame(node));
        }
    }

    /// When [`Self::on_time`] has something to do next.
    pub fn next_deadline(&self) -> Option<u64> {
        let nodes = self.nodes.iter().flat_map(|n| {
            let watch = n.watch.map(|w| w.guard.map_or(w.lost_at_ns, |g| g.next_ns.min(w.lost_at_ns)));
            [n.boot.next_deadline(), watch, n.restart_at_ns]
        });
        let own = [
            self.next_sync_ns,
            self.next_time_ns.filter(|_| !self.bus_off),
            self.next_heartbeat_ns.filter(|_| !self.bus_off),
            self.boot_until_ns,
            (!self.commands.is_empty() && !self.bus_off).then_some(self.next_command_ns),
            self.transfers.next_deadline(),
            self.exchange.next_deadline(),
        ];
        nodes.chain(own).flatten().min()
    }

    /// Tells a boot-up how its transfer ended; for tests and for transfers that never started.
    pub fn on_boot_sdo(&mut self, now_ns: u64, node: u8, end: &SdoEnd, out: &mut Outbox) {
        if let Some(i) = self.find(node) {
            self.nodes[i].boot.on_sdo(now_ns, end);
        }
        self.settle(now_ns, out);
    }
}

#[cfg(test)]
#[path = "network_tests.rs"]
mod tests;
