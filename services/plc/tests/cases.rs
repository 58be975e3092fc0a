//! The shared case files through the tracer: one program, the value of every output in every scan.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use dinrail_iec::Source;
use dinrail_plc::setup::Setup;
use dinrail_plc::trace::{Setting, trace_case, trace_scans};
use serde_json::json;
use std::path::PathBuf;

/// Folder of the case files, or `None` with a loud line; a failure when DINRAIL_NO_SKIP is set.
fn folder() -> Option<PathBuf> {
    let beside = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../../shared/cases");
    let dir = std::env::var_os("DINRAIL_CASES").map_or(beside, PathBuf::from).join("iec");
    if dir.is_dir() {
        return Some(dir);
    }
    let text = format!("*** SKIPPED: no case files in {}; set DINRAIL_CASES", dir.display());
    assert!(std::env::var_os("DINRAIL_NO_SKIP").is_none(), "{text}");
    eprintln!("\n{text}\n");
    None
}

fn sources(name: &str) -> Option<Vec<Source>> {
    let text = std::fs::read_to_string(folder()?.join(format!("{name}.st"))).unwrap();
    Some(vec![Source { name: format!("{name}.st"), text }])
}

fn run(name: &str) {
    let Some(sources) = sources(name) else { return };
    let case = std::fs::read_to_string(folder().unwrap().join(format!("{name}.case.json"))).unwrap();
    let report = trace_case(sources, Setup::default(), &case).unwrap_or_else(|e| panic!("{e}"));
    assert!(report.values > 0);
    assert_eq!(report.first_difference, None);
}

macro_rules! cases {
    ($($name:ident)*) => {$(
        #[test]
        fn $name() {
            run(stringify!($name));
        }
    )*};
}

cases! {
    bubble1000
    fb_counters
    fb_timers
    math100k
    st_arith_conv
    st_for_bounds
    st_for_limits
}

#[test]
fn st_runtime_faults() {
    let Some(sources) = sources("st_runtime_faults") else { return };
    let faults: Vec<String> = (0..=6)
        .filter(|sel| *sel != 5)
        .map(|sel| {
            let settings = [Setting { scan: 2, variable: "sel".into(), value: json!(sel) }];
            let trace = trace_scans(sources.clone(), Setup::default(), None, 3, &settings).unwrap();
            assert_eq!(trace[0].fault, None);
            assert_eq!(trace[1].fault, trace[2].fault, "a fault stays");
            let fault = trace[1].fault.clone().unwrap_or_else(|| "no fault".into());
            // Which statement of the endless loop it was, and what r had reached, is chance.
            let fault = if sel == 4 { fault.split(" at ").next().unwrap().to_owned() } else { fault };
            format!("{sel}: {fault}")
        })
        .collect();
    insta::assert_snapshot!(faults.join("\n"), @r"
    0: no fault
    1: division by zero at st_runtime_faults.st:18:8, in prg, task main; dividend 100; statement: r := 100 / zero; with zero = 0, r = 0, sel = 1, m1 = -1, lowest = -2147483648, idx = 10, alive = 2
    2: no fault
    3: array index out of bounds at st_runtime_faults.st:20:8, in prg, task main; index 10; statement: a[idx] := 1; with idx = 10, sel = 3, zero = 0, m1 = -1, lowest = -2147483648, r = 0, alive = 2
    4: watchdog: the task ran too long
    6: no fault
    ");
}
