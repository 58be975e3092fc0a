//! Any process may die at any time and its neighbours go on: one named test per way to die and per process.
//!
//! Every test runs a stack of five services under load, lets one die in one way, and then looks at all others:
//! same process as before, work not interrupted, outputs as documented, the dead one back, the fault in the
//! recording, nothing left in shared memory.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod support;

use rustix::process::Signal;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::{self, JoinHandle, sleep};
use std::time::{Duration, Instant};
use support::modbus::{Answer, Client};
use support::socketcand::Load;
use support::{Scratch, Stack, dinrail, free_port};

const SERVICES: [&str; 5] = ["rec", "can0", "io", "plc", "modbus"];

fn text(modbus_port: u16, can_port: u16, more: &str) -> String {
    format!(
        r#"
[stack]
name = "NAME"

[[service]]
name = "rec"
kind = "recorder"
dir = "recordings"
{more}

[[service]]
name = "can0"
kind = "can"
backend = "virtual"
feed = {{ file = "conveyor.log", loop = true }}
serve = {{ socketcand = "127.0.0.1:{can_port}" }}
{more}

[[service]]
name = "io"
kind = "can-io"
bus = "can0"
{more}

[[service.in]]
id = 0x1A0
start = 24
len = 8
to = "%IW0"
type = "UINT"
symbol = "Alive"
timeout = "500ms"

[[service.out]]
id = 0x210
dlc = 2
mode = "cyclic"
period = "50ms"
signals = [{{ start = 0, len = 16, from = "%QW0", type = "UINT", symbol = "Out" }}]

[[service]]
name = "plc"
kind = "plc"
program = ["main.st"]
cycle = "10ms"
{more}

[[service]]
name = "modbus"
kind = "modbus-server"
tcp = {{ address = "127.0.0.1", port = {modbus_port} }}
# A machine with much to do may keep a living plc from its turn for the 0.2 s that are the default.
stale_after = "1s"
{more}
"#
    )
}

const PROGRAM: &str = r"
PROGRAM main
VAR
  Setpoint AT %MW0 : UINT;
  Seen AT %MW1 : UINT;
  Scans AT %MW2 : UINT;
  Kept AT %MW3 : UINT;
END_VAR
VAR RETAIN Total : UINT; END_VAR
  Scans := Scans + 1;
  Seen := Alive;
  Out := Setpoint;
  Total := Total + 1;
  Kept := Total;
END_PROGRAM
";

/// Asks the Modbus server all the time, reconnecting, and counts what it saw.
struct Watch {
    stop: Arc<AtomicBool>,
    refused: Arc<AtomicU64>,
    answered: Arc<AtomicU64>,
    exceptions: Arc<AtomicU64>,
    thread: Option<JoinHandle<()>>,
}

impl Watch {
    fn start(port: u16) -> Self {
        let stop = Arc::new(AtomicBool::new(false));
        let (refused, answered, exceptions) = (Arc::default(), Arc::default(), Arc::default());
        let watch = Self { stop: stop.clone(), refused, answered, exceptions, thread: None };
        let (refused, answered, exceptions) =
            (watch.refused.clone(), watch.answered.clone(), watch.exceptions.clone());
        let thread = thread::spawn(move || {
            while !stop.load(Ordering::Relaxed) {
                let mut client = match Client::connect(port) {
                    Ok(client) => client,
                    Err(e) => {
                        if e.kind() == std::io::ErrorKind::ConnectionRefused {
                            refused.fetch_add(1, Ordering::Relaxed);
                        }
                        sleep(Duration::from_millis(5));
                        continue;
                    }
                };
                while !stop.load(Ordering::Relaxed) {
                    match client.holding(0, 4) {
                        Ok(Answer::Exception(4)) => exceptions.fetch_add(1, Ordering::Relaxed),
                        Ok(Answer::Registers(_)) => answered.fetch_add(1, Ordering::Relaxed),
                        Ok(other) => panic!("unexpected answer {other:?}"),
                        Err(_) => break,
                    };
                    sleep(Duration::from_millis(5));
                }
            }
        });
        Self { thread: Some(thread), ..watch }
    }

    fn end(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.take().unwrap().join().unwrap();
    }
}

