//! Type specifications to types.

use std::rc::Rc;

use super::check::{Checker, Val};
use super::init::completed;
use super::tables::{Enum, Field, InitData, NamedType, Struct, Tables};
use crate::address::{AddressSize, LocatedAddress, parse_address};
use crate::artifact::{AreaKind, ElemType, Storage};
use crate::diagnostic::{Diagnostic, Span};
use crate::syntax::ast::{Expr, Ident, TypeSpec, TypeSpecKind};
use crate::types::{ArrayType, ElemExt, Subrange, Type, elementary};
use crate::{Options, limits};

use super::tables::{Located, Pou};

/// Makes types; used while the tables are still being filled.
pub struct Resolver<'a> {
    pub tables: &'a mut Tables,
    pub options: &'a Options,
    pub diags: &'a mut Vec<Diagnostic>,
}

impl Resolver<'_> {
    /// Type of a specification with the initial value that belongs to the type; `pou`: whose constants are visible.
    pub fn spec(&mut self, spec: &TypeSpec, pou: Option<&Pou>) -> (Type, InitData) {
        match &spec.kind {
            TypeSpecKind::Error => (Type::Error, InitData::Default),
            TypeSpecKind::Named(name) => self.named(name),
            TypeSpecKind::Subrange { base, lo, hi } => (self.subrange(base, lo, hi, pou), InitData::Default),
            TypeSpecKind::Array { dims, of } => self.array(spec.span, dims, of, pou),
            TypeSpecKind::Struct(_) | TypeSpecKind::Enum(_) => {
                let what =
                    if matches!(spec.kind, TypeSpecKind::Struct(_)) { "STRUCT" } else { "enumeration" };
                let d =
                    Diagnostic::new("E0905", spec.span, format!("an unnamed {what} is not supported here"))
                        .help("declare it as TYPE name : ... END_TYPE and use the name");
                self.diags.push(d);
                (Type::Error, InitData::Default)
            }
        }
    }

    fn named(&mut self, name: &Ident) -> (Type, InitData) {
        if let Some(e) = elementary(&name.text) {
            return (Type::Elem(e), InitData::Default);
        }
        let key = name.key();
        if let Some(t) = self.tables.types.get(&key) {
            return (t.ty.clone(), t.init.clone());
        }
        if let Some(&pou) = self.tables.pous_by_name.get(&key) {
            let p = &self.tables.pous[pou as usize];
            if p.kind == crate::syntax::ast::PouKind::FunctionBlock {
                return (Type::Fb(pou), InitData::Default);
            }
            let d = Diagnostic::new(
                "E0303",
                name.span,
                format!("`{}` is a {} and no type", name.text, p.kind.keyword()),
            )
            .also(p.name.span, "declared here");
            self.diags.push(d);
            return (Type::Error, InitData::Default);
        }
        let unsupported = [
            "STRING",
            "WSTRING",
            "CHAR",
            "WCHAR",
            "DATE",
            "LDATE",
            "TIME_OF_DAY",
            "TOD",
            "LTOD",
            "DATE_AND_TIME",
            "DT",
            "LDT",
            "POINTER",
            "REFERENCE",
        ];
        let unknown = || Diagnostic::new("E0303", name.span, format!("there is no type `{}`", name.text));
        let d = if unsupported.contains(&key.as_str()) {
            Diagnostic::new("E0906", name.span, format!("type {key} is not supported yet"))
        } else if self.diags.len() > limits::ERRORS {
            // To look for the nearest name takes its time.
            unknown()
        } else {
            unknown().help(
                nearest(
                    &key,
                    self.tables
                        .types
                        .keys()
                        .map(String::as_str)
                        .chain(
                            self.tables
                                .pous
                                .iter()
                                .filter(|p| p.kind == crate::syntax::ast::PouKind::FunctionBlock)
                                .map(|p| p.name.text.as_str()),
                        )
                        .chain(ELEMENTARY.iter().copied()),
                )
                .map_or_else(
                    || "declare it with TYPE or FUNCTION_BLOCK".to_owned(),
                    |n| format!("did you mean `{n}`?"),
                ),
            )
        };
        self.diags.push(d);
        (Type::Error, InitData::Default)
    }

    /// A constant integer of a declaration.
    pub fn constant(&mut self, e: &Expr, pou: Option<&Pou>) -> Option<i128> {
        let mut ck = Checker::new(self.tables, pou, self.options);
        ck.constant_only = true;
        let v = ck.expr(e, None);
        let value = match v {
            Val::Int(v) => Some(v),
            Val::Expr(e, _) if e.ty.is_int() => e.as_int().map(|v| crate::ir::value(e.ty, v)),
            Val::Error => None,
            _ => {
                ck.report(Diagnostic::new("E0302", e.span, "an integer constant is needed here"));
                None
            }
        };
        self.diags.append(&mut ck.diags);
        value
    }

    fn subrange(&mut self, base: &Ident, lo: &Expr, hi: &Expr, pou: Option<&Pou>) -> Type {
        let (ty, _) = self.named(base);
        let (Some(l), Some(h)) = (self.constant(lo, pou), self.constant(hi, pou)) else { return Type::Error };
        let Type::Elem(e) = ty else {
            if ty != Type::Error {
                self.diags.push(Diagnostic::new(
                    "E0401",
                    base.span,
                    "a subrange is made from an integer type",
                ));
            }
            return Type::Error;
        };
        let (min, max) = e.range();
        let span = lo.span.to(hi.span);
        if !e.is_int() {
            self.diags.push(Diagnostic::new("E0401", base.span, "a subrange is made from an integer type"));
            return Type::Error;
        }
        if l > h || l < min || h > max {
            let d = Diagnostic::new("E0407", span, format!("bounds {l}..{h} are no range of {}", e.name()))
                .help(format!("the lower bound comes first; {} holds {min} to {max}", e.name()));
            self.diags.push(d);
            return Type::Error;
        }
        Type::Subrange(Rc::new(Subrange { base: e, lo: l, hi: h }))
    }

    fn array(
        &mut self,
        span: Span,
        dims: &[(Expr, Expr)],
        of: &TypeSpec,
        pou: Option<&Pou>,
    ) -> (Type, InitData) {
        const WRONG: (Type, InitData) = (Type::Error, InitData::Default);
        let (of_ty, of_init) = self.spec(of, pou);
        let mut bounds = Vec::new();
        let mut elements: i128 = 1;
        for (lo, hi) in dims {
            let (Some(l), Some(h)) = (self.constant(lo, pou), self.constant(hi, pou)) else {
                return WRONG;
            };
            let fits = |v: i128| i32::try_from(v).is_ok();
            if l > h || !fits(l) || !fits(h) {
                let d = Diagnostic::new(
                    "E0407",
                    lo.span.to(hi.span),
                    format!("array bounds {l}..{h} are no range"),
                )
                .help("the lower bound comes first; bounds are DINT values");
                self.diags.push(d);
                return WRONG;
            }
            elements *= h - l + 1;
            bounds.push((l as i64, h as i64));
        }
        if of_ty == Type::Error {
            return WRONG;
        }
        if self.tables.depth_of(&of_ty) >= limits::INSTANCE_DEPTH {
            self.diags.push(super::too_deep(span));
            return WRONG;
        }
        let bytes = elements * i128::from(self.tables.size_of(&of_ty).max(1));
        if elements > limits::ARRAY_ELEMENTS || bytes > i128::from(limits::MEMORY_BYTES) {
            let d = Diagnostic::new(
                "E0805",
                span,
                format!("array has {elements} elements of {} bytes", self.tables.size_of(&of_ty)),
            )
            .help(format!(
                "at most {} elements and {} bytes of memory altogether",
                limits::ARRAY_ELEMENTS,
                limits::MEMORY_BYTES
            ));
            self.diags.push(d);
            return WRONG;
        }
        // `ARRAY OF ARRAY` keeps its own level: elements are reached with a[i][j].
        let init = match of_init {
            InitData::Default => InitData::Default,
            // Every element starts with what its type says.
            own => InitData::Array([(elements as u32, own)].into()),
        };
        (Type::Array(Rc::new(ArrayType { dims: bounds, of: of_ty })), init)
    }

    /// A named structure; its fields' types are known already.
    pub fn structure(&mut self, name: &Ident, fields: &[crate::syntax::ast::VarDecl]) -> Type {
        let mut out: Vec<Field> = Vec::new();
        let (mut bytes, mut align, mut depth) = (0_u64, 1_u32, 1_u32);
        let members: usize = fields.iter().map(|d| d.names.len()).sum();
        if members == 0 || members > limits::MEMBERS {
            let d = if members == 0 {
                Diagnostic::new("E0905", name.span, format!("STRUCT `{}` has no member", name.text))
            } else {
                let text = format!("STRUCT `{}` has more than {} members", name.text, limits::MEMBERS);
                Diagnostic::new("E0801", name.span, text)
            };
            self.diags.push(d);
            return Type::Error;
        }
        for decl in fields {
            if let Some(at) = &decl.at {
                self.diags.push(Diagnostic::new("E0905", at.span, "AT inside a STRUCT is not supported"));
            }
            let (ty, type_init) = self.spec(&decl.spec, None);
            let init = match &decl.init {
                Some(i) => completed(self.init(i, &ty, None), &type_init),
                None => type_init,
            };
            depth = depth.max(1 + self.tables.depth_of(&ty));
            for name in &decl.names {
                if let Some(first) = out.iter().find(|f| f.name.text.eq_ignore_ascii_case(&name.text)) {
                    self.diags.push(super::duplicate(&name.text, first.name.span, name.span));
                    continue;
                }
                let a = self.tables.align_of(&ty);
                bytes = bytes.next_multiple_of(u64::from(a));
                out.push(Field {
                    name: name.clone(),
                    ty: ty.clone(),
                    init: init.clone(),
                    offset: bytes.min(u64::from(u32::MAX)) as u32,
                });
                bytes += self.tables.size_of(&ty);
                align = align.max(a);
            }
        }
        bytes = bytes.next_multiple_of(u64::from(align));
        if bytes > limits::MEMORY_BYTES {
            self.diags.push(Diagnostic::new(
                "E0805",
                name.span,
                format!("STRUCT `{}` has {bytes} bytes", name.text),
            ));
            return Type::Error;
        }
        if depth > limits::INSTANCE_DEPTH {
            self.diags.push(super::too_deep(name.span));
            return Type::Error;
        }
        let index = self.tables.structs.len() as u32;
        let bytes = bytes as u32;
        self.tables.structs.push(Struct { name: name.text.clone(), fields: out, bytes, align, depth });
        Type::Struct(index)
    }

    /// A named enumeration.
    pub fn enumeration(&mut self, name: &Ident, values: &[(Ident, Option<Expr>)]) -> Type {
        let index = self.tables.enums.len() as u32;
        let mut out: Vec<(Ident, i64)> = Vec::new();
        let mut next: i128 = 0;
        for (ident, value) in values {
            if let Some(v) = value {
                next = self.constant(v, None).unwrap_or(next);
            }
            if i16::try_from(next).is_err() {
                let d = Diagnostic::new(
                    "E0104",
                    ident.span,
                    format!("value {next} does not fit: enumerations are INT"),
                );
                self.diags.push(d);
                next = 0;
            }
            if let Some((first, _)) = out.iter().find(|(i, _)| i.text.eq_ignore_ascii_case(&ident.text)) {
                self.diags.push(super::duplicate(&ident.text, first.span, ident.span));
                continue;
            }
            out.push((ident.clone(), next as i64));
            let slot = self.tables.enum_values.entry(ident.key());
            slot.and_modify(|v| *v = None).or_insert(Some((index, next as i64)));
            next += 1;
        }
        self.tables.enums.push(Enum { name: name.text.clone(), values: out });
        Type::Enum(index)
    }

    /// Enters a named type.
    pub fn enter(&mut self, name: &Ident, ty: Type, init: InitData) {
        self.tables.types.insert(name.key(), NamedType { ty, init, span: name.span });
    }

    /// The place of `AT %...` for a variable of this type.
    pub fn located(&mut self, at: &Ident, ty: &Type) -> Option<Located> {
        match locate(self.tables, &at.text, ty) {
            Ok(l) => Some(l),
            Err((code, message)) => {
                self.diags.push(Diagnostic::new(code, at.span, message));
                None
            }
        }
    }
}

