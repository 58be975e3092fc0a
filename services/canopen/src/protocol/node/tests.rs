use super::*;
use crate::protocol::cob_id::{CobId, is_restricted};
use crate::protocol::data_type::DataType;
use crate::protocol::emcy::Emcy;
use crate::protocol::error_control::MS;
use crate::protocol::nmt::heartbeat_frame;
use crate::protocol::od::{Access, EntryDef, OdBuilder};
use ipc_types::payload::id_flag;
use proptest::prelude::*;

fn number(data_type: DataType) -> EntryDef {
    EntryDef::new(data_type, Access::Rw)
}

/// A device with everything: two RPDOs into 2100:1-8, two TPDOs out of 2200:1-8, bits in 2300:1-64.
fn builder() -> OdBuilder {
    use DataType::{Boolean, Unsigned8, Unsigned16, Unsigned32};
    let mut od = OdBuilder::new();
    let u32_of = |value: i64| number(Unsigned32).value(value);
    od.var(0x1000, EntryDef::new(Unsigned32, Access::Ro).value(0x191));
    od.var(0x1001, EntryDef::new(Unsigned8, Access::Ro).mappable());
    od.array(0x1003, 8, EntryDef::new(Unsigned32, Access::Ro));
    od.object_mut(0x1003).unwrap().subs[0].1 = number(Unsigned8);
    od.var(0x1005, u32_of(0x80)).var(0x1006, u32_of(0)).var(0x1007, u32_of(0));
    od.var(0x100C, number(Unsigned16)).var(0x100D, number(Unsigned8));
    od.array(0x1010, 3, u32_of(1)).array(0x1011, 3, u32_of(1));
    od.var(0x1012, u32_of(0x100)).var(0x1014, number(Unsigned32).value_plus_node_id(0x80));
    od.var(0x1015, number(Unsigned16)).array(0x1016, 127, u32_of(0)).var(0x1017, number(Unsigned16));
    od.array(0x1018, 4, EntryDef::new(Unsigned32, Access::Ro).value(7)).var(0x1019, number(Unsigned8));
    od.array(0x1028, 127, u32_of(0x8000_0000)).array(0x1029, 1, number(Unsigned8));
    od.var(0x1F80, u32_of(4));
    for n in 0..4u16 {
        let rpdo = number(Unsigned32).value_plus_node_id(0x200 + 0x100 * u32::from(n));
        let tpdo = number(Unsigned32).value_plus_node_id(0x180 + 0x100 * u32::from(n));
        let kind = || (2, number(Unsigned8).value(255));
        let timer = || (5, number(Unsigned16));
        od.record(0x1400 + n, Access::Ro, vec![(1, rpdo), kind(), timer()]);
        let (inhibit, start) = ((3, number(Unsigned16)), (6, number(Unsigned8)));
        od.record(0x1800 + n, Access::Ro, vec![(1, tpdo), kind(), inhibit, timer(), start]);
        for (mapping, object) in [(0x1600 + n, 0x2100_0008u32), (0x1A00 + n, 0x2200_0008)] {
            od.array(mapping, 64, u32_of(0));
            let subs = &mut od.object_mut(mapping).unwrap().subs;
            subs[0].1 = number(Unsigned8).value(2);
            for (at, (_, def)) in subs.iter_mut().enumerate().skip(1).take(2) {
                *def = u32_of(i64::from(object | (u32::from(n) * 2 + at as u32) << 8));
            }
        }
    }
    let byte = || number(Unsigned8).mappable();
    od.array(0x2100, 8, byte()).array(0x2200, 8, byte());
    od.array(0x2300, 64, number(Boolean).mappable()).array(0x2301, 64, number(Boolean).mappable());
    (1..=7).for_each(|dummy| {
        od.dummy(dummy);
    });
    od
}

/// A node on its own, in virtual time.
struct Bench {
    node: Node,
    t_ns: u64,
    out: Outbox,
}

