//! The two clocks of a stack: CLOCK_MONOTONIC stamps everything, UTC is an offset that is recorded.

use rustix::time::{ClockId, clock_gettime};

fn read(id: ClockId) -> i64 {
    let t = clock_gettime(id);
    t.tv_sec as i64 * 1_000_000_000 + t.tv_nsec as i64
}

/// CLOCK_MONOTONIC in ns; the same on all processes of the machine.
pub fn mono_ns() -> u64 {
    read(ClockId::Monotonic) as u64
}

/// UTC in ns since 1970.
pub fn utc_ns() -> i64 {
    read(ClockId::Realtime)
}

/// `UTC - CLOCK_MONOTONIC` in ns, now.
pub fn utc_offset_ns() -> i64 {
    let before = mono_ns();
    let utc = utc_ns();
    let after = mono_ns();
    utc - (before / 2 + after / 2) as i64
}
