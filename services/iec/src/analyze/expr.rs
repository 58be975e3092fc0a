//! Expressions: values and their types.

use super::check::{Checker, Val, int_const};
use super::place::Target;
use crate::artifact::ElemType;
use crate::diagnostic::{Diagnostic, Span};
use crate::ir::{Const, Convert, Expr, ExprKind, fold};
use crate::lexer::literal;
use crate::syntax::ast::{self, Ident, Unary};
use crate::types::{ElemExt, Type, elementary, widens};

impl Checker<'_> {
    /// Value of an expression. `want` is a hint for literals that no operand gives a type to; it forces nothing.
    pub fn expr(&mut self, e: &ast::Expr, want: Option<ElemType>) -> Val {
        match &e.kind {
            ast::ExprKind::Error => Val::Error,
            ast::ExprKind::Int(v) => Val::Int(*v),
            ast::ExprKind::Real(text) => self.real(text, e.span),
            ast::ExprKind::Bool(b) => Val::bool(*b),
            ast::ExprKind::Text => {
                let d = Diagnostic::new("E0906", e.span, "texts (STRING) are not supported yet");
                self.report(d);
                Val::Error
            }
            ast::ExprKind::Typed(prefix, rest) => self.typed(prefix, rest, e.span),
            ast::ExprKind::Name(_)
            | ast::ExprKind::Direct(_)
            | ast::ExprKind::Field(..)
            | ast::ExprKind::Index(..) => match self.place(e) {
                Target::Place(place, ty, _) => self.load(place, &ty),
                Target::Const(c, ty) => constant(c, ty),
                Target::Error => Val::Error,
            },
            ast::ExprKind::Call(callee, args) => self.call(callee, args, e.span, want),
            ast::ExprKind::Unary(op, operand) => self.unary(*op, operand, e.span, want),
            ast::ExprKind::Binary(op, a, b, op_span) => self.binary(*op, a, b, *op_span, want),
        }
    }

    fn real(&mut self, text: &str, span: Span) -> Val {
        match (text.parse::<f64>(), text.parse::<f32>()) {
            (Ok(d), Ok(f)) => Val::Real(d, f),
            _ => self.error("E0103", span, "this is no real number"),
        }
    }

    /// `INT#5`, `T#5s`, `Color#Red`
    fn typed(&mut self, prefix: &Ident, rest: &str, span: Span) -> Val {
        let key = prefix.key();
        let bad = |ck: &mut Self, e| {
            ck.report(crate::syntax::literal_diagnostic(span, e));
            Val::Error
        };
        if matches!(key.as_str(), "T" | "LT" | "TIME" | "LTIME") {
            return match literal::duration(rest) {
                Ok(ns) => Val::elem(Expr::int(ElemType::Time, ns)),
                Err(e) => bad(self, e),
            };
        }
        if let Some(elem) = elementary(&key) {
            if elem == ElemType::Bool
                && (rest.eq_ignore_ascii_case("TRUE") || rest.eq_ignore_ascii_case("FALSE"))
            {
                return Val::bool(rest.eq_ignore_ascii_case("TRUE"));
            }
            let value = if elem.is_real() && !rest.contains('#') {
                match literal::real_text(rest) {
                    Ok(t) => self.real(&t, span),
                    Err(e) => return bad(self, e),
                }
            } else {
                match literal::integer(rest) {
                    Ok(v) => Val::Int(v),
                    Err(e) => return bad(self, e),
                }
            };
            return self.coerce(value, span, &Type::Elem(elem), "literal").map_or(Val::Error, Val::elem);
        }
        if let Some(named) = self.tables.types.get(&key) {
            if let Type::Enum(i) = named.ty {
                let e = &self.tables.enums[i as usize];
                if let Some((_, v)) = e.values.iter().find(|(n, _)| n.text.eq_ignore_ascii_case(rest)) {
                    return constant(Const::I(*v), Type::Enum(i));
                }
                let near = super::resolve::nearest(rest, e.values.iter().map(|v| v.0.text.as_str()));
                let mut d = Diagnostic::new("E0302", span, format!("`{}` has no value `{rest}`", e.name));
                if let Some(n) = near {
                    d = d.help(format!("did you mean `{}#{n}`?", e.name));
                }
                self.report(d);
                return Val::Error;
            }
            return self.error(
                "E0103",
                prefix.span,
                format!("literals of type `{}` are not supported", prefix.text),
            );
        }
        let text = ["STRING", "WSTRING", "CHAR", "WCHAR"].contains(&key.as_str());
        if text || crate::lexer::is_date(&key) {
            return self.error("E0906", span, format!("literals of type {key} are not supported yet"));
        }
        self.error("E0303", prefix.span, format!("there is no type `{}`", prefix.text))
    }

    fn unary(&mut self, op: Unary, operand: &ast::Expr, span: Span, want: Option<ElemType>) -> Val {
        let v = self.expr(operand, want);
        match (op, v) {
            (_, Val::Error) => Val::Error,
            // An enumeration is carried as INT, but its values are no numbers.
            (Unary::Neg | Unary::Plus, v @ Val::Expr(_, Type::Enum(_))) => {
                let text = if op == Unary::Neg { "-" } else { "+" };
                self.bad_operand(text, &v, operand.span)
            }
            (Unary::Plus, v @ (Val::Int(_) | Val::Real(..))) => v,
            (Unary::Neg, Val::Int(v)) => self.literal_in_range(-v, span),
            (Unary::Neg, Val::Real(d, f)) => Val::Real(-d, -f),
            (Unary::Neg, Val::Expr(e, _))
                if (e.ty.is_num() && (e.ty.is_real() || e.ty.is_signed())) || e.ty == ElemType::Time =>
            {
                let ty = e.ty;
                Val::elem(fold(Expr::new(ty, ExprKind::Unary(crate::ir::UnOp::Neg, Box::new(e)))))
            }
            (Unary::Neg, Val::Expr(e, _)) if e.ty.is_int() => {
                let d = Diagnostic::new(
                    "E0402",
                    span,
                    format!("`-` of {}, which holds no negative values", e.ty.name()),
                )
                .help("convert to a signed type first, for example UINT_TO_DINT(x)");
                self.report(d);
                Val::Error
            }
            (Unary::Plus, v @ Val::Expr(..)) => match &v {
                Val::Expr(e, _) if e.ty.is_num() || e.ty == ElemType::Time => v,
                _ => self.bad_operand("+", &v, operand.span),
            },
            (Unary::Not, Val::Expr(e, Type::Elem(ty))) if ty.is_any_bit() => {
                Val::elem(fold(Expr::new(ty, ExprKind::Unary(crate::ir::UnOp::Not, Box::new(e)))))
            }
            // NOT 16#FF: the width comes from the context.
            (Unary::Not, Val::Int(v)) if want.is_some_and(|w| w.is_any_bit()) => {
                let ty = Type::Elem(want.unwrap_or(ElemType::Bool));
                match self.coerce(Val::Int(v), operand.span, &ty, "operand") {
                    Some(e) => {
                        Val::elem(fold(Expr::new(e.ty, ExprKind::Unary(crate::ir::UnOp::Not, Box::new(e)))))
                    }
                    None => Val::Error,
                }
            }
            (Unary::Not, v) => self.bad_operand("NOT", &v, operand.span),
            (Unary::Neg, v) => self.bad_operand("-", &v, operand.span),
            (Unary::Plus, v) => self.bad_operand("+", &v, operand.span),
        }
    }

    pub fn bad_operand(&mut self, op: &str, v: &Val, span: Span) -> Val {
        if matches!(v, Val::Error) {
            return Val::Error;
        }
        let what = self.describe(v);
        let mut d = Diagnostic::new("E0402", span, format!("`{op}` cannot take {what}"));
        if let Val::Expr(e, _) = v {
            if e.ty.is_bits() && !matches!(op, "NOT" | "AND" | "OR" | "XOR") {
                d = d.help(format!(
                    "bit strings are not numbers: convert, for example {}_TO_UDINT(x)",
                    e.ty.name()
                ));
            } else if e.ty.is_int() && matches!(op, "NOT" | "AND" | "OR" | "XOR") {
                d = d.help(format!(
                    "integers are not bit strings: convert, for example {}_TO_DWORD(x)",
                    e.ty.name()
                ));
            }
        }
        self.report(d);
        Val::Error
    }

    /// A folded integer literal must still be a value of some type.
    pub fn literal_in_range(&mut self, v: i128, span: Span) -> Val {
        if v < i128::from(i64::MIN) || v > i128::from(u64::MAX) {
            return self.error("E0104", span, format!("{v} does not fit the largest integer type"));
        }
        Val::Int(v)
    }

    /// The value as one of type `to`, widened if need be; a diagnostic if that would need a conversion.
    pub fn coerce(&mut self, v: Val, span: Span, to: &Type, what: &str) -> Option<Expr> {
        match (v, to) {
            (Val::Error, _) | (_, Type::Error) => None,
            (Val::Expr(e, from), Type::Enum(_)) if from == *to => Some(e),
            (v, Type::Enum(_)) => {
                self.mismatch(&v, span, to, what, None);
                None
            }
            (Val::Expr(_, from @ Type::Enum(_)), _) => {
                let v = Val::Expr(Expr::int(ElemType::Int, 0), from);
                self.mismatch(&v, span, to, what, None);
                None
            }
            (v, Type::Subrange(s)) => {
                let e = self.coerce(v, span, &Type::Elem(s.base), what)?;
                let (lo, hi) = self.range(&e);
                if let Some(c) = e.as_int() {
                    let c = crate::ir::value(s.base, c);
                    if c < s.lo || c > s.hi {
                        let d = Diagnostic::new(
                            "E0404",
                            span,
                            format!("{c} is outside of the subrange {}..{}", s.lo, s.hi),
                        );
                        self.report(d);
                        return None;
                    }
                    return Some(e);
                }
                if lo >= s.lo && hi <= s.hi && !self.options.debug {
                    return Some(e);
                }
                let kind = ExprKind::InRange { value: Box::new(e), lo: s.lo as i64, hi: s.hi as i64 };
                Some(Expr::new(s.base, kind))
            }
            (v, Type::Elem(to)) => self.coerce_elem(v, span, *to, what),
            (v, to) => {
                self.mismatch(&v, span, to, what, None);
                None
            }
        }
    }

    fn coerce_elem(&mut self, v: Val, span: Span, to: ElemType, what: &str) -> Option<Expr> {
        let to_type = Type::Elem(to);
        match v {
            Val::Int(n) => {
                if let Some(c) = int_const(to, n) {
                    return Some(Expr::new(to, ExprKind::Const(c)));
                }
                let d = if to == ElemType::Time {
                    Diagnostic::new("E0401", span, format!("{what}: TIME is needed, found the integer {n}"))
                        .help(format!("write a duration, for example T#{}ms", n.unsigned_abs()))
                } else {
                    let (lo, hi) = to.range();
                    Diagnostic::new("E0404", span, format!("{n} does not fit {}", to.name()))
                        .help(format!("{} holds {lo} to {hi}", to.name()))
                };
                self.report(d);
                None
            }
            Val::Real(d, f) => match to {
                ElemType::Real if f.is_infinite() && d.is_finite() => {
                    let diagnostic = Diagnostic::new("E0404", span, format!("{d:e} does not fit REAL"))
                        .help("REAL holds up to 3.4e38; use LREAL");
                    self.report(diagnostic);
                    None
                }
                ElemType::Real => Some(Expr::new(to, ExprKind::Const(Const::F32(f)))),
                ElemType::Lreal => Some(Expr::new(to, ExprKind::Const(Const::F64(d)))),
                _ => {
                    let help = to.is_int().then(|| format!("convert with REAL_TO_{}", to.name()));
                    self.mismatch(&Val::Real(d, f), span, &to_type, what, help);
                    None
                }
            },
            Val::Expr(e, ty) => {
                if let Some(widened) = Self::widen(e.clone(), to) {
                    return Some(widened);
                }
                let help = Some(format!("convert with {}_TO_{}", e.ty.name(), to.name()));
                self.mismatch(&Val::Expr(e, ty), span, &to_type, what, help);
                None
            }
            other => {
                self.mismatch(&other, span, &to_type, what, None);
                None
            }
        }
    }

    fn mismatch(&mut self, v: &Val, span: Span, to: &Type, what: &str, help: Option<String>) {
        if matches!(v, Val::Error) {
            return;
        }
        let found = self.describe(v);
        let to = self.tables.type_name(to);
        let mut d = Diagnostic::new("E0401", span, format!("{what}: {to} is needed, found {found}"));
        if let Some(h) = help {
            d = d.help(h);
        }
        self.report(d);
    }

    /// Implicit conversion, if the standard has one.
    pub fn widen(e: Expr, to: ElemType) -> Option<Expr> {
        if e.ty == to {
            return Some(e);
        }
        if !widens(e.ty, to) {
            return None;
        }
        let how = match (e.ty.is_real(), to.is_real()) {
            (false, false) => Convert::Wrap,
            (false, true) => Convert::ToFloat,
            _ => Convert::Float,
        };
        Some(fold(Expr::new(to, ExprKind::Convert(how, Box::new(e)))))
    }

    /// A condition.
    pub fn condition(&mut self, e: &ast::Expr, what: &str) -> Expr {
        let v = self.expr(e, Some(ElemType::Bool));
        if let Val::Expr(x, Type::Elem(ElemType::Bool)) = v {
            return x;
        }
        if !matches!(v, Val::Error) {
            let found = self.describe(&v);
            let d = Diagnostic::new("E0401", e.span, format!("{what}: BOOL is needed, found {found}"))
                .help("compare, for example x <> 0");
            self.report(d);
        }
        Expr::int(ElemType::Bool, 0)
    }
}

/// A declared constant keeps its type.
fn constant(c: Const, ty: Type) -> Val {
    match ty.elem() {
        Some(e) => Val::Expr(Expr::new(e, ExprKind::Const(c)), ty.of_value()),
        None => Val::Error,
    }
}
