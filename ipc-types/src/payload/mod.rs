//! The messages of the rail.
//!
//! Every message is a header, a `#[repr(C)]` struct without padding, and where the header ends with `n: u32` a
//! tail of that many bytes. In shared memory the header is the sample's user header and the tail its payload;
//! in a recording both stand one behind the other, which is exactly ROS 1's packed little-endian encoding of
//! the `ros1msg` text that [`Payload::ros1msg`] generates from the same struct. All integers are little-endian;
//! dinrail runs on little-endian machines only (compile-time check).
//!
//! The first member of every header is [`Stamp`].
//!
//! `unsafe` here: the `payload!` macro writes the `unsafe impl`s that iceoryx2 asks for, with compile-time proofs.
#![allow(unsafe_code)]

mod frame;
mod image;
mod plumbing;
mod service;

pub use frame::{CHUNK_BYTES, CanFrame, SerialChunk, can_flag, fd_flag, id_flag, serial_flag};
pub use image::{
    AckEntry, Image, ImageWrite, Inputs, MAX_ACKS, PART_BYTES, PlcState, Quality, ScanPart, acks,
};
pub use plumbing::{Encoding, Payload, Stamp, as_bytes, from_bytes};
pub use service::{Event, Health, HealthState, Job, JobResult, Status, event_flag};

use plumbing::payload;
#[cfg(target_endian = "big")]
compile_error!("dinrail's recorded formats are the bytes of memory: little-endian machines only");
