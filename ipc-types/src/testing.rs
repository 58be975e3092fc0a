//! A whole rail in the process of a test: what the launcher does for a stack, in a few lines.
//!
//! A process belongs to one rail for its whole life, so a test executable makes one [`TestRail`] only. Nothing but
//! tests may use this module: its functions panic.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may end like this")]

pub mod allocations;

use crate::rail::{self, Held, Svc};
use crate::stack::{ServiceEntry, Stack, TopicEntry};
use crate::topic::{EVENTS, TopicKind};
use crate::{Context, Wiring};
use iceoryx2::node::Node;
use std::collections::BTreeMap;
use std::os::fd::OwnedFd;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Longest wait for anything; never a measure of speed.
pub const PATIENCE: Duration = Duration::from_mins(1);

/// Asks every 2 ms until there is an answer. Panics after [`PATIENCE`].
pub fn wait<T>(what: &str, mut attempt: impl FnMut() -> Option<T>) -> T {
    let end = Instant::now() + PATIENCE;
    loop {
        if let Some(result) = attempt() {
            return result;
        }
        assert!(Instant::now() < end, "{what} never came");
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// A service of the stack; its number on the rail is its place in the stack, from 1.
pub fn service(name: &str, kind: &str, config: serde_json::Value, wiring: Wiring) -> ServiceEntry {
    ServiceEntry { name: name.to_owned(), kind: kind.to_owned(), index: 0, config, wiring }
}

/// A stack of these services that is nowhere: for what services declare and check.
pub fn stack(services: Vec<ServiceEntry>) -> Stack {
    Stack {
        name: "test".into(),
        file: "stack.toml".into(),
        dir: ".".into(),
        text: String::new(),
        build_id: String::new(),
        root: "/nonexistent".into(),
        prefix: "x".into(),
        services,
        topics: Vec::new(),
    }
}

/// A topic with the table's limits and a few ports; of a kind that belongs to no service, `service` may be empty.
pub fn topic(kind: TopicKind, service: &str) -> TopicEntry {
    let (max_publishers, max_subscribers) = rail::port_limits(kind, 3, 3);
    TopicEntry {
        name: if kind == TopicKind::Events { EVENTS.to_owned() } else { kind.of(service) },
        kind,
        depth: kind.row().depth,
        max_tail: kind.row().max_tail,
        writers: vec![service.to_owned()],
        readers: Vec::new(),
        wakes: Vec::new(),
        max_publishers,
        max_subscribers,
    }
}

impl TopicEntry {
    /// With another depth.
    #[must_use]
    pub fn depth(mut self, depth: u32) -> Self {
        self.depth = depth;
        self
    }
    /// With another limit of the tail.
    #[must_use]
    pub fn max_tail(mut self, max_tail: u32) -> Self {
        self.max_tail = max_tail;
        self
    }
    /// Wakes this service.
    #[must_use]
    pub fn wakes(mut self, service: &str) -> Self {
        self.wakes.push(service.to_owned());
        self
    }
}

/// Removes what a rail leaves in shared memory, however the test ends.
struct Wipe(PathBuf, String);

impl Wipe {
    fn now(&self) {
        let _ = std::fs::remove_dir_all(&self.0);
        for entry in std::fs::read_dir("/dev/shm").unwrap().flatten() {
            if entry.file_name().to_string_lossy().starts_with(&self.1) {
                let _ = std::fs::remove_file(entry.path());
            }
        }
    }
}

impl Drop for Wipe {
    fn drop(&mut self) {
        self.now();
    }
}

/// The rail, as long as it lives.
pub struct TestRail {
    /// As every process of the stack reads it.
    pub stack: Stack,
    // In this order: the topics before their node, the files last.
    _held: Vec<Held>,
    _launcher: Node<Svc>,
    _wipe: Wipe,
}

impl TestRail {
    /// Makes a rail of these topics; events, health and status of all services are added.
    pub fn new(name: &str, services: Vec<ServiceEntry>, topics: Vec<TopicEntry>) -> Self {
        Self::in_folder(Path::new("."), name, services, topics)
    }

    /// The same with a folder that the stack's relative paths start from.
    pub fn in_folder(
        dir: &Path,
        name: &str,
        mut services: Vec<ServiceEntry>,
        mut topics: Vec<TopicEntry>,
    ) -> Self {
        let name = format!("{name}{}", std::process::id());
        let (root, prefix) = rail::place(0, &name);
        let wipe = Wipe(root.clone(), prefix.clone());
        wipe.now();
        std::fs::create_dir_all(&root).unwrap();
        std::fs::write(root.join(rail::CONFIG_FILE), rail::config_text(&root, &prefix)).unwrap();
        topics.push(topic(TopicKind::Events, "stack"));
        for (service, index) in services.iter_mut().zip(1..) {
            service.index = index;
            topics.push(topic(TopicKind::Health, &service.name));
            topics.push(topic(TopicKind::Status, &service.name));
        }
        let stack = Stack {
            name,
            file: "test.toml".into(),
            dir: dir.to_owned(),
            text: String::new(),
            build_id: "test".into(),
            root,
            prefix,
            services,
            topics,
        };
        write(&stack);
        rail::join(&stack.root).unwrap();
        let launcher = rail::node("launcher").unwrap();
        let held = stack.topics.iter().map(|t| rail::create_topic(&launcher, t).unwrap()).collect();
        Self { stack, _held: held, _launcher: launcher, _wipe: wipe }
    }

    /// Its folder, for threads that join by themselves.
    pub fn root(&self) -> &Path {
        &self.stack.root
    }

    /// Writes a changed stack for those that join from now on.
    pub fn rewrite(&self) {
        write(&self.stack);
    }

    /// Joins as a service of the stack, generation 1. See [`join`].
    pub fn context(&self, service: &str) -> Context {
        join(self.root(), service, BTreeMap::new())
    }
}

fn write(stack: &Stack) {
    std::fs::write(stack.root.join(rail::STACK_FILE), serde_json::to_vec(stack).unwrap()).unwrap();
}

/// Joins the rail at `root` as a service of its stack, generation 1. Before any thread starts, or on a thread: the
/// context stays on its own.
pub fn join(root: &Path, service: &str, fds: BTreeMap<String, OwnedFd>) -> Context {
    match Context::service(root, service, 1, fds) {
        Ok(ctx) => ctx,
        Err(e) => panic!("service '{service}' cannot join: {e}"),
    }
}
