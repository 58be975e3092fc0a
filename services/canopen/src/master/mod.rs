//! The role of the master: what it does on top of the protocol, sans-I/O.

pub mod boot;
pub mod exchange;
pub mod lss;
pub mod network;
#[cfg(test)]
mod pdo_tests;
pub mod plan;
#[cfg(test)]
pub(crate) mod testing;
pub mod transfers;
