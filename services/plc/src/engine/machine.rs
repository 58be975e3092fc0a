//! One program in its sandbox: memory, tasks, and what a trap left behind.

use super::runtime::{Runtime, Shared};
use dinrail_iec::artifact::{Artifact, DebugMap, TrapId, sys};
use std::sync::Arc;
use wasmtime::{InstancePre, Linker, Memory, Module, Store, Trap, TypedFunc, UpdateDeadline, WasmBacktrace};

/// Epochs that a task may see: one, which the watchdog ends. Far beyond any number of them: no watchdog.
const NO_DEADLINE: u64 = u64::MAX / 2;
const PAGE: usize = 65_536;

/// Why a program cannot be loaded.
#[derive(Debug, thiserror::Error)]
pub enum LoadError {
    #[error("the module is refused: {0:#}; compile the program again with this version")]
    Module(wasmtime::Error),
    #[error("the module cannot be started: {0:#}")]
    Instance(wasmtime::Error),
    #[error("the module has no {0}; it was not made by this version of the compiler")]
    Missing(String),
    #[error("the module's memory of {has} bytes is too small for its layout, which needs {needs}")]
    Memory { has: usize, needs: usize },
    #[error("the program has {0} tasks; at most 64 are possible")]
    Tasks(usize),
    #[error(
        "the program was compiled for {program} bytes of %{area}, the image has {image}; compile it again"
    )]
    Image { area: char, program: u32, image: u32 },
}

/// What stopped a task, as numbers.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct RawTrap {
    pub trap: u32,
    pub statement: u32,
    pub instance: u32,
    pub value: i64,
    pub real: f64,
}

pub(crate) struct Machine {
    pre: InstancePre<()>,
    store: Store<()>,
    memory: Memory,
    tasks: Vec<TypedFunc<(), ()>>,
    exports: Vec<String>,
    watchdog: Option<Arc<Shared>>,
    runtime: Runtime,
    poisoned: bool,
}

impl Machine {
    pub(crate) fn new(runtime: &Runtime, artifact: &Artifact) -> Result<Self, LoadError> {
        if artifact.map.tasks.len() > 64 {
            return Err(LoadError::Tasks(artifact.map.tasks.len()));
        }
        let module = Module::new(&runtime.wasm, &artifact.wasm).map_err(LoadError::Module)?;
        let mut linker = Linker::new(&runtime.wasm);
        imports(&mut linker).map_err(LoadError::Module)?;
        let pre = linker.instantiate_pre(&module).map_err(LoadError::Module)?;
        let exports: Vec<String> = artifact.map.tasks.iter().map(|t| t.export.clone()).collect();
        let (store, memory, tasks) = instantiate(runtime, &pre, &exports)?;
        let machine = Self {
            pre,
            store,
            memory,
            tasks,
            exports,
            watchdog: runtime.watchdog.clone(),
            runtime: runtime.clone(),
            poisoned: false,
        };
        let layout = &artifact.map.layout;
        let needs = (layout.temp.offset as usize).saturating_add(layout.temp.bytes as usize);
        let has = machine.memory().len();
        if has < needs {
            return Err(LoadError::Memory { has, needs });
        }
        Ok(machine)
    }

    pub(crate) fn memory(&self) -> &[u8] {
        self.memory.data(&self.store)
    }
    pub(crate) fn memory_mut(&mut self) -> &mut [u8] {
        self.memory.data_mut(&mut self.store)
    }

    /// A new instance, when a trap left the old one in the middle of something.
    pub(crate) fn renew(&mut self) -> Result<(), LoadError> {
        if self.poisoned {
            let keep = self.memory().to_vec();
            (self.store, self.memory, self.tasks) = instantiate(&self.runtime, &self.pre, &self.exports)?;
            self.memory_mut().copy_from_slice(&keep);
            self.poisoned = false;
        }
        Ok(())
    }

    /// Touches every page, so that no scan pays for it.
    pub(crate) fn prefault(&mut self) {
        for page in self.memory_mut().chunks_mut(4096) {
            page[0] = std::hint::black_box(page[0]);
        }
    }

    /// Runs a task once.
    pub(crate) fn run(&mut self, task: usize, map: &DebugMap) -> Result<(), RawTrap> {
        let Some(entry) = self.tasks.get(task) else { return Ok(()) };
        let result = if let Some(watchdog) = &self.watchdog {
            self.store.set_epoch_deadline(1);
            watchdog.arm();
            let result = entry.call(&mut self.store, ());
            watchdog.disarm();
            result
        } else {
            entry.call(&mut self.store, ())
        };
        match result {
            Ok(()) => Ok(()),
            Err(error) => {
                self.poisoned = true;
                Err(self.raw_trap(&error, map))
            }
        }
    }

