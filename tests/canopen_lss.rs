//! LSS, EMCY, boot state and TIME by way of the running services, with python-canopen and python-can on the other side.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod support;

use serde_json::Value;
use std::fs;
use support::canopen::{slave, wait_operational, wait_said};
use support::peers::{Peer, peer};
use support::{Stack, free_port};

/// A virtual bus of 1 Mbit/s with a server for foreign programs.
fn bus(port: &str) -> String {
    format!(
        r#"
[stack]
name = "NAME"

[[service]]
name = "can0"
kind = "can"
backend = "virtual"
bitrate = "1M"
serve = {{ cannelloni = "127.0.0.1:{port}" }}
"#
    )
}

fn python(port: &str, arguments: &[&str]) -> Option<Peer> {
    let mut command = peer("canopen_lss.py")?;
    command.arg(port).args(arguments);
    Some(Peer::start(command))
}

fn master(nodes: &[u8], more: &str) -> String {
    let nodes: String = nodes
        .iter()
        .map(|id| format!("\n[[service.node]]\nid = {id}\neds = \"io401.eds\"\nheartbeat = \"100ms\"\nmandatory = false\n"))
        .collect();
    format!("\n[[service]]\nname = \"io\"\nkind = \"canopen-master\"\nsdo_timeout = \"2s\"\n{more}\n{nodes}")
}

/// Starts a stack whose master is not whole for want of nodes, and waits until it answers.
fn up(name: &str, text: &str) -> Stack {
    let stack = Stack::spawn(name, text, &EDS);
    stack
        .wait("an answer of the master", || stack.cli(&["canopen", "status"]).status.success().then_some(()));
    stack
}

const EDS: [(&str, &str); 1] = [("io401.eds", support::canopen::IO401)];

#[test]
fn a_running_master_gives_node_ids_to_all_devices_without_one() {
    let port = free_port().to_string();
    if peer("canopen_lss.py").is_none() {
        return;
    }
    let device =
        |n: u8| slave(&format!("d{n}"), 255, &format!("store = \"d{n}.store\"\nserial_number = {n}"));
    let text = format!("{}{}{}{}", bus(&port), device(1), device(2), master(&[10, 11], ""));
    let mut stack = up("colssjob", &text);
    let mut foreign = python(&port, &["slave", "0x7FFFFFFF", "0x12345678", "3", "0xCAFE"]).unwrap();
    foreign.says("here");
    let someone = "at least one device without node-id answers";
    assert_eq!(stack.ok(&["canopen", "lss", "identify"]).trim(), someone);
    // Two at once: one waits for the other.
    std::thread::scope(|scope| {
        let both = [(), ()].map(|()| scope.spawn(|| stack.ok(&["canopen", "lss", "identify"])));
        assert!(both.into_iter().all(|one| one.join().unwrap().trim() == someone));
    });
    let found = stack.ok(&["canopen", "lss", "fastscan", "--from", "10", "--store"]);
    let lines: Vec<&str> = found.lines().collect();
    assert_eq!(lines.len(), 3, "{found}");
    for (line, end) in lines.iter().zip([
        "serial 0x00000001  -> node-id 10",
        "serial 0x00000002  -> node-id 11",
        "vendor 0x7FFFFFFF  product 0x12345678  revision 0x00000003  serial 0x0000CAFE  -> node-id 12",
    ]) {
        assert!(line.ends_with(end), "{found}");
    }
    foreign.says("stored 12");
    foreign.says("node-id 12");
    // It was the master that did it, and its nodes boot when they have their node-ids.
    wait_operational(&stack, &[10, 11]);
    wait_said(&stack, "io", "a device with node-id 12 booted, but the stack file has no such node");
    for (file, id) in [("d1.store.lss", "10"), ("d2.store.lss", "11")] {
        assert_eq!(fs::read_to_string(stack.scratch.0.join(file)).unwrap().trim(), id);
    }
    one_device(&stack, &mut foreign);
    assert_eq!(stack.take_down(), 0, "{}", stack.log());
}

/// Services for one device by its identity; the words are the same from master and command.
fn one_device(stack: &Stack, foreign: &mut Peer) {
    let lss = |verb: &[&str], identity: &[&str], more: &[&str]| {
        let arguments = [&["canopen", "lss"], verb, identity, more].concat();
        let output = stack.cli(&arguments);
        let text = if output.status.success() { output.stdout } else { output.stderr };
        (output.status.code(), String::from_utf8(text).unwrap())
    };
    let foreign_one =
        ["--vendor", "0x7FFFFFFF", "--product", "0x12345678", "--revision", "3", "--serial", "0xCAFE"];
    let nobody = ["--vendor", "1", "--product", "2", "--revision", "3", "--serial", "4"];
    for direct in [&[][..], &["--direct"]] {
        let (code, text) = lss(&["inquire"], &foreign_one, direct);
        assert!(code == Some(0) && text.trim().ends_with("it has node-id 12"), "{code:?} {text}");
        let (code, text) = lss(&["inquire"], &nobody, direct);
        assert!(code == Some(1) && text.contains("no device has vendor 0x00000001"), "{code:?} {text}");
        let (code, text) = lss(&["identify"], &[], direct);
        assert_eq!((code, text.trim()), (Some(0), "no device without node-id answers"));
    }
    let (code, text) = lss(&["set-bitrate", "250"], &foreign_one, &["--store", "--activate", "300"]);
    assert_eq!((code, text.trim()), (Some(0), "the device changes over to 250 kbit/s"));
    foreign.says("bit timing 3");
    foreign.says("stored 12");
    foreign.says("activate after 300 ms");
    // Our device knows no other bit rate than that of its bus.
    let ours = ["--vendor", "0", "--product", "0x401", "--revision", "0x10000", "--serial", "2"];
    let (code, text) = lss(&["set-bitrate", "250"], &ours, &[]);
    assert!(code == Some(1) && text.contains("setting the bit rate: the device refused"), "{code:?} {text}");
    let (code, text) = lss(&["set-bitrate", "300"], &ours, &[]);
    assert!(code == Some(2) && text.contains("LSS has no bit rate of 300 kbit/s"), "{code:?} {text}");
}

