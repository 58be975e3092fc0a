//! Statements, calls, data: what programs do.

use dinrail_iec::artifact::TrapId;
use dinrail_iec::{Options, compile};

use crate::host::{Host, Value, source};
use crate::random::SAMPLE;

fn check(text: &str, expected: &[(&str, i128)]) -> Host {
    let mut h = Host::new(text);
    h.run();
    for (var, v) in expected {
        assert_eq!(h.int(var), *v, "{var}");
    }
    h
}

#[test]
fn case_takes_lists_ranges_and_the_first_match() {
    // A jump table, a chain of comparisons (far labels), a 64-bit selector.
    for (ty, far) in [("INT", 14), ("INT", 30_000), ("LINT", 14), ("USINT", 14), ("WORD", 14)] {
        let text = format!(
            "PROGRAM p VAR x : {ty}; r : INT; END_VAR
             CASE x OF 1: r := 1; 2, 3: r := 2; 5..8, 12: r := 3; 6: r := 99; {far}: r := 4; ELSE r := -1; END_CASE; END_PROGRAM"
        );
        let mut h = Host::new(&text);
        for x in 0..16 {
            h.set("x", Value::Int(x));
            h.run();
            let expected = match x {
                1 => 1,
                2 | 3 => 2,
                5..=8 | 12 => 3,
                14 if far == 14 => 4,
                _ => -1,
            };
            assert_eq!(h.int("r"), expected, "{ty} {x}");
        }
    }
    check(
        "PROGRAM p VAR x : INT := -3; r : INT := 7; END_VAR CASE x OF -5..-1: r := 1; END_CASE; CASE x OF 1: r := 9; END_CASE; END_PROGRAM",
        &[("r", 1)],
    );
}

#[test]
fn loops_with_exit_and_continue() {
    check(
        "PROGRAM p VAR i, j, odd, n, w, rep, inner : INT; END_VAR
         FOR i := 1 TO 10 DO
           IF i MOD 2 = 0 THEN CONTINUE; END_IF;
           IF i > 7 THEN EXIT; END_IF;
           odd := odd + i;
         END_FOR;
         WHILE TRUE DO
           n := n + 1;
           FOR j := 0 TO 100 DO IF j = 3 THEN EXIT; END_IF; inner := inner + 1; END_FOR;
           IF n < 5 THEN CONTINUE; END_IF;
           EXIT;
         END_WHILE;
         WHILE w < 10 DO w := w + 3; END_WHILE;
         REPEAT rep := rep + 1; IF rep = 2 THEN CONTINUE; END_IF; UNTIL rep >= 2 END_REPEAT;
         END_PROGRAM",
        &[("odd", 16), ("n", 5), ("inner", 15), ("w", 12), ("rep", 2)],
    );
}

#[test]
fn end_and_step_of_for_are_evaluated_once() {
    check(
        "PROGRAM p VAR i, n, e, s : INT; END_VAR e := 5; s := 1; FOR i := 1 TO e BY s DO e := 100; s := 7; n := n + 1; END_FOR; END_PROGRAM",
        &[("n", 5)],
    );
    let mut h =
        Host::new("PROGRAM p VAR i, s : INT; END_VAR\nFOR i := 1 TO 3 BY s DO ; END_FOR;\nEND_PROGRAM");
    let f = h.scan_at(0).unwrap_err();
    assert_eq!((f.id, f.place.as_str()), (TrapId::ForStepZero, "test.st:2:1"));
}

#[test]
fn a_loop_that_changes_its_variable_follows_the_change() {
    check(
        "PROGRAM p VAR i, n : INT; END_VAR FOR i := 1 TO 10 DO n := n + 1; i := i + 1; END_FOR; END_PROGRAM",
        &[("n", 5)],
    );
    check(
        "PROGRAM p VAR i, n : INT; END_VAR FOR i := 1 TO 10 DO n := n + 1; i := 50; END_FOR; END_PROGRAM",
        &[("n", 1), ("i", 50)],
    );
    check(
        "FUNCTION bump : BOOL VAR_IN_OUT x : INT; END_VAR x := x + 4; bump := TRUE; END_FUNCTION
         PROGRAM p VAR i, n : INT; b : BOOL; END_VAR FOR i := 0 TO 9 DO b := bump(i); n := n + 1; END_FOR; END_PROGRAM",
        &[("n", 2)],
    );
}