    fn raw_trap(&self, error: &wasmtime::Error, map: &DebugMap) -> RawTrap {
        let memory = self.memory();
        let trap = u32_at(memory, sys::TRAP_ID);
        if trap != 0 {
            return RawTrap {
                trap,
                statement: u32_at(memory, sys::TRAP_STATEMENT),
                instance: u32_at(memory, sys::TRAP_INSTANCE),
                value: u64_at(memory, sys::TRAP_VALUE) as i64,
                real: f64::from_bits(u64_at(memory, sys::TRAP_REAL)),
            };
        }
        let trap = match error.downcast_ref::<Trap>() {
            Some(Trap::Interrupt) => TrapId::Watchdog,
            _ => {
                tracing::error!(
                    "the program stopped with a fault that the compiler did not foresee: {error:#}"
                );
                TrapId::Internal
            }
        };
        let statement = error.downcast_ref::<WasmBacktrace>().map_or(0, |trace| innermost(trace, map));
        RawTrap { trap: trap as u32, statement, ..RawTrap::default() }
    }
}

/// The statement of the innermost frame that has one.
fn innermost(trace: &WasmBacktrace, map: &DebugMap) -> u32 {
    for frame in trace.frames() {
        let Some(function) = map.functions.iter().find(|f| f.function == frame.func_index()) else {
            continue;
        };
        let Some(offset) = frame.func_offset() else { continue };
        let at = function.lines.partition_point(|(start, _)| *start as usize <= offset);
        if let Some((_, statement)) = at.checked_sub(1).and_then(|i| function.lines.get(i))
            && *statement != 0
        {
            return *statement;
        }
    }
    0
}

type Parts = (Store<()>, Memory, Vec<TypedFunc<(), ()>>);

fn instantiate(runtime: &Runtime, pre: &InstancePre<()>, exports: &[String]) -> Result<Parts, LoadError> {
    let mut store = Store::new(&runtime.wasm, ());
    store.set_epoch_deadline(NO_DEADLINE);
    if let Some(watchdog) = runtime.watchdog.clone() {
        store.epoch_deadline_callback(move |_| {
            Ok(if watchdog.tripped() { UpdateDeadline::Interrupt } else { UpdateDeadline::Continue(1) })
        });
    }
    let instance = pre.instantiate(&mut store).map_err(LoadError::Instance)?;
    let memory =
        instance.get_memory(&mut store, "memory").ok_or_else(|| LoadError::Missing("memory".to_owned()))?;
    let mut tasks = Vec::with_capacity(exports.len());
    for export in exports {
        let entry = instance
            .get_typed_func::<(), ()>(&mut store, export)
            .map_err(|_| LoadError::Missing(format!("task '{export}'")))?;
        tasks.push(entry);
    }
    if memory.data_size(&store) % PAGE != 0 {
        return Err(LoadError::Missing("memory of whole pages".to_owned()));
    }
    Ok((store, memory, tasks))
}

fn canonical(x: f64) -> f64 {
    if x.is_nan() { f64::from_bits(0x7FF8_0000_0000_0000) } else { x }
}
fn canonical32(x: f32) -> f32 {
    if x.is_nan() { f32::from_bits(0x7FC0_0000) } else { x }
}

/// The functions a module may import: the pinned `libm`, never the platform's.
fn imports(linker: &mut Linker<()>) -> Result<(), wasmtime::Error> {
    macro_rules! unary {
        ($($name:literal => $f64:path, $f32:path;)*) => {$(
            linker.func_wrap("dinrail", $name, |x: f64| canonical($f64(x)))?;
            linker.func_wrap("dinrail", concat!($name, "f"), |x: f32| canonical32($f32(x)))?;
        )*};
    }
    unary! {
        "sin" => libm::sin, libm::sinf;
        "cos" => libm::cos, libm::cosf;
        "tan" => libm::tan, libm::tanf;
        "asin" => libm::asin, libm::asinf;
        "acos" => libm::acos, libm::acosf;
        "atan" => libm::atan, libm::atanf;
        "exp" => libm::exp, libm::expf;
        "ln" => libm::log, libm::logf;
        "log" => libm::log10, libm::log10f;
    }
    linker.func_wrap("dinrail", "expt", |x: f64, y: f64| canonical(libm::pow(x, y)))?;
    linker.func_wrap("dinrail", "exptf", |x: f32, y: f32| canonical32(libm::powf(x, y)))?;
    // Breakpoints are not supported yet: a debug build runs, its hooks do nothing.
    linker.func_wrap("dinrail", "brk", |_statement: i32| ())?;
    Ok(())
}

pub(crate) fn u32_at(memory: &[u8], at: u32) -> u32 {
    let at = at as usize;
    memory.get(at..at + 4).and_then(|b| b.try_into().ok()).map_or(0, u32::from_le_bytes)
}
pub(crate) fn u64_at(memory: &[u8], at: u32) -> u64 {
    let at = at as usize;
    memory.get(at..at + 8).and_then(|b| b.try_into().ok()).map_or(0, u64::from_le_bytes)
}
