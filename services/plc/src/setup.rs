//! How an engine is set up beside its program. Stands in every keyframe, so that a recording verifies alone.

use crate::config::EventTrigger;
use crate::engine::value::Image;
use crate::routes::{Route, RouteConfig, RouteError, RoutePlan};
use dinrail_iec::artifact::Area;
use dinrail_iec::{Addressing, ExternalSymbol, ModByZero, Options, RealToInt};
use ipc_types::wiring::OnBad;
use serde::{Deserialize, Serialize};

/// Largest %I, %Q or %M.
pub const MAX_AREA_BYTES: u32 = 65_536;

/// A range of %I that a field service delivers.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct InputRange {
    /// Name of the service.
    pub owner: String,
    /// Place on the field side, for messages.
    pub label: String,
    pub byte: u32,
    pub bytes: u32,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub bit: Option<u8>,
    pub on_bad: OnBad,
    /// %I byte that shows the quality.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub status_byte: Option<u32>,
}

/// A VAR_GLOBAL made from a `symbol` of the stack file.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct External {
    pub name: String,
    pub address: String,
    #[serde(rename = "type")]
    pub type_name: String,
    pub origin: String,
}

/// Everything but the program that a scan depends on.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Setup {
    /// `element`, `byte` or `openplc`.
    pub addressing: Addressing,
    pub input_bytes: u32,
    pub output_bytes: u32,
    pub marker_bytes: u32,
    #[serde(default)]
    pub inputs: Vec<InputRange>,
    #[serde(default)]
    pub routes: Vec<RouteConfig>,
    /// Tasks without INTERVAL and SINGLE wait for this event; without it they run in every scan.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub trigger: Option<EventTrigger>,
    // What the program was compiled with, so that a changed one can be compiled likewise.
    #[serde(default)]
    pub cycle_ns: Option<u64>,
    #[serde(default)]
    pub externals: Vec<External>,
    #[serde(default)]
    pub debug: bool,
    #[serde(default)]
    pub real_to_int: RealToIntName,
    #[serde(default)]
    pub mod_by_zero: ModByZeroName,
    /// Names of the program's files.
    #[serde(default)]
    pub files: Vec<String>,
}

/// Key `real_to_int`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum RealToIntName {
    #[default]
    Fault,
    Clamp,
}

/// Key `mod_by_zero`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ModByZeroName {
    #[default]
    Zero,
    Fault,
}

impl Default for Setup {
    fn default() -> Self {
        Self {
            addressing: Addressing::Element,
            input_bytes: 4096,
            output_bytes: 4096,
            marker_bytes: 4096,
            inputs: Vec::new(),
            routes: Vec::new(),
            trigger: None,
            cycle_ns: None,
            externals: Vec::new(),
            debug: false,
            real_to_int: RealToIntName::Fault,
            mod_by_zero: ModByZeroName::Zero,
            files: Vec::new(),
        }
    }
}

impl Setup {
    /// Options for the compiler.
    pub fn options(&self) -> Options {
        Options {
            addressing: self.addressing,
            input_bytes: self.input_bytes,
            output_bytes: self.output_bytes,
            marker_bytes: self.marker_bytes,
            retain_max: crate::retain::MAX_RETAIN_BYTES as u32,
            implicit_cycle_ns: self.cycle_ns,
            externals: self
                .externals
                .iter()
                .map(|e| ExternalSymbol {
                    name: e.name.clone(),
                    address: e.address.clone(),
                    type_name: e.type_name.clone(),
                    origin: e.origin.clone(),
                })
                .collect(),
            debug: self.debug,
            real_to_int: match self.real_to_int {
                RealToIntName::Fault => RealToInt::Fault,
                RealToIntName::Clamp => RealToInt::Clamp,
            },
            mod_by_zero: match self.mod_by_zero {
                ModByZeroName::Zero => ModByZero::Zero,
                ModByZeroName::Fault => ModByZero::Fault,
            },
        }
    }

    /// The image of an engine without program: behind SYSTEM, in the compiler's order.
    pub fn plain_image(&self) -> Image {
        let input = Area { offset: dinrail_iec::artifact::sys::BYTES, bytes: self.input_bytes };
        let output = Area { offset: after(input), bytes: self.output_bytes };
        let marker = Area { offset: after(output), bytes: self.marker_bytes };
        Image { input, output, marker }
    }

    /// The routes for an image.
    pub fn compile_routes(&self, image: &Image) -> Result<Vec<Route>, (usize, RouteError)> {
        let ranges: Vec<(u32, u32)> = self.inputs.iter().map(|r| (r.byte, r.bytes)).collect();
        let plan = RoutePlan {
            addressing: self.addressing,
            input: (image.input.offset, image.input.bytes),
            output: (image.output.offset, image.output.bytes),
            marker: (image.marker.offset, image.marker.bytes),
            input_ranges: &ranges,
        };
        self.routes
            .iter()
            .enumerate()
            .map(|(i, route)| Route::new(route, &plan).map_err(|e| (i, e)))
            .collect()
    }
}

/// First multiple of 8 behind an area.
pub(crate) fn after(area: Area) -> u32 {
    (area.offset + area.bytes).next_multiple_of(8)
}
