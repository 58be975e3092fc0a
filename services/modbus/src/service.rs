//! The service: ports on the rail, configuration, loop.
//!
//! One thread, one current-thread tokio runtime. The image is fetched when a request comes, so a PLC that scans
//! every 500 us wakes nobody here. A tick every 50 ms beats the heart, notices a PLC that stopped or died,
//! runs the write watchdog and repeats the owned inputs.

use crate::config::{Config, MAX_CONNECTIONS};
use crate::map_config::{MapConfig, MapError, area_of};
use crate::process_image::{Change, NotQueued, ProcessImage, Rail, WriteCounters};
use crate::readable;
use crate::tcp::{ClientInfo, Counters, Happening, Hub};
use crate::view::View;
use crate::watchdog::{Watchdog, WatchdogState};
use dinrail_iec::{Addressing, parse_address};
use ipc_types::event::{EventKind, Level};
use ipc_types::image_write::Builder;
use ipc_types::payload::{Image, ImageWrite, Inputs, PlcState};
use ipc_types::port::{Publisher, ReadCounters, SendError, Subscriber};
use ipc_types::rail::RailError;
use ipc_types::stack::ServiceEntry;
use ipc_types::topic::TopicKind;
use ipc_types::wiring::{Area, AreaSizes, ImageRange, Listener, Neighbours, OnBad, TopicDecl};
use ipc_types::{Context, Finding, Stack, Wiring, clock, plc_table};
use serde::Serialize;
use std::io;
use std::net::SocketAddr;
use std::time::Duration;
use tokio::net::TcpListener;
use tokio::time::MissedTickBehavior;

/// Kind of the service in stack files.
pub const KIND: &str = "modbus-server";
/// Name of the inherited listener.
pub const LISTENER: &str = "tcp";
const TICK: Duration = Duration::from_millis(50);
/// Ticks between two statuses and sweeps: one second.
const TICKS_PER_STATUS: u32 = 20;
/// Clients listed in a status, so that it stays below its limit of 16 KiB.
pub const MAX_LISTED_CLIENTS: usize = 64;

