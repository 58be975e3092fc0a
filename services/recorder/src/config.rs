//! The recorder's table of the stack file, what it declares, and what can be wrong with it before it runs.

use crate::disk;
use ipc_types::stack::{Finding, ServiceEntry, Stack};
use ipc_types::topic::TopicKind;
use ipc_types::units::{Size, Span};
use ipc_types::wiring::{Neighbours, Wiring};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// How chunks are written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Compression {
    /// Zstandard, level 3.
    #[default]
    Zstd,
    None,
}

/// Smallest `max_size`: below it a file would hold little more than its attachments.
pub const MIN_MAX_SIZE: Size = Size(1 << 20);
/// Bounds of `flush_interval`.
pub const FLUSH_INTERVAL: (Span, Span) = (Span::from_ms(5), Span::from_ms(1000));

/// Keys of a `recorder` service.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// Folder of the files, relative to the stack file. Made when missing.
    #[serde(default = "default_dir")]
    pub dir: PathBuf,
    /// A new file begins when the current one has this size. At least 1 MiB.
    #[serde(default = "default_max_size")]
    pub max_size: Size,
    /// ... or this age. Absent: no limit.
    #[serde(default)]
    pub max_time: Option<Span>,
    /// Bytes that the files of this stack may take together; the oldest finished ones are deleted first.
    #[serde(default = "default_keep")]
    pub keep: Size,
    /// Recording pauses while the file system has less free than this.
    #[serde(default = "default_min_free")]
    pub min_free: Size,
    /// A message is in the file at most this long after the recorder took it: what kill -9 can lose. 5 ms - 1 s.
    #[serde(default = "default_flush_interval")]
    pub flush_interval: Span,
    #[serde(default)]
    pub compression: Compression,
    /// Indexes for readers that jump to a time or topic (Foxglove, PlotJuggler): 16 bytes a message, which is a third
    /// of a quiet stack's recording. Without, every reader goes through the file from its start.
    #[serde(default = "default_index")]
    pub index: bool,
    /// Topics that are not recorded; a trailing `*` stands for any ending.
    #[serde(default)]
    pub exclude: Vec<String>,
}

fn default_dir() -> PathBuf {
    PathBuf::from("recordings")
}
fn default_max_size() -> Size {
    Size(100 << 20)
}
fn default_keep() -> Size {
    Size(2 << 30)
}
fn default_min_free() -> Size {
    Size(64 << 20)
}
fn default_flush_interval() -> Span {
    Span::from_ms(50)
}

fn default_index() -> bool {
    false
}

impl Default for Config {
    fn default() -> Self {
        Self {
            dir: default_dir(),
            max_size: default_max_size(),
            max_time: None,
            keep: default_keep(),
            min_free: default_min_free(),
            flush_interval: default_flush_interval(),
            compression: Compression::default(),
            index: default_index(),
            exclude: Vec::new(),
        }
    }
}

/// Whether a topic is meant by one of the patterns: its name, or its beginning followed by `*`.
pub fn matches(patterns: &[String], topic: &str) -> bool {
    patterns.iter().any(|pattern| match pattern.strip_suffix('*') {
        Some(start) => topic.starts_with(start),
        None => topic == pattern,
    })
}

impl Config {
    /// The folder of the files of this stack.
    pub fn folder(&self, stack_dir: &Path) -> PathBuf {
        stack_dir.join(&self.dir)
    }
}

/// Reads every recorded topic; asks each plc for a keyframe at the start of a file.
pub fn topics(_config: &Config, neighbours: &Neighbours) -> Wiring {
    let mut wiring = Wiring { records: true, ..Wiring::default() };
    for (name, kind) in &neighbours.services {
        if kind == "plc" {
            wiring.write(TopicKind::Jobs.of(name), "");
        }
    }
    wiring
}

