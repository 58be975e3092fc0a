//! Walks over IR.

use crate::ir::{Call, CallArg, Expr, ExprKind, FbInput, OutputCopy, Place, Step, Stmt, StmtKind};

/// Calls `f` for every expression in a statement, inner ones too.
pub fn visit_statement(s: &Stmt, f: &mut impl FnMut(&Expr)) {
    let all = |list: &[Stmt], f: &mut _| {
        for s in list {
            visit_statement(s, f);
        }
    };
    match &s.kind {
        StmtKind::Store { place, value } => {
            visit_place(place, f);
            visit(value, f);
        }
        StmtKind::SetTemp { value, .. } | StmtKind::Eval(value) => visit(value, f),
        StmtKind::Copy { to, from, .. } => {
            visit_place(to, f);
            visit_place(from, f);
        }
        StmtKind::CallVoid(call) => visit_call(call, f),
        StmtKind::CallFb { instance, inputs, outputs, .. } => {
            visit_place(instance, f);
            for i in inputs {
                match i {
                    FbInput::Value { value, .. } => visit(value, f),
                    FbInput::Copy { from: p, .. } | FbInput::Address { of: p, .. } => visit_place(p, f),
                }
            }
            visit_outputs(outputs, f);
        }
        StmtKind::If { branches, otherwise } => {
            for (_, cond, body) in branches {
                visit(cond, f);
                all(body, f);
            }
            all(otherwise, f);
        }
        StmtKind::Case { selector, arms, otherwise } => {
            visit(selector, f);
            for (_, body) in arms {
                all(body, f);
            }
            all(otherwise, f);
        }
        StmtKind::For(l) => {
            visit_place(&l.var, f);
            visit(&l.from, f);
            visit(&l.to, f);
            if let Step::Dynamic(e) = &l.step {
                visit(e, f);
            }
            all(&l.body, f);
        }
        StmtKind::While { cond, body } => {
            visit(cond, f);
            all(body, f);
        }
        StmtKind::Repeat { body, until, .. } => {
            all(body, f);
            visit(until, f);
        }
        StmtKind::Exit | StmtKind::Continue | StmtKind::Return | StmtKind::Nop => {}
    }
}

fn visit_place(p: &Place, f: &mut impl FnMut(&Expr)) {
    for t in p.index.iter().flat_map(|i| &i.terms) {
        visit(&t.value, f);
    }
}

fn visit_outputs(outputs: &[OutputCopy], f: &mut impl FnMut(&Expr)) {
    for o in outputs {
        visit_place(&o.target, f);
    }
}

fn visit_call(call: &Call, f: &mut impl FnMut(&Expr)) {
    for a in &call.args {
        match a {
            CallArg::Value(e) => visit(e, f),
            CallArg::Address(p) => visit_place(p, f),
        }
    }
    visit_outputs(&call.outputs, f);
}

fn visit(e: &Expr, f: &mut impl FnMut(&Expr)) {
    f(e);
    match &e.kind {
        ExprKind::Const(_) | ExprKind::Temp(_) | ExprKind::Now => {}
        ExprKind::Load(p) => visit_place(p, f),
        ExprKind::Unary(_, a) | ExprKind::Convert(_, a) | ExprKind::InRange { value: a, .. } => visit(a, f),
        ExprKind::Binary(_, a, b) | ExprKind::ShortCircuit { left: a, right: b, .. } => {
            visit(a, f);
            visit(b, f);
        }
        ExprKind::Select(a, b, c) => {
            visit(a, f);
            visit(b, f);
            visit(c, f);
        }
        ExprKind::Mux(k, items) => {
            visit(k, f);
            for i in items {
                visit(i, f);
            }
        }
        ExprKind::Call(call) => visit_call(call, f),
        ExprKind::Math(_, args) => {
            for a in args {
                visit(a, f);
            }
        }
    }
}
