//! Real TCP on the loopback interface.

use super::*;
use crate::admission::Filter;
use crate::testing::{MemoryImage, hex, matrix, tcp_device, to_hex};
use ipc_types::net::IpFilter;
use std::future::Future;
use std::net::Ipv4Addr;
use tokio::io::AsyncWriteExt;
use tokio::task::LocalSet;
use tokio::time::timeout;
use tokio_modbus::client::{Reader as _, Writer as _};
use tokio_modbus::prelude::{Client as _, Request as PeerRequest, Response as PeerResponse, Slave};

/// Generous: the machine may be busy.
const LONG: Duration = Duration::from_secs(30);

type TestHub = Rc<Hub<MemoryImage>>;

/// Runs a test with a server on a port of its own.
fn with_server<F: Future<Output = ()>>(options: Options, test: impl FnOnce(TestHub, SocketAddr) -> F) {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    LocalSet::new().block_on(&runtime, async {
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).await.unwrap();
        let address = listener.local_addr().unwrap();
        let image = Rc::new(RefCell::new(MemoryImage::new(10000)));
        let hub = Hub::new(image, tcp_device(), options);
        tokio::task::spawn_local(hub.clone().accept(listener));
        timeout(LONG, test(hub, address)).await.expect("the test hangs");
    });
}

fn frame(transaction: u16, unit: u8, pdu: &str) -> Vec<u8> {
    let pdu = hex(pdu);
    let mut frame = transaction.to_be_bytes().to_vec();
    frame.extend([0, 0]);
    frame.extend((pdu.len() as u16 + 1).to_be_bytes());
    frame.push(unit);
    frame.extend(pdu);
    frame
}

/// Reads one whole answer.
async fn read_answer(stream: &mut TcpStream) -> io::Result<Vec<u8>> {
    let mut head = [0; 6];
    stream.read_exact(&mut head).await?;
    let mut body = vec![0; usize::from(u16::from_be_bytes([head[4], head[5]]))];
    stream.read_exact(&mut body).await?;
    Ok([&head[..], &body].concat())
}

/// Whether the server closed the connection, by FIN or by RST.
async fn is_closed(stream: &mut TcpStream) -> bool {
    matches!(stream.read(&mut [0; 1]).await, Ok(0) | Err(_))
}

async fn until(condition: impl Fn() -> bool) {
    while !condition() {
        tokio::time::sleep(Duration::from_millis(1)).await;
    }
}

#[test]
fn the_matrix_of_disagreements_is_answered_as_the_specification_says() {
    for (request, response) in matrix() {
        with_server(Options::default(), |_, address| async move {
            let mut stream = TcpStream::connect(address).await.unwrap();
            // Each is followed by a good request, which must be answered too.
            stream.write_all(&frame(1, 1, &to_hex(&request))).await.unwrap();
            let expected = frame(1, 1, &to_hex(&response));
            assert_eq!(read_answer(&mut stream).await.unwrap(), expected, "{request:02X?}");
            stream.write_all(&frame(2, 1, "03 0000 0001")).await.unwrap();
            let expected = frame(2, 1, "03 02 0000");
            assert_eq!(read_answer(&mut stream).await.unwrap(), expected, "after {request:02X?}");
        });
    }
}

#[test]
fn the_matrix_of_streams() {
    with_server(Options::default(), |hub, address| async move {
        let good = frame(8, 1, "03 0000 0001");
        let answer = frame(8, 1, "03 02 0000");
        let mut stream = TcpStream::connect(address).await.unwrap();

        // Two requests in one segment.
        stream.write_all(&[frame(7, 1, "03 0000 0001"), good.clone()].concat()).await.unwrap();
        assert_eq!(read_answer(&mut stream).await.unwrap(), frame(7, 1, "03 02 0000"));
        assert_eq!(read_answer(&mut stream).await.unwrap(), answer);

        // Another protocol: nothing but the answer to the next request comes.
        let mut foreign = frame(1, 1, "03 0000 0001");
        foreign[3] = 1;
        stream.write_all(&[foreign, good.clone()].concat()).await.unwrap();
        assert_eq!(read_answer(&mut stream).await.unwrap(), answer);

        // Units 0 and 255 are the device itself.
        for unit in [0, 255] {
            stream.write_all(&frame(1, unit, "03 0000 0001")).await.unwrap();
            assert_eq!(read_answer(&mut stream).await.unwrap(), frame(1, unit, "03 02 0000"));
        }
        stream.write_all(&frame(1, 0, "06 0000 0001")).await.unwrap();
        assert_eq!(read_answer(&mut stream).await.unwrap(), frame(1, 0, "06 0000 0001"));

        // Byte by byte.
        stream.set_nodelay(true).unwrap();
        for byte in &good {
            stream.write_all(&[*byte]).await.unwrap();
            tokio::time::sleep(Duration::from_millis(2)).await;
        }
        assert_eq!(read_answer(&mut stream).await.unwrap(), frame(8, 1, "03 02 0001"));

        // A length of 300.
        stream.write_all(&hex("0001 0000 012C 01 03 0000 0001")).await.unwrap();
        assert!(is_closed(&mut stream).await);
        until(|| hub.counters().closed_bad_length == 1).await;
        assert_eq!((hub.counters().foreign, hub.clients().len()), (1, 0));
    });
}

