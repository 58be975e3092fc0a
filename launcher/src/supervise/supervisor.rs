//! The launcher's main loop: waits for deaths, output, clients, heartbeats and clocks, tells them to the
//! [`Policy`], and does what it decides.

use super::child::{self, Child, Executable, Exit};
use super::console::Console;
use super::control::{ControlServer, Heard, Reply, Request, ServiceRow, StackStatus};
use super::hardware::Watchdog;
use super::logbook::{Line, Logbook};
use super::notify::Notify;
use super::policy::{Action, Death, Exhausted, Notice, Phase, Policy, Rule};
use super::rail_thread::{Order, RailHandle, Report};
use super::report::{self, Progress};
use super::state_dir::SOCKET;
use super::watch::Observed;
use super::{Listeners, Options, Outcome, ground};
use crate::stackfile::{LaunchOptions, OnExhausted, StackSettings};
use ipc_types::event::{EventKind, Level};
use ipc_types::payload::HealthState;
use ipc_types::reactor::{Reactor, Wake, signals};
use ipc_types::{Stack, clock};
use serde_json::json;
use std::collections::{BTreeMap, HashMap};
use std::io;
use std::os::fd::{AsFd, OwnedFd};
use std::time::Duration;

const MS: u64 = 1_000_000;
/// The launcher's own clock: samples, clients' deadlines, watchdogs.
const TICK_MS: u64 = 250;
/// Ticks without a turn of the rail thread before the stack fails: 5 s. Ticks, not time, so that a launcher that
/// was itself stopped does not blame its thread.
const RAIL_TICKS_MAX: u32 = 20;
/// The clean-up helper is killed after so long.
const CLEAN_LIMIT_NS: u64 = 2_000_000_000;
/// What killed command-line tools left is looked for so often.
const HOUSEKEEPING_TICKS: u64 = 40;
/// Nodes of the launcher itself.
const OWN_NODES: usize = 2;
/// `restart` waits so long for the new process to be ready.
const RESTART_WAIT_NS: u64 = 15_000_000_000;
/// The rail thread may take so long to let go of everything.
const QUIT_LIMIT: Duration = Duration::from_secs(2);
/// Log lines in a `died` event, and bytes of each.
const EPITAPH_LINES: usize = 20;
const EPITAPH_BYTES: usize = 256;

/// What the loop is made of.
pub struct Parts {
    pub stack: Stack,
    pub launch: BTreeMap<String, LaunchOptions>,
    pub settings: StackSettings,
    pub executable: Executable,
    pub signal_fd: OwnedFd,
    pub listeners: Vec<Listeners>,
    pub retain: Vec<Option<OwnedFd>>,
    pub rail: RailHandle,
    pub hardware: Option<Watchdog>,
}

/// Signals that end a stack. SIGHUP only when the starter did not ask to ignore it (nohup): a blocked signal
/// arrives at a signalfd even when it is ignored.
pub fn stop_signals() -> Vec<i32> {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let ignored = status
        .lines()
        .find_map(|l| l.strip_prefix("SigIgn:"))
        .and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok())
        .unwrap_or(0);
    let mut list = vec![libc::SIGTERM, libc::SIGINT];
    if ignored >> (libc::SIGHUP - 1) & 1 == 0 {
        list.push(libc::SIGHUP);
    }
    list
}

#[derive(Debug, Clone, Copy)]
enum Source {
    Signals,
    Rail,
    Alarm,
    Tick,
    Death(usize),
    Output(usize),
    CleanerDeath,
    Control,
    Client(u64),
}

/// What is kept of a service beside the policy's slot.
struct Service {
    options: LaunchOptions,
    child: Option<Child>,
    sources: Vec<Wake>,
    health: HealthState,
    cpu_ticks: u64,
    cpu_at: u64,
    cpu_percent: f64,
}

struct Cleaner {
    child: Child,
    wake: Wake,
    kill_at: u64,
    timed_out: bool,
}

/// A client that waits for a restart.
struct Waiter {
    client: u64,
    service: usize,
    generation: u32,
    since: u64,
}

