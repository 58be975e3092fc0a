//! The copy on disk.

use super::{Kept, MEMORY_BYTES, decode_slot, header, newest};
use std::fs::{self, File};
use std::io::{self, Write};
use std::os::fd::OwnedFd;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

/// Time between two looks at the memory.
const PERIOD: Duration = Duration::from_millis(500);

/// What a file holds; `None` when there is none or it is damaged (said in the log).
pub fn read_file(path: &Path) -> Option<Kept> {
    let bytes = match fs::read(path) {
        Ok(bytes) => bytes,
        Err(e) if e.kind() == io::ErrorKind::NotFound => return None,
        Err(e) => {
            tracing::warn!(
                "retain file {} cannot be read: {e}; RETAIN variables start with initial values",
                path.display()
            );
            return None;
        }
    };
    let kept = decode_slot(&bytes);
    if kept.is_none() {
        tracing::warn!(
            "retain file {} is damaged; RETAIN variables start with initial values",
            path.display()
        );
    }
    kept
}

/// Writes whole or not at all: beside it, fsync, rename, fsync of the folder.
fn write_file(path: &Path, kept: &Kept) -> io::Result<()> {
    // The whole name: `keep.1` and `keep.2` of two engines must not share the file beside them.
    let mut aside = path.as_os_str().to_owned();
    aside.push(".new");
    let aside = PathBuf::from(aside);
    let mut file = File::create(&aside)?;
    file.write_all(&header(kept.seq, kept.layout, kept.plc_time_ns, &kept.bytes))?;
    file.write_all(&kept.bytes)?;
    file.sync_all()?;
    fs::rename(&aside, path)?;
    if let Some(folder) = path.parent().filter(|p| !p.as_os_str().is_empty()) {
        File::open(folder)?.sync_all()?;
    }
    Ok(())
}

/// The helper thread. Copies once more when it is dropped.
pub struct DiskCopy {
    stop: Arc<AtomicBool>,
    failures: Arc<AtomicU64>,
    thread: Option<JoinHandle<()>>,
}

impl DiskCopy {
    /// Copies from the descriptor's memory to `path` whenever the data changed.
    pub fn start(fd: OwnedFd, path: PathBuf) -> io::Result<Self> {
        let stop = Arc::new(AtomicBool::new(false));
        let failures = Arc::new(AtomicU64::new(0));
        let (stopped, failed) = (stop.clone(), failures.clone());
        let thread = std::thread::Builder::new()
            .name("retain".to_owned())
            .spawn(move || copy_loop(&fd, &path, &stopped, &failed))?;
        Ok(Self { stop, failures, thread: Some(thread) })
    }

    /// Copies that failed (disk full, folder gone); the memory itself is not affected.
    pub fn failures(&self) -> u64 {
        self.failures.load(Ordering::Relaxed)
    }
}

impl Drop for DiskCopy {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Release);
        if let Some(thread) = self.thread.take() {
            thread.thread().unpark();
            let _ = thread.join();
        }
    }
}

fn copy_loop(fd: &OwnedFd, path: &Path, stop: &AtomicBool, failures: &AtomicU64) {
    let mut memory = vec![0u8; MEMORY_BYTES];
    let mut written: Option<Kept> = None;
    loop {
        let last = stop.load(Ordering::Acquire);
        // A commit may be under way: then one slot is torn, the other one is whole.
        if let Some(kept) = read_memory(fd, &mut memory)
            && written.as_ref().is_none_or(|w| {
                // At the end also for the PLC's time alone, which goes on from there.
                (w.layout, &w.bytes) != (kept.layout, &kept.bytes) || last && w.seq != kept.seq
            })
        {
            match write_file(path, &kept) {
                Ok(()) => written = Some(kept),
                Err(e) => {
                    if failures.fetch_add(1, Ordering::Relaxed).is_multiple_of(120) {
                        tracing::error!("retain file {} cannot be written: {e}", path.display());
                    }
                }
            }
        }
        if last {
            return;
        }
        std::thread::park_timeout(PERIOD);
    }
}

fn read_memory(fd: &OwnedFd, memory: &mut [u8]) -> Option<Kept> {
    let mut at = 0;
    while at < memory.len() {
        match rustix::io::pread(fd, &mut memory[at..], at as u64) {
            Ok(0) | Err(_) => return None,
            Ok(n) => at += n,
        }
    }
    newest(memory)
}
