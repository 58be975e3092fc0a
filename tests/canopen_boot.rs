//! A CANopen network whose nodes are wrong, die and come back: what is done about it, and what the user is shown.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod support;

use rustix::process::Signal;
use serde_json::Value;
use support::canopen::{
    BUS, ErrorControl, HELD, IO401, node, object, said, slave, status, wait_operational, wait_said,
    wait_said_times, wait_state,
};
use support::{Stack, free_port, recorded_events};

const MASTER: &str = r#"
[[service]]
name = "io"
kind = "canopen-master"
sync_period = "20ms"
"#;

const PLC: &str = r#"
[[service]]
name = "plc"
kind = "plc"
program = ["main.st"]
cycle = "10ms"
"#;

const PROGRAM: &str = r"
PROGRAM main
VAR
  Pattern AT %MB0 : USINT := 90;
  Scans AT %MW2 : UINT;
  State AT %IB30 : USINT;
  Quality AT %IB40 : USINT;
END_VAR
  Scans := Scans + 1;
  Lamps := Pattern;
  Remote := Pattern;
END_PROGRAM
";

/// Two nodes; the first shows its lamps at its buttons.
const NODES: &str = r#"
[[service.node]]
id = 2
eds = "io401.eds"
mandatory = true
heartbeat = "100ms"
status_to = "%IB30"
map = [
    { object = "6000:01", to = "%IB0", symbol = "Buttons", status_to = "%IB40" },
    { object = "6200:01", from = "%QB0", symbol = "Lamps" },
]

[[service.node]]
id = 3
eds = "io401.eds"
mandatory = true
heartbeat = "100ms"
map = [{ object = "6200:01", from = "%QB1", symbol = "Remote" }]
"#;

fn network(name: &str, master: &str) -> Stack {
    let nodes = [slave("n2", 2, HELD), slave("n3", 3, HELD)].concat();
    let toml = [BUS, &nodes, MASTER, master, NODES, PLC].concat();
    let stack = Stack::up(name, &toml, &[("main.st", PROGRAM), ("io401.eds", IO401)]);
    wait_operational(&stack, &[2, 3]);
    wait_exchange(&stack);
    stack
}

/// Outputs reach the nodes, and their inputs the program.
fn wait_exchange(stack: &Stack) {
    stack.wait("inputs that follow the outputs", || {
        let pattern = stack.read("Pattern").as_u64()?;
        let good = stack.read("Quality") == 0 && stack.read("State") == 5;
        (good && stack.read("Buttons") == pattern).then_some(())
    });
}

/// Only nodes, of which a mandatory one does not boot: never ready.
fn troubled(name: &str, slaves: &[String], master: &str) -> Stack {
    let toml = [BUS, &slaves.concat(), MASTER, master].concat();
    Stack::spawn(name, &toml, &[("io401.eds", IO401)])
}

fn expected_node(id: u8, more: &str) -> String {
    format!("\n[[service.node]]\nid = {id}\neds = \"io401.eds\"\nheartbeat = \"100ms\"\n{more}\n")
}

#[test]
fn missing_and_wrong_devices_are_named_with_letter_expected_and_got() {
    let slaves: Vec<String> =
        [2, 3, 4, 5, 6, 7, 20].iter().map(|&id| slave(&format!("n{id}"), id, "serial_number = 77")).collect();
    let wrong = [
        (2, "vendor_id = \"0xBAD\"", "letter D: its vendor (1018h:01)", "expected 0x00000BAD, it has 0x"),
        (3, "product_code = 9999", "letter M: its product code (1018h:02)", "expected 0x0000270F, it has 0x"),
        (4, "revision = \"0x90009\"", "letter N: its revision (1018h:03)", "expected 0x00090009, it has 0x"),
        (5, "serial_number = 78", "letter O: its serial number (1018h:04)", "0x0000004E, it has 0x0000004D"),
        (6, "device_type = \"0x192\"", "letter C: its device type (1000h)", "0x00000192, it has 0x"),
    ];
    let mut master = "boot_time = \"3s\"\nsdo_timeout = \"100ms\"\n".to_owned();
    for (id, key, ..) in wrong {
        master += &expected_node(id, key);
    }
    master += &expected_node(7, "mandatory = true");
    master += &expected_node(9, "mandatory = true");
    let mut stack = troubled("wrongdev", &slaves, &master);
    for (id, _, letter, values) in wrong {
        let failure = stack.wait(&format!("why node {id} does not boot"), || {
            node(&stack, id)?["failure"].as_str().map(str::to_owned)
        });
        assert!(failure.contains(letter) && failure.contains(values), "{failure}");
        wait_said(&stack, "io", &format!("node {id} (Simulated I/O): boot-up failed with {letter}"));
    }
    wait_operational(&stack, &[7]);
    wait_said(&stack, "io", "node 9 (Simulated I/O): boot-up failed with letter B: it does not answer");
    wait_said(
        &stack,
        "io",
        "node 9 (Simulated I/O) is mandatory and not booted in time; the network is incomplete",
    );
    wait_said(
        &stack,
        "io",
        "a device with node-id 20 booted, but the stack file has no such node (letter A)",
    );
    let shown = stack.ok(&["canopen", "status"]);
    assert!(shown.starts_with("io, node 1, pre-operational: not complete\n"), "{shown}");
    assert!(shown.contains("node 9: boot-up failed with letter B: "), "{shown}");
    assert_eq!(stack.service("io").unwrap()["health"], "degraded");
    // The same trouble is told once, however often it is tried.
    stack.wait("three tries", || {
        let failure = node(&stack, 2)?["failure"].as_str()?.to_owned();
        ["try 1", "try 2,"].iter().all(|t| !failure.contains(t)).then_some(())
    });
    assert_eq!(
        said(&stack, "io").matches("boot-up failed with letter D").count(),
        1,
        "{}",
        said(&stack, "io")
    );
    assert_eq!(stack.take_down(), 0);
}

