//! Descriptors on the event loop. With [`crate::sys`] the only module of this crate with `unsafe`.
#![allow(unsafe_code)]

use std::io;
use std::os::fd::OwnedFd;

use tokio::io::Interest;
use tokio::io::unix::AsyncFd;

/// Watches a descriptor for reading. Needs a tokio runtime; the descriptor must be non-blocking or never be read
/// before it is readable.
pub fn readable(fd: OwnedFd) -> io::Result<AsyncFd<OwnedFd>> {
    // SAFETY: an `OwnedFd` is open, belongs to nobody else, always returns the same number, and closes only when
    // the `AsyncFd` that owns it from here on has taken it out of the event loop.
    unsafe { AsyncFd::register_with_interest(fd, Interest::READABLE) }.map_err(io::Error::from)
}

/// Watches a descriptor for reading and writing; else as [`readable`].
pub fn both(fd: OwnedFd) -> io::Result<AsyncFd<OwnedFd>> {
    // SAFETY: as in `readable`.
    unsafe { AsyncFd::register_with_interest(fd, Interest::READABLE | Interest::WRITABLE) }
        .map_err(io::Error::from)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pipe_becomes_readable_when_its_other_end_closes() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(async {
            let (reader, writer) = rustix::pipe::pipe().unwrap();
            let reader = readable(reader).unwrap();
            drop(writer);
            reader.readable().await.unwrap().retain_ready();
            assert_eq!(rustix::io::read(reader.get_ref(), &mut [0u8; 1]).unwrap(), 0);
        });
    }
}
