//! CONFIGURATION: tasks and program instances.

use std::collections::HashMap;

use super::check::{Checker, Val};
use super::tables::{InstanceInfo, Tables, TaskInfo};
use crate::artifact::ElemType;
use crate::diagnostic::{Diagnostic, Span};
use crate::syntax::ast::{self, Expr, ExprKind, PouKind, Resource, TaskDecl};
use crate::types::{ElemExt, Type};
use crate::{Options, limits};

/// Name of the task that runs what no TASK runs.
const IMPLICIT: &str = "main";
/// Priority of programs without a task when there are tasks: behind all others.
const LOWEST: u32 = 65_535;

/// The tasks with their programs, and the program instances.
pub fn configure(
    units: &[ast::Unit],
    tables: &Tables,
    options: &Options,
    syntax_errors: bool,
    diags: &mut Vec<Diagnostic>,
) -> (Vec<TaskInfo>, Vec<InstanceInfo>) {
    let resources: Vec<&Resource> =
        units.iter().flat_map(|u| &u.configurations).flat_map(|c| &c.resources).collect();
    if let [first, second, ..] = resources.as_slice() {
        let d = Diagnostic::new("E0701", second.name.span, "more than one RESOURCE")
            .also(first.name.span, "the first one")
            .help("run each resource as a plc service of its own");
        diags.push(d);
    }
    match resources.first() {
        Some(r) => Config { tables, options, syntax_errors, diags }.resource(r),
        None => implicit(units, tables, options, syntax_errors, diags),
    }
}

/// One instance of each program, all in one task.
fn implicit(
    units: &[ast::Unit],
    tables: &Tables,
    options: &Options,
    syntax_errors: bool,
    diags: &mut Vec<Diagnostic>,
) -> (Vec<TaskInfo>, Vec<InstanceInfo>) {
    let mut instances = Vec::new();
    for (i, p) in tables.pous.iter().enumerate() {
        if p.kind == PouKind::Program {
            instances.push(InstanceInfo { name: p.name.text.clone(), pou: i as u32, retain: false });
        }
    }
    if instances.is_empty() && !syntax_errors && diags.iter().all(|d| d.code.starts_with('W')) {
        let d = match units.iter().flat_map(|u| &u.configurations).next() {
            Some(c) => {
                Diagnostic::new("E0702", c.name.span, "the CONFIGURATION has no RESOURCE with a PROGRAM")
            }
            None => Diagnostic::placeless("E0702", "there is no PROGRAM in the sources"),
        };
        diags.push(d.help("add PROGRAM name ... END_PROGRAM"));
    }
    let programs = (0..instances.len() as u32).collect();
    let interval_ns = options.implicit_cycle_ns;
    let task = TaskInfo { name: IMPLICIT.to_owned(), priority: 0, interval_ns, single: None, programs };
    (vec![task], instances)
}

struct Config<'a> {
    tables: &'a Tables,
    options: &'a Options,
    /// A file could not be read whole: what seems to be missing may stand there.
    syntax_errors: bool,
    diags: &'a mut Vec<Diagnostic>,
}

