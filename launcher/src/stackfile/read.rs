//! From a table of the document to a typed value, with serde's messages turned into sentences for people.

use super::keypath;
use super::nearest::{nearest, suggestion};
use super::place::Sink;
use crate::explain_keys::{KeyDoc, find_key};
use crate::kinds::Kind;
use std::ops::Range;
use toml_edit::de::Error;
use toml_edit::{Item, Table, Value};

/// Unknown keys that are reported of one table before giving up.
const UNKNOWN_MAX: usize = 16;

/// What a table is, for messages.
pub struct Scope<'a> {
    /// `service 'can0' (can)`.
    pub what: &'a str,
    /// Word before the key in `dinrail explain WORD.KEY`; empty for keys without one.
    pub explain: &'a str,
    /// Documentation of its keys.
    pub keys: &'a [KeyDoc],
    /// Keys beyond those of the type that are right at the top of the table.
    pub more_keys: &'a [&'a str],
    /// Kinds whose key this may be, written below the wrong service.
    pub kinds: &'static [Kind],
    /// Where to point when the key itself is not known: the header.
    pub place: Range<usize>,
}

/// Reads a table; every mistake that is found goes to the sink.
pub fn read<T>(
    mut table: Table,
    scope: &Scope<'_>,
    sink: &mut Sink<'_>,
    parse: impl Fn(Table) -> Result<T, Error>,
) -> Option<T> {
    let mut misspelt: Vec<String> = Vec::new();
    for tries in 0.. {
        let error = match parse(table.clone()) {
            Ok(value) => return (tries == 0).then_some(value),
            Err(error) => error,
        };
        let span = error.span().filter(|s| !s.is_empty());
        // A key that is only misspelt is not missing as well.
        let names = quoted(error.message());
        if error.message().starts_with("missing field")
            && names.first().is_some_and(|n| misspelt.iter().any(|m| m == n))
        {
            return None;
        }
        if let Some((name, keys)) = names.split_first() {
            misspelt.extend(nearest(name, keys.iter().copied()).map(str::to_owned));
        }
        report(&error, &table, scope, sink);
        let unknown = error.message().starts_with("unknown field");
        let span = span.filter(|_| unknown && tries < UNKNOWN_MAX)?;
        if !keypath::remove_key_at(&mut table, &span) {
            return None;
        }
    }
    None
}

/// One serde error as a finding.
fn report(error: &Error, table: &Table, scope: &Scope<'_>, sink: &mut Sink<'_>) {
    let message = error.message();
    let span = error.span().filter(|s| !s.is_empty());
    let path = span.as_ref().map(|s| keypath::path_at(table, s)).unwrap_or_default();
    let span = span.unwrap_or_else(|| scope.place.clone());
    let what = scope.what;
    let quoted = quoted(message);
    if message.starts_with("unknown field") {
        let name = quoted.first().copied().unwrap_or("");
        let parent = path.rsplit_once('.').map_or("", |(parent, _)| parent);
        let mut keys: Vec<&str> = quoted.iter().skip(1).copied().collect();
        if parent.is_empty() {
            // `exec` is known only to be refused: nobody is to be led to it.
            keys.extend(scope.more_keys.iter().filter(|key| **key != "exec"));
        }
        let place = if parent.is_empty() { what.to_owned() } else { format!("{what}, table '{parent}'") };
        let help = suggestion(name, "keys here", keys.iter().copied());
        let strayed = if parent.is_empty() { strayed(name, table, scope.kinds) } else { None };
        sink.error(&span, format!("unknown key '{name}' in {place}"), strayed.unwrap_or(help));
        return;
    }
    if message.starts_with("missing field") {
        let name = quoted.first().copied().unwrap_or("");
        // The error's place is the table that lacks the key.
        let place = if path.is_empty() { what.to_owned() } else { format!("{what}, table '{path}'") };
        let full = if path.is_empty() { name.to_owned() } else { format!("{path}.{name}") };
        sink.error(&span, format!("{place} lacks the key '{name}'"), key_help(&full, scope));
        return;
    }
    let key = if path.is_empty() { what.to_owned() } else { format!("key '{path}' of {what}") };
    if message.starts_with("unknown variant") {
        let name = quoted.first().copied().unwrap_or("");
        sink.error(
            &span,
            format!("{key}: '{name}' is none of its values"),
            suggestion(name, "values", quoted.iter().skip(1).copied()),
        );
        return;
    }
    let help = key_help(&path, scope);
    let sentence = match message.split_once(", expected ") {
        Some((found, wanted)) if found.starts_with("invalid") => {
            let found = found.split_once(": ").map_or(found, |(_, f)| f).replace('`', "");
            let wanted = match wanted_text(wanted) {
                // The type's range only contradicts the key's own.
                number if number.starts_with("a whole number") && help.contains("Takes ") => {
                    "a whole number".to_owned()
                }
                other => other,
            };
            format!("{key}: expected {wanted}, found {found}")
        }
        _ if message.starts_with("invalid socket address") => {
            format!("{key}: {}", address_fault(sink.source.text.get(span.clone()).unwrap_or_default()))
        }
        // An untagged form says only what it takes.
        _ if message.starts_with("an ") || message.starts_with("a ") || message.starts_with('"') => {
            format!("{key}: expected {}", message.trim_end())
        }
        _ => format!("{key}: {}", message.trim_end()),
    };
    sink.error(&span, sentence, help);
}

