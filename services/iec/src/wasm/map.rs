//! The debug map.

use super::layout::Memory;
use crate::analyze::tables::{Analyzed, Located, Var};
use crate::artifact::{
    ARTIFACT_VERSION, Access, AreaKind, DebugMap, ElemType, Enumeration, FunctionLines, Instance, Place,
    Storage, Symbol, Task, VarKind,
};
use crate::diagnostic::{Diagnostic, Span};
use crate::syntax::ast::Section;
use crate::types::{ArrayType, Type};
use crate::{Options, Source, limits, stdlib};

/// Makes the map.
pub fn build(
    a: &Analyzed,
    memory: &Memory,
    reached: &[u32],
    statements: &[Span],
    sources: &[Source],
    options: &Options,
    functions: Vec<FunctionLines>,
) -> Result<DebugMap, Box<Diagnostic>> {
    let mut places = Places::new(sources);
    let mut b = Builder {
        a,
        memory,
        symbols: Vec::new(),
        instances: Vec::new(),
        used: [0; 3],
        places: &mut places,
        full: false,
    };
    b.globals();
    b.programs();
    if b.full {
        return Err(Box::new(
            Diagnostic::placeless("E0803", format!("the program has more than {} symbols", limits::SYMBOLS))
                .help("use arrays instead of many instances"),
        ));
    }
    let (mut reads, mut writes) = (Vec::new(), Vec::new());
    for p in reached {
        b.accesses(*p, &mut reads, &mut writes);
    }
    let (symbols, instances, used) = (b.symbols, b.instances, b.used);
    let mut layout = memory.layout;
    layout.used_input = used[0].max(high(&reads, &writes, AreaKind::Input));
    layout.used_output = used[1].max(high(&reads, &writes, AreaKind::Output));
    layout.used_marker = used[2].max(high(&reads, &writes, AreaKind::Marker));
    let mut files: Vec<String> = sources.iter().map(|s| s.name.clone()).collect();
    files.push(stdlib::NAME.to_owned());
    Ok(DebugMap {
        version: ARTIFACT_VERSION,
        layout,
        tasks: tasks(a),
        symbols,
        enumerations: enumerations(a),
        instances,
        files,
        pous: a.tables.pous.iter().map(|p| p.name.text.clone()).collect(),
        statements: statement_places(a, statements, &mut places),
        functions,
        writes,
        reads,
        call_depth: a.call_depth,
        debug: options.debug,
    })
}

fn enumerations(a: &Analyzed) -> Vec<Enumeration> {
    let named = |values: &[(crate::syntax::ast::Ident, i64)]| {
        values.iter().map(|(name, value)| (name.text.clone(), *value)).collect()
    };
    a.tables.enums.iter().map(|e| Enumeration { name: e.name.clone(), values: named(&e.values) }).collect()
}

fn high(reads: &[Access], writes: &[Access], area: AreaKind) -> u32 {
    reads.iter().chain(writes).filter(|x| x.area == area).map(|x| x.byte + x.bytes).max().unwrap_or(0)
}

fn tasks(a: &Analyzed) -> Vec<Task> {
    a.tasks
        .iter()
        .map(|t| Task {
            name: t.name.clone(),
            export: format!("task.{}", t.name),
            priority: t.priority,
            interval_ns: t.interval_ns,
            single: t.single.clone(),
            programs: t.programs.iter().map(|p| a.instances[*p as usize].name.clone()).collect(),
        })
        .collect()
}

fn statement_places(a: &Analyzed, statements: &[Span], places: &mut Places) -> Vec<Place> {
    let mut pou_of = vec![0_u32; statements.len()];
    for (i, p) in a.tables.pous.iter().enumerate() {
        for id in p.stmts.0..p.stmts.1.min(statements.len() as u32) {
            pou_of[id as usize] = i as u32;
        }
    }
    statements.iter().zip(pou_of).map(|(span, pou)| places.place(*span, pou)).collect()
}

/// Byte offsets to lines and columns.
struct Places {
    /// By file: starts of the lines, and whether the text is ASCII only.
    files: Vec<(Vec<u32>, Option<String>)>,
}

