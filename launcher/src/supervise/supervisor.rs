//! The launcher's main loop: waits for deaths, output, clients, heartbeats and clocks, tells them to the
//! [`Policy`], and does what it decides.

use super::child::{self, Child, Executable, Exit};
use super::console::Console;
use super::control::{ControlServer, Heard};
use super::hardware::Watchdog;
use super::logbook::Logbook;
use super::notify::Notify;
use super::policy::{Action, Exhausted, Phase, Policy, Rule};
use super::rail_thread::{Order, RailHandle, Report};
use super::report::{self, Progress};
use super::state_dir::SOCKET;
use super::watch::Observed;
use super::{Listeners, Options, Outcome};
use crate::stackfile::{LaunchOptions, OnExhausted, StackSettings};
use ipc_types::net::Seldom;
use ipc_types::payload::HealthState;
use ipc_types::reactor::{Reactor, Wake, signals};
use ipc_types::{Stack, clock};
use serde_json::json;
use std::collections::{BTreeMap, HashMap};
use std::io;
use std::os::fd::{AsFd, OwnedFd};
use std::time::Duration;

mod processes;
mod requests;

use requests::Waiter;

const MS: u64 = 1_000_000;
/// The launcher's own clock: samples, clients' deadlines, watchdogs.
const TICK_MS: u64 = 250;
/// Ticks without a turn of the rail thread before the stack fails: 5 s. Ticks, not time, so that a launcher that
/// was itself stopped does not blame its thread.
const RAIL_TICKS_MAX: u32 = 20;
/// What killed command-line tools left is looked for so often.
const HOUSEKEEPING_TICKS: u64 = 40;
/// Nodes of the launcher itself.
const OWN_NODES: usize = 2;
/// The rail thread may take so long to let go of everything.
const QUIT_LIMIT: Duration = Duration::from_secs(2);
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
    /// What it last said of itself while it was at work: ready, but not as it should be.
    degraded: bool,
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
    /// `None` while the control socket is not waited for, because nobody can be taken.
    control_wake: Option<Wake>,
    turned_away: Seldom,
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
        let Parts { stack, launch, settings, executable, signal_fd, listeners, retain, rail, hardware } =
            parts;
        let launch: Vec<LaunchOptions> =
            stack.services.iter().map(|s| launch.get(&s.name).cloned().unwrap_or_default()).collect();
        let rules =
            stack.services.iter().zip(&launch).map(|(s, l)| (s.name.clone(), rule_of(l, s.wiring.records)));
        let term_grace_ns = settings.stop_timeout.as_nanos() as u64;
        let policy = Policy::new(rules.collect(), term_grace_ns);
        let control = ControlServer::open(&stack.root.join(SOCKET))?;
        let mut reactor = Reactor::new()?;
        let mut sources = HashMap::new();
        sources.insert(reactor.add(signal_fd.as_fd())?, Source::Signals);
        sources.insert(reactor.add(rail.bell())?, Source::Rail);
        let control_wake = reactor.add(control.fd())?;
        sources.insert(control_wake, Source::Control);
        sources.insert(reactor.add_timer(Duration::from_millis(TICK_MS))?, Source::Tick);
        let alarm = reactor.add_alarm()?;
        sources.insert(alarm, Source::Alarm);
        let now = clock::mono_ns();
        let services = launch.into_iter().map(|options| Service {
            options,
            child: None,
            sources: Vec::new(),
            health: HealthState::Starting,
            degraded: false,
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
            control_wake: Some(control_wake),
            turned_away: Seldom::default(),
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
            let woken = self.reactor.wait(None)?.to_vec();
            // First the wish to end: who sends a signal to all processes of the stack at once wants no restarts.
            self.handle(Source::Signals);
            self.perform();
            for wake in woken {
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
                    // A terminal that closes tells it more than once; nobody sits there to hurry anything.
                    if number == libc::SIGHUP && self.policy.stopping() {
                        continue;
                    }
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
            Source::Control => self.take_clients(),
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
                            let service = &mut self.services[beat.service];
                            service.health = beat.state;
                            if matches!(beat.state, HealthState::Ready | HealthState::Degraded) {
                                service.degraded = beat.state == HealthState::Degraded;
                            }
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
            self.console
                .out(json!({ "event": "ready", "services": count, "after_ms": after_ms }).to_string());
        } else {
            let degraded = match self.degraded().join(", ") {
                none if none.is_empty() => none,
                some => format!("; degraded: {some} (`dinrail status` says why)"),
            };
            let services = if count == 1 { "the service is" } else { &format!("all {count} services") };
            self.console.out(format!("{services} ready after {after_ms} ms{degraded}"));
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
        self.listen_again();
        self.rail_ticks += 1;
        if self.rail_ticks >= RAIL_TICKS_MAX && !self.policy.stopping() {
            self.policy
                .fail("the launcher's rail thread does not turn any more: the middleware hangs".into(), now);
        }
        if self.ticks.is_multiple_of(1000 / TICK_MS) {
            self.sample_cpu(now);
        }
        if self.ticks.is_multiple_of(HOUSEKEEPING_TICKS) && self.foreign_nodes() {
            self.policy.housekeeping();
        }
        if let (Some(notify), Some((period, last))) = (&self.notify, &mut self.watchdog)
            && now - *last + TICK_MS * MS >= period.as_nanos() as u64
        {
            *last = now;
            notify.send("WATCHDOG=1");
        }
        let healthy = self
            .services
            .iter()
            .zip(self.policy.slots())
            .all(|(s, slot)| !s.options.critical || slot.phase == Phase::Running);
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
        let nodes = std::fs::read_dir(self.stack.root.join("nodes"))
            .map_or(0, |dir| dir.flatten().filter(|e| e.file_type().is_ok_and(|t| t.is_dir())).count());
        nodes > self.services.iter().filter(|s| s.child.is_some()).count() + OWN_NODES
    }

    /// Services that work, but say that something is not as it should be.
    pub(super) fn degraded(&self) -> Vec<String> {
        let named = self.services.iter().zip(&self.stack.services);
        named.filter(|(service, _)| service.degraded).map(|(_, entry)| entry.name.clone()).collect()
    }

    /// Everything has ended: let go of the rail, say how it went.
    fn finish(mut self) -> Outcome {
        let ran = Duration::from_nanos(clock::mono_ns() - self.began);
        if let Some(cleaner) = &self.cleaner {
            cleaner.child.signal(super::policy::Kill::Now);
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
            degraded: self.degraded(),
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
            self.console.err(format!(
                "{} lines were not printed: the terminal did not take them",
                self.console.dropped()
            ));
        }
        self.console.finish(Duration::from_secs(1));
        outcome
    }
}
