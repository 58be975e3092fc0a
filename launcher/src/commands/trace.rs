//! `dinrail trace`: a program in virtual time.

use super::plc::{assignment, plain};
use super::sources::{Program, ProgramArgs};
use super::{UsageError, println};
use anyhow::Context as _;
use clap::Args;
use dinrail_plc::program::ProgramError;
use dinrail_plc::setup::Setup;
use dinrail_plc::trace::{CaseReport, ScanTrace, Setting, TraceError, trace_case, trace_scans};
use ipc_types::units::Span;
use serde_json::{Map, Value};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

/// Most scans of one trace: every variable of each is kept.
const SCANS_MAX: u64 = 1_000_000;

/// What to run.
#[derive(Debug, Args)]
pub struct TraceArgs {
    #[command(flatten)]
    program: ProgramArgs,
    /// Inputs and expected values (JSON); exit 1 at the first difference
    #[arg(long, conflicts_with_all = ["cycle", "scans", "set"])]
    case: Option<PathBuf>,
    /// Time between scans; with --stack its plc's when left out
    #[arg(long, value_name = "DURATION", required_unless_present_any = ["case", "stack"])]
    cycle: Option<Span>,
    /// Number of scans
    #[arg(long, required_unless_present = "case")]
    scans: Option<u64>,
    /// Set a variable before a scan; the first scan is 1
    #[arg(long, value_name = "SCAN:VAR=VALUE")]
    set: Vec<String>,
}

pub fn run(args: &TraceArgs, json: bool) -> anyhow::Result<ExitCode> {
    match (&args.case, args.scans) {
        (Some(case), _) => against_case(&args.program, case, json),
        (None, Some(scans)) => self::scans(args, scans, json),
        (None, None) => Err(UsageError("give --case, or --cycle and --scans".to_owned()).into()),
    }
}

/// Nothing delivers inputs here and no event comes: both are set, or stay as they are.
fn setup_of(program: &Program) -> Setup {
    Setup { inputs: Vec::new(), trigger: None, cycle_ns: None, ..program.setup.clone() }
}

/// What the compiler says comes first, as it is.
fn told(program: &Program, error: TraceError) -> anyhow::Error {
    match error {
        TraceError::Program(ProgramError::Compile(shown)) => {
            eprintln!("{}", shown.trim_end());
            anyhow::anyhow!("the program does not compile{}", program.advice(&shown))
        }
        error => error.into(),
    }
}

/// Runs a program against a case. Exit code 0 = all values as expected, 1 = the first difference is printed.
fn against_case(program: &ProgramArgs, case: &Path, json: bool) -> anyhow::Result<ExitCode> {
    let program = Program::read(program)?;
    let text = std::fs::read_to_string(case).with_context(|| format!("cannot read {}", case.display()))?;
    let report = trace_case(program.sources.clone(), setup_of(&program), &text)
        .map_err(|e| told(&program, e))
        .with_context(|| case.display().to_string())?;
    if let Some(warnings) = &report.warnings {
        eprintln!("{warnings}");
    }
    if json {
        println(&serde_json::to_string(&report)?);
    } else {
        println(&case_text(&report));
    }
    Ok(if report.first_difference.is_none() { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

fn case_text(report: &CaseReport) -> String {
    let Some(d) = &report.first_difference else {
        return format!("{}: {} scans, {} values as expected", report.case, report.scans, report.values);
    };
    let fault = d.fault.as_ref().map(|f| format!("\nthe program had stopped: {f}")).unwrap_or_default();
    format!(
        "{}: scan {}, {}: expected {}, got {}{fault}",
        report.case,
        d.scan,
        d.variable,
        plain(&d.expected),
        plain(&d.got)
    )
}

/// Runs a program for so many scans and prints every variable after each, in text only those that changed.
/// Exit code 1 when the program faulted.
fn scans(args: &TraceArgs, scans: u64, json: bool) -> anyhow::Result<ExitCode> {
    if args.cycle.is_some_and(|cycle| cycle.ns() == 0) {
        return Err(UsageError("--cycle 0: write the time between scans, for example 10ms".to_owned()).into());
    }
    if scans == 0 || scans > SCANS_MAX {
        return Err(UsageError(format!("--scans {scans}: write 1 to {SCANS_MAX}")).into());
    }
    let settings = args.set.iter().map(|text| setting(text)).collect::<Result<Vec<_>, _>>()?;
    if let Some(late) = settings.iter().find(|s| s.scan > scans) {
        return Err(UsageError(format!("--set {}:..: there are only {scans} scans", late.scan)).into());
    }
    let program = Program::read(&args.program)?;
    let cycle_ns = args.cycle.map(|cycle| cycle.ns()).or(program.setup.cycle_ns);
    let trace = trace_scans(program.sources.clone(), setup_of(&program), cycle_ns, scans, &settings)
        .map_err(|e| told(&program, e))?;
    let mut before = Map::new();
    for scan in &trace {
        if json {
            println(&serde_json::to_string(scan)?);
        } else {
            println(&scan_text(scan, &before));
            before.clone_from(&scan.variables);
        }
    }
    let fault = trace.iter().find(|scan| scan.fault.is_some());
    Ok(if fault.is_none() { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

fn scan_text(scan: &ScanTrace, before: &Map<String, Value>) -> String {
    let changed = scan.variables.iter().filter(|(name, value)| before.get(*name) != Some(value));
    let mut parts: Vec<String> = changed.map(|(name, value)| format!("{name} = {}", plain(value))).collect();
    parts.extend(scan.fault.as_ref().map(|fault| format!("fault: {fault}")));
    format!("scan {} at {} ms: {}", scan.scan, scan.t_ms, parts.join(", "))
        .trim_end_matches([' ', ':'])
        .to_owned()
}

/// `3:Main.x=5`.
fn setting(text: &str) -> Result<Setting, UsageError> {
    let parts = text.split_once(':').and_then(|(n, rest)| Some((n.trim().parse::<u64>().ok()?, rest)));
    let Some((scan @ 1.., rest)) = parts else {
        return Err(UsageError(format!(
            "--set {text}: write SCAN:VAR=VALUE, for example 3:Start=TRUE; scans count from 1"
        )));
    };
    let (variable, value) = assignment(rest)?;
    Ok(Setting { scan, variable, value })
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn settings_are_taken_apart() {
        let expected = Setting { scan: 3, variable: "Main.x".into(), value: json!(5) };
        assert_eq!(setting("3:Main.x=5").unwrap(), expected);
        assert_eq!(setting("1:t=T#1s").unwrap().value, json!("T#1s"));
        for text in ["x=5", "0:x=5", "-1:x=5", "a:x=5", "3:x"] {
            assert!(setting(text).is_err(), "{text}");
        }
    }

    #[test]
    fn only_what_changed_is_printed() {
        let variables: Map<String, Value> =
            [("a".to_owned(), json!(1)), ("b".to_owned(), json!(true))].into_iter().collect();
        let mut scan = ScanTrace { scan: 1, t_ms: 0.0, variables, fault: None };
        assert_eq!(scan_text(&scan, &Map::new()), "scan 1 at 0 ms: a = 1, b = TRUE");
        let before = scan.variables.clone();
        scan.scan = 2;
        scan.t_ms = 2.5;
        assert_eq!(scan_text(&scan, &before), "scan 2 at 2.5 ms");
        scan.fault = Some("division by zero".into());
        assert_eq!(scan_text(&scan, &before), "scan 2 at 2.5 ms: fault: division by zero");
    }
}
