//! What a reader of recordings hands over.

use ipc_types::payload::Stamp;
use ipc_types::topic::TopicKind;
use std::collections::BTreeMap;
use std::sync::Arc;

/// A stream of messages.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Channel {
    pub id: u16,
    pub topic: String,
    /// What it is on the rail; `None` for channels that are not of this version's topics.
    pub kind: Option<TopicKind>,
    pub message_encoding: String,
    pub schema_id: u16,
    pub schema_name: String,
    pub schema_encoding: String,
    /// Shared: a file may have thousands of channels of one large schema.
    pub schema: Arc<[u8]>,
    pub metadata: BTreeMap<String, String>,
}

/// A message, borrowed from the reader.
#[derive(Debug, Clone, Copy)]
pub struct Message<'a> {
    pub channel: &'a Channel,
    /// Who, when, which. Of JSON messages only `seq` (low 32 bits) and `t_ns` are known.
    pub stamp: Stamp,
    /// Header bytes as in shared memory; empty for JSON and unknown kinds.
    pub header: &'a [u8],
    /// Tail bytes, or the JSON text, or all bytes of an unknown kind.
    pub tail: &'a [u8],
    /// Header and tail in one piece.
    pub data: &'a [u8],
    pub sequence: u32,
    /// UTC in ns.
    pub log_time: u64,
    pub publish_time: u64,
}

impl Message<'_> {
    /// Name of the topic.
    pub fn topic(&self) -> &str {
        &self.channel.topic
    }
}

/// A file within the recording, borrowed from the reader.
#[derive(Debug, Clone, Copy)]
pub struct Attachment<'a> {
    pub name: &'a str,
    pub media_type: &'a str,
    pub log_time: u64,
    pub create_time: u64,
    pub data: &'a [u8],
}

/// A metadata record.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Metadata {
    pub name: String,
    pub entries: BTreeMap<String, String>,
}

/// What the reader hands over, in the order of the file.
#[derive(Debug)]
pub enum Item<'a> {
    Message(Message<'a>),
    Attachment(Attachment<'a>),
    Metadata(Metadata),
}

/// A part of the file that was left out.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize)]
pub struct Damage {
    /// Where the damaged record begins.
    pub offset: u64,
    pub bytes: u64,
    pub reason: String,
}

/// How a file ended.
#[derive(Debug, Clone, PartialEq, Eq, Default, serde::Serialize)]
pub struct End {
    /// Data, index and end are all there.
    pub finished: bool,
    /// The checksum over all data held: not a bit of them is another one than was written, and none is missing.
    pub checked: bool,
    /// Messages that no checksum covered.
    pub unchecked: u64,
    /// First byte that was not used.
    pub offset: u64,
    /// Bytes of data from there on that were not understood; 0 when the file ends between two records.
    pub unread: u64,
    /// Why reading ended, if not with the end of the data.
    pub reason: Option<String>,
    /// Chunks and records left out.
    pub damaged: u64,
    pub damaged_bytes: u64,
    /// The first [`MAX_DAMAGES`] of them.
    pub damages: Vec<Damage>,
}

/// A message that owns its bytes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct OwnedMessage {
    pub topic: String,
    pub kind: Option<TopicKind>,
    pub stamp: Stamp,
    pub header: Vec<u8>,
    pub tail: Vec<u8>,
    pub log_time: u64,
}
