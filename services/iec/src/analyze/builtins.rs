//! The standard functions.

use super::check::{Checker, Val};
use super::conversions::conversion;
use crate::artifact::ElemType;
use crate::diagnostic::{Diagnostic, Span};
use crate::ir::{BinOp, Expr, ExprKind, MathFn, UnOp, fold};
use crate::syntax::ast::{self, Arg, Binary, Ident};
use crate::types::{ElemExt, Type};

/// What a standard function does.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Abs,
    Sqrt,
    Math(MathFn),
    Expt,
    /// An operator on two or more operands.
    Chain(Binary),
    /// An operator on exactly two.
    Pair(Binary),
    Not,
    Shift(BinOp),
    Sel,
    Extreme(BinOp),
    Limit,
    Mux,
    Move,
}

/// Name, what it does, names of the parameters (the last one ends with `..` where more may follow), least number.
const TABLE: &[(&str, Kind, &[&str], usize)] = &[
    ("ABS", Kind::Abs, &["IN"], 1),
    ("SQRT", Kind::Sqrt, &["IN"], 1),
    ("LN", Kind::Math(MathFn::Ln), &["IN"], 1),
    ("LOG", Kind::Math(MathFn::Log), &["IN"], 1),
    ("EXP", Kind::Math(MathFn::Exp), &["IN"], 1),
    ("SIN", Kind::Math(MathFn::Sin), &["IN"], 1),
    ("COS", Kind::Math(MathFn::Cos), &["IN"], 1),
    ("TAN", Kind::Math(MathFn::Tan), &["IN"], 1),
    ("ASIN", Kind::Math(MathFn::Asin), &["IN"], 1),
    ("ACOS", Kind::Math(MathFn::Acos), &["IN"], 1),
    ("ATAN", Kind::Math(MathFn::Atan), &["IN"], 1),
    ("EXPT", Kind::Expt, &["IN1", "IN2"], 2),
    ("ADD", Kind::Chain(Binary::Add), &["IN1.."], 2),
    ("MUL", Kind::Chain(Binary::Mul), &["IN1.."], 2),
    ("SUB", Kind::Pair(Binary::Sub), &["IN1", "IN2"], 2),
    ("DIV", Kind::Pair(Binary::Div), &["IN1", "IN2"], 2),
    ("MOD", Kind::Pair(Binary::Mod), &["IN1", "IN2"], 2),
    ("ADD_TIME", Kind::Pair(Binary::Add), &["IN1", "IN2"], 2),
    ("SUB_TIME", Kind::Pair(Binary::Sub), &["IN1", "IN2"], 2),
    ("MUL_TIME", Kind::Pair(Binary::Mul), &["IN1", "IN2"], 2),
    ("MULTIME", Kind::Pair(Binary::Mul), &["IN1", "IN2"], 2),
    ("DIV_TIME", Kind::Pair(Binary::Div), &["IN1", "IN2"], 2),
    ("DIVTIME", Kind::Pair(Binary::Div), &["IN1", "IN2"], 2),
    ("AND", Kind::Chain(Binary::And), &["IN1.."], 2),
    ("OR", Kind::Chain(Binary::Or), &["IN1.."], 2),
    ("XOR", Kind::Chain(Binary::Xor), &["IN1.."], 2),
    ("NOT", Kind::Not, &["IN"], 1),
    ("SHL", Kind::Shift(BinOp::Shl), &["IN", "N"], 2),
    ("SHR", Kind::Shift(BinOp::Shr), &["IN", "N"], 2),
    ("ROL", Kind::Shift(BinOp::Rol), &["IN", "N"], 2),
    ("ROR", Kind::Shift(BinOp::Ror), &["IN", "N"], 2),
    ("SEL", Kind::Sel, &["G", "IN0", "IN1"], 3),
    ("MAX", Kind::Extreme(BinOp::Max), &["IN1.."], 2),
    ("MIN", Kind::Extreme(BinOp::Min), &["IN1.."], 2),
    ("LIMIT", Kind::Limit, &["MN", "IN", "MX"], 3),
    ("MUX", Kind::Mux, &["K", "IN0.."], 2),
    ("GT", Kind::Pair(Binary::Gt), &["IN1", "IN2"], 2),
    ("GE", Kind::Pair(Binary::Ge), &["IN1", "IN2"], 2),
    ("EQ", Kind::Pair(Binary::Eq), &["IN1", "IN2"], 2),
    ("LE", Kind::Pair(Binary::Le), &["IN1", "IN2"], 2),
    ("LT", Kind::Pair(Binary::Lt), &["IN1", "IN2"], 2),
    ("NE", Kind::Pair(Binary::Ne), &["IN1", "IN2"], 2),
    ("MOVE", Kind::Move, &["IN"], 1),
];

