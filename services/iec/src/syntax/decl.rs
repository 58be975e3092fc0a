//! Declarations: POUs, variables, types.

use super::ast::{
    Expr, Ident, Init, Pou, PouKind, Section, TypeDecl, TypeSpec, TypeSpecKind, Unit, VarBlock, VarDecl,
};
use super::{Parsed, Parser, Skip, is_boundary};
use crate::diagnostic::{Diagnostic, Span};
use crate::lexer::{Keyword, TokenKind};
use crate::limits;

impl Parser<'_> {
    pub(super) fn unit(&mut self) -> Unit {
        let mut unit = Unit::default();
        let mut reported = false;
        loop {
            let start = self.span();
            let TokenKind::Word(Some(word)) = self.kind() else {
                if self.kind() == TokenKind::Eof {
                    return unit;
                }
                if !reported {
                    let _ = self.unexpected::<()>(
                        "PROGRAM, FUNCTION, FUNCTION_BLOCK, TYPE, VAR_GLOBAL or CONFIGURATION",
                    );
                    reported = true;
                }
                self.bump();
                continue;
            };
            match word {
                Keyword::Program => self.pou(PouKind::Program, &mut unit),
                Keyword::Function => self.pou(PouKind::Function, &mut unit),
                Keyword::FunctionBlock => self.pou(PouKind::FunctionBlock, &mut unit),
                Keyword::Type => self.types(&mut unit),
                Keyword::VarGlobal => unit.globals.extend(self.var_block()),
                Keyword::Configuration => unit.configurations.extend(self.configuration()),
                Keyword::Class
                | Keyword::Interface
                | Keyword::Namespace
                | Keyword::Using
                | Keyword::Method => {
                    let d = Diagnostic::new("E0904", start, format!("{} is not supported yet", word.text()));
                    self.report(d);
                    self.bump();
                    let end = match word {
                        Keyword::Class => Some(Keyword::EndClass),
                        Keyword::Interface => Some(Keyword::EndInterface),
                        Keyword::Method => Some(Keyword::EndMethod),
                        _ => None,
                    };
                    match end {
                        Some(end) => {
                            self.skip_to(|k| k == TokenKind::Word(Some(end)));
                            self.bump();
                        }
                        None => self.skip_to(is_top),
                    }
                }
                Keyword::EndNamespace => {
                    self.bump();
                }
                _ => {
                    if !reported {
                        let _ = self.unexpected::<()>(
                            "PROGRAM, FUNCTION, FUNCTION_BLOCK, TYPE, VAR_GLOBAL or CONFIGURATION",
                        );
                    }
                    self.bump();
                    self.skip_to(is_top);
                    continue;
                }
            }
            reported = false;
        }
    }

    fn pou(&mut self, kind: PouKind, unit: &mut Unit) {
        let opened = self.span();
        self.bump();
        let first = self.statements.spans.len() as u32;
        let Ok(name) = self.ident(&format!("the name of the {}", kind.keyword())) else {
            self.skip_to(is_pou_end);
            self.bump();
            return;
        };
        let mut returns = None;
        if kind == PouKind::Function && self.eat(TokenKind::Colon) {
            returns = self.type_spec().ok();
        }
        for word in [Keyword::Extends, Keyword::Implements] {
            if self.at_kw(word) {
                let d =
                    Diagnostic::new("E0904", self.span(), format!("{} is not supported yet", word.text()));
                self.report(d);
                self.skip_to(|k| matches!(k, TokenKind::Word(Some(k)) if is_boundary(k)));
            }
        }
        self.eat(TokenKind::Semi);
        let mut blocks = Vec::new();
        while let TokenKind::Word(Some(word)) = self.kind() {
            match word {
                Keyword::Var
                | Keyword::VarInput
                | Keyword::VarOutput
                | Keyword::VarInOut
                | Keyword::VarTemp
                | Keyword::VarExternal
                | Keyword::VarGlobal => blocks.extend(self.var_block()),
                Keyword::VarAccess | Keyword::VarConfig => self.unsupported_section(word),
                Keyword::Method => {
                    let d = Diagnostic::new("E0904", self.span(), "METHOD is not supported yet");
                    self.report(d);
                    self.skip_to(|k| k == TokenKind::Word(Some(Keyword::EndMethod)));
                    self.bump();
                }
                _ => break,
            }
        }
        let end_word = match kind {
            PouKind::Program => Keyword::EndProgram,
            PouKind::Function => Keyword::EndFunction,
            PouKind::FunctionBlock => Keyword::EndFunctionBlock,
        };
        let body = self.pou_body(end_word);
        let end = self.span();
        if !self.eat_kw(end_word) {
            let found = self.describe_current();
            let d = Diagnostic::new("E0207", end, format!("expected `{}`, found {found}", end_word.text()))
                .label(format!("`{}` is missing before this", end_word.text()))
                .also(opened, format!("to close {} {}", kind.keyword(), name.text));
            self.report(d);
            self.skip_to(is_top);
        }
        self.eat(TokenKind::Semi);
        let stmts = (first, self.statements.spans.len() as u32);
        unit.pous.push(Pou { kind, name, returns, blocks, body, stmts, end });
    }

    /// Statements; SFC and actions are reported once and skipped.
    fn pou_body(&mut self, end_word: Keyword) -> Vec<super::ast::Stmt> {
        let mut body = Vec::new();
        loop {
            body.append(&mut self.statements(&[end_word]));
            let TokenKind::Word(Some(word)) = self.kind() else { return body };
            match word {
                Keyword::Step | Keyword::InitialStep | Keyword::Transition | Keyword::Action => {
                    let d = Diagnostic::new(
                        "E0902",
                        self.span(),
                        "Sequential Function Chart (SFC) is not supported yet",
                    )
                    .label("this is an SFC element")
                    .help("write the sequence in Structured Text, for example as a CASE over a step number");
                    self.report(d);
                    self.skip_to(|k| k == TokenKind::Word(Some(end_word)) || is_top(k));
                    return body;
                }
                k if k == end_word => return body,
                k if is_top(TokenKind::Word(Some(k))) || is_pou_end(TokenKind::Word(Some(k))) => return body,
                k => {
                    let d =
                        Diagnostic::new("E0206", self.span(), format!("`{}` does not belong here", k.text()));
                    self.report(d);
                    self.bump();
                    self.eat(TokenKind::Semi);
                }
            }
        }
    }

    pub(super) fn unsupported_section(&mut self, word: Keyword) {
        let d = Diagnostic::new("E0904", self.span(), format!("{} is not supported yet", word.text()));
        self.report(d);
        self.skip_to(|k| k == TokenKind::Word(Some(Keyword::EndVar)) || is_top(k));
        self.eat_kw(Keyword::EndVar);
    }

    /// `VAR_xxx [CONSTANT] [RETAIN] ... END_VAR`
    pub(super) fn var_block(&mut self) -> Option<VarBlock> {
        let start = self.span();
        let section = match self.kind() {
            TokenKind::Word(Some(Keyword::Var)) => Section::Var,
            TokenKind::Word(Some(Keyword::VarInput)) => Section::Input,
            TokenKind::Word(Some(Keyword::VarOutput)) => Section::Output,
            TokenKind::Word(Some(Keyword::VarInOut)) => Section::InOut,
            TokenKind::Word(Some(Keyword::VarTemp)) => Section::Temp,
            TokenKind::Word(Some(Keyword::VarGlobal)) => Section::Global,
            TokenKind::Word(Some(Keyword::VarExternal)) => Section::External,
            _ => return None,
        };
        self.bump();
        let mut block = VarBlock { section, constant: false, retain: None, vars: Vec::new(), span: start };
        loop {
            match self.kind() {
                TokenKind::Word(Some(Keyword::Constant)) => block.constant = true,
                TokenKind::Word(Some(Keyword::Retain)) => block.retain = Some(self.span()),
                TokenKind::Word(Some(Keyword::NonRetain)) => {}
                TokenKind::Word(None)
                    if ["PUBLIC", "PRIVATE", "PROTECTED", "INTERNAL"]
                        .iter()
                        .any(|w| self.slice().eq_ignore_ascii_case(w))
                        && matches!(self.peek(1), TokenKind::Word(_)) =>
                {
                    let d = Diagnostic::new("E0904", self.span(), "access specifiers are not supported yet");
                    self.report(d);
                }
                TokenKind::Word(None)
                    if self.slice().eq_ignore_ascii_case("PERSISTENT")
                        && matches!(self.peek(1), TokenKind::Word(_)) =>
                {
                    let d = Diagnostic::new("E0904", self.span(), "PERSISTENT is not supported")
                        .help("RETAIN keeps variables over restarts and while the power is off");
                    self.report(d);
                }
                _ => break,
            }
            self.bump();
        }
        while !self.at_kw(Keyword::EndVar) {
            if self.kind() == TokenKind::Eof
                || is_top(self.kind())
                || is_pou_end(self.kind())
                || is_section(self.kind())
            {
                break;
            }
            let before = self.at;
            match self.var_decl() {
                Ok(v) => block.vars.push(v),
                Err(Skip) => self.skip_declaration(before),
            }
        }
        if !self.eat_kw(Keyword::EndVar) {
            let found = self.describe_current();
            let d = Diagnostic::new("E0207", self.span(), format!("expected `END_VAR`, found {found}"))
                .label("`END_VAR` is missing before this")
                .also(start, format!("to close {}", section.keyword()));
            self.report(d);
        }
        self.eat(TokenKind::Semi);
        Some(block)
    }

    /// Skips to the next declaration; at least one token further than `before`.
    fn skip_declaration(&mut self, before: usize) {
        let stop = |k| {
            matches!(k, TokenKind::Semi | TokenKind::Word(Some(Keyword::EndVar | Keyword::EndStruct)))
                || is_top(k)
                || is_pou_end(k)
                || is_section(k)
        };
        self.skip_to(stop);
        self.eat(TokenKind::Semi);
        if self.at == before {
            self.bump();
        }
    }

    fn var_decl(&mut self) -> Parsed<VarDecl> {
        let mut names = vec![self.ident("a variable name")?];
        while self.eat(TokenKind::Comma) {
            names.push(self.ident("a variable name")?);
        }
        let mut at = None;
        if self.eat_kw(Keyword::At) {
            if self.kind() != TokenKind::Direct {
                return self.unexpected("an address like %IX0.0");
            }
            at = Some(Ident { text: self.slice().to_owned(), span: self.span() });
            self.bump();
        }
        self.expect(TokenKind::Colon)?;
        let spec = self.type_spec()?;
        let init = if self.eat(TokenKind::Assign) { Some(self.init()?) } else { None };
        if let TokenKind::Word(Some(k @ (Keyword::REdge | Keyword::FEdge))) = self.kind() {
            let d = Diagnostic::new("E0904", self.span(), format!("{} is not supported yet", k.text()))
                .help("use an R_TRIG or F_TRIG instance");
            self.report(d);
            self.bump();
        }
        let _ = self.expect_semi("the declaration");
        Ok(VarDecl { names, at, spec, init })
    }

    pub(super) fn type_spec(&mut self) -> Parsed<TypeSpec> {
        self.nested(Self::type_spec_inner)
    }

    fn type_spec_inner(&mut self) -> Parsed<TypeSpec> {
        let start = self.span();
        let kind = match self.kind() {
            TokenKind::Word(Some(Keyword::Array)) => self.array_spec()?,
            TokenKind::Word(Some(Keyword::Struct)) => {
                self.bump();
                if self.eat_kw(Keyword::Overlap) {
                    let d = Diagnostic::new("E0904", self.last_span(), "STRUCT OVERLAP is not supported yet");
                    self.report(d);
                }
                let mut fields = Vec::new();
                while !self.at_kw(Keyword::EndStruct) {
                    if self.kind() == TokenKind::Eof || is_top(self.kind()) || self.at_kw(Keyword::EndType) {
                        break;
                    }
                    let before = self.at;
                    match self.var_decl() {
                        Ok(v) => fields.push(v),
                        Err(Skip) => self.skip_declaration(before),
                    }
                }
                self.expect_kw(Keyword::EndStruct)?;
                TypeSpecKind::Struct(fields)
            }
            TokenKind::LParen => {
                let values = self.enum_spec()?;
                // (red, green) INT
                match self.kind() {
                    TokenKind::Word(None) => {
                        let base = self.ident("a type")?;
                        self.enum_base(&base, values)
                    }
                    _ => values,
                }
            }
            TokenKind::Word(Some(Keyword::RefTo)) => {
                let d = Diagnostic::new("E0904", start, "references (REF_TO) are not supported yet");
                self.report(d);
                self.bump();
                self.type_spec()?;
                TypeSpecKind::Error
            }
            _ => {
                let name = self.ident("a type")?;
                if self.at_kw(Keyword::To) && is_pointer(&name.text) {
                    self.bump();
                    self.type_spec()?;
                    TypeSpecKind::Named(name)
                } else if self.kind() == TokenKind::LParen && is_string(&name.text) {
                    self.skip_to(|k| matches!(k, TokenKind::RParen | TokenKind::Semi));
                    self.eat(TokenKind::RParen);
                    TypeSpecKind::Named(name)
                } else if self.kind() == TokenKind::LParen && self.at_enum_values() {
                    // INT (red := 1, green := 5)
                    let values = self.enum_spec()?;
                    self.enum_base(&name, values)
                } else if self.kind() == TokenKind::LParen {
                    self.bump();
                    let lo = self.expr()?;
                    self.expect(TokenKind::Range)?;
                    let hi = self.expr()?;
                    self.expect(TokenKind::RParen)?;
                    TypeSpecKind::Subrange { base: name, lo: Box::new(lo), hi: Box::new(hi) }
                } else if self.kind() == TokenKind::LBracket && is_string(&name.text) {
                    self.skip_to(|k| matches!(k, TokenKind::RBracket | TokenKind::Semi));
                    self.eat(TokenKind::RBracket);
                    TypeSpecKind::Named(name)
                } else {
                    TypeSpecKind::Named(name)
                }
            }
        };
        Ok(TypeSpec { kind, span: start.to(self.last_span()) })
    }

    /// At `(name,`, `(name :=` or `(name)`: values, no bounds.
    fn at_enum_values(&self) -> bool {
        self.peek(1) == TokenKind::Word(None)
            && matches!(self.peek(2), TokenKind::Assign | TokenKind::Comma | TokenKind::RParen)
    }

    /// Enumerations are INT; said aloud it changes nothing, another type is refused.
    fn enum_base(&mut self, base: &Ident, values: TypeSpecKind) -> TypeSpecKind {
        if base.text.eq_ignore_ascii_case("INT") {
            return values;
        }
        let text = format!("an enumeration of type {} is not supported: enumerations are INT", base.text);
        self.report(Diagnostic::new("E0905", base.span, text).help("leave the type out, or write INT"));
        TypeSpecKind::Error
    }

    fn array_spec(&mut self) -> Parsed<TypeSpecKind> {
        self.bump();
        self.expect(TokenKind::LBracket)?;
        let mut dims: Vec<(Expr, Expr)> = Vec::new();
        loop {
            if self.kind() == TokenKind::Star {
                let d = Diagnostic::new(
                    "E0904",
                    self.span(),
                    "arrays of variable length (`*`) are not supported yet",
                );
                self.report(d);
                return Err(Skip);
            }
            let lo = self.expr()?;
            self.expect(TokenKind::Range)?;
            let hi = self.expr()?;
            dims.push((lo, hi));
            if dims.len() > limits::ARRAY_DIMS {
                let d = Diagnostic::new(
                    "E0801",
                    self.last_span(),
                    format!("more than {} dimensions", limits::ARRAY_DIMS),
                );
                self.report(d);
                return Err(Skip);
            }
            if !self.eat(TokenKind::Comma) {
                break;
            }
        }
        self.expect(TokenKind::RBracket)?;
        self.expect_kw(Keyword::Of)?;
        let of = Box::new(self.type_spec()?);
        Ok(TypeSpecKind::Array { dims, of })
    }

    fn enum_spec(&mut self) -> Parsed<TypeSpecKind> {
        self.bump();
        let mut values = Vec::new();
        loop {
            let name = self.ident("the name of a value")?;
            let value = if self.eat(TokenKind::Assign) { Some(self.expr()?) } else { None };
            values.push((name, value));
            if values.len() > limits::CHAIN {
                let d =
                    Diagnostic::new("E0801", self.last_span(), format!("more than {} values", limits::CHAIN));
                self.report(d);
                return Err(Skip);
            }
            if !self.eat(TokenKind::Comma) {
                break;
            }
        }
        self.expect(TokenKind::RParen)?;
        Ok(TypeSpecKind::Enum(values))
    }

    /// Initial value after `:=`.
    pub(super) fn init(&mut self) -> Parsed<Init> {
        self.nested(Self::init_inner)
    }

    fn init_inner(&mut self) -> Parsed<Init> {
        let start = self.span();
        if self.eat(TokenKind::LBracket) {
            let mut items = Vec::new();
            while self.kind() != TokenKind::RBracket {
                items.push(self.array_item()?);
                if !self.eat(TokenKind::Comma) {
                    break;
                }
            }
            self.expect(TokenKind::RBracket)?;
            return Ok(Init::Array(items, start.to(self.last_span())));
        }
        let structured = self.kind() == TokenKind::LParen
            && matches!(self.peek(1), TokenKind::Word(_))
            && self.peek(2) == TokenKind::Assign;
        if structured {
            self.bump();
            let mut members = Vec::new();
            loop {
                let name = self.ident("a member name")?;
                self.expect(TokenKind::Assign)?;
                members.push((name, self.init()?));
                if !self.eat(TokenKind::Comma) {
                    break;
                }
            }
            self.expect(TokenKind::RParen)?;
            return Ok(Init::Struct(members, start.to(self.last_span())));
        }
        Ok(Init::Expr(self.expr()?))
    }

    /// `5`, `3(0)`, `2([1, 2])`
    fn array_item(&mut self) -> Parsed<(Option<Expr>, Init)> {
        // Only numbers repeat: a name before a parenthesis is a call.
        let repeated =
            matches!(self.kind(), TokenKind::Int | TokenKind::BasedInt) && self.peek(1) == TokenKind::LParen;
        if !repeated {
            return Ok((None, self.init()?));
        }
        let span = self.span();
        let count = self.primary_literal()?;
        self.expect(TokenKind::LParen)?;
        if self.eat(TokenKind::RParen) {
            // `3()` is three times the type's own initial value.
            return Ok((Some(count), Init::Struct(Vec::new(), span.to(self.last_span()))));
        }
        let value = self.init()?;
        self.expect(TokenKind::RParen)?;
        Ok((Some(count), value))
    }

    fn types(&mut self, unit: &mut Unit) {
        let opened = self.span();
        self.bump();
        while !self.at_kw(Keyword::EndType) {
            if self.kind() == TokenKind::Eof || is_top(self.kind()) || is_pou_end(self.kind()) {
                break;
            }
            let before = self.at;
            match self.type_decl() {
                Ok(t) => unit.types.push(t),
                Err(Skip) => {
                    self.skip_to(|k| {
                        matches!(k, TokenKind::Semi | TokenKind::Word(Some(Keyword::EndType)))
                            || is_top(k)
                            || is_pou_end(k)
                    });
                    self.eat(TokenKind::Semi);
                    if self.at == before {
                        self.bump();
                    }
                }
            }
        }
        if !self.eat_kw(Keyword::EndType) {
            let d = Diagnostic::new("E0207", self.span(), "expected `END_TYPE`")
                .also(opened, "to close this TYPE");
            self.report(d);
        }
        self.eat(TokenKind::Semi);
    }

    fn type_decl(&mut self) -> Parsed<TypeDecl> {
        let name = self.ident("a type name")?;
        self.expect(TokenKind::Colon)?;
        let spec = self.type_spec()?;
        let init = if self.eat(TokenKind::Assign) { Some(self.init()?) } else { None };
        // The `;` after END_STRUCT is often left out.
        if !self.eat(TokenKind::Semi) && !matches!(spec.kind, TypeSpecKind::Struct(_)) {
            let _ = self.expect_semi("the type");
        }
        Ok(TypeDecl { name, spec, init })
    }

    fn primary_literal(&mut self) -> Parsed<Expr> {
        let span = self.span();
        match crate::lexer::literal::integer(self.slice()) {
            Ok(v) => {
                self.bump();
                Ok(Expr { span, kind: super::ast::ExprKind::Int(v) })
            }
            Err(e) => {
                let d = super::expr::literal_diagnostic(span, e);
                self.report(d);
                Err(Skip)
            }
        }
    }

    /// Place of the current token; for callers in other files.
    pub(super) fn here(&self) -> Span {
        self.span()
    }
}

/// POINTER TO and REFERENCE TO of other tools.
fn is_pointer(name: &str) -> bool {
    name.eq_ignore_ascii_case("POINTER") || name.eq_ignore_ascii_case("REFERENCE")
}

/// STRING and WSTRING may carry a length in brackets.
fn is_string(name: &str) -> bool {
    name.eq_ignore_ascii_case("STRING") || name.eq_ignore_ascii_case("WSTRING")
}

/// Words that start something at file level.
pub(super) fn is_top(k: TokenKind) -> bool {
    use Keyword::*;
    matches!(
        k,
        TokenKind::Word(Some(
            Program | Function | FunctionBlock | Type | Configuration | Class | Interface | Namespace | Using
        ))
    )
}

fn is_pou_end(k: TokenKind) -> bool {
    use Keyword::*;
    matches!(
        k,
        TokenKind::Word(Some(EndProgram | EndFunction | EndFunctionBlock | EndConfiguration | EndResource))
    )
}

fn is_section(k: TokenKind) -> bool {
    use Keyword::*;
    matches!(
        k,
        TokenKind::Word(Some(
            Var | VarInput | VarOutput | VarInOut | VarTemp | VarGlobal | VarExternal | VarAccess | VarConfig
        ))
    )
}
