//! Logs in Vector's ASC format and logs of unknown format: a line is refused with a reason, passed over, or holds a frame
//! that can be written and read again.

#![no_main]

use dinrail_can::protocol::{asc, logfile};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|data: &[u8]| {
    let text = String::from_utf8_lossy(data);
    let (mut reader, mut any) = (asc::Reader::default(), logfile::Reader::default());
    for line in text.lines() {
        match reader.line(line) {
            Ok(Some(found)) => {
                found.frame.validate().unwrap();
                let writer = asc::Writer::new(found.t_ns);
                let mut again = asc::Reader::default();
                // A date the calendar of the format cannot tell is written, but not read.
                for line in writer.header().lines() {
                    let _ = again.line(line);
                }
                let line = writer.line(found.t_ns, found.channel, &found.frame, found.tx);
                let read = again.line(&line).unwrap().unwrap();
                assert_eq!((read.frame.is_error(), read.channel), (found.frame.is_error(), found.channel));
                if !found.frame.is_error() {
                    assert_eq!((read.frame, read.tx), (found.frame, found.tx));
                }
            }
            Ok(None) => {}
            Err(error) => assert!(!error.to_string().is_empty()),
        }
        match any.line(line) {
            Ok(Some(found)) => {
                found.frame.validate().unwrap();
                assert!(!found.bus.to_string().is_empty());
            }
            Ok(None) => {}
            Err(error) => assert!(!error.to_string().is_empty()),
        }
    }
});
