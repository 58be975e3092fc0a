//! 64 PDOs that each carry the counter of a SYNC: no scan ever sees two counters in inputs that are good.
//!
//! 60 nodes are played by a thread of this test with a place of its own on the rail, four are services. A process
//! belongs to one rail for its whole life, so this program has one test.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod support;

use dinrail_canopen::config::Simulation;
use dinrail_canopen::service::fleet::Player;
use dinrail_canopen::slave::fleet::Fleet;
use ipc_types::Context;
use rustix::process::Signal;
use std::path::PathBuf;
use std::sync::mpsc::{Receiver, Sender, TryRecvError, channel};
use std::thread::{self, JoinHandle, sleep};
use std::time::Duration;
use support::canopen::{BUS, HELD, IO401, node, slave, status, wait_state};
use support::socketcand::Load;
use support::{Stack, free_port};

const NODES: std::ops::RangeInclusive<u8> = 2..=65;
/// Those that are services; the others are played here.
const SERVICES: std::ops::RangeInclusive<u8> = 2..=5;

const PROGRAM: &str = r"
PROGRAM main
VAR
  Values AT %IW0 : ARRAY[0..63] OF INT;
  Qualities AT %IB200 : ARRAY[0..63] OF USINT;
  i : INT;
  good : INT;
  first : INT;
  last : INT;
  Samples : UDINT;      (* changes of the counter *)
  Whole : UDINT;        (* scans in which all inputs were good *)
  Partly : UDINT;       (* scans in which some were *)
  Mixed : UDINT;        (* scans with two counters: must stay 0 *)
  MixedAt : INT := -1;
  MixedFirst : INT;
  MixedOther : INT;
END_VAR
  good := 0;
  FOR i := 0 TO 63 DO
    IF Qualities[i] = 0 THEN
      IF good = 0 THEN
        first := Values[i];
      ELSIF Values[i] <> first THEN
        Mixed := Mixed + 1;
        MixedAt := i;
        MixedFirst := first;
        MixedOther := Values[i];
      END_IF;
      good := good + 1;
    END_IF;
  END_FOR;
  IF good = 64 THEN
    Whole := Whole + 1;
  ELSIF good > 0 THEN
    Partly := Partly + 1;
  END_IF;
  IF good > 0 AND first <> last THEN
    Samples := Samples + 1;
    last := first;
  END_IF;
END_PROGRAM
";

/// A PDO that is later than a whole period cannot be told from one of the next SYNC: the period is longer than a machine
/// under load keeps a process waiting.
fn text(can_port: u16) -> String {
    let mut text = format!("{BUS}serve = {{ socketcand = \"127.0.0.1:{can_port}\" }}\n");
    for id in SERVICES {
        text += &slave(&format!("n{id}"), id, HELD);
    }
    text += r#"
[[service]]
name = "io"
kind = "canopen-master"
sync_period = "50ms"
sync_window = "40ms"
sync_overflow = 240
"#;
    for id in NODES {
        let at = id - 2;
        text += &format!(
            r#"
[[service.node]]
id = {id}
eds = "io401.eds"
heartbeat = "200ms"
map = [{{ object = "6401:04", to = "%IW{at}", status_to = "%IB{}" }}]
"#,
            200 + u16::from(at)
        );
    }
    text + "\n[[service]]\nname = \"plc\"\nkind = \"plc\"\nprogram = [\"main.st\"]\ncycle = \"5ms\"\n"
}

/// The nodes played here.
struct Devices {
    /// Node-id, and whether it shall have power.
    power: Option<Sender<(u8, bool)>>,
    thread: Option<JoinHandle<u64>>,
}

impl Devices {
    fn start(root: PathBuf) -> Self {
        let (power, switches) = channel();
        let thread = thread::spawn(move || play(&root, &switches));
        let devices = Self { power: Some(power), thread: Some(thread) };
        NODES.filter(|id| !SERVICES.contains(id)).for_each(|id| devices.switch(id, true));
        devices
    }

