//! What is behind and before the bus, on one machine: unmodified python-can on cannelloni and on the pseudo-terminal; a
//! bus behind our own SLCAN and socketcand servers, pulled and plugged in again.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may end like this")]

use std::cell::RefCell;
use std::path::Path;
use std::process::Command;
use std::rc::Rc;
use std::time::{Duration, Instant};

use dinrail_can::protocol::peer::Peer;
use dinrail_can::protocol::{Frame, slcan_client, socketcand_client};
use dinrail_can::server::{Host, Hub};
use dinrail_can::server_pty::Pty;
use dinrail_can::txqueue::Pushed;
use dinrail_can::virtual_bus::{Dialect, Origin, Tap};
use dinrail_can::wire::port::Target;
use dinrail_can::wire::{Line, LinkStatus, remote};
use ipc_types::event::Level;
use tokio::task::spawn_local;

mod common;
#[path = "../../../tests/support/python.rs"]
mod python;

use common::{local, serve, settings};

/// Longest wait for anything; never a measure of speed.
const PATIENCE: Duration = Duration::from_mins(1);

type Said = Rc<RefCell<Vec<String>>>;
type Bus = Rc<Hub<Listener>>;
type Seen = Rc<RefCell<Vec<(Frame, Origin)>>>;

#[derive(Default)]
struct Listener {
    seen: Seen,
    said: Said,
}

impl Tap for Listener {
    fn frame(&mut self, frame: &Frame, _: u64, origin: Origin) {
        self.seen.borrow_mut().push((*frame, origin));
    }
}

impl Host for Listener {
    fn flush(&mut self) {}
    fn client(&mut self, message: String, _refused: bool) {
        println!("{message}");
    }
    fn link(&mut self, _: Level, message: String, _: bool) {
        println!("{message}");
        self.said.borrow_mut().push(message);
    }
}

/// A bus with its clock running and what was seen on it.
fn bus() -> (Bus, Seen, Said) {
    let host = Listener::default();
    let (seen, said) = (host.seen.clone(), host.said.clone());
    let hub = Hub::new(settings(), host, None).unwrap();
    let ticking = hub.clone();
    spawn_local(async move {
        loop {
            ticking.alarm().await.unwrap();
            ticking.turn(|_, _, _| ());
        }
    });
    (hub, seen, said)
}

async fn until(what: &str, mut check: impl FnMut() -> bool) {
    let start = Instant::now();
    while !check() {
        assert!(start.elapsed() < PATIENCE, "waited in vain for: {what}");
        tokio::time::sleep(Duration::from_millis(2)).await;
    }
}

fn numbered(id: u32, i: u32) -> Frame {
    Frame::data(id, false, &i.to_be_bytes()).unwrap()
}

/// All frames through the bus as a process of the stack would send them.
async fn push_all(hub: &Rc<Hub<Listener>>, frames: &[Frame]) {
    for frame in frames {
        while hub.turn(|bus, _, now_ns| bus.push_rail(frame, false, now_ns, 0)) == Pushed::Refused {
            tokio::task::yield_now().await;
        }
    }
}

fn behind(target: Target, peer: Box<dyn Peer>) -> (Bus, Seen, Said, Rc<RefCell<LinkStatus>>) {
    let (hub, seen, said) = bus();
    hub.look(|bus, _| bus.attach_wire(peer.flight()));
    let line = Line::new(hub.clone(), "wire0");
    let status = line.status.clone();
    spawn_local(remote::drive(line, target, peer));
    (hub, seen, said, status)
}

fn slcan_peer(fd: bool) -> Box<dyn Peer> {
    Box::new(slcan_client::Client::new(slcan_client::Channel {
        rate_code: 6,
        data_rate_code: fd.then_some(2),
        timestamps: true,
        restart_ns: 100_000_000,
    }))
}

/// 2,000 frames each way: own ones once and in order as ours, those of the others once and in order as theirs.
async fn both_ways(
    near: &Rc<Hub<Listener>>,
    near_seen: &Seen,
    far: &Rc<Hub<Listener>>,
    far_seen: &Seen,
    extra: &[Frame],
) {
    const COUNT: u32 = 2000;
    near_seen.borrow_mut().clear();
    far_seen.borrow_mut().clear();
    let out: Vec<_> = (0..COUNT).map(|i| numbered(0x100, i)).chain(extra.iter().copied()).collect();
    let back: Vec<_> = (0..COUNT).map(|i| numbered(0x200, i)).chain(extra.iter().copied()).collect();
    tokio::join!(push_all(near, &out), push_all(far, &back));
    let all = out.len() + back.len();
    until("all frames at both ends", || near_seen.borrow().len() >= all && far_seen.borrow().len() >= all)
        .await;
    let of = |seen: &Seen, ours: bool| -> Vec<Frame> {
        seen.borrow().iter().filter(|(_, o)| (*o == Origin::Rail(0)) == ours).map(|(f, _)| *f).collect()
    };
    // By identifier, so the extra frames may overtake; within an identifier nothing does.
    let sorted = |mut frames: Vec<Frame>| {
        frames.sort_by_key(Frame::arbitration_key);
        frames
    };
    assert_eq!(sorted(of(near_seen, true)), sorted(out.clone()));
    assert_eq!(sorted(of(far_seen, false)), sorted(out));
    assert_eq!(sorted(of(near_seen, false)), sorted(back.clone()));
    assert_eq!(sorted(of(far_seen, true)), sorted(back));
}

