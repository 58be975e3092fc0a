//! Jobs for a service of a running stack: sent, sent again to a service that was restarted meanwhile, answered.

use super::client::Client;
use super::control::{Reply, Request, ServiceRow};
use super::state_dir::RunningStack;
use ipc_types::payload::{Health, Job, JobResult};
use ipc_types::port::{Publisher, SendError, Subscriber};
use ipc_types::topic::TopicKind;
use ipc_types::{Context, clock};
use serde_json::Value;
use std::time::{Duration, Instant};

const LOOK: Duration = Duration::from_millis(1);
/// The launcher answers at once: it waits for nothing but the CPU.
const LAUNCHER_LIMIT: Duration = Duration::from_secs(10);
/// So often the launcher is asked whether the service is still to come back.
const ASK_LAUNCHER: Duration = Duration::from_millis(250);

/// Why a job brought nothing.
#[derive(Debug, thiserror::Error)]
pub enum JobError {
    /// The service refused it, or it failed there: its own words, and all it said.
    #[error("{kind} '{service}': {text}")]
    Refused { kind: String, service: String, text: String, body: Value },
    #[error("{kind} '{service}' did not answer within {} s; see `dinrail ps`", limit.as_secs())]
    Silent { kind: String, service: String, limit: Duration },
    #[error("{0}")]
    Other(#[from] anyhow::Error),
}

/// The service meant: the one named, or the only one of its kind.
pub fn choose(ctx: &Context, kind: &str, named: Option<&str>) -> anyhow::Result<String> {
    let list: Vec<&str> =
        ctx.stack.services.iter().filter(|s| s.kind == kind).map(|s| s.name.as_str()).collect();
    choose_of(&ctx.stack.name, kind, &list, named)
}

fn choose_of(stack: &str, kind: &str, list: &[&str], named: Option<&str>) -> anyhow::Result<String> {
    match (named, list) {
        (_, []) => anyhow::bail!("stack '{stack}' has no {kind} service"),
        (Some(name), list) if list.contains(&name) => Ok(name.to_owned()),
        (Some(name), list) => {
            anyhow::bail!("stack '{stack}' has no {kind} service '{name}'; it has {}", list.join(", "))
        }
        (None, [only]) => Ok((*only).to_owned()),
        (None, list) => {
            let option = if kind == "can" { "--bus" } else { "--service" };
            anyhow::bail!("several {kind} services: {}; say which one with {option} NAME", list.join(", "))
        }
    }
}

/// When a job is to be sent. Sans-I/O: a service that dies takes its unread jobs along, so they are sent again to its
/// successor.
#[derive(Debug, Default)]
struct Sending {
    /// Generation of the service that got the job.
    to: Option<u32>,
}

impl Sending {
    /// Whether the job must be sent to a service of this generation.
    fn is_due(&self, generation: u32) -> bool {
        self.to.is_none_or(|to| generation > to)
    }

    fn sent(&mut self, generation: u32) {
        self.to = Some(generation);
    }
}

/// Why no answer can come, from the service's row of `ps`.
fn hopeless(kind: &str, row: Option<&ServiceRow>) -> Option<String> {
    let row = row?;
    matches!(row.state.as_str(), "held" | "ended" | "stopping").then(|| {
        let way = if row.state == "held" {
            format!("; `dinrail logs {0}` says why, `dinrail restart {0}` starts it again", row.service)
        } else {
            String::new()
        };
        format!("{kind} '{}' is {}{way}", row.service, row.state)
    })
}

/// The way to a service and back. One a process: the numbers of its jobs count up.
pub struct JobLine {
    kind: &'static str,
    service: String,
    writer: u32,
    jobs: Publisher<Job>,
    results: Subscriber<JobResult>,
    health: Subscriber<Health>,
    running: RunningStack,
    /// Newest generation of the service that is known.
    generation: u32,
}

impl JobLine {
    pub fn open(
        ctx: &mut Context,
        running: RunningStack,
        kind: &'static str,
        service: &str,
    ) -> anyhow::Result<Self> {
        // First the ear, then the mouth: the answer may come at once.
        let results = ctx.subscriber::<JobResult>(&TopicKind::Results.of(service))?;
        let health = ctx.subscriber::<Health>(&TopicKind::Health.of(service))?;
        let jobs = ctx.publisher::<Job>(&TopicKind::Jobs.of(service))?;
        let service = service.to_owned();
        let mut line =
            Self { kind, service, writer: ctx.writer, jobs, results, health, running, generation: 0 };
        line.ask_launcher()?;
        Ok(line)
    }

