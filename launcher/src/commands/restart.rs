//! `dinrail restart SERVICE`.

use crate::cli::Which;
use crate::supervise::client::{Client, find};
use crate::supervise::control::{Reply, Request};
use std::time::Duration;

/// Ends one process and returns when its successor is ready.
pub fn run(service: &str, which: &Which, json: bool) -> anyhow::Result<()> {
    let mut client = Client::connect(find(which.stack.as_deref())?)?;
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
