//! The scan engine: one program, one process image, one scan after the other.
//!
//! Sans-I/O: stamps, inputs, writes and commands come in, memory and a record of it come out. There is no clock,
//! no rail and no randomness in here, and **a scan is a function of what its record holds**: the same engine runs
//! live, in `trace`, and again in the verifier, where the record is its only input.
//!
//! A scan: [`Engine::begin`], then what is to be applied, in this order: [`Engine::control`],
//! [`Engine::input_begin`] .. [`Engine::input_end`], [`Engine::write`], [`Engine::trigger`]; then [`Engine::finish`], which
//! stamps, copies the inputs, forces, moves routes, runs the due tasks by priority with forces re-applied before
//! each, forces again, and closes the record. Nothing in it allocates, except when a program faults or starts.

mod changes;
mod fault;
mod keyframe;
mod machine;
mod runtime;
mod scan;
mod schedule;
#[cfg(test)]
mod tests;
pub mod value;

pub use fault::FaultReport;
pub use keyframe::RestoreError;
pub use machine::LoadError;
pub use runtime::{Runtime, RuntimeError, Watchdog};

use crate::routes::{Route, RouteError};
use crate::setup::{Setup, after};
use dinrail_iec::artifact::{Area, DebugMap, Storage, TrapId, sys};
use dinrail_iec::{Artifact, Source as SourceText};
use ipc_types::image_write;
use ipc_types::payload::{PlcState, Quality};
use ipc_types::scan_record::{
    Command, Fault, Head, MAX_FORCES, MAX_RECORD_BYTES, Outcome, Patch, Source, Start, Trigger, Writer, flag,
};
use ipc_types::wiring::{Area as ImageArea, OnBad};
use machine::{Machine, RawTrap};
use schedule::{Schedule, SingleBit};
use std::sync::Arc;
use value::{Cell, Image, VarError};
use xxhash_rust::xxh3::xxh3_64;

/// Bytes of memory that one scan's hash covers at most; larger memories are hashed slice by slice.
pub const HASH_SLICE: u32 = 65_536;
/// Changed bytes of DATA that a record holds at most.
pub const DATA_CHANGES: usize = 256;
/// Bytes of DATA that are searched for changes.
pub const DATA_SEARCHED: u32 = 65_536;

/// A compiled program with the sources it came from (may be empty: then faults quote no statement).
#[derive(Debug, Clone, PartialEq)]
pub struct Program {
    pub artifact: Artifact,
    pub sources: Vec<SourceText>,
}

/// Why an engine cannot be built.
#[derive(Debug, thiserror::Error)]
pub enum EngineError {
    #[error("{0}")]
    Load(#[from] LoadError),
    #[error("route[{index}]: {source}")]
    Route { index: usize, source: RouteError },
}

/// The stamps of a scan. All time that a scan knows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Stamps {
    /// CLOCK_MONOTONIC.
    pub t_ns: u64,
    /// 0 at a cold start, continues over warm and hot ones.
    pub plc_time_ns: i64,
    pub utc_ns: i64,
}

/// What became of a scan.
#[derive(Debug, Clone, PartialEq)]
pub struct ScanOutcome {
    pub outcome: Outcome,
    /// Why the program stopped in this scan.
    pub fault: Option<Box<FaultReport>>,
    /// Task periods that were skipped because this scan came late, and events that triggered no scan.
    pub skipped: u64,
    /// The inputs reached the program: a task ran, or without a program the routes.
    pub used_inputs: bool,
}

/// Result of a write, as `payload::Image::ack_result`.
pub mod write_result {
    pub const APPLIED: u32 = 0;
    pub const TOO_OLD: u32 = 1;
    pub const OLD_GENERATION: u32 = 2;
    pub const MALFORMED: u32 = 3;
    pub const OUTSIDE: u32 = 4;
}

enum Body {
    Machine(Box<Machine>),
    Plain(Vec<u8>),
}

impl Body {
    fn memory(&self) -> &[u8] {
        match self {
            Self::Machine(machine) => machine.memory(),
            Self::Plain(bytes) => bytes,
        }
    }
    fn memory_mut(&mut self) -> &mut [u8] {
        match self {
            Self::Machine(machine) => machine.memory_mut(),
            Self::Plain(bytes) => bytes,
        }
    }
}

/// The scan engine.
pub struct Engine {
    setup: Arc<Setup>,
    setup_json: Vec<u8>,
    program: Option<Arc<Program>>,
    program_hash: u64,
    body: Body,
    image: Image,
    retain: Area,
    data: Area,
    /// Memory as a cold start makes it, TEMP included.
    initial: Vec<u8>,
    /// %I to the searched part of DATA, as after the last scan.
    prev: Vec<u8>,
    /// %I to RETAIN, as before the tasks: what a watchdog kill goes back to.
    before: Vec<u8>,
    /// %I as the field delivered it.
    field: Vec<u8>,
    quality: Vec<u8>,
    forces: Vec<Patch>,
    force_paths: Vec<String>,
    routes: Vec<Route>,
    schedule: Schedule,
    state: PlcState,
    scan: u64,
    stamps: Stamps,
    head: Head,
    forces_changed: bool,
    /// Missed events, when this scan is triggered.
    triggered: Option<u64>,
    fault: Option<Box<FaultReport>>,
    writer: Writer,
    keyframe: Option<Writer>,
}

