//! IR to a WebAssembly module with its debug map.

mod access;
mod code;
mod convert;
mod expr;
mod layout;
mod map;
mod op;
mod stmt;

use std::borrow::Cow;
use std::collections::{BTreeSet, HashMap};

use wasm_encoder::{
    CodeSection, ConstExpr, CustomSection, DataSection, EntityType, ExportKind, ExportSection,
    FunctionSection, ImportSection, MemorySection, MemoryType, Module, NameMap, NameSection, TypeSection,
    ValType,
};

use crate::analyze::tables::Analyzed;
use crate::artifact::{Artifact, ElemType, FunctionLines, MAP_SECTION};
use crate::diagnostic::{Diagnostic, Span};
use crate::ir::{self, MathFn};
use crate::syntax::ast::PouKind;
use crate::types::ElemExt;
use crate::{Options, Source, limits};
use code::Code;
use layout::Memory;

/// What code refers to by number.
pub(crate) struct Indices {
    /// Imported mathematics: (function, LREAL).
    math: HashMap<(MathFn, bool), u32>,
    brk: Option<u32>,
    trap: u32,
    /// Functions and function blocks by POU.
    pous: HashMap<u32, u32>,
}

/// Value type of an elementary type.
pub(crate) fn val_type(e: ElemType) -> ValType {
    match e {
        ElemType::Real => ValType::F32,
        ElemType::Lreal => ValType::F64,
        e if e.is_wide() => ValType::I64,
        _ => ValType::I32,
    }
}

/// Function types by content.
#[derive(Default)]
struct Types {
    section: TypeSection,
    known: HashMap<(Vec<ValType>, Vec<ValType>), u32>,
}

impl Types {
    fn get(&mut self, params: Vec<ValType>, results: Vec<ValType>) -> u32 {
        let next = self.known.len() as u32;
        let section = &mut self.section;
        *self.known.entry((params.clone(), results.clone())).or_insert_with(|| {
            section.ty().function(params, results);
            next
        })
    }
}

