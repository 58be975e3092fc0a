//! The launcher's own place on the rail: creates and holds every topic, publishes events, reads heartbeats.
//!
//! All of it lives in one helper thread, because a call into the middleware may hang on what a killed process
//! left. The main thread talks to it through channels and an eventfd, counts its turns, and never waits for it.

use super::outbox::Outbox;
use super::watch::{Observed, Observer};
use ipc_types::context::Context;
use ipc_types::event::{EventBody, EventKind, Level};
use ipc_types::payload::{Event, Health, HealthState, event_flag};
use ipc_types::port::{Publisher, Subscriber};
use ipc_types::rail::{self, Held, RailError};
use ipc_types::reactor::Reactor;
use ipc_types::reserve::reserve;
use ipc_types::topic::{EVENTS, TopicKind};
use ipc_types::{Stack, clock};
use rustix::event::{EventfdFlags, eventfd};
use serde_json::Value;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, Sender, SyncSender, channel, sync_channel};
use std::time::{Duration, SystemTime};

/// Heartbeats and orders are looked at so often.
const TURN: Duration = Duration::from_millis(20);
/// The memory of the stack's objects is looked after so often.
const STOCK_NS: u64 = 1_000_000_000;
/// So long after the last change in /dev/shm what was made there has its size.
const SETTLED: Duration = Duration::from_millis(500);
/// Orders that may wait.
const ORDERS_MAX: usize = 1024;
/// Longest message of an event in bytes.
const EVENT_MESSAGE_MAX: usize = 1024;

/// What the main thread asks for.
#[derive(Debug)]
pub enum Order {
    /// Publish an event.
    Tell { service: String, kind: EventKind, level: Level, message: String, detail: Value },
    /// Let go of everything and end.
    Quit,
}

/// A heartbeat that was seen.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Beat {
    pub service: usize,
    pub generation: u32,
    pub state: HealthState,
}

/// What the main thread is told.
#[derive(Debug)]
pub enum Report {
    /// Every topic exists.
    Up,
    /// The rail could not be made.
    Failed(String),
    /// All heartbeats up to `t_ns` were read.
    Turn { t_ns: u64, beats: Vec<Beat>, observed: Option<Box<Observed>> },
    /// Something for the launcher's log.
    Trouble(String),
}

/// The main thread's end.
pub struct RailHandle {
    orders: SyncSender<Order>,
    order_bell: Arc<OwnedFd>,
    pub reports: Receiver<Report>,
    report_bell: Arc<OwnedFd>,
    thread: std::thread::JoinHandle<()>,
}

impl RailHandle {
    /// Starts the thread. The first report is [`Report::Up`] or [`Report::Failed`].
    pub fn start(stack: Stack, observe: bool) -> std::io::Result<Self> {
        let flags = EventfdFlags::CLOEXEC | EventfdFlags::NONBLOCK;
        let (order_bell, report_bell) = (Arc::new(eventfd(0, flags)?), Arc::new(eventfd(0, flags)?));
        let (orders, incoming) = sync_channel(ORDERS_MAX);
        let (outgoing, reports) = channel();
        let mut out = Outgoing { reports: outgoing, bell: report_bell.clone() };
        let bell = order_bell.clone();
        let thread = std::thread::Builder::new().name("rail".into()).spawn(move || {
            if let Err(e) = serve(&stack, observe, &incoming, &bell, &mut out) {
                out.send(Report::Failed(e.to_string()));
            }
        })?;
        Ok(Self { orders, order_bell, reports, report_bell, thread })
    }

    /// Readable when reports wait.
    pub fn bell(&self) -> BorrowedFd<'_> {
        self.report_bell.as_fd()
    }

    /// Resets the bell; take all reports after it.
    pub fn drain_bell(&self) {
        let _ = rustix::io::read(&*self.report_bell, &mut [0u8; 8]);
    }

    /// Hands over an order without waiting; `false` when the thread does not take any more.
    pub fn order(&self, order: Order) -> bool {
        let taken = self.orders.try_send(order).is_ok();
        ring(&self.order_bell);
        taken
    }

    /// Whether the thread has ended.
    pub fn ended(&self) -> bool {
        self.thread.is_finished()
    }
}

