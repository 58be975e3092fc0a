//! The other side of the launcher's spawn: what a child process does before and after its service's `run`.

use super::child::Executable;
use super::debris;
use super::inject;
use super::sys;
use crate::kinds;
use ipc_types::reactor::signals;
use ipc_types::{Context, rail};
use rustix::process::{Pid, PidfdFlags, Resource, Rlimit, Signal};
use rustix::thread::CpuSet;
use std::collections::BTreeMap;
use std::os::fd::OwnedFd;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

/// A service has so long after its launcher's death to go safe and end by itself.
const ORPHAN_GRACE: Duration = Duration::from_millis(1500);

/// Half-made objects are looked for so often while dead nodes are cleaned up.
const DEBRIS_PERIOD: Duration = Duration::from_millis(50);

/// Arguments of the hidden `__service`, written by [`Executable::spawn_service`].
#[derive(Debug, Clone, clap::Args)]
pub struct ServiceArgs {
    #[arg(long)]
    pub root: PathBuf,
    #[arg(long)]
    pub name: String,
    #[arg(long)]
    pub generation: u32,
    #[arg(long)]
    pub build_id: String,
    /// Process id of the launcher.
    #[arg(long)]
    pub parent: u32,
    #[arg(long, default_value = "info")]
    pub log_level: String,
    #[arg(long, allow_hyphen_values = true)]
    pub nice: Option<i32>,
    #[arg(long)]
    pub fifo: Option<u32>,
    #[arg(long, value_delimiter = ',')]
    pub cpus: Vec<u32>,
    #[arg(long)]
    pub memory: Option<u64>,
    /// `name=number` of an inherited descriptor.
    #[arg(long)]
    pub fd: Vec<String>,
}

/// Runs one service until it is asked to end. Exit code 0 = asked and ended, 1 = a failure that was logged.
pub fn run(args: &ServiceArgs) -> ExitCode {
    match serve(args) {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) => {
            tracing::error!("{}", crate::terminal::error_text(&e));
            ExitCode::FAILURE
        }
    }
}

fn serve(args: &ServiceArgs) -> anyhow::Result<()> {
    // The first thing of all: later descriptors could take the numbers of the inherited ones.
    let fds = take_fds(&args.fd)?;
    // Before any thread exists, so that SIGTERM is never taken by a thread that does not know it.
    signals::descriptor(&[libc::SIGTERM, libc::SIGINT])?;
    start_log(&args.log_level);
    inject::arm()?;
    name_process(&args.name);
    bind_to_parent(args.parent)?;
    let own = Executable::own()?;
    if own.identity() != args.build_id {
        anyhow::bail!(
            "this executable is build {}, the launcher's is {}: restart the stack after an upgrade",
            own.identity(),
            args.build_id
        );
    }
    drop(own);
    end_on_panic();
    limit(args);
    let ctx = Context::service(&args.root, &args.name, args.generation, fds)?;
    let kind = ctx.entry().map(|e| e.kind.clone()).unwrap_or_default();
    kinds::run_service(&kind, ctx)
}

/// Cleans up after dead processes and ends. The launcher kills it when it hangs.
pub fn clean(root: &Path, parent: u32) -> ExitCode {
    let work = || -> anyhow::Result<(u64, u64)> {
        bind_to_parent(parent)?;
        let prefix = ipc_types::context::load(root)?.prefix.clone();
        let shm = root.parent().unwrap_or(root).to_owned();
        debris::remove_half_made(&shm, &prefix);
        // Others may die while this one cleans: a half-made object would stop it for ever.
        std::thread::Builder::new().name("debris".into()).spawn(move || {
            loop {
                std::thread::sleep(DEBRIS_PERIOD);
                debris::remove_half_made(&shm, &prefix);
            }
        })?;
        rail::join(root)?;
        Ok(rail::clean_dead_nodes()?)
    };
    match work() {
        Ok((cleaned, failed)) => {
            println!("cleaned {cleaned}, failed {failed}");
            ExitCode::SUCCESS
        }
        Err(e) => {
            println!("{e:#}");
            ExitCode::FAILURE
        }
    }
}

fn take_fds(list: &[String]) -> anyhow::Result<BTreeMap<String, OwnedFd>> {
    let mut fds = BTreeMap::new();
    for entry in list {
        let parsed = entry.rsplit_once('=').and_then(|(name, n)| Some((name, n.parse().ok()?)));
        let Some((name, number)) = parsed else {
            anyhow::bail!("--fd {entry}: expected name=number");
        };
        let fd = sys::take_inherited(number).map_err(|e| anyhow::anyhow!("--fd {entry}: {e}"))?;
        fds.insert(name.to_owned(), fd);
    }
    Ok(fds)
}

