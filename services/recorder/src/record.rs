//! The records of an MCAP file as bytes: parsed without trusting any length.

use crate::format::{KIND_KEY, PAYLOAD_KEY};
use crate::item::{Attachment, Metadata};
use crate::reader::MAX_CHUNK;
use ipc_types::payload::{Encoding, Stamp};
use ipc_types::topic::TopicKind;
use std::collections::BTreeMap;
use std::sync::Arc;

pub(crate) mod op {
    pub const HEADER: u8 = 0x01;
    pub const SCHEMA: u8 = 0x03;
    pub const CHANNEL: u8 = 0x04;
    pub const MESSAGE: u8 = 0x05;
    pub const CHUNK: u8 = 0x06;
    pub const ATTACHMENT: u8 = 0x09;
    pub const METADATA: u8 = 0x0C;
    pub const DATA_END: u8 = 0x0F;
    /// Last opcode that MCAP assigns; from 0x80 on they are private.
    pub const LAST: u8 = 0x0F;
    pub const PRIVATE: u8 = 0x80;
    /// Ours: CRC-32 of everything from the end of the last chunk up to this record. Raw messages stand before it.
    pub const RAW_CHECK: u8 = 0x80;
}

/// Bytes of a [`op::RAW_CHECK`] record.
pub(crate) const RAW_CHECK_BYTES: usize = 9 + 4;

/// A [`op::RAW_CHECK`] record.
pub(crate) fn raw_check(crc: u32) -> [u8; RAW_CHECK_BYTES] {
    let mut record = [0; RAW_CHECK_BYTES];
    record[0] = op::RAW_CHECK;
    record[1..9].copy_from_slice(&4u64.to_le_bytes());
    record[9..].copy_from_slice(&crc.to_le_bytes());
    record
}

pub(crate) struct Schema {
    pub(crate) name: String,
    pub(crate) encoding: String,
    pub(crate) data: Arc<[u8]>,
}

/// The topic kind that channel metadata names, if its payload is the one of this version.
pub(crate) fn kind_of(metadata: &BTreeMap<String, String>, encoding: &str) -> Option<TopicKind> {
    let (name, payload) = (metadata.get(KIND_KEY)?, metadata.get(PAYLOAD_KEY)?);
    let kind: TopicKind = serde_json::from_value(serde_json::Value::String(name.clone())).ok()?;
    let expected = match kind.encoding() {
        Encoding::Ros1 => "ros1",
        Encoding::Json => "json",
    };
    (kind.row().payload == payload && encoding == expected).then_some(kind)
}

pub(crate) fn stamp_of(header: &[u8]) -> Option<Stamp> {
    let mut bytes = Bytes(header);
    Some(Stamp { seq: bytes.u64()?, t_ns: bytes.u64()?, generation: bytes.u32()?, writer: bytes.u32()? })
}

/// The `n` that ends a header with tail.
pub(crate) fn tail_len(header: &[u8]) -> Option<usize> {
    header.last_chunk::<4>().map(|n| u32::from_le_bytes(*n) as usize)
}

/// Bytes that may end anywhere.
pub(crate) struct Bytes<'a>(pub(crate) &'a [u8]);

impl<'a> Bytes<'a> {
    pub(crate) fn take(&mut self, n: usize) -> Option<&'a [u8]> {
        let (now, later) = self.0.split_at_checked(n)?;
        self.0 = later;
        Some(now)
    }
    pub(crate) fn u16(&mut self) -> Option<u16> {
        self.take(2)?.try_into().ok().map(u16::from_le_bytes)
    }
    pub(crate) fn u32(&mut self) -> Option<u32> {
        self.take(4)?.try_into().ok().map(u32::from_le_bytes)
    }
    pub(crate) fn u64(&mut self) -> Option<u64> {
        self.take(8)?.try_into().ok().map(u64::from_le_bytes)
    }
    pub(crate) fn string(&mut self) -> Option<&'a str> {
        let len = self.u32()? as usize;
        std::str::from_utf8(self.take(len)?).ok()
    }
    pub(crate) fn map(&mut self) -> Option<BTreeMap<String, String>> {
        let len = self.u32()? as usize;
        let mut inner = Bytes(self.take(len)?);
        let mut map = BTreeMap::new();
        while !inner.0.is_empty() {
            let (key, value) = (inner.string()?, inner.string()?);
            map.insert(key.to_owned(), value.to_owned());
        }
        Some(map)
    }
}

pub(crate) struct ChunkHead<'a> {
    pub(crate) crc: u32,
    pub(crate) compression: &'a str,
    pub(crate) records: (usize, usize),
    /// Bytes of the records, unpacked.
    pub(crate) uncompressed: u64,
}

pub(crate) fn chunk_head(record: &[u8]) -> Option<ChunkHead<'_>> {
    let mut bytes = Bytes(record);
    let (_start, _end, uncompressed) = (bytes.u64()?, bytes.u64()?, bytes.u64()?);
    let (crc, compression) = (bytes.u32()?, bytes.string()?);
    let len = usize::try_from(bytes.u64()?).ok()?;
    let from = record.len() - bytes.0.len();
    let fits = len <= bytes.0.len() && uncompressed <= MAX_CHUNK;
    fits.then(|| ChunkHead { crc, compression, records: (from, from + len), uncompressed })
}

