//! Every recording can be verified exactly: exit 0 when nothing was lost, 3 with the spans listed after kills,
//! 1 with scan and variable when something differs.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod support;

use rustix::process::Signal;
use std::path::Path;
use std::process::Output;
use std::thread::sleep;
use std::time::Duration;
use support::modbus::Client;
use support::{Scratch, Stack, dinrail, free_port};

fn text(port: u16) -> String {
    format!(
        r#"
[stack]
name = "NAME"

[[service]]
name = "rec"
kind = "recorder"
dir = "recordings"
restart = {{ max = 100, within = "10s" }}

[[service]]
name = "can0"
kind = "can"
backend = "virtual"
feed = {{ file = "conveyor.log", loop = true }}

[[service]]
name = "io"
kind = "can-io"
bus = "can0"

[[service.in]]
id = 0x1A0
start = 0
len = 16
to = "%IW0"
type = "UINT"
symbol = "Speed"

[[service.in]]
id = 0x0F1
start = 2
len = 1
to = "%IX2.0"
type = "BOOL"
symbol = "Barrier"

[[service]]
name = "plc"
kind = "plc"
program = ["main.st"]
cycle = "5ms"
restart = {{ max = 100, within = "10s" }}

[[service]]
name = "modbus"
kind = "modbus-server"
tcp = {{ address = "127.0.0.1", port = {port} }}
"#
    )
}

const PROGRAM: &str = "
PROGRAM main
VAR CONSTANT Limit : UINT := 1700; END_VAR
VAR
  Setpoint AT %MW0 : UINT;
  Over AT %MX2.0 : BOOL;
  Parcels AT %MW2 : UINT;
  Average AT %MD2 : REAL;
  Edge : R_TRIG;
  Late : TON;
  Low : INT;
  High : INT;
  Torn : INT;