#[test]
fn functions_take_values_references_and_give_outputs() {
    check(
        "FUNCTION divmod : INT
         VAR_INPUT a : INT; b : INT := 10; END_VAR VAR_OUTPUT rest : INT; END_VAR VAR calls : INT; END_VAR
           calls := calls + 1; divmod := a / b; rest := a MOD b + calls - 1; END_FUNCTION
         FUNCTION inc : INT VAR_IN_OUT x : INT; END_VAR VAR_INPUT amount : INT; END_VAR x := x + amount; inc := x; END_FUNCTION
         FUNCTION sum : DINT VAR_INPUT a : ARRAY [1..4] OF INT; END_VAR VAR i : INT; END_VAR
           FOR i := 1 TO 4 DO sum := sum + a[i]; a[i] := 0; END_FOR; END_FUNCTION
         FUNCTION fill : BOOL VAR_IN_OUT a : ARRAY [1..4] OF INT; END_VAR VAR_INPUT v : INT; END_VAR VAR i : INT; END_VAR
           FOR i := 1 TO 4 DO a[i] := v * i; END_FOR; fill := TRUE; END_FUNCTION
         FUNCTION quiet VAR_INPUT a : INT; END_VAR VAR_OUTPUT b : INT; END_VAR b := a + 1; END_FUNCTION
         FUNCTION twice : INT VAR_INPUT a : INT; END_VAR twice := a; twice := twice + a; END_FUNCTION
         PROGRAM p VAR q, r, q2, x, y, z, t, n4 : INT; s, s2 : DINT; arr : ARRAY [1..4] OF INT := [1, 2, 3, 4]; b : BOOL; d : DINT; END_VAR
           q := divmod(a := 47, rest => r); q2 := divmod(b := 5, a := 47);
           x := 5; y := inc(x, 3) + inc(x := x, amount := 1); z := divmod(divmod(1000, 10, rest => d), 7, rest => r);
           s := sum(arr); b := fill(arr, 5); s2 := sum(a := arr); quiet(3, b => n4); t := twice(twice(twice(1)));
         END_PROGRAM",
        &[("q", 4), ("r", 2), ("q2", 9), ("x", 9), ("y", 17), ("z", 14), ("d", 0), ("s", 10), ("s2", 50), ("n4", 4), ("t", 8), ("arr[4]", 20)],
    );
}

#[test]
fn locals_of_functions_start_anew_in_every_call() {
    check(
        "TYPE c : (red, green) := green; END_TYPE
         FUNCTION f : INT VAR a : INT := 5; m : ARRAY [0..3] OF INT := [7, 2(8)]; z : ARRAY [0..1] OF LINT; k : c; s : INT (3..9); END_VAR
           f := a + m[0] + m[1] + m[2] + m[3] + LINT_TO_INT(z[1]) + s; IF k = green THEN f := f + 1000; END_IF;
           a := 99; m[0] := 99; m[3] := 99; z[1] := 99; k := red; s := 9; END_FUNCTION
         PROGRAM p VAR x, y : INT; END_VAR x := f(); y := f(); END_PROGRAM",
        &[("x", 1031), ("y", 1031)],
    );
}

