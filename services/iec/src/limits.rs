//! The limits of the compiler: what a program may ask for before it is refused with a diagnostic (`E08xx`).
//!
//! They keep every stage bounded on hostile input and are far above what a controller program needs.

/// Bytes of one source file.
pub const SOURCE_BYTES: usize = 1024 * 1024;
/// Source files of one compilation.
pub const SOURCES: usize = 1024;
/// Nesting of expressions and statements (parentheses, operators, IF in IF ...).
pub const NESTING: u32 = 64;
/// Depth of nested block comments.
pub const COMMENT_NESTING: u32 = 64;
/// Characters of an identifier.
pub const IDENT_CHARS: usize = 128;
/// Statements of all sources together; and of all program instances together.
pub const STATEMENTS: usize = 500_000;
/// Operators of one expression, parentheses and arguments included.
pub const OPERATORS: usize = 1000;
/// Parameters of one call, values of one enumeration.
pub const CHAIN: usize = 4096;
/// Variables of one POU.
pub const VARIABLES: usize = 16_384;
/// Symbols of the debug map (instances flattened).
pub const SYMBOLS: usize = 262_144;
/// Nesting of function block instances, structures and arrays in each other.
pub const INSTANCE_DEPTH: u32 = 64;
/// Members of one structure.
pub const MEMBERS: usize = 4096;
/// Longest chain of calls.
pub const CALL_DEPTH: u32 = 128;
/// Errors of all files after which no further body is looked at.
pub const ERRORS: usize = 1000;
/// Inputs of one function; what every WebAssembly engine takes.
pub const PARAMETERS: usize = 1000;
/// Registers of one POU: inputs, variables of functions, loops, intermediate values; as above.
pub const REGISTERS: usize = 50_000;
/// Bytes of code of one POU; as above.
pub const POU_CODE_BYTES: usize = 7_654_321;
/// Runs of initial values that lie apart from each other; beyond, what lies between them is stored too.
pub const DATA_RUNS: usize = 10_000;
/// Elements of one array.
pub const ARRAY_ELEMENTS: i128 = 4 * 1024 * 1024;
/// Dimensions of one array.
pub const ARRAY_DIMS: usize = 6;
/// Bytes of linear memory, everything together.
pub const MEMORY_BYTES: u64 = 16 * 1024 * 1024;
/// Bytes of %I, of %Q and of %M.
pub const IMAGE_BYTES: u32 = 64 * 1024;
/// Errors after which a file's remaining errors are left out.
pub const ERRORS_PER_FILE: usize = 100;
/// Labels of one CASE statement, a range counts once.
pub const CASE_LABELS: usize = 4096;
/// Tasks of a configuration.
pub const TASKS: usize = 64;
/// Lowest task interval in ns.
pub const TASK_INTERVAL_MIN_NS: i64 = 1_000;
