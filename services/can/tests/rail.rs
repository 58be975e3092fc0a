//! The driver as a service: a whole rail in one process, the driver on a thread, a process of the stack and a TCP
//! client around it. One test function, because a process belongs to one rail for its whole life.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may end like this")]

use std::collections::BTreeMap;
use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::os::fd::OwnedFd;
use std::time::{Duration, Instant};

use ipc_types::Wiring;
use ipc_types::payload::{CanFrame, Health, HealthState, Status, can_flag, fd_flag, id_flag};
use ipc_types::port::{Publisher, SendError, Subscriber};
use ipc_types::reactor::Reactor;
use ipc_types::testing::{PATIENCE, TestRail, join, service, topic, wait};
use ipc_types::topic::TopicKind;
use ipc_types::wiring::Neighbours;
use serde_json::json;

struct Probe {
    reactor: Reactor,
    inbox: ipc_types::inbox::Inbox,
    rx: Subscriber<CanFrame>,
    tx: Publisher<CanFrame>,
}

impl Probe {
    /// Frames of `rx` until there are so many.
    fn receive(&mut self, count: usize) -> Vec<CanFrame> {
        let mut got = Vec::with_capacity(count);
        let end = Instant::now() + PATIENCE;
        while got.len() < count {
            assert!(Instant::now() < end, "{} of {count} frames came; {:?}", got.len(), self.rx.counters());
            self.reactor.wait(Some(Duration::from_millis(100))).unwrap();
            self.inbox.drain();
            while self.rx.drain(1024, |frame, _| got.push(*frame)) == 1024 {}
        }
        got
    }

    fn send(&mut self, frame: CanFrame) {
        let end = Instant::now() + PATIENCE;
        loop {
            match self.tx.send(frame) {
                Ok(_) => return self.tx.ring(),
                Err(SendError::NoReader(_)) => assert!(Instant::now() < end, "the driver never came"),
                Err(e) => panic!("{e}"),
            }
            std::thread::sleep(Duration::from_millis(1));
        }
    }
}

fn expect(stream: &mut TcpStream, text: &str) {
    let mut got = vec![0; text.len()];
    stream.read_exact(&mut got).unwrap();
    assert_eq!(String::from_utf8_lossy(&got), text);
}

#[test]
fn a_bus_on_the_rail() {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap();
    // At this rate a reader may sleep for a second without loss: enough on any machine.
    let config = json!({ "backend": "virtual", "max_rate": 8_000, "serve": { "socketcand": address } });
    let neighbours = Neighbours { name: "can0".into(), ..Neighbours::default() };
    let wiring = dinrail_can::topics(&serde_json::from_value(config.clone()).unwrap(), &neighbours);
    assert_eq!(wiring.listeners[0].name, "socketcand");
    let rx_depth = wiring.topics.iter().find(|t| t.kind == TopicKind::CanRx).unwrap().depth;
    let rail = TestRail::new(
        "cantest",
        vec![
            service("can0", "can", config, wiring),
            service("probe", "can", serde_json::Value::Null, Wiring::default()),
        ],
        vec![
            topic(TopicKind::CanRx, "can0").depth(rx_depth).wakes("probe"),
            topic(TopicKind::CanTx, "can0").depth(1024).wakes("can0"),
        ],
    );
    let mut ctx = rail.context("probe");
    let mut health = ctx.subscriber::<Health>("can0/health").unwrap();
    let mut status = ctx.subscriber::<Status>("can0/status").unwrap();
    let inbox = ctx.inbox().unwrap();
    let mut reactor = Reactor::new().unwrap();
    reactor.add(inbox.fd()).unwrap();
    let mut probe = Probe {
        rx: ctx.subscriber("can0/rx").unwrap(),
        tx: ctx.publisher("can0/tx").unwrap(),
        inbox,
        reactor,
    };
    let fds = BTreeMap::from([("socketcand".to_owned(), OwnedFd::from(listener))]);
    let root = rail.root().to_owned();
    std::thread::spawn(move || dinrail_can::run(join(&root, "can0", fds)).unwrap());
    wait("the driver ready", || {
        let mut ready = false;
        health.newest(|h, _| ready = h.state == HealthState::Ready as u32);
        ready.then_some(())
    });

    // What a process of the stack sends comes back as echo, with data untouched, in all kinds.
    let fd = CanFrame {
        can_id: id_flag::EFF | 0x1ABC_DEF0,
        len: 64,
        fd_flags: fd_flag::FDF | fd_flag::BRS,
        data: [0x5A; 64],
        ..CanFrame::default()
    };
    let remote = CanFrame { can_id: id_flag::RTR | 0x123, len: 4, ..CanFrame::default() };
    for frame in [CanFrame::classic(0x123, &[1, 2, 3]), remote, fd] {
        probe.send(frame);
        let echo = probe.receive(1)[0];
        assert_eq!(
            (echo.can_id, echo.len, echo.fd_flags, echo.data),
            (frame.can_id, frame.len, frame.fd_flags, frame.data)
        );
        assert_eq!((echo.flags, echo.stamp.writer), (can_flag::TX_ECHO, 1));
        // And tells who sent it.
        assert_eq!((echo.sender, echo.echo_of(2), echo.echo_of(1)), (2, Some(true), Some(false)));
    }
    // What stands behind the data of a frame is not of the frame.
    let mut dirty = CanFrame::classic(0x124, &[1, 2]);
    dirty.data[2..].fill(0xEE);
    probe.send(dirty);
    assert_eq!(probe.receive(1)[0].data, CanFrame::classic(0x124, &[1, 2]).data);
    // What cannot exist on a bus is dropped and counted.
    probe.send(CanFrame { len: 9, ..CanFrame::default() });

    // A TCP client and the rail see each other; the client's frames are no echoes.
    let mut client = TcpStream::connect(address).unwrap();
    client.set_read_timeout(Some(PATIENCE)).unwrap();
    expect(&mut client, "< hi >");
    client.write_all(b"< open can0 >").unwrap();
    expect(&mut client, "< ok >");
    client.write_all(b"< rawmode >").unwrap();
    expect(&mut client, "< ok >");
    client.write_all(b"< send 7ff 2 a b >").unwrap();
    let frame = probe.receive(1)[0];
    assert_eq!((frame.id(), frame.payload(), frame.flags), (0x7FF, &[0xA, 0xB][..], 0));
    probe.send(CanFrame::classic(0x42, &[0xFF]));
    expect(&mut client, "< frame 042 ");
    probe.receive(1);

    burst_of_a_process(&mut probe);
    burst_of_a_client(&mut probe, client);

    let mut text = String::new();
    wait("the counters of all frames", || {
        status.newest(|_, tail| text = String::from_utf8_lossy(tail).into_owned());
        (text.contains("\"tx_invalid\":1") && text.contains("\"tx\":20005")).then_some(())
    });
    assert!(text.contains("\"protocol\":\"socketcand\"") || text.contains("\"clients\":[]"), "{text}");
}

