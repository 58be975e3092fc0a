//! Shared serial lines that misbehave: a peer writes noise, other units' dialogs, frames that break off and frames that
//! were damaged, and between them valid requests, each after a silence. Every one of these is answered, once and
//! right, and nothing else is. An RTU and an ASCII line of one server at the same time.
//!
//! 20 s by default; `DINRAIL_SOAK_SECONDS=600` for ten minutes. `DINRAIL_SEED=N` for other bytes.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod support;

use dinrail_modbus::protocol::{ascii, rtu};
use serde_json::Value;
use std::fs::{File, OpenOptions};
use std::io::{Read, Write};
use std::path::Path;
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::thread::sleep;
use std::time::{Duration, Instant};
use support::Stack;

/// `grace` is longer than the silences of the peer: a request that follows a frame that broke off must be found
/// behind it by the silence between them. `stale_after`: a plc that does not get the CPU for a while is not the subject.
const STACK: &str = r#"
[stack]
name = "NAME"

[[service]]
name = "com1"
kind = "serial"
device = "pty:com1"
framing = "rtu"
grace = "300ms"

[[service]]
name = "com2"
kind = "serial"
device = "pty:com2"
framing = "ascii"

[[service]]
name = "plc"
kind = "plc"
cycle = "5ms"

[[service]]
name = "modbus"
kind = "modbus-server"
stale_after = "10s"
serial = [
    { port = "com1", mode = "rtu", unit = [1, 5] },
    { port = "com2", mode = "ascii", unit = [1, 5] },
]
"#;

/// Registers and coils of each line, so that the two do not meet.
const OWN: u16 = 100;
/// Longest wait for an answer: the machine may be busy.
const PATIENCE: Duration = Duration::from_secs(20);

/// xorshift64*: the same bytes for the same seed.
struct Rng(u64);

impl Rng {
    fn next(&mut self) -> u64 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        self.0.wrapping_mul(0x2545_F491_4F6C_DD1D) >> 16
    }
    fn below(&mut self, n: u64) -> u64 {
        self.next() % n
    }
    fn word(&mut self) -> u16 {
        self.next() as u16
    }
    fn bytes(&mut self, n: u64) -> Vec<u8> {
        (0..n).map(|_| self.next() as u8).collect()
    }
}

#[derive(Clone, Copy, PartialEq, Debug)]
enum Mode {
    Rtu,
    Ascii,
}

impl Mode {
    fn frame(self, unit: u8, pdu: &[u8]) -> Vec<u8> {
        match self {
            Self::Rtu => {
                let mut out = [0; rtu::MAX_ADU];
                let len = rtu::encode(unit, pdu, &mut out);
                out[..len].to_vec()
            }
            Self::Ascii => {
                let mut out = [0; ascii::MAX_ADU];
                let len = ascii::encode(unit, pdu, &mut out);
                out[..len].to_vec()
            }
        }
    }
}

/// What was written.
#[derive(Default, Debug)]
struct Tally {
    answered: u64,
    exceptions: u64,
    broadcasts: u64,
    noise: u64,
    /// Frames of other units, answers included.
    foreign: u64,
    truncated: u64,
    damaged: u64,
}

/// Everybody else on a line.
struct Peer {
    mode: Mode,
    seed: u64,
    rng: Rng,
    port: File,
    received: Receiver<Vec<u8>>,
    /// First register and coil of this line.
    base: u16,
    registers: Vec<u16>,
    coils: Vec<bool>,
    tally: Tally,
    step: u64,
}

fn words(values: &[u16]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_be_bytes()).collect()
}

fn read_request(function: u8, at: u16, count: u16) -> Vec<u8> {
    [&[function][..], &words(&[at, count])].concat()
}

impl Peer {
    fn new(path: &Path, mode: Mode, seed: u64, base: u16) -> Self {
        let port = OpenOptions::new().read(true).write(true).open(path).unwrap();
        let mut reader = port.try_clone().unwrap();
        let (send, received) = channel();
        // Ends when the driver closes its side.
        std::thread::spawn(move || {
            let mut some = [0; 1024];
            while let Ok(n @ 1..) = reader.read(&mut some) {
                if send.send(some[..n].to_vec()).is_err() {
                    return;
                }
            }
        });
        Self {
            mode,
            seed,
            rng: Rng(seed | 1),
            port,
            received,
            base,
            registers: vec![0; usize::from(OWN)],
            coils: vec![false; usize::from(OWN)],
            tally: Tally::default(),
            step: 0,
        }
    }

