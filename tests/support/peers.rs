//! Foreign programs: python scripts in the project's own environment, and programs of the system.

use super::python::python;
use super::skip;
use std::path::Path;
use std::process::Command;

/// A command that runs one of `tests/peers/*.py`.
pub fn peer(script: &str) -> Option<Command> {
    let mut command = Command::new(python()?);
    command.arg("-u").arg(Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/peers").join(script));
    Some(command)
}

/// A program of the system, or `None` after saying loudly that the test is skipped.
pub fn program(name: &str, package: &str) -> Option<Command> {
    let found = std::env::var_os("PATH")
        .is_some_and(|path| std::env::split_paths(&path).any(|dir| dir.join(name).is_file()));
    if found {
        return Some(Command::new(name));
    }
    skip(&format!("no {name} here: apt-get install {package}"));
    None
}