    fn switch(&self, id: u8, on: bool) {
        self.power.as_ref().unwrap().send((id, on)).unwrap();
    }

    /// Frames that found no room.
    fn end(mut self) -> u64 {
        self.power = None;
        self.thread.take().unwrap().join().unwrap()
    }
}

fn play(root: &std::path::Path, switches: &Receiver<(u8, bool)>) -> u64 {
    let mut ctx = Context::observer(root).unwrap();
    let ids = NODES.filter(|id| !SERVICES.contains(id));
    let mut fleet = Fleet::new(Simulation::Cia401, ids).unwrap();
    let mut player = Player::open(&mut ctx, "can0").unwrap();
    let step = |fleet: &mut Fleet, now_ns: u64, out: &mut _| match switches.try_recv() {
        Ok((id, true)) => {
            fleet.power_on(now_ns, id, out);
            true
        }
        Ok((id, false)) => {
            fleet.power_off(id);
            true
        }
        Err(TryRecvError::Empty) => true,
        Err(TryRecvError::Disconnected) => false,
    };
    player.play(&mut fleet, step).unwrap();
    player.dropped
}

fn count(stack: &Stack, variable: &str) -> u64 {
    stack.read(variable).as_u64().unwrap()
}

/// All 64 are good in some scan from now on.
fn wait_whole(stack: &Stack) {
    let before = count(stack, "Whole");
    stack.wait("scans in which all inputs are good", || (count(stack, "Whole") > before + 20).then_some(()));
}

#[test]
fn no_scan_sees_two_syncs_under_load_and_while_nodes_drop_out() {
    let can_port = free_port();
    let mut stack = Stack::spawn("coherence", &text(can_port), &[("main.st", PROGRAM), ("io401.eds", IO401)]);
    stack.wait("a running stack", || {
        let rows = stack.ps();
        (!rows.is_empty() && rows.iter().all(|r| r["state"] == "running" && r["health"] != "starting"))
            .then_some(())
    });
    let devices = Devices::start(stack.root().to_owned());
    wait_whole(&stack);
    let load = Load::start(can_port, 3000);
    for round in 0..3u8 {
        // One device loses its power, one process is killed.
        let (device, service) = (20 + round, 2 + round);
        devices.switch(device, false);
        stack.kill(&format!("n{service}"), Signal::KILL);
        for id in [device, service] {
            wait_state(&stack, id, "unknown");
        }
        let before = count(&stack, "Partly");
        stack.wait("the others go on", || (count(&stack, "Partly") > before + 20).then_some(()));
        devices.switch(device, true);
        stack.ok(&["restart", &format!("n{service}")]);
        for id in [device, service] {
            wait_state(&stack, id, "operational");
        }
        wait_whole(&stack);
    }
    sleep(Duration::from_secs(3));
    wait_whole(&stack);
    assert!(load.end() > 0);
    let lost: Vec<u64> =
        [20, 21, 22, 2, 3, 4].map(|id| node(&stack, id).unwrap()["losses"].as_u64().unwrap_or(0)).into();
    assert!(lost.iter().all(|&n| n >= 1), "{lost:?}");
    let mixed =
        [count(&stack, "Mixed"), count(&stack, "Samples"), count(&stack, "Whole"), count(&stack, "Partly")];
    let at = ["MixedAt", "MixedFirst", "MixedOther"].map(|v| stack.read(v).to_string());
    let pdo = status(&stack).unwrap()["pdo"].clone();
    eprintln!("mixed, samples, whole, partly: {mixed:?}; pdo {pdo}");
    assert_eq!(mixed[0], 0, "two counters in one scan, last at {at:?}; {mixed:?} {pdo}");
    assert!(mixed[1] > 80, "{mixed:?} {pdo}");
    assert_eq!(devices.end(), 0, "frames that the bus did not take");
    assert_eq!(stack.take_down(), 0);
}
