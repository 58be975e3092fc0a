//! The CAN command line on a running stack.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod support;

use serde_json::Value;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Stdio};
use support::commands::{frames, ok, text};
use support::{Scratch, Stack, cases, dinrail};

const STACK: &str = r#"
[stack]
name = "NAME"

[[service]]
name = "rec"
kind = "recorder"
dir = "recordings"

[[service]]
name = "can0"
kind = "can"
backend = "virtual"
bitrate = "1M"

[[service]]
name = "can1"
kind = "can"
backend = "virtual"
bitrate = "1M"
"#;

/// A `can dump` whose lines go to a file, seen to be listening.
struct Dump {
    child: Child,
    path: PathBuf,
    bus: String,
}

impl Dump {
    fn start(stack: &Stack, bus: &str, name: &str) -> Self {
        let path = stack.scratch.0.join(name);
        let child = dinrail()
            .args(["can", "dump", bus, "--stack", &stack.name])
            .stdout(fs::File::create(&path).unwrap())
            .stderr(fs::File::create(path.with_extension("err")).unwrap())
            .spawn()
            .unwrap();
        let dump = Self { child, path, bus: bus.to_owned() };
        stack.wait("the dump listens", || {
            stack.ok(&["can", "send", bus, "7F0#AA"]);
            (!dump.text().is_empty()).then_some(())
        });
        dump
    }

    fn text(&self) -> String {
        fs::read_to_string(&self.path).unwrap_or_default()
    }

    /// The frames between the first frame and now, as `ID#DATA`.
    fn end(mut self, stack: &Stack) -> Vec<String> {
        stack.ok(&["can", "send", &self.bus, "7F1#BB"]);
        stack.wait("the dump saw everything", || self.text().contains("7F1#BB\n").then_some(()));
        let pid = rustix::process::Pid::from_child(&self.child);
        rustix::process::kill_process(pid, rustix::process::Signal::INT).unwrap();
        let status = self.child.wait().unwrap();
        let said = fs::read_to_string(self.path.with_extension("err")).unwrap();
        assert_eq!((status.code(), said.as_str()), (Some(0), ""));
        let frames = frames(&self.text());
        frames.into_iter().filter(|f| f != "7F0#AA" && f != "7F1#BB").collect()
    }
}

#[test]
fn generated_frames_are_dumped_recorded_and_replayed_in_their_order() {
    let mut stack = Stack::up("cancli", STACK, &[]);
    let dump = Dump::start(&stack, "can0", "gen.log");
    let gen_args = [
        "can",
        "gen",
        "can0",
        "--mix",
        "--fd",
        "--gap",
        "0",
        "--count",
        "5000",
        "--seed",
        "42",
        "--in-order",
        "--json",
    ];
    let summary: Value = serde_json::from_str(&stack.ok(&gen_args)).unwrap();
    assert_eq!((&summary["sent"], &summary["echoed"]), (&5000.into(), &5000.into()), "{summary}");
    assert_eq!(summary["out_of_order"], 0, "{summary}");
    let generated = dump.end(&stack);
    assert_eq!(generated.len(), 5000);
    // The same seed on the other bus: the same frames, whatever the order.
    let dump = Dump::start(&stack, "can1", "again.log");
    stack.ok(&["can", "gen", "can1", "--mix", "--fd", "--gap", "0", "--count", "5000", "--seed", "42"]);
    let (mut again, mut sorted) = (dump.end(&stack), generated.clone());
    again.sort();
    sorted.sort();
    assert_eq!(again, sorted);

    // The log, the same as MCAP, and the stack's own recording: each replayed on the other bus.
    let log = stack.scratch.0.join("gen.log");
    let imported = stack.scratch.0.join("imported.mcap");
    ok(&["recordings", "import", text(&log), "-o", text(&imported), "--bus", "can0"]);
    for file in [&log, &imported] {
        let dump = Dump::start(&stack, "can1", "replayed.log");
        let args = [
            "can",
            "replay",
            text(file),
            "--bus",
            "can1",
            "--no-wait",
            "--filter",
            "!7F0",
            "--filter",
            "!7F1",
        ];
        let said = stack.ok(&args);
        assert!(
            said.contains("frames sent") && said.contains("every one was seen on the bus, in order"),
            "{said}"
        );
        let replayed = dump.end(&stack);
        let kept = |frames: &[String]| -> Vec<String> {
            frames.iter().filter(|f| !f.starts_with("7F0#") && !f.starts_with("7F1#")).cloned().collect()
        };
        assert!(kept(&replayed) == kept(&generated), "{}: another order or other frames", file.display());
    }
    assert_eq!(stack.take_down(), 0);
    let recording = &stack.recordings()[0];
    let exported = frames(&ok(&["recordings", "export", text(recording), "--bus", "can0"]));
    let own: Vec<String> = exported.into_iter().filter(|f| f != "7F0#AA" && f != "7F1#BB").collect();
    assert!(own == generated, "the recording holds other frames than the dump");
    let asc = stack.scratch.0.join("all.asc");
    ok(&["recordings", "export", text(recording), "-o", text(&asc)]);
    assert!(fs::read_to_string(&asc).unwrap().contains("// channel 2 is can1\n"));
}

