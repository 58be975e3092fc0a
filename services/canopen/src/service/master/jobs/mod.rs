//! The jobs of the rail: taken, carried out with the network, answered. [`Desk`] knows neither ports nor clocks.

mod emcy;
mod lss;
mod sdo;

use super::book::Book;
use super::{Service, report};
use crate::master::network::Network;
use crate::protocol::io::Outbox;
use crate::service::job_port::{Answer, Asker, Taken, taken};
use crate::service::jobs::{self, FAILED, LATE, Request};
use ipc_types::clock;
use lss::LssAskers;
use sdo::SdoJobs;
use serde_json::{Value, json};
use std::collections::VecDeque;

/// Longest list in a result, in bytes: what is more is asked for by another job.
const LIST_BYTES: usize = 3500;

/// Now, by both clocks.
#[derive(Debug, Clone, Copy)]
pub(super) struct Now {
    pub ns: u64,
    /// UTC at `ns`.
    pub utc_ns: i64,
}

impl Now {
    fn read() -> Self {
        Self { ns: clock::mono_ns(), utc_ns: clock::utc_ns() }
    }

    /// UTC of a moment of the monotonic clock, in ms.
    pub fn utc_ms(self, t_ns: u64) -> i64 {
        let signed = |ns: u64| i64::try_from(ns).unwrap_or(i64::MAX);
        self.utc_ns.saturating_sub(signed(self.ns) - signed(t_ns)) / 1_000_000
    }
}

/// What a job leads to at once: its result, nothing yet, or code and text of a failure.
type Begun = Result<Option<Value>, (u32, String)>;

fn failed(text: impl Into<String>) -> (u32, String) {
    (FAILED, text.into())
}

/// See the module.
pub(super) struct Desk {
    pub book: Book,
    sdo: SdoJobs,
    lss: LssAskers,
    answers: VecDeque<Answer>,
}

impl Desk {
    /// `sdo_timeout_ns`: for nodes that no stack file names.
    pub fn new(book: Book, sdo_timeout_ns: u64) -> Self {
        Self { book, sdo: SdoJobs::new(sdo_timeout_ns), lss: LssAskers::default(), answers: VecDeque::new() }
    }

    /// Takes a job. The state of the service is its own to tell: then the asker is given back.
    pub fn ask(
        &mut self,
        now: Now,
        job: Taken<'_>,
        network: &mut Network,
        out: &mut Outbox,
    ) -> Option<Asker> {
        let by = job.by;
        if job.deadline_ns < now.ns {
            self.answer(by, Err((LATE, "the job is older than its deadline".to_owned())));
            return None;
        }
        let begun = match jobs::parse(job.text) {
            Ok(Request::Status) => return Some(by),
            Ok(request) => self.begin(now, job, request, network, out),
            Err(error) => Err(error),
        };
        match begun {
            Ok(Some(value)) => self.answer(by, Ok(value)),
            Ok(None) => {}
            Err(error) => self.answer(by, Err(error)),
        }
        None
    }

    /// Carries a job out, or begins to.
    fn begin(
        &mut self,
        now: Now,
        job: Taken<'_>,
        request: Request,
        network: &mut Network,
        out: &mut Outbox,
    ) -> Begun {
        let (now_ns, by) = (now.ns, job.by);
        match request {
            Request::Status => Ok(None),
            Request::Nmt { command, node } => {
                if node > 127 {
                    return Err(failed(format!("node-id {node} does not exist; 0 is all nodes")));
                }
                network.nmt(now_ns, command.command(), node, out);
                Ok(Some(json!(true)))
            }
            Request::Boot { node } => {
                if network.boot_again(now_ns, node, out) {
                    Ok(Some(json!(true)))
                } else {
                    Err(failed(format!("the stack file has no node {node}")))
                }
            }
            Request::BootState { node } => boot_state(now, node, &self.book, network),
            Request::Lss(call) => self.lss.ask(by, call, job.deadline_ns, network),
            Request::Emcy { node: Some(node), skip } => emcy::of_node(now, node, skip, &self.book, network),
            Request::Emcy { node: None, skip } => Ok(Some(emcy::of_all(skip, &self.book, network))),
            Request::EmcyClear { node } => emcy::clear(node, network),
            Request::SdoRead(read) => self.sdo.read(now_ns, by, read, &self.book, network, out),
            Request::SdoWrite(write) => self.sdo.write(now_ns, by, write, &self.book, network, out),
        }
    }

    fn answer(&mut self, to: Asker, result: Result<Value, (u32, String)>) {
        self.answers.push_back(Answer::new(to, result));
    }

    /// Collects what has ended meanwhile.
    pub fn collect(&mut self, network: &mut Network) {
        while let Some(end) = network.transfers.take_job_end() {
            self.answers.extend(self.sdo.ended(&end, &self.book));
        }
        while let Some((job, outcome)) = network.lss.take_end() {
            self.answers.extend(self.lss.ended(job, &outcome));
        }
    }

    pub fn take_answer(&mut self) -> Option<Answer> {
        self.answers.pop_front()
    }
}

/// How boot-ups go or went.
fn boot_state(now: Now, node: Option<u8>, book: &Book, network: &Network) -> Begun {
    let all = network.nodes();
    match node {
        Some(id) => {
            let run = all.iter().find(|run| run.id() == id);
            let run = run.ok_or_else(|| failed(format!("the stack file has no node {id}")))?;
            Ok(Some(report::boot(now, run, book)))
        }
        None => Ok(Some(all.iter().map(|run| report::boot(now, run, book)).collect())),
    }
}

impl Service {
    pub(super) fn take_jobs(&mut self) {
        let now = Now::read();
        for (job, text) in self.jobs.take() {
            let job = taken(&job, &text);
            if let Some(by) = self.desk.ask(now, job, &mut self.network, &mut self.out) {
                let status = self.network_status();
                self.desk.answer(by, Ok(status));
            }
        }
        self.send();
    }

    pub(super) fn answer_jobs(&mut self) {
        self.desk.collect(&mut self.network);
        while let Some(answer) = self.desk.take_answer() {
            self.jobs.send(&answer);
        }
    }
}

#[cfg(test)]
mod tests;
