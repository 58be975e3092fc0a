//! The whole service on a real rail: a thread runs `run`, this one plays launcher and PLC, a third is the client.

#![allow(clippy::unwrap_used, reason = "helpers of a test, outside #[test] functions")]

use ipc_types::image_write;
use ipc_types::payload::{Event, Image, ImageWrite, Inputs, PlcState, Status};
use ipc_types::testing::{TestRail, join, service, topic};
use ipc_types::topic::{EVENTS, TopicKind};
use ipc_types::wiring::{Area, Neighbours, Wiring};
use std::collections::BTreeMap;
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::os::fd::OwnedFd;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::time::{Duration, Instant};

const LONG: Duration = Duration::from_secs(30);
const AREA: usize = 64;

const CONFIG: &str = r#"{
    "tcp": { "address": "127.0.0.1", "max_connections": 2 },
    "map": [ { "table": "holding", "at": 0, "count": 16, "area": "%MW0" },
             { "table": "holding", "at": 100, "count": 2, "area": "%IW2", "own": true },
             { "table": "coils", "at": 0, "count": 64, "area": "%QX0.0" } ]
}"#;

/// What the client tells the thread that plays the PLC.
enum Tell {
    /// Publish images in this state, or none.
    Scan(Option<PlcState>),
    /// Answer with %M, %Q and the number of messages taken so far.
    Show(Sender<Shown>),
    Done,
}

struct Shown {
    marker: Vec<u8>,
    output: Vec<u8>,
    messages: usize,
    inputs: Vec<u8>,
    status: serde_json::Value,
    events: Vec<String>,
}

struct Client {
    stream: TcpStream,
    tell: Sender<Tell>,
}

impl Client {
    fn ask(&mut self, pdu: &[u8]) -> Vec<u8> {
        let mut frame = vec![0, 1, 0, 0, 0, pdu.len() as u8 + 1, 1];
        frame.extend(pdu);
        self.stream.write_all(&frame).unwrap();
        let mut head = [0; 7];
        self.stream.read_exact(&mut head).unwrap();
        let mut answer = vec![0; usize::from(head[5]) - 1];
        self.stream.read_exact(&mut answer).unwrap();
        answer
    }

