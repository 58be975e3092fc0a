//! CANopen between processes and with foreign programs: python-canopen as master of our devices; devices made of
//! python-canopen, durand and node-canopen under our master. All through the bus servers of a virtual bus.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::cast_possible_truncation)]

mod support;

use std::fs;
use std::io::{BufRead, BufReader, Read, Write};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex};
use std::time::Duration;
use support::peers::{peer, program};
use support::{Scratch, Stack, free_port, skip, wait_for};

/// Transfers of a megabyte by interpreted programs, on a machine that is shared.
const LONG: Duration = Duration::from_mins(2);
const EDS: &str = include_str!("../launcher/stacks/canopen-io/io401.eds");

/// A foreign program with what it said so far; killed when dropped.
struct Peer {
    child: Child,
    said: Arc<Mutex<Vec<String>>>,
    /// Lines already waited for.
    taken: usize,
}

impl Peer {
    fn start(mut command: Command) -> Self {
        let mut child =
            command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        let said = Arc::new(Mutex::new(Vec::new()));
        let pipes: [Box<dyn Read + Send>; 2] =
            [Box::new(child.stdout.take().unwrap()), Box::new(child.stderr.take().unwrap())];
        for pipe in pipes {
            let said = Arc::clone(&said);
            std::thread::spawn(move || {
                for line in BufReader::new(pipe).lines().map_while(Result::ok) {
                    said.lock().unwrap().push(line);
                }
            });
        }
        Self { child, said, taken: 0 }
    }

    fn all(&self) -> Vec<String> {
        self.said.lock().unwrap().clone()
    }

    /// Waits until it says this line, after those waited for before.
    fn says(&mut self, line: &str) {
        let start = std::time::Instant::now();
        loop {
            let said = self.all();
            if let Some(at) = said[self.taken..].iter().position(|l| l == line) {
                self.taken += at + 1;
                return;
            }
            let ended = self.child.try_wait().unwrap().is_some();
            assert!(
                !ended && start.elapsed() < LONG,
                "waited in vain for '{line}'; the peer {}said:\n{}",
                if ended { "ended and " } else { "" },
                said.join("\n")
            );
            std::thread::sleep(Duration::from_millis(10));
        }
    }

    fn tell(&mut self, line: &str) {
        let pipe = self.child.stdin.as_mut().unwrap();
        writeln!(pipe, "{line}").unwrap();
        pipe.flush().unwrap();
    }

