//! Tests of the virtual bus without sockets and clocks.

use super::*;
use crate::protocol::candump::{format, parse};
use proptest::prelude::*;

#[derive(Default)]
struct Seen(Vec<(String, u64, Origin)>);

impl Tap for Seen {
    fn frame(&mut self, frame: &Frame, t_ns: u64, origin: Origin) {
        self.0.push((format(frame), t_ns, origin));
    }
}

impl Seen {
    fn texts(&self) -> Vec<&str> {
        self.0.iter().map(|(text, _, _)| text.as_str()).collect()
    }
}

fn settings(pace: bool) -> Settings {
    Settings {
        name: "can0".into(),
        bitrate: 500_000,
        data_bitrate: 2_000_000,
        pace,
        max_rate: 1_000_000,
        tx_queue: 16,
        client_buffer: 4096,
    }
}

/// All output of a client as text, as if the socket took it at once.
fn read(bus: &mut VirtualBus, number: usize, now_ns: u64) -> String {
    let mut all = Vec::new();
    loop {
        let bytes = bus.output(number, now_ns).to_vec();
        if bytes.is_empty() {
            return String::from_utf8(all).unwrap();
        }
        bus.written(number, bytes.len());
        all.extend(bytes);
    }
}

/// Gives all bytes, writing out answers as they come.
fn give(bus: &mut VirtualBus, number: usize, text: &str, now_ns: u64, tap: &mut Seen) -> String {
    let mut rest = text.as_bytes();
    let mut answers = String::new();
    loop {
        let taken = bus.take(number, rest, now_ns, tap);
        rest = &rest[taken.used..];
        match taken.stopped {
            Some(Stopped::WriteFirst | Stopped::Turn) => answers += &read(bus, number, now_ns),
            Some(Stopped::Close | Stopped::QueueFull) | None => {
                assert!(taken.stopped.is_some() || rest.is_empty());
                answers += &read(bus, number, now_ns);
                return answers;
            }
        }
    }
}

fn socketcand_client(bus: &mut VirtualBus, tap: &mut Seen) -> usize {
    let number = bus.connect(Dialect::Socketcand).unwrap();
    assert_eq!(read(bus, number, 0), "< hi >");
    assert_eq!(give(bus, number, "< open can0 >", 0, tap), "< ok >");
    assert_eq!(give(bus, number, "< rawmode >", 0, tap), "< ok >");
    number
}

#[test]
fn a_frame_reaches_everyone_but_its_sender() {
    let mut bus = VirtualBus::new(settings(false));
    let mut tap = Seen::default();
    let a = socketcand_client(&mut bus, &mut tap);
    let b = socketcand_client(&mut bus, &mut tap);
    let c = bus.connect(Dialect::Slcan).unwrap();
    assert_eq!(give(&mut bus, c, "C\rS6\rZ1\r\rO\r", 0, &mut tap), "\r\r\r\r\r");
    bus.set_utc_offset(1_000_000_000);
    bus.take_output_ready();
    let now = 5_000_000_000;
    assert_eq!(give(&mut bus, a, "< send 123 2 a ff >", now, &mut tap), "");
    assert_eq!(bus.take_output_ready(), 1 << b | 1 << c);
    assert_eq!(read(&mut bus, b, now), "< frame 123 6.000000 0AFF >");
    assert_eq!(read(&mut bus, c, now), "t12320AFF1388\r");
    assert_eq!(give(&mut bus, c, "R000000018\r", now, &mut tap), "Z\r");
    assert_eq!(read(&mut bus, a, now), "< rtr 00000001 6.000000 8 >");
    bus.push_rail(&parse("7FF#").unwrap(), false, now, 0);
    assert_eq!(bus.run(now, &mut tap), None);
    assert_eq!(read(&mut bus, a, now), "< frame 7FF 6.000000  >");
    assert_eq!(
        tap.0,
        vec![
            ("123#0AFF".into(), now, Origin::Client(a)),
            ("00000001#R8".into(), now, Origin::Client(c)),
            ("7FF#".into(), now, Origin::Rail(0)),
        ]
    );
    assert_eq!(
        bus.client_counters(a).unwrap(),
        ClientCounters { sent: 1, received: 2, ..Default::default() }
    );
    let gone = bus.disconnect(a);
    assert_eq!(gone.sent, 1);
    assert_eq!(bus.counters().frames, 3);
}

