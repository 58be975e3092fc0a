//! The masters: who is let in, what they ask, and the answers that their sockets did not take yet.

use super::config::Config;
use super::core::Core;
use crate::admission::Admission;
use crate::protocol::mbap::{self, MAX_RECEIVED, Scan};
use crate::visits::{Visits, leaving_is_told, untold_words};
use ipc_types::clock;
use ipc_types::event::Level;
use ipc_types::net::Seldom;
use std::cell::{Cell, RefCell};
use std::io;
use std::net::SocketAddr;
use std::rc::Rc;
use std::time::Duration;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::Notify;

/// A master that does not take its answers for so long is cut off.
const WRITE_LIMIT: Duration = Duration::from_secs(5);
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);
/// Bytes of a connection's buffers: 16 requests and their answers.
const BUFFER: usize = 16 * MAX_RECEIVED;

pub(super) struct Client {
    pub(super) id: u64,
    pub(super) peer: SocketAddr,
    pub(super) since_ns: u64,
    pub(super) stream: TcpStream,
    /// Answers that the socket did not take yet.
    pub(super) pending: RefCell<Vec<u8>>,
    /// Rung when there are such, or the connection is to be closed.
    pub(super) wake: Notify,
    pub(super) closing: Cell<bool>,
    pub(super) requests: Cell<u64>,
    pub(super) last_ns: Cell<u64>,
}

impl Client {
    /// Writes now what the socket takes; the rest waits for the connection's task.
    pub(super) fn answer(&self, transaction: u16, unit: u8, pdu: &[u8]) {
        let mut frame = [0; mbap::MAX_ADU];
        let Some(len) = mbap::encode(transaction, unit, pdu, &mut frame) else { return };
        let mut pending = self.pending.borrow_mut();
        let mut done = 0;
        if pending.is_empty() {
            done = self.stream.try_write(&frame[..len]).unwrap_or(0);
        }
        if done < len {
            pending.extend_from_slice(&frame[done..len]);
            self.wake.notify_one();
        }
    }
}

pub(super) struct Shared {
    pub(super) core: RefCell<Core>,
    pub(super) clients: RefCell<Vec<Rc<Client>>>,
    /// Something was queued for a line.
    pub(super) queued: Notify,
    pub(super) config: Config,
    pub(super) admission: Admission,
    pub(super) next_client: Cell<u64>,
    pub(super) accepted: Cell<u64>,
    pub(super) refused: Cell<u64>,
    visits: RefCell<Visits>,
    pub(super) events: RefCell<Vec<(Level, String)>>,
}

/// Events kept from one beat to the next.
const MAX_EVENTS: usize = 8;

impl Shared {
    /// Nobody is connected.
    pub(super) fn new(core: Core, config: Config) -> Rc<Self> {
        Rc::new(Self {
            core: RefCell::new(core),
            clients: RefCell::new(Vec::new()),
            queued: Notify::new(),
            admission: Admission::new(config.tcp.filter.as_ref()),
            config,
            next_client: Cell::new(1),
            accepted: Cell::new(0),
            refused: Cell::new(0),
            visits: RefCell::default(),
            events: RefCell::new(Vec::new()),
        })
    }

    fn event(&self, level: Level, message: String) {
        let mut events = self.events.borrow_mut();
        if events.len() < MAX_EVENTS {
            events.push((level, message));
        }
    }

    /// Accepts masters for ever. A failing accept (descriptors, memory) never ends it.
    pub(super) async fn accept(self: Rc<Self>, listener: TcpListener) {
        let mut seldom = Seldom::default();
        loop {
            match listener.accept().await {
                Ok((stream, peer)) => self.admit(stream, peer),
                Err(error) => {
                    if let Some(untold) = seldom.failed(clock::mono_ns()) {
                        tracing::warn!(%error, untold, "accepting a Modbus connection failed; told every 10 s");
                    }
                    tokio::time::sleep(ACCEPT_PAUSE).await;
                }
            }
        }
    }

