use super::*;
use crate::program::compile_sources;
use crate::setup::{InputRange, ModByZeroName};
use ipc_types::image_write::{Builder, Op};
use ipc_types::scan_record::{Content, Reason, Section};
use serde_json::json;
use std::time::Duration;

fn build_on(runtime: &Runtime, text: &str, setup: Setup) -> Engine {
    let sources = vec![SourceText { name: "main.st".into(), text: text.into() }];
    let program = compile_sources(sources, &setup).unwrap_or_else(|e| panic!("{e}")).program;
    Engine::new(runtime, Some(program), Arc::new(setup)).unwrap()
}

fn build(text: &str) -> Engine {
    build_on(&Runtime::new().unwrap(), text, Setup { cycle_ns: Some(10_000_000), ..Setup::default() })
}

fn begin(engine: &mut Engine, t_ms: i64) {
    engine.begin(Stamps { t_ns: t_ms as u64 * 1_000_000, plc_time_ns: t_ms * 1_000_000, utc_ns: 0 });
}

fn scan(engine: &mut Engine, t_ms: i64, commands: &[Command<'_>]) -> ScanOutcome {
    begin(engine, t_ms);
    for command in commands {
        engine.control(&Source::default(), command);
    }
    engine.finish()
}

fn value(engine: &Engine, path: &str) -> serde_json::Value {
    engine.resolve(path).unwrap_or_else(|e| panic!("{e}")).json(engine.memory())
}

fn patch(engine: &Engine, path: &str, value: serde_json::Value) -> Patch {
    engine.resolve(path).unwrap().patch(path, &value).unwrap()
}

const COLD: &[Command<'_>] = &[Command::Start(Start::Cold)];

#[test]
fn a_blinky_blinks_only_after_its_start() {
    let mut engine = build("PROGRAM main VAR lamp AT %QX0.0 : BOOL; END_VAR lamp := NOT lamp; END_PROGRAM");
    assert_eq!(scan(&mut engine, 0, &[]).outcome, Outcome::Idle);
    assert_eq!(engine.state(), PlcState::Starting);
    let mut seen = Vec::new();
    for i in 0..5 {
        assert_eq!(scan(&mut engine, i * 10, if i == 0 { COLD } else { &[] }).outcome, Outcome::Ok);
        seen.push(value(&engine, "%QX0.0").as_bool().unwrap());
    }
    assert_eq!(seen, [true, false, true, false, true]);
}

const STARTS: &str = "PROGRAM main
VAR n : INT := 5; END_VAR
VAR RETAIN kept : INT := 7; END_VAR
  n := n + 1; kept := kept + 1;
END_PROGRAM";

#[test]
fn starts_keep_what_their_kind_says() {
    let mut engine = build(STARTS);
    let both =
        |engine: &Engine| (value(engine, "n").as_i64().unwrap(), value(engine, "kept").as_i64().unwrap());
    scan(&mut engine, 0, COLD);
    scan(&mut engine, 10, &[]);
    assert_eq!(both(&engine), (7, 9));
    scan(&mut engine, 20, &[Command::Start(Start::Hot)]);
    assert_eq!(both(&engine), (8, 10));
    scan(&mut engine, 30, &[Command::Start(Start::Warm)]);
    assert_eq!(both(&engine), (6, 11));
    scan(&mut engine, 40, &[Command::Start(Start::Cold)]);
    assert_eq!(both(&engine), (6, 8));
    scan(&mut engine, 50, &[Command::Stop]);
    assert_eq!((engine.state(), both(&engine)), (PlcState::Stop, (6, 8)));
    // Another process: RETAIN comes from where it was kept.
    let kept = engine.retain().to_vec();
    let mut next = build(STARTS);
    assert_eq!(next.retain_layout(), engine.retain_layout());
    assert!(next.set_retain(&kept) && !next.set_retain(&[]));
    scan(&mut next, 60, &[Command::Start(Start::Warm)]);
    assert_eq!(both(&next), (6, 9));
}

#[test]
fn forces_win_over_field_program_and_writes_until_they_end() {
    let mut engine = build(
        "PROGRAM main VAR i AT %IB0 : USINT; q AT %QB0 : USINT; m AT %MB0 : USINT; seen : USINT; END_VAR
         seen := i; q := q + 1; END_PROGRAM",
    );
    scan(&mut engine, 0, COLD);
    let (i, q) = (patch(&engine, "i", json!(9)), patch(&engine, "q", json!(50)));
    scan(&mut engine, 10, &[Command::Force { patch: i, path: "i" }, Command::Force { patch: q, path: "q" }]);
    assert_eq!((value(&engine, "seen"), value(&engine, "q")), (json!(9), json!(50)));
    scan(&mut engine, 20, &[Command::Unforce { patch: i, path: "i" }]);
    assert_eq!((value(&engine, "seen"), value(&engine, "q")), (json!(0), json!(50)));
    assert_eq!(engine.forces().map(|(path, _)| path).collect::<Vec<_>>(), ["q"]);
    scan(&mut engine, 30, &[Command::UnforceAll]);
    assert_eq!(value(&engine, "q"), json!(51));
    // A bit beside a forced bit stays free.
    let bit = patch(&engine, "%MX0.3", json!(true));
    begin(&mut engine, 40);
    engine.control(&Source::default(), &Command::Force { patch: bit, path: "%MX0.3" });
    let mut ops = Builder::default();
    ops.push(&Op::Set { area: ImageArea::Marker, offset: 0, bytes: &[0x11] }).unwrap();
    assert_eq!(engine.write(&Source::default(), write_result::APPLIED, ops.tail()), write_result::APPLIED);
    engine.finish();
    assert_eq!(value(&engine, "m"), json!(0x19));
}

#[test]
fn writes_are_whole_or_not_at_all() {
    let mut engine = build("PROGRAM main VAR q AT %QB0 : USINT; END_VAR ; END_PROGRAM");
    scan(&mut engine, 0, COLD);
    begin(&mut engine, 10);
    let source = Source { writer: 4, generation: 1, seq: 9 };
    let mut ops = Builder::default();
    ops.push(&Op::Set { area: ImageArea::Output, offset: 0, bytes: &[7] }).unwrap();
    ops.push(&Op::Set { area: ImageArea::Marker, offset: 4095, bytes: &[1, 2] }).unwrap();
    assert_eq!(engine.write(&source, 0, ops.tail()), write_result::OUTSIDE);
    assert_eq!(engine.write(&source, 0, &[1, 2, 3]), write_result::MALFORMED);
    assert_eq!(engine.write(&source, write_result::TOO_OLD, &[]), write_result::TOO_OLD);
    let mut ops = Builder::default();
    ops.push(&Op::Set { area: ImageArea::Input, offset: 0, bytes: &[7] }).unwrap();
    assert_eq!(engine.write(&source, 0, ops.tail()), write_result::OUTSIDE);
    engine.finish();
    assert_eq!(value(&engine, "q"), json!(0));
    let content = Content::parse(engine.record()).unwrap();
    let results: Vec<u32> = content
        .sections()
        .filter_map(|s| match s {
            Section::Write { result, source: Source { seq: 9, .. }, .. } => Some(result),
            _ => None,
        })
        .collect();
    assert_eq!(results, [4, 3, 1, 4]);
}

fn with_inputs(text: &str) -> Engine {
    let range = |byte, bytes, bit, on_bad, status_byte| InputRange {
        owner: "io".into(),
        label: String::new(),
        byte,
        bytes,
        bit,
        on_bad,
        status_byte,
    };
    let inputs = vec![
        range(0, 2, None, OnBad::Hold, Some(10)),
        range(2, 2, None, OnBad::Zero, None),
        range(4, 1, Some(3), OnBad::Zero, None),
    ];
    build_on(&Runtime::new().unwrap(), text, Setup { inputs, ..Setup::default() })
}

fn deliver(engine: &mut Engine, t_ms: i64, ranges: &[(u16, Quality, &[u8])]) -> Vec<(u16, u8, u32, Vec<u8>)> {
    begin(engine, t_ms);
    let at = engine.input_begin(&Source { writer: 2, generation: 1, seq: 1 });
    for (range, quality, bytes) in ranges {
        engine.input_range(*range, *quality as u8, 0, bytes);
    }
    engine.input_end(at);
    engine.finish();
    let content = Content::parse(engine.record()).unwrap();
    content
        .sections()
        .flat_map(|s| match s {
            Section::Input { ranges, .. } => ranges.map(|(r, q, at, b)| (r, q, at, b.to_vec())).collect(),
            _ => Vec::new(),
        })
        .collect()
}

#[test]
fn inputs_are_recorded_by_value_and_go_bad_as_configured() {
    use Quality::{Good, OwnerDead, Stale};
    let mut engine = with_inputs("PROGRAM main ; END_PROGRAM");
    scan(&mut engine, 0, COLD);
    assert_eq!(value(&engine, "%IB10"), json!(Quality::NoData as u8));
    let recorded = deliver(&mut engine, 10, &[(0, Good, &[1, 2]), (1, Good, &[3, 4]), (2, Good, &[1])]);
    assert_eq!(recorded, [(0, 0, 0, vec![1, 2]), (1, 0, 0, vec![3, 4]), (2, 0, 0, vec![1])]);
    assert_eq!(engine.image_bytes()[..11], [1, 2, 3, 4, 8, 0, 0, 0, 0, 0, 0]);
    // Only what changed is recorded.
    let recorded = deliver(&mut engine, 20, &[(0, Good, &[1, 9]), (1, Good, &[3, 4]), (2, Good, &[1])]);
    assert_eq!(recorded, [(0, 0, 1, vec![9])]);
    // A living owner's substitute counts, a dead one's bytes do not.
    deliver(&mut engine, 30, &[(0, Stale, &[5, 5])]);
    assert_eq!(engine.image_bytes()[..11], [5, 5, 3, 4, 8, 0, 0, 0, 0, 0, 1]);
    deliver(&mut engine, 40, &[(0, OwnerDead, &[]), (1, OwnerDead, &[]), (2, OwnerDead, &[])]);
    assert_eq!(engine.image_bytes()[..11], [5, 5, 0, 0, 0, 0, 0, 0, 0, 0, 3]);
    deliver(&mut engine, 50, &[(1, Good, &[3, 4])]);
    assert_eq!(engine.image_bytes()[2..4], [3, 4]);
}

#[test]
fn without_a_program_routes_move_the_image() {
    let route = |from: &str, to: &str| serde_json::from_value(json!({ "from": from, "to": to })).unwrap();
    let setup = Setup { routes: vec![route("%IW0", "%QW1"), route("%MB0", "%QB0")], ..Setup::default() };
    let mut engine = Engine::new(&Runtime::new().unwrap(), None, Arc::new(setup)).unwrap();
    scan(&mut engine, 0, COLD);
    assert_eq!(engine.state(), PlcState::Run);
    let (i, m) = (patch(&engine, "%IW0", json!(513)), patch(&engine, "%MB0", json!(4)));
    scan(&mut engine, 10, &[Command::Set { patch: i, path: "" }, Command::Set { patch: m, path: "" }]);
    assert_eq!((value(&engine, "%QW1"), value(&engine, "%QB0")), (json!(513), json!(4)));
    assert_eq!(engine.program_hash(), 0);
}

const FAULTS: &str = "FUNCTION_BLOCK pump
VAR_INPUT demand : INT; END_VAR
VAR speed : INT; table : ARRAY [0..3] OF INT; END_VAR
  speed := 100 / demand;
  table[demand] := speed;
END_FUNCTION_BLOCK

PROGRAM main
VAR p1 : pump; p2 : pump; want : INT := 1; x : REAL; i : INT; END_VAR
  p1(demand := 1);
  p2(demand := want);
  IF want = 2 THEN
    x := 1.0E30;
    i := REAL_TO_INT(x);
  END_IF;
END_PROGRAM";

#[test]
fn faults_name_place_instance_and_values() {
    let mut engine = build(FAULTS);
    let mut messages = Vec::new();
    for want in [0, 7, 2] {
        scan(&mut engine, 0, COLD);
        assert_eq!(engine.state(), PlcState::Run);
        let set = patch(&engine, "main.want", json!(want));
        let outcome = scan(&mut engine, 10, &[Command::Set { patch: set, path: "main.want" }]);
        assert_eq!((outcome.outcome, engine.state()), (Outcome::Trap, PlcState::Fault));
        let fault = outcome.fault.unwrap();
        assert_eq!(fault.file, "main.st");
        messages.push(fault.message.clone());
        assert_eq!(scan(&mut engine, 20, &[]).outcome, Outcome::Idle);
    }
    insta::assert_snapshot!(messages.join("\n"), @r"
    division by zero at main.st:4:3, in main.p2, task main; dividend 100; statement: speed := 100 / demand; with demand = 0, speed = 100
    array index out of bounds at main.st:5:3, in main.p2, task main; index 7; statement: table[demand] := speed; with demand = 7, speed = 14
    REAL value does not fit the integer type at main.st:14:5, in main, task main; value 1.0000000150474662e30; statement: i := REAL_TO_INT(x); with x = 1e+30, i = 0, want = 2
    ");
}

#[test]
fn a_watchdog_kill_undoes_the_scan_and_can_be_replayed_without_a_watchdog() {
    let text = "PROGRAM main
VAR endless : BOOL; n : DINT; q AT %QB0 : USINT; END_VAR
VAR RETAIN r : INT; END_VAR
  n := n + 1; q := q + 1; r := r + 1;
  WHILE endless DO n := n + 1; END_WHILE;
END_PROGRAM";
    let (runtime, _watchdog) = Runtime::with_watchdog(Duration::from_millis(50)).unwrap();
    let mut live = build_on(&runtime, text, Setup::default());
    let mut again = build(text);
    scan(&mut live, 0, COLD);
    scan(&mut again, 0, COLD);
    let set = patch(&live, "endless", json!(true));
    let outcome = scan(&mut live, 10, &[Command::Set { patch: set, path: "endless" }]);
    let fault = outcome.fault.unwrap();
    assert_eq!(fault.trap, TrapId::Watchdog as u32);
    assert!(fault.message.starts_with("watchdog: the task ran too long at main.st:5:"), "{}", fault.message);
    assert_eq!((value(&live, "q"), value(&live, "r"), value(&live, "n")), (json!(1), json!(1), json!(0)));
    let record = live.record().to_vec();
    crate::verify::replay(&mut again, &Content::parse(&record).unwrap());
    let (a, b) = (Content::parse(&record).unwrap().head, Content::parse(again.record()).unwrap().head);
    assert_eq!((a.memory_hash, a.state_after, a.outcome), (b.memory_hash, b.state_after, b.outcome));
    // It starts again, warm.
    scan(&mut live, 20, &[Command::Start(Start::Warm)]);
    assert_eq!((live.state(), value(&live, "n"), value(&live, "r")), (PlcState::Run, json!(1), json!(2)));
}

#[test]
fn an_engine_continues_from_a_keyframe() {
    let text = "PROGRAM main
VAR t : TON; n : DINT; q AT %QW0 : INT; a : ARRAY [0..99] OF DINT; END_VAR
  t(IN := TRUE, PT := T#35ms);
  n := n + 1; a[n MOD 100] := n;
  IF t.Q THEN q := q + 1; END_IF;
END_PROGRAM";
    let mut first = build(text);
    for i in 0..5 {
        scan(&mut first, i * 10, if i == 0 { COLD } else { &[] });
    }
    let force = patch(&first, "q", json!(-3));
    scan(&mut first, 50, &[Command::Force { patch: force, path: "q" }]);
    let keyframe = first.take_keyframe(Reason::Request).to_vec();
    let mut second = build(text);
    second.restore(&Content::parse(&keyframe).unwrap()).unwrap();
    for i in 6..40 {
        scan(&mut first, i * 10, &[]);
        scan(&mut second, i * 10, &[]);
        assert_eq!(first.record(), second.record());
    }
    let mut other = build(STARTS);
    assert!(matches!(
        other.restore(&Content::parse(&keyframe).unwrap()),
        Err(RestoreError::OtherProgram(..))
    ));
}

#[test]
fn mod_by_zero_warns_or_faults() {
    let text = "PROGRAM main VAR a : INT := 5; z : INT; r : INT := 9; END_VAR r := a MOD z; END_PROGRAM";
    let mut engine = build(text);
    scan(&mut engine, 0, COLD);
    assert_eq!((value(&engine, "r"), engine.warnings()), (json!(0), 1));
    let setup = Setup { mod_by_zero: ModByZeroName::Fault, ..Setup::default() };
    let mut engine = build_on(&Runtime::new().unwrap(), text, setup);
    assert_eq!(scan(&mut engine, 0, COLD).outcome, Outcome::Trap);
}

#[test]
fn variables_are_found_and_wrong_values_refused_with_a_remedy() {
    let engine = build(
        "PROGRAM main VAR a : ARRAY [1..3] OF INT; t : TIME; r : REAL; w : WORD; f : R_TRIG; g : F_TRIG; END_VAR f(CLK := TRUE); g(CLK := TRUE); END_PROGRAM",
    );
    let error = |path: &str, value: serde_json::Value| match engine.resolve(path) {
        Ok(cell) => cell.patch(path, &value).unwrap_err().to_string(),
        Err(e) => e.to_string(),
    };
    let texts = [
        error("a", json!(1)),
        error("a[4]", json!(1)),
        error("a[1]", json!(40000)),
        error("main.b", json!(1)),
        error("Q", json!(1)),
        error("%IX0.9", json!(1)),
        error("%MW9999", json!(1)),
        error("t", json!("soon")),
        error("r", json!("x")),
    ];
    insta::assert_snapshot!(texts.join("\n"), @r#"
    'main.a' is an array [1..3]: write an element, like main.a[1]
    'main.a': index 4 lies outside [1..3]
    'a[1]' is INT; 40000 does not fit: give a whole number in its range
    no variable 'main.b'
    no variable 'Q'; did you mean main.f.Q or main.g.Q?
    `%IX0.9`: a byte has the bits 0 to 7; bit 9 of byte 0 is %IX1.1
    '%MW9999': this place is beyond the end of its area
    't' is TIME; "soon" does not fit: give milliseconds or a text like "1.5s"
    'r' is REAL; "x" does not fit: give a number
    "#);
    for (path, value, text) in [
        ("t", json!("T#1.5s"), "T#1500ms"),
        ("t", json!(20), "T#20ms"),
        ("r", json!(0.1), "0.1"),
        ("w", json!("16#FF"), "255"),
        ("a[2]", json!(-5), "-5"),
    ] {
        let cell = engine.resolve(path).unwrap();
        let mut memory = engine.memory().to_vec();
        assert!(cell.patch(path, &value).unwrap().apply(&mut memory));
        assert_eq!(cell.text(&memory), text, "{path}");
    }
}

/// 24.8 and 49.7 days are where 32-bit milliseconds end; PLC time and TIME are 64-bit nanoseconds.
#[test]
fn weeks_of_running_wrap_nothing_but_what_is_32_bits_wide() {
    let mut engine = build(
        "PROGRAM main VAR t : TON; d : DINT; u : UDINT; l : LINT; m AT %MD0 : TIME; n : UDINT; END_VAR
         t(IN := TRUE, PT := T#60d); l := TIME_TO_LINT(t.ET); u := TIME_TO_UDINT(t.ET); d := TIME_TO_DINT(t.ET); m := t.ET; n := n + 1; END_PROGRAM",
    );
    const DAY: i64 = 86_400_000;
    scan(&mut engine, 0, COLD);
    engine.scan = u64::from(u32::MAX);
    let wrapped = |ms: i64| json!(ms as u32 as i32);
    for (day, q) in [(24, false), (25, false), (49, false), (50, false), (60, true), (1000, true)] {
        let before = engine.scan();
        let outcome = scan(&mut engine, day * DAY, &[]);
        assert_eq!(outcome.outcome, Outcome::Ok);
        // The engine was not there for all these periods; they are counted, not made up for.
        assert!(outcome.skipped > 0);
        let et = day.min(60) * DAY;
        for (var, expected) in [
            ("t.ET", json!(et)),
            ("t.Q", json!(q)),
            ("l", json!(et)),
            ("u", json!(et as u32)),
            ("d", wrapped(et)),
            ("m", wrapped(et)),
        ] {
            assert_eq!(value(&engine, var), expected, "{var} after {day} days");
        }
        assert_eq!(engine.scan(), before + 1);
        assert_eq!(Content::parse(engine.record()).unwrap().head.scan, before + 1);
    }
    assert_eq!(value(&engine, "n"), json!(7));
    // At the end of 292 years the schedule ends, without a fault.
    for ms in [i64::MAX / 1_000_000 - 1, i64::MAX / 1_000_000] {
        assert_eq!(scan(&mut engine, ms, &[]).outcome, Outcome::Ok);
    }
    assert!(engine.next_task_ns().is_some());
}
