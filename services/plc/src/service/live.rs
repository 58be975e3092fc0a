//! The loop: waits for clock, inputs and commands, runs scans, publishes what came out.

mod asked;
mod keyframes;
mod tell;

use super::acks::Acks;
use super::inputs::InputSource;
use super::jobs::{self, Asker, MAX_ORDERS, Order, Request};
use super::load::Loading;
use super::status::{Counters, ScanTimes, status};
use super::watch::Watch;
use super::{RETAIN_FD, RunError, restart_of};
use crate::config::{Config, DEFAULT_CYCLE, Trigger, TriggerWord};
use crate::engine::{Engine, FaultReport, Runtime, Stamps, write_result};
use crate::retain::{Committer, CopyNews, DiskCopy, MEMORY_BYTES, Mapping, newest, read_file};
use ipc_types::event::{EventBody, EventKind, Level};
use ipc_types::inbox::Inbox;
use ipc_types::payload::{
    Event, HealthState, Image, ImageWrite, Job, JobResult, PlcState, Quality, ScanPart, event_flag,
};
use ipc_types::port::{Publisher, Subscriber};
use ipc_types::rail::RailError;
use ipc_types::reactor::Reactor;
use ipc_types::scan_record::{Content, Reason, Source, Start, flag, part_header, parts};
use ipc_types::topic::{EVENTS, TopicKind};
use ipc_types::{Context, clock};
use serde_json::{Value, json};
use std::os::fd::OwnedFd;
use std::path::PathBuf;
use std::time::Duration;

/// Most writes taken in one scan; the rest waits.
const WRITES_PER_SCAN: usize = 256;
/// Older writes are dropped.
const WRITE_AGE_NS: u64 = 1_000_000_000;
/// Heartbeat, status and repeats hang on this clock.
const TICK: Duration = Duration::from_millis(50);
/// The image is sent again after this time, because a late reader only gets it then.
const REPEAT_NS: u64 = 45_000_000;
const STATUS_NS: u64 = 1_000_000_000;
const KEYFRAME_NS: u64 = 10_000_000_000;
/// An automatic start follows a fault after this time at the earliest.
const RESTART_NS: u64 = 1_000_000_000;
/// Parts of a keyframe that are sent in one turn: what a reader's queue takes at ease.
const PARTS_PER_TURN: usize = 64;
/// Scans are stamped in steps of 256 ns, far below the jitter of any clock that wakes a process: a byte that is
/// always 0 need not be stored five times in every scan record.
const STAMP_NS: u64 = 256;
/// UTC that drifted less is not worth a new offset.
const UTC_STEP_NS: i64 = 50_000;

/// A running service.
pub(super) struct Live {
    pub engine: Engine,
    pub inputs: Vec<InputSource>,
    /// The event that scans wait for, where the trigger is one.
    pub watch: Option<Watch>,
    pub counters: Counters,
    pub shown_times: ScanTimes,
    times: ScanTimes,
    config: Config,
    runtime: Runtime,
    dir: PathBuf,
    root: PathBuf,
    // Ports.
    inbox: Inbox,
    image_port: Publisher<Image>,
    scan_port: Publisher<ScanPart>,
    keyframe_port: Publisher<ScanPart>,
    results: Publisher<JobResult>,
    writes: Subscriber<ImageWrite>,
    jobs: Subscriber<Job>,
    events: Subscriber<Event>,
    // State.
    header: Image,
    acks: Acks,
    orders: Vec<(Source, Order)>,
    replies: Vec<Asker>,
    loading: Option<Loading>,
    /// Next part of the keyframe that is being sent.
    keyframe_next: Option<usize>,
    keyframe_wanted: Option<Reason>,
    keyframe_due_ns: u64,
    retain: Option<(Mapping, Committer)>,
    disk: Option<DiskCopy>,
    /// RETAIN memory and file, for a program with RETAIN that is loaded later.
    disk_place: Option<(OwnedFd, PathBuf)>,
    retain_layout: u64,
    started_ns: u64,
    waiting: bool,
    /// PLC time 0 as CLOCK_MONOTONIC.
    base_ns: i64,
    last_stamp_ns: i64,
    last_scan_ns: u64,
    utc_offset_ns: i64,
    image_sent_ns: u64,
    status_ns: u64,
    beat_ns: u64,
    restart_at_ns: Option<u64>,
    hurry: bool,
}

