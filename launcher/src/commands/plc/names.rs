//! The variables of a running PLC by name: its program's, from the module that the engine left beside its rail, and those
//! that the stack file's symbols make.
//!
//! The engine knows elementary variables only. Here names are found as a person writes them: instances with their members,
//! names of enumerations for their values, the nearest name for one that is not there.

use crate::stackfile::nearest;
use crate::supervise::jobs::JobLine;
use dinrail_iec::artifact::{AreaKind, DebugMap, ElemType, Enumeration, Symbol};
use dinrail_iec::{AddressSize, Addressing, Artifact, parse_address};
use dinrail_modbus::service::addressing_of;
use dinrail_plc::engine::value::{find, time_text};
use dinrail_plc::program;
use dinrail_plc::setup::External;
use ipc_types::Context;
use ipc_types::stack::Stack;
use ipc_types::wiring::{Area, ImageRange};
use serde_json::{Value, json};
use std::path::Path;

/// Largest module that is read.
const MODULE_BYTES_MAX: u64 = 64 << 20;
/// Members of one instance that are shown.
pub const MEMBERS_MAX: usize = 1024;
/// Names that an error lists.
const LISTED: usize = 12;

/// A variable that the engine can be asked for.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Variable {
    /// As the engine knows it; `%QX0.3` for a place without a name.
    pub path: String,
    /// `INT`, `Mode`, `ARRAY [0..9] OF INT`; empty when only the engine knows.
    pub type_name: String,
    /// Elements of an array, else 1.
    pub elements: u64,
    is_time: bool,
    enumeration: Option<Enumeration>,
}

/// A line of `plc list`.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize)]
pub struct Entry {
    pub var: String,
    #[serde(rename = "type")]
    pub type_name: String,
    pub address: Option<String>,
    pub retain: bool,
    /// `main.st:3`, or the service whose point it is.
    pub declared: String,
    /// Names of the values of an enumeration.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub values: Vec<String>,
}

/// What can be named in a PLC.
pub struct Names {
    map: Option<DebugMap>,
    /// There is a program, but its module could not be read: names are left to the engine.
    hidden: bool,
    externals: Vec<External>,
    addressing: Addressing,
}

impl Names {
    /// Asks the engine which program runs and reads its module.
    pub fn fetch(ctx: &Context, line: &mut JobLine, plc: &str) -> anyhow::Result<Self> {
        let status = line.ask(&json!({ "do": "status" }), super::LIMIT)?;
        let hash = status.get("program_hash").and_then(Value::as_str).unwrap_or_default();
        let map = module(&ctx.stack.root.join(format!("{plc}.{hash}.wasm")));
        let hidden = map.is_none() && hash.chars().any(|c| c != '0');
        Ok(Self { hidden, ..Self::of(&ctx.stack, plc, map) })
    }

    pub(super) fn of(stack: &Stack, plc: &str, map: Option<DebugMap>) -> Self {
        let service = stack.service(plc);
        let config =
            service.and_then(|s| serde_json::from_value::<dinrail_plc::Config>(s.config.clone()).ok());
        let externals = config.map(|c| program::setup(&c, stack, plc).externals).unwrap_or_default();
        Self { map, hidden: false, externals, addressing: addressing_of(service) }
    }

    /// The variables meant by a name: itself, an element of an array, or all members of an instance.
    pub fn expand(&self, asked: &str) -> Result<Vec<Variable>, String> {
        let asked = asked.trim();
        if asked.starts_with('%') {
            return Ok(vec![self.place(asked)?]);
        }
        if let Some(one) = self.one(asked) {
            return Ok(vec![one]);
        }
        let members = self.members(asked)?;
        match (members.is_empty(), self.hidden) {
            (false, _) => Ok(members),
            (true, true) => Ok(vec![Variable::unknown(asked)]),
            (true, false) => Err(self.no_such(asked)),
        }
    }

    /// The one variable of a name that can be set; an instance is none.
    pub fn settable(&self, asked: &str) -> Result<Variable, String> {
        match self.expand(asked)?.as_slice() {
            [only] => Ok(only.clone()),
            members => {
                let names: Vec<&str> = members.iter().map(|v| v.path.as_str()).take(LISTED).collect();
                Err(format!("'{asked}' is an instance: name one of its members, {}", names.join(", ")))
            }
        }
    }

