//! Modbus TCP connections on a current-thread tokio runtime.
//!
//! A [`Hub`] holds what all connections of a listener share: the image, the device, the rules of admission, the list
//! of clients, the counters. Every connection is one local task that reads, lets its [`Session`] answer, and writes once. No
//! task holds the image across an await, so one request is always served from one state of it.

use crate::admission::Admission;
use crate::device::Device;
use crate::rights::Peer;
use crate::server::Image;
use crate::session::{Framing, MAX_EXCEPTION, Next, Session, SessionCounts};
use crate::visits::{Visits, leaving_is_told, untold_words};
use ipc_types::clock;
use ipc_types::net::Seldom;
use serde::{Deserialize, Serialize};
use std::cell::{Cell, RefCell};
use std::fmt;
use std::io;
use std::net::{IpAddr, SocketAddr};
use std::rc::Rc;
use std::time::{Duration, Instant};
use tokio::io::AsyncReadExt;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::Notify;

/// A peer that does not take its answers is dropped after this time, also if it takes a part of them now and then.
const WRITE_TIMEOUT: Duration = Duration::from_secs(5);
/// A client whose last request came within this time after the answer before it gets [`EAGER_SPIN`].
const EAGER_GAP: Duration = Duration::from_micros(50);
/// How long the next request of such a client is awaited before the process sleeps. Bounds what it costs the others.
const EAGER_SPIN: Duration = Duration::from_micros(20);
/// Reads of such a client in a row until everything else has its turn: one that never pauses must not stop the service.
const EAGER_TURNS: u32 = 64;
/// A peer that vanished without a word is noticed after a minute: silence, then so many questions, each so long apart.
const KEEP_ALIVE: (Duration, u32, Duration) = (Duration::from_secs(30), 3, Duration::from_secs(10));
/// Pause after an accept that failed for want of descriptors or memory.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);
/// RTU over TCP: a frame that was begun and does not go on for so long is noise. Longer than a lost segment takes to
/// come again.
const FRAME_TIMEOUT: Duration = Duration::from_millis(500);
/// Happenings kept between two calls of [`Hub::take_happenings`]; a flood of connections must not flood the rail.
const MAX_HAPPENINGS: usize = 8;

/// The image as the hub uses it.
pub trait Backend: Image {
    /// Called before each batch of requests: take the newest state of the image.
    fn begin(&mut self);
}

/// What happens to a connection when all places are taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum WhenFull {
    /// The new connection is closed.
    Refuse,
    /// The connection that has been without a request for longest, at least [`Options::min_idle`], makes room;
    /// without such a one the new connection is closed.
    #[default]
    CloseOldestIdle,
}

/// Rules of admission.
#[derive(Clone, Debug)]
pub struct Options {
    pub max_connections: usize,
    pub filter: Admission,
    pub framing: Framing,
    /// A connection without a request for this long is closed; `None` = never.
    pub idle_timeout: Option<Duration>,
    pub when_full: WhenFull,
    /// How long a connection must have been idle to be closed for another one.
    pub min_idle: Duration,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            max_connections: 8,
            filter: Admission::default(),
            framing: Framing::Tcp,
            idle_timeout: Some(Duration::from_mins(1)),
            when_full: WhenFull::default(),
            min_idle: Duration::from_secs(1),
        }
    }
}

/// Why a connection ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum CloseReason {
    /// The peer closed it.
    Peer,
    /// Reading or writing failed.
    Error,
    /// The length field of a header was impossible.
    BadLength,
    /// No request for [`Options::idle_timeout`].
    Idle,
    /// It made room for another one.
    Replaced,
    /// The peer did not take its answers.
    NotReading,
    /// The server was switched off.
    Disabled,
}

