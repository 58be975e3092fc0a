//! Backend `socketcan`: a network interface of the kernel.
//!
//! One raw socket, all frames, error frames too. Own frames are known by the kernel's echo, so that they stand in `rx` at
//! their true place; at most [`FLIGHT`] of them are in the kernel at once. The socket survives `ip link set down`; it is
//! opened anew when the interface itself was gone.

use std::io;
use std::os::fd::{AsFd, OwnedFd};
use std::time::Duration;

use ipc_types::clock;
use ipc_types::event::Level;
use ipc_types::net::Seldom;
use socketcan::{CanFdSocket, Socket, SocketOptions};
use tokio::io::unix::AsyncFd;
use tokio::time::Instant;

use super::filter::Filter;
use super::netlink::{self, Interface, LinkError, Wanted};
use super::{BackOff, Line, NO_ACK_NS};
use crate::protocol::Frame;
use crate::protocol::error_frame::{ControllerState, ErrorFrame};
use crate::server::Host;
use crate::sys::{self, Batch, Received};
use crate::watch;

/// Frames in the kernel's queue at once: enough to keep the bus busy, few enough for arbitration to be ours.
pub const FLIGHT: usize = 3;
/// Pause before a full queue of the kernel is tried again.
const BUSY: Duration = Duration::from_millis(1);
/// How often an interface that is down is looked at.
const DOWN_LOOK: Duration = Duration::from_millis(50);
/// Batches read before other work has its turn.
const TURN_BATCHES: usize = 16;
/// How often the counters are read.
const LOOK: Duration = Duration::from_secs(1);
/// Longest pause before a restart after bus-off.
const MAX_RESTART: Duration = Duration::from_secs(5);

/// Settings of the backend.
#[derive(Debug, Clone)]
pub struct Settings {
    /// The interface.
    pub wanted: Wanted,
    /// Receive buffer of the socket in bytes.
    pub rx_buffer: usize,
    /// Which frames the kernel hands over; empty: all.
    pub filters: Vec<Filter>,
}

/// Works for ever. Must run inside a `LocalSet`; the bus must have its wire attached.
pub async fn drive<H: Host + 'static>(line: Line<H>, settings: Settings) {
    let mut back_off = BackOff::default();
    let mut opened = None;
    loop {
        match open(&line, &settings, &mut opened) {
            Ok((socket, interface)) => {
                back_off = BackOff::default();
                let mut wire = Wire::new(&line, &settings, socket, interface);
                wire.run().await;
            }
            Err(e) => line.down(e.to_string()),
        }
        back_off.wait().await;
    }
}

/// `opened`: number of the interface that was prepared last. It is prepared once, so that an operator's
/// `ip link set down` is not undone.
fn open<H: Host + 'static>(
    line: &Line<H>,
    settings: &Settings,
    opened: &mut Option<u32>,
) -> Result<(AsyncFd<OwnedFd>, Interface), LinkError> {
    let name = &settings.wanted.name;
    let mut interface = netlink::look(name)?;
    if *opened != Some(interface.index) {
        match netlink::prepare(&settings.wanted) {
            Ok((prepared, note)) => {
                interface = prepared;
                *opened = Some(interface.index);
                if let Some(note) = note {
                    line.say(Level::Info, note);
                }
            }
            // The socket can be opened all the same; it works when somebody raises the interface.
            Err(e @ LinkError::Down { .. }) => {
                *opened = Some(interface.index);
                line.down(e.to_string());
            }
            Err(e) => return Err(e),
        }
    }
    let socket = socket(settings).map_err(|source| match source.raw_os_error() {
        Some(libc::EAFNOSUPPORT | libc::EPROTONOSUPPORT) => LinkError::NoCan,
        Some(libc::ENODEV) if netlink::look(name).is_ok() => LinkError::NotCan(name.clone()),
        Some(libc::ENODEV) => LinkError::Absent { name: name.clone(), known: netlink::known() },
        _ => LinkError::System { name: name.clone(), what: "opening a CAN socket", source },
    })?;
    Ok((socket, interface))
}

