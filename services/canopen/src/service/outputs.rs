//! The values that outputs have in their safe state.

use crate::config::Number;
use ipc_types::wiring::ImageRange;

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
    use ipc_types::wiring::{Area, OnBad};

    fn range(byte: u32, bytes: u32, type_name: &str) -> ImageRange {
        ImageRange {
            area: Area::Output,
            byte,
            bit: None,
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
    fn safe_values_have_the_type_of_their_place() {
        let ranges = [range(0, 2, "INT"), range(4, 4, "REAL")];
        let out = values(&ranges, &[(1, Number::Int(2)), (0, Number::Int(-1))]);
        assert_eq!(out, [0xFF, 0xFF, 0, 0, 0, 0x40]);
    }
}
