//! CANopen networks of simulated nodes, and what their users are shown.

use super::Stack;
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
    let file = stack.scratch.write("value.bin", &value);
    let back = stack.scratch.0.join("back.bin");
    stack.ok(&["canopen", "sdo", "write", node, "2000", "--input", path(&file), "--mode", mode]);
    stack.ok(&["canopen", "sdo", "read", node, "2000", "--output", path(&back), "--mode", mode]);
    assert_eq!(fs::read(&back).unwrap().len(), bytes);
    assert!(fs::read(&back).unwrap() == value, "{bytes} bytes to node {node}, {mode}");
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
