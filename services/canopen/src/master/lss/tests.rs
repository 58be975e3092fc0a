use super::*;
use crate::protocol::io::Outbox;
use crate::protocol::lss::slave::{LssAbilities, LssSlave};
use crate::protocol::lss::{LssAddress, LssState, UNCONFIGURED};
use ipc_types::payload::CanFrame;
use serde_json::{Value, json};

const MS: u64 = 1_000_000;

fn address(serial: u32) -> LssAddress {
    LssAddress { vendor: 0x11, product: 0x22, revision: 0x33, serial }
}

/// A master's queue and some devices, in virtual time.
struct Bus {
    jobs: LssJobs,
    slaves: Vec<LssSlave>,
    now: u64,
    /// Frames so far, both ways; those for which this is true are lost.
    frames: usize,
    lose: fn(usize, &CanFrame) -> bool,
    /// The devices lose what they were told when they go back to waiting.
    forgets: bool,
}

impl Bus {
    fn new(slaves: impl IntoIterator<Item = LssSlave>) -> Self {
        Self {
            jobs: LssJobs::default(),
            slaves: slaves.into_iter().collect(),
            now: 0,
            frames: 0,
            lose: |_, _| false,
            forgets: false,
        }
    }

    fn unconfigured(serials: impl IntoIterator<Item = u32>) -> Self {
        let slave = |serial| LssSlave::new(address(serial), UNCONFIGURED, LssAbilities::default());
        Self::new(serials.into_iter().map(slave))
    }

    fn arrives(&mut self, frame: &CanFrame) -> bool {
        self.frames += 1;
        !(self.lose)(self.frames, frame)
    }

    /// Until the next end, or none in an hour.
    fn next_end(&mut self) -> Option<(u64, LssOutcome)> {
        while self.now < 3_600_000 * MS {
            if let Some(end) = self.jobs.take_end() {
                return Some(end);
            }
            self.now = self.now.max(self.jobs.next_deadline()?);
            let mut out = Outbox::default();
            self.jobs.on_time(self.now, &mut out);
            for frame in out.drain().collect::<Vec<_>>() {
                if !self.arrives(&frame) {
                    continue;
                }
                let mut answers = Outbox::default();
                for slave in &mut self.slaves {
                    slave.on_frame(&frame, &mut answers);
                    if self.forgets && frame.data[..2] == [0x04, 0] {
                        *slave = LssSlave::new(address(9), UNCONFIGURED, LssAbilities::default());
                    }
                }
                for answer in answers.drain().collect::<Vec<_>>() {
                    if self.arrives(&answer) {
                        self.jobs.on_frame(self.now, &answer);
                    }
                }
            }
        }
        None
    }

    fn call(&mut self, call: Value) -> Result<Value, LssError> {
        let call: LssCall = serde_json::from_value(call).unwrap();
        self.jobs.ask(1, call, u64::MAX).unwrap();
        let (job, outcome) = self.next_end().unwrap();
        assert_eq!((job, self.jobs.waiting()), (1, 0));
        outcome.result
    }

    fn all_wait(&self) -> bool {
        self.slaves.iter().all(|s| s.state() == LssState::Waiting)
    }
}

fn found(value: &Value) -> Vec<(u64, u64)> {
    let part = |v: &Value, key: &str| v[key].as_u64().unwrap();
    value["found"].as_array().unwrap().iter().map(|f| (part(f, "serial"), part(f, "node_id"))).collect()
}

#[test]
fn all_devices_without_node_id_get_one() {
    let mut bus = Bus::unconfigured([0x8000_0001, 7, 0xFFFF_FFFF, 0]);
    let value = bus.call(json!({ "call": "assign", "from": 20, "store": true })).unwrap();
    assert_eq!(found(&value), [(0, 20), (7, 21), (0x8000_0001, 22), (0xFFFF_FFFF, 23)]);
    assert_eq!(value["more"], false);
    assert!(bus.all_wait());
    let given: Vec<u8> = bus.slaves.iter().map(LssSlave::pending_node_id).collect();
    assert_eq!(given, [22, 21, 23, 20]);
    // Nobody is left.
    assert_eq!(bus.call(json!({ "call": "identify_non_configured" })), Ok(json!({ "answered": false })));
    let value = bus.call(json!({ "call": "assign", "from": 30 })).unwrap();
    assert_eq!(value, json!({ "found": [], "more": false }));
}