#[test]
fn a_hundred_pipelined_requests_in_one_write() {
    with_server(Options::default(), |hub, address| async move {
        let mut stream = TcpStream::connect(address).await.unwrap();
        let stream_of: Vec<u8> = (0..100).flat_map(|i| frame(i, 1, "03 0000 007D")).collect();
        stream.write_all(&stream_of).await.unwrap();
        for i in 0..100 {
            let answer = read_answer(&mut stream).await.unwrap();
            assert_eq!((answer.len(), u16::from_be_bytes([answer[0], answer[1]])), (259, i));
        }
        assert_eq!(hub.counters().requests, 100);
        // Sixteen at a time at most, so that others get their turn.
        assert!(hub.with_backend(|image| image.batches) >= 7);
    });
}

#[test]
fn a_peer_library_reads_and_writes_everything() {
    with_server(Options::default(), |hub, address| async move {
        hub.with_backend(|image| {
            image.input[3] = 0xABCD;
            MemoryImage::set_bits(&mut image.discrete, &[0b0101]);
        });
        let mut peer = tokio_modbus::client::tcp::connect_slave(address, Slave(17)).await.unwrap();
        assert_eq!(peer.read_input_registers(3, 1).await.unwrap().unwrap(), [0xABCD]);
        assert_eq!(peer.read_discrete_inputs(0, 4).await.unwrap().unwrap(), [true, false, true, false]);
        peer.write_single_coil(9, true).await.unwrap().unwrap();
        peer.write_multiple_coils(10, &[true, false, true]).await.unwrap().unwrap();
        assert_eq!(peer.read_coils(9, 4).await.unwrap().unwrap(), [true, true, false, true]);
        peer.write_single_register(5, 0x0012).await.unwrap().unwrap();
        peer.masked_write_register(5, 0x00F2, 0x0025).await.unwrap().unwrap();
        let values: Vec<u16> = (0..121).collect();
        let read = peer.read_write_multiple_registers(5, 2, 6, &values).await.unwrap().unwrap();
        assert_eq!(read, [0x17, 0]);
        let values: Vec<u16> = (1000..1123).collect();
        peer.write_multiple_registers(200, &values).await.unwrap().unwrap();
        assert_eq!(peer.read_holding_registers(200, 123).await.unwrap().unwrap(), values);
        assert_eq!(peer.read_coils(0, 2000).await.unwrap().unwrap().len(), 2000);
        let refused = peer.read_holding_registers(9999, 2).await.unwrap().unwrap_err();
        assert_eq!(refused, tokio_modbus::ExceptionCode::IllegalDataAddress);
        hub.with_backend(|image| image.ready = false);
        let refused = peer.read_holding_registers(0, 1).await.unwrap().unwrap_err();
        assert_eq!(refused, tokio_modbus::ExceptionCode::ServerDeviceFailure);
        let refused = peer.call(PeerRequest::Custom(0x41, std::borrow::Cow::Borrowed(&[1]))).await.unwrap();
        assert!(!matches!(refused, Ok(PeerResponse::Custom(..))), "{refused:?}");
        let clients = hub.clients();
        assert_eq!((clients.len(), clients[0].last_unit, clients[0].exceptions), (1, 17, 3));
    });
}

#[test]
fn two_hundred_clients_at_once() {
    with_server(Options { max_connections: 200, ..Options::default() }, |hub, address| async move {
        let mut clients = Vec::new();
        for i in 0..200_u16 {
            let mut stream = TcpStream::connect(address).await.unwrap();
            stream.write_all(&frame(i, 1, "03 0000 0001")).await.unwrap();
            clients.push(stream);
        }
        for (i, stream) in clients.iter_mut().enumerate() {
            assert_eq!(read_answer(stream).await.unwrap(), frame(i as u16, 1, "03 02 0000"));
        }
        assert_eq!((hub.clients().len(), hub.counters().requests), (200, 200));
    });
}

