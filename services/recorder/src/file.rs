//! One MCAP file being written.
//!
//! Small chunks compress badly and cost an index each, large ones are lost whole when the process is killed. So
//! a chunk is closed when it is full or three seconds old, and until then its messages also stand *raw* behind the
//! last chunk, as plain MCAP message records, which is where readers find them after kill -9. The chunk, when
//! it is closed, takes their place. At every moment the file is a valid MCAP file without its end.
//!
//! MCAP knows no checksum of such messages. So private records with one stand among them, which other readers pass over:
//! behind every flush, and every few kilobytes. Ours believes no raw message without.

use crate::config::Compression;
use crate::record::{Crc, op, raw_check};
use crate::sink::Sink;
use mcap::records::{MessageHeader, Metadata};
use mcap::{Attachment, McapError, McapResult, WriteOptions, Writer};
use std::borrow::Cow;
use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::os::unix::fs::FileExt;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

/// Uncompressed bytes after which a chunk is closed.
pub const CHUNK_BYTES: usize = 256 * 1024;
/// Age after which a chunk is closed: how much a torn write of a chunk can lose at most.
pub const CHUNK_AGE: Duration = Duration::from_secs(3);
/// Bytes of a message record before its data: opcode, length, channel, sequence, two times.
const MESSAGE_HEAD: usize = 1 + 8 + 2 + 4 + 8 + 8;
/// Bytes of raw messages after which a checksum stands: what a torn write can cost of them.
const CHECK_EVERY: usize = 4096;
/// Chunks after which a file is full, whatever its size: the MCAP writer keeps 136 bytes of each until the end, with
/// indexes about 30 more a channel. A quiet stack closes one every three seconds: 27 h a file, and 4.3 MiB.
pub const MAX_CHUNKS: u32 = 32_768;
/// zstd level: 3 saves another tenth of a quiet stack's bytes over 1; above it nothing is gained.
const LEVEL: u32 = 3;

/// The file. Every error leaves what was written before it readable.
pub struct RecordingFile {
    writer: Writer<Sink>,
    file: Arc<File>,
    /// Bytes of closed chunks and other records.
    written: Arc<AtomicU64>,
    /// Raw messages of the open chunk, with their checksums.
    raw: Vec<u8>,
    /// How many bytes of them are in the file, behind `written`.
    raw_in_file: usize,
    /// How many of them a checksum covers, and the checksum of all of them.
    raw_checked: usize,
    raw_crc: Crc,
    chunk_bytes: usize,
    chunk_since: Option<Instant>,
    chunks: u32,
    copied_schemas: BTreeSet<u16>,
}

/// What a channel is made of.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ChannelSpec {
    pub topic: String,
    /// `ros1` or `json`.
    pub message_encoding: String,
    pub schema_name: String,
    /// `ros1msg` or `jsonschema`.
    pub schema_encoding: String,
    pub schema: String,
    pub metadata: BTreeMap<String, String>,
}

impl RecordingFile {
    /// Begins an empty file; without `index` readers must go through it from the start.
    pub fn new(file: Arc<File>, compression: Compression, index: bool) -> McapResult<Self> {
        let written = Arc::new(AtomicU64::new(0));
        let sink = Sink::new(file.clone(), written.clone());
        let options = WriteOptions::new()
            .profile("x-dinrail")
            .library(concat!("dinrail-recorder ", env!("CARGO_PKG_VERSION")))
            .compression(match compression {
                Compression::Zstd => Some(mcap::Compression::Zstd),
                Compression::None => None,
            })
            .compression_level(LEVEL)
            .compression_threads(0)
            .use_chunks(true)
            // Never reached: chunks are closed here, because their raw messages must go with them. A buffer of this size is
            // allocated a file.
            .chunk_size(Some(2 * CHUNK_BYTES as u64))
            .emit_message_indexes(index)
            // Chunk indexes alone are an error to some readers (Foxglove), a file without any is not.
            .emit_chunk_indexes(index)
            .disable_seeking(true);
        let writer = options.create(sink)?;
        Ok(Self {
            writer,
            file,
            written,
            raw: Vec::with_capacity(CHUNK_BYTES + CHUNK_BYTES / 64),
            raw_in_file: 0,
            raw_checked: 0,
            raw_crc: Crc::new(),
            chunk_bytes: 0,
            chunk_since: None,
            chunks: 0,
            copied_schemas: BTreeSet::new(),
        })
    }

    /// Adds a channel; its number. Call [`Self::close_chunk`] after the last one: raw messages need their
    /// channel before them.
    pub fn add_channel(&mut self, spec: &ChannelSpec) -> McapResult<u16> {
        let schema =
            self.writer.add_schema(&spec.schema_name, &spec.schema_encoding, spec.schema.as_bytes())?;
        self.writer.add_channel(schema, &spec.topic, &spec.message_encoding, &spec.metadata)
    }

