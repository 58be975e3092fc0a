//! Keys of the services at the network side and of recording.

#[allow(clippy::enum_glob_use, reason = "tables of one line a key")]
use super::ValueKind::*;
use super::{KeyDoc, may, need, with};

/// Keys of kind `modbus-server`.
pub const MODBUS_SERVER: &[KeyDoc] = &[
    with("enable", Bool, "true", "Whether the server listens."),
    may("plc", Service("plc"), "the only plc of the stack", "The plc service whose image is served."),
    with("tcp", Table, "{}", "Where the server listens and who may connect."),
    with(
        "tcp.address",
        Ip,
        "\"0.0.0.0\"",
        "Address of this machine to listen on; \"127.0.0.1\" serves this machine alone.",
    ),
    with(
        "tcp.port",
        Int(0, 65535),
        "502",
        "TCP port. The launcher opens it, so 502 needs privilege there only.",
    ),
    with("tcp.max_connections", Int(1, 1024), "8", "Most clients at once."),
    may(
        "tcp.filter",
        Table,
        "everybody may connect",
        "Who may connect besides loopback: start <= address <= end, and address & mask = start & mask.",
    ),
    need("tcp.filter.mask", Ip, "Bits of the address that must equal those of `start`."),
    need("tcp.filter.start", Ip, "First address that may connect."),
    need("tcp.filter.end", Ip, "Last address that may connect."),
    with(
        "tcp.idle_timeout",
        Duration,
        "\"60s\"",
        "A connection without a request for so long is closed; \"0s\" = never.",
    ),
    with(
        "tcp.when_full",
        Choice(&["refuse", "close_oldest_idle"]),
        "\"refuse\"",
        "What a new client gets when `tcp.max_connections` is reached: refused, or the place of the client that has been idle longest.",
    ),
    may("units", List(&Int(0, 255)), "every unit", "Unit ids that are answered besides 0 and 255."),
    with(
        "map",
        OneOf(&[Choice(&["dinrail", "openplc"]), Tables]),
        "\"dinrail\"",
        "Which register shows which part of the image: a ready map, or [[service.map]] tables.",
    ),
    need(
        "map[].table",
        Choice(&["coils", "discrete_inputs", "input_registers", "holding_registers"]),
        "The Modbus table.",
    ),
    need("map[].at", Int(0, 65535), "First address, counted from 0 as on the wire."),
    need("map[].count", Int(1, 65536), "Number of bits or registers."),
    need("map[].area", Address, "%-address of the first one."),
    may(
        "map[].word_order",
        Choice(&["low_first", "high_first"]),
        "low_first",
        "Order of the registers of a 32- or 64-bit value; only for %xD and %xL.",
    ),
    with("map[].swap_bytes", Bool, "false", "Exchange the two bytes of every register."),
    with(
        "map[].own",
        Bool,
        "false",
        "The server owns this part of %I: clients write it, the program reads it.",
    ),
    with(
        "on_stop",
        Choice(&["exception", "hold"]),
        "\"exception\"",
        "What requests get while the PLC does not run: exception 04, or the last image.",
    ),
    with(
        "stale_after",
        Duration,
        "\"200ms\"",
        "Age from which the image is not believed: reads and writes get exception 04. At least three times `max_interval` of the plc.",
    ),
    may(
        "write_watchdog",
        Duration,
        "no watchdog",
        "When no client has written for so long, `watchdog_values` are written.",
    ),
    with("watchdog_values", Tables, "[]", "What is written when `write_watchdog` expires."),
    need("watchdog_values[].to", Address, "Where to write, in %Q or %M."),
    need(
        "watchdog_values[].value",
        OneOf(&[Bool, Int(i64::MIN, i64::MAX)]),
        "true or false for a bit, else a whole number.",
    ),
];

/// Keys of kind `recorder`.
pub const RECORDER: &[KeyDoc] = &[
    with("dir", File, "\"recordings\"", "Folder of the recordings; made when missing."),
    with("max_size", Size, "\"100MiB\"", "A new file begins at this size; at least 1MiB."),
    may("max_time", Duration, "no limit", "A new file begins at this age; at least 10s."),
    with(
        "keep",
        Size,
        "\"2GiB\"",
        "Bytes that the recordings of the stack take together; beyond it the oldest finished ones are deleted.",
    ),
    with("min_free", Size, "\"64MiB\"", "Recording pauses while the file system has less free than this."),
    with(
        "flush_interval",
        Duration,
        "\"50ms\"",
        "A message is in the file at most this long after it was taken, which is what kill -9 can lose; 5ms to 1s.",
    ),
    with("compression", Choice(&["zstd", "none"]), "\"zstd\"", "How chunks of the file are compressed."),
    with(
        "index",
        Bool,
        "false",
        "Write indexes for readers that jump to a time or topic (Foxglove, PlotJuggler), 16 bytes a message; without, they read the file from the start.",
    ),
    with(
        "exclude",
        List(&Text),
        "[]",
        "Topics that are not recorded; a trailing * stands for any ending, e.g. \"can0/*\".",
    ),
];

/// Keys of kind `replay`.
pub const REPLAY: &[KeyDoc] = &[
    need("file", File, "The recording (MCAP)."),
    may(
        "source",
        Text,
        "NAME/rx with the name of this service",
        "Topic of the recording whose frames are sent, e.g. \"can0/rx\".",
    ),
    with(
        "speed",
        OneOf(&[Number, Choice(&["max"])]),
        "1.0",
        "2.0 is twice as fast as recorded, 0.01 to 1000; \"max\" is as fast as readers of the rail can take.",
    ),
    with("loop", Bool, "false", "Begin again at the end."),
    with("start", Duration, "\"0s\"", "Skip so much of the recording from the first frame on."),
    with("echoes", Bool, "true", "Also send the frames that the recorded stack itself had sent."),
];
