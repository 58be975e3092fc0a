//! Names, types, constants: from the syntax tree to IR.
//!
//! All of a program is looked at even when parts are wrong, so that one run shows all errors. What was reported
//! once is marked ([`crate::types::Type::Error`]) and not reported again.

mod builtins;
mod calls;
mod calls_scan;
mod check;
mod config;
mod conversions;
mod declare;
mod expr;
mod globals;
mod init;
mod operators;
mod place;
mod range;
mod recursion;
mod resolve;
mod stmt;
pub mod tables;

use std::collections::HashMap;

use crate::artifact::sys;
use crate::diagnostic::{Diagnostic, Span};
use crate::syntax::ast;
use crate::{Options, limits};
use tables::{Analyzed, ImageLayout, Tables};

/// Checks the units of a compilation; `library` is the index of the standard library's unit.
pub fn analyze(
    units: &[ast::Unit],
    library: usize,
    options: &Options,
    syntax_errors: bool,
) -> (Option<Analyzed>, Vec<Diagnostic>) {
    let mut diags = Vec::new();
    let image = match image_layout(options) {
        Ok(i) => i,
        Err(d) => return (None, vec![*d]),
    };
    let mut tables = Tables {
        image,
        addressing: options.addressing,
        types: HashMap::new(),
        structs: Vec::new(),
        enums: Vec::new(),
        enum_values: HashMap::new(),
        globals: Vec::new(),
        globals_by_name: HashMap::new(),
        pous: Vec::new(),
        pous_by_name: HashMap::new(),
    };
    let decls = declare::declare(units, library, options, &mut tables, &mut diags);
    let mut bodies = Vec::with_capacity(decls.len());
    for (index, decl) in decls.iter().enumerate() {
        // The library's own bodies are compiled only where they are used, below.
        if tables.pous[index].library {
            bodies.push(None);
        } else {
            bodies.push(Some(stmt::check_body(&tables, index as u32, decl, options, &mut diags)));
        }
    }
    let mut wanted: Vec<u32> = bodies.iter().flatten().flat_map(|b| b.calls.iter().copied()).collect();
    while let Some(pou) = wanted.pop() {
        let slot = pou as usize;
        if bodies.get(slot).is_some_and(Option::is_none) {
            let body = stmt::check_body(&tables, pou, decls[slot], options, &mut diags);
            wanted.extend(body.calls.iter().copied());
            bodies[slot] = Some(body);
        }
    }
    // Whatever is not compiled is refused, even if no reason was found.
    let dropped = bodies.iter().flatten().find_map(|b| b.dropped);
    if let (Some(span), false) = (dropped, syntax_errors || diags.iter().any(|d| d.code.starts_with('E'))) {
        diags.push(Diagnostic::new("E0901", span, "a statement was not compiled and no reason was given"));
    }
    let call_depth = recursion::check(&tables, &bodies, &mut diags);
    let (tasks, instances) = config::configure(units, &tables, options, syntax_errors, &mut diags);
    (Some(Analyzed { tables, bodies, tasks, instances, call_depth }), diags)
}

fn image_layout(options: &Options) -> Result<ImageLayout, Box<Diagnostic>> {
    for (name, bytes) in
        [("%I", options.input_bytes), ("%Q", options.output_bytes), ("%M", options.marker_bytes)]
    {
        if bytes > limits::IMAGE_BYTES {
            return Err(Box::new(Diagnostic::placeless(
                "E0804",
                format!(
                    "{name} of {bytes} bytes: an area of the image has at most {} bytes",
                    limits::IMAGE_BYTES
                ),
            )));
        }
    }
    let up = |n: u32| n.next_multiple_of(8);
    let input = sys::BYTES;
    let output = input + up(options.input_bytes);
    let marker = output + up(options.output_bytes);
    Ok(ImageLayout {
        input,
        input_bytes: options.input_bytes,
        output,
        output_bytes: options.output_bytes,
        marker,
        marker_bytes: options.marker_bytes,
        end: marker + up(options.marker_bytes),
    })
}

/// Types in types, over the limit.
pub(crate) fn too_deep(span: Span) -> Diagnostic {
    Diagnostic::new("E0801", span, format!("types are nested more than {} deep", limits::INSTANCE_DEPTH))
}

/// A name that is taken, for the message of the second declaration.
pub(crate) fn duplicate(name: &str, first: Span, second: Span) -> Diagnostic {
    Diagnostic::new("E0301", second, format!("`{name}` is declared twice"))
        .label("second declaration")
        .also(first, "first declaration")
        .help("names differ in more than case; rename one of them")
}
