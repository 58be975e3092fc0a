//! CANopen over the kernel's CAN, in user-mode Linux: a stack with our master, a stack with our nodes and devices made of
//! python-canopen and durand share vcan0, and candump hears all of it. Then python-canopen as master of our devices.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod support;

use rustix::process::Signal;
use std::fs;
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};
use support::canopen::{
    DEVICE_PROGRAM, DEVICES, HELD, IO401, back, becomes, durand, eight_without_node_id, exchanges,
    fastscan_finds_eight, log_has, long_value, python_slave, slave, status, there, there_and_back,
    with_durand_eds,
};
use support::peers::{Peer, peer};
use support::uml::{guest_work, in_guest};
use support::{Scratch, Stack, dinrail, wait_for};

/// The guest's interface.
const VCAN: &str = "vcan0";

/// The guest is slow, and its machine is shared.
const LONG: Duration = Duration::from_mins(2);

const BUS: &str = r#"
[stack]
name = "NAME"

[[service]]
name = "can0"
kind = "can"
backend = "socketcan"
interface = "vcan0"
"#;

/// Node 2: synchronous PDOs, heartbeat. Node 3: its input by remote frame, guarding. 10 and 11: the same made of
/// python-canopen, 12: durand.
const MASTER: &str = r#"
[[service]]
name = "io"
kind = "canopen-master"
sync_period = "50ms"
sdo_timeout = "2s"

[[service.node]]
id = 2
eds = "io401.eds"
mandatory = true
heartbeat = "1s"
check = ["device_type", "vendor", "product", "revision", "serial"]
serial_number = 7
status_to = "%IB30"
sdo = [{ object = "Scratch value", value = "0xCAFE" }]
map = [
    { object = "6000:01", to = "%IB0" },
    { object = "6401:01", to = "%IW10" },
    { object = "6200:01", from = "%QB0" },
    { object = "6411:01", from = "%QW10" },
]

[[service.node]]
id = 3
eds = "io401.eds"
mandatory = true
guarding = { time = "1s", factor = 3 }
status_to = "%IB31"
tpdo = [{ number = 1, transmission = "rtr" }]
rpdo = [{ number = 1, transmission = "event" }]
map = [
    { object = "6000:01", to = "%IB1" },
    { object = "6200:01", from = "%QB1" },
]

[[service.node]]
id = 10
eds = "io401.eds"
heartbeat = "1s"
check = ["device_type", "vendor", "product", "revision", "serial"]
serial_number = 10
status_to = "%IB32"
sdo = [{ object = "Scratch value", value = "0xCAFE" }]
map = [
    { object = "6000:01", to = "%IB2" },
    { object = "6200:01", from = "%QB2" },
]

[[service.node]]
id = 11
eds = "io401.eds"
guarding = { time = "1s", factor = 3 }
status_to = "%IB33"
tpdo = [{ number = 1, transmission = "rtr" }]
rpdo = [{ number = 1, transmission = "event" }]
map = [
    { object = "6000:01", to = "%IB3" },
    { object = "6200:01", from = "%QB3" },
]

[[service.node]]
id = 12
name = "Durand"
eds = "durand.eds"
heartbeat = "1s"
status_to = "%IB34"
map = [
    { object = "6000:01", to = "%IB4" },
    { object = "6200:01", from = "%QB4" },
]

[[service]]
name = "plc"
kind = "plc"
cycle = "20ms"
"#;

/// All that is exchanged: outputs and the inputs that show them.
const PAIRS: [(&str, &str); 6] = [
    ("%QB0", "%IB0"),
    ("%QW10", "%IW10"),
    ("%QB1", "%IB1"),
    ("%QB2", "%IB2"),
    ("%QB3", "%IB3"),
    ("%QB4", "%IB4"),
];

/// Somebody who writes all frames of the bus to a file: candump, or our own `can dump`.
struct Witness {
    child: Child,
    path: PathBuf,
}

