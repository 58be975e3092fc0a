//! Modbus for dinrail: a server that shows the process image of a PLC to clients on TCP and serial lines.
//!
//! Three storeys, imports only downwards:
//!
//! 1. [`protocol`]: PDU, MBAP, RTU and ASCII codecs. Bytes in, values out.
//! 2. [`server`]: one request, one answer, on any [`server::Image`]; [`device`]: units and what they may be asked;
//!    [`session`] and [`line`]: one connection without its socket, one serial line without its port; [`map`],
//!    [`buffers`], [`view`], [`watchdog`], [`process_image`]: registers as bits and bytes of the PLC's image.
//!    No clock, socket or rail; time and messages are handed in.
//! 3. [`tcp`]: connections on tokio; [`service`]: ports, configuration, loop.
//!
//! What may never happen here: a panic or an allocation that a client can cause by a request, a write that is
//! applied in part, an answer from an image that is too old to be true.

pub mod admission;
pub mod buffers;
pub mod client;
pub mod config;
pub mod device;
pub mod gateway;
pub mod identity;
pub mod line;
pub mod line_state;
pub mod map;
pub mod map_config;
pub mod process;
pub mod process_image;
pub mod protocol;
mod readable;
pub mod rights;
pub mod server;
pub mod service;
pub mod session;
pub mod stream;
pub mod tcp;
#[cfg(test)]
mod testing;
pub mod view;
mod visits;
pub mod watchdog;
pub mod write_set;

pub use config::Config;
pub use service::{ServiceError, check, run, topics};