/// Functions of the standard that are not there yet.
const MISSING: &[&str] = &[
    "LEN",
    "LEFT",
    "RIGHT",
    "MID",
    "CONCAT",
    "INSERT",
    "DELETE",
    "REPLACE",
    "FIND",
    "ADR",
    "SIZEOF",
    "ATAN2",
    "CEIL",
    "FLOOR",
    "ROUND",
    "REF",
    "CONCAT_DATE",
    "CONCAT_TOD",
    "DAY_OF_WEEK",
    "SPLIT_DATE",
    "IS_VALID",
    "LOWER_BOUND",
    "UPPER_BOUND",
];

/// True for the name (upper case) of a standard function.
pub fn is_builtin(name: &str) -> bool {
    TABLE.iter().any(|t| t.0 == name) || conversion(name).is_some()
}

/// True for a standard function that is known and not supported yet.
pub fn is_missing(name: &str) -> bool {
    let string = |n: &str| {
        n.contains("STRING")
            || n.contains("DATE")
            || n.contains("TOD")
            || n.contains("BCD")
            || n.contains("CHAR")
    };
    MISSING.contains(&name) || (name.contains("_TO_") && string(name))
}

/// All names, for "did you mean".
pub fn names() -> impl Iterator<Item = &'static str> {
    TABLE.iter().map(|t| t.0)
}

