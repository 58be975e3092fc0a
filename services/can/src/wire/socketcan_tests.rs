//! The wire without a kernel that has CAN: a datagram socket carries the same structures.
use super::*;
use crate::protocol::candump::parse;
use crate::server::Hub;
use crate::virtual_bus::{Origin, Settings as BusSettings, Tap};
use std::cell::RefCell;
use std::os::unix::net::UnixDatagram;
use std::rc::Rc;

#[derive(Default, Clone)]
struct Ears {
    said: Rc<RefCell<Vec<String>>>,
    frames: Rc<RefCell<Vec<(String, Origin)>>>,
}

impl Tap for Ears {
    fn frame(&mut self, frame: &Frame, _: u64, origin: Origin) {
        self.frames.borrow_mut().push((crate::protocol::candump::format(frame), origin));
    }
}

impl Host for Ears {
    fn flush(&mut self) {}
    fn client(&mut self, _: String, _: bool) {}
    fn link(&mut self, _: Level, message: String, _: bool) {
        self.said.borrow_mut().push(message);
    }
}

fn settings(restart_ms: u32, filters: &[&str]) -> Settings {
    Settings {
        wanted: Wanted {
            name: "nocan42".into(),
            bitrate: 500_000,
            data_bitrate: 2_000_000,
            fd: None,
            restart_ms,
            configure: true,
        },
        rx_buffer: 65_536,
        filters: filters.iter().map(|text| Filter::parse(text).unwrap()).collect(),
    }
}

