//! Files (functions 20 and 21) and FIFO queues (24) as named buffers of the process image.
//!
//! A record of a file is one register: record `r` is the word at `2 * r` bytes behind the beginning of the buffer.
//! A FIFO queue is a word that counts the registers queued, and up to 31 registers behind it; the program fills and
//! empties it, reading it over Modbus takes nothing out (V1.1b3 clause 6.18).

use crate::map::Memory;
use crate::map_config::area_of;
use crate::protocol::files::{MAX_FIFO, MAX_RECORD, WriteGroup};
use crate::protocol::pdu::Exception;
use crate::server::Access;
use crate::write_set::WriteSet;
use dinrail_iec::{AddressError, AddressSize, Addressing, parse_address};
use ipc_types::wiring::{Area, AreaSizes};
use serde::{Deserialize, Serialize};

/// Most files and most queues.
pub const MAX_BUFFERS: usize = 256;

/// One `[[service.file]]` table.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FileEntry {
    /// 1-65535.
    pub number: u16,
    /// For people.
    #[serde(default)]
    pub name: Option<String>,
    /// %-address of record 0.
    pub area: String,
    /// 1-10000.
    pub records: u32,
    #[serde(default)]
    pub read_only: bool,
}

/// One `[[service.fifo]]` table.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FifoEntry {
    /// FIFO pointer address.
    pub address: u16,
    /// For people.
    #[serde(default)]
    pub name: Option<String>,
    /// %-address of the counting word; the registers follow.
    pub area: String,
    /// Registers it has room for, 1-31.
    #[serde(default = "most_registers")]
    pub size: u32,
}

fn most_registers() -> u32 {
    MAX_FIFO as u32
}

