//! File names, what lies in the folder, quota, free space, and the lock that says "this file is being written".

use crate::utc::Utc;
use rustix::fs::FlockOperation;
use std::fs::{File, OpenOptions};
use std::io::{self, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

/// Ending of recordings.
pub const ENDING: &str = ".mcap";
/// Ending of the copy that sealing writes before it takes the file's place.
pub const SEALING: &str = ".mcap.sealing";

/// `<stack>-<UTC yyyymmddThhmmss.mmm>-<n>.mcap`. `n` counts all files of the stack in the folder: a machine that starts
/// with a wrong clock names its files by it, and the newest must not be taken for the oldest.
pub fn file_name(stack: &str, utc_ns: i64, n: u64) -> String {
    format!("{stack}-{}-{n}{ENDING}", Utc::from_ns(utc_ns).compact())
}

/// Time and number of a name that [`file_name`] made for this stack.
fn parse_name<'a>(stack: &str, name: &'a str, ending: &str) -> Option<(&'a str, u64)> {
    let rest = name.strip_prefix(stack)?.strip_prefix('-')?.strip_suffix(ending)?;
    let (time, n) = rest.split_once('-')?;
    let shape = time.bytes().enumerate().all(|(i, c)| match i {
        8 => c == b'T',
        15 => c == b'.',
        _ => c.is_ascii_digit(),
    });
    (shape && time.len() == 19).then_some((time, n.parse().ok()?))
}

/// A recording of the folder.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Found {
    pub path: PathBuf,
    pub bytes: u64,
}

fn listed(dir: &Path, stack: &str, ending: &str) -> Vec<Found> {
    let Ok(folder) = std::fs::read_dir(dir) else { return Vec::new() };
    let mut found = Vec::new();
    for item in folder.flatten() {
        let name = item.file_name();
        let Some((time, n)) = name.to_str().and_then(|name| parse_name(stack, name, ending)) else {
            continue;
        };
        let Ok(meta) = item.metadata() else { continue };
        if meta.is_file() {
            found.push(((n, time.to_owned()), Found { path: item.path(), bytes: meta.len() }));
        }
    }
    found.sort_by(|a, b| a.0.cmp(&b.0));
    found.into_iter().map(|(_, found)| found).collect()
}

/// This stack's recordings in the folder, oldest first.
pub fn recordings(dir: &Path, stack: &str) -> Vec<Found> {
    listed(dir, stack, ENDING)
}

/// Number of this stack's newest recording in the folder, 0 when there is none. Reads names alone.
pub fn last_number(dir: &Path, stack: &str) -> u64 {
    let Ok(folder) = std::fs::read_dir(dir) else { return 0 };
    folder.flatten().filter_map(|item| number(stack, item.file_name().to_str()?)).max().unwrap_or(0)
}

/// The number in a recording's name.
fn number(stack: &str, name: &str) -> Option<u64> {
    parse_name(stack, name, ENDING).map(|(_, n)| n)
}

/// Every `.mcap` file of the folder, of any stack and making, by name.
pub fn all_recordings(dir: &Path) -> io::Result<Vec<Found>> {
    let mut found = Vec::new();
    for item in std::fs::read_dir(dir)?.flatten() {
        let meta = item.metadata();
        if item.path().extension().is_some_and(|e| e == "mcap") && meta.as_ref().is_ok_and(|m| m.is_file()) {
            found.push(Found { path: item.path(), bytes: meta.map_or(0, |m| m.len()) });
        }
    }
    found.sort_by(|a, b| a.path.cmp(&b.path));
    Ok(found)
}

/// Removes half-made copies of a sealing that was killed.
pub fn remove_half_sealed(dir: &Path, stack: &str) {
    for found in listed(dir, stack, SEALING) {
        if open_locked(&found.path).is_ok_and(|(_file, lock)| matches!(lock, Lock::Taken)) {
            let _ = std::fs::remove_file(&found.path);
        }
    }
}

/// Creates the next file. Never overwrites: counts `n` up over what is there.
pub fn create(dir: &Path, stack: &str, utc_ns: i64, n: &mut u64) -> io::Result<(PathBuf, File)> {
    for _ in 0..1000 {
        *n = n.saturating_add(1);
        let path = dir.join(file_name(stack, utc_ns, *n));
        match OpenOptions::new().read(true).write(true).create_new(true).open(&path) {
            Ok(file) => {
                lock(&file);
                return Ok((path, file));
            }
            Err(e) if e.kind() == io::ErrorKind::AlreadyExists => {}
            Err(e) => return Err(e),
        }
    }
    Err(io::Error::new(io::ErrorKind::AlreadyExists, "1000 files of this very millisecond exist"))
}

/// What came of asking for a file's lock.
#[derive(Debug)]
pub enum Lock {
    /// Ours until the descriptor is closed, so also until the process ends.
    Taken,
    /// Another descriptor has it: the file is being written or sealed.
    InUse,
    /// The file system knows no locks.
    Unknown(io::Error),
}

/// Takes the lock of a file that is being written or sealed; `false` when it was not to be had.
pub fn lock(file: &File) -> bool {
    matches!(try_lock(file), Lock::Taken)
}

fn try_lock(file: &File) -> Lock {
    match rustix::fs::flock(file, FlockOperation::NonBlockingLockExclusive) {
        Ok(()) => Lock::Taken,
        Err(rustix::io::Errno::WOULDBLOCK) => Lock::InUse,
        Err(e) => Lock::Unknown(e.into()),
    }
}