#[test]
fn emergencies_and_boot_states_are_shown() {
    let text = format!("{}{}{}", support::canopen::BUS, slave("d1", 10, ""), master(&[10, 11], ""));
    let mut stack = up("coemcy", &text);
    wait_operational(&stack, &[10]);
    assert_eq!(stack.ok(&["canopen", "emcy"]).trim(), "no emergency messages seen");
    let sent = stack.ok(&["canopen", "emcy", "send", "0x4210", "--register", "8", "--data", "0102"]);
    assert_eq!(sent.trim(), "sent; the error register is 09h now");
    let entry = || -> Option<Value> {
        let nodes: Value = serde_json::from_str(&stack.ok(&["canopen", "emcy", "10", "--json"])).unwrap();
        nodes[0]["entries"].get(0).cloned()
    };
    let told = stack.wait("the emergency", entry);
    assert_eq!(
        (&told["code"], &told["text"], &told["data"]),
        (&"4210h".into(), &"temperature".into(), &"0102000000".into())
    );
    assert_eq!(told["bits"], serde_json::json!(["generic", "temperature"]));
    assert_eq!(told.get("reset_by"), None);
    let shown = stack.ok(&["canopen", "emcy"]);
    assert!(shown.contains("4210h temperature") && shown.contains("09h generic, temperature"), "{shown}");
    let twice = stack.cli(&["canopen", "emcy", "send", "0x4210"]);
    assert!(String::from_utf8_lossy(&twice.stderr).contains("is there already"));
    let reset = stack.ok(&["canopen", "emcy", "reset", "0x4210"]);
    assert_eq!(reset.trim(), "1 errors reset; the error register is 00h now");
    stack.wait("the reset", || (entry()?["reset_by"] == "error-reset").then_some(()));
    assert_eq!(stack.ok(&["canopen", "emcy", "10", "--clear"]).trim(), "1 messages forgotten");
    assert_eq!(stack.ok(&["canopen", "emcy"]).trim(), "no emergency messages seen");
    // One node is booted, the other is not there.
    let state: Value = serde_json::from_str(&stack.ok(&["canopen", "boot-state", "10", "--json"])).unwrap();
    assert_eq!((&state[0]["booted"], &state[0]["step"]), (&true.into(), &"booted".into()), "{state}");
    assert!(state[0]["tries"].as_u64() >= Some(1) && state[0]["took_ms"].is_u64(), "{state}");
    stack.wait("letter B of node 11", || {
        let shown = stack.ok(&["canopen", "boot-state"]);
        shown.contains("node 11: boot-up failed with letter B").then_some(())
    });
    assert_eq!(stack.take_down(), 0, "{}", stack.log());
}

#[test]
fn python_canopen_sets_bit_timing_and_time() {
    let port = free_port().to_string();
    if peer("canopen_lss.py").is_none() {
        return;
    }
    let text = format!("{}{}", bus(&port), slave("d1", 3, "store = \"d1.store\"\nserial_number = 77"));
    let mut stack = Stack::up("colsspy", &text, &[]);
    let mut python_master = python(&port, &["bit_timing", "3", "0", "0x401", "0x10000", "77"]).unwrap();
    python_master.says("bit_timing");
    python_master.ends();
    assert_eq!(fs::read_to_string(stack.scratch.0.join("d1.store.lss")).unwrap().trim(), "3");
    let mut python_time = python(&port, &["time", "3"]).unwrap();
    python_time.says("time");
    python_time.ends();
    stack.wait("the consumed TIME", || {
        stack.ok(&["status", "d1", "--json"]).contains("1893456000250").then_some(())
    });
    assert_eq!(stack.take_down(), 0, "{}", stack.log());
}

#[test]
fn the_time_of_our_master_is_read_by_python() {
    let port = free_port().to_string();
    if peer("canopen_lss.py").is_none() {
        return;
    }
    let consumes = "sdo = [{ object = \"1012:00\", value = 0x80000100 }]";
    let text = format!(
        "{}{}{}{consumes}\n",
        bus(&port),
        slave("d1", 3, ""),
        master(&[3], "time_period = \"100ms\"")
    );
    let mut stack = up("cotime", &text);
    let mut reader = python(&port, &["read_time"]).unwrap();
    reader.says("read_time");
    reader.ends();
    // And our own device takes it.
    wait_operational(&stack, &[3]);
    let this_year = |text: &str| {
        let digits = text.split("\"time_utc_ms\":").nth(1)?.trim_start();
        let ms: i64 = digits.split(|c: char| !c.is_ascii_digit()).next()?.parse().ok()?;
        let now = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).ok()?;
        (i64::try_from(now.as_millis()).ok()?.abs_diff(ms) < 20_000).then_some(())
    };
    stack.wait("the TIME in the device", || this_year(&stack.ok(&["status", "d1", "--json"])));
    assert_eq!(stack.take_down(), 0, "{}", stack.log());
}
