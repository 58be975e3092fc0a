//! From bytes to records: through the file, into its chunks, and where it ends.

use super::{MAX_CHUNK, MAX_METADATA, MAX_RECORD, Place, ReadError, Recording};
use crate::item::Damage;
use crate::reader::MAX_DAMAGES;
use crate::record::{Bytes, Crc, RAW_CHECK_BYTES, chunk_head, crc32, op};
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};
use std::io::{self, Read, Seek, SeekFrom};

/// Bytes before a record's own.
const HEAD: u64 = 9;
/// Bytes read at once of what is only gone through.
const SKIPPED: usize = 16 * 1024;

impl Recording {
    pub(super) fn bytes(&self, place: Place) -> &[u8] {
        match place {
            Place::Chunk { from, to } => self.chunk.get(from..to).unwrap_or_default(),
            Place::Record => &self.record,
        }
    }

    /// The next record, within the current chunk or of the file.
    pub(super) fn advance(&mut self) -> Result<Option<(u8, Place)>, ReadError> {
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
            let before = self.crc;
            let Some((opcode, len)) = self.record_head()? else { return Ok(None) };
            self.chunk_offset = self.offset;
            let limit = match opcode {
                op::CHUNK => MAX_CHUNK,
                op::METADATA => MAX_METADATA,
                op::SCHEMA | op::CHANNEL | op::MESSAGE | op::ATTACHMENT | op::HEADER | op::DATA_END => {
                    MAX_RECORD
                }
                // Indexes and private records.
                _ => {
                    if !self.skip(len)? {
                        return Ok(None);
                    }
                    self.offset += HEAD + len;
                    continue;
                }
            };
            if len > limit {
                self.damage_of(self.offset, HEAD + len, "a record above the reader's limit");
                if !self.skip(len)? {
                    return Ok(None);
                }
                self.offset += HEAD + len;
                continue;
            }
            if !self.load(len)? {
                return Ok(None);
            }
            match opcode {
                op::DATA_END => {
                    self.finish(HEAD + len, before)?;
                    return Ok(None);
                }
                op::CHUNK => {
                    self.open_chunk(opcode, len);
                    self.offset += HEAD + len;
                }
                op::MESSAGE if self.raw_checked => self.gather()?,
                _ => {
                    self.offset += HEAD + len;
                    return Ok(Some((opcode, Place::Record)));
                }
            }
        }
    }

    /// Opcode and length of the record at `offset`; `None`, and ended, when no whole record is there.
    fn record_head(&mut self) -> Result<Option<(u8, u64)>, ReadError> {
        let left = self.len.saturating_sub(self.offset);
        if left < HEAD {
            self.stop(
                if left == 0 { "the file has no end yet" } else { "the file ends within a record" },
                left,
            );
            return Ok(None);
        }
        let mut head = [0u8; HEAD as usize];
        if !self.read_into(&mut head)? {
            return Ok(None);
        }
        let (opcode, len) = opcode_and_len(&head);
        let known = (1..=op::LAST).contains(&opcode) || opcode >= op::PRIVATE;
        if !known {
            self.stop("what follows is no MCAP record", left);
            return Ok(None);
        }
        if len > left - HEAD {
            self.stop("the file ends within a record", left);
            return Ok(None);
        }
        Ok(Some((opcode, len)))
    }

    fn advance_in_chunk(&mut self) -> Option<(u8, Place)> {
        let rest = &self.chunk[self.chunk_at..];
        let bounds = rest.first_chunk::<{ HEAD as usize }>().and_then(|head| {
            let (opcode, len) = opcode_and_len(head);
            let len = usize::try_from(len).ok()?;
            (len <= rest.len() - head.len()).then_some((opcode, len))
        });
        let Some((opcode, len)) = bounds else {
            let bytes = rest.len() as u64;
            self.chunk_at = self.chunk.len();
            self.damage_of(self.chunk_offset, bytes, "a record that does not end within its chunk");
            return None;
        };
        let from = self.chunk_at + HEAD as usize;
        self.chunk_at = from + len;
        let wanted = matches!(opcode, op::MESSAGE | op::SCHEMA | op::CHANNEL);
        wanted.then_some((opcode, Place::Chunk { from, to: from + len }))
    }

    /// Unpacks the chunk in `record`. A damaged one is left out.
    fn open_chunk(&mut self, opcode: u8, len: u64) {
        self.chunk.clear();
        self.chunk_at = 0;
        self.chunk_unchecked = false;
        let unpacked = match chunk_head(&self.record) {
            Some(head) if matches!(head.compression, "" | "zstd") => {
                let (crc, records, uncompressed) = (head.crc, head.records, head.uncompressed);
                self.chunk_unchecked = crc == 0;
                let unpacked = if head.compression.is_empty() {
                    self.copy_chunk(crc, records)
                } else {
                    self.unpack_chunk(opcode, len)
                };
                // A stream that ends early, or says another length than it has, is told by nothing else.
                unpacked.and_then(|()| {
                    if self.chunk.len() as u64 == uncompressed {
                        return Ok(());
                    }
                    Err(format!("a chunk of {} bytes that should have {uncompressed}", self.chunk.len()))
                })
            }
            Some(head) => Err(format!(
                "compression '{}' is not supported; convert the file with `mcap compress --compression zstd`",
                head.compression
            )),
            None => Err("a chunk whose lengths do not fit".to_owned()),
        };
        if let Err(reason) = unpacked {
            self.chunk.clear();
            self.damage_of(self.offset, HEAD + len, &reason);
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
        let mut head = [opcode; HEAD as usize];
        head[1..].copy_from_slice(&len.to_le_bytes());
        let mut rest: &[u8] = &self.record;
        decoder.insert(head.len()).copy_from_slice(&head);
        decoder.notify_read(head.len());
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

    /// The messages behind the last chunk, the first of which is in `record`. They count up to the last record that has their
    /// checksum: what follows it was being written when the writer died, is what was left when a chunk took the place
    /// of its messages, or is damaged.
    fn gather(&mut self) -> Result<(), ReadError> {
        let start = self.offset;
        let mut run = std::mem::take(&mut self.chunk);
        run.clear();
        let mut crc = Crc::new();
        let mut good = 0;
        let mut head = [op::MESSAGE; HEAD as usize];
        head[1..].copy_from_slice(&(self.record.len() as u64).to_le_bytes());
        let reason = loop {
            run.extend_from_slice(&head);
            run.extend_from_slice(&self.record);
            let whole = HEAD as usize + self.record.len();
            self.offset = start + run.len() as u64;
            let added = &run[run.len() - whole..];
            if head[0] == op::RAW_CHECK {
                if added.last_chunk() != Some(&crc.value().to_le_bytes()) {
                    break "messages that fail their checksum";
                }
                good = run.len();
            }
            crc.add(added);
            let left = self.len.saturating_sub(self.offset);
            if left < HEAD {
                break "messages without their checksum: they were being written";
            }
            if !self.read_into(&mut head)? {
                break "the file became shorter while it was read";
            }
            let (opcode, len) = opcode_and_len(&head);
            let wanted = match opcode {
                op::MESSAGE => len <= MAX_CHUNK.saturating_sub(run.len() as u64),
                op::RAW_CHECK => len == (RAW_CHECK_BYTES as u64 - HEAD),
                _ => false,
            };
            if !wanted {
                break "messages without their checksum";
            }
            if len > left - HEAD {
                break "messages without their checksum: they were being written";
            }
            if !self.load(len)? {
                break "the file became shorter while it was read";
            }
        };
        run.truncate(good);
        self.chunk = run;
        self.chunk_at = 0;
        self.chunk_unchecked = false;
        self.chunk_offset = start;
        self.offset = start + good as u64;
        let unread = self.len.saturating_sub(self.offset);
        // Nothing is read behind it: in our files nothing stands there, and where a record begins is not known any more.
        self.stop(if unread == 0 { "the file has no end yet" } else { reason }, unread);
        Ok(())
    }

    /// Behind the data: whether they are what was written, and whether index and end are there too. `before` is the
    /// checksum of everything before the record in `record`.
    fn finish(&mut self, whole: u64, before: Crc) -> Result<(), ReadError> {
        self.ended = true;
        let saved = Bytes(&self.record).u32().unwrap_or(0);
        if saved != 0 && saved == before.value() {
            self.end.checked = true;
            self.end.unchecked = 0;
        } else if saved != 0 && self.end.damaged == 0 {
            self.damage_of(self.offset, 0, "the data before it fail their checksum, though no part of them does: something was altered, added or taken out");
        }
        self.end.offset = self.offset + whole;
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

    pub(super) fn stop(&mut self, reason: &str, unread: u64) {
        self.ended = true;
        self.end.offset = self.offset;
        self.end.unread = unread;
        self.end.reason = Some(reason.to_owned());
    }

    /// Something in the current record or chunk was left out.
    pub(super) fn damage(&mut self, reason: &str) {
        self.damage_of(self.chunk_offset, 0, reason);
    }

    pub(super) fn damage_of(&mut self, offset: u64, bytes: u64, reason: &str) {
        self.end.damaged += 1;
        self.end.damaged_bytes += bytes;
        if self.end.damages.len() < MAX_DAMAGES {
            self.end.damages.push(Damage { offset, bytes, reason: reason.to_owned() });
        }
    }

    /// Reads the record behind its head; `len` was checked against file and limit. `false`, and ended, when the
    /// file has become shorter meanwhile.
    fn load(&mut self, len: u64) -> Result<bool, ReadError> {
        let mut record = std::mem::take(&mut self.record);
        record.resize(len as usize, 0);
        if record.capacity() > 4 << 20 && record.len() < 1 << 20 {
            record.shrink_to(1 << 20);
        }
        let read = self.read_into(&mut record);
        self.record = record;
        read
    }

    /// Goes through a record that nobody wants: it is read, for the checksum.
    fn skip(&mut self, len: u64) -> Result<bool, ReadError> {
        let mut left = len;
        let mut piece = [0u8; SKIPPED];
        while left > 0 {
            let now = left.min(SKIPPED as u64);
            if !self.read_into(&mut piece[..now as usize])? {
                return Ok(false);
            }
            left -= now;
        }
        Ok(true)
    }

    fn seek(&mut self, to: SeekFrom) -> Result<(), ReadError> {
        let offset = self.offset;
        self.file.seek(to).map_err(|source| ReadError::Io { path: self.path.clone(), offset, source })?;
        Ok(())
    }

    /// Reads on; `false`, and ended, when the file has become shorter meanwhile. `offset` is the callers' to move.
    pub(super) fn read_into(&mut self, bytes: &mut [u8]) -> Result<bool, ReadError> {
        match self.file.read_exact(bytes) {
            Ok(()) => {
                self.crc.add(bytes);
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

fn opcode_and_len(head: &[u8; HEAD as usize]) -> (u8, u64) {
    let len = [head[1], head[2], head[3], head[4], head[5], head[6], head[7], head[8]];
    (head[0], u64::from_le_bytes(len))
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