impl Places {
    fn new(sources: &[Source]) -> Self {
        let texts = sources.iter().map(|s| s.text.as_str()).chain([stdlib::PRELUDE]);
        let files = texts
            .map(|t| {
                let mut starts = vec![0];
                starts.extend(t.bytes().enumerate().filter(|(_, b)| *b == b'\n').map(|(i, _)| i as u32 + 1));
                (starts, (!t.is_ascii()).then(|| t.to_owned()))
            })
            .collect();
        Self { files }
    }

    /// Line and column from 1; columns count characters.
    fn line_column(&self, file: u32, at: u32) -> (u32, u32) {
        let Some((starts, text)) = self.files.get(file as usize) else { return (0, 0) };
        let line = starts.partition_point(|s| *s <= at).max(1);
        let start = starts[line - 1];
        let column = match text {
            None => at.saturating_sub(start),
            Some(t) => t.get(start as usize..at as usize).map_or(0, |s| s.chars().count() as u32),
        };
        (line as u32, column + 1)
    }

    fn place(&self, span: Span, pou: u32) -> Place {
        let (line, column) = self.line_column(span.file, span.start);
        let (end_line, end_column) = self.line_column(span.file, span.end);
        Place { file: span.file, line, column, end_line, end_column, pou }
    }
}

struct Builder<'a> {
    a: &'a Analyzed,
    memory: &'a Memory,
    symbols: Vec<Symbol>,
    instances: Vec<Instance>,
    /// Highest used byte + 1 of %I, %Q, %M.
    used: [u32; 3],
    places: &'a mut Places,
    full: bool,
}

/// What a variable hands down to its members.
#[derive(Clone, Copy)]
struct Context<'v> {
    kind: VarKind,
    retain: bool,
    span: Span,
    mapped: bool,
    located: Option<&'v Located>,
    enumeration: Option<u32>,
}

