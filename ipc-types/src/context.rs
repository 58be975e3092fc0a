//! What a service's `run` receives: its configuration, its ports, its inherited descriptors, its voice.

use crate::event::{EventBody, EventKind, Level};
use crate::inbox::{Bell, Inbox};
use crate::payload::{Event, Health, HealthState, Payload, Status};
use crate::port::{Publisher, RawSubscriber, Subscriber, raw_subscriber};
use crate::rail::{self, RailError, STACK_FILE, Svc};
use crate::reactor::signals;
use crate::reserve::reserve;
use crate::stack::{ServiceEntry, Stack, TopicEntry};
use crate::topic::{EVENTS, TopicKind};
use iceoryx2::node::Node;
use serde::de::DeserializeOwned;
use std::collections::BTreeMap;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::path::Path;
use std::rc::Rc;

/// A process on the rail.
pub struct Context {
    /// The resolved stack.
    pub stack: Rc<Stack>,
    /// Name of this service; of an observer: `pid N`.
    pub service: String,
    /// Writer number on the rail.
    pub writer: u32,
    /// 1 at the first start, one more at each restart.
    pub generation: u32,
    fds: BTreeMap<String, OwnedFd>,
    shutdown: OwnedFd,
    bells: BTreeMap<String, Rc<Bell>>,
    events: Publisher<Event>,
    health: Option<Publisher<Health>>,
    status: Option<Publisher<Status>>,
    state: HealthState,
    turns: u64,
    // Last, so that the ports are gone before their node.
    node: Node<Svc>,
}

impl Context {
    /// Joins as a service of the stack. Blocks SIGTERM and SIGINT: call before any thread starts.
    pub fn service(
        root: &Path,
        service: &str,
        generation: u32,
        fds: BTreeMap<String, OwnedFd>,
    ) -> Result<Self, RailError> {
        let stack = load(root)?;
        let Some(entry) = stack.service(service) else {
            return Err(RailError::Stack {
                path: root.join(STACK_FILE),
                message: format!("it has no service '{service}'"),
            });
        };
        let writer = entry.index;
        let mut ctx = Self::join(root, stack.clone(), service, writer, generation, fds)?;
        ctx.health = Some(ctx.publisher(&TopicKind::Health.of(service))?);
        ctx.status = Some(ctx.publisher(&TopicKind::Status.of(service))?);
        ctx.beat();
        Ok(ctx)
    }

    /// Joins as a command-line tool or console: reads what it likes, writes into spare slots, has no inbox.
    pub fn observer(root: &Path) -> Result<Self, RailError> {
        let stack = load(root)?;
        let pid = std::process::id();
        let generation = observer_generation(crate::clock::mono_ns());
        Self::join(root, stack, &format!("pid {pid}"), 0x8000_0000 | pid, generation, BTreeMap::new())
    }

    fn join(
        root: &Path,
        stack: Rc<Stack>,
        service: &str,
        writer: u32,
        generation: u32,
        fds: BTreeMap<String, OwnedFd>,
    ) -> Result<Self, RailError> {
        let shutdown = signals::descriptor(&[libc::SIGTERM, libc::SIGINT])?;
        rail::join(root)?;
        let node = rail::node(service)?;
        let events = Publisher::new(&node, find(&stack, EVENTS)?, Vec::new(), writer, generation)?;
        Ok(Self {
            stack,
            service: service.to_owned(),
            writer,
            generation,
            fds,
            shutdown,
            bells: BTreeMap::new(),
            events,
            health: None,
            status: None,
            state: HealthState::Starting,
            turns: 0,
            node,
        })
    }

    /// This service's row of the stack; `None` for an observer.
    pub fn entry(&self) -> Option<&ServiceEntry> {
        self.stack.service(&self.service)
    }

    /// The service's own table of the stack file. `check` has already accepted it.
    pub fn config<C: DeserializeOwned>(&self) -> Result<C, RailError> {
        let value = self.entry().map_or(serde_json::Value::Null, |e| e.config.clone());
        serde_json::from_value(value).map_err(|e| RailError::Stack {
            path: self.stack.root.join(STACK_FILE),
            message: format!("service '{}': {e}", self.service),
        })
    }

