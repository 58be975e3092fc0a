//! What is measured on, and what processes cost: `/proc`.

use rustix::param::clock_ticks_per_second;
use rustix::thread::{CpuSet, Pid, sched_getaffinity, sched_setaffinity};
use serde::{Deserialize, Serialize};
use std::fmt;
use std::fs::read_to_string;
use std::time::Instant;

/// The machine of a report.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Machine {
    pub cpu: String,
    pub cores: usize,
    pub kernel: String,
    /// Runnable processes over the last minute, before the bench: figures of a busy machine mean little.
    pub load: f64,
}

impl Machine {
    pub fn read() -> Self {
        let info = read_to_string("/proc/cpuinfo").unwrap_or_default();
        let model = |key: &str| {
            let line = info.lines().find(|l| l.starts_with(key))?;
            Some(line.split_once(':')?.1.trim().to_owned())
        };
        // Arm has no model name.
        let cpu = model("model name").or_else(|| model("Model")).or_else(|| model("CPU part"));
        let kernel = read_to_string("/proc/sys/kernel/osrelease").unwrap_or_default();
        let load = read_to_string("/proc/loadavg").unwrap_or_default();
        Self {
            cpu: cpu.unwrap_or_else(|| std::env::consts::ARCH.to_owned()),
            cores: std::thread::available_parallelism().map_or(0, Into::into),
            kernel: kernel.trim().to_owned(),
            load: load.split(' ').next().and_then(|n| n.parse().ok()).unwrap_or(f64::NAN),
        }
    }
}

impl fmt::Display for Machine {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { cpu, cores, kernel, load } = self;
        write!(f, "{cpu}, {cores} cores, Linux {kernel}, load {load:.2} before")
    }
}

/// CPU time of a process so far, all its threads, in seconds; `None` when it is gone.
///
/// From the scheduler's own count in ns: `/proc/PID/stat` counts in ticks, which a process that works in step with
/// a clock can be missed by.
pub fn cpu_seconds(pid: u32) -> Option<f64> {
    let mut ns = 0;
    for task in std::fs::read_dir(format!("/proc/{pid}/task")).ok()?.flatten() {
        // A thread may end between the listing and here.
        let text = read_to_string(task.path().join("schedstat")).unwrap_or_default();
        ns += text.split(' ').next().and_then(|n| n.parse::<u64>().ok()).unwrap_or(0);
    }
    Some(ns as f64 / 1e9)
}

/// CPU time of the whole machine and of this bench with its stack, in seconds.
pub struct MachineMeter {
    began: Instant,
    busy: f64,
    own: f64,
}

impl MachineMeter {
    pub fn start() -> Self {
        Self { began: Instant::now(), busy: busy_seconds(), own: own_seconds() }
    }

    /// Per cent of one CPU that everything else on the machine took. Call it when the stack has ended: only then
    /// its time counts as the bench's.
    pub fn others(&self) -> f64 {
        let others = (busy_seconds() - self.busy) - (own_seconds() - self.own);
        others.max(0.0) / self.began.elapsed().as_secs_f64() * 100.0
    }
}

/// All CPUs together, time taken by the hypervisor included.
fn busy_seconds() -> f64 {
    let text = read_to_string("/proc/stat").unwrap_or_default();
    let fields = text.lines().next().unwrap_or_default().split_whitespace().skip(1);
    let ticks: Vec<f64> = fields.map_while(|n| n.parse().ok()).collect();
    // user nice system idle iowait irq softirq steal; guest time is in user time already.
    let busy = [0, 1, 2, 5, 6, 7].iter().filter_map(|i| ticks.get(*i)).sum::<f64>();
    busy / clock_ticks_per_second() as f64
}

/// This process and all its ended descendants.
fn own_seconds() -> f64 {
    let text = read_to_string("/proc/self/stat").unwrap_or_default();
    // Behind the name, which may hold anything: state is field 3, utime 14, stime 15, cutime 16, cstime 17.
    let fields = text.rsplit_once(')').map_or("", |(_, rest)| rest).split_whitespace();
    let ticks = fields.skip(11).take(4).filter_map(|n| n.parse::<f64>().ok()).sum::<f64>();
    ticks / clock_ticks_per_second() as f64
}

/// The CPUs this process may use, ascending.
pub fn cpus() -> Vec<usize> {
    let set = sched_getaffinity(None).unwrap_or_else(|_| CpuSet::new());
    (0..CpuSet::MAX_CPU).filter(|cpu| set.is_set(*cpu)).collect()
}

/// Keeps a process (`None`: this thread) on one CPU. Without the right to, nothing happens.
pub fn pin(pid: Option<u32>, cpu: usize) {
    let pid = pid.and_then(|pid| Pid::from_raw(pid as i32));
    let mut set = CpuSet::new();
    set.set(cpu);
    let _ = sched_setaffinity(pid, &set);
}

/// CPU of processes over a span of time.
pub struct CpuMeter {
    began: Instant,
    /// Name, pid, CPU seconds at the beginning.
    processes: Vec<(String, u32, f64)>,
}

impl CpuMeter {
    pub fn start(processes: Vec<(String, u32)>) -> Self {
        let processes =
            processes.into_iter().filter_map(|(name, pid)| Some((name, pid, cpu_seconds(pid)?))).collect();
        Self { began: Instant::now(), processes }
    }

    /// Per cent of one CPU, each process.
    pub fn stop(self) -> Vec<(String, f64)> {
        let seconds = self.began.elapsed().as_secs_f64();
        let percent = |(name, pid, before): (String, u32, f64)| {
            Some((name, (cpu_seconds(pid)? - before) / seconds * 100.0))
        };
        self.processes.into_iter().filter_map(percent).collect()
    }
}

/// Resident memory of a process.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Memory {
    /// Shared pages counted by their share: sums of processes count each page once.
    pub pss_bytes: u64,
    /// Shared pages counted whole.
    pub rss_bytes: u64,
}

/// Resident memory; `None` when the process is gone.
pub fn memory(pid: u32) -> Option<Memory> {
    let text = read_to_string(format!("/proc/{pid}/smaps_rollup")).ok()?;
    let bytes = |key: &str| {
        let line = text.lines().find(|l| l.starts_with(key))?;
        Some(line.split_whitespace().nth(1)?.parse::<u64>().ok()? * 1024)
    };
    Some(Memory { pss_bytes: bytes("Pss:")?, rss_bytes: bytes("Rss:")? })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn this_process_has_memory_and_time() {
        let own = std::process::id();
        let memory = memory(own).unwrap();
        assert!(memory.pss_bytes > 100_000 && memory.rss_bytes >= memory.pss_bytes, "{memory:?}");
        assert!(cpu_seconds(own).unwrap() > 0.0);
        assert!(!cpus().is_empty());
        let meter = MachineMeter::start();
        assert!(meter.busy > 0.0 && meter.others() >= 0.0);
        assert_eq!(cpu_seconds(u32::MAX), None);
        let machine = Machine::read();
        assert!(machine.cores > 0 && !machine.kernel.is_empty() && !machine.cpu.is_empty());
    }
}