END_VAR
  Edge(CLK := Barrier);
  IF Edge.Q THEN Parcels := Parcels + 1; END_IF;
  Average := Average * 0.99 + UINT_TO_REAL(Speed) * 0.01 + SIN(Average) * 0.001;
  Late(IN := Speed > Limit, PT := T#50ms);
  Over := Late.Q;
  IF Low <> High THEN Torn := Torn + 1; END_IF;
END_PROGRAM
";

/// Waits until the plc has made so many more scans: every 5 ms one, if it gets the CPU so often.
fn scans(stack: &Stack, more: u64) {
    let scan = || -> Option<u64> {
        let said = stack.cli(&["plc", "status", "--json"]).stdout;
        serde_json::from_slice::<serde_json::Value>(&said).ok()?["scan"].as_u64()
    };
    let first = stack.wait("a scan", scan);
    stack.wait(&format!("{more} scans after scan {first}"), || scan().filter(|now| *now >= first + more));
}

/// A stack that ran until `during` was over and so many more scans were made.
fn run(name: &str, more: u64, mut during: impl FnMut(&Stack, u16)) -> Stack {
    let port = free_port();
    let scratch = Scratch::new(name);
    scratch.write("main.st", PROGRAM);
    scratch.write("conveyor.log", include_str!("../recordings/conveyor.log"));
    let mut stack = Stack::spawn_in(name, &text(port), scratch, &[]);
    stack.wait_ready();
    during(&stack, port);
    scans(&stack, more);
    stack.wait_ready();
    assert_eq!(stack.take_down(), 0, "{}", stack.log());
    stack
}

fn verify(recording: &Path, args: &[&str]) -> (i32, serde_json::Value, String) {
    let output: Output =
        dinrail().args(["replay", "--verify", "--json"]).arg(recording).args(args).output().unwrap();
    let said =
        format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    (output.status.code().unwrap(), serde_json::from_slice(&output.stdout).unwrap_or_default(), said)
}

#[test]
fn a_loss_free_recording_verifies_exactly() {
    let stack = run("verify", 600, |_, port| {
        // Writes by Modbus and forces are inputs like any other.
        let mut client = Client::connect(port).unwrap();
        for value in 0..50 {
            client.write(0, value).unwrap();
            sleep(Duration::from_millis(7));
        }
    });
    let recordings = stack.recordings();
    assert_eq!(recordings.len(), 1);
    let (code, report, said) = verify(&recordings[0], &[]);
    assert_eq!(code, 0, "{said}");
    assert!(report["scans_verified"].as_u64().unwrap() > 500, "{said}");
}

#[test]
fn forces_starts_and_stops_verify_too() {
    let stack = run("forces", 100, |stack, _| {
        stack.ok(&["plc", "force", "Speed=1999", "Barrier=TRUE"]);
        sleep(Duration::from_millis(200));
        // Variables of the program are written in one scan, or none of them.
        for value in ["1", "2", "3"] {
            let both = [format!("Low={value}"), format!("main.High={value}"), "%MW0=7".to_owned()];
            let said = stack.ok(&["plc", "write", "--json", &both[0], &both[1], &both[2]]);
            assert!(said.contains("\"one_scan\":true"), "{said}");
        }
        assert!(!stack.cli(&["plc", "write", "Low=4", "High=nine"]).status.success());
        assert_eq!(
            stack.ok(&["plc", "read", "Low", "High", "Torn"]),
            "main.Low = 3\nmain.High = 3\nmain.Torn = 0\n"
        );
        stack.ok(&["plc", "stop"]);
        sleep(Duration::from_millis(100));
        stack.ok(&["plc", "run"]);
        stack.ok(&["plc", "unforce", "Speed", "Barrier"]);
        stack.ok(&["plc", "warm"]);
        sleep(Duration::from_millis(200));
        stack.ok(&["plc", "cold"]);
    });
    let (code, _, said) = verify(&stack.recordings()[0], &[]);
    assert_eq!(code, 0, "{said}");
}

#[test]
fn a_program_loaded_from_elsewhere_verifies_from_the_file_alone() {
    let elsewhere = Scratch::new("elsewhere");
    let other = elsewhere.write("other.st", PROGRAM.replace("1700", "900"));
    let stack = run("elsewhere", 100, |stack, _| {
        stack.ok(&["plc", "load", other.to_str().unwrap()]);
        scans(stack, 60);
    });
    // Neither the source nor what the plc left in shared memory is there any more.
    std::fs::remove_file(&other).unwrap();
    let recording = &stack.recordings()[0];
    let info = dinrail().args(["recordings", "info", "--json"]).arg(recording).output().unwrap();
    let info: serde_json::Value = serde_json::from_slice(&info.stdout).unwrap();
    let names = info["attachments"].as_array().unwrap().iter().filter_map(|a| a["name"].as_str());
    let modules = names
        .filter(|name| name.starts_with("plc.") && Path::new(name).extension().is_some_and(|e| e == "wasm"))
        .count();
    assert_eq!(modules, 2, "{info}");
    let (code, report, said) = verify(recording, &[]);
    assert_eq!(code, 0, "{said}");
    assert!(report["scans_verified"].as_u64().unwrap() > 100, "{said}");
}

#[test]
fn a_changed_constant_is_named_by_scan_and_variable() {
    let stack = run("constant", 1100, |_, _| {});
    let other = stack.scratch.write("other.st", PROGRAM.replace("1700", "1500"));
    let (code, report, said) = verify(&stack.recordings()[0], &["--program", other.to_str().unwrap()]);
    assert_eq!(code, 1, "{said}");
    let difference = &report["first_difference"];
    assert!(difference["scan"].as_u64().is_some(), "{said}");
    assert!(difference["variable"].as_str().unwrap().to_lowercase().contains("late"), "{said}");
}

#[test]
fn after_kills_the_spans_are_listed_and_99_of_100_scans_verified() {
    let stack = run("kills", 1100, |stack, _| {
        // Long enough between the kills that on a slow machine, too, only one in a hundred waits for a keyframe.
        scans(stack, 1100);
        for victim in ["rec", "plc", "rec"] {
            let generation = stack.generation(victim);
            stack.kill(victim, Signal::KILL);
            stack.wait_generation_above(victim, generation);
            scans(stack, 1100);
        }
    });
    let (mut verified, mut total) = (0, 0);
    let recordings = stack.recordings();
    assert_eq!(recordings.len(), 3, "one a life of the recorder");
    for recording in &recordings {
        let (code, report, said) = verify(recording, &[]);
        assert!(code == 0 || code == 3, "{}: exit {code}\n{said}", recording.display());
        if code == 3 {
            let listed = |key: &str| report[key].as_array().unwrap().len();
            assert!(listed("unverifiable") + listed("incomplete") > 0, "{said}");
        }
        verified += report["scans_verified"].as_u64().unwrap();
        total += report["scans"].as_u64().unwrap();
    }
    assert!(verified as f64 >= 0.99 * total as f64, "{verified} of {total} scans verified");
    assert!(total > 3500, "{total}");
}

#[test]
fn every_file_of_a_rotated_recording_verifies_alone() {
    let port = free_port();
    let scratch = Scratch::new("rotate");
    scratch.write("main.st", PROGRAM);
    scratch.write("conveyor.log", include_str!("../recordings/conveyor.log"));
    let toml = text(port).replace("dir = \"recordings\"\n", "dir = \"recordings\"\nmax_time = \"10s\"\n");
    let mut stack = Stack::spawn_in("rotate", &toml, scratch, &[]);
    stack.wait_ready();
    scans(&stack, 1100);
    stack.wait("a second file", || (stack.recordings().len() >= 2).then_some(()));
    scans(&stack, 300);
    assert_eq!(stack.take_down(), 0, "{}", stack.log());
    let mut scans = 0;
    for recording in stack.recordings() {
        let (code, report, said) = verify(&recording, &[]);
        assert_eq!(code, 0, "{}: {said}", recording.display());
        scans += report["scans_verified"].as_u64().unwrap();
    }
    assert!(scans > 1000, "{scans}");
}