impl Live {
    /// Opens every port and finds out how to start.
    pub(super) fn open(
        ctx: &mut Context,
        config: Config,
        runtime: Runtime,
        engine: Engine,
    ) -> Result<Self, RunError> {
        let service = ctx.service.clone();
        let rail = |source: RailError| RunError::Rail { service: service.clone(), source };
        let of = |kind: TopicKind| kind.of(&service);
        let now_ns = clock::mono_ns();
        let inputs = InputSource::open_all(ctx).map_err(rail)?;
        let mut live = Self {
            watch: config.trigger.event().and_then(|event| {
                let at = inputs.iter().position(|source| source.name == event.service)?;
                Some(Watch::new(at, config.max_interval.ns()))
            }),
            inputs,
            inbox: ctx.inbox().map_err(rail)?,
            image_port: ctx.publisher(&of(TopicKind::Image)).map_err(rail)?,
            scan_port: ctx.publisher(&of(TopicKind::Scan)).map_err(rail)?,
            keyframe_port: ctx.publisher(&of(TopicKind::Keyframe)).map_err(rail)?,
            results: ctx.publisher(&of(TopicKind::Results)).map_err(rail)?,
            writes: ctx.subscriber(&of(TopicKind::Writes)).map_err(rail)?,
            jobs: ctx.subscriber(&of(TopicKind::Jobs)).map_err(rail)?,
            events: ctx.subscriber(EVENTS).map_err(rail)?,
            counters: Counters::default(),
            shown_times: ScanTimes::default(),
            times: ScanTimes::default(),
            dir: ctx.stack.dir.clone(),
            root: ctx.stack.root.clone(),
            header: header_of(&engine),
            acks: Acks::default(),
            orders: Vec::with_capacity(MAX_ORDERS),
            replies: Vec::with_capacity(MAX_ORDERS),
            loading: None,
            keyframe_next: None,
            keyframe_wanted: Some(Reason::EngineStart),
            keyframe_due_ns: now_ns + KEYFRAME_NS,
            retain: None,
            disk: None,
            disk_place: None,
            retain_layout: engine.retain_layout(),
            started_ns: now_ns,
            waiting: true,
            base_ns: now_ns as i64,
            last_stamp_ns: now_ns as i64,
            last_scan_ns: 0,
            utc_offset_ns: clock::utc_offset_ns(),
            image_sent_ns: 0,
            status_ns: 0,
            beat_ns: 0,
            restart_at_ns: None,
            hurry: false,
            config,
            runtime,
            engine,
        };
        let start = live.open_retain(ctx);
        let me = Source { writer: ctx.writer, generation: ctx.generation, seq: 0 };
        live.orders.push((me, Order::Start(start)));
        live.tell_loaded(ctx);
        Ok(live)
    }

    /// Takes over the RETAIN memory; what is kept decides between warm and cold.
    fn open_retain(&mut self, ctx: &mut Context) -> Start {
        let fd = match ctx.take_fd(RETAIN_FD) {
            Ok(fd) => fd,
            Err(e) => {
                tracing::warn!("{e}: RETAIN variables are not kept");
                return Start::Cold;
            }
        };
        let mapping = match Mapping::new(&fd, MEMORY_BYTES) {
            Ok(mapping) => mapping,
            Err(e) => {
                tracing::warn!("the RETAIN memory cannot be mapped: {e}; RETAIN variables are not kept");
                return Start::Cold;
            }
        };
        let mut kept = newest(mapping.bytes());
        let committer = Committer::new(mapping.bytes());
        self.retain = Some((mapping, committer));
        let path = self.config.retain_file.as_ref().map_or_else(
            || ctx.stack.dir.join(format!("{}.{}.retain", ctx.stack.name, ctx.service)),
            |file| ctx.stack.dir.join(file),
        );
        if kept.is_none() && !self.engine.retain().is_empty() {
            kept = read_file(&path);
        }
        self.disk_place = Some((fd, path));
        self.copy_to_disk();
        let Some(kept) = kept else { return Start::Cold };
        if kept.layout != self.retain_layout || !self.engine.set_retain(&kept.bytes) {
            tracing::warn!("the kept RETAIN variables are of another program: cold start");
            return Start::Cold;
        }
        self.base_ns = self.started_ns as i64 - kept.plc_time_ns;
        Start::Warm
    }

