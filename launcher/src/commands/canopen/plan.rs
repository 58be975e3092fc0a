//! `dinrail canopen plan` and `dcf make`: what a master will do, without a bus.

use super::super::{println, table};
use super::DcfCommand;
use crate::stackfile::load;
use anyhow::Context as _;
use dinrail_can::protocol::busload::{Stuffing, bits};
use dinrail_can::protocol::frame::Frame;
use dinrail_canopen::config::MasterConfig;
use dinrail_canopen::device::Device;
use dinrail_canopen::master::plan::{Direction, Pdo, Plan, plan};
use dinrail_canopen::protocol::cob_id::CobId;
use dinrail_canopen::protocol::eds::{DcfOptions, Eds};
use dinrail_canopen::service::load::devices;
use dinrail_iec::Addressing;
use ipc_types::stack::ServiceEntry;
use ipc_types::{Stack, plc_table};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::path::Path;

const KIND: &str = "canopen-master";

struct Network {
    name: String,
    config: MasterConfig,
    devices: BTreeMap<u8, Device>,
    plan: Plan,
    /// Bit rate of its bus, where the stack file says it.
    bitrate: Option<u32>,
}

fn networks(path: &Path) -> anyhow::Result<(Stack, Vec<Network>)> {
    let loaded = load(path).map_err(|e| anyhow::anyhow!("{e}"))?;
    let stack = loaded.stack;
    let all: anyhow::Result<Vec<Network>> =
        stack.services.iter().filter(|s| s.kind == KIND).map(|s| network(&stack, s)).collect();
    let all = all?;
    anyhow::ensure!(!all.is_empty(), "stack '{}' has no {KIND} service", stack.name);
    Ok((stack, all))
}

fn network(stack: &Stack, service: &ServiceEntry) -> anyhow::Result<Network> {
    let config: MasterConfig = serde_json::from_value(service.config.clone())?;
    let (devices, _) = devices(&config, &stack.dir);
    let plc = service.wiring.plc.as_deref().and_then(|plc| stack.service(plc));
    let addressing =
        plc.and_then(|p| Addressing::from_name(plc_table::addressing(&p.config))).unwrap_or_default();
    let plan = plan(&config, &devices, addressing, &service.name);
    let bus = service.wiring.reads.iter().find_map(|r| r.topic.strip_suffix("/rx"));
    let rate = bus.and_then(|bus| stack.service(bus)).and_then(|bus| bus.config.get("bitrate"));
    let bitrate = rate.and_then(|rate| match rate {
        Value::Number(n) => n.as_u64().and_then(|n| u32::try_from(n).ok()),
        Value::String(text) => text.parse::<ipc_types::units::BitRate>().ok().map(|r| r.0),
        _ => None,
    });
    Ok(Network { name: service.name.clone(), config, devices, plan, bitrate })
}

/// Times a second that a PDO is sent when nothing but its timers sends it; `None` where only events do.
fn rate(pdo: &Pdo, sync_ns: Option<u64>) -> Option<f64> {
    match pdo.transmission {
        1..=240 => sync_ns.map(|ns| 1e9 / ns as f64 / f64::from(pdo.transmission)),
        254 | 255 if pdo.event > 0 => Some(1000.0 / f64::from(pdo.event)),
        _ => None,
    }
}

/// Most bits of a PDO on the wire.
fn wire_bits(pdo: &Pdo) -> u32 {
    let cob = CobId(pdo.cob_id);
    let payload = vec![0; usize::from(pdo.bytes()).min(8)];
    Frame::data(cob.id(), cob.is_extended(), &payload)
        .map_or(0, |frame| bits(&frame, Stuffing::Worst).nominal)
}

fn object_name(device: Option<&Device>, index: u16, sub: u8) -> String {
    match device.and_then(|d| d.name_of(index, sub)) {
        Some(name) => format!("{index:04X}:{sub:02X} {name}"),
        None => format!("{index:04X}:{sub:02X}"),
    }
}

pub fn run(path: &Path, as_json: bool) -> anyhow::Result<()> {
    let (_, networks) = networks(path)?;
    if as_json {
        let list: Vec<Value> = networks.iter().map(as_value).collect();
        println(&Value::Array(list).to_string());
        return Ok(());
    }
    for (i, network) in networks.iter().enumerate() {
        if i > 0 {
            println("");
        }
        println(text(network).trim_end());
    }
    Ok(())
}

fn as_value(network: &Network) -> Value {
    let nodes: Vec<Value> = network
        .plan
        .nodes
        .iter()
        .map(|node| {
            let pdos: Vec<&Pdo> = node.pdos.iter().filter(|p| p.is_active()).collect();
            json!({
                "id": node.settings.plan.id,
                "name": node.name,
                "pdos": pdos,
                "writes": node.settings.plan.writes.len(),
            })
        })
        .collect();
    json!({ "service": network.name, "nodes": nodes })
}

