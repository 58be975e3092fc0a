//! Fills the tables: POUs, types, global variables, then the variables of every POU.

use std::collections::HashMap;

use super::init::completed;
use super::resolve::Resolver;
use super::tables::{InitData, Pou, Tables, Var};
use crate::diagnostic::{Diagnostic, Span};
use crate::syntax::ast::{self, Ident, PouKind, Section, TypeDecl, TypeSpec, TypeSpecKind, VarBlock};
use crate::types::{Type, elementary};
use crate::{Options, limits};

/// Work still to be done for one named thing.
#[derive(Clone, Copy, PartialEq)]
enum State {
    Open,
    Running,
    Done,
}

/// Declares everything; the POUs' trees by POU index.
pub fn declare<'u>(
    units: &'u [ast::Unit],
    library: usize,
    options: &Options,
    tables: &mut Tables,
    diags: &mut Vec<Diagnostic>,
) -> Vec<&'u ast::Pou> {
    let mut d = Declare {
        options,
        tables,
        diags,
        decls: Vec::new(),
        types: HashMap::new(),
        fb_state: Vec::new(),
        path: Vec::new(),
    };
    for (index, unit) in units.iter().enumerate() {
        for pou in &unit.pous {
            d.enter_pou(pou, index == library);
        }
    }
    let blocks: Vec<&VarBlock> = units
        .iter()
        .flat_map(|u| {
            let inner = u
                .configurations
                .iter()
                .flat_map(|c| c.globals.iter().chain(c.resources.iter().flat_map(|r| r.globals.iter())));
            u.globals.iter().chain(inner)
        })
        .collect();
    // Constants of elementary types first: array bounds and types may use them.
    d.globals(&blocks, true);
    for unit in units {
        for t in &unit.types {
            d.enter_type(t);
        }
    }
    let names: Vec<String> = d.types.keys().cloned().collect();
    for name in sorted(names) {
        d.complete_type(&name);
    }
    for pou in 0..d.decls.len() {
        d.complete_fb(pou as u32);
    }
    d.globals(&blocks, false);
    d.mapped_symbols();
    for pou in 0..d.decls.len() {
        if d.decls[pou].kind != PouKind::FunctionBlock {
            d.variables(pou as u32);
        }
    }
    for pou in 0..d.decls.len() {
        d.link_externals(pou);
    }
    d.decls
}

fn sorted(mut names: Vec<String>) -> Vec<String> {
    names.sort();
    names
}

pub(super) struct Declare<'u, 'a> {
    pub(super) options: &'a Options,
    pub(super) tables: &'a mut Tables,
    pub(super) diags: &'a mut Vec<Diagnostic>,
    decls: Vec<&'u ast::Pou>,
    types: HashMap<String, (&'u TypeDecl, State)>,
    fb_state: Vec<State>,
    /// Names being completed, for the message of a cycle.
    path: Vec<(String, Span)>,
}

impl<'u> Declare<'u, '_> {
    fn enter_pou(&mut self, pou: &'u ast::Pou, library: bool) {
        let key = pou.name.key();
        if let Some(&first) = self.tables.pous_by_name.get(&key) {
            let first = &self.tables.pous[first as usize];
            if library {
                let d = Diagnostic::new(
                    "W0103",
                    first.name.span,
                    format!("`{}` hides the standard block of this name", first.name.text),
                );
                self.diags.push(d);
            } else {
                self.diags.push(super::duplicate(&pou.name.text, first.name.span, pou.name.span));
            }
            return;
        }
        if elementary(&key).is_some() || (!library && super::builtins::is_builtin(&key)) {
            let d =
                Diagnostic::new("E0203", pou.name.span, format!("`{}` is a standard name", pou.name.text))
                    .help("choose another name");
            self.diags.push(d);
        }
        let index = self.tables.pous.len() as u32;
        self.tables.pous_by_name.insert(key, index);
        self.tables.pous.push(Pou {
            kind: pou.kind,
            name: pou.name.clone(),
            library,
            vars: Vec::new(),
            by_name: HashMap::new(),
            returns: None,
            bytes: 0,
            align: 1,
            depth: 1,
            stmts: pou.stmts,
        });
        self.decls.push(pou);
        self.fb_state.push(State::Open);
    }

