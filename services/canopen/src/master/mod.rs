//! The role of the master: what it does on top of the protocol, sans-I/O.

pub mod boot;
pub mod exchange;
pub mod network;
pub mod plan;
#[cfg(test)]
mod testing;
pub mod transfers;
