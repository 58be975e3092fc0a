//! What `<service>/status` shows.

use super::super::ask::exception_words;
use super::super::line::{LineCounters, UnitCounters, UnitState};
use super::{EVENTS_A_SECOND, Runner, STATUS_UNITS, Service, Transport, Unsafe};
use ipc_types::event::{EventKind, Level};
use ipc_types::payload::Quality;
use serde::Serialize;
use serde_json::Value;

#[derive(Serialize)]
struct UnitRow {
    unit: u8,
    #[serde(skip_serializing_if = "Option::is_none")]
    name: Option<String>,
    state: UnitState,
    counters: UnitCounters,
    #[serde(skip_serializing_if = "Option::is_none")]
    last_exception: Option<String>,
    /// Of the last answer.
    rtt_us: Option<u64>,
    max_rtt_us: u64,
}

#[derive(Serialize)]
struct LineRow {
    target: String,
    /// Of a connection: whether it stands.
    #[serde(skip_serializing_if = "Option::is_none")]
    connected: Option<bool>,
    #[serde(skip_serializing_if = "Option::is_none")]
    trouble: Option<String>,
    counters: LineCounters,
    jobs_waiting: usize,
    units: Vec<UnitRow>,
}

#[derive(Serialize)]
pub(super) struct Status {
    lines: Vec<LineRow>,
    ranges: usize,
    /// Ranges of %I by quality.
    good: usize,
    stale: usize,
    no_data: usize,
    /// Absent: writes follow the image.
    #[serde(skip_serializing_if = "Option::is_none")]
    safe: Option<Unsafe>,
    jobs: u64,
    jobs_failed: u64,
    images_too_small: u64,
}

impl Service {
    pub(super) fn status(&mut self) {
        if self.events_left_out > 0 {
            let message = format!("{} more changes in the last second left out", self.events_left_out);
            self.ctx.event(EventKind::InputQuality, Level::Warning, message, Value::Null);
        }
        (self.event_budget, self.events_left_out) = (EVENTS_A_SECOND, 0);
        let body = self.status_body(STATUS_UNITS);
        self.ctx.status(&body);
    }

    pub(super) fn status_body(&self, units: usize) -> Status {
        let mut left = units;
        let lines = self.runners.iter().map(|runner| line_row(runner, &mut left)).collect();
        let count = |quality| (0..self.reads.len()).filter(|&i| self.inputs.quality(i) == quality).count();
        Status {
            lines,
            ranges: self.reads.len(),
            good: count(Quality::Good),
            stale: count(Quality::Stale),
            no_data: count(Quality::NoData),
            safe: self.safe.filter(|_| self.image.is_some()),
            jobs: self.jobs_done,
            jobs_failed: self.jobs_failed,
            images_too_small: self.writes.outside(),
        }
    }
}

fn line_row(runner: &Runner, left: &mut usize) -> LineRow {
    let mut units = Vec::new();
    for view in runner.line.units() {
        if *left == 0 {
            break;
        }
        *left -= 1;
        units.push(UnitRow {
            unit: view.unit,
            name: runner.plan.units.iter().find(|u| u.unit == view.unit).and_then(|u| u.name.clone()),
            state: view.state,
            counters: view.counters,
            last_exception: view.last_exception.map(|code| exception_words(code, 0)),
            rtt_us: view.last_rtt_ns.map(|ns| ns / 1000),
            max_rtt_us: view.max_rtt_ns / 1000,
        });
    }
    LineRow {
        target: runner.plan.target.to_string(),
        connected: matches!(runner.transport, Transport::Tcp(_)).then_some(runner.connected),
        trouble: runner.trouble.clone(),
        counters: runner.line.counters(),
        jobs_waiting: runner.line.jobs(),
        units,
    }
}
