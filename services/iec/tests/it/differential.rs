//! Random typed expressions: the module against a small evaluator that works on mathematical values.

use dinrail_iec::artifact::{ElemType, TrapId};
use dinrail_iec::{Options, compile};
use proptest::prelude::*;

use crate::host::{Host, Value, source};
use ElemType::*;

const TYPES: [ElemType; 16] =
    [Bool, Byte, Word, Dword, Lword, Sint, Int, Dint, Lint, Usint, Uint, Udint, Ulint, Real, Lreal, Time];
const INTEGERS: [ElemType; 8] = [Sint, Int, Dint, Lint, Usint, Uint, Udint, Ulint];
const BITS: [ElemType; 4] = [Byte, Word, Dword, Lword];
const NUMBERS: [ElemType; 14] =
    [Byte, Word, Dword, Lword, Sint, Int, Dint, Lint, Usint, Uint, Udint, Ulint, Real, Lreal];

fn bits(t: ElemType) -> u32 {
    if t == Bool { 1 } else { t.bytes() * 8 }
}

fn signed(t: ElemType) -> bool {
    matches!(t, Sint | Int | Dint | Lint | Time)
}

fn wrap(t: ElemType, v: i128) -> i128 {
    let n = bits(t);
    let low = v & ((1 << n) - 1);
    if signed(t) && low >> (n - 1) & 1 == 1 { low - (1 << n) } else { low }
}

/// Choices made by the bytes of a random string; the text of an expression grows beside its value.
struct Maker<'a> {
    dice: std::slice::Iter<'a, u8>,
    vars: &'a [(ElemType, V)],
    /// The value is a constant expression of declared constants only.
    depth: u32,
}

/// A value: integers, bit strings, BOOL, TIME in ns; or a real of 32 or 64 bits.
#[derive(Debug, Clone, Copy, PartialEq)]
enum V {
    I(i128),
    F(f32),
    D(f64),
}

/// What stops the program.
type Fault = TrapId;
type R = Result<V, Fault>;

fn i(r: R) -> Result<i128, Fault> {
    match r? {
        V::I(v) => Ok(v),
        other => panic!("{other:?} is no integer"),
    }
}