/// Counters since the service started.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Counters {
    pub accepted: u64,
    /// Closed before a byte was read: not in the filter's range.
    pub refused_filter: u64,
    /// Closed before a byte was read: all places taken.
    pub refused_full: u64,
    /// Closed before a byte was read: server switched off.
    pub refused_disabled: u64,
    /// `accept` failed.
    pub accept_errors: u64,
    pub requests: u64,
    pub exceptions: u64,
    /// By exception code, index 0 unused.
    pub by_exception: [u64; MAX_EXCEPTION + 1],
    /// Frames of another protocol, and of other units on RTU over TCP, dropped without an answer.
    pub foreign: u64,
    /// Requests without an answer: broadcasts on RTU over TCP, listen-only mode.
    pub silent: u64,
    /// RTU over TCP: bytes that belonged to no frame.
    pub noise: u64,
    pub closed_peer: u64,
    pub closed_error: u64,
    pub closed_bad_length: u64,
    pub closed_idle: u64,
    pub closed_replaced: u64,
    pub closed_not_reading: u64,
    pub closed_disabled: u64,
}

impl Counters {
    fn closed(&mut self, reason: CloseReason) {
        *match reason {
            CloseReason::Peer => &mut self.closed_peer,
            CloseReason::Error => &mut self.closed_error,
            CloseReason::BadLength => &mut self.closed_bad_length,
            CloseReason::Idle => &mut self.closed_idle,
            CloseReason::Replaced => &mut self.closed_replaced,
            CloseReason::NotReading => &mut self.closed_not_reading,
            CloseReason::Disabled => &mut self.closed_disabled,
        } += 1;
    }

    fn add(&mut self, before: &SessionCounts, after: &SessionCounts) {
        self.requests += after.requests - before.requests;
        self.exceptions += after.exceptions - before.exceptions;
        self.foreign += after.foreign - before.foreign;
        self.silent += after.silent - before.silent;
        self.noise += after.noise - before.noise;
        for ((sum, old), new) in self.by_exception.iter_mut().zip(before.by_exception).zip(after.by_exception)
        {
            *sum += new - old;
        }
    }
}

/// One connected client, as shown in the status.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct ClientInfo {
    pub address: IpAddr,
    pub port: u16,
    /// Seconds since it connected.
    pub connected_s: u64,
    /// Seconds since its last request (since it connected if there was none).
    pub idle_s: u64,
    pub requests: u64,
    pub exceptions: u64,
    pub last_unit: u8,
    /// Function code of its last request, 0 before the first.
    pub last_function: u8,
}

/// Something about a client that the rail is told.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Happening {
    /// `untold`: connections of the same address before it that were not told.
    Connected {
        peer: SocketAddr,
        untold: u32,
    },
    Refused {
        peer: SocketAddr,
        why: Refusal,
    },
    Left {
        peer: SocketAddr,
        why: CloseReason,
        requests: u64,
        exceptions: u64,
    },
}

/// Why a connection was closed before a byte was read.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Refusal {
    Filter,
    Full,
    Disabled,
}

impl fmt::Display for Happening {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Connected { peer, untold } => {
                write!(f, "Modbus client {peer} connected{}", untold_words(*untold))
            }
            Self::Refused { peer, why: Refusal::Filter } => {
                write!(f, "Modbus client {peer} refused: the filter does not admit its address")
            }
            Self::Refused { peer, why: Refusal::Full } => {
                write!(f, "Modbus client {peer} refused: max_connections are in use")
            }
            Self::Refused { peer, why: Refusal::Disabled } => {
                write!(f, "Modbus client {peer} refused: the server is switched off")
            }
            Self::Left { peer, why, requests, exceptions } => {
                let why = match why {
                    CloseReason::Peer => "it closed the connection",
                    CloseReason::Error => "the connection broke",
                    CloseReason::BadLength => "it sent a header with an impossible length",
                    CloseReason::Idle => "it was idle for idle_timeout",
                    CloseReason::Replaced => "it was idle and made room for another client",
                    CloseReason::NotReading => "it did not take its answers",
                    CloseReason::Disabled => "the server was switched off",
                };
                write!(f, "Modbus client {peer} left: {why}; {requests} requests, {exceptions} exceptions")
            }
        }
    }
}

struct Client {
    peer: SocketAddr,
    since: Instant,
    last_request: Cell<Instant>,
    counts: Cell<SessionCounts>,
    closing: Cell<Option<CloseReason>>,
    wake: Notify,
}

impl Client {
    fn close(&self, reason: CloseReason) {
        if self.closing.get().is_none() {
            self.closing.set(Some(reason));
        }
        self.wake.notify_one();
    }
}

