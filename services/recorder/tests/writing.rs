//! What the writer thread does over time: rotation, quota, the disk going away, files of a killed predecessor.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a test that fails")]

mod common;

use common::{Rig, TempDir, frame, keyframe, message, one_of_each, stack, wait_for};
use dinrail_recorder::reader::{Item, Recording};
use dinrail_recorder::{Config, Filter, Format, cat, disk, info, scan, scan_contents};
use ipc_types::clock;
use ipc_types::topic::{EVENTS, TopicKind};
use ipc_types::units::Size;
use std::path::Path;
use std::sync::atomic::Ordering;

fn sequences(path: &Path, topic: &str) -> Vec<u64> {
    let messages = Recording::open(path).unwrap().messages();
    messages.map(Result::unwrap).filter(|m| m.topic == topic).map(|m| m.stamp.seq).collect()
}

#[test]
fn files_rotate_at_a_keyframe_and_each_stands_alone() {
    let dir = TempDir::new("rotate");
    let config = Config {
        max_size: Size(1 << 20),
        compression: dinrail_recorder::Compression::None,
        ..Config::default()
    };
    let mut rig = Rig::start(stack(dir.path()), config);
    let (mut seq, mut key) = (0, 0);
    let mut asked = 0;
    while rig.progress().files < 4 {
        let t = clock::mono_ns();
        let mut messages: Vec<_> = (0..500)
            .map(|i| {
                seq += 1;
                frame(seq, t + i)
            })
            .collect();
        // The plc answers with a keyframe in the middle of the traffic.
        if rig.shared.keyframe_wanted.load(Ordering::Relaxed) {
            key += 1;
            asked += 1;
            messages.push(keyframe(key, t + 250));
        }
        rig.send(&messages);
        rig.settle();
    }
    rig.counters[0].lost = 3;
    rig.send(&[]);
    let files = rig.stop();
    assert_eq!(files.len(), 4);
    assert!(asked >= 4);
    let mut next = 1;
    for (n, file) in files.iter().enumerate() {
        let found = info(file).unwrap();
        assert!(found.finished, "{found}");
        assert_eq!(found.recording["file"], (n + 1).to_string());
        let names: Vec<_> = found.attachments.iter().map(|a| a.name.as_str()).collect();
        assert_eq!(names, ["stack.toml", "stack.json", "main.st"]);
        // Nothing is missing or twice between the files.
        let frames = sequences(file, "can0/rx");
        assert_eq!(frames.first(), Some(&next));
        assert!(frames.windows(2).all(|w| w[1] == w[0] + 1));
        next = frames.last().unwrap() + 1;
        // From the second file on, the first message is the keyframe.
        let first = Recording::open(file).unwrap().messages().next().unwrap().unwrap();
        assert!(n == 0 || first.kind == Some(TopicKind::Keyframe), "{n}: {first:?}");
        let gaps = found.gaps.unwrap();
        assert!(gaps.last);
        assert_eq!(gaps.topics["can0/rx"].recorded, frames.len() as u64);
        assert_eq!(gaps.missed, if n == 3 { 3 } else { 0 }, "losses count in the file of their time");
    }
    assert_eq!(next - 1, seq);
}

#[test]
fn without_a_keyframe_a_due_file_ends_all_the_same() {
    let dir = TempDir::new("no-key");
    let config = Config {
        max_size: Size(1 << 20),
        compression: dinrail_recorder::Compression::None,
        ..Config::default()
    };
    let mut rig = Rig::start(stack(dir.path()), config);
    let mut seq = 0;
    wait_for("the second file", || {
        let t = clock::mono_ns();
        let messages: Vec<_> = (0..500)
            .map(|i| {
                seq += 1;
                frame(seq, t + i)
            })
            .collect();
        rig.send(&messages);
        rig.settle();
        rig.progress().files >= 2
    });
    let total: usize = rig.stop().iter().map(|f| sequences(f, "can0/rx").len()).sum();
    assert_eq!(total as u64, seq);
}