/// Why the service ended.
#[derive(Debug, thiserror::Error)]
pub enum ServiceError {
    #[error("service '{service}': {source}")]
    Rail { service: String, source: RailError },
    #[error("service '{service}': {source}")]
    Map { service: String, source: MapError },
    #[error("service '{service}': {source}")]
    Watchdog { service: String, source: crate::config::WatchdogError },
    #[error("service '{service}': no plc service is named; set plc = \"NAME\"")]
    NoPlc { service: String },
    #[error("service '{service}': {what} failed: {source}")]
    System { service: String, what: &'static str, source: io::Error },
}

/// Everything the service reads, writes, owns and listens on.
pub fn topics(config: &Config, neighbours: &Neighbours) -> Wiring {
    let mut wiring = Wiring::default();
    if let Some(plc) = neighbours.resolve("plc", config.plc.as_deref()) {
        wiring.read(TopicKind::Image.of(&plc), false, "plc");
        wiring.write(TopicKind::Writes.of(&plc), "plc");
        wiring.plc = Some(plc);
    }
    let addressing = addressing_named(neighbours.addressing(wiring.plc.as_deref()));
    if let Ok(map) = config.map.build(AreaSizes::MAX, addressing) {
        let own = map.own_inputs().into_iter();
        wiring.inputs = own.map(|(byte, bytes)| own_range(config, addressing, byte, bytes)).collect();
        wiring.outputs = shown_ranges(config, addressing);
    }
    if !wiring.inputs.is_empty() {
        let tail: u32 = wiring.inputs.iter().map(|range| range.bytes + 1).sum();
        let decl = TopicDecl::new(TopicKind::Inputs);
        let max_tail = decl.max_tail.max(tail);
        wiring.topics.push(decl.max_tail(max_tail));
    }
    if config.enable {
        let address = SocketAddr::new(config.tcp.address, config.tcp.port);
        wiring.listeners.push(Listener { name: LISTENER.to_owned(), address, key: "tcp.port".to_owned() });
    }
    wiring
}

/// A name that is none is the plc service's mistake, and found there.
fn addressing_named(name: &str) -> Addressing {
    Addressing::from_name(name).unwrap_or_default()
}

/// How the addresses of this plc service's image count.
pub fn addressing_of(plc: Option<&ServiceEntry>) -> Addressing {
    plc.map_or_else(Addressing::default, |plc| addressing_named(plc_table::addressing(&plc.config)))
}

/// The ranges of %Q and %M that map tables show. The ready maps show all of both, which is not listed.
fn shown_ranges(config: &Config, addressing: Addressing) -> Vec<ImageRange> {
    let MapConfig::Tables(entries) = &config.map else { return Vec::new() };
    let shown = entries.iter().enumerate().filter_map(|(i, entry)| {
        let address = parse_address(&entry.area, addressing).ok()?;
        let bytes = if entry.table.is_bits() {
            (u32::from(address.bit.unwrap_or(0)) + entry.count).div_ceil(8)
        } else {
            entry.count * 2
        };
        let label = format!("{} {}-{}", entry.table.name(), entry.at, entry.at + entry.count - 1);
        let area = area_of(address);
        let range = ImageRange { area, ..image_range(address.byte, bytes, label, format!("map[{i}].area")) };
        (area != Area::Input).then_some(range)
    });
    shown.collect()
}

fn image_range(byte: u32, bytes: u32, label: String, key: String) -> ImageRange {
    ImageRange {
        area: Area::Input,
        byte,
        bit: None,
        bytes,
        type_name: None,
        symbol: None,
        label,
        key,
        on_bad: OnBad::Hold,
        status_byte: None,
    }
}

fn own_range(config: &Config, addressing: Addressing, byte: u32, bytes: u32) -> ImageRange {
    // The first table that owns a byte of it; joined neighbours are named by the first.
    let found = match &config.map {
        MapConfig::Tables(entries) => entries.iter().enumerate().find(|(_, entry)| {
            entry.own
                && parse_address(&entry.area, addressing)
                    .is_ok_and(|address| area_of(address) == Area::Input && address.byte == byte)
        }),
        MapConfig::Preset(_) => None,
    };
    let (label, key) = found.map_or_else(
        || ("written by Modbus clients".to_owned(), "map".to_owned()),
        |(i, entry)| {
            (
                format!("{} {}.. written by Modbus clients", entry.table.name(), entry.at),
                format!("map[{i}].area"),
            )
        },
    );
    image_range(byte, bytes, label, key)
}

/// Every mistake that can be found without starting.
pub fn check(config: &Config, stack: &Stack, me: &ServiceEntry) -> Vec<Finding> {
    let service = me.name.as_str();
    let mut findings = Vec::new();
    check_plc(service, config, stack, &mut findings);
    check_tcp(service, config, &mut findings);
    let plc = chosen_plc(config, stack);
    let addressing = addressing_of(plc);
    let sizes = plc.map_or(AreaSizes::MAX, |plc| plc_table::areas(&plc.config));
    if let Err(error) = config.map.build(sizes, addressing) {
        let help = "see the page on the Modbus server for what a [[service.map]] table takes";
        findings.push(Finding::error(service, &map_key(&error), error.to_string(), help));
    }
    check_watchdog(service, config, addressing, &mut findings);
    findings
}

fn map_key(error: &MapError) -> String {
    match error.entry() {
        Some(entry) => format!("map[{}]", entry - 1),
        None => "map".to_owned(),
    }
}

fn chosen_plc<'a>(config: &Config, stack: &'a Stack) -> Option<&'a ServiceEntry> {
    let mut plcs = stack.services.iter().filter(|entry| entry.kind == "plc");
    match &config.plc {
        Some(name) => plcs.find(|entry| entry.name == *name),
        None => plcs.next().filter(|_| plcs.next().is_none()),
    }
}

