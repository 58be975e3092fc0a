//! Whether statements may change a variable: a look at the syntax alone, erring on the safe side.

use super::tables::{Pou, Tables};
use crate::syntax::ast::{Arg, Expr, ExprKind, PouKind, Section, Stmt, StmtKind};
use crate::types::Type;

/// The variable that is asked for, and what names in the statements mean.
pub struct Scan<'a> {
    pub name: &'a str,
    pub tables: &'a Tables,
    pub pou: Option<&'a Pou>,
}

impl Scan<'_> {
    /// True when `body` may assign the variable: as a target, as a FOR variable, or by handing it to a call that
    /// takes a reference or gives an output.
    pub fn changes(&self, body: &[Stmt]) -> bool {
        body.iter().any(|s| self.statement(s))
    }

    fn statement(&self, s: &Stmt) -> bool {
        match &s.kind {
            StmtKind::Assign { target, value } => self.root(target) || self.expr(target) || self.expr(value),
            StmtKind::Call(e) => self.expr(e),
            StmtKind::If { branches, otherwise } => {
                branches.iter().any(|b| self.expr(&b.cond) || self.changes(&b.body))
                    || self.changes(otherwise)
            }
            StmtKind::Case { selector, arms, otherwise } => {
                self.expr(selector) || arms.iter().any(|a| self.changes(&a.body)) || self.changes(otherwise)
            }
            StmtKind::For { var, from, to, by, body } => {
                self.root(var)
                    || self.expr(from)
                    || self.expr(to)
                    || by.as_ref().is_some_and(|e| self.expr(e))
                    || self.changes(body)
            }
            StmtKind::While { cond, body } => self.expr(cond) || self.changes(body),
            StmtKind::Repeat { body, until, .. } => self.changes(body) || self.expr(until),
            StmtKind::Exit | StmtKind::Continue | StmtKind::Return | StmtKind::Empty => false,
        }
    }

    /// The variable at the root of a path is the one.
    fn root(&self, e: &Expr) -> bool {
        match &e.kind {
            ExprKind::Name(n) => n.text.eq_ignore_ascii_case(self.name),
            ExprKind::Field(base, _) | ExprKind::Index(base, _) => self.root(base),
            _ => false,
        }
    }

    /// A call inside hands the variable over.
    fn expr(&self, e: &Expr) -> bool {
        match &e.kind {
            ExprKind::Call(callee, args) => {
                self.expr(callee) || (0..args.len()).any(|i| self.arg(callee, args, i))
            }
            ExprKind::Field(base, _) => self.expr(base),
            ExprKind::Index(base, subscripts) => self.expr(base) || subscripts.iter().any(|s| self.expr(s)),
            ExprKind::Unary(_, a) => self.expr(a),
            ExprKind::Binary(..) => {
                // Down the left spine in a loop: it may be long.
                let mut e = e;
                while let ExprKind::Binary(_, a, b, _) = &e.kind {
                    if self.expr(b) {
                        return true;
                    }
                    e = a;
                }
                self.expr(e)
            }
            _ => false,
        }
    }

    fn arg(&self, callee: &Expr, args: &[Arg], index: usize) -> bool {
        let Some(value) = &args[index].value else { return false };
        self.expr(value) || (self.root(value) && !self.by_value(callee, args, index))
    }

    /// True when the callee only gets the value of this argument.
    fn by_value(&self, callee: &Expr, args: &[Arg], index: usize) -> bool {
        let Some(pou) = self.callee(callee) else {
            return matches!(&callee.kind, ExprKind::Name(n) if super::builtins::is_builtin(&n.key()));
        };
        let arg = &args[index];
        let section = match &arg.name {
            _ if arg.output => return false,
            Some(name) => pou.by_name.get(&name.key()).map(|i| pou.vars[*i as usize].section),
            None => {
                let before = args[..index].iter().filter(|a| a.name.is_none()).count();
                let mut inputs = pou
                    .vars
                    .iter()
                    .map(|v| v.section)
                    .filter(|s| matches!(s, Section::Input | Section::InOut));
                inputs.nth(before)
            }
        };
        section == Some(Section::Input)
    }

    /// The function or function block that is called.
    fn callee(&self, callee: &Expr) -> Option<&Pou> {
        let index = match (self.type_of(callee), &callee.kind) {
            (Some(Type::Fb(p)), _) => p,
            (_, ExprKind::Name(n)) => *self.tables.pous_by_name.get(&n.key())?,
            _ => return None,
        };
        self.tables.pous.get(index as usize).filter(|p| p.kind != PouKind::Program)
    }

    /// Type of a variable's path; `None` where it is wrong, which others report.
    fn type_of(&self, e: &Expr) -> Option<Type> {
        match &e.kind {
            ExprKind::Name(n) => {
                let key = n.key();
                let own = self.pou.and_then(|p| p.by_name.get(&key).map(|i| p.vars[*i as usize].ty.clone()));
                let global =
                    || self.tables.globals_by_name.get(&key).map(|g| &self.tables.globals[*g as usize]);
                own.or_else(|| global().map(|g| g.ty.clone()))
            }
            ExprKind::Field(base, field) => match self.type_of(base)? {
                Type::Struct(s) => {
                    let fields = &self.tables.structs.get(s as usize)?.fields;
                    fields
                        .iter()
                        .find(|f| f.name.text.eq_ignore_ascii_case(&field.text))
                        .map(|f| f.ty.clone())
                }
                Type::Fb(p) => {
                    let p = self.tables.pous.get(p as usize)?;
                    p.by_name.get(&field.key()).map(|i| p.vars[*i as usize].ty.clone())
                }
                _ => None,
            },
            ExprKind::Index(base, subscripts) => {
                let (mut ty, mut left) = (self.type_of(base)?, subscripts.len());
                while left > 0 {
                    let Type::Array(a) = &ty else { return None };
                    left = left.checked_sub(a.dims.len())?;
                    ty = a.of.clone();
                }
                Some(ty)
            }
            _ => None,
        }
    }
}
