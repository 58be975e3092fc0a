//! A medium that takes the beginning of a file and no more, as a user's quota does.
//!
//! One test, alone in its process: the limit is the process's.
#![cfg(target_os = "linux")]
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a test that fails")]

mod common;

use common::{Rig, TempDir, frame, stack, wait_for};
use dinrail_recorder::{Config, disk, info};
use ipc_types::clock;
use std::path::Path;
use std::time::Duration;

/// Bytes that a file of this process may have.
#[allow(unsafe_code)]
fn limit_files(bytes: u64) {
    let limit = libc::rlimit { rlim_cur: bytes, rlim_max: libc::RLIM_INFINITY };
    // SAFETY: the signal's default action would end the process; ignoring it runs no code of ours. The kernel only reads
    // the limit.
    unsafe {
        libc::signal(libc::SIGXFSZ, libc::SIG_IGN);
        assert_eq!(libc::setrlimit(libc::RLIMIT_FSIZE, &raw const limit), 0);
    }
}

fn frames_of(file: &Path) -> u64 {
    info(file).unwrap().channels.iter().find(|c| c.topic == "can0/rx").map_or(0, |c| c.messages)
}

#[test]
fn beginnings_of_files_are_removed_and_files_with_messages_made_whole() {
    let dir = TempDir::fast("limit");
    let mut rig = Rig::start(stack(dir.path()), Config::default());
    let mut seq = 0;
    let mut send = |rig: &mut Rig, frames: u64| {
        let t = clock::mono_ns();
        let messages: Vec<_> = (1..=frames).map(|i| frame(seq + i, t + i)).collect();
        seq += frames;
        rig.send(&messages);
        rig.settle();
    };
    // What was sent reaches the file with a flush, every 50 ms: until these frames are there and it grows no more.
    let size = |rig: &Rig, frames: u64| {
        let now = || {
            let file = rig.files().into_iter().next()?;
            (frames_of(&file) == frames).then(|| file.metadata().ok().map(|m| m.len()))?
        };
        let mut last = None;
        wait_for("everything in the file", || {
            std::thread::sleep(Duration::from_millis(200));
            let before = std::mem::replace(&mut last, now());
            before.is_some() && before == last
        });
        last.unwrap()
    };
    wait_for("the first file", || rig.progress().files == 1);
    // The file is begun, and there is no room for a message.
    limit_files(size(&rig, 0));
    send(&mut rig, 1);
    let paused = rig.progress().paused.unwrap();
    assert!(paused.contains("File too large"), "{paused}");
    assert_eq!(rig.files(), Vec::<std::path::PathBuf>::new(), "the beginning is gone");
    send(&mut rig, 2);
    assert_eq!(rig.progress().dropped, 3, "the one that there was no room for, too");
    limit_files(libc::RLIM_INFINITY);
    wait_for("recording again", || rig.progress().paused.is_none());
    // Ten messages stand in this one when there is no more room.
    send(&mut rig, 10);
    limit_files(size(&rig, 10));
    send(&mut rig, 10);
    assert!(rig.progress().paused.is_some());
    assert_eq!(rig.files().len(), 1);
    assert!(!disk::is_finished(&rig.files()[0]));
    limit_files(libc::RLIM_INFINITY);
    wait_for("recording again, and the file made whole", || rig.progress().sealed == 1);
    send(&mut rig, 5);
    let files = rig.stop();
    let frames: Vec<_> = files.iter().map(|f| frames_of(f)).collect();
    assert_eq!(frames, [10, 5]);
    assert!(files.iter().all(|f| disk::is_finished(f)));
}
