//! Foreign programs in C of `tests/peers`, compiled against the system's libmodbus.

use super::{Scratch, peers, skip};
use std::path::{Path, PathBuf};
use std::process::Command;

/// Compiles `tests/peers/NAME.c`; `None` after saying loudly that the test is skipped.
pub fn compiled(name: &str, into: &Scratch) -> Option<PathBuf> {
    let flags =
        peers::program("pkg-config", "pkg-config")?.args(["--cflags", "--libs", "libmodbus"]).output();
    let flags = flags.unwrap();
    if !flags.status.success() {
        skip("no libmodbus here: apt-get install libmodbus-dev");
        return None;
    }
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/peers").join(format!("{name}.c"));
    let program = into.0.join(name);
    let built = Command::new("gcc")
        .args(["-O2", "-Wall", "-Werror"])
        .args([source.as_path(), Path::new("-o"), program.as_path()])
        .args(String::from_utf8(flags.stdout).unwrap().split_whitespace())
        .output()
        .unwrap();
    assert!(built.status.success(), "{}", String::from_utf8_lossy(&built.stderr));
    Some(program)
}
