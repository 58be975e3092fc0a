use super::*;
use crate::protocol::candump::{format, parse};

const SECOND: u64 = 1_000_000_000;

#[derive(Default)]
struct Seen(Vec<(String, Origin)>);

impl Tap for Seen {
    fn frame(&mut self, frame: &Frame, _: u64, origin: Origin) {
        self.0.push((format(frame), origin));
    }
}

/// A bus with a wire that takes three frames at once.
fn bus(up: bool) -> VirtualBus {
    let mut bus = VirtualBus::new(Settings {
        name: "can0".into(),
        bitrate: 500_000,
        data_bitrate: 2_000_000,
        pace: false,
        max_rate: 1_000_000,
        tx_queue: 16,
        client_buffer: 65_536,
    });
    bus.attach_wire(3);
    if up {
        bus.wire_up(0);
    }
    bus
}

fn push(bus: &mut VirtualBus, text: &str, now_ns: u64) {
    assert_eq!(bus.push_rail(&parse(text).unwrap(), false, now_ns, 0), Pushed::Queued);
}

fn next(bus: &mut VirtualBus, now_ns: u64) -> Option<String> {
    bus.wire_next(now_ns, |f| !f.is_fd()).map(|f| format(&f))
}

#[test]
fn three_on_their_way_and_the_rest_in_order_of_arbitration() {
    let (mut bus, mut seen) = (bus(true), Seen::default());
    for text in ["300#01", "200#02", "400#03", "500#04"] {
        push(&mut bus, text, 1);
    }
    let given: Vec<_> = std::iter::from_fn(|| next(&mut bus, 2)).collect();
    assert_eq!(given, ["200#02", "300#01", "400#03"]);
    assert!(!bus.wire_wants());
    // A later frame of a lower identifier goes before the one that still waits.
    push(&mut bus, "001#05", 3);
    bus.wire_echo(&parse("200#02").unwrap(), 4, &mut seen);
    assert_eq!(next(&mut bus, 4).as_deref(), Some("001#05"));
    // Between the echoes stands what others sent: the order of the wire.
    bus.wire_received(&parse("7FF#").unwrap(), 5, &mut seen);
    bus.wire_received(&parse("20000080#0000000000000000").unwrap(), 5, &mut seen);
    bus.wire_echo(&parse("300#01").unwrap(), 6, &mut seen);
    let seen: Vec<_> = seen.0.iter().map(|(text, origin)| (text.as_str(), *origin)).collect();
    assert_eq!(
        seen,
        [
            ("200#02", Origin::Rail(0)),
            ("7FF#", Origin::Wire),
            ("20000080#0000000000000000", Origin::Wire),
            ("300#01", Origin::Rail(0))
        ]
    );
    let counters = bus.wire_counters().unwrap();
    assert_eq!((counters.sent, counters.received, counters.errors), (2, 1, 1));
}

#[test]
fn what_the_wire_cannot_carry_is_dropped_and_counted() {
    let mut bus = bus(true);
    push(&mut bus, "123##0AA", 1);
    push(&mut bus, "124#AA", 1);
    assert_eq!(next(&mut bus, 2).as_deref(), Some("124#AA"));
    assert_eq!(bus.wire_counters().unwrap().unfit, 1);
}

#[test]
fn frames_wait_for_a_wire_that_is_down_but_not_for_ever() {
    let mut bus = bus(false);
    push(&mut bus, "100#01", SECOND);
    push(&mut bus, "101#02", 5 * SECOND);
    assert_eq!(next(&mut bus, 6 * SECOND), None);
    bus.wire_up(6 * SECOND);
    assert_eq!(next(&mut bus, 6 * SECOND).as_deref(), Some("101#02"));
    assert_eq!(bus.wire_counters().unwrap().stale, 1);
    // What was on its way when the wire fell is lost, never sent twice.
    bus.wire_down();
    bus.wire_up(7 * SECOND);
    assert_eq!(next(&mut bus, 7 * SECOND), None);
    assert_eq!(bus.wire_counters().unwrap().lost, 1);
}

#[test]
fn nobody_acknowledges() {
    let (mut bus, mut seen) = (bus(true), Seen::default());
    assert_eq!(bus.wire_overdue(SECOND), None);
    push(&mut bus, "100#01", SECOND);
    push(&mut bus, "100#02", SECOND);
    next(&mut bus, SECOND);
    next(&mut bus, 2 * SECOND);
    assert_eq!(bus.wire_overdue(9 * SECOND), Some(SECOND));
    // The kernel dropped something: the echoes may be among it, so they are given up soon.
    bus.wire_dropped();
    assert_eq!(bus.wire_overdue(9 * SECOND), None);
    assert_eq!(bus.wire_counters().unwrap().lost, 2);
    // One comes after all: it was on the wire and is ours.
    bus.wire_echo(&parse("100#01").unwrap(), 9 * SECOND, &mut seen);
    assert_eq!(seen.0, [("100#01".to_owned(), Origin::Rail(0))]);
}

#[test]
fn confirmed_and_refused_in_order() {
    let (mut bus, mut seen) = (bus(true), Seen::default());
    for text in ["100#01", "100#02", "100#03"] {
        push(&mut bus, text, 1);
        next(&mut bus, 2).unwrap();
    }
    bus.wire_sent(3, &mut seen);
    bus.wire_refused();
    bus.wire_sent(4, &mut seen);
    bus.wire_sent(5, &mut seen);
    bus.wire_refused();
    assert_eq!(seen.0.iter().map(|(text, _)| text.as_str()).collect::<Vec<_>>(), ["100#01", "100#03"]);
    assert_eq!(bus.wire_counters().unwrap().lost, 1);
}

