//! Expressions: each pushes one value.

use wasm_encoder::{BlockType, Instruction as I, ValType};

use super::code::{Code, mem};
use super::val_type;
use crate::ModByZero;
use crate::artifact::{ElemType, TrapId, sys};
use crate::ir::{BinOp, Call, CallArg, Expr, ExprKind, OutputCopy, UnOp};
use crate::types::ElemExt;

impl Code<'_> {
    pub fn expr(&mut self, e: &Expr) {
        match &e.kind {
            ExprKind::Const(c) => self.constant(e.ty, *c),
            ExprKind::Load(place) => self.load(e.ty, place),
            ExprKind::Temp(t) => {
                let local = self.temps[*t as usize];
                self.op(I::LocalGet(local));
            }
            ExprKind::Unary(op, a) => self.unary(*op, a),
            ExprKind::Binary(op, a, b) => self.binary(*op, a, b),
            ExprKind::Convert(how, a) => self.convert(*how, a, e.ty),
            ExprKind::Select(cond, a, b) => {
                self.expr(a);
                self.expr(b);
                self.expr(cond);
                self.op(I::Select);
            }
            ExprKind::Mux(k, items) => self.mux(k, items, e.ty),
            ExprKind::ShortCircuit { and, left, right } => {
                self.expr(left);
                self.open(I::If(BlockType::Result(ValType::I32)));
                if *and {
                    self.expr(right);
                    self.op(I::Else);
                    self.op(I::I32Const(0));
                } else {
                    self.op(I::I32Const(1));
                    self.op(I::Else);
                    self.expr(right);
                }
                self.close();
            }
            ExprKind::Call(call) => self.call(call),
            ExprKind::Math(f, args) => {
                for a in args {
                    self.expr(a);
                }
                // Every used function was imported.
                if let Some(index) = self.indices.math.get(&(*f, e.ty == ElemType::Lreal)) {
                    self.op(I::Call(*index));
                } else {
                    self.op(I::Unreachable);
                }
            }
            ExprKind::Now => {
                self.op(I::I32Const(0));
                self.op(I::I64Load(mem(sys::STAMP_NS, 3)));
            }
            ExprKind::InRange { value, lo, hi } => self.in_range(value, *lo, *hi),
        }
    }

    /// Brings an `i32` into the range of a narrow type.
    pub fn normalise(&mut self, e: ElemType) {
        match (e.bits(), e.is_signed()) {
            (1, _) => {
                self.op(I::I32Const(1));
                self.op(I::I32And);
            }
            (8, true) => self.op(I::I32Extend8S),
            (16, true) => self.op(I::I32Extend16S),
            (8, false) => {
                self.op(I::I32Const(0xff));
                self.op(I::I32And);
            }
            (16, false) => {
                self.op(I::I32Const(0xffff));
                self.op(I::I32And);
            }
            _ => {}
        }
    }

    fn unary(&mut self, op: UnOp, a: &Expr) {
        let e = a.ty;
        match (op, val_type(e)) {
            (UnOp::Neg, ValType::F32) => self.one(a, I::F32Neg),
            (UnOp::Neg, ValType::F64) => self.one(a, I::F64Neg),
            (UnOp::Neg, ValType::I64) => {
                self.op(I::I64Const(0));
                self.one(a, I::I64Sub);
            }
            (UnOp::Neg, _) => {
                self.op(I::I32Const(0));
                self.one(a, I::I32Sub);
                self.normalise(e);
            }
            (UnOp::Not, _) if e == ElemType::Bool => self.one(a, I::I32Eqz),
            (UnOp::Not, ValType::I64) => {
                self.expr(a);
                self.op(I::I64Const(-1));
                self.op(I::I64Xor);
            }
            (UnOp::Not, _) => {
                self.expr(a);
                self.op(I::I32Const(-1));
                self.op(I::I32Xor);
                self.normalise(e);
            }
            (UnOp::Abs, ValType::F32) => self.one(a, I::F32Abs),
            (UnOp::Abs, ValType::F64) => self.one(a, I::F64Abs),
            (UnOp::Abs, v) => {
                let wide = v == ValType::I64;
                let x = self.take(v);
                self.expr(a);
                self.op(I::LocalSet(x));
                self.op(if wide { I::I64Const(0) } else { I::I32Const(0) });
                self.op(I::LocalGet(x));
                self.op(if wide { I::I64Sub } else { I::I32Sub });
                if !wide {
                    self.normalise(e);
                }
                self.op(I::LocalGet(x));
                self.op(I::LocalGet(x));
                self.op(if wide { I::I64Const(0) } else { I::I32Const(0) });
                self.op(if wide { I::I64LtS } else { I::I32LtS });
                self.op(I::Select);
                self.give(v, x);
            }
            (UnOp::Sqrt, ValType::F32) => self.one(a, I::F32Sqrt),
            (UnOp::Sqrt, _) => self.one(a, I::F64Sqrt),
        }
    }

    fn one(&mut self, a: &Expr, op: I<'static>) {
        self.expr(a);
        self.op(op);
    }

    fn binary(&mut self, op: BinOp, a: &Expr, b: &Expr) {
        let e = a.ty;
        let v = val_type(e);
        match op {
            BinOp::Div if !e.is_real() => return self.divide(a, b),
            BinOp::Mod => return self.modulo(a, b),
            BinOp::Shl | BinOp::Shr => return self.shift(op, a, b),
            BinOp::Rol | BinOp::Ror => return self.rotate(op, a, b),
            BinOp::Min | BinOp::Max if !e.is_real() => return self.extreme(op, a, b),
            _ => {}
        }
        self.expr(a);
        self.expr(b);
        self.op(simple(op, e, v));
        if matches!(op, BinOp::Add | BinOp::Sub | BinOp::Mul) && v == ValType::I32 {
            self.normalise(e);
        }
    }

    fn extreme(&mut self, op: BinOp, a: &Expr, b: &Expr) {
        let v = val_type(a.ty);
        let (x, y) = (self.take(v), self.take(v));
        self.expr(a);
        self.op(I::LocalSet(x));
        self.expr(b);
        self.op(I::LocalSet(y));
        for local in [x, y, x, y] {
            self.op(I::LocalGet(local));
        }
        let compare = if op == BinOp::Min { BinOp::Lt } else { BinOp::Gt };
        self.op(simple(compare, a.ty, v));
        self.op(I::Select);
        self.give(v, x);
        self.give(v, y);
    }

    /// Integer division: by zero is a fault, the least value by -1 wraps.
    fn divide(&mut self, a: &Expr, b: &Expr) {
        let e = a.ty;
        let v = val_type(e);
        let wide = v == ValType::I64;
        if let Some(n) = b.as_int().filter(|n| *n != 0) {
            if n == -1 && e.is_signed() {
                self.op(if wide { I::I64Const(0) } else { I::I32Const(0) });
                self.expr(a);
                self.op(if wide { I::I64Sub } else { I::I32Sub });
            } else {
                self.expr(a);
                self.expr(b);
                self.op(div_op(e, wide));
            }
            if !wide {
                self.normalise(e);
            }
            return;
        }
        let (x, y) = (self.take(v), self.take(v));
        self.expr(a);
        self.op(I::LocalSet(x));
        self.expr(b);
        self.op(I::LocalTee(y));
        self.op(if wide { I::I64Eqz } else { I::I32Eqz });
        self.open(I::If(BlockType::Empty));
        self.trap_int(TrapId::DivisionByZero, e, x);
        self.close();
        // DINT and LINT only: narrower quotients fit 32 bits and are wrapped after.
        let overflows = e.is_signed() && e.bits() >= 32;
        if overflows {
            // b = -1 ? 0 - a : a / (b = -1 ? 1 : b); one comparison, no branch.
            self.zero(wide);
            self.op(I::LocalGet(x));
            self.op(if wide { I::I64Sub } else { I::I32Sub });
        }
        self.op(I::LocalGet(x));
        if overflows {
            self.op(if wide { I::I64Const(1) } else { I::I32Const(1) });
            self.op(I::LocalGet(y));
            self.minus_one(y, wide);
            self.op(I::Select);
        } else {
            self.op(I::LocalGet(y));
        }
        self.op(div_op(e, wide));
        if overflows {
            self.minus_one(y, wide);
            self.op(I::Select);
        }
        if !wide {
            self.normalise(e);
        }
        self.give(v, x);
        self.give(v, y);
    }

    fn zero(&mut self, wide: bool) {
        self.op(if wide { I::I64Const(0) } else { I::I32Const(0) });
    }

    fn minus_one(&mut self, local: u32, wide: bool) {
        self.op(I::LocalGet(local));
        self.op(if wide { I::I64Const(-1) } else { I::I32Const(-1) });
        self.op(if wide { I::I64Eq } else { I::I32Eq });
    }

    fn modulo(&mut self, a: &Expr, b: &Expr) {
        let e = a.ty;
        let v = val_type(e);
        let wide = v == ValType::I64;
        if b.as_int().is_some_and(|n| n != 0) {
            self.expr(a);
            self.expr(b);
            self.op(rem_op(e, wide));
            return;
        }
        let (x, y) = (self.take(v), self.take(v));
        self.expr(a);
        self.op(I::LocalSet(x));
        self.expr(b);
        self.op(I::LocalTee(y));
        self.op(if wide { I::I64Eqz } else { I::I32Eqz });
        self.open(I::If(BlockType::Result(v)));
        match self.options.mod_by_zero {
            ModByZero::Fault => self.trap_int(TrapId::ModuloByZero, e, x),
            ModByZero::Zero => {
                let m = mem(sys::WARNINGS, 2);
                self.op(I::I32Const(0));
                self.op(I::I32Const(0));
                self.op(I::I32Load(m));
                self.op(I::I32Const(1));
                self.op(I::I32Add);
                self.op(I::I32Store(m));
                self.zero(wide);
            }
        }
        self.op(I::Else);
        self.op(I::LocalGet(x));
        self.op(I::LocalGet(y));
        self.op(rem_op(e, wide));
        self.close();
        self.give(v, x);
        self.give(v, y);
    }

    /// SHL, SHR: by the width or more, and by a negative count, 0.
    fn shift(&mut self, op: BinOp, a: &Expr, b: &Expr) {
        let e = a.ty;
        let wide = val_type(e) == ValType::I64;
        let bits = i64::from(e.bits());
        let instruction = match (op, wide) {
            (BinOp::Shl, true) => I::I64Shl,
            (BinOp::Shl, false) => I::I32Shl,
            (_, true) => I::I64ShrU,
            (_, false) => I::I32ShrU,
        };
        if let Some(n) = b.as_int() {
            self.expr(a);
            if (0..bits).contains(&n) {
                self.op(if wide { I::I64Const(n) } else { I::I32Const(n as i32) });
                self.op(instruction);
                if op == BinOp::Shl && !wide {
                    self.normalise(e);
                }
            } else {
                self.op(I::Drop);
                self.zero(wide);
            }
            return;
        }
        let long_count = b.ty.is_wide();
        let count_type = val_type(b.ty);
        let count = self.take(count_type);
        self.expr(a);
        self.expr(b);
        self.op(I::LocalTee(count));
        match (wide, long_count) {
            (true, false) => self.op(I::I64ExtendI32U),
            (false, true) => self.op(I::I32WrapI64),
            _ => {}
        }
        self.op(instruction);
        if op == BinOp::Shl && !wide {
            self.normalise(e);
        }
        self.zero(wide);
        self.op(I::LocalGet(count));
        if long_count {
            self.op(I::I64Const(bits));
            self.op(I::I64LtU);
        } else {
            self.op(I::I32Const(bits as i32));
            self.op(I::I32LtU);
        }
        self.op(I::Select);
        self.give(count_type, count);
    }

    /// ROL, ROR: the count modulo the width.
    fn rotate(&mut self, op: BinOp, a: &Expr, b: &Expr) {
        let e = a.ty;
        let bits = e.bits();
        if bits >= 32 {
            let wide = bits == 64;
            self.expr(a);
            self.expr(b);
            match (wide, b.ty.is_wide()) {
                (true, false) => self.op(I::I64ExtendI32S),
                (false, true) => self.op(I::I32WrapI64),
                _ => {}
            }
            self.op(match (op, wide) {
                (BinOp::Rol, true) => I::I64Rotl,
                (BinOp::Rol, false) => I::I32Rotl,
                (_, true) => I::I64Rotr,
                (_, false) => I::I32Rotr,
            });
            return;
        }
        let (x, n) = (self.take(ValType::I32), self.take(ValType::I32));
        self.expr(a);
        self.op(I::LocalSet(x));
        self.expr(b);
        if b.ty.is_wide() {
            self.op(I::I32WrapI64);
        }
        // Left by n is right by width - n; a BOOL has width 1 and stays.
        if op == BinOp::Ror {
            let t = self.take(ValType::I32);
            self.op(I::LocalSet(t));
            self.op(I::I32Const(0));
            self.op(I::LocalGet(t));
            self.op(I::I32Sub);
            self.give(ValType::I32, t);
        }
        self.op(I::I32Const(bits as i32 - 1));
        self.op(I::I32And);
        self.op(I::LocalSet(n));
        self.op(I::LocalGet(x));
        self.op(I::LocalGet(n));
        self.op(I::I32Shl);
        self.op(I::LocalGet(x));
        self.op(I::I32Const(bits as i32));
        self.op(I::LocalGet(n));
        self.op(I::I32Sub);
        self.op(I::I32ShrU);
        self.op(I::I32Or);
        self.normalise(e);
        self.give(ValType::I32, x);
        self.give(ValType::I32, n);
    }

    fn mux(&mut self, k: &Expr, items: &[Expr], e: ElemType) {
        let key = val_type(k.ty);
        let wide = key == ValType::I64;
        let v = val_type(e);
        let selector = self.take(key);
        self.expr(k);
        self.op(I::LocalTee(selector));
        self.op(if wide { I::I64Const(items.len() as i64) } else { I::I32Const(items.len() as i32) });
        self.op(if wide { I::I64GeU } else { I::I32GeU });
        self.open(I::If(BlockType::Empty));
        self.trap_int(TrapId::IndexOutOfBounds, k.ty, selector);
        self.close();
        let chosen = self.take(v);
        for (i, item) in items.iter().enumerate() {
            self.expr(item);
            if i > 0 {
                self.op(I::LocalGet(chosen));
                self.op(I::LocalGet(selector));
                self.op(if wide { I::I64Const(i as i64) } else { I::I32Const(i as i32) });
                self.op(if wide { I::I64Eq } else { I::I32Eq });
                self.op(I::Select);
            }
            self.op(I::LocalSet(chosen));
        }
        self.op(I::LocalGet(chosen));
        self.give(key, selector);
        self.give(v, chosen);
    }

    fn in_range(&mut self, value: &Expr, lo: i64, hi: i64) {
        let e = value.ty;
        let v = val_type(e);
        let wide = v == ValType::I64;
        let x = self.take(v);
        self.expr(value);
        self.op(I::LocalTee(x));
        let bound = |n: i64| if wide { I::I64Const(n) } else { I::I32Const(n as i32) };
        self.op(bound(lo));
        self.op(simple(BinOp::Lt, e, v));
        self.op(I::LocalGet(x));
        self.op(bound(hi));
        self.op(simple(BinOp::Gt, e, v));
        self.op(I::I32Or);
        self.open(I::If(BlockType::Empty));
        self.trap_int(TrapId::SubrangeViolation, e, x);
        self.close();
        self.op(I::LocalGet(x));
        self.give(v, x);
    }

    /// Pushes the arguments, calls, copies the outputs; the result stays on the stack.
    pub fn call(&mut self, call: &Call) {
        for a in &call.args {
            match a {
                CallArg::Value(e) => self.expr(e),
                CallArg::Address(p) => self.push_full_address(p),
            }
        }
        let Some(index) = self.indices.pous.get(&call.pou).copied() else {
            self.op(I::Unreachable);
            return;
        };
        self.op(I::Call(index));
        let from = |c: &Self, o: &OutputCopy| {
            c.memory.frames[call.pou as usize].vars.get(&o.var).copied().unwrap_or(0)
        };
        // A subscript of a target may call the same function and overwrite its outputs: all are fetched first.
        let held: Vec<u32> = if call.outputs.iter().any(|o| o.target.index.is_some()) {
            let hold = |o: &OutputCopy| {
                let local = self.take(val_type(o.ty));
                self.op(I::I32Const(0));
                let from = from(self, o);
                self.load_op(o.ty, from);
                self.op(I::LocalSet(local));
                local
            };
            call.outputs.iter().map(hold).collect()
        } else {
            Vec::new()
        };
        for (i, o) in call.outputs.iter().enumerate() {
            self.store_with(o.to, &o.target, |c| {
                match held.get(i) {
                    Some(local) => c.op(I::LocalGet(*local)),
                    None => {
                        c.op(I::I32Const(0));
                        let from = from(c, o);
                        c.load_op(o.ty, from);
                    }
                }
                c.output_value(o);
            });
        }
        for (o, local) in call.outputs.iter().zip(held) {
            self.give(val_type(o.ty), local);
        }
    }

    /// Conversion and negation of an output on the stack.
    pub fn output_value(&mut self, o: &crate::ir::OutputCopy) {
        if let Some(how) = o.convert {
            self.convert_top(how, o.ty, o.to);
        }
        if o.negate {
            self.op(I::I32Eqz);
        }
    }
}

