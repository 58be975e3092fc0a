//! The CANopen protocol, sans-I/O: frames and time in, frames and events out. No clock, socket, rail, randomness
//! or global in here. Times are `t_ns: u64` of one monotonic clock that the caller chooses.

pub mod io;
