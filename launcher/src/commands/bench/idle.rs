//! What a stack of the demo's size costs while nothing happens on its bus: memory, CPU, recording.

use super::demo::{self, Changes};
use super::machine::{CpuMeter, Memory, memory};
use super::{Bench, Goal};
use anyhow::{Context as _, ensure};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

const SECONDS: u64 = 30;
const LOOK: Duration = Duration::from_millis(200);

pub fn run(bench: &mut Bench) -> anyhow::Result<()> {
    let span = Duration::from_secs(bench.seconds(SECONDS));
    let mut stack = demo::spawn(&bench.dir, "idle", Changes { quiet: true, ..Changes::default() })?;
    stack.wait_ready()?;
    let processes = stack.processes()?;
    let cpu = CpuMeter::start(processes.clone());
    let began = Instant::now();
    while began.elapsed() < span {
        std::thread::sleep(LOOK);
        stack.check()?;
    }
    let cpu: f64 = cpu.stop().iter().map(|(_, percent)| percent).sum();
    let mut sum = Memory::default();
    let mut each = Vec::new();
    for (name, pid) in &processes {
        let one = memory(*pid).with_context(|| format!("{name} is gone"))?;
        sum.pss_bytes += one.pss_bytes;
        sum.rss_bytes += one.rss_bytes;
        each.push(format!("{name} {:.1} MB", one.pss_bytes as f64 / 1e6));
    }
    let (scratch, _) = stack.down()?;
    let (steady, whole) = recorded_mb_per_h(&recordings_in(&scratch.path().join("recordings")))?;
    bench.goal("recording", steady, "MB/h", Goal::AtMost(20.0));
    bench.info("recording, with what stands once in a file", whole, "MB/h");
    bench.goal("resident, all processes (PSS)", sum.pss_bytes as f64 / 1e6, "MB", Goal::Below(80.0));
    bench.info("sum of RSS, shared pages counted several times", sum.rss_bytes as f64 / 1e6, "MB");
    bench.info("CPU, all processes", cpu, "%");
    bench.note(format!("PSS: {}", each.join(", ")));
    Ok(())
}

/// Recordings, oldest first.
pub fn recordings_in(dir: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(dir).into_iter().flatten().flatten();
    let mut files: Vec<_> = entries.map(|e| e.path()).collect();
    files.retain(|f| f.extension().is_some_and(|e| e == "mcap"));
    files.sort();
    files
}

/// MB/h of what grows with time, and of the whole files. Attachments, channels and summary stand once in a file
/// of up to 100 MiB; in one of half a minute they weigh more than its messages.
fn recorded_mb_per_h(files: &[PathBuf]) -> anyhow::Result<(f64, f64)> {
    let (mut growing, mut whole, mut seconds) = (0, 0, 0.0);
    for file in files {
        let info = dinrail_recorder::info(file)?;
        ensure!(info.finished, "{} was not finished", file.display());
        growing += growing_bytes(&std::fs::read(file)?);
        whole += info.bytes;
        seconds += info.duration_s;
    }
    ensure!(seconds > 0.0, "nothing was recorded");
    let per_h = |bytes: u64| bytes as f64 / 1e6 / seconds * 3600.0;
    Ok((per_h(growing), per_h(whole)))
}

/// Bytes of chunks, message indexes and chunk indexes of a finished MCAP file: eight bytes of magic, then records
/// of opcode, length, content (MCAP specification, "Records").
fn growing_bytes(file: &[u8]) -> u64 {
    const CHUNK: u8 = 0x06;
    const MESSAGE_INDEX: u8 = 0x07;
    const CHUNK_INDEX: u8 = 0x08;
    let (mut at, mut sum) = (8, 0);
    while let Some((head, _)) = file.get(at..).and_then(|rest| rest.split_first_chunk::<9>()) {
        let [opcode, length @ ..] = *head;
        let bytes = u64::from_le_bytes(length).saturating_add(9);
        if matches!(opcode, CHUNK | MESSAGE_INDEX | CHUNK_INDEX) {
            sum += bytes;
        }
        at = at.saturating_add(usize::try_from(bytes).unwrap_or(usize::MAX));
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_grows_is_counted() {
        let mut file = b"\x89MCAP0\r\n".to_vec();
        for (opcode, length) in [(0x01, 7), (0x06, 100), (0x07, 20), (0x09, 1000), (0x08, 3), (0x0f, 4)] {
            file.push(opcode);
            file.extend_from_slice(&u64::to_le_bytes(length));
            file.resize(file.len() + length as usize, 0);
        }
        file.extend_from_slice(b"\x89MCAP0\r\n");
        assert_eq!(growing_bytes(&file), 109 + 29 + 12);
        // A length of nonsense ends the walk.
        file.truncate(8);
        file.extend_from_slice(&[0x06, 255, 255, 255, 255, 255, 255, 255, 255, 0]);
        assert_eq!(growing_bytes(&file), u64::MAX);
    }
}