fn filter(start: &str, end: &str) -> Admission {
    let (mask, start, end) = (Ipv4Addr::UNSPECIFIED, start.parse().unwrap(), end.parse().unwrap());
    Admission::new(Some(&Filter::One(IpFilter { mask, start, end })))
}

#[test]
fn connections_beyond_the_limit_are_refused_until_one_leaves() {
    let options = Options { max_connections: 2, when_full: WhenFull::Refuse, ..Options::default() };
    with_server(options, |hub, address| async move {
        let a = TcpStream::connect(address).await.unwrap();
        let mut b = TcpStream::connect(address).await.unwrap();
        until(|| hub.clients().len() == 2).await;
        let mut c = TcpStream::connect(address).await.unwrap();
        assert!(is_closed(&mut c).await);
        assert_eq!((hub.counters().accepted, hub.counters().refused_full), (2, 1));
        b.write_all(&frame(1, 1, "03 0000 0001")).await.unwrap();
        read_answer(&mut b).await.unwrap();
        drop(a);
        until(|| hub.clients().len() == 1).await;
        let mut d = TcpStream::connect(address).await.unwrap();
        d.write_all(&frame(1, 1, "03 0000 0001")).await.unwrap();
        read_answer(&mut d).await.unwrap();
        let (happened, left_out) = hub.take_happenings();
        // Of an address the first connection is told.
        assert_eq!(happened.len(), 3, "{happened:?}");
        assert!(matches!(happened[0], Happening::Connected { untold: 0, .. }));
        assert!(matches!(happened[1], Happening::Refused { why: Refusal::Full, .. }));
        assert!(matches!(happened[2], Happening::Left { why: CloseReason::Peer, .. }));
        assert_eq!(left_out, 0);
    });
}

#[test]
fn the_oldest_idle_connection_makes_room_if_wanted() {
    let options = Options {
        max_connections: 2,
        when_full: WhenFull::CloseOldestIdle,
        min_idle: Duration::from_millis(50),
        ..Options::default()
    };
    with_server(options, |hub, address| async move {
        let mut a = TcpStream::connect(address).await.unwrap();
        until(|| hub.clients().len() == 1).await;
        let mut b = TcpStream::connect(address).await.unwrap();
        until(|| hub.clients().len() == 2).await;
        // `a` connected first, but `b` is the one without a request for longest.
        tokio::time::sleep(Duration::from_millis(60)).await;
        a.write_all(&frame(1, 1, "03 0000 0001")).await.unwrap();
        read_answer(&mut a).await.unwrap();
        let mut c = TcpStream::connect(address).await.unwrap();
        c.write_all(&frame(1, 1, "03 0000 0001")).await.unwrap();
        read_answer(&mut c).await.unwrap();
        assert!(is_closed(&mut b).await);
        assert_eq!((hub.counters().closed_replaced, hub.clients().len()), (1, 2));
        // Both are busy now: min_idle has not passed for either, unless this machine slept in between.
        a.write_all(&frame(2, 1, "03 0000 0001")).await.unwrap();
        read_answer(&mut a).await.unwrap();
    });
}

#[test]
fn nobody_makes_room_who_is_not_idle() {
    let options = Options {
        max_connections: 1,
        when_full: WhenFull::CloseOldestIdle,
        min_idle: Duration::from_hours(1),
        ..Options::default()
    };
    with_server(options, |hub, address| async move {
        let _a = TcpStream::connect(address).await.unwrap();
        until(|| hub.clients().len() == 1).await;
        let mut b = TcpStream::connect(address).await.unwrap();
        assert!(is_closed(&mut b).await);
        assert_eq!(hub.counters().refused_full, 1);
    });
}

#[test]
fn addresses_outside_the_filter_are_closed_before_a_byte_is_read() {
    // Loopback is always allowed, so the peer address is given to `admit` by hand.
    let options = Options { filter: filter("10.0.0.1", "10.0.0.9"), ..Options::default() };
    with_server(options, |hub, _| async move {
        for (peer, allowed) in
            [("10.0.0.1:1", true), ("10.0.0.9:1", true), ("10.0.0.10:1", false), ("[fe80::1]:1", false)]
        {
            let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).await.unwrap();
            let mut stream = TcpStream::connect(listener.local_addr().unwrap()).await.unwrap();
            let (accepted, _) = listener.accept().await.unwrap();
            // A good request is already waiting when the connection is judged.
            stream.write_all(&frame(1, 1, "03 0000 0001")).await.unwrap();
            hub.admit(accepted, peer.parse().unwrap());
            if allowed {
                read_answer(&mut stream).await.unwrap();
            } else {
                assert!(is_closed(&mut stream).await);
            }
        }
        let counters = hub.counters();
        assert_eq!((counters.accepted, counters.refused_filter, counters.requests), (2, 2, 2));
    });
}

