//! `dinrail logs`.

use crate::cli::Which;
use crate::supervise::client::{Client, find};
use crate::supervise::control::{Reply, Request};
use crate::supervise::logbook;
use std::time::Duration;

/// Prints the last lines of one service or of all; with `follow` goes on until the stack ends or Ctrl-C.
pub fn run(service: Option<&str>, lines: u32, follow: bool, which: &Which, json: bool) -> anyhow::Result<()> {
    let mut client = Client::connect(find(which.stack.as_deref())?)?;
    client.ask(&Request::Logs { service: service.map(str::to_owned), lines, follow })?;
    let limit = (!follow).then(|| Duration::from_secs(10));
    while let Some(reply) = client.next(limit)? {
        match reply {
            Reply::Log(line) if json => super::println(&serde_json::to_string(&line)?),
            Reply::Log(line) => {
                super::println(&format!(
                    "{} {:<10} | {}",
                    logbook::clock(line.utc_ns),
                    line.service,
                    line.line
                ));
            }
            _ => break,
        }
    }
    Ok(())
}