impl Maker<'_> {
    fn roll(&mut self, n: usize) -> usize {
        usize::from(self.dice.next().copied().unwrap_or(0)) % n
    }

    fn pick(&mut self, of: &[ElemType]) -> ElemType {
        of[self.roll(of.len())]
    }

    /// An expression of exactly this type.
    fn make(&mut self, t: ElemType) -> (String, R) {
        self.depth += 1;
        let made = if self.depth > 6 || self.dice.len() == 0 { self.leaf(t) } else { self.node(t) };
        self.depth -= 1;
        made
    }

    fn leaf(&mut self, t: ElemType) -> (String, R) {
        let known: Vec<usize> = (0..self.vars.len()).filter(|n| self.vars[*n].0 == t).collect();
        if !known.is_empty() && self.roll(3) > 0 {
            let n = known[self.roll(known.len())];
            return (format!("v{n}"), Ok(self.vars[n].1));
        }
        let raw = [0, 1, 2, 3, 7, 31, 32, 64, 100, 127, 128, 255, 32767, 65535, 1 << 31, (1 << 63) - 1]
            [self.roll(16)];
        match t {
            Bool => (["FALSE", "TRUE"][(raw & 1) as usize].to_owned(), Ok(V::I(raw & 1))),
            Real => (format!("REAL#{raw}.5"), Ok(V::F(format!("{raw}.5").parse().unwrap()))),
            Lreal => (format!("LREAL#{raw}.25"), Ok(V::D(format!("{raw}.25").parse().unwrap()))),
            Time => (format!("T#{}ns", wrap(Time, raw)), Ok(V::I(wrap(Time, raw)))),
            _ => {
                let v = wrap(t, if self.roll(2) == 1 && signed(t) { -raw } else { raw });
                (format!("{}#{v}", t.name()), Ok(V::I(v)))
            }
        }
    }

    fn node(&mut self, t: ElemType) -> (String, R) {
        match self.roll(6) {
            0 => self.leaf(t),
            1 => self.conversion(t),
            2 => self.select(t),
            _ => match t {
                Bool => self.truth(),
                Real | Lreal => self.real(t),
                Time => self.time(),
                t if BITS.contains(&t) => self.bit_string(t),
                t => self.integer(t),
            },
        }
    }

    fn select(&mut self, t: ElemType) -> (String, R) {
        let (g, gv) = self.make(Bool);
        let ((a, av), (b, bv)) = (self.make(t), self.make(t));
        if self.roll(3) == 0 {
            let (k, kv) = self.make(Usint);
            let value = (|| {
                let (k, a, b) = (i(kv)?, av?, bv?);
                match k {
                    0 => Ok(a),
                    1 => Ok(b),
                    _ => Err(TrapId::IndexOutOfBounds),
                }
            })();
            // K is checked before the inputs are evaluated.
            let value = match (kv, value) {
                (Ok(V::I(k)), _) if k > 1 => Err(TrapId::IndexOutOfBounds),
                (_, v) => v,
            };
            return (format!("MUX({k}, {a}, {b})"), value);
        }
        // The inputs first, then G.
        let value = (|| {
            let (a, b) = (bv, av);
            // IN1 is pushed before IN0.
            let one = a?;
            let zero = b?;
            Ok(if i(gv)? != 0 { one } else { zero })
        })();
        (format!("SEL({g}, {a}, {b})"), value)
    }

    fn integer(&mut self, t: ElemType) -> (String, R) {
        let kind = self.roll(9);
        let (a, av) = self.make(t);
        if kind == 0 && signed(t) {
            return (format!("(-{a})"), i(av).map(|x| V::I(wrap(t, -x))));
        }
        if kind == 1 && signed(t) {
            return (format!("ABS({a})"), i(av).map(|x| V::I(wrap(t, x.abs()))));
        }
        let (b, bv) = self.make(t);
        let pair = (|| Ok((i(av)?, i(bv)?)))();
        let (text, value): (String, Result<i128, Fault>) = match kind {
            2 => (format!("({a} + {b})"), pair.map(|(x, y)| x + y)),
            3 => (format!("({a} - {b})"), pair.map(|(x, y)| x - y)),
            4 => (format!("({a} * {b})"), pair.map(|(x, y)| x.wrapping_mul(y))),
            5 => (
                format!("({a} / {b})"),
                pair.and_then(|(x, y)| if y == 0 { Err(TrapId::DivisionByZero) } else { Ok(x / y) }),
            ),
            6 => (format!("({a} MOD {b})"), pair.map(|(x, y)| if y == 0 { 0 } else { x % y })),
            7 => {
                let (c, cv) = self.make(t);
                let v = pair.and_then(|(x, y)| Ok(x.max(y).min(i(cv)?)));
                (format!("LIMIT({b}, {a}, {c})"), v)
            }
            _ => (format!("MAX({a}, {b})"), pair.map(|(x, y)| x.max(y))),
        };
        (text, value.map(|v| V::I(wrap(t, v))))
    }

    fn bit_string(&mut self, t: ElemType) -> (String, R) {
        let kind = self.roll(8);
        let (a, av) = self.make(t);
        let n = i128::from(bits(t));
        if kind < 4 {
            let counter = self.pick(&INTEGERS);
            let (c, cv) = self.make(counter);
            let name = ["SHL", "SHR", "ROL", "ROR"][kind];
            let value = (|| {
                let (x, by) = (i(av)?, i(cv)?);
                let turn = by.rem_euclid(n);
                let inside = (0..n).contains(&by);
                Ok(V::I(wrap(
                    t,
                    match kind {
                        0 | 1 if !inside => 0,
                        0 => x << by,
                        1 => x >> by,
                        2 => x << turn | x >> (n - turn),
                        _ => x >> turn | x << (n - turn),
                    },
                )))
            })();
            return (format!("{name}({a}, {c})"), value);
        }
        if kind == 4 {
            return (format!("(NOT {a})"), i(av).map(|x| V::I(wrap(t, !x))));
        }
        let (b, bv) = self.make(t);
        let op = ["AND", "OR", "XOR"][kind - 5];
        let value = (|| {
            let (x, y) = (i(av)?, i(bv)?);
            Ok(V::I([x & y, x | y, x ^ y][kind - 5]))
        })();
        (format!("({a} {op} {b})"), value)
    }

    fn truth(&mut self) -> (String, R) {
        let kind = self.roll(8);
        if kind < 5 {
            let t = self.pick(&TYPES);
            let ((a, av), (b, bv)) = (self.make(t), self.make(t));
            let op = self.roll(6);
            let text = format!("({a} {} {b})", ["<", "<=", ">", ">=", "=", "<>"][op]);
            let value = (|| {
                let order = match (av?, bv?) {
                    (V::I(x), V::I(y)) => Some(x.cmp(&y)),
                    (V::F(x), V::F(y)) => x.partial_cmp(&y),
                    (V::D(x), V::D(y)) => x.partial_cmp(&y),
                    other => panic!("{other:?}"),
                };
                use std::cmp::Ordering::*;
                let holds = match (op, order) {
                    (5, o) => o != Some(Equal),
                    (_, None) => false,
                    (0, Some(o)) => o == Less,
                    (1, Some(o)) => o != Greater,
                    (2, Some(o)) => o == Greater,
                    (3, Some(o)) => o != Less,
                    (_, Some(o)) => o == Equal,
                };
                Ok(V::I(i128::from(holds)))
            })();
            return (text, value);
        }
        let (a, av) = self.make(Bool);
        if kind == 5 {
            return (format!("(NOT {a})"), i(av).map(|x| V::I(1 - x)));
        }
        let (b, bv) = self.make(Bool);
        let (op, value): (&str, Result<i128, Fault>) = match (kind, self.roll(3)) {
            (6, 0) => ("AND_THEN", i(av).and_then(|x| if x == 0 { Ok(0) } else { i(bv) })),
            (6, _) => ("OR_ELSE", i(av).and_then(|x| if x == 1 { Ok(1) } else { i(bv) })),
            (_, n) => {
                let pair = (|| Ok((i(av)?, i(bv)?)))();
                (["AND", "OR", "XOR"][n], pair.map(|(x, y)| [x & y, x | y, x ^ y][n]))
            }
        };
        (format!("({a} {op} {b})"), value.map(V::I))
    }

    fn real(&mut self, t: ElemType) -> (String, R) {
        let kind = self.roll(6);
        let ((a, av), (b, bv)) = (self.make(t), self.make(t));
        if kind == 4 {
            let value = av.map(|x| match x {
                V::F(x) => V::F(-x),
                V::D(x) => V::D(-x),
                V::I(_) => panic!(),
            });
            return (format!("(-{a})"), value);
        }
        if kind == 5 {
            let value = av.map(|x| match x {
                V::F(x) => V::F(x.abs().sqrt()),
                V::D(x) => V::D(x.abs().sqrt()),
                V::I(_) => panic!(),
            });
            return (format!("SQRT(ABS({a}))"), value);
        }
        let value = (|| {
            Ok(match (av?, bv?) {
                (V::F(x), V::F(y)) => V::F([x + y, x - y, x * y, x / y][kind]),
                (V::D(x), V::D(y)) => V::D([x + y, x - y, x * y, x / y][kind]),
                other => panic!("{other:?}"),
            })
        })();
        (format!("({a} {} {b})", ["+", "-", "*", "/"][kind]), value)
    }

    fn time(&mut self) -> (String, R) {
        let kind = self.roll(4);
        let (a, av) = self.make(Time);
        if kind < 2 {
            let (b, bv) = self.make(Time);
            let value = (|| {
                let (x, y) = (i(av)?, i(bv)?);
                Ok(V::I(wrap(Time, if kind == 0 { x + y } else { x - y })))
            })();
            return (format!("({a} {} {b})", ["+", "-"][kind]), value);
        }
        let t = self.pick(&[Sint, Int, Dint, Lint, Usint, Uint, Udint]);
        let (b, bv) = self.make(t);
        let value = (|| {
            let (x, y) = (i(av)?, i(bv)?);
            match kind {
                2 => Ok(V::I(wrap(Time, x.wrapping_mul(y)))),
                _ if y == 0 => Err(TrapId::DivisionByZero),
                _ => Ok(V::I(wrap(Time, x / y))),
            }
        })();
        (format!("({a} {} {b})", ["*", "/"][kind - 2]), value)
    }

    fn conversion(&mut self, t: ElemType) -> (String, R) {
        let from = match t {
            Bool | Time => self.pick(&INTEGERS),
            _ => self.pick(&NUMBERS),
        };
        if from == t {
            return self.leaf(t);
        }
        let (a, av) = self.make(from);
        let trunc = matches!(from, Real | Lreal) && INTEGERS.contains(&t) && self.roll(2) == 0;
        let name = if trunc { "TRUNC" } else { "TO" };
        (format!("{}_{name}_{}({a})", from.name(), t.name()), av.and_then(|v| convert(v, from, t, trunc)))
    }
}

