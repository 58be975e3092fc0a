//! `dinrail modbus clients`, `enable` and `disable`: a modbus-server of a running stack.

use crate::cli::Which;
use crate::commands::{println, table};
use crate::supervise::client::{find, observe};
use crate::supervise::jobs::{JobLine, choose};
use crate::supervise::state_dir::RunningStack;
use clap::Args;
use ipc_types::Context;
use ipc_types::payload::Status;
use ipc_types::topic::TopicKind;
use serde_json::{Value, json};
use std::time::{Duration, Instant};

/// How long an answer or a status may take.
const LIMIT: Duration = Duration::from_secs(5);
const LOOK: Duration = Duration::from_millis(2);
const KIND: &str = "modbus-server";

/// Which server is meant.
#[derive(Debug, Clone, Args)]
pub struct ServerArgs {
    /// The modbus-server; not needed when the stack has only one
    #[arg(value_name = "SERVICE")]
    pub service: Option<String>,
    #[command(flatten)]
    pub which: Which,
}

/// Lists the clients that are connected now.
pub fn clients(args: &ServerArgs, json: bool) -> anyhow::Result<()> {
    let (ctx, _, service) = open(args)?;
    let status = status(&ctx, &service)?;
    let list = status.get("client_list").and_then(Value::as_array).cloned().unwrap_or_default();
    let count = status.get("clients").and_then(Value::as_u64).unwrap_or(0);
    if json {
        let shown = json!({ "service": service, "enabled": status["enabled"], "clients": count, "client_list": list });
        println(&serde_json::to_string_pretty(&shown)?);
        return Ok(());
    }
    crate::commands::print(&text(&list));
    if status.get("enabled") == Some(&Value::Bool(false)) {
        println(&format!("'{service}' is switched off; `dinrail modbus enable` switches it on"));
    }
    if count as usize > list.len() {
        println(&format!("{} more clients are not listed", count as usize - list.len()));
    }
    Ok(())
}

fn text(list: &[Value]) -> String {
    let head = ["ADDRESS", "PORT", "CONNECTED", "IDLE", "REQUESTS", "EXCEPTIONS", "UNIT", "FUNCTION"];
    let number = |row: &Value, key: &str| row.get(key).and_then(Value::as_u64).unwrap_or(0).to_string();
    let rows: Vec<Vec<String>> = list
        .iter()
        .map(|row| {
            vec![
                row.get("address").and_then(Value::as_str).unwrap_or("-").to_owned(),
                number(row, "port"),
                format!("{} s", number(row, "connected_s")),
                format!("{} s", number(row, "idle_s")),
                number(row, "requests"),
                number(row, "exceptions"),
                number(row, "last_unit"),
                number(row, "last_function"),
            ]
        })
        .collect();
    table(&head, &rows)
}

/// Switches a server on or off until the next command or its restart.
pub fn switch(args: &ServerArgs, on: bool, json: bool) -> anyhow::Result<()> {
    let (mut ctx, running, service) = open(args)?;
    let order = json!({ "do": if on { "enable" } else { "disable" } });
    JobLine::open(&mut ctx, running, KIND, &service)?.ask(&order, LIMIT)?;
    if json {
        println(&json!({ "service": service, "wanted": on }).to_string());
    } else {
        let state = if on { "on" } else { "off: it answers nobody" };
        println(&format!("'{service}' is switched {state}"));
    }
    Ok(())
}

fn open(args: &ServerArgs) -> anyhow::Result<(Context, RunningStack, String)> {
    let running = find(args.which.stack.as_deref())?;
    let ctx = observe(&running)?;
    let service = choose(&ctx, KIND, args.service.as_deref())?;
    Ok((ctx, running, service))
}

/// The newest status. The server sends it every second.
fn status(ctx: &Context, service: &str) -> anyhow::Result<Value> {
    let mut port = ctx.subscriber::<Status>(&TopicKind::Status.of(service))?;
    let begin = Instant::now();
    loop {
        let mut newest = None;
        port.newest(|_, tail| newest = serde_json::from_slice(tail).ok());
        if let Some(status) = newest {
            return Ok(status);
        }
        if begin.elapsed() > LIMIT {
            anyhow::bail!("modbus-server '{service}' tells no status; see `dinrail ps`");
        }
        std::thread::sleep(LOOK);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clients_are_a_table() {
        let list =
            [json!({ "address": "10.0.0.7", "port": 50123, "connected_s": 12, "idle_s": 0, "requests": 7,
                            "exceptions": 1, "last_unit": 1, "last_function": 3 })];
        assert_eq!(
            text(&list),
            "ADDRESS   PORT   CONNECTED  IDLE  REQUESTS  EXCEPTIONS  UNIT  FUNCTION\n\
             10.0.0.7  50123  12 s       0 s   7         1           1     3\n"
        );
    }
}
