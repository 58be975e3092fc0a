use super::*;
use proptest::prelude::*;
use std::time::{Duration, Instant};

#[test]
fn the_newest_commit_is_found_again() {
    let mut memory = vec![0u8; MEMORY_BYTES];
    assert_eq!(newest(&memory), None);
    let mut committer = Committer::new(&memory);
    for i in 0..5u8 {
        committer.commit(&mut memory, 7, i64::from(i), &[i; 10]);
        let kept = newest(&memory).unwrap();
        assert_eq!((kept.seq, kept.plc_time_ns, kept.bytes), (u64::from(i) + 1, i64::from(i), vec![i; 10]));
        committer = Committer::new(&memory);
    }
}

proptest! {
    /// Death in the middle of a commit: any prefix of its bytes in any of its two steps was stored.
    #[test]
    fn a_torn_commit_leaves_the_one_before(len in 1usize..300, stored in 0usize..364, commits in 1u8..4) {
        let mut memory = vec![0u8; MEMORY_BYTES];
        let mut committer = Committer::new(&memory);
        for i in 0..commits {
            committer.commit(&mut memory, 1, 1, &vec![i; len]);
        }
        let before = memory.clone();
        committer.commit(&mut memory, 1, 2, &vec![99; len]);
        // Data first, then the header.
        let slot = usize::from(memory[..SLOT_BYTES] == before[..SLOT_BYTES]) * SLOT_BYTES;
        let mut torn = before;
        let data = stored.min(len);
        torn[slot + HEADER_BYTES..][..data].copy_from_slice(&memory[slot + HEADER_BYTES..][..data]);
        let head = stored.saturating_sub(len).min(HEADER_BYTES);
        torn[slot..slot + head].copy_from_slice(&memory[slot..slot + head]);
        let kept = newest(&torn).unwrap();
        prop_assert!(kept.bytes == vec![commits - 1; len] || kept.bytes == vec![99; len]);
    }

    #[test]
    fn any_memory_is_read_without_panic(mut head in prop::collection::vec(any::<u8>(), 64), len in any::<u64>()) {
        head[..8].copy_from_slice(&MAGIC);
        head[32..40].copy_from_slice(&len.to_le_bytes());
        prop_assert_eq!(decode_slot(&head), None);
    }
}

#[test]
fn the_disk_gets_the_newest_state_and_gives_it_back() {
    let dir = std::env::temp_dir().join(format!("dinrail-retain-{}", std::process::id()));
    std::fs::create_dir_all(&dir).unwrap();
    let path = dir.join("a.retain");
    let fd = rustix::fs::memfd_create("retain-test", rustix::fs::MemfdFlags::CLOEXEC).unwrap();
    rustix::fs::ftruncate(&fd, MEMORY_BYTES as u64).unwrap();
    let mut map = Mapping::new(&fd, MEMORY_BYTES).unwrap();
    assert!(Mapping::new(&fd, MEMORY_BYTES + 1).is_err());
    let mut committer = Committer::new(map.bytes());
    let copy = DiskCopy::start(fd.try_clone().unwrap(), path.clone()).unwrap();
    committer.commit(map.bytes_mut(), 5, 1, b"one");
    let limit = Instant::now() + Duration::from_secs(20);
    while read_file(&path).is_none_or(|kept| kept.bytes != b"one") {
        assert!(Instant::now() < limit, "the change never reached the disk");
        std::thread::sleep(Duration::from_millis(20));
    }
    committer.commit(map.bytes_mut(), 5, 2, b"two");
    while read_file(&path).is_none_or(|kept| kept.bytes != b"two") {
        assert!(Instant::now() < limit, "the second change never reached the disk");
        std::thread::sleep(Duration::from_millis(20));
    }
    // Only the PLC's time went on.
    committer.commit(map.bytes_mut(), 5, 9, b"two");
    drop(copy);
    let kept = read_file(&path).unwrap();
    assert_eq!((kept.plc_time_ns, kept.bytes), (9, b"two".to_vec()));
    std::fs::write(&path, b"rubbish").unwrap();
    assert_eq!(read_file(&path), None);
    std::fs::remove_dir_all(&dir).unwrap();
}

