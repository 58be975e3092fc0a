//! Files that are cut off, damaged or hostile: never a panic, never more than was written, nothing lost that
//! stands before the damage.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a test that fails")]

mod common;

use common::{Rig, TempDir, frame, keyframe, one_of_each, stack};
use dinrail_recorder::reader::{OwnedMessage, Recording};
use dinrail_recorder::{Compression, Config, Filter, Format, ReadError, SealError, cat, disk, info, recover};
use ipc_types::clock;
use proptest::prelude::*;
use std::path::{Path, PathBuf};

/// A small recording: finished, and as it stood on disk before it was.
fn small(dir: &Path, compression: Compression) -> (PathBuf, PathBuf) {
    let mut rig = Rig::start(stack(dir), Config { compression, ..Config::default() });
    let t = clock::mono_ns();
    rig.send(&one_of_each(t));
    for i in 0..5u64 {
        rig.send(&[frame(10 + i, t + 100 + i), keyframe(2 + i, t + 100 + i)]);
    }
    rig.settle();
    let live = dir.join("live.mcap");
    std::fs::copy(&rig.files()[0], &live).unwrap();
    let files = rig.stop();
    (files[0].clone(), live)
}

fn read(path: &Path) -> (Vec<OwnedMessage>, bool) {
    let mut messages = Recording::open(path).unwrap().messages();
    let all: Vec<_> = messages.by_ref().map(Result::unwrap).collect();
    let finished = messages.recording().end().finished;
    (all, finished)
}

#[test]
fn a_file_cut_off_at_any_byte_gives_what_stands_before_the_cut() {
    for compression in [Compression::Zstd, Compression::None] {
        let dir = TempDir::fast("cut");
        let (finished, live) = small(dir.path(), compression);
        for file in [&finished, &live] {
            let bytes = std::fs::read(file).unwrap();
            let (all, whole) = read(file);
            assert_eq!(whole, file == &finished);
            let found = info(file).unwrap();
            assert_eq!(all.len(), 18 + usize::from(whole), "messages, and the recorder's last word: {found}");
            let cut = dir.path().join("cut.mcap");
            let mut before = 0;
            for len in 0..bytes.len() {
                std::fs::write(&cut, &bytes[..len]).unwrap();
                let (some, whole) = read(&cut);
                assert!(!whole, "{len}");
                assert!(some.len() >= before, "more bytes, fewer messages at {len}");
                assert!(some.iter().zip(&all).all(|(a, b)| a == b), "{len}");
                before = some.len();
                // Sealing is slower: a sample of the cuts, and all near the end.
                if len % 97 == 0 || len + 64 > bytes.len() {
                    let report = recover(&cut).unwrap();
                    assert_eq!((report.messages, report.already_sealed), (some.len() as u64, false));
                    let (sealed, whole) = read(&cut);
                    assert!(whole && disk::is_finished(&cut));
                    assert_eq!(sealed, some);
                    assert!(recover(&cut).unwrap().already_sealed);
                }
            }
            // The live file's last byte is its last message's.
            assert_eq!(before, all.len() - usize::from(!whole));
        }
    }
}

