//! A socketcand client of a few lines: load on a virtual bus, paced or as fast as it takes it.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, JoinHandle, sleep};
use std::time::{Duration, Instant};

pub struct Load {
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<u64>>,
}

impl Load {
    /// Sends 8-byte frames to the server at this port, `rate` a second (0 = unpaced), reconnecting when cut off.
    pub fn start(port: u16, rate: u64) -> Self {
        let stop = Arc::new(AtomicBool::new(false));
        let ended = stop.clone();
        let thread = thread::spawn(move || {
            const BATCH: u64 = 50;
            let frames = "< send 123 8 de ad be ef 1 2 3 4 >".repeat(BATCH as usize);
            let mut sent = 0;
            while !ended.load(Ordering::Relaxed) {
                let Ok(mut stream) = TcpStream::connect(("127.0.0.1", port)) else {
                    sleep(Duration::from_millis(5));
                    continue;
                };
                let _ = stream.write_all(b"< open can0 >");
                let _ = stream.read(&mut [0u8; 64]);
                let _ = stream.write_all(b"< rawmode >");
                let (start, first) = (Instant::now(), sent);
                while !ended.load(Ordering::Relaxed) && stream.write_all(frames.as_bytes()).is_ok() {
                    sent += BATCH;
                    if let Some(due_ns) = ((sent - first) * 1_000_000_000).checked_div(rate) {
                        sleep(Duration::from_nanos(due_ns).saturating_sub(start.elapsed()));
                    }
                }
            }
            sent
        });
        Self { stop, thread: Some(thread) }
    }

    /// Ends it; gives how many frames were handed to the server.
    pub fn end(mut self) -> u64 {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.take().map_or(0, |t| t.join().unwrap_or(0))
    }
}

impl Drop for Load {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
    }
}
