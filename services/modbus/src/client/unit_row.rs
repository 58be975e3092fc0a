//! A unit of a line as the status shows it.

use super::ask::exception_words;
use super::line::{UnitCounters, UnitState, UnitView};
use serde::Serialize;

#[derive(Serialize)]
pub(crate) struct UnitRow {
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

/// The first `left` units, which are counted off: a status has a limit of bytes.
pub(crate) fn unit_rows(
    units: impl Iterator<Item = UnitView>,
    left: &mut usize,
    name_of: impl Fn(u8) -> Option<String>,
) -> Vec<UnitRow> {
    let rows: Vec<UnitRow> = units
        .take(*left)
        .map(|view| UnitRow {
            unit: view.unit,
            name: name_of(view.unit),
            state: view.state,
            counters: view.counters,
            last_exception: view.last_exception.map(|(code, function)| exception_words(code, function)),
            rtt_us: view.last_rtt_ns.map(|ns| ns / 1000),
            max_rtt_us: view.max_rtt_ns / 1000,
        })
        .collect();
    *left -= rows.len();
    rows
}
