//! Commands from the command line and other services: JSON in, commands of the engine or answers out.

use crate::engine::Engine;
use dinrail_iec::artifact::{ElemType, Symbol};
use ipc_types::payload::PlcState;
use ipc_types::scan_record::{Command, Patch, Source, Start};
use serde_json::{Map, Value, json};
use std::path::PathBuf;

/// Most variables of one `read`.
const MAX_READ: usize = 256;
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
    /// Applied in the next scan, answered after it.
    Order(Order),
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

/// Reads a job.
pub(super) fn parse(tail: &[u8], engine: &Engine) -> Result<Request, Refusal> {
    let fail = |text: String| (FAILED, text);
    let job: Value = serde_json::from_slice(tail).map_err(|e| fail(format!("the job is no JSON: {e}")))?;
    let text = |key: &str| {
        job.get(key).and_then(Value::as_str).ok_or_else(|| fail(format!("the job lacks \"{key}\" (a text)")))
    };
    let start = |kind| Ok(Request::Order(Order::Start(kind)));
    match text("do")? {
        "stop" => Ok(Request::Order(Order::Stop)),
        "run" => match engine.state() {
            PlcState::Fault => start(Start::Warm),
            PlcState::Run => Ok(Request::Answer(json!(true))),
            _ => start(Start::Hot),
        },
        "cold" => start(Start::Cold),
        "warm" => start(Start::Warm),
        "hot" => start(Start::Hot),
        "force" => {
            let (patch, path) = assignment(&job, engine)?;
            if !engine.can_force(&patch) {
                return Err(fail("all 256 forces are in use; unforce some first".to_owned()));
            }
            Ok(Request::Order(Order::Force(patch, path)))
        }
        "write" => {
            let (patch, path) = assignment(&job, engine)?;
            Ok(Request::Order(Order::Set(patch, path)))
        }
        "unforce" => {
            let path = text("var")?;
            let cell = engine.resolve(path).map_err(|e| fail(e.to_string()))?;
            let found = engine.forces().find(|(name, patch)| {
                name.eq_ignore_ascii_case(path)
                    || (patch.offset == cell.offset && u32::from(patch.len) == cell.bytes())
            });
            let Some((name, patch)) = found else { return Err(fail(format!("'{path}' is not forced"))) };
            Ok(Request::Order(Order::Unforce(*patch, name.to_owned())))
        }
        "unforce_all" => Ok(Request::Order(Order::UnforceAll)),
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

fn assignment(job: &Value, engine: &Engine) -> Result<(Patch, String), Refusal> {
    let fail = |text: String| (FAILED, text);
    let path =
        job.get("var").and_then(Value::as_str).ok_or_else(|| fail("the job lacks \"var\"".to_owned()))?;
    let value = job.get("value").ok_or_else(|| fail("the job lacks \"value\"".to_owned()))?;
    let cell = engine.resolve(path).map_err(|e| fail(e.to_string()))?;
    let patch = cell.patch(path, value).map_err(|e| fail(e.to_string()))?;
    Ok((patch, path.to_owned()))
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
