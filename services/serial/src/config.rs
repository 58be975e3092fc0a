//! The service's table of the stack file, and what can be found wrong with it without starting.

use std::path::Path;

use ipc_types::Finding;
use ipc_types::stack::{ServiceEntry, Stack};
use ipc_types::units::Span;
use serde::{Deserialize, Serialize};

use crate::character::{Character, Flow, Parity};
use crate::driver::Settings;
use crate::port::{Kind, Options, Target};
use crate::protocol::framer::{self, MAX_ASCII, MAX_DELIMITER, Mode};
use crate::protocol::length::MAX_RTU;
use crate::protocol::sender;
use crate::protocol::timing::Timing;
use crate::sys::Rs485;

/// How frames are told apart.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Framing {
    /// Modbus RTU: silence of 3.5 characters and CRC.
    #[default]
    Rtu,
    /// Modbus ASCII: ':' to CR LF.
    Ascii,
    /// Up to `delimiter`.
    Delimiter,
    /// `length` bytes.
    Length,
    /// Silence.
    Silence,
    /// No frames.
    Raw,
}

/// Defaults of a device.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Preset {
    /// 9600 8E1.
    #[serde(rename = "device-L")]
    DeviceL,
}

/// Who switches an RS-485 transmitter.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Rs485Mode {
    /// The kernel's driver.
    Kernel,
    /// dinrail, by RTS.
    Rts,
    /// The adapter by itself.
    Adapter,
}

/// What happens to our own bytes that come back.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum EchoMode {
    /// They do not come back, or are wanted.
    #[default]
    Keep,
    /// They are removed.
    Discard,
}

/// Whether both sides may send at once.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Duplex {
    /// One at a time: silence is waited for.
    Half,
    /// Both.
    Full,
}

/// A service of kind `serial`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// `/dev/ttyS0`, `socket://host:port` or `pty:/path`.
    pub device: String,
    /// Number for blocks that name a port by number; default: order in the stack file.
    #[serde(default)]
    pub number: Option<u32>,
    /// How frames are told apart.
    #[serde(default)]
    pub framing: Framing,
    /// Other defaults.
    #[serde(default)]
    pub preset: Option<Preset>,
    /// Bit/s; default 19200.
    #[serde(default)]
    pub baud: Option<u32>,
    /// 5 to 8; default 8, ascii 7.
    #[serde(default)]
    pub data_bits: Option<u8>,
    /// Default even.
    #[serde(default)]
    pub parity: Option<Parity>,
    /// 1 or 2; default 1.
    #[serde(default)]
    pub stop_bits: Option<u8>,
    /// Flow control.
    #[serde(default)]
    pub flow: Flow,
    /// Who switches an RS-485 transmitter; absent: RS-232 or RS-422.
    #[serde(default)]
    pub rs485: Option<Rs485Mode>,
    /// RTS is 1 while sending (kernel, rts).
    #[serde(default = "yes")]
    pub rts_on_send: bool,
    /// Pause between the transmitter's switching and the first byte.
    #[serde(default)]
    pub rts_delay_before: Span,
    /// Pause between the last byte and the transmitter's switching.
    #[serde(default)]
    pub rts_delay_after: Span,
    /// The receiver stays on while sending (kernel).
    #[serde(default)]
    pub receive_while_sending: bool,
    /// Our own bytes that come back.
    #[serde(default)]
    pub echo: EchoMode,
    /// Default: half for RS-485 and the framings rtu and ascii, else full.
    #[serde(default)]
    pub duplex: Option<Duplex>,
    /// Least time between a received frame and our answer.
    #[serde(default)]
    pub reply_delay: Span,
    /// Least time between two own transmissions.
    #[serde(default)]
    pub turnaround: Span,
    /// Silence that ends a frame (rtu, silence); default 3.5 characters.
    #[serde(default)]
    pub silence: Option<Span>,
    /// A gap of 1.5 characters inside a frame rejects it (rtu).
    #[serde(default)]
    pub strict_t15: bool,
    /// How long more is waited for when a frame has only begun (rtu); default by the kind of port.
    #[serde(default)]
    pub grace: Option<Span>,
    /// Last bytes of a frame (delimiter); default "\n".
    #[serde(default)]
    pub delimiter: Option<String>,
    /// Bytes of a frame (length).
    #[serde(default)]
    pub length: Option<u32>,
    /// A frame that stops for so long is handed over unfinished (ascii, delimiter, length).
    #[serde(default = "second")]
    pub timeout: Span,
    /// Longest frame; default 256 rtu, 513 ascii, else 4096.
    #[serde(default)]
    pub max_frame: Option<u32>,
    /// How long a transmission waits for a free line.
    #[serde(default = "second")]
    pub tx_timeout: Span,
    /// Ask the port for low latency.
    #[serde(default = "yes")]
    pub low_latency: bool,
    /// Take the port for this process alone.
    #[serde(default = "yes")]
    pub exclusive: bool,
    /// Read the settings back.
    #[serde(default = "yes")]
    pub verify: bool,
    /// Hold bytes of a pseudo-terminal to the time they take on a line.
    #[serde(default)]
    pub pace: bool,
}

