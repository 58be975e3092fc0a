//! What the service declares and checks without starting.

use super::config::Config;
use super::service::LISTENER;
use crate::client::wiring::check_serial;
use ipc_types::stack::ServiceEntry;
use ipc_types::topic::TopicKind;
use ipc_types::wiring::{Listener, Neighbours};
use ipc_types::{Finding, Stack, Wiring};
use std::net::SocketAddr;

/// What the service needs of the launcher.
pub fn topics(config: &Config, _neighbours: &Neighbours) -> Wiring {
    let mut wiring = Wiring::default();
    for port in config.plan().ports {
        wiring.read(TopicKind::SerialRx.of(&port.serial), true, &port.key);
        wiring.write(TopicKind::SerialTx.of(&port.serial), &port.key);
    }
    let address = SocketAddr::new(config.tcp.address, config.tcp.port);
    wiring.listeners.push(Listener { name: LISTENER.to_owned(), address, key: "tcp.port".to_owned() });
    wiring
}

/// Every mistake that can be found without starting.
pub fn check(config: &Config, stack: &Stack, me: &ServiceEntry) -> Vec<Finding> {
    let plan = config.plan();
    let mut found: Vec<Finding> = plan.mistakes.iter().map(|m| m.finding(&me.name)).collect();
    for port in &plan.ports {
        found.extend(check_serial(&me.name, &port.key, &port.serial, port.ascii, stack));
    }
    if config.tcp.filter.is_none() && !config.tcp.address.is_loopback() {
        found.push(Finding::warning(
            &me.name,
            "tcp",
            "Modbus has no passwords: whoever reaches this port can write to every unit of the line",
            "add filter = { mask = ..., start = ..., end = ... }, or address = \"127.0.0.1\"",
        ));
    }
    found
}
