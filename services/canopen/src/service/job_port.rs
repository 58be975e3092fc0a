//! Where jobs come from and answers go.

use super::jobs::FAILED;
use ipc_types::Context;
use ipc_types::payload::{Job, JobResult};
use ipc_types::port::{Publisher, Subscriber};
use ipc_types::rail::RailError;
use ipc_types::topic::TopicKind;
use serde_json::{Value, json};

/// Jobs taken from the rail before other work has its turn.
const TAKE_JOBS: usize = 16;

/// Who waits for an answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Asker {
    pub seq: u64,
    pub writer: u32,
    pub generation: u32,
}

/// The end of a job.
#[derive(Debug, Clone, PartialEq)]
pub struct Answer {
    pub to: Asker,
    /// 0 done, 1 failed, 2 late, 3 not supported.
    pub code: u32,
    /// With the key `ok` or `error`.
    pub body: Value,
}

impl Answer {
    pub fn new(to: Asker, result: Result<Value, (u32, String)>) -> Self {
        match result {
            Ok(value) => Self { to, code: 0, body: json!({ "ok": value }) },
            Err((code, text)) => Self { to, code, body: json!({ "error": text }) },
        }
    }
}

/// A job as it comes from the rail.
#[derive(Debug, Clone, Copy)]
pub struct Taken<'a> {
    pub by: Asker,
    pub deadline_ns: u64,
    /// JSON.
    pub text: &'a [u8],
}

/// See the module.
pub struct JobPort {
    jobs: Subscriber<Job>,
    results: Publisher<JobResult>,
}

impl JobPort {
    pub fn open(ctx: &mut Context) -> Result<Self, RailError> {
        let name = ctx.service.clone();
        let jobs = ctx.subscriber(&TopicKind::Jobs.of(&name))?;
        Ok(Self { jobs, results: ctx.publisher(&TopicKind::Results.of(&name))? })
    }

    /// The next few jobs.
    pub fn take(&mut self) -> Vec<(Job, Vec<u8>)> {
        let mut taken = Vec::new();
        self.jobs.drain(TAKE_JOBS, |job, tail| taken.push((*job, tail.to_vec())));
        taken
    }

    pub fn send(&mut self, answer: &Answer) {
        let Asker { seq, writer, generation } = answer.to;
        let header = JobResult {
            job_seq: seq,
            job_writer: writer,
            job_generation: generation,
            code: answer.code,
            ..JobResult::default()
        };
        let text = serde_json::to_vec(&answer.body).unwrap_or_default();
        if let Err(e) = self.results.send_tail(header, &text) {
            tracing::warn!("answer to a job: {e}");
            // Who asked is told rather than left waiting.
            let text =
                format!("{{\"error\":\"the answer of {} bytes does not fit into a result\"}}", text.len());
            let _ = self.results.send_tail(JobResult { code: FAILED, ..header }, text.as_bytes());
        }
        self.results.ring();
    }
}

/// A job of the port, as the desk wants it.
pub fn taken<'a>(job: &Job, text: &'a [u8]) -> Taken<'a> {
    let by = Asker { seq: job.stamp.seq, writer: job.stamp.writer, generation: job.stamp.generation };
    Taken { by, deadline_ns: job.deadline_t_ns, text }
}
