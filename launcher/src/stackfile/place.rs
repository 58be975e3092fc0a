//! Where in the stack file something stands, and how it is shown.

use ipc_types::stack::Severity;
use std::fmt;
use std::ops::Range;
use std::path::{Path, PathBuf};

/// Longest line of the stack file that a message repeats.
const EXCERPT_MAX: usize = 160;

/// A finding with its place in a file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Located {
    pub severity: Severity,
    pub file: PathBuf,
    /// From 1; 0 = no particular line.
    pub line: u32,
    /// From 1, in characters.
    pub column: u32,
    /// Characters of the line it is about.
    pub width: u32,
    /// The line itself.
    pub excerpt: String,
    /// What is wrong.
    pub message: String,
    /// What to do about it; may be empty.
    pub help: String,
}

impl Located {
    /// About a file as a whole.
    pub fn of_file(file: &Path, message: impl Into<String>, help: impl Into<String>) -> Self {
        Self {
            severity: Severity::Error,
            file: file.to_owned(),
            line: 0,
            column: 0,
            width: 0,
            excerpt: String::new(),
            message: message.into(),
            help: help.into(),
        }
    }

    /// `stack.toml:12:5`, or the file alone.
    pub fn place(&self) -> String {
        if self.line == 0 {
            return self.file.display().to_string();
        }
        format!("{}:{}:{}", self.file.display(), self.line, self.column)
    }

    /// For `--json`.
    pub fn json(&self) -> serde_json::Value {
        serde_json::json!({
            "severity": self.severity, "file": self.file, "line": self.line, "column": self.column,
            "message": self.message, "help": self.help,
        })
    }
}

impl fmt::Display for Located {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let label = match self.severity {
            Severity::Error => "error",
            Severity::Warning => "warning",
        };
        writeln!(f, "{label}: {}", self.message)?;
        write!(f, "  --> {}", self.place())?;
        let gutter = if self.line > 0 {
            let number = self.line.to_string();
            let pad = " ".repeat(number.len());
            let indent: String =
                self.excerpt.chars().take(self.column.saturating_sub(1) as usize).map(blank).collect();
            let mark = "^".repeat(self.width.max(1) as usize);
            write!(f, "\n{pad} |\n{number} | {}\n{pad} | {indent}{mark}", self.excerpt)?;
            pad
        } else {
            " ".to_owned()
        };
        for (i, line) in self.help.lines().enumerate() {
            write!(f, "\n{gutter} {} {line}", if i == 0 { "= help:" } else { "       " })?;
        }
        Ok(())
    }
}

/// What stands above a character so that the mark below it lines up.
fn blank(c: char) -> char {
    if c == '\t' { '\t' } else { ' ' }
}

/// The text of a stack file and where its lines begin.
pub struct Source<'a> {
    pub file: PathBuf,
    pub text: &'a str,
    starts: Vec<usize>,
}

impl<'a> Source<'a> {
    pub fn new(file: &Path, text: &'a str) -> Self {
        let starts = std::iter::once(0).chain(text.match_indices('\n').map(|(i, _)| i + 1)).collect();
        Self { file: file.to_owned(), text, starts }
    }

    /// Number of the line, from 1, that a byte of the text is in.
    pub fn line(&self, at: usize) -> u32 {
        self.starts.partition_point(|&start| start <= at) as u32
    }

    /// A finding at a range of bytes; only its first line is shown.
    pub fn located(
        &self,
        severity: Severity,
        span: &Range<usize>,
        message: impl Into<String>,
        help: impl Into<String>,
    ) -> Located {
        let at = self.text.floor_char_boundary(span.start.min(self.text.len()));
        let line = self.line(at);
        let start = self.starts.get(line as usize - 1).copied().unwrap_or(0);
        let rest = &self.text[start..];
        let full = rest.lines().next().unwrap_or("");
        let end = self.text.ceil_char_boundary(span.end.clamp(at, (start + full.len()).max(at)));
        let column = self.text[start..at].chars().count() as u32 + 1;
        let width = self.text[at..end].trim_end().chars().count().max(1) as u32;
        let mut excerpt = full.trim_end().to_owned();
        if excerpt.chars().count() > EXCERPT_MAX {
            excerpt = excerpt.chars().take(EXCERPT_MAX).collect::<String>() + " ...";
        }
        // A mark beyond the shortened line would point at nothing.
        let room = (excerpt.chars().count() as u32 + 1).saturating_sub(column).max(1);
        Located {
            severity,
            file: self.file.clone(),
            line,
            column,
            width: width.min(room),
            excerpt,
            message: message.into().trim_end().to_owned(),
            help: help.into(),
        }
    }
}

/// Collects findings about one file.
pub struct Sink<'a> {
    pub source: Source<'a>,
    pub list: Vec<Located>,
}

impl Sink<'_> {
    pub fn error(&mut self, span: &Range<usize>, message: impl Into<String>, help: impl Into<String>) {
        let item = self.source.located(Severity::Error, span, message, help);
        self.push(item);
    }

    pub fn warning(&mut self, span: &Range<usize>, message: impl Into<String>, help: impl Into<String>) {
        let item = self.source.located(Severity::Warning, span, message, help);
        self.push(item);
    }

    /// Keeps one of equal findings.
    pub fn push(&mut self, item: Located) {
        if !self.list.contains(&item) {
            self.list.push(item);
        }
    }

    pub fn has_errors(&self) -> bool {
        self.list.iter().any(|f| f.severity == Severity::Error)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_place_is_shown_with_its_line() {
        let text = "[stack]\nname = \"ü\"  # x\r\n";
        let source = Source::new(Path::new("s.toml"), text);
        let at = text.find("\"ü").unwrap();
        let shown = source.located(Severity::Error, &(at..at + 4), "bad", "do this\nor that").to_string();
        assert_eq!(
            shown,
            "error: bad\n  --> s.toml:2:8\n  |\n2 | name = \"ü\"  # x\n  |        ^^^\n  = help: do this\n          or that"
        );
    }

    #[test]
    fn any_range_has_a_place() {
        for text in ["", "\n", "a\tb\nü", "äöü"] {
            let source = Source::new(Path::new("s"), text);
            for start in 0..text.len() + 3 {
                for end in 0..text.len() + 3 {
                    let _ = source.located(Severity::Warning, &(start..end), "m", "").to_string();
                }
            }
        }
    }
}
