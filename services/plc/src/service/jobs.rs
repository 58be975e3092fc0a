//! Commands from the command line and other services: JSON in, commands of the engine or answers out.

use crate::engine::Engine;
use dinrail_iec::artifact::{ElemType, Symbol};
use ipc_types::payload::PlcState;
use ipc_types::scan_record::{Command, MAX_FORCES, Patch, Source, Start};
use serde_json::{Map, Value, json};
use std::path::PathBuf;

/// Most variables of one `read`.
const MAX_READ: usize = 256;
/// Most variables of one `write` or `force`.
pub const MAX_SET: usize = 64;
/// Most commands that wait for a scan.
pub(super) const MAX_ORDERS: usize = 2 * MAX_SET;
/// Wrong assignments that a refusal names.
const MAX_TOLD: usize = 8;
/// Most elements of an array that `read` shows.
const MAX_ELEMENTS: u64 = 64;

/// A command of the engine with its own text.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Order {
    Stop,
    Start(Start),
    Force(Patch, String),
    Unforce(Patch, String),
    UnforceAll,
    Set(Patch, String),
    Load(u64),
}

impl Order {
    pub(super) fn command(&self) -> Command<'_> {
        match self {
            Self::Stop => Command::Stop,
            Self::Start(kind) => Command::Start(*kind),
            Self::Force(patch, path) => Command::Force { patch: *patch, path },
            Self::Unforce(patch, path) => Command::Unforce { patch: *patch, path },
            Self::UnforceAll => Command::UnforceAll,
            Self::Set(patch, path) => Command::Set { patch: *patch, path },
            Self::Load(program_hash) => Command::Load { program_hash: *program_hash },
        }
    }
}

/// Who waits for the answer to a job.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Asker {
    pub source: Source,
    pub deadline_ns: u64,
}

/// What a job asks for.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Request {
    /// Applied in the next scan, all of them, answered after it.
    Orders(Vec<Order>),
    /// Answered at once.
    Answer(Value),
    Status,
    Keyframe,
    Load {
        path: PathBuf,
        cold: bool,
    },
}

/// Why a job fails: code of the result and text.
pub(super) type Refusal = (u32, String);

const FAILED: u32 = 1;
const NOT_SUPPORTED: u32 = 3;

/// Reads a job. `waiting` are the commands that the next scan applies before it.
pub(super) fn parse(tail: &[u8], engine: &Engine, waiting: &[(Source, Order)]) -> Result<Request, Refusal> {
    let fail = |text: String| (FAILED, text);
    let job: Value = serde_json::from_slice(tail).map_err(|e| fail(format!("the job is no JSON: {e}")))?;
    let text = |key: &str| {
        job.get(key).and_then(Value::as_str).ok_or_else(|| fail(format!("the job lacks \"{key}\" (a text)")))
    };
    let one = |order| Ok(Request::Orders(vec![order]));
    let start = |kind| one(Order::Start(kind));
    match text("do")? {
        "stop" => one(Order::Stop),
        "run" => match engine.state() {
            PlcState::Fault => start(Start::Warm),
            PlcState::Run => Ok(Request::Answer(json!(true))),
            _ => start(Start::Hot),
        },
        "cold" => start(Start::Cold),
        "warm" => start(Start::Warm),
        "hot" => start(Start::Hot),
        "force" => {
            let list = assignments(&job, engine)?;
            if !have_room(engine, waiting, &list) {
                return Err(fail(format!(
                    "more than {MAX_FORCES} forces are not possible; unforce some first"
                )));
            }
            let order = |(patch, path)| Order::Force(patch, path);
            Ok(Request::Orders(list.into_iter().map(order).collect()))
        }
        "write" => {
            let order = |(patch, path)| Order::Set(patch, path);
            Ok(Request::Orders(assignments(&job, engine)?.into_iter().map(order).collect()))
        }
        "unforce" => {
            let path = text("var")?;
            let cell = engine.resolve(path).map_err(|e| fail(e.to_string()))?;
            // Any value will do: what counts is the place, down to its bits.
            let place = cell.patch(path, &json!(0)).map_err(|e| fail(e.to_string()))?;
            let found = engine.forces().find(|(_, patch)| patch.same_place(&place));
            let Some((name, patch)) = found else { return Err(fail(format!("'{path}' is not forced"))) };
            one(Order::Unforce(*patch, name.to_owned()))
        }
        "unforce_all" => one(Order::UnforceAll),
        "read" => read(&job, engine).map(Request::Answer).map_err(fail),
        "status" => Ok(Request::Status),
        "keyframe" => Ok(Request::Keyframe),
        "load" => Ok(Request::Load {
            path: PathBuf::from(text("path")?),
            cold: job.get("cold").and_then(Value::as_bool).unwrap_or(false),
        }),
        other => {
            let known = "run, stop, cold, warm, hot, force, unforce, unforce_all, read, write, keyframe, load, status";
            Err((NOT_SUPPORTED, format!("a plc does not know the job '{other}'; it knows {known}")))
        }
    }
}