    fn place(&self) -> String {
        format!("{:?} line, seed {}, step {}", self.mode, self.seed, self.step)
    }

    fn write(&mut self, bytes: &[u8]) {
        self.port.write_all(bytes).unwrap_or_else(|e| panic!("{}: {e}", self.place()));
    }

    /// A silence that ends a frame. 3.5 characters at 19200 are 2 ms; this is so much longer because the driver cannot
    /// see a silence of a pseudo-terminal during which it does not get the CPU. ASCII needs none.
    fn silence(&mut self) {
        let (least, more) = if self.mode == Mode::Rtu { (120, 80) } else { (2, 15) };
        sleep(Duration::from_millis(least + self.rng.below(more)));
    }

    /// Nobody has said anything since the last answer.
    fn expect_nothing(&mut self, after: &str, written: &[u8]) {
        if let Ok(bytes) = self.received.try_recv() {
            panic!("{}: {bytes:02X?} was answered to {after} {written:02X?}", self.place());
        }
    }

    fn step(&mut self) {
        self.step += 1;
        let (what, written) = match self.rng.below(10) {
            0 | 1 => ("noise", self.noise()),
            2 | 3 => ("another unit's dialog", self.dialog()),
            4 => ("a frame that broke off", self.truncated()),
            5 => ("a damaged frame", self.damaged()),
            6 if self.rng.below(3) == 0 => ("a broadcast", self.broadcast()),
            _ => return self.request(),
        };
        self.silence();
        self.expect_nothing(what, &written);
    }

    fn noise(&mut self) -> Vec<u8> {
        self.tally.noise += 1;
        let longest = if self.rng.below(8) == 0 { 700 } else { 40 };
        let n = 1 + self.rng.below(longest);
        let mut bytes = self.rng.bytes(n);
        while self.mode == Mode::Rtu && rtu::is_frame(&bytes) {
            bytes = self.rng.bytes(n);
        }
        if self.mode == Mode::Ascii {
            // An LF would complete a frame before it that broke off just there.
            bytes.iter_mut().filter(|b| **b == b'\n').for_each(|b| *b = b'!');
        }
        self.write(&bytes);
        bytes
    }

    fn other_unit(&mut self) -> u8 {
        loop {
            let unit = self.rng.below(247) as u8 + 1;
            if unit != 1 && unit != 5 {
                return unit;
            }
        }
    }

    /// A request and mostly an answer; the data of some answers is a request to us.
    fn dialog(&mut self) -> Vec<u8> {
        let unit = self.other_unit();
        let count = 1 + self.rng.below(60) as u16;
        let at = self.rng.word();
        let (request, answer) = match self.rng.below(4) {
            0 => {
                let write = [&[6][..], &words(&[at, count])].concat();
                (write.clone(), write)
            }
            1 => (read_request(3, at, count), vec![0x83, 2]),
            2 => {
                let inner = self.mode.frame(1, &[&[6][..], &words(&[self.base, at])].concat());
                let inner = if inner.len().is_multiple_of(2) { inner } else { [inner, vec![0]].concat() };
                let count = (inner.len() / 2) as u16;
                (read_request(3, at, count), [&[3, inner.len() as u8][..], &inner].concat())
            }
            _ => {
                let data = self.rng.bytes(u64::from(count) * 2);
                (read_request(3, at, count), [&[3, data.len() as u8][..], &data].concat())
            }
        };
        let mut all = self.mode.frame(unit, &request);
        self.write(&all);
        self.tally.foreign += 1;
        if self.rng.below(4) > 0 {
            self.silence();
            self.expect_nothing("another unit's request", &all);
            let answer = self.mode.frame(unit, &answer);
            self.write(&answer);
            self.tally.foreign += 1;
            all.extend(answer);
        }
        all
    }

    /// A write to us or to another unit that would change a register if it were taken.
    fn tempting(&mut self) -> Vec<u8> {
        let unit = [1, 5, 0, self.other_unit()][self.rng.below(4) as usize];
        let (at, value) = (self.base + self.rng.below(u64::from(OWN)) as u16, self.rng.word());
        self.mode.frame(unit, &[&[6][..], &words(&[at, value])].concat())
    }

