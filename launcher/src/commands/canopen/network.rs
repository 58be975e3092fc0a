//! What is done through the canopen-master of a running stack.

use super::super::{UsageError, println, table};
use super::{MasterArgs, Nmt, SdoCommand, emcy, value};
use crate::supervise::client::{find, observe};
use crate::supervise::jobs::{JobLine, choose};
use anyhow::Context as _;
use serde_json::{Value, json};
use std::path::PathBuf;
use std::time::Duration;

const KIND: &str = "canopen-master";
/// A job that talks to nobody.
const AT_ONCE: Duration = Duration::from_secs(5);
/// A transfer of 1 MB at 10 kbit/s would take longer; then its progress is seen in `can dump`.
const TRANSFER: Duration = Duration::from_mins(10);

pub fn line(master: &MasterArgs) -> anyhow::Result<(JobLine, String)> {
    let running = find(master.which.stack.as_deref())?;
    let mut ctx = observe(&running)?;
    let service = choose(&ctx, KIND, master.service.as_deref())?;
    Ok((JobLine::open(&mut ctx, running, KIND, &service)?, service))
}

pub fn status(master: &MasterArgs, as_json: bool) -> anyhow::Result<()> {
    let (mut line, service) = line(master)?;
    let status = line.ask(&json!({ "do": "status" }), AT_ONCE)?;
    if as_json {
        println(&status.to_string());
    } else {
        println(status_text(&service, &status).trim_end());
    }
    Ok(())
}

fn status_text(service: &str, status: &Value) -> String {
    let word = |v: &Value| match v {
        Value::String(text) => text.clone(),
        Value::Null => "-".to_owned(),
        other => other.to_string(),
    };
    let bus = if status["bus_off"] == json!(true) { ", the bus is off" } else { "" };
    let whole = match (&status["started"], &status["whole"]) {
        (Value::Bool(true), Value::Bool(false)) => "a mandatory node is missing",
        (Value::Bool(true), _) => "all mandatory nodes are booted",
        _ => "not complete",
    };
    let mut text =
        format!("{service}, node {}, {}: {whole}{bus}\n\n", word(&status["node_id"]), word(&status["state"]));
    let nodes = status["nodes"].as_array().map_or(&[][..], Vec::as_slice);
    let rows: Vec<Vec<String>> = nodes
        .iter()
        .map(|n| {
            let mandatory = if n["mandatory"] == json!(true) { "yes" } else { "no" };
            let emcy = match n.get("last_emcy") {
                Some(reset) if reset == "0000h" => "none (0000h: reset)".to_owned(),
                Some(emcy) => word(emcy),
                None => "-".to_owned(),
            };
            vec![
                word(&n["id"]),
                word(&n["name"]),
                word(&n["state"]),
                word(&n["boot"]),
                mandatory.to_owned(),
                emcy,
            ]
        })
        .collect();
    text.push_str(&table(&["NODE", "NAME", "NMT STATE", "BOOT", "MANDATORY", "LAST EMCY"], &rows));
    for node in nodes {
        if let Some(failure) = node.get("failure").and_then(Value::as_str) {
            text.push_str(&format!("\nnode {}: {failure}\n", word(&node["id"])));
        }
    }
    let pdo = &status["pdo"];
    text.push_str(&format!(
        "\nPDOs received {}, sent {}; samples complete {}, incomplete {}; SYNC sent {}, left out {}\n",
        word(&pdo["rx_pdos"]),
        word(&pdo["tx_pdos"]),
        word(&pdo["complete_samples"]),
        word(&pdo["incomplete_samples"]),
        word(&status["network"]["syncs"]),
        word(&status["network"]["syncs_missed"]),
    ));
    for queue in status["queues"].as_array().into_iter().flatten() {
        text.push_str(&format!(
            "queue of node {}, PDO {:03X}h: {} of {} wait, at most {} did, {} dropped\n",
            word(&queue["node"]),
            queue["cob_id"].as_u64().unwrap_or(0),
            word(&queue["waiting"]),
            word(&queue["size"]),
            word(&queue["most"]),
            word(&queue["dropped"]),
        ));
    }
    text
}

