//! The process: rail ports, TCP listeners, the loop.

use std::os::fd::OwnedFd;
use std::rc::Rc;
use std::time::Duration;

use ipc_types::event::{EventKind, Level};
use ipc_types::inbox::Inbox;
use ipc_types::payload::{CanFrame, HealthState, can_flag};
use ipc_types::port::{Publisher, Subscriber};
use ipc_types::rail::RailError;
use ipc_types::stack::ServiceEntry;
use ipc_types::topic::TopicKind;
use ipc_types::wiring::{Listener, Neighbours, TopicDecl};
use ipc_types::{Context, Finding, Stack, Wiring, clock};
use serde::Serialize;
use thiserror::Error;
use tokio::io::unix::AsyncFd;
use tokio::net::TcpListener;

use crate::config::{Backend, Config};
use crate::feed::{FeedError, Log, Player};
use crate::protocol::Frame;
use crate::server::{ClientStatus, Host, Hub};
use crate::server_pty::Pty;
use crate::txqueue::{Pushed, TxCounters};
use crate::virtual_bus::{BusCounters, Origin, Tap, VirtualBus, WireCounters};
use crate::wire::filter::{self, Filter, Filters};
use crate::wire::{Line, LinkStatus, remote, socketcan};
use crate::{protocol, watch};

/// Depth of `rx` for a virtual bus: it is faster than any wire, so its bursts are longer.
const RX_DEPTH: u32 = 8192;
/// Frames of the rail taken in one turn.
const TAKE_FRAMES: usize = 256;
/// Heartbeat; the launcher wants one every 100 ms.
const BEAT: Duration = Duration::from_millis(50);
/// Beats from one status to the next: one second.
const STATUS_BEATS: u32 = 20;
/// Client events a second that go to the rail; a client that reconnects in a loop must not fill the recording.
const CLIENT_EVENTS: u32 = 20;

/// Events of the wire a second that go to the rail.
const LINK_EVENTS: u32 = 10;

