//! Where the MCAP writer's bytes go: collected, then written at their place in the file.
//!
//! The place is counted here and not by the file's own cursor, because behind the last chunk the open chunk's
//! messages stand raw (see [`crate::file`]) and the next chunk takes their place.

use std::fs::File;
use std::io::{self, Seek, SeekFrom, Write};
use std::os::unix::fs::FileExt;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

/// Bytes collected before they are written: more than a chunk with its index, so that a chunk is one write.
const COLLECTED: usize = 512 * 1024;

pub(crate) struct Sink {
    file: Arc<File>,
    collected: Vec<u8>,
    /// Bytes of the file that are written, which is where `collected` goes.
    written: Arc<AtomicU64>,
}

impl Sink {
    pub(crate) fn new(file: Arc<File>, written: Arc<AtomicU64>) -> Self {
        Self { file, collected: Vec::new(), written }
    }
}

impl Write for Sink {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if self.collected.len() + bytes.len() > COLLECTED {
            self.flush()?;
        }
        if bytes.len() > COLLECTED {
            let at = self.written.load(Ordering::Relaxed);
            self.file.write_all_at(bytes, at)?;
            self.written.store(at + bytes.len() as u64, Ordering::Relaxed);
        } else {
            self.collected.extend_from_slice(bytes);
        }
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        let at = self.written.load(Ordering::Relaxed);
        self.file.write_all_at(&self.collected, at)?;
        self.written.store(at + self.collected.len() as u64, Ordering::Relaxed);
        self.collected.clear();
        Ok(())
    }
}

impl Seek for Sink {
    /// Only tells the position: nothing is ever written behind it.
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        match to {
            SeekFrom::Current(0) => Ok(self.written.load(Ordering::Relaxed) + self.collected.len() as u64),
            _ => Err(io::Error::new(io::ErrorKind::Unsupported, "recordings are written forwards only")),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::TempDir;

    #[test]
    fn bytes_stand_where_they_were_counted() {
        let dir = TempDir::new("sink");
        let path = dir.path().join("f");
        let file = Arc::new(File::options().read(true).write(true).create_new(true).open(&path).unwrap());
        let written = Arc::new(AtomicU64::new(0));
        let mut sink = Sink::new(file.clone(), written.clone());
        sink.write_all(b"abc").unwrap();
        assert_eq!((sink.stream_position().unwrap(), written.load(Ordering::Relaxed)), (3, 0));
        let large = vec![b'x'; COLLECTED + 1];
        sink.write_all(&large).unwrap();
        sink.write_all(b"end").unwrap();
        sink.flush().unwrap();
        // Somebody else's bytes behind the position are overwritten, not appended to.
        file.write_all_at(b"raw", written.load(Ordering::Relaxed)).unwrap();
        sink.write_all(b"CHUNK").unwrap();
        sink.flush().unwrap();
        let text = std::fs::read(&path).unwrap();
        assert_eq!(text.len(), 3 + large.len() + 3 + 5);
        assert!(text.starts_with(b"abcxx") && text.ends_with(b"xendCHUNK"));
        assert!(sink.seek(SeekFrom::Start(0)).is_err());
    }
}
