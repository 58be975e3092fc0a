//! The driver on a rail of its own, with pseudo-terminals as lines.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, missing_docs)]

use dinrail_serial::config::Config;
use dinrail_serial::port::{Options, Port, Read, Target};
use dinrail_serial::protocol::crc::crc16;
use ipc_types::Context;
use ipc_types::payload::{SerialChunk, serial_flag};
use ipc_types::port::{Publisher, Subscriber};
use ipc_types::testing::{TestRail, join, service, topic, wait};
use ipc_types::topic::TopicKind;
use ipc_types::wiring::Wiring;
use serde_json::json;
use std::path::{Path, PathBuf};

fn frame(bytes: &[u8]) -> Vec<u8> {
    let mut frame = bytes.to_vec();
    frame.extend(crc16(bytes).to_le_bytes());
    frame
}

/// The other end of a line.
fn open(path: &Path) -> Port {
    let options: Options =
        Config::of_device(path.to_str().unwrap()).options(Path::new("/")).expect("a device");
    wait("the other end", || Port::open(&options).ok())
}

fn read(port: &mut Port, want: usize) -> Vec<u8> {
    let mut all = Vec::new();
    wait("bytes on the line", || {
        let mut bytes = [0; 512];
        if let Ok(Read::Bytes(n, _)) = port.read(&mut bytes) {
            all.extend_from_slice(&bytes[..n]);
        }
        (all.len() >= want).then_some(())
    });
    all
}

struct User {
    rx: Subscriber<SerialChunk>,
    tx: Publisher<SerialChunk>,
    seen: Vec<(SerialChunk, Vec<u8>)>,
}

impl User {
    fn new(ctx: &mut Context, serial: &str) -> Self {
        Self {
            rx: ctx.subscriber(&TopicKind::SerialRx.of(serial)).unwrap(),
            tx: ctx.publisher(&TopicKind::SerialTx.of(serial)).unwrap(),
            seen: Vec::new(),
        }
    }

    fn send(&mut self, bytes: &[u8]) -> u64 {
        let header = SerialChunk { flags: serial_flag::END, ..SerialChunk::default() };
        // The driver connects at its own time.
        let seq = wait("the driver", || self.tx.send_tail(header, bytes).ok());
        self.tx.ring();
        seq
    }

    fn next(&mut self) -> (SerialChunk, Vec<u8>) {
        if self.seen.is_empty() {
            let Self { rx, seen, .. } = self;
            wait("a chunk on rx", || {
                rx.drain(16, |header, bytes| seen.push((*header, bytes.to_vec())));
                (!seen.is_empty()).then_some(())
            });
        }
        self.seen.remove(0)
    }
}

fn status(rx: &mut Subscriber<ipc_types::payload::Status>) -> serde_json::Value {
    wait("a status", || {
        let mut value = None;
        rx.newest(|_, text| value = serde_json::from_slice(text).ok());
        value
    })
}