#[test]
fn no_frame_follows_the_ok_of_rawmode() {
    let mut bus = VirtualBus::new(settings(false));
    let mut tap = Seen::default();
    let (a, b) = (socketcand_client(&mut bus, &mut tap), bus.connect(Dialect::Socketcand).unwrap());
    assert_eq!(read(&mut bus, b, 0), "< hi >");
    // Both commands in one segment: the answers leave one by one.
    let commands = b"< open can0 >< rawmode >";
    let taken = bus.take(b, commands, 0, &mut tap);
    assert_eq!(taken, Taken { used: 13, stopped: Some(Stopped::WriteFirst) });
    assert_eq!(read(&mut bus, b, 0), "< ok >");
    assert_eq!(bus.take(b, &commands[13..], 0, &mut tap).stopped, Some(Stopped::WriteFirst));
    give(&mut bus, a, "< send 1 0  >", 0, &mut tap);
    assert_eq!(read(&mut bus, b, 1), "< ok >");
    assert_eq!(bus.held_until(b), Some(HANDSHAKE_HOLD_NS));
    // Nothing is lost meanwhile; the hold ends by time ...
    assert_eq!(read(&mut bus, b, HANDSHAKE_HOLD_NS), "< frame 001 0.000000  >");
    // ... or when the client speaks.
    give(&mut bus, b, "< rawmode >", 0, &mut tap);
    give(&mut bus, a, "< send 2 0  >", 0, &mut tap);
    assert_eq!(read(&mut bus, b, 1), "");
    assert_eq!(give(&mut bus, b, "< send 3 0 >", 1, &mut tap), "< frame 002 0.000000  >");
}

#[test]
fn nonsense_is_answered_and_counted() {
    let mut bus = VirtualBus::new(settings(false));
    let mut tap = Seen::default();
    let a = socketcand_client(&mut bus, &mut tap);
    assert_eq!(give(&mut bus, a, "< fly >< echo >", 0, &mut tap), "< error unknown command >< echo >");
    // In raw mode an answer to a frame would be taken for a frame: it is counted only.
    assert_eq!(give(&mut bus, a, "< send 123 4  >< sendrtr 123 9 >< echo >", 0, &mut tap), "< echo >");
    let b = bus.connect(Dialect::Slcan).unwrap();
    assert_eq!(give(&mut bus, b, "t1230\rO\rhello\r", 0, &mut tap), "\x07\r\x07");
    assert_eq!((bus.client_counters(a).unwrap().refused, bus.client_counters(b).unwrap().refused), (3, 2));
    let c = bus.connect(Dialect::Socketcand).unwrap();
    let taken = bus.take(c, b"< open can1 >< echo >", 0, &mut tap);
    assert_eq!(taken.stopped, Some(Stopped::Close));
    assert_eq!(read(&mut bus, c, 0), "< hi >< error no such bus on this server >");
    assert!(tap.0.is_empty());
}

#[test]
fn a_client_that_does_not_read_loses_whole_frames_and_delays_nobody() {
    let mut bus = VirtualBus::new(settings(false));
    let mut tap = Seen::default();
    let slow = socketcand_client(&mut bus, &mut tap);
    let fast = socketcand_client(&mut bus, &mut tap);
    let mut received = 0;
    for i in 0..1000u32 {
        bus.push_rail(&Frame::data(i % 2048, false, &[1; 8]).unwrap(), false, 0, 0);
        bus.run(0, &mut tap);
        received += read(&mut bus, fast, HANDSHAKE_HOLD_NS).matches("< frame").count();
    }
    assert_eq!(received, 1000);
    let counters = bus.client_counters(slow).unwrap();
    assert_eq!(counters.received + counters.dropped, 1000);
    assert!(counters.dropped > 800, "{counters:?}");
    assert_eq!(bus.counters().client_drops, counters.dropped);
    let late = read(&mut bus, slow, HANDSHAKE_HOLD_NS);
    assert_eq!(late.matches("< frame").count() as u64, counters.received);
    assert!(late.len() <= 4096 && late.ends_with('>'));
}

