//! What lies in the folder, kept in memory: a folder of years has thousands of files, and the quota is looked at every
//! second. The folder is read at the start, and now and then for what others do in it.

use crate::disk::{Found, Lock, is_finished, last_number, open_locked, recordings};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// The folder is read again, at the earliest after this: by then files were made whole, copied or deleted by hand.
const LOOK_AGAIN: Duration = Duration::from_mins(1);

/// A recording on the shelf.
#[derive(Debug, Clone)]
struct Entry {
    found: Found,
    /// Known to end as a finished file does. It stays so.
    finished: bool,
}

/// The files of one stack in one folder, oldest first.
#[derive(Debug)]
pub struct Shelf {
    dir: PathBuf,
    stack: String,
    files: Vec<Entry>,
    total: u64,
    looked_at: Option<Instant>,
}

impl Shelf {
    /// Nothing is read yet.
    pub fn new(dir: &Path, stack: &str) -> Self {
        Self { dir: dir.to_owned(), stack: stack.to_owned(), files: Vec::new(), total: 0, looked_at: None }
    }

    /// Reads the folder.
    pub fn look(&mut self) {
        let found = recordings(&self.dir, &self.stack);
        // Both are in the same order, but for files that came or went between.
        let known: std::collections::BTreeSet<PathBuf> =
            self.files.drain(..).filter(|e| e.finished).map(|e| e.found.path).collect();
        self.files =
            found.into_iter().map(|found| Entry { finished: known.contains(&found.path), found }).collect();
        self.total = self.files.iter().map(|e| e.found.bytes).sum();
        self.looked_at = Some(Instant::now());
    }

    /// Number of the newest file in the folder, without reading more than names.
    pub fn last_number(&self) -> u64 {
        last_number(&self.dir, &self.stack)
    }

    /// All files.
    pub fn paths(&self) -> impl Iterator<Item = PathBuf> {
        self.files.iter().map(|e| e.found.path.clone())
    }

    /// A file of ours has this many bytes now. A new one is the newest.
    pub fn put(&mut self, path: &Path, bytes: u64) {
        // From the end: it is the last one, or next to it.
        if let Some(entry) = self.files.iter_mut().rev().find(|e| e.found.path == path) {
            self.total = self.total - entry.found.bytes + bytes;
            entry.found.bytes = bytes;
        } else {
            self.total += bytes;
            self.files.push(Entry { found: Found { path: path.to_owned(), bytes }, finished: false });
        }
    }

    /// A file is no longer there.
    pub fn forget(&mut self, path: &Path) {
        self.files.retain(|e| e.found.path != path);
        self.total = self.files.iter().map(|e| e.found.bytes).sum();
    }

    /// Deletes files until all together take at most `keep` bytes: the oldest finished ones, and when those
    /// are not enough, the oldest unfinished ones, which could not be made whole. The current file and files in use stay.
    /// Returns what was deleted.
    pub fn keep(&mut self, keep: u64, current: Option<&Path>) -> Vec<Found> {
        let mut deleted = Vec::new();
        if let Some(at) = self.looked_at
            && at.elapsed() >= LOOK_AGAIN
        {
            let ours = current.and_then(|path| self.files.iter().find(|e| e.found.path == path)).cloned();
            self.look();
            // What was counted is newer than what the folder told.
            if let Some(ours) = ours {
                self.put(&ours.found.path, ours.found.bytes);
            }
        }
        for unfinished in [false, true] {
            let mut at = 0;
            while self.total > keep && at < self.files.len() {
                let entry = &mut self.files[at];
                entry.finished |=
                    Some(entry.found.path.as_path()) != current && is_finished(&entry.found.path);
                let protected = Some(entry.found.path.as_path()) == current || entry.finished == unfinished;
                if protected || !delete(&entry.found.path) {
                    at += 1;
                    continue;
                }
                let entry = self.files.remove(at);
                self.total -= entry.found.bytes;
                deleted.push(entry.found);
            }
        }
        deleted
    }
}