fn socket(settings: &Settings) -> io::Result<AsyncFd<OwnedFd>> {
    const ALL_ERRORS: u32 = 0x1FFF_FFFF;
    let socket = CanFdSocket::open(&settings.wanted.name)?;
    socket.set_nonblocking(true)?;
    if !settings.filters.is_empty() {
        let raw: Vec<_> = settings.filters.iter().map(|f| f.raw()).collect();
        socket.set_filters(&raw)?;
    }
    socket.set_recv_own_msgs(true)?;
    socket.set_error_filter(ALL_ERRORS)?;
    socket.set_socket_option_int(libc::SOL_SOCKET, libc::SO_TIMESTAMPNS, 1)?;
    socket.set_socket_option_int(libc::SOL_SOCKET, libc::SO_RXQ_OVFL, 1)?;
    let bytes = i32::try_from(settings.rx_buffer).unwrap_or(i32::MAX);
    // Above net.core.rmem_max only with CAP_NET_ADMIN.
    if socket.set_socket_option_int(libc::SOL_SOCKET, libc::SO_RCVBUFFORCE, bytes).is_err() {
        socket.set_socket_option_int(libc::SOL_SOCKET, libc::SO_RCVBUF, bytes)?;
    }
    let fd = socket.as_fd().try_clone_to_owned()?;
    watch::readable(fd)
}

/// What ends a wire.
enum End {
    /// Go on.
    No,
    /// The interface is gone: open anew.
    Gone(String),
}

struct Wire<'a, H: Host> {
    line: &'a Line<H>,
    settings: &'a Settings,
    socket: AsyncFd<OwnedFd>,
    interface: Interface,
    /// Taken out while it is read.
    batch: Option<Batch>,
    /// There may be more to read.
    again: bool,
    /// Could not be given to the kernel yet.
    held: Option<Frame>,
    drops: u32,
    last_ns: u64,
    utc_offset_ns: i64,
    restarts: u32,
    restart_at_ns: Option<u64>,
    /// In bus-off: the kernel throws away without a word what it is given now.
    off: bool,
    no_ack_said: bool,
    look_failed: Seldom,
}