#[test]
fn engines_whose_files_differ_in_the_last_part_only_do_not_meet() {
    let dir = std::env::temp_dir().join(format!("dinrail-retain-aside-{}", std::process::id()));
    // What stands in the way of one file's neighbour must not hinder the other file.
    std::fs::create_dir_all(dir.join("keep.new")).unwrap();
    let fd = rustix::fs::memfd_create("retain-test", rustix::fs::MemfdFlags::CLOEXEC).unwrap();
    rustix::fs::ftruncate(&fd, MEMORY_BYTES as u64).unwrap();
    let mut map = Mapping::new(&fd, MEMORY_BYTES).unwrap();
    let mut committer = Committer::new(map.bytes());
    committer.commit(map.bytes_mut(), 5, 1, b"one");
    drop(DiskCopy::start(fd, dir.join("keep.1")).unwrap());
    assert_eq!(read_file(&dir.join("keep.1")).map(|kept| kept.bytes), Some(b"one".to_vec()));
    std::fs::remove_dir_all(&dir).unwrap();
}

#[test]
fn a_copy_that_fails_is_told_once_and_once_when_it_succeeds_again() {
    let dir = std::env::temp_dir().join(format!("dinrail-retain-full-{}", std::process::id()));
    let _ = std::fs::remove_dir_all(&dir);
    let path = dir.join("a.retain");
    let fd = rustix::fs::memfd_create("retain-test", rustix::fs::MemfdFlags::CLOEXEC).unwrap();
    rustix::fs::ftruncate(&fd, MEMORY_BYTES as u64).unwrap();
    let mut map = Mapping::new(&fd, MEMORY_BYTES).unwrap();
    let mut committer = Committer::new(map.bytes());
    committer.commit(map.bytes_mut(), 5, 1, b"one");
    // The folder is not there.
    let copy = DiskCopy::start(fd, path.clone()).unwrap();
    let wait = |what: &str, mut found: Box<dyn FnMut() -> bool + '_>| {
        let limit = Instant::now() + Duration::from_secs(20);
        while !found() {
            assert!(Instant::now() < limit, "{what}");
            std::thread::sleep(Duration::from_millis(20));
        }
    };
    let mut news = Vec::new();
    wait("several failures", Box::new(|| copy.failures() >= 3));
    news.extend(copy.news());
    assert_eq!(copy.news(), None, "once");
    let Some(CopyNews::Failing(text)) = news.pop() else { panic!("not told") };
    assert!(text.contains(&path.display().to_string()) && text.contains("make its folder"), "{text}");
    std::fs::create_dir_all(&dir).unwrap();
    wait(
        "told that it works",
        Box::new(|| {
            news.extend(copy.news());
            !news.is_empty()
        }),
    );
    assert!(matches!(&news[..], [CopyNews::Working(_)]), "{news:?}");
    assert_eq!(read_file(&path).map(|kept| kept.bytes), Some(b"one".to_vec()));
    drop(copy);
    std::fs::remove_dir_all(&dir).unwrap();
}

/// Power is cut anywhere in the writing of a second state: the first or the second is read, never none.
#[test]
fn a_power_cut_while_the_file_is_written_loses_neither_copy() {
    let dir = std::env::temp_dir().join(format!("dinrail-retain-cut-{}", std::process::id()));
    let _ = std::fs::remove_dir_all(&dir);
    std::fs::create_dir_all(&dir).unwrap();
    let path = dir.join("a.retain");
    let aside = dir.join("a.retain.new");
    let bytes = |seq: u64, data: &[u8]| [&header(seq, 7, seq as i64, data)[..], data].concat();
    let (old, new) = (bytes(1, &[1; 40]), bytes(2, &[2; 40]));
    let read = || read_file(&path).map(|kept| kept.bytes[0]);
    assert_eq!(read(), None);
    std::fs::write(&path, &old).unwrap();
    for written in 0..=new.len() {
        std::fs::write(&aside, &new[..written]).unwrap();
        assert_eq!(read(), Some(1), "{written} bytes beside");
    }
    // A rename in two steps: first the old name goes.
    std::fs::remove_file(&path).unwrap();
    assert_eq!(read(), Some(2));
    std::fs::write(&path, []).unwrap();
    assert_eq!(read(), Some(2));
    std::fs::rename(&aside, &path).unwrap();
    assert_eq!(read(), Some(2));
    // Any damage is seen.
    for at in (0..new.len()).filter(|at| !(48..HEADER_BYTES).contains(at)) {
        let mut damaged = new.clone();
        damaged[at] ^= 0x10;
        std::fs::write(&path, &damaged).unwrap();
        assert_eq!(read(), None, "byte {at}");
    }
    // What is no file of ours is not read to its end.
    assert_eq!(read_file(std::path::Path::new("/dev/zero")), None);
    assert_eq!(read_file(&dir), None);
    std::fs::remove_dir_all(&dir).unwrap();
}