/// Opens a file for its lock alone. For writing where that is allowed: file systems over a network give no exclusive lock
/// without.
pub fn open_locked(path: &Path) -> io::Result<(File, Lock)> {
    let writing = OpenOptions::new().read(true).write(true).open(path);
    let file = match writing {
        Ok(file) => file,
        Err(e) if e.kind() == io::ErrorKind::NotFound => return Err(e),
        Err(_) => File::open(path)?,
    };
    let lock = try_lock(&file);
    Ok((file, lock))
}

/// Whether a file ends as a finished recording does.
pub fn is_finished(path: &Path) -> bool {
    let ends = |path: &Path| -> io::Result<bool> {
        let mut file = File::open(path)?;
        if file.metadata()?.len() < 2 * mcap::MAGIC.len() as u64 {
            return Ok(false);
        }
        file.seek(SeekFrom::End(-(mcap::MAGIC.len() as i64)))?;
        let mut last = [0u8; 8];
        file.read_exact(&mut last)?;
        Ok(last == *mcap::MAGIC)
    };
    ends(path).unwrap_or(false)
}

/// Bytes that this user may still write where the folder is or would be.
pub fn free_bytes(dir: &Path) -> Option<u64> {
    let existing = dir.ancestors().find(|d| d.exists())?;
    let stat = rustix::fs::statvfs(existing).ok()?;
    Some(stat.f_bavail.saturating_mul(stat.f_frsize))
}

/// Whether files can be made in the folder, or the folder itself. Leaves nothing behind.
pub fn writable(dir: &Path) -> io::Result<()> {
    let not =
        |path: &Path, cause: String| io::Error::other(format!("cannot write {}: {cause}", path.display()));
    let Some(existing) = dir.ancestors().find(|d| d.exists()) else {
        return Err(not(dir, "no folder above it exists".into()));
    };
    if !existing.is_dir() {
        return Err(not(existing, "not a folder".into()));
    }
    rustix::fs::access(existing, rustix::fs::Access::WRITE_OK | rustix::fs::Access::EXEC_OK)
        .map_err(|e| not(existing, io::Error::from(e).to_string()))?;
    // A file system without files of its own (/proc) grants access and refuses all the same.
    let probe = existing.join(format!(".dinrail-probe-{}", std::process::id()));
    let made = OpenOptions::new().write(true).create_new(true).open(&probe);
    let _ = std::fs::remove_file(&probe);
    made.map(|_| ()).map_err(|e| not(existing, e.to_string()))
}

/// `12.3 MiB`.
pub fn human(bytes: u64) -> String {
    let mut value = bytes as f64;
    for unit in ["B", "KiB", "MiB", "GiB"] {
        if value < 1024.0 || unit == "GiB" {
            return if unit == "B" { format!("{bytes} B") } else { format!("{value:.1} {unit}") };
        }
        value /= 1024.0;
    }
    format!("{bytes} B")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{TempDir, file};

    #[test]
    fn only_names_of_this_stack_count() {
        assert_eq!(file_name("a", 0, 3), "a-19700101T000000.000-3.mcap");
        let ok = "a-19700101T000000.000-3.mcap";
        assert_eq!(parse_name("a", ok, ENDING), Some(("19700101T000000.000", 3)));
        for (stack, name) in [
            ("b", ok),
            ("a", "a-2-19700101T000000.000-3.mcap"), // stack "a-2"
            ("a", "a-19700101T000000.000-3.mcap.sealing"),
            ("a", "a-19700101T000000.000.mcap"),
            ("a", "a-19700101T000000,000-3.mcap"),
            ("a", "a-1970é101T00000.000-3.mcap"),
            ("a", "notes.txt"),
        ] {
            assert_eq!(parse_name(stack, name, ENDING), None, "{name}");
        }
        assert!(parse_name("a-2", "a-2-19700101T000000.000-3.mcap", ENDING).is_some());
    }

    #[test]
    fn names_never_collide() {
        let dir = TempDir::new("names");
        let mut n = 0;
        let (first, _held) = create(dir.path(), "s", 5, &mut n).unwrap();
        let mut again = 0;
        let (second, _held) = create(dir.path(), "s", 5, &mut again).unwrap();
        assert_ne!(first, second);
        assert_eq!((n, again), (1, 2));
        assert!(create(&dir.path().join("missing"), "s", 5, &mut n).is_err());
        // The last number of all does not run over.
        let mut last = u64::MAX;
        let (path, _held) = create(dir.path(), "s", 5, &mut last).unwrap();
        assert!(path.ends_with("s-19700101T000000.000-18446744073709551615.mcap"), "{path:?}");
        assert!(create(dir.path(), "s", 5, &mut last).is_err());
        assert!(create(dir.path(), "s", 2_000_000, &mut last).is_ok());
        assert_eq!(last_number(dir.path(), "s"), u64::MAX);
    }

    #[test]
    fn a_folder_that_cannot_be_made_is_refused_with_its_path() {
        let dir = TempDir::new("writable");
        writable(&dir.path().join("new/deeper")).unwrap();
        assert!(!dir.path().join("new").exists());
        let plain = file(dir.path(), "plain", 10, false);
        for bad in [plain.join("under"), PathBuf::from("/proc/recordings")] {
            let error = writable(&bad).unwrap_err().to_string();
            assert!(error.starts_with("cannot write /"), "{error}");
        }
    }

    #[test]
    fn sizes_for_people() {
        assert_eq!(human(999), "999 B");
        assert_eq!(human(1536), "1.5 KiB");
        assert_eq!(human(5 << 40), "5120.0 GiB");
    }
}
