//! A DCF: what is read, written and read again configures the same values.

#![no_main]

use dinrail_canopen::protocol::eds::{Commissioning, DcfOptions, Eds};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|input: &[u8]| {
    let Ok(eds) = Eds::parse(input) else { return };
    let commissioning = Commissioning { node_id: 5, ..Commissioning::default() };
    let options = DcfOptions { commissioning, ..DcfOptions::default() };
    let Ok(text) = eds.dcf(&options, &[]) else { return };
    let Ok(again) = Eds::parse(text.as_bytes()) else { panic!("what was written is refused") };
    assert_eq!(again.parameter_values(5), eds.parameter_values(5));
    assert_eq!(again.objects.len(), eds.objects.len());
});
