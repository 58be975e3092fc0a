//! From text to typed tables: `[stack]`, and each `[[service]]` split into the launcher's keys and its own.

use super::keypath;
use super::launch::{LaunchOptions, LaunchTable, SERVICE_KEYS, StackSettings, StackTable};
use super::nearest::suggestion;
use super::place::Sink;
use super::read::{Scope, read as read_table, to_json};
use crate::explain_keys::{SERVICE_DOCS, STACK_DOCS};
use crate::kinds::{Kind, NOT_YET, ServiceConfig};
use std::ops::Range;
use toml_edit::{Document as Toml, DocumentMut, Item, Table};

/// Most services of a stack: a topic has room for 64 processes, launcher, command line and restarts included.
pub const SERVICES_MAX: usize = 48;
/// Longest name of a stack or service.
const NAME_MAX: usize = 32;
/// Names that mean something else on the rail.
const RESERVED: [&str; 3] = ["stack", "inbox", "launcher"];

/// One `[[service]]`.
pub struct Service {
    pub name: String,
    pub kind: &'static Kind,
    /// The header `[[service]]`.
    pub header: Range<usize>,
    /// Its table without the launcher's keys, for places of keys.
    pub table: Table,
    pub json: serde_json::Value,
    pub config: Box<dyn ServiceConfig>,
    pub launch: LaunchOptions,
}

impl Service {
    /// Where a key of the service's own table stands; the header when it is not there.
    pub fn place(&self, key: &str) -> Range<usize> {
        keypath::span_of(&self.table, key).unwrap_or_else(|| self.header.clone())
    }
}

/// The whole file.
pub struct Document {
    pub name: String,
    pub settings: StackSettings,
    pub services: Vec<Service>,
}

impl Document {
    pub fn service(&self, name: &str) -> Option<&Service> {
        self.services.iter().find(|s| s.name == name)
    }

    /// Where a key of a service stands.
    pub fn place(&self, service: &str, key: &str) -> Range<usize> {
        self.service(service).map(|s| s.place(key)).unwrap_or_default()
    }
}

/// Reads the text; `None` when there is no stack to speak of. Mistakes go to the sink.
pub fn read(text: &str, kinds: &'static [Kind], sink: &mut Sink<'_>) -> Option<Document> {
    let toml = match Toml::parse(text) {
        Ok(toml) => toml,
        Err(error) => {
            let span = error.span().unwrap_or(text.len()..text.len());
            if let Some((span, message, help)) = common_slip(text, &span) {
                sink.error(&span, message, help);
                return None;
            }
            let mut lines = error.message().lines().map(str::trim).filter(|l| !l.is_empty());
            let first = lines.next().unwrap_or("the text cannot be read");
            let rest: Vec<&str> = lines.collect();
            let help = if sink.source.file.extension().is_some_and(|e| e != "toml") {
                "a stack file is asked for (stack.toml), or its folder; it names the program".to_owned()
            } else if rest.is_empty() {
                "stack files are TOML: https://toml.io".to_owned()
            } else {
                rest.join("\n")
            };
            sink.error(&span, format!("no TOML: {first}"), help);
            return None;
        }
    };
    let root = toml.as_table();
    for (name, _) in root {
        if name != "stack" && name != "service" {
            let span = root.key(name).and_then(|k| k.span()).unwrap_or_default();
            sink.error(
                &span,
                format!("unknown table '{name}'"),
                suggestion(name, "tables of a stack file", ["stack", "service"]),
            );
        }
    }
    let stack = read_stack(root, sink);
    let services = read_services(root, stack.as_ref(), kinds, sink);
    let (name, table) = stack?;
    Some(Document { name, settings: table.settings(), services })
}

