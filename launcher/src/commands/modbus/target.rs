//! Where the commands of `dinrail modbus` go: a connection, a serial port, or a service of a running stack.

use super::MasterArgs;
use crate::commands::UsageError;
use crate::supervise::client::{find, observe};
use crate::supervise::jobs::{JobError, JobLine, choose};
use anyhow::Context as _;
use dinrail_modbus::client::ask::{Ask, exception_words};
use dinrail_modbus::protocol::client_fit::{Fit, Length, fit, length};
use dinrail_modbus::protocol::mbap::{self, Scan};
use dinrail_modbus::protocol::{ascii, rtu};
use dinrail_serial::config::{Config as SerialConfig, Framing};
use dinrail_serial::port::{Port, Read as PortRead};
use ipc_types::stack::Severity;
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::net::{RecvFlags, recv};
use serde_json::Value;
use std::io::{Read, Write};
use std::net::{TcpStream, ToSocketAddrs};
use std::path::Path;
use std::time::{Duration, Instant};

/// Services that carry out any function.
const KIND: &str = "modbus-client";
/// Longer than the service's own limits, which it reports better.
const SERVICE_LIMIT: Duration = Duration::from_secs(20);

/// Why there is no value.
#[derive(Debug)]
pub enum Failed {
    /// The unit's or gateway's exception.
    Exception(u8, String),
    NoAnswer(String),
    Other(String),
}

impl std::fmt::Display for Failed {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Exception(_, text) | Self::NoAnswer(text) | Self::Other(text) => f.write_str(text),
        }
    }
}

enum Wire {
    Tcp { stream: TcpStream, transaction: u16 },
    RtuOverTcp(TcpStream),
    Serial { port: Box<Port>, ascii: bool, char_ns: u64, t35: Duration },
    Service { name: String, line: Box<JobLine> },
}

/// A request whose answer may still come, and until when. On Modbus TCP answers have numbers.
struct Late {
    unit: u8,
    pdu: Vec<u8>,
    until: Instant,
}

impl Late {
    /// Whether its answer could be taken for the answer to this request.
    fn confuses(&self, unit: u8, pdu: &[u8]) -> bool {
        (self.unit, self.pdu.first()) == (unit, pdu.first()) && self.pdu != pdu
    }
}

/// A master with its unit.
pub struct Master {
    wire: Wire,
    target: String,
    unit: Value,
    timeout: Duration,
    retries: u8,
    late: Option<Late>,
}

impl Master {
    /// Opens the line; nothing is sent yet.
    pub fn open(args: &MasterArgs) -> anyhow::Result<Self> {
        let unit = match args.unit.parse::<u8>() {
            Ok(number) => Value::from(number),
            Err(_) => Value::from(args.unit.clone()),
        };
        let timeout = args.timeout.duration();
        if args.target.contains("://") && !unit.is_u64() {
            return Err(UsageError(format!("unit '{}' is no number from 0 to 255", args.unit)).into());
        }
        let wire = match args.target.split_once("://") {
            Some(("tcp", address)) => Wire::Tcp { stream: connect(address, 502, timeout)?, transaction: 0 },
            Some(("rtu-over-tcp", address)) => Wire::RtuOverTcp(connect(address, 502, timeout)?),
            Some(("rtu", device)) => serial(device, false)?,
            Some(("ascii", device)) => serial(device, true)?,
            Some((scheme, _)) => {
                return Err(UsageError(format!(
                    "'{scheme}://' is none of tcp://, rtu://, ascii://, rtu-over-tcp://"
                ))
                .into());
            }
            None if args.target.contains(['/', '.', ':']) => return Err(no_scheme(&args.target).into()),
            None => service(&args.target, args.stack.as_deref())?,
        };
        Ok(Self { wire, target: args.target.clone(), unit, timeout, retries: args.retries, late: None })
    }

    /// One request, as [`Ask`] describes it.
    pub fn ask(&mut self, job: &Value) -> anyhow::Result<Value> {
        self.try_ask(job).map_err(|e| anyhow::anyhow!("{}: {e}", self.target))
    }