/// Whether the file is gone. One that is being written or made whole stays.
fn delete(path: &Path) -> bool {
    match open_locked(path) {
        Ok((_file, Lock::InUse)) => false,
        // Gone already, or not to be opened: the folder decides whether it can be deleted.
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => true,
        Ok(_) | Err(_) => std::fs::remove_file(path).is_ok(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::disk::{all_recordings, file_name, lock};
    use crate::testing::{TempDir, file};
    use std::fs::File;

    fn shelf(dir: &Path) -> Shelf {
        let mut shelf = Shelf::new(dir, "s");
        shelf.look();
        shelf
    }

    #[test]
    fn the_oldest_finished_file_goes_first() {
        let dir = TempDir::new("quota");
        // The clock goes wrong after the sixth: the number says which is the newest.
        let second = |n: u64| if n > 6 { n as i64 - 100 } else { n as i64 };
        let names: Vec<_> = (1..=12).map(|n| file_name("s", second(n) * 1_000_000_000, n)).collect();
        assert_eq!(shelf(dir.path()).last_number(), 0);
        for (i, name) in names.iter().enumerate() {
            file(dir.path(), name, 1000, i != 1);
        }
        let stranger = file(dir.path(), "other-19700101T000000.000-1.mcap", 1000, true);
        let held = File::open(dir.path().join(&names[2])).unwrap();
        assert!(lock(&held));
        let current = dir.path().join(&names[11]);
        let deleted = shelf(dir.path()).keep(9500, Some(&current));
        // 12000 bytes: 0 goes, 1 is unfinished, 2 is in use, 3 and 4 go.
        let gone: Vec<_> = deleted.iter().map(|f| f.path.file_name().unwrap().to_str().unwrap()).collect();
        assert_eq!(gone, [&names[0], &names[3], &names[4]]);
        assert!(stranger.exists());
        assert_eq!(all_recordings(dir.path()).unwrap().len(), 12 + 1 - 3);
        assert_eq!(shelf(dir.path()).last_number(), 12);
        let left = || recordings(dir.path(), "s").into_iter().map(|f| f.path).collect::<Vec<_>>();
        let of = |i: usize| dir.path().join(&names[i]);
        // All finished ones before the first unfinished one.
        shelf(dir.path()).keep(3000, Some(&current));
        assert_eq!(left(), [of(1), of(2), current.clone()]);
        // Nothing but protected files is left at last; the current one stays even above the quota.
        shelf(dir.path()).keep(0, Some(&current));
        assert_eq!(left(), [of(2), current]);
    }

    #[test]
    fn what_grows_and_ends_is_counted_without_reading_the_folder() {
        let dir = TempDir::new("shelf");
        let names: Vec<_> = (1..=4).map(|n| dir.path().join(file_name("s", 0, n))).collect();
        file(dir.path(), names[0].file_name().unwrap().to_str().unwrap(), 1000, true);
        let mut shelf = shelf(dir.path());
        shelf.put(&names[1], 100);
        shelf.put(&names[1], 600);
        assert_eq!(shelf.total, 1600);
        assert!(shelf.keep(1600, Some(&names[1])).is_empty());
        // The second is finished, the third begins: the first must go.
        file(dir.path(), names[1].file_name().unwrap().to_str().unwrap(), 700, true);
        shelf.put(&names[1], 700);
        shelf.put(&names[2], 50);
        let gone: Vec<_> = shelf.keep(1600, Some(&names[2])).into_iter().map(|f| f.path).collect();
        assert_eq!(gone, [names[0].clone()]);
        // Deleted by hand meanwhile: counted as gone when it is its turn.
        std::fs::remove_file(&names[1]).unwrap();
        assert_eq!(shelf.keep(100, Some(&names[2])).len(), 1);
        assert_eq!(shelf.total, 50);
        shelf.forget(&names[2]);
        assert_eq!((shelf.total, shelf.paths().count()), (0, 0));
    }

    #[test]
    fn a_thousand_files_are_read_once() {
        let dir = TempDir::fast("thousand");
        for n in 1..=2000 {
            file(dir.path(), &file_name("s", 0, n), 16, true);
        }
        let mut shelf = shelf(dir.path());
        assert_eq!((shelf.total, shelf.last_number()), (32_000, 2000));
        // A folder that cannot be read any more tells nothing new: the shelf does not ask it.
        for keep in [32_000, 31_990] {
            shelf.put(&dir.path().join(file_name("s", 0, 2000)), 16);
            shelf.keep(keep, None);
        }
        assert_eq!(shelf.files.iter().filter(|e| e.finished).count(), 0, "one was looked at, and it is gone");
        assert_eq!(shelf.files.len(), 1999);
    }
}
