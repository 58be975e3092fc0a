//! Every value of a PDO reaches a scan by `queue`; every SYNC runs the program by `trigger`; a recording says so and
//! verifies.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod support;

use dinrail_recorder::scan_contents;
use ipc_types::scan_record::{Content, Joiner, Kind, MAX_RECORD_BYTES, Section, Trigger};
use rustix::process::Signal;
use std::io::{Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::time::Duration;
use support::canopen::{BUS, HELD, IO401, node, slave, status, wait_operational, wait_state};
use support::{Scratch, Stack, dinrail, free_port};

/// Counts what it sees of a PDO with a queue and of one without; both carry numbers that rise by one.
const COUNTING: &str = r"
PROGRAM main
VAR
  QueueLast : USINT; QueueSeen : UDINT; QueueGaps : UDINT;
  NewestLast : INT; NewestSeen : UDINT;
END_VAR
  IF Queued <> QueueLast THEN
    QueueSeen := QueueSeen + 1;
    IF Queued <> QueueLast + 1 THEN QueueGaps := QueueGaps + 1; END_IF;
    QueueLast := Queued;
  END_IF;
  IF Newest <> NewestLast THEN
    NewestSeen := NewestSeen + 1;
    NewestLast := Newest;
  END_IF;
END_PROGRAM
";

/// A node whose first PDO is event-driven with a queue, and whose second counts by its newest value. The process data
/// of the test is sent beside the simulated device, with its identifiers: it only sends when an output changes.
fn queue_text(can_port: u16) -> String {
    format!(
        r#"{BUS}serve = {{ socketcand = "127.0.0.1:{can_port}" }}
{}
[[service]]
name = "io"
kind = "canopen-master"

[[service.node]]
id = 2
eds = "io401.eds"
heartbeat = "200ms"
map = [
    {{ object = "6000:01", to = "%IB0", symbol = "Queued", queue = 64 }},
    {{ object = "6401:01", to = "%IW1", symbol = "Newest" }},
]

[[service]]
name = "plc"
kind = "plc"
program = ["main.st"]
cycle = "20ms"
"#,
        slave("n2", 2, HELD)
    )
}

/// A client of the bus that sends as fast as it can.
struct Bus(TcpStream);

impl Bus {
    fn open(port: u16) -> Self {
        let mut stream = TcpStream::connect(("127.0.0.1", port)).unwrap();
        stream.set_read_timeout(Some(Duration::from_secs(10))).unwrap();
        let mut answer = |ask: &str| {
            stream.write_all(ask.as_bytes()).unwrap();
            let mut said = [0u8; 64];
            assert!(stream.read(&mut said).unwrap() > 0);
        };
        answer("< open can0 >");
        answer("< rawmode >");
        Self(stream)
    }

    /// Both PDOs with each of these numbers, at once.
    fn burst(&mut self, numbers: std::ops::RangeInclusive<u8>) {
        let frames: String = numbers
            .map(|n| format!("< send 182 2 {n:02x} 00 >< send 282 8 {n:02x} 00 00 00 00 00 00 00 >"))
            .collect();
        self.0.write_all(frames.as_bytes()).unwrap();
    }
}

fn count(stack: &Stack, variable: &str) -> u64 {
    stack.read(variable).as_u64().unwrap()
}

#[test]
fn every_value_of_a_burst_reaches_a_scan_in_order() {
    let can_port = free_port();
    let mut stack = Stack::up("queue", &queue_text(can_port), &[("main.st", COUNTING), ("io401.eds", IO401)]);
    wait_operational(&stack, &[2]);
    let mut bus = Bus::open(can_port);
    // Fifty values in far less than one scan period.
    bus.burst(1..=50);
    stack.wait("the last value", || (count(&stack, "QueueLast") == 50).then_some(()));
    assert_eq!((count(&stack, "QueueSeen"), count(&stack, "QueueGaps")), (50, 0));
    assert_eq!(count(&stack, "NewestLast"), 50);
    let seen = count(&stack, "NewestSeen");
    assert!((1..50).contains(&seen), "without a queue only the last is sure: {seen}");
    let queue = status(&stack).unwrap()["queues"][0].clone();
    assert_eq!(
        (&queue["node"], &queue["cob_id"], &queue["size"], &queue["waiting"], &queue["dropped"]),
        (&2.into(), &0x182.into(), &64.into(), &0.into(), &0.into()),
        "{queue}"
    );
    assert!(queue["most"].as_u64().unwrap() > 0, "{queue}");

    // A stopped program takes nothing: the first value is shown, 64 wait, the oldest of those are dropped.
    stack.ok(&["plc", "stop"]);
    bus.burst(51..=130);
    let full = || {
        let queue = status(&stack)?["queues"][0].clone();
        (queue["waiting"] == 64 && queue["dropped"] == 15).then_some(())
    };
    stack.wait("a full queue", full);
    stack.ok(&["plc", "run"]);
    stack.wait("the last value", || (count(&stack, "QueueLast") == 130).then_some(()));
    assert_eq!((count(&stack, "QueueSeen"), count(&stack, "QueueGaps")), (50 + 65, 1));

    // Without its plc the values wait as well, and the next plc gets them.
    let before = stack.generation("plc");
    stack.kill("plc", Signal::KILL);
    bus.burst(131..=140);
    stack.wait_generation_above("plc", before);
    stack.wait("the last value", || (count(&stack, "QueueLast") == 140).then_some(()));
    // Its counters began at 0: the first value it saw was a gap, none after it.
    assert!(count(&stack, "QueueGaps") <= 1);
    assert_eq!(stack.take_down(), 0);
}

#[test]
fn points_of_a_pdo_have_one_queue() {
    let said = |map: &str, more: &str| {
        let scratch = Scratch::new("queue-check");
        scratch.write("io401.eds", IO401);
        let text = format!(
            r#"[stack]
name = "queue-check"
[[service]]
name = "can0"
kind = "can"
backend = "virtual"
[[service]]
name = "io"
kind = "canopen-master"
[[service.node]]
id = 2
eds = "io401.eds"
map = [
{map}
]
[[service]]
name = "plc"
kind = "plc"
{more}"#
        );
        let file = scratch.write("stack.toml", text);
        let output = dinrail().arg("check").arg(&file).output().unwrap();
        let text =
            format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
        (output.status.code().unwrap(), text)
    };
    let (code, text) = said(
        "{ object = \"6000:01\", to = \"%IB0\", queue = 8 },\n{ object = \"6000:02\", to = \"%IB1\" },",
        "",
    );
    assert_eq!(code, 1, "{text}");
    assert!(text.contains("stack.toml:14"), "{text}");
    assert!(text.contains("TPDO 1 of node 2 has points with and without queue"), "{text}");
    for (entry, expected) in [
        ("{ object = \"6000:01\", to = \"%IB0\", queue = 65 }", "a queue of 65 values is not possible"),
        ("{ object = \"6000:01\", to = \"%IB0\", queue = 0 }", "a queue of 0 values is not possible"),
        ("{ object = \"6200:01\", from = \"%QB0\", queue = 4 }", "queue is for what a node sends"),
    ] {
        let (code, text) = said(entry, "");
        assert!(code == 1 && text.contains(expected) && text.contains("stack.toml:14"), "{text}");
    }
    let both = "{ object = \"6000:01\", to = \"%IB0\", queue = 8 },\n{ object = \"6000:02\", to = \"%IB1\", queue = 8 },";
    let (code, text) = said(both, "");
    assert_eq!(code, 0, "{text}");
    // The trigger is checked against what the master is set up for.
    let (code, text) = said(both, "trigger = { service = \"io\", event = \"sync\" }\n");
    assert!(code == 1 && text.contains("'io' sends no SYNC: it has no sync_period"), "{text}");
    assert!(text.contains("stack.toml:20"), "{text}");
}

/// Counts its runs; the counter of the SYNC comes with the inputs.
const RUNS: &str = r"
PROGRAM main
VAR
  Runs : UDINT; Bad : UDINT; Jumps : UDINT; Last : INT;
  Quality AT %IB10 : USINT;
END_VAR
  Runs := Runs + 1;
  IF Quality <> 0 THEN
    Bad := Bad + 1;
    Last := 0;
  ELSE
    IF Last <> 0 AND Counter <> Last MOD 240 + 1 THEN Jumps := Jumps + 1; END_IF;
    Last := Counter;
  END_IF;
END_PROGRAM
";

fn sync_text() -> String {
    format!(
        r#"{BUS}
[[service]]
name = "rec"
kind = "recorder"
dir = "recordings"
{}
[[service]]
name = "io"
kind = "canopen-master"
sync_period = "20ms"
sync_window = "10ms"
sync_overflow = 240
{HELD}

[[service.node]]
id = 2
eds = "io401.eds"
heartbeat = "200ms"
keep_alive = true
map = [{{ object = "6401:04", to = "%IW0", symbol = "Counter", status_to = "%IB10" }}]

[[service]]
name = "plc"
kind = "plc"
program = ["main.st"]
trigger = {{ service = "io", event = "sync" }}
"#,
        slave("n2", 2, HELD)
    )
}

/// Of each scan of a recording what it was triggered by, whether a task ran in it, and its UTC in ns.
fn triggers(recording: &Path) -> Vec<(Option<Trigger>, bool, i64)> {
    let mut joiner = Joiner::new(MAX_RECORD_BYTES);
    let mut found = Vec::new();
    for message in scan_contents(recording, "plc").unwrap() {
        let message = message.unwrap();
        if message.keyframe {
            continue;
        }
        let step = joiner.push(&message.header, &message.tail);
        let Some(whole) = step.whole else { continue };
        let content = Content::parse(whole.bytes).unwrap();
        assert_eq!(content.head.kind, Kind::Scan);
        let trigger = content.sections().find_map(|section| match section {
            Section::Trigger(trigger) => Some(trigger),
            _ => None,
        });
        found.push((trigger, content.head.tasks_ran != 0, content.head.utc_ns));
    }
    found
}

#[test]
fn a_program_runs_once_a_sync_and_its_recording_verifies() {
    let mut stack = Stack::up("trigger", &sync_text(), &[("main.st", RUNS), ("io401.eds", IO401)]);
    wait_operational(&stack, &[2]);
    let before = count(&stack, "Runs");
    stack.wait("runs", || (count(&stack, "Runs") > before + 100).then_some(()));
    // A command is applied at once, in a scan of its own that is no run.
    stack.ok(&["plc", "write", "Jumps=0"]);
    // Without SYNC the program goes on, and sees that its inputs are bad.
    stack.kill("io", Signal::KILL);
    let bad = count(&stack, "Bad");
    stack.wait("runs without SYNC", || (count(&stack, "Bad") > bad + 10).then_some(()));
    stack.ok(&["restart", "io"]);
    wait_state(&stack, 2, "operational");
    let before = count(&stack, "Runs");
    stack.wait("runs", || (count(&stack, "Runs") > before + 100).then_some(()));
    let (runs, jumps) = (count(&stack, "Runs"), count(&stack, "Jumps"));
    assert!(node(&stack, 2).unwrap()["operational"] == true);
    assert_eq!(stack.take_down(), 0, "{}", stack.log());

    let recordings = stack.recordings();
    assert_eq!(recordings.len(), 1);
    let scans = triggers(&recordings[0]);
    let ran = scans.iter().filter(|(_, ran, _)| *ran).count();
    assert!(ran as u64 >= runs, "{ran} of {runs}");
    // What ran was triggered, but for the start; what was not triggered did not run.
    let untriggered: Vec<_> = scans.iter().filter(|(trigger, ran, _)| trigger.is_none() == *ran).collect();
    assert!(untriggered.len() <= 1, "{untriggered:?}");
    assert!(scans.iter().any(|(_, ran, _)| !ran), "the command had a scan of its own");
    let events: Vec<(Trigger, i64)> = scans
        .iter()
        .filter_map(|(trigger, _, utc_ns)| Some((trigger.filter(|t| !t.overdue)?, *utc_ns)))
        .collect();
    let generations: Vec<u32> = events.iter().map(|(t, _)| t.source.generation).collect();
    assert_eq!((generations.first(), generations.last()), (Some(&1), Some(&2)));
    assert!(scans.iter().any(|(trigger, ..)| trigger.is_some_and(|t| t.overdue)));
    // Each SYNC once: the number rises by one, and by what the record says was missed.
    let mut missed = 0;
    for pair in events.windows(2) {
        let [(a, _), (b, _)] = pair else { continue };
        let from = if a.source.generation == b.source.generation { a.count } else { 0 };
        assert_eq!(b.count, from + 1 + b.missed, "{a:?} {b:?}");
        missed += b.missed;
    }
    assert!(jumps <= missed, "the program missed {jumps} SYNCs, the engine says {missed}");
    // As many as there were SYNC frames on the bus until the last run.
    let output =
        dinrail().args(["recordings", "export"]).arg(&recordings[0]).args(["--bus", "can0"]).output();
    let log = String::from_utf8(output.unwrap().stdout).unwrap();
    let end_s = events.last().unwrap().1 as f64 / 1e9 + 0.001;
    let at = |line: &str| line.strip_prefix('(')?.split(')').next()?.parse::<f64>().ok();
    let syncs = log.lines().filter(|line| line.contains(" 080#")).filter_map(at).filter(|t| *t <= end_s);
    let last = |generation: u32| {
        events.iter().rev().find(|(t, _)| t.source.generation == generation).map_or(0, |(t, _)| t.count)
    };
    let (syncs, counted) = (syncs.count() as u64, last(1) + last(2));
    // The last SYNC before the master died, and the one that is on the bus just now, may have reached no scan.
    assert!((counted..=counted + 2).contains(&syncs), "{syncs} SYNC frames, {counted} samples");

    let output = dinrail().args(["replay", "--verify"]).arg(&recordings[0]).output().unwrap();
    let said =
        format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert_eq!(output.status.code(), Some(0), "{said}");
}

#[test]
fn a_wrong_trigger_is_named_with_its_line() {
    let stack_of = |trigger: &str| {
        format!("[stack]\nname = \"x\"\n[[service]]\nname = \"plc\"\nkind = \"plc\"\ntrigger = {trigger}\n")
    };
    for (trigger, expected) in [
        ("{ service = \"io\", event = \"sync\" }", "there is no service 'io'"),
        ("{ service = \"plc\", event = \"sync\" }", "'plc'"),
        ("{ service = \"io\", event = \"snyc\" }", "snyc"),
        ("\"sync\"", "sync"),
    ] {
        let scratch = Scratch::new("trigger-check");
        let file = scratch.write("stack.toml", stack_of(trigger));
        let output = dinrail().arg("check").arg(&file).output().unwrap();
        let said =
            format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
        assert_eq!(output.status.code(), Some(1), "{trigger}: {said}");
        assert!(said.contains(expected) && said.contains("stack.toml:6"), "{trigger}: {said}");
    }
}
