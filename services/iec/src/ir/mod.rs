//! The intermediate representation: typed, structured, ignorant of the syntax it came from and of wasm.
//!
//! Every [`Expr`] has an elementary type; every conversion is explicit; every check that can fail at run time is a
//! node or a flag. Values of types narrower than 32 bits are kept in their range after every operation.

mod fold;

pub use fold::{convert_const, fold, value, wrap};

use crate::artifact::{ElemType, Storage, TrapId};

/// A constant. Integers, bit strings, BOOL and TIME are `I`; ULINT and LWORD as the bits of an `i64`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Const {
    I(i64),
    F32(f32),
    F64(f64),
}

#[derive(Debug, Clone, PartialEq)]
pub struct Expr {
    pub ty: ElemType,
    pub kind: ExprKind,
}

#[derive(Debug, Clone, PartialEq)]
pub enum ExprKind {
    Const(Const),
    Load(Place),
    /// A counter or scratch value that lives in a register only; never a declared variable.
    Temp(u32),
    Unary(UnOp, Box<Expr>),
    /// Both sides have the same type, except for shifts, whose right side is DINT or wider.
    Binary(BinOp, Box<Expr>, Box<Expr>),
    Convert(Convert, Box<Expr>),
    /// `if cond { then } else { otherwise }`; both are evaluated.
    Select(Box<Expr>, Box<Expr>, Box<Expr>),
    /// Only the chosen item counts; all are evaluated. Out of range is a fault.
    Mux(Box<Expr>, Vec<Expr>),
    /// AND_THEN, OR_ELSE: the right side only if needed.
    ShortCircuit {
        and: bool,
        left: Box<Expr>,
        right: Box<Expr>,
    },
    Call(Box<Call>),
    /// An imported function of the host's pinned mathematics library.
    Math(MathFn, Vec<Expr>),
    /// The scan's stamp.
    Now,
    /// A subrange check: fault if the value is outside.
    InRange {
        value: Box<Expr>,
        lo: i64,
        hi: i64,
    },
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum UnOp {
    /// Wraps.
    Neg,
    Not,
    /// Wraps for the least value.
    Abs,
    Sqrt,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum BinOp {
    Add,
    Sub,
    Mul,
    /// Toward zero; integer division by zero is a fault.
    Div,
    /// Sign of the dividend; see [`crate::ModByZero`].
    Mod,
    And,
    Or,
    Xor,
    Eq,
    Ne,
    Lt,
    Le,
    Gt,
    Ge,
    Min,
    Max,
    /// By the width or more (a negative count too): 0.
    Shl,
    Shr,
    /// Modulo the width.
    Rol,
    Ror,
}

impl BinOp {
    pub fn is_comparison(self) -> bool {
        matches!(self, Self::Eq | Self::Ne | Self::Lt | Self::Le | Self::Gt | Self::Ge)
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Convert {
    /// Integer, bit string, BOOL or TIME to the like: sign or zero extension, or the low bits.
    Wrap,
    /// Anything to BOOL: not zero.
    NotZero,
    /// Integer or bit string to REAL or LREAL, nearest.
    ToFloat,
    /// REAL <-> LREAL.
    Float,
    /// REAL or LREAL to integer or bit string, half to even; does not fit: see [`crate::RealToInt`].
    Round,
    /// The same, toward zero.
    Trunc,
    /// DWORD <-> REAL, LWORD <-> LREAL: the bits.
    Bits,
}

/// Functions the host provides.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum MathFn {
    Sin,
    Cos,
    Tan,
    Asin,
    Acos,
    Atan,
    Exp,
    Ln,
    Log,
    Expt,
}

impl MathFn {
    /// Name of the import for LREAL; REAL has the suffix `f`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Sin => "sin",
            Self::Cos => "cos",
            Self::Tan => "tan",
            Self::Asin => "asin",
            Self::Acos => "acos",
            Self::Atan => "atan",
            Self::Exp => "exp",
            Self::Ln => "ln",
            Self::Log => "log",
            Self::Expt => "expt",
        }
    }
    pub fn arity(self) -> usize {
        if self == Self::Expt { 2 } else { 1 }
    }
}

/// Where a place starts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Base {
    /// Variable of the POU's own instance (program or function block), or a local of a function.
    Var(u32),
    /// What a VAR_IN_OUT variable of the POU refers to.
    Ref(u32),
    /// A global variable that is not located.
    Global(u32),
    /// A fixed address in linear memory: located variables.
    Abs(u32),
    /// The result variable of a function.
    Result,
}

/// A place in memory: `base + offset + index`.
#[derive(Debug, Clone, PartialEq)]
pub struct Place {
    pub base: Base,
    pub offset: u32,
    pub storage: Storage,
    /// Byte offset that is known at run time only; a DINT that was checked.
    pub index: Option<Box<Index>>,
}

/// Sum of checked subscripts, each times its stride.
#[derive(Debug, Clone, PartialEq)]
pub struct Index {
    pub terms: Vec<IndexTerm>,
}

#[derive(Debug, Clone, PartialEq)]
pub struct IndexTerm {
    pub value: Expr,
    pub lo: i64,
    pub hi: i64,
    pub stride: u32,
    /// False when the value is known to lie in the bounds.
    pub check: bool,
    /// The value is known not to be negative.
    pub nonneg: bool,
}