#[test]
fn a_limit_ends_an_assign_and_the_next_goes_on() {
    let mut bus = Bus::unconfigured(1..=5);
    let value = bus.call(json!({ "call": "assign", "from": 10, "max": 2 })).unwrap();
    assert_eq!((found(&value), &value["more"]), (vec![(1, 10), (2, 11)], &json!(true)));
    let value = bus.call(json!({ "call": "assign", "from": 126 })).unwrap_err();
    assert_eq!(value, LssError::NoNodeId(address(5)));
    assert!(bus.all_wait());
}

#[test]
fn a_failed_assign_tells_what_it_did_before() {
    let mut bus = Bus::unconfigured(1..=3);
    let call = serde_json::from_value(json!({ "call": "assign", "from": 126 })).unwrap();
    bus.jobs.ask(5, call, u64::MAX).unwrap();
    let (_, outcome) = bus.next_end().unwrap();
    let error = outcome.result.clone().unwrap_err();
    let body = outcome.error_body(&error);
    assert_eq!(found(&body), [(1, 126), (2, 127)]);
    assert_eq!(body["error"], "no node-id is left for the device with serial 0x00000003");
}

#[test]
fn twins_are_one_device_to_the_master() {
    let mut bus = Bus::unconfigured([1, 1]);
    let value = bus.call(json!({ "call": "assign", "from": 5 })).unwrap();
    assert_eq!(found(&value), [(1, 5)]);
    assert!(bus.slaves.iter().all(|s| s.pending_node_id() == 5));
}

#[test]
fn a_device_that_forgets_its_node_id_is_noticed() {
    let mut bus = Bus::unconfigured([9]);
    bus.forgets = true;
    let error = bus.call(json!({ "call": "assign", "from": 5 })).unwrap_err();
    assert_eq!(error, LssError::Again { address: address(9), node_id: 5 });
    assert!(bus.all_wait());
}

#[test]
fn a_command_that_never_arrives_is_told_and_the_device_waits_again() {
    let mut bus = Bus::unconfigured([9]);
    bus.lose = |_, frame| frame.can_id == 0x7E5 && frame.data[0] == 0x11;
    assert_eq!(
        bus.call(json!({ "call": "assign", "from": 5 })),
        Err(LssError::Silent("setting the node-id"))
    );
    assert!(bus.all_wait());
}

#[test]
fn lost_frames_lead_to_another_try_or_an_error_never_to_a_wrong_identity() {
    let mut good = 0;
    // Each frame of the first scan is lost once.
    for lost in 1..300usize {
        static LOST: std::sync::atomic::AtomicUsize = std::sync::atomic::AtomicUsize::new(0);
        LOST.store(lost, std::sync::atomic::Ordering::Relaxed);
        let mut bus = Bus::unconfigured([0x5A5A_0F0F]);
        bus.lose = |n, _| n == LOST.load(std::sync::atomic::Ordering::Relaxed);
        match bus.call(json!({ "call": "assign", "from": 5 })) {
            Ok(value) if value["found"] == json!([]) => {}
            Ok(value) => {
                assert_eq!(found(&value), [(0x5A5A_0F0F, 5)], "frame {lost}");
                good += 1;
            }
            Err(LssError::Lost | LssError::Silent(_)) => {}
            Err(other) => panic!("frame {lost}: {other}"),
        }
        assert!(bus.all_wait() || lost > 200, "frame {lost}");
    }
    assert!(good > 250, "{good}");
}

#[test]
fn a_chosen_device_is_configured_and_asked() {
    let mut bus = Bus::unconfigured([1, 2]);
    let one = json!({ "vendor": 0x11, "product": 0x22, "revision": 0x33, "serial": 2 });
    let none = json!({ "vendor": 0x11, "product": 0x22, "revision": 0x33, "serial": 3 });
    let set =
        |address: &Value| json!({ "call": "set_node_id", "node_id": 44, "address": address, "store": true });
    assert_eq!(bus.call(set(&one)), Ok(json!({ "node_id": 44 })));
    assert_eq!(bus.slaves[1].pending_node_id(), 44);
    let asked = bus.call(json!({ "call": "inquire_device", "address": one })).unwrap();
    assert_eq!((&asked["serial"], &asked["node_id"]), (&json!(2), &json!(44)));
    let error = bus.call(set(&none)).unwrap_err();
    insta::assert_snapshot!(error, @"no device has vendor 0x00000011, product 0x00000022, revision 0x00000033, serial 0x00000003: is it powered, and does it support LSS?");
    let rate =
        json!({ "call": "set_bitrate", "kbit": 250, "address": one, "store": true, "activate_ms": 20 });
    assert_eq!(bus.call(rate), Ok(json!({ "kbit": 250 })));
    assert!(bus.all_wait());
    let range = |serial: [u32; 2]| json!({ "call": "identify", "vendor": 0x11, "product": 0x22, "revision": [0, 0x33], "serial": serial });
    assert_eq!(bus.call(range([2, 9])), Ok(json!({ "answered": true })));
    assert_eq!(bus.call(range([3, 9])), Ok(json!({ "answered": false })));
}

