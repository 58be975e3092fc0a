//! The service: ports on the rail, configuration, loop.
//!
//! One thread, one current-thread tokio runtime. The image is fetched when a request comes, so a PLC that scans
//! every 500 us wakes nobody here; a serial line wakes it by its frames. A tick every 50 ms beats the heart, notices
//! a PLC that stopped or died, runs the write watchdog, follows the switch and repeats the owned inputs.

mod check;
mod live;
mod status;
mod wiring;

use crate::map_config::MapError;
use dinrail_iec::Addressing;
use ipc_types::plc_table;
use ipc_types::rail::RailError;
use ipc_types::stack::ServiceEntry;

pub use check::check;
pub use live::run;
pub use wiring::topics;

/// Kind of the service in stack files.
pub const KIND: &str = "modbus-server";
/// Name of the inherited listener of Modbus TCP.
pub const LISTENER: &str = "tcp";
/// Name of the inherited listener of RTU over TCP.
pub const RTU_LISTENER: &str = "rtu_over_tcp";
/// Clients listed in a status, so that it stays below its limit of 16 KiB.
pub const MAX_LISTED_CLIENTS: usize = 40;

/// Why the service ended.
#[derive(Debug, thiserror::Error)]
pub enum ServiceError {
    #[error("service '{service}': {source}")]
    Rail { service: String, source: RailError },
    #[error("service '{service}': {source}")]
    Map { service: String, source: MapError },
    #[error("service '{service}': {source}")]
    Watchdog { service: String, source: crate::config::WatchdogError },
    #[error("service '{service}': {text}")]
    Config { service: String, text: String },
    #[error("service '{service}': no plc service is named; set plc = \"NAME\"")]
    NoPlc { service: String },
    #[error("service '{service}': {source}")]
    Run { service: String, source: crate::process::RunError },
}

/// A name that is none is the plc service's mistake, and found there.
fn addressing_named(name: &str) -> Addressing {
    Addressing::from_name(name).unwrap_or_default()
}

/// How the addresses of this plc service's image count.
pub fn addressing_of(plc: Option<&ServiceEntry>) -> Addressing {
    plc.map_or_else(Addressing::default, |plc| addressing_named(plc_table::addressing(&plc.config)))
}

#[cfg(test)]
#[path = "service_tests.rs"]
mod tests;