    /// Adds a channel of another file under its own number.
    pub fn copy_channel(&mut self, channel: &crate::reader::Channel) -> McapResult<()> {
        let (id, schema) = (channel.id, channel.schema_id);
        // Once each: the MCAP writer would compare the whole text.
        if schema != 0 && self.copied_schemas.insert(schema) {
            let (name, encoding) = (&channel.schema_name, &channel.schema_encoding);
            self.writer.add_schema_with_id(schema, name, encoding, &channel.schema)?;
        }
        self.writer.add_channel_with_id(
            id,
            schema,
            &channel.topic,
            &channel.message_encoding,
            &channel.metadata,
        )?;
        Ok(())
    }

    /// Adds a message; it is in the file after [`Self::flush`].
    pub fn message(&mut self, head: &MessageHeader, data: &[u8], now: Instant) -> McapResult<()> {
        let bytes = MESSAGE_HEAD + data.len();
        if self.chunk_bytes > 0 && self.chunk_bytes + bytes > CHUNK_BYTES {
            self.close_chunk()?;
        }
        self.writer.write_to_known_channel(head, data)?;
        self.chunk_bytes += bytes;
        self.chunk_since.get_or_insert(now);
        let from = self.raw.len();
        self.raw.push(op::MESSAGE);
        self.raw.extend_from_slice(&((bytes - 9) as u64).to_le_bytes());
        self.raw.extend_from_slice(&head.channel_id.to_le_bytes());
        self.raw.extend_from_slice(&head.sequence.to_le_bytes());
        self.raw.extend_from_slice(&head.log_time.to_le_bytes());
        self.raw.extend_from_slice(&head.publish_time.to_le_bytes());
        self.raw.extend_from_slice(data);
        self.raw_crc.add(&self.raw[from..]);
        if self.raw.len() - self.raw_checked >= CHECK_EVERY {
            self.check_raw();
        }
        Ok(())
    }

    /// Puts the checksum behind the raw messages.
    fn check_raw(&mut self) {
        if self.raw.len() == self.raw_checked {
            return;
        }
        let record = raw_check(self.raw_crc.value());
        self.raw.extend_from_slice(&record);
        self.raw_crc.add(&record);
        self.raw_checked = self.raw.len();
    }

    /// Adds a message without its raw copy: for files that nobody reads before they are finished.
    pub fn message_chunked(&mut self, head: &MessageHeader, data: &[u8]) -> McapResult<()> {
        if self.chunk_bytes > CHUNK_BYTES {
            self.close_chunk()?;
        }
        self.chunk_bytes += MESSAGE_HEAD + data.len();
        self.writer.write_to_known_channel(head, data)
    }

    /// Everything so far is in the file after this, in a chunk or raw.
    pub fn flush(&mut self, now: Instant) -> McapResult<()> {
        if self.chunk_since.is_some_and(|since| now.duration_since(since) >= CHUNK_AGE) {
            return self.close_chunk();
        }
        self.check_raw();
        if self.raw_in_file < self.raw.len() {
            let at = self.bytes();
            self.file.write_all_at(&self.raw[self.raw_in_file..], at)?;
            self.raw_in_file = self.raw.len();
        }
        Ok(())
    }

    /// Closes the chunk; it takes the place of its raw messages. When that fails they are put back as well as the disk allows.
    pub fn close_chunk(&mut self) -> McapResult<()> {
        let (start, raw_end) = (self.written.load(Ordering::Relaxed), self.bytes());
        if let Err(error) = self.writer.flush() {
            // Only what stood there before: there may be no room for more.
            let _ = self.file.write_all_at(&self.raw[..self.raw_in_file], start);
            let _ = self.file.set_len(raw_end);
            return Err(error);
        }
        self.raw.clear();
        self.raw_in_file = 0;
        self.raw_checked = 0;
        self.raw_crc = Crc::new();
        self.chunks = self.chunks.saturating_add(u32::from(self.chunk_bytes > 0));
        self.chunk_bytes = 0;
        self.chunk_since = None;
        let end = self.written.load(Ordering::Relaxed);
        if raw_end > end {
            self.file.set_len(end)?;
        }
        Ok(())
    }

    /// Adds a metadata record.
    pub fn metadata(&mut self, name: &str, entries: BTreeMap<String, String>) -> McapResult<()> {
        self.close_chunk()?;
        self.writer.write_metadata(&Metadata { name: name.to_owned(), metadata: entries })?;
        // The raw messages that follow must stand behind it, and what is in memory goes with the process.
        self.writer.flush()
    }

    /// Adds a file.
    pub fn attach(&mut self, name: &str, media_type: &str, utc_ns: u64, data: &[u8]) -> McapResult<()> {
        self.close_chunk()?;
        self.writer.attach(&Attachment {
            log_time: utc_ns,
            create_time: utc_ns,
            name: name.to_owned(),
            media_type: media_type.to_owned(),
            data: Cow::Borrowed(data),
        })?;
        self.writer.flush()
    }

    /// Bytes of the file now.
    pub fn bytes(&self) -> u64 {
        self.written.load(Ordering::Relaxed) + self.raw_in_file as u64
    }

