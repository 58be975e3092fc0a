//! A port that carries bytes: a serial device, a pseudo-terminal of our own, a raw TCP connection.
//!
//! Opening may take its time (USB, TCP) and is done on a helper thread; reading and writing never wait.

use std::io;
use std::net::{TcpStream, ToSocketAddrs};
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::path::{Path, PathBuf};
use std::time::Duration;

use ipc_types::payload::serial_flag;
use rustix::fs::inotify;
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{QueueSelector, tcflush};
use thiserror::Error;

use crate::character::{self, Character};
use crate::device::Device;
use crate::list;
use crate::protocol::parmrk::Unmark;
use crate::sys::{self, LineCounters, Rs485};

/// How long a TCP connection may take.
const CONNECT: Duration = Duration::from_secs(5);
/// How long a TCP peer may leave what it was sent without acknowledgement: as long as one that is silent is probed.
const UNANSWERED_MS: u32 = 20_000;

/// Where the bytes go.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Target {
    /// A serial device or the other end of a pseudo-terminal.
    Device(PathBuf),
    /// `pty:/path`: a pseudo-terminal is made, and a link to it.
    Terminal(PathBuf),
    /// `socket://host:port`: bytes over TCP, as ser2net serves them.
    Socket(String),
}

impl Target {
    /// Reads `device` of the stack file; paths of `pty:` start at `dir`. `None`: neither a path nor one of the forms.
    pub fn parse(text: &str, dir: &Path) -> Option<Self> {
        if let Some(address) = text.strip_prefix("socket://") {
            let (host, port) = address.rsplit_once(':')?;
            let whole = !host.is_empty() && port.parse::<u16>().is_ok_and(|p| p > 0);
            return whole.then(|| Self::Socket(address.to_owned()));
        }
        if let Some(path) = text.strip_prefix("pty:") {
            return (!path.is_empty()).then(|| Self::Terminal(dir.join(path)));
        }
        text.starts_with('/').then(|| Self::Device(PathBuf::from(text)))
    }
}

impl std::fmt::Display for Target {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Device(path) => write!(f, "{}", path.display()),
            Self::Terminal(path) => write!(f, "pty:{}", path.display()),
            Self::Socket(address) => write!(f, "socket://{address}"),
        }
    }
}

/// What a port really is; it decides how far the time of a read can be believed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// A UART of the machine.
    Uart,
    /// A USB adapter.
    Usb,
    /// A pseudo-terminal.
    Pty,
    /// A TCP connection.
    Tcp,
}

/// How a port is opened.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Options {
    /// Where.
    pub target: Target,
    /// Rate and shape of characters.
    pub character: Character,
    /// The kernel switches the transmitter.
    pub rs485: Option<Rs485>,
    /// This process switches the transmitter: RTS is this while sending.
    pub rts_on_send: Option<bool>,
    /// Ask the driver for low latency.
    pub low_latency: bool,
    /// Take the port for this process alone.
    pub exclusive: bool,
    /// Compare the settings that the port has taken.
    pub verify: bool,
}

/// Why a port cannot be used.
#[derive(Debug, Error)]
pub enum PortError {
    /// No such device.
    #[error(
        "there is no device {0}: plug the adapter in; `dinrail serial list` lists ports, with names that stay the same"
    )]
    Absent(String),
    /// Not permitted.
    #[error("no permission for {path}: {remedy}")]
    Permission {
        /// The device.
        path: String,
        /// What to do.
        remedy: String,
    },
    /// In use.
    #[error("{path} is in use by {holder}: end it first, or use another port")]
    Busy {
        /// The device.
        path: String,
        /// Who has it.
        holder: String,
    },
    /// Something else than a serial device.
    #[error("{0} is no serial device; `dinrail serial list` lists ports")]
    NotSerial(String),
    /// The driver cannot switch the transmitter.
    #[error(
        "{0}: its driver cannot switch an RS-485 transmitter (rs485 = \"kernel\"): use rs485 = \"adapter\" if the adapter switches by itself, as most USB ones do, or rs485 = \"rts\" to let dinrail switch RTS"
    )]
    NoRs485(String),
    /// The port has taken other settings.
    #[error(
        "{path} does not take {wanted}: {keys} read back otherwise; use settings that its chip has, or verify = false"
    )]
    Refused {
        /// The device.
        path: String,
        /// As asked.
        wanted: String,
        /// What differs.
        keys: String,
    },
    /// Nobody there.
    #[error(
        "cannot connect to socket://{address}: {source}; is ser2net (or what serves the port) running, and does the address say host and port?"
    )]
    Connect {
        /// Where.
        address: String,
        /// The system's reason.
        source: io::Error,
    },
    /// No pseudo-terminal.
    #[error("cannot make a pseudo-terminal at {path}: {source}")]
    Terminal {
        /// The link.
        path: String,
        /// The system's reason.
        source: io::Error,
    },
    /// Anything else.
    #[error("{path}: {what}: {source}")]
    System {
        /// The device.
        path: String,
        /// What was attempted.
        what: &'static str,
        /// The system's reason.
        source: io::Error,
    },
}

