//! Global variables: declared ones, those the stack file makes, and the VAR_EXTERNAL that refer to them.

use super::declare::Declare;
use super::resolve::locate;
use super::tables::{InitData, Var};
use crate::diagnostic::{Diagnostic, Span};
use crate::limits;
use crate::syntax::ast::{Ident, Section, TypeSpecKind, VarBlock};
use crate::types::{Type, elementary};

impl Declare<'_, '_> {
    /// Global variables: constants of elementary types first, everything else in a second pass.
    pub(super) fn globals(&mut self, blocks: &[&VarBlock], constants: bool) {
        for block in blocks {
            for decl in &block.vars {
                let early = block.constant
                    && matches!(&decl.spec.kind, TypeSpecKind::Named(n) if elementary(&n.text).is_some());
                if early != constants {
                    continue;
                }
                self.complete_spec(&decl.spec);
                for var in self.variable(block, decl, None) {
                    self.enter_global(var);
                }
            }
        }
    }

    fn enter_global(&mut self, var: Var) {
        let key = var.name.key();
        if let Some(&first) = self.tables.globals_by_name.get(&key) {
            let first = &self.tables.globals[first as usize];
            self.diags.push(super::duplicate(&var.name.text, first.name.span, var.name.span));
            return;
        }
        if let Some(&pou) = self.tables.pous_by_name.get(&key)
            && !self.tables.pous[pou as usize].library
        {
            let first = self.tables.pous[pou as usize].name.span;
            self.diags.push(super::duplicate(&var.name.text, first, var.name.span));
            return;
        }
        self.tables.globals_by_name.insert(key, self.tables.globals.len() as u32);
        self.tables.globals.push(var);
    }

    /// VAR_GLOBAL made from the stack file's symbols.
    pub(super) fn mapped_symbols(&mut self) {
        for symbol in &self.options.externals {
            let fail = |text: String| {
                Diagnostic::placeless("E0604", format!("{}: symbol `{}`: {text}", symbol.origin, symbol.name))
            };
            let valid = symbol
                .name
                .chars()
                .enumerate()
                .all(|(i, c)| c == '_' || c.is_ascii_alphabetic() || (i > 0 && c.is_ascii_digit()));
            let (tokens, problems) = crate::lexer::lex(0, &symbol.name);
            let is_word = problems.is_empty()
                && tokens.len() == 2
                && tokens[0].kind == crate::lexer::TokenKind::Word(None)
                && elementary(&symbol.name).is_none();
            if !valid || !is_word || symbol.name.len() > limits::IDENT_CHARS {
                self.diags.push(fail(
                    "is no name of a variable (letters, digits, `_`, no reserved word)".to_owned(),
                ));
                continue;
            }
            let Some(elem) = elementary(&symbol.type_name) else {
                self.diags.push(fail(format!("`{}` is no elementary type", symbol.type_name)));
                continue;
            };
            let located = match locate(self.tables, &symbol.address, &Type::Elem(elem)) {
                Ok(l) => l,
                Err((_, message)) => {
                    self.diags.push(fail(message));
                    continue;
                }
            };
            let key = symbol.name.to_ascii_uppercase();
            if let Some(&first) = self.tables.globals_by_name.get(&key) {
                let first = &self.tables.globals[first as usize];
                let d = match &first.mapped {
                    Some(origin) => fail(format!("is declared at {origin} already")),
                    None => Diagnostic::new("E0604", first.name.span, format!("`{}` is also the symbol of {}", first.name.text, symbol.origin))
                        .help("remove this declaration: the stack file makes the variable; in a POU use VAR_EXTERNAL or the plain name"),
                };
                self.diags.push(d);
                continue;
            }
            if self.tables.pous_by_name.get(&key).is_some_and(|p| !self.tables.pous[*p as usize].library) {
                self.diags.push(fail("is the name of a POU".to_owned()));
                continue;
            }
            self.tables.globals_by_name.insert(key, self.tables.globals.len() as u32);
            self.tables.globals.push(Var {
                name: Ident { text: symbol.name.clone(), span: Span::default() },
                section: Section::Global,
                ty: Type::Elem(elem),
                init: InitData::Default,
                constant: false,
                value: None,
                retain: false,
                located: Some(located),
                external: None,
                offset: 0,
                mapped: Some(symbol.origin.clone()),
            });
        }
    }

    pub(super) fn link_externals(&mut self, pou: usize) {
        let mut links = Vec::new();
        for (i, v) in self.tables.pous[pou].vars.iter().enumerate() {
            if v.section != Section::External {
                continue;
            }
            let Some(&g) = self.tables.globals_by_name.get(&v.name.key()) else {
                let names = self.tables.globals.iter().map(|g| g.name.text.as_str());
                let near = super::resolve::nearest(&v.name.key(), names);
                let d = Diagnostic::new(
                    "E0307",
                    v.name.span,
                    format!("there is no VAR_GLOBAL `{}`", v.name.text),
                )
                .help(near.map_or_else(
                    || "declare it in VAR_GLOBAL, or give the stack file a `symbol`".to_owned(),
                    |n| format!("did you mean `{n}`?"),
                ));
                self.diags.push(d);
                continue;
            };
            let global = &self.tables.globals[g as usize];
            if global.ty != v.ty && v.ty != Type::Error && global.ty != Type::Error {
                let (here, there) = (self.tables.type_name(&v.ty), self.tables.type_name(&global.ty));
                let mut d = Diagnostic::new(
                    "E0307",
                    v.name.span,
                    format!("`{}` is {there}, not {here}", v.name.text),
                );
                d = match &global.mapped {
                    Some(origin) => d.help(format!("it is the symbol of {origin}")),
                    None => d.also(global.name.span, "declared here"),
                };
                self.diags.push(d);
            }
            links.push((i, g, global.constant, global.value));
        }
        for (i, g, constant, value) in links {
            let v = &mut self.tables.pous[pou].vars[i];
            v.external = Some(g);
            v.constant |= constant;
            v.value = value;
        }
    }
}
