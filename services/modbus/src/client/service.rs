//! The process: ports on the rail, transports, the loop.
//!
//! One thread, one current-thread tokio runtime; connections are tasks on it ([`super::link`]). What is exact in time
//! comes from a timerfd ([`super::alarm`]) and from the serial driver's stamps.

mod jobs;
mod status;

use self::jobs::Asker;
use super::alarm::Alarm;
use super::config::{Config, MAX_READS, SafeOn};
use super::image::{InputTable, WriteTable, read_request};
use super::line::{Failure, Line, Origin, Settings, SlotKind, Step, UnitSettings, UnitState};
use super::link::{Link, Report, Reports};
use super::plan::{Batch, LinePlan, Plan, Target, plan};
use super::port::{Incoming, SEND_LIMIT_NS, SerialPort};
use super::wiring::plc_of;
use crate::readable;
use ipc_types::event::{EventKind, Level};
use ipc_types::payload::{Image, Inputs, Job, JobResult, PlcState, Quality};
use ipc_types::port::{Publisher, Subscriber};
use ipc_types::rail::RailError;
use ipc_types::topic::TopicKind;
use ipc_types::{Context, clock};
use serde::Serialize;
use serde_json::{Value, json};
use std::collections::HashMap;
use std::io;
use std::time::Duration;
use tokio::sync::mpsc;
use tokio::time::MissedTickBehavior;

/// Heartbeat; the launcher wants one every 100 ms.
const BEAT: Duration = Duration::from_millis(50);
/// Beats from one status to the next: one second.
const STATUS_BEATS: u32 = 20;
/// The inputs are repeated at least this often, so that a plc that comes late gets them.
const REPEAT_NS: u64 = 90_000_000;
/// Events a second about ranges and units that go to the rail.
const EVENTS_A_SECOND: u32 = 20;
/// Units shown in the status.
const STATUS_UNITS: usize = 48;

/// Why the service ended.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    #[error(transparent)]
    Rail(#[from] RailError),
    #[error("modbus-client: {what}: {source}")]
    System { what: &'static str, source: io::Error },
    #[error("modbus-client: {key}: {message}; run `dinrail check`")]
    Config { key: String, message: String },
}

fn system(what: &'static str) -> impl Fn(io::Error) -> RunError {
    move |source| RunError::System { what, source }
}

enum Transport {
    Serial(Box<SerialPort>),
    Tcp(Link),
}

/// What a slot of a line is for.
#[derive(Clone, Copy)]
enum Use {
    Batch(usize),
    Write,
}

struct Runner {
    plan: LinePlan,
    line: Line,
    transport: Transport,
    uses: Vec<Use>,
    /// Slot of each batch.
    batch_slots: Vec<usize>,
    /// Units that were dead when last looked at.
    dead: Vec<u8>,
    /// Why the link does not work; `None`: it does, or was not needed.
    trouble: Option<String>,
    connected: bool,
}

/// Why nothing is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum Unsafe {
    /// No image of a running program yet.
    Waiting,
    Stale,
    Stop,
    Fault,
    Halted,
}

impl Unsafe {
    fn text(self) -> &'static str {
        match self {
            Self::Waiting => "the PLC has not finished a scan yet",
            Self::Stale => "the image of the PLC is stale: it is dead, hung or too slow",
            Self::Stop => "the PLC is stopped",
            Self::Fault => "the program of the PLC faulted",
            Self::Halted => "the PLC is halted at a breakpoint",
        }
    }
}

/// What an image asks of the writes; `None`: follow it.
pub(super) fn judge(state: PlcState, scan: u64, safe_on: &[SafeOn]) -> Option<Unsafe> {
    let asked = |on, why| safe_on.contains(&on).then_some(why);
    match state {
        _ if scan == 0 => Some(Unsafe::Waiting),
        PlcState::Starting => Some(Unsafe::Waiting),
        PlcState::Run => None,
        PlcState::Stop => asked(SafeOn::Stop, Unsafe::Stop),
        PlcState::Fault => asked(SafeOn::Fault, Unsafe::Fault),
        PlcState::Halted => asked(SafeOn::Halted, Unsafe::Halted),
    }
}

struct Service {
    ctx: Context,
    config: Config,
    reads: Vec<String>,
    /// Line and unit of each read.
    read_units: Vec<(usize, u8)>,
    runners: Vec<Runner>,
    inputs: InputTable,
    writes: WriteTable,
    /// Line and slot of each write.
    write_slots: Vec<(usize, usize)>,
    image: Option<Subscriber<Image>>,
    published: Option<Publisher<Inputs>>,
    published_ns: u64,
    image_ns: u64,
    jobs: Subscriber<Job>,
    results: Publisher<JobResult>,
    askers: HashMap<u64, Asker>,
    next_job: u64,
    jobs_done: u64,
    jobs_failed: u64,
    safe: Option<Unsafe>,
    safe_told: bool,
    fresh: bool,
    event_budget: u32,
    events_left_out: u32,
}

