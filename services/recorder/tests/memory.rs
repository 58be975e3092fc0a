//! The writer's memory over many files: what one file needs, and no more.
//!
//! Alone in its process: other tests' memory would count.
#![cfg(target_os = "linux")]
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a test that fails")]

mod common;

use common::{Rig, TempDir, keyframe, message, stack};
use dinrail_recorder::batch::{BATCH_BYTES, QUEUE};
use dinrail_recorder::{Config, disk};
use ipc_types::clock;
use ipc_types::payload::{CanFrame, Stamp};
use ipc_types::units::Size;
use std::sync::atomic::Ordering;

/// Files until the memory is looked at first, and until it is looked at last.
const FILES: (u32, u32) = (20, 120);
/// More than an allocator keeps by chance, far less than a hundred files that each leave something behind. A process of
/// `dinrail` keeps less: it fixes glibc's threshold for large allocations, which a test cannot.
const GROWTH: u64 = 4 << 20;

/// What batches that were used may keep: eight of half a megabyte, and one by chance.
const KEPT: u64 = 9 << 19;

/// Memory of this process that is no file's, in bytes.
fn anonymous() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    let line = status.lines().find(|line| line.starts_with("RssAnon:")).unwrap();
    line.split_whitespace().nth(1).unwrap().parse::<u64>().unwrap() * 1024
}

fn descriptors() -> usize {
    std::fs::read_dir("/proc/self/fd").unwrap().count()
}

/// As after a disk that stood still: every batch was full.
fn backlog(rig: &Rig) {
    let before = anonymous();
    let body = vec![1u8; BATCH_BYTES];
    let mut batches: Vec<_> = (0..QUEUE).map(|_| rig.shared.pool.take().unwrap()).collect();
    for batch in &mut batches {
        assert!(batch.push(0, &Stamp::default(), &body, &[]));
        assert!(batch.push(0, &Stamp::default(), &body, &[]));
    }
    let full = anonymous();
    assert!(
        full > before + ((QUEUE - 9) * BATCH_BYTES) as u64,
        "{before} bytes before, {full} with a backlog"
    );
    for batch in batches {
        rig.shared.pool.give(batch);
    }
    let after = anonymous();
    eprintln!("{} KiB before a backlog, {} KiB with it, {} KiB after", before >> 10, full >> 10, after >> 10);
    assert!(after < before + KEPT, "{before} bytes before a backlog, {full} with it, {after} after");
}

#[test]
fn a_hundred_files_leave_no_memory_and_no_descriptor_behind() {
    let dir = TempDir::fast("memory");
    let config = Config { max_size: Size(1 << 18), keep: Size(1 << 20), ..Config::default() };
    let mut rig = Rig::start(stack(dir.path()), config);
    let (mut seq, mut key) = (0u64, 0);
    let mut until = |rig: &mut Rig, files: u32| {
        while rig.progress().files < files {
            let t = clock::mono_ns();
            let mut messages: Vec<_> = (0..1000)
                .map(|i| {
                    seq += 1;
                    // Data that does not compress.
                    let noise = seq.wrapping_mul(0x9E37_79B9_7F4A_7C15).to_le_bytes();
                    message("can0/rx", CanFrame::classic(0x100, &noise), &[], seq, t + i)
                })
                .collect();
            if rig.shared.keyframe_wanted.load(Ordering::Relaxed) {
                key += 1;
                messages.push(keyframe(key, t + 500));
            }
            rig.send(&messages);
            rig.settle();
        }
        (anonymous(), descriptors())
    };
    let warm = until(&mut rig, FILES.0);
    let end = until(&mut rig, FILES.1);
    eprintln!("{seq} messages, {} files: {} KiB, {} KiB", FILES.1, warm.0 >> 10, end.0 >> 10);
    // One more or less: a file that is still being synced.
    assert!(
        end.1 <= warm.1 + 1,
        "descriptors: {} with {} files, {} with {}",
        warm.1,
        FILES.0,
        end.1,
        FILES.1
    );
    assert!(end.0 < warm.0 + GROWTH, "{} bytes with {} files, {} with {}", warm.0, FILES.0, end.0, FILES.1);
    backlog(&rig);
    let files = rig.stop();
    assert!(files.len() < 20, "the quota was kept: {} files", files.len());
    assert!(files.iter().all(|f| disk::is_finished(f)));
}
