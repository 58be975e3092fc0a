//! What stands in a recording: `dinrail recordings info`.

use crate::disk::{Lock, human, open_locked};
use crate::format::{Gaps, META_CLOCK, META_RECORDING, META_SEALED};
use crate::reader::{End, Item, Message, ReadError, Recording};
use crate::utc;
use ipc_types::port::{Accept, Sequence};
use ipc_types::topic::TopicKind;
use serde::Serialize;
use std::collections::BTreeMap;
use std::fmt;
use std::path::{Path, PathBuf};

/// Messages that came within less time than this have no rate worth telling.
pub const RATE_SPAN_S: f64 = 0.1;
/// Clock jumps that are listed.
const MAX_JUMPS: usize = 64;
/// Attachments that are listed.
const MAX_ATTACHMENTS: usize = 4096;

/// One channel.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ChannelInfo {
    pub topic: String,
    pub kind: Option<TopicKind>,
    pub schema: String,
    pub encoding: String,
    pub messages: u64,
    /// Payload bytes.
    pub bytes: u64,
    /// Messages per second between the first and the last; `None` when these are less than [`RATE_SPAN_S`] apart,
    /// as the parts of a single keyframe are.
    pub rate: Option<f64>,
    /// UTC in ns; 0 without messages.
    pub first_ns: u64,
    pub last_ns: u64,
    /// Messages missing by the numbers of their writers. Unknown for JSON channels: see `missed`.
    pub gaps: Option<u64>,
    /// Messages the recorder knows it missed: lost, malformed, dropped.
    pub missed: u64,
}

/// A file that stands in the recording.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct AttachmentInfo {
    pub name: String,
    pub media_type: String,
    pub bytes: u64,
}

/// A recording.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Info {
    #[serde(serialize_with = "lossy")]
    pub path: PathBuf,
    pub bytes: u64,
    /// Index and end are there.
    pub finished: bool,
    /// A recorder writes it now, or it is just being made whole.
    pub being_written: bool,
    pub end: End,
    /// Name of the stack, build, host and so on, as recorded.
    pub recording: BTreeMap<String, String>,
    /// Present when the file was made whole later.
    pub sealed: Option<BTreeMap<String, String>>,
    pub messages: u64,
    /// UTC in ns; 0 without messages.
    pub first_ns: u64,
    pub last_ns: u64,
    pub duration_s: f64,
    /// File bytes per hour in MB (10^6).
    pub mb_per_h: f64,
    pub channels: Vec<ChannelInfo>,
    pub attachments: Vec<AttachmentInfo>,
    /// Attachments that are not listed, because there are too many.
    pub more_attachments: u64,
    /// UTC - CLOCK_MONOTONIC in ns at the start and at each jump.
    pub utc_offsets_ns: Vec<i64>,
    /// The recorder's last word on itself.
    pub gaps: Option<Gaps>,
}

/// Names need not be UTF-8; JSON is.
fn lossy<S: serde::Serializer>(path: &Path, out: S) -> Result<S::Ok, S::Error> {
    out.collect_str(&path.display())
}

#[derive(Default)]
struct Count {
    messages: u64,
    bytes: u64,
    first_ns: u64,
    last_ns: u64,
    gaps: u64,
    sequence: Sequence,
}

impl Count {
    fn add(&mut self, message: &Message<'_>) {
        if self.messages == 0 {
            self.first_ns = message.log_time;
        }
        self.messages += 1;
        self.bytes += message.data.len() as u64;
        self.first_ns = self.first_ns.min(message.log_time);
        self.last_ns = self.last_ns.max(message.log_time);
        if !message.header.is_empty()
            && let Accept::Fresh { lost } = self.sequence.accept(&message.stamp)
        {
            self.gaps = self.gaps.saturating_add(lost);
        }
    }
}

