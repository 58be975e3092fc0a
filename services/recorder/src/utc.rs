//! UTC as people read it, from nanoseconds since 1970. No time zone, no clock, no locale.

/// Date and time of day.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Utc {
    pub year: i64,
    pub month: u32,
    pub day: u32,
    pub hour: u32,
    pub minute: u32,
    pub second: u32,
    pub nanos: u32,
}

const NS_PER_DAY: i64 = 86_400_000_000_000;

impl Utc {
    /// From nanoseconds since 1970; also before it.
    pub fn from_ns(ns: i64) -> Self {
        let days = ns.div_euclid(NS_PER_DAY);
        let rest = ns.rem_euclid(NS_PER_DAY) as u64;
        // Days since 0000-03-01, in eras of 400 years: a leap day then ends its year.
        let shifted = days + 719_468;
        let era = shifted.div_euclid(146_097);
        let day_of_era = shifted.rem_euclid(146_097);
        let year_of_era =
            (day_of_era - day_of_era / 1_460 + day_of_era / 36_524 - day_of_era / 146_096) / 365;
        let day_of_year = day_of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
        let month_from_march = (5 * day_of_year + 2) / 153;
        let day = day_of_year - (153 * month_from_march + 2) / 5 + 1;
        let month = if month_from_march < 10 { month_from_march + 3 } else { month_from_march - 9 };
        let seconds = rest / 1_000_000_000;
        Self {
            year: year_of_era + era * 400 + i64::from(month <= 2),
            month: month as u32,
            day: day as u32,
            hour: (seconds / 3600) as u32,
            minute: (seconds / 60 % 60) as u32,
            second: (seconds % 60) as u32,
            nanos: (rest % 1_000_000_000) as u32,
        }
    }

    /// `20260311T142233.123`, as in file names.
    pub fn compact(self) -> String {
        let millis = self.nanos / 1_000_000;
        format!(
            "{:04}{:02}{:02}T{:02}{:02}{:02}.{millis:03}",
            self.year, self.month, self.day, self.hour, self.minute, self.second
        )
    }

    /// `2026-03-11T14:22:33.123456Z`.
    pub fn iso(self) -> String {
        let micros = self.nanos / 1000;
        format!(
            "{:04}-{:02}-{:02}T{:02}:{:02}:{:02}.{micros:06}Z",
            self.year, self.month, self.day, self.hour, self.minute, self.second
        )
    }
}

/// `2026-03-11T14:22:33.123456Z` of an MCAP time.
pub fn iso(ns: u64) -> String {
    Utc::from_ns(ns.min(i64::MAX as u64) as i64).iso()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn known_days() {
        for (seconds, text) in [
            (0, "19700101T000000.000"),
            (951_782_400, "20000229T000000.000"),
            (1_709_210_096, "20240229T123456.000"),
            (4_107_542_399, "21000228T235959.000"),
            (4_107_542_400, "21000301T000000.000"),
            (-1, "19691231T235959.000"),
        ] {
            assert_eq!(Utc::from_ns(seconds * 1_000_000_000).compact(), text);
        }
        assert_eq!(iso(1_709_210_096_123_456_789), "2024-02-29T12:34:56.123456Z");
        assert_eq!(iso(u64::MAX).len(), 27);
    }

    proptest! {
        #[test]
        fn later_is_greater(a in 0i64..9_000_000_000_000_000_000, step in 1_000_000i64..400_000_000_000_000_000) {
            prop_assume!(a.checked_add(step).is_some());
            prop_assert!(Utc::from_ns(a).compact() < Utc::from_ns(a + step).compact());
        }
    }
}
