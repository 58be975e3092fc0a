//! Tests of the whole compiler: text in, behaviour of the module out.

mod cases;
mod diagnostics;
mod host;
mod limits;
mod map;
mod operators;
mod random;
mod statements;