/// `var` and `value`, or `set` = a list of them: all, or none when one is wrong.
fn assignments(job: &Value, engine: &Engine) -> Result<Vec<(Patch, String)>, Refusal> {
    let fail = |text: String| (FAILED, text);
    let Some(list) = job.get("set") else {
        return Ok(vec![assignment(job, engine).map_err(fail)?]);
    };
    let list = list.as_array().ok_or_else(|| fail("\"set\" is no list of var and value".to_owned()))?;
    if list.is_empty() || list.len() > MAX_SET {
        return Err(fail(format!("{} variables in one job; 1 to {MAX_SET} are possible", list.len())));
    }
    let (mut good, mut wrong) = (Vec::with_capacity(list.len()), Vec::new());
    for one in list {
        match assignment(one, engine) {
            Ok(found) => good.push(found),
            Err(text) => wrong.push(text),
        }
    }
    if wrong.is_empty() {
        return Ok(good);
    }
    let more = wrong.len().saturating_sub(MAX_TOLD);
    wrong.truncate(MAX_TOLD);
    let more = if more > 0 { format!("; and {more} more") } else { String::new() };
    Err(fail(format!("{}{more}", wrong.join("; "))))
}

fn assignment(job: &Value, engine: &Engine) -> Result<(Patch, String), String> {
    let path = job.get("var").and_then(Value::as_str).ok_or("the job lacks \"var\"")?;
    let value = job.get("value").ok_or("the job lacks \"value\"")?;
    let cell = engine.resolve(path).map_err(|e| e.to_string())?;
    let patch = cell.patch(path, value).map_err(|e| e.to_string())?;
    Ok((patch, path.to_owned()))
}

/// Whether these can be forced once the commands that wait are applied.
fn have_room(engine: &Engine, waiting: &[(Source, Order)], list: &[(Patch, String)]) -> bool {
    let mut forced: Vec<Patch> = engine.forces().map(|(_, patch)| *patch).collect();
    let force = |forced: &mut Vec<Patch>, patch: &Patch| {
        if !forced.iter().any(|f| f.same_place(patch)) {
            forced.push(*patch);
        }
    };
    for (_, order) in waiting {
        match order {
            Order::Force(patch, _) => force(&mut forced, patch),
            Order::Unforce(patch, _) => forced.retain(|f| !f.same_place(patch)),
            Order::UnforceAll => forced.clear(),
            Order::Stop | Order::Start(_) | Order::Set(..) | Order::Load(_) => {}
        }
    }
    for (patch, _) in list {
        force(&mut forced, patch);
    }
    forced.len() <= MAX_FORCES
}

/// `var`: `{value, type}`; `vars`: `{name: value}`.
fn read(job: &Value, engine: &Engine) -> Result<Value, String> {
    if let Some(path) = job.get("var").and_then(Value::as_str) {
        let (value, type_name) = one(path, engine)?;
        return Ok(json!({ "value": value, "type": type_name }));
    }
    let list = job.get("vars").and_then(Value::as_array).ok_or("the job lacks \"var\" or \"vars\"")?;
    if list.len() > MAX_READ {
        return Err(format!("{} variables in one job; at most {MAX_READ} are possible", list.len()));
    }
    let mut out = Map::new();
    for path in list.iter().filter_map(Value::as_str) {
        out.insert(path.to_owned(), one(path, engine)?.0);
    }
    Ok(Value::Object(out))
}

fn one(path: &str, engine: &Engine) -> Result<(Value, String), String> {
    if let Some(array) =
        engine.map().and_then(|map| crate::engine::value::find(map, path)).filter(|s| !s.dims.is_empty())
    {
        return Ok((elements(array, engine), format!("ARRAY OF {}", array.elem.name())));
    }
    let cell = engine.resolve(path).map_err(|e| e.to_string())?;
    let type_name = if cell.elem == ElemType::Time { "TIME (ms)" } else { cell.elem.name() };
    Ok((cell.json(engine.memory()), type_name.to_owned()))
}