fn classic_extra() -> Vec<Frame> {
    vec![
        Frame::data(0x1ABC_DEF0, true, &[1, 2, 3, 4, 5, 6, 7, 8]).unwrap(),
        Frame::data(0x7FF, false, &[]).unwrap(),
        Frame::remote(0x123, false, 4).unwrap(),
        Frame::remote(0x1234_5678, true, 0).unwrap(),
    ]
}

#[test]
fn a_bus_behind_slcan_by_tcp() {
    local(async {
        let (far, far_seen, _) = bus();
        let (address, _server) = serve(&far, Dialect::Slcan).await;
        let (near, near_seen, _, status) = behind(Target::Tcp(address.to_string()), slcan_peer(true));
        until("the wire up", || status.borrow().up).await;
        let mut extra = classic_extra();
        extra.push(Frame::fd(0x321, false, 1, &[7; 64]).unwrap());
        extra.push(Frame::fd(0x1ABC_0000, true, 0, &[]).unwrap());
        both_ways(&near, &near_seen, &far, &far_seen, &extra).await;
        let wire = near.look(|bus, _| bus.wire_counters()).unwrap();
        assert_eq!((wire.sent, wire.received, wire.lost, wire.unfit), (2006, 2006, 0, 0));
    });
}

#[test]
fn a_bus_behind_socketcand() {
    local(async {
        let (far, far_seen, _) = bus();
        let (address, _server) = serve(&far, Dialect::Socketcand).await;
        let peer = || Box::new(socketcand_client::Client::new("can0"));
        let (near, near_seen, _, status) = behind(Target::Tcp(address.to_string()), peer());
        until("the wire up", || status.borrow().up).await;
        both_ways(&near, &near_seen, &far, &far_seen, &classic_extra()).await;
        // What the protocol cannot carry is dropped and counted, never sent as something else.
        push_all(&near, &[Frame::fd(1, false, 0, &[1]).unwrap()]).await;
        until("the FD frame dropped", || near.look(|bus, _| bus.wire_counters()).unwrap().unfit == 1).await;
        let (_lost, _, said, _) =
            behind(Target::Tcp(address.to_string()), Box::new(socketcand_client::Client::new("can9")));
        let why = "wire0: the server does not open bus 'can9': it says 'error no such bus on this server'";
        until("the wrong bus named", || said.borrow().iter().any(|text| text == why)).await;
    });
}

#[test]
fn an_adapter_pulled_and_plugged_in_again() {
    local(async {
        let dir = std::env::temp_dir().join(format!("dinrail-pty-{}", std::process::id()));
        std::fs::create_dir_all(&dir).unwrap();
        let link = dir.join("adapter");
        let device = Target::Device { path: link.to_str().unwrap().into(), baud: 115_200 };
        let (far, far_seen, _) = bus();
        let (near, near_seen, said, status) = behind(device, slcan_peer(false));
        until("the missing device named", || {
            said.borrow().iter().any(|t| t.starts_with("there is no device"))
        })
        .await;
        for round in 0..3 {
            let server = spawn_local(Pty::new(&link).unwrap().serve(far.clone()));
            until("the wire up", || status.borrow().up).await;
            both_ways(&near, &near_seen, &far, &far_seen, &classic_extra()).await;
            server.abort();
            until("the wire down", || !status.borrow().up).await;
            assert_eq!(status.borrow().downs, round + 1);
        }
        assert!(said.borrow().iter().any(|t| t.contains("the adapter was pulled")), "{:?}", said.borrow());
        assert!(!link.exists(), "the link goes with the terminal");
        std::fs::remove_dir_all(&dir).unwrap();
    });
}

#[test]
fn a_link_replaces_a_link_only() {
    local(async {
        let dir = std::env::temp_dir().join(format!("dinrail-link-{}", std::process::id()));
        std::fs::create_dir_all(&dir).unwrap();
        std::fs::write(dir.join("file"), "precious").unwrap();
        assert!(Pty::new(&dir.join("file")).is_err());
        assert_eq!(std::fs::read_to_string(dir.join("file")).unwrap(), "precious");
        std::os::unix::fs::symlink("nowhere", dir.join("link")).unwrap();
        drop(Pty::new(&dir.join("link")).unwrap());
        std::fs::remove_dir_all(&dir).unwrap();
    });
}

#[test]
fn python_can_by_cannelloni_and_terminal() {
    let Some(python) = python::python() else { return };
    let (output, dropped) = local(async {
        let dir = std::env::temp_dir().join(format!("dinrail-python-{}", std::process::id()));
        std::fs::create_dir_all(&dir).unwrap();
        let link = dir.join("slcan");
        let (hub, _, _) = bus();
        let (cannelloni, _a) = serve(&hub, Dialect::Cannelloni).await;
        let (slcan, _b) = serve(&hub, Dialect::Slcan).await;
        let _c = spawn_local(Pty::new(&link).unwrap().serve(hub.clone()));
        let args =
            [cannelloni.port().to_string(), slcan.port().to_string(), link.to_str().unwrap().to_owned()];
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python_wires.py");
        let peer = std::thread::spawn(move || {
            Command::new(python).arg("-u").arg(script).args(args).output().unwrap()
        });
        while !peer.is_finished() {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
        std::fs::remove_dir_all(&dir).unwrap();
        (peer.join().unwrap(), hub.look(|bus, _| bus.counters().client_drops))
    });
    let (said, errors) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "{said}{errors}");
    let parts = "kinds\nburst cannelloni to cannelloni\nburst cannelloni to terminal\nburst terminal to cannelloni\nterminal reopened\n";
    assert_eq!(said, parts, "{errors}");
    assert_eq!(dropped, 0);
}
