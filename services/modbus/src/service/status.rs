//! What `<svc>/status` shows.

use super::MAX_LISTED_CLIENTS;
use super::live::Served;
use crate::line::LineCounters;
use crate::process_image::WriteCounters;
use crate::tcp::{ClientInfo, Counters, Hub};
use crate::watchdog::WatchdogState;
use ipc_types::clock;
use ipc_types::payload::PlcState;
use ipc_types::port::ReadCounters;
use serde::Serialize;
use std::net::SocketAddr;
use std::rc::Rc;

/// A serial line.
#[derive(Serialize)]
pub(super) struct LineStatus<'a> {
    /// The serial service.
    pub port: &'a str,
    #[serde(flatten)]
    pub counters: &'a LineCounters,
    /// Messages from the driver.
    pub rail: ReadCounters,
}

/// A listener for RTU over TCP.
#[derive(Serialize)]
pub(super) struct RtuOverTcpStatus {
    pub listen: Option<SocketAddr>,
    pub counters: Counters,
}

/// The JSON object.
#[derive(Serialize)]
pub(super) struct StatusBody<'a> {
    /// Whether the server is switched on.
    pub enabled: bool,
    /// Address and port of Modbus TCP, or null.
    pub listen: Option<SocketAddr>,
    /// Whether requests are carried out; false = exception 04.
    pub serving: bool,
    pub plc_state: Option<PlcState>,
    pub plc_generation: Option<u32>,
    /// Age of the newest image in ms.
    pub image_age_ms: Option<u64>,
    pub clients: usize,
    /// The first of them.
    pub client_list: Vec<ClientInfo>,
    /// Of Modbus TCP.
    pub counters: Counters,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rtu_over_tcp: Option<RtuOverTcpStatus>,
    #[serde(skip_serializing_if = "<[LineStatus<'_>]>::is_empty")]
    pub serial: &'a [LineStatus<'a>],
    pub writes: WriteCounters,
    /// Writes that the PLC has not acknowledged yet.
    pub writes_pending: usize,
    /// Acknowledgements that refused a write.
    pub writes_refused_by_plc: u64,
    pub watchdog: Option<WatchdogState>,
    pub image: ReadCounters,
}

type Listening = Option<(Rc<Hub<Served>>, Option<SocketAddr>)>;

pub(super) fn body<'a>(
    image: &Served,
    enabled: bool,
    tcp: &Listening,
    rtu: &Listening,
    lines: &'a [LineStatus<'a>],
) -> StatusBody<'a> {
    let mut client_list: Vec<ClientInfo> = tcp.iter().chain(rtu).flat_map(|(hub, _)| hub.clients()).collect();
    let clients = client_list.len();
    client_list.truncate(MAX_LISTED_CLIENTS);
    let newest = image.view().newest();
    StatusBody {
        enabled,
        listen: tcp.as_ref().and_then(|(_, address)| *address).filter(|_| enabled),
        serving: image.is_serving(),
        plc_state: newest.map(|newest| newest.state),
        plc_generation: newest.map(|newest| newest.generation),
        image_age_ms: newest.map(|newest| clock::mono_ns().saturating_sub(newest.t_ns) / 1_000_000),
        clients,
        client_list,
        counters: tcp.as_ref().map(|(hub, _)| hub.counters()).unwrap_or_default(),
        rtu_over_tcp: rtu.as_ref().map(|(hub, address)| RtuOverTcpStatus {
            listen: address.filter(|_| enabled),
            counters: hub.counters(),
        }),
        serial: lines,
        writes: image.write_counters(),
        writes_pending: image.view().pending(),
        writes_refused_by_plc: image.view().refused(),
        watchdog: image.watchdog(),
        image: image.rail().image.counters(),
    }
}
