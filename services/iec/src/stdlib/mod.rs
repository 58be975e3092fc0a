//! The standard function blocks: written in ST and compiled like any other source.

/// Name of the library in diagnostics and places.
pub const NAME: &str = "<standard library>";
/// Its text.
pub const PRELUDE: &str = include_str!("prelude.st");
