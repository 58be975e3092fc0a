//! The process: one thread waits for the port, its clock and the rail, and does all the work; opening and closing,
//! which may wait for USB or TCP, are left to helper threads.

use std::io;
use std::os::fd::{AsFd, OwnedFd};
use std::sync::mpsc;
use std::time::Duration;

use ipc_types::event::{EventKind, Level};
use ipc_types::inbox::Inbox;
use ipc_types::payload::{HealthState, SerialChunk, serial_flag};
use ipc_types::port::{Publisher, Subscriber};
use ipc_types::rail::RailError;
use ipc_types::reactor::{Reactor, Wake};
use ipc_types::topic::TopicKind;
use ipc_types::wiring::Neighbours;
use ipc_types::{Context, Wiring, clock};
use rustix::pipe::PipeFlags;
use serde::Serialize;
use thiserror::Error;

use crate::config::Config;
use crate::doubt::{Doubt, Verdict};
use crate::driver::{Counters, Driver, Sink, echo_flags};
use crate::port::{Kind, Options, Port, PortError};
use crate::protocol::sender::Head;
use crate::sys;

/// Heartbeat; the launcher wants one every 100 ms.
const BEAT: Duration = Duration::from_millis(50);
/// Beats from one status to the next: one second.
const STATUS_BEATS: u32 = 20;
/// Pause before a port is opened again, doubled up to the second.
const BACKOFF_NS: (u64, u64) = (100_000_000, 5_000_000_000);
/// A port that was open for so long is tried at once when it goes.
const STEADY_NS: u64 = 2_000_000_000;
/// Priority under SCHED_FIFO, where it is permitted: above normal processes, below what an administrator sets.
const PRIORITY: i32 = 5;
/// Transmissions begun in one turn.
const LOADS: usize = 64;
/// Events of the port a second that go to the rail.
const EVENTS: u32 = 5;

/// Why the driver ended. A port that fails is no reason.
#[derive(Debug, Error)]
pub enum RunError {
    /// The rail.
    #[error(transparent)]
    Rail(#[from] RailError),
    /// The system.
    #[error("serial: {what}: {source}")]
    System {
        /// What was attempted.
        what: &'static str,
        /// The system's reason.
        source: io::Error,
    },
    /// Settings that `check` refuses.
    #[error("serial: device '{0}' is no serial device: `dinrail check` says why")]
    Device(String),
}

fn system<E: Into<io::Error>>(what: &'static str) -> impl FnOnce(E) -> RunError {
    move |source| RunError::System { what, source: source.into() }
}

/// What the driver needs of the launcher.
pub fn topics(_config: &Config, neighbours: &Neighbours) -> Wiring {
    let mut wiring = Wiring::default();
    wiring.own(TopicKind::SerialRx).own(TopicKind::SerialTx);
    wiring.read(TopicKind::SerialTx.of(&neighbours.name), true, "");
    wiring
}

/// Runs until the launcher says stop.
pub fn run(ctx: Context) -> Result<(), RunError> {
    let config: Config = ctx.config()?;
    let Some(options) = config.options(&ctx.stack.dir) else { return Err(RunError::Device(config.device)) };
    let inbox = ctx.inbox()?;
    Service::new(ctx, config, options)?.run(inbox)
}

/// The rail as the port sees it.
struct Rail {
    rx: Publisher<SerialChunk>,
    unpublished: u64,
    /// Something was published and nobody was woken yet.
    silent: bool,
}

impl Sink for Rail {
    fn chunk(&mut self, header: SerialChunk, bytes: &[u8], t_ns: u64) {
        if self.rx.send_at(header, bytes, t_ns).is_err() {
            self.unpublished += 1;
        }
        self.silent = true;
    }
}

impl Rail {
    fn flush(&mut self) {
        if std::mem::take(&mut self.silent) {
            self.rx.ring();
        }
    }

