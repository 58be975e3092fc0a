//! Every limit holds, is told, and is not reached by accident.

use dinrail_iec::{Options, Source, compile, limits};

use crate::host::{Host, source};

/// Codes of the errors.
fn errors(text: &str) -> Vec<&'static str> {
    match compile(&source(text), &Options::default()) {
        Ok(_) => Vec::new(),
        Err(d) => {
            assert!(!d.render(false).is_empty());
            let mut codes: Vec<_> = d.items().iter().map(|d| d.code).collect();
            codes.dedup();
            codes
        }
    }
}

fn program(vars: &str, body: &str) -> String {
    format!("PROGRAM p VAR {vars} END_VAR {body} END_PROGRAM")
}

#[test]
fn nesting() {
    let parens = |n: usize| program("x : INT;", &format!("x := {}x{};", "(".repeat(n), ")".repeat(n)));
    assert!(errors(&parens(30)).is_empty());
    assert!(errors(&parens(10_000)).contains(&"E0801"));
    let ifs = |n: usize| {
        program("x : INT;", &format!("{}x := 1;{}", "IF x > 0 THEN ".repeat(n), " END_IF;".repeat(n)))
    };
    assert!(errors(&ifs(40)).is_empty());
    assert!(errors(&ifs(10_000)).contains(&"E0801"));
    let nots = program("b : BOOL;", &format!("b := {} b;", "NOT ".repeat(10_000)));
    assert!(errors(&nots).contains(&"E0801"));
    let comments = format!("{}{}PROGRAM p END_PROGRAM", "(*".repeat(60), "*)".repeat(60));
    assert!(errors(&comments).is_empty());
    let comments = format!("{}{}PROGRAM p END_PROGRAM", "(*".repeat(100), "*)".repeat(100));
    assert!(errors(&comments).contains(&"E0801"));
    let arrays = program(&format!("a : {} INT;", "ARRAY [0..0] OF ".repeat(1000)), "");
    assert!(errors(&arrays).contains(&"E0801"));
    let path = program("a : INT;", &format!("a{} := 1;", ".b".repeat(1000)));
    assert!(errors(&path).contains(&"E0801"));
}

/// A long chain is fine up to the limit and runs on a small stack.
#[test]
fn long_expressions_on_a_small_stack() {
    let chain = |n: usize| program("x, y : DINT;", &format!("y := x{};", " + 1".repeat(n)));
    let run = move || {
        let mut h = Host::new(&chain(limits::OPERATORS));
        h.run();
        assert_eq!(h.int("y"), limits::OPERATORS as i128);
        assert_eq!(errors(&chain(limits::OPERATORS + 1)), ["E0801"]);
        let mixed = program("x : DINT;", &format!("x := {}1{};", "(x + ".repeat(60), ")".repeat(60)));
        assert!(errors(&mixed).iter().all(|c| *c == "E0801"));
    };
    std::thread::Builder::new().stack_size(1 << 20).spawn(run).unwrap().join().unwrap();
}

#[test]
fn sizes() {
    assert!(errors(&program("a : ARRAY [0..4000000] OF BYTE;", "")).is_empty());
    assert_eq!(errors(&program("a : ARRAY [0..5000000] OF BYTE;", "")), ["E0805"]);
    assert_eq!(errors(&program("a, b, c, d, e : ARRAY [0..4000000] OF BYTE;", "")), ["E0805"]);
    assert_eq!(errors(&program("a : ARRAY [0..2147483647, 0..2147483647] OF BYTE;", "")), ["E0805"]);
    assert_eq!(errors(&program("a : ARRAY [0..9223372036854775807] OF BYTE;", "")), ["E0407"]);
    let nested = "TYPE a : ARRAY [0..999] OF INT; b : ARRAY [0..999] OF a; c : ARRAY [0..999] OF b; END_TYPE PROGRAM p VAR x : c; END_VAR END_PROGRAM";
    assert_eq!(errors(nested), ["E0805"]);
    let blocks = "FUNCTION_BLOCK f VAR x : ARRAY [0..999999] OF LINT; END_VAR END_FUNCTION_BLOCK FUNCTION_BLOCK g VAR a, b, c : f; END_VAR END_FUNCTION_BLOCK PROGRAM p VAR x : g; END_VAR END_PROGRAM";
    assert!(errors(blocks).contains(&"E0805"));
}