impl Engine {
    /// An engine in state [`PlcState::Starting`], memory initial. Without program it only has image and routes.
    pub fn new(
        runtime: &Runtime,
        program: Option<Arc<Program>>,
        setup: Arc<Setup>,
    ) -> Result<Self, EngineError> {
        let (body, image, retain, data, state_end) = match &program {
            Some(program) => with_program(runtime, program, &setup)?,
            None => without_program(&setup),
        };
        let routes =
            setup.compile_routes(&image).map_err(|(index, source)| EngineError::Route { index, source })?;
        let schedule = program.as_ref().map_or_else(Schedule::default, |p| {
            let map = &p.artifact.map;
            Schedule::new(&map.tasks, setup.trigger.is_some(), |path| single_bit(map, &image, &setup, path))
        });
        let initial = body.memory().to_vec();
        let searched = (data.offset + data.bytes.min(DATA_SEARCHED)).min(state_end);
        let mut engine = Self {
            setup_json: serde_json::to_vec(&*setup).unwrap_or_default(),
            program_hash: program.as_ref().map_or(0, |p| p.artifact.hash()),
            prev: initial[image.input.offset as usize..searched as usize].to_vec(),
            before: vec![0; (retain.offset + retain.bytes - image.input.offset) as usize],
            field: initial[span(image.input)].to_vec(),
            quality: vec![Quality::NoData as u8; setup.inputs.len()],
            forces: Vec::with_capacity(MAX_FORCES),
            force_paths: Vec::with_capacity(MAX_FORCES),
            routes,
            schedule,
            state: PlcState::Starting,
            scan: 0,
            stamps: Stamps::default(),
            head: Head::default(),
            forces_changed: false,
            triggered: None,
            fault: None,
            writer: Writer::new(MAX_RECORD_BYTES),
            keyframe: None,
            setup,
            program,
            body,
            image,
            retain,
            data,
            initial,
        };
        for range in 0..engine.quality.len() {
            engine.show_quality(range, Quality::NoData as u8);
        }
        if let Body::Machine(machine) = &mut engine.body {
            machine.prefault();
        }
        Ok(engine)
    }

    // --- what it is -----------------------------------------------------------------------------------

    pub fn state(&self) -> PlcState {
        self.state
    }
    /// Number of the last scan.
    pub fn scan(&self) -> u64 {
        self.scan
    }
    pub fn program_hash(&self) -> u64 {
        self.program_hash
    }
    pub fn program(&self) -> Option<&Arc<Program>> {
        self.program.as_ref()
    }
    pub fn map(&self) -> Option<&DebugMap> {
        self.program.as_ref().map(|p| &p.artifact.map)
    }
    pub fn setup(&self) -> &Arc<Setup> {
        &self.setup
    }
    /// Where %I, %Q and %M lie in memory.
    pub fn image(&self) -> &Image {
        &self.image
    }
    /// %I, %Q and %M, one behind the other, without gaps.
    pub fn image_bytes(&self) -> &[u8] {
        let end = self.image.marker.offset + self.image.marker.bytes;
        &self.body.memory()[self.image.input.offset as usize..end as usize]
    }
    pub fn memory(&self) -> &[u8] {
        self.body.memory()
    }
    /// Bytes of memory that are state: all but TEMP.
    pub fn state_end(&self) -> u32 {
        self.data.offset + self.data.bytes
    }
    /// Bytes of memory that every record's changes are searched in: from, to.
    pub fn searched(&self) -> (u32, u32) {
        (self.image.input.offset, self.image.input.offset + self.prev.len() as u32)
    }
    /// Where DATA begins.
    pub fn data_offset(&self) -> u32 {
        self.data.offset
    }
    /// Whether memory means the same in both.
    pub fn same_layout(&self, other: &Self) -> bool {
        match (self.map(), other.map()) {
            (Some(a), Some(b)) => {
                a.layout == b.layout
                    && a.symbols.len() == b.symbols.len()
                    && a.symbols.iter().zip(&b.symbols).all(|(x, y)| {
                        x.path.eq_ignore_ascii_case(&y.path)
                            && (x.offset, x.elem, x.storage, &x.dims)
                                == (y.offset, y.elem, y.storage, &y.dims)
                    })
            }
            (None, None) => self.image == other.image,
            _ => false,
        }
    }
    /// The RETAIN variables.
    pub fn retain(&self) -> &[u8] {
        &self.body.memory()[span(self.retain)]
    }
    /// The record of the last finished scan.
    pub fn record(&self) -> &[u8] {
        self.writer.content()
    }
    /// Why the program is in [`PlcState::Fault`].
    pub fn fault(&self) -> Option<&FaultReport> {
        self.fault.as_deref()
    }
    /// Forced variables: path as it was given, patch.
    pub fn forces(&self) -> impl Iterator<Item = (&str, &Patch)> {
        self.force_paths.iter().map(String::as_str).zip(&self.forces)
    }
    /// Quality of each input range.
    pub fn quality(&self) -> &[u8] {
        &self.quality
    }
    /// Warnings of the program since its start.
    pub fn warnings(&self) -> u32 {
        machine::u32_at(self.body.memory(), sys::WARNINGS)
    }
    /// PLC time of the next periodic task; `None` when no task has a period.
    pub fn next_task_ns(&self) -> Option<i64> {
        self.schedule.next_ns()
    }
    /// Shortest period of a task.
    pub fn shortest_period_ns(&self) -> Option<i64> {
        self.schedule.shortest_ns()
    }
    pub fn skipped_total(&self) -> u64 {
        self.schedule.skipped_total()
    }
    /// Finds a variable by path or %-address, also a symbol of the stack file that the program lacks.
    pub fn resolve(&self, path: &str) -> Result<Cell, VarError> {
        let (image, addressing) = (&self.image, self.setup.addressing);
        let found = value::resolve(self.map(), image, addressing, path);
        let of_stack = || value::of_stack(&self.setup.externals, image, addressing, path);
        match found {
            Err(VarError::Unknown { .. }) => of_stack().map_or(found, Ok),
            found => found,
        }
    }
    /// Names what the layout of RETAIN is: only memory of the same layout may be kept.
    pub fn retain_layout(&self) -> u64 {
        self.map().map_or(0, retain_layout)
    }
    /// Before the first scan: RETAIN as it was kept. `false` when the size does not fit.
    pub fn set_retain(&mut self, bytes: &[u8]) -> bool {
        if bytes.len() != self.retain.bytes as usize {
            return false;
        }
        let place = span(self.retain);
        self.body.memory_mut()[place.clone()].copy_from_slice(bytes);
        let base = self.image.input.offset as usize;
        self.prev[place.start - base..place.end - base].copy_from_slice(bytes);
        true
    }
    /// Number of the scan before the next one; for an engine that takes another's place.
    pub fn continue_from(&mut self, other: &Engine) {
        self.scan = other.scan;
        self.stamps = other.stamps;
        if self.field.len() == other.field.len() && self.quality.len() == other.quality.len() {
            self.field.copy_from_slice(&other.field);
            self.quality.copy_from_slice(&other.quality);
        }
    }
}