impl Builder<'_> {
    fn globals(&mut self) {
        let a = self.a;
        for (v, at) in a.tables.globals.iter().zip(&self.memory.globals) {
            if v.constant {
                continue;
            }
            let kind = if v.mapped.is_some() { VarKind::Mapped } else { VarKind::Global };
            let cx = Context {
                kind,
                retain: v.retain,
                span: v.name.span,
                mapped: v.mapped.is_some(),
                located: v.located.as_ref(),
                enumeration: None,
            };
            self.variable(&v.name.text, &v.ty, *at, cx);
        }
    }

    fn programs(&mut self) {
        let a = self.a;
        for (info, inst) in a.instances.iter().zip(&self.memory.instances) {
            let pou = &a.tables.pous[info.pou as usize];
            self.instances.push(Instance {
                path: info.name.clone(),
                type_name: pou.name.text.clone(),
                offset: inst.offset,
                bytes: inst.bytes,
            });
            for (v, at) in pou.vars.iter().zip(&inst.vars) {
                if let Some((kind, located)) = visible(v) {
                    let cx = Context {
                        kind,
                        retain: v.retain || info.retain,
                        span: v.name.span,
                        mapped: false,
                        located,
                        enumeration: None,
                    };
                    self.variable(&format!("{}.{}", info.name, v.name.text), &v.ty, *at, cx);
                }
            }
        }
    }

    fn variable(&mut self, path: &str, ty: &Type, at: u32, cx: Context<'_>) {
        if self.symbols.len() + self.instances.len() > limits::SYMBOLS {
            self.full = true;
            return;
        }
        let at = cx.located.map_or(at, |l| l.offset);
        match ty {
            Type::Error => {}
            Type::Elem(_) | Type::Subrange(_) | Type::Enum(_) => {
                if let Some(e) = ty.elem() {
                    let cx = Context { enumeration: enumeration_of(ty), ..cx };
                    self.symbol(path, e, at, Vec::new(), cx);
                }
            }
            Type::Array(array) => self.array(path, array, at, cx),
            Type::Struct(s) => {
                let a = self.a;
                for f in &a.tables.structs[*s as usize].fields {
                    self.variable(&format!("{path}.{}", f.name.text), &f.ty, at + f.offset, cx);
                }
            }
            Type::Fb(p) => {
                let a = self.a;
                let pou = &a.tables.pous[*p as usize];
                self.instances.push(Instance {
                    path: path.to_owned(),
                    type_name: pou.name.text.clone(),
                    offset: at,
                    bytes: pou.bytes,
                });
                for v in &pou.vars {
                    if let Some((kind, located)) = visible(v) {
                        let inner = Context { kind, span: v.name.span, located, ..cx };
                        self.variable(&format!("{path}.{}", v.name.text), &v.ty, at + v.offset, inner);
                    }
                }
            }
        }
    }

    fn array(&mut self, path: &str, array: &ArrayType, at: u32, cx: Context<'_>) {
        // Arrays of arrays of elementary types are one symbol with all dimensions.
        let mut dims = array.dims.clone();
        let mut of = &array.of;
        while let Type::Array(inner) = of {
            dims.extend(&inner.dims);
            of = &inner.of;
        }
        if let Some(e) = of.elem() {
            let cx = Context { enumeration: enumeration_of(of), ..cx };
            self.symbol(path, e, at, dims, cx);
            return;
        }
        let size = self.a.tables.size_of(of) as u32;
        let count: i64 = dims.iter().map(|(lo, hi)| hi - lo + 1).product();
        for n in 0..count {
            if self.full {
                return;
            }
            let mut rest = n;
            let mut subscripts: Vec<String> = Vec::new();
            for (lo, hi) in dims.iter().rev() {
                let width = hi - lo + 1;
                subscripts.push((lo + rest % width).to_string());
                rest /= width;
            }
            subscripts.reverse();
            let inner = Context { located: None, ..cx };
            self.variable(&format!("{path}[{}]", subscripts.join(",")), of, at + n as u32 * size, inner);
        }
    }

    fn symbol(&mut self, path: &str, elem: ElemType, offset: u32, dims: Vec<(i64, i64)>, cx: Context<'_>) {
        let l = &self.memory.layout;
        let area = match cx.located {
            Some(located) => {
                let count: i64 = dims.iter().map(|(lo, hi)| hi - lo + 1).product();
                let bytes = match located.storage {
                    Storage::Bit(_) => 1,
                    Storage::Millis32 => 4,
                    Storage::Plain => elem.bytes() * count as u32,
                };
                let slot = match located.address.area {
                    AreaKind::Input => 0,
                    AreaKind::Output => 1,
                    _ => 2,
                };
                self.used[slot] = self.used[slot].max(located.address.byte + bytes);
                located.address.area
            }
            None if offset >= l.retain.offset && offset < l.retain.offset + l.retain.bytes => {
                AreaKind::Retain
            }
            None => AreaKind::Data,
        };
        let (line, column) =
            if cx.mapped { (0, 0) } else { self.places.line_column(cx.span.file, cx.span.start) };
        self.symbols.push(Symbol {
            path: path.to_owned(),
            elem,
            offset,
            storage: cx.located.map_or(Storage::Plain, |l| l.storage),
            dims,
            area,
            kind: cx.kind,
            retain: cx.retain,
            address: cx.located.map(|l| l.text.clone()),
            enumeration: cx.enumeration,
            file: cx.span.file,
            line,
            column,
        });
    }

    fn accesses(&mut self, pou: u32, reads: &mut Vec<Access>, writes: &mut Vec<Access>) {
        let image = &self.a.tables.image;
        let Some(body) = &self.a.bodies[pou as usize] else { return };
        for u in &body.located {
            let (area, start) = if u.address < image.output {
                (AreaKind::Input, image.input)
            } else if u.address < image.marker {
                (AreaKind::Output, image.output)
            } else {
                (AreaKind::Marker, image.marker)
            };
            let access =
                Access { area, byte: u.address - start, bytes: u.bytes, bit: u.bit, statement: u.statement };
            let list = if u.write { &mut *writes } else { &mut *reads };
            if list.last() != Some(&access) {
                list.push(access);
            }
        }
    }
}

fn enumeration_of(ty: &Type) -> Option<u32> {
    match ty {
        Type::Enum(index) => Some(*index),
        _ => None,
    }
}

/// Kind and place of a variable that has a symbol.
fn visible(v: &Var) -> Option<(VarKind, Option<&Located>)> {
    if v.constant || v.external.is_some() {
        return None;
    }
    let kind = match v.section {
        Section::Input => VarKind::Input,
        Section::Output => VarKind::Output,
        Section::Var => VarKind::Local,
        Section::InOut | Section::Temp | Section::External | Section::Global => return None,
    };
    Some((kind, v.located.as_ref()))
}
