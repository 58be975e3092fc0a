//! Tests of tables right and wrong.

use super::*;
use serde_json::json;

fn planned(value: serde_json::Value) -> Plan {
    plan(&serde_json::from_value(value).unwrap(), Addressing::Element)
}

fn said(value: serde_json::Value) -> String {
    let mistakes = planned(value).mistakes;
    mistakes.iter().map(|m| format!("{}: {} -> {}", m.key, m.message, m.help)).collect::<Vec<_>>().join("\n")
}

#[test]
fn a_good_table() {
    let plan = planned(json!({
        "in": [
            { "id": 0x1A0, "start": 0, "len": 16, "to": "%IW0", "type": "UINT", "timeout": "500ms" },
            { "id": 0x1A0, "start": 23, "len": 12, "order": "motorola", "signed": true, "to": "%IW1",
              "on_bad": -1, "status_to": "%IB10" },
            { "id": "00000001", "start": 0, "len": 1, "to": "%IX4.7", "on_bad": "zero" },
            { "id": 1, "start": 0, "len": 1, "to": "%IX4.6" },
        ],
        "out": [{ "id": 0x210, "dlc": 8, "mode": "cyclic", "period": "100ms", "fill": 255,
            "on_stop": { "values": [-40, 1] },
            "signals": [
                { "start": 0, "len": 8, "scale": 0.5, "offset": -40.0, "from": "%QW0", "type": "INT" },
                { "start": 16, "len": 1, "from": "%MX0.0" } ] }],
    }));
    assert_eq!(plan.mistakes, []);
    assert_eq!(plan.inputs[1].codec.iec, IecType::Int);
    assert_eq!(
        plan.inputs[1].substitute,
        Some((-1i64).to_le_bytes().map(|b| b)).map(|mut b| {
            b[2..].fill(0xFF);
            b
        })
    );
    assert_eq!((plan.inputs[1].status_byte, plan.inputs[0].timeout_ns), (Some(10), Some(500_000_000)));
    assert_eq!((plan.inputs[2].can_id, plan.inputs[3].can_id), (EFF_FLAG | 1, 1));
    let frame = &plan.outputs[0];
    assert_eq!((frame.can_id, frame.len, frame.fd_flags, frame.period_ns), (0x210, 8, 0, Some(100_000_000)));
    let Safe::Payload(safe) = frame.safe else { panic!("{:?}", frame.safe) };
    assert_eq!(safe[..8], [0, 255, 255, 255, 255, 255, 255, 255]);
}