#[test]
fn a_configuration_with_the_right_date_is_not_loaded_again() {
    let slaves = [slave("n2", 2, "store = \"n2.store\"")];
    let master = expected_node(
        2,
        "mandatory = true\nconfig_date = 100\nconfig_time = 200\nsdo = [{ object = \"2001\", value = 42 }]",
    );
    let mut stack = troubled("confdate", &slaves, &master);
    wait_operational(&stack, &[2]);
    let is = |what: &str, value: &str| {
        stack.wait(&format!("{what} = {value}"), || (object(&stack, 2, what)? == value).then_some(()));
    };
    let boot = |times: usize| {
        stack.ok(&["canopen", "boot", "2"]);
        wait_said_times(&stack, "io", "node 2 (Simulated I/O) is booted", times);
    };
    let loaded = |had: &str| {
        let text = "node 2 (Simulated I/O) is booted; its configuration was loaded: ";
        wait_said(&stack, "io", &format!("{text}{had}, 100 and 200 are expected"));
    };
    let write = |what: &str, value: &str| stack.ok(&["canopen", "sdo", "write", "2", what, value]);
    let save = || stack.ok(&["canopen", "sdo", "write", "2", "1010:01", "0x65766173"]);
    // A new device has no date: it was loaded.
    is("2001", "42");
    loaded("it was never configured, or was changed since (date and time are 0 in 1020h)");
    is("1020:01", "100");
    is("1020:02", "200");
    // The device keeps its configuration, date and all. A value that the download would change stays.
    save();
    write("2001", "7");
    boot(2);
    is("2001", "7");
    assert_eq!(said(&stack, "io").matches("its configuration was loaded").count(), 1);
    // Another time, or another date: loaded.
    write("1020:02", "201");
    save();
    write("2001", "8");
    boot(3);
    loaded("it had date 100 and time 201 (1020h)");
    is("2001", "42");
    is("1020:02", "200");
    write("1020:01", "99");
    save();
    write("2001", "9");
    boot(4);
    loaded("it had date 99 and time 200 (1020h)");
    is("2001", "42");
    assert_eq!(stack.take_down(), 0);
}

#[test]
fn a_node_that_dies_while_it_is_configured_is_named_and_booted_when_it_is_back() {
    // Slow enough that the configuration takes seconds.
    let bus = format!("{BUS}bitrate = \"50k\"\npace = true\n");
    let writes: Vec<String> = (0..800).map(|i| format!("{{ object = \"2001\", value = {i} }}")).collect();
    let node2 = expected_node(2, &format!("mandatory = true\nsdo = [{}]", writes.join(", ")));
    let toml = [bus.as_str(), &slave("n2", 2, HELD), MASTER, &node2]
        .concat()
        .replace("sync_period = \"20ms\"\n", "");
    let mut stack = Stack::spawn("middown", &toml, &[("io401.eds", IO401)]);
    stack.wait("the download", || (node(&stack, 2)?["boot"] == "loading its configuration").then_some(()));
    stack.kill("n2", Signal::KILL);
    wait_said(
        &stack,
        "io",
        "node 2 (Simulated I/O): boot-up failed with letter J: its configuration could not be loaded (at 2001:00 Scratch \
         value) (the node did not answer in time: did it die?); try ",
    );
    // It stays away: now it does not even tell its device type.
    stack.wait("letter B", || (node(&stack, 2)?["letter"] == "B").then_some(()));
    stack.ok(&["restart", "n2"]);
    wait_operational(&stack, &[2]);
    assert_eq!(object(&stack, 2, "2001").as_deref(), Some("799"));
    assert!(node(&stack, 2).unwrap().get("failure").is_none(), "an old failure is no news");
    assert_eq!(stack.take_down(), 0);
}

