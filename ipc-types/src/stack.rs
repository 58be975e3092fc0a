//! The resolved stack: what the launcher writes to `<root>/stack.json` and every process reads.

use crate::topic::TopicKind;
use crate::wiring::Wiring;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// How grave a finding of `check` is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Severity {
    /// Runs, but probably not as meant.
    Warning,
    /// The stack is refused.
    Error,
}

/// Something that `check` found without starting anything.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Finding {
    pub severity: Severity,
    /// Service whose table it stands in.
    pub service: String,
    /// Path of the key in the service's table: `bus`, `in[2].to`; empty = the table itself. The launcher turns
    /// it into `file:line`.
    pub key: String,
    /// What is wrong.
    pub message: String,
    /// What to do about it.
    pub help: String,
}

impl Finding {
    pub fn error(service: &str, key: &str, message: impl Into<String>, help: impl Into<String>) -> Self {
        let (message, help) = (message.into(), help.into());
        Self { severity: Severity::Error, service: service.to_owned(), key: key.to_owned(), message, help }
    }
    pub fn warning(service: &str, key: &str, message: impl Into<String>, help: impl Into<String>) -> Self {
        Self { severity: Severity::Warning, ..Self::error(service, key, message, help) }
    }
}

/// A service of the resolved stack.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct ServiceEntry {
    pub name: String,
    pub kind: String,
    /// Writer number on the rail, from 1 (0 is the launcher).
    pub index: u32,
    /// The service's own table, without the launcher's keys.
    pub config: serde_json::Value,
    pub wiring: Wiring,
}

/// A topic of the resolved stack.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct TopicEntry {
    pub name: String,
    pub kind: TopicKind,
    pub depth: u32,
    pub max_tail: u32,
    pub writers: Vec<String>,
    pub readers: Vec<String>,
    /// Services whose inbox a writer rings.
    pub wakes: Vec<String>,
    /// Limits as created.
    pub max_publishers: u32,
    pub max_subscribers: u32,
}

impl TopicEntry {
    /// Bytes of shared memory that its writers reserve when all of the stack's writers and reader slots exist.
    pub fn bytes(&self) -> u64 {
        // 64: iceoryx2's own header and alignment of a chunk.
        let chunk = (self.kind.header_bytes() + self.max_tail as usize + 64) as u64;
        let chunks = u64::from(self.max_subscribers) * (u64::from(self.depth) + 2) + 4;
        self.writers.len().max(1) as u64 * chunk * chunks
    }
}

/// The resolved stack.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Stack {
    pub name: String,
    /// The stack file, absolute; a name in angle brackets for an embedded one.
    pub file: PathBuf,
    /// Folder that relative paths of the stack file start from.
    pub dir: PathBuf,
    /// Text of the stack file as it was read.
    pub text: String,
    /// Identifies the executable: children of another build refuse to run.
    pub build_id: String,
    /// Folder of the stack in shared memory.
    pub root: PathBuf,
    /// Prefix of its objects in /dev/shm.
    pub prefix: String,
    pub services: Vec<ServiceEntry>,
    pub topics: Vec<TopicEntry>,
}

impl Stack {
    pub fn service(&self, name: &str) -> Option<&ServiceEntry> {
        self.services.iter().find(|s| s.name == name)
    }
    pub fn topic(&self, name: &str) -> Option<&TopicEntry> {
        self.topics.iter().find(|t| t.name == name)
    }
    /// The plc service whose image a service of this wiring exchanges. A name that leads nowhere is found by the
    /// launcher, who sees it in the wiring.
    pub fn plc_of(&self, wiring: &Wiring) -> Option<&ServiceEntry> {
        self.service(wiring.plc.as_deref()?).filter(|plc| plc.kind == "plc")
    }
    /// What is wrong with leaving out the key that names a service of this kind: then the stack must have exactly one.
    pub fn check_only(&self, me: &str, key: &str, kind: &str) -> Option<Finding> {
        let names: Vec<&str> =
            self.services.iter().filter(|s| s.kind == kind).map(|s| s.name.as_str()).collect();
        let (message, help) = match names.as_slice() {
            [_] => return None,
            [] => (
                format!("the stack has no service of kind \"{kind}\""),
                format!("add one, as [[service]] with kind = \"{kind}\""),
            ),
            [first, ..] => (
                format!("the stack has several services of kind \"{kind}\": {}", names.join(", ")),
                format!("say which one: {key} = \"{first}\""),
            ),
        };
        Some(Finding::error(me, key, message, help))
    }
    /// Name of the service with this writer number, for messages.
    pub fn writer_name(&self, writer: u32) -> String {
        match self.services.iter().find(|s| s.index == writer) {
            Some(service) => service.name.clone(),
            None if writer == 0 => "launcher".to_owned(),
            None => format!("pid {}", writer & 0x7FFF_FFFF),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn stack(kinds: &[(&str, &str)]) -> Stack {
        let entry = |&(name, kind): &(&str, &str)| ServiceEntry {
            name: name.to_owned(),
            kind: kind.to_owned(),
            index: 1,
            config: serde_json::Value::Null,
            wiring: Wiring::default(),
        };
        Stack {
            name: "s".to_owned(),
            file: PathBuf::new(),
            dir: PathBuf::new(),
            text: String::new(),
            build_id: String::new(),
            root: PathBuf::new(),
            prefix: String::new(),
            services: kinds.iter().map(entry).collect(),
            topics: Vec::new(),
        }
    }

    #[test]
    fn a_key_may_be_left_out_where_the_stack_has_one_such_service() {
        let said = |kinds: &[(&str, &str)]| {
            stack(kinds)
                .check_only("io", "bus", "can")
                .map(|f| format!("{}: {} -> {}", f.key, f.message, f.help))
        };
        assert_eq!(said(&[("io", "can-io"), ("can0", "can")]), None);
        assert_eq!(
            said(&[("io", "can-io")]).as_deref(),
            Some(
                "bus: the stack has no service of kind \"can\" -> add one, as [[service]] with kind = \"can\""
            )
        );
        assert_eq!(
            said(&[("can0", "can"), ("can1", "can")]).as_deref(),
            Some(
                "bus: the stack has several services of kind \"can\": can0, can1 -> say which one: bus = \"can0\""
            )
        );
    }

    #[test]
    fn the_plc_of_a_wiring_is_one() {
        let stack = stack(&[("plc", "plc"), ("io", "can-io")]);
        let plc = |name: &str| {
            let wiring = Wiring { plc: Some(name.to_owned()), ..Wiring::default() };
            stack.plc_of(&wiring).map(|s| s.name.clone())
        };
        assert_eq!(plc("plc").as_deref(), Some("plc"));
        assert_eq!((plc("io"), plc("nobody")), (None, None));
        assert!(stack.plc_of(&Wiring::default()).is_none());
    }
}
