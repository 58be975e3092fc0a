//! Reading any recording: finished, still being written, cut off at any byte, damaged.
//!
//! Streamed with bounded memory, never memory-mapped (a file that shrinks under a mapping kills the reader). No
//! length of the file is trusted; nothing here panics. A file that ends early is no error: what is there is
//! handed over, and [`Recording::end`] says where and why it ended. A chunk that fails its checksum is left
//! out, counted, and reading goes on behind it. What no checksum covered is counted too: whoever proves something from a
//! recording must know.

mod walk;

use crate::format::{META_CLOCK, META_RECORDING, RAW_CRC32, RAW_KEY};
pub use crate::item::{Attachment, Channel, Damage, End, Item, Message, Metadata, OwnedMessage};
use crate::record::{Bytes, Crc, Schema, attachment, kind_of, metadata, op, schema, stamp_of, tail_len};
use ipc_types::payload::{Encoding, Stamp};
use mcap::sans_io::LinearReader;
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, BufReader, Cursor, Read, Seek};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Largest chunk, compressed or not.
pub const MAX_CHUNK: u64 = 64 << 20;
/// Largest other record; larger ones are skipped, counted.
pub const MAX_RECORD: u64 = 64 << 20;
/// Most channels of a file.
pub const MAX_CHANNELS: usize = 4096;
/// Most bytes of all schemas together.
pub const MAX_SCHEMA_BYTES: usize = 16 << 20;
/// Largest metadata record, and most bytes of all channels together: they are kept as maps, which take many times as much.
pub const MAX_METADATA: u64 = 4 << 20;
/// Damages that are remembered one by one; the rest is only counted.
pub const MAX_DAMAGES: usize = 16;

/// Why a file cannot be read at all.
#[derive(Debug, thiserror::Error)]
pub enum ReadError {
    #[error("cannot open {path}: {source}; recordings lie in the `dir` of the stack's recorder")]
    Open { path: PathBuf, source: io::Error },
    #[error("{path} is no MCAP file: it does not begin with MCAP's magic bytes")]
    NotMcap { path: PathBuf },
    #[error("{path}: its attachments have more than {limit} bytes together; none of ours has")]
    Attachments { path: PathBuf, limit: usize },
    #[error("{path}: reading at byte {offset} failed: {source}; copy the file from its medium and try again")]
    Io { path: PathBuf, offset: u64, source: io::Error },
}

/// Where the next item lies.
#[derive(Clone, Copy)]
enum Place {
    Chunk { from: usize, to: usize },
    Record,
}

/// Where the bytes come from.
trait Source: Read + Seek + Send {}
impl<T: Read + Seek + Send> Source for T {}

/// A recording being read.
pub struct Recording {
    path: PathBuf,
    file: BufReader<Box<dyn Source>>,
    /// Length when it was opened: a file that grows meanwhile is read up to there.
    len: u64,
    offset: u64,
    /// The record read last.
    record: Vec<u8>,
    /// Records of the current chunk.
    chunk: Vec<u8>,
    chunk_at: usize,
    chunk_offset: u64,
    /// No checksum stands for what is in `chunk`.
    chunk_unchecked: bool,
    /// Raw messages of this file count only with their checksum behind them.
    raw_checked: bool,
    /// Of everything read, which is everything: nothing is skipped unread.
    crc: Crc,
    decoder: Option<LinearReader>,
    schemas: BTreeMap<u16, Schema>,
    schema_bytes: usize,
    channels: BTreeMap<u16, Channel>,
    channel_bytes: usize,
    utc_offset_ns: i64,
    end: End,
    ended: bool,
}

impl Recording {
    /// Opens a file. One that is shorter than the magic bytes is an empty recording.
    pub fn open(path: &Path) -> Result<Self, ReadError> {
        let opened = |source| ReadError::Open { path: path.to_owned(), source };
        let file = File::open(path).map_err(opened)?;
        let meta = file.metadata().map_err(opened)?;
        if meta.is_dir() {
            return Err(opened(io::Error::new(io::ErrorKind::IsADirectory, "it is a folder")));
        }
        Self::read(path, Box::new(file), meta.len())
    }

