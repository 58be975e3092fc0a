//! A look at the stages by themselves: tokens, tree, text of the module.

use dinrail_iec::syntax::{StatementTable, parse};
use dinrail_iec::{Options, compile, lexer};

use crate::host::source;

#[test]
fn tokens() {
    let text = "IF a1>=16#FF THEN (* x (* y *) *) q:=T#1h_30m; // end\n w := WORD#16#8001; r := REAL#-1.5e-3; a[1..2]; %IX0.3 1.5 1..3 'don$'t' {p} END_IF";
    let (tokens, problems) = lexer::lex(0, text);
    let list: Vec<String> =
        tokens.iter().map(|t| format!("{:?} {}", t.kind, &text[t.start as usize..t.end as usize])).collect();
    assert_eq!(problems.len(), 1, "the pragma");
    insta::assert_snapshot!(list.join("\n"));
}

#[test]
fn tree() {
    let text = "PROGRAM p VAR x : INT := 2 + 3 * 4; END_VAR IF NOT a OR b AND c = d THEN x := -x ** 2; END_IF END_PROGRAM";
    let (unit, problems) = parse(0, text, &mut StatementTable::default());
    assert!(problems.is_empty());
    // Places are left out: they are pinned by the diagnostics.
    let tree = format!("{unit:#?}");
    let mut short = String::new();
    let mut skip = 0;
    for line in tree.lines() {
        let t = line.trim_start();
        if t.contains("Span {") {
            skip = 4;
        }
        if skip > 0 {
            skip -= 1;
            if t == "}," || t == "}" {
                skip = 0;
            }
            continue;
        }
        short.push_str(line);
        short.push('\n');
    }
    insta::assert_snapshot!(short);
}

/// Operators bind as the standard's table says.
#[test]
fn precedence() {
    use crate::host::Host;
    let mut h = Host::new(
        "PROGRAM p VAR a, b, c : BOOL; x, y, z, m : INT; r : REAL; q1, q2, q3, q4 : BOOL; END_VAR
         a := TRUE; q1 := a OR b AND c; q2 := a XOR a AND b; q3 := NOT b = a; q4 := 1 + 2 * 3 = 7 AND 5 > 3;
         x := 2 + 3 * 4 - 10 / 3 MOD 2; y := -2 * 3; z := 20 - 5 - 3; m := 7 - -2; r := -2.0 ** 2.0; END_PROGRAM",
    );
    h.run();
    for (var, v) in [("q1", 1), ("q2", 1), ("q3", 1), ("q4", 1), ("x", 13), ("y", -6), ("z", 12), ("m", 9)] {
        assert_eq!(h.int(var), v, "{var}");
    }
    // Unary minus binds tighter than the power.
    assert_eq!(h.real("r"), 4.0);
}

/// No check where none is needed, no address arithmetic where the address is known.
#[test]
fn emitted_code_is_lean() {
    let loads = |text: &str| {
        let a = compile(&source(text), &Options::default()).unwrap().artifact;
        let mut operators = Vec::new();
        for payload in wasmparser::Parser::new(0).parse_all(&a.wasm) {
            if let wasmparser::Payload::CodeSectionEntry(body) = payload.unwrap() {
                let list: Vec<String> = body
                    .get_operators_reader()
                    .unwrap()
                    .into_iter()
                    .map(|o| format!("{:?}", o.unwrap()))
                    .collect();
                operators.push(list.join("\n"));
            }
        }
        // trap, program, task
        operators[1].clone()
    };
    let text = loads(
        "PROGRAM p VAR a : ARRAY [1..10] OF DINT; i : DINT; END_VAR FOR i := 1 TO 9 DO a[i] := a[i + 1] * 2; END_FOR; END_PROGRAM",
    );
    assert!(!text.contains("Call"), "no check is left:\n{text}");
    insta::assert_snapshot!(text);
}
