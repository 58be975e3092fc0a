//! A connection that carries bytes: TCP, or a descriptor (serial device, pseudo-terminal).

use std::io;
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::fs::{FileTypeExt, MetadataExt, OpenOptionsExt};
use std::path::Path;
use std::time::Duration;

use thiserror::Error;
use tokio::io::Interest;
use tokio::io::unix::AsyncFd;
use tokio::net::TcpStream;

use crate::{sys, watch};

/// How long a TCP connection may take.
const CONNECT: Duration = Duration::from_secs(5);

/// See the module.
#[derive(Debug)]
pub enum Port {
    /// TCP.
    Tcp(TcpStream),
    /// A terminal, non-blocking.
    Tty(AsyncFd<OwnedFd>),
}

impl Port {
    /// Reads what is there; `Ok(0)` is the end.
    pub fn try_read(&self, buffer: &mut [u8]) -> io::Result<usize> {
        match self {
            Self::Tcp(stream) => stream.try_read(buffer),
            Self::Tty(fd) => fd.try_io(Interest::READABLE, |fd| Ok(rustix::io::read(fd, &mut *buffer)?)),
        }
    }

    /// Writes what fits.
    pub fn try_write(&self, bytes: &[u8]) -> io::Result<usize> {
        match self {
            Self::Tcp(stream) => stream.try_write(bytes),
            Self::Tty(fd) => fd.try_io(Interest::WRITABLE, |fd| Ok(rustix::io::write(fd, bytes)?)),
        }
    }

    /// Waits; true when it may be readable.
    pub async fn ready(&self, interest: Interest) -> io::Result<bool> {
        match self {
            Self::Tcp(stream) => Ok(stream.ready(interest).await?.is_readable()),
            Self::Tty(fd) => {
                let mut guard = fd.ready(interest).await?;
                guard.retain_ready();
                Ok(guard.ready().is_readable() || guard.ready().is_read_closed() || guard.ready().is_error())
            }
        }
    }
}

/// Where a connection leads.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Target {
    /// `tcp://host:port`
    Tcp(String),
    /// A serial device or pseudo-terminal.
    Device {
        /// Its path.
        path: String,
        /// Its rate.
        baud: u32,
    },
}

