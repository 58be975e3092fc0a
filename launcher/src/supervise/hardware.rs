//! The hardware watchdog (`/dev/watchdog`): resets the machine when nobody feeds it. Fed while the launcher's loop
//! turns and every critical service is healthy; disarmed by an orderly end (the `V` of the Linux watchdog API).

use std::fs::{File, OpenOptions};
use std::io::{self, Write};
use std::path::Path;

/// An armed watchdog.
pub struct Watchdog {
    file: File,
}

impl Watchdog {
    /// Opens, and so arms, the device.
    pub fn open(path: &Path) -> io::Result<Self> {
        let file = OpenOptions::new().write(true).open(path).map_err(|e| {
            io::Error::new(
                e.kind(),
                format!("{}: {e}; is a driver loaded (softdog), and may you write to it?", path.display()),
            )
        })?;
        Ok(Self { file })
    }

    /// Asks for another period.
    pub fn feed(&mut self) {
        let _ = self.file.write_all(b".");
    }

    /// Disarms. A launcher that dies without it, or a stack that failed, lets the machine reset.
    pub fn disarm(mut self) {
        let _ = self.file.write_all(b"V");
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_is_fed_and_disarmed() {
        let path = std::env::temp_dir().join(format!("dinrail-watchdog-{}", std::process::id()));
        let _ = std::fs::remove_file(&path);
        assert!(Watchdog::open(&path).is_err_and(|e| e.to_string().contains("softdog")));
        std::fs::write(&path, "").unwrap();
        let mut watchdog = Watchdog::open(&path).unwrap();
        watchdog.feed();
        watchdog.feed();
        watchdog.disarm();
        assert_eq!(std::fs::read(&path).unwrap(), b"..V");
        std::fs::remove_file(&path).unwrap();
    }
}
