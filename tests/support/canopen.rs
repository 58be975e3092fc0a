//! CANopen networks of simulated nodes, and what their users are shown.

use super::Stack;
use serde_json::Value;
use std::fs;
use std::path::PathBuf;
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
