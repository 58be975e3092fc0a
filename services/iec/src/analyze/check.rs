//! The checker's state and the values it passes around.

use crate::Options;
use crate::artifact::ElemType;
use crate::diagnostic::{Diagnostic, Severity, Span};
use crate::ir::{Body, Const, Expr, ExprKind, LocatedUse, Place};
use crate::types::{ElemExt, Type};

use super::tables::{Pou, Tables};

/// What an expression is.
#[derive(Debug, Clone)]
pub enum Val {
    /// Integer literal, or an expression of such: takes the type its context asks for.
    Int(i128),
    /// Real literal: nearest `f64` and nearest `f32`.
    Real(f64, f32),
    /// A value. The type is elementary or an enumeration.
    Expr(Expr, Type),
    /// A whole array, structure or function block instance.
    Whole(Place, Type),
    /// Reported already.
    Error,
}

impl Val {
    pub fn elem(e: Expr) -> Self {
        let ty = Type::Elem(e.ty);
        Self::Expr(e, ty)
    }
    pub fn bool(b: bool) -> Self {
        Self::elem(Expr::int(ElemType::Bool, i64::from(b)))
    }
}

/// A FOR variable whose value is at hand in a temporary while its body is checked.
#[derive(Debug, Clone)]
pub struct Counter {
    pub place: Place,
    pub temp: u32,
}

/// Checks one body, or constant expressions of declarations.
pub struct Checker<'a> {
    pub tables: &'a Tables,
    /// The POU whose names are visible.
    pub pou: Option<&'a Pou>,
    pub options: &'a Options,
    pub diags: Vec<Diagnostic>,
    /// Errors among them.
    pub errors: usize,
    pub body: Body,
    /// Id of the current statement.
    pub statement: u32,
    /// Loops around the current statement.
    pub loops: u32,
    pub counters: Vec<Counter>,
    /// Known bounds of temporaries.
    pub temp_ranges: Vec<(i128, i128)>,
    /// Only constants are allowed.
    pub constant_only: bool,
    /// A statement was left out.
    pub dropped: bool,
}

impl<'a> Checker<'a> {
    pub fn new(tables: &'a Tables, pou: Option<&'a Pou>, options: &'a Options) -> Self {
        Self {
            tables,
            pou,
            options,
            diags: Vec::new(),
            errors: 0,
            body: Body::default(),
            statement: 0,
            loops: 0,
            counters: Vec::new(),
            temp_ranges: Vec::new(),
            constant_only: false,
            dropped: false,
        }
    }

    pub fn report(&mut self, d: Diagnostic) {
        self.errors += usize::from(d.severity == Severity::Error);
        self.diags.push(d);
    }

    pub fn error(&mut self, code: &'static str, span: Span, message: impl Into<String>) -> Val {
        self.report(Diagnostic::new(code, span, message));
        Val::Error
    }

    /// A new temporary of this type whose value is known to lie in `range`.
    pub fn temp(&mut self, ty: ElemType, range: (i128, i128)) -> u32 {
        self.body.temps.push(ty);
        self.temp_ranges.push(range);
        (self.body.temps.len() - 1) as u32
    }

    /// Notes an access to a located byte.
    pub fn note_located(&mut self, place: &Place, bytes: u32, write: bool) {
        let crate::ir::Base::Abs(address) = place.base else { return };
        let image = &self.tables.image;
        if address < image.input || address >= image.end {
            return;
        }
        let bit = match place.storage {
            crate::artifact::Storage::Bit(b) => Some(b),
            _ => None,
        };
        // A subscript that is known at run time only may reach the whole array.
        let reach: i64 =
            place.index.iter().flat_map(|i| &i.terms).map(|t| (t.hi - t.lo) * i64::from(t.stride)).sum();
        let bytes = bytes + reach as u32;
        let used =
            LocatedUse { statement: self.statement, address: address + place.offset, bytes, bit, write };
        self.body.located.push(used);
    }

    /// Value of a place.
    pub fn load(&mut self, place: Place, ty: &Type) -> Val {
        let Some(elem) = ty.elem() else { return Val::Whole(place, ty.clone()) };
        if let Some(c) = self.counters.iter().rev().find(|c| c.place == place) {
            let e = Expr::new(elem, ExprKind::Temp(c.temp));
            return Val::Expr(e, ty.of_value());
        }
        let bytes = match place.storage {
            crate::artifact::Storage::Plain => elem.bytes(),
            crate::artifact::Storage::Bit(_) => 1,
            crate::artifact::Storage::Millis32 => 4,
        };
        self.note_load(&place, bytes);
        Val::Expr(Expr::new(elem, ExprKind::Load(place)), ty.of_value())
    }

    fn note_load(&mut self, place: &Place, bytes: u32) {
        self.note_located(place, bytes, false);
    }

    /// The type's name for messages, literals included.
    pub fn describe(&self, v: &Val) -> String {
        match v {
            Val::Int(n) => format!("the integer {n}"),
            Val::Real(r, _) => format!("the real number {r}"),
            Val::Expr(_, t) | Val::Whole(_, t) => self.tables.type_name(t),
            Val::Error => "?".to_owned(),
        }
    }
}

/// Constant of an integer-like or real type from a mathematical integer, if it fits.
pub fn int_const(ty: ElemType, v: i128) -> Option<Const> {
    match ty {
        ElemType::Real => Some(Const::F32(v as f32)),
        ElemType::Lreal => Some(Const::F64(v as f64)),
        ElemType::Time => None,
        _ => {
            let (lo, hi) = ty.range();
            (v >= lo && v <= hi).then_some(Const::I(v as i64))
        }
    }
}
