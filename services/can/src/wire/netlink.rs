//! Bit rate, state and counters of a CAN interface by netlink, with the sentences for what cannot be done.

use std::io;

use socketcan::nl::{CanCtrlMode, CanInterface, CanState, Mtu};
use thiserror::Error;

use crate::protocol::error_frame::ControllerState;

/// Why an interface cannot be used.
#[derive(Debug, Error)]
pub enum LinkError {
    /// Not there.
    #[error(
        "there is no interface '{name}' ({known}): plug the adapter in or load its driver; `ip link add dev {name} type vcan` makes one without hardware"
    )]
    Absent {
        /// Its name.
        name: String,
        /// The CAN interfaces that are there.
        known: String,
    },
    /// The kernel has no CAN.
    #[error(
        "this kernel has no SocketCAN: load it with `modprobe can_raw`, or use backend = \"slcan\" for a serial adapter"
    )]
    NoCan,
    /// Another kind of interface.
    #[error("interface '{0}' is no CAN interface")]
    NotCan(String),
    /// Down, and may not be raised by us.
    #[error("interface {name} is down: run `{command}`{why}")]
    Down {
        /// Its name.
        name: String,
        /// What raises it.
        command: String,
        /// Why the driver does not do it.
        why: &'static str,
    },
    /// Anything else.
    #[error("interface {name}: {what}: {source}")]
    System {
        /// Its name.
        name: String,
        /// What was attempted.
        what: &'static str,
        /// The system's reason.
        source: io::Error,
    },
}

/// What an interface shall be like.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Wanted {
    /// Its name.
    pub name: String,
    /// Nominal bit rate in bit/s.
    pub bitrate: u32,
    /// Data bit rate in bit/s.
    pub data_bitrate: u32,
    /// CAN FD: must be on, must be off, as it is.
    pub fd: Option<bool>,
    /// Pause before the restart after bus-off in ms; 0 = never.
    pub restart_ms: u32,
    /// Set what differs, where permitted.
    pub configure: bool,
}

/// What an interface is like.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Interface {
    /// Its number; another one after it was pulled and plugged in.
    pub index: u32,
    /// Up.
    pub up: bool,
    /// Carries CAN FD.
    pub fd: bool,
    /// Bit rate in bit/s; a virtual interface has none.
    pub bitrate: Option<u32>,
    /// Data bit rate in bit/s.
    pub data_bitrate: Option<u32>,
    /// Has a controller with a bit rate that can be set.
    pub settable: bool,
    /// Belongs to a device. Serial line disciplines (slcan, can327) do not.
    pub device: bool,
    /// The kernel's own pause before a restart; 0 = it restarts never.
    pub restart_ms: Option<u32>,
    /// State of the controller.
    pub state: Option<ControllerState>,
    /// TEC and REC.
    pub counters: Option<(u16, u16)>,
}

fn system(name: &str, what: &'static str) -> impl FnOnce(socketcan::Error) -> LinkError {
    let name = name.to_owned();
    move |e| LinkError::System { name, what, source: to_io(e) }
}

fn to_io(e: socketcan::Error) -> io::Error {
    match e {
        socketcan::Error::Io(e) => e,
        socketcan::Error::Nl(e) => {
            e.errno().map_or_else(|| io::Error::other(e.to_string()), io::Error::from_raw_os_error)
        }
        e @ socketcan::Error::Can(_) => io::Error::other(e.to_string()),
    }
}

/// This process may not do that.
pub(super) fn denied(e: &LinkError) -> bool {
    matches!(e, LinkError::System { source, .. } if source.kind() == io::ErrorKind::PermissionDenied)
}

fn open(name: &str) -> Result<CanInterface, LinkError> {
    CanInterface::open(name).map_err(|_| {
        if supported() {
            LinkError::Absent { name: name.to_owned(), known: known() }
        } else {
            LinkError::NoCan
        }
    })
}

/// The CAN interfaces of this machine, for messages: "there are: can0, vcan0".
pub fn known() -> String {
    const ARPHRD_CAN: &str = "280";
    let entries = std::fs::read_dir("/sys/class/net").into_iter().flatten().flatten();
    let mut names: Vec<_> = entries
        .filter(|e| std::fs::read_to_string(e.path().join("type")).is_ok_and(|t| t.trim() == ARPHRD_CAN))
        .map(|e| e.file_name().to_string_lossy().into_owned())
        .collect();
    names.sort();
    match &names[..] {
        [] => "there is no CAN interface at all".to_owned(),
        names => format!("CAN interfaces here: {}", names.join(", ")),
    }
}

