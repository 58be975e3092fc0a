//! Answers of the Modbus TCP server, in turns with the plainest server that libmodbus allows and with pymodbus; then
//! 200 connections at once, and the serial lines ([`super::modbus_lines`]).
//!
//! All servers run during the whole measurement and the rounds alternate, so that a busy machine is busy for
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
/// Clients at once.
const MANY: usize = 200;
const PEER_SOURCE: &str = include_str!("../../../../tests/peers/libmodbus_server.c");
const PYTHON_SOURCE: &str = include_str!("../../../../tests/peers/modbus_serve.py");

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
tcp = { address = "127.0.0.1", port = PORT, max_connections = 256 }
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
        // An exception is shorter than what is waited for.
        let read = self.stream.read(&mut self.answer).context("reading an answer")?;
        ensure!(read < 9 || self.answer[7] == 3, "unexpected answer {:02x?}", &self.answer[..read]);
        self.stream.read_exact(&mut self.answer[read..]).context("reading an answer")?;
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
    /// Whether it answers pipelined requests.
    pipelines: bool,
    single_us: Samples,
    pipelined: usize,
    pipelined_s: f64,
}

impl Side {
    fn new(port: u16, pipelines: bool) -> anyhow::Result<Self> {
        let mut client = Client::connect(port)?;
        // Warm.
        for _ in 0..200 {
            client.ask(0, REGISTERS)?;
        }
        Ok(Self { client, pipelines, single_us: Samples::default(), pipelined: 0, pipelined_s: 0.0 })
    }

    fn round(&mut self) -> anyhow::Result<()> {
        for _ in 0..SINGLE {
            let began = Instant::now();
            self.client.ask(0, REGISTERS)?;
            self.single_us.push(began.elapsed().as_nanos() as f64 / 1e3);
        }
        if !self.pipelines {
            return Ok(());
        }
        let began = Instant::now();
        for _ in 0..BATCHES {
            self.client.pipeline(PIPELINED, REGISTERS)?;
        }
        self.pipelined_s += began.elapsed().as_secs_f64();
        self.pipelined += BATCHES * PIPELINED;
        Ok(())
    }

    /// Writes the figures; gives requests a second with one and with 16 in flight.
    fn tell(self, bench: &mut Bench, name: &str) -> (f64, f64) {
        let single = self.single_us.sorted();
        let pipelined = if self.pipelines { self.pipelined as f64 / self.pipelined_s } else { 0.0 };
        bench.info(format!("{name} FC3 x 10, p50"), single.p50(), "us");
        bench.info(format!("{name} FC3 x 10, p99"), single.p99(), "us");
        bench.info(format!("{name} 1 in flight"), 1e6 / single.p50(), "requests/s");
        if self.pipelines {
            bench.info(format!("{name} 16 in flight"), pipelined, "requests/s");
        }
        (1e6 / single.p50(), pipelined)
    }
}

/// 200 connections, a request in flight on each.
fn many(bench: &mut Bench, port: u16, span: Duration) -> anyhow::Result<()> {
    let mut clients = Vec::with_capacity(MANY);
    for _ in 0..MANY {
        clients.push(Client::connect(port)?);
    }
    let mut samples = Samples::default();
    let (began, mut requests) = (Instant::now(), 0usize);
    while began.elapsed() < span {
        let mut sent = Vec::with_capacity(MANY);
        for client in &mut clients {
            let request = client.request(0, REGISTERS);
            sent.push(Instant::now());
            client.stream.write_all(&request).context("sending a request")?;
        }
        for (client, sent) in clients.iter_mut().zip(sent) {
            client.answers(1, REGISTERS)?;
            samples.push(sent.elapsed().as_nanos() as f64 / 1e3);
        }
        requests += MANY;
    }
    let samples = samples.sorted();
    bench.info(format!("{MANY} connections"), requests as f64 / began.elapsed().as_secs_f64(), "requests/s");
    bench.info(format!("{MANY} connections, p50"), samples.p50(), "us");
    bench.info(format!("{MANY} connections, p99"), samples.p99(), "us");
    Ok(())
}

