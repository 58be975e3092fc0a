//! `dinrail up` and `dinrail demo`.

use super::check::report;
use crate::stackfile::{self, LoadError, Loaded};
use crate::stacks;
use crate::supervise::{self, Options};
use anyhow::Context as _;
use ipc_types::units::Span;
use std::path::Path;
use std::process::ExitCode;

/// Name of the ready stack that `demo` runs.
const DEMO: &str = "canopen-io";
/// Text of its tour, with places for the executable and the folder.
const TOUR: &str = include_str!("demo_tour.txt");

/// Starts the stack of a file and runs it until it ends.
pub fn up(path: &Path, duration: Option<Span>, json: bool) -> anyhow::Result<ExitCode> {
    let loaded = load(path)?;
    let options =
        Options { duration: duration.map(|d| d.duration()), progress: duration.is_some(), json, tour: None };
    run(loaded, &options)
}

/// Starts the built-in demo in a folder of its own, where its recordings go as well. Files that are there already
/// stay as they are, so that changes made on the tour last.
pub fn demo(dir: &Path, duration: Option<Span>, json: bool) -> anyhow::Result<ExitCode> {
    let ready = stacks::find(DEMO).context("this build has no demo stack inside")?;
    if dir.join("stack.toml").exists() {
        eprintln!("using {} as it is; remove the folder to begin anew", dir.display());
    } else {
        ready.write_to(dir)?;
    }
    let loaded = load(dir)?;
    let tour = (!json).then(|| paste_ready(TOUR, dir));
    let options = Options { duration: duration.map(|d| d.duration()), progress: true, json, tour };
    run(loaded, &options)
}

/// The tour with this executable's path and the demo's folder in its commands, as typed from here.
fn paste_ready(text: &str, dir: &Path) -> String {
    let exe = std::env::current_exe().unwrap_or_else(|_| "dinrail".into());
    let here = std::env::current_dir().unwrap_or_default();
    let shown =
        exe.strip_prefix(&here).map_or_else(|_| exe.display().to_string(), |p| format!("./{}", p.display()));
    text.replace("{dinrail}", &shown).replace("{folder}", &dir.display().to_string())
}

fn load(path: &Path) -> anyhow::Result<Loaded> {
    match stackfile::load(path) {
        Ok(loaded) => {
            report(&loaded.findings);
            Ok(loaded)
        }
        Err(LoadError { findings }) => {
            report(&findings);
            anyhow::bail!("{}: the stack is not started", path.display());
        }
    }
}

fn run(loaded: Loaded, options: &Options) -> anyhow::Result<ExitCode> {
    let outcome = supervise::run(loaded, options)?;
    Ok(ExitCode::from(outcome.exit_code()))
}