    fn truncated(&mut self) -> Vec<u8> {
        // One in 65,536 is a whole frame all the same, by its CRC.
        let frame = loop {
            let mut frame = self.tempting();
            let keep = 1 + self.rng.below(frame.len() as u64 - 1) as usize;
            frame.truncate(keep);
            if self.mode == Mode::Ascii || !rtu::is_frame(&frame) {
                break frame;
            }
        };
        self.tally.truncated += 1;
        self.write(&frame);
        frame
    }

    fn damaged(&mut self) -> Vec<u8> {
        let mut frame = self.tempting();
        match self.mode {
            Mode::Rtu => {
                let at = self.rng.below(frame.len() as u64) as usize;
                frame[at] ^= 1 << self.rng.below(8);
            }
            Mode::Ascii => {
                let at = 1 + self.rng.below(frame.len() as u64 - 3) as usize;
                frame[at] = if frame[at] == b'F' { b'0' } else { b'F' };
            }
        }
        self.tally.damaged += 1;
        self.write(&frame);
        frame
    }

    /// Carried out and not answered: later reads show it.
    fn broadcast(&mut self) -> Vec<u8> {
        let (index, value) = (self.rng.below(u64::from(OWN)), self.rng.word());
        let frame = self.mode.frame(0, &[&[6][..], &words(&[self.base + index as u16, value])].concat());
        self.registers[index as usize] = value;
        self.tally.broadcasts += 1;
        self.write(&frame);
        frame
    }

    fn request(&mut self) {
        let unit = if self.rng.below(3) == 0 { 5 } else { 1 };
        let (request, answer) = self.dialog_with_us();
        let request = self.mode.frame(unit, &request);
        let expected = self.mode.frame(unit, &answer);
        self.write(&request);
        let (mut got, began) = (Vec::new(), Instant::now());
        while got.len() < expected.len() {
            match self.received.recv_timeout(PATIENCE.saturating_sub(began.elapsed())) {
                Ok(bytes) => got.extend(bytes),
                Err(RecvTimeoutError::Timeout) => break,
                Err(RecvTimeoutError::Disconnected) => panic!("{}: the driver is gone", self.place()),
            }
        }
        assert_eq!(got, expected, "{}: answer to {request:02X?}", self.place());
        self.tally.answered += 1;
        self.tally.exceptions += u64::from(answer[0] & 0x80 != 0);
        self.silence();
        self.expect_nothing("what was answered already", &request);
    }

    /// A request and the answer that the specification and what was written so far ask for.
    fn dialog_with_us(&mut self) -> (Vec<u8>, Vec<u8>) {
        let first = self.rng.below(u64::from(OWN)) as usize;
        let count = 1 + self.rng.below(u64::from(OWN) - first as u64) as usize;
        let at = self.base + first as u16;
        let value = self.rng.word();
        match self.rng.below(9) {
            0 | 1 => {
                let data = words(&self.registers[first..first + count]);
                (read_request(3, at, count as u16), [&[3, data.len() as u8][..], &data].concat())
            }
            2 => {
                self.registers[first] = value;
                let pdu = [&[6][..], &words(&[at, value])].concat();
                (pdu.clone(), pdu)
            }
            3 => {
                let values: Vec<u16> = (0..count).map(|_| self.rng.word()).collect();
                self.registers[first..first + count].copy_from_slice(&values);
                let head = read_request(16, at, count as u16);
                ([&head[..], &[count as u8 * 2], &words(&values)].concat(), head)
            }
            4 => {
                let on = value & 1 != 0;
                self.coils[first] = on;
                let pdu = [&[5][..], &words(&[at, if on { 0xFF00 } else { 0 }])].concat();
                (pdu.clone(), pdu)
            }
            5 => {
                let mut data = vec![0_u8; count.div_ceil(8)];
                for (i, coil) in self.coils[first..first + count].iter().enumerate() {
                    data[i / 8] |= u8::from(*coil) << (i % 8);
                }
                (read_request(1, at, count as u16), [&[1, data.len() as u8][..], &data].concat())
            }
            6 => {
                let or = self.rng.word();
                let masked = (self.registers[first] & value) | (or & !value);
                self.registers[first] = masked;
                let pdu = [&[22][..], &words(&[at, value, or])].concat();
                (pdu.clone(), pdu)
            }
            7 => {
                let pdu = [&[8, 0, 0][..], &words(&[value])].concat();
                (pdu.clone(), pdu)
            }
            _ => match self.rng.below(3) {
                0 => (read_request(3, 3000, 1), vec![0x83, 2]),
                1 => (read_request(3, at, 0), vec![0x83, 3]),
                _ => (vec![9], vec![0x89, 1]),
            },
        }
    }

