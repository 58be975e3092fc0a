//! Raw CAN frames and signals to and from the process image.
//!
//! For devices that speak neither CANopen nor J1939: named bits of frames go to %I, bits of %Q and %M go out in
//! frames. The service must never keep a value alive that the bus or the PLC no longer vouches for: every input has
//! a quality, every output a safe state.
//!
//! Storeys: [`protocol`] bits and values, sans-I/O; [`plan`] the stack file resolved; [`inputs`] and [`outputs`] the
//! tables that frames and images pass through, sans-I/O; the functions below are the service on the rail.

pub mod config;
pub mod inputs;
pub mod outputs;
pub mod plan;
pub mod protocol;
mod service;

pub use config::Config;
pub use service::{RunError, check, run, topics};