/// 20,000 frames of one identifier through the rail: none lost, order kept, the writer held back by refusals.
fn burst_of_a_process(probe: &mut Probe) {
    const COUNT: u32 = 20_000;
    let start = Instant::now();
    let (mut next, mut refusals) = (0u32, 0u32);
    let mut got = Vec::with_capacity(COUNT as usize);
    while got.len() < COUNT as usize {
        assert!(start.elapsed() < PATIENCE, "{} frames; {:?}", got.len(), probe.rx.counters());
        for _ in 0..256 {
            if next == COUNT {
                break;
            }
            match probe.tx.send(CanFrame::classic(0x100, &next.to_le_bytes())) {
                Ok(_) => next += 1,
                Err(SendError::Full(_)) => {
                    refusals += 1;
                    break;
                }
                Err(e) => panic!("{e}"),
            }
        }
        probe.tx.ring();
        probe.inbox.drain();
        probe.rx.drain(8192, |frame, _| {
            got.push(u32::from_le_bytes([frame.data[0], frame.data[1], frame.data[2], frame.data[3]]));
        });
    }
    let rate = f64::from(COUNT) / start.elapsed().as_secs_f64();
    println!("rail to rail: {rate:.0} frames/s, {refusals} refusals");
    assert_eq!(probe.rx.counters().lost, 0);
    assert!(got.iter().copied().eq(0..COUNT), "order");
}

/// 20,000 frames of a TCP client to one process of the stack: none lost, order kept.
fn burst_of_a_client(probe: &mut Probe, mut client: TcpStream) {
    const COUNT: u32 = 20_000;
    let writer = std::thread::spawn(move || {
        let mut text = String::new();
        for i in 0..COUNT {
            use std::fmt::Write as _;
            let [a, b, c, d] = i.to_le_bytes();
            let _ = write!(text, "< send 200 4 {a:x} {b:x} {c:x} {d:x} >");
        }
        client.write_all(text.as_bytes()).unwrap();
        client
    });
    let start = Instant::now();
    let frames = probe.receive(COUNT as usize);
    println!("TCP to rail: {:.0} frames/s", f64::from(COUNT) / start.elapsed().as_secs_f64());
    assert_eq!(probe.rx.counters().lost, 0);
    let numbers = frames.iter().map(|f| u32::from_le_bytes([f.data[0], f.data[1], f.data[2], f.data[3]]));
    assert!(numbers.eq(0..COUNT), "order");
    let stamps: Vec<_> = frames.iter().map(|f| (f.stamp.t_ns, f.stamp.seq)).collect();
    assert!(stamps.is_sorted());
    drop(writer.join().unwrap());
}
