//! Text on its way to a terminal: what comes from files, the wire and other processes cannot steer it.
//!
//! Control characters (ESC, BEL, DEL, C1) and the marks that turn the direction of writing round are shown as
//! `\u001b`, which is also how JSON writes them. Line ends and tabs stay, and so does every letter of every language.

use std::borrow::Cow;
use std::io::{self, IsTerminal, Write};

/// Clears the screen; what is printed next begins at its top.
const CLEAR: &str = "\x1b[H\x1b[2J";

/// Whether a character may reach a terminal as it is.
fn is_harmless(c: char) -> bool {
    let turns = matches!(c, '\u{200e}' | '\u{200f}' | '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}');
    matches!(c, '\n' | '\t') || !(c.is_control() || turns)
}

/// A text that cannot steer a terminal.
pub fn harmless(text: &str) -> Cow<'_, str> {
    cleaned(text, |_| None)
}

/// As [`harmless`], but colours stay: `ESC [ ... m` with foreground colours, bold, dim, reversed and off.
pub fn coloured(text: &str) -> Cow<'_, str> {
    cleaned(text, colour)
}

/// `keeps` says how much of a text's beginning stays although it is not harmless.
fn cleaned(text: &str, keeps: impl Fn(&str) -> Option<usize>) -> Cow<'_, str> {
    if text.chars().all(is_harmless) {
        return Cow::Borrowed(text);
    }
    let mut out = String::with_capacity(text.len() + 16);
    let mut rest = text;
    while let Some(c) = rest.chars().next() {
        let taken =
            if is_harmless(c) || rest.starts_with("\r\n") { c.len_utf8() } else { keeps(rest).unwrap_or(0) };
        if taken == 0 {
            out += &format!("\\u{:04x}", u32::from(c));
        }
        out += &rest[..taken];
        rest = &rest[taken.max(c.len_utf8())..];
    }
    Cow::Owned(out)
}

/// Length of the colour sequence at the beginning of a text.
fn colour(text: &str) -> Option<usize> {
    let body = text.strip_prefix("\x1b[")?;
    let end = body.find(|c: char| !(c.is_ascii_digit() || c == ';'))?;
    if end > 12 || !body[end..].starts_with('m') {
        return None;
    }
    let codes: Vec<&str> = body[..end].split(';').collect();
    let good = match codes.as_slice() {
        ["38", "5", _] => true,
        codes => codes.iter().all(|code| matches!(code.parse(), Ok(0 | 1 | 2 | 7 | 30..=37 | 39 | 90..=97))),
    };
    good.then_some(2 + end + 1)
}

/// A diagnostic on stderr, with a line end. That nobody reads it is no reason to fail.
pub fn say(text: &str) {
    let _ = writeln!(io::stderr(), "{}", harmless(text));
}

/// A diagnostic with colours of our own in it.
pub fn say_coloured(text: &str) {
    let _ = writeln!(io::stderr(), "{}", coloured(text));
}

/// Prints a result. A reader that went away (`| head`) is no error: the process ends quietly.
pub fn print(text: &str) {
    put(harmless(text).as_bytes());
}

/// As [`print`], on an empty screen.
pub fn print_screen(text: &str) {
    put(format!("{CLEAR}{}", harmless(text)).as_bytes());
}

fn put(bytes: &[u8]) {
    let mut out = io::stdout().lock();
    if out.write_all(bytes).and_then(|()| out.flush()).is_err() {
        std::process::exit(0);
    }
}

/// An error with its causes, `what: why: why`. Messages that hold their cause's text already are not followed by it.
pub fn error_text(error: &anyhow::Error) -> String {
    let mut text = String::new();
    for cause in error.chain() {
        let next = cause.to_string();
        if text.is_empty() {
            text = next;
        } else if !next.is_empty() && !text.contains(next.trim_end()) {
            text += ": ";
            text += &next;
        }
    }
    text
}

/// stdout for text that is written piece by piece: harmless on a terminal, untouched elsewhere.
pub struct Guarded<W: Write> {
    inner: W,
    on: bool,
    /// An unfinished line.
    line: Vec<u8>,
}