    /// Reads a recording in memory; errors call it `name`.
    pub fn from_bytes(name: &Path, bytes: Vec<u8>) -> Result<Self, ReadError> {
        let len = bytes.len() as u64;
        Self::read(name, Box::new(Cursor::new(bytes)), len)
    }

    fn read(path: &Path, source: Box<dyn Source>, len: u64) -> Result<Self, ReadError> {
        let mut recording = Self {
            path: path.to_owned(),
            file: BufReader::with_capacity(256 * 1024, source),
            len,
            offset: 0,
            record: Vec::new(),
            chunk: Vec::new(),
            chunk_at: 0,
            chunk_offset: 0,
            chunk_unchecked: false,
            raw_checked: false,
            crc: Crc::new(),
            decoder: None,
            schemas: BTreeMap::new(),
            schema_bytes: 0,
            channels: BTreeMap::new(),
            channel_bytes: 0,
            utc_offset_ns: 0,
            end: End::default(),
            ended: false,
        };
        let magic = mcap::MAGIC;
        let there = recording.len.min(magic.len() as u64) as usize;
        let mut start = [0u8; 8];
        recording.read_into(&mut start[..there])?;
        recording.offset = there as u64;
        if start[..there] != magic[..there] {
            return Err(ReadError::NotMcap { path: path.to_owned() });
        }
        if there < magic.len() {
            recording.stop("the file ends within MCAP's magic bytes", 0);
        }
        Ok(recording)
    }

    /// Where the file lies.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Bytes of the file when it was opened.
    pub fn len(&self) -> u64 {
        self.len
    }

    /// Whether nothing stands in it.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// The channels seen so far.
    pub fn channels(&self) -> impl Iterator<Item = &Channel> {
        self.channels.values()
    }

    /// UTC - CLOCK_MONOTONIC in ns, as recorded last before the current place.
    pub fn utc_offset_ns(&self) -> i64 {
        self.utc_offset_ns
    }

    /// How the file ended; complete after [`Self::next_item`] returned `None`.
    pub fn end(&self) -> &End {
        &self.end
    }