    /// Tells a writer that its bytes were not sent.
    fn not_sent(&mut self, head: &Head, bytes: &[u8], now_ns: u64) {
        let header = SerialChunk {
            first_t_ns: now_ns,
            tx_seq: head.seq,
            tx_writer: head.writer,
            tx_generation: head.generation,
            flags: echo_flags(head, bytes.len()) | serial_flag::NOT_SENT,
            ..SerialChunk::default()
        };
        self.chunk(header, bytes, now_ns);
    }
}

fn head_of(message: &SerialChunk) -> Head {
    Head {
        seq: message.stamp.seq,
        writer: message.stamp.writer,
        generation: message.stamp.generation,
        deadline_ns: message.first_t_ns,
        flags: message.flags,
    }
}

/// Opens ports beside the work.
struct Opener {
    send: mpsc::Sender<Result<Port, PortError>>,
    receive: mpsc::Receiver<Result<Port, PortError>>,
    bell: (OwnedFd, OwnedFd),
}

impl Opener {
    fn new() -> io::Result<Self> {
        let (send, receive) = mpsc::channel();
        let bell = rustix::pipe::pipe_with(PipeFlags::CLOEXEC | PipeFlags::NONBLOCK)?;
        Ok(Self { send, receive, bell })
    }

    fn start(&self, options: &Options) -> io::Result<()> {
        let (send, options) = (self.send.clone(), options.clone());
        let bell = self.bell.1.try_clone()?;
        std::thread::Builder::new().name("open".into()).spawn(move || {
            let _ = send.send(Port::open(&options));
            let _ = rustix::io::write(&bell, b"!");
        })?;
        Ok(())
    }

    fn result(&self) -> Option<Result<Port, PortError>> {
        let mut bytes = [0; 16];
        while matches!(rustix::io::read(&self.bell.0, &mut bytes), Ok(n) if n > 0) {}
        self.receive.try_recv().ok()
    }
}

/// Closing may wait as well.
fn close(port: Port) {
    let _ = std::thread::Builder::new().name("close".into()).spawn(move || drop(port));
}

enum Line {
    /// Opened again at this time.
    Closed(u64),
    Opening,
    Open(Box<Open>),
}

struct Open {
    driver: Driver,
    since_ns: u64,
    /// While the port is waited for.
    wake: Option<Wake>,
    visitors: Option<Wake>,
}

/// What `<serial>/status` says.
#[derive(Serialize)]
struct Status<'a> {
    state: &'static str,
    device: &'a str,
    /// As in the stack file.
    #[serde(skip_serializing_if = "Option::is_none")]
    number: Option<u32>,
    /// The device itself, links followed.
    #[serde(skip_serializing_if = "Option::is_none")]
    path: Option<&'a str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    kind: Option<Kind>,
    character: String,
    framing: crate::config::Framing,
    /// Why it is not open.
    #[serde(skip_serializing_if = "Option::is_none")]
    why: Option<&'a str>,
    /// Nothing that comes is right.
    #[serde(skip_serializing_if = "Option::is_none")]
    doubt: Option<&'a str>,
    notes: &'a [String],
    /// Nobody has the other end of the pseudo-terminal open.
    nobody: bool,
    realtime: bool,
    /// Per mille of the last second that bytes were on the line.
    load_permille: u32,
    /// Times it was opened again after it had gone.
    reopened: u64,
    #[serde(flatten)]
    counters: Counters,
    /// Messages on `tx` without bytes.
    tx_invalid: u64,
    rx_unpublished: u64,
}

struct Service {
    ctx: Context,
    config: Config,
    options: Options,
    rail: Rail,
    tx: Subscriber<SerialChunk>,
    reactor: Reactor,
    alarm: Wake,
    /// What it is set to; `None`: it is not, or has rung.
    alarm_ns: Option<u64>,
    opener: Opener,
    line: Line,
    backoff_ns: u64,
    opened: u64,
    /// Counters of the ports before this one.
    before: Counters,
    tx_invalid: u64,
    why: Option<String>,
    doubt: Doubt,
    doubted: Option<String>,
    notes: Vec<String>,
    realtime: bool,
    answered: bool,
    bytes_seen: u64,
    load_permille: u32,
    events_left: u32,
    more: bool,
}

