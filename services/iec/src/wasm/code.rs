//! One function: its locals, its entry, and the instructions that are collected for it.

use std::collections::HashMap;

use wasm_encoder::{BlockType, Function, Instruction as I, MemArg, MemArgTarget, ValType};

use super::layout::{Frame, Memory};
use super::{Indices, val_type};
use crate::analyze::tables::{Analyzed, InitData, Pou};
use crate::artifact::{ElemType, TrapId, sys};
use crate::diagnostic::Diagnostic;
use crate::ir::{Body, Const};
use crate::syntax::ast::{PouKind, Section};
use crate::types::{ElemExt, Type};
use crate::{Options, limits};

/// A memory operand.
pub fn mem(offset: u32, align: u32) -> MemArg {
    MemArg { offset: u64::from(offset), align, target: MemArgTarget::Memory(0), ordering: None }
}

/// Where a variable of the POU is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Slot {
    Register(u32),
    /// Fixed address.
    Abs(u32),
    /// Offset in the function block's instance.
    This(u32),
}

/// An address: a register or nothing, and a constant.
#[derive(Debug, Clone, Copy)]
pub struct Addr {
    pub local: Option<u32>,
    pub offset: u32,
}

/// A loop's labels as absolute depths.
#[derive(Debug, Clone, Copy)]
pub struct Labels {
    pub exit: u32,
    pub next: u32,
}

pub struct Code<'a> {
    pub a: &'a Analyzed,
    pub memory: &'a Memory,
    pub indices: &'a Indices,
    pub options: &'a Options,
    pub pou: &'a Pou,
    pub pou_index: u32,
    instance: Option<usize>,
    pub frame: &'a Frame,
    pub out: Vec<I<'static>>,
    /// (instruction, statement).
    marks: Vec<(usize, u32)>,
    params: u32,
    locals: Vec<ValType>,
    free: Vec<(ValType, u32)>,
    pub vars: HashMap<u32, Slot>,
    pub temps: Vec<u32>,
    pub result: Option<Slot>,
    pub statement: u32,
    pub depth: u32,
    pub loops: Vec<Labels>,
}

/// Offset in a function's code and the statement that begins there.
pub type Lines = Vec<(u32, u32)>;

/// Parameters of a function: inputs by value, arrays and VAR_IN_OUT by address.
pub fn params(pou: &Pou) -> Vec<ValType> {
    pou.vars
        .iter()
        .filter_map(|v| match v.section {
            Section::Input => Some(v.ty.elem().map_or(ValType::I32, val_type)),
            Section::InOut => Some(ValType::I32),
            _ => None,
        })
        .collect()
}

impl<'a> Code<'a> {
    pub fn new(
        a: &'a Analyzed,
        memory: &'a Memory,
        indices: &'a Indices,
        options: &'a Options,
        pou_index: u32,
        instance: Option<usize>,
    ) -> Self {
        let pou = &a.tables.pous[pou_index as usize];
        Self {
            a,
            memory,
            indices,
            options,
            pou,
            pou_index,
            instance,
            frame: &memory.frames[pou_index as usize],
            out: Vec::new(),
            marks: Vec::new(),
            params: match pou.kind {
                PouKind::Program => 0,
                PouKind::FunctionBlock => 1,
                PouKind::Function => params(pou).len() as u32,
            },
            locals: Vec::new(),
            free: Vec::new(),
            vars: HashMap::new(),
            temps: Vec::new(),
            result: None,
            statement: 0,
            depth: 0,
            loops: Vec::new(),
        }
    }