fn check_plc(service: &str, config: &Config, stack: &Stack, findings: &mut Vec<Finding>) {
    let plcs: Vec<&str> =
        stack.services.iter().filter(|s| s.kind == "plc").map(|s| s.name.as_str()).collect();
    let Some(plc) = chosen_plc(config, stack) else {
        let message = match &config.plc {
            Some(name) => format!("there is no plc service '{name}'"),
            None if plcs.is_empty() => "the stack has no plc service whose image could be served".to_owned(),
            None => format!("the stack has {} plc services; which one is served?", plcs.len()),
        };
        let help = if plcs.is_empty() {
            "add a [[service]] with kind = \"plc\"; it works without a program too".to_owned()
        } else {
            format!("set plc to one of: {}", plcs.join(", "))
        };
        findings.push(Finding::error(service, "plc", message, help));
        return;
    };
    findings.extend(plc_table::check_stale_after(service, config.stale_after, plc));
}

fn check_tcp(service: &str, config: &Config, findings: &mut Vec<Finding>) {
    let tcp = &config.tcp;
    if tcp.max_connections == 0 || tcp.max_connections > MAX_CONNECTIONS {
        let message = format!("max_connections = {} is not 1 to {MAX_CONNECTIONS}", tcp.max_connections);
        findings.push(Finding::error(service, "tcp.max_connections", message, "8 is the default"));
    }
    if let Some(fault) = tcp.filter.and_then(|filter| filter.fault()) {
        findings.push(Finding::error(
            service,
            "tcp.filter",
            fault,
            "exchange start and end, or correct them",
        ));
    }
    if config.enable && tcp.filter.is_none() && !tcp.address.is_loopback() {
        findings.push(Finding::warning(
            service,
            "tcp",
            "Modbus has no passwords: whoever reaches this port can write outputs and markers",
            "add filter = { mask = ..., start = ..., end = ... }, or address = \"127.0.0.1\"",
        ));
    }
    if config.units.as_ref().is_some_and(Vec::is_empty) {
        let help = "leave units out to serve all, or list unit identifiers";
        findings.push(Finding::warning(service, "units", "only units 0 and 255 are served", help));
    }
}

fn check_watchdog(service: &str, config: &Config, addressing: Addressing, findings: &mut Vec<Finding>) {
    if let Err(error) = config.watchdog_write(addressing) {
        let key = format!("watchdog_values[{}]", error.index());
        findings.push(Finding::error(service, &key, error.to_string(), "correct or remove the value"));
    }
    let owns = config.map.build(AreaSizes::MAX, addressing).is_ok_and(|map| !map.own_inputs().is_empty());
    match config.write_watchdog {
        None if !config.watchdog_values.is_empty() => {
            let help = "set write_watchdog, e.g. \"2s\", or remove the values";
            findings.push(Finding::error(service, "watchdog_values", "values without write_watchdog", help));
        }
        Some(_) if config.watchdog_values.is_empty() && !owns => {
            let help = "add watchdog_values = [ { to = \"%QW0\", value = 0 } ]";
            findings.push(Finding::error(
                service,
                "write_watchdog",
                "the watchdog has nothing to write",
                help,
            ));
        }
        Some(limit) if limit.ns() < 100_000_000 => {
            let help = "set at least \"100ms\", and twice the clients' period";
            let message = format!("write_watchdog = {limit} is shorter than it is looked at");
            findings.push(Finding::error(service, "write_watchdog", message, help));
        }
        _ => {}
    }
}

/// The ports.
struct Ports {
    image: Subscriber<Image>,
    writes: Publisher<ImageWrite>,
    inputs: Option<Publisher<Inputs>>,
}

impl Rail for Ports {
    fn now_ns(&self) -> u64 {
        clock::mono_ns()
    }

    fn newest(&mut self, take: &mut dyn FnMut(&Image, &[u8])) {
        self.image.newest(take);
    }

    fn write(&mut self, write: &Builder) -> Result<u64, NotQueued> {
        let header = ImageWrite { ops: write.ops(), ..ImageWrite::default() };
        self.writes.send_tail(header, write.tail()).map_err(|error| match error {
            SendError::Full(_) => NotQueued::Full,
            SendError::NoReader(_) | SendError::TooLong { .. } | SendError::Middleware { .. } => {
                NotQueued::NoReader
            }
        })
    }

