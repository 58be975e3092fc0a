//! `dinrail restart SERVICE`.

use crate::cli::Which;
use crate::supervise::client::{Client, find};
use crate::supervise::control::{Reply, Request};
use crate::supervise::state_dir::RunningStack;
use std::time::Duration;

/// Whether the stack file is another than the one that runs.
fn edited(stack: &RunningStack) -> bool {
    let now = std::fs::read_to_string(&stack.file);
    let then = ipc_types::context::load(&stack.root);
    matches!((now, then), (Ok(now), Ok(then)) if now != then.text)
}

/// Ends one process and returns when its successor is ready.
pub fn run(service: &str, which: &Which, json: bool) -> anyhow::Result<()> {
    let stack = find(which.stack.as_deref())?;
    if edited(&stack) {
        eprintln!(
            "note: {} has changed since `up`; a restarted service has the old configuration: `dinrail down`, then `up`",
            stack.file.display()
        );
    }
    let mut client = Client::connect(stack)?;
    let request = Request::Restart { service: service.to_owned() };
    let reply = client.call(&request, Duration::from_secs(30))?;
    let Reply::Restarted { service, generation, after_ms } = reply else {
        anyhow::bail!("the launcher gave another answer than asked for; is it of another version?");
    };
    if json {
        let value = serde_json::json!({ "service": service, "generation": generation, "after_ms": after_ms });
        super::println(&value.to_string());
    } else {
        super::println(&format!("{service} is ready again after {after_ms} ms, generation {generation}"));
    }
    Ok(())
}