#[test]
fn function_blocks_keep_their_state_per_instance() {
    let mut h = Host::new(
        "FUNCTION_BLOCK counter VAR_INPUT step : INT := 1; END_VAR VAR_OUTPUT n : DINT; END_VAR VAR first : BOOL := TRUE; END_VAR VAR_TEMP t : DINT := 100; END_VAR
           t := t + step; n := n + t - 100; first := FALSE; END_FUNCTION_BLOCK
         FUNCTION_BLOCK pair VAR_OUTPUT sum : DINT; END_VAR VAR a : counter; b : counter := (step := 10); END_VAR
           a(); b(); sum := a.n + b.n; END_FUNCTION_BLOCK
         VAR_GLOBAL g : counter := (step := 1000); END_VAR
         PROGRAM p VAR x, y : pair; arr : ARRAY [1..3] OF counter; i : INT; d, e : LINT; END_VAR
           x(); x(sum => d); y(); g(); g.step := 2000;
           FOR i := 1 TO 3 DO arr[i](step := i); END_FOR; e := arr[2].n; END_PROGRAM",
    );
    h.run();
    h.run();
    for (var, v) in [
        ("x.sum", 44),
        ("d", 44),
        ("y.sum", 22),
        ("g.n", 3000),
        ("arr[1].n", 2),
        ("arr[2].n", 4),
        ("arr[3].n", 6),
        ("e", 4),
        ("x.a.first", 0),
        ("x.b.step", 10),
    ] {
        assert_eq!(h.int(var), v, "{var}");
    }
}

#[test]
fn in_out_of_function_blocks_refers_to_the_callers_variable() {
    check(
        "FUNCTION_BLOCK acc VAR_IN_OUT total : DINT; m : ARRAY [0..2] OF INT; t : R_TRIG; END_VAR VAR_INPUT v : INT; END_VAR VAR i : INT; END_VAR
           total := total + v; FOR i := 0 TO 2 DO m[i] := m[i] + v; END_FOR; t(CLK := TRUE); END_FUNCTION_BLOCK
         FUNCTION_BLOCK outer VAR_IN_OUT total : DINT; END_VAR VAR a : acc; m : ARRAY [0..2] OF INT; t : R_TRIG; END_VAR VAR_OUTPUT x : INT; q : BOOL; END_VAR
           a(total := total, m := m, v := 5, t := t); x := m[2]; q := t.Q; END_FUNCTION_BLOCK
         PROGRAM p VAR s, u : DINT; o : outer; a : acc; m : ARRAY [0..2] OF INT; t : R_TRIG; arr : ARRAY [0..2] OF DINT; i : INT := 1; END_VAR
           o(total := s); a(total := s, v := 2, m := m, t := t); a(total := arr[i], v := 7, m := m, t := t); END_PROGRAM",
        &[("s", 7), ("o.x", 5), ("o.q", 1), ("arr[1]", 7), ("m[0]", 9)],
    );
}

#[test]
fn arrays_structures_and_enumerations() {
    check(
        "TYPE color : (red := 5, green, blue); pt : STRUCT x, y : INT := 1; c : color := blue; h : ARRAY [0..2] OF SINT := [1, 2]; END_STRUCT; END_TYPE
         PROGRAM p
         VAR a, b : ARRAY [-1..1, 2..4] OF INT := [1, 2, 3, 3(9)]; v, w : pt := (x := 7); list : ARRAY [0..4] OF pt; n : ARRAY [0..1] OF ARRAY [1..2] OF INT;
           c : color; i : INT := 1; r1, r2, r3, r4, r5, r6, r7 : INT; same : BOOL; s : INT (0..9) := 3; END_VAR
           a[0, 3] := 50; a[i - 1, i + 3] := 60; b := a; r1 := b[-1, 4]; r2 := b[0, 3]; r3 := b[i - 1, 4]; r4 := b[1, 2];
           v.y := 3; w := v; list[3] := w; list[i + 1].h[2] := 77; r5 := list[3].x * 10 + list[3].y; r6 := list[2].h[1];
           n[1][2] := 8; n[1, 1] := 4; r7 := n[i][2] * 10 + n[1][1];
           c := color#green; same := c = green AND c <> blue; s := 5;
         END_PROGRAM",
        &[("r1", 3), ("r2", 50), ("r3", 60), ("r4", 0), ("r5", 73), ("r6", 2), ("r7", 84), ("c", 6), ("same", 1), ("v.c", 7), ("list[2].h[2]", 77), ("s", 5)],
    );
}

