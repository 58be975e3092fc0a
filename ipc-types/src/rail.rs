//! Joining and creating the rail: iceoryx2 with one prefix and one root a stack.
//!
//! Rules that hold here (measured against iceoryx2 0.10): the launcher creates every topic before it starts a
//! process and holds it, services only open; the per-stack configuration is set as the *global* one before
//! anything else; the automatic clean-ups are off, a short-lived helper process cleans dead nodes.

use crate::payload::Payload;
use crate::stack::TopicEntry;
use crate::topic::{MAX_NODES, SPARE_PORTS, TopicKind, WhenFull};
use crate::with_payload;
use iceoryx2::config::Config;
use iceoryx2::node::{Node, NodeBuilder};
use iceoryx2::prelude::{NodeName, ServiceName, SignalHandlingMode, ipc};
use iceoryx2_bb_container::semantic_string::SemanticString;
use iceoryx2_bb_system_types::file_path::FilePath;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// The service variant: ports belong to one thread.
pub type Svc = ipc::Service;
/// Name of the iceoryx2 configuration in the stack's root.
pub const CONFIG_FILE: &str = "iceoryx2.toml";
/// Name of the resolved stack in the stack's root.
pub const STACK_FILE: &str = "stack.json";

/// Why the rail could not be joined or made.
#[derive(Debug, thiserror::Error)]
pub enum RailError {
    #[error("rail: cannot read {path}: {source}; is the stack running?")]
    Read { path: PathBuf, source: std::io::Error },
    #[error("rail: cannot write {path}: {source}; is /dev/shm full or not writable?")]
    Write { path: PathBuf, source: std::io::Error },
    #[error("rail: {path} is no stack description: {message}; was it written by another version of dinrail?")]
    Stack { path: PathBuf, message: String },
    #[error("rail: {what} failed: {cause}; is /dev/shm full, or the limit of open files reached?")]
    Middleware { what: String, cause: String },
    /// `cause` is the middleware's own word for it.
    #[error(
        "rail: {what}: too many tools use it at this moment, at most {limit} ports fit ({cause}); end a `dinrail top`, \
         `dinrail can dump` or the like"
    )]
    Crowded { what: String, limit: u32, cause: String },
    #[error("rail: topic '{0}' is not part of this stack; the service's topics() must declare it")]
    UnknownTopic(String),
    #[error("rail: topic '{topic}' carries {has}, not {asked}")]
    WrongPayload { topic: String, has: &'static str, asked: &'static str },
    #[error("rail: no descriptor named '{0}' was passed to this process")]
    NoDescriptor(String),
    #[error("rail: {0}")]
    System(#[from] std::io::Error),
}

impl RailError {
    pub(crate) fn middleware(what: impl Into<String>, cause: impl std::fmt::Debug) -> Self {
        Self::Middleware { what: what.into(), cause: format!("{cause:?}") }
    }

    /// Of a port: a topic has places for so many, and for [`MAX_NODES`] processes.
    pub(crate) fn port(what: String, ports: u32, cause: impl std::fmt::Debug) -> Self {
        let cause = format!("{cause:?}");
        if cause.contains("ExceedsMax") {
            let limit = if cause.contains("Nodes") { MAX_NODES } else { ports };
            return Self::Crowded { what, limit, cause };
        }
        Self::Middleware { what, cause }
    }
}

/// Root folder and prefix of a stack: `/dev/shm/dr<hex>` and `dr<hex>_`, from user and stack name.
pub fn place(uid: u32, stack: &str) -> (PathBuf, String) {
    let hash = xxhash_rust::xxh3::xxh3_64(format!("{uid}/{stack}").as_bytes()) as u32;
    (PathBuf::from(format!("/dev/shm/dr{hash:08x}")), format!("dr{hash:08x}_"))
}

/// Text of the iceoryx2 configuration of a stack.
pub fn config_text(root: &Path, prefix: &str) -> String {
    format!(
        "[global]\nroot-path = \"{}\"\nprefix = \"{prefix}\"\n\n[global.service]\ncleanup-dead-nodes-on-open = false\n\n\
         [global.node]\ncleanup-dead-nodes-on-creation = false\ncleanup-dead-nodes-on-destruction = false\n",
        root.display()
    )
}