    fn publish_inputs(&mut self, ranges: u32, data_t_ns: u64, tail: &[u8]) -> bool {
        let Some(port) = &mut self.inputs else { return true };
        let sent = port.send_tail(Inputs { data_t_ns, ranges, ..Inputs::default() }, tail).is_ok();
        port.ring();
        sent
    }
}

/// What `<svc>/status` shows.
#[derive(Serialize)]
struct StatusBody {
    /// Address and port, or null when switched off.
    listen: Option<SocketAddr>,
    /// Whether requests are carried out; false = exception 04.
    serving: bool,
    plc_state: Option<PlcState>,
    plc_generation: Option<u32>,
    /// Age of the newest image in ms.
    image_age_ms: Option<u64>,
    clients: usize,
    /// The first 64 of them.
    client_list: Vec<ClientInfo>,
    counters: Counters,
    writes: WriteCounters,
    /// Writes that the PLC has not acknowledged yet.
    writes_pending: usize,
    /// Acknowledgements that refused a write.
    writes_refused_by_plc: u64,
    watchdog: Option<WatchdogState>,
    image: ReadCounters,
}

/// Serves until the launcher says stop.
pub fn run(ctx: Context) -> Result<(), ServiceError> {
    let service = ctx.service.clone();
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_io()
        .enable_time()
        .build()
        .map_err(|source| ServiceError::System { service, what: "starting the runtime", source })?;
    let local = tokio::task::LocalSet::new();
    local.block_on(&runtime, serve(ctx))
}

async fn serve(mut ctx: Context) -> Result<(), ServiceError> {
    let service = ctx.service.clone();
    let rail = |source| ServiceError::Rail { service: service.clone(), source };
    let system = |what| {
        let service = service.clone();
        move |source| ServiceError::System { service, what, source }
    };
    let config: Config = ctx.config().map_err(rail)?;
    let plc = ctx.entry().and_then(|entry| entry.wiring.plc.clone());
    let plc = plc.ok_or_else(|| ServiceError::NoPlc { service: service.clone() })?;
    let image = build_image(&mut ctx, &config, &plc)?;
    let hub = Hub::new(image, config.options());

    let shutdown =
        ctx.shutdown_fd().try_clone_to_owned().map_err(system("duplicating the shutdown descriptor"))?;
    let shutdown = readable::watch(shutdown).map_err(system("watching the shutdown descriptor"))?;
    let mut listen = None;
    if config.enable {
        let fd = ctx.take_fd(LISTENER).map_err(rail)?;
        let listener = std::net::TcpListener::from(fd);
        listener.set_nonblocking(true).map_err(system("preparing the listener"))?;
        let listener = TcpListener::from_std(listener).map_err(system("watching the listener"))?;
        listen = listener.local_addr().ok();
        tokio::task::spawn_local(hub.clone().accept(listener));
    } else {
        hub.set_enabled(false);
    }

    let mut tick = tokio::time::interval(TICK);
    tick.set_missed_tick_behavior(MissedTickBehavior::Skip);
    let mut ticks = 0_u32;
    // The owned inputs go out before the service counts as ready, so that the first scan need not wait.
    on_tick(&hub, &mut ctx, &config, &plc);
    ctx.ready();
    loop {
        tokio::select! {
            biased;
            _ = shutdown.readable() => return Ok(()),
            _ = tick.tick() => {}
        }
        ctx.beat();
        let news = on_tick(&hub, &mut ctx, &config, &plc);
        if ticks == 0 {
            hub.sweep();
        }
        if ticks == 0 || news {
            ctx.status(&status(&hub, listen));
        }
        ticks = (ticks + 1) % TICKS_PER_STATUS;
    }
}

