//! What `up` and `demo` print on stdout: the banner, the lines of progress, the summary.

use super::Outcome;
use super::watch::Observed;
use ipc_types::Stack;
use ipc_types::payload::PlcState;
use serde_json::{Value, json};
use std::time::Duration;

/// Services, where they listen, what is recorded where.
pub fn banner(stack: &Stack, pid: u32) -> String {
    let mut text = format!(
        "stack '{}' from {}, launcher pid {pid}, {}",
        stack.name,
        stack.file.display(),
        stack.root.display()
    );
    for service in &stack.services {
        text += &format!("\n  {:<12} {:<14}", service.name, service.kind);
        for listener in &service.wiring.listeners {
            text += &format!(" {} on {}", listener.name, listener.address);
        }
        if service.wiring.records
            && let Some(dir) = service.config.get("dir").and_then(Value::as_str)
        {
            text += &format!(" writes to {}", stack.dir.join(dir).display());
        }
        text.truncate(text.trim_end().len());
    }
    text
}

/// The banner for programs.
pub fn banner_json(stack: &Stack, pid: u32) -> Value {
    let services: Vec<Value> = stack
        .services
        .iter()
        .map(|s| {
            let listeners: Vec<Value> =
                s.wiring.listeners.iter().map(|l| json!({ "name": l.name, "address": l.address })).collect();
            json!({ "name": s.name, "kind": s.kind, "listeners": listeners })
        })
        .collect();
    json!({ "event": "up", "stack": stack.name, "pid": pid, "root": stack.root, "services": services })
}

/// Turns two pictures of the stack into a line.
pub struct Progress {
    last: Observed,
    json: bool,
}

impl Progress {
    pub fn new(json: bool) -> Self {
        Self { last: Observed::default(), json }
    }

    /// One line about the time since the last one.
    pub fn line(&mut self, now: &Observed, at: Duration, passed: Duration) -> String {
        let seconds = passed.as_secs_f64().max(0.001);
        let rate = |new: u64, old: u64| (new.saturating_sub(old) as f64 / seconds).round() as u64;
        let before = |name: &str| self.last.buses.iter().find(|(n, _)| n == name).map_or(0, |(_, f)| *f);
        let scans_before = |name: &str| self.last.plcs.iter().find(|p| p.0 == name).map_or(0, |p| p.2);
        let line = if self.json {
            let buses: Vec<Value> = now
                .buses
                .iter()
                .map(|(n, f)| json!({ "bus": n, "frames": f, "frames_per_s": rate(*f, before(n)) }))
                .collect();
            let plcs: Vec<Value> = now
                .plcs
                .iter()
                .map(|(n, s, k)| json!({ "plc": n, "state": s, "scans": k, "scans_per_s": rate(*k, scans_before(n)) }))
                .collect();
            let points: serde_json::Map<String, Value> =
                now.points.iter().map(|(n, v)| (n.clone(), v.clone().into())).collect();
            json!({ "event": "progress", "t_s": at.as_secs_f64(), "buses": buses, "plcs": plcs, "points": points })
                .to_string()
        } else {
            let mut parts = vec![format!("{:>4.0} s", at.as_secs_f64())];
            for (name, state, scans) in &now.plcs {
                let word = if *state == PlcState::Run { String::new() } else { format!(" ({state:?})") };
                parts.push(format!("{name} {scans} scans, {}/s{word}", rate(*scans, scans_before(name))));
            }
            for (name, frames) in &now.buses {
                parts.push(format!("{name} {frames} frames, {}/s", rate(*frames, before(name))));
            }
            if !now.points.is_empty() {
                let values: Vec<String> = now.points.iter().map(|(n, v)| format!("{n} = {v}")).collect();
                parts.push(values.join(", "));
            }
            parts.join(" | ")
        };
        self.last = now.clone();
        line
    }
}

