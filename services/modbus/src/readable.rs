//! Waiting for an owned descriptor on tokio.
#![allow(unsafe_code)]

use std::io;
use std::os::fd::OwnedFd;
use tokio::io::unix::AsyncFd;

/// Makes a descriptor one that [`AsyncFd::readable`] waits for.
pub fn watch(fd: OwnedFd) -> io::Result<AsyncFd<OwnedFd>> {
    // SAFETY: `register` asks that the number stays valid and open as long as the AsyncFd lives. The AsyncFd
    // owns the descriptor, and an OwnedFd never changes or closes its number before it is dropped.
    let registered = unsafe { AsyncFd::register(fd) };
    registered.map_err(io::Error::from)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_written_pipe_becomes_readable() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_io().build().unwrap();
        runtime.block_on(async {
            let (read, write) = rustix::pipe::pipe().unwrap();
            let watched = watch(read).unwrap();
            rustix::io::write(&write, b"x").unwrap();
            let _ready = watched.readable().await.unwrap();
        });
    }
}