/// Reads a recording through and sums it up.
pub fn info(path: &Path) -> Result<Info, ReadError> {
    let mut recording = Recording::open(path)?;
    let mut counts: BTreeMap<u16, Count> = BTreeMap::new();
    let mut info = Info {
        path: path.to_owned(),
        bytes: recording.len(),
        finished: false,
        being_written: matches!(open_locked(path), Ok((_, Lock::InUse))),
        end: End::default(),
        recording: BTreeMap::new(),
        sealed: None,
        messages: 0,
        first_ns: 0,
        last_ns: 0,
        duration_s: 0.0,
        mb_per_h: 0.0,
        channels: Vec::new(),
        attachments: Vec::new(),
        more_attachments: 0,
        utc_offsets_ns: Vec::new(),
        gaps: None,
    };
    while let Some(item) = recording.next_item()? {
        match item {
            Item::Message(message) => {
                if message.topic() == crate::format::GAPS_TOPIC {
                    info.gaps = serde_json::from_slice(message.tail).ok().or(info.gaps);
                }
                counts.entry(message.channel.id).or_default().add(&message);
            }
            Item::Attachment(_) if info.attachments.len() >= MAX_ATTACHMENTS => info.more_attachments += 1,
            Item::Attachment(a) => {
                let bytes = a.data.len() as u64;
                let (name, media_type) = (a.name.to_owned(), a.media_type.to_owned());
                info.attachments.push(AttachmentInfo { name, media_type, bytes });
            }
            Item::Metadata(m) => match m.name.as_str() {
                META_RECORDING => info.recording = m.entries,
                META_SEALED => info.sealed = Some(m.entries),
                META_CLOCK if info.utc_offsets_ns.len() < MAX_JUMPS => {
                    let offset = m.entries.get("utc_offset_ns").and_then(|v| v.parse::<i64>().ok());
                    info.utc_offsets_ns.extend(offset);
                }
                _ => {}
            },
        }
    }
    info.end = recording.end().clone();
    info.finished = info.end.finished;
    sum_up(&mut info, &recording, &counts);
    Ok(info)
}

fn seconds(first_ns: u64, last_ns: u64) -> f64 {
    last_ns.saturating_sub(first_ns) as f64 / 1e9
}

fn sum_up(info: &mut Info, recording: &Recording, counts: &BTreeMap<u16, Count>) {
    let none = Count::default();
    for channel in recording.channels() {
        let count = counts.get(&channel.id).unwrap_or(&none);
        let span = seconds(count.first_ns, count.last_ns);
        let rate = (span >= RATE_SPAN_S).then(|| count.messages.saturating_sub(1) as f64 / span);
        let numbered = channel.kind.is_some() && channel.message_encoding == "ros1";
        let missed = info.gaps.as_ref().and_then(|g| g.topics.get(&channel.topic)).map_or(0, |g| g.missed());
        info.channels.push(ChannelInfo {
            topic: channel.topic.clone(),
            kind: channel.kind,
            schema: channel.schema_name.clone(),
            encoding: channel.message_encoding.clone(),
            messages: count.messages,
            bytes: count.bytes,
            rate,
            first_ns: count.first_ns,
            last_ns: count.last_ns,
            gaps: numbered.then_some(count.gaps),
            missed,
        });
        if count.messages > 0 {
            info.first_ns =
                if info.messages == 0 { count.first_ns } else { info.first_ns.min(count.first_ns) };
            info.last_ns = info.last_ns.max(count.last_ns);
            info.messages += count.messages;
        }
    }
    info.duration_s = seconds(info.first_ns, info.last_ns);
    if info.duration_s > 0.0 {
        info.mb_per_h = info.bytes as f64 / info.duration_s * 3600.0 / 1e6;
    }
}

/// Characters of a name that are shown.
const SHOWN: usize = 160;

/// A file's own text, for a terminal: whatever it is, it neither moves the cursor nor fills the screen.
fn shown(text: &str) -> String {
    let clean = text.chars().map(|c| if c.is_control() { char::REPLACEMENT_CHARACTER } else { c });
    let mut shown: String = clean.take(SHOWN).collect();
    if text.chars().nth(SHOWN).is_some() {
        shown.push('…');
    }
    shown
}

impl fmt::Display for Info {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.fmt_head(f)?;
        for damage in &self.end.damages {
            let (at, reason, bytes) = (damage.offset, shown(&damage.reason), damage.bytes);
            writeln!(f, "  damage     at byte {at}: {reason} ({bytes} bytes left out)")?;
        }
        self.fmt_channels(f)
    }
}

