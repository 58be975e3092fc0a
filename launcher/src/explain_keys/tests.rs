//! The documentation and the types that read the keys have the same keys, the same choices, the same defaults.

use super::*;
use crate::kinds::KINDS;
use ipc_types::units::{BitRate, Size, Span};
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::{Value, json};
use std::collections::BTreeSet;

const UNKNOWN: &str = "zzz_unknown";

/// `{"a": {"b": [inner]}}` for `a.b[]`.
fn nested(path: &str, inner: Value) -> Value {
    path.rsplit('.').filter(|p| !p.is_empty()).fold(inner, |inner, part| {
        let lists = part.matches("[]").count();
        let value = (0..lists).fold(inner, |v, _| json!([v]));
        json!({ (part.trim_end_matches("[]")): value })
    })
}

/// The names that a serde message expects.
fn expected(message: &str, start: &str) -> Option<BTreeSet<String>> {
    if !message.starts_with(start) {
        return None;
    }
    Some(message.split('`').skip(1).step_by(2).skip(1).map(str::to_owned).collect())
}

fn error_of<T: DeserializeOwned>(value: &Value) -> String {
    T::deserialize(value).err().map_or_else(String::new, |e| e.to_string())
}

/// What a type says to a value.
type Ask = fn(&Value) -> String;

/// A table behind an untagged enum hides its keys from serde's message: asked for directly.
fn hidden(kind: &str, path: &str) -> Option<(usize, Ask)> {
    use ipc_types::net::IpFilter;
    let list: &[(&str, &str, Ask)] = &[
        ("can", "serve.socketcand.filter", error_of::<IpFilter>),
        ("can", "serve.slcan.filter", error_of::<IpFilter>),
        ("can", "serve.cannelloni.filter", error_of::<IpFilter>),
        ("can", "serve.socketcand", error_of::<dinrail_can::config::EndpointTable>),
        ("can", "serve.slcan", error_of::<dinrail_can::config::EndpointTable>),
        ("can", "serve.cannelloni", error_of::<dinrail_can::config::EndpointTable>),
        ("can-io", "out[].on_stop", error_of::<dinrail_can_io::config::StopValues>),
    ];
    let starts = |p: &str| path == p || path.strip_prefix(p).is_some_and(|r| r.starts_with(['.', '[']));
    list.iter().find(|(k, p, _)| *k == kind && starts(p)).map(|(_, p, ask)| (p.len(), *ask))
}

fn message(kind: &str, accepts: impl Fn(&Value) -> String, path: &str, inner: Value) -> String {
    match hidden(kind, path) {
        Some((len, ask)) => ask(&nested(path[len..].trim_start_matches('.'), inner)),
        None => accepts(&nested(path, inner)),
    }
}

fn compare(table: &str, docs: &[KeyDoc], accepts: impl Fn(&Value) -> String) {
    let mut prefixes: BTreeSet<String> = BTreeSet::from([String::new()]);
    for doc in docs {
        if let Some((parent, _)) = doc.key.rsplit_once('.') {
            prefixes.insert(parent.to_owned());
        }
        let tables = [ValueKind::Table, ValueKind::Tables];
        let has = |forms: &[ValueKind]| forms.iter().any(|f| tables.contains(f));
        let is_table =
            tables.contains(&doc.value) || matches!(doc.value, ValueKind::OneOf(forms) if has(forms));
        if is_table {
            let inner =
                docs.iter().any(|d| d.key.strip_prefix(doc.key).is_some_and(|r| r.starts_with(['.', '['])));
            assert!(inner, "{table}: table '{}' has no documented keys", doc.key);
        }
    }
    for prefix in prefixes {
        let documented: BTreeSet<String> = docs
            .iter()
            .filter(|d| d.key.rsplit_once('.').map_or("", |(p, _)| p) == prefix)
            .map(|d| d.key.rsplit('.').next().unwrap().to_owned())
            .collect();
        let said = message(table, &accepts, &prefix, json!({ UNKNOWN: 1 }));
        // A table that stands beside words (`"hold"` or `{ value = 1 }`) names both.
        let mut documented = documented;
        let read = match expected(&said, "unknown variant") {
            Some(read) => {
                if let Some(KeyDoc { value: ValueKind::OneOf(forms), .. }) =
                    docs.iter().find(|d| d.key == prefix)
                {
                    for form in *forms {
                        if let ValueKind::Choice(words) = form {
                            documented.extend(words.iter().map(|w| (*w).to_owned()));
                        }
                    }
                }
                read
            }
            None => expected(&said, "unknown field").unwrap_or_else(|| {
                panic!("{table}, keys of '{prefix}': expected an unknown field, got '{said}'")
            }),
        };
        assert_eq!(documented, read, "{table}: keys of '{prefix}'");
    }
    for doc in docs {
        let (values, lists) = match doc.value {
            ValueKind::Choice(values) => (values, 0),
            ValueKind::List(ValueKind::Choice(values)) => (*values, 1),
            _ => continue,
        };
        let value = if lists == 1 { json!([UNKNOWN]) } else { json!(UNKNOWN) };
        let said = message(table, &accepts, doc.key, value);
        let read = expected(&said, "unknown variant")
            .unwrap_or_else(|| panic!("{table}, values of '{}': got '{said}'", doc.key));
        let documented: BTreeSet<String> = values.iter().map(|v| (*v).to_owned()).collect();
        // serde lists aliases as well; ours are short forms such as "coil" of "coils".
        let alias = |v: &String| documented.iter().any(|d| d.starts_with(v.as_str()));
        assert!(
            documented.is_subset(&read) && read.iter().all(alias),
            "{table}: values of '{}': documented {documented:?}, read {read:?}",
            doc.key
        );
    }
}

