//! The process: ports on the rail, transports, the loop.
//!
//! One thread, one current-thread tokio runtime; connections are tasks on it ([`super::link`]). What is exact in time
//! comes from a timerfd ([`super::alarm`]) and from the serial driver's stamps.

mod jobs;
mod news;
mod outputs;
mod runner;
mod status;

use self::jobs::Asker;
use self::runner::{Place, Runner, Transport, Use, batch_done, exception_of, runner};
use super::alarm::Alarm;
use super::config::{Config, MAX_READS};
use super::image::{InputTable, WriteTable};
use super::line::{Origin, SlotKind, Step};
use super::link::{Report, Reports};
use super::plan::{Plan, plan};
use super::port::Incoming;
use super::wiring::plc_of;
pub use crate::process::RunError;
use crate::process::{Wake, Wakes, run_here};
use ipc_types::event::Budget;
use ipc_types::inputs::InputsPort;
use ipc_types::outputs::{Guard, OutputImage};
use ipc_types::payload::{HealthState, Inputs, Job, JobResult, Quality};
use ipc_types::port::{Publisher, Subscriber};
use ipc_types::topic::TopicKind;
use ipc_types::turns::STATUS_BEATS;
use ipc_types::{Context, clock};
use std::collections::HashMap;
use tokio::sync::mpsc;

/// Kind of the service in stack files.
pub const KIND: &str = "modbus-client";
/// Events a second about ranges and units that go to the rail.
const EVENTS_A_SECOND: u32 = 20;
/// Units shown in the status.
const STATUS_UNITS: usize = 48;

struct Service {
    ctx: Context,
    config: Config,
    reads: Vec<String>,
    /// Line and unit of each read.
    read_units: Vec<(usize, u8)>,
    /// What was last told of the quality of each read.
    told: Vec<Quality>,
    state: HealthState,
    runners: Vec<Runner>,
    inputs: InputTable,
    writes: WriteTable,
    /// Line and slot of each write.
    write_slots: Vec<(usize, usize)>,
    image: OutputImage,
    published: InputsPort,
    jobs: Subscriber<Job>,
    results: Publisher<JobResult>,
    askers: HashMap<u64, Asker>,
    next_job: u64,
    jobs_done: u64,
    jobs_failed: u64,
    fresh: bool,
    events: Budget,
}

/// Runs until the launcher says stop.
pub fn run(ctx: Context) -> Result<(), RunError> {
    run_here(serve(ctx), RunError::system(KIND, "starting the runtime"))
}

async fn serve(mut ctx: Context) -> Result<(), RunError> {
    let (reports_in, mut reports) = mpsc::unbounded_channel();
    let mut wakes = Wakes::new(KIND, &mut ctx)?;
    let mut alarm = Alarm::new().map_err(RunError::system(KIND, "making a clock"))?;
    let mut service = Service::new(ctx, &reports_in)?;
    // Tells the plc that its inputs have no data yet, so that its first scan need not wait.
    service.publish(true);
    service.status();
    service.ctx.ready();
    let mut beats = 0u32;
    loop {
        tokio::select! {
            biased;
            wake = wakes.next() => match wake? {
                Wake::Shutdown => return Ok(()),
                Wake::Beat => {
                    beats += 1;
                    service.beat(beats);
                }
                Wake::Rail => {}
            },
            Some((line, seq, report)) = reports.recv() => service.report(line, seq, report),
            rang = alarm.rang() => rang.map_err(RunError::system(KIND, "reading a clock"))?,
        }
        let next_ns = service.turn();
        alarm.set(next_ns).map_err(RunError::system(KIND, "setting a clock"))?;
    }
}