const ELEMENTARY: &[&str] = &[
    "BOOL", "BYTE", "WORD", "DWORD", "LWORD", "SINT", "INT", "DINT", "LINT", "USINT", "UINT", "UDINT",
    "ULINT", "REAL", "LREAL", "TIME", "LTIME",
];

/// Where an address lies in linear memory; `Err` is a sentence and its code.
pub fn locate(tables: &Tables, text: &str, ty: &Type) -> Result<Located, (&'static str, String)> {
    let address = parse_address(text, tables.addressing).map_err(|e| ("E0601", e.to_string()))?;
    let (elem, count) = match ty {
        Type::Array(a) => (a.of.elem(), u64::from(a.elements())),
        other => (other.elem(), 1),
    };
    let Some(elem) = elem else {
        return Err(("E0603", "only elementary variables and arrays of them can be located".to_owned()));
    };
    let storage = match (address.bit, elem) {
        (Some(_), ElemType::Bool) if count > 1 => {
            return Err(("E0603", "an array of BOOL at a bit address is not supported yet".to_owned()));
        }
        (Some(bit), ElemType::Bool) => Storage::Bit(bit),
        (None, ElemType::Time) if address.size == AddressSize::Dword && count == 1 => Storage::Millis32,
        _ => Storage::Plain,
    };
    let fits = match storage {
        Storage::Bit(_) | Storage::Millis32 => true,
        Storage::Plain => {
            elem != ElemType::Bool && address.bit.is_none() && address.size.bytes() == elem.bytes()
        }
    };
    if !fits {
        return Err(("E0603", size_mismatch(&address, elem)));
    }
    let bytes = u64::from(address.size.bytes()) * count;
    let (start, size) = match address.area {
        AreaKind::Input => (tables.image.input, tables.image.input_bytes),
        AreaKind::Output => (tables.image.output, tables.image.output_bytes),
        _ => (tables.image.marker, tables.image.marker_bytes),
    };
    let end = u64::from(address.byte) + bytes;
    if end > u64::from(size) {
        let area = crate::address::area_letter(address.area);
        return Err(("E0602", format!("`{text}` ends at byte {end} of %{area}, which has {size} bytes")));
    }
    Ok(Located { address, text: text.to_owned(), offset: start + address.byte, storage })
}

