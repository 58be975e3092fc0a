//! Conversions between elementary types.

use wasm_encoder::{BlockType, Instruction as I, ValType};

use super::code::Code;
use super::val_type;
use crate::RealToInt;
use crate::artifact::{ElemType, TrapId};
use crate::ir::{Convert, Expr};
use crate::types::ElemExt;

impl Code<'_> {
    pub fn convert(&mut self, how: Convert, a: &Expr, to: ElemType) {
        self.expr(a);
        self.convert_top(how, a.ty, to);
    }

    /// Converts the value on the stack.
    pub fn convert_top(&mut self, how: Convert, from: ElemType, to: ElemType) {
        match how {
            Convert::Wrap => self.wrap(from, to),
            Convert::NotZero => match val_type(from) {
                ValType::I64 => {
                    self.op(I::I64Const(0));
                    self.op(I::I64Ne);
                }
                ValType::F32 => {
                    self.op(I::F32Const(0.0.into()));
                    self.op(I::F32Ne);
                }
                ValType::F64 => {
                    self.op(I::F64Const(0.0.into()));
                    self.op(I::F64Ne);
                }
                _ => {
                    self.op(I::I32Const(0));
                    self.op(I::I32Ne);
                }
            },
            Convert::ToFloat => self.op(match (from.is_wide(), from.is_signed(), to) {
                (false, true, ElemType::Real) => I::F32ConvertI32S,
                (false, false, ElemType::Real) => I::F32ConvertI32U,
                (true, true, ElemType::Real) => I::F32ConvertI64S,
                (true, false, ElemType::Real) => I::F32ConvertI64U,
                (false, true, _) => I::F64ConvertI32S,
                (false, false, _) => I::F64ConvertI32U,
                (true, true, _) => I::F64ConvertI64S,
                (true, false, _) => I::F64ConvertI64U,
            }),
            Convert::Float => self.op(if to == ElemType::Real { I::F32DemoteF64 } else { I::F64PromoteF32 }),
            Convert::Bits => self.op(match to {
                ElemType::Real => I::F32ReinterpretI32,
                ElemType::Lreal => I::F64ReinterpretI64,
                _ if from == ElemType::Real => I::I32ReinterpretF32,
                _ => I::I64ReinterpretF64,
            }),
            Convert::Round | Convert::Trunc => {
                if from == ElemType::Real {
                    self.op(I::F64PromoteF32);
                }
                self.op(if how == Convert::Round { I::F64Nearest } else { I::F64Trunc });
                match self.options.real_to_int {
                    RealToInt::Fault => self.int_checked(to),
                    RealToInt::Clamp => self.int_clamped(to),
                }
            }
        }
    }

    fn wrap(&mut self, from: ElemType, to: ElemType) {
        match (from.is_wide(), to.is_wide()) {
            (true, true) => {}
            (false, true) => self.extend(from),
            (true, false) => {
                self.op(I::I32WrapI64);
                self.normalise(to);
            }
            (false, false) => {
                let (f, t) = (from.range(), to.range());
                let kept = f.0 >= t.0 && f.1 <= t.1;
                if !kept {
                    self.normalise(to);
                }
            }
        }
    }

    /// A whole `f64` on the stack to an integer, or a fault.
    fn int_checked(&mut self, to: ElemType) {
        let x = self.take(ValType::F64);
        self.op(I::LocalSet(x));
        if to.is_wide() {
            let (lo, hi) = to.range();
            // hi is not a double but hi + 1 is; NaN fails both comparisons.
            self.op(I::LocalGet(x));
            self.op(I::F64Const((lo as f64).into()));
            self.op(I::F64Ge);
            self.op(I::LocalGet(x));
            self.op(I::F64Const((hi as f64).into()));
            self.op(I::F64Lt);
            self.op(I::I32And);
            self.op(I::I32Eqz);
            self.fault_if(x);
            self.op(I::LocalGet(x));
            self.op(if to.is_signed() { I::I64TruncSatF64S } else { I::I64TruncSatF64U });
        } else {
            // There and back: equal only if it fits. NaN becomes 0 and is not equal.
            let r = self.take(ValType::I32);
            let unsigned = to.bits() == 32 && !to.is_signed();
            self.op(I::LocalGet(x));
            self.op(if unsigned { I::I32TruncSatF64U } else { I::I32TruncSatF64S });
            self.normalise(to);
            self.op(I::LocalTee(r));
            self.op(if unsigned { I::F64ConvertI32U } else { I::F64ConvertI32S });
            self.op(I::LocalGet(x));
            self.op(I::F64Ne);
            self.fault_if(x);
            self.op(I::LocalGet(r));
            self.give(ValType::I32, r);
        }
        self.give(ValType::F64, x);
    }

    fn fault_if(&mut self, x: u32) {
        self.open(I::If(BlockType::Empty));
        self.trap(TrapId::ConversionOutOfRange, |c| c.op(I::I64Const(0)), |c| c.op(I::LocalGet(x)));
        self.close();
    }

    /// A whole `f64` on the stack to the nearest value of an integer type; NaN to 0.
    fn int_clamped(&mut self, to: ElemType) {
        let (lo, hi) = to.range();
        if to.bits() < 32 {
            self.op(I::F64Const((lo as f64).into()));
            self.op(I::F64Max);
            self.op(I::F64Const((hi as f64).into()));
            self.op(I::F64Min);
        }
        self.op(match (to.is_wide(), to.is_signed()) {
            (true, true) => I::I64TruncSatF64S,
            (true, false) => I::I64TruncSatF64U,
            (false, false) if to.bits() == 32 => I::I32TruncSatF64U,
            (false, _) => I::I32TruncSatF64S,
        });
    }
}