impl Service {
    fn new(mut ctx: Context, reports: &Reports) -> Result<Self, RunError> {
        let config: Config = ctx.config()?;
        let name = ctx.service.clone();
        let wiring = ctx.entry().map(|entry| entry.wiring.clone()).unwrap_or_default();
        let (_, addressing) = plc_of(&ctx.stack, &wiring);
        let Plan { lines, reads, writes, mistakes } = plan(&config, addressing);
        if let Some(mistake) = mistakes.into_iter().next() {
            return Err(RunError::Config { kind: KIND, key: mistake.key, message: mistake.message });
        }
        let mut runners = Vec::with_capacity(lines.len());
        for (i, line) in lines.into_iter().enumerate() {
            runners.push(runner(&mut ctx, &config, i, line, reports)?);
        }
        let mut write_slots = Vec::with_capacity(writes.len());
        for write in &writes {
            let runner = &mut runners[write.line];
            write_slots.push((write.line, runner.line.add_slot(write.unit, SlotKind::Write, &[], None)));
            runner.uses.push(Use::Write);
            runner.places.push(Place::new(write.table, write.at, write.count));
        }
        let image = match (&wiring.plc, writes.is_empty()) {
            (Some(plc), false) => Some(ctx.subscriber(&TopicKind::Image.of(plc))?),
            _ => None,
        };
        let image = OutputImage::new(image, Guard::new(config.stale_after, &config.safe_on));
        let published =
            if reads.is_empty() { None } else { Some(ctx.publisher(&TopicKind::Inputs.of(&name))?) };
        let published = InputsPort::new(published);
        let jobs = ctx.subscriber(&TopicKind::Jobs.of(&name))?;
        let results = ctx.publisher(&TopicKind::Results.of(&name))?;
        let labels = reads.iter().map(|read| {
            let read = &config.reads[read.index];
            read.symbol.clone().unwrap_or_else(|| read.to.clone())
        });
        let labels: Vec<String> = labels.take(MAX_READS).collect();
        let told = vec![Quality::NoData; labels.len()];
        let read_units = reads.iter().map(|read| (read.line, read.unit)).collect();
        let (inputs, writes) = (InputTable::new(&reads), WriteTable::new(&writes));
        Ok(Self {
            ctx,
            config,
            reads: labels,
            read_units,
            told,
            state: HealthState::Ready,
            runners,
            inputs,
            writes,
            write_slots,
            image,
            published,
            jobs,
            results,
            askers: HashMap::new(),
            next_job: 1,
            jobs_done: 0,
            jobs_failed: 0,
            fresh: false,
            events: Budget::new(EVENTS_A_SECOND),
        })
    }

    /// Takes what came, does what is due; when to come again.
    fn turn(&mut self) -> Option<u64> {
        let mut more = self.take_serial();
        self.take_image();
        more |= self.take_jobs();
        let now_ns = clock::mono_ns();
        let change = self.image.on_time(now_ns);
        self.follow(change);
        let mut next_ns = self.writes_due(now_ns);
        for line in 0..self.runners.len() {
            next_ns = next_ns.into_iter().chain(self.pump(line)).min();
        }
        let checked_ns = self.inputs.check(clock::mono_ns());
        if self.inputs.has_changes() {
            self.fresh = true;
            self.tell_quality();
        }
        if std::mem::take(&mut self.fresh) {
            self.publish(true);
        }
        let stale_ns = self.image.next_deadline();
        if more { Some(1) } else { next_ns.into_iter().chain(checked_ns).chain(stale_ns).min() }
    }

    /// Frames of serial lines; true when more wait.
    fn take_serial(&mut self) -> bool {
        let mut more = false;
        for i in 0..self.runners.len() {
            let runner = &mut self.runners[i];
            let Transport::Serial(port) = &mut runner.transport else { continue };
            let line = &mut runner.line;
            // Whether the last request has left.
            let mut left = None;
            more |= !port.drain(|incoming| match incoming {
                Incoming::Sent { t_ns } => {
                    left = Some(true);
                    line.sent(t_ns);
                }
                Incoming::NotSent => {
                    left = Some(false);
                    line.link_failed(clock::mono_ns());
                }
                Incoming::Frame { unit, pdu, t_ns } => line.answer(unit, pdu, t_ns),
                Incoming::Garbage => line.garbage(),
            });
            match left {
                Some(true) => self.link_works(i),
                Some(false) => self.link_trouble(i, "the serial port does not work; see its status"),
                None => {}
            }
        }
        more
    }

