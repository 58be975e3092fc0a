//! The virtual bus with its TCP clients, on a current-thread runtime.
//!
//! One [`Hub`] holds the bus, the feed and the [`Host`] (the rail, or whatever else wants the frames). Every change
//! goes through [`Hub::turn`], which is never interrupted: so there is one true order without a lock. A connection
//! is one task: it reads, gives bytes to the bus, writes what the bus has for it. It stops reading when its queue
//! on the bus is full, so what a client sends is never dropped.

use std::cell::RefCell;
use std::io::{self, ErrorKind};
use std::net::{IpAddr, SocketAddr};
use std::os::fd::OwnedFd;
use std::rc::Rc;
use std::time::Duration;

use ipc_types::event::Level;
use ipc_types::net::{IpFilter, Seldom};
use rustix::time::{Itimerspec, TimerfdClockId, TimerfdFlags, TimerfdTimerFlags, Timespec};
use serde::Serialize;
use tokio::io::Interest;
use tokio::io::unix::AsyncFd;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::Notify;

use crate::feed::Player;
use crate::virtual_bus::{ClientCounters, Dialect, MAX_CLIENTS, Settings, Stopped, Tap, VirtualBus};
use crate::watch;
use crate::wire::port::Port;

/// Bytes read from a client at once: about 600 socketcand frames.
const READ_BYTES: usize = 16 * 1024;
/// How long the last words to a client may take to leave.
const FAREWELL: Duration = Duration::from_secs(1);

/// Who else is told the frames, and what a client did.
pub trait Host: Tap {
    /// A batch of frames is complete: wake the readers.
    fn flush(&mut self);
    /// A client came, left or was refused.
    fn client(&mut self, message: String, refused: bool);
    /// Something happened to the wire behind the bus; `up`: it carries frames.
    fn link(&mut self, level: Level, message: String, up: bool) {
        let _ = (level, message, up);
    }
}

/// A connected client, for the status.
#[derive(Debug, Clone, Serialize)]
pub struct ClientStatus {
    /// Its address.
    pub peer: String,
    /// What it speaks.
    pub protocol: Dialect,
    /// Its counters.
    #[serde(flatten)]
    pub counters: ClientCounters,
}

struct Inner<H> {
    bus: VirtualBus,
    host: H,
    feed: Option<Player>,
    peers: [Option<(String, Dialect)>; MAX_CLIENTS],
    refused: u64,
    alarm_ns: Option<u64>,
}

/// See the module.
pub struct Hub<H: Host> {
    inner: RefCell<Inner<H>>,
    notify: [Notify; MAX_CLIENTS],
    wire: Notify,
    rail_room: Notify,
    alarm: AsyncFd<OwnedFd>,
}

