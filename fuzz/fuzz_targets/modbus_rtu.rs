//! RTU frames: what is accepted is written again as the same bytes; a stream of them is read to its end whatever it
//! holds, and every frame found in it is one.

#![no_main]

use dinrail_modbus::protocol::rtu;
use dinrail_modbus::stream::{Found, find};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|data: &[u8]| {
    if let Ok((unit, pdu)) = rtu::decode(data) {
        let mut out = [0; rtu::MAX_ADU];
        let len = rtu::encode(unit, pdu, &mut out);
        assert_eq!(out[..len], *data);
    }
    let _ = (rtu::request_length(data), rtu::response_length(data));
    let mut rest = data;
    while let Found::Frame { skip, len } = find(rest, false, |unit| matches!(unit, 0 | 5)) {
        assert!(rtu::is_frame(&rest[skip..skip + len]));
        rest = &rest[skip + len..];
    }
    // After a silence nothing is left.
    while let Found::Frame { skip, len } = find(rest, true, |unit| matches!(unit, 0 | 5)) {
        rest = &rest[skip + len..];
    }
    assert_eq!(find(rest, true, |_| true), Found::Nothing { skip: rest.len() });
});
