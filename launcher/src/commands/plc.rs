//! `dinrail plc`: jobs for a PLC of a running stack.
//!
//! [`names`] knows its variables; [`read`] shows them, once or again and again; [`state`] is `plc status`;
//! [`super::plc_write`] sets and forces.

mod names;
mod read;
mod state;

use super::plc_write::{Kind, set};
use super::{UsageError, println};
use crate::cli::PlcCommand;
use crate::supervise::client::{find, observe};
use crate::supervise::jobs::{JobLine, choose};
pub use names::{Names, Variable};
use serde_json::{Value, json};
use std::path::Path;
use std::time::Duration;

/// How long a job may take.
const LIMIT: Duration = Duration::from_secs(5);

pub fn run(
    service: Option<&str>,
    stack: Option<&str>,
    command: PlcCommand,
    json: bool,
) -> anyhow::Result<()> {
    let assignments = match &command {
        PlcCommand::Write { assignments } | PlcCommand::Force { assignments } => {
            assignments.iter().map(|text| assignment(text)).collect::<Result<Vec<_>, _>>()?
        }
        _ => Vec::new(),
    };
    if let PlcCommand::Watch { every, .. } = &command {
        read::check_period(*every)?;
    }
    let running = find(stack)?;
    let mut ctx = observe(&running)?;
    let plc = choose(&ctx, "plc", service)?;
    let mut line = JobLine::open(&mut ctx, running, "plc", &plc)?;
    let names = |line: &mut JobLine| Names::fetch(&ctx, line, &plc);
    match command {
        PlcCommand::Read { variables } => read::once(&names(&mut line)?, &mut line, &variables, json),
        PlcCommand::List { filter } => {
            read::list(&names(&mut line)?, filter.as_deref(), json);
            Ok(())
        }
        PlcCommand::Watch { variables, every, duration } => {
            let wanted = read::Watch { variables: &variables, every, duration, json };
            read::watch(&ctx, &mut line, &plc, &wanted)
        }
        PlcCommand::Write { .. } => {
            let names = names(&mut line)?;
            set(&mut ctx, &mut line, &plc, &names, &assignments, (Kind::Write, json))
        }
        PlcCommand::Force { .. } => {
            let names = names(&mut line)?;
            set(&mut ctx, &mut line, &plc, &names, &assignments, (Kind::Force, json))
        }
        PlcCommand::Status => {
            let answer = line.ask(&json!({ "do": "status" }), LIMIT)?;
            println(&if json { answer.to_string() } else { state::text(&plc, &answer) });
            Ok(())
        }
        command => {
            for mut job in jobs_of(&command) {
                name_as_stack_does(&mut job, &ctx.stack.dir);
                let answer = line.ask(&job, LIMIT)?;
                println(&if json { answer.to_string() } else { text_of(&job, &answer) });
            }
            Ok(())
        }
    }
}

/// The jobs of a command that nothing is to be found out for, in order.
fn jobs_of(command: &PlcCommand) -> Vec<Value> {
    let plain = |what: &str| vec![json!({ "do": what })];
    match command {
        PlcCommand::Stop => plain("stop"),
        PlcCommand::Run => plain("run"),
        PlcCommand::Cold => plain("cold"),
        PlcCommand::Warm => plain("warm"),
        PlcCommand::Hot => plain("hot"),
        PlcCommand::Load { program, cold } => {
            // The service has another working directory.
            let path = std::path::absolute(program).unwrap_or_else(|_| program.clone());
            vec![json!({ "do": "load", "path": path, "cold": cold })]
        }
        PlcCommand::Unforce { all: true, .. } => plain("unforce_all"),
        PlcCommand::Unforce { variables, .. } => {
            variables.iter().map(|var| json!({ "do": "unforce", "var": var })).collect()
        }
        PlcCommand::Status
        | PlcCommand::Read { .. }
        | PlcCommand::List { .. }
        | PlcCommand::Watch { .. }
        | PlcCommand::Write { .. }
        | PlcCommand::Force { .. } => Vec::new(),
    }
}

/// A program of the stack's own folder is named as the stack file names it: so it is found in the recording.
fn name_as_stack_does(job: &mut Value, dir: &Path) {
    if let Some(path) = job.get("path").and_then(Value::as_str)
        && let Ok(short) = Path::new(path).canonicalize().unwrap_or_else(|_| path.into()).strip_prefix(dir)
    {
        job["path"] = json!(short);
    }
}

