//! The outputs half of a field service: whether its outputs may follow the image of the plc.
//!
//! [`Guard`] judges: told images and times, it says when outputs enter and leave their safe state. [`OutputImage`] is
//! the guard together with the topic `<plc>/image`. [`OnStop`] is the stack-file key of the safe state. What the safe
//! state *is* (zero, silence, values, an NMT command) belongs to the service; nothing here sends or sets an output.

mod guard;
mod on_stop;

pub use guard::{Change, Guard, OutputImage, Words};
pub use on_stop::{OnStop, StopValues, StopWord};

use crate::event::Level;
use crate::payload::PlcState;
use crate::units::Span;
use crate::wiring::{Area, ImageRange};
use serde::{Deserialize, Serialize};

/// Default of the key `stale_after`: twice the time after which every plc repeats its image.
pub const STALE_AFTER: Span = Span::from_ms(200);

/// States of the plc in which outputs go to their safe state, as the key `safe_on` lists them. A stale image always
/// sends them there.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum SafeOn {
    /// Stopped by command.
    Stop,
    /// The program faulted.
    Fault,
    /// Halted at a breakpoint.
    Halted,
}

impl SafeOn {
    /// Every state: the default of the key.
    pub const ALL: [Self; 3] = [Self::Stop, Self::Fault, Self::Halted];
}

/// Why outputs are in their safe state. The numbers travel in emergency messages of a CANopen slave.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
#[repr(u8)]
pub enum Unsafe {
    /// No image of a running program yet.
    Waiting = 0,
    /// No image for longer than `stale_after`.
    Stale = 1,
    Stop = 2,
    Fault = 3,
    Halted = 4,
}

impl Unsafe {
    /// The reason as half a sentence.
    pub fn text(self) -> &'static str {
        match self {
            Self::Waiting => "the PLC has not finished a scan yet",
            Self::Stale => "the image of the PLC is stale: it is dead, hung or too slow",
            Self::Stop => "the PLC is stopped",
            Self::Fault => "the program of the PLC faulted",
            Self::Halted => "the PLC is halted at a breakpoint",
        }
    }

    /// A stop, a breakpoint and a (re)start are somebody's will and no fault; a plc that died is told of by itself.
    pub fn level(self) -> Level {
        match self {
            Self::Waiting | Self::Stop | Self::Halted => Level::Info,
            Self::Stale | Self::Fault => Level::Fault,
        }
    }
}

/// What an image asks of the outputs, whatever its age; `None`: follow it.
pub fn judge(state: PlcState, scan: u64, safe_on: &[SafeOn]) -> Option<Unsafe> {
    let asked = |on, why| safe_on.contains(&on).then_some(why);
    match state {
        _ if scan == 0 => Some(Unsafe::Waiting),
        PlcState::Starting => Some(Unsafe::Waiting),
        PlcState::Run => None,
        PlcState::Stop => asked(SafeOn::Stop, Unsafe::Stop),
        PlcState::Fault => asked(SafeOn::Fault, Unsafe::Fault),
        PlcState::Halted => asked(SafeOn::Halted, Unsafe::Halted),
    }
}

/// Copies what lies at a place of an area: `out.len()` bytes from `byte` on, or a bit of that byte as a byte of 0 or 1.
/// False, and `out` unchanged, where the area ends before.
pub fn copy_value(area: &[u8], byte: u32, bit: Option<u8>, out: &mut [u8]) -> bool {
    let from = byte as usize;
    let Some(value) = from.checked_add(out.len()).and_then(|to| area.get(from..to)) else { return false };
    match (bit, out.first_mut(), value.first()) {
        (Some(bit), Some(place), Some(byte)) => *place = byte >> (bit & 7) & 1,
        _ => out.copy_from_slice(value),
    }
    true
}

/// Copies the ranges of an image one behind the other; a bit becomes a byte of 0 or 1. What lies outside of the image
/// stays as it was, and ranges that `out` has no room for are left out.
pub fn gather(ranges: &[ImageRange], q: &[u8], m: &[u8], out: &mut [u8]) {
    let mut at = 0;
    for range in ranges {
        let area = if range.area == Area::Marker { m } else { q };
        let bytes = range.bytes as usize;
        let Some(place) = out.get_mut(at..at + bytes) else { return };
        at += bytes;
        copy_value(area, range.byte, range.bit, place);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wiring::OnBad;

    fn range(area: Area, byte: u32, bit: Option<u8>, bytes: u32) -> ImageRange {
        ImageRange {
            area,
            byte,
            bit,
            bytes,
            type_name: None,
            symbol: None,
            label: String::new(),
            key: String::new(),
            on_bad: OnBad::Hold,
            status_byte: None,
        }
    }

    #[test]
    fn ranges_are_gathered_in_their_order() {
        let ranges = [
            range(Area::Output, 1, None, 2),
            range(Area::Marker, 0, Some(3), 1),
            range(Area::Output, 9, None, 1),
            range(Area::Output, 0, None, 1),
        ];
        let mut out = [9; 4];
        gather(&ranges, &[1, 2, 3], &[8], &mut out);
        // What lies outside of the image stays; the last range finds no room.
        assert_eq!(out, [2, 3, 1, 9]);
    }

    #[test]
    fn values_are_copied_whole_or_not_at_all() {
        for (byte, bit, taken, expected) in [
            (0, None, true, [1, 2]),
            (1, None, true, [2, 0x80]),
            (2, None, false, [9, 9]),
            (u32::MAX, None, false, [9, 9]),
        ] {
            let mut out = [9; 2];
            assert_eq!(copy_value(&[1, 2, 0x80], byte, bit, &mut out), taken);
            assert_eq!(out, expected, "byte {byte}");
        }
        for (byte, bit, taken, expected) in
            [(2, 7, true, 1), (2, 6, true, 0), (0, 0, true, 1), (3, 0, false, 9)]
        {
            let mut out = [9];
            assert_eq!(copy_value(&[1, 2, 0x80], byte, Some(bit), &mut out), taken);
            assert_eq!(out, [expected], "bit {byte}.{bit}");
        }
    }

    #[test]
    fn states_are_judged_as_asked() {
        for (state, scan, on, expected) in [
            (PlcState::Run, 0, &SafeOn::ALL[..], Some(Unsafe::Waiting)),
            (PlcState::Run, 1, &SafeOn::ALL, None),
            (PlcState::Stop, 1, &SafeOn::ALL, Some(Unsafe::Stop)),
            (PlcState::Stop, 1, &[], None),
            (PlcState::Fault, 1, &SafeOn::ALL, Some(Unsafe::Fault)),
            (PlcState::Halted, 1, &SafeOn::ALL, Some(Unsafe::Halted)),
            (PlcState::Halted, 1, &[SafeOn::Stop], None),
            (PlcState::Starting, 1, &[], Some(Unsafe::Waiting)),
        ] {
            assert_eq!(judge(state, scan, on), expected, "{state:?}");
        }
    }

    #[test]
    fn words_of_the_stack_file() {
        let words = serde_json::to_value(SafeOn::ALL).unwrap();
        assert_eq!(words, serde_json::json!(["stop", "fault", "halted"]));
        assert_eq!(serde_json::from_value::<Vec<SafeOn>>(words).unwrap(), SafeOn::ALL);
    }
}
