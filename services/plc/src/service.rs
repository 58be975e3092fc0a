//! The service on the rail: what it declares, what can be found wrong without starting, and its start.
//!
//! Everything that has a clock, a descriptor or a neighbour is in here and below; the engine has none of them.

mod acks;
mod inputs;
mod jobs;
mod live;
mod load;
mod status;
mod trigger;
mod watch;

pub use jobs::MAX_SET;

use crate::config::{Config, OnFault, Trigger};
use crate::engine::{Engine, EngineError, Runtime, RuntimeError};
use crate::program::{self, ProgramError};
use crate::retain::MEMORY_BYTES;
use crate::routes::MAX_ROUTES;
use crate::setup::{MAX_AREA_BYTES, Setup};
use dinrail_iec::artifact::AreaKind;
use ipc_types::rail::RailError;
use ipc_types::stack::{Finding, ServiceEntry, Stack};
use ipc_types::topic::{EVENTS, TopicKind};
use ipc_types::units::Size;
use ipc_types::wiring::{Neighbours, TopicDecl, Wiring};
use ipc_types::{Context, units::Span};
use std::time::Duration;

/// Kind of the service in stack files.
pub const KIND: &str = "plc";
/// Name of the inherited RETAIN memory.
pub const RETAIN_FD: &str = "retain";
/// Shortest `cycle` and `min_interval`.
const MIN_CYCLE: Span = Span(100_000);

/// Why the service ended.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    #[error("service '{service}': {source}")]
    Rail { service: String, source: RailError },
    #[error("service '{service}': {source}")]
    Program { service: String, source: ProgramError },
    #[error("service '{service}': {source}")]
    Runtime { service: String, source: RuntimeError },
    #[error("service '{service}': {source}")]
    Engine { service: String, source: EngineError },
    #[error("service '{service}': {what} failed: {source}")]
    System { service: String, what: &'static str, source: std::io::Error },
}

/// Every topic it owns or reads. The inputs of field services are wired by the launcher.
pub fn topics(config: &Config, neighbours: &Neighbours) -> Wiring {
    let mut wiring = Wiring::default();
    let image: u32 =
        [config.input_bytes, config.output_bytes, config.marker_bytes].map(Config::area_bytes).iter().sum();
    wiring.topics.push(TopicDecl::new(TopicKind::Image).max_tail(image));
    for kind in [TopicKind::Writes, TopicKind::Scan, TopicKind::Keyframe, TopicKind::Jobs, TopicKind::Results]
    {
        wiring.own(kind);
    }
    wiring.read(EVENTS.to_owned(), true, "");
    wiring.plc = Some(neighbours.name.clone());
    wiring.retain_bytes = MEMORY_BYTES as u32;
    for (i, file) in config.program.iter().enumerate() {
        wiring.files.push((file.clone(), format!("program[{i}]")));
    }
    wiring
}

/// Every mistake that can be found without starting.
pub fn check(config: &Config, stack: &Stack, me: &ServiceEntry) -> Vec<Finding> {
    let mut findings = Vec::new();
    check_times(config, &me.name, &mut findings);
    for (key, size) in [
        ("input_bytes", config.input_bytes),
        ("output_bytes", config.output_bytes),
        ("marker_bytes", config.marker_bytes),
    ] {
        check_size(key, size, &me.name, &mut findings);
    }
    trigger::check(config, stack, &me.name, &mut findings);
    let setup = program::setup(config, stack, &me.name);
    check_neighbours(config, stack, &me.name, &setup, &mut findings);
    if config.route.len() > MAX_ROUTES {
        let message = format!("{} routes; at most {MAX_ROUTES} are possible", config.route.len());
        findings.push(Finding::error(&me.name, "route", message, "move some of them into a program"));
    } else if let Err((i, error)) = setup.compile_routes(&setup.plain_image()) {
        let help = "see the page on the plc service for what a [[service.route]] takes";
        findings.push(Finding::error(&me.name, &format!("route[{i}]"), error.to_string(), help));
    }
    check_retain_file(config, stack, &me.name, &mut findings);
    check_program(config, stack, &me.name, &setup, &mut findings);
    findings
}

