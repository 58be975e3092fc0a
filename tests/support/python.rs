//! A python with the pinned peers of `tests/peers/requirements.txt`, in a virtual environment of the project's own
//! that is made once. Stands alone: the tests of single crates include it by path.
#![allow(dead_code, clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use std::fs;
use std::path::PathBuf;
use std::process::Command;
use std::sync::OnceLock;

static PYTHON: OnceLock<Result<PathBuf, String>> = OnceLock::new();

/// Says loudly that a test does not run; with DINRAIL_NO_SKIP=1 that is a failure.
pub fn skip(why: &str) {
    assert!(std::env::var_os("DINRAIL_NO_SKIP").is_none(), "must not skip here: {why}");
    eprintln!("\n*** SKIPPED: {why}\n");
}

/// The python, or `None` after saying loudly that the test is skipped.
pub fn python() -> Option<PathBuf> {
    match PYTHON.get_or_init(make) {
        Ok(python) => Some(python.clone()),
        Err(why) => {
            skip(why);
            None
        }
    }
}

fn make() -> Result<PathBuf, String> {
    let wanted = include_str!("../peers/requirements.txt");
    // target/release/deps/THIS
    let own = std::env::current_exe().map_err(|e| e.to_string())?;
    let target = own.ancestors().nth(3).ok_or("no target directory")?;
    let dir = target.join("peers");
    let python = dir.join("bin/python");
    let done = dir.join("requirements.done");
    fs::create_dir_all(target).map_err(|e| e.to_string())?;
    // Test programs run at the same time: one makes it, the others wait.
    let lock = fs::File::create(target.join("peers.lock")).map_err(|e| e.to_string())?;
    lock.lock().map_err(|e| e.to_string())?;
    if fs::read_to_string(&done).is_ok_and(|text| text == wanted) {
        return Ok(python);
    }
    let _ = fs::remove_dir_all(&dir);
    let run = |command: &mut Command| match command.output() {
        Ok(output) if output.status.success() => Ok(()),
        Ok(output) => Err(format!("{command:?}: {}", String::from_utf8_lossy(&output.stderr))),
        Err(e) => Err(format!("{command:?}: {e}")),
    };
    run(Command::new("python3").arg("-m").arg("venv").arg(&dir))?;
    let requirements = dir.join("requirements.txt");
    fs::write(&requirements, wanted).map_err(|e| e.to_string())?;
    run(Command::new(&python)
        .args(["-m", "pip", "install", "-q", "--disable-pip-version-check", "-r"])
        .arg(&requirements))?;
    fs::write(&done, wanted).map_err(|e| e.to_string())?;
    Ok(python)
}