fn size_mismatch(address: &LocatedAddress, elem: ElemType) -> String {
    let wants = match elem {
        ElemType::Bool => 'X',
        e if e.bytes() == 1 => 'B',
        e if e.bytes() == 2 => 'W',
        e if e.bytes() == 4 => 'D',
        _ => 'L',
    };
    let also = if elem == ElemType::Time { " or D (32-bit milliseconds)" } else { "" };
    format!(
        "{} does not fit an address of size {}; it needs size {wants}{also}",
        elem.name(),
        address.size.letter()
    )
}

/// The name that is most like `key`, if one is near.
pub fn nearest<'n>(key: &str, names: impl Iterator<Item = &'n str>) -> Option<String> {
    let key = key.to_ascii_uppercase();
    // Short names are all alike.
    let limit = if key.len() < 3 { 0 } else { key.len().div_ceil(3).min(3) };
    names
        .into_iter()
        .map(|n| (distance(&key, &n.to_ascii_uppercase()), n))
        .filter(|(d, _)| *d <= limit && limit > 0)
        .min()
        .map(|(_, n)| n.to_owned())
}

/// Edit distance of two short names; long ones count as far apart.
fn distance(a: &str, b: &str) -> usize {
    if a.len() > 64 || b.len() > 64 || a.len().abs_diff(b.len()) > 3 {
        return usize::MAX;
    }
    let b: Vec<u8> = b.bytes().collect();
    let mut row: Vec<usize> = (0..=b.len()).collect();
    for (i, ca) in a.bytes().enumerate() {
        let mut diagonal = row[0];
        row[0] = i + 1;
        for j in 0..b.len() {
            let cost = diagonal + usize::from(ca != b[j]);
            diagonal = row[j + 1];
            row[j + 1] = cost.min(row[j] + 1).min(row[j + 1] + 1);
        }
    }
    row[b.len()]
}