#[test]
fn two_devices_with_one_node_id_are_told_by_device_and_master() {
    let recorder = "\n[[service]]\nname = \"rec\"\nkind = \"recorder\"\ndir = \"recordings\"\n".to_owned();
    let slaves = [
        slave("n5a", 5, "serial_number = 1"),
        slave("n5b", 5, "serial_number = 2"),
        slave("n6", 6, ""),
        recorder,
    ];
    let master = expected_node(5, "") + &expected_node(6, "mandatory = true");
    let mut stack = troubled("twins", &slaves, &master);
    wait_operational(&stack, &[6]);
    wait_said(&stack, "io", "two devices seem to have node-id 5");
    wait_said(&stack, "n5a", "another device on the bus has node-id 5 too");
    wait_said(&stack, "n5b", "another device on the bus has node-id 5 too");
    assert!(!said(&stack, "n6").contains("another device"), "{}", said(&stack, "n6"));
    assert!(!said(&stack, "io").contains("two devices seem to have node-id 6"), "{}", said(&stack, "io"));
    assert_eq!(stack.take_down(), 0);
    // Everybody on the rail was told, too.
    let events = recorded_events(&stack);
    let twins = |service: &str, text: &str, level: &str| {
        let told = |e: &Value| {
            e["service"] == service && e["level"] == level && e["message"].as_str().unwrap().contains(text)
        };
        assert!(events.iter().any(told), "{service}: {text}: {events:#?}");
    };
    twins("io", "two devices seem to have node-id 5", "fault");
    twins("n5a", "another device on the bus has node-id 5 too", "fault");
    twins("n5b", "another device on the bus has node-id 5 too", "fault");
}

#[test]
fn a_node_is_pulled_its_inputs_are_stale_and_good_again_when_it_is_back() {
    let mut stack = network("pulled", "");
    stack.kill("n2", Signal::KILL);
    stack.wait("stale inputs", || (stack.read("Quality") == 1).then_some(()));
    stack.wait("state unknown to the program", || (stack.read("State") == 0).then_some(()));
    assert_eq!(stack.read("Buttons"), 90, "a bad input is held");
    wait_said(&stack, "io", "node 2 (Simulated I/O) is lost: it sends no heartbeat any more");
    assert_eq!(node(&stack, 2).unwrap()["state"], "unknown");
    let shown = stack.ok(&["canopen", "status"]);
    assert!(shown.starts_with("io, node 1, operational: a mandatory node is missing\n"), "{shown}");
    stack.wait("a degraded master", || (stack.service("io")?["health"] == "degraded").then_some(()));
    // The other one goes on.
    assert_eq!(node(&stack, 3).unwrap()["operational"], true);
    stack.ok(&["plc", "write", "Pattern=17"]);
    stack.wait("node 3 follows", || (object(&stack, 3, "6200:01")? == "17").then_some(()));
    stack.ok(&["restart", "n2"]);
    wait_operational(&stack, &[2, 3]);
    wait_exchange(&stack);
    assert_eq!(stack.read("Buttons"), 17);
    wait_said_times(&stack, "io", "node 2 (Simulated I/O) is booted", 2);
    assert_eq!(node(&stack, 2).unwrap()["losses"], 1);
    assert_eq!(said(&stack, "io").matches("node 3 (Simulated I/O) is booted").count(), 1);
    assert_eq!(stack.take_down(), 0);
}

