use super::*;
use crate::protocol::Frame;
use crate::protocol::socketcand_client::Client;
use crate::server::Hub;
use crate::virtual_bus::{Origin, Settings, Tap};
use std::cell::Cell;
use std::io::{Read, Write};
use std::net::TcpListener;
use std::rc::Rc;
use std::time::Duration;

#[derive(Default, Clone)]
struct Count(Rc<Cell<usize>>);

impl Tap for Count {
    fn frame(&mut self, _: &Frame, _: u64, _: Origin) {
        self.0.set(self.0.get() + 1);
    }
}

impl Host for Count {
    fn flush(&mut self) {}
    fn client(&mut self, _: String, _: bool) {}
}

fn hub(tx_queue: usize) -> (Rc<Hub<Count>>, Count) {
    let count = Count::default();
    let settings = Settings {
        name: "can0".into(),
        bitrate: 500_000,
        data_bitrate: 2_000_000,
        pace: false,
        max_rate: 1_000_000,
        tx_queue,
        client_buffer: 65_536,
    };
    let hub = Hub::new(settings, count.clone(), None).unwrap();
    (hub, count)
}

fn local<F: Future>(work: F) -> F::Output {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    tokio::task::LocalSet::new().block_on(&runtime, work)
}

#[test]
fn what_a_peer_that_reads_nothing_was_not_given_has_no_echo() {
    local(async {
        let (hub, count) = hub(4096);
        let mut peer = Client::new("can0");
        hub.look(|bus, _| bus.attach_wire(peer.flight()));
        let line = Line::new(hub.clone(), "remote");
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let port = Target::Tcp(listener.local_addr().unwrap().to_string()).open().await.unwrap();
        let (far, _) = listener.accept().unwrap();
        let mut talk = Talk {
            line: &line,
            peer: &mut peer,
            port,
            out: Vec::new(),
            heard: Vec::new(),
            last_ns: 0,
            was_up: false,
            blocked: false,
        };
        talk.peer.connected(clock::mono_ns(), &mut talk.out);
        let (heard, out) = (&mut talk.heard, &mut talk.out);
        talk.peer.receive(b"< hi >< ok >< ok >", clock::mono_ns(), out, &mut |h| heard.push(h));
        let frame = Frame::data(0x123, false, &[0; 8]).unwrap();
        // Until the other side's buffers are full, without waiting for anything.
        let end = std::time::Instant::now() + Duration::from_mins(1);
        while !talk.blocked {
            assert!(std::time::Instant::now() < end);
            talk.port.ready(Interest::WRITABLE).await.unwrap();
            hub.turn(|bus, _, now_ns| {
                while bus.rail_room() > 0 {
                    bus.push_rail(&frame, false, now_ns, 0);
                }
            });
            talk.settle().unwrap();
            talk.blocked = talk.write().unwrap();
        }
        let (echoes, waiting) = (count.0.get(), talk.out.len());
        assert!(waiting <= 2 * WRITE_BYTES);
        hub.turn(|bus, _, now_ns| {
            while bus.rail_room() > 0 {
                bus.push_rail(&frame, false, now_ns, 0);
            }
        });
        for _ in 0..10 {
            talk.settle().unwrap();
        }
        assert_eq!((count.0.get(), talk.out.len()), (echoes, waiting));
        drop(far);
    });
}

#[test]
fn a_peer_that_never_pauses_lets_others_have_their_turn() {
    const FRAME: &[u8] = b"< frame 123 1.0 11 >";
    const FRAMES: usize = 200_000;
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap().to_string();
    let server = std::thread::spawn(move || {
        let (mut stream, _) = listener.accept().unwrap();
        let mut answer = [0; 64];
        for text in ["< hi >", "< ok >", "< ok >"] {
            stream.write_all(text.as_bytes()).unwrap();
            assert!(stream.read(&mut answer).unwrap() > 0 || text == "< ok >");
            if text == "< ok >" && answer.starts_with(b"< rawmode >") {
                break;
            }
        }
        stream.write_all(b"< ok >").unwrap();
        stream.write_all(&FRAME.repeat(FRAMES)).unwrap();
        stream
    });
    local(async {
        let (hub, count) = hub(16);
        let peer = Box::new(Client::new("can0"));
        hub.look(|bus, _| bus.attach_wire(peer.flight()));
        tokio::task::spawn_local(drive(Line::new(hub, "remote"), Target::Tcp(address), peer));
        let (mut before, mut most) = (0, 0);
        let end = std::time::Instant::now() + Duration::from_mins(1);
        while before < FRAMES {
            assert!(std::time::Instant::now() < end, "{before} frames");
            tokio::task::yield_now().await;
            most = most.max(count.0.get() - before);
            before = count.0.get();
        }
        assert!(most <= 2 * READ_BYTES / FRAME.len(), "{most} frames without a pause");
    });
    drop(server.join().unwrap());
}
