//! What is verified is what was recorded: a recording of a real engine, whatever is done to its bytes.

use super::*;
use dinrail_iec::Source as SourceText;
use dinrail_plc::engine::{Engine, Runtime, Stamps};
use dinrail_recorder::config::Compression;
use dinrail_recorder::file::RecordingFile;
use dinrail_recorder::format::{
    GAPS_TOPIC, Gaps, META_RECORDING, RAW_CRC32, RAW_KEY, TopicGaps, channel, gaps_channel,
};
use ipc_types::payload::{Payload as _, Stamp, as_bytes};
use ipc_types::scan_record::{Command, Reason, Source, Start, part_header, parts};
use ipc_types::stack::TopicEntry;
use ipc_types::topic::TopicKind;
use mcap::records::MessageHeader;
use proptest::prelude::*;
use std::collections::BTreeMap;
use std::fs::File;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Instant;

#[test]
fn every_combination_of_versions_is_tried_newest_first() {
    let (a, b, c) = (1, 2, 3);
    assert_eq!(combinations(&[vec![&a, &b], vec![&c]]), [[&a, &c], [&b, &c]]);
    assert!(combinations::<i32>(&[]).is_empty());
    assert!(combinations(&[vec![&a], vec![]]).is_empty());
    let many = vec![&a; 100];
    assert_eq!(combinations(&[many.clone(), many]).len(), COMBINATIONS_MAX);
}