#[test]
fn the_car_log_is_replayed_bit_for_bit() {
    let Some(cases) = cases() else { return };
    let log = cases.join("canlogs/savvycan/examples_candump.log");
    let mut stack = Stack::up("carlog", STACK, &[]);
    let dump = Dump::start(&stack, "can1", "car.log");
    let said = stack.ok(&["can", "replay", text(&log), "--map", "vcan0=can1", "--no-wait", "--json"]);
    let said: Value = serde_json::from_str(&said).unwrap();
    assert_eq!((&said["whole"], &said["buses"]["can1"]["out_of_order"]), (&true.into(), &0.into()), "{said}");
    let expected = frames(&fs::read_to_string(&log).unwrap());
    let got = dump.end(&stack);
    assert_eq!(got.len(), expected.len());
    assert!(got == expected, "another order or other frames");
    // With its own timing, a part of it, fast.
    let begin = std::time::Instant::now();
    let args = [
        "can",
        "replay",
        text(&log),
        "--bus",
        "can0",
        "--from",
        "1s",
        "--to",
        "3s",
        "--speed",
        "2",
        "--json",
    ];
    let said: Value = serde_json::from_str(&stack.ok(&args)).unwrap();
    assert!(begin.elapsed().as_millis() >= 900, "faster than asked for: {said}");
    assert_eq!(said["whole"], true, "{said}");
    assert!(said["buses"]["can0"]["sent"].as_u64().unwrap() > 0, "{said}");
    assert_eq!(stack.take_down(), 0);
}

