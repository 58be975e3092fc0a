//! CANopen networks of simulated nodes, and what their users are shown.

use super::peers::{Peer, peer};
use super::{Scratch, Stack};
use serde_json::Value;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Stdio};

/// The EDS of the simulated CiA 401 device.
pub const IO401: &str = include_str!("../../launcher/stacks/canopen-io/io401.eds");

/// A service that stays dead until somebody restarts it.
pub const HELD: &str = "restart = { max = 0, within = \"10s\", on_exhausted = \"hold\" }";

/// A bus without pace, and the beginning of the stack.
pub const BUS: &str = r#"
[stack]
name = "NAME"

[[service]]
name = "can0"
kind = "can"
backend = "virtual"
"#;

/// A simulated node; `more` are lines of its table.
pub fn slave(name: &str, id: u8, more: &str) -> String {
    format!(
        "\n[[service]]\nname = \"{name}\"\nkind = \"canopen-slave\"\nnode_id = {id}\nsimulate = \"401\"\n{more}\n"
    )
}

/// A simulated node, and a device whose inside is a program.
pub const DEVICES: &str = r#"
[[service]]
name = "simulated"
kind = "canopen-slave"
node_id = 2
simulate = "401"
serial_number = 7
restart = { max = 0, within = "10s", on_exhausted = "hold" }

[[service]]
name = "device"
kind = "canopen-slave"
node_id = 5
eds = "io401.eds"
store = "device.store"
map = [
    { object = "6200:01", to = "%IB0", symbol = "Lamps" },
    { object = "6411:01", to = "%IW2", symbol = "Valve" },
    { object = "6000:01", from = "%QB0", symbol = "Buttons" },
    { object = "6401:01", from = "%QW2", symbol = "Level" },
]

[[service]]
name = "plc"
kind = "plc"
program = ["main.st"]
cycle = "5ms"
"#;

/// The inside.
pub const DEVICE_PROGRAM: &str = r"
PROGRAM Device
  Buttons := Lamps;
  Level := Valve + 1;
END_PROGRAM
";

/// Simulated devices without node-id, with the serial numbers 1 to 8.
pub fn eight_without_node_id() -> String {
    (1..=8u8).map(|n| slave(&format!("device{n}"), 255, &format!("serial_number = {n}"))).collect()
}

/// `dinrail canopen lss fastscan` gives eight devices node-ids from `from` on, in order of their serial numbers, which
/// count from `serial` on. Returns what it said.
pub fn fastscan_finds_eight(stack: &Stack, from: u8, serial: u32, more: &[&str]) -> String {
    let first = from.to_string();
    let found = stack.ok(&[&["canopen", "lss", "fastscan", "--from", &first], more].concat());
    for n in 0..8u8 {
        let line = format!("serial 0x{:08X}  -> node-id {}", serial + u32::from(n), from + n);
        assert!(found.contains(&line), "{line} is not in\n{found}");
    }
    found
}

/// A device made of python-canopen; its serial number is its node-id. `place`: a port of a cannelloni server, or a network
/// interface. It says `ready`.
pub fn python_slave(place: &str, eds: &Path, node: u8) -> Peer {
    let mut command = peer("canopen_slave.py").unwrap();
    command.arg(place).arg(eds).args([node.to_string(), node.to_string()]);
    Peer::start(command)
}

/// Devices made of durand, with these serial numbers; `place` as for [`python_slave`]. They say `ready`.
pub fn durand(place: &str, node: u8, serials: impl IntoIterator<Item = u32>) -> Peer {
    let mut command = peer("durand_slave.py").unwrap();
    command.args([place, &node.to_string()]).args(serials.into_iter().map(|serial| serial.to_string()));
    Peer::start(command)
}

/// A scratch folder with the EDS that durand makes of its device, `durand.eds`.
pub fn with_durand_eds(what: &str) -> Option<Scratch> {
    let output = peer("durand_slave.py")?.arg("eds").output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let scratch = Scratch::new(what);
    scratch.write("durand.eds", output.stdout);
    Some(scratch)
}

/// `dinrail canopen status --json`.
pub fn status(stack: &Stack) -> Option<Value> {
    let output = stack.cli(&["canopen", "status", "--json"]);
    serde_json::from_slice(&output.stdout).ok()
}

/// What the master says of a node.
pub fn node(stack: &Stack, id: u8) -> Option<Value> {
    status(stack)?["nodes"].as_array()?.iter().find(|n| n["id"] == id).cloned()
}

pub fn wait_operational(stack: &Stack, ids: &[u8]) {
    stack.wait(&format!("nodes {ids:?} operational"), || {
        let status = status(stack)?;
        let nodes = status["nodes"].as_array()?;
        let on = |id: &u8| nodes.iter().any(|n| n["id"] == *id && n["operational"] == true);
        ids.iter().all(on).then_some(())
    });
}

pub fn wait_state(stack: &Stack, id: u8, state: &str) {
    stack.wait(&format!("node {id} {state}"), || (node(stack, id)?["state"] == state).then_some(()));
}