/// Why there is no connection.
#[derive(Debug, Error)]
pub enum PortError {
    /// No such device.
    #[error(
        "there is no device {0}: plug the adapter in; `ls /dev/serial/by-id` lists serial adapters by a name that stays"
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
    #[error("{0} is in use by another program: end it first (`fuser {0}` names it)")]
    Busy(String),
    /// Something else than a serial device.
    #[error("{0} is no serial device")]
    NotSerial(String),
    /// Nobody there.
    #[error(
        "cannot connect to {address}: {source}; is the server running, and does the address say host and port?"
    )]
    Connect {
        /// Where.
        address: String,
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

impl Target {
    /// Opens it.
    pub async fn open(&self) -> Result<Port, PortError> {
        match self {
            Self::Tcp(address) => {
                let failed = |source| PortError::Connect { address: address.clone(), source };
                let stream = tokio::time::timeout(CONNECT, TcpStream::connect(address.as_str()))
                    .await
                    .map_err(|_| failed(io::ErrorKind::TimedOut.into()))?
                    .map_err(failed)?;
                crate::server::prepare(&stream).map_err(failed)?;
                Ok(Port::Tcp(stream))
            }
            Self::Device { path, baud } => device(path, *baud),
        }
    }
}

fn device(path: &str, baud: u32) -> Result<Port, PortError> {
    let system = |what| move |source| PortError::System { path: path.to_owned(), what, source };
    let file = std::fs::OpenOptions::new()
        .read(true)
        .write(true)
        .custom_flags(libc::O_NOCTTY | libc::O_NONBLOCK | libc::O_CLOEXEC)
        .open(path)
        .map_err(|source| match source.kind() {
            io::ErrorKind::NotFound => PortError::Absent(path.to_owned()),
            io::ErrorKind::PermissionDenied => permission(path),
            _ if source.raw_os_error() == Some(libc::EBUSY) => PortError::Busy(path.to_owned()),
            io::ErrorKind::IsADirectory => PortError::NotSerial(path.to_owned()),
            _ => system("opening it")(source),
        })?;
    if !file.metadata().map_err(system("looking at it"))?.file_type().is_char_device() {
        return Err(PortError::NotSerial(path.to_owned()));
    }
    sys::make_raw(file.as_fd(), Some(baud)).map_err(|source| match source.raw_os_error() {
        Some(libc::ENOTTY) => PortError::NotSerial(path.to_owned()),
        _ => system("setting its rate")(source),
    })?;
    sys::exclusive(file.as_fd()).map_err(system("taking it for this process alone"))?;
    let fd = watch::both(OwnedFd::from(file)).map_err(system("watching it"))?;
    Ok(Port::Tty(fd))
}

/// The group that owns the device is the one to join.
fn permission(path: &str) -> PortError {
    let group = std::fs::metadata(path).ok().map(|m| m.gid()).and_then(group_name);
    let remedy = match group {
        Some(group) if group != "root" => {
            format!("it belongs to group '{group}'; run `sudo usermod -aG {group} $USER`, then log in again")
        }
        _ => "it belongs to root alone: a udev rule must give it a group".to_owned(),
    };
    PortError::Permission { path: path.to_owned(), remedy }
}

fn group_name(gid: u32) -> Option<String> {
    let groups = std::fs::read_to_string(Path::new("/etc/group")).ok()?;
    groups.lines().find_map(|line| {
        let mut fields = line.split(':');
        let name = fields.next()?;
        (fields.nth(1)?.parse() == Ok(gid)).then(|| name.to_owned())
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn open(target: Target) -> String {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(async { target.open().await.map(|_| ()).unwrap_err().to_string() })
    }

    #[test]
    fn sentences() {
        let device = |path: &str| open(Target::Device { path: path.into(), baud: 115_200 });
        let closed = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
        let all = [
            device("/dev/ttyNOTHERE"),
            device("/dev"),
            device("/dev/null"),
            device("/etc/hostname"),
            open(Target::Tcp(closed.to_string())).replace(&closed.port().to_string(), "PORT"),
            PortError::Busy("/dev/ttyACM0".into()).to_string(),
            PortError::Permission {
                path: "/dev/ttyACM0".into(),
                remedy:
                    "it belongs to group 'dialout'; run `sudo usermod -aG dialout $USER`, then log in again"
                        .into(),
            }
            .to_string(),
        ];
        insta::assert_snapshot!(all.join("\n"), @r"
        there is no device /dev/ttyNOTHERE: plug the adapter in; `ls /dev/serial/by-id` lists serial adapters by a name that stays
        /dev is no serial device
        /dev/null is no serial device
        /etc/hostname is no serial device
        cannot connect to 127.0.0.1:PORT: Connection refused (os error 111); is the server running, and does the address say host and port?
        /dev/ttyACM0 is in use by another program: end it first (`fuser /dev/ttyACM0` names it)
        no permission for /dev/ttyACM0: it belongs to group 'dialout'; run `sudo usermod -aG dialout $USER`, then log in again
        ");
    }

    #[test]
    fn the_group_that_owns_the_device_is_named() {
        let path = std::env::temp_dir().join(format!("dinrail-group-{}", std::process::id()));
        std::fs::write(&path, "").unwrap();
        let groups = std::fs::read_to_string("/etc/group").unwrap();
        let dialout =
            groups.lines().find_map(|line| line.strip_prefix("dialout:x:")?.split(':').next()?.parse().ok());
        // Only root may give a file away; else it is the group of this process.
        let given = dialout.is_some_and(|gid| std::os::unix::fs::chown(&path, None, Some(gid)).is_ok());
        let group = group_name(std::fs::metadata(&path).unwrap().gid()).unwrap();
        assert!(!given || group == "dialout");
        let said = permission(path.to_str().unwrap()).to_string();
        let remedy = if group == "root" {
            "it belongs to root alone: a udev rule must give it a group".to_owned()
        } else {
            format!("it belongs to group '{group}'; run `sudo usermod -aG {group} $USER`, then log in again")
        };
        assert_eq!(said, format!("no permission for {}: {remedy}", path.display()));
        std::fs::remove_file(&path).unwrap();
        assert_eq!(group_name(0).as_deref(), Some("root"));
        assert_eq!(group_name(u32::MAX - 7), None);
    }
}
