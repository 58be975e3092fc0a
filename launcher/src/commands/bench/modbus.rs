//! Answers of the Modbus TCP server, in turns with the plainest server that libmodbus allows.
//!
//! Both servers run during the whole measurement and the rounds alternate, so that a busy machine is busy for
//! both. The client is a blocking socket without Nagle's delay. It stays on one CPU and both servers on another:
//! left to the scheduler, a server that happens to share the client's CPU answers in half the time.

use super::machine::{cpus, pin};
use super::stack::{BenchStack, PATIENCE, Scratch, free_port, unique_name};
use super::stats::Samples;
use super::{Bench, Goal};
use anyhow::{Context as _, ensure};
use std::io::{self, BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

const SECONDS: u64 = 10;
/// Requests one after the other in a round.
const SINGLE: usize = 500;
/// Batches of pipelined requests in a round.
const BATCHES: usize = 50;
const PIPELINED: usize = 16;
const REGISTERS: u16 = 10;
const PEER_SOURCE: &str = include_str!("../../../../tests/peers/libmodbus_server.c");

const STACK: &str = r#"
[stack]
name = "NAME"

[[service]]
name = "plc"
kind = "plc"
cycle = "10ms"

[[service]]
name = "modbus"
kind = "modbus-server"
tcp = { address = "127.0.0.1", port = PORT }
cpus = [CPU]
"#;

/// A Modbus TCP client that reads holding registers.
pub struct Client {
    stream: TcpStream,
    transaction: u16,
    answer: Vec<u8>,
}

impl Client {
    pub fn connect(port: u16) -> io::Result<Self> {
        let stream = TcpStream::connect(("127.0.0.1", port))?;
        stream.set_nodelay(true)?;
        stream.set_read_timeout(Some(PATIENCE))?;
        Ok(Self { stream, transaction: 0, answer: Vec::new() })
    }

    fn request(&mut self, address: u16, count: u16) -> [u8; 12] {
        self.transaction = self.transaction.wrapping_add(1);
        let ([t0, t1], [a0, a1], [c0, c1]) =
            (self.transaction.to_be_bytes(), address.to_be_bytes(), count.to_be_bytes());
        [t0, t1, 0, 0, 0, 6, 1, 3, a0, a1, c0, c1]
    }

    /// Reads the answers to requests sent in one go, all with the same number of registers.
    fn answers(&mut self, requests: usize, count: u16) -> anyhow::Result<()> {
        let length = 9 + usize::from(count) * 2;
        self.answer.resize(requests * length, 0);
        self.stream.read_exact(&mut self.answer).context("reading an answer")?;
        let first = self.transaction.wrapping_sub(requests as u16 - 1);
        for (i, answer) in self.answer.chunks(length).enumerate() {
            let transaction = first.wrapping_add(i as u16).to_be_bytes();
            let expected = answer[..2] == transaction && answer[7] == 3 && answer[8] == (count * 2) as u8;
            ensure!(expected, "unexpected answer {answer:02x?}");
        }
        Ok(())
    }

    /// Reads holding registers.
    pub fn holding(&mut self, address: u16, count: u16) -> anyhow::Result<Vec<u16>> {
        self.ask(address, count)?;
        Ok(self.answer[9..].chunks(2).map(|c| u16::from_be_bytes([c[0], c[1]])).collect())
    }

    fn ask(&mut self, address: u16, count: u16) -> anyhow::Result<()> {
        let request = self.request(address, count);
        self.stream.write_all(&request).context("sending a request")?;
        self.answers(1, count)
    }

    /// Sends several requests in one write and waits for all answers.
    fn pipeline(&mut self, requests: usize, count: u16) -> anyhow::Result<()> {
        let bytes: Vec<u8> = (0..requests).flat_map(|_| self.request(0, count)).collect();
        self.stream.write_all(&bytes).context("sending requests")?;
        self.answers(requests, count)
    }
}

/// What was measured on one server.
struct Side {
    client: Client,
    single_us: Samples,
    pipelined: usize,
    pipelined_s: f64,
}

impl Side {
    fn new(port: u16) -> anyhow::Result<Self> {
        let mut client = Client::connect(port)?;
        // Warm.
        for _ in 0..200 {
            client.ask(0, REGISTERS)?;
        }
        Ok(Self { client, single_us: Samples::default(), pipelined: 0, pipelined_s: 0.0 })
    }

    fn round(&mut self) -> anyhow::Result<()> {
        for _ in 0..SINGLE {
            let began = Instant::now();
            self.client.ask(0, REGISTERS)?;
            self.single_us.push(began.elapsed().as_nanos() as f64 / 1e3);
        }
        let began = Instant::now();
        for _ in 0..BATCHES {
            self.client.pipeline(PIPELINED, REGISTERS)?;
        }
        self.pipelined_s += began.elapsed().as_secs_f64();
        self.pipelined += BATCHES * PIPELINED;
        Ok(())
    }

    /// Writes the figures; gives the median.
    fn tell(self, bench: &mut Bench, name: &str) -> f64 {
        let single = self.single_us.sorted();
        bench.info(format!("{name} FC3 x 10, p50"), single.p50(), "us");
        bench.info(format!("{name} FC3 x 10, p99"), single.p99(), "us");
        bench.info(format!("{name} 16 in flight"), self.pipelined as f64 / self.pipelined_s, "requests/s");
        single.p50()
    }
}

pub fn run(bench: &mut Bench) -> anyhow::Result<()> {
    let span = Duration::from_secs(bench.seconds(SECONDS));
    let port = free_port()?;
    let cpus = cpus();
    let (first, last) = (*cpus.first().unwrap_or(&0), *cpus.last().unwrap_or(&0));
    let toml = STACK.replace("PORT", &port.to_string()).replace("CPU", &last.to_string());
    let mut stack = BenchStack::up(&bench.dir, "modbus", &toml, &[])?;
    let scratch = Scratch::new(&bench.dir, &format!("{}-peer", unique_name("modbus")))?;
    let peer = Peer::start(&scratch);
    if let Some(peer) = &peer {
        pin(Some(peer.child.id()), last);
    }
    {
        pin(None, first);
        let mut ours = Side::new(port)?;
        let mut theirs = peer.as_ref().map(|peer| Side::new(peer.port)).transpose()?;
        let began = Instant::now();
        while began.elapsed() < span {
            ours.round()?;
            if let Some(theirs) = &mut theirs {
                theirs.round()?;
            }
            stack.check()?;
        }
        let ours_us = ours.tell(bench, "dinrail");
        if first == last {
            bench.note("client and servers share one CPU");
        }
        if let Some(theirs) = theirs {
            let theirs_us = theirs.tell(bench, "libmodbus");
            bench.goal("p50, dinrail / libmodbus", ours_us / theirs_us, "", Goal::AtMost(1.2));
        } else {
            bench.note("not compared: apt-get install gcc pkg-config libmodbus-dev");
        }
    }
    stack.down()?;
    Ok(())
}

/// The libmodbus server; killed when dropped.
struct Peer {
    child: Child,
    port: u16,
}

impl Peer {
    /// Compiles and starts it; `None` when that is not possible here.
    fn start(scratch: &Scratch) -> Option<Self> {
        let program = compile(scratch).ok()??;
        let port = free_port().ok()?;
        let mut child = Command::new(program)
            .arg(port.to_string())
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .spawn()
            .ok()?;
        let mut line = String::new();
        // It says "ready" or ends.
        let ready = child
            .stdout
            .take()
            .is_some_and(|out| BufReader::new(out).read_line(&mut line).is_ok() && line.trim() == "ready");
        let peer = Self { child, port };
        ready.then_some(peer)
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn compile(scratch: &Scratch) -> anyhow::Result<Option<std::path::PathBuf>> {
    let source = scratch.write("libmodbus_server.c", PEER_SOURCE)?;
    let flags = Command::new("pkg-config").args(["--cflags", "--libs", "libmodbus"]).output()?;
    if !flags.status.success() {
        return Ok(None);
    }
    let flags = String::from_utf8(flags.stdout)?;
    let program = scratch.path().join("libmodbus_server");
    let built = Command::new("gcc")
        .arg("-O2")
        .args([source.as_path(), Path::new("-o"), program.as_path()])
        .args(flags.split_whitespace())
        .output()?;
    Ok(built.status.success().then_some(program))
}