pub fn run(bench: &mut Bench) -> anyhow::Result<()> {
    let span = Duration::from_secs(bench.seconds(SECONDS));
    let port = free_port()?;
    let cpus = cpus();
    let (first, last) = (*cpus.first().unwrap_or(&0), *cpus.last().unwrap_or(&0));
    let toml = STACK.replace("PORT", &port.to_string()).replace("CPU", &last.to_string());
    let mut stack = BenchStack::up(&bench.dir, "modbus", &toml, &[])?;
    let scratch = Scratch::new(&bench.dir, &format!("{}-peer", unique_name("modbus")))?;
    let (libmodbus, pymodbus) = (Peer::libmodbus(&scratch), Peer::pymodbus(&scratch));
    for peer in libmodbus.iter().chain(&pymodbus) {
        pin(Some(peer.child.id()), last);
    }
    {
        pin(None, first);
        let mut ours = Side::new(port, true)?;
        let mut c = libmodbus.as_ref().map(|peer| Side::new(peer.port, true)).transpose()?;
        // It drops the second of two requests in one segment.
        let mut python = pymodbus.as_ref().map(|peer| Side::new(peer.port, false)).transpose()?;
        let began = Instant::now();
        while began.elapsed() < span {
            for side in [Some(&mut ours), c.as_mut(), python.as_mut()].into_iter().flatten() {
                side.round()?;
            }
            stack.check()?;
        }
        let ours = ours.tell(bench, "dinrail");
        if first == last {
            bench.note("client and servers share one CPU");
        }
        let c = c.map(|side| side.tell(bench, "libmodbus"));
        let python = python.map(|side| side.tell(bench, "pymodbus"));
        if let Some(best) = c.iter().chain(&python).copied().reduce(|a, b| (a.0.max(b.0), a.1.max(b.1))) {
            bench.goal("1 in flight, dinrail / best", ours.0 / best.0, "", Goal::AtLeast(1.0));
            if best.1 > 0.0 {
                bench.goal("16 in flight, dinrail / best", ours.1 / best.1, "", Goal::AtLeast(2.0));
            }
        }
        if c.is_none() {
            bench.note("libmodbus was not compared: apt-get install gcc pkg-config libmodbus-dev");
        }
        if python.is_none() {
            bench.note("pymodbus was not compared: DINRAIL_PYTHON must name a python that has pymodbus 3.16");
        }
        many(bench, port, span / 4)?;
    }
    drop((libmodbus, pymodbus));
    stack.down()?;
    super::modbus_lines::run(bench, span)
}

/// A foreign server; killed when dropped.
struct Peer {
    child: Child,
    port: u16,
}

impl Peer {
    /// Compiles and starts the one of libmodbus; `None` when that is not possible here.
    fn libmodbus(scratch: &Scratch) -> Option<Self> {
        let program = compile(scratch).ok()??;
        let port = free_port().ok()?;
        let mut command = Command::new(program);
        command.arg(port.to_string());
        Self::start(command, port)
    }

    /// Starts the one of pymodbus, with the python named by DINRAIL_PYTHON, that of the project's tests beside this
    /// executable, or the system's.
    fn pymodbus(scratch: &Scratch) -> Option<Self> {
        let script = scratch.write("modbus_serve.py", PYTHON_SOURCE).ok()?;
        let own = std::env::current_exe()
            .ok()
            .and_then(|exe| Some(exe.parent()?.parent()?.join("peers/bin/python")));
        let named = std::env::var_os("DINRAIL_PYTHON").map(std::path::PathBuf::from);
        let pythons =
            named.into_iter().chain(own.filter(|path| path.exists())).chain([Path::new("python3").into()]);
        for python in pythons {
            let port = free_port().ok()?;
            let mut command = Command::new(python);
            command.arg("-u").arg(&script).args(["tcp", &port.to_string(), "1"]);
            if let Some(peer) = Self::start(command, port) {
                return Some(peer);
            }
        }
        None
    }

    fn start(mut command: Command, port: u16) -> Option<Self> {
        let command = command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::null());
        let mut child = command.spawn().ok()?;
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
