//! What the compiler hands over: one WebAssembly module that carries its own debug map.
//!
//! This is the contract between the compiler and whoever runs the program (the scan engine, `trace`, the
//! verifier). The compiler writes nothing else and the engine reads nothing else.
//!
//! # Linear memory
//!
//! One memory, `min == max`, exported as `memory`:
//!
//! ```text
//! 0        SYSTEM   256 bytes, see [`sys`]
//! 256      %I       Options::input_bytes
//!          %Q       Options::output_bytes
//!          %M       Options::marker_bytes
//!          RETAIN   variables declared RETAIN
//!          DATA     globals, program and function block instances
//!          TEMP     frames of functions; not part of the state: neither hashed nor kept
//! ```
//!
//! Every area starts at a multiple of 8. Values are little-endian; BOOL is one byte 0/1, except where it lies
//! at a `%xX` address: there it is one bit. TIME is `i64` nanoseconds, except at a `%xD` address: there it is
//! 32-bit milliseconds. The module's data segments hold all initial values, so that instantiation is a cold
//! start.
//!
//! # Exports and imports
//!
//! Exports: `memory`, and one function `() -> ()` a task, named by [`Task::export`].
//! Imports, all from module `dinrail` and only those that are used: `sin cos tan asin acos atan exp ln log`
//! `(f64) -> f64`, `expt` `(f64, f64) -> f64`, the same with suffix `f` for `f32`; and in debug builds
//! `brk (i32 statement)`.
//!
//! # Faults
//!
//! A check that fails stores trap id, statement id, the instance's address and two values into
//! [`sys`]'s trap record, then executes `unreachable`.

use serde::{Deserialize, Serialize};

/// Version of the contract; an artefact of another version is refused at load.
pub const ARTIFACT_VERSION: u32 = 1;
/// Name of the wasm custom section that carries [`DebugMap`] as JSON.
pub const MAP_SECTION: &str = "dinrail.map";

/// Offsets in the SYSTEM area. The host writes the scan fields before a task and reads the trap record after.
pub mod sys {
    /// `i64` PLC time of this scan in ns: 0 at cold start, never jumps.
    pub const STAMP_NS: u32 = 0;
    /// `u64` number of this scan, from 1.
    pub const SCAN: u32 = 8;
    /// `i64` UTC of this scan in ns since 1970.
    pub const UTC_NS: u32 = 16;
    /// `u8` 1 in the first scan after a cold or warm start.
    pub const FIRST_SCAN: u32 = 24;
    /// `u8` debug builds: call `brk` before every statement while not 0.
    pub const BRK_ANY: u32 = 25;
    /// `u32` counts warnings such as MOD by zero; the host publishes the count.
    pub const WARNINGS: u32 = 28;
    /// `u32` [`super::TrapId`] as number, 0 = none.
    pub const TRAP_ID: u32 = 32;
    /// `u32` statement id, index into [`super::DebugMap::statements`].
    pub const TRAP_STATEMENT: u32 = 36;
    /// `u32` address of the function block or program instance, see [`super::DebugMap::instances`].
    pub const TRAP_INSTANCE: u32 = 40;
    /// `i64` first value of the fault: the index, the divisor's dividend, the value that does not fit.
    pub const TRAP_VALUE: u32 = 48;
    /// `f64` the REAL value that does not fit, where the fault is about a REAL.
    pub const TRAP_REAL: u32 = 56;
    /// Size of the area.
    pub const BYTES: u32 = 256;
}

/// The named run-time faults of a program.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[repr(u32)]
#[serde(rename_all = "snake_case")]
pub enum TrapId {
    /// Integer division by zero.
    DivisionByZero = 1,
    /// Array index outside its bounds.
    IndexOutOfBounds = 2,
    /// REAL or LREAL that does not fit the integer type it is converted to, or NaN.
    ConversionOutOfRange = 3,
    /// Reference that is NULL.
    NullReference = 4,
    /// Value outside the bounds of a subrange type.
    SubrangeViolation = 5,
    /// MOD by zero where the dialect asks for a fault.
    ModuloByZero = 6,
    /// FOR with BY 0.
    ForStepZero = 7,
    /// The task ran longer than its watchdog allows (set by the host, never by emitted code).
    Watchdog = 100,
    /// Any other wasm trap: a fault of the compiler, to be reported (set by the host).
    Internal = 101,
}

impl TrapId {
    /// The trap with this number, if there is one.
    pub fn from_u32(n: u32) -> Option<Self> {
        Some(match n {
            1 => Self::DivisionByZero,
            2 => Self::IndexOutOfBounds,
            3 => Self::ConversionOutOfRange,
            4 => Self::NullReference,
            5 => Self::SubrangeViolation,
            6 => Self::ModuloByZero,
            7 => Self::ForStepZero,
            100 => Self::Watchdog,
            101 => Self::Internal,
            _ => return None,
        })
    }

