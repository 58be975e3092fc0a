//! `dinrail serial list`, `dump` and `send`.

use super::{UsageError, println, table};
use crate::cli::Which;
use crate::supervise::client::{find, observe};
use clap::{Args, Subcommand};
use dinrail_serial::driver::Driver;
use dinrail_serial::port::Port;
use dinrail_serial::protocol::crc::crc16;
use dinrail_serial::protocol::sender::Head;
use dinrail_serial::{Config, list};
use ipc_types::payload::{CHUNK_BYTES, SerialChunk, serial_flag};
use ipc_types::reactor::Reactor;
use ipc_types::topic::TopicKind;
use ipc_types::units::Span;
use ipc_types::{Context, clock};
use std::path::Path;
use std::time::{Duration, Instant};

/// Observers have no inbox: they look this often.
const LOOK: Duration = Duration::from_millis(5);
/// A sent frame must be reported within this time.
const ECHO_LIMIT: Duration = Duration::from_secs(5);

#[derive(Debug, Subcommand)]
pub enum SerialCommand {
    /// List the ports of this machine
    List,
    /// Print frames as they are on the line, with their times
    Dump {
        /// Service of a running stack, or a device
        port: String,
        /// Stop after so many frames
        #[arg(long)]
        count: Option<u64>,
        /// Stop after so long
        #[arg(long = "for", value_name = "DURATION")]
        duration: Option<Span>,
        #[command(flatten)]
        line: LineArgs,
        #[command(flatten)]
        which: Which,
    },
    /// Send one frame and print what is answered
    Send {
        /// Service of a running stack, or a device
        port: String,
        /// Hex bytes, e.g. 01 03 0000 0002; with --text the text itself
        #[arg(required = true)]
        data: Vec<String>,
        /// The data are text; \r, \n, \t, \0 and \xHH stand for bytes
        #[arg(long)]
        text: bool,
        /// Append the CRC of Modbus RTU
        #[arg(long, conflicts_with = "text")]
        crc: bool,
        /// How long answers are waited for
        #[arg(long, default_value = "1s", value_name = "DURATION")]
        wait: Span,
        #[command(flatten)]
        line: LineArgs,
        #[command(flatten)]
        which: Which,
    },
}

/// Settings of a device that is opened directly; a service has its own.
#[derive(Debug, Clone, Default, Args)]
pub struct LineArgs {
    /// Bits a second; default 19200
    #[arg(long)]
    pub baud: Option<u32>,
    /// 5 to 8; default 8
    #[arg(long)]
    pub data_bits: Option<u8>,
    /// none, even, odd, mark or space; default even
    #[arg(long)]
    pub parity: Option<String>,
    /// 1 or 2; default 1
    #[arg(long)]
    pub stop_bits: Option<u8>,
    /// rtu, ascii, silence, delimiter (at line ends) or raw; default rtu
    #[arg(long)]
    pub framing: Option<String>,
}

impl LineArgs {
    /// Puts what was given into a configuration.
    pub fn apply(&self, config: &mut Config) -> Result<(), UsageError> {
        fn word<T: serde::de::DeserializeOwned>(name: &str, text: &str) -> Result<T, UsageError> {
            serde_json::from_value(text.into()).map_err(|e| UsageError(format!("--{name} {text}: {e}")))
        }
        config.baud = self.baud.or(config.baud);
        config.data_bits = self.data_bits.or(config.data_bits);
        config.stop_bits = self.stop_bits.or(config.stop_bits);
        if let Some(parity) = &self.parity {
            config.parity = Some(word("parity", parity)?);
        }
        if let Some(framing) = &self.framing {
            config.framing = word("framing", framing)?;
        }
        Ok(())
    }

    fn given(&self) -> bool {
        self.baud.is_some()
            || self.data_bits.is_some()
            || self.parity.is_some()
            || self.stop_bits.is_some()
            || self.framing.is_some()
    }
}