impl Config<'_> {
    fn resource(&mut self, r: &Resource) -> (Vec<TaskInfo>, Vec<InstanceInfo>) {
        let mut tasks: Vec<TaskInfo> = Vec::new();
        let mut names: HashMap<String, Span> = HashMap::new();
        for t in &r.tasks {
            if let Some(first) = names.get(&t.name.key()) {
                self.diags.push(super::duplicate(&t.name.text, *first, t.name.span));
                continue;
            }
            names.insert(t.name.key(), t.name.span);
            if let Some(ns) = self.options.implicit_cycle_ns {
                let d = Diagnostic::new(
                    "E0703",
                    t.name.span,
                    format!(
                        "the sources declare a TASK and the stack file gives `cycle` ({} ms)",
                        ns as f64 / 1e6
                    ),
                )
                .help("remove one of the two: `cycle` makes the task of programs that have none");
                self.diags.push(d);
            }
            if tasks.len() >= limits::TASKS {
                self.diags.push(Diagnostic::new(
                    "E0803",
                    t.name.span,
                    format!("more than {} tasks", limits::TASKS),
                ));
                break;
            }
            tasks.push(self.task(t));
        }
        let mut instances: Vec<InstanceInfo> = Vec::new();
        let mut statements = 0;
        let mut instance_names: HashMap<String, Span> = HashMap::new();
        for p in &r.programs {
            if let Some(first) = instance_names.get(&p.name.key()) {
                self.diags.push(super::duplicate(&p.name.text, *first, p.name.span));
                continue;
            }
            instance_names.insert(p.name.key(), p.name.span);
            if let Some(&g) = self.tables.globals_by_name.get(&p.name.key()) {
                let first = self.tables.globals[g as usize].name.span;
                self.diags.push(super::duplicate(&p.name.text, first, p.name.span));
                continue;
            }
            if let Some(span) = p.args {
                let d =
                    Diagnostic::new("E0905", span, "parameters of program instances are not supported yet")
                        .help("use located or global variables");
                self.diags.push(d);
            }
            let Some(pou) = self.program(&p.type_name) else { continue };
            let (from, to) = self.tables.pous[pou as usize].stmts;
            statements += (to - from).max(1) as usize;
            if statements > limits::STATEMENTS {
                let text = format!("the program instances have more than {} statements", limits::STATEMENTS);
                let d = Diagnostic::new("E0803", p.name.span, text)
                    .help("every instance has code of its own: put it into a FUNCTION_BLOCK");
                self.diags.push(d);
                break;
            }
            let index = instances.len() as u32;
            instances.push(InstanceInfo { name: p.name.text.clone(), pou, retain: p.retain.is_some() });
            self.attach(&mut tasks, p, index);
        }
        if instances.is_empty() && !self.syntax_errors && self.diags.iter().all(|d| d.code.starts_with('W')) {
            let d =
                Diagnostic::new("E0702", r.name.span, format!("RESOURCE {} runs no PROGRAM", r.name.text))
                    .help("add PROGRAM instance WITH task : type;");
            self.diags.push(d);
        }
        self.unused(&instances);
        (tasks, instances)
    }

    fn program(&mut self, name: &ast::Ident) -> Option<u32> {
        let found = self.tables.pous_by_name.get(&name.key()).copied();
        if let Some(i) = found.filter(|i| self.tables.pous[*i as usize].kind == PouKind::Program) {
            return Some(i);
        }
        let programs =
            self.tables.pous.iter().filter(|p| p.kind == PouKind::Program).map(|p| p.name.text.as_str());
        let near = super::resolve::nearest(&name.key(), programs);
        let mut d = Diagnostic::new("E0704", name.span, format!("there is no PROGRAM `{}`", name.text));
        if let Some(n) = near {
            d = d.help(format!("did you mean `{n}`?"));
        }
        self.diags.push(d);
        None
    }

    fn attach(&mut self, tasks: &mut Vec<TaskInfo>, p: &ast::ProgramDecl, index: u32) {
        let Some(name) = &p.task else {
            // Programs without a task run every scan, behind all tasks.
            match tasks.iter_mut().find(|t| t.name == IMPLICIT) {
                Some(t) => t.programs.push(index),
                None => {
                    let only = tasks.is_empty();
                    tasks.push(TaskInfo {
                        name: IMPLICIT.to_owned(),
                        priority: if only { 0 } else { LOWEST },
                        interval_ns: self.options.implicit_cycle_ns,
                        single: None,
                        programs: vec![index],
                    });
                }
            }
            return;
        };
        match tasks.iter_mut().find(|t| t.name.eq_ignore_ascii_case(&name.text)) {
            Some(t) => t.programs.push(index),
            None => {
                let near = super::resolve::nearest(&name.key(), tasks.iter().map(|t| t.name.as_str()));
                let mut d = Diagnostic::new("E0704", name.span, format!("there is no TASK `{}`", name.text));
                if let Some(n) = near {
                    d = d.help(format!("did you mean `{n}`?"));
                }
                self.diags.push(d);
            }
        }
    }

    fn task(&mut self, t: &TaskDecl) -> TaskInfo {
        let mut task = TaskInfo {
            name: t.name.text.clone(),
            priority: 0,
            interval_ns: None,
            single: None,
            programs: Vec::new(),
        };
        let mut seen: Vec<String> = Vec::new();
        for (name, value) in &t.params {
            let key = name.key();
            if seen.contains(&key) {
                self.diags.push(Diagnostic::new(
                    "E0503",
                    name.span,
                    format!("`{}` is given twice", name.text),
                ));
                continue;
            }
            match key.as_str() {
                "INTERVAL" => task.interval_ns = self.interval(value),
                "PRIORITY" => task.priority = self.priority(value).unwrap_or(0),
                "SINGLE" => task.single = self.single(value),
                _ => self.diags.push(
                    Diagnostic::new("E0502", name.span, format!("a TASK has no parameter `{}`", name.text))
                        .help("it has INTERVAL, PRIORITY and SINGLE"),
                ),
            }
            seen.push(key);
        }
        task
    }

    fn value(&mut self, e: &Expr, want: Option<ElemType>) -> Val {
        let mut ck = Checker::new(self.tables, None, self.options);
        ck.constant_only = true;
        let v = ck.expr(e, want);
        self.diags.append(&mut ck.diags);
        v
    }

    fn interval(&mut self, e: &Expr) -> Option<u64> {
        let v = self.value(e, None);
        let ns = match &v {
            Val::Expr(x, Type::Elem(ElemType::Time)) => x.as_int(),
            Val::Error => return None,
            _ => None,
        };
        match ns {
            Some(ns) if ns >= limits::TASK_INTERVAL_MIN_NS => Some(ns as u64),
            // The standard lets INTERVAL 0 mean "none".
            Some(0) => None,
            Some(_) => {
                self.diags.push(Diagnostic::new("E0705", e.span, "INTERVAL must be at least 1 us"));
                None
            }
            None => {
                self.diags.push(
                    Diagnostic::new("E0705", e.span, "INTERVAL must be a constant duration")
                        .help("write INTERVAL := T#10ms"),
                );
                None
            }
        }
    }

    fn priority(&mut self, e: &Expr) -> Option<u32> {
        let n = match self.value(e, None) {
            Val::Int(n) => Some(n),
            Val::Expr(x, _) if x.ty.is_int() => x.as_int().map(i128::from),
            Val::Error => return None,
            _ => None,
        };
        let found = n.and_then(|n| u32::try_from(n).ok()).filter(|n| *n <= LOWEST);
        if found.is_none() {
            self.diags.push(Diagnostic::new(
                "E0705",
                e.span,
                format!("PRIORITY must be a constant from 0 (highest) to {LOWEST}"),
            ));
        }
        found
    }

    /// SINGLE names a global BOOL.
    fn single(&mut self, e: &Expr) -> Option<String> {
        let global = match &e.kind {
            ExprKind::Name(n) => {
                self.tables.globals_by_name.get(&n.key()).map(|g| &self.tables.globals[*g as usize])
            }
            _ => None,
        };
        match global {
            Some(g) if g.ty == Type::Elem(ElemType::Bool) && !g.constant => Some(g.name.text.clone()),
            _ => {
                self.diags.push(
                    Diagnostic::new("E0705", e.span, "SINGLE must be the name of a global BOOL variable")
                        .help("declare VAR_GLOBAL start AT %IX0.0 : BOOL; END_VAR and write SINGLE := start"),
                );
                None
            }
        }
    }

    fn unused(&mut self, instances: &[InstanceInfo]) {
        for (i, p) in self.tables.pous.iter().enumerate() {
            if p.kind == PouKind::Program && !instances.iter().any(|x| x.pou == i as u32) {
                let d =
                    Diagnostic::new("W0207", p.name.span, format!("PROGRAM {} is never run", p.name.text))
                        .help("add an instance to the RESOURCE");
                self.diags.push(d);
            }
        }
    }
}