fn register(port: u16, address: u16) -> Option<u16> {
    match Client::connect(port).ok()?.holding(address, 1).ok()? {
        Answer::Registers(values) => values.first().copied(),
        _ => None,
    }
}

fn changes(stack: &Stack, what: &str, port: u16, address: u16) {
    let first = stack.wait(what, || register(port, address));
    stack.wait(what, || register(port, address).filter(|v| *v != first));
}

/// The whole stack does its work: frames reach a register, scans go on, a setpoint reaches the bus.
fn works(stack: &Stack, port: u16) {
    changes(stack, "frames reach a register", port, 1);
    changes(stack, "scans go on", port, 2);
    let value = register(port, 0).unwrap_or(0).wrapping_add(0x0101) | 1;
    stack.wait("a setpoint is accepted", || {
        matches!(Client::connect(port).ok()?.write(0, value).ok()?, Answer::Written).then_some(())
    });
    let wanted = format!("210#{:02X}{:02X}", value & 0xFF, value >> 8);
    stack.wait("the setpoint is on the bus", || {
        let dump = stack.cli(&["can", "dump", "can0", "--count", "60", "--for", "2s"]);
        compact(&String::from_utf8_lossy(&dump.stdout)).contains(&wanted).then_some(())
    });
}

/// The frames of `can dump` as `ID#DATA`, one a line.
fn compact(dump: &str) -> String {
    dump.lines().filter_map(|line| line.split_whitespace().nth(2)).collect::<Vec<_>>().join("\n")
}

fn generations(stack: &Stack) -> BTreeMap<String, u64> {
    stack
        .ps()
        .iter()
        .map(|r| (r["service"].as_str().unwrap().to_owned(), r["generation"].as_u64().unwrap()))
        .collect()
}

/// How a process dies.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Way {
    Panic,
    Abort,
    KillIdle,
    KillUnderLoad,
    Stop,
    ExitZero,
    Descriptors,
}

fn inject(stack: &Stack, victim: &str, what: &str) {
    // Handlers of injected faults sit on real-time signals, only with DINRAIL_INJECT=1 in the environment.
    let number = match what {
        "panic" => 1,
        "exit0" => 2,
        _ => 3,
    };
    let status = std::process::Command::new("kill")
        .args([format!("-{}", libc_rtmin() + number), stack.pid(victim).to_string()])
        .status()
        .unwrap();
    assert!(status.success());
}

fn libc_rtmin() -> i32 {
    34
}

fn case(victim: &str, way: Way) {
    let (port, can_port) = (free_port(), free_port());
    let scratch = Scratch::new(&format!("{victim}-{way:?}").to_lowercase());
    scratch.write("main.st", PROGRAM);
    scratch.write("conveyor.log", include_str!("../recordings/conveyor.log"));
    let mut stack = Stack::spawn_in(&format!("f{victim}"), &text(port, can_port, ""), scratch, &[]);
    stack.wait_ready();
    works(&stack, port);
    let before = generations(&stack);
    let mut watch = Watch::start(port);

    match way {
        Way::Panic => inject(&stack, victim, "panic"),
        Way::Abort => stack.kill(victim, Signal::ABORT),
        Way::KillIdle => stack.kill(victim, Signal::KILL),
        Way::KillUnderLoad => {
            let load = Load::start(can_port, 0);
            sleep(Duration::from_millis(300));
            stack.kill(victim, Signal::KILL);
            sleep(Duration::from_millis(300));
            load.end();
        }
        Way::Stop => stack.kill(victim, Signal::STOP),
        Way::ExitZero => inject(&stack, victim, "exit0"),
        Way::Descriptors => inject(&stack, victim, "descriptors"),
    }
    if way == Way::Descriptors {
        // Not a death: the service must live on without a free descriptor and be well when it has some again.
        // A new Modbus connection needs a descriptor, the one that stands goes on.
        let answered = watch.answered.load(Ordering::Relaxed);
        stack.wait("the standing connection is served on", || {
            (watch.answered.load(Ordering::Relaxed) > answered + 50).then_some(())
        });
        stack.ok(&["restart", victim]);
    }
    stack.wait_generation_above(victim, before[victim]);
    works(&stack, port);
    watch.end();

    for (name, generation) in generations(&stack) {
        if name != victim {
            assert_eq!(
                generation,
                before[&name],
                "{name} must not be touched by the death of {victim}\n{}",
                stack.log()
            );
        }
    }
    // The launcher holds the listener: whoever connects while the server restarts waits, but is not refused.
    assert_eq!(watch.refused.load(Ordering::Relaxed), 0, "connections refused");
    assert!(watch.answered.load(Ordering::Relaxed) > 0);
    if matches!(victim, "rec" | "can0" | "io") {
        assert_eq!(watch.exceptions.load(Ordering::Relaxed), 0, "{victim} is no reason for exception 04");
    }
    assert_eq!(stack.take_down(), 0, "{}", stack.log());
    let events = events(&stack);
    // A restart by command is no fault, and what happens while the recorder is away it cannot see.
    assert!(
        way == Way::Descriptors
            || events
                .iter()
                .any(|e| e["service"] == victim && (e["event"] == "died" || e["event"] == "restarting")),
        "the fault is in the recording: {events:#?}"
    );
}