/// A function call.
#[derive(Debug, Clone, PartialEq)]
pub struct Call {
    /// Index of the POU.
    pub pou: u32,
    pub args: Vec<CallArg>,
    /// VAR_OUTPUT variables to be copied after the call: index of the variable, and where to, with a conversion.
    pub outputs: Vec<OutputCopy>,
}

#[derive(Debug, Clone, PartialEq)]
pub enum CallArg {
    Value(Expr),
    /// Address of a variable: VAR_IN_OUT, and arrays and structures given by value (the callee copies).
    Address(Place),
}

/// After a call: variable `var` of the callee goes to `target`.
#[derive(Debug, Clone, PartialEq)]
pub struct OutputCopy {
    pub var: u32,
    /// Offset in the instance (function blocks).
    pub offset: u32,
    pub ty: ElemType,
    pub to: ElemType,
    pub convert: Option<Convert>,
    pub negate: bool,
    pub target: Place,
}

#[derive(Debug, Clone, PartialEq)]
pub struct Stmt {
    /// Statement id of the debug map.
    pub id: u32,
    pub kind: StmtKind,
}

#[derive(Debug, Clone, PartialEq)]
pub enum StmtKind {
    Store {
        place: Place,
        value: Expr,
    },
    SetTemp {
        temp: u32,
        value: Expr,
    },
    /// Whole arrays and structures.
    Copy {
        to: Place,
        from: Place,
        bytes: u32,
    },
    /// Value not used.
    Eval(Expr),
    /// Function without result.
    CallVoid(Call),
    CallFb {
        pou: u32,
        instance: Place,
        inputs: Vec<FbInput>,
        outputs: Vec<OutputCopy>,
    },
    If {
        branches: Vec<(u32, Expr, Vec<Stmt>)>,
        otherwise: Vec<Stmt>,
    },
    Case {
        selector: Expr,
        arms: Vec<CaseArm>,
        otherwise: Vec<Stmt>,
    },
    For(Box<For>),
    While {
        cond: Expr,
        body: Vec<Stmt>,
    },
    Repeat {
        body: Vec<Stmt>,
        until: Expr,
        until_id: u32,
    },
    Exit,
    Continue,
    Return,
    /// Only a breakpoint's place.
    Nop,
}

/// Labels of a CASE arm, and its statements.
pub type CaseArm = (Vec<(i64, i64)>, Vec<Stmt>);

#[derive(Debug, Clone, PartialEq)]
pub enum FbInput {
    Value {
        offset: u32,
        value: Expr,
    },
    Copy {
        offset: u32,
        from: Place,
        bytes: u32,
    },
    /// VAR_IN_OUT: the address goes into the hidden slot at `offset`.
    Address {
        offset: u32,
        of: Place,
    },
}

#[derive(Debug, Clone, PartialEq)]
pub struct For {
    pub ty: ElemType,
    pub var: Place,
    /// The counter lives in this temporary and is written to `var` before each run of the body; `None` when the
    /// body may change the variable, which then rules.
    pub counter: Option<u32>,
    pub from: Expr,
    pub to: Expr,
    pub step: Step,
    pub body: Vec<Stmt>,
}

#[derive(Debug, Clone, PartialEq)]
pub enum Step {
    Const(i64),
    /// LINT, or ULINT when the step is unsigned; 0 is a fault.
    Dynamic(Expr),
}

/// Types of a body's temporaries by number.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Body {
    pub stmts: Vec<Stmt>,
    pub temps: Vec<ElemType>,
    /// Local variables whose address is taken: they need memory.
    pub in_memory: std::collections::BTreeSet<u32>,
    /// The result variable's address is taken.
    pub result_in_memory: bool,
    /// POUs this body calls.
    pub calls: std::collections::BTreeSet<u32>,
    /// A statement was left out: the POU's name. An error must have said why.
    pub dropped: Option<crate::diagnostic::Span>,
    /// Located bytes read and written: (statement, area address, bytes, bit, write).
    pub located: Vec<LocatedUse>,
}

/// An access to a located address.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct LocatedUse {
    pub statement: u32,
    pub address: u32,
    pub bytes: u32,
    pub bit: Option<u8>,
    pub write: bool,
}

/// Faults the emitter needs a name for.
pub const INDEX_FAULT: TrapId = TrapId::IndexOutOfBounds;

impl Expr {
    pub fn int(ty: ElemType, v: i64) -> Self {
        Self { ty, kind: ExprKind::Const(Const::I(v)) }
    }
    pub fn new(ty: ElemType, kind: ExprKind) -> Self {
        Self { ty, kind }
    }
    pub fn as_const(&self) -> Option<Const> {
        match self.kind {
            ExprKind::Const(c) => Some(c),
            _ => None,
        }
    }
    pub fn as_int(&self) -> Option<i64> {
        match self.kind {
            ExprKind::Const(Const::I(v)) => Some(v),
            _ => None,
        }
    }
}

impl Place {
    pub fn new(base: Base, storage: Storage) -> Self {
        Self { base, offset: 0, storage, index: None }
    }
}