impl Bench {
    fn new(node_id: u8) -> Self {
        Self::with(builder().build(node_id).unwrap(), node_id, &[])
    }
    fn with(od: ObjectDictionary, node_id: u8, stored: &[u8]) -> Self {
        let node = Node::new(od, NodeParams::new(node_id), stored).unwrap();
        let mut bench = Self { node, t_ns: 0, out: Outbox::default() };
        bench.node.start(0, &mut bench.out);
        bench
    }
    fn sent(&mut self) -> Vec<(u32, Vec<u8>)> {
        self.out.drain().map(|frame| (frame.can_id, frame.payload().to_vec())).collect()
    }
    fn frame(&mut self, id: u32, data: &[u8]) -> Vec<(u32, Vec<u8>)> {
        self.node.on_frame(self.t_ns, &CanFrame::classic(id, data), &mut self.out);
        self.sent()
    }
    fn until(&mut self, t_ms: u64) -> Vec<(u32, Vec<u8>)> {
        let end = t_ms * MS;
        for _ in 0..100_000 {
            let Some(due) = self.node.next_deadline().filter(|&due| due <= end) else {
                self.t_ns = end;
                return self.sent();
            };
            self.t_ns = self.t_ns.max(due);
            self.node.on_time(self.t_ns, &mut self.out);
        }
        panic!("the node asks for time without end");
    }
    fn set(&mut self, index: u16, sub: u8, value: u64) {
        let entry = self.node.od().find(index, sub).unwrap();
        let len = self.node.od().get(entry).len();
        self.node.write(self.t_ns, index, sub, &value.to_le_bytes()[..len], &mut self.out).unwrap();
    }
    /// Expedited download; abort code, or 0.
    fn sdo(&mut self, index: u16, sub: u8, data: &[u8]) -> u32 {
        let mut request = vec![0x23 | (4 - data.len() as u8) << 2, index as u8, (index >> 8) as u8, sub];
        request.extend_from_slice(data);
        request.resize(8, 0);
        let id = u32::from(self.node.node_id());
        let sent = self.frame(0x600 + id, &request);
        let (_, answer) = sent.iter().find(|sent| sent.0 == 0x580 + id).expect("an SDO answer");
        match answer[0] {
            0x60 => 0,
            _ => u32::from_le_bytes(answer[4..8].try_into().unwrap()),
        }
    }
    fn start(&mut self) -> Vec<(u32, Vec<u8>)> {
        self.sent();
        self.frame(0, &[1, self.node.node_id()])
    }
    fn events(&mut self) -> Vec<NodeEvent> {
        std::iter::from_fn(|| self.node.next_event()).collect()
    }
    fn value(&self, index: u16, sub: u8) -> u64 {
        self.node.od().u64(index, sub).unwrap()
    }
}

#[test]
fn boots_and_starts_by_itself_if_1f80_says_so() {
    let mut bench = Bench::new(4);
    assert_eq!(bench.sent(), [(0x704, vec![0])]);
    assert_eq!(bench.node.state(), NmtState::PreOperational);
    let mut od = builder().build(4).unwrap();
    od.set_uint(0x1F80, 0, 0).unwrap();
    let mut node = Bench::with(od, 4, &[]);
    assert_eq!(node.node.state(), NmtState::PreOperational, "a reset takes the defaults");
    node.set(0x1F80, 0, 0);
    assert_eq!(node.sdo(0x1010, 1, b"save"), 0);
    let image = node.node.store_image().to_vec();
    let mut again = Bench::with(builder().build(4).unwrap(), 4, &image);
    assert_eq!(again.node.state(), NmtState::Operational);
    let ids: Vec<_> = again.sent().iter().map(|sent| sent.0).collect();
    assert_eq!(ids, [0x704, 0x184, 0x284, 0x384, 0x484]);
}

#[test]
fn node_id_is_checked() {
    let error = Node::new(builder().build(0).unwrap(), NodeParams::new(128), &[]).unwrap_err();
    insta::assert_snapshot!(error, @"node-id 128 is none: it must be 1 to 127, or 255 for a device that LSS gives one");
}