/// A wire that is up, and the other end of its socket.
fn with_wire(settings: &Settings, test: impl FnOnce(&mut Wire<'_, Ears>, &UnixDatagram, &Ears)) {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    with_wire_on(&runtime, settings, async |wire, far, ears| test(wire, far, ears));
}

fn with_wire_on(
    runtime: &tokio::runtime::Runtime,
    settings: &Settings,
    test: impl AsyncFnOnce(&mut Wire<'_, Ears>, &UnixDatagram, &Ears),
) {
    runtime.block_on(async {
        let ears = Ears::default();
        let bus = BusSettings {
            name: "can0".into(),
            bitrate: 500_000,
            data_bitrate: 2_000_000,
            pace: false,
            max_rate: 150_000,
            tx_queue: 64,
            client_buffer: 65_536,
        };
        let hub = Hub::new(bus, ears.clone(), None).unwrap();
        hub.look(|bus, _| bus.attach_wire(FLIGHT));
        let line = Line::new(hub, "nocan42");
        let (near, far) = UnixDatagram::pair().unwrap();
        near.set_nonblocking(true).unwrap();
        far.set_nonblocking(true).unwrap();
        let interface = Interface { up: true, ..Interface::default() };
        let mut wire = Wire::new(&line, settings, watch::readable(near.into()).unwrap(), interface);
        wire.raised();
        test(&mut wire, &far, &ears).await;
    });
}

fn send(far: &UnixDatagram, text: &str) {
    let (bytes, n) = sys::to_kernel(&parse(text).unwrap());
    far.send(&bytes[..n]).unwrap();
}

#[test]
fn error_frames_become_states_counters_and_sentences() {
    with_wire(&settings(100, &[]), |wire, far, ears| {
        for text in [
            "20000204#000C000000006160",
            "20000204#0030000000008180",
            "20000020#0000000000000000",
            "20000020#0000000000000000",
            "20000040#0000000000000000",
            "20000100#0000000000000000",
        ] {
            send(far, text);
        }
        assert!(matches!(wire.exchange(), End::No));
        insta::assert_snapshot!(ears.said.borrow().join("\n"), @r"
        interface nocan42 is up
        nocan42 is error warning: error warning by receive errors; error warning by transmit errors; TEC 97, REC 96
        nocan42 is error passive: error passive by receive errors; error passive by transmit errors; TEC 129, REC 128
        interface nocan42: nobody acknowledges what is sent (no acknowledgement): termination, bit rate, partner?
        nocan42 is bus-off
        nocan42 is error active: controller restarted
        ");
        let status = wire.line.status.borrow();
        assert_eq!((status.tec, status.rec), (Some(0x81), Some(0x80)));
        assert_eq!((status.bus_off, status.restarts), (1, 1));
        assert_eq!(status.last_error.as_deref(), Some("controller restarted"));
        assert_eq!(ears.frames.borrow().len(), 6);
    });
}

#[test]
fn an_adapter_without_a_word_of_acknowledgement() {
    with_wire(&settings(100, &[]), |wire, _, ears| {
        let old = clock::mono_ns() - 5_000_000_000;
        wire.line.hub.look(|bus, _| {
            bus.push_rail(&parse("123#01").unwrap(), false, clock::mono_ns(), 0);
            bus.wire_next(old, |_| true).unwrap();
        });
        wire.watch_acknowledgements();
        wire.watch_acknowledgements();
        let said = ears.said.borrow();
        let wanted =
            "interface nocan42: nobody acknowledges what is sent: termination, bit rate, partner?".to_owned();
        assert_eq!(said.iter().filter(|text| **text == wanted).count(), 1, "{said:?}");
    });
}

#[test]
fn what_the_kernel_dropped_is_counted() {
    with_wire(&settings(100, &[]), |wire, _, _| {
        let received = |drops| Received { frame: Frame::default(), own: false, utc_ns: None, drops };
        assert!(!wire.dropped(&received(None)));
        assert!(wire.dropped(&received(Some(7))));
        assert!(!wire.dropped(&received(Some(7))));
        wire.drops = u32::MAX;
        assert!(wire.dropped(&received(Some(1))));
        assert_eq!(wire.line.status.borrow().kernel_drops, 9);
    });
}

#[test]
fn bus_off_is_met_by_a_restart_with_back_off() {
    let ms = Duration::from_millis;
    let pauses: Vec<_> = (0..8).map(|n| restart_pause(ms(100), n)).collect();
    assert_eq!(pauses, [100, 200, 400, 800, 1600, 3200, 5000, 5000].map(ms));
    assert_eq!(restart_pause(ms(60_000), u32::MAX), ms(60_000));

    with_wire(&settings(100, &[]), |wire, _, ears| {
        wire.interface.settable = true;
        wire.restarts = 3;
        wire.bus_off(true);
        let pause = wire.until_restart().unwrap();
        assert!(pause > ms(1) && pause <= ms(800), "{pause:?}");
        // Back by itself before that: nothing to do.
        wire.bus_off(false);
        assert_eq!(wire.until_restart(), None);
        // What fails for a reason that may pass is not the end.
        wire.restart_at_ns = Some(0);
        wire.restart_if_due();
        let said = ears.said.borrow().join("\n");
        assert!(said.contains("it is tried again in 1600 ms"), "{said}");
        assert_eq!(wire.restarts, 4);
        assert!(wire.until_restart().is_some_and(|pause| pause > ms(1)));
    });
    with_wire(&settings(0, &[]), |wire, _, ears| {
        wire.interface.settable = true;
        wire.bus_off(true);
        let said = ears.said.borrow().join("\n");
        assert!(said.contains("stays in bus-off, because bus_off_restart = \"0ms\""), "{said}");
    });
    // The kernel does it by itself.
    with_wire(&settings(100, &[]), |wire, _, _| {
        wire.interface = Interface { settable: true, restart_ms: Some(100), ..wire.interface };
        wire.bus_off(true);
        assert_eq!(wire.until_restart(), None);
    });
}

#[test]
fn own_frames_outside_of_the_filters_need_no_echo() {
    with_wire(&settings(100, &["100:700"]), |wire, far, ears| {
        for text in ["210#01", "123#02", "211#03"] {
            wire.line.hub.look(|bus, _| bus.push_rail(&parse(text).unwrap(), false, clock::mono_ns(), 0));
        }
        assert!(matches!(wire.exchange(), End::No));
        let mut bytes = [0; 80];
        let sent: Vec<_> = std::iter::from_fn(|| far.recv(&mut bytes).ok()).collect();
        assert_eq!(sent, [16, 16, 16]);
        let seen: Vec<_> = ears.frames.borrow().iter().map(|(text, _)| text.clone()).collect();
        assert_eq!(seen, ["210#01", "211#03"], "123 waits for its echo");
    });
}

fn push(wire: &Wire<'_, Ears>, text: &str, since_ns: u64) {
    wire.line.hub.look(|bus, _| bus.push_rail(&parse(text).unwrap(), false, since_ns, 0));
}

fn arrived(far: &UnixDatagram) -> Vec<String> {
    let mut bytes = [0; 80];
    let received = std::iter::from_fn(|| far.recv(&mut bytes).ok().map(|n| bytes[..n].to_vec()));
    received.map(|b| crate::protocol::candump::format(&sys::from_kernel(&b).unwrap())).collect()
}

/// A kernel whose interface is in bus-off takes frames and throws them away: no echo would ever come.
#[test]
fn in_bus_off_the_kernel_is_given_nothing() {
    with_wire(&settings(100, &[]), |wire, far, _| {
        wire.interface.settable = true;
        let now_ns = clock::mono_ns();
        push(wire, "100#01", now_ns);
        assert!(matches!(wire.exchange(), End::No));
        assert_eq!(arrived(far), ["100#01"]);
        send(far, "20000040#0000000000000000");
        for text in ["101#02", "102#03", "103#04", "104#05"] {
            push(wire, text, now_ns);
        }
        push(wire, "099#06", now_ns - 5_000_000_000);
        // The first turn hears of it and still gives nothing, and so does the next.
        assert!(matches!(wire.exchange(), End::No));
        assert!(matches!(wire.exchange(), End::No));
        assert_eq!(arrived(far), <[&str; 0]>::default());
        send(far, "20000100#0000000000000000");
        assert!(matches!(wire.exchange(), End::No));
        assert_eq!(arrived(far), ["101#02", "102#03", "103#04"]);
        let counters = wire.line.hub.look(|bus, _| bus.wire_counters()).unwrap();
        assert_eq!((counters.lost, counters.stale), (1, 1), "what was on its way, and what is too old");
    });
}

#[test]
fn a_frame_that_the_kernel_refuses_takes_no_place() {
    with_wire(&settings(100, &[]), |wire, far, ears| {
        let now_ns = clock::mono_ns();
        push(wire, "100#01", now_ns);
        assert!(matches!(wire.exchange(), End::No));
        // Now the kernel refuses (here: nobody is there).
        far.shutdown(std::net::Shutdown::Both).unwrap();
        push(wire, "200#02", now_ns);
        let _ = wire.give();
        let first = parse("100#01").unwrap();
        wire.line.hub.turn(|bus, host, now_ns| bus.wire_echo(&first, now_ns, host));
        assert_eq!(wire.line.hub.look(|bus, _| bus.wire_overdue(now_ns)), None, "{:?}", ears.said.borrow());
    });
}

/// State, counters and lost echoes are looked at on a bus that is never silent, too.
#[test]
fn frames_that_keep_coming_do_not_put_off_the_look() {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    with_wire_on(&runtime, &settings(100, &[]), async |wire, far, ears| {
        let flood = async {
            loop {
                send(far, "123#01");
                tokio::time::sleep(Duration::from_millis(50)).await;
            }
        };
        tokio::select! {
            // There is no such interface, and the look finds that.
            () = wire.run() => {}
            () = flood => {}
            () = tokio::time::sleep(Duration::from_secs(30)) => panic!("30 s without a look"),
        }
        assert!(!ears.frames.borrow().is_empty());
    });
}
