//! The disk is full in the moment in which a chunk takes the place of its raw messages: they are still there.
//!
//! One test, alone in its process: the limit is the process's.
#![cfg(target_os = "linux")]
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a test that fails")]

mod common;

use common::TempDir;
use dinrail_recorder::config::Compression;
use dinrail_recorder::file::{CHUNK_AGE, RecordingFile};
use dinrail_recorder::format::{META_RECORDING, RAW_CRC32, RAW_KEY, gaps_channel};
use dinrail_recorder::reader::Recording;
use mcap::records::MessageHeader;
use std::collections::BTreeMap;
use std::fs::File;
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

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

fn messages(path: &Path) -> (usize, u64) {
    let mut messages = Recording::open(path).unwrap().messages();
    let count = messages.by_ref().map(Result::unwrap).filter(|m| m.topic == "recorder/gaps").count();
    (count, messages.recording().end().unread)
}

#[test]
fn a_chunk_that_does_not_fit_leaves_its_messages_as_they_stood() {
    let dir = TempDir::new("chunk-limit");
    for how in ["age", "finish", "metadata"] {
        let path = dir.path().join(how);
        let handle = File::options().read(true).write(true).create_new(true).open(&path).unwrap();
        // Uncompressed, a chunk with its head is longer than its messages were.
        let mut file = RecordingFile::new(Arc::new(handle), Compression::None, false).unwrap();
        let raw = BTreeMap::from([(RAW_KEY.to_owned(), RAW_CRC32.to_owned())]);
        file.metadata(META_RECORDING, raw).unwrap();
        let channel = file.add_channel(&gaps_channel()).unwrap();
        file.close_chunk().unwrap();
        let now = Instant::now();
        for sequence in 1..=20 {
            let head = MessageHeader { channel_id: channel, sequence, log_time: 7, publish_time: 7 };
            file.message(&head, b"{\"text\":\"twenty of these\"}", now).unwrap();
        }
        file.flush(now).unwrap();
        assert_eq!(messages(&path), (20, 0));
        limit_files(file.bytes());
        match how {
            "age" => {
                file.flush(now + CHUNK_AGE).unwrap_err();
                file.abandon();
            }
            "finish" => drop(file.finish().unwrap_err()),
            _ => {
                file.metadata("name", BTreeMap::new()).unwrap_err();
                file.abandon();
            }
        }
        assert_eq!(messages(&path), (20, 0), "{how}");
        limit_files(libc::RLIM_INFINITY);
    }
}