/// Looks at an interface.
pub fn look(name: &str) -> Result<Interface, LinkError> {
    let details = open(name)?.details().map_err(system(name, "asking the kernel about it"))?;
    let can = details.can;
    let state = can.state.and_then(|state| match state {
        CanState::ErrorActive => Some(ControllerState::Active),
        CanState::ErrorWarning => Some(ControllerState::Warning),
        CanState::ErrorPassive => Some(ControllerState::Passive),
        CanState::BusOff => Some(ControllerState::BusOff),
        CanState::Stopped | CanState::Sleeping => None,
    });
    Ok(Interface {
        index: details.index,
        up: details.is_up,
        fd: details.mtu == Some(Mtu::Fd),
        // slcand's interfaces say 2^32-1 for a rate that nobody told them.
        bitrate: can.bit_timing.map(|t| t.bitrate).filter(|&rate| rate > 0 && rate < u32::MAX),
        data_bitrate: can.data_bit_timing.map(|t| t.bitrate).filter(|&rate| rate > 0),
        settable: can.clock.is_some() || can.bit_timing_const.is_some(),
        device: std::path::Path::new("/sys/class/net").join(name).join("device").exists(),
        restart_ms: can.restart_ms,
        state,
        counters: can.berr_counter.map(|c| (c.txerr, c.rxerr)),
    })
}

/// The command that makes the interface as wanted.
pub fn command(wanted: &Wanted, is: &Interface) -> String {
    let mut text = format!("ip link set {} up", wanted.name);
    if is.settable {
        text += &format!(" type can bitrate {}", wanted.bitrate);
        if wanted.fd == Some(true) {
            text += &format!(" dbitrate {} fd on", wanted.data_bitrate);
        }
        // Kernels before 6.16 crash when a line discipline is to be restarted.
        if wanted.restart_ms > 0 && is.device {
            text += &format!(" restart-ms {}", wanted.restart_ms);
        }
    }
    text
}

/// What differs, for people; empty when nothing does.
pub fn differences(wanted: &Wanted, is: &Interface) -> Vec<String> {
    let mut all = Vec::new();
    if let Some(bitrate) = is.bitrate
        && bitrate != wanted.bitrate
    {
        all.push(format!("its bit rate is {bitrate}, the stack file says {}", wanted.bitrate));
    }
    if wanted.fd == Some(true) && !is.fd {
        all.push("it does not carry CAN FD, the stack file says fd = true".to_owned());
    }
    if wanted.fd == Some(true)
        && let Some(rate) = is.data_bitrate
        && rate != wanted.data_bitrate
    {
        all.push(format!("its data bit rate is {rate}, the stack file says {}", wanted.data_bitrate));
    }
    all
}

/// Brings an interface into the state wanted, as far as permitted, and says what was done or is left to do.
pub fn prepare(wanted: &Wanted) -> Result<(Interface, Option<String>), LinkError> {
    let is = look(&wanted.name)?;
    let differ = differences(wanted, &is);
    let no_rate_yet = is.settable && is.bitrate.is_none();
    if is.up && differ.is_empty() {
        return Ok((is, None));
    }
    if wanted.configure {
        match set(wanted, &is, !differ.is_empty() || no_rate_yet) {
            Ok(done) => return Ok((look(&wanted.name)?, Some(done))),
            Err(e) if !denied(&e) => return Err(e),
            Err(_) => {}
        }
    }
    let command = command(wanted, &is);
    if !is.up {
        let why = if wanted.configure {
            " as root, or give this process CAP_NET_ADMIN"
        } else {
            ", because configure = false leaves that to you"
        };
        return Err(LinkError::Down { name: wanted.name.clone(), command, why });
    }
    let note = format!(
        "interface {}: {}; it is used as it is. To change it: `ip link set {} down`, then `{command}`",
        wanted.name,
        differ.join("; "),
        wanted.name
    );
    Ok((is, Some(note)))
}

fn set(wanted: &Wanted, is: &Interface, timing: bool) -> Result<String, LinkError> {
    let name = &wanted.name;
    let link = open(name)?;
    if is.settable && timing {
        if is.up {
            link.bring_down().map_err(system(name, "taking it down to set its bit rate"))?;
        }
        link.set_bitrate(wanted.bitrate, None).map_err(system(name, "setting its bit rate"))?;
        if wanted.fd == Some(true) {
            link.set_data_bitrate(wanted.data_bitrate, None)
                .map_err(system(name, "setting its data bit rate"))?;
            link.set_ctrlmode(CanCtrlMode::Fd, true).map_err(system(name, "switching CAN FD on"))?;
        }
    }
    if is.settable && is.restart_ms.is_some_and(|ms| ms > 0) {
        // Who may set the bit rate may restart: the kernel's own restart knows no back-off.
        let _ = link.set_restart_ms(0);
    }
    link.bring_up().map_err(system(name, "raising it"))?;
    Ok(format!(
        "interface {name}: did what `{}` does",
        command(&Wanted { restart_ms: 0, ..wanted.clone() }, is)
    ))
}

