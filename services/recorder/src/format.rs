//! What stands in a recording: channels, metadata records, attachments.
//!
//! A message of a topic with [`Encoding::Ros1`] is header and tail as they stand in shared memory, which is
//! ROS 1's packed encoding of the schema that the header's struct generates. Events and status are JSON: the
//! tail alone. `log_time` and `publish_time` are the message's stamp as UTC, `sequence` the low half of its `seq`.

use crate::config::matches;
use crate::file::ChannelSpec;
use ipc_types::event::{EventBody, EventKind};
use ipc_types::payload::Encoding;
use ipc_types::stack::{Stack, TopicEntry};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

/// Channel of the recorder's own counters.
pub const GAPS_TOPIC: &str = "recorder/gaps";
/// Metadata record with what was recorded.
pub const META_RECORDING: &str = "dinrail.recording";
/// Metadata record with UTC against CLOCK_MONOTONIC.
pub const META_CLOCK: &str = "dinrail.clock";
/// Metadata record of a file that [`crate::seal`] made whole.
pub const META_SEALED: &str = "dinrail.sealed";
/// Entry of [`META_RECORDING`]: how the messages behind the last chunk are protected ...
pub const RAW_KEY: &str = "raw";
/// ... by private records with the CRC-32 of everything from the end of the last chunk up to them.
pub const RAW_CRC32: &str = "crc32";
/// Attachment with the text of the stack file.
pub const STACK_TEXT: &str = "stack.toml";
/// Attachment with the resolved stack.
pub const RESOLVED_STACK: &str = "stack.json";
/// Channel metadata key with the [`ipc_types::topic::TopicKind`].
pub const KIND_KEY: &str = "kind";
/// Largest file that becomes an attachment.
pub const MAX_ATTACHMENT: u64 = 16 << 20;

/// Channel metadata key with the payload's type name on the rail: `dinrail.CanFrame/1`.
pub const PAYLOAD_KEY: &str = "payload";

/// Any JSON object: readers that insist on a schema get one.
const ANY_OBJECT: &str = r#"{"type":"object"}"#;

/// Topics of the stack that are recorded, in the stack's order.
pub fn recorded_topics<'a>(stack: &'a Stack, exclude: &[String]) -> Vec<&'a TopicEntry> {
    stack.topics.iter().filter(|t| t.kind.row().recorded && !matches(exclude, &t.name)).collect()
}

/// Name of a payload's schema: `dinrail.CanFrame/1` is `dinrail_v1/CanFrame`. ROS 1's decoders make identifiers
/// of package and type, so the version stands in the package.
pub fn schema_name(payload: &str) -> String {
    let named = payload.split_once('.').and_then(|(package, rest)| Some((package, rest.split_once('/')?)));
    named.map_or_else(
        || payload.to_owned(),
        |(package, (name, version))| format!("{package}_v{version}/{name}"),
    )
}

/// The channel of a topic.
pub fn channel(topic: &TopicEntry) -> ChannelSpec {
    let kind = serde_json::to_value(topic.kind).ok().and_then(|v| v.as_str().map(str::to_owned));
    let (message_encoding, schema_encoding, schema) = match topic.kind.encoding() {
        Encoding::Ros1 => ("ros1", "ros1msg", topic.kind.ros1msg()),
        Encoding::Json => ("json", "jsonschema", ANY_OBJECT.to_owned()),
    };
    ChannelSpec {
        topic: topic.name.clone(),
        message_encoding: message_encoding.into(),
        schema_name: schema_name(topic.kind.row().payload),
        schema_encoding: schema_encoding.into(),
        schema,
        metadata: BTreeMap::from([
            (KIND_KEY.to_owned(), kind.unwrap_or_default()),
            (PAYLOAD_KEY.to_owned(), topic.kind.row().payload.to_owned()),
            ("writers".to_owned(), topic.writers.join(",")),
        ]),
    }
}

/// The channel of [`Gaps`].
pub fn gaps_channel() -> ChannelSpec {
    ChannelSpec {
        topic: GAPS_TOPIC.into(),
        message_encoding: "json".into(),
        schema_name: schema_name("dinrail.Gaps/1"),
        schema_encoding: "jsonschema".into(),
        schema: ANY_OBJECT.into(),
        metadata: BTreeMap::new(),
    }
}

/// Counters of one topic since the file began.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct TopicGaps {
    /// Messages in this file.
    pub recorded: u64,
    /// Replaced on the rail before the recorder read them.
    pub lost: u64,
    /// Dropped: of an older generation of the writer, or a number already seen.
    pub old: u64,
    /// Dropped: header and tail disagreed.
    pub malformed: u64,
    /// Read, but not written: the disk was too slow or full.
    pub dropped: u64,
}

