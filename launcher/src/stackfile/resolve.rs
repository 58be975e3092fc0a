//! From what every service declares to the rail as the launcher creates it: each topic with its writers, its
//! readers, whom it wakes, and its limits.

use super::document::{Document, Service};
use super::nearest::nearest;
use super::place::Sink;
use super::{Loader, build_id};
use ipc_types::plc_table;
use ipc_types::rail::{place, port_limits};
use ipc_types::stack::{ServiceEntry, Stack, TopicEntry};
use ipc_types::topic::{EVENTS, TopicKind, WhenFull};
use ipc_types::wiring::{Neighbours, TopicDecl, Wiring};
use std::collections::BTreeMap;

/// Reader and writer name of the launcher itself.
pub const LAUNCHER: &str = "launcher";
/// Kind of the services that own a process image.
pub const PLC: &str = "plc";

/// Resolves the document. Names that lead nowhere go to the sink.
pub fn resolve(document: &Document, loader: &Loader<'_>, text: &str, sink: &mut Sink<'_>) -> Stack {
    let kinds: Vec<(String, String)> =
        document.services.iter().map(|s| (s.name.clone(), s.kind.name.to_owned())).collect();
    let plc_addressing: BTreeMap<String, String> = document
        .services
        .iter()
        .filter(|s| s.kind.name == PLC)
        .map(|s| (s.name.clone(), plc_table::addressing(&s.json).to_owned()))
        .collect();
    let services: Vec<ServiceEntry> = document
        .services
        .iter()
        .zip(1..)
        .map(|(service, index)| {
            let neighbours = Neighbours {
                name: service.name.clone(),
                services: kinds.clone(),
                dir: loader.dir.clone(),
                plc_addressing: plc_addressing.clone(),
            };
            ServiceEntry {
                name: service.name.clone(),
                kind: service.kind.name.to_owned(),
                index,
                config: service.json.clone(),
                wiring: service.config.topics(&neighbours),
            }
        })
        .collect();
    let topics = Rail::new(document, &services, sink).build();
    let (root, prefix) = place(rustix::process::getuid().as_raw(), &document.name);
    Stack {
        name: document.name.clone(),
        file: loader.file.clone(),
        dir: loader.dir.clone(),
        text: text.to_owned(),
        build_id: build_id().to_owned(),
        root,
        prefix,
        services,
        topics,
    }
}

/// The plc service whose image a service exchanges, or what is wrong. `None` when it exchanges nothing.
fn image_of(entry: &ServiceEntry, services: &[ServiceEntry]) -> Option<Result<String, (String, String)>> {
    let wiring = &entry.wiring;
    let (key, first) = match wiring.inputs.iter().chain(&wiring.outputs).next() {
        Some(first) => ("plc", first.label.as_str()),
        None => return None,
    };
    let plcs: Vec<&str> = services.iter().filter(|s| s.kind == PLC).map(|s| s.name.as_str()).collect();
    let list = plcs.join(", ");
    let Some(named) = wiring.plc.as_deref() else {
        let who = format!("service '{}' exchanges points with a process image ({first})", entry.name);
        return Some(Err(if plcs.is_empty() {
            (
                format!("{who}, but the stack has no plc service"),
                "add a [[service]] with kind = \"plc\"; it needs no program".to_owned(),
            )
        } else {
            (
                format!("{who}, and the stack has {} plc services: {list}", plcs.len()),
                format!("say which one: {key} = \"{}\"", plcs.first().copied().unwrap_or("")),
            )
        }));
    };
    if plcs.contains(&named) {
        return Some(Ok(named.to_owned()));
    }
    let message = match services.iter().find(|s| s.name == named) {
        Some(other) => format!(
            "key '{key}' of service '{}' names '{named}', a service of kind {}",
            entry.name, other.kind
        ),
        None => format!("key '{key}' of service '{}' names '{named}': there is no such service", entry.name),
    };
    let list = if plcs.is_empty() { "none; add a [[service]] with kind = \"plc\"".to_owned() } else { list };
    Some(Err((message, format!("plc services: {list}"))))
}

