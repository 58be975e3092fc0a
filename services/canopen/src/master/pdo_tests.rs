//! 64 PDOs that the master maps anew, against a whole node that refuses every write out of step.

use super::exchange::Exchange;
use super::network::{Event, Network};
use super::plan::plan;
use super::transfers::Transfers;
use crate::config::MasterConfig;
use crate::device::Device;
use crate::protocol::data_type::DataType;
use crate::protocol::io::Outbox;
use crate::protocol::node::{Node, NodeParams};
use crate::protocol::od::{Access, EntryDef, ObjectDictionary, OdBuilder};
use dinrail_iec::Addressing;
use ipc_types::payload::CanFrame;
use serde_json::json;
use std::collections::BTreeMap;

const MS: u64 = 1_000_000;
const NODE: u8 = 5;
/// PDOs each way.
const PDOS: u16 = 32;

fn pdo(builder: &mut OdBuilder, comm: u16) {
    let entry = |data_type| EntryDef::new(data_type, Access::Rw);
    let (u8_, u16_, u32_) = (DataType::Unsigned8, DataType::Unsigned16, DataType::Unsigned32);
    // Without COB-ID and without mapping: everything is the master's work.
    let fields = vec![
        (1, entry(u32_).value(0x8000_0000)),
        (2, entry(u8_).value(255)),
        (3, entry(u16_)),
        (5, entry(u16_)),
    ];
    builder.record(comm, Access::Ro, fields);
    builder.record(comm + 0x200, Access::Rw, (1..=8).map(|sub| (sub, entry(u32_))).collect());
    if let Some(object) = builder.object_mut(comm + 0x200) {
        object.subs[0].1 = entry(u8_).value(0);
    }
}

/// 32 channels each way, a byte and a word each, and as many PDOs that carry nothing yet.
fn dictionary() -> ObjectDictionary {
    let mut b = OdBuilder::new();
    let var = |data_type, access| EntryDef::new(data_type, access);
    let ro32 = || var(DataType::Unsigned32, Access::Ro);
    b.var(0x1000, ro32().value(0x191));
    b.var(0x1001, var(DataType::Unsigned8, Access::Ro));
    b.var(0x1017, var(DataType::Unsigned16, Access::Rw));
    b.record(0x1018, Access::Ro, (1u8..=4).map(|i| (i, ro32().value(i64::from(i)))).collect());
    for n in 0..PDOS {
        pdo(&mut b, 0x1400 + n);
        pdo(&mut b, 0x1800 + n);
    }
    let channels = |data_type, access| {
        (1..=PDOS as u8).map(|sub| (sub, var(data_type, access).mappable())).collect::<Vec<_>>()
    };
    b.record(0x6000, Access::Ro, channels(DataType::Unsigned8, Access::Ro));
    b.record(0x6200, Access::Ro, channels(DataType::Unsigned8, Access::Rw));
    b.record(0x6401, Access::Ro, channels(DataType::Integer16, Access::Ro));
    b.record(0x6411, Access::Ro, channels(DataType::Integer16, Access::Rw));
    b.build(NODE).unwrap()
}

fn config() -> MasterConfig {
    let pdo = |base: u16, objects: [&str; 2]| {
        (1..=PDOS)
            .map(|n| {
                let mapping: Vec<String> = objects.iter().map(|o| format!("{o}:{n:02X}")).collect();
                json!({ "number": n, "cob_id": base + n, "transmission": 255, "mapping": mapping })
            })
            .collect::<Vec<_>>()
    };
    let map: Vec<_> = (1..=PDOS)
        .flat_map(|n| {
            let at = (n - 1) * 4;
            [
                json!({ "object": format!("6000:{n:02X}"), "to": format!("%IB{at}") }),
                json!({ "object": format!("6401:{n:02X}"), "to": format!("%IW{}", at / 2 + 1) }),
                json!({ "object": format!("6200:{n:02X}"), "from": format!("%QB{at}") }),
                json!({ "object": format!("6411:{n:02X}"), "from": format!("%QW{}", at / 2 + 1) }),
            ]
        })
        .collect();
    serde_json::from_value(json!({ "node_id": 1, "node": [{
        "id": NODE, "eds": "x", "heartbeat": "50ms", "mandatory": true,
        "tpdo": pdo(0x1A0, ["6000", "6401"]), "rpdo": pdo(0x2A0, ["6200", "6411"]), "map": map,
    }] }))
    .unwrap()
}

struct Bench {
    network: Network,
    node: Node,
    now: u64,
    /// Every write of the master, as index, sub-index and value.
    writes: Vec<(u16, u8, u32)>,
    answers: usize,
    /// This answer of the node is lost.
    lost: usize,
    events: Vec<Event>,
}