fn check_times(config: &Config, me: &str, findings: &mut Vec<Finding>) {
    let mut error =
        |key: &str, message: String, help: &str| findings.push(Finding::error(me, key, message, help));
    if config.trigger != Trigger::CYCLE && config.cycle.is_some() {
        let message = format!("cycle and trigger = {} exclude each other", trigger::text(&config.trigger));
        error("cycle", message, "leave cycle out; max_interval says how long a scan may fail to come");
    }
    if let Some(cycle) = config.cycle.filter(|c| *c < MIN_CYCLE || c.ns() > 3_600_000_000_000) {
        error("cycle", format!("a cycle of {cycle} is not possible"), "choose 100us to 1h, e.g. \"10ms\"");
    }
    if config.min_interval < MIN_CYCLE || config.max_interval < config.min_interval {
        let message =
            format!("min_interval {} and max_interval {}", config.min_interval, config.max_interval);
        error("min_interval", message, "choose 100us <= min_interval <= max_interval");
    }
    if config.max_interval > Span::from_ms(1000) {
        let message = format!("max_interval {} is longer than 1s", config.max_interval);
        error("max_interval", message, "readers of the image would take it for dead; choose at most \"1s\"");
    }
    if let Some(watchdog) = config.watchdog.filter(|w| *w < Span::from_ms(1) || *w > Span::from_ms(60_000)) {
        error("watchdog", format!("a watchdog of {watchdog} is not possible"), "choose 1ms to 60s");
    }
    if config.input_timeout < Span::from_ms(200) {
        let message = format!("input_timeout {} is shorter than 200ms", config.input_timeout);
        error(
            "input_timeout",
            message,
            "input services repeat their values every 100ms; choose at least \"200ms\"",
        );
    }
}

fn check_size(key: &str, size: Size, me: &str, findings: &mut Vec<Finding>) {
    if size.0 == 0 || size.0 > u64::from(MAX_AREA_BYTES) {
        let message = format!("{key} = {size} is not possible");
        findings.push(Finding::error(me, key, message, "choose 1 to 65536 bytes; 8-byte steps are used"));
    }
}

fn check_neighbours(config: &Config, stack: &Stack, me: &str, setup: &Setup, findings: &mut Vec<Finding>) {
    for service in stack.services.iter().filter(|s| s.wiring.plc.as_deref() == Some(me)) {
        for range in service.wiring.inputs.iter().chain(&service.wiring.outputs) {
            let (area, bytes, key) = match range.area {
                ipc_types::wiring::Area::Input => ('I', setup.input_bytes, "input_bytes"),
                ipc_types::wiring::Area::Output => ('Q', setup.output_bytes, "output_bytes"),
                ipc_types::wiring::Area::Marker => ('M', setup.marker_bytes, "marker_bytes"),
            };
            let end = u64::from(range.byte) + u64::from(range.bytes);
            if end > u64::from(bytes) {
                let message = format!("'{}' ends at byte {end} of %{area}, which has {bytes}", range.label);
                let help = format!("place it lower, or set {key} = {end} in service '{me}'");
                findings.push(Finding::error(&service.name, &range.key, message, help));
            }
            if let Some(status) = range.status_byte.filter(|byte| *byte >= setup.input_bytes) {
                let message =
                    format!("the quality at %IB{status} lies beyond %I's {} bytes", setup.input_bytes);
                findings.push(Finding::error(&service.name, &range.key, message, "place it lower"));
            }
            if let Err(reason) = program::external(range, &service.name, config.addressing) {
                let name = range.symbol.clone().unwrap_or_default();
                let message = format!("symbol '{name}': {reason}");
                findings.push(Finding::error(
                    &service.name,
                    &range.key,
                    message,
                    "move it, or leave symbol out",
                ));
            }
        }
    }
}

fn check_retain_file(config: &Config, stack: &Stack, me: &str, findings: &mut Vec<Finding>) {
    let Some(file) = &config.retain_file else { return };
    let path = stack.dir.join(file);
    let folder = path.parent().filter(|f| !f.as_os_str().is_empty());
    if path.is_dir() {
        let message = format!("{} is a folder", path.display());
        findings.push(Finding::error(me, "retain_file", message, "name a file in a folder that exists"));
    } else if let Some(folder) = folder.filter(|f| !f.is_dir()) {
        // No error: a disk that is mounted late must not keep the plant down.
        let message = format!("the folder {} of the retain file does not exist", folder.display());
        findings.push(Finding::warning(
            me,
            "retain_file",
            message,
            "make it, or mount its disk: until then nothing is kept",
        ));
    }
    // Each would overwrite what the other keeps.
    let other = stack.services.iter().filter(|s| s.kind == KIND && s.name != me).find(|s| {
        let theirs = s.config.get("retain_file").and_then(serde_json::Value::as_str);
        theirs.is_some_and(|f| stack.dir.join(f) == path)
    });
    if let Some(other) = other {
        let message = format!("{} is the retain_file of service '{}' too", path.display(), other.name);
        findings.push(Finding::error(me, "retain_file", message, "give each plc a file of its own"));
    }
}