#[test]
fn event_driven_pdos_with_inhibit_and_event_time() {
    let mut bench = Bench::new(4);
    assert_eq!(bench.sdo(0x1800, 1, &0x8000_0184u32.to_le_bytes()), 0);
    assert_eq!(bench.sdo(0x1800, 3, &100u16.to_le_bytes()), 0);
    assert_eq!(bench.sdo(0x1800, 5, &50u16.to_le_bytes()), 0);
    assert_eq!(bench.sdo(0x1800, 1, &0x184u32.to_le_bytes()), 0);
    assert_eq!(bench.sdo(0x1800, 3, &0u16.to_le_bytes()), 0x0609_0030, "not while the PDO exists");
    bench.start();
    let tpdo1 = |sent: Vec<(u32, Vec<u8>)>| -> Vec<_> { sent.into_iter().filter(|s| s.0 == 0x184).collect() };
    // The start sent it at 0: changes within 10 ms wait and go out as one.
    bench.set(0x2200, 1, 1);
    bench.set(0x2200, 1, 2);
    bench.set(0x2200, 2, 3);
    assert!(tpdo1(bench.until(9)).is_empty());
    assert_eq!(tpdo1(bench.until(10)), [(0x184, vec![2, 3])]);
    // The same value is no event; the event timer sends anyway, 50 ms after the last.
    bench.set(0x2200, 1, 2);
    assert!(tpdo1(bench.until(59)).is_empty());
    assert_eq!(tpdo1(bench.until(60)), [(0x184, vec![2, 3])]);
    bench.frame(0, &[128, 4]);
    assert!(tpdo1(bench.until(1000)).is_empty());
}

#[test]
fn synchronous_rpdos_take_effect_at_the_next_sync() {
    let mut bench = Bench::new(4);
    assert_eq!(bench.sdo(0x1400, 2, &[1]), 0);
    bench.start();
    bench.events();
    bench.frame(0x204, &[5, 6]);
    bench.frame(0x204, &[7, 8]);
    assert_eq!(bench.value(0x2100, 1), 0);
    bench.frame(0x080, &[]);
    assert_eq!((bench.value(0x2100, 1), bench.value(0x2100, 2)), (7, 8), "the newest");
    assert_eq!(bench.events(), [NodeEvent::Received { number: 0 }, NodeEvent::Sync { counter: 0 }]);
    // Behind the synchronous window it is thrown away.
    bench.set(0x1007, 0, 1000);
    bench.frame(0x080, &[]);
    bench.until(2);
    bench.frame(0x204, &[9, 9]);
    bench.frame(0x080, &[]);
    assert_eq!(bench.value(0x2100, 1), 7);
}

#[test]
fn rpdo_errors_are_told_once_and_resolved() {
    let mut bench = Bench::new(4);
    assert_eq!(bench.sdo(0x1400, 5, &100u16.to_le_bytes()), 0);
    bench.start();
    let codes = |sent: Vec<(u32, Vec<u8>)>| -> Vec<(u16, u8)> {
        let emcys = sent.iter().filter(|s| s.0 == 0x084).filter_map(|s| Emcy::decode(&s.1));
        emcys.map(|emcy| (emcy.code, emcy.register)).collect()
    };
    assert_eq!(codes(bench.frame(0x204, &[1])), [(0x8210, 0x11)]);
    assert_eq!(bench.value(0x2100, 1), 0, "not processed");
    assert_eq!(codes(bench.frame(0x204, &[])), []);
    assert_eq!(codes(bench.frame(0x204, &[1, 2, 3])), [(0x8220, 0x11)]);
    assert_eq!((bench.value(0x2100, 1), bench.value(0x2100, 2)), (1, 2), "the first bytes are");
    assert_eq!(codes(bench.frame(0x204, &[3, 4])), [(0, 0x11), (0, 0)]);
    assert_eq!(codes(bench.until(99)), []);
    assert_eq!(codes(bench.until(100)), [(0x8250, 0x11)]);
    assert_eq!(codes(bench.until(500)), []);
    assert_eq!(codes(bench.frame(0x204, &[3, 4])), [(0, 0)]);
    assert_eq!(bench.node.error_history(), [0x0204_8250, 0x0204_8220, 0x0204_8210]);
    let answer = bench.frame(0x604, &[0x40, 0x03, 0x10, 0, 0, 0, 0, 0]);
    assert_eq!(answer, [(0x584, vec![0x4F, 0x03, 0x10, 0, 3, 0, 0, 0])]);
    assert_eq!(bench.sdo(0x1003, 0, &[0]), 0);
    assert!(bench.node.error_history().is_empty());
}