#[test]
fn several_buses_filters_statistics_and_changes() {
    let mut stack = Stack::up("buses", STACK, &[]);
    let spawn = |args: &[&str]| {
        dinrail()
            .args(args)
            .args(["--stack", &stack.name])
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap()
    };
    let dump = spawn(&[
        "can",
        "dump",
        "all",
        "--filter",
        "100-1FF,!1A0,7C0",
        "--count",
        "200",
        "--for",
        "30s",
        "--json",
    ]);
    let rising = spawn(&["can", "gen", "can0", "--id", "inc:180", "--gap", "10ms", "--for", "7s"]);
    let fixed = spawn(&[
        "can", "gen", "can1", "--id", "7C0", "--gap", "10ms", "--for", "7s", "--data", "inc", "--len", "2",
    ]);
    let done = |child: Child| {
        let output = child.wait_with_output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        String::from_utf8(output.stdout).unwrap()
    };
    let rows: Vec<Value> = done(dump).lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert_eq!(rows.len(), 200);
    for row in &rows {
        let (bus, id) = (row["bus"].as_str().unwrap(), row["id"].as_u64().unwrap());
        assert!(matches!((bus, id), ("can0", 0x180..=0x1FF) | ("can1", 0x7C0)) && id != 0x1A0, "{row}");
        assert_eq!(row["echo"], true);
    }
    let stamps: Vec<i64> = rows.iter().map(|row| row["utc_ns"].as_i64().unwrap()).collect();
    assert!(stamps.is_sorted(), "{stamps:?}");
    assert!(rows.iter().any(|row| row["bus"] == "can1") && rows.iter().any(|row| row["bus"] == "can0"));
    for child in [rising, fixed] {
        let said = done(child);
        assert!(said.contains(" sent in ") && said.contains(" seen on the bus"), "{said}");
    }

    let stats = spawn(&["can", "stats", "--for", "6s", "--json"]);
    stack.ok(&["can", "gen", "can1", "--id", "7C0", "--gap", "10ms", "--count", "200"]);
    let stats: Value = serde_json::from_str(&done(stats)).unwrap();
    assert_eq!(stats["buses"].as_array().unwrap().len(), 2);
    let row = stats["ids"].as_array().unwrap().iter().find(|row| row["id"] == 0x7C0).unwrap();
    assert!(row["frames"].as_u64().unwrap() >= 50 && row["period_mean_ms"].as_f64().unwrap() > 0.0, "{row}");

    let sniff = spawn(&["can", "sniff", "can0", "--for", "8s"]);
    stack.ok(&["can", "gen", "can0", "--id", "inc:180", "--gap", "10ms", "--count", "300"]);
    let changes = done(sniff);
    assert!(changes.contains("  2AB  ") && !changes.contains("  7C0  "), "{changes}");

    // Tools that were killed, or whose reader went away, take no place from those that come later.
    let mut traffic = spawn(&["can", "gen", "can0", "--id", "7F0", "--gap", "10ms"]);
    for round in 0..6 {
        let mut dump = spawn(&["can", "dump", "can0"]);
        std::io::Read::read_exact(dump.stdout.as_mut().unwrap(), &mut [0]).unwrap();
        if round % 2 == 0 {
            drop(dump.stdout.take());
        } else {
            dump.kill().unwrap();
        }
        dump.wait().unwrap();
    }
    let pid = rustix::process::Pid::from_child(&traffic);
    rustix::process::kill_process(pid, rustix::process::Signal::INT).unwrap();
    assert!(traffic.wait().unwrap().success());
    stack.ok(&["can", "send", "can0", "7F0#AA"]);

    // Refusals say what to do.
    let say = |args: &[&str]| {
        let output = stack.cli(args);
        (output.status.code().unwrap(), String::from_utf8_lossy(&output.stderr).into_owned())
    };
    let (code, said) = say(&["can", "dump", "cna1"]);
    assert!(
        code == 1 && said.contains("has no CAN bus 'cna1' (did you mean 'can1'?); it has can0, can1"),
        "{said}"
    );
    let (code, said) = say(&["can", "dump", "can0", "--filter", "#eror"]);
    assert!(code == 2 && said.contains("did you mean '#error'?"), "{said}");
    let (code, said) = say(&["can", "send", "can0", "20000080#00"]);
    assert!(code == 2 && said.contains("is an error frame: a controller makes them"), "{said}");
    let (code, said) = say(&["can", "gen", "can0", "--len", "9"]);
    assert!(code == 2 && said.contains("9 data bytes: a classic frame carries at most 8"), "{said}");
    let two = stack.scratch.write("two.log", "(1.0) a 123#01\n(1.0) b 123#02\n");
    let (code, said) = say(&["can", "replay", text(&two)]);
    assert!(code == 2 && said.contains("the file has frames of a, b, the stack has can0, can1"), "{said}");
    let wrong = stack.scratch.write("wrong.log", "(1.0) can0 123#01\n(1.1) can0 12#01\n");
    let (code, said) = say(&["can", "replay", text(&wrong), "--bus", "can0"]);
    assert!(code == 1 && said.contains("wrong.log:2: identifier `12` must have 3 hex digits"), "{said}");
    assert_eq!(stack.take_down(), 0);
}

const CANOPEN: &str = r#"
[stack]
name = "NAME"

[[service]]
name = "can0"
kind = "can"
backend = "virtual"
bitrate = "1M"

[[service]]
name = "node5"
kind = "canopen-slave"
node_id = 5
simulate = "401"

[[service]]
name = "io"
kind = "canopen-master"
node_id = 1
sync_period = "20ms"

[[service.node]]
id = 5
eds = "io401.eds"
heartbeat = "50ms"
map = [{ object = "6000:01", to = "%IB0", symbol = "Buttons" }, { object = "6200:01", from = "%QB0", symbol = "Lamps" }]