fn convert(v: V, from: ElemType, to: ElemType, trunc: bool) -> R {
    if (from, to) == (Real, Dword) || (from, to) == (Lreal, Lword) {
        return Ok(match v {
            V::F(x) => V::I(i128::from(if x.is_nan() { 0x7FC0_0000 } else { x.to_bits() })),
            V::D(x) => V::I(i128::from(if x.is_nan() { 0x7FF8_0000_0000_0000 } else { x.to_bits() })),
            V::I(_) => panic!(),
        });
    }
    Ok(match (v, to) {
        (V::I(x), Dword) if from == Real => V::I(x),
        (V::I(x), Real) if from == Dword => V::F(f32::from_bits(x as u32)),
        (V::I(x), Lreal) if from == Lword => V::D(f64::from_bits(x as u64)),
        (V::I(x), Real) => V::F(x as f32),
        (V::I(x), Lreal) => V::D(x as f64),
        (V::I(x), Bool) => V::I(i128::from(x != 0)),
        (V::I(x), Time) => V::I(wrap(Time, wrap(Time, x).wrapping_mul(1_000_000))),
        (V::I(x), t) => V::I(wrap(t, x)),
        (V::F(x), Lreal) => V::D(f64::from(x)),
        (V::D(x), Real) => V::F(x as f32),
        (v, t) => {
            let x = match v {
                V::F(x) => f64::from(x),
                V::D(x) => x,
                V::I(_) => panic!(),
            };
            let whole = if trunc { x.trunc() } else { x.round_ties_even() };
            // Exact below 2^100; what is larger fits no type.
            if whole.is_nan() || whole.abs() > 1e30 || wrap(t, whole as i128) != whole as i128 {
                return Err(TrapId::ConversionOutOfRange);
            }
            V::I(whole as i128)
        }
    })
}