    fn admit(self: &Rc<Self>, stream: TcpStream, peer: SocketAddr) {
        let refuse = |why: &str| {
            self.refused.set(self.refused.get() + 1);
            self.event(Level::Warning, format!("Modbus master {peer} refused: {why}"));
        };
        if !self.admission.allows(peer.ip()) {
            return refuse("its address is outside tcp.filter");
        }
        if self.clients.borrow().len() >= self.config.tcp.max_connections as usize && !self.make_room() {
            return refuse("tcp.max_connections are in use");
        }
        // Without it Nagle's algorithm and delayed acknowledgement cost 40 ms a round.
        if stream.set_nodelay(true).is_err() {
            return;
        }
        self.accepted.set(self.accepted.get() + 1);
        let id = self.next_client.get();
        self.next_client.set(id + 1);
        let now_ns = clock::mono_ns();
        let client = Rc::new(Client {
            id,
            peer,
            since_ns: now_ns,
            stream,
            pending: RefCell::new(Vec::new()),
            wake: Notify::new(),
            closing: Cell::new(false),
            requests: Cell::new(0),
            last_ns: Cell::new(now_ns),
        });
        let arrival = self.visits.borrow_mut().arrives(peer.ip(), now_ns);
        match arrival {
            Some(n) => self.event(Level::Info, format!("Modbus master {peer} connected{}", untold_words(n))),
            None => tracing::debug!("Modbus master {peer} connected"),
        }
        self.clients.borrow_mut().push(client.clone());
        let shared = self.clone();
        tokio::task::spawn_local(async move {
            shared.serve(&client).await;
            shared.clients.borrow_mut().retain(|other| !Rc::ptr_eq(other, &client));
            shared.core.borrow_mut().client_gone(client.id);
            let left = format!("Modbus master {peer} left after {} requests", client.requests.get());
            if leaving_is_told(arrival, clock::mono_ns().saturating_sub(client.since_ns)) {
                shared.event(Level::Info, left);
            } else {
                tracing::debug!("{left}");
            }
        });
    }

    /// Closes the connection idle for longest, if the configuration wants it and it is idle for a second.
    fn make_room(&self) -> bool {
        if self.config.tcp.when_full != crate::tcp::WhenFull::CloseOldestIdle {
            return false;
        }
        let mut clients = self.clients.borrow_mut();
        let oldest = clients.iter().enumerate().min_by_key(|(_, client)| client.last_ns.get());
        let Some((index, client)) = oldest else { return false };
        if clock::mono_ns().saturating_sub(client.last_ns.get()) < 1_000_000_000 {
            return false;
        }
        client.closing.set(true);
        client.wake.notify_one();
        clients.remove(index);
        true
    }

    async fn serve(&self, client: &Client) {
        let mut buffer = vec![0; BUFFER];
        let mut filled = 0;
        loop {
            tokio::select! {
                biased;
                () = client.wake.notified() => {
                    if client.closing.get() || flush(client).await.is_err() {
                        return;
                    }
                    continue;
                }
                ready = client.stream.readable() => {
                    if ready.is_err() {
                        return;
                    }
                }
            }
            match client.stream.try_read(&mut buffer[filled..]) {
                Ok(0) => return,
                Ok(n) => filled += n,
                Err(e) if matches!(e.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::Interrupted) => {
                    continue;
                }
                Err(_) => return,
            }
            let Some(used) = self.requests(client, &buffer[..filled]) else { return };
            buffer.copy_within(used..filled, 0);
            filled -= used;
            if !client.pending.borrow().is_empty() && flush(client).await.is_err() {
                return;
            }
        }
    }

    /// Handles the frames of a buffer; bytes used, or `None`: the stream makes no sense any more.
    fn requests(&self, client: &Client, bytes: &[u8]) -> Option<usize> {
        let mut used = 0;
        let mut any = false;
        let now_ns = clock::mono_ns();
        client.last_ns.set(now_ns);
        let end = loop {
            match mbap::scan(&bytes[used..]) {
                Scan::Incomplete => break Some(used),
                Scan::BadLength { .. } => break None,
                Scan::Foreign { used: n } => used += n,
                Scan::Frame { frame, used: n } => {
                    used += n;
                    client.requests.set(client.requests.get() + 1);
                    let mut core = self.core.borrow_mut();
                    match core.request(client.id, frame.transaction, frame.unit, frame.pdu, now_ns) {
                        Some(pdu) => {
                            // Collected, so that several answers leave in one segment.
                            let mut out = [0; mbap::MAX_ADU];
                            if let Some(len) = mbap::encode(frame.transaction, frame.unit, pdu, &mut out) {
                                client.pending.borrow_mut().extend_from_slice(&out[..len]);
                            }
                        }
                        None => any = true,
                    }
                }
            }
        };
        if any {
            self.queued.notify_one();
        }
        end
    }
}

/// Writes what waits for a client.
async fn flush(client: &Client) -> io::Result<()> {
    loop {
        {
            let mut pending = client.pending.borrow_mut();
            if pending.is_empty() {
                return Ok(());
            }
            match client.stream.try_write(&pending) {
                Ok(n) => {
                    pending.drain(..n);
                    continue;
                }
                Err(e) if e.kind() == io::ErrorKind::WouldBlock => {}
                Err(e) if e.kind() == io::ErrorKind::Interrupted => continue,
                Err(e) => return Err(e),
            }
        }
        tokio::time::timeout(WRITE_LIMIT, client.stream.writable())
            .await
            .map_err(|_| io::Error::from(io::ErrorKind::TimedOut))??;
    }
}
