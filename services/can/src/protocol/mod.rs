//! Sans-I/O codecs of the CAN driver: bytes and time in, frames and bytes out.
//!
//! Nothing in here owns a socket, reads a clock, allocates per frame or knows the rail. The same code serves
//! the live driver, the command line, replay and the tests.

pub mod asc;
pub mod busload;
pub mod candump;
pub mod cannelloni;
mod civil;
pub mod error_frame;
pub mod frame;
mod hex;
pub mod logfile;
pub mod peer;
pub mod slcan;
pub mod slcan_client;
pub mod socketcand;
pub mod socketcand_client;

pub use frame::{Frame, FrameError};