/// Why the driver ended.
#[derive(Debug, Error)]
pub enum RunError {
    /// The rail.
    #[error(transparent)]
    Rail(#[from] RailError),
    /// The log of the feed.
    #[error(transparent)]
    Feed(#[from] FeedError),
    /// The system.
    #[error("can: {what}: {source}")]
    System {
        /// What was attempted.
        what: &'static str,
        /// The system's reason.
        source: std::io::Error,
    },
    /// The pseudo-terminal of `serve.slcan_pty`.
    #[error("can: serve.slcan_pty: cannot make a terminal at {path}: {source}")]
    Pty {
        /// The link.
        path: std::path::PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// Settings that `check` refuses.
    #[error("can: the settings of backend {0:?} cannot work: `dinrail check` says why")]
    Settings(Backend),
}

fn system(what: &'static str) -> impl FnOnce(std::io::Error) -> RunError {
    move |source| RunError::System { what, source }
}

/// What the driver needs of the launcher.
pub fn topics(config: &Config, neighbours: &Neighbours) -> Wiring {
    let mut wiring = Wiring::default();
    let rx = TopicDecl::new(TopicKind::CanRx);
    let rx = if config.backend == Backend::Virtual { rx.depth(RX_DEPTH) } else { rx };
    wiring.topics.push(rx);
    wiring.own(TopicKind::CanTx);
    wiring.read(TopicKind::CanTx.of(&neighbours.name), true, "");
    for (name, endpoint) in config.endpoints() {
        wiring.listeners.push(Listener {
            name: name.to_owned(),
            address: endpoint.address,
            key: format!("serve.{name}"),
        });
    }
    if let Some(feed) = &config.feed {
        wiring.files.push((feed.file.clone(), "feed.file".to_owned()));
    }
    wiring
}

/// Every mistake that can be found without starting.
pub fn check(config: &Config, stack: &Stack, me: &ServiceEntry) -> Vec<Finding> {
    let mut found = config.findings(&me.name, &stack.dir);
    if let Err(why) = filters(config, stack, &me.name) {
        found.push(Finding::warning(
            &me.name,
            "filters",
            format!("filters = \"auto\" filters nothing: {why}"),
            "remove the key, or list the identifiers",
        ));
    }
    found
}

/// The filters for the kernel, none: every frame. Or why there can be none.
fn filters(config: &Config, stack: &Stack, service: &str) -> Result<Vec<Filter>, String> {
    match &config.filters {
        Filters::None => Ok(Vec::new()),
        Filters::List(list) => Ok(list.clone()),
        Filters::Auto => match config.endpoints().first() {
            Some((name, _)) => Err(format!("clients of serve.{name} take every frame")),
            None if config.serve.slcan_pty.is_some() => {
                Err("the client of serve.slcan_pty takes every frame".to_owned())
            }
            None => filter::derived(stack, service),
        },
    }
}

/// Runs until the launcher says stop.
pub fn run(ctx: Context) -> Result<(), RunError> {
    let config: Config = ctx.config()?;
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .map_err(system("starting the event loop"))?;
    let end = tokio::task::LocalSet::new().block_on(&runtime, serve(ctx, &config));
    // Looking for a host's name or opening a device may take long, and nobody waits for it any more.
    runtime.shutdown_background();
    end
}

/// The rail as the bus sees it.
struct Rail {
    ctx: Context,
    rx: Publisher<CanFrame>,
    tx: Subscriber<CanFrame>,
    /// Frames of the rail that cannot exist on a CAN bus.
    invalid: u64,
    unpublished: u64,
    event_budget: u32,
    events_left_out: u32,
    link_budget: u32,
    link_left_out: u32,
}

impl Tap for Rail {
    fn frame(&mut self, frame: &Frame, t_ns: u64, origin: Origin) {
        let (flags, sender) = match origin {
            Origin::Rail(sender) => (can_flag::TX_ECHO, sender),
            _ => (0, 0),
        };
        let message = CanFrame {
            can_id: frame.can_id,
            len: frame.len,
            fd_flags: frame.fd,
            flags,
            sender,
            data: frame.data,
            ..CanFrame::default()
        };
        if self.rx.send_at(message, &[], t_ns).is_err() {
            self.unpublished += 1;
        }
    }
}

impl Host for Rail {
    fn flush(&mut self) {
        self.rx.ring();
    }

    fn client(&mut self, message: String, refused: bool) {
        if self.event_budget == 0 {
            self.events_left_out += 1;
            return;
        }
        self.event_budget -= 1;
        let level = if refused { Level::Warning } else { Level::Info };
        self.ctx.event(EventKind::Client, level, message, serde_json::Value::Null);
    }

    fn link(&mut self, level: Level, message: String, up: bool) {
        self.ctx.set_state(if up { HealthState::Ready } else { HealthState::Degraded });
        if self.link_budget == 0 {
            self.link_left_out += 1;
            return;
        }
        self.link_budget -= 1;
        self.ctx.event(EventKind::BusState, level, message, serde_json::Value::Null);
    }
}

impl Rail {
    /// Moves frames of the stack into the bus's queue as far as it has room; what stays in the topic makes the
    /// topic full, and its writers are told. Returns whether more may wait.
    fn take_tx(&mut self, bus: &mut VirtualBus, now_ns: u64) -> bool {
        let limit = bus.rail_room().min(TAKE_FRAMES);
        let invalid = &mut self.invalid;
        let taken = self.tx.drain(limit, |message, _| {
            let mut frame =
                Frame { can_id: message.can_id, len: message.len, fd: message.fd_flags, data: message.data };
            if frame.validate().is_err() || frame.is_error() {
                *invalid += 1;
                return;
            }
            // A writer may leave anything behind its data; the kernel's echo, by which the frame is known again, does not.
            let used = frame.payload().len();
            frame.data[used..].fill(0);
            let newest = message.flags & can_flag::NEWEST != 0;
            // What waited in the topic while a wire was down is as old as its stamp.
            let since_ns = if bus.has_wire() { message.stamp.t_ns.min(now_ns) } else { now_ns };
            let pushed = bus.push_rail(&frame, newest, since_ns, (message.stamp.writer & 0xFF) as u8);
            debug_assert_ne!(pushed, Pushed::Refused, "room was asked for");
        });
        limit > 0 && taken == limit
    }

    fn second(&mut self) {
        if self.events_left_out > 0 {
            let message = format!("{} more client events in the last second left out", self.events_left_out);
            self.ctx.event(EventKind::Client, Level::Warning, message, serde_json::Value::Null);
        }
        if self.link_left_out > 0 {
            let message =
                format!("{} more events of the wire in the last second left out", self.link_left_out);
            self.ctx.event(EventKind::BusState, Level::Warning, message, serde_json::Value::Null);
        }
        self.event_budget = CLIENT_EVENTS;
        self.events_left_out = 0;
        self.link_budget = LINK_EVENTS;
        self.link_left_out = 0;
    }
}

/// What `<can>/status` says.
#[derive(Serialize)]
struct Status<'a> {
    backend: &'static str,
    bitrate: u32,
    data_bitrate: u32,
    pace: bool,
    /// Frames of others: clients and feed.
    rx: u64,
    /// Frames of the stack.
    tx: u64,
    /// Per mille of the last second.
    load_permille: u32,
    bus: BusCounters,
    tx_queue: TxCounters,
    tx_waiting: usize,
    tx_invalid: u64,
    rx_unpublished: u64,
    clients: &'a [ClientStatus],
    clients_refused: u64,
    feed_rounds: Option<u64>,
    /// Not for a virtual bus.
    #[serde(skip_serializing_if = "Option::is_none")]
    link: Option<LinkStatus>,
    #[serde(skip_serializing_if = "Option::is_none")]
    wire: Option<WireCounters>,
}

type Shared = Option<Rc<std::cell::RefCell<LinkStatus>>>;

fn publish_status(hub: &Hub<Rail>, config: &Config, link: &Shared) {
    let clients = hub.clients();
    let (clients_refused, feed_rounds) = (hub.refused(), hub.feed_rounds());
    hub.look(|bus, rail| {
        bus.set_utc_offset(clock::utc_offset_ns());
        let counters = bus.counters();
        let status = Status {
            backend: config.backend.name(),
            bitrate: config.bitrate.0,
            data_bitrate: config.data_bitrate.0,
            pace: config.pace,
            rx: counters.frames - counters.from_rail,
            tx: counters.from_rail,
            load_permille: bus.load_permille(clock::mono_ns()),
            bus: counters,
            tx_queue: bus.tx_counters(),
            tx_waiting: bus.rail_waiting(),
            tx_invalid: rail.invalid,
            rx_unpublished: rail.unpublished,
            clients: &clients,
            clients_refused,
            feed_rounds,
            link: link.as_ref().map(|link| link.borrow().clone()),
            wire: bus.wire_counters(),
        };
        rail.ctx.status(&status);
        rail.second();
    });
}

fn watched(fd: std::os::fd::BorrowedFd<'_>) -> Result<AsyncFd<OwnedFd>, RunError> {
    let owned = fd.try_clone_to_owned().map_err(system("duplicating a descriptor"))?;
    watch::readable(owned).map_err(system("watching a descriptor"))
}

fn listener(fd: OwnedFd) -> Result<TcpListener, RunError> {
    let listener = std::net::TcpListener::from(fd);
    listener.set_nonblocking(true).map_err(system("setting up an inherited listener"))?;
    TcpListener::from_std(listener).map_err(system("watching an inherited listener"))
}

async fn serve(mut ctx: Context, config: &Config) -> Result<(), RunError> {
    let service = ctx.service.clone();
    let feed = match &config.feed {
        Some(feed) => {
            let log = Log::load(&ctx.stack.dir.join(&feed.file), feed.bus.as_deref())?;
            tracing::info!("feed: {} frames from {}", log.len(), feed.file.display());
            Some(Player::new(log, feed.speed, feed.repeat, feed.gap.ns(), clock::mono_ns()))
        }
        None => None,
    };
    let mut inbox = ctx.inbox()?;
    let inbox_fd = watched(inbox.fd())?;
    let shutdown = watched(ctx.shutdown_fd())?;
    let mut listeners = Vec::new();
    for (dialect, endpoint) in config.servers() {
        listeners.push((listener(ctx.take_fd(dialect.name())?)?, dialect, endpoint));
    }
    let rail = Rail {
        rx: ctx.publisher(&TopicKind::CanRx.of(&service))?,
        tx: ctx.subscriber(&TopicKind::CanTx.of(&service))?,
        ctx,
        invalid: 0,
        unpublished: 0,
        event_budget: CLIENT_EVENTS,
        events_left_out: 0,
        link_budget: LINK_EVENTS,
        link_left_out: 0,
    };
    let pty = match &config.serve.slcan_pty {
        Some(path) => {
            let path = rail.ctx.stack.dir.join(path);
            Some(Pty::new(&path).map_err(|source| RunError::Pty { path, source })?)
        }
        None => None,
    };
    let hub =
        Hub::new(config.settings(&service), rail, feed).map_err(system("making the clock of the bus"))?;
    for (listener, dialect, endpoint) in listeners {
        let max_clients = endpoint.max_clients as usize;
        tokio::task::spawn_local(hub.clone().serve(listener, dialect, endpoint.filter, max_clients));
    }
    if let Some(pty) = pty {
        let hub = hub.clone();
        tokio::task::spawn_local(async move {
            if let Err(e) = pty.serve(hub).await {
                tracing::error!("the pseudo-terminal is of no use any more: {e}");
            }
        });
    }
    hub.look(|_, rail| rail.ctx.ready());
    let link = attach(&hub, config)?;
    publish_status(&hub, config, &link);
    // Starts the feed.
    hub.turn(|_, _, _| ());
    work(&hub, config, &link, &mut inbox, &inbox_fd, &shutdown).await?;
    sum_up(&hub, &link);
    Ok(())
}

/// The counters of the wire in the log, where they outlive the process.
fn sum_up(hub: &Hub<Rail>, link: &Shared) {
    let (Some(link), Some(wire)) = (link, hub.look(|bus, _| bus.wire_counters())) else { return };
    let link = link.borrow();
    tracing::info!(
        "{} in all: {} frames sent, {} received, {} error frames, {} dropped by the kernel, {} lost, {} stale, {} unfit; {} times bus-off, {} restarts, {} times down",
        link.interface,
        wire.sent,
        wire.received,
        wire.errors,
        link.kernel_drops,
        wire.lost,
        wire.stale,
        wire.unfit,
        link.bus_off,
        link.restarts,
        link.downs
    );
}

/// Puts the wire behind the bus that the stack file asks for and starts its task.
fn attach(hub: &Rc<Hub<Rail>>, config: &Config) -> Result<Shared, RunError> {
    let wrong = || RunError::Settings(config.backend);
    let interface = config.interface.clone().unwrap_or_default();
    let line = Line::new(hub.clone(), &interface);
    let link = line.status.clone();
    let flight = |frames| hub.look(|bus, _| bus.attach_wire(frames));
    match config.backend {
        Backend::Virtual => return Ok(None),
        Backend::Socketcan => {
            flight(socketcan::FLIGHT);
            let filters = hub.look(|_, rail| filters(config, &rail.ctx.stack, &rail.ctx.service));
            let settings = socketcan::Settings {
                wanted: config.wanted(),
                rx_buffer: config.rx_buffer.0 as usize,
                // Why there are none is said by `check`.
                filters: filters.unwrap_or_default(),
            };
            tokio::task::spawn_local(socketcan::drive(line, settings));
        }
        Backend::Slcan | Backend::Socketcand => {
            let (target, bus) = config.target().ok_or_else(wrong)?;
            let peer: Box<dyn protocol::peer::Peer> = if config.backend == Backend::Slcan {
                Box::new(protocol::slcan_client::Client::new(config.channel().ok_or_else(wrong)?))
            } else {
                Box::new(protocol::socketcand_client::Client::new(&bus.ok_or_else(wrong)?))
            };
            flight(peer.flight());
            tokio::task::spawn_local(remote::drive(line, target, peer));
        }
    }
    Ok(Some(link))
}

async fn work(
    hub: &Rc<Hub<Rail>>,
    config: &Config,
    link: &Shared,
    inbox: &mut Inbox,
    inbox_fd: &AsyncFd<OwnedFd>,
    shutdown: &AsyncFd<OwnedFd>,
) -> Result<(), RunError> {
    let mut beat = tokio::time::interval(BEAT);
    beat.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    let mut beats = 0u32;
    // The rail has more frames than one turn takes.
    let mut more = false;
    loop {
        tokio::select! {
            end = shutdown.readable() => {
                end.map_err(system("waiting for the end"))?.retain_ready();
                return Ok(());
            }
            rang = inbox_fd.readable() => {
                // First cleared, then drained: what rings in between is an arrival again.
                rang.map_err(system("waiting for the rail"))?.clear_ready();
                inbox.drain();
                // At once, not by another pass of the loop: it would cost every frame out a look at all descriptors.
                more = hub.turn(|bus, rail, now_ns| rail.take_tx(bus, now_ns));
            }
            // One turn at a time, so that writers that never pause keep neither the heartbeat nor the end waiting.
            () = tokio::task::yield_now(), if more => {
                more = hub.turn(|bus, rail, now_ns| rail.take_tx(bus, now_ns));
            }
            // A wire has taken a frame, and the topic may hold what had no place: its writers need not ring again.
            () = hub.rail_room() => more = true,
            due = hub.alarm() => {
                due.map_err(system("waiting for the clock of the bus"))?;
                // A paced bus has room again: what waits in the topic goes on.
                hub.turn(|bus, rail, now_ns| rail.take_tx(bus, now_ns));
            }
            _ = beat.tick() => {
                beats += 1;
                hub.look(|_, rail| rail.ctx.beat());
                if beats.is_multiple_of(STATUS_BEATS) {
                    publish_status(hub, config, link);
                }
            }
        }
    }
}