fn text(network: &Network) -> String {
    let sync_ns = network.config.sync_period.map(|p| p.ns());
    let mut rows = Vec::new();
    let mut per_second = 0.0;
    let mut by_event = 0;
    for node in &network.plan.nodes {
        let id = node.settings.plan.id;
        let device = network.devices.get(&id);
        for pdo in node.pdos.iter().filter(|p| p.is_active() && (p.used || p.direction == Direction::Tpdo)) {
            let rate = rate(pdo, sync_ns);
            match rate {
                Some(rate) => per_second += rate * f64::from(wire_bits(pdo)),
                None => by_event += 1,
            }
            let objects: Vec<String> =
                pdo.mapping.iter().map(|m| object_name(device, m.index, m.sub)).collect();
            rows.push(vec![
                id.to_string(),
                format!("{} {}", pdo.direction.name(), pdo.number),
                format!("{:03X}h", CobId(pdo.cob_id).id()),
                pdo.transmission.to_string(),
                pdo.bytes().to_string(),
                rate.map_or_else(|| "on event".to_owned(), |r| format!("{r:.0}/s")),
                if pdo.used { objects.join(", ") } else { format!("(not used) {}", objects.join(", ")) },
            ]);
        }
    }
    if let Some(ns) = sync_ns {
        let length = u8::from(network.config.sync_overflow > 0);
        let frame = Frame::data(u32::from(network.config.sync_cob_id), false, &vec![0; usize::from(length)]);
        per_second += 1e9 / ns as f64 * frame.map_or(0.0, |f| f64::from(bits(&f, Stuffing::Worst).nominal));
    }
    let head = ["NODE", "PDO", "COB-ID", "TYPE", "BYTES", "RATE", "OBJECTS"];
    let mut text = format!("{}\n\n{}", network.name, table(&head, &rows));
    let load = match network.bitrate {
        Some(rate) if rate > 0 => {
            format!("{:.1} % of {} kbit/s", per_second / f64::from(rate) * 100.0, rate / 1000)
        }
        _ => format!("{:.0} bit/s", per_second),
    };
    text.push_str(&format!("\nload by SYNC and timers, with most stuff bits: {load}"));
    if by_event > 0 {
        text.push_str(&format!("; {by_event} PDOs come on events besides"));
    }
    for node in &network.plan.nodes {
        let id = node.settings.plan.id;
        text.push_str(&format!(
            "\nnode {id}: {} objects are written at boot",
            node.settings.plan.writes.len()
        ));
    }
    text + "\n"
}

/// The EDS of a node with the values that its master writes.
pub fn dcf(command: &DcfCommand, as_json: bool) -> anyhow::Result<()> {
    let DcfCommand::Make { stack: path, node, service, output } = command;
    let (node, service) = (*node, service.as_deref());
    let (stack, networks) = networks(path)?;
    let network = match (service, networks.as_slice()) {
        (Some(name), all) => all.iter().find(|n| n.name == name),
        (None, [only]) => Some(only),
        (None, _) => anyhow::bail!("the stack has several masters; say which one with --service NAME"),
    };
    let network =
        network.with_context(|| format!("the stack has no {KIND} '{}'", service.unwrap_or_default()))?;
    let planned = network.plan.nodes.iter().find(|n| n.settings.plan.id == node);
    let entry = network.config.nodes.iter().find(|n| n.id == node);
    let (planned, eds) = match (planned, entry.and_then(|n| n.eds.as_ref())) {
        (Some(planned), Some(eds)) => (planned, eds),
        (None, _) => anyhow::bail!("{} has no node {node}", network.name),
        (Some(_), None) => anyhow::bail!("node {node} has no EDS: set eds = \"FILE\" in its table"),
    };
    let file = stack.dir.join(eds);
    let bytes = std::fs::read(&file).with_context(|| format!("reading {}", file.display()))?;
    let eds = Eds::parse(&bytes).with_context(|| file.display().to_string())?;
    // Of the PDO lock-step only the last value of each object is what the node is left with.
    let mut values: BTreeMap<(u16, u8), Vec<u8>> = BTreeMap::new();
    for write in &planned.settings.plan.writes {
        values.insert((write.index, write.sub), write.data.clone());
    }
    let values: Vec<_> = values.into_iter().map(|((index, sub), data)| (index, sub, data)).collect();
    let mut options = DcfOptions::default();
    options.commissioning.node_id = node;
    options.commissioning.node_name = planned.name.clone();
    options.commissioning.baud_rate = network.bitrate.map_or(0, |r| (r / 1000) as u16);
    let text = eds.dcf(&options, &values)?;
    match output {
        Some(path) => {
            std::fs::write(path, text).with_context(|| format!("writing {}", path.display()))?;
            if as_json {
                println(&json!({ "node": node, "file": path }).to_string());
            }
        }
        None if as_json => println(&json!({ "node": node, "dcf": text }).to_string()),
        None => super::super::print(&text),
    }
    Ok(())
}
