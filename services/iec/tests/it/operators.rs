//! Every operator on every type, against a reference of our own.

use dinrail_iec::artifact::{ElemType, TrapId, sys};
use dinrail_iec::{ModByZero, Options, RealToInt, compile};

use crate::host::{Host, Value, source};

pub const INTS: [(&str, u32, bool); 8] = [
    ("SINT", 8, true),
    ("INT", 16, true),
    ("DINT", 32, true),
    ("LINT", 64, true),
    ("USINT", 8, false),
    ("UINT", 16, false),
    ("UDINT", 32, false),
    ("ULINT", 64, false),
];
const BITS: [(&str, u32); 5] = [("BOOL", 1), ("BYTE", 8), ("WORD", 16), ("DWORD", 32), ("LWORD", 64)];

/// Low bits of a value as a value of the type.
pub fn wrap(v: i128, bits: u32, signed: bool) -> i128 {
    let m = 1_i128 << bits;
    let low = v.rem_euclid(m);
    if signed && low >= m / 2 { low - m } else { low }
}

fn edges(bits: u32, signed: bool) -> Vec<i128> {
    let (lo, hi) = if signed { (-(1 << (bits - 1)), (1 << (bits - 1)) - 1) } else { (0, (1 << bits) - 1) };
    let mut v = vec![lo, lo + 1, hi, hi - 1, 0, 1, 2, 3, 7, hi / 2, hi / 3];
    if signed {
        v.extend([-1, -2, -3, -7]);
    }
    v.sort_unstable();
    v.dedup();
    v
}

