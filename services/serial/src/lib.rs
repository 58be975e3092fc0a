//! The serial port driver: one process a port.
//!
//! It owns the port: it finds frames in what is received by real time, puts them in one true order on `<serial>/rx`
//! together with the echoes of what was sent, and sends what the stack puts on `<serial>/tx` when the line is free. It
//! must never interpret a frame beyond its end and its CRC, never wait for a reader, and never die of a port that is
//! unplugged.
//!
//! Storeys: [`protocol`] bytes and time, sans-I/O; [`dialog`] recorded dialogs, sans-I/O; [`sys`], [`character`],
//! [`device`], [`port`] and [`list`] the system; [`driver`] a port with all of it; [`config`] and the functions below the service on the rail.

pub mod character;
pub mod config;
pub mod device;
pub mod dialog;
mod doubt;
pub mod driver;
pub mod list;
pub mod port;
pub mod protocol;
mod service;
pub mod sys;

pub use config::{Config, check};
pub use service::{RunError, run, topics};