    /// Waits until it ends well.
    fn ends(mut self) {
        let status = wait_for("the end of the peer", LONG, || self.child.try_wait().unwrap());
        assert!(status.success(), "{}", self.all().join("\n"));
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Ports of the servers of a bus.
struct Ports {
    cannelloni: String,
    slcan: String,
}

impl Ports {
    fn new() -> Self {
        Self { cannelloni: free_port().to_string(), slcan: free_port().to_string() }
    }

    /// The stack's head: a virtual bus with its servers.
    fn bus(&self) -> String {
        format!(
            r#"
[stack]
name = "NAME"

[[service]]
name = "can0"
kind = "can"
backend = "virtual"
bitrate = "1M"
serve = {{ cannelloni = "127.0.0.1:{}", slcan = "127.0.0.1:{}" }}
"#,
            self.cannelloni, self.slcan
        )
    }
}

/// python-canopen as master, carrying out parts of `canopen_master.py`.
fn python_master(ports: &Ports, interface: &str, eds: &Path, parts: &[&str]) -> Option<Peer> {
    let mut command = peer("canopen_master.py")?;
    let port = if interface == "slcan" { &ports.slcan } else { &ports.cannelloni };
    command.args([interface, port]).arg(eds).args(parts);
    Some(Peer::start(command))
}

const DEVICES: &str = r#"
[[service]]
name = "simulated"
kind = "canopen-slave"
node_id = 2
simulate = "401"
serial_number = 7

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

const PROGRAM: &str = r"
PROGRAM Device
  Buttons := Lamps;
  Level := Valve + 1;
END_PROGRAM
";

#[test]
fn python_canopen_as_master_drives_our_devices() {
    let ports = Ports::new();
    if peer("canopen_master.py").is_none() {
        return;
    }
    let text = format!("{}{DEVICES}", ports.bus());
    let mut stack = Stack::up("copymaster", &text, &[("io401.eds", EDS), ("main.st", PROGRAM)]);
    let eds = stack.scratch.0.join("io401.eds");
    let parts = ["nmt", "heartbeat_consumer", "sdo", "pdo"];
    let mut master = python_master(&ports, "cannelloni", &eds, &parts).unwrap();
    for part in parts {
        master.says(part);
    }
    master.ends();
    // Remote frames, by the other protocol that carries them.
    let mut master = python_master(&ports, "slcan", &eds, &["rtr"]).unwrap();
    master.says("rtr");
    master.ends();
    // The device whose inside is a program.
    let mut master = python_master(&ports, "cannelloni", &eds, &["device"]).unwrap();
    master.says("stop the plc");
    stack.ok(&["plc", "stop"]);
    master.says("start the plc");
    stack.ok(&["plc", "run"]);
    master.says("device");
    master.ends();
    let mut master = python_master(&ports, "cannelloni", &eds, &["megabyte"]).unwrap();
    master.says("megabyte");
    master.ends();
    assert_eq!(stack.take_down(), 0, "{}", stack.log());
}

fn eight_without_node_id(ports: &Ports) -> String {
    let mut text = ports.bus();
    for serial in 1..=8 {
        text.push_str(&format!(
            "\n[[service]]\nname = \"device{serial}\"\nkind = \"canopen-slave\"\nnode_id = 255\nsimulate = \"401\"\nserial_number = {serial}\n"
        ));
    }
    text
}

#[test]
fn eight_devices_without_node_id_are_found_by_python_canopen() {
    let ports = Ports::new();
    if peer("canopen_master.py").is_none() {
        return;
    }
    let stack = Stack::up("colsspy", &eight_without_node_id(&ports), &[("io401.eds", EDS)]);
    let eds = stack.scratch.0.join("io401.eds");
    let mut master = python_master(&ports, "cannelloni", &eds, &["fastscan"]).unwrap();
    master.says("fastscan");
    master.ends();
}

#[test]
fn eight_devices_without_node_id_are_found_by_the_command_line() {
    let stack = Stack::up("colsscli", &eight_without_node_id(&Ports::new()), &[]);
    let found = stack.ok(&["canopen", "lss", "fastscan", "--from", "10"]);
    for serial in 1..=8 {
        let line = format!("serial 0x{serial:08X}  -> node-id {}", 9 + serial);
        assert!(found.contains(&line), "{line} is not in\n{found}");
    }
    let scanned = stack.ok(&["canopen", "scan"]);
    for node in 10..=17 {
        let row = scanned.lines().find(|l| l.starts_with(&node.to_string())).unwrap_or_default();
        assert!(row.ends_with(&format!("{:08X}h", node - 9)), "{scanned}");
    }
    // Nobody is left.
    let again = stack.ok(&["canopen", "lss", "fastscan"]);
    assert_eq!(again.trim(), "no device without node-id answers");
}

/// A stack with our master; `nodes` are its `[[service.node]]`.
fn our_master(ports: &Ports, nodes: &str) -> String {
    format!(
        r#"{}
[[service]]
name = "io"
kind = "canopen-master"
sync_period = "20ms"
sdo_timeout = "2s"
{nodes}
[[service]]
name = "plc"
kind = "plc"
cycle = "10ms"
"#,
        ports.bus()
    )
}

/// Value of a place of the image, once it is the expected one.
fn becomes(stack: &Stack, place: &str, expected: i64) {
    let expected = format!("{place} = {expected}");
    stack.wait(&expected, || {
        let said = stack.cli(&["plc", "read", place]).stdout;
        (String::from_utf8_lossy(&said).trim() == expected).then_some(())
    });
}

/// Whatever is written to outputs comes back at inputs, over the bus and through the foreign device.
fn exchanges(stack: &Stack, pairs: &[(&str, &str)]) {
    for value in [17i64, 85] {
        for (i, (output, _)) in pairs.iter().enumerate() {
            stack.ok(&["plc", "write", &format!("{output}={}", value + i as i64)]);
        }
        for (i, (_, input)) in pairs.iter().enumerate() {
            becomes(stack, input, value + i as i64);
        }
    }
}

fn log_has(stack: &Stack, text: &str) {
    stack.wait(&format!("'{text}' in the log"), || stack.log().contains(text).then_some(()));
}

/// Bytes that repeat nowhere, so that a lost or doubled segment shows.
fn long_value(bytes: usize) -> Vec<u8> {
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
fn there_and_back(stack: &Stack, node: &str, bytes: usize, mode: &str) {
    let value = long_value(bytes);
    let file = stack.scratch.write("value.bin", &value);
    let back = stack.scratch.0.join("back.bin");
    stack.ok(&["canopen", "sdo", "write", node, "2000", "--input", path(&file), "--mode", mode]);
    stack.ok(&["canopen", "sdo", "read", node, "2000", "--output", path(&back), "--mode", mode]);
    assert_eq!(fs::read(&back).unwrap().len(), bytes);
    assert!(fs::read(&back).unwrap() == value, "{bytes} bytes to node {node}, {mode}");
}

fn path(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// Text of a command that must fail.
fn refused(stack: &Stack, args: &[&str]) -> String {
    let output = stack.cli(args);
    assert!(!output.status.success(), "{args:?} succeeded");
    String::from_utf8(output.stderr).unwrap()
}

fn python_slave(ports: &Ports, stack: &Stack, node: u8) -> Peer {
    let mut command = peer("canopen_slave.py").unwrap();
    command.arg(&ports.cannelloni).arg(stack.scratch.0.join("io401.eds"));
    command.args([node.to_string(), node.to_string()]);
    let mut peer = Peer::start(command);
    peer.says("ready");
    peer
}

const PYTHON_NODES: &str = r#"
[[service.node]]
id = 10
eds = "io401.eds"
mandatory = true
heartbeat = "200ms"
check = ["device_type", "vendor", "product", "revision", "serial"]
serial_number = 10
status_to = "%IB30"
sdo = [{ object = "Scratch value", value = "0xCAFE" }]
rpdo = [{ number = 2, cob_id = "$NODEID+0x320", transmission = 1, mapping = ["6411:02", "6411:01"] }]
map = [
    { object = "6000:01", to = "%IB0" },
    { object = "6401:01", to = "%IW2" },
    { object = "6401:02", to = "%IW3" },
    { object = "6200:01", from = "%QB0" },
    { object = "6411:01", from = "%QW2" },
    { object = "6411:02", from = "%QW3" },
]

[[service.node]]
id = 11
eds = "io401.eds"
guarding = { time = "300ms", factor = 3 }
status_to = "%IB31"
check = ["device_type", "vendor", "product", "serial"]
serial_number = 11
tpdo = [{ number = 1, transmission = "event" }]
rpdo = [{ number = 1, transmission = "event" }]
map = [
    { object = "6000:01", to = "%IB1" },
    { object = "6200:01", from = "%QB1" },
]
"#;

#[test]
fn our_master_drives_devices_made_of_python_canopen() {
    if peer("canopen_slave.py").is_none() {
        return;
    }
    let ports = Ports::new();
    let mut stack = Stack::spawn("copyslave", &our_master(&ports, PYTHON_NODES), &[("io401.eds", EDS)]);
    stack.wait("the bus at work", || stack.is_ready("can0").then_some(()));
    let mut first = python_slave(&ports, &stack, 10);
    let mut second = python_slave(&ports, &stack, 11);
    // Boot-up: identity, configuration, start.
    first.says("written 2001:00 feca0000");
    first.says("operational 0xcafe");
    second.says("operational 0x0");
    becomes(&stack, "%IB30", 5);
    becomes(&stack, "%IB31", 5);
    exchanges(&stack, &[("%QB0", "%IB0"), ("%QW2", "%IW2"), ("%QW3", "%IW3"), ("%QB1", "%IB1")]);
    // SDO: expedited, segmented; block falls back, because LocalNode has none.
    assert_eq!(
        stack.ok(&["canopen", "sdo", "read", "10", "1018:04"]).trim(),
        "1018:04 Identity, Serial number = 10"
    );
    let name = stack.ok(&["canopen", "sdo", "read", "10", "Manufacturer device name"]);
    assert_eq!(name.trim(), "1008:00 Manufacturer device name = Simulated I/O");
    stack.ok(&["canopen", "sdo", "write", "10", "2001", "4711"]);
    assert!(stack.ok(&["canopen", "sdo", "read", "10", "2001"]).ends_with("= 4711\n"));
    there_and_back(&stack, "10", 10_240, "segmented");
    there_and_back(&stack, "10", 10_240, "block");
    assert!(refused(&stack, &["canopen", "sdo", "read", "10", "5000"]).contains("06020000h"));
    let ro = ["canopen", "sdo", "write", "10", "1000", "1", "--type", "u32"];
    assert!(refused(&stack, &ro).contains("06010002h"));
    // Emergencies are shown.
    first.tell("emcy");
    log_has(
        &stack,
        "node 10 (Simulated I/O) reports emergency 3110h, voltage; error register 05h, vendor bytes 766F6C7473",
    );
    stack.wait("the emergency in the status", || {
        stack.ok(&["canopen", "status"]).contains("3110h").then_some(())
    });
    first.tell("emcy gone");
    log_has(&stack, "node 10 (Simulated I/O) reports that its error is gone");
    // NMT from outside is seen and put right.
    stack.ok(&["canopen", "nmt", "reset-node", "10"]);
    first.says("reset");
    first.says("operational 0xcafe");
    comes_and_goes(&stack, &ports, first, &mut second);
    assert_eq!(stack.take_down(), 0, "{}", stack.log());
}

/// Heartbeat loss by kill -9, guarding loss by silence, and the return of both.
fn comes_and_goes(stack: &Stack, ports: &Ports, first: Peer, second: &mut Peer) {
    drop(first);
    log_has(stack, "node 10 (Simulated I/O) is lost: it sends no heartbeat any more");
    becomes(stack, "%IB30", 0);
    becomes(stack, "%IB31", 5);
    let mut first = python_slave(ports, stack, 10);
    first.says("operational 0xcafe");
    becomes(stack, "%IB30", 5);
    exchanges(stack, &[("%QB0", "%IB0"), ("%QB1", "%IB1")]);
    second.tell("quiet");
    log_has(stack, "node 11 (Simulated I/O) is lost: it does not answer node guarding any more");
    becomes(stack, "%IB31", 0);
    second.tell("speak");
    second.says("operational 0x0");
    becomes(stack, "%IB31", 5);
    exchanges(stack, &[("%QB0", "%IB0"), ("%QB1", "%IB1")]);
}

const DURAND_NODE: &str = r#"
[[service.node]]
id = 12
name = "Durand"
eds = "durand.eds"
heartbeat = "200ms"
status_to = "%IB32"
check = ["device_type", "vendor", "product", "revision", "serial"]
serial_number = 12
sdo = [{ object = "Number", value = 4711 }]
map = [
    { object = "6000:01", to = "%IB2" },
    { object = "6401:03", to = "%IW4" },
    { object = "6200:01", from = "%QB2" },
    { object = "6411:03", from = "%QW4" },
]
"#;

/// A scratch folder with the EDS that durand makes of the device.
fn with_durand_eds() -> Option<Scratch> {
    let output = peer("durand_slave.py")?.arg("eds").output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let scratch = Scratch::new("durand");
    scratch.write("durand.eds", output.stdout);
    Some(scratch)
}

fn durand(ports: &Ports, node: u8) -> Peer {
    let mut command = peer("durand_slave.py").unwrap();
    command.args([ports.cannelloni.as_str(), &node.to_string(), "12"]);
    let mut peer = Peer::start(command);
    peer.says("ready");
    peer
}

#[test]
fn our_master_drives_devices_made_of_durand() {
    let Some(scratch) = with_durand_eds() else { return };
    let ports = Ports::new();
    let stack = Stack::spawn_in("codurand", &our_master(&ports, DURAND_NODE), scratch, &[]);
    stack.wait("the bus at work", || stack.is_ready("can0").then_some(()));
    // It has no node-id yet: LSS gives it one, and the master boots it.
    let first = durand(&ports, 255);
    let found = stack.ok(&["canopen", "lss", "fastscan", "--from", "12"]);
    assert!(
        found.contains(
            "vendor 0x00000D0D  product 0x00000401  revision 0x00000002  serial 0x0000000C  -> node-id 12"
        ),
        "{found}"
    );
    becomes(&stack, "%IB32", 5);
    exchanges(&stack, &[("%QB2", "%IB2"), ("%QW4", "%IW4")]);
    drop(first);
    log_has(&stack, "node 12 (Durand) is lost: it sends no heartbeat any more");
    becomes(&stack, "%IB32", 0);
    let mut second = durand(&ports, 12);
    becomes(&stack, "%IB32", 5);
    exchanges(&stack, &[("%QB2", "%IB2"), ("%QW4", "%IW4")]);
    assert_eq!(stack.ok(&["canopen", "sdo", "read", "12", "Number"]).trim(), "2001:00 Number = 4711");
    for mode in ["segmented", "block", "auto"] {
        there_and_back(&stack, "12", 10_240, mode);
    }
    // 889 bytes are one sub-block of 127 segments.
    for bytes in [1, 8, 888, 890] {
        there_and_back(&stack, "12", bytes, "block");
    }
    there_and_back(&stack, "12", 1 << 20, "block");
    assert!(refused(&stack, &["canopen", "sdo", "write", "12", "2002", "1"]).contains("06010002h"));
    second.tell("emcy");
    log_has(
        &stack,
        "node 12 (Durand) reports emergency 2310h, current; error register 03h, vendor bytes 616D707321",
    );
}

/// node.js with node-canopen, installed once beside the build.
fn node_canopen() -> Option<Command> {
    let mut command = program("node", "nodejs")?;
    program("npm", "npm")?;
    let exe = std::env::current_exe().unwrap();
    let target = exe.ancestors().nth(3).unwrap();
    let (dir, lock) = (target.join("peers-node"), include_str!("peers/node/package-lock.json"));
    let turn = fs::File::create(target.join("peers-node.lock")).unwrap();
    turn.lock().unwrap();
    if fs::read_to_string(dir.join("installed.json")).is_ok_and(|done| done == lock) {
        return Some(with_modules(command, &dir));
    }
    let _ = fs::remove_dir_all(&dir);
    fs::create_dir_all(&dir).unwrap();
    fs::write(dir.join("package.json"), include_str!("peers/node/package.json")).unwrap();
    fs::write(dir.join("package-lock.json"), lock).unwrap();
    // Newer npm leaves install scripts out, and node-crc is compiled by one.
    for args in [&["ci", "--no-audit", "--no-fund"][..], &["rebuild", "--foreground-scripts", "node-crc"]] {
        let output = Command::new("npm").args(args).current_dir(&dir).output().unwrap();
        if !output.status.success() {
            skip(&format!("npm {args:?}: {}", String::from_utf8_lossy(&output.stderr)));
            return None;
        }
    }
    fs::write(dir.join("installed.json"), lock).unwrap();
    command = with_modules(command, &dir);
    Some(command)
}

fn with_modules(mut command: Command, dir: &Path) -> Command {
    command.env("NODE_PATH", dir.join("node_modules"));
    command.arg(Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/peers/node/canopen_slave.js"));
    command
}

const NODE_NODE: &str = r#"
[[service.node]]
id = 13
eds = "io401.eds"
heartbeat = "200ms"
check = ["device_type", "vendor", "product", "revision", "serial"]
serial_number = 13
status_to = "%IB33"
sdo = [{ object = "2001", value = "0xBEEF" }]
map = [
    { object = "6000:01", to = "%IB3" },
    { object = "6200:01", from = "%QB3" },
    { object = "6401:02", to = "%IW5" },
    { object = "6411:02", from = "%QW5" },
]
"#;

#[test]
fn our_master_drives_a_device_made_of_node_canopen() {
    let Some(mut command) = node_canopen() else { return };
    let ports = Ports::new();
    let stack = Stack::spawn("conode", &our_master(&ports, NODE_NODE), &[("io401.eds", EDS)]);
    stack.wait("the bus at work", || stack.is_ready("can0").then_some(()));
    command.arg(&ports.cannelloni).arg(stack.scratch.0.join("io401.eds")).args(["13", "13"]);
    let mut device = Peer::start(command);
    device.says("operational 0xbeef");
    becomes(&stack, "%IB33", 5);
    exchanges(&stack, &[("%QB3", "%IB3"), ("%QW5", "%IW5")]);
    let name = stack.ok(&["canopen", "sdo", "read", "13", "1008"]);
    assert_eq!(name.trim(), "1008:00 Manufacturer device name = Simulated I/O");
    assert!(refused(&stack, &["canopen", "sdo", "read", "13", "5000"]).contains("06020000h"));
    there_and_back(&stack, "13", 10_240, "segmented");
    // Only to it by block: its own block upload ends the whole program now and then.
    let value = long_value(10_241);
    let file = stack.scratch.write("value.bin", &value);
    let back = stack.scratch.0.join("back.bin");
    stack.ok(&["canopen", "sdo", "write", "13", "2000", "--input", path(&file), "--mode", "block"]);
    stack.ok(&["canopen", "sdo", "read", "13", "2000", "--output", path(&back), "--mode", "segmented"]);
    assert!(fs::read(&back).unwrap() == value);
    stack.ok(&["canopen", "nmt", "reset-node", "13"]);
    device.says("booted");
    device.says("operational 0xbeef");
    drop(device);
    log_has(&stack, "node 13 (Simulated I/O) is lost: it sends no heartbeat any more");
    becomes(&stack, "%IB33", 0);
}
