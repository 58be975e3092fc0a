//! `dinrail status`: how the stack is, and what its services tell about themselves.

use super::ps::{fetch_status, row_json, uptime};
use super::top::feed::{Feed, FeedError, Snapshot, Told};
use super::{print, table};
use crate::cli::Which;
use crate::stackfile::suggestion;
use crate::supervise::client::{ClientError, find};
use crate::supervise::control::{ServiceRow, StackStatus};
use ipc_types::reactor::Reactor;
use serde_json::{Map, Value, json};
use std::process::ExitCode;
use std::time::Duration;

/// Services tell their status once a second; one that does not within this is shown without.
const STATUS_WAIT: Duration = Duration::from_millis(1500);
/// Time between two screens of `--watch`.
const WATCH: Duration = Duration::from_secs(1);
/// Columns of a table within a status.
const COLUMNS_MAX: usize = 16;
/// Columns that name what a row is about, first those that name most.
const NAMING: [&str; 8] = ["target", "serial", "service", "address", "unit", "node", "id", "name"];
/// Rows of it.
const ROWS_MAX: usize = 64;

/// Which services and how.
pub struct Wanted<'a> {
    /// Empty: all.
    pub services: &'a [String],
    /// Again every second, until the stack ends or Ctrl-C.
    pub watch: bool,
    pub json: bool,
}

/// Exit code 1 unless the stack is running or starting, and 1 for an unknown service.
pub fn run(which: &Which, wanted: &Wanted<'_>) -> anyhow::Result<ExitCode> {
    let stack = find(which.stack.as_deref())?;
    let mut feed = match Feed::open(&stack) {
        Ok(feed) => feed,
        // A stack that is going down has no rail any more, but its launcher still answers.
        Err(FeedError::Rail(_)) if wanted.services.is_empty() => {
            let status = fetch_status(which)?;
            let alone = Snapshot { stack: Some(status), ..Snapshot::default() };
            print(&shown(&alone, &[], wanted.json));
            return Ok(code(&alone));
        }
        Err(e) => return Err(e.into()),
    };
    let services = choose(&feed.services(), wanted.services)?;
    let mut reactor = Reactor::new()?;
    let stop = reactor.add(feed.ctx.shutdown_fd())?;
    let mut first = true;
    loop {
        let snapshot = look(&mut feed, &services, first);
        let snapshot = match snapshot {
            Ok(snapshot) => snapshot,
            Err(FeedError::Client(ClientError::Io { .. })) if !first => {
                eprintln!("dinrail: stack '{}' has ended", stack.stack);
                return Ok(ExitCode::SUCCESS);
            }
            Err(e) => return Err(e.into()),
        };
        let text = shown(&snapshot, &services, wanted.json);
        if !wanted.watch {
            print(&text);
            return Ok(code(&snapshot));
        }
        show_frame(&text, first, wanted.json);
        first = false;
        if reactor.wait(Some(WATCH))?.contains(&stop) {
            return Ok(ExitCode::SUCCESS);
        }
    }
}

fn look(feed: &mut Feed, services: &[String], first: bool) -> Result<Snapshot, FeedError> {
    if first {
        // Only those that can: a dead service tells nothing.
        let alive = feed.look()?.rows.into_iter().filter(|r| r.pid != 0 && services.contains(&r.service));
        let alive: Vec<String> = alive.map(|r| r.service).collect();
        feed.wait_for_statuses(&alive, STATUS_WAIT);
    }
    feed.look()
}

