//! Statements to IR.

use super::calls_scan::Scan;
use super::check::{Checker, Counter, Val};
use super::tables::Tables;
use crate::artifact::{ElemType, Storage};
use crate::diagnostic::{Diagnostic, Severity, Span};
use crate::ir::{Base, Body, For, Step, Stmt, StmtKind};
use crate::syntax::ast;
use crate::types::{ElemExt, Type};
use crate::{Options, limits};

/// Checks the body of a POU.
pub fn check_body(
    tables: &Tables,
    pou: u32,
    decl: &ast::Pou,
    options: &Options,
    diags: &mut Vec<Diagnostic>,
) -> Body {
    let mut ck = Checker::new(tables, tables.pous.get(pou as usize), options);
    if diags.len() >= limits::ERRORS && diags.iter().any(|d| d.severity == Severity::Error) {
        ck.body.dropped = Some(decl.name.span);
        return ck.body;
    }
    let stmts = ck.statements(&decl.body);
    ck.body.stmts = stmts;
    ck.missing_result(decl);
    ck.body.dropped = ck.dropped.then_some(decl.name.span);
    diags.append(&mut ck.diags);
    ck.body
}

impl Checker<'_> {
    fn scan<'n>(&'n self, name: &'n str) -> Scan<'n> {
        Scan { name, tables: self.tables, pou: self.pou }
    }

    /// A function that never assigns its result returns its type's initial value: surely a mistake.
    fn missing_result(&mut self, decl: &ast::Pou) {
        let returns = self.pou.is_some_and(|p| p.returns.is_some());
        if decl.kind == ast::PouKind::Function && returns && !self.scan(&decl.name.text).changes(&decl.body) {
            let d = Diagnostic::new(
                "W0206",
                decl.name.span,
                format!("function {} never assigns its result", decl.name.text),
            )
            .help(format!("add `{} := ...;`", decl.name.text));
            self.report(d);
        }
    }

    fn statements(&mut self, list: &[ast::Stmt]) -> Vec<Stmt> {
        list.iter().filter_map(|s| self.statement_checked(s)).collect()
    }

    fn statement_checked(&mut self, s: &ast::Stmt) -> Option<Stmt> {
        if self.errors > limits::ERRORS_PER_FILE {
            // To look for the nearest name of each unknown one takes its time.
            self.dropped = true;
            return None;
        }
        let outer = self.statement;
        self.statement = s.id;
        let kind = self.kind(s);
        self.statement = outer;
        self.dropped |= kind.is_none() && !matches!(s.kind, ast::StmtKind::Empty);
        kind.map(|kind| Stmt { id: s.id, kind })
    }

    fn kind(&mut self, s: &ast::Stmt) -> Option<StmtKind> {
        match &s.kind {
            ast::StmtKind::Assign { target, value } => self.assign(target, value),
            ast::StmtKind::Call(e) => {
                let ast::ExprKind::Call(callee, args) = &e.kind else { return None };
                self.call_statement(callee, args, e.span)
            }
            ast::StmtKind::If { branches, otherwise } => {
                let mut out = Vec::new();
                for b in branches {
                    self.statement = b.id;
                    let cond = self.condition(&b.cond, "condition of IF");
                    out.push((b.id, cond, self.statements(&b.body)));
                }
                let otherwise = self.statements(otherwise);
                Some(StmtKind::If { branches: out, otherwise })
            }
            ast::StmtKind::Case { selector, arms, otherwise } => self.case(selector, arms, otherwise),
            ast::StmtKind::For { var, from, to, by, body } => self.for_loop(var, from, to, by.as_ref(), body),
            ast::StmtKind::While { cond, body } => {
                let cond = self.condition(cond, "condition of WHILE");
                let body = self.looped(body);
                Some(StmtKind::While { cond, body })
            }
            ast::StmtKind::Repeat { body, until, until_id } => {
                let body = self.looped(body);
                self.statement = *until_id;
                let until = self.condition(until, "condition of UNTIL");
                Some(StmtKind::Repeat { body, until, until_id: *until_id })
            }
            ast::StmtKind::Exit | ast::StmtKind::Continue if self.loops == 0 => {
                let word = if matches!(s.kind, ast::StmtKind::Exit) { "EXIT" } else { "CONTINUE" };
                self.report(Diagnostic::new("E0410", s.span, format!("{word} outside of a loop")));
                None
            }
            ast::StmtKind::Exit => Some(StmtKind::Exit),
            ast::StmtKind::Continue => Some(StmtKind::Continue),
            ast::StmtKind::Return => Some(StmtKind::Return),
            ast::StmtKind::Empty => None,
        }
    }

    fn looped(&mut self, body: &[ast::Stmt]) -> Vec<Stmt> {
        self.loops += 1;
        let out = self.statements(body);
        self.loops -= 1;
        out
    }

    fn assign(&mut self, target: &ast::Expr, value: &ast::Expr) -> Option<StmtKind> {
        let place = self.assignable(target);
        let want = place.as_ref().and_then(|(_, t)| t.elem());
        let v = self.expr(value, want);
        let (place, ty) = place?;
        if ty.elem().is_some() {
            let value = self.coerce(v, value.span, &ty, "assignment")?;
            return Some(StmtKind::Store { place, value });
        }
        match v {
            Val::Error => None,
            Val::Whole(from, from_ty) if from_ty == ty && !matches!(ty, Type::Fb(_)) => {
                let bytes = self.tables.size_of(&ty) as u32;
                self.note_located(&from, bytes, false);
                self.take_address(&from);
                self.take_address(&place);
                Some(StmtKind::Copy { to: place, from, bytes })
            }
            Val::Whole(..) if matches!(ty, Type::Fb(_)) => {
                let d =
                    Diagnostic::new("E0905", target.span, "instances of function blocks cannot be assigned");
                self.report(d);
                None
            }
            other => {
                let (want, found) = (self.tables.type_name(&ty), self.describe(&other));
                self.report(Diagnostic::new(
                    "E0401",
                    value.span,
                    format!("assignment: {want} is needed, found {found}"),
                ));
                None
            }
        }
    }

    fn case(
        &mut self,
        selector: &ast::Expr,
        arms: &[ast::CaseArm],
        otherwise: &[ast::Stmt],
    ) -> Option<StmtKind> {
        let v = self.expr(selector, None);
        let (e, ty) = match v {
            Val::Expr(e, ty) if e.ty.is_int() || e.ty.is_any_bit() => (Some(e), ty),
            Val::Int(n) => {
                let e = self.literal_default(&Val::Int(n), selector.span, None);
                let ty = e.as_ref().map_or(Type::Error, |e| Type::Elem(e.ty));
                (e, ty)
            }
            Val::Error => (None, Type::Error),
            other => {
                let found = self.describe(&other);
                let d = Diagnostic::new(
                    "E0401",
                    selector.span,
                    format!("CASE needs an integer, a bit string or an enumeration, found {found}"),
                );
                self.report(d);
                (None, Type::Error)
            }
        };
        // Labels of a subrange may lie outside of it; they never match.
        let ty = match ty {
            Type::Subrange(s) => Type::Elem(s.base),
            t => t,
        };
        let mut seen: Vec<(i128, i128, Span)> = Vec::new();
        let mut out = Vec::new();
        for arm in arms {
            let mut labels = Vec::new();
            for (from, to) in &arm.labels {
                let lo = self.label(from, &ty);
                let hi = match to {
                    Some(to) => self.label(to, &ty),
                    None => lo,
                };
                let span = to.as_ref().map_or(from.span, |t| from.span.to(t.span));
                let (Some(lo), Some(hi)) = (lo, hi) else { continue };
                self.note_label(&mut seen, lo.0, hi.0, span);
                labels.push((lo.1, hi.1));
            }
            out.push((labels, self.statements(&arm.body)));
        }
        self.overlapping(seen);
        let otherwise = self.statements(otherwise);
        Some(StmtKind::Case { selector: e?, arms: out, otherwise })
    }

    fn note_label(&mut self, seen: &mut Vec<(i128, i128, Span)>, lo: i128, hi: i128, span: Span) {
        if lo > hi {
            let d = Diagnostic::new("E0407", span, format!("{lo}..{hi} is no range"))
                .help("the lower value comes first");
            self.report(d);
            return;
        }
        seen.push((lo, hi, span));
    }

    fn overlapping(&mut self, mut seen: Vec<(i128, i128, Span)>) {
        seen.sort_by_key(|s| (s.0, s.1, s.2.start));
        let mut reach: Option<(i128, Span)> = None;
        for (lo, hi, span) in seen {
            if let Some((end, first)) = reach
                && lo <= end
            {
                let (first, second) = if first.start < span.start { (first, span) } else { (span, first) };
                let d = Diagnostic::new("W0204", second, "this CASE label is covered already")
                    .also(first, "by this one")
                    .help("the first match runs");
                self.report(d);
            }
            if reach.is_none_or(|(end, _)| hi > end) {
                reach = Some((hi, span));
            }
        }
    }

    /// Value of a label: mathematical, and as the constant compared.
    fn label(&mut self, e: &ast::Expr, ty: &Type) -> Option<(i128, i64)> {
        let v = self.expr(e, ty.elem());
        if *ty == Type::Error {
            return None;
        }
        let value = self.coerce(v, e.span, ty, "CASE label")?;
        match value.as_int() {
            Some(c) => Some((crate::ir::value(value.ty, c), c)),
            None => {
                self.report(Diagnostic::new("E0302", e.span, "a CASE label must be a constant"));
                None
            }
        }
    }

    fn for_loop(
        &mut self,
        var: &ast::Expr,
        from: &ast::Expr,
        to: &ast::Expr,
        by: Option<&ast::Expr>,
        body: &[ast::Stmt],
    ) -> Option<StmtKind> {
        let target = self.assignable(var);
        let (place, ty) = match target {
            Some((p, t)) if t.elem().is_some_and(|e| e.is_int()) && !matches!(t, Type::Enum(_)) => {
                (Some(p), t)
            }
            Some((_, t)) => {
                let found = self.tables.type_name(&t);
                if t != Type::Error {
                    self.report(Diagnostic::new(
                        "E0401",
                        var.span,
                        format!("FOR needs an integer variable, found {found}"),
                    ));
                }
                (None, Type::Error)
            }
            None => (None, Type::Error),
        };
        let elem = ty.elem().unwrap_or(ElemType::Dint);
        let from_v = self.expr(from, Some(elem));
        let to_v = self.expr(to, Some(elem));
        let (from_e, to_e) = (
            self.coerce(from_v, from.span, &ty, "start of FOR"),
            self.coerce(to_v, to.span, &ty, "end of FOR"),
        );
        let step = self.step(by, elem);
        let changed = match &var.kind {
            ast::ExprKind::Name(name) => self.scan(&name.text).changes(body),
            _ => true,
        };
        if let (true, ast::ExprKind::Name(name)) = (changed, &var.kind) {
            let d = Diagnostic::new(
                "W0201",
                var.span,
                format!("the loop may change its control variable `{}`", name.text),
            )
            .help("the standard forbids it; the changed value counts here. Use WHILE if that is meant");
            self.report(d);
        }
        let (Some(place), Some(from), Some(to), Some(step)) = (place, from_e, to_e, step) else {
            self.looped(body);
            return None;
        };
        let private =
            matches!(place.base, Base::Var(_)) && place.index.is_none() && place.storage == Storage::Plain;
        let counter = (!changed && private && !self.options.debug).then(|| {
            let (f, t) = (self.range(&from), self.range(&to));
            let range = match step {
                Step::Const(n) if n > 0 => (f.0, t.1.max(f.0)),
                Step::Const(_) => (t.0.min(f.1), f.1),
                Step::Dynamic(_) => (f.0.min(t.0), f.1.max(t.1)),
            };
            self.temp(elem, range)
        });
        let var = place.clone();
        if let Some(temp) = counter {
            self.counters.push(Counter { place, temp });
        }
        let body = self.looped(body);
        if counter.is_some() {
            self.counters.pop();
        }
        Some(StmtKind::For(Box::new(For { ty: elem, var, counter, from, to, step, body })))
    }

    fn step(&mut self, by: Option<&ast::Expr>, elem: ElemType) -> Option<Step> {
        let Some(by) = by else { return Some(Step::Const(1)) };
        match self.expr(by, None) {
            Val::Int(0) => {
                self.report(Diagnostic::new("E0411", by.span, "FOR with BY 0 never ends"));
                None
            }
            Val::Int(n) => self.constant_step(n, by.span, elem),
            Val::Expr(e, Type::Elem(t)) if t.is_int() => match e.as_int() {
                Some(0) => {
                    self.report(Diagnostic::new("E0411", by.span, "FOR with BY 0 never ends"));
                    None
                }
                // As far as literals may reach: a wider step would not fit the loop's own arithmetic.
                Some(v) => self.constant_step(crate::ir::value(t, v), by.span, elem),
                None => {
                    let wide = if t.is_signed() { ElemType::Lint } else { ElemType::Ulint };
                    Some(Step::Dynamic(super::conversions::convert(e, wide)))
                }
            },
            Val::Error => None,
            other => {
                let found = self.describe(&other);
                self.report(Diagnostic::new(
                    "E0401",
                    by.span,
                    format!("step of FOR: an integer is needed, found {found}"),
                ));
                None
            }
        }
    }

    fn constant_step(&mut self, n: i128, span: Span, elem: ElemType) -> Option<Step> {
        let (lo, hi) = elem.range();
        match i64::try_from(n) {
            Ok(v) if n.abs() <= hi - lo => Some(Step::Const(v)),
            _ => {
                let d =
                    Diagnostic::new("E0404", span, format!("a step of {n} is wider than {}", elem.name()));
                self.report(d);
                None
            }
        }
    }
}
