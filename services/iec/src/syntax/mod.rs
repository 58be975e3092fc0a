//! Tokens to tree: a hand-written recursive descent with operator precedence for expressions.
//!
//! It never gives up at the first error: a statement that cannot be read is skipped to its `;`, a declaration to
//! its `;` or `END_VAR`, anything else to the next POU. Nesting is bounded ([`crate::limits::NESTING`]).

pub mod ast;
mod config;
mod decl;
mod expr;
pub(crate) use expr::literal_diagnostic;
mod stmt;

use crate::diagnostic::{Diagnostic, Span};
use crate::lexer::{self, Keyword, Token, TokenKind};
use crate::limits;
use ast::{Ident, Unit};

/// Places of all statements by id; shared by all files of a compilation.
#[derive(Debug)]
pub struct StatementTable {
    /// Index = statement id; entry 0 is a placeholder.
    pub spans: Vec<Span>,
}

impl Default for StatementTable {
    fn default() -> Self {
        Self { spans: vec![Span::default()] }
    }
}

/// Reads one file.
pub fn parse(file: u32, text: &str, statements: &mut StatementTable) -> (Unit, Vec<Diagnostic>) {
    read(file, text, statements, false)
}

/// Reads the standard library, which may use `__NOW`.
pub(crate) fn parse_library(file: u32, statements: &mut StatementTable) -> (Unit, Vec<Diagnostic>) {
    read(file, crate::stdlib::PRELUDE, statements, true)
}

fn read(file: u32, text: &str, statements: &mut StatementTable, library: bool) -> (Unit, Vec<Diagnostic>) {
    if text.trim_start_matches(['\u{feff}', ' ', '\t', '\r', '\n']).starts_with('<') {
        let span = Span { file, start: 0, end: text.lines().next().map_or(0, str::len) as u32 };
        let d = Diagnostic::new("E0903", span, "PLCopen XML is not supported yet")
            .label("this file is XML")
            .help("give the program as Structured Text (ST)");
        return (Unit::default(), vec![d]);
    }
    let (mut tokens, diags) = lexer::lex(file, text);
    free_sfc_words(&mut tokens);
    let mut parser = Parser {
        file,
        text,
        tokens,
        at: 0,
        diags,
        depth: 0,
        expr_level: 0,
        operators: 0,
        statements,
        full: false,
        library,
    };
    let unit = parser.unit();
    let mut diags = parser.diags;
    // A comment that swallowed the rest of the file: what is missing after it is no news.
    let open =
        diags.iter().find(|d| d.code == "E0102").and_then(|d| d.primary.as_ref()).map(|p| p.span.start);
    if let Some(open) = open {
        diags.retain(|d| d.primary.as_ref().is_none_or(|p| p.span.start <= open));
    }
    let errors = diags.iter().filter(|d| d.code.starts_with('E')).count();
    if errors > limits::ERRORS_PER_FILE {
        diags.truncate(limits::ERRORS_PER_FILE);
    }
    (unit, diags)
}

/// STEP, ACTION and the like open an SFC element only before a name; everywhere else they are names themselves,
/// since many programs have a variable `step`.
fn free_sfc_words(tokens: &mut [Token]) {
    for i in 0..tokens.len().saturating_sub(1) {
        let is_name = tokens[i + 1].kind == TokenKind::Word(None);
        if let TokenKind::Word(Some(
            Keyword::Step | Keyword::InitialStep | Keyword::Transition | Keyword::Action,
        )) = tokens[i].kind
            && !is_name
        {
            tokens[i].kind = TokenKind::Word(None);
        }
    }
}

/// An error was reported; the caller skips to a place where it can go on.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Skip;

type Parsed<T> = Result<T, Skip>;

struct Parser<'a> {
    file: u32,
    text: &'a str,
    tokens: Vec<Token>,
    at: usize,
    diags: Vec<Diagnostic>,
    depth: u32,
    /// Expressions around the current one, and operators read since the outermost began.
    expr_level: u32,
    operators: usize,
    statements: &'a mut StatementTable,
    /// The statement limit was reported.
    full: bool,
    library: bool,
}

