//! Times of the stack file that a node keeps in an object of 16 bits, and those that cannot work.

use super::CONSUMER_FACTOR;
use crate::config::{MasterConfig as Config, Node};
use crate::mistakes::Mistakes;
use ipc_types::units::Span;

/// Nanoseconds of a step.
const MS: u64 = 1_000_000;
const INHIBIT: u64 = 100_000;
/// A heartbeat faster than this is late by the load of a bus or of a computer, and its node is lost.
const SHORT_HEARTBEAT: Span = Span::from_ms(10);
/// Shortest wait for an answer by SDO that makes sense.
const SHORT_SDO: Span = Span::from_ms(1);

/// A time that an UNSIGNED16 in steps of `step_ns` must hold; 0 is told by the callers where it means nothing.
fn fits(span: Span, step_ns: u64, object: &str, key: &str, mistakes: &mut Mistakes) {
    let limit = u64::from(u16::MAX);
    let (step, most) = if step_ns == MS { ("1ms", "65535ms") } else { ("100us", "6553500us") };
    let message = if !span.ns().is_multiple_of(step_ns) {
        format!("{span} is no multiple of {step}, in which {object} counts")
    } else if span.ns() / step_ns > limit {
        format!("{span} is more than {object} holds, {most}")
    } else {
        return;
    };
    mistakes.add(key, message, format!("take {step} to {most} in steps of {step}, or leave it out"));
}

/// Times of the master's own table.
pub(super) fn check_master(config: &Config, mistakes: &mut Mistakes) {
    fits(config.heartbeat, MS, "1017h", "heartbeat", mistakes);
    sdo_timeout(config.sdo_timeout, "sdo_timeout", mistakes);
}

fn sdo_timeout(span: Span, key: &str, mistakes: &mut Mistakes) {
    if span < SHORT_SDO {
        let message = format!("{span} is no time for an answer by SDO");
        mistakes.add(key, message, "take 1ms or more, e.g. \"500ms\"");
    }
}

