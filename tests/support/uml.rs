//! A Linux that runs as an ordinary program (user-mode Linux) with the kernel's own CAN: booting it, and what it leaves.

use super::{peers, python, skip};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

/// The guest has one slow processor, on a machine that may have other work.
const LIMIT: Duration = Duration::from_mins(20);
/// Set inside the guest by `itself.sh`.
const GUEST: &str = "DINRAIL_GUEST";

/// Folder for what the guest finds; removed when the test passed.
pub struct Work(pub PathBuf);

impl Work {
    /// The guest hides the host's /tmp, so results go beside the executable.
    pub fn new(name: &str) -> Self {
        let target = Path::new(env!("CARGO_BIN_EXE_dinrail")).parent().unwrap();
        assert!(!target.starts_with("/tmp"), "the guest has a /tmp of its own: build in another folder");
        let dir = target.join(format!("uml-{}-{name}", std::process::id()));
        let _ = fs::remove_dir_all(&dir);
        fs::create_dir_all(&dir).unwrap();
        Self(dir)
    }

    pub fn text(&self, name: &str) -> String {
        fs::read_to_string(self.0.join(name)).unwrap_or_default()
    }

    /// `ID#DATA` of every line of a candump log. Kernels mark CAN FD frames in the flags that candump shows; that mark
    /// is taken off.
    pub fn frames(&self, name: &str) -> Vec<String> {
        let unmarked = |frame: &str| match frame.split_once("##") {
            Some((id, rest)) => {
                let flags = u32::from_str_radix(&rest[..1], 16).unwrap() & 3;
                format!("{id}##{flags}{}", &rest[1..])
            }
            None => frame.to_owned(),
        };
        self.text(name).lines().filter_map(|line| line.split_whitespace().nth(2)).map(unmarked).collect()
    }

    /// What a driver counted, as it says at its end.
    pub fn sum(&self, service: &str) -> String {
        let log = self.text("up.log");
        let line = log
            .lines()
            .find(|line| line.split_whitespace().nth(1) == Some(service) && line.contains(" in all: "));
        line.unwrap_or_else(|| panic!("no sum of {service} in\n{log}")).to_owned()
    }

    fn logs(&self) -> String {
        ["kernel.log", "insmod.log", "script.log", "up.log"].map(|name| self.text(name)).join("\n---\n")
    }
}

impl Drop for Work {
    fn drop(&mut self) {
        if std::env::var_os("DINRAIL_KEEP").is_none() && !std::thread::panicking() {
            let _ = fs::remove_dir_all(&self.0);
        }
    }
}

/// What a guest needs of this machine, or a word about what it lacks.
pub fn can_boot() -> Option<()> {
    peers::program("linux.uml", "user-mode-linux")?;
    for (name, package) in [("candump", "can-utils"), ("ip", "iproute2"), ("insmod", "kmod")] {
        peers::program(name, package)?;
    }
    Some(())
}

/// Boots the guest with a script of `tests/uml`; its results are files in `work`.
pub fn boot(script: &str, work: &Work) -> Option<()> {
    boot_with(script, work, &[])
}

/// As [`boot`], with more variables for the script.
fn boot_with(script: &str, work: &Work, variables: &[(&str, &str)]) -> Option<()> {
    let scripts = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/uml").canonicalize().unwrap();
    let log = fs::File::create(work.0.join("kernel.log")).unwrap();
    // The kernel's memory is a file that is mapped executable.
    let folders = ["/dev/shm", "/tmp", "/var/tmp"].map(Path::new);
    let Some(memory) = folders.into_iter().find(|dir| has_room(dir) && executable(dir)) else {
        skip(
            "no folder for temporary files has 1.5 GiB free and allows to execute: user-mode Linux cannot boot",
        );
        return None;
    };
    let preload = work.0.join("xstate.so");
    let built = Command::new("cc")
        .args(["-O2", "-shared", "-fPIC", "-ldl", "-o"])
        .args([&preload, &scripts.join("xstate.c")])
        .status();
    let preload = if built.is_ok_and(|status| status.success()) { preload } else { PathBuf::new() };
    let mut guest = Command::new("linux.uml")
        .args(["rootfstype=hostfs", "rootflags=/", "rw", "mem=1G", "con=null", "con0=fd:0,fd:1", "quiet"])
        .arg(format!("init={}", scripts.join("init.sh").display()))
        .arg(format!("WORK={}", work.0.display()))
        .arg(format!("DINRAIL={}", env!("CARGO_BIN_EXE_dinrail")))
        .arg(format!("PYTHON={}", python::python()?.display()))
        .arg(format!("SCRIPT={}", scripts.join(script).display()))
        .args(variables.iter().map(|(name, value)| format!("{name}={value}")))
        .env("TMPDIR", memory)
        .env("LD_PRELOAD", preload)
        .stdin(Stdio::null())
        .stdout(log.try_clone().unwrap())
        .stderr(log)
        .spawn()
        .unwrap();
    let began = Instant::now();
    let mut ended = false;
    while !ended && !work.0.join("done").exists() && began.elapsed() < LIMIT {
        std::thread::sleep(Duration::from_millis(50));
        ended = guest.try_wait().unwrap().is_some();
    }
    // It halts by itself; what is left of it after the script's end is nothing anybody waits for.
    if !ended {
        std::thread::sleep(Duration::from_secs(1));
        let _ = guest.kill();
    }
    let _ = guest.wait();
    assert!(work.0.join("booted").exists(), "the guest did not boot:\n{}", work.logs());
    assert!(work.0.join("exec").exists(), "the guest's /tmp does not allow to execute:\n{}", work.logs());
    assert!(work.0.join("done").exists(), "the guest ended early or hung:\n{}", work.logs());
    assert_eq!(work.text("in_vain"), "", "{}", work.logs());
    Some(())
}

/// Whether the memory of a guest fits there: in many a container /dev/shm has 64 MiB, and a guest that finds it full
/// dies.
fn has_room(dir: &Path) -> bool {
    rustix::fs::statvfs(dir).is_ok_and(|found| found.f_bavail.saturating_mul(found.f_frsize) >= 3 << 29)
}

/// Whether a program there could be run: user-mode Linux maps its memory executable.
fn executable(dir: &Path) -> bool {
    let script = dir.join(format!("dinrail-exec-{}", std::process::id()));
    let written = fs::copy("/bin/true", &script).is_ok();
    let runs = written && Command::new(&script).status().is_ok_and(|status| status.success());
    let _ = fs::remove_file(&script);
    runs
}

/// Runs `body`, the inside of the test of that name, in a guest: this program boots it and is started in it once more.
/// What fails there fails here, with everything the guest printed.
pub fn in_guest(test: &str, body: impl FnOnce()) {
    if std::env::var_os(GUEST).is_some() {
        return body();
    }
    let Some(()) = can_boot() else { return };
    let work = Work::new(test);
    let itself = std::env::current_exe().unwrap();
    let variables = [("TESTS", itself.to_str().unwrap()), ("TEST", test)];
    let Some(()) = boot_with("itself.sh", &work, &variables) else { return };
    let (code, printed) = (work.text("done"), work.text("script.log"));
    // A test that was not found would pass, too.
    assert!(code.trim() == "0" && printed.contains("1 passed"), "exit code {code}in the guest:\n{printed}");
    // Measurements that a test prints.
    printed.lines().filter(|line| line.starts_with("--- ")).for_each(|line| eprintln!("{line}"));
}

/// Inside the guest: the folder that outlives it.
pub fn guest_work() -> PathBuf {
    PathBuf::from(std::env::var_os("WORK").unwrap())
}
