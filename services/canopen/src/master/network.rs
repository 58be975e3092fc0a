//! The network as its master sees it: who is there, in which state, and what is done about it. Sans-I/O.
//!
//! Frames and time in, frames and [`Event`]s out. The boot-up of each node is [`super::boot`], process data is
//! [`super::exchange`], SDO transfers are [`super::transfers`], LSS is [`super::lss`]; this module decides between
//! them.

mod bus;
mod command;
mod emcy;
mod produce;
mod types;
mod watch;

pub use command::state_name;
pub use emcy::{EmcyEntry, EmcyLog, NodeEmcys, ResetBy};
pub use types::{Counters, Event, NodeRun, NodeSettings, Settings, Sign};

use super::boot::{Action, Failure, OPERATIONAL, SdoEnd, Write};
use super::exchange::Exchange;
use super::lss::LssJobs;
use super::transfers::{Owner, Transfers};
use crate::protocol::cob_id::predefined;
use crate::protocol::io::Outbox;
use crate::protocol::nmt::NmtCommand;
use command::MAX_COMMANDS;
use ipc_types::payload::CanFrame;
use std::collections::VecDeque;

/// Events kept until the caller takes them; more are counted.
const MAX_EVENTS: usize = 256;

/// See the module.
#[derive(Debug)]
pub struct Network {
    settings: Settings,
    nodes: Vec<NodeRun>,
    /// Place in `nodes` of each node-id.
    place: [u8; 128],
    pub exchange: Exchange,
    pub transfers: Transfers,
    pub lss: LssJobs,
    pub emcys: EmcyLog,
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
            lss: LssJobs::default(),
            emcys: EmcyLog::default(),
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
                // The answer to a question of before would be taken for one to the first question.
                self.transfers.cancel(node.id(), Owner::Boot);
                node.boot.stop();
                node.boot.start(now_ns);
            }
        }
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
        if id == predefined::LSS_SLAVE {
            return self.lss.on_frame(t_ns, frame);
        }
        match id & 0x780 {
            predefined::SDO_TX => self.transfers.on_frame(t_ns, node, frame, out),
            predefined::ERROR_CONTROL if !frame.is_remote() && node != 0 => {
                self.on_error_control(t_ns, node, frame.payload());
            }
            predefined::EMCY if node != 0 => self.on_emcy(t_ns, node, frame.payload()),
            _ => {
                self.exchange.on_frame(t_ns, frame);
                return;
            }
        }
        self.settle(t_ns, out);
    }

    /// Whatever time has brought. Sends SYNC first, so that nothing delays it.
    pub fn on_time(&mut self, now_ns: u64, out: &mut Outbox) {
        self.sync_and_pdos(now_ns, out);
        if !self.bus_off {
            self.produce(now_ns, out);
        }
        self.transfers.on_time(now_ns, out);
        if !self.bus_off {
            self.lss.on_time(now_ns, out);
        }
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
                let node = &mut self.nodes[i];
                node.booted_ns = Some((now_ns, now_ns.saturating_sub(node.boot.began_ns())));
                (node.kept, node.last_failure) = (kept, None);
                self.nodes[i].told_duplicate = false;
                let loaded = self.nodes[i].boot.loaded();
                self.tell(Event::Booted { node: id, attempts, kept, loaded });
                self.booted(now_ns, i, kept);
            }
            Action::Failed(failure) => {
                self.nodes[i].watch = None;
                self.nodes[i].failed_ns = Some(now_ns);
                let before = self.nodes[i].last_failure.replace(failure);
                let same = |a: Failure| (a.letter, a.expected, a.got, a.object, a.abort);
                // The same trouble is told once, not once a second.
                if before.map(same) != Some(same(failure)) {
                    self.tell(Event::BootFailed { node: id, failure });
                }
            }
        }
    }

    fn booted(&mut self, now_ns: u64, i: usize, kept: bool) {
        let id = self.nodes[i].id();
        // Of the safe state before this boot-up: whether it is to run is decided anew.
        self.nodes[i].held = false;
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
            if self.settings.start_all_nodes && self.settings.start_nodes {
                return self.start_all(now_ns);
            }
        }
        let wait_for_all = self.settings.start_all_nodes && !self.started;
        if kept {
            // The safe state holds for a node that was found running, too.
            if let Some(safe) = self.safe {
                self.hold(now_ns, i, safe);
            }
        } else if self.settings.start_nodes && !wait_for_all {
            match self.safe {
                Some(safe) => self.hold(now_ns, i, safe),
                None => {
                    let node = &mut self.nodes[i];
                    // What it told before it was started does not keep its process data closed.
                    (node.wanted, node.state) = (OPERATIONAL, None);
                    self.command(NmtCommand::Start, id);
                }
            }
        }
        self.gate(now_ns, i);
    }

    /// All booted nodes at once (1F80h bit 1), or all into the safe state.
    fn start_all(&mut self, now_ns: u64) {
        for i in 0..self.nodes.len() {
            if !self.nodes[i].boot.is_running() {
                continue;
            }
            match self.safe {
                Some(safe) => self.hold(now_ns, i, safe),
                None => {
                    let node = &mut self.nodes[i];
                    (node.wanted, node.state) = (OPERATIONAL, None);
                    self.gate(now_ns, i);
                }
            }
        }
        if self.safe.is_none() {
            self.command(NmtCommand::Start, 0);
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
            self.lss.next_deadline().filter(|_| !self.bus_off),
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