    /// Asks until the answer is the expected one.
    fn until(&mut self, pdu: &[u8], expected: &[u8]) {
        let end = Instant::now() + LONG;
        loop {
            let got = self.ask(pdu);
            if got == expected {
                return;
            }
            assert!(Instant::now() < end, "{pdu:02X?}: {got:02X?} instead of {expected:02X?}");
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    fn show(&self) -> Shown {
        let (answer, shown) = channel();
        self.tell.send(Tell::Show(answer)).unwrap();
        shown.recv_timeout(LONG).unwrap()
    }

    fn shows(&self, condition: impl Fn(&Shown) -> bool) -> Shown {
        let end = Instant::now() + LONG;
        loop {
            let shown = self.show();
            if condition(&shown) {
                return shown;
            }
            assert!(Instant::now() < end, "status {}, events {:?}", shown.status, shown.events);
            std::thread::sleep(Duration::from_millis(5));
        }
    }
}

const READ_0: [u8; 5] = [3, 0, 0, 0, 1];

fn client(address: SocketAddr, tell: Sender<Tell>) {
    let stream = TcpStream::connect(address).unwrap();
    stream.set_nodelay(true).unwrap();
    stream.set_read_timeout(Some(LONG)).unwrap();
    let mut client = Client { stream, tell };

    // No image yet.
    assert_eq!(client.ask(&READ_0), [0x83, 4]);
    client.tell.send(Tell::Scan(Some(PlcState::Run))).unwrap();
    client.until(&READ_0, &[3, 2, 0, 0]);
    client.shows(|shown| shown.events.iter().any(|event| event == "safe_left"));

    // A write is answered at once, read back at once, and applied as one message.
    assert_eq!(client.ask(&[16, 0, 0, 0, 2, 4, 0x12, 0x34, 0x56, 0x78]), [16, 0, 0, 0, 2]);
    assert_eq!(client.ask(&[3, 0, 0, 0, 2]), [3, 4, 0x12, 0x34, 0x56, 0x78]);
    let shown = client.shows(|shown| shown.marker[..4] == [0x34, 0x12, 0x78, 0x56]);
    assert_eq!(shown.messages, 1);
    assert_eq!(client.ask(&[15, 0, 3, 0, 10, 2, 0xCD, 0x01]), [15, 0, 3, 0, 10]);
    assert_eq!(client.ask(&[22, 0, 0, 0xFF, 0x00, 0x00, 0x55]), [22, 0, 0, 0xFF, 0x00, 0x00, 0x55]);
    assert_eq!(client.ask(&READ_0), [3, 2, 0x12, 0x55]);
    let shown = client.shows(|shown| shown.marker[0] == 0x55);
    assert_eq!((shown.messages, &shown.output[..2]), (3, &[0b0110_1000, 0b0000_1110][..]));

    // Registers that the server owns go to its part of %I.
    assert_eq!(client.ask(&[6, 0, 100, 0xAB, 0xCD]), [6, 0, 100, 0xAB, 0xCD]);
    assert_eq!(client.ask(&[3, 0, 100, 0, 2]), [3, 4, 0xAB, 0xCD, 0, 0]);
    client.shows(|shown| shown.inputs == [0xCD, 0xAB, 0, 0, 0]);
    assert_eq!(client.ask(&[3, 0, 50, 0, 1]), [0x83, 2]);

    // A stopped PLC, a running one, a silent one.
    client.tell.send(Tell::Scan(Some(PlcState::Stop))).unwrap();
    client.until(&READ_0, &[0x83, 4]);
    client.shows(|shown| shown.events.iter().any(|event| event == "safe_entered"));
    client.tell.send(Tell::Scan(Some(PlcState::Run))).unwrap();
    client.until(&READ_0, &[3, 2, 0x12, 0x55]);
    client.shows(|shown| shown.events.iter().filter(|event| *event == "safe_left").count() >= 2);
    client.tell.send(Tell::Scan(None)).unwrap();
    client.until(&READ_0, &[0x83, 4]);
    assert_eq!(client.ask(&[6, 0, 0, 0, 0]), [0x86, 4]);

    // Clients and counters are on the rail.
    let second = TcpStream::connect(address).unwrap();
    let shown = client.shows(|shown| shown.status["clients"] == 2 && shown.status["serving"] == false);
    let first = &shown.status["client_list"][0];
    assert_eq!((first["address"].as_str(), first["last_function"].as_u64()), (Some("127.0.0.1"), Some(6)));
    assert_eq!(first["port"].as_u64(), Some(u64::from(client.stream.local_addr().unwrap().port())));
    assert_eq!(shown.status["writes"]["queued"], 3);
    assert_eq!(shown.status["writes"]["own"], 1);
    drop(second);
    client.shows(|shown| shown.status["clients"] == 1 && shown.status["counters"]["closed_peer"] == 1);
    client.tell.send(Tell::Done).unwrap();
}

fn rail() -> TestRail {
    let config: dinrail_modbus::Config = serde_json::from_str(CONFIG).unwrap();
    let services =
        vec![("plc".to_owned(), "plc".to_owned()), ("modbus".to_owned(), "modbus-server".to_owned())];
    let neighbours = Neighbours { name: "modbus".to_owned(), services, ..Neighbours::default() };
    let wiring = dinrail_modbus::topics(&config, &neighbours);
    TestRail::new(
        "modbustest",
        vec![
            service("plc", "plc", serde_json::json!({}), Wiring::default()),
            service("modbus", "modbus-server", serde_json::from_str(CONFIG).unwrap(), wiring),
        ],
        vec![
            topic(TopicKind::Image, "plc"),
            topic(TopicKind::Writes, "plc").wakes("plc", 0),
            topic(TopicKind::Inputs, "modbus").wakes("plc", 0),
        ],
    )
}

#[test]
fn registers_of_a_running_stack() {
    let rail = rail();
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap();
    let root = rail.root().to_owned();
    // Ends with the process: nothing tells it to stop.
    std::thread::spawn(move || {
        let fds = BTreeMap::from([("tcp".to_owned(), OwnedFd::from(listener))]);
        dinrail_modbus::run(join(&root, "modbus", fds)).unwrap();
    });
    let (tell, told) = channel();
    let client = std::thread::spawn(move || client(address, tell));
    play_plc(&rail, &told);
    client.join().unwrap();
}

/// Scans every 2 ms until the client is done or dead.
fn play_plc(rail: &TestRail, told: &Receiver<Tell>) {
    let mut ctx = rail.context("plc");
    let mut image = ctx.publisher::<Image>("plc/image").unwrap();
    let mut writes = ctx.subscriber::<ImageWrite>("plc/writes").unwrap();
    let mut inputs = ctx.subscriber::<Inputs>("modbus/inputs").unwrap();
    let mut status = ctx.subscriber::<Status>("modbus/status").unwrap();
    let mut events = ctx.subscriber::<Event>(EVENTS).unwrap();
    let mut areas = [vec![0; AREA], vec![0; AREA], vec![0; AREA]];
    let (mut state, mut ack, mut messages) = (None, (0, 0, 0), 0);
    let mut latest = serde_json::Value::Null;
    let (mut latest_inputs, mut kinds) = (Vec::new(), Vec::new());
    loop {
        if let Some(state) = state {
            writes.drain(256, |header, tail| {
                for op in image_write::parse(tail).unwrap() {
                    assert!(op.apply(&mut areas[op.area() as usize]));
                }
                assert_ne!(header.ops, 0);
                ack = (header.stamp.writer, header.stamp.generation, header.stamp.seq);
                messages += 1;
            });
            let mut header = Image {
                state: state as u32,
                input_bytes: AREA as u32,
                output_bytes: AREA as u32,
                marker_bytes: AREA as u32,
                ..Image::default()
            };
            (header.ack_writer[0], header.ack_generation[0], header.ack_seq[0]) = ack;
            image.send_tail(header, &areas.concat()).unwrap();
        }
        inputs.newest(|_, tail| latest_inputs = tail.to_vec());
        status.newest(|_, tail| latest = serde_json::from_slice(tail).unwrap());
        events.drain(256, |_, tail| {
            let event: serde_json::Value = serde_json::from_slice(tail).unwrap();
            kinds.push(event["event"].as_str().unwrap().to_owned());
        });
        match told.recv_timeout(Duration::from_millis(2)) {
            Ok(Tell::Scan(wanted)) => state = wanted,
            Ok(Tell::Show(answer)) => {
                let shown = Shown {
                    marker: areas[Area::Marker as usize].clone(),
                    output: areas[Area::Output as usize].clone(),
                    messages,
                    inputs: latest_inputs.clone(),
                    status: latest.clone(),
                    events: kinds.clone(),
                };
                answer.send(shown).unwrap();
            }
            Err(std::sync::mpsc::RecvTimeoutError::Timeout) => {}
            Ok(Tell::Done) | Err(std::sync::mpsc::RecvTimeoutError::Disconnected) => return,
        }
    }
}