#[test]
fn integers() {
    for (ty, bits, signed) in INTS {
        let negate = if signed { "neg := -a; abs1 := ABS(a);" } else { "" };
        let text = format!(
            "PROGRAM p VAR a, b, add1, sub1, mul1, mod1, neg, abs1, min1, max1, lim, sel0, sel1, f_add, f_mul, f_sub, f_mod : {ty};
             eq, ne, lt, le, gt, ge, feq, fne, flt, fle, fgt, fge : BOOL; END_VAR
             add1 := a + b; sub1 := a - b; mul1 := a * b; mod1 := a MOD b; {negate}
             min1 := MIN(a, b); max1 := MAX(a, b); lim := LIMIT({ty}#3, a, {ty}#100);
             sel0 := SEL(FALSE, a, b); sel1 := SEL(TRUE, a, b);
             f_add := ADD(a, b, a); f_mul := MUL(a, b); f_sub := SUB(a, b); f_mod := MOD(a, b);
             eq := a = b; ne := a <> b; lt := a < b; le := a <= b; gt := a > b; ge := a >= b;
             feq := EQ(a, b); fne := NE(a, b); flt := LT(a, b); fle := LE(a, b); fgt := GT(a, b); fge := GE(a, b);
             END_PROGRAM
             PROGRAM d VAR a, b, div1, f_div : {ty}; END_VAR div1 := a / b; f_div := DIV(a, b); END_PROGRAM"
        );
        let mut h = Host::new(&text);
        for a in edges(bits, signed) {
            for b in edges(bits, signed) {
                for (var, v) in [("p.a", a), ("p.b", b), ("d.a", a), ("d.b", if b == 0 { 1 } else { b })] {
                    h.set(var, Value::Int(v));
                }
                h.run();
                let w = |v: i128| wrap(v, bits, signed);
                let db = if b == 0 { 1 } else { b };
                let mut expected = vec![
                    ("add1", w(a + b)),
                    ("sub1", w(a - b)),
                    ("mul1", w(a.wrapping_mul(b))),
                    ("mod1", if b == 0 { 0 } else { a % b }),
                    ("min1", a.min(b)),
                    ("max1", a.max(b)),
                    ("lim", a.clamp(3, 100)),
                    ("sel0", a),
                    ("sel1", b),
                    ("f_add", w(w(a + b) + a)),
                    ("f_mul", w(a.wrapping_mul(b))),
                    ("f_sub", w(a - b)),
                    ("f_mod", if b == 0 { 0 } else { a % b }),
                    ("d.div1", w(a / db)),
                    ("d.f_div", w(a / db)),
                ];
                if signed {
                    expected.extend([("neg", w(-a)), ("abs1", w(a.abs()))]);
                }
                for (prefix, v) in [
                    ("eq", a == b),
                    ("ne", a != b),
                    ("lt", a < b),
                    ("le", a <= b),
                    ("gt", a > b),
                    ("ge", a >= b),
                ] {
                    assert_eq!(h.int(prefix), i128::from(v), "{ty} {a} {prefix} {b}");
                    assert_eq!(h.int(&format!("f{prefix}")), i128::from(v), "{ty} {a} {prefix} {b}");
                }
                for (var, v) in expected {
                    let path = if var.contains('.') { var.to_owned() } else { format!("p.{var}") };
                    assert_eq!(h.int(&path), v, "{ty}: {var} of {a} and {b}");
                }
            }
        }
    }
}

#[test]
fn division_by_zero_faults_with_the_dividend() {
    for (ty, ..) in INTS {
        let mut h = Host::new(&format!(
            "PROGRAM p VAR a : {ty} := 7; b, c : {ty}; END_VAR\n  c := a / b;\nEND_PROGRAM"
        ));
        let f = h.scan_at(0).unwrap_err();
        assert_eq!((f.id, f.place.as_str(), f.value), (TrapId::DivisionByZero, "test.st:2:3", 7), "{ty}");
        let options = Options { mod_by_zero: ModByZero::Fault, ..Options::default() };
        let mut h = Host::with(
            &format!("PROGRAM p VAR a : {ty} := 7; b, c : {ty}; END_VAR c := a MOD b; END_PROGRAM"),
            &options,
        );
        assert_eq!(h.scan_at(0).unwrap_err().id, TrapId::ModuloByZero);
    }
}

#[test]
fn modulo_by_zero_counts_a_warning() {
    let mut h = Host::new(
        "PROGRAM p VAR a : INT := 7; b, c : INT := 3; END_VAR b := 0; c := a MOD b; c := c + a MOD b; END_PROGRAM",
    );
    h.run();
    assert_eq!((h.int("c"), h.u32(sys::WARNINGS)), (0, 2));
}

#[test]
fn bit_strings() {
    for (ty, bits) in BITS {
        let text = format!(
            "PROGRAM p VAR a, b, and1, or1, xor1, not1, shl1, shr1, rol1, ror1, shl_l, rol_l, shl_c, rol_c, f_and : {ty}; n : INT; m : ULINT;
             lt, eq : BOOL; END_VAR
             and1 := a AND b; or1 := a OR b; xor1 := a XOR b; not1 := NOT a; f_and := AND(a, b, a);
             shl1 := SHL(a, n); shr1 := SHR(a, n); rol1 := ROL(a, n); ror1 := ROR(a, n);
             shl_l := SHL(IN := a, N := m); rol_l := ROL(a, m); shl_c := SHL(a, 3); rol_c := ROL(a, 3); lt := a < b; eq := a = b;
             END_PROGRAM"
        );
        let mut h = Host::new(&text);
        let mask = (1_i128 << bits) - 1;
        let values: Vec<i128> = edges(bits.max(2), false).into_iter().map(|v| v & mask).collect();
        for a in &values {
            for b in &values {
                for n in [0_i128, 1, 3, 7, 8, 9, 15, 16, 31, 32, 33, 63, 64, 65, 200, -1] {
                    let m = n as u64;
                    for (var, v) in [("a", *a), ("b", *b), ("n", n), ("m", i128::from(m))] {
                        h.set(var, Value::Int(v));
                    }
                    h.run();
                    let rol = |n: i128| {
                        let n = n.rem_euclid(i128::from(bits));
                        ((a << n) | (a >> (i128::from(bits) - n))) & mask
                    };
                    let shl = |n: i128| if (0..i128::from(bits)).contains(&n) { (a << n) & mask } else { 0 };
                    let shr = if (0..i128::from(bits)).contains(&n) { a >> n } else { 0 };
                    let expected = [
                        ("and1", a & b),
                        ("or1", a | b),
                        ("xor1", a ^ b),
                        ("not1", !a & mask),
                        ("f_and", a & b),
                        ("shl1", shl(n)),
                        ("shr1", shr),
                        ("rol1", rol(n)),
                        ("ror1", rol(-n)),
                        ("shl_l", shl(n)),
                        ("rol_l", rol(n)),
                        ("shl_c", shl(3)),
                        ("rol_c", rol(3)),
                        ("lt", i128::from(a < b)),
                        ("eq", i128::from(a == b)),
                    ];
                    for (var, v) in expected {
                        assert_eq!(h.int(var), v, "{ty}: {var} of {a:#x} and {b:#x}, n {n}");
                    }
                }
            }
        }
    }
}

#[test]
fn reals() {
    let body = |ty: &str| {
        format!(
            "PROGRAM p VAR a, b, add1, sub1, mul1, div1, neg, abs1, sqrt1, min1, max1, pow1, sin1, exp1, ln1 : {ty};
             eq, lt, ge, ne : BOOL; END_VAR
             add1 := a + b; sub1 := a - b; mul1 := a * b; div1 := a / b; neg := -a; abs1 := ABS(a); sqrt1 := SQRT(a);
             min1 := MIN(a, b); max1 := MAX(a, b); pow1 := a ** b; sin1 := SIN(a); exp1 := EXP(a); ln1 := LN(a);
             eq := a = b; lt := a < b; ge := a >= b; ne := a <> b; END_PROGRAM"
        )
    };
    let values = [
        0.0,
        -0.0,
        1.0,
        -1.0,
        0.1,
        2.5,
        -3.75,
        1e10,
        -1e-10,
        f64::INFINITY,
        f64::NEG_INFINITY,
        f64::NAN,
        1e38,
    ];
    let same = |x: f64, y: f64| x == y || (x.is_nan() && y.is_nan());
    let (mut h32, mut h64) = (Host::new(&body("REAL")), Host::new(&body("LREAL")));
    for a in values {
        for b in values {
            for h in [&mut h32, &mut h64] {
                h.set("a", Value::Real(a));
                h.set("b", Value::Real(b));
                h.run();
            }
            let (x, y) = (a as f32, b as f32);
            let narrow = [
                ("add1", x + y),
                ("sub1", x - y),
                ("mul1", x * y),
                ("div1", x / y),
                ("neg", -x),
                ("abs1", x.abs()),
                ("sqrt1", x.sqrt()),
                ("pow1", libm::powf(x, y)),
                ("sin1", libm::sinf(x)),
                ("exp1", libm::expf(x)),
                ("ln1", libm::logf(x)),
            ];
            for (var, v) in narrow {
                assert!(
                    same(h32.real(var), f64::from(v)),
                    "REAL {var} of {x} and {y}: {} for {v}",
                    h32.real(var)
                );
            }
            let wide = [
                ("add1", a + b),
                ("sub1", a - b),
                ("mul1", a * b),
                ("div1", a / b),
                ("neg", -a),
                ("abs1", a.abs()),
                ("sqrt1", a.sqrt()),
                ("pow1", libm::pow(a, b)),
                ("sin1", libm::sin(a)),
                ("exp1", libm::exp(a)),
                ("ln1", libm::log(a)),
            ];
            for (var, v) in wide {
                assert!(same(h64.real(var), v), "LREAL {var} of {a} and {b}: {} for {v}", h64.real(var));
            }
            for (var, v) in [("eq", a == b), ("lt", a < b), ("ge", a >= b), ("ne", a != b)] {
                assert_eq!(h64.int(var), i128::from(v), "LREAL {a} {var} {b}");
            }
            if !a.is_nan() && !b.is_nan() {
                assert!(same(h64.real("min1"), a.min(b)) && same(h64.real("max1"), a.max(b)));
            }
        }
    }
}

/// Names, bits and signedness of all types that are carried as integers.
fn integer_like() -> Vec<(&'static str, u32, bool)> {
    INTS.into_iter().chain(BITS.into_iter().map(|(n, b)| (n, b, false))).collect()
}

#[test]
fn conversions_among_integers_and_bit_strings_keep_the_low_bits() {
    let types = integer_like();
    for (from, fbits, fsigned) in &types {
        let vars: Vec<String> = types.iter().map(|(t, ..)| format!("v_{t}, u_{t} : {t};")).collect();
        let body: Vec<String> =
            types.iter().map(|(t, ..)| format!("v_{t} := {from}_TO_{t}(x); u_{t} := TO_{t}(x);")).collect();
        let mut h = Host::new(&format!(
            "PROGRAM p VAR x : {from}; {} END_VAR {} END_PROGRAM",
            vars.join(" "),
            body.join(" ")
        ));
        for x in edges((*fbits).max(2), *fsigned).into_iter().map(|v| wrap(v, *fbits, *fsigned)) {
            h.set("x", Value::Int(x));
            h.run();
            for (to, tbits, tsigned) in &types {
                let expected = if *to == "BOOL" { i128::from(x != 0) } else { wrap(x, *tbits, *tsigned) };
                assert_eq!(h.int(&format!("v_{to}")), expected, "{from}_TO_{to}({x})");
                assert_eq!(h.int(&format!("u_{to}")), expected, "TO_{to}({x})");
            }
        }
    }
}

#[test]
fn conversions_between_integers_and_reals() {
    for (ty, bits, signed) in integer_like() {
        let text = format!(
            "PROGRAM p VAR x : {ty}; r : REAL; l : LREAL; END_VAR r := {ty}_TO_REAL(x); l := {ty}_TO_LREAL(x); END_PROGRAM"
        );
        let mut h = Host::new(&text);
        for x in edges(bits.max(2), signed).into_iter().map(|v| wrap(v, bits, signed)) {
            h.set("x", Value::Int(x));
            h.run();
            // DWORD and REAL, LWORD and LREAL exchange their bits.
            let r = if ty == "DWORD" { f32::from_bits(x as u32) } else { x as f32 };
            let l = if ty == "LWORD" { f64::from_bits(x as u64) } else { x as f64 };
            let same = |a: f64, b: f64| a == b || (a.is_nan() && b.is_nan());
            assert!(same(h.real("r"), f64::from(r)), "{ty}_TO_REAL({x})");
            assert!(same(h.real("l"), l), "{ty}_TO_LREAL({x})");
        }
    }
}

#[test]
fn reals_to_integers_round_half_to_even_and_fault_outside() {
    for (ty, bits, signed) in INTS {
        for real in ["REAL", "LREAL"] {
            let text = format!(
                "PROGRAM p VAR x : {real}; r, t : {ty}; END_VAR r := {real}_TO_{ty}(x); t := {real}_TRUNC_{ty}(x); END_PROGRAM"
            );
            let mut strict = Host::new(&text);
            let mut clamp =
                Host::with(&text, &Options { real_to_int: RealToInt::Clamp, ..Options::default() });
            let (lo, hi) = if signed {
                (-(1_i128 << (bits - 1)), (1_i128 << (bits - 1)) - 1)
            } else {
                (0, (1_i128 << bits) - 1)
            };
            let mut values: Vec<f64> = vec![
                0.0,
                0.5,
                1.5,
                2.5,
                2.4,
                3.7,
                -0.5,
                -1.5,
                100.5,
                126.5,
                127.4,
                127.5,
                128.0,
                255.5,
                1e6,
                3e9,
                -3e9,
                1e19,
                2e19,
                -1e19,
                1e300,
                f64::NAN,
                f64::INFINITY,
                f64::NEG_INFINITY,
            ];
            values.extend([
                lo as f64,
                hi as f64,
                lo as f64 - 1.0,
                hi as f64 + 1.0,
                lo as f64 - 0.5,
                hi as f64 + 0.5,
            ]);
            for x in values {
                let x = if real == "REAL" { f64::from(x as f32) } else { x };
                let rounded = x.round_ties_even();
                let fits = |v: f64| v >= lo as f64 && v < hi as f64 + 1.0 && !(bits < 64 && v > hi as f64);
                strict.set("x", Value::Real(x));
                let result = strict.scan_at(0);
                if fits(rounded) && fits(x.trunc()) {
                    result.unwrap_or_else(|f| panic!("{real}_TO_{ty}({x}): {f:?}"));
                    assert_eq!(strict.int("r"), rounded as i128, "{real}_TO_{ty}({x})");
                    assert_eq!(strict.int("t"), x.trunc() as i128, "{real}_TRUNC_{ty}({x})");
                } else {
                    let f = result.unwrap_err();
                    assert_eq!(f.id, TrapId::ConversionOutOfRange);
                    // The record holds the rounded or cut value, one of the two that did not fit.
                    assert!(
                        f.real == rounded || f.real == x.trunc() || f.real.is_nan(),
                        "{real}_TO_{ty}({x}): {f:?}"
                    );
                }
                clamp.set("x", Value::Real(x));
                clamp.run();
                let expected = if x.is_nan() {
                    0
                } else if rounded >= hi as f64 {
                    hi
                } else {
                    (rounded as i128).clamp(lo, hi)
                };
                assert_eq!(clamp.int("r"), expected, "clamped {real}_TO_{ty}({x})");
            }
        }
    }
}

#[test]
fn bits_of_reals() {
    let mut h = Host::new(
        "PROGRAM p VAR r : REAL := 1.5; l : LREAL := -2.25; d : DWORD; w : LWORD; r2 : REAL; l2 : LREAL; b : BOOL; u : UINT; END_VAR
         d := REAL_TO_DWORD(r); w := LREAL_TO_LWORD(l); r2 := DWORD_TO_REAL(d); l2 := LWORD_TO_LREAL(w);
         b := REAL_TO_BOOL(r); u := WORD_TO_UINT(REAL_TO_WORD(r)); END_PROGRAM",
    );
    h.run();
    assert_eq!(h.int("d"), i128::from(1.5_f32.to_bits()));
    assert_eq!(h.int("w"), i128::from((-2.25_f64).to_bits()));
    assert_eq!((h.real("r2"), h.real("l2"), h.int("b"), h.int("u")), (1.5, -2.25, 1, 2));
}

#[test]
fn time_arithmetic_and_conversions() {
    let ms = 1_000_000_i128;
    let mut h = Host::new(
        "PROGRAM p VAR a : TIME := T#1m; b : LTIME := LTIME#1500ms; i : INT := 3; r : REAL := 0.5; l : LREAL := 1.5;
           add1, sub1, mul1, mul2, div1, mulr, divl, neg, f_add, f_mul, f_div, min1, c1, c2, c3, c4 : TIME;
           d : DINT; s : SINT; tr : REAL; tl : LREAL; w : WORD; lt, z : BOOL; u : ULINT; END_VAR
         add1 := a + b; sub1 := b - a; mul1 := b * i; mul2 := 2 * b; div1 := a / i; mulr := b * r; divl := b / l; neg := -b;
         f_add := ADD_TIME(a, b); f_mul := MULTIME(b, 2.0); f_div := DIVTIME(b, 2); min1 := MIN(a, b);
         d := TIME_TO_DINT(b); s := TIME_TO_SINT(b); tr := TIME_TO_REAL(b); tl := TIME_TO_LREAL(T#1us); w := TIME_TO_WORD(b); u := TIME_TO_ULINT(a);
         c1 := DINT_TO_TIME(250); c2 := REAL_TO_TIME(2.5); c3 := LREAL_TO_TIME(0.000001); c4 := UINT_TO_TIME(60000);
         lt := b < a; z := TIME_TO_BOOL(T#0s); END_PROGRAM",
    );
    h.run();
    let (a, b) = (60_000 * ms, 1500 * ms);
    for (var, v) in [
        ("add1", a + b),
        ("sub1", b - a),
        ("mul1", b * 3),
        ("mul2", b * 2),
        ("div1", a / 3),
        ("mulr", b / 2),
        ("divl", 1000 * ms),
        ("neg", -b),
        ("f_add", a + b),
        ("f_mul", b * 2),
        ("f_div", b / 2),
        ("min1", b),
        ("d", 1500),
        ("s", wrap(1500, 8, true)),
        ("w", 1500),
        ("u", 60_000),
        ("c1", 250 * ms),
        ("c2", 2_500_000),
        ("c3", 1),
        ("c4", 60_000 * ms),
        ("lt", 1),
        ("z", 0),
    ] {
        assert_eq!(h.int(var), v, "{var}");
    }
    assert_eq!((h.real("tr"), h.real("tl")), (1500.0, 0.001));
}

/// Which types meet without a conversion function: written out by hand from the standard's figure.
#[test]
fn implicit_widening() {
    let order: &[(&str, &[&str])] = &[
        ("BOOL", &["BYTE", "WORD", "DWORD", "LWORD"]),
        ("BYTE", &["WORD", "DWORD", "LWORD"]),
        ("WORD", &["DWORD", "LWORD"]),
        ("DWORD", &["LWORD"]),
        ("LWORD", &[]),
        ("SINT", &["INT", "DINT", "LINT", "REAL", "LREAL"]),
        ("INT", &["DINT", "LINT", "REAL", "LREAL"]),
        ("DINT", &["LINT", "LREAL"]),
        ("LINT", &[]),
        ("USINT", &["UINT", "UDINT", "ULINT", "INT", "DINT", "LINT", "REAL", "LREAL"]),
        ("UINT", &["UDINT", "ULINT", "DINT", "LINT", "REAL", "LREAL"]),
        ("UDINT", &["ULINT", "LINT", "LREAL"]),
        ("ULINT", &[]),
        ("REAL", &["LREAL"]),
        ("LREAL", &[]),
        ("TIME", &["LTIME"]),
    ];
    for (from, wider) in order {
        for (to, _) in order {
            let text = format!("PROGRAM p VAR a : {from}; b : {to}; END_VAR b := a; END_PROGRAM");
            let allowed = from == to || wider.contains(to);
            assert_eq!(compile(&source(&text), &Options::default()).is_ok(), allowed, "{from} to {to}");
            let convert =
                format!("PROGRAM p VAR a : {from}; b : {to}; END_VAR b := {from}_TO_{to}(a); END_PROGRAM");
            assert!(compile(&source(&convert), &Options::default()).is_ok(), "{from}_TO_{to}");
        }
    }
}

/// Operands are brought to the smallest common type before the operation.
#[test]
fn mixed_operands_widen_first() {
    let mut h = Host::new(
        "PROGRAM p VAR s : SINT := -100; u : USINT := 200; w : UINT := 65535; d : DINT := -1; r : REAL := 0.5; l : LREAL;
           i1 : INT; d1 : DINT; l1 : LINT; b1, b2 : BOOL; ud : UDINT := 4000000000; oct : BYTE := 16#0F; wd, w2 : WORD := 16#FF00; END_VAR
         i1 := s + u; d1 := s + w; l1 := d + ud; b1 := d < ud; b2 := s < u; l := d + r; wd := wd OR oct; w2 := 16#00FF AND w2; END_PROGRAM",
    );
    h.run();
    for (var, v) in
        [("i1", 100), ("d1", 65435), ("l1", 3_999_999_999), ("b1", 1), ("b2", 1), ("wd", 0xff0f), ("w2", 0)]
    {
        assert_eq!(h.int(var), v, "{var}");
    }
    assert_eq!(h.real("l"), -0.5);
}

#[test]
fn literals_take_the_type_of_their_context() {
    let mut h = Host::new(
        "PROGRAM p VAR s : SINT := -128; u : ULINT := 18446744073709551615; r : REAL := 1; l : LREAL; b : BYTE := 16#F0; i : INT := 5; d : DINT;
           x, y, z : BOOL; l2 : LREAL; w : WORD; d2 : DINT; r2 : REAL; END_VAR
         l := 1.0 / 3; d := i + 100000; x := s < 0; y := u > 5; z := 3 > 2; b := b OR 2#1111; l2 := i * 0.1; w := NOT 16#FF; d2 := 2 ** 10; r2 := 0.1; END_PROGRAM",
    );
    h.run();
    assert_eq!(
        (h.int("s"), h.int("u"), h.int("b"), h.int("d"), h.int("w")),
        (-128, i128::from(u64::MAX), 0xff, 100_005, 0xff00)
    );
    assert_eq!((h.int("x"), h.int("y"), h.int("z"), h.int("d2")), (1, 1, 1, 1024));
    assert_eq!(h.real("r"), 1.0);
    assert_eq!(h.real("l"), 1.0 / 3.0);
    assert_eq!(h.real("l2"), 5.0 * 0.1);
    assert_eq!(h.real("r2"), f64::from(0.1_f32));
}

#[test]
fn short_circuit_forms_skip_the_right_side() {
    let mut h = Host::new(
        "FUNCTION f : BOOL VAR_EXTERNAL n : INT; END_VAR n := n + 1; f := TRUE; END_FUNCTION
         VAR_GLOBAL n : INT; END_VAR
         PROGRAM p VAR off, b : BOOL; on : BOOL := TRUE; END_VAR
           b := off AND_THEN f(); b := on OR_ELSE f(); b := off AND f(); b := on OR f(); b := on AND_THEN f(); END_PROGRAM",
    );
    h.run();
    assert_eq!(h.int("n"), 3);
}

#[test]
fn mux_picks_and_faults() {
    let mut h = Host::new(
        "PROGRAM p VAR k : INT; v, c : DINT; END_VAR v := MUX(k, 10, 20, 30); c := MUX(1, 10, 20); END_PROGRAM",
    );
    for (k, v) in [(0, 10), (1, 20), (2, 30)] {
        h.set("k", Value::Int(k));
        h.run();
        assert_eq!(h.int("v"), v);
    }
    assert_eq!(h.int("c"), 20);
    for k in [3, -1] {
        h.set("k", Value::Int(k));
        let f = h.scan_at(0).unwrap_err();
        assert_eq!((f.id, f.value), (TrapId::IndexOutOfBounds, k as i64));
    }
}

#[test]
fn elem_types_have_the_bytes_of_the_contract() {
    let all = [
        ("BOOL", ElemType::Bool),
        ("WORD", ElemType::Word),
        ("REAL", ElemType::Real),
        ("LREAL", ElemType::Lreal),
        ("TIME", ElemType::Time),
    ];
    for (name, elem) in all {
        let h = Host::new(&format!("PROGRAM p VAR x : {name}; END_VAR END_PROGRAM"));
        assert_eq!(h.artifact.map.symbol("p.x").unwrap().elem, elem);
    }
}