    /// Every variable, in the order of the program.
    pub fn all(&self) -> Vec<Variable> {
        let map = self.map.as_ref();
        let mut list: Vec<Variable> =
            map.iter().flat_map(|map| map.symbols.iter().map(|s| of_symbol(map, s))).collect();
        list.extend(self.foreign().map(of_external));
        list
    }

    /// Every variable with its place.
    pub fn entries(&self) -> Vec<Entry> {
        let mut list = Vec::new();
        for (map, s) in self.map.iter().flat_map(|map| map.symbols.iter().map(move |s| (map, s))) {
            let variable = of_symbol(map, s);
            let external =
                self.externals.iter().find(|e| s.line == 0 && e.name.eq_ignore_ascii_case(&s.path));
            let file = map.files.get(s.file as usize).map_or("program", String::as_str);
            list.push(Entry {
                var: variable.path,
                type_name: variable.type_name,
                address: s.address.clone(),
                retain: s.retain,
                declared: external.map_or_else(|| format!("{file}:{}", s.line), |e| e.origin.clone()),
                values: variable.enumeration.map(|e| names_of(&e)).unwrap_or_default(),
            });
        }
        for external in self.foreign() {
            list.push(Entry {
                var: external.name.clone(),
                type_name: external.type_name.clone(),
                address: Some(external.address.clone()),
                retain: false,
                declared: external.origin.clone(),
                values: Vec::new(),
            });
        }
        list
    }

    /// Symbols of the stack file that the program does not have.
    fn foreign(&self) -> impl Iterator<Item = &External> {
        let has = |e: &&External| {
            let map = self.map.as_ref();
            map.is_some_and(|map| map.symbols.iter().any(|s| s.path.eq_ignore_ascii_case(&e.name)))
        };
        self.externals.iter().filter(move |e| !has(e))
    }

    fn place(&self, asked: &str) -> Result<Variable, String> {
        let at = parse_address(asked, self.addressing).map_err(|e| e.to_string())?;
        let elem = match at.size {
            AddressSize::Bit => ElemType::Bool,
            AddressSize::Byte => ElemType::Usint,
            AddressSize::Word => ElemType::Uint,
            AddressSize::Dword => ElemType::Udint,
            AddressSize::Lword => ElemType::Ulint,
        };
        Ok(Variable { type_name: elem.name().to_owned(), ..Variable::unknown(asked) })
    }

    fn one(&self, asked: &str) -> Option<Variable> {
        if let Some(map) = &self.map {
            if let Some(symbol) = find(map, asked) {
                return Some(of_symbol(map, symbol));
            }
            // An element: its last index is none of the symbol's name.
            if let Some((base, _)) = asked.rsplit_once('[')
                && let Some(symbol) = find(map, base).filter(|s| !s.dims.is_empty())
            {
                let element = of_symbol(map, &Symbol { dims: Vec::new(), ..symbol.clone() });
                return Some(Variable { path: asked.to_owned(), ..element });
            }
        }
        self.externals.iter().find(|e| e.name.eq_ignore_ascii_case(asked)).map(of_external)
    }

    /// All that lies in the instance or structure of this path, or of a path that ends so.
    fn members(&self, asked: &str) -> Result<Vec<Variable>, String> {
        let Some(map) = &self.map else { return Ok(Vec::new()) };
        let owners = owners(map, asked);
        let [owner] = owners.as_slice() else {
            return match owners.as_slice() {
                [] => Ok(Vec::new()),
                several => Err(format!("'{asked}' is not clear: {}", shortened(several))),
            };
        };
        let inside = map.symbols.iter().filter(|s| below(&s.path, owner)).map(|s| of_symbol(map, s));
        Ok(inside.take(MEMBERS_MAX).collect())
    }

