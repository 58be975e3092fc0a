//! The driver on the rail with a wire behind it that is slower than its writers: a serial adapter over TCP.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may end like this")]

use std::collections::BTreeMap;
use std::io::{Read, Write};
use std::net::TcpListener;

use ipc_types::Wiring;
use ipc_types::payload::{CanFrame, can_flag};
use ipc_types::port::{Publisher, SendError, Subscriber};
use ipc_types::testing::{TestRail, join, service, topic, wait};
use ipc_types::topic::TopicKind;
use ipc_types::wiring::Neighbours;
use serde_json::json;

/// An adapter that acknowledges everything.
fn adapter(listener: &TcpListener) {
    let (mut stream, _) = listener.accept().unwrap();
    let mut bytes = [0; 4096];
    let mut first = None;
    loop {
        let n = stream.read(&mut bytes).unwrap_or(0);
        if n == 0 {
            return;
        }
        for byte in &bytes[..n] {
            if *byte == b'\r' {
                let answer: &[u8] = if first.take() == Some(b't') { b"z\r" } else { b"\r" };
                stream.write_all(answer).unwrap();
            } else {
                first.get_or_insert(*byte);
            }
        }
    }
}

#[test]
fn what_has_no_place_in_the_queue_is_taken_from_the_topic_later() {
    const COUNT: u8 = 100;
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let interface = format!("tcp://{}", listener.local_addr().unwrap());
    let config = json!({ "backend": "slcan", "interface": interface, "tx_queue": 4 });
    let neighbours = Neighbours { name: "can0".into(), ..Neighbours::default() };
    let wiring = dinrail_can::topics(&serde_json::from_value(config.clone()).unwrap(), &neighbours);
    let rail = TestRail::new(
        "canwire",
        vec![
            service("can0", "can", config, wiring),
            service("probe", "can", serde_json::Value::Null, Wiring::default()),
        ],
        vec![
            topic(TopicKind::CanRx, "can0").depth(1024),
            topic(TopicKind::CanTx, "can0").depth(1024).wakes("can0"),
        ],
    );
    let mut ctx = rail.context("probe");
    let mut rx: Subscriber<CanFrame> = ctx.subscriber("can0/rx").unwrap();
    let mut tx: Publisher<CanFrame> = ctx.publisher("can0/tx").unwrap();
    let root = rail.root().to_owned();
    std::thread::spawn(move || dinrail_can::run(join(&root, "can0", BTreeMap::new())).unwrap());
    std::thread::spawn(move || adapter(&listener));
    // One burst, one ring, and then silence.
    for i in 0..COUNT {
        wait("the driver", || match tx.send(CanFrame::classic(0x100, &[i])) {
            Ok(_) => Some(()),
            Err(SendError::NoReader(_)) => None,
            Err(e) => panic!("{e}"),
        });
    }
    tx.ring();
    let mut got = Vec::new();
    wait("all echoes", || {
        rx.drain(1024, |frame, _| {
            assert_eq!(frame.flags, can_flag::TX_ECHO);
            got.push(frame.data[0]);
        });
        (got.len() == usize::from(COUNT)).then_some(())
    });
    assert!(got.iter().copied().eq(0..COUNT), "{got:?}");
}
