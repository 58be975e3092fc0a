//! A concise DCF (object 1F22h): a message, or entries that are written as the same bytes.

#![no_main]

use dinrail_canopen::protocol::eds::concise::{decode, encode};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|input: &[u8]| {
    if let Ok(items) = decode(input) {
        assert!(input.is_empty() || encode(items) == input);
    }
});
