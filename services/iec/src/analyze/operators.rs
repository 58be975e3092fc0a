//! Binary operators, and the functions that are operators in another dress (ADD, AND, GT ...).

use super::check::{Checker, Val, int_const};
use crate::artifact::ElemType;
use crate::diagnostic::{Diagnostic, Span};
use crate::ir::{BinOp, Const, Convert, Expr, ExprKind, MathFn, fold};
use crate::syntax::ast::{self, Binary};
use crate::types::{ElemExt, Type, common_type, widens};

/// Operators of the IR.
fn ir_op(op: Binary) -> BinOp {
    match op {
        Binary::Or | Binary::OrElse => BinOp::Or,
        Binary::Xor => BinOp::Xor,
        Binary::And | Binary::AndThen => BinOp::And,
        Binary::Eq => BinOp::Eq,
        Binary::Ne => BinOp::Ne,
        Binary::Lt => BinOp::Lt,
        Binary::Gt => BinOp::Gt,
        Binary::Le => BinOp::Le,
        Binary::Ge => BinOp::Ge,
        Binary::Add => BinOp::Add,
        Binary::Sub => BinOp::Sub,
        Binary::Mul => BinOp::Mul,
        Binary::Div => BinOp::Div,
        Binary::Mod | Binary::Power => BinOp::Mod,
    }
}

