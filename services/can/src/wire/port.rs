//! A connection that carries bytes: TCP, or a descriptor (serial device, pseudo-terminal).

use std::io;
use std::os::fd::OwnedFd;
use std::path::PathBuf;
use std::time::Duration;

use dinrail_serial::character::{Character, Flow, Parity};
use dinrail_serial::device::Device;
use thiserror::Error;
use tokio::io::Interest;
use tokio::io::unix::AsyncFd;
use tokio::net::TcpStream;

use crate::watch;

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
            Self::Tty(fd) => fd.try_io(Interest::READABLE, |fd| {
                Ok(rustix::io::retry_on_intr(|| rustix::io::read(fd, &mut *buffer))?)
            }),
        }
    }

    /// Writes what fits.
    pub fn try_write(&self, bytes: &[u8]) -> io::Result<usize> {
        match self {
            Self::Tcp(stream) => stream.try_write(bytes),
            Self::Tty(fd) => fd.try_io(Interest::WRITABLE, |fd| {
                Ok(rustix::io::retry_on_intr(|| rustix::io::write(fd, bytes))?)
            }),
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
    /// The device cannot be used.
    #[error(transparent)]
    Device(#[from] dinrail_serial::port::PortError),
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
    /// It cannot be waited for.
    #[error("{path}: watching it: {source}")]
    Watch {
        /// The device.
        path: String,
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
            Self::Device { path, baud } => device(path, *baud).await,
        }
    }
}

async fn device(path: &str, baud: u32) -> Result<Port, PortError> {
    let failed = |source| PortError::Watch { path: path.to_owned(), source };
    let character = Character { baud, data_bits: 8, parity: Parity::None, stop_bits: 1, flow: Flow::None };
    let device = PathBuf::from(path);
    // Opening takes its time, and so does the search for who has it.
    let opening = tokio::task::spawn_blocking(move || Device::open(&device, &character, true));
    let device = opening.await.map_err(|e| failed(io::Error::other(e)))??;
    Ok(Port::Tty(watch::both(device.into_fd()).map_err(failed)?))
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
        ];
        insta::assert_snapshot!(all.join("\n"), @r"
        there is no device /dev/ttyNOTHERE: plug the adapter in; `dinrail serial list` lists ports, with names that stay the same
        /dev is no serial device; `dinrail serial list` lists ports
        /dev/null is no serial device; `dinrail serial list` lists ports
        /etc/hostname is no serial device; `dinrail serial list` lists ports
        cannot connect to 127.0.0.1:PORT: Connection refused (os error 111); is the server running, and does the address say host and port?
        ");
    }
}
