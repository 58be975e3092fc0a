//! An EDS: a message, or a file that can be checked, named and made a dictionary of.

#![no_main]

use dinrail_canopen::protocol::eds::{BuildOptions, Eds};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|input: &[u8]| {
    let Ok(eds) = Eds::parse(input) else { return };
    for diag in eds.check() {
        assert!(!diag.to_string().is_empty());
    }
    assert_eq!(eds.names().count(), eds.entries().count());
    for parameter_values in [false, true] {
        let options = BuildOptions { parameter_values, ..BuildOptions::default() };
        if let Ok(od) = eds.builder(&options).build(5) {
            assert!(od.entries().count() <= eds.entries().count());
        }
    }
});
