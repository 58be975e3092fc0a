//! Keys of kind `serial`.

#[allow(clippy::enum_glob_use, reason = "tables of one line a key")]
use super::ValueKind::*;
use super::{KeyDoc, may, need, with};

/// Keys of kind `serial`.
pub const SERIAL: &[KeyDoc] = &[
    need(
        "device",
        Text,
        "The port: \"/dev/ttyUSB0\" (better its name in /dev/serial/by-id, which stays), \"socket://host:port\" for a port that ser2net or the like serves as raw TCP, \"pty:/path\" for a pseudo-terminal with a link to it (\"pty:com1\": in the folder of the stack file). The path of a device is whole, from \"/\". A service named com1 makes it COM1 for the rest of the stack.",
    ),
    may(
        "number",
        Int(0, u32::MAX as i64),
        "the order in the stack file",
        "Number of the port for blocks that name a port by number. There is no such block yet: the number is shown in the status, and nothing else uses it.",
    ),
    with(
        "framing",
        Choice(&["rtu", "ascii", "delimiter", "length", "silence", "raw"]),
        "\"rtu\"",
        "Where frames end: \"rtu\" at a silence of 3.5 characters, checked by the CRC; \"ascii\" from ':' to CR LF; \"delimiter\" at `delimiter`; \"length\" after `length` bytes; \"silence\" at `silence`; \"raw\" nowhere.",
    ),
    may(
        "preset",
        Choice(&["device-L"]),
        "19200 8E1, for ascii 7E1",
        "Other defaults of the line: \"device-L\" is 9600 8E1.",
    ),
    may("baud", Int(50, 12_000_000), "19200, preset device-L 9600", "Bits a second; any rate the port has."),
    may("data_bits", Int(5, 8), "8, framing ascii 7", "Data bits of a character; rtu needs 8, ascii 7 or 8."),
    may(
        "parity",
        Choice(&["none", "even", "odd", "mark", "space"]),
        "\"even\"",
        "Parity bit. Modbus without parity asks for 2 stop bits.",
    ),
    may("stop_bits", Int(1, 2), "1", "Stop bits of a character."),
    with(
        "flow",
        Choice(&["none", "rtscts", "xonxoff"]),
        "\"none\"",
        "Flow control of RS-232: by the lines RTS and CTS, or by characters (not for rtu).",
    ),
    may(
        "rs485",
        Choice(&["kernel", "rts", "adapter"]),
        "RS-232 or RS-422",
        "Who switches the transmitter of an RS-485 port: \"kernel\" its driver (TIOCSRS485), \"rts\" dinrail by the line RTS, \"adapter\" the adapter by itself, as most USB ones do.",
    ),
    with("rts_on_send", Bool, "true", "rs485 kernel and rts: RTS is active while sending; false: inactive."),
    with(
        "rts_delay_before",
        Duration,
        "\"0\"",
        "rs485 kernel and rts: pause between switching the transmitter on and the first byte; kernel: whole ms.",
    ),
    with(
        "rts_delay_after",
        Duration,
        "\"0\"",
        "rs485 kernel and rts: pause between the last byte and switching the transmitter off; kernel: whole ms.",
    ),
    with(
        "receive_while_sending",
        Bool,
        "false",
        "rs485 kernel: the receiver stays on while sending; then set echo = \"discard\".",
    ),
    with(
        "echo",
        Choice(&["keep", "discard"]),
        "\"keep\"",
        "What happens to our own bytes that an RS-485 adapter receives again: \"discard\" compares and removes them; what differs is a collision, counted.",
    ),
    may(
        "duplex",
        Choice(&["half", "full"]),
        "half for rs485 and for rtu and ascii, else full",
        "half: a transmission waits until no frame is being received and the line is silent.",
    ),
    with(
        "reply_delay",
        Duration,
        "\"0\"",
        "Least time between the last byte received and the first byte sent, for peers that switch slowly.",
    ),
    with("turnaround", Duration, "\"0\"", "Least time between two transmissions of our own."),
    may(
        "silence",
        Duration,
        "3.5 characters, 1.75ms above 19200 baud",
        "rtu and silence: silence that ends a frame, and that is waited for before sending.",
    ),
    with(
        "strict_t15",
        Bool,
        "false",
        "rtu: a gap of more than 1.5 characters (750us above 19200 baud) inside a frame rejects it. Right for UARTs without FIFO only; otherwise such gaps are the port's, and only counted.",
    ),
    may(
        "grace",
        Duration,
        "UART 16 characters, USB and pseudo-terminal 20ms, TCP 50ms",
        "rtu: how long after its last byte more is waited for when what is there is only the beginning of a frame.",
    ),
    may("delimiter", Text, "\"\\n\"", "framing delimiter: the last bytes of every frame, 1 to 8."),
    may("length", Int(1, 65_536), "", "framing length, required there: bytes of every frame."),
    with(
        "timeout",
        Duration,
        "\"1s\"",
        "ascii, delimiter, length: a frame that stops for so long is handed over unfinished.",
    ),
    may(
        "max_frame",
        Int(1, 65_536),
        "4096 (rtu always 256, ascii 513)",
        "delimiter and silence: longest frame in bytes; what is beyond is cut, marked and counted.",
    ),
    with(
        "tx_timeout",
        Duration,
        "\"1s\"",
        "How long a transmission waits for a line that others keep busy, or for a port that takes no bytes, before it counts as not sent.",
    ),
    with(
        "low_latency",
        Bool,
        "true",
        "Ask the driver to hand over bytes at once; FTDI adapters hold them for 16 ms otherwise.",
    ),
    with("exclusive", Bool, "true", "Nobody else may open the port meanwhile."),
    with(
        "verify",
        Bool,
        "true",
        "Read the settings back from a real port and refuse it when its chip has taken others.",
    ),
    with(
        "pace",
        Bool,
        "false",
        "pty: hold bytes to the time they would take on a line at `baud`, both ways.",
    ),
];
