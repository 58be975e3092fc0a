//! Random programs: expressions against a reference, and texts that must not shake the compiler.

use dinrail_iec::artifact::TrapId;
use dinrail_iec::{Options, compile};
use proptest::prelude::*;

use crate::host::{Host, Value, source};
use crate::operators::{INTS, wrap};

/// An expression over the variables v0 to v3 of one integer type.
#[derive(Debug, Clone)]
enum E {
    Var(usize),
    Lit(i128),
    Bin(&'static str, Box<E>, Box<E>),
    Neg(Box<E>),
    Call(&'static str, Box<E>, Box<E>),
    Sel(&'static str, Box<E>, Box<E>, Box<E>, Box<E>),
}

fn tree() -> impl Strategy<Value = E> {
    let leaf = prop_oneof![
        (0_usize..4).prop_map(E::Var),
        prop_oneof![any::<i64>().prop_map(i128::from), (-5_i128..6), Just(i128::from(i64::MIN))]
            .prop_map(E::Lit),
    ];
    leaf.prop_recursive(5, 40, 4, |inner| {
        let op = prop::sample::select(vec!["+", "-", "*", "/", "MOD"]);
        let f = prop::sample::select(vec!["MAX", "MIN"]);
        let cmp = prop::sample::select(vec!["<", "<=", "=", "<>", ">", ">="]);
        let b = |e: E| Box::new(e);
        prop_oneof![
            4 => (op, inner.clone(), inner.clone()).prop_map(move |(o, x, y)| E::Bin(o, b(x), b(y))),
            1 => inner.clone().prop_map(move |x| E::Neg(b(x))),
            1 => (f, inner.clone(), inner.clone()).prop_map(move |(o, x, y)| E::Call(o, b(x), b(y))),
            1 => (cmp, inner.clone(), inner.clone(), inner.clone(), inner)
                .prop_map(move |(o, w, x, y, z)| E::Sel(o, b(w), b(x), b(y), b(z))),
        ]
    })
}

/// Text; literals carry their type, so that none of them widens anything.
fn text(e: &E, ty: &str, bits: u32, signed: bool) -> String {
    let t = |e: &E| text(e, ty, bits, signed);
    match e {
        E::Var(i) => format!("v{i}"),
        E::Lit(n) => format!("{ty}#{}", wrap(*n, bits, signed)),
        E::Bin(op, a, b) => format!("({} {op} {})", t(a), t(b)),
        E::Neg(a) if signed => format!("(-{})", t(a)),
        E::Neg(a) => format!("({ty}#0 - {})", t(a)),
        E::Call(f, a, b) => format!("{f}({}, {})", t(a), t(b)),
        E::Sel(op, a, b, x, y) => format!("SEL({} {op} {}, {}, {})", t(a), t(b), t(x), t(y)),
    }
}

/// Value, or `None` where the program faults.
fn eval(e: &E, vars: &[i128; 4], bits: u32, signed: bool) -> Option<i128> {
    let v = |e: &E| eval(e, vars, bits, signed);
    let w = |n| wrap(n, bits, signed);
    Some(match e {
        E::Var(i) => vars[*i],
        E::Lit(n) => w(*n),
        E::Neg(a) => w(-v(a)?),
        E::Bin(op, a, b) => {
            let (x, y) = (v(a), v(b));
            let (x, y) = (x?, y?);
            match *op {
                "+" => w(x + y),
                "-" => w(x - y),
                "*" => w(x.wrapping_mul(y)),
                "/" if y == 0 => return None,
                "/" => w(x / y),
                _ if y == 0 => 0,
                _ => x % y,
            }
        }
        E::Call(f, a, b) => {
            let (x, y) = (v(a)?, v(b)?);
            if *f == "MAX" { x.max(y) } else { x.min(y) }
        }
        // All operands are evaluated.
        E::Sel(op, a, b, x, y) => {
            let (a, b, x, y) = (v(a)?, v(b)?, v(x)?, v(y)?);
            let g = match *op {
                "<" => a < b,
                "<=" => a <= b,
                "=" => a == b,
                "<>" => a != b,
                ">" => a > b,
                _ => a >= b,
            };
            if g { y } else { x }
        }
    })
}

/// True when the division by zero is seen at compile time.
fn refused(text: &str) -> bool {
    compile(&source(text), &Options::default()).is_err_and(|d| {
        d.items().iter().all(|i| i.code == "E0405" || i.severity == dinrail_iec::Severity::Warning)
    })
}

/// Cases of a property test: `least`, or PROPTEST_CASES when that is given.
pub fn cases(least: u32) -> u32 {
    std::env::var("PROPTEST_CASES").ok().and_then(|n| n.parse().ok()).unwrap_or(least)
}

/// Compiles with and without hooks; what compiles is valid.
fn valid_or_refused(text: &str) {
    for debug in [false, true] {
        match compile(&source(text), &Options { debug, ..Options::default() }) {
            Ok(c) => {
                wasmparser::validate(&c.artifact.wasm).unwrap_or_else(|e| panic!("{e}: {text}"));
                let _ = c.render_warnings(&source(text), false);
            }
            Err(d) => {
                assert!(d.error_count() > 0, "refused without an error: {text}");
                assert!(d.items().iter().all(|i| i.code != "E0901"), "{}", d.render(false));
                let _ = d.render(true);
            }
        }
    }
}

/// The programs of the other tests, as stock for mutation.
fn stock() -> &'static [String] {
    static STOCK: std::sync::OnceLock<Vec<String>> = std::sync::OnceLock::new();
    STOCK.get_or_init(|| {
        let dir = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/it/programs");
        let mut files: Vec<_> = std::fs::read_dir(dir).unwrap().map(|e| e.unwrap().path()).collect();
        files.sort();
        let texts = files.iter().map(|f| std::fs::read_to_string(f).unwrap());
        let mut all: Vec<String> =
            texts.flat_map(|t| t.split("\n=== ").skip(1).map(str::to_owned).collect::<Vec<_>>()).collect();
        all.extend(all.clone().iter().map(|t| t.split_once('\n').map_or("", |p| p.1).to_owned()));
        all.push(SAMPLE.to_owned());
        all
    })
}

proptest! {
    #![proptest_config(ProptestConfig { cases: cases(300), ..ProptestConfig::default() })]

    #[test]
    fn integer_expressions(e in tree(), pick in 0_usize..8, vars in prop::array::uniform4(prop_oneof![any::<i64>(), -3_i64..4])) {
        let (ty, bits, signed) = INTS[pick];
        let program = format!("PROGRAM p VAR v0, v1, v2, v3, r : {ty}; END_VAR r := {}; END_PROGRAM", text(&e, ty, bits, signed));
        let vars = vars.map(|v| wrap(i128::from(v), bits, signed));
        if refused(&program) {
            return Ok(());
        }
        let mut h = Host::new(&program);
        for (i, v) in vars.iter().enumerate() {
            h.set(&format!("v{i}"), Value::Int(*v));
        }
        match (h.scan_at(0), eval(&e, &vars, bits, signed)) {
            (Ok(()), Some(v)) => prop_assert_eq!(h.int("r"), v, "{}", program),
            (Err(f), None) => prop_assert_eq!(f.id, TrapId::DivisionByZero),
            (got, expected) => prop_assert!(false, "{program}: {got:?}, expected {expected:?}"),
        }
    }

    #[test]
    fn constant_folding_is_the_same_arithmetic(e in tree(), pick in 0_usize..8) {
        let (ty, bits, signed) = INTS[pick];
        // All variables become constants.
        let program = format!(
            "PROGRAM p VAR CONSTANT v0 : {ty} := 1; v1 : {ty} := 7; v2 : {ty} := 100; v3 : {ty} := 3; END_VAR VAR r : {ty}; END_VAR r := {}; END_PROGRAM",
            text(&e, ty, bits, signed));
        if refused(&program) {
            return Ok(());
        }
        let mut h = Host::new(&program);
        match (h.scan_at(0), eval(&e, &[1, 7, 100, 3], bits, signed)) {
            (Ok(()), Some(v)) => prop_assert_eq!(h.int("r"), v, "{}", program),
            (Err(f), None) => prop_assert_eq!(f.id, TrapId::DivisionByZero),
            (got, expected) => prop_assert!(false, "{program}: {got:?}, expected {expected:?}"),
        }
    }

    #[test]
    fn for_loops_run_as_often_as_they_should(pick in 0_usize..8, from in any::<i64>(), span in -20_i64..60, step in -9_i64..10, form in 0_u8..3) {
        let (ty, bits, signed) = INTS[pick];
        let from = wrap(i128::from(from), bits, signed);
        let (lo, hi) = if signed { (-(1_i128 << (bits - 1)), (1_i128 << (bits - 1)) - 1) } else { (0, (1_i128 << bits) - 1) };
        let to = (from + i128::from(span) * if step < 0 { -1 } else { 1 }).clamp(lo, hi);
        let step = if step == 0 { 1 } else { step };
        let mut expected = (0_i128, 0_i128);
        let mut i = from;
        while (step > 0 && i <= to) || (step < 0 && i >= to) {
            expected = (expected.0 + 1, wrap(expected.1 + i, bits, signed));
            i += i128::from(step);
        }
        let (by, body) = match form {
            // Known step, counter in a register; step at run time; variable that the body might change.
            0 => (step.to_string(), ""),
            1 => ("s".to_owned(), ""),
            _ => (step.to_string(), "IF n > 1000 THEN i := i; END_IF;"),
        };
        let program = format!(
            "PROGRAM p VAR i, a, b, sum : {ty}; s : SINT; n : DINT; END_VAR n := 0; sum := 0; FOR i := a TO b BY {by} DO n := n + 1; sum := sum + i; {body} END_FOR; END_PROGRAM");
        let mut h = Host::new(&program);
        for (var, v) in [("a", from), ("b", to), ("s", i128::from(step))] {
            h.set(var, Value::Int(v));
        }
        h.run();
        prop_assert_eq!((h.int("n"), h.int("sum")), expected, "{} from {} to {} by {}", program, from, to, step);
    }

    #[test]
    fn never_panics_on_any_text(text in "\\PC{0,200}") {
        let _ = compile(&source(&text), &Options::default()).map_err(|d| d.render(false));
    }

    #[test]
    fn never_panics_on_token_soup(words in prop::collection::vec(prop::sample::select(WORDS.to_vec()), 0..120)) {
        let text = words.join(" ");
        if let Ok(c) = compile(&source(&text), &Options::default()) {
            wasmparser::validate(&c.artifact.wasm).unwrap();
        }
        let wrapped = format!("FUNCTION_BLOCK fb VAR_INPUT x : INT; END_VAR VAR_OUTPUT q : BOOL; END_VAR END_FUNCTION_BLOCK PROGRAM p VAR a, b, i : INT; c : BOOL; t : TON; f : fb; r : REAL; arr : ARRAY [0..3] OF INT; END_VAR {text} END_PROGRAM");
        match compile(&source(&wrapped), &Options::default()) {
            Ok(c) => { wasmparser::validate(&c.artifact.wasm).unwrap(); }
            Err(d) => prop_assert!(d.error_count() > 0 && !d.render(true).is_empty()),
        }
    }

    #[test]
    fn mutated_programs_compile_to_valid_modules_or_not_at_all(
        which in any::<prop::sample::Index>(), other in any::<prop::sample::Index>(),
        changes in prop::collection::vec((0_u8..6, any::<prop::sample::Index>(), any::<prop::sample::Index>(), any::<prop::sample::Index>()), 1..6)
    ) {
        // Words are replaced, doubled, swapped, left out, or taken from another program.
        let split = |text: &str| -> Vec<String> {
            let (tokens, _) = dinrail_iec::lexer::lex(0, text);
            tokens.iter().map(|t| text[t.start as usize..t.end as usize].to_owned()).collect()
        };
        let (mine, theirs): (&String, &String) = (which.get(stock()), other.get(stock()));
        let mut words = split(mine);
        let foreign = split(theirs);
        for (how, a, b, c) in changes {
            if words.is_empty() { break; }
            let (i, j) = (a.index(words.len()), b.index(words.len()));
            match how {
                0 => { words.remove(i); }
                1 => words[i] = (*c.get(WORDS)).to_owned(),
                2 => words.insert(i, (*c.get(WORDS)).to_owned()),
                3 => words.swap(i, j),
                4 => words[i] = words[j].clone(),
                _ => {
                    let from = c.index(foreign.len());
                    let to = (from + 12).min(foreign.len());
                    words.splice(i..i, foreign[from..to].iter().cloned());
                }
            }
        }
        valid_or_refused(&words.join(" "));
    }

    #[test]
    fn a_program_with_a_piece_cut_out_compiles_to_a_valid_module_or_not_at_all(at in 0_usize..4000, len in 1_usize..60, debug in any::<bool>()) {
        let mut text = SAMPLE.to_owned();
        let at = at.min(text.len());
        let end = (at + len).min(text.len());
        text.replace_range(at..end, "");
        match compile(&source(&text), &Options { debug, ..Options::default() }) {
            Ok(c) => { wasmparser::validate(&c.artifact.wasm).unwrap(); }
            Err(d) => prop_assert!(d.error_count() > 0),
        }
    }
}

const WORDS: &[&str] = &[
    "PROGRAM",
    "END_PROGRAM",
    "FUNCTION",
    "END_FUNCTION",
    "FUNCTION_BLOCK",
    "END_FUNCTION_BLOCK",
    "VAR",
    "VAR_INPUT",
    "VAR_GLOBAL",
    "END_VAR",
    "CONSTANT",
    "RETAIN",
    "IF",
    "THEN",
    "ELSIF",
    "ELSE",
    "END_IF",
    "CASE",
    "OF",
    "END_CASE",
    "FOR",
    "TO",
    "BY",
    "DO",
    "END_FOR",
    "WHILE",
    "END_WHILE",
    "REPEAT",
    "UNTIL",
    "END_REPEAT",
    "EXIT",
    "CONTINUE",
    "RETURN",
    "TYPE",
    "END_TYPE",
    "STRUCT",
    "END_STRUCT",
    "ARRAY",
    "AT",
    "CONFIGURATION",
    "END_CONFIGURATION",
    "RESOURCE",
    "END_RESOURCE",
    "TASK",
    "WITH",
    "ON",
    "NOT",
    "AND",
    "OR",
    "XOR",
    "MOD",
    "TRUE",
    "FALSE",
    "a",
    "b",
    "c",
    "i",
    "t",
    "f",
    "r",
    "arr",
    "x",
    "q",
    "p",
    "fb",
    "TON",
    "INT",
    "BOOL",
    "REAL",
    "SIN",
    "MAX",
    "SEL",
    "INT_TO_REAL",
    "IN",
    "PT",
    "Q",
    ":=",
    "=>",
    "=",
    "<>",
    "<",
    ">",
    "+",
    "-",
    "*",
    "/",
    "**",
    "&",
    "(",
    ")",
    "[",
    "]",
    ",",
    ";",
    ";",
    ";",
    ":",
    ".",
    "..",
    "^",
    "?=",
    "1",
    "0",
    "16#FF",
    "1.5",
    "T#1s",
    "INT#5",
    "%IX0.0",
    "%QW2",
    "'text'",
    "(*",
    "*)",
    "//",
    "{",
    "}",
    "#",
    "LD",
    "ST",
    "STEP",
    "TRANSITION",
];

pub const SAMPLE: &str = include_str!("sample.st");