/// Slips of people who see TOML for the first time: place, what is wrong, what to write.
fn common_slip(text: &str, span: &Range<usize>) -> Option<(Range<usize>, String, String)> {
    // One bracket makes a table that can be there only once: the parser complains about the next one.
    let mut at = 0;
    for line in text.split_inclusive('\n') {
        let header: String =
            line.split('#').next().unwrap_or_default().chars().filter(|c| !c.is_whitespace()).collect();
        if header == "[service]" {
            let start = at + line.len() - line.trim_start().len();
            return Some((
                start..start + line.trim().len(),
                "'service' is no list of tables".to_owned(),
                ONE_BRACKET.to_owned(),
            ));
        }
        at += line.len();
    }
    let at = text.floor_char_boundary(span.start.min(text.len()));
    let start = text[..at].rfind('\n').map_or(0, |i| i + 1);
    let line = text[start..].lines().next().unwrap_or_default();
    bare_value(line, start)
}

/// A value that lacks its quotes, has others, or is written as in another language; `start`: where the line begins.
fn bare_value(line: &str, start: usize) -> Option<(Range<usize>, String, String)> {
    let plain = |c: char| c.is_alphanumeric() || matches!(c, '_' | '-' | '.' | ':' | '/' | '%');
    let Some((key, value)) = line.split_once('=') else {
        let (key, value) = line.split_once(':')?;
        let named = !key.trim().is_empty() && key.trim().chars().all(plain) && !value.trim().is_empty();
        let (key, value) = (key.trim(), value.trim());
        let colon = start + line.find(':')?;
        return named.then(|| {
            (colon..colon + 1, format!("':' behind '{key}'"), format!("TOML writes {key} = {value}"))
        });
    };
    let (key, word) = (key.trim(), value.split('#').next().unwrap_or_default().trim());
    if key.is_empty() || !key.chars().all(plain) || word.is_empty() {
        return None;
    }
    let from = start + line.find('=')? + 1 + value.find(word)?;
    let at = from..from + word.len();
    if let Some(inner) = word.strip_prefix(['“', '”', '„', '‘', '’', '«', '»']) {
        let inner = inner.trim_end_matches(['“', '”', '‘', '’', '«', '»']);
        return Some((
            at,
            format!("the quotes of '{key}' are typographic ones"),
            format!("write {key} = \"{inner}\" with plain quotes"),
        ));
    }
    if !word.chars().all(plain) || ["true", "false", "inf", "nan"].contains(&word) {
        return None;
    }
    if word.eq_ignore_ascii_case("true") || word.eq_ignore_ascii_case("false") {
        let lower = word.to_lowercase();
        return Some((at, format!("'{word}' is written in small letters"), format!("write {key} = {lower}")));
    }
    let digits = word.starts_with(|c: char| c.is_ascii_digit());
    if digits
        && word.chars().all(|c| c.is_ascii_hexdigit())
        && word.contains(|c: char| c.is_ascii_alphabetic())
    {
        return Some((
            at,
            format!("the value of '{key}' is no number"),
            format!("hexadecimal numbers begin with 0x: write {key} = 0x{word}"),
        ));
    }
    let text = if digits {
        word.ends_with(|c: char| c.is_ascii_alphabetic())
    } else {
        !word.starts_with(['-', '.', ':'])
    };
    text.then(|| {
        (at, format!("the value of '{key}' is a text without quotes"), format!("write {key} = \"{word}\""))
    })
}

const ONE_BRACKET: &str = "write [[service]] with two brackets for each service";

fn read_stack(root: &Table, sink: &mut Sink<'_>) -> Option<(String, StackTable)> {
    let table = match root.get("stack") {
        Some(Item::Table(table)) => table.clone(),
        Some(Item::Value(toml_edit::Value::InlineTable(table))) => table.clone().into_table(),
        Some(other) => {
            let span = other.span().unwrap_or_default();
            sink.error(
                &span,
                "'stack' is no table",
                "write [stack] on a line of its own, then name = \"...\"",
            );
            return None;
        }
        None => {
            sink.error(&(0..0), "the file has no [stack] table", "begin it with\n[stack]\nname = \"...\"");
            return None;
        }
    };
    let header = root.key("stack").and_then(|k| k.span()).unwrap_or_default();
    let header = table.span().unwrap_or(header);
    if !table.contains_key("name") {
        sink.error(
            &header,
            "[stack] lacks the key 'name'",
            "write name = \"...\"; two stacks on one machine need two names",
        );
        return None;
    }
    let name_span = keypath::span_of(&table, "name").unwrap_or_else(|| header.clone());
    let scope = Scope {
        what: "[stack]",
        explain: "stack",
        keys: STACK_DOCS,
        more_keys: &[],
        kinds: &[],
        place: header,
    };
    let stack: StackTable =
        read_table(table, &scope, sink, |t| toml_edit::de::from_document(DocumentMut::from(t)))?;
    if let Some(fault) = name_fault(&stack.name) {
        sink.error(&name_span, format!("stack name '{}': {fault}", stack.name.escape_debug()), NAME_HELP);
    }
    Some((stack.name.clone(), stack))
}