impl TopicGaps {
    /// Messages that should be in the file and are not.
    pub fn missed(&self) -> u64 {
        self.lost.saturating_add(self.malformed).saturating_add(self.dropped)
    }
}

/// A message of [`GAPS_TOPIC`]: when a counter of losses changed, every 10 s, and at the end of the file.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Gaps {
    /// Last one of the file.
    #[serde(rename = "final")]
    pub last: bool,
    /// `recorded n, missed m`.
    pub text: String,
    pub recorded: u64,
    pub missed: u64,
    pub topics: BTreeMap<String, TopicGaps>,
}

impl Gaps {
    /// Sums up; topics without any message are left out.
    pub fn new(topics: impl Iterator<Item = (String, TopicGaps)>, last: bool) -> Self {
        let topics: BTreeMap<_, _> = topics.filter(|(_, g)| *g != TopicGaps::default()).collect();
        let recorded = topics.values().map(|g| g.recorded).sum();
        let missed = topics.values().map(TopicGaps::missed).sum();
        Self { last, text: format!("recorded {recorded}, missed {missed}"), recorded, missed, topics }
    }
}

/// Name of this machine.
pub fn host_name() -> String {
    let name = std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
    name.trim().to_owned()
}

/// Entries of [`META_RECORDING`].
pub fn recording_metadata(
    stack: &Stack,
    recorder: &str,
    generation: u32,
    n: u64,
) -> BTreeMap<String, String> {
    let stack_hash = xxhash_rust::xxh3::xxh3_64(stack.text.as_bytes());
    BTreeMap::from([
        ("stack".to_owned(), stack.name.clone()),
        ("stack_file".to_owned(), stack.file.display().to_string()),
        ("stack_hash".to_owned(), format!("xxh3:{stack_hash:016x}")),
        ("build".to_owned(), stack.build_id.clone()),
        ("version".to_owned(), env!("CARGO_PKG_VERSION").to_owned()),
        ("host".to_owned(), host_name()),
        ("recorder".to_owned(), recorder.to_owned()),
        ("recorder_generation".to_owned(), generation.to_string()),
        ("file".to_owned(), n.to_string()),
        (RAW_KEY.to_owned(), RAW_CRC32.to_owned()),
    ])
}

/// Entries of [`META_CLOCK`].
pub fn clock_metadata(utc_offset_ns: i64, t_ns: u64, reason: &str) -> BTreeMap<String, String> {
    BTreeMap::from([
        ("utc_offset_ns".to_owned(), utc_offset_ns.to_string()),
        ("t_ns".to_owned(), t_ns.to_string()),
        ("reason".to_owned(), reason.to_owned()),
    ])
}

/// UTC of a stamp as an MCAP time; 0 when it lies before 1970.
pub fn utc_of(t_ns: u64, utc_offset_ns: i64) -> u64 {
    t_ns.checked_add_signed(utc_offset_ns).unwrap_or(0)
}

/// A file that goes with the recording.
#[derive(Debug, Clone)]
pub struct AttachedFile {
    /// As the stack file names it: `main.st`, `eds/io.eds`.
    pub name: String,
    path: PathBuf,
    /// What it looked like when it was read last.
    seen: Option<(SystemTime, u64)>,
}

/// The files of all services, each once.
pub fn attached_files(stack: &Stack) -> Vec<AttachedFile> {
    let mut files: Vec<AttachedFile> = Vec::new();
    for (file, _key) in stack.services.iter().flat_map(|s| &s.wiring.files) {
        let (name, path) = (file.display().to_string(), stack.dir.join(file));
        if !files.iter().any(|f| f.name == name) {
            files.push(AttachedFile { name, path, seen: None });
        }
    }
    files
}

impl AttachedFile {
    /// The content, when it is not what was read last. An unreadable or too large file is told as an error text.
    pub fn read_if_changed(&mut self) -> Option<Result<Vec<u8>, String>> {
        let meta = match std::fs::metadata(&self.path) {
            Ok(meta) => meta,
            Err(e) => return self.fails(e.to_string()),
        };
        let look = (meta.modified().unwrap_or(SystemTime::UNIX_EPOCH), meta.len());
        if self.seen == Some(look) {
            return None;
        }
        if meta.len() > MAX_ATTACHMENT {
            return self.fails(format!("larger than {MAX_ATTACHMENT} bytes"));
        }
        match std::fs::read(&self.path) {
            Ok(data) => {
                self.seen = Some(look);
                Some(Ok(data))
            }
            Err(e) => self.fails(e.to_string()),
        }
    }

