//! What others read of a plc service's table of the stack file: how its %-addresses count, how large its image is,
//! how old that image may get. The one place where these keys and their defaults are known outside the plc service.

use crate::stack::{Finding, ServiceEntry};
use crate::units::{Size, Span};
use crate::wiring::AreaSizes;
use serde::de::DeserializeOwned;
use serde_json::Value;

/// The longest pause between two images of a healthy plc, whatever its cycle: it repeats the last one.
const REPEAT_MS: u64 = 100;
/// A `stale_after` below this mistakes a delay by the system for a dead plc.
const SHORT_MS: u64 = 50;

fn value<T: DeserializeOwned>(table: &Value, key: &str) -> Option<T> {
    table.get(key).and_then(|value| T::deserialize(value).ok())
}

/// Key `addressing`: `element` (default), `byte` or `openplc`.
pub fn addressing(table: &Value) -> &str {
    table.get("addressing").and_then(Value::as_str).unwrap_or("element")
}

/// Keys `input_bytes`, `output_bytes`, `marker_bytes`. One that is not a size counts as the default.
pub fn areas(table: &Value) -> AreaSizes {
    let size =
        |key, default: u32| value::<Size>(table, key).map_or(default, |size| size.0.min(65_536) as u32);
    let default = AreaSizes::default();
    AreaSizes {
        input: size("input_bytes", default.input),
        output: size("output_bytes", default.output),
        marker: size("marker_bytes", default.marker),
    }
}

/// The shortest `stale_after` that a healthy plc never reaches: three times the longest time between two scans, and
/// never more than twice the 100 ms after which every plc repeats its image.
pub fn shortest_stale_after(table: &Value) -> Span {
    let span = |key, default_ms| value::<Span>(table, key).unwrap_or(Span::from_ms(default_ms));
    let on_news = table.get("trigger").is_some_and(|trigger| trigger == "inputs" || trigger.is_object());
    let period = if on_news { span("max_interval", 100) } else { span("cycle", 10) };
    Span(period.ns().saturating_mul(3)).min(Span::from_ms(2 * REPEAT_MS))
}

/// What is wrong with the key `stale_after` of a service that reads the image of this plc.
pub fn check_stale_after(service: &str, stale_after: Span, plc: &ServiceEntry) -> Option<Finding> {
    let shortest = shortest_stale_after(&plc.config);
    if stale_after < shortest {
        return Some(Finding::error(
            service,
            "stale_after",
            format!(
                "stale_after = {stale_after} is shorter than 3 times the longest time between two scans of '{}'",
                plc.name
            ),
            format!("leave it out (200ms) or set at least \"{shortest}\""),
        ));
    }
    (stale_after < Span::from_ms(SHORT_MS)).then(|| {
        Finding::warning(
            service,
            "stale_after",
            format!("stale_after = {stale_after} is short: a plc process delayed by the system looks dead"),
            "200ms is the default",
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::stack::Severity;
    use crate::wiring::Wiring;
    use serde_json::json;

    #[test]
    fn keys_and_their_defaults() {
        assert_eq!(addressing(&json!({})), "element");
        assert_eq!(addressing(&json!({ "addressing": "byte" })), "byte");
        assert_eq!(areas(&json!({})), AreaSizes::default());
        let table = json!({ "input_bytes": 64, "output_bytes": "8KiB", "marker_bytes": "1GiB" });
        assert_eq!(areas(&table), AreaSizes { input: 64, output: 8192, marker: 65_536 });
        assert_eq!(areas(&json!({ "input_bytes": "much" })), AreaSizes::default());
    }

    #[test]
    fn images_may_be_three_scans_old() {
        for (table, shortest) in [
            (json!({}), "30ms"),
            (json!({ "cycle": "1ms" }), "3ms"),
            (json!({ "cycle": "1s" }), "200ms"),
            (json!({ "cycle": "1ms", "max_interval": "20ms" }), "3ms"),
            (json!({ "trigger": "inputs" }), "200ms"),
            (json!({ "trigger": "inputs", "max_interval": "20ms" }), "60ms"),
            (json!({ "trigger": { "service": "io", "event": "sync" } }), "200ms"),
            (json!({ "trigger": { "service": "io", "event": "sync" }, "max_interval": "20ms" }), "60ms"),
        ] {
            assert_eq!(shortest_stale_after(&table).to_string(), shortest, "{table}");
        }
    }

    #[test]
    fn a_short_limit_is_found() {
        let plc = ServiceEntry {
            name: "plc".into(),
            kind: "plc".into(),
            index: 1,
            config: json!({ "cycle": "10ms" }),
            wiring: Wiring::default(),
        };
        let found = |ms| check_stale_after("io", Span::from_ms(ms), &plc).map(|f| (f.severity, f.message));
        assert_eq!(found(200), None);
        assert_eq!(found(50), None);
        let (severity, message) = found(40).unwrap();
        assert_eq!(severity, Severity::Warning);
        assert_eq!(message, "stale_after = 40ms is short: a plc process delayed by the system looks dead");
        let (severity, message) = found(29).unwrap();
        assert_eq!(severity, Severity::Error);
        assert_eq!(
            message,
            "stale_after = 29ms is shorter than 3 times the longest time between two scans of 'plc'"
        );
    }
}