#[test]
fn sixty_four_bits_and_dummies() {
    let mut bench = Bench::new(4);
    for (cob, mapping, object) in [(0x1400, 0x1600, 0x2300_0001u32), (0x1800, 0x1A00, 0x2301_0001)] {
        let id = if cob == 0x1400 { 0x204u32 } else { 0x184 };
        assert_eq!(bench.sdo(cob, 1, &(0x8000_0000 | id).to_le_bytes()), 0);
        assert_eq!(bench.sdo(mapping, 0, &[0]), 0);
        for sub in 1..=64u8 {
            assert_eq!(bench.sdo(mapping, sub, &(object | u32::from(sub) << 8).to_le_bytes()), 0);
        }
        assert_eq!(bench.sdo(mapping, 0, &[65]), 0x0604_0042);
        assert_eq!(bench.sdo(mapping, 0, &[64]), 0);
        assert_eq!(bench.sdo(cob, 1, &id.to_le_bytes()), 0);
    }
    bench.start();
    bench.frame(0x204, &0x8123_4567_89AB_CDEFu64.to_le_bytes());
    let bits = (1..=64).fold(0u64, |bits, sub| bits | bench.value(0x2300, sub as u8) << (sub - 1));
    assert_eq!(bits, 0x8123_4567_89AB_CDEF);
    bench.set(0x2301, 64, 1);
    assert_eq!(bench.sent(), [(0x184, vec![0, 0, 0, 0, 0, 0, 0, 0x80])]);
    // One bit, seven dummy bits would not exist: BOOLEAN dummies do.
    assert_eq!(bench.sdo(0x1400, 1, &0x8000_0204u32.to_le_bytes()), 0);
    assert_eq!(bench.sdo(0x1600, 0, &[0]), 0);
    for (sub, object) in [(1, 0x0001_0001u32), (2, 0x0005_0008), (3, 0x2300_0101), (4, 0x0002_0007)] {
        let abort = if sub == 4 { 0x0604_0041 } else { 0 };
        assert_eq!(bench.sdo(0x1600, sub, &object.to_le_bytes()), abort);
    }
    assert_eq!(bench.sdo(0x1600, 0, &[3]), 0);
    assert_eq!(bench.sdo(0x1400, 1, &0x0000_0204u32.to_le_bytes()), 0);
    bench.frame(0x204, &[0xFF, 0x00]);
    assert_eq!(bench.value(0x2300, 1), 0, "the tenth bit");
    bench.frame(0x204, &[0x00, 0x02]);
    assert_eq!(bench.value(0x2300, 1), 1);
}

#[test]
fn no_object_takes_a_restricted_identifier() {
    let mut bench = Bench::new(4);
    let objects = [(0x1005, 0), (0x1012, 0), (0x1014, 0), (0x1400, 1), (0x1800, 1)];
    for (index, sub) in objects {
        // Off, so that the identifier may change at all.
        let off: u32 = if matches!(index, 0x1005 | 0x1012) { 0x80 } else { 0x8000_0080 };
        assert_eq!(bench.sdo(index, sub, &off.to_le_bytes()), 0, "{index:04X}:{sub:02X}");
        for id in (0..0x800u32).filter(|&id| is_restricted(id)) {
            let abort = bench.sdo(index, sub, &id.to_le_bytes());
            assert_eq!(abort, 0x0609_0030, "{index:04X}:{sub:02X} {id:03X}");
            assert_eq!(bench.value(index, sub), u64::from(off), "{index:04X}:{sub:02X} {id:03X}");
        }
        assert_eq!(bench.sdo(index, sub, &0x6DFu32.to_le_bytes()), 0, "{index:04X}:{sub:02X}");
    }
}

