//! What the operating system offers only through raw calls: the scheduler, inherited descriptors, and the allocator's
//! thresholds.
//!
//! The only module of the launcher with `unsafe`.
#![allow(unsafe_code)]

use std::io;
use std::os::fd::{FromRawFd, OwnedFd, RawFd};

/// Puts the calling thread under SCHED_FIFO; threads and processes that it starts later inherit it. Priority 1 to 99.
pub fn set_fifo(priority: u32) -> io::Result<()> {
    let param = libc::sched_param { sched_priority: priority as i32 };
    // SAFETY: 0 names the calling thread; the pointer is to a live local that the kernel only reads.
    if unsafe { libc::sched_setscheduler(0, libc::SCHED_FIFO | libc::SCHED_RESET_ON_FORK, &raw const param) }
        == 0
    {
        Ok(())
    } else {
        Err(io::Error::last_os_error())
    }
}

/// Whether this user may use [`set_fifo`]. Asked on a thread that ends: the calling thread, and what it starts later,
/// stay as they are.
pub fn may_fifo(priority: u32) -> bool {
    std::thread::spawn(move || set_fifo(priority).is_ok()).join().unwrap_or(false)
}

/// Takes over a descriptor that the parent process passed by number.
///
/// Refuses 0-2 and numbers that are not open. Each number may be taken once in the life of a process, before
/// anything else opens descriptors: the caller is the very beginning of `__service`.
pub fn take_inherited(number: RawFd) -> io::Result<OwnedFd> {
    if number <= 2 {
        return Err(io::Error::new(io::ErrorKind::InvalidInput, "0, 1 and 2 are standard streams"));
    }
    // SAFETY: F_GETFD and F_SETFD touch no memory; an invalid number is answered with EBADF.
    let flags = unsafe { libc::fcntl(number, libc::F_GETFD) };
    if flags < 0 {
        return Err(io::Error::last_os_error());
    }
    // SAFETY: as above.
    if unsafe { libc::fcntl(number, libc::F_SETFD, flags | libc::FD_CLOEXEC) } < 0 {
        return Err(io::Error::last_os_error());
    }
    // SAFETY: open (checked above), and by the contract above nobody else in this process owns it.
    Ok(unsafe { OwnedFd::from_raw_fd(number) })
}

/// Keeps large buffers out of the heap. glibc would take them from it as soon as the first one was freed, and the pages
/// that such buffers touched at ever new places stay with the process: a recorder grew by 35 KiB a file. To be called
/// before anything large is freed.
pub fn give_large_memory_back() {
    #[cfg(target_env = "gnu")]
    // SAFETY: mallopt takes two numbers and touches the allocator's own settings only.
    unsafe {
        // Fixed where glibc begins: allocations from here on come from the system whole and go back to it whole.
        libc::mallopt(libc::M_MMAP_THRESHOLD, 128 * 1024);
    }
}

/// Makes deaths of children known: a starter that ignores SIGCHLD hands that down, and then the system throws away how a
/// process ended.
pub fn hear_of_children() {
    // SAFETY: sets the default action of one signal; no handler of ours is involved.
    unsafe {
        libc::signal(libc::SIGCHLD, libc::SIG_DFL);
    }
}

/// Lets no descriptor that the launcher's starter left open reach a service. Since Linux 5.11; older ones pass them
/// on, which does no harm but keep a pipe open.
pub fn keep_descriptors_private() {
    // SAFETY: the call changes a flag of descriptors and touches no memory.
    unsafe {
        libc::close_range(3, libc::c_uint::MAX, libc::CLOSE_RANGE_CLOEXEC as libc::c_int);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::fd::{AsRawFd, IntoRawFd};

    #[test]
    fn an_inherited_descriptor_is_taken_and_closed_on_exec_again() {
        let (reader, writer) = rustix::pipe::pipe().unwrap();
        rustix::io::fcntl_setfd(&reader, rustix::io::FdFlags::empty()).unwrap();
        let number = reader.into_raw_fd();
        let taken = take_inherited(number).unwrap();
        assert_eq!(taken.as_raw_fd(), number);
        assert!(rustix::io::fcntl_getfd(&taken).unwrap().contains(rustix::io::FdFlags::CLOEXEC));
        rustix::io::write(&writer, b"x").unwrap();
        let mut byte = [0u8; 1];
        assert_eq!(rustix::io::read(&taken, &mut byte).unwrap(), 1);
    }

    #[test]
    fn standard_streams_and_closed_numbers_are_refused() {
        for number in [-1, 0, 1, 2, 1_000_000] {
            assert!(take_inherited(number).is_err(), "{number}");
        }
    }

    #[test]
    fn helper_threads_are_not_under_fifo() {
        // SAFETY: asks for a number of the calling thread.
        let policy = || unsafe { libc::sched_getscheduler(0) };
        let worker = std::thread::spawn(move || match set_fifo(1) {
            Ok(()) => Some((policy(), std::thread::spawn(policy).join().unwrap())),
            Err(e) => {
                eprintln!("skipped: {e}");
                None
            }
        });
        if let Some((own, helper)) = worker.join().unwrap() {
            assert_eq!((own, helper), (libc::SCHED_FIFO | libc::SCHED_RESET_ON_FORK, libc::SCHED_OTHER));
        }
    }

    #[test]
    fn a_priority_outside_the_range_is_refused() {
        assert!(set_fifo(1000).is_err());
    }
}