const NAME_HELP: &str =
    "a name has 1 to 32 of a-z 0-9 _ - and begins with a letter; 'stack', 'inbox' and 'launcher' are taken";

fn name_fault(name: &str) -> Option<&'static str> {
    let mut chars = name.chars();
    match chars.next() {
        None => return Some("it is empty"),
        Some('a'..='z') => {}
        Some(_) => return Some("it does not begin with a letter a-z"),
    }
    if !chars.all(|c| matches!(c, 'a'..='z' | '0'..='9' | '_' | '-')) {
        return Some("it has characters other than a-z 0-9 _ -");
    }
    if name.len() > NAME_MAX {
        return Some("it is longer than 32 characters");
    }
    RESERVED.contains(&name).then_some("this name is taken by the rail itself")
}

fn read_services(
    root: &Table,
    stack: Option<&(String, StackTable)>,
    kinds: &'static [Kind],
    sink: &mut Sink<'_>,
) -> Vec<Service> {
    let tables = match root.get("service") {
        Some(Item::ArrayOfTables(tables)) => tables,
        Some(other) => {
            let key = root.key("service").and_then(|k| k.span());
            let span = other.span().or(key).unwrap_or_default();
            sink.error(&span, "'service' is no list of tables", ONE_BRACKET);
            return Vec::new();
        }
        None => {
            if stack.is_some() {
                let end = sink.source.text.trim_end().len();
                sink.error(
                    &(end..end),
                    "the stack has no services",
                    "add [[service]] tables, each with name and kind",
                );
            }
            return Vec::new();
        }
    };
    if tables.len() > SERVICES_MAX {
        let span = tables.get(SERVICES_MAX).and_then(Table::span).unwrap_or_default();
        sink.error(
            &span,
            format!("the stack has {} services; at most {SERVICES_MAX} fit on a rail", tables.len()),
            "split it into two stacks",
        );
        return Vec::new();
    }
    let mut services: Vec<Service> = Vec::new();
    let mut names: Vec<(String, Range<usize>)> = Vec::new();
    for table in tables {
        let mut reader = ServiceReader { kinds, sink, header: table.span().unwrap_or_default() };
        let name = reader.name(table);
        if let Some((name, span)) = &name {
            if let Some((_, first)) = names.iter().find(|(n, _)| n == name) {
                let line = sink.source.line(first.start);
                sink.error(
                    span,
                    format!("two services are named '{name}'; the first is in line {line}"),
                    "give each service its own name",
                );
                continue;
            }
            names.push((name.clone(), span.clone()));
        }
        let mut reader = ServiceReader { kinds, sink, header: table.span().unwrap_or_default() };
        let kind = reader.kind(table, name.as_ref().map(|(n, _)| n.as_str()));
        if let (Some((name, _)), Some(kind)) = (name, kind)
            && let Some(service) = reader.service(table, name, kind, stack.map(|(_, s)| s))
        {
            services.push(service);
        }
    }
    services
}

struct ServiceReader<'s, 't> {
    kinds: &'static [Kind],
    sink: &'s mut Sink<'t>,
    header: Range<usize>,
}

impl ServiceReader<'_, '_> {
    fn text(&mut self, table: &Table, key: &str, help: &str) -> Option<(String, Range<usize>)> {
        let Some(item) = table.get(key) else {
            self.sink.error(&self.header, format!("[[service]] lacks the key '{key}'"), help);
            return None;
        };
        let span = item.span().unwrap_or_else(|| self.header.clone());
        let Some(text) = item.as_str() else {
            let found = item.type_name();
            self.sink.error(
                &span,
                format!("key '{key}' of [[service]]: expected a text in quotes, found {found}"),
                help,
            );
            return None;
        };
        Some((text.to_owned(), span))
    }

