//! A program in virtual time, scan by scan: for `dinrail trace` and for tests of programs.
//!
//! Scan n happens at `(n - 1) * step`; nothing of the machine's time enters it but the watchdog.

use crate::engine::value::{Cell, VarError};
use crate::engine::{Engine, EngineError, Program, Runtime, RuntimeError, Stamps};
use crate::program::{ProgramError, compile_sources};
use crate::setup::Setup;
use dinrail_iec::Source as SourceText;
use dinrail_iec::artifact::{ElemType, Symbol};
use ipc_types::scan_record::{Command, Source, Start, Trigger};
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};
use std::sync::Arc;
use std::time::Duration;

/// A task that computes for so long is killed.
pub const WATCHDOG: Duration = Duration::from_secs(1);
/// UTC of virtual time 0: 2026-01-01.
const UTC_START_NS: i64 = 1_767_225_600_000_000_000;
/// Step when neither the caller nor a TASK gives one.
const DEFAULT_STEP_NS: u64 = 10_000_000;
/// Elements of one array that a trace shows.
const MAX_ELEMENTS: u64 = 4096;

/// Why there is no trace.
#[derive(Debug, thiserror::Error)]
pub enum TraceError {
    #[error("{0}")]
    Program(#[from] ProgramError),
    #[error("{0}")]
    Runtime(#[from] RuntimeError),
    #[error("{0}")]
    Engine(#[from] EngineError),
    #[error("the case is no JSON of a case: {0}")]
    Case(#[from] serde_json::Error),
    #[error("scan {scan}: {source}")]
    Variable { scan: u64, source: VarError },
}

/// A case file: what to set before each scan and what must be seen after it.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct Case {
    pub case: String,
    pub task_interval_ms: f64,
    pub scans: Vec<CaseScan>,
}

/// One scan of a case. TIME values are milliseconds.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct CaseScan {
    pub scan: u64,
    #[serde(default)]
    pub t_ms: Option<f64>,
    #[serde(rename = "in", default)]
    pub inputs: Map<String, Value>,
    #[serde(rename = "out", default)]
    pub outputs: Map<String, Value>,
}

/// Where a program left its case.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CaseDifference {
    pub scan: u64,
    pub variable: String,
    pub expected: Value,
    pub got: Value,
    /// The fault, if the program stopped in or before this scan.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub fault: Option<String>,
}

/// What became of a case.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CaseReport {
    pub case: String,
    pub scans: u64,
    /// Values compared.
    pub values: u64,
    pub first_difference: Option<CaseDifference>,
    pub warnings: Option<String>,
}

/// Every variable after one scan.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ScanTrace {
    pub scan: u64,
    pub t_ms: f64,
    pub variables: Map<String, Value>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub fault: Option<String>,
}

/// A value to set before a scan.
#[derive(Debug, Clone, PartialEq)]
pub struct Setting {
    pub scan: u64,
    pub variable: String,
    pub value: Value,
}

/// A program in virtual time.
pub struct Tracer {
    engine: Engine,
    step_ns: u64,
    warnings: Option<String>,
    _watchdog: crate::engine::Watchdog,
}

impl Tracer {
    /// Compiles and starts cold. `step_ns` defaults to the shortest task's period, else 10 ms.
    pub fn new(sources: Vec<SourceText>, setup: Setup, step_ns: Option<u64>) -> Result<Self, TraceError> {
        let compiled = compile_sources(sources, &setup)?;
        let mut tracer = Self::with_program(compiled.program, setup, step_ns)?;
        tracer.warnings = compiled.warnings;
        Ok(tracer)
    }

    /// With a program that is compiled already.
    pub fn with_program(
        program: Arc<Program>,
        setup: Setup,
        step_ns: Option<u64>,
    ) -> Result<Self, TraceError> {
        let (runtime, watchdog) = Runtime::with_watchdog(WATCHDOG)?;
        let engine = Engine::new(&runtime, Some(program), Arc::new(setup))?;
        let step = step_ns.filter(|ns| *ns > 0);
        let shortest = engine.shortest_period_ns().and_then(|ns| u64::try_from(ns).ok());
        let step_ns = step.or(shortest).unwrap_or(DEFAULT_STEP_NS);
        Ok(Self { engine, step_ns, warnings: None, _watchdog: watchdog })
    }

    pub fn engine(&self) -> &Engine {
        &self.engine
    }

    /// Virtual time of the last scan in ns.
    pub fn time_ns(&self) -> u64 {
        self.engine.scan().saturating_sub(1) * self.step_ns
    }

    /// Finds a variable: by path, %-address, or name in the program instance.
    pub fn resolve(&self, name: &str) -> Result<Cell, VarError> {
        if let Some(map) = self.engine.map() {
            // A program's own variable before one of a function block in it with the same name.
            for program in map.tasks.iter().flat_map(|task| &task.programs) {
                let path = format!("{program}.{name}");
                if map
                    .symbols
                    .iter()
                    .any(|s| s.path.eq_ignore_ascii_case(path.split('[').next().unwrap_or(&path)))
                {
                    return self.engine.resolve(&path);
                }
            }
        }
        self.engine.resolve(name)
    }