/// Events of all recordings of a stack.
fn events(stack: &Stack) -> Vec<serde_json::Value> {
    let mut all = Vec::new();
    for recording in stack.recordings() {
        let output = dinrail()
            .args(["recordings", "cat", "--topic", "stack/events", "--json"])
            .arg(&recording)
            .output()
            .unwrap();
        for line in String::from_utf8_lossy(&output.stdout).lines() {
            let value: serde_json::Value = serde_json::from_str(line).unwrap();
            let body = value.get("body").cloned().unwrap_or(value);
            all.push(body);
        }
    }
    all
}

macro_rules! ways {
    ($($victim:ident: $($name:ident = $way:ident),*;)*) => {$(
        mod $victim {
            $(#[test] fn $name() { super::case(stringify!($victim), super::Way::$way) })*
        }
    )*};
}

ways! {
    rec: panics = Panic, aborts = Abort, is_killed_idle = KillIdle, is_killed_under_load = KillUnderLoad,
         hangs = Stop, exits_with_zero = ExitZero, runs_out_of_descriptors = Descriptors;
    can0: panics = Panic, aborts = Abort, is_killed_idle = KillIdle, is_killed_under_load = KillUnderLoad,
         hangs = Stop, exits_with_zero = ExitZero, runs_out_of_descriptors = Descriptors;
    io: panics = Panic, aborts = Abort, is_killed_idle = KillIdle, is_killed_under_load = KillUnderLoad,
         hangs = Stop, exits_with_zero = ExitZero, runs_out_of_descriptors = Descriptors;
    plc: panics = Panic, aborts = Abort, is_killed_idle = KillIdle, is_killed_under_load = KillUnderLoad,
         hangs = Stop, exits_with_zero = ExitZero, runs_out_of_descriptors = Descriptors;
    modbus: panics = Panic, aborts = Abort, is_killed_idle = KillIdle, is_killed_under_load = KillUnderLoad,
         hangs = Stop, exits_with_zero = ExitZero, runs_out_of_descriptors = Descriptors;
}

/// 60 kills a service make 300.
#[test]
fn three_hundred_kills_at_random_moments_of_start_up_brick_nothing() {
    let (port, can_port) = (free_port(), free_port());
    let scratch = Scratch::new("startup");
    scratch.write("main.st", PROGRAM);
    scratch.write("conveyor.log", include_str!("../recordings/conveyor.log"));
    let more = "restart = { max = 1000, within = \"10s\", backoff_first = \"1ms\", backoff_max = \"2ms\" }";
    let mut stack = Stack::spawn_in("startup", &text(port, can_port, more), scratch, &[]);
    stack.wait_ready();
    let mut random = 0x9E37_79B9_7F4A_7C15_u64;
    let mut kills = 0;
    let start = Instant::now();
    while kills < 300 {
        assert!(start.elapsed() < Duration::from_mins(4), "{kills} kills only\n{}", stack.log());
        let victim = SERVICES[kills % SERVICES.len()];
        let Some(pid) = stack.service(victim).and_then(|row| row["pid"].as_i64()) else { continue };
        let Some(pid) = rustix::process::Pid::from_raw(pid as i32) else { continue };
        if rustix::process::kill_process(pid, Signal::KILL).is_err() {
            continue;
        }
        kills += 1;
        random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
        sleep(Duration::from_micros((random >> 33) % 20_000));
    }
    stack.wait_ready();
    works(&stack, port);
    assert_eq!(stack.take_down(), 0, "{}", stack.log());
}

#[test]
fn the_launcher_is_killed_no_orphan_lives_and_the_next_up_runs() {
    let (port, can_port) = (free_port(), free_port());
    let scratch = Scratch::new("orphans");
    scratch.write("main.st", PROGRAM);
    scratch.write("conveyor.log", include_str!("../recordings/conveyor.log"));
    let mut stack = Stack::spawn_in("orphans", &text(port, can_port, ""), scratch, &[]);
    stack.wait_ready();
    let pids: Vec<i32> = SERVICES.iter().map(|s| stack.pid(s)).collect();
    stack.launcher.kill().unwrap();
    stack.launcher.wait().unwrap();
    // A dead one that nobody waited for is no orphan that lives: in a container often nobody does.
    let lives = |pid: &i32| {
        let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).unwrap_or_default();
        stat.rsplit_once(") ").is_some_and(|(_, rest)| !rest.starts_with(['Z', 'X']))
    };
    support::wait_for("no orphan lives", Duration::from_secs(10), || (!pids.iter().any(lives)).then_some(()));
    let file = stack.scratch.0.join("stack.toml");
    let again = || {
        let mut up = dinrail();
        up.arg("up").arg(&file).stderr(std::process::Stdio::null()).stdout(std::process::Stdio::null());
        up.spawn().unwrap()
    };
    // The same stack again: what the dead launcher left is wiped.
    stack.launcher = again();
    stack.wait_ready();
    works(&stack, port);
    stack.launcher.kill().unwrap();
    stack.launcher.wait().unwrap();
    // Who does not want it again clears up.
    let said = stack.ok(&["down"]);
    assert!(said.contains("was not running") && !stack.root().exists(), "{said}");
    stack.launcher = again();
    stack.wait_ready();
    assert_eq!(stack.take_down(), 0);
}

