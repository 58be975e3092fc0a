//! Sans-I/O core: bits of frames to values of the process image and back.

pub mod signal;
pub mod value;