impl Checker<'_> {
    /// Calls a standard function; `None` if there is none of this name.
    pub fn builtin(
        &mut self,
        callee: &Ident,
        args: &[Arg],
        span: Span,
        want: Option<ElemType>,
    ) -> Option<Val> {
        let key = callee.key();
        if key == "__NOW" {
            return Some(Val::elem(Expr::new(ElemType::Time, ExprKind::Now)));
        }
        if let Some(c) = conversion(&key) {
            let Some(inputs) = self.match_args(callee, args, &["IN"], 1, span) else {
                return Some(Val::Error);
            };
            let hint = c.from;
            let v = self.expr(inputs[0], hint);
            return Some(self.convert_call(c, v, inputs[0].span, want));
        }
        let (name, kind, params, least) = *TABLE.iter().find(|t| t.0 == key)?;
        let Some(inputs) = self.match_args(callee, args, params, least, span) else {
            return Some(Val::Error);
        };
        Some(self.call_builtin(name, kind, &inputs, span, want))
    }

    /// Arguments in order of the parameters.
    fn match_args<'e>(
        &mut self,
        callee: &Ident,
        args: &'e [Arg],
        params: &[&str],
        least: usize,
        span: Span,
    ) -> Option<Vec<&'e ast::Expr>> {
        let endless = params.last().is_some_and(|p| p.ends_with(".."));
        let most = if endless { usize::MAX } else { params.len() };
        let count_error = |n: usize| {
            let expected = if endless { format!("{least} or more") } else { least.to_string() };
            Diagnostic::new(
                "E0501",
                span,
                format!("{} takes {expected} argument(s), {n} given", callee.text.to_ascii_uppercase()),
            )
        };
        if args.iter().all(|a| a.name.is_none()) {
            if args.len() < least || args.len() > most {
                self.report(count_error(args.len()));
                return None;
            }
            return Some(args.iter().filter_map(|a| a.value.as_ref()).collect());
        }
        let mut slots: Vec<Option<&ast::Expr>> = Vec::new();
        for a in args {
            let Some(name) = &a.name else {
                self.report(mixed(a.span));
                return None;
            };
            let position = position(params, &name.key());
            let (Some(i), false, Some(value)) =
                (position.filter(|i| *i < most.min(args.len())), a.output, &a.value)
            else {
                let known: Vec<&str> = params.to_vec();
                let d = Diagnostic::new(
                    "E0502",
                    name.span,
                    format!("{} has no input `{}`", callee.text.to_ascii_uppercase(), name.text),
                )
                .help(format!("its inputs: {}", known.join(", ")));
                self.report(d);
                return None;
            };
            if slots.len() <= i {
                slots.resize(i + 1, None);
            }
            if slots[i].is_some() {
                self.report(Diagnostic::new("E0503", name.span, format!("`{}` is given twice", name.text)));
                return None;
            }
            slots[i] = Some(value);
        }
        let found: Vec<&ast::Expr> = slots.iter().flatten().copied().collect();
        if found.len() != slots.len() || found.len() < least {
            self.report(count_error(found.len()));
            return None;
        }
        Some(found)
    }

    fn call_builtin(
        &mut self,
        name: &str,
        kind: Kind,
        inputs: &[&ast::Expr],
        span: Span,
        want: Option<ElemType>,
    ) -> Val {
        match kind {
            Kind::Abs => self.abs(inputs[0], want),
            Kind::Sqrt | Kind::Math(_) => self.math(name, kind, inputs[0], want),
            Kind::Expt => {
                let hint = want.filter(|w| w.is_real());
                let (a, b) = (self.expr(inputs[0], hint), self.expr(inputs[1], None));
                self.power(a, inputs[0].span, b, inputs[1].span, hint)
            }
            Kind::Chain(op) | Kind::Pair(op) => {
                let hint = if op.is_comparison() { None } else { want };
                let mut value = self.expr(inputs[0], hint);
                let mut value_span = inputs[0].span;
                for next in &inputs[1..] {
                    let v = self.expr(next, hint);
                    value = self.apply(op, value, value_span, v, next.span, span, hint);
                    value_span = value_span.to(next.span);
                }
                value
            }
            Kind::Not => {
                let e = ast::Expr {
                    span,
                    kind: ast::ExprKind::Unary(ast::Unary::Not, Box::new(inputs[0].clone())),
                };
                self.expr(&e, want)
            }
            Kind::Shift(op) => self.shift(name, op, inputs, want),
            Kind::Sel => self.sel(inputs, span, want),
            Kind::Extreme(op) => {
                let Some((values, _)) = self.same_type(name, inputs, span, want, false) else {
                    return Val::Error;
                };
                Val::elem(reduce(op, values))
            }
            Kind::Limit => {
                let Some((values, _)) = self.same_type(name, inputs, span, want, false) else {
                    return Val::Error;
                };
                let mut it = values.into_iter();
                let (Some(mn), Some(x), Some(mx)) = (it.next(), it.next(), it.next()) else {
                    return Val::Error;
                };
                let low = reduce(BinOp::Max, vec![x, mn]);
                Val::elem(reduce(BinOp::Min, vec![low, mx]))
            }
            Kind::Mux => self.mux(inputs, span, want),
            Kind::Move => {
                let v = self.expr(inputs[0], want);
                if matches!(v, Val::Whole(..)) { self.bad_operand(name, &v, inputs[0].span) } else { v }
            }
        }
    }

    fn abs(&mut self, input: &ast::Expr, want: Option<ElemType>) -> Val {
        match self.expr(input, want) {
            Val::Int(v) => self.literal_in_range(v.abs(), input.span),
            Val::Real(d, f) => Val::Real(d.abs(), f.abs()),
            Val::Expr(e, t) if e.ty.is_num() && !matches!(t, Type::Enum(_)) => {
                if e.ty.is_int() && !e.ty.is_signed() {
                    return Val::elem(e);
                }
                Val::elem(fold(Expr::new(e.ty, ExprKind::Unary(UnOp::Abs, Box::new(e)))))
            }
            v => self.bad_operand("ABS", &v, input.span),
        }
    }

    fn math(&mut self, name: &str, kind: Kind, input: &ast::Expr, want: Option<ElemType>) -> Val {
        let hint = want.filter(|w| w.is_real());
        let v = self.expr(input, hint);
        let ty = match &v {
            Val::Expr(e, Type::Elem(_)) if e.ty.is_real() => e.ty,
            Val::Int(_) | Val::Real(..) => hint.unwrap_or(ElemType::Lreal),
            other => {
                let v = other.clone();
                if let Val::Expr(e, _) = &v
                    && e.ty.is_int()
                {
                    let d = Diagnostic::new(
                        "E0402",
                        input.span,
                        format!("{name} takes REAL or LREAL, not {}", e.ty.name()),
                    )
                    .help(format!("convert with {}_TO_REAL", e.ty.name()));
                    self.report(d);
                    return Val::Error;
                }
                return self.bad_operand(name, &v, input.span);
            }
        };
        let Some(e) = self.coerce(v, input.span, &Type::Elem(ty), "argument") else { return Val::Error };
        Val::elem(fold(match kind {
            Kind::Math(f) => Expr::new(ty, ExprKind::Math(f, vec![e])),
            _ => Expr::new(ty, ExprKind::Unary(UnOp::Sqrt, Box::new(e))),
        }))
    }

    fn shift(&mut self, name: &str, op: BinOp, inputs: &[&ast::Expr], want: Option<ElemType>) -> Val {
        let hint = want.filter(|w| w.is_bits());
        let value = match self.expr(inputs[0], hint) {
            v @ Val::Int(_) => {
                let Some(ty) = hint else {
                    let d = Diagnostic::new(
                        "E0402",
                        inputs[0].span,
                        format!("{name} needs to know the width of its value"),
                    )
                    .help("write the literal with its type, for example WORD#16#8001");
                    self.report(d);
                    return Val::Error;
                };
                self.coerce(v, inputs[0].span, &Type::Elem(ty), "argument")
            }
            Val::Expr(e, Type::Elem(ty)) if ty.is_any_bit() => Some(e),
            Val::Error => None,
            v => {
                if let Val::Expr(e, _) = &v
                    && e.ty.is_int()
                {
                    let d = Diagnostic::new(
                        "E0402",
                        inputs[0].span,
                        format!("{name} takes a bit string, not {}", e.ty.name()),
                    )
                    .help(format!("convert, for example {}_TO_WORD(x)", e.ty.name()));
                    self.report(d);
                    return Val::Error;
                }
                return self.bad_operand(name, &v, inputs[0].span);
            }
        };
        let count = self.expr(inputs[1], None);
        let count = match count {
            Val::Int(n) => {
                Some(Expr::int(ElemType::Dint, n.clamp(i128::from(i32::MIN), i128::from(i32::MAX)) as i64))
            }
            Val::Expr(e, Type::Elem(ty)) if ty.is_int() => {
                let to = if ty.is_wide() || ty == ElemType::Udint { ElemType::Lint } else { ElemType::Dint };
                Some(super::conversions::convert(e, to))
            }
            Val::Error => None,
            v => return self.bad_operand(name, &v, inputs[1].span),
        };
        let (Some(value), Some(count)) = (value, count) else { return Val::Error };
        Val::elem(fold(Expr::new(value.ty, ExprKind::Binary(op, Box::new(value), Box::new(count)))))
    }

    fn sel(&mut self, inputs: &[&ast::Expr], span: Span, want: Option<ElemType>) -> Val {
        let cond = self.condition(inputs[0], "G of SEL");
        let Some((values, ty)) = self.same_type("SEL", &inputs[1..], span, want, true) else {
            return Val::Error;
        };
        let mut it = values.into_iter();
        let (Some(zero), Some(one)) = (it.next(), it.next()) else { return Val::Error };
        let elem = zero.ty;
        Val::Expr(fold(Expr::new(elem, ExprKind::Select(Box::new(cond), Box::new(one), Box::new(zero)))), ty)
    }

    fn mux(&mut self, inputs: &[&ast::Expr], span: Span, want: Option<ElemType>) -> Val {
        let selector = self.expr(inputs[0], None);
        let Some((values, ty)) = self.same_type("MUX", &inputs[1..], span, want, true) else {
            return Val::Error;
        };
        let selector = match selector {
            Val::Int(k) => {
                let chosen = usize::try_from(k).ok().and_then(|k| values.into_iter().nth(k));
                return match chosen {
                    Some(e) => Val::Expr(e, ty),
                    None => self.error(
                        "E0406",
                        inputs[0].span,
                        format!("K of MUX is {k}; there are inputs IN0 to IN{}", inputs.len() - 2),
                    ),
                };
            }
            Val::Expr(e, Type::Elem(t)) if t.is_int() => e,
            Val::Error => return Val::Error,
            v => return self.bad_operand("MUX", &v, inputs[0].span),
        };
        let elem = values.first().map_or(ElemType::Dint, |v| v.ty);
        Val::Expr(Expr::new(elem, ExprKind::Mux(Box::new(selector), values)), ty)
    }

    /// Values brought to one elementary type (or all of one enumeration, where that is allowed).
    fn same_type(
        &mut self,
        name: &str,
        inputs: &[&ast::Expr],
        span: Span,
        want: Option<ElemType>,
        any: bool,
    ) -> Option<(Vec<Expr>, Type)> {
        let values: Vec<(Val, Span)> = inputs.iter().map(|e| (self.expr(e, want), e.span)).collect();
        if values.iter().any(|(v, _)| matches!(v, Val::Error)) {
            return None;
        }
        for (v, s) in &values {
            if matches!(v, Val::Whole(..)) {
                self.bad_operand(name, v, *s);
                return None;
            }
        }
        if let Some(enumeration) = values.iter().find_map(|(v, _)| match v {
            Val::Expr(_, t @ Type::Enum(_)) => Some(t.clone()),
            _ => None,
        }) {
            if !any {
                self.bad_operand(name, &values[0].0, values[0].1);
                return None;
            }
            let mut out = Vec::new();
            for (v, s) in values {
                out.push(self.coerce(v, s, &enumeration, "input")?);
            }
            return Some((out, enumeration));
        }
        // The common type of all: literals follow the values.
        let mut common: Option<Expr> = None;
        for (v, s) in &values {
            if let Val::Expr(e, _) = v {
                common = Some(match common {
                    None => e.clone(),
                    Some(c) => self.unify(name, Val::elem(c), *s, v.clone(), *s, span, want)?.0,
                });
            }
        }
        for (v, s) in &values {
            if let (Val::Int(_) | Val::Real(..), Some(c)) = (v, &common) {
                common = Some(self.unify(name, Val::elem(c.clone()), *s, v.clone(), *s, span, want)?.0);
            }
        }
        let ty = match common {
            Some(c) => c.ty,
            None => Self::literal_type(&values, want),
        };
        let mut out = Vec::new();
        for (v, s) in values {
            out.push(self.coerce(v, s, &Type::Elem(ty), "input")?);
        }
        Some((out, Type::Elem(ty)))
    }

    /// A type for literals among themselves.
    fn literal_type(values: &[(Val, Span)], want: Option<ElemType>) -> ElemType {
        if values.iter().any(|(v, _)| matches!(v, Val::Real(..))) {
            return want.filter(|w| w.is_real()).unwrap_or(ElemType::Lreal);
        }
        let fits = |t: &ElemType| {
            values.iter().all(|(v, _)| matches!(v, Val::Int(n) if super::check::int_const(*t, *n).is_some()))
        };
        want.iter()
            .chain(&[ElemType::Dint, ElemType::Lint, ElemType::Ulint])
            .copied()
            .find(|t| fits(t))
            .unwrap_or(ElemType::Lint)
    }
}

/// Named and positional arguments in one call.
pub fn mixed(span: Span) -> Diagnostic {
    Diagnostic::new("E0504", span, "arguments are given either all by name or all by position")
        .help("add `name :=` before this one")
}

fn position(params: &[&str], key: &str) -> Option<usize> {
    if let Some(i) = params.iter().position(|p| *p == key) {
        return Some(i);
    }
    // IN1, IN2 ... from the last parameter on.
    let last = params.last()?.strip_suffix("..")?;
    let first: usize = last.strip_prefix("IN")?.parse().ok()?;
    let n: usize = key.strip_prefix("IN")?.parse().ok()?;
    n.checked_sub(first).filter(|i| *i < crate::limits::CHAIN).map(|i| i + params.len() - 1)
}

fn reduce(op: BinOp, values: Vec<Expr>) -> Expr {
    let mut it = values.into_iter();
    let Some(mut acc) = it.next() else { return Expr::int(ElemType::Dint, 0) };
    for v in it {
        acc = fold(Expr::new(acc.ty, ExprKind::Binary(op, Box::new(acc), Box::new(v))));
    }
    acc
}