/// The identity of nobody, a node-id given twice: nothing of that without an address.
#[test]
fn several_devices_are_refused_where_one_is_meant() {
    let calls = [
        json!({ "call": "set_node_id", "node_id": 33, "store": true }),
        json!({ "call": "set_bitrate", "kbit": 250, "activate_ms": 20 }),
        json!({ "call": "inquire_device" }),
    ];
    // Different ones, two with one identity, a configured one beside one without node-id.
    let buses: [fn() -> Bus; 3] = [
        || Bus::unconfigured([1, 2]),
        || Bus::unconfigured([1, 1]),
        || {
            Bus::new(
                [5, UNCONFIGURED].map(|id| LssSlave::new(address(id.into()), id, LssAbilities::default())),
            )
        },
    ];
    for (call, new) in calls.iter().flat_map(|call| buses.map(|new| (call, new))) {
        let mut bus = new();
        let before: Vec<u8> = bus.slaves.iter().map(LssSlave::pending_node_id).collect();
        assert_eq!(bus.call(call.clone()), Err(LssError::Several), "{call}");
        assert_eq!(bus.slaves.iter().map(LssSlave::pending_node_id).collect::<Vec<_>>(), before);
        assert!(bus.all_wait());
    }
    let mut bus = Bus::unconfigured([1, 2]);
    bus.call(json!({ "call": "switch_global", "state": "configuration" })).unwrap();
    assert_eq!(bus.call(json!({ "call": "inquire" })), Err(LssError::Several));
}

#[test]
fn the_only_device_needs_no_address() {
    let mut bus = Bus::unconfigured([7]);
    assert_eq!(bus.call(json!({ "call": "set_node_id", "node_id": 33 })), Ok(json!({ "node_id": 33 })));
    assert_eq!(bus.call(json!({ "call": "set_bitrate", "kbit": 250 })), Ok(json!({ "kbit": 250 })));
    let asked = bus.call(json!({ "call": "inquire_device" })).unwrap();
    assert_eq!(
        asked,
        json!({ "vendor": 0x11, "product": 0x22, "revision": 0x33, "serial": 7, "node_id": 33 })
    );
    assert!(bus.all_wait());
    // Who does not answer cannot be told from nobody, or from two.
    bus.lose = |_, frame| frame.can_id == 0x7E4 && frame.data[0] == 0x5D;
    let error = bus.call(json!({ "call": "set_node_id", "node_id": 34 })).unwrap_err();
    insta::assert_snapshot!(error, @"asking for the serial number, to be sure that it is the only device: the device did not answer");
    assert_eq!(bus.slaves[0].pending_node_id(), 33);
}

#[test]
fn single_services_do_as_the_standard_says() {
    let mut bus = Bus::unconfigured([0xABCD]);
    let silent = bus.call(json!({ "call": "configure_node_id", "node_id": 5 })).unwrap_err();
    assert_eq!(silent.to_string(), "setting the node-id: no device in the state configuration answered");
    let value = bus.call(json!({ "call": "fastscan", "hold": true, "hint": { "vendor": 0x11 } })).unwrap();
    assert_eq!(value["found"][0]["serial"], 0xABCD);
    assert!(!bus.all_wait());
    assert_eq!(bus.call(json!({ "call": "inquire" })).unwrap()["node_id"], Value::Null);
    for (call, ok) in [
        (json!({ "call": "configure_node_id", "node_id": 5 }), true),
        (json!({ "call": "configure_bit_timing", "kbit": 125 }), true),
        (json!({ "call": "store" }), true),
        (json!({ "call": "activate_bit_timing", "delay_ms": 10 }), true),
        (json!({ "call": "switch_global", "state": "waiting" }), true),
        (json!({ "call": "switch_selective", "address": address(1) }), false),
        (json!({ "call": "switch_selective", "address": address(0xABCD) }), true),
    ] {
        assert_eq!(bus.call(call.clone()).is_ok(), ok, "{call}");
    }
    assert_eq!(bus.slaves[0].state(), LssState::Configuration);
}

