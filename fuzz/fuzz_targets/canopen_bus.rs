//! A master and two devices on one bus that hears anything: each step is its pause in ms (a byte), the identifier
//! with its flags (two bytes, or four after a pause of 255) and, after a length, data. Nothing panics, frames do not
//! answer each other for ever, and after a reset of the nodes the network is whole again.

#![no_main]

#[path = "../../services/canopen/tests/bed/mod.rs"]
mod bed;

use bed::{Bed, Step};
use ipc_types::payload::id_flag;
use libfuzzer_sys::fuzz_target;

/// Steps of one run, at most: each may cost virtual time.
const MAX_STEPS: usize = 60;

fn step(input: &mut &[u8]) -> Option<Step> {
    let (&pause, rest) = input.split_first()?;
    let (can_id, rest) = if pause == u8::MAX {
        let (id, rest) = rest.split_first_chunk::<4>()?;
        (u32::from_le_bytes(*id), rest)
    } else {
        let (id, rest) = rest.split_first_chunk::<2>()?;
        let id = u32::from(u16::from_le_bytes(*id));
        (id & 0x7FF | if id & 0x8000 != 0 { id_flag::RTR } else { 0 }, rest)
    };
    let (&len, rest) = rest.split_first()?;
    let len = usize::from(len % 9).min(rest.len());
    let (data, rest) = rest.split_at(len);
    *input = rest;
    Some(Step { pause_ms: u64::from(pause), can_id, data: data.to_vec() })
}

fuzz_target!(|input: &[u8]| {
    let mut rest = input;
    let steps: Vec<Step> = std::iter::from_fn(|| step(&mut rest)).take(MAX_STEPS).collect();
    let bed = Bed::new();
    assert!(bed.is_ok(), "the bus is planned");
    let Ok(bed) = bed else { return };
    assert!(bed.survives(steps), "the network is not whole again after a reset of its nodes");
});
