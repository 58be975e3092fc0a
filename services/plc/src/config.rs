//! The table of a plc service in the stack file.

use crate::routes::RouteConfig;
use crate::setup::{ModByZeroName, RealToIntName};
use dinrail_iec::Addressing;
use ipc_types::units::{Size, Span};
use ipc_types::wiring::ServiceEvent;
use serde::{Deserialize, Deserializer, Serialize, de};
use std::path::PathBuf;

/// Base cycle when neither `cycle` nor a TASK says one.
pub const DEFAULT_CYCLE: Span = Span::from_ms(10);

/// What starts a scan: `"cycle"`, `"inputs"`, or `{ service = "io", event = "sync" }`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[serde(untagged)]
pub enum Trigger {
    Word(TriggerWord),
    /// An event of one service, and the clock every `max_interval`.
    Event(EventTrigger),
}

/// Words of [`Trigger`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TriggerWord {
    /// The clock.
    Cycle,
    /// A new sample of an input service, and the clock every `max_interval`.
    Inputs,
}

/// The table form of [`Trigger`].
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EventTrigger {
    /// Name of the service.
    pub service: String,
    pub event: ServiceEvent,
}

impl Trigger {
    /// The clock.
    pub const CYCLE: Self = Self::Word(TriggerWord::Cycle);
    /// Every sample of every input service.
    pub const INPUTS: Self = Self::Word(TriggerWord::Inputs);

    /// The event, if it is one.
    pub fn event(&self) -> Option<&EventTrigger> {
        match self {
            Self::Event(event) => Some(event),
            Self::Word(_) => None,
        }
    }
}

impl Default for Trigger {
    fn default() -> Self {
        Self::CYCLE
    }
}

impl<'de> Deserialize<'de> for Trigger {
    fn deserialize<D: Deserializer<'de>>(d: D) -> Result<Self, D::Error> {
        struct Visit;
        impl<'de> de::Visitor<'de> for Visit {
            type Value = Trigger;
            fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.write_str("\"cycle\", \"inputs\" or { service = \"io\", event = \"sync\" }")
            }
            fn visit_str<E: de::Error>(self, text: &str) -> Result<Trigger, E> {
                TriggerWord::deserialize(de::value::StrDeserializer::<E>::new(text))
                    .map(Trigger::Word)
                    .map_err(|_| E::invalid_value(de::Unexpected::Str(text), &self))
            }
            // A derived untagged enum would swallow which key of the table is unknown.
            fn visit_map<A: de::MapAccess<'de>>(self, map: A) -> Result<Trigger, A::Error> {
                EventTrigger::deserialize(de::value::MapAccessDeserializer::new(map)).map(Trigger::Event)
            }
        }
        d.deserialize_any(Visit)
    }
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
    /// With a `trigger` other than the clock: shortest time between two scans.
    pub min_interval: Span,
    /// Longest time between two scans; with a `trigger` other than the clock, between two runs of the implicit task.
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
            trigger: Trigger::default(),
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