/// A running stack.
pub struct Supervisor {
    stack: Stack,
    executable: Executable,
    signal_fd: OwnedFd,
    listeners: Vec<Listeners>,
    retain: Vec<Option<OwnedFd>>,
    rail: RailHandle,
    hardware: Option<Watchdog>,
    options: Options,
    policy: Policy,
    services: Vec<Service>,
    cleaner: Option<Cleaner>,
    logbook: Logbook,
    console: Console,
    control: ControlServer,
    waiters: Vec<Waiter>,
    notify: Option<Notify>,
    watchdog: Option<(Duration, u64)>,
    reactor: Reactor,
    sources: HashMap<Wake, Source>,
    alarm: Wake,
    began: u64,
    end_at: Option<u64>,
    all_ready: bool,
    ticks: u64,
    rail_ticks: u32,
    progress: Progress,
    progress_at: u64,
    observed: Observed,
    losses: Vec<String>,
    output_waits: bool,
}

fn rule_of(options: &LaunchOptions, recorder: bool) -> Rule {
    let ns = |d: Duration| u64::try_from(d.as_nanos()).unwrap_or(u64::MAX);
    let restart = &options.restart;
    Rule {
        max: restart.max,
        within_ns: ns(restart.within),
        backoff_first_ns: ns(restart.backoff_first),
        backoff_max_ns: ns(restart.backoff_max),
        on_exhausted: match restart.on_exhausted {
            OnExhausted::Hold => Exhausted::Hold,
            OnExhausted::FailStack => Exhausted::FailStack,
        },
        hang_timeout_ns: ns(options.hang_timeout),
        start_timeout_ns: ns(options.start_timeout),
        recorder,
    }
}

impl Supervisor {
    pub fn new(parts: Parts, options: &Options) -> io::Result<Self> {
        let Parts { stack, launch, settings, executable, signal_fd, listeners, retain, rail, hardware } = parts;
        let launch: Vec<LaunchOptions> =
            stack.services.iter().map(|s| launch.get(&s.name).cloned().unwrap_or_default()).collect();
        let rules = stack.services.iter().zip(&launch).map(|(s, l)| (s.name.clone(), rule_of(l, s.wiring.records)));
        let term_grace_ns = settings.stop_timeout.as_nanos() as u64;
        let policy = Policy::new(rules.collect(), term_grace_ns);
        let control = ControlServer::open(&stack.root.join(SOCKET))?;
        let mut reactor = Reactor::new()?;
        let mut sources = HashMap::new();
        sources.insert(reactor.add(signal_fd.as_fd())?, Source::Signals);
        sources.insert(reactor.add(rail.bell())?, Source::Rail);
        sources.insert(reactor.add(control.fd())?, Source::Control);
        sources.insert(reactor.add_timer(Duration::from_millis(TICK_MS))?, Source::Tick);
        let alarm = reactor.add_alarm()?;
        sources.insert(alarm, Source::Alarm);
        let now = clock::mono_ns();
        let services = launch.into_iter().map(|options| Service {
            options,
            child: None,
            sources: Vec::new(),
            health: HealthState::Starting,
            cpu_ticks: 0,
            cpu_at: 0,
            cpu_percent: 0.0,
        });
        Ok(Self {
            logbook: Logbook::new(stack.services.len()),
            console: Console::start()?,
            services: services.collect(),
            end_at: options.duration.map(|d| now + d.as_nanos() as u64),
            progress: Progress::new(options.json),
            options: options.clone(),
            notify: Notify::from_env(),
            watchdog: Notify::watchdog_period().map(|period| (period, now)),
            cleaner: None,
            waiters: Vec::new(),
            began: now,
            all_ready: false,
            ticks: 0,
            rail_ticks: 0,
            progress_at: now,
            observed: Observed::default(),
            losses: Vec::new(),
            output_waits: false,
            stack,
            executable,
            signal_fd,
            listeners,
            retain,
            rail,
            hardware,
            policy,
            control,
            reactor,
            sources,
            alarm,
        })
    }

    /// Runs the stack to its end.
    pub fn run(mut self) -> io::Result<Outcome> {
        let pid = std::process::id();
        if self.options.json {
            self.console.out(report::banner_json(&self.stack, pid).to_string());
        } else {
            self.console.out(report::banner(&self.stack, pid));
        }
        self.policy.start(clock::mono_ns());
        self.perform();
        while !self.policy.ended() {
            self.set_alarm()?;
            for wake in self.reactor.wait(None)?.to_vec() {
                if let Some(source) = self.sources.get(&wake).copied() {
                    self.handle(source);
                    self.perform();
                }
            }
            let now = clock::mono_ns();
            if self.end_at.is_some_and(|t| now >= t) {
                self.end_at = None;
                self.policy.stop("its time is over", now);
            }
            self.policy.tick(now);
            self.limit_cleaner(now);
            self.perform();
            self.answer_waiters(now);
            self.flush();
        }
        Ok(self.finish())
    }