    fn run(mut self, span: Duration) -> Tally {
        let began = Instant::now();
        while began.elapsed() < span || self.tally.answered < 30 {
            self.step();
        }
        // Whatever had been begun is over; what was written to the end stands.
        sleep(Duration::from_millis(500));
        self.expect_nothing("the last of it", &[]);
        for first in (0..OWN).step_by(50) {
            let request = self.mode.frame(1, &read_request(3, self.base + first, 50));
            let data = words(&self.registers[usize::from(first)..usize::from(first) + 50]);
            let expected = self.mode.frame(1, &[&[3, 100][..], &data].concat());
            self.write(&request);
            let mut got = Vec::new();
            while got.len() < expected.len() {
                got.extend(self.received.recv_timeout(PATIENCE).unwrap());
            }
            assert_eq!(got, expected, "{}: the registers at the end", self.place());
            self.tally.answered += 1;
            self.silence();
        }
        self.tally
    }
}

/// What the server tells of its lines.
fn lines_of(stack: &Stack) -> Vec<Value> {
    let status: Value = serde_json::from_str(&stack.ok(&["status", "--json"])).unwrap();
    let rows = status["service_list"].as_array().unwrap();
    let row = rows.iter().find(|row| row["service"] == "modbus").unwrap();
    row["status"]["serial"].as_array().cloned().unwrap_or_default()
}

#[test]
fn valid_requests_are_answered_whatever_stands_between_them() {
    let seconds = std::env::var("DINRAIL_SOAK_SECONDS").ok().and_then(|s| s.parse().ok()).unwrap_or(20);
    let seed = std::env::var("DINRAIL_SEED").ok().and_then(|s| s.parse().ok()).unwrap_or(20_260_101);
    let span = Duration::from_secs(seconds);
    let mut stack = Stack::up("mbline", STACK, &[]);
    stack.wait("the plc runs", || stack.ok(&["plc", "status"]).contains("run").then_some(()));
    let tallies: Vec<Tally> = std::thread::scope(|scope| {
        let peers = [("com1", Mode::Rtu, 0), ("com2", Mode::Ascii, 200)].map(|(port, mode, base)| {
            let peer = Peer::new(&stack.scratch.0.join(port), mode, seed, base);
            scope.spawn(move || peer.run(span))
        });
        peers.into_iter().map(|peer| peer.join().expect("see above")).collect()
    });
    // The status is told once a second.
    let lines = stack.wait("a status with all of it", || {
        let lines = lines_of(&stack);
        let whole = lines.iter().zip(&tallies).all(|(line, tally)| line["sent"] == tally.answered);
        (lines.len() == 2 && whole).then_some(lines)
    });
    for (line, tally) in lines.iter().zip(&tallies) {
        eprintln!("{tally:?}\n{line}");
        assert_eq!(line["answers"], tally.answered, "{tally:?}\n{line}");
        assert_eq!(line["exceptions"], tally.exceptions, "{tally:?}\n{line}");
        assert_eq!(line["broadcasts"], tally.broadcasts, "{tally:?}\n{line}");
        assert_eq!(line["foreign"], tally.foreign, "{tally:?}\n{line}");
        for none in ["not_sent", "lost", "overlapped"] {
            assert_eq!(line[none], 0, "{none}: {line}");
        }
        let broken = ["crc_errors", "malformed"].map(|key| line[key].as_u64().unwrap()).iter().sum::<u64>();
        assert!(broken > 0, "{line}");
    }
    for service in ["com1", "com2", "modbus"] {
        assert_eq!(stack.generation(service), 1, "{service} was restarted");
    }
    assert_eq!(stack.take_down(), 0, "{}", stack.log());
}
