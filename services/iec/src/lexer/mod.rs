//! Text to tokens. Never fails: what is no token becomes a diagnostic and is left out.

mod keyword;
pub mod literal;

use logos::{FilterResult, Lexer, Logos};

pub use keyword::Keyword;

use crate::diagnostic::{Diagnostic, Span};
use crate::limits;

/// What a token is. Its text is the source's slice at its span.
#[derive(Logos, Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[logos(skip r"[ \t\r\n\f\u{feff}]+", error = LexError)]
pub enum TokenKind {
    #[regex(r"[A-Za-z_][A-Za-z0-9_]*", |lex| keyword::lookup(lex.slice()))]
    Word(Option<Keyword>),
    /// `123`, `1_000`
    #[regex(r"[0-9][0-9_]*")]
    Int,
    /// `16#FF`, `2#1010_1010`
    #[regex(r"[0-9][0-9_]*#[0-9A-Za-z_]*")]
    BasedInt,
    /// `1.5`, `1.5e-3`, `1E3`
    #[regex(r"[0-9][0-9_]*\.[0-9][0-9_]*([eE][+-]?[0-9]+)?")]
    #[regex(r"[0-9][0-9_]*[eE][+-]?[0-9]+")]
    Real,
    /// `INT#5`, `WORD#16#8001`, `T#1h2m`, `Color#Red`
    #[regex(r"[A-Za-z_][A-Za-z0-9_]*#", typed_literal)]
    Typed,
    /// `'text'` or `"text"`
    #[regex(r"'([^'$\n]|\$[^\n])*'")]
    #[regex(r#""([^"$\n]|\$[^\n])*""#)]
    Text,
    /// `%IX0.3`
    #[regex(r"%[A-Za-z0-9_*]+(\.[0-9]+)*")]
    Direct,
    #[token("(*", comment)]
    #[token("/*", comment_c)]
    #[regex(r"//[^\n]*", logos::skip, allow_greedy = true)]
    Comment,
    #[regex(r"\{[^}]*\}")]
    Pragma,
    #[token(":=")]
    Assign,
    #[token("=>")]
    Arrow,
    #[token("?=")]
    TryAssign,
    #[token("**")]
    Power,
    #[token("..")]
    Range,
    #[token("<>")]
    Ne,
    #[token("<=")]
    Le,
    #[token(">=")]
    Ge,
    #[token("<")]
    Lt,
    #[token(">")]
    Gt,
    #[token("=")]
    Eq,
    #[token("+")]
    Plus,
    #[token("-")]
    Minus,
    #[token("*")]
    Star,
    #[token("/")]
    Slash,
    #[token("&")]
    Amp,
    #[token("(")]
    LParen,
    #[token(")")]
    RParen,
    #[token("[")]
    LBracket,
    #[token("]")]
    RBracket,
    #[token(",")]
    Comma,
    #[token(";")]
    Semi,
    #[token(":")]
    Colon,
    #[token(".")]
    Dot,
    #[token("^")]
    Caret,
    /// End of the file, once.
    Eof,
}

/// Why a piece of text is no token.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum LexError {
    #[default]
    Character,
    OpenComment,
    DeepComment,
}

/// One token.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Token {
    pub kind: TokenKind,
    pub start: u32,
    pub end: u32,
}

fn comment(lex: &mut Lexer<'_, TokenKind>) -> FilterResult<(), LexError> {
    skip_comment(lex, b"(*", b"*)")
}

fn comment_c(lex: &mut Lexer<'_, TokenKind>) -> FilterResult<(), LexError> {
    skip_comment(lex, b"/*", b"*/")
}

/// Skips to the end of a comment; comments nest.
fn skip_comment(lex: &mut Lexer<'_, TokenKind>, open: &[u8], close: &[u8]) -> FilterResult<(), LexError> {
    let rest = lex.remainder().as_bytes();
    let (mut at, mut depth) = (0, 1_u32);
    while at + 1 < rest.len() {
        let pair = &rest[at..at + 2];
        if pair == close {
            depth -= 1;
            at += 2;
            if depth == 0 {
                lex.bump(at);
                return FilterResult::Skip;
            }
        } else if pair == open {
            depth += 1;
            at += 2;
            if depth > limits::COMMENT_NESTING {
                lex.bump(rest.len());
                return FilterResult::Error(LexError::DeepComment);
            }
        } else {
            at += 1;
        }
    }
    lex.bump(rest.len());
    FilterResult::Error(LexError::OpenComment)
}

/// Takes what follows `INT#`: sign, digits, letters, further `#`, one `.` between digits, sign of an exponent.
fn typed_literal(lex: &mut Lexer<'_, TokenKind>) {
    let rest = lex.remainder().as_bytes();
    let at = |i: usize| rest.get(i).copied().unwrap_or(b' ');
    if at(0).is_ascii_digit() && is_date(lex.slice().trim_end_matches('#')) {
        // 2024-01-31-12:30:15.5
        let mut i = 0;
        while at(i).is_ascii_digit() || (matches!(at(i), b'-' | b':' | b'.') && at(i + 1).is_ascii_digit()) {
            i += 1;
        }
        lex.bump(i);
        return;
    }
    let mut i = usize::from(matches!(at(0), b'+' | b'-') && at(1).is_ascii_digit());
    loop {
        let c = at(i);
        let more = c.is_ascii_alphanumeric()
            || c == b'_'
            || c == b'#'
            || (c == b'.' && i > 0 && at(i - 1).is_ascii_digit() && at(i + 1).is_ascii_digit())
            || (matches!(c, b'+' | b'-')
                && i > 1
                && matches!(at(i - 1), b'e' | b'E')
                && at(i - 2).is_ascii_digit()
                && at(i + 1).is_ascii_digit()
                && rest[..i].contains(&b'.'));
        if !more {
            break;
        }
        i += 1;
    }
    lex.bump(i);
}