#[test]
fn a_machine_that_stood_still_is_nobodys_hang() {
    let (port, can_port) = (free_port(), free_port());
    let scratch = Scratch::new("frozen");
    scratch.write("main.st", PROGRAM);
    scratch.write("conveyor.log", include_str!("../recordings/conveyor.log"));
    let mut stack = Stack::spawn_in("frozen", &text(port, can_port, ""), scratch, &[]);
    stack.wait_ready();
    works(&stack, port);
    let before = generations(&stack);
    let launcher = rustix::process::Pid::from_child(&stack.launcher);
    let pids: Vec<_> = SERVICES.iter().filter_map(|s| rustix::process::Pid::from_raw(stack.pid(s))).collect();
    let all = |signal| {
        for pid in &pids {
            rustix::process::kill_process(*pid, signal).unwrap();
        }
    };
    // As a frozen control group or a paused virtual machine does: longer than any heartbeat may fail to come.
    all(Signal::STOP);
    rustix::process::kill_process(launcher, Signal::STOP).unwrap();
    sleep(Duration::from_secs(4));
    // The launcher is the first to run again.
    rustix::process::kill_process(launcher, Signal::CONT).unwrap();
    sleep(Duration::from_millis(300));
    all(Signal::CONT);
    works(&stack, port);
    assert_eq!(generations(&stack), before, "{}", stack.log());
    assert_eq!(stack.take_down(), 0);
}

#[test]
fn a_stopped_reader_on_the_command_line_disturbs_nobody() {
    let (port, can_port) = (free_port(), free_port());
    let scratch = Scratch::new("reader");
    scratch.write("main.st", PROGRAM);
    scratch.write("conveyor.log", include_str!("../recordings/conveyor.log"));
    let mut stack = Stack::spawn_in("reader", &text(port, can_port, ""), scratch, &[]);
    stack.wait_ready();
    let before = generations(&stack);
    let mut dump = dinrail()
        .args(["can", "dump", "can0", "--stack", &stack.name])
        .stdout(std::process::Stdio::null())
        .spawn()
        .unwrap();
    sleep(Duration::from_millis(300));
    let pid = rustix::process::Pid::from_child(&dump);
    rustix::process::kill_process(pid, Signal::STOP).unwrap();
    works(&stack, port);
    let _ = dump.kill();
    let _ = dump.wait();
    works(&stack, port);
    assert_eq!(generations(&stack), before);
    assert_eq!(stack.take_down(), 0);
}