    fn fails(&mut self, cause: String) -> Option<Result<Vec<u8>, String>> {
        // Told once: the mark of a file that cannot be read is one that no file has.
        let mark = (SystemTime::UNIX_EPOCH, u64::MAX);
        if self.seen.replace(mark) == Some(mark) {
            return None;
        }
        Some(Err(format!("{} is not in the recording: {cause}", self.path.display())))
    }

    /// Makes the next look read it again: a new file needs it whole.
    pub fn forget(&mut self) {
        self.seen = None;
    }
}

/// Modules of each plc that are looked at: the running one, and the one that a load has just replaced.
const MODULES_EACH: usize = 2;

/// The compiled programs that the stack's plcs left in its root, `<svc>.<hash>.wasm`, the newest of each plc last.
/// So a recording verifies alone, wherever a program was loaded from and whatever became of its source.
pub fn modules(stack: &Stack) -> Vec<(String, PathBuf)> {
    let mut found: Vec<(String, SystemTime, String)> = Vec::new();
    for entry in std::fs::read_dir(&stack.root).into_iter().flatten().flatten() {
        let Ok(name) = entry.file_name().into_string() else { continue };
        let Some(service) = module_of(&name) else { continue };
        let is_plc = stack.service(service).is_some_and(|s| s.kind == "plc");
        // No link, whatever it leads to: only what a plc wrote itself.
        let Some(meta) = entry.metadata().ok().filter(|m| m.is_file() && is_plc) else { continue };
        let written = meta.modified().unwrap_or(SystemTime::UNIX_EPOCH);
        found.push((service.to_owned(), written, name.clone()));
    }
    found.sort();
    let newer = |i: usize| found[i + 1..].iter().filter(|(service, ..)| *service == found[i].0).count();
    (0..found.len())
        .filter(|i| newer(*i) < MODULES_EACH)
        .map(|i| (found[i].2.clone(), stack.root.join(&found[i].2)))
        .collect()
}

/// The content of a file that is to be attached, or why it cannot be.
pub fn read_attachment(path: &Path) -> Result<Vec<u8>, String> {
    let why = |cause: String| format!("{} is not in the recording: {cause}", path.display());
    let bytes = std::fs::metadata(path).map_err(|e| why(e.to_string()))?.len();
    if bytes > MAX_ATTACHMENT {
        return Err(why(format!("larger than {MAX_ATTACHMENT} bytes")));
    }
    std::fs::read(path).map_err(|e| why(e.to_string()))
}

/// The service of a module's file name.
fn module_of(name: &str) -> Option<&str> {
    let (service, hash) = name.strip_suffix(".wasm")?.rsplit_once('.')?;
    (hash.len() == 16 && hash.bytes().all(|b| b.is_ascii_hexdigit())).then_some(service)
}

/// Whether an event says that a program was loaded.
pub fn says_loaded(event: &[u8]) -> bool {
    let word = b"\"loaded\"";
    event.windows(word.len()).any(|w| w == word)
        && serde_json::from_slice::<EventBody>(event).is_ok_and(|body| body.event == EventKind::Loaded)
}