fn code(snapshot: &Snapshot) -> ExitCode {
    let well = snapshot.stack.as_ref().is_some_and(|s| matches!(s.state.as_str(), "running" | "starting"));
    if well { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

/// A screen of `--watch`: over the last one on a terminal, else below it.
fn show_frame(text: &str, first: bool, json: bool) {
    use std::io::IsTerminal;
    if std::io::stdout().is_terminal() && !json {
        return crate::terminal::print_screen(text);
    }
    print(&if first || json { text.to_owned() } else { format!("\n{text}") });
}

fn choose(has: &[&str], asked: &[String]) -> anyhow::Result<Vec<String>> {
    for name in asked {
        if !has.contains(&name.as_str()) {
            let help = suggestion(name, "services", has.iter().copied());
            anyhow::bail!("this stack has no service '{name}'; {help}");
        }
    }
    let wanted = |name: &&&str| asked.is_empty() || asked.iter().any(|a| a == **name);
    Ok(has.iter().filter(wanted).map(|name| (*name).to_owned()).collect())
}

fn shown(snapshot: &Snapshot, services: &[String], json: bool) -> String {
    if json {
        return format!("{}\n", to_json(snapshot, services));
    }
    let mut text = snapshot.stack.as_ref().map(|s| stack_text(s) + "\n").unwrap_or_default();
    for row in snapshot.rows.iter().filter(|r| services.contains(&r.service)) {
        let told = snapshot.told.iter().find(|t| t.service == row.service);
        text += &format!("\n{}", service_text(row, told, snapshot.t_ns));
    }
    text
}

/// The stack's own keys, and `service_list`: the keys of `ps`, `status` (null when it told none) and its age.
fn to_json(snapshot: &Snapshot, services: &[String]) -> Value {
    let mut value = snapshot.stack.as_ref().map_or(Value::Null, |s| json!(s));
    let list: Vec<Value> = snapshot
        .rows
        .iter()
        .filter(|r| services.contains(&r.service))
        .map(|row| {
            let told = snapshot.told.iter().find(|t| t.service == row.service);
            let mut entry = row_json(row);
            entry["status"] = told.map_or(Value::Null, |t| t.body.clone());
            entry["status_age_ms"] = told.map_or(Value::Null, |t| json!(age_ms(t, snapshot.t_ns)));
            entry
        })
        .collect();
    if value.is_object() {
        value["service_list"] = Value::Array(list);
    }
    value
}

fn age_ms(told: &Told, now_ns: u64) -> u64 {
    now_ns.saturating_sub(told.t_ns) / 1_000_000
}

pub(super) fn stack_text(s: &StackStatus) -> String {
    let mut text = format!(
        "stack '{}' is {}, launcher pid {}, up {}, {} of {} services ready, build {}",
        s.stack,
        s.state,
        s.pid,
        uptime(s.uptime_ms),
        s.ready,
        s.services,
        s.build_id
    );
    if !s.held.is_empty() {
        // Not "after too many restarts": with `restart = { max = 0 }` there was none.
        let names = s.held.join(", ");
        text += &format!(
            "\nheld, not started again: {names}; `dinrail logs SERVICE` says why, `dinrail restart SERVICE` starts it"
        );
    }
    if !s.degraded.is_empty() {
        text += &format!("\ndegraded: {}; below each says why", s.degraded.join(", "));
    }
    if !s.unstable.is_empty() {
        let names = s.unstable.join(", ");
        text += &format!(
            "\nunstable, dies again and again: {names}; `dinrail logs SERVICE` says why; forgotten after a minute's good run"
        );
    }
    if let Some(why) = &s.failed {
        text += &format!("\nfailed: {why}");
    }
    text
}

fn service_text(row: &ServiceRow, told: Option<&Told>, now_ns: u64) -> String {
    let state = if row.state == "running" { &row.health } else { &row.state };
    let mut text = format!("{}  {}  {state}", row.service, row.kind);
    if row.pid != 0 {
        text += &format!(
            "  pid {}  up {}  CPU {:.1} %  {:.1} MiB",
            row.pid,
            uptime(row.uptime_ms),
            row.cpu_percent,
            row.rss_bytes as f64 / 1_048_576.0
        );
    }
    text += &format!("  generation {}  restarts {}\n", row.generation, row.restarts);
    let Some(told) = told else {
        let why = if row.pid == 0 { "no process" } else { "it has told no status yet" };
        return text + &format!("  ({why})\n");
    };
    let age_ms = age_ms(told, now_ns);
    // Twice the period: one that is late by a moment is not worth a line.
    if age_ms > 2500 {
        text += &format!("  (told {} ago)\n", uptime(age_ms));
    }
    text + &body_text(&told.body)
}

/// A status, one value a line, lists of objects as tables below.
fn body_text(body: &Value) -> String {
    let fields = flat(body);
    let plain: Vec<(String, String)> = fields
        .iter()
        .filter(|(_, value)| rows_of(value).is_none())
        .map(|(path, value)| (path.clone(), plain(value)))
        .collect();
    let width = plain.iter().map(|(path, _)| path.chars().count()).max().unwrap_or(0);
    let mut text: String = plain
        .iter()
        .map(|(path, value)| format!("  {path:width$}  {value}").trim_end().to_owned() + "\n")
        .collect();
    for (path, value) in &fields {
        if let Some(rows) = rows_of(value) {
            text += &tables_text(path, rows, 0);
        }
    }
    text
}

type Row<'a> = Vec<(String, &'a Value)>;

/// A list of objects as a table; lists of objects in its rows (units of lines) as tables of their own below it, whose
/// first column says to which row they belong.
fn tables_text(path: &str, mut rows: Vec<Row<'_>>, depth: u32) -> String {
    let mut inner: Vec<(String, Vec<Row<'_>>)> = Vec::new();
    for row in &mut rows {
        // The depth is bounded by the status's own limit of bytes; this keeps the stack small anyhow.
        let plain = row.iter().filter(|(_, value)| rows_of(value).is_none());
        let whose = plain.min_by_key(|(path, _)| rank(path)).filter(|_| depth < 8).cloned();
        let Some((key, owner)) = whose else { continue };
        row.retain(|(name, value)| {
            let Some(list) = rows_of(value) else { return true };
            let list = list.into_iter().map(|mut entry| {
                let taken = entry.iter().any(|(name, _)| *name == key);
                let key = if taken { format!("{path}.{key}") } else { key.clone() };
                entry.insert(0, (key, owner));
                entry
            });
            match inner.iter_mut().find(|(known, _)| known == name) {
                Some((_, entries)) => entries.extend(list),
                None => inner.push((name.clone(), list.collect())),
            }
            false
        });
    }
    // An empty list beside full ones is no column either.
    for row in &mut rows {
        row.retain(|(name, _)| inner.iter().all(|(list, _)| list != name));
    }
    let mut text = format!("  {path}\n{}", list_text(&rows, depth > 0));
    for (name, entries) in inner {
        text += &tables_text(&format!("{path}.{name}"), entries, depth + 1);
    }
    text
}

/// Every value that is no object, by its path: `bus.frames`.
pub fn flat(value: &Value) -> Vec<(String, &Value)> {
    fn walk<'a>(prefix: &str, map: &'a Map<String, Value>, depth: u32, out: &mut Vec<(String, &'a Value)>) {
        for (key, value) in map {
            let path = if prefix.is_empty() { key.clone() } else { format!("{prefix}.{key}") };
            match value {
                // The depth is bounded by the status's own limit of bytes; this keeps the stack small anyhow.
                Value::Object(inner) if !inner.is_empty() && depth < 16 => walk(&path, inner, depth + 1, out),
                _ => out.push((path, value)),
            }
        }
    }
    let mut out = Vec::new();
    if let Value::Object(map) = value {
        walk("", map, 0, &mut out);
    }
    out
}

/// The rows of a list of objects; `None` for anything else.
fn rows_of(value: &Value) -> Option<Vec<Row<'_>>> {
    let list = value.as_array().filter(|l| !l.is_empty())?;
    list.iter().all(Value::is_object).then(|| list.iter().map(flat).collect())
}

/// Columns that say what a row is about stand first, those of objects within it last.
fn rank(path: &str) -> usize {
    let known = NAMING.iter().position(|name| *name == path);
    known.unwrap_or(NAMING.len() + usize::from(path.contains('.')))
}

fn list_text(rows: &[Row<'_>], owned: bool) -> String {
    let mut head: Vec<&str> = Vec::new();
    for (path, _) in rows.iter().flatten() {
        if !head.contains(&path.as_str()) {
            head.push(path);
        }
    }
    // The owner that was put in front of the rows of an inner list stays there.
    head[usize::from(owned)..].sort_by_key(|path| rank(path));
    head.truncate(COLUMNS_MAX);
    let cells = |row: &Row<'_>| {
        let find =
            |name: &&str| row.iter().find(|(path, _)| path == name).map_or("-".to_owned(), |(_, v)| plain(v));
        head.iter().map(find).collect::<Vec<String>>()
    };
    let body: Vec<Vec<String>> = rows.iter().take(ROWS_MAX).map(cells).collect();
    // `counters.requests` is `requests` where no other column has that name.
    let short = |path: &str| path.rsplit('.').next().unwrap_or_default().to_owned();
    let shorts: Vec<String> = head.iter().map(|path| short(path)).collect();
    let named = head.iter().zip(&shorts).map(|(path, short)| {
        if shorts.iter().filter(|other| *other == short).count() == 1 { short.as_str() } else { path }
    });
    let named: Vec<&str> = named.collect();
    let mut text: String = table(&named, &body).lines().map(|line| format!("    {line}\n")).collect();
    if rows.len() > ROWS_MAX {
        text += &format!("    and {} more\n", rows.len() - ROWS_MAX);
    }
    text
}

/// A value as people read it, without anything that steers a terminal.
fn plain(value: &Value) -> String {
    let text = match value {
        Value::Null => "-".to_owned(),
        Value::Bool(true) => "yes".to_owned(),
        Value::Bool(false) => "no".to_owned(),
        Value::String(text) => text.clone(),
        Value::Array(list) if list.is_empty() => "-".to_owned(),
        Value::Array(list) => list.iter().map(plain).collect::<Vec<_>>().join(", "),
        Value::Object(map) if map.is_empty() => "-".to_owned(),
        Value::Number(n) => match n.as_f64().filter(|_| n.is_f64()) {
            Some(float) => format!("{float:.3}").trim_end_matches('0').trim_end_matches('.').to_owned(),
            None => n.to_string(),
        },
        other @ Value::Object(_) => other.to_string(),
    };
    text.chars().map(|c| if c.is_control() { '\u{fffd}' } else { c }).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::commands::top::tests::{row, snapshot};

    #[test]
    fn every_service_is_shown_with_what_it_tells() {
        let mut snapshot = snapshot(1);
        snapshot.told.retain(|t| t.service != "rec");
        let names: Vec<String> = ["rec", "can1", "plc", "modbus"].map(str::to_owned).into();
        insta::assert_snapshot!(shown(&snapshot, &names, false));
        let value: Value = serde_json::from_str(&shown(&snapshot, &names, true)).unwrap();
        assert_eq!((&value["stack"], value["service_list"].as_array().unwrap().len()), (&json!("demo"), 4));
        assert_eq!(value["service_list"][1]["status"]["link"]["tec"], 255);
        assert_eq!(
            (&value["service_list"][0]["status"], &value["service_list"][2]["status_age_ms"]),
            (&Value::Null, &json!(0))
        );
    }

    #[test]
    fn a_held_service_is_told_without_guessing_why() {
        let mut stack = snapshot(0).stack.unwrap();
        stack.held = vec!["io".into()];
        let text = stack_text(&stack);
        assert!(text.contains("\nheld, not started again: io; `dinrail logs SERVICE`"), "{text}");
        assert!(!text.contains("too many"), "{text}");
        stack.unstable = vec!["plc".into()];
        assert!(stack_text(&stack).contains("\nunstable, dies again and again: plc; "));
    }

    #[test]
    fn an_unknown_service_is_answered_with_the_nearest() {
        let has = ["rec", "can0", "modbus"];
        let refused = choose(&has, &["modus".to_owned()]).unwrap_err().to_string();
        assert!(
            refused.starts_with("this stack has no service 'modus'; did you mean 'modbus'?"),
            "{refused}"
        );
        let far = choose(&has, &["zzzzzz".to_owned()]).unwrap_err().to_string();
        assert!(far.contains("rec, can0, modbus"), "{far}");
        // In the order of the stack, whatever the order asked.
        assert_eq!(choose(&has, &["modbus".to_owned(), "rec".to_owned()]).unwrap(), ["rec", "modbus"]);
        assert_eq!(choose(&has, &[]).unwrap().len(), 3);
    }

    #[test]
    fn lists_within_lists_are_tables_of_their_own() {
        let unit = |unit: u8, requests: u64| json!({ "unit": unit, "state": "ok", "counters": { "requests": requests }, "rtt_us": null });
        let body = json!({
            "clients": 1,
            "lines": [
                { "serial": "com1", "waiting": 0, "counters": { "late": 1 }, "units": [unit(1, 20), unit(17, 3)] },
                { "serial": "com2", "waiting": 2, "counters": { "late": 0 }, "units": [unit(5, 7)] },
                { "serial": "com3", "waiting": 0, "counters": { "late": 0 }, "units": [] },
            ],
        });
        insta::assert_snapshot!(body_text(&body), @r"
          clients  1
          lines
            serial  waiting  late
            com1    0        1
            com2    2        0
            com3    0        0
          lines.units
            serial  unit  rtt_us  state  requests
            com1    1     -       ok     20
            com1    17    -       ok     3
            com2    5     -       ok     7
        ");
        // Names that would be the same stay whole, and an owner is told from what it owns.
        let body = json!({ "a": [{ "id": 1, "x": { "n": 2 }, "y": { "n": 3 }, "b": [{ "id": 9 }] }] });
        insta::assert_snapshot!(body_text(&body), @r"
          a
            id  x.n  y.n
            1   2    3
          a.b
            a.id  id
            1     9
        ");
    }

    #[test]
    fn values_are_plain_and_cannot_steer_the_terminal() {
        let body = json!({ "a": 1.5, "b": 2.0, "c": null, "d": true, "e": [1, 2], "f": [], "g": {}, "h": { "i": "x\u{1b}[2J" } });
        assert_eq!(
            body_text(&body),
            "  a    1.5\n  b    2\n  c    -\n  d    yes\n  e    1, 2\n  f    -\n  g    -\n  h.i  x\u{fffd}[2J\n"
        );
        assert_eq!(body_text(&json!("text")), "");
        let old = Told { service: "a".into(), generation: 1, t_ns: 0, body: json!({}) };
        assert!(service_text(&row("a", "can"), Some(&old), 5_000_000_000).contains("(told 5 s ago)"));
    }
}