/// Makes the module.
pub fn emit(
    a: &Analyzed,
    statements: &[Span],
    sources: &[Source],
    options: &Options,
) -> Result<Artifact, Box<Diagnostic>> {
    let memory = layout::lay_out(a, options)?;
    let reached = reachable(a);
    let mut types = Types::default();
    let mut imports = ImportSection::new();
    let mut functions = FunctionSection::new();
    let mut names = NameMap::new();
    let mut next = 0_u32;

    let mut math = HashMap::new();
    for (f, wide) in used_math(a, &reached) {
        let v = if wide { ValType::F64 } else { ValType::F32 };
        let ty = types.get(vec![v; f.arity()], vec![v]);
        let name = format!("{}{}", f.name(), if wide { "" } else { "f" });
        imports.import("dinrail", &name, EntityType::Function(ty));
        names.append(next, &name);
        math.insert((f, wide), next);
        next += 1;
    }
    let mut brk = None;
    if options.debug {
        let ty = types.get(vec![ValType::I32], vec![]);
        imports.import("dinrail", "brk", EntityType::Function(ty));
        names.append(next, "brk");
        brk = Some(next);
        next += 1;
    }
    let mut define = |ty: u32, name: &str| {
        functions.function(ty);
        names.append(next, name);
        next += 1;
        next - 1
    };
    let trap_type =
        types.get(vec![ValType::I32, ValType::I32, ValType::I32, ValType::I64, ValType::F64], vec![]);
    let trap = define(trap_type, "trap");
    let mut pous = HashMap::new();
    for p in &reached {
        let pou = &a.tables.pous[*p as usize];
        let ty = match pou.kind {
            PouKind::Program => continue,
            PouKind::FunctionBlock => types.get(vec![ValType::I32], vec![]),
            PouKind::Function => {
                let params = code::params(pou);
                let results = pou.returns.iter().filter_map(|t| t.elem()).map(val_type).collect();
                types.get(params, results)
            }
        };
        pous.insert(*p, define(ty, &pou.name.text));
    }
    let plain = types.get(vec![], vec![]);
    let instances: Vec<u32> = a.instances.iter().map(|i| define(plain, &i.name)).collect();
    let tasks: Vec<u32> = a.tasks.iter().map(|t| define(plain, &format!("task {}", t.name))).collect();
    let indices = Indices { math, brk, trap, pous };

    let mut code = CodeSection::new();
    let mut lines: Vec<FunctionLines> = Vec::new();
    code.function(&code::trap_function());
    for p in &reached {
        let pou = &a.tables.pous[*p as usize];
        let (Some(index), Some(body)) = (indices.pous.get(p), &a.bodies[*p as usize]) else { continue };
        let (function, marks) = Code::new(a, &memory, &indices, options, *p, None).function(body)?;
        code.function(&function);
        lines.push(FunctionLines { function: *index, pou: pou.name.text.clone(), lines: marks });
    }
    for (i, inst) in a.instances.iter().enumerate() {
        let pou = &a.tables.pous[inst.pou as usize];
        let empty = ir::Body::default();
        let body = a.bodies[inst.pou as usize].as_ref().unwrap_or(&empty);
        let (function, marks) = Code::new(a, &memory, &indices, options, inst.pou, Some(i)).function(body)?;
        code.function(&function);
        lines.push(FunctionLines { function: instances[i], pou: pou.name.text.clone(), lines: marks });
    }
    for t in &a.tasks {
        let calls: Vec<u32> = t.programs.iter().map(|p| instances[*p as usize]).collect();
        code.function(&code::task_function(&calls));
    }

    let map = map::build(a, &memory, &reached, statements, sources, options, lines)?;
    let mut memories = MemorySection::new();
    let pages = u64::from(memory.layout.pages);
    memories.memory(MemoryType {
        minimum: pages,
        maximum: Some(pages),
        memory64: false,
        shared: false,
        page_size_log2: None,
    });
    let mut exports = ExportSection::new();
    exports.export("memory", ExportKind::Memory, 0);
    for (t, index) in map.tasks.iter().zip(&tasks) {
        exports.export(&t.export, ExportKind::Func, *index);
    }
    let json = serde_json::to_vec(&map)
        .map_err(|e| Box::new(Diagnostic::placeless("E0901", format!("debug map: {e}"))))?;
    let mut name_section = NameSection::new();
    name_section.functions(&names);

    let mut module = Module::new();
    module.section(&types.section);
    if !imports.is_empty() {
        module.section(&imports);
    }
    module.section(&functions).section(&memories).section(&exports).section(&code);
    let data = data_segments(&memory);
    if !data.is_empty() {
        module.section(&data);
    }
    module.section(&name_section);
    module.section(&CustomSection { name: Cow::Borrowed(MAP_SECTION), data: Cow::Owned(json) });
    Ok(Artifact { wasm: module.finish(), map })
}

/// POUs that run: the instances' programs and all they call.
fn reachable(a: &Analyzed) -> Vec<u32> {
    let mut seen: BTreeSet<u32> = BTreeSet::new();
    let mut open: Vec<u32> = a.instances.iter().map(|i| i.pou).collect();
    while let Some(p) = open.pop() {
        if seen.insert(p) {
            open.extend(a.bodies[p as usize].iter().flat_map(|b| b.calls.iter().copied()));
        }
    }
    seen.into_iter().collect()
}

/// Imported functions in a fixed order.
fn used_math(a: &Analyzed, reached: &[u32]) -> BTreeSet<(MathFn, bool)> {
    let mut used = BTreeSet::new();
    for body in reached.iter().filter_map(|p| a.bodies[*p as usize].as_ref()) {
        for s in &body.stmts {
            op::visit_statement(s, &mut |e| {
                if let ir::ExprKind::Math(f, _) = &e.kind {
                    used.insert((*f, e.ty == ElemType::Lreal));
                }
            });
        }
    }
    used
}

/// Runs of bytes that are not zero; short gaps are bridged, and all of them when there are too many runs.
fn data_segments(memory: &Memory) -> DataSection {
    const GAP: usize = 16;
    let mut section = DataSection::new();
    let image = &memory.image;
    let mut at = 0;
    while let Some(start) = image[at..].iter().position(|b| *b != 0).map(|p| p + at) {
        let mut end = start + 1;
        if section.len() as usize >= limits::DATA_RUNS {
            end = image.iter().rposition(|b| *b != 0).map_or(end, |p| p + 1);
        }
        while let Some(next) = image[end..].iter().take(GAP + 1).position(|b| *b != 0) {
            end += next + 1;
        }
        section.active(0, &ConstExpr::i32_const(start as i32), image[start..end].iter().copied());
        at = end;
    }
    section
}