/// Runs until the launcher says stop.
pub fn run(ctx: Context) -> Result<(), RunError> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_io()
        .enable_time()
        .build()
        .map_err(system("starting the runtime"))?;
    tokio::task::LocalSet::new().block_on(&runtime, serve(ctx))
}

async fn serve(mut ctx: Context) -> Result<(), RunError> {
    let (reports_in, mut reports) = mpsc::unbounded_channel();
    let mut inbox = ctx.inbox()?;
    let inbox_fd = inbox.fd().try_clone_to_owned().map_err(system("duplicating the inbox"))?;
    let inbox_fd = readable::watch(inbox_fd).map_err(system("watching the inbox"))?;
    let shutdown = ctx.shutdown_fd().try_clone_to_owned().map_err(system("duplicating a descriptor"))?;
    let shutdown = readable::watch(shutdown).map_err(system("watching the shutdown descriptor"))?;
    let mut alarm = Alarm::new().map_err(system("making a clock"))?;
    let mut service = Service::prepare(&mut ctx, &reports_in)?.with(ctx);
    // Tells the plc that its inputs have no data yet, so that its first scan need not wait.
    service.publish(true);
    service.status();
    service.ctx.ready();
    let mut beat = tokio::time::interval(BEAT);
    beat.set_missed_tick_behavior(MissedTickBehavior::Skip);
    let mut beats = 0u32;
    loop {
        tokio::select! {
            biased;
            _ = shutdown.readable() => return Ok(()),
            _ = beat.tick() => {
                beats += 1;
                service.beat(beats);
            }
            Some((line, seq, report)) = reports.recv() => service.report(line, seq, report),
            ready = inbox_fd.readable() => {
                // First cleared, then drained: what rings in between is an edge again.
                ready.map_err(system("waiting for the rail"))?.clear_ready();
                inbox.drain();
            }
            rang = alarm.rang() => rang.map_err(system("reading a clock"))?,
        }
        let next_ns = service.turn();
        alarm.set(next_ns).map_err(system("setting a clock"))?;
    }
}

/// A service without its context, which opens ports while it is made.
struct Half(Box<dyn FnOnce(Context) -> Service>);

impl Half {
    fn with(self, ctx: Context) -> Service {
        (self.0)(ctx)
    }
}

impl Service {
    fn prepare(ctx: &mut Context, reports: &Reports) -> Result<Half, RunError> {
        let config: Config = ctx.config()?;
        let name = ctx.service.clone();
        let wiring = ctx.entry().map(|entry| entry.wiring.clone()).unwrap_or_default();
        let (_, addressing) = plc_of(&ctx.stack, &wiring);
        let Plan { lines, reads, writes, mistakes } = plan(&config, addressing);
        if let Some(mistake) = mistakes.into_iter().next() {
            return Err(RunError::Config { key: mistake.key, message: mistake.message });
        }
        let mut runners = Vec::with_capacity(lines.len());
        for (i, line) in lines.into_iter().enumerate() {
            runners.push(runner(ctx, &config, i, line, reports)?);
        }
        let now_ns = clock::mono_ns();
        let mut write_slots = Vec::with_capacity(writes.len());
        for write in &writes {
            let runner = &mut runners[write.line];
            write_slots.push((write.line, runner.line.add_slot(write.unit, SlotKind::Write, &[], None)));
            runner.uses.push(Use::Write);
        }
        let image = match (&wiring.plc, writes.is_empty()) {
            (Some(plc), false) => Some(ctx.subscriber(&TopicKind::Image.of(plc))?),
            _ => None,
        };
        let published =
            if reads.is_empty() { None } else { Some(ctx.publisher(&TopicKind::Inputs.of(&name))?) };
        let jobs = ctx.subscriber(&TopicKind::Jobs.of(&name))?;
        let results = ctx.publisher(&TopicKind::Results.of(&name))?;
        let labels = reads.iter().map(|read| {
            let read = &config.reads[read.index];
            read.symbol.clone().unwrap_or_else(|| read.to.clone())
        });
        let labels: Vec<String> = labels.take(MAX_READS).collect();
        let read_units = reads.iter().map(|read| (read.line, read.unit)).collect();
        let (inputs, writes) = (InputTable::new(&reads), WriteTable::new(&writes));
        Ok(Half(Box::new(move |ctx| Self {
            ctx,
            config,
            reads: labels,
            read_units,
            runners,
            inputs,
            writes,
            write_slots,
            image,
            published,
            published_ns: 0,
            image_ns: now_ns,
            jobs,
            results,
            askers: HashMap::new(),
            next_job: 1,
            jobs_done: 0,
            jobs_failed: 0,
            safe: Some(Unsafe::Waiting),
            safe_told: false,
            fresh: false,
            event_budget: EVENTS_A_SECOND,
            events_left_out: 0,
        })))
    }