/// What a read brought.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Read {
    /// So many bytes, and [`serial_flag`]s of errors that were seen.
    Bytes(usize, u32),
    /// Nothing now.
    Nothing,
    /// A pseudo-terminal that nobody has open.
    Nobody,
}

/// Errors that the UART has seen since the port was opened.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize)]
pub struct ErrorCounters {
    /// Parity errors.
    pub parity: u64,
    /// Framing errors.
    pub framing: u64,
    /// Bytes lost in the UART or the driver's buffer.
    pub overrun: u64,
    /// Breaks.
    pub breaks: u64,
}

/// The end of a pseudo-terminal that we made.
#[derive(Debug)]
struct Made {
    link: PathBuf,
    device: PathBuf,
    notify: OwnedFd,
}

#[derive(Debug)]
enum Wire {
    Device(Device),
    /// A connection, or a pseudo-terminal of our own.
    Other(OwnedFd),
}

impl AsFd for Wire {
    fn as_fd(&self) -> BorrowedFd<'_> {
        match self {
            Self::Device(device) => device.fd(),
            Self::Other(fd) => fd.as_fd(),
        }
    }
}

/// See the module.
#[derive(Debug)]
pub struct Port {
    wire: Wire,
    kind: Kind,
    path: String,
    made: Option<Made>,
    unmark: Option<Unmark>,
    counters: Option<LineCounters>,
    errors: ErrorCounters,
    rts_on_send: Option<bool>,
    notes: Vec<String>,
    nobody: bool,
}

impl Port {
    /// Opens a port. May take seconds.
    pub fn open(options: &Options) -> Result<Self, PortError> {
        match &options.target {
            Target::Device(path) => device(path, options),
            Target::Terminal(path) => terminal(path, &options.character)
                .map_err(|source| PortError::Terminal { path: path.display().to_string(), source }),
            Target::Socket(address) => {
                socket(address).map_err(|source| PortError::Connect { address: address.clone(), source })
            }
        }
    }

    fn plain(wire: Wire, kind: Kind, path: String) -> Self {
        Self {
            wire,
            kind,
            path,
            made: None,
            unmark: None,
            counters: None,
            errors: ErrorCounters::default(),
            rts_on_send: None,
            notes: Vec::new(),
            nobody: false,
        }
    }

    /// What it is.
    pub fn kind(&self) -> Kind {
        self.kind
    }

    /// The device that was opened, links followed.
    pub fn path(&self) -> &str {
        &self.path
    }

    /// What a user should know about it, once.
    pub fn notes(&self) -> &[String] {
        &self.notes
    }

    /// What the UART has seen.
    pub fn errors(&self) -> ErrorCounters {
        self.errors
    }