/// Sets the stack's configuration as the process's global one. Must come before any other use of the rail in
/// this process, and a process belongs to one stack for its whole life.
pub fn join(root: &Path) -> Result<(), RailError> {
    iceoryx2_log::set_log_level(iceoryx2_log::LogLevel::Fatal);
    let path = root.join(CONFIG_FILE);
    if let Err(source) = std::fs::metadata(&path) {
        return Err(RailError::Read { path, source });
    }
    let file = FilePath::new(path.as_os_str().as_encoded_bytes())
        .map_err(|e| RailError::middleware("configuration path", e))?;
    let config = Config::setup_global_config_from_file(&file)
        .map_err(|e| RailError::middleware("loading the configuration", e))?;
    let joined = config.global.root_path().to_string();
    if Path::new(&joined) != root {
        return Err(RailError::middleware("joining", format!("this process already belongs to {joined}")));
    }
    Ok(())
}

/// A node of this process on the rail that [`join`] named.
pub fn node(name: &str) -> Result<Node<Svc>, RailError> {
    let node_name = NodeName::new(name).map_err(|e| RailError::middleware("node name", e))?;
    NodeBuilder::new()
        .name(&node_name)
        .signal_handling_mode(SignalHandlingMode::Disabled)
        .config(Config::global_config())
        .create::<Svc>()
        .map_err(|e| RailError::middleware(format!("creating node '{name}'"), e))
}

/// Cleans what dead processes left: counts of cleaned and failed nodes. Only for the helper process that the
/// launcher kills after 2 s, for this call can hang (a process killed between creating and sizing an object).
pub fn clean_dead_nodes() -> Result<(u64, u64), RailError> {
    let node = node("cleaner")?;
    let state = node.blocking_cleanup_dead_nodes(Duration::from_millis(500));
    Ok((state.cleanups, state.failed_cleanups))
}

pub(crate) fn service_name(name: &str) -> Result<ServiceName, RailError> {
    ServiceName::new(name).map_err(|e| RailError::middleware(format!("service name '{name}'"), e))
}

/// What the launcher holds so that a topic outlives every process.
pub struct Held(#[allow(dead_code, reason = "held, never used")] Box<dyn std::any::Any>);

/// Creates a topic with its limits. Launcher only.
pub fn create_topic(node: &Node<Svc>, topic: &TopicEntry) -> Result<Held, RailError> {
    with_payload!(topic.kind, T => create_typed::<T>(node, topic))
}

fn create_typed<T: Payload>(node: &Node<Svc>, topic: &TopicEntry) -> Result<Held, RailError> {
    let row = topic.kind.row();
    let port_factory = node
        .service_builder(&service_name(&topic.name)?)
        .publish_subscribe::<[u8]>()
        .user_header::<T>()
        .max_publishers(topic.max_publishers as usize)
        .max_subscribers(topic.max_subscribers as usize)
        .max_nodes(MAX_NODES as usize)
        .subscriber_max_buffer_size(topic.depth as usize)
        .subscriber_max_borrowed_samples(2)
        .history_size(usize::from(row.history))
        .enable_safe_overflow(row.when_full == WhenFull::Oldest)
        .create()
        .map_err(|e| RailError::middleware(format!("creating topic '{}'", topic.name), e))?;
    Ok(Held(Box::new(port_factory)))
}

/// Limits of a topic from its writers and readers.
pub fn port_limits(kind: TopicKind, writers: usize, readers: usize) -> (u32, u32) {
    let subscribers = match kind.row().when_full {
        // One reader, plus the slot of a dead predecessor that is not cleaned up yet.
        WhenFull::Refuse => 2,
        WhenFull::Oldest => match kind {
            // Deep and wide: each slot costs depth x part. The recorder and one more.
            TopicKind::Scan | TopicKind::Keyframe => readers as u32 + 2,
            _ => readers as u32 + SPARE_PORTS,
        },
    };
    let publishers = match kind {
        // The launcher writes events too, and so does every tool that looks on.
        TopicKind::Events => writers as u32 + 2 * SPARE_PORTS,
        _ => writers as u32 + SPARE_PORTS,
    };
    (publishers, subscribers)
}