    /// Takes what came, does what is due; when to come again.
    fn turn(&mut self) -> Option<u64> {
        let mut more = self.take_serial();
        self.take_image();
        more |= self.take_jobs();
        let now_ns = clock::mono_ns();
        if self.image.is_some()
            && self.safe.is_none()
            && now_ns.saturating_sub(self.image_ns) > self.config.stale_after.ns()
        {
            self.set_safe(Some(Unsafe::Stale), now_ns);
        }
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
        let stale_ns = (self.image.is_some() && self.safe.is_none())
            .then(|| self.image_ns.saturating_add(self.config.stale_after.ns()) + 1);
        if more { Some(1) } else { next_ns.into_iter().chain(checked_ns).chain(stale_ns).min() }
    }

    /// Frames of serial lines; true when more wait.
    fn take_serial(&mut self) -> bool {
        let mut more = false;
        for runner in &mut self.runners {
            let Transport::Serial(port) = &mut runner.transport else { continue };
            let (line, trouble) = (&mut runner.line, &mut runner.trouble);
            more |= !port.drain(|incoming| match incoming {
                Incoming::Sent { t_ns } => {
                    *trouble = None;
                    line.sent(t_ns);
                }
                Incoming::NotSent => {
                    *trouble = Some("the serial port does not work; see its status".to_owned());
                    line.link_failed(clock::mono_ns());
                }
                Incoming::Frame { unit, pdu, t_ns } => line.answer(unit, pdu, t_ns),
                Incoming::Garbage => line.garbage(),
            });
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
            Report::Connected => {
                runner.connected = true;
                if runner.trouble.take().is_some() {
                    let message = format!("connected to {} again", runner.plan.target);
                    self.tell(EventKind::BusState, Level::Info, message);
                }
            }
            Report::Sent => runner.line.sent(now_ns),
            Report::Answer { unit, pdu } => runner.line.answer(unit, &pdu, now_ns),
            Report::Garbage => runner.line.garbage(),
            Report::Failed(why) => {
                runner.connected = false;
                runner.line.link_failed(now_ns);
                if runner.trouble.replace(why.clone()).is_none() {
                    self.tell(EventKind::BusState, Level::Warning, why);
                }
            }
        }
    }

