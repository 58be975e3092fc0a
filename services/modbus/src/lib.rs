//! Modbus server for dinrail: TCP clients on one side, the process image of a PLC on the other.
//!
//! Three storeys, imports only downwards:
//!
//! 1. [`protocol`]: PDU and MBAP codecs. Bytes in, values out.
//! 2. [`server`]: one request, one answer, on any [`server::Image`]; [`map`]: registers as bits and bytes of the
//!    process image; [`session`]: one connection, sans-I/O.
//! 3. [`tcp`]: connections on tokio; [`service`]: the rail, the configuration and the loop.
//!
//! What may never happen here: a panic or an allocation that a client can cause, a partly applied write, an
//! answer from an image that is too old to be true.

pub mod address;
pub mod map;
pub mod map_config;
pub mod protocol;
pub mod server;
pub mod session;
pub mod tcp;
pub mod write_set;
