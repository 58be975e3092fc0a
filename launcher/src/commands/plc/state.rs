//! `dinrail plc status` for people.

use super::plain;
use serde_json::Value;

/// The answer to the job `status`, one subject a line. What another version does not tell is left out.
pub fn text(plc: &str, answer: &Value) -> String {
    let mut rows: Vec<(&str, String)> = Vec::new();
    let mut row = |name: &'static str, text: Option<String>| rows.extend(text.map(|text| (name, text)));
    let word = |key: &str| answer.get(key).filter(|v| !v.is_null()).map(plain);
    row("plc", Some(plc.to_owned()));
    row("state", word("state"));
    row("fault", word("fault"));
    row("", word("fault").map(|_| way_on(plc)));
    row("program", program(answer));
    row("scans", word("scan"));
    row("scan time", scan_time(answer));
    row("skipped", counted(answer, "periods_skipped", "period", "of tasks, because scans came late"));
    row("trigger", trigger(answer));
    row("forced", list(answer, "forces"));
    row("inputs", inputs(answer));
    row("writes", pair(answer, "writes", "taken from the rail", "writes_refused", "of them refused"));
    row("retain", pair(answer, "retain_bytes", "bytes", "retain_file_failures", "copies to the disk failed"));
    row("recording", recording(answer));
    row("warnings", counted(answer, "warnings", "warning", "of the program, such as MOD by zero"));
    row("faults", counted(answer, "faults", "fault", "since the service started"));
    let width = rows.iter().map(|(name, _)| name.len()).max().unwrap_or(0);
    let lines: Vec<String> = rows.iter().map(|(name, text)| format!("{name:width$}  {text}")).collect();
    lines.join("\n")
}

fn number(answer: &Value, key: &str) -> Option<u64> {
    answer.get(key).and_then(Value::as_u64)
}

/// Nothing for 0.
fn counted(answer: &Value, key: &str, what: &str, more: &str) -> Option<String> {
    let count = number(answer, key).filter(|n| *n > 0)?;
    Some(format!("{count} {what}{} {more}", if count == 1 { "" } else { "s" }))
}

/// Two counts; of the second nothing for 0, and nothing at all for two of them.
fn pair(answer: &Value, first: &str, what: &str, second: &str, bad: &str) -> Option<String> {
    let (first, second) = (number(answer, first)?, number(answer, second).unwrap_or(0));
    if first == 0 && second == 0 {
        return None;
    }
    let second = if second > 0 { format!(", {second} {bad}") } else { String::new() };
    Some(format!("{first} {what}{second}"))
}

fn way_on(plc: &str) -> String {
    format!(
        "`dinrail plc run --service {plc}` starts the program again, RETAIN kept; `dinrail plc load` another one"
    )
}

fn program(answer: &Value) -> Option<String> {
    let files = answer.get("program")?.as_array()?;
    if files.is_empty() {
        return Some("none: image and routes only".to_owned());
    }
    let files: Vec<String> = files.iter().map(plain).collect();
    let hash = answer.get("program_hash").map(|hash| format!(", {}", plain(hash))).unwrap_or_default();
    Some(files.join(" ") + &hash)
}

fn scan_time(answer: &Value) -> Option<String> {
    let times = answer.get("scan_us")?;
    let of = |key: &str| times.get(key).and_then(Value::as_f64);
    Some(format!(
        "{:.1} us on average, {:.1} us at most, begun {:.1} us late at most, over the last second",
        of("average")?,
        of("max")?,
        of("late_max")?
    ))
}

fn trigger(answer: &Value) -> Option<String> {
    let trigger = answer.get("trigger").filter(|t| t.is_object())?;
    let service = trigger.get("service").map(plain)?;
    let of = |key: &str| number(trigger, key).unwrap_or(0);
    Some(format!("{service}: {} events, {} missed, {} overdue", of("events"), of("missed"), of("overdue")))
}

fn list(answer: &Value, key: &str) -> Option<String> {
    let list = answer.get(key)?.as_array().filter(|l| !l.is_empty())?;
    Some(list.iter().map(plain).collect::<Vec<_>>().join(", "))
}

fn inputs(answer: &Value) -> Option<String> {
    let one = |input: &Value| {
        let of = |key: &str| number(input, key).unwrap_or(0);
        let mut text =
            format!("{}: {}", plain(&input["service"]), plain(&input["quality"]).replace('_', " "));
        if let Some(age) = number(input, "age_ms") {
            text += &format!(", {age} ms old");
        }
        for (key, word) in [("lost", "lost"), ("malformed", "malformed")] {
            if of(key) > 0 {
                text += &format!(", {} {word}", of(key));
            }
        }
        text
    };
    let list = answer.get("inputs")?.as_array().filter(|l| !l.is_empty())?;
    Some(list.iter().map(one).collect::<Vec<_>>().join("; "))
}

fn recording(answer: &Value) -> Option<String> {
    let keyframes = number(answer, "keyframes")?;
    let mut text = format!("{keyframes} keyframes");
    for (key, word) in [("records_incomplete", "incomplete"), ("records_lost", "lost")] {
        if let Some(count) = number(answer, key).filter(|n| *n > 0) {
            text += &format!(", {count} scan records {word}");
        }
    }
    Some(text)
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn the_state_is_told_in_lines() {
        let answer = json!({
            "state": "fault", "scan": 4711, "program": ["main.st", "io.st"], "program_hash": "0123456789abcdef",
            "fault": "division by zero at main.st:4:3", "scan_us": { "average": 12.44, "max": 80.0, "late_max": 3.0 },
            "periods_skipped": 1, "trigger": { "service": "io", "events": 9, "missed": 1, "overdue": 0 },
            "warnings": 0, "forces": ["Main.Limit", "%QX0.3"], "inputs": [
                { "service": "io", "quality": "good", "age_ms": 12, "lost": 0, "malformed": 0 },
                { "service": "bus", "quality": "no_data", "age_ms": null, "lost": 2, "malformed": 0 } ],
            "writes": 3, "writes_refused": 1, "keyframes": 4, "records_incomplete": 0, "records_lost": 2,
            "faults": 1, "retain_bytes": 16, "retain_file_failures": 0,
        });
        insta::assert_snapshot!(text("plc", &answer), @r"
        plc        plc
        state      fault
        fault      division by zero at main.st:4:3
                   `dinrail plc run --service plc` starts the program again, RETAIN kept; `dinrail plc load` another one
        program    main.st io.st, 0123456789abcdef
        scans      4711
        scan time  12.4 us on average, 80.0 us at most, begun 3.0 us late at most, over the last second
        skipped    1 period of tasks, because scans came late
        trigger    io: 9 events, 1 missed, 0 overdue
        forced     Main.Limit, %QX0.3
        inputs     io: good, 12 ms old; bus: no data, 2 lost
        writes     3 taken from the rail, 1 of them refused
        retain     16 bytes
        recording  4 keyframes, 2 scan records lost
        faults     1 fault since the service started
        ");
        let idle = json!({ "state": "run", "scan": 0, "program": [], "program_hash": "0", "fault": null, "inputs": [] });
        insta::assert_snapshot!(text("plc", &idle), @r"
        plc      plc
        state    run
        program  none: image and routes only
        scans    0
        ");
        assert_eq!(text("plc", &Value::Null), "plc  plc");
    }
}
