//! The virtual bus beside what else carries CAN frames between two programs without hardware: unmodified python-can on
//! our servers, and python-can's own buses (UDP multicast between processes, `virtual` inside one).

use super::Bench;
use super::stats::{Samples, number};
use anyhow::{Context as _, ensure};
use dinrail_can::protocol::Frame;
use dinrail_can::protocol::cannelloni::{Decoder, GREETING, Item, MAX_BYTES, encode};
use serde::Deserialize;
use serde_json::{Value, json};
use std::io::{Read, Write};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

const ROUNDS: usize = 2000;
const BURST: usize = 10_000;
const PATIENCE: Duration = Duration::from_secs(30);
const SCRIPT: &str = include_str!("../../../../tests/peers/can_bench.py");

/// Where the servers of the stack's virtual bus listen.
pub struct Ports {
    pub cannelloni: u16,
    pub socketcand: u16,
    pub slcan: u16,
}

#[derive(Deserialize)]
struct Told {
    rtt_us: Vec<f64>,
    sent: f64,
    received: f64,
    lost: f64,
}

pub fn run(bench: &mut Bench, ports: &Ports, dir: &Path) -> anyhow::Result<()> {
    let times = round_trips(ports.cannelloni)?.sorted();
    bench.info("two plain sockets, cannelloni: round trip p50", times.p50(), "us");
    bench.info("two plain sockets, cannelloni: round trip p99", times.p99(), "us");
    let Some(python) = python() else {
        bench.note(
            "not compared with python-can: none found; `pip install python-can can-cannelloni pyserial msgpack`, and DINRAIL_PYTHON=that python",
        );
        return Ok(());
    };
    let script = dir.join("can_bench.py");
    std::fs::write(&script, SCRIPT)?;
    let host = "127.0.0.1";
    let buses: [(&str, Value); 5] = [
        (
            "dinrail cannelloni server",
            json!({ "interface": "cannelloni", "host": host, "port": ports.cannelloni }),
        ),
        (
            "dinrail socketcand server",
            json!({ "interface": "socketcand", "host": host, "port": ports.socketcand, "channel": "can0" }),
        ),
        (
            "dinrail SLCAN server",
            json!({ "interface": "slcan", "channel": format!("socket://{host}:{}", ports.slcan), "bitrate": 500_000, "sleep_after_open": 0 }),
        ),
        (
            "python-can udp_multicast",
            json!({ "interface": "udp_multicast", "channel": "239.74.163.2", "hop_limit": 0 }),
        ),
        ("python-can virtual (threads)", json!({ "interface": "virtual", "channel": "dinrail-bench" })),
    ];
    for (name, arguments) in buses {
        match peers(&python, &script, &arguments) {
            Ok(told) => tell(bench, name, told),
            Err(e) => bench.note(format!("{name}: not measured: {e}")),
        }
    }
    Ok(())
}

fn tell(bench: &mut Bench, name: &str, told: Told) {
    let answered = told.rtt_us.len();
    let times = told.rtt_us.into_iter().collect::<Samples>().sorted();
    bench.info(format!("{name}: round trip p50"), times.p50(), "us");
    bench.info(format!("{name}: round trip p99"), times.p99(), "us");
    bench.info(format!("{name}: burst of {BURST} sent"), told.sent, "frames/s");
    bench.info(format!("{name}: burst received"), told.received, "frames/s");
    bench.info(format!("{name}: burst lost"), told.lost, "");
    if answered < ROUNDS {
        bench.note(format!("{name}: {} of {ROUNDS} round trips lost", number((ROUNDS - answered) as f64)));
    }
}

/// A python that has python-can: of the environment, of the project's tests, of the system.
fn python() -> Option<PathBuf> {
    let named = std::env::var_os("DINRAIL_PYTHON").map(PathBuf::from);
    let own = std::env::current_exe().ok();
    let tests = own.and_then(|exe| Some(exe.parent()?.parent()?.join("peers/bin/python")));
    let all = named.into_iter().chain(tests).chain([PathBuf::from("python3")]);
    let has = |python: &PathBuf| {
        let mut command = Command::new(python);
        command.args(["-c", "import can"]).stdout(Stdio::null()).stderr(Stdio::null());
        command.status().is_ok_and(|status| status.success())
    };
    all.into_iter().find(has)
}

fn peers(python: &Path, script: &Path, arguments: &Value) -> anyhow::Result<Told> {
    let output = Command::new(python)
        .arg(script)
        .arg(arguments.to_string())
        .args([ROUNDS.to_string(), BURST.to_string()])
        .stdin(Stdio::null())
        .output()?;
    let errors = String::from_utf8_lossy(&output.stderr);
    let last = errors.lines().last().unwrap_or("no word why").to_owned();
    ensure!(output.status.success(), "{last}");
    serde_json::from_slice(&output.stdout).context("what it printed")
}

/// A cannelloni client that is nothing but a socket.
struct Plain {
    stream: TcpStream,
    decoder: Decoder,
    buffer: Vec<u8>,
    at: usize,
}

impl Plain {
    fn connect(port: u16) -> anyhow::Result<Self> {
        let mut stream = TcpStream::connect(("127.0.0.1", port))?;
        stream.set_nodelay(true)?;
        stream.set_read_timeout(Some(PATIENCE))?;
        stream.write_all(GREETING)?;
        let mut plain = Self { stream, decoder: Decoder::default(), buffer: Vec::new(), at: 0 };
        ensure!(plain.next()? == Item::Greeted, "the server did not greet");
        Ok(plain)
    }

    fn next(&mut self) -> anyhow::Result<Item> {
        loop {
            let mut rest = &self.buffer[self.at..];
            let item = self.decoder.next(&mut rest);
            self.at = self.buffer.len() - rest.len();
            if let Some(item) = item {
                return Ok(item);
            }
            self.buffer.resize(4096, 0);
            let n = self.stream.read(&mut self.buffer).context("waiting for a frame")?;
            ensure!(n > 0, "the server ended the connection");
            self.buffer.truncate(n);
            self.at = 0;
        }
    }

    fn send(&mut self, frame: &Frame) -> anyhow::Result<()> {
        let mut bytes = [0; MAX_BYTES];
        let n = encode(frame, &mut bytes);
        Ok(self.stream.write_all(&bytes[..n])?)
    }
}

/// One client sends, the other answers: two passes through the driver.
fn round_trips(port: u16) -> anyhow::Result<Samples> {
    let (mut near, mut far) = (Plain::connect(port)?, Plain::connect(port)?);
    let mut samples = Samples::default();
    let other = std::thread::spawn(move || -> anyhow::Result<()> {
        loop {
            match far.next()? {
                Item::Frame(frame) if frame.id() == 0x7FF => return Ok(()),
                Item::Frame(frame) => far.send(&Frame { can_id: frame.can_id + 1, ..frame })?,
                _ => {}
            }
        }
    });
    for i in 0..ROUNDS + 200 {
        let began = Instant::now();
        near.send(&Frame::data(0x100, false, &(i as u64).to_le_bytes())?)?;
        while !matches!(near.next()?, Item::Frame(frame) if frame.id() == 0x101) {}
        if i >= 200 {
            samples.push(began.elapsed().as_nanos() as f64 / 1e3);
        }
    }
    near.send(&Frame::data(0x7FF, false, &[])?)?;
    other.join().map_err(|_| anyhow::anyhow!("the other client panicked"))??;
    Ok(samples)
}
