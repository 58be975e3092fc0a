//! Keys of the services at the field side.

#[allow(clippy::enum_glob_use, reason = "tables of one line a key")]
use super::ValueKind::*;
use super::{KeyDoc, may, need, with};

const PORT_FORMS: super::ValueKind = OneOf(&[Socket, Table]);

/// Keys of kind `can`.
pub const CAN: &[KeyDoc] = &[
    need(
        "backend",
        Choice(&["virtual", "socketcan", "slcan", "socketcand"]),
        "What stands between the driver and the wire: \"virtual\" is a bus inside the driver process, \"socketcan\" a network interface, \"slcan\" a serial adapter, \"socketcand\" a bus of another machine.",
    ),
    may(
        "interface",
        Text,
        "none",
        "socketcan: name of the interface, e.g. \"can0\". slcan: \"/dev/ttyACM0\" or \"tcp://host:port\". socketcand: \"tcp://host:29536/can0\". Without meaning for \"virtual\".",
    ),
    may(
        "number",
        Int(0, u32::MAX as i64),
        "the order in the stack file",
        "Number of the bus for blocks that name a bus by number. There is no such block yet: nothing uses the number.",
    ),
    with("bitrate", BitRate, "\"500k\"", "Nominal bit rate, 5k to 1M."),
    with("data_bitrate", BitRate, "\"2M\"", "Bit rate of the data phase of CAN FD, from `bitrate` up to 8M."),
    may(
        "fd",
        Bool,
        "as the interface is; off for slcan",
        "CAN FD: true switches it on where the driver may, and names it when it cannot be.",
    ),
    with(
        "configure",
        Bool,
        "true",
        "socketcan: set bit rate, restart and CAN FD and raise the interface when it is first used, where permitted (CAP_NET_ADMIN); false: only compare and say.",
    ),
    with(
        "bus_off_restart",
        Duration,
        "\"100ms\"",
        "Pause before the restart after bus-off, doubled up to 5s while it fails; whole ms up to 60s; \"0ms\" = stay off.",
    ),
    with(
        "rx_buffer",
        Size,
        "\"4MiB\"",
        "socketcan: receive buffer of the socket, 64KiB to 64MiB; without CAP_NET_ADMIN at most net.core.rmem_max.",
    ),
    with(
        "filters",
        OneOf(&[Choice(&["none", "auto"]), List(&Text)]),
        "\"none\"",
        "socketcan: frames that the kernel hands over: \"none\" filters nothing; \"auto\" takes the identifiers that the readers of the bus name, if all do; a list such as [\"1A0\", \"18FEF100:1FFFFF00\"] takes these, at most 512. What is kept back is in no recording and no dump.",
    ),
    with("baud", Int(9600, 3_000_000), "115200", "slcan: rate of the serial device; USB adapters ignore it."),
    with("timestamps", Bool, "false", "slcan: stamp frames by the adapter's clock instead of their arrival."),
    with(
        "pace",
        Bool,
        "false",
        "Hold frames of a virtual bus to the time they would take on a wire at `bitrate`; else as fast as it goes.",
    ),
    with(
        "max_rate",
        Int(100, 10_000_000),
        "150000",
        "Without `pace`: most frames a second on a virtual bus, so that no reader loses any.",
    ),
    with(
        "tx_queue",
        Int(1, 4096),
        "512",
        "Frames of the stack that wait for the bus; when it is full, senders are refused.",
    ),
    with(
        "client_buffer",
        Size,
        "\"1MiB\"",
        "Bytes that wait for one TCP client, 4KiB to 64MiB; a client that reads too slowly misses frames, and stays.",
    ),
    with("serve", Table, "{}", "Servers for foreign tools such as python-can."),
    may(
        "serve.socketcand",
        PORT_FORMS,
        "no server",
        "Serves the bus by the socketcand protocol at this address.",
    ),
    need("serve.socketcand.address", Socket, "Where the server listens."),
    may(
        "serve.socketcand.filter",
        Table,
        "loopback only",
        "Who may connect besides loopback: start <= address <= end, and address & mask = start & mask. Required unless the server listens on loopback.",
    ),
    need("serve.socketcand.filter.mask", Ip, "Bits of the address that must equal those of `start`."),
    need("serve.socketcand.filter.start", Ip, "First address that may connect."),
    need("serve.socketcand.filter.end", Ip, "Last address that may connect."),
    with("serve.socketcand.max_clients", Int(1, 32), "8", "Most clients at once."),
    may("serve.slcan", PORT_FORMS, "no server", "Serves the bus as SLCAN over TCP at this address."),
    need("serve.slcan.address", Socket, "Where the server listens."),
    may(
        "serve.slcan.filter",
        Table,
        "loopback only",
        "Who may connect besides loopback: start <= address <= end, and address & mask = start & mask. Required unless the server listens on loopback.",
    ),
    need("serve.slcan.filter.mask", Ip, "Bits of the address that must equal those of `start`."),
    need("serve.slcan.filter.start", Ip, "First address that may connect."),
    need("serve.slcan.filter.end", Ip, "Last address that may connect."),
    with("serve.slcan.max_clients", Int(1, 32), "8", "Most clients at once."),
    may(
        "serve.cannelloni",
        PORT_FORMS,
        "no server",
        "Serves the bus by the cannelloni protocol over TCP at this address.",
    ),
    need("serve.cannelloni.address", Socket, "Where the server listens."),
    may(
        "serve.cannelloni.filter",
        Table,
        "loopback only",
        "Who may connect besides loopback: start <= address <= end, and address & mask = start & mask. Required unless the server listens on loopback.",
    ),
    need("serve.cannelloni.filter.mask", Ip, "Bits of the address that must equal those of `start`."),
    need("serve.cannelloni.filter.start", Ip, "First address that may connect."),
    need("serve.cannelloni.filter.end", Ip, "Last address that may connect."),
    with("serve.cannelloni.max_clients", Int(1, 32), "8", "Most clients at once."),
    may(
        "serve.slcan_pty",
        Text,
        "no terminal",
        "Serves the bus as SLCAN on a pseudo-terminal; path of the link that leads to it, relative to the stack file.",
    ),
    may("feed", Table, "nothing is played", "A recorded log that is played onto the bus."),
    need("feed.file", File, "A candump log (`candump -L`)."),
    may("feed.bus", Text, "all lines", "Play only lines of this bus name of the log."),
    with("feed.loop", Bool, "true", "Start again at the end of the log."),
    with("feed.gap", Duration, "\"100ms\"", "Pause before the log starts again, at least 1ms."),
    with("feed.speed", Number, "1.0", "2.0 plays twice as fast; 0.01 to 1000."),
];