#[test]
fn array_bounds_are_checked_in_every_dimension_and_type() {
    for (ty, lo, hi) in [
        ("SINT", -5, 5),
        ("INT", 0, 9),
        ("DINT", -1, 1),
        ("LINT", 1, 3),
        ("USINT", 0, 9),
        ("UDINT", -3, 9),
        ("ULINT", -3, 9),
        ("UINT", 2, 300),
    ] {
        let text = format!(
            "PROGRAM p VAR i : {ty}; a : ARRAY [{lo}..{hi}] OF INT; r : INT; END_VAR\n  a[i] := 5; r := a[i];\nEND_PROGRAM"
        );
        let mut h = Host::new(&text);
        let signed = !ty.starts_with('U');
        for i in [lo - 1, lo, 2.max(lo), hi, hi + 1, 0, 100, 127] {
            if (i < 0 && !signed) || (ty == "USINT" && i > 255) || (ty == "SINT" && !(-128..128).contains(&i))
            {
                continue;
            }
            h.set("i", Value::Int(i.into()));
            let result = h.scan_at(0);
            if (lo..=hi).contains(&i) {
                assert_eq!((result, h.int("r")), (Ok(()), 5), "{ty} {i}");
            } else {
                let f = result.unwrap_err();
                assert_eq!(
                    (f.id, f.value, f.place.as_str()),
                    (TrapId::IndexOutOfBounds, i64::from(i), "test.st:2:3"),
                    "{ty} {i}"
                );
            }
        }
        if !signed {
            let top = if ty == "UDINT" { i128::from(u32::MAX) } else { i128::from(u64::MAX) };
            if ty == "UDINT" || ty == "ULINT" {
                h.set("i", Value::Int(top));
                assert!(h.scan_at(0).is_err(), "{ty} {top}");
            }
        }
    }
    let mut h = Host::new(
        "PROGRAM p VAR i, j : INT; a : ARRAY [0..2, 0..3] OF INT; END_VAR a[i, j] := 1; END_PROGRAM",
    );
    h.set("j", Value::Int(4));
    assert_eq!(h.scan_at(0).unwrap_err().value, 4);
}

/// Where the bounds of the loop prove the index, no check is emitted; the same results either way.
#[test]
fn indices_known_to_be_in_bounds() {
    check(
        "PROGRAM p VAR a : ARRAY [0..9] OF DINT; b : ARRAY [1..10] OF DINT; i, j : INT; s : DINT; u : USINT; t : ARRAY [0..255] OF BYTE; END_VAR
         FOR i := 0 TO 9 DO a[i] := i; b[i + 1] := 10 * i; END_FOR;
         FOR i := 9 TO 1 BY -2 DO a[i - 1] := a[i - 1] + b[10 - i]; END_FOR;
         FOR i := 0 TO 8 DO FOR j := 0 TO 8 - i DO s := s + a[j + 1]; END_FOR; END_FOR;
         FOR u := 0 TO 255 DO t[u] := 1; END_FOR; t[u] := 2; i := -13; s := s + a[ABS(i) MOD 10];
         END_PROGRAM",
        &[("a[0]", 80), ("a[2]", 62), ("a[8]", 8), ("b[10]", 90), ("t[255]", 2), ("s", 968)],
    );
    // An index that wraps is not proven by the bounds of its type.
    let mut h = Host::new(
        "PROGRAM p VAR s : SINT := 127; a : ARRAY [-128..127] OF INT; END_VAR a[s + 1] := 5; END_PROGRAM",
    );
    h.run();
    assert_eq!(h.int("a[-128]"), 5);
}

#[test]
fn subranges_are_checked() {
    let mut h = Host::new(
        "TYPE pct : INT (0..100); END_TYPE PROGRAM p VAR x : pct; y : INT := 50; END_VAR\nx := y;\nEND_PROGRAM",
    );
    h.run();
    h.set("y", Value::Int(101));
    let f = h.scan_at(0).unwrap_err();
    assert_eq!((f.id, f.value, f.place.as_str()), (TrapId::SubrangeViolation, 101, "test.st:2:1"));
    assert_eq!(h.int("x"), 50);
}

