//! What nodes reported, as jobs.

use super::super::book::Book;
use super::{Begun, LIST_BYTES, Now, failed};
use crate::master::network::{EmcyEntry, Network};
use crate::protocol::emcy::register_bits;
use serde_json::{Value, json};

fn exists(node: u8) -> Result<(), (u32, String)> {
    match node {
        1..=127 => Ok(()),
        _ => Err(failed(format!("node-id {node} does not exist; node-ids are 1 to 127"))),
    }
}

/// Takes from `all` what fits into a result; tells whether there is more.
fn fitting(all: impl Iterator<Item = Value>) -> (Vec<Value>, bool) {
    let (mut list, mut bytes) = (Vec::new(), 0);
    for value in all {
        bytes += value.to_string().len() + 1;
        if bytes > LIST_BYTES && !list.is_empty() {
            return (list, true);
        }
        list.push(value);
    }
    (list, false)
}

/// The messages of one node, newest first, after `skip` of them.
pub(super) fn of_node(now: Now, node: u8, skip: usize, book: &Book, network: &Network) -> Begun {
    exists(node)?;
    let log = network.emcys.of(node).ok_or_else(|| failed("no such node"))?;
    let (entries, more) = fitting(log.entries().skip(skip).map(|e| entry(now, e)));
    Ok(Some(json!({
        "node": node,
        "name": book.names.get(&node),
        "seen": log.seen,
        "dropped": log.dropped,
        "active": log.active(),
        "entries": entries,
        "more": more,
    })))
}

fn entry(now: Now, entry: &EmcyEntry) -> Value {
    let emcy = &entry.emcy;
    let data: String = emcy.info.iter().map(|b| format!("{b:02X}")).collect();
    let mut value = json!({
        "utc_ms": now.utc_ms(entry.t_ns),
        "code": format!("{:04X}h", emcy.code),
        "text": emcy.class(),
        "register": format!("{:02X}h", emcy.register),
        "bits": register_bits(emcy.register),
        "data": data,
    });
    if let Some((t_ns, by)) = entry.reset {
        value["reset_utc_ms"] = json!(now.utc_ms(t_ns));
        value["reset_by"] = json!(by);
    }
    value
}

/// How many messages there are of each node that sent any, of the nodes after `skip`.
pub(super) fn of_all(skip: usize, book: &Book, network: &Network) -> Value {
    let nodes = (1..=127u8).skip(skip).filter_map(|id| {
        let log = network.emcys.of(id).filter(|log| log.seen > 0)?;
        let mut value = json!({ "node": id, "seen": log.seen, "active": log.active() });
        if let Some(name) = book.names.get(&id) {
            value["name"] = json!(name);
        }
        Some(value)
    });
    let (nodes, more) = fitting(nodes);
    json!({ "nodes": nodes, "more": more })
}

pub(super) fn clear(node: Option<u8>, network: &mut Network) -> Begun {
    if let Some(node) = node {
        exists(node)?;
    }
    Ok(Some(json!({ "cleared": network.emcys.clear(node.unwrap_or(0)) })))
}
