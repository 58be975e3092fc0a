//! `dinrail plc`: jobs for a PLC of a running stack.

use super::{UsageError, println};
use crate::cli::PlcCommand;
use crate::supervise::client::{Client, find, observe};
use crate::supervise::control::{Reply, Request, ServiceRow};
use crate::supervise::state_dir::RunningStack;
use ipc_types::payload::{Health, Job, JobResult};
use ipc_types::port::{Publisher, SendError, Subscriber};
use ipc_types::topic::TopicKind;
use ipc_types::{Context, clock};
use serde_json::{Value, json};
use std::path::Path;
use std::time::{Duration, Instant};

/// How long a job may take.
const LIMIT: Duration = Duration::from_secs(5);
const LOOK: Duration = Duration::from_millis(1);
/// The launcher answers at once; it waits for nothing.
const LAUNCHER_LIMIT: Duration = Duration::from_secs(2);
/// So often the launcher is asked whether the plc is still to come back.
const ASK_LAUNCHER: Duration = Duration::from_millis(250);

pub fn run(
    service: Option<&str>,
    stack: Option<&str>,
    command: PlcCommand,
    json: bool,
) -> anyhow::Result<()> {
    let mut jobs = jobs_of(&command)?;
    let running = find(stack)?;
    let mut ctx = observe(&running)?;
    for job in &mut jobs {
        name_as_stack_does(job, &ctx.stack.dir);
    }
    let plc = choose(&ctx, service)?;
    let mut line = Line::open(&mut ctx, running, &plc)?;
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

/// When a job is to be sent. Sans-I/O: a plc that dies takes its unread jobs along, so they are sent again to its
/// successor.
#[derive(Debug, Default)]
struct Sending {
    /// Generation of the plc that got the job.
    to: Option<u32>,
}

impl Sending {
    /// Whether the job must be sent to a plc of this generation.
    fn is_due(&self, generation: u32) -> bool {
        self.to.is_none_or(|to| generation > to)
    }

    fn sent(&mut self, generation: u32) {
        self.to = Some(generation);
    }
}

/// Why no answer can come, from the plc's row of `ps`.
fn hopeless(row: Option<&ServiceRow>) -> Option<String> {
    let row = row?;
    matches!(row.state.as_str(), "held" | "ended" | "stopping").then(|| {
        let way = if row.state == "held" {
            format!("; `dinrail logs {0}` says why, `dinrail restart {0}` starts it again", row.service)
        } else {
            String::new()
        };
        format!("plc '{}' is {}{way}", row.service, row.state)
    })
}

/// The way to a plc service and back. One a process: the numbers of its jobs count up.
struct Line {
    plc: String,
    writer: u32,
    jobs: Publisher<Job>,
    results: Subscriber<JobResult>,
    health: Subscriber<Health>,
    running: RunningStack,
    /// Newest generation of the plc that is known.
    generation: u32,
}

impl Line {
    fn open(ctx: &mut Context, running: RunningStack, plc: &str) -> anyhow::Result<Self> {
        // First the ear, then the mouth: the answer may come at once.
        let results = ctx.subscriber::<JobResult>(&TopicKind::Results.of(plc))?;
        let health = ctx.subscriber::<Health>(&TopicKind::Health.of(plc))?;
        let jobs = ctx.publisher::<Job>(&TopicKind::Jobs.of(plc))?;
        let mut line =
            Self { plc: plc.to_owned(), writer: ctx.writer, jobs, results, health, running, generation: 0 };
        line.ask_launcher()?;
        Ok(line)
    }

    /// Which generation runs now; an error when none will come.
    fn ask_launcher(&mut self) -> anyhow::Result<()> {
        let mut client = Client::connect(self.running.clone())?;
        let Reply::Ps(rows) = client.call(&Request::Ps {}, LAUNCHER_LIMIT)? else {
            anyhow::bail!("the launcher gave another answer than asked for; is it of another version?");
        };
        let row = rows.iter().find(|row| row.service == self.plc);
        if let Some(why) = hopeless(row) {
            anyhow::bail!("{why}");
        }
        self.generation = self.generation.max(row.map_or(0, |row| row.generation));
        Ok(())
    }

    /// Sends a job and waits for its result. A plc that is restarted meanwhile gets it again.
    fn ask(&mut self, job: &Value) -> anyhow::Result<Value> {
        let text = serde_json::to_vec(job)?;
        let (mut sending, mut sent) = (Sending::default(), Vec::new());
        let begin = Instant::now();
        let mut asked_launcher = begin;
        let mut refused = None;
        while begin.elapsed() <= LIMIT {
            let generation = &mut self.generation;
            self.health.newest(|health, _| *generation = (*generation).max(health.stamp.generation));
            if sending.is_due(self.generation) {
                let left = LIMIT.saturating_sub(begin.elapsed());
                let header =
                    Job { deadline_t_ns: clock::mono_ns() + left.as_nanos() as u64, ..Job::default() };
                match self.jobs.send_tail(header, &text) {
                    Ok(seq) => {
                        self.jobs.ring();
                        sending.sent(self.generation);
                        sent.push(seq);
                    }
                    // It starts, or it has much to do: it will read again.
                    Err(e @ (SendError::NoReader(_) | SendError::Full(_))) => refused = Some(e),
                    Err(e) => return Err(e.into()),
                }
            }
            if let Some(answer) = self.answer(&sent) {
                return answer;
            }
            if asked_launcher.elapsed() >= ASK_LAUNCHER {
                asked_launcher = Instant::now();
                self.ask_launcher()?;
            }
            std::thread::sleep(LOOK);
        }
        match refused.filter(|_| sent.is_empty()) {
            Some(refused) => Err(refused.into()),
            None => anyhow::bail!(
                "plc '{}' did not answer within {} s; see `dinrail ps`",
                self.plc,
                LIMIT.as_secs()
            ),
        }
    }

    /// The result of one of these jobs of ours, if it has come.
    fn answer(&mut self, sent: &[u64]) -> Option<anyhow::Result<Value>> {
        let (plc, writer) = (&self.plc, self.writer);
        let mut answer = None;
        self.results.drain(64, |result, tail| {
            if result.job_writer == writer && sent.contains(&result.job_seq) {
                answer = Some((result.code, serde_json::from_slice::<Value>(tail).unwrap_or(Value::Null)));
            }
        });
        Some(match answer? {
            (0, body) => Ok(body.get("ok").cloned().unwrap_or(body)),
            (code, body) => {
                let error = body.get("error").and_then(Value::as_str).unwrap_or(match code {
                    2 => "it came too late",
                    3 => "not supported",
                    _ => "it failed",
                });
                Err(anyhow::anyhow!("plc '{plc}': {error}"))
            }
        })
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
    fn a_job_goes_once_to_each_generation() {
        let mut sending = Sending::default();
        assert!(sending.is_due(1));
        sending.sent(1);
        // A heartbeat of a process before it, from the queue of a dead writer.
        assert!(!sending.is_due(1) && !sending.is_due(0) && sending.is_due(2));
        sending.sent(2);
        assert!(!sending.is_due(2));
    }

    #[test]
    fn a_plc_that_will_not_come_back_is_told_at_once() {
        let mut row = super::super::top::tests::row("plc", "plc");
        assert_eq!(hopeless(Some(&row)), None);
        row.state = "back-off".into();
        assert_eq!(hopeless(Some(&row)), None);
        row.state = "held".into();
        let why = hopeless(Some(&row)).unwrap();
        assert!(why.starts_with("plc 'plc' is held; ") && why.contains("`dinrail restart plc`"), "{why}");
        row.state = "stopping".into();
        assert_eq!(hopeless(Some(&row)).unwrap(), "plc 'plc' is stopping");
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
