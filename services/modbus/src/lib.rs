//! Modbus server for dinrail: TCP clients on one side, the process image of a PLC on the other.
//!
//! Three storeys, imports only downwards:
//!
//! 1. [`protocol`]: PDU and MBAP codecs. Bytes in, values out.
//! 2. [`server`]: one request, one answer, on any [`server::Image`]; [`session`]: one connection without its
//!    socket; [`map`], [`view`], [`watchdog`], [`process_image`]: registers as bits and bytes of the PLC's image.
//!    No clock, socket or rail; time and messages are handed in.
//! 3. [`tcp`]: connections on tokio; [`service`]: ports, configuration, loop.
//!
//! What may never happen here: a panic or an allocation that a client can cause by a request, a write that is
//! applied in part, an answer from an image that is too old to be true.

pub mod config;
pub mod map;
pub mod map_config;
pub mod process_image;
pub mod protocol;
mod readable;
pub mod server;
pub mod service;
pub mod session;
pub mod tcp;
#[cfg(test)]
mod testing;
pub mod view;
pub mod watchdog;
pub mod write_set;

pub use config::Config;
pub use service::{ServiceError, check, run, topics};
