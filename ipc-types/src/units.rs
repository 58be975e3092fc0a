//! Values of the stack file that carry a unit: `"10ms"`, `"100MiB"`, `"500k"`.

use serde::{Deserialize, Deserializer, Serialize, Serializer, de};
use std::fmt;
use std::time::Duration;

/// A text that is no value of its unit.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum UnitError {
    #[error(
        "'{0}' is not a duration: write a number and a unit, e.g. \"500us\", \"10ms\", \"1.5s\", \"2min\", \"1h\""
    )]
    Duration(String),
    #[error("'{0}' is not a size: write a number and a unit, e.g. \"512KiB\", \"100MiB\", \"2GiB\"")]
    Size(String),
    #[error("'{0}' is not a bit rate: write e.g. \"500k\", \"1M\" or 125000")]
    Rate(String),
}

/// Splits `"1.5ms"` into number and unit; at most 9 fractional digits.
fn split(text: &str) -> Option<(f64, &str)> {
    let text = text.trim();
    let end = text.find(|c: char| !(c.is_ascii_digit() || c == '.')).unwrap_or(text.len());
    let number: f64 = text[..end].parse().ok()?;
    number.is_finite().then_some((number, text[end..].trim()))
}

macro_rules! text_unit {
    ($(#[$doc:meta])* $name:ident($inner:ty), $err:ident, $expect:literal, $parse:expr, $show:expr) => {
        $(#[$doc])*
        #[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
        pub struct $name(pub $inner);

        impl std::str::FromStr for $name {
            type Err = UnitError;
            fn from_str(text: &str) -> Result<Self, UnitError> {
                let parse: fn(&str) -> Option<$inner> = $parse;
                parse(text).map($name).ok_or_else(|| UnitError::$err(text.to_owned()))
            }
        }
        impl fmt::Display for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                let show: fn($inner) -> String = $show;
                f.write_str(&show(self.0))
            }
        }
        impl fmt::Debug for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                fmt::Display::fmt(self, f)
            }
        }
        impl Serialize for $name {
            fn serialize<S: Serializer>(&self, s: S) -> Result<S::Ok, S::Error> {
                s.collect_str(self)
            }
        }
        impl<'de> Deserialize<'de> for $name {
            fn deserialize<D: Deserializer<'de>>(d: D) -> Result<Self, D::Error> {
                struct Visit;
                impl de::Visitor<'_> for Visit {
                    type Value = $name;
                    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                        f.write_str($expect)
                    }
                    fn visit_str<E: de::Error>(self, text: &str) -> Result<$name, E> {
                        text.parse().map_err(E::custom)
                    }
                    fn visit_i64<E: de::Error>(self, n: i64) -> Result<$name, E> {
                        n.to_string().parse().map_err(E::custom)
                    }
                    fn visit_u64<E: de::Error>(self, n: u64) -> Result<$name, E> {
                        n.to_string().parse().map_err(E::custom)
                    }
                }
                d.deserialize_any(Visit)
            }
        }
    };
}

text_unit!(
    /// A duration in nanoseconds, up to 292 years. In files: `"500us"`, `"10ms"`, `"2s"`, `"5min"`, `"1h"`.
    /// A bare number is refused, except 0: a unit must stand.
    Span(u64), Duration, "a duration such as \"10ms\"",
    |text| {
        let (number, unit) = split(text)?;
        let factor = match unit {
            "ns" => 1.0,
            "us" | "µs" => 1e3,
            "ms" => 1e6,
            "s" => 1e9,
            "min" => 60e9,
            "h" => 3600e9,
            "d" => 86400e9,
            "" if number == 0.0 => 0.0,
            _ => return None,
        };
        let ns = (number * factor).round();
        (ns < i64::MAX as f64).then_some(ns as u64)
    },
    |ns| {
        for (unit, size) in [("h", 3_600_000_000_000), ("min", 60_000_000_000), ("s", 1_000_000_000),
                             ("ms", 1_000_000), ("us", 1_000)] {
            if ns != 0 && ns % size == 0 {
                return format!("{}{unit}", ns / size);
            }
        }
        format!("{ns}ns")
    }
);

impl Span {
    /// From whole milliseconds.
    pub const fn from_ms(ms: u64) -> Self {
        Self(ms * 1_000_000)
    }
    /// Nanoseconds.
    pub const fn ns(self) -> u64 {
        self.0
    }
    /// As std's type.
    pub const fn duration(self) -> Duration {
        Duration::from_nanos(self.0)
    }
}

text_unit!(
    /// A size in bytes. In files: `4096`, `"64KiB"`, `"100MiB"`, `"2GiB"` (also kB, MB, GB, decimal).
    Size(u64), Size, "a size such as \"100MiB\"",
    |text| {
        let (number, unit) = split(text)?;
        let factor = match unit {
            "" | "B" => 1.0,
            "KiB" => 1024.0,
            "MiB" => 1_048_576.0,
            "GiB" => 1_073_741_824.0,
            "TiB" => 1_099_511_627_776.0,
            "kB" => 1e3,
            "MB" => 1e6,
            "GB" => 1e9,
            "TB" => 1e12,
            _ => return None,
        };
        let bytes = (number * factor).round();
        (bytes < i64::MAX as f64).then_some(bytes as u64)
    },
    |bytes| {
        for (unit, size) in [("GiB", 1 << 30), ("MiB", 1 << 20), ("KiB", 1 << 10)] {
            if bytes != 0 && bytes % size == 0 {
                return format!("{}{unit}", bytes / size);
            }
        }
        format!("{bytes}B")
    }
);

text_unit!(
    /// A bit rate in bit/s. In files: `"500k"`, `"1M"`, `125000`.
    BitRate(u32), Rate, "a bit rate such as \"500k\"",
    |text| {
        let (number, unit) = split(text)?;
        let factor = match unit {
            "" => 1.0,
            "k" => 1e3,
            "M" => 1e6,
            _ => return None,
        };
        let rate = (number * factor).round();
        (rate >= 1.0 && rate <= f64::from(u32::MAX)).then_some(rate as u32)
    },
    |rate| if rate % 1_000_000 == 0 && rate != 0 { format!("{}M", rate / 1_000_000) }
           else if rate % 1_000 == 0 && rate != 0 { format!("{}k", rate / 1_000) }
           else { rate.to_string() }
);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_with_units_are_read_and_shown_again() {
        for (text, ns, shown) in [
            ("10ms", 10_000_000, "10ms"),
            ("1.5ms", 1_500_000, "1500us"),
            ("500us", 500_000, "500us"),
            ("60s", 60_000_000_000, "1min"),
            ("0", 0, "0ns"),
        ] {
            let span: Span = text.parse().unwrap();
            assert_eq!((span.ns(), span.to_string().as_str()), (ns, shown), "{text}");
        }
        assert_eq!("100MiB".parse::<Size>().unwrap().0, 104_857_600);
        assert_eq!("500k".parse::<BitRate>().unwrap().0, 500_000);
        assert_eq!("83.3k".parse::<BitRate>().unwrap().0, 83_300);
        assert_eq!("125000".parse::<BitRate>().unwrap().to_string(), "125k");
    }

    #[test]
    fn a_number_without_a_unit_is_refused_with_the_remedy() {
        let error = "10".parse::<Span>().unwrap_err().to_string();
        assert!(error.contains("\"10ms\""), "{error}");
        for bad in ["", "ms", "1e5ms", "-5ms", "10 lightyears", "1.2.3s"] {
            assert!(bad.parse::<Span>().is_err(), "{bad}");
        }
    }
}
