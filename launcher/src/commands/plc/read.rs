//! `dinrail plc read`, `list` and `watch`.

use super::{LIMIT, Names, Variable};
use crate::commands::{UsageError, print, println, table};
use crate::supervise::jobs::{JobError, JobLine};
use crate::supervise::logbook;
use crate::terminal::print_screen;
use ipc_types::reactor::Reactor;
use ipc_types::units::Span;
use ipc_types::{Context, clock};
use serde_json::{Map, Value, json};
use std::io::IsTerminal;
use std::time::{Duration, Instant};

/// Bytes of names, and of values as they are reckoned, in one job; a message carries 4096.
const JOB_BYTES: usize = 3500;
/// Most variables of one job.
const JOB_VARS: usize = 250;
/// JSON of a value: the longest number with a comma.
const VALUE_BYTES: usize = 24;
/// Elements of an array that the engine shows.
const ELEMENTS: u64 = 64;
/// Variables that are watched at once.
const WATCHED: usize = 512;
/// Shortest and longest time between two looks.
const EVERY: (Duration, Duration) = (Duration::from_millis(20), Duration::from_mins(1));

/// The values of variables, those of one job from one moment.
fn values(line: &mut JobLine, variables: &[Variable]) -> Result<Vec<Value>, JobError> {
    let mut list = Vec::with_capacity(variables.len());
    for part in jobs(variables) {
        let names: Vec<&str> = part.iter().map(|v| v.path.as_str()).collect();
        let answer = line.ask(&json!({ "do": "read", "vars": names }), LIMIT)?;
        list.extend(names.iter().map(|name| answer.get(*name).cloned().unwrap_or(Value::Null)));
    }
    Ok(list)
}

/// Parts that fit a message, there and back.
fn jobs(variables: &[Variable]) -> Vec<&[Variable]> {
    let cost = |v: &Variable| v.path.len() + 4 + VALUE_BYTES * v.elements.clamp(1, ELEMENTS) as usize;
    let (mut parts, mut start, mut bytes) = (Vec::new(), 0, 0);
    for (i, variable) in variables.iter().enumerate() {
        bytes += cost(variable);
        if i > start && (bytes > JOB_BYTES || i - start >= JOB_VARS) {
            parts.push(&variables[start..i]);
            (start, bytes) = (i, cost(variable));
        }
    }
    if start < variables.len() {
        parts.push(&variables[start..]);
    }
    parts
}

fn expand(names: &Names, asked: &[String]) -> anyhow::Result<Vec<Variable>> {
    let (mut found, mut wrong) = (Vec::new(), Vec::new());
    for name in asked {
        match names.expand(name) {
            Ok(list) => found.extend(list),
            Err(text) => wrong.push(text),
        }
    }
    anyhow::ensure!(wrong.is_empty(), "{}", wrong.join("; "));
    Ok(found)
}

/// Prints each variable once.
pub fn once(names: &Names, line: &mut JobLine, asked: &[String], as_json: bool) -> anyhow::Result<()> {
    let variables = expand(names, asked)?;
    let values = values(line, &variables)?;
    for (variable, value) in variables.iter().zip(&values) {
        println(&if as_json { to_json(variable, value).to_string() } else { to_text(variable, value) });
    }
    Ok(())
}

fn to_text(variable: &Variable, value: &Value) -> String {
    format!("{} = {}", variable.path, variable.text(value))
}

/// TIME stays a number of milliseconds; an enumeration has its name beside its number.
fn to_json(variable: &Variable, value: &Value) -> Value {
    let mut object = json!({ "var": variable.path, "value": value, "type": variable.type_name });
    if let Some(name) = variable.name_of(value) {
        object["name"] = json!(name);
    }
    object
}

