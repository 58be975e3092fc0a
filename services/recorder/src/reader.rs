//! Reading any recording: finished, still being written, cut off at any byte, damaged.
//!
//! Streamed with bounded memory, never memory-mapped (a file that shrinks under a mapping kills the reader). No
//! length of the file is trusted; nothing here panics. A file that ends early is no error: what is there is
//! handed over, and [`Recording::end`] says where and why it ended. A chunk that fails its checksum is left
//! out, counted, and reading goes on behind it.

use crate::format::META_CLOCK;
pub use crate::item::{Attachment, Channel, Damage, End, Item, Message, Metadata, OwnedMessage};
use crate::record::{
    Bytes, Schema, attachment, chunk_head, crc32, kind_of, metadata, op, schema, stamp_of, tail_len,
};
use ipc_types::payload::{Encoding, Stamp};
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, BufReader, Cursor, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

/// Largest chunk, compressed or not.
pub const MAX_CHUNK: u64 = 64 << 20;
/// Largest other record; larger ones are skipped, counted.
pub const MAX_RECORD: u64 = 64 << 20;
/// Most channels of a file.
pub const MAX_CHANNELS: usize = 4096;
/// Most bytes of all schemas together.
pub const MAX_SCHEMA_BYTES: usize = 16 << 20;
/// Damages that are remembered one by one; the rest is only counted.
pub const MAX_DAMAGES: usize = 16;

