//! What the compiler says: errors and warnings with code, place, source excerpt and remedy.

use codespan_reporting::diagnostic::{Diagnostic as CsDiagnostic, Label as CsLabel, Severity as CsSeverity};
use codespan_reporting::files::SimpleFiles;
use codespan_reporting::term;

use crate::{Source, limits};

/// A range of bytes in one source.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct Span {
    /// Index into the sources; the index after the last one is the standard library.
    pub file: u32,
    /// First byte.
    pub start: u32,
    /// Byte after the last one.
    pub end: u32,
}

impl Span {
    /// From the start of `self` to the end of `other` (of the same file).
    #[must_use]
    pub fn to(self, other: Span) -> Span {
        if self.file != other.file {
            return self;
        }
        Span { file: self.file, start: self.start.min(other.start), end: self.end.max(other.end) }
    }
}

/// How bad it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Severity {
    Error,
    Warning,
}

/// A place with a remark.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Label {
    pub span: Span,
    pub message: String,
}

/// One error or warning.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Diagnostic {
    /// `E0203`, `W0101`: see [`crate::codes`].
    pub code: &'static str,
    pub severity: Severity,
    pub message: String,
    /// Where; `None` when the cause lies in no source (a symbol of the stack file: the message names the line).
    pub primary: Option<Label>,
    pub secondary: Vec<Label>,
    pub help: Option<String>,
}

impl Diagnostic {
    /// An error, or a warning when the code starts with `W`.
    pub fn new(code: &'static str, span: Span, message: impl Into<String>) -> Self {
        let mut d = Self::placeless(code, message);
        d.primary = Some(Label { span, message: String::new() });
        d
    }

    /// As [`Self::new`], for a cause that lies in no source.
    pub fn placeless(code: &'static str, message: impl Into<String>) -> Self {
        let severity = if code.starts_with('W') { Severity::Warning } else { Severity::Error };
        Self { code, severity, message: message.into(), primary: None, secondary: Vec::new(), help: None }
    }

    /// Remark under the primary place.
    #[must_use]
    pub fn label(mut self, message: impl Into<String>) -> Self {
        if let Some(p) = &mut self.primary {
            p.message = message.into();
        }
        self
    }

    /// A second place.
    #[must_use]
    pub fn also(mut self, span: Span, message: impl Into<String>) -> Self {
        self.secondary.push(Label { span, message: message.into() });
        self
    }

    /// What to do about it.
    #[must_use]
    pub fn help(mut self, text: impl Into<String>) -> Self {
        self.help = Some(text.into());
        self
    }
}

/// Bytes of a line that is shown in messages; of a longer one only the place is told.
const LONG_LINE: usize = 2000;

/// All diagnostics of a compilation with the sources they point into.
#[derive(Debug, Clone, Default)]
pub struct Diagnostics {
    items: Vec<Diagnostic>,
    files: Vec<(String, String)>,
}

impl Diagnostics {
    /// Diagnostics of these sources; sorted by place, errors and warnings mixed as they stand in the text. Of very
    /// many the first [`limits::ERRORS`], errors before warnings.
    pub fn new(sources: &[Source], mut items: Vec<Diagnostic>) -> Self {
        if items.len() > limits::ERRORS {
            items.sort_by_key(|d| d.severity);
            items.truncate(limits::ERRORS);
        }
        items.sort_by_key(|d| {
            let s = d.primary.as_ref().map_or(Span::default(), |p| p.span);
            (s.file, s.start, s.end)
        });
        let mut files: Vec<(String, String)> =
            sources.iter().map(|s| (s.name.clone(), s.text.clone())).collect();
        files.push((crate::stdlib::NAME.to_owned(), crate::stdlib::PRELUDE.to_owned()));
        Self { items, files }
    }

    /// The diagnostics by place.
    pub fn items(&self) -> &[Diagnostic] {
        &self.items
    }

    /// How many of them are errors.
    pub fn error_count(&self) -> usize {
        self.items.iter().filter(|d| d.severity == Severity::Error).count()
    }

    /// True when there is neither error nor warning.
    pub fn is_empty(&self) -> bool {
        self.items.is_empty()
    }

