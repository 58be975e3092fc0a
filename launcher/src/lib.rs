//! The launcher of `dinrail`: starts a stack of gateway services, keeps it alive, and is every command around it.
//!
//! [`stackfile`] reads and checks stack files, `supervise` runs them, `kinds` knows the services of this build,
//! `stacks` the ready stacks inside the executable, `commands` is one module a command. It is a library so that
//! fuzzing and other tools read stack files as the executable does; everything else is private to it.
//!
//! Exit codes: 0 done, 1 failed, 2 wrong usage, 3 done but with data loss. Results go to stdout, diagnostics to
//! stderr.

/// As that of the standard library, but text from files and the wire cannot steer the terminal, and a stderr that is gone
/// is no panic.
macro_rules! eprintln {
    ($($text:tt)*) => { $crate::terminal::say(&format!($($text)*)) };
}

mod cli;
mod commands;
mod explain_keys;
mod kinds;
pub mod stackfile;
mod stacks;
mod supervise;
mod terminal;

use clap::Parser;
use std::process::ExitCode;

/// The executable: reads the command line and does what it says.
pub fn main() -> ExitCode {
    supervise::sys::give_large_memory_back();
    commands::run(cli::Cli::parse())
}
