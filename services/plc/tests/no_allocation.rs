//! A scan allocates nothing: counted by a global allocator, over every kind of thing a scan can take.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use dinrail_iec::Source as SourceText;
use dinrail_plc::engine::{Engine, Runtime, Stamps};
use dinrail_plc::program::compile_sources;
use dinrail_plc::setup::{InputRange, Setup};
use ipc_types::image_write::{Builder, Op};
use ipc_types::payload::PlcState;
use ipc_types::scan_record::{Command, Source, Start};
use ipc_types::testing::allocations::{Counting, allocations};
use ipc_types::wiring::{Area, OnBad};
use std::sync::Arc;

#[global_allocator]
static ALLOCATOR: Counting = Counting;

const PROGRAM: &str = "PROGRAM main
VAR level AT %IW0 : UINT; q AT %QW0 : UINT; m AT %MW0 : UINT; t : TON; x : REAL; table : ARRAY [0..999] OF DINT; i : INT; END_VAR
VAR RETAIN r : DINT; END_VAR
  t(IN := TRUE, PT := T#1h);
  FOR i := 0 TO 999 DO table[i] := table[i] + i; END_FOR;
  x := SIN(x + 0.1); q := level + m; r := r + 1;
END_PROGRAM";

#[test]
fn a_scan_allocates_nothing() {
    let input = InputRange {
        owner: "io".into(),
        label: String::new(),
        byte: 0,
        bytes: 2,
        bit: None,
        on_bad: OnBad::Zero,
        status_byte: Some(5),
    };
    let route =
        serde_json::from_value(serde_json::json!({ "from": "%IW0", "to": "%QW5", "scale": 2.0 })).unwrap();
    let setup = Setup { inputs: vec![input], routes: vec![route], ..Setup::default() };
    let sources = vec![SourceText { name: "main.st".into(), text: PROGRAM.into() }];
    let program = compile_sources(sources, &setup).unwrap().program;
    let (runtime, _watchdog) = Runtime::with_watchdog(std::time::Duration::from_secs(5)).unwrap();
    let mut engine = Engine::new(&runtime, Some(program), Arc::new(setup)).unwrap();
    let force = engine.resolve("main.x").unwrap().patch("main.x", &serde_json::json!(0.5)).unwrap();
    let source = Source { writer: 2, generation: 1, seq: 1 };
    let mut ops = Builder::default();
    ops.push(&Op::Set { area: Area::Marker, offset: 0, bytes: &[1, 2] }).unwrap();
    let mut scan = |n: u64, command: Option<Command<'_>>| {
        engine.begin(Stamps { t_ns: n * 1_000_000, plc_time_ns: n as i64 * 1_000_000, utc_ns: 7 });
        if let Some(command) = command {
            engine.control(&source, &command);
        }
        let at = engine.input_begin(&source);
        engine.input_range(0, u8::from(n.is_multiple_of(50)) * 3, 0, &(n as u16).to_le_bytes());
        engine.input_end(at);
        for _ in 0..3 {
            engine.write(&source, 0, ops.tail());
        }
        engine.finish();
        engine.state()
    };
    scan(1, Some(Command::Start(Start::Cold)));
    scan(2, Some(Command::Force { patch: force, path: "main.x" }));
    scan(3, None);
    let allocated = allocations(|| {
        for n in 4..1000 {
            assert_eq!(scan(n, None), PlcState::Run);
        }
    });
    assert_eq!(allocated, 0, "allocations in 996 scans");
}
