//! `dinrail modbus scan` and `identify`.

use super::target::{Failed, Master};
use crate::commands::{print, println, table};
use serde_json::{Value, json};
use std::io::{IsTerminal, Write};

/// What a unit answered to the question whether it is there.
fn look(line: &mut Master, unit: u8) -> Result<Option<String>, anyhow::Error> {
    let job = json!({ "do": "read", "table": "holding_registers", "at": 0, "count": 1 });
    match line.ask_unit(&json!(unit), &job) {
        Ok(_) => Ok(Some("answers".to_owned())),
        // An exception is an answer, but those of a gateway say that there is nobody.
        Err(Failed::Exception(code @ (0x0A | 0x0B), text)) => {
            tracing::debug!("unit {unit}: {code:02X} {text}");
            Ok(None)
        }
        Err(Failed::Exception(_, text)) => Ok(Some(format!("answers with {text}"))),
        Err(Failed::NoAnswer(_)) => Ok(None),
        Err(Failed::Other(text)) => Err(anyhow::anyhow!(text)),
    }
}

/// Asks every unit for one register.
pub fn scan(line: &mut Master, from: u8, to: u8, json: bool) -> anyhow::Result<()> {
    let progress = std::io::stderr().is_terminal();
    let mut found = Vec::new();
    let count = u32::from(to - from) + 1;
    for unit in from..=to {
        if progress {
            let done = u32::from(unit - from);
            eprint!("\runit {unit} of {from} to {to}, {} found, {} % ", found.len(), done * 100 / count);
            let _ = std::io::stderr().flush();
        }
        if let Some(how) = look(line, unit)? {
            if progress {
                eprint!("\r\x1b[K");
            }
            if !json {
                println(&format!("unit {unit} {how}"));
            }
            found.push((unit, how));
        }
    }
    if progress {
        eprint!("\r\x1b[K");
    }
    if json {
        let list: Vec<Value> =
            found.iter().map(|(unit, how)| json!({ "unit": unit, "answer": how })).collect();
        println(&json!({ "asked": count, "found": list }).to_string());
    }
    if found.is_empty() {
        anyhow::bail!("{}. {}", nobody(from, to), line.why_silent());
    }
    if !json {
        let answer = if found.len() == 1 { "answers" } else { "answer" };
        println(&format!("{} of {count} unit{} {answer}", found.len(), if count == 1 { "" } else { "s" }));
    }
    Ok(())
}

/// That no unit answered.
fn nobody(from: u8, to: u8) -> String {
    if from == to {
        format!("unit {from} does not answer")
    } else {
        format!("none of the {} units from {from} to {to} answers", u32::from(to - from) + 1)
    }
}

/// Asks for all objects of 43/14 and for 17.
pub fn identify(line: &mut Master, json: bool) -> anyhow::Result<()> {
    let mut objects: Vec<Value> = Vec::new();
    let mut refused = None;
    // Basic, regular, extended: each is told from its first object.
    'codes: for (code, first) in [(1, 0u64), (2, 3), (3, 0x80)] {
        let mut object = first;
        // A unit that says "more follows" for ever is left after all objects there can be.
        for _ in 0..256 {
            let job = json!({ "do": "identification", "code": code, "object": object });
            match line.try_ask(&job) {
                Ok(answer) => {
                    let list = answer.get("objects").and_then(Value::as_array).cloned().unwrap_or_default();
                    for new in list {
                        if !objects.iter().any(|o| o["id"] == new["id"]) {
                            objects.push(new);
                        }
                    }
                    let next = answer.get("next").and_then(Value::as_u64).unwrap_or(0);
                    if answer.get("more") != Some(&json!(true)) || next <= object {
                        break;
                    }
                    object = next;
                }
                Err(Failed::Exception(_, text)) => {
                    refused = Some(text);
                    break 'codes;
                }
                Err(e) => return Err(anyhow::anyhow!(e.to_string())),
            }
        }
    }
    let server = match line.try_ask(&json!({ "do": "server_id" })) {
        Ok(answer) => Ok(answer),
        Err(Failed::Exception(_, text) | Failed::NoAnswer(text)) => Err(text),
        Err(e) => return Err(anyhow::anyhow!(e.to_string())),
    };
    if json {
        let (id, error) = match &server {
            Ok(answer) => (answer.clone(), Value::Null),
            Err(text) => (Value::Null, json!(text)),
        };
        println(&json!({ "objects": objects, "server_id": id, "server_id_error": error }).to_string());
        return Ok(());
    }
    if objects.is_empty() {
        println(&format!(
            "device identification (43/14): {}",
            refused.unwrap_or_else(|| "no objects".to_owned())
        ));
    } else {
        let rows: Vec<Vec<String>> = objects
            .iter()
            .map(|o| {
                let id = o["id"].as_u64().unwrap_or(0);
                let name = o["name"].as_str().unwrap_or("").to_owned();
                vec![format!("{id:02X}"), name, o["text"].as_str().unwrap_or("").to_owned()]
            })
            .collect();
        print(&table(&["OBJECT", "NAME", "VALUE"], &rows));
    }
    match server {
        Ok(answer) => {
            let running = match answer["running"].as_bool() {
                Some(true) => ", running",
                Some(false) => ", stopped",
                None => "",
            };
            println(&format!(
                "server id (17): {}{running} \"{}\" [{}]",
                answer["id"],
                answer["text"].as_str().unwrap_or(""),
                answer["bytes"].as_str().unwrap_or("")
            ));
        }
        Err(text) => println(&format!("server id (17): {text}")),
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nobody_in_words() {
        assert_eq!(nobody(5, 5), "unit 5 does not answer");
        assert_eq!(nobody(1, 247), "none of the 247 units from 1 to 247 answers");
    }
}
