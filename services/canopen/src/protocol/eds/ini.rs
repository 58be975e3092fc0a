//! The shape of an EDS or DCF: sections of `key=value` lines (CiA 306-1 V1.4, 6.2), read so that what real files
//! do wrong costs a warning and not the file.

use super::{Diag, EdsError, limit};
use std::collections::HashMap;

/// A `key=value` line.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Key {
    pub key: String,
    pub value: String,
    pub line: u32,
}

impl Key {
    /// Is this the key `name`, whatever its case and blanks in it (`Supported Objects`)?
    pub fn is(&self, name: &str) -> bool {
        self.key.eq_ignore_ascii_case(name)
            || (self.key.contains(char::is_whitespace)
                && self.key.split_whitespace().collect::<String>().eq_ignore_ascii_case(name))
    }
}

/// A section as it stands in the file.
#[derive(Clone, Debug, PartialEq, Eq, Default)]
pub struct Section {
    pub name: String,
    /// Line of the header; 0 if the section was made here.
    pub line: u32,
    pub keys: Vec<Key>,
}

impl Section {
    /// The value of a key, whatever its case.
    pub fn get(&self, key: &str) -> Option<&Key> {
        self.keys.iter().find(|found| found.is(key))
    }
    /// The text of a key, `""` without one.
    pub fn text(&self, key: &str) -> &str {
        self.get(key).map_or("", |key| &key.value)
    }
    /// Sets a key, behind the others if it is new.
    pub fn set(&mut self, key: &str, value: &str) {
        match self.keys.iter_mut().find(|found| found.is(key)) {
            Some(found) => found.value = value.to_owned(),
            None => self.keys.push(Key { key: key.to_owned(), value: value.to_owned(), line: 0 }),
        }
    }
}

/// All sections in the order of the file.
#[derive(Clone, Debug, PartialEq, Eq, Default)]
pub struct Ini {
    pub sections: Vec<Section>,
    /// Name in small letters -> position.
    by_name: HashMap<String, usize>,
}

/// The name as it is compared: small letters, no blanks, no `0x` in front, no zeros in front of a sub-index.
pub(super) fn fold(name: &str) -> String {
    let name: String = name.chars().filter(|c| !c.is_whitespace()).map(|c| c.to_ascii_lowercase()).collect();
    let name = name.strip_prefix("0x").unwrap_or(&name);
    match name.split_once("sub") {
        Some((index, sub)) if index.len() == 4 && sub.len() > 1 && sub.is_ascii() => {
            let zeros = sub[..sub.len() - 1].bytes().take_while(|&byte| byte == b'0').count();
            format!("{index}sub{}", &sub[zeros..])
        }
        _ => name.to_owned(),
    }
}

impl Ini {
    /// The section of this name, whatever its case.
    pub fn get(&self, name: &str) -> Option<&Section> {
        self.by_name.get(&fold(name)).map(|&at| &self.sections[at])
    }
    /// The section of this name; made behind `after`, or at the end, if it is not there.
    pub fn get_or_make(&mut self, name: &str, after: Option<&str>) -> &mut Section {
        if let Some(&at) = self.by_name.get(&fold(name)) {
            return &mut self.sections[at];
        }
        let section = Section { name: name.to_owned(), ..Section::default() };
        let after = after.and_then(|after| self.by_name.get(&fold(after)).copied());
        let at = after.map_or(self.sections.len(), |at| at + 1);
        self.sections.insert(at, section);
        for (at, section) in self.sections.iter().enumerate().skip(at) {
            self.by_name.insert(fold(&section.name), at);
        }
        &mut self.sections[at]
    }