#[test]
fn more_clients_than_the_limit_are_refused() {
    let mut bus = VirtualBus::new(Settings { client_buffer: 512, ..settings(false) });
    for number in 0..MAX_CLIENTS {
        assert_eq!(bus.connect(Dialect::Slcan), Some(number));
    }
    assert_eq!(bus.connect(Dialect::Slcan), None);
    bus.disconnect(7);
    assert_eq!(bus.connect(Dialect::Socketcand), Some(7));
    bus.disconnect(99);
}

#[test]
fn a_paced_bus_takes_the_time_of_a_wire_and_arbitrates() {
    let mut bus = VirtualBus::new(settings(true));
    let mut tap = Seen::default();
    let a = socketcand_client(&mut bus, &mut tap);
    let b = socketcand_client(&mut bus, &mut tap);
    let start = 1_000_000_000;
    // `a` has only high identifiers, in its own order; the rail sends by identifier.
    give(&mut bus, a, "< send 555 0 >< send 500 0 >", start, &mut tap);
    give(&mut bus, b, "< send 200 0 >", start, &mut tap);
    for text in ["400#", "100#"] {
        bus.push_rail(&parse(text).unwrap(), false, start, 0);
    }
    assert!(tap.0.is_empty());
    let mut now = start;
    let mut wakes = 0;
    while let Some(next) = bus.run(now, &mut tap) {
        assert!(next > now);
        now = next;
        wakes += 1;
    }
    assert_eq!(tap.texts(), ["100#", "200#", "400#", "555#", "500#"]);
    assert_eq!(wakes, 5);
    let mut end = start;
    for (text, t_ns, _) in &tap.0 {
        end += bits(&parse(text).unwrap(), Stuffing::Exact).time_ns(500_000, 2_000_000);
        assert_eq!(*t_ns, end);
    }
    // Woken late, it catches up: stamps are those of the wire, not of the wake.
    let late = now + 10_000_000;
    for i in 0..8 {
        bus.push_rail(&Frame::data(i, false, &[]).unwrap(), false, late, 0);
    }
    bus.run(late, &mut tap);
    assert_eq!(bus.run(late + 1_000_000_000, &mut tap), None);
    let stamps: Vec<u64> = tap.0[5..].iter().map(|(_, t, _)| *t).collect();
    assert!(stamps[0] > late && stamps[7] < late + 1_000_000 && stamps.is_sorted());
}

#[test]
fn a_paced_bus_stops_reading_and_never_drops_what_a_client_sends() {
    let mut bus = VirtualBus::new(settings(true));
    let mut tap = Seen::default();
    let a = socketcand_client(&mut bus, &mut tap);
    let text = (0..1000).map(|i| format!("< send {i:03x} 0 >")).collect::<Vec<_>>().concat();
    let mut rest = text.as_bytes();
    let mut now = 1_000_000_000;
    let mut full = 0;
    while !rest.is_empty() {
        let taken = bus.take(a, rest, now, &mut tap);
        rest = &rest[taken.used..];
        if taken.stopped == Some(Stopped::QueueFull) {
            full += 1;
            now = bus.run(now, &mut tap).unwrap();
            bus.take_room_again();
        }
    }
    while let Some(next) = bus.run(now, &mut tap) {
        now = next;
    }
    assert!(full > 0);
    let expected: Vec<String> = (0..1000).map(|i| format!("{i:03X}#")).collect();
    assert_eq!(tap.texts(), expected);
    // 100 % load while it ran.
    assert!(bus.load_permille(now) <= 1000);
}

