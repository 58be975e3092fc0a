//! What the analysis knows about the whole program, and the result it hands to the emitter.

use std::collections::HashMap;
use std::rc::Rc;

use crate::address::LocatedAddress;
use crate::artifact::{ElemType, Storage};
use crate::diagnostic::Span;
use crate::ir::{Body, Const};
use crate::syntax::ast::{Ident, PouKind, Section};
use crate::types::{ElemExt, Type};

/// Initial value of a variable. Cheap to clone: many variables may share a long list.
#[derive(Debug, Clone, PartialEq, Default)]
pub enum InitData {
    /// The type's own.
    #[default]
    Default,
    Scalar(Const),
    /// Items with repetition, row by row.
    Array(Rc<[(u32, InitData)]>),
    /// By index of the member.
    Members(Rc<[(u32, InitData)]>),
}

/// A located variable's place.
#[derive(Debug, Clone, PartialEq)]
pub struct Located {
    pub address: LocatedAddress,
    /// As written.
    pub text: String,
    /// Byte in linear memory.
    pub offset: u32,
    pub storage: Storage,
}

#[derive(Debug, Clone)]
pub struct Var {
    pub name: Ident,
    pub section: Section,
    pub ty: Type,
    pub init: InitData,
    pub constant: bool,
    /// Value of a scalar constant.
    pub value: Option<Const>,
    pub retain: bool,
    pub located: Option<Located>,
    /// VAR_EXTERNAL: index of the global.
    pub external: Option<u32>,
    /// Offset in the instance (function blocks).
    pub offset: u32,
    /// Made from a symbol of the stack file: where.
    pub mapped: Option<String>,
}

impl Var {
    /// True for what lies in an instance (or in the globals) and not elsewhere.
    pub fn has_storage(&self) -> bool {
        self.external.is_none() && self.located.is_none() && !self.constant && self.section != Section::Temp
    }
}

#[derive(Debug, Clone)]
pub struct Pou {
    pub kind: PouKind,
    pub name: Ident,
    pub library: bool,
    pub vars: Vec<Var>,
    pub by_name: HashMap<String, u32>,
    /// Result type of a function.
    pub returns: Option<Type>,
    /// Size and alignment of an instance (function blocks).
    pub bytes: u32,
    pub align: u32,
    /// Levels of types in an instance.
    pub depth: u32,
    /// Statement ids: from, to (exclusive).
    pub stmts: (u32, u32),
}

#[derive(Debug, Clone)]
pub struct Field {
    pub name: Ident,
    pub ty: Type,
    pub init: InitData,
    pub offset: u32,
}

#[derive(Debug, Clone)]
pub struct Struct {
    pub name: String,
    pub fields: Vec<Field>,
    pub bytes: u32,
    pub align: u32,
    /// Levels of types in it, itself included.
    pub depth: u32,
}

#[derive(Debug, Clone)]
pub struct Enum {
    pub name: String,
    pub values: Vec<(Ident, i64)>,
}

/// A named type with its own initial value.
#[derive(Debug, Clone)]
pub struct NamedType {
    pub ty: Type,
    pub init: InitData,
    pub span: Span,
}

/// Where the areas start; fixed by the options before anything is read.
#[derive(Debug, Clone, Copy)]
pub struct ImageLayout {
    pub input: u32,
    pub input_bytes: u32,
    pub output: u32,
    pub output_bytes: u32,
    pub marker: u32,
    pub marker_bytes: u32,
    /// First byte after %M, a multiple of 8: RETAIN.
    pub end: u32,
}

/// Everything that is declared.
#[derive(Debug, Clone)]
pub struct Tables {
    pub image: ImageLayout,
    pub addressing: crate::address::Addressing,
    pub types: HashMap<String, NamedType>,
    pub structs: Vec<Struct>,
    pub enums: Vec<Enum>,
    /// Enumeration values by name: (enumeration, value); `None` when two enumerations have it.
    pub enum_values: HashMap<String, Option<(u32, i64)>>,
    pub globals: Vec<Var>,
    pub globals_by_name: HashMap<String, u32>,
    pub pous: Vec<Pou>,
    pub pous_by_name: HashMap<String, u32>,
}

impl Tables {
    /// Bytes of a variable of this type.
    pub fn size_of(&self, ty: &Type) -> u64 {
        match ty {
            Type::Elem(_) | Type::Subrange(_) | Type::Enum(_) => {
                ty.elem().map_or(0, |e| u64::from(e.bytes()))
            }
            Type::Array(a) => u64::from(a.elements()) * self.size_of(&a.of),
            Type::Struct(i) => self.structs.get(*i as usize).map_or(0, |s| u64::from(s.bytes)),
            Type::Fb(i) => self.pous.get(*i as usize).map_or(0, |p| u64::from(p.bytes)),
            Type::Error => 0,
        }
    }

    pub fn align_of(&self, ty: &Type) -> u32 {
        match ty {
            Type::Elem(_) | Type::Subrange(_) | Type::Enum(_) => ty.elem().map_or(1, ElemType::bytes),
            Type::Array(a) => self.align_of(&a.of),
            Type::Struct(i) => self.structs.get(*i as usize).map_or(1, |s| s.align),
            Type::Fb(i) => self.pous.get(*i as usize).map_or(1, |p| p.align),
            Type::Error => 1,
        }
    }