/// Media type by the ending of a name.
pub fn media_type(name: &str) -> &'static str {
    match Path::new(name).extension().and_then(|e| e.to_str()) {
        Some("toml") => "application/toml",
        Some("json") => "application/json",
        Some("xml") => "application/xml",
        Some("wasm") => "application/wasm",
        Some("st" | "il" | "eds" | "dcf" | "dbc" | "log" | "txt") => "text/plain",
        _ => "application/octet-stream",
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{TempDir, stack_of};
    use ipc_types::topic::TopicKind;

    #[test]
    fn channels_follow_the_topic_table() {
        let all: Vec<_> = TopicKind::ALL.map(|kind| ("svc", kind)).into();
        let stack = stack_of("all", Path::new("/"), &all);
        let recorded = recorded_topics(&stack, &["svc/inp*".to_owned()]);
        let names: Vec<_> = recorded.iter().map(|t| t.name.as_str()).collect();
        assert_eq!(
            names,
            // Of a CAN and of a serial driver.
            ["svc/rx", "svc/rx", "svc/scan", "svc/keyframe", "svc/results", "svc/status", "stack/events"]
        );
        let frames = channel(recorded[0]);
        assert_eq!((frames.message_encoding.as_str(), frames.schema_encoding.as_str()), ("ros1", "ros1msg"));
        assert_eq!(frames.schema, TopicKind::CanRx.ros1msg());
        assert_eq!(frames.metadata["kind"], "can_rx");
        let events = channel(recorded[6]);
        assert_eq!(
            (events.message_encoding.as_str(), events.schema_name.as_str()),
            ("json", "dinrail_v1/Event")
        );
        assert_eq!(frames.schema_name, "dinrail_v1/CanFrame");
        assert_eq!(frames.metadata["payload"], "dinrail.CanFrame/1");
    }

    #[test]
    fn a_changed_file_is_read_again_and_a_missing_one_told_once() {
        let dir = TempDir::new("attached");
        std::fs::write(dir.path().join("main.st"), "A").unwrap();
        let mut stack = stack_of("files", dir.path(), &[]);
        let mut plc = crate::testing::entry("plc", "plc", 1);
        plc.wiring.files = vec![
            ("main.st".into(), "program[0]".into()),
            ("gone.eds".into(), "eds".into()),
            ("main.st".into(), "x".into()),
        ];
        stack.services.push(plc);
        let mut files = attached_files(&stack);
        assert_eq!(files.len(), 2);
        assert_eq!(files[0].read_if_changed(), Some(Ok(b"A".to_vec())));
        assert_eq!(files[0].read_if_changed(), None);
        std::fs::write(dir.path().join("main.st"), "BC").unwrap();
        assert_eq!(files[0].read_if_changed(), Some(Ok(b"BC".to_vec())));
        files[0].forget();
        assert_eq!(files[0].read_if_changed(), Some(Ok(b"BC".to_vec())));
        assert!(matches!(files[1].read_if_changed(), Some(Err(text)) if text.contains("gone.eds is not in")));
        assert_eq!(files[1].read_if_changed(), None);
    }

    #[test]
    fn the_newest_modules_of_each_plc_are_found() {
        let dir = TempDir::new("modules");
        let mut stack = stack_of("modules", dir.path(), &[]);
        stack.root = dir.path().to_owned();
        for (name, kind) in [("plc", "plc"), ("plc2", "plc"), ("io", "can-io")] {
            stack.services.push(crate::testing::entry(name, kind, 1));
        }
        assert!(modules(&stack).is_empty());
        let write = |name: &str, age_s: u64| {
            let file = std::fs::File::create(dir.path().join(name)).unwrap();
            file.set_modified(SystemTime::UNIX_EPOCH + std::time::Duration::from_secs(1000 - age_s)).unwrap();
        };
        write("plc.00000000000000aa.wasm", 30);
        write("plc.00000000000000bb.wasm", 10);
        write("plc.00000000000000cc.wasm", 20);
        write("plc2.00000000000000dd.wasm", 99);
        for no in [
            "io.00000000000000aa.wasm",
            "gone.00000000000000aa.wasm",
            "plc.12.wasm",
            "plc.wasm",
            "stack.json",
        ] {
            write(no, 0);
        }
        std::os::unix::fs::symlink("/etc/passwd", dir.path().join("plc.00000000000000ee.wasm")).unwrap();
        let names: Vec<_> = modules(&stack).into_iter().map(|(name, _)| name).collect();
        assert_eq!(
            names,
            ["plc.00000000000000cc.wasm", "plc.00000000000000bb.wasm", "plc2.00000000000000dd.wasm"]
        );
    }

    #[test]
    fn only_a_loaded_event_says_loaded() {
        let event = |kind| {
            let body = EventBody::now(
                kind,
                ipc_types::event::Level::Info,
                "plc",
                "\"loaded\"",
                serde_json::Value::Null,
            );
            serde_json::to_vec(&body).unwrap()
        };
        assert!(says_loaded(&event(EventKind::Loaded)));
        assert!(!says_loaded(&event(EventKind::Died)));
        assert!(!says_loaded(br#"{"event":"loaded"}"#) && !says_loaded(b""));
    }

    #[test]
    fn counters_sum_up() {
        let gaps = Gaps::new(
            [
                ("a".to_owned(), TopicGaps { recorded: 5, lost: 1, old: 9, malformed: 2, dropped: 3 }),
                ("b".to_owned(), TopicGaps { recorded: 7, ..TopicGaps::default() }),
                ("c".to_owned(), TopicGaps::default()),
            ]
            .into_iter(),
            true,
        );
        assert_eq!(gaps.text, "recorded 12, missed 6");
        assert_eq!(gaps.topics.len(), 2);
        assert!(serde_json::to_string(&gaps).unwrap().starts_with(r#"{"final":true,"text":"recorded 12"#));
    }

    #[test]
    fn times_before_1970_become_zero() {
        assert_eq!(utc_of(5, -10), 0);
        assert_eq!(utc_of(5, 10), 15);
    }
}
