//! `dinrail modbus read` and `write`.

use super::points::{Point, decode};
use super::target::Master;
use crate::commands::{println, table};
use ipc_types::units::Span;
use serde_json::{Value, json};
use std::time::{Duration, Instant};

/// Reads the points, once or again and again.
pub fn read(
    line: &mut Master,
    points: &[Point],
    every: Option<Span>,
    rounds: Option<u64>,
    json: bool,
) -> anyhow::Result<()> {
    let mut round = 0;
    let mut next = Instant::now();
    loop {
        let mut rows = Vec::new();
        let mut failed = None;
        for point in points {
            match one(line, point) {
                Ok(values) => rows.extend(
                    values.into_iter().enumerate().map(|(i, (value, raw))| (point, i, Some(value), raw)),
                ),
                Err(e) => {
                    rows.push((point, 0, None, e.to_string()));
                    failed.get_or_insert(e);
                }
            }
        }
        if json {
            let list: Vec<Value> = rows
                .iter()
                .map(|(point, i, value, raw)| {
                    let number = point.number(*i);
                    let at = usize::from(point.at) + i * point.value_type.registers();
                    match value {
                        Some(value) => {
                            json!({ "name": point.name, "number": number, "table": point.table, "at": at, "value": value, "registers": raw })
                        }
                        None => json!({ "name": point.name, "number": number, "table": point.table, "at": at, "error": raw }),
                    }
                })
                .collect();
            println(&Value::Array(list).to_string());
        } else {
            let cells: Vec<Vec<String>> = rows
                .iter()
                .map(|(point, i, value, raw)| {
                    let at = usize::from(point.at) + i * point.value_type.registers();
                    let mut row = vec![point.number(*i), format!("{} {at}", point.table.name())];
                    row.push(value.as_ref().map_or_else(|| "-".to_owned(), plain));
                    row.push(raw.clone());
                    if points.iter().any(|p| p.name.is_some()) {
                        row.insert(0, point.name.clone().unwrap_or_default());
                    }
                    row
                })
                .collect();
            let head: &[&str] = if points.iter().any(|p| p.name.is_some()) {
                &["NAME", "NUMBER", "ADDRESS", "VALUE", "REGISTERS"]
            } else {
                &["NUMBER", "ADDRESS", "VALUE", "REGISTERS"]
            };
            crate::commands::print(&table(head, &cells));
        }
        round += 1;
        let Some(every) = every else {
            return failed.map_or(Ok(()), Err);
        };
        if rounds.is_some_and(|rounds| round >= rounds) {
            return failed.map_or(Ok(()), Err);
        }
        next += every.duration();
        std::thread::sleep(next.saturating_duration_since(Instant::now()));
        if next + Duration::from_secs(1) < Instant::now() {
            // Slower than asked for: no hurry afterwards.
            next = Instant::now();
        }
    }
}

fn plain(value: &Value) -> String {
    match value {
        Value::String(text) => text.clone(),
        Value::Bool(on) => if *on { "on" } else { "off" }.to_owned(),
        other => other.to_string(),
    }
}

/// Values of a point, each with its registers in hex.
fn one(line: &mut Master, point: &Point) -> anyhow::Result<Vec<(Value, String)>> {
    let job = json!({ "do": "read", "table": point.table, "at": point.at, "count": point.entries() });
    let answer = line.ask(&job)?;
    let entries: Vec<u16> = answer
        .get("values")
        .and_then(Value::as_array)
        .map(|list| list.iter().filter_map(Value::as_u64).map(|n| n as u16).collect())
        .unwrap_or_default();
    anyhow::ensure!(entries.len() == usize::from(point.entries()), "the answer has the wrong length");
    let hex = |registers: &[u16]| registers.iter().map(|r| format!("{r:04X}")).collect::<Vec<_>>().join(" ");
    let values = decode(point, &entries);
    if point.table.is_bits() {
        return Ok(values.into_iter().map(|value| (value, String::new())).collect());
    }
    if values.len() == 1 {
        return Ok(values.into_iter().map(|value| (value, hex(&entries))).collect());
    }
    let chunks = entries.chunks(point.value_type.registers());
    Ok(values.into_iter().zip(chunks).map(|(value, registers)| (value, hex(registers))).collect())
}

/// Writes the points, one request each.
pub fn write(
    line: &mut Master,
    writes: &[(Point, Vec<Value>)],
    multiple: bool,
    json: bool,
) -> anyhow::Result<()> {
    for (point, values) in writes {
        let job = json!({ "do": "write", "table": point.table, "at": point.at, "values": values, "multiple": multiple });
        let answer = line.ask(&job)?;
        if json {
            println(&json!({ "number": point.number(0), "answer": answer }).to_string());
        } else if answer.get("broadcast").is_some() {
            println(&format!("{}: broadcast, nobody confirms it", point.number(0)));
        } else {
            println(&format!("{}: {} written", point.number(0), point.count));
        }
    }
    Ok(())
}
