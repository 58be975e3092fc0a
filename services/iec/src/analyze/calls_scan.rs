//! Whether statements may change a variable: a look at the syntax alone, erring on the safe side.

use crate::syntax::ast::{Arg, Expr, ExprKind, Stmt, StmtKind};

/// True when `body` may assign the variable `name`: as a target, as a FOR variable, or by handing it to a call.
pub fn changes(body: &[Stmt], name: &str) -> bool {
    body.iter().any(|s| statement(s, name))
}

fn statement(s: &Stmt, name: &str) -> bool {
    match &s.kind {
        StmtKind::Assign { target, value } => root(target, name) || expr(target, name) || expr(value, name),
        StmtKind::Call(e) => expr(e, name),
        StmtKind::If { branches, otherwise } => {
            branches.iter().any(|b| expr(&b.cond, name) || changes(&b.body, name)) || changes(otherwise, name)
        }
        StmtKind::Case { selector, arms, otherwise } => {
            expr(selector, name) || arms.iter().any(|a| changes(&a.body, name)) || changes(otherwise, name)
        }
        StmtKind::For { var, from, to, by, body } => {
            root(var, name)
                || expr(from, name)
                || expr(to, name)
                || by.as_ref().is_some_and(|e| expr(e, name))
                || changes(body, name)
        }
        StmtKind::While { cond, body } => expr(cond, name) || changes(body, name),
        StmtKind::Repeat { body, until, .. } => changes(body, name) || expr(until, name),
        StmtKind::Exit | StmtKind::Continue | StmtKind::Return | StmtKind::Empty => false,
    }
}

/// The variable at the root of a path is `name`.
fn root(e: &Expr, name: &str) -> bool {
    match &e.kind {
        ExprKind::Name(n) => n.text.eq_ignore_ascii_case(name),
        ExprKind::Field(base, _) | ExprKind::Index(base, _) => root(base, name),
        _ => false,
    }
}

/// A call inside hands the variable over.
fn expr(e: &Expr, name: &str) -> bool {
    match &e.kind {
        ExprKind::Call(callee, args) => {
            let harmless = matches!(&callee.kind, ExprKind::Name(n) if super::builtins::is_builtin(&n.key()));
            expr(callee, name) || args.iter().any(|a| arg(a, name, harmless))
        }
        ExprKind::Field(base, _) => expr(base, name),
        ExprKind::Index(base, subscripts) => expr(base, name) || subscripts.iter().any(|s| expr(s, name)),
        ExprKind::Unary(_, a) => expr(a, name),
        ExprKind::Binary(..) => {
            // Down the left spine in a loop: it may be long.
            let mut e = e;
            while let ExprKind::Binary(_, a, b, _) = &e.kind {
                if expr(b, name) {
                    return true;
                }
                e = a;
            }
            expr(e, name)
        }
        _ => false,
    }
}

fn arg(a: &Arg, name: &str, harmless: bool) -> bool {
    a.value.as_ref().is_some_and(|v| (!harmless && root(v, name)) || expr(v, name))
}