pub fn nmt(command: Nmt, node: u8, master: &MasterArgs, as_json: bool) -> anyhow::Result<()> {
    let (mut line, _) = line(master)?;
    line.ask(&json!({ "do": "nmt", "command": command.word(), "node": node }), AT_ONCE)?;
    told(as_json, &json!({ "node": node, "command": command.word() }), "sent");
    Ok(())
}

pub fn boot(node: u8, master: &MasterArgs, as_json: bool) -> anyhow::Result<()> {
    let (mut line, _) = line(master)?;
    line.ask(&json!({ "do": "boot", "node": node }), AT_ONCE)?;
    told(as_json, &json!({ "node": node }), "boot-up begins; `dinrail canopen status` shows how it goes");
    Ok(())
}

pub fn boot_state(node: Option<u8>, master: &MasterArgs, as_json: bool) -> anyhow::Result<()> {
    let (mut line, _) = line(master)?;
    let mut state = line.ask(&json!({ "do": "boot_state", "node": node }), AT_ONCE)?;
    if !state.is_array() {
        state = Value::Array(vec![state]);
    }
    println(&if as_json { state.to_string() } else { boot_text(&state).trim_end().to_owned() });
    Ok(())
}

fn boot_text(state: &Value) -> String {
    let word = |v: &Value| match v {
        Value::String(text) => text.clone(),
        Value::Null => "-".to_owned(),
        other => other.to_string(),
    };
    let nodes = state.as_array().map_or(&[][..], Vec::as_slice);
    let row = |n: &Value| {
        let took = n["took_ms"].as_u64().map_or_else(|| "-".to_owned(), |ms| format!("{ms} ms"));
        vec![
            word(&n["id"]),
            word(&n["name"]),
            word(&n["step"]),
            word(&n["tries"]),
            emcy::time(&n["began_utc_ms"]),
            took,
            word(&n["letter"]),
        ]
    };
    let rows: Vec<Vec<String>> = nodes.iter().map(row).collect();
    let mut text = table(&["NODE", "NAME", "BOOT", "TRIES", "LAST BEGAN", "TOOK", "LETTER"], &rows);
    for node in nodes {
        if let Some(said) = node.get("text").and_then(Value::as_str) {
            text.push_str(&format!("\nnode {}: {said}\n", word(&node["id"])));
        }
    }
    text
}

fn told(as_json: bool, value: &Value, text: &str) {
    println(&if as_json { value.to_string() } else { text.to_owned() });
}

pub fn sdo(command: SdoCommand, as_json: bool) -> anyhow::Result<()> {
    match command {
        SdoCommand::Read { node, object, kind, output, mode, master } => {
            // Long values travel by a file that service and command share.
            let file = match &output {
                Some(path) => std::path::absolute(path)?,
                None => scratch(),
            };
            let job = json!({ "do": "sdo_read", "node": node, "object": object, "mode": mode.word(), "file": file });
            let answer = line(&master)?.0.ask(&job, TRANSFER);
            let data = std::fs::read(&file);
            if output.is_none() {
                let _ = std::fs::remove_file(&file);
            }
            let answer = answer?;
            let data = data.with_context(|| format!("reading {}", file.display()))?;
            show(&answer, &data, kind.as_deref(), output.is_some(), as_json)
        }
        SdoCommand::Write { node, object, value: typed, kind, input, mode, master } => {
            let mut job = json!({ "do": "sdo_write", "node": node, "object": object, "mode": mode.word() });
            let mut beside = None;
            match (typed, kind, input) {
                (None, _, Some(path)) => job["file"] = json!(std::path::absolute(path)?),
                (Some(typed), Some(kind), _) => {
                    let bytes = value::bytes(&typed, &kind)?;
                    let file = scratch();
                    std::fs::write(&file, bytes).with_context(|| format!("writing {}", file.display()))?;
                    job["file"] = json!(file);
                    beside = Some(file);
                }
                (Some(typed), None, _) => job["value"] = untyped(&typed),
                (None, _, None) => return Err(UsageError("give a value, or --input FILE".to_owned()).into()),
            }
            let answer = line(&master).and_then(|(mut line, _)| Ok(line.ask(&job, TRANSFER)?));
            if let Some(file) = beside {
                let _ = std::fs::remove_file(file);
            }
            let answer = answer?;
            let object = answer["object"].as_str().unwrap_or_default();
            told(as_json, &answer, &format!("{object}: {} bytes written", answer["bytes"]));
            Ok(())
        }
    }
}

