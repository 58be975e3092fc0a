//! A whole rail in one process: topics made with their limits, messages numbered, gaps counted, full queues
//! refused, consumers woken. One test function, because a process belongs to one rail for its whole life.

use ipc_types::Wiring;
use ipc_types::payload::{CanFrame, Event, Inputs};
use ipc_types::port::SendError;
use ipc_types::reactor::Reactor;
use ipc_types::testing::{TestRail, service, topic};
use ipc_types::topic::{EVENTS, TopicKind};
use std::time::Duration;

#[test]
fn the_rail_carries_numbers_refuses_and_wakes() {
    let rail = TestRail::new(
        "railtest",
        vec![service("a", "test", serde_json::Value::Null, Wiring::default())],
        vec![
            topic(TopicKind::CanRx, "can0").depth(8).wakes("a"),
            topic(TopicKind::CanTx, "can0").depth(4).wakes("a"),
            topic(TopicKind::Inputs, "io").depth(2),
        ],
    );
    let mut ctx = rail.context("a");
    let mut inbox = ctx.inbox().unwrap();
    let mut reactor = Reactor::new().unwrap();
    let token = reactor.add(inbox.fd()).unwrap();

    // Replace-the-oldest: the reader sees the newest and counts what it missed.
    let mut rx = ctx.subscriber::<CanFrame>("can0/rx").unwrap();
    let mut port = ctx.publisher::<CanFrame>("can0/rx").unwrap();
    for n in 0..20u8 {
        port.send(CanFrame::classic(0x123, &[n])).unwrap();
        if n == 1 {
            assert_eq!(rx.drain(100, |_, _| {}), 2);
        }
    }
    port.ring();
    assert!(reactor.wait(Some(Duration::from_secs(10))).unwrap().contains(&token));
    assert!(inbox.drain());
    assert!(reactor.wait(Some(Duration::ZERO)).unwrap().is_empty(), "the inbox was drained");
    let mut got = Vec::new();
    rx.drain(100, |frame, tail| {
        assert!(tail.is_empty());
        got.push((frame.stamp.seq, frame.data[0]));
    });
    assert_eq!(got, (12..20u8).map(|n| (u64::from(n) + 1, n)).collect::<Vec<_>>());
    assert_eq!(rx.counters().lost, 10);

    // Refuse: told when there is no reader, and when its queue is full; nothing is consumed by a refusal.
    let mut tx = ctx.publisher::<CanFrame>("can0/tx").unwrap();
    assert!(matches!(tx.send(CanFrame::default()), Err(SendError::NoReader(_))));
    let mut driver = ctx.subscriber::<CanFrame>("can0/tx").unwrap();
    let sent = (0..10).take_while(|_| tx.send(CanFrame::default()).is_ok()).count();
    assert_eq!(sent, 4, "the queue holds its depth");
    assert!(matches!(tx.send(CanFrame::default()), Err(SendError::Full(_))));
    let mut seqs = Vec::new();
    driver.drain(100, |frame, _| seqs.push(frame.stamp.seq));
    assert_eq!(seqs, [1, 2, 3, 4]);
    assert_eq!(tx.send(CanFrame::default()), Ok(5));

    // History: a late reader gets the newest at once; tails travel.
    let mut inputs = ctx.publisher::<Inputs>("io/inputs").unwrap();
    for n in 0..5u8 {
        inputs.send_tail(Inputs { ranges: 1, ..Inputs::default() }, &[n, 0]).unwrap();
    }
    let mut late = ctx.subscriber::<Inputs>("io/inputs").unwrap();
    inputs.send_tail(Inputs { ranges: 1, ..Inputs::default() }, &[9, 0]).unwrap();
    let mut tails = Vec::new();
    late.drain(10, |header, tail| tails.push((header.n, tail.to_vec())));
    assert_eq!(tails.last().unwrap(), &(2, vec![9, 0]));
    assert!(matches!(inputs.send_tail(Inputs::default(), &[0; 5000]), Err(SendError::TooLong { .. })));

    // Events and a reader that knows no type.
    let mut raw = ctx.raw_subscriber(EVENTS).unwrap();
    ctx.event(
        ipc_types::event::EventKind::Ready,
        ipc_types::event::Level::Info,
        "works",
        serde_json::json!({"x": 1}),
    );
    let mut bodies = Vec::new();
    raw.drain_raw(10, &mut |stamp, header, tail| {
        assert_eq!(header.len(), size_of::<Event>());
        assert_eq!(stamp.writer, 1);
        bodies.push(serde_json::from_slice::<serde_json::Value>(tail).unwrap());
    });
    assert_eq!(bodies[0]["message"], "works");
    assert!(ctx.subscriber::<Inputs>("can0/rx").is_err(), "another payload is refused");

    // More readers than there are places for: the way out is named, and it is not the shared memory.
    let mut crowd = Vec::new();
    let refused = loop {
        match ctx.subscriber::<Inputs>("io/inputs") {
            Ok(one) if crowd.len() < 100 => crowd.push(one),
            other => break other.map(|_| ()).unwrap_err().to_string(),
        }
    };
    let limit = ipc_types::rail::port_limits(TopicKind::Inputs, 3, 3).1;
    assert!(refused.contains(&format!("at most {limit} ports fit")), "{refused}");
    assert!(refused.contains("end a `dinrail top`") && !refused.contains("/dev/shm"), "{refused}");
}