#[test]
fn counts() {
    let symbols = "FUNCTION_BLOCK f VAR a, b, c, d, e : BOOL; END_VAR END_FUNCTION_BLOCK PROGRAM p VAR x : ARRAY [0..99999] OF f; END_VAR END_PROGRAM";
    assert_eq!(errors(symbols), ["E0803"]);
    let many: Vec<String> = (0..=limits::VARIABLES).map(|i| format!("v{i}")).collect();
    assert_eq!(errors(&program(&format!("{} : BOOL;", many.join(", ")), "")), ["E0803"]);
    let mut chain = String::from("FUNCTION_BLOCK f0 VAR x : INT; END_VAR END_FUNCTION_BLOCK ");
    for i in 1..100 {
        chain.push_str(&format!("FUNCTION_BLOCK f{i} VAR x : f{}; END_VAR END_FUNCTION_BLOCK ", i - 1));
    }
    // Given callee first, each is complete when the next one asks.
    assert_eq!(errors(&format!("{chain} PROGRAM p END_PROGRAM")), ["E0801"]);
    let mut chain = String::new();
    for i in 0..100 {
        chain.push_str(&format!("FUNCTION_BLOCK f{i} VAR x : f{}; END_VAR END_FUNCTION_BLOCK ", i + 1));
    }
    chain.push_str("FUNCTION_BLOCK f100 VAR x : INT; END_VAR END_FUNCTION_BLOCK ");
    assert!(errors(&format!("{chain} PROGRAM p END_PROGRAM")).contains(&"E0801"));
    let tasks: Vec<String> = (0..100).map(|i| format!("TASK t{i}(PRIORITY := 1);")).collect();
    let config = format!(
        "PROGRAM p END_PROGRAM CONFIGURATION c RESOURCE r ON x {} PROGRAM i WITH t0 : p; END_RESOURCE END_CONFIGURATION",
        tasks.join(" ")
    );
    assert_eq!(errors(&config), ["E0803"]);
}

#[test]
fn sources() {
    assert_eq!(compile(&[], &Options::default()).unwrap_err().items()[0].code, "E0807");
    let big = Source { name: "big.st".to_owned(), text: " ".repeat(limits::SOURCE_BYTES + 1) };
    let d = compile(&[big], &Options::default()).unwrap_err();
    assert_eq!(d.items()[0].code, "E0807");
    assert!(d.render(false).contains("big.st"));
    // The largest file of statements, and the most errors.
    let mut text = String::from("PROGRAM p VAR x : INT; END_VAR ");
    while text.len() < limits::SOURCE_BYTES - 100 {
        text.push_str("x:=x+1;");
    }
    text.push_str(" END_PROGRAM");
    let t = std::time::Instant::now();
    assert!(errors(&text).is_empty());
    println!("1 MiB of statements: {} ms", t.elapsed().as_millis());
    let mut text = String::from("PROGRAM p ");
    while text.len() < 200_000 {
        text.push_str("x := ; ) ( ] ");
    }
    let d = compile(&source(&text), &Options::default()).unwrap_err();
    assert!(d.items().len() <= limits::ERRORS_PER_FILE + 10, "{}", d.items().len());
}

#[test]
fn retain_has_its_own_limit() {
    let text = program("x : INT; END_VAR VAR RETAIN r : ARRAY [0..9] OF DINT;", "");
    let options = Options { retain_max: 39, ..Options::default() };
    let d = compile(&source(&text), &options).unwrap_err();
    assert_eq!(d.items()[0].code, "E0806");
    assert!(d.render(false).contains("40 bytes"));
    assert!(compile(&source(&text), &Options { retain_max: 40, ..options }).is_ok());
}

