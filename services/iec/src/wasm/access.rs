//! Reading and writing places.

use wasm_encoder::{Instruction as I, ValType};

use super::code::{Addr, Code, Slot, mem};
use super::val_type;
use crate::artifact::{ElemType, Storage};
use crate::ir::{Base, Expr, INDEX_FAULT, IndexTerm, Place};
use crate::types::ElemExt;

const NS_PER_MS: i64 = 1_000_000;

impl Code<'_> {
    /// The register a place is, if it is one.
    fn register(&self, place: &Place) -> Option<u32> {
        let slot = match place.base {
            Base::Var(i) => self.vars.get(&i).copied(),
            Base::Result => self.result,
            _ => None,
        };
        match slot {
            Some(Slot::Register(r)) => Some(r),
            _ => None,
        }
    }

    /// Base of a place without its subscripts. The register may be a scratch one: `bool`.
    fn base(&mut self, place: &Place) -> (Addr, bool) {
        let slot = match place.base {
            Base::Abs(at) => Slot::Abs(at),
            Base::Global(g) => Slot::Abs(self.memory.globals[g as usize]),
            Base::Var(i) => self.vars.get(&i).copied().unwrap_or(Slot::Abs(0)),
            Base::Result => self.result.unwrap_or(Slot::Abs(0)),
            Base::Ref(i) => match self.vars.get(&i).copied() {
                Some(Slot::Register(r)) => return (Addr { local: Some(r), offset: place.offset }, false),
                Some(Slot::This(offset)) => {
                    let local = self.take(ValType::I32);
                    self.op(I::LocalGet(0));
                    self.op(I::I32Load(mem(offset, 2)));
                    self.op(I::LocalSet(local));
                    return (Addr { local: Some(local), offset: place.offset }, true);
                }
                _ => Slot::Abs(0),
            },
        };
        let addr = match slot {
            Slot::Abs(at) => Addr { local: None, offset: at + place.offset },
            Slot::This(at) => Addr { local: Some(0), offset: at + place.offset },
            Slot::Register(_) => Addr { local: None, offset: 0 },
        };
        (addr, false)
    }

    /// Pushes the part of an address that is known at run time only; returns the rest, for the instruction.
    pub fn push_address(&mut self, place: &Place) -> u32 {
        let (addr, scratch) = self.base(place);
        let mut offset = addr.offset;
        let mut pushed = false;
        if let Some(local) = addr.local {
            self.op(I::LocalGet(local));
            if scratch {
                self.give(ValType::I32, local);
            }
            pushed = true;
        }
        for term in place.index.iter().flat_map(|i| &i.terms) {
            offset = self.push_term(term, offset);
            if pushed {
                self.op(I::I32Add);
            }
            pushed = true;
        }
        if !pushed {
            self.op(I::I32Const(0));
        }
        offset
    }

    /// Pushes `(subscript - lo) * stride`, after the check; may move the constant part to the offset.
    fn push_term(&mut self, t: &IndexTerm, offset: u32) -> u32 {
        let e = t.value.ty;
        let mut offset = offset;
        self.expr(&t.value);
        if t.check {
            self.check_index(t);
        } else {
            if e.is_wide() {
                self.op(I::I32WrapI64);
            }
            // Not negative and the constant part fits: it goes into the instruction.
            let shift = -t.lo * i64::from(t.stride);
            let moved = i64::from(offset) + shift;
            if t.lo != 0 && t.nonneg && (0..=i64::from(u32::MAX >> 1)).contains(&moved) {
                offset = moved as u32;
            } else if t.lo != 0 {
                self.op(I::I32Const(t.lo as i32));
                self.op(I::I32Sub);
            }
        }
        if t.stride != 1 {
            self.op(I::I32Const(t.stride as i32));
            self.op(I::I32Mul);
        }
        offset
    }

    /// Subscript on the stack -> subscript minus lower bound as `i32`, or a fault.
    fn check_index(&mut self, t: &IndexTerm) {
        let e = t.value.ty;
        let count = t.hi - t.lo + 1;
        let wide = e.is_wide() || (e == ElemType::Udint && t.lo < 0);
        let own = val_type(e);
        let value = self.take(own);
        self.op(I::LocalTee(value));
        let ty = if wide { ValType::I64 } else { ValType::I32 };
        let index = self.take(ty);
        if wide {
            self.extend(e);
            if t.lo != 0 {
                self.op(I::I64Const(t.lo));
                self.op(I::I64Sub);
            }
            self.op(I::LocalTee(index));
            self.op(I::I64Const(count));
            self.op(I::I64GeU);
            if e == ElemType::Ulint && t.lo < 0 {
                self.op(I::LocalGet(value));
                self.op(I::I64Const(0));
                self.op(I::I64LtS);
                self.op(I::I32Or);
            }
        } else {
            if t.lo != 0 {
                self.op(I::I32Const(t.lo as i32));
                self.op(I::I32Sub);
            }
            self.op(I::LocalTee(index));
            self.op(I::I32Const(count as i32));
            self.op(I::I32GeU);
        }
        self.open(I::If(wasm_encoder::BlockType::Empty));
        self.trap_int(INDEX_FAULT, e, value);
        self.close();
        self.op(I::LocalGet(index));
        if wide {
            self.op(I::I32WrapI64);
        }
        self.give(own, value);
        self.give(ty, index);
    }

    /// Pushes the whole address.
    pub fn push_full_address(&mut self, place: &Place) {
        let simple = place.index.is_none();
        let offset = self.push_address(place);
        if simple && matches!(self.out.last(), Some(I::I32Const(0))) {
            self.out.pop();
            self.op(I::I32Const(offset as i32));
        } else if offset != 0 {
            self.op(I::I32Const(offset as i32));
            self.op(I::I32Add);
        }
    }

    /// An address that is used several times; hand the register back with [`Self::release`].
    pub fn hold_address(&mut self, place: &Place) -> (Addr, bool) {
        if place.index.is_none() {
            return self.base(place);
        }
        let local = self.take(ValType::I32);
        let offset = self.push_address(place);
        self.op(I::LocalSet(local));
        (Addr { local: Some(local), offset }, true)
    }

    pub fn release(&mut self, held: (Addr, bool)) {
        if let (Some(local), true) = (held.0.local, held.1) {
            self.give(ValType::I32, local);
        }
    }

    pub fn push_held(&mut self, a: Addr) {
        match a.local {
            Some(l) => self.op(I::LocalGet(l)),
            None => self.op(I::I32Const(0)),
        }
    }

    pub fn load(&mut self, e: ElemType, place: &Place) {
        if let Some(r) = self.register(place) {
            self.op(I::LocalGet(r));
            return;
        }
        let offset = self.push_address(place);
        let m = mem(offset, 0);
        match place.storage {
            Storage::Plain => self.load_op(e, offset),
            Storage::Bit(bit) => {
                self.op(I::I32Load8U(m));
                if bit > 0 {
                    self.op(I::I32Const(i32::from(bit)));
                    self.op(I::I32ShrU);
                }
                self.op(I::I32Const(1));
                self.op(I::I32And);
            }
            Storage::Millis32 => {
                self.op(I::I64Load32S(m));
                self.op(I::I64Const(NS_PER_MS));
                self.op(I::I64Mul);
            }
        }
    }

    /// Writes what `value` pushes.
    pub fn store_with(&mut self, e: ElemType, place: &Place, value: impl FnOnce(&mut Self)) {
        if let Some(r) = self.register(place) {
            value(self);
            self.op(I::LocalSet(r));
            return;
        }
        let offset = self.push_address(place);
        let m = mem(offset, 0);
        match place.storage {
            Storage::Plain => {
                value(self);
                self.store_op(e, offset);
            }
            Storage::Bit(bit) => {
                // The value first: it may read or write other bits of this byte.
                let v = self.take(ValType::I32);
                value(self);
                self.op(I::LocalSet(v));
                self.op(I::I32Const(0));
                self.op(I::I32Load8U(m));
                self.op(I::I32Const(!(1 << bit)));
                self.op(I::I32And);
                self.op(I::LocalGet(v));
                if bit > 0 {
                    self.op(I::I32Const(i32::from(bit)));
                    self.op(I::I32Shl);
                }
                self.op(I::I32Or);
                self.op(I::I32Store8(m));
                self.give(ValType::I32, v);
            }
            Storage::Millis32 => {
                value(self);
                self.op(I::I64Const(NS_PER_MS));
                self.op(I::I64DivS);
                self.op(I::I32WrapI64);
                self.op(I::I32Store(m));
            }
        }
    }

    pub fn store(&mut self, place: &Place, value: &Expr) {
        self.store_with(value.ty, place, |c| c.expr(value));
    }
}
