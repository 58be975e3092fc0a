//! Jobs of programs and tools: JSON in, requests of the line, JSON out.

use super::super::ask::{Ask, AskError};
use super::super::line::Failure;
use super::super::plan::{LinePlan, find_unit};
use super::Service;
use ipc_types::clock;
use ipc_types::payload::{JobResult, Stamp};
use serde_json::{Value, json};

/// Jobs taken at a time.
const TAKE_JOBS: usize = 16;
/// A job without a deadline of its own is forgotten after this time.
const JOB_LIMIT_NS: u64 = 60_000_000_000;

/// Who waits for the answer to a job.
pub(super) struct Asker {
    stamp: Stamp,
    ask: Ask,
    line: usize,
}

impl Service {
    /// New jobs; true when more wait.
    pub(super) fn take_jobs(&mut self) -> bool {
        let mut taken = Vec::new();
        let count = self.jobs.drain(TAKE_JOBS, |job, tail| {
            taken.push((job.stamp, job.deadline_t_ns, serde_json::from_slice::<Value>(tail)));
        });
        for (stamp, deadline_ns, job) in taken {
            let now_ns = clock::mono_ns();
            if deadline_ns != 0 && deadline_ns <= now_ns {
                continue;
            }
            let deadline_ns = if deadline_ns == 0 { now_ns + JOB_LIMIT_NS } else { deadline_ns };
            match job {
                Err(e) => self.reply(&stamp, 1, &json!({ "error": format!("the job is no JSON: {e}") })),
                Ok(job) if job.get("do").is_some_and(|what| what == "status") => {
                    let status = serde_json::to_value(self.status_body(4)).unwrap_or_default();
                    self.reply(&stamp, 0, &json!({ "ok": status }));
                }
                Ok(job) => {
                    if let Err((code, text)) = self.begin(&job, stamp, deadline_ns) {
                        self.reply(&stamp, code, &json!({ "error": text }));
                    }
                }
            }
        }
        count == TAKE_JOBS
    }

    fn begin(&mut self, job: &Value, stamp: Stamp, deadline_ns: u64) -> Result<(), (u32, String)> {
        let ask = Ask::from_json(job).map_err(|e| {
            let code = if matches!(e, AskError::Unknown(_)) { 3 } else { 1 };
            (code, e.to_string())
        })?;
        let unit = job.get("unit").cloned().unwrap_or(Value::Null);
        let unit = serde_json::from_value(unit)
            .map_err(|_| (1, "the job lacks \"unit\" (a unit id or the name of a unit)".to_owned()))?;
        let lines: Vec<LinePlan> = self.runners.iter().map(|r| r.plan.clone()).collect();
        let has_own = self.config.serial.is_some() || self.config.tcp.is_some();
        let (line, unit) = find_unit(&lines, &unit, has_own).map_err(|e| (1, e))?;
        let id = self.next_job;
        self.next_job += 1;
        let core = &mut self.runners[line].line;
        core.push_job(id, unit, ask.pdu(), deadline_ns, false).map_err(|e| (1, e.to_string()))?;
        self.askers.insert(id, Asker { stamp, ask, line });
        Ok(())
    }

    pub(super) fn job_done(&mut self, id: u64, result: Result<Vec<u8>, Failure>) {
        let Some(asker) = self.askers.remove(&id) else { return };
        self.jobs_done += 1;
        let runner = &self.runners[asker.line];
        let expired = matches!(result, Err(Failure::Expired));
        let outcome = match result {
            Ok(pdu) => asker.ask.explain(&pdu),
            Err(failure) => Err(match failure {
                Failure::NoAnswer | Failure::UnitDown => format!(
                    "no answer from {}: unit id, wiring, baud rate and parity are the usual causes",
                    runner.plan.target
                ),
                Failure::Link => {
                    runner.trouble.clone().unwrap_or_else(|| "the line does not work".to_owned())
                }
                Failure::Expired => "its turn did not come in time: the line is busy".to_owned(),
                Failure::Mismatch => "the answer belongs to another request".to_owned(),
            }),
        };
        match outcome {
            Ok(value) => self.reply(&asker.stamp, 0, &json!({ "ok": value })),
            Err(text) => {
                self.jobs_failed += 1;
                let code = if expired { 2 } else { 1 };
                self.reply(&asker.stamp, code, &json!({ "error": text }));
            }
        }
    }

    fn reply(&mut self, job: &Stamp, code: u32, body: &Value) {
        let header = JobResult {
            job_seq: job.seq,
            job_writer: job.writer,
            job_generation: job.generation,
            code,
            ..JobResult::default()
        };
        let text = serde_json::to_vec(body).unwrap_or_default();
        let sent = if text.len() > self.results.max_tail() as usize {
            let short = br#"{"error":"the answer is longer than 4096 bytes; ask for less at once"}"#;
            self.results.send_tail(JobResult { code: 1, ..header }, short)
        } else {
            self.results.send_tail(header, &text)
        };
        if let Err(e) = sent {
            tracing::warn!("an answer was not sent: {e}");
        }
        self.results.ring();
    }
}