#[test]
fn frames_both_ways_echoes_and_a_port_that_goes_and_comes() {
    let dir = std::env::temp_dir().join(format!("dinrail-serial-rail-{}", std::process::id()));
    let _ = std::fs::remove_dir_all(&dir);
    std::fs::create_dir_all(&dir).unwrap();
    let made: PathBuf = dir.join("made");
    let line: PathBuf = dir.join("line");
    let wiring = Wiring::default;
    let rail = TestRail::in_folder(
        &dir,
        "serialrail",
        vec![
            service("user", "plc", json!({}), wiring()),
            // Makes its own terminal, at the pace of a line.
            service("com1", "serial", json!({ "device": "pty:made", "pace": true }), wiring()),
            // Opens a device that somebody else makes.
            service("com2", "serial", json!({ "device": line, "framing": "ascii" }), wiring()),
        ],
        vec![
            topic(TopicKind::SerialRx, "com1"),
            topic(TopicKind::SerialTx, "com1").wakes("com1"),
            topic(TopicKind::SerialRx, "com2"),
            topic(TopicKind::SerialTx, "com2").wakes("com2"),
        ],
    );
    let mut ctx = rail.context("user");
    let mut com1 = User::new(&mut ctx, "com1");
    let mut com2 = User::new(&mut ctx, "com2");
    let mut status2 = ctx.subscriber(&TopicKind::Status.of("com2")).unwrap();
    for name in ["com1", "com2"] {
        let root = rail.root().to_owned();
        std::thread::spawn(move || {
            let ctx = join(&root, name, std::collections::BTreeMap::new());
            dinrail_serial::run(ctx).unwrap();
        });
    }

    // com1: a frame of the other end.
    let mut peer = open(&made);
    let request = frame(&[1, 3, 0, 0, 0, 2]);
    peer.write(&request).unwrap();
    let (header, bytes) = com1.next();
    assert_eq!((header.flags, bytes), (serial_flag::END, request.clone()));
    // Eight characters of 11 bits at 19200 baud, and 3.5 of silence.
    let took_ns = header.stamp.t_ns - header.first_t_ns;
    assert!(took_ns >= (7 * 11 + 38) * 1_000_000_000 / 19_200, "{took_ns}");
    // A frame of ours, and its echo.
    let answer = frame(&[1, 3, 4, 0, 1, 0, 2]);
    let seq = com1.send(&answer);
    assert_eq!(read(&mut peer, answer.len()), answer);
    let (echo, bytes) = com1.next();
    assert_eq!(echo.flags, serial_flag::END | serial_flag::TX_ECHO);
    assert_eq!((echo.tx_seq, echo.tx_writer, echo.tx_generation), (seq, 1, 1));
    assert_eq!(bytes, answer);
    assert!(echo.stamp.t_ns - echo.first_t_ns >= 9 * 11 * 1_000_000_000 / 19_200);
    // What is over its deadline is not sent.
    let late = SerialChunk { flags: serial_flag::END, first_t_ns: 1, ..SerialChunk::default() };
    com1.tx.send_tail(late, &answer).unwrap();
    com1.tx.ring();
    assert_eq!(com1.next().0.flags, serial_flag::END | serial_flag::TX_ECHO | serial_flag::NOT_SENT);

    // com2: without its device nothing is sent, and the writer is told.
    wait("the closed port's status", || {
        let value = status(&mut status2);
        (value["state"] != "open" && value["why"].as_str()?.contains("there is no device")).then_some(())
    });
    com2.send(b":0103\r\n");
    let (refused, _) = com2.next();
    assert_eq!(refused.flags, serial_flag::END | serial_flag::TX_ECHO | serial_flag::NOT_SENT);
    // The device appears, goes, and appears again.
    for round in 0..3u64 {
        let target = Target::Terminal(line.clone());
        let options = Options { target, ..Config::of_device("/x").options(Path::new("/")).unwrap() };
        let mut other = Port::open(&options).unwrap();
        wait("the port open again", || {
            let value = status(&mut status2);
            (value["state"] == "open" && value["reopened"] == round).then_some(())
        });
        assert!(other.visited());
        other.write(b":010300FC\r\n").unwrap();
        let (header, bytes) = com2.next();
        assert_eq!((header.flags, &bytes[..]), (serial_flag::END, &b":010300FC\r\n"[..]));
        com2.send(b":0103\r\n");
        assert_eq!(read(&mut other, 7), b":0103\r\n");
        assert_eq!(com2.next().0.flags, serial_flag::END | serial_flag::TX_ECHO);
        drop(other);
        wait("the port gone", || (status(&mut status2)["state"] != "open").then_some(()));
    }
    let value = status(&mut status2);
    assert_eq!((&value["rx"]["frames"], &value["tx"]["frames"]), (&json!(3), &json!(3)), "{value}");
    let _ = std::fs::remove_dir_all(&dir);
}