    /// What a connection tells.
    fn report(&mut self, line: usize, seq: u64, report: Report) {
        let Some(runner) = self.runners.get_mut(line) else { return };
        // About a request that was given up meanwhile: it would be taken for the answer to the next one.
        if matches!(&runner.transport, Transport::Tcp(link) if !link.is_current(seq)) {
            return;
        }
        let now_ns = clock::mono_ns();
        match report {
            Report::Connected { anew } => {
                runner.connected = true;
                self.link_works(line);
                self.runners[line].rewrite.wanted |= anew;
                self.rewrite(line, now_ns);
            }
            Report::Sent => runner.line.sent(now_ns),
            Report::Answer { unit, pdu } => runner.line.answer(unit, &pdu, now_ns),
            Report::Garbage => runner.line.garbage(),
            Report::Failed(why) => {
                runner.connected = false;
                runner.line.link_failed(now_ns);
                self.link_trouble(line, &why);
            }
        }
    }

    /// Lets a line do what it wants to; when to come again.
    fn pump(&mut self, line: usize) -> Option<u64> {
        loop {
            let now_ns = clock::mono_ns();
            let Runner { line: core, transport, uses, plan, connected, .. } = &mut self.runners[line];
            match core.step(now_ns) {
                Step::Wait(until) => return until,
                Step::Reset => {
                    *connected = false;
                    if let Transport::Tcp(link) = transport {
                        link.reset();
                    }
                }
                Step::Send { unit, pdu, .. } => match transport {
                    Transport::Tcp(link) => link.send(unit, pdu),
                    Transport::Serial(port) => {
                        if let Err(e) = port.send(unit, pdu, now_ns) {
                            core.link_failed(now_ns);
                            self.link_trouble(line, &e.to_string());
                        }
                    }
                },
                Step::Done { origin: Origin::Slot(slot), unit, result } => {
                    let (lost, refused) = (result.err(), result.ok().and_then(exception_of));
                    let mut split = false;
                    if let Some(Use::Batch(batch)) = uses.get(slot).copied() {
                        split = batch_done(&plan.batches[batch], result, &mut self.inputs, now_ns);
                        self.fresh = true;
                        if split {
                            self.split(line, batch, now_ns);
                        }
                    }
                    if lost.is_none() && !split {
                        self.refusal(line, slot, unit, refused);
                    }
                    self.line_news(line, lost, now_ns);
                }
                Step::Done { origin: Origin::Job(id), result, .. } => {
                    let result = result.map(<[u8]>::to_vec);
                    let lost = result.as_ref().err().copied();
                    self.job_done(id, result);
                    self.line_news(line, lost, now_ns);
                }
            }
        }
    }

    /// `fresh`: news, so the plc is woken; otherwise a repetition.
    fn publish(&mut self, fresh: bool) {
        let ranges = self.reads.len() as u32;
        let header = Inputs { data_t_ns: self.inputs.data_t_ns(), ranges, ..Inputs::default() };
        self.published.publish(header, self.inputs.tail(), fresh);
    }

    fn beat(&mut self, beats: u32) {
        self.ctx.beat();
        let now_ns = clock::mono_ns();
        if self.published.is_due(now_ns) {
            self.publish(false);
        }
        for line in 0..self.runners.len() {
            self.rewrite(line, now_ns);
        }
        let state = if self.is_degraded() { HealthState::Degraded } else { HealthState::Ready };
        if std::mem::replace(&mut self.state, state) != state {
            self.ctx.set_state(state);
        }
        if beats.is_multiple_of(STATUS_BEATS) {
            self.status();
        }
    }
}