impl Parser<'_> {
    fn token(&self) -> Token {
        // The list ends with Eof and `bump` never passes it.
        self.tokens[self.at.min(self.tokens.len() - 1)]
    }

    fn kind(&self) -> TokenKind {
        self.token().kind
    }

    fn peek(&self, ahead: usize) -> TokenKind {
        self.tokens.get(self.at + ahead).map_or(TokenKind::Eof, |t| t.kind)
    }

    fn span(&self) -> Span {
        self.span_of(self.token())
    }

    fn span_of(&self, t: Token) -> Span {
        Span { file: self.file, start: t.start, end: t.end }
    }

    /// Of the token before the current one.
    fn last_span(&self) -> Span {
        self.at.checked_sub(1).map_or_else(|| self.span(), |i| self.span_of(self.tokens[i]))
    }

    fn slice(&self) -> &str {
        let t = self.token();
        self.text.get(t.start as usize..t.end as usize).unwrap_or("")
    }

    fn bump(&mut self) -> Token {
        let t = self.token();
        if t.kind != TokenKind::Eof {
            self.at += 1;
        }
        t
    }

    fn at_kw(&self, k: Keyword) -> bool {
        self.kind() == TokenKind::Word(Some(k))
    }

    fn eat_kw(&mut self, k: Keyword) -> bool {
        let hit = self.at_kw(k);
        if hit {
            self.bump();
        }
        hit
    }

    fn eat(&mut self, k: TokenKind) -> bool {
        let hit = self.kind() == k;
        if hit {
            self.bump();
        }
        hit
    }

    fn report(&mut self, d: Diagnostic) {
        if self.diags.len() <= limits::ERRORS_PER_FILE {
            self.diags.push(d);
        }
    }

    fn describe_current(&self) -> String {
        match self.kind() {
            TokenKind::Eof => "the end of the file".to_owned(),
            TokenKind::Text => "a text".to_owned(),
            _ => {
                let s = self.slice();
                let cut: String = s.chars().take(32).collect();
                format!("`{cut}`")
            }
        }
    }

    /// "expected WHAT, found ..."
    fn unexpected<T>(&mut self, what: &str) -> Parsed<T> {
        let found = self.describe_current();
        let d = Diagnostic::new("E0201", self.span(), format!("expected {what}, found {found}"))
            .label(format!("expected {what}"));
        let d = match self.habit() {
            Some(help) => d.help(help),
            None => d,
        };
        self.report(d);
        Err(Skip)
    }

    /// How what other languages write here is written in this one.
    fn habit(&self) -> Option<&'static str> {
        let sum = |k| matches!(k, TokenKind::Plus | TokenKind::Minus | TokenKind::Star | TokenKind::Slash);
        if sum(self.kind()) && self.peek(1) == TokenKind::Eq {
            return Some("write the whole assignment: `x := x + 1`");
        }
        let adjacent = self.last_span().end == self.token().start;
        let before = self.at.checked_sub(1).map(|i| self.tokens[i].kind);
        match (before, self.kind()) {
            (Some(TokenKind::Eq), TokenKind::Eq) if adjacent => Some("\"equal\" is written `=`"),
            (Some(TokenKind::Amp), TokenKind::Amp) if adjacent => Some("\"and\" is written AND or `&`"),
            (_, TokenKind::Eq) if !matches!(before, Some(TokenKind::Assign)) => {
                Some("an assignment is written `:=`")
            }
            (Some(TokenKind::Word(None)), _) => {
                let last = self.last_span();
                let word = self.text.get(last.start as usize..last.end as usize).unwrap_or("");
                ["ELSEIF", "ELIF"]
                    .iter()
                    .any(|w| word.eq_ignore_ascii_case(w))
                    .then_some("it is written ELSIF")
            }
            _ => None,
        }
    }

    fn expect(&mut self, k: TokenKind) -> Parsed<Token> {
        if self.kind() == k {
            return Ok(self.bump());
        }
        self.unexpected(&format!("`{}`", k.describe()))
    }

    fn expect_kw(&mut self, k: Keyword) -> Parsed<Token> {
        self.expect(TokenKind::Word(Some(k)))
    }

    /// A `;` that closes the construct before; where it is missing is told at the end of that construct.
    fn expect_semi(&mut self, after: &str) -> Parsed<()> {
        if self.eat(TokenKind::Semi) {
            return Ok(());
        }
        let found = self.describe_current();
        let here = self.span();
        let end = self.last_span();
        let place = Span { start: end.end.saturating_sub(1).max(end.start), ..end };
        let d = Diagnostic::new("E0202", place, format!("`;` is missing after {after}, before {found}"))
            .label("add `;` after this")
            .also(here, "found this instead");
        self.report(d);
        Err(Skip)
    }

    fn ident(&mut self, what: &str) -> Parsed<Ident> {
        match self.kind() {
            TokenKind::Word(None) => {
                let ident = Ident { text: self.slice().to_owned(), span: self.span() };
                self.bump();
                self.check_ident(&ident);
                Ok(ident)
            }
            TokenKind::Word(Some(k)) => {
                let d = Diagnostic::new(
                    "E0203",
                    self.span(),
                    format!("`{}` is a reserved word and cannot be {what}", k.text()),
                )
                .help("choose another name");
                self.report(d);
                Err(Skip)
            }
            _ => self.unexpected(what),
        }
    }

    fn check_ident(&mut self, ident: &Ident) {
        if ident.text.len() > limits::IDENT_CHARS {
            let d = Diagnostic::new(
                "E0802",
                ident.span,
                format!(
                    "name has {} characters, at most {} are allowed",
                    ident.text.len(),
                    limits::IDENT_CHARS
                ),
            );
            self.report(d);
        } else if (ident.text.contains("__") || ident.text.ends_with('_')) && !self.is_library() {
            let d = Diagnostic::new(
                "E0204",
                ident.span,
                format!("`{}`: underscores in a name stand alone and not at its end", ident.text),
            )
            .help("the standard forbids `__` and a final `_`");
            self.report(d);
        }
    }

    /// Only the standard library may use `__NOW`.
    fn is_library(&self) -> bool {
        self.library
    }

    /// Runs `f` one level deeper, or reports that the nesting is too deep.
    fn nested<T>(&mut self, f: impl FnOnce(&mut Self) -> Parsed<T>) -> Parsed<T> {
        if self.depth >= limits::NESTING {
            let d = Diagnostic::new(
                "E0801",
                self.span(),
                format!("nesting is more than {} deep", limits::NESTING),
            )
            .help("split the expression or move statements into a function");
            self.report(d);
            return Err(Skip);
        }
        self.depth += 1;
        let result = f(self);
        self.depth -= 1;
        result
    }

    /// An id for a statement at this place.
    fn statement_id(&mut self, span: Span) -> u32 {
        if self.statements.spans.len() > limits::STATEMENTS {
            if !self.full {
                self.full = true;
                let d =
                    Diagnostic::new("E0803", span, format!("more than {} statements", limits::STATEMENTS));
                self.report(d);
            }
            return 0;
        }
        self.statements.spans.push(span);
        (self.statements.spans.len() - 1) as u32
    }

    /// Skips tokens until one of these words (not consumed) or the end of the file.
    fn skip_to(&mut self, stop: impl Fn(TokenKind) -> bool) {
        while self.kind() != TokenKind::Eof && !stop(self.kind()) {
            self.bump();
        }
    }

    /// Skips past the next `;`, or to a word that starts or ends a construct.
    fn skip_statement(&mut self) {
        loop {
            match self.kind() {
                TokenKind::Eof => return,
                TokenKind::Semi => {
                    self.bump();
                    return;
                }
                TokenKind::Word(Some(k)) if is_boundary(k) => return,
                _ => {
                    self.bump();
                }
            }
        }
    }
}

/// Words at which skipping stops: they open or close a construct.
fn is_boundary(k: Keyword) -> bool {
    use Keyword::*;
    matches!(
        k,
        EndCase
            | EndConfiguration
            | EndFor
            | EndFunction
            | EndFunctionBlock
            | EndIf
            | EndProgram
            | EndRepeat
            | EndResource
            | EndStruct
            | EndType
            | EndVar
            | EndWhile
            | EndAction
            | EndStep
            | EndTransition
            | EndMethod
            | EndClass
            | EndInterface
            | EndNamespace
            | Else
            | Elsif
            | Until
            | If
            | Case
            | For
            | While
            | Repeat
            | Return
            | Exit
            | Continue
            | Program
            | Function
            | FunctionBlock
            | Configuration
            | Type
            | Var
            | VarInput
            | VarOutput
            | VarInOut
            | VarTemp
            | VarGlobal
            | VarExternal
    )
}
