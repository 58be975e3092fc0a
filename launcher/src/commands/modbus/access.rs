//! `dinrail modbus read` and `write`.

use super::points::{Point, ValueType, decode};
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
                            json!({ "name": point.name, "number": number, "table": point.table, "at": at, "form": point.form(), "value": value, "registers": raw })
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
                    row.push(point.form());
                    if points.iter().any(|p| p.name.is_some()) {
                        row.insert(0, point.name.clone().unwrap_or_default());
                    }
                    row
                })
                .collect();
            let head: &[&str] = if points.iter().any(|p| p.name.is_some()) {
                &["NAME", "NUMBER", "ADDRESS", "VALUE", "REGISTERS", "READ AS"]
            } else {
                &["NUMBER", "ADDRESS", "VALUE", "REGISTERS", "READ AS"]
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
            println(&json!({ "number": point.number(0), "values": point.count, "entries": values.len(), "form": point.form(), "answer": answer }).to_string());
        } else if answer.get("broadcast").is_some() {
            println(&format!("{}: broadcast, nobody confirms it", point.number(0)));
        } else {
            println(&written(point, values.len()));
        }
    }
    Ok(())
}

/// `40001: 1 value written as float ABCD, 2 registers`: text and bits say less.
fn written(point: &Point, entries: usize) -> String {
    let number = point.number(0);
    let values = point.count;
    if point.value_type == ValueType::Text {
        return format!("{number}: text written, {entries} register{}", plural(entries));
    }
    let value = format!("{values} value{} written", plural(values.into()));
    if point.table.is_bits() {
        return format!("{number}: {value}");
    }
    format!("{number}: {value} as {}, {entries} register{}", point.form(), plural(entries))
}

fn plural(count: usize) -> &'static str {
    if count == 1 { "" } else { "s" }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::commands::modbus::PointArgs;
    use crate::commands::modbus::points::parse_writes;

    #[test]
    fn what_was_written_is_counted() {
        let form = PointArgs { table: None, value_type: None, order: None };
        let texts =
            ["40001=5", "40001=1,2", "40001:float=1.5", "00001=on", "00001=on,off", "40001:string=abc"];
        let writes = parse_writes(&texts.map(str::to_owned), &form).unwrap();
        let said: Vec<String> = writes.iter().map(|(point, values)| written(point, values.len())).collect();
        insta::assert_snapshot!(said.join("\n"), @"
        40001: 1 value written as uint16, 1 register
        40001: 2 values written as uint16, 2 registers
        40001: 1 value written as float ABCD, 2 registers
        00001: 1 value written
        00001: 2 values written
        40001: text written, 2 registers
        ");
    }
}
