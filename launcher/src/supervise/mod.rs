//! Runs a stack: prepares its ground, starts its services, keeps them alive, stops them, removes every trace.
//!
//! | module | what |
//! |---|---|
//! | [`policy`] | when to start, kill, restart, hold: sans-I/O |
//! | [`supervisor`] | the loop that does what the policy decides |
//! | [`rail_thread`], [`outbox`], [`watch`] | the launcher's place on the rail, in a thread of its own |
//! | [`ground`], [`state_dir`] | shared memory, listeners, RETAIN memory, the lock of a running stack |
//! | [`child`], [`service_main`] | a process, seen from the launcher and from within |
//! | [`debris`] | what processes leave that are killed while they start |
//! | [`control`], [`logbook`], [`console`], [`notify`], [`hardware`] | how it is seen from outside |
//!
//! What may never happen here: the main thread waiting for the middleware, a terminal, a client, a service or a
//! file other than `/proc`; a process started before every topic and listener exists; a path wiped without the
//! stack's lock.

pub mod child;
pub mod client;
pub mod console;
pub mod control;
pub mod debris;
pub mod ground;
pub mod hardware;
pub mod inject;
pub mod jobs;
pub mod logbook;
pub mod notify;
pub mod outbox;
pub mod policy;
pub mod rail_thread;
pub mod report;
pub mod service_main;
pub mod state_dir;
pub mod supervisor;
pub mod sys;
pub mod watch;

#[cfg(test)]
mod policy_tests;

use crate::stackfile::Loaded;
use child::Executable;
use ground::GroundError;
use ipc_types::clock;
use ipc_types::reactor::signals;
use rail_thread::{RailHandle, Report};
use state_dir::{LockError, RunningStack, StackLock};
use std::io::{self, Write as _};
use std::net::TcpListener;
use std::os::fd::OwnedFd;
use std::time::Duration;
use supervisor::Supervisor;

/// Making every topic of a stack takes milliseconds; so long means that the middleware hangs.
const RAIL_START_LIMIT: Duration = Duration::from_secs(30);

/// How to run a stack.
#[derive(Debug, Clone, Default)]
pub struct Options {
    /// Stop after so long.
    pub duration: Option<Duration>,
    /// One line a second about what the stack does.
    pub progress: bool,
    /// Results as JSON lines.
    pub json: bool,
    /// Printed once everything is ready.
    pub tour: Option<String>,
}

/// Why a stack could not be started.
#[derive(Debug, thiserror::Error)]
pub enum UpError {
    #[error(transparent)]
    Lock(#[from] LockError),
    #[error(transparent)]
    Ground(#[from] GroundError),
    #[error("the rail could not be made: {0}")]
    Rail(String),
    #[error("launcher: {what}: {source}")]
    System { what: &'static str, source: io::Error },
}

/// How a stack ended.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Outcome {
    /// Why it failed.
    pub failed: Option<String>,
    /// Services that were down at the end.
    pub held: Vec<String>,
    /// Services that were degraded when they last spoke at work. Told, but no fault: a line may be unplugged for good reason.
    pub degraded: Vec<String>,
    /// What the recorders lost.
    pub losses: Vec<String>,
}

impl Outcome {
    /// 0 healthy, 1 failed or a service was held, 3 healthy but with data loss.
    pub fn exit_code(&self) -> u8 {
        if self.failed.is_some() || !self.held.is_empty() {
            1
        } else if self.losses.is_empty() {
            0
        } else {
            3
        }
    }
}

/// The listeners of one service; `None` while they are closed.
pub type Listeners = Vec<(String, Option<TcpListener>)>;

fn system(what: &'static str) -> impl Fn(io::Error) -> UpError {
    move |source| UpError::System { what, source }
}

/// Runs a stack until it is stopped, has failed, or its time is over. Call from the main thread, before any
/// other thread exists.
pub fn run(loaded: Loaded, options: &Options) -> Result<Outcome, UpError> {
    let Loaded { stack, launch, settings, .. } = loaded;
    sys::keep_descriptors_private();
    sys::hear_of_children();
    let executable = Executable::own().map_err(system("opening its own executable"))?;
    let stop_signals = supervisor::stop_signals();
    let signal_fd = signals::descriptor(&stop_signals).map_err(system("signals"))?;
    let _lock = StackLock::take(&RunningStack {
        stack: stack.name.clone(),
        pid: std::process::id(),
        root: stack.root.clone(),
        since_utc_ns: clock::utc_ns(),
        file: stack.file.clone(),
    })?;
    ground::raise_descriptor_limit();
    let hardware = settings.watchdog.as_deref().map(hardware::Watchdog::open).transpose();
    let hardware = hardware.map_err(system("opening the hardware watchdog"))?;
    // Sockets first: the likeliest refusal, and nothing has to be undone after it.
    let mut listeners: Vec<Listeners> = Vec::new();
    let mut retain: Vec<Option<OwnedFd>> = Vec::new();
    for service in &stack.services {
        let mut own = Vec::new();
        for listener in &service.wiring.listeners {
            own.push((listener.name.clone(), Some(ground::listen(&service.name, listener)?)));
        }
        listeners.push(own);
        let bytes = service.wiring.retain_bytes;
        retain.push((bytes > 0).then(|| ground::retain_memory(&service.name, bytes)).transpose()?);
    }
    ground::prepare(&stack)?;
    let wipe = Wipe { root: stack.root.clone(), prefix: stack.prefix.clone() };
    let rail = RailHandle::start(stack.clone(), options.progress).map_err(system("starting a thread"))?;
    match rail.reports.recv_timeout(RAIL_START_LIMIT) {
        Ok(Report::Up) => {}
        Ok(Report::Failed(cause)) => return Err(UpError::Rail(cause)),
        Ok(other) => return Err(UpError::Rail(format!("unexpected {other:?}"))),
        Err(_) => return Err(UpError::Rail(format!("no answer within {} s", RAIL_START_LIMIT.as_secs()))),
    }
    let parts = supervisor::Parts {
        stack,
        launch,
        settings,
        executable,
        signal_fd,
        listeners,
        retain,
        rail,
        hardware,
    };
    let outcome = Supervisor::new(parts, options).map_err(system("setting up supervision"))?.run();
    drop(wipe);
    outcome.map_err(system("waiting for events"))
}

/// Removes the stack's shared memory, also when the start fails half-way.
struct Wipe {
    root: std::path::PathBuf,
    prefix: String,
}

impl Drop for Wipe {
    fn drop(&mut self) {
        if let Err(e) = ground::wipe(&self.root, &self.prefix) {
            // Not `eprintln!`: it panics when nobody reads any more.
            let _ = writeln!(io::stderr(), "dinrail: {e}");
        }
    }
}