    /// All of them as the user reads them: code, message, `file:line:column`, source excerpt, help.
    pub fn render(&self, color: bool) -> String {
        let mut files = SimpleFiles::new();
        for (name, text) in &self.files {
            files.add(name.as_str(), text.as_str());
        }
        let config = term::Config { tab_width: 4, ..term::Config::default() };
        let mut buffer: Vec<u8> = Vec::new();
        for d in &self.items {
            let cs = to_codespan(d, &self.files);
            // Writing into a Vec cannot fail and all spans lie in their files (checked in `to_codespan`); should
            // the renderer refuse all the same, the bare message is still better than nothing.
            let before = buffer.len();
            if let Some(place) = self.place_in_a_long_line(d) {
                let word = if d.severity == Severity::Error { "error" } else { "warning" };
                let help = d.help.as_ref().map_or_else(String::new, |h| format!("  = help: {h}\n"));
                let text = format!("{word}[{}]: {}\n  at {place}\n{help}\n", d.code, d.message);
                buffer.extend_from_slice(text.as_bytes());
                continue;
            }
            let result = if color {
                let mut writer = term::termcolor::Ansi::new(&mut buffer);
                term::emit_to_write_style(&mut writer, &config, &files, &cs)
            } else {
                term::emit_to_io_write(&mut buffer, &config, &files, &cs)
            };
            if result.is_err() {
                buffer.truncate(before);
                buffer.extend_from_slice(format!("error[{}]: {}\n\n", d.code, d.message).as_bytes());
            }
        }
        String::from_utf8_lossy(&buffer).into_owned()
    }

    /// `file:line:column` of a diagnostic that touches a line too long to be shown: a file may be one line of 1 MiB.
    fn place_in_a_long_line(&self, d: &Diagnostic) -> Option<String> {
        let line = |span: Span| {
            let (_, text) = self.files.get(span.file as usize)?;
            let at = floor_boundary(text, span.start as usize);
            let start = text[..at].rfind('\n').map_or(0, |n| n + 1);
            Some((at, start, text[start..].find('\n').unwrap_or(text.len() - start)))
        };
        let spans = d.primary.iter().chain(&d.secondary).map(|l| l.span);
        let long = spans.filter_map(line).any(|(_, _, length)| length > LONG_LINE);
        let primary = d.primary.as_ref().filter(|_| long)?.span;
        let (name, text) = self.files.get(primary.file as usize)?;
        let (at, start, _) = line(primary)?;
        let number = text[..start].matches('\n').count() + 1;
        Some(format!("{name}:{number}:{}", text[start..at].chars().count() + 1))
    }
}

impl std::fmt::Display for Diagnostics {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.render(false))
    }
}

impl std::error::Error for Diagnostics {}

fn to_codespan(d: &Diagnostic, files: &[(String, String)]) -> CsDiagnostic<usize> {
    let severity = match d.severity {
        Severity::Error => CsSeverity::Error,
        Severity::Warning => CsSeverity::Warning,
    };
    let place = |span: Span| -> Option<(usize, std::ops::Range<usize>)> {
        let file = span.file as usize;
        let text = &files.get(file)?.1;
        let end = floor_boundary(text, span.end as usize);
        let start = floor_boundary(text, span.start as usize).min(end);
        Some((file, start..end))
    };
    let mut cs = CsDiagnostic::new(severity).with_code(d.code).with_message(&d.message);
    if let Some((file, range)) = d.primary.as_ref().and_then(|p| place(p.span)) {
        let text = d.primary.as_ref().map_or("", |p| p.message.as_str());
        cs = cs.with_label(CsLabel::primary(file, range).with_message(text));
    }
    for s in &d.secondary {
        if let Some((file, range)) = place(s.span) {
            cs = cs.with_label(CsLabel::secondary(file, range).with_message(&s.message));
        }
    }
    if let Some(help) = &d.help {
        cs = cs.with_note(format!("help: {help}"));
    }
    cs
}

fn floor_boundary(text: &str, at: usize) -> usize {
    let mut at = at.min(text.len());
    while !text.is_char_boundary(at) {
        at -= 1;
    }
    at
}
