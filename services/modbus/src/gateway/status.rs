//! What `<service>/status` shows.

use super::core::{Core, GatewayCounters};
use super::service::Service;
use crate::client::line::LineCounters;
use crate::client::unit_row::{UnitRow, unit_rows};
use ipc_types::clock;
use serde::Serialize;
use std::net::SocketAddr;

/// Masters and units shown.
const SHOWN: usize = 32;

#[derive(Serialize)]
struct LineRow {
    serial: String,
    waiting: usize,
    counters: LineCounters,
    units: Vec<UnitRow>,
}

#[derive(Serialize)]
struct ClientRow {
    address: String,
    port: u16,
    connected_s: u64,
    idle_s: u64,
    requests: u64,
}

#[derive(Serialize)]
struct Status {
    listen: Option<SocketAddr>,
    clients: usize,
    client_list: Vec<ClientRow>,
    accepted: u64,
    refused: u64,
    counters: GatewayCounters,
    lines: Vec<LineRow>,
}

fn line_row(core: &Core, line: usize, name: &str, left: &mut usize) -> LineRow {
    let units = unit_rows(core.units(line), left, |_| None);
    LineRow {
        serial: name.to_owned(),
        waiting: core.waiting(line),
        counters: core.line_counters(line),
        units,
    }
}

impl Service {
    pub(super) fn status(&mut self) {
        let now_ns = clock::mono_ns();
        let status = {
            let core = self.shared.core.borrow();
            let clients = self.shared.clients.borrow();
            let seconds = |since_ns| now_ns.saturating_sub(since_ns) / 1_000_000_000;
            let mut left = SHOWN;
            Status {
                listen: self.listen,
                clients: clients.len(),
                client_list: clients
                    .iter()
                    .take(SHOWN)
                    .map(|client| ClientRow {
                        address: client.peer.ip().to_canonical().to_string(),
                        port: client.peer.port(),
                        connected_s: seconds(client.since_ns),
                        idle_s: seconds(client.last_ns.get()),
                        requests: client.requests.get(),
                    })
                    .collect(),
                accepted: self.shared.accepted.get(),
                refused: self.shared.refused.get(),
                counters: core.counters(),
                lines: (0..self.names.len())
                    .map(|line| line_row(&core, line, &self.names[line], &mut left))
                    .collect(),
            }
        };
        self.ctx.status(&status);
    }
}