impl<H: Host + 'static> Hub<H> {
    /// A hub with an idle bus. Needs a tokio runtime.
    pub fn new(settings: Settings, host: H, feed: Option<Player>) -> io::Result<Rc<Self>> {
        let timer = rustix::time::timerfd_create(
            TimerfdClockId::Monotonic,
            TimerfdFlags::NONBLOCK | TimerfdFlags::CLOEXEC,
        )?;
        Ok(Rc::new(Self {
            inner: RefCell::new(Inner {
                bus: VirtualBus::new(settings),
                host,
                feed,
                peers: std::array::from_fn(|_| None),
                refused: 0,
                alarm_ns: None,
            }),
            notify: std::array::from_fn(|_| Notify::new()),
            wire: Notify::new(),
            rail_room: Notify::new(),
            alarm: watch::readable(timer)?,
        }))
    }

    /// Does something with the bus, then lets it run, wakes everyone with news and sets the clock.
    pub fn turn<R>(&self, f: impl FnOnce(&mut VirtualBus, &mut H, u64) -> R) -> R {
        let mut inner = self.inner.borrow_mut();
        let inner = &mut *inner;
        let now_ns = ipc_types::clock::mono_ns();
        let before = inner.bus.counters().frames;
        let result = f(&mut inner.bus, &mut inner.host, now_ns);
        let bus = &mut inner.bus;
        bus.take_feed_room_again();
        let feed_ns = inner.feed.as_mut().and_then(|p| p.play(now_ns, |frame| bus.push_feed(frame, now_ns)));
        let bus_ns = bus.run(now_ns, &mut inner.host);
        if bus.counters().frames != before {
            inner.host.flush();
        }
        let mut wake = bus.take_output_ready() | bus.take_room_again();
        while wake != 0 {
            self.notify[wake.trailing_zeros() as usize].notify_one();
            wake &= wake - 1;
        }
        if bus.wire_wants() {
            self.wire.notify_one();
        }
        if bus.take_rail_room_again() {
            self.rail_room.notify_one();
        }
        // Who has another turn anyway finds the room then.
        let room_ns = (bus.take_feed_room_again() && bus_ns.is_none()).then_some(now_ns);
        let next_ns = feed_ns.into_iter().chain(bus_ns).chain(room_ns).min();
        if next_ns != inner.alarm_ns {
            inner.alarm_ns = next_ns;
            self.set_alarm(next_ns);
        }
        result
    }

    fn set_alarm(&self, at_ns: Option<u64>) {
        // Zero stops the clock; a time in the past rings at once.
        let ns = at_ns.map_or(0, |ns| ns.max(1));
        let at = Timespec { tv_sec: (ns / 1_000_000_000) as i64, tv_nsec: (ns % 1_000_000_000) as i64 };
        let once = Itimerspec { it_interval: Timespec { tv_sec: 0, tv_nsec: 0 }, it_value: at };
        if let Err(e) = rustix::time::timerfd_settime(self.alarm.get_ref(), TimerfdTimerFlags::ABSTIME, &once)
        {
            tracing::error!("setting the clock of the bus: {e}");
        }
    }

    /// Waits until the bus wants its next [`Self::turn`] (paced frames, feed). May come once too often, never too late.
    pub async fn alarm(&self) -> io::Result<()> {
        let mut guard = self.alarm.readable().await?;
        // The clock rings once and is set anew, so there is nothing to read from it: a read less per frame of a paced bus.
        guard.clear_ready();
        self.inner.borrow_mut().alarm_ns = None;
        Ok(())
    }

    /// Waits until the wire could have another frame.
    pub async fn wire_wanted(&self) {
        self.wire.notified().await;
    }

    /// Waits until the queue of the rail, which was full, has room.
    pub async fn rail_room(&self) {
        self.rail_room.notified().await;
    }

    /// Looks at bus and host without letting the bus run.
    pub fn look<R>(&self, f: impl FnOnce(&mut VirtualBus, &mut H) -> R) -> R {
        let mut inner = self.inner.borrow_mut();
        let inner = &mut *inner;
        f(&mut inner.bus, &mut inner.host)
    }

    /// The connected clients.
    pub fn clients(&self) -> Vec<ClientStatus> {
        let inner = self.inner.borrow();
        let known = inner.peers.iter().enumerate();
        known
            .filter_map(|(number, peer)| {
                let (peer, protocol) = peer.as_ref()?;
                Some(ClientStatus {
                    peer: peer.clone(),
                    protocol: *protocol,
                    counters: inner.bus.client_counters(number)?,
                })
            })
            .collect()
    }

    /// Connections refused since start.
    pub fn refused(&self) -> u64 {
        self.inner.borrow().refused
    }

    /// Times the feed was played to its end.
    pub fn feed_rounds(&self) -> Option<u64> {
        self.inner.borrow().feed.as_ref().map(Player::rounds)
    }

    /// Accepts clients for ever. Must run inside a `LocalSet`.
    pub async fn serve(
        self: Rc<Self>,
        listener: TcpListener,
        dialect: Dialect,
        filter: Option<IpFilter>,
        max_clients: usize,
    ) {
        let mut seldom = Seldom::default();
        loop {
            match listener.accept().await {
                Ok((stream, peer)) => match self.admit(peer, dialect, filter.as_ref(), max_clients) {
                    Ok(number) => {
                        let hub = self.clone();
                        tokio::task::spawn_local(
                            async move { hub.talk(stream, number, peer, dialect).await },
                        );
                    }
                    Err(why) => {
                        let mut inner = self.inner.borrow_mut();
                        inner.refused += 1;
                        inner.host.client(format!("{peer} was refused: {why}"), true);
                    }
                },
                // Descriptors exhausted or the like: others must go first.
                Err(e) => {
                    if let Some(untold) = seldom.failed(ipc_types::clock::mono_ns()) {
                        tracing::warn!(
                            "accepting {} clients: {e} ({untold} more since last told)",
                            dialect.name()
                        );
                    }
                    tokio::time::sleep(Duration::from_millis(100)).await;
                }
            }
        }
    }

    fn admit(
        &self,
        peer: SocketAddr,
        dialect: Dialect,
        filter: Option<&IpFilter>,
        max_clients: usize,
    ) -> Result<usize, &'static str> {
        if !filter.map_or_else(|| peer.ip().to_canonical().is_loopback(), |f| f.allows(peer.ip())) {
            return Err("its address is outside of the filter");
        }
        {
            let inner = self.inner.borrow();
            let present = inner.peers.iter().flatten().filter(|(_, d)| *d == dialect).count();
            if present >= max_clients {
                return Err("max_clients are connected");
            }
        }
        self.enter(&peer.to_string(), dialect).ok_or("the bus has no room for another client")
    }

    /// A client came.
    pub(crate) fn enter(&self, peer: &str, dialect: Dialect) -> Option<usize> {
        let mut inner = self.inner.borrow_mut();
        let number = inner.bus.connect(dialect)?;
        inner.peers[number] = Some((peer.to_owned(), dialect));
        inner.host.client(format!("{peer} connected ({})", dialect.name()), false);
        Some(number)
    }

    async fn talk(self: Rc<Self>, stream: TcpStream, number: usize, peer: SocketAddr, dialect: Dialect) {
        let end = match prepare(&stream) {
            Ok(()) => self.converse(&Port::Tcp(stream), number).await,
            Err(e) => Err(e),
        };
        self.leave(&peer.to_string(), number, dialect, end);
    }

    /// A client is gone.
    pub(crate) fn leave(&self, peer: &str, number: usize, dialect: Dialect, end: io::Result<()>) {
        let mut inner = self.inner.borrow_mut();
        let counters = inner.bus.disconnect(number);
        inner.peers[number] = None;
        let how = end.err().map(|e| format!(" ({e})")).unwrap_or_default();
        let message = format!(
            "{peer} left ({}){how}: {} frames sent, {} received, {} dropped because it did not read, {} commands refused",
            dialect.name(),
            counters.sent,
            counters.received,
            counters.dropped,
            counters.refused
        );
        inner.host.client(message, false);
    }

    pub(crate) async fn converse(&self, stream: &Port, number: usize) -> io::Result<()> {
        let mut buffer = vec![0u8; READ_BYTES].into_boxed_slice();
        let (mut start, mut end) = (0, 0);
        let mut finished = false;
        loop {
            let mut stopped = None;
            if start < end {
                let taken =
                    self.turn(|bus, host, now_ns| bus.take(number, &buffer[start..end], now_ns, host));
                start += taken.used;
                stopped = taken.stopped;
            }
            let blocked = self.write_out(stream, number)?;
            match stopped {
                Some(Stopped::Turn) => {
                    tokio::task::yield_now().await;
                    continue;
                }
                Some(Stopped::WriteFirst) if !blocked => {
                    // An answer is a call to the system: thousands of questions in one segment must wait their turn.
                    tokio::task::yield_now().await;
                    continue;
                }
                Some(Stopped::Close) => return self.farewell(stream, number).await,
                None if finished => return self.farewell(stream, number).await,
                _ => {}
            }
            let wants_read = start == end && !finished;
            let interest = match (wants_read, blocked) {
                (true, true) => Some(Interest::READABLE | Interest::WRITABLE),
                (true, false) => Some(Interest::READABLE),
                (false, true) => Some(Interest::WRITABLE),
                (false, false) => None,
            };
            let hold_ns = self.inner.borrow().bus.held_until(number);
            tokio::select! {
                ready = stream.ready(interest.unwrap_or(Interest::READABLE)), if interest.is_some() => {
                    if ready? && wants_read {
                        match stream.try_read(&mut buffer) {
                            Ok(0) => finished = true,
                            Ok(n) => (start, end) = (0, n),
                            Err(e) if e.kind() == ErrorKind::WouldBlock => {}
                            Err(e) => return Err(e),
                        }
                    }
                }
                () = self.notify[number].notified() => {}
                () = sleep_until(hold_ns), if hold_ns.is_some() => {}
            }
        }
    }

    /// Writes what the bus has for the client; true when its socket takes no more now.
    fn write_out(&self, stream: &Port, number: usize) -> io::Result<bool> {
        let mut inner = self.inner.borrow_mut();
        let now_ns = ipc_types::clock::mono_ns();
        loop {
            let bytes = inner.bus.output(number, now_ns);
            if bytes.is_empty() {
                return Ok(false);
            }
            match stream.try_write(bytes) {
                Ok(0) => return Err(ErrorKind::WriteZero.into()),
                Ok(n) => inner.bus.written(number, n),
                Err(e) if e.kind() == ErrorKind::WouldBlock => return Ok(true),
                Err(e) => return Err(e),
            }
        }
    }

    /// Gives the last words a moment to leave.
    async fn farewell(&self, stream: &Port, number: usize) -> io::Result<()> {
        let words = async {
            while self.write_out(stream, number)? {
                stream.ready(Interest::WRITABLE).await?;
            }
            Ok(())
        };
        tokio::time::timeout(FAREWELL, words).await.unwrap_or(Ok(()))
    }
}

