//! The Modbus master and the transparent gateway between processes: foreign servers on TCP and on pseudo-terminals,
//! servers that die and come back, servers that answer nonsense or late.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::cast_possible_truncation)]

mod support;

use serde_json::Value;
use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::path::Path;
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::Duration;
use support::modbus::{Answer, Client};
use support::peers::{Peer, peer, program};
use support::{PATIENCE, Scratch, Stack, c_peer, dinrail, free_port, wait_for};

/// A foreign server that listens; killed when dropped.
fn listening(command: Command) -> Peer {
    let mut server = Peer::start(command);
    server.says("ready");
    server
}

/// pymodbus.
fn pymodbus(args: &[&str]) -> Option<Peer> {
    let mut command = peer("modbus_serve.py")?;
    command.args(args);
    Some(listening(command))
}

/// libmodbus.
fn libmodbus(program: &Path, args: &[&str]) -> Peer {
    let mut command = Command::new(program);
    command.args(args);
    listening(command)
}

/// Value of a variable of the plc, once it is the expected one.
fn becomes(stack: &Stack, variable: &str, expected: &str) {
    let mut last = String::new();
    let end = std::time::Instant::now() + PATIENCE;
    while std::time::Instant::now() < end {
        let output = stack.cli(&["plc", "read", variable]);
        last = String::from_utf8_lossy(&output.stdout).trim().to_owned();
        if last == format!("{variable} = {expected}") {
            return;
        }
        std::thread::sleep(Duration::from_millis(20));
    }
    panic!("{variable} is '{last}', not {expected}\n{}", stack.log());
}

const CLIENT: &str = r#"
[stack]
name = "NAME"

[[service]]
name = "plc"
kind = "plc"
cycle = "10ms"

[[service]]
name = "master"
kind = "modbus-client"
LINE
response_timeout = "1s"
probe_min = "100ms"
probe_max = "300ms"
retries = 1

[[service.read]]
unit = 5
table = "holding"
at = 0
count = 4
to = "%IW0"
period = "50ms"
status_to = "%IB100"

[[service.read]]
unit = 5
table = "coils"
at = 0
count = 8
to = "%IB8"
period = "50ms"

[[service.write]]
unit = 5
table = "holding"
at = 100
from = "%QW0"
"#;

/// Reads, writes, jobs and the command line against a server that has units 1 and 5.
fn exercise(stack: &Stack) {
    becomes(stack, "%IW0", "500");
    becomes(stack, "%IW3", "503");
    becomes(stack, "%IB8", "170");
    becomes(stack, "%IB100", "0");
    stack.ok(&["plc", "write", "%QW0=4711"]);
    let read = |what: &[&str]| stack.ok(&[&["modbus", "read", "master", "--unit", "5"], what].concat());
    wait_for("the written value", PATIENCE, || read(&["40101"]).contains("4711").then_some(()));
    let table = read(&["Answer=30043", "Two=40002x2", "00002"]);
    assert!(table.contains("Answer  30043") && table.contains("42"), "{table}");
    assert!(table.contains("40003") && table.contains("502") && table.contains("on"), "{table}");
    stack.ok(&["modbus", "write", "master", "--unit", "5", "40120:float=1.5", "00011=on"]);
    assert!(read(&["40120:float"]).contains("1.5"));
    // What the unit refuses is said in words.
    let refused = stack.cli(&["modbus", "read", "master", "--unit", "5", "49000"]);
    let text = String::from_utf8_lossy(&refused.stderr).into_owned();
    assert!(!refused.status.success() && text.contains("exception 02"), "{text}");
}

#[test]
fn a_tcp_server_is_polled_dies_and_comes_back() {
    let port = free_port().to_string();
    let Some(server) = pymodbus(&["tcp", &port, "1", "5"]) else { return };
    let toml = CLIENT.replace("LINE", &format!("tcp = \"127.0.0.1:{port}\""));
    let stack = Stack::up("mbclient", &toml, &[]);
    exercise(&stack);
    // Gone: the values are held and marked. Back: polled again, and what was written is written again.
    drop(server);
    becomes(&stack, "%IB100", "1");
    becomes(&stack, "%IW0", "500");
    let _server = pymodbus(&["tcp", &port, "1", "5"]).unwrap();
    becomes(&stack, "%IB100", "0");
    stack.ok(&["plc", "write", "%QW0=4712"]);
    wait_for("the value after the restart", PATIENCE, || {
        stack.ok(&["modbus", "read", "master", "--unit", "5", "40101"]).contains("4712").then_some(())
    });
}

