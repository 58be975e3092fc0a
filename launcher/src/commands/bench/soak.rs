//! What a line carries in 24 hours, as fast as a stack takes it: memory, shared memory and descriptors of every process
//! must stay as they are.
//!
//! A server answers on a pseudo-terminal and on Modbus TCP, whose connections are closed and opened again all the time;
//! a master polls a unit on a line of its own; everything is recorded. All traffic rests while memory is looked at, so
//! that no buffer that is in use counts as growth.
//!
//! What counts is anonymous memory, a process's own, since the recorder has begun its third file: by then everything has
//! happened once. Pages of the executable and of the queues on the rail become resident when they are used first and
//! have their size from the start; the queues' use is told apart, for the stack as a whole.

use super::modbus::Client;
use super::modbus_unit::Unit;
use super::stack::{BenchStack, PATIENCE, free_port};
use super::{Bench, Goal};
use anyhow::{Context as _, bail, ensure};
use dinrail_modbus::protocol::rtu;
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use std::fs::{File, OpenOptions, read_dir, read_to_string};
use std::io::{Read as _, Write as _};
use std::net::TcpStream;
use std::os::fd::AsFd as _;
use std::os::unix::fs::MetadataExt as _;
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

/// FC3 x 10 registers at 9600 8E1 with 3.5 characters of silence twice take 45.8 ms.
const REQUESTS_PER_S: f64 = 21.8;
const DAY_S: f64 = 86_400.0;
/// Connections of a whole run.
const CONNECTIONS: u64 = 20_000;
const REGISTERS: u16 = 10;
/// Parts of the run, in per cent: warm-up, first and second half of what counts.
const PARTS: [u64; 3] = [10, 45, 45];
/// Files the recorder has begun when the warm-up ends: with the second it asks the PLC for a keyframe, which connects it.
const WARM_FILES: u64 = 3;
/// Growth that is none: allocators keep pages back by chance.
const FLAT_MIB: f64 = 1.0;
/// The launcher may still hold the connection that asked for the processes; a leak of twenty thousand connections or of
/// a file a rotation is more.
const GAINED: f64 = 1.0;
/// How far TCP may be ahead of the line, in requests.
const AHEAD: u64 = 1000;
/// How long closed connections may take to be gone.
const CLOSING: Duration = Duration::from_secs(5);
const MIB: f64 = (1 << 20) as f64;

/// A silence of 0.1 ms: on a pseudo-terminal without a pace frames come whole. Recordings are so small that the first
/// of them end while the stack warms up.
const STACK: &str = r#"
[stack]
name = "NAME"

[[service]]
name = "com1"
kind = "serial"
device = "pty:slave"
silence = "100us"
grace = "2ms"

[[service]]
name = "com2"
kind = "serial"
device = "pty:line"

[[service]]
name = "plc"
kind = "plc"
cycle = "10ms"

[[service]]
name = "server"
kind = "modbus-server"
tcp = { address = "127.0.0.1", port = PORT }
serial = [ { port = "com1", unit = 1 } ]

[[service]]
name = "master"
kind = "modbus-client"
serial = "com2"

[[service.read]]
unit = 1
table = "holding_registers"
at = 0
count = 10
to = "%IW0"
period = "20ms"

[[service]]
name = "rec"
kind = "recorder"
dir = "recordings"
max_size = "1MiB"
keep = "8MiB"
"#;

/// What one process holds.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
struct Held {
    /// Resident memory, shared pages whole.
    rss: u64,
    /// Of it, the process's own: anonymous pages, which are heap and stacks.
    private: u64,
    descriptors: u64,
    threads: u64,
}

impl Held {
    fn of(pid: u32) -> Option<Self> {
        let status = read_to_string(format!("/proc/{pid}/status")).ok()?;
        let descriptors = read_dir(format!("/proc/{pid}/fd")).ok()?.count() as u64;
        Self::read(&status, descriptors)
    }