    fn resolver(&mut self) -> Resolver<'_> {
        Resolver { tables: self.tables, options: self.options, diags: self.diags }
    }

    fn enter_type(&mut self, t: &'u TypeDecl) {
        let key = t.name.key();
        if let Some((first, _)) = self.types.get(&key) {
            self.diags.push(super::duplicate(&t.name.text, first.name.span, t.name.span));
        } else if let Some(&pou) = self.tables.pous_by_name.get(&key) {
            let first = self.tables.pous[pou as usize].name.span;
            self.diags.push(super::duplicate(&t.name.text, first, t.name.span));
        } else if elementary(&key).is_some() {
            self.diags.push(Diagnostic::new(
                "E0203",
                t.name.span,
                format!("`{}` is a standard name", t.name.text),
            ));
        } else {
            self.types.insert(key, (t, State::Open));
        }
    }

    /// True when this name may go on; reports cycles and too deep nesting.
    fn start(&mut self, name: &Ident, state: State) -> bool {
        match state {
            State::Done => false,
            State::Running => {
                let from = self.path.iter().position(|(n, _)| *n == name.key()).unwrap_or(0);
                let names: Vec<&str> = self.path[from..].iter().map(|(n, _)| n.as_str()).collect();
                let mut d = Diagnostic::new("E0304", name.span, format!("`{}` contains itself", name.text))
                    .label(format!("{} -> {}", names.join(" -> "), name.key()))
                    .help("an instance inside itself would need endless memory; use VAR_IN_OUT");
                for (n, span) in self.path[from..].iter().skip(1) {
                    d = d.also(*span, format!("by way of {n}"));
                }
                self.diags.push(d);
                false
            }
            State::Open if self.path.len() >= limits::INSTANCE_DEPTH as usize => {
                self.diags.push(super::too_deep(name.span));
                false
            }
            State::Open => true,
        }
    }

    fn complete_type(&mut self, key: &str) {
        let Some(&(decl, state)) = self.types.get(key) else { return };
        if !self.start(&decl.name, state) {
            return;
        }
        self.types.insert(key.to_owned(), (decl, State::Running));
        self.path.push((key.to_owned(), decl.name.span));
        self.complete_spec(&decl.spec);
        let mut r = self.resolver();
        let (ty, own) = match &decl.spec.kind {
            TypeSpecKind::Struct(fields) => (r.structure(&decl.name, fields), InitData::Default),
            TypeSpecKind::Enum(values) => (r.enumeration(&decl.name, values), InitData::Default),
            _ => r.spec(&decl.spec, None),
        };
        // The type is known to its own initial value: TYPE c : (red, green) := green.
        r.enter(&decl.name, ty.clone(), own.clone());
        if let Some(i) = &decl.init {
            let init = completed(r.init(i, &ty, None), &own);
            r.enter(&decl.name, ty, init);
        }
        self.path.pop();
        self.types.insert(key.to_owned(), (decl, State::Done));
    }

    /// Completes what a specification names.
    pub(super) fn complete_spec(&mut self, spec: &TypeSpec) {
        match &spec.kind {
            TypeSpecKind::Named(name) => self.complete_name(name),
            TypeSpecKind::Array { of, .. } => self.complete_spec(of),
            TypeSpecKind::Struct(fields) => {
                for f in fields {
                    self.complete_spec(&f.spec);
                }
            }
            TypeSpecKind::Subrange { base, .. } => self.complete_name(base),
            TypeSpecKind::Enum(_) | TypeSpecKind::Error => {}
        }
    }

    fn complete_name(&mut self, name: &Ident) {
        let key = name.key();
        if self.types.contains_key(&key) {
            self.complete_type(&key);
        } else if let Some(&pou) = self.tables.pous_by_name.get(&key) {
            self.complete_fb(pou);
        }
    }

    /// Variables and size of a function block.
    fn complete_fb(&mut self, pou: u32) {
        let decl = self.decls[pou as usize];
        if decl.kind != PouKind::FunctionBlock || !self.start(&decl.name, self.fb_state[pou as usize]) {
            return;
        }
        self.fb_state[pou as usize] = State::Running;
        self.path.push((decl.name.key(), decl.name.span));
        for block in &decl.blocks {
            // Globals are referred to, not contained.
            if block.section != Section::External {
                for v in &block.vars {
                    self.complete_spec(&v.spec);
                }
            }
        }
        self.variables(pou);
        self.layout(pou);
        self.path.pop();
        self.fb_state[pou as usize] = State::Done;
    }

    fn layout(&mut self, pou: u32) {
        let (mut bytes, mut align, mut depth) = (0_u64, 1_u32, 1_u32);
        let mut offsets = Vec::new();
        for v in &self.tables.pous[pou as usize].vars {
            if !v.has_storage() {
                offsets.push(0);
                continue;
            }
            // VAR_IN_OUT is an address.
            let (size, a) = if v.section == Section::InOut {
                (4, 4)
            } else {
                (self.tables.size_of(&v.ty), self.tables.align_of(&v.ty))
            };
            bytes = bytes.next_multiple_of(u64::from(a));
            offsets.push(bytes.min(u64::from(u32::MAX)) as u32);
            bytes += size;
            align = align.max(a);
            if v.section != Section::InOut {
                depth = depth.max(1 + self.tables.depth_of(&v.ty));
            }
        }
        bytes = bytes.next_multiple_of(u64::from(align)).max(1);
        if depth > limits::INSTANCE_DEPTH {
            self.diags.push(super::too_deep(self.tables.pous[pou as usize].name.span));
            depth = 1;
        }
        let p = &mut self.tables.pous[pou as usize];
        if bytes > limits::MEMORY_BYTES {
            let d = Diagnostic::new(
                "E0805",
                p.name.span,
                format!("one instance of `{}` has {bytes} bytes", p.name.text),
            );
            self.diags.push(d);
            bytes = 1;
        }
        for (v, offset) in p.vars.iter_mut().zip(offsets) {
            v.offset = offset;
        }
        p.bytes = bytes as u32;
        p.align = align;
        p.depth = depth;
    }

    /// All variables of a POU, and a function's result.
    fn variables(&mut self, pou: u32) {
        let decl = self.decls[pou as usize];
        for block in &decl.blocks {
            self.check_section(decl.kind, block);
            if block.section == Section::Global {
                continue;
            }
            for v in &block.vars {
                let vars = self.variable(block, v, Some(pou));
                for var in vars {
                    self.enter_var(pou, var);
                }
            }
        }
        if decl.kind == PouKind::Function {
            let returns = decl.returns.as_ref().map(|spec| {
                let (ty, _) = self.resolver().spec(spec, None);
                if ty.elem().is_none() && ty != Type::Error {
                    let name = self.tables.type_name(&ty);
                    let d = Diagnostic::new(
                        "E0905",
                        spec.span,
                        format!("functions that return {name} are not supported yet"),
                    )
                    .help("use a VAR_IN_OUT parameter");
                    self.diags.push(d);
                    return Type::Error;
                }
                ty
            });
            self.tables.pous[pou as usize].returns = returns;
        }
    }

    fn enter_var(&mut self, pou: u32, var: Var) {
        let p = &mut self.tables.pous[pou as usize];
        let key = var.name.key();
        if let Some(&first) = p.by_name.get(&key) {
            let first = p.vars[first as usize].name.span;
            self.diags.push(super::duplicate(&var.name.text, first, var.name.span));
            return;
        }
        if p.kind == PouKind::Function && p.name.key() == key {
            let d = Diagnostic::new(
                "E0301",
                var.name.span,
                format!("`{}` is the name of the function itself", var.name.text),
            )
            .also(p.name.span, "this function");
            self.diags.push(d);
            return;
        }
        if elementary(&key).is_some() {
            let d =
                Diagnostic::new("E0203", var.name.span, format!("`{}` is the name of a type", var.name.text))
                    .help("choose another name");
            self.diags.push(d);
            return;
        }
        if p.vars.len() >= limits::VARIABLES {
            let d = Diagnostic::new(
                "E0803",
                var.name.span,
                format!("more than {} variables in one POU", limits::VARIABLES),
            );
            self.diags.push(d);
            return;
        }
        p.by_name.insert(key, p.vars.len() as u32);
        p.vars.push(var);
    }

    fn check_section(&mut self, kind: PouKind, block: &VarBlock) {
        let bad = |what: &str, help: &str| {
            Some(
                Diagnostic::new(
                    "E0305",
                    block.span,
                    format!("{what} is not allowed in a {}", kind.keyword()),
                )
                .help(help),
            )
        };
        let section = block.section.keyword();
        let mut d = match (kind, block.section) {
            (_, Section::Global) => bad("VAR_GLOBAL", "put it at file level or into the CONFIGURATION"),
            (PouKind::Program, Section::InOut) => Some(
                Diagnostic::new("E0905", block.span, "VAR_IN_OUT of a PROGRAM is not supported")
                    .help("use VAR_EXTERNAL or a global variable"),
            ),
            _ => None,
        };
        if block.constant && !matches!(block.section, Section::Var | Section::Global | Section::External) {
            d = bad(&format!("{section} CONSTANT"), "constants stand in VAR CONSTANT");
        }
        if let Some(span) = block.retain {
            d = match kind {
                PouKind::Function => bad("RETAIN", "a function keeps nothing between calls"),
                PouKind::FunctionBlock => Some(
                    Diagnostic::new("E0905", span, "RETAIN inside a FUNCTION_BLOCK is not supported yet")
                        .help("declare the whole instance RETAIN where it is declared"),
                ),
                PouKind::Program
                    if block.constant || matches!(block.section, Section::Temp | Section::External) =>
                {
                    bad(
                        &format!("{section} RETAIN"),
                        "RETAIN belongs to VAR, VAR_INPUT, VAR_OUTPUT and VAR_GLOBAL",
                    )
                }
                PouKind::Program => d,
            };
        }
        self.diags.extend(d);
    }

    /// The variables of one declaration; `pou`: whose.
    pub(super) fn variable(&mut self, block: &VarBlock, decl: &ast::VarDecl, pou: Option<u32>) -> Vec<Var> {
        let kind = pou.map(|p| self.decls[p as usize].kind);
        // Earlier constants of the POU are visible in bounds and initial values: it is lent out meanwhile.
        let scope = pou.map(|p| self.lend(p));
        let result = self.variable_in(block, decl, kind, scope.as_ref());
        if let (Some(p), Some(scope)) = (pou, scope) {
            self.tables.pous[p as usize] = scope;
        }
        result
    }

    /// Takes a POU out of the tables; a shell of the same name stays.
    fn lend(&mut self, pou: u32) -> Pou {
        let p = &mut self.tables.pous[pou as usize];
        let shell =
            Pou { vars: Vec::new(), by_name: HashMap::new(), returns: None, name: p.name.clone(), ..*p };
        std::mem::replace(p, shell)
    }

    fn variable_in(
        &mut self,
        block: &VarBlock,
        decl: &ast::VarDecl,
        kind: Option<PouKind>,
        scope: Option<&Pou>,
    ) -> Vec<Var> {
        let mut r = self.resolver();
        let (ty, type_init) = r.spec(&decl.spec, scope);
        let init = match &decl.init {
            Some(i) if block.section == Section::External || block.section == Section::InOut => {
                let d = Diagnostic::new(
                    "E0310",
                    i.span(),
                    format!("{} has no initial value", block.section.keyword()),
                )
                .help("the variable it refers to has one");
                r.diags.push(d);
                InitData::Default
            }
            Some(i) => completed(r.init(i, &ty, scope), &type_init),
            None => type_init,
        };
        let located = decl.at.as_ref().and_then(|at| match (kind, block.section) {
            (None, _) | (Some(PouKind::Program | PouKind::FunctionBlock), Section::Var)
                if !block.constant =>
            {
                r.located(at, &ty)
            }
            _ => {
                r.diags.push(Diagnostic::new(
                    "E0605",
                    at.span,
                    "AT is allowed in VAR of a PROGRAM or FUNCTION_BLOCK and in VAR_GLOBAL only",
                ));
                None
            }
        });
        if let (Some(at), Some(span)) = (&decl.at, block.retain) {
            let d = Diagnostic::new("E0605", at.span, "a located variable cannot be RETAIN")
                .also(span, "RETAIN here")
                .help("the image is not kept; copy the value to a RETAIN variable");
            r.diags.push(d);
        }
        self.check_type(block, decl, &ty, kind);
        if block.constant && decl.init.is_none() && block.section != Section::External && ty != Type::Error {
            let d =
                Diagnostic::new("E0308", decl.spec.span, "a CONSTANT needs a value").help("add `:= value`");
            self.diags.push(d);
        }
        let value = match (&init, block.constant, ty.elem()) {
            (InitData::Scalar(c), true, Some(_)) => Some(*c),
            _ => None,
        };
        let make = |name: &Ident| Var {
            name: name.clone(),
            section: block.section,
            ty: ty.clone(),
            init: init.clone(),
            constant: block.constant,
            value,
            retain: block.retain.is_some(),
            located: located.clone(),
            external: None,
            offset: 0,
            mapped: None,
        };
        decl.names.iter().map(make).collect()
    }

    /// Where instances of function blocks may stand.
    fn check_type(&mut self, block: &VarBlock, decl: &ast::VarDecl, ty: &Type, kind: Option<PouKind>) {
        if !self.contains_fb(ty) {
            return;
        }
        let allowed = match (kind, block.section) {
            (_, Section::InOut | Section::External) => true,
            (Some(PouKind::Function), _) => false,
            (_, Section::Var | Section::Global) => !block.constant,
            _ => false,
        };
        if !allowed {
            let name = self.tables.type_name(ty);
            let d = Diagnostic::new("E0311", decl.spec.span, format!("an instance of {name} cannot stand here"))
                .help("instances stand in VAR of a PROGRAM or FUNCTION_BLOCK or in VAR_GLOBAL; pass them by VAR_IN_OUT");
            self.diags.push(d);
        }
    }

    fn contains_fb(&self, ty: &Type) -> bool {
        match ty {
            Type::Fb(_) => true,
            Type::Array(a) => self.contains_fb(&a.of),
            Type::Struct(s) => {
                self.tables.structs[*s as usize].fields.iter().any(|f| self.contains_fb(&f.ty))
            }
            _ => false,
        }
    }
}
