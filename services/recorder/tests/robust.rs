//! Files that are cut off, damaged or hostile: never a panic, never more than was written, nothing lost that
//! stands before the damage.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a test that fails")]

mod common;

use common::{Rig, TempDir, frame, keyframe, one_of_each, stack};
use dinrail_recorder::reader::Item;
use dinrail_recorder::reader::{OwnedMessage, Recording};
use dinrail_recorder::{
    Compression, Config, Filter, Format, ReadError, SealError, cat, disk, info, recover, scan_contents,
};
use ipc_types::clock;
use ipc_types::topic::TopicKind;
use proptest::prelude::*;
use std::path::{Path, PathBuf};

/// As many as asked for, else as many as take seconds.
fn cases() -> u32 {
    std::env::var("PROPTEST_CASES").ok().and_then(|n| n.parse().ok()).unwrap_or(200)
}

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
            // The live file's last byte is the checksum's of what was flushed last: a frame and a keyframe.
            assert_eq!(before, all.len() - if whole { 0 } else { 2 });
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

/// Small recordings, finished and not, in turn for each compression, and what stands in them.
struct Files {
    dir: TempDir,
    files: Vec<(Vec<u8>, Vec<OwnedMessage>)>,
}

impl Files {
    fn make() -> Self {
        let mut files = Vec::new();
        for compression in [Compression::Zstd, Compression::None] {
            let of = TempDir::fast("flip-of");
            let (finished, live) = small(of.path(), compression);
            for file in [finished, live] {
                files.push((std::fs::read(&file).unwrap(), read(&file).0));
            }
        }
        Self { dir: TempDir::fast("flip"), files }
    }
}

thread_local! {
    static FILES: Files = Files::make();
}

/// What can happen to bytes.
#[derive(Debug, Clone)]
enum Wound {
    Flip(prop::sample::Index, u8),
    Zero(prop::sample::Index, usize),
    Cut(prop::sample::Index, usize),
    Insert(prop::sample::Index, Vec<u8>),
    /// A piece stands twice, the second time somewhere else.
    Copy(prop::sample::Index, usize, prop::sample::Index),
    End(prop::sample::Index),
}

fn wound() -> impl Strategy<Value = Wound> {
    let at = any::<prop::sample::Index>;
    prop_oneof![
        4 => (at(), 1u8..).prop_map(|(at, with)| Wound::Flip(at, with)),
        1 => (at(), 1usize..600).prop_map(|(at, n)| Wound::Zero(at, n)),
        2 => (at(), 1usize..600).prop_map(|(at, n)| Wound::Cut(at, n)),
        2 => (at(), prop::collection::vec(any::<u8>(), 1..80)).prop_map(|(at, bytes)| Wound::Insert(at, bytes)),
        2 => (at(), 1usize..2000, at()).prop_map(|(from, n, to)| Wound::Copy(from, n, to)),
        1 => at().prop_map(Wound::End),
    ]
}

fn wounded(bytes: &[u8], wounds: &[Wound]) -> Vec<u8> {
    let mut bytes = bytes.to_vec();
    for wound in wounds {
        let len = bytes.len();
        if len == 0 {
            break;
        }
        let end = |at: usize, n: usize| (at + n).min(len);
        match wound {
            Wound::Flip(at, with) => bytes[at.index(len)] ^= with,
            Wound::Zero(at, n) => {
                let at = at.index(len);
                bytes[at..end(at, *n)].fill(0);
            }
            Wound::Cut(at, n) => drop(bytes.drain(at.index(len)..end(at.index(len), *n))),
            Wound::Insert(at, new) => drop(bytes.splice(at.index(len)..at.index(len), new.iter().copied())),
            Wound::Copy(from, n, to) => {
                let piece = bytes[from.index(len)..end(from.index(len), *n)].to_vec();
                bytes.splice(to.index(len)..to.index(len), piece);
            }
            Wound::End(at) => bytes.truncate(at.index(len)),
        }
    }
    bytes
}

/// Topic, kind, header and tail of a message.
type Raw = (String, Option<TopicKind>, Vec<u8>, Vec<u8>);

