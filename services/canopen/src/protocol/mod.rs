//! The CANopen protocol, sans-I/O: frames and time in, frames and events out. No clock, socket, rail, randomness
//! or global in here. Times are `t_ns: u64` of one monotonic clock that the caller chooses.

pub mod abort;
pub mod cob_id;
pub mod data_type;
pub mod io;
pub mod nmt;
pub mod od;
pub mod sdo;
