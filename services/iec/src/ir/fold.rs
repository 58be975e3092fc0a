//! Constant folding. The same arithmetic as the emitted code: integers wrap, reals are IEEE 754.

use super::{BinOp, Const, Convert, Expr, ExprKind, UnOp};
use crate::artifact::ElemType;
use crate::types::ElemExt;

/// Brings an integer into the range of a type by keeping its low bits.
pub fn wrap(ty: ElemType, v: i128) -> i64 {
    match ty.bits() {
        1 => i64::from(v & 1 != 0),
        8 if ty.is_signed() => i64::from(v as i8),
        8 => i64::from(v as u8),
        16 if ty.is_signed() => i64::from(v as i16),
        16 => i64::from(v as u16),
        32 if ty.is_signed() => i64::from(v as i32),
        32 => i64::from(v as u32),
        _ => v as i64,
    }
}

/// The mathematical value of a constant of an integer-like type.
pub fn value(ty: ElemType, v: i64) -> i128 {
    if ty.is_wide() && !ty.is_signed() { i128::from(v as u64) } else { i128::from(v) }
}

/// Replaces an operation on constants by its value. Operations that fault or count a warning at run time stay.
pub fn fold(e: Expr) -> Expr {
    let result = match &e.kind {
        ExprKind::Unary(op, a) => a.as_const().and_then(|c| unary(*op, a.ty, c)),
        ExprKind::Binary(op, a, b) => match (a.as_const(), b.as_const()) {
            (Some(x), Some(y)) => binary(*op, a.ty, b.ty, x, y),
            _ => None,
        },
        ExprKind::Convert(how, a) => a.as_const().and_then(|c| convert_const(*how, a.ty, e.ty, c)),
        ExprKind::Select(cond, a, b) => match (cond.as_int(), a.as_const(), b.as_const()) {
            (Some(c), Some(x), Some(y)) => Some(if c != 0 { x } else { y }),
            _ => None,
        },
        _ => None,
    };
    match result {
        Some(c) => Expr { ty: e.ty, kind: ExprKind::Const(c) },
        None => e,
    }
}

fn unary(op: UnOp, ty: ElemType, c: Const) -> Option<Const> {
    Some(match (op, c) {
        (UnOp::Neg, Const::I(v)) => Const::I(wrap(ty, -value(ty, v))),
        (UnOp::Neg, Const::F32(v)) => Const::F32(-v),
        (UnOp::Neg, Const::F64(v)) => Const::F64(-v),
        (UnOp::Not, Const::I(v)) => Const::I(wrap(ty, !value(ty, v))),
        (UnOp::Abs, Const::I(v)) => Const::I(wrap(ty, value(ty, v).abs())),
        (UnOp::Abs, Const::F32(v)) => Const::F32(v.abs()),
        (UnOp::Abs, Const::F64(v)) => Const::F64(v.abs()),
        (UnOp::Sqrt, Const::F32(v)) if v >= 0.0 => Const::F32(v.sqrt()),
        (UnOp::Sqrt, Const::F64(v)) if v >= 0.0 => Const::F64(v.sqrt()),
        _ => return None,
    })
}

fn binary(op: BinOp, ty: ElemType, right: ElemType, a: Const, b: Const) -> Option<Const> {
    match (a, b) {
        (Const::I(x), Const::I(y)) => integers(op, ty, value(ty, x), value(right, y)),
        (Const::F32(x), Const::F32(y)) => reals(op, f64::from(x), f64::from(y), || match op {
            BinOp::Add => Some(f64::from(x + y)),
            BinOp::Sub => Some(f64::from(x - y)),
            BinOp::Mul => Some(f64::from(x * y)),
            BinOp::Div => Some(f64::from(x / y)),
            _ => None,
        })
        .map(|c| match c {
            Const::F64(v) => Const::F32(v as f32),
            other => other,
        }),
        (Const::F64(x), Const::F64(y)) => reals(op, x, y, || match op {
            BinOp::Add => Some(x + y),
            BinOp::Sub => Some(x - y),
            BinOp::Mul => Some(x * y),
            BinOp::Div => Some(x / y),
            _ => None,
        }),
        _ => None,
    }
}

