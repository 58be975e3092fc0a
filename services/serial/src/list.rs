//! The serial ports of this machine: driver, adapter, names that stay, who has them open.

use std::fmt;
use std::fs;
use std::os::unix::fs::{FileTypeExt, MetadataExt};
use std::path::{Path, PathBuf};

use serde::Serialize;
use serialport::SerialPortType;

const CLASS: &str = "/sys/class/tty";

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
    Some(Path::new(CLASS).join(device.file_name()?))
}

/// Whether a USB adapter carries this device (`/dev/ttyUSB0`, links followed).
pub fn is_usb(device: &Path) -> bool {
    usb_ports().iter().any(|(name, _)| Path::new(name) == device)
}

/// The ports of USB adapters, by device.
fn usb_ports() -> Vec<(String, Usb)> {
    // `serialport` panics where there is none.
    if !Path::new(CLASS).is_dir() {
        return Vec::new();
    }
    let ports = serialport::available_ports().unwrap_or_default();
    ports.into_iter().filter_map(|port| Some((port.port_name, usb_of(port.port_type)?))).collect()
}

fn usb_of(port: SerialPortType) -> Option<Usb> {
    let SerialPortType::UsbPort(usb) = port else { return None };
    let said = |text: Option<String>| text.filter(|t| !t.is_empty());
    Some(Usb {
        vendor: format!("{:04x}", usb.vid),
        product: format!("{:04x}", usb.pid),
        manufacturer: said(usb.manufacturer),
        name: said(usb.product),
        serial: said(usb.serial_number),
    })
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

/// [`holders`] but for who made the pseudo-terminal and has its other end: a program such as socat keeps both ends open
/// and reads its own one only.
pub fn users(device: &Path) -> Vec<Holder> {
    let mut users = holders(device);
    let number = device.strip_prefix("/dev/pts").ok().and_then(|n| n.to_str()?.parse::<u32>().ok());
    if let Some(number) = number {
        users.retain(|holder| !has_other_end(holder.pid, number));
    }
    users
}

/// Whether a process has the master of a pseudo-terminal open, which the kernel tells in its `fdinfo` (Linux 5.16).
fn has_other_end(pid: u32, number: u32) -> bool {
    let Ok(descriptors) = fs::read_dir(format!("/proc/{pid}/fdinfo")) else { return false };
    descriptors
        .flatten()
        .any(|d| fs::read_to_string(d.path()).is_ok_and(|info| tty_index(&info) == Some(number)))
}

/// The number behind `tty-index:` of an `fdinfo`.
fn tty_index(info: &str) -> Option<u32> {
    info.lines().find_map(|line| line.strip_prefix("tty-index:")?.trim().parse().ok())
}

/// Who has locked the device (`flock`), so that nobody else may lock it `alone` or, if not, with others. Unlike
/// [`holders`] it sees the processes of all users.
pub fn lock_holder(device: &fs::Metadata, alone: bool) -> Option<Holder> {
    let locks = fs::read_to_string("/proc/locks").ok()?;
    let pid = locker(&locks, device.dev(), device.ino(), alone)?;
    let program = text(&Path::new("/proc").join(pid.to_string()).join("comm"));
    Some(Holder { pid, program: program.unwrap_or_else(|| "?".to_owned()) })
}

/// `1: FLOCK  ADVISORY  WRITE 1234 00:05:67 0 EOF`: kind, mode, process, file system and file.
fn locker(locks: &str, dev: u64, ino: u64, alone: bool) -> Option<u32> {
    let file = format!("{:02x}:{:02x}:{ino}", rustix::fs::major(dev), rustix::fs::minor(dev));
    locks.lines().find_map(|line| {
        let mut words = line.split_whitespace().skip(1);
        let kind = words.next()?;
        let mode = words.nth(1)?;
        let pid = words.next()?.parse().ok()?;
        let same = kind == "FLOCK" && words.next()? == file;
        (same && (alone || mode == "WRITE")).then_some(pid)
    })
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

fn describe(device: &Path, usb: Option<Usb>) -> PortInfo {
    let driver = sysfs(device)
        .and_then(|s| fs::read_link(s.join("device/driver")).ok())
        .and_then(|d| Some(d.file_name()?.to_string_lossy().into_owned()));
    let denied = rustix::fs::access(device, rustix::fs::Access::READ_OK | rustix::fs::Access::WRITE_OK);
    PortInfo {
        device: device.display().to_string(),
        by_id: by_id(device),
        driver,
        usb,
        latency_timer_ms: sysfs(device)
            .and_then(|s| text(&s.join("device/latency_timer")))
            .and_then(|t| t.parse().ok()),
        holders: holders(device),
        permission: denied.is_err().then(|| permission_remedy(device)),
    }
}

/// Every port with hardware behind it, by name.
pub fn ports() -> Vec<PortInfo> {
    let Ok(entries) = fs::read_dir(CLASS) else { return Vec::new() };
    let mut names: Vec<String> =
        entries.flatten().map(|e| e.file_name().to_string_lossy().into_owned()).collect();
    names.sort_by_key(|name| {
        (name.trim_end_matches(|c: char| c.is_ascii_digit()).to_owned(), name.len(), name.clone())
    });
    let mut usb = usb_ports();
    let mut describe = |name: &String| {
        let device = Path::new("/dev").join(name);
        let at = usb.iter().position(|(name, _)| Path::new(name) == device);
        describe(&device, at.map(|at| usb.swap_remove(at).1))
    };
    // `serialport` knows ports of some buses only, and none of their drivers.
    names.iter().filter(|name| is_port(name)).map(&mut describe).collect()
}

/// Virtual consoles have no device behind them; the kernel lists UARTs of type 0 that are not there.
fn is_port(name: &str) -> bool {
    let dir = Path::new(CLASS).join(name);
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
        assert_eq!(describe(Path::new("/dev/null"), None).by_id, None);
    }

    #[test]
    fn what_a_usb_adapter_says() {
        let said = |text: &str| Some(text.to_owned());
        let info = serialport::UsbPortInfo {
            vid: 0x403,
            pid: 0x6001,
            serial_number: said("A50285BI"),
            manufacturer: said(""),
            product: said("FT232R USB UART"),
        };
        let usb = usb_of(SerialPortType::UsbPort(info)).unwrap();
        assert_eq!((usb.vendor.as_str(), usb.product.as_str()), ("0403", "6001"));
        assert_eq!(
            (usb.manufacturer, usb.name, usb.serial),
            (None, said("FT232R USB UART"), said("A50285BI"))
        );
        assert_eq!(usb_of(SerialPortType::PciPort), None);
    }

    #[test]
    fn who_made_a_pseudo_terminal_is_no_other_user_of_it() {
        use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
        assert_eq!(tty_index("pos:\t0\nflags:\t02\ntty-index:\t17\n"), Some(17));
        assert_eq!(tty_index("pos:\t0\nino:\t3\n"), None);
        let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).unwrap();
        grantpt(&master).unwrap();
        unlockpt(&master).unwrap();
        let name = ptsname(&master, Vec::new()).unwrap().to_string_lossy().into_owned();
        let slave = fs::File::open(&name).unwrap();
        let me = |list: Vec<Holder>| list.iter().any(|h| h.pid == std::process::id());
        assert!(me(holders(Path::new(&name))));
        // Older kernels do not tell who has the master.
        let told = has_other_end(std::process::id(), name.rsplit('/').next().unwrap().parse().unwrap());
        assert_eq!(me(users(Path::new(&name))), !told);
        drop(slave);
    }

    #[test]
    fn locks_are_read() {
        let locks = "1: POSIX  ADVISORY  WRITE 7 00:05:67 0 EOF\n1: -> FLOCK ADVISORY WRITE 8 00:05:67 0 EOF\n\
            2: FLOCK  ADVISORY  READ 9 00:05:67 0 EOF\n3: FLOCK  ADVISORY  WRITE 10 fe:1a:68 0 EOF\nnonsense\n4:\n";
        let (devices, disk) = (rustix::fs::makedev(0, 5), rustix::fs::makedev(0xfe, 0x1a));
        assert_eq!(locker(locks, devices, 67, true), Some(9));
        assert_eq!(locker(locks, devices, 67, false), None);
        assert_eq!(locker(locks, disk, 68, false), Some(10));
        assert_eq!(locker(locks, disk, 67, true), None);
    }

    #[test]
    fn groups_are_named() {
        assert_eq!(group_name(0).as_deref(), Some("root"));
        assert_eq!(group_name(u32::MAX - 7), None);
        assert!(permission_remedy(Path::new("/nowhere")).contains("udev"));
    }

    #[test]
    fn the_group_that_owns_the_device_is_named() {
        let path = std::env::temp_dir().join(format!("dinrail-group-{}", std::process::id()));
        fs::write(&path, "").unwrap();
        let groups = fs::read_to_string("/etc/group").unwrap();
        let dialout =
            groups.lines().find_map(|line| line.strip_prefix("dialout:x:")?.split(':').next()?.parse().ok());
        // Only root may give a file away; else it is the group of this process.
        let given = dialout.is_some_and(|gid| std::os::unix::fs::chown(&path, None, Some(gid)).is_ok());
        let group = group_name(fs::metadata(&path).unwrap().gid()).unwrap();
        assert!(!given || group == "dialout");
        let remedy = if group == "root" {
            "it belongs to root alone: a udev rule must give it a group".to_owned()
        } else {
            format!("it belongs to group '{group}'; run `sudo usermod -aG {group} $USER`, then log in again")
        };
        assert_eq!(permission_remedy(&path), remedy);
        fs::remove_file(&path).unwrap();
    }

    #[test]
    fn a_holder_is_found() {
        let null = fs::File::open("/dev/null").unwrap();
        assert!(holders(Path::new("/dev/null")).iter().any(|h| h.pid == std::process::id()));
        drop(null);
        assert_eq!(Holder { pid: 7, program: "minicom".into() }.to_string(), "minicom (pid 7)");
    }
}