#[test]
fn rtu_and_ascii_on_a_serial_line() {
    for mode in ["rtu", "ascii"] {
        let toml = CLIENT.replace("LINE", &format!("serial = \"com1\"\nmode = \"{mode}\""))
            + &format!(
                "\n[[service]]\nname = \"com1\"\nkind = \"serial\"\ndevice = \"pty:line\"\nframing = \"{mode}\"\n"
            );
        let stack = Stack::up(&format!("mb{mode}"), &toml, &[]);
        let line = stack.scratch.0.join("line");
        wait_for("the pseudo-terminal", PATIENCE, || line.exists().then_some(()));
        let Some(_server) = pymodbus(&[mode, line.to_str().unwrap(), "1", "5"]) else { return };
        exercise(&stack);
    }
}

#[test]
fn libmodbus_serves_our_master_on_tcp_and_on_a_line() {
    let scratch = Scratch::new("libmodbus");
    let Some(program) = c_peer::compiled("libmodbus_unit", &scratch) else { return };
    let port = free_port().to_string();
    let server = libmodbus(&program, &["tcp", &port, "5"]);
    let stack = Stack::up("mblibtcp", &CLIENT.replace("LINE", &format!("tcp = \"127.0.0.1:{port}\"")), &[]);
    exercise(&stack);
    drop((stack, server));
    let toml = CLIENT.replace("LINE", "serial = \"com1\"")
        + "\n[[service]]\nname = \"com1\"\nkind = \"serial\"\ndevice = \"pty:line\"\n";
    let stack = Stack::up("mblibrtu", &toml, &[]);
    let line = stack.scratch.0.join("line");
    wait_for("the pseudo-terminal", PATIENCE, || line.exists().then_some(()));
    let server = libmodbus(&program, &["rtu", line.to_str().unwrap(), "5"]);
    exercise(&stack);
    // Gone and back, as after a power cut.
    drop(server);
    becomes(&stack, "%IB100", "1");
    let _server = libmodbus(&program, &["rtu", line.to_str().unwrap(), "5"]);
    becomes(&stack, "%IB100", "0");
}

const GATEWAY: &str = r#"
[stack]
name = "NAME"

[[service]]
name = "com1"
kind = "serial"
device = "pty:line"
framing = "rtu"

[[service]]
name = "gateway"
kind = "modbus-gateway"
serial = "com1"
tcp = { address = "127.0.0.1", port = PORT, max_connections = 4 }
units = [ { tcp = 101, line = 5 } ]
response_timeout = "1s"
"#;

fn gateway_stack() -> Option<(Stack, Peer, u16)> {
    let port = free_port();
    let stack = Stack::up("mbgateway", &GATEWAY.replace("PORT", &port.to_string()), &[]);
    let line = stack.scratch.0.join("line");
    wait_for("the pseudo-terminal", PATIENCE, || line.exists().then_some(()));
    let server = pymodbus(&["rtu", line.to_str().unwrap(), "1", "5"])?;
    Some((stack, server, port))
}

/// One request to a unit; its answer PDU.
fn ask(stream: &mut TcpStream, transaction: u16, unit: u8, pdu: &[u8]) -> Vec<u8> {
    let mut frame = transaction.to_be_bytes().to_vec();
    frame.extend([0, 0, 0, pdu.len() as u8 + 1, unit]);
    frame.extend(pdu);
    stream.write_all(&frame).unwrap();
    let mut head = [0; 7];
    stream.read_exact(&mut head).unwrap();
    assert_eq!((&head[..2], head[6]), (&transaction.to_be_bytes()[..], unit));
    let mut answer = vec![0; usize::from(head[5]) - 1];
    stream.read_exact(&mut answer).unwrap();
    answer
}

fn connect(port: u16) -> TcpStream {
    let stream = TcpStream::connect(("127.0.0.1", port)).unwrap();
    stream.set_nodelay(true).unwrap();
    stream.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
    stream
}