/// Prints every variable, or those with `filter` in their line.
pub fn list(names: &Names, filter: Option<&str>, as_json: bool) {
    let needle = filter.map(str::to_lowercase);
    let mut entries = names.entries();
    let row = |e: &super::names::Entry| {
        let mut type_name = e.type_name.clone();
        if !e.values.is_empty() {
            type_name += &format!(" ({})", e.values.join(", "));
        }
        let address = e.address.clone().unwrap_or_else(|| "-".to_owned());
        vec![
            e.var.clone(),
            type_name,
            address,
            if e.retain { "RETAIN" } else { "" }.to_owned(),
            e.declared.clone(),
        ]
    };
    entries.retain(|e| needle.as_ref().is_none_or(|n| row(e).join("\t").to_lowercase().contains(n)));
    if as_json {
        println(&json!(entries).to_string());
    } else if entries.is_empty() {
        println(if filter.is_some() {
            "no variable has this text"
        } else {
            "no variables, only %-addresses"
        });
    } else {
        let rows: Vec<Vec<String>> = entries.iter().map(row).collect();
        print(&table(&["VARIABLE", "TYPE", "ADDRESS", "KEPT", "DECLARED"], &rows));
    }
}

/// What to watch and how.
pub struct Watch<'a> {
    /// Empty: all.
    pub variables: &'a [String],
    pub every: Span,
    pub duration: Option<Span>,
    pub json: bool,
}

pub fn check_period(every: Span) -> Result<(), UsageError> {
    let fits = (EVERY.0..=EVERY.1).contains(&every.duration());
    if fits { Ok(()) } else { Err(UsageError("--every takes 20ms to 60s".to_owned())) }
}

/// Shows values again and again: on a terminal in place, else one line for each that changed, until Ctrl-C or the time is
/// over.
pub fn watch(ctx: &Context, line: &mut JobLine, plc: &str, wanted: &Watch<'_>) -> anyhow::Result<()> {
    let mut reactor = Reactor::new()?;
    let stop = reactor.add(ctx.shutdown_fd())?;
    let in_place = std::io::stdout().is_terminal() && !wanted.json;
    let begin = Instant::now();
    let mut seen: Vec<Value> = Vec::new();
    let mut variables = watched(&Names::fetch(ctx, line, plc)?, wanted)?;
    let mut due = begin;
    loop {
        let now = match values(line, &variables) {
            Ok(now) => now,
            // Another program was loaded: its variables may lie elsewhere, or be others.
            Err(JobError::Refused { .. }) => {
                variables = watched(&Names::fetch(ctx, line, plc)?, wanted)?;
                seen.clear();
                values(line, &variables)?
            }
            Err(e) => return Err(e.into()),
        };
        let utc_ns = clock::utc_ns();
        if in_place {
            print_screen(&page(plc, utc_ns, &variables, &now));
        } else {
            print(&changes(utc_ns, &variables, &seen, &now, wanted.json));
        }
        seen = now;
        due += wanted.every.duration();
        let end = wanted.duration.map(|d| begin + d.duration());
        if end.is_some_and(|end| due > end) {
            return Ok(());
        }
        // A look that took longer than the period is not made up for.
        due = due.max(Instant::now());
        let wait = due.saturating_duration_since(Instant::now());
        if reactor.wait(Some(wait))?.contains(&stop) {
            return Ok(());
        }
    }
}

fn watched(names: &Names, wanted: &Watch<'_>) -> anyhow::Result<Vec<Variable>> {
    let mut list = if wanted.variables.is_empty() { names.all() } else { expand(names, wanted.variables)? };
    anyhow::ensure!(!list.is_empty(), "there is no program: name %-addresses, for example %MW0");
    if list.len() > WATCHED {
        eprintln!(
            "dinrail: the first {WATCHED} of {} variables are watched; name those you need",
            list.len()
        );
        list.truncate(WATCHED);
    }
    Ok(list)
}