#[test]
fn mistakes_are_named() {
    let input = |value: serde_json::Value| {
        let mut base = json!({ "id": 1, "start": 0, "len": 8, "to": "%IB0" });
        base.as_object_mut().unwrap().extend(value.as_object().unwrap().clone());
        said(json!({ "in": [base] }))
    };
    let output = |value: serde_json::Value| {
        let mut base = json!({ "id": 1, "dlc": 8, "mode": "on_change",
                               "signals": [{ "start": 0, "len": 8, "from": "%QB0" }] });
        base.as_object_mut().unwrap().extend(value.as_object().unwrap().clone());
        said(json!({ "out": [base] }))
    };
    let all = [
        input(json!({ "id": 0x800, "ext": false })),
        input(json!({ "id": 0x2000_0000 })),
        input(json!({ "len": 65 })),
        input(json!({ "start": 511, "len": 2 })),
        input(json!({ "float": true })),
        input(json!({ "scale": 0 })),
        input(json!({ "to": "%QB0" })),
        input(json!({ "to": "%IX0.8" })),
        input(json!({ "to": "%IB0", "type": "INT" })),
        input(json!({ "timeout": "10us", "status_to": "%IW4" })),
        said(json!({ "in": [
            { "id": 1, "start": 0, "len": 8, "to": "%IX1.3" },
            { "id": 1, "start": 0, "len": 8, "to": "%IW0" } ] })),
        output(json!({ "dlc": 9 })),
        output(json!({ "dlc": 9, "fd": false, "brs": true })),
        output(json!({ "mode": "cyclic", "inhibit": "1ms" })),
        output(json!({ "period": "10ms" })),
        output(json!({ "dlc": 0 })),
        output(json!({ "signals": [{ "start": 0, "len": 8, "from": "%IB0" }] })),
        output(
            json!({ "signals": [{ "start": 0, "len": 9, "from": "%QW0" }, { "start": 8, "len": 8, "from": "%QB2" }] }),
        ),
        output(json!({ "on_stop": { "values": [] } })),
        said(json!({ "out": [
            { "id": 5, "dlc": 0, "mode": "on_change" }, { "id": "005", "dlc": 0, "mode": "on_change" } ] })),
    ];
    insta::assert_snapshot!(all.join("\n"), @r#"
    in[0].id: identifier 800 does not fit in 11 bits -> use at most 7FF, or ext = true for 29 bits
    in[0].id: identifier 20000000 does not fit in 29 bits -> use at most 1FFFFFFF
    in[0].len: len 65 is not possible: a signal has 1 to 64 bits -> see the DBC numbering of start and len
    in[0].len: a signal of 2 bits from bit 511 needs 65 bytes: a frame has at most 64 -> see the DBC numbering of start and len
    in[0].float: a float signal has 32 or 64 bits, not 8 -> set len = 32 or 64, or float = false
    in[0].scale: scale 0 and offset 0 make no value -> scale must not be 0, and both must be finite
    in[0].to: %QB0 is no input: values from the bus go to %I -> write %I..., and copy it in the program or by a route
    in[0].to: `%IX0.8`: a byte has the bits 0 to 7; bit 8 of byte 0 is %IX1.0 -> the plc service's `addressing` says how numbers are counted
    in[0].type: %IB0 has 8 bits, INT has 16 -> use X for BOOL, B, W, D, L for 8, 16, 32, 64 bits
    in[0].timeout: a timeout below 1ms is no timeout -> use at least 1ms
    in[0].status_to: '%IW4' is no byte of the inputs -> write %IB and a number, as %IB10
    in[1].to: lies over in[0].to -> give every bit of %I to one input only
    out[0].dlc: a CAN FD frame has no 9 bytes -> use 0 to 8, for CAN FD also 12, 16, 20, 24, 32, 48 or 64
    out[0].dlc: a classic frame has no 9 bytes -> use 0 to 8, for CAN FD also 12, 16, 20, 24, 32, 48 or 64
    out[0].brs: only CAN FD switches the bit rate -> set fd = true, or remove brs
    out[0].period: a cyclic frame needs a period of at least 1ms -> add period = "100ms"
    out[0].inhibit: a cyclic frame has no inhibit time -> remove it, or use mode = "on_change"
    out[0].period: a frame sent on change has no period -> remove it, or use mode = "cyclic"
    out[0].signals[0].start: 8 bits from 0 intel needs 1 bytes, dlc is 0 -> set dlc higher, or start or len lower
    out[0].signals[0].from: %IB0 is no output: values to the bus come from %Q or %M -> write %Q... or %M...
    out[0].signals[1].start: 8 bits from 8 intel lies over another signal of the frame -> give every bit to one signal only
    out[0].on_stop: 0 values for 1 signals -> give one finite number per signal, in their order
    out[1].id: 005h is sent by out[0] too -> put all signals of a frame into one entry
    "#);
}

#[test]
fn limits() {
    let inputs: Vec<_> =
        (0..=MAX_INPUTS).map(|i| json!({ "id": 1, "start": 0, "len": 8, "to": format!("%IB{i}") })).collect();
    assert!(said(json!({ "in": inputs })).starts_with("in: 1025 entries: a can-io service has at most 1024"));
    let signals: Vec<_> = (0..65).map(|i| json!({ "start": i, "len": 1, "from": "%QX0.0" })).collect();
    let text = said(json!({ "out": [{ "id": 1, "dlc": 64, "mode": "on_change", "signals": signals }] }));
    assert!(text.starts_with("out[0].signals: 65 signals: a frame has at most 64"), "{text}");
}