impl Service {
    fn new(mut ctx: Context, config: Config, options: Options) -> Result<Self, RunError> {
        let service = ctx.service.clone();
        let mut reactor = Reactor::new().map_err(system("making the event loop"))?;
        let alarm = reactor.add_alarm().map_err(system("making the clock"))?;
        let rx = ctx.publisher(&TopicKind::SerialRx.of(&service))?;
        let tx = ctx.subscriber(&TopicKind::SerialTx.of(&service))?;
        Ok(Self {
            rail: Rail { rx, unpublished: 0, silent: false },
            tx,
            ctx,
            config,
            options,
            reactor,
            alarm,
            alarm_ns: None,
            opener: Opener::new().map_err(system("making a pipe"))?,
            line: Line::Closed(0),
            backoff_ns: BACKOFF_NS.0,
            opened: 0,
            before: Counters::default(),
            tx_invalid: 0,
            why: None,
            doubt: Doubt::default(),
            doubted: None,
            notes: Vec::new(),
            realtime: false,
            answered: false,
            bytes_seen: 0,
            load_permille: 0,
            events_left: EVENTS,
            more: false,
        })
    }

    fn run(mut self, mut inbox: Inbox) -> Result<(), RunError> {
        let failed = "setting up the event loop";
        let rail = self.reactor.add(inbox.fd()).map_err(system(failed))?;
        let shutdown = self.reactor.add(self.ctx.shutdown_fd()).map_err(system(failed))?;
        let opened = self.reactor.add(self.opener.bell.0.as_fd()).map_err(system(failed))?;
        let beat = self.reactor.add_timer(BEAT).map_err(system(failed))?;
        self.realtime = sys::realtime(PRIORITY);
        let mut beats = 0u32;
        loop {
            self.work();
            self.arm()?;
            let timeout = self.more.then_some(Duration::ZERO);
            let woken = self.reactor.wait(timeout).map_err(system("waiting"))?;
            let is = |wake| woken.contains(&wake);
            let (port, visitors) = match &self.line {
                Line::Open(open) => (open.wake.is_some_and(is), open.visitors.is_some_and(is)),
                _ => (false, false),
            };
            let (rang, ended, opened, beaten) = (is(rail), is(shutdown), is(opened), is(beat));
            if is(self.alarm) {
                self.alarm_ns = None;
            }
            if ended {
                self.sum_up();
                return Ok(());
            }
            if port {
                self.readable();
            }
            if visitors && let Line::Open(open) = &mut self.line {
                open.driver.visited();
            }
            if rang {
                inbox.drain();
            }
            if opened {
                while let Some(result) = self.opener.result() {
                    self.opened(result)?;
                }
            }
            if beaten {
                beats += 1;
                self.ctx.beat();
                if beats.is_multiple_of(STATUS_BEATS) {
                    self.second();
                }
            }
        }
    }

    fn readable(&mut self) {
        let Line::Open(open) = &mut self.line else { return };
        if let Err(e) = open.driver.readable(clock::mono_ns(), &mut self.rail) {
            self.gone(&e);
        }
    }

    /// Everything that is due now.
    fn work(&mut self) {
        self.more = false;
        if let Line::Closed(at_ns) = self.line
            && clock::mono_ns() >= at_ns
        {
            match self.opener.start(&self.options) {
                Ok(()) => self.line = Line::Opening,
                Err(e) => {
                    tracing::error!("cannot start a thread to open the port: {e}");
                    self.line = Line::Closed(clock::mono_ns() + BACKOFF_NS.1);
                }
            }
        }
        if !matches!(self.line, Line::Open(_)) {
            self.refuse();
        }
        let mut failed = None;
        if let Line::Open(open) = &mut self.line {
            let driver = &mut open.driver;
            self.more = true;
            for _ in 0..LOADS {
                if let Err(e) = driver.turn(clock::mono_ns(), &mut self.rail) {
                    failed = Some(e);
                    break;
                }
                if !driver.is_idle() || !take(&mut self.tx, driver, &mut self.rail, &mut self.tx_invalid) {
                    self.more = false;
                    break;
                }
            }
        }
        if let Some(e) = failed {
            self.gone(&e);
        }
        self.rail.flush();
    }

