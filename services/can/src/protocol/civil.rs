//! Dates of log headers: the proleptic Gregorian calendar, UTC, from 1970 on.

const WEEKDAYS: [&str; 7] = ["Thu", "Fri", "Sat", "Sun", "Mon", "Tue", "Wed"];
const MONTHS: [&str; 12] =
    ["Jan", "Feb", "Mar", "Apr", "May", "Jun", "Jul", "Aug", "Sep", "Oct", "Nov", "Dec"];

fn is_leap(year: i32) -> bool {
    year % 4 == 0 && (year % 100 != 0 || year % 400 == 0)
}

fn month_days(year: i32, month: u32) -> u32 {
    match month {
        2 => 28 + u32::from(is_leap(year)),
        4 | 6 | 9 | 11 => 30,
        _ => 31,
    }
}

/// Days from 1970-01-01 to a date; `None` for what is no date or lies before 1970 or behind 2500.
pub(super) fn days(year: i32, month: u32, day: u32) -> Option<u64> {
    if !(1970..=2500).contains(&year)
        || !(1..=12).contains(&month)
        || day == 0
        || day > month_days(year, month)
    {
        return None;
    }
    let years: u64 = (1970..year).map(|y| 365 + u64::from(is_leap(y))).sum();
    let months: u64 = (1..month).map(|m| u64::from(month_days(year, m))).sum();
    Some(years + months + u64::from(day - 1))
}

/// `Sat Sep 30 15:06:13.191 2017`.
pub(super) fn asc_date(utc_ns: u64) -> String {
    let (seconds, ms) = (utc_ns / 1_000_000_000, utc_ns / 1_000_000 % 1000);
    let (mut left, of_day) = (seconds / 86_400, seconds % 86_400);
    let weekday = WEEKDAYS[(left % 7) as usize];
    let mut year = 1970;
    while left >= 365 + u64::from(is_leap(year)) {
        left -= 365 + u64::from(is_leap(year));
        year += 1;
    }
    let mut month = 1;
    while left >= u64::from(month_days(year, month)) {
        left -= u64::from(month_days(year, month));
        month += 1;
    }
    let name = MONTHS[(month - 1) as usize];
    let (hour, minute, second) = (of_day / 3600, of_day / 60 % 60, of_day % 60);
    format!("{weekday} {name} {:02} {hour:02}:{minute:02}:{second:02}.{ms:03} {year}", left + 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dates_both_ways() {
        assert_eq!(days(1970, 1, 1), Some(0));
        assert_eq!(days(2017, 9, 30), Some(17_439));
        assert_eq!(days(2000, 2, 29), Some(11_016));
        for (year, month, day) in
            [(1969, 12, 31), (2100, 2, 29), (2017, 13, 1), (2017, 4, 31), (2017, 4, 0), (9999, 1, 1)]
        {
            assert_eq!(days(year, month, day), None, "{year}-{month}-{day}");
        }
        assert_eq!(asc_date(1_506_783_973_191_999_999), "Sat Sep 30 15:06:13.191 2017");
        assert_eq!(asc_date(0), "Thu Jan 01 00:00:00.000 1970");
        assert_eq!(asc_date(1_709_164_800_000_000_000), "Thu Feb 29 00:00:00.000 2024");
    }
}