    fn read(status: &str, descriptors: u64) -> Option<Self> {
        let number = |key: &str| {
            let line = status.lines().find(|line| line.starts_with(key))?;
            line.split_whitespace().nth(1)?.parse::<u64>().ok()
        };
        let kib = |key| Some(number(key)? * 1024);
        let (rss, private) = (kib("VmRSS:")?, kib("RssAnon:")?);
        Some(Self { rss, private, descriptors, threads: number("Threads:")? })
    }
}

/// Every process, and the stack's shared memory.
struct Look {
    name: &'static str,
    requests: u64,
    processes: Vec<(String, u32, Held)>,
    shared: u64,
}

/// Memory in use below a path, files of sparse pages by what they use.
fn used_bytes(path: &Path) -> u64 {
    let Ok(about) = path.symlink_metadata() else { return 0 };
    let own = about.blocks() * 512;
    let inside = read_dir(path).into_iter().flatten().flatten();
    own + if about.is_dir() { inside.map(|entry| used_bytes(&entry.path())).sum() } else { 0 }
}

impl Look {
    fn at(stack: &BenchStack, name: &'static str, requests: u64) -> anyhow::Result<Self> {
        let mut processes = Vec::new();
        for (name, pid) in stack.processes()? {
            let held = Held::of(pid).with_context(|| format!("{name} is gone"))?;
            processes.push((name, pid, held));
        }
        let shared = stack.leftovers().iter().map(|name| used_bytes(&Path::new("/dev/shm").join(name))).sum();
        Ok(Self { name, requests, processes, shared })
    }
}

/// Number of the newest recording, which counts them all.
fn files_begun(recordings: &Path) -> u64 {
    let number = |name: &str| name.strip_suffix(".mcap")?.rsplit_once('-')?.1.parse::<u64>().ok();
    let names = read_dir(recordings).into_iter().flatten().flatten();
    names.filter_map(|entry| number(entry.file_name().to_str()?)).max().unwrap_or(0)
}

/// Whether a register is answered; not with an exception, which is shorter and says that the PLC has not begun.
fn serves(port: u16) -> Option<()> {
    let mut stream = TcpStream::connect(("127.0.0.1", port)).ok()?;
    stream.set_read_timeout(Some(Duration::from_secs(1))).ok()?;
    stream.write_all(&[0, 1, 0, 0, 0, 6, 1, 3, 0, 0, 0, 1]).ok()?;
    let mut head = [0; 9];
    stream.read_exact(&mut head).ok()?;
    (head[7] == 3).then_some(())
}

/// What the traffic came to.
#[derive(Default)]
struct Traffic {
    line: AtomicU64,
    tcp: AtomicU64,
    connections: AtomicU64,
    /// Something failed: the others end too.
    over: AtomicBool,
}

impl Traffic {
    fn is_over(&self) -> bool {
        self.over.load(Ordering::Relaxed)
    }
}

/// What one part of the run does.
#[derive(Clone, Copy)]
struct Part {
    /// Requests on the line, and as many on TCP.
    requests: u64,
    per_connection: u64,
    /// Ends it early.
    until: Option<Instant>,
}

impl Part {
    fn is_late(&self) -> bool {
        self.until.is_some_and(|until| Instant::now() >= until)
    }
}

/// A master on the pseudo-terminal.
struct Line {
    port: File,
}

impl Line {
    fn open(path: &Path) -> anyhow::Result<Self> {
        let port = OpenOptions::new().read(true).write(true).open(path).context("opening the line")?;
        Ok(Self { port })
    }

    /// Sends a request and reads the answer, which must be this one.
    fn ask(&mut self, request: &[u8], expected: &[u8]) -> anyhow::Result<()> {
        self.port.write_all(request).context("writing to the line")?;
        let (mut answer, mut len) = ([0; rtu::MAX_ADU], 0);
        while len < expected.len() {
            let wait = Timespec { tv_sec: PATIENCE.as_secs() as i64, tv_nsec: 0 };
            let ready = poll(&mut [PollFd::from_borrowed_fd(self.port.as_fd(), PollFlags::IN)], Some(&wait))?;
            ensure!(ready > 0, "no answer on the line within {} s", PATIENCE.as_secs());
            len += self.port.read(&mut answer[len..]).context("reading from the line")?;
        }
        ensure!(answer[..len] == *expected, "unexpected answer {:02x?} on the line", &answer[..len]);
        Ok(())
    }
}

