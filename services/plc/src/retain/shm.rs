//! The inherited memory, mapped.
#![allow(unsafe_code)]

use rustix::mm::{MapFlags, ProtFlags, mmap, munmap};
use std::io;
use std::os::fd::AsFd;

/// A shared mapping of a descriptor. Only this process writes it.
pub struct Mapping {
    start: *mut u8,
    len: usize,
}

// SAFETY: the mapping is memory like any other and owned by this value alone.
unsafe impl Send for Mapping {}

impl Mapping {
    /// Maps `len` bytes; the descriptor may be closed afterwards.
    pub fn new(fd: impl AsFd, len: usize) -> io::Result<Self> {
        let size = rustix::fs::fstat(&fd)?.st_size;
        if u64::try_from(size).unwrap_or(0) < len as u64 {
            // Touching pages behind the end would be a SIGBUS.
            return Err(io::Error::new(
                io::ErrorKind::InvalidInput,
                format!("{size} bytes, {len} are needed"),
            ));
        }
        // SAFETY: a fresh mapping at an address of the kernel's choice; nothing else refers to it.
        let start = unsafe {
            mmap(std::ptr::null_mut(), len, ProtFlags::READ | ProtFlags::WRITE, MapFlags::SHARED, fd, 0)?
        };
        Ok(Self { start: start.cast(), len })
    }

    pub fn bytes(&self) -> &[u8] {
        // SAFETY: mapped for the life of `self`, `len` bytes; the launcher holds the descriptor but never writes.
        unsafe { std::slice::from_raw_parts(self.start, self.len) }
    }

    pub fn bytes_mut(&mut self) -> &mut [u8] {
        // SAFETY: as above; `&mut self` makes it the only access of this process. The helper thread reads through
        // the descriptor, in the kernel, and checks the checksum.
        unsafe { std::slice::from_raw_parts_mut(self.start, self.len) }
    }
}

impl Drop for Mapping {
    fn drop(&mut self) {
        // SAFETY: mapped by `new`, no borrow outlives `self`.
        let _ = unsafe { munmap(self.start.cast(), self.len) };
    }
}