    /// Without a port nothing is sent, and its writers are told at once. While it is opened for the first time they
    /// wait.
    fn refuse(&mut self) {
        if !self.answered {
            return;
        }
        let now_ns = clock::mono_ns();
        let Self { tx, rail, before, .. } = self;
        tx.drain(LOADS, |message, bytes| {
            before.tx.port_gone += 1;
            rail.not_sent(&head_of(message), bytes, now_ns);
        });
    }

    /// Waits for the port where it can be waited for, and sets the clock.
    fn arm(&mut self) -> Result<(), RunError> {
        let due = match &mut self.line {
            Line::Closed(at_ns) => Some(*at_ns),
            Line::Opening => None,
            Line::Open(open) => {
                let wanted = !open.driver.nobody() && !open.driver.is_full();
                if wanted && open.wake.is_none() {
                    open.wake =
                        Some(self.reactor.add(open.driver.fd()).map_err(system("waiting for the port"))?);
                } else if !wanted && open.wake.take().is_some() {
                    self.reactor.remove(open.driver.fd()).map_err(system("leaving the port"))?;
                }
                open.driver.deadline()
            }
        };
        // A call to the system for each wake-up would be more than the rest of it.
        if self.alarm_ns == due {
            return Ok(());
        }
        self.alarm_ns = due;
        match due {
            Some(at_ns) => self.reactor.set_alarm(self.alarm, at_ns),
            None => self.reactor.set_timer(self.alarm, Duration::ZERO, Duration::ZERO),
        }
        .map_err(system("setting the clock"))
    }

    fn opened(&mut self, result: Result<Port, PortError>) -> Result<(), RunError> {
        let now_ns = clock::mono_ns();
        let first = !self.answered;
        if first {
            self.ctx.ready();
            self.answered = true;
        }
        match result {
            Ok(port) => {
                let kind = port.kind();
                self.opened += 1;
                self.notes = port.notes().to_vec();
                self.why = None;
                self.doubted = None;
                self.doubt.reset(&self.before);
                let message = format!("port {} is open, {}", self.config.device, self.options.character);
                let driver = Driver::new(port, &self.config.settings(kind));
                let visitors = driver.port().visitors();
                let visitors = visitors
                    .map(|fd| self.reactor.add(fd))
                    .transpose()
                    .map_err(system("watching the port"))?;
                let mut open = Open { driver, since_ns: now_ns, wake: None, visitors };
                if visitors.is_some() {
                    open.driver.visited();
                }
                self.line = Line::Open(Box::new(open));
                self.ctx.set_state(HealthState::Ready);
                if first {
                    tracing::info!("{message}");
                } else {
                    self.event(Level::Info, message);
                }
                for note in self.notes.clone() {
                    self.event(Level::Warning, note);
                }
            }
            Err(e) => {
                let text = e.to_string();
                self.ctx.set_state(HealthState::Degraded);
                if self.why.as_deref() != Some(&text) {
                    self.event(Level::Warning, text.clone());
                    self.why = Some(text);
                }
                self.line = Line::Closed(now_ns + self.backoff_ns);
                self.backoff_ns = (self.backoff_ns * 2).min(BACKOFF_NS.1);
            }
        }
        self.publish_status();
        Ok(())
    }

    /// The port is gone: unplugged, hung up.
    fn gone(&mut self, error: &io::Error) {
        let now_ns = clock::mono_ns();
        let Line::Open(open) = std::mem::replace(&mut self.line, Line::Closed(now_ns)) else { return };
        let open = *open;
        if open.wake.is_some() {
            let _ = self.reactor.remove(open.driver.fd());
        }
        let lived_ns = now_ns.saturating_sub(open.since_ns);
        let (port, counters) = open.driver.end(now_ns, &mut self.rail);
        self.before = self.before.plus(&counters);
        close(port);
        if lived_ns >= STEADY_NS {
            self.backoff_ns = BACKOFF_NS.0;
        }
        self.line = Line::Closed(now_ns + self.backoff_ns);
        self.backoff_ns = (self.backoff_ns * 2).min(BACKOFF_NS.1);
        let device = &self.config.device;
        let text = format!(
            "port {device} is gone ({error}): unplugged or hung up; it will be opened again when it is back"
        );
        self.ctx.set_state(HealthState::Degraded);
        self.event(Level::Warning, text.clone());
        self.why = Some(text);
        self.rail.flush();
        self.publish_status();
    }