#[test]
fn refused_values_have_the_right_abort_code() {
    let mut bench = Bench::new(4);
    for (index, sub, value, abort) in [
        (0x1005, 0, 0x7FFu32, 0x0609_0030),
        (0x1012, 0, 0x8000_0581, 0x0609_0030),
        (0x1014, 0, 0x85, 0x0609_0030),
        (0x1016, 1, 0x0005_0064, 0),
        (0x1016, 2, 0x0005_0064, 0x0604_0043),
        (0x1016, 1, 0x0005_0065, 0),
        (0x1010, 1, 0x1234, 0x0800_0020),
        (0x1400, 1, 0x205, 0x0609_0030),
        (0x1600, 1, 0x2100_0108, 0x0601_0000),
        (0x1400, 1, 0x8000_0204, 0),
        (0x1600, 1, 0x2100_0108, 0x0601_0000),
    ] {
        assert_eq!(bench.sdo(index, sub, &value.to_le_bytes()), abort, "{index:04X}:{sub:02X} {value:08X}");
    }
    for (index, sub, value, abort) in [
        (0x1003, 0, 1u8, 0x0609_0030),
        (0x1019, 0, 1, 0x0609_0030),
        (0x1019, 0, 241, 0x0609_0030),
        (0x1019, 0, 240, 0),
        (0x1029, 1, 3, 0x0609_0030),
        (0x1400, 2, 241, 0x0609_0030),
        (0x1400, 2, 252, 0x0609_0030),
        (0x1800, 2, 251, 0x0609_0030),
        (0x1800, 2, 252, 0),
        (0x1600, 0, 0, 0),
        (0x1600, 0, 255, 0x0604_0042),
    ] {
        assert_eq!(bench.sdo(index, sub, &[value]), abort, "{index:04X}:{sub:02X} {value:02X}");
    }
    assert_eq!(bench.sdo(0x1600, 1, &0x2100_0110u32.to_le_bytes()), 0x0604_0041, "wrong length");
    assert_eq!(bench.sdo(0x1600, 1, &0x5000_0108u32.to_le_bytes()), 0x0602_0000);
    assert_eq!(bench.sdo(0x1006, 0, &1000u32.to_le_bytes()), 0);
    assert_eq!(bench.sdo(0x1019, 0, &[0]), 0x0800_0022);
}

#[test]
fn a_lost_heartbeat_follows_1029() {
    for (behaviour, state) in
        [(0, NmtState::PreOperational), (1, NmtState::Operational), (2, NmtState::Stopped)]
    {
        let mut bench = Bench::new(4);
        bench.set(0x1029, 1, behaviour);
        bench.set(0x1016, 1, 0x0001_0064);
        bench.start();
        bench.node.on_frame(bench.t_ns, &heartbeat_frame(1, NmtState::Operational), &mut bench.out);
        bench.until(200);
        assert_eq!(bench.node.state(), state);
        assert_eq!(bench.node.error_register(), 0x11);
        assert_eq!(bench.node.state_of(1), None);
        bench.node.on_frame(bench.t_ns, &heartbeat_frame(1, NmtState::Operational), &mut bench.out);
        assert_eq!(bench.node.error_register(), 0);
        assert_eq!(bench.node.state_of(1), Some(NmtState::Operational));
    }
}

#[test]
fn a_master_that_turns_to_heartbeat_is_not_missed_as_guard() {
    for heartbeat in [0u16, 50] {
        let mut bench = Bench::new(4);
        bench.set(0x100C, 0, 100);
        bench.set(0x100D, 0, 2);
        bench.start();
        bench.node.on_frame(0, &CobId(0x704).remote(1), &mut bench.out);
        assert_eq!(bench.sent(), [(0x704, vec![5])]);
        assert_eq!(bench.sdo(0x1017, 0, &heartbeat.to_le_bytes()), 0);
        let lost = bench.until(1000).iter().any(|(id, data)| *id == 0x84 && data[..2] == [0x30, 0x81]);
        assert_eq!(lost, heartbeat == 0);
        let state = if lost { NmtState::PreOperational } else { NmtState::Operational };
        assert_eq!(bench.node.state(), state);
    }
}