#[test]
fn idle_connections_are_closed() {
    let options = Options { idle_timeout: Some(Duration::from_millis(100)), ..Options::default() };
    with_server(options, |hub, address| async move {
        let mut stream = TcpStream::connect(address).await.unwrap();
        until(|| hub.clients().len() == 1).await;
        until(|| {
            hub.sweep();
            hub.clients().is_empty()
        })
        .await;
        assert!(is_closed(&mut stream).await);
        assert_eq!(hub.counters().closed_idle, 1);
    });
    with_server(Options { idle_timeout: None, ..Options::default() }, |hub, address| async move {
        let _stream = TcpStream::connect(address).await.unwrap();
        until(|| hub.clients().len() == 1).await;
        hub.sweep();
        assert_eq!(hub.clients().len(), 1);
    });
}

#[test]
fn switched_off_it_closes_and_refuses_and_on_again_it_serves() {
    with_server(Options::default(), |hub, address| async move {
        let mut a = TcpStream::connect(address).await.unwrap();
        until(|| hub.clients().len() == 1).await;
        hub.set_enabled(false);
        assert!(is_closed(&mut a).await);
        let mut b = TcpStream::connect(address).await.unwrap();
        assert!(is_closed(&mut b).await);
        let counters = hub.counters();
        assert_eq!((counters.closed_disabled, counters.refused_disabled), (1, 1));
        hub.set_enabled(true);
        let mut c = TcpStream::connect(address).await.unwrap();
        c.write_all(&frame(1, 1, "03 0000 0001")).await.unwrap();
        read_answer(&mut c).await.unwrap();
    });
}

#[test]
fn a_flood_of_connections_does_not_flood_the_rail() {
    let options = Options { max_connections: 1, when_full: WhenFull::Refuse, ..Options::default() };
    with_server(options, |hub, address| async move {
        let _a = TcpStream::connect(address).await.unwrap();
        for _ in 0..50 {
            let mut refused = TcpStream::connect(address).await.unwrap();
            assert!(is_closed(&mut refused).await);
        }
        let (happened, left_out) = hub.take_happenings();
        assert_eq!((happened.len(), left_out), (MAX_HAPPENINGS, 51 - MAX_HAPPENINGS as u64));
        assert_eq!(hub.take_happenings(), (vec![], 0));
    });
}

