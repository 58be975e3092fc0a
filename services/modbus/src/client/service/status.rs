//! What `<service>/status` shows.

use super::super::ask::exception_words;
use super::super::line::LineCounters;
use super::super::unit_row::{UnitRow, unit_rows};
use super::super::wiring::points;
use super::{Runner, STATUS_UNITS, Service, Transport, Use};
use ipc_types::event::{EventKind, Level};
use ipc_types::outputs::Unsafe;
use ipc_types::payload::Quality;
use serde::Serialize;
use serde_json::Value;

/// Refused ranges shown.
const REFUSED: usize = 8;

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
    /// Reads and writes that units refuse, the first of them.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    refused: Vec<String>,
    /// Absent: writes follow the image.
    #[serde(skip_serializing_if = "Option::is_none")]
    safe: Option<Unsafe>,
    jobs: u64,
    jobs_failed: u64,
    images_too_small: u64,
}

impl Service {
    pub(super) fn status(&mut self) {
        if let Some(left_out) = self.events.renew() {
            let message = format!("{left_out} more changes in the last second left out");
            self.ctx.event(EventKind::InputQuality, Level::Warning, message, Value::Null);
        }
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
            refused: self.refused(),
            safe: self.image.why(),
            jobs: self.jobs_done,
            jobs_failed: self.jobs_failed,
            images_too_small: self.writes.outside(),
        }
    }
}

impl Service {
    fn refused(&self) -> Vec<String> {
        let slots = self
            .runners
            .iter()
            .flat_map(|runner| runner.places.iter().zip(&runner.uses).map(move |p| (runner, p)));
        let words = slots.filter_map(|(runner, (place, used))| {
            let (function, code) = place.refused?;
            let unit = match used {
                Use::Batch(batch) => format!("unit {}, ", runner.plan.batches[*batch].unit),
                Use::Write => String::new(),
            };
            let what = points(place.table, place.at, place.count);
            Some(format!("{unit}{what}: {}", exception_words(code, function)))
        });
        words.take(REFUSED).collect()
    }
}

fn line_row(runner: &Runner, left: &mut usize) -> LineRow {
    let name_of = |unit| runner.plan.units.iter().find(|u| u.unit == unit).and_then(|u| u.name.clone());
    let units = unit_rows(runner.line.units(), left, name_of);
    LineRow {
        target: runner.plan.target.to_string(),
        connected: matches!(runner.transport, Transport::Tcp(_)).then_some(runner.connected),
        trouble: runner.trouble.clone(),
        counters: runner.line.counters(),
        jobs_waiting: runner.line.jobs(),
        units,
    }
}
