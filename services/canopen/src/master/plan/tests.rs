use super::*;
use crate::master::boot::Write;
use crate::master::testing::device;
use crate::protocol::data_type::DataType;
use crate::protocol::od::{Access, EntryDef, OdBuilder};
use serde_json::json;

fn planned(table: serde_json::Value) -> Plan {
    let config: Config = serde_json::from_value(table).unwrap();
    let devices: BTreeMap<_, _> = config.nodes.iter().map(|n| (n.id, device(n.id))).collect();
    plan(&config, &devices, Addressing::Element, "io")
}

fn mistakes(table: serde_json::Value) -> String {
    let said = planned(table).mistakes;
    said.iter()
        .map(|m| format!("{}{}: {}; {}\n", if m.warning { "warning " } else { "" }, m.key, m.message, m.help))
        .collect()
}

fn writes(plan: &Plan) -> String {
    let text = |w: &Write| {
        let value = w.data.iter().rev().map(|b| format!("{b:02X}")).collect::<String>();
        format!("{:04X}:{:02X} = {value}\n", w.index, w.sub)
    };
    plan.nodes[0].settings.plan.writes.iter().map(text).collect()
}

#[test]
fn a_mapped_object_takes_the_pdo_that_has_it() {
    let plan = planned(json!({ "node": [{ "id": 5, "eds": "x", "map": [
        { "object": "Inputs 9-16", "to": "%IB1" },
        { "object": "6200:01", "from": "%QB0", "symbol": "Lamps" },
    ] }] }));
    assert_eq!(plan.mistakes, []);
    let [rx] = &plan.exchange.rx[..] else { panic!() };
    assert_eq!((rx.cob_id, rx.length, rx.fields[0].pdo_bit, rx.fields[0].bits), (0x185, 2, 8, 8));
    let [tx] = &plan.exchange.tx[..] else { panic!() };
    assert_eq!((tx.cob_id, tx.length, tx.transmission), (0x205, 2, 255));
    assert_eq!(plan.inputs[0].label, "node 5 6000:02 Digital inputs, Inputs 9-16, TPDO 1");
    assert_eq!(
        (plan.outputs[0].symbol.as_deref(), plan.outputs[0].type_name.as_deref()),
        (Some("Lamps"), Some("USINT"))
    );
    insta::assert_snapshot!(writes(&plan), @r"
    1800:01 = 80000185
    1800:02 = FF
    1800:03 = 0000
    1800:05 = 0000
    1800:01 = 00000185
    1400:01 = 80000205
    1400:02 = FF
    1400:05 = 0000
    1400:01 = 00000205
    ");
}

#[test]
fn other_objects_get_the_first_free_pdo_in_lock_step() {
    let plan = planned(json!({ "sync_period": "10ms", "node": [{ "id": 5, "eds": "x", "map": [
        { "object": "6401:01", "to": "%IW8" },
    ] }] }));
    assert_eq!(plan.mistakes, []);
    assert_eq!((plan.exchange.rx[0].cob_id, plan.exchange.rx[0].transmission), (0x285, 1));
    assert!(plan.exchange.rx[0].fields[0].signed);
    insta::assert_snapshot!(writes(&plan), @r"
    1801:01 = 80000285
    1A01:00 = 00
    1A01:01 = 64010110
    1A01:00 = 01
    1801:02 = 01
    1801:03 = 0000
    1801:05 = 0000
    1801:06 = 00
    1801:01 = 00000285
    ");
}

#[test]
fn what_the_stack_file_sets_of_a_pdo_is_written() {
    let plan = planned(json!({ "node": [{ "id": 5, "eds": "x",
        "sdo": [{ "object": "2000", "value": "$NODEID+0x100" }], "heartbeat": "100ms",
        "tpdo": [{ "number": 1, "cob_id": "$NODEID+0x380", "transmission": 3, "inhibit_time": "5ms", "event_timer": "1s",
                   "mapping": ["6000:01", "6401:01"] }],
        "rpdo": [{ "number": 1, "enabled": false }],
        "map": [{ "object": "6401:01", "to": "%IW8" }],
    }] }));
    insta::assert_snapshot!(writes(&plan), @r"
    2000:00 = 00000105
    1017:00 = 0064
    1016:01 = 000105DC
    1800:01 = 80000385
    1A00:00 = 00
    1A00:01 = 60000108
    1A00:02 = 64010110
    1A00:00 = 02
    1800:02 = 03
    1800:03 = 0032
    1800:05 = 03E8
    1800:06 = 00
    1800:01 = 00000385
    1400:01 = 80000205
    ");
    assert_eq!(plan.exchange.rx[0].fields[0].pdo_bit, 8);
}

#[test]
fn mistakes_are_named() {
    let node = |map: serde_json::Value| json!({ "node": [{ "id": 5, "eds": "x", "map": [map] }] });
    let said: String = [
        node(json!({ "object": "6000:09", "to": "%IB0" })),
        node(json!({ "object": "6100:01", "to": "%IB0" })),
        node(json!({ "object": "Digital thing", "to": "%IB0" })),
        node(json!({ "object": "1017", "to": "%IW0" })),
        node(json!({ "object": "6000:01", "from": "%QB0" })),
        node(json!({ "object": "6000:01", "to": "%QB0" })),
        node(json!({ "object": "6401:01", "to": "%IB0" })),
        node(json!({ "object": "6000:01", "to": "%IB0", "from": "%QB0" })),
        node(json!({ "object": "6000:01", "to": "IB0" })),
        json!({ "node": [{ "id": 1 }, { "id": 5 }, { "id": 5 }, { "id": 200 }] }),
        json!({ "sync_overflow": 1, "sync_period": "100us", "node": [{ "id": 5 }] }),
        json!({ "node": [{ "id": 5, "rpdo": [{ "number": 9 }], "tpdo": [
            { "number": 1, "transmission": 250, "cob_id": "0x601",
              "mapping": ["6000:01", "6000:02", "6401:01", "6401:01", "6401:01", "6401:01"] }] }] }),
        json!({ "node": [{ "id": 5 }, { "id": 6, "tpdo": [{ "number": 1, "cob_id": "0x185" }] }] }),
        json!({ "node": [{ "id": 5, "tpdo": [{ "number": 1, "cob_id": 0x186 }] }, { "id": 6 }] }),
        json!({ "node": [{ "id": 5, "vendor_id": true, "product_code": "0x22", "revision": "two",
            "tpdo": [{ "number": 1, "cob_id": 0x585 }, { "number": 2, "cob_id": true }] }] }),
        json!({ "node": [{ "id": 5, "heartbeat": "500us", "tpdo": [{ "number": 1, "event_timer": "70s" }] }] }),
        json!({ "node": [{ "id": 5, "tpdo": [{ "number": 1, "transmission": 1 }] }] }),
        json!({ "node": [{ "id": 5, "sdo": [{ "object": "1017", "value": 70000 }, { "object": "1000", "value": 1 },
            { "object": "1016:01", "value": "0x10064" }] }] }),
    ]
    .into_iter()
    .map(mistakes)
    .collect();
    insta::assert_snapshot!(said);
}

#[test]
fn cob_ids_that_nothing_may_have() {
    let sync =
        |id: u32| json!({ "sync_period": "10ms", "sync_cob_id": id, "node": [{ "id": 5, "eds": "x" }] });
    let pdo = |id: u32| json!({ "node": [{ "id": 5, "eds": "x", "tpdo": [{ "number": 1, "cob_id": id }] }] });
    let sdo = |object: &str, value: u32| json!({ "node": [{ "id": 5, "eds": "x", "sdo": [{ "object": object, "value": value }] }] });
    let said: String = [
        sync(0),
        sync(0x7F),
        sync(0x100),
        sync(0x180),
        sync(0x85),
        sync(0x81),
        sync(0x580),
        sync(0x700),
        sync(0x7E5),
        sync(0x900),
        // TPDO 1 of node 5 has it.
        sync(0x185),
        // Those of TIME, an emergency, an SDO.
        pdo(0x100),
        pdo(0x85),
        pdo(0x580),
        sdo("1005", 0x7F),
        sdo("1400:01", 0x585),
        // Also while it is switched off.
        sdo("1400:01", 0x8000_0585),
    ]
    .into_iter()
    .map(mistakes)
    .collect();
    insta::assert_snapshot!(said, @r"
    sync_cob_id: 0h cannot be the COB-ID of the SYNC: restricted CAN-ID; leave it out for 080h, or take 181h to 57Fh (CiA 301 clause 7.3.5)
    sync_cob_id: 7Fh cannot be the COB-ID of the SYNC: restricted CAN-ID; leave it out for 080h, or take 181h to 57Fh (CiA 301 clause 7.3.5)
    sync_cob_id: 100h cannot be the COB-ID of the SYNC: it is that of TIME; leave it out for 080h, or take 181h to 57Fh (CiA 301 clause 7.3.5)
    sync_cob_id: 180h cannot be the COB-ID of the SYNC: restricted CAN-ID; leave it out for 080h, or take 181h to 57Fh (CiA 301 clause 7.3.5)
    sync_cob_id: 85h cannot be the COB-ID of the SYNC: emergencies of node 5 have it; leave it out for 080h, or take 181h to 57Fh (CiA 301 clause 7.3.5)
    sync_cob_id: 81h cannot be the COB-ID of the SYNC: emergencies of node 1 have it; leave it out for 080h, or take 181h to 57Fh (CiA 301 clause 7.3.5)
    sync_cob_id: 580h cannot be the COB-ID of the SYNC: it lies among those of SDO and heartbeat; leave it out for 080h, or take 181h to 57Fh (CiA 301 clause 7.3.5)
    sync_cob_id: 700h cannot be the COB-ID of the SYNC: it lies among those of SDO and heartbeat; leave it out for 080h, or take 181h to 57Fh (CiA 301 clause 7.3.5)
    sync_cob_id: 7E5h cannot be the COB-ID of the SYNC: restricted CAN-ID; leave it out for 080h, or take 181h to 57Fh (CiA 301 clause 7.3.5)
    sync_cob_id: 900h cannot be the COB-ID of the SYNC: identifier above 7FFh without the bit for 29-bit identifiers; leave it out for 080h, or take 181h to 57Fh (CiA 301 clause 7.3.5)
    sync_cob_id: TPDO 1 of node 5 and the SYNC have the same COB-ID 185h; give one of them another with cob_id
    node[0].tpdo[0].cob_id: 100h is no COB-ID that a PDO may have; take 181h to 57Fh, or 680h to 6DFh (CiA 301 clause 7.3.5)
    node[0].tpdo[0].cob_id: 85h is no COB-ID that a PDO may have; take 181h to 57Fh, or 680h to 6DFh (CiA 301 clause 7.3.5)
    node[0].tpdo[0].cob_id: 580h is no COB-ID that a PDO may have; take 181h to 57Fh, or 680h to 6DFh (CiA 301 clause 7.3.5)
    node[0].sdo[0].value: 1005:00 cannot be 7Fh: restricted CAN-ID; a device refuses it by abort 06090030h; take 181h to 57Fh, or 680h to 6DFh (CiA 301 clause 7.3.5)
    node[0].sdo[0].value: 1400:01 cannot be 585h: restricted CAN-ID; a device refuses it by abort 06090030h; take 181h to 57Fh, or 680h to 6DFh (CiA 301 clause 7.3.5)
    ");
    for fine in [sync(0x80), sync(0x86), sync(0x6DF), pdo(0x181), pdo(0x6DF), sdo("1400:01", 0x2000_0005)] {
        assert_eq!(mistakes(fine.clone()), "", "{fine}");
    }
}

#[test]
fn nodes_are_told_of_another_sync() {
    let writes = |config: serde_json::Value| {
        let plan = planned(config);
        let writes = &plan.nodes[0].settings.plan.writes;
        writes.iter().find(|w| w.index == 0x1005).map(|w| w.data.clone())
    };
    let with = |id: u32, sdo: serde_json::Value| json!({ "sync_period": "10ms", "sync_cob_id": id, "node": [{ "id": 5, "eds": "x", "sdo": sdo }] });
    assert_eq!(writes(with(0x80, json!([]))), None);
    assert_eq!(writes(with(0x300, json!([]))), Some(vec![0, 3, 0, 0]));
    let by_hand = json!([{ "object": "1005", "value": 0x301 }]);
    assert_eq!(writes(with(0x300, by_hand)), Some(vec![1, 3, 0, 0]), "once, and as the stack file says");
    // An EDS without a default.
    let of_open = |access: Access, table: serde_json::Value| {
        let config: Config = serde_json::from_value(table).unwrap();
        let mut device = device(5);
        let mut b = OdBuilder::new();
        b.var(0x1000, EntryDef::new(DataType::Unsigned32, Access::Ro));
        b.var(0x1005, EntryDef::new(DataType::Unsigned32, access));
        device.od = b.build(5).unwrap();
        let plan = plan(&config, &BTreeMap::from([(5, device)]), Addressing::Element, "io");
        let written = plan.nodes[0].settings.plan.writes.iter().any(|w| w.index == 0x1005);
        (written, plan.mistakes.iter().any(|m| m.message.contains("does not hear")))
    };
    for (access, id, told) in [
        (Access::Rw, 0x80, (false, false)),
        (Access::Ro, 0x80, (false, false)),
        (Access::Rw, 0x300, (true, false)),
        (Access::Ro, 0x300, (false, true)),
    ] {
        assert_eq!(of_open(access, with(id, json!([]))), told, "{id:X}");
    }
}