    /// Lets a line do what it wants to; when to come again.
    fn pump(&mut self, line: usize) -> Option<u64> {
        loop {
            let now_ns = clock::mono_ns();
            let Runner { line: core, transport, uses, plan, trouble, connected, .. } =
                &mut self.runners[line];
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
                            *trouble = Some(e.to_string());
                            core.link_failed(now_ns);
                        }
                    }
                },
                Step::Done { origin: Origin::Slot(slot), unit, result } => {
                    let answered = result.is_ok();
                    let lost = result.err();
                    if let Some(Use::Batch(batch)) = uses.get(slot).copied() {
                        let split = batch_done(&plan.batches[batch], result, &mut self.inputs, now_ns);
                        self.fresh = true;
                        if split {
                            self.split(line, batch, now_ns);
                        }
                    }
                    self.unit_news(line, unit, answered, lost, now_ns);
                }
                Step::Done { origin: Origin::Job(id), unit, result } => {
                    let result = result.map(<[u8]>::to_vec);
                    let (answered, lost) = (result.is_ok(), result.as_ref().err().copied());
                    self.job_done(id, result);
                    self.unit_news(line, unit, answered, lost, now_ns);
                }
            }
        }
    }

    /// A request put together of several ranges was refused: from now on they are read one by one.
    fn split(&mut self, line: usize, batch: usize, now_ns: u64) {
        let Runner { line: core, plan, batch_slots, .. } = &mut self.runners[line];
        let Batch { unit, table, at, count, ref alone, .. } = plan.batches[batch];
        tracing::warn!(
            "unit {unit} on {} refuses {} {at} + {count} in one request; its ranges are read one by one from now on",
            plan.target,
            table.name()
        );
        core.enable(batch_slots[batch], false, now_ns);
        for &single in alone {
            core.enable(batch_slots[single], true, now_ns);
        }
    }

    /// Follows units that go and come back.
    fn unit_news(&mut self, line: usize, unit: u8, answered: bool, lost: Option<Failure>, now_ns: u64) {
        if lost == Some(Failure::Link) {
            for (read, at) in self.read_units.iter().enumerate() {
                if at.0 == line {
                    self.inputs.failed(read);
                }
            }
        }
        let runner = &mut self.runners[line];
        let is_dead = runner.line.unit_state(unit) == UnitState::Dead;
        let was_dead = runner.dead.contains(&unit);
        if is_dead && !was_dead {
            runner.dead.push(unit);
            for (read, at) in self.read_units.iter().enumerate() {
                if *at == (line, unit) {
                    self.inputs.failed(read);
                }
            }
            let message =
                format!("{} does not answer; it is tried again from time to time", self.name_of(line, unit));
            self.tell(EventKind::BusState, Level::Warning, message);
        } else if was_dead && answered {
            self.runners[line].dead.retain(|&d| d != unit);
            let message = format!("{} answers again", self.name_of(line, unit));
            self.tell(EventKind::BusState, Level::Info, message);
            // It may have been switched off: it gets its values again.
            let Self { writes, runners, write_slots, .. } = self;
            writes.again(line, unit, now_ns, |i, pdu| set_write(runners, write_slots, i, pdu, now_ns));
        }
    }

    fn name_of(&self, line: usize, unit: u8) -> String {
        let plan = &self.runners[line].plan;
        let name = plan.units.iter().find(|u| u.unit == unit).and_then(|u| u.name.as_deref());
        match name {
            Some(name) => format!("unit {unit} ({name}) on {}", plan.target),
            None => format!("unit {unit} on {}", plan.target),
        }
    }

    fn tell(&mut self, kind: EventKind, level: Level, message: String) {
        if self.event_budget == 0 {
            self.events_left_out += 1;
            return;
        }
        self.event_budget -= 1;
        self.ctx.event(kind, level, message, Value::Null);
    }

    fn tell_quality(&mut self) {
        let changes: Vec<_> = self.inputs.drain_changes().collect();
        for change in changes {
            let (line, unit) = self.read_units[change.read];
            // The unit was told of already.
            if self.runners[line].dead.contains(&unit) || self.runners[line].trouble.is_some() {
                continue;
            }
            let what = &self.reads[change.read];
            let (level, message) = if change.quality == Quality::Good {
                (Level::Info, format!("{what} of {} is good", self.name_of(line, unit)))
            } else {
                (Level::Warning, format!("{what} of {} is stale", self.name_of(line, unit)))
            };
            self.tell(EventKind::InputQuality, level, message);
        }
    }

    fn take_image(&mut self) {
        let Some(port) = &mut self.image else { return };
        let now_ns = clock::mono_ns();
        let Self { writes, runners, write_slots, config, image_ns, .. } = self;
        let mut verdict = None;
        port.newest(|image, tail| {
            let Some((_, q, m)) = image.areas(tail) else { return };
            *image_ns = image.stamp.t_ns;
            let why = judge(image.plc_state(), image.scan, &config.safe_on);
            // One that waited too long in the queue is as good as none.
            let fresh = now_ns.saturating_sub(*image_ns) <= config.stale_after.ns();
            let why = why.or((!fresh).then_some(Unsafe::Stale));
            if why.is_none() {
                writes.image(q, m, now_ns, |i, pdu| set_write(runners, write_slots, i, pdu, now_ns));
            }
            verdict = Some(why);
        });
        if let Some(why) = verdict {
            self.set_safe(why, now_ns);
        }
    }

    fn writes_due(&mut self, now_ns: u64) -> Option<u64> {
        let Self { writes, runners, write_slots, .. } = self;
        writes.due(now_ns, |i, pdu| set_write(runners, write_slots, i, pdu, now_ns))
    }

    fn set_safe(&mut self, why: Option<Unsafe>, now_ns: u64) {
        if self.safe == why {
            return;
        }
        self.safe = why;
        match why {
            Some(why) => {
                let was_running = self.writes.is_running();
                let Self { writes, runners, write_slots, .. } = self;
                writes.safe(|i, pdu| {
                    drop_write(runners, write_slots, i);
                    if let Some(pdu) = pdu {
                        set_write(runners, write_slots, i, pdu, now_ns);
                    }
                });
                if was_running {
                    self.safe_told = true;
                    let message = format!("writes went to their safe state: {}", why.text());
                    self.ctx.event(EventKind::SafeEntered, Level::Fault, message, json!({ "why": why }));
                }
            }
            None if self.safe_told => {
                self.safe_told = false;
                let message = "writes follow the image again";
                self.ctx.event(EventKind::SafeLeft, Level::Info, message, Value::Null);
            }
            None => {}
        }
    }

    /// `fresh`: news, so the plc is woken; otherwise a repetition.
    fn publish(&mut self, fresh: bool) {
        let Some(port) = &mut self.published else { return };
        let ranges = self.reads.len() as u32;
        let header = Inputs { data_t_ns: self.inputs.data_t_ns(), ranges, ..Inputs::default() };
        if let Err(e) = port.send_tail(header, self.inputs.tail()) {
            tracing::warn!("inputs: {e}");
        }
        if fresh {
            port.ring();
        }
        self.published_ns = clock::mono_ns();
    }

    fn beat(&mut self, beats: u32) {
        self.ctx.beat();
        if clock::mono_ns().saturating_sub(self.published_ns) >= REPEAT_NS {
            self.publish(false);
        }
        if beats.is_multiple_of(STATUS_BEATS) {
            self.status();
        }
    }
}