#[test]
fn located_variables_share_the_image() {
    let mut h = Host::new(
        "VAR_GLOBAL lamp AT %QX0.3 : BOOL := TRUE; m AT %MD1 : TIME := T#5s; END_VAR
         PROGRAM p VAR b AT %QB0 : BYTE; w AT %IW1 : INT; v AT %IX2.7 : BOOL; words AT %MW10 : ARRAY [0..3] OF UINT; i : INT := 2; t : TIME; got : BOOL; raw AT %MD1 : DINT; END_VAR
           lamp := NOT lamp; %QX0.0 := TRUE; %QX0.7 := v; got := %IX2.7; words[i] := 500; t := m; m := m + T#1ms; %QW1 := 16#1234; END_PROGRAM",
    );
    assert_eq!(h.int("b"), 8, "initial values lie in the image");
    h.set("w", Value::Int(-2));
    h.run();
    for (var, v) in
        [("b", 0x81), ("v", 1), ("got", 1), ("words[2]", 500), ("t", 5_000_000_000), ("raw", 5001)]
    {
        assert_eq!(h.int(var), v, "{var}");
    }
    let q = h.artifact.map.layout.output.offset;
    assert_eq!(h.read(q + 2, 2), [0x34, 0x12]);
    h.run();
    assert_eq!(h.int("b"), 0x89);
}

#[test]
fn first_scan_of_the_edge_blocks() {
    let mut h = Host::new(
        "PROGRAM p VAR r : R_TRIG; f : F_TRIG; a : SR; b : RS; x, s, c : BOOL; END_VAR r(CLK := x); f(CLK := x); a(S1 := s, R := c); b(S := s, R1 := c); END_PROGRAM",
    );
    let mut step = |x: i128, s: i128, c: i128| {
        for (var, v) in [("x", x), ("s", s), ("c", c)] {
            h.set(var, Value::Int(v));
        }
        h.run();
        (h.int("r.Q"), h.int("f.Q"), h.int("a.Q1"), h.int("b.Q1"))
    };
    assert_eq!(step(0, 0, 0), (0, 1, 0, 0), "F_TRIG fires in the first scan, by the standard's body");
    assert_eq!(step(1, 1, 1), (1, 0, 1, 0));
    assert_eq!(step(1, 1, 0), (0, 0, 1, 1));
    assert_eq!(step(0, 0, 0), (0, 1, 1, 1));
    assert_eq!(step(0, 0, 1), (0, 0, 0, 0));
}

#[test]
fn counters_stop_at_the_limits_of_their_type() {
    let mut h = Host::new(
        "PROGRAM p VAR u : CTU; d : CTD; x : BOOL; END_VAR x := NOT x; u(CU := x, PV := 5); d(CD := x, PV := 5); END_PROGRAM",
    );
    h.set("u.CV", Value::Int(32766));
    h.set("d.CV", Value::Int(-32767));
    for _ in 0..8 {
        h.run();
    }
    assert_eq!((h.int("u.CV"), h.int("d.CV")), (32767, -32768));
}

#[test]
fn the_sample_runs_in_both_builds() {
    for debug in [false, true] {
        let mut h = Host::with(SAMPLE, &Options { debug, ..Options::default() });
        for n in 0..10 {
            h.scan_at(n * 10_000_000).unwrap();
        }
        assert_eq!(h.int("total"), 40);
        assert_eq!(h.int("m1.lev"), 50);
        assert_eq!(h.int("m2.f[2].n"), 10);
        assert_eq!(h.int("delay"), 500_000_000);
    }
}

#[test]
fn debug_builds_call_brk_before_every_statement() {
    let text = "PROGRAM p VAR i, n : INT; END_VAR\nn := 1;\nFOR i := 1 TO 2 DO\n  n := n + 1;\nEND_FOR;\nIF n = 3 THEN\n  n := 10;\nELSIF n = 4 THEN\n  n := 11;\nEND_IF;\nEND_PROGRAM";
    let mut h = Host::with(text, &Options { debug: true, ..Options::default() });
    h.run();
    assert!(h.store.data().is_empty(), "no call while BRK_ANY is 0");
    h.write(dinrail_iec::artifact::sys::BRK_ANY, &[1]);
    h.run();
    let lines: Vec<String> = h.store.data().clone().iter().map(|s| h.artifact.map.place_text(*s)).collect();
    assert_eq!(
        lines,
        ["test.st:2:1", "test.st:3:1", "test.st:4:3", "test.st:4:3", "test.st:6:1", "test.st:7:3"]
    );
    assert!(h.artifact.map.debug);
    let release = compile(&source(text), &Options::default()).unwrap().artifact;
    assert!(!release.map.debug && release.wasm.len() < h.artifact.wasm.len());
}