    /// Chunks closed so far: when their number rises, all messages before are in the file.
    pub fn chunks(&self) -> u32 {
        self.chunks
    }

    /// Whether another file should begin, although this one may be small: [`MAX_CHUNKS`].
    pub fn is_full(&self) -> bool {
        self.chunks >= MAX_CHUNKS
    }

    /// Writes index and end.
    pub fn finish(mut self) -> McapResult<()> {
        let ended = self.close_chunk().and_then(|()| self.writer.finish().map(drop));
        // Taken apart, not dropped: the MCAP writer would try to end the file once more, over what was put back.
        let mut sink = self.writer.into_inner();
        ended?;
        std::io::Write::flush(&mut sink).map_err(McapError::from)
    }

    /// Gives the file up after an error: no index, what stands stays.
    pub fn abandon(self) {
        drop(self.writer.into_inner());
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::format::gaps_channel;
    use crate::record::RAW_CHECK_BYTES;

    fn head(channel_id: u16, sequence: u32) -> MessageHeader {
        MessageHeader { channel_id, sequence, log_time: 7, publish_time: 7 }
    }

    #[test]
    fn a_full_disk_is_an_error_and_no_panic() {
        let full = Arc::new(File::options().read(true).write(true).open("/dev/full").unwrap());
        let now = Instant::now();
        for step in 0..3 {
            let mut file = RecordingFile::new(full.clone(), Compression::Zstd, true).unwrap();
            let channel = file.add_channel(&gaps_channel()).unwrap();
            file.message(&head(channel, 1), b"{}", now).unwrap();
            let error = match step {
                0 => file.flush(now).unwrap_err(),
                1 => file.close_chunk().unwrap_err(),
                _ => file.metadata("name", BTreeMap::new()).unwrap_err(),
            };
            let McapError::Io(error) = error else { panic!("{error}") };
            assert_eq!(error.raw_os_error(), Some(libc::ENOSPC));
            // What is done with it afterwards may fail, but must not panic.
            let _ = file.message(&head(channel, 2), b"{}", now);
            if step == 0 {
                file.abandon();
            } else {
                file.finish().unwrap_err();
            }
        }
    }

    #[test]
    fn a_file_of_many_small_chunks_is_full() {
        let dir = crate::testing::TempDir::new("chunks");
        let handle = File::options().read(true).write(true).create_new(true).open(dir.path().join("a.mcap"));
        let mut file = RecordingFile::new(Arc::new(handle.unwrap()), Compression::None, false).unwrap();
        let channel = file.add_channel(&gaps_channel()).unwrap();
        let now = Instant::now();
        for n in 1..=MAX_CHUNKS {
            assert!(!file.is_full(), "{n}");
            file.message(&head(channel, n), b"{}", now).unwrap();
            // Closing twice is closing once.
            file.close_chunk().unwrap();
            file.close_chunk().unwrap();
        }
        assert!(file.is_full());
        file.finish().unwrap();
    }

    #[test]
    fn the_chunk_takes_the_place_of_its_raw_messages() {
        let dir = crate::testing::TempDir::new("file");
        let path = dir.path().join("a.mcap");
        let handle = File::options().read(true).write(true).create_new(true).open(&path).unwrap();
        let mut file = RecordingFile::new(Arc::new(handle), Compression::Zstd, true).unwrap();
        let channel = file.add_channel(&gaps_channel()).unwrap();
        file.close_chunk().unwrap();
        let (empty, start) = (file.bytes(), Instant::now());
        let messages = |path: &std::path::Path| {
            let messages = crate::Recording::open(path).unwrap().messages();
            messages.map(|m| m.unwrap().tail).collect::<Vec<_>>()
        };
        for n in 1..=100u32 {
            file.message(&head(channel, n), &[b' '; 100], start).unwrap();
            file.flush(start).unwrap();
            assert_eq!(messages(&path).len() as u32, n, "in the file after each flush");
        }
        let (raw, before) = (file.bytes(), std::fs::read(&path).unwrap());
        assert_eq!(raw - empty, 100 * (MESSAGE_HEAD + 100 + RAW_CHECK_BYTES) as u64);
        file.flush(start + CHUNK_AGE).unwrap();
        assert!(file.bytes() < raw, "the chunk is smaller than its raw messages");
        assert_eq!(file.bytes(), std::fs::metadata(&path).unwrap().len());
        assert_eq!(messages(&path), vec![vec![b' '; 100]; 100]);
        // Killed after the chunk was written and before the rest of the raw messages was cut off.
        let mut torn = std::fs::read(&path).unwrap();
        torn.extend_from_slice(&before[torn.len()..]);
        let read = crate::Recording::from_bytes(&path, torn).unwrap().messages();
        assert_eq!(read.flatten().count(), 100);
        file.finish().unwrap();
        assert_eq!(messages(&path).len(), 100);
        assert!(crate::disk::is_finished(&path));
    }
}