#[test]
fn numbers_go_on_where_the_last_recorder_ended() {
    let dir = TempDir::new("numbers");
    let mut all = Vec::new();
    for _ in 0..3 {
        all = Rig::start(stack(dir.path()), Config::default()).stop();
    }
    let ends: Vec<_> = all.iter().map(|f| f.to_str().unwrap().rsplit_once('-').unwrap().1).collect();
    assert_eq!(ends, ["1.mcap", "2.mcap", "3.mcap"]);
    assert_eq!(info(&all[2]).unwrap().recording["file"], "3");
}

#[test]
fn the_quota_deletes_the_oldest_files() {
    let dir = TempDir::new("quota");
    let config = Config {
        max_size: Size(1 << 20),
        keep: Size(3 << 20),
        compression: dinrail_recorder::Compression::None,
        ..Config::default()
    };
    let mut rig = Rig::start(stack(dir.path()), config);
    let mut seq = 0;
    while rig.progress().files < 8 {
        let t = clock::mono_ns();
        let mut messages: Vec<_> = (0..2000)
            .map(|i| {
                seq += 1;
                frame(seq, t + i)
            })
            .collect();
        messages.push(keyframe(seq, t));
        rig.send(&messages);
        rig.settle();
    }
    let files = rig.stop();
    assert!(files.len() < 6, "{files:?}");
    let total: u64 = files.iter().map(|f| f.metadata().unwrap().len()).sum();
    // The quota was kept when the last file began.
    assert!(total < 6 << 20, "{total}");
    assert_eq!(sequences(files.last().unwrap(), "can0/rx").last(), Some(&seq));
}

#[test]
fn a_folder_that_goes_away_stops_the_recording_and_coming_back_resumes_it() {
    let dir = TempDir::new("gone");
    let config = Config {
        max_size: Size(1 << 20),
        compression: dinrail_recorder::Compression::None,
        ..Config::default()
    };
    let mut rig = Rig::start(stack(dir.path()), config);
    rig.send(&[frame(1, clock::mono_ns())]);
    rig.settle();
    // A plain file stands where the folder was: not even root can write there.
    let (folder, aside) = (dir.path().join("recordings"), dir.path().join("aside"));
    std::fs::rename(&folder, &aside).unwrap();
    std::fs::write(&folder, "in the way").unwrap();
    let mut seq = 1;
    wait_for("the pause", || {
        let t = clock::mono_ns();
        let messages: Vec<_> = (0..1000)
            .map(|i| {
                seq += 1;
                frame(seq, t + i)
            })
            .collect();
        rig.send(&messages);
        rig.settle();
        rig.progress().paused.is_some()
    });
    let notice = rig.notices.recv().unwrap();
    assert!(notice.fault);
    let expected = format!("recording stopped: cannot write {}", folder.display());
    assert!(notice.message.starts_with(&expected), "{}", notice.message);
    assert!(notice.message.contains("free space there or lower 'keep'"), "{}", notice.message);
    // The stack goes on; what comes is counted.
    let before = rig.progress().dropped;
    rig.send(&[frame(seq + 1, clock::mono_ns())]);
    rig.settle();
    assert_eq!(rig.progress().dropped, before + 1);
    std::fs::remove_file(&folder).unwrap();
    wait_for("recording again", || rig.progress().paused.is_none());
    let again = rig.notices.recv().unwrap();
    assert!(!again.fault && again.message.starts_with("recording again, into"), "{}", again.message);
    rig.send(&[frame(seq + 2, clock::mono_ns())]);
    let dropped = before + 1;
    let files = rig.stop();
    let found = info(files.last().unwrap()).unwrap();
    assert_eq!(found.gaps.as_ref().unwrap().topics["can0/rx"].dropped, dropped, "{found}");
    // The file that was open when the folder went was finished in its new place.
    assert!(disk::recordings(&aside, "test").iter().all(|f| disk::is_finished(&f.path)));
}

#[test]
fn a_disk_without_room_pauses_before_the_first_file() {
    let dir = TempDir::new("room");
    let rig = Rig::start(stack(dir.path()), Config { min_free: Size(1 << 60), ..Config::default() });
    let notice = rig.notices.recv().unwrap();
    assert!(notice.message.contains("less free space than min_free"), "{}", notice.message);
    assert!(rig.progress().paused.is_some());
    assert!(rig.stop().is_empty());
}

