//! Foreign programs: a virtual environment of the project's own with pinned packages, made once.

use super::skip;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

static PYTHON: OnceLock<Result<PathBuf, String>> = OnceLock::new();

/// A python with the pinned peers, or `None` after saying loudly that the test is skipped.
pub fn python() -> Option<PathBuf> {
    match PYTHON.get_or_init(make) {
        Ok(python) => Some(python.clone()),
        Err(why) => {
            skip(why);
            None
        }
    }
}

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

fn make() -> Result<PathBuf, String> {
    let wanted = include_str!("../peers/requirements.txt");
    let target = Path::new(env!("CARGO_BIN_EXE_dinrail")).ancestors().nth(2).ok_or("no target directory")?;
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
    run(Command::new(&python).args(["-m", "pip", "install", "-q", "--disable-pip-version-check", "-r"]).arg(&requirements))?;
    fs::write(&done, wanted).map_err(|e| e.to_string())?;
    Ok(python)
}
