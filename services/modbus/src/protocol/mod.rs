//! Modbus codecs: bytes in, values out, and back.
//!
//! Nothing in here knows a clock, a socket, the rail or a register map, and nothing in here allocates or
//! panics whatever the bytes are. [`pdu`] is the protocol data unit every transport shares, [`mbap`] the
//! framing on a TCP stream. Sources: "MODBUS Application Protocol Specification V1.1b3" (26 April 2012),
//! cited as V1.1b3, and "MODBUS Messaging on TCP/IP Implementation Guide V1.0b" (24 October 2006), cited as
//! Guide V1.0b.

pub mod mbap;
pub mod pdu;
mod reply;
mod wire;

pub use reply::{Response, ResponseError, decode_response, encode_response};
