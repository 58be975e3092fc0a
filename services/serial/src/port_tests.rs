use super::*;
use crate::character::{Flow, Parity};

pub(crate) fn options(target: Target) -> Options {
    Options {
        target,
        character: Character {
            baud: 19_200,
            data_bits: 8,
            parity: Parity::Even,
            stop_bits: 1,
            flow: Flow::None,
        },
        rs485: None,
        rts_on_send: None,
        low_latency: true,
        exclusive: true,
        verify: true,
    }
}

fn scratch(name: &str) -> PathBuf {
    std::env::temp_dir().join(format!("dinrail-serial-{name}-{}", std::process::id()))
}

fn read_all(port: &mut Port) -> Vec<u8> {
    let mut bytes = [0; 64];
    ipc_types::testing::wait("bytes", || match port.read(&mut bytes).unwrap() {
        Read::Bytes(n, 0) => Some(bytes[..n].to_vec()),
        _ => None,
    })
}

#[test]
fn targets() {
    let dir = Path::new("/stack");
    let parse = |text| Target::parse(text, dir).map(|t| t.to_string());
    assert_eq!(parse("/dev/ttyS0").as_deref(), Some("/dev/ttyS0"));
    assert_eq!(parse("pty:com1").as_deref(), Some("pty:/stack/com1"));
    assert_eq!(parse("pty:/tmp/com1").as_deref(), Some("pty:/tmp/com1"));
    assert_eq!(parse("socket://10.0.0.1:4001").as_deref(), Some("socket://10.0.0.1:4001"));
    for bad in ["", "ttyS0", "COM1", "pty:", "socket://", "socket://host", "socket://host:0", "tcp://a:1"] {
        assert_eq!(parse(bad), None, "{bad}");
    }
}

#[test]
fn a_terminal_of_our_own_and_its_other_end() {
    let link = scratch("pair");
    let mut made = Port::open(&options(Target::Terminal(link.clone()))).unwrap();
    assert_eq!(made.write(b"into the void").unwrap(), 13);
    let mut other = Port::open(&options(Target::Device(link.clone()))).unwrap();
    assert_eq!(other.kind(), Kind::Pty);
    assert!(made.visited());
    assert_eq!(made.write(b"\x01\xFF\r\n").unwrap(), 4);
    assert_eq!(read_all(&mut other), b"\x01\xFF\r\n");
    assert_eq!(other.write(b"back").unwrap(), 4);
    assert_eq!(read_all(&mut made), b"back");

    // A second one is refused and told by whom.
    let error = Port::open(&options(Target::Device(link.clone()))).unwrap_err().to_string();
    let me = std::process::id();
    assert!(error.starts_with(&format!("{} is in use by ", link.display())), "{error}");
    assert!(error.contains(&format!("(pid {me})")), "{error}");

    // The other end leaves and comes back.
    drop(other);
    let mut bytes = [0; 8];
    assert_eq!(made.read(&mut bytes).unwrap(), Read::Nobody);
    assert!(!made.visited());
    let mut other = Port::open(&options(Target::Device(link.clone()))).unwrap();
    assert!(made.visited());
    made.write(b"again").unwrap();
    assert_eq!(read_all(&mut other), b"again");

    // We leave: the other end is gone, and so is the link.
    drop(made);
    assert!(other.read(&mut bytes).is_err());
    assert!(std::fs::symlink_metadata(&link).is_err());
}

/// `echo text > line`: written and gone before anybody looked.
#[test]
fn what_a_visitor_wrote_before_leaving_is_read() {
    let link = scratch("brief");
    let mut made = Port::open(&options(Target::Terminal(link.clone()))).unwrap();
    let mut visitor = std::fs::OpenOptions::new().write(true).open(&link).unwrap();
    std::io::Write::write_all(&mut visitor, b"last words").unwrap();
    drop(visitor);
    assert!(made.visited());
    assert_eq!(read_all(&mut made), b"last words");
    assert_eq!(made.read(&mut [0; 8]).unwrap(), Read::Nobody);
    assert!(!made.visited());
}

