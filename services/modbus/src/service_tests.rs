use super::status::{LineStatus, RtuOverTcpStatus, StatusBody};
use super::*;
use crate::Config;
use crate::line::LineCounters;
use crate::process_image::WriteCounters;
use crate::tcp::{ClientInfo, Counters};
use crate::watchdog::WatchdogState;
use insta::assert_snapshot;
use ipc_types::payload::PlcState;
use ipc_types::port::ReadCounters;
use ipc_types::topic::TopicKind;
use ipc_types::wiring::{Area, Neighbours};
use ipc_types::{Finding, Stack, Wiring};

fn config(json: &str) -> Config {
    serde_json::from_str(json).unwrap()
}

fn neighbours(plcs: &[&str]) -> Neighbours {
    Neighbours {
        name: "modbus".to_owned(),
        services: plcs.iter().map(|name| ((*name).to_owned(), "plc".to_owned())).collect(),
        ..Neighbours::default()
    }
}

fn check_it(config: &Config, stack: &Stack) -> Vec<Finding> {
    let me = ServiceEntry {
        name: "modbus".to_owned(),
        kind: KIND.to_owned(),
        index: 9,
        config: serde_json::Value::Null,
        wiring: Wiring::default(),
    };
    check(config, stack, &me)
}

fn stack(plcs: &[(&str, &str)]) -> Stack {
    let services = plcs
        .iter()
        .enumerate()
        .map(|(i, (name, config))| ServiceEntry {
            name: (*name).to_owned(),
            kind: "plc".to_owned(),
            index: i as u32 + 1,
            config: serde_json::from_str(config).unwrap(),
            wiring: Wiring::default(),
        })
        .collect();
    Stack {
        name: "test".to_owned(),
        file: "test.toml".into(),
        dir: ".".into(),
        text: String::new(),
        build_id: String::new(),
        root: "/nowhere".into(),
        prefix: "x".to_owned(),
        services,
        topics: Vec::new(),
    }
}

