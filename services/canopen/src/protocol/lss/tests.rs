use super::master::*;
use super::slave::*;
use super::*;
use crate::protocol::io::Outbox;

/// Slaves and a master on a bus without loss, in virtual time.
struct Bus {
    t_ns: u64,
    master: LssMaster,
    slaves: Vec<LssSlave>,
    events: Vec<(usize, LssSlaveEvent)>,
    frames: usize,
    /// Every n-th answer is lost; 0: none.
    lose: usize,
}

impl Bus {
    fn new(slaves: Vec<LssSlave>) -> Self {
        Self {
            t_ns: 0,
            master: LssMaster::new(LssTimes::default()),
            slaves,
            events: Vec::new(),
            frames: 0,
            lose: 0,
        }
    }
    fn run(&mut self, request: LssRequest) -> LssResult {
        self.master.start(self.t_ns, request).unwrap();
        assert_eq!(self.master.start(self.t_ns, request), Err(Busy));
        let (mut commands, mut answers) = (Outbox::default(), Outbox::default());
        for _ in 0..10_000 {
            self.t_ns = self.master.next_deadline().unwrap().max(self.t_ns);
            if let Some(result) = self.master.on_time(self.t_ns, &mut commands) {
                self.deliver(&mut commands, &mut answers);
                return result;
            }
            self.deliver(&mut commands, &mut answers);
            self.t_ns += 1_000_000;
            for frame in answers.drain().collect::<Vec<_>>() {
                self.frames += 1;
                if self.lose > 0 && self.frames.is_multiple_of(self.lose) {
                    continue;
                }
                if let Some(result) = self.master.on_frame(self.t_ns, &frame) {
                    return result;
                }
            }
        }
        panic!("the master is stuck in {request:?}");
    }
    fn deliver(&mut self, commands: &mut Outbox, answers: &mut Outbox) {
        for frame in commands.drain() {
            for (at, slave) in self.slaves.iter_mut().enumerate() {
                self.events.extend(slave.on_frame(&frame, answers).map(|event| (at, event)));
            }
        }
    }
}

fn address(n: u32) -> LssAddress {
    LssAddress {
        vendor: 0x0000_0360,
        product: 0x1234_5678 + (n & 1),
        revision: n >> 1,
        serial: n.wrapping_mul(0x9E37_79B9),
    }
}

fn slave(n: u32, node_id: u8) -> LssSlave {
    LssSlave::new(address(n), node_id, LssAbilities::default())
}

#[test]
fn fastscan_finds_eight_unconfigured_slaves_and_gives_them_node_ids() {
    let mut slaves: Vec<_> = (0..8).map(|n| slave(n, UNCONFIGURED)).collect();
    slaves.push(slave(100, 5));
    let mut bus = Bus::new(slaves);
    let mut found = Vec::new();
    for node_id in 10.. {
        if bus.run(LssRequest::IdentifyNonConfigured) == LssResult::Nobody {
            break;
        }
        let LssResult::Found(at) = bus.run(LssRequest::Fastscan(FastscanHint::default())) else { panic!() };
        found.push(at);
        assert_eq!(bus.run(LssRequest::Inquire(Inquiry::Serial)), LssResult::Value(at.serial));
        assert_eq!(bus.run(LssRequest::ConfigureNodeId(node_id)), LssResult::Done);
        assert_eq!(bus.run(LssRequest::Store), LssResult::Done);
        assert_eq!(bus.run(LssRequest::SwitchGlobal(LssState::Waiting)), LssResult::Done);
    }
    assert_eq!(bus.run(LssRequest::Fastscan(FastscanHint::default())), LssResult::Nobody);
    let mut wanted: Vec<_> = (0..8).map(address).collect();
    wanted.sort_by_key(|address| address.parts());
    assert_eq!(found, wanted, "ascending, because silence counts as 1");
    let active =
        bus.events.iter().filter(|(_, event)| matches!(event, LssSlaveEvent::NodeIdActive { .. })).count();
    assert_eq!(active, 8);
    assert!(bus.t_ns < 120_000_000_000, "{} s", bus.t_ns / 1_000_000_000);
}