/// True for the prefix of a literal that holds a date or a time of day.
pub(crate) fn is_date(prefix: &str) -> bool {
    const DATES: &[&str] = &[
        "D",
        "DATE",
        "TOD",
        "TIME_OF_DAY",
        "DT",
        "DATE_AND_TIME",
        "LD",
        "LDATE",
        "LTOD",
        "LTIME_OF_DAY",
        "LDT",
        "LDATE_AND_TIME",
    ];
    DATES.iter().any(|d| d.eq_ignore_ascii_case(prefix))
}

/// Tokens of one file, [`TokenKind::Eof`] last, and what was wrong.
pub fn lex(file: u32, text: &str) -> (Vec<Token>, Vec<Diagnostic>) {
    let mut tokens = Vec::with_capacity(text.len() / 4 + 1);
    let mut problems = Vec::new();
    let mut lexer = TokenKind::lexer(text);
    let mut bad: Option<Span> = None;
    while let Some(result) = lexer.next() {
        let range = lexer.span();
        let span = Span { file, start: range.start as u32, end: range.end as u32 };
        match result {
            Ok(TokenKind::Pragma) => problems.push(
                Diagnostic::new("W0101", span, "pragma is ignored")
                    .help("pragmas belong to other tools; nothing here acts on them"),
            ),
            Ok(kind) => tokens.push(Token { kind, start: span.start, end: span.end }),
            Err(LexError::Character) => match &mut bad {
                Some(run) if run.end == span.start => run.end = span.end,
                _ => {
                    flush_bad(&mut bad, text, &mut problems);
                    bad = Some(span);
                }
            },
            Err(LexError::OpenComment) => problems.push(
                Diagnostic::new("E0102", Span { end: span.start + 2, ..span }, "comment is never closed")
                    .label("starts here")
                    .help("comments nest: every `(*` inside needs its own `*)`"),
            ),
            Err(LexError::DeepComment) => problems.push(Diagnostic::new(
                "E0801",
                Span { end: span.start + 2, ..span },
                format!("comments are nested more than {} deep", limits::COMMENT_NESTING),
            )),
        }
        if problems.len() > limits::ERRORS_PER_FILE {
            break;
        }
    }
    flush_bad(&mut bad, text, &mut problems);
    let end = text.len() as u32;
    tokens.push(Token { kind: TokenKind::Eof, start: end, end });
    (tokens, problems)
}

fn flush_bad(bad: &mut Option<Span>, text: &str, problems: &mut Vec<Diagnostic>) {
    let Some(span) = bad.take() else { return };
    let slice = text.get(span.start as usize..span.end as usize).unwrap_or("");
    let first = slice.chars().next().unwrap_or(' ');
    let help = match first {
        '\'' | '"' => "the text is not closed on its line",
        '{' => "the pragma is never closed with `}`",
        '%' => "an address is written like %IX0.3 or %QW2",
        '!' if text[span.start as usize..].starts_with("!=") => "\"not equal\" is written `<>`",
        '!' | '~' => "\"not\" is written NOT",
        '|' => "\"or\" is written OR",
        c if !c.is_ascii() => "outside comments and texts only ASCII is allowed",
        _ => "remove it",
    };
    let shown: String = slice.chars().take(16).flat_map(char::escape_default).collect();
    problems.push(Diagnostic::new("E0101", span, format!("`{shown}` does not belong here")).help(help));
}

impl TokenKind {
    /// As a message names it.
    pub fn describe(self) -> &'static str {
        match self {
            Self::Word(Some(k)) => k.text(),
            Self::Word(None) => "a name",
            Self::Int | Self::BasedInt => "an integer",
            Self::Real => "a real number",
            Self::Typed => "a typed literal",
            Self::Text => "a text",
            Self::Direct => "an address",
            Self::Comment => "a comment",
            Self::Pragma => "a pragma",
            Self::Assign => ":=",
            Self::Arrow => "=>",
            Self::TryAssign => "?=",
            Self::Power => "**",
            Self::Range => "..",
            Self::Ne => "<>",
            Self::Le => "<=",
            Self::Ge => ">=",
            Self::Lt => "<",
            Self::Gt => ">",
            Self::Eq => "=",
            Self::Plus => "+",
            Self::Minus => "-",
            Self::Star => "*",
            Self::Slash => "/",
            Self::Amp => "&",
            Self::LParen => "(",
            Self::RParen => ")",
            Self::LBracket => "[",
            Self::RBracket => "]",
            Self::Comma => ",",
            Self::Semi => ";",
            Self::Colon => ":",
            Self::Dot => ".",
            Self::Caret => "^",
            Self::Eof => "end of file",
        }
    }
}
