//! What a service declares before it runs, so that the launcher can create its topics, open its sockets and
//! find conflicts without knowing the service.

use crate::topic::TopicKind;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::path::PathBuf;

/// One area of the process image.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[repr(u8)]
pub enum Area {
    Input = 0,
    Output = 1,
    Marker = 2,
}

impl Area {
    /// From the number in a message.
    pub fn from_u8(n: u8) -> Option<Self> {
        Some(match n {
            0 => Self::Input,
            1 => Self::Output,
            2 => Self::Marker,
            _ => return None,
        })
    }
    /// `I`, `Q` or `M`.
    pub const fn letter(self) -> char {
        match self {
            Self::Input => 'I',
            Self::Output => 'Q',
            Self::Marker => 'M',
        }
    }
}

/// Bytes of each area, at most 64 KiB.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct AreaSizes {
    pub input: u32,
    pub output: u32,
    pub marker: u32,
}

impl AreaSizes {
    /// The largest areas a plc service can have.
    pub const MAX: Self = Self { input: 65_536, output: 65_536, marker: 65_536 };

    /// Size of one area in bytes.
    pub const fn of(self, area: Area) -> u32 {
        match area {
            Area::Input => self.input,
            Area::Output => self.output,
            Area::Marker => self.marker,
        }
    }
}

impl Default for AreaSizes {
    /// 4 KiB each, the plc service's default.
    fn default() -> Self {
        Self { input: 4096, output: 4096, marker: 4096 }
    }
}

/// What a reader of the image sees of an input that went bad.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum OnBad {
    /// The last good value stays.
    #[default]
    Hold,
    /// All bytes become zero.
    Zero,
}

/// A range of the image that a service owns (%I) or uses (%Q, %M), with what `map` and `check` say about it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ImageRange {
    pub area: Area,
    /// First byte in the area.
    pub byte: u32,
    /// Bit of that byte, for a single bit; then `bytes` is 1.
    #[serde(default)]
    pub bit: Option<u8>,
    pub bytes: u32,
    /// IEC type of what lies there, e.g. `INT`; for symbols and `map`.
    #[serde(default)]
    pub type_name: Option<String>,
    /// Name of the VAR_GLOBAL made for the program.
    #[serde(default)]
    pub symbol: Option<String>,
    /// What the point is on the field side: `id 123h bits 0..15`, `holding register 5`.
    pub label: String,
    /// Key in the service's table: `in[2].to`, for messages that name the line.
    pub key: String,
    /// For inputs: what the PLC makes of it when the service dies.
    #[serde(default)]
    pub on_bad: OnBad,
    /// For inputs: %I byte that shows the [`crate::payload::Quality`] to the program; written by the PLC.
    #[serde(default)]
    pub status_byte: Option<u32>,
}

/// A topic that the service owns: it gives the limits. The rest of the row is [`TopicKind::row`]'s.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct TopicDecl {
    pub kind: TopicKind,
    pub depth: u32,
    pub max_tail: u32,
}

impl TopicDecl {
    /// With the table's limits.
    pub fn new(kind: TopicKind) -> Self {
        let row = kind.row();
        Self { kind, depth: row.depth, max_tail: row.max_tail }
    }
    #[must_use]
    pub fn depth(mut self, depth: u32) -> Self {
        self.depth = depth;
        self
    }
    #[must_use]
    pub fn max_tail(mut self, max_tail: u32) -> Self {
        self.max_tail = max_tail;
        self
    }
}

/// A topic the service reads.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Read {
    /// `can0/rx`.
    pub topic: String,
    /// Writers ring the service's inbox for it.
    pub wake: bool,
    /// Key of the stack file that asked for it: `bus`.
    pub key: String,
}

/// A TCP listener that the launcher opens and passes on as an inherited descriptor, so that a restarting server
/// refuses nobody and needs no privilege for port 502.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Listener {
    /// Name under which [`crate::Context::take_fd`] finds it.
    pub name: String,
    pub address: SocketAddr,
    pub key: String,
}

/// An event of a service that a plc task can be triggered by.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ServiceEvent {
    /// The inputs of one SYNC were published as one sample.
    Sync,
}

impl ServiceEvent {
    /// As the stack file writes it.
    pub const fn word(self) -> &'static str {
        match self {
            Self::Sync => "sync",
        }
    }
}

/// Everything a service declares.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Wiring {
    /// Topics it owns, named `<service>/<suffix>`. Health and status are added by the launcher for everyone.
    pub topics: Vec<TopicDecl>,
    pub reads: Vec<Read>,
    /// Topics of others it writes, with the key that asked for it.
    pub writes: Vec<(String, String)>,
    /// The plc service whose image it exchanges; its inputs go there.
    #[serde(default)]
    pub plc: Option<String>,
    /// Ranges of %I that it owns; the order is that of the `inputs` tail.
    pub inputs: Vec<ImageRange>,
    /// Ranges of %Q or %M that it reads.
    pub outputs: Vec<ImageRange>,
    pub listeners: Vec<Listener>,
    /// Bytes of RETAIN memory that the launcher must hold for it over restarts; 0 = none.
    #[serde(default)]
    pub retain_bytes: u32,
    /// Files it reads, relative to the stack file: must exist, become attachments of the recording.
    #[serde(default)]
    pub files: Vec<(PathBuf, String)>,
    /// Reads every recorded topic of the stack (the recorder).
    #[serde(default)]
    pub records: bool,
    /// Events of the service that may trigger the implicit task of its plc; it counts them in
    /// [`crate::payload::Inputs::samples`].
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub events: Vec<ServiceEvent>,
}

impl Wiring {
    /// Adds a topic of its own with the table's limits.
    pub fn own(&mut self, kind: TopicKind) -> &mut Self {
        self.topics.push(TopicDecl::new(kind));
        self
    }
    /// Adds a topic it reads.
    pub fn read(&mut self, topic: String, wake: bool, key: &str) -> &mut Self {
        self.reads.push(Read { topic, wake, key: key.to_owned() });
        self
    }
    /// Adds a topic of another service that it writes.
    pub fn write(&mut self, topic: String, key: &str) -> &mut Self {
        self.writes.push((topic, key.to_owned()));
        self
    }
}

/// Who else is in the stack, for defaults such as "the only plc".
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Neighbours {
    /// Name of the service itself.
    pub name: String,
    /// `(name, kind)` of all services in order of the stack file.
    pub services: Vec<(String, String)>,
    /// Folder of the stack file: relative paths start there.
    pub dir: PathBuf,
    /// Of each plc service, how its %-addresses count: `element`, `byte` or `openplc`.
    pub plc_addressing: BTreeMap<String, String>,
}

impl Neighbours {
    /// How %-addresses count in the image of this plc service; `element` when it is not known.
    pub fn addressing(&self, plc: Option<&str>) -> &str {
        plc.and_then(|plc| self.plc_addressing.get(plc)).map_or("element", String::as_str)
    }

    /// The service named by a key, or the only one of its kind when the key is absent.
    pub fn resolve(&self, kind: &str, named: Option<&str>) -> Option<String> {
        if let Some(name) = named {
            return Some(name.to_owned());
        }
        let mut of_kind = self.services.iter().filter(|(_, k)| k == kind);
        let only = of_kind.next()?;
        of_kind.next().is_none().then(|| only.0.clone())
    }
}
