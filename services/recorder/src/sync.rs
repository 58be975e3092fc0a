//! fdatasync once a second, on a thread of its own: it can take long, and nobody waits for it. A file that was begun is
//! taken to the medium with its name.

use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

const PERIOD: Duration = Duration::from_secs(1);

pub(crate) enum Command {
    /// This is the current file from now on.
    Current(PathBuf, Arc<File>),
    /// This file is finished: once more, then no longer.
    Finished(PathBuf, Arc<File>),
    /// This file was deleted: no more.
    Gone(PathBuf),
}

/// The thread's other end. Dropping it ends the thread after what was asked for is done.
pub(crate) struct Syncer {
    pub(crate) commands: Sender<Command>,
    pub(crate) thread: JoinHandle<()>,
}

impl Syncer {
    /// `failed` is called from the thread with the file and the error, once per file.
    pub(crate) fn start(failed: impl Fn(PathBuf, io::Error) + Send + 'static) -> io::Result<Self> {
        let (commands, inbox) = channel();
        let thread =
            std::thread::Builder::new().name("rec-sync".into()).spawn(move || run(&inbox, &failed))?;
        Ok(Self { commands, thread })
    }
}

fn run(inbox: &Receiver<Command>, failed: &impl Fn(PathBuf, io::Error)) {
    let mut current: Option<(PathBuf, Arc<File>)> = None;
    // Told once a file; tried again all the same.
    let mut told = false;
    let mut due = Instant::now() + PERIOD;
    loop {
        match inbox.recv_timeout(due.saturating_duration_since(Instant::now())) {
            Ok(Command::Current(path, file)) => {
                // A file is only on the medium when its name is.
                if let Err(e) = sync_folder(&path) {
                    failed(path.clone(), e);
                }
                current = Some((path, file));
                told = false;
            }
            Ok(Command::Gone(path)) => current = current.filter(|(p, _)| *p != path),
            Ok(Command::Finished(path, file)) => {
                current = current.filter(|(p, _)| *p != path);
                if let Err(e) = file.sync_all() {
                    failed(path, e);
                }
            }
            Err(RecvTimeoutError::Timeout) => {
                if let Some((path, file)) = &current
                    && let Err(e) = file.sync_data()
                    && !std::mem::replace(&mut told, true)
                {
                    failed(path.clone(), e);
                }
                due = Instant::now() + PERIOD;
            }
            Err(RecvTimeoutError::Disconnected) => return,
        }
    }
}

/// Takes the folder of a file to the medium: what is in it, not what is in the files.
pub(crate) fn sync_folder(file: &Path) -> io::Result<()> {
    match File::open(file.parent().unwrap_or(Path::new(".")))?.sync_all() {
        // Some file systems cannot.
        Err(e) if matches!(e.kind(), io::ErrorKind::InvalidInput | io::ErrorKind::Unsupported) => Ok(()),
        result => result,
    }
}
