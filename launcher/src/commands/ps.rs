//! `dinrail ps`.

use super::table;
use crate::cli::Which;
use crate::supervise::client::{Client, find};
use crate::supervise::control::{Reply, Request, ServiceRow, StackStatus};
use serde_json::{Value, json};
use std::time::Duration;

const LIMIT: Duration = Duration::from_secs(10);

/// One row a service.
pub fn run(which: &Which, json: bool) -> anyhow::Result<()> {
    let mut client = Client::connect(find(which.stack.as_deref())?)?;
    let Reply::Ps(rows) = client.call(&Request::Ps {}, LIMIT)? else {
        anyhow::bail!("the launcher gave another answer than asked for; is it of another version?");
    };
    if json {
        let rows: Vec<Value> = rows.iter().map(row_json).collect();
        super::println(&serde_json::to_string_pretty(&rows)?);
    } else {
        super::print(&rows_text(&rows));
    }
    Ok(())
}

/// A row for programs. What only a process has is null where there is none: nobody shall send signals to process 0.
pub fn row_json(row: &ServiceRow) -> Value {
    let mut value = json!(row);
    if row.pid == 0 {
        for key in ["pid", "health", "uptime_ms", "cpu_percent", "rss_bytes"] {
            value[key] = Value::Null;
        }
    }
    value
}

fn rows_text(rows: &[ServiceRow]) -> String {
    let head = ["SERVICE", "KIND", "PID", "STATE", "GEN", "RESTARTS", "UPTIME", "CPU", "MEMORY"];
    let cells = |row: &ServiceRow| {
        let none = || "-".to_owned();
        let lives = row.pid != 0;
        let mut state = if row.state == "running" { row.health.clone() } else { row.state.clone() };
        if row.unstable && row.state != "held" {
            state += ", unstable";
        }
        vec![
            row.service.clone(),
            row.kind.clone(),
            if lives { row.pid.to_string() } else { none() },
            state,
            row.generation.to_string(),
            row.restarts.to_string(),
            if lives { uptime(row.uptime_ms) } else { none() },
            if lives { format!("{:.1} %", row.cpu_percent) } else { none() },
            if lives { format!("{:.1} MiB", row.rss_bytes as f64 / 1_048_576.0) } else { none() },
        ]
    };
    table(&head, &rows.iter().map(cells).collect::<Vec<_>>())
}

/// `950 ms`, `12 s`, `3 min 5 s`, `2 h 7 min`, `4 d 3 h`.
pub fn uptime(ms: u64) -> String {
    let s = ms / 1000;
    match s {
        0 => format!("{ms} ms"),
        1..=59 => format!("{s} s"),
        60..=3599 => format!("{} min {} s", s / 60, s % 60),
        3600..=86399 => format!("{} h {} min", s / 3600, s / 60 % 60),
        _ => format!("{} d {} h", s / 86400, s / 3600 % 24),
    }
}

/// The stack as a whole, from its launcher alone.
pub fn fetch_status(which: &Which) -> anyhow::Result<StackStatus> {
    let mut client = Client::connect(find(which.stack.as_deref())?)?;
    let Reply::Status(status) = client.call(&Request::Status {}, LIMIT)? else {
        anyhow::bail!("the launcher gave another answer than asked for; is it of another version?");
    };
    Ok(status)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_are_readable() {
        let row = ServiceRow {
            service: "can0".into(),
            kind: "can".into(),
            state: "running".into(),
            health: "ready".into(),
            pid: 42,
            generation: 2,
            restarts: 1,
            uptime_ms: 185_000,
            cpu_percent: 1.25,
            rss_bytes: 5 << 20,
            deaths: 0,
            unstable: false,
        };
        let held = ServiceRow { state: "held".into(), pid: 0, unstable: true, ..row.clone() };
        assert_eq!(
            rows_text(&[row.clone(), held]),
            "SERVICE  KIND  PID  STATE  GEN  RESTARTS  UPTIME     CPU    MEMORY\n\
             can0     can   42   ready  2    1         3 min 5 s  1.2 %  5.0 MiB\n\
             can0     can   -    held   2    1         -          -      -\n"
        );
        let (lives, none) = (row_json(&row), row_json(&ServiceRow { pid: 0, ..row.clone() }));
        assert_eq!((&lives["pid"], &lives["health"]), (&json!(42), &json!("ready")));
        assert_eq!(
            (&none["pid"], &none["health"], &none["uptime_ms"]),
            (&Value::Null, &Value::Null, &Value::Null)
        );
        assert_eq!((&none["service"], &none["restarts"]), (&json!("can0"), &json!(1)));
        let unstable = rows_text(&[ServiceRow { unstable: true, ..row }]);
        assert!(unstable.contains("  ready, unstable  2  "), "{unstable}");
    }

    #[test]
    fn times_are_short() {
        for (ms, text) in
            [(950, "950 ms"), (12_000, "12 s"), (7_620_000, "2 h 7 min"), (356_400_000, "4 d 3 h")]
        {
            assert_eq!(uptime(ms), text);
        }
    }
}
