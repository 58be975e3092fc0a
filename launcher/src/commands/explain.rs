//! `dinrail explain KEY` and `dinrail schema`: what the keys of a stack file mean, for people and for editors.

use super::print;
use crate::explain_keys::{Default, KeyDoc, SERVICE_DOCS, STACK_DOCS, ValueKind, general};
use crate::kinds::KINDS;
use crate::stackfile::{nearest, suggestion};
use serde_json::{Map, Value, json};

/// Word before keys that every service has.
const COMMON: &str = "service";

/// Tables of keys with the word that stands before them: `stack`, `service`, and one a kind.
fn tables() -> Vec<(&'static str, &'static [KeyDoc])> {
    let mut list = vec![("stack", STACK_DOCS), (COMMON, SERVICE_DOCS)];
    list.extend(KINDS.iter().map(|k| (k.name, k.config_doc)));
    list
}

/// Prints what is known about a key: `restart`, `stale_after`, `modbus-server.tcp.port`, `can`; without one, the
/// kinds. An unknown key is an error that names the nearest.
pub fn run(key: Option<&str>, as_json: bool) -> anyhow::Result<()> {
    let Some(key) = key else {
        print(&overview());
        return Ok(());
    };
    let found = lookup(key);
    if found.is_empty() {
        anyhow::bail!("{}", unknown(key));
    }
    if as_json {
        let list: Vec<Value> = found.iter().map(|(table, doc)| doc_json(table, doc)).collect();
        print(&format!("{:#}\n", Value::from(list)));
    } else {
        print(&found.iter().map(|(table, doc)| entry(table, doc)).collect::<Vec<_>>().join("\n"));
    }
    Ok(())
}

fn overview() -> String {
    let mut text = "tables of a stack file; `dinrail explain WORD` lists its keys\n".to_owned();
    text += &format!("  {:<16} the stack as a whole: [stack]\n", "stack");
    text += &format!("  {:<16} keys that every [[service]] has\n", COMMON);
    for kind in KINDS {
        text += &format!("  {:<16} {}\n", kind.name, kind.about);
    }
    text
}

/// The keys meant: a whole table, a key of a named table, or a key of any table by its path or last part.
fn lookup(asked: &str) -> Vec<(&'static str, &'static KeyDoc)> {
    let asked = plain(&general(asked.trim()));
    let tables = tables();
    let all = |docs: &'static [KeyDoc]| docs.iter().collect::<Vec<_>>();
    if let Some((table, docs)) = tables.iter().find(|(t, _)| *t == asked) {
        return all(docs).into_iter().map(|d| (*table, d)).collect();
    }
    if let Some((word, rest)) = asked.split_once('.')
        && let Some((table, docs)) = tables.iter().find(|(t, _)| *t == word)
    {
        // Every service has the launcher's keys as well.
        let common = SERVICE_DOCS.iter().filter(|_| *table != "stack" && *table != COMMON);
        return with_inner(rest, docs.iter().map(|d| (*table, d)).chain(common.map(|d| (COMMON, d))));
    }
    let every = || tables.iter().flat_map(|(t, docs)| docs.iter().map(|d| (*t, d)));
    let exact = with_inner(&asked, every());
    if !exact.is_empty() {
        return exact;
    }
    every().filter(|(_, d)| last_part(d.key) == asked).collect()
}

/// A key without the marks of lists, which some shells expand: `in[].to` is asked for as `in.to`.
fn plain(key: &str) -> String {
    key.replace("[]", "")
}

/// A key and, for a table, the keys in it.
fn with_inner(
    key: &str,
    docs: impl Iterator<Item = (&'static str, &'static KeyDoc)>,
) -> Vec<(&'static str, &'static KeyDoc)> {
    let inner =
        |doc: &KeyDoc| plain(doc.key).strip_prefix(key).is_some_and(|r| r.is_empty() || r.starts_with('.'));
    docs.filter(|(_, d)| inner(d)).collect()
}

fn last_part(key: &str) -> &str {
    key.rsplit('.').next().unwrap_or(key)
}