#[test]
fn happenings_are_sentences() {
    let peer: SocketAddr = "192.168.1.20:50000".parse().unwrap();
    let text = [
        Happening::Connected { peer, untold: 0 },
        Happening::Connected { peer, untold: 59 },
        Happening::Refused { peer, why: Refusal::Filter },
        Happening::Refused { peer, why: Refusal::Full },
        Happening::Refused { peer, why: Refusal::Disabled },
        Happening::Left { peer, why: CloseReason::Peer, requests: 7, exceptions: 1 },
        Happening::Left { peer, why: CloseReason::BadLength, requests: 0, exceptions: 0 },
        Happening::Left { peer, why: CloseReason::NotReading, requests: 0, exceptions: 0 },
    ]
    .map(|happening| format!("{happening}\n"))
    .concat();
    insta::assert_snapshot!(text, @r#"
Modbus client 192.168.1.20:50000 connected
Modbus client 192.168.1.20:50000 connected (59 more connections of this address in between)
Modbus client 192.168.1.20:50000 refused: the filter does not admit its address
Modbus client 192.168.1.20:50000 refused: max_connections are in use
Modbus client 192.168.1.20:50000 refused: the server is switched off
Modbus client 192.168.1.20:50000 left: it closed the connection; 7 requests, 1 exceptions
Modbus client 192.168.1.20:50000 left: it sent a header with an impossible length; 0 requests, 0 exceptions
Modbus client 192.168.1.20:50000 left: it did not take its answers; 0 requests, 0 exceptions
"#);
}

#[test]
fn rtu_frames_on_a_stream_and_noise_that_never_ends() {
    let options = Options { framing: Framing::Rtu, ..Options::default() };
    with_server(options, |hub, address| async move {
        let good = hex("01030000000184 0A");
        let mut stream = TcpStream::connect(address).await.unwrap();
        stream.write_all(&good).await.unwrap();
        let mut answer = [0; 7];
        stream.read_exact(&mut answer).await.unwrap();
        assert_eq!(answer, *hex("0103020000B844"));
        // The beginning of a frame that never comes whole.
        stream.write_all(&hex("01 10 0000 0002 04 00")).await.unwrap();
        until(|| hub.counters().noise >= 8).await;
        stream.write_all(&good).await.unwrap();
        stream.read_exact(&mut answer).await.unwrap();
        assert_eq!(answer, *hex("0103020000B844"));
    });
}

#[test]
fn a_peer_that_sends_and_never_reads_does_not_stop_the_others() {
    with_server(Options::default(), |hub, address| async move {
        let mut deaf = TcpStream::connect(address).await.unwrap();
        let flood: Vec<u8> = (0..200).flat_map(|i| frame(i, 1, "03 0000 007D")).collect();
        // Until the buffers of both directions are full and writing stalls.
        while let Ok(result) = timeout(Duration::from_millis(300), deaf.write_all(&flood)).await {
            result.unwrap();
        }
        let mut good = TcpStream::connect(address).await.unwrap();
        for i in 0..20 {
            good.write_all(&frame(i, 1, "03 0000 0001")).await.unwrap();
            read_answer(&mut good).await.unwrap();
        }
        until(|| hub.counters().closed_not_reading == 1).await;
    });
}

#[test]
fn a_peer_that_does_not_read_is_closed_at_once_when_the_server_is_switched_off() {
    with_server(Options::default(), |hub, address| async move {
        let mut deaf = TcpStream::connect(address).await.unwrap();
        let flood: Vec<u8> = (0..200).flat_map(|i| frame(i, 1, "03 0000 007D")).collect();
        while let Ok(result) = timeout(Duration::from_millis(300), deaf.write_all(&flood)).await {
            result.unwrap();
        }
        hub.set_enabled(false);
        until(|| hub.clients().is_empty()).await;
        let counters = hub.counters();
        assert_eq!((counters.closed_disabled, counters.closed_not_reading), (1, 0));
    });
}

#[test]
fn one_client_that_never_pauses_leaves_the_service_its_turn() {
    use std::io::{Read as _, Write as _};
    use std::sync::Arc;
    use std::sync::atomic::{AtomicBool, Ordering};
    with_server(Options::default(), |hub, address| async move {
        let stop = Arc::new(AtomicBool::new(false));
        let mut sender = std::net::TcpStream::connect(address).unwrap();
        let mut reader = sender.try_clone().unwrap();
        // The longest requests: what one read takes is never more than one turn answers.
        let longest: Vec<u8> =
            (0..15).flat_map(|i| frame(i, 1, &format!("10 0000 007B F6 {}", "00".repeat(246)))).collect();
        let flood = {
            let stop = stop.clone();
            std::thread::spawn(
                move || while !stop.load(Ordering::Relaxed) && sender.write_all(&longest).is_ok() {},
            )
        };
        let reading = std::thread::spawn(move || while matches!(reader.read(&mut [0; 4096]), Ok(1..)) {});
        until(|| hub.counters().requests > 1000).await;
        // What is served until everything else on this thread (timers, the rail, the heartbeat) has its turn.
        let (mut most, mut before) = (0, hub.counters().requests);
        for _ in 0..200 {
            tokio::task::yield_now().await;
            let now = hub.counters().requests;
            (most, before) = (most.max(now - before), now);
        }
        assert!(most <= u64::from(EAGER_TURNS) * 17, "{most} requests in one turn");
        until(|| hub.counters().requests > before + 1000).await;
        stop.store(true, Ordering::Relaxed);
        hub.set_enabled(false);
        until(|| hub.clients().is_empty()).await;
        flood.join().unwrap();
        reading.join().unwrap();
    });
}

#[test]
fn a_peer_that_vanishes_is_asked_after() {
    with_server(Options { idle_timeout: None, ..Options::default() }, |_, _| async move {
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).await.unwrap();
        let stream = TcpStream::connect(listener.local_addr().unwrap()).await.unwrap();
        keep_alive(&stream);
        use rustix::net::sockopt::{socket_keepalive, tcp_keepidle};
        assert_eq!((socket_keepalive(&stream), tcp_keepidle(&stream)), (Ok(true), Ok(KEEP_ALIVE.0)));
    });
}
