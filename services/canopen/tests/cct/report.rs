//! The table of results.

use crate::runner::{Outcome, Verdict};
use std::fmt::Write;

fn word(outcome: &Outcome) -> String {
    match &outcome.verdict {
        Verdict::Passed if outcome.own => "passed (own steps)".into(),
        Verdict::Passed => "passed".into(),
        Verdict::Failed(why) => format!("FAILED: {why}"),
        Verdict::NotApplicable(why) => format!("not applicable: {why}"),
    }
}

pub fn table(outcomes: &[Outcome]) -> String {
    let mut text = String::new();
    for outcome in outcomes {
        let _ =
            writeln!(text, "{:6} {:27} {:8} {}", outcome.id, outcome.name, outcome.reference, word(outcome));
    }
    let _ = write!(text, "{}", totals(outcomes));
    text
}

fn totals(outcomes: &[Outcome]) -> String {
    let count =
        |fits: &dyn Fn(&Verdict) -> bool| outcomes.iter().filter(|outcome| fits(&outcome.verdict)).count();
    format!(
        "{} passed, {} failed, {} not applicable",
        count(&|verdict| *verdict == Verdict::Passed),
        count(&|verdict| matches!(verdict, Verdict::Failed(_))),
        count(&|verdict| matches!(verdict, Verdict::NotApplicable(_))),
    )
}

pub fn page(outcomes: &[Outcome]) -> String {
    let mut text = String::from(
        "# CANopen conformance\n\n\
         The slave runs the cases of CiA's CANopen conformance test tool, as logged in the public report of another\n\
         open-source stack's demo device. The tool itself is not ours to run: a runner sends what the tool sent, in\n\
         virtual time, to a slave made of the same EDS, and compares the answers by meaning (abort codes that the tool\n\
         calls valid, EMCY codes, periods). Where the tool skipped or failed a case at the other device, steps of our own\n\
         test what the case asks for.\n\n\
         This is no certificate of CAN in Automation.\n\n",
    );
    let _ = writeln!(text, "{}.\n", totals(outcomes));
    text.push_str("| case | name | what | other device | dinrail |\n|---|---|---|---|---|\n");
    for outcome in outcomes {
        let _ = writeln!(
            text,
            "| {} | {} | {} | {} | {} |",
            outcome.id,
            outcome.name,
            outcome.info.split_whitespace().collect::<Vec<_>>().join(" ").replace('|', "/"),
            outcome.reference.to_lowercase(),
            word(outcome)
        );
    }
    text
}
