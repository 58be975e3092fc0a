use super::*;
use crate::config::MasterConfig;
use crate::master::boot::Letter;
use crate::master::plan::{Plan, plan};
use crate::master::testing::{Slave, device};
use crate::protocol::nmt::NmtState;
use dinrail_iec::Addressing;
use ipc_types::payload::id_flag;
use serde_json::json;
use std::collections::BTreeMap;

const MS: u64 = 1_000_000;

struct Bus {
    network: Network,
    slaves: Vec<Slave>,
    now: u64,
    events: Vec<Event>,
    samples: Vec<(bool, Vec<u8>)>,
    /// Every frame, with its sender: 0 is the master.
    log: Vec<(u8, CanFrame)>,
}

fn config(nodes: serde_json::Value) -> serde_json::Value {
    json!({ "node_id": 1, "heartbeat": "100ms", "node": nodes })
}

fn node(id: u8) -> serde_json::Value {
    json!({ "id": id, "eds": "x.eds", "heartbeat": "50ms", "mandatory": true, "map": [
        { "object": "6000:01", "to": format!("%IB{}", id * 4) },
        { "object": "6200:01", "from": format!("%QB{}", id * 4) },
    ] })
}

fn planned(config: serde_json::Value) -> Plan {
    let config: MasterConfig = serde_json::from_value(config).unwrap();
    let devices: BTreeMap<_, _> = config.nodes.iter().map(|n| (n.id, device(n.id))).collect();
    let plan = plan(&config, &devices, Addressing::Element, "io");
    assert!(plan.mistakes.iter().all(|m| m.warning), "{:?}", plan.mistakes);
    plan
}

impl Bus {
    fn new(config: serde_json::Value, slaves: &[u8], takeover: bool) -> Self {
        let mut plan = planned(config);
        plan.settings.takeover = takeover;
        let exchange = Exchange::new(plan.exchange, plan.sync_window_ns);
        let transfers = Transfers::new(plan.nodes.iter().map(|n| (n.settings.plan.id, 500 * MS)));
        let nodes = plan.nodes.into_iter().map(|n| n.settings).collect();
        Self {
            network: Network::new(plan.settings, nodes, exchange, transfers),
            slaves: slaves.iter().map(|&id| Slave::new(id)).collect(),
            now: 0,
            events: Vec::new(),
            samples: Vec::new(),
            log: Vec::new(),
        }
    }

    fn start(&mut self) {
        let mut out = Outbox::default();
        self.network.start(self.now, &mut out);
        self.pass(0, out);
    }

    /// Everybody sees the frame; what they answer is passed on likewise.
    fn pass(&mut self, from: u8, mut out: Outbox) {
        let mut wait: VecDeque<(u8, CanFrame)> = out.drain().map(|f| (from, f)).collect();
        while let Some((from, frame)) = wait.pop_front() {
            self.log.push((from, frame));
            let mut out = Outbox::default();
            self.network.on_frame(self.now, &frame, &mut out);
            wait.extend(out.drain().map(|f| (0, f)));
            for slave in &mut self.slaves {
                if slave.id != from {
                    slave.on_frame(self.now, &frame, &mut out);
                    wait.extend(out.drain().map(|f| (slave.id, f)));
                }
            }
        }
        self.events.extend(self.network.drain_events());
        if let Some(sample) = self.network.exchange.take_sample() {
            self.samples.push((sample.sync, self.network.exchange.tail().to_vec()));
        }
    }

    fn run(&mut self, ms: u64) {
        for _ in 0..ms {
            self.now += MS;
            let mut out = Outbox::default();
            self.network.on_time(self.now, &mut out);
            self.pass(0, out);
            for i in 0..self.slaves.len() {
                let mut out = Outbox::default();
                self.slaves[i].on_time(self.now, &mut out);
                self.pass(self.slaves[i].id, out);
            }
        }
    }

    fn send(&mut self, from: u8, frame: CanFrame) {
        let mut out = Outbox::default();
        out.push(frame);
        self.pass(from, out);
    }

    fn said(&mut self) -> String {
        self.events.drain(..).map(|e| format!("{e:?}\n")).collect()
    }
}

