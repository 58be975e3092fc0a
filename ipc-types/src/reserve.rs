//! Memory that is there when it is needed. iceoryx2 sizes its objects and leaves their pages to be found when they are
//! first touched: on a full /dev/shm that touch is a SIGBUS, and it comes long after the start (the queue of a reader
//! that was killed fills up, and every message in it holds a chunk that was never used before). So every service has the
//! system set all pages of the stack's objects aside before it says that it is ready, and the launcher once a second
//! those of tools that came later.

use rustix::fs::{AtFlags, FallocateFlags, FileType, Mode, OFlags};
use rustix::io::Errno;
use std::os::unix::ffi::OsStrExt;
use std::path::Path;

/// What [`reserve`] found.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Reserved {
    /// Bytes of all objects.
    pub bytes: u64,
    /// Of these, bytes there was no room for.
    pub missing: u64,
}

impl Reserved {
    /// What to say when there was not room for all.
    pub fn complaint(&self) -> Option<String> {
        (self.missing > 0).then(|| {
            format!(
                "/dev/shm is full: {} KiB of the {} KiB of this stack's memory could not be set aside; whoever needs it \
                 is killed by SIGBUS and started again: remove files there or make it larger",
                self.missing.div_ceil(1024),
                self.bytes.div_ceil(1024)
            )
        })
    }
}

/// Sets aside all pages of the objects in `shm` (/dev/shm) whose names begin with the stack's prefix. What is already
/// there costs one look. Objects that are just being made or removed by others are left out.
pub fn reserve(shm: &Path, prefix: &str) -> std::io::Result<Reserved> {
    let folder = rustix::fs::open(shm, OFlags::RDONLY | OFlags::DIRECTORY | OFlags::CLOEXEC, Mode::empty())?;
    let mut found = Reserved::default();
    // An empty prefix would match the objects of everybody.
    if prefix.len() < 4 {
        return Ok(found);
    }
    for entry in std::fs::read_dir(shm)?.flatten() {
        let name = entry.file_name();
        if !name.as_bytes().starts_with(prefix.as_bytes()) {
            continue;
        }
        let flags = OFlags::WRONLY | OFlags::NOFOLLOW | OFlags::NONBLOCK | OFlags::CLOEXEC;
        let Ok(look) = rustix::fs::statat(&folder, &name, AtFlags::SYMLINK_NOFOLLOW) else { continue };
        let (size, there) = (look.st_size.max(0) as u64, (look.st_blocks.max(0) as u64).saturating_mul(512));
        if FileType::from_raw_mode(look.st_mode) != FileType::RegularFile {
            continue;
        }
        found.bytes += size;
        if there >= size {
            continue;
        }
        // An attempt that cannot succeed would take all that is left for a moment, under the feet of everybody else.
        if rustix::fs::fstatvfs(&folder).is_ok_and(|room| is_short(&room, size - there)) {
            found.missing += size - there;
            continue;
        }
        let Ok(object) = rustix::fs::openat(&folder, &name, flags, Mode::empty()) else { continue };
        loop {
            match rustix::fs::fallocate(&object, FallocateFlags::KEEP_SIZE, 0, size) {
                Err(Errno::INTR) => {}
                Err(Errno::NOSPC | Errno::NOMEM) => {
                    found.missing += size - there;
                    break;
                }
                // A system that cannot is one where pages come when they are touched.
                Ok(()) | Err(_) => break,
            }
        }
    }
    Ok(found)
}

/// Whether so many bytes are not there; a file system without a limit says that it has no blocks at all.
fn is_short(room: &rustix::fs::StatVfs, bytes: u64) -> bool {
    room.f_blocks > 0 && room.f_bavail.saturating_mul(room.f_frsize) < bytes
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test may end like this")]
    use super::*;
    use std::os::unix::fs::MetadataExt;

    #[test]
    fn objects_of_the_stack_have_all_their_pages_and_nothing_else_is_touched() {
        let shm = Path::new("/dev/shm");
        let prefix = format!("drtest{}_", std::process::id());
        let file = |name: &str, size: u64| {
            let path = shm.join(name);
            std::fs::File::create(&path).unwrap().set_len(size).unwrap();
            path
        };
        let ours = file(&format!("{prefix}a"), 300_000);
        let other = file(&format!("x{prefix}a"), 300_000);
        // More than there is room for, where there is a limit at all.
        let room = rustix::fs::statvfs(shm).unwrap();
        let too_much = 2 * room.f_blocks * room.f_frsize;
        let huge = file(&format!("{prefix}b"), too_much);
        let there = |path: &Path| path.metadata().unwrap().blocks() * 512;
        let found = reserve(shm, &prefix);
        let (left, untouched) = (there(&huge), there(&other));
        let reserved = there(&ours);
        for path in [ours, other, huge] {
            std::fs::remove_file(path).unwrap();
        }
        assert_eq!(found.unwrap(), Reserved { bytes: 300_000 + too_much, missing: too_much });
        assert!(reserved >= 300_000);
        assert_eq!((left, untouched), (0, 0), "what does not fit is given back whole");
        assert_eq!(reserve(shm, "").unwrap(), Reserved::default());
    }
}
