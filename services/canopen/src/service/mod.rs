//! The services on the rail: what is the same for master and slave.

pub mod fleet;
mod jobs;
pub mod load;
pub mod master;
mod outputs;
pub mod slave;
mod words;

use dinrail_iec::Addressing;
use ipc_types::rail::RailError;
use ipc_types::stack::ServiceEntry;
use ipc_types::wiring::Neighbours;
use ipc_types::{Finding, Stack, Wiring, plc_table};
use std::time::Duration;
use thiserror::Error;

/// Heartbeat on the rail; the launcher wants one every 100 ms.
const BEAT: Duration = Duration::from_millis(50);
/// Beats from one status to the next: one second.
const STATUS_BEATS: u32 = 20;
/// The inputs are repeated at least this often, so that a plc that comes late gets them.
const REPEAT_NS: u64 = 90_000_000;
/// Frames taken from the bus before other work has its turn.
const TAKE_FRAMES: usize = 256;
/// Events a second that go to the rail.
const EVENTS_A_SECOND: u32 = 30;

/// Why a service ended.
#[derive(Debug, Error)]
pub enum RunError {
    /// The rail.
    #[error(transparent)]
    Rail(#[from] RailError),
    /// The system.
    #[error("canopen: waiting for bus and image: {0}")]
    System(#[from] std::io::Error),
    /// `check` was not heeded.
    #[error("canopen: {key}: {message}; run `dinrail check`")]
    Config { key: String, message: String },
}

/// A name that is none is the plc service's mistake, and found there.
fn addressing_named(name: &str) -> Addressing {
    Addressing::from_name(name).unwrap_or_default()
}

fn addressing_near(neighbours: &Neighbours, plc: Option<&str>) -> Addressing {
    addressing_named(neighbours.addressing(plc))
}

/// The plc service whose image is exchanged, and how its addresses count.
fn plc_of<'a>(stack: &'a Stack, wiring: &Wiring) -> (Option<&'a ServiceEntry>, Addressing) {
    let plc = wiring.plc.as_deref().and_then(|plc| stack.service(plc)).filter(|plc| plc.kind == "plc");
    let addressing = plc.map(|plc| addressing_named(plc_table::addressing(&plc.config)));
    (plc, addressing.unwrap_or_default())
}

/// Without the key `bus` the stack must have one bus.
fn no_only_bus(stack: &Stack, me: &str) -> Option<Finding> {
    let buses: Vec<&str> =
        stack.services.iter().filter(|s| s.kind == "can").map(|s| s.name.as_str()).collect();
    let (message, help) = match buses.as_slice() {
        [_] => return None,
        [] => (
            "the stack has no service of kind \"can\"".to_owned(),
            "add one, as [[service]] with kind = \"can\"".to_owned(),
        ),
        [first, ..] => (
            format!("the stack has several services of kind \"can\": {}", buses.join(", ")),
            format!("say which one: bus = \"{first}\""),
        ),
    };
    Some(Finding::error(me, "bus", message, help))
}
