use super::*;
use crate::program::compile_sources;
use crate::setup::InputRange;
use dinrail_iec::Source as SourceText;
use ipc_types::image_write::{Builder, Op};
use ipc_types::scan_record::{Command, Source, Start, Trigger, tag};
use ipc_types::wiring::{Area, OnBad};
use proptest::prelude::*;
use serde_json::json;

const PROGRAM: &str = "PROGRAM main
VAR
  button AT %IX0.0 : BOOL; level AT %IW1 : UINT;
  lamp AT %QX0.0 : BOOL; speed AT %QW1 : INT; setpoint AT %MW0 : INT;
  t : TON; count : DINT; sum : REAL; table : ARRAY [0..9] OF INT;
END_VAR
VAR RETAIN hours : DINT; END_VAR
  t(IN := button, PT := T#30ms);
  lamp := t.Q;
  count := count + 1;
  IF count MOD 10 = 0 THEN hours := hours + 1; END_IF;
  sum := sum + UINT_TO_REAL(level) * 0.25;
  table[count MOD 10] := setpoint;
  speed := setpoint + 3;
  IF setpoint = 77 THEN speed := 1 / (setpoint - 77); END_IF;
END_PROGRAM";

type Recording = Vec<(u32, Vec<u8>)>;

fn program(text: &str, setup: &Setup) -> Arc<Program> {
    let sources = vec![SourceText { name: "main.st".into(), text: text.into() }];
    compile_sources(sources, setup).unwrap_or_else(|e| panic!("{e}")).program
}

fn setup() -> Setup {
    let range = |byte, bytes| InputRange {
        owner: "io".into(),
        label: String::new(),
        byte,
        bytes,
        bit: None,
        on_bad: OnBad::Zero,
        status_byte: None,
    };
    Setup { cycle_ns: Some(10_000_000), inputs: vec![range(0, 1), range(2, 2)], ..Setup::default() }
}

#[derive(Debug, Clone)]
enum Step {
    Nothing,
    Input(bool, u16),
    Bad,
    Write(i16),
    Force(i16),
    Unforce,
    Start(Start),
    Stop,
    Set(f32),
    /// The event came, so many were missed; or it is overdue.
    Event(u64, bool),
}

fn step() -> impl Strategy<Value = Step> {
    prop_oneof![
        4 => Just(Step::Nothing),
        4 => (any::<bool>(), any::<u16>()).prop_map(|(b, l)| Step::Input(b, l)),
        1 => Just(Step::Bad),
        3 => prop_oneof![any::<i16>(), Just(77i16)].prop_map(Step::Write),
        1 => any::<i16>().prop_map(Step::Force),
        1 => Just(Step::Unforce),
        1 => prop_oneof![Just(Start::Cold), Just(Start::Warm), Just(Start::Hot)].prop_map(Step::Start),
        1 => Just(Step::Stop),
        1 => any::<f32>().prop_map(Step::Set),
        3 => (0u64..4, any::<bool>()).prop_map(|(missed, overdue)| Step::Event(missed, overdue)),
    ]
}

/// Records a run in virtual time: keyframe 0, then a record a step, keyframes every `every` scans.
fn record(steps: &[(Step, i64)], every: usize) -> Recording {
    record_as(setup(), steps, every)
}

fn record_as(setup: Setup, steps: &[(Step, i64)], every: usize) -> Recording {
    let program = program(PROGRAM, &setup);
    let mut engine = Engine::new(&Runtime::new().unwrap(), Some(program), Arc::new(setup)).unwrap();
    let mut out: Recording = vec![(1, engine.take_keyframe(Reason::EngineStart).to_vec())];
    let (mut t_ns, mut base_ns) = (5_000_000i64, 0i64);
    for (i, (step, jitter_ns)) in steps.iter().enumerate() {
        t_ns += 10_000_000 + jitter_ns;
        let cold = i == 0 || matches!(step, Step::Start(Start::Cold));
        if cold {
            base_ns = t_ns;
        }
        engine.begin(Stamps { t_ns: t_ns as u64, plc_time_ns: t_ns - base_ns, utc_ns: t_ns + 1_000 });
        let source = Source { writer: 3, generation: 1, seq: i as u64 + 1 };
        if i == 0 {
            engine.control(&source, &Command::Start(Start::Cold));
        }
        apply(&mut engine, &source, step);
        engine.finish();
        out.push((1, engine.record().to_vec()));
        if (i + 1) % every == 0 {
            out.push((1, engine.take_keyframe(Reason::Periodic).to_vec()));
        }
    }
    out
}

fn apply(engine: &mut Engine, source: &Source, step: &Step) {
    let patch = |engine: &Engine, path: &str, value: serde_json::Value| {
        engine.resolve(path).unwrap().patch(path, &value).unwrap()
    };
    match step {
        Step::Nothing => {}
        Step::Input(button, level) => {
            let at = engine.input_begin(source);
            engine.input_range(0, 0, 0, &[u8::from(*button)]);
            engine.input_range(1, 0, 0, &level.to_le_bytes());
            engine.input_end(at);
        }
        Step::Bad => {
            let at = engine.input_begin(source);
            engine.input_range(1, 3, 0, &[]);
            engine.input_end(at);
        }
        Step::Write(n) => {
            let mut ops = Builder::default();
            ops.push(&Op::Set { area: Area::Marker, offset: 0, bytes: &n.to_le_bytes() }).unwrap();
            engine.write(source, 0, ops.tail());
        }
        Step::Force(n) => {
            let patch = patch(engine, "main.speed", json!(n));
            engine.control(source, &Command::Force { patch, path: "main.speed" });
        }
        Step::Unforce => engine.control(source, &Command::UnforceAll),
        Step::Start(kind) => engine.control(source, &Command::Start(*kind)),
        Step::Stop => engine.control(source, &Command::Stop),
        Step::Set(x) => {
            let value = if x.is_finite() { json!(x) } else { json!(0.0) };
            let patch = patch(engine, "main.sum", value);
            engine.control(source, &Command::Set { patch, path: "main.sum" });
        }
        Step::Event(missed, overdue) => {
            let count = source.seq;
            engine.trigger(&Trigger { source: *source, count, missed: *missed, overdue: *overdue });
        }
    }
}

/// The implicit task waits for an event.
fn triggered() -> Setup {
    let event =
        crate::config::EventTrigger { service: "io".into(), event: ipc_types::wiring::ServiceEvent::Sync };
    Setup { cycle_ns: None, trigger: Some(event), ..setup() }
}

fn verify_with(recording: &[(u32, Vec<u8>)], compare: Option<&str>) -> Report {
    verify_as(setup(), recording, compare)
}

fn verify_as(setup: Setup, recording: &[(u32, Vec<u8>)], compare: Option<&str>) -> Report {
    let known = program(PROGRAM, &setup);
    let provider: Provider<'_> =
        Box::new(move |hash, _| (hash == known.artifact.hash()).then(|| known.clone()));
    let mut verifier = Verifier::new(provider).unwrap();
    if let Some(text) = compare {
        verifier = verifier.compare(program(text, &setup));
    }
    for (generation, bytes) in recording {
        verifier.push(*generation, bytes).unwrap();
    }
    verifier.finish().unwrap()
}

fn verify(recording: &[(u32, Vec<u8>)]) -> Report {
    verify_with(recording, None)
}

fn plain(count: usize) -> Vec<(Step, i64)> {
    let kinds = [
        Step::Input(true, 10),
        Step::Nothing,
        Step::Write(5),
        Step::Input(true, 300),
        Step::Force(11),
        Step::Nothing,
        Step::Unforce,
        Step::Input(false, 7),
    ];
    (0..count).map(|i| (kinds[i % kinds.len()].clone(), (i as i64 * 7919) % 90_000)).collect()
}

#[test]
fn a_recording_without_loss_is_exact() {
    let report = verify(&record(&plain(200), 50));
    assert!(report.first_difference.is_none(), "{report:#?}");
    assert_eq!((report.scans, report.scans_verified, report.exit_code()), (200, 200, 0));
    assert_eq!(report.keyframes_checked, 4);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]
    #[test]
    fn whatever_happens_a_scan_is_a_function_of_its_record(
        steps in prop::collection::vec((step(), -3_000_000i64..40_000_000), 1..120)
    ) {
        let report = verify(&record(&steps, 37));
        prop_assert_eq!(&report.first_difference, &None);
        prop_assert_eq!(report.scans_verified, steps.len() as u64);
        prop_assert_eq!(report.exit_code(), 0);
        let report = verify_as(triggered(), &record_as(triggered(), &steps, 37), None);
        prop_assert_eq!(&report.first_difference, &None);
        prop_assert_eq!((report.scans_verified, report.exit_code()), (steps.len() as u64, 0));
    }
}

