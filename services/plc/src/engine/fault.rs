//! A program fault as the user reads it: what, where, in which instance, with which values.

use super::machine::RawTrap;
use super::value::Cell;
use dinrail_iec::Source;
use dinrail_iec::artifact::{DebugMap, Place, TrapId};
use serde::Serialize;

/// Most variables of a report.
const MAX_VARIABLES: usize = 12;

/// What stopped the program.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FaultReport {
    /// Number of the trap.
    pub trap: u32,
    /// The trap in words.
    pub words: String,
    /// Task that was running.
    pub task: String,
    /// `main.st`; empty when unknown.
    pub file: String,
    /// From 1; 0 when unknown.
    pub line: u32,
    pub column: u32,
    /// `prg.pump`; empty when unknown.
    pub instance: String,
    /// The statement's text, when the source is known.
    pub statement: String,
    /// Variables of the instance, those of the statement first.
    pub variables: Vec<(String, String)>,
    /// All of it in one paragraph.
    pub message: String,
}

impl FaultReport {
    pub(crate) fn new(raw: &RawTrap, task: usize, map: &DebugMap, memory: &[u8], sources: &[Source]) -> Self {
        let known = TrapId::from_u32(raw.trap);
        let words = known.map_or_else(|| format!("unknown fault {}", raw.trap), |t| t.words().to_owned());
        let task = map.tasks.get(task).map_or_else(String::new, |t| t.name.clone());
        let place = map.statements.get(raw.statement as usize).filter(|_| raw.statement != 0);
        let file = place.and_then(|p| map.files.get(p.file as usize)).cloned().unwrap_or_default();
        let statement = place.and_then(|p| excerpt(p, &file, sources)).unwrap_or_default();
        let instance = instance_path(raw, map, place);
        let variables = variables(map, memory, &instance, &statement);
        let mut report = Self {
            trap: raw.trap,
            words,
            task,
            file,
            line: place.map_or(0, |p| p.line),
            column: place.map_or(0, |p| p.column),
            instance,
            statement,
            variables,
            message: String::new(),
        };
        report.message = report.text(raw, known, &map.place_text(raw.statement));
        report
    }

    fn text(&self, raw: &RawTrap, known: Option<TrapId>, place: &str) -> String {
        let mut text = format!("{} at {place}", self.words);
        if !self.instance.is_empty() {
            text.push_str(&format!(", in {}", self.instance));
        }
        if !self.task.is_empty() {
            text.push_str(&format!(", task {}", self.task));
        }
        match known {
            Some(TrapId::DivisionByZero | TrapId::ModuloByZero) => {
                text.push_str(&format!("; dividend {}", raw.value));
            }
            Some(TrapId::IndexOutOfBounds) => text.push_str(&format!("; index {}", raw.value)),
            Some(TrapId::ConversionOutOfRange) if raw.real.abs() < 1e15 => {
                text.push_str(&format!("; value {}", raw.real));
            }
            Some(TrapId::ConversionOutOfRange) => text.push_str(&format!("; value {:e}", raw.real)),
            Some(TrapId::SubrangeViolation) => text.push_str(&format!("; value {}", raw.value)),
            _ => {}
        }
        if !self.statement.is_empty() {
            text.push_str(&format!("; statement: {}", self.statement));
        }
        for (i, (name, value)) in self.variables.iter().enumerate() {
            text.push_str(if i == 0 { "; with " } else { ", " });
            text.push_str(&format!("{name} = {value}"));
        }
        text
    }
}

/// The instance whose statement it is: stored by the check, or the only one of the POU.
fn instance_path(raw: &RawTrap, map: &DebugMap, place: Option<&Place>) -> String {
    let pou = place.and_then(|p| map.pous.get(p.pou as usize)).map_or("", String::as_str);
    let of_pou = || map.instances.iter().filter(|i| i.type_name.eq_ignore_ascii_case(pou));
    // An instance and its first member begin at the same address: the POU tells which one is meant.
    if let Some(exact) = of_pou().find(|i| raw.instance != 0 && i.offset == raw.instance) {
        return exact.path.clone();
    }
    if raw.instance != 0
        && let Some(found) = map.instance_at(raw.instance)
    {
        return found.path.clone();
    }
    let mut candidates = of_pou();
    match (candidates.next(), candidates.next()) {
        (Some(only), None) => only.path.clone(),
        _ => String::new(),
    }
}

/// The statement in one line of at most 120 characters.
fn excerpt(place: &Place, file: &str, sources: &[Source]) -> Option<String> {
    let text = &sources.iter().find(|s| s.name == file)?.text;
    let mut out = String::new();
    for (i, line) in text.lines().enumerate() {
        let number = i as u32 + 1;
        if number < place.line || number > place.end_line {
            continue;
        }
        let chars: Vec<char> = line.chars().collect();
        let from = if number == place.line { (place.column as usize).saturating_sub(1) } else { 0 };
        let to = if number == place.end_line {
            (place.end_column as usize).saturating_sub(1)
        } else {
            chars.len()
        };
        let part: String =
            chars.get(from..to.clamp(from, chars.len().max(from))).unwrap_or(&[]).iter().collect();
        if !out.is_empty() {
            out.push(' ');
        }
        out.push_str(part.trim());
    }
    if out.chars().count() > 120 {
        out = out.chars().take(117).collect::<String>() + "...";
    }
    Some(out)
}

fn variables(map: &DebugMap, memory: &[u8], instance: &str, statement: &str) -> Vec<(String, String)> {
    if instance.is_empty() {
        return Vec::new();
    }
    let words: Vec<String> = statement
        .split(|c: char| !(c.is_alphanumeric() || c == '_'))
        .filter(|w| !w.is_empty())
        .map(str::to_ascii_lowercase)
        .collect();
    let prefix = format!("{instance}.");
    let mut named = Vec::new();
    let mut others = Vec::new();
    for symbol in &map.symbols {
        let local = symbol.path.get(..prefix.len()).filter(|p| p.eq_ignore_ascii_case(&prefix));
        let name = match local {
            Some(_) => &symbol.path[prefix.len()..],
            // A global counts only when the statement names it.
            None if !symbol.path.contains('.') => symbol.path.as_str(),
            None => continue,
        };
        let mentioned =
            words.iter().any(|w| name.split('.').next().is_some_and(|n| n.eq_ignore_ascii_case(w)));
        if !symbol.dims.is_empty() || (local.is_none() && !mentioned) {
            continue;
        }
        let cell = Cell { offset: symbol.offset, elem: symbol.elem, storage: symbol.storage };
        let row = (name.to_owned(), cell.text(memory));
        if mentioned {
            named.push(row);
        } else if !name.contains('.') {
            others.push(row);
        }
    }
    named.append(&mut others);
    named.truncate(MAX_VARIABLES);
    named
}
