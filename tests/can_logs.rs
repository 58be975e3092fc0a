//! CAN logs from and to the formats of others, with python-can as the judge.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod support;

use serde_json::Value;
use std::fs;
use std::path::Path;
use support::commands::{frames, ok, refused, text};
use support::{Scratch, Stack, cases, peers};

#[test]
fn logs_tell_who_sent_a_frame() {
    let scratch = Scratch::new("direction");
    let log =
        scratch.write("told.log", "(0000000001.000000) can0 123#01 T\n(0000000001.100000) can0 124#02 R\n");
    let recording = scratch.0.join("told.mcap");
    ok(&["recordings", "import", text(&log), "-o", text(&recording)]);
    let exported = ok(&["recordings", "export", text(&recording), "--direction"]);
    assert_eq!(exported, fs::read_to_string(&log).unwrap());
    assert_eq!(
        ok(&["recordings", "export", text(&recording)]),
        exported.replace(" T\n", "\n").replace(" R\n", "\n")
    );
    let info = ok(&["recordings", "info", text(&recording)]);
    assert!(
        info.contains("  imported   from told.log (candump log), host ") && !info.contains("build"),
        "{info}"
    );
    let untold = scratch.write("untold.log", "(0000000001.000000) can0 123#01\n");
    ok(&["recordings", "import", text(&untold), "-o", text(&recording), "--force"]);
    let info = ok(&["recordings", "info", text(&recording)]);
    assert!(
        info.contains("(candump log), host ") && info.contains("does not tell sent frames from received"),
        "{info}"
    );
    // Nothing is made up.
    let exported = ok(&["recordings", "export", text(&recording), "--direction"]);
    assert_eq!(exported, "(0000000001.000000) can0 123#01\n");
    let (code, said) = refused(&["recordings", "export", text(&recording), "--format", "asc", "--direction"]);
    assert!(code == 2 && said.contains("an ASC file always tells the direction"), "{said}");
}

/// A log with every kind of frame that the formats have in common: python-can takes an empty FD frame of an ASC file for a
/// remote one.
fn mix() -> String {
    let kinds = [
        "123#",
        "123#11",
        "7FF#1122334455667788",
        "00000123#01",
        "1FFFFFFF#A1B2",
        "123#R",
        "123#R8",
        "12345678#R3",
        "123##0AA",
        "123##1000102030405060708090A0B",
        "00000001##2FF",
        "1ABCDEF0##311223344",
        "20000080#0000000000000000",
    ];
    let long = "0123456789ABCDEF".repeat(8);
    let mut log = String::new();
    for i in 0..500u64 {
        let us = 1_506_783_973_191_777 + i * 1009;
        let frame = if i % 14 == 13 { format!("456##1{long}") } else { kinds[(i % 14) as usize].to_owned() };
        log += &format!("({}.{:06}) can{} {frame}\n", us / 1_000_000, us % 1_000_000, i % 3);
    }
    log
}

