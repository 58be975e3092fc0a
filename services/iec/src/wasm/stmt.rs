//! Statements.

use wasm_encoder::{BlockType, Instruction as I, ValType};

use super::code::{Addr, Code, Labels, mem};
use super::expr::simple;
use super::val_type;
use crate::artifact::{ElemType, TrapId, sys};
use crate::ir::{BinOp, CaseArm, Expr, FbInput, For, OutputCopy, Place, Step, Stmt, StmtKind};
use crate::types::ElemExt;

/// A CASE with this many labels in this span becomes a jump table.
const TABLE_LABELS: usize = 4;
const TABLE_SPAN: i64 = 1024;

impl Code<'_> {
    pub fn statements(&mut self, list: &[Stmt]) {
        for s in list {
            self.stmt(s);
        }
    }

    /// The hook of debug builds.
    fn hook(&mut self, statement: u32) {
        self.mark(statement);
        let Some(brk) = self.indices.brk else { return };
        self.op(I::I32Const(0));
        self.op(I::I32Load8U(mem(sys::BRK_ANY, 0)));
        self.open(I::If(BlockType::Empty));
        self.op(I::I32Const(statement as i32));
        self.op(I::Call(brk));
        self.close();
    }

    fn stmt(&mut self, s: &Stmt) {
        if !matches!(s.kind, StmtKind::If { .. } | StmtKind::Repeat { .. }) {
            self.hook(s.id);
        }
        match &s.kind {
            StmtKind::Store { place, value } => self.store(place, value),
            StmtKind::SetTemp { temp, value } => {
                self.expr(value);
                let local = self.temps[*temp as usize];
                self.op(I::LocalSet(local));
            }
            StmtKind::Copy { to, from, bytes } => {
                self.push_full_address(to);
                self.push_full_address(from);
                self.copy(*bytes as i32);
            }
            StmtKind::Eval(e) => {
                self.expr(e);
                self.op(I::Drop);
            }
            StmtKind::CallVoid(call) => self.call(call),
            StmtKind::CallFb { pou, instance, inputs, outputs } => {
                self.call_fb(*pou, instance, inputs, outputs);
            }
            StmtKind::If { branches, otherwise } => self.if_chain(branches, otherwise),
            StmtKind::Case { selector, arms, otherwise } => self.case(selector, arms, otherwise),
            StmtKind::For(f) => self.for_loop(f, s.id),
            StmtKind::While { cond, body } => {
                let labels = self.open_loop();
                self.hook_again(s.id);
                self.expr(cond);
                self.op(I::I32Eqz);
                let exit = self.to(labels.0);
                self.op(I::BrIf(exit));
                self.body(labels.0, body);
                self.close_loop(labels.1);
            }
            StmtKind::Repeat { body, until, until_id } => {
                let labels = self.open_loop();
                self.body(labels.0, body);
                self.hook(*until_id);
                self.expr(until);
                self.op(I::I32Eqz);
                let top = self.to(labels.1);
                self.op(I::BrIf(top));
                self.close();
                self.close();
            }
            StmtKind::Exit => {
                if let Some(l) = self.loops.last().copied() {
                    let to = self.to(l.exit);
                    self.op(I::Br(to));
                }
            }
            StmtKind::Continue => {
                if let Some(l) = self.loops.last().copied() {
                    let to = self.to(l.next);
                    self.op(I::Br(to));
                }
            }
            StmtKind::Return => {
                self.push_result();
                self.op(I::Return);
            }
            StmtKind::Nop => {}
        }
    }

    /// A loop's head runs once a round: its place holds again after the body.
    fn hook_again(&mut self, statement: u32) {
        self.mark(statement);
    }

    /// Opens `block { loop {`: depths of both.
    fn open_loop(&mut self) -> (u32, u32) {
        let exit = self.block();
        let top = self.open(I::Loop(BlockType::Empty));
        (exit, top)
    }

    /// Runs the body once; CONTINUE goes to its end.
    fn body(&mut self, exit: u32, body: &[Stmt]) {
        let next = self.block();
        self.loops.push(Labels { exit, next });
        self.statements(body);
        self.loops.pop();
        self.close();
    }

    /// Goes back to the top and closes both blocks.
    fn close_loop(&mut self, top: u32) {
        let top = self.to(top);
        self.op(I::Br(top));
        self.close();
        self.close();
    }

    fn if_chain(&mut self, branches: &[(u32, Expr, Vec<Stmt>)], otherwise: &[Stmt]) {
        if let [(id, cond, body)] = branches {
            self.hook(*id);
            self.expr(cond);
            self.open(I::If(BlockType::Empty));
            self.statements(body);
            if !otherwise.is_empty() {
                self.op(I::Else);
                self.statements(otherwise);
            }
            self.close();
            return;
        }
        // Side by side, not inside each other: there may be many ELSIF.
        let end = self.block();
        for (id, cond, body) in branches {
            let next = self.block();
            self.hook(*id);
            self.expr(cond);
            self.op(I::I32Eqz);
            let to = self.to(next);
            self.op(I::BrIf(to));
            self.statements(body);
            let to = self.to(end);
            self.op(I::Br(to));
            self.close();
        }
        self.statements(otherwise);
        self.close();
    }

    fn case(&mut self, selector: &Expr, arms: &[CaseArm], otherwise: &[Stmt]) {
        let v = val_type(selector.ty);
        let key = self.take(v);
        self.expr(selector);
        self.op(I::LocalSet(key));
        let end = self.block();
        let fallback = self.block();
        // The first arm's block is the innermost.
        let first = self.depth + arms.len() as u32;
        for _ in arms {
            self.block();
        }
        let arm_label = |i: usize| first - i as u32;
        if let Some((lo, table)) = jump_table(selector.ty, arms) {
            self.op(I::LocalGet(key));
            if lo != 0 {
                self.op(I::I32Const(lo as i32));
                self.op(I::I32Sub);
            }
            let targets: Vec<u32> = table.iter().map(|t| self.to(t.map_or(fallback, arm_label))).collect();
            let default = self.to(fallback);
            self.op(I::BrTable(targets.into(), default));
        } else {
            for (i, (labels, _)) in arms.iter().enumerate() {
                for (lo, hi) in labels {
                    self.test_label(selector.ty, key, *lo, *hi);
                    let to = self.to(arm_label(i));
                    self.op(I::BrIf(to));
                }
            }
            let to = self.to(fallback);
            self.op(I::Br(to));
        }
        self.give(v, key);
        for (_, body) in arms {
            self.close();
            self.statements(body);
            let to = self.to(end);
            self.op(I::Br(to));
        }
        self.close();
        self.statements(otherwise);
        self.close();
    }

    fn test_label(&mut self, e: ElemType, key: u32, lo: i64, hi: i64) {
        let wide = e.is_wide();
        let constant = |n: i64| if wide { I::I64Const(n) } else { I::I32Const(n as i32) };
        self.op(I::LocalGet(key));
        self.op(constant(lo));
        if lo == hi {
            self.op(if wide { I::I64Eq } else { I::I32Eq });
        } else {
            // key - lo <= hi - lo, unsigned
            self.op(if wide { I::I64Sub } else { I::I32Sub });
            self.op(constant(hi.wrapping_sub(lo)));
            self.op(if wide { I::I64LeU } else { I::I32LeU });
        }
    }

    fn for_loop(&mut self, f: &For, id: u32) {
        match &f.step {
            Step::Const(step) => self.for_const(f, *step, id),
            Step::Dynamic(step) => self.for_dynamic(f, step, id),
        }
    }

    /// The common FOR: the step is known, so is the direction.
    fn for_const(&mut self, f: &For, step: i64, id: u32) {
        let e = f.ty;
        let v = val_type(e);
        let wide = v == ValType::I64;
        let constant = |n: i64| if wide { I::I64Const(n) } else { I::I32Const(n as i32) };
        let counter = match f.counter {
            Some(t) => self.temps[t as usize],
            None => self.take(v),
        };
        let end = self.take(v);
        self.expr(&f.from);
        self.op(I::LocalSet(counter));
        let fixed_end = f.to.as_int();
        if fixed_end.is_none() {
            self.expr(&f.to);
            self.op(I::LocalSet(end));
        }
        let push_end = |c: &mut Self| match fixed_end {
            Some(n) => c.op(constant(n)),
            None => c.op(I::LocalGet(end)),
        };
        let passed = simple(if step > 0 { BinOp::Gt } else { BinOp::Lt }, e, v);
        // Even a FOR that runs no round assigns its variable.
        self.store_with(e, &f.var, |c| c.op(I::LocalGet(counter)));
        let (exit, top) = {
            let exit = self.block();
            self.op(I::LocalGet(counter));
            push_end(self);
            self.op(passed.clone());
            let to = self.to(exit);
            self.op(I::BrIf(to));
            (exit, self.open(I::Loop(BlockType::Empty)))
        };
        self.body(exit, &f.body);
        self.mark(id);
        let to_exit = self.to(exit);
        if f.counter.is_none() {
            // The body may have moved the variable past the end.
            self.load(e, &f.var);
            self.op(I::LocalTee(counter));
            push_end(self);
            self.op(passed);
            self.op(I::BrIf(to_exit));
        }
        if step.unsigned_abs() == 1 {
            self.op(I::LocalGet(counter));
            push_end(self);
            self.op(simple(if step > 0 { BinOp::Ge } else { BinOp::Le }, e, v));
        } else {
            // Distance to the end, unsigned, less than a step: this was the last round. Nothing can overflow.
            if step > 0 {
                push_end(self);
                self.op(I::LocalGet(counter));
            } else {
                self.op(I::LocalGet(counter));
                push_end(self);
            }
            self.op(if wide { I::I64Sub } else { I::I32Sub });
            self.op(constant(step.unsigned_abs() as i64));
            self.op(if wide { I::I64LtU } else { I::I32LtU });
        }
        self.op(I::BrIf(to_exit));
        self.op(I::LocalGet(counter));
        self.op(constant(step));
        self.op(if wide { I::I64Add } else { I::I32Add });
        self.op(I::LocalSet(counter));
        self.store_with(e, &f.var, |c| c.op(I::LocalGet(counter)));
        self.close_loop(top);
        self.give(v, end);
        if f.counter.is_none() {
            self.give(v, counter);
        }
    }

    /// FOR whose step is known at run time only; counted in 64 bits.
    fn for_dynamic(&mut self, f: &For, step: &Expr, id: u32) {
        let e = f.ty;
        let (at, end, by) = (self.take(ValType::I64), self.take(ValType::I64), self.take(ValType::I64));
        self.expr(&f.from);
        self.extend(e);
        self.op(I::LocalSet(at));
        self.expr(&f.to);
        self.extend(e);
        self.op(I::LocalSet(end));
        self.expr(step);
        self.op(I::LocalTee(by));
        self.op(I::I64Eqz);
        self.open(I::If(BlockType::Empty));
        self.trap(TrapId::ForStepZero, |c| c.op(I::I64Const(0)), |c| c.op(I::F64Const(0.0.into())));
        self.close();
        self.set_counter(f, at);
        let (exit, top) = self.open_loop();
        self.passed(f, step, at, end, by);
        let to = self.to(exit);
        self.op(I::BrIf(to));
        self.body(exit, &f.body);
        self.mark(id);
        if f.counter.is_none() {
            self.load(e, &f.var);
            self.extend(e);
            self.op(I::LocalSet(at));
            self.passed(f, step, at, end, by);
            let to = self.to(exit);
            self.op(I::BrIf(to));
        }
        // Upwards: end - at < by; downwards: at - end < -by. Unsigned.
        let up_down = |c: &mut Self, up: I<'static>, down: I<'static>| {
            c.op(up);
            c.op(down);
            c.is_up(step, by);
            c.op(I::Select);
        };
        up_down(self, I::LocalGet(end), I::LocalGet(at));
        up_down(self, I::LocalGet(at), I::LocalGet(end));
        self.op(I::I64Sub);
        self.op(I::LocalGet(by));
        self.op(I::I64Const(0));
        self.op(I::LocalGet(by));
        self.op(I::I64Sub);
        self.is_up(step, by);
        self.op(I::Select);
        self.op(I::I64LtU);
        let to = self.to(exit);
        self.op(I::BrIf(to));
        self.op(I::LocalGet(at));
        self.op(I::LocalGet(by));
        self.op(I::I64Add);
        self.op(I::LocalSet(at));
        self.set_counter(f, at);
        self.close_loop(top);
        for local in [at, end, by] {
            self.give(ValType::I64, local);
        }
    }

    /// Pushes whether the step goes up.
    fn is_up(&mut self, step: &Expr, by: u32) {
        if step.ty.is_signed() {
            self.op(I::LocalGet(by));
            self.op(I::I64Const(0));
            self.op(I::I64GtS);
        } else {
            self.op(I::I32Const(1));
        }
    }

    /// Pushes whether the variable has passed the end.
    fn passed(&mut self, f: &For, step: &Expr, at: u32, end: u32, by: u32) {
        let compare = |op| {
            simple(op, if f.ty == ElemType::Ulint { ElemType::Ulint } else { ElemType::Lint }, ValType::I64)
        };
        self.op(I::LocalGet(at));
        self.op(I::LocalGet(end));
        self.op(compare(BinOp::Gt));
        self.op(I::LocalGet(at));
        self.op(I::LocalGet(end));
        self.op(compare(BinOp::Lt));
        self.is_up(step, by);
        self.op(I::Select);
    }

    fn set_counter(&mut self, f: &For, at: u32) {
        let narrow = !f.ty.is_wide();
        if let Some(t) = f.counter {
            self.op(I::LocalGet(at));
            if narrow {
                self.op(I::I32WrapI64);
            }
            let local = self.temps[t as usize];
            self.op(I::LocalSet(local));
        }
        self.store_with(f.ty, &f.var, |c| {
            c.op(I::LocalGet(at));
            if narrow {
                c.op(I::I32WrapI64);
            }
        });
    }

    fn call_fb(&mut self, pou: u32, instance: &Place, inputs: &[FbInput], outputs: &[OutputCopy]) {
        let held = self.hold_address(instance);
        let at = held.0;
        for i in inputs {
            match i {
                FbInput::Value { offset, value } => {
                    self.push_held(at);
                    self.expr(value);
                    self.store_op(value.ty, at.offset + offset);
                }
                FbInput::Address { offset, of } => {
                    self.push_held(at);
                    self.push_full_address(of);
                    self.store_op(ElemType::Udint, at.offset + offset);
                }
                FbInput::Copy { offset, from, bytes } => {
                    self.push_member(at, *offset);
                    self.push_full_address(from);
                    self.copy(*bytes as i32);
                }
            }
        }
        self.push_member(at, 0);
        match self.indices.pous.get(&pou) {
            Some(index) => self.op(I::Call(*index)),
            None => self.op(I::Unreachable),
        }
        for o in outputs {
            self.store_with(o.to, &o.target, |c| {
                c.push_held(at);
                c.load_op(o.ty, at.offset + o.offset);
                c.output_value(o);
            });
        }
        self.release(held);
    }

    fn push_member(&mut self, at: Addr, offset: u32) {
        match at.local {
            None => self.op(I::I32Const((at.offset + offset) as i32)),
            Some(l) => {
                self.op(I::LocalGet(l));
                if at.offset + offset != 0 {
                    self.op(I::I32Const((at.offset + offset) as i32));
                    self.op(I::I32Add);
                }
            }
        }
    }
}

/// Lowest label and the arm of each value from there, where a table pays. The first matching arm counts.
fn jump_table(e: ElemType, arms: &[CaseArm]) -> Option<(i64, Vec<Option<usize>>)> {
    let labels = || arms.iter().flat_map(|(l, _)| l);
    let lo = labels().map(|l| l.0).min()?;
    let hi = labels().map(|l| l.1).max()?;
    if e.is_wide() || labels().count() < TABLE_LABELS || hi - lo >= TABLE_SPAN {
        return None;
    }
    let mut table = vec![None; (hi - lo + 1) as usize];
    for (i, (labels, _)) in arms.iter().enumerate() {
        for (from, to) in labels {
            for slot in &mut table[(from - lo).max(0) as usize..=(to - lo).max(0) as usize] {
                slot.get_or_insert(i);
            }
        }
    }
    Some((lo, table))
}