    /// The fault in words, as the user reads it.
    pub fn words(self) -> &'static str {
        match self {
            Self::DivisionByZero => "division by zero",
            Self::IndexOutOfBounds => "array index out of bounds",
            Self::ConversionOutOfRange => "REAL value does not fit the integer type",
            Self::NullReference => "reference is NULL",
            Self::SubrangeViolation => "value outside its subrange",
            Self::ModuloByZero => "MOD by zero",
            Self::ForStepZero => "FOR with BY 0 never ends",
            Self::Watchdog => "watchdog: the task ran too long",
            Self::Internal => "internal fault of the compiler, please report it",
        }
    }
}

/// One area of linear memory.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Area {
    /// Byte offset in linear memory.
    pub offset: u32,
    /// Size in bytes.
    pub bytes: u32,
}

/// Where everything lies.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Layout {
    pub input: Area,
    pub output: Area,
    pub marker: Area,
    pub retain: Area,
    pub data: Area,
    pub temp: Area,
    /// Bytes of %I, %Q, %M that the program uses, counted from the start of each (highest used byte + 1).
    pub used_input: u32,
    pub used_output: u32,
    pub used_marker: u32,
    /// Pages of 64 KiB of the memory.
    pub pages: u32,
}

/// Elementary types of the program's variables.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "UPPERCASE")]
pub enum ElemType {
    Bool,
    Byte,
    Word,
    Dword,
    Lword,
    Sint,
    Int,
    Dint,
    Lint,
    Usint,
    Uint,
    Udint,
    Ulint,
    Real,
    Lreal,
    Time,
}

impl ElemType {
    /// Bytes of a variable of this type that does not lie at a `%xX` or `%xD` address.
    pub const fn bytes(self) -> u32 {
        match self {
            Self::Bool | Self::Byte | Self::Sint | Self::Usint => 1,
            Self::Word | Self::Int | Self::Uint => 2,
            Self::Dword | Self::Dint | Self::Udint | Self::Real => 4,
            Self::Lword | Self::Lint | Self::Ulint | Self::Lreal | Self::Time => 8,
        }
    }
    /// The keyword.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Bool => "BOOL",
            Self::Byte => "BYTE",
            Self::Word => "WORD",
            Self::Dword => "DWORD",
            Self::Lword => "LWORD",
            Self::Sint => "SINT",
            Self::Int => "INT",
            Self::Dint => "DINT",
            Self::Lint => "LINT",
            Self::Usint => "USINT",
            Self::Uint => "UINT",
            Self::Udint => "UDINT",
            Self::Ulint => "ULINT",
            Self::Real => "REAL",
            Self::Lreal => "LREAL",
            Self::Time => "TIME",
        }
    }
}

/// How the bytes of a variable are laid down.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Storage {
    /// [`ElemType::bytes`] bytes, little-endian.
    Plain,
    /// BOOL at a `%xX` address: this bit (0-7) of the byte at `offset`.
    Bit(u8),
    /// TIME at a `%xD` address: `i32` milliseconds.
    Millis32,
}

/// In which area a variable lies.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AreaKind {
    Input,
    Output,
    Marker,
    Retain,
    Data,
}

/// The section that declared a variable.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum VarKind {
    Input,
    Output,
    InOut,
    Local,
    Global,
    /// Made from a `symbol` of the stack file, not from a declaration.
    Mapped,
}

/// A variable that the host may read, write, watch or force. Arrays are one symbol; structured instances are
/// flattened to their elementary members.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Symbol {
    /// `instance.member.member` as spelled in the declaration; looked up without regard to case.
    /// Globals have no instance: `gain`. VAR CONSTANT has no symbol.
    pub path: String,
    #[serde(rename = "type")]
    pub elem: ElemType,
    /// Byte offset in linear memory.
    pub offset: u32,
    pub storage: Storage,
    /// Bounds of each dimension, outermost first; empty for a scalar. Elements lie row by row,
    /// [`ElemType::bytes`] apart.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub dims: Vec<(i64, i64)>,
    pub area: AreaKind,
    pub kind: VarKind,
    pub retain: bool,
    /// `%`-address as written in the source, if located.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub address: Option<String>,
    /// Index into [`DebugMap::enumerations`] of a variable whose values have names.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub enumeration: Option<u32>,
    /// Place of the declaration: index into [`DebugMap::files`], line and column from 1.
    pub file: u32,
    pub line: u32,
    pub column: u32,
}

impl Symbol {
    /// Number of elements: 1 for a scalar.
    pub fn elements(&self) -> u64 {
        self.dims.iter().map(|(lo, hi)| (hi - lo + 1).max(0) as u64).product()
    }
}

/// An enumeration of the program.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Enumeration {
    pub name: String,
    /// Names with their values, in the order of the declaration.
    pub values: Vec<(String, i64)>,
}

