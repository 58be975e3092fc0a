//! CANopen for dinrail: master and slave.
//!
//! Storeys, imports only downwards: [`protocol`] the machines of CiA 301, 302-2 and 305, sans-I/O; the roles on it;
//! the services on the rail.

pub mod config;
pub mod master;
pub mod protocol;
pub mod service;