#[test]
fn unfinished_files_of_a_killed_predecessor_are_made_whole() {
    let dir = TempDir::new("predecessor");
    let mut rig = Rig::start(stack(dir.path()), Config::default());
    rig.send(&one_of_each(clock::mono_ns()));
    rig.settle();
    let first = rig.files().remove(0);
    let folder = first.parent().unwrap().to_owned();
    // As kill -9 leaves it: the bytes, without end and without lock.
    let left = folder.join(disk::file_name("test", 1, 1));
    std::fs::copy(&first, &left).unwrap();
    let half = folder.join(disk::file_name("test", 2, 1) + ".sealing");
    std::fs::write(&half, "half").unwrap();
    rig.stop();
    let rig = Rig::start(stack(dir.path()), Config::default());
    wait_for("sealing", || rig.progress().sealed == 1);
    assert!(disk::is_finished(&left));
    assert_eq!(sequences(&left, "can0/rx"), [1, 2]);
    assert!(!half.exists());
    let notice = rig.notices.recv().unwrap();
    assert!(!notice.fault && notice.message.contains("8 messages kept, 0 bytes lost"), "{}", notice.message);
    rig.stop();
}

#[test]
fn a_changed_program_is_attached_again() {
    let dir = TempDir::new("program");
    let mut rig = Rig::start(stack(dir.path()), Config::default());
    rig.send(&[frame(1, clock::mono_ns())]);
    rig.settle();
    std::fs::write(dir.path().join("main.st"), "PROGRAM other END_PROGRAM").unwrap();
    let file = rig.files().remove(0);
    wait_for("the new program in the file", || {
        scan::attachments(&file).unwrap().iter().filter(|a| a.name == "main.st").count() == 2
    });
    rig.stop();
    let programs: Vec<_> =
        scan::attachments(&file).unwrap().into_iter().filter(|a| a.name == "main.st").collect();
    assert_eq!(programs[0].data, b"PROGRAM main END_PROGRAM");
    assert_eq!(programs[1].data, b"PROGRAM other END_PROGRAM");
}

#[test]
fn what_tools_show() {
    let dir = TempDir::new("tools");
    let mut rig = Rig::start(stack(dir.path()), Config::default());
    let t = clock::mono_ns();
    rig.send(&one_of_each(t));
    let file = rig.stop().remove(0);
    let print = |filter: &Filter, format| {
        let mut out = Vec::new();
        let printed = cat(&file, filter, format, &mut out).unwrap();
        (String::from_utf8(out).unwrap(), printed)
    };
    let (text, printed) = print(&Filter::default(), Format::Json);
    assert_eq!((text.lines().count(), printed.messages), (9, 9));
    assert!(printed.end.finished);
    let lines: Vec<serde_json::Value> = text.lines().map(|l| serde_json::from_str(l).unwrap()).collect();
    assert_eq!(lines[0]["id"], "1A0");
    assert_eq!((&lines[1]["id"], &lines[1]["brs"]), (&"1ABCDEF0".into(), &true.into()));
    assert_eq!(lines[2]["data"], "0102030001");
    assert_eq!(lines[7]["body"]["event"], "died");
    let only = Filter { topics: vec!["plc/*".into()], limit: Some(2), ..Filter::default() };
    let (text, printed) = print(&only, Format::Json);
    assert_eq!((text.lines().count(), printed.messages), (2, 2));
    let (text, _) = print(&Filter::default(), Format::Candump);
    let frames: Vec<_> = text.lines().map(|l| l.split_once(' ').unwrap().1).collect();
    assert_eq!(frames, ["can0 1A0#DEAD", "can0 1ABCDEF0##168656C6C6F2C2043414E2121"]);
    let from = info(&file).unwrap().first_ns;
    let late = Filter { from_ns: Some(from + 2), to_ns: Some(from + 4), ..Filter::default() };
    assert_eq!(print(&late, Format::Json).1.messages, 2);
    let parts: Vec<_> = scan_contents(&file, "plc").unwrap().map(Result::unwrap).collect();
    assert_eq!(
        parts.iter().map(|p| (p.keyframe, p.header.scan, p.tail.len())).collect::<Vec<_>>(),
        [(false, 77, 3), (true, 1, 3)]
    );
    assert_eq!(scan::scanned_services(&file).unwrap(), ["plc"]);
    let found = info(&file).unwrap();
    let text = found.to_string();
    assert!(text.contains("state      finished"), "{text}");
    assert!(text.contains("recorder   recorded 8, missed 0"), "{text}");
    assert!(text.contains("dinrail_v1/CanFrame"), "{text}");
    let mut recording = Recording::open(&file).unwrap();
    let mut others = 0;
    while let Some(item) = recording.next_item().unwrap() {
        others += usize::from(!matches!(item, Item::Message(_)));
    }
    assert_eq!(others, 5, "two metadata records, three attachments");
}

