//! A shared serial line in front of the server: whatever chunks come, it neither breaks nor answers anything but
//! whole frames to its unit, and afterwards a good request is answered. The first byte chooses RTU or ASCII; the rest
//! are chunks: flags, length, bytes.

#![no_main]

use dinrail_modbus::device::{Device, Shared};
use dinrail_modbus::line::{Line, Mode};
use dinrail_modbus::protocol::pdu::Exception;
use dinrail_modbus::protocol::{ascii, rtu};
use dinrail_modbus::server::{Access, Image, Table, Write};
use ipc_types::payload::{SerialChunk, serial_flag};
use libfuzzer_sys::fuzz_target;

/// Everything is there and zero.
struct Zeros;

impl Image for Zeros {
    fn check(&self, _: Access, _: Table, _: u16, _: u16) -> Result<(), Exception> {
        Ok(())
    }
    fn ready(&self, _: Access) -> Result<(), Exception> {
        Ok(())
    }
    fn read_bits(&mut self, _: Table, _: u16, _: u16, out: &mut [u8]) -> Result<(), Exception> {
        out.fill(0);
        Ok(())
    }
    fn read_words(&mut self, _: Table, _: u16, out: &mut [u8]) -> Result<(), Exception> {
        out.fill(0);
        Ok(())
    }
    fn write(&mut self, _: &Write<'_>) -> Result<(), Exception> {
        Ok(())
    }
}

fn frame(mode: Mode, pdu: &[u8]) -> Vec<u8> {
    if mode == Mode::Rtu {
        let mut out = [0; rtu::MAX_ADU];
        let len = rtu::encode(5, pdu, &mut out);
        return out[..len].to_vec();
    }
    let mut out = [0; ascii::MAX_ADU];
    let len = ascii::encode(5, pdu, &mut out);
    out[..len].to_vec()
}

fuzz_target!(|data: &[u8]| {
    let Some((&mode, mut rest)) = data.split_first() else { return };
    let mode = if mode & 1 == 0 { Mode::Rtu } else { Mode::Ascii };
    let device = Device::line(&[(5, 0), (6, 0)], mode == Mode::Rtu, Shared::open());
    let mut line = Line::new(mode, 0, device, 1, 1);
    let mut seq = 0;
    let mut chunk = |line: &mut Line, flags: u32, bytes: &[u8], sent: &mut Vec<Vec<u8>>| {
        seq += 1;
        let mut header = SerialChunk { flags, ..SerialChunk::default() };
        (header.stamp.seq, header.stamp.generation) = (seq, 1);
        line.chunk(&header, bytes, &mut Zeros, &mut |frame| {
            sent.push(frame.to_vec());
            true
        });
    };
    let mut sent = Vec::new();
    while let &[flags, len, ref tail @ ..] = rest {
        let (bytes, tail) = tail.split_at(usize::from(len).min(tail.len()));
        chunk(&mut line, u32::from(flags), bytes, &mut sent);
        rest = tail;
    }
    for answer in &sent {
        let mut buffer = [0; 256];
        let unit = match mode {
            Mode::Rtu => rtu::decode(answer).map(|(unit, _)| unit),
            // The delimiter may have been changed.
            Mode::Ascii => ascii::decode_with(answer, *answer.last().unwrap(), &mut buffer).map(|(unit, _)| unit),
        };
        assert!(matches!(unit.unwrap(), 5 | 6 | 255));
    }
    if mode == Mode::Rtu {
        chunk(&mut line, serial_flag::END, &[], &mut sent);
        chunk(&mut line, serial_flag::END, &frame(mode, &[8, 0, 1, 0, 0]), &mut sent);
        sent.clear();
        chunk(&mut line, serial_flag::END, &frame(mode, &[3, 0, 0, 0, 1]), &mut sent);
        assert_eq!(sent, [frame(mode, &[3, 2, 0, 0])]);
    }
});