#[test]
fn every_key_and_choice_is_documented() {
    for kind in KINDS {
        compare(kind.name, kind.config_doc, |value| {
            (kind.accepts)(value).err().map_or_else(String::new, |e| e.to_string())
        });
    }
}

#[test]
fn the_launchers_keys_are_documented() {
    use crate::stackfile::probe;
    compare("stack", STACK_DOCS, probe::stack);
    let own: Vec<KeyDoc> =
        SERVICE_DOCS.iter().filter(|d| !["name", "kind", "exec"].contains(&d.key)).copied().collect();
    compare("service", &own, probe::service);
    let documented: BTreeSet<&str> =
        SERVICE_DOCS.iter().map(|d| d.key).filter(|k| !k.contains('.')).collect();
    assert_eq!(documented, probe::SERVICE_KEYS.into_iter().collect());
}

#[test]
fn keys_are_listed_once_and_explained() {
    for kind in KINDS {
        let mut seen = BTreeSet::new();
        assert!(!kind.about.is_empty());
        for doc in kind.config_doc.iter().chain(SERVICE_DOCS) {
            assert!(seen.insert(doc.key), "{}: key '{}' is documented twice", kind.name, doc.key);
            assert!(doc.meaning.ends_with('.'), "{}: '{}'", kind.name, doc.key);
        }
    }
}

/// Whether two values mean the same: equal, or the same amount in other units.
fn same(a: &Value, b: &Value) -> bool {
    if let (Some(a), Some(b)) = (a.as_f64(), b.as_f64()) {
        return a == b;
    }
    if let (Some(a), Some(b)) = (a.as_str(), b.as_str()) {
        let spans = a.parse::<Span>().is_ok() && a.parse::<Span>() == b.parse::<Span>();
        let sizes = a.parse::<Size>().is_ok() && a.parse::<Size>() == b.parse::<Size>();
        let rates = a.parse::<BitRate>().is_ok() && a.parse::<BitRate>() == b.parse::<BitRate>();
        return a == b || spans || sizes || rates;
    }
    a == b
}

/// Reads the smallest table that is right and compares what it means with the documented defaults.
fn defaults<C: DeserializeOwned + Serialize>(docs: &[KeyDoc], smallest: Value) {
    let config: C = serde_json::from_value(smallest.clone()).unwrap();
    let read = serde_json::to_value(&config).unwrap();
    for doc in docs {
        let pointer = format!("/{}", doc.key.replace("[]", "/0").replace('.', "/"));
        let given = smallest.pointer(&pointer).is_some();
        // An absent optional table or list element has no inner defaults.
        let Some(value) = read.pointer(&pointer) else { continue };
        match doc.default {
            Default::Required => assert!(given, "'{}' is documented as required", doc.key),
            _ if given => {}
            Default::Absent(_) => assert_eq!(value, &Value::Null, "'{}' is documented as absent", doc.key),
            Default::Is(text) => {
                if matches!(doc.value, ValueKind::Table) {
                    continue;
                }
                let toml = format!("v = {text}").parse::<toml_edit::DocumentMut>().unwrap();
                let shown: Value = toml_edit::de::from_document::<serde_json::Map<String, Value>>(toml)
                    .unwrap()["v"]
                    .clone();
                assert!(same(&shown, value), "'{}': documented {shown}, is {value}", doc.key);
            }
        }
    }
}

#[test]
fn the_documented_defaults_are_those_of_the_types() {
    defaults::<dinrail_can::Config>(CAN, json!({ "backend": "virtual", "feed": { "file": "x" } }));
    defaults::<dinrail_can_io::Config>(
        CAN_IO,
        json!({ "in": [{ "id": 1, "start": 0, "len": 8, "to": "%IB0" }],
                "out": [{ "id": 2, "dlc": 8, "mode": "on_change", "signals": [{ "start": 0, "len": 8, "from": "%QB0" }] }] }),
    );
    defaults::<dinrail_plc::Config>(PLC, json!({ "route": [{ "from": "%IW0", "to": "%QW0" }] }));
    defaults::<dinrail_modbus::Config>(
        MODBUS_SERVER,
        json!({ "tcp": { "filter": { "mask": "255.0.0.0", "start": "10.0.0.1", "end": "10.0.0.2" } },
                "identity": { "server_text": "x", "revision": "1" },
                "watchdog_values": [{ "to": "%MW0", "value": 0 }] }),
    );
    defaults::<dinrail_modbus::client::Config>(
        MODBUS_CLIENT,
        json!({ "unit": [{ "id": 1 }], "read": [{ "unit": 1, "table": "coils", "at": 0, "to": "%IX0.0" }],
                "write": [{ "unit": 1, "table": "coils", "at": 0, "from": "%QX0.0" }] }),
    );
    defaults::<dinrail_modbus::gateway::Config>(
        MODBUS_GATEWAY,
        json!({ "port": [{ "serial": "com1" }], "units": [{ "tcp": 1 }],
                "cache": [{ "unit": 1, "table": "coils", "at": 0, "count": 1 }] }),
    );
    defaults::<dinrail_serial::Config>(SERIAL, json!({ "device": "/dev/ttyS0" }));
    defaults::<dinrail_recorder::Config>(RECORDER, json!({}));
    defaults::<dinrail_recorder::replay::Config>(REPLAY, json!({ "file": "x" }));
}

#[test]
fn paths_are_generalised() {
    assert_eq!(general("in[2].to"), "in[].to");
    assert_eq!(general("map[12]"), "map");
    assert_eq!(general("tcp.port"), "tcp.port");
    assert_eq!(find_key(MODBUS_SERVER, "map[3].area").unwrap().key, "map[].area");
}