impl Guarded<io::StdoutLock<'static>> {
    pub fn stdout() -> Self {
        let out = io::stdout();
        Self { on: out.is_terminal(), inner: out.lock(), line: Vec::new() }
    }
}

impl<W: Write> Write for Guarded<W> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if !self.on {
            return self.inner.write(bytes);
        }
        self.line.extend_from_slice(bytes);
        if let Some(end) = self.line.iter().rposition(|b| *b == b'\n') {
            let whole: Vec<u8> = self.line.drain(..=end).collect();
            self.inner.write_all(harmless(&String::from_utf8_lossy(&whole)).as_bytes())?;
        }
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        self.inner.flush()
    }
}

impl<W: Write> Drop for Guarded<W> {
    fn drop(&mut self) {
        let rest = std::mem::take(&mut self.line);
        let _ = self.inner.write_all(harmless(&String::from_utf8_lossy(&rest)).as_bytes());
        let _ = self.inner.flush();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use anyhow::Context as _;
    use proptest::prelude::*;

    #[test]
    fn what_steers_a_terminal_is_shown_and_letters_stay() {
        for (text, shown) in [
            ("20 °C, 5 µs, Größe\n\tx", "20 °C, 5 µs, Größe\n\tx"),
            ("\x1b]0;title\x07", "\\u001b]0;title\\u0007"),
            ("\u{9b}2J\x7f\r", "\\u009b2J\\u007f\\u000d"),
            ("a\r\nb\rc", "a\r\nb\\u000dc"),
            ("a\u{202e}b", "a\\u202eb"),
            ("日本\u{0}", "日本\\u0000"),
        ] {
            assert_eq!(harmless(text), shown);
        }
    }

    #[test]
    fn colours_of_our_own_stay_and_nothing_else() {
        for text in ["\x1b[0m\x1b[1m\x1b[38;5;9merror\x1b[0m", "\x1b[1;7mx"] {
            assert_eq!(coloured(text), text);
        }
        for text in ["\x1b[8mhidden", "\x1b[2J", "\x1b[31", "\x1b[;m", "\x1b[1;1;1;1;1;1;1;1m", "\x1b"] {
            assert_eq!(coloured(text), harmless(text), "{text:?}");
        }
    }

    #[test]
    fn a_cause_is_told_once() {
        #[derive(Debug, thiserror::Error)]
        #[error("cannot load: {0}")]
        struct Says(#[source] io::Error);
        let inner = || io::Error::other("no such variable");
        let error = anyhow::Error::new(Says(inner())).context("scan 2");
        assert_eq!(error_text(&error), "scan 2: cannot load: no such variable");
        let error = Err::<(), _>(inner()).context("reading x").unwrap_err();
        assert_eq!(error_text(&error), "reading x: no such variable");
    }

    #[test]
    fn pieces_are_joined_before_they_are_looked_at() {
        let write = |on: bool| {
            let mut out = Vec::new();
            let mut guarded = Guarded { inner: &mut out, on, line: Vec::new() };
            for piece in [&b"\xc3"[..], b"\xbc\n\xc2", b"\x9b2J", b"\nrest\x1b"] {
                guarded.write_all(piece).unwrap();
            }
            drop(guarded);
            out
        };
        assert_eq!(String::from_utf8(write(true)).unwrap(), "ü\n\\u009b2J\nrest\\u001b");
        assert_eq!(write(false), b"\xc3\xbc\n\xc2\x9b2J\nrest\x1b");
    }

    proptest! {
        #[test]
        fn nothing_harmful_is_left(text in any::<String>()) {
            prop_assert!(harmless(&text).replace("\r\n", "").chars().all(is_harmless));
            let mut shown = coloured(&text).replace("\r\n", "");
            while let Some(at) = shown.find('\x1b') {
                let taken = colour(&shown[at..]).unwrap();
                shown.replace_range(at..at + taken, "");
            }
            prop_assert!(shown.chars().all(is_harmless));
        }
    }
}