/// What must be true of any bytes that were such a recording once: nothing that a checksum covers is another message than
/// was recorded, and who is told of no doubt has every message as it was.
fn tells_the_truth(path: &Path, bytes: &[u8], recorded: &[OwnedMessage]) {
    let Ok(mut recording) = Recording::from_bytes(Path::new("wounded"), bytes.to_vec()) else { return };
    let mut found: Vec<Raw> = Vec::new();
    while let Some(item) = recording.next_item().unwrap() {
        let Item::Message(m) = item else { continue };
        found.push((m.channel.topic.clone(), m.channel.kind, m.header.to_vec(), m.tail.to_vec()));
    }
    let end = recording.end().clone();
    let same =
        |(a, b): (&Raw, &OwnedMessage)| (&a.0, a.1, &a.2, &a.3) == (&b.topic, b.kind, &b.header, &b.tail);
    if end.unchecked == 0 {
        for message in &found {
            assert!(recorded.iter().any(|r| same((message, r))), "invented: {message:?}, {end:?}");
        }
    }
    if end.checked && end.damaged == 0 {
        assert_eq!(found.len(), recorded.len(), "{end:?}");
        assert!(found.iter().zip(recorded).all(same), "{end:?}");
    }
    let Ok(mut contents) = scan_contents(path, "plc") else { return };
    let scans: Vec<_> = contents.by_ref().map(Result::unwrap).map(|m| m.tail).collect();
    if contents.integrity().doubts(contents.end(), "plc").is_empty() {
        let is_scan = |m: &&OwnedMessage| matches!(m.kind, Some(TopicKind::Scan | TopicKind::Keyframe));
        let expected: Vec<_> = recorded.iter().filter(is_scan).map(|m| m.tail.clone()).collect();
        assert_eq!(scans, expected, "{end:?}");
    }
}

#[test]
fn an_untouched_recording_leaves_no_doubt_and_one_that_ended_early_does() {
    FILES.with(|Files { dir, files }| {
        for (which, (bytes, recorded)) in files.iter().enumerate() {
            let path = dir.path().join("untouched.mcap");
            std::fs::write(&path, bytes).unwrap();
            tells_the_truth(&path, bytes, recorded);
            let doubts = || {
                let mut contents = scan_contents(&path, "plc").unwrap();
                assert!(contents.by_ref().all(|m| m.is_ok()));
                contents.integrity().doubts(contents.end(), "plc")
            };
            if which % 2 == 0 {
                assert_eq!(doubts(), Vec::<String>::new());
                continue;
            }
            let said = doubts();
            assert!(said.len() == 1 && said[0].contains("the file has no end yet"), "{said:?}");
            recover(&path).unwrap();
            let said = doubts();
            assert!(
                said.len() == 1 && said[0].contains("made whole afterwards, without 0 bytes"),
                "{said:?}"
            );
        }
    });
}

