//! Types and what the standard says about them: ranges, implicit widening, sizes.

mod elem;

use std::rc::Rc;

pub use elem::{ElemExt, common_type, elementary, widens};

use crate::artifact::ElemType;

/// The type of a variable.
#[derive(Debug, Clone, PartialEq)]
pub enum Type {
    Elem(ElemType),
    /// Values of an elementary integer type between two bounds (inclusive).
    Subrange(Rc<Subrange>),
    Array(Rc<ArrayType>),
    /// Index into the program's structures.
    Struct(u32),
    /// Index into the program's enumerations; stored as INT.
    Enum(u32),
    /// Index into the program's POUs: a function block.
    Fb(u32),
    /// Reported already.
    Error,
}

#[derive(Debug, Clone, PartialEq)]
pub struct Subrange {
    pub base: ElemType,
    pub lo: i128,
    pub hi: i128,
}

#[derive(Debug, Clone, PartialEq)]
pub struct ArrayType {
    /// Bounds of each dimension, outermost first.
    pub dims: Vec<(i64, i64)>,
    pub of: Type,
}

impl ArrayType {
    /// Number of elements; bounded by [`crate::limits::ARRAY_ELEMENTS`].
    pub fn elements(&self) -> u32 {
        self.dims.iter().map(|(lo, hi)| (hi - lo + 1).max(0) as u64).product::<u64>() as u32
    }
}

impl Type {
    /// The elementary type that carries values of this type, if it is a scalar.
    pub fn elem(&self) -> Option<ElemType> {
        match self {
            Self::Elem(e) => Some(*e),
            Self::Subrange(s) => Some(s.base),
            Self::Enum(_) => Some(ElemType::Int),
            _ => None,
        }
    }

    /// The type of a value read from a variable of this type: a subrange bounds what is stored, not what is
    /// reckoned with.
    #[must_use]
    pub fn of_value(&self) -> Self {
        match self {
            Self::Subrange(s) => Self::Elem(s.base),
            other => other.clone(),
        }
    }
}
