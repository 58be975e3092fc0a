//! The value of a literal's text.

/// Why a literal has no value.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum LiteralError {
    /// With a sentence that says what is wrong.
    Form(String),
    /// The number does not fit even the largest type.
    TooLarge,
}

fn form(text: impl Into<String>) -> LiteralError {
    LiteralError::Form(text.into())
}

/// Digits without their underscores; an underscore stands between two digits.
fn digits(text: &str) -> Result<String, LiteralError> {
    if text.is_empty() {
        return Err(form("digits are missing"));
    }
    if text.starts_with('_') || text.ends_with('_') || text.contains("__") {
        return Err(form("an underscore stands between two digits"));
    }
    Ok(text.chars().filter(|c| *c != '_').collect())
}

/// `123`, `1_000`, `16#FF`, `2#1010`, with a sign before the whole.
pub fn integer(text: &str) -> Result<i128, LiteralError> {
    let (negative, text) = match text.strip_prefix('-') {
        Some(rest) => (true, rest),
        None => (false, text.strip_prefix('+').unwrap_or(text)),
    };
    let (base, body) = match text.split_once('#') {
        None => (10, text),
        Some((base, body)) => match digits(base)?.as_str() {
            "2" => (2, body),
            "8" => (8, body),
            "10" => (10, body),
            "16" => (16, body),
            other => return Err(form(format!("base {other} is not 2, 8, 10 or 16"))),
        },
    };
    let body = digits(body)?;
    let mut value: i128 = 0;
    for c in body.chars() {
        let Some(digit) = c.to_digit(base) else {
            return Err(form(format!("`{c}` is not a digit of base {base}")));
        };
        value = value * i128::from(base) + i128::from(digit);
        if value > i128::from(u64::MAX) {
            return Err(LiteralError::TooLarge);
        }
    }
    if negative && value > -i128::from(i64::MIN) {
        return Err(LiteralError::TooLarge);
    }
    Ok(if negative { -value } else { value })
}

/// `1.5`, `1_000.0e-3` as decimal text that Rust's parser takes.
pub fn real_text(text: &str) -> Result<String, LiteralError> {
    let mantissa = text.split(['e', 'E']).next().unwrap_or("");
    for part in mantissa.trim_start_matches(['+', '-']).split('.') {
        digits(part)?;
    }
    let plain: String = text.chars().filter(|c| *c != '_').collect();
    match plain.parse::<f64>() {
        Ok(v) if v.is_finite() => Ok(plain),
        Ok(_) => Err(LiteralError::TooLarge),
        Err(_) => Err(form("this is no real number")),
    }
}

const UNITS: &[(&str, i128)] = &[
    ("d", 86_400_000_000_000),
    ("h", 3_600_000_000_000),
    ("m", 60_000_000_000),
    ("s", 1_000_000_000),
    ("ms", 1_000_000),
    ("us", 1_000),
    ("ns", 1),
];

