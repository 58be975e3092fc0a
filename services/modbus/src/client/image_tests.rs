//! Answers to inputs, outputs to requests.

use super::*;
use crate::client::plan::plan;
use dinrail_iec::Addressing;
use serde_json::{Value, json};

fn reads(value: Value) -> InputTable {
    let plan = plan(
        &serde_json::from_value(json!({ "serial": "com1", "read": value })).unwrap(),
        Addressing::Element,
    );
    assert_eq!(plan.mistakes, []);
    InputTable::new(&plan.reads)
}

fn writes(value: Value) -> WriteTable {
    let plan = plan(
        &serde_json::from_value(json!({ "serial": "com1", "write": value })).unwrap(),
        Addressing::Element,
    );
    assert_eq!(plan.mistakes, []);
    WriteTable::new(&plan.writes)
}

const GOOD: u8 = Quality::Good as u8;
const STALE: u8 = Quality::Stale as u8;
const NO_DATA: u8 = Quality::NoData as u8;

#[test]
fn registers_and_bits_in_every_form() {
    let mut table = reads(json!([
        { "unit": 1, "table": "holding", "at": 0, "to": "%IW0" },
        { "unit": 1, "table": "holding", "at": 1, "to": "%ID1", "order": "CDAB" },
        { "unit": 1, "table": "holding", "at": 3, "count": 2, "to": "%IB8", "order": "BA" },
        { "unit": 1, "table": "coils", "at": 5, "to": "%IX20.3" },
        { "unit": 1, "table": "coils", "at": 6, "count": 10, "to": "%IX21.0", "timeout": "1s", "on_bad": "zero" },
    ]));
    assert_eq!(
        table.tail(),
        [0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, NO_DATA, NO_DATA, NO_DATA, NO_DATA, NO_DATA]
    );
    // One answer with registers 0 to 4: a number, 11223344h with its low word first, the text "Abcd".
    let data = [0x12, 0x34, 0x33, 0x44, 0x11, 0x22, b'A', b'b', b'c', b'd'];
    assert!(table.data(0, &data, 0, 10) && table.data(1, &data, 1, 10) && table.data(2, &data, 3, 10));
    assert_eq!(table.tail()[..10], [0x34, 0x12, 0x44, 0x33, 0x22, 0x11, b'A', b'b', b'c', b'd']);
    // Bits 5 to 15 in one answer.
    assert!(
        table.data(3, &[0b0000_0111, 0b0000_0100], 0, 10)
            && table.data(4, &[0b0000_0111, 0b0000_0100], 1, 10)
    );
    assert_eq!(table.tail()[10..], [1, 0b0000_0011, 0b0000_0010, GOOD, GOOD, GOOD, GOOD, GOOD]);
    assert_eq!(table.drain_changes().count(), 5);
    assert!(!table.data(0, &[1], 0, 11) && !table.data(4, &[1], 1, 11) && !table.data(9, &[1], 0, 11));
    // Stale by age: zeroed where asked for; by failure: held.
    assert_eq!(table.check(999_999_999), Some(1_000_000_010));
    assert_eq!(table.check(1_000_000_010), Some(5_000_000_010));
    table.failed(0);
    assert_eq!(table.tail()[10..], [1, 0, 0, STALE, GOOD, GOOD, GOOD, STALE]);
    assert_eq!(table.tail()[..2], [0x34, 0x12]);
    let changes: Vec<_> = table.drain_changes().map(|c| (c.read, c.quality)).collect();
    assert_eq!(changes, [(4, Quality::Stale), (0, Quality::Stale)]);
    assert_eq!((table.quality(0), table.data_t_ns()), (Quality::Stale, 10));
}

fn image(table: &mut WriteTable, q: &[u8], now_ns: u64) -> Vec<(usize, Vec<u8>)> {
    let mut written = Vec::new();
    table.image(q, &[7; 4], now_ns, |i, pdu| written.push((i, pdu.to_vec())));
    written
}

#[test]
fn writes_follow_the_image() {
    let mut table = writes(json!([
        { "unit": 1, "table": "holding", "at": 9, "from": "%QW0" },
        { "unit": 1, "table": "holding", "at": 16, "from": "%QD1", "order": "CDAB" },
        { "unit": 1, "table": "coils", "at": 3, "from": "%QX8.2" },
        { "unit": 1, "table": "coils", "at": 4, "count": 10, "from": "%QX8.3" },
        { "unit": 1, "table": "holding", "at": 5, "from": "%MW0", "function": "multiple", "on_change": false, "period": "1s" },
        { "unit": 1, "table": "holding", "at": 5, "from": "%QW100" },
    ]));
    let q = [0x34, 0x12, 0, 0, 0x44, 0x33, 0x22, 0x11, 0b1010_1100, 0b0001_0000];
    let first = image(&mut table, &q, 0);
    assert_eq!(
        first,
        [
            (0, vec![6, 0, 9, 0x12, 0x34]),
            (1, vec![16, 0, 16, 0, 2, 4, 0x33, 0x44, 0x11, 0x22]),
            (2, vec![5, 0, 3, 0xFF, 0]),
            (3, vec![15, 0, 4, 0, 10, 2, 0b0001_0101, 0b10]),
            (4, vec![16, 0, 5, 0, 1, 2, 7, 7]),
        ]
    );
    assert_eq!((table.outside(), image(&mut table, &q, 1)), (1, vec![]));
    let mut changed = q;
    changed[8] = 0b1010_1000;
    assert_eq!(image(&mut table, &changed, 2), [(2, vec![5, 0, 3, 0, 0])]);
    // By period.
    let mut due = Vec::new();
    assert_eq!(table.due(999_999_999, |i, _| due.push(i)), Some(1_000_000_000));
    assert_eq!(table.due(1_000_000_000, |i, _| due.push(i)), Some(2_000_000_000));
    assert_eq!(due, [4]);
    // A unit that comes back gets everything.
    let mut again = Vec::new();
    table.again(0, Some(1), 0, |i, _| again.push(i));
    table.again(0, Some(2), 0, |i, _| again.push(i));
    assert_eq!(again, [0, 1, 2, 3, 4]);
    again.clear();
    table.again(0, None, 0, |i, _| again.push(i));
    table.again(1, None, 0, |i, _| again.push(i));
    assert_eq!(again, [0, 1, 2, 3, 4]);
}

#[test]
fn the_safe_state() {
    let mut table = writes(json!([
        { "unit": 1, "table": "holding", "at": 9, "from": "%QW0", "period": "1s" },
        { "unit": 1, "table": "coils", "at": 3, "count": 2, "from": "%QX2.0", "safe_values": [0, 1] },
    ]));
    let mut acts = Vec::new();
    table.safe(|i, pdu| acts.push((i, pdu.map(<[u8]>::to_vec))));
    assert!(acts.is_empty(), "nothing was running");
    image(&mut table, &[1, 0, 3], 0);
    table.safe(|i, pdu| acts.push((i, pdu.map(<[u8]>::to_vec))));
    assert_eq!(acts, [(0, None), (1, Some(vec![15, 0, 3, 0, 2, 1, 0b10]))]);
    assert_eq!(table.due(u64::MAX, |_, _| panic!("silent")), None);
    table.again(0, Some(1), 0, |_, _| panic!("silent"));
    // Back: everything is written, changed or not.
    assert_eq!(image(&mut table, &[1, 0, 3], 0).len(), 2);
}