#[test]
fn a_task_runs_in_the_scans_whose_record_says_that_the_event_came() {
    let steps: Vec<(Step, i64)> = [
        Step::Nothing,
        Step::Event(0, false),
        Step::Input(true, 5),
        Step::Event(2, false),
        Step::Stop,
        Step::Event(0, false),
        Step::Start(Start::Hot),
        Step::Event(0, true),
        Step::Write(9),
    ]
    .into_iter()
    .map(|step| (step, 0))
    .collect();
    let recording = record_as(triggered(), &steps, 3);
    let report = verify_as(triggered(), &recording, None);
    assert_eq!((report.scans_verified, report.exit_code(), &report.first_difference), (9, 0, &None));
    let ran: Vec<bool> = recording
        .iter()
        .filter_map(|(_, bytes)| Content::parse(bytes).ok().filter(|c| c.head.kind == Kind::Scan))
        .map(|c| c.head.tasks_ran != 0)
        .collect();
    // The first and the hot start are scans of the task as well.
    assert_eq!(ran, [true, true, false, true, false, false, true, true, false]);
    let skipped: Vec<u64> = recording
        .iter()
        .filter_map(|(_, bytes)| Content::parse(bytes).ok())
        .flat_map(|c| {
            c.sections()
                .filter_map(|s| if let Section::Skipped { periods, .. } = s { Some(periods) } else { None })
                .collect::<Vec<_>>()
        })
        .collect();
    assert_eq!(skipped, [2]);
    // Without what the record says of the event the task does not run.
    let mut without = recording.clone();
    let bytes = &mut without[2].1;
    let content = Content::parse(bytes).unwrap();
    assert!(
        content.sections().any(|s| matches!(s, Section::Trigger(Trigger { missed: 0, overdue: false, .. })))
    );
    let at = ipc_types::scan_record::HEAD_BYTES;
    assert_eq!(bytes[at], tag::TRIGGER);
    bytes[at] = 99;
    let report = verify_as(triggered(), &without, None);
    assert_eq!((report.exit_code(), report.first_difference.map(|d| d.scan)), (1, Some(2)));
}

