//! Logs of candump: a line is refused with a reason or holds a frame that can be written and read again.

#![no_main]

use dinrail_can::protocol::candump::{MAX_LINE, format, format_log_line, parse, parse_log_line};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|data: &[u8]| {
    let text = String::from_utf8_lossy(data);
    for line in text.lines() {
        match parse_log_line(line) {
            Ok(Some(found)) => {
                found.frame.validate().unwrap();
                assert_eq!(parse(&format(&found.frame)), Ok(found.frame));
                let again = format_log_line(found.t_ns, found.bus, &found.frame);
                if again.len() <= MAX_LINE {
                    assert_eq!(parse_log_line(&again).unwrap().unwrap().frame, found.frame);
                }
            }
            Ok(None) => {}
            Err(error) => assert!(!error.to_string().is_empty()),
        }
        if let Ok(frame) = parse(line) {
            frame.validate().unwrap();
        }
    }
});