    /// A writer of a topic; its [`Publisher::ring`] wakes the topic's consumers.
    pub fn publisher<H: Payload>(&mut self, topic: &str) -> Result<Publisher<H>, RailError> {
        let stack = self.stack.clone();
        let entry = find(&stack, topic)?;
        let mut bells = Vec::with_capacity(entry.wakes.len());
        for wake in &entry.wakes {
            bells.push(self.bell(wake)?);
        }
        Publisher::new(&self.node, entry, bells, self.writer, self.generation)
    }

    fn bell(&mut self, service: &str) -> Result<Rc<Bell>, RailError> {
        if let Some(bell) = self.bells.get(service) {
            return Ok(bell.clone());
        }
        let bell = Rc::new(Bell::open(&self.stack.root, service)?);
        self.bells.insert(service.to_owned(), bell.clone());
        Ok(bell)
    }

    /// A reader of a topic.
    pub fn subscriber<H: Payload>(&self, topic: &str) -> Result<Subscriber<H>, RailError> {
        Subscriber::new(&self.node, find(&self.stack, topic)?)
    }

    /// A reader of a topic of any payload.
    pub fn raw_subscriber(&self, topic: &str) -> Result<Box<dyn RawSubscriber>, RailError> {
        raw_subscriber(&self.node, find(&self.stack, topic)?)
    }

    /// This service's inbox.
    pub fn inbox(&self) -> Result<Inbox, RailError> {
        Inbox::open(&self.stack.root, &self.service)
    }

    /// Takes over an inherited descriptor: a listener or the retain memory.
    pub fn take_fd(&mut self, name: &str) -> Result<OwnedFd, RailError> {
        self.fds.remove(name).ok_or_else(|| RailError::NoDescriptor(name.to_owned()))
    }

    /// Readable when the service shall end: finish what is begun, go safe, return from `run` within 1 s.
    pub fn shutdown_fd(&self) -> BorrowedFd<'_> {
        self.shutdown.as_fd()
    }

    /// Says that the service works now; call once after the last port is open. Its memory is set aside before that: from
    /// now on a full /dev/shm does it no harm.
    pub fn ready(&mut self) {
        if let Some(shm) = self.stack.root.parent()
            && let Ok(reserved) = reserve(shm, &self.stack.prefix)
            && let Some(complaint) = reserved.complaint()
        {
            self.event(EventKind::NoRoom, Level::Fault, complaint, serde_json::Value::Null);
        }
        self.set_state(HealthState::Ready);
    }

    /// Says how the service is, with the next heartbeat and at once.
    pub fn set_state(&mut self, state: HealthState) {
        self.state = state;
        self.beat();
    }

    /// Heartbeat: at least every 100 ms, from the thread that does the work, never from a helper thread.
    pub fn beat(&mut self) {
        self.turns += 1;
        let health = Health {
            pid: std::process::id(),
            state: self.state as u32,
            turns: self.turns,
            ..Health::default()
        };
        if let Some(port) = &mut self.health {
            let _ = port.send(health);
            port.ring();
        }
    }

    /// Publishes counters and peers, about once a second and on change. At most 16 KiB as JSON; larger ones
    /// are replaced by a note.
    pub fn status(&mut self, status: &impl serde::Serialize) {
        if let Some(port) = &mut self.status {
            let text =
                serde_json::to_vec(status).unwrap_or_else(|e| format!("{{\"error\":\"{e}\"}}").into_bytes());
            if text.len() > port.max_tail() as usize {
                let _ = port.send_tail(Status::default(), b"{\"error\":\"status above its limit\"}");
            } else {
                let _ = port.send_tail(Status::default(), &text);
            }
        }
    }

    /// Tells everybody, and the recording, that something happened. Also a log line.
    pub fn event(
        &mut self,
        kind: EventKind,
        level: Level,
        message: impl Into<String>,
        detail: serde_json::Value,
    ) {
        let service = self.service.clone();
        self.event_about(&service, kind, level, message, detail);
    }

    /// [`Self::event`] about another service (the launcher, the engine about an input's owner).
    pub fn event_about(
        &mut self,
        service: &str,
        kind: EventKind,
        level: Level,
        message: impl Into<String>,
        detail: serde_json::Value,
    ) {
        let mut body = EventBody::now(kind, level, service, message, detail);
        match level {
            Level::Info => tracing::info!("{}", body.message),
            Level::Warning => tracing::warn!("{}", body.message),
            Level::Fault => tracing::error!("{}", body.message),
        }
        let text = fit(&mut body, self.events.max_tail() as usize);
        let _ = self.events.send_tail(Event::default(), &text);
        self.events.ring();
    }
}