/// What all connections of a server share.
pub struct Hub<B> {
    backend: Rc<RefCell<B>>,
    device: RefCell<Device>,
    options: Options,
    enabled: Cell<bool>,
    clients: RefCell<Vec<Rc<Client>>>,
    counters: Cell<Counters>,
    visits: RefCell<Visits>,
    happenings: RefCell<Vec<Happening>>,
    happenings_left_out: Cell<u64>,
}

impl<B: Backend + 'static> Hub<B> {
    /// A hub without connections, enabled. Several may share an image.
    pub fn new(backend: Rc<RefCell<B>>, device: Device, options: Options) -> Rc<Self> {
        Rc::new(Self {
            backend,
            device: RefCell::new(device),
            options,
            enabled: Cell::new(true),
            clients: RefCell::new(Vec::new()),
            counters: Cell::new(Counters::default()),
            visits: RefCell::default(),
            happenings: RefCell::new(Vec::with_capacity(MAX_HAPPENINGS)),
            happenings_left_out: Cell::new(0),
        })
    }

    /// Lends the image to the caller, who must not hold it across an await.
    pub fn with_backend<R>(&self, use_it: impl FnOnce(&mut B) -> R) -> R {
        use_it(&mut self.backend.borrow_mut())
    }

    /// Counters of all connections, gone ones included.
    pub fn counters(&self) -> Counters {
        self.counters.get()
    }

    /// Whether connections are accepted.
    pub fn is_enabled(&self) -> bool {
        self.enabled.get()
    }

    /// Switches the server on or off. Off closes every connection and refuses new ones.
    pub fn set_enabled(&self, enabled: bool) {
        self.enabled.set(enabled);
        if !enabled {
            for client in self.clients.borrow().iter() {
                client.close(CloseReason::Disabled);
            }
        }
    }

    /// What happened to clients since the last call, at most 8, and how much more happened.
    pub fn take_happenings(&self) -> (Vec<Happening>, u64) {
        (self.happenings.borrow_mut().drain(..).collect(), self.happenings_left_out.take())
    }

    fn happened(&self, happening: Happening) {
        let mut happenings = self.happenings.borrow_mut();
        if happenings.len() < MAX_HAPPENINGS {
            happenings.push(happening);
        } else {
            self.happenings_left_out.set(self.happenings_left_out.get() + 1);
        }
    }

    /// Addresses of the clients connected now, oldest first.
    pub fn for_each_peer(&self, mut each: impl FnMut(SocketAddr)) {
        self.clients.borrow().iter().for_each(|client| each(client.peer));
    }

    /// The clients connected now, oldest first.
    pub fn clients(&self) -> Vec<ClientInfo> {
        let now = Instant::now();
        self.clients
            .borrow()
            .iter()
            .map(|client| {
                let counts = client.counts.get();
                ClientInfo {
                    address: client.peer.ip().to_canonical(),
                    port: client.peer.port(),
                    connected_s: now.saturating_duration_since(client.since).as_secs(),
                    idle_s: now.saturating_duration_since(client.last_request.get()).as_secs(),
                    requests: counts.requests,
                    exceptions: counts.exceptions,
                    last_unit: counts.last_unit,
                    last_function: counts.last_function,
                }
            })
            .collect()
    }

    /// Closes connections that were idle for too long. Call it about every second.
    pub fn sweep(&self) {
        let Some(limit) = self.options.idle_timeout else { return };
        let now = Instant::now();
        for client in self.clients.borrow().iter() {
            if now.saturating_duration_since(client.last_request.get()) >= limit {
                client.close(CloseReason::Idle);
            }
        }
    }

    /// Accepts connections for ever. A failing accept (descriptors, memory) never ends it.
    pub async fn accept(self: Rc<Self>, listener: TcpListener) {
        let mut seldom = Seldom::default();
        loop {
            match listener.accept().await {
                Ok((stream, peer)) => self.admit(stream, peer),
                Err(error) => {
                    self.update(|counters| counters.accept_errors += 1);
                    if !matches!(
                        error.kind(),
                        io::ErrorKind::ConnectionAborted
                            | io::ErrorKind::ConnectionReset
                            | io::ErrorKind::Interrupted
                    ) {
                        if let Some(untold) = seldom.failed(clock::mono_ns()) {
                            tracing::warn!(
                                %error,
                                untold,
                                "accepting a Modbus connection failed; trying again every 100 ms; told every 10 s"
                            );
                        }
                        tokio::time::sleep(ACCEPT_PAUSE).await;
                    }
                }
            }
        }
    }

    fn update(&self, change: impl FnOnce(&mut Counters)) {
        let mut counters = self.counters.get();
        change(&mut counters);
        self.counters.set(counters);
    }

    /// Takes a connection in or closes it. Nothing is read from a connection that is refused.
    fn admit(self: &Rc<Self>, stream: TcpStream, peer: SocketAddr) {
        if !self.enabled.get() {
            self.update(|counters| counters.refused_disabled += 1);
            return self.happened(Happening::Refused { peer, why: Refusal::Disabled });
        }
        if !self.options.filter.allows(peer.ip()) {
            self.update(|counters| counters.refused_filter += 1);
            return self.happened(Happening::Refused { peer, why: Refusal::Filter });
        }
        if self.clients.borrow().len() >= self.options.max_connections && !self.make_room() {
            self.update(|counters| counters.refused_full += 1);
            return self.happened(Happening::Refused { peer, why: Refusal::Full });
        }
        // Without it Nagle's algorithm and delayed acknowledgement cost 40 ms a round.
        if stream.set_nodelay(true).is_err() {
            self.update(|counters| counters.closed(CloseReason::Error));
            return;
        }
        keep_alive(&stream);
        self.update(|counters| counters.accepted += 1);
        let arrival = self.visits.borrow_mut().arrives(peer.ip(), clock::mono_ns());
        match arrival {
            Some(untold) => self.happened(Happening::Connected { peer, untold }),
            None => tracing::debug!("Modbus client {peer} connected"),
        }
        let now = Instant::now();
        let client = Rc::new(Client {
            peer,
            since: now,
            last_request: Cell::new(now),
            counts: Cell::new(SessionCounts::default()),
            closing: Cell::new(None),
            wake: Notify::new(),
        });
        self.clients.borrow_mut().push(Rc::clone(&client));
        let hub = Rc::clone(self);
        tokio::task::spawn_local(async move {
            let reason = hub.serve(stream, &client).await;
            hub.clients.borrow_mut().retain(|other| !Rc::ptr_eq(other, &client));
            hub.update(|counters| counters.closed(reason));
            let SessionCounts { requests, exceptions, .. } = client.counts.get();
            let left = Happening::Left { peer, why: reason, requests, exceptions };
            let lasted_ns = client.since.elapsed().as_nanos() as u64;
            if leaving_is_told(arrival, lasted_ns) {
                hub.happened(left);
            } else {
                tracing::debug!("{left}");
            }
        });
    }

    /// Closes the connection idle for longest, if the options want it and it is idle enough.
    fn make_room(&self) -> bool {
        if self.options.when_full != WhenFull::CloseOldestIdle {
            return false;
        }
        let mut clients = self.clients.borrow_mut();
        let oldest = clients.iter().enumerate().min_by_key(|(_, client)| client.last_request.get());
        let Some((index, client)) = oldest else { return false };
        if client.last_request.get().elapsed() < self.options.min_idle {
            return false;
        }
        client.close(CloseReason::Replaced);
        clients.remove(index);
        true
    }

    async fn serve(&self, mut stream: TcpStream, client: &Client) -> CloseReason {
        let mut session = Session::new(self.options.framing);
        let (mut eager, mut turns) = (false, 0);
        loop {
            let waiting = session.is_waiting();
            turns += 1;
            if turns == EAGER_TURNS {
                tokio::task::yield_now().await;
                turns = 0;
            }
            let begin = Instant::now();
            // One client alone that asks again within microseconds: sleeping would cost it more than the wait does.
            let early = if eager && self.clients.borrow().len() == 1 {
                early(&stream, session.space())
            } else {
                None
            };
            let read = match early {
                Some(read) => Some(read),
                None => tokio::select! {
                    biased;
                    () = client.wake.notified() => return client.closing.get().unwrap_or(CloseReason::Disabled),
                    read = stream.read(session.space()) => Some(read),
                    () = tokio::time::sleep(FRAME_TIMEOUT), if waiting => None,
                },
            };
            eager = begin.elapsed() < EAGER_GAP;
            match read {
                None => session.silence(),
                Some(read) => match read {
                    Ok(0) => return CloseReason::Peer,
                    Ok(n) => session.received(n),
                    Err(error) if error.kind() == io::ErrorKind::Interrupted => continue,
                    Err(_) => return CloseReason::Error,
                },
            }
            loop {
                let next = self.process(&mut session, client);
                if let Err(reason) = send(&stream, &mut session, client).await {
                    return reason;
                }
                match next {
                    Next::Read => break,
                    Next::Again => tokio::task::yield_now().await,
                    Next::BadLength(length) => {
                        tracing::debug!(peer = %client.peer, length, "impossible length in a Modbus header, closing");
                        return CloseReason::BadLength;
                    }
                }
                if let Some(reason) = client.closing.get() {
                    return reason;
                }
            }
        }
    }

    fn process(&self, session: &mut Session, client: &Client) -> Next {
        let before = *session.counts();
        let next = {
            let mut backend = self.backend.borrow_mut();
            backend.begin();
            session.process(&mut self.device.borrow_mut(), &Peer::Ip(client.peer.ip()), &mut *backend)
        };
        let after = session.counts();
        if after.requests != before.requests {
            client.last_request.set(Instant::now());
        }
        client.counts.set(*after);
        self.update(|counters| counters.add(&before, after));
        next
    }
}

