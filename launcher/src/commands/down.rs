//! `dinrail down`.

use crate::cli::Which;
use crate::supervise::client::{Client, ClientError, find};
use crate::supervise::control::Request;
use crate::supervise::ground::clear;
use crate::supervise::state_dir::{self, RunningStack, StackLock};
use anyhow::Context as _;
use ipc_types::rail;
use std::time::Duration;

/// Every service may take its `stop_timeout`; then the launcher kills it.
const LIMIT: Duration = Duration::from_mins(1);

/// No such stack runs: removes what one left whose launcher was killed, or says that there is none.
fn clear_left(name: Option<&str>, none: ClientError, json: bool) -> anyhow::Result<()> {
    let named = |state: &RunningStack| match (&none, name) {
        (ClientError::NoneRunning, None) => true,
        (ClientError::NotThisNorAny(_) | ClientError::NotRunning { .. }, Some(name)) => state.stack == name,
        _ => false,
    };
    let left: Vec<RunningStack> = state_dir::left_behind().into_iter().filter(named).collect();
    if left.is_empty() {
        return Err(none.into());
    }
    for state in left {
        // The same names as `up` would give: a file cannot lead elsewhere.
        let (root, prefix) = rail::place(rustix::process::getuid().as_raw(), &state.stack);
        let _lock = StackLock::take(&state)?;
        clear(&root, &prefix)?;
        if json {
            let value = serde_json::json!({ "stack": state.stack, "pid": state.pid, "state": "cleared" });
            super::println(&value.to_string());
        } else {
            super::println(&format!(
                "stack '{}' was not running: its launcher, pid {}, was killed; what it left is removed",
                state.stack, state.pid
            ));
        }
    }
    Ok(())
}

/// Stops a stack and returns when nothing of it is left.
pub fn run(which: &Which, json: bool) -> anyhow::Result<()> {
    let stack = match find(which.stack.as_deref()) {
        Ok(stack) => stack,
        Err(e) => return clear_left(which.stack.as_deref(), e, json),
    };
    let (name, pid) = (stack.stack.clone(), stack.pid);
    let launcher = rustix::process::Pid::from_raw(pid as i32)
        .and_then(|p| rustix::process::pidfd_open(p, rustix::process::PidfdFlags::empty()).ok());
    let mut client = Client::connect(stack)?;
    client.call(&Request::Down {}, Duration::from_secs(10))?;
    // The connection closes a moment before the launcher has removed its last file: wait for its end itself.
    while client.next(Some(LIMIT))?.is_some() {}
    if let Some(launcher) = launcher {
        let mut fds = [rustix::event::PollFd::new(&launcher, rustix::event::PollFlags::IN)];
        let limit = rustix::event::Timespec { tv_sec: 10, tv_nsec: 0 };
        let ended = rustix::event::poll(&mut fds, Some(&limit)).context("waiting for the launcher")?;
        anyhow::ensure!(ended > 0, "stack '{name}' has ended, but its launcher, pid {pid}, has not");
    }
    if json {
        super::println(&serde_json::json!({ "stack": name, "pid": pid, "state": "down" }).to_string());
    } else {
        super::println(&format!("stack '{name}' is down"));
    }
    Ok(())
}
