//! Tests of the whole compiler: text in, behaviour of the module out.

// Helpers of tests, too, stop at what should not happen.
#![allow(clippy::unwrap_used, clippy::panic, clippy::enum_glob_use)]

mod cases;
mod diagnostics;
mod differential;
mod host;
mod limits;
mod map;
mod operators;
mod programs;
mod random;

mod stages;
mod statements;
