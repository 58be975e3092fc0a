use super::*;
use crate::payload::{PART_BYTES, Stamp};
use proptest::prelude::*;

fn patch(offset: u32, len: u8, value: [u8; 8]) -> Patch {
    Patch { offset, len, mask: [0xFF; 8], value }
}

fn example(writer: &mut Writer, input: &[u8], op: &[u8]) -> Vec<u8> {
    let source = Source { writer: 3, generation: 2, seq: 77 };
    writer.begin();
    writer.control(&source, &Command::Start(Start::Warm));
    writer.control(&source, &Command::Force { patch: patch(300, 2, [1; 8]), path: "prg.speed" });
    let at = writer.input_begin(&source);
    writer.input_range(4, 1, 2, input);
    writer.input_end(at);
    writer.write(&source, 4, op);
    writer.forces(&[patch(300, 2, [1; 8])]);
    writer.trigger(&Trigger { source, count: 41, missed: 2, overdue: false });
    writer.skipped(1, 9);
    writer.fault(&Fault { task: 1, trap: 2, statement: 5, instance: 640, value: 10, real: 0.5, text: "x" });
    let at = writer.changes_begin();
    writer.change(260, &[1, 2, 3]);
    writer.change(4096, &[9]);
    writer.changes_end(at);
    let head =
        Head { scan: 12, plc_time_ns: -5, memory_hash: 99, start: Start::Warm as u8, ..Head::default() };
    writer.finish(&head).to_vec()
}

#[test]
fn what_was_written_is_read_in_the_same_order() {
    let mut writer = Writer::new(MAX_RECORD_BYTES);
    let bytes = example(&mut writer, &[7, 8], b"op");
    let content = Content::parse(&bytes).unwrap();
    assert_eq!((content.head.scan, content.head.plc_time_ns, content.start()), (12, -5, Some(Start::Warm)));
    let mut names = Vec::new();
    for section in content.sections() {
        names.push(match section {
            Section::Control { source, command: Command::Start(Start::Warm) } => {
                assert_eq!(source.seq, 77);
                "start"
            }
            Section::Control { command: Command::Force { path: "prg.speed", patch }, .. } => {
                assert_eq!(patch.offset, 300);
                "force"
            }
            Section::Input { ranges, .. } => {
                assert_eq!(ranges.collect::<Vec<_>>(), [(4, 1, 2, &[7u8, 8][..])]);
                "input"
            }
            Section::Write { result: 4, tail: b"op", .. } => "write",
            Section::Forces(table) => {
                assert_eq!(table.len(), 1);
                "forces"
            }
            Section::Trigger(trigger) => {
                let source = Source { writer: 3, generation: 2, seq: 77 };
                assert_eq!(trigger, Trigger { source, count: 41, missed: 2, overdue: false });
                "trigger"
            }
            Section::Skipped { task: 1, periods: 9 } => "skipped",
            Section::Fault(fault) => {
                assert_eq!((fault.trap, fault.value, fault.text), (2, 10, "x"));
                "fault"
            }
            Section::Changes(changes) => {
                assert_eq!(changes.collect::<Vec<_>>(), [(260, &[1u8, 2, 3][..]), (4096, &[9])]);
                "changes"
            }
            other => panic!("{other:?}"),
        });
    }
    assert_eq!(
        names,
        ["start", "force", "input", "write", "forces", "trigger", "skipped", "fault", "changes"]
    );
}

#[test]
fn a_full_buffer_leaves_sections_out_and_says_so() {
    let mut writer = Writer::new(200);
    let bytes = example(&mut writer, &[0; 100], b"op");
    let content = Content::parse(&bytes).unwrap();
    assert_ne!(content.head.flags & flag::INCOMPLETE, 0);
    assert!(bytes.len() <= 200);
    writer.begin();
    assert_eq!(writer.finish(&Head::default()).len(), HEAD_BYTES);
    assert!(!writer.overflowed());
}

#[test]
fn an_empty_list_of_changes_takes_no_room() {
    let mut writer = Writer::new(1024);
    writer.begin();
    let at = writer.changes_begin();
    writer.changes_end(at);
    assert_eq!(writer.finish(&Head::default()).len(), HEAD_BYTES);
}