#[test]
fn fastscan_with_known_parts_is_short_and_says_when_nobody_has_them() {
    let mut bus = Bus::new(vec![slave(1, UNCONFIGURED), slave(2, UNCONFIGURED)]);
    let hint =
        FastscanHint { vendor: Some(0x360), product: Some(0x1234_5678), revision: Some(1), serial: None };
    assert_eq!(bus.run(LssRequest::Fastscan(hint)), LssResult::Found(address(2)));
    bus.run(LssRequest::SwitchGlobal(LssState::Waiting));
    let other = FastscanHint { vendor: Some(0x361), ..hint };
    assert_eq!(bus.run(LssRequest::Fastscan(other)), LssResult::Nobody);
}

#[test]
fn a_lost_answer_ends_in_a_result_not_in_a_wrong_address() {
    for lose in 2..40 {
        let mut bus = Bus::new(vec![slave(7, UNCONFIGURED)]);
        bus.lose = lose;
        match bus.run(LssRequest::Fastscan(FastscanHint::default())) {
            LssResult::Found(at) => assert_eq!(at, address(7)),
            other => assert!(matches!(other, LssResult::Lost | LssResult::Nobody), "{other:?}"),
        }
    }
}

#[test]
fn fastscan_waits_for_the_last_of_several_answers() {
    const MS: u64 = 1_000_000;
    let mut master = LssMaster::new(LssTimes::default());
    let mut out = Outbox::default();
    master.start(0, LssRequest::Fastscan(FastscanHint::default())).unwrap();
    assert_eq!(master.on_time(0, &mut out), None);
    assert_eq!(out.drain().count(), 1);
    let answer = frame(0x7E4, cs::IDENTIFY_ANSWER, [0; 7]);
    for ms in [3, 7, 11] {
        assert_eq!(master.on_frame(ms * MS, &answer), None);
        assert_eq!(master.next_deadline(), Some((ms + 5) * MS));
    }
    // Somebody who never stops is not waited for longer than for an answer.
    for ms in 12..200 {
        assert_eq!(master.on_frame(ms * MS, &answer), None);
    }
    assert_eq!(master.next_deadline(), Some(103 * MS));
    assert_eq!(master.on_time(103 * MS, &mut out), None);
    assert_eq!(master.next_deadline(), Some(103 * MS), "the next question goes");
}

#[test]
fn selective_services() {
    let mut bus = Bus::new(vec![slave(1, 5), slave(2, 6)]);
    assert_eq!(bus.run(LssRequest::SwitchSelective(address(3))), LssResult::Nobody);
    assert_eq!(bus.run(LssRequest::Inquire(Inquiry::NodeId)), LssResult::Nobody);
    assert_eq!(bus.run(LssRequest::SwitchSelective(address(2))), LssResult::Done);
    assert_eq!(bus.slaves[1].state(), LssState::Configuration);
    assert_eq!(bus.run(LssRequest::Inquire(Inquiry::NodeId)), LssResult::Value(6));
    assert_eq!(bus.run(LssRequest::Inquire(Inquiry::Vendor)), LssResult::Value(0x360));
    assert_eq!(bus.run(LssRequest::ConfigureNodeId(200)), LssResult::Refused { code: 1, specific: 0 });
    assert_eq!(bus.run(LssRequest::ConfigureNodeId(9)), LssResult::Done);
    assert_eq!(bus.run(LssRequest::ConfigureBitTiming(5)), LssResult::Refused { code: 1, specific: 0 });
    assert_eq!(bus.run(LssRequest::ConfigureBitTiming(3)), LssResult::Done);
    assert_eq!(bus.run(LssRequest::ActivateBitTiming { delay_ms: 300 }), LssResult::Done);
    assert!(bus.events.contains(&(1, LssSlaveEvent::ActivateBitTiming { kbit: 250, delay_ms: 300 })));
    assert_eq!(bus.run(LssRequest::SwitchGlobal(LssState::Waiting)), LssResult::Done);
    // Configured before: the new id waits for reset communication.
    assert!(!bus.events.iter().any(|(_, event)| matches!(event, LssSlaveEvent::NodeIdActive { .. })));
    assert_eq!(bus.slaves[1].pending_node_id(), 9);
    let range = LssRange { vendor: 0x360, product: 0x1234_5679, revision: (0, 0), serial: (0, u32::MAX) };
    assert_eq!(bus.run(LssRequest::Identify(range)), LssResult::Done);
    assert_eq!(bus.run(LssRequest::Identify(LssRange { revision: (1, 9), ..range })), LssResult::Nobody);
    assert_eq!(bus.run(LssRequest::IdentifyNonConfigured), LssResult::Nobody);
}