/// What comes within [`EAGER_SPIN`], without sleeping; `None` when nothing does.
fn early(stream: &TcpStream, space: &mut [u8]) -> Option<io::Result<usize>> {
    let begin = Instant::now();
    while begin.elapsed() < EAGER_SPIN {
        match rustix::net::recv(stream, &mut *space, rustix::net::RecvFlags::DONTWAIT) {
            Ok((n, _)) => return Some(Ok(n)),
            Err(rustix::io::Errno::AGAIN) => std::hint::spin_loop(),
            Err(error) => return Some(Err(error.into())),
        }
    }
    None
}

/// Has the system ask whether an idle peer is still there: one that lost its power sends no end. Where that is not
/// possible `idle_timeout` remains.
fn keep_alive(stream: &TcpStream) {
    use rustix::net::sockopt::{set_socket_keepalive, set_tcp_keepcnt, set_tcp_keepidle, set_tcp_keepintvl};
    let (idle, count, interval) = KEEP_ALIVE;
    let asked = set_socket_keepalive(stream, true)
        .and_then(|()| set_tcp_keepidle(stream, idle))
        .and_then(|()| set_tcp_keepintvl(stream, interval))
        .and_then(|()| set_tcp_keepcnt(stream, count));
    if let Err(error) = asked {
        tracing::debug!(%error, "a Modbus connection cannot be watched for a peer that vanishes");
    }
}

/// Writes the whole output: one system call unless the socket's buffer is full.
async fn send(stream: &TcpStream, session: &mut Session, client: &Client) -> Result<(), CloseReason> {
    let mut end = None;
    while !session.output().is_empty() {
        match stream.try_write(session.output()) {
            Ok(n) => session.sent(n),
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => {
                let end = *end.get_or_insert_with(|| tokio::time::Instant::now() + WRITE_TIMEOUT);
                let writable = tokio::select! {
                    biased;
                    () = client.wake.notified() => {
                        return Err(client.closing.get().unwrap_or(CloseReason::Disabled));
                    }
                    writable = tokio::time::timeout_at(end, stream.writable()) => writable,
                };
                match writable {
                    Ok(Ok(())) => {}
                    Ok(Err(_)) => return Err(CloseReason::Error),
                    Err(_) => return Err(CloseReason::NotReading),
                }
            }
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(_) => return Err(CloseReason::Error),
        }
    }
    Ok(())
}

#[cfg(test)]
#[path = "tcp_tests.rs"]
mod tests;