fn entry(table: &str, doc: &KeyDoc) -> String {
    let word = if table == COMMON { String::new() } else { format!("{table}.") };
    format!(
        "{word}{}\n    {}\n    takes: {}\n    {}\n",
        doc.key,
        doc.meaning,
        doc.value.words(),
        doc.default_words()
    )
}

fn doc_json(table: &str, doc: &KeyDoc) -> Value {
    json!({
        "table": table,
        "key": doc.key,
        "meaning": doc.meaning,
        "takes": doc.value.words(),
        "required": doc.default == Default::Required,
        "default": match doc.default { Default::Is(value) => Value::from(value), _ => Value::Null },
    })
}

fn unknown(asked: &str) -> String {
    let tables = tables();
    let mut keys: Vec<&str> = tables.iter().flat_map(|(_, docs)| docs.iter().map(|d| d.key)).collect();
    let words: Vec<&str> = tables.iter().map(|(t, _)| *t).collect();
    if let Some((word, key)) = asked.split_once('.')
        && let Some((table, docs)) = tables.iter().find(|(t, _)| *t == word)
    {
        let keys = docs.iter().map(|d| d.key);
        return format!("{table} has no key '{key}'; {}", suggestion(key, "keys", keys).replace('\n', " "));
    }
    keys.extend(&words);
    keys.extend(
        tables.iter().flat_map(|(_, docs)| docs.iter().map(|d| last_part(d.key))).collect::<Vec<_>>(),
    );
    let near = nearest(asked, keys).map(|n| format!("did you mean '{n}'? ")).unwrap_or_default();
    format!(
        "no key is called '{asked}'; {near}`dinrail explain WORD` lists keys, WORD being {}",
        words.join(", ")
    )
}

/// JSON Schema (draft 7) of stack files, for editors: taplo reads it from `#:schema PATH` in the first line.
pub fn schema() -> Value {
    let services: Vec<Value> = KINDS
        .iter()
        .map(|kind| {
            let mut docs: Vec<&KeyDoc> = SERVICE_DOCS.iter().filter(|d| d.key != "exec").collect();
            docs.extend(kind.config_doc);
            let mut object = object(&docs, "");
            object["title"] = kind.name.into();
            object["properties"]["kind"] = json!({ "const": kind.name, "description": kind.about });
            object
        })
        .collect();
    json!({
        "$schema": "http://json-schema.org/draft-07/schema#",
        "title": "dinrail stack file",
        "type": "object",
        "additionalProperties": false,
        "required": ["stack", "service"],
        "properties": {
            "stack": object(&STACK_DOCS.iter().collect::<Vec<_>>(), ""),
            "service": { "type": "array", "minItems": 1, "items": { "oneOf": services } },
        },
    })
}

/// The object whose keys begin with `prefix`.
fn object(docs: &[&KeyDoc], prefix: &str) -> Value {
    let mut properties = Map::new();
    let mut required = Vec::new();
    for doc in docs {
        let Some(name) = doc.key.strip_prefix(prefix).filter(|n| !n.contains(['.', '['])) else { continue };
        let mut value = value_schema(&doc.value, docs, doc.key);
        value["description"] = doc.meaning.into();
        if doc.default == Default::Required {
            required.push(name);
        }
        properties.insert(name.to_owned(), value);
    }
    let mut object = json!({ "type": "object", "additionalProperties": false, "properties": properties });
    if !required.is_empty() {
        object["required"] = required.into();
    }
    object
}

