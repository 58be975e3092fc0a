//! IEC 61131-3 compiler: sources to WebAssembly and a debug map.
//!
//! Text in, one module out: no file, clock, process or network is touched, so that the same compiler serves the
//! engine, the command line, the verifier and, later, a browser.
//!
//! Stages, one module each: [`lexer`] (text to tokens), [`syntax`] (tokens to tree), [`analyze`] (names, types,
//! constants; tree to IR), [`ir`] (small, typed, ignorant of wasm), [`wasm`] (IR to module and debug map).
//! Other languages join at the syntax tree.

// Tables of keywords and types read better without the prefix.
#![allow(clippy::enum_glob_use)]

pub mod artifact;

mod address;
pub mod analyze;
pub mod codes;
mod container;
mod diagnostic;
pub mod ir;
pub mod lexer;
pub mod limits;
pub mod stdlib;
pub mod syntax;
pub mod types;
pub mod wasm;

pub use address::{AddressError, AddressSize, Addressing, LocatedAddress, parse_address};
pub use artifact::Artifact;
pub use container::ArtifactError;
pub use diagnostic::{Diagnostic, Diagnostics, Label, Severity, Span};

/// One source file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Source {
    /// Name as it is to appear in messages and in the debug map.
    pub name: String,
    pub text: String,
}

/// A VAR_GLOBAL that the stack file makes (`symbol = "..."`).
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ExternalSymbol {
    pub name: String,
    /// `%IB0`.
    pub address: String,
    /// Keyword of an elementary type: `BOOL`, `UINT` ...
    pub type_name: String,
    /// Where it is declared, for messages: `stack.toml:12`.
    pub origin: String,
}

/// What REAL to integer does when the value does not fit.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum RealToInt {
    /// Named run-time fault.
    #[default]
    Fault,
    /// Nearest value of the integer type; NaN gives 0.
    Clamp,
}

/// What MOD by zero does.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum ModByZero {
    /// Gives 0 (the standard's definition) and counts a warning.
    #[default]
    Zero,
    /// Named run-time fault.
    Fault,
}

/// How to compile.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Options {
    pub addressing: Addressing,
    /// Bytes of %I, at most 65536.
    pub input_bytes: u32,
    /// Bytes of %Q, at most 65536.
    pub output_bytes: u32,
    /// Bytes of %M, at most 65536.
    pub marker_bytes: u32,
    /// Most bytes of RETAIN variables.
    pub retain_max: u32,
    /// Interval of the one implicit task in ns (`cycle` of the stack file). An error if the sources declare a TASK.
    pub implicit_cycle_ns: Option<u64>,
    pub externals: Vec<ExternalSymbol>,
    /// Compile breakpoint hooks in.
    pub debug: bool,
    pub real_to_int: RealToInt,
    pub mod_by_zero: ModByZero,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            addressing: Addressing::Element,
            input_bytes: 4096,
            output_bytes: 4096,
            marker_bytes: 4096,
            retain_max: 65_536,
            implicit_cycle_ns: None,
            externals: Vec::new(),
            debug: false,
            real_to_int: RealToInt::Fault,
            mod_by_zero: ModByZero::Zero,
        }
    }
}

/// A program that compiled.
#[derive(Debug, Clone, PartialEq)]
pub struct Compiled {
    pub artifact: Artifact,
    /// Render with [`Compiled::render_warnings`].
    pub warnings: Vec<Diagnostic>,
}

impl Compiled {
    /// The warnings as text; `sources` as given to [`compile`].
    pub fn render_warnings(&self, sources: &[Source], color: bool) -> String {
        Diagnostics::new(sources, self.warnings.clone()).render(color)
    }
}

/// Compiles all sources as one program.
///
/// On failure: all errors and warnings found. Never panics, whatever the text.
pub fn compile(sources: &[Source], options: &Options) -> Result<Compiled, Diagnostics> {
    if let Err(d) = check_sources(sources) {
        return Err(Diagnostics::new(sources, vec![*d]));
    }
    let mut statements = syntax::StatementTable::default();
    let mut units = Vec::with_capacity(sources.len() + 1);
    let mut diags = Vec::new();
    for (i, s) in sources.iter().enumerate() {
        let (unit, mut found) = syntax::parse(i as u32, &s.text, &mut statements);
        units.push(unit);
        diags.append(&mut found);
    }
    let library = units.len();
    let (unit, mut found) = syntax::parse_library(library as u32, &mut statements);
    units.push(unit);
    diags.append(&mut found);
    let syntax_errors = diags.iter().any(|d| d.severity == Severity::Error);
    let (analyzed, mut found) = analyze::analyze(&units, library, options, syntax_errors);
    diags.append(&mut found);
    if let (Some(a), true) = (analyzed, diags.iter().all(|d| d.severity == Severity::Warning)) {
        match wasm::emit(&a, &statements.spans, sources, options) {
            Ok(artifact) => {
                let warnings = Diagnostics::new(sources, diags).items().to_vec();
                return Ok(Compiled { artifact, warnings });
            }
            Err(d) => diags.push(*d),
        }
    }
    Err(Diagnostics::new(sources, diags))
}

fn check_sources(sources: &[Source]) -> Result<(), Box<Diagnostic>> {
    if sources.is_empty() || sources.len() > limits::SOURCES {
        let d = Diagnostic::placeless("E0807", format!("{} source files given", sources.len()));
        return Err(Box::new(d.help(format!("give 1 to {} files", limits::SOURCES))));
    }
    match sources.iter().find(|s| s.text.len() > limits::SOURCE_BYTES) {
        Some(s) => Err(Box::new(
            Diagnostic::placeless(
                "E0807",
                format!(
                    "{}: file of {} bytes, at most {} are allowed",
                    s.name,
                    s.text.len(),
                    limits::SOURCE_BYTES
                ),
            )
            .help("split the program into several files"),
        )),
        None => Ok(()),
    }
}