#[test]
fn a_restarted_master_takes_the_running_network_over_and_boots_what_does_not_run() {
    let mut stack = network("takeover", "");
    stack.ok(&["canopen", "nmt", "preop", "3"]);
    wait_state(&stack, 3, "pre-operational");
    let watch = ErrorControl::watch(&stack);
    let generation = stack.generation("io");
    stack.kill("io", Signal::KILL);
    stack.wait_generation_above("io", generation);
    wait_operational(&stack, &[2, 3]);
    wait_exchange(&stack);
    wait_said(&stack, "io", "node 2 (Simulated I/O) was running already and is left running");
    let before = said(&stack, "n2").matches("the device is ").count();
    assert_eq!((watch.boot_ups(2), watch.boot_ups(3)), (0, 1), "{:?}", watch.frames());
    // Node 2 was operational in every heartbeat, however long the master was away.
    assert!(watch.frames().iter().all(|f| !f.starts_with("702#") || f == "702#05"), "{:?}", watch.frames());
    assert_eq!(said(&stack, "n2").matches("the device is ").count(), before);
    // And once more, with all of them at work.
    let generation = stack.generation("io");
    stack.kill("io", Signal::KILL);
    stack.wait_generation_above("io", generation);
    wait_operational(&stack, &[2, 3]);
    wait_exchange(&stack);
    assert_eq!((watch.boot_ups(2), watch.boot_ups(3)), (0, 1), "{:?}", watch.frames());
    drop(watch);
    assert_eq!(stack.take_down(), 0);
}

#[test]
fn nodes_without_a_master_do_what_they_are_told_to() {
    // Without a heartbeat of the master for three of its periods: node 2 goes to pre-operational, node 3 stays
    // (1029h:01).
    let nodes = NODES.replacen("id = 3\n", "id = 3\nsdo = [{ object = \"1029:01\", value = 1 }]\n", 1);
    let toml = [
        BUS,
        &slave("n2", 2, HELD),
        &slave("n3", 3, HELD),
        MASTER,
        "heartbeat = \"100ms\"\n",
        HELD,
        &nodes,
        PLC,
    ]
    .concat();
    let mut stack = Stack::up("masterless", &toml, &[("main.st", PROGRAM), ("io401.eds", IO401)]);
    wait_operational(&stack, &[2, 3]);
    wait_exchange(&stack);
    let watch = ErrorControl::watch(&stack);
    stack.kill("io", Signal::KILL);
    stack.wait("node 2 pre-operational", || watch.frames().contains(&"702#7F".to_owned()).then_some(()));
    wait_said(&stack, "n2", "8130h");
    wait_said(&stack, "n3", "8130h");
    let frames = watch.frames().len();
    stack.wait("more heartbeats", || {
        let later = watch.frames().split_off(frames);
        (later.iter().filter(|f| f.starts_with("703#")).count() > 5).then_some(())
    });
    assert!(watch.frames().iter().all(|f| !f.starts_with("703#") || f == "703#05"), "{:?}", watch.frames());
    // The restarted master leaves the one running and boots the other.
    stack.ok(&["restart", "io"]);
    wait_operational(&stack, &[2, 3]);
    wait_exchange(&stack);
    wait_said(&stack, "io", "node 3 (Simulated I/O) was running already and is left running");
    assert_eq!((watch.boot_ups(2), watch.boot_ups(3)), (1, 0), "{:?}", watch.frames());
    drop(watch);
    assert_eq!(stack.take_down(), 0);
}

#[test]
fn a_new_master_keeps_alive_what_it_is_told_to() {
    // The nodes are a stack of their own, so that a master can begin from cold beside them.
    let port = free_port();
    let serve = format!("serve = {{ socketcand = \"127.0.0.1:{port}\" }}\n");
    let nodes = [BUS, &serve, &slave("n2", 2, ""), &slave("n3", 3, "")].concat();
    let mut nodes = Stack::up("keptnodes", &nodes, &[]);
    let bus = BUS.replace(
        "backend = \"virtual\"",
        &format!("backend = \"socketcand\"\ninterface = \"tcp://127.0.0.1:{port}/can0\""),
    );
    // A heartbeat so slow that no node misses its master.
    let master = [&bus, MASTER, "heartbeat = \"10s\"\n", HELD, NODES, PLC].concat();
    let begin = |toml: &str| {
        let stack = Stack::spawn("keeper", toml, &[("main.st", PROGRAM), ("io401.eds", IO401)]);
        wait_operational(&stack, &[2, 3]);
        wait_exchange(&stack);
        stack
    };
    let end = |mut stack: Stack| {
        stack.kill("io", Signal::KILL);
        stack.wait("a dead master", || (stack.service("io")?["state"] != "running").then_some(()));
        // A service that is held at the end makes the exit code 1.
        stack.take_down();
    };
    end(begin(&master));
    let watch = ErrorControl::watch(&nodes);
    // Node 2 is kept alive (1F81h bit 4), node 3 is reset.
    let stack = begin(&master.replacen("id = 2\n", "id = 2\nkeep_alive = true\n", 1));
    wait_said(&stack, "io", "node 2 (Simulated I/O) was running already and is left running");
    wait_said(&stack, "io", "node 3 (Simulated I/O) is booted");
    assert!(watch.frames().iter().all(|f| !f.starts_with("702#") || f == "702#05"), "{:?}", watch.frames());
    assert_eq!((watch.boot_ups(2), watch.boot_ups(3)), (0, 1), "{:?}", watch.frames());
    end(stack);
    // And a master that keeps nobody resets both.
    end(begin(&master));
    assert_eq!((watch.boot_ups(2), watch.boot_ups(3)), (1, 2), "{:?}", watch.frames());
    drop(watch);
    assert_eq!(nodes.take_down(), 0);
}