/// Which part of `state_end` bytes of memory is hashed in this scan.
fn hash_range(state_end: u32, scan: u64) -> (u32, u32) {
    let slices = u64::from(state_end.div_ceil(HASH_SLICE).max(1));
    let offset = (scan % slices) as u32 * HASH_SLICE;
    (offset, HASH_SLICE.min(state_end - offset))
}

fn span(area: Area) -> std::ops::Range<usize> {
    area.offset as usize..(area.offset + area.bytes) as usize
}

type Parts = (Body, Image, Area, Area, u32);

fn with_program(runtime: &Runtime, program: &Program, setup: &Setup) -> Result<Parts, LoadError> {
    let layout = program.artifact.map.layout;
    for (area, program, image) in [
        ('I', layout.input.bytes, setup.input_bytes),
        ('Q', layout.output.bytes, setup.output_bytes),
        ('M', layout.marker.bytes, setup.marker_bytes),
    ] {
        if program != image {
            return Err(LoadError::Image { area, program, image });
        }
    }
    let areas = [layout.input, layout.output, layout.marker, layout.retain, layout.data, layout.temp];
    if areas.windows(2).any(|pair| pair[1].offset < pair[0].offset.saturating_add(pair[0].bytes))
        || layout.input.offset < sys::BYTES
        || after(layout.input) != layout.output.offset
        || after(layout.output) != layout.marker.offset
    {
        return Err(LoadError::Missing("areas in the order of the contract".to_owned()));
    }
    let machine = Machine::new(runtime, &program.artifact)?;
    let image = Image { input: layout.input, output: layout.output, marker: layout.marker };
    let end = layout.data.offset + layout.data.bytes;
    Ok((Body::Machine(Box::new(machine)), image, layout.retain, layout.data, end))
}

fn without_program(setup: &Setup) -> Parts {
    let image = setup.plain_image();
    let end = after(image.marker);
    let none = Area { offset: end, bytes: 0 };
    (Body::Plain(vec![0; end as usize]), image, none, none, end)
}

fn single_bit(map: &DebugMap, image: &Image, setup: &Setup, path: &str) -> Option<SingleBit> {
    let cell = value::resolve(Some(map), image, setup.addressing, path).ok()?;
    let mask = match cell.storage {
        Storage::Bit(bit) => 1 << bit,
        _ => 0xFF,
    };
    Some(SingleBit { offset: cell.offset, mask })
}

fn retain_layout(map: &DebugMap) -> u64 {
    let mut text = format!("{}", map.layout.retain.bytes);
    for s in map.symbols.iter().filter(|s| s.area == dinrail_iec::artifact::AreaKind::Retain) {
        let at = s.offset - map.layout.retain.offset;
        text.push_str(&format!("\n{} {} {at} {:?}", s.path.to_ascii_lowercase(), s.elem.name(), s.dims));
    }
    xxh3_64(text.as_bytes())
}