    /// The same with a cause that can be told apart.
    pub fn try_ask(&mut self, job: &Value) -> Result<Value, Failed> {
        let unit = self.unit.clone();
        self.ask_unit(&unit, job)
    }

    /// The same to another unit.
    pub fn ask_unit(&mut self, unit: &Value, job: &Value) -> Result<Value, Failed> {
        let ask = Ask::from_json(job).map_err(|e| Failed::Other(e.to_string()))?;
        if let Wire::Service { line, .. } = &mut self.wire {
            let mut job = job.clone();
            job["unit"] = unit.clone();
            return through_service(line, &job);
        }
        let unit = unit.as_u64().unwrap_or(0) as u8;
        let mut last = Failed::NoAnswer("no answer".to_owned());
        if let Some(late) = self.late.take_if(|late| late.confuses(unit, ask.pdu())) {
            std::thread::sleep(late.until.saturating_duration_since(Instant::now()));
        }
        let numbered = matches!(self.wire, Wire::Tcp { .. });
        let mut unanswered = false;
        for _ in 0..=self.retries {
            let outcome = self.once(unit, ask.pdu());
            unanswered |= matches!(outcome, Err(Failed::NoAnswer(_)));
            if unanswered && !numbered {
                // One of the tries may be answered behind the answer to the other.
                let until = Instant::now() + self.timeout * 2;
                self.late = Some(Late { unit, pdu: ask.pdu().to_vec(), until });
            }
            match outcome {
                Ok(pdu) => {
                    return match fit(ask.pdu(), &pdu) {
                        Fit::Exception(code) => {
                            Err(Failed::Exception(code, exception_words(code, ask.pdu()[0])))
                        }
                        _ => ask.explain(&pdu).map_err(Failed::Other),
                    };
                }
                Err(failed @ Failed::NoAnswer(_)) => last = failed,
                Err(failed) => return Err(failed),
            }
        }
        if let Failed::NoAnswer(text) = last {
            return Err(Failed::NoAnswer(format!("unit {unit}: {text}. {}", self.why_silent())));
        }
        Err(last)
    }

    /// What to look at when nobody answers.
    pub fn why_silent(&self) -> String {
        match &self.wire {
            Wire::Tcp { .. } => "The connection stands, so address and port are right; is the unit id? \
                                 A gateway stays silent for units that it does not know."
                .to_owned(),
            Wire::RtuOverTcp(_) => "The connection stands; does the converter pass bytes on unchanged, and are its \
                                    baud rate and parity those of the line?"
                .to_owned(),
            Wire::Serial { .. } => "Look at: unit id, A and B exchanged, baud rate and parity, RTU or ASCII, \
                                    termination, the adapter's direction switching, another master on the line."
                .to_owned(),
            Wire::Service { name, .. } => format!("`dinrail status` shows what service '{name}' sees."),
        }
    }

