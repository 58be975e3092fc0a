//! Which stacks run: one locked file a stack, outside of the stack's shared memory.
//!
//! The lock is taken before anything of the stack is touched and held until everything is gone, so that two
//! launchers can never wipe each other's memory. The lock belongs to the open file: the kernel releases it with
//! the process, whatever killed it. What the file says is for other programs and people.

use rustix::fs::FlockOperation;
use serde::{Deserialize, Serialize};
use std::fs::{DirBuilder, File, OpenOptions};
use std::io::{self, Read, Seek, Write};
use std::os::unix::fs::{DirBuilderExt, MetadataExt, OpenOptionsExt};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Name of the control socket in a stack's root.
pub const SOCKET: &str = "control.sock";
/// A tool may look at the lock for an instant; a launcher holds it.
const LOCK_PATIENCE: Duration = Duration::from_millis(300);

/// What the file of a running stack says.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct RunningStack {
    pub stack: String,
    pub pid: u32,
    pub root: PathBuf,
    /// UTC in ns since 1970.
    pub since_utc_ns: i64,
    /// The stack file.
    pub file: PathBuf,
}

/// Why a stack could not be locked.
#[derive(Debug, thiserror::Error)]
pub enum LockError {
    #[error(
        "stack '{stack}' is already running, pid {pid}; `dinrail down --stack {stack}` ends it, or give this one \
         another name"
    )]
    Running { stack: String, pid: u32 },
    #[error(
        "state folder {path}: {source}; set XDG_RUNTIME_DIR to a folder that belongs to you alone, or remove this one"
    )]
    Folder { path: PathBuf, source: io::Error },
    #[error("stack state file {path}: {source}")]
    File { path: PathBuf, source: io::Error },
}

/// Where the state files are: `$XDG_RUNTIME_DIR/dinrail`, as root `/run/dinrail`, else `/tmp/dinrail-<uid>`.
pub fn folder() -> PathBuf {
    let uid = rustix::process::getuid().as_raw();
    match std::env::var_os("XDG_RUNTIME_DIR") {
        Some(dir) if Path::new(&dir).is_absolute() && Path::new(&dir).is_dir() => {
            PathBuf::from(dir).join("dinrail")
        }
        _ if uid == 0 => PathBuf::from("/run/dinrail"),
        _ => PathBuf::from(format!("/tmp/dinrail-{uid}")),
    }
}

/// Makes the folder, or makes sure that an existing one is ours alone: `/tmp` is everybody's.
fn prepare(folder: &Path) -> io::Result<()> {
    match DirBuilder::new().mode(0o700).create(folder) {
        Err(e) if e.kind() != io::ErrorKind::AlreadyExists => return Err(e),
        _ => {}
    }
    let found = std::fs::symlink_metadata(folder)?;
    if !found.is_dir() {
        return Err(io::Error::other("is no folder"));
    }
    if found.uid() != rustix::process::getuid().as_raw() {
        return Err(io::Error::other(format!("belongs to user {}", found.uid())));
    }
    if found.mode() & 0o022 != 0 {
        return Err(io::Error::other("others may write to it"));
    }
    Ok(())
}

/// The lock of a running stack.
#[derive(Debug)]
pub struct StackLock {
    file: File,
    path: PathBuf,
}

impl StackLock {
    /// Takes the lock in the user's folder.
    pub fn take(state: &RunningStack) -> Result<Self, LockError> {
        Self::take_in(&folder(), state)
    }

    fn take_in(folder: &Path, state: &RunningStack) -> Result<Self, LockError> {
        prepare(folder).map_err(|source| LockError::Folder { path: folder.to_owned(), source })?;
        let path = folder.join(format!("{}.json", state.stack));
        let fail = |source| LockError::File { path: path.clone(), source };
        let begin = Instant::now();
        loop {
            let mut file = OpenOptions::new()
                .read(true)
                .write(true)
                .create(true)
                .truncate(false)
                .mode(0o600)
                .custom_flags(libc::O_NOFOLLOW)
                .open(&path)
                .map_err(fail)?;
            match rustix::fs::flock(&file, FlockOperation::NonBlockingLockExclusive) {
                Ok(()) => {}
                Err(rustix::io::Errno::WOULDBLOCK) if begin.elapsed() > LOCK_PATIENCE => {
                    let pid = read_state(&mut file).map_or(0, |s| s.pid);
                    return Err(LockError::Running { stack: state.stack.clone(), pid });
                }
                Err(rustix::io::Errno::WOULDBLOCK) => {
                    std::thread::sleep(Duration::from_millis(20));
                    continue;
                }
                Err(e) => return Err(fail(e.into())),
            }
            // The last holder may have removed the file between our open and our lock: then ours is another one.
            let ours = file.metadata().map_err(fail)?.ino();
            if std::fs::metadata(&path).map(|m| m.ino()).ok() != Some(ours) {
                continue;
            }
            let text = serde_json::to_vec(state).map_err(|e| fail(io::Error::other(e)))?;
            file.set_len(0).map_err(fail)?;
            file.rewind().map_err(fail)?;
            file.write_all(&text).map_err(fail)?;
            return Ok(Self { file, path });
        }
    }
}

