//! The transparent gateway: masters on TCP, units on serial lines.
//!
//! [`core`] has all of it but sockets and ports, in virtual time; [`cache`] what it polls by itself; [`config`] the
//! stack file's table; [`masters`] the connections; [`service`] the process.
//!
//! What may never happen here: an answer that reaches another master or request than its own, two requests in flight
//! on a line, an exception 04 of the gateway's own, a master that keeps others from the line.

pub mod cache;
pub mod config;
pub mod core;
mod masters;
mod service;
mod status;
mod wiring;

pub use config::Config;
pub use service::{KIND, RunError, run};
pub use wiring::{check, topics};