    fn once(&mut self, unit: u8, pdu: &[u8]) -> Result<Vec<u8>, Failed> {
        let timeout = self.timeout;
        let io = |e: std::io::Error| Failed::Other(e.to_string());
        match &mut self.wire {
            Wire::Tcp { stream, transaction } => {
                *transaction = transaction.wrapping_add(1);
                let mut frame = [0; mbap::MAX_ADU];
                let len = mbap::encode(*transaction, unit, pdu, &mut frame).unwrap_or(0);
                stream.write_all(&frame[..len]).map_err(io)?;
                let sent = *transaction;
                read_stream(stream, timeout, |bytes| {
                    loop {
                        match mbap::scan(bytes) {
                            Scan::Frame { frame, .. } if frame.transaction == sent && frame.unit == unit => {
                                return Some(Ok(frame.pdu.to_vec()));
                            }
                            // A late answer to an earlier request.
                            Scan::Frame { used, .. } | Scan::Foreign { used } => {
                                bytes.drain(..used);
                            }
                            Scan::Incomplete => return None,
                            Scan::BadLength { length } => {
                                return Some(Err(format!("the answer has an impossible length, {length}")));
                            }
                        }
                    }
                })
            }
            Wire::RtuOverTcp(stream) => {
                let mut frame = [0; rtu::MAX_ADU];
                let len = rtu::encode(unit, pdu, &mut frame);
                // What came unasked is no answer.
                let mut some = [0_u8; 512];
                while matches!(recv(&*stream, &mut some, RecvFlags::DONTWAIT), Ok((1.., _))) {}
                stream.write_all(&frame[..len]).map_err(io)?;
                if unit == 0 {
                    return Ok(Vec::new());
                }
                read_stream(stream, timeout, |bytes| found_rtu(unit, pdu, bytes).map(Ok))
            }
            Wire::Serial { port, ascii, char_ns, t35 } => {
                let (ascii, char_ns, t35) = (*ascii, *char_ns, *t35);
                // What came unasked is no answer.
                let mut some = [0; 512];
                while matches!(port.read(&mut some).map_err(io)?, PortRead::Bytes(..)) {}
                std::thread::sleep(t35);
                let frame = if ascii {
                    let mut frame = [0; ascii::MAX_ADU];
                    let len = ascii::encode(unit, pdu, &mut frame);
                    frame[..len].to_vec()
                } else {
                    let mut frame = [0; rtu::MAX_ADU];
                    let len = rtu::encode(unit, pdu, &mut frame);
                    frame[..len].to_vec()
                };
                send_serial(port, &frame, char_ns).map_err(io)?;
                if unit == 0 {
                    // Units carry it out; nobody answers.
                    std::thread::sleep(Duration::from_millis(200));
                    return Ok(Vec::new());
                }
                read_serial(port, timeout, |bytes| {
                    if ascii { found_ascii(unit, pdu, bytes) } else { found_rtu(unit, pdu, bytes) }
                })
            }
            Wire::Service { .. } => Err(Failed::Other("a service takes jobs".to_owned())),
        }
    }
}

/// A device or an address that stands there as it is; names of services have no such characters.
fn no_scheme(target: &str) -> UsageError {
    if target.contains('/') {
        return UsageError(format!("write rtu://{target} or ascii://{target} for a serial device"));
    }
    UsageError(format!("write tcp://{target} for a device, or rtu-over-tcp://{target} for a converter"))
}

/// Host and port of an address, which may lack the port.
fn host_and_port(address: &str, port: u16) -> Result<String, UsageError> {
    let address = address.trim_end_matches('/');
    let (host, digits) = match address.rsplit_once(':') {
        // The colon of an IPv6 address belongs to it.
        Some((host, digits)) if !address.ends_with(']') && !host.ends_with(':') => (host, Some(digits)),
        _ => (address, None),
    };
    let whole_v6 = host.contains(':') && !host.starts_with('[');
    let port = match digits {
        Some(digits) if !whole_v6 => digits.parse::<u16>().ok().filter(|&port| port > 0),
        _ => Some(port),
    };
    match port {
        _ if host.is_empty() => {
            Err(UsageError("the address lacks a host: write tcp://192.168.1.20".to_owned()))
        }
        None => Err(UsageError(format!("'{address}': a port is a number from 1 to 65535"))),
        Some(port) if whole_v6 => Ok(format!("[{address}]:{port}")),
        Some(port) => Ok(format!("{host}:{port}")),
    }
}

fn connect(address: &str, port: u16, timeout: Duration) -> anyhow::Result<TcpStream> {
    let whole = host_and_port(address, port)?;
    let mut last = None;
    for resolved in whole.to_socket_addrs().with_context(|| format!("'{whole}' is no address"))? {
        match TcpStream::connect_timeout(&resolved, timeout.max(Duration::from_millis(100))) {
            Ok(stream) => {
                stream.set_nodelay(true)?;
                return Ok(stream);
            }
            Err(e) => last = Some(e),
        }
    }
    let cause = last.map_or_else(|| "no such host".to_owned(), |e| e.to_string());
    anyhow::bail!("connecting to {whole}: {cause}; is the device on, the port right, a filter in between?")
}