impl Witness {
    /// Of these identifiers, all if there are none.
    fn candump(identifiers: &[&str]) -> Self {
        // Left to be read where the test fails.
        let path = guest_work().join("candump.log");
        let mut command = Command::new("candump");
        let filters: String = identifiers.iter().map(|id| format!(",{id}:7FF")).collect();
        // The frames by which it is seen to hear.
        let own = if filters.is_empty() { "" } else { ",6FE:7FF" };
        // A receive buffer that lets it sleep for seconds on this one processor.
        command.args(["-r", "33554432", "-L", &format!("{VCAN}{filters}{own}")]);
        Self::start(command, path)
    }

    fn of_stack(stack: &Stack) -> Self {
        let mut command = dinrail();
        command.args(["can", "dump", "can0", "--no-names", "--stack", &stack.name]);
        Self::start(command, stack.scratch.0.join("dump.log"))
    }

    /// Starts it, and waits until it hears.
    fn start(mut command: Command, path: PathBuf) -> Self {
        let file = fs::File::create(&path).unwrap();
        let child = command.stdin(Stdio::null()).stdout(file).stderr(Stdio::null()).spawn().unwrap();
        let witness = Self { child, path };
        wait_for("the first frame of a witness", LONG, || {
            cansend("6FE#");
            (!witness.frames().is_empty()).then_some(())
        });
        witness
    }

    /// `ID#DATA` of every frame so far.
    fn frames(&self) -> Vec<String> {
        let text = fs::read_to_string(&self.path).unwrap_or_default();
        let whole = text.rsplit_once('\n').map_or("", |(lines, _)| lines);
        whole.lines().filter_map(|line| line.split_whitespace().nth(2)).map(str::to_owned).collect()
    }

    fn count(&self, start: &str) -> usize {
        self.frames().iter().filter(|f| f.starts_with(start)).count()
    }

    /// Waits until it heard a frame that begins so.
    fn hears(&self, start: &str) {
        wait_for(&format!("{start} on the bus"), LONG, || (self.count(start) > 0).then_some(()));
    }

    /// Frames between two of ours.
    fn between(&self, from: &str, to: &str) -> Vec<String> {
        self.hears(to);
        let frames = self.frames();
        let place = |mark| frames.iter().position(|f| f == mark).unwrap();
        frames[place(from) + 1..place(to)].to_vec()
    }
}