/// What is wrong with a `device` that is none of the forms, and what to write.
fn no_device(text: &str) -> (String, String) {
    let help = "write e.g. device = \"/dev/ttyUSB0\", better its name in /dev/serial/by-id; \"socket://host:port\" for a port over TCP, \"pty:/tmp/com1\" for a pseudo-terminal; `dinrail serial list` lists ports";
    let plain = |message: String| (message, help.to_owned());
    if text.is_empty() || text.contains("://") || text.starts_with("pty:") {
        return plain(format!("'{text}' is no serial device"));
    }
    let name = text.trim_start_matches("./");
    let port = name.strip_prefix("COM").or_else(|| name.strip_prefix("com"));
    if let Some(number) = port.and_then(|n| n.parse::<u32>().ok()) {
        let help = format!(
            "name the device, e.g. device = \"/dev/ttyS{}\"; name = \"com{number}\" in [[service]] makes it COM{number} for the rest of the stack",
            number.saturating_sub(1)
        );
        return (format!("'{text}' is no device of Linux"), help);
    }
    let message = format!("'{text}' is a relative path: it is not looked for in any folder");
    if name.starts_with("tty") || name.starts_with("serial/") || name.starts_with("dev/") {
        let whole = name.trim_start_matches("dev/");
        return (message, format!("write device = \"/dev/{whole}\""));
    }
    plain(message)
}

fn yes() -> bool {
    true
}
fn second() -> Span {
    Span::from_ms(1000)
}

/// Rates with some use; the lowest is that of the oldest teleprinters.
const BAUD: std::ops::RangeInclusive<u32> = 50..=12_000_000;
/// Longest of the times in the table.
const LONGEST: Span = Span::from_ms(60_000);
/// Longest frame of the framings without a standard.
const MAX_FRAME: u32 = 65_536;

impl Config {
    /// The defaults for a device.
    pub fn of_device(device: &str) -> Self {
        Self {
            device: device.to_owned(),
            number: None,
            framing: Framing::default(),
            preset: None,
            baud: None,
            data_bits: None,
            parity: None,
            stop_bits: None,
            flow: Flow::default(),
            rs485: None,
            rts_on_send: true,
            rts_delay_before: Span::default(),
            rts_delay_after: Span::default(),
            receive_while_sending: false,
            echo: EchoMode::default(),
            duplex: None,
            reply_delay: Span::default(),
            turnaround: Span::default(),
            silence: None,
            strict_t15: false,
            grace: None,
            delimiter: None,
            length: None,
            timeout: second(),
            max_frame: None,
            tx_timeout: second(),
            low_latency: true,
            exclusive: true,
            verify: true,
            pace: false,
        }
    }

    /// Rate and shape of characters, defaults filled in.
    pub fn character(&self) -> Character {
        let baud = if self.preset == Some(Preset::DeviceL) { 9600 } else { 19_200 };
        Character {
            baud: self.baud.unwrap_or(baud),
            data_bits: self.data_bits.unwrap_or(if self.framing == Framing::Ascii { 7 } else { 8 }),
            parity: self.parity.unwrap_or(Parity::Even),
            stop_bits: self.stop_bits.unwrap_or(1),
            flow: self.flow,
        }
    }