/// A task of the resource. Which tasks are due is decided by the host from the stamp and this table alone.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Task {
    pub name: String,
    /// Name of the wasm export that runs all programs of the task once.
    pub export: String,
    /// 0 is the highest.
    pub priority: u32,
    /// Period, or `None` for a task that runs once a scan of the engine's base cycle.
    pub interval_ns: Option<u64>,
    /// Path of the BOOL whose rising edge runs the task (`SINGLE`).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub single: Option<String>,
    /// Instance paths, in the order they run.
    pub programs: Vec<String>,
}

/// A place in a source file, lines and columns from 1, `end` exclusive.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Place {
    /// Index into [`DebugMap::files`].
    pub file: u32,
    pub line: u32,
    pub column: u32,
    pub end_line: u32,
    pub end_column: u32,
    /// Index into [`DebugMap::pous`].
    pub pou: u32,
}

/// A program or function block instance.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Instance {
    pub path: String,
    /// Name of the PROGRAM or FUNCTION_BLOCK.
    #[serde(rename = "type")]
    pub type_name: String,
    /// Byte offset in linear memory.
    pub offset: u32,
    pub bytes: u32,
}

/// The statements of one wasm function, for finding the place of a trap the host caused (watchdog).
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct FunctionLines {
    /// Index in the module's function index space (imports counted).
    pub function: u32,
    /// Name of the POU.
    pub pou: String,
    /// `(byte offset from the start of the function's body as wasm_encoder counts it, statement id)`, rising.
    pub lines: Vec<(u32, u32)>,
}

/// A range of bytes of %I, %Q or %M with the place that uses it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Access {
    pub area: AreaKind,
    /// First byte, counted from the start of the area.
    pub byte: u32,
    pub bytes: u32,
    /// Bit, when only one bit is meant.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub bit: Option<u8>,
    /// Statement id.
    pub statement: u32,
}

/// Everything the host must know about the module.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DebugMap {
    /// [`ARTIFACT_VERSION`].
    pub version: u32,
    pub layout: Layout,
    pub tasks: Vec<Task>,
    pub symbols: Vec<Symbol>,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub enumerations: Vec<Enumeration>,
    pub instances: Vec<Instance>,
    /// File names as given to the compiler.
    pub files: Vec<String>,
    /// POU names.
    pub pous: Vec<String>,
    /// Statement id -> place; id 0 is a placeholder for "unknown".
    pub statements: Vec<Place>,
    pub functions: Vec<FunctionLines>,
    /// Located bytes that the program assigns (for `check`: two owners of one range).
    pub writes: Vec<Access>,
    /// Located bytes that the program reads.
    pub reads: Vec<Access>,
    /// Bound of the wasm stack in frames, from the call graph (recursion is rejected).
    pub call_depth: u32,
    /// True when hooks are compiled in.
    pub debug: bool,
}

impl DebugMap {
    /// The symbol with this path, without regard to case; a suffix is enough (`x` for `prg.x`) if it is unique
    /// among the symbols with the fewest parts, so `x` is the program's `x` even where a block in it has one too.
    pub fn symbol(&self, path: &str) -> Option<&Symbol> {
        if let Some(found) = self.symbols.iter().find(|s| s.path.eq_ignore_ascii_case(path)) {
            return Some(found);
        }
        let matches = |s: &&Symbol| {
            let tail =
                s.path.len().checked_sub(path.len()).and_then(|at| at.checked_sub(1).map(|dot| (dot, at)));
            tail.is_some_and(|(dot, at)| {
                s.path.is_char_boundary(dot)
                    && s.path.is_char_boundary(at)
                    && s.path.as_bytes()[dot] == b'.'
                    && s.path[at..].eq_ignore_ascii_case(path)
            })
        };
        let parts = |s: &&Symbol| s.path.matches('.').count();
        let fewest = self.symbols.iter().filter(matches).map(|s| parts(&s)).min()?;
        let mut found = self.symbols.iter().filter(matches).filter(|s| parts(s) == fewest);
        let first = found.next()?;
        found.next().is_none().then_some(first)
    }

    /// The instance whose bytes contain this address; the innermost one.
    pub fn instance_at(&self, offset: u32) -> Option<&Instance> {
        self.instances
            .iter()
            .filter(|i| offset >= i.offset && offset < i.offset + i.bytes.max(1))
            .min_by_key(|i| i.bytes)
    }

    /// `file:line:column` of a statement.
    pub fn place_text(&self, statement: u32) -> String {
        match self.statements.get(statement as usize) {
            Some(p) if statement != 0 => {
                let file = self.files.get(p.file as usize).map_or("?", String::as_str);
                format!("{file}:{}:{}", p.line, p.column)
            }
            _ => "unknown place".to_owned(),
        }
    }
}

/// A compiled program.
#[derive(Debug, Clone, PartialEq)]
pub struct Artifact {
    /// The module, [`MAP_SECTION`] included. This is the file that is deployed.
    pub wasm: Vec<u8>,
    pub map: DebugMap,
}

impl Artifact {
    /// Hash that names the program everywhere: XXH3-64 of [`Self::wasm`].
    pub fn hash(&self) -> u64 {
        xxhash_rust::xxh3::xxh3_64(&self.wasm)
    }
}
