//! Opening a serial device or the other end of a pseudo-terminal, and the sentences for whoever cannot.
//!
//! `serialport` opens and sets it; what it lacks is added here. Also for services that want no more than the descriptor,
//! as the SLCAN adapters of the CAN service.

use std::fs::{self, OpenOptions};
use std::io;
use std::os::fd::{BorrowedFd, OwnedFd};
use std::os::unix::fs::{FileTypeExt, MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};

use rustix::fs::OFlags;
use rustix::io::Errno;
use rustix::termios::{OptionalActions, tcgetattr, tcsetattr};
use serialport::{DataBits, ErrorKind, FlowControl, SerialPort, StopBits, TTYPort};

use crate::character::{self, Character, Flow, Parity};
use crate::port::PortError;
use crate::{list, sys};

/// An open device: plain bytes, never waits, closing leaves its lines as they are.
#[derive(Debug)]
pub struct Device {
    port: TTYPort,
    path: PathBuf,
    is_pty: bool,
}

impl Device {
    /// Opens it; `exclusive` for this process alone. May take its time.
    pub fn open(path: &Path, c: &Character, exclusive: bool) -> Result<Self, PortError> {
        let shown = || path.display().to_string();
        let system = |what| move |source: io::Error| PortError::System { path: shown(), what, source };
        let meta = fs::metadata(path).map_err(|source| match source.kind() {
            io::ErrorKind::NotFound => PortError::Absent(shown()),
            io::ErrorKind::PermissionDenied => permission(path),
            _ => system("looking at it")(source),
        })?;
        if !meta.file_type().is_char_device() {
            return Err(PortError::NotSerial(shown()));
        }
        // Refused after opening it, `serialport` (as root) would end the exclusive use of whoever has it.
        if let Some(holder) = list::lock_holder(&meta, exclusive) {
            return Err(busy(path, Some(holder)));
        }
        let port = builder(path, c, exclusive).open_native().map_err(|error| refused(path, error))?;
        let device = Self {
            port,
            path: path.canonicalize().unwrap_or_else(|_| path.to_owned()),
            is_pty: is_pty(meta.rdev()),
        };
        // `serialport` waits for the line before it reads and writes; here nothing may wait.
        rustix::fs::fcntl_setfl(device.fd(), OFlags::NONBLOCK)
            .map_err(|e| system("switching off waiting")(e.into()))?;
        character::complete(device.fd(), c).map_err(system("setting rate and character"))?;
        Ok(device)
    }

    /// Links followed.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Whether it is the end of a pseudo-terminal.
    pub fn is_pty(&self) -> bool {
        self.is_pty
    }

    /// To read and write.
    pub fn fd(&self) -> BorrowedFd<'_> {
        sys::descriptor(&self.port)
    }

    /// Gives the descriptor away.
    pub fn into_fd(self) -> OwnedFd {
        sys::into_descriptor(self.port)
    }

    /// Sets the line RTS.
    pub fn set_rts(&mut self, on: bool) -> io::Result<()> {
        Ok(self.port.write_request_to_send(on)?)
    }

    /// Whether everything has been sent, as far as the driver knows: its queue is empty, and so is the transmitter.
    pub fn is_drained(&self) -> io::Result<bool> {
        Ok(self.port.bytes_to_write()? == 0 && sys::transmitter_is_empty(self.fd()))
    }
}

fn builder(path: &Path, c: &Character, exclusive: bool) -> serialport::SerialPortBuilder {
    let data_bits = match c.data_bits {
        5 => DataBits::Five,
        6 => DataBits::Six,
        7 => DataBits::Seven,
        _ => DataBits::Eight,
    };
    let parity = match c.parity {
        Parity::None => serialport::Parity::None,
        // With CMSPAR, see [`character::complete`], even is space and odd is mark.
        Parity::Even | Parity::Space => serialport::Parity::Even,
        Parity::Odd | Parity::Mark => serialport::Parity::Odd,
    };
    let flow = match c.flow {
        Flow::None => FlowControl::None,
        Flow::Rtscts => FlowControl::Hardware,
        Flow::Xonxoff => FlowControl::Software,
    };
    serialport::new(path.to_string_lossy(), c.baud)
        .data_bits(data_bits)
        .parity(parity)
        .stop_bits(if c.stop_bits == 2 { StopBits::Two } else { StopBits::One })
        .flow_control(flow)
        .exclusive(exclusive)
}