const PROGRAM: &str = "PROGRAM main
VAR count : DINT; t : TON; table : ARRAY [0..9] OF INT; out AT %QW0 : INT; END_VAR
VAR RETAIN hours : DINT; END_VAR
  count := count + 1;
  t(IN := count MOD 7 > 2, PT := T#30ms);
  IF t.Q THEN hours := hours + 1; END_IF;
  table[count MOD 10] := DINT_TO_INT(count MOD 1000);
  out := table[count MOD 3];
END_PROGRAM";

/// Scans of a recording.
const SCANS: u64 = 40;

struct Dir(PathBuf);

impl Drop for Dir {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

impl Dir {
    fn new(name: &str) -> Self {
        let shm = Path::new("/dev/shm");
        let parent = if shm.is_dir() { shm.to_owned() } else { std::env::temp_dir() };
        static COUNT: AtomicU32 = AtomicU32::new(0);
        let n = COUNT.fetch_add(1, Ordering::Relaxed);
        let path = parent.join(format!("dinrail-verify-{}-{name}-{n}", std::process::id()));
        std::fs::create_dir_all(&path).unwrap();
        Self(path)
    }
}

/// Writes what a recorder would of one plc.
struct Recorder {
    file: RecordingFile,
    channels: [u16; 2],
    seq: [u64; 2],
    gaps: u16,
}

impl Recorder {
    fn begin(path: &Path, program: &Program, compression: Compression) -> Self {
        let handle = File::options().read(true).write(true).create(true).truncate(true).open(path).unwrap();
        let mut file = RecordingFile::new(Arc::new(handle), compression, false).unwrap();
        let raw = BTreeMap::from([(RAW_KEY.to_owned(), RAW_CRC32.to_owned())]);
        file.metadata(META_RECORDING, raw).unwrap();
        file.attach("plc.wasm", "application/wasm", 1, &program.artifact.wasm).unwrap();
        let topic = |kind: TopicKind| TopicEntry {
            name: kind.of("plc"),
            kind,
            depth: 1,
            max_tail: kind.row().max_tail,
            writers: vec!["plc".to_owned()],
            readers: Vec::new(),
            wakes: Vec::new(),
            max_publishers: 1,
            max_subscribers: 1,
        };
        let channels =
            [TopicKind::Scan, TopicKind::Keyframe].map(|k| file.add_channel(&channel(&topic(k))).unwrap());
        let gaps = file.add_channel(&gaps_channel()).unwrap();
        file.close_chunk().unwrap();
        Self { file, channels, seq: [0, 0], gaps }
    }

    fn content(&mut self, keyframe: bool, scan: u64, bytes: &[u8]) {
        let which = usize::from(keyframe);
        for (i, part) in parts(bytes).enumerate() {
            self.seq[which] += 1;
            let mut header = part_header(scan, i, bytes.len());
            header.stamp = Stamp { seq: self.seq[which], t_ns: scan, generation: 1, writer: 2 };
            header.set_tail_len(part.len() as u32);
            let data = [as_bytes(&header), part].concat();
            self.write(self.channels[which], self.seq[which], &data);
        }
    }

    fn write(&mut self, channel_id: u16, seq: u64, data: &[u8]) {
        let head = MessageHeader { channel_id, sequence: seq as u32, log_time: seq, publish_time: seq };
        self.file.message(&head, data, Instant::now()).unwrap();
    }

    fn finish(mut self) {
        let count = |recorded| TopicGaps { recorded, ..TopicGaps::default() };
        let topics =
            [("plc/scan".to_owned(), count(self.seq[0])), ("plc/keyframe".to_owned(), count(self.seq[1]))];
        let gaps = serde_json::to_vec(&Gaps::new(topics.into_iter(), true)).unwrap();
        assert_eq!(GAPS_TOPIC, "recorder/gaps");
        self.write(self.gaps, 1, &gaps);
        self.file.finish().unwrap();
    }
}

/// A recording, whole; and as it stood on the disk after two thirds of it.
fn record(dir: &Path, compression: Compression) -> [Vec<u8>; 2] {
    let setup = Setup { cycle_ns: Some(10_000_000), ..Setup::default() };
    let source = SourceText { name: "main.st".into(), text: PROGRAM.into() };
    let program = compile_sources(vec![source], &setup).unwrap().program;
    let mut engine = Engine::new(&Runtime::new().unwrap(), Some(program.clone()), Arc::new(setup)).unwrap();
    let path = dir.join("whole.mcap");
    let mut out = Recorder::begin(&path, &program, compression);
    out.content(true, 0, engine.take_keyframe(Reason::EngineStart));
    let mut live = Vec::new();
    for scan in 1..=SCANS {
        let t_ns = scan as i64 * 10_000_000;
        engine.begin(Stamps { t_ns: t_ns as u64, plc_time_ns: t_ns - 10_000_000, utc_ns: t_ns + 1000 });
        if scan == 1 {
            engine.control(&Source { writer: 3, generation: 1, seq: 1 }, &Command::Start(Start::Cold));
        }
        engine.finish();
        out.content(false, scan, engine.record());
        if scan % 15 == 0 {
            out.content(true, scan, engine.take_keyframe(Reason::Periodic));
            if scan == 15 {
                out.file.close_chunk().unwrap();
            }
        }
        if scan == 28 {
            out.file.flush(Instant::now()).unwrap();
            live = std::fs::read(&path).unwrap();
        }
    }
    out.finish();
    [std::fs::read(&path).unwrap(), live]
}

fn verified(path: &Path, bytes: &[u8]) -> anyhow::Result<Report> {
    std::fs::write(path, bytes).unwrap();
    Ok(run(&Verify { file: path, program: &[], service: None })?.1)
}

struct Files {
    dir: Dir,
    files: Vec<Vec<u8>>,
}

thread_local! {
    static FILES: Files = {
        let dir = Dir::new("wounds");
        let files = [Compression::Zstd, Compression::None].map(|c| record(&dir.0, c)).concat();
        Files { dir, files }
    };
}

#[test]
fn a_whole_recording_is_exact_and_one_that_ends_early_says_so() {
    FILES.with(|Files { dir, files }| {
        let path = dir.0.join("untouched.mcap");
        for pair in files.chunks(2) {
            let report = verified(&path, &pair[0]).unwrap();
            assert_eq!((report.exit_code(), report.scans_verified), (0, SCANS), "{report:#?}");
            let report = verified(&path, &pair[1]).unwrap();
            assert_eq!((report.exit_code(), report.scans_verified), (3, 28), "{report:#?}");
            assert!(report.incomplete[0].contains("has no end yet"), "{report:#?}");
            let text = text_of(&report, "plc", true);
            assert!(text.contains("\nnot complete: it ends at byte"), "{text}");
            dinrail_recorder::recover(&path).unwrap();
            let report = run(&Verify { file: &path, program: &[], service: None }).unwrap().1;
            assert_eq!((report.exit_code(), report.scans_verified), (3, 28), "{report:#?}");
            assert!(report.incomplete[0].contains("made whole afterwards"), "{report:#?}");
        }
    });
}

/// As many as asked for, else as many as take seconds.
fn cases() -> u32 {
    std::env::var("PROPTEST_CASES").ok().and_then(|n| n.parse().ok()).unwrap_or(150)
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::with_cases(cases()) })]

    /// Flipped, cut out, put in, repeated, cut off: never a panic, and never "exact" of another recording than this.
    #[test]
    fn a_recording_that_was_altered_is_never_called_exact(
        wounds in prop::collection::vec(
            (0u8..5, any::<prop::sample::Index>(), 1usize..700, any::<prop::sample::Index>(), 1u8..),
            1..4,
        ),
        which in 0usize..4,
    ) {
        FILES.with(|Files { dir, files }| {
            let mut bytes = files[which].clone();
            for (how, at, n, to, with) in wounds {
                if bytes.is_empty() {
                    break;
                }
                let (at, to) = (at.index(bytes.len()), to.index(bytes.len()));
                let end = (at + n).min(bytes.len());
                match how {
                    0 => bytes[at] ^= with,
                    1 => drop(bytes.drain(at..end)),
                    2 => drop(bytes.splice(at..at, vec![with; n % 40])),
                    3 => {
                        let piece = bytes[at..end].to_vec();
                        bytes.splice(to..to, piece);
                    }
                    _ => bytes.truncate(at),
                }
            }
            let data_end = |bytes: &[u8]| {
                let mut recording = dinrail_recorder::Recording::from_bytes(Path::new("wounded"), bytes.to_vec()).ok()?;
                while recording.next_item().ok()?.is_some() {}
                Some((recording.end().offset as usize, recording.end().checked))
            };
            // What a file says that no recording can be made of is an error of its own.
            let Ok(report) = verified(&dir.0.join("wounded.mcap"), &bytes) else { return };
            if report.exit_code() == 0 {
                assert_eq!(report.scans_verified, SCANS, "{report:#?}");
                let (end, checked) = data_end(&bytes).unwrap();
                assert!(checked);
                assert_eq!(bytes[..end], files[which][..end], "other data, and exact");
            }
        });
    }
}