#[test]
fn masters_share_a_line_through_the_gateway() {
    let Some((stack, _server, port)) = gateway_stack() else { return };
    let mut first = connect(port);
    // The server needs a moment until its port is open.
    wait_for("the unit behind the gateway", PATIENCE, || {
        (ask(&mut first, 1, 5, &[3, 0, 0, 0, 2]) == [3, 4, 0x01, 0xF4, 0x01, 0xF5]).then_some(())
    });
    assert_eq!(ask(&mut first, 2, 101, &[3, 0, 1, 0, 1]), [3, 2, 0x01, 0xF5], "mapped");
    assert_eq!(ask(&mut first, 3, 1, &[3, 0, 1, 0, 1]), [3, 2, 0, 101]);
    assert_eq!(ask(&mut first, 4, 1, &[3, 0x27, 0x10, 0, 1]), [0x83, 2], "the unit's own exception");
    assert_eq!(ask(&mut first, 5, 250, &[3, 0, 0, 0, 1]), [0x83, 0x0A]);
    assert_eq!(ask(&mut first, 6, 77, &[3, 0, 0, 0, 1]), [0x83, 0x0B]);
    assert_eq!(ask(&mut first, 7, 77, &[3, 0, 0, 0, 1]), [0x83, 0x0B], "known to be silent");
    // Several masters at once: everybody gets its own answers.
    std::thread::scope(|scope| {
        for master in 0..4u16 {
            let mut stream = if master == 0 { first.try_clone().unwrap() } else { connect(port) };
            scope.spawn(move || {
                for i in 0..25u16 {
                    let (unit, at) = ([1, 5][usize::from(i % 2)], master * 20 + i % 10);
                    let answer = ask(&mut stream, i, unit, &[3, 0, at as u8, 0, 1]);
                    let value = u16::from(unit) * 100 + at;
                    assert_eq!(answer, [3, 2, (value >> 8) as u8, value as u8]);
                }
            });
        }
    });
    // Foreign masters.
    if let Some(mut mbpoll) = program("mbpoll", "mbpoll") {
        let output = mbpoll
            .args([
                "-m",
                "tcp",
                "-p",
                &port.to_string(),
                "-a",
                "5",
                "-r",
                "1",
                "-c",
                "3",
                "-1",
                "-o",
                "10",
                "127.0.0.1",
            ])
            .output()
            .unwrap();
        let text = String::from_utf8_lossy(&output.stdout).into_owned();
        assert!(output.status.success() && text.contains("502"), "{text}");
    }
    let target = format!("tcp://127.0.0.1:{port}");
    let scan = dinrail()
        .args(["--json", "modbus", "scan", &target, "--from", "1", "--to", "6", "--timeout", "10s"])
        .output()
        .unwrap();
    let found: Value = serde_json::from_slice(&scan.stdout).unwrap();
    let units: Vec<u64> =
        found["found"].as_array().unwrap().iter().map(|f| f["unit"].as_u64().unwrap()).collect();
    assert_eq!(units, [1, 5]);
    drop(stack);
}

/// A Modbus TCP server of a few lines that misbehaves as told: for each request a script entry, from the beginning again
/// and again, until it is to calm down. Counts how often it was at the end.
struct Rogue {
    port: u16,
    calm: Arc<AtomicBool>,
    rounds: Arc<AtomicUsize>,
}

fn rogue(script: &'static [&'static str]) -> Rogue {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = listener.local_addr().unwrap().port();
    let (calm, rounds) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicUsize::new(0)));
    let rogue = Rogue { port, calm: Arc::clone(&calm), rounds: Arc::clone(&rounds) };
    std::thread::spawn(move || {
        let mut steps = 0;
        let mut next = || {
            if calm.load(Ordering::Relaxed) {
                return "right";
            }
            let step = script[steps % script.len()];
            steps += 1;
            rounds.store(steps / script.len(), Ordering::Relaxed);
            step
        };
        for stream in listener.incoming() {
            let Ok(mut stream) = stream else { return };
            let mut head = [0; 12];
            while stream.read_exact(&mut head).is_ok() {
                let answer = |transaction: [u8; 2], pdu: &[u8]| {
                    let mut frame = transaction.to_vec();
                    frame.extend([0, 0, 0, pdu.len() as u8 + 1, head[6]]);
                    frame.extend(pdu);
                    frame
                };
                let (own, right) = ([head[0], head[1]], [3, 2, 0, 9]);
                let sent = match next() {
                    "right" => stream.write_all(&answer(own, &right)),
                    "other transaction" => {
                        stream.write_all(&answer([head[0], head[1] ^ 0x55], &[3, 2, 6, 6]))
                    }
                    "other function" => stream.write_all(&answer(own, &[4, 2, 6, 6])),
                    "wrong count" => stream.write_all(&answer(own, &[3, 4, 6, 6, 6, 6])),
                    "noise" => stream.write_all(&[0xFF; 40]),
                    "half" => stream.write_all(&answer(own, &right)[..8]),
                    "late" => {
                        std::thread::sleep(Duration::from_millis(700));
                        stream.write_all(&answer(own, &[3, 2, 6, 6]))
                    }
                    "close" => break,
                    other => panic!("{other}"),
                };
                if sent.is_err() {
                    break;
                }
            }
        }
    });
    rogue
}