    fn no_such(&self, asked: &str) -> String {
        let mut names: Vec<&str> = self.externals.iter().map(|e| e.name.as_str()).collect();
        let symbols = self.map.iter().flat_map(|map| &map.symbols).map(|s| s.path.as_str());
        names.extend(symbols);
        let wanted = asked.rsplit('.').next().unwrap_or(asked);
        // First the whole name, then its last part, of which the whole name is told.
        let near = nearest(asked, names.iter().copied()).or_else(|| {
            let last = |path: &str| path.rsplit('.').next().unwrap_or_default().to_owned();
            let lasts: Vec<String> = names.iter().map(|n| last(n)).collect();
            let near = nearest(wanted, lasts.iter().map(String::as_str))?;
            names.iter().copied().find(|n| last(n) == near)
        });
        let near = near.map_or_else(|| "; ".to_owned(), |n| format!("; did you mean '{n}'? "));
        let list =
            if names.is_empty() { "there are only %-addresses" } else { "`dinrail plc list` shows all" };
        format!("no variable '{asked}'{near}{list}")
    }

    /// The service that delivers the place of a variable in %I, if one does: what is written there lasts until its next
    /// value.
    pub fn input_owner<'a>(&self, stack: &'a Stack, plc: &str, asked: &str) -> Option<&'a str> {
        let (byte, bytes, bit) = self.input_place(asked.trim())?;
        let meets = |r: &ImageRange| {
            let apart = bit.is_some() && r.bit.is_some() && bit != r.bit;
            r.area == Area::Input && r.byte < byte + bytes && byte < r.byte + r.bytes && !apart
        };
        let of_plc = stack.services.iter().filter(|s| s.wiring.plc.as_deref() == Some(plc));
        of_plc.into_iter().find(|s| s.wiring.inputs.iter().any(meets)).map(|s| s.name.as_str())
    }

    fn input_place(&self, asked: &str) -> Option<(u32, u32, Option<u8>)> {
        let address = if asked.starts_with('%') {
            asked.to_owned()
        } else if let Some(symbol) = self.map.as_ref().and_then(|map| find(map, asked)) {
            symbol.address.clone()?
        } else {
            self.externals.iter().find(|e| e.name.eq_ignore_ascii_case(asked))?.address.clone()
        };
        let at = parse_address(&address, self.addressing).ok()?;
        (at.area == AreaKind::Input).then_some((at.byte, at.size.bytes(), at.bit))
    }
}

/// The debug map of a module in a file.
fn module(path: &Path) -> Option<DebugMap> {
    let metadata = std::fs::metadata(path).ok()?;
    if !metadata.is_file() || metadata.len() > MODULE_BYTES_MAX {
        return None;
    }
    Artifact::from_wasm(&std::fs::read(path).ok()?).ok().map(|artifact| artifact.map)
}

fn of_symbol(map: &DebugMap, symbol: &Symbol) -> Variable {
    let enumeration = symbol.enumeration.and_then(|e| map.enumerations.get(e as usize)).cloned();
    let word = enumeration.as_ref().map_or_else(|| symbol.elem.name(), |e| e.name.as_str());
    let dims: Vec<String> = symbol.dims.iter().map(|(lo, hi)| format!("{lo}..{hi}")).collect();
    Variable {
        path: symbol.path.clone(),
        type_name: if dims.is_empty() {
            word.to_owned()
        } else {
            format!("ARRAY [{}] OF {word}", dims.join(", "))
        },
        elements: symbol.elements(),
        is_time: symbol.elem == ElemType::Time,
        enumeration,
    }
}

fn of_external(external: &External) -> Variable {
    let is_time = matches!(external.type_name.as_str(), "TIME" | "LTIME");
    Variable { type_name: external.type_name.clone(), is_time, ..Variable::unknown(&external.name) }
}

fn names_of(enumeration: &Enumeration) -> Vec<String> {
    enumeration.values.iter().map(|(name, _)| name.clone()).collect()
}

/// Whether a variable lies in an instance, a structure or an array of them.
fn below(path: &str, owner: &str) -> bool {
    let Some(rest) = path.get(owner.len()..) else { return false };
    path[..owner.len()].eq_ignore_ascii_case(owner) && rest.starts_with(['.', '['])
}

