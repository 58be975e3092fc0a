//! From the stack file to requests.

use super::*;
use serde_json::{Value, json};

fn planned(value: Value) -> Plan {
    plan(&serde_json::from_value(value).unwrap(), Addressing::Element)
}

fn said(value: Value) -> String {
    let mistakes = planned(value).mistakes;
    mistakes.iter().map(|m| format!("{}: {} -> {}", m.key, m.message, m.help)).collect::<Vec<_>>().join("\n")
}

fn read(at: u16, to: &str) -> Value {
    json!({ "unit": 5, "table": "holding", "at": at, "to": to })
}

#[test]
fn ranges_near_each_other_are_read_at_once() {
    let plan = planned(json!({
        "serial": "com1", "max_gap": 2, "max_batch": 10,
        "read": [
            read(0, "%IW0"), read(3, "%IW1"), read(6, "%IW2"), read(9, "%IW3"), read(10, "%IW4"),
            { "unit": 5, "table": "holding", "at": 100, "count": 4, "to": "%ID8" },
            { "unit": 5, "table": "holding", "at": 1, "to": "%IW30", "period": "50ms" },
            { "unit": 6, "table": "holding", "at": 4, "to": "%IW31" },
            { "unit": 5, "table": "coils", "at": 7, "to": "%IX80.3" },
            { "unit": 5, "table": "coils", "at": 8, "count": 12, "to": "%IX81.0" },
        ],
    }));
    assert_eq!(plan.mistakes, []);
    let line = &plan.lines[0];
    let shown: Vec<_> = line
        .batches
        .iter()
        .map(|b| {
            format!(
                "{} {} {}+{} {:?} {:?} {}",
                b.unit,
                b.table.name(),
                b.at,
                b.count,
                b.members,
                b.alone,
                b.enabled
            )
        })
        .collect();
    assert_eq!(
        shown,
        [
            "5 coils 7+13 [(8, 0), (9, 1)] [6, 7] true",
            "5 holding_registers 1+1 [(6, 0)] [] true",
            "5 holding_registers 0+10 [(0, 0), (1, 3), (2, 6), (3, 9)] [8, 9, 10, 11] true",
            "5 holding_registers 10+1 [(4, 0)] [] true",
            "5 holding_registers 100+4 [(5, 0)] [] true",
            "6 holding_registers 4+1 [(7, 0)] [] true",
            "5 coils 7+1 [(8, 0)] [] false",
            "5 coils 8+12 [(9, 0)] [] false",
            "5 holding_registers 0+1 [(0, 0)] [] false",
            "5 holding_registers 3+1 [(1, 0)] [] false",
            "5 holding_registers 6+1 [(2, 0)] [] false",
            "5 holding_registers 9+1 [(3, 0)] [] false",
        ]
    );
    let two = &plan.reads[5];
    assert_eq!((two.byte, two.bytes, two.group, two.timeout_ns), (32, 8, 2, 5_000_000_000));
    assert_eq!((plan.reads[8].bit, plan.reads[9].bit, plan.reads[9].bytes), (Some(3), None, 2));
}

#[test]
fn units_and_their_lines() {
    let plan = planned(json!({
        "tcp": "10.0.0.1:502", "retries": 3,
        "unit": [
            { "id": 1, "name": "a", "tcp": "10.0.0.2:502", "response_timeout": "300ms" },
            { "id": 1, "name": "b", "tcp": "10.0.0.3:502", "retries": 0 },
            { "id": 2, "name": "c", "tcp": "10.0.0.3:502" },
        ],
        "read": [
            { "unit": "a", "table": "input", "at": 0, "to": "%IW0" },
            { "unit": "c", "table": "input", "at": 0, "to": "%IW1" },
            { "unit": 9, "table": "input", "at": 0, "to": "%IW2" },
            { "unit": 2, "table": "input", "at": 0, "to": "%IW3" },
        ],
        "write": [{ "unit": "b", "table": "coils", "at": 3, "from": "%QX0.5", "safe_values": [1] }],
    }));
    assert_eq!(plan.mistakes, []);
    assert_eq!(
        plan.reads.iter().map(|r| (r.line, r.unit)).collect::<Vec<_>>(),
        [(1, 1), (2, 2), (0, 9), (2, 2)]
    );
    assert_eq!(plan.lines[1].target, Target::Tcp("10.0.0.2:502".parse().unwrap()));
    let settings = plan.lines[1].units[0].settings;
    assert_eq!((settings.response_timeout_ns, settings.retries), (300_000_000, 3));
    assert_eq!(plan.lines[2].units[0].settings.retries, 0);
    let write = &plan.writes[0];
    assert_eq!((write.line, write.bit, write.bytes, write.safe.clone()), (2, 5, 1, Some(vec![1])));
}

