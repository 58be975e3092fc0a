//! Many simulated devices in one process, for benches and tests of the master. Sans-I/O.
//!
//! The devices keep to the predefined connection set (CiA 301 V4.2, clause 7.3.3): a PDO is the device's whose node-id
//! is in its identifier. Each behaves as a service of kind `canopen-slave` with the same simulation does.

use super::{drop_synchronous, is_late_sync, simulation};
use crate::config::Simulation;
use crate::device::Device;
use crate::protocol::cob_id::predefined;
use crate::protocol::eds::{BuildOptions, Eds};
use crate::protocol::io::Outbox;
use crate::protocol::node::{Node, NodeParams};
use ipc_types::payload::CanFrame;

const NOWHERE: u8 = u8::MAX;

/// Why a fleet cannot be made.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum FleetError {
    #[error("node-id {0} is none, or there twice: node-ids are 1 to 127")]
    NodeId(u8),
    #[error("the simulation's own EDS: {0}")]
    Eds(String),
}

/// See the module.
#[derive(Debug, Clone)]
pub struct Fleet {
    nodes: Vec<Node>,
    /// Without power, a device neither hears nor speaks.
    on: Vec<bool>,
    /// Place of each node-id.
    place: [u8; 128],
}

impl Fleet {
    /// Devices without power.
    pub fn new(simulation: Simulation, ids: impl IntoIterator<Item = u8>) -> Result<Self, FleetError> {
        let told = |e: &dyn std::fmt::Display| FleetError::Eds(e.to_string());
        let eds = Eds::parse(simulation::eds(simulation).as_bytes()).map_err(|e| told(&e))?;
        let options = BuildOptions { parameter_values: true, ..BuildOptions::default() };
        let mut fleet = Self { nodes: Vec::new(), on: Vec::new(), place: [NOWHERE; 128] };
        for id in ids {
            let at = fleet.place.get_mut(usize::from(id)).filter(|at| id > 0 && **at == NOWHERE);
            *at.ok_or(FleetError::NodeId(id))? = fleet.nodes.len() as u8;
            let device = Device::from_eds(&eds, id, &options).map_err(|e| told(&e))?;
            let node = Node::new(device.od, NodeParams::new(id), &[]).map_err(|e| told(&e))?;
            fleet.nodes.push(node);
            fleet.on.push(false);
        }
        Ok(fleet)
    }

    fn find(&self, id: u8) -> Option<usize> {
        self.place.get(usize::from(id)).filter(|at| **at != NOWHERE).map(|at| usize::from(*at))
    }

