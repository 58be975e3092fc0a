//! A page that is drawn again and again in its place.

use crate::terminal::coloured;
use std::io::{Stdout, Write};

/// The terminal's second screen; left when dropped, whatever happens.
pub struct Page(Stdout);

impl Page {
    pub fn open() -> Self {
        let page = Self(std::io::stdout());
        page.put("\x1b[?1049h\x1b[?25l\x1b[2J");
        page
    }

    /// Shows these lines, as many as there is room for.
    pub fn draw(&self, lines: &[String]) {
        // Some terminals say 0 when they do not know.
        let known = ratatui::crossterm::terminal::size().ok().map(|(_, rows)| usize::from(rows));
        let rows = known.filter(|rows| *rows >= 2).unwrap_or(24);
        let mut text = String::from("\x1b[H");
        let (shown, more) =
            if lines.len() > rows { (rows - 1, lines.len() - rows + 1) } else { (lines.len(), 0) };
        for (i, line) in lines[..shown].iter().enumerate() {
            if i > 0 {
                text.push_str("\r\n");
            }
            text.push_str(&coloured(line));
            text.push_str("\x1b[K");
        }
        if more > 0 {
            text += &format!("\r\n... {more} lines more\x1b[K");
        }
        text.push_str("\x1b[J");
        self.put(&text);
    }

    /// A terminal that is gone is no reason to fail: the command ends with its signal.
    fn put(&self, text: &str) {
        let mut out = self.0.lock();
        let _ = out.write_all(text.as_bytes()).and_then(|()| out.flush());
    }
}

impl Drop for Page {
    fn drop(&mut self) {
        self.put("\x1b[?25h\x1b[?1049l");
    }
}
