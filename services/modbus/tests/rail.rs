//! The whole service on a real rail: a thread runs `run`, this one plays launcher and PLC, a third is the client.

#![allow(clippy::unwrap_used, clippy::expect_used, reason = "helpers of a test, outside #[test] functions")]

use ipc_types::image_write;
use ipc_types::payload::{
    Event, Image, ImageWrite, Inputs, Job, JobResult, PlcState, SerialChunk, Status, serial_flag,
};
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
             { "table": "coils", "at": 0, "count": 64, "area": "%QX0.0" } ],
    "serial": [ { "port": "com1", "unit": 5 } ],
    "stale_after": "2s",
    "enable_from": "%MX40.0",
    "clients_to": "%IB20"
}"#;

/// What the client tells the thread that plays the PLC.
enum Tell {
    /// Publish images in this state, or none.
    Scan(Option<PlcState>),
    /// Put these bytes on the serial line as one frame, and answer with what comes back within this time.
    Line(Vec<u8>, Sender<Vec<u8>>, Duration),
    /// Send this command, answer with the code of its result.
    Job(&'static str, Sender<u32>),
    /// Set a byte of %M.
    Marker(usize, u8),
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

/// A frame for unit 5 and its CRC.
fn rtu(pdu: &[u8]) -> Vec<u8> {
    let mut out = [0; 256];
    let len = dinrail_modbus::protocol::rtu::encode(5, pdu, &mut out);
    out[..len].to_vec()
}

impl Client {
    fn line(&self, frame: Vec<u8>) -> Vec<u8> {
        self.line_within(frame, LONG).expect("an answer on the line")
    }

    /// Silence long enough to be one.
    fn line_is_silent(&self, frame: Vec<u8>) -> bool {
        self.line_within(frame, Duration::from_millis(500)).is_none()
    }

    fn line_within(&self, frame: Vec<u8>, limit: Duration) -> Option<Vec<u8>> {
        let (answer, shown) = channel();
        self.tell.send(Tell::Line(frame, answer, limit)).unwrap();
        shown.recv_timeout(2 * LONG).ok()
    }

    fn job(&self, job: &'static str) -> u32 {
        let (answer, shown) = channel();
        self.tell.send(Tell::Job(job, answer)).unwrap();
        shown.recv_timeout(LONG).unwrap()
    }
}

/// The serial line serves the same image, counts, and is switched with the rest.
fn serial_line_and_switch(client: &mut Client) {
    assert_eq!(client.line(rtu(&[3, 0, 0, 0, 1])), rtu(&[3, 2, 0x12, 0x55]));
    assert_eq!(client.line(rtu(&[6, 0, 3, 0xAB, 0xCD])), rtu(&[6, 0, 3, 0xAB, 0xCD]));
    assert_eq!(client.ask(&[3, 0, 3, 0, 1]), [3, 2, 0xAB, 0xCD]);
    let mut wrong = rtu(&[3, 0, 0, 0, 1]);
    wrong[2] ^= 1;
    client.tell.send(Tell::Line(wrong, channel().0, LONG)).unwrap();
    // Counted: one damaged frame.
    assert_eq!(client.line(rtu(&[8, 0, 0x0C, 0, 0])), rtu(&[8, 0, 0x0C, 0, 1]));
    let port = client.stream.local_addr().unwrap().port().to_le_bytes();
    let list = [1, 0, 127, 0, 0, 1, port[0], port[1], 0, 0, 0, 0, 0, 0];
    client.shows(|shown| shown.inputs.get(4..18) == Some(&list[..]));
    client.shows(|shown| {
        shown.status["serial"][0]["sent"] == 3 && shown.status["serial"][0]["crc_errors"] == 1
    });

    // Off and on by command, by the bit.
    assert_eq!(client.job(r#"{ "do": "fly" }"#), 3);
    assert_eq!(client.job(r#"{ "do": "disable" }"#), 0);
    assert_eq!(client.stream.read(&mut [0; 1]).unwrap_or(0), 0, "the connection is closed");
    client.shows(|shown| shown.status["enabled"] == false && shown.status["listen"].is_null());
    assert!(client.line_is_silent(rtu(&[3, 0, 0, 0, 1])));
    assert_eq!(client.job(r#"{ "do": "enable" }"#), 0);
    client.shows(|shown| shown.status["enabled"] == true);
    assert_eq!(client.line(rtu(&[3, 0, 0, 0, 1])), rtu(&[3, 2, 0x12, 0x55]));
    client.tell.send(Tell::Marker(40, 0)).unwrap();
    client.shows(|shown| shown.status["enabled"] == false);
    assert!(client.line_is_silent(rtu(&[3, 0, 0, 0, 1])));
    client.tell.send(Tell::Marker(40, 1)).unwrap();
    client.shows(|shown| shown.status["enabled"] == true);
}

const READ_0: [u8; 5] = [3, 0, 0, 0, 1];

fn client(address: SocketAddr, tell: Sender<Tell>) {
    let connect = || {
        let stream = TcpStream::connect(address).unwrap();
        stream.set_nodelay(true).unwrap();
        stream.set_read_timeout(Some(LONG)).unwrap();
        stream
    };
    let mut client = Client { stream: connect(), tell };

    // No image yet, so the bit that switches the server on is not set either.
    assert_eq!(client.stream.read(&mut [0; 1]).unwrap_or(0), 0);
    client.tell.send(Tell::Scan(Some(PlcState::Run))).unwrap();
    client.shows(|shown| shown.status["enabled"] == true);
    client.stream = connect();
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
    client.shows(|shown| shown.inputs.get(..4) == Some(&[0xCD, 0xAB, 0, 0][..]));
    assert_eq!(client.ask(&[3, 0, 50, 0, 1]), [0x83, 2]);

    serial_line_and_switch(&mut client);
    client.stream = connect();

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
    assert_eq!(shown.status["writes"]["queued"], 4);
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
            topic(TopicKind::Writes, "plc").wakes("plc"),
            topic(TopicKind::Inputs, "modbus").wakes("plc"),
            topic(TopicKind::Jobs, "modbus").wakes("modbus"),
            topic(TopicKind::Results, "modbus"),
            topic(TopicKind::SerialRx, "com1").wakes("modbus"),
            topic(TopicKind::SerialTx, "com1"),
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
    areas[Area::Marker as usize][40] = 1;
    let mut rx = ctx.publisher::<SerialChunk>("com1/rx").unwrap();
    let mut tx = ctx.subscriber::<SerialChunk>("com1/tx").unwrap();
    let mut jobs = ctx.publisher::<Job>("modbus/jobs").unwrap();
    let mut results = ctx.subscriber::<JobResult>("modbus/results").unwrap();
    let (mut asked, mut waiting_job) = (None::<(Sender<Vec<u8>>, Instant)>, None::<(Sender<u32>, u64)>);
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
        let mut sent = Vec::new();
        tx.drain(64, |header, bytes| {
            assert!(header.first_t_ns > header.stamp.t_ns, "an answer has its deadline");
            sent.push((header.stamp, bytes.to_vec()));
        });
        for (stamp, bytes) in sent {
            let echo = SerialChunk {
                flags: serial_flag::TX_ECHO | serial_flag::END,
                tx_seq: stamp.seq,
                tx_writer: stamp.writer,
                tx_generation: stamp.generation,
                ..SerialChunk::default()
            };
            rx.send_tail(echo, &bytes).unwrap();
            rx.ring();
            if let Some((answer, _)) = asked.take() {
                let _ = answer.send(bytes);
            }
        }
        // The sender learns of silence by the end of its channel.
        if asked.as_ref().is_some_and(|(_, end)| Instant::now() > *end) {
            asked = None;
        }
        results.drain(16, |result, _| {
            if let Some((answer, seq)) = &waiting_job
                && *seq == result.job_seq
            {
                answer.send(result.code).unwrap();
            }
        });
        inputs.newest(|_, tail| latest_inputs = tail.to_vec());
        status.newest(|_, tail| latest = serde_json::from_slice(tail).unwrap());
        events.drain(256, |_, tail| {
            let event: serde_json::Value = serde_json::from_slice(tail).unwrap();
            kinds.push(event["event"].as_str().unwrap().to_owned());
        });
        match told.recv_timeout(Duration::from_millis(2)) {
            Ok(Tell::Scan(wanted)) => state = wanted,
            Ok(Tell::Line(bytes, answer, limit)) => {
                asked = Some((answer, Instant::now() + limit));
                let header = SerialChunk { flags: serial_flag::END, ..SerialChunk::default() };
                rx.send_tail(header, &bytes).unwrap();
                rx.ring();
            }
            Ok(Tell::Job(text, answer)) => {
                let seq = jobs.send_tail(Job { deadline_t_ns: u64::MAX, ..Job::default() }, text.as_bytes());
                jobs.ring();
                waiting_job = Some((answer, seq.unwrap()));
            }
            Ok(Tell::Marker(at, value)) => areas[Area::Marker as usize][at] = value,
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
