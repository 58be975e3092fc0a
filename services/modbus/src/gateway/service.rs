//! The process: connections of masters, ports of lines, the loop.
//!
//! One thread. A connection is a task: it reads frames, hands each to the [`Core`] and writes what is answered at
//! once; answers from lines are written by the loop itself, so that they wait for no other task.

use super::cache::Cache;
use super::config::{Config, Plan};
use super::core::{Core, GatewayCounters, GatewayStep};
use crate::admission::Admission;
use crate::client::alarm::Alarm;
use crate::client::ask::exception_words;
use crate::client::line::{LineCounters, UnitCounters, UnitState};
use crate::client::port::{Incoming, SerialPort};
use crate::client::wiring::check_serial;
use crate::protocol::mbap::{self, MAX_RECEIVED, Scan};
use crate::readable;
use ipc_types::event::{EventKind, Level};
use ipc_types::net::Seldom;
use ipc_types::rail::RailError;
use ipc_types::stack::ServiceEntry;
use ipc_types::topic::TopicKind;
use ipc_types::wiring::{Listener, Neighbours};
use ipc_types::{Context, Finding, Stack, Wiring, clock};
use serde::Serialize;
use serde_json::Value;
use std::cell::{Cell, RefCell};
use std::io;
use std::net::SocketAddr;
use std::rc::Rc;
use std::time::Duration;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::Notify;
use tokio::time::MissedTickBehavior;

/// Kind of the service in stack files.
pub const KIND: &str = "modbus-gateway";
const LISTENER: &str = "tcp";
const BEAT: Duration = Duration::from_millis(50);
const STATUS_BEATS: u32 = 20;
/// A master that does not take its answers for so long is cut off.
const WRITE_LIMIT: Duration = Duration::from_secs(5);
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);
/// Bytes of a connection's buffers: 16 requests and their answers.
const BUFFER: usize = 16 * MAX_RECEIVED;
/// Masters and units shown in the status.
const SHOWN: usize = 32;