fn reals(op: BinOp, x: f64, y: f64, arithmetic: impl Fn() -> Option<f64>) -> Option<Const> {
    let truth = |b: bool| Some(Const::I(i64::from(b)));
    match op {
        BinOp::Eq => truth(x == y),
        BinOp::Ne => truth(x != y),
        BinOp::Lt => truth(x < y),
        BinOp::Le => truth(x <= y),
        BinOp::Gt => truth(x > y),
        BinOp::Ge => truth(x >= y),
        // NaN stays for run time, where the host makes it canonical.
        _ => arithmetic().filter(|v| !v.is_nan()).map(Const::F64),
    }
}

fn integers(op: BinOp, ty: ElemType, x: i128, y: i128) -> Option<Const> {
    let bits = i128::from(ty.bits());
    let mask = (1_i128 << bits) - 1;
    let v = match op {
        BinOp::Add => x + y,
        BinOp::Sub => x - y,
        BinOp::Mul => x.wrapping_mul(y),
        BinOp::Div if y != 0 => x / y,
        BinOp::Mod if y != 0 => x % y,
        BinOp::Div | BinOp::Mod => return None,
        BinOp::And => x & y,
        BinOp::Or => x | y,
        BinOp::Xor => x ^ y,
        BinOp::Eq => i128::from(x == y),
        BinOp::Ne => i128::from(x != y),
        BinOp::Lt => i128::from(x < y),
        BinOp::Le => i128::from(x <= y),
        BinOp::Gt => i128::from(x > y),
        BinOp::Ge => i128::from(x >= y),
        BinOp::Min => x.min(y),
        BinOp::Max => x.max(y),
        BinOp::Shl if (0..bits).contains(&y) => (x & mask) << y,
        BinOp::Shr if (0..bits).contains(&y) => (x & mask) >> y,
        BinOp::Shl | BinOp::Shr => 0,
        BinOp::Rol | BinOp::Ror => {
            let n = y.rem_euclid(bits);
            let n = if op == BinOp::Rol { n } else { (bits - n) % bits };
            ((x & mask) << n) | ((x & mask) >> (bits - n))
        }
    };
    Some(Const::I(if op.is_comparison() { v as i64 } else { wrap(ty, v) }))
}

/// Value of a conversion; `None` when it would fault.
pub fn convert_const(how: Convert, from: ElemType, to: ElemType, c: Const) -> Option<Const> {
    let real = |v: f64| {
        if to == ElemType::Real { Const::F32(v as f32) } else { Const::F64(v) }
    };
    Some(match (how, c) {
        (Convert::Wrap, Const::I(v)) => Const::I(wrap(to, value(from, v))),
        (Convert::NotZero, Const::I(v)) => Const::I(i64::from(v != 0)),
        (Convert::NotZero, Const::F32(v)) => Const::I(i64::from(v != 0.0)),
        (Convert::NotZero, Const::F64(v)) => Const::I(i64::from(v != 0.0)),
        // Straight to the target: by way of f64 a 64-bit value would be rounded twice.
        (Convert::ToFloat, Const::I(v)) if to == ElemType::Real => Const::F32(value(from, v) as f32),
        (Convert::ToFloat, Const::I(v)) => Const::F64(value(from, v) as f64),
        (Convert::Float, Const::F32(v)) => real(f64::from(v)),
        (Convert::Float, Const::F64(v)) => real(v),
        (Convert::Round | Convert::Trunc, Const::F32(_) | Const::F64(_)) => {
            let v = match c {
                Const::F32(v) => f64::from(v),
                Const::F64(v) => v,
                Const::I(_) => return None,
            };
            let v = if how == Convert::Round { v.round_ties_even() } else { v.trunc() };
            let (lo, hi) = to.range();
            if !(v >= lo as f64 && v < hi as f64 + 1.0) {
                return None;
            }
            Const::I(wrap(to, v as i128))
        }
        (Convert::Bits, Const::F32(v)) => Const::I(i64::from(v.to_bits())),
        (Convert::Bits, Const::F64(v)) => Const::I(v.to_bits() as i64),
        (Convert::Bits, Const::I(v)) if to == ElemType::Real => Const::F32(f32::from_bits(v as u32)),
        (Convert::Bits, Const::I(v)) => Const::F64(f64::from_bits(v as u64)),
        _ => return None,
    })
}
