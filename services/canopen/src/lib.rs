//! CANopen master and slave.