/// `/dev/ttyUSB0?baud=9600&parity=none&stop=2&data=8`.
fn serial(text: &str, ascii: bool) -> anyhow::Result<Wire> {
    let (device, query) = text.split_once('?').unwrap_or((text, ""));
    let mut config = SerialConfig::of_device(device);
    config.framing = if ascii { Framing::Ascii } else { Framing::Rtu };
    for pair in query.split('&').filter(|pair| !pair.is_empty()) {
        let (key, value) = pair.split_once('=').unwrap_or((pair, ""));
        let wrong =
            || UsageError(format!("'{pair}': write baud=9600, parity=none|even|odd, stop=1|2, data=7|8"));
        match key {
            "baud" => config.baud = Some(value.parse().map_err(|_| wrong())?),
            "parity" => {
                config.parity = Some(serde_json::from_value(Value::from(value)).map_err(|_| wrong())?);
            }
            "stop" | "stop_bits" => config.stop_bits = Some(value.parse().map_err(|_| wrong())?),
            "data" | "data_bits" => config.data_bits = Some(value.parse().map_err(|_| wrong())?),
            _ => return Err(wrong().into()),
        }
    }
    let options = config
        .options(Path::new("."))
        .ok_or_else(|| UsageError(format!("'{device}' is no device: write rtu:///dev/ttyUSB0")))?;
    let findings = config.findings("", Path::new("."));
    if let Some(error) = findings.iter().find(|f| f.severity == Severity::Error) {
        return Err(UsageError(format!("{}; {}", error.message, error.help)).into());
    }
    let port = Port::open(&options)?;
    for note in port.notes() {
        eprintln!("dinrail: {note}");
    }
    let timing = config.timing();
    Ok(Wire::Serial {
        port: Box::new(port),
        ascii,
        char_ns: timing.char_ns,
        t35: Duration::from_nanos(timing.t35_ns),
    })
}

fn service(name: &str, stack: Option<&str>) -> anyhow::Result<Wire> {
    let running = find(stack)?;
    let mut ctx = observe(&running).context("asking a modbus-client of a running stack")?;
    let service = choose(&ctx, KIND, Some(name))
        .map_err(|e| anyhow::anyhow!("{e}. A device is written tcp://HOST or rtu:///dev/..."))?;
    let line = Box::new(JobLine::open(&mut ctx, running, KIND, &service)?);
    Ok(Wire::Service { name: service, line })
}

fn through_service(line: &mut JobLine, job: &Value) -> Result<Value, Failed> {
    let text = match line.ask(job, SERVICE_LIMIT) {
        Ok(value) => return Ok(value),
        Err(JobError::Refused { text, .. }) => text,
        Err(other) => return Err(Failed::Other(other.to_string())),
    };
    let code = text.strip_prefix("exception ").and_then(|rest| u8::from_str_radix(rest.get(..2)?, 16).ok());
    Err(match code {
        Some(code) => Failed::Exception(code, text),
        None if text.starts_with("no answer") => Failed::NoAnswer(text),
        None => Failed::Other(text),
    })
}

/// Reads until `found` has something or the time is over.
fn read_stream(
    stream: &mut TcpStream,
    timeout: Duration,
    mut found: impl FnMut(&mut Vec<u8>) -> Option<Result<Vec<u8>, String>>,
) -> Result<Vec<u8>, Failed> {
    let end = Instant::now() + timeout;
    let mut bytes = Vec::new();
    let mut some = [0; 512];
    loop {
        let left = end.saturating_duration_since(Instant::now());
        if left.is_zero() {
            return Err(silent(timeout, bytes.len()));
        }
        stream.set_read_timeout(Some(left)).map_err(|e| Failed::Other(e.to_string()))?;
        match stream.read(&mut some) {
            Ok(0) => return Err(Failed::Other("the other side closed the connection".to_owned())),
            Ok(n) => bytes.extend_from_slice(&some[..n]),
            Err(e) if matches!(e.kind(), std::io::ErrorKind::WouldBlock | std::io::ErrorKind::TimedOut) => {
                return Err(silent(timeout, bytes.len()));
            }
            Err(e) if e.kind() == std::io::ErrorKind::Interrupted => {}
            Err(e) => return Err(Failed::Other(e.to_string())),
        }
        if let Some(result) = found(&mut bytes) {
            return result.map_err(Failed::Other);
        }
    }
}