impl Info {
    fn fmt_head(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let of = |key: &str| self.recording.get(key).map_or_else(|| "-".to_owned(), |v| shown(v));
        writeln!(f, "{}", shown(&self.path.display().to_string()))?;
        if self.recording.contains_key("imported_from") {
            let (from, what) = (of("imported_from"), of("imported_as"));
            let unknown = self.recording.get("direction").is_some_and(|v| v == "unknown");
            let direction = if unknown { "; it does not tell sent frames from received ones" } else { "" };
            writeln!(f, "  imported   from {from} ({what}), host {}{direction}", of("host"))?;
        } else {
            let (stack, file, build, host) = (of("stack"), of("stack_file"), of("build"), of("host"));
            writeln!(f, "  stack      {stack} ({file}), build {build}, host {host}")?;
        }
        writeln!(f, "  state      {}", self.state())?;
        if let Some(sealed) = &self.sealed {
            let lost = sealed.get("bytes_lost").map_or_else(|| "?".to_owned(), |v| shown(v));
            let why = sealed.get("reason").filter(|v| !v.is_empty()).map(|v| format!(" ({})", shown(v)));
            let why = why.unwrap_or_default();
            writeln!(f, "  sealed     afterwards; {lost} bytes could not be read{why}")?;
        }
        if self.messages > 0 {
            let (first, last) = (utc::iso(self.first_ns), utc::iso(self.last_ns));
            writeln!(f, "  time       {first} .. {last}, {:.3} s", self.duration_s)?;
        }
        let size = human(self.bytes);
        writeln!(f, "  size       {size}, {} messages, {:.1} MB/h", self.messages, self.mb_per_h)?;
        if self.utc_offsets_ns.len() > 1 {
            writeln!(f, "  clock      UTC jumped {} times", self.utc_offsets_ns.len() - 1)?;
        }
        if let Some(gaps) = &self.gaps {
            writeln!(f, "  recorder   {}{}", shown(&gaps.text), if gaps.last { "" } else { " so far" })?;
        }
        if !self.attachments.is_empty() {
            let name = |a: &AttachmentInfo| format!("{} ({})", shown(&a.name), human(a.bytes));
            let mut files: Vec<_> = self.attachments.iter().map(name).collect();
            if self.more_attachments > 0 {
                files.push(format!("and {} more", self.more_attachments));
            }
            writeln!(f, "  files      {}", files.join(", "))?;
        }
        Ok(())
    }

    fn fmt_channels(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let topics: Vec<String> = self.channels.iter().map(|c| shown(&c.topic)).collect();
        let width = topics.iter().map(|t| t.chars().count()).max().unwrap_or(0).max(5);
        writeln!(
            f,
            "  {:width$} {:>10} {:>12} {:>10} {:>8} {:>8}  schema",
            "topic", "messages", "bytes", "per s", "gaps", "missed"
        )?;
        for (c, topic) in self.channels.iter().zip(topics) {
            let gaps = c.gaps.map_or("-".to_owned(), |g| g.to_string());
            let rate = c.rate.map_or("-".to_owned(), |r| format!("{r:.1}"));
            let (messages, bytes, missed, schema) = (c.messages, c.bytes, c.missed, shown(&c.schema));
            writeln!(
                f,
                "  {topic:width$} {messages:>10} {bytes:>12} {rate:>10} {gaps:>8} {missed:>8}  {schema}"
            )?;
        }
        Ok(())
    }

    fn state(&self) -> String {
        let reason = self.end.reason.as_deref().unwrap_or("damaged");
        if self.finished && self.end.damaged == 0 {
            return "finished".to_owned();
        }
        if self.finished {
            return format!("finished, but {} damaged parts are left out", self.end.damaged);
        }
        if self.being_written {
            return "being written".to_owned();
        }
        let (at, unread) = (self.end.offset, self.end.unread);
        format!(
            "unfinished: {reason} (byte {at}, {unread} bytes unread); `dinrail recordings recover` makes it whole"
        )
    }
}
