//! Helpers of the tests: a plain memory of four tables as the simplest possible [`Image`], and test vectors.

use crate::device::{Device, Shared};
use crate::protocol::files::{self, MAX_FIFO};
use crate::protocol::pdu::{Exception, bytes_for_bits};
use crate::server::{Access, Image, Table, Write};
use crate::tcp::Backend;
use std::collections::BTreeMap;

pub(crate) const DEVICE_FRAMES: &str = include_str!("../tests/vectors/device_frames.tsv");
pub(crate) const SPEC_EXAMPLES: &str = include_str!("../tests/vectors/spec_v1_1b3_examples.tsv");

/// Bytes of a hexadecimal text; spaces are ignored.
pub(crate) fn hex(text: &str) -> Vec<u8> {
    let digits: Vec<u8> = text.bytes().filter(|b| !b.is_ascii_whitespace()).collect();
    assert!(digits.len().is_multiple_of(2), "{text}");
    digits.chunks(2).map(|pair| u8::from_str_radix(std::str::from_utf8(pair).unwrap(), 16).unwrap()).collect()
}

/// Bytes as hexadecimal text.
pub(crate) fn to_hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02X}")).collect::<Vec<_>>().concat()
}

/// Rows of a tab-separated text without its comments.
pub(crate) fn rows(text: &str) -> impl Iterator<Item = Vec<&str>> {
    text.lines()
        .filter(|line| !line.starts_with('#') && !line.is_empty())
        .map(|line| line.split('\t').collect())
}

/// The requests whose answers differ between public servers, with what V1.1b3 asks for, from a device that has just
/// started. `{124}` stands for so many registers of zeros, `{id}` for what `Identity::default` tells.
pub(crate) const MATRIX: &[(&str, &str)] = &[
    ("03 0000 0002", "03 04 0000 0000"),
    ("01 0000 0000", "81 03"),
    ("01 0000 07D1", "81 03"),
    ("03 0000 0000", "83 03"),
    ("03 0000 007E", "83 03"),
    ("03 FFFF 0002", "83 02"),
    ("05 0000 1234", "85 03"),
    ("0F 0000 0064 01 FF", "8F 03"),
    ("0F 0000 0001 02 FFFF", "8F 03"),
    ("10 0000 0002 02 0001", "90 03"),
    ("10 0000 007C F8 {124}", "90 03"),
    ("03 0000 0002 00", "83 03"),
    ("03 0000 00", "83 03"),
    ("07", "07 6D"),
    ("08 0000 A537", "08 0000 A537"),
    ("0B", "0B 0000 0000"),
    // One event, the request itself; one message on the line, the request itself.
    ("0C", "0C 07 0000 0000 0001 80"),
    ("11", "{17}"),
    ("14 07 06 0001 0000 0002", "94 02"),
    ("16 0004 00F2 0025", "16 0004 00F2 0025"),
    ("17 0003 0006 000E 0003 06 00FF00FF00FF", "17 0C 0000 0000 0000 0000 0000 0000"),
    ("18 0000", "98 02"),
    ("2B 0E 01 00", "{43}"),
    ("2B 0E 09 00", "AB 03"),
    ("2B 0D 00", "AB 01"),
    ("64 01", "E4 01"),
    ("09", "89 01"),
    ("83 02", "83 01"),
    ("00", "80 01"),
];

/// Request and response PDU of each row.
pub(crate) fn matrix() -> impl Iterator<Item = (Vec<u8>, Vec<u8>)> {
    let identity = crate::identity::Identity::default();
    let mut out = [0; crate::protocol::pdu::MAX_PDU];
    let len = identity.report(true, &mut out);
    let report = to_hex(&out[..len]);
    let len = identity.read(1, 0, &mut out).unwrap();
    let read = to_hex(&out[..len]);
    MATRIX.iter().map(move |(request, response)| {
        let request = request.replace("{124}", &"0000".repeat(124));
        (hex(&request), hex(&response.replace("{17}", &report).replace("{43}", &read)))
    })
}

/// A device on TCP that answers every unit.
pub(crate) fn tcp_device() -> Device {
    Device::tcp(None, &[], Shared::open())
}

/// Four tables of values, one entry each, all of the same size.
pub(crate) struct MemoryImage {
    pub coils: Vec<bool>,
    pub discrete: Vec<bool>,
    pub input: Vec<u16>,
    pub holding: Vec<u16>,
    pub ready: bool,
    pub busy: bool,
    pub writes: usize,
    pub batches: usize,
    pub status: u8,
    pub files: BTreeMap<u16, Vec<u16>>,
    pub fifos: BTreeMap<u16, Vec<u16>>,
    /// Maps that were selected, in order.
    pub selected: Vec<usize>,
}

