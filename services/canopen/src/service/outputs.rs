//! The process image as the outputs of a field service: gathered, judged, replaced by the safe state.

use crate::config::{Number, SafeOn};
use ipc_types::event::Level;
use ipc_types::payload::PlcState;
use ipc_types::wiring::{Area, ImageRange};
use serde::Serialize;

/// Why outputs are in their safe state.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Unsafe {
    /// No image of a running program yet.
    Waiting,
    Stale,
    Stop,
    Fault,
    Halted,
}

impl Unsafe {
    pub fn text(self) -> &'static str {
        match self {
            Self::Waiting => "the PLC has not finished a scan yet",
            Self::Stale => "the image of the PLC is stale: it is dead, hung or too slow",
            Self::Stop => "the PLC is stopped",
            Self::Fault => "the program of the PLC faulted",
            Self::Halted => "the PLC is halted at a breakpoint",
        }
    }
    pub fn level(self) -> Level {
        match self {
            Self::Waiting | Self::Stop | Self::Halted => Level::Info,
            Self::Stale | Self::Fault => Level::Fault,
        }
    }
}

/// What an image asks of the outputs; `None`: follow it.
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

/// Copies the ranges of an image one behind the other; a bit becomes a byte of 0 or 1.
pub fn gather(ranges: &[ImageRange], q: &[u8], m: &[u8], out: &mut [u8]) {
    let mut at = 0;
    for range in ranges {
        let area = if range.area == Area::Marker { m } else { q };
        let (from, bytes) = (range.byte as usize, range.bytes as usize);
        let Some(place) = out.get_mut(at..at + bytes) else { return };
        at += bytes;
        let Some(value) = area.get(from..from + bytes) else { continue };
        match range.bit {
            Some(bit) => place[0] = value[0] >> bit & 1,
            None => place.copy_from_slice(value),
        }
    }
}

/// The gathered outputs of a safe state with values: those named, zero for the others.
pub fn values(ranges: &[ImageRange], values: &[(usize, Number)]) -> Vec<u8> {
    let total = ranges.iter().map(|r| r.bytes as usize).sum();
    let mut out = vec![0; total];
    for (which, value) in values {
        let at: usize = ranges[..*which].iter().map(|r| r.bytes as usize).sum();
        let bytes = (ranges[*which].bytes as usize).min(8);
        let real = matches!(ranges[*which].type_name.as_deref(), Some("REAL" | "LREAL"));
        let raw = match value {
            Number::Float(v) if bytes == 4 => u64::from((*v as f32).to_bits()),
            Number::Float(v) => v.to_bits(),
            other => {
                let int = other.integer(0).unwrap_or(0);
                match (real, bytes) {
                    (true, 4) => u64::from((int as f32).to_bits()),
                    (true, _) => (int as f64).to_bits(),
                    _ => int as u64,
                }
            }
        };
        out[at..at + bytes].copy_from_slice(&raw.to_le_bytes()[..bytes]);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use ipc_types::wiring::OnBad;

    fn range(area: Area, byte: u32, bit: Option<u8>, bytes: u32, type_name: &str) -> ImageRange {
        ImageRange {
            area,
            byte,
            bit,
            bytes,
            type_name: Some(type_name.to_owned()),
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
            range(Area::Output, 1, None, 2, "INT"),
            range(Area::Marker, 0, Some(3), 1, "BOOL"),
            range(Area::Output, 9, None, 1, "BYTE"),
        ];
        let mut out = [9; 4];
        gather(&ranges, &[1, 2, 3], &[8], &mut out);
        // What lies outside of the image stays.
        assert_eq!(out, [2, 3, 1, 9]);
    }

    #[test]
    fn safe_values_have_the_type_of_their_place() {
        let ranges = [range(Area::Output, 0, None, 2, "INT"), range(Area::Output, 4, None, 4, "REAL")];
        let out = values(&ranges, &[(1, Number::Int(2)), (0, Number::Int(-1))]);
        assert_eq!(out, [0xFF, 0xFF, 0, 0, 0, 0x40]);
    }

    #[test]
    fn states_are_judged_as_asked() {
        let all = [SafeOn::Stop, SafeOn::Fault, SafeOn::Halted];
        for (state, scan, on, expected) in [
            (PlcState::Run, 0, &all[..], Some(Unsafe::Waiting)),
            (PlcState::Run, 1, &all, None),
            (PlcState::Stop, 1, &all, Some(Unsafe::Stop)),
            (PlcState::Stop, 1, &[], None),
            (PlcState::Fault, 1, &all, Some(Unsafe::Fault)),
            (PlcState::Halted, 1, &all, Some(Unsafe::Halted)),
            (PlcState::Starting, 1, &[], Some(Unsafe::Waiting)),
        ] {
            assert_eq!(judge(state, scan, on), expected, "{state:?}");
        }
    }
}