/// What is wrong with the table, the folder and the disk.
pub fn check(config: &Config, stack: &Stack, me: &ServiceEntry) -> Vec<Finding> {
    let mut findings = Vec::new();
    limits(config, &me.name, &mut findings);
    excluded(config, stack, &me.name, &mut findings);
    let dir = config.folder(&stack.dir);
    if let Err(error) = disk::writable(&dir) {
        let help = "name a folder this user may write, or change its rights";
        findings.push(Finding::error(&me.name, "dir", error.to_string(), help));
    } else if let Some(free) = disk::free_bytes(&dir) {
        space(config, stack, &dir, free, &me.name, &mut findings);
    }
    for other in stack.services.iter().filter(|s| s.kind == me.kind && s.index < me.index) {
        let Ok(theirs) = serde_json::from_value::<Config>(other.config.clone()) else { continue };
        if same_folder(&theirs.folder(&stack.dir), &dir) {
            findings.push(Finding::error(
                &me.name,
                "dir",
                format!("'{}' records into {} as well", other.name, dir.display()),
                "give each recorder a folder of its own: each deletes its oldest files to stay below 'keep'",
            ));
        }
    }
    findings
}

/// Whether both names lead to one folder, by links or `..` too where it is there.
fn same_folder(a: &Path, b: &Path) -> bool {
    let real = |path: &Path| std::fs::canonicalize(path).unwrap_or_else(|_| path.to_owned());
    a == b || real(a) == real(b)
}

fn limits(config: &Config, me: &str, findings: &mut Vec<Finding>) {
    if config.max_size < MIN_MAX_SIZE {
        findings.push(Finding::error(
            me,
            "max_size",
            format!("max_size = {} is below {MIN_MAX_SIZE}", config.max_size),
            "a file needs room for its attachments and a keyframe; the default is \"100MiB\"",
        ));
    }
    if config.keep.0 <= config.max_size.0 {
        findings.push(Finding::error(
            me,
            "keep",
            format!("keep = {} is not above max_size = {}", config.keep, config.max_size),
            "the current file is never deleted, so 'keep' must hold at least one file more",
        ));
    }
    let (least, most) = FLUSH_INTERVAL;
    if config.flush_interval < least || config.flush_interval > most {
        findings.push(Finding::error(
            me,
            "flush_interval",
            format!("flush_interval = {} lies outside {least} .. {most}", config.flush_interval),
            "the default is \"50ms\"",
        ));
    }
    if config.max_time.is_some_and(|t| t < Span::from_ms(10_000)) {
        findings.push(Finding::error(
            me,
            "max_time",
            format!("max_time = {} is below 10s", config.max_time.unwrap_or_default()),
            "each file repeats configuration, program and a keyframe; use \"10s\" or more",
        ));
    }
}

fn excluded(config: &Config, stack: &Stack, me: &str, findings: &mut Vec<Finding>) {
    for (i, pattern) in config.exclude.iter().enumerate() {
        let key = format!("exclude[{i}]");
        let pattern_of_one = std::slice::from_ref(pattern);
        let meant: Vec<_> = stack.topics.iter().filter(|t| matches(pattern_of_one, &t.name)).collect();
        if !meant.iter().any(|t| t.kind.row().recorded) {
            let recorded: Vec<_> =
                stack.topics.iter().filter(|t| t.kind.row().recorded).map(|t| t.name.as_str()).collect();
            findings.push(Finding::error(
                me,
                &key,
                format!("no recorded topic of this stack is called '{pattern}'"),
                format!("recorded topics: {}", recorded.join(", ")),
            ));
        }
        for topic in meant.iter().filter(|t| matches!(t.kind, TopicKind::Scan | TopicKind::Keyframe)) {
            findings.push(Finding::warning(
                me,
                &key,
                format!("without '{}' the recording cannot be verified", topic.name),
                "leave the topic in, or expect `replay --verify` to have nothing to compare",
            ));
        }
    }
}