struct Rail<'a, 's, 't> {
    document: &'a Document,
    services: &'a [ServiceEntry],
    sink: &'s mut Sink<'t>,
    topics: Vec<(TopicEntry, String)>,
    /// Keys already reported as leading nowhere: one key often stands for two topics.
    reported: Vec<(String, String)>,
}

impl<'a, 's, 't> Rail<'a, 's, 't> {
    fn new(document: &'a Document, services: &'a [ServiceEntry], sink: &'s mut Sink<'t>) -> Self {
        Self { document, services, sink, topics: Vec::new(), reported: Vec::new() }
    }

    fn build(mut self) -> Vec<TopicEntry> {
        for entry in self.services {
            self.own(entry);
        }
        self.add(&TopicDecl::new(TopicKind::Events), EVENTS, LAUNCHER);
        for entry in self.services {
            self.writer(EVENTS, &entry.name);
        }
        for entry in self.services {
            self.reads(entry);
            self.writes(entry);
        }
        self.inputs();
        for entry in self.services {
            self.consumed(entry);
            self.recorded(entry);
        }
        for entry in self.services {
            self.reader(&TopicKind::Health.of(&entry.name), LAUNCHER);
        }
        let mut topics: Vec<TopicEntry> = self.topics.into_iter().map(|(topic, _)| topic).collect();
        for topic in &mut topics {
            (topic.max_publishers, topic.max_subscribers) =
                port_limits(topic.kind, topic.writers.len(), topic.readers.len());
        }
        topics
    }

    fn add(&mut self, decl: &TopicDecl, name: &str, owner: &str) {
        if self.topics.iter().any(|(t, _)| t.name == name) {
            return;
        }
        let topic = TopicEntry {
            name: name.to_owned(),
            kind: decl.kind,
            depth: decl.depth,
            max_tail: decl.max_tail,
            // Of a refusing topic the owner is the consumer.
            writers: if decl.kind.row().when_full == WhenFull::Refuse {
                Vec::new()
            } else {
                vec![owner.to_owned()]
            },
            readers: Vec::new(),
            wakes: Vec::new(),
            max_publishers: 0,
            max_subscribers: 0,
        };
        self.topics.push((topic, owner.to_owned()));
    }

    fn own(&mut self, entry: &ServiceEntry) {
        for decl in &entry.wiring.topics {
            self.add(decl, &decl.kind.of(&entry.name), &entry.name);
        }
        if !entry.wiring.inputs.is_empty() {
            self.add(&TopicDecl::new(TopicKind::Inputs), &TopicKind::Inputs.of(&entry.name), &entry.name);
        }
        for kind in [TopicKind::Health, TopicKind::Status] {
            self.add(&TopicDecl::new(kind), &kind.of(&entry.name), &entry.name);
        }
    }

    fn topic(&mut self, name: &str) -> Option<&mut (TopicEntry, String)> {
        self.topics.iter_mut().find(|(t, _)| t.name == name)
    }

    fn writer(&mut self, topic: &str, service: &str) {
        if let Some((topic, _)) = self.topic(topic)
            && !topic.writers.iter().any(|w| w == service)
        {
            topic.writers.push(service.to_owned());
        }
    }

    fn reader(&mut self, topic: &str, service: &str) {
        if let Some((topic, _)) = self.topic(topic)
            && !topic.readers.iter().any(|r| r == service)
        {
            topic.readers.push(service.to_owned());
        }
    }

    fn wake(&mut self, topic: &str, service: &str) {
        if let Some((topic, _)) = self.topic(topic)
            && !topic.wakes.iter().any(|w| w == service)
        {
            topic.wakes.push(service.to_owned());
        }
    }

    fn reads(&mut self, entry: &ServiceEntry) {
        for read in &entry.wiring.reads {
            let Some((topic, owner)) = self.topic(&read.topic) else {
                self.nowhere(entry, &read.topic, &read.key);
                continue;
            };
            if topic.kind.row().when_full == WhenFull::Refuse && *owner != entry.name {
                let message =
                    format!("service '{}' may not read '{}': only '{owner}' does", entry.name, read.topic);
                let place = self.document.place(&entry.name, &read.key);
                self.sink.error(
                    &place,
                    message,
                    "a second reader would stop the writers; read what the owner publishes",
                );
                continue;
            }
            self.reader(&read.topic, &entry.name);
            if read.wake {
                self.wake(&read.topic, &entry.name);
            }
        }
    }

