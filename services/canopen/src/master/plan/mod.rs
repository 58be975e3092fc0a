//! From the stack file and the EDS files to a network: every object resolved, every PDO placed, every mistake named.
//!
//! Sans-I/O: the EDS files are handed in as [`Device`]s.

mod pdo;
mod value;

pub use pdo::{Direction, Mapped, Pdo};
pub use value::encode;

use super::boot::{self, ErrorControl, Identity, Write};
use super::exchange::{self, Field, RxPdo, TxPdo, transmission};
use super::network::{NodeSettings, Settings};
use crate::config::{
    Check, MAX_MAPS, MAX_NODES, MAX_SDO_WRITES, Map, MasterConfig as Config, Node, OnBadWord, Restore,
};
use crate::device::Device;
use crate::mistakes::{Mistake, Mistakes};
use crate::place::{self, iec_type};
use crate::protocol::cob_id::CobId;
use crate::protocol::data_type::{DataType, unsigned};
use dinrail_iec::artifact::AreaKind;
use dinrail_iec::{Addressing, LocatedAddress, parse_address};
use ipc_types::wiring::{Area, ImageRange, OnBad};
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
    let mut taken: BTreeMap<u32, String> = BTreeMap::new();
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

fn check_master(config: &Config, mistakes: &mut Mistakes) {
    if !(1..=127).contains(&config.node_id) {
        let message = format!("node-id {} does not exist", config.node_id);
        mistakes.add("node_id", message, "node-ids are 1 to 127 (CiA 301 clause 7.2.3)");
    }
    if config.nodes.len() > MAX_NODES {
        let message =
            format!("{} nodes: a network has at most {MAX_NODES} besides its master", config.nodes.len());
        mistakes.add("node", message, "split them over two buses");
    }
    if config.nodes.is_empty() {
        mistakes.warn(
            "node",
            "the master has no nodes",
            "add [[service.node]]; `dinrail canopen scan --toml` finds them",
        );
    }
    if config.sync_overflow == 1 || config.sync_overflow > 240 {
        let message = format!("a SYNC counter cannot overflow at {}", config.sync_overflow);
        mistakes.add(
            "sync_overflow",
            message,
            "take 0 for no counter, or 2 to 240 (CiA 301 clause 7.5.2.22)",
        );
    }
    if let Some(period) = config.sync_period
        && period.ns() < 1_000_000
    {
        let help = "take 1ms or more: one frame needs 0.13 ms at 1 Mbit/s";
        mistakes.add("sync_period", "the SYNC comes faster than a bus can carry it", help);
    }
    if let (Some(window), Some(period)) = (config.sync_window, config.sync_period)
        && window.ns() > period.ns()
    {
        mistakes.add(
            "sync_window",
            "the window is longer than the SYNC period",
            "make it shorter, or leave it out",
        );
    }
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
    fn node(&mut self, device: Option<&Device>, taken: &mut BTreeMap<u32, String>) -> NodePlan {
        let node = self.node;
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
                let value = written.integer(node.id).and_then(|v| u32::try_from(v).ok());
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

    /// What is written before the PDOs: the DCF's values, the stack file's, error control.
    fn own_writes(&mut self, device: &Device) -> Vec<Write> {
        let node = self.node;
        let mut writes: Vec<Write> = device
            .values
            .iter()
            .map(|(index, sub, data)| Write { index: *index, sub: *sub, data: data.clone() })
            .collect();
        if node.sdo.len() > MAX_SDO_WRITES {
            let message = format!("{} objects are written, the limit is {MAX_SDO_WRITES}", node.sdo.len());
            self.mistakes.add(&format!("{}.sdo", self.key), message, "put them into a DCF");
        }
        for (i, sdo) in node.sdo.iter().take(MAX_SDO_WRITES).enumerate() {
            let key = format!("{}.sdo[{i}]", self.key);
            match device.resolve(&sdo.object) {
                Ok((index, sub)) => writes.extend(self.sdo_write(device, index, sub, &sdo.value, &key)),
                Err(message) => self.mistakes.add(&format!("{key}.object"), message, "write one of those"),
            }
        }
        self.sync_writes(device, &mut writes);
        writes.extend(self.error_control_writes(device));
        writes
    }

    /// What a consumer of the SYNC must know: whether it has a counter (1019h), and how long its window is (1007h).
    fn sync_writes(&mut self, device: &Device, writes: &mut Vec<Write>) {
        let config = self.config;
        if config.sync_period.is_none() {
            return;
        }
        let writable = |index| {
            let entry = device.od.find(index, 0).ok().and_then(|e| device.od.entry(e));
            entry.is_some_and(|e| e.access.writable())
        };
        let by_hand = |index| {
            self.node.sdo.iter().any(|w| matches!(w.object.number(), Some((written, _)) if written == index))
        };
        if let Some(window) = config.sync_window
            && writable(0x1007)
            && !by_hand(0x1007)
        {
            let us = u32::try_from(window.ns() / 1000).unwrap_or(u32::MAX);
            writes.push(Write { index: 0x1007, sub: 0, data: us.to_le_bytes().to_vec() });
        }
        if config.sync_overflow == 0 || by_hand(0x1019) {
            return;
        }
        if writable(0x1019) {
            writes.push(Write { index: 0x1019, sub: 0, data: vec![config.sync_overflow] });
        } else {
            let message =
                format!("node {} knows no SYNC counter: its EDS lacks a writable 1019h", self.node.id);
            let help = "it answers a SYNC with counter by emergency 8240h; leave sync_overflow out";
            self.mistakes.warn(&format!("{}.eds", self.key), message, help);
        }
    }

    fn sdo_write(
        &mut self,
        device: &Device,
        index: u16,
        sub: u8,
        value: &crate::config::Number,
        key: &str,
    ) -> Option<Write> {
        let entry = device.od.find(index, sub).ok().and_then(|e| device.od.entry(e))?;
        if !entry.access.writable() {
            let message = format!("{index:04X}:{sub:02X} has access '{}'", entry.access.word());
            self.mistakes.add(&format!("{key}.object"), message, "leave it out: it cannot be written");
            return None;
        }
        match encode(value, entry, self.node.id) {
            Ok(data) => Some(Write { index, sub, data }),
            Err(message) => {
                self.mistakes.add(&format!("{key}.value"), message, "write a value of the object's type");
                None
            }
        }
    }

    fn error_control_writes(&mut self, device: &Device) -> Vec<Write> {
        let mut writes = Vec::new();
        let has = |index, sub| {
            device
                .od
                .find(index, sub)
                .ok()
                .and_then(|e| device.od.entry(e))
                .is_some_and(|e| e.access.writable())
        };
        let ms = |ns: u64| (ns / 1_000_000).min(u64::from(u16::MAX)) as u16;
        match self.error_control() {
            ErrorControl::Heartbeat { .. } => {
                let period = self.node.heartbeat.map_or(0, |h| ms(h.ns()));
                if has(0x1017, 0) {
                    writes.push(Write { index: 0x1017, sub: 0, data: period.to_le_bytes().to_vec() });
                } else {
                    let help = "leave heartbeat out, or use guarding = { time = \"100ms\", factor = 3 }";
                    let message =
                        format!("node {} has no heartbeat: its EDS lacks a writable 1017h", self.node.id);
                    self.mistakes.add(&format!("{}.heartbeat", self.key), message, help);
                }
                self.consumer_write(device, &mut writes);
            }
            ErrorControl::Guarding { guard_ns, factor } => {
                if has(0x100C, 0) && has(0x100D, 0) {
                    writes.push(Write { index: 0x100C, sub: 0, data: ms(guard_ns).to_le_bytes().to_vec() });
                    writes.push(Write { index: 0x100D, sub: 0, data: vec![factor] });
                } else {
                    let message =
                        format!("node {} has no guarding: its EDS lacks 100Ch or 100Dh", self.node.id);
                    self.mistakes.add(
                        &format!("{}.guarding", self.key),
                        message,
                        "use heartbeat = \"100ms\"",
                    );
                }
            }
            ErrorControl::None => {}
        }
        let written = |w: &&crate::config::SdoWrite| matches!(w.object.number(), Some((0x1016, _)));
        for sdo in self.node.sdo.iter().filter(written) {
            let time = sdo.value.integer(self.node.id).unwrap_or(0) & 0xFFFF;
            if time > 0 && (time as u64) < RESTART_MS {
                let message = format!(
                    "node {} waits {time} ms for a heartbeat (1016h), shorter than a restart of the master ({RESTART_MS} ms)",
                    self.node.id
                );
                let help = "a restarted master would find it in its error state: set 500 ms or more";
                self.mistakes.warn(&format!("{}.sdo", self.key), message, help);
            }
        }
        writes
    }

    /// The node watches the master, unless the stack file sets 1016h itself.
    fn consumer_write(&mut self, device: &Device, writes: &mut Vec<Write>) {
        let by_hand = self.node.sdo.iter().any(|w| matches!(w.object.number(), Some((0x1016, _))));
        let heartbeat_ms = self.config.heartbeat.ns() / 1_000_000;
        let entry = device.od.find(0x1016, 1).ok().and_then(|e| device.od.entry(e));
        if by_hand || heartbeat_ms == 0 || entry.is_none_or(|e| !e.access.writable()) {
            return;
        }
        let wait_ms = (heartbeat_ms * CONSUMER_FACTOR).clamp(RESTART_MS, u64::from(u16::MAX)) as u32;
        let value = u32::from(self.config.node_id) << 16 | wait_ms;
        writes.push(Write { index: 0x1016, sub: 1, data: value.to_le_bytes().to_vec() });
    }

    /// Finds place and PDO of one `map` entry.
    fn place(
        &mut self,
        device: &Device,
        planner: &mut PdoPlanner<'_>,
        map: &Map,
        key: &str,
    ) -> Option<Placed> {
        let object = match device.resolve(&map.object) {
            Ok(object) => object,
            Err(message) => {
                self.mistakes.add(&format!("{key}.object"), message, "map one of those");
                return None;
            }
        };
        let (direction, text, end) = match (&map.to, &map.from) {
            (Some(to), None) => (Direction::Tpdo, to, "to"),
            (None, Some(from)) => (Direction::Rpdo, from, "from"),
            _ => {
                let help = "to = \"%IB0\" for what the node sends, from = \"%QB0\" for what it receives";
                self.mistakes.add(key, "an object goes to %I or comes from %Q or %M", help);
                return None;
            }
        };
        let end = format!("{key}.{end}");
        let at = match parse_address(text, self.addressing) {
            Ok(at) => at,
            Err(e) => {
                self.mistakes.add(&end, e.to_string(), "write an address like %IB0 or %QX1.0");
                return None;
            }
        };
        let is_input = at.area == AreaKind::Input;
        if is_input != (direction == Direction::Tpdo) {
            let (message, help) = if is_input {
                (
                    format!("{text} is an input; a node receives what comes from %Q or %M"),
                    "use to = for what it sends",
                )
            } else {
                (
                    format!("{text} is no input; what a node sends goes to %I"),
                    "use from = for what it receives",
                )
            };
            self.mistakes.add(&end, message, help);
            return None;
        }
        let number = planner.place(direction, object, &format!("{key}.object"), self.mistakes)?;
        let entry = device.od.find(object.0, object.1).ok().and_then(|e| device.od.entry(e))?;
        if let Err(message) = place::fits(entry, at, text) {
            self.mistakes.add(&end, message, "take a larger place: B has 8 bits, W 16, D 32, L 64");
            return None;
        }
        let bits = u32::from(entry.pdo_bits().unwrap_or(0));
        let status =
            map.status_to.as_ref().and_then(|text| self.status_byte(text, &format!("{key}.status_to")));
        Some(Placed {
            pdo: (planner.pdos[number].direction, planner.pdos[number].number),
            object,
            at,
            bits: bits as u16,
            data_type: entry.data_type,
            symbol: map.symbol.clone(),
            on_bad: if map.on_bad == OnBadWord::Zero { OnBad::Zero } else { OnBad::Hold },
            status,
            key: end,
        })
    }

    fn status_byte(&mut self, text: &str, key: &str) -> Option<u32> {
        match parse_address(text, self.addressing) {
            Ok(at) if at.area == AreaKind::Input && at.size.bits() == 8 => Some(at.byte),
            _ => {
                let message = format!("{text} is no byte of %I");
                self.mistakes.add(key, message, "write an address like %IB10");
                None
            }
        }
    }

    /// `status_to` of the node: its NMT state as a range of %I.
    fn state_range(&mut self) {
        let Some(text) = &self.node.status_to else { return };
        let key = format!("{}.status_to", self.key);
        let Some(byte) = self.status_byte(text, &key) else { return };
        let range = self.plan.inputs.len() as u16;
        let at = self.plan.exchange.input_bytes.iter().map(|&n| u32::from(n)).sum();
        self.plan.exchange.states.push((self.node.id, at, range));
        self.plan.exchange.input_bytes.push(1);
        self.plan.inputs.push(ImageRange {
            area: Area::Input,
            byte,
            bit: None,
            bytes: 1,
            type_name: Some("USINT".to_owned()),
            symbol: None,
            label: format!("{} node {} NMT state", self.me, self.node.id),
            key,
            on_bad: OnBad::Zero,
            status_byte: None,
        });
    }

    /// Puts the placed objects into the exchange and the wiring.
    fn fields(&mut self, device: &Device, pdos: &[Pdo], placed: &[Placed]) {
        for pdo in pdos.iter().filter(|p| p.used && p.is_active()) {
            let mut fields = Vec::new();
            for placed in placed.iter().filter(|p| p.pdo == (pdo.direction, pdo.number)) {
                let Some(bit) = pdo.bit_of(placed.object.0, placed.object.1) else { continue };
                fields.push(self.field(device, pdo, placed, bit));
            }
            if fields.is_empty() {
                continue;
            }
            let cob_id = CobId(pdo.cob_id).can_id();
            let event_ns = Some(u64::from(pdo.event) * 1_000_000).filter(|&ns| ns > 0);
            if pdo.direction == Direction::Tpdo {
                let polled = matches!(pdo.transmission, transmission::RTR | transmission::SYNC_RTR);
                self.plan.exchange.rx.push(RxPdo {
                    cob_id,
                    node: self.node.id,
                    length: pdo.bytes(),
                    transmission: pdo.transmission,
                    // An event-driven PDO with an event timer must come at least that often.
                    deadline_ns: event_ns
                        .filter(|_| pdo.transmission >= transmission::EVENT_MANUFACTURER)
                        .map(|ns| 3 * ns),
                    poll_ns: if polled { event_ns.or(Some(100_000_000)) } else { None },
                    fields,
                });
            } else {
                self.plan.exchange.tx.push(TxPdo {
                    cob_id,
                    node: self.node.id,
                    length: pdo.bytes(),
                    transmission: pdo.transmission,
                    inhibit_ns: u64::from(pdo.inhibit) * 100_000,
                    event_ns,
                    fields,
                });
            }
        }
    }

    fn field(&mut self, device: &Device, pdo: &Pdo, placed: &Placed, pdo_bit: u16) -> Field {
        let bytes = placed.at.size.bytes() as u8;
        let (index, sub) = placed.object;
        let name = device.name_of(index, sub).unwrap_or("object");
        let what = format!(
            "node {} {index:04X}:{sub:02X} {name}, {} {}",
            self.node.id,
            pdo.direction.name(),
            pdo.number
        );
        let range = ImageRange {
            area: match placed.at.area {
                AreaKind::Input => Area::Input,
                AreaKind::Output => Area::Output,
                AreaKind::Marker | AreaKind::Retain | AreaKind::Data => Area::Marker,
            },
            byte: placed.at.byte,
            bit: placed.at.bit,
            bytes: placed.at.size.bytes(),
            type_name: Some(iec_type(placed.data_type, placed.at).to_owned()),
            symbol: placed.symbol.clone(),
            label: what,
            key: placed.key.clone(),
            on_bad: placed.on_bad,
            status_byte: placed.status,
        };
        let signed = placed.data_type.is_signed();
        if pdo.direction == Direction::Tpdo {
            let at = self.plan.exchange.input_bytes.iter().map(|&n| u32::from(n)).sum();
            let number = self.plan.inputs.len() as u16;
            self.plan.exchange.input_bytes.push(bytes);
            self.plan.inputs.push(range);
            Field { pdo_bit, bits: placed.bits, at, bytes, signed, range: number }
        } else {
            let at = self.plan.exchange.output_bytes as u32;
            self.plan.exchange.output_bytes += usize::from(bytes);
            self.plan.outputs.push(range);
            Field { pdo_bit, bits: placed.bits, at, bytes, signed, range: 0 }
        }
    }

    /// Two PDOs of the network with one COB-ID.
    fn doubled(&mut self, pdos: &[Pdo], taken: &mut BTreeMap<u32, String>) {
        for pdo in pdos.iter().filter(|p| p.is_active() && (p.used || p.direction == Direction::Tpdo)) {
            let id = CobId(pdo.cob_id).can_id();
            let what = format!("{} {} of node {}", pdo.direction.name(), pdo.number, self.node.id);
            if let Some(other) = taken.get(&id) {
                let message =
                    format!("{what} and {other} have the same COB-ID {:03X}h", CobId(pdo.cob_id).id());
                self.mistakes.add(self.key, message, "give one of them another with cob_id");
            } else {
                taken.insert(id, what);
            }
        }
    }
}

/// One `map` entry, resolved.
struct Placed {
    pdo: (Direction, u16),
    object: (u16, u8),
    at: LocatedAddress,
    bits: u16,
    data_type: DataType,
    symbol: Option<String>,
    on_bad: OnBad,
    status: Option<u32>,
    key: String,
}

#[cfg(test)]
mod tests;
