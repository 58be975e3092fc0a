//! Modbus codecs: bytes in, values out, and back.
//!
//! Nothing in here knows a clock, a socket, the rail or a register map, and nothing in here allocates (but for two
//! helpers of clients in [`files`]) or panics whatever the bytes are. [`pdu`] is the protocol data unit every
//! transport shares, [`mbap`] the framing on a TCP stream, [`rtu`] and [`ascii`] those on a serial line. Sources:
//! "MODBUS Application Protocol Specification V1.1b3" (26 April 2012), cited as V1.1b3, "MODBUS Messaging on TCP/IP
//! Implementation Guide V1.0b" (24 October 2006), cited as Guide V1.0b, and "MODBUS over serial line V1.02"
//! (20 December 2006), cited as V1.02.

pub mod ascii;
pub mod client_fit;
pub mod diagnostics;
pub mod files;
pub mod identification;
pub mod mbap;
pub mod pdu;
mod reply;
pub mod rtu;
mod wire;

pub use reply::{MAX_EVENTS, Response, ResponseError, decode_response, encode_response};