fn elements(array: &Symbol, engine: &Engine) -> Value {
    let step = array.elem.bytes();
    let count = array.elements().min(MAX_ELEMENTS) as u32;
    (0..count)
        .map(|i| {
            let offset = array.offset + i * step;
            crate::engine::value::Cell { offset, elem: array.elem, storage: array.storage }
                .json(engine.memory())
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::{Engine, Runtime, Stamps};
    use crate::program::compile_sources;
    use crate::setup::Setup;
    use std::sync::Arc;

    fn engine(text: &str) -> Engine {
        let sources = vec![dinrail_iec::Source { name: "main.st".into(), text: text.into() }];
        let program = compile_sources(sources, &Setup::default()).unwrap_or_else(|e| panic!("{e}")).program;
        let mut engine =
            Engine::new(&Runtime::new().unwrap(), Some(program), Arc::new(Setup::default())).unwrap();
        engine.begin(Stamps::default());
        engine.control(&Source::default(), &Command::Start(Start::Cold));
        engine.finish();
        engine
    }

    fn orders(engine: &Engine, job: &Value) -> Result<Vec<Order>, String> {
        match parse(&serde_json::to_vec(job).unwrap(), engine, &[]) {
            Ok(Request::Orders(orders)) => Ok(orders),
            Ok(other) => panic!("{other:?}"),
            Err((_, text)) => Err(text),
        }
    }

    const TWO: &str = "PROGRAM main VAR a, b : INT; c : BOOL; END_VAR END_PROGRAM";

    #[test]
    fn a_list_is_written_whole_or_refused_whole() {
        let engine = engine(TWO);
        let list = json!([{ "var": "a", "value": 1 }, { "var": "main.b", "value": -2 }, { "var": "%MW3", "value": 9 }]);
        let found = orders(&engine, &json!({ "do": "write", "set": list })).unwrap();
        let paths: Vec<&str> = found
            .iter()
            .map(|order| match order {
                Order::Set(_, path) => path.as_str(),
                other => panic!("{other:?}"),
            })
            .collect();
        assert_eq!(paths, ["a", "main.b", "%MW3"]);
        let forced = orders(&engine, &json!({ "do": "force", "set": list })).unwrap();
        assert!(forced.iter().all(|order| matches!(order, Order::Force(..))) && forced.len() == 3);
        assert_eq!(orders(&engine, &json!({ "do": "write", "var": "a", "value": 1 })).unwrap().len(), 1);

        let many: Vec<Value> = (0..=MAX_SET).map(|_| json!({ "var": "a", "value": 1 })).collect();
        for (set, said) in [
            (
                json!([{ "var": "a", "value": 1 }, { "var": "c", "value": 2 }, { "var": "d", "value": 0 }]),
                "'c' is BOOL; 2 does not fit: give true or false; no variable 'd'",
            ),
            (json!([{ "var": "a", "value": 1 }, { "var": "b" }]), "the job lacks \"value\""),
            (json!([]), "0 variables in one job; 1 to 64 are possible"),
            (json!(many), "65 variables in one job; 1 to 64 are possible"),
            (json!({ "a": 1 }), "\"set\" is no list of var and value"),
        ] {
            assert_eq!(orders(&engine, &json!({ "do": "write", "set": set })).unwrap_err(), said);
        }
        let wrong: Vec<Value> = (0..20).map(|i| json!({ "var": format!("x{i}"), "value": 1 })).collect();
        let said = orders(&engine, &json!({ "do": "write", "set": wrong })).unwrap_err();
        assert!(said.ends_with("no variable 'x7'; and 12 more"), "{said}");
    }

    #[test]
    fn unforce_means_the_very_bits() {
        let mut engine = engine(
            "PROGRAM main VAR a, b : INT; c : BOOL; r : REAL; l : LREAL; t : TIME; q AT %QX0.3 : BOOL; m AT %MD4 : TIME; END_VAR END_PROGRAM",
        );
        let unforce = |engine: &Engine, var: &str| orders(engine, &json!({ "do": "unforce", "var": var }));
        engine.begin(Stamps::default());
        for (path, value) in [
            ("%QX0.3", json!(true)),
            ("%QB1", json!(7)),
            ("main.a", json!(1)),
            ("c", json!(true)),
            ("r", json!(1.5)),
            ("l", json!(1)),
            ("t", json!(5)),
            ("m", json!(5)),
        ] {
            let patch = engine.resolve(path).unwrap().patch(path, &value).unwrap();
            engine.control(&Source::default(), &Command::Force { patch, path });
        }
        engine.finish();
        // A neighbour in the same byte, the byte around the bit, a bit of the byte.
        for other in ["%QX0.4", "%QB0", "%QX1.0", "b", "%MW4"] {
            assert_eq!(unforce(&engine, other).unwrap_err(), format!("'{other}' is not forced"));
        }
        for (path, name) in [
            ("%qx0.3", "%QX0.3"),
            ("main.q", "%QX0.3"),
            ("%QB1", "%QB1"),
            ("a", "main.a"),
            ("main.c", "c"),
            ("r", "r"),
            ("l", "l"),
            ("t", "t"),
            ("main.m", "m"),
        ] {
            match unforce(&engine, path).as_deref() {
                Ok([Order::Unforce(_, found)]) => assert_eq!(found, name),
                other => panic!("{path}: {other:?}"),
            }
        }
    }

    #[test]
    fn values_at_and_beyond_the_limits_of_every_type() {
        let mut engine = engine(
            "TYPE e : (one, two); END_TYPE PROGRAM main VAR b : BOOL; s : SINT; us : USINT; i : INT; u : UINT; d : DINT; ud : UDINT; l : LINT; ul : ULINT; w : WORD; lw : LWORD; r : REAL; lr : LREAL; t : TIME; k : e; m AT %MD4 : TIME; END_VAR END_PROGRAM",
        );
        let write = |engine: &mut Engine, var: &str, value: Value| -> Result<Value, String> {
            let set = orders(engine, &json!({ "do": "write", "var": var, "value": value }))?;
            engine.begin(Stamps::default());
            engine.control(&Source::default(), &set[0].command());
            engine.finish();
            Ok(one(var, engine).unwrap().0)
        };
        for (var, value) in [
            ("b", json!(true)),
            ("s", json!(-128)),
            ("s", json!(127)),
            ("us", json!(255)),
            ("i", json!(-32768)),
            ("u", json!(65535)),
            ("d", json!(-2_147_483_648_i64)),
            ("ud", json!(4_294_967_295_u32)),
            ("l", json!(i64::MIN)),
            ("l", json!(i64::MAX)),
            ("ul", json!(u64::MAX)),
            ("lw", json!(u64::MAX)),
            ("w", json!(65535)),
            ("k", json!(1)),
            ("r", json!(3.402_823_5e38)),
            ("r", json!(-0.1)),
            ("lr", json!(1e300)),
            ("t", json!(-1500)),
            ("t", json!(0.000_001)),
            ("m", json!(-2_147_483_648_i64)),
        ] {
            assert_eq!(write(&mut engine, var, value.clone()), Ok(value), "{var}");
        }
        for (var, value) in
            [("w", json!("16#FFFF")), ("us", json!("2#1010")), ("b", json!("TRUE")), ("r", json!("NaN"))]
        {
            write(&mut engine, var, value.clone()).unwrap_or_else(|e| panic!("{var} {value}: {e}"));
        }
        for (var, value) in [
            ("b", json!(2)),
            ("s", json!(128)),
            ("us", json!(-1)),
            ("i", json!(32768)),
            ("i", json!(1.5)),
            ("i", json!("five")),
            ("u", json!(null)),
            ("ud", json!(4_294_967_296_u64)),
            ("l", json!(u64::MAX)),
            ("w", json!("16#10000")),
            ("r", json!(1e39)),
            ("r", json!(-1e39)),
            ("r", json!([1])),
            ("t", json!(1e13)),
            ("m", json!(2_147_483_648_i64)),
        ] {
            let said = write(&mut engine, var, value.clone()).unwrap_err();
            assert!(said.contains("does not fit"), "{var} {value}: {said}");
        }
    }

    #[test]
    fn forces_that_wait_for_the_scan_count_too() {
        let mut engine = engine(TWO);
        let bit = |n: usize| format!("%MX{}.{}", n / 8, n % 8);
        engine.begin(Stamps::default());
        for n in 0..MAX_FORCES - 1 {
            let path = bit(n);
            let patch = engine.resolve(&path).unwrap().patch(&path, &json!(true)).unwrap();
            engine.control(&Source::default(), &Command::Force { patch, path: &path });
        }
        engine.finish();
        let force = |n: usize, waiting: &[(Source, Order)]| {
            parse(
                json!({ "do": "force", "var": bit(n), "value": true }).to_string().as_bytes(),
                &engine,
                waiting,
            )
        };
        let Ok(Request::Orders(last)) = force(MAX_FORCES, &[]) else { panic!("there is room for one") };
        let mut waiting = vec![(Source::default(), last[0].clone())];
        let (_, said) = force(MAX_FORCES + 1, &waiting).unwrap_err();
        assert_eq!(said, "more than 256 forces are not possible; unforce some first");
        assert!(
            force(MAX_FORCES, &waiting).is_ok() && force(3, &waiting).is_ok(),
            "these places are forced already"
        );
        waiting.push((Source::default(), Order::UnforceAll));
        assert!(force(MAX_FORCES + 1, &waiting).is_ok());
        let two = json!([{ "var": bit(300), "value": true }, { "var": bit(301), "value": true }]);
        let (_, said) =
            parse(json!({ "do": "force", "set": two }).to_string().as_bytes(), &engine, &[]).unwrap_err();
        assert!(said.starts_with("more than 256"), "{said}");
    }
}
