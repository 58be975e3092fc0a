//! Telling systemd how the stack is (`Type=notify`, `WatchdogSec=`): a datagram to the socket of NOTIFY_SOCKET.
//! See sd_notify(3). Never blocks; a lost datagram is repeated by the next one.

use std::os::linux::net::SocketAddrExt;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::net::{SocketAddr, UnixDatagram};
use std::time::Duration;

/// The way to the service manager.
pub struct Notify {
    socket: UnixDatagram,
    address: SocketAddr,
}

impl Notify {
    /// `None` when nobody asked for notifications.
    pub fn from_env() -> Option<Self> {
        Self::to(std::env::var_os("NOTIFY_SOCKET")?.as_bytes())
    }

    fn to(path: &[u8]) -> Option<Self> {
        let address = match path {
            [b'@', name @ ..] => SocketAddr::from_abstract_name(name).ok()?,
            [b'/', ..] => SocketAddr::from_pathname(std::ffi::OsStr::from_bytes(path)).ok()?,
            _ => return None,
        };
        let socket = UnixDatagram::unbound().ok()?;
        socket.set_nonblocking(true).ok()?;
        Some(Self { socket, address })
    }

    /// Sends lines such as `READY=1`.
    pub fn send(&self, text: &str) {
        let _ = self.socket.send_to_addr(text.as_bytes(), &self.address);
    }

    /// How often `WATCHDOG=1` is due: half of what the manager waits for; `None` when it does not watch us.
    pub fn watchdog_period() -> Option<Duration> {
        let micros: u64 = std::env::var("WATCHDOG_USEC").ok()?.parse().ok()?;
        if let Ok(pid) = std::env::var("WATCHDOG_PID")
            && pid != std::process::id().to_string()
        {
            return None;
        }
        (micros > 0).then(|| Duration::from_micros(micros / 2))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_message_arrives_at_an_abstract_and_at_a_path_socket() {
        let name = format!("dinrail-notify-{}", std::process::id());
        let abstract_address = SocketAddr::from_abstract_name(&name).unwrap();
        let path = std::env::temp_dir().join(&name);
        for (address, text) in [
            (abstract_address, format!("@{name}")),
            (SocketAddr::from_pathname(&path).unwrap(), path.display().to_string()),
        ] {
            let receiver = UnixDatagram::bind_addr(&address).unwrap();
            receiver.set_read_timeout(Some(Duration::from_secs(10))).unwrap();
            Notify::to(text.as_bytes()).unwrap().send("READY=1");
            let mut buffer = [0u8; 64];
            let n = receiver.recv(&mut buffer).unwrap();
            assert_eq!(&buffer[..n], b"READY=1");
        }
        std::fs::remove_file(&path).unwrap();
        assert!(Notify::to(b"relative").is_none());
    }
}