    /// Levels of structures, instances and arrays in a variable of this type; at most [`crate::limits::INSTANCE_DEPTH`].
    pub fn depth_of(&self, ty: &Type) -> u32 {
        match ty {
            Type::Elem(_) | Type::Subrange(_) | Type::Enum(_) | Type::Error => 0,
            Type::Array(a) => 1 + self.depth_of(&a.of),
            Type::Struct(i) => self.structs.get(*i as usize).map_or(0, |s| s.depth),
            Type::Fb(i) => self.pous.get(*i as usize).map_or(0, |p| p.depth),
        }
    }

    /// As a message names it.
    pub fn type_name(&self, ty: &Type) -> String {
        match ty {
            Type::Elem(e) => e.name().to_owned(),
            Type::Subrange(s) => format!("{} ({}..{})", s.base.name(), s.lo, s.hi),
            Type::Array(a) => {
                let dims: Vec<String> = a.dims.iter().map(|(lo, hi)| format!("{lo}..{hi}")).collect();
                format!("ARRAY [{}] OF {}", dims.join(", "), self.type_name(&a.of))
            }
            Type::Struct(i) => self.structs.get(*i as usize).map_or_else(String::new, |s| s.name.clone()),
            Type::Enum(i) => self.enums.get(*i as usize).map_or_else(String::new, |s| s.name.clone()),
            Type::Fb(i) => self.pous.get(*i as usize).map_or_else(String::new, |p| p.name.text.clone()),
            Type::Error => "?".to_owned(),
        }
    }

    /// Writes the initial value of a variable at `at`; `image` is zero before.
    pub fn write_init(&self, image: &mut [u8], at: usize, ty: &Type, init: &InitData) {
        match (ty, init) {
            (Type::Array(a), _) => self.write_array(image, at, a, init),
            (Type::Struct(i), _) => {
                let Some(s) = self.structs.get(*i as usize) else { return };
                for (f, given) in s.fields.iter().zip(members(init, s.fields.len())) {
                    self.write_init(image, at + f.offset as usize, &f.ty, given.unwrap_or(&f.init));
                }
            }
            (Type::Fb(i), _) => {
                let Some(p) = self.pous.get(*i as usize) else { return };
                for (v, given) in p.vars.iter().zip(members(init, p.vars.len())) {
                    if !v.has_storage() || v.section == Section::InOut {
                        continue;
                    }
                    self.write_init(image, at + v.offset as usize, &v.ty, given.unwrap_or(&v.init));
                }
            }
            (_, InitData::Scalar(c)) => {
                let Some(e) = ty.elem() else { return };
                let bytes = const_bytes(e, *c);
                let n = e.bytes() as usize;
                if let Some(to) = image.get_mut(at..at + n) {
                    to.copy_from_slice(&bytes[..n]);
                }
            }
            (Type::Subrange(s), _) => {
                self.write_init(image, at, &Type::Elem(s.base), &InitData::Scalar(Const::I(s.lo as i64)));
            }
            (Type::Enum(i), _) => {
                let first = self.enums.get(*i as usize).and_then(|e| e.values.first()).map_or(0, |v| v.1);
                self.write_init(image, at, &Type::Elem(ElemType::Int), &InitData::Scalar(Const::I(first)));
            }
            _ => {}
        }
    }

    fn write_array(&self, image: &mut [u8], at: usize, a: &crate::types::ArrayType, init: &InitData) {
        let size = self.size_of(&a.of) as usize;
        let total = a.elements() as usize;
        let mut n = 0;
        if let InitData::Array(items) = init {
            for (count, item) in items.iter() {
                for _ in 0..*count {
                    if n >= total {
                        return;
                    }
                    self.write_init(image, at + n * size, &a.of, item);
                    n += 1;
                }
            }
        }
        // The rest has the initial value of its type; nothing to do where that is zero.
        if !matches!(a.of, Type::Elem(_)) {
            for n in n..total {
                self.write_init(image, at + n * size, &a.of, &InitData::Default);
            }
        }
    }
}

/// What is given for each of so many members; of two the later one. By place: to search for each member would take long
/// where an array has many elements of many members.
fn members(init: &InitData, count: usize) -> Vec<Option<&InitData>> {
    let mut given = vec![None; count];
    if let InitData::Members(list) = init {
        for (member, data) in list.iter() {
            if let Some(place) = given.get_mut(*member as usize) {
                *place = Some(data);
            }
        }
    }
    given
}

/// Little-endian bytes of a constant.
pub fn const_bytes(ty: ElemType, c: Const) -> [u8; 8] {
    let mut bytes = [0_u8; 8];
    match c {
        Const::I(v) => bytes.copy_from_slice(&v.to_le_bytes()),
        Const::F32(v) => bytes[..4].copy_from_slice(&v.to_le_bytes()),
        Const::F64(v) => bytes.copy_from_slice(&v.to_le_bytes()),
    }
    debug_assert!(!ty.is_real() || !matches!(c, Const::I(_)));
    bytes
}

/// A task with its programs.
#[derive(Debug, Clone)]
pub struct TaskInfo {
    pub name: String,
    pub priority: u32,
    pub interval_ns: Option<u64>,
    pub single: Option<String>,
    /// Indices into [`Analyzed::instances`].
    pub programs: Vec<u32>,
}

/// A program instance.
#[derive(Debug, Clone)]
pub struct InstanceInfo {
    pub name: String,
    pub pou: u32,
    pub retain: bool,
}

/// A checked program.
#[derive(Debug)]
pub struct Analyzed {
    pub tables: Tables,
    /// By POU; `None` where nothing calls it.
    pub bodies: Vec<Option<Body>>,
    pub tasks: Vec<TaskInfo>,
    pub instances: Vec<InstanceInfo>,
    /// Longest chain of calls, the task's own frame included.
    pub call_depth: u32,
}