/// Everything that reads files, on any bytes.
fn survive(path: &Path) {
    if let Ok(recording) = Recording::open(path) {
        for message in recording.messages() {
            message.unwrap();
        }
        let _ = info(path).unwrap().to_string();
        for format in [Format::Json, Format::Candump] {
            cat(path, &Filter::default(), format, &mut std::io::sink()).unwrap();
        }
        recover(path).unwrap();
        assert!(disk::is_finished(path));
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 200, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn flipped_bytes_are_survived(
        flips in proptest::collection::vec((any::<prop::sample::Index>(), 1u8..), 1..6), which in 0usize..4,
    ) {
        thread_local! {
            static FILES: (TempDir, Vec<Vec<u8>>) = {
                let dir = TempDir::fast("flip");
                let mut files = Vec::new();
                for compression in [Compression::Zstd, Compression::None] {
                    let of = TempDir::fast("flip-of");
                    let (finished, live) = small(of.path(), compression);
                    files.push(std::fs::read(finished).unwrap());
                    files.push(std::fs::read(live).unwrap());
                }
                (dir, files)
            };
        }
        FILES.with(|(dir, files)| {
            let mut bytes = files[which].clone();
            for (at, with) in flips {
                let at = at.index(bytes.len());
                bytes[at] ^= with;
            }
            let path = dir.path().join("flipped.mcap");
            if let Ok(recording) = Recording::from_bytes(Path::new("flipped"), bytes.clone()) {
                recording.messages().for_each(|m| drop(m.unwrap()));
            }
            std::fs::write(&path, bytes).unwrap();
            survive(&path);
        });
    }

    #[test]
    fn any_records_are_survived(
        records in proptest::collection::vec((0u8..=0x10, any::<Option<u64>>(), proptest::collection::vec(any::<u8>(), 0..80)), 0..8),
        zstd: bool,
    ) {
        let dir = TempDir::fast("records");
        let mut bytes = mcap::MAGIC.to_vec();
        for (opcode, len, mut body) in records {
            if opcode == 6 {
                // A chunk head that holds, with lengths of chance.
                let name: &[u8] = if zstd { b"zstd" } else { b"" };
                let mut chunk = vec![0u8; 16];
                chunk.extend_from_slice(&len.unwrap_or(64).to_le_bytes());
                chunk.extend_from_slice(&0u32.to_le_bytes());
                chunk.extend_from_slice(&(name.len() as u32).to_le_bytes());
                chunk.extend_from_slice(name);
                chunk.extend_from_slice(&(body.len() as u64).to_le_bytes());
                chunk.append(&mut body);
                body = chunk;
            }
            bytes.push(opcode);
            let stated = if opcode == 6 { body.len() as u64 } else { len.unwrap_or(body.len() as u64) };
            bytes.extend_from_slice(&stated.to_le_bytes());
            bytes.append(&mut body);
        }
        let path = dir.path().join("any.mcap");
        std::fs::write(&path, bytes).unwrap();
        survive(&path);
    }
}

#[test]
fn a_damaged_chunk_costs_itself_alone() {
    let dir = TempDir::new("damage");
    let mut rig = Rig::start(stack(dir.path()), Config::default());
    let t = clock::mono_ns();
    for round in 0..12u64 {
        let frames: Vec<_> = (0..1000).map(|i| frame(round * 1000 + i + 1, t + round * 1000 + i)).collect();
        rig.send(&frames);
    }
    let file = rig.stop().remove(0);
    let mut bytes = std::fs::read(&file).unwrap();
    // Within the second chunk of messages, which follows the first one's index.
    let chunk = |n: usize| {
        let head = |w: &[u8]| w[0] == 6 && w[3..9] == [0; 6] && w[37..45] == *b"\x04\0\0\0zstd";
        bytes.windows(45).enumerate().filter(|(_, w)| head(w)).nth(n).unwrap().0
    };
    let middle = chunk(2) + 200;
    bytes[middle] ^= 0xFF;
    std::fs::write(&file, &bytes).unwrap();
    let found = info(&file).unwrap();
    assert!(found.finished && found.end.damaged == 1, "{found}");
    let frames = &found.channels[0];
    assert!(frames.messages > 8000 && frames.messages < 12_000, "{found}");
    assert_eq!(frames.gaps, Some(12_000 - frames.messages), "the numbers of the frames tell what is missing");
    assert_eq!(found.gaps.as_ref().unwrap().recorded, 12_000);
    let text = found.to_string();
    assert!(text.contains("finished, but 1 damaged parts are left out"), "{text}");
    let report = recover(&file).unwrap();
    assert!(!report.already_sealed && report.bytes_lost > 0);
    assert_eq!(info(&file).unwrap().end.damaged, 0);
}

#[test]
fn what_is_no_recording_is_refused_with_path_and_remedy() {
    let dir = TempDir::new("refuse");
    let text = dir.path().join("notes.txt");
    std::fs::write(&text, "not an MCAP file").unwrap();
    let error = Recording::open(&text).err().unwrap();
    assert!(matches!(error, ReadError::NotMcap { .. }));
    assert!(error.to_string().contains("notes.txt is no MCAP file"), "{error}");
    let missing = dir.path().join("missing.mcap");
    let error = Recording::open(&missing).err().unwrap().to_string();
    assert!(error.contains("missing.mcap") && error.contains("dinrail recordings"), "{error}");
    assert!(Recording::open(dir.path()).err().unwrap().to_string().contains("is a folder"));
    // lz4 is named with its remedy, and what stands outside of chunks is still read.
    let mut bytes = mcap::MAGIC.to_vec();
    let mut chunk = vec![0u8; 28];
    chunk.extend_from_slice(&3u32.to_le_bytes());
    chunk.extend_from_slice(b"lz4");
    chunk.extend_from_slice(&0u64.to_le_bytes());
    bytes.push(6);
    bytes.extend_from_slice(&(chunk.len() as u64).to_le_bytes());
    bytes.append(&mut chunk);
    std::fs::write(&text, bytes).unwrap();
    let found = info(&text).unwrap();
    assert!(found.end.damages[0].reason.contains("mcap compress --compression zstd"), "{found}");
}

#[test]
fn a_file_in_use_is_not_sealed() {
    let dir = TempDir::new("in-use");
    let mut rig = Rig::start(stack(dir.path()), Config::default());
    rig.send(&[frame(1, clock::mono_ns())]);
    rig.settle();
    let error = recover(&rig.files()[0]).unwrap_err();
    assert!(matches!(error, SealError::InUse(_)), "{error}");
    let files = rig.stop();
    assert!(recover(&files[0]).unwrap().already_sealed);
}