fn page(plc: &str, utc_ns: i64, variables: &[Variable], values: &[Value]) -> String {
    let rows: Vec<Vec<String>> = variables
        .iter()
        .zip(values)
        .map(|(variable, value)| {
            vec![variable.path.clone(), variable.text(value), variable.type_name.clone()]
        })
        .collect();
    let time = logbook::clock(utc_ns);
    format!("{plc}, {time} UTC, Ctrl-C ends\n\n{}", table(&["VARIABLE", "VALUE", "TYPE"], &rows))
}

/// What is new: lines, or one object. The first time everything is.
fn changes(utc_ns: i64, variables: &[Variable], before: &[Value], now: &[Value], as_json: bool) -> String {
    let is_new = |(i, value): &(usize, &Value)| before.get(*i) != Some(value);
    let new: Vec<(&Variable, &Value)> =
        now.iter().enumerate().filter(is_new).map(|(i, value)| (&variables[i], value)).collect();
    if new.is_empty() {
        return String::new();
    }
    let time = logbook::clock(utc_ns);
    if as_json {
        let values: Map<String, Value> =
            new.iter().map(|(v, value)| (v.path.clone(), (*value).clone())).collect();
        let names: Map<String, Value> =
            new.iter().filter_map(|(v, value)| Some((v.path.clone(), json!(v.name_of(value)?)))).collect();
        let mut object = json!({ "utc_ns": utc_ns, "values": values });
        if !names.is_empty() {
            object["names"] = Value::Object(names);
        }
        return format!("{object}\n");
    }
    new.iter().map(|(variable, value)| format!("{time}  {}\n", to_text(variable, value))).collect()
}

#[cfg(test)]
mod tests {
    use super::super::tests::stack;
    use super::*;

    fn variable(path: &str, elements: u64) -> Variable {
        let names = Names::of(&stack(), "plc", None);
        let mut variable = names.expand("%MW0").unwrap().remove(0);
        (variable.path, variable.elements) = (path.to_owned(), elements);
        variable
    }

    #[test]
    fn a_job_takes_no_more_than_a_message_carries() {
        let small: Vec<Variable> = (0..600).map(|i| variable(&format!("v{i}"), 1)).collect();
        let parts = jobs(&small);
        assert_eq!(parts.iter().map(|p| p.len()).sum::<usize>(), 600);
        assert!(parts.len() > 2 && parts.iter().all(|p| !p.is_empty() && p.len() <= JOB_VARS));
        let arrays: Vec<Variable> = (0..5).map(|i| variable(&format!("a{i}"), 1000)).collect();
        assert_eq!(jobs(&arrays).iter().map(|p| p.len()).collect::<Vec<_>>(), [2, 2, 1]);
        assert!(jobs(&[]).is_empty());
        let long = [variable(&"x".repeat(5000), 1)];
        assert_eq!(jobs(&long).len(), 1);
    }

    #[test]
    fn only_what_changed_is_told_again() {
        let variables = [variable("a", 1), variable("b", 1)];
        let at = 1_700_000_000_123_456_789;
        let told = |before: &[Value], now: &[Value], json| changes(at, &variables, before, now, json);
        let (one, two) = ([json!(1), json!(true)], [json!(2), json!(true)]);
        assert_eq!(told(&[], &one, false), "22:13:20.123  a = 1\n22:13:20.123  b = TRUE\n");
        assert_eq!(told(&one, &two, false), "22:13:20.123  a = 2\n");
        assert_eq!(told(&two, &two, true), "");
        assert_eq!(told(&one, &two, true), "{\"utc_ns\":1700000000123456789,\"values\":{\"a\":2}}\n");
        assert!(page("plc", at, &variables, &one).contains("VARIABLE  VALUE  TYPE\na         1      UINT\n"));
    }

    #[test]
    fn the_period_is_checked() {
        assert!(check_period("1s".parse().unwrap()).is_ok());
        assert!(
            check_period("1ms".parse().unwrap()).is_err() && check_period("2min".parse().unwrap()).is_err()
        );
    }
}