[[service]]
name = "plc"
kind = "plc"
"#;

fn canopen_stack(name: &str) -> Stack {
    let scratch = Scratch::new(name);
    let eds = Path::new(env!("CARGO_MANIFEST_DIR")).join("stacks/canopen-io/io401.eds");
    fs::copy(eds, scratch.0.join("io401.eds")).unwrap();
    let stack = Stack::spawn_in(name, CANOPEN, scratch, &[]);
    stack.wait_ready();
    stack
}

/// Identifiers that a command showed as JSON lines.
fn ids(lines: &str) -> std::collections::BTreeSet<u64> {
    let rows = lines.lines().map(|line| serde_json::from_str::<Value>(line).unwrap());
    rows.map(|row| row["id"].as_u64().unwrap()).collect()
}

#[test]
fn names_of_canopen_are_filters_and_frames_of_others_are_no_disorder() {
    let mut stack = canopen_stack("named");
    let dump = |filter: &str| {
        ids(&stack.ok(&["can", "dump", "--json", "--filter", filter, "-n", "6", "--for", "20s"]))
    };
    let set = |ids: &[u64]| ids.iter().copied().collect::<std::collections::BTreeSet<u64>>();
    assert_eq!(dump("heartbeat node 5"), set(&[0x705]));
    assert_eq!(dump("SYNC"), set(&[0x80]));
    assert_eq!(dump("heartbeat,!heartbeat 1"), set(&[0x705]));
    // What is shown is what is taken, by the mapped object's name, too.
    stack.wait("the master's outputs reach the bus", || {
        let line = stack.ok(&["can", "dump", "--json", "--filter", "lamps", "-n", "1", "--for", "5s"]);
        let row: Value = serde_json::from_str(line.lines().next()?).unwrap();
        assert_eq!((&row["id"], &row["id_text"]), (&0x205.into(), &"205".into()), "{row}");
        (row["names"]["RPDO1 5"].is_null() && row["names"]["Lamps"] == "0").then_some(())
    });
    let stats = stack.ok(&["can", "stats", "--filter", "heartbeat 5", "--for", "3s", "--json"]);
    let stats: Value = serde_json::from_str(&stats).unwrap();
    assert_eq!(stats["ids"].as_array().unwrap().len(), 1, "{stats}");
    assert_eq!(stats["ids"][0]["names"], serde_json::json!({ "heartbeat 5": null }));
    let sniff = stack.ok(&["can", "sniff", "--filter", "node 5", "--for", "3s", "--json"]);
    assert!(ids(&sniff).iter().all(|id| id & 0x7F == 5), "{sniff}");
    let row: Value = serde_json::from_str(sniff.lines().next().unwrap()).unwrap();
    assert!(row["names"].is_object() && !row["data"].as_str().unwrap().contains(' '), "{row}");
    let output = stack.cli(&["can", "dump", "--filter", "heartbeet 5"]);
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.code() == Some(2) && said.contains("did you mean 'heartbeat 5'?"), "{said}");
    assert!(said.contains("nodes in this stack: 1, 5"), "{said}");

    // The heartbeat of the node comes meanwhile, equal to the replayed one.
    let log: String = (0..40u64)
        .map(|i| {
            format!("({}.{:03}) can0 {}\n", 1 + i / 20, i % 20 * 50, ["705#05", "123#01"][i as usize % 2])
        })
        .collect();
    let log = stack.scratch.write("beats.log", log);
    let output = stack.cli(&["can", "replay", text(&log), "--json"]);
    let (said, why) = (
        String::from_utf8_lossy(&output.stdout).into_owned(),
        String::from_utf8_lossy(&output.stderr).into_owned(),
    );
    assert_eq!(output.status.code(), Some(0), "{said}{why}");
    let said: Value = serde_json::from_str(&said).unwrap();
    let counts = &said["buses"]["can0"];
    assert_eq!(
        (&counts["sent"], &counts["echoed"], &counts["out_of_order"]),
        (&40.into(), &40.into(), &0.into())
    );
    assert!(counts["equal_from_others"].as_u64().unwrap() > 0, "{said}");
    assert!(
        why.contains("equal to these came from another sender of the stack (") && why.contains("io"),
        "{why}"
    );

    // What the log does not tell is not made up; nothing sent is no success.
    let say = |args: &[&str]| {
        let output = stack.cli(args);
        (output.status.code().unwrap(), String::from_utf8_lossy(&output.stderr).into_owned())
    };
    let (code, said) = say(&["can", "replay", text(&log), "--received-only"]);
    assert!(code == 2 && said.contains("does not tell sent frames from received ones"), "{said}");
    let imported = stack.scratch.0.join("beats.mcap");
    ok(&["recordings", "import", text(&log), "-o", text(&imported)]);
    let (code, said) = say(&["can", "replay", text(&imported), "--filter", "#rx"]);
    assert!(code == 2 && said.contains("--filter #tx or #rx cannot be applied"), "{said}");
    let (code, said) = say(&["can", "replay", text(&log), "--filter", "7F0"]);
    assert!(code == 1 && said.contains("nothing was sent: every frame was left out by --filter"), "{said}");
    let told = stack.scratch.write("told.log", "(1.0) can0 123#01 T\n(1.1) can0 124#02 R\n");
    let said: Value =
        serde_json::from_str(&stack.ok(&["can", "replay", text(&told), "--received-only", "--json"]))
            .unwrap();
    assert_eq!((&said["buses"]["can0"]["sent"], &said["left_out"]["not_wanted"]), (&1.into(), &1.into()));
    assert_eq!(stack.take_down(), 0);
}

