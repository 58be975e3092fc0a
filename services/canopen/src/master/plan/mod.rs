//! From the stack file and the EDS files to a network: every object resolved, every PDO placed, every mistake named.
//!
//! Sans-I/O: the EDS files are handed in as [`Device`]s.

mod check;
mod cob_ids;
mod image;
mod pdo;
mod times;
mod value;
mod writes;

pub use pdo::{Direction, Mapped, Pdo};
pub use value::encode;

use super::boot::{self, ErrorControl, Identity};
use super::exchange;
use super::network::{NodeSettings, Settings};
use crate::config::{Check, MAX_MAPS, MAX_NODES, MasterConfig as Config, Node, Restore};
use crate::device::Device;
use crate::mistakes::{Mistake, Mistakes};
use crate::protocol::data_type::unsigned;
use check::check_master;
use dinrail_iec::Addressing;
use ipc_types::wiring::ImageRange;
use pdo::PdoPlanner;
use std::collections::BTreeMap;

/// Heartbeats are awaited this many times as long as they are produced apart.
const CONSUMER_FACTOR: u64 = 3;
/// A restart of the master takes about this long: a consumer in a node that waits less sees the master die.
const RESTART_MS: u64 = 500;

/// Everything about one node.
#[derive(Debug, Clone)]
pub struct NodePlan {
    pub settings: NodeSettings,
    pub name: String,
    pub pdos: Vec<Pdo>,
}

/// COB-IDs of the network's SYNC and PDOs: whose it is, and the key that says so.
type Taken = BTreeMap<u32, (String, Option<String>)>;

/// Everything the service does.
#[derive(Debug, Default)]
pub struct Plan {
    pub settings: Settings,
    pub sync_window_ns: u64,
    pub nodes: Vec<NodePlan>,
    pub exchange: exchange::Plan,
    /// Ranges of %I in order of the `inputs` tail.
    pub inputs: Vec<ImageRange>,
    /// Ranges of %Q and %M in order of the gathered outputs.
    pub outputs: Vec<ImageRange>,
    pub mistakes: Vec<Mistake>,
}

/// Resolves the table. `devices` by node-id; a node without one is planned as far as that goes.
pub fn plan(config: &Config, devices: &BTreeMap<u8, Device>, addressing: Addressing, me: &str) -> Plan {
    let mut mistakes = Mistakes::default();
    check_master(config, &mut mistakes);
    let mut plan = Plan { settings: settings(config), ..Plan::default() };
    let period_ns = config.sync_period.map_or(0, |p| p.ns());
    plan.sync_window_ns = config.sync_window.map_or(period_ns, |w| w.ns());
    let mut taken = cob_ids::taken(config);
    for (i, node) in config.nodes.iter().take(MAX_NODES).enumerate() {
        let key = format!("node[{i}]");
        if !(1..=127).contains(&node.id) {
            let message = format!("node-id {} does not exist", node.id);
            mistakes.add(&format!("{key}.id"), message, "node-ids are 1 to 127 (CiA 301 clause 7.2.3)");
            continue;
        }
        if node.id == config.node_id {
            let message = format!("node-id {} is the master's own", node.id);
            mistakes.add(&format!("{key}.id"), message, "change node_id of the master or id of this node");
            continue;
        }
        if config.nodes[..i].iter().any(|other| other.id == node.id) {
            let message = format!("node {} is there twice", node.id);
            mistakes.add(&format!("{key}.id"), message, "every node of a network has its own node-id");
            continue;
        }
        let mut one =
            One { config, node, key: &key, addressing, me, mistakes: &mut mistakes, plan: &mut plan };
        let pdos = one.node(devices.get(&node.id), &mut taken);
        plan.nodes.push(pdos);
    }
    plan.mistakes = mistakes.0;
    plan
}

fn settings(config: &Config) -> Settings {
    Settings {
        node_id: config.node_id,
        sync_period_ns: config.sync_period.map(|p| p.ns()).filter(|&ns| ns > 0),
        sync_overflow: config.sync_overflow,
        sync_cob_id: u32::from(config.sync_cob_id),
        time_period_ns: config.time_period.map(|p| p.ns()).filter(|&ns| ns > 0),
        heartbeat_ns: config.heartbeat.ns(),
        start_nodes: config.start_nodes,
        start_all_nodes: config.start_all_nodes,
        reset_all_nodes: config.reset_all_nodes,
        stop_all_nodes: config.stop_all_nodes,
        boot_time_ns: config.boot_time.ns(),
        nmt_inhibit_ns: config.nmt_inhibit_time.ns(),
        takeover: false,
    }
}

/// The planning of one node.
struct One<'a> {
    config: &'a Config,
    node: &'a Node,
    key: &'a str,
    addressing: Addressing,
    me: &'a str,
    mistakes: &'a mut Mistakes,
    plan: &'a mut Plan,
}

