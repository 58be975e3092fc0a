//! Calls of functions and function block instances.

use super::builtins::{is_builtin, is_missing, mixed, names};
use super::check::{Checker, Val};
use super::place::{Access, Target};
use super::resolve::nearest;
use super::tables::{InitData, Pou, Var};
use crate::artifact::{ElemType, Storage};
use crate::diagnostic::{Diagnostic, Span};
use crate::ir::{Base, Call, CallArg, Const, Convert, Expr, ExprKind, FbInput, OutputCopy, Place, StmtKind};
use crate::syntax::ast::{self, Arg, Ident, PouKind, Section};
use crate::types::{ElemExt, Type, widens};

/// What stands before the parenthesis.
enum Callee<'t> {
    Instance(Place, u32),
    Function(u32, &'t Pou),
    Builtin,
    Error,
}

/// One argument beside its parameter.
struct Matched<'e> {
    var: u32,
    value: Option<&'e ast::Expr>,
    negated: bool,
    span: Span,
}

impl<'a> Checker<'a> {
    /// A call as an operand.
    pub fn call(&mut self, callee: &ast::Expr, args: &[Arg], span: Span, want: Option<ElemType>) -> Val {
        match self.callee(callee) {
            Callee::Error => {
                self.check_args_anyway(args);
                Val::Error
            }
            Callee::Instance(_, pou) => {
                let name = &self.tables.pous[pou as usize].name.text;
                let d = Diagnostic::new(
                    "E0505",
                    span,
                    format!("a call of a function block ({name}) has no value"),
                )
                .help(
                    "call it as a statement of its own, then read its outputs: inst(IN := x); y := inst.Q;",
                );
                self.report(d);
                Val::Error
            }
            Callee::Function(index, pou) => match self.function_call(index, pou, args, span) {
                Some((call, Some(ty))) => {
                    let elem = ty.elem().unwrap_or(ElemType::Bool);
                    Val::Expr(Expr::new(elem, ExprKind::Call(Box::new(call))), ty.of_value())
                }
                Some((_, None)) => {
                    let d =
                        Diagnostic::new("E0505", span, format!("function {} has no result", pou.name.text));
                    self.report(d);
                    Val::Error
                }
                None => Val::Error,
            },
            Callee::Builtin => {
                let ast::ExprKind::Name(name) = &callee.kind else { return Val::Error };
                self.builtin(name, args, span, want).unwrap_or(Val::Error)
            }
        }
    }

    /// A call as a statement.
    pub fn call_statement(&mut self, callee: &ast::Expr, args: &[Arg], span: Span) -> Option<StmtKind> {
        match self.callee(callee) {
            Callee::Error => {
                self.check_args_anyway(args);
                None
            }
            Callee::Instance(place, pou) => self.instance_call(place, pou, args, span),
            Callee::Function(index, pou) => {
                let (call, result) = self.function_call(index, pou, args, span)?;
                match result {
                    None => Some(StmtKind::CallVoid(call)),
                    Some(ty) => {
                        let has_effect = pou.vars.iter().any(|v| {
                            matches!(v.section, Section::Output | Section::InOut | Section::External)
                        });
                        if !has_effect {
                            self.unused_result(&pou.name.text, span);
                        }
                        let elem = ty.elem().unwrap_or(ElemType::Bool);
                        Some(StmtKind::Eval(Expr::new(elem, ExprKind::Call(Box::new(call)))))
                    }
                }
            }
            Callee::Builtin => {
                let ast::ExprKind::Name(name) = &callee.kind else { return None };
                let v = self.builtin(name, args, span, None)?;
                let e = self.literal_default(&v, span, None)?;
                self.unused_result(&name.text, span);
                Some(StmtKind::Eval(e))
            }
        }
    }

    fn unused_result(&mut self, name: &str, span: Span) {
        self.report(
            Diagnostic::new("W0202", span, format!("the result of {name} is not used")).help("assign it"),
        );
    }

    /// So that mistakes in the arguments of an unknown function are shown too.
    fn check_args_anyway(&mut self, args: &[Arg]) {
        for a in args {
            if let Some(v) = &a.value {
                self.expr(v, None);
            }
        }
    }