/// Why a file cannot be read at all.
#[derive(Debug, thiserror::Error)]
pub enum ReadError {
    #[error("cannot open {path}: {source}; `dinrail recordings` lists what is there")]
    Open { path: PathBuf, source: io::Error },
    #[error("{path} is no MCAP file: it does not begin with MCAP's magic bytes")]
    NotMcap { path: PathBuf },
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
    decoder: Option<LinearReader>,
    schemas: BTreeMap<u16, Schema>,
    schema_bytes: usize,
    channels: BTreeMap<u16, Channel>,
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
            decoder: None,
            schemas: BTreeMap::new(),
            schema_bytes: 0,
            channels: BTreeMap::new(),
            utc_offset_ns: 0,
            end: End::default(),
            ended: false,
        };
        let magic = mcap::MAGIC;
        let there = magic.len().min(recording.len as usize);
        let mut start = [0u8; 8];
        recording.read_into(&mut start[..there])?;
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
                        self.follow_clock(&metadata);
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

    fn bytes(&self, place: Place) -> &[u8] {
        match place {
            Place::Chunk { from, to } => self.chunk.get(from..to).unwrap_or_default(),
            Place::Record => &self.record,
        }
    }

    /// The next record, within the current chunk or of the file.
    fn advance(&mut self) -> Result<Option<(u8, Place)>, ReadError> {
        loop {
            if self.chunk_at < self.chunk.len() {
                if let Some(found) = self.advance_in_chunk() {
                    return Ok(Some(found));
                }
                continue;
            }
            if self.ended {
                return Ok(None);
            }
            let Some((opcode, len)) = self.record_head()? else { return Ok(None) };
            self.chunk_offset = self.offset;
            let whole = 9 + len;
            match opcode {
                op::DATA_END => {
                    self.finish(whole)?;
                    return Ok(None);
                }
                op::CHUNK if len <= MAX_CHUNK => {
                    if !self.load(len)? {
                        return Ok(None);
                    }
                    self.open_chunk(opcode, len);
                }
                op::SCHEMA | op::CHANNEL | op::MESSAGE | op::ATTACHMENT | op::METADATA | op::HEADER
                    if len <= MAX_RECORD =>
                {
                    if !self.load(len)? {
                        return Ok(None);
                    }
                    self.offset += whole;
                    return Ok(Some((opcode, Place::Record)));
                }
                op::CHUNK | op::ATTACHMENT | op::METADATA | op::MESSAGE | op::SCHEMA | op::CHANNEL => {
                    self.damage_of(self.offset, whole, "a record above the reader's limit");
                    self.skip(len)?;
                }
                // Indexes and private records.
                _ => self.skip(len)?,
            }
            self.offset += whole;
        }
    }

    /// Opcode and length of the record at `offset`; `None`, and ended, when no whole record is there.
    fn record_head(&mut self) -> Result<Option<(u8, u64)>, ReadError> {
        let left = self.len - self.offset;
        if left < 9 {
            self.stop(
                if left == 0 { "the file has no end yet" } else { "the file ends within a record" },
                left,
            );
            return Ok(None);
        }
        let mut head = [0u8; 9];
        if !self.read_into(&mut head)? {
            return Ok(None);
        }
        self.offset -= 9;
        let len =
            u64::from_le_bytes([head[1], head[2], head[3], head[4], head[5], head[6], head[7], head[8]]);
        let known = (1..=op::LAST).contains(&head[0]) || head[0] >= op::PRIVATE;
        if !known {
            self.stop("what follows is no MCAP record", left);
            return Ok(None);
        }
        if len > left - 9 {
            self.stop("the file ends within a record", left);
            return Ok(None);
        }
        Ok(Some((head[0], len)))
    }

    fn advance_in_chunk(&mut self) -> Option<(u8, Place)> {
        let rest = &self.chunk[self.chunk_at..];
        let bounds = rest.first_chunk::<9>().and_then(|head| {
            let len =
                u64::from_le_bytes([head[1], head[2], head[3], head[4], head[5], head[6], head[7], head[8]]);
            let len = usize::try_from(len).ok()?;
            (len <= rest.len() - 9).then_some((head[0], len))
        });
        let Some((opcode, len)) = bounds else {
            let bytes = rest.len() as u64;
            self.chunk_at = self.chunk.len();
            self.damage_of(self.chunk_offset, bytes, "a record that does not end within its chunk");
            return None;
        };
        let from = self.chunk_at + 9;
        self.chunk_at = from + len;
        let wanted = matches!(opcode, op::MESSAGE | op::SCHEMA | op::CHANNEL);
        wanted.then_some((opcode, Place::Chunk { from, to: from + len }))
    }

    /// Unpacks the chunk in `record`. A damaged one is left out.
    fn open_chunk(&mut self, opcode: u8, len: u64) {
        self.chunk.clear();
        self.chunk_at = 0;
        let unpacked = match chunk_head(&self.record) {
            Some(head) if head.compression.is_empty() => self.copy_chunk(head.crc, head.records),
            Some(head) if head.compression == "zstd" => self.unpack_chunk(opcode, len),
            Some(head) => Err(format!(
                "compression '{}' is not supported; convert the file with `mcap compress --compression zstd`",
                head.compression
            )),
            None => Err("a chunk whose lengths do not fit".to_owned()),
        };
        if let Err(reason) = unpacked {
            self.chunk.clear();
            self.damage_of(self.offset, 9 + len, &reason);
        }
    }

    fn copy_chunk(&mut self, crc: u32, records: (usize, usize)) -> Result<(), String> {
        let records = self.record.get(records.0..records.1).unwrap_or_default();
        if crc != 0 && crc32(records) != crc {
            return Err("a chunk that fails its checksum".to_owned());
        }
        self.chunk.extend_from_slice(records);
        Ok(())
    }

    /// Decompression is the mcap crate's: it is fed one whole chunk record at a time.
    fn unpack_chunk(&mut self, opcode: u8, len: u64) -> Result<(), String> {
        let mut decoder = self.decoder.take().unwrap_or_else(new_decoder);
        let mut head = [opcode; 9];
        head[1..].copy_from_slice(&len.to_le_bytes());
        let mut rest: &[u8] = &self.record;
        decoder.insert(9).copy_from_slice(&head);
        decoder.notify_read(9);
        loop {
            match decoder.next_event() {
                Some(Ok(LinearReadEvent::ReadRequest(wanted))) => {
                    if rest.is_empty() {
                        // It asks for the next record: the chunk is done. The decoder serves the next one too.
                        self.decoder = Some(decoder);
                        return Ok(());
                    }
                    let (now, later) = rest.split_at(wanted.clamp(1, rest.len()));
                    decoder.insert(now.len())[..now.len()].copy_from_slice(now);
                    decoder.notify_read(now.len());
                    rest = later;
                }
                Some(Ok(LinearReadEvent::Record { data, opcode })) => {
                    if self.chunk.len() + data.len() > MAX_CHUNK as usize {
                        return Err("a chunk above the reader's limit".to_owned());
                    }
                    self.chunk.push(opcode);
                    self.chunk.extend_from_slice(&(data.len() as u64).to_le_bytes());
                    self.chunk.extend_from_slice(data);
                }
                Some(Err(error)) => return Err(format!("a damaged chunk: {error}")),
                None => return Err("a damaged chunk".to_owned()),
            }
        }
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
        self.schema_bytes += schema.data.len();
        if self.schema_bytes > MAX_SCHEMA_BYTES || self.schemas.len() >= MAX_CHANNELS {
            return self.damage("more schemas than the reader's limit");
        }
        self.schemas.insert(id, schema);
    }

    fn channel(&mut self, place: Place) {
        let mut bytes = Bytes(self.bytes(place));
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
        if self.channels.len() >= MAX_CHANNELS {
            return self.damage("more channels than the reader's limit");
        }
        let (schema_name, schema_encoding, schema) = match self.schemas.get(&schema_id) {
            Some(s) => (s.name.clone(), s.encoding.clone(), s.data.clone()),
            None if schema_id == 0 => Default::default(),
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

    fn follow_clock(&mut self, metadata: &Metadata) {
        if metadata.name == META_CLOCK
            && let Some(offset) = metadata.entries.get("utc_offset_ns").and_then(|v| v.parse().ok())
        {
            self.utc_offset_ns = offset;
        }
    }

    /// Behind the data: whether index and end are there too.
    fn finish(&mut self, data_end: u64) -> Result<(), ReadError> {
        self.ended = true;
        self.end.offset = self.offset + data_end;
        let magic = mcap::MAGIC.len() as u64;
        if self.len < self.end.offset + magic {
            self.end.reason = Some("the file ends within its index".to_owned());
            return Ok(());
        }
        self.seek(SeekFrom::Start(self.len - magic))?;
        let mut last = [0u8; 8];
        self.read_into(&mut last)?;
        self.end.finished = last == *mcap::MAGIC;
        if !self.end.finished {
            self.end.reason = Some("the file ends within its index".to_owned());
        }
        Ok(())
    }

    fn stop(&mut self, reason: &str, unread: u64) {
        self.ended = true;
        self.end.offset = self.offset;
        self.end.unread = unread;
        self.end.reason = Some(reason.to_owned());
    }

    /// Something in the current record or chunk was left out.
    fn damage(&mut self, reason: &str) {
        self.damage_of(self.chunk_offset, 0, reason);
    }

    fn damage_of(&mut self, offset: u64, bytes: u64, reason: &str) {
        self.end.damaged += 1;
        self.end.damaged_bytes += bytes;
        if self.end.damages.len() < MAX_DAMAGES {
            self.end.damages.push(Damage { offset, bytes, reason: reason.to_owned() });
        }
    }

    /// Reads the record behind its head; `len` was checked against file and limit. `false`, and ended, when the
    /// file has become shorter meanwhile.
    fn load(&mut self, len: u64) -> Result<bool, ReadError> {
        let (at, mut record) = (self.offset, std::mem::take(&mut self.record));
        record.resize(len as usize, 0);
        if record.capacity() > 4 << 20 && record.len() < 1 << 20 {
            record.shrink_to(1 << 20);
        }
        let read = self.read_into(&mut record);
        self.record = record;
        // The caller counts the whole record.
        self.offset = at;
        read
    }

    fn skip(&mut self, len: u64) -> Result<(), ReadError> {
        let target = self.offset + 9 + len;
        self.seek(SeekFrom::Start(target))
    }

    fn seek(&mut self, to: SeekFrom) -> Result<(), ReadError> {
        let offset = self.offset;
        self.file.seek(to).map_err(|source| ReadError::Io { path: self.path.clone(), offset, source })?;
        Ok(())
    }

    /// Reads and counts; `false`, and ended, when the file has become shorter meanwhile.
    fn read_into(&mut self, bytes: &mut [u8]) -> Result<bool, ReadError> {
        match self.file.read_exact(bytes) {
            Ok(()) => {
                self.offset += bytes.len() as u64;
                Ok(true)
            }
            Err(e) if e.kind() == io::ErrorKind::UnexpectedEof => {
                self.stop("the file became shorter while it was read", 0);
                Ok(false)
            }
            Err(source) => Err(ReadError::Io { path: self.path.clone(), offset: self.offset, source }),
        }
    }
}

fn new_decoder() -> LinearReader {
    LinearReader::new_with_options(
        LinearReaderOptions::default()
            .with_skip_start_magic(true)
            .with_skip_end_magic(true)
            .with_prevalidate_chunk_crcs(true)
            .with_record_length_limit(MAX_CHUNK as usize),
    )
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