fn set_write(runners: &mut [Runner], slots: &[(usize, usize)], i: usize, pdu: &[u8], now_ns: u64) {
    if let Some(&(line, slot)) = slots.get(i) {
        runners[line].line.set_write(slot, pdu, now_ns);
    }
}

fn drop_write(runners: &mut [Runner], slots: &[(usize, usize)], i: usize) {
    if let Some(&(line, slot)) = slots.get(i) {
        runners[line].line.drop_write(slot);
    }
}

/// Puts an answer into the inputs. True: the unit does not like the ranges in one request.
fn batch_done(batch: &Batch, result: Result<&[u8], Failure>, inputs: &mut InputTable, now_ns: u64) -> bool {
    let data = match result {
        Ok(&[code, 2 | 3]) if code & 0x80 != 0 && !batch.alone.is_empty() => return true,
        Ok(&[code, _, ref data @ ..]) if code & 0x80 == 0 => Some(data),
        _ => None,
    };
    for &(read, skip) in &batch.members {
        let taken = data.is_some_and(|data| inputs.data(read, data, skip, now_ns));
        if !taken {
            inputs.failed(read);
        }
    }
    false
}

fn runner(
    ctx: &mut Context,
    config: &Config,
    i: usize,
    plan: LinePlan,
    reports: &Reports,
) -> Result<Runner, RunError> {
    let turnaround_ns = config.turnaround.ns();
    let (settings, transport) = match &plan.target {
        Target::Serial { service, ascii } => {
            let rx = ctx.subscriber(&TopicKind::SerialRx.of(service))?;
            let tx = ctx.publisher(&TopicKind::SerialTx.of(service))?;
            let port = SerialPort::new(tx, rx, *ascii, ctx.writer, ctx.generation);
            let settings =
                Settings { serial: true, turnaround_ns: Some(turnaround_ns), send_limit_ns: SEND_LIMIT_NS };
            (settings, Transport::Serial(Box::new(port)))
        }
        target => {
            let broadcasts = matches!(target, Target::RtuOverTcp(_));
            let settings = Settings {
                serial: false,
                turnaround_ns: broadcasts.then_some(turnaround_ns),
                send_limit_ns: config.connect_timeout.ns() + 1_000_000_000,
            };
            let link = Link::start(i, target, config.connect_timeout.duration(), reports.clone());
            let Some(link) = link else {
                let message = "it is no connection".to_owned();
                return Err(RunError::Config { key: "tcp".to_owned(), message });
            };
            (settings, Transport::Tcp(link))
        }
    };
    let default = UnitSettings {
        response_timeout_ns: config.response_timeout.ns(),
        retries: config.retries,
        probe_min_ns: config.probe_min.ns(),
        probe_max_ns: config.probe_max.ns(),
    };
    let mut line = Line::new(settings, default);
    for unit in &plan.units {
        line.set_unit(unit.unit, unit.settings);
    }
    let (mut uses, mut batch_slots) = (Vec::new(), Vec::new());
    for (b, batch) in plan.batches.iter().enumerate() {
        let pdu = read_request(batch.table, batch.at, batch.count);
        let slot = line.add_slot(batch.unit, SlotKind::Read, &pdu, Some(batch.period_ns));
        if !batch.enabled {
            line.enable(slot, false, 0);
        }
        batch_slots.push(slot);
        uses.push(Use::Batch(b));
    }
    Ok(Runner { plan, line, transport, uses, batch_slots, dead: Vec::new(), trouble: None, connected: false })
}