#[test]
fn a_network_boots_and_exchanges() {
    let mut bus = Bus::new(config(json!([node(2), node(3)])), &[2, 3], false);
    bus.start();
    bus.run(200);
    insta::assert_snapshot!(bus.said(), @r"
    Booted { node: 2, attempts: 1, kept: false, loaded: None }
    Booted { node: 3, attempts: 1, kept: false, loaded: None }
    NetworkStarted
    ");
    assert!(bus.network.nodes().iter().all(NodeRun::is_operational));
    assert!(bus.slaves.iter().all(|s| s.state == NmtState::Operational));
    assert_eq!(bus.slaves[0].od.u16(0x1017, 0), Some(50));
    // The node watches the master at three times its heartbeat, but no shorter than a restart takes.
    assert_eq!(bus.slaves[0].od.u32(0x1016, 1), Some(0x0001_0000 + 500));
    bus.samples.clear();
    bus.send(2, CanFrame::classic(0x182, &[0x5A, 0]));
    assert_eq!(bus.samples.pop(), Some((false, vec![0x5A, 0, 0, 2])));
    bus.network.exchange.set_outputs(&[1, 2]);
    bus.run(1);
    assert_eq!(bus.slaves[0].pdos.last(), Some(&(0x202, vec![1, 0])));
    assert_eq!(bus.slaves[1].pdos.last(), Some(&(0x203, vec![2, 0])));
}

#[test]
fn a_lost_node_is_told_and_booted_when_it_returns() {
    let mut bus = Bus::new(config(json!([node(2)])), &[2], false);
    bus.start();
    bus.run(200);
    bus.send(2, CanFrame::classic(0x182, &[7, 0]));
    bus.said();
    bus.slaves[0].dead = true;
    bus.run(300);
    assert_eq!(bus.said(), "Lost { node: 2, guarding: false }\n");
    assert_eq!(bus.network.exchange.tail(), [7, 1]);
    bus.run(5000);
    let told = bus.said();
    // Once, however often it is tried.
    assert_eq!(told.matches("BootFailed").count(), 1, "{told}");
    assert!(told.contains("letter: B"), "{told}");
    let mut out = Outbox::default();
    bus.slaves[0].boot(&mut out);
    bus.pass(2, out);
    bus.run(200);
    let told = bus.said();
    assert!(told.contains("Booted { node: 2"), "{told}");
    assert!(bus.slaves[0].state == NmtState::Operational && bus.network.nodes()[0].is_operational());
}

#[test]
fn a_missing_mandatory_node_is_named_in_time() {
    let mut bus = Bus::new(config(json!([node(2), node(3)])), &[2], false);
    bus.start();
    bus.run(12_000);
    let told = bus.said();
    assert!(told.contains("MandatoryMissing { node: 3, missing: 1 }"), "{told}");
    assert!(!told.contains("NetworkStarted"));
    // The other one works all the same.
    assert!(bus.network.nodes()[0].is_operational() && !bus.network.is_started());
}

#[test]
fn a_takeover_disturbs_no_running_node() {
    let mut first = Bus::new(config(json!([node(2), node(3)])), &[2, 3], false);
    first.start();
    first.run(200);
    let resets: Vec<u32> = first.slaves.iter().map(|s| s.resets).collect();
    let mut second = Bus::new(config(json!([node(2), node(3)])), &[], true);
    second.slaves = first.slaves;
    second.slaves[1].state = NmtState::PreOperational;
    second.now = first.now;
    second.start();
    second.run(500);
    let told = second.said();
    assert!(told.contains("Booted { node: 2, attempts: 1, kept: true, loaded: None }"), "{told}");
    assert!(told.contains("Booted { node: 3, attempts: 1, kept: false, loaded: None }"), "{told}");
    assert_eq!(second.slaves[0].resets, resets[0]);
    assert_eq!(second.slaves[1].resets, resets[1] + 1);
    assert!(second.network.nodes().iter().all(NodeRun::is_operational));
    let to_running =
        |(from, f): &(u8, CanFrame)| *from == 0 && f.can_id == 0 && matches!(f.payload(), [_, 0 | 2]);
    assert_eq!(second.log.iter().filter(|e| to_running(e)).count(), 0);
}

#[test]
fn a_wrong_device_is_refused_with_its_letter() {
    let mut nodes = json!([node(2)]);
    nodes[0]["check"] = json!(["vendor", "serial"]);
    nodes[0]["serial_number"] = json!(99);
    let mut bus = Bus::new(config(nodes), &[2], false);
    bus.start();
    bus.run(3000);
    let failure = bus.network.nodes()[0].last_failure.unwrap();
    assert_eq!((failure.letter, failure.expected, failure.got), (Letter::O, Some(99), Some(0x44)));
    assert_eq!(bus.said().matches("BootFailed").count(), 1);
}

#[test]
fn sync_carries_the_counter_and_its_pdos_follow_at_once() {
    let mut table = config(json!([node(2)]));
    table["sync_period"] = json!("10ms");
    table["sync_overflow"] = json!(3);
    let mut bus = Bus::new(table, &[2], false);
    bus.start();
    bus.run(200);
    bus.log.clear();
    bus.samples.clear();
    bus.run(40);
    let of_master: Vec<(u32, u8)> = bus
        .log
        .iter()
        .filter(|(from, f)| *from == 0 && matches!(f.can_id, 0x80 | 0x202))
        .map(|(_, f)| (f.can_id, f.data[0]))
        .collect();
    assert_eq!(of_master.len(), 8, "{of_master:?}");
    for pair in of_master.chunks(2) {
        assert_eq!((pair[0].0, pair[1]), (0x80, (0x202, 0)));
        assert!((1..=3).contains(&pair[0].1));
    }
    // The node's PDO is type 1 now: one sample a SYNC.
    assert_eq!(bus.slaves[0].od.u8(0x1800, 2), Some(1));
    assert_eq!(bus.network.counters().syncs_missed, 0);
}

#[test]
fn bus_off_stops_sync_and_the_network_boots_again() {
    let mut table = config(json!([node(2)]));
    table["sync_period"] = json!("10ms");
    let mut bus = Bus::new(table, &[2], false);
    bus.start();
    bus.run(200);
    bus.said();
    bus.send(9, CanFrame { can_id: id_flag::ERR | 0x40, len: 8, ..CanFrame::default() });
    bus.log.clear();
    bus.slaves[0].dead = true;
    bus.run(100);
    assert_eq!(bus.said(), "BusOff\n");
    assert!(bus.log.is_empty());
    bus.slaves[0].dead = false;
    bus.send(9, CanFrame { can_id: id_flag::ERR | 0x100, len: 8, ..CanFrame::default() });
    bus.run(300);
    let told = bus.said();
    assert!(told.contains("BusBack") && told.contains("Booted { node: 2"), "{told}");
    assert_eq!(bus.network.counters().bus_offs, 1);
}

#[test]
fn two_devices_with_one_node_id_are_found() {
    let mut bus = Bus::new(config(json!([node(2)])), &[2], false);
    bus.start();
    bus.run(200);
    bus.said();
    for _ in 0..5 {
        bus.run(30);
        bus.send(9, heartbeat(2, 127));
    }
    assert!(bus.said().contains("Duplicate { node: 2, sign: States }"));
}

fn heartbeat(node: u32, state: u8) -> CanFrame {
    CanFrame::classic(0x700 + node, &[state])
}

#[test]
fn emergencies_and_strangers_are_told() {
    let mut bus = Bus::new(config(json!([node(2)])), &[2], false);
    bus.start();
    bus.run(200);
    bus.said();
    bus.send(2, CanFrame::classic(0x82, &[0x10, 0x82, 0x11, 1, 2, 3, 4, 5]));
    bus.send(9, CanFrame::classic(0x709, &[0]));
    bus.send(9, CanFrame::classic(0x709, &[0]));
    insta::assert_snapshot!(bus.said(), @r"
    Emcy { node: 2, code: 33296, register: 17, vendor: [1, 2, 3, 4, 5] }
    Unknown { node: 9 }
    ");
}

#[test]
fn start_all_waits_for_the_mandatory_nodes() {
    let mut table = config(json!([node(2), node(3)]));
    table["start_all_nodes"] = json!(true);
    let mut bus = Bus::new(table, &[2], false);
    bus.start();
    bus.run(500);
    assert_eq!(bus.slaves[0].state, NmtState::PreOperational);
    let mut late = Slave::new(3);
    let mut out = Outbox::default();
    late.boot(&mut out);
    bus.slaves.push(late);
    bus.pass(3, out);
    bus.run(500);
    assert!(bus.slaves.iter().all(|s| s.state == NmtState::Operational));
}

#[test]
fn guarding_sees_a_node_go() {
    let mut nodes = json!([node(2)]);
    let entry = nodes[0].as_object_mut().unwrap();
    entry.remove("heartbeat");
    entry.insert("guarding".to_owned(), json!({ "time": "50ms", "factor": 2 }));
    let config: MasterConfig = serde_json::from_value(config(nodes)).unwrap();
    let devices = BTreeMap::from([(2, device(2))]);
    let plan = plan(&config, &devices, Addressing::Element, "io");
    // The test device has no guarding, and says so.
    assert_eq!(plan.mistakes.len(), 1);
    assert!(plan.mistakes[0].message.contains("100Ch"));
}

mod anything {
    use super::*;
    use proptest::prelude::*;

    fn frame() -> impl Strategy<Value = CanFrame> {
        let id = prop_oneof![Just(0x700u32), Just(0x580), Just(0x80), Just(0x180), Just(0x000), 0u32..0x800];
        (id, 0u32..4, any::<[u8; 8]>(), 0usize..9, any::<bool>()).prop_map(|(id, node, data, len, error)| {
            let mut frame = CanFrame::classic((id + node) & 0x7FF, &data[..len]);
            if error && id == 0x180 {
                frame.can_id = id_flag::ERR | u32::from(data[0]) << 1;
            }
            frame
        })
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        /// Any frame at any moment: no panic, and the network runs again once the storm is over.
        #[test]
        fn never_stuck(frames in prop::collection::vec((frame(), 0u64..200), 0..120)) {
            let mut bus = Bus::new(config(json!([node(2), node(3)])), &[2, 3], false);
            bus.start();
            for (frame, wait) in frames {
                bus.send(9, frame);
                bus.run(wait);
            }
            bus.send(9, CanFrame { can_id: id_flag::ERR | 0x100, len: 8, ..CanFrame::default() });
            bus.run(8000);
            prop_assert!(bus.network.nodes().iter().all(NodeRun::is_operational), "{}", bus.said());
        }
    }
}

#[test]
fn the_sync_goes_before_its_pdos_and_says_how_late_it_is() {
    let mut config = config(json!([]));
    config["sync_period"] = "10ms".into();
    let mut bus = Bus::new(config, &[], false);
    bus.start();
    let first = bus.network.next_sync_ns.unwrap();
    let mut out = Outbox::default();
    assert_eq!(bus.network.sync(first, &mut out), Some(0));
    assert_eq!(bus.network.sync(first, &mut out), None, "once");
    assert_eq!(out.drain().count(), 1);
    let late = first + 10 * MS + 7_000;
    assert!(!bus.network.is_sync_near(first + 5 * MS) && bus.network.is_sync_near(first + 9 * MS));
    assert!(bus.network.is_sync_near(late), "it is due");
    assert_eq!(bus.network.sync(late, &mut out), Some(7_000));
    assert!(!bus.network.is_sync_near(late), "there is always time behind a SYNC");
    // Two and a half periods slept over: the grid stays.
    assert_eq!(bus.network.sync(first + 45 * MS, &mut out), Some(25 * MS));
    assert_eq!((bus.network.counters().syncs, bus.network.counters().syncs_missed), (3, 2));
    assert_eq!(bus.network.next_sync_ns, Some(first + 50 * MS));
    assert_eq!(out.len(), 2);
}

/// What the master sent to a node by NMT since the last look; 0 is all.
fn commands(bus: &mut Bus) -> Vec<(u8, u8)> {
    let of_master = |(from, frame): (u8, CanFrame)| {
        (from == 0 && frame.can_id == predefined::NMT).then(|| (frame.data[0], frame.data[1]))
    };
    bus.log.drain(..).filter_map(of_master).collect()
}

fn set_safe(bus: &mut Bus, safe: Option<NmtCommand>) {
    let mut out = Outbox::default();
    bus.network.set_safe(bus.now, safe, &mut out);
    bus.pass(0, out);
}

#[test]
fn the_end_of_the_safe_state_starts_what_it_held_and_nothing_else() {
    let mut bus = Bus::new(config(json!([node(2), node(3)])), &[2, 3], false);
    bus.start();
    bus.run(200);
    // A user stopped node 3 before.
    let mut out = Outbox::default();
    bus.network.nmt(bus.now, NmtCommand::Stop, 3, &mut out);
    bus.pass(0, out);
    bus.log.clear();
    set_safe(&mut bus, Some(NmtCommand::EnterPreOperational));
    assert_eq!(commands(&mut bus), [(128, 2)]);
    bus.run(200);
    assert!(!bus.network.nodes()[0].is_operational());
    assert_eq!(commands(&mut bus), []);
    set_safe(&mut bus, None);
    assert_eq!(commands(&mut bus), [(1, 2)]);
    bus.run(200);
    assert!(bus.network.nodes()[0].is_operational() && !bus.network.nodes()[1].is_operational());
}

#[test]
fn what_boots_in_the_safe_state_is_held_and_started_at_its_end() {
    for all in [false, true] {
        let mut config = config(json!([node(2), node(3)]));
        config["start_all_nodes"] = all.into();
        let mut bus = Bus::new(config, &[2, 3], false);
        set_safe(&mut bus, Some(NmtCommand::EnterPreOperational));
        bus.start();
        bus.run(200);
        assert!(bus.network.is_started());
        let sent = commands(&mut bus);
        assert!(
            sent.contains(&(128, 2)) && sent.contains(&(128, 3)) && sent.iter().all(|c| c.0 != 1),
            "{sent:?}"
        );
        set_safe(&mut bus, None);
        assert_eq!(commands(&mut bus), [(1, 2), (1, 3)], "start_all_nodes = {all}");
        bus.run(200);
        assert!(bus.network.nodes().iter().all(NodeRun::is_operational), "start_all_nodes = {all}");
    }
}

#[test]
fn a_node_that_is_not_started_after_a_boot_up_is_not_started_by_the_end_of_the_safe_state() {
    let mut config = config(json!([node(2)]));
    config["start_nodes"] = false.into();
    let mut bus = Bus::new(config, &[2], false);
    bus.start();
    bus.run(200);
    // A user started it; in the safe state it begins again.
    let mut out = Outbox::default();
    bus.network.nmt(bus.now, NmtCommand::Start, 2, &mut out);
    bus.pass(0, out);
    bus.run(100);
    assert!(bus.network.nodes()[0].is_operational());
    set_safe(&mut bus, Some(NmtCommand::EnterPreOperational));
    bus.send(2, CanFrame::classic(0x702, &[0]));
    bus.run(300);
    assert!(bus.network.nodes()[0].boot.is_running());
    bus.log.clear();
    set_safe(&mut bus, None);
    bus.run(200);
    assert_eq!(commands(&mut bus), []);
}

#[test]
fn nodes_that_start_together_exchange_also_without_error_control() {
    let mut one = node(2);
    one.as_object_mut().unwrap().remove("heartbeat");
    let mut config = config(json!([one]));
    config["start_all_nodes"] = true.into();
    let mut bus = Bus::new(config, &[2], false);
    bus.start();
    bus.run(100);
    assert!(bus.network.nodes()[0].is_operational());
}

#[test]
fn a_node_that_does_not_come_back_from_a_reset_is_lost() {
    let mut bus = Bus::new(config(json!([node(2)])), &[2], false);
    bus.start();
    bus.run(200);
    bus.said();
    bus.slaves.clear();
    let mut out = Outbox::default();
    bus.network.nmt(bus.now, NmtCommand::ResetNode, 2, &mut out);
    bus.pass(0, out);
    bus.run(9_900);
    assert_eq!(bus.said(), "", "ten seconds for its boot-up message: drives need some");
    bus.run(200);
    assert_eq!(bus.said(), "Lost { node: 2, guarding: false }\n");
}

#[test]
fn an_answer_to_a_question_before_bus_off_answers_none_behind_it() {
    let mut with_serial = node(2);
    with_serial["check"] = json!(["device_type", "vendor"]);
    let mut bus = Bus::new(config(json!([with_serial])), &[2], false);
    let slave = bus.slaves.pop().unwrap();
    bus.start();
    bus.run(20);
    // It was asked for its device type, and the bus went off and came back before it answered.
    for class in [0x40, 0x100] {
        bus.send(9, CanFrame { can_id: id_flag::ERR | class, len: 8, ..CanFrame::default() });
    }
    bus.log.clear();
    bus.slaves.push(slave);
    bus.run(1500);
    assert!(bus.network.nodes()[0].boot.is_running());
    let said = bus.said();
    assert!(!said.contains("BootFailed"), "{said}");
}