/// Position of a section's body in the record of a scan.
fn find(
    recording: &Recording,
    scan: u64,
    matches: impl Fn(&Section<'_>) -> Option<*const u8>,
) -> (usize, usize) {
    let (index, bytes) = recording
        .iter()
        .enumerate()
        .map(|(i, (_, bytes))| (i, bytes))
        .find(|(_, bytes)| {
            let content = Content::parse(bytes).unwrap();
            content.head.kind == Kind::Scan && content.head.scan == scan
        })
        .unwrap();
    let content = Content::parse(bytes).unwrap();
    let at = content.sections().find_map(|s| matches(&s)).unwrap();
    (index, at as usize - bytes.as_ptr() as usize)
}

fn flipped(recording: &Recording, (index, at): (usize, usize), bit: u8) -> Difference {
    let mut mutated = recording.clone();
    mutated[index].1[at] ^= 1 << bit;
    let report = verify(&mutated);
    assert_eq!(report.exit_code(), 1, "{report:#?}");
    report.first_difference.unwrap()
}

#[test]
fn one_flipped_bit_of_an_input_is_named() {
    let recording = record(&plain(40), 100);
    let place = find(&recording, 12, |s| match s {
        Section::Input { ranges, .. } => ranges.clone().next().map(|(_, _, _, bytes)| bytes.as_ptr()),
        _ => None,
    });
    let difference = flipped(&recording, place, 1);
    assert_eq!((difference.scan, difference.variable.as_str()), (12, "main.level"));
    assert_eq!((difference.expected.as_str(), difference.got.as_str()), ("300", "302"));
}

#[test]
fn one_flipped_bit_of_a_force_is_named() {
    let recording = record(&plain(40), 100);
    let place = find(&recording, 5, |s| match s {
        Section::Control { command: Command::Force { path, .. }, .. } => {
            // The value stands 8 bytes before the path.
            Some(path.as_ptr().wrapping_sub(8))
        }
        _ => None,
    });
    let difference = flipped(&recording, place, 2);
    assert_eq!((difference.scan, difference.variable.as_str()), (5, "main.speed"));
    assert_eq!((difference.expected.as_str(), difference.got.as_str()), ("11", "15"));
}

#[test]
fn a_changed_stamp_is_named() {
    let recording = record(&plain(40), 100);
    let index = recording.iter().position(|(_, b)| Content::parse(b).unwrap().head.scan == 3).unwrap();
    // PLC time stands at byte 16 of the head; the timer runs in scan 3.
    let difference = flipped(&recording, (index, 16), 3);
    assert_eq!((difference.scan, difference.variable.as_str()), (3, "main.t.ET"), "{difference:?}");
    // UTC at byte 32 is used by no variable: the stamp itself is named.
    let difference = flipped(&recording, (index, 32), 3);
    assert_eq!((difference.scan, difference.variable.as_str()), (3, "the scan's stamp"));
}

#[test]
fn a_changed_constant_is_named() {
    let recording = record(&plain(40), 100);
    for (from, to, variable) in
        [("setpoint + 3", "setpoint + 4", "main.speed"), ("* 0.25", "* 0.5", "main.sum")]
    {
        let report = verify_with(&recording, Some(&PROGRAM.replace(from, to)));
        assert_eq!(report.exit_code(), 1);
        let difference = report.first_difference.unwrap();
        assert_eq!((difference.scan, difference.variable.as_str()), (1, variable), "{difference:?}");
    }
    assert_eq!(verify_with(&recording, Some(PROGRAM)).exit_code(), 0);
    // Another layout: compared by name.
    let report = verify_with(&recording, Some(&PROGRAM.replace("t : TON;", "extra : LREAL; t : TON;")));
    assert_eq!(report.exit_code(), 0, "{report:#?}");
    let other = PROGRAM.replace("t : TON;", "extra : LREAL; t : TON;").replace("* 0.25", "* 0.5");
    assert_eq!(verify_with(&recording, Some(&other)).first_difference.unwrap().variable, "main.sum");
}

#[test]
fn any_flipped_bit_of_a_record_is_caught_or_changes_nothing_that_counts() {
    let recording = record(&plain(8), 100);
    for index in [1, 3, 5] {
        for at in 0..recording[index].1.len() {
            let mut mutated = recording.clone();
            mutated[index].1[at] ^= 0x10;
            let report = verify(&mutated);
            if report.exit_code() == 0 {
                // Who sent it, and names: information, no input of the scan.
                let content = Content::parse(&mutated[index].1).unwrap();
                assert_eq!(
                    content.head.memory_hash,
                    Content::parse(&recording[index].1).unwrap().head.memory_hash
                );
            }
        }
    }
}

#[test]
fn losses_are_listed_and_verification_goes_on_at_the_next_keyframe() {
    let mut recording = record(&plain(100), 20);
    // Keyframes stand at 0, 21, 42, ...; scan 30 and 31 vanish.
    recording.retain(|(_, bytes)| {
        let head = Content::parse(bytes).unwrap().head;
        head.kind == Kind::Keyframe || !(30..=31).contains(&head.scan)
    });
    let report = verify(&recording);
    assert_eq!(report.exit_code(), 3, "{report:#?}");
    assert_eq!(report.unverifiable.len(), 1);
    assert_eq!((report.unverifiable[0].from, report.unverifiable[0].to), (30, 40));
    assert_eq!((report.scans, report.scans_verified), (100, 89));
}

#[test]
fn a_recording_that_begins_in_the_middle_waits_for_its_keyframe() {
    let mut recording = record(&plain(60), 20);
    recording.remove(0);
    let report = verify(&recording);
    assert_eq!(report.exit_code(), 3);
    assert_eq!(report.scans_verified, 40);
    assert_eq!(report.unverifiable[0].reason, "no keyframe before it");
    // Keyframes that come late still count for what waited.
    let mut late = record(&plain(60), 100);
    let keyframe = late.remove(0);
    late.insert(30, keyframe);
    assert_eq!(verify(&late).exit_code(), 0);
}

#[test]
fn an_unknown_program_is_unverifiable_not_wrong() {
    let mut verifier = Verifier::new(Box::new(|_, _| None)).unwrap();
    for (generation, bytes) in record(&plain(10), 100) {
        verifier.push(generation, &bytes).unwrap();
    }
    let report = verifier.finish().unwrap();
    assert_eq!(report.exit_code(), 3);
    assert!(report.unverifiable[0].reason.contains("not in the recording"));
}

#[test]
fn rubbish_is_survived() {
    let mut recording = record(&plain(10), 100);
    recording.insert(4, (1, vec![1, 2, 3]));
    recording.insert(8, (1, vec![0; 500]));
    assert_eq!(verify(&recording).exit_code(), 3);
}

fn without(recording: &Recording, missing: impl Fn(Kind, u64) -> bool) -> Recording {
    let mut some = recording.clone();
    some.retain(|(_, bytes)| {
        let head = Content::parse(bytes).unwrap().head;
        !missing(head.kind, head.scan)
    });
    some
}

fn spans(report: &Report) -> Vec<(u32, u64, u64)> {
    report.unverifiable.iter().map(|u| (u.generation, u.from, u.to)).collect()
}

#[test]
fn scans_that_are_missing_before_the_last_keyframe_are_listed() {
    let recording = record(&plain(40), 20);
    // The last keyframe is the file's end, or nearly.
    let report = verify(&without(&recording, |kind, scan| kind == Kind::Scan && scan > 33));
    assert_eq!((report.exit_code(), spans(&report)), (3, vec![(1, 34, 40)]), "{report:#?}");
    assert_eq!((report.scans, report.scans_verified), (40, 33));
    // None between two keyframes.
    let report = verify(&without(&recording, |kind, scan| kind == Kind::Scan && scan > 20));
    assert_eq!((report.exit_code(), spans(&report)), (3, vec![(1, 21, 40)]), "{report:#?}");
}

#[test]
fn a_damaged_record_is_told_wherever_it_stands() {
    let recording = record(&plain(40), 20);
    for (index, (_, bytes)) in recording.iter().enumerate() {
        let head = Content::parse(bytes).unwrap().head;
        let mut damaged = recording.clone();
        damaged[index].1[1] = 9;
        let report = verify(&damaged);
        assert_eq!(report.exit_code(), 3, "{head:?}: {report:#?}");
        assert!(report.incomplete[0].contains("a record is damaged"), "{report:#?}");
        if head.kind == Kind::Scan && head.scan < 40 {
            let first = report.unverifiable.first().unwrap();
            assert_eq!(first.from, head.scan, "{report:#?}");
        }
    }
    // A keyframe whose memory is another one than its head says is no ground to stand on.
    let mut damaged = recording;
    let len = damaged[0].1.len();
    damaged[0].1[len / 2] ^= 1;
    let report = verify(&damaged);
    assert!(report.exit_code() == 3 || report.exit_code() == 1, "{report:#?}");
}

#[test]
fn an_engine_that_started_anew_without_its_first_keyframe_is_listed_from_its_first_scan() {
    let mut recording = record(&plain(30), 10);
    let second: Recording = record(&plain(30), 10).into_iter().map(|(_, bytes)| (2, bytes)).collect();
    let both: Recording = recording.iter().cloned().chain(second.clone()).collect();
    assert_eq!(verify(&both).exit_code(), 0);
    // Keyframe 0 and scans 1 to 4 of the second are lost, then also those up to its next keyframe.
    for last in [4, 10] {
        let lost: Recording = second
            .iter()
            .filter(|(_, bytes)| {
                let head = Content::parse(bytes).unwrap().head;
                !(head.scan <= last && (head.kind == Kind::Scan || head.scan == 0))
            })
            .cloned()
            .collect();
        let all: Recording = recording.iter().cloned().chain(lost).collect();
        let report = verify(&all);
        assert_eq!((report.exit_code(), spans(&report)), (3, vec![(2, 1, 10)]), "{report:#?}");
        assert_eq!(report.scans_verified, 50);
    }
    // A keyframe of the first engine waits for records that never come when the second one starts.
    recording = without(&recording, |kind, scan| kind == Kind::Scan && scan > 25);
    let all: Recording = recording.iter().cloned().chain(second).collect();
    let report = verify(&all);
    assert_eq!((report.exit_code(), spans(&report)), (3, vec![(1, 26, 30)]), "{report:#?}");
}

#[test]
fn what_came_without_a_number_is_told() {
    let run = |gaps: &[u64], doubts: &[&str]| {
        let known = program(PROGRAM, &setup());
        let mut verifier = Verifier::new(Box::new(move |_, _| Some(known.clone()))).unwrap();
        for (generation, bytes) in record(&plain(10), 100) {
            verifier.push(generation, &bytes).unwrap();
        }
        for n in gaps {
            verifier.gap(*n);
        }
        for why in doubts {
            verifier.doubt((*why).to_owned());
        }
        verifier.finish().unwrap()
    };
    assert_eq!(run(&[], &[]).exit_code(), 0);
    let report = run(&[3, 0], &[]);
    assert_eq!((report.exit_code(), report.incomplete.len()), (3, 1), "{report:#?}");
    assert_eq!(run(&[], &["cut off"]).exit_code(), 3);
    assert_eq!(run(&[], &["many"; 500]).incomplete.len(), MAX_DOUBTS);
    assert_eq!(verify(&[]).exit_code(), 3, "nothing verified is not exact");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]
    /// Whatever is left out, doubled or late: each scan is verified or listed, and only what lies before the first or behind
    /// the last content of all can be missing unnoticed.
    #[test]
    fn every_scan_is_accounted_for(
        left_out in prop::collection::btree_set(0usize..67, 0..12),
        moved in prop::collection::vec((0usize..67, 0usize..67), 0..3),
    ) {
        let whole = record(&plain(60), 10);
        let mut some: Recording =
            whole.iter().enumerate().filter(|(i, _)| !left_out.contains(i)).map(|(_, c)| c.clone()).collect();
        for (from, to) in moved {
            let content = some[from % some.len()].clone();
            let to = to % some.len();
            some.insert(to, content);
        }
        let report = verify(&some);
        prop_assert!(report.exact, "{:#?}", report);
        let listed: u64 = report.unverifiable.iter().map(|u| u.to + 1 - u.from).sum();
        prop_assert_eq!(report.scans, report.scans_verified + listed, "{:#?}", &report);
        let heads: Vec<Head> = some.iter().map(|(_, b)| Content::parse(b).unwrap().head).collect();
        let there: std::collections::BTreeSet<u64> =
            heads.iter().filter(|h| h.kind == Kind::Scan).map(|h| h.scan).collect();
        prop_assert!(report.scans_verified <= there.len() as u64, "{:#?}", &report);
        if report.exit_code() == 0 {
            prop_assert_eq!(report.scans_verified, there.len() as u64, "{:#?}", &report);
            prop_assert_eq!(heads.iter().map(|h| h.scan).max(), there.last().copied());
        }
    }
}
