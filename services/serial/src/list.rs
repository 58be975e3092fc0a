//! The serial ports of this machine: driver, adapter, names that stay, who has them open.

use std::fmt;
use std::fs;
use std::os::unix::fs::{FileTypeExt, MetadataExt};
use std::path::{Path, PathBuf};

use serde::Serialize;

/// A process that has a port open.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Holder {
    /// Process id.
    pub pid: u32,
    /// Name of its executable.
    pub program: String,
}

impl fmt::Display for Holder {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} (pid {})", self.program, self.pid)
    }
}

/// A USB adapter.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Usb {
    /// Vendor id, hex.
    pub vendor: String,
    /// Product id, hex.
    pub product: String,
    /// Name of the maker.
    pub manufacturer: Option<String>,
    /// Name of the product.
    pub name: Option<String>,
    /// Serial number.
    pub serial: Option<String>,
}

/// A port.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct PortInfo {
    /// `/dev/ttyUSB0`
    pub device: String,
    /// Name that stays when it is plugged in elsewhere.
    pub by_id: Option<String>,
    /// Kernel driver.
    pub driver: Option<String>,
    /// Its adapter.
    pub usb: Option<Usb>,
    /// FTDI: ms that bytes are held back.
    pub latency_timer_ms: Option<u32>,
    /// Who has it open, as far as this user may see.
    pub holders: Vec<Holder>,
    /// What keeps this user from opening it.
    pub permission: Option<String>,
}

fn text(path: &Path) -> Option<String> {
    let text = fs::read_to_string(path).ok()?;
    Some(text.trim().to_owned()).filter(|t| !t.is_empty())
}

fn sysfs(device: &Path) -> Option<PathBuf> {
    Some(Path::new("/sys/class/tty").join(device.file_name()?))
}

/// Whether a USB adapter carries this device (`/dev/ttyUSB0`, links followed).
pub fn is_usb(device: &Path) -> bool {
    usb_of(device).is_some()
}

fn usb_of(device: &Path) -> Option<Usb> {
    let mut at = sysfs(device)?.join("device").canonicalize().ok()?;
    // The port, its interface, its adapter: the latter has the ids.
    for _ in 0..6 {
        if let (Some(vendor), Some(product)) = (text(&at.join("idVendor")), text(&at.join("idProduct"))) {
            return Some(Usb {
                vendor,
                product,
                manufacturer: text(&at.join("manufacturer")),
                name: text(&at.join("product")),
                serial: text(&at.join("serial")),
            });
        }
        at = at.parent()?.to_owned();
    }
    None
}

/// The latency timer of an FTDI adapter in ms, after an attempt to set it to 1 when `asked` did not do it.
pub fn latency_timer(device: &Path, asked: bool) -> Option<u32> {
    let file = sysfs(device)?.join("device/latency_timer");
    let read = || text(&file)?.parse::<u32>().ok();
    let now = read()?;
    if now > 1 && (!asked || read() != Some(1)) {
        let _ = fs::write(&file, "1");
    }
    read()
}

/// Who has the device open, as far as this user may see: own processes, all for root.
pub fn holders(device: &Path) -> Vec<Holder> {
    let Ok(wanted) = fs::metadata(device) else { return Vec::new() };
    let mut found = Vec::new();
    let Ok(processes) = fs::read_dir("/proc") else { return found };
    for process in processes.flatten() {
        let Some(pid) = process.file_name().to_str().and_then(|n| n.parse::<u32>().ok()) else { continue };
        let Ok(descriptors) = fs::read_dir(process.path().join("fd")) else { continue };
        let holds = descriptors.flatten().any(|d| {
            // The link's text first: following it would open network file systems.
            fs::read_link(d.path()).is_ok_and(|to| to.starts_with("/dev"))
                && fs::metadata(d.path())
                    .is_ok_and(|m| m.rdev() == wanted.rdev() && m.file_type().is_char_device())
        });
        if holds {
            let program = text(&process.path().join("comm")).unwrap_or_else(|| "?".to_owned());
            found.push(Holder { pid, program });
        }
    }
    found
}

