//! Faults on demand, for the fault isolation tests: only with `DINRAIL_INJECT=1` in the environment.
//!
//! Some ways to die cannot be caused from outside by a plain signal. Real-time signals stand for them here:
//! SIGRTMIN+1 panics in a helper thread, +2 exits with code 0 without a word, +3 takes away all descriptors.

use ipc_types::reactor::signals;
use rustix::event::{PollFd, PollFlags, poll};
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
use std::os::fd::OwnedFd;

/// glibc's SIGRTMIN: the first two real-time signals are its own.
const SIGRTMIN: i32 = 34;
const PANIC: i32 = SIGRTMIN + 1;
const EXIT_ZERO: i32 = SIGRTMIN + 2;
const DESCRIPTORS: i32 = SIGRTMIN + 3;

/// Arms the injected faults, when the environment asks for them. Before any thread exists.
pub fn arm() -> anyhow::Result<()> {
    if std::env::var_os("DINRAIL_INJECT").is_none_or(|value| value != "1") {
        return Ok(());
    }
    let fd = signals::descriptor(&[PANIC, EXIT_ZERO, DESCRIPTORS])?;
    tracing::warn!("DINRAIL_INJECT=1: this process fails on demand");
    std::thread::Builder::new().name("inject".into()).spawn(move || wait(&fd))?;
    Ok(())
}

#[allow(clippy::panic, reason = "this is the fault that is asked for")]
fn wait(fd: &OwnedFd) {
    loop {
        let mut fds = [PollFd::new(fd, PollFlags::IN)];
        if poll(&mut fds, None).is_err() {
            continue;
        }
        match signals::take(fd) {
            Some(PANIC) => panic!("injected panic"),
            Some(EXIT_ZERO) => std::process::exit(0),
            Some(DESCRIPTORS) => exhaust(),
            _ => {}
        }
    }
}

/// No new descriptor can be opened from now on.
fn exhaust() {
    let limit = getrlimit(Resource::Nofile);
    if let Err(e) = setrlimit(Resource::Nofile, Rlimit { current: Some(0), maximum: limit.maximum }) {
        tracing::warn!("injected descriptor exhaustion: {e}");
    }
}