impl One<'_> {
    fn node(&mut self, device: Option<&Device>, taken: &mut Taken) -> NodePlan {
        let node = self.node;
        times::check_node(node, self.key, self.mistakes);
        let name = node.name.clone().or_else(|| device.map(|d| d.name.clone())).unwrap_or_default();
        let mut settings = NodeSettings {
            plan: boot::Plan {
                id: node.id,
                identity: self.identity(device),
                keep_alive: node.keep_alive,
                restore: match node.restore {
                    Restore::No => None,
                    Restore::All => Some(1),
                    Restore::Communication => Some(2),
                    Restore::Application => Some(3),
                },
                config_stamp: match (node.config_date, node.config_time) {
                    (Some(date), Some(time)) => Some((date, time)),
                    _ => None,
                },
                writes: Vec::new(),
                error_control: self.error_control(),
                sdo_tries: self.config.sdo_tries,
            },
            mandatory: node.mandatory,
            boot: node.boot,
            on_error: node.on_error,
        };
        if node.config_date.is_some() != node.config_time.is_some() {
            let key = format!("{}.config_date", self.key);
            self.mistakes.add(
                &key,
                "a configuration has a date and a time",
                "set config_date and config_time",
            );
        }
        let Some(device) = device else {
            if !(node.map.is_empty() && node.sdo.is_empty() && node.tpdo.is_empty() && node.rpdo.is_empty()) {
                let key = format!("{}.eds", self.key);
                let message =
                    format!("node {} has a configuration, but no EDS says what its objects are", node.id);
                self.mistakes.add(&key, message, "set eds = \"FILE\", the device's EDS or DCF");
            }
            self.state_range();
            return NodePlan { settings, name, pdos: Vec::new() };
        };
        let mut writes = self.own_writes(device);
        let has_sync = self.config.sync_period.is_some();
        let mut planner = PdoPlanner::new(device, node, self.key, has_sync, self.mistakes);
        let mut placed = Vec::new();
        if node.map.len() > MAX_MAPS {
            let message = format!("{} objects are mapped, the limit is {MAX_MAPS}", node.map.len());
            self.mistakes.add(&format!("{}.map", self.key), message, "map fewer objects");
        }
        for (i, map) in node.map.iter().take(MAX_MAPS).enumerate() {
            let key = format!("{}.map[{i}]", self.key);
            placed.extend(self.place(device, &mut planner, map, &key));
        }
        planner.check(self.mistakes);
        writes.extend(planner.writes());
        self.fields(device, &planner.pdos, &placed);
        self.doubled(&planner.pdos, taken);
        self.state_range();
        settings.plan.writes = writes;
        NodePlan { settings, name, pdos: planner.pdos }
    }

    fn error_control(&self) -> ErrorControl {
        let heartbeat_ns = self.node.heartbeat.map_or(0, |h| h.ns());
        match self.node.guarding {
            _ if heartbeat_ns > 0 => {
                ErrorControl::Heartbeat { consumer_ns: heartbeat_ns.saturating_mul(CONSUMER_FACTOR) }
            }
            Some(guarding) => ErrorControl::Guarding {
                guard_ns: guarding.time.ns().max(1_000_000),
                factor: guarding.factor,
            },
            None => ErrorControl::None,
        }
    }

    fn identity(&mut self, device: Option<&Device>) -> Identity {
        let node = self.node;
        let mut get = |check: Check, over: &Option<crate::config::Number>, key: &str, object: (u16, u8)| {
            if let Some(written) = over {
                let value = written.identifier(node.id).and_then(|v| u32::try_from(v).ok());
                if value.is_none() {
                    let message = format!("{written} is no 32-bit number");
                    self.mistakes.add(
                        &format!("{}.{key}", self.key),
                        message,
                        "write it as 1234 or \"0x4D2\"",
                    );
                }
                return value;
            }
            let od = &device?.od;
            let entry = od.find(object.0, object.1).ok().filter(|_| node.check.contains(&check))?;
            // An EDS that leaves it open says 0.
            let value = unsigned(od.default_of(entry)) as u32;
            (value != 0 || check == Check::DeviceType).then_some(value)
        };
        Identity {
            device_type: get(Check::DeviceType, &node.device_type, "device_type", (0x1000, 0)),
            vendor: get(Check::Vendor, &node.vendor_id, "vendor_id", (0x1018, 1)),
            product: get(Check::Product, &node.product_code, "product_code", (0x1018, 2)),
            revision: get(Check::Revision, &node.revision, "revision", (0x1018, 3)),
            serial: get(Check::Serial, &node.serial_number, "serial_number", (0x1018, 4)),
        }
    }
}

#[cfg(test)]
mod tests;