/// What a text lacks to be an address and a port.
fn address_fault(quoted: &str) -> String {
    let text = quoted.trim_matches(['"', '\'']);
    match text.rsplit_once(':') {
        Some((host, port))
            if port.parse::<u16>().is_ok() && host.contains(|c: char| c.is_ascii_alphabetic()) =>
        {
            format!("'{host}' is no IP address; names of hosts are not supported, write the number")
        }
        _ if text.parse::<std::net::IpAddr>().is_ok() => {
            let host = if text.contains(':') { format!("[{text}]") } else { text.to_owned() };
            format!("the port is missing: write \"{host}:PORT\"")
        }
        _ => "expected an address and a port, as \"192.168.0.10:502\"".to_owned(),
    }
}

/// Help for a table that other kinds have: in TOML it belongs to the last `[[service]]` before it.
fn strayed(name: &str, table: &Table, kinds: &[Kind]) -> Option<String> {
    let brackets = match table.get(name)? {
        Item::ArrayOfTables(_) => ["[[", "]]"],
        Item::Table(_) => ["[", "]"],
        _ => return None,
    };
    let top = |key: &'static str| key.split(['.', '[']).next() == Some(name);
    let owners: Vec<&str> =
        kinds.iter().filter(|k| k.config_doc.iter().any(|doc| top(doc.key))).map(|k| k.name).collect();
    let [open, close] = brackets;
    (!owners.is_empty()).then(|| {
        format!(
            "{open}service.{name}{close} is a table of {} and belongs to the last [[service]] before it: move it up, \
             before the next [[service]]",
            owners.join(", ")
        )
    })
}

/// What `explain` says about a key, in one line.
fn key_help(path: &str, scope: &Scope<'_>) -> String {
    let Some(doc) = find_key(scope.keys, path) else { return String::new() };
    let dot = if scope.explain.is_empty() { "" } else { "." };
    // Without the marks of lists, which some shells would expand.
    let asked = doc.key.replace("[]", "");
    format!("{}: {}\n`dinrail explain {}{dot}{asked}` says more", doc.key, doc.one_line(), scope.explain)
}

/// The words between back-ticks of a serde message.
fn quoted(message: &str) -> Vec<&str> {
    message.split('`').skip(1).step_by(2).collect()
}

/// serde's names of types in plain words.
fn wanted_text(wanted: &str) -> String {
    match wanted {
        "u8" => "a whole number from 0 to 255",
        "u16" => "a whole number from 0 to 65535",
        "u32" => "a whole number from 0 to 4294967295",
        "u64" | "usize" => "a whole number from 0 up",
        "i8" => "a whole number from -128 to 127",
        "i16" => "a whole number from -32768 to 32767",
        "i32" | "i64" => "a whole number",
        "f32" | "f64" => "a number",
        "a string" => "a text in quotes",
        "a boolean" => "true or false",
        "a sequence" => "a list in square brackets",
        "a map" => "a table",
        other if other.starts_with("struct ") => "a table",
        other => return other.replace('`', ""),
    }
    .to_owned()
}

/// The table as JSON, as it stands in the resolved stack. The error names the value that JSON lacks.
pub fn to_json(table: &Table) -> Result<serde_json::Value, (Range<usize>, &'static str)> {
    let mut map = serde_json::Map::new();
    for (name, item) in table {
        if let Some(value) = item_json(item)? {
            map.insert(name.to_owned(), value);
        }
    }
    Ok(map.into())
}

type Json = Result<serde_json::Value, (Range<usize>, &'static str)>;

fn item_json(item: &Item) -> Result<Option<serde_json::Value>, (Range<usize>, &'static str)> {
    Ok(Some(match item {
        Item::None => return Ok(None),
        Item::Value(value) => value_json(value)?,
        Item::Table(table) => to_json(table)?,
        Item::ArrayOfTables(tables) => tables.iter().map(to_json).collect::<Result<Vec<_>, _>>()?.into(),
    }))
}

fn value_json(value: &Value) -> Json {
    Ok(match value {
        Value::String(text) => text.value().clone().into(),
        Value::Integer(number) => (*number.value()).into(),
        Value::Float(number) => serde_json::Number::from_f64(*number.value())
            .ok_or_else(|| (value.span().unwrap_or_default(), "inf and nan are no values of a stack file"))?
            .into(),
        Value::Boolean(on) => (*on.value()).into(),
        Value::Datetime(_) => {
            return Err((value.span().unwrap_or_default(), "dates are no values of a stack file"));
        }
        Value::Array(array) => array.iter().map(value_json).collect::<Result<Vec<_>, _>>()?.into(),
        Value::InlineTable(table) => {
            let mut map = serde_json::Map::new();
            for (name, inner) in table {
                map.insert(name.to_owned(), value_json(inner)?);
            }
            map.into()
        }
    })
}