/// Majors 136 to 143 are the ends of pseudo-terminals (Unix 98).
fn is_pty(rdev: u64) -> bool {
    (136..=143).contains(&rustix::fs::major(rdev))
}

fn refused(path: &Path, error: serialport::Error) -> PortError {
    let shown = path.display().to_string();
    match error.kind() {
        ErrorKind::NoDevice => return busy(path, None),
        ErrorKind::Io(io::ErrorKind::PermissionDenied) => return permission(path),
        ErrorKind::Io(io::ErrorKind::NotFound) => return PortError::Absent(shown),
        _ => {}
    }
    // `serialport` keeps no error number: the system is asked for it.
    let what = "opening it";
    match try_again(path) {
        Ok(()) => PortError::System { path: shown, what, source: error.into() },
        Err(source) => match Errno::from_io_error(&source) {
            Some(Errno::NOTTY) => PortError::NotSerial(shown),
            // A port without hardware, an adapter that is being unplugged.
            Some(Errno::NXIO | Errno::NODEV | Errno::IO | Errno::NOENT) => PortError::Absent(shown),
            Some(Errno::BUSY) => busy(path, None),
            Some(Errno::ACCESS | Errno::PERM) => permission(path),
            _ => PortError::System { path: shown, what, source },
        },
    }
}

fn try_again(path: &Path) -> io::Result<()> {
    let flags = OFlags::NOCTTY | OFlags::NONBLOCK;
    let file = OpenOptions::new().read(true).write(true).custom_flags(flags.bits() as i32).open(path)?;
    let settings = tcgetattr(&file)?;
    Ok(tcsetattr(&file, OptionalActions::Now, &settings)?)
}

fn busy(path: &Path, locked: Option<list::Holder>) -> PortError {
    let holders = list::holders(&path.canonicalize().unwrap_or_else(|_| path.to_owned()));
    let me = std::process::id();
    let other = holders.iter().find(|h| h.pid != me).or(locked.as_ref()).or(holders.first());
    PortError::Busy {
        path: path.display().to_string(),
        holder: other.map_or_else(|| "another program".to_owned(), ToString::to_string),
    }
}

