//! Where everything lies in linear memory, and what lies there at a cold start.

use std::collections::HashMap;

use crate::analyze::tables::{Analyzed, InitData, Pou, Tables, Var};
use crate::artifact::{Area, Layout};
use crate::diagnostic::{Diagnostic, Span};
use crate::syntax::ast::{PouKind, Section};
use crate::types::Type;
use crate::{Options, limits};

/// Addresses of a program instance's variables.
#[derive(Debug, Default)]
pub struct InstanceLayout {
    /// Start and size in DATA.
    pub offset: u32,
    pub bytes: u32,
    /// By variable; 0 where the variable has no storage here.
    pub vars: Vec<u32>,
}

/// Addresses of what a POU keeps in TEMP while it runs.
#[derive(Debug, Default, Clone)]
pub struct Frame {
    pub vars: HashMap<u32, u32>,
    /// Variables whose initial value is copied from here at entry.
    pub templates: HashMap<u32, u32>,
    pub result: Option<u32>,
}

#[derive(Debug)]
pub struct Memory {
    pub layout: Layout,
    pub globals: Vec<u32>,
    pub instances: Vec<InstanceLayout>,
    pub frames: Vec<Frame>,
    /// Constant arrays and structures: (POU, variable) -> address.
    pub constants: HashMap<(u32, u32), u32>,
    /// Initial bytes from address 0 to the end of DATA.
    pub image: Vec<u8>,
}

/// Fills one area from its start on.
struct Cursor(u64);

impl Cursor {
    fn take(&mut self, bytes: u64, align: u32) -> u32 {
        self.0 = self.0.next_multiple_of(u64::from(align.max(1)));
        let at = self.0;
        self.0 += bytes;
        // Over the limit is reported at the end; until then only the sum counts.
        u32::try_from(at).unwrap_or(u32::MAX)
    }
}

/// Lays everything out; `Err` when it does not fit.
pub fn lay_out(a: &Analyzed, options: &Options) -> Result<Memory, Box<Diagnostic>> {
    let t = &a.tables;
    let start = t.image.end;
    let mut retain = Cursor(u64::from(start));
    let mut globals = vec![0; t.globals.len()];
    let stored = |v: &Var| v.located.is_none() && (!v.constant || v.value.is_none());
    for (i, v) in t.globals.iter().enumerate().filter(|(_, v)| v.retain && stored(v)) {
        globals[i] = retain.take(t.size_of(&v.ty), t.align_of(&v.ty));
    }
    let mut instances: Vec<InstanceLayout> = Vec::new();
    for inst in &a.instances {
        let pou = &t.pous[inst.pou as usize];
        let mut vars = vec![0; pou.vars.len()];
        for (i, v) in kept(pou).filter(|(_, v)| v.retain || inst.retain) {
            vars[i] = retain.take(t.size_of(&v.ty), t.align_of(&v.ty));
        }
        instances.push(InstanceLayout { offset: 0, bytes: 0, vars });
    }
    let retain_bytes = retain.0 - u64::from(start);
    if retain_bytes > u64::from(options.retain_max) {
        let span = first_retain(a);
        let message =
            format!("RETAIN variables need {retain_bytes} bytes, {} are allowed", options.retain_max);
        let d = span.map_or_else(
            || Diagnostic::placeless("E0806", &message),
            |s| Diagnostic::new("E0806", s, &message),
        );
        return Err(Box::new(d.help("make fewer variables RETAIN")));
    }
    let mut data = Cursor(retain.0.next_multiple_of(8));
    let data_start = data.0;
    for (i, v) in t.globals.iter().enumerate().filter(|(_, v)| !v.retain && stored(v)) {
        globals[i] = data.take(t.size_of(&v.ty), t.align_of(&v.ty));
    }
    let mut constants = HashMap::new();
    for (p, pou) in t.pous.iter().enumerate() {
        for (i, v) in pou.vars.iter().enumerate() {
            if v.constant && v.value.is_none() && v.external.is_none() {
                constants.insert((p as u32, i as u32), data.take(t.size_of(&v.ty), t.align_of(&v.ty)));
            }
        }
    }
    for (inst, info) in instances.iter_mut().zip(&a.instances) {
        let pou = &t.pous[info.pou as usize];
        inst.offset = data.take(0, 8);
        for (i, v) in kept(pou).filter(|(_, v)| !v.retain && !info.retain) {
            inst.vars[i] = data.take(t.size_of(&v.ty), t.align_of(&v.ty));
        }
        // At least one byte, so that every instance has an address of its own.
        if data.0 == u64::from(inst.offset) {
            data.take(1, 1);
        }
        inst.bytes = (data.0 - u64::from(inst.offset)).min(u64::from(u32::MAX)) as u32;
    }
    let mut frames = vec![Frame::default(); t.pous.len()];
    templates(a, &mut frames, &mut data);
    let data_end = data.0.next_multiple_of(8);
    let mut temp = Cursor(data_end);
    for (p, frame) in frames.iter_mut().enumerate() {
        lay_out_frame(a, p as u32, frame, &mut temp);
    }
    let end = temp.0.next_multiple_of(8);
    if end > limits::MEMORY_BYTES {
        return Err(Box::new(
            Diagnostic::placeless(
                "E0805",
                format!("the program needs {end} bytes of memory, {} are allowed", limits::MEMORY_BYTES),
            )
            .help("make arrays smaller"),
        ));
    }
    let area = |offset: u64, end: u64| Area { offset: offset as u32, bytes: (end - offset) as u32 };
    let layout = Layout {
        input: Area { offset: t.image.input, bytes: t.image.input_bytes },
        output: Area { offset: t.image.output, bytes: t.image.output_bytes },
        marker: Area { offset: t.image.marker, bytes: t.image.marker_bytes },
        retain: area(u64::from(start), retain.0),
        data: area(data_start, data_end),
        temp: area(data_end, end),
        used_input: 0,
        used_output: 0,
        used_marker: 0,
        pages: (end.div_ceil(65_536)) as u32,
    };
    let mut m = Memory { layout, globals, instances, frames, constants, image: vec![0; data_end as usize] };
    initial_values(a, &mut m);
    Ok(m)
}

