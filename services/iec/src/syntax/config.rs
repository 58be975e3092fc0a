//! CONFIGURATION, RESOURCE, TASK.

use super::ast::{Configuration, Expr, Ident, ProgramDecl, Resource, TaskDecl};
use super::decl::is_top;
use super::{Parsed, Parser, Skip};
use crate::diagnostic::Diagnostic;
use crate::lexer::{Keyword, TokenKind};

impl Parser<'_> {
    pub(super) fn configuration(&mut self) -> Option<Configuration> {
        let opened = self.here();
        self.bump();
        let Ok(name) = self.ident("the name of the CONFIGURATION") else {
            self.skip_to(|k| k == TokenKind::Word(Some(Keyword::EndConfiguration)));
            self.bump();
            return None;
        };
        let mut config = Configuration { name: name.clone(), globals: Vec::new(), resources: Vec::new() };
        // TASK and PROGRAM without RESOURCE are allowed when there is one processor only.
        let mut own = Resource { name, globals: Vec::new(), tasks: Vec::new(), programs: Vec::new() };
        loop {
            match self.kind() {
                TokenKind::Word(Some(Keyword::Resource)) => config.resources.extend(self.resource()),
                TokenKind::Word(Some(Keyword::EndConfiguration)) => {
                    self.bump();
                    self.eat(TokenKind::Semi);
                    break;
                }
                TokenKind::Eof => {
                    let d = Diagnostic::new("E0207", self.here(), "expected `END_CONFIGURATION`")
                        .also(opened, "to close this CONFIGURATION");
                    self.report(d);
                    break;
                }
                _ => self.resource_item(&mut own, Keyword::EndConfiguration),
            }
        }
        if own.tasks.is_empty() && own.programs.is_empty() {
            config.globals = own.globals;
        } else {
            config.resources.push(own);
        }
        Some(config)
    }

    fn resource(&mut self) -> Option<Resource> {
        let opened = self.here();
        self.bump();
        let name = match self.ident("the name of the RESOURCE") {
            Ok(n) => n,
            Err(Skip) => {
                self.skip_to(|k| k == TokenKind::Word(Some(Keyword::EndResource)));
                self.bump();
                return None;
            }
        };
        if matches!(self.kind(), TokenKind::Word(None)) && self.slice().eq_ignore_ascii_case("ON") {
            self.bump();
            if matches!(self.kind(), TokenKind::Word(_)) {
                self.bump();
            } else {
                let _ = self.unexpected::<()>("the kind of the resource");
            }
        }
        let mut resource = Resource { name, globals: Vec::new(), tasks: Vec::new(), programs: Vec::new() };
        loop {
            match self.kind() {
                TokenKind::Word(Some(Keyword::EndResource)) => {
                    self.bump();
                    self.eat(TokenKind::Semi);
                    break;
                }
                TokenKind::Eof | TokenKind::Word(Some(Keyword::EndConfiguration)) => {
                    let d = Diagnostic::new("E0207", self.here(), "expected `END_RESOURCE`")
                        .also(opened, "to close this RESOURCE");
                    self.report(d);
                    break;
                }
                _ => self.resource_item(&mut resource, Keyword::EndResource),
            }
        }
        Some(resource)
    }

    fn resource_item(&mut self, resource: &mut Resource, end: Keyword) {
        let before = self.at;
        let result = match self.kind() {
            TokenKind::Word(Some(Keyword::Task)) => self.task().map(|t| resource.tasks.push(t)),
            TokenKind::Word(Some(Keyword::Program)) => {
                self.program_instance().map(|p| resource.programs.push(p))
            }
            TokenKind::Word(Some(Keyword::VarGlobal)) => {
                resource.globals.extend(self.var_block());
                Ok(())
            }
            TokenKind::Word(Some(k @ (Keyword::VarAccess | Keyword::VarConfig))) => {
                self.unsupported_section(k);
                Ok(())
            }
            _ => self.unexpected("TASK, PROGRAM or VAR_GLOBAL"),
        };
        if result.is_err() {
            self.skip_to(|k| {
                matches!(
                    k,
                    TokenKind::Semi
                        | TokenKind::Word(Some(Keyword::Task | Keyword::Program | Keyword::EndConfiguration))
                ) || k == TokenKind::Word(Some(end))
                    || is_top(k)
            });
            self.eat(TokenKind::Semi);
        }
        if self.at == before {
            self.bump();
        }
    }

    /// `TASK name(INTERVAL := T#10ms, PRIORITY := 0);`
    fn task(&mut self) -> Parsed<TaskDecl> {
        self.bump();
        let name = self.ident("the name of the TASK")?;
        let mut params: Vec<(Ident, Expr)> = Vec::new();
        self.expect(TokenKind::LParen)?;
        loop {
            let param = self.ident("INTERVAL, PRIORITY or SINGLE")?;
            self.expect(TokenKind::Assign)?;
            params.push((param, self.expr()?));
            if !self.eat(TokenKind::Comma) {
                break;
            }
        }
        self.expect(TokenKind::RParen)?;
        let _ = self.expect_semi("the TASK");
        Ok(TaskDecl { name, params })
    }

    /// `PROGRAM [RETAIN] inst WITH task : type;`
    fn program_instance(&mut self) -> Parsed<ProgramDecl> {
        self.bump();
        let mut retain = None;
        if self.at_kw(Keyword::Retain) {
            retain = Some(self.here());
            self.bump();
        }
        self.eat_kw(Keyword::NonRetain);
        let name = self.ident("the name of the program instance")?;
        let task = if self.eat_kw(Keyword::With) { Some(self.ident("the name of a TASK")?) } else { None };
        self.expect(TokenKind::Colon)?;
        let type_name = self.ident("the name of a PROGRAM")?;
        let mut args = None;
        if self.kind() == TokenKind::LParen {
            let start = self.here();
            self.args()?;
            args = Some(start.to(self.last_span()));
        }
        let _ = self.expect_semi("the program instance");
        Ok(ProgramDecl { name, retain, task, type_name, args })
    }
}
