//! The PLC service of dinrail: scan engine, process image, routes; and the verifier and tracer on the same engine.
//!
//! - [`engine`]: one scan after the other, sans-I/O. [`setup`] and [`routes`] are what it depends on beside its program.
//! - [`verify`]: a recording is computed again, scan by scan. [`trace`]: a program in virtual time.
//! - `service`: the rail, the clock and the commands around the engine; [`config`] its table of the stack file.
//!
//! What may never happen here: a scan that depends on anything its record does not hold, an output before the
//! first finished scan, a program that takes the process down.

pub mod config;
pub mod engine;
pub mod program;
pub mod retain;
pub mod routes;
pub mod service;
pub mod setup;
pub mod trace;
pub mod verify;

pub use config::Config;
pub use service::{KIND, RunError, check, run, topics};
