//! Error frames: whatever a driver writes into one, it has words, and state and counters do not contradict them.

#![no_main]

use dinrail_can::protocol::error_frame::{ControllerState, ErrorFrame};
use dinrail_can::sys::{CLASSIC_BYTES, FD_BYTES, from_kernel, to_kernel};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|data: &[u8]| {
    for size in [CLASSIC_BYTES, FD_BYTES] {
        let mut bytes = vec![0; size];
        let n = data.len().min(size);
        bytes[..n].copy_from_slice(&data[..n]);
        let Some(frame) = from_kernel(&bytes) else { continue };
        let (again, len) = to_kernel(&frame);
        assert_eq!(from_kernel(&again[..len]), Some(frame));
        let Some(error) = ErrorFrame::of(&frame) else {
            assert!(!frame.is_error());
            continue;
        };
        let words = error.words();
        assert!(!words.is_empty() && words.len() < 1000 && !words.contains('\n'));
        assert_eq!(error.state() == Some(ControllerState::BusOff), words.contains("bus-off"));
        assert_eq!(error.counters().is_some(), words.contains("TEC"));
        assert!(!error.is_restart() || words.contains("restarted"));
    }
});