    /// Wakes the loop for the next deadline.
    fn set_alarm(&mut self) -> io::Result<()> {
        let cleaner = self.cleaner.as_ref().filter(|c| !c.timed_out).map(|c| c.kill_at);
        let output = self.output_waits.then(|| clock::mono_ns() + 10 * MS);
        let next = [self.policy.next_deadline(), cleaner, self.end_at, output].into_iter().flatten().min();
        match next {
            Some(t) => self.reactor.set_alarm(self.alarm, t),
            None => self.reactor.set_timer(self.alarm, Duration::ZERO, Duration::ZERO),
        }
    }

    fn handle(&mut self, source: Source) {
        match source {
            Source::Signals => {
                while let Some(number) = signals::take(&self.signal_fd) {
                    let name = Exit::Signal { number, core: false }.signal_word();
                    self.policy.stop(&format!("{name} received"), clock::mono_ns());
                }
            }
            Source::Rail => self.take_reports(),
            Source::Alarm => {}
            Source::Tick => self.on_tick(),
            Source::Death(service) => self.on_death(service),
            Source::Output(service) => self.read_output(service),
            Source::CleanerDeath => self.on_cleaner_death(),
            Source::Control => {
                for id in self.control.accept() {
                    let Some(fd) = self.control.client_fd(id) else { continue };
                    match self.reactor.add(fd) {
                        Ok(wake) => drop(self.sources.insert(wake, Source::Client(id))),
                        Err(_) => self.control.drop_client(id),
                    }
                }
            }
            Source::Client(id) => match self.control.hear(id) {
                Heard::Gone => self.drop_client(id),
                Heard::Requests(requests) => {
                    for request in requests {
                        self.serve(id, request);
                    }
                }
            },
        }
    }

    /// Does what the policy decided, until it has nothing more.
    fn perform(&mut self) {
        loop {
            let actions = self.policy.take();
            if actions.is_empty() {
                return;
            }
            for action in actions {
                match action {
                    Action::Spawn { service, generation } => self.spawn(service, generation),
                    Action::Signal { service, signal } => {
                        if let Some(child) = &self.services[service].child {
                            child.signal(signal);
                        }
                    }
                    Action::Clean => self.start_cleaner(),
                    Action::CloseListeners { service } => {
                        for (_, listener) in &mut self.listeners[service] {
                            *listener = None;
                        }
                    }
                    Action::Tell(notice) => self.tell(notice),
                    Action::Ended => {}
                }
            }
        }
    }

    fn spawn(&mut self, service: usize, generation: u32) {
        if let Err(cause) = self.try_spawn(service, generation) {
            let death = Death { how: format!("could not be started: {cause}"), detail: json!({}) };
            self.policy.died(service, death, clock::mono_ns());
        }
    }