#[test]
fn lss_gives_a_node_id_and_the_node_boots_with_it() {
    let mut bench = Bench::with(builder().build(0).unwrap(), UNCONFIGURED, &[]);
    assert!(bench.sent().is_empty());
    assert!(bench.frame(0, &[1, 0]).is_empty() && bench.node.next_deadline().is_none());
    bench.frame(0x7E5, &[4, 1, 0, 0, 0, 0, 0, 0]);
    assert_eq!(bench.frame(0x7E5, &[0x11, 9, 0, 0, 0, 0, 0, 0]), [(0x7E4, vec![0x11, 0, 0, 0, 0, 0, 0, 0])]);
    assert_eq!(bench.frame(0x7E5, &[4, 0, 0, 0, 0, 0, 0, 0]), [(0x709, vec![0])]);
    assert_eq!((bench.node.node_id(), bench.value(0x1014, 0)), (9, 0x89));
    assert_eq!(bench.sdo(0x1017, 0, &100u16.to_le_bytes()), 0, "SDO answers at the new node-id");
    // Another one waits for reset communication.
    bench.frame(0x7E5, &[4, 1, 0, 0, 0, 0, 0, 0]);
    bench.frame(0x7E5, &[0x11, 10, 0, 0, 0, 0, 0, 0]);
    bench.frame(0x7E5, &[4, 0, 0, 0, 0, 0, 0, 0]);
    assert_eq!(bench.node.node_id(), 9);
    assert_eq!(bench.frame(0, &[130, 9]), [(0x70A, vec![0])]);
    // A reset in the middle of a configuration: the slave waits again, and is not asked as if it were configured.
    bench.frame(0x7E5, &[4, 1, 0, 0, 0, 0, 0, 0]);
    assert_eq!(bench.frame(0, &[130, 10]), [(0x70A, vec![0])]);
    assert!(bench.frame(0x7E5, &[0x5E, 0, 0, 0, 0, 0, 0, 0]).is_empty());
}

#[test]
fn reset_communication_keeps_the_application() {
    let mut bench = Bench::new(4);
    bench.set(0x2100, 1, 77);
    bench.set(0x1017, 0, 100);
    bench.frame(0, &[130, 0]);
    assert_eq!((bench.value(0x2100, 1), bench.value(0x1017, 0)), (77, 0));
    bench.frame(0, &[129, 0]);
    assert_eq!(bench.value(0x2100, 1), 0);
}

#[test]
fn time_duplicates_and_consumed_emcys_are_events() {
    let mut bench = Bench::new(4);
    bench.set(0x1012, 0, 0x8000_0100);
    bench.set(0x1028, 5, 0x85);
    bench.events();
    bench.frame(0x100, &[1, 0, 0, 0, 2, 0]);
    bench.frame(0x085, &[0x30, 0x81, 0x11, 0, 0, 0, 0, 0]);
    bench.frame(0x704, &[0x7F]);
    bench.frame(0x704, &[0x7F]);
    let events = bench.events();
    let twins = events.iter().filter(|e| matches!(e, NodeEvent::DuplicateNodeId { .. }));
    assert_eq!(twins.count(), 1, "told once, not with every heartbeat of the other");
    assert_eq!(events[0], NodeEvent::Time(crate::protocol::time_stamp::TimeOfDay { ms: 1, days: 2 }));
    assert!(matches!(events[1], NodeEvent::EmcyReceived { node_id: 5, emcy: Emcy { code: 0x8130, .. } }));
    assert_eq!(events[2], NodeEvent::DuplicateNodeId { node_id: 4 });
    bench.set(0x1012, 0, 0x4000_0100);
    assert!(bench.node.send_time(crate::protocol::time_stamp::TimeOfDay::default(), &mut bench.out));
    assert_eq!(bench.sent().last().unwrap().0, 0x100);
}