#[test]
fn faults_name_the_instance_of_a_nested_block() {
    let text = "FUNCTION_BLOCK inner VAR_INPUT d : INT; END_VAR VAR_OUTPUT q : INT; END_VAR\nq := 10 / d;\nEND_FUNCTION_BLOCK
FUNCTION_BLOCK outer VAR a, b : inner; END_VAR\na(d := 1); b(d := 0);\nEND_FUNCTION_BLOCK
PROGRAM p VAR pad : LINT; o : ARRAY [0..1] OF outer; END_VAR\no[1]();\nEND_PROGRAM";
    let mut h = Host::new(text);
    let f = h.scan_at(0).unwrap_err();
    assert_eq!((f.id, f.place.as_str()), (TrapId::DivisionByZero, "test.st:2:1"));
    assert_eq!(h.artifact.map.instance_at(f.instance).unwrap().path, "p.o[1].b");
}

/// 1000 IL-like instructions and the two anchors: printed, with a bound so loose that only a mistake in kind fails it.
#[test]
fn speed_of_the_anchors() {
    use std::fmt::Write as _;
    let mut body = String::new();
    for i in 0..200 {
        let _ = writeln!(body, "b{0} := (a AND NOT b{1}) OR c; n{0} := n{1} + 3;", i % 16, (i + 1) % 16);
    }
    let vars: Vec<String> = (0..16).map(|i| format!("b{i} : BOOL; n{i} : INT;")).collect();
    let text = format!("PROGRAM p VAR a, c : BOOL; {} END_VAR {body} END_PROGRAM", vars.join(" "));
    let mut h = Host::new(&text);
    let f = h.task("task.main").typed::<(), ()>(&h.store).unwrap();
    f.call(&mut h.store, ()).unwrap();
    let mut best = u128::MAX;
    for _ in 0..50 {
        let t = std::time::Instant::now();
        for _ in 0..100 {
            f.call(&mut h.store, ()).unwrap();
        }
        best = best.min(t.elapsed().as_nanos() / 100);
    }
    println!("1000 IL-like instructions: {best} ns");
    for anchor in [
        "PROGRAM bubble VAR a : ARRAY [0..999] OF DINT; i, j, t, swaps : DINT; END_VAR FOR i := 0 TO 999 DO a[i] := 1000 - i; END_FOR;
         FOR i := 0 TO 998 DO FOR j := 0 TO 998 - i DO IF a[j] > a[j + 1] THEN t := a[j]; a[j] := a[j + 1]; a[j + 1] := t; swaps := swaps + 1; END_IF; END_FOR; END_FOR; END_PROGRAM",
        "PROGRAM math VAR i, n, acc : DINT; x : REAL := 1.5; y : REAL; END_VAR acc := 0; FOR i := 1 TO 100000 DO y := x * 1.0; acc := acc + REAL_TO_DINT(y - 0.4); n := n + 1; END_FOR; END_PROGRAM",
    ] {
        let mut h = Host::new(anchor);
        let f = h.task("task.main").typed::<(), ()>(&h.store).unwrap();
        let mut best = std::time::Duration::MAX;
        for _ in 0..10 {
            let t = std::time::Instant::now();
            f.call(&mut h.store, ()).unwrap();
            best = best.min(t.elapsed());
        }
        println!("{}: {best:?}", &anchor[8..14]);
    }
    let compiled = std::time::Instant::now();
    let _ = compile(&source(SAMPLE), &Options::default()).unwrap();
    println!("compile the sample to wasm: {} us", compiled.elapsed().as_micros());
    assert!(best < 100_000, "{best} ns");
}
