//! `dinrail plc`: jobs for a PLC of a running stack.

use super::{UsageError, println};
use crate::cli::PlcCommand;
use crate::supervise::client::{find, observe};
use ipc_types::payload::{Job, JobResult};
use ipc_types::port::{Publisher, Subscriber};
use ipc_types::topic::TopicKind;
use ipc_types::{Context, clock};
use serde_json::{Value, json};
use std::path::Path;
use std::time::{Duration, Instant};

/// How long a job may take.
const LIMIT: Duration = Duration::from_secs(5);
const LOOK: Duration = Duration::from_millis(1);

pub fn run(
    service: Option<&str>,
    stack: Option<&str>,
    command: PlcCommand,
    json: bool,
) -> anyhow::Result<()> {
    let mut jobs = jobs_of(&command)?;
    let mut ctx = observe(&find(stack)?)?;
    for job in &mut jobs {
        name_as_stack_does(job, &ctx.stack.dir);
    }
    let plc = choose(&ctx, service)?;
    let mut line = Line::open(&mut ctx, &plc)?;
    for job in jobs {
        let answer = line.ask(&job)?;
        if json {
            println(&answer.to_string());
        } else {
            println(&text_of(&job, &answer));
        }
    }
    Ok(())
}

/// The jobs of a command, in order.
fn jobs_of(command: &PlcCommand) -> Result<Vec<Value>, UsageError> {
    let plain = |what: &str| vec![json!({ "do": what })];
    let assign = |what: &str, list: &[String]| -> Result<Vec<Value>, UsageError> {
        let job = |(var, value)| json!({ "do": what, "var": var, "value": value });
        list.iter().map(|text| assignment(text).map(job)).collect()
    };
    let each =
        |what: &str, list: &[String]| list.iter().map(|var| json!({ "do": what, "var": var })).collect();
    Ok(match command {
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
        PlcCommand::Force { assignments } => assign("force", assignments)?,
        PlcCommand::Write { assignments } => assign("write", assignments)?,
        PlcCommand::Unforce { all: true, .. } => plain("unforce_all"),
        PlcCommand::Unforce { variables, .. } => each("unforce", variables),
        PlcCommand::Read { variables } => each("read", variables),
    })
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

/// The plc service meant: the one named, or the only one.
fn choose(ctx: &Context, named: Option<&str>) -> anyhow::Result<String> {
    let list: Vec<&str> =
        ctx.stack.services.iter().filter(|s| s.kind == "plc").map(|s| s.name.as_str()).collect();
    match (named, list.as_slice()) {
        (_, []) => anyhow::bail!("stack '{}' has no plc service", ctx.stack.name),
        (Some(name), list) if list.contains(&name) => Ok(name.to_owned()),
        (Some(name), list) => {
            anyhow::bail!(
                "stack '{}' has no plc service '{name}'; it has {}",
                ctx.stack.name,
                list.join(", ")
            )
        }
        (None, [only]) => Ok((*only).to_owned()),
        (None, list) => {
            anyhow::bail!("several plc services: {}; say which one with --service NAME", list.join(", "))
        }
    }
}

/// The way to a plc service and back. One a process: the numbers of its jobs count up.
struct Line {
    plc: String,
    writer: u32,
    jobs: Publisher<Job>,
    results: Subscriber<JobResult>,
}

impl Line {
    fn open(ctx: &mut Context, plc: &str) -> anyhow::Result<Self> {
        // First the ear, then the mouth: the answer may come at once.
        let results = ctx.subscriber::<JobResult>(&TopicKind::Results.of(plc))?;
        let jobs = ctx.publisher::<Job>(&TopicKind::Jobs.of(plc))?;
        Ok(Self { plc: plc.to_owned(), writer: ctx.writer, jobs, results })
    }

    /// Sends a job and waits for its result.
    fn ask(&mut self, job: &Value) -> anyhow::Result<Value> {
        let plc = &self.plc;
        let header = Job { deadline_t_ns: clock::mono_ns() + LIMIT.as_nanos() as u64, ..Job::default() };
        let seq = self.jobs.send_tail(header, &serde_json::to_vec(job)?)?;
        self.jobs.ring();
        let begin = Instant::now();
        loop {
            let mut answer = None;
            self.results.drain(64, |result, tail| {
                if result.job_seq == seq && result.job_writer == self.writer {
                    answer =
                        Some((result.code, serde_json::from_slice::<Value>(tail).unwrap_or(Value::Null)));
                }
            });
            match answer {
                Some((0, body)) => return Ok(body.get("ok").cloned().unwrap_or(body)),
                Some((code, body)) => {
                    let error = body.get("error").and_then(Value::as_str).unwrap_or(match code {
                        2 => "it came too late",
                        3 => "not supported",
                        _ => "it failed",
                    });
                    anyhow::bail!("plc '{plc}': {error}");
                }
                None if begin.elapsed() > LIMIT => {
                    anyhow::bail!("plc '{plc}' did not answer within {} s; see `dinrail ps`", LIMIT.as_secs())
                }
                None => std::thread::sleep(LOOK),
            }
        }
    }
}

fn text_of(job: &Value, answer: &Value) -> String {
    let var = job.get("var").and_then(Value::as_str);
    match (var, answer) {
        (Some(var), Value::Object(map)) if map.contains_key("value") => {
            format!("{var} = {}", plain(&map["value"]))
        }
        (Some(var), Value::Null | Value::Bool(_)) => match job.get("value") {
            Some(value) => format!("{var} = {}", plain(value)),
            None => format!("{var}: done"),
        },
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
        let job = json!({ "do": "force", "var": "x", "value": 3 });
        assert_eq!(text_of(&job, &Value::Null), "x = 3");
        assert_eq!(
            text_of(&json!({ "do": "status" }), &json!({ "state": "run", "scans": 7 })),
            "scans: 7\nstate: run"
        );
    }
}
