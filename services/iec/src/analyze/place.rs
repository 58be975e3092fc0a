//! Names, members, subscripts: which place an expression means.

use super::check::{Checker, Val};
use super::resolve::{locate, nearest};
use super::tables::{Pou, Var};
use crate::artifact::{ElemType, Storage};
use crate::diagnostic::{Diagnostic, Span};
use crate::ir::{Base, BinOp, Const, Expr, ExprKind, Index, IndexTerm, Place};
use crate::syntax::ast::{self, Ident, PouKind, Section};
use crate::types::{ArrayType, ElemExt, Type};

/// What a name means.
pub enum Target {
    Place(Place, Type, Access),
    Const(Const, Type),
    Error,
}

/// What may be done with a place.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Access {
    Full,
    /// Own VAR_INPUT: assigning it is legal but odd.
    OwnInput,
    /// With the reason.
    ReadOnly(&'static str),
}

impl Checker<'_> {
    /// The place an assignable expression means.
    pub fn place(&mut self, e: &ast::Expr) -> Target {
        match &e.kind {
            ast::ExprKind::Error => Target::Error,
            ast::ExprKind::Name(name) => self.name(name),
            ast::ExprKind::Direct(text) => self.direct(text, e.span),
            ast::ExprKind::Field(base, field) => self.field(base, field),
            ast::ExprKind::Index(base, subscripts) => self.index(base, subscripts, e.span),
            _ => {
                self.report(Diagnostic::new("E0306", e.span, "a variable is needed here"));
                Target::Error
            }
        }
    }

    fn name(&mut self, name: &Ident) -> Target {
        let key = name.key();
        if let Some(pou) = self.pou {
            if let Some(&i) = pou.by_name.get(&key) {
                return self.own_variable(pou, i);
            }
            if pou.kind == PouKind::Function
                && pou.name.text.eq_ignore_ascii_case(&name.text)
                && let Some(ty) = &pou.returns
            {
                return Target::Place(Place::new(Base::Result, Storage::Plain), ty.clone(), Access::Full);
            }
        }
        if let Some(&g) = self.tables.globals_by_name.get(&key) {
            return self.global(g);
        }
        match self.tables.enum_values.get(&key) {
            Some(Some((e, v))) => return Target::Const(Const::I(*v), Type::Enum(*e)),
            Some(None) => {
                let d = Diagnostic::new(
                    "E0312",
                    name.span,
                    format!("several enumerations have a value `{}`", name.text),
                )
                .help(format!("write Type#{}", name.text));
                self.report(d);
                return Target::Error;
            }
            None => {}
        }
        self.unknown_name(name);
        Target::Error
    }

    fn unknown_name(&mut self, name: &Ident) {
        let key = name.key();
        let own = self.pou.iter().flat_map(|p| p.vars.iter()).map(|v| v.name.text.as_str());
        let globals = self.tables.globals.iter().map(|g| g.name.text.as_str());
        let near = nearest(&key, own.chain(globals));
        let mut d = Diagnostic::new("E0302", name.span, format!("there is no variable `{}`", name.text));
        if self.constant_only && self.pou.is_some() {
            d = Diagnostic::new(
                "E0302",
                name.span,
                format!("`{}` is no constant that is known here", name.text),
            )
            .help("constants stand in VAR CONSTANT or VAR_GLOBAL CONSTANT before their use");
        } else if let Some(t) = self.tables.types.get(&key) {
            d = Diagnostic::new("E0302", name.span, format!("`{}` is a type, not a variable", name.text));
            let values = match t.ty {
                Type::Enum(e) => self.tables.enums.get(e as usize).map(|e| e.values.as_slice()),
                _ => None,
            };
            if let Some((value, _)) = values.and_then(<[_]>::first) {
                d = d.help(format!("its values are written {}#{}", name.text, value.text));
            }
        } else if let Some(n) = near {
            d = d.help(format!("did you mean `{n}`?"));
        } else if let Some(&p) = self.tables.pous_by_name.get(&key) {
            let p = &self.tables.pous[p as usize];
            d = Diagnostic::new(
                "E0302",
                name.span,
                format!("`{}` is a {}, not a variable", name.text, p.kind.keyword()),
            );
            if p.kind == PouKind::FunctionBlock {
                d = d.help(format!("declare an instance: VAR x : {}; END_VAR", p.name.text));
            }
        } else {
            d = d.help("declare it in a VAR section");
        }
        self.report(d);
    }

    fn own_variable(&mut self, pou: &Pou, i: u32) -> Target {
        let v = &pou.vars[i as usize];
        if let Some(g) = v.external {
            return match self.global(g) {
                Target::Place(p, t, _) if v.constant => {
                    Target::Place(p, t, Access::ReadOnly("it is a CONSTANT"))
                }
                other => other,
            };
        }
        if v.section == Section::External {
            // Not linked yet: a constant expression of a declaration. A missing global is reported when it is linked.
            let global = self.tables.globals_by_name.get(&v.name.key()).copied();
            return global.map_or(Target::Error, |g| self.global(g));
        }
        if v.ty == Type::Error {
            return Target::Error;
        }
        if let (true, Some(c)) = (v.constant, v.value) {
            return Target::Const(c, v.ty.clone());
        }
        if let Some(l) = &v.located {
            return Target::Place(Place::new(Base::Abs(l.offset), l.storage), v.ty.clone(), Access::Full);
        }
        let base = if v.section == Section::InOut { Base::Ref(i) } else { Base::Var(i) };
        Target::Place(Place::new(base, Storage::Plain), v.ty.clone(), own_access(v))
    }

    fn global(&mut self, g: u32) -> Target {
        let v = &self.tables.globals[g as usize];
        if v.ty == Type::Error {
            return Target::Error;
        }
        if let (true, Some(c)) = (v.constant, v.value) {
            return Target::Const(c, v.ty.clone());
        }
        let place = match &v.located {
            Some(l) => Place::new(Base::Abs(l.offset), l.storage),
            None => Place::new(Base::Global(g), Storage::Plain),
        };
        Target::Place(place, v.ty.clone(), own_access(v))
    }

    fn direct(&mut self, text: &str, span: Span) -> Target {
        let by_size = |size| match size {
            crate::address::AddressSize::Bit => ElemType::Bool,
            crate::address::AddressSize::Byte => ElemType::Byte,
            crate::address::AddressSize::Word => ElemType::Word,
            crate::address::AddressSize::Dword => ElemType::Dword,
            crate::address::AddressSize::Lword => ElemType::Lword,
        };
        let located = crate::address::parse_address(text, self.tables.addressing)
            .map_err(|e| ("E0601", e.to_string()))
            .and_then(|a| {
                let ty = Type::Elem(by_size(a.size));
                locate(self.tables, text, &ty).map(|l| (l, ty))
            });
        match located {
            Ok((l, ty)) => Target::Place(Place::new(Base::Abs(l.offset), l.storage), ty, Access::Full),
            Err((code, message)) => {
                self.report(Diagnostic::new(code, span, message));
                Target::Error
            }
        }
    }

    fn field(&mut self, base: &ast::Expr, field: &Ident) -> Target {
        let (mut place, ty, access) = match self.place(base) {
            Target::Place(p, t, a) => (p, t, a),
            Target::Const(_, ty) => {
                let name = self.tables.type_name(&ty);
                self.report(Diagnostic::new("E0309", field.span, format!("{name} has no members")));
                return Target::Error;
            }
            Target::Error => return Target::Error,
        };
        match &ty {
            Type::Struct(s) => {
                let s = &self.tables.structs[*s as usize];
                if let Some(f) = s.fields.iter().find(|f| f.name.text.eq_ignore_ascii_case(&field.text)) {
                    place.offset += f.offset;
                    return Target::Place(place, f.ty.clone(), access);
                }
                let near = nearest(&field.key(), s.fields.iter().map(|f| f.name.text.as_str()));
                self.no_member(&s.name, field, near);
            }
            Type::Fb(p) => return self.instance_member(place, *p, field),
            other => {
                let name = self.tables.type_name(other);
                self.report(Diagnostic::new("E0309", field.span, format!("{name} has no members")));
            }
        }
        Target::Error
    }

    fn no_member(&mut self, owner: &str, field: &Ident, near: Option<String>) {
        let mut d = Diagnostic::new("E0309", field.span, format!("`{owner}` has no member `{}`", field.text));
        if let Some(n) = near {
            d = d.help(format!("did you mean `{n}`?"));
        }
        self.report(d);
    }

    fn instance_member(&mut self, mut place: Place, pou: u32, field: &Ident) -> Target {
        let p = &self.tables.pous[pou as usize];
        let Some(v) = p.by_name.get(&field.key()).map(|i| &p.vars[*i as usize]) else {
            let outside = p.vars.iter().filter(|v| matches!(v.section, Section::Input | Section::Output));
            let near = nearest(&field.key(), outside.map(|v| v.name.text.as_str()));
            self.no_member(&p.name.text, field, near);
            return Target::Error;
        };
        let access = match v.section {
            Section::Input => Access::Full,
            Section::Output => Access::ReadOnly("it is an output of the function block"),
            _ => {
                let d = Diagnostic::new(
                    "E0309",
                    field.span,
                    format!("`{}` of {} is not visible from outside", v.name.text, p.name.text),
                )
                .also(v.name.span, format!("it stands in {}", v.section.keyword()))
                .help("only VAR_INPUT and VAR_OUTPUT can be reached from outside");
                self.report(d);
                return Target::Error;
            }
        };
        if v.ty == Type::Error {
            return Target::Error;
        }
        place.offset += v.offset;
        Target::Place(place, v.ty.clone(), access)
    }

    fn index(&mut self, base: &ast::Expr, subscripts: &[ast::Expr], span: Span) -> Target {
        let (mut place, ty, access) = match self.place(base) {
            Target::Place(p, t, a) => (p, t, a),
            Target::Const(..) => {
                self.report(Diagnostic::new("E0409", base.span, "this is no array"));
                return Target::Error;
            }
            Target::Error => {
                for s in subscripts {
                    self.expr(s, None);
                }
                return Target::Error;
            }
        };
        let Type::Array(a) = &ty else {
            let name = self.tables.type_name(&ty);
            self.report(Diagnostic::new("E0409", base.span, format!("this is no array but {name}")));
            return Target::Error;
        };
        // a[i, j] on an array of arrays takes both levels.
        let mut rest = subscripts;
        let mut array: std::rc::Rc<ArrayType> = a.clone();
        loop {
            let n = array.dims.len();
            if rest.len() < n {
                let d = Diagnostic::new(
                    "E0409",
                    span,
                    format!("{} subscripts for an array of {n} dimensions", subscripts.len()),
                );
                self.report(d);
                return Target::Error;
            }
            let (own, later) = rest.split_at(n);
            if !self.subscripts(&mut place, &array, own) {
                return Target::Error;
            }
            rest = later;
            if rest.is_empty() {
                return Target::Place(place, array.of.clone(), access);
            }
            let Type::Array(next) = array.of.clone() else {
                let d = Diagnostic::new(
                    "E0409",
                    span,
                    format!("{} subscripts for an array of {n} dimensions", subscripts.len()),
                );
                self.report(d);
                return Target::Error;
            };
            array = next;
        }
    }

    /// Adds the subscripts of one array; false when one is wrong.
    fn subscripts(&mut self, place: &mut Place, array: &ArrayType, subscripts: &[ast::Expr]) -> bool {
        let mut stride = self.tables.size_of(&array.of) as u32;
        let mut strides = vec![0; array.dims.len()];
        for (i, (lo, hi)) in array.dims.iter().enumerate().rev() {
            strides[i] = stride;
            stride = stride.wrapping_mul((hi - lo + 1) as u32);
        }
        let mut good = true;
        for ((s, (lo, hi)), stride) in subscripts.iter().zip(&array.dims).zip(strides) {
            let value = match self.expr(s, None) {
                Val::Int(v) => {
                    good &= self.constant_subscript(place, s.span, v, (*lo, *hi), stride);
                    continue;
                }
                Val::Expr(e, ty) if e.ty.is_int() && !matches!(ty, Type::Enum(_)) => e,
                Val::Error => {
                    good = false;
                    continue;
                }
                other => {
                    let what = self.describe(&other);
                    let d =
                        Diagnostic::new("E0401", s.span, format!("a subscript is an integer, not {what}"));
                    self.report(d);
                    good = false;
                    continue;
                }
            };
            if let Some(c) = value.as_int() {
                good &=
                    self.constant_subscript(place, s.span, crate::ir::value(value.ty, c), (*lo, *hi), stride);
                continue;
            }
            let range = self.range(&value);
            let inside = range.0 >= i128::from(*lo) && range.1 <= i128::from(*hi);
            // In debug builds a variable may be changed at a breakpoint, so nothing is known for sure.
            let check = !inside || self.options.debug;
            let (value, lo, hi) =
                if check { (value, *lo, *hi) } else { self.shift_constant(value, *lo, *hi) };
            let nonneg = self.range(&value).0 >= 0;
            let term = IndexTerm { value, lo, hi, stride, check, nonneg };
            place.index.get_or_insert_with(|| Box::new(Index { terms: Vec::new() })).terms.push(term);
        }
        good
    }

    /// `x + c` in bounds lo..hi is `x` in bounds lo-c..hi-c: the constant goes into the address. Only where the
    /// sum cannot wrap.
    fn shift_constant(&self, value: Expr, lo: i64, hi: i64) -> (Expr, i64, i64) {
        if let ExprKind::Binary(op @ (BinOp::Add | BinOp::Sub), x, c) = &value.kind
            && let Some(c) = c.as_int()
            && c.unsigned_abs() < 1 << 24
        {
            let c = if *op == BinOp::Add { c } else { -c };
            let (least, most) = self.range(x);
            let (type_lo, type_hi) = value.ty.range();
            let (from, to) = (least + i128::from(c), most + i128::from(c));
            if from >= i128::from(lo).max(type_lo) && to <= i128::from(hi).min(type_hi) {
                return ((**x).clone(), lo - c, hi - c);
            }
        }
        (value, lo, hi)
    }

    fn constant_subscript(
        &mut self,
        place: &mut Place,
        span: Span,
        v: i128,
        (lo, hi): (i64, i64),
        stride: u32,
    ) -> bool {
        if v < i128::from(lo) || v > i128::from(hi) {
            let d = Diagnostic::new(
                "E0406",
                span,
                format!("index {v} is outside of the array's bounds {lo}..{hi}"),
            );
            self.report(d);
            return false;
        }
        place.offset += (v - i128::from(lo)) as u32 * stride;
        true
    }
}

fn own_access(v: &Var) -> Access {
    if v.constant {
        Access::ReadOnly("it is a CONSTANT")
    } else if v.section == Section::Input {
        Access::OwnInput
    } else {
        Access::Full
    }
}