pub fn run(command: SerialCommand, json: bool) -> anyhow::Result<()> {
    match command {
        SerialCommand::List => {
            list_ports(json);
            Ok(())
        }
        SerialCommand::Dump { port, count, duration, line, which } => {
            let end = duration.map(|d| Instant::now() + d.duration());
            let mut print = Printer::new(&port, json, count.unwrap_or(u64::MAX));
            if is_device(&port) {
                let (mut driver, mut reactor) = open(&port, &line)?;
                while print.left > 0 && pump(&mut driver, &mut reactor, end, &mut print)? {}
                return Ok(());
            }
            let ctx = service(&port, &line, &which)?;
            observe_line(&ctx, &port, end, &mut print)
        }
        SerialCommand::Send { port, data, text, crc, wait, line, which } => {
            let bytes = bytes_of(&data, text, crc)?;
            let mut print = Printer::new(&port, json, u64::MAX);
            if is_device(&port) {
                let (mut driver, mut reactor) = open(&port, &line)?;
                return send_device(&mut driver, &mut reactor, &bytes, wait, &mut print);
            }
            let mut ctx = service(&port, &line, &which)?;
            send_service(&mut ctx, &port, &bytes, wait, &mut print)
        }
    }
}

fn is_device(port: &str) -> bool {
    port.starts_with('/') || port.starts_with("pty:") || port.contains("://")
}

/// Bytes of hex words or of a text, at most one chunk.
fn bytes_of(data: &[String], text: bool, crc: bool) -> Result<Vec<u8>, UsageError> {
    let mut bytes = if text { unescape(&data.join(" "))? } else { hex(&data.concat())? };
    if crc {
        bytes.extend(crc16(&bytes).to_le_bytes());
    }
    if bytes.is_empty() || bytes.len() > CHUNK_BYTES {
        let n = bytes.len();
        return Err(UsageError(format!("{n} bytes: one frame has 1 to {CHUNK_BYTES}")));
    }
    Ok(bytes)
}

fn hex(text: &str) -> Result<Vec<u8>, UsageError> {
    let digits: Vec<u8> =
        text.bytes().filter(|c| !c.is_ascii_whitespace() && !matches!(c, b':' | b'-' | b',')).collect();
    let wrong =
        || UsageError(format!("'{text}' is not hex: write bytes of two digits, e.g. 01 03 0000 0002"));
    if !digits.len().is_multiple_of(2) || !digits.iter().all(u8::is_ascii_hexdigit) {
        return Err(wrong());
    }
    let digit = |c: u8| (c as char).to_digit(16).unwrap_or(0) as u8;
    Ok(digits.chunks_exact(2).map(|pair| digit(pair[0]) << 4 | digit(pair[1])).collect())
}

fn unescape(text: &str) -> Result<Vec<u8>, UsageError> {
    let mut bytes = Vec::new();
    let mut rest = text;
    while let Some(at) = rest.find('\\') {
        bytes.extend_from_slice(&rest.as_bytes()[..at]);
        let tail = &rest[at + 1..];
        let (byte, used) = match tail.chars().next() {
            Some('r') => (b'\r', 1),
            Some('n') => (b'\n', 1),
            Some('t') => (b'\t', 1),
            Some('0') => (0, 1),
            Some('\\') => (b'\\', 1),
            Some('x') if tail.get(1..3).is_some() => (hex(&tail[1..3])?[0], 3),
            _ => return Err(UsageError(format!("\\{tail}: write \\r, \\n, \\t, \\0, \\xHH or \\\\"))),
        };
        bytes.push(byte);
        rest = &tail[used..];
    }
    bytes.extend_from_slice(rest.as_bytes());
    Ok(bytes)
}

fn list_ports(json: bool) {
    let ports = list::ports();
    if json {
        println(&serde_json::to_string(&ports).unwrap_or_default());
        return;
    }
    if ports.is_empty() {
        println("no serial ports");
        return;
    }
    let rows: Vec<Vec<String>> = ports.iter().map(row).collect();
    super::print(&table(&["device", "driver", "adapter", "by id", "open in", ""], &rows));
}