#[test]
fn wiring_of_the_default() {
    let wiring = topics(&Config::default(), &neighbours(&["plc"]));
    assert_eq!(
        wiring.reads.iter().map(|r| (r.topic.as_str(), r.wake)).collect::<Vec<_>>(),
        [("plc/image", false)]
    );
    assert_eq!(wiring.writes, [("plc/writes".to_owned(), "plc".to_owned())]);
    assert_eq!(wiring.plc.as_deref(), Some("plc"));
    let kinds: Vec<_> = wiring.topics.iter().map(|topic| topic.kind).collect();
    assert_eq!(kinds, [TopicKind::Jobs, TopicKind::Results]);
    assert!(wiring.inputs.is_empty());
    assert_eq!(wiring.listeners.len(), 1);
    assert_eq!(wiring.listeners[0].address.to_string(), "0.0.0.0:502");
    // Open all the same: it may be switched on while it runs.
    assert_eq!(topics(&config(r#"{ "enable": false }"#), &neighbours(&["plc"])).listeners.len(), 1);
    assert!(topics(&Config::default(), &neighbours(&["a", "b"])).plc.is_none());
    assert_eq!(topics(&config(r#"{ "plc": "b" }"#), &neighbours(&["a", "b"])).plc.as_deref(), Some("b"));
}

#[test]
fn owned_inputs_are_declared_with_room_for_their_message() {
    let config = config(
        r#"{ "map": [ { "table": "holding", "at": 0, "count": 4096, "area": "%IW16", "own": true },
                      { "table": "coils", "at": 0, "count": 16, "area": "%IX0.0", "own": true },
                      { "table": "coils", "at": 20, "count": 10, "area": "%QX1.7" } ] }"#,
    );
    let wiring = topics(&config, &neighbours(&["plc"]));
    let ranges: Vec<_> =
        wiring.inputs.iter().map(|r| (r.byte, r.bytes, r.key.as_str(), r.label.as_str())).collect();
    assert_eq!(
        ranges,
        [
            (0, 2, "map[1].area", "coils 0.. written by Modbus clients"),
            (32, 8192, "map[0].area", "holding_registers 0.. written by Modbus clients")
        ]
    );
    let shown: Vec<_> = wiring.outputs.iter().map(|r| (r.area, r.byte, r.bytes, r.label.as_str())).collect();
    assert_eq!(shown, [(Area::Output, 1, 3, "coils 20-29")]);
    assert_eq!(wiring.topics.len(), 3);
    assert_eq!(wiring.topics[0].max_tail, 8196);
}

#[test]
fn wiring_of_lines_and_the_list_of_clients() {
    let config = config(
        r#"{ "serial": [ { "port": "com1" }, { "port": "com2", "mode": "ascii", "unit": [1, 2] } ],
             "rtu_over_tcp": { "port": 4001, "max_connections": 3 }, "clients_to": "%IB100",
             "map": [ { "table": "holding", "at": 0, "count": 2, "area": "%IW60", "own": true } ] }"#,
    );
    let wiring = topics(&config, &neighbours(&["plc"]));
    let reads: Vec<_> = wiring.reads.iter().map(|r| (r.topic.as_str(), r.wake, r.key.as_str())).collect();
    assert_eq!(
        reads,
        [
            ("plc/image", false, "plc"),
            ("com1/rx", true, "serial[0].port"),
            ("com2/rx", true, "serial[1].port")
        ]
    );
    assert_eq!(wiring.writes[2], ("com2/tx".to_owned(), "serial[1].port".to_owned()));
    assert_eq!(wiring.listeners.iter().map(|l| l.key.as_str()).collect::<Vec<_>>(), ["rtu_over_tcp.port"]);
    let ranges: Vec<_> = wiring.inputs.iter().map(|r| (r.byte, r.bytes, r.key.as_str())).collect();
    assert_eq!(ranges, [(120, 4, "map[0].area"), (100, 20, "clients_to")]);
}

#[test]
fn a_good_table_has_no_findings() {
    let good = config(r#"{ "tcp": { "address": "127.0.0.1" } }"#);
    for plc in ["{}", r#"{ "cycle": "1s" }"#, r#"{ "trigger": "inputs", "max_interval": "1s" }"#] {
        assert_eq!(check_it(&good, &stack(&[("plc", plc)])), [], "{plc}");
    }
}

#[test]
fn findings_name_key_mistake_and_remedy() {
    let one = [("plc", "{}")];
    let local = r#""tcp": { "address": "127.0.0.1" }"#;
    let cases: &[(&str, &[(&str, &str)])] = &[
        ("{}", &one),
        (r#"{ "tcp": { "address": "127.0.0.1", "max_connections": 0 } }"#, &one),
        (
            r#"{ "tcp": { "filter": { "mask": "255.255.255.0", "start": "10.0.0.9", "end": "10.0.0.1" } } }"#,
            &one,
        ),
        (&format!("{{ {local} }}"), &[]),
        (&format!("{{ {local} }}"), &[("a", "{}"), ("b", "{}")]),
        (&format!(r#"{{ {local}, "plc": "c" }}"#), &[("a", "{}"), ("b", "{}")]),
        // Fits where addresses count bytes only: as those of the plc.
        (
            &format!(
                r#"{{ {local}, "map": [ {{ "table": "holding", "at": 0, "count": 9, "area": "%MW8" }} ] }}"#
            ),
            &[("plc", r#"{ "marker_bytes": "32B" }"#)],
        ),
        (&format!(r#"{{ {local}, "stale_after": "0" }}"#), &one),
        (&format!(r#"{{ {local}, "stale_after": "10ms" }}"#), &[("plc", r#"{ "cycle": "1ms" }"#)]),
        (&format!(r#"{{ {local}, "stale_after": "199ms" }}"#), &[("plc", r#"{ "trigger": "inputs" }"#)]),
        (
            &format!(
                r#"{{ {local}, "map": [ {{ "table": "holding", "at": 0, "count": 9, "area": "%MW0" }} ] }}"#
            ),
            &[("plc", r#"{ "marker_bytes": "16B" }"#)],
        ),
        (&format!(r#"{{ {local}, "units": [] }}"#), &one),
        (
            &format!(
                r#"{{ {local}, "map": [ {{ "table": "coils", "at": 0, "count": 1, "area": "%QW0" }} ] }}"#
            ),
            &one,
        ),
        (&format!(r#"{{ {local}, "write_watchdog": "2s" }}"#), &one),
        (&format!(r#"{{ {local}, "watchdog_values": [ {{ "to": "%QB0", "value": 1 }} ] }}"#), &one),
        (
            &format!(
                r#"{{ {local}, "write_watchdog": "50ms", "watchdog_values": [ {{ "to": "%QB0", "value": 256 }} ] }}"#
            ),
            &one,
        ),
    ];
    let wrong = [
        r#""serial": [ { "port": "com1", "unit": [5, 5, 248] }, { "port": "com1", "answer_within": "0" } ]"#,
        r#""unit": [ { "id": 0, "map": "dinrail" }, { "id": 3, "map": "dinrail" }, { "id": 3, "map": "openplc" } ]"#,
        r#""rights": [ { "peer": "com7", "allow": "read" } ]"#,
        r#""identity": { "extended": [ { "id": 1, "value": "" } ] }"#,
        r#""clients_to": "%IB4090""#,
        r#""file": [ { "number": 1, "area": "%MW3000", "records": 1 } ]"#,
    ]
    .map(|keys| format!(r#"{{ "tcp": {{ "address": "127.0.0.1" }}, {keys} }}"#));
    let cases = cases.iter().copied().chain(wrong.iter().map(|json| (json.as_str(), &one[..])));
    let mut text = String::new();
    for (json, plcs) in cases {
        let findings = check_it(&config(json), &stack(plcs));
        assert!(!findings.is_empty(), "{json}");
        for f in findings {
            text.push_str(&format!("{:?} {}: {} -> {}\n", f.severity, f.key, f.message, f.help));
        }
    }
    assert_snapshot!(text, @r#"
Warning tcp: Modbus has no passwords: whoever reaches this port can write outputs and markers -> add filter = { mask = ..., start = ..., end = ... }, or address = "127.0.0.1"
Error tcp.max_connections: max_connections = 0 is not 1 to 1024 -> 8 is the default
Error tcp.filter: filter: start 10.0.0.9 lies behind end 10.0.0.1: nobody could connect -> exchange start and end, or correct them
Error plc: the stack has no plc service whose image could be served -> add a [[service]] with kind = "plc"; it works without a program too
Error plc: the stack has 2 plc services; which one is served? -> set plc to one of: a, b
Error plc: there is no plc service 'c' -> set plc to one of: a, b
Error map[0]: map table 1: holding_registers 0 to 8 reaches byte 34 of %M, which has 32; lower count or raise the size of %M in the plc service -> see the page on the Modbus server for what a [[service.map]] table takes
Error stale_after: stale_after = 0ns is shorter than 3 times the longest time between two scans of 'plc' -> leave it out (200ms) or set at least "30ms"
Warning stale_after: stale_after = 10ms is short: a plc process delayed by the system looks dead -> 200ms is the default
Error stale_after: stale_after = 199ms is shorter than 3 times the longest time between two scans of 'plc' -> leave it out (200ms) or set at least "200ms"
Error map[0]: map table 1: holding_registers 0 to 8 reaches byte 18 of %M, which has 16; lower count or raise the size of %M in the plc service -> see the page on the Modbus server for what a [[service.map]] table takes
Warning units: only units 0 and 255 are served -> leave units out to serve all, or list unit identifiers
Error map[0]: map table 1: coils shows single bits, so area must be %QX... or %QB...; got %QW0 -> see the page on the Modbus server for what a [[service.map]] table takes
Error write_watchdog: the watchdog has nothing to write -> add watchdog_values = [ { to = "%QW0", value = 0 } ]
Error watchdog_values: values without write_watchdog -> set write_watchdog, e.g. "2s", or remove the values
Error watchdog_values[0]: watchdog value 1: 256 does not fit %QB0, which takes -128 to 255 -> correct or remove the value
Error write_watchdog: write_watchdog = 50ms is shorter than it is looked at -> set at least "100ms", and twice the clients' period
Error serial[0].unit: unit 248 is no address of a device -> units are 1 to 247; 0 is the broadcast, 248 to 255 are reserved
Error serial[0].unit: unit 5 stands there twice -> remove one
Error serial[1].port: 'com1' is served twice -> give the one line all units: unit = [1, 2]
Error serial[1].answer_within: no answer could be in time -> leave it out (1s)
Error unit[0].id: unit 0 is no address of a device -> units are 1 to 247; 0 is the broadcast, 248 to 255 are reserved
Error unit[2].id: unit 3 has two maps -> remove one [[service.unit]] table
Error rights[0]: rights 1: 'com7' is no IP address, no network like 192.168.1.0/24 and no serial port of this server -> see the page on the Modbus server for what a [[service.rights]] table takes
Error identity: identity.extended 1: id 1 is not 128 to 255; lower ones belong to the named objects -> shorten or correct it
Error clients_to: the list of clients reaches byte 4140 of %I, which has 4096 -> take an earlier place, lower max_connections, or raise input_bytes of the plc service
Error file[0]: file 1: it reaches byte 6002 of %M, which has 4096; make it smaller or raise the size of %M in the plc service -> see the page on the Modbus server for files and queues
"#);
}

#[test]
fn a_unit_of_a_line_has_one_server() {
    let mut stack = stack(&[("plc", "{}")]);
    let server = |json: &str| ServiceEntry {
        name: "other".to_owned(),
        kind: KIND.to_owned(),
        index: 2,
        config: serde_json::from_str(json).unwrap(),
        wiring: Wiring::default(),
    };
    let mine =
        config(r#"{ "plc": "plc", "serial": [ { "port": "com1", "unit": [4, 5], "answer_255": true } ] }"#);
    let mut said = Vec::new();
    for theirs in [
        r#"{ "serial": [ { "port": "com1", "unit": 5 } ] }"#,
        r#"{ "serial": [ { "port": "com1", "unit": 6, "answer_255": true } ] }"#,
        r#"{ "serial": [ { "port": "com1", "unit": 6 }, { "port": "com2", "unit": 5 } ] }"#,
        "{ }",
    ] {
        stack.services.truncate(1);
        stack.services.push(server(theirs));
        said.extend(
            check_it(&mine, &stack).iter().map(|f| format!("{}: {} -> {}", f.key, f.message, f.help)),
        );
    }
    assert_snapshot!(said.join("\n"), @r#"
serial[0].unit: unit 5 on 'com1' is answered by 'other' too -> two answers at once are none: give each unit of a line to one server
serial[0].unit: unit 255 on 'com1' is answered by 'other' too -> two answers at once are none: give each unit of a line to one server
"#);
}

#[test]
fn addresses_count_as_in_the_plc() {
    let config = config(
        r#"{ "tcp": { "address": "127.0.0.1" }, "map": [
            { "table": "holding", "at": 0, "count": 9, "area": "%MW8" },
            { "table": "holding", "at": 9, "count": 2, "area": "%IW8", "own": true } ] }"#,
    );
    assert_eq!(
        check_it(&config, &stack(&[("plc", r#"{ "marker_bytes": "32B", "addressing": "byte" }"#)])),
        []
    );
    for (addressing, byte) in [("element", 16), ("byte", 8), ("openplc", 1040)] {
        let plc_addressing = [("plc".to_owned(), addressing.to_owned())].into();
        let wiring = topics(&config, &Neighbours { plc_addressing, ..neighbours(&["plc"]) });
        assert_eq!((wiring.outputs[0].byte, wiring.inputs[0].byte), (byte, byte), "{addressing}");
    }
}

#[test]
fn the_largest_status_fits_its_topic() {
    let client = ClientInfo {
        address: "2001:db8:1111:2222:3333:4444:5555:6666".parse().unwrap(),
        port: 65535,
        connected_s: u64::from(u32::MAX),
        idle_s: u64::from(u32::MAX),
        requests: u64::MAX / 2,
        exceptions: u64::MAX / 2,
        last_unit: 255,
        last_function: 255,
    };
    let counters =
        LineCounters { bus_messages: u64::MAX, by_exception: [u64::MAX; 12], ..LineCounters::default() };
    let line = || LineStatus {
        port: "a_long_name_of_a_serial_port",
        counters: &counters,
        rail: ReadCounters::default(),
    };
    let lines: Vec<_> = (0..crate::config::MAX_LINES).map(|_| line()).collect();
    let body = StatusBody {
        enabled: false,
        rtu_over_tcp: Some(RtuOverTcpStatus { listen: None, counters: Counters::default() }),
        serial: &lines,
        listen: Some("[2001:db8:1111:2222:3333:4444:5555:6666]:65535".parse().unwrap()),
        serving: false,
        plc_state: Some(PlcState::Starting),
        plc_generation: Some(u32::MAX),
        image_age_ms: Some(u64::MAX),
        clients: 1024,
        client_list: vec![client; MAX_LISTED_CLIENTS],
        counters: Counters { requests: u64::MAX, by_exception: [u64::MAX; 12], ..Counters::default() },
        writes: WriteCounters::default(),
        writes_pending: 256,
        writes_refused_by_plc: u64::MAX,
        watchdog: Some(WatchdogState::Waiting),
        image: ReadCounters::default(),
    };
    let bytes = serde_json::to_vec(&body).unwrap().len();
    assert!(bytes <= TopicKind::Status.row().max_tail as usize, "{bytes}");
}
