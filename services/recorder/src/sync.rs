//! fdatasync once a second, on a thread of its own: it can take long, and nobody waits for it.

use std::fs::File;
use std::io;
use std::path::PathBuf;
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
    let mut due = Instant::now() + PERIOD;
    loop {
        match inbox.recv_timeout(due.saturating_duration_since(Instant::now())) {
            Ok(Command::Current(path, file)) => current = Some((path, file)),
            Ok(Command::Finished(path, file)) => {
                current = current.filter(|(p, _)| *p != path);
                if let Err(e) = file.sync_all() {
                    failed(path, e);
                }
            }
            Err(RecvTimeoutError::Timeout) => {
                if let Some((path, file)) = &current
                    && let Err(e) = file.sync_data()
                {
                    failed(path.clone(), e);
                    current = None;
                }
                due = Instant::now() + PERIOD;
            }
            Err(RecvTimeoutError::Disconnected) => return,
        }
    }
}
