//! `dinrail down`.

use crate::cli::Which;
use crate::supervise::client::{Client, find};
use crate::supervise::control::Request;
use anyhow::Context as _;
use std::time::Duration;

/// Every service may take its `stop_timeout`; then the launcher kills it.
const LIMIT: Duration = Duration::from_mins(1);

/// Stops a stack and returns when nothing of it is left.
pub fn run(which: &Which, json: bool) -> anyhow::Result<()> {
    let stack = find(which.stack.as_deref())?;
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