/// `Main.Speed=12` in its two parts; the value as JSON where it is one, else as the text it is (`T#5s`, `TRUE`).
pub fn assignment(text: &str) -> Result<(String, Value), UsageError> {
    let parts =
        text.split_once('=').filter(|(var, value)| !var.trim().is_empty() && !value.trim().is_empty());
    let Some((var, value)) = parts else {
        return Err(UsageError(format!(
            "'{text}' is no assignment: write VAR=VALUE, for example Main.Speed=12"
        )));
    };
    let var = var.trim().trim_end_matches(':').trim_end().to_owned();
    let value = value.trim();
    let parsed = match value.to_ascii_uppercase().as_str() {
        "TRUE" => Value::Bool(true),
        "FALSE" => Value::Bool(false),
        _ => match serde_json::from_str::<Value>(value) {
            Ok(number @ Value::Number(_)) => number,
            _ => Value::String(value.to_owned()),
        },
    };
    Ok((var, parsed))
}

fn text_of(job: &Value, answer: &Value) -> String {
    let var = job.get("var").and_then(Value::as_str);
    match (var, answer) {
        (Some(var), Value::Null | Value::Bool(_)) => format!("{var}: done"),
        (_, Value::Object(map)) => {
            map.iter().map(|(key, value)| format!("{key}: {}", plain(value))).collect::<Vec<_>>().join("\n")
        }
        (_, Value::Null | Value::Bool(_)) => "done".to_owned(),
        (_, value) => plain(value),
    }
}

pub fn plain(value: &Value) -> String {
    match value {
        Value::String(text) => text.clone(),
        Value::Bool(true) => "TRUE".to_owned(),
        Value::Bool(false) => "FALSE".to_owned(),
        other => other.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ipc_types::stack::{ServiceEntry, Stack};
    use ipc_types::wiring::{Area, ImageRange, OnBad, Wiring};

    pub const PROGRAM: &str = "TYPE Mode : (Off, Auto := 5); Axis : STRUCT pos : INT; busy : BOOL; END_STRUCT; END_TYPE
PROGRAM Main
VAR n : INT; mode : Mode := Auto; pause : TIME := T#500ms; hold : TON; table : ARRAY [1..3] OF INT; axis : ARRAY [0..1] OF Axis; END_VAR
VAR RETAIN kept : INT; END_VAR
n := n + 1; hold(IN := TRUE, PT := pause);
END_PROGRAM
";

    /// `io` delivers %ID1 as `Level` and %IX0.3, and sends %QB1 as `Lamps`.
    pub fn stack() -> Stack {
        let range = |area, byte, bit, bytes, type_name: &str, symbol: Option<&str>| ImageRange {
            area,
            byte,
            bit,
            bytes,
            type_name: Some(type_name.to_owned()),
            symbol: symbol.map(str::to_owned),
            label: String::new(),
            key: "in[0]".to_owned(),
            on_bad: OnBad::default(),
            status_byte: None,
        };
        let wiring = Wiring {
            plc: Some("plc".to_owned()),
            inputs: vec![
                range(Area::Input, 4, None, 4, "REAL", Some("Level")),
                range(Area::Input, 0, Some(3), 1, "BOOL", None),
            ],
            outputs: vec![range(Area::Output, 1, None, 1, "USINT", Some("Lamps"))],
            ..Wiring::default()
        };
        let service = |name: &str, kind: &str, index, config, wiring| ServiceEntry {
            name: name.to_owned(),
            kind: kind.to_owned(),
            index,
            config,
            wiring,
        };
        Stack {
            name: "s".to_owned(),
            file: "s.toml".into(),
            dir: ".".into(),
            text: String::new(),
            build_id: String::new(),
            root: "/".into(),
            prefix: String::new(),
            services: vec![
                service("plc", "plc", 1, json!({}), Wiring::default()),
                service("io", "can-io", 2, Value::Null, wiring),
            ],
            topics: Vec::new(),
        }
    }

    #[test]
    fn assignments_are_taken_apart() {
        for (text, var, value) in [
            ("x=1", "x", json!(1)),
            ("Main.Limit = -2.5", "Main.Limit", json!(-2.5)),
            ("%QX0.3=true", "%QX0.3", json!(true)),
            ("Delay := T#5s", "Delay", json!("T#5s")),
            ("Name='a=b'", "Name", json!("'a=b'")),
            ("w=16#FF", "w", json!("16#FF")),
        ] {
            assert_eq!(assignment(text).unwrap(), (var.to_owned(), value), "{text}");
        }
        for text in ["x", "=1", "x=", " = "] {
            let message = assignment(text).unwrap_err().to_string();
            assert!(message.contains("write VAR=VALUE"), "{message}");
        }
    }

    #[test]
    fn answers_are_readable() {
        assert_eq!(text_of(&json!({ "do": "stop" }), &json!(true)), "done");
        let job = json!({ "do": "unforce", "var": "x" });
        assert_eq!(text_of(&job, &Value::Bool(true)), "x: done");
        assert_eq!(text_of(&json!({ "do": "load" }), &json!({ "start": "warm" })), "start: warm");
    }
}