#[test]
fn a_clock_that_jumps_is_in_the_file() {
    let dir = TempDir::new("clock");
    let mut rig = Rig::start(stack(dir.path()), Config::default());
    let t = clock::mono_ns();
    rig.send(&[frame(1, t)]);
    rig.utc_offset_ns += 3_600_000_000_000;
    let after = rig.utc_offset_ns;
    rig.send(&[frame(2, t)]);
    let file = rig.stop().remove(0);
    assert_eq!(info(&file).unwrap().utc_offsets_ns, [after - 3_600_000_000_000, after]);
    let frames: Vec<_> = Recording::open(&file).unwrap().messages().map(Result::unwrap).take(2).collect();
    assert_eq!(frames[1].log_time - frames[0].log_time, 3_600_000_000_000);
    assert_eq!(frames[1].stamp.t_ns, frames[0].stamp.t_ns);
}

#[test]
fn a_program_loaded_while_recording_stands_in_this_file_and_the_next() {
    let dir = TempDir::new("loaded");
    let stack = stack(dir.path());
    std::fs::create_dir_all(&stack.root).unwrap();
    let module = |hash: &str| stack.root.join(format!("plc.{hash}.wasm"));
    std::fs::write(module("00000000000000aa"), b"\0asm first").unwrap();
    let loaded = |seq: u64| {
        let body = serde_json::json!({ "event": "loaded", "level": "info", "service": "plc", "message": "program loaded",
                                       "utc_ns": 1, "t_ns": 1 });
        message(
            EVENTS,
            ipc_types::payload::Event::default(),
            body.to_string().as_bytes(),
            seq,
            clock::mono_ns(),
        )
    };
    let names = |file: &std::path::Path| {
        let found = dinrail_recorder::scan::attachments(file).unwrap();
        found
            .into_iter()
            .filter(|a| std::path::Path::new(&a.name).extension().is_some_and(|e| e == "wasm"))
            .map(|a| (a.name, a.data))
            .collect::<Vec<_>>()
    };
    let mut rig = Rig::start(stack.clone(), Config::default());
    rig.send(&[frame(1, clock::mono_ns())]);
    // The file is begun.
    rig.settle();
    std::fs::write(module("00000000000000bb"), b"\0asm second").unwrap();
    // Written, but not loaded: not in the file.
    rig.send(&[frame(2, clock::mono_ns())]);
    rig.settle();
    assert_eq!(names(&rig.files()[0]), [("plc.00000000000000aa.wasm".to_owned(), b"\0asm first".to_vec())]);
    rig.send(&[loaded(1), frame(3, clock::mono_ns())]);
    rig.send(&[loaded(2)]);
    let files = rig.stop();
    let both = ["plc.00000000000000aa.wasm", "plc.00000000000000bb.wasm"];
    assert_eq!(names(&files[0]).into_iter().map(|(name, _)| name).collect::<Vec<_>>(), both, "each once");
    // A recorder that starts later finds it without the event.
    let files = Rig::start(stack, Config::default()).stop();
    assert_eq!(names(files.last().unwrap()).into_iter().map(|(name, _)| name).collect::<Vec<_>>(), both);
}