/// Restarts the controller after bus-off. A line discipline has no restart (and kernels before 6.16 crash when asked for
/// one): it is taken down and raised again.
pub fn restart(name: &str, is: &Interface) -> Result<(), LinkError> {
    let link = open(name)?;
    if is.device {
        return link.restart().map_err(system(name, "restarting it after bus-off"));
    }
    link.bring_down().map_err(system(name, "taking it down after bus-off"))?;
    link.bring_up().map_err(system(name, "raising it after bus-off"))
}

/// Whether this kernel has CAN.
pub fn supported() -> bool {
    use rustix::net::{AddressFamily, Protocol, SocketType, socket};
    let family = AddressFamily::from_raw(libc::AF_CAN as u16);
    let raw = Protocol::from_raw(std::num::NonZero::<u32>::MIN);
    // Any other refusal is not the kernel's lack of it.
    let lacks = [rustix::io::Errno::AFNOSUPPORT, rustix::io::Errno::PROTONOSUPPORT];
    !socket(family, SocketType::RAW, Some(raw)).is_err_and(|e| lacks.contains(&e))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn wanted() -> Wanted {
        Wanted {
            name: "can0".into(),
            bitrate: 500_000,
            data_bitrate: 2_000_000,
            fd: None,
            restart_ms: 100,
            configure: true,
        }
    }

    #[test]
    fn what_differs() {
        let is = Interface { up: true, bitrate: Some(250_000), settable: true, ..Interface::default() };
        assert_eq!(differences(&wanted(), &is), ["its bit rate is 250000, the stack file says 500000"]);
        assert_eq!(differences(&wanted(), &Interface { bitrate: None, ..is }), Vec::<String>::new());
        let fd = Wanted { fd: Some(true), ..wanted() };
        let is = Interface { bitrate: Some(500_000), data_bitrate: Some(5_000_000), ..is };
        assert_eq!(
            differences(&fd, &is),
            [
                "it does not carry CAN FD, the stack file says fd = true",
                "its data bit rate is 5000000, the stack file says 2000000"
            ]
        );
        assert_eq!(
            command(&fd, &Interface { settable: true, device: true, ..Interface::default() }),
            "ip link set can0 up type can bitrate 500000 dbitrate 2000000 fd on restart-ms 100"
        );
        assert_eq!(command(&wanted(), &Interface::default()), "ip link set can0 up");
        let line = Interface { settable: true, ..Interface::default() };
        assert_eq!(command(&wanted(), &line), "ip link set can0 up type can bitrate 500000");
    }

    #[test]
    fn sentences() {
        let all = [
            LinkError::Absent { name: "can7".into(), known: "CAN interfaces here: can0, vcan0".into() },
            LinkError::NoCan,
            LinkError::NotCan("eth0".into()),
            LinkError::Down {
                name: "can0".into(),
                command: command(
                    &wanted(),
                    &Interface { settable: true, device: true, ..Interface::default() },
                ),
                why: " as root, or give this process CAP_NET_ADMIN",
            },
            LinkError::System {
                name: "can0".into(),
                what: "setting its bit rate",
                source: io::ErrorKind::InvalidInput.into(),
            },
        ];
        insta::assert_snapshot!(all.map(|e| e.to_string()).join("\n"), @r#"
        there is no interface 'can7' (CAN interfaces here: can0, vcan0): plug the adapter in or load its driver; `ip link add dev can7 type vcan` makes one without hardware
        this kernel has no SocketCAN: load it with `modprobe can_raw`, or use backend = "slcan" for a serial adapter
        interface 'eth0' is no CAN interface
        interface can0 is down: run `ip link set can0 up type can bitrate 500000 restart-ms 100` as root, or give this process CAP_NET_ADMIN
        interface can0: setting its bit rate: invalid input parameter
        "#);
    }

    #[test]
    fn an_interface_that_is_not_there() {
        let error = prepare(&Wanted { name: "nocan42".into(), ..wanted() }).unwrap_err();
        // A kernel without CAN is named first: then there is nothing to plug in.
        assert_eq!(matches!(error, LinkError::Absent { .. }), supported(), "{error}");
        assert_eq!(matches!(error, LinkError::NoCan), !supported(), "{error}");
    }
}
