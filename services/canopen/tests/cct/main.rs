//! The cases of CiA's CANopen conformance tool against our slave, in virtual time.
//!
//! `cct_cases.json` is the log of the tool's run against another device: what the tool sent, what that device answered,
//! and the tool's notes. The device here is a [`Node`](dinrail_canopen::protocol::node::Node) made of the same EDS, as
//! node 4. The runner sends what the tool sent and compares the answers by what they mean (see `runner.rs`). Cases that
//! the tool skipped, because that device lacks a feature, are run from steps of our own where our slave has the feature
//! (`own.rs`).
//!
//! The table of results is a snapshot: a case that stops passing fails the test. `DINRAIL_CCT_DOC=1` also writes the
//! table to `docs/src/reference/canopen-conformance.md`.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod device;
mod eds;
mod own;
mod report;
mod runner;

use std::path::PathBuf;

/// Folder of the case files, or `None` with a loud line; a failure when DINRAIL_NO_SKIP is set.
fn cases() -> Option<PathBuf> {
    let beside = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../../shared/cases");
    let dir = std::env::var_os("DINRAIL_CASES").map_or(beside, PathBuf::from);
    if dir.join("conformance/cct_cases.json").is_file() {
        return Some(dir);
    }
    let text = format!("*** SKIPPED: no conformance/cct_cases.json in {}; set DINRAIL_CASES", dir.display());
    assert!(std::env::var_os("DINRAIL_NO_SKIP").is_none(), "{text}");
    eprintln!("\n{text}\n");
    None
}

#[test]
fn conformance() {
    let Some(dir) = cases() else { return };
    let text = std::fs::read_to_string(dir.join("conformance/cct_cases.json")).unwrap();
    let cases: Vec<runner::Case> = serde_json::from_str(&text).unwrap();
    assert_eq!(cases.len(), 128, "127 cases and the preparation");
    let eds = std::fs::read_to_string(dir.join("eds/canopendemo/demo_demoDevice.eds")).unwrap();
    let outcomes = runner::run_all(&cases, &eds);
    let table = report::table(&outcomes);
    eprintln!("{table}");
    insta::assert_snapshot!("results", table);
    let bad: Vec<_> = outcomes.iter().filter(|outcome| outcome.is_regression()).collect();
    assert!(bad.is_empty(), "cases that the log's device passed and ours does not: {bad:#?}");
    if std::env::var_os("DINRAIL_CCT_DOC").is_some() {
        let path =
            PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../docs/src/reference/canopen-conformance.md");
        std::fs::write(path, report::page(&outcomes)).unwrap();
    }
}