fn check_program(config: &Config, stack: &Stack, me: &str, setup: &Setup, findings: &mut Vec<Finding>) {
    if config.program.is_empty() {
        if config.cycle.is_none() && setup.routes.is_empty() && setup.inputs.is_empty() {
            let message = "neither program nor route: the image is all there is";
            findings.push(Finding::warning(
                me,
                "",
                message,
                "name program = [\"main.st\"], or add [[service.route]]",
            ));
        }
        return;
    }
    match program::load(&stack.dir, &config.program, setup) {
        Ok(compiled) => {
            if let Some(text) = compiled.warnings {
                findings.push(Finding::warning(
                    me,
                    "program",
                    format!("warnings of the compiler:\n{text}"),
                    "",
                ));
            }
            let map = &compiled.program.artifact.map;
            trigger::check_tasks(config, &map.tasks, me, findings);
            for task in &map.tasks {
                if let Some(ns) = task.interval_ns.filter(|ns| *ns < MIN_CYCLE.ns()) {
                    let message = format!("TASK {} has an INTERVAL of {}", task.name, Span(ns));
                    let help =
                        "the shortest period is 100us: such a task would never leave time for anything else";
                    findings.push(Finding::error(me, "program", message, help));
                }
            }
            for access in map.writes.iter().filter(|a| a.area == AreaKind::Input) {
                let message = format!("{} assigns %IB{}", map.place_text(access.statement), access.byte);
                let help = "inputs belong to the field: the value is overwritten at the next scan";
                findings.push(Finding::warning(me, "program", message, help));
            }
            let limit = crate::retain::MAX_RETAIN_BYTES as u32;
            if map.layout.retain.bytes > limit {
                let message =
                    format!("{} bytes of RETAIN; at most {limit} are kept", map.layout.retain.bytes);
                findings.push(Finding::error(me, "program", message, "declare fewer variables RETAIN"));
            }
            let built = Runtime::new().map_err(|e| e.to_string()).and_then(|runtime| {
                Engine::new(&runtime, Some(compiled.program.clone()), std::sync::Arc::new(setup.clone()))
                    .map(|_| ())
                    .map_err(|e| e.to_string())
            });
            if let Err(message) = built {
                findings.push(Finding::error(me, "program", message, "please report it with the program"));
            }
        }
        // A missing file is found by the launcher, which names the line of each file.
        Err(ProgramError::Read { source, .. }) if source.kind() == std::io::ErrorKind::NotFound => {}
        Err(error) => {
            findings.push(Finding::error(me, "program", error.to_string(), "correct the program"));
        }
    }
}

/// Default of `watchdog` for a shortest period.
fn watchdog_limit(config: &Config, shortest_ns: Option<u64>) -> Duration {
    config.watchdog.map_or_else(
        || {
            let base = shortest_ns.unwrap_or(crate::config::DEFAULT_CYCLE.ns()).saturating_mul(10);
            Duration::from_nanos(base.clamp(100_000_000, 1_000_000_000))
        },
        Span::duration,
    )
}

/// Runs the PLC until the stack stops it.
pub fn run(mut ctx: Context) -> Result<(), RunError> {
    let service = ctx.service.clone();
    let rail = |source| RunError::Rail { service: service.clone(), source };
    let config: Config = ctx.config().map_err(rail)?;
    let stack = ctx.stack.clone();
    let setup = std::sync::Arc::new(program::setup(&config, &stack, &service));
    let program = if config.program.is_empty() {
        None
    } else {
        let compiled = program::load(&stack.dir, &config.program, &setup)
            .map_err(|source| RunError::Program { service: service.clone(), source })?;
        if let Some(text) = &compiled.warnings {
            tracing::warn!("warnings of the compiler:\n{text}");
        }
        Some(compiled.program)
    };
    let shortest =
        program.as_ref().and_then(|p| p.artifact.map.tasks.iter().filter_map(|t| t.interval_ns).min());
    let (runtime, watchdog) = Runtime::with_watchdog(watchdog_limit(&config, shortest))
        .map_err(|source| RunError::Runtime { service: service.clone(), source })?;
    let engine = Engine::new(&runtime, program, setup)
        .map_err(|source| RunError::Engine { service: service.clone(), source })?;
    let mut live = live::Live::open(&mut ctx, config, runtime, engine)?;
    let result = live.run(&mut ctx);
    drop(watchdog);
    result
}

/// The start that a fault policy asks for.
fn restart_of(policy: OnFault) -> Option<ipc_types::scan_record::Start> {
    match policy {
        OnFault::Stop => None,
        OnFault::RestartWarm => Some(ipc_types::scan_record::Start::Warm),
        OnFault::RestartCold => Some(ipc_types::scan_record::Start::Cold),
    }
}

#[cfg(test)]
mod tests;