/// What would overflow the compiler's own stack, fill its memory or keep it busy for minutes.
#[test]
fn programs_made_to_hurt() {
    let run = || {
        let t = std::time::Instant::now();
        let told = |what: &str| println!("{what}: {} ms so far", t.elapsed().as_millis());
        // Types in types, each complete when the next one is read.
        let many = |n: usize, one: &dyn Fn(usize) -> String| (1..n).map(one).collect::<String>();
        let blocks =
            many(12_000, &|i| format!("FUNCTION_BLOCK f{i} VAR x : f{}; END_VAR END_FUNCTION_BLOCK ", i - 1));
        let first = "FUNCTION_BLOCK f0 VAR x : INT; END_VAR END_FUNCTION_BLOCK ";
        let text = format!("{first}{blocks}PROGRAM p VAR x : f11999; END_VAR END_PROGRAM");
        assert_eq!(errors(&text), ["E0801"]);
        told("blocks");
        let structs = many(20_000, &|i| format!("s{i:05} : STRUCT x : s{:05}; END_STRUCT; ", i - 1));
        let text = format!(
            "TYPE s00000 : STRUCT x : INT; END_STRUCT; {structs} END_TYPE PROGRAM p VAR x : s19999; END_VAR END_PROGRAM"
        );
        assert_eq!(errors(&text), ["E0801"]);
        told("structures");
        let arrays = many(20_000, &|i| format!("a{i:05} : ARRAY [0..0] OF a{:05}; ", i - 1));
        let text =
            format!("TYPE a00000 : INT; {arrays} END_TYPE PROGRAM p VAR x : a19999; END_VAR END_PROGRAM");
        assert_eq!(errors(&text), ["E0801"]);
        told("arrays");
        // Calls in calls, and a circle of them.
        let calls = |n: usize, last: &str| {
            let functions = many(n, &|i| format!("FUNCTION f{i} : INT f{i} := f{}(); END_FUNCTION ", i - 1));
            format!(
                "FUNCTION f0 : INT f0 := {last}; END_FUNCTION {functions} PROGRAM p VAR x : INT; END_VAR x := f{}(); END_PROGRAM",
                n - 1
            )
        };
        assert!(errors(&calls(120, "1")).is_empty());
        assert_eq!(errors(&calls(15_000, "1")), ["E0801"]);
        assert_eq!(errors(&calls(15_000, "f14999()")), ["E0509"]);
        told("calls");
        // Small in the text, large in memory.
        let text = "TYPE e : STRUCT END_STRUCT; a : ARRAY [1..4000000] OF e; END_TYPE PROGRAM p VAR x : ARRAY [1..4000000] OF a; END_VAR END_PROGRAM";
        assert!(errors(text).contains(&"E0905"));
        let names: Vec<String> = (0..16_000).map(|i| format!("v{i}")).collect();
        let values = vec!["1"; 200_000].join(",");
        let text = program(&format!("{} : ARRAY [1..200000] OF SINT := [{values}];", names.join(",")), "");
        assert_eq!(errors(&text), ["E0805"]);
        let text = format!(
            "FUNCTION f : INT VAR {} : ARRAY [1..4000000] OF INT (1..2); END_VAR f := 1; END_FUNCTION PROGRAM p VAR x : INT; END_VAR x := f(); END_PROGRAM",
            names.join(",")
        );
        assert_eq!(errors(&text), ["E0805"]);
        told("memory");
        // Initial values of many members, in each of many elements.
        let members =
            |what: &str, by: &str| (0..4000).map(|i| format!("m{i}{what}")).collect::<Vec<_>>().join(by);
        let text = format!(
            "TYPE s : STRUCT {} : BYTE; END_STRUCT; t : s := ({}); END_TYPE
            FUNCTION f : INT VAR a : ARRAY [0..1499] OF t; END_VAR f := BYTE_TO_INT(a[1499].m3999); END_FUNCTION
            PROGRAM p VAR x : INT; END_VAR x := f(); END_PROGRAM",
            members("", ","),
            members(" := 7", ",")
        );
        assert!(errors(&text).is_empty());
        told("members");
        // Every instance of a program has code of its own.
        let body = "x := x + 1; ".repeat(20_000);
        let instances: String = (0..20_000).map(|i| format!("PROGRAM i{i} : p; ")).collect();
        let text = format!(
            "PROGRAM p VAR x : INT; END_VAR {body} END_PROGRAM CONFIGURATION c RESOURCE r ON x {instances} END_RESOURCE END_CONFIGURATION"
        );
        assert_eq!(errors(&text), ["E0803"]);
        told("instances");
        // Names that nobody knows beside very many that are known.
        let unknown: String = (0..50_000).map(|i| format!("w{i}:=u{i};")).collect();
        let text = program(&format!("{} : INT;", names.join(",")), &unknown);
        assert_eq!(errors(&text), ["E0302"]);
        let unknown: String = (0..60_000).map(|i| format!("w{i}:t{i};")).collect();
        let types: String = (0..16_000).map(|i| format!("y{i}:INT;")).collect();
        let block = format!("FUNCTION_BLOCK b VAR {unknown} END_VAR END_FUNCTION_BLOCK");
        let sources = [
            Source { name: "a".to_owned(), text: format!("TYPE {types} END_TYPE PROGRAM p END_PROGRAM") },
            Source { name: "b".to_owned(), text: block },
        ];
        assert!(compile(&sources, &Options::default()).is_err());
        let fields: String = (0..80_000).map(|i| format!("m{i}:INT;")).collect();
        assert_eq!(
            errors(&format!("TYPE s : STRUCT {fields} END_STRUCT; END_TYPE PROGRAM p END_PROGRAM")),
            ["E0801"]
        );
        told("names");
        assert!(t.elapsed().as_secs() < 120, "{} s", t.elapsed().as_secs());
    };
    std::thread::Builder::new().stack_size(2 << 20).spawn(run).unwrap().join().unwrap();
}