/// What stands after `T#`: `1h2m3s4ms5us6ns`, `-1.5s`, `1d_2h`, as ns.
///
/// Units come in falling order, each once; only the last number may have a fraction.
pub fn duration(text: &str) -> Result<i64, LiteralError> {
    let (negative, mut rest) = match text.strip_prefix('-') {
        Some(rest) => (true, rest),
        None => (false, text.strip_prefix('+').unwrap_or(text)),
    };
    if rest.is_empty() {
        return Err(form("the duration is empty; write one like T#1m30s"));
    }
    let mut total: i128 = 0;
    let mut last_unit: Option<usize> = None;
    let mut fraction_seen = false;
    while !rest.is_empty() {
        let number_len =
            rest.find(|c: char| !c.is_ascii_digit() && c != '.' && c != '_').unwrap_or(rest.len());
        let number: String = rest[..number_len].chars().filter(|c| *c != '_').collect();
        let after = &rest[number_len..];
        let unit_len = after.find(|c: char| !c.is_ascii_alphabetic()).unwrap_or(after.len());
        let unit = after[..unit_len].to_ascii_lowercase();
        rest = &after[unit_len..];
        if number.is_empty() || number.starts_with('.') || number.ends_with('.') {
            return Err(form("a number with a unit is expected, like T#1m30s"));
        }
        let Some(index) = UNITS.iter().position(|(u, _)| *u == unit) else {
            return Err(form(if unit.is_empty() {
                "the unit is missing: d, h, m, s, ms, us or ns".to_owned()
            } else {
                format!("`{unit}` is no unit: d, h, m, s, ms, us or ns")
            }));
        };
        if last_unit.is_some_and(|l| index <= l) {
            return Err(form("units come in falling order, each at most once"));
        }
        if fraction_seen {
            return Err(form("only the last number may have a fraction"));
        }
        last_unit = Some(index);
        let scale = UNITS[index].1;
        let (whole, fraction) = number.split_once('.').unwrap_or((&number, ""));
        fraction_seen = number.contains('.');
        let whole: i128 = whole.parse().map_err(|_| LiteralError::TooLarge)?;
        total = whole
            .checked_mul(scale)
            .and_then(|ns| total.checked_add(ns))
            .filter(|t| *t <= i128::from(u64::MAX))
            .ok_or(LiteralError::TooLarge)?;
        if fraction_seen {
            let cut: String = fraction.chars().take(15).collect();
            let value: i128 = cut.parse().map_err(|_| form("a fraction is made of digits"))?;
            total += value * scale / 10_i128.pow(cut.len() as u32);
        }
    }
    let total = if negative { -total } else { total };
    i64::try_from(total).map_err(|_| LiteralError::TooLarge)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn integers() {
        for (text, value) in [
            ("0", 0),
            ("1_000", 1000),
            ("16#FF", 255),
            ("16#ff_FF", 65535),
            ("2#1010_1010", 170),
            ("8#17", 15),
            ("-5", -5),
            ("+5", 5),
            ("18446744073709551615", u64::MAX as i128),
            ("-9223372036854775808", i64::MIN as i128),
        ] {
            assert_eq!(integer(text), Ok(value), "{text}");
        }
        for bad in ["", "_1", "1_", "1__0", "3#1", "2#2", "16#", "16#G", "8#8"] {
            assert!(matches!(integer(bad), Err(LiteralError::Form(_))), "{bad}");
        }
        assert_eq!(integer("18446744073709551616"), Err(LiteralError::TooLarge));
        assert_eq!(integer("-9223372036854775809"), Err(LiteralError::TooLarge));
    }

    #[test]
    fn durations() {
        for (text, ns) in [
            ("1h2m3s4ms5us6ns", 3_723_004_005_006),
            ("50ms", 50_000_000),
            ("1.5s", 1_500_000_000),
            ("-5s", -5_000_000_000),
            ("1d_2h", 93_600_000_000_000),
            ("0s", 0),
            ("5000ms", 5_000_000_000),
            ("1H30M", 5_400_000_000_000),
            ("0.000001ms", 1),
        ] {
            assert_eq!(duration(text), Ok(ns), "{text}");
        }
        for bad in ["", "5", "5x", "s", "1s1m", "1s1s", "1.5m3s", "1.s", ".5s"] {
            assert!(matches!(duration(bad), Err(LiteralError::Form(_))), "{bad}");
        }
        assert_eq!(duration("300000d"), Err(LiteralError::TooLarge));
        assert_eq!(duration("99999999999999999999999999999999999999999d"), Err(LiteralError::TooLarge));
    }

    #[test]
    fn reals() {
        assert_eq!(real_text("1_000.5e-3").unwrap(), "1000.5e-3");
        assert_eq!(real_text("1.0e400"), Err(LiteralError::TooLarge));
        assert!(real_text("1._5").is_err());
    }

    proptest::proptest! {
        #[test]
        fn never_panics(text in "\\PC{0,24}") {
            let _ = integer(&text);
            let _ = duration(&text);
            let _ = real_text(&text);
        }
        #[test]
        fn durations_of_ns_come_back(ns in proptest::num::i64::ANY) {
            if ns > i64::MIN {
                proptest::prop_assert_eq!(duration(&format!("{ns}ns")), Ok(ns));
            }
        }
    }
}