    /// The whole function, and the place of each statement in it.
    ///
    /// `Err` when no engine would take it: too many inputs or registers, too much code.
    pub fn function(mut self, body: &Body) -> Result<(Function, Lines), Box<Diagnostic>> {
        self.assign_slots();
        for ty in &body.temps {
            let local = self.new_local(val_type(*ty));
            self.temps.push(local);
        }
        self.entry();
        self.statements(&body.stmts);
        self.push_result();
        self.op(I::End);
        let mut function = Function::new_with_locals_types(self.locals.iter().copied());
        let mut lines: Lines = Vec::new();
        let mut marks = self.marks.iter().peekable();
        for (i, instruction) in self.out.iter().enumerate() {
            while let Some((at, statement)) = marks.peek() {
                if *at > i {
                    break;
                }
                let offset = function.byte_len() as u32;
                match lines.last_mut() {
                    Some(last) if last.0 == offset => last.1 = *statement,
                    _ => lines.push((offset, *statement)),
                }
                marks.next();
            }
            function.instruction(instruction);
        }
        let registers = self.params as usize + self.locals.len();
        for (what, has, most) in [
            ("inputs", self.params as usize, limits::PARAMETERS),
            ("variables and intermediate values", registers, limits::REGISTERS),
            ("bytes of code", function.byte_len(), limits::POU_CODE_BYTES),
        ] {
            if has > most {
                let text = format!("`{}` has {has} {what}, at most {most} are possible", self.pou.name.text);
                let d = Diagnostic::new("E0803", self.pou.name.span, text);
                return Err(Box::new(d.help("split it into several POUs")));
            }
        }
        Ok((function, lines))
    }

    pub fn op(&mut self, i: I<'static>) {
        self.out.push(i);
    }

    fn new_local(&mut self, ty: ValType) -> u32 {
        self.locals.push(ty);
        self.params + self.locals.len() as u32 - 1
    }

    /// A register for a moment; hand it back with [`Self::give`].
    pub fn take(&mut self, ty: ValType) -> u32 {
        match self.free.iter().rposition(|(t, _)| *t == ty) {
            Some(i) => self.free.swap_remove(i).1,
            None => self.new_local(ty),
        }
    }

    pub fn give(&mut self, ty: ValType, local: u32) {
        self.free.push((ty, local));
    }

    /// Marks the place of a statement and sets it for faults.
    pub fn mark(&mut self, statement: u32) {
        self.statement = statement;
        self.marks.push((self.out.len(), statement));
    }

    pub fn open(&mut self, i: I<'static>) -> u32 {
        self.op(i);
        self.depth += 1;
        self.depth
    }

    pub fn block(&mut self) -> u32 {
        self.open(I::Block(BlockType::Empty))
    }

    pub fn close(&mut self) {
        self.op(I::End);
        self.depth -= 1;
    }

    /// Branch distance to a block opened at this depth.
    pub fn to(&self, label: u32) -> u32 {
        self.depth - label
    }

    fn assign_slots(&mut self) {
        let mut param = 0;
        for (i, v) in self.pou.vars.iter().enumerate() {
            let i = i as u32;
            let is_param =
                self.pou.kind == PouKind::Function && matches!(v.section, Section::Input | Section::InOut);
            let register = param;
            param += u32::from(is_param);
            if v.external.is_some() || v.located.is_some() || (v.constant && v.value.is_some()) {
                continue;
            }
            let slot = if let Some(at) = self.memory.constants.get(&(self.pou_index, i)) {
                Slot::Abs(*at)
            } else if v.section == Section::InOut {
                // The register holds the address; in function blocks it lies in the instance.
                if is_param { Slot::Register(register) } else { Slot::This(v.offset) }
            } else if let Some(at) = self.frame.vars.get(&i) {
                Slot::Abs(*at)
            } else if is_param {
                Slot::Register(register)
            } else if self.pou.kind == PouKind::Function || v.section == Section::Temp {
                let Some(e) = v.ty.elem() else { continue };
                Slot::Register(self.new_local(val_type(e)))
            } else if let Some(n) = self.instance {
                Slot::Abs(self.memory.instances[n].vars[i as usize])
            } else {
                Slot::This(v.offset)
            };
            self.vars.insert(i, slot);
        }
        if let Some(e) = self.pou.returns.as_ref().and_then(Type::elem) {
            self.result = Some(match self.frame.result {
                Some(at) => Slot::Abs(at),
                None => Slot::Register(self.new_local(val_type(e))),
            });
        }
    }

