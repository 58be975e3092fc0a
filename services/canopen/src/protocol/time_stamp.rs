//! TIME: the TIME_OF_DAY message, producer and consumer (CiA 301 V4.2, 7.2.6, object 1012h).
//!
//! The core knows no wall clock: whoever has one hands the time in.

use ipc_types::payload::CanFrame;

use super::cob_id::{BIT_30, BIT_31, CobId};
use super::io::Outbox;

/// Days from 1970-01-01 to 1984-01-01, where TIME_OF_DAY begins (CiA 301 V4.2, 7.1.6.6).
pub const DAYS_TO_1984: u64 = 5113;
/// Milliseconds of a day.
pub const MS_PER_DAY: u32 = 86_400_000;

/// TIME_OF_DAY.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct TimeOfDay {
    /// Milliseconds since midnight, 28 bits.
    pub ms: u32,
    /// Days since 1984-01-01.
    pub days: u16,
}

impl TimeOfDay {
    /// None before 1984 and after 2163 (16 bits of days).
    pub fn from_unix_ms(unix_ms: u64) -> Option<Self> {
        let days = (unix_ms / u64::from(MS_PER_DAY)).checked_sub(DAYS_TO_1984)?;
        Some(Self { ms: (unix_ms % u64::from(MS_PER_DAY)) as u32, days: u16::try_from(days).ok()? })
    }
    /// Milliseconds since 1970-01-01.
    pub fn unix_ms(self) -> u64 {
        (u64::from(self.days) + DAYS_TO_1984) * u64::from(MS_PER_DAY) + u64::from(self.ms)
    }
    /// 28 bits of milliseconds, 4 reserved bits, 16 bits of days.
    pub fn encode(self) -> [u8; 6] {
        let [a, b, c, d] = (self.ms & 0x0FFF_FFFF).to_le_bytes();
        let [e, f] = self.days.to_le_bytes();
        [a, b, c, d, e, f]
    }
    /// None unless 6 bytes with less than a day of milliseconds.
    pub fn decode(data: &[u8]) -> Option<Self> {
        let &[a, b, c, d, e, f] = data else { return None };
        let ms = u32::from_le_bytes([a, b, c, d]) & 0x0FFF_FFFF;
        (ms < MS_PER_DAY).then_some(Self { ms, days: u16::from_le_bytes([e, f]) })
    }
}

/// Producer and consumer, as 1012h says.
#[derive(Debug, Clone, Copy, Default)]
pub struct TimeStamp {
    object: u32,
}

impl TimeStamp {
    /// Takes 1012h; 0 without the object.
    pub fn configure(&mut self, object: u32) {
        self.object = object;
    }
    /// Bit 31: the device consumes TIME (7.5.2.15, figure 60).
    pub fn consumes(self) -> bool {
        self.object & BIT_31 != 0
    }
    /// Bit 30: the device produces TIME.
    pub fn produces(self) -> bool {
        self.object & BIT_30 != 0
    }
    fn cob(self) -> CobId {
        CobId(self.object & !(BIT_30 | BIT_31))
    }
    /// The time a frame tells, if it is a TIME message and the device consumes it.
    pub fn on_frame(self, frame: &CanFrame) -> Option<TimeOfDay> {
        if !self.consumes() || frame.is_remote() || !self.cob().matches(frame) {
            return None;
        }
        TimeOfDay::decode(frame.payload())
    }
    /// Sends TIME, if the device produces it. Tells whether it did.
    pub fn produce(self, time: TimeOfDay, out: &mut Outbox) -> bool {
        if self.produces() {
            out.push(self.cob().frame(&time.encode()));
        }
        self.produces()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn time_of_day_counts_from_1984() {
        // 2024-02-29 12:00:00 UTC.
        let time = TimeOfDay::from_unix_ms(1_709_208_000_000).unwrap();
        assert_eq!(time, TimeOfDay { ms: 43_200_000, days: 14_669 });
        assert_eq!(time.unix_ms(), 1_709_208_000_000);
        assert_eq!(TimeOfDay::decode(&time.encode()), Some(time));
        assert_eq!(TimeOfDay::from_unix_ms(0), None);
        assert_eq!(TimeOfDay::from_unix_ms(u64::MAX), None);
        assert_eq!(TimeOfDay::decode(&[0xFF; 6]), None);
        assert_eq!(TimeOfDay::decode(&[0; 5]), None);
    }

    #[test]
    fn bits_30_and_31_of_1012_decide() {
        let mut out = Outbox::default();
        let mut time = TimeStamp::default();
        let stamp = TimeOfDay { ms: 1, days: 2 };
        assert!(!time.produce(stamp, &mut out));
        time.configure(0x4000_0100);
        assert!(time.produce(stamp, &mut out));
        let frame = out.drain().next().unwrap();
        assert_eq!(time.on_frame(&frame), None);
        time.configure(0x8000_0100);
        assert_eq!(time.on_frame(&frame), Some(stamp));
        assert!(!time.produce(stamp, &mut out));
    }
}
