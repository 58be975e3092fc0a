//! Tests of what the service declares and checks. The running service is tested in `tests/`.

use super::*;
use serde_json::{Value, json};

fn config(value: Value) -> Config {
    serde_json::from_value(value).unwrap()
}

fn entry(name: &str, kind: &str, config: Value) -> ServiceEntry {
    ServiceEntry { name: name.into(), kind: kind.into(), index: 1, config, wiring: Wiring::default() }
}

fn stack(services: Vec<ServiceEntry>) -> Stack {
    Stack {
        name: "test".into(),
        file: "stack.toml".into(),
        dir: ".".into(),
        text: String::new(),
        build_id: String::new(),
        root: "/nonexistent".into(),
        prefix: "x".into(),
        services,
        topics: vec![],
    }
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
    // Only outputs: nothing of the bus is read.
    let only_out = topics(&config(json!({ "out": demo()["out"] })), &neighbours);
    assert!(only_out.topics.is_empty() && only_out.reads.len() == 1);
}

#[test]
fn findings() {
    let said = |value: Value, services: Vec<ServiceEntry>| {
        let mut me = entry("io", "can-io", Value::Null);
        me.wiring.plc = services.iter().find(|s| s.kind == "plc").map(|s| s.name.clone());
        let found = check(&config(value), &stack(services), &me);
        found.iter().map(|f| format!("{}: {} -> {}", f.key, f.message, f.help)).collect::<Vec<_>>().join("\n")
    };
    let can = || entry("can0", "can", json!({}));
    let plc = |value| entry("plc", "plc", value);
    assert_eq!(said(demo(), vec![can(), plc(json!({ "cycle": "10ms" }))]), "");
    let with = |key: &str, value: Value| {
        let mut table = demo();
        table[key] = value;
        table
    };
    let all = [
        said(json!({}), vec![]),
        said(demo(), vec![]),
        said(demo(), vec![can(), entry("can1", "can", json!({})), plc(json!({}))]),
        said(demo(), vec![can(), plc(json!({ "addressing": "byte" }))]),
        said(with("stale_after", json!("25ms")), vec![can(), plc(json!({ "cycle": "10ms" }))]),
        said(with("stale_after", json!("150ms")), vec![can(), plc(json!({ "cycle": "1s" }))]),
        said(with("stale_after", json!("10us")), vec![can(), plc(json!({}))]),
    ];
    insta::assert_snapshot!(all.join("\n"), @r#"
        : the service has neither in nor out: it does nothing -> add [[service.in]] or [[service.out]]
        bus: the stack has no service of kind "can" -> add one, as [[service]] with kind = "can"
        bus: the stack has several services of kind "can": can0, can1 -> say which one: bus = "can0"
        addressing: addresses are counted by "element" here and by "byte" in 'plc' -> set addressing = "byte"
        stale_after: stale_after 25ms is less than 3 x cycle 10ms of 'plc' -> set stale_after = "30ms" or more
        stale_after: stale_after 150ms is less than 3 x cycle 1s of 'plc' -> set stale_after = "200ms" or more
        stale_after: stale_after must be at least 1ms -> the default is 200ms
        "#);
}

#[test]
fn verdicts() {
    let all = [SafeOn::Stop, SafeOn::Fault, SafeOn::Halted];
    assert_eq!(judge(PlcState::Run, 1, &all), None);
    assert_eq!(judge(PlcState::Run, 0, &all), Some(Unsafe::Waiting));
    assert_eq!(judge(PlcState::Starting, 5, &[]), Some(Unsafe::Waiting));
    assert_eq!(judge(PlcState::Stop, 5, &all), Some(Unsafe::Stop));
    assert_eq!(judge(PlcState::Fault, 5, &all), Some(Unsafe::Fault));
    assert_eq!(judge(PlcState::Halted, 5, &all), Some(Unsafe::Halted));
    assert_eq!(judge(PlcState::Halted, 5, &[SafeOn::Stop]), None);
}