/// A value whose type the EDS will say.
fn untyped(text: &str) -> Value {
    match serde_json::from_str::<Value>(text) {
        Ok(value @ (Value::Number(_) | Value::Bool(_))) => value,
        _ => Value::String(text.to_owned()),
    }
}

/// A file of this process in shared memory.
fn scratch() -> PathBuf {
    PathBuf::from(format!("/dev/shm/dinrail-sdo-{}.bin", std::process::id()))
}

fn show(answer: &Value, data: &[u8], kind: Option<&str>, in_file: bool, as_json: bool) -> anyhow::Result<()> {
    let object = answer["object"].as_str().unwrap_or_default();
    if as_json {
        let mut value = answer.clone();
        if !in_file {
            value["data"] = json!(value::hex(data).replace(' ', "").to_lowercase());
        }
        println(&value.to_string());
        return Ok(());
    }
    if in_file {
        println(&format!("{object}: {} bytes", data.len()));
        return Ok(());
    }
    let text = match (kind, answer.get("value").and_then(Value::as_str)) {
        (Some(kind), _) => value::text(data, kind)?,
        (None, Some(value)) => value.to_owned(),
        (None, None) => value::hex(data),
    };
    println(&format!("{object} = {text}"));
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_network_is_shown_with_the_reasons() {
        let status = json!({
            "node_id": 1, "state": "pre-operational", "started": false, "bus_off": false,
            "nodes": [
                { "id": 2, "name": "Simulated I/O", "state": "operational", "boot": "booted", "mandatory": true },
                { "id": 4, "name": "Valve", "state": "operational", "boot": "booted", "mandatory": false, "last_emcy": "0000h" },
                { "id": 3, "name": "Drive", "state": "unknown", "boot": "waiting for the next try", "mandatory": true,
                  "last_emcy": "8130h", "letter": "B", "failure": "boot-up failed with letter B: no answer; try 3" },
            ],
            "pdo": { "rx_pdos": 10, "tx_pdos": 11, "complete_samples": 9, "incomplete_samples": 1 },
            "queues": [{ "node": 2, "cob_id": 386, "size": 64, "waiting": 3, "most": 49, "dropped": 0 }],
            "network": { "syncs": 12, "syncs_missed": 0 },
        });
        insta::assert_snapshot!(status_text("io", &status), @r"
        io, node 1, pre-operational: not complete

        NODE  NAME           NMT STATE    BOOT                      MANDATORY  LAST EMCY
        2     Simulated I/O  operational  booted                    yes        -
        4     Valve          operational  booted                    no         none (0000h: reset)
        3     Drive          unknown      waiting for the next try  yes        8130h

        node 3: boot-up failed with letter B: no answer; try 3

        PDOs received 10, sent 11; samples complete 9, incomplete 1; SYNC sent 12, left out 0
        queue of node 2, PDO 182h: 3 of 64 wait, at most 49 did, 0 dropped
        ");
    }

    #[test]
    fn untyped_values_keep_their_form() {
        assert_eq!(untyped("5"), json!(5));
        assert_eq!(untyped("true"), json!(true));
        assert_eq!(untyped("0x10"), json!("0x10"));
        assert_eq!(untyped("$NODEID+1"), json!("$NODEID+1"));
    }
}