impl MemoryImage {
    pub(crate) fn new(entries: usize) -> Self {
        Self {
            coils: vec![false; entries],
            discrete: vec![false; entries],
            input: vec![0; entries],
            holding: vec![0; entries],
            ready: true,
            busy: false,
            writes: 0,
            batches: 0,
            status: 0x6D,
            files: BTreeMap::new(),
            fifos: BTreeMap::new(),
            selected: Vec::new(),
        }
    }

    /// Sets bits from bytes packed low bit first.
    pub(crate) fn set_bits(bits: &mut [bool], packed: &[u8]) {
        for (i, bit) in bits.iter_mut().enumerate().take(packed.len() * 8) {
            *bit = packed[i / 8] >> (i % 8) & 1 == 1;
        }
    }
}

impl Image for MemoryImage {
    fn check(&self, _: Access, _: Table, address: u16, quantity: u16) -> Result<(), Exception> {
        let inside = usize::from(address) + usize::from(quantity) <= self.coils.len();
        if inside { Ok(()) } else { Err(Exception::IllegalDataAddress) }
    }

    fn ready(&self, _: Access) -> Result<(), Exception> {
        if self.ready { Ok(()) } else { Err(Exception::ServerDeviceFailure) }
    }

    fn read_bits(
        &mut self,
        table: Table,
        address: u16,
        quantity: u16,
        out: &mut [u8],
    ) -> Result<(), Exception> {
        assert_eq!(out.len(), bytes_for_bits(quantity));
        let bits = if table == Table::Coils { &self.coils } else { &self.discrete };
        out.fill(0);
        for i in 0..usize::from(quantity) {
            out[i / 8] |= u8::from(bits[usize::from(address) + i]) << (i % 8);
        }
        Ok(())
    }

    fn read_words(&mut self, table: Table, address: u16, out: &mut [u8]) -> Result<(), Exception> {
        let words = if table == Table::HoldingRegisters { &self.holding } else { &self.input };
        for (i, pair) in out.chunks_exact_mut(2).enumerate() {
            pair.copy_from_slice(&words[usize::from(address) + i].to_be_bytes());
        }
        Ok(())
    }

    fn write(&mut self, write: &Write<'_>) -> Result<(), Exception> {
        if self.busy {
            return Err(Exception::ServerDeviceBusy);
        }
        self.writes += 1;
        match *write {
            Write::Coils { address, quantity, values } => {
                for i in 0..usize::from(quantity) {
                    self.coils[usize::from(address) + i] = values[i / 8] >> (i % 8) & 1 == 1;
                }
            }
            Write::Registers { address, values } => {
                for (i, pair) in values.chunks_exact(2).enumerate() {
                    self.holding[usize::from(address) + i] = u16::from_be_bytes([pair[0], pair[1]]);
                }
            }
            Write::Mask { address, and_mask, or_mask } => {
                let register = &mut self.holding[usize::from(address)];
                *register = (*register & and_mask) | (or_mask & !and_mask);
            }
        }
        Ok(())
    }

    fn select(&mut self, map: usize) {
        self.selected.push(map);
    }

    fn exception_status(&mut self) -> Result<u8, Exception> {
        Ok(self.status)
    }

    fn check_file(&self, _: Access, file: u16, record: u16, count: u16) -> Result<(), Exception> {
        let records = self.files.get(&file).map_or(0, Vec::len);
        let inside = usize::from(record) + usize::from(count) <= records;
        if inside { Ok(()) } else { Err(Exception::IllegalDataAddress) }
    }

    fn read_file(&mut self, file: u16, record: u16, out: &mut [u8]) -> Result<(), Exception> {
        for (pair, value) in out.chunks_exact_mut(2).zip(&self.files[&file][usize::from(record)..]) {
            pair.copy_from_slice(&value.to_be_bytes());
        }
        Ok(())
    }

    fn write_files(&mut self, groups: &[u8]) -> Result<(), Exception> {
        for group in files::write_groups(groups) {
            let records = self.files.get_mut(&group.file).unwrap();
            for (pair, record) in group.values.chunks_exact(2).zip(&mut records[usize::from(group.record)..])
            {
                *record = u16::from_be_bytes([pair[0], pair[1]]);
            }
        }
        self.writes += 1;
        Ok(())
    }

    fn check_fifo(&self, address: u16) -> Result<(), Exception> {
        if self.fifos.contains_key(&address) { Ok(()) } else { Err(Exception::IllegalDataAddress) }
    }

    fn read_fifo(&mut self, address: u16, out: &mut [u8; 2 * MAX_FIFO]) -> Result<usize, Exception> {
        let values = &self.fifos[&address];
        if values.len() > MAX_FIFO {
            return Err(Exception::IllegalDataValue);
        }
        for (pair, value) in out.chunks_exact_mut(2).zip(values) {
            pair.copy_from_slice(&value.to_be_bytes());
        }
        Ok(values.len())
    }
}

impl Backend for MemoryImage {
    fn begin(&mut self) {
        self.batches += 1;
    }
}
