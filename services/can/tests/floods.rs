//! Clients that never pause: the driver's own work, the heartbeat among it, keeps its turn.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may end like this")]

use std::io::{Read, Write};
use std::net::{Ipv4Addr, TcpStream};
use std::time::{Duration, Instant};

use dinrail_can::protocol::Frame;
use dinrail_can::server::{Host, Hub, listen, prepare};
use dinrail_can::virtual_bus::{Dialect, Origin, Settings, Tap};
use tokio::task::LocalSet;

struct Nobody;

impl Tap for Nobody {
    fn frame(&mut self, _: &Frame, _: u64, _: Origin) {}
}

impl Host for Nobody {
    fn flush(&mut self) {}
    fn client(&mut self, _: String, _: bool) {}
}

fn settings() -> Settings {
    Settings {
        name: "can0".into(),
        bitrate: 500_000,
        data_bitrate: 2_000_000,
        pace: false,
        max_rate: 150_000,
        tx_queue: 512,
        client_buffer: 1 << 20,
    }
}

#[test]
fn thousands_of_questions_in_one_segment() {
    const QUESTIONS: u64 = 5000;
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    LocalSet::new().block_on(&runtime, async {
        let hub = Hub::new(settings(), Nobody, None).unwrap();
        let listener = listen(Ipv4Addr::LOCALHOST.into(), 0).await.unwrap();
        let address = listener.local_addr().unwrap();
        tokio::task::spawn_local(hub.clone().serve(listener, Dialect::Socketcand, None, 8));
        let client = std::thread::spawn(move || {
            let mut stream = TcpStream::connect(address).unwrap();
            stream.write_all(&b"<a>".repeat(QUESTIONS as usize)).unwrap();
            let wanted = QUESTIONS as usize * "< error unknown command >".len() + "< hi >".len();
            stream.read_exact(&mut vec![0; wanted]).unwrap();
            stream
        });
        let end = Instant::now() + Duration::from_mins(1);
        let (mut before, mut most) = (0, 0);
        while before < QUESTIONS {
            assert!(Instant::now() < end, "{before} answers");
            tokio::task::yield_now().await;
            let answered = hub.look(|bus, _| bus.client_counters(0)).map_or(before, |c| c.refused);
            most = most.max(answered - before);
            before = answered;
        }
        assert!(most <= 64, "{most} answers without a pause");
        drop(client.join().unwrap());
    });
}

/// Keep-alive probes only a silent connection; with bytes on their way this does it.
#[test]
fn a_peer_that_vanished_with_bytes_on_their_way() {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    runtime.block_on(async {
        let listener = listen(Ipv4Addr::LOCALHOST.into(), 0).await.unwrap();
        let stream = tokio::net::TcpStream::connect(listener.local_addr().unwrap()).await.unwrap();
        prepare(&stream).unwrap();
        assert_eq!(rustix::net::sockopt::tcp_user_timeout(&stream).unwrap(), 60_000);
    });
}