/// How long a peer may leave what it was sent without acknowledgement, or its window closed.
const UNANSWERED_MS: u32 = 60_000;

/// Latency before packing; and a peer that vanished without a word frees its place within a minute or so, whether something
/// is on its way to it (then the system does not probe, and would go on for a quarter of an hour) or not.
pub fn prepare(stream: &TcpStream) -> io::Result<()> {
    use rustix::net::sockopt;
    stream.set_nodelay(true)?;
    sockopt::set_socket_keepalive(stream, true)?;
    sockopt::set_tcp_keepidle(stream, Duration::from_secs(30))?;
    sockopt::set_tcp_keepintvl(stream, Duration::from_secs(10))?;
    sockopt::set_tcp_keepcnt(stream, 3)?;
    sockopt::set_tcp_user_timeout(stream, UNANSWERED_MS)?;
    Ok(())
}

pub(crate) async fn sleep_until(at_ns: Option<u64>) {
    let now_ns = ipc_types::clock::mono_ns();
    let wait_ns = at_ns.map_or(0, |at_ns| at_ns.saturating_sub(now_ns));
    tokio::time::sleep(Duration::from_nanos(wait_ns)).await;
}

/// A listener on `address` that this process opens itself (tests and examples; services inherit theirs).
pub async fn listen(ip: IpAddr, port: u16) -> io::Result<TcpListener> {
    TcpListener::bind((ip, port)).await
}
