//! The TCP servers of a virtual bus with unmodified python-can 4.6.1 as clients: handshakes, every kind of frame that
//! each protocol carries, bursts of 10,000 frames without loss.

#![allow(clippy::unwrap_used, reason = "a test may end like this")]

use std::net::Ipv4Addr;
use std::path::Path;
use std::process::Command;
use std::rc::Rc;

use dinrail_can::protocol::Frame;
use dinrail_can::server::{Host, Hub, listen};
use dinrail_can::virtual_bus::{Dialect, Origin, Settings, Tap};

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

#[path = "../../../tests/support/python.rs"]
mod python;
use python::python;

#[test]
fn python_can_is_content() {
    let Some(python) = python() else { return };
    let settings = Settings {
        name: "can0".into(),
        bitrate: 500_000,
        data_bitrate: 2_000_000,
        pace: false,
        max_rate: 150_000,
        tx_queue: 512,
        client_buffer: 1 << 20,
    };
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    let output = tokio::task::LocalSet::new().block_on(&runtime, async {
        let hub = Hub::new(settings, Nobody, None).unwrap();
        hub.turn(|bus, _, _| bus.set_utc_offset(ipc_types::clock::utc_offset_ns()));
        let mut ports = Vec::new();
        for dialect in [Dialect::Socketcand, Dialect::Slcan] {
            let listener = listen(Ipv4Addr::LOCALHOST.into(), 0).await.unwrap();
            ports.push(listener.local_addr().unwrap().port().to_string());
            tokio::task::spawn_local(Rc::clone(&hub).serve(listener, dialect, None, 8));
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