fn send(
    joiner: &mut Joiner,
    seq: &mut u64,
    generation: u32,
    scan: u64,
    content: &[u8],
    skip: &[usize],
) -> (u32, u32) {
    let (mut gaps, mut wholes) = (0, 0);
    for (i, part) in parts(content).enumerate() {
        let mut header = part_header(scan, i, content.len());
        header.stamp = Stamp { seq: *seq, t_ns: 0, generation, writer: 5 };
        header.n = part.len() as u32;
        *seq += 1;
        if skip.contains(&i) {
            continue;
        }
        let step = joiner.push(&header, part);
        gaps += u32::from(step.gap.is_some());
        if let Some(whole) = step.whole {
            assert_eq!(whole.bytes, content);
            assert_eq!((whole.generation, whole.scan), (generation, scan));
            wholes += 1;
        }
    }
    (gaps, wholes)
}

#[test]
fn losses_are_gaps_and_only_whole_contents_come_out() {
    let mut joiner = Joiner::new(MAX_RECORD_BYTES);
    let long = vec![3u8; PART_BYTES * 2 + 5];
    let mut seq = 1;
    assert_eq!(send(&mut joiner, &mut seq, 1, 1, &long, &[]), (0, 1));
    assert_eq!(send(&mut joiner, &mut seq, 1, 2, b"short", &[]), (0, 1));
    assert_eq!(send(&mut joiner, &mut seq, 1, 3, &long, &[1]), (1, 0));
    assert_eq!(send(&mut joiner, &mut seq, 1, 4, &long, &[0]), (1, 0));
    assert_eq!(send(&mut joiner, &mut seq, 1, 5, &long, &[2]), (0, 0));
    // The loss at the end of 5 shows with the first part of 6.
    assert_eq!(send(&mut joiner, &mut seq, 1, 6, &long, &[]), (1, 1));
    // A writer that died in the middle: its successor begins anew.
    assert_eq!(send(&mut joiner, &mut seq, 1, 7, &long, &[1, 2]), (0, 0));
    seq = 1;
    assert_eq!(send(&mut joiner, &mut seq, 2, 1, &long, &[]), (1, 1));
}

#[test]
fn the_last_number_of_a_writer_overflows_nothing() {
    let mut joiner = Joiner::new(MAX_RECORD_BYTES);
    let mut push = |seq| {
        let mut header = part_header(1, 0, 1);
        header.stamp = Stamp { seq, t_ns: 0, generation: 1, writer: 5 };
        let step = joiner.push(&header, &[0]);
        (step.gap.map(|gap| gap.messages), step.whole.is_some())
    };
    assert_eq!(push(u64::MAX), (None, true));
    assert_eq!(push(0), (None, true));
    assert_eq!(push(u64::MAX), (Some(u64::MAX - 1), true));
}

proptest! {
    #[test]
    fn any_bytes_are_read_without_panic(bytes in prop::collection::vec(any::<u8>(), 0..400)) {
        let _ = Content::parse(&bytes);
        let mut with_head = vec![0u8; HEAD_BYTES];
        (with_head[0], with_head[1]) = (VERSION, 1);
        with_head.extend_from_slice(&bytes);
        if let Ok(content) = Content::parse(&with_head) {
            for section in content.sections() {
                let mut memory = [0u8; 64];
                if let Section::Forces(table) = section {
                    for patch in table { let _ = patch.apply(&mut memory); }
                }
            }
        }
    }

    #[test]
    fn damaged_records_are_read_without_panic(at in 0usize..400, bit in 0u8..8, cut in 0usize..400) {
        let mut writer = Writer::new(MAX_RECORD_BYTES);
        let mut bytes = example(&mut writer, &[1, 2, 3], b"operation");
        let at = at % bytes.len();
        bytes[at] ^= 1 << bit;
        if let Ok(content) = Content::parse(&bytes) { prop_assert!(content.sections().count() < 100); }
        let _ = Content::parse(&bytes[..cut.min(bytes.len())]);
    }

    #[test]
    fn any_parts_are_joined_without_panic(
        heads in prop::collection::vec((0u64..4, 0u32..4, 0u32..4, 0u32..9000, 0usize..2049, 0u64..3), 0..40)
    ) {
        let mut joiner = Joiner::new(8192);
        for (scan, part, parts, total, len, seq) in heads {
            let mut header = crate::payload::ScanPart { scan, part, parts, total, ..Default::default() };
            header.stamp = Stamp { seq, t_ns: 0, generation: 1, writer: 1 };
            if let Some(whole) = joiner.push(&header, &vec![0; len]).whole {
                prop_assert!(whole.bytes.len() <= 8192);
            }
        }
    }
}