/// Why the service ended.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    #[error(transparent)]
    Rail(#[from] RailError),
    #[error("modbus-gateway: {what}: {source}")]
    System { what: &'static str, source: io::Error },
    #[error("modbus-gateway: {key}: {message}; run `dinrail check`")]
    Config { key: String, message: String },
}

fn system(what: &'static str) -> impl Fn(io::Error) -> RunError {
    move |source| RunError::System { what, source }
}

/// What the service needs of the launcher.
pub fn topics(config: &Config, _neighbours: &Neighbours) -> Wiring {
    let mut wiring = Wiring::default();
    for port in config.plan().ports {
        wiring.read(TopicKind::SerialRx.of(&port.serial), true, &port.key);
        wiring.write(TopicKind::SerialTx.of(&port.serial), &port.key);
    }
    let address = SocketAddr::new(config.tcp.address, config.tcp.port);
    wiring.listeners.push(Listener { name: LISTENER.to_owned(), address, key: "tcp.port".to_owned() });
    wiring
}

/// Every mistake that can be found without starting.
pub fn check(config: &Config, stack: &Stack, me: &ServiceEntry) -> Vec<Finding> {
    let plan = config.plan();
    let mut found: Vec<Finding> =
        plan.mistakes.iter().map(|m| Finding::error(&me.name, &m.key, &m.message, &m.help)).collect();
    for port in &plan.ports {
        found.extend(check_serial(&me.name, &port.key, &port.serial, port.ascii, stack));
    }
    if config.tcp.filter.is_none() && !config.tcp.address.is_loopback() {
        found.push(Finding::warning(
            &me.name,
            "tcp",
            "Modbus has no passwords: whoever reaches this port can write to every unit of the line",
            "add filter = { mask = ..., start = ..., end = ... }, or address = \"127.0.0.1\"",
        ));
    }
    found
}

struct Client {
    id: u64,
    peer: SocketAddr,
    since_ns: u64,
    stream: TcpStream,
    /// Answers that the socket did not take yet.
    pending: RefCell<Vec<u8>>,
    /// Rung when there are such, or the connection is to be closed.
    wake: Notify,
    closing: Cell<bool>,
    requests: Cell<u64>,
    last_ns: Cell<u64>,
}

impl Client {
    /// Writes now what the socket takes; the rest waits for the connection's task.
    fn answer(&self, transaction: u16, unit: u8, pdu: &[u8]) {
        let mut frame = [0; mbap::MAX_ADU];
        let Some(len) = mbap::encode(transaction, unit, pdu, &mut frame) else { return };
        let mut pending = self.pending.borrow_mut();
        let mut done = 0;
        if pending.is_empty() {
            done = self.stream.try_write(&frame[..len]).unwrap_or(0);
        }
        if done < len {
            pending.extend_from_slice(&frame[done..len]);
            self.wake.notify_one();
        }
    }
}

struct Shared {
    core: RefCell<Core>,
    clients: RefCell<Vec<Rc<Client>>>,
    /// Something was queued for a line.
    queued: Notify,
    config: Config,
    admission: Admission,
    next_client: Cell<u64>,
    accepted: Cell<u64>,
    refused: Cell<u64>,
    events: RefCell<Vec<(Level, String)>>,
}

/// Events kept from one beat to the next.
const MAX_EVENTS: usize = 8;

impl Shared {
    fn event(&self, level: Level, message: String) {
        let mut events = self.events.borrow_mut();
        if events.len() < MAX_EVENTS {
            events.push((level, message));
        }
    }

    async fn accept(self: Rc<Self>, listener: TcpListener) {
        let mut seldom = Seldom::default();
        loop {
            match listener.accept().await {
                Ok((stream, peer)) => self.admit(stream, peer),
                Err(error) => {
                    if let Some(untold) = seldom.failed(clock::mono_ns()) {
                        tracing::warn!(%error, untold, "accepting a Modbus connection failed; told every 10 s");
                    }
                    tokio::time::sleep(ACCEPT_PAUSE).await;
                }
            }
        }
    }

    fn admit(self: &Rc<Self>, stream: TcpStream, peer: SocketAddr) {
        let refuse = |why: &str| {
            self.refused.set(self.refused.get() + 1);
            self.event(Level::Warning, format!("Modbus master {peer} refused: {why}"));
        };
        if !self.admission.allows(peer.ip()) {
            return refuse("its address is outside tcp.filter");
        }
        if self.clients.borrow().len() >= self.config.tcp.max_connections as usize && !self.make_room() {
            return refuse("tcp.max_connections are in use");
        }
        // Without it Nagle's algorithm and delayed acknowledgement cost 40 ms a round.
        if stream.set_nodelay(true).is_err() {
            return;
        }
        self.accepted.set(self.accepted.get() + 1);
        let id = self.next_client.get();
        self.next_client.set(id + 1);
        let now_ns = clock::mono_ns();
        let client = Rc::new(Client {
            id,
            peer,
            since_ns: now_ns,
            stream,
            pending: RefCell::new(Vec::new()),
            wake: Notify::new(),
            closing: Cell::new(false),
            requests: Cell::new(0),
            last_ns: Cell::new(now_ns),
        });
        self.event(Level::Info, format!("Modbus master {peer} connected"));
        self.clients.borrow_mut().push(client.clone());
        let shared = self.clone();
        tokio::task::spawn_local(async move {
            shared.serve(&client).await;
            shared.clients.borrow_mut().retain(|other| !Rc::ptr_eq(other, &client));
            shared.core.borrow_mut().client_gone(client.id);
            shared.event(
                Level::Info,
                format!("Modbus master {peer} left after {} requests", client.requests.get()),
            );
        });
    }

    /// Closes the connection idle for longest, if the configuration wants it and it is idle for a second.
    fn make_room(&self) -> bool {
        if self.config.tcp.when_full != crate::tcp::WhenFull::CloseOldestIdle {
            return false;
        }
        let mut clients = self.clients.borrow_mut();
        let oldest = clients.iter().enumerate().min_by_key(|(_, client)| client.last_ns.get());
        let Some((index, client)) = oldest else { return false };
        if clock::mono_ns().saturating_sub(client.last_ns.get()) < 1_000_000_000 {
            return false;
        }
        client.closing.set(true);
        client.wake.notify_one();
        clients.remove(index);
        true
    }

    async fn serve(&self, client: &Client) {
        let mut buffer = vec![0; BUFFER];
        let mut filled = 0;
        loop {
            tokio::select! {
                biased;
                () = client.wake.notified() => {
                    if client.closing.get() || flush(client).await.is_err() {
                        return;
                    }
                    continue;
                }
                ready = client.stream.readable() => {
                    if ready.is_err() {
                        return;
                    }
                }
            }
            match client.stream.try_read(&mut buffer[filled..]) {
                Ok(0) => return,
                Ok(n) => filled += n,
                Err(e) if matches!(e.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::Interrupted) => {
                    continue;
                }
                Err(_) => return,
            }
            let Some(used) = self.requests(client, &buffer[..filled]) else { return };
            buffer.copy_within(used..filled, 0);
            filled -= used;
            if !client.pending.borrow().is_empty() && flush(client).await.is_err() {
                return;
            }
        }
    }

    /// Handles the frames of a buffer; bytes used, or `None`: the stream makes no sense any more.
    fn requests(&self, client: &Client, bytes: &[u8]) -> Option<usize> {
        let mut used = 0;
        let mut any = false;
        let now_ns = clock::mono_ns();
        client.last_ns.set(now_ns);
        let end = loop {
            match mbap::scan(&bytes[used..]) {
                Scan::Incomplete => break Some(used),
                Scan::BadLength { .. } => break None,
                Scan::Foreign { used: n } => used += n,
                Scan::Frame { frame, used: n } => {
                    used += n;
                    client.requests.set(client.requests.get() + 1);
                    let mut core = self.core.borrow_mut();
                    match core.request(client.id, frame.transaction, frame.unit, frame.pdu, now_ns) {
                        Some(pdu) => {
                            // Collected, so that several answers leave in one segment.
                            let mut out = [0; mbap::MAX_ADU];
                            if let Some(len) = mbap::encode(frame.transaction, frame.unit, pdu, &mut out) {
                                client.pending.borrow_mut().extend_from_slice(&out[..len]);
                            }
                        }
                        None => any = true,
                    }
                }
            }
        };
        if any {
            self.queued.notify_one();
        }
        end
    }
}

/// Writes what waits for a client.
async fn flush(client: &Client) -> io::Result<()> {
    loop {
        {
            let mut pending = client.pending.borrow_mut();
            if pending.is_empty() {
                return Ok(());
            }
            match client.stream.try_write(&pending) {
                Ok(n) => {
                    pending.drain(..n);
                    continue;
                }
                Err(e) if e.kind() == io::ErrorKind::WouldBlock => {}
                Err(e) if e.kind() == io::ErrorKind::Interrupted => continue,
                Err(e) => return Err(e),
            }
        }
        tokio::time::timeout(WRITE_LIMIT, client.stream.writable())
            .await
            .map_err(|_| io::Error::from(io::ErrorKind::TimedOut))??;
    }
}

#[derive(Serialize)]
struct UnitRow {
    unit: u8,
    state: UnitState,
    counters: UnitCounters,
    #[serde(skip_serializing_if = "Option::is_none")]
    last_exception: Option<String>,
    rtt_us: Option<u64>,
    max_rtt_us: u64,
}

#[derive(Serialize)]
struct LineRow {
    serial: String,
    waiting: usize,
    counters: LineCounters,
    units: Vec<UnitRow>,
}

#[derive(Serialize)]
struct ClientRow {
    address: String,
    port: u16,
    connected_s: u64,
    idle_s: u64,
    requests: u64,
}

#[derive(Serialize)]
struct Status {
    listen: Option<SocketAddr>,
    clients: usize,
    client_list: Vec<ClientRow>,
    accepted: u64,
    refused: u64,
    counters: GatewayCounters,
    lines: Vec<LineRow>,
}

struct Service {
    ctx: Context,
    shared: Rc<Shared>,
    ports: Vec<SerialPort>,
    names: Vec<String>,
    /// Ports that were told not to work.
    broken: Vec<bool>,
    listen: Option<SocketAddr>,
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
    let config: Config = ctx.config()?;
    let Plan { ports, routes, cache, rules, mistakes } = config.plan();
    if let Some(mistake) = mistakes.into_iter().next() {
        return Err(RunError::Config { key: mistake.key, message: mistake.message });
    }
    let mut inbox = ctx.inbox()?;
    let inbox_fd = inbox.fd().try_clone_to_owned().map_err(system("duplicating the inbox"))?;
    let inbox_fd = readable::watch(inbox_fd).map_err(system("watching the inbox"))?;
    let shutdown = ctx.shutdown_fd().try_clone_to_owned().map_err(system("duplicating a descriptor"))?;
    let shutdown = readable::watch(shutdown).map_err(system("watching the shutdown descriptor"))?;
    let mut alarm = Alarm::new().map_err(system("making a clock"))?;
    let mut open = Vec::with_capacity(ports.len());
    for port in &ports {
        let rx = ctx.subscriber(&TopicKind::SerialRx.of(&port.serial))?;
        let tx = ctx.publisher(&TopicKind::SerialTx.of(&port.serial))?;
        open.push(SerialPort::new(tx, rx, port.ascii, ctx.writer, ctx.generation));
    }
    let setups: Vec<_> = ports.iter().map(|port| port.setup).collect();
    let core = Core::new(rules, &setups, routes, Cache::new(&cache));
    let listener = std::net::TcpListener::from(ctx.take_fd(LISTENER)?);
    listener.set_nonblocking(true).map_err(system("preparing the listener"))?;
    let listener = TcpListener::from_std(listener).map_err(system("watching the listener"))?;
    let listen = listener.local_addr().ok();
    let shared = Rc::new(Shared {
        core: RefCell::new(core),
        clients: RefCell::new(Vec::new()),
        queued: Notify::new(),
        admission: Admission::new(config.tcp.filter.as_ref()),
        config,
        next_client: Cell::new(1),
        accepted: Cell::new(0),
        refused: Cell::new(0),
        events: RefCell::new(Vec::new()),
    });
    tokio::task::spawn_local(shared.clone().accept(listener));
    let names: Vec<String> = ports.into_iter().map(|port| port.serial).collect();
    let broken = vec![false; names.len()];
    let mut service = Service { ctx, shared, ports: open, names, broken, listen };
    service.status();
    service.ctx.ready();
    let shared = service.shared.clone();
    let mut beat = tokio::time::interval(BEAT);
    beat.set_missed_tick_behavior(MissedTickBehavior::Skip);
    let mut beats = 0u32;
    loop {
        tokio::select! {
            biased;
            _ = shutdown.readable() => return Ok(()),
            ready = inbox_fd.readable() => {
                // First cleared, then drained: what rings in between is an edge again.
                ready.map_err(system("waiting for the rail"))?.clear_ready();
                inbox.drain();
            }
            () = shared.queued.notified() => {}
            rang = alarm.rang() => rang.map_err(system("reading a clock"))?,
            _ = beat.tick() => {
                beats += 1;
                service.beat(beats);
            }
        }
        let next_ns = service.turn();
        alarm.set(next_ns).map_err(system("setting a clock"))?;
    }
}

impl Service {
    /// Takes what came from the lines and sends what is due; when to come again.
    fn turn(&mut self) -> Option<u64> {
        let mut more = false;
        let mut next_ns: Option<u64> = None;
        for line in 0..self.ports.len() {
            let shared = self.shared.clone();
            let (port, broken) = (&mut self.ports[line], &mut self.broken[line]);
            more |= !port.drain(|incoming| {
                let mut core = shared.core.borrow_mut();
                match incoming {
                    Incoming::Sent { t_ns } => {
                        *broken = false;
                        core.sent(line, t_ns);
                    }
                    Incoming::NotSent => {
                        *broken = true;
                        core.link_failed(line, clock::mono_ns());
                    }
                    Incoming::Frame { unit, pdu, t_ns } => core.answer(line, unit, pdu, t_ns),
                    Incoming::Garbage => core.garbage(line),
                }
            });
            next_ns = next_ns.into_iter().chain(self.pump(line)).min();
        }
        if more { Some(1) } else { next_ns }
    }

    fn pump(&mut self, line: usize) -> Option<u64> {
        let shared = self.shared.clone();
        let mut core = shared.core.borrow_mut();
        loop {
            let now_ns = clock::mono_ns();
            match core.step(line, now_ns) {
                GatewayStep::Wait(until) => return until,
                GatewayStep::Send { unit, pdu } => {
                    if let Err(e) = self.ports[line].send(unit, pdu, now_ns) {
                        if !self.broken[line] {
                            tracing::warn!("{e}");
                        }
                        self.broken[line] = true;
                        core.link_failed(line, now_ns);
                    }
                }
                GatewayStep::Reply { client, transaction, unit, pdu } => {
                    let clients = shared.clients.borrow();
                    if let Some(client) = clients.iter().find(|c| c.id == client) {
                        client.answer(transaction, unit, pdu);
                    }
                }
            }
        }
    }

    fn beat(&mut self, beats: u32) {
        self.ctx.beat();
        let events: Vec<_> = self.shared.events.borrow_mut().drain(..).collect();
        for (level, message) in events {
            self.ctx.event(EventKind::Client, level, message, Value::Null);
        }
        if beats.is_multiple_of(STATUS_BEATS) {
            self.sweep();
            self.status();
        }
    }

    /// Closes connections that were idle for too long.
    fn sweep(&self) {
        let limit_ns = self.shared.config.tcp.idle_timeout.ns();
        if limit_ns == 0 {
            return;
        }
        let now_ns = clock::mono_ns();
        for client in self.shared.clients.borrow().iter() {
            if now_ns.saturating_sub(client.last_ns.get()) >= limit_ns {
                client.closing.set(true);
                client.wake.notify_one();
            }
        }
    }

    fn status(&mut self) {
        let now_ns = clock::mono_ns();
        let status = {
            let core = self.shared.core.borrow();
            let clients = self.shared.clients.borrow();
            let seconds = |since_ns| now_ns.saturating_sub(since_ns) / 1_000_000_000;
            let mut left = SHOWN;
            Status {
                listen: self.listen,
                clients: clients.len(),
                client_list: clients
                    .iter()
                    .take(SHOWN)
                    .map(|client| ClientRow {
                        address: client.peer.ip().to_canonical().to_string(),
                        port: client.peer.port(),
                        connected_s: seconds(client.since_ns),
                        idle_s: seconds(client.last_ns.get()),
                        requests: client.requests.get(),
                    })
                    .collect(),
                accepted: self.shared.accepted.get(),
                refused: self.shared.refused.get(),
                counters: core.counters(),
                lines: (0..self.names.len())
                    .map(|line| line_row(&core, line, &self.names[line], &mut left))
                    .collect(),
            }
        };
        self.ctx.status(&status);
    }
}

fn line_row(core: &Core, line: usize, name: &str, left: &mut usize) -> LineRow {
    let units: Vec<UnitRow> = core
        .units(line)
        .take(*left)
        .map(|view| UnitRow {
            unit: view.unit,
            state: view.state,
            counters: view.counters,
            last_exception: view.last_exception.map(|code| exception_words(code, 0)),
            rtt_us: view.last_rtt_ns.map(|ns| ns / 1000),
            max_rtt_us: view.max_rtt_ns / 1000,
        })
        .collect();
    *left -= units.len();
    LineRow {
        serial: name.to_owned(),
        waiting: core.waiting(line),
        counters: core.line_counters(line),
        units,
    }
}
