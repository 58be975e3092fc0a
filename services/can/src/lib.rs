//! The CAN bus driver: one process a bus.
//!
//! It owns the bus: it stamps every frame, puts all frames into one true order on `<can>/rx`, sends what the stack
//! puts on `<can>/tx` by identifier, and lets foreign tools take part by TCP. It must never interpret a frame, never
//! wait for a reader, and never drop what a TCP client sends.
//!
//! Storeys: [`protocol`] text and bits, sans-I/O; [`txqueue`], [`virtual_bus`] and [`feed`] the bus, sans-I/O;
//! [`server`] and [`server_pty`] the clients; [`wire`] what is behind the bus: nothing (backend `virtual`), a kernel
//! interface, a serial adapter, a remote bus; [`config`] and the functions below the service on the rail.

pub mod config;
pub mod feed;
pub mod protocol;
pub mod server;
pub mod server_pty;
mod service;
pub mod sys;
pub mod txqueue;
pub mod virtual_bus;
pub mod watch;
pub mod wire;

pub use config::Config;
pub use service::{RunError, check, run, topics};