impl<'a, H: Host + 'static> Wire<'a, H> {
    fn new(
        line: &'a Line<H>,
        settings: &'a Settings,
        socket: AsyncFd<OwnedFd>,
        interface: Interface,
    ) -> Self {
        Self {
            line,
            settings,
            socket,
            interface,
            batch: Some(Batch::default()),
            again: false,
            held: None,
            drops: 0,
            last_ns: 0,
            utc_offset_ns: clock::utc_offset_ns(),
            restarts: 0,
            restart_at_ns: None,
            off: false,
            no_ack_said: false,
            look_failed: Seldom::default(),
        }
    }

    async fn run(&mut self) {
        if self.interface.up {
            self.raised();
        }
        self.line.status.borrow_mut().filters = self.settings.filters.len();
        let hub = self.line.hub.clone();
        let mut next_look = Instant::now() + LOOK;
        loop {
            let up = self.line.status.borrow().up;
            let pause = if up { self.until_restart().unwrap_or(LOOK) } else { DOWN_LOOK };
            // Frames that keep coming must not put it off.
            next_look = next_look.min(Instant::now() + pause);
            let end = tokio::select! {
                ready = self.socket.readable() => match ready {
                    Ok(mut guard) => {
                        guard.clear_ready();
                        drop(guard);
                        self.exchange()
                    }
                    Err(e) => End::Gone(format!("waiting for frames: {e}")),
                },
                () = tokio::task::yield_now(), if self.again => self.exchange(),
                () = hub.wire_wanted(), if self.held.is_none() => self.exchange(),
                () = tokio::time::sleep(BUSY), if self.held.is_some() && up => self.exchange(),
                () = tokio::time::sleep_until(next_look) => {
                    next_look = Instant::now() + LOOK;
                    self.look()
                }
            };
            if let End::Gone(why) = end {
                return self.line.down(why);
            }
        }
    }

    fn raised(&mut self) {
        self.off = false;
        let name = &self.settings.wanted.name;
        let rate = self.interface.bitrate.map(|rate| format!(" at {rate} bit/s")).unwrap_or_default();
        self.line
            .up(format!("interface {name} is up{rate}{}", if self.interface.fd { ", CAN FD" } else { "" }));
        self.note();
    }

    /// Reads what is there and writes what may go, until both would wait or others must have their turn.
    fn exchange(&mut self) -> End {
        for _ in 0..TURN_BATCHES {
            let mut batch = self.batch.take().unwrap_or_default();
            let more = match sys::receive(self.socket.get_ref().as_fd(), &mut batch) {
                Ok(count) => {
                    self.taken(batch.items());
                    // What comes after this makes the socket readable again.
                    count == sys::BATCH
                }
                Err(e) if e.kind() == io::ErrorKind::WouldBlock => false,
                Err(e) if e.kind() == io::ErrorKind::Interrupted => true,
                Err(e) if e.raw_os_error() == Some(libc::ENETDOWN) => {
                    // Said once; frames from before may still wait.
                    self.fell();
                    true
                }
                Err(e) => return End::Gone(format!("interface {} is gone: {e}", self.settings.wanted.name)),
            };
            self.batch = Some(batch);
            if let end @ End::Gone(_) = self.give() {
                return end;
            }
            self.again = more;
            if !more {
                break;
            }
        }
        End::No
    }

    /// Hands a batch to the bus.
    fn taken(&mut self, items: &[Received]) {
        if !self.line.status.borrow().up {
            // Frames come: somebody raised it, and we had not looked yet.
            if let Ok(interface) = netlink::look(&self.settings.wanted.name) {
                self.interface = interface;
            }
            if self.interface.up {
                self.raised();
            }
        }
        let hub = self.line.hub.clone();
        hub.turn(|bus, host, now_ns| {
            for item in items {
                let t_ns = self.stamp(item, now_ns);
                if item.own {
                    bus.wire_echo(&item.frame, t_ns, host);
                    self.no_ack_said = false;
                    self.restarts = 0;
                } else {
                    bus.wire_received(&item.frame, t_ns, host);
                }
                if self.dropped(item) {
                    bus.wire_dropped();
                }
            }
        });
        for item in items {
            if let Some(error) = ErrorFrame::of(&item.frame) {
                self.error(error);
            }
        }
    }

    /// The kernel's stamp as CLOCK_MONOTONIC; never in the future, never before the frame before it.
    fn stamp(&mut self, item: &Received, now_ns: u64) -> u64 {
        let stamped = item.utc_ns.and_then(|utc_ns| utc_ns.checked_add_signed(-self.utc_offset_ns));
        // UTC was set in between: the time of arrival is closer than that.
        let t_ns = stamped.filter(|&t_ns| t_ns <= now_ns && now_ns - t_ns < 1_000_000_000).unwrap_or(now_ns);
        self.last_ns = self.last_ns.max(t_ns);
        self.last_ns
    }

    fn dropped(&mut self, item: &Received) -> bool {
        let Some(drops) = item.drops else { return false };
        let new = drops.wrapping_sub(self.drops);
        self.drops = drops;
        self.line.status.borrow_mut().kernel_drops += u64::from(new);
        new > 0
    }

    /// Gives the kernel what may go.
    fn give(&mut self) -> End {
        if !self.line.status.borrow().up {
            return End::No;
        }
        let hub = self.line.hub.clone();
        let fd_capable = self.interface.fd;
        let filters = &self.settings.filters;
        let failed = hub.turn(|bus, host, now_ns| {
            loop {
                let waiting = self.held.take();
                let frame = waiting.or_else(|| bus.wire_next(now_ns, |f| fd_capable || !f.is_fd()))?;
                let (bytes, n) = sys::to_kernel(&frame);
                match rustix::io::write(self.socket.get_ref(), &bytes[..n]) {
                    // Its echo would not pass the filters.
                    Ok(_) if !filters.is_empty() && !filters.iter().any(|f| f.passes(frame.can_id)) => {
                        self.last_ns = self.last_ns.max(now_ns);
                        bus.wire_echo(&frame, self.last_ns, host);
                    }
                    Ok(_) => {}
                    Err(rustix::io::Errno::INTR) => self.held = Some(frame),
                    Err(e) => {
                        self.held = Some(frame);
                        return Some(e);
                    }
                }
            }
        });
        match failed {
            None => End::No,
            Some(rustix::io::Errno::AGAIN | rustix::io::Errno::NOBUFS) => {
                self.line.status.borrow_mut().tx_busy += 1;
                End::No
            }
            Some(rustix::io::Errno::NETDOWN) => {
                self.fell();
                End::No
            }
            Some(rustix::io::Errno::NXIO | rustix::io::Errno::NODEV) => {
                End::Gone(format!("interface {} is gone: the adapter was pulled", self.settings.wanted.name))
            }
            Some(e) => {
                // The kernel does not want this frame: the next one may be better.
                self.held = None;
                hub.look(|bus, _| bus.wire_not_taken());
                self.line.say(
                    Level::Warning,
                    format!("interface {} refuses a frame: {e}", self.settings.wanted.name),
                );
                End::No
            }
        }
    }

    fn fell(&mut self) {
        self.held = None;
        self.off = false;
        self.restart_at_ns = None;
        let wanted = &self.settings.wanted;
        let command = netlink::command(wanted, &self.interface);
        self.line.down(format!(
            "interface {} is down: frames wait until it is up again (`{command}`)",
            wanted.name
        ));
    }

    /// Once a second, or more often while down.
    fn look(&mut self) -> End {
        let name = &self.settings.wanted.name;
        self.utc_offset_ns = clock::utc_offset_ns();
        match netlink::look(name) {
            Err(e @ (LinkError::Absent { .. } | LinkError::NoCan)) => return End::Gone(e.to_string()),
            // The socket works, and would say if the interface went: no reason to lose frames by opening it anew.
            Err(e) => {
                if let Some(untold) = self.look_failed.failed(clock::mono_ns()) {
                    tracing::warn!("{e} ({untold} more since last told)");
                }
                return self.exchange();
            }
            Ok(is) if is.index != self.interface.index => {
                return End::Gone(format!("interface {name} was pulled and plugged in again"));
            }
            Ok(is) => self.interface = is,
        }
        let was_up = self.line.status.borrow().up;
        match (was_up, self.interface.up) {
            (false, true) => self.raised(),
            (true, false) => self.fell(),
            (true, true) => {
                self.note();
                self.restart_if_due();
                self.watch_acknowledgements();
            }
            (false, false) => {}
        }
        self.exchange()
    }

    fn watch_acknowledgements(&mut self) {
        let now_ns = clock::mono_ns();
        let since_ns = self.line.hub.look(|bus, _| bus.wire_overdue(now_ns));
        if since_ns.is_some_and(|since_ns| since_ns + NO_ACK_NS < now_ns) && !self.no_ack_said {
            self.no_ack_said = true;
            self.line.say(
                Level::Warning,
                format!(
                    "interface {}: nobody acknowledges what is sent: termination, bit rate, partner?",
                    self.settings.wanted.name
                ),
            );
        }
    }

    /// Takes over what the kernel tells about the controller.
    fn note(&mut self) {
        {
            let mut status = self.line.status.borrow_mut();
            status.bitrate = self.interface.bitrate;
            status.data_bitrate = self.interface.data_bitrate;
            if let Some((tec, rec)) = self.interface.counters {
                (status.tec, status.rec) = (Some(tec), Some(rec));
            }
        }
        if let Some(state) = self.interface.state {
            self.line.state(state, "the kernel reports it");
            self.bus_off(state == ControllerState::BusOff);
        }
    }

    fn error(&mut self, error: ErrorFrame) {
        let words = error.words();
        {
            let mut status = self.line.status.borrow_mut();
            if let Some((tec, rec)) = error.counters() {
                (status.tec, status.rec) = (Some(tec.into()), Some(rec.into()));
            }
            status.restarts += u64::from(error.is_restart());
            status.last_error = Some(words.clone());
        }
        if let Some(state) = error.state() {
            self.line.state(state, &words);
            self.bus_off(state == ControllerState::BusOff);
        } else if error.is_no_ack() && !self.no_ack_said {
            self.no_ack_said = true;
            self.line.say(
                Level::Warning,
                format!(
                    "interface {}: nobody acknowledges what is sent ({words}): termination, bit rate, partner?",
                    self.settings.wanted.name
                ),
            );
        }
    }

    fn bus_off(&mut self, off: bool) {
        if !off {
            self.restart_at_ns = None;
            if std::mem::take(&mut self.off) {
                // What waited for too long is dropped, as when the interface was down.
                self.line.hub.turn(|bus, _, now_ns| bus.wire_up(now_ns));
            }
            return;
        }
        self.held = None;
        if !self.interface.settable {
            // Without a controller there is nothing to restart, and nobody would say that it is over.
            self.line.hub.look(|bus, _| bus.wire_flush());
            return;
        }
        self.off = true;
        self.line.hub.look(|bus, _| bus.wire_down());
        if self.restart_at_ns.is_some() {
            return;
        }
        let pause_ms = u64::from(self.settings.wanted.restart_ms);
        // The kernel does it by itself when it was told to.
        if self.interface.restart_ms.unwrap_or(0) > 0 {
            return;
        }
        if pause_ms > 0 {
            let pause = restart_pause(Duration::from_millis(pause_ms), self.restarts);
            self.restart_at_ns = Some(clock::mono_ns() + pause.as_nanos() as u64);
        } else {
            self.line.say(
                Level::Warning,
                format!("interface {0} stays in bus-off, because bus_off_restart = \"0ms\": `ip link set {0} type can restart`", self.settings.wanted.name),
            );
            self.restart_at_ns = Some(u64::MAX);
        }
    }

    fn until_restart(&self) -> Option<Duration> {
        let at_ns = self.restart_at_ns?;
        Some(Duration::from_nanos(at_ns.saturating_sub(clock::mono_ns()).max(1_000_000)).min(LOOK))
    }

    fn restart_if_due(&mut self) {
        if self.restart_at_ns.is_none_or(|at_ns| at_ns > clock::mono_ns()) {
            return;
        }
        let name = &self.settings.wanted.name;
        match netlink::restart(name, &self.interface) {
            Ok(()) => {
                self.restarts += 1;
                if !self.interface.device {
                    // A device tells it by an error frame.
                    self.line.status.borrow_mut().restarts += 1;
                }
                self.restart_at_ns = None;
            }
            Err(e) if !netlink::denied(&e) => {
                let first = Duration::from_millis(u64::from(self.settings.wanted.restart_ms));
                self.restarts += 1;
                let pause = restart_pause(first, self.restarts);
                self.restart_at_ns = Some(clock::mono_ns() + pause.as_nanos() as u64);
                self.line.say(Level::Fault, format!("{e}; it is tried again in {} ms", pause.as_millis()));
            }
            Err(e) => {
                self.restart_at_ns = Some(u64::MAX);
                self.line.say(
                    Level::Fault,
                    format!("{e}; it stays in bus-off: `ip link set {name} type can restart` as root, or give this process CAP_NET_ADMIN"),
                );
            }
        }
    }
}

/// Pause before the restart after so many that did not help: doubled each time, up to 5 s or what the first one is.
fn restart_pause(first: Duration, restarts: u32) -> Duration {
    (first * (1 << restarts.min(16))).min(MAX_RESTART.max(first))
}

#[cfg(test)]
#[path = "socketcan_tests.rs"]
mod tests;
