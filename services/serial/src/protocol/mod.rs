//! Bytes and time in, frames and actions out: no clock, no port, no rail.
//!
//! [`framer`] finds frames in what is received, [`sender`] says when what is to be sent may go out, [`echo`] removes
//! our own bytes that come back on RS-485, [`parmrk`] takes the kernel's marks of damaged bytes out of the stream,
//! [`pacer`] gives bytes of a pseudo-terminal the time they would take on a line. All memory is reserved beforehand.

pub mod answer;
pub mod crc;
pub mod echo;
pub mod framer;
pub mod length;
pub mod pacer;
pub mod parmrk;
pub mod rtu;
pub mod sender;
pub mod timing;

#[cfg(test)]
mod framer_tests;
#[cfg(test)]
mod sender_tests;