    /// Which generation runs now; an error when none will come.
    fn ask_launcher(&mut self) -> anyhow::Result<()> {
        let mut client = Client::connect(self.running.clone())?;
        let Reply::Ps(rows) = client.call(&Request::Ps {}, LAUNCHER_LIMIT)? else {
            anyhow::bail!("the launcher gave another answer than asked for; is it of another version?");
        };
        let row = rows.iter().find(|row| row.service == self.service);
        if let Some(why) = hopeless(self.kind, row) {
            anyhow::bail!("{why}");
        }
        self.generation = self.generation.max(row.map_or(0, |row| row.generation));
        Ok(())
    }

    /// Sends a job and waits for its result. A service that is restarted meanwhile gets it again.
    pub fn ask(&mut self, job: &Value, limit: Duration) -> Result<Value, JobError> {
        let text = serde_json::to_vec(job).map_err(anyhow::Error::from)?;
        let (mut sending, mut sent) = (Sending::default(), Vec::new());
        let begin = Instant::now();
        let mut asked_launcher = begin;
        let mut refused = None;
        while begin.elapsed() <= limit {
            let generation = &mut self.generation;
            self.health.newest(|health, _| *generation = (*generation).max(health.stamp.generation));
            if sending.is_due(self.generation) {
                let left = limit.saturating_sub(begin.elapsed());
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
                    Err(e) => return Err(anyhow::Error::from(e).into()),
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
            Some(refused) => Err(anyhow::Error::from(refused).into()),
            None => {
                Err(JobError::Silent { kind: self.kind.to_owned(), service: self.service.clone(), limit })
            }
        }
    }

    /// The result of one of these jobs of ours, if it has come.
    fn answer(&mut self, sent: &[u64]) -> Option<Result<Value, JobError>> {
        let writer = self.writer;
        let mut answer = None;
        self.results.drain(64, |result, tail| {
            if result.job_writer == writer && sent.contains(&result.job_seq) {
                answer = Some((result.code, serde_json::from_slice::<Value>(tail).unwrap_or(Value::Null)));
            }
        });
        Some(match answer? {
            (0, body) => Ok(body.get("ok").cloned().unwrap_or(body)),
            (code, body) => {
                let text = body.get("error").and_then(Value::as_str).unwrap_or(match code {
                    2 => "it came too late",
                    3 => "not supported",
                    _ => "it failed",
                });
                let text = text.to_owned();
                Err(JobError::Refused {
                    kind: self.kind.to_owned(),
                    service: self.service.clone(),
                    text,
                    body,
                })
            }
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_only_one_is_meant_and_several_are_listed() {
        assert_eq!(choose_of("s", "plc", &["a"], None).unwrap(), "a");
        assert_eq!(choose_of("s", "plc", &["a", "b"], Some("b")).unwrap(), "b");
        let error = |list: &[&str], named| choose_of("s", "plc", list, named).unwrap_err().to_string();
        assert_eq!(error(&[], None), "stack 's' has no plc service");
        assert_eq!(error(&["a", "b"], None), "several plc services: a, b; say which one with --service NAME");
        assert_eq!(error(&["a"], Some("c")), "stack 's' has no plc service 'c'; it has a");
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
        let mut row = ServiceRow {
            service: "plc".into(),
            kind: "plc".into(),
            state: "running".into(),
            health: "ready".into(),
            pid: 4242,
            generation: 1,
            restarts: 0,
            uptime_ms: 0,
            cpu_percent: 0.0,
            rss_bytes: 0,
            deaths: 0,
            unstable: false,
        };
        assert_eq!(hopeless("plc", Some(&row)), None);
        row.state = "back-off".into();
        assert_eq!(hopeless("plc", Some(&row)), None);
        row.state = "held".into();
        let why = hopeless("plc", Some(&row)).unwrap();
        assert!(why.starts_with("plc 'plc' is held; ") && why.contains("`dinrail restart plc`"), "{why}");
        row.state = "stopping".into();
        assert_eq!(hopeless("plc", Some(&row)).unwrap(), "plc 'plc' is stopping");
    }
}