    /// Readable when there are bytes.
    pub fn fd(&self) -> BorrowedFd<'_> {
        self.wire.as_fd()
    }

    /// Readable when somebody opens the pseudo-terminal that we made.
    pub fn visitors(&self) -> Option<BorrowedFd<'_>> {
        self.made.as_ref().map(|made| made.notify.as_fd())
    }

    /// Somebody may have opened the pseudo-terminal; true when somebody has.
    pub fn visited(&mut self) -> bool {
        if let Some(made) = &self.made {
            let mut buffer = [0u8; 1024];
            while matches!(rustix::io::read(&made.notify, &mut buffer), Ok(n) if n > 0) {}
            self.nobody = hung_up(self.wire.as_fd());
        }
        !self.nobody
    }

    /// Reads what is there. An error means that the port is gone.
    pub fn read(&mut self, bytes: &mut [u8]) -> io::Result<Read> {
        let n = match rustix::io::read(&self.wire, &mut *bytes) {
            Ok(0) => return Err(io::ErrorKind::UnexpectedEof.into()),
            Ok(n) => n,
            Err(rustix::io::Errno::AGAIN | rustix::io::Errno::INTR) => return Ok(Read::Nothing),
            Err(rustix::io::Errno::IO) if self.made.is_some() => {
                self.nobody = true;
                return Ok(Read::Nobody);
            }
            Err(e) => return Err(e.into()),
        };
        let (n, marked) = match &mut self.unmark {
            Some(unmark) => unmark.decode(&mut bytes[..n]),
            None => (n, 0),
        };
        Ok(Read::Bytes(n, self.errors_since(marked)))
    }

    /// What the UART saw since the last read; where it has no counters, what the marks say.
    fn errors_since(&mut self, marked: u32) -> u32 {
        let Some(before) = self.counters else {
            self.errors.parity += u64::from(marked & serial_flag::PARITY != 0);
            self.errors.breaks += u64::from(marked & serial_flag::BREAK != 0);
            return marked;
        };
        let Ok(now) = sys::line_counters(self.wire.as_fd()) else { return marked };
        self.counters = Some(now);
        let mut flags = 0;
        let mut grown = |now: i32, before: i32, flag: u32, count: &mut u64| {
            let more = now.wrapping_sub(before).max(0) as u64;
            *count += more;
            flags |= if more > 0 { flag } else { 0 };
        };
        let errors = &mut self.errors;
        grown(now.parity, before.parity, serial_flag::PARITY, &mut errors.parity);
        grown(now.frame, before.frame, serial_flag::FRAMING, &mut errors.framing);
        grown(now.overrun, before.overrun, serial_flag::OVERRUN, &mut errors.overrun);
        grown(now.buf_overrun, before.buf_overrun, serial_flag::OVERRUN, &mut errors.overrun);
        grown(now.brk, before.brk, serial_flag::BREAK, &mut errors.breaks);
        flags | unseen(flags, marked)
    }

    /// Writes what fits; 0 when nothing does. Into a pseudo-terminal that nobody has open bytes vanish, as on a line
    /// without a receiver. An error means that the port is gone.
    pub fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if self.nobody {
            return Ok(bytes.len());
        }
        match rustix::io::write(&self.wire, bytes) {
            Ok(n) => Ok(n),
            Err(rustix::io::Errno::AGAIN | rustix::io::Errno::INTR) => Ok(0),
            Err(e) => Err(e.into()),
        }
    }

    /// Whether all bytes have left, as far as it can be known.
    pub fn is_drained(&self) -> io::Result<bool> {
        match &self.wire {
            Wire::Device(device) if self.kind != Kind::Pty => device.is_drained(),
            _ => Ok(true),
        }
    }

    /// Switches the transmitter on or off by RTS, where this process does that.
    pub fn transmitter(&mut self, on: bool) -> io::Result<()> {
        match (&mut self.wire, self.rts_on_send) {
            (Wire::Device(device), Some(level)) if self.kind != Kind::Pty => device.set_rts(on == level),
            _ => Ok(()),
        }
    }

    /// Throws away what could not be sent.
    pub fn discard_output(&self) {
        if self.kind != Kind::Tcp {
            let _ = tcflush(&self.wire, QueueSelector::OFlush);
        }
    }
}

impl Drop for Port {
    fn drop(&mut self) {
        // Closing would wait until a stuck line has taken the rest.
        self.discard_output();
        if let Some(made) = &self.made
            && std::fs::read_link(&made.link).is_ok_and(|to| to == made.device)
        {
            let _ = std::fs::remove_file(&made.link);
        }
    }
}

/// Marks of damage that the counters say nothing of: some adapters have counters and do not count. Which of parity and
/// framing a mark means only the counters know.
fn unseen(counted: u32, marked: u32) -> u32 {
    let damaged = serial_flag::PARITY | serial_flag::FRAMING | serial_flag::BREAK;
    if counted & damaged == 0 { marked & damaged } else { 0 }
}

fn hung_up(fd: BorrowedFd<'_>) -> bool {
    use rustix::event::{PollFd, PollFlags, Timespec, poll};
    let mut fds = [PollFd::new(&fd, PollFlags::IN)];
    let _ = poll(&mut fds, Some(&Timespec { tv_sec: 0, tv_nsec: 0 }));
    let is = fds[0].revents();
    // What somebody wrote before leaving is still to be read.
    is.contains(PollFlags::HUP) && !is.contains(PollFlags::IN)
}

fn device(path: &Path, options: &Options) -> Result<Port, PortError> {
    let shown = path.display().to_string();
    let system = |what| {
        let path = shown.clone();
        move |source| PortError::System { path, what, source }
    };
    let device = Device::open(path, &options.character, options.exclusive)?;
    let kind = if device.is_pty() {
        Kind::Pty
    } else if list::is_usb(device.path()) {
        Kind::Usb
    } else {
        Kind::Uart
    };
    let real = kind != Kind::Pty;
    let whole = device.path().to_owned();
    let mut port = Port::plain(Wire::Device(device), kind, whole.display().to_string());
    if options.exclusive
        && let Some(holder) = list::users(&whole).into_iter().find(|h| h.pid != std::process::id())
    {
        port.notes.push(format!("{shown} is also open in {holder}: it may take bytes away"));
    }
    if real && options.verify {
        let different =
            character::differences(port.fd(), &options.character).map_err(system("reading back"))?;
        if !different.is_empty() {
            let wanted = options.character.to_string();
            return Err(PortError::Refused { path: shown, wanted, keys: different.join(", ") });
        }
    }
    if real {
        prepare(&mut port, &shown, options)?;
        // What came before the port was set is garbage.
        let _ = tcflush(port.fd(), QueueSelector::IFlush);
    }
    Ok(port)
}

