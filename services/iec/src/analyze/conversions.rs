//! `X_TO_Y`, `TO_Y`, `X_TRUNC_Y`, TRUNC.

use super::check::{Checker, Val};
use crate::artifact::ElemType;
use crate::diagnostic::Span;
use crate::ir::{BinOp, Convert, Expr, ExprKind, fold};
use crate::types::{ElemExt, Type, elementary};

/// A conversion function's name taken apart.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Conversion {
    /// `None` in `TO_INT`.
    pub from: Option<ElemType>,
    /// `None` in `TRUNC`.
    pub to: Option<ElemType>,
    pub trunc: bool,
}

/// `INT_TO_REAL`, `TO_REAL`, `REAL_TRUNC_INT`, `TRUNC_INT`, `TRUNC`; upper case.
pub fn conversion(name: &str) -> Option<Conversion> {
    if name == "TRUNC" {
        return Some(Conversion { from: None, to: None, trunc: true });
    }
    let make = |from: Option<&str>, to: &str, trunc: bool| {
        let to = elementary(to)?;
        let from = match from {
            Some(f) => Some(elementary(f)?),
            None => None,
        };
        let real = from.is_none_or(|f| f.is_real());
        (!trunc || (real && to.is_int())).then_some(Conversion { from, to: Some(to), trunc })
    };
    if let Some(to) = name.strip_prefix("TO_") {
        return make(None, to, false);
    }
    if let Some(to) = name.strip_prefix("TRUNC_") {
        return make(None, to, true);
    }
    if let Some((from, to)) = name.split_once("_TO_") {
        return make(Some(from), to, false);
    }
    let (from, to) = name.split_once("_TRUNC_")?;
    make(Some(from), to, true)
}

const NS_PER_MS: i64 = 1_000_000;

impl Checker<'_> {
    /// Calls a conversion function.
    pub fn convert_call(&mut self, c: Conversion, arg: Val, span: Span, want: Option<ElemType>) -> Val {
        let value = match (c.from, arg) {
            (_, Val::Error) => return Val::Error,
            // An enumeration's number: Color_TO_INT has no name of its own, INT_TO_x and TO_x take it.
            (Some(ElemType::Int) | None, Val::Expr(e, Type::Enum(_))) => Some(e),
            (Some(from), v) => self.coerce(v, span, &Type::Elem(from), "argument"),
            (None, v) => {
                let hint = if c.trunc { Some(ElemType::Lreal) } else { None };
                let v = if c.trunc && matches!(v, Val::Int(_)) {
                    self.as_real(v, span, ElemType::Lreal).map_or(Val::Error, Val::elem)
                } else {
                    v
                };
                self.literal_default(&v, span, hint)
            }
        };
        let Some(value) = value else { return Val::Error };
        let to = c.to.unwrap_or_else(|| want.filter(|w| w.is_int()).unwrap_or(ElemType::Dint));
        if c.trunc {
            if !value.ty.is_real() {
                return self.bad_operand("TRUNC", &Val::elem(value), span);
            }
            return Val::elem(fold(Expr::new(to, ExprKind::Convert(Convert::Trunc, Box::new(value)))));
        }
        Val::elem(convert(value, to))
    }
}

/// Explicit conversion between any two elementary types.
pub fn convert(e: Expr, to: ElemType) -> Expr {
    use ElemType::*;
    if e.ty == to {
        return e;
    }
    let step = |how, ty, e| fold(Expr::new(ty, ExprKind::Convert(how, Box::new(e))));
    let scaled = |op, e: Expr| {
        let n = Expr::int(e.ty, NS_PER_MS);
        fold(Expr::new(e.ty, ExprKind::Binary(op, Box::new(e), Box::new(n))))
    };
    let real_scaled = |op, e: Expr| {
        let n = Expr::new(Lreal, ExprKind::Const(crate::ir::Const::F64(NS_PER_MS as f64)));
        fold(Expr::new(Lreal, ExprKind::Binary(op, Box::new(e), Box::new(n))))
    };
    match (e.ty, to) {
        (_, Bool) => step(Convert::NotZero, Bool, e),
        (Real, Lreal) | (Lreal, Real) => step(Convert::Float, to, e),
        (Real, Dword) | (Dword, Real) | (Lreal, Lword) | (Lword, Lreal) => step(Convert::Bits, to, e),
        (Time, Real | Lreal) => {
            let ms = real_scaled(BinOp::Div, step(Convert::ToFloat, Lreal, e));
            if to == Real { step(Convert::Float, Real, ms) } else { ms }
        }
        (Real | Lreal, Time) => {
            let wide = if e.ty == Real { step(Convert::Float, Lreal, e) } else { e };
            step(Convert::Round, Time, real_scaled(BinOp::Mul, wide))
        }
        (Time, _) => step(Convert::Wrap, to, scaled(BinOp::Div, e)),
        (_, Time) => scaled(BinOp::Mul, step(Convert::Wrap, Time, e)),
        (Real | Lreal, _) => step(Convert::Round, to, e),
        (_, Real | Lreal) => step(Convert::ToFloat, to, e),
        _ => step(Convert::Wrap, to, e),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names() {
        let c = |n| conversion(n).map(|c| (c.from, c.to, c.trunc));
        assert_eq!(c("INT_TO_REAL"), Some((Some(ElemType::Int), Some(ElemType::Real), false)));
        assert_eq!(c("TO_TIME"), Some((None, Some(ElemType::Time), false)));
        assert_eq!(c("REAL_TRUNC_INT"), Some((Some(ElemType::Real), Some(ElemType::Int), true)));
        assert_eq!(c("TRUNC"), Some((None, None, true)));
        assert_eq!(c("INT_TRUNC_INT"), None);
        assert_eq!(c("REAL_TRUNC_BOOL"), None);
        assert_eq!(c("INT_TO_STRING"), None);
        assert_eq!(c("FOO_TO_INT"), None);
    }
}