    /// Times of the line.
    pub fn timing(&self) -> Timing {
        let character = self.character();
        Timing::new(character.baud, character.bits())
    }

    fn half_duplex(&self) -> bool {
        match self.duplex {
            Some(duplex) => duplex == Duplex::Half,
            None => self.rs485.is_some() || matches!(self.framing, Framing::Rtu | Framing::Ascii),
        }
    }

    /// How the port is opened; `None` when `device` is none.
    pub fn options(&self, dir: &Path) -> Option<Options> {
        let ms = |span: Span| (span.ns() / 1_000_000) as u32;
        Some(Options {
            target: Target::parse(&self.device, dir)?,
            character: self.character(),
            rs485: (self.rs485 == Some(Rs485Mode::Kernel)).then(|| Rs485 {
                rts_on_send: self.rts_on_send,
                rx_during_tx: self.receive_while_sending,
                delay_before_ms: ms(self.rts_delay_before),
                delay_after_ms: ms(self.rts_delay_after),
            }),
            rts_on_send: (self.rs485 == Some(Rs485Mode::Rts)).then_some(self.rts_on_send),
            low_latency: self.low_latency,
            exclusive: self.exclusive,
            verify: self.verify,
        })
    }

    /// How a port of this kind is driven.
    pub fn settings(&self, kind: Kind) -> Settings {
        let timing = self.timing();
        let paced = self.pace && kind == Kind::Pty;
        let silence_ns = self.silence.map_or(timing.t35_ns, Span::ns);
        let mode = match self.framing {
            Framing::Rtu => Mode::Rtu { strict_t15: self.strict_t15, grace_ns: self.grace_ns(kind, timing) },
            Framing::Ascii => Mode::Ascii,
            Framing::Delimiter => Mode::delimiter(self.delimiter.as_deref().unwrap_or("\n").as_bytes())
                .unwrap_or(Mode::Delimiter { pattern: 10, len: 1 }),
            Framing::Length => Mode::Length(self.length.unwrap_or(1).max(1) as usize),
            Framing::Silence => Mode::Silence,
            Framing::Raw => Mode::Raw,
        };
        let max_frame = match self.framing {
            Framing::Rtu => MAX_RTU,
            Framing::Ascii => MAX_ASCII,
            Framing::Length => self.length.unwrap_or(1).max(1) as usize,
            _ => self.max_frame.unwrap_or(4096).clamp(1, MAX_FRAME) as usize,
        };
        let real = matches!(kind, Kind::Uart | Kind::Usb);
        let rts = (self.rs485 == Some(Rs485Mode::Rts) && real)
            .then(|| (self.rts_delay_before.ns(), self.rts_delay_after.ns()));
        Settings {
            framer: framer::Settings {
                mode,
                timing,
                silence_ns,
                timeout_ns: self.timeout.ns(),
                max_frame,
                timed: real || paced,
            },
            sender: sender::Settings {
                timing,
                half_duplex: self.half_duplex(),
                silence_ns,
                reply_delay_ns: self.reply_delay.ns(),
                turnaround_ns: self.turnaround.ns(),
                give_up_ns: self.tx_timeout.ns(),
                rts,
                timed: kind != Kind::Pty || paced,
                paced,
            },
            discard_echo: self.echo == EchoMode::Discard,
            // What an adapter may hold back, and the time of the scheduler.
            echo_patience_ns: 50_000_000,
            pace: paced,
        }
    }

    /// UARTs hand over what stands in their FIFO when it is filled to a level, so that gaps of up to 16 characters
    /// are theirs, not the sender's. FTDI adapters hold bytes back for 16 ms.
    fn grace_ns(&self, kind: Kind, timing: Timing) -> u64 {
        if let Some(grace) = self.grace {
            return grace.ns();
        }
        match kind {
            Kind::Uart => timing.of(16),
            Kind::Usb | Kind::Pty => 20_000_000,
            Kind::Tcp => 50_000_000,
        }
    }