    fn name(&mut self, table: &Table) -> Option<(String, Range<usize>)> {
        let (name, span) =
            self.text(table, "name", "write name = \"...\"; topics, logs and messages carry this name")?;
        if let Some(fault) = name_fault(&name) {
            self.sink.error(&span, format!("service name '{}': {fault}", name.escape_debug()), NAME_HELP);
            return None;
        }
        Some((name, span))
    }

    fn kind(&mut self, table: &Table, name: Option<&str>) -> Option<&'static Kind> {
        let kinds = self.kinds;
        if let Some(key) = table.key("exec") {
            let span = key.span().unwrap_or_else(|| self.header.clone());
            self.sink.error(
                &span,
                "foreign programs (exec) are not supported yet",
                "leave the service out; a program of your own can read and write through Modbus or socketcand",
            );
            return None;
        }
        let list = suggestion("", "kinds", kinds.iter().map(|k| k.name));
        let (kind, span) = self.text(table, "kind", &list)?;
        if let Some(found) = kinds.iter().find(|k| k.name == kind) {
            return Some(found);
        }
        let of = name.map(|n| format!(" of service '{n}'")).unwrap_or_default();
        if NOT_YET.contains(&kind.as_str()) {
            self.sink.error(&span, format!("kind '{kind}'{of} is not supported yet"), list);
        } else {
            self.sink.error(
                &span,
                format!("unknown kind '{}'{of}", kind.escape_debug()),
                suggestion(&kind, "kinds", kinds.iter().map(|k| k.name)),
            );
        }
        None
    }

    fn service(
        &mut self,
        table: &Table,
        name: String,
        kind: &'static Kind,
        stack: Option<&StackTable>,
    ) -> Option<Service> {
        let what = format!("service '{name}' ({})", kind.name);
        let (own, launch) = split(table);
        let launch = self.launch(launch, &what, stack);
        let scope = Scope {
            what: &what,
            explain: kind.name,
            keys: kind.config_doc,
            more_keys: &SERVICE_KEYS,
            kinds: self.kinds,
            place: self.header.clone(),
        };
        let config = read_table(own.clone(), &scope, self.sink, kind.parse)?;
        let json = match to_json(&own) {
            Ok(json) => json,
            Err((span, message)) => {
                self.sink.error(&span, format!("{what}: {message}"), "");
                return None;
            }
        };
        // The process reads the JSON, not the TOML: what only one of them can say must not pass.
        if let Err(error) = (kind.accepts)(&json) {
            self.sink.error(&self.header, format!("{what}: {error}"), "");
            return None;
        }
        Some(Service { name, kind, header: self.header.clone(), table: own, json, config, launch: launch? })
    }

    fn launch(&mut self, table: Table, what: &str, stack: Option<&StackTable>) -> Option<LaunchOptions> {
        let place = self.header.clone();
        let scope = Scope { what, explain: "", keys: SERVICE_DOCS, more_keys: &[], kinds: &[], place };
        let launch: LaunchTable = read_table(table.clone(), &scope, self.sink, |t| {
            toml_edit::de::from_document(DocumentMut::from(t))
        })?;
        for (key, message, help) in launch.faults() {
            let span = keypath::span_of(&table, key).unwrap_or_else(|| self.header.clone());
            self.sink.error(&span, format!("{what}: {message}"), help);
        }
        let level = stack.map(|s| s.log_level).unwrap_or_default();
        Some(launch.options(&level))
    }
}

/// A service's own keys, and the launcher's without `name` and `kind`. Places are kept.
fn split(table: &Table) -> (Table, Table) {
    let mut own = table.clone();
    let mut launch = Table::new();
    for name in SERVICE_KEYS {
        if let Some((key, item)) = own.remove_entry(name)
            && name != "name"
            && name != "kind"
        {
            launch.insert_formatted(&key, item);
        }
    }
    (own, launch)
}