fn build_image(ctx: &mut Context, config: &Config, plc: &str) -> Result<ProcessImage<Ports>, ServiceError> {
    let service = ctx.service.clone();
    let rail = |source| ServiceError::Rail { service: service.clone(), source };
    let addressing = addressing_of(ctx.stack.service(plc));
    let map = config
        .map
        .build(AreaSizes::MAX, addressing)
        .map_err(|source| ServiceError::Map { service: service.clone(), source })?;
    let watchdog = match config.write_watchdog {
        None => None,
        Some(limit) => {
            let values = config
                .watchdog_write(addressing)
                .map_err(|source| ServiceError::Watchdog { service: service.clone(), source })?;
            Some(Watchdog::new(limit.ns(), values, ctx.generation > 1, clock::mono_ns()))
        }
    };
    let inputs = if map.own_inputs().is_empty() {
        None
    } else {
        Some(ctx.publisher(&TopicKind::Inputs.of(&service)).map_err(rail)?)
    };
    let ports = Ports {
        image: ctx.subscriber(&TopicKind::Image.of(plc)).map_err(rail)?,
        writes: ctx.publisher(&TopicKind::Writes.of(plc)).map_err(rail)?,
        inputs,
    };
    let view = View::new(ctx.writer, ctx.generation, config.stale_after.ns());
    Ok(ProcessImage::new(ports, view, map, config.on_stop, watchdog))
}

/// Returns whether the list of clients or the state changed.
fn on_tick(hub: &Hub<ProcessImage<Ports>>, ctx: &mut Context, config: &Config, plc: &str) -> bool {
    let mut changes = Vec::new();
    hub.with_backend(|image| image.tick(|change| changes.push(change)));
    for change in &changes {
        tell_change(*change, ctx, config, plc);
    }
    let (happenings, left_out) = hub.take_happenings();
    for happening in &happenings {
        tell_client(happening, ctx);
    }
    if left_out > 0 {
        let message = format!("{left_out} more connections came, went or were refused");
        ctx.event(EventKind::Client, Level::Warning, message, serde_json::Value::Null);
    }
    !changes.is_empty() || !happenings.is_empty()
}

fn tell_change(change: Change, ctx: &mut Context, config: &Config, plc: &str) {
    let detail = serde_json::Value::Null;
    match change {
        Change::NotServing => {
            let message = format!(
                "'{plc}' does not run or its image is older than {}: Modbus requests are answered by exception 04",
                config.stale_after
            );
            ctx.event(EventKind::SafeEntered, Level::Fault, message, detail);
        }
        Change::Serving => {
            let message = format!("'{plc}' runs: Modbus requests are carried out");
            ctx.event(EventKind::SafeLeft, Level::Info, message, detail);
        }
        Change::WatchdogFired => {
            let limit = config.write_watchdog.unwrap_or_default();
            let message = format!("no Modbus client has written for {limit}: watchdog_values were written");
            ctx.event(EventKind::SafeEntered, Level::Fault, message, detail);
        }
        Change::WatchdogCleared => {
            ctx.event(EventKind::SafeLeft, Level::Info, "a Modbus client writes again", detail);
        }
    }
}

fn tell_client(happening: &Happening, ctx: &mut Context) {
    let detail = serde_json::to_value(happening).unwrap_or_default();
    let level = if matches!(happening, Happening::Refused { .. }) { Level::Warning } else { Level::Info };
    ctx.event(EventKind::Client, level, happening.to_string(), detail);
}

fn status(hub: &Hub<ProcessImage<Ports>>, listen: Option<SocketAddr>) -> StatusBody {
    let mut client_list = hub.clients();
    let clients = client_list.len();
    client_list.truncate(MAX_LISTED_CLIENTS);
    hub.with_backend(|image| {
        let newest = image.view().newest();
        StatusBody {
            listen: listen.filter(|_| hub.is_enabled()),
            serving: image.is_serving(),
            plc_state: newest.map(|newest| newest.state),
            plc_generation: newest.map(|newest| newest.generation),
            image_age_ms: newest.map(|newest| clock::mono_ns().saturating_sub(newest.t_ns) / 1_000_000),
            clients,
            client_list,
            counters: hub.counters(),
            writes: image.write_counters(),
            writes_pending: image.view().pending(),
            writes_refused_by_plc: image.view().refused(),
            watchdog: image.watchdog(),
            image: image.rail().image.counters(),
        }
    })
}

#[cfg(test)]
#[path = "service_tests.rs"]
mod tests;
