//! Helpers of the tests: a plain memory of four tables as the simplest possible [`Image`], and test vectors.

use crate::protocol::pdu::{Exception, bytes_for_bits};
use crate::server::{Access, Image, Table, Write};
use crate::tcp::Backend;

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
}

impl Backend for MemoryImage {
    fn begin(&mut self) {
        self.batches += 1;
    }
}