#[test]
fn a_device_without_node_id_tells_the_one_it_was_given() {
    let mut bus = Bus::new(vec![slave(1, UNCONFIGURED)]);
    bus.run(LssRequest::SwitchGlobal(LssState::Configuration));
    assert_eq!(bus.run(LssRequest::Inquire(Inquiry::NodeId)), LssResult::Value(0xFF));
    assert_eq!(bus.run(LssRequest::ConfigureNodeId(9)), LssResult::Done);
    assert_eq!(bus.run(LssRequest::Inquire(Inquiry::NodeId)), LssResult::Value(9));
}

#[test]
fn a_reset_ends_the_configuration() {
    let mut device = slave(1, 5);
    let mut out = Outbox::default();
    let mut say = |device: &mut LssSlave, data: [u8; 8]| {
        device.on_frame(&CanFrame::classic(predefined::LSS_MASTER, &data), &mut out);
        out.drain().count()
    };
    assert_eq!(device.reset(), None);
    say(&mut device, [cs::SWITCH_GLOBAL, 1, 0, 0, 0, 0, 0, 0]);
    assert_eq!(say(&mut device, [cs::CONFIGURE_NODE_ID, 9, 0, 0, 0, 0, 0, 0]), 1);
    assert_eq!(device.reset(), Some(LssSlaveEvent::State(LssState::Waiting)));
    assert_eq!((device.state(), device.pending_node_id()), (LssState::Waiting, 9));
    assert_eq!(say(&mut device, [cs::INQUIRE_NODE_ID, 0, 0, 0, 0, 0, 0, 0]), 0);
}

#[test]
fn storing_can_be_impossible() {
    let unable = LssAbilities { store: false, bit_timing: 0 };
    let mut bus = Bus::new(vec![LssSlave::new(address(1), 5, unable)]);
    bus.run(LssRequest::SwitchGlobal(LssState::Configuration));
    assert_eq!(bus.run(LssRequest::Store), LssResult::Refused { code: 1, specific: 0 });
    assert_eq!(bus.run(LssRequest::ConfigureBitTiming(2)), LssResult::Refused { code: 1, specific: 0 });
}

proptest::proptest! {
    /// Any frames at a slave: no panic, and a right sequence works afterwards.
    #[test]
    fn a_slave_survives_anything(frames: Vec<([u8; 8], u8)>) {
        let mut out = Outbox::default();
        let mut device = slave(3, UNCONFIGURED);
        for (data, len) in frames {
            let frame = CanFrame::classic(predefined::LSS_MASTER, &data[..usize::from(len % 9)]);
            device.on_frame(&frame, &mut out);
            out.drain().count();
        }
        let mut bus = Bus::new(vec![device]);
        bus.run(LssRequest::SwitchGlobal(LssState::Waiting));
        proptest::prop_assert_eq!(bus.run(LssRequest::SwitchSelective(address(3))), LssResult::Done);
    }
}
