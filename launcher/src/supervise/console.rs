//! The foreground of `up`: a thread of its own writes to stdout and stderr, so that a terminal that does not take
//! output (Ctrl-S, a full pipe) never stops supervision. What it cannot take is dropped and counted.

use std::io::Write;
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Lines that may wait.
const QUEUE: usize = 4096;

enum Text {
    Out(String),
    Err(String),
}

/// The way to the terminal.
pub struct Console {
    queue: Option<SyncSender<Text>>,
    thread: Option<JoinHandle<()>>,
    done: Receiver<()>,
    dropped: u64,
}

impl Console {
    pub fn start() -> std::io::Result<Self> {
        let (queue, texts) = sync_channel(QUEUE);
        let (finished, done) = sync_channel(1);
        let thread = std::thread::Builder::new().name("console".into()).spawn(move || {
            write_all(&texts);
            let _ = finished.send(());
        })?;
        Ok(Self { queue: Some(queue), thread: Some(thread), done, dropped: 0 })
    }

    /// A result, on stdout.
    pub fn out(&mut self, line: impl Into<String>) {
        self.push(Text::Out(line.into()));
    }

    /// A diagnostic or log line, on stderr.
    pub fn err(&mut self, line: impl Into<String>) {
        self.push(Text::Err(line.into()));
    }

    fn push(&mut self, text: Text) {
        if let Some(queue) = &self.queue
            && queue.try_send(text).is_err()
        {
            self.dropped += 1;
        }
    }

    /// Lines that the terminal did not take.
    pub fn dropped(&self) -> u64 {
        self.dropped
    }

    /// Writes what waits, as long as the terminal takes it within `limit`.
    pub fn finish(mut self, limit: Duration) {
        drop(self.queue.take());
        let begin = Instant::now();
        match self.done.recv_timeout(limit.saturating_sub(begin.elapsed())) {
            Ok(()) | Err(RecvTimeoutError::Disconnected) => {
                if let Some(thread) = self.thread.take() {
                    let _ = thread.join();
                }
            }
            // The terminal blocks: the process ends without it.
            Err(RecvTimeoutError::Timeout) => {}
        }
    }
}

fn write_all(texts: &Receiver<Text>) {
    while let Ok(text) = texts.recv() {
        let failed = match text {
            Text::Out(line) => writeln!(std::io::stdout(), "{line}").is_err(),
            Text::Err(line) => writeln!(std::io::stderr(), "{line}").is_err(),
        };
        if failed {
            // Nobody reads this stream any more; the other one may still be read.
            continue;
        }
    }
}
