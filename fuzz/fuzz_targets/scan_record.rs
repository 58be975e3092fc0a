//! Scan records: any content is read or refused, its parts join to the same content again, and any sequence of
//! parts, as a rail with losses delivers them, joins to nothing wrong. The first byte chooses.

#![no_main]

use ipc_types::payload::{PART_BYTES, ScanPart, Stamp};
use ipc_types::scan_record::{
    Command, Content, Joiner, MAX_RECORD_BYTES, Patch, Section, part_header, parts,
};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|data: &[u8]| {
    let Some((&choice, rest)) = data.split_first() else { return };
    if choice & 1 == 0 {
        read(rest);
        divide_and_join(rest);
    } else {
        join_any(rest);
    }
});

fn read(bytes: &[u8]) {
    let content = match Content::parse(bytes) {
        Ok(content) => content,
        Err(error) => return assert!(!error.to_string().is_empty()),
    };
    let _ = content.start();
    let mut memory = [0; 256];
    let mut apply = |patch: &Patch| {
        let before = memory;
        assert!(patch.apply(&mut memory) || before == memory);
    };
    for section in content.sections() {
        match section {
            Section::Control { command, .. } => match command {
                Command::Force { patch, .. }
                | Command::Unforce { patch, .. }
                | Command::Set { patch, .. } => {
                    apply(&patch);
                }
                _ => {}
            },
            Section::Forces(table) => table.iter().for_each(&mut apply),
            Section::Input { ranges, .. } => {
                assert!(ranges.map(|(_, _, _, b)| b.len()).sum::<usize>() <= bytes.len())
            }
            Section::Changes(changes) => assert!(changes.map(|(_, b)| b.len()).sum::<usize>() <= bytes.len()),
            _ => {}
        }
    }
}

fn divide_and_join(content: &[u8]) {
    let mut joiner = Joiner::new(MAX_RECORD_BYTES);
    let mut joined = None;
    for (i, part) in parts(content).enumerate() {
        let mut header = part_header(1, i, content.len());
        header.stamp = Stamp { seq: i as u64 + 1, t_ns: 0, generation: 1, writer: 1 };
        header.n = part.len() as u32;
        let step = joiner.push(&header, part);
        assert!(step.gap.is_none());
        joined = step.whole.map(|whole| whole.bytes.to_vec());
    }
    assert_eq!(joined.as_deref(), (content.len() <= MAX_RECORD_BYTES).then_some(content));
}

/// 32 bytes a message: its header, and in the last two the length of its tail.
fn join_any(bytes: &[u8]) {
    let mut joiner = Joiner::new(4 * PART_BYTES);
    for message in bytes.chunks_exact(32) {
        let word = |at: usize| u32::from_le_bytes(message[at..at + 4].try_into().unwrap());
        let header = ScanPart {
            stamp: Stamp {
                seq: u64::from(word(0)) | u64::from(word(4)) << 32,
                t_ns: 0,
                generation: word(8),
                writer: 1,
            },
            scan: u64::from(word(12)),
            part: word(16),
            parts: word(20),
            total: word(24),
            n: u32::from(u16::from_le_bytes([message[30], message[31]])),
        };
        let tail = vec![0; header.n as usize];
        if let Some(whole) = joiner.push(&header, &tail).whole {
            assert!(whole.bytes.len() <= 4 * PART_BYTES);
            assert_eq!(whole.bytes.len(), header.total as usize);
        }
    }
}