#[test]
fn a_server_that_answers_nonsense_or_late_never_gives_a_wrong_value() {
    let rogue = rogue(&[
        "right",
        "other transaction",
        "right",
        "other function",
        "wrong count",
        "right",
        "noise",
        "late",
        "half",
        "close",
        "right",
        "late",
        "other transaction",
    ]);
    let port = rogue.port;
    let toml = format!(
        "[stack]\nname = \"NAME\"\n[[service]]\nname = \"plc\"\nkind = \"plc\"\ncycle = \"10ms\"\n\
         [[service]]\nname = \"master\"\nkind = \"modbus-client\"\ntcp = \"127.0.0.1:{port}\"\n\
         response_timeout = \"300ms\"\nprobe_min = \"50ms\"\nprobe_max = \"100ms\"\nretries = 0\n\
         [[service.read]]\nunit = 1\ntable = \"holding\"\nat = 0\nto = \"%IW0\"\nperiod = \"20ms\"\nstatus_to = \"%IB100\"\n"
    );
    let stack = Stack::up("mbrogue", &toml, &[]);
    // 1542 (0606h) is what every wrong answer carries.
    let read = || {
        let text = stack.ok(&["plc", "read", "%IW0", "%IB100"]);
        assert!(!text.contains("1542"), "{text}");
        text
    };
    let mut was_bad = false;
    stack.wait("the script twice, and bad answers seen", || {
        was_bad |= read().contains("%IB100 = 1");
        (was_bad && rogue.rounds.load(Ordering::Relaxed) >= 2).then_some(())
    });
    rogue.calm.store(true, Ordering::Relaxed);
    stack.wait("good answers", || {
        let text = read();
        (text.contains("%IW0 = 9") && text.contains("%IB100 = 0")).then_some(())
    });
}

#[test]
fn a_dead_unit_among_ten_does_not_stop_the_others() {
    let toml = CLIENT
        .replace("LINE", "serial = \"com1\"")
        .replace("period = \"50ms\"", "period = \"0s\"")
        .replace("response_timeout = \"1s\"", "response_timeout = \"300ms\"")
        + "\n[[service.read]]\nunit = 9\ntable = \"holding\"\nat = 0\nto = \"%IW60\"\nperiod = \"0s\"\nstatus_to = \"%IB122\"\n"
        + "\n[[service]]\nname = \"com1\"\nkind = \"serial\"\ndevice = \"pty:line\"\n";
    let stack = Stack::up("mbdead", &toml, &[]);
    let line = stack.scratch.0.join("line");
    wait_for("the pseudo-terminal", PATIENCE, || line.exists().then_some(()));
    let Some(_server) = pymodbus(&["rtu", line.to_str().unwrap(), "5"]) else { return };
    becomes(&stack, "%IW0", "500");
    becomes(&stack, "%IB122", "2");
    // The live unit stays good while the dead one is tried. When the machine keeps it from answering for two timeouts it
    // is not: then the next 20 looks count.
    let stays_good = || {
        (0..20).all(|_| {
            std::thread::sleep(Duration::from_millis(50));
            stack.ok(&["plc", "read", "%IB100"]).trim() == "%IB100 = 0"
        })
    };
    assert!((0..5).any(|_| stays_good()), "{}", stack.log());
}

#[test]
fn the_command_line_alone_reads_a_device() {
    let port = free_port();
    let Some(_server) = pymodbus(&["tcp", &port.to_string(), "1"]) else { return };
    let target = format!("tcp://127.0.0.1:{port}");
    let run = |args: &[&str]| {
        let patient = if args.contains(&"--timeout") { &[][..] } else { &["--timeout", "10s"] };
        let output = dinrail().arg("modbus").args(args).args(patient).output().unwrap();
        let text =
            String::from_utf8_lossy(&output.stdout).into_owned() + &String::from_utf8_lossy(&output.stderr);
        (output.status.success(), text)
    };
    let (ok, text) = run(&["read", &target, "40001x3", "30011:int16", "Coil=00002"]);
    assert!(ok && text.contains("102") && text.contains("10") && text.contains("on"), "{text}");
    let (ok, text) = run(&["write", &target, "40010:float:CDAB=-2.25"]);
    assert!(ok && text.contains("40010: 1 value written"), "{text}");
    let (ok, text) = run(&["read", &target, "40010:float:CDAB", "--every", "10ms", "--rounds", "2"]);
    assert!(ok && text.matches("-2.25").count() == 2, "{text}");
    let (ok, text) = run(&["identify", &target]);
    assert!(ok && text.contains("server id (17)"), "{text}");
    let (ok, text) = run(&["read", "tcp://127.0.0.1:1", "0", "--timeout", "300ms"]);
    assert!(!ok && text.contains("Connection refused"), "{text}");
    // A client of a few lines sees the same.
    let answer = Client::connect(port).unwrap().holding(0, 2).unwrap();
    assert_eq!(answer, Answer::Registers(vec![100, 101]));
}
