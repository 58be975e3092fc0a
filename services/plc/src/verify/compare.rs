//! A record, and what the verifier's own engine made of its scan.

use super::diff::differences;
use super::{OTHERS, Position, VarDiff};
use ipc_types::scan_record::{Content, Fault, Head, Outcome, Patch, Section, flag};

pub(super) type Found = (String, Vec<VarDiff>);

/// What of the record the engine's own record contradicts.
pub(super) fn compare_record(position: &Position, recorded: &Content<'_>) -> Option<Found> {
    let engine = &position.engine;
    let Ok(own) = Content::parse(engine.record()) else {
        return Some(("the verifier's own record".to_owned(), Vec::new()));
    };
    let row = |variable: &str, expected: String, got: String| {
        Some((variable.to_owned(), vec![VarDiff { variable: variable.to_owned(), expected, got }]))
    };
    if own.head == recorded.head && forces(&own) == forces(recorded) && changes_equal(&own, recorded) {
        // What a later version recorded beside it is not known here.
        let unknown = recorded.sections().any(|s| matches!(s, Section::Unknown { .. }));
        if unknown || own.bytes() == recorded.bytes() {
            return None;
        }
        let at = own.bytes().iter().zip(recorded.bytes()).position(|(a, b)| a != b);
        let at = at.unwrap_or(own.bytes().len().min(recorded.bytes().len()));
        return row("what the record says of its scan", format!("another at byte {at}"), String::new());
    }
    let (a, b) = (&recorded.head, &own.head);
    let rows = memory_rows(position, recorded);
    if !rows.is_empty() {
        return Some(("memory".to_owned(), rows));
    }
    if let (Some(expected), Some(got)) = (forces(recorded), forces(&own))
        && let Some((e, g)) = first_unequal(&expected, &got)
    {
        let at = e.or(g).map_or(0, |p| p.offset);
        let (name, _) = crate::engine::value::name_of(engine.map(), engine.image(), at);
        let text = |p: Option<Patch>| {
            p.map_or("not forced".to_owned(), |p| format!("forced to {:?}", &p.value[..usize::from(p.len)]))
        };
        return row(&name, text(e), text(g));
    }
    if a.outcome != b.outcome {
        let text = |o: u8, c: &Content<'_>| match (o, fault_of(c)) {
            (o, Some(fault)) if o == Outcome::Trap as u8 => format!("fault: {}", fault.text),
            (o, _) if o == Outcome::Ok as u8 => "no fault".to_owned(),
            _ => "no task ran".to_owned(),
        };
        return row("outcome of the scan", text(a.outcome, recorded), text(b.outcome, &own));
    }
    if a.tasks_ran != b.tasks_ran {
        return row("tasks that ran", format!("{:#b}", a.tasks_ran), format!("{:#b}", b.tasks_ran));
    }
    if (a.state_before, a.state_after) != (b.state_before, b.state_after) {
        let text = |h: &Head| format!("{} then {}", h.state_before, h.state_after);
        return row("state of the PLC", text(a), text(b));
    }
    if a.warnings != b.warnings {
        return row("warnings of the program", a.warnings.to_string(), b.warnings.to_string());
    }
    if a.program_hash != b.program_hash {
        return row("program", format!("{:016x}", a.program_hash), format!("{:016x}", b.program_hash));
    }
    if a.memory_hash != b.memory_hash && a.flags & flag::DATA_CUT == 0 {
        // Every recorded byte agrees: what is left is the stamp in front of the image.
        let got = format!("PLC time {} ns, UTC {} ns", b.plc_time_ns, b.utc_ns);
        return row("the scan's stamp", "another".to_owned(), got);
    }
    row(
        "a variable beyond the recorded changes",
        format!("{:016x}", a.memory_hash),
        format!("{:016x}", b.memory_hash),
    )
}

fn fault_of<'c>(content: &Content<'c>) -> Option<Fault<'c>> {
    content.sections().find_map(|s| match s {
        Section::Fault(fault) => Some(fault),
        _ => None,
    })
}

fn forces(content: &Content<'_>) -> Option<Vec<Patch>> {
    content.sections().find_map(|s| match s {
        Section::Forces(table) => Some(table),
        _ => None,
    })
}

fn first_unequal(a: &[Patch], b: &[Patch]) -> Option<(Option<Patch>, Option<Patch>)> {
    (0..a.len().max(b.len())).map(|i| (a.get(i).copied(), b.get(i).copied())).find(|(a, b)| a != b)
}

fn changes_equal(a: &Content<'_>, b: &Content<'_>) -> bool {
    let list = |c: &Content<'_>| -> Option<Vec<(u32, Vec<u8>)>> {
        c.sections().find_map(|s| match s {
            Section::Changes(changes) => Some(changes.map(|(at, bytes)| (at, bytes.to_vec())).collect()),
            _ => None,
        })
    };
    list(a) == list(b)
}

/// Variables that differ between memory as recorded (before + changes) and as computed.
fn memory_rows(position: &Position, recorded: &Content<'_>) -> Vec<VarDiff> {
    let engine = &position.engine;
    let mut expected = position.before.clone();
    let mut known_to = 0u32;
    for section in recorded.sections() {
        let Section::Changes(changes) = section else { continue };
        for (at, bytes) in changes {
            if let Some(target) = expected.get_mut(at as usize..at as usize + bytes.len()) {
                target.copy_from_slice(bytes);
            }
            known_to = at + bytes.len() as u32;
        }
    }
    let cut = recorded.head.flags & flag::DATA_CUT != 0;
    let (from, to) = engine.searched();
    let data = engine.data_offset();
    let known = |at: u32| at < to && (!cut || at < data.max(known_to));
    let end = engine.state_end() as usize;
    differences(engine, &expected[..end], &engine.memory()[..end], from, known, OTHERS + 1)
}
