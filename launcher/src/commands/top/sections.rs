//! The tables of the main screen, made from statuses. A status is JSON of a service that may be of another
//! version: whatever is missing is shown as `-`.

use super::draw::{Cell, Mood, Section, cell, moody, printable};
use super::model::{Model, number, text};
use crate::commands::ps::uptime;
use serde_json::Value;

/// Clients listed on the main screen.
const CLIENTS_MAX: usize = 16;
/// Counters shown of a service of a kind that has no table of its own.
const FIELDS_MAX: usize = 8;
const NONE: &str = "-";

fn kind_of<'a>(model: &'a Model, service: &str) -> &'a str {
    model.now.rows.iter().find(|r| r.service == service).map_or("", |r| r.kind.as_str())
}

/// Name and last status of every service of these kinds.
fn told<'a>(
    model: &'a Model,
    wanted: impl Fn(&str) -> bool + 'a,
) -> impl Iterator<Item = (&'a str, &'a Value)> {
    model
        .now
        .told
        .iter()
        .filter(move |t| wanted(kind_of(model, &t.service)))
        .map(|t| (t.service.as_str(), &t.body))
}

fn whole(status: &Value, path: &str) -> String {
    number(status, path).map_or_else(|| NONE.to_owned(), |n| format!("{n:.0}"))
}

fn rate(model: &Model, service: &str, counter: &str) -> String {
    model.rate(service, counter).map_or_else(|| NONE.to_owned(), |n| format!("{n:.0}"))
}

fn sum(status: &Value, paths: &[&str]) -> Option<f64> {
    let known: Vec<f64> = paths.iter().filter_map(|path| number(status, path)).collect();
    (!known.is_empty()).then(|| known.iter().sum())
}

/// A count of something that should be 0.
fn losses(count: Option<f64>) -> Cell {
    match count {
        None => cell(NONE),
        Some(n) if n > 0.0 => moody(format!("{n:.0}"), Mood::Warning),
        Some(_) => cell("0"),
    }
}

pub fn services(model: &Model) -> Section {
    let rows = model.now.rows.iter().map(|row| {
        let lives = row.pid != 0 && model.gone.is_none();
        let state = if row.state == "running" { &row.health } else { &row.state };
        let mood = match state.as_str() {
            "ready" => Mood::Good,
            "degraded" | "starting" | "stopping" | "restarting" | "back-off" => Mood::Warning,
            _ => Mood::Bad,
        };
        let of = |text: String| cell(if lives { text } else { NONE.to_owned() });
        vec![
            cell(&row.service),
            cell(&row.kind),
            if model.gone.is_some() { cell(NONE) } else { moody(state, mood) },
            of(row.pid.to_string()),
            of(format!("{:.1}", row.cpu_percent)),
            of(format!("{:.1}", row.rss_bytes as f64 / 1_048_576.0)),
            moody(row.restarts.to_string(), if row.restarts > 0 { Mood::Warning } else { Mood::Plain }),
            cell(row.generation.to_string()),
            of(uptime(row.uptime_ms)),
        ]
    });
    let head = vec!["SERVICE", "KIND", "STATE", " PID", " CPU %", " MiB", " RESTARTS", " GEN", "UP"];
    Section { head, rows: rows.collect() }
}

pub fn buses(model: &Model) -> Section {
    let rows = told(model, |kind| kind == "can").map(|(name, s)| {
        let load = number(s, "load_permille").map_or_else(|| NONE.to_owned(), |n| format!("{:.1}", n / 10.0));
        let drops = [
            "bus.client_drops",
            "tx_queue.refused",
            "tx_invalid",
            "rx_unpublished",
            "link.kernel_drops",
            "wire.stale",
            "wire.lost",
        ];
        let errors = ["wire.errors", "link.bus_off"];
        let counters = match (number(s, "link.tec"), number(s, "link.rec")) {
            (Some(tec), Some(rec)) => format!("{tec:.0}/{rec:.0}"),
            _ => NONE.to_owned(),
        };
        vec![
            cell(name),
            cell(text(s, "backend").unwrap_or(NONE)),
            cell(load),
            cell(rate(model, name, "rx")),
            cell(rate(model, name, "tx")),
            losses(sum(s, &drops)),
            losses(sum(s, &errors)),
            cell(counters),
            bus_state(s),
        ]
    });
    let head = vec!["BUS", "BACKEND", " LOAD %", " RX/s", " TX/s", " DROPS", " ERRORS", " TEC/REC", "STATE"];
    Section { head, rows: rows.collect() }
}

fn bus_state(status: &Value) -> Cell {
    let Some(link) = status.get("link").filter(|l| l.is_object()) else {
        return moody("up", Mood::Good);
    };
    let trouble = text(link, "trouble").or_else(|| text(link, "last_error")).map(printable);
    let with = |word: &str| trouble.as_ref().map_or_else(|| word.to_owned(), |t| format!("{word}: {t}"));
    match (link.get("up").and_then(Value::as_bool), text(link, "state")) {
        (Some(false), _) => moody(with("down"), Mood::Bad),
        (_, Some(state)) if state != "active" && state != "error_active" => {
            moody(with(&state.replace('_', "-")), Mood::Warning)
        }
        _ => moody("up", Mood::Good),
    }
}