fn div_op(e: ElemType, wide: bool) -> I<'static> {
    match (e.is_signed(), wide) {
        (true, true) => I::I64DivS,
        (true, false) => I::I32DivS,
        (false, true) => I::I64DivU,
        (false, false) => I::I32DivU,
    }
}

fn rem_op(e: ElemType, wide: bool) -> I<'static> {
    match (e.is_signed(), wide) {
        (true, true) => I::I64RemS,
        (true, false) => I::I32RemS,
        (false, true) => I::I64RemU,
        (false, false) => I::I32RemU,
    }
}

/// The instruction of an operator that is one instruction.
pub fn simple(op: BinOp, e: ElemType, v: ValType) -> I<'static> {
    let signed = e.is_signed();
    match v {
        ValType::F32 => match op {
            BinOp::Add => I::F32Add,
            BinOp::Sub => I::F32Sub,
            BinOp::Mul => I::F32Mul,
            BinOp::Div => I::F32Div,
            BinOp::Min => I::F32Min,
            BinOp::Max => I::F32Max,
            BinOp::Eq => I::F32Eq,
            BinOp::Ne => I::F32Ne,
            BinOp::Lt => I::F32Lt,
            BinOp::Le => I::F32Le,
            BinOp::Gt => I::F32Gt,
            BinOp::Ge => I::F32Ge,
            _ => I::Unreachable,
        },
        ValType::F64 => match op {
            BinOp::Add => I::F64Add,
            BinOp::Sub => I::F64Sub,
            BinOp::Mul => I::F64Mul,
            BinOp::Div => I::F64Div,
            BinOp::Min => I::F64Min,
            BinOp::Max => I::F64Max,
            BinOp::Eq => I::F64Eq,
            BinOp::Ne => I::F64Ne,
            BinOp::Lt => I::F64Lt,
            BinOp::Le => I::F64Le,
            BinOp::Gt => I::F64Gt,
            BinOp::Ge => I::F64Ge,
            _ => I::Unreachable,
        },
        ValType::I64 => match op {
            BinOp::Add => I::I64Add,
            BinOp::Sub => I::I64Sub,
            BinOp::Mul => I::I64Mul,
            BinOp::And => I::I64And,
            BinOp::Or => I::I64Or,
            BinOp::Xor => I::I64Xor,
            BinOp::Eq => I::I64Eq,
            BinOp::Ne => I::I64Ne,
            BinOp::Lt if signed => I::I64LtS,
            BinOp::Le if signed => I::I64LeS,
            BinOp::Gt if signed => I::I64GtS,
            BinOp::Ge if signed => I::I64GeS,
            BinOp::Lt => I::I64LtU,
            BinOp::Le => I::I64LeU,
            BinOp::Gt => I::I64GtU,
            BinOp::Ge => I::I64GeU,
            _ => I::Unreachable,
        },
        _ => match op {
            BinOp::Add => I::I32Add,
            BinOp::Sub => I::I32Sub,
            BinOp::Mul => I::I32Mul,
            BinOp::And => I::I32And,
            BinOp::Or => I::I32Or,
            BinOp::Xor => I::I32Xor,
            BinOp::Eq => I::I32Eq,
            BinOp::Ne => I::I32Ne,
            BinOp::Lt if signed => I::I32LtS,
            BinOp::Le if signed => I::I32LeS,
            BinOp::Gt if signed => I::I32GtS,
            BinOp::Ge if signed => I::I32GeS,
            BinOp::Lt => I::I32LtU,
            BinOp::Le => I::I32LeU,
            BinOp::Gt => I::I32GtU,
            BinOp::Ge => I::I32GeU,
            _ => I::Unreachable,
        },
    }
}
