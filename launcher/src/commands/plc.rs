//! `dinrail plc`: jobs for a PLC of a running stack.

use super::plc_write::{check_all, force, write};
use super::{UsageError, println};
use crate::cli::PlcCommand;
use crate::supervise::client::{find, observe};
use crate::supervise::jobs::{JobLine, choose};
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
    let mut jobs = jobs_of(&command);
    let assignments = match &command {
        PlcCommand::Write { assignments } | PlcCommand::Force { assignments } => {
            assignments.iter().map(|text| assignment(text)).collect::<Result<Vec<_>, _>>()?
        }
        _ => Vec::new(),
    };
    let running = find(stack)?;
    let mut ctx = observe(&running)?;
    for job in &mut jobs {
        name_as_stack_does(job, &ctx.stack.dir);
    }
    let plc = choose(&ctx, "plc", service)?;
    let mut line = JobLine::open(&mut ctx, running, "plc", &plc)?;
    let is_write = matches!(command, PlcCommand::Write { .. });
    if !assignments.is_empty() {
        let what = if is_write { "written" } else { "forced" };
        let known = check_all(&ctx.stack, &mut line, &plc, &assignments, what)?;
        if is_write {
            return write(&mut ctx, &mut line, &plc, &assignments, known, json);
        }
        return force(&mut line, &assignments, json);
    }
    for job in jobs {
        let answer = line.ask(&job, LIMIT)?;
        if json {
            println(&answer.to_string());
        } else {
            println(&text_of(&job, &answer));
        }
    }
    Ok(())
}

/// The jobs of a command, in order.
fn jobs_of(command: &PlcCommand) -> Vec<Value> {
    let plain = |what: &str| vec![json!({ "do": what })];
    let each =
        |what: &str, list: &[String]| list.iter().map(|var| json!({ "do": what, "var": var })).collect();
    match command {
        PlcCommand::Status => plain("status"),
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
        // See `plc_write`.
        PlcCommand::Write { .. } | PlcCommand::Force { .. } => Vec::new(),
        PlcCommand::Unforce { all: true, .. } => plain("unforce_all"),
        PlcCommand::Unforce { variables, .. } => each("unforce", variables),
        PlcCommand::Read { variables } => each("read", variables),
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
        (Some(var), Value::Object(map)) if map.contains_key("value") => {
            format!("{var} = {}", plain(&map["value"]))
        }
        (Some(var), Value::Null | Value::Bool(_)) => format!("{var}: done"),
        (Some(var), value) if !value.is_object() => format!("{var} = {}", plain(value)),
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
        let job = json!({ "do": "read", "var": "x" });
        assert_eq!(text_of(&job, &json!({ "value": true, "type": "BOOL" })), "x = TRUE");
        assert_eq!(text_of(&json!({ "do": "stop" }), &json!(true)), "done");
        let job = json!({ "do": "unforce", "var": "x" });
        assert_eq!(text_of(&job, &Value::Bool(true)), "x: done");
        assert_eq!(
            text_of(&json!({ "do": "status" }), &json!({ "state": "run", "scans": 7 })),
            "scans: 7\nstate: run"
        );
    }
}