/// RS-485, RTS, latency, counters of a real port.
fn prepare(port: &mut Port, shown: &str, options: &Options) -> Result<(), PortError> {
    match options.rs485 {
        Some(rs485) => {
            sys::set_rs485(port.fd(), Some(rs485)).map_err(|source| match source.raw_os_error() {
                Some(libc::ENOTTY | libc::EINVAL) => PortError::NoRs485(shown.to_owned()),
                _ => PortError::System { path: shown.to_owned(), what: "switching on RS-485", source },
            })?;
        }
        // What an earlier program left on would switch a second time.
        None if sys::rs485_enabled(port.fd()).unwrap_or(false) => {
            let _ = sys::set_rs485(port.fd(), None);
        }
        None => {}
    }
    port.rts_on_send = options.rts_on_send;
    if options.rts_on_send.is_some() {
        port.transmitter(false).map_err(|source| PortError::System {
            path: shown.to_owned(),
            what: "switching RTS",
            source,
        })?;
    }
    if options.rts_on_send == Some(true) {
        // Killed while it sends, this process would leave the transmitter on, and the line blocked for all.
        let _ = character::drop_lines_on_close(port.fd());
    }
    if options.low_latency {
        let asked = sys::low_latency(port.fd());
        if port.kind == Kind::Usb
            && let Some(ms) = list::latency_timer(Path::new(&port.path), asked.is_ok())
            && ms > 1
        {
            port.notes.push(format!(
                "{shown} holds bytes back up to {ms} ms: write 1 to its latency_timer in /sys/bus/usb-serial/devices, or use a udev rule"
            ));
        }
    }
    character::mark_errors(port.fd()).map_err(|source| PortError::System {
        path: shown.to_owned(),
        what: "asking for marks of damaged bytes",
        source,
    })?;
    port.unmark = Some(Unmark::default());
    port.counters = sys::line_counters(port.fd()).ok();
    Ok(())
}

fn terminal(link: &Path, character: &Character) -> io::Result<Port> {
    let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC)?;
    grantpt(&master)?;
    unlockpt(&master)?;
    rustix::fs::fcntl_setfl(&master, rustix::fs::OFlags::NONBLOCK)?;
    let device = PathBuf::from(ptsname(&master, Vec::new())?.to_string_lossy().into_owned());
    // On the master it sets the other end.
    character::make_pipe(master.as_fd(), character)?;
    let notify = inotify::init(inotify::CreateFlags::CLOEXEC | inotify::CreateFlags::NONBLOCK)?;
    inotify::add_watch(&notify, &device, inotify::WatchFlags::OPEN)?;
    match std::fs::symlink_metadata(link) {
        Ok(found) if found.file_type().is_symlink() => std::fs::remove_file(link)?,
        Ok(_) => {
            let why = "something that is no link is there";
            return Err(io::Error::new(io::ErrorKind::AlreadyExists, why));
        }
        Err(_) => {}
    }
    std::os::unix::fs::symlink(&device, link)?;
    let mut port = Port::plain(Wire::Other(master), Kind::Pty, device.display().to_string());
    port.made = Some(Made { link: link.to_owned(), device, notify });
    // Until somebody opens it.
    port.nobody = true;
    Ok(port)
}

fn socket(address: &str) -> io::Result<Port> {
    let mut last = io::Error::new(io::ErrorKind::NotFound, "the name leads to no address");
    for one in address.to_socket_addrs()? {
        match TcpStream::connect_timeout(&one, CONNECT) {
            Ok(stream) => {
                stream.set_nodelay(true)?;
                stream.set_nonblocking(true)?;
                let _ = rustix::net::sockopt::set_socket_keepalive(&stream, true);
                let _ = rustix::net::sockopt::set_tcp_keepidle(&stream, Duration::from_secs(10));
                let _ = rustix::net::sockopt::set_tcp_keepintvl(&stream, Duration::from_secs(3));
                let _ = rustix::net::sockopt::set_tcp_keepcnt(&stream, 3);
                // With bytes on their way the system does not probe, and would go on for a quarter of an hour.
                let _ = rustix::net::sockopt::set_tcp_user_timeout(&stream, UNANSWERED_MS);
                return Ok(Port::plain(Wire::Other(stream.into()), Kind::Tcp, address.to_owned()));
            }
            Err(e) => last = e,
        }
    }
    Err(last)
}

#[cfg(test)]
#[path = "port_tests.rs"]
mod tests;