    /// Sets these variables and runs one scan.
    pub fn scan<'s>(
        &mut self,
        settings: impl IntoIterator<Item = (&'s str, &'s Value)>,
    ) -> Result<(), TraceError> {
        let scan = self.engine.scan() + 1;
        let mut patches = Vec::new();
        for (name, value) in settings {
            let cell = self.resolve(name).map_err(|source| TraceError::Variable { scan, source })?;
            let patch = cell.patch(name, value).map_err(|source| TraceError::Variable { scan, source })?;
            patches.push((name, patch));
        }
        let t_ns = (scan - 1) * self.step_ns;
        let utc_ns = UTC_START_NS.saturating_add_unsigned(t_ns);
        self.engine.begin(Stamps { t_ns, plc_time_ns: t_ns as i64, utc_ns });
        let source = Source::default();
        if scan == 1 {
            self.engine.control(&source, &Command::Start(Start::Cold));
        }
        for (path, patch) in patches {
            self.engine.control(&source, &Command::Set { patch, path });
        }
        if self.engine.setup().trigger.is_some() {
            self.engine.trigger(&Trigger { source, count: scan, ..Trigger::default() });
        }
        self.engine.finish();
        Ok(())
    }

    /// The fault that stopped the program.
    pub fn fault(&self) -> Option<String> {
        self.engine.fault().map(|f| f.message.clone())
    }

    /// Every variable of the program now.
    pub fn variables(&self) -> Map<String, Value> {
        let symbols = self.engine.map().map_or(&[][..], |map| &map.symbols);
        symbols.iter().map(|s| (s.path.clone(), self.value(s))).collect()
    }

    fn value(&self, symbol: &Symbol) -> Value {
        let memory = self.engine.memory();
        let cell = Cell { offset: symbol.offset, elem: symbol.elem, storage: symbol.storage };
        if symbol.dims.is_empty() {
            return cell.json(memory);
        }
        let step = symbol.elem.bytes();
        let count = symbol.elements().min(MAX_ELEMENTS) as u32;
        (0..count).map(|i| Cell { offset: symbol.offset + i * step, ..cell }.json(memory)).collect()
    }
}

/// Runs a program against a case and stops at the first difference.
pub fn trace_case(sources: Vec<SourceText>, setup: Setup, case_json: &str) -> Result<CaseReport, TraceError> {
    let case: Case = serde_json::from_str(case_json)?;
    let step_ns = (case.task_interval_ms * 1e6).round() as u64;
    let mut tracer = Tracer::new(sources, setup, Some(step_ns))?;
    let mut report = CaseReport {
        case: case.case.clone(),
        scans: 0,
        values: 0,
        first_difference: None,
        warnings: tracer.warnings.clone(),
    };
    for scan in &case.scans {
        // Scans that the case leaves out run as well.
        while tracer.engine.scan() + 1 < scan.scan {
            tracer.scan([])?;
            report.scans += 1;
        }
        tracer.scan(scan.inputs.iter().map(|(name, value)| (name.as_str(), value)))?;
        report.scans += 1;
        for (name, expected) in &scan.outputs {
            let cell =
                tracer.resolve(name).map_err(|source| TraceError::Variable { scan: scan.scan, source })?;
            let got = cell.json(tracer.engine.memory());
            report.values += 1;
            if !equal(&cell, expected, &got) {
                report.first_difference = Some(CaseDifference {
                    scan: scan.scan,
                    variable: name.clone(),
                    expected: expected.clone(),
                    got,
                    fault: tracer.fault(),
                });
                return Ok(report);
            }
        }
    }
    Ok(report)
}

/// All variables of every scan.
pub fn trace_scans(
    sources: Vec<SourceText>,
    setup: Setup,
    step_ns: Option<u64>,
    scans: u64,
    settings: &[Setting],
) -> Result<Vec<ScanTrace>, TraceError> {
    let mut tracer = Tracer::new(sources, setup, step_ns)?;
    let mut out = Vec::new();
    for scan in 1..=scans {
        let now = settings.iter().filter(|s| s.scan == scan).map(|s| (s.variable.as_str(), &s.value));
        tracer.scan(now)?;
        out.push(ScanTrace {
            scan,
            t_ms: tracer.time_ns() as f64 / 1e6,
            variables: tracer.variables(),
            fault: tracer.fault(),
        });
    }
    Ok(out)
}

/// Cases are written with as many digits as people write: REAL agrees to 1e-6, LREAL to 1e-12, relative.
fn equal(cell: &Cell, expected: &Value, got: &Value) -> bool {
    match cell.elem {
        ElemType::Real | ElemType::Lreal => {
            let (Some(a), Some(b)) = (expected.as_f64(), got.as_f64()) else { return expected == got };
            let tolerance = if cell.elem == ElemType::Real { 1e-6 } else { 1e-12 };
            (a - b).abs() <= tolerance * a.abs().max(b.abs()).max(1e-300)
        }
        ElemType::Bool => match expected {
            Value::Number(n) => got == &Value::Bool(n.as_i64() == Some(1)),
            _ => expected == got,
        },
        _ => match (expected.as_f64(), got.as_f64()) {
            // 64-bit integers as integers, the rest also when written 10.0.
            (Some(a), Some(b)) if !(expected.is_i64() || expected.is_u64()) => a == b,
            _ => expected == got,
        },
    }
}

#[cfg(test)]
mod tests;