/// Types of a point.
const TYPES: &[&str] = &[
    "BOOL", "SINT", "INT", "DINT", "LINT", "USINT", "UINT", "UDINT", "ULINT", "REAL", "LREAL", "BYTE",
    "WORD", "DWORD", "LWORD",
];
const ORDERS: super::ValueKind = Choice(&["intel", "motorola"]);
const ID: super::ValueKind = OneOf(&[Int(0, 0x1FFF_FFFF), Text]);

/// Keys of kind `can-io`.
pub const CAN_IO: &[KeyDoc] = &[
    may(
        "bus",
        Service("can"),
        "the only bus of the stack",
        "The can service whose frames are taken and sent.",
    ),
    may("plc", Service("plc"), "the only plc of the stack", "The plc service whose image is exchanged."),
    with("echo", Bool, "false", "Take frames that the stack itself sent, too."),
    with(
        "stale_after",
        Duration,
        "\"200ms\"",
        "Age of the image above which the frames sent go to their safe state.",
    ),
    with(
        "safe_on",
        List(&Choice(&["stop", "fault", "halted"])),
        "[\"stop\", \"fault\", \"halted\"]",
        "States of the plc in which the frames sent go to their safe state; a stale image always does.",
    ),
    with("in", Tables, "[]", "Signals taken from the bus into %I, one [[service.in]] each; at most 1024."),
    need(
        "in[].id",
        ID,
        "Identifier of the frame: a number, or hex digits as text; eight digits mean 29 bits.",
    ),
    may("in[].ext", Bool, "by the identifier", "true: 29-bit identifier."),
    need(
        "in[].start",
        Int(0, 511),
        "First bit of the signal in DBC numbering: the least significant for intel, the most significant for motorola.",
    ),
    need("in[].len", Int(1, 64), "Bits of the signal."),
    with("in[].order", ORDERS, "\"intel\"", "Order of the bytes: intel = low byte first."),
    with("in[].signed", Bool, "false", "The raw value is two's complement."),
    with("in[].float", Bool, "false", "The raw value is IEEE 754, of 32 or 64 bits."),
    with("in[].scale", Number, "1.0", "Value = raw * scale + offset."),
    with("in[].offset", Number, "0.0", "Value = raw * scale + offset."),
    need("in[].to", Address, "Place in %I."),
    may("in[].type", Choice(TYPES), "by the width of `to` and `signed`", "IEC type of the value."),
    may("in[].symbol", Text, "none", "Name of a global variable for the program."),
    may("in[].timeout", Duration, "never", "A value older than this is bad."),
    with(
        "in[].on_bad",
        OneOf(&[Choice(&["hold", "zero"]), Number]),
        "\"hold\"",
        "Value while bad: the last good one, zero, or this number in the unit of the value.",
    ),
    may("in[].status_to", Address, "not shown", "%IB that shows the quality of the value to the program."),
    with("out", Tables, "[]", "Frames sent, one [[service.out]] each; at most 256."),
    need(
        "out[].id",
        ID,
        "Identifier of the frame: a number, or hex digits as text; eight digits mean 29 bits.",
    ),
    may("out[].ext", Bool, "by the identifier", "true: 29-bit identifier."),
    need("out[].dlc", Int(0, 64), "Bytes of the frame: 0 to 8; for CAN FD also 12, 16, 20, 24, 32, 48, 64."),
    may("out[].fd", Bool, "when `dlc` is above 8", "Send a CAN FD frame."),
    with("out[].brs", Bool, "false", "CAN FD with bit rate switch."),
    need(
        "out[].mode",
        Choice(&["on_change", "cyclic"]),
        "When the frame is sent: when a bit of it changed after a scan, or every `period`.",
    ),
    may("out[].period", Duration, "only for on_change", "For cyclic: time between two frames, at least 1ms."),
    with("out[].inhibit", Duration, "\"0ms\"", "For on_change: least time between two frames."),
    with("out[].fill", Int(0, 255), "0", "Value of the bytes' bits that no signal covers."),
    with(
        "out[].on_stop",
        OneOf(&[Choice(&["silent", "hold", "not_available"]), Table]),
        "\"silent\"",
        "Safe state of the frame: nothing is sent so that the receiver's own timeout fires; the last values go on; all signals have all bits 1; or these values.",
    ),
    need("out[].on_stop.values", List(&Number), "One number per signal, in its unit."),
    with("out[].signals", Tables, "[]", "Signals in the frame; at most 64."),
    need("out[].signals[].start", Int(0, 511), "First bit of the signal in DBC numbering."),
    need("out[].signals[].len", Int(1, 64), "Bits of the signal."),
    with("out[].signals[].order", ORDERS, "\"intel\"", "Order of the bytes: intel = low byte first."),
    with("out[].signals[].signed", Bool, "false", "The raw value is two's complement."),
    with("out[].signals[].float", Bool, "false", "The raw value is IEEE 754, of 32 or 64 bits."),
    with("out[].signals[].scale", Number, "1.0", "Value = raw * scale + offset."),
    with("out[].signals[].offset", Number, "0.0", "Value = raw * scale + offset."),
    need("out[].signals[].from", Address, "Place in %Q or %M."),
    may(
        "out[].signals[].type",
        Choice(TYPES),
        "by the width of `from` and `signed`",
        "IEC type of the value.",
    ),
    may("out[].signals[].symbol", Text, "none", "Name of a global variable for the program."),
];