pub fn plcs(model: &Model) -> Section {
    let rows = told(model, |kind| kind == "plc").map(|(name, s)| {
        let state = text(s, "state").unwrap_or(NONE);
        let mood = match state {
            "run" => Mood::Good,
            "fault" => Mood::Bad,
            _ => Mood::Warning,
        };
        let micros = |path: &str| number(s, path).map_or_else(|| NONE.to_owned(), |n| format!("{n:.0}"));
        let program = match s.get("program").and_then(Value::as_array) {
            Some(files) if !files.is_empty() => {
                files.iter().filter_map(Value::as_str).collect::<Vec<_>>().join(" ")
            }
            _ => "no program".to_owned(),
        };
        let about = text(s, "fault").map_or(program, printable);
        vec![
            cell(name),
            moody(state, mood),
            cell(whole(s, "scan")),
            cell(rate(model, name, "scan")),
            cell(micros("scan_us.average")),
            cell(micros("scan_us.max")),
            losses(number(s, "periods_skipped")),
            losses(number(s, "forces")),
            losses(number(s, "faults")),
            cell(about),
        ]
    });
    let head = vec![
        "PLC", "STATE", " SCAN", " SCANS/s", " AVG us", " MAX us", " SKIPPED", " FORCED", " FAULTS",
        "PROGRAM",
    ];
    Section { head, rows: rows.collect() }
}

pub fn recorders(model: &Model) -> Section {
    let rows = told(model, |kind| kind == "recorder").map(|(name, s)| {
        let paused = text(s, "paused").map(printable);
        let file = text(s, "file").map_or(NONE, |f| f.rsplit('/').next().unwrap_or(f));
        let per_h = number(s, "mb_per_h").map_or_else(|| NONE.to_owned(), |n| format!("{n:.1}"));
        let mib = number(s, "bytes").map_or_else(|| NONE.to_owned(), |n| format!("{:.1}", n / 1_048_576.0));
        vec![
            cell(name),
            cell(per_h),
            cell(whole(s, "messages_per_s")),
            losses(number(s, "missed")),
            cell(mib),
            paused.map_or_else(|| cell(file), |why| moody(why, Mood::Bad)),
        ]
    });
    let head = vec!["RECORDER", " MB/h", " MSG/s", " MISSED", " MiB", "FILE"];
    Section { head, rows: rows.collect() }
}

pub fn clients(model: &Model) -> Section {
    let mut rows = Vec::new();
    for (name, s) in told(model, |kind| kind == "modbus-server") {
        for client in s.get("client_list").and_then(Value::as_array).into_iter().flatten().take(CLIENTS_MAX) {
            let peer = match (text(client, "address"), number(client, "port")) {
                (Some(address), Some(port)) if address.contains(':') => format!("[{address}]:{port:.0}"),
                (Some(address), Some(port)) => format!("{address}:{port:.0}"),
                _ => text(client, "peer").unwrap_or(NONE).to_owned(),
            };
            let seconds = |path: &str| match number(client, path) {
                None => NONE.to_owned(),
                Some(n) if n < 1.0 => "0 s".to_owned(),
                Some(n) => uptime((n as u64).saturating_mul(1000)),
            };
            rows.push(vec![
                cell(printable(&peer)),
                cell(name),
                cell(seconds("connected_s")),
                cell(seconds("idle_s")),
                cell(whole(client, "requests")),
                losses(number(client, "exceptions")),
                cell(whole(client, "last_unit")),
                cell(whole(client, "last_function")),
            ]);
        }
    }
    let head =
        vec!["MODBUS CLIENT", "SERVER", "CONNECTED", "IDLE", " REQUESTS", " EXCEPTIONS", " UNIT", "FUNCTION"];
    Section { head, rows }
}

/// Services without a table of their own: serial lines, CANopen, J1939 and what is to come. First what counts,
/// each number as `name total (+per second)`.
pub fn others(model: &Model) -> Section {
    const OWN: [&str; 5] = ["can", "plc", "recorder", "modbus-server", "can-io"];
    let rows = told(model, |kind| !kind.is_empty() && !OWN.contains(&kind)).map(|(name, s)| {
        let mut fields = Vec::new();
        for (path, value) in crate::commands::status::flat(s) {
            if fields.len() == FIELDS_MAX {
                break;
            }
            match value {
                Value::Number(n) if n.as_f64() != Some(0.0) => {
                    let grows = model.rate(name, &path).filter(|r| *r > 0.0);
                    let grows = grows.map_or_else(String::new, |r| format!(" (+{r:.0}/s)"));
                    fields.push(format!("{path} {n}{grows}"));
                }
                Value::String(word) if word.len() <= 40 => fields.push(format!("{path} {}", printable(word))),
                Value::Bool(true) => fields.push(path),
                _ => {}
            }
        }
        vec![cell(name), cell(kind_of(model, name)), cell(fields.join(", "))]
    });
    Section { head: vec!["OTHER", "KIND", "STATUS"], rows: rows.collect() }
}

pub fn points(model: &Model) -> Section {
    let rows = model.now.images.iter().flat_map(|shot| &shot.points).map(|point| {
        vec![
            cell(point.symbol.as_deref().unwrap_or(NONE)),
            cell(&point.address),
            cell(&point.type_name),
            cell(&point.value),
            cell(&point.service),
        ]
    });
    Section { head: vec!["POINT", "ADDRESS", "TYPE", " VALUE", "SERVICE"], rows: rows.collect() }
}