    /// Brings parameters and temporary variables into their first state.
    fn entry(&mut self) {
        let mut param = 0;
        for (i, v) in self.pou.vars.iter().enumerate() {
            let i = i as u32;
            let is_param =
                self.pou.kind == PouKind::Function && matches!(v.section, Section::Input | Section::InOut);
            let register = param;
            param += u32::from(is_param);
            let slot = self.vars.get(&i).copied();
            let bytes = self.a.tables.size_of(&v.ty) as i32;
            if is_param {
                if v.section == Section::InOut {
                    continue;
                }
                // By value: what is not in a register is copied.
                match (slot, v.ty.elem()) {
                    (Some(Slot::Abs(at)), Some(e)) => {
                        self.op(I::I32Const(0));
                        self.op(I::LocalGet(register));
                        self.store_op(e, at);
                    }
                    (Some(Slot::Abs(at)), None) => {
                        self.op(I::I32Const(at as i32));
                        self.op(I::LocalGet(register));
                        self.copy(bytes);
                    }
                    _ => {}
                }
                continue;
            }
            let temporary = self.pou.kind == PouKind::Function || v.section == Section::Temp;
            if !temporary || v.constant || v.external.is_some() {
                continue;
            }
            match (slot, v.ty.elem()) {
                (Some(slot), Some(e)) => self.initialise(slot, e, &v.ty, &v.init),
                (Some(Slot::Abs(at)), None) => {
                    self.op(I::I32Const(at as i32));
                    if let Some(template) = self.frame.templates.get(&i) {
                        self.op(I::I32Const(*template as i32));
                        self.copy(bytes);
                    } else {
                        self.op(I::I32Const(0));
                        self.op(I::I32Const(bytes));
                        self.op(I::MemoryFill(0));
                    }
                }
                _ => {}
            }
        }
        if let (Some(slot), Some(ty)) = (self.result, self.pou.returns.clone())
            && let Some(e) = ty.elem()
        {
            self.initialise(slot, e, &ty, &InitData::Default);
        }
    }

    fn initialise(&mut self, slot: Slot, e: ElemType, ty: &Type, init: &InitData) {
        let value = self.initial(e, ty, init);
        match slot {
            // Registers are zero at entry.
            Slot::Register(_)
                if value == Const::I(0) || value == Const::F32(0.0) || value == Const::F64(0.0) => {}
            Slot::Register(r) => {
                self.constant(e, value);
                self.op(I::LocalSet(r));
            }
            Slot::Abs(at) => {
                self.op(I::I32Const(0));
                self.constant(e, value);
                self.store_op(e, at);
            }
            Slot::This(_) => {}
        }
    }

    fn initial(&self, e: ElemType, ty: &Type, init: &InitData) -> Const {
        if let InitData::Scalar(c) = init {
            return *c;
        }
        let mut bytes = [0_u8; 8];
        self.a.tables.write_init(&mut bytes, 0, ty, init);
        match e {
            ElemType::Real => Const::F32(0.0),
            ElemType::Lreal => Const::F64(0.0),
            _ => Const::I(crate::ir::wrap(e, i128::from(i64::from_le_bytes(bytes)))),
        }
    }

    /// Pushes the function's result, if it has one.
    pub fn push_result(&mut self) {
        let Some(e) = self.pou.returns.as_ref().and_then(Type::elem) else { return };
        match self.result {
            Some(Slot::Register(r)) => self.op(I::LocalGet(r)),
            Some(Slot::Abs(at)) => {
                self.op(I::I32Const(0));
                self.load_op(e, at);
            }
            _ => {}
        }
    }

    pub fn constant(&mut self, e: ElemType, c: Const) {
        match c {
            Const::I(v) if e.is_wide() => self.op(I::I64Const(v)),
            Const::I(v) => self.op(I::I32Const(v as i32)),
            Const::F32(v) => self.op(I::F32Const(v.into())),
            Const::F64(v) => self.op(I::F64Const(v.into())),
        }
    }

