//! RTU units on a line: threads of the test that sit at the other end of a pseudo-terminal, answer, and note every
//! request in the order in which it came.

use dinrail_modbus::protocol::rtu::{self, RequestLength};
use std::fs::{File, OpenOptions};
use std::io::{Read, Write};
use std::path::Path;
use std::sync::{Arc, Mutex};
use std::time::Duration;

/// A request: unit and PDU.
pub type Noted = (u8, Vec<u8>);

/// See the module.
pub struct Units {
    noted: Arc<Mutex<Vec<Noted>>>,
}

impl Units {
    /// All units but the dead ones answer after `delay`: registers hold the unit's number, bits are off, writes are
    /// confirmed. Ends when the driver closes its side.
    pub fn start(line: &Path, dead: &[u8], delay: Duration) -> Self {
        let port = OpenOptions::new().read(true).write(true).open(line).unwrap();
        let noted = Arc::new(Mutex::new(Vec::new()));
        let (notes, dead) = (Arc::clone(&noted), dead.to_vec());
        std::thread::spawn(move || serve(port, &notes, &dead, delay));
        Self { noted }
    }

    /// Every request so far.
    pub fn noted(&self) -> Vec<Noted> {
        self.noted.lock().unwrap().clone()
    }

    /// Requests so far.
    pub fn count(&self) -> usize {
        self.noted.lock().unwrap().len()
    }

    /// Requests so far to each of the units 0 to 247.
    pub fn by_unit(&self) -> Vec<u32> {
        let mut counts = vec![0; 248];
        for (unit, _) in self.noted.lock().unwrap().iter() {
            counts[usize::from(*unit)] += 1;
        }
        counts
    }
}

/// Whether a request writes.
pub fn is_write((_, pdu): &Noted) -> bool {
    matches!(pdu[0], 5 | 6 | 15 | 16)
}

fn serve(mut port: File, noted: &Mutex<Vec<Noted>>, dead: &[u8], delay: Duration) {
    let (mut bytes, mut some) = (Vec::new(), [0; 512]);
    while let Ok(n @ 1..) = port.read(&mut some) {
        bytes.extend_from_slice(&some[..n]);
        while let RequestLength::Bytes(len) = rtu::request_length(&bytes)
            && bytes.len() >= len
        {
            let frame: Vec<u8> = bytes.drain(..len).collect();
            let (unit, pdu) = rtu::decode(&frame).expect("the master's frame is whole");
            noted.lock().unwrap().push((unit, pdu.to_vec()));
            if unit == 0 || dead.contains(&unit) {
                continue;
            }
            std::thread::sleep(delay);
            let mut out = [0; rtu::MAX_ADU];
            let len = rtu::encode(unit, &answer(unit, pdu), &mut out);
            if port.write_all(&out[..len]).is_err() {
                return;
            }
        }
    }
}

fn answer(unit: u8, pdu: &[u8]) -> Vec<u8> {
    let count = usize::from(u16::from_be_bytes([pdu[3], pdu[4]]));
    match pdu[0] {
        1 | 2 => [&[pdu[0], count.div_ceil(8) as u8][..], &vec![0; count.div_ceil(8)]].concat(),
        3 | 4 => [&[pdu[0], count as u8 * 2][..], &[0, unit].repeat(count)].concat(),
        5 | 6 => pdu.to_vec(),
        15 | 16 => pdu[..5].to_vec(),
        other => vec![other | 0x80, 1],
    }
}