#[test]
fn a_killed_plc_makes_outputs_safe_and_modbus_answers_exception_4_until_it_is_back() {
    let (port, can_port) = (free_port(), free_port());
    let scratch = Scratch::new("safe");
    scratch.write("main.st", PROGRAM);
    scratch.write("conveyor.log", include_str!("../recordings/conveyor.log"));
    // The PLC may not come back by itself: what the others do without it can be seen at leisure.
    let held = "restart = { max = 0, within = \"10s\", on_exhausted = \"hold\" }";
    let toml = text(port, can_port, "").replace("cycle = \"10ms\"\n", &format!("cycle = \"10ms\"\n{held}\n"));
    let mut stack = Stack::spawn_in("safe", &toml, scratch, &[]);
    stack.wait_ready();
    works(&stack, port);
    stack.kill("plc", Signal::KILL);
    stack.wait("exception 04", || {
        (Client::connect(port).ok()?.holding(0, 1).ok()? == Answer::Exception(4)).then_some(())
    });
    assert_eq!(Client::connect(port).unwrap().write(0, 5).unwrap(), Answer::Exception(4));
    // Silent: the receiver's own timeout fires. What is in flight may still come out, then nothing.
    stack.wait("210h is no longer sent", || {
        let dump = stack.cli(&["can", "dump", "can0", "--for", "1s"]);
        let text = compact(&String::from_utf8_lossy(&dump.stdout));
        (text.contains("1A0#") && !text.contains("210#")).then_some(())
    });
    stack.ok(&["restart", "plc"]);
    works(&stack, port);
    assert_eq!(stack.take_down(), 0);
    let events = events(&stack);
    for kind in ["died", "held", "safe_entered", "safe_left"] {
        assert!(events.iter().any(|e| e["event"] == kind), "{kind} is missing: {events:#?}");
    }
}

/// Numbers of the launcher's descriptors with what they lead to.
fn descriptors(pid: u32) -> Vec<(u64, String)> {
    let folder = format!("/proc/{pid}/fd");
    let one = |entry: std::fs::DirEntry| {
        let target = std::fs::read_link(entry.path()).ok()?.to_string_lossy().into_owned();
        Some((entry.file_name().to_str()?.parse().ok()?, target))
    };
    std::fs::read_dir(folder).unwrap().flatten().filter_map(one).collect()
}

/// CPU time of a process in seconds.
fn cpu_s(pid: u32) -> f64 {
    let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).unwrap();
    let fields: Vec<&str> = stat.rsplit_once(')').unwrap().1.split_whitespace().collect();
    (fields[11].parse::<f64>().unwrap() + fields[12].parse::<f64>().unwrap()) / 100.0
}

