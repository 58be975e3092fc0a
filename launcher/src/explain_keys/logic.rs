//! Keys of the plc.

#[allow(clippy::enum_glob_use, reason = "tables of one line a key")]
use super::ValueKind::*;
use super::{KeyDoc, may, need, with};

/// Keys of kind `plc`.
pub const PLC: &[KeyDoc] = &[
    with(
        "program",
        List(&File),
        "[]",
        "Source files of the program, or one compiled .wasm. Without any the service keeps the image and its routes.",
    ),
    may(
        "cycle",
        Duration,
        "10ms unless the program declares a TASK",
        "Period of the one implicit task. Not together with a TASK of the program.",
    ),
    with(
        "trigger",
        OneOf(&[Choice(&["cycle", "inputs"]), Table]),
        "\"cycle\"",
        "What starts a scan: the clock; each new sample of an input service; or { service = \"io\", event = \"sync\" }, each published SYNC of one service; the last two with the clock every `max_interval`.",
    ),
    need(
        "trigger.service",
        Service("canopen-master"),
        "The service whose event runs the implicit task. It has a sync_period and synchronous inputs.",
    ),
    need(
        "trigger.event",
        Choice(&["sync"]),
        "The inputs of one SYNC were published as one sample. Between two the implicit task does not run, unless `max_interval` is over.",
    ),
    with(
        "min_interval",
        Duration,
        "\"500us\"",
        "With a trigger other than the clock: shortest time between two scans.",
    ),
    with(
        "max_interval",
        Duration,
        "\"100ms\"",
        "Longest time between two scans; with a trigger other than the clock, between two runs of the implicit task.",
    ),
    with("input_bytes", Size, "\"4KiB\"", "Size of %I, at most 64KiB."),
    with("output_bytes", Size, "\"4KiB\"", "Size of %Q, at most 64KiB."),
    with("marker_bytes", Size, "\"4KiB\"", "Size of %M, at most 64KiB."),
    with(
        "addressing",
        Choice(&["element", "byte", "openplc"]),
        "\"element\"",
        "How %-addresses count: %IW1 is bytes 2 and 3 (element, as CODESYS V3), bytes 1 and 2 (byte, as OpenPCS and Siemens), or the second word of a table of its own (openplc).",
    ),
    may(
        "watchdog",
        Duration,
        "10 periods of the fastest task, 100ms to 1s",
        "Processor time after which a task is stopped as a fault.",
    ),
    with(
        "start_timeout",
        Duration,
        "\"1s\"",
        "How long the first scan waits for inputs that have not come yet.",
    ),
    with(
        "input_timeout",
        Duration,
        "\"500ms\"",
        "An input service that says nothing for so long counts as dead: its inputs turn bad.",
    ),
    with(
        "on_fault",
        Choice(&["stop", "restart_warm", "restart_cold"]),
        "\"stop\"",
        "What follows a fault of the program: it stays stopped, or starts again, at most once a second.",
    ),
    may(
        "retain_file",
        File,
        "STACK.SERVICE.retain beside the stack file",
        "Where RETAIN variables are kept on disk.",
    ),
    with(
        "route",
        Tables,
        "[]",
        "Moves inside the image, one [[service.route]] each, so that a gateway needs no program; at most 1024.",
    ),
    need("route[].from", Address, "Place that is read."),
    need("route[].to", Address, "Place in %Q or %M that is written."),
    may(
        "route[].type",
        Text,
        "by the size of `from`: BOOL, USINT, UINT, UDINT, ULINT",
        "IEC type of the source, e.g. \"INT\" or \"REAL\".",
    ),
    may("route[].to_type", Text, "that of the source, in the size of `to`", "IEC type of the target."),
    may("route[].scale", Number, "1", "to = from * scale + offset."),
    may("route[].offset", Number, "0", "to = from * scale + offset."),
    with(
        "route[].swap",
        Bool,
        "false",
        "Reverse the bytes of the source first, for values that are big-endian on their bus.",
    ),
    with(
        "route[].on_bad",
        OneOf(&[Choice(&["hold", "zero"]), Table]),
        "\"hold\"",
        "What is moved while the input is bad: nothing, zero, or a value of the target.",
    ),
    need("route[].on_bad.value", Number, "The value, in units of the target, not scaled."),
    with("debug", Bool, "false", "Compile breakpoint hooks in."),
    with(
        "real_to_int",
        Choice(&["fault", "clamp"]),
        "\"fault\"",
        "A REAL that does not fit its integer: fault of the program, or the nearest value.",
    ),
    with(
        "mod_by_zero",
        Choice(&["zero", "fault"]),
        "\"zero\"",
        "MOD by zero: 0, as the standard says, or fault of the program.",
    ),
];
