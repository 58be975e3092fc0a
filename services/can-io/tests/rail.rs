//! The service on a whole rail in one process: the service on a thread, bus driver and PLC played by the test.
//! One test function, because a process belongs to one rail for its whole life.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may end like this")]

use ipc_types::Wiring;
use ipc_types::payload::{CanFrame, Event, Health, HealthState, Image, Inputs, PlcState, Quality, can_flag};
use ipc_types::port::{Publisher, SendError, Subscriber};
use ipc_types::testing::{TestRail, join, service, topic, wait};
use ipc_types::topic::{EVENTS, TopicKind};
use ipc_types::wiring::Neighbours;
use serde_json::json;
use std::collections::BTreeMap;
use std::time::Duration;

const GOOD: u8 = Quality::Good as u8;
const STALE: u8 = Quality::Stale as u8;
const NO_DATA: u8 = Quality::NoData as u8;

struct Plc {
    port: Publisher<Image>,
    scan: u64,
}

impl Plc {
    fn image(&mut self, state: PlcState, outputs: &[u8]) {
        self.scan += 1;
        let image = Image {
            scan: self.scan,
            state: state as u32,
            output_bytes: outputs.len() as u32,
            ..Image::default()
        };
        self.port.send_tail(image, outputs).unwrap();
        self.port.ring();
    }
}

fn events(port: &mut Subscriber<Event>, kind: &str) -> Option<String> {
    let mut found = None;
    port.drain(64, |_, tail| {
        let body: serde_json::Value = serde_json::from_slice(tail).unwrap();
        if body["event"] == kind {
            found = Some(body["message"].as_str().unwrap().to_owned());
        }
    });
    found
}