#[test]
fn refusals_and_wrong_values_are_told_in_words() {
    let abilities = LssAbilities { store: false, bit_timing: 0 };
    let mut bus = Bus::new([LssSlave::new(address(1), UNCONFIGURED, abilities)]);
    let said: Vec<String> = [
        json!({ "call": "set_node_id", "node_id": 7, "store": true }),
        json!({ "call": "set_bitrate", "kbit": 250 }),
        json!({ "call": "set_bitrate", "kbit": 100 }),
        json!({ "call": "set_node_id", "node_id": 0 }),
        json!({ "call": "assign", "from": 200 }),
        json!({ "call": "assign", "from": 1, "max": 33 }),
        json!({ "call": "fastscan", "timeout_ms": 0 }),
        json!({ "call": "store" }),
    ]
    .into_iter()
    .map(|call| bus.call(call).unwrap_err().to_string())
    .collect();
    insta::assert_snapshot!(said.join("\n"));
    assert!(bus.all_wait());
}

#[test]
fn calls_wait_for_each_other_up_to_a_limit() {
    let mut bus = Bus::unconfigured(1..=3);
    let assign =
        |from: u8| serde_json::from_value(json!({ "call": "assign", "from": from, "max": 1 })).unwrap();
    let mut out = Outbox::default();
    bus.jobs.ask(0, assign(50), u64::MAX).unwrap();
    bus.jobs.on_time(0, &mut out);
    out.drain().for_each(drop);
    for n in 1..=MAX_CALLS as u64 {
        bus.jobs.ask(n, assign(60 + n as u8), u64::MAX).unwrap();
    }
    assert_eq!(bus.jobs.ask(99, assign(10), u64::MAX), Err(QueueFull));
    assert_eq!(bus.jobs.waiting(), MAX_CALLS + 1);
    // The first frame is lost: its call finds nobody, the others come in order.
    let order: Vec<(u64, usize)> = std::iter::from_fn(|| bus.next_end())
        .map(|(job, end)| (job, found(&end.result.unwrap()).len()))
        .collect();
    let wanted: Vec<(u64, usize)> =
        (0..=MAX_CALLS as u64).map(|n| (n, usize::from((1..=3).contains(&n)))).collect();
    assert_eq!(order, wanted);
    assert!(bus.all_wait());
}

#[test]
fn a_deadline_ends_a_call_on_the_bus_and_one_that_waits() {
    let mut bus = Bus::unconfigured([0xFFFF_FFFF]);
    let assign: LssCall = serde_json::from_value(json!({ "call": "assign", "from": 5 })).unwrap();
    bus.jobs.ask(1, assign.clone(), 2000 * MS).unwrap();
    bus.jobs.ask(2, assign.clone(), 500 * MS).unwrap();
    bus.jobs.ask(3, assign, u64::MAX).unwrap();
    let (job, outcome) = bus.next_end().unwrap();
    assert_eq!((job, outcome.result), (2, Err(LssError::Late)));
    assert_eq!(bus.now, 500 * MS);
    let (job, outcome) = bus.next_end().unwrap();
    assert_eq!((job, outcome.result), (1, Err(LssError::Late)));
    assert!(bus.now < 2100 * MS && bus.all_wait());
    let (job, outcome) = bus.next_end().unwrap();
    assert_eq!((job, found(&outcome.result.unwrap())), (3, vec![(0xFFFF_FFFF, 5)]));
}

#[test]
fn a_bus_that_goes_off_ends_the_call() {
    let mut bus = Bus::unconfigured([1]);
    bus.jobs.ask(1, LssCall::IdentifyNonConfigured {}, u64::MAX).unwrap();
    let mut out = Outbox::default();
    bus.jobs.on_time(0, &mut out);
    bus.jobs.bus_off();
    let (_, outcome) = bus.jobs.take_end().unwrap();
    assert_eq!(outcome.result, Err(LssError::BusOff));
    assert_eq!(bus.jobs.next_deadline(), None);
}
