//! The role of the slave: a device whose objects are ranges of the process image, or a simulated one. Sans-I/O.

pub mod image_map;
pub mod simulation;