fn variables() -> impl Strategy<Value = Vec<(ElemType, V)>> {
    let one = (0_usize..16, any::<u64>(), 0_u8..4).prop_map(|(t, raw, how)| {
        let t = TYPES[t];
        let small = i128::from(raw % 9) - 4;
        let v = match t {
            Real if how == 0 => V::F(f32::from_bits(raw as u32)),
            Real => V::F(small as f32 * 0.5),
            Lreal if how == 0 => V::D(f64::from_bits(raw)),
            Lreal => V::D(small as f64 * 0.5),
            t if how < 2 => V::I(wrap(t, i128::from(raw))),
            t => V::I(wrap(t, small)),
        };
        // Only one NaN is ever in memory.
        (
            t,
            match v {
                V::F(x) if x.is_nan() => V::F(f32::from_bits(0x7FC0_0000)),
                V::D(x) if x.is_nan() => V::D(f64::from_bits(0x7FF8_0000_0000_0000)),
                v => v,
            },
        )
    });
    prop::collection::vec(one, 1..8)
}

fn to_host(v: V) -> Value {
    match v {
        V::I(x) => Value::Int(x),
        V::F(x) => Value::Real(f64::from(x)),
        V::D(x) => Value::Real(x),
    }
}

fn same(a: Value, b: Value) -> bool {
    match (a, b) {
        (Value::Real(x), Value::Real(y)) => (x.is_nan() && y.is_nan()) || x.to_bits() == y.to_bits(),
        (a, b) => a == b,
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: crate::random::cases(400), ..ProptestConfig::default() })]

    #[test]
    fn typed_expressions(vars in variables(), pick in 0_usize..16, dice in prop::collection::vec(any::<u8>(), 1..80), debug in any::<bool>()) {
        let t = TYPES[pick];
        let (text, expected) = Maker { dice: dice.iter(), vars: &vars, depth: 0 }.make(t);
        let declared: String = vars.iter().enumerate().map(|(n, (t, _))| format!("v{n} : {}; ", t.name())).collect();
        let program = format!("PROGRAM p VAR {declared}r : {}; END_VAR\nr := {text};\nEND_PROGRAM", t.name());
        let options = Options { debug, ..Options::default() };
        match compile(&source(&program), &options) {
            Ok(_) => {}
            // A division that the compiler sees to be by zero, a K of MUX that it sees to be outside.
            Err(d) => {
                let known = |c: &str| ["E0405", "E0406"].contains(&c) || c.starts_with('W');
                prop_assert!(d.items().iter().all(|i| known(i.code)), "{program}\n{}", d.render(false));
                return Ok(());
            }
        }
        let mut h = Host::with(&program, &options);
        for (n, (_, v)) in vars.iter().enumerate() {
            h.set(&format!("v{n}"), to_host(*v));
        }
        match (h.scan_at(0), expected) {
            (Ok(()), Ok(v)) => {
                let got = h.get("r");
                prop_assert!(same(got, to_host(v)), "{program}\ngot {got:?}, expected {v:?}; {vars:?}");
            }
            // Which of two faults comes first is not laid down.
            (Err(_), Err(_)) => {}
            (got, expected) => prop_assert!(false, "{program}\ngot {got:?}, expected {expected:?}; {vars:?}"),
        }
    }
}
