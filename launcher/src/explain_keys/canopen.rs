//! Keys of CANopen services.

#[allow(clippy::enum_glob_use, reason = "tables of one line a key")]
use super::ValueKind::*;
use super::{KeyDoc, ValueKind, may, need, with};

/// A number of the stack file: `5`, `"0x1F"`, `"$NODEID+0x180"`.
const NUMBER: ValueKind = OneOf(&[Int(i64::MIN, i64::MAX), Bool, Number, Text]);
/// An identifier: `5` or `"0x1F"`.
const ID: ValueKind = OneOf(&[Int(0, u32::MAX as i64), Text]);
/// States of the PLC.
const STATES: ValueKind = List(&Choice(&["stop", "fault", "halted"]));

/// Keys of kind `canopen-master`.
pub const CANOPEN_MASTER: &[KeyDoc] = &[
    may("bus", Service("can"), "the only can of the stack", "The CAN bus of the network."),
    may("plc", Service("plc"), "the only plc of the stack", "The plc service whose image is exchanged."),
    with("node_id", Int(1, 127), "1", "The master's own node-id."),
    may("sync_period", Duration, "no SYNC", "Time between two SYNC messages; 1ms or more."),
    may(
        "sync_window",
        Duration,
        "sync_period",
        "Time after a SYNC in which synchronous PDOs belong to it (1007h); what comes later is not taken.",
    ),
    with(
        "sync_overflow",
        Int(0, 240),
        "0",
        "The SYNC carries a counter from 1 to this value (1019h); 0 = no counter.",
    ),
    with(
        "sync_cob_id",
        Int(1, 2047),
        "0x80",
        "COB-ID of the SYNC (1005h): 0x80, 0x181 to 0x57F or 0x680 to 0x6DF. Written to nodes whose EDS has another.",
    ),
    may("time_period", Duration, "no TIME", "Time between two TIME messages (1012h)."),
    with(
        "heartbeat",
        Duration,
        "\"500ms\"",
        "Time between two heartbeats of the master (1017h); \"0s\" = none.",
    ),
    with("start_nodes", Bool, "true", "Nodes are started as soon as they are booted (1F80h bit 3 clear)."),
    with(
        "start_all_nodes",
        Bool,
        "false",
        "All nodes are started with one message when every mandatory one is booted (1F80h bit 1).",
    ),
    with("reset_all_nodes", Bool, "false", "The loss of a mandatory node resets all nodes (1F80h bit 4)."),
    with("stop_all_nodes", Bool, "false", "The loss of a mandatory node stops all nodes (1F80h bit 6)."),
    with(
        "boot_time",
        Duration,
        "\"10s\"",
        "How long mandatory nodes may take to boot before a fault is reported (1F89h); \"0s\" = for ever.",
    ),
    with("nmt_inhibit_time", Duration, "\"0s\"", "Least time between two NMT commands (102Ah)."),
    with("sdo_timeout", Duration, "\"500ms\"", "Longest wait for the answer of an SDO server."),
    with("sdo_tries", Int(1, 255), "3", "How often an SDO transfer of the boot-up is tried."),
    with(
        "stale_after",
        Duration,
        "\"200ms\"",
        "Age of the image from which outputs go to their safe state. At least three times `max_interval` of the plc.",
    ),
    with(
        "safe_on",
        STATES,
        "[\"stop\", \"fault\", \"halted\"]",
        "States of the plc in which outputs go to their safe state; a stale image always does.",
    ),
    with(
        "on_stop",
        OneOf(&[Choice(&["zero", "hold", "preop", "stop"]), Table]),
        "\"zero\"",
        "Safe state of the outputs: all zero, the last ones, NMT pre-operational, NMT stop, or { values = [...] }.",
    ),
    need("on_stop.values", Tables, "Values of the safe state; outputs that are not named become zero."),
    need("on_stop.values[].from", Address, "The %-address, as in the map."),
    need("on_stop.values[].value", NUMBER, "Its value."),
    with("node", Tables, "[]", "The nodes of the network, as [[service.node]]."),
    need("node[].id", Int(1, 127), "Node-id."),
    may("node[].name", Text, "product name of the EDS", "Name for messages."),
    may("node[].eds", File, "no EDS", "EDS or DCF of the device; the values of a DCF are written at boot."),
    with("node[].mandatory", Bool, "false", "The network is incomplete without it (1F81h bit 3)."),
    with("node[].boot", Bool, "true", "The master configures and starts it (1F81h bit 2)."),
    with(
        "node[].keep_alive",
        Bool,
        "false",
        "A node that runs is not reset when the master starts (1F81h bit 4). A restarted master never resets one.",
    ),
    may(
        "node[].heartbeat",
        Duration,
        "no heartbeat",
        "Producer heartbeat time written to the node (1017h), whole ms up to 65535ms; it is lost after three times as long.",
    ),
    may(
        "node[].guarding",
        Table,
        "no guarding",
        "Node guarding by remote frames, instead of heartbeat; not both.",
    ),
    need("node[].guarding.time", Duration, "Guard time (100Ch)."),
    need("node[].guarding.factor", Int(1, 255), "Life time factor (100Dh)."),
    with(
        "node[].check",
        List(&Choice(&["device_type", "vendor", "product", "revision", "serial"])),
        "[\"device_type\", \"vendor\", \"product\"]",
        "What of the node's identity (1000h, 1018h) must be as in the EDS before it is configured.",
    ),
    may("node[].device_type", ID, "the EDS's", "Expected 1000h, as 401 or \"0x191\"."),
    may("node[].vendor_id", ID, "the EDS's", "Expected 1018h:01, as 401 or \"0x191\"."),
    may("node[].product_code", ID, "the EDS's", "Expected 1018h:02, as 401 or \"0x191\"."),
    may("node[].revision", ID, "the EDS's", "Expected 1018h:03, as 401 or \"0x191\"."),
    may("node[].serial_number", ID, "not checked", "Expected 1018h:04, as 401 or \"0x191\"."),
    may(
        "node[].config_date",
        Int(0, u32::MAX as i64),
        "always configured",
        "Days since 1984-01-01 (1F26h): a node whose 1020h:01 and :02 are equal keeps its configuration.",
    ),
    may(
        "node[].config_time",
        Int(0, u32::MAX as i64),
        "always configured",
        "Milliseconds since midnight (1F27h).",
    ),
    with(
        "node[].restore",
        Choice(&["no", "all", "communication", "application"]),
        "\"no\"",
        "Defaults restored (1011h) before the node is configured (1F81h bit 7).",
    ),
    with("node[].sdo", Tables, "[]", "Objects written at boot, in this order, before the PDOs."),
    need("node[].sdo[].object", Text, "\"6423:00\", both parts in hex, or the object's name in the EDS."),
    need("node[].sdo[].value", NUMBER, "A value of the object's type; $NODEID stands for the node-id."),
    with("node[].tpdo", Tables, "[]", "Transmit PDOs of the node that differ from its EDS."),
    need("node[].tpdo[].number", Int(1, 512), "Number of the PDO, from 1."),
    with("node[].tpdo[].enabled", Bool, "true", "Whether it exists."),
    may("node[].tpdo[].cob_id", ID, "the EDS's", "Its COB-ID, as \"0x1C5\" or \"$NODEID+0x180\"."),
    may(
        "node[].tpdo[].transmission",
        TRANSMISSION,
        "the EDS's; 1 with sync_period",
        "Transmission type: 0 on change at SYNC, 1-240 every n-th SYNC, 252 \"sync_rtr\", 253 \"rtr\", 254, 255 \"event\".",
    ),
    may("node[].tpdo[].inhibit_time", Duration, "the EDS's", "Least time between two, in steps of 100us."),
    may(
        "node[].tpdo[].event_timer",
        Duration,
        "the EDS's",
        "Sent after this time also without change, in ms.",
    ),
    may("node[].tpdo[].sync_start", Int(0, 240), "the EDS's", "SYNC counter value at which it starts."),
    may("node[].tpdo[].mapping", List(&Text), "the EDS's", "Objects in it, at most 8 bytes."),
    with("node[].rpdo", Tables, "[]", "Receive PDOs of the node that differ from its EDS."),
    need("node[].rpdo[].number", Int(1, 512), "Number of the PDO, from 1."),
    with("node[].rpdo[].enabled", Bool, "true", "Whether it exists."),
    may("node[].rpdo[].cob_id", ID, "the EDS's", "Its COB-ID, as \"0x245\" or \"$NODEID+0x200\"."),
    may(
        "node[].rpdo[].transmission",
        TRANSMISSION,
        "the EDS's; 1 with sync_period",
        "Transmission type, as of tpdo.",
    ),
    may("node[].rpdo[].inhibit_time", Duration, "the EDS's", "Least time between two that the master sends."),
    may(
        "node[].rpdo[].event_timer",
        Duration,
        "the EDS's",
        "The master sends it at least so often; the node reports an error when it does not come.",
    ),
    may("node[].rpdo[].sync_start", Int(0, 240), "none", "Not used by receive PDOs."),
    may("node[].rpdo[].mapping", List(&Text), "the EDS's", "Objects in it, at most 8 bytes."),
    with("node[].map", Tables, "[]", "Objects to and from the process image."),
    need("node[].map[].object", Text, "\"6000:01\", both parts in hex, or the object's name in the EDS."),
    may("node[].map[].to", Address, "none", "Place in %I, for what the node sends."),
    may("node[].map[].from", Address, "none", "Place in %Q or %M, for what the node receives."),
    may("node[].map[].symbol", Text, "no variable", "Name of a global variable for the program."),
    with(
        "node[].map[].on_bad",
        Choice(&["hold", "zero"]),
        "\"hold\"",
        "Value of the input while the node is not operational.",
    ),
    may(
        "node[].map[].status_to",
        Address,
        "none",
        "%IB that shows the quality: 0 good, 1 stale, 2 no data, 3 dead.",
    ),
    may(
        "node[].map[].queue",
        Int(1, 64),
        "the newest value counts",
        "Every received value of the PDO reaches one scan, in order; so many wait, then the oldest of them is dropped. The same for all objects of a PDO.",
    ),
    with(
        "node[].on_error",
        Choice(&["zero", "ignore", "stop"]),
        "\"zero\"",
        "When the node is lost: its process data stops until it is booted again, nothing, or all nodes are stopped.",
    ),
    may("node[].sdo_timeout", Duration, "the master's", "Longest wait for an answer of this node."),
    may(
        "node[].status_to",
        Address,
        "none",
        "%IB that shows its NMT state: 0 unknown, 4 stopped, 5 operational, 127 pre-operational.",
    ),
];