    fn try_spawn(&mut self, service: usize, generation: u32) -> Result<(), String> {
        let entry = &self.stack.services[service];
        // Closed by a hold: `restart` opens them again.
        for (slot, declared) in self.listeners[service].iter_mut().zip(&entry.wiring.listeners) {
            if slot.1.is_none() {
                slot.1 = Some(ground::listen(&entry.name, declared).map_err(|e| e.to_string())?);
            }
        }
        let mut fds: Vec<(String, std::os::fd::BorrowedFd<'_>)> = self.listeners[service]
            .iter()
            .filter_map(|(name, listener)| Some((name.clone(), listener.as_ref()?.as_fd())))
            .collect();
        if let Some(retain) = &self.retain[service] {
            fds.push(("retain".to_owned(), retain.as_fd()));
        }
        let options = &self.services[service].options;
        let child = self
            .executable
            .spawn_service(&self.stack.root, &entry.name, generation, options, &fds)
            .map_err(|e| e.to_string())?;
        let watch = |reactor: &mut Reactor| -> io::Result<(Wake, Wake)> {
            Ok((reactor.add(child.pidfd())?, reactor.add(child.output())?))
        };
        let (death, output) = match watch(&mut self.reactor) {
            Ok(wakes) => wakes,
            Err(e) => {
                child.signal(super::policy::Kill::Kill);
                return Err(e.to_string());
            }
        };
        self.sources.insert(death, Source::Death(service));
        self.sources.insert(output, Source::Output(service));
        let pid = child.pid;
        let slot = &mut self.services[service];
        slot.sources = vec![death, output];
        slot.health = HealthState::Starting;
        slot.cpu_ticks = 0;
        slot.cpu_at = clock::mono_ns();
        slot.cpu_percent = 0.0;
        slot.child = Some(child);
        self.policy.started(service, pid);
        Ok(())
    }

    fn on_death(&mut self, service: usize) {
        let Some(child) = &self.services[service].child else { return };
        let exit = match child.reap() {
            Ok(Some(exit)) => exit,
            Ok(None) => return,
            Err(_) => Exit::Code(-1),
        };
        self.read_output(service);
        if let Some(line) = self.logbook.flush(service, clock::utc_ns()) {
            self.show(&line);
        }
        let Some(child) = self.services[service].child.take() else { return };
        let _ = self.reactor.remove(child.pidfd());
        let _ = self.reactor.remove(child.output());
        for wake in std::mem::take(&mut self.services[service].sources) {
            self.sources.remove(&wake);
        }
        let mut detail = exit.json();
        let log: Vec<String> =
            self.logbook.tail(Some(service), EPITAPH_LINES).iter().map(|l| cut(&l.text, EPITAPH_BYTES)).collect();
        detail["pid"] = child.pid.into();
        detail["log"] = log.into();
        self.policy.died(service, Death { how: exit.to_string(), detail }, clock::mono_ns());
    }

    fn read_output(&mut self, service: usize) {
        let Some(child) = &self.services[service].child else { return };
        let mut lines = Vec::new();
        let logbook = &mut self.logbook;
        let utc_ns = clock::utc_ns();
        let open = child.read(&mut [0u8; 8192], |bytes| {
            logbook.feed(service, bytes, utc_ns, |line| lines.push(line.clone()));
        });
        if !open {
            // It closed its output but lives on: nothing more comes, and an ended pipe would wake for ever.
            let _ = self.reactor.remove(child.output());
        }
        for line in lines {
            self.show(&line);
        }
    }

    /// A log line goes to the foreground and to those who follow.
    fn show(&mut self, line: &Line) {
        let name = &self.stack.services[line.service].name;
        self.console.err(format!("{} {name:<10} | {}", line.clock(), line.text));
        for id in self.control.publish(line, name) {
            self.drop_client(id);
        }
    }

    fn tell(&mut self, notice: Notice) {
        let (name, utc_ns) = match notice.service {
            Some(service) => (self.stack.services[service].name.clone(), clock::utc_ns()),
            None => ("stack".to_owned(), clock::utc_ns()),
        };
        if let Some(service) = notice.service {
            let line = self.logbook.note(service, &format!("== {}", notice.message), utc_ns);
            self.show(&line);
        } else {
            self.console.err(format!("{} {name:<10} | == {}", super::logbook::clock(utc_ns), notice.message));
        }
        if let Some(notify) = &self.notify {
            match notice.kind {
                EventKind::Stopping => notify.send("STOPPING=1\nSTATUS=stopping"),
                EventKind::StackFailed | EventKind::Held => {
                    notify.send(&format!("STATUS={name}: {}", notice.message.replace('\n', " ")));
                }
                _ => {}
            }
        }
        let Notice { kind, level, message, detail, .. } = notice;
        if !self.rail.order(Order::Tell { service: name, kind, level, message, detail }) && level == Level::Fault {
            self.console.err("stack      | == the rail thread does not take events any more");
        }
    }

    fn start_cleaner(&mut self) {
        let started = self.executable.spawn_cleaner(&self.stack.root).and_then(|child| {
            let wake = self.reactor.add(child.pidfd())?;
            Ok((child, wake))
        });
        match started {
            Ok((child, wake)) => {
                self.sources.insert(wake, Source::CleanerDeath);
                let kill_at = clock::mono_ns() + CLEAN_LIMIT_NS;
                self.cleaner = Some(Cleaner { child, wake, kill_at, timed_out: false });
            }
            Err(e) => self.policy.clean_done(Err(format!("could not be started: {e}")), clock::mono_ns()),
        }
    }

    fn limit_cleaner(&mut self, now: u64) {
        if let Some(cleaner) = &mut self.cleaner
            && now >= cleaner.kill_at
            && !std::mem::replace(&mut cleaner.timed_out, true)
        {
            cleaner.child.signal(super::policy::Kill::Kill);
        }
    }

    fn on_cleaner_death(&mut self) {
        let Some(cleaner) = self.cleaner.take() else { return };
        let exit = match cleaner.child.reap() {
            Ok(None) => {
                self.cleaner = Some(cleaner);
                return;
            }
            Ok(Some(exit)) => exit,
            Err(_) => Exit::Code(-1),
        };
        let _ = self.reactor.remove(cleaner.child.pidfd());
        self.sources.remove(&cleaner.wake);
        let mut text = Vec::new();
        cleaner.child.read(&mut [0u8; 1024], |bytes| text.extend_from_slice(bytes));
        let result = if cleaner.timed_out {
            Err(format!("no answer within {} s", CLEAN_LIMIT_NS / 1_000_000_000))
        } else if exit == Exit::Code(0) {
            Ok(())
        } else {
            Err(format!("{exit}: {}", cut(String::from_utf8_lossy(&text).trim(), EPITAPH_BYTES)))
        };
        if let Err(cause) = &result {
            self.console.err(format!("stack      | == clean-up after dead processes failed: {cause}"));
        }
        self.policy.clean_done(result, clock::mono_ns());
    }

    fn take_reports(&mut self) {
        self.rail.drain_bell();
        while let Ok(report) = self.rail.reports.try_recv() {
            match report {
                Report::Up => {}
                Report::Failed(cause) => {
                    self.policy.fail(format!("the launcher lost the rail: {cause}"), clock::mono_ns());
                }
                Report::Trouble(text) => self.console.err(format!("stack      | == {text}")),
                Report::Turn { t_ns, beats, observed } => {
                    self.rail_ticks = 0;
                    for beat in beats {
                        if beat.generation == self.policy.slots()[beat.service].generation {
                            self.services[beat.service].health = beat.state;
                        }
                        self.policy.beat(beat.service, beat.generation, beat.state, t_ns);
                    }
                    self.policy.heartbeats_read(t_ns);
                    if let Some(observed) = observed {
                        self.on_observed(*observed);
                    }
                }
            }
        }
        self.check_all_ready();
    }

    fn check_all_ready(&mut self) {
        if self.all_ready || !self.policy.slots().iter().all(|s| s.phase == Phase::Running) {
            return;
        }
        self.all_ready = true;
        let after_ms = (clock::mono_ns() - self.began) / MS;
        let count = self.services.len();
        if let Some(notify) = &self.notify {
            notify.send(&format!("READY=1\nSTATUS={count} services ready"));
        }
        if self.options.json {
            self.console.out(json!({ "event": "ready", "services": count, "after_ms": after_ms }).to_string());
        } else {
            self.console.out(format!("all {count} services ready after {after_ms} ms"));
            if let Some(tour) = self.options.tour.take() {
                self.console.out(tour);
            }
        }
    }

    fn on_observed(&mut self, observed: Observed) {
        self.losses.clone_from(&observed.losses);
        let now = clock::mono_ns();
        self.observed = observed;
        let passed = now - self.progress_at;
        if self.options.progress && passed >= 1_000 * MS - 125 * MS && !self.policy.stopping() {
            self.progress_at = now;
            let at = Duration::from_nanos(now - self.began);
            let line = self.progress.line(&self.observed, at, Duration::from_nanos(passed));
            self.console.out(line);
        }
    }

    fn on_tick(&mut self) {
        let now = clock::mono_ns();
        self.ticks += 1;
        self.rail_ticks += 1;
        if self.rail_ticks >= RAIL_TICKS_MAX && !self.policy.stopping() {
            self.policy.fail("the launcher's rail thread does not turn any more: the middleware hangs".into(), now);
        }
        if self.ticks % (1000 / TICK_MS) == 0 {
            self.sample_cpu(now);
        }
        if self.ticks % HOUSEKEEPING_TICKS == 0 && self.foreign_nodes() {
            self.policy.housekeeping();
        }
        if let (Some(notify), Some((period, last))) = (&self.notify, &mut self.watchdog)
            && now - *last + TICK_MS * MS >= period.as_nanos() as u64
        {
            *last = now;
            notify.send("WATCHDOG=1");
        }
        let healthy =
            self.services.iter().zip(self.policy.slots()).all(|(s, slot)| !s.options.critical || slot.phase == Phase::Running);
        if let Some(hardware) = &mut self.hardware
            && healthy
            && !self.policy.stopping()
        {
            hardware.feed();
        }
    }

    fn sample_cpu(&mut self, now: u64) {
        for service in &mut self.services {
            let Some(usage) = service.child.as_ref().and_then(|c| child::usage(c.pid)) else { continue };
            let passed_s = (now - service.cpu_at) as f64 / 1e9;
            let ticks = usage.cpu_ticks.saturating_sub(service.cpu_ticks);
            service.cpu_percent = ticks as f64 / child::TICKS_PER_S as f64 / passed_s.max(0.001) * 100.0;
            service.cpu_ticks = usage.cpu_ticks;
            service.cpu_at = now;
        }
    }

    /// Whether there are more nodes on the rail than processes of the stack: a tool is at work, or was killed.
    fn foreign_nodes(&self) -> bool {
        let nodes = std::fs::read_dir(self.stack.root.join("nodes")).map_or(0, |dir| {
            dir.flatten().filter(|e| e.file_type().is_ok_and(|t| t.is_dir())).count()
        });
        nodes > self.services.iter().filter(|s| s.child.is_some()).count() + OWN_NODES
    }

    fn serve(&mut self, id: u64, request: Result<Request, String>) {
        let now = clock::mono_ns();
        match request {
            Err(cause) => self.reply(id, &Reply::Error(cause)),
            Ok(Request::Ps {}) => {
                let rows = (0..self.services.len()).map(|i| self.row(i, now)).collect();
                self.reply(id, &Reply::Ps(rows));
            }
            Ok(Request::Status {}) => {
                let status = self.status(now);
                self.reply(id, &Reply::Status(status));
            }
            Ok(Request::Down {}) => {
                self.reply(id, &Reply::Stopping { pid: std::process::id() });
                self.policy.stop("`down` was asked for", now);
            }
            Ok(Request::Logs { service, lines, follow }) => self.serve_logs(id, service.as_deref(), lines, follow),
            Ok(Request::Restart { service }) => {
                let result = self.index_of(&service).and_then(|i| Ok((i, self.policy.restart(i, now)?)));
                match result {
                    Ok((service, generation)) => {
                        self.waiters.push(Waiter { client: id, service, generation, since: now });
                    }
                    Err(cause) => self.reply(id, &Reply::Error(cause)),
                }
            }
        }
    }

    fn serve_logs(&mut self, id: u64, service: Option<&str>, lines: u32, follow: bool) {
        let index = match service.map(|s| self.index_of(s)).transpose() {
            Ok(index) => index,
            Err(cause) => return self.reply(id, &Reply::Error(cause)),
        };
        let replies: Vec<Reply> = self
            .logbook
            .tail(index, lines as usize)
            .into_iter()
            .map(|line| {
                Reply::Log(super::control::LogLine {
                    utc_ns: line.utc_ns,
                    service: self.stack.services[line.service].name.clone(),
                    line: line.text.clone(),
                })
            })
            .collect();
        for reply in replies {
            self.reply(id, &reply);
        }
        if follow {
            self.control.follow(id, index);
        } else {
            self.reply(id, &Reply::End);
        }
    }

    fn index_of(&self, name: &str) -> Result<usize, String> {
        let names: Vec<&str> = self.stack.services.iter().map(|s| s.name.as_str()).collect();
        names
            .iter()
            .position(|n| *n == name)
            .ok_or_else(|| format!("this stack has no service '{name}'; it has {}", names.join(", ")))
    }

    fn row(&self, index: usize, now: u64) -> ServiceRow {
        let (entry, service, slot) = (&self.stack.services[index], &self.services[index], &self.policy.slots()[index]);
        let pid = service.child.as_ref().map_or(0, |c| c.pid);
        ServiceRow {
            service: entry.name.clone(),
            kind: entry.kind.clone(),
            state: slot.phase.word().to_owned(),
            health: format!("{:?}", service.health).to_lowercase(),
            pid,
            generation: slot.generation,
            restarts: slot.generation.saturating_sub(1),
            uptime_ms: if pid == 0 { 0 } else { (now - slot.since) / MS },
            cpu_percent: if pid == 0 { 0.0 } else { service.cpu_percent },
            rss_bytes: child::usage(pid).map_or(0, |u| u.rss_bytes),
        }
    }

    fn held(&self) -> Vec<String> {
        let held = |s: &&super::policy::Slot| s.phase == Phase::Held;
        self.policy.slots().iter().filter(held).map(|s| s.name.clone()).collect()
    }

    fn status(&self, now: u64) -> StackStatus {
        let held = self.held();
        let ready = self.policy.slots().iter().filter(|s| s.phase == Phase::Running).count();
        let state = match () {
            () if self.policy.failed().is_some() => "failed",
            () if self.policy.stopping() => "stopping",
            () if !held.is_empty() => "degraded",
            () if ready == self.services.len() => "running",
            () if self.all_ready => "degraded",
            () => "starting",
        };
        StackStatus {
            stack: self.stack.name.clone(),
            pid: std::process::id(),
            build_id: self.stack.build_id.clone(),
            state: state.to_owned(),
            uptime_ms: (now - self.began) / MS,
            services: self.services.len() as u32,
            ready: ready as u32,
            held,
            failed: self.policy.failed().map(str::to_owned),
        }
    }

    /// Tells clients whose restart is done, or will not be.
    fn answer_waiters(&mut self, now: u64) {
        for waiter in std::mem::take(&mut self.waiters) {
            let slot = &self.policy.slots()[waiter.service];
            let name = slot.name.clone();
            let reply = if slot.generation >= waiter.generation && slot.phase == Phase::Running {
                Reply::Restarted { service: name, generation: slot.generation, after_ms: (now - waiter.since) / MS }
            } else if slot.phase == Phase::Held {
                Reply::Error(format!("service '{name}' does not stay up and is held; see `dinrail logs {name}`"))
            } else if self.policy.stopping() {
                Reply::Error("the stack is stopping".into())
            } else if now - waiter.since > RESTART_WAIT_NS {
                Reply::Error(format!("service '{name}' is not ready after 15 s; see `dinrail logs {name}`"))
            } else {
                self.waiters.push(waiter);
                continue;
            };
            self.reply(waiter.client, &reply);
        }
    }

    fn reply(&mut self, id: u64, reply: &Reply) {
        if !self.control.answer(id, reply) {
            self.drop_client(id);
        }
    }

    fn flush(&mut self) {
        let (waits, broken) = self.control.flush();
        self.output_waits = waits;
        for id in broken {
            self.drop_client(id);
        }
    }

    fn drop_client(&mut self, id: u64) {
        if let Some(fd) = self.control.client_fd(id) {
            let _ = self.reactor.remove(fd);
        }
        self.sources.retain(|_, s| !matches!(s, Source::Client(client) if *client == id));
        self.waiters.retain(|w| w.client != id);
        self.control.drop_client(id);
    }

    /// Everything has ended: let go of the rail, say how it went.
    fn finish(mut self) -> Outcome {
        let ran = Duration::from_nanos(clock::mono_ns() - self.began);
        if let Some(cleaner) = &self.cleaner {
            cleaner.child.signal(super::policy::Kill::Kill);
        }
        self.rail.order(Order::Quit);
        let begin = std::time::Instant::now();
        while !self.rail.ended() && begin.elapsed() < QUIT_LIMIT {
            std::thread::sleep(Duration::from_millis(1));
        }
        while let Ok(report) = self.rail.reports.try_recv() {
            if let Report::Turn { observed: Some(observed), .. } = report {
                self.losses.clone_from(&observed.losses);
                self.observed = *observed;
            }
        }
        let outcome = Outcome {
            failed: self.policy.failed().map(str::to_owned),
            held: self.held(),
            losses: std::mem::take(&mut self.losses),
        };
        if outcome.failed.is_none()
            && let Some(hardware) = self.hardware.take()
        {
            hardware.disarm();
        }
        let restarts: u32 = self.policy.slots().iter().map(|s| s.generation.saturating_sub(1)).sum();
        self.console.out(report::summary(&self.observed, &outcome, ran, restarts, self.options.json));
        if self.console.dropped() > 0 {
            self.console.err(format!("{} lines were not printed: the terminal did not take them", self.console.dropped()));
        }
        self.console.finish(Duration::from_secs(1));
        outcome
    }
}

/// At most so many bytes of a text.
fn cut(text: &str, bytes: usize) -> String {
    text[..text.floor_char_boundary(bytes)].to_owned()
}
