//! What neither std nor rustix offers of serial ports: any rate, RS-485, line errors, low latency.
#![allow(unsafe_code)]

use std::io;
use std::os::fd::{AsRawFd, BorrowedFd};

use serde::{Deserialize, Serialize};

/// Parity bit.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Parity {
    /// No parity bit.
    None,
    /// Even number of ones.
    Even,
    /// Odd number of ones.
    Odd,
    /// Always 1.
    Mark,
    /// Always 0.
    Space,
}

/// Flow control.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Flow {
    /// None.
    #[default]
    None,
    /// By the lines RTS and CTS.
    Rtscts,
    /// By the characters XON and XOFF.
    Xonxoff,
}

/// Rate and shape of characters.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Character {
    /// Bit/s.
    pub baud: u32,
    /// 5 to 8.
    pub data_bits: u8,
    /// Parity bit.
    pub parity: Parity,
    /// 1 or 2.
    pub stop_bits: u8,
    /// Flow control.
    pub flow: Flow,
}

impl Character {
    /// Bits of a character on the line, start, parity and stop bits included.
    pub fn bits(&self) -> u32 {
        1 + u32::from(self.data_bits) + u32::from(self.parity != Parity::None) + u32::from(self.stop_bits)
    }
}

impl std::fmt::Display for Character {
    /// `19200 8E1`
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let parity = match self.parity {
            Parity::None => 'N',
            Parity::Even => 'E',
            Parity::Odd => 'O',
            Parity::Mark => 'M',
            Parity::Space => 'S',
        };
        write!(f, "{} {}{parity}{}", self.baud, self.data_bits, self.stop_bits)
    }
}

fn check(result: libc::c_int) -> io::Result<()> {
    if result < 0 { Err(io::Error::last_os_error()) } else { Ok(()) }
}

fn get(fd: BorrowedFd<'_>) -> io::Result<libc::termios2> {
    // SAFETY: termios2 is plain data that TCGETS2 fills in; the descriptor is open for the borrow.
    unsafe {
        let mut settings: libc::termios2 = std::mem::zeroed();
        check(libc::ioctl(fd.as_raw_fd(), libc::TCGETS2, &raw mut settings))?;
        Ok(settings)
    }
}

const INPUT_FLAGS: libc::tcflag_t = libc::IGNBRK
    | libc::BRKINT
    | libc::IGNPAR
    | libc::PARMRK
    | libc::INPCK
    | libc::ISTRIP
    | libc::INLCR
    | libc::IGNCR
    | libc::ICRNL
    | libc::IXON
    | libc::IXOFF
    | libc::IXANY;

fn control_flags(c: &Character) -> libc::tcflag_t {
    let size = match c.data_bits {
        5 => libc::CS5,
        6 => libc::CS6,
        7 => libc::CS7,
        _ => libc::CS8,
    };
    let parity = match c.parity {
        Parity::None => 0,
        Parity::Even => libc::PARENB,
        Parity::Odd => libc::PARENB | libc::PARODD,
        Parity::Mark => libc::PARENB | libc::PARODD | libc::CMSPAR,
        Parity::Space => libc::PARENB | libc::CMSPAR,
    };
    let stop = if c.stop_bits == 2 { libc::CSTOPB } else { 0 };
    let flow = if c.flow == Flow::Rtscts { libc::CRTSCTS } else { 0 };
    size | parity | stop | flow
}

const SHAPE: libc::tcflag_t =
    libc::CSIZE | libc::PARENB | libc::PARODD | libc::CMSPAR | libc::CSTOPB | libc::CRTSCTS;

/// Makes a terminal a plain pipe of bytes of this character. `mark` asks for marks before damaged bytes (PARMRK).
pub fn configure(fd: BorrowedFd<'_>, c: &Character, mark: bool) -> io::Result<()> {
    let mut t = get(fd)?;
    t.c_iflag &= !INPUT_FLAGS;
    if mark {
        t.c_iflag |= libc::PARMRK | libc::INPCK;
    }
    if c.flow == Flow::Xonxoff {
        t.c_iflag |= libc::IXON | libc::IXOFF;
    }
    t.c_oflag &= !libc::OPOST;
    t.c_lflag &= !(libc::ECHO | libc::ECHONL | libc::ICANON | libc::ISIG | libc::IEXTEN);
    t.c_cflag &= !(SHAPE | libc::CBAUD | (libc::CBAUD << 16));
    t.c_cflag |= control_flags(c) | libc::BOTHER | libc::CLOCAL | libc::CREAD;
    t.c_cflag &= !libc::HUPCL;
    t.c_ispeed = c.baud;
    t.c_ospeed = c.baud;
    t.c_cc[libc::VMIN] = 1;
    t.c_cc[libc::VTIME] = 0;
    // SAFETY: the settings live during the call; the descriptor is open for the borrow.
    unsafe { check(libc::ioctl(fd.as_raw_fd(), libc::TCSETS2, &raw const t)) }
}

