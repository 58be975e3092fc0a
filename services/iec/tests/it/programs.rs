//! Programs as engineers write them, with what they must do: files of `programs/`.
//!
//! A file holds several programs, each behind a line `=== name`. Lines in them that say what is expected:
//! `//> 100 in = 1 | q = 0, et = 100000000`: the scan at 100 ms with these inputs leaves these values;
//! `//> fault IndexOutOfBounds 7`: the first scan faults in line 7; `//! E0904 3`: refused with this code in line 3
//! (several lines: all of them, in this order), `//! W0201 3`: a warning. Line 1 follows the `===`.

use std::path::Path;

use dinrail_iec::{Options, compile};

use crate::host::{Host, Value, source};

/// `a = 1, b[2] = -1.5`
fn pairs(text: &str) -> Vec<(String, String)> {
    text.split(", ")
        .filter(|p| !p.trim().is_empty())
        .map(|p| {
            let (name, value) = p.split_once('=').unwrap_or_else(|| panic!("no `=` in `{p}`"));
            (name.trim().to_owned(), value.trim().to_owned())
        })
        .collect()
}

fn value(text: &str, like: Value) -> Value {
    match like {
        Value::Int(_) => Value::Int(text.parse().unwrap_or_else(|_| panic!("`{text}` is no integer"))),
        Value::Real(_) => Value::Real(text.parse().unwrap_or_else(|_| panic!("`{text}` is no number"))),
    }
}

fn same(expected: Value, got: Value) -> bool {
    match (expected, got) {
        (Value::Real(e), Value::Real(g)) => {
            e == g || (e.is_nan() && g.is_nan()) || (e - g).abs() <= 1e-6 * e.abs().max(1e-30)
        }
        (e, g) => e == g,
    }
}

/// What is wrong with a program; nothing, if it does what it must.
fn judge(text: &str) -> Vec<String> {
    let mut wrong = Vec::new();
    let expected: Vec<&str> =
        text.lines().filter_map(|l| l.trim().strip_prefix("//! ")).map(str::trim).collect();
    let steps: Vec<&str> = text.lines().filter_map(|l| l.trim().strip_prefix("//> ")).collect();
    assert!(!expected.is_empty() || !steps.is_empty(), "nothing is expected of:\n{text}");
    let (found, rendered) = match compile(&source(text), &Options::default()) {
        Ok(c) => (c.warnings.clone(), c.render_warnings(&source(text), false)),
        Err(d) => (d.items().to_vec(), d.render(false)),
    };
    let line = |at: u32| text[..at as usize].matches('\n').count() + 1;
    let got: Vec<String> = found
        .iter()
        .map(|d| format!("{} {}", d.code, d.primary.as_ref().map_or(0, |p| line(p.span.start))))
        .collect();
    if got != expected {
        return vec![format!("diagnostics {got:?}, expected {expected:?}\n{rendered}")];
    }
    if steps.is_empty() {
        return wrong;
    }
    let mut host = Host::new(text);
    for step in steps {
        if let Some(fault) = step.strip_prefix("fault ") {
            let f = host.scan_at(0).unwrap_err();
            let line = f.place.split(':').nth(1).unwrap_or("");
            let got = format!("{:?} {line}", f.id);
            if got != fault {
                wrong.push(format!("fault {got}, expected {fault}"));
            }
            return wrong;
        }
        let (head, out) = step.split_once('|').unwrap_or_else(|| panic!("no `|` in `{step}`"));
        let (t_ms, inputs) = head.trim().split_once(' ').unwrap_or((head.trim(), ""));
        for (name, v) in pairs(inputs) {
            let like = host.get(&name);
            host.set(&name, value(&v, like));
        }
        if let Err(f) = host.scan_at(t_ms.parse::<i64>().unwrap() * 1_000_000) {
            wrong.push(format!("`{step}`: fault {f:?}"));
            return wrong;
        }
        for (name, v) in pairs(out) {
            let got = host.get(&name);
            if !same(value(&v, got), got) {
                wrong.push(format!("`{step}`: {name} is {got:?}, expected {v}"));
            }
        }
    }
    wrong
}

#[test]
fn programs_of_engineers() {
    let dir = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/it/programs");
    let (mut count, mut wrong) = (0, Vec::new());
    let mut files: Vec<_> = std::fs::read_dir(&dir).unwrap().map(|e| e.unwrap().path()).collect();
    files.sort();
    for file in files {
        let text = std::fs::read_to_string(&file).unwrap();
        let name = file.file_name().unwrap().to_string_lossy().into_owned();
        for program in text.split("\n=== ").skip(1) {
            let (title, body) = program.split_once('\n').unwrap();
            count += 1;
            // With and without the hooks of debug builds behind the same values is a matter of other tests.
            let result = std::panic::catch_unwind(|| judge(body)).unwrap_or_else(|e| {
                vec![e.downcast_ref::<String>().cloned().unwrap_or_else(|| "panic".to_owned())]
            });
            wrong.extend(result.into_iter().map(|w| format!("{name}: {title}: {w}")));
        }
    }
    assert!(count > 50, "{count} programs in {}", dir.display());
    assert!(wrong.is_empty(), "{} wrong of {count} programs:\n{}", wrong.len(), wrong.join("\n"));
}