#[test]
fn a_launcher_without_descriptors_turns_clients_away_and_does_not_turn_for_nothing() {
    use rustix::process::{Pid, Resource, Rlimit, prlimit};
    use std::io::Read;
    use std::os::unix::net::UnixStream;
    let (port, can_port) = (free_port(), free_port());
    let scratch = Scratch::new("nofile");
    scratch.write("main.st", PROGRAM);
    scratch.write("conveyor.log", include_str!("../recordings/conveyor.log"));
    let mut stack = Stack::spawn_in("nofile", &text(port, can_port, ""), scratch, &[]);
    stack.wait_ready();
    works(&stack, port);
    let before = generations(&stack);
    let (pid, raw) = (Pid::from_child(&stack.launcher), stack.launcher.id());
    let socket = stack.root().join("control.sock");
    let limit = |soft| {
        let old = rustix::process::getrlimit(Resource::Nofile).maximum;
        prlimit(Some(pid), Resource::Nofile, Rlimit { current: soft, maximum: old }).unwrap().current
    };
    // Nothing above its spare descriptor: clients fill the gaps below, then there is only the spare one.
    let spare = descriptors(raw).iter().filter(|(n, to)| *n > 2 && to == "/dev/null").map(|(n, _)| *n).max();
    let whole = limit(Some(spare.expect("a spare descriptor") + 1));
    let mut clients = Vec::new();
    let said = stack.wait("a client is turned away", || {
        let mut client = UnixStream::connect(&socket).ok()?;
        client.set_read_timeout(Some(Duration::from_millis(300))).unwrap();
        let (mut text, mut chunk) = (Vec::new(), [0u8; 256]);
        if let Ok(n) = client.read(&mut chunk) {
            text.extend_from_slice(&chunk[..n]);
        }
        clients.push(client);
        (!text.is_empty()).then(|| String::from_utf8(text).unwrap())
    });
    assert_eq!(said, "{\"error\":\"the launcher has no file descriptor left (ulimit -n)\"}\n");
    // Not even the spare one: clients wait in the backlog, and the launcher does not turn round them.
    limit(Some(0));
    let waiting: Vec<_> = (0..3).map(|_| UnixStream::connect(&socket).unwrap()).collect();
    let (from, begin) = (cpu_s(raw), Instant::now());
    sleep(Duration::from_secs(2));
    let share = (cpu_s(raw) - from) / begin.elapsed().as_secs_f64();
    assert!(share < 0.3, "the launcher uses {share} of a CPU");
    changes(&stack, "the stack works on", port, 2);
    limit(whole);
    drop((clients, waiting));
    stack.wait_ready();
    assert_eq!(generations(&stack), before, "{}", stack.log());
    // One sentence for both: they are the same trouble.
    let said = ["clients are turned away: ", "no client can be taken: Too many open files"];
    assert!(said.iter().any(|text| stack.log().contains(text)), "{}", stack.log());
    assert_eq!(stack.take_down(), 0);
}

#[test]
fn what_happens_while_the_recorder_is_in_back_off_is_recorded_once_and_told_at_once() {
    let (port, can_port) = (free_port(), free_port());
    let scratch = Scratch::new("backoff");
    scratch.write("main.st", PROGRAM);
    scratch.write("conveyor.log", include_str!("../recordings/conveyor.log"));
    let rule = "restart = { max = 20, within = \"10s\", backoff_first = \"4s\", backoff_max = \"4s\" }";
    let toml = text(port, can_port, "")
        .replace("dir = \"recordings\"\n", &format!("dir = \"recordings\"\n{rule}\n"));
    let mut stack = Stack::spawn_in("backoff", &toml, scratch, &[]);
    stack.wait_ready();
    works(&stack, port);
    stack.kill("rec", Signal::KILL);
    stack.wait_generation_above("rec", 1);
    // What a killed recorder had not written yet is lost.
    stack.wait("its first death in the recording", || {
        events(&stack).iter().any(|e| e["service"] == "rec" && e["event"] == "died").then_some(())
    });
    stack.kill("rec", Signal::KILL);
    stack
        .wait("the recorder is in back-off", || (stack.service("rec")?["state"] == "back-off").then_some(()));
    let generation = stack.generation("io");
    stack.kill("io", Signal::KILL);
    stack.wait_generation_above("io", generation);
    assert_eq!(stack.service("rec").unwrap()["state"], "back-off", "the others do not wait for it");
    stack.wait_generation_above("rec", 2);
    works(&stack, port);
    assert_eq!(stack.take_down(), 0, "{}", stack.log());
    let events = events(&stack);
    let count = |service: &str, kind: &str, generation: u64| {
        let is = |e: &&serde_json::Value| {
            e["service"] == service && e["event"] == kind && e["detail"]["generation"] == generation
        };
        events.iter().filter(is).count()
    };
    for (service, kind, generation) in [
        ("rec", "started", 1),
        ("rec", "died", 1),
        ("rec", "died", 2),
        ("rec", "started", 3),
        ("io", "started", 1),
        ("io", "died", 1),
        ("io", "started", 2),
        ("io", "ready", 2),
    ] {
        assert_eq!(count(service, kind, generation), 1, "{service} {kind} {generation}: {events:#?}");
    }
}
