//! CANopen between processes and with foreign programs: python-canopen as master of our devices; devices made of
//! python-canopen, durand and node-canopen under our master. All through the bus servers of a virtual bus.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::cast_possible_truncation)]

mod support;

use rustix::process::Signal;
use std::fs;
use std::path::Path;
use std::process::Command;
use support::canopen::{
    DEVICE_PROGRAM, DEVICES, IO401, becomes, durand, eight_without_node_id, exchanges, fastscan_finds_eight,
    log_has, long_value, object as object_of, path, python_slave, refused, there_and_back, with_durand_eds,
};
use support::peers::{Peer, peer, program};
use support::{Stack, free_port, skip};

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

#[test]
fn python_canopen_as_master_drives_our_devices() {
    let ports = Ports::new();
    if peer("canopen_master.py").is_none() {
        return;
    }
    let text = format!("{}{DEVICES}", ports.bus());
    let mut stack = Stack::up("copymaster", &text, &[("io401.eds", IO401), ("main.st", DEVICE_PROGRAM)]);
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
    let mut master = python_master(&ports, "cannelloni", &eds, &["loss"]).unwrap();
    master.says("kill it");
    stack.kill("simulated", Signal::KILL);
    master.says("start it");
    stack.ok(&["restart", "simulated"]);
    master.says("loss");
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

#[test]
fn eight_devices_without_node_id_are_found_by_python_canopen() {
    let ports = Ports::new();
    if peer("canopen_master.py").is_none() {
        return;
    }
    let text = ports.bus() + &eight_without_node_id();
    let stack = Stack::up("colsspy", &text, &[("io401.eds", IO401)]);
    let eds = stack.scratch.0.join("io401.eds");
    let mut master = python_master(&ports, "cannelloni", &eds, &["fastscan"]).unwrap();
    master.says("fastscan");
    master.ends();
}

#[test]
fn eight_devices_without_node_id_are_found_by_the_command_line() {
    let stack = Stack::up("colsscli", &(Ports::new().bus() + &eight_without_node_id()), &[]);
    fastscan_finds_eight(&stack, 10, 1, &[]);
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

/// As [`python_slave`], on the bus already.
fn python_node(ports: &Ports, stack: &Stack, node: u8) -> Peer {
    let mut peer = python_slave(&ports.cannelloni, &stack.scratch.0.join("io401.eds"), node);
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
    let mut stack = Stack::spawn("copyslave", &our_master(&ports, PYTHON_NODES), &[("io401.eds", IO401)]);
    stack.wait("the bus at work", || stack.is_ready("can0").then_some(()));
    let mut first = python_node(&ports, &stack, 10);
    let mut second = python_node(&ports, &stack, 11);
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

/// Every transmission type both ways, spread over four devices: what the master is asked to set, and the way the values
/// of 6200h and 6411h go and come back.
const KINDS: [(u8, [u8; 2], [u8; 2]); 4] =
    [(14, [253, 252], [254, 0]), (15, [254, 3], [1, 5]), (16, [0, 255], [255, 240]), (17, [1, 255], [1, 0])];

#[test]
fn every_kind_of_pdo_with_devices_made_of_python_canopen() {
    if peer("canopen_slave.py").is_none() {
        return;
    }
    let ports = Ports::new();
    let mut nodes = String::new();
    let mut pairs = Vec::new();
    for (i, (id, tpdo, rpdo)) in KINDS.iter().enumerate() {
        let (state, byte, word) = (30 + i, i, 10 + i);
        nodes.push_str(&format!(
            r#"
[[service.node]]
id = {id}
eds = "io401.eds"
heartbeat = "500ms"
status_to = "%IB{state}"
tpdo = [{{ number = 1, transmission = {} }}, {{ number = 2, transmission = {} }}]
rpdo = [{{ number = 1, transmission = {} }}, {{ number = 2, transmission = {} }}]
map = [
    {{ object = "6000:01", to = "%IB{byte}" }},
    {{ object = "6401:01", to = "%IW{word}" }},
    {{ object = "6200:01", from = "%QB{byte}" }},
    {{ object = "6411:01", from = "%QW{word}" }},
]
"#,
            tpdo[0], tpdo[1], rpdo[0], rpdo[1]
        ));
        pairs.push((format!("%QB{byte}"), format!("%IB{byte}")));
        pairs.push((format!("%QW{word}"), format!("%IW{word}")));
    }
    let pairs: Vec<(&str, &str)> = pairs.iter().map(|(q, i)| (q.as_str(), i.as_str())).collect();
    let mut stack = Stack::spawn("copykinds", &our_master(&ports, &nodes), &[("io401.eds", IO401)]);
    stack.wait("the bus at work", || stack.is_ready("can0").then_some(()));
    let devices: Vec<Peer> = KINDS.iter().map(|(id, ..)| python_node(&ports, &stack, *id)).collect();
    for state in 30..34 {
        becomes(&stack, &format!("%IB{state}"), 5);
    }
    exchanges(&stack, &pairs);
    for (id, tpdo, rpdo) in KINDS {
        for (object, expected) in
            [("1800:02", tpdo[0]), ("1801:02", tpdo[1]), ("1400:02", rpdo[0]), ("1401:02", rpdo[1])]
        {
            assert_eq!(
                object_of(&stack, id, object).as_deref(),
                Some(&*expected.to_string()),
                "{id} {object}"
            );
        }
    }
    drop(devices);
    assert_eq!(stack.take_down(), 0, "{}", stack.log());
}

/// Heartbeat loss by kill -9, guarding loss by silence, and the return of both.
fn comes_and_goes(stack: &Stack, ports: &Ports, first: Peer, second: &mut Peer) {
    drop(first);
    log_has(stack, "node 10 (Simulated I/O) is lost: it sends no heartbeat any more");
    becomes(stack, "%IB30", 0);
    becomes(stack, "%IB31", 5);
    let mut first = python_node(ports, stack, 10);
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

#[test]
fn our_master_drives_devices_made_of_durand() {
    let Some(scratch) = with_durand_eds("durand") else { return };
    let ports = Ports::new();
    let stack = Stack::spawn_in("codurand", &our_master(&ports, DURAND_NODE), scratch, &[]);
    stack.wait("the bus at work", || stack.is_ready("can0").then_some(()));
    // It has no node-id yet: LSS gives it one, and the master boots it.
    let mut first = durand(&ports.cannelloni, 255, [12]);
    first.says("ready");
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
    let mut second = durand(&ports.cannelloni, 12, [12]);
    second.says("ready");
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

#[test]
fn eight_devices_made_of_durand_without_node_id_are_found_by_our_master() {
    if peer("durand_slave.py").is_none() {
        return;
    }
    let ports = Ports::new();
    let stack = Stack::up("codurand8", &our_master(&ports, ""), &[]);
    let mut devices = durand(&ports.cannelloni, 255, 101..=108);
    devices.says("ready");
    // Python answers late on a machine under load.
    fastscan_finds_eight(&stack, 20, 101, &["--timeout", "200"]);
    for node in 20..28 {
        let said = stack.ok(&["canopen", "sdo", "read", &node.to_string(), "1018:04", "--type", "u32"]);
        assert!(said.trim().ends_with(&format!("= {}", node - 20 + 101)), "{said}");
    }
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
    if node_canopen().is_none() {
        return;
    }
    let ports = Ports::new();
    let stack = Stack::spawn("conode", &our_master(&ports, NODE_NODE), &[("io401.eds", IO401)]);
    stack.wait("the bus at work", || stack.is_ready("can0").then_some(()));
    let start = || {
        let mut command = node_canopen().unwrap();
        command.arg(&ports.cannelloni).arg(stack.scratch.0.join("io401.eds")).args(["13", "13"]);
        Peer::start(command)
    };
    let mut device = start();
    device.says("operational 0xbeef");
    becomes(&stack, "%IB33", 5);
    exchanges(&stack, &[("%QB3", "%IB3"), ("%QW5", "%IW5")]);
    let name = stack.ok(&["canopen", "sdo", "read", "13", "1008"]);
    assert_eq!(name.trim(), "1008:00 Manufacturer device name = Simulated I/O");
    assert!(refused(&stack, &["canopen", "sdo", "read", "13", "5000"]).contains("06020000h"));
    there_and_back(&stack, "13", 10_240, "segmented");
    // Only to it by block: its own block upload ends the whole program now and then. And no megabyte: it stands still for
    // so long meanwhile that it is lost.
    let value = long_value(10_241);
    let file = stack.scratch.write("value.bin", &value);
    let back = stack.scratch.0.join("back.bin");
    stack.ok(&["canopen", "sdo", "write", "13", "2000", "--input", path(&file), "--mode", "block"]);
    stack.ok(&["canopen", "sdo", "read", "13", "2000", "--output", path(&back), "--mode", "segmented"]);
    assert!(fs::read(&back).unwrap() == value);
    device.tell("emcy");
    log_has(
        &stack,
        "node 13 (Simulated I/O) reports emergency 4210h, temperature; error register 00h, vendor bytes 6865617421",
    );
    stack.ok(&["canopen", "nmt", "reset-node", "13"]);
    device.says("booted");
    device.says("operational 0xbeef");
    drop(device);
    log_has(&stack, "node 13 (Simulated I/O) is lost: it sends no heartbeat any more");
    becomes(&stack, "%IB33", 0);
    let mut device = start();
    device.says("operational 0xbeef");
    becomes(&stack, "%IB33", 5);
    exchanges(&stack, &[("%QB3", "%IB3"), ("%QW5", "%IW5")]);
}
