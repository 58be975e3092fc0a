//! What neither `serialport` nor rustix offers of serial ports: RS-485, line errors, low latency. The only module of this
//! crate with `unsafe`.
#![allow(unsafe_code)]

use std::io;
use std::os::fd::{AsRawFd, BorrowedFd, FromRawFd, IntoRawFd, OwnedFd};

use serialport::TTYPort;

fn check(result: libc::c_int) -> io::Result<()> {
    if result < 0 { Err(io::Error::last_os_error()) } else { Ok(()) }
}

/// Counters of a UART since the system started (`struct serial_icounter_struct`).
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct LineCounters {
    cts: i32,
    dsr: i32,
    rng: i32,
    dcd: i32,
    rx: i32,
    tx: i32,
    /// Framing errors.
    pub frame: i32,
    /// Bytes lost in the UART.
    pub overrun: i32,
    /// Parity errors.
    pub parity: i32,
    /// Breaks.
    pub brk: i32,
    /// Bytes lost in the driver's buffer.
    pub buf_overrun: i32,
    reserved: [i32; 9],
}

/// The UART's counters; an error where there are none (pseudo-terminals, some adapters).
pub fn line_counters(fd: BorrowedFd<'_>) -> io::Result<LineCounters> {
    let mut counters = LineCounters::default();
    // SAFETY: the struct has the kernel's layout and lives during the call; the descriptor is open for the borrow.
    unsafe { check(libc::ioctl(fd.as_raw_fd(), libc::TIOCGICOUNT, &raw mut counters))? };
    Ok(counters)
}

/// `struct serial_struct` of the kernel.
#[repr(C)]
struct SerialStruct {
    kind: libc::c_int,
    line: libc::c_int,
    port: libc::c_uint,
    irq: libc::c_int,
    flags: libc::c_int,
    xmit_fifo_size: libc::c_int,
    custom_divisor: libc::c_int,
    baud_base: libc::c_int,
    close_delay: libc::c_ushort,
    io_type: libc::c_char,
    reserved_char: [libc::c_char; 1],
    hub6: libc::c_int,
    closing_wait: libc::c_ushort,
    closing_wait2: libc::c_ushort,
    iomem_base: *mut libc::c_uchar,
    iomem_reg_shift: libc::c_ushort,
    port_high: libc::c_uint,
    iomap_base: libc::c_ulong,
}

const ASYNC_LOW_LATENCY: libc::c_int = 1 << 13;
/// Closing does not wait for bytes that nobody takes.
const CLOSING_WAIT_NONE: libc::c_ushort = 65_535;

/// Asks the driver to hand over every byte at once, and, where that is permitted, to close without waiting.
pub fn low_latency(fd: BorrowedFd<'_>) -> io::Result<()> {
    // SAFETY: an all-zero SerialStruct is valid; it has the kernel's layout and lives during the calls; the pointer in
    // it is only handed back as the kernel gave it.
    unsafe {
        let mut serial: SerialStruct = std::mem::zeroed();
        check(libc::ioctl(fd.as_raw_fd(), libc::TIOCGSERIAL, &raw mut serial))?;
        serial.flags |= ASYNC_LOW_LATENCY;
        check(libc::ioctl(fd.as_raw_fd(), libc::TIOCSSERIAL, &raw const serial))?;
        // By itself: only an administrator may, and the kernel refuses all of a call for a part of it.
        serial.closing_wait = CLOSING_WAIT_NONE;
        let _ = libc::ioctl(fd.as_raw_fd(), libc::TIOCSSERIAL, &raw const serial);
        Ok(())
    }
}

/// How the kernel switches an RS-485 transmitter.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Rs485 {
    /// RTS is 1 while sending.
    pub rts_on_send: bool,
    /// The receiver stays on while sending.
    pub rx_during_tx: bool,
    /// Pause before the first byte, ms.
    pub delay_before_ms: u32,
    /// Pause after the last byte, ms.
    pub delay_after_ms: u32,
}

/// `struct serial_rs485`: flags, two delays, five words of padding.
type RawRs485 = [u32; 8];
const RS485_ENABLED: u32 = 1;
const RS485_RTS_ON_SEND: u32 = 2;
const RS485_RTS_AFTER_SEND: u32 = 4;
const RS485_RX_DURING_TX: u32 = 16;