fn row(port: &list::PortInfo) -> Vec<String> {
    let adapter = port.usb.as_ref().map_or_else(String::new, |usb| {
        let words = [usb.manufacturer.as_deref(), usb.name.as_deref(), usb.serial.as_deref()];
        let words: Vec<&str> = words.into_iter().flatten().collect();
        format!("{}:{} {}", usb.vendor, usb.product, words.join(" ")).trim_end().to_owned()
    });
    let holders: Vec<String> = port.holders.iter().map(ToString::to_string).collect();
    let latency = port.latency_timer_ms.filter(|ms| *ms > 1).map(|ms| format!("holds bytes for {ms} ms"));
    let hints: Vec<String> =
        port.permission.iter().map(|p| format!("no permission: {p}")).chain(latency).collect();
    vec![
        port.device.clone(),
        port.driver.clone().unwrap_or_default(),
        adapter,
        port.by_id.clone().unwrap_or_default(),
        holders.join(", "),
        hints.join("; "),
    ]
}

/// Prints chunks.
struct Printer<'a> {
    port: &'a str,
    json: bool,
    left: u64,
    offset_ns: i64,
    last_ns: Option<u64>,
}

/// The marks of a chunk, in words.
const MARKS: [(u32, &str); 6] = [
    (serial_flag::NOT_SENT, "not sent"),
    (serial_flag::GAP, "gap"),
    (serial_flag::PARITY, "parity"),
    (serial_flag::FRAMING, "framing"),
    (serial_flag::OVERRUN, "overrun"),
    (serial_flag::BREAK, "break"),
];

fn spaced(bytes: &[u8]) -> String {
    let words: Vec<String> = bytes.iter().map(|b| format!("{b:02X}")).collect();
    words.join(" ")
}

impl<'a> Printer<'a> {
    fn new(port: &'a str, json: bool, left: u64) -> Self {
        Self { port, json, left, offset_ns: clock::utc_offset_ns(), last_ns: None }
    }

    /// `1766.001 com1 > 01 03 .. 8 bytes, 9.2 ms, 21.0 ms after [gap]`; `>` is what the stack sent, `..` goes on.
    fn print(&mut self, header: &SerialChunk, bytes: &[u8], end_ns: u64) {
        if self.left == 0 {
            return;
        }
        let end = header.flags & serial_flag::END != 0;
        self.left -= u64::from(end || bytes.is_empty());
        let sent = header.flags & serial_flag::TX_ECHO != 0;
        let marks: Vec<&str> =
            MARKS.iter().filter(|(flag, _)| header.flags & flag != 0).map(|(_, word)| *word).collect();
        let utc_ns = |t_ns: u64| (t_ns as i64 + self.offset_ns).max(0);
        let before = self.last_ns.map(|last| header.first_t_ns.saturating_sub(last));
        self.last_ns = Some(end_ns);
        if self.json {
            println(
                &serde_json::json!({
                    "port": self.port, "seq": header.stamp.seq, "utc_ns": utc_ns(header.first_t_ns),
                    "end_utc_ns": utc_ns(end_ns), "sent": sent, "end": end, "marks": marks, "n": bytes.len(),
                    "hex": bytes.iter().map(|b| format!("{b:02X}")).collect::<String>(),
                })
                .to_string(),
            );
            return;
        }
        let utc = utc_ns(header.first_t_ns);
        let ms = |ns: u64| ns as f64 / 1e6;
        let after = before.map_or_else(String::new, |ns| format!(", {:.3} ms after", ms(ns)));
        let marks = if marks.is_empty() { String::new() } else { format!(" [{}]", marks.join(", ")) };
        println(&format!(
            "({}.{:06}) {} {} {}{}  {} bytes, {:.3} ms{after}{marks}",
            utc / 1_000_000_000,
            utc % 1_000_000_000 / 1000,
            self.port,
            if sent { '>' } else { '<' },
            spaced(bytes),
            if end { "" } else { " .." },
            bytes.len(),
            ms(end_ns.saturating_sub(header.first_t_ns)),
        ));
    }
}

fn open(device: &str, line: &LineArgs) -> anyhow::Result<(Driver, Reactor)> {
    let mut config = Config::of_device(device);
    line.apply(&mut config)?;
    let findings = config.findings("", Path::new("."));
    if let Some(error) = findings.iter().find(|f| f.severity == ipc_types::stack::Severity::Error) {
        return Err(UsageError(format!("{}; {}", error.message, error.help)).into());
    }
    open_config(&config)
}

