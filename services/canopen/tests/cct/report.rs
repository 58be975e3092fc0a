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
    // Case 0 is the tool's preparation.
    let cases = || outcomes.iter().filter(|outcome| outcome.id != "0");
    let count = |fits: &dyn Fn(&Verdict) -> bool| cases().filter(|outcome| fits(&outcome.verdict)).count();
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
         This is no certificate of CAN in Automation.\n\n\
         Where the runner is lenient:\n\n\
         - The log has no times: the tool's frames are sent 1 ms apart, SYNCs 10 ms, heartbeats of other nodes 900 ms.\n\
         - Frames of the device may come in any order between each other; SDO answers must come at once and in order.\n\
         - An EMCY fits by its error code. The other device's EMCYs for a missing SYNC need not come.\n\
         - Transmission type 253 is taken here, where the other device has no RTR and refuses it.\n\
         - State 01 writes random values: each may be taken or refused, and must be gone after the reset.\n\
         - Synchronization 03 counts PDOs of transmission type 10: one more or less is right.\n\
         - Values that are the other device's state (1003h, 1018h, 2106h, 2110h-2112h, 2120h) only have to be readable.\n\
         - A SYNC that the log has behind a reset or stop command was on its way and need not come.\n\n",
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
