//! Expressions: operator precedence by the standard's table 71, lowest first.
//!
//! `OR` < `XOR` < `AND &` < `= <>` < `< > <= >=` < `+ -` < `* / MOD` < `**` < unary `- NOT`.

use super::ast::{Arg, Binary, Expr, ExprKind, Ident, Unary};
use super::{Parsed, Parser, Skip};
use crate::diagnostic::{Diagnostic, Span};
use crate::lexer::literal::{self, LiteralError};
use crate::lexer::{Keyword, TokenKind};
use crate::limits;

impl Parser<'_> {
    pub(super) fn expr(&mut self) -> Parsed<Expr> {
        if self.expr_level == 0 {
            self.operators = 0;
        }
        self.expr_level += 1;
        let result = self.nested(|p| p.binary(0));
        self.expr_level -= 1;
        result
    }

    fn binary_operator(&self) -> Option<(Binary, u8)> {
        Some(match self.kind() {
            TokenKind::Word(Some(Keyword::Or)) => (Binary::Or, 1),
            TokenKind::Word(Some(Keyword::OrElse)) => (Binary::OrElse, 1),
            TokenKind::Word(Some(Keyword::Xor)) => (Binary::Xor, 2),
            TokenKind::Word(Some(Keyword::And)) | TokenKind::Amp => (Binary::And, 3),
            TokenKind::Word(Some(Keyword::AndThen)) => (Binary::AndThen, 3),
            TokenKind::Eq => (Binary::Eq, 4),
            TokenKind::Ne => (Binary::Ne, 4),
            TokenKind::Lt => (Binary::Lt, 5),
            TokenKind::Gt => (Binary::Gt, 5),
            TokenKind::Le => (Binary::Le, 5),
            TokenKind::Ge => (Binary::Ge, 5),
            TokenKind::Plus => (Binary::Add, 6),
            TokenKind::Minus => (Binary::Sub, 6),
            TokenKind::Star => (Binary::Mul, 7),
            TokenKind::Slash => (Binary::Div, 7),
            TokenKind::Word(Some(Keyword::Mod)) => (Binary::Mod, 7),
            TokenKind::Power => (Binary::Power, 8),
            _ => return None,
        })
    }

    /// Left-associative chain of operators that bind tighter than `floor`.
    fn binary(&mut self, floor: u8) -> Parsed<Expr> {
        let mut left = self.unary()?;
        while let Some((op, level)) = self.binary_operator() {
            if level <= floor {
                break;
            }
            let op_span = self.span();
            self.bump();
            let right = self.nested(|p| p.binary(level))?;
            let span = left.span.to(right.span);
            left = Expr { span, kind: ExprKind::Binary(op, Box::new(left), Box::new(right), op_span) };
            // Trees as deep as a long chain are walked by recursion later.
            self.operators += 1;
            if self.operators > limits::OPERATORS {
                let d = Diagnostic::new(
                    "E0801",
                    op_span,
                    format!("more than {} operators in one expression", limits::OPERATORS),
                )
                .help("split the expression with a variable");
                self.report(d);
                return Err(Skip);
            }
        }
        Ok(left)
    }

    fn unary(&mut self) -> Parsed<Expr> {
        let op = match self.kind() {
            TokenKind::Minus => Unary::Neg,
            TokenKind::Plus => Unary::Plus,
            TokenKind::Word(Some(Keyword::Not)) => Unary::Not,
            _ => return self.postfix(),
        };
        let start = self.span();
        self.bump();
        let operand = self.nested(|p| p.unary())?;
        let span = start.to(operand.span);
        if let (Unary::Neg, ExprKind::Int(v)) = (op, &operand.kind)
            && *v > 0
        {
            return Ok(Expr { span, kind: ExprKind::Int(-v) });
        }
        Ok(Expr { span, kind: ExprKind::Unary(op, Box::new(operand)) })
    }

    fn postfix(&mut self) -> Parsed<Expr> {
        let mut e = self.primary()?;
        let mut links = 0;
        loop {
            links += 1;
            if links > limits::NESTING {
                let d = Diagnostic::new(
                    "E0801",
                    self.span(),
                    format!("path has more than {} parts", limits::NESTING),
                );
                self.report(d);
                return Err(Skip);
            }
            match self.kind() {
                TokenKind::Dot => {
                    self.bump();
                    if matches!(self.kind(), TokenKind::Int | TokenKind::Direct) {
                        let span = e.span.to(self.span());
                        let d = Diagnostic::new(
                            "E0904",
                            span,
                            "access to a part of a variable (`w.3`, `w.%X3`) is not supported yet",
                        )
                        .help("use a mask: (w AND 16#0008) <> 0, or SHR");
                        self.report(d);
                        self.bump();
                        e = Expr { span, kind: ExprKind::Error };
                        continue;
                    }
                    let field = self.ident("a member name")?;
                    let span = e.span.to(field.span);
                    e = Expr { span, kind: ExprKind::Field(Box::new(e), field) };
                }
                TokenKind::LBracket => {
                    self.bump();
                    let mut indices = vec![self.expr()?];
                    while self.eat(TokenKind::Comma) {
                        indices.push(self.expr()?);
                    }
                    self.expect(TokenKind::RBracket)?;
                    let span = e.span.to(self.last_span());
                    e = Expr { span, kind: ExprKind::Index(Box::new(e), indices) };
                }
                TokenKind::LParen if is_path(&e) => {
                    let args = self.args()?;
                    let span = e.span.to(self.last_span());
                    e = Expr { span, kind: ExprKind::Call(Box::new(e), args) };
                }
                TokenKind::Caret => {
                    let span = e.span.to(self.span());
                    self.bump();
                    let d = Diagnostic::new("E0904", span, "references (`^`) are not supported yet");
                    self.report(d);
                    e = Expr { span, kind: ExprKind::Error };
                }
                _ => return Ok(e),
            }
        }
    }

    /// `( a, name := b, out => c )`
    pub(super) fn args(&mut self) -> Parsed<Vec<Arg>> {
        self.expect(TokenKind::LParen)?;
        let mut args = Vec::new();
        if self.eat(TokenKind::RParen) {
            return Ok(args);
        }
        loop {
            args.push(self.arg()?);
            if args.len() > limits::CHAIN {
                let d =
                    Diagnostic::new("E0801", self.span(), format!("more than {} parameters", limits::CHAIN));
                self.report(d);
                return Err(Skip);
            }
            if self.eat(TokenKind::Comma) {
                continue;
            }
            self.expect(TokenKind::RParen)?;
            return Ok(args);
        }
    }

    fn arg(&mut self) -> Parsed<Arg> {
        let start = self.span();
        let is_word = |k| matches!(k, TokenKind::Word(_));
        let negated = self.at_kw(Keyword::Not) && is_word(self.peek(1)) && self.peek(2) == TokenKind::Arrow;
        let names = |k| matches!(k, TokenKind::Assign | TokenKind::Arrow);
        if negated {
            self.bump();
        }
        if !(is_word(self.kind()) && names(self.peek(1))) {
            let value = self.expr()?;
            return Ok(Arg {
                name: None,
                output: false,
                negated: false,
                span: value.span,
                value: Some(value),
            });
        }
        let name = self.ident("a parameter name")?;
        let output = self.kind() == TokenKind::Arrow;
        self.bump();
        if output && matches!(self.kind(), TokenKind::Comma | TokenKind::RParen) {
            return Ok(Arg {
                name: Some(name),
                output,
                negated,
                value: None,
                span: start.to(self.last_span()),
            });
        }
        let value = self.expr()?;
        Ok(Arg { name: Some(name), output, negated, span: start.to(value.span), value: Some(value) })
    }

    fn primary(&mut self) -> Parsed<Expr> {
        let span = self.span();
        let kind = match self.kind() {
            TokenKind::LParen => {
                self.bump();
                let mut inner = self.expr()?;
                self.expect(TokenKind::RParen)?;
                inner.span = span.to(self.last_span());
                return Ok(inner);
            }
            TokenKind::Int | TokenKind::BasedInt => {
                let value = literal::integer(self.slice());
                self.bump();
                value.map_or_else(|e| self.bad_literal(span, e), ExprKind::Int)
            }
            TokenKind::Real => {
                let value = literal::real_text(self.slice());
                self.bump();
                value.map_or_else(|e| self.bad_literal(span, e), ExprKind::Real)
            }
            TokenKind::Typed => {
                let (prefix, rest) = self.slice().split_once('#').unwrap_or(("", ""));
                let prefix_span = Span { end: span.start + prefix.len() as u32, ..span };
                let kind =
                    ExprKind::Typed(Ident { text: prefix.to_owned(), span: prefix_span }, rest.to_owned());
                self.bump();
                kind
            }
            TokenKind::Text => {
                self.bump();
                ExprKind::Text
            }
            TokenKind::Direct => {
                let text = self.slice().to_owned();
                self.bump();
                ExprKind::Direct(text)
            }
            TokenKind::Word(Some(Keyword::True)) => {
                self.bump();
                ExprKind::Bool(true)
            }
            TokenKind::Word(Some(Keyword::False)) => {
                self.bump();
                ExprKind::Bool(false)
            }
            // Function forms of operators: AND(a, b), MOD(a, b).
            TokenKind::Word(Some(Keyword::And | Keyword::Or | Keyword::Xor | Keyword::Mod))
                if self.peek(1) == TokenKind::LParen =>
            {
                let name = Ident { text: self.slice().to_owned(), span };
                self.bump();
                ExprKind::Name(name)
            }
            TokenKind::Word(Some(k @ (Keyword::This | Keyword::Super | Keyword::Null))) => {
                self.bump();
                let d = Diagnostic::new("E0904", span, format!("{} is not supported yet", k.text()));
                self.report(d);
                ExprKind::Error
            }
            TokenKind::Word(_) => ExprKind::Name(self.ident("an expression")?),
            _ => return self.unexpected("an expression"),
        };
        Ok(Expr { span, kind })
    }

    fn bad_literal(&mut self, span: Span, e: LiteralError) -> ExprKind {
        let d = literal_diagnostic(span, e);
        self.report(d);
        ExprKind::Error
    }
}

/// The diagnostic for a literal without value.
pub(crate) fn literal_diagnostic(span: Span, e: LiteralError) -> Diagnostic {
    match e {
        LiteralError::Form(text) => Diagnostic::new("E0103", span, text),
        LiteralError::TooLarge => {
            Diagnostic::new("E0104", span, "the value does not fit the largest type there is for it")
        }
    }
}

fn is_path(e: &Expr) -> bool {
    matches!(e.kind, ExprKind::Name(_) | ExprKind::Field(..) | ExprKind::Index(..))
}

impl Parser<'_> {
    /// A name with members, indices, arguments.
    pub(super) fn path(&mut self) -> Parsed<Expr> {
        self.postfix()
    }
}
