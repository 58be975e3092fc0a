//! Serial lines across processes: the driver of a stack, a pyserial peer, ports that are taken, that go and come back,
//! and a recorded line that answers as a virtual slave.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod support;

use serde_json::Value;
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use support::{Scratch, Stack, dinrail, python, wait_for};

const REQUEST: &str = "010300000002C40B";

fn peer(
    python: &Path,
    port: &Path,
    settings: &str,
    expected: &str,
    answer: &str,
) -> (Child, BufReader<std::process::ChildStdout>) {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/peers/serial_peer.py");
    let mut child = Command::new(python)
        .arg(script)
        .arg(port)
        .args([settings, expected, answer])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut out = BufReader::new(child.stdout.take().unwrap());
    let mut line = String::new();
    out.read_line(&mut line).unwrap();
    assert_eq!(line.trim(), "open");
    (child, out)
}

fn lines(text: &str) -> Vec<Value> {
    text.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

/// `com1`, a pseudo-terminal of the driver's own, and a recorder.
fn stack(settings: &str) -> String {
    format!(
        r#"
[stack]
name = "NAME"

[[service]]
name = "com1"
kind = "serial"
device = "pty:line"
{settings}

[[service]]
name = "rec"
kind = "recorder"
dir = "recordings"
"#
    )
}

fn answer() -> String {
    let data = [1u8, 3, 4, 0, 1, 0, 2];
    let crc = dinrail_serial::protocol::crc::crc16(&data).to_le_bytes();
    data.iter().chain(&crc).map(|b| format!("{b:02X}")).collect()
}

#[test]
fn a_pyserial_peer_both_ways_and_its_recording_as_a_virtual_slave() {
    let Some(python) = python::python() else { return };
    let mut stack = Stack::up("serial", &stack("preset = \"device-L\""), &[]);
    let port = stack.scratch.0.join("line");
    let (mut peer_process, mut out) = peer(&python, &port, "9600-8E1", REQUEST, &answer());
    let sent = stack.ok(&["serial", "send", "com1", "0103 0000 0002", "--crc", "--json"]);
    let frames = lines(&sent);
    assert_eq!((&frames[0]["hex"], &frames[0]["sent"]), (&REQUEST.into(), &true.into()), "{sent}");
    assert_eq!((&frames[1]["hex"], &frames[1]["sent"]), (&answer().into(), &false.into()), "{sent}");
    let mut got = String::new();
    out.read_line(&mut got).unwrap();
    assert_eq!(got.trim().to_uppercase(), REQUEST);
    drop(peer_process.stdin.take());
    peer_process.wait().unwrap();
    let unknown = stack.cli(&["serial", "send", "com9", "00"]);
    let said = String::from_utf8_lossy(&unknown.stderr).into_owned();
    assert!(said.contains("has no serial port 'com9'; it has com1"), "{said}");
    assert_eq!(stack.take_down(), 0);

    // The recording answers in the peer's place.
    let recording = stack.recordings().pop().unwrap();
    let link = stack.scratch.0.join("slave");
    let mut slave = dinrail()
        .args(["replay", "--as-slave", "--for", "60s", "--json", "--device"])
        .arg(format!("pty:{}", link.display()))
        .arg(&recording)
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut said = BufReader::new(slave.stdout.take().unwrap());
    let mut first = String::new();
    said.read_line(&mut first).unwrap();
    let about: Value = serde_json::from_str(&first).unwrap();
    assert_eq!((&about["line"], &about["requests"]), (&"9600 8E1".into(), &1.into()), "{first}");
    let ask = format!("ask:{REQUEST}");
    let (mut master, mut out) = peer(&python, &link, "9600-8E1", &answer(), &ask);
    let mut got = String::new();
    out.read_line(&mut got).unwrap();
    assert_eq!(got.trim().to_uppercase(), answer());
    assert!(master.wait().unwrap().success());
    let pid = rustix::process::Pid::from_child(&slave);
    rustix::process::kill_process(pid, rustix::process::Signal::TERM).unwrap();
    let mut last = String::new();
    said.read_line(&mut last).unwrap();
    assert_eq!(serde_json::from_str::<Value>(&last).unwrap()["answered"], 1, "{last}");
    assert!(slave.wait().unwrap().success());
}

#[test]
fn seven_bits_on_a_terminal_a_port_that_is_taken_and_dump() {
    // 7E1 on a pseudo-terminal, which always has 8N: accepted.
    let first = Stack::up("serial7", &stack("framing = \"ascii\""), &[]);
    let port = first.scratch.0.join("line");
    let text = stack("framing = \"ascii\"").replace("pty:line", port.to_str().unwrap());
    let second = Stack::up("serialuser", &text, &[]);
    // A third one finds the port taken, says by whom, and works when it is free.
    let third = Stack::spawn("serialtaken", &text, &[]);
    let pid = second.pid("com1");
    third.wait("the sentence that the port is in use", || {
        let log = third.log();
        log.contains(&format!("is in use by dr:com1 (pid {pid})")).then_some(())
    });
    drop(third);

    let dump = dinrail()
        .args(["serial", "dump", "com1", "--count", "1", "--json", "--for", "30s", "--stack", &first.name])
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    // Until the observer has joined, frames go by unseen.
    wait_for("a dumped frame", support::PATIENCE, || {
        second.ok(&["serial", "send", "com1", "--text", ":010300000002FA\\r\\n", "--wait", "10ms"]);
        let done = format!("/proc/{}/stat", dump.id());
        let text = std::fs::read_to_string(done).unwrap_or_default();
        (text.is_empty() || text.contains(") Z ")).then_some(())
    });
    let output = dump.wait_with_output().unwrap();
    let frame = &lines(&String::from_utf8(output.stdout).unwrap())[0];
    assert_eq!(frame["hex"], "3A30313033303030303030303246410D0A");
    assert_eq!((&frame["end"], &frame["sent"]), (&true.into(), &false.into()));
}

#[test]
fn check_names_what_cannot_work() {
    let scratch = Scratch::new("serialcheck");
    let text = r#"
[stack]
name = "x"

[[service]]
name = "com1"
kind = "serial"
device = "pty:a"
data_bits = 7

[[service]]
name = "com2"
kind = "serial"
device = "pty:a"
parity = "none"
"#;
    let file = scratch.write("stack.toml", text);
    let output = dinrail().arg("check").arg(&file).output().unwrap();
    let said = [output.stdout, output.stderr].concat();
    let said = String::from_utf8_lossy(&said);
    assert!(!output.status.success());
    for sentence in [
        "framing \"rtu\" needs 8 data bits, not 7",
        "V1.02",
        "'pty:a' is the port of service 'com1' too",
        "asks for 2 stop bits",
    ] {
        assert!(said.contains(sentence), "{sentence}\n{said}");
    }
    let output = dinrail().args(["serial", "list", "--json"]).output().unwrap();
    assert!(output.status.success());
    assert!(serde_json::from_slice::<Value>(&output.stdout).unwrap().is_array());
}