/// Every single bit of a finished recording: only the index behind the data may change without doubt.
#[test]
fn no_flipped_bit_of_the_data_goes_unnoticed() {
    FILES.with(|Files { dir, files }| {
        let path = dir.path().join("bit.mcap");
        for which in [0, 2] {
            let (bytes, recorded) = &files[which];
            for at in 0..bytes.len() {
                let mut bytes = bytes.clone();
                bytes[at] ^= 1 << (at % 8);
                std::fs::write(&path, &bytes).unwrap();
                tells_the_truth(&path, &bytes, recorded);
            }
        }
    });
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::with_cases(cases()) })]

    #[test]
    fn whatever_happens_to_the_bytes_the_reader_tells_the_truth(
        wounds in prop::collection::vec(wound(), 1..5), which in 0usize..4,
    ) {
        FILES.with(|Files { dir, files }| {
            let (bytes, recorded) = &files[which];
            let bytes = wounded(bytes, &wounds);
            let path = dir.path().join("wounded.mcap");
            std::fs::write(&path, &bytes).unwrap();
            tells_the_truth(&path, &bytes, recorded);
        });
    }

    #[test]
    fn flipped_bytes_are_survived(
        flips in proptest::collection::vec((any::<prop::sample::Index>(), 1u8..), 1..6), which in 0usize..4,
    ) {
        FILES.with(|Files { dir, files }| {
            let mut bytes = files[which].0.clone();
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
    assert!(error.contains("missing.mcap") && error.contains("the stack's recorder"), "{error}");
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

/// A record of an MCAP file.
fn record(opcode: u8, body: &[u8]) -> Vec<u8> {
    [&[opcode][..], &(body.len() as u64).to_le_bytes(), body].concat()
}

fn text(s: &str) -> Vec<u8> {
    [&(s.len() as u32).to_le_bytes()[..], s.as_bytes()].concat()
}

/// Another tool's file, made to hurt: names of 70,000 characters and with escape sequences, one large schema of thousands of
/// channels, metadata of a million entries.
#[test]
fn a_hostile_file_of_another_tool_is_shown_within_limits() {
    let dir = TempDir::fast("hostile");
    let path = dir.path().join("hostile\u{1b}[2J.mcap");
    let mut bytes = mcap::MAGIC.to_vec();
    bytes.extend(record(1, &[text("\u{1b}[31m"), text("x")].concat()));
    let schema = vec![b' '; 8 << 20];
    let head =
        [&1u16.to_le_bytes()[..], &text("a\nb"), &text("ros1msg"), &(schema.len() as u32).to_le_bytes()]
            .concat();
    bytes.extend(record(3, &[head, schema].concat()));
    for id in 0..5000u16 {
        let topic = if id == 0 { "t".repeat(70_000) } else { format!("\u{1b}[2J{id}") };
        let body =
            [&id.to_le_bytes()[..], &1u16.to_le_bytes(), &text(&topic), &text("ros1"), &text("")].concat();
        bytes.extend(record(4, &body));
    }
    let mut message = vec![0u8; 22];
    message.extend(b"data");
    bytes.extend(record(5, &message));
    let entries: Vec<u8> =
        (0..1_000_000u32).flat_map(|n| [text(&format!("{n:x}")), text("")].concat()).collect();
    bytes
        .extend(record(12, &[text("many"), (entries.len() as u32).to_le_bytes().to_vec(), entries].concat()));
    std::fs::write(&path, bytes).unwrap();
    let found = info(&path).unwrap();
    assert_eq!(found.messages, 1);
    assert!(found.channels.len() <= 4096);
    let reasons: Vec<_> = found.end.damages.iter().map(|d| d.reason.as_str()).collect();
    assert!(reasons.contains(&"more channels than the reader's limit"), "{reasons:?}");
    let shown = found.to_string();
    assert!(
        shown.lines().all(|line| line.chars().count() < 400 && !line.contains('\u{1b}')),
        "{shown:.2000}"
    );
    // Without the channels that were too many, the metadata are next.
    assert!(found.end.damaged > 900);
    survive(&path);
    assert_eq!(scan_contents(&path, "plc").unwrap().count(), 0);
}

#[test]
fn a_file_is_made_whole_where_it_lies_and_as_it_was() {
    use std::os::unix::ffi::OsStrExt;
    use std::os::unix::fs::PermissionsExt;
    let dir = TempDir::fast("in-place");
    let (_, live) = small(dir.path(), Compression::Zstd);
    let elsewhere = dir.path().join("elsewhere");
    std::fs::create_dir(&elsewhere).unwrap();
    let real = elsewhere.join(std::ffi::OsStr::from_bytes(b"caf\xe9.mcap"));
    std::fs::rename(&live, &real).unwrap();
    std::fs::set_permissions(&real, std::fs::Permissions::from_mode(0o640)).unwrap();
    let link = dir.path().join("link.mcap");
    std::os::unix::fs::symlink(&real, &link).unwrap();
    // A killed sealing's copy is taken away; a link in its place is not followed.
    let mut copy = real.clone().into_os_string();
    copy.push(".sealing");
    let precious = dir.path().join("precious");
    std::fs::write(&precious, "precious").unwrap();
    std::os::unix::fs::symlink(&precious, &copy).unwrap();
    let error = recover(&link).unwrap_err();
    assert!(matches!(error, SealError::Write { .. }), "{error}");
    assert_eq!(std::fs::read(&precious).unwrap(), b"precious");
    std::fs::remove_file(&copy).unwrap();
    std::fs::write(&copy, "half").unwrap();
    let report = recover(&link).unwrap();
    assert_eq!((report.bytes_lost, report.damaged, report.already_sealed), (0, 0, false));
    assert!(std::fs::symlink_metadata(&link).unwrap().is_symlink() && !Path::new(&copy).exists());
    assert!(disk::is_finished(&real));
    assert_eq!(std::fs::metadata(&real).unwrap().permissions().mode() & 0o777, 0o640);
    // A name that is no UTF-8 is shown, not refused.
    let shown = serde_json::to_value(info(&real).unwrap()).unwrap();
    assert!(shown["path"].as_str().unwrap().ends_with("caf\u{fffd}.mcap"), "{shown}");
}

#[test]
fn a_file_of_an_older_version_is_read_without_checksums_and_says_so() {
    let dir = TempDir::fast("older");
    let (_, live) = small(dir.path(), Compression::Zstd);
    let mut bytes = std::fs::read(&live).unwrap();
    let (all, _) = read(&live);
    // It did not say that raw messages have checksums; nor had they any, but those are private records to whoever reads it.
    let key = bytes.windows(5).position(|w| w == b"crc32").unwrap();
    bytes[key..key + 5].copy_from_slice(b"crc-1");
    std::fs::write(&live, &bytes).unwrap();
    assert_eq!(read(&live).0, all);
    let end = info(&live).unwrap().end;
    assert_eq!((end.unchecked, end.damaged, end.unread), (all.len() as u64, 0, 0));
}
