//! Statements.

use super::ast::{CaseArm, Expr, ExprKind, IfBranch, Stmt, StmtKind};
use super::{Parsed, Parser, Skip};
use crate::diagnostic::{Diagnostic, Span};
use crate::lexer::{Keyword, TokenKind};
use crate::limits;

/// Instruction List operators that start a line and are no names in ST by accident.
const IL_OPERATORS: &[&str] = &[
    "LD", "LDN", "ST", "STN", "S", "R", "AND", "ANDN", "OR", "ORN", "XOR", "XORN", "ADD", "SUB", "MUL",
    "DIV", "MOD", "GT", "GE", "EQ", "NE", "LE", "LT", "JMP", "JMPC", "JMPCN", "CAL", "CALC", "CALCN", "RET",
    "RETC", "RETCN", "NOT",
];

/// Tokens of a CASE label that begins with a name, at most.
const LABEL_TOKENS: usize = 32;

impl Parser<'_> {
    /// Statements up to a word that `ends` (not consumed), a POU boundary or the end of the file.
    pub(super) fn statements(&mut self, ends: &[Keyword]) -> Vec<Stmt> {
        let mut list = Vec::new();
        loop {
            match self.kind() {
                TokenKind::Eof => return list,
                TokenKind::Word(Some(k)) if ends.contains(&k) || is_outer(k) => return list,
                TokenKind::Semi => {
                    self.bump();
                }
                _ => {
                    let before = self.at;
                    match self.nested(Self::statement) {
                        Ok(s) => list.push(s),
                        Err(Skip) => {
                            if self.depth >= limits::NESTING {
                                return list;
                            }
                            self.skip_statement();
                            if self.at == before {
                                self.stray_word();
                            }
                        }
                    }
                }
            }
        }
    }

    /// A closing word that closes nothing here: step over it, so that the list goes on.
    fn stray_word(&mut self) {
        self.bump();
        self.eat(TokenKind::Semi);
    }

    fn statement(&mut self) -> Parsed<Stmt> {
        let start = self.span();
        match self.kind() {
            TokenKind::Word(Some(Keyword::If)) => self.if_statement(start),
            TokenKind::Word(Some(Keyword::Case)) => self.case_statement(start),
            TokenKind::Word(Some(Keyword::For)) => self.for_statement(start),
            TokenKind::Word(Some(Keyword::While)) => {
                self.bump();
                let cond = self.expr()?;
                self.expect_kw(Keyword::Do)?;
                let span = start.to(self.last_span());
                let id = self.statement_id(span);
                let body = self.statements(&[Keyword::EndWhile]);
                self.close(Keyword::EndWhile, start)?;
                Ok(Stmt { id, span, kind: StmtKind::While { cond, body } })
            }
            TokenKind::Word(Some(Keyword::Repeat)) => {
                self.bump();
                let id = self.statement_id(start);
                let body = self.statements(&[Keyword::Until, Keyword::EndRepeat]);
                let until_start = self.span();
                self.expect_kw(Keyword::Until)?;
                let until = self.expr()?;
                let until_id = self.statement_id(until_start.to(until.span));
                self.eat(TokenKind::Semi);
                self.close(Keyword::EndRepeat, start)?;
                Ok(Stmt { id, span: start, kind: StmtKind::Repeat { body, until, until_id } })
            }
            TokenKind::Word(Some(Keyword::Exit)) => self.word_statement(StmtKind::Exit, "EXIT"),
            TokenKind::Word(Some(Keyword::Continue)) => self.word_statement(StmtKind::Continue, "CONTINUE"),
            TokenKind::Word(Some(Keyword::Return)) => self.word_statement(StmtKind::Return, "RETURN"),
            TokenKind::Word(Some(Keyword::Super | Keyword::This)) => {
                let d =
                    Diagnostic::new("E0904", start, "object orientation (SUPER, THIS) is not supported yet");
                self.report(d);
                Err(Skip)
            }
            _ => self.simple_statement(start),
        }
    }

    fn word_statement(&mut self, kind: StmtKind, word: &str) -> Parsed<Stmt> {
        let span = self.span();
        self.bump();
        let id = self.statement_id(span);
        self.semi_or_go_on(word);
        Ok(Stmt { id, span, kind })
    }

    /// A missing `;` is reported, but the statement before it is kept.
    fn semi_or_go_on(&mut self, after: &str) {
        if self.expect_semi(after).is_err() {
            // What follows may be the next statement: it is read as one.
            let next_starts = matches!(self.kind(), TokenKind::Word(_));
            if !next_starts {
                self.skip_statement();
            }
        }
    }

    fn simple_statement(&mut self, start: Span) -> Parsed<Stmt> {
        if self.looks_like_il() {
            let d = Diagnostic::new("E0902", start, "Instruction List (IL) is not supported yet")
                .label("this is an IL instruction")
                .help("write the body in Structured Text (ST)");
            self.report(d);
            self.skip_to(|k| matches!(k, TokenKind::Word(Some(k)) if is_outer(k)));
            return Ok(Stmt { id: 0, span: start, kind: StmtKind::Empty });
        }
        let target = self.expr_statement_head()?;
        match self.kind() {
            TokenKind::Assign => {
                self.bump();
                let value = self.expr()?;
                let span = start.to(value.span);
                let id = self.statement_id(span);
                self.semi_or_go_on("the assignment");
                Ok(Stmt { id, span, kind: StmtKind::Assign { target, value } })
            }
            TokenKind::TryAssign => {
                let d =
                    Diagnostic::new("E0904", self.span(), "assignment attempt (`?=`) is not supported yet");
                self.report(d);
                Err(Skip)
            }
            TokenKind::Eq => {
                let d = Diagnostic::new("E0205", self.span(), "`=` compares; an assignment is written `:=`")
                    .help("write `:=`");
                self.report(d);
                Err(Skip)
            }
            _ if matches!(target.kind, ExprKind::Call(..)) => {
                let span = start.to(target.span);
                let id = self.statement_id(span);
                self.semi_or_go_on("the call");
                Ok(Stmt { id, span, kind: StmtKind::Call(target) })
            }
            _ if matches!(target.kind, ExprKind::Error) => {
                self.skip_statement();
                Ok(Stmt { id: 0, span: start, kind: StmtKind::Empty })
            }
            _ => self.unexpected("`:=` or a call's `(`"),
        }
    }

    fn expr_statement_head(&mut self) -> Parsed<Expr> {
        match self.kind() {
            TokenKind::Word(None) | TokenKind::Direct => self.expr_path(),
            TokenKind::Word(Some(Keyword::And | Keyword::Or | Keyword::Xor | Keyword::Mod)) => {
                self.expr_path()
            }
            TokenKind::Word(Some(k)) => {
                let d = Diagnostic::new("E0206", self.span(), format!("`{}` does not belong here", k.text()))
                    .label("expected a statement");
                self.report(d);
                Err(Skip)
            }
            _ => self.unexpected("a statement"),
        }
    }

    /// A name with its members, indices or arguments, without operators.
    fn expr_path(&mut self) -> Parsed<Expr> {
        self.path()
    }

    /// `LD x`, `ST x`, `R1 := ...` is none. Two names in a row on one line, the first an IL operator.
    fn looks_like_il(&self) -> bool {
        if !matches!(self.kind(), TokenKind::Word(_)) {
            return false;
        }
        let word = self.slice();
        if !IL_OPERATORS.iter().any(|op| word.eq_ignore_ascii_case(op)) {
            return false;
        }
        match self.peek(1) {
            TokenKind::Word(_)
            | TokenKind::Int
            | TokenKind::BasedInt
            | TokenKind::Real
            | TokenKind::Typed
            | TokenKind::Direct
            | TokenKind::Minus => true,
            _ => {
                ["RET", "RETC", "RETCN"].iter().any(|op| word.eq_ignore_ascii_case(op))
                    && self.peek(1) != TokenKind::Assign
            }
        }
    }

    fn if_statement(&mut self, start: Span) -> Parsed<Stmt> {
        let mut branches = Vec::new();
        let mut otherwise = Vec::new();
        let mut head = start;
        let mut first_span = start;
        loop {
            self.bump(); // IF or ELSIF
            let cond = match self.expr() {
                Ok(c) => c,
                Err(Skip) => {
                    self.skip_to(|k| {
                        matches!(k, TokenKind::Word(Some(Keyword::Then)) | TokenKind::Semi) || closes(k)
                    });
                    Expr { span: head, kind: ExprKind::Error }
                }
            };
            if self.expect_kw(Keyword::Then).is_err() && !matches!(self.kind(), TokenKind::Word(_)) {
                return Err(Skip);
            }
            let span = head.to(cond.span);
            if branches.is_empty() {
                first_span = span;
            }
            let id = self.statement_id(span);
            let body = self.statements(&[Keyword::Elsif, Keyword::Else, Keyword::EndIf]);
            branches.push(IfBranch { id, cond, body });
            if self.at_kw(Keyword::Elsif) {
                head = self.span();
                continue;
            }
            if self.eat_kw(Keyword::Else) {
                otherwise = self.statements(&[Keyword::EndIf]);
            }
            break;
        }
        self.close(Keyword::EndIf, start)?;
        let id = branches.first().map_or(0, |b| b.id);
        Ok(Stmt { id, span: first_span, kind: StmtKind::If { branches, otherwise } })
    }

    fn case_statement(&mut self, start: Span) -> Parsed<Stmt> {
        self.bump();
        let selector = self.expr()?;
        self.expect_kw(Keyword::Of)?;
        let span = start.to(self.last_span());
        let id = self.statement_id(span);
        let mut arms = Vec::new();
        let mut otherwise = Vec::new();
        let mut label_count = 0;
        loop {
            match self.kind() {
                TokenKind::Word(Some(Keyword::Else)) => {
                    self.bump();
                    otherwise = self.statements(&[Keyword::EndCase]);
                    break;
                }
                TokenKind::Word(Some(Keyword::EndCase)) | TokenKind::Eof => break,
                TokenKind::Word(Some(k)) if is_outer(k) => break,
                TokenKind::Semi => {
                    self.bump();
                }
                _ => match self.case_labels() {
                    Ok(labels) => {
                        label_count += labels.len();
                        let body = self.case_body();
                        arms.push(CaseArm { labels, body });
                    }
                    Err(Skip) => {
                        let before = self.at;
                        self.skip_statement();
                        if self.at == before {
                            self.bump();
                        }
                    }
                },
            }
        }
        if label_count > limits::CASE_LABELS {
            let d =
                Diagnostic::new("E0801", span, format!("CASE has more than {} labels", limits::CASE_LABELS));
            self.report(d);
        }
        self.close(Keyword::EndCase, start)?;
        Ok(Stmt { id, span, kind: StmtKind::Case { selector, arms, otherwise } })
    }

    fn case_labels(&mut self) -> Parsed<Vec<(Expr, Option<Expr>)>> {
        let mut labels = Vec::new();
        loop {
            let from = self.expr()?;
            let to = if self.eat(TokenKind::Range) { Some(self.expr()?) } else { None };
            labels.push((from, to));
            if self.eat(TokenKind::Comma) {
                continue;
            }
            self.expect(TokenKind::Colon)?;
            return Ok(labels);
        }
    }

    /// Statements of an arm: up to the next label, ELSE or END_CASE.
    fn case_body(&mut self) -> Vec<Stmt> {
        let mut list = Vec::new();
        loop {
            match self.kind() {
                TokenKind::Eof | TokenKind::Word(Some(Keyword::Else | Keyword::EndCase)) => return list,
                TokenKind::Word(Some(k)) if is_outer(k) => return list,
                TokenKind::Semi => {
                    self.bump();
                }
                _ if self.at_case_label() => return list,
                _ => {
                    let before = self.at;
                    match self.nested(Self::statement) {
                        Ok(s) => list.push(s),
                        Err(Skip) => {
                            if self.depth >= limits::NESTING {
                                return list;
                            }
                            self.skip_statement();
                            if self.at == before {
                                self.stray_word();
                            }
                        }
                    }
                }
            }
        }
    }

    /// A literal starts no statement; a name starts a label when `:`, `,` or `..` follows.
    fn at_case_label(&self) -> bool {
        match self.kind() {
            TokenKind::Int | TokenKind::BasedInt | TokenKind::Typed | TokenKind::Minus | TokenKind::Plus => {
                true
            }
            TokenKind::Word(Some(Keyword::True | Keyword::False)) => true,
            TokenKind::LParen => true,
            TokenKind::Word(None) => self.name_starts_label(),
            _ => false,
        }
    }

    /// `name:`, `name, `, `name + 1 ..`, `Color.Red:`: an expression of names and numbers before a label's end.
    fn name_starts_label(&self) -> bool {
        for ahead in 1..LABEL_TOKENS {
            match self.peek(ahead) {
                TokenKind::Colon | TokenKind::Comma | TokenKind::Range => return true,
                TokenKind::Word(None | Some(Keyword::Mod))
                | TokenKind::Dot
                | TokenKind::Int
                | TokenKind::BasedInt
                | TokenKind::Typed
                | TokenKind::Plus
                | TokenKind::Minus
                | TokenKind::Star
                | TokenKind::Slash => {}
                _ => return false,
            }
        }
        false
    }

    fn for_statement(&mut self, start: Span) -> Parsed<Stmt> {
        self.bump();
        let var = self.path()?;
        self.expect(TokenKind::Assign)?;
        let from = self.expr()?;
        self.expect_kw(Keyword::To)?;
        let to = self.expr()?;
        let by = if self.eat_kw(Keyword::By) { Some(self.expr()?) } else { None };
        self.expect_kw(Keyword::Do)?;
        let span = start.to(self.last_span());
        let id = self.statement_id(span);
        let body = self.statements(&[Keyword::EndFor]);
        self.close(Keyword::EndFor, start)?;
        Ok(Stmt { id, span, kind: StmtKind::For { var, from, to, by, body } })
    }

    /// `END_IF` and the like, with an optional `;`.
    fn close(&mut self, word: Keyword, opened: Span) -> Parsed<()> {
        if self.eat_kw(word) {
            self.eat(TokenKind::Semi);
            return Ok(());
        }
        let found = self.describe_current();
        let d = Diagnostic::new("E0207", self.span(), format!("expected `{}`, found {found}", word.text()))
            .label(format!("`{}` is missing before this", word.text()))
            .also(opened, "to close this");
        self.report(d);
        // Statements that were read are kept; the outer construct goes on from here.
        Ok(())
    }
}

/// Words that end a body whatever is open in it.
fn is_outer(k: Keyword) -> bool {
    use Keyword::*;
    matches!(
        k,
        EndProgram
            | EndFunction
            | EndFunctionBlock
            | EndAction
            | EndMethod
            | EndClass
            | EndConfiguration
            | EndResource
            | Program
            | Function
            | FunctionBlock
            | Configuration
            | EndVar
            | EndType
            | EndStep
            | EndTransition
            | Step
            | InitialStep
            | Transition
            | Action
    )
}

fn closes(k: TokenKind) -> bool {
    matches!(k, TokenKind::Word(Some(k)) if is_outer(k) || matches!(k, Keyword::EndIf | Keyword::Else | Keyword::Elsif))
}