/// What is sent to a driver that is not there is lost: the reset of all nodes, the boot-up message of a device.
#[test]
fn master_and_devices_begin_when_the_driver_of_the_bus_is_there() {
    let bus = format!("{BUS}{HELD}\n");
    let node2 = expected_node(2, "mandatory = true");
    let toml = [bus.as_str(), &slave("n2", 2, ""), MASTER, &node2].concat();
    let mut stack = Stack::up("latedriver", &toml, &[("io401.eds", IO401)]);
    wait_operational(&stack, &[2]);
    stack.kill("can0", Signal::KILL);
    stack.wait("no driver", || (stack.service("can0")?["state"] == "held").then_some(()));
    for service in ["n2", "io"] {
        stack.ok(&["restart", service]);
        wait_said(&stack, service, "bus 'can0' has no driver yet: nothing is sent until it is there");
    }
    let before = said(&stack, "io");
    stack.ok(&["restart", "can0"]);
    for service in ["n2", "io"] {
        wait_said(&stack, service, "the driver of bus 'can0' is there, after ");
    }
    wait_operational(&stack, &[2]);
    // Nothing was lost: the first try goes well.
    assert_eq!(status(&stack).unwrap()["frames_dropped"], 0);
    let after = said(&stack, "io").split_off(before.len());
    assert!(after.contains("node 2 (Simulated I/O) is booted") && !after.contains("failed"), "{after}");
    assert_eq!(stack.take_down(), 0);
}

#[test]
fn the_bus_is_restarted_and_the_network_works_again() {
    let mut stack = network("busdies", "");
    let generation = stack.generation("can0");
    stack.kill("can0", Signal::KILL);
    stack.wait_generation_above("can0", generation);
    stack.ok(&["plc", "write", "Pattern=33"]);
    wait_operational(&stack, &[2, 3]);
    wait_exchange(&stack);
    assert_eq!(stack.read("Buttons"), 33);
    stack.wait("node 3 follows", || (object(&stack, 3, "6200:01")? == "33").then_some(()));
    let samples = || status(&stack)?["pdo"]["complete_samples"].as_u64();
    let first = stack.wait("samples", samples);
    stack.wait("more samples", || (samples()? > first + 5).then_some(()));
    assert_eq!(stack.take_down(), 0);
}

#[test]
fn a_stopped_plc_zeroes_the_outputs_and_the_nodes_stay_operational() {
    let mut stack = network("plcstop", "");
    stack.ok(&["plc", "stop"]);
    wait_said(&stack, "io", "outputs went to their safe state: the PLC is stopped");
    for id in [2, 3] {
        stack.wait("outputs zero", || (object(&stack, id, "6200:01")? == "0").then_some(()));
        assert_eq!(node(&stack, id).unwrap()["operational"], true);
    }
    stack.ok(&["plc", "run"]);
    wait_exchange(&stack);
    wait_said(&stack, "io", "outputs follow the image again");
    assert_eq!(stack.take_down(), 0);
}

#[test]
fn a_stopped_plc_sends_the_nodes_to_pre_operational_where_on_stop_says_so() {
    let mut stack = network("plcpreop", "on_stop = \"preop\"\n");
    stack.ok(&["plc", "stop"]);
    for id in [2, 3] {
        wait_state(&stack, id, "pre-operational");
    }
    // A node that boots meanwhile goes there, too.
    stack.kill("n3", Signal::KILL);
    wait_said(&stack, "io", "node 3 (Simulated I/O) is lost");
    stack.ok(&["restart", "n3"]);
    wait_said_times(&stack, "io", "node 3 (Simulated I/O) is booted", 2);
    wait_state(&stack, 3, "pre-operational");
    assert!(!said(&stack, "io").contains("instead of"), "{}", said(&stack, "io"));
    stack.ok(&["plc", "run"]);
    wait_operational(&stack, &[2, 3]);
    wait_exchange(&stack);
    assert_eq!(stack.take_down(), 0);
}