/// What a service said so far, as `dinrail logs` shows it.
pub fn said(stack: &Stack, service: &str) -> String {
    String::from_utf8_lossy(&stack.cli(&["logs", service, "-n", "1000"]).stdout).into_owned()
}

/// Waits until a service has said something so many times.
pub fn wait_said_times(stack: &Stack, service: &str, text: &str, times: usize) {
    stack.wait(&format!("{service} says {times} times: {text}"), || {
        (said(stack, service).matches(text).count() >= times).then_some(())
    });
}

pub fn wait_said(stack: &Stack, service: &str, text: &str) {
    wait_said_times(stack, service, text, 1);
}

/// Value of an object of a node, as `dinrail canopen sdo read` shows it.
pub fn object(stack: &Stack, node: u8, object: &str) -> Option<String> {
    let output = stack.cli(&["canopen", "sdo", "read", &node.to_string(), object]);
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    output.status.success().then(|| text.trim().rsplit("= ").next().unwrap_or_default().to_owned())
}

/// Value of a place of the image, once it is the expected one.
pub fn becomes(stack: &Stack, place: &str, expected: i64) {
    let expected = format!("{place} = {expected}");
    stack.wait(&expected, || {
        let said = stack.cli(&["plc", "read", place]).stdout;
        (String::from_utf8_lossy(&said).trim() == expected).then_some(())
    });
}

/// Whatever is written to outputs comes back at inputs, over the bus and through the foreign device.
pub fn exchanges(stack: &Stack, pairs: &[(&str, &str)]) {
    for value in [17i64, 85] {
        for (i, (output, _)) in pairs.iter().enumerate() {
            stack.ok(&["plc", "write", &format!("{output}={}", value + i as i64)]);
        }
        for (i, (_, input)) in pairs.iter().enumerate() {
            becomes(stack, input, value + i as i64);
        }
    }
}

pub fn log_has(stack: &Stack, text: &str) {
    stack.wait(&format!("'{text}' in the log"), || stack.log().contains(text).then_some(()));
}

/// Bytes that repeat nowhere, so that a lost or doubled segment shows.
pub fn long_value(bytes: usize) -> Vec<u8> {
    let mut state = 0x1234_5678_9ABC_DEF1u64;
    let mut out = Vec::with_capacity(bytes + 8);
    while out.len() < bytes {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        out.extend_from_slice(&state.to_le_bytes());
    }
    out.truncate(bytes);
    out
}

/// Writes and reads a long value by the command line.
pub fn there_and_back(stack: &Stack, node: &str, bytes: usize, mode: &str) {
    let value = long_value(bytes);
    there(stack, node, &value, mode);
    back(stack, node, &value, mode);
}

pub fn there(stack: &Stack, node: &str, value: &[u8], mode: &str) {
    let file = stack.scratch.write("value.bin", value);
    stack.ok(&["canopen", "sdo", "write", node, "2000", "--input", path(&file), "--mode", mode]);
}

pub fn back(stack: &Stack, node: &str, value: &[u8], mode: &str) {
    let file = stack.scratch.0.join("back.bin");
    stack.ok(&["canopen", "sdo", "read", node, "2000", "--output", path(&file), "--mode", mode]);
    let read = fs::read(&file).unwrap();
    assert_eq!(read.len(), value.len());
    assert!(read == value, "{} bytes of node {node}, {mode}", value.len());
}

pub fn path(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// Text of a command that must fail.
pub fn refused(stack: &Stack, args: &[&str]) -> String {
    let output = stack.cli(args);
    assert!(!output.status.success(), "{args:?} succeeded");
    String::from_utf8(output.stderr).unwrap()
}

/// Error control messages of the bus, boot-up messages among them, from now on.
pub struct ErrorControl {
    child: Child,
    path: PathBuf,
}

impl ErrorControl {
    /// Begins, and waits until a node was heard.
    pub fn watch(stack: &Stack) -> Self {
        let path = stack.scratch.0.join("error-control.log");
        let child = super::dinrail()
            .args(["can", "dump", "can0", "--no-names", "--filter", "700-77F", "--stack", &stack.name])
            .stdout(fs::File::create(&path).unwrap())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let watch = Self { child, path };
        stack.wait("the dump hears heartbeats", || (!watch.frames().is_empty()).then_some(()));
        watch
    }

    /// `702#05`, ...
    pub fn frames(&self) -> Vec<String> {
        let text = fs::read_to_string(&self.path).unwrap_or_default();
        let whole = text.rsplit_once('\n').map_or("", |(lines, _)| lines);
        whole.lines().filter_map(|line| line.split_whitespace().nth(2)).map(str::to_owned).collect()
    }

    /// How many boot-up messages a node sent.
    pub fn boot_ups(&self, node: u8) -> usize {
        let wanted = format!("{:03X}#00", 0x700 + u32::from(node));
        self.frames().iter().filter(|f| **f == wanted).count()
    }
}

impl Drop for ErrorControl {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
