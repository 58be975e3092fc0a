//! Before the service runs: its topics, and every mistake that can be found without starting.

use crate::config::{MasterConfig as Config, Number, OnStop, OnStopWord};
use crate::master::exchange::{RxPdo, transmission};
use crate::master::plan::plan;
use crate::service::outputs::values;
use crate::service::{addressing_near, load, node_ids, plc_of};
use ipc_types::stack::ServiceEntry;
use ipc_types::topic::TopicKind;
use ipc_types::wiring::{ImageRange, Neighbours, ServiceEvent, TopicDecl};
use ipc_types::{Finding, Stack, Wiring, plc_table};

/// What a node takes of the state of the network, with the reason of a failed boot: 512 bytes are seldom reached.
const RESULT_BYTES_A_NODE: u32 = 768;

/// What the service needs of the launcher.
pub fn topics(config: &Config, neighbours: &Neighbours) -> Wiring {
    let plc = neighbours.resolve("plc", config.plc.as_deref());
    let (devices, unread) = load::devices(config, &neighbours.dir);
    let plan = plan(config, &devices, addressing_near(neighbours, plc.as_deref()), &neighbours.name);
    let mut wiring = Wiring { plc, ..Wiring::default() };
    if !plan.inputs.is_empty() {
        let tail =
            plan.exchange.input_bytes.iter().map(|&n| u32::from(n)).sum::<u32>() + plan.inputs.len() as u32;
        wiring.topics.push(TopicDecl::new(TopicKind::Inputs).max_tail(tail.max(1)));
    }
    wiring.own(TopicKind::Jobs);
    let results = TopicKind::Results.row().max_tail + RESULT_BYTES_A_NODE * config.nodes.len() as u32;
    wiring.topics.push(TopicDecl::new(TopicKind::Results).max_tail(results));
    wiring.read(TopicKind::Jobs.of(&neighbours.name), true, "");
    if let Some(bus) = neighbours.resolve("can", config.bus.as_deref()) {
        wiring.read(TopicKind::CanRx.of(&bus), true, "bus");
        wiring.write(TopicKind::CanTx.of(&bus), "bus");
    }
    // A queue moves by what the image says of the scans.
    if !(plan.outputs.is_empty() && plan.exchange.queues.is_empty())
        && let Some(plc) = &wiring.plc
    {
        let topic = TopicKind::Image.of(plc);
        wiring.read(topic, true, "plc");
    }
    for (i, node) in config.nodes.iter().enumerate() {
        if let Some(eds) = &node.eds {
            wiring.files.push((eds.into(), format!("node[{i}].eds")));
        }
    }
    let synchronous = |pdo: &RxPdo| transmission::is_synchronous(pdo.transmission);
    // Mistakes leave inputs out, and are told at their own place: the plc shall not miss the event besides.
    let flawed = unread.iter().chain(&plan.mistakes).any(|m| !m.warning);
    if plan.settings.sync_period_ns.is_some() && (flawed || plan.exchange.rx.iter().any(synchronous)) {
        wiring.events.push(ServiceEvent::Sync);
    }
    wiring.inputs = plan.inputs;
    wiring.outputs = plan.outputs;
    wiring
}

/// Every mistake that can be found without starting.
pub fn check(config: &Config, stack: &Stack, me: &ServiceEntry) -> Vec<Finding> {
    let name = &me.name;
    let (plc, addressing) = plc_of(stack, &me.wiring);
    let (devices, mut mistakes) = load::devices(config, &stack.dir);
    mistakes.extend(plan(config, &devices, addressing, name).mistakes);
    let mut found: Vec<Finding> = mistakes.iter().map(|m| m.finding(name)).collect();
    found.extend(safe_values(config, &me.wiring.outputs).err().map(|(key, message)| {
        Finding::error(name, &key, message, "name an address that a map entry takes from")
    }));
    found.extend(node_ids::check_master(config, stack, me));
    if config.bus.is_none() {
        found.extend(stack.check_only(name, "bus", "can"));
    }
    if !me.wiring.outputs.is_empty() {
        found.extend(plc.and_then(|plc| plc_table::check_stale_after(name, config.stale_after, plc)));
    }
    found
}

/// The gathered outputs of the safe state; `None` where they stay.
pub(super) fn safe_values(
    config: &Config,
    outputs: &[ImageRange],
) -> Result<Option<Vec<u8>>, (String, String)> {
    let named = match &config.on_stop {
        OnStop::Word(OnStopWord::Hold) => return Ok(None),
        OnStop::Word(OnStopWord::Zero | OnStopWord::Preop | OnStopWord::Stop) => &[][..],
        OnStop::Values(table) => &table.values,
    };
    let sources: Vec<(&str, &str)> = config
        .nodes
        .iter()
        .enumerate()
        .flat_map(|(n, node)| node.map.iter().enumerate().map(move |(m, map)| (n, m, map)))
        .filter_map(|(n, m, map)| Some((n, m, map.from.as_deref()?)))
        .filter_map(|(n, m, from)| {
            let key = format!("node[{n}].map[{m}].from");
            outputs.iter().find(|r| r.key == key).map(|r| (from, r.key.as_str()))
        })
        .collect();
    let mut list: Vec<(usize, Number)> = Vec::new();
    for (i, value) in named.iter().enumerate() {
        let found = sources.iter().find(|(from, _)| from.eq_ignore_ascii_case(&value.from));
        let place = found.and_then(|(_, key)| outputs.iter().position(|r| r.key == *key));
        match place {
            Some(place) => list.push((place, value.value.clone())),
            None => {
                return Err((
                    format!("on_stop.values[{i}].from"),
                    format!("no node receives {}", value.from),
                ));
            }
        }
    }
    Ok(Some(values(outputs, &list)))
}