/// Variables of a program that lie in its instance.
fn kept(pou: &Pou) -> impl Iterator<Item = (usize, &Var)> {
    pou.vars.iter().enumerate().filter(|(_, v)| v.has_storage() && v.section != Section::InOut)
}

fn first_retain(a: &Analyzed) -> Option<Span> {
    let globals = a.tables.globals.iter().filter(|v| v.retain).map(|v| v.name.span);
    let locals = a.tables.pous.iter().flat_map(|p| &p.vars).filter(|v| v.retain).map(|v| v.name.span);
    let instances = a.instances.iter().filter(|i| i.retain).map(|i| a.tables.pous[i.pou as usize].name.span);
    globals.chain(locals).chain(instances).next()
}

/// Variables of a POU that live only while it runs.
fn is_temporary(kind: PouKind, v: &Var) -> bool {
    let own = v.external.is_none() && v.located.is_none() && !v.constant && v.section != Section::InOut;
    own && (kind == PouKind::Function || v.section == Section::Temp)
}

/// True when a temporary variable needs memory instead of a register.
fn needs_memory(a: &Analyzed, pou: u32, index: u32, v: &Var) -> bool {
    let taken = a.bodies[pou as usize].as_ref().is_some_and(|b| b.in_memory.contains(&index));
    v.ty.elem().is_none() || taken || v.section == Section::Output
}

fn templates(a: &Analyzed, frames: &mut [Frame], data: &mut Cursor) {
    let t = &a.tables;
    for (p, pou) in t.pous.iter().enumerate() {
        if a.bodies[p].is_none() {
            continue;
        }
        for (i, v) in pou.vars.iter().enumerate() {
            // Far over the limit, which is told at the end; each look at a large array takes time.
            if data.0 > limits::MEMORY_BYTES {
                return;
            }
            if is_temporary(pou.kind, v)
                && v.ty.elem().is_none()
                && v.section != Section::Input
                && !zero(t, &v.ty, &v.init)
            {
                frames[p].templates.insert(i as u32, data.take(t.size_of(&v.ty), t.align_of(&v.ty)));
            }
        }
    }
}

fn zero(t: &Tables, ty: &Type, init: &InitData) -> bool {
    let mut bytes = vec![0; t.size_of(ty) as usize];
    t.write_init(&mut bytes, 0, ty, init);
    bytes.iter().all(|b| *b == 0)
}

fn lay_out_frame(a: &Analyzed, p: u32, frame: &mut Frame, temp: &mut Cursor) {
    let t = &a.tables;
    let pou = &t.pous[p as usize];
    let Some(body) = &a.bodies[p as usize] else { return };
    for (i, v) in pou.vars.iter().enumerate() {
        if is_temporary(pou.kind, v) && needs_memory(a, p, i as u32, v) {
            frame.vars.insert(i as u32, temp.take(t.size_of(&v.ty), t.align_of(&v.ty)));
        }
    }
    if body.result_in_memory
        && let Some(ty) = &pou.returns
    {
        frame.result = Some(temp.take(t.size_of(ty), t.align_of(ty)));
    }
}

fn initial_values(a: &Analyzed, m: &mut Memory) {
    let t = &a.tables;
    for (v, at) in t.globals.iter().zip(&m.globals) {
        if let Some(l) = &v.located {
            write_located(t, &mut m.image, v, l);
        } else if !v.constant || v.value.is_none() {
            t.write_init(&mut m.image, *at as usize, &v.ty, &v.init);
        }
    }
    for (info, inst) in a.instances.iter().zip(&m.instances) {
        let pou = &t.pous[info.pou as usize];
        for (v, at) in pou.vars.iter().zip(&inst.vars) {
            if *at != 0 {
                t.write_init(&mut m.image, *at as usize, &v.ty, &v.init);
            }
        }
    }
    for pou in &t.pous {
        for v in &pou.vars {
            if let Some(l) = &v.located {
                write_located(t, &mut m.image, v, l);
            }
        }
    }
    for ((p, i), at) in &m.constants {
        let v = &t.pous[*p as usize].vars[*i as usize];
        t.write_init(&mut m.image, *at as usize, &v.ty, &v.init);
    }
    for (pou, frame) in t.pous.iter().zip(&m.frames) {
        for (i, at) in &frame.templates {
            let v = &pou.vars[*i as usize];
            t.write_init(&mut m.image, *at as usize, &v.ty, &v.init);
        }
    }
}

fn write_located(t: &Tables, image: &mut [u8], v: &Var, l: &crate::analyze::tables::Located) {
    use crate::artifact::Storage;
    use crate::ir::Const;
    let at = l.offset as usize;
    match (l.storage, &v.init) {
        (Storage::Plain, init) => t.write_init(image, at, &v.ty, init),
        (Storage::Bit(b), InitData::Scalar(Const::I(x))) if *x != 0 => {
            if let Some(byte) = image.get_mut(at) {
                *byte |= 1 << b;
            }
        }
        (Storage::Millis32, InitData::Scalar(Const::I(ns))) => {
            if let Some(to) = image.get_mut(at..at + 4) {
                to.copy_from_slice(&((ns / 1_000_000) as i32).to_le_bytes());
            }
        }
        _ => {}
    }
}