fn ring(bell: &OwnedFd) {
    let _ = rustix::io::write(bell, &1u64.to_ne_bytes());
}

struct Outgoing {
    reports: Sender<Report>,
    bell: Arc<OwnedFd>,
}

impl Outgoing {
    fn send(&mut self, report: Report) {
        let _ = self.reports.send(report);
        ring(&self.bell);
    }
}

/// Health topic of one service.
struct Pulse {
    health: Subscriber<Health>,
    writer: u32,
}

fn serve(
    stack: &Stack,
    observe: bool,
    orders: &Receiver<Order>,
    bell: &OwnedFd,
    out: &mut Outgoing,
) -> Result<(), RailError> {
    rail::join(&stack.root)?;
    let node = rail::node("launcher")?;
    let mut held: Vec<Held> = Vec::with_capacity(stack.topics.len());
    for topic in &stack.topics {
        held.push(rail::create_topic(&node, topic)?);
    }
    let mut ctx = Context::observer(&stack.root)?;
    // The launcher is writer 0 of the rail, and the rail's only launcher.
    ctx.service = "launcher".to_owned();
    ctx.writer = 0;
    ctx.generation = 1;
    let mut post = Post { events: ctx.publisher::<Event>(EVENTS)?, told: false };
    let mut outbox = Outbox::new(stack);
    let mut pulses = Vec::with_capacity(stack.services.len());
    for service in &stack.services {
        let health = ctx.subscriber::<Health>(&TopicKind::Health.of(&service.name))?;
        pulses.push(Pulse { health, writer: service.index });
    }
    let mut observer = Observer::new(&ctx, observe)?;
    let mut stock = Stock::default();
    out.send(Report::Up);

    let mut reactor = Reactor::new()?;
    reactor.add(bell.as_fd())?;
    reactor.add_timer(TURN)?;
    let mut beats = Vec::new();
    loop {
        reactor.wait(Some(Duration::from_secs(1)))?;
        let _ = rustix::io::read(bell, &mut [0u8; 8]);
        for order in orders.try_iter() {
            match order {
                Order::Tell { service, kind, level, message, detail } => {
                    let body = EventBody::now(kind, level, &service, message, detail);
                    outbox.note(&body);
                    if let Some(trouble) = post.send(body, 0) {
                        out.send(Report::Trouble(trouble));
                    }
                }
                Order::Quit => {
                    // What services said last, the recorder above all.
                    let observed = observer.look(true).map(Box::new);
                    out.send(Report::Turn { t_ns: clock::mono_ns(), beats: Vec::new(), observed });
                    return Ok(());
                }
            }
        }
        // Before the reading: were this thread stopped after it, nobody would have been silent for so long.
        let t_ns = clock::mono_ns();
        for (service, pulse) in pulses.iter_mut().enumerate() {
            pulse.health.newest(|health, _| {
                if health.stamp.writer == pulse.writer {
                    let state = HealthState::from_u32(health.state);
                    beats.push(Beat { service, generation: health.stamp.generation, state });
                }
            });
        }
        for body in outbox.again(&beats) {
            if let Some(trouble) = post.send(body, event_flag::AGAIN) {
                out.send(Report::Trouble(trouble));
            }
        }
        if let Some(trouble) = stock.take(stack, t_ns) {
            out.send(Report::Trouble(trouble));
        }
        let observed = observer.look(false).map(Box::new);
        out.send(Report::Turn { t_ns, beats: std::mem::take(&mut beats), observed });
    }
}

/// Sets aside the memory of tools that joined, and what there was no room for before.
#[derive(Default)]
struct Stock {
    due_ns: u64,
    /// When something was last made or removed in /dev/shm.
    changed: Option<SystemTime>,
    short: bool,
}

