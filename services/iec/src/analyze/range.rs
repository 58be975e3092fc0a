//! Bounds of a value that are known at compile time, to leave out checks that cannot fail.

use super::check::Checker;
use crate::artifact::ElemType;
use crate::ir::{BinOp, Convert, Expr, ExprKind};
use crate::types::ElemExt;

impl Checker<'_> {
    /// Least and greatest value an integer expression can have.
    pub fn range(&self, e: &Expr) -> (i128, i128) {
        let all = e.ty.range();
        // Only bounds that lie in the type hold: beyond, the operation wraps.
        let kept = |r: (i128, i128)| if r.0 >= all.0 && r.1 <= all.1 { r } else { all };
        match &e.kind {
            ExprKind::Const(_) => e.as_int().map_or(all, |v| {
                let v = crate::ir::value(e.ty, v);
                (v, v)
            }),
            ExprKind::Temp(t) => self.temp_ranges.get(*t as usize).copied().unwrap_or(all),
            ExprKind::Binary(op, a, b) => {
                if !a.ty.is_int() && !a.ty.is_bits() {
                    return all;
                }
                let (x, y) = (self.range(a), self.range(b));
                match op {
                    BinOp::Add => kept((x.0 + y.0, x.1 + y.1)),
                    BinOp::Sub => kept((x.0 - y.1, x.1 - y.0)),
                    BinOp::Mul => {
                        if x.0.unsigned_abs().max(x.1.unsigned_abs()) > 1 << 62
                            || y.0.unsigned_abs().max(y.1.unsigned_abs()) > 1 << 62
                        {
                            return all;
                        }
                        let p = [x.0 * y.0, x.0 * y.1, x.1 * y.0, x.1 * y.1];
                        let lo = p.iter().copied().min().unwrap_or(all.0);
                        let hi = p.iter().copied().max().unwrap_or(all.1);
                        kept((lo, hi))
                    }
                    // Of a dividend that is not negative, by a constant.
                    BinOp::Mod if x.0 >= 0 && y.0 == y.1 && y.0 > 0 => (0, x.1.min(y.0 - 1)),
                    BinOp::Div if x.0 >= 0 && y.0 == y.1 && y.0 > 0 => (x.0 / y.0, x.1 / y.0),
                    BinOp::And if x.0 >= 0 && y.0 >= 0 => (0, x.1.min(y.1)),
                    BinOp::Min => (x.0.min(y.0), x.1.min(y.1)),
                    BinOp::Max => (x.0.max(y.0), x.1.max(y.1)),
                    _ => all,
                }
            }
            ExprKind::Convert(Convert::Wrap, a) if a.ty != ElemType::Time => {
                if a.ty.is_real() {
                    all
                } else {
                    kept(self.range(a))
                }
            }
            ExprKind::InRange { lo, hi, .. } => (i128::from(*lo), i128::from(*hi)),
            ExprKind::Select(_, a, b) if !e.ty.is_real() => {
                let (x, y) = (self.range(a), self.range(b));
                (x.0.min(y.0), x.1.max(y.1))
            }
            _ => all,
        }
    }
}
