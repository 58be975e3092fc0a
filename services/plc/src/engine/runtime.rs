//! wasmtime, set up so that a program is the same function everywhere, and the watchdog over it.

use rustix::thread::gettid;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicI32, AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};
use wasmtime::{Config, OptLevel};

/// The compiler of a process. Cheap to clone; programs of one runtime may replace each other.
#[derive(Clone)]
pub struct Runtime {
    pub(crate) wasm: wasmtime::Engine,
    pub(crate) watchdog: Option<Arc<Shared>>,
}

/// Why the runtime is not to be had.
#[derive(Debug, thiserror::Error)]
#[error("cannot set up the WebAssembly runtime: {0:#}")]
pub struct RuntimeError(wasmtime::Error);

impl Runtime {
    /// Without watchdog: for replay, where the record says when the watchdog struck.
    pub fn new() -> Result<Self, RuntimeError> {
        let mut config = Config::new();
        config
            .cranelift_opt_level(OptLevel::Speed)
            // A NaN's bits must not depend on the machine: the memory hash covers them.
            .cranelift_nan_canonicalization(true)
            // No signal handlers beside the rail's shared memory, and a trap costs 0.5 us instead of 10 us.
            // This turns the two Spectre mitigations of memory and table access off: a program is trusted
            // not to spy on its own engine.
            .signals_based_traps(false)
            .epoch_interruption(true)
            // Relaxed SIMD may differ between processors.
            .wasm_relaxed_simd(false);
        let wasm = wasmtime::Engine::new(&config).map_err(RuntimeError)?;
        Ok(Self { wasm, watchdog: None })
    }

    /// With a watchdog that stops a task that has computed for longer than `limit`.
    pub fn with_watchdog(limit: Duration) -> Result<(Self, Watchdog), RuntimeError> {
        let mut runtime = Self::new()?;
        let shared = Arc::new(Shared::default());
        runtime.watchdog = Some(shared.clone());
        let watchdog = Watchdog::start(shared, runtime.wasm.clone(), limit);
        Ok((runtime, watchdog))
    }
}

/// What the engine's thread and the watchdog's thread share. No locks: two atomics.
#[derive(Default)]
pub(crate) struct Shared {
    /// Number of the task call that runs now, 0 = none.
    armed: AtomicU64,
    /// Number of the task call that ran too long.
    tripped: AtomicU64,
    /// Thread whose time counts.
    tid: AtomicI32,
    calls: AtomicU64,
    stop: AtomicBool,
}

impl Shared {
    pub(crate) fn arm(&self) {
        let call = self.calls.load(Ordering::Relaxed) + 1;
        self.calls.store(call, Ordering::Relaxed);
        if call == 1 {
            self.tid.store(gettid().as_raw_nonzero().get(), Ordering::Relaxed);
        }
        self.armed.store(call, Ordering::Release);
    }
    pub(crate) fn disarm(&self) {
        self.armed.store(0, Ordering::Release);
    }
    /// Whether it is the running call that is meant: an epoch that ends late must not hit the next one.
    pub(crate) fn tripped(&self) -> bool {
        let armed = self.armed.load(Ordering::Acquire);
        armed != 0 && self.tripped.load(Ordering::Acquire) == armed
    }
}

/// The watchdog's thread; it ends when this is dropped.
///
/// It counts processor time of the engine's thread, so that a loaded machine or a stopped process is not
/// mistaken for an endless loop. It strikes between 1 and 1.5 times the limit.
pub struct Watchdog {
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

impl Watchdog {
    fn start(shared: Arc<Shared>, wasm: wasmtime::Engine, limit: Duration) -> Self {
        let state = shared.clone();
        let thread = std::thread::Builder::new()
            .name("watchdog".to_owned())
            .spawn(move || watch(&state, &wasm, limit))
            .map_err(|e| tracing::error!("no watchdog: cannot start its thread: {e}"))
            .ok();
        Self { shared, thread }
    }
}

impl Drop for Watchdog {
    fn drop(&mut self) {
        self.shared.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            thread.thread().unpark();
            let _ = thread.join();
        }
    }
}

fn watch(shared: &Shared, wasm: &wasmtime::Engine, limit: Duration) {
    let tick = (limit / 4).clamp(Duration::from_millis(1), Duration::from_millis(100));
    let mut seen = 0;
    let mut since = Duration::ZERO;
    let start = Instant::now();
    while !shared.stop.load(Ordering::Relaxed) {
        std::thread::park_timeout(tick);
        let armed = shared.armed.load(Ordering::Acquire);
        if armed == 0 {
            seen = 0;
            continue;
        }
        let now = processor_time(shared.tid.load(Ordering::Relaxed)).unwrap_or_else(|| start.elapsed());
        if armed != seen {
            (seen, since) = (armed, now);
        } else if now.saturating_sub(since) >= limit {
            shared.tripped.store(armed, Ordering::Release);
            wasm.increment_epoch();
        }
    }
}

/// Time that a thread of this process has been on a processor.
fn processor_time(tid: i32) -> Option<Duration> {
    let text = std::fs::read_to_string(format!("/proc/self/task/{tid}/schedstat")).ok()?;
    text.split(' ').next()?.parse().ok().map(Duration::from_nanos)
}
