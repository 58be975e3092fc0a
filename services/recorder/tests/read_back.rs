//! Recordings read by python's `mcap` alone: no code of ours between the file and the values.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a test that fails")]

mod common;

use common::{Rig, TempDir, frame, one_of_each, stack};
use dinrail_recorder::{Compression, Config, recover};
use ipc_types::clock;
use serde_json::{Value, json};
use std::path::Path;
use std::process::Command;

#[path = "../../../tests/support/python.rs"]
mod python;
use python::python;

fn read_back(python: &Path, file: &Path, options: &[&str]) -> Value {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/read_back.py");
    let output = Command::new(python).arg(script).arg(file).args(options).output().unwrap();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{}: {errors}", file.display());
    serde_json::from_slice(&output.stdout).unwrap()
}

fn check_values(found: &Value) {
    let last = &found["last"];
    assert_eq!(last["can0/rx"]["can_id"], 0x9ABC_DEF0u32);
    assert_eq!(last["can0/rx"]["len"], 12);
    assert_eq!(last["can0/rx"]["data"], "68656c6c6f2c2043414e2121".to_owned() + &"00".repeat(52));
    assert_eq!(last["io/inputs"]["ranges"], 2);
    assert_eq!(last["io/inputs"]["data"], "0102030001");
    assert_eq!(last["plc/scan"]["scan"], 77);
    assert_eq!(last["plc/scan"]["parts"], 2);
    assert_eq!(last["plc/scan"]["seq"], 0x1_0000_0005u64);
    assert_eq!(last["plc/scan"]["data"], "090807");
    assert_eq!(last["plc/keyframe"]["data"], "6b6579");
    assert_eq!(last["plc/results"]["job_seq"], 9);
    assert_eq!(last["plc/results"]["code"], 3);
    assert_eq!(last["can0/status"], json!({ "load": 0.25 }));
    assert_eq!(last["stack/events"], json!({ "event": "died", "message": "Überlast" }));
}

#[test]
fn every_payload_is_read_by_python_alone() {
    let Some(python) = python() else { return };
    for (compression, index) in
        [(Compression::Zstd, true), (Compression::None, true), (Compression::Zstd, false)]
    {
        let dir = TempDir::new("python");
        let mut rig = Rig::start(stack(dir.path()), Config { compression, index, ..Config::default() });
        let messages = one_of_each(clock::mono_ns());
        rig.send(&messages);
        let files = rig.stop();
        assert_eq!(files.len(), 1);
        let found = read_back(&python, &files[0], &[]);
        check_values(&found);
        assert_eq!(found["profile"], "x-dinrail");
        // The recorder's own last word comes on top.
        assert_eq!(found["statistics"], messages.len() + 1);
        assert_eq!(found["filtered"], 2);
        assert_eq!(found["in_order"], true);
        assert_eq!(found["last"]["recorder/gaps"]["text"], "recorded 8, missed 0");
        assert_eq!(found["last"]["recorder/gaps"]["final"], true);
        assert_eq!(found["attachments"]["main.st"], json!(["PROGRAM main END_PROGRAM"]));
        assert_eq!(found["attachments"]["stack.toml"], json!(["[stack]\nname = \"test\"\n"]));
        assert!(found["attachments"]["stack.json"][0].as_str().unwrap().contains("\"build-1\""));
        assert_eq!(found["metadata"]["dinrail.recording"][0]["build"], "build-1");
        assert!(
            found["metadata"]["dinrail.clock"][0]["utc_offset_ns"].as_str().unwrap().parse::<i64>().unwrap()
                > 0
        );
    }
}

#[test]
fn a_file_is_read_while_it_is_written_and_after_it_was_cut_off() {
    let Some(python) = python() else { return };
    let dir = TempDir::new("live");
    let mut rig = Rig::start(stack(dir.path()), Config::default());
    let mut seq = 2;
    let t = clock::mono_ns();
    // More than a chunk, so that both closed chunks and raw messages are there.
    for _ in 0..8 {
        let frames: Vec<_> = (0..500)
            .map(|_| {
                seq += 1;
                frame(seq, t)
            })
            .collect();
        rig.send(&frames);
    }
    rig.send(&one_of_each(t));
    rig.settle();
    let copy = dir.path().join("copy.mcap");
    std::fs::copy(&rig.files()[0], &copy).unwrap();
    let found = read_back(&python, &copy, &["--unfinished"]);
    check_values(&found);
    assert_eq!(found["messages"]["can0/rx"], 4002);
    assert_eq!(found["ended"], "end of file");
    let cut = std::fs::metadata(&copy).unwrap().len() - 40;
    std::fs::File::options().write(true).open(&copy).unwrap().set_len(cut).unwrap();
    let report = recover(&copy).unwrap();
    assert!(!report.already_sealed && report.bytes_lost > 0);
    let found = read_back(&python, &copy, &[]);
    // 4000 frames and the eight, less those behind the last checksum that was not cut.
    let kept = found["statistics"].as_u64().unwrap();
    assert!((3960..4008).contains(&kept), "{kept}");
    assert_eq!(found["metadata"]["dinrail.sealed"][0]["messages"], kept.to_string());
    rig.stop();
}
