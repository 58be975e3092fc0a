//! Initial values.

use std::collections::HashMap;

use super::check::{Checker, Val};
use super::resolve::Resolver;
use super::tables::{InitData, Pou};
use crate::diagnostic::{Diagnostic, Span};
use crate::ir::{Const, ExprKind};
use crate::syntax::ast::{Expr, Ident, Init, Section};
use crate::types::{ArrayType, Type};

/// An initial value as given, where it says nothing completed by that of the type.
///
/// `own` of an array is one repeated value (its element type's), or what the array's own type gives.
pub fn completed(given: InitData, own: &InitData) -> InitData {
    match (given, own) {
        (InitData::Default, own) => own.clone(),
        // The later one counts.
        (InitData::Members(given), InitData::Members(own)) => {
            InitData::Members(own.iter().chain(given.iter()).cloned().collect())
        }
        (InitData::Array(given), InitData::Array(own)) => {
            let [(total, of)] = &**own else { return InitData::Array(given) };
            let mut out: Vec<(u32, InitData)> =
                given.iter().map(|(n, d)| (*n, completed(d.clone(), of))).collect();
            let used = out.iter().map(|(n, _)| *n).fold(0, u32::saturating_add);
            if used < *total {
                out.push((total - used, of.clone()));
            }
            InitData::Array(out.into())
        }
        (given, _) => given,
    }
}

impl Resolver<'_> {
    /// Value of an initialiser for a variable of this type.
    pub fn init(&mut self, init: &Init, ty: &Type, pou: Option<&Pou>) -> InitData {
        match (ty, init) {
            (Type::Error, _) => InitData::Default,
            (Type::Array(a), Init::Array(items, span)) => self.init_array(items, *span, a, pou),
            (Type::Array(_), other) => {
                let d = Diagnostic::new("E0408", other.span(), "an array is initialised with a list")
                    .help("write [1, 2, 3] or [10(0)]");
                self.diags.push(d);
                InitData::Default
            }
            (Type::Struct(_) | Type::Fb(_), Init::Struct(members, _)) => self.init_members(members, ty, pou),
            (Type::Struct(_) | Type::Fb(_), other) => {
                let d = Diagnostic::new(
                    "E0408",
                    other.span(),
                    "a structure or instance is initialised member by member",
                )
                .help("write (name := value, ...)");
                self.diags.push(d);
                InitData::Default
            }
            (_, Init::Expr(e)) => self.scalar(e, ty, pou).map_or(InitData::Default, InitData::Scalar),
            (_, Init::Struct(members, _)) if members.is_empty() => InitData::Default,
            (_, other) => {
                let name = self.tables.type_name(ty);
                let d =
                    Diagnostic::new("E0408", other.span(), format!("{name} is initialised with one value"));
                self.diags.push(d);
                InitData::Default
            }
        }
    }

    /// A constant of this scalar type.
    pub fn scalar(&mut self, e: &Expr, ty: &Type, pou: Option<&Pou>) -> Option<Const> {
        let mut ck = Checker::new(self.tables, pou, self.options);
        ck.constant_only = true;
        let v = ck.expr(e, ty.elem());
        let failed = matches!(v, Val::Error);
        let value = ck.coerce(v, e.span, ty, "initial value");
        let result = value.and_then(|v| match v.kind {
            ExprKind::Const(c) => Some(c),
            _ => {
                if !failed {
                    ck.report(
                        Diagnostic::new("E0302", e.span, "an initial value must be a constant")
                            .help("assign it in the first scan instead"),
                    );
                }
                None
            }
        });
        self.diags.append(&mut ck.diags);
        result
    }

    fn init_array(
        &mut self,
        items: &[(Option<Expr>, Init)],
        span: Span,
        a: &ArrayType,
        pou: Option<&Pou>,
    ) -> InitData {
        let total = u64::from(a.elements());
        let mut out = Vec::new();
        let mut count: u64 = 0;
        for (times, item) in items {
            let n = match times {
                None => 1,
                Some(e) => match self.constant(e, pou) {
                    Some(n) if (0..=i128::from(u32::MAX)).contains(&n) => n as u64,
                    Some(n) => {
                        self.diags.push(Diagnostic::new("E0407", e.span, format!("{n} repetitions")));
                        0
                    }
                    None => 0,
                },
            };
            let value = self.init(item, &a.of, pou);
            count += n;
            if count > total {
                let d = Diagnostic::new(
                    "E0408",
                    span,
                    format!("the list has {count} or more values, the array {total} elements"),
                )
                .help("leave values out or make the array larger");
                self.diags.push(d);
                break;
            }
            out.push((n as u32, value));
        }
        InitData::Array(out.into())
    }

    fn init_members(&mut self, members: &[(Ident, Init)], ty: &Type, pou: Option<&Pou>) -> InitData {
        let mut out: Vec<(u32, InitData)> = Vec::new();
        let mut seen: HashMap<String, Span> = HashMap::new();
        for (name, init) in members {
            let found: Option<(u32, Type)> = match ty {
                Type::Struct(s) => self.tables.structs[*s as usize]
                    .fields
                    .iter()
                    .position(|f| f.name.text.eq_ignore_ascii_case(&name.text))
                    .map(|i| (i as u32, self.tables.structs[*s as usize].fields[i].ty.clone())),
                Type::Fb(p) => {
                    let p = &self.tables.pous[*p as usize];
                    p.by_name
                        .get(&name.key())
                        .filter(|i| {
                            let v = &p.vars[**i as usize];
                            v.has_storage() && matches!(v.section, Section::Input | Section::Output)
                        })
                        .map(|i| (*i, p.vars[*i as usize].ty.clone()))
                }
                _ => None,
            };
            if let Some(first) = seen.get(&name.key()) {
                self.diags.push(super::duplicate(&name.text, *first, name.span));
                continue;
            }
            seen.insert(name.key(), name.span);
            let Some((index, member)) = found else {
                let d = Diagnostic::new(
                    "E0309",
                    name.span,
                    format!("`{}` is no member that can be initialised here", name.text),
                );
                self.diags.push(d);
                continue;
            };
            let value = self.init(init, &member, pou);
            out.push((index, value));
        }
        InitData::Members(out.into())
    }
}