fn frame(pdu: &[u8]) -> Vec<u8> {
    let mut frame = [0; rtu::MAX_ADU];
    let len = rtu::encode(1, pdu, &mut frame);
    frame[..len].to_vec()
}

/// What stands in the registers that are read.
fn values() -> Vec<u16> {
    (0..REGISTERS).map(|i| 0x1100 + i).collect()
}

fn write_values(line: &mut Line) -> anyhow::Result<()> {
    let head = [16, 0, 0, 0, REGISTERS as u8];
    let data: Vec<u8> = values().iter().flat_map(|v| v.to_be_bytes()).collect();
    line.ask(&frame(&[&head[..], &[data.len() as u8], &data].concat()), &frame(&head))
}

fn on_line(line: &mut Line, part: Part, traffic: &Traffic) -> anyhow::Result<()> {
    let request = frame(&[3, 0, 0, 0, REGISTERS as u8]);
    let data: Vec<u8> = values().iter().flat_map(|v| v.to_be_bytes()).collect();
    let expected = frame(&[&[3, data.len() as u8][..], &data].concat());
    for i in 0..part.requests {
        if traffic.is_over() || (i % 64 == 0 && part.is_late()) {
            break;
        }
        line.ask(&request, &expected)?;
        traffic.line.fetch_add(1, Ordering::Relaxed);
    }
    Ok(())
}

/// As many requests as the line, in step with it.
fn on_tcp(port: u16, part: Part, traffic: &Traffic, line_done: &AtomicBool) -> anyhow::Result<()> {
    let (expected, mut left) = (values(), part.requests);
    while left > 0 && !traffic.is_over() {
        let mut client = Client::connect(port)?;
        traffic.connections.fetch_add(1, Ordering::Relaxed);
        for _ in 0..part.per_connection.min(left) {
            ensure!(client.holding(0, REGISTERS)? == expected, "wrong registers over TCP");
            traffic.tcp.fetch_add(1, Ordering::Relaxed);
            left -= 1;
        }
        drop(client);
        let ahead = || traffic.tcp.load(Ordering::Relaxed) > traffic.line.load(Ordering::Relaxed) + AHEAD;
        while ahead() && !line_done.load(Ordering::Relaxed) && !traffic.is_over() {
            std::thread::sleep(Duration::from_millis(1));
        }
        if part.is_late() {
            break;
        }
    }
    Ok(())
}

/// Both at once.
fn both(line: &mut Line, port: u16, part: Part, traffic: &Traffic) -> anyhow::Result<()> {
    let line_done = AtomicBool::new(false);
    std::thread::scope(|scope| {
        let tcp = scope.spawn(|| {
            let result = on_tcp(port, part, traffic, &line_done);
            traffic.over.fetch_or(result.is_err(), Ordering::Relaxed);
            result
        });
        let result = on_line(line, part, traffic);
        traffic.over.fetch_or(result.is_err(), Ordering::Relaxed);
        line_done.store(true, Ordering::Relaxed);
        let Ok(tcp) = tcp.join() else { bail!("the TCP client panicked") };
        result.and(tcp)
    })
}