fn value_schema(value: &ValueKind, docs: &[&KeyDoc], key: &str) -> Value {
    match value {
        ValueKind::Bool => json!({ "type": "boolean" }),
        ValueKind::Int(low, high) => json!({ "type": "integer", "minimum": low, "maximum": high }),
        ValueKind::Number => json!({ "type": "number" }),
        ValueKind::Text | ValueKind::Service(_) | ValueKind::File => json!({ "type": "string" }),
        ValueKind::Duration => {
            json!({ "anyOf": [{ "const": 0 },
                    { "type": "string", "pattern": r"^\s*(0|[0-9.]+\s*(ns|us|µs|ms|s|min|h|d))\s*$" }] })
        }
        ValueKind::Size => json!({ "anyOf": [{ "type": "integer", "minimum": 0 },
                    { "type": "string", "pattern": r"^\s*[0-9.]+\s*(B|[kMGT]B|[KMGT]iB)?\s*$" }] }),
        ValueKind::BitRate => json!({ "anyOf": [{ "type": "integer", "minimum": 1 },
                    { "type": "string", "pattern": r"^\s*[0-9.]+\s*[kM]?\s*$" }] }),
        ValueKind::Address => json!({ "type": "string", "pattern": "^%" }),
        ValueKind::Socket => json!({ "type": "string", "pattern": ":[0-9]+$" }),
        ValueKind::Ip => json!({ "type": "string" }),
        ValueKind::Choice(values) => json!({ "enum": values }),
        ValueKind::List(inner) => json!({ "type": "array", "items": value_schema(inner, docs, key) }),
        ValueKind::OneOf(forms) => {
            json!({ "anyOf": forms.iter().map(|f| value_schema(f, docs, key)).collect::<Vec<_>>() })
        }
        ValueKind::Table => object(docs, &format!("{key}.")),
        ValueKind::Tables => json!({ "type": "array", "items": object(docs, &format!("{key}[].")) }),
        ValueKind::Texts => json!({ "type": "object", "additionalProperties": { "type": "string" } }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn found(key: &str) -> Vec<String> {
        lookup(key).iter().map(|(table, doc)| format!("{table}.{}", doc.key)).collect()
    }

    #[test]
    fn keys_are_found_by_path_by_table_and_by_their_last_part() {
        // Several kinds have it, with their own default each.
        let stale = found("stale_after");
        assert!(stale.contains(&"can-io.stale_after".to_owned()), "{stale:?}");
        assert!(stale.contains(&"modbus-server.stale_after".to_owned()), "{stale:?}");
        assert_eq!(found("modbus-server.tcp.port"), ["modbus-server.tcp.port"]);
        // Nothing has it as a whole name: every table's last part counts.
        assert!(found("on_exhausted").contains(&"service.restart.on_exhausted".to_owned()));
        assert_eq!(found("can-io.in[3].to"), ["can-io.in[].to"]);
        assert_eq!(found("can-io.out.signals.from"), ["can-io.out[].signals[].from"]);
        assert!(found("can-io.in").contains(&"can-io.in[].to".to_owned()));
        assert_eq!(found("can.critical"), ["service.critical"]);
        assert_eq!(found("stack").len(), STACK_DOCS.len());
        assert!(found("restart").contains(&"service.restart.on_exhausted".to_owned()));
        assert!(found("stack.critical").is_empty() && found("").is_empty() && found("nonsense").is_empty());
    }

    #[test]
    fn an_unknown_key_names_the_nearest() {
        assert!(unknown("stale_aftr").contains("did you mean 'stale_after'?"));
        assert!(unknown("can.bitrat").contains("can has no key 'bitrat'; did you mean 'bitrate'?"));
    }

    /// Every path of the schema, as keys are documented.
    fn paths(schema: &Value, prefix: &str, out: &mut Vec<String>) {
        for form in schema["anyOf"].as_array().into_iter().flatten() {
            paths(form, prefix, out);
        }
        if schema["type"] == "array" {
            paths(&schema["items"], &format!("{prefix}[]"), out);
        }
        for (name, inner) in schema["properties"].as_object().into_iter().flatten() {
            let path = if prefix.is_empty() { name.clone() } else { format!("{prefix}.{name}") };
            paths(inner, &path, out);
            out.push(path);
        }
    }

    #[test]
    fn the_schema_has_every_documented_key() {
        let schema = schema();
        let services = schema["properties"]["service"]["items"]["oneOf"].as_array().unwrap();
        assert_eq!(services.len(), KINDS.len());
        for (kind, service) in KINDS.iter().zip(services) {
            let mut there = Vec::new();
            paths(service, "", &mut there);
            let mut documented: Vec<String> = SERVICE_DOCS
                .iter()
                .chain(kind.config_doc)
                .map(|d| d.key.to_owned())
                .filter(|k| k != "exec")
                .collect();
            there.sort();
            documented.sort();
            assert_eq!(there, documented, "{}", kind.name);
            assert_eq!(service["properties"]["kind"]["const"], kind.name);
        }
    }
}
