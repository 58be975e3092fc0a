//! The servers of a virtual bus with unmodified python-can 4.6.1 as clients: handshakes, every kind of frame that each
//! protocol carries, bursts of 10,000 frames without loss. One test a kind of client, and one with all on one bus.

#![allow(clippy::unwrap_used, reason = "a test may end like this")]

use std::path::Path;
use std::process::Command;
use std::rc::Rc;

use dinrail_can::protocol::Frame;
use dinrail_can::server::{Host, Hub};
use dinrail_can::server_pty::Pty;
use dinrail_can::virtual_bus::{Dialect, Origin, Tap};

struct Nobody;

impl Tap for Nobody {
    fn frame(&mut self, _: &Frame, _: u64, _: Origin) {}
}

impl Host for Nobody {
    fn flush(&mut self) {}
    fn client(&mut self, message: String, _refused: bool) {
        println!("{message}");
    }
}

mod common;
#[path = "../../../tests/support/python.rs"]
mod python;

use common::{local, serve, settings};
use python::python;

/// Two clients of one kind; see `python_rows.py`.
fn row(kind: &str, dialect: Dialect) {
    let Some(python) = python() else { return };
    let dir = std::env::temp_dir().join(format!("dinrail-row-{kind}-{}", std::process::id()));
    std::fs::create_dir_all(&dir).unwrap();
    let link = dir.join("tty");
    let (output, drops) = local(async {
        let hub = Hub::new(settings(), Nobody, None).unwrap();
        let (address, _server) = serve(&hub, dialect).await;
        let port = address.port().to_string();
        tokio::task::spawn_local(Pty::new(&link).unwrap().serve(Rc::clone(&hub)));
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python_rows.py");
        let mut peer = Command::new(python);
        peer.arg("-u").arg(script).args([kind, &port]).arg(&link);
        let peer = std::thread::spawn(move || peer.output().unwrap());
        while !peer.is_finished() {
            tokio::select! {
                due = hub.alarm() => { due.unwrap(); hub.turn(|_, _, _| ()); }
                () = tokio::time::sleep(std::time::Duration::from_millis(50)) => {}
            }
        }
        (peer.join().unwrap(), hub.look(|bus, _| bus.counters().client_drops))
    });
    let _ = std::fs::remove_dir_all(&dir);
    let (said, errors) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "{said}{errors}");
    assert_eq!((&*said, drops), ("kinds\nburst\npaced\n", 0), "{errors}");
}

#[test]
fn socketcand() {
    row("socketcand", Dialect::Socketcand);
}

#[test]
fn socketcand_with_tcp_tune() {
    row("socketcand-tuned", Dialect::Socketcand);
}

#[test]
fn slcan_by_tcp() {
    row("slcan", Dialect::Slcan);
}

#[test]
fn slcan_on_a_terminal() {
    row("terminal", Dialect::Slcan);
}

#[test]
fn cannelloni() {
    row("cannelloni", Dialect::Cannelloni);
}

#[test]
fn all_on_one_bus() {
    let Some(python) = python() else { return };
    let output = local(async {
        let hub = Hub::new(settings(), Nobody, None).unwrap();
        hub.turn(|bus, _, _| bus.set_utc_offset(ipc_types::clock::utc_offset_ns()));
        let mut ports = Vec::new();
        for dialect in [Dialect::Socketcand, Dialect::Slcan] {
            ports.push(serve(&hub, dialect).await.0.port().to_string());
        }
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python_can.py");
        let peer = std::thread::spawn(move || {
            Command::new(python).arg("-u").arg(script).args(ports).output().unwrap()
        });
        while !peer.is_finished() {
            tokio::select! {
                due = hub.alarm() => { due.unwrap(); hub.turn(|_, _, _| ()); }
                () = tokio::time::sleep(std::time::Duration::from_millis(50)) => {}
            }
        }
        peer.join().unwrap()
    });
    let (said, errors) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "{said}{errors}");
    let parts =
        "kinds\nburst socketcand to socketcand\nburst slcan to slcan\nburst socketcand to all\nhandshakes\n";
    assert_eq!(said, parts, "{errors}");
}