impl Bench {
    fn new(lost: usize) -> Self {
        let config = config();
        let device =
            Device { name: "64".to_owned(), od: dictionary(), names: Vec::new(), values: Vec::new() };
        let plan = plan(&config, &BTreeMap::from([(NODE, device)]), Addressing::Element, "io");
        assert!(plan.mistakes.iter().all(|m| m.warning), "{:?}", plan.mistakes);
        assert_eq!((plan.exchange.rx.len(), plan.exchange.tx.len()), (32, 32));
        let nodes = plan.nodes.into_iter().map(|n| n.settings).collect();
        let exchange = Exchange::new(plan.exchange, plan.sync_window_ns);
        Self {
            network: Network::new(plan.settings, nodes, exchange, Transfers::new([(NODE, 500 * MS)])),
            node: Node::new(dictionary(), NodeParams::new(NODE), &[]).unwrap(),
            now: 0,
            writes: Vec::new(),
            answers: 0,
            lost,
            events: Vec::new(),
        }
    }

    fn seen(&mut self, frame: &CanFrame) {
        if frame.can_id == 0x600 + u32::from(NODE) && frame.data[0] & 0xE0 == 0x20 {
            let d = &frame.data;
            let value = u32::from_le_bytes([d[4], d[5], d[6], d[7]]);
            self.writes.push((u16::from_le_bytes([d[1], d[2]]), d[3], value));
        }
    }

    /// Carries frames of the master to the node and back until there are none.
    fn pass(&mut self, mut of_master: Outbox, mut of_node: Outbox) {
        loop {
            let (down, up): (Vec<_>, Vec<_>) = (of_master.drain().collect(), of_node.drain().collect());
            if down.is_empty() && up.is_empty() {
                break;
            }
            for frame in down {
                self.seen(&frame);
                self.node.on_frame(self.now, &frame, &mut of_node);
            }
            for frame in up {
                if frame.can_id == 0x580 + u32::from(NODE) {
                    self.answers += 1;
                    if self.answers == self.lost {
                        continue;
                    }
                }
                self.network.on_frame(self.now, &frame, &mut of_master);
            }
            while self.node.next_event().is_some() {}
        }
        self.events.extend(self.network.drain_events());
    }

    fn run(&mut self, ms: u64) {
        for _ in 0..ms {
            self.now += MS;
            let (mut of_master, mut of_node) = (Outbox::default(), Outbox::default());
            self.network.on_time(self.now, &mut of_master);
            self.node.on_time(self.now, &mut of_node);
            self.pass(of_master, of_node);
        }
    }

    fn boot(&mut self) {
        let (mut of_master, mut of_node) = (Outbox::default(), Outbox::default());
        self.node.start(self.now, &mut of_node);
        self.network.start(self.now, &mut of_master);
        self.pass(of_master, of_node);
        for _ in 0..100 {
            if self.network.is_started() && self.network.nodes()[0].is_operational() {
                return;
            }
            self.run(100);
        }
        panic!("the node is not operational; answer {} was lost: {:?}", self.lost, self.events);
    }

    fn configured(&self) {
        let value = |index, sub| {
            let data = self.node.read(index, sub).unwrap();
            data.iter().rev().fold(0u32, |value, &byte| value << 8 | u32::from(byte))
        };
        for n in 0..PDOS {
            let channel = u32::from(n + 1);
            for (comm, cob_id, objects) in [
                (0x1800 + n, 0x1A0, [0x6000_0008, 0x6401_0010]),
                (0x1400 + n, 0x2A0, [0x6200_0008, 0x6411_0010]),
            ] {
                let at = format!("{comm:04X}, answer {} lost", self.lost);
                assert_eq!((value(comm, 1), value(comm, 2)), (cob_id + channel, 255), "{at}");
                assert_eq!(value(comm + 0x200, 0), 2, "{at}");
                for (sub, object) in (1..).zip(objects) {
                    assert_eq!(value(comm + 0x200, sub), object | channel << 8, "{at}");
                }
            }
        }
    }

    /// A value through each of the PDOs.
    fn exchanges(&mut self) {
        let outputs: Vec<u8> = (0..PDOS as u8).flat_map(|n| [n + 1, n, 0x40 + n]).collect();
        self.network.exchange.set_outputs(&outputs);
        self.run(50);
        let (of_master, mut of_node) = (Outbox::default(), Outbox::default());
        for n in 0..PDOS as u8 {
            assert_eq!(self.node.read(0x6200, n + 1).unwrap(), [n + 1], "RPDO {}", n + 1);
            assert_eq!(self.node.read(0x6411, n + 1).unwrap(), [n, 0x40 + n]);
            self.node.write(self.now, 0x6000, n + 1, &[0x80 + n], &mut of_node).unwrap();
            self.node.write(self.now, 0x6401, n + 1, &[0xA0 + n, n], &mut of_node).unwrap();
        }
        self.pass(of_master, of_node);
        self.run(50);
        let expected: Vec<u8> = (0..PDOS as u8).flat_map(|n| [0x80 + n, 0xA0 + n, n]).collect();
        let tail = self.network.exchange.tail();
        // Behind the values is the quality of each.
        let values = &tail[..expected.len()];
        assert_eq!(values, expected, "{tail:02X?}");
    }
}