impl Stock {
    /// Something to say when the memory has become short.
    fn take(&mut self, stack: &Stack, now_ns: u64) -> Option<String> {
        let shm = stack.root.parent().filter(|_| now_ns >= self.due_ns)?;
        self.due_ns = now_ns + STOCK_NS;
        // One look at the folder instead of one at each object.
        let changed = shm.metadata().and_then(|m| m.modified()).ok();
        if !self.short && changed.is_some() && changed == self.changed {
            return None;
        }
        let complaint = reserve(shm, &stack.prefix).ok()?.complaint();
        // An object that was made this moment may get its size, or a neighbour of the same time stamp, right afterwards.
        self.changed = changed.filter(|at| at.elapsed().is_ok_and(|age| age >= SETTLED));
        let before = std::mem::replace(&mut self.short, complaint.is_some());
        complaint.filter(|_| !before)
    }
}

/// Publishes events.
struct Post {
    events: Publisher<Event>,
    told: bool,
}

impl Post {
    /// The first failure is returned as text, the others are silent.
    fn send(&mut self, body: EventBody, flags: u32) -> Option<String> {
        let t_ns = body.t_ns;
        let sent = fit(body, self.events.max_tail() as usize).and_then(|text| {
            self.events.send_at(Event { flags, ..Event::default() }, &text, t_ns).map_err(|e| e.to_string())
        });
        self.events.ring();
        let first = sent.is_err() && !std::mem::replace(&mut self.told, true);
        sent.err().filter(|_| first).map(|cause| format!("an event could not be published: {cause}"))
    }
}

/// The event as JSON of at most `max` bytes: old log lines go first, then all of the detail.
fn fit(mut body: EventBody, max: usize) -> Result<Vec<u8>, String> {
    body.message.truncate(body.message.floor_char_boundary(EVENT_MESSAGE_MAX));
    loop {
        let text = serde_json::to_vec(&body).map_err(|e| e.to_string())?;
        let over = text.len().saturating_sub(max);
        if over == 0 {
            return Ok(text);
        }
        if drop_lines(&mut body.detail, over) {
            continue;
        }
        body.detail = match body.detail {
            Value::Null => return Err(format!("{} bytes; at most {max} fit", text.len())),
            Value::String(_) => Value::Null,
            _ => serde_json::json!("left out: too long"),
        };
    }
}

/// Drops the oldest log lines of a detail until so many bytes are gone; `false` when there is none.
fn drop_lines(detail: &mut Value, bytes: usize) -> bool {
    let Some(lines) = detail.get_mut("log").and_then(Value::as_array_mut) else { return false };
    let mut freed = 0;
    let gone = lines.iter().take_while(|line| {
        let needed = freed < bytes;
        // With its quotes and comma.
        freed += line.to_string().len() + 1;
        needed
    });
    let gone = gone.count();
    lines.drain(..gone);
    gone > 0
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn of_a_long_death_the_last_words_are_kept() {
        let lines: Vec<String> = (0..20).map(|i| format!("{i} \"{}", "x".repeat(150))).collect();
        let body = |detail| EventBody::now(EventKind::Died, Level::Fault, "plc", "died", detail);
        let text = fit(body(json!({ "exit_code": 1, "log": lines })), 2048).unwrap();
        assert!(text.len() > 1700 && text.len() <= 2048, "{}", text.len());
        let told: EventBody = serde_json::from_slice(&text).unwrap();
        let log = told.detail["log"].as_array().unwrap();
        assert_eq!(log.last().unwrap(), lines.last().unwrap());
        assert_eq!(told.detail["exit_code"], 1);
        let long = fit(body(json!({ "text": "x".repeat(4000) })), 2048).unwrap();
        let told: EventBody = serde_json::from_slice(&long).unwrap();
        assert_eq!(told.detail, "left out: too long");
        assert!(fit(body(Value::Null), 20).is_err());
    }
}