#[test]
fn several_writes_are_one_or_none() {
    let mut stack = canopen_stack("plcwrite");
    let read = |var: &str| stack.ok(&["plc", "read", var]).trim().to_owned();
    let output = stack.cli(&["plc", "write", "%MW0=1", "%MB2=bad", "%MW2=3", "%MB9999=1"]);
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains("nothing was written: '%MB2' is USINT; \"bad\" does not fit"), "{said}");
    assert!(said.contains("'%MB9999': this place is beyond the end of its area"), "{said}");
    assert_eq!((read("%MW0"), read("%MW2")), ("%MW0 = 0".to_owned(), "%MW2 = 0".to_owned()));
    let said = stack.ok(&["plc", "write", "%MW0=1", "%MX2.3=TRUE", "%MW2=16#FF", "Lamps=5", "--json"]);
    let said: Value = serde_json::from_str(&said).unwrap();
    assert_eq!((&said["one_scan"], said["written"].as_array().unwrap().len()), (&true.into(), 4), "{said}");
    for (var, value) in [("%MW0", 1), ("%MB2", 8), ("%MW2", 255), ("%QB0", 5)] {
        assert_eq!(read(var), format!("{var} = {value}"));
    }
    let many: Vec<String> = (0..65).map(|i| format!("%MW{}=7", 2 * i)).collect();
    let args: Vec<&str> = ["plc", "write"].into_iter().chain(many.iter().map(String::as_str)).collect();
    let output = stack.cli(&args);
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(
        output.status.code() == Some(2)
            && said.contains("65 assignments are more than one scan applies whole"),
        "{said}"
    );
    assert_eq!(read("%MW0"), "%MW0 = 1");
    assert_eq!(stack.take_down(), 0);
}

/// A killed tool cannot give its place back: the next one does, and does not wait for the launcher to find it.
#[test]
fn killed_senders_do_not_keep_others_out() {
    let mut stack = Stack::up("cankilled", STACK, &[]);
    let mut senders: Vec<Child> = (0..4)
        .map(|_| {
            dinrail()
                .args(["can", "gen", "can0", "--gap", "10ms", "--stack", &stack.name])
                .stdout(Stdio::null())
                .stderr(Stdio::null())
                .spawn()
                .unwrap()
        })
        .collect();
    // With all places taken the next one is told so.
    stack.wait("a full house", || {
        let output = stack.cli(&["can", "send", "can0", "123#01"]);
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        (output.status.code() == Some(1) && said.contains("too many tools")).then_some(())
    });
    for sender in &mut senders {
        sender.kill().unwrap();
        sender.wait().unwrap();
    }
    stack.ok(&["can", "gen", "can0", "--id", "105", "--count", "3"]);
    assert_eq!(stack.take_down(), 0);
}