    fn event(&mut self, level: Level, message: String) {
        if self.events_left > 0 {
            self.events_left -= 1;
            self.ctx.event(EventKind::BusState, level, message, serde_json::Value::Null);
        }
    }

    fn second(&mut self) {
        self.events_left = EVENTS;
        let counters = self.counters();
        let bytes = counters.rx.bytes + counters.tx.bytes + counters.echo.removed;
        let busy_ns = self.config.timing().of(bytes.saturating_sub(self.bytes_seen) as usize);
        self.load_permille = (busy_ns / 1_000_000).min(1000) as u32;
        self.bytes_seen = bytes;
        if matches!(self.line, Line::Open(_)) {
            self.look(&counters);
        }
        self.publish_status();
    }

    /// Tells when nothing that comes is right, and when it is again.
    fn look(&mut self, counters: &Counters) {
        use crate::config::Framing::{Ascii, Rtu};
        let checked = matches!(self.config.framing, Rtu | Ascii);
        match self.doubt.look(counters, checked, clock::mono_ns()) {
            Some(Verdict::Wrong(words)) => {
                let text = format!("port {} ({}): {words}", self.config.device, self.options.character);
                self.ctx.set_state(HealthState::Degraded);
                self.event(Level::Warning, text.clone());
                self.doubted = Some(text);
            }
            Some(Verdict::Right) => {
                self.doubted = None;
                self.ctx.set_state(HealthState::Ready);
                self.event(Level::Info, format!("port {}: frames are right again", self.config.device));
            }
            None => {}
        }
    }

    fn counters(&self) -> Counters {
        match &self.line {
            Line::Open(open) => self.before.plus(&open.driver.counters()),
            _ => self.before,
        }
    }

    fn publish_status(&mut self) {
        let counters = self.counters();
        let port = match &self.line {
            Line::Open(open) => Some(&open.driver),
            _ => None,
        };
        let status = Status {
            state: match self.line {
                Line::Closed(_) => "closed",
                Line::Opening => "opening",
                Line::Open(_) => "open",
            },
            device: &self.config.device,
            number: self.config.number,
            path: port.map(|p| p.port().path()),
            kind: port.map(|p| p.port().kind()),
            character: self.options.character.to_string(),
            framing: self.config.framing,
            why: self.why.as_deref(),
            doubt: self.doubted.as_deref(),
            notes: &self.notes,
            nobody: port.is_some_and(Driver::nobody),
            realtime: self.realtime,
            load_permille: self.load_permille,
            reopened: self.opened.saturating_sub(1),
            counters,
            tx_invalid: self.tx_invalid,
            rx_unpublished: self.rail.unpublished,
        };
        self.ctx.status(&status);
    }

    /// The counters in the log, where they outlive the process.
    fn sum_up(&self) {
        let c = self.counters();
        tracing::info!(
            "in all: {} frames sent, {} received, {} CRC errors, {} fragments, {} not sent, {} collisions; opened {} times",
            c.tx.frames,
            c.rx.frames,
            c.rx.crc_errors,
            c.rx.fragments,
            c.tx.expired + c.tx.line_busy + c.tx.blocked + c.tx.port_gone,
            c.echo.collisions,
            self.opened
        );
    }
}

/// Takes the next transmission from the rail; false when there is none.
fn take(tx: &mut Subscriber<SerialChunk>, driver: &mut Driver, rail: &mut Rail, invalid: &mut u64) -> bool {
    for _ in 0..LOADS {
        let mut loaded = false;
        let taken = tx.drain(1, |message, bytes| {
            let (head, now_ns) = (head_of(message), clock::mono_ns());
            loaded = driver.load(head, bytes, now_ns);
            if !loaded {
                *invalid += 1;
                rail.not_sent(&head, bytes, now_ns);
            }
        });
        if loaded || taken == 0 {
            return loaded;
        }
    }
    false
}
