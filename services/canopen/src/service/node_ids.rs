//! Node-ids of one bus that several services of the stack have, and devices that no master knows.

use crate::config::{MasterConfig, Node, SlaveConfig};
use ipc_types::stack::ServiceEntry;
use ipc_types::topic::TopicKind;
use ipc_types::{Finding, Stack};
use serde::de::DeserializeOwned;

const MASTER: &str = "canopen-master";
const SLAVE: &str = "canopen-slave";
/// Nodes of a master that a message lists.
const SHOWN: usize = 8;

/// The can service that it sends to; none where the stack file does not say which.
fn bus(service: &ServiceEntry) -> Option<&str> {
    service.wiring.writes.iter().find_map(|(topic, _)| {
        let bus = topic.split('/').next()?;
        (TopicKind::CanTx.of(bus) == *topic).then_some(bus)
    })
}

/// The other services of a kind on the bus of `me`, with their tables. Tables that cannot be read are told elsewhere.
fn others<'a, C: DeserializeOwned>(
    stack: &'a Stack,
    me: &'a ServiceEntry,
    kind: &'static str,
) -> impl Iterator<Item = (&'a ServiceEntry, C)> {
    let mine = bus(me);
    stack
        .services
        .iter()
        .filter(move |s| s.kind == kind && s.name != me.name && mine.is_some() && bus(s) == mine)
        .filter_map(|s| Some((s, serde_json::from_value(s.config.clone()).ok()?)))
}

/// Two services with one node-id are told once, at the later one.
fn is_later(stack: &Stack, me: &ServiceEntry, other: &ServiceEntry) -> bool {
    let at = |name: &str| stack.services.iter().position(|s| s.name == name);
    at(&me.name) > at(&other.name)
}

fn doubled(me: &ServiceEntry, other: &ServiceEntry, node_id: u8, warning: bool) -> Finding {
    let by_default = if other.config.get("node_id").is_none() { " (the default of its node_id)" } else { "" };
    let bus = bus(me).unwrap_or_default();
    let message = format!(
        "'{}' has node-id {node_id}, and so has {} '{}'{by_default} on the same bus, '{bus}'",
        me.name, other.kind, other.name
    );
    let make = if warning { Finding::warning } else { Finding::error };
    make(&me.name, "node_id", &message, "give one of them another node_id: each is there once on a bus")
}

/// Of a master: another master with its node-id.
pub fn check_master(config: &MasterConfig, stack: &Stack, me: &ServiceEntry) -> Vec<Finding> {
    others::<MasterConfig>(stack, me, MASTER)
        .filter(|(other, table)| table.node_id == config.node_id && is_later(stack, me, other))
        .map(|(other, _)| doubled(me, other, config.node_id, false))
        .collect()
}