#[test]
fn tcp() {
    let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap().to_string();
    let mut port = Port::open(&options(Target::Socket(address.clone()))).unwrap();
    let (mut peer, _) = listener.accept().unwrap();
    // A peer that vanishes with bytes on their way to it is gone as soon as a silent one.
    assert_eq!(rustix::net::sockopt::tcp_user_timeout(port.fd()).unwrap(), 20_000);
    std::io::Write::write_all(&mut peer, b"hello").unwrap();
    assert_eq!(read_all(&mut port), b"hello");
    drop(peer);
    drop(listener);
    let mut bytes = [0; 8];
    let gone = ipc_types::testing::wait("the end", || match port.read(&mut bytes) {
        Ok(_) => None,
        Err(e) => Some(e.kind()),
    });
    assert_eq!(gone, io::ErrorKind::UnexpectedEof);
}

#[test]
fn sentences() {
    let closed = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let open = |target: Target| Port::open(&options(target)).unwrap_err().to_string();
    let device = |path: &str| open(Target::Device(path.into()));
    let file = scratch("file");
    std::fs::write(&file, "x").unwrap();
    let all = [
        device("/dev/ttyNOTHERE"),
        device("/dev"),
        device("/dev/null"),
        device("/etc/hostname"),
        open(Target::Socket(closed.to_string())).replace(&closed.port().to_string(), "PORT"),
        open(Target::Terminal(file.clone())).replace(&file.display().to_string(), "FILE"),
        PortError::Permission {
            path: "/dev/ttyUSB0".into(),
            remedy: "it belongs to group 'dialout'; run `sudo usermod -aG dialout $USER`, then log in again"
                .into(),
        }
        .to_string(),
        PortError::NoRs485("/dev/ttyUSB0".into()).to_string(),
        PortError::Refused {
            path: "/dev/ttyUSB0".into(),
            wanted: "19200 5E1".into(),
            keys: "data_bits".into(),
        }
        .to_string(),
    ];
    std::fs::remove_file(file).unwrap();
    insta::assert_snapshot!(all.join("\n"), @r#"
    there is no device /dev/ttyNOTHERE: plug the adapter in; `dinrail serial list` lists ports, with names that stay the same
    /dev is no serial device; `dinrail serial list` lists ports
    /dev/null is no serial device; `dinrail serial list` lists ports
    /etc/hostname is no serial device; `dinrail serial list` lists ports
    cannot connect to socket://127.0.0.1:PORT: Connection refused (os error 111); is ser2net (or what serves the port) running, and does the address say host and port?
    cannot make a pseudo-terminal at FILE: something that is no link is there
    no permission for /dev/ttyUSB0: it belongs to group 'dialout'; run `sudo usermod -aG dialout $USER`, then log in again
    /dev/ttyUSB0: its driver cannot switch an RS-485 transmitter (rs485 = "kernel"): use rs485 = "adapter" if the adapter switches by itself, as most USB ones do, or rs485 = "rts" to let dinrail switch RTS
    /dev/ttyUSB0 does not take 19200 5E1: data_bits read back otherwise; use settings that its chip has, or verify = false
    "#);
}

#[test]
fn marks_count_where_the_counters_of_an_adapter_stand_still() {
    use serial_flag::{BREAK, FRAMING, OVERRUN, PARITY};
    for (counted, marked, more) in [
        (0, 0, 0),
        (0, PARITY, PARITY),
        (0, PARITY | BREAK, PARITY | BREAK),
        (OVERRUN, PARITY, PARITY),
        // The counters know which it was.
        (FRAMING, PARITY, 0),
        (PARITY, PARITY, 0),
        (BREAK, BREAK, 0),
    ] {
        assert_eq!(unseen(counted, marked), more, "{counted:x} {marked:x}");
    }
}