pub(crate) fn schema(record: &[u8]) -> Option<(u16, Schema)> {
    let mut bytes = Bytes(record);
    let id = bytes.u16()?;
    let (name, encoding) = (bytes.string()?.to_owned(), bytes.string()?.to_owned());
    let len = bytes.u32()? as usize;
    let data = bytes.take(len)?.into();
    Some((id, Schema { name, encoding, data }))
}

pub(crate) fn attachment(record: &[u8]) -> Option<Attachment<'_>> {
    let mut bytes = Bytes(record);
    let (log_time, create_time) = (bytes.u64()?, bytes.u64()?);
    let (name, media_type) = (bytes.string()?, bytes.string()?);
    let len = usize::try_from(bytes.u64()?).ok()?;
    let data = bytes.take(len)?;
    let crc_from = record.len() - bytes.0.len();
    let crc = bytes.u32()?;
    let sound = crc == 0 || crc32(&record[..crc_from]) == crc;
    sound.then_some(Attachment { name, media_type, log_time, create_time, data })
}

pub(crate) fn metadata(record: &[u8]) -> Option<Metadata> {
    let mut bytes = Bytes(record);
    Some(Metadata { name: bytes.string()?.to_owned(), entries: bytes.map()? })
}

/// CRC-32 of ISO-HDLC (zlib's), as MCAP uses it: bytes that come one piece after the other.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Crc(u32);

/// `TABLES[0]` is the table of one byte; `TABLES[n]` that of a byte with `n` zeros behind it, so that eight bytes are taken
/// at once.
const TABLES: [[u32; 256]; 8] = {
    let mut tables = [[0u32; 256]; 8];
    let mut i = 0;
    while i < 256 {
        let (mut value, mut bit) = (i as u32, 0);
        while bit < 8 {
            value = if value & 1 == 1 { 0xEDB8_8320 ^ (value >> 1) } else { value >> 1 };
            bit += 1;
        }
        tables[0][i] = value;
        i += 1;
    }
    let mut n = 1;
    while n < 8 {
        let mut i = 0;
        while i < 256 {
            let before = tables[n - 1][i];
            tables[n][i] = (before >> 8) ^ tables[0][(before & 0xFF) as usize];
            i += 1;
        }
        n += 1;
    }
    tables
};

impl Crc {
    pub(crate) fn new() -> Self {
        Self(!0)
    }

    pub(crate) fn add(&mut self, bytes: &[u8]) {
        let (eights, rest) = bytes.as_chunks::<8>();
        for eight in eights {
            let low = u32::from_le_bytes([eight[0], eight[1], eight[2], eight[3]]) ^ self.0;
            let [a, b, c, d] = low.to_le_bytes();
            self.0 = TABLES[7][usize::from(a)]
                ^ TABLES[6][usize::from(b)]
                ^ TABLES[5][usize::from(c)]
                ^ TABLES[4][usize::from(d)]
                ^ TABLES[3][usize::from(eight[4])]
                ^ TABLES[2][usize::from(eight[5])]
                ^ TABLES[1][usize::from(eight[6])]
                ^ TABLES[0][usize::from(eight[7])];
        }
        for byte in rest {
            self.0 = TABLES[0][((self.0 ^ u32::from(*byte)) & 0xFF) as usize] ^ (self.0 >> 8);
        }
    }

    pub(crate) fn value(self) -> u32 {
        !self.0
    }
}

/// [`Crc`] of bytes that are all there.
pub(crate) fn crc32(bytes: &[u8]) -> u32 {
    let mut crc = Crc::new();
    crc.add(bytes);
    crc.value()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn the_checksum_is_zlibs() {
        assert_eq!(crc32(b"123456789"), 0xCBF4_3926);
        assert_eq!(crc32(b""), 0);
        assert_eq!(crc32(b"The quick brown fox jumps over the lazy dog"), 0x414F_A339);
    }

    #[test]
    fn a_chunk_longer_than_memory_is_no_chunk() {
        let head = |len: u64| {
            let mut bytes = vec![0; 8 + 8 + 8 + 4 + 4];
            bytes.extend(len.to_le_bytes());
            bytes.extend([1, 2, 3]);
            bytes
        };
        assert_eq!(chunk_head(&head(3)).map(|c| c.records), Some((40, 43)));
        for len in [4, u64::from(u32::MAX), u64::MAX] {
            assert!(chunk_head(&head(len)).is_none(), "{len}");
        }
    }

    proptest! {
        #[test]
        fn a_checksum_knows_no_pieces(bytes: Vec<u8>, at: prop::sample::Index) {
            let (before, behind) = bytes.split_at(at.index(bytes.len() + 1));
            let mut crc = Crc::new();
            crc.add(before);
            crc.add(behind);
            prop_assert_eq!(crc.value(), crc32(&bytes));
        }

        #[test]
        fn any_bytes_are_survived(bytes: Vec<u8>) {
            let _ = (chunk_head(&bytes).is_some(), schema(&bytes).is_some(), attachment(&bytes).is_some());
            let _ = (metadata(&bytes), stamp_of(&bytes), tail_len(&bytes), Bytes(&bytes).map());
        }
    }
}
