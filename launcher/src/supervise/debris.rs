//! What a process leaves that is killed while it makes an object in shared memory: a file of zero bytes.
//!
//! Everybody who opens such a file waits for its size for ever (iceoryx2 0.10.0, `dynamic_storage`: the arm for a
//! size of zero knows no timeout; measured: 150 kills at random moments of start-up suffice). So it is removed before
//! and while dead nodes are cleaned up. A live process may be between making a file and sizing it, some
//! microseconds: its files are told apart by being open in a process every time one looks; who merely waits for a
//! file opens and closes it.

use std::ffi::OsString;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// A file must be found open so often to count as being made.
const LOOKS: usize = 4;
/// Time between two looks; longer than who waits keeps the file open (it looks once a millisecond).
const BETWEEN: Duration = Duration::from_micros(1700);

/// Removes the half-made objects of a stack; returns how many. `shm` is `/dev/shm`.
pub fn remove_half_made(shm: &Path, prefix: &str) -> usize {
    if prefix.len() < 4 {
        return 0;
    }
    let mut suspects = half_made(shm, prefix);
    let mut removed = 0;
    for look in 0..LOOKS {
        if suspects.is_empty() {
            break;
        }
        if look > 0 {
            std::thread::sleep(BETWEEN);
        }
        let open = open_files(shm);
        suspects.retain(|(path, inode)| {
            let still = std::fs::symlink_metadata(path).is_ok_and(|m| m.ino() == *inode && m.size() == 0);
            if still && !open.contains(&path.clone().into_os_string()) {
                removed += usize::from(std::fs::remove_file(path).is_ok());
                return false;
            }
            still
        });
    }
    removed
}

/// Files of zero bytes with the stack's prefix, with their inodes.
fn half_made(shm: &Path, prefix: &str) -> Vec<(PathBuf, u64)> {
    std::fs::read_dir(shm)
        .into_iter()
        .flatten()
        .flatten()
        .filter(|entry| entry.file_name().as_encoded_bytes().starts_with(prefix.as_bytes()))
        .filter_map(|entry| {
            let found = entry.metadata().ok()?;
            (found.is_file() && found.size() == 0).then(|| (entry.path(), found.ino()))
        })
        .collect()
}

/// Files of a folder that other processes of this user have open.
fn open_files(folder: &Path) -> Vec<OsString> {
    let own = std::process::id().to_string();
    let mut list = Vec::new();
    for process in std::fs::read_dir("/proc").into_iter().flatten().flatten() {
        let name = process.file_name();
        if !name.as_encoded_bytes().iter().all(u8::is_ascii_digit) || name.to_str() == Some(&own) {
            continue;
        }
        for fd in std::fs::read_dir(process.path().join("fd")).into_iter().flatten().flatten() {
            if let Ok(target) = std::fs::read_link(fd.path())
                && target.parent() == Some(folder)
            {
                list.push(target.into_os_string());
            }
        }
    }
    list
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::process::{Command, Stdio};

    #[test]
    fn only_what_nobody_makes_is_removed() {
        let shm = std::env::temp_dir().join(format!("dinrail-debris-{}", std::process::id()));
        let _ = std::fs::remove_dir_all(&shm);
        std::fs::create_dir(&shm).unwrap();
        for name in ["dr1_dead.connection", "dr1_made.connection", "dr2_other.connection"] {
            std::fs::write(shm.join(name), "").unwrap();
        }
        std::fs::write(shm.join("dr1_whole.data"), "x").unwrap();
        // Another process has it open, as one that is about to size it.
        let made = std::fs::File::open(shm.join("dr1_made.connection")).unwrap();
        let mut maker =
            Command::new("sleep").arg("60").stdin(Stdio::from(made)).stdout(Stdio::null()).spawn().unwrap();
        let removed = remove_half_made(&shm, "dr1_");
        maker.kill().unwrap();
        maker.wait().unwrap();
        assert_eq!(removed, 1);
        let mut left: Vec<_> = std::fs::read_dir(&shm).unwrap().map(|e| e.unwrap().file_name()).collect();
        left.sort();
        assert_eq!(left, ["dr1_made.connection", "dr1_whole.data", "dr2_other.connection"]);
        assert_eq!(remove_half_made(&shm, "dr1_"), 1, "its maker is gone");
        assert_eq!(remove_half_made(&shm, ""), 0);
        std::fs::remove_dir_all(&shm).unwrap();
    }
}