/// The event as JSON of at most `max` bytes: the detail goes first, then the end of the message.
fn fit(body: &mut EventBody, max: usize) -> Vec<u8> {
    let mut text = serde_json::to_vec(body).unwrap_or_default();
    if text.len() > max {
        body.detail = serde_json::json!("left out: too long");
        text = serde_json::to_vec(body).unwrap_or_default();
    }
    // One character may take six bytes there: quotes, control characters.
    let mut room = 1024;
    while text.len() > max && room > 0 {
        body.message.truncate(body.message.floor_char_boundary(room));
        text = serde_json::to_vec(body).unwrap_or_default();
        room /= 2;
    }
    text
}

/// A tool is known by its process id, and ids come again: a later tool is a later generation, or its first
/// messages would be taken for old ones. Steps of 2^24 ns (17 ms), so that it wraps after 2.2 years of uptime.
fn observer_generation(mono_ns: u64) -> u32 {
    ((mono_ns >> 24) as u32).max(1)
}

/// Reads the resolved stack of a root.
pub fn load(root: &Path) -> Result<Rc<Stack>, RailError> {
    let path = root.join(STACK_FILE);
    let text =
        std::fs::read_to_string(&path).map_err(|source| RailError::Read { path: path.clone(), source })?;
    let stack = serde_json::from_str(&text).map_err(|e| RailError::Stack { path, message: e.to_string() })?;
    Ok(Rc::new(stack))
}

fn find<'a>(stack: &'a Stack, topic: &str) -> Result<&'a TopicEntry, RailError> {
    stack.topic(topic).ok_or_else(|| RailError::UnknownTopic(topic.to_owned()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_event_that_is_too_long_loses_its_detail_then_the_end_of_its_message() {
        let body =
            |message: String, detail| EventBody::now(EventKind::Loaded, Level::Info, "plc", message, detail);
        let told = |mut body: EventBody| {
            let text = fit(&mut body, 2048);
            assert!(!text.is_empty() && text.len() <= 2048, "{}", text.len());
            serde_json::from_slice::<EventBody>(&text).map_err(|e| e.to_string())
        };
        let short =
            told(body("loaded".into(), serde_json::json!({ "hash": 7 }))).map(|b| (b.message, b.detail));
        assert_eq!(short, Ok(("loaded".into(), serde_json::json!({ "hash": 7 }))));
        let long = told(body("loaded".into(), serde_json::json!("x".repeat(4000)))).map(|b| b.message);
        assert_eq!(long, Ok("loaded".into()));
        let quotes = told(body("\u{1}".repeat(1024), serde_json::Value::Null)).map(|b| b.message.len());
        assert!(quotes.as_ref().is_ok_and(|len| *len >= 128), "{quotes:?}");
    }

    #[test]
    fn a_later_tool_is_a_later_generation() {
        let second = 1_000_000_000;
        assert!(observer_generation(0) >= 1);
        // Two years of uptime still fit.
        let times = [0, 20_000_000, second, 86_400 * second, 2 * 365 * 86_400 * second];
        assert!(times.windows(2).all(|t| observer_generation(t[0]) < observer_generation(t[1]) || t[0] == 0));
        assert!(observer_generation(20_000_000) <= observer_generation(40_000_000));
    }
}