/// The group that owns the device is the one to join.
fn permission(path: &Path) -> PortError {
    PortError::Permission { path: path.display().to_string(), remedy: list::permission_remedy(path) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rustix::fs::{FlockOperation, flock};
    use rustix::termios::ioctl_tiocexcl;

    fn pty() -> (OwnedFd, PathBuf) {
        use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
        let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC).unwrap();
        grantpt(&master).unwrap();
        unlockpt(&master).unwrap();
        let name = ptsname(&master, Vec::new()).unwrap();
        (master, PathBuf::from(name.to_str().unwrap()))
    }

    fn c() -> Character {
        Character { baud: 12_345, data_bits: 7, parity: Parity::Even, stop_bits: 2, flow: Flow::None }
    }

    #[test]
    fn a_terminal_becomes_a_pipe_of_any_rate() {
        let (master, path) = pty();
        let mut device = Device::open(&path, &c(), true).unwrap();
        // A pseudo-terminal has eight bits and no parity, whatever is asked; the rate it keeps.
        assert_eq!(character::differences(device.fd(), &c()).unwrap(), ["data_bits", "parity"]);
        assert_eq!(tcgetattr(device.fd()).unwrap().output_speed(), 12_345);
        rustix::io::write(&master, b"a\r\x03\xFF\x11\x13\n").unwrap();
        let mut bytes = [0; 16];
        let n = rustix::io::read(device.fd(), &mut bytes).unwrap();
        assert_eq!(&bytes[..n], b"a\r\x03\xFF\x11\x13\n");
        // And nothing waits.
        assert_eq!(rustix::io::read(device.fd(), &mut bytes), Err(Errno::AGAIN));
        assert!(device.is_drained().unwrap() && device.is_pty());
        assert!(device.set_rts(true).is_err());
        rustix::io::write(device.into_fd(), b"b\n").unwrap();
        let n = rustix::io::read(&master, &mut bytes).unwrap();
        assert_eq!(&bytes[..n], b"b\n");
    }

    #[test]
    fn settings_of_an_earlier_program_are_taken_away() {
        const INPUT: libc::tcflag_t = libc::IGNBRK
            | libc::BRKINT
            | libc::PARMRK
            | libc::ISTRIP
            | libc::INLCR
            | libc::IGNCR
            | libc::ICRNL
            | libc::IXON
            | libc::IXOFF
            | libc::IXANY;
        let (_master, path) = pty();
        let file = OpenOptions::new().read(true).write(true).open(&path).unwrap();
        let mut t = tcgetattr(&file).unwrap();
        t.input_modes |= rustix::termios::InputModes::from_bits_retain(INPUT);
        t.output_modes |= rustix::termios::OutputModes::OPOST;
        t.control_modes |= rustix::termios::ControlModes::CRTSCTS | rustix::termios::ControlModes::HUPCL;
        tcsetattr(&file, OptionalActions::Now, &t).unwrap();
        let device = Device::open(&path, &c(), false).unwrap();
        let t = tcgetattr(device.fd()).unwrap();
        assert_eq!((t.input_modes.bits() & INPUT, t.output_modes.bits() & libc::OPOST), (0, 0));
        assert_eq!(t.control_modes.bits() & (libc::CRTSCTS | libc::HUPCL), 0);
        // Wanted again where RTS switches a transmitter.
        character::drop_lines_on_close(device.fd()).unwrap();
        assert_ne!(tcgetattr(device.fd()).unwrap().control_modes.bits() & libc::HUPCL, 0);
    }

    #[test]
    fn a_refused_program_leaves_the_holder_its_exclusive_use() {
        let (_master, path) = pty();
        let first = Device::open(&path, &c(), true).unwrap();
        assert!(sys::is_exclusive(first.fd()));
        for exclusive in [true, false] {
            assert!(matches!(Device::open(&path, &c(), exclusive), Err(PortError::Busy { .. })));
        }
        assert!(sys::is_exclusive(first.fd()));
        drop(first);
        // Two that share.
        let _one = Device::open(&path, &c(), false).unwrap();
        let _two = Device::open(&path, &c(), false).unwrap();
        assert!(matches!(Device::open(&path, &c(), true), Err(PortError::Busy { .. })));
    }

    #[test]
    fn whoever_has_it_by_lock_or_by_ioctl_is_named() {
        let me = format!("(pid {})", std::process::id());
        let (_master, path) = pty();
        let file = OpenOptions::new().read(true).write(true).open(&path).unwrap();
        flock(&file, FlockOperation::LockExclusive).unwrap();
        let error = Device::open(&path, &c(), true).unwrap_err().to_string();
        assert!(error.contains("in use by") && error.contains(&me), "{error}");
        flock(&file, FlockOperation::Unlock).unwrap();
        ioctl_tiocexcl(&file).unwrap();
        match Device::open(&path, &c(), true) {
            Ok(_) => assert!(rustix::process::geteuid().is_root(), "only root may"),
            Err(error) => assert!(error.to_string().contains(&me), "{error}"),
        }
    }

    #[test]
    fn a_terminal_that_goes_meanwhile() {
        let (master, path) = pty();
        let device = Device::open(&path, &c(), true).unwrap();
        drop(master);
        // Its path is gone; what would open it otherwise says so too.
        assert!(matches!(Device::open(&path, &c(), true), Err(PortError::Absent(_))));
        let gone = serialport::Error::new(ErrorKind::Unknown, "I/O error");
        assert!(matches!(refused(&path, gone), PortError::Absent(_)));
        assert!(device.is_drained().is_err());
    }
}