/// Paths of instances and structures that are called so, or end so: those with the fewest parts.
fn owners<'a>(map: &'a DebugMap, asked: &str) -> Vec<&'a str> {
    let mut found: Vec<&str> = Vec::new();
    for symbol in &map.symbols {
        for (at, _) in symbol.path.match_indices(['.', '[']) {
            let owner = &symbol.path[..at];
            let fits = owner.get(owner.len().wrapping_sub(asked.len())..).is_some_and(|tail| {
                let before = &owner[..owner.len() - tail.len()];
                tail.eq_ignore_ascii_case(asked) && (before.is_empty() || before.ends_with('.'))
            });
            if fits && !found.contains(&owner) && found.len() < 100 {
                found.push(owner);
            }
        }
    }
    let parts = |path: &&str| path.matches('.').count();
    let fewest = found.iter().map(&parts).min().unwrap_or(0);
    found.retain(|path| parts(path) == fewest);
    found
}

fn shortened(list: &[&str]) -> String {
    let more = if list.len() > LISTED { ", ..." } else { "" };
    format!("{}{more}", list.iter().take(LISTED).copied().collect::<Vec<_>>().join(", "))
}

impl Variable {
    /// Only the engine knows what it is.
    fn unknown(path: &str) -> Self {
        Self {
            path: path.to_owned(),
            type_name: String::new(),
            elements: 1,
            is_time: false,
            enumeration: None,
        }
    }

    /// The name of a value, of an enumeration.
    pub fn name_of(&self, value: &Value) -> Option<&str> {
        let value = value.as_i64()?;
        let values = &self.enumeration.as_ref()?.values;
        values.iter().find(|(_, number)| *number == value).map(|(name, _)| name.as_str())
    }

    /// A value as the engine told it, for people: `TRUE`, `T#500ms`, `Auto (6)`.
    pub fn text(&self, value: &Value) -> String {
        if let Value::Array(list) = value {
            let more = if self.elements > list.len() as u64 { ", ..." } else { "" };
            let list: Vec<String> = list.iter().map(|value| self.text(value)).collect();
            return format!("[{}{more}]", list.join(", "));
        }
        match (value.as_f64().filter(|_| self.is_time), self.name_of(value)) {
            (Some(ms), _) => time_text(ms),
            (None, Some(name)) => format!("{name} ({value})"),
            (None, None) => super::plain(value),
        }
    }