pub fn run(bench: &mut Bench) -> anyhow::Result<()> {
    let port = free_port()?;
    let toml = STACK.replace("PORT", &port.to_string());
    let mut stack = BenchStack::up(&bench.dir, "soak", &toml, &[])?;
    let (slave, master) = (stack.dir().join("slave"), stack.dir().join("line"));
    stack.wait("the pseudo-terminals", |_| (slave.exists() && master.exists()).then_some(()))?;
    let unit = Unit::start(&master)?;
    let mut line = Line::open(&slave)?;
    stack.wait("the server to serve", |_| serves(port))?;
    write_values(&mut line)?;

    let traffic = Traffic::default();
    let whole = (REQUESTS_PER_S * DAY_S) as u64;
    let began = Instant::now();
    let mut looks = vec![Look::at(&stack, "at the start", 0)?];
    let (mut done, mut warm_files) = (0, 0);
    for (percent, name) in PARTS.into_iter().zip(["warm", "in the middle", "at the end"]) {
        done += percent;
        let until = bench.seconds.map(|s| began + Duration::from_millis(s * 10 * done));
        let part =
            Part { requests: whole * percent / 100, per_connection: whole.div_ceil(CONNECTIONS), until };
        both(&mut line, port, part, &traffic)?;
        let limit = Instant::now() + PATIENCE;
        while done == PARTS[0] && files_begun(&stack.dir().join("recordings")) < WARM_FILES {
            ensure!(Instant::now() < limit, "the recorder does not begin its {WARM_FILES}rd file");
            let more = Part { requests: part.per_connection, until: None, ..part };
            both(&mut line, port, more, &traffic)?;
        }
        let requests = traffic.line.load(Ordering::Relaxed) + traffic.tcp.load(Ordering::Relaxed);
        eprintln!("{done} %: {requests} requests in {} s", began.elapsed().as_secs());
        let ended = Instant::now();
        stack.wait("the server to see its connections closed", |stack| {
            let (first, now) = (looks.first()?, Look::at(stack, name, requests).ok()?);
            let open = |look: &Look| {
                let server = look.processes.iter().find(|(name, _, _)| name == "server");
                server.map(|(_, _, held)| held.descriptors)
            };
            let more = open(&now) > open(first);
            // A leak never goes: then what is there is told.
            (!more || ended.elapsed() > CLOSING).then_some(())
        })?;
        looks.push(Look::at(&stack, name, requests)?);
        if done == PARTS[0] {
            warm_files = files_begun(&stack.dir().join("recordings"));
        }
        stack.check()?;
    }
    let seconds = began.elapsed().as_secs_f64();
    let polls = unit.answered();
    drop((unit, line));
    let files = files_begun(&stack.dir().join("recordings")).saturating_sub(warm_files);
    tell(bench, &traffic, polls, seconds, files, &looks)?;
    stack.down()?;
    Ok(())
}