    pub fn load_op(&mut self, e: ElemType, offset: u32) {
        let m = |align| mem(offset, align);
        self.op(match e {
            ElemType::Bool | ElemType::Byte | ElemType::Usint => I::I32Load8U(m(0)),
            ElemType::Sint => I::I32Load8S(m(0)),
            ElemType::Word | ElemType::Uint => I::I32Load16U(m(0)),
            ElemType::Int => I::I32Load16S(m(0)),
            ElemType::Dword | ElemType::Udint | ElemType::Dint => I::I32Load(m(0)),
            ElemType::Real => I::F32Load(m(0)),
            ElemType::Lreal => I::F64Load(m(0)),
            ElemType::Lword | ElemType::Lint | ElemType::Ulint | ElemType::Time => I::I64Load(m(0)),
        });
    }

    pub fn store_op(&mut self, e: ElemType, offset: u32) {
        // Alignment is only a hint; located values may lie anywhere.
        let m = mem(offset, 0);
        self.op(match (e, e.bytes()) {
            (ElemType::Real, _) => I::F32Store(m),
            (ElemType::Lreal, _) => I::F64Store(m),
            (_, 1) => I::I32Store8(m),
            (_, 2) => I::I32Store16(m),
            (_, 4) => I::I32Store(m),
            _ => I::I64Store(m),
        });
    }

    /// `memory.copy` of the two addresses on the stack.
    pub fn copy(&mut self, bytes: i32) {
        self.op(I::I32Const(bytes));
        self.op(I::MemoryCopy { src_mem: 0, dst_mem: 0 });
    }

    /// Stops with a fault. `value` and `real` push the fault's values.
    pub fn trap(&mut self, id: TrapId, value: impl FnOnce(&mut Self), real: impl FnOnce(&mut Self)) {
        self.op(I::I32Const(id as i32));
        self.op(I::I32Const(self.statement as i32));
        match (self.pou.kind, self.instance) {
            (_, Some(n)) => self.op(I::I32Const(self.memory.instances[n].offset as i32)),
            (PouKind::FunctionBlock, None) => self.op(I::LocalGet(0)),
            // A function has no instance.
            _ => self.op(I::I32Const(0)),
        }
        value(self);
        real(self);
        self.op(I::Call(self.indices.trap));
        self.op(I::Unreachable);
    }

    /// As [`Self::trap`], for a fault about the integer in this register of that type.
    pub fn trap_int(&mut self, id: TrapId, e: ElemType, local: u32) {
        self.trap(
            id,
            |c| {
                c.op(I::LocalGet(local));
                c.extend(e);
            },
            |c| c.op(I::F64Const(0.0.into())),
        );
    }

    /// An integer of type `e` on the stack as `i64`.
    pub fn extend(&mut self, e: ElemType) {
        if !e.is_wide() {
            self.op(if e.is_signed() { I::I64ExtendI32S } else { I::I64ExtendI32U });
        }
    }
}

/// Stores the trap record and stops.
pub fn trap_function() -> Function {
    let mut f = Function::new([]);
    let m = |offset: u32| mem(offset, 2);
    for (local, at) in [(0, sys::TRAP_ID), (1, sys::TRAP_STATEMENT), (2, sys::TRAP_INSTANCE)] {
        f.instruction(&I::I32Const(0)).instruction(&I::LocalGet(local)).instruction(&I::I32Store(m(at)));
    }
    f.instruction(&I::I32Const(0)).instruction(&I::LocalGet(3)).instruction(&I::I64Store(m(sys::TRAP_VALUE)));
    f.instruction(&I::I32Const(0)).instruction(&I::LocalGet(4)).instruction(&I::F64Store(m(sys::TRAP_REAL)));
    f.instruction(&I::Unreachable).instruction(&I::End);
    f
}

/// Calls the programs of a task one after the other.
pub fn task_function(programs: &[u32]) -> Function {
    let mut f = Function::new([]);
    for p in programs {
        f.instruction(&I::Call(*p));
    }
    f.instruction(&I::End);
    f
}