/// What gives this user access to a device.
pub fn permission_remedy(path: &Path) -> String {
    let group = fs::metadata(path).ok().map(|m| m.gid()).and_then(group_name);
    match group {
        Some(group) if group != "root" => {
            format!("it belongs to group '{group}'; run `sudo usermod -aG {group} $USER`, then log in again")
        }
        _ => "it belongs to root alone: a udev rule must give it a group".to_owned(),
    }
}

fn group_name(gid: u32) -> Option<String> {
    let groups = fs::read_to_string("/etc/group").ok()?;
    groups.lines().find_map(|line| {
        let mut fields = line.split(':');
        let name = fields.next()?;
        (fields.nth(1)?.parse() == Ok(gid)).then(|| name.to_owned())
    })
}

fn by_id(device: &Path) -> Option<String> {
    let entries = fs::read_dir("/dev/serial/by-id").ok()?;
    entries
        .flatten()
        .map(|e| e.path())
        .find(|p| p.canonicalize().is_ok_and(|to| to == device))
        .map(|p| p.display().to_string())
}

/// One port.
pub fn describe(device: &Path) -> PortInfo {
    let driver = sysfs(device)
        .and_then(|s| fs::read_link(s.join("device/driver")).ok())
        .and_then(|d| Some(d.file_name()?.to_string_lossy().into_owned()));
    let denied = rustix::fs::access(device, rustix::fs::Access::READ_OK | rustix::fs::Access::WRITE_OK);
    PortInfo {
        device: device.display().to_string(),
        by_id: by_id(device),
        driver,
        usb: usb_of(device),
        latency_timer_ms: sysfs(device)
            .and_then(|s| text(&s.join("device/latency_timer")))
            .and_then(|t| t.parse().ok()),
        holders: holders(device),
        permission: denied.is_err().then(|| permission_remedy(device)),
    }
}

/// Every port with hardware behind it, by name.
pub fn ports() -> Vec<PortInfo> {
    let Ok(entries) = fs::read_dir("/sys/class/tty") else { return Vec::new() };
    let mut names: Vec<String> =
        entries.flatten().map(|e| e.file_name().to_string_lossy().into_owned()).collect();
    names.sort_by_key(|name| {
        (name.trim_end_matches(|c: char| c.is_ascii_digit()).to_owned(), name.len(), name.clone())
    });
    names.iter().filter(|name| is_port(name)).map(|name| describe(&Path::new("/dev").join(name))).collect()
}

/// Virtual consoles have no device behind them; the kernel lists UARTs of type 0 that are not there.
fn is_port(name: &str) -> bool {
    let dir = Path::new("/sys/class/tty").join(name);
    dir.join("device").exists()
        && text(&dir.join("type")).is_none_or(|kind| kind != "0")
        && Path::new("/dev").join(name).exists()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_here_panics_whatever_the_machine_has() {
        for port in ports() {
            assert!(port.device.starts_with("/dev/"), "{port:?}");
        }
        assert!(!is_usb(Path::new("/dev/null")) && !is_usb(Path::new("/")));
        assert_eq!(latency_timer(Path::new("/dev/null"), false), None);
        assert_eq!(describe(Path::new("/dev/null")).by_id, None);
    }

    #[test]
    fn groups_are_named() {
        assert_eq!(group_name(0).as_deref(), Some("root"));
        assert_eq!(group_name(u32::MAX - 7), None);
        assert!(permission_remedy(Path::new("/nowhere")).contains("udev"));
    }

    #[test]
    fn a_holder_is_found() {
        let null = fs::File::open("/dev/null").unwrap();
        assert!(holders(Path::new("/dev/null")).iter().any(|h| h.pid == std::process::id()));
        drop(null);
        assert_eq!(Holder { pid: 7, program: "minicom".into() }.to_string(), "minicom (pid 7)");
    }
}