/// Opens the port of a configuration for this process.
pub fn open_config(config: &Config) -> anyhow::Result<(Driver, Reactor)> {
    let options = config
        .options(&std::env::current_dir()?)
        .ok_or_else(|| UsageError(format!("'{}' is no serial device", config.device)))?;
    let port = Port::open(&options)?;
    let settings = config.settings(port.kind());
    for note in port.notes() {
        eprintln!("dinrail: {note}");
    }
    let mut driver = Driver::new(port, &settings);
    driver.visited();
    Ok((driver, Reactor::new()?))
}

/// Lets a port work until something happened, at most until `end`. False: that time is over.
fn pump(
    driver: &mut Driver,
    reactor: &mut Reactor,
    end: Option<Instant>,
    print: &mut Printer<'_>,
) -> anyhow::Result<bool> {
    let mut sink = |header: SerialChunk, bytes: &[u8], t_ns: u64| print.print(&header, bytes, t_ns);
    step(driver, reactor, end, &mut sink)
}

/// One step of a port that this process drives: waits until bytes or a time are due, at most until `end`, and does
/// the work. False: that time is over.
pub fn step(
    driver: &mut Driver,
    reactor: &mut Reactor,
    end: Option<Instant>,
    sink: &mut dyn dinrail_serial::driver::Sink,
) -> anyhow::Result<bool> {
    driver.turn(clock::mono_ns(), sink)?;
    let due = driver.deadline().map(|t| Duration::from_nanos(t.saturating_sub(clock::mono_ns())));
    let left = end.map(|end| end.saturating_duration_since(Instant::now()));
    // Without anybody at the other end of a pseudo-terminal there is nothing to wait for but a visitor.
    let watched = !driver.nobody() && !driver.is_full();
    let idle = if driver.nobody() { Some(LOOK) } else { None };
    let timeout = [due, left, idle].into_iter().flatten().min();
    if watched {
        reactor.add(driver.fd())?;
        let _ = reactor.wait(timeout)?;
        reactor.remove(driver.fd())?;
        driver.readable(clock::mono_ns(), sink)?;
    } else {
        let _ = reactor.wait(timeout)?;
        driver.visited();
    }
    driver.turn(clock::mono_ns(), sink)?;
    Ok(left.is_none_or(|left| !left.is_zero()))
}

fn send_device(
    driver: &mut Driver,
    reactor: &mut Reactor,
    bytes: &[u8],
    wait: Span,
    print: &mut Printer<'_>,
) -> anyhow::Result<()> {
    let head = Head { flags: serial_flag::END, ..Head::default() };
    driver.load(head, bytes, clock::mono_ns());
    let limit = Instant::now() + ECHO_LIMIT;
    while !driver.is_idle() {
        if !pump(driver, reactor, Some(limit), print)? {
            anyhow::bail!("{}: the port takes no bytes", print.port);
        }
    }
    if driver.counters().tx.frames == 0 {
        anyhow::bail!("{}: not sent: the line is busy or the port takes no bytes", print.port);
    }
    let end = Instant::now() + wait.duration();
    while pump(driver, reactor, Some(end), print)? {}
    Ok(())
}

fn service(port: &str, line: &LineArgs, which: &Which) -> anyhow::Result<Context> {
    if line.given() {
        let why = format!("service '{port}' has its own settings: remove --baud and the like");
        return Err(UsageError(why).into());
    }
    Ok(observe(&find(which.stack.as_deref())?)?)
}

/// The topic of a port, or an error that lists the ports.
fn topic(ctx: &Context, port: &str, kind: TopicKind) -> anyhow::Result<String> {
    let name = kind.of(port);
    if ctx.stack.topic(&name).is_some_and(|t| t.kind == kind) {
        return Ok(name);
    }
    let has = |s: &&ipc_types::stack::ServiceEntry| s.wiring.topics.iter().any(|t| t.kind == kind);
    let ports: Vec<&str> = ctx.stack.services.iter().filter(has).map(|s| s.name.as_str()).collect();
    if ports.is_empty() {
        anyhow::bail!("stack '{}' has no serial port; a device is written with its path", ctx.stack.name);
    }
    anyhow::bail!("stack '{}' has no serial port '{port}'; it has {}", ctx.stack.name, ports.join(", "))
}