    /// Every mistake in the table itself; `dir` is the folder of the stack file.
    pub fn findings(&self, service: &str, dir: &Path) -> Vec<Finding> {
        let mut found = Vec::new();
        self.check_device(service, dir, &mut found);
        self.check_character(service, &mut found);
        self.check_framing(service, &mut found);
        self.check_times(service, &mut found);
        found
    }

    fn check_device(&self, service: &str, dir: &Path, found: &mut Vec<Finding>) {
        let Some(target) = Target::parse(&self.device, dir) else {
            let (message, help) = no_device(&self.device);
            found.push(Finding::error(service, "device", message, help));
            return;
        };
        if let Target::Device(path) = &target
            && !path.exists()
        {
            let message = format!("this machine has no {} now", path.display());
            let help = "the driver waits for it; `dinrail serial list` lists ports";
            found.push(Finding::warning(service, "device", message, help));
        }
        let is_device = matches!(target, Target::Device(_));
        if !is_device && self.rs485.is_some() {
            let message = "rs485 has no meaning for this device".to_owned();
            found.push(Finding::warning(service, "rs485", message, "remove the key"));
        }
        if self.pace && matches!(target, Target::Socket(_)) {
            let message = "pace has no meaning for a port over TCP".to_owned();
            found.push(Finding::warning(service, "pace", message, "remove the key"));
        }
    }

    fn check_character(&self, service: &str, found: &mut Vec<Finding>) {
        let c = self.character();
        let mut error = |key: &str, message: String, help: &str| {
            found.push(Finding::error(service, key, message, help));
        };
        if !BAUD.contains(&c.baud) {
            error("baud", format!("baud {} is out of range", c.baud), "use 50 to 12000000, e.g. 19200");
        }
        if !(5..=8).contains(&c.data_bits) {
            error("data_bits", format!("data_bits {} is out of range", c.data_bits), "use 5 to 8");
        } else if self.framing == Framing::Rtu && c.data_bits < 8 {
            error(
                "data_bits",
                format!("framing \"rtu\" needs 8 data bits, not {}", c.data_bits),
                "MODBUS over Serial Line V1.02, 2.5.1: each byte of RTU is sent as 8 data bits; for 7 use framing = \"ascii\", for 5 to 7 without Modbus framing = \"raw\", \"silence\", \"length\" or \"delimiter\"",
            );
        } else if self.framing == Framing::Ascii && c.data_bits < 7 {
            error(
                "data_bits",
                format!("framing \"ascii\" needs 7 or 8 data bits, not {}", c.data_bits),
                "use 7",
            );
        }
        if !(1..=2).contains(&c.stop_bits) {
            error("stop_bits", format!("stop_bits {} is out of range", c.stop_bits), "use 1 or 2");
        }
        let modbus = matches!(self.framing, Framing::Rtu | Framing::Ascii);
        if c.flow == Flow::Xonxoff && self.framing == Framing::Rtu {
            let message = "flow \"xonxoff\" takes the bytes 11h and 13h out of RTU frames".to_owned();
            error("flow", message, "use \"none\" or \"rtscts\"");
        }
        if c.flow == Flow::Rtscts && self.rs485 == Some(Rs485Mode::Rts) {
            let message = "RTS cannot switch the transmitter and control the flow".to_owned();
            error("flow", message, "remove flow: RS-485 has none");
        }
        if modbus && c.parity == Parity::None && c.stop_bits == 1 {
            found.push(Finding::warning(
                service,
                "stop_bits",
                format!("{c}: without parity the standard asks for 2 stop bits (V1.02, 2.5.1)"),
                "set stop_bits = 2, or parity = \"even\"; leave it if all devices on the line are set so",
            ));
        }
    }

