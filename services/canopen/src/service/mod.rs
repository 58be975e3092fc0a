//! The services on the rail: what is the same for master and slave.

pub mod fleet;
mod job_port;
mod jobs;
pub mod load;
pub mod master;
mod node_ids;
mod outputs;
mod ports;
pub mod slave;
mod words;

use crate::protocol::io::OUTBOX_FRAMES;
use dinrail_iec::Addressing;
use ipc_types::rail::RailError;
use ipc_types::stack::ServiceEntry;
use ipc_types::wiring::Neighbours;
use ipc_types::{Stack, Wiring, plc_table};
use thiserror::Error;

/// Frames taken from the bus before other work has its turn.
const TAKE_FRAMES: usize = 256;
/// Frames in the outbox that are handed over before more are taken: what one frame leads to, a sub-block of 127 segments
/// and a command to each node, still has room.
const SEND_AT: usize = OUTBOX_FRAMES / 2;
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
    let plc = stack.plc_of(wiring);
    let addressing = plc.map(|plc| addressing_named(plc_table::addressing(&plc.config)));
    (plc, addressing.unwrap_or_default())
}