    /// Node-ids, in the order given.
    pub fn ids(&self) -> impl Iterator<Item = u8> + '_ {
        self.nodes.iter().map(Node::node_id)
    }

    /// A device, by node-id.
    pub fn node(&self, id: u8) -> Option<&Node> {
        self.nodes.get(self.find(id)?)
    }

    /// Boots a device that has no power; nothing happens to others and to node-ids that are not there.
    pub fn power_on(&mut self, t_ns: u64, id: u8, out: &mut Outbox) {
        let Some(i) = self.find(id).filter(|&i| !self.on[i]) else { return };
        self.on[i] = true;
        self.nodes[i].start(t_ns, out);
        self.react(t_ns, i, out);
    }

    pub fn power_off(&mut self, id: u8) {
        if let Some(i) = self.find(id) {
            self.on[i] = false;
        }
    }

    fn react(&mut self, t_ns: u64, i: usize, out: &mut Outbox) {
        while let Some(event) = self.nodes[i].next_event() {
            simulation::react(&mut self.nodes[i], &event, t_ns, out);
        }
    }

    fn hand(&mut self, now_ns: u64, i: usize, frame: &CanFrame, out: &mut Outbox) {
        if !self.on[i] {
            return;
        }
        self.nodes[i].on_frame(frame.stamp.t_ns, frame, out);
        self.react(frame.stamp.t_ns, i, out);
        if is_late_sync(&self.nodes[i], frame, now_ns) {
            drop_synchronous(out);
        }
    }

    /// Takes a frame of the bus, the fleet's own echoes too. `now_ns` tells how late it is taken.
    pub fn on_frame(&mut self, now_ns: u64, frame: &CanFrame, out: &mut Outbox) {
        if frame.is_error() || frame.is_extended() || frame.is_fd() {
            return;
        }
        let id = frame.id();
        let own = self.find((id & 0x7F) as u8);
        let of_all = match id & 0x780 {
            // NMT, SYNC, TIME, LSS.
            _ if matches!(id, predefined::NMT | predefined::SYNC | predefined::TIME)
                || id == predefined::LSS_MASTER =>
            {
                true
            }
            // Of a device outside: others may watch it. The fleet's own it does not hear.
            predefined::ERROR_CONTROL if !frame.is_remote() => match own {
                None => true,
                Some(_) => return,
            },
            predefined::EMCY => return,
            _ => false,
        };
        if of_all {
            (0..self.nodes.len()).for_each(|i| self.hand(now_ns, i, frame, out));
        } else if let Some(i) = own {
            self.hand(now_ns, i, frame, out);
        }
    }

    pub fn on_time(&mut self, t_ns: u64, out: &mut Outbox) {
        for i in 0..self.nodes.len() {
            if self.on[i] {
                self.nodes[i].on_time(t_ns, out);
                self.react(t_ns, i, out);
            }
        }
    }

    /// When [`Self::on_time`] has something to do next.
    pub fn next_deadline(&self) -> Option<u64> {
        let on = self.nodes.iter().zip(&self.on).filter(|(_, on)| **on);
        on.filter_map(|(node, _)| node.next_deadline()).min()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::protocol::nmt::{NmtCommand, NmtState};

    const MS: u64 = 1_000_000;

    fn at(t_ns: u64, frame: CanFrame) -> CanFrame {
        let mut frame = frame;
        frame.stamp.t_ns = t_ns;
        frame
    }

    fn ids(out: &mut Outbox) -> Vec<u32> {
        out.drain().map(|f| f.id()).collect()
    }

    fn write(fleet: &mut Fleet, id: u8, index: u16, sub: u8, data: &[u8]) {
        let mut out = Outbox::default();
        let i = fleet.find(id).unwrap();
        fleet.nodes[i].write(0, index, sub, data, &mut out).unwrap();
    }

    #[test]
    fn each_device_answers_for_itself_and_one_without_power_is_silent() {
        let mut fleet = Fleet::new(Simulation::Cia401, 2..=4).unwrap();
        let mut out = Outbox::default();
        (2..=4).for_each(|id| fleet.power_on(0, id, &mut out));
        assert_eq!(ids(&mut out), [0x702, 0x703, 0x704]);
        fleet.on_frame(1, &at(1, CanFrame::classic(0x603, &[0x40, 0, 0x10, 0, 0, 0, 0, 0])), &mut out);
        assert_eq!(ids(&mut out), [0x583]);
        fleet.power_off(3);
        fleet.on_frame(2, &at(2, CanFrame::classic(0x603, &[0x40, 0, 0x10, 0, 0, 0, 0, 0])), &mut out);
        assert!(ids(&mut out).is_empty());
        fleet.on_frame(3, &at(3, NmtCommand::Start.frame(0)), &mut out);
        let states = [2, 3, 4].map(|id| fleet.node(id).unwrap().state());
        assert_eq!(states, [NmtState::Operational, NmtState::PreOperational, NmtState::Operational]);
        // Their own boot-up messages, come back as echoes, are no second device.
        fleet.on_frame(4, &at(4, CanFrame::classic(0x702, &[0])), &mut out);
        assert_eq!(fleet.node(2).unwrap().error_register(), 0);
        assert_eq!(Fleet::new(Simulation::Cia401, [5, 5]).unwrap_err(), FleetError::NodeId(5));
    }

    #[test]
    fn a_sync_that_is_taken_behind_its_window_sends_nothing() {
        let mut fleet = Fleet::new(Simulation::Cia401, 2..=3).unwrap();
        let mut out = Outbox::default();
        for id in 2..=3 {
            fleet.power_on(0, id, &mut out);
            write(&mut fleet, id, 0x1800, 2, &[1]);
            write(&mut fleet, id, 0x1007, 0, &5000u32.to_le_bytes());
        }
        fleet.on_frame(1, &at(1, NmtCommand::Start.frame(0)), &mut out);
        out.drain().count();
        let sync = at(10 * MS, CanFrame::classic(0x80, &[]));
        fleet.on_frame(12 * MS, &sync, &mut out);
        assert_eq!(ids(&mut out), [0x182, 0x183]);
        fleet.on_frame(16 * MS, &sync, &mut out);
        assert!(ids(&mut out).is_empty());
    }
}