fn any_frame() -> impl Strategy<Value = CanFrame> {
    let ids = prop_oneof![
        Just(0u32),
        Just(0x80),
        Just(0x100),
        Just(0x204),
        Just(0x304),
        Just(0x184),
        Just(0x604),
        Just(0x701),
        Just(0x704),
        Just(0x7E5),
        0u32..0x800,
        any::<u32>()
    ];
    let first =
        prop_oneof![Just(0x23u8), Just(0x2F), Just(0x2B), Just(0x40), Just(0x21), Just(0xC6), any::<u8>()];
    let index = prop_oneof![
        0x1000u16..0x102A,
        0x1400u16..0x1404,
        0x1600u16..0x1604,
        0x1800u16..0x1804,
        0x1A00u16..0x1A04,
        any::<u16>()
    ];
    (ids, first, index, 0u8..9, any::<[u8; 4]>(), 0u8..10, any::<bool>(), any::<bool>()).prop_map(
        |(id, first, index, sub, data, len, raw, remote)| {
            let [low, high] = index.to_le_bytes();
            let bytes = if raw {
                [first, data[0], data[1], data[2], data[3], low, high, sub]
            } else {
                [first, low, high, sub, data[0], data[1], data[2], data[3]]
            };
            let mut frame = CanFrame::classic(0, &bytes);
            frame.can_id = id | if remote && len < 3 { id_flag::RTR } else { 0 };
            frame.len = if id < 0x800 && (0x580..0x680).contains(&id) { 8 } else { len };
            frame
        },
    )
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 300, ..ProptestConfig::default() })]

    /// Any frames at any times: no panic, time always goes on, and afterwards the node can be reset and used.
    #[test]
    fn a_node_survives_anything(steps in prop::collection::vec((any_frame(), 0u64..50), 0..200)) {
        let mut bench = Bench::new(4);
        let mut t_ms = 0;
        for (frame, wait) in steps {
            t_ms += wait;
            bench.until(t_ms);
            let t_ns = bench.t_ns;
            bench.node.on_frame(t_ns, &frame, &mut bench.out);
            bench.sent();
            bench.events();
        }
        prop_assert_eq!(bench.out.dropped, 0);
        // LSS may have given another node-id: it counts after this.
        bench.frame(0, &[129, 0]);
        if bench.node.node_id() != UNCONFIGURED {
            prop_assert_ne!(bench.node.state(), NmtState::Initialising);
            let id = u32::from(bench.node.node_id());
            let answer = bench.frame(0x600 + id, &[0x40, 0x00, 0x10, 0, 0, 0, 0, 0]);
            prop_assert_eq!(answer, vec![(0x580 + id, vec![0x43, 0x00, 0x10, 0, 0x91, 1, 0, 0])]);
        }
    }

    /// Two nodes back to back, the second consuming the first's PDO, heartbeat and SYNC. While the network loses,
    /// doubles, delays and reorders, anything may be reported; when it works again all errors go and the values are
    /// equal.
    #[test]
    fn two_nodes_agree_after_a_bad_network(noise in prop::collection::vec((0u8..10, 0u64..40), 1..400), value in any::<u8>()) {
        let (mut a, mut b) = (Bench::new(1), Bench::new(2));
        a.set(0x1017, 0, 50);
        a.set(0x1006, 0, 20_000);
        a.set(0x1005, 0, 0x4000_0080);
        b.set(0x1016, 1, 0x0001_0064);
        b.set(0x1006, 0, 20_000);
        b.set(0x1029, 1, 1);
        b.set(0x1400, 1, 0x8000_0202);
        b.set(0x1400, 2, 1);
        b.set(0x1400, 5, 100);
        b.set(0x1400, 1, 0x181);
        a.set(0x1800, 2, 2);
        a.start();
        b.start();
        let mut late: Vec<(u64, CanFrame)> = Vec::new();
        let mut dice = noise.iter().cycle();
        for t_ms in 1..=2000u64 {
            if t_ms == 1000 {
                a.set(0x2200, 1, u64::from(value));
            }
            for bench in [&mut a, &mut b] {
                while let Some(due) = bench.node.next_deadline().filter(|&due| due <= t_ms * MS) {
                    bench.t_ns = bench.t_ns.max(due);
                    let t_ns = bench.t_ns;
                    bench.node.on_time(t_ns, &mut bench.out);
                }
                bench.t_ns = t_ms * MS;
                bench.node.next_event();
            }
            for frame in a.out.drain() {
                let &(kind, wait) = dice.next().unwrap();
                let wait = if t_ms > 1200 { 0 } else { wait };
                let copies = match kind {
                    0..=2 if t_ms <= 1200 => 0,
                    3 if t_ms <= 1200 => 2,
                    _ => 1,
                };
                late.extend((0..copies).map(|copy| (t_ms + wait * (copy + 1) / 2, frame)));
            }
            let mut at = 0;
            while at < late.len() {
                if late[at].0 <= t_ms {
                    let (_, frame) = late.remove(at);
                    b.node.on_frame(t_ms * MS, &frame, &mut b.out);
                } else {
                    at += 1;
                }
            }
            b.out.drain().count();
        }
        prop_assert_eq!(b.node.error_register(), 0);
        prop_assert_eq!(b.value(0x2100, 1), u64::from(value));
        prop_assert_eq!(b.node.state(), NmtState::Operational);
    }
}