    /// The next message, attachment or metadata record in the order of the file; `None` at its end.
    pub fn next_item(&mut self) -> Result<Option<Item<'_>>, ReadError> {
        loop {
            let Some((opcode, place)) = self.advance()? else { return Ok(None) };
            match opcode {
                op::MESSAGE => {
                    if self.message_at(place).is_some() {
                        let covered = matches!(place, Place::Chunk { .. }) && !self.chunk_unchecked;
                        self.end.unchecked += u64::from(!covered);
                        // Asked twice, because a borrow cannot be returned from within a loop that goes on.
                        return Ok(self.message_at(place).map(Item::Message));
                    }
                    self.damage("a message of an unknown channel, or shorter than its header");
                }
                op::SCHEMA => self.schema(place),
                op::CHANNEL => self.channel(place),
                op::ATTACHMENT => {
                    if attachment(&self.record).is_some() {
                        return Ok(attachment(&self.record).map(Item::Attachment));
                    }
                    self.damage("an attachment whose lengths do not fit");
                }
                op::METADATA => match metadata(&self.record) {
                    Some(metadata) => {
                        self.follow(&metadata);
                        return Ok(Some(Item::Metadata(metadata)));
                    }
                    None => self.damage("a metadata record whose lengths do not fit"),
                },
                _ => {}
            }
        }
    }

    /// All messages, owned, in the order of the file.
    pub fn messages(self) -> Messages {
        Messages { recording: self }
    }

    fn message_at(&self, place: Place) -> Option<Message<'_>> {
        let (head, data) = self.bytes(place).split_first_chunk::<22>()?;
        let channel = self.channels.get(&u16::from_le_bytes([head[0], head[1]]))?;
        let sequence = u32::from_le_bytes([head[2], head[3], head[4], head[5]]);
        let time = |at: usize| head[at..at + 8].try_into().map_or(0, u64::from_le_bytes);
        let (log_time, publish_time) = (time(6), time(14));
        let t_ns = publish_time.checked_add_signed(self.utc_offset_ns.wrapping_neg()).unwrap_or(0);
        let mut stamp = Stamp { seq: u64::from(sequence), t_ns, generation: 0, writer: 0 };
        let (mut header, mut tail) = (&data[..0], data);
        if let Some(kind) = channel.kind.filter(|k| k.encoding() == Encoding::Ros1) {
            (header, tail) = data.split_at_checked(kind.header_bytes())?;
            stamp = stamp_of(header)?;
            let stated = if ipc_types::port::has_tail(kind) { tail_len(header)? } else { 0 };
            if stated != tail.len() {
                return None;
            }
        }
        Some(Message { channel, stamp, header, tail, data, sequence, log_time, publish_time })
    }

    fn schema(&mut self, place: Place) {
        let parsed = schema(self.bytes(place));
        let Some((id, schema)) = parsed else { return self.damage("a schema whose lengths do not fit") };
        if id == 0 || self.schemas.contains_key(&id) {
            return;
        }
        self.schema_bytes = self.schema_bytes.saturating_add(schema.data.len());
        if self.schema_bytes > MAX_SCHEMA_BYTES || self.schemas.len() >= MAX_CHANNELS {
            return self.damage("more schemas than the reader's limit");
        }
        self.schemas.insert(id, schema);
    }

    fn channel(&mut self, place: Place) {
        let record = self.bytes(place);
        let (mut bytes, len) = (Bytes(record), record.len());
        let parsed = (|| {
            let (id, schema_id) = (bytes.u16()?, bytes.u16()?);
            let (topic, message_encoding) = (bytes.string()?, bytes.string()?);
            Some((id, schema_id, topic.to_owned(), message_encoding.to_owned(), bytes.map()?))
        })();
        let Some((id, schema_id, topic, message_encoding, metadata)) = parsed else {
            return self.damage("a channel whose lengths do not fit");
        };
        if self.channels.contains_key(&id) {
            return;
        }
        self.channel_bytes = self.channel_bytes.saturating_add(len);
        if self.channels.len() >= MAX_CHANNELS || self.channel_bytes > MAX_METADATA as usize {
            return self.damage("more channels than the reader's limit");
        }
        let (schema_name, schema_encoding, schema) = match self.schemas.get(&schema_id) {
            Some(s) => (s.name.clone(), s.encoding.clone(), s.data.clone()),
            None if schema_id == 0 => (String::new(), String::new(), Arc::default()),
            None => return self.damage("a channel of an unknown schema"),
        };
        let kind = kind_of(&metadata, &message_encoding);
        let channel = Channel {
            id,
            topic,
            kind,
            message_encoding,
            schema_id,
            schema_name,
            schema_encoding,
            schema,
            metadata,
        };
        self.channels.insert(id, channel);
    }

    fn follow(&mut self, metadata: &Metadata) {
        if metadata.name == META_RECORDING {
            self.raw_checked = metadata.entries.get(RAW_KEY).is_some_and(|v| v == RAW_CRC32);
        }
        if metadata.name == META_CLOCK
            && let Some(offset) = metadata.entries.get("utc_offset_ns").and_then(|v| v.parse().ok())
        {
            self.utc_offset_ns = offset;
        }
    }
}

/// Iterator over the messages of a recording.
pub struct Messages {
    recording: Recording,
}

impl Messages {
    /// The recording, e.g. for its [`Recording::end`].
    pub fn recording(&self) -> &Recording {
        &self.recording
    }
}

impl Iterator for Messages {
    type Item = Result<OwnedMessage, ReadError>;

    fn next(&mut self) -> Option<Self::Item> {
        loop {
            match self.recording.next_item() {
                Ok(Some(Item::Message(m))) => {
                    return Some(Ok(OwnedMessage {
                        topic: m.channel.topic.clone(),
                        kind: m.channel.kind,
                        stamp: m.stamp,
                        header: m.header.to_vec(),
                        tail: m.tail.to_vec(),
                        log_time: m.log_time,
                    }));
                }
                Ok(Some(_)) => {}
                Ok(None) => return None,
                Err(error) => {
                    // An unreadable medium does not become readable by asking again.
                    self.recording.ended = true;
                    self.recording.chunk.clear();
                    return Some(Err(error));
                }
            }
        }
    }
}