    fn writes(&mut self, entry: &ServiceEntry) {
        for (topic, key) in &entry.wiring.writes {
            if self.topic(topic).is_none() {
                self.nowhere(entry, topic, key);
            }
            self.writer(topic, &entry.name);
        }
    }

    /// A plc reads the inputs of every service that exchanges its image, and is woken by them.
    fn inputs(&mut self) {
        for entry in self.services {
            match image_of(entry, self.services) {
                Some(Ok(plc)) if !entry.wiring.inputs.is_empty() => {
                    let topic = TopicKind::Inputs.of(&entry.name);
                    self.reader(&topic, &plc);
                    self.wake(&topic, &plc);
                }
                Some(Err((message, help))) => {
                    let key = "plc".to_owned();
                    if !self.reported.contains(&(entry.name.clone(), key.clone())) {
                        let place = self.document.place(&entry.name, &key);
                        self.sink.error(&place, message, help);
                    }
                    self.reported.push((entry.name.clone(), key));
                }
                Some(Ok(_)) | None => {}
            }
        }
    }

    /// The owner of a refusing topic is its only reader and is woken by it.
    fn consumed(&mut self, entry: &ServiceEntry) {
        let mine: Vec<String> = self
            .topics
            .iter()
            .filter(|(t, owner)| *owner == entry.name && t.kind.row().when_full == WhenFull::Refuse)
            .map(|(t, _)| t.name.clone())
            .collect();
        for topic in mine {
            // A declared read decides about the wake-up.
            if !entry.wiring.reads.iter().any(|r| r.topic == topic) {
                self.reader(&topic, &entry.name);
                self.wake(&topic, &entry.name);
            }
        }
    }

    fn recorded(&mut self, entry: &ServiceEntry) {
        if !entry.wiring.records {
            return;
        }
        let all: Vec<String> =
            self.topics.iter().filter(|(t, _)| t.kind.row().recorded).map(|(t, _)| t.name.clone()).collect();
        for topic in all {
            self.reader(&topic, &entry.name);
        }
    }

    /// A key names a service that has no such topic, or none at all.
    fn nowhere(&mut self, entry: &ServiceEntry, topic: &str, key: &str) {
        let at = (entry.name.clone(), key.to_owned());
        if self.reported.contains(&at) {
            return;
        }
        self.reported.push(at);
        let (named, suffix) = topic.split_once('/').unwrap_or((topic, ""));
        let fitting: Vec<&str> = self
            .topics
            .iter()
            .filter_map(|(t, owner)| {
                t.name.strip_prefix(owner.as_str())?.strip_prefix('/').map(|s| (s, owner))
            })
            .filter(|(s, owner)| *s == suffix && **owner != entry.name)
            .map(|(_, owner)| owner.as_str())
            .collect();
        let by = if key.is_empty() {
            format!("service '{}' needs '{topic}'", entry.name)
        } else {
            format!("key '{key}' of service '{}' names '{named}'", entry.name)
        };
        let message = match self.document.service(named) {
            Some(Service { kind, .. }) => {
                format!("{by}, a service of kind {}, which has no topic '{topic}'", kind.name)
            }
            None => format!("{by}: there is no such service"),
        };
        let mut help = match nearest(named, fitting.iter().copied()) {
            Some(near) => format!("did you mean '{near}'?\n"),
            None => String::new(),
        };
        help += &match fitting.as_slice() {
            [] => format!("no service of this stack has a topic '{suffix}'; add one"),
            list => format!("services that fit: {}", list.join(", ")),
        };
        let place = self.document.place(&entry.name, key);
        self.sink.error(&place, message, help);
    }
}

/// The services that exchange the image of a plc, with what they declare.
pub fn exchangers<'a>(stack: &'a Stack, plc: &str) -> impl Iterator<Item = (&'a ServiceEntry, &'a Wiring)> {
    let plc = plc.to_owned();
    stack.services.iter().filter(move |s| s.wiring.plc.as_deref() == Some(&plc)).map(|s| (s, &s.wiring))
}