/// Dies with the launcher: SIGTERM at once, so that outputs go safe, and the end for certain a little later.
fn bind_to_parent(parent: u32) -> anyhow::Result<()> {
    rustix::process::set_parent_process_death_signal(Some(Signal::TERM))?;
    let gone = || anyhow::anyhow!("the launcher, pid {parent}, is gone");
    // It may have died before the line above.
    if rustix::process::getppid().map(|p| p.as_raw_nonzero().get()) != Some(parent as i32) {
        return Err(gone());
    }
    let pid = Pid::from_raw(parent as i32).ok_or_else(gone)?;
    let pidfd = rustix::process::pidfd_open(pid, PidfdFlags::empty())?;
    // Nor may the number mean another process by now.
    if rustix::process::getppid() != Some(pid) {
        return Err(gone());
    }
    std::thread::Builder::new().name("orphan".into()).stack_size(64 * 1024).spawn(move || {
        let mut fds = [rustix::event::PollFd::new(&pidfd, rustix::event::PollFlags::IN)];
        while !matches!(rustix::event::poll(&mut fds, None), Ok(1..)) {}
        std::thread::sleep(ORPHAN_GRACE);
        let _ = rustix::process::kill_process(rustix::process::getpid(), Signal::KILL);
    })?;
    Ok(())
}

/// Name in `top` and `ps`: executing a descriptor left its number there.
fn name_process(service: &str) {
    let mut name = format!("dr:{service}");
    name.truncate(name.floor_char_boundary(15));
    if let Ok(name) = std::ffi::CString::new(name) {
        let _ = rustix::thread::set_name(&name);
    }
}

/// The launcher adds service and time to each line.
fn start_log(level: &str) {
    let filter = std::env::var("DINRAIL_LOG").unwrap_or_else(|_| level.to_owned());
    let _ = tracing_subscriber::fmt()
        .with_env_filter(tracing_subscriber::EnvFilter::new(filter))
        .with_writer(std::io::stderr)
        .with_ansi(false)
        .with_target(false)
        .without_time()
        // Nobody reads what a service says after the launcher's death; telling that on the same stream would panic, in the
        // middle of taking outputs to their safe state.
        .log_internal_errors(false)
        .try_init();
}

/// A panic in a helper thread would leave a process that looks alive and works no more: the process ends, the
/// launcher starts a whole one.
fn end_on_panic() {
    let print = std::panic::take_hook();
    let main = std::thread::current().id();
    std::panic::set_hook(Box::new(move |info| {
        print(info);
        if std::thread::current().id() != main {
            std::process::exit(101);
        }
    }));
}

/// Scheduling and memory, before any thread of the service exists. What the system refuses is a warning: the
/// service works without it.
fn limit(args: &ServiceArgs) {
    if let Some(nice) = args.nice
        && let Err(e) = rustix::process::setpriority_process(None, nice)
    {
        tracing::warn!("nice = {nice}: {e}; below 0 needs CAP_SYS_NICE (`LimitNICE=` in a systemd unit)");
    }
    if !args.cpus.is_empty() {
        let mut set = CpuSet::new();
        for &cpu in &args.cpus {
            if (cpu as usize) < CpuSet::MAX_CPU {
                set.set(cpu as usize);
            }
        }
        if let Err(e) = rustix::thread::sched_setaffinity(None, &set) {
            tracing::warn!("cpus = {:?}: {e}; does this machine have them?", args.cpus);
        }
    }
    if let Some(priority) = args.fifo
        && let Err(e) = sys::set_fifo(priority)
    {
        tracing::warn!(
            "priority = {priority}: {e}; SCHED_FIFO needs CAP_SYS_NICE or `ulimit -r {priority}` \
             (`LimitRTPRIO=` in a systemd unit)"
        );
    }
    if let Some(bytes) = args.memory {
        // RLIMIT_DATA counts private writable memory only. RLIMIT_AS would count the rail's mappings and the
        // address space that the program's sandbox reserves without using it.
        let limit = Rlimit { current: Some(bytes), maximum: Some(bytes) };
        if let Err(e) = rustix::process::setrlimit(Resource::Data, limit) {
            tracing::warn!("memory_limit = {bytes}: {e}");
        }
    }
}
