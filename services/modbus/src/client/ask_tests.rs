//! Jobs to bytes, answers to JSON.

use super::*;
use proptest::prelude::*;

#[test]
fn requests_of_every_function() {
    for (job, bytes) in [
        (json!({ "do": "read", "table": "coils", "at": 19, "count": 19 }), "01 00 13 00 13"),
        (json!({ "do": "read", "table": "discrete", "at": 196, "count": 22 }), "02 00 C4 00 16"),
        (json!({ "do": "read", "table": "holding", "at": 107, "count": 3 }), "03 00 6B 00 03"),
        (json!({ "do": "read", "table": "input_registers", "at": 8 }), "04 00 08 00 01"),
        (json!({ "do": "write", "table": "coils", "at": 172, "values": [true] }), "05 00 AC FF 00"),
        (json!({ "do": "write", "table": "holding", "at": 1, "values": [3] }), "06 00 01 00 03"),
        (
            json!({ "do": "write", "table": "holding", "at": 1, "values": [-1], "multiple": true }),
            "10 00 01 00 01 02 FF FF",
        ),
        (json!({ "do": "exception_status" }), "07"),
        (json!({ "do": "diagnostics", "sub": 0, "data": 0xA537 }), "08 00 00 A5 37"),
        (json!({ "do": "event_counter" }), "0B"),
        (json!({ "do": "event_log" }), "0C"),
        (
            json!({ "do": "write", "table": "coils", "at": 19, "values": [1,0,1,1,0,0,1,1,1,0] }),
            "0F 00 13 00 0A 02 CD 01",
        ),
        (
            json!({ "do": "write", "table": "holding", "at": 1, "values": [10, 258] }),
            "10 00 01 00 02 04 00 0A 01 02",
        ),
        (json!({ "do": "server_id" }), "11"),
        (json!({ "do": "read_file", "file": 4, "record": 1, "count": 2 }), "14 07 06 00 04 00 01 00 02"),
        (
            json!({ "do": "write_file", "file": 4, "record": 7, "values": [1711, 1214, 4109] }),
            "15 0D 06 00 04 00 07 00 03 06 AF 04 BE 10 0D",
        ),
        (json!({ "do": "mask", "at": 4, "and": 242, "or": 37 }), "16 00 04 00 F2 00 25"),
        (
            json!({ "do": "read_write", "at": 3, "count": 6, "write_at": 14, "values": [255, 255, 255] }),
            "17 00 03 00 06 00 0E 00 03 06 00 FF 00 FF 00 FF",
        ),
        (json!({ "do": "read_fifo", "at": 1246 }), "18 04 DE"),
        (json!({ "do": "identification" }), "2B 0E 01 00"),
        (json!({ "do": "raw", "pdu": "64 0102" }), "64 01 02"),
    ] {
        assert_eq!(hex_text(Ask::from_json(&job).unwrap().pdu()), bytes, "{job}");
    }
}

#[test]
fn answers_in_words() {
    let ask = |job: Value| Ask::from_json(&job).unwrap();
    for (job, answer, expected) in [
        (
            json!({ "do": "read", "table": "coils", "at": 0, "count": 3 }),
            "01 01 05",
            json!({ "values": [1, 0, 1] }),
        ),
        (
            json!({ "do": "read", "table": "holding", "at": 0, "count": 2 }),
            "03 04 00 01 FF FF",
            json!({ "values": [1, 65535] }),
        ),
        (
            json!({ "do": "write", "table": "holding", "at": 1, "values": [3] }),
            "06 00 01 00 03",
            json!({ "written": 1 }),
        ),
        (json!({ "do": "exception_status" }), "07 6D", json!({ "status": 0x6D })),
        (json!({ "do": "diagnostics", "sub": 11 }), "08 00 0B 00 09", json!({ "sub": 11, "data": [9] })),
        (json!({ "do": "event_counter" }), "0B FF FF 01 08", json!({ "busy": true, "events": 264 })),
        (
            json!({ "do": "event_log" }),
            "0C 08 00 00 01 08 01 21 20 00",
            json!({ "busy": false, "events": 264, "messages": 289, "log": "20 00" }),
        ),
        (
            json!({ "do": "server_id" }),
            "11 04 01 FF 41 42",
            json!({ "id": 1, "running": true, "text": "AB", "bytes": "01 FF 41 42" }),
        ),
        (
            json!({ "do": "read_file", "file": 4, "record": 1, "count": 2 }),
            "14 06 05 06 0D FE 00 20",
            json!({ "values": [3582, 32] }),
        ),
        (
            json!({ "do": "read_fifo", "at": 1246 }),
            "18 00 06 00 02 01 B8 12 84",
            json!({ "values": [440, 4740] }),
        ),
        (
            json!({ "do": "identification" }),
            "2B 0E 01 01 00 00 01 00 02 41 FF",
            json!({ "conformity": 1, "more": false, "next": 0, "objects": [{ "id": 0, "name": "VendorName", "text": "A\\xff" }] }),
        ),
        (json!({ "do": "raw", "pdu": "64 01" }), "64 07", json!({ "pdu": "64 07" })),
    ] {
        let ask = ask(job);
        assert_eq!(ask.explain(&hex(answer).unwrap()).unwrap(), expected, "{answer}");
    }
    let read = ask(json!({ "do": "read", "table": "holding", "at": 0 }));
    assert_eq!(
        read.explain(&[0x83, 2]).unwrap_err(),
        "exception 02 to function 3 (Read Holding Registers): the unit has no such address, or not so many of them"
    );
    assert_eq!(read.explain(&[4, 2, 0, 0]).unwrap_err(), "the answer does not fit the request");
}

#[test]
fn what_cannot_be_asked_is_named() {
    let all: Vec<String> = [
        json!({}),
        json!({ "do": "fly" }),
        json!({ "do": "read", "at": 0 }),
        json!({ "do": "read", "table": "holding", "at": 70_000 }),
        json!({ "do": "read", "table": "holding", "at": 0, "count": 126 }),
        json!({ "do": "write", "table": "input", "at": 0, "values": [1] }),
        json!({ "do": "write", "table": "holding", "at": 0, "values": [65_536] }),
        json!({ "do": "write", "table": "coils", "at": 0, "values": [2] }),
        json!({ "do": "write", "table": "holding", "at": 0, "values": [] }),
        json!({ "do": "raw", "pdu": "0" }),
    ]
    .iter()
    .map(|job| Ask::from_json(job).unwrap_err().to_string())
    .collect();
    insta::assert_snapshot!(all.join("\n"), @r#"
    the job lacks "do" (a text)
    a modbus-client does not know the job 'fly'; it knows read, write, mask, read_write, exception_status, diagnostics, event_counter, event_log, server_id, read_file, write_file, read_fifo, identification, raw, status
    the job lacks "table" (coils, discrete_inputs, input_registers or holding_registers)
    "at": 70000 is not 0 to 65535
    "count": 126 is not 1 to 125
    input_registers cannot be written; coils and holding_registers can
    "values": 65536 is not -32768 to 65535
    the job lacks "values" (a list of true and false)
    "values": 0 is not 1 to 123
    "pdu": '0' is no list of 1 to 253 hexadecimal bytes
    "#);
}

proptest! {
    #[test]
    fn any_answer_to_any_request(request in prop::collection::vec(any::<u8>(), 1..20), answer in prop::collection::vec(any::<u8>(), 0..40), same: bool) {
        let ask = Ask::new(&[&request]);
        let mut answer = answer;
        if same && !answer.is_empty() {
            answer[0] = request[0];
        }
        let _ = ask.explain(&answer);
    }
}
