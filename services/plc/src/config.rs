//! The table of a plc service in the stack file.

use crate::routes::RouteConfig;
use crate::setup::{ModByZeroName, RealToIntName};
use dinrail_iec::Addressing;
use ipc_types::units::{Size, Span};
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// Base cycle when neither `cycle` nor a TASK says one.
pub const DEFAULT_CYCLE: Span = Span::from_ms(10);

/// What starts a scan.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Trigger {
    /// The clock.
    #[default]
    Cycle,
    /// A new sample of an input service, and the clock every `max_interval`.
    Inputs,
}

/// What follows a program fault.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum OnFault {
    /// The program stays stopped until somebody starts it.
    #[default]
    Stop,
    /// A warm start, at most once a second.
    RestartWarm,
    /// A cold start, at most once a second.
    RestartCold,
}

/// The keys of `kind = "plc"`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// Source files (or one compiled `.wasm`), relative to the stack file. None: image and routes only.
    pub program: Vec<PathBuf>,
    /// Period of the one implicit task. Not together with a TASK of the program.
    pub cycle: Option<Span>,
    pub trigger: Trigger,
    /// `trigger = "inputs"`: shortest time between two scans.
    pub min_interval: Span,
    /// `trigger = "inputs"`: longest time between two scans.
    pub max_interval: Span,
    pub input_bytes: Size,
    pub output_bytes: Size,
    pub marker_bytes: Size,
    pub addressing: Addressing,
    /// Processor time after which a task is killed. Default: 10 periods of the fastest task, 100 ms to 1 s.
    pub watchdog: Option<Span>,
    /// How long the first scan waits for inputs that have not come yet.
    pub start_timeout: Span,
    /// An input service that says nothing for so long counts as dead.
    pub input_timeout: Span,
    pub on_fault: OnFault,
    /// Where RETAIN variables are kept on disk. Default: `STACK.SERVICE.retain` beside the stack file.
    pub retain_file: Option<PathBuf>,
    pub route: Vec<RouteConfig>,
    /// Compiles breakpoint hooks in.
    pub debug: bool,
    pub real_to_int: RealToIntName,
    pub mod_by_zero: ModByZeroName,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            program: Vec::new(),
            cycle: None,
            trigger: Trigger::Cycle,
            min_interval: Span(500_000),
            max_interval: Span::from_ms(100),
            input_bytes: Size(4096),
            output_bytes: Size(4096),
            marker_bytes: Size(4096),
            addressing: Addressing::Element,
            watchdog: None,
            start_timeout: Span::from_ms(1000),
            input_timeout: Span::from_ms(500),
            on_fault: OnFault::Stop,
            retain_file: None,
            route: Vec::new(),
            debug: false,
            real_to_int: RealToIntName::Fault,
            mod_by_zero: ModByZeroName::Zero,
        }
    }
}

impl Config {
    /// Bytes of an area as the engine has it: multiples of 8, so that areas lie without gaps.
    pub fn area_bytes(size: Size) -> u32 {
        u32::try_from(size.0).unwrap_or(u32::MAX).clamp(8, crate::setup::MAX_AREA_BYTES).next_multiple_of(8)
    }
}