    /// A value as the engine takes it: a name of an enumeration as its number.
    pub fn value(&self, value: &Value) -> Result<Value, String> {
        let (Some(e), Value::String(text)) = (&self.enumeration, value) else { return Ok(value.clone()) };
        let name = text.rsplit('#').next().unwrap_or(text).trim();
        if let Some((_, number)) = e.values.iter().find(|(n, _)| n.eq_ignore_ascii_case(name)) {
            return Ok(json!(number));
        }
        // 16#5 is a number.
        if name.starts_with(|c: char| c.is_ascii_digit() || c == '-') {
            return Ok(value.clone());
        }
        let names = names_of(e);
        let near = nearest(name, names.iter().map(String::as_str));
        let near = near.map(|n| format!("did you mean '{n}'? ")).unwrap_or_default();
        Err(format!(
            "'{}' is {}; it has no value '{text}': {near}it has {}",
            self.path,
            e.name,
            names.join(", ")
        ))
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::{PROGRAM, stack};
    use super::*;
    use dinrail_iec::Source;
    use dinrail_plc::program::compile_sources;
    use dinrail_plc::setup::Setup;

    fn map(stack: &Stack) -> DebugMap {
        let setup = Setup { externals: Names::of(stack, "plc", None).externals, ..Setup::default() };
        let source = Source { name: "main.st".into(), text: PROGRAM.into() };
        let compiled = compile_sources(vec![source], &setup).unwrap_or_else(|e| panic!("{e}"));
        compiled.program.artifact.map.clone()
    }

    fn names() -> Names {
        let stack = stack();
        let map = map(&stack);
        Names::of(&stack, "plc", Some(map))
    }

    fn paths(found: Result<Vec<Variable>, String>) -> String {
        found.map_or_else(|e| e, |list| list.iter().map(|v| v.path.as_str()).collect::<Vec<_>>().join(" "))
    }

    #[test]
    fn names_are_found_as_people_write_them() {
        let names = names();
        for (asked, found) in [
            ("main.n", "Main.n"),
            ("n", "Main.n"),
            ("Main.table", "Main.table"),
            ("table[3]", "table[3]"),
            ("%QX0.3", "%QX0.3"),
            ("level", "Level"),
            ("Main.hold", "Main.hold.IN Main.hold.PT Main.hold.Q Main.hold.ET"),
            ("HOLD", "Main.hold.IN Main.hold.PT Main.hold.Q Main.hold.ET"),
            ("Main.axis", "Main.axis[0].pos Main.axis[0].busy Main.axis[1].pos Main.axis[1].busy"),
            ("axis[1]", "Main.axis[1].pos Main.axis[1].busy"),
        ] {
            let shown = paths(names.expand(asked));
            assert!(
                shown == found || (found.contains("hold") && shown.starts_with(found)),
                "{asked}: {shown}"
            );
        }
        assert!(names.expand("Main").unwrap().len() > 10);
        insta::assert_snapshot!(
            ["Main.nn", "tabel", "Nothing.at.all", "%QX0.9", "lvel"].map(|n| paths(names.expand(n))).join("\n"),
            @r"
        no variable 'Main.nn'; did you mean 'Main.n'? `dinrail plc list` shows all
        no variable 'tabel'; did you mean 'Main.table'? `dinrail plc list` shows all
        no variable 'Nothing.at.all'; `dinrail plc list` shows all
        `%QX0.9`: a byte has the bits 0 to 7; bit 9 of byte 0 is %QX1.1
        no variable 'lvel'; did you mean 'Level'? `dinrail plc list` shows all
        "
        );
        let said = names.settable("hold").unwrap_err();
        assert!(said.starts_with("'hold' is an instance: name one of its members, Main.hold.IN, "), "{said}");
    }

    #[test]
    fn without_a_program_the_symbols_of_the_stack_are_known() {
        let names = Names::of(&stack(), "plc", None);
        let level = names.settable("Level").unwrap();
        assert_eq!((level.path.as_str(), level.type_name.as_str()), ("Level", "REAL"));
        assert_eq!(paths(names.expand("Main.n")), "no variable 'Main.n'; `dinrail plc list` shows all");
        let hidden = Names { hidden: true, ..names };
        assert_eq!(paths(hidden.expand("Main.n")), "Main.n");
    }

    #[test]
    fn values_are_shown_and_taken_by_name() {
        let names = names();
        let mode = names.settable("Main.mode").unwrap();
        assert_eq!(mode.text(&json!(5)), "Auto (5)");
        assert_eq!(mode.text(&json!(77)), "77");
        for (text, value) in [("auto", json!(5)), ("Mode#Off", json!(0)), ("16#5", json!("16#5"))] {
            assert_eq!(mode.value(&json!(text)), Ok(value));
        }
        assert_eq!(
            mode.value(&json!("Autto")).unwrap_err(),
            "'Main.mode' is Mode; it has no value 'Autto': did you mean 'Auto'? it has Off, Auto"
        );
        let pause = names.settable("pause").unwrap();
        assert_eq!((pause.type_name.as_str(), pause.text(&json!(500))), ("TIME", "T#500ms".to_owned()));
        let table = names.settable("table").unwrap();
        assert_eq!(table.type_name, "ARRAY [1..3] OF INT");
        assert_eq!(table.text(&json!([1, 2])), "[1, 2, ...]");
    }

    #[test]
    fn the_owner_of_an_input_is_found() {
        let (names, stack) = (names(), stack());
        for (asked, owner) in [
            ("Level", Some("io")),
            ("%ID1", Some("io")),
            ("%IB5", Some("io")),
            ("%IX0.3", Some("io")),
            ("%IX0.4", None),
            ("%IB8", None),
            ("%QB4", None),
            ("Main.n", None),
        ] {
            assert_eq!(names.input_owner(&stack, "plc", asked), owner, "{asked}");
        }
        assert_eq!(names.input_owner(&stack, "other", "Level"), None);
    }

    #[test]
    fn every_variable_is_listed_with_its_place() {
        let names = names();
        let entries = names.entries();
        let of = |var: &str| entries.iter().find(|e| e.var == var).unwrap();
        assert_eq!(of("Main.mode").values, ["Off", "Auto"]);
        assert!(of("Main.kept").retain);
        assert_eq!(of("Level").declared, "service 'io' in[0]");
        assert_eq!(of("Level").address.as_deref(), Some("%ID1"));
        assert_eq!(of("Main.n").declared, "main.st:3");
        assert_eq!(entries.len(), names.all().len());
    }
}