/// Transmission types.
const TRANSMISSION: ValueKind = OneOf(&[Int(0, 255), Choice(&["event", "rtr", "sync_rtr", "acyclic"])]);

/// Keys of kind `canopen-slave`.
pub const CANOPEN_SLAVE: &[KeyDoc] = &[
    may("bus", Service("can"), "the only can of the stack", "The CAN bus of the network."),
    may("plc", Service("plc"), "the only plc of the stack", "The plc service whose image is the device."),
    need("node_id", Int(1, 255), "Node-id 1 to 127; 255 = the device waits until LSS gives it one."),
    may("eds", File, "none", "EDS or DCF that says which objects the device has."),
    may(
        "simulate",
        Choice(&["401"]),
        "no simulation",
        "A ready device instead of an EDS: \"401\" has digital and analogue inputs that show its outputs.",
    ),
    may(
        "store",
        File,
        "storing is refused",
        "File that keeps objects stored by 1010h; the node-id set by LSS is kept beside it.",
    ),
    may("serial_number", Int(0, u32::MAX as i64), "the EDS's", "Serial number (1018h:04)."),
    with(
        "stale_after",
        Duration,
        "\"200ms\"",
        "Age of the image from which the device sends an EMCY and acts as 1029h says.",
    ),
    with("map", Tables, "[]", "Objects to and from the process image."),
    need("map[].object", Text, "\"6200:01\", both parts in hex, or the object's name in the EDS."),
    may("map[].to", Address, "none", "Place in %I, for what the network writes."),
    may("map[].from", Address, "none", "Place in %Q or %M, for what the network reads."),
    may("map[].symbol", Text, "no variable", "Name of a global variable for the program."),
    with("map[].on_bad", Choice(&["hold", "zero"]), "\"hold\"", "Value while the device is not operational."),
];
