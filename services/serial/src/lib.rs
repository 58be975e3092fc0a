//! The serial port driver: one process a port.

pub mod protocol;