fn tell(
    bench: &mut Bench,
    traffic: &Traffic,
    polls: u64,
    seconds: f64,
    files: u64,
    looks: &[Look],
) -> anyhow::Result<()> {
    let count = |counter: &AtomicU64| counter.load(Ordering::Relaxed) as f64;
    let line = count(&traffic.line);
    ensure!(polls > 0, "the master did not poll");
    bench.info("took", seconds, "s");
    bench.info("requests on the line", line, "");
    bench.info("of what 9600 baud carries in 24 h", line / (REQUESTS_PER_S * DAY_S) * 100.0, "%");
    bench.info("requests on TCP", count(&traffic.tcp), "");
    bench.info("connections opened and closed", count(&traffic.connections), "");
    bench.info("polls of the master", polls as f64, "");
    bench.info("files of the recorder since warm", files as f64, "");
    let [start, warm, .., end] = looks else { bail!("memory was not looked at") };
    let millions = (end.requests - warm.requests) as f64 / 1e6;
    for (i, (name, pid, last)) in end.processes.iter().enumerate() {
        let at = |look: &Look| look.processes.get(i).filter(|p| p.1 == *pid).map(|p| p.2);
        let same = at(start).and(at(warm));
        let before = same.with_context(|| format!("{name} was restarted meanwhile"))?;
        let growth = (last.private as f64 - before.private as f64) / MIB;
        bench.goal(format!("{name}: own memory grown since warm"), growth, "MiB", Goal::Below(FLAT_MIB));
        let gained = last.descriptors as f64 - before.descriptors as f64;
        bench.goal(format!("{name}: descriptors gained since warm"), gained, "", Goal::AtMost(GAINED));
        let list = |what: &dyn Fn(&Held) -> String| {
            let all: Vec<String> = looks.iter().filter_map(at).map(|held| what(&held)).collect();
            all.join(", ")
        };
        bench.note(format!(
            "{name}: {:+.2} MiB per million requests; own {} MiB, with shared pages {} MiB, descriptors {}, threads {}",
            growth / millions.max(f64::MIN_POSITIVE),
            list(&|held| format!("{:.2}", held.private as f64 / MIB)),
            list(&|held| format!("{:.2}", held.rss as f64 / MIB)),
            list(&|held| held.descriptors.to_string()),
            list(&|held| held.threads.to_string()),
        ));
    }
    let shared = (end.shared as f64 - warm.shared as f64) / MIB;
    bench.goal("/dev/shm grown since warm", shared, "MiB", Goal::Below(FLAT_MIB));
    let all: Vec<String> = looks.iter().map(|l| format!("{:.2} {}", l.shared as f64 / MIB, l.name)).collect();
    bench.note(format!("MiB of /dev/shm: {}; the other lists are in the same order", all.join(", ")));
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_process_is_read() {
        let status =
            "Name:\tx\nVmRSS:\t    2048 kB\nRssAnon:\t     1024 kB\nRssShmem:\t 512 kB\nThreads:\t3\n";
        let held = Held { rss: 2 << 20, private: 1 << 20, descriptors: 7, threads: 3 };
        assert_eq!(Held::read(status, 7), Some(held));
        assert_eq!(Held::read("Name:\tx\n", 7), None);
        let own = Held::of(std::process::id()).unwrap();
        assert!(own.rss > own.private && own.descriptors >= 3 && own.threads >= 1, "{own:?}");
        assert_eq!(Held::of(u32::MAX), None);
    }

    #[test]
    fn the_newest_recording_tells_how_many_there_were() {
        let dir = std::env::temp_dir().join(format!("dinrail-soak-{}", std::process::id()));
        assert_eq!(files_begun(&dir), 0);
        std::fs::create_dir_all(&dir).unwrap();
        for name in ["s-20260101T000000.000-9.mcap", "s-20260102T000000.000-10.mcap", "x-y-99.txt", "s.mcap"]
        {
            std::fs::write(dir.join(name), "").unwrap();
        }
        assert_eq!(files_begun(&dir), 10);
        std::fs::remove_dir_all(&dir).unwrap();
    }

    #[test]
    fn parts_are_a_whole_and_the_day_is_that_of_the_line() {
        assert_eq!(PARTS.iter().sum::<u64>(), 100);
        assert_eq!((REQUESTS_PER_S * DAY_S) as u64, 1_883_520);
    }

    #[test]
    fn growth_and_leaks_are_told() {
        let look = |name, requests, rss, descriptors| Look {
            name,
            requests,
            processes: vec![(
                "one".to_owned(),
                5,
                Held { rss: 2 * rss, private: rss, descriptors, threads: 1 },
            )],
            shared: 4 << 20,
        };
        let looks = [
            look("at the start", 0, 8 << 20, 20),
            look("warm", 200_000, 9 << 20, 20),
            look("in the middle", 1_200_000, 10 << 20, 21),
            look("at the end", 2_200_000, 11 << 20, 22),
        ];
        let mut bench = Bench {
            what: super::super::What::Soak,
            seconds: None,
            dir: std::path::PathBuf::new(),
            figures: Vec::new(),
            notes: Vec::new(),
        };
        tell(&mut bench, &Traffic::default(), 9, 1.0, 7, &looks).unwrap();
        let missed: Vec<_> = bench.figures.iter().filter(|f| f.met == Some(false)).collect();
        let shown: Vec<_> = missed.iter().map(|f| (f.name.as_str(), f.value)).collect();
        assert_eq!(
            shown,
            [("one: own memory grown since warm", 2.0), ("one: descriptors gained since warm", 2.0)]
        );
        assert!(bench.notes[0].contains("one: +1.00 MiB per million requests"), "{:?}", bench.notes);
        assert!(bench.notes[0].contains("descriptors 20, 20, 21, 22"), "{:?}", bench.notes);
        let mut looks = looks;
        looks[3].processes[0].1 = 6;
        let error = tell(&mut bench, &Traffic::default(), 9, 1.0, 7, &looks).unwrap_err();
        assert_eq!(error.to_string(), "one was restarted meanwhile");
    }
}