#[test]
fn python_can_reads_what_is_exported_and_writes_what_is_imported() {
    let Some(mut python) = peers::peer("can_logs.py") else { return };
    let scratch = Scratch::new("logs");
    let mut sources = vec![scratch.write("mix.log", mix())];
    if let Some(cases) = cases() {
        sources.push(cases.join("canlogs/savvycan/examples_candump.log"));
    }
    let mut read = |path: &Path| {
        let output = python_run(&mut python, &["read", text(path)]);
        output.lines().map(|line| serde_json::from_str(line).unwrap()).collect::<Vec<Value>>()
    };
    for (i, source) in sources.iter().enumerate() {
        let (recording, asc, candump, theirs) = (
            scratch.0.join(format!("{i}.mcap")),
            scratch.0.join(format!("{i}.asc")),
            scratch.0.join(format!("{i}.log")),
            scratch.0.join(format!("{i}.theirs.asc")),
        );
        let expected = read(source);
        assert!(expected.len() >= 500);
        ok(&["recordings", "import", text(source), "-o", text(&recording)]);
        let info: Value =
            serde_json::from_str(&ok(&["recordings", "info", text(&recording), "--json"])).unwrap();
        assert_eq!((&info["finished"], &info["messages"]), (&true.into(), &expected.len().into()), "{info}");
        ok(&["recordings", "export", text(&recording), "-o", text(&asc)]);
        ok(&["recordings", "export", text(&recording), "-o", text(&candump)]);
        same(&read(&candump), &expected, "candump");
        same(&read(&asc), &expected, "ASC");
        // And what python-can makes of it, read by us. Its stamps count from the first frame.
        let mut convert = peers::peer("can_logs.py").unwrap();
        python_run(&mut convert, &["convert", text(source), text(&theirs)]);
        let back = scratch.0.join(format!("{i}.back.log"));
        ok(&["recordings", "export", text(&theirs), "-o", text(&back), "--format", "candump"]);
        let relative = |rows: Vec<Value>| -> Vec<Value> {
            let first = rows[0][0].as_i64().unwrap();
            rows.into_iter()
                .map(|mut row| {
                    row[0] = (row[0].as_i64().unwrap() - first).into();
                    row
                })
                .collect()
        };
        same(&relative(read(&back)), &relative(expected), "python-can's ASC");
    }
    let (code, said) =
        refused(&["recordings", "import", text(&sources[0]), "-o", text(&scratch.0.join("0.mcap"))]);
    assert!(code == 1 && said.contains("is there already: name another output, or give --force"), "{said}");
    let csv = scratch.write("x.csv", "Time Stamp,ID,Extended\n");
    let (code, said) = refused(&["recordings", "import", text(&csv), "-o", text(&scratch.0.join("x.mcap"))]);
    assert!(code == 1 && said.contains("x.csv:1: ") && said.contains("can_logconvert"), "{said}");
    assert!(!scratch.0.join("x.mcap").exists());
}

/// The peer with other arguments.
fn python_run(python: &mut std::process::Command, args: &[&str]) -> String {
    let program = python.get_program().to_owned();
    let fixed: Vec<_> = python.get_args().map(std::ffi::OsStr::to_owned).collect();
    let output = std::process::Command::new(program).args(fixed).args(args).output().unwrap();
    assert!(output.status.success(), "{args:?}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

/// Equal, stamps to one microsecond.
fn same(got: &[Value], expected: &[Value], what: &str) {
    assert_eq!(got.len(), expected.len(), "{what}");
    for (i, (got, expected)) in got.iter().zip(expected).enumerate() {
        let (a, b) = (got.as_array().unwrap(), expected.as_array().unwrap());
        let apart = (a[0].as_i64().unwrap() - b[0].as_i64().unwrap()).abs();
        assert!(apart <= 1 && a[1..] == b[1..], "{what}, frame {i}: {got} instead of {expected}");
    }
}

#[test]
fn an_imported_log_plays_in_a_drivers_place() {
    let scratch = Scratch::new("inplace");
    let log = scratch
        .write("one.log", "(1.000) vcan0 123#0102\n(1.010) vcan0 00000123#R2\n(1.020) vcan0 456##1AA\n");
    ok(&["recordings", "import", text(&log), "-o", text(&scratch.0.join("one.mcap")), "--bus", "can0"]);
    let toml = r#"
[stack]
name = "NAME"

[[service]]
name = "can0"
kind = "replay"
file = "one.mcap"
loop = true
"#;
    let mut stack = Stack::spawn_in("inplace", toml, scratch, &[]);
    stack.wait_ready();
    let dumped = frames(&stack.ok(&["can", "dump", "can0", "--count", "9", "--for", "20s"]));
    for frame in ["123#0102", "00000123#R2", "456##1AA"] {
        assert_eq!(dumped.iter().filter(|f| *f == frame).count(), 3, "{dumped:?}");
    }
    assert_eq!(stack.take_down(), 0);
}