    /// Starts the copies to disk, once the program has RETAIN variables.
    pub(super) fn copy_to_disk(&mut self) {
        if self.disk.is_some() || self.engine.retain().is_empty() {
            return;
        }
        let Some((fd, path)) = &self.disk_place else { return };
        match fd.try_clone().and_then(|fd| DiskCopy::start(fd, path.clone())) {
            Ok(copy) => self.disk = Some(copy),
            Err(e) => tracing::error!("RETAIN variables are not copied to disk: {e}"),
        }
    }

    pub(super) fn retain_failures(&self) -> u64 {
        self.disk.as_ref().map_or(0, DiskCopy::failures)
    }

    /// Leaves the module where the recorder finds it, and says that it is loaded.
    fn tell_loaded(&mut self, ctx: &mut Context) {
        let hash = self.engine.program_hash();
        let mut detail =
            json!({ "program_hash": format!("{hash:016x}"), "files": self.engine.setup().files });
        let Some(program) = self.engine.program().cloned() else {
            ctx.event(EventKind::Loaded, Level::Info, "no program: image and routes only", detail);
            return;
        };
        let path = self.root.join(format!("{}.{hash:016x}.wasm", ctx.service));
        match std::fs::write(&path, &program.artifact.wasm) {
            Ok(()) => detail["artifact"] = json!(path),
            Err(e) => {
                tracing::warn!("the program cannot be left for the recorder in {}: {e}", path.display());
            }
        }
        let tasks: Vec<&str> = program.artifact.map.tasks.iter().map(|t| t.name.as_str()).collect();
        detail["tasks"] = json!(tasks);
        let names = self.engine.setup().files.join(", ");
        ctx.event(EventKind::Loaded, Level::Info, format!("program {names} loaded"), detail);
    }

    // --- the loop -------------------------------------------------------------------------------------