/// Times of a node.
pub(super) fn check_node(node: &Node, key: &str, mistakes: &mut Mistakes) {
    let at = |end: &str| format!("{key}.{end}");
    let beat = node.heartbeat.filter(|beat| beat.ns() > 0);
    if let Some(beat) = beat {
        fits(beat, MS, "1017h", &at("heartbeat"), mistakes);
        if beat < SHORT_HEARTBEAT && beat.ns().is_multiple_of(MS) {
            let wait = Span(beat.ns().saturating_mul(CONSUMER_FACTOR));
            let message = format!(
                "with a heartbeat every {beat} node {} is lost when none comes for {wait}: load of the bus or of the computer is enough",
                node.id
            );
            mistakes.warn(&at("heartbeat"), message, "take 10ms or more; 100ms is usual");
        }
    }
    if let Some(guarding) = node.guarding {
        if beat.is_some() {
            let message =
                format!("node {} has heartbeat and guarding, and only one of them can watch it", node.id);
            mistakes.add(
                &at("guarding"),
                message,
                "leave guarding out if the device has a heartbeat, else heartbeat",
            );
        }
        if guarding.time.ns() == 0 {
            mistakes.add(&at("guarding.time"), "a guard time of 0 guards nothing", "take 1ms to 65535ms");
        }
        if guarding.factor == 0 {
            let help = "take 1 to 255; 3 is usual";
            mistakes.add(&at("guarding.factor"), "a life time factor of 0 guards nothing", help);
        }
        fits(guarding.time, MS, "100Ch", &at("guarding.time"), mistakes);
    }
    if let Some(timeout) = node.sdo_timeout {
        sdo_timeout(timeout, &at("sdo_timeout"), mistakes);
    }
    for (table, pdos) in [("tpdo", &node.tpdo), ("rpdo", &node.rpdo)] {
        let first: u16 = if table == "tpdo" { 0x1800 } else { 0x1400 };
        for (i, pdo) in pdos.iter().enumerate() {
            let at = |end: &str| format!("{key}.{table}[{i}].{end}");
            let object =
                |sub: u8| format!("{:04X}:{sub:02X}", first.saturating_add(pdo.number).saturating_sub(1));
            if let Some(span) = pdo.inhibit_time {
                fits(span, INHIBIT, &object(3), &at("inhibit_time"), mistakes);
            }
            if let Some(span) = pdo.event_timer {
                fits(span, MS, &object(5), &at("event_timer"), mistakes);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    fn said(table: serde_json::Value) -> String {
        let config: Config = serde_json::from_value(table).unwrap();
        let mut mistakes = Mistakes::default();
        check_master(&config, &mut mistakes);
        for (i, node) in config.nodes.iter().enumerate() {
            check_node(node, &format!("node[{i}]"), &mut mistakes);
        }
        let warning = |warning| if warning { "warning " } else { "" };
        mistakes
            .0
            .iter()
            .map(|m| format!("{}{}: {}; {}\n", warning(m.warning), m.key, m.message, m.help))
            .collect()
    }

    #[test]
    fn times_that_objects_hold_are_fine() {
        let table = json!({ "heartbeat": 0, "node": [
            { "id": 5, "heartbeat": "65535ms", "sdo_timeout": "2min",
              "tpdo": [{ "number": 1, "inhibit_time": "6553500us", "event_timer": "1ms" }] },
            { "id": 6, "heartbeat": 0, "guarding": { "time": "65535ms", "factor": 1 } },
            { "id": 7, "heartbeat": "10ms", "rpdo": [{ "number": 1, "inhibit_time": 0, "event_timer": 0 }] },
        ] });
        assert_eq!(said(table), "");
    }

    #[test]
    fn other_times_are_told() {
        let table = json!({ "heartbeat": "500us", "sdo_timeout": "0s", "node": [
            { "id": 5, "heartbeat": "500us", "sdo_timeout": "1us",
              "tpdo": [{ "number": 1, "inhibit_time": "50us", "event_timer": "70s" }] },
            { "id": 6, "heartbeat": "70s", "rpdo": [{ "number": 1, "inhibit_time": "7s", "event_timer": "1.5ms" }] },
            { "id": 7, "heartbeat": "1ms", "guarding": { "time": "0s", "factor": 0 } },
            { "id": 8, "guarding": { "time": "500us", "factor": 3 } },
        ] });
        insta::assert_snapshot!(said(table), @r#"
        heartbeat: 500us is no multiple of 1ms, in which 1017h counts; take 1ms to 65535ms in steps of 1ms, or leave it out
        sdo_timeout: 0ns is no time for an answer by SDO; take 1ms or more, e.g. "500ms"
        node[0].heartbeat: 500us is no multiple of 1ms, in which 1017h counts; take 1ms to 65535ms in steps of 1ms, or leave it out
        node[0].sdo_timeout: 1us is no time for an answer by SDO; take 1ms or more, e.g. "500ms"
        node[0].tpdo[0].inhibit_time: 50us is no multiple of 100us, in which 1800:03 counts; take 100us to 6553500us in steps of 100us, or leave it out
        node[0].tpdo[0].event_timer: 70s is more than 1800:05 holds, 65535ms; take 1ms to 65535ms in steps of 1ms, or leave it out
        node[1].heartbeat: 70s is more than 1017h holds, 65535ms; take 1ms to 65535ms in steps of 1ms, or leave it out
        node[1].rpdo[0].inhibit_time: 7s is more than 1400:03 holds, 6553500us; take 100us to 6553500us in steps of 100us, or leave it out
        node[1].rpdo[0].event_timer: 1500us is no multiple of 1ms, in which 1400:05 counts; take 1ms to 65535ms in steps of 1ms, or leave it out
        warning node[2].heartbeat: with a heartbeat every 1ms node 7 is lost when none comes for 3ms: load of the bus or of the computer is enough; take 10ms or more; 100ms is usual
        node[2].guarding: node 7 has heartbeat and guarding, and only one of them can watch it; leave guarding out if the device has a heartbeat, else heartbeat
        node[2].guarding.time: a guard time of 0 guards nothing; take 1ms to 65535ms
        node[2].guarding.factor: a life time factor of 0 guards nothing; take 1 to 255; 3 is usual
        node[3].guarding.time: 500us is no multiple of 1ms, in which 100Ch counts; take 1ms to 65535ms in steps of 1ms, or leave it out
        "#);
    }
}
