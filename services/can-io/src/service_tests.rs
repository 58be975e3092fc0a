//! Tests of what the service declares and checks. The running service is tested in `tests/`.

use super::*;
use ipc_types::testing;
use serde_json::{Value, json};

fn config(value: Value) -> Config {
    serde_json::from_value(value).unwrap()
}

fn entry(name: &str, kind: &str, config: Value) -> ServiceEntry {
    testing::service(name, kind, config, Wiring::default())
}

fn demo() -> Value {
    json!({
        "in": [
            { "id": 0x1A0, "start": 0, "len": 16, "to": "%IW0", "symbol": "Speed", "timeout": "1s", "status_to": "%IB9" },
            { "id": "18FEF100", "start": 8, "len": 1, "to": "%IX4.1", "on_bad": "zero" },
        ],
        "out": [{ "id": 0x210, "dlc": 2, "mode": "on_change",
                  "signals": [{ "start": 0, "len": 16, "from": "%MW3", "type": "INT", "symbol": "Command" }] }],
    })
}

#[test]
fn wiring() {
    let neighbours = Neighbours {
        name: "io".into(),
        services: vec![
            ("can0".into(), "can".into()),
            ("io".into(), "can-io".into()),
            ("plc".into(), "plc".into()),
        ],
        dir: ".".into(),
        ..Neighbours::default()
    };
    let wiring = topics(&config(demo()), &neighbours);
    assert_eq!(wiring.plc.as_deref(), Some("plc"));
    let reads: Vec<_> = wiring.reads.iter().map(|r| (r.topic.as_str(), r.wake)).collect();
    assert_eq!(reads, [("can0/rx", true), ("plc/image", true)]);
    assert_eq!(wiring.writes, [("can0/tx".to_owned(), "bus".to_owned())]);
    assert_eq!((wiring.topics.len(), wiring.topics[0].max_tail), (1, 2 + 1 + 2));
    let inputs: Vec<_> = wiring.inputs.iter().map(|r| (r.byte, r.bit, r.bytes, r.label.as_str())).collect();
    assert_eq!(
        inputs,
        [
            (0, None, 2, "from frame 1A0h, 16 bits from 0 intel"),
            (4, Some(1), 1, "from frame 18FEF100h, 1 bit from 8 intel")
        ]
    );
    assert_eq!((wiring.inputs[0].status_byte, wiring.inputs[1].on_bad), (Some(9), OnBad::Zero));
    let out = &wiring.outputs[0];
    assert_eq!(
        (out.byte, out.bytes, out.symbol.as_deref(), out.key.as_str()),
        (6, 2, Some("Command"), "out[0].signals[0].from")
    );
    // Addresses count as in the plc.
    let plc_addressing = [("plc".to_owned(), "byte".to_owned())].into();
    let counted = topics(&config(demo()), &Neighbours { plc_addressing, ..neighbours.clone() });
    assert_eq!(counted.outputs[0].byte, 3);
    // Only outputs: nothing of the bus is read.
    let only_out = topics(&config(json!({ "out": demo()["out"] })), &neighbours);
    assert!(only_out.topics.is_empty() && only_out.reads.len() == 1);
}

#[test]
fn findings() {
    let said = |value: Value, services: Vec<ServiceEntry>| {
        let mut me = entry("io", "can-io", Value::Null);
        me.wiring.plc = services.iter().find(|s| s.kind == "plc").map(|s| s.name.clone());
        let found = check(&config(value), &testing::stack(services), &me);
        found.iter().map(|f| format!("{}: {} -> {}", f.key, f.message, f.help)).collect::<Vec<_>>().join("\n")
    };
    let can = || entry("can0", "can", json!({}));
    let plc = |value| entry("plc", "plc", value);
    assert_eq!(said(demo(), vec![can(), plc(json!({ "cycle": "10ms" }))]), "");
    let bytes = json!({ "in": [{ "id": 1, "start": 0, "len": 16, "to": "%IW40000" }] });
    assert_eq!(said(bytes, vec![can(), plc(json!({ "addressing": "byte" }))]), "");
    let with = |key: &str, value: Value| {
        let mut table = demo();
        table[key] = value;
        table
    };
    let all = [
        said(json!({}), vec![]),
        said(demo(), vec![]),
        said(demo(), vec![can(), entry("can1", "can", json!({})), plc(json!({}))]),
        said(
            with("in", json!([{ "id": 1, "start": 0, "len": 16, "to": "%IW40000" }])),
            vec![can(), plc(json!({}))],
        ),
        said(with("stale_after", json!("25ms")), vec![can(), plc(json!({ "cycle": "10ms" }))]),
        said(with("stale_after", json!("150ms")), vec![can(), plc(json!({ "cycle": "1s" }))]),
        said(with("stale_after", json!("10us")), vec![can(), plc(json!({}))]),
    ];
    insta::assert_snapshot!(all.join("\n"), @r#"
        : the service has neither in nor out: it does nothing -> add [[service.in]] or [[service.out]]
        bus: the stack has no service of kind "can" -> add one, as [[service]] with kind = "can"
        bus: the stack has several services of kind "can": can0, can1 -> say which one: bus = "can0"
        in[0].to: `%IW40000`: the number is too large, an area has at most 65536 bytes -> the plc service's `addressing` says how numbers are counted
        stale_after: stale_after = 25ms is shorter than 3 times the longest time between two scans of 'plc' -> leave it out (200ms) or set at least "30ms"
        stale_after: stale_after = 150ms is shorter than 3 times the longest time between two scans of 'plc' -> leave it out (200ms) or set at least "200ms"
        stale_after: stale_after = 10us is shorter than 3 times the longest time between two scans of 'plc' -> leave it out (200ms) or set at least "30ms"
        "#);
}
