//! A recording as text: `dinrail recordings cat`.

use crate::config::matches;
use crate::reader::{End, Item, Message, ReadError, Recording};
use crate::ros1::{Layout, hex};
use crate::utc;
use ipc_types::payload::{CanFrame, can_flag, fd_flag, from_bytes, id_flag};
use ipc_types::topic::TopicKind;
use serde_json::{Map, Value, json};
use std::collections::{BTreeMap, BTreeSet};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

/// How messages are printed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Format {
    /// One JSON object a line.
    #[default]
    Json,
    /// `(1436509052.249713) can0 1A0#DEADBEEF`, as `candump -L` writes: CAN frames only.
    Candump,
}

/// Which messages are printed.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Filter {
    /// Topics; a trailing `*` stands for any ending; empty = all.
    pub topics: Vec<String>,
    /// UTC in ns, inclusive.
    pub from_ns: Option<u64>,
    /// UTC in ns, exclusive.
    pub to_ns: Option<u64>,
    /// At most so many messages.
    pub limit: Option<u64>,
}

impl Filter {
    fn takes(&self, message: &Message<'_>) -> bool {
        (self.topics.is_empty() || matches(&self.topics, message.topic()))
            && self.from_ns.is_none_or(|t| message.log_time >= t)
            && self.to_ns.is_none_or(|t| message.log_time < t)
    }
}

/// Why printing ended early.
#[derive(Debug, thiserror::Error)]
pub enum CatError {
    #[error(transparent)]
    Read(#[from] ReadError),
    #[error("writing the output failed: {0}")]
    Write(#[from] io::Error),
    #[error("{path}: no topic '{topic}'; there are: {there}")]
    NoTopic { path: PathBuf, topic: String, there: String },
}

/// What was printed.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize)]
pub struct Printed {
    pub messages: u64,
    /// How the recording ended; when `limit` was reached, how it stood until then.
    pub end: End,
}

/// Prints the messages of a recording in the order of the file.
pub fn cat(path: &Path, filter: &Filter, format: Format, out: &mut impl Write) -> Result<Printed, CatError> {
    let mut recording = Recording::open(path)?;
    let mut layouts: BTreeMap<u16, Option<Layout>> = BTreeMap::new();
    let mut messages = 0;
    while filter.limit.is_none_or(|limit| messages < limit) {
        let Some(item) = recording.next_item()? else { break };
        let Item::Message(message) = item else { continue };
        if !filter.takes(&message) {
            continue;
        }
        let printed = match format {
            Format::Json => {
                let layout = layouts.entry(message.channel.id).or_insert_with(|| layout_of(&message));
                json_line(&message, layout.as_ref(), out)?;
                true
            }
            Format::Candump => candump_line(&message, out)?,
        };
        messages += u64::from(printed);
    }
    out.flush()?;
    let whole = filter.limit.is_none_or(|limit| messages < limit);
    // With those that were silent.
    let seen: BTreeSet<String> = recording.channels().map(|channel| channel.topic.clone()).collect();
    let absent = |topic: &&String| !seen.iter().any(|there| matches(std::slice::from_ref(*topic), there));
    if let Some(topic) = filter.topics.iter().filter(|_| whole).find(absent) {
        let there = if seen.is_empty() { "none".to_owned() } else { Vec::from_iter(seen).join(", ") };
        return Err(CatError::NoTopic { path: path.to_owned(), topic: topic.clone(), there });
    }
    Ok(Printed { messages, end: recording.end().clone() })
}

fn layout_of(message: &Message<'_>) -> Option<Layout> {
    let channel = message.channel;
    let text = std::str::from_utf8(&channel.schema).ok()?;
    (channel.message_encoding == "ros1").then(|| Layout::parse(text)).flatten()
}

fn json_line(message: &Message<'_>, layout: Option<&Layout>, out: &mut impl Write) -> io::Result<()> {
    let mut line = Map::new();
    line.insert("topic".into(), json!(message.topic()));
    line.insert("utc".into(), json!(utc::iso(message.log_time)));
    line.insert("log_time".into(), json!(message.log_time));
    let frame = can_frame(message);
    if let Some(frame) = frame {
        let stamp = frame.stamp;
        line.insert("seq".into(), json!(stamp.seq));
        line.insert("t_ns".into(), json!(stamp.t_ns));
        line.insert("generation".into(), json!(stamp.generation));
        line.insert("writer".into(), json!(stamp.writer));
        can_fields(&frame, &mut line);
    } else if message.channel.message_encoding == "json" {
        line.insert("seq".into(), json!(message.sequence));
        let body = serde_json::from_slice(message.tail);
        line.insert("body".into(), body.unwrap_or_else(|_| Value::String(hex(message.tail))));
    } else if let Some(fields) = layout.and_then(|l| l.decode(message.data)) {
        line.extend(fields);
    } else {
        line.insert("seq".into(), json!(message.sequence));
        line.insert("data".into(), json!(hex(message.data)));
    }
    serde_json::to_writer(&mut *out, &line)?;
    out.write_all(b"\n")
}

fn can_frame(message: &Message<'_>) -> Option<CanFrame> {
    (message.channel.kind == Some(TopicKind::CanRx)).then(|| from_bytes(message.header)).flatten()
}

fn can_fields(frame: &CanFrame, line: &mut Map<String, Value>) {
    line.insert("id".into(), json!(id_text(frame)));
    line.insert("extended".into(), json!(frame.is_extended()));
    line.insert("len".into(), json!(frame.len));
    line.insert("data".into(), json!(hex(frame.payload())));
    for (key, set) in [
        ("rtr", frame.is_remote()),
        ("error", frame.is_error()),
        ("fd", frame.is_fd()),
        ("brs", frame.is_fd() && frame.fd_flags & fd_flag::BRS != 0),
        ("esi", frame.is_fd() && frame.fd_flags & fd_flag::ESI != 0),
        ("tx", frame.flags & can_flag::TX_ECHO != 0),
    ] {
        if set {
            line.insert(key.into(), json!(true));
        }
    }
}

/// Three digits for standard, eight for extended identifiers; error frames keep their flag, as candump prints.
fn id_text(frame: &CanFrame) -> String {
    if frame.is_error() {
        return format!("{:08X}", frame.can_id & (id_flag::ERR | id_flag::EFF_MASK));
    }
    if frame.is_extended() { format!("{:08X}", frame.id()) } else { format!("{:03X}", frame.id()) }
}

fn candump_line(message: &Message<'_>, out: &mut impl Write) -> io::Result<bool> {
    let Some(frame) = can_frame(message) else { return Ok(false) };
    let bus = message.topic().split('/').next().unwrap_or_default();
    let (seconds, micros) = (message.log_time / 1_000_000_000, message.log_time / 1000 % 1_000_000);
    write!(out, "({seconds:010}.{micros:06}) {bus} {}", id_text(&frame))?;
    if frame.is_fd() {
        writeln!(out, "##{:X}{}", frame.fd_flags & (fd_flag::BRS | fd_flag::ESI), hex(frame.payload()))?;
    } else if frame.is_remote() {
        if frame.len == 0 { writeln!(out, "#R")? } else { writeln!(out, "#R{:X}", frame.len.min(8))? }
    } else {
        writeln!(out, "#{}", hex(frame.payload()))?;
    }
    Ok(true)
}
