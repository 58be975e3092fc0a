use super::*;
use serde_json::json;

fn source(name: &str, text: &str) -> Vec<SourceText> {
    vec![SourceText { name: name.to_owned(), text: text.to_owned() }]
}

const COUNTER: &str = "PROGRAM main
VAR n : INT; lamp AT %QX0.0 : BOOL; inc : INT := 1; END_VAR
  n := n + inc;
  lamp := NOT lamp;
END_PROGRAM";

#[test]
fn every_variable_of_every_scan_is_shown() {
    let settings = [Setting { scan: 3, variable: "inc".into(), value: json!(10) }];
    let trace =
        trace_scans(source("main.st", COUNTER), Setup::default(), Some(5_000_000), 4, &settings).unwrap();
    let n: Vec<i64> = trace.iter().map(|t| t.variables["main.n"].as_i64().unwrap()).collect();
    assert_eq!(n, [1, 2, 12, 22]);
    assert_eq!(trace[3].t_ms, 15.0);
    assert_eq!(trace[3].variables["main.lamp"], json!(false));
}

#[test]
fn a_case_names_scan_variable_expected_and_got() {
    let case = json!({ "case": "counter", "task_interval_ms": 10, "scans": [
        { "scan": 1, "out": { "n": 1, "lamp": true } },
        { "scan": 2, "in": { "inc": 5 }, "out": { "n": 6 } },
        { "scan": 5, "out": { "n": 22 } },
    ] });
    let report = trace_case(source("main.st", COUNTER), Setup::default(), &case.to_string()).unwrap();
    let difference = report.first_difference.unwrap();
    assert_eq!((difference.scan, difference.variable.as_str()), (5, "n"));
    assert_eq!((difference.expected, difference.got), (json!(22), json!(21)));
    assert_eq!((report.scans, report.values), (5, 4));
}

#[test]
fn unknown_variables_are_named_with_their_scan() {
    let case = json!({ "case": "x", "task_interval_ms": 10, "scans": [{ "scan": 1, "in": { "speed": 1 } }] });
    let error =
        trace_case(source("main.st", COUNTER), Setup::default(), &case.to_string()).unwrap_err().to_string();
    assert_eq!(error, "scan 1: no variable 'speed'");
}