    fn callee(&mut self, callee: &ast::Expr) -> Callee<'a> {
        let ast::ExprKind::Name(name) = &callee.kind else {
            return match self.place(callee) {
                Target::Place(place, Type::Fb(p), _) => Callee::Instance(place, p),
                Target::Place(_, ty, _) => self.not_callable(&self.tables.type_name(&ty), callee.span),
                Target::Const(_, ty) => self.not_callable(&self.tables.type_name(&ty), callee.span),
                Target::Error => Callee::Error,
            };
        };
        let key = name.key();
        let own = self.pou.and_then(|p| p.by_name.get(&key).map(|i| p.vars[*i as usize].ty.clone()));
        let global =
            self.tables.globals_by_name.get(&key).map(|g| self.tables.globals[*g as usize].ty.clone());
        let variable = own.or(global);
        if let Some(Type::Fb(p)) = variable {
            return match self.place(callee) {
                Target::Place(place, _, _) => Callee::Instance(place, p),
                _ => Callee::Error,
            };
        }
        if variable == Some(Type::Error) {
            return Callee::Error;
        }
        if let Some(&p) = self.tables.pous_by_name.get(&key) {
            let pou = &self.tables.pous[p as usize];
            return match pou.kind {
                PouKind::Function => Callee::Function(p, pou),
                PouKind::FunctionBlock => {
                    let d = Diagnostic::new(
                        "E0506",
                        name.span,
                        format!("`{}` is a function block type; instances are called", name.text),
                    )
                    .help(format!("declare VAR x : {}; END_VAR and call x(...)", pou.name.text));
                    self.report(d);
                    Callee::Error
                }
                PouKind::Program => {
                    let d = Diagnostic::new(
                        "E0506",
                        name.span,
                        format!("PROGRAM `{}` cannot be called", name.text),
                    )
                    .help("programs are run by tasks; make it a FUNCTION_BLOCK to call it");
                    self.report(d);
                    Callee::Error
                }
            };
        }
        if is_builtin(&key) || (key == "__NOW" && self.pou.is_some_and(|p| p.library)) {
            return Callee::Builtin;
        }
        if let Some(ty) = variable {
            let ty = self.tables.type_name(&ty);
            return self.not_callable(&format!("`{}` ({ty})", name.text), callee.span);
        }
        if is_missing(&key) {
            self.report(Diagnostic::new("E0906", name.span, format!("{key} is not supported yet")));
            return Callee::Error;
        }
        let functions =
            self.tables.pous.iter().filter(|p| p.kind == PouKind::Function).map(|p| p.name.text.as_str());
        let instances = self
            .pou
            .iter()
            .flat_map(|p| p.vars.iter())
            .filter(|v| matches!(v.ty, Type::Fb(_)))
            .map(|v| v.name.text.as_str());
        let mut d =
            Diagnostic::new("E0506", name.span, format!("there is no function or instance `{}`", name.text));
        if let Some(n) = nearest(&key, functions.chain(instances).chain(names().map(|n| -> &str { n }))) {
            d = d.help(format!("did you mean `{n}`?"));
        }
        self.report(d);
        Callee::Error
    }

    fn not_callable(&mut self, what: &str, span: Span) -> Callee<'a> {
        self.report(Diagnostic::new("E0506", span, format!("{what} cannot be called")));
        Callee::Error
    }

    /// Arguments beside their parameters: inputs (with VAR_IN_OUT) and outputs.
    fn match_call<'e>(
        &mut self,
        pou: &Pou,
        args: &'e [Arg],
        span: Span,
    ) -> Option<(Vec<Matched<'e>>, Vec<Matched<'e>>)> {
        let params: Vec<u32> = (0..pou.vars.len() as u32)
            .filter(|i| matches!(pou.vars[*i as usize].section, Section::Input | Section::InOut))
            .collect();
        let (mut inputs, mut outputs): (Vec<Matched>, Vec<Matched>) = (Vec::new(), Vec::new());
        let positional = args.iter().filter(|a| a.name.is_none()).count();
        if positional > 0 {
            // Outputs may follow positional inputs by name.
            if let Some(a) = args.iter().find(|a| a.name.is_some() && !a.output) {
                self.report(mixed(a.span));
                return None;
            }
            if positional != params.len() {
                let names: Vec<&str> =
                    params.iter().map(|i| pou.vars[*i as usize].name.text.as_str()).collect();
                let d = Diagnostic::new(
                    "E0501",
                    span,
                    format!("{} takes {} inputs, {positional} given", pou.name.text, params.len()),
                )
                .help(format!(
                    "its inputs: {}",
                    if names.is_empty() { "none".to_owned() } else { names.join(", ") }
                ));
                self.report(d);
                return None;
            }
        }
        let mut next = params.iter();
        let mut good = true;
        for a in args {
            let Some(name) = &a.name else {
                if let Some(i) = next.next() {
                    inputs.push(Matched { var: *i, value: a.value.as_ref(), negated: false, span: a.span });
                }
                continue;
            };
            let found = pou.by_name.get(&name.key()).copied().filter(|i| {
                let section = pou.vars[*i as usize].section;
                if a.output {
                    section == Section::Output
                } else {
                    matches!(section, Section::Input | Section::InOut)
                }
            });
            let Some(i) = found else {
                self.no_parameter(pou, name, a.output);
                good = false;
                continue;
            };
            let list = if a.output { &mut outputs } else { &mut inputs };
            if list.iter().any(|m| m.var == i) {
                self.report(Diagnostic::new("E0503", name.span, format!("`{}` is given twice", name.text)));
                good = false;
                continue;
            }
            list.push(Matched { var: i, value: a.value.as_ref(), negated: a.negated, span: a.span });
        }
        if !good {
            for a in args {
                if let Some(v) = &a.value {
                    self.expr(v, None);
                }
            }
            return None;
        }
        Some((inputs, outputs))
    }

    fn no_parameter(&mut self, pou: &Pou, name: &Ident, output: bool) {
        let of = |want_output: bool| {
            pou.vars.iter().filter(move |v| match v.section {
                Section::Output => want_output,
                Section::Input | Section::InOut => !want_output,
                _ => false,
            })
        };
        if matches!(name.key().as_str(), "EN" | "ENO") {
            self.report(
                Diagnostic::new("E0904", name.span, "EN and ENO are not supported in ST yet").help("use IF"),
            );
            return;
        }
        let what = if output { "output" } else { "input" };
        let mut d =
            Diagnostic::new("E0502", name.span, format!("{} has no {what} `{}`", pou.name.text, name.text));
        if of(!output).any(|v| v.name.text.eq_ignore_ascii_case(&name.text)) {
            d = d.help(if output { "it is an input: write `:=`" } else { "it is an output: write `=>`" });
        } else if let Some(n) = nearest(&name.key(), of(output).map(|v| v.name.text.as_str())) {
            d = d.help(format!("did you mean `{n}`?"));
        }
        self.report(d);
    }

    fn function_call(
        &mut self,
        index: u32,
        pou: &Pou,
        args: &[Arg],
        span: Span,
    ) -> Option<(Call, Option<Type>)> {
        let (inputs, outputs) = self.match_call(pou, args, span)?;
        self.body.calls.insert(index);
        let mut call_args = Vec::new();
        let mut good = true;
        for (i, v) in pou.vars.iter().enumerate() {
            if !matches!(v.section, Section::Input | Section::InOut) {
                continue;
            }
            let given = inputs.iter().find(|m| m.var == i as u32);
            let arg = match (v.section, given.and_then(|m| m.value)) {
                (Section::InOut, Some(e)) => self.reference(v, e).map(CallArg::Address),
                (_, Some(e)) => self.input(v, e),
                (Section::InOut, None) => {
                    let d = Diagnostic::new(
                        "E0507",
                        span,
                        format!("VAR_IN_OUT `{}` of {} must be given", v.name.text, pou.name.text),
                    );
                    self.report(d);
                    None
                }
                (_, None) => match (v.ty.elem(), &v.init) {
                    (Some(e), InitData::Scalar(c)) => Some(CallArg::Value(Expr::new(e, ExprKind::Const(*c)))),
                    (Some(e), _) => Some(CallArg::Value(self.default_value(e, &v.ty))),
                    (None, _) => {
                        let d = Diagnostic::new(
                            "E0507",
                            span,
                            format!("input `{}` of {} must be given", v.name.text, pou.name.text),
                        );
                        self.report(d);
                        None
                    }
                },
            };
            match arg {
                Some(a) => call_args.push(a),
                None => good = false,
            }
        }
        let outputs = self.outputs(pou, &outputs);
        let returns = pou.returns.clone();
        if !good || returns == Some(Type::Error) {
            return None;
        }
        Some((Call { pou: index, args: call_args, outputs: outputs? }, returns))
    }

    fn default_value(&self, e: ElemType, ty: &Type) -> Expr {
        let mut bytes = [0_u8; 8];
        self.tables.write_init(&mut bytes, 0, ty, &InitData::Default);
        let c = match e {
            ElemType::Real => Const::F32(0.0),
            ElemType::Lreal => Const::F64(0.0),
            _ => Const::I(crate::ir::wrap(e, i128::from(i64::from_le_bytes(bytes)))),
        };
        Expr::new(e, ExprKind::Const(c))
    }

    /// An input by value.
    fn input(&mut self, v: &Var, e: &ast::Expr) -> Option<CallArg> {
        let value = self.expr(e, v.ty.elem());
        if v.ty.elem().is_some() {
            return self
                .coerce(value, e.span, &v.ty, &format!("input `{}`", v.name.text))
                .map(CallArg::Value);
        }
        match value {
            Val::Whole(place, ty) if ty == v.ty => {
                self.take_address(&place);
                Some(CallArg::Address(place))
            }
            other => {
                self.coerce(other, e.span, &v.ty, &format!("input `{}`", v.name.text));
                None
            }
        }
    }

    /// The variable given for a VAR_IN_OUT: of exactly its type.
    fn reference(&mut self, v: &Var, e: &ast::Expr) -> Option<Place> {
        let (place, ty, access) = match self.place(e) {
            Target::Place(p, t, a) => (p, t, a),
            Target::Const(..) => {
                let d = Diagnostic::new(
                    "E0508",
                    e.span,
                    format!("VAR_IN_OUT `{}` needs a variable, not a constant", v.name.text),
                );
                self.report(d);
                return None;
            }
            Target::Error => return None,
        };
        if v.ty == Type::Error {
            return None;
        }
        if ty != v.ty {
            let (want, found) = (self.tables.type_name(&v.ty), self.tables.type_name(&ty));
            let d = Diagnostic::new(
                "E0401",
                e.span,
                format!("VAR_IN_OUT `{}`: a variable of type {want} is needed, found {found}", v.name.text),
            )
            .help("a reference converts nothing: the types must be the same");
            self.report(d);
            return None;
        }
        if let Access::ReadOnly(why) = access {
            let d = Diagnostic::new(
                "E0306",
                e.span,
                format!("cannot be given to VAR_IN_OUT `{}`: {why}", v.name.text),
            );
            self.report(d);
            return None;
        }
        if place.storage != Storage::Plain {
            let d = Diagnostic::new(
                "E0508",
                e.span,
                format!("a located bit or 32-bit TIME cannot be given to VAR_IN_OUT `{}`", v.name.text),
            )
            .help("copy it to a variable, call, and copy it back");
            self.report(d);
            return None;
        }
        let bytes = self.tables.size_of(&ty) as u32;
        self.note_located(&place, bytes, false);
        self.note_located(&place, bytes, true);
        self.take_address(&place);
        Some(place)
    }

    pub fn take_address(&mut self, place: &Place) {
        match place.base {
            Base::Var(i) => {
                self.body.in_memory.insert(i);
            }
            Base::Result => self.body.result_in_memory = true,
            _ => {}
        }
    }

    fn outputs(&mut self, pou: &Pou, given: &[Matched<'_>]) -> Option<Vec<OutputCopy>> {
        let mut out = Vec::new();
        let mut good = true;
        for m in given {
            let v = &pou.vars[m.var as usize];
            let Some(e) = m.value else { continue };
            match self.output(v, m, e) {
                Some(c) => out.push(OutputCopy { var: m.var, ..c }),
                None => good = false,
            }
        }
        good.then_some(out)
    }

    fn output(&mut self, v: &Var, m: &Matched<'_>, e: &ast::Expr) -> Option<OutputCopy> {
        let (target, ty) = self.assignable(e)?;
        let (Some(from), Some(to)) = (v.ty.elem(), ty.elem()) else {
            if v.ty != Type::Error {
                let d =
                    Diagnostic::new("E0905", m.span, "`=>` with arrays and structures is not supported yet")
                        .help("assign the member after the call");
                self.report(d);
            }
            return None;
        };
        let plain = |t: &Type| matches!(t, Type::Elem(_));
        let fits = v.ty == ty || (plain(&ty) && !matches!(v.ty, Type::Enum(_)) && widens(from, to));
        if !fits {
            let (a, b) = (self.tables.type_name(&v.ty), self.tables.type_name(&ty));
            let d = Diagnostic::new(
                "E0401",
                e.span,
                format!("output `{}` is {a} and does not fit {b}", v.name.text),
            )
            .help("assign it after the call with a conversion");
            self.report(d);
            return None;
        }
        if m.negated && from != ElemType::Bool {
            self.report(Diagnostic::new("E0402", m.span, "NOT before `=>` needs a BOOL output"));
            return None;
        }
        let convert = (from != to).then(|| match (from.is_real(), to.is_real()) {
            (false, false) => Convert::Wrap,
            (false, true) => Convert::ToFloat,
            _ => Convert::Float,
        });
        Some(OutputCopy { var: 0, offset: v.offset, ty: from, to, convert, negate: m.negated, target })
    }

    fn instance_call(&mut self, place: Place, index: u32, args: &[Arg], span: Span) -> Option<StmtKind> {
        let pou = &self.tables.pous[index as usize];
        let (inputs, outputs) = self.match_call(pou, args, span)?;
        self.body.calls.insert(index);
        self.take_address(&place);
        let mut good = true;
        for v in pou.vars.iter().filter(|v| v.section == Section::InOut) {
            if !inputs.iter().any(|m| pou.vars[m.var as usize].name == v.name) {
                let d = Diagnostic::new(
                    "E0507",
                    span,
                    format!("VAR_IN_OUT `{}` of {} must be given in every call", v.name.text, pou.name.text),
                );
                self.report(d);
                good = false;
            }
        }
        let mut stores = Vec::new();
        for m in &inputs {
            let v = &pou.vars[m.var as usize];
            let Some(e) = m.value else { continue };
            let store = if v.section == Section::InOut {
                self.reference(v, e).map(|of| FbInput::Address { offset: v.offset, of })
            } else {
                self.input(v, e).map(|a| match a {
                    CallArg::Value(value) => FbInput::Value { offset: v.offset, value },
                    CallArg::Address(from) => {
                        FbInput::Copy { offset: v.offset, from, bytes: self.tables.size_of(&v.ty) as u32 }
                    }
                })
            };
            match store {
                Some(s) => stores.push(s),
                None => good = false,
            }
        }
        let outputs = self.outputs(pou, &outputs)?;
        good.then_some(StmtKind::CallFb { pou: index, instance: place, inputs: stores, outputs })
    }

    /// The place on the left of `:=` or the right of `=>`.
    pub fn assignable(&mut self, e: &ast::Expr) -> Option<(Place, Type)> {
        match self.place(e) {
            Target::Place(place, ty, access) => {
                match access {
                    Access::ReadOnly(why) => {
                        self.report(Diagnostic::new(
                            "E0306",
                            e.span,
                            format!("this cannot be assigned: {why}"),
                        ));
                        return None;
                    }
                    Access::OwnInput => self.report(
                        Diagnostic::new("W0205", e.span, "a VAR_INPUT is assigned in its own POU")
                            .help("the standard does not allow it; copy the input to a VAR"),
                    ),
                    Access::Full => {}
                }
                let bytes = match place.storage {
                    Storage::Bit(_) => 1,
                    Storage::Millis32 => 4,
                    Storage::Plain => self.tables.size_of(&ty) as u32,
                };
                self.note_located(&place, bytes, true);
                Some((place, ty))
            }
            Target::Const(..) => {
                self.report(Diagnostic::new("E0306", e.span, "this cannot be assigned: it is a CONSTANT"));
                None
            }
            Target::Error => None,
        }
    }
}
