//! The process: connections of masters, ports of lines, the loop.
//!
//! One thread. A connection is a task: it reads frames, hands each to the [`Core`] and writes what is answered at
//! once; answers from lines are written by the loop itself, so that they wait for no other task.

use super::cache::Cache;
use super::config::{Config, Plan};
use super::core::{Core, GatewayStep};
use super::masters::Shared;
use crate::client::alarm::Alarm;
use crate::client::line::UnitNews;
use crate::client::port::{Incoming, SerialPort};
pub use crate::process::RunError;
use crate::process::{Wake, Wakes, listener, run_here};
use ipc_types::event::{Budget, EventKind, Level};
use ipc_types::payload::HealthState;
use ipc_types::topic::TopicKind;
use ipc_types::turns::STATUS_BEATS;
use ipc_types::{Context, clock};
use serde_json::Value;
use std::net::SocketAddr;
use std::rc::Rc;

/// Kind of the service in stack files.
pub const KIND: &str = "modbus-gateway";
/// Events a second about units and lines that go to the rail.
const EVENTS_A_SECOND: u32 = 20;
pub(super) const LISTENER: &str = "tcp";

pub(super) struct Service {
    pub(super) ctx: Context,
    pub(super) shared: Rc<Shared>,
    ports: Vec<SerialPort>,
    pub(super) names: Vec<String>,
    /// Why a port does not work.
    broken: Vec<Option<String>>,
    state: HealthState,
    events: Budget,
    pub(super) listen: Option<SocketAddr>,
}

/// Runs until the launcher says stop.
pub fn run(ctx: Context) -> Result<(), RunError> {
    run_here(serve(ctx), RunError::system(KIND, "starting the runtime"))
}

async fn serve(mut ctx: Context) -> Result<(), RunError> {
    let config: Config = ctx.config()?;
    let Plan { ports, routes, cache, rules, mistakes } = config.plan();
    if let Some(mistake) = mistakes.into_iter().next() {
        return Err(RunError::Config { kind: KIND, key: mistake.key, message: mistake.message });
    }
    let mut wakes = Wakes::new(KIND, &mut ctx)?;
    let mut alarm = Alarm::new().map_err(RunError::system(KIND, "making a clock"))?;
    let mut open = Vec::with_capacity(ports.len());
    for port in &ports {
        let rx = ctx.subscriber(&TopicKind::SerialRx.of(&port.serial))?;
        let tx = ctx.publisher(&TopicKind::SerialTx.of(&port.serial))?;
        open.push(SerialPort::new(tx, rx, port.ascii, ctx.writer, ctx.generation));
    }
    let setups: Vec<_> = ports.iter().map(|port| port.setup).collect();
    let core = Core::new(rules, &setups, routes, Cache::new(&cache));
    let (listener, listen) = listener(KIND, &mut ctx, LISTENER)?;
    let shared = Shared::new(core, config);
    tokio::task::spawn_local(shared.clone().accept(listener));
    let names: Vec<String> = ports.into_iter().map(|port| port.serial).collect();
    let broken = vec![None; names.len()];
    let (state, events) = (HealthState::Ready, Budget::new(EVENTS_A_SECOND));
    let mut service = Service { ctx, shared, ports: open, names, broken, state, events, listen };
    service.status();
    service.ctx.ready();
    let shared = service.shared.clone();
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
            () = shared.queued.notified() => {}
            rang = alarm.rang() => rang.map_err(RunError::system(KIND, "reading a clock"))?,
        }
        let next_ns = service.turn();
        alarm.set(next_ns).map_err(RunError::system(KIND, "setting a clock"))?;
    }
}

impl Service {
    /// Takes what came from the lines and sends what is due; when to come again.
    fn turn(&mut self) -> Option<u64> {
        let mut more = false;
        let mut next_ns: Option<u64> = None;
        for line in 0..self.ports.len() {
            let shared = self.shared.clone();
            let port = &mut self.ports[line];
            // Whether the last request has left.
            let mut left = None;
            more |= !port.drain(|incoming| {
                let mut core = shared.core.borrow_mut();
                match incoming {
                    Incoming::Sent { t_ns } => {
                        left = Some(true);
                        core.sent(line, t_ns);
                    }
                    Incoming::NotSent => {
                        left = Some(false);
                        core.link_failed(line, clock::mono_ns());
                    }
                    Incoming::Frame { unit, pdu, t_ns } => core.answer(line, unit, pdu, t_ns),
                    Incoming::Garbage => core.garbage(line),
                }
            });
            match left {
                Some(true) => self.line_state(line, None),
                Some(false) => self.line_state(line, Some("the serial port does not work; see its status")),
                None => {}
            }
            next_ns = next_ns.into_iter().chain(self.pump(line)).min();
            self.tell_units(line);
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
                        core.link_failed(line, now_ns);
                        self.line_state(line, Some(&e.to_string()));
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

    /// Units that have gone or come back: each told once.
    fn tell_units(&mut self, line: usize) {
        let shared = self.shared.clone();
        while let Some(UnitNews { unit, dead, .. }) = shared.core.borrow_mut().unit_news(line) {
            let name = &self.names[line];
            let (level, message) = if dead {
                (
                    Level::Warning,
                    format!(
                        "unit {unit} on {name} does not answer; masters get exception 0B at once, and it is tried again from time to time"
                    ),
                )
            } else {
                (Level::Info, format!("unit {unit} on {name} answers again"))
            };
            self.tell(level, message);
        }
    }

    /// Whether a line works, and why not: told when it changes.
    fn line_state(&mut self, line: usize, why: Option<&str>) {
        if self.broken[line].as_deref() == why {
            return;
        }
        self.broken[line] = why.map(str::to_owned);
        let name = &self.names[line];
        let (level, message) = match why {
            Some(why) => (Level::Warning, format!("{name}: {why}; masters get exception 0A meanwhile")),
            None => (Level::Info, format!("{name} works again")),
        };
        self.tell(level, message);
        let broken = self.broken.iter().any(Option::is_some);
        let state = if broken { HealthState::Degraded } else { HealthState::Ready };
        if std::mem::replace(&mut self.state, state) != state {
            self.ctx.set_state(state);
        }
    }

    fn tell(&mut self, level: Level, message: String) {
        if self.events.take() {
            self.ctx.event(EventKind::BusState, level, message, Value::Null);
        }
    }

    fn beat(&mut self, beats: u32) {
        self.ctx.beat();
        let events: Vec<_> = self.shared.events.borrow_mut().drain(..).collect();
        for (level, message) in events {
            self.ctx.event(EventKind::Client, level, message, Value::Null);
        }
        if beats.is_multiple_of(STATUS_BEATS) {
            if let Some(left_out) = self.events.renew() {
                let message = format!("{left_out} more changes in the last second left out");
                self.ctx.event(EventKind::BusState, Level::Warning, message, Value::Null);
            }
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
}