    /// Until the stack stops the service.
    pub(super) fn run(&mut self, ctx: &mut Context) -> Result<(), RunError> {
        let service = ctx.service.clone();
        let system = |what: &'static str| {
            let service = service.clone();
            move |source| RunError::System { service, what, source }
        };
        let mut reactor = Reactor::new().map_err(system("epoll"))?;
        let inbox = reactor.add(self.inbox.fd()).map_err(system("watching the inbox"))?;
        let stop = reactor.add(ctx.shutdown_fd()).map_err(system("watching for the end"))?;
        let tick = reactor.add_timer(TICK).map_err(system("the clock"))?;
        let alarm = reactor.add_alarm().map_err(system("the scan clock"))?;
        ctx.ready();
        let mut due_ns = clock::mono_ns();
        reactor.set_alarm(alarm, due_ns).map_err(system("the scan clock"))?;
        self.tick(ctx);
        // Before the first scan, or a recording could not verify it.
        self.send_keyframe();
        loop {
            let woken = reactor.wait(None).map_err(system("waiting"))?;
            let (mut rang, mut ticked) = (false, false);
            for wake in woken {
                if *wake == stop {
                    self.stop(ctx);
                    return Ok(());
                }
                rang |= *wake == inbox;
                ticked |= *wake == tick;
            }
            if rang && self.ring(ctx) {
                due_ns = due_ns.min(self.earliest_ns());
            }
            if ticked {
                self.tick(ctx);
            }
            if self.waiting && self.all_there() {
                due_ns = clock::mono_ns();
            }
            let now_ns = clock::mono_ns();
            if !self.waiting && (now_ns >= due_ns || self.hurry) {
                self.hurry = false;
                self.scan(ctx, now_ns, due_ns);
                due_ns = self.next_due_ns(now_ns);
            }
            self.send_keyframe();
            let wake_ns =
                if self.waiting { self.started_ns + self.config.start_timeout.ns() + 1 } else { due_ns };
            reactor.set_alarm(alarm, wake_ns).map_err(system("the scan clock"))?;
        }
    }

    /// The first scan waits for its inputs, but not for ever.
    fn all_there(&mut self) -> bool {
        let mut all = true;
        for source in &mut self.inputs {
            source.poll();
            all &= source.delivered();
        }
        let over = clock::mono_ns().saturating_sub(self.started_ns) > self.config.start_timeout.ns();
        if all || over {
            self.waiting = false;
            // The PLC's time does not run while it waits.
            let now_ns = clock::mono_ns();
            self.base_ns += now_ns as i64 - self.started_ns as i64;
            if let Some(watch) = &mut self.watch {
                let source = &self.inputs[watch.at];
                watch.begin(now_ns, &source.source, source.samples);
            }
        }
        !self.waiting
    }

    /// The inbox rang. Says whether a scan is wanted because of it.
    fn ring(&mut self, ctx: &mut Context) -> bool {
        self.inbox.drain();
        let mut news = false;
        for source in &mut self.inputs {
            news |= source.poll();
        }
        self.read_events();
        self.take_jobs(ctx);
        match (&self.config.trigger, &mut self.watch) {
            (Trigger::Word(word), _) => news && *word == TriggerWord::Inputs,
            (Trigger::Event(_), Some(watch)) => {
                let source = &self.inputs[watch.at];
                watch.look(&source.source, source.samples) > 0
            }
            (Trigger::Event(_), None) => false,
        }
    }

    fn read_events(&mut self) {
        let Self { events, inputs, .. } = self;
        events.drain(256, |header, tail| {
            // Only the launcher knows who died; what it says again was heard before.
            if header.stamp.writer != 0 || header.flags & event_flag::AGAIN != 0 {
                return;
            }
            let Ok(body) = serde_json::from_slice::<EventBody>(tail) else { return };
            if matches!(
                body.event,
                EventKind::Died | EventKind::Hung | EventKind::Restarting | EventKind::Held
            ) && let Some(source) = inputs.iter_mut().find(|s| s.name == body.service)
            {
                source.died(body.t_ns);
            }
        });
    }

    /// When the next scan may come at the earliest.
    fn earliest_ns(&self) -> u64 {
        self.last_scan_ns + self.config.min_interval.ns()
    }

    fn cycle_ns(&self) -> u64 {
        let shortest = self.engine.shortest_period_ns().and_then(|ns| u64::try_from(ns).ok());
        self.config.cycle.map_or_else(|| shortest.unwrap_or(DEFAULT_CYCLE.ns()), |c| c.ns())
    }

    /// When the next scan is due.
    fn next_due_ns(&self, now_ns: u64) -> u64 {
        let latest = now_ns + self.config.max_interval.ns();
        let running = self.engine.state() == PlcState::Run;
        let task =
            self.engine.next_task_ns().filter(|_| running).map(|plc| (plc + self.base_ns).max(0) as u64);
        // An event that fails to come is due at its own time, whatever else makes scans.
        let latest = self.watch.as_ref().map_or(latest, |watch| watch.due_ns().clamp(now_ns, latest));
        match (&self.config.trigger, task) {
            (_, Some(task)) => task.clamp(now_ns.min(latest), latest),
            (Trigger::Word(TriggerWord::Inputs) | Trigger::Event(_), None) => latest,
            (Trigger::Word(TriggerWord::Cycle), None) => {
                // On the grid of the last stamp, so that the clock has no drift.
                let cycle = self.cycle_ns();
                let mut next = self.last_stamp_ns.max(0) as u64 + cycle;
                if next <= now_ns {
                    next = now_ns - (now_ns - next) % cycle + cycle;
                }
                next.min(latest.max(now_ns + cycle.min(REPEAT_NS)))
            }
        }
    }

    // --- a scan ---------------------------------------------------------------------------------------

    fn scan(&mut self, ctx: &mut Context, now_ns: u64, due_ns: u64) {
        if self.restart_at_ns.is_some_and(|at| now_ns >= at) {
            self.restart_at_ns = None;
            // Who stops a faulted program means that it stays so.
            let stopped = self.orders.iter().any(|(_, order)| *order == Order::Stop);
            if let Some(kind) = restart_of(self.config.on_fault).filter(|_| !stopped) {
                let me = Source { writer: ctx.writer, generation: ctx.generation, seq: 0 };
                self.orders.push((me, Order::Start(kind)));
            }
        }
        let before = self.engine.state();
        let stamps = self.stamps(now_ns, due_ns);
        self.engine.begin(stamps);
        let mut commands = 0u32;
        for (source, order) in &self.orders {
            self.engine.control(source, &order.command());
            commands += 1;
        }
        let timeout_ns = self.config.input_timeout.ns();
        // Before the first look: what a service sent earlier is in this scan.
        let inputs_t_ns = clock::mono_ns();
        for source in &mut self.inputs {
            source.poll();
            source.apply(&mut self.engine, now_ns, timeout_ns, true);
        }
        self.take_writes(now_ns);
        self.take_event(now_ns);
        let outcome = self.engine.finish();
        if outcome.used_inputs {
            self.header.inputs_t_ns = inputs_t_ns;
        }
        if let Some((mapping, committer)) = &mut self.retain {
            let plc_time_ns = self.last_stamp_ns - self.base_ns;
            committer.commit(mapping.bytes_mut(), self.retain_layout, plc_time_ns, self.engine.retain());
        }
        self.publish_record(stamps.t_ns);
        self.publish_image(now_ns);
        self.last_scan_ns = now_ns;
        let end_ns = clock::mono_ns();
        let took_ns = end_ns - now_ns;
        self.times.scans += 1;
        self.times.sum_ns += took_ns;
        self.times.max_ns = self.times.max_ns.max(took_ns);
        self.times.late_max_ns = self.times.late_max_ns.max(now_ns.saturating_sub(due_ns));
        if commands > 0 {
            self.tell_orders(ctx, before);
        }
        if let Some(fault) = outcome.fault {
            self.tell_fault(ctx, &fault, end_ns);
        }
        self.tell_quality(ctx);
        if end_ns >= self.keyframe_due_ns {
            self.keyframe_wanted.get_or_insert(Reason::Periodic);
        }
        if end_ns - self.beat_ns > TICK.as_nanos() as u64 {
            self.beat_ns = end_ns;
            ctx.beat();
        }
    }

    /// A scan on time carries the time it was due: the clock's jitter is not the program's.
    fn stamps(&mut self, now_ns: u64, due_ns: u64) -> Stamps {
        let late_ns = now_ns.saturating_sub(due_ns);
        let on_time = self.config.trigger == Trigger::CYCLE && now_ns >= due_ns && late_ns < self.cycle_ns();
        let stamp = if on_time { due_ns } else { now_ns } as i64;
        let stamp = stamp.max(self.last_stamp_ns);
        self.last_stamp_ns = stamp;
        if self.orders.iter().any(|(_, order)| *order == Order::Start(Start::Cold)) {
            self.base_ns = stamp;
        }
        let t_ns = now_ns & !(STAMP_NS - 1);
        Stamps { t_ns, plc_time_ns: stamp - self.base_ns, utc_ns: t_ns as i64 + self.utc_offset_ns }
    }

    /// Whether the tasks that wait for an event are due, for the engine and its record.
    fn take_event(&mut self, now_ns: u64) {
        let Some(watch) = &mut self.watch else { return };
        if self.orders.iter().any(|(_, order)| matches!(order, Order::Start(_))) {
            watch.started(now_ns);
        }
        let source = &self.inputs[watch.at];
        if let Some(trigger) = watch.take(now_ns, &source.source, source.samples) {
            self.engine.trigger(&trigger);
        }
    }

    fn take_writes(&mut self, now_ns: u64) {
        let Self { writes, engine, header, acks, counters, .. } = self;
        writes.drain(WRITES_PER_SCAN, |write, tail| {
            let stamp = write.stamp;
            let old = now_ns.saturating_sub(stamp.t_ns) > WRITE_AGE_NS;
            let judged = if old { write_result::TOO_OLD } else { write_result::APPLIED };
            let source = Source { writer: stamp.writer, generation: stamp.generation, seq: stamp.seq };
            let result = engine.write(&source, judged, tail);
            counters.writes += 1;
            counters.writes_refused += u64::from(result != write_result::APPLIED);
            acks.note(header, stamp.writer, stamp.generation, stamp.seq, result);
        });
    }

    /// Stamped with the scan's own time, which stands in the record as well: a time that occurs twice costs a
    /// recording nothing.
    fn publish_record(&mut self, t_ns: u64) {
        let content = self.engine.record();
        let scan = self.engine.scan();
        if Content::parse(&content[..content.len().min(ipc_types::scan_record::HEAD_BYTES)])
            .is_ok_and(|c| c.head.flags & flag::INCOMPLETE != 0)
        {
            self.counters.records_incomplete += 1;
        }
        for (i, part) in parts(content).enumerate() {
            if self.scan_port.send_at(part_header(scan, i, content.len()), part, t_ns).is_err() {
                self.counters.records_lost += 1;
            }
        }
        self.scan_port.ring();
    }

    fn publish_image(&mut self, now_ns: u64) {
        let engine = &self.engine;
        self.header.scan = engine.scan();
        self.header.plc_time_ns = self.last_stamp_ns - self.base_ns;
        self.header.utc_ns = now_ns as i64 + self.utc_offset_ns;
        self.header.program_hash = engine.program_hash();
        self.header.state = engine.state() as u32;
        self.header.trap = engine.fault().map_or(0, |f| f.trap);
        let _ = self.image_port.send_tail(self.header, engine.image_bytes());
        self.image_port.ring();
        self.image_sent_ns = now_ns;
    }

    fn tick(&mut self, ctx: &mut Context) {
        let now_ns = clock::mono_ns();
        self.beat_ns = now_ns;
        ctx.beat();
        self.read_events();
        self.take_jobs(ctx);
        self.finish_load(ctx);
        if now_ns - self.image_sent_ns > REPEAT_NS {
            self.publish_image(now_ns);
        }
        if now_ns - self.status_ns > STATUS_NS {
            self.status_ns = now_ns;
            let offset_ns = clock::utc_offset_ns();
            if (offset_ns - self.utc_offset_ns).abs() > UTC_STEP_NS {
                self.utc_offset_ns = offset_ns;
            }
            self.shown_times = std::mem::take(&mut self.times);
            self.tell_retain(ctx);
            ctx.status(&status(self, now_ns));
        }
    }

    /// Whether RETAIN variables reach the disk: once when they no longer do, once when they do again.
    fn tell_retain(&mut self, ctx: &mut Context) {
        match self.disk.as_ref().and_then(DiskCopy::news) {
            Some(CopyNews::Failing(message)) => {
                ctx.event(EventKind::RetainFault, Level::Fault, message, Value::Null);
            }
            Some(CopyNews::Working(message)) => {
                ctx.event(EventKind::RetainFault, Level::Info, message, Value::Null);
            }
            None => {}
        }
    }

    /// The end: owners of outputs are told at once, RETAIN reaches the disk.
    fn stop(&mut self, ctx: &mut Context) {
        ctx.set_state(HealthState::Stopping);
        let now_ns = clock::mono_ns();
        self.header.state = PlcState::Stop as u32;
        let _ = self.image_port.send_tail(self.header, self.engine.image_bytes());
        self.image_port.ring();
        let detail = json!({ "scan": self.engine.scan() });
        ctx.event(EventKind::PlcStopped, Level::Info, "PLC stopped with the stack", detail);
        drop(self.disk.take());
        tracing::debug!("stopped after {} ms", (clock::mono_ns() - now_ns) / 1_000_000);
    }
}

fn header_of(engine: &Engine) -> Image {
    let image = engine.image();
    Image {
        input_bytes: image.input.bytes,
        output_bytes: image.output.bytes,
        marker_bytes: image.marker.bytes,
        ..Image::default()
    }
}