/// Of a slave: a master or another slave with its node-id, and that no master on its bus has it as a node.
pub fn check_slave(config: &SlaveConfig, stack: &Stack, me: &ServiceEntry) -> Vec<Finding> {
    if !(1..=127).contains(&config.node_id) {
        return Vec::new();
    }
    let id = config.node_id;
    let masters: Vec<_> = others::<MasterConfig>(stack, me, MASTER).collect();
    let mut found: Vec<Finding> = masters
        .iter()
        .filter(|(_, table)| table.node_id == id)
        .map(|(other, _)| doubled(me, other, id, false))
        .collect();
    let slaves = others::<SlaveConfig>(stack, me, SLAVE);
    // Simulated devices may be there to show what a master says of it.
    found.extend(
        slaves.filter(|(other, table)| table.node_id == id && is_later(stack, me, other)).map(
            |(other, table)| doubled(me, other, id, table.simulate.is_some() && config.simulate.is_some()),
        ),
    );
    // A master without nodes, and one with a node twice where another is meant, is told at its own place.
    let twice =
        |nodes: &[Node]| nodes.iter().enumerate().any(|(i, n)| nodes[..i].iter().any(|m| m.id == n.id));
    let knows = |table: &MasterConfig| {
        table.nodes.is_empty() || table.nodes.iter().any(|n| n.id == id) || twice(&table.nodes)
    };
    if found.is_empty()
        && let Some((master, table)) = masters.first()
        && !masters.iter().any(|(_, table)| knows(table))
    {
        let ids: Vec<String> = table.nodes.iter().take(SHOWN).map(|n| n.id.to_string()).collect();
        let more = if table.nodes.len() > SHOWN { ", ..." } else { "" };
        let message = format!(
            "master '{}' of this bus has no node {id}; it has {}{more}: is that meant?",
            master.name,
            ids.join(", ")
        );
        let help = format!("add [[service.node]] with id = {id} to '{}', or change node_id", master.name);
        found.push(Finding::warning(&me.name, "node_id", message, help));
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;
    use ipc_types::Wiring;
    use serde_json::{Value, json};
    use std::path::PathBuf;

    /// Name, kind, bus and table of each service.
    fn said(services: &[(&str, &str, &str, Value)]) -> String {
        let entry = |(name, kind, bus, config): &(&str, &str, &str, Value)| {
            let mut wiring = Wiring::default();
            wiring.write(TopicKind::CanTx.of(bus), "bus");
            let (name, kind) = ((*name).to_owned(), (*kind).to_owned());
            ServiceEntry { name, kind, index: 1, config: config.clone(), wiring }
        };
        let stack = Stack {
            name: "s".to_owned(),
            file: PathBuf::default(),
            dir: PathBuf::default(),
            text: String::new(),
            build_id: String::new(),
            root: PathBuf::default(),
            prefix: String::new(),
            services: services.iter().map(entry).collect(),
            topics: Vec::new(),
        };
        let found = stack.services.iter().flat_map(|me| {
            let config = me.config.clone();
            if me.kind == MASTER {
                check_master(&serde_json::from_value(config).unwrap(), &stack, me)
            } else {
                check_slave(&serde_json::from_value(config).unwrap(), &stack, me)
            }
        });
        found
            .map(|f| format!("{:?} {}.{}: {}; {}\n", f.severity, f.service, f.key, f.message, f.help))
            .collect()
    }

    #[test]
    fn different_node_ids_or_buses_are_fine() {
        let master = || json!({ "node": [{ "id": 20 }] });
        let slave = |id: u8| json!({ "node_id": id });
        assert_eq!(said(&[("io", MASTER, "can0", master()), ("d", SLAVE, "can0", slave(20))]), "");
        assert_eq!(said(&[("io", MASTER, "can0", master()), ("d", SLAVE, "can1", slave(1))]), "");
        assert_eq!(said(&[("d", SLAVE, "can0", slave(255)), ("e", SLAVE, "can0", slave(255))]), "");
        assert_eq!(said(&[("io", MASTER, "can0", json!({})), ("d", SLAVE, "can0", slave(20))]), "");
        let twice = json!({ "node": [{ "id": 20 }, { "id": 20 }] });
        assert_eq!(said(&[("io", MASTER, "can0", twice), ("d", SLAVE, "can0", slave(21))]), "");
    }

    #[test]
    fn doubled_and_unknown_node_ids_are_told_once() {
        let sim = |id: u8| json!({ "node_id": id, "simulate": "401" });
        let all = said(&[
            ("io", MASTER, "can0", json!({ "node": [{ "id": 20 }] })),
            ("second", MASTER, "can0", json!({ "node_id": 1, "node": [{ "id": 20 }] })),
            ("d1", SLAVE, "can0", json!({ "node_id": 1 })),
            ("d20", SLAVE, "can0", json!({ "node_id": 20 })),
            ("e20", SLAVE, "can0", sim(20)),
            ("f20", SLAVE, "can0", sim(20)),
            ("d21", SLAVE, "can0", sim(21)),
        ]);
        insta::assert_snapshot!(all, @r"
        Error second.node_id: 'second' has node-id 1, and so has canopen-master 'io' (the default of its node_id) on the same bus, 'can0'; give one of them another node_id: each is there once on a bus
        Error d1.node_id: 'd1' has node-id 1, and so has canopen-master 'io' (the default of its node_id) on the same bus, 'can0'; give one of them another node_id: each is there once on a bus
        Error d1.node_id: 'd1' has node-id 1, and so has canopen-master 'second' on the same bus, 'can0'; give one of them another node_id: each is there once on a bus
        Error e20.node_id: 'e20' has node-id 20, and so has canopen-slave 'd20' on the same bus, 'can0'; give one of them another node_id: each is there once on a bus
        Error f20.node_id: 'f20' has node-id 20, and so has canopen-slave 'd20' on the same bus, 'can0'; give one of them another node_id: each is there once on a bus
        Warning f20.node_id: 'f20' has node-id 20, and so has canopen-slave 'e20' on the same bus, 'can0'; give one of them another node_id: each is there once on a bus
        Warning d21.node_id: master 'io' of this bus has no node 21; it has 20: is that meant?; add [[service.node]] with id = 21 to 'io', or change node_id
        ");
    }
}