fn space(config: &Config, stack: &Stack, dir: &Path, free: u64, me: &str, findings: &mut Vec<Finding>) {
    if free < config.min_free.0 {
        findings.push(Finding::error(
            me,
            "min_free",
            format!(
                "{} has {} free, less than min_free = {}",
                dir.display(),
                disk::human(free),
                config.min_free
            ),
            "free space on that file system, choose another 'dir', or lower 'min_free'",
        ));
        return;
    }
    let taken: u64 = disk::recordings(dir, &stack.name).iter().map(|r| r.bytes).sum();
    let wanted = config.keep.0.saturating_sub(taken).saturating_add(config.min_free.0);
    if free < wanted {
        findings.push(Finding::warning(
            me,
            "keep",
            format!(
                "keep = {} does not fit: {} has {} free and {} of this stack's recordings",
                config.keep,
                dir.display(),
                disk::human(free),
                disk::human(taken)
            ),
            "recording will pause at 'min_free' before 'keep' is reached: lower 'keep' or free space",
        ));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{entry, stack_of};

    #[test]
    fn the_defaults_are_those_of_the_docs() {
        let config: Config = serde_json::from_str("{}").unwrap();
        assert_eq!(config, Config::default());
        assert!(serde_json::from_str::<Config>(r#"{"max_sise":"1MiB"}"#).is_err());
        let text = serde_json::to_string(&Config::default()).unwrap();
        assert_eq!(
            text,
            r#"{"dir":"recordings","max_size":"100MiB","max_time":null,"keep":"2GiB","min_free":"64MiB","flush_interval":"50ms","compression":"zstd","index":false,"exclude":[]}"#
        );
    }

    #[test]
    fn every_mistake_names_its_key() {
        let dir = crate::testing::TempDir::new("config");
        let mut stack =
            stack_of("check", dir.path(), &[("can0", TopicKind::CanRx), ("plc", TopicKind::Scan)]);
        let me = entry("rec", "recorder", 7);
        let good = Config { keep: Size(200 << 20), ..Config::default() };
        assert_eq!(check(&good, &stack, &me), vec![]);
        let table = [
            (Config { max_size: Size(1), ..good.clone() }, "max_size"),
            (Config { keep: Size(100 << 20), ..good.clone() }, "keep"),
            (Config { flush_interval: Span(1), ..good.clone() }, "flush_interval"),
            (Config { max_time: Some(Span::from_ms(1)), ..good.clone() }, "max_time"),
            (Config { exclude: vec!["can1/rx".into()], ..good.clone() }, "exclude[0]"),
            (Config { exclude: vec!["can0/rx".into(), "plc/*".into()], ..good.clone() }, "exclude[1]"),
            (Config { dir: "/proc/nope".into(), ..good.clone() }, "dir"),
            (Config { min_free: Size(1 << 60), ..good.clone() }, "min_free"),
            (Config { keep: Size(1 << 60), ..good.clone() }, "keep"),
        ];
        for (config, key) in table {
            let findings = check(&config, &stack, &me);
            assert_eq!(findings.len(), 1, "{key}: {findings:?}");
            assert_eq!(findings[0].key, key);
            assert!(!findings[0].help.is_empty());
        }
        let mut other = entry("first", "recorder", 1);
        other.config = serde_json::to_value(&good).unwrap();
        stack.services.push(other);
        let findings = check(&good, &stack, &me);
        assert!(findings[0].message.contains("'first' records into"), "{findings:?}");
        // Under another name.
        std::fs::create_dir(dir.path().join("recordings")).unwrap();
        std::os::unix::fs::symlink("recordings", dir.path().join("link")).unwrap();
        let linked = Config { dir: "link".into(), ..good.clone() };
        assert!(check(&linked, &stack, &me)[0].message.contains("'first' records into"));
    }

    #[test]
    fn it_reads_everything_and_asks_every_plc() {
        let neighbours = Neighbours {
            name: "rec".into(),
            services: vec![("plc".into(), "plc".into()), ("can0".into(), "can".into())],
            dir: PathBuf::new(),
            ..Neighbours::default()
        };
        let wiring = topics(&Config::default(), &neighbours);
        assert!(wiring.records && wiring.topics.is_empty() && wiring.reads.is_empty());
        assert_eq!(wiring.writes, vec![("plc/jobs".to_owned(), String::new())]);
    }
}