#[test]
fn mistakes_are_named() {
    let with = |change: Value| {
        let mut base = read(0, "%IW0");
        base.as_object_mut().unwrap().extend(change.as_object().unwrap().clone());
        said(json!({ "serial": "com1", "read": [base] }))
    };
    let write = |change: Value| {
        let mut base = json!({ "unit": 5, "table": "holding", "at": 0, "from": "%QW0" });
        base.as_object_mut().unwrap().extend(change.as_object().unwrap().clone());
        said(json!({ "serial": "com1", "write": [base] }))
    };
    let all = [
        said(json!({})),
        // Nothing but the cause is told.
        said(json!({ "unit": [{ "id": 3, "name": "main" }],
                     "read": [{ "unit": "main", "table": "input", "at": 0, "to": "%IW0" },
                              { "unit": 7, "table": "input", "at": 1, "to": "%IW1" }] })),
        said(json!({ "serial": "com1", "tcp": "10.0.0.1:502" })),
        said(json!({ "serial": "com1", "mode": "tcp" })),
        said(json!({ "tcp": "10.0.0.1:502", "mode": "ascii" })),
        said(json!({ "serial": "com1", "max_batch": 126, "response_timeout": "10us", "probe_max": "10ms" })),
        said(json!({ "serial": "com1", "unit": [{ "id": 1 }, { "id": 1 }] })),
        said(json!({ "unit": [{ "id": 1, "name": "a", "tcp": "10.0.0.1:502" }, { "id": 2, "name": "a" }] })),
        said(
            json!({ "unit": [{ "id": 1, "name": "a", "tcp": "10.0.0.1:502" }, { "id": 1, "tcp": "10.0.0.2:502" }],
                     "read": [read(0, "%IW0"), { "unit": 1, "table": "coils", "at": 0, "to": "%IX9.0" },
                              { "unit": "x", "table": "coils", "at": 0, "to": "%IX9.1" }] }),
        ),
        with(json!({ "unit": 0 })),
        with(json!({ "to": "%QW0" })),
        with(json!({ "to": "%IX0.0" })),
        with(json!({ "table": "coils" })),
        with(json!({ "count": 126 })),
        with(json!({ "count": 0 })),
        with(json!({ "at": 65535, "count": 2 })),
        with(json!({ "to": "%ID0", "count": 3 })),
        with(json!({ "order": "CDAB" })),
        with(json!({ "to": "%ID0", "order": "AB" })),
        with(json!({ "symbol": "Level", "count": 2 })),
        with(json!({ "type": "REAL" })),
        with(json!({ "status_to": "%IW4" })),
        with(json!({ "table": "coils", "to": "%IX0.3", "count": 2 })),
        with(json!({ "to": "%IB65535" })),
        said(json!({ "serial": "com1", "read": [read(0, "%IW0"), read(1, "%IB1")] })),
        write(json!({ "table": "input" })),
        write(json!({ "from": "%IW0" })),
        write(json!({ "on_change": false })),
        write(json!({ "period": "1us" })),
        write(json!({ "safe_values": [] })),
        write(json!({ "safe_values": [70000] })),
        write(json!({ "table": "coils", "from": "%QX0.0", "safe_values": [0.5] })),
    ];
    insta::assert_snapshot!(all.join("\n"), @r#"
    : the service has no line: neither serial nor tcp -> add serial = "NAME", or tcp = "ADDRESS:502"
    : the service has no line: neither serial nor tcp -> add serial = "NAME", or tcp = "ADDRESS:502"
    unit[0]: unit 3 has no line -> give it tcp = "ADDRESS:502", or give the service a line
    tcp: the service has a serial line and a connection -> remove serial or tcp
    mode: mode "tcp" is for connections -> use "rtu" or "ascii" on a serial line
    mode: mode "ascii" is for serial lines -> use "tcp", or "rtu" for a converter that passes RTU frames on
    max_batch: max_batch = 126 is not 1 to 125 -> 125 is the default
    response_timeout: response_timeout = 10us is too short -> use at least 1ms; 1s is the default
    probe_max: probe_max is shorter than probe_min -> exchange them, or leave them out
    unit[1].id: unit 1 stands twice on its line -> one [[service.unit]] a unit and line
    unit[1]: unit 2 has no line -> give it tcp = "ADDRESS:502", or give the service a line
    read[0].unit: no [[service.unit]] has the id 5, and the service has no line of its own -> add a [[service.unit]], or correct the unit
    read[1].unit: 2 units have the id 1; call the one you mean by its name -> add a [[service.unit]], or correct the unit
    read[2].unit: no unit has the name 'x'; there are: a -> add a [[service.unit]], or correct the unit
    read[0].unit: unit 0 is the broadcast: nobody answers -> read from units 1 to 247
    read[0].to: %QW0 is no input: what is read goes to %I -> write %I...
    read[0].to: %IX0.0 does not hold holding_registers -> use B, W, D or L addresses for registers
    read[0].to: %IW0 does not hold coils -> use X or B addresses for bits
    read[0].count: 126 holding_registers in one range: 1 to 125 are possible -> split the range
    read[0].count: 0 holding_registers in one range: 1 to 125 are possible -> split the range
    read[0].at: the range ends behind address 65535 -> lower at or count
    read[0].count: count 3 splits a value of 2 registers -> D needs a multiple of 2, L of 4
    read[0].order: order CDAB is not possible here -> AB and BA are for single registers, ABCD, DCBA, BADC, CDAB for %xD and %xL; bits have none
    read[0].order: order AB is not possible here -> AB and BA are for single registers, ABCD, DCBA, BADC, CDAB for %xD and %xL; bits have none
    read[0].symbol: a symbol names one value, and this range has several -> give the symbol to a range of one value, or declare a VAR AT in the program
    read[0].type: %IW0 has 16 bits, REAL has 32 -> use X for BOOL, B, W, D, L for 8, 16, 32, 64 bits
    read[0].status_to: '%IW4' is no byte of the inputs -> write %IB and a number, as %IB10
    read[0].to: several bits begin in the middle of a byte -> begin at bit 0, or read them one by one
    read[0].to: %IB65535 and 2 bytes reach beyond 65536 bytes -> lower the address or count
    read[1].to: lies over read[0].to -> give every bit of %I to one read only
    write[0].table: input_registers cannot be written -> use "coils" or "holding_registers"
    write[0].from: %IW0 is no output: what is written comes from %Q or %M -> write %Q... or %M...
    write[0]: it is written neither on change nor by period -> add period = "1s"
    write[0].period: a period below 1ms is none -> use at least 1ms
    write[0].safe_values: 0 values for 1 -> give one number a value of the range, in its type
    write[0].safe_values: 70000 is no whole number of 16 bits -> give one number a value of the range, in its type
    write[0].safe_values: 0.5 is no bit -> give one number a value of the range, in its type
    "#);
}

#[test]
fn safe_values_as_they_go_on_the_wire() {
    let safe = |change: Value| {
        let mut base = json!({ "unit": 5, "table": "holding", "at": 0, "from": "%QD0" });
        base.as_object_mut().unwrap().extend(change.as_object().unwrap().clone());
        let plan = planned(json!({ "serial": "com1", "write": [base] }));
        assert_eq!(plan.mistakes, []);
        plan.writes[0].safe.clone().unwrap()
    };
    assert_eq!(safe(json!({ "type": "REAL", "safe_values": [1.5] })), [0x3F, 0xC0, 0, 0]);
    assert_eq!(safe(json!({ "type": "REAL", "order": "CDAB", "safe_values": [1.5] })), [0, 0, 0x3F, 0xC0]);
    assert_eq!(safe(json!({ "safe_values": [-2] })), [0xFF, 0xFF, 0xFF, 0xFE]);
    assert_eq!(safe(json!({ "from": "%QW0", "count": 2, "safe_values": [1, 65535] })), [0, 1, 0xFF, 0xFF]);
}

#[test]
fn limits() {
    let reads: Vec<_> = (0..=MAX_READS).map(|i| read(i as u16, &format!("%IW{i}"))).collect();
    let text = said(json!({ "serial": "com1", "read": reads }));
    assert!(text.starts_with("read: 1025 entries: a modbus-client has at most 1024"), "{text}");
}