fn observe_line(
    ctx: &Context,
    port: &str,
    end: Option<Instant>,
    print: &mut Printer<'_>,
) -> anyhow::Result<()> {
    let mut rx = ctx.subscriber::<SerialChunk>(&topic(ctx, port, TopicKind::SerialRx)?)?;
    let mut reactor = Reactor::new()?;
    reactor.add_timer(LOOK)?;
    let stop = reactor.add(ctx.shutdown_fd())?;
    let mut ended = false;
    while !ended && print.left > 0 {
        ended = reactor.wait(Some(LOOK * 4))?.contains(&stop) || end.is_some_and(|e| Instant::now() >= e);
        rx.drain(1024, |header, bytes| print.print(header, bytes, header.stamp.t_ns));
    }
    let lost = rx.counters().lost;
    if lost > 0 {
        eprintln!("dinrail: {lost} frames were not seen: this terminal is slower than the line");
    }
    Ok(())
}

fn send_service(
    ctx: &mut Context,
    port: &str,
    bytes: &[u8],
    wait: Span,
    print: &mut Printer<'_>,
) -> anyhow::Result<()> {
    let mut rx = ctx.subscriber::<SerialChunk>(&topic(ctx, port, TopicKind::SerialRx)?)?;
    let mut tx = ctx.publisher::<SerialChunk>(&topic(ctx, port, TopicKind::SerialTx)?)?;
    let header = SerialChunk { flags: serial_flag::END, ..SerialChunk::default() };
    let seq = tx.send_tail(header, bytes)?;
    tx.ring();
    let begin = Instant::now();
    let mut reported = None;
    while reported.is_none() {
        if begin.elapsed() > ECHO_LIMIT {
            anyhow::bail!("{port}: not reported as sent within {} s; `dinrail ps`", ECHO_LIMIT.as_secs());
        }
        rx.drain(1024, |header, bytes| {
            let ours = header.tx_writer == ctx.writer && header.tx_seq == seq;
            if ours && header.flags & serial_flag::TX_ECHO != 0 {
                reported = Some(header.flags & serial_flag::NOT_SENT == 0);
            }
            if ours || reported.is_some() {
                print.print(header, bytes, header.stamp.t_ns);
            }
        });
        std::thread::sleep(Duration::from_millis(1));
    }
    if reported == Some(false) {
        anyhow::bail!(
            "{port}: not sent: the port is gone, the line is busy, or nobody takes the bytes; `dinrail ps` and `dinrail logs {port}`"
        );
    }
    let end = Instant::now() + wait.duration();
    while Instant::now() < end {
        rx.drain(1024, |header, bytes| print.print(header, bytes, header.stamp.t_ns));
        std::thread::sleep(Duration::from_millis(2));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn data_of_the_command_line() {
        let words = |text: &str| text.split(' ').map(str::to_owned).collect::<Vec<_>>();
        assert_eq!(
            bytes_of(&words("01 03 0000 000A"), false, true).unwrap(),
            [1, 3, 0, 0, 0, 10, 0xC5, 0xCD]
        );
        assert_eq!(bytes_of(&words("a:\\r\\n\\x41\\\\ b"), true, false).unwrap(), b"a:\r\nA\\ b");
        for (bad, text) in [("0", false), ("0g", false), ("\\q", true), ("\\x4", true), ("\\", true)] {
            assert!(bytes_of(&words(bad), text, false).is_err(), "{bad}");
        }
        assert!(bytes_of(&["00".repeat(1025)], false, false).is_err());
    }

    #[test]
    fn devices_and_services_are_told_apart() {
        for device in ["/dev/ttyS0", "pty:/tmp/x", "socket://a:1"] {
            assert!(is_device(device), "{device}");
        }
        assert!(!is_device("com1"));
    }
}