/// The last lines: how it went, and where the recordings are.
pub fn summary(seen: &Observed, outcome: &Outcome, ran: Duration, restarts: u32, json: bool) -> String {
    let recordings: Vec<(String, String)> = seen
        .recorders
        .iter()
        .filter_map(|(name, status)| {
            let file = ["file", "path", "recording"].iter().find_map(|key| status.get(key)?.as_str())?;
            Some((name.clone(), file.to_owned()))
        })
        .collect();
    if json {
        return json!({
            "event": "down",
            "ran_s": ran.as_secs_f64(),
            "restarts": restarts,
            "failed": outcome.failed,
            "held": outcome.held,
            "degraded": outcome.degraded,
            "losses": outcome.losses,
            "plcs": seen.plcs.iter().map(|p| json!({ "plc": p.0, "scans": p.2 })).collect::<Vec<_>>(),
            "buses": seen.buses.iter().map(|b| json!({ "bus": b.0, "frames": b.1 })).collect::<Vec<_>>(),
            "recordings": recordings.iter().map(|(n, f)| json!({ "recorder": n, "file": f })).collect::<Vec<_>>(),
            "exit_code": outcome.exit_code(),
        })
        .to_string();
    }
    let mut lines: Vec<String> = recordings.iter().map(|(_, file)| format!("recording: {file}")).collect();
    lines.extend(outcome.losses.iter().map(|loss| format!("lost: {loss}")));
    lines.extend(outcome.held.iter().map(|name| format!("down at the end: {name}")));
    let mut parts = vec![format!("ran {:.1} s", ran.as_secs_f64())];
    parts.extend(seen.plcs.iter().map(|p| format!("{} {} scans", p.0, p.2)));
    parts.extend(seen.buses.iter().map(|b| format!("{} {} frames", b.0, b.1)));
    parts.push(format!("{restarts} restart{}", if restarts == 1 { "" } else { "s" }));
    parts.push(match &outcome.failed {
        Some(why) => format!("failed: {why}"),
        None if outcome.exit_code() == 0 && !outcome.degraded.is_empty() => {
            format!("degraded at the end: {}", outcome.degraded.join(", "))
        }
        None if outcome.exit_code() == 0 => "healthy".to_owned(),
        None if outcome.exit_code() == 3 => "healthy, with data loss".to_owned(),
        None => "not healthy".to_owned(),
    });
    lines.push(parts.join(", "));
    lines.join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn seen(scans: u64, frames: u64) -> Observed {
        Observed {
            buses: vec![("can0".into(), frames)],
            plcs: vec![("plc".into(), PlcState::Run, scans)],
            points: vec![("Speed".into(), "42".into())],
            recorders: vec![("rec".into(), json!({ "file": "recordings/a.mcap" }))],
            losses: vec![],
        }
    }

    #[test]
    fn rates_are_over_the_time_passed() {
        let mut progress = Progress::new(false);
        progress.line(&seen(100, 10), Duration::from_secs(1), Duration::from_secs(1));
        let line = progress.line(&seen(1100, 30), Duration::from_secs(3), Duration::from_secs(2));
        assert_eq!(line, "   3 s | plc 1100 scans, 500/s | can0 30 frames, 10/s | Speed = 42");
    }

    #[test]
    fn the_summary_says_how_it_ended() {
        let healthy = summary(&seen(9, 3), &Outcome::default(), Duration::from_secs(10), 0, false);
        assert_eq!(
            healthy,
            "recording: recordings/a.mcap\nran 10.0 s, plc 9 scans, can0 3 frames, 0 restarts, healthy"
        );
        let degraded = Outcome { degraded: vec!["can0".into(), "com1".into()], ..Outcome::default() };
        let said = summary(&seen(9, 3), &degraded, Duration::from_secs(10), 0, false);
        assert!(said.ends_with("0 restarts, degraded at the end: can0, com1"), "{said}");
        let lossy = Outcome { losses: vec!["rec: 3 messages".into()], ..Outcome::default() };
        let text = summary(&Observed::default(), &lossy, Duration::from_secs(1), 1, false);
        assert_eq!(text, "lost: rec: 3 messages\nran 1.0 s, 1 restart, healthy, with data loss");
        assert_eq!(lossy.exit_code(), 3);
        let held = Outcome { held: vec!["can0".into()], ..lossy };
        assert_eq!(held.exit_code(), 1);
    }
}