/// What the port has taken otherwise than asked, e.g. `data_bits`. The rate may be off by 2 %: more than that no
/// receiver follows.
pub fn differences(fd: BorrowedFd<'_>, c: &Character) -> io::Result<Vec<&'static str>> {
    let t = get(fd)?;
    let wanted = control_flags(c);
    let mut different = Vec::new();
    let mut compare = |mask: libc::tcflag_t, key| {
        if (t.c_cflag ^ wanted) & mask != 0 {
            different.push(key);
        }
    };
    compare(libc::CSIZE, "data_bits");
    compare(libc::PARENB | libc::PARODD | libc::CMSPAR, "parity");
    compare(libc::CSTOPB, "stop_bits");
    compare(libc::CRTSCTS, "flow");
    if u64::from(t.c_ospeed.abs_diff(c.baud)) * 50 > u64::from(c.baud) {
        different.push("baud");
    }
    Ok(different)
}

/// Nobody else may open the terminal from now on (except root).
pub fn exclusive(fd: BorrowedFd<'_>) -> io::Result<()> {
    // SAFETY: TIOCEXCL takes no argument; the descriptor is open for the borrow.
    unsafe { check(libc::ioctl(fd.as_raw_fd(), libc::TIOCEXCL)) }
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

/// Asks the driver to hand over every byte at once, and to close without waiting.
pub fn low_latency(fd: BorrowedFd<'_>) -> io::Result<()> {
    // SAFETY: an all-zero SerialStruct is valid; it has the kernel's layout and lives during the calls; the pointer in
    // it is only handed back as the kernel gave it.
    unsafe {
        let mut serial: SerialStruct = std::mem::zeroed();
        check(libc::ioctl(fd.as_raw_fd(), libc::TIOCGSERIAL, &raw mut serial))?;
        serial.flags |= ASYNC_LOW_LATENCY;
        serial.closing_wait = CLOSING_WAIT_NONE;
        check(libc::ioctl(fd.as_raw_fd(), libc::TIOCSSERIAL, &raw const serial))
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

/// Sets the line RTS.
pub fn set_rts(fd: BorrowedFd<'_>, on: bool) -> io::Result<()> {
    let bits: libc::c_int = libc::TIOCM_RTS;
    let request = if on { libc::TIOCMBIS } else { libc::TIOCMBIC };
    // SAFETY: one int, alive during the call; the descriptor is open for the borrow.
    unsafe { check(libc::ioctl(fd.as_raw_fd(), request, &raw const bits)) }
}

/// Whether everything has been sent, as far as the driver knows: its queue is empty, and so is the transmitter.
pub fn is_drained(fd: BorrowedFd<'_>) -> io::Result<bool> {
    const TEMT: libc::c_int = 1;
    let (mut queued, mut lsr): (libc::c_int, libc::c_int) = (0, TEMT);
    // SAFETY: one int each, alive during the calls; the descriptor is open for the borrow.
    unsafe {
        check(libc::ioctl(fd.as_raw_fd(), libc::TIOCOUTQ, &raw mut queued))?;
        if queued == 0 && libc::ioctl(fd.as_raw_fd(), libc::TIOCSERGETLSR, &raw mut lsr) < 0 {
            // The driver cannot say: the time that the bytes take has been waited for anyway.
            return Ok(true);
        }
    }
    Ok(queued == 0 && lsr & TEMT != 0)
}

/// Throws away what has not been read (`input`) or sent (`output`).
pub fn flush(fd: BorrowedFd<'_>, input: bool, output: bool) {
    let which = match (input, output) {
        (true, true) => libc::TCIOFLUSH,
        (true, false) => libc::TCIFLUSH,
        (false, true) => libc::TCOFLUSH,
        (false, false) => return,
    };
    // SAFETY: takes a number; the descriptor is open for the borrow.
    unsafe { libc::ioctl(fd.as_raw_fd(), libc::TCFLSH, which) };
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
    use std::os::fd::AsFd;

    fn pty() -> (rustix::fd::OwnedFd, std::fs::File) {
        use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
        let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).unwrap();
        grantpt(&master).unwrap();
        unlockpt(&master).unwrap();
        let name = ptsname(&master, Vec::new()).unwrap();
        let slave = std::fs::OpenOptions::new().read(true).write(true).open(name.to_str().unwrap()).unwrap();
        (master, slave)
    }

    #[test]
    fn a_terminal_becomes_a_pipe_of_any_rate() {
        let (master, slave) = pty();
        let c =
            Character { baud: 12_345, data_bits: 7, parity: Parity::Even, stop_bits: 2, flow: Flow::None };
        configure(slave.as_fd(), &c, false).unwrap();
        // A pseudo-terminal has eight bits and no parity, whatever is asked; the rate it keeps.
        assert_eq!(differences(slave.as_fd(), &c).unwrap(), ["data_bits", "parity"]);
        assert_eq!(get(slave.as_fd()).unwrap().c_ospeed, 12_345);
        exclusive(slave.as_fd()).unwrap();
        rustix::io::write(&master, b"a\r\x03\xFF\n").unwrap();
        let mut bytes = [0; 16];
        let n = rustix::io::read(&slave, &mut bytes).unwrap();
        assert_eq!(&bytes[..n], b"a\r\x03\xFF\n");
        assert!(is_drained(slave.as_fd()).unwrap());
        assert_eq!(c.to_string(), "12345 7E2");
        assert_eq!(c.bits(), 11);
    }

    #[test]
    fn what_a_terminal_lacks_is_an_error() {
        let (_master, slave) = pty();
        let all = [
            line_counters(slave.as_fd()).err(),
            low_latency(slave.as_fd()).err(),
            set_rs485(slave.as_fd(), None).err(),
            rs485_enabled(slave.as_fd()).err(),
        ];
        for error in all {
            let code = error.and_then(|e| e.raw_os_error());
            assert!(matches!(code, Some(libc::ENOTTY | libc::EINVAL)), "{code:?}");
        }
        let (pipe, _) = rustix::pipe::pipe().unwrap();
        let c = Character { baud: 9600, data_bits: 8, parity: Parity::None, stop_bits: 1, flow: Flow::None };
        assert!(configure(pipe.as_fd(), &c, true).is_err());
        assert!(set_rts(pipe.as_fd(), true).is_err() && is_drained(pipe.as_fd()).is_err());
    }

    #[test]
    fn realtime_is_tried() {
        // Permitted or not, a second call says the same.
        std::thread::spawn(|| assert_eq!(realtime(1), realtime(1))).join().unwrap();
    }
}