    fn check_framing(&self, service: &str, found: &mut Vec<Finding>) {
        let mut error = |key: &str, message: String, help: &str| {
            found.push(Finding::error(service, key, message, help));
        };
        match (self.framing, self.length) {
            (Framing::Length, None) => {
                error("length", "framing \"length\" needs length".to_owned(), "add e.g. length = 12");
            }
            (Framing::Length, Some(n)) if !(1..=MAX_FRAME).contains(&n) => {
                error("length", format!("length {n} is out of range"), "use 1 to 65536");
            }
            _ => {}
        }
        if let Some(delimiter) = &self.delimiter
            && !(1..=MAX_DELIMITER).contains(&delimiter.len())
        {
            let message = format!("delimiter of {} bytes is out of range", delimiter.len());
            error("delimiter", message, "use 1 to 8 bytes, e.g. \"\\r\\n\"");
        }
        if let Some(n) = self.max_frame
            && !(1..=MAX_FRAME).contains(&n)
        {
            error("max_frame", format!("max_frame {n} is out of range"), "use 1 to 65536");
        }
        let uses = |set: bool, key: &str, framings: &[Framing], names: &str, found: &mut Vec<Finding>| {
            if set && !framings.contains(&self.framing) {
                let message = format!("{key} has no meaning for this framing, only for {names}");
                found.push(Finding::warning(service, key, message, "remove the key, or change framing"));
            }
        };
        use Framing::{Delimiter, Length, Raw, Rtu, Silence};
        uses(self.length.is_some(), "length", &[Length], "\"length\"", found);
        uses(self.delimiter.is_some(), "delimiter", &[Delimiter], "\"delimiter\"", found);
        uses(self.strict_t15, "strict_t15", &[Rtu], "\"rtu\"", found);
        uses(self.grace.is_some(), "grace", &[Rtu], "\"rtu\"", found);
        uses(
            self.max_frame.is_some(),
            "max_frame",
            &[Delimiter, Silence, Raw],
            "\"delimiter\" and \"silence\"",
            found,
        );
    }

    fn check_times(&self, service: &str, found: &mut Vec<Finding>) {
        let times = [
            ("rts_delay_before", Some(self.rts_delay_before)),
            ("rts_delay_after", Some(self.rts_delay_after)),
            ("reply_delay", Some(self.reply_delay)),
            ("turnaround", Some(self.turnaround)),
            ("silence", self.silence),
            ("grace", self.grace),
            ("timeout", Some(self.timeout)),
            ("tx_timeout", Some(self.tx_timeout)),
        ];
        for (key, span) in times {
            if span.is_some_and(|s| s > LONGEST) {
                let message = format!("{key} {} is out of range", span.unwrap_or_default());
                found.push(Finding::error(service, key, message, "use at most 60s"));
            }
        }
        for (key, span) in [
            ("timeout", Some(self.timeout)),
            ("tx_timeout", Some(self.tx_timeout)),
            ("silence", self.silence),
        ] {
            if span == Some(Span(0)) {
                let help = "use e.g. \"1s\"; the default of silence is 3.5 characters";
                found.push(Finding::error(service, key, format!("{key} must be above 0"), help));
            }
        }
        let whole_ms = |span: Span| span.ns().is_multiple_of(1_000_000) && span <= Span::from_ms(100);
        if self.rs485 == Some(Rs485Mode::Kernel) {
            for (key, span) in
                [("rts_delay_before", self.rts_delay_before), ("rts_delay_after", self.rts_delay_after)]
            {
                if !whole_ms(span) {
                    let message = format!("{key} {span}: the kernel takes whole ms up to 100");
                    found.push(Finding::error(service, key, message, "use e.g. \"1ms\", or rs485 = \"rts\""));
                }
            }
        }
    }
}

/// Every mistake that can be found without starting.
pub fn check(config: &Config, stack: &Stack, me: &ServiceEntry) -> Vec<Finding> {
    let mut found = config.findings(&me.name, &stack.dir);
    let own = |device: &str| {
        Target::parse(device, &stack.dir).map(|t| match t {
            Target::Device(path) => std::fs::canonicalize(&path).unwrap_or(path).display().to_string(),
            other => other.to_string(),
        })
    };
    let mine = own(&config.device);
    for other in stack.services.iter().filter(|s| s.kind == "serial" && s.index < me.index) {
        let device = other.config.get("device").and_then(|d| d.as_str()).and_then(own);
        if device.is_some() && device == mine {
            let message = format!("'{}' is the port of service '{}' too", config.device, other.name);
            let help = "one process has a port: let both use the same serial service";
            found.push(Finding::error(&me.name, "device", message, help));
        }
    }
    found
}

#[cfg(test)]
#[path = "config_tests.rs"]
mod tests;
