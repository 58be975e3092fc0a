//! The CANopen protocol, sans-I/O: frames and time in, frames and events out. No clock, socket, rail, randomness
//! or global in here. Times are `t_ns: u64` of one monotonic clock that the caller chooses.

pub mod abort;
pub mod cob_id;
pub mod data_type;
pub mod eds;
pub mod emcy;
pub mod error_control;
pub mod io;
pub mod lss;
pub mod nmt;
pub mod node;
pub mod od;
pub mod pdo;
pub mod sdo;
pub mod store;
pub mod sync;
pub mod time_stamp;