#[test]
fn what_the_wire_does_not_take_leaves_its_own_place() {
    let (mut bus, mut seen) = (bus(true), Seen::default());
    for text in ["100#01", "200#02"] {
        push(&mut bus, text, 1);
    }
    assert_eq!((next(&mut bus, 2), next(&mut bus, 2)), (Some("100#01".into()), Some("200#02".into())));
    bus.wire_not_taken();
    bus.wire_echo(&parse("100#01").unwrap(), 3, &mut seen);
    assert_eq!(bus.wire_overdue(4), None, "nothing is on its way");
    assert_eq!(bus.wire_counters().unwrap().lost, 1);
}

#[test]
fn room_in_a_full_queue_is_told_once() {
    let mut bus = bus(true);
    for i in 0..16 {
        push(&mut bus, &format!("1{i:02X}#"), 1);
    }
    assert!(!bus.take_rail_room_again());
    assert!(next(&mut bus, 2).is_some());
    assert!(bus.take_rail_room_again() && !bus.take_rail_room_again());
    assert!(next(&mut bus, 2).is_some());
    assert!(!bus.take_rail_room_again(), "it was not full any more");
}

/// Frames of a client in SLCAN, `count` of them, numbered from `first`.
fn flood(
    bus: &mut VirtualBus,
    client: usize,
    first: usize,
    count: usize,
    now_ns: u64,
) -> (usize, Option<Stopped>) {
    let text: String = (first..first + count).map(|n| format!("t1232{n:04X}\r")).collect();
    let (mut rest, mut seen) = (text.as_bytes(), Seen::default());
    loop {
        let taken = bus.take(client, rest, now_ns, &mut seen);
        rest = &rest[taken.used..];
        if taken.stopped != Some(Stopped::Turn) {
            let left = rest.split_inclusive(|b| *b == b'\r').count();
            return (count - left, taken.stopped);
        }
    }
}

#[test]
fn a_wire_that_is_down_for_long_holds_no_client_in_its_place() {
    for stuck in [false, true] {
        // Down, or up without anybody who acknowledges.
        let mut bus = bus(stuck);
        let client = bus.connect(Dialect::Slcan).unwrap();
        bus.take(client, b"O\r", SECOND, &mut Seen::default());
        if stuck {
            assert_eq!(flood(&mut bus, client, 0, 3, SECOND), (3, None));
            assert_eq!(std::iter::from_fn(|| next(&mut bus, SECOND)).count(), 3);
        }
        let (taken, stopped) = flood(&mut bus, client, 1, 1000, SECOND);
        assert_eq!(stopped, Some(Stopped::QueueFull), "for a short while nothing is lost");
        assert_eq!(taken, CLIENT_QUEUE);
        bus.take_room_again();
        let due = bus.run(SECOND, &mut Seen::default()).unwrap();
        assert!((STALE_NS..STALE_NS + 2 * HELD_GRID_NS).contains(&(due - SECOND)), "{due}");
        assert_eq!(bus.run(due - 1, &mut Seen::default()), Some(due));
        assert_eq!(bus.take_room_again(), 0);
        assert_eq!(bus.run(due, &mut Seen::default()), None);
        assert_eq!(bus.take_room_again(), 1 << client, "its socket is read again");
        assert_eq!(flood(&mut bus, client, taken + 1, 1000 - taken, due), (1000 - taken, None));
        let stale = bus.wire_counters().unwrap().stale;
        assert_eq!(stale as usize, 1000 - taken, "the oldest, one by one");
        // The newest are what the wire gets.
        let later = due + SECOND;
        if stuck {
            bus.wire_flush();
        }
        bus.wire_up(later);
        let first = next(&mut bus, later).unwrap();
        assert_eq!(first, format!("123#{:04X}", 1001 - CLIENT_QUEUE));
        // And now it is waited for again.
        assert_eq!(flood(&mut bus, client, 0, 10, later), (1, Some(Stopped::QueueFull)));
    }
}

#[test]
fn a_feed_on_a_wire_that_is_down_waits_for_no_clock_and_goes_on_in_time() {
    let mut bus = bus(false);
    let frame = |n: usize| parse(&format!("123#{n:04X}")).unwrap();
    assert!((0..CLIENT_QUEUE).all(|n| bus.push_feed(&frame(n), SECOND)));
    assert_eq!(bus.run(SECOND, &mut Seen::default()), None);
    assert!(!bus.push_feed(&frame(CLIENT_QUEUE), SECOND));
    let due = bus.run(SECOND, &mut Seen::default()).unwrap();
    assert!(due - SECOND >= STALE_NS && !bus.take_feed_room_again());
    assert_eq!(bus.run(due, &mut Seen::default()), None);
    assert!(bus.take_feed_room_again());
    assert!((CLIENT_QUEUE..5000).all(|n| bus.push_feed(&frame(n), due)));
    bus.wire_up(due);
    assert_eq!(next(&mut bus, due), Some(format!("123#{:04X}", 5000 - CLIENT_QUEUE)));
    // Full again, and the wire takes one: the feed is told.
    bus.wire_down();
    assert!(bus.push_feed(&frame(1), due) && !bus.push_feed(&frame(2), due));
    bus.wire_up(due);
    assert!(!bus.take_feed_room_again());
    assert!(next(&mut bus, due).is_some() && bus.take_feed_room_again());
}