/// What no engine would load is refused with a place, not by the engine.
#[test]
fn modules_that_no_engine_takes() {
    let inputs: Vec<String> = (0..1001).map(|i| format!("v{i}")).collect();
    let function = |n: usize| {
        format!(
            "FUNCTION f : INT VAR_INPUT {} : INT; END_VAR f := v0; END_FUNCTION PROGRAM p VAR x : INT; END_VAR x := f(v0 := 1); END_PROGRAM",
            inputs[..n].join(",")
        )
    };
    assert!(errors(&function(limits::PARAMETERS)).is_empty());
    assert_eq!(errors(&function(limits::PARAMETERS + 1)), ["E0803"]);
    let loops = "FOR i:=0 TO 9 DO END_FOR ".repeat(38_500);
    let more: Vec<String> = (0..12_500).map(|i| format!("v{i}")).collect();
    let text = format!(
        "FUNCTION f : INT VAR i,{} : INT; END_VAR {loops} f := 1; END_FUNCTION PROGRAM p VAR x : INT; END_VAR x := f(); END_PROGRAM",
        more.join(",")
    );
    assert_eq!(errors(&text), ["E0803"]);
    // Initial values that lie far apart, more than an engine has segments for.
    let text = "TYPE s : STRUCT v : ARRAY [0..7] OF DINT; x : INT := 5; END_STRUCT; END_TYPE
        PROGRAM p VAR a : ARRAY [0..119999] OF s; n, i : DINT; END_VAR
        FOR i := 0 TO 119999 DO IF a[i].x = 5 AND a[i].v[3] = 0 THEN n := n + 1; END_IF END_FOR END_PROGRAM";
    let mut h = Host::new(text);
    h.run();
    assert_eq!(h.int("n"), 120_000);
}
