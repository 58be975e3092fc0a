//! SDO: access to the object dictionary of another node (CiA 301 V4.2, 7.2.4).
//!
//! [`SdoServer`] is one channel of a device, [`SdoServers`] all of them; [`SdoClient`] is one channel of a client
//! with one transfer at a time. All are sans-I/O: a frame or a time in, frames into the outbox. After they were
//! made, nothing allocates but the start of a transfer by the client that is larger than any before.
//!
//! What no end can know: a segmented transfer has one toggle bit and no check sum. Frames that a broken network
//! repeats much later or puts into another order can go unseen there; block transfer with CRC sees them. And an
//! answer that comes after the client's timeout cannot be told from the answer to the next request for the same
//! object: the timeout has to be longer than the network's delay.

mod block;
mod channel;
mod client;
mod crc;
mod frame;
mod server;
mod servers;
#[cfg(test)]
mod tests;
mod transfer;

pub use channel::{Channel, client_channel, server_channel, validate_parameter};
pub use client::SdoClient;
pub use crc::crc16;
pub use server::{SdoServer, ServerConfig, ServerCounters};
pub use servers::SdoServers;
pub use transfer::{Busy, By, ClientConfig, ClientCounters, Direction, Failure, Finished, Mode, Options};