#[test]
fn a_moment_has_no_rate() {
    let dir = TempDir::new("rate");
    let mut rig = Rig::start(stack(dir.path()), Config::default());
    let t = clock::mono_ns();
    // Two parts of a keyframe, 1 us apart; frames over a second.
    rig.send(&[keyframe(1, t), keyframe(2, t + 1000)]);
    rig.send(&[frame(1, t), frame(2, t + 500_000_000), frame(3, t + 1_000_000_000)]);
    let found = info(&rig.stop()[0]).unwrap();
    let rate = |topic: &str| found.channels.iter().find(|c| c.topic == topic).unwrap().rate;
    assert_eq!((rate("plc/keyframe"), rate("can0/rx"), rate("io/inputs")), (None, Some(2.0), None));
    let shown = found.to_string();
    let line = shown.lines().find(|l| l.contains("plc/keyframe")).unwrap();
    let cells: Vec<_> = line.split_whitespace().collect();
    assert_eq!((cells[1], cells[3]), ("2", "-"), "{line}");
}

#[test]
fn a_silent_topic_is_there_and_an_unknown_one_is_told() {
    let dir = TempDir::new("silent");
    let mut rig = Rig::start(stack(dir.path()), Config::default());
    rig.send(&[frame(1, clock::mono_ns())]);
    let file = rig.stop().remove(0);
    let print = |topic: &str| {
        let filter = Filter { topics: vec![topic.into()], ..Filter::default() };
        cat(&file, &filter, Format::Json, &mut std::io::sink()).map(|p| p.messages).map_err(|e| e.to_string())
    };
    assert_eq!((print("can0/rx"), print("plc/scan")), (Ok(1), Ok(0)));
    let said = print("can9/*").unwrap_err();
    assert!(said.contains("no topic 'can9/*'; there are: ") && said.contains("plc/scan"), "{said}");
}

#[test]
fn a_file_that_is_deleted_while_it_is_written_is_told_and_another_begins() {
    let dir = TempDir::new("deleted");
    let mut rig = Rig::start(stack(dir.path()), Config::default());
    rig.send(&[frame(1, clock::mono_ns())]);
    rig.settle();
    let first = rig.files().remove(0);
    // With its folder.
    std::fs::remove_dir_all(first.parent().unwrap()).unwrap();
    wait_for("another file", || rig.progress().files == 2);
    let notice = rig.notices.recv().unwrap();
    let expected = format!("{} was deleted while it was written, with 1 messages", first.display());
    assert!(notice.fault && notice.message.starts_with(&expected), "{}", notice.message);
    rig.send(&[frame(2, clock::mono_ns())]);
    assert!(rig.progress().paused.is_none());
    let files = rig.stop();
    assert_eq!(files.len(), 1);
    assert_eq!(sequences(&files[0], "can0/rx"), [2]);
    assert_ne!(files[0], first, "no number is given twice");
}

#[test]
fn a_thousand_files_of_former_years_neither_delay_the_first_message_nor_stay_unfinished() {
    let dir = TempDir::fast("years");
    let stack = stack(dir.path());
    let folder = dir.path().join("recordings");
    std::fs::create_dir_all(&folder).unwrap();
    // Two of them were cut off; one is no recording at all, one a link, one has no name that UTF-8 knows.
    let mut old = mcap::MAGIC.to_vec();
    for n in 1..=1000 {
        let ended = if n % 400 == 0 { 1 } else { 2 };
        std::fs::write(folder.join(disk::file_name("test", n * 1_000_000_000, n as u64)), old.repeat(ended))
            .unwrap();
    }
    old.clear();
    std::fs::write(folder.join(disk::file_name("test", 0, 1001)), "not MCAP").unwrap();
    let strange = std::os::unix::ffi::OsStrExt::from_bytes(b"test-\xff.mcap");
    std::fs::write(folder.join::<&std::ffi::OsStr>(strange), "strange").unwrap();
    std::os::unix::fs::symlink("/nowhere", folder.join(disk::file_name("test", 0, 1002))).unwrap();
    let mut rig =
        Rig::start(stack, Config { max_size: Size(1 << 20), keep: Size(3 << 20), ..Config::default() });
    rig.send(&[frame(1, clock::mono_ns())]);
    wait_for("sealing", || rig.progress().sealed == 2);
    let files = rig.stop();
    let current = files.last().unwrap();
    assert!(current.to_str().unwrap().ends_with("-1003.mcap"), "{current:?}");
    assert_eq!(sequences(current, "can0/rx"), [1]);
    assert_eq!(files.len(), 1002, "nothing was above the quota");
    assert!(files.iter().all(|f| disk::is_finished(f) || f.to_str().unwrap().ends_with("-1001.mcap")));
}
