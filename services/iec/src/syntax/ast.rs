//! The syntax tree. All front ends end here; every node knows its place.

use crate::diagnostic::Span;

/// A name as spelled.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Ident {
    pub text: String,
    pub span: Span,
}

impl Ident {
    /// For look-ups: names differ in more than case.
    pub fn key(&self) -> String {
        self.text.to_ascii_uppercase()
    }
}

/// What a file holds.
#[derive(Debug, Clone, Default)]
pub struct Unit {
    pub pous: Vec<Pou>,
    pub types: Vec<TypeDecl>,
    pub globals: Vec<VarBlock>,
    pub configurations: Vec<Configuration>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PouKind {
    Program,
    Function,
    FunctionBlock,
}

impl PouKind {
    pub fn keyword(self) -> &'static str {
        match self {
            Self::Program => "PROGRAM",
            Self::Function => "FUNCTION",
            Self::FunctionBlock => "FUNCTION_BLOCK",
        }
    }
}

/// A program organisation unit.
#[derive(Debug, Clone)]
pub struct Pou {
    pub kind: PouKind,
    pub name: Ident,
    pub returns: Option<TypeSpec>,
    pub blocks: Vec<VarBlock>,
    pub body: Vec<Stmt>,
    /// Ids of its statements: from, to (exclusive).
    pub stmts: (u32, u32),
    /// The `END_...` word.
    pub end: Span,
}

/// `TYPE name : spec := init; END_TYPE`
#[derive(Debug, Clone)]
pub struct TypeDecl {
    pub name: Ident,
    pub spec: TypeSpec,
    pub init: Option<Init>,
}

/// Which section.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Section {
    Var,
    Input,
    Output,
    InOut,
    Temp,
    Global,
    External,
}

impl Section {
    pub fn keyword(self) -> &'static str {
        match self {
            Self::Var => "VAR",
            Self::Input => "VAR_INPUT",
            Self::Output => "VAR_OUTPUT",
            Self::InOut => "VAR_IN_OUT",
            Self::Temp => "VAR_TEMP",
            Self::Global => "VAR_GLOBAL",
            Self::External => "VAR_EXTERNAL",
        }
    }
}

/// `VAR ... END_VAR`
#[derive(Debug, Clone)]
pub struct VarBlock {
    pub section: Section,
    pub constant: bool,
    pub retain: Option<Span>,
    pub vars: Vec<VarDecl>,
    pub span: Span,
}

/// `a, b AT %IX0.0 : BOOL := TRUE;`
#[derive(Debug, Clone)]
pub struct VarDecl {
    pub names: Vec<Ident>,
    pub at: Option<Ident>,
    pub spec: TypeSpec,
    pub init: Option<Init>,
}

#[derive(Debug, Clone)]
pub struct TypeSpec {
    pub kind: TypeSpecKind,
    pub span: Span,
}

#[derive(Debug, Clone)]
pub enum TypeSpecKind {
    Named(Ident),
    Array {
        dims: Vec<(Expr, Expr)>,
        of: Box<TypeSpec>,
    },
    Struct(Vec<VarDecl>),
    Enum(Vec<(Ident, Option<Expr>)>),
    Subrange {
        base: Ident,
        lo: Box<Expr>,
        hi: Box<Expr>,
    },
    /// Something that was reported already.
    Error,
}

/// Initial value.
#[derive(Debug, Clone)]
pub enum Init {
    Expr(Expr),
    /// `[1, 2, 3(0)]`: each item with its repetition.
    Array(Vec<(Option<Expr>, Init)>, Span),
    /// `(a := 1, b := 2)`
    Struct(Vec<(Ident, Init)>, Span),
}

impl Init {
    pub fn span(&self) -> Span {
        match self {
            Self::Expr(e) => e.span,
            Self::Array(_, s) | Self::Struct(_, s) => *s,
        }
    }
}

#[derive(Debug, Clone)]
pub struct Stmt {
    /// Index into the debug map's statements; from 1.
    pub id: u32,
    /// Of its head: up to THEN, DO, OF; the whole of a simple statement.
    pub span: Span,
    pub kind: StmtKind,
}

