//! ASCII frames: what is accepted is written again as the same characters, but for the case of digits; characters of
//! a line never break the receiver, and a good frame behind them is found.

#![no_main]

use dinrail_modbus::protocol::ascii::{self, Received, Receiver};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|data: &[u8]| {
    let mut buffer = [0; 256];
    if let Ok((unit, pdu)) = ascii::decode(data, &mut buffer) {
        let mut out = [0; ascii::MAX_ADU];
        let len = ascii::encode(unit, pdu, &mut out);
        assert!(out[..len].eq_ignore_ascii_case(data));
    }
    let mut receiver = Receiver::default();
    for &character in data {
        if receiver.push(character) == Received::Frame {
            let _ = ascii::decode(receiver.frame(), &mut buffer);
        }
    }
    let mut found = false;
    for &character in b":0103FC\r\n" {
        found = receiver.push(character) == Received::Frame;
    }
    assert!(found && ascii::decode(receiver.frame(), &mut buffer) == Ok((1, &[3][..])));
});
