//! CANopen for dinrail: master and slave.
//!
//! Storeys, imports only downwards: [`protocol`] the machines of CiA 301, 305 and 306, sans-I/O; [`master`] and
//! [`slave`] the roles on it, sans-I/O; [`service`] the services on the rail.
//!
//! What may never happen here: a panic or a stuck state by a frame, a file or a program; a PDO torn between two images;
//! a running network stopped because its master was restarted.

pub mod config;
pub mod device;
pub mod master;
pub mod mistakes;
pub mod place;
pub mod protocol;
pub mod service;
pub mod slave;