    /// Reads the text of a file.
    pub fn parse(text: &str, diags: &mut Vec<Diag>) -> Result<Self, EdsError> {
        let mut ini = Self::default();
        let mut current: Option<usize> = None;
        let mut total = 0usize;
        // Line ends of old Macs: no line would end otherwise.
        let mac = text.contains('\r') && !text.contains('\n');
        for (at, line) in text.split(if mac { '\r' } else { '\n' }).enumerate() {
            let number = u32::try_from(at + 1).unwrap_or(u32::MAX);
            if line.len() > limit::LINE {
                return Err(EdsError::LineTooLong { line: number });
            }
            total += 1;
            if total > limit::LINES {
                return Err(EdsError::TooManyLines);
            }
            let line =
                line.trim_matches(|c: char| c.is_whitespace() || matches!(c, '\0' | '\u{1A}' | '\u{FEFF}'));
            if line.is_empty() || line.starts_with(';') || line.starts_with('#') {
                continue;
            }
            if line.starts_with('[') {
                current = Some(ini.header(line, number, diags));
                continue;
            }
            let Some((key, value)) = line.split_once('=') else {
                diags.push(Diag::warning(
                    number,
                    "",
                    "",
                    format!("'{}' is no key=value: ignored", short(line)),
                ));
                continue;
            };
            let Some(section) = current.and_then(|at| ini.sections.get_mut(at)) else {
                diags.push(Diag::warning(
                    number,
                    "",
                    key.trim(),
                    "before the first [section]: ignored".to_owned(),
                ));
                continue;
            };
            add(section, key.trim(), value.trim(), number, diags);
        }
        Ok(ini)
    }

    fn header(&mut self, line: &str, number: u32, diags: &mut Vec<Diag>) -> usize {
        let inner = &line[1..];
        let (name, rest) = inner.split_once(']').unwrap_or((inner, "missing"));
        let name = name.trim();
        let rest = rest.trim();
        if rest == "missing" && !inner.contains(']') {
            diags.push(Diag::warning(number, name, "", "the ']' is missing".to_owned()));
        } else if !rest.is_empty() && !rest.starts_with(';') && !rest.starts_with('#') {
            diags.push(Diag::warning(number, name, "", format!("'{}' behind ']' is ignored", short(rest))));
        }
        match self.by_name.get(&fold(name)) {
            Some(&at) => {
                let first = self.sections[at].line;
                let text =
                    format!("the section is there twice, first in line {first}: both are taken as one");
                diags.push(Diag::warning(number, name, "", text));
                at
            }
            None => {
                self.by_name.insert(fold(name), self.sections.len());
                self.sections.push(Section { name: name.to_owned(), line: number, keys: Vec::new() });
                self.sections.len() - 1
            }
        }
    }
}

fn add(section: &mut Section, key: &str, value: &str, line: u32, diags: &mut Vec<Diag>) {
    // Object lists may be long, and their keys are numbers that nobody repeats by accident: no search there.
    let searched = section.keys.len() < 64;
    if searched && let Some(first) = section.get(key) {
        if first.value != value {
            let text = format!("the key is there twice, first in line {}: the first counts", first.line);
            diags.push(Diag::warning(line, &section.name, key, text));
        }
        return;
    }
    section.keys.push(Key { key: key.to_owned(), value: value.to_owned(), line });
}

/// The beginning of a text, for messages.
pub(super) fn short(text: &str) -> String {
    if text.chars().count() <= 40 {
        text.to_owned()
    } else {
        text.chars().take(37).collect::<String>() + "..."
    }
}

/// The text of a file: UTF-8, UTF-16 with a byte order mark, or else Latin-1, which every byte is.
pub fn decode(bytes: &[u8], diags: &mut Vec<Diag>) -> String {
    let utf16 = |from: fn([u8; 2]) -> u16, diags: &mut Vec<Diag>| {
        diags.push(Diag::warning(1, "", "", "the file is UTF-16; CiA 306 asks for ASCII".to_owned()));
        let units: Vec<u16> = bytes[2..].chunks_exact(2).map(|pair| from([pair[0], pair[1]])).collect();
        String::from_utf16_lossy(&units)
    };
    match bytes {
        [0xFF, 0xFE, ..] => return utf16(u16::from_le_bytes, diags),
        [0xFE, 0xFF, ..] => return utf16(u16::from_be_bytes, diags),
        _ => {}
    }
    match std::str::from_utf8(bytes) {
        Ok(text) => text.to_owned(),
        Err(error) => {
            let line = bytes[..error.valid_up_to()].split(|&byte| byte == b'\n').count();
            let text = "the file is not UTF-8: read as Latin-1".to_owned();
            diags.push(Diag::warning(u32::try_from(line).unwrap_or(u32::MAX), "", "", text));
            bytes.iter().map(|&byte| char::from(byte)).collect()
        }
    }
}