fn silent(timeout: Duration, bytes: usize) -> Failed {
    if bytes == 0 {
        Failed::NoAnswer(format!("no answer within {timeout:?}"))
    } else {
        Failed::NoAnswer(format!("{bytes} bytes came within {timeout:?} that are no answer"))
    }
}

fn send_serial(port: &mut Port, frame: &[u8], char_ns: u64) -> std::io::Result<()> {
    port.transmitter(true)?;
    let mut left = frame;
    let end = Instant::now() + Duration::from_secs(5) + Duration::from_nanos(char_ns * frame.len() as u64);
    while !left.is_empty() || !port.is_drained()? {
        let n = if left.is_empty() { 0 } else { port.write(left)? };
        left = &left[n..];
        if Instant::now() > end {
            return Err(std::io::ErrorKind::TimedOut.into());
        }
        if n == 0 {
            std::thread::sleep(Duration::from_micros(200));
        }
    }
    port.transmitter(false)
}

fn read_serial(
    port: &mut Port,
    timeout: Duration,
    mut found: impl FnMut(&mut Vec<u8>) -> Option<Vec<u8>>,
) -> Result<Vec<u8>, Failed> {
    let end = Instant::now() + timeout;
    let mut bytes = Vec::new();
    let mut some = [0; 512];
    let other = |e: std::io::Error| Failed::Other(e.to_string());
    loop {
        let left = end.saturating_duration_since(Instant::now());
        if left.is_zero() {
            return Err(silent(timeout, bytes.len()));
        }
        let wait = Timespec { tv_sec: left.as_secs() as i64, tv_nsec: i64::from(left.subsec_nanos()) };
        let mut fds = [PollFd::from_borrowed_fd(port.fd(), PollFlags::IN)];
        let _ = poll(&mut fds, Some(&wait));
        match port.read(&mut some).map_err(other)? {
            PortRead::Bytes(n, _) => bytes.extend_from_slice(&some[..n]),
            PortRead::Nothing => {}
            PortRead::Nobody => std::thread::sleep(Duration::from_millis(5)),
        }
        if let Some(pdu) = found(&mut bytes) {
            return Ok(pdu);
        }
    }
}

/// The answer of the unit in a stream of RTU bytes, wherever it begins.
fn found_rtu(unit: u8, request: &[u8], bytes: &[u8]) -> Option<Vec<u8>> {
    (0..bytes.len()).filter(|&start| bytes[start] == unit).find_map(|start| {
        let rest = &bytes[start..];
        let end = match length(request, &rest[1..]) {
            Length::Exactly(len) => len + 3,
            Length::AtLeast(_) => return None,
            Length::Unknown => rest.len(),
        };
        let (_, pdu) = rtu::decode(rest.get(..end)?).ok()?;
        (fit(request, pdu) != Fit::No).then(|| pdu.to_vec())
    })
}