impl Drop for StackLock {
    fn drop(&mut self) {
        // Removed while the lock is held: whoever waits for it notices and makes a new file.
        let _ = std::fs::remove_file(&self.path);
        let _ = rustix::fs::flock(&self.file, FlockOperation::Unlock);
    }
}

fn read_state(file: &mut File) -> Option<RunningStack> {
    let mut text = String::new();
    file.take(64 * 1024).read_to_string(&mut text).ok()?;
    serde_json::from_str(&text).ok()
}

/// What the files of the user's folder say.
fn known() -> impl Iterator<Item = RunningStack> {
    std::fs::read_dir(folder())
        .into_iter()
        .flatten()
        .flatten()
        .filter(|entry| entry.path().extension().is_some_and(|e| e == "json"))
        .filter_map(|entry| read_state(&mut File::open(entry.path()).ok()?))
}

/// The stacks of this user whose launcher answers. Stale files of killed launchers are passed over.
pub fn running() -> Vec<RunningStack> {
    let mut list: Vec<RunningStack> = known().filter(|state| answers(&state.root)).collect();
    list.sort_by(|a, b| a.stack.cmp(&b.stack));
    list
}

/// Stacks of this user whose launcher was killed: nobody has stopped them.
pub fn left_behind() -> Vec<RunningStack> {
    known().filter(|state| !answers(&state.root)).collect()
}

/// Whether a launcher listens in this root.
pub fn answers(root: &Path) -> bool {
    UnixStream::connect(root.join(SOCKET)).is_ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn state(stack: &str) -> RunningStack {
        RunningStack {
            stack: stack.into(),
            pid: 42,
            root: "/nowhere".into(),
            since_utc_ns: 1,
            file: "x.toml".into(),
        }
    }

    fn scratch(name: &str) -> PathBuf {
        let folder = std::env::temp_dir().join(format!("dinrail-state-{}-{name}", std::process::id()));
        let _ = std::fs::remove_dir_all(&folder);
        folder
    }

    #[test]
    fn a_second_launcher_is_told_who_runs_the_stack_and_the_file_goes_with_the_lock() {
        let folder = scratch("lock");
        let lock = StackLock::take_in(&folder, &state("a")).unwrap();
        let refused = StackLock::take_in(&folder, &state("a")).unwrap_err();
        assert!(refused.to_string().starts_with("stack 'a' is already running, pid 42;"), "{refused}");
        let other = StackLock::take_in(&folder, &state("b")).unwrap();
        drop((lock, other));
        assert_eq!(std::fs::read_dir(&folder).unwrap().count(), 0);
        StackLock::take_in(&folder, &state("a")).unwrap();
        std::fs::remove_dir_all(&folder).unwrap();
    }

    #[test]
    fn a_file_left_by_a_killed_launcher_is_no_obstacle() {
        let folder = scratch("stale");
        prepare(&folder).unwrap();
        std::fs::write(folder.join("a.json"), "{half").unwrap();
        StackLock::take_in(&folder, &state("a")).unwrap();
        std::fs::remove_dir_all(&folder).unwrap();
    }

    #[test]
    fn a_folder_that_others_may_write_to_is_refused() {
        use std::os::unix::fs::PermissionsExt;
        let folder = scratch("open");
        std::fs::create_dir(&folder).unwrap();
        std::fs::set_permissions(&folder, std::fs::Permissions::from_mode(0o777)).unwrap();
        let refused = StackLock::take_in(&folder, &state("a")).unwrap_err();
        assert!(refused.to_string().contains("others may write to it"), "{refused}");
        std::fs::remove_dir_all(&folder).unwrap();
    }
}
