//! What the service declares and checks. The running service is tested in `tests/`.

use super::*;
use ipc_types::testing::{service, stack};
use serde_json::{Value, json};

fn config(value: Value) -> Config {
    serde_json::from_value(value).unwrap()
}

fn entry(name: &str, kind: &str, config: Value) -> ServiceEntry {
    ServiceEntry { index: 1, ..service(name, kind, config, Wiring::default()) }
}

fn demo() -> Value {
    json!({
        "serial": "com1",
        "read": [
            { "unit": 5, "table": "input", "at": 0, "to": "%ID1", "type": "REAL", "symbol": "Power", "status_to": "%IB40" },
            { "unit": 5, "table": "coils", "at": 3, "count": 12, "to": "%IX8.0", "on_bad": "zero" },
        ],
        "write": [{ "unit": 5, "table": "holding", "at": 100, "from": "%QW0", "symbol": "Limit" }],
    })
}

#[test]
fn wiring() {
    let neighbours = Neighbours {
        name: "meters".into(),
        services: vec![
            ("com1".into(), "serial".into()),
            ("meters".into(), "modbus-client".into()),
            ("plc".into(), "plc".into()),
        ],
        dir: ".".into(),
        ..Neighbours::default()
    };
    let wiring = topics(&config(demo()), &neighbours);
    let reads: Vec<_> = wiring.reads.iter().map(|r| (r.topic.as_str(), r.wake)).collect();
    assert_eq!(reads, [("meters/jobs", true), ("plc/image", true), ("com1/rx", true)]);
    assert_eq!(wiring.writes, [("com1/tx".to_owned(), "serial".to_owned())]);
    let kinds: Vec<_> = wiring.topics.iter().map(|t| (t.kind, t.max_tail)).collect();
    assert_eq!(kinds[0], (TopicKind::Inputs, 4 + 2 + 2));
    assert_eq!(kinds.len(), 3);
    let inputs: Vec<_> =
        wiring.inputs.iter().map(|r| (r.byte, r.bytes, r.type_name.as_deref(), r.label.as_str())).collect();
    assert_eq!(
        inputs,
        [
            (4, 4, Some("REAL"), "from unit 5, input_registers 0-1 (30001...) ABCD"),
            (8, 2, None, "from unit 5, coils 3-14 (00004...)")
        ]
    );
    assert_eq!((wiring.inputs[0].status_byte, wiring.inputs[1].on_bad), (Some(40), OnBad::Zero));
    let out = &wiring.outputs[0];
    assert_eq!((out.byte, out.type_name.as_deref(), out.key.as_str()), (0, Some("WORD"), "write[0].from"));
}

#[test]
fn findings() {
    let said = |value: Value, services: Vec<ServiceEntry>| {
        let mut me = entry("meters", "modbus-client", Value::Null);
        me.wiring.plc = services.iter().find(|s| s.kind == "plc").map(|s| s.name.clone());
        let found = check(&config(value), &stack(services), &me);
        found.iter().map(|f| format!("{}: {} -> {}", f.key, f.message, f.help)).collect::<Vec<_>>().join("\n")
    };
    let serial = |framing: &str| entry("com1", "serial", json!({ "framing": framing }));
    let plc = || entry("plc", "plc", json!({ "cycle": "10ms" }));
    assert_eq!(said(demo(), vec![serial("rtu"), plc()]), "");
    let mut short = demo();
    short["stale_after"] = json!("10ms");
    let mut early = demo();
    early["read"][0]["timeout"] = json!("900ms");
    let mut typo = demo();
    typo["unit"] = json!([{ "id": 3, "name": "main" }, { "id": 4 }]);
    let all = [
        said(json!({ "tcp": "10.0.0.1:502" }), vec![]),
        said(typo, vec![serial("rtu"), plc()]),
        said(demo(), vec![plc()]),
        said(demo(), vec![entry("com2", "serial", json!({})), plc()]),
        said(demo(), vec![serial("ascii"), plc()]),
        said(demo(), vec![serial("rtu")]),
        said(short, vec![serial("rtu"), plc()]),
        said(early, vec![serial("rtu"), plc()]),
        said(
            demo(),
            vec![
                serial("rtu"),
                entry("gw", "modbus-gateway", json!({ "port": [{ "serial": "com1" }] })),
                plc(),
            ],
        ),
        // Another line, and the line of a server.
        said(
            demo(),
            vec![
                serial("rtu"),
                entry("pumps", "modbus-client", json!({ "serial": "com2" })),
                entry("unit", "modbus-server", json!({ "serial": [{ "port": "com1" }] })),
                plc(),
            ],
        ),
    ];
    insta::assert_snapshot!(all.join("\n"), @r#"
    : the service has neither read nor write -> add [[service.read]] or [[service.write]]; jobs of others are carried out in any case
    read[0].unit: unit 5 has no [[service.unit]], as other units have; did you mean 3 ("main") or 4? -> write the unit meant, or add [[service.unit]] with id = 5
    serial: there is no serial service 'com1' -> add a [[service]] with kind = "serial"
    serial: there is no serial service 'com1' -> set it to one of: com2
    serial: serial service 'com1' has framing "ascii" -> set framing = "rtu" there, or change mode here
    plc: the stack has no plc service -> add a [[service]] with kind = "plc"; it works without a program too
    stale_after: stale_after = 10ms is shorter than 3 times the longest time between two scans of 'plc' -> leave it out (200ms) or set at least "30ms"
    read[0].timeout: timeout = 900ms is not longer than period = 1s: the value turns stale between two reads -> leave it out (three periods and a response timeout), or give it more than two periods
    serial: 'gw' is a master on the line of 'com1' already -> a line has one master, else requests and answers collide: put the units of both into one service, or use another line
    "#);
}
