//! The copy on disk.

use super::{Kept, MEMORY_BYTES, SLOT_BYTES, decode_slot, header, newest};
use std::fs::{self, File};
use std::io::{self, Read, Write};
use std::os::fd::OwnedFd;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread::JoinHandle;
use std::time::Duration;

/// Time between two looks at the memory.
const PERIOD: Duration = Duration::from_millis(500);

/// What a file holds; `None` when there is none or it is damaged (said in the log).
///
/// Where the file system does not rename in one step (FAT), a power cut may leave only the new file beside it.
pub fn read_file(path: &Path) -> Option<Kept> {
    let found = read_one(path);
    if let Ok(Some(kept)) = found {
        return Some(kept);
    }
    let aside = beside(path);
    if let Ok(Some(kept)) = read_one(&aside) {
        tracing::warn!(
            "retain file {} is missing or damaged; {} beside it is whole and is used",
            path.display(),
            aside.display()
        );
        return Some(kept);
    }
    if let Err(reason) = found {
        tracing::warn!("retain file {} {reason}; RETAIN variables start with initial values", path.display());
    }
    None
}

fn read_one(path: &Path) -> Result<Option<Kept>, String> {
    let unreadable = |e: io::Error| format!("cannot be read: {e}");
    let file = match File::open(path) {
        Ok(file) => file,
        Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(None),
        Err(e) => return Err(unreadable(e)),
    };
    if !file.metadata().map_err(unreadable)?.is_file() {
        return Err("is no file".to_owned());
    }
    let mut bytes = Vec::new();
    file.take(SLOT_BYTES as u64 + 1).read_to_end(&mut bytes).map_err(unreadable)?;
    decode_slot(&bytes).map(Some).ok_or_else(|| "is damaged".to_owned())
}

/// The whole name: `keep.1` and `keep.2` of two engines must not share the file beside them.
fn beside(path: &Path) -> PathBuf {
    let mut aside = path.as_os_str().to_owned();
    aside.push(".new");
    PathBuf::from(aside)
}

/// Writes whole or not at all: beside it, fsync, rename, fsync of the folder.
fn write_file(path: &Path, kept: &Kept) -> io::Result<()> {
    let aside = beside(path);
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

/// A change for people to hear of, as a sentence.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum CopyNews {
    /// Copies began to fail.
    Failing(String),
    /// Copies succeed again.
    Working(String),
}

/// News that wait to be taken; more changes than that nobody needs to know.
const NEWS_MAX: usize = 4;

/// The helper thread. Copies once more when it is dropped.
pub struct DiskCopy {
    stop: Arc<AtomicBool>,
    failures: Arc<AtomicU64>,
    news: Receiver<CopyNews>,
    thread: Option<JoinHandle<()>>,
}

impl DiskCopy {
    /// Copies from the descriptor's memory to `path` whenever the data changed.
    pub fn start(fd: OwnedFd, path: PathBuf) -> io::Result<Self> {
        let stop = Arc::new(AtomicBool::new(false));
        let failures = Arc::new(AtomicU64::new(0));
        let (stopped, failed) = (stop.clone(), failures.clone());
        let (told, news) = sync_channel(NEWS_MAX);
        let thread = std::thread::Builder::new()
            .name("retain".to_owned())
            .spawn(move || copy_loop(&fd, &path, &stopped, &failed, &told))?;
        Ok(Self { stop, failures, news, thread: Some(thread) })
    }

    /// The next change between failing and working, if there was one.
    pub fn news(&self) -> Option<CopyNews> {
        self.news.try_recv().ok()
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

/// What to do about a copy that failed.
fn remedy(error: &io::Error) -> &'static str {
    match error.kind() {
        io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => "make room there",
        io::ErrorKind::ReadOnlyFilesystem => "mount it writable, or set `retain_file` to another place",
        io::ErrorKind::PermissionDenied => "let this user write there, or set `retain_file` to another place",
        io::ErrorKind::NotFound | io::ErrorKind::NotADirectory => "make its folder, or set `retain_file`",
        _ => "check the disk, or set `retain_file` to another place",
    }
}

fn copy_loop(
    fd: &OwnedFd,
    path: &Path,
    stop: &AtomicBool,
    failures: &AtomicU64,
    news: &SyncSender<CopyNews>,
) {
    let mut memory = vec![0u8; MEMORY_BYTES];
    let mut failing = false;
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
                Ok(()) => {
                    written = Some(kept);
                    if std::mem::take(&mut failing) {
                        let text = format!("RETAIN variables are copied to {} again", path.display());
                        let _ = news.try_send(CopyNews::Working(text));
                    }
                }
                Err(e) => {
                    failures.fetch_add(1, Ordering::Relaxed);
                    let text = format!(
                        "RETAIN variables do not reach the disk: {} cannot be written: {e}; {}. A power failure now loses \
                         what changed since",
                        path.display(),
                        remedy(&e)
                    );
                    // Nobody takes the last news.
                    if last {
                        tracing::error!("{text}");
                    } else if !std::mem::replace(&mut failing, true) {
                        let _ = news.try_send(CopyNews::Failing(text));
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