#[test]
fn frames_and_image() {
    let config = json!({
        "in": [
            { "id": 0x1A0, "start": 0, "len": 16, "to": "%IW0", "symbol": "Speed", "timeout": "2s" },
            { "id": "18FEF100", "start": 3, "len": 1, "to": "%IX2.5" },
        ],
        "out": [
            { "id": 0x210, "dlc": 2, "mode": "cyclic", "period": "20ms",
              "signals": [{ "start": 0, "len": 16, "from": "%QW0" }] },
            { "id": 0x211, "dlc": 1, "mode": "on_change", "signals": [{ "start": 7, "len": 1, "from": "%QX2.0" }] },
        ],
        // A stale image is a part of this test, but not one that this thread published late by chance.
        "stale_after": "3s",
    });
    let services =
        vec![("can0".into(), "can".into()), ("io".into(), "can-io".into()), ("plc".into(), "plc".into())];
    let neighbours = Neighbours { name: "io".into(), services, ..Neighbours::default() };
    let wiring = dinrail_can_io::topics(&serde_json::from_value(config.clone()).unwrap(), &neighbours);
    let tail = wiring.topics[0].max_tail;
    let rail = TestRail::new(
        "caniotest",
        vec![
            service("io", "can-io", config, wiring),
            service("probe", "test", serde_json::Value::Null, Wiring::default()),
        ],
        vec![
            topic(TopicKind::CanRx, "can0").wakes("io"),
            topic(TopicKind::CanTx, "can0"),
            topic(TopicKind::Image, "plc").max_tail(64).wakes("io"),
            topic(TopicKind::Inputs, "io").max_tail(tail),
        ],
    );
    let mut ctx = rail.context("probe");
    let mut health = ctx.subscriber::<Health>("io/health").unwrap();
    let mut events_port = ctx.subscriber::<Event>(EVENTS).unwrap();
    let mut inputs = ctx.subscriber::<Inputs>("io/inputs").unwrap();
    let mut tx = ctx.subscriber::<CanFrame>("can0/tx").unwrap();
    let mut rx = ctx.publisher::<CanFrame>("can0/rx").unwrap();
    let mut plc = Plc { port: ctx.publisher("plc/image").unwrap(), scan: 0 };
    let root = rail.root().to_owned();
    std::thread::spawn(move || dinrail_can_io::run(join(&root, "io", BTreeMap::new())).unwrap());
    wait("readiness", || {
        let mut ready = false;
        health.newest(|h, _| ready = h.state == HealthState::Ready as u32);
        ready.then_some(())
    });

    // In: no data, then values; echoes and remote frames are not taken.
    let mut tail_is = |expected: &[u8]| {
        let mut seen = false;
        wait(&format!("inputs {expected:?}"), || {
            inputs.drain(64, |header, tail| {
                assert_eq!(header.ranges, 2);
                seen |= tail == expected;
            });
            seen.then_some(())
        });
    };
    tail_is(&[0, 0, 0, NO_DATA, NO_DATA]);
    let mut bus = |frame: CanFrame| {
        rx.send(frame).unwrap();
        rx.ring();
    };
    bus(CanFrame::classic(0x18FE_F100, &[8]));
    tail_is(&[0, 0, 1, NO_DATA, GOOD]);
    bus(CanFrame { flags: can_flag::TX_ECHO, ..CanFrame::classic(0x18FE_F100, &[0]) });
    bus(CanFrame::classic(0x1A0, &[0x34, 0x12]));
    tail_is(&[0x34, 0x12, 1, GOOD, GOOD]);
    // The value is held and marked, and it is told.
    tail_is(&[0x34, 0x12, 1, STALE, GOOD]);
    let message = wait("the event", || events(&mut events_port, "input_quality"));
    assert!(
        message.starts_with("frame 1A0h has not come for ") && message.ends_with("Speed is stale"),
        "{message}"
    );
    bus(CanFrame::classic(0x1A0, &[0x35, 0x12]));
    tail_is(&[0x35, 0x12, 1, GOOD, GOOD]);

    // Out: nothing before the first image of a running program.
    let mut sent = Vec::new();
    let mut take = |sent: &mut Vec<(u32, Vec<u8>, u8)>| {
        tx.drain(1024, |f, _| sent.push((f.can_id, f.payload().to_vec(), f.flags)));
        sent.len()
    };
    plc.image(PlcState::Starting, &[9, 9, 1]);
    std::thread::sleep(Duration::from_millis(100));
    assert_eq!(take(&mut sent), 0);
    plc.image(PlcState::Run, &[0x78, 0x56, 1]);
    let cyclic = (0x210, vec![0x78, 0x56], can_flag::NEWEST);
    wait("frames", || {
        plc.image(PlcState::Run, &[0x78, 0x56, 1]);
        take(&mut sent);
        (sent.iter().filter(|f| **f == cyclic).count() >= 3).then_some(())
    });
    assert_eq!(sent.iter().filter(|f| f.0 == 0x211).collect::<Vec<_>>(), [&(0x211, vec![0x80], 0)]);

    // A stale image silences.
    let message = wait("the safe state", || events(&mut events_port, "safe_entered"));
    assert!(message.contains("stale"), "{message}");
    take(&mut sent);
    sent.clear();
    std::thread::sleep(Duration::from_millis(200));
    assert_eq!(take(&mut sent), 0);
    wait("frames again", || {
        plc.image(PlcState::Run, &[1, 0, 1]);
        (take(&mut sent) >= 2).then_some(())
    });
    assert!(
        sent.contains(&(0x210, vec![1, 0], can_flag::NEWEST)) && sent.contains(&(0x211, vec![0x80], 0)),
        "{sent:?}"
    );
    wait("the end of the safe state", || events(&mut events_port, "safe_left"));

    // So does STOP, at once and although images keep coming.
    plc.image(PlcState::Stop, &[2, 0, 0]);
    let message = wait("the safe state", || events(&mut events_port, "safe_entered"));
    assert!(message.contains("stopped"), "{message}");
    take(&mut sent);
    sent.clear();
    for _ in 0..10 {
        plc.image(PlcState::Stop, &[2, 0, 0]);
        std::thread::sleep(Duration::from_millis(10));
    }
    assert_eq!(take(&mut sent), 0);
    drop(tx);

    // Without a driver frames are refused and the service lives on.
    plc.image(PlcState::Run, &[3, 0, 1]);
    let mut late = ctx.subscriber::<CanFrame>("can0/tx").unwrap();
    wait("frames after the driver came back", || {
        plc.image(PlcState::Run, &[3, 0, 1]);
        (late.drain(64, |_, _| ()) > 0).then_some(())
    });
    assert!(!matches!(rx.send(CanFrame::default()), Err(SendError::Full(_))));
}