/// Buffers that cannot be made. `entry` counts from 1; `what` is `file` or `fifo`.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum BufferError {
    #[error("{what} {entry}: {source}")]
    Address { what: &'static str, entry: usize, source: AddressError },
    #[error("{what} {entry}: {got} is a bit; a buffer begins at a byte or word")]
    Bit { what: &'static str, entry: usize, got: String },
    #[error(
        "{what} {entry}: it reaches byte {end} of %{area}, which has {size}; make it smaller or raise the size of %{area} in the plc service"
    )]
    PastArea { what: &'static str, entry: usize, end: u64, area: char, size: u32 },
    #[error("file {entry}: number 0 is no file; files are 1 to 65535")]
    Number { entry: usize },
    #[error("file {entry}: records = {got} is not 1 to 10000")]
    Records { entry: usize, got: u32 },
    #[error("fifo {entry}: size = {got} is not 1 to {MAX_FIFO}")]
    Size { entry: usize, got: u32 },
    #[error("{what} {entry}: {number} stands there twice")]
    Twice { what: &'static str, entry: usize, number: u16 },
    #[error("there are {got} {what} tables; at most {MAX_BUFFERS} are allowed")]
    TooMany { what: &'static str, got: usize },
}

impl BufferError {
    /// Key of the stack file it is about.
    pub fn key(&self) -> String {
        match self {
            Self::Address { what, entry, .. }
            | Self::Bit { what, entry, .. }
            | Self::PastArea { what, entry, .. }
            | Self::Twice { what, entry, .. } => format!("{what}[{}]", entry - 1),
            Self::Number { entry } | Self::Records { entry, .. } => format!("file[{}]", entry - 1),
            Self::Size { entry, .. } => format!("fifo[{}]", entry - 1),
            Self::TooMany { what, .. } => (*what).to_owned(),
        }
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Buffer {
    number: u16,
    area: Area,
    /// Byte of the first word.
    base: u32,
    /// Words.
    words: u32,
    writable: bool,
}

impl Buffer {
    fn end(&self) -> u32 {
        self.base + self.words * 2
    }
}

/// The buffers, checked.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Buffers {
    files: Vec<Buffer>,
    fifos: Vec<Buffer>,
    sizes: Option<AreaSizes>,
}

fn place(
    what: &'static str,
    entry: usize,
    area: &str,
    words: u32,
    sizes: AreaSizes,
    addressing: Addressing,
) -> Result<(Area, u32), BufferError> {
    let address =
        parse_address(area, addressing).map_err(|source| BufferError::Address { what, entry, source })?;
    if address.size == AddressSize::Bit {
        return Err(BufferError::Bit { what, entry, got: area.to_owned() });
    }
    let (area, end) = (area_of(address), u64::from(address.byte) + u64::from(words) * 2);
    let size = sizes.of(area);
    if end > u64::from(size) {
        return Err(BufferError::PastArea { what, entry, end, area: area.letter(), size });
    }
    Ok((area, address.byte))
}

impl Buffers {
    /// Reads the tables.
    pub fn new(
        files: &[FileEntry],
        fifos: &[FifoEntry],
        sizes: AreaSizes,
        addressing: Addressing,
    ) -> Result<Self, BufferError> {
        let mut made = Self::default();
        for (what, got) in [("file", files.len()), ("fifo", fifos.len())] {
            if got > MAX_BUFFERS {
                return Err(BufferError::TooMany { what, got });
            }
        }
        for (i, file) in files.iter().enumerate() {
            let (entry, number) = (i + 1, file.number);
            if number == 0 {
                return Err(BufferError::Number { entry });
            }
            if !(1..=u32::from(MAX_RECORD) + 1).contains(&file.records) {
                return Err(BufferError::Records { entry, got: file.records });
            }
            if made.files.iter().any(|other| other.number == number) {
                return Err(BufferError::Twice { what: "file", entry, number });
            }
            let (area, base) = place("file", entry, &file.area, file.records, sizes, addressing)?;
            let writable = !file.read_only && area != Area::Input;
            made.files.push(Buffer { number, area, base, words: file.records, writable });
        }
        for (i, fifo) in fifos.iter().enumerate() {
            let (entry, number) = (i + 1, fifo.address);
            if !(1..=MAX_FIFO as u32).contains(&fifo.size) {
                return Err(BufferError::Size { entry, got: fifo.size });
            }
            if made.fifos.iter().any(|other| other.number == number) {
                return Err(BufferError::Twice { what: "fifo", entry, number });
            }
            let (area, base) = place("fifo", entry, &fifo.area, fifo.size + 1, sizes, addressing)?;
            made.fifos.push(Buffer { number, area, base, words: fifo.size + 1, writable: false });
        }
        Ok(made)
    }

    /// Tells how large the PLC's areas really are; buffers beyond get exception 02.
    pub fn set_sizes(&mut self, sizes: AreaSizes) {
        self.sizes = Some(sizes);
    }

    fn find(&self, list: &[Buffer], number: u16) -> Result<Buffer, Exception> {
        let inside = |buffer: &&Buffer| self.sizes.is_none_or(|sizes| buffer.end() <= sizes.of(buffer.area));
        let found = list.iter().find(|buffer| buffer.number == number).filter(inside);
        found.copied().ok_or(Exception::IllegalDataAddress)
    }

    /// Whether the records exist and may be accessed so.
    pub fn check_file(&self, access: Access, file: u16, record: u16, count: u16) -> Result<(), Exception> {
        let buffer = self.find(&self.files, file)?;
        let inside = u32::from(record) + u32::from(count) <= buffer.words;
        if inside && (access == Access::Read || buffer.writable) {
            Ok(())
        } else {
            Err(Exception::IllegalDataAddress)
        }
    }

    /// Puts records into `out`, high byte first.
    pub fn read_file(
        &self,
        memory: &Memory<'_>,
        file: u16,
        record: u16,
        out: &mut [u8],
    ) -> Result<(), Exception> {
        let buffer = self.find(&self.files, file)?;
        copy_words(memory.area(buffer.area), buffer.base + u32::from(record) * 2, out);
        Ok(())
    }

    /// Adds the bytes of a group to a set of writes; exception 04 when it is full.
    pub fn plan(&self, group: &WriteGroup<'_>, set: &mut WriteSet) -> Result<(), Exception> {
        let buffer = self.find(&self.files, group.file)?;
        let mut at = buffer.base + u32::from(group.record) * 2;
        for pair in group.values.chunks_exact(2) {
            let &[high, low] = pair else { continue };
            if !(set.push(buffer.area, at, 0, low) && set.push(buffer.area, at + 1, 0, high)) {
                return Err(Exception::ServerDeviceFailure);
            }
            at += 2;
        }
        Ok(())
    }

    /// Whether there is a queue at this address.
    pub fn check_fifo(&self, address: u16) -> Result<(), Exception> {
        self.find(&self.fifos, address).map(|_| ())
    }

    /// Puts the registers queued into `out` and returns how many.
    pub fn read_fifo(
        &self,
        memory: &Memory<'_>,
        address: u16,
        out: &mut [u8; 2 * MAX_FIFO],
    ) -> Result<usize, Exception> {
        let buffer = self.find(&self.fifos, address)?;
        let bytes = memory.area(buffer.area);
        let mut word = [0; 2];
        copy_words(bytes, buffer.base, &mut word);
        let count = usize::from(u16::from_be_bytes(word));
        if count > MAX_FIFO || count as u32 >= buffer.words {
            return Err(Exception::IllegalDataValue);
        }
        copy_words(bytes, buffer.base + 2, &mut out[..count * 2]);
        Ok(count)
    }
}

/// Words of memory, low byte first, into `out`, high byte first. Zero beyond the end.
fn copy_words(bytes: &[u8], from: u32, out: &mut [u8]) {
    for (i, pair) in out.chunks_exact_mut(2).enumerate() {
        let at = from as usize + i * 2;
        let byte = |at: usize| bytes.get(at).copied().unwrap_or(0);
        pair.copy_from_slice(&[byte(at + 1), byte(at)]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn buffers(files: &str, fifos: &str) -> Result<Buffers, BufferError> {
        Buffers::new(
            &serde_json::from_str::<Vec<_>>(files).unwrap(),
            &serde_json::from_str::<Vec<_>>(fifos).unwrap(),
            AreaSizes::default(),
            Addressing::Element,
        )
    }

    #[test]
    fn records_and_queues() {
        let buffers = buffers(
            r#"[ { "number": 4, "area": "%MW10", "records": 3 },
                 { "number": 5, "area": "%IW0", "records": 2 },
                 { "number": 6, "area": "%MW0", "records": 2, "read_only": true } ]"#,
            r#"[ { "address": 1246, "area": "%MW20", "size": 2 } ]"#,
        )
        .unwrap();
        let mut marker = [0; 64];
        marker[20..26].copy_from_slice(&[1, 2, 3, 4, 5, 6]);
        marker[40..46].copy_from_slice(&[2, 0, 0xB8, 0x01, 0x84, 0x12]);
        fn memory(marker: &[u8]) -> Memory<'_> {
            Memory { marker, input: &[9, 8], ..Memory::default() }
        }
        for (access, file, record, count, good) in [
            (Access::Read, 4, 0, 3, true),
            (Access::Write, 4, 2, 1, true),
            (Access::Read, 4, 0, 4, false),
            (Access::Read, 4, 3, 1, false),
            (Access::Read, 7, 0, 1, false),
            (Access::Read, 5, 0, 2, true),
            (Access::Write, 5, 0, 1, false),
            (Access::Read, 6, 0, 1, true),
            (Access::Write, 6, 0, 1, false),
        ] {
            assert_eq!(buffers.check_file(access, file, record, count).is_ok(), good, "{file} {record}");
        }
        let mut out = [0; 4];
        buffers.read_file(&memory(&marker), 4, 1, &mut out).unwrap();
        assert_eq!(out, [4, 3, 6, 5]);
        buffers.read_file(&memory(&marker), 5, 0, &mut out).unwrap();
        assert_eq!(out, [8, 9, 0, 0]);
        let mut set = WriteSet::default();
        buffers
            .plan(&WriteGroup { reference: 6, file: 4, record: 1, values: &[0xAB, 0xCD] }, &mut set)
            .unwrap();
        let runs: Vec<_> = set.runs().map(|run| (run.area, run.offset, run.or.to_vec())).collect();
        assert_eq!(runs, [(Area::Marker, 22, vec![0xCD, 0xAB])]);

        let mut values = [0; 62];
        assert_eq!(buffers.read_fifo(&memory(&marker), 1246, &mut values), Ok(2));
        assert_eq!(values[..4], [0x01, 0xB8, 0x12, 0x84]);
        for count in [3, 32, 255] {
            marker[40] = count;
            let got = buffers.read_fifo(&memory(&marker), 1246, &mut values);
            assert_eq!(got, Err(Exception::IllegalDataValue), "{count}");
        }
        assert_eq!(buffers.check_fifo(0), Err(Exception::IllegalDataAddress));
    }

    #[test]
    fn buffers_that_cannot_be_made() {
        let file = |json: &str| {
            let error = buffers(json, "[]").unwrap_err();
            format!("{}: {error}", error.key())
        };
        insta::assert_snapshot!(file(r#"[ { "number": 0, "area": "%MW0", "records": 1 } ]"#), @"file[0]: file 1: number 0 is no file; files are 1 to 65535");
        insta::assert_snapshot!(file(r#"[ { "number": 1, "area": "%MX0.0", "records": 1 } ]"#), @"file[0]: file 1: %MX0.0 is a bit; a buffer begins at a byte or word");
        insta::assert_snapshot!(file(r#"[ { "number": 1, "area": "%MW2000", "records": 100 } ]"#), @"file[0]: file 1: it reaches byte 4200 of %M, which has 4096; make it smaller or raise the size of %M in the plc service");
        insta::assert_snapshot!(file(r#"[ { "number": 1, "area": "%MW0", "records": 10001 } ]"#), @"file[0]: file 1: records = 10001 is not 1 to 10000");
        insta::assert_snapshot!(file(r#"[ { "number": 1, "area": "%MW0", "records": 1 }, { "number": 1, "area": "%MW9", "records": 1 } ]"#), @"file[1]: file 2: 1 stands there twice");
        let error = buffers("[]", r#"[ { "address": 1, "area": "%MW0", "size": 32 } ]"#).unwrap_err();
        insta::assert_snapshot!(error, @"fifo 1: size = 32 is not 1 to 31");
    }
}