/// The answer of the unit in a stream of ASCII characters, whatever stands before it.
fn found_ascii(unit: u8, request: &[u8], bytes: &[u8]) -> Option<Vec<u8>> {
    bytes.split_inclusive(|&b| b == b'\n').find_map(|line| {
        let start = line.iter().rposition(|&b| b == b':')?;
        let mut out = [0; 256];
        let (from, pdu) = ascii::decode(&line[start..], &mut out).ok()?;
        (from == unit && fit(request, pdu) != Fit::No).then(|| pdu.to_vec())
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn answers_are_found_behind_noise() {
        let mut frame = [0; rtu::MAX_ADU];
        let len = rtu::encode(5, &[3, 2, 0, 7], &mut frame);
        let request = [3, 0, 0, 0, 1];
        let mut bytes = vec![0, 5, 9];
        assert_eq!(found_rtu(5, &request, &bytes), None);
        bytes.extend(&frame[..len]);
        assert_eq!(found_rtu(5, &request, &bytes), Some(vec![3, 2, 0, 7]));
        assert_eq!(found_rtu(6, &request, &bytes), None);
        let mut frame = [0; ascii::MAX_ADU];
        let len = ascii::encode(5, &[3, 2, 0, 7], &mut frame);
        let mut bytes = b":05".to_vec();
        bytes.extend(&frame[..len]);
        assert_eq!(found_ascii(5, &request, &bytes), Some(vec![3, 2, 0, 7]));
        assert_eq!(found_ascii(5, &request, &bytes[..bytes.len() - 1]), None);
        assert_eq!(found_ascii(6, &request, &bytes), None);
        // Behind the end of somebody else's frame, a broken one, and an answer to something else.
        for noise in ["0203FB\r\n", ":0203FB\r\n", ":05\r\n", ":058304ZZ\r\n", ":0503040000000 0F4\r\n"] {
            let bytes = [noise.as_bytes(), &bytes].concat();
            assert_eq!(found_ascii(5, &request, &bytes), Some(vec![3, 2, 0, 7]), "{noise}");
        }
    }

    #[test]
    fn addresses_of_the_command_line() {
        for (text, whole) in [
            ("10.0.0.1", "10.0.0.1:502"),
            ("10.0.0.1:1502", "10.0.0.1:1502"),
            ("plant/", "plant:502"),
            ("[::1]", "[::1]:502"),
            ("[::1]:1502", "[::1]:1502"),
            ("::1", "[::1]:502"),
            ("fe80::", "[fe80::]:502"),
        ] {
            assert_eq!(host_and_port(text, 502).unwrap(), whole, "{text}");
        }
        let wrong: Vec<String> = ["", ":502", "10.0.0.1:", "10.0.0.1:99999", "10.0.0.1:0", "plant:modbus"]
            .iter()
            .map(|text| host_and_port(text, 502).unwrap_err().0)
            .chain(["127.0.0.1", "plant:502", "/dev/ttyUSB0"].map(|text| no_scheme(text).0))
            .collect();
        insta::assert_snapshot!(wrong.join("\n"), @r#"
        the address lacks a host: write tcp://192.168.1.20
        the address lacks a host: write tcp://192.168.1.20
        '10.0.0.1:': a port is a number from 1 to 65535
        '10.0.0.1:99999': a port is a number from 1 to 65535
        '10.0.0.1:0': a port is a number from 1 to 65535
        'plant:modbus': a port is a number from 1 to 65535
        write tcp://127.0.0.1 for a device, or rtu-over-tcp://127.0.0.1 for a converter
        write tcp://plant:502 for a device, or rtu-over-tcp://plant:502 for a converter
        write rtu:///dev/ttyUSB0 or ascii:///dev/ttyUSB0 for a serial device
        "#);
    }

    /// A unit behind a converter that answers each request after so long; registers show their address.
    fn slow_unit(answers: u32, after: Duration) -> (String, std::thread::JoinHandle<()>) {
        let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        let target = format!("rtu-over-tcp://{}", listener.local_addr().unwrap());
        let unit = std::thread::spawn(move || {
            let (mut stream, _) = listener.accept().unwrap();
            for _ in 0..answers {
                let mut request = [0; 8];
                if stream.read_exact(&mut request).is_err() {
                    return;
                }
                std::thread::sleep(after);
                let mut frame = [0; rtu::MAX_ADU];
                let len = rtu::encode(request[0], &[3, 2, request[2], request[3]], &mut frame);
                if stream.write_all(&frame[..len]).is_err() {
                    return;
                }
            }
        });
        (target, unit)
    }

    #[test]
    fn a_late_answer_is_not_the_next_one_s() {
        // Slower than the timeout: the answer to the first try comes during the second, and that one's behind it.
        let (target, unit) = slow_unit(4, Duration::from_millis(700));
        let mut master = Master::open(&MasterArgs {
            target,
            unit: "5".to_owned(),
            timeout: ipc_types::units::Span::from_ms(600),
            retries: 1,
            stack: None,
        })
        .unwrap();
        let read = |at: u16| serde_json::json!({ "do": "read", "table": "holding_registers", "at": at });
        for at in [0x0101, 0x0202] {
            assert_eq!(master.try_ask(&read(at)).unwrap()["values"][0], at);
        }
        drop(master);
        unit.join().unwrap();
    }
}
