//! What the service tells about itself once a second.

use super::live::Live;
use ipc_types::payload::PlcState;
use serde_json::{Value, json};

/// Times of the scans since the last status.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct ScanTimes {
    pub scans: u64,
    pub sum_ns: u64,
    pub max_ns: u64,
    /// Start of a scan after the time it was due.
    pub late_max_ns: u64,
}

/// Counters since the start of the service.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Counters {
    pub writes: u64,
    pub writes_refused: u64,
    pub records_incomplete: u64,
    pub records_lost: u64,
    pub keyframes: u64,
    pub faults: u64,
    pub jobs: u64,
}

/// The status as JSON.
pub(super) fn status(live: &Live, now_ns: u64) -> Value {
    let engine = &live.engine;
    let times = live.shown_times;
    let state = engine.state();
    let inputs: Vec<Value> = live
        .inputs
        .iter()
        .map(|source| {
            json!({
                "service": source.name,
                "quality": source.quality(engine),
                "age_ms": source.age_ns(now_ns).map(|ns| ns / 1_000_000),
                "lost": source.lost(),
                "malformed": source.malformed,
            })
        })
        .collect();
    let trigger = live.watch.as_ref().map(|watch| {
        let counters = watch.counters;
        json!({
            "service": live.inputs[watch.at].name,
            "events": counters.events,
            "missed": counters.missed,
            "overdue": counters.overdue,
        })
    });
    let forces: Vec<&str> = engine.forces().map(|(path, _)| path).take(64).collect();
    let counters = live.counters;
    json!({
        "state": state,
        "scan": engine.scan(),
        "program": engine.setup().files,
        "program_hash": format!("{:016x}", engine.program_hash()),
        "fault": engine.fault().filter(|_| state == PlcState::Fault).map(|f| f.message.as_str()),
        "scan_us": {
            "average": if times.scans == 0 { 0.0 } else { times.sum_ns as f64 / times.scans as f64 / 1e3 },
            "max": times.max_ns as f64 / 1e3,
            "late_max": times.late_max_ns as f64 / 1e3,
        },
        "periods_skipped": engine.skipped_total(),
        "trigger": trigger,
        "warnings": engine.warnings(),
        "forces": forces,
        "inputs": inputs,
        "writes": counters.writes,
        "writes_refused": counters.writes_refused,
        "keyframes": counters.keyframes,
        "records_incomplete": counters.records_incomplete,
        "records_lost": counters.records_lost,
        "faults": counters.faults,
        "retain_bytes": engine.retain().len(),
        "retain_file_failures": live.retain_failures(),
    })
}