/// Switches RS-485 in the kernel on or off. ENOTTY: the driver of this port cannot.
pub fn set_rs485(fd: BorrowedFd<'_>, settings: Option<Rs485>) -> io::Result<()> {
    let mut raw: RawRs485 = [0; 8];
    if let Some(s) = settings {
        raw[0] = RS485_ENABLED
            | if s.rts_on_send { RS485_RTS_ON_SEND } else { RS485_RTS_AFTER_SEND }
            | if s.rx_during_tx { RS485_RX_DURING_TX } else { 0 };
        raw[1] = s.delay_before_ms;
        raw[2] = s.delay_after_ms;
    }
    // SAFETY: 32 bytes as the kernel reads and writes them, alive during the call; the descriptor is open.
    unsafe { check(libc::ioctl(fd.as_raw_fd(), libc::TIOCSRS485, &raw mut raw)) }
}

/// Whether the port's driver has RS-485 switched on; an error where it knows nothing of it.
pub fn rs485_enabled(fd: BorrowedFd<'_>) -> io::Result<bool> {
    let mut raw: RawRs485 = [0; 8];
    // SAFETY: as in [`set_rs485`].
    unsafe { check(libc::ioctl(fd.as_raw_fd(), libc::TIOCGRS485, &raw mut raw))? };
    Ok(raw[0] & RS485_ENABLED != 0)
}

/// Whether the transmitter is empty, as far as the driver can say; where it cannot, the time that the bytes take has been
/// waited for anyway.
pub fn transmitter_is_empty(fd: BorrowedFd<'_>) -> bool {
    const TEMT: libc::c_int = 1;
    let mut lsr: libc::c_int = TEMT;
    // SAFETY: one int, alive during the call; the descriptor is open for the borrow.
    let known = unsafe { libc::ioctl(fd.as_raw_fd(), libc::TIOCSERGETLSR, &raw mut lsr) } >= 0;
    !known || lsr & TEMT != 0
}

/// The descriptor of a port, which `serialport` shows as a mere number.
pub fn descriptor(port: &TTYPort) -> BorrowedFd<'_> {
    // SAFETY: the descriptor is open as long as its port, which the borrow keeps.
    unsafe { BorrowedFd::borrow_raw(port.as_raw_fd()) }
}

/// The descriptor of a port without the port.
pub fn into_descriptor(port: TTYPort) -> OwnedFd {
    // SAFETY: the port gives up its descriptor, which is open and nobody else's.
    unsafe { OwnedFd::from_raw_fd(port.into_raw_fd()) }
}

/// Whether nobody else may open the terminal (TIOCGEXCL).
#[cfg(test)]
pub fn is_exclusive(fd: BorrowedFd<'_>) -> bool {
    let mut on: libc::c_int = 0;
    // SAFETY: one int, alive during the call; the descriptor is open for the borrow.
    unsafe { check(libc::ioctl(fd.as_raw_fd(), libc::TIOCGEXCL, &raw mut on)).unwrap() };
    on != 0
}

/// Real-time scheduling (SCHED_FIFO) for this thread, not for those it starts. False where it is not permitted. A
/// thread that is scheduled so already stays as it is.
pub fn realtime(priority: i32) -> bool {
    const RESET_ON_FORK: libc::c_int = 0x4000_0000;
    // SAFETY: sched_param is plain data, alive during the call; 0 is the calling thread.
    unsafe {
        let now = libc::sched_getscheduler(0);
        if now >= 0 && matches!(now & !RESET_ON_FORK, libc::SCHED_FIFO | libc::SCHED_RR) {
            return true;
        }
        let mut param: libc::sched_param = std::mem::zeroed();
        param.sched_priority = priority;
        libc::sched_setscheduler(0, libc::SCHED_FIFO | RESET_ON_FORK, &raw const param) == 0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_terminal_lacks_is_an_error() {
        let (_master, slave) = TTYPort::pair().unwrap();
        let fd = descriptor(&slave);
        let all = [
            line_counters(fd).err(),
            low_latency(fd).err(),
            set_rs485(fd, None).err(),
            rs485_enabled(fd).err(),
        ];
        for error in all {
            let code = error.and_then(|e| e.raw_os_error());
            assert!(matches!(code, Some(libc::ENOTTY | libc::EINVAL)), "{code:?}");
        }
        assert!(transmitter_is_empty(fd));
        let number = fd.as_raw_fd();
        assert_eq!(into_descriptor(slave).as_raw_fd(), number);
    }

    #[test]
    fn realtime_is_tried() {
        // Permitted or not, a second call says the same.
        std::thread::spawn(|| assert_eq!(realtime(1), realtime(1))).join().unwrap();
    }
}
