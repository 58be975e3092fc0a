//! Stack files: any text is resolved or refused with messages. It is read as if it stood in the conveyor's folder, so
//! that it finds a program and a log to name.

#![no_main]

use dinrail_launcher::stackfile::load_text;
use libfuzzer_sys::fuzz_target;
use std::path::Path;

fuzz_target!(|data: &[u8]| {
    let file = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../launcher/stacks/conveyor/stack.toml"));
    match load_text(file, &String::from_utf8_lossy(data)) {
        Ok(loaded) => {
            assert_eq!(loaded.launch.len(), loaded.stack.services.len());
            assert!(loaded.findings.iter().all(|finding| !finding.to_string().is_empty()));
        }
        Err(error) => assert!(error.errors() > 0 && !error.to_string().is_empty()),
    }
});