impl Drop for Witness {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn cansend(frame: &str) {
    assert!(Command::new("cansend").args([VCAN, frame]).status().unwrap().success());
}

/// NMT states of nodes, where the program sees them.
fn states(master: &Stack, places: &[&str], state: i64) {
    for place in places {
        becomes(master, place, state);
    }
}

/// Says how long a part took: what a slow machine is slow at.
fn timed<T>(what: &str, part: impl FnOnce() -> T) -> T {
    let began = Instant::now();
    let value = part();
    eprintln!("--- {what}: {:.1} s", began.elapsed().as_secs_f32());
    value
}

#[test]
fn our_master_drives_our_nodes_and_foreign_ones_over_the_kernel() {
    in_guest("our_master_drives_our_nodes_and_foreign_ones_over_the_kernel", our_master);
}

fn our_master() {
    let Some(scratch) = with_durand_eds("vcmaster") else { return };
    let eds = scratch.write("io401.eds", IO401);
    let candump = Witness::candump(&[]);
    // Interpreters start while other things do.
    let [mut first, mut second] = [10, 11].map(|node| python_slave(VCAN, &eds, node));
    let mut third = durand(VCAN, 12, [12]);
    let devices =
        [BUS, &slave("n2", 2, &format!("serial_number = 7\n{HELD}")), &slave("n3", 3, HELD)].concat();
    let mut nodes = timed("our nodes", || Stack::up("vcnodes", &devices, &[]));
    timed("interpreters", || {
        first.says("ready");
        second.says("ready");
        third.says("ready");
    });
    let mut master = Stack::spawn_in("vcmaster", &[BUS, MASTER].concat(), scratch, &[]);
    timed("boot", || {
        states(&master, &["%IB30", "%IB31", "%IB32", "%IB33", "%IB34"], 5);
        first.says("written 2001:00 feca0000");
        first.says("operational 0xcafe");
    });
    booted(&candump.frames());
    timed("exchange", || exchanges(&master, &PAIRS));
    timed("order", || order(&master, &candump));
    timed("SDO", || sdo(&master, &candump));
    timed("emergencies", || emergencies(&master, &candump, &mut first));
    timed("loss and return", || comes_and_goes(&nodes, &master, &candump, first, &mut second));
    assert_eq!(master.take_down(), 0, "{}", master.log());
    assert_eq!(nodes.take_down(), 0, "{}", nodes.log());
    for (stack, peers) in [(&master, 5), (&nodes, 2)] {
        let log = stack.log();
        let sum = log.lines().find(|l| l.contains(" in all: ")).unwrap_or_else(|| panic!("no sum in\n{log}"));
        assert!(sum.contains(" 0 dropped by the kernel, "), "{peers} nodes: {sum}");
    }
}

/// The master's cold start resets everybody, at once or one by one; after a node's boot-up message its identity is read, and after that it is
/// started. A node may answer before its boot-up message, which has a higher identifier: then it is asked again.
fn booted(frames: &[String]) {
    for node in [2u8, 3, 10, 11] {
        let place = |reset: String| frames.iter().position(|f| *f == reset);
        let reset = place("000#8200".to_owned()).or_else(|| place(format!("000#82{node:02X}")));
        let mut at = reset.unwrap_or_else(|| panic!("node {node} was not reset: {frames:?}"));
        // The EDS names no vendor; the product code is the first that is compared.
        for wanted in [
            format!("7{node:02X}#00"),
            format!("6{node:02X}#40181002"),
            format!("5{:02X}#43181002", 0x80 + node),
            format!("000#01{node:02X}"),
        ] {
            let found = frames[at..].iter().position(|f| f.starts_with(&wanted));
            at += found.unwrap_or_else(|| panic!("no {wanted} after {at} in {frames:?}"));
        }
    }
}

/// What the stack receives is what was on the wire, own frames in their places: the SYNC before its PDOs.
fn order(master: &Stack, candump: &Witness) {
    let dump = Witness::of_stack(master);
    cansend("6FF#01");
    candump.hears("6FF#01");
    // Enough of everything between the marks.
    let marked = candump.frames().len();
    let heard = |id: &str, times: usize| {
        let frames = candump.frames().split_off(marked);
        frames.iter().filter(|f| f.starts_with(id)).count() >= times
    };
    wait_for("SYNCs and answers to node guarding", LONG, || {
        (heard("080#", 40) && heard("703#", 8) && heard("70B#", 8)).then_some(())
    });
    wait_for("the mark in the dump", LONG, || (dump.frames().iter().any(|f| f == "6FF#01")).then_some(()));
    cansend("6FF#02");
    let wire = candump.between("6FF#01", "6FF#02");
    let ours = dump.between("6FF#01", "6FF#02");
    let differs = wire.iter().zip(&ours).position(|(a, b)| a != b);
    assert!(differs.is_none() && wire.len() == ours.len(), "at {differs:?}\n{wire:?}\n{ours:?}");
    // Synchronous PDOs, the master's and the nodes': at any time not more than SYNCs, so each comes after its own.
    let from = wire.iter().position(|f| f == "080#").unwrap();
    for id in ["182#", "202#", "18A#", "20A#", "282#", "302#"] {
        let (mut syncs, mut pdos, mut most) = (0, 0, 0);
        for frame in &wire[from..] {
            syncs += i32::from(frame == "080#");
            pdos += i32::from(frame.starts_with(id));
            most = most.max(pdos - syncs);
        }
        assert!(most <= 0, "{id} before its SYNC: {wire:?}");
        assert!(pdos >= 20, "{id} {pdos} times: {wire:?}");
    }
    // On request: never without one, and each is answered.
    for node in ["83", "8B"] {
        let (asked, answer) = (format!("1{node}#R"), format!("1{node}#"));
        let mut open = 0;
        let mut answers = 0;
        for frame in &wire {
            if frame.starts_with(&asked) {
                open += 1;
            } else if frame.starts_with(&answer) {
                (open, answers) = (open - 1, answers + 1);
                assert!(open >= -1, "1{node} unasked: {wire:?}");
            }
        }
        assert!(answers >= 5, "{wire:?}");
    }
    guarding(&wire);
}

/// Node guarding: remote frames, answers with a toggle bit.
fn guarding(wire: &[String]) {
    for node in ["703", "70B"] {
        let of_node: Vec<&str> = wire.iter().filter_map(|f| f.strip_prefix(node)).collect();
        assert!(of_node.iter().any(|f| f.starts_with("#R")), "{wire:?}");
        let states: Vec<&str> = of_node.into_iter().filter(|f| !f.starts_with("#R")).collect();
        assert!(states.len() >= 3, "{states:?}");
        assert!(states.iter().all(|s| ["#05", "#85"].contains(s)), "{states:?}");
        assert!(states.windows(2).all(|w| w[0] != w[1]), "{states:?}");
    }
}

/// Expedited, segmented, block; the wire shows that they were.
fn sdo(master: &Stack, candump: &Witness) {
    for (node, serial) in [("2", 7), ("10", 10), ("12", 12)] {
        let said = master.ok(&["canopen", "sdo", "read", node, "1018:04"]);
        assert!(said.trim().ends_with(&format!(" = {serial}")), "{said}");
    }
    candump.hears("602#40181004");
    candump.hears("582#4318100407000000");
    for node in ["2", "10"] {
        there_and_back(master, node, 1000, "segmented");
    }
    // Size given, 1000 bytes.
    for start in ["602#21002000E8030000", "582#60002000", "582#41002000E8030000", "60A#21002000E8030000"] {
        candump.hears(start);
    }
    for node in ["2", "12"] {
        there_and_back(master, node, 10_240, "block");
    }
    // Both sides with CRC, size given: 10,240 bytes.
    for start in ["602#C600200000280000", "582#A4002000", "602#A4002000", "582#C600200000280000"] {
        candump.hears(start);
        candump.hears(&start.replacen("02#", "0C#", 1).replacen("82#", "8C#", 1));
    }
}

fn emergencies(master: &Stack, candump: &Witness, first: &mut Peer) {
    first.tell("emcy");
    log_has(master, "node 10 (Simulated I/O) reports emergency 3110h, voltage; error register 05h");
    candump.hears("08A#103105");
    first.tell("emcy gone");
    log_has(master, "node 10 (Simulated I/O) reports that its error is gone");
    // A PDO that is too short; the next ones of the master are right again.
    cansend("202#01");
    log_has(
        master,
        "node 2 (Simulated I/O) reports emergency 8210h, PDO not processed because of its length",
    );
    log_has(master, "node 2 (Simulated I/O) reports that its error is gone");
    candump.hears("082#108211");
    candump.hears("082#000000");
}

/// Killed nodes, and one that is silent: told, and booted again when they return.
fn comes_and_goes(nodes: &Stack, master: &Stack, candump: &Witness, first: Peer, second: &mut Peer) {
    nodes.kill("n2", Signal::KILL);
    drop(first);
    second.tell("quiet");
    for (node, what) in [
        (2, "sends no heartbeat any more"),
        (10, "sends no heartbeat any more"),
        (11, "does not answer node guarding any more"),
    ] {
        log_has(master, &format!("node {node} (Simulated I/O) is lost: it {what}"));
    }
    states(master, &["%IB30", "%IB32", "%IB33"], 0);
    // The others go on.
    states(master, &["%IB31", "%IB34"], 5);
    let (boot_ups, starts) = (candump.count("702#00"), candump.count("000#0102"));
    nodes.ok(&["restart", "n2"]);
    let mut first = python_slave(VCAN, &master.scratch.0.join("io401.eds"), 10);
    second.tell("speak");
    first.says("operational 0xcafe");
    states(master, &["%IB30", "%IB31", "%IB32", "%IB33", "%IB34"], 5);
    exchanges(master, &PAIRS);
    assert!(candump.count("702#00") > boot_ups, "{:?}", candump.frames());
    assert!(candump.count("000#0102") > starts, "{:?}", candump.frames());
    let nodes_of = status(master).unwrap()["nodes"].clone();
    for node in [2, 10, 11] {
        let row = nodes_of.as_array().unwrap().iter().find(|n| n["id"] == node).unwrap();
        assert!(row["losses"].as_u64().unwrap_or(0) >= 1, "node {node}: {nodes_of}");
    }
}

#[test]
fn python_canopen_as_master_drives_our_devices_over_the_kernel() {
    in_guest("python_canopen_as_master_drives_our_devices_over_the_kernel", python_master);
}

fn python_master() {
    let Some(mut command) = peer("canopen_master.py") else { return };
    let scratch = Scratch::new("vcdevices");
    let eds = scratch.write("io401.eds", IO401);
    scratch.write("main.st", DEVICE_PROGRAM);
    let candump = Witness::candump(&[]);
    let mut stack = Stack::spawn_in("vcdevices", &[BUS, DEVICES].concat(), scratch, &[]);
    timed("our devices", || stack.wait_ready());
    let parts = ["nmt", "heartbeat_consumer", "sdo", "pdo", "rtr", "device"];
    command.args(["socketcan", VCAN]).arg(eds).args(parts);
    let mut master = Peer::start(command);
    for part in &parts[..5] {
        timed(part, || master.says(part));
    }
    timed("device", || {
        master.says("stop the plc");
        stack.ok(&["plc", "stop"]);
        master.says("start the plc");
        stack.ok(&["plc", "run"]);
        master.says("device");
        master.ends();
    });
    // What the wire shows: block transfer with CRC both ways, a PDO on request, guarding, emergencies of both devices.
    for start in [
        "602#C6002000",
        "582#A4002000",
        "602#A4002000",
        "582#C6002000",
        "182#R",
        "702#R",
        "082#108211",
        "085#10FF",
    ] {
        candump.hears(start);
    }
    assert_eq!(stack.take_down(), 0, "{}", stack.log());
}

#[test]
fn eight_devices_get_node_ids_and_one_a_megabyte_over_the_kernel() {
    in_guest("eight_devices_get_node_ids_and_one_a_megabyte_over_the_kernel", eight_devices);
}

fn eight_devices() {
    const ALONE: &str = "\n[[service]]\nname = \"io\"\nkind = \"canopen-master\"\nsdo_timeout = \"2s\"\n";
    let text = [BUS, ALONE, &eight_without_node_id()].concat();
    let mut stack = timed("eight devices", || Stack::up("vceight", &text, &[]));
    // Eight processes answer on one processor.
    timed("fastscan", || fastscan_finds_eight(&stack, 10, 1, &["--timeout", "200"]));
    let scanned = stack.ok(&["canopen", "scan"]);
    assert!((10..=17).all(|node| scanned.lines().any(|l| l.starts_with(&node.to_string()))), "{scanned}");
    assert_eq!(stack.take_down(), 0, "{}", stack.log());
    // Frames that seven others would look at, too, take three times as long here.
    let text = [BUS, ALONE, &slave("device", 10, "serial_number = 1")].concat();
    let mut stack = timed("one device", || Stack::up("vcone", &text, &[]));
    // Of each direction what the receiver says is heard: 1200 frames of 150,000.
    let value = long_value(1 << 20);
    let server = Witness::candump(&["58A"]);
    timed("a megabyte there", || there(&stack, "10", &value, "block"));
    // With CRC, and sub-blocks of 127 segments; 149,797 segments are 1180 sub-blocks.
    server.hears("58A#A4002000");
    server.hears("58A#A100000000000000");
    assert!(server.count("58A#A27F7F") >= 1179, "{}", server.count("58A#A2"));
    drop(server);
    let client = Witness::candump(&["60A"]);
    timed("and back", || back(&stack, "10", &value, "block"));
    client.hears("60A#A40020007F");
    client.hears("60A#A100000000000000");
    assert!(client.count("60A#A27F7F") >= 1179, "{}", client.count("60A#A2"));
    assert_eq!(stack.take_down(), 0, "{}", stack.log());
}