impl Checker<'_> {
    pub fn binary(
        &mut self,
        op: Binary,
        a: &ast::Expr,
        b: &ast::Expr,
        op_span: Span,
        want: Option<ElemType>,
    ) -> Val {
        let hint = if op.is_comparison() { None } else { want };
        // The left spine of `a + b + c + ...` is walked in a loop: it may be thousands long.
        let mut spine: Vec<(Binary, &ast::Expr, Span)> = vec![(op, b, op_span)];
        let mut left = a;
        while let ast::ExprKind::Binary(op, x, y, span) = &left.kind {
            spine.push((*op, y, *span));
            left = x;
        }
        let inner_hint = |op: Binary| if op.is_comparison() { None } else { hint };
        let innermost = spine.last().map_or(op, |s| s.0);
        let mut value = self.expr(left, inner_hint(innermost));
        let mut span = left.span;
        while let Some((op, right, op_span)) = spine.pop() {
            let r = self.expr(right, inner_hint(op));
            value = self.apply(op, value, span, r, right.span, op_span, inner_hint(op));
            span = span.to(right.span);
        }
        value
    }

    /// One operation on two values.
    #[allow(clippy::too_many_arguments)]
    pub fn apply(
        &mut self,
        op: Binary,
        a: Val,
        a_span: Span,
        b: Val,
        b_span: Span,
        op_span: Span,
        want: Option<ElemType>,
    ) -> Val {
        if matches!(a, Val::Error) || matches!(b, Val::Error) {
            return Val::Error;
        }
        for (v, span) in [(&a, a_span), (&b, b_span)] {
            if matches!(v, Val::Whole(..)) {
                return self.bad_operand(op.text(), v, span);
            }
        }
        match (&a, &b) {
            (Val::Int(x), Val::Int(y)) => return self.int_literals(op, *x, *y, a_span.to(b_span), b_span),
            _ if op == Binary::Power => return self.power(a, a_span, b, b_span, want),
            (Val::Int(_) | Val::Real(..), Val::Int(_) | Val::Real(..)) => {
                return self.real_literals(op, &a, &b, a_span.to(b_span));
            }
            _ => {}
        }
        if let Some(v) = self.enums(op, &a, &b, op_span) {
            return v;
        }
        let is_time = |v: &Val| matches!(v, Val::Expr(e, _) if e.ty == ElemType::Time);
        if is_time(&a) || is_time(&b) {
            return self.time(op, a, a_span, b, b_span, op_span);
        }
        let Some((x, y)) = self.unify(op.text(), a, a_span, b, b_span, op_span, want) else {
            return Val::Error;
        };
        self.operate(op, x, a_span, y, b_span)
    }

    fn operate(&mut self, op: Binary, x: Expr, a_span: Span, y: Expr, b_span: Span) -> Val {
        let ty = x.ty;
        let allowed = match op {
            Binary::Or | Binary::Xor | Binary::And => ty.is_any_bit(),
            Binary::OrElse | Binary::AndThen => ty == ElemType::Bool,
            Binary::Mod => ty.is_int(),
            Binary::Add | Binary::Sub | Binary::Mul | Binary::Div | Binary::Power => ty.is_num(),
            _ => true,
        };
        if !allowed {
            // The side whose own type is the wrong one, if literals came to it.
            return self.bad_operand(op.text(), &Val::elem(x), a_span);
        }
        if matches!(op, Binary::Div | Binary::Mod) && y.as_int() == Some(0) && ty.is_int() {
            if op == Binary::Mod {
                self.report(
                    Diagnostic::new("W0203", b_span, "MOD by the constant 0")
                        .help("the standard defines the result as 0; `mod_by_zero` can make it a fault"),
                );
            } else {
                let d = Diagnostic::new("E0405", b_span, "division by the constant 0");
                self.report(d);
                return Val::Error;
            }
        }
        if matches!(op, Binary::AndThen | Binary::OrElse) {
            let kind =
                ExprKind::ShortCircuit { and: op == Binary::AndThen, left: Box::new(x), right: Box::new(y) };
            return Val::elem(Expr::new(ElemType::Bool, kind));
        }
        let result = if op.is_comparison() { ElemType::Bool } else { ty };
        Val::elem(fold(Expr::new(result, ExprKind::Binary(ir_op(op), Box::new(x), Box::new(y)))))
    }

    fn enums(&mut self, op: Binary, a: &Val, b: &Val, op_span: Span) -> Option<Val> {
        let of = |v: &Val| match v {
            Val::Expr(_, t @ Type::Enum(_)) => Some(t.clone()),
            _ => None,
        };
        let (x, y) = (of(a), of(b));
        if x.is_none() && y.is_none() {
            return None;
        }
        if x != y || !matches!(op, Binary::Eq | Binary::Ne) {
            let (l, r) = (self.describe(a), self.describe(b));
            let d = Diagnostic::new("E0402", op_span, format!("`{}` cannot join {l} and {r}", op.text()))
                .help("values of one enumeration can be compared with = and <>");
            self.report(d);
            return Some(Val::Error);
        }
        None
    }

    /// Brings two operands to one type.
    #[allow(clippy::too_many_arguments)]
    pub fn unify(
        &mut self,
        op: &str,
        a: Val,
        a_span: Span,
        b: Val,
        b_span: Span,
        op_span: Span,
        want: Option<ElemType>,
    ) -> Option<(Expr, Expr)> {
        match (a, b) {
            (Val::Expr(x, tx), Val::Expr(y, ty)) => {
                let Some(common) = common_type(x.ty, y.ty) else {
                    let (l, r) = (self.tables.type_name(&tx), self.tables.type_name(&ty));
                    let d = Diagnostic::new(
                        "E0403",
                        op_span,
                        format!("`{op}` has no common type for {l} and {r}"),
                    )
                    .also(a_span, l)
                    .also(b_span, r)
                    .help("convert one side with an X_TO_Y function");
                    self.report(d);
                    return None;
                };
                Some((Self::widen(x, common)?, Self::widen(y, common)?))
            }
            (lit, Val::Expr(y, _)) => {
                let (l, y) = self.adapt(op, lit, a_span, y, op_span, want)?;
                Some((l, y))
            }
            (Val::Expr(x, _), lit) => {
                let (l, x) = self.adapt(op, lit, b_span, x, op_span, want)?;
                Some((x, l))
            }
            _ => None,
        }
    }

    /// A literal beside a value: the literal takes the value's type if it fits, else the value widens.
    fn adapt(
        &mut self,
        op: &str,
        lit: Val,
        span: Span,
        e: Expr,
        op_span: Span,
        want: Option<ElemType>,
    ) -> Option<(Expr, Expr)> {
        let ty = e.ty;
        match lit {
            Val::Int(n) => {
                if let Some(c) = int_const(ty, n) {
                    return Some((Expr::new(ty, ExprKind::Const(c)), e));
                }
                let chain: &[ElemType] = if ty.is_int() {
                    &[
                        ElemType::Int,
                        ElemType::Uint,
                        ElemType::Dint,
                        ElemType::Udint,
                        ElemType::Lint,
                        ElemType::Ulint,
                    ]
                } else if ty.is_any_bit() {
                    &[ElemType::Byte, ElemType::Word, ElemType::Dword, ElemType::Lword]
                } else {
                    &[]
                };
                for wide in chain {
                    if widens(ty, *wide)
                        && let Some(c) = int_const(*wide, n)
                    {
                        let e = Self::widen(e, *wide)?;
                        return Some((Expr::new(*wide, ExprKind::Const(c)), e));
                    }
                }
                let d = Diagnostic::new(
                    "E0404",
                    span,
                    format!("{n} does not fit {} or a type it widens to", ty.name()),
                );
                self.report(d);
                None
            }
            Val::Real(d, f) => {
                let to = match ty {
                    t if t.is_real() => t,
                    t if widens(t, ElemType::Real) && want != Some(ElemType::Lreal) => ElemType::Real,
                    t if widens(t, ElemType::Lreal) => ElemType::Lreal,
                    _ => {
                        let d = Diagnostic::new(
                            "E0403",
                            op_span,
                            format!("`{op}` has no common type for {} and a real number", ty.name()),
                        )
                        .also(span, "this is real")
                        .help("convert one side with an X_TO_Y function");
                        self.report(d);
                        return None;
                    }
                };
                let literal = self.coerce(Val::Real(d, f), span, &Type::Elem(to), "operand")?;
                let e = Self::widen(e, to)?;
                Some((literal, e))
            }
            _ => None,
        }
    }

    fn int_literals(&mut self, op: Binary, x: i128, y: i128, span: Span, b_span: Span) -> Val {
        let v = match op {
            Binary::Add => x + y,
            Binary::Sub => x - y,
            Binary::Mul => match x.checked_mul(y) {
                Some(v) => v,
                None => return self.error("E0104", span, "the value does not fit the largest integer type"),
            },
            Binary::Div if y == 0 => return self.error("E0405", b_span, "division by the constant 0"),
            Binary::Div => x / y,
            Binary::Mod if y == 0 => 0,
            Binary::Mod => x % y,
            Binary::And | Binary::AndThen => x & y,
            Binary::Or | Binary::OrElse => x | y,
            Binary::Xor => x ^ y,
            Binary::Eq => return Val::bool(x == y),
            Binary::Ne => return Val::bool(x != y),
            Binary::Lt => return Val::bool(x < y),
            Binary::Gt => return Val::bool(x > y),
            Binary::Le => return Val::bool(x <= y),
            Binary::Ge => return Val::bool(x >= y),
            Binary::Power => match u32::try_from(y).ok().and_then(|n| x.checked_pow(n)) {
                Some(v) => v,
                None if y < 0 => {
                    return self.error(
                        "E0402",
                        b_span,
                        "an integer literal to a negative power; write the base as a real number, like 2.0",
                    );
                }
                None => return self.error("E0104", span, "the value does not fit the largest integer type"),
            },
        };
        self.literal_in_range(v, span)
    }

    fn real_literals(&mut self, op: Binary, a: &Val, b: &Val, span: Span) -> Val {
        let value = |v: &Val| match v {
            Val::Int(n) => *n as f64,
            Val::Real(d, _) => *d,
            _ => 0.0,
        };
        let (x, y) = (value(a), value(b));
        let d = match op {
            Binary::Add => x + y,
            Binary::Sub => x - y,
            Binary::Mul => x * y,
            Binary::Div => x / y,
            Binary::Eq => return Val::bool(x == y),
            Binary::Ne => return Val::bool(x != y),
            Binary::Lt => return Val::bool(x < y),
            Binary::Gt => return Val::bool(x > y),
            Binary::Le => return Val::bool(x <= y),
            Binary::Ge => return Val::bool(x >= y),
            _ => return self.bad_operand(op.text(), if matches!(a, Val::Real(..)) { a } else { b }, span),
        };
        if !d.is_finite() {
            return self.error("E0104", span, "the value is no finite number");
        }
        // Literals are reckoned as LREAL, whatever they become.
        Val::Real(d, d as f32)
    }

    /// `a ** b`, EXPT: the base is REAL or LREAL.
    pub fn power(&mut self, a: Val, a_span: Span, b: Val, b_span: Span, want: Option<ElemType>) -> Val {
        let real_of = |v: &Val| match v {
            Val::Expr(e, _) if e.ty.is_real() => Some(e.ty),
            Val::Expr(e, _) if e.ty.is_int() => {
                Some(if widens(e.ty, ElemType::Real) { ElemType::Real } else { ElemType::Lreal })
            }
            _ => None,
        };
        let mut ty = real_of(&a).or(want.filter(|w| w.is_real())).unwrap_or(ElemType::Lreal);
        // An LREAL exponent makes the whole LREAL.
        if matches!(&b, Val::Expr(e, _) if e.ty == ElemType::Lreal)
            || (matches!(&a, Val::Expr(e, _) if !e.ty.is_real()) && want == Some(ElemType::Lreal))
        {
            ty = ElemType::Lreal;
        }
        let base = self.as_real(a, a_span, ty);
        let exponent = self.as_real(b, b_span, ty);
        let (Some(x), Some(y)) = (base, exponent) else { return Val::Error };
        Val::elem(Expr::new(ty, ExprKind::Math(MathFn::Expt, vec![x, y])))
    }

    /// Any number as REAL or LREAL.
    pub fn as_real(&mut self, v: Val, span: Span, ty: ElemType) -> Option<Expr> {
        match v {
            Val::Expr(e, t) if e.ty.is_int() && !matches!(t, Type::Enum(_)) => {
                Some(fold(Expr::new(ty, ExprKind::Convert(Convert::ToFloat, Box::new(e)))))
            }
            v @ (Val::Expr(..) | Val::Int(_) | Val::Real(..)) => {
                self.coerce(v, span, &Type::Elem(ty), "operand")
            }
            Val::Error => None,
            other => {
                self.bad_operand("**", &other, span);
                None
            }
        }
    }

    /// TIME with TIME, and TIME with numbers.
    fn time(&mut self, op: Binary, a: Val, a_span: Span, b: Val, b_span: Span, op_span: Span) -> Val {
        let is_time = |v: &Val| matches!(v, Val::Expr(e, _) if e.ty == ElemType::Time);
        match (is_time(&a), is_time(&b)) {
            (true, true) => {
                if !matches!(op, Binary::Add | Binary::Sub) && !op.is_comparison() {
                    let d = Diagnostic::new(
                        "E0402",
                        op_span,
                        format!("`{}` cannot join TIME and TIME", op.text()),
                    )
                    .help("convert, for example TIME_TO_LINT(a) / TIME_TO_LINT(b)");
                    self.report(d);
                    return Val::Error;
                }
                let (Val::Expr(x, _), Val::Expr(y, _)) = (a, b) else { return Val::Error };
                Self::operate_time(op, x, y)
            }
            (true, false) if matches!(op, Binary::Mul | Binary::Div) => {
                let Val::Expr(t, _) = a else { return Val::Error };
                self.scale_time(op, t, b, b_span)
            }
            (false, true) if op == Binary::Mul => {
                let Val::Expr(t, _) = b else { return Val::Error };
                self.scale_time(op, t, a, a_span)
            }
            _ => {
                let (l, r) = (self.describe(&a), self.describe(&b));
                let d = Diagnostic::new("E0403", op_span, format!("`{}` cannot join {l} and {r}", op.text()))
                    .help("write a duration like T#5s, or convert");
                self.report(d);
                Val::Error
            }
        }
    }

    fn operate_time(op: Binary, x: Expr, y: Expr) -> Val {
        let result = if op.is_comparison() { ElemType::Bool } else { ElemType::Time };
        Val::elem(fold(Expr::new(result, ExprKind::Binary(ir_op(op), Box::new(x), Box::new(y)))))
    }

    /// TIME times or divided by a number.
    pub fn scale_time(&mut self, op: Binary, time: Expr, by: Val, span: Span) -> Val {
        let real = match &by {
            Val::Real(..) => true,
            Val::Expr(e, _) => e.ty.is_real(),
            _ => false,
        };
        if real {
            let Some(by) = self.coerce(by, span, &Type::Elem(ElemType::Lreal), "factor") else {
                return Val::Error;
            };
            let t = fold(Expr::new(ElemType::Lreal, ExprKind::Convert(Convert::ToFloat, Box::new(time))));
            let product =
                fold(Expr::new(ElemType::Lreal, ExprKind::Binary(ir_op(op), Box::new(t), Box::new(by))));
            return Val::elem(fold(Expr::new(
                ElemType::Time,
                ExprKind::Convert(Convert::Round, Box::new(product)),
            )));
        }
        let factor = match by {
            Val::Int(0) if op == Binary::Div => {
                return self.error("E0405", span, "division by the constant 0");
            }
            Val::Int(n) => match i64::try_from(n) {
                Ok(n) => Expr::int(ElemType::Time, n),
                Err(_) => return self.error("E0404", span, format!("{n} does not fit LINT")),
            },
            Val::Expr(e, _) if e.ty.is_int() => {
                fold(Expr::new(ElemType::Time, ExprKind::Convert(Convert::Wrap, Box::new(e))))
            }
            other => return self.bad_operand(op.text(), &other, span),
        };
        Self::operate_time(op, time, factor)
    }

    /// A literal that nothing gives a type to: DINT if it fits, then LINT, ULINT; LREAL.
    pub fn literal_default(&mut self, v: &Val, span: Span, want: Option<ElemType>) -> Option<Expr> {
        match v {
            Val::Int(n) => {
                let fits = |t: &ElemType| int_const(*t, *n).map(|c| Expr::new(*t, ExprKind::Const(c)));
                want.iter()
                    .filter(|t| **t != ElemType::Time)
                    .chain(&[ElemType::Dint, ElemType::Lint, ElemType::Ulint])
                    .find_map(fits)
            }
            Val::Real(d, f) => Some(match want {
                Some(ElemType::Real) if f.is_finite() => {
                    Expr::new(ElemType::Real, ExprKind::Const(Const::F32(*f)))
                }
                _ => Expr::new(ElemType::Lreal, ExprKind::Const(Const::F64(*d))),
            }),
            Val::Expr(e, _) => Some(e.clone()),
            Val::Error => None,
            other @ Val::Whole(..) => {
                let what = self.describe(other);
                self.report(Diagnostic::new("E0401", span, format!("a value is needed here, not {what}")));
                None
            }
        }
    }
}