/// The writes to one PDO in the order that CiA 301 V4.2, 7.5.2.36 wants: off, no mapping, objects, count, on.
fn in_step(writes: &[(u16, u8, u32)], comm: u16) {
    let map = comm + 0x200;
    let own: Vec<(u16, u8, u32)> =
        writes.iter().copied().filter(|(index, ..)| *index == comm || *index == map).collect();
    let at = |what: &str, wanted: &dyn Fn(&(u16, u8, u32)) -> bool| {
        own.iter().position(wanted).unwrap_or_else(|| panic!("{comm:04X}: {what} is not written: {own:X?}"))
    };
    let off = at("COB-ID off", &|w| (w.0, w.1) == (comm, 1) && w.2 >> 31 == 1);
    let none = at("count 0", &|w| *w == (map, 0, 0));
    let first = at("object 1", &|w| (w.0, w.1) == (map, 1));
    let second = at("object 2", &|w| (w.0, w.1) == (map, 2));
    let count = at("count 2", &|w| *w == (map, 0, 2));
    let on = at("COB-ID on", &|w| (w.0, w.1) == (comm, 1) && w.2 >> 31 == 0);
    assert!([off, none, first, second, count, on].is_sorted(), "{comm:04X}: {own:X?}");
    assert_eq!(on, own.len() - 1, "{comm:04X}: nothing is written to a PDO that is on: {own:X?}");
}

#[test]
fn sixty_four_pdos_are_mapped_in_lock_step() {
    let mut bench = Bench::new(0);
    bench.boot();
    bench.configured();
    for n in 0..PDOS {
        in_step(&bench.writes, 0x1400 + n);
        in_step(&bench.writes, 0x1800 + n);
    }
    assert!(bench.events.iter().any(|e| matches!(e, Event::Booted { node: NODE, attempts: 1, .. })));
    bench.exchanges();
}

#[test]
fn a_lost_answer_leaves_no_pdo_behind() {
    let mut all = Bench::new(0);
    all.boot();
    assert!(all.answers > 64 * 6, "{}", all.answers);
    // Those of one receive and one transmit PDO each, and others here and there.
    let some = (1..all.answers).filter(|n| n % 13 == 0 || *n < 30 || (200..230).contains(n));
    for lost in some {
        let mut bench = Bench::new(lost);
        bench.boot();
        bench.configured();
        assert!(bench.events.iter().all(|e| !matches!(e, Event::BootFailed { .. })), "{:?}", bench.events);
        bench.exchanges();
    }
}

/// More PDOs at once than an outbox holds: none is taken for sent that was not.
#[test]
fn pdos_that_find_no_room_are_sent_later() {
    use crate::master::exchange::{Field, Plan, TxPdo};
    const PDOS: u32 = 600;
    for transmission in [255, 0] {
        let field = Field { at: 0, bytes: 1, pdo_bit: 0, bits: 8, range: 0, signed: false };
        let tx = |id| TxPdo {
            cob_id: 0x8000_0000 | id,
            node: 5,
            length: 1,
            transmission,
            inhibit_ns: 0,
            event_ns: None,
            fields: vec![field],
        };
        let plan = Plan { tx: (0..PDOS).map(tx).collect(), output_bytes: 1, ..Plan::default() };
        let mut exchange = Exchange::new(plan, 0);
        exchange.set_operational(5, true, 0);
        let mut out = Outbox::default();
        let mut sent = Vec::new();
        for t_ns in 1..=3 {
            if transmission == 255 {
                assert_eq!(exchange.next_deadline().is_some(), sent.len() < PDOS as usize);
                exchange.on_time(t_ns, &mut out);
            } else {
                exchange.sync_pdos(t_ns, &mut out);
            }
            sent.extend(out.drain().map(|frame| frame.can_id));
        }
        assert_eq!((sent.len(), out.dropped), (PDOS as usize, 0), "type {transmission}");
        assert_eq!(exchange.counters().tx_pdos, u64::from(PDOS));
        sent.sort_unstable();
        sent.dedup();
        assert_eq!(sent.len(), PDOS as usize);
    }
}