#[derive(Debug, Clone)]
pub enum StmtKind {
    Assign { target: Expr, value: Expr },
    Call(Expr),
    If { branches: Vec<IfBranch>, otherwise: Vec<Stmt> },
    Case { selector: Expr, arms: Vec<CaseArm>, otherwise: Vec<Stmt> },
    For { var: Expr, from: Expr, to: Expr, by: Option<Expr>, body: Vec<Stmt> },
    While { cond: Expr, body: Vec<Stmt> },
    Repeat { body: Vec<Stmt>, until: Expr, until_id: u32 },
    Exit,
    Continue,
    Return,
    Empty,
}

#[derive(Debug, Clone)]
pub struct IfBranch {
    /// Statement id of this test.
    pub id: u32,
    pub cond: Expr,
    pub body: Vec<Stmt>,
}

#[derive(Debug, Clone)]
pub struct CaseArm {
    pub labels: Vec<(Expr, Option<Expr>)>,
    pub body: Vec<Stmt>,
}

#[derive(Debug, Clone)]
pub struct Expr {
    pub span: Span,
    pub kind: ExprKind,
}

#[derive(Debug, Clone)]
pub enum ExprKind {
    Int(i128),
    /// Decimal text, so that REAL and LREAL both get the nearest value.
    Real(String),
    Bool(bool),
    /// `INT#5`: prefix and the rest.
    Typed(Ident, String),
    Text,
    Name(Ident),
    /// `%IX0.3`
    Direct(String),
    Field(Box<Expr>, Ident),
    Index(Box<Expr>, Vec<Expr>),
    Call(Box<Expr>, Vec<Arg>),
    Unary(Unary, Box<Expr>),
    Binary(Binary, Box<Expr>, Box<Expr>, Span),
    /// Something that was reported already.
    Error,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Unary {
    Neg,
    Plus,
    Not,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Binary {
    Or,
    OrElse,
    Xor,
    And,
    AndThen,
    Eq,
    Ne,
    Lt,
    Gt,
    Le,
    Ge,
    Add,
    Sub,
    Mul,
    Div,
    Mod,
    Power,
}

impl Binary {
    pub fn text(self) -> &'static str {
        match self {
            Self::Or => "OR",
            Self::OrElse => "OR_ELSE",
            Self::Xor => "XOR",
            Self::And => "AND",
            Self::AndThen => "AND_THEN",
            Self::Eq => "=",
            Self::Ne => "<>",
            Self::Lt => "<",
            Self::Gt => ">",
            Self::Le => "<=",
            Self::Ge => ">=",
            Self::Add => "+",
            Self::Sub => "-",
            Self::Mul => "*",
            Self::Div => "/",
            Self::Mod => "MOD",
            Self::Power => "**",
        }
    }
    pub fn is_comparison(self) -> bool {
        matches!(self, Self::Eq | Self::Ne | Self::Lt | Self::Gt | Self::Le | Self::Ge)
    }
}

/// An argument: `x`, `name := x`, `name => y`, `NOT name => y`.
#[derive(Debug, Clone)]
pub struct Arg {
    pub name: Option<Ident>,
    pub output: bool,
    /// `NOT name => target`
    pub negated: bool,
    /// `None` in `name =>`: the output is not taken.
    pub value: Option<Expr>,
    pub span: Span,
}

/// `CONFIGURATION`; what stands outside of a RESOURCE belongs to an unnamed one.
#[derive(Debug, Clone)]
pub struct Configuration {
    pub name: Ident,
    pub globals: Vec<VarBlock>,
    pub resources: Vec<Resource>,
}

#[derive(Debug, Clone)]
pub struct Resource {
    pub name: Ident,
    pub globals: Vec<VarBlock>,
    pub tasks: Vec<TaskDecl>,
    pub programs: Vec<ProgramDecl>,
}

#[derive(Debug, Clone)]
pub struct TaskDecl {
    pub name: Ident,
    pub params: Vec<(Ident, Expr)>,
}

#[derive(Debug, Clone)]
pub struct ProgramDecl {
    pub name: Ident,
    pub retain: Option<Span>,
    pub task: Option<Ident>,
    pub type_name: Ident,
    /// Place of an argument list, which is not supported.
    pub args: Option<Span>,
}
