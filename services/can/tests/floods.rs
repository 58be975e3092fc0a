//! Clients that never pause: the driver's own work, the heartbeat among it, keeps its turn.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may end like this")]

use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::{Duration, Instant};

use dinrail_can::protocol::Frame;
use dinrail_can::server::{Host, Hub, prepare};
use dinrail_can::virtual_bus::{Dialect, Origin, Tap};

mod common;

use common::{local, serve, settings};

struct Nobody;

impl Tap for Nobody {
    fn frame(&mut self, _: &Frame, _: u64, _: Origin) {}
}

impl Host for Nobody {
    fn flush(&mut self) {}
    fn client(&mut self, _: String, _: bool) {}
}

#[test]
fn thousands_of_questions_in_one_segment() {
    const QUESTIONS: u64 = 5000;
    local(async {
        let hub = Hub::new(settings(), Nobody, None).unwrap();
        let (address, _server) = serve(&hub, Dialect::Socketcand).await;
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
    local(async {
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        let stream = tokio::net::TcpStream::connect(listener.local_addr().unwrap()).await.unwrap();
        prepare(&stream).unwrap();
        assert_eq!(rustix::net::sockopt::tcp_user_timeout(&stream).unwrap(), 60_000);
    });
}
