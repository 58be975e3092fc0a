//! `dinrail canopen emcy`: what nodes reported to the master, and what a device of the stack reports.

use super::super::{println, table};
use super::{EmcyArgs, EmcyCommand, MasterArgs, network};
use crate::supervise::client::{find, observe};
use crate::supervise::jobs::{JobLine, choose};
use dinrail_recorder::utc::iso;
use serde_json::{Value, json};
use std::time::Duration;

const SLAVE: &str = "canopen-slave";
const LIMIT: Duration = Duration::from_secs(5);

pub fn run(args: EmcyArgs, as_json: bool) -> anyhow::Result<()> {
    let EmcyArgs { command, node, clear, master } = args;
    match command {
        Some(command) => device(command, as_json),
        None if clear => {
            let (mut line, _) = network::line(&master)?;
            let done = line.ask(&json!({ "do": "emcy_clear", "node": node }), LIMIT)?;
            let text = format!("{} messages forgotten", done["cleared"]);
            println(&if as_json { done.to_string() } else { text });
            Ok(())
        }
        None => show(node, &master, as_json),
    }
}

/// A device of the stack reports an error, or that it is gone.
fn device(command: EmcyCommand, as_json: bool) -> anyhow::Result<()> {
    let (job, service, which) = match command {
        EmcyCommand::Send { code, register, data, service, which } => {
            (json!({ "do": "emcy", "code": code, "register": register, "data": data }), service, which)
        }
        EmcyCommand::Reset { code, service, which } => {
            (json!({ "do": "emcy_reset", "code": code }), service, which)
        }
    };
    let running = find(which.stack.as_deref())?;
    let mut ctx = observe(&running)?;
    let service = choose(&ctx, SLAVE, service.as_deref())?;
    let done = JobLine::open(&mut ctx, running, SLAVE, &service)?.ask(&job, LIMIT)?;
    let register = done["error_register"].as_u64().unwrap_or(0);
    let text = match done.get("reset") {
        Some(reset) => format!("{reset} errors reset; the error register is {register:02X}h now"),
        None => format!("sent; the error register is {register:02X}h now"),
    };
    println(&if as_json { done.to_string() } else { text });
    Ok(())
}

fn show(node: Option<u8>, master: &MasterArgs, as_json: bool) -> anyhow::Result<()> {
    let (mut line, _) = network::line(master)?;
    let ids = match node {
        Some(node) => vec![node],
        None => reporting(&mut line)?,
    };
    let mut all = Vec::new();
    for id in ids {
        all.push(history(&mut line, id)?);
    }
    if as_json {
        println(&Value::Array(all).to_string());
    } else {
        println(text(&all).trim_end());
    }
    Ok(())
}

/// The nodes that reported anything.
fn reporting(line: &mut JobLine) -> anyhow::Result<Vec<u8>> {
    let mut ids: Vec<u8> = Vec::new();
    loop {
        let skip = ids.last().copied().unwrap_or(0);
        let answer = line.ask(&json!({ "do": "emcy", "skip": skip }), LIMIT)?;
        let nodes = answer["nodes"].as_array().map_or(&[][..], Vec::as_slice);
        ids.extend(nodes.iter().filter_map(|n| u8::try_from(n["node"].as_u64()?).ok()));
        if answer["more"] != json!(true) || nodes.is_empty() {
            return Ok(ids);
        }
    }
}

/// All messages of a node that the master keeps.
fn history(line: &mut JobLine, node: u8) -> anyhow::Result<Value> {
    let mut entries: Vec<Value> = Vec::new();
    loop {
        let job = json!({ "do": "emcy", "node": node, "skip": entries.len() });
        let mut answer = line.ask(&job, LIMIT)?;
        let part = answer["entries"].as_array().cloned().unwrap_or_default();
        let more = answer["more"] == json!(true) && !part.is_empty();
        entries.extend(part);
        if !more {
            answer["entries"] = Value::Array(entries);
            if let Some(object) = answer.as_object_mut() {
                object.remove("more");
            }
            return Ok(answer);
        }
    }
}

pub fn time(value: &Value) -> String {
    value.as_i64().map_or_else(|| "-".to_owned(), |ms| iso(ms.max(0).unsigned_abs() * 1_000_000))
}

fn text(nodes: &[Value]) -> String {
    let word = |v: &Value| v.as_str().unwrap_or("-").to_owned();
    let mut rows = Vec::new();
    let mut beyond = String::new();
    for node in nodes {
        let id = &node["node"];
        for entry in node["entries"].as_array().into_iter().flatten() {
            let bits: Vec<String> = entry["bits"].as_array().into_iter().flatten().map(word).collect();
            let reset = match entry.get("reset_by") {
                Some(by) => format!("{} {}", time(&entry["reset_utc_ms"]), word(by)),
                None => "no".to_owned(),
            };
            rows.push(vec![
                id.to_string(),
                time(&entry["utc_ms"]),
                format!("{} {}", word(&entry["code"]), word(&entry["text"])),
                format!("{} {}", word(&entry["register"]), bits.join(", ")),
                word(&entry["data"]),
                reset,
            ]);
        }
        if node["dropped"].as_u64().unwrap_or(0) > 0 {
            beyond.push_str(&format!(
                "\nnode {id}: {} older messages are not kept; the recording has them",
                node["dropped"]
            ));
        }
    }
    if rows.is_empty() {
        return "no emergency messages seen".to_owned();
    }
    table(&["NODE", "TIME", "EMERGENCY", "ERROR REGISTER", "DATA", "RESET"], &rows) + &beyond
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_are_a_table() {
        let nodes = [json!({
            "node": 5, "name": "Drive", "seen": 20, "dropped": 4, "active": 1,
            "entries": [
                { "utc_ms": 1_792_000_000_500_i64, "code": "4210h", "text": "temperature", "register": "09h",
                  "bits": ["generic", "temperature"], "data": "0102000000" },
                { "utc_ms": 1_792_000_000_000_i64, "code": "8130h", "text": "life guard or heartbeat error", "register": "11h",
                  "bits": ["generic", "communication"], "data": "0500000000",
                  "reset_utc_ms": 1_792_000_000_250_i64, "reset_by": "error-reset" },
            ],
        })];
        insta::assert_snapshot!(text(&nodes));
        assert_eq!(text(&[]), "no emergency messages seen");
    }
}