#[test]
fn an_unpaced_bus_carries_no_more_than_its_rate() {
    let mut bus = VirtualBus::new(Settings { max_rate: 1000, ..settings(false) });
    let mut tap = Seen::default();
    let a = socketcand_client(&mut bus, &mut tap);
    let text =
        (0..4000).map(|i| format!("< send 001 2 {:x} {:x} >", i / 256, i % 256)).collect::<Vec<_>>().concat();
    let mut rest = text.as_bytes();
    let start = 1_000_000_000;
    let mut now = start;
    let mut first_burst = None;
    for _ in 0..100_000 {
        let taken = bus.take(a, rest, now, &mut tap);
        rest = &rest[taken.used..];
        match bus.run(now, &mut tap) {
            Some(next) => {
                first_burst.get_or_insert(tap.0.len());
                now = next.max(now);
            }
            None if rest.is_empty() => break,
            None => {}
        }
    }
    // The burst is at once, the rest at 1000 frames a second, all in order.
    assert!(first_burst.unwrap() as u64 > RATE_BURST, "{first_burst:?}");
    let expected: Vec<String> = (0..4000).map(|i| format!("001#{i:04X}")).collect();
    assert_eq!(tap.texts(), expected);
    let last = tap.0.last().unwrap().1 - start;
    assert!((2_700_000_000..3_300_000_000).contains(&last), "{last}");
}

#[test]
fn one_turn_is_bounded() {
    let mut bus = VirtualBus::new(settings(false));
    let mut tap = Seen::default();
    let a = socketcand_client(&mut bus, &mut tap);
    let text = "< send 1 0 >".repeat(1000);
    let taken = bus.take(a, text.as_bytes(), 0, &mut tap);
    assert_eq!(taken, Taken { used: 12 * TURN_FRAMES, stopped: Some(Stopped::Turn) });
    assert_eq!(tap.0.len(), TURN_FRAMES);
}

proptest! {
    /// Whatever clients send in whatever pieces: no panic, and everyone sees the frames in the tap's order.
    #[test]
    fn one_true_order(
        pieces in prop::collection::vec((0usize..3, 0u32..0x800, any::<bool>()), 1..60),
        pace in any::<bool>(),
    ) {
        let mut bus = VirtualBus::new(settings(pace));
        let mut tap = Seen::default();
        let clients: Vec<usize> = (0..2).map(|_| socketcand_client(&mut bus, &mut tap)).collect();
        let listener = socketcand_client(&mut bus, &mut tap);
        let mut heard = String::new();
        let mut now = 1_000_000_000;
        for (who, id, idle) in pieces {
            match clients.get(who) {
                Some(&client) => {
                    give(&mut bus, client, &format!("< send {id:03x} 0 >"), now, &mut tap);
                }
                None => {
                    bus.push_rail(&Frame::data(id, false, &[]).unwrap(), false, now, 0);
                }
            }
            while let Some(next) = bus.run(now, &mut tap) {
                if !idle {
                    break;
                }
                now = next;
            }
            heard += &read(&mut bus, listener, u64::MAX);
        }
        while let Some(next) = bus.run(now, &mut tap) {
            now = next;
        }
        heard += &read(&mut bus, listener, u64::MAX);
        let heard: Vec<String> = heard.split("< frame ").skip(1).map(|t| format!("{}#", &t[..3])).collect();
        prop_assert_eq!(heard, tap.texts());
        prop_assert!(tap.0.iter().map(|f| f.1).collect::<Vec<_>>().is_sorted());
    }

    #[test]
    fn garbage_never_panics(bytes in prop::collection::vec(any::<u8>(), 0..2000), slcan in any::<bool>()) {
        let mut bus = VirtualBus::new(settings(false));
        let mut tap = Seen::default();
        let number = bus.connect(if slcan { Dialect::Slcan } else { Dialect::Socketcand }).unwrap();
        let mut rest = &bytes[..];
        while !rest.is_empty() {
            let taken = bus.take(number, rest, 0, &mut tap);
            rest = &rest[taken.used..];
            if taken.stopped == Some(Stopped::Close) {
                break;
            }
            read(&mut bus, number, 0);
        }
        read(&mut bus, number, 0);
    }
}
