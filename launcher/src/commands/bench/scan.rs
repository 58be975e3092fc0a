//! What a thousand instructions cost in a scan, and what a scan costs without any.
//!
//! In this process, on the engine that a stack runs, watchdog armed: no rail and no clock. Blocks of scans with
//! and without the instructions alternate; the difference of the medians is the instructions' share.

use super::stats::Samples;
use super::{Bench, Goal};
use anyhow::Context as _;
use dinrail_iec::Source;
use dinrail_plc::engine::{Engine, Runtime, Stamps};
use dinrail_plc::program::compile_sources;
use dinrail_plc::setup::Setup;
use ipc_types::payload::PlcState;
use ipc_types::scan_record::{Command, Source as Sender, Start};
use std::fmt::Write;
use std::sync::Arc;
use std::time::{Duration, Instant};

const SECONDS: u64 = 4;
const BLOCK: u32 = 1000;
const CYCLE_NS: u64 = 1_000_000;
const WATCHDOG: Duration = Duration::from_secs(1);
/// Variables of each type.
const VARIABLES: usize = 8;
/// Times that each kind of statement stands in the program.
const STATEMENTS: usize = 100;

/// 1000 instructions as a controller counts them: 100 x LD AND OR ST, 100 x LD ADD ST, 100 x LD GT ST.
fn program() -> String {
    let mut text = String::from("PROGRAM Main\n  VAR\n");
    for i in 0..VARIABLES {
        let _ = writeln!(text, "    b{i} : BOOL := {};\n    n{i} : DINT := {};", i % 3 == 0, i + 1);
    }
    text += "  END_VAR\n";
    let at = |i: usize| i % VARIABLES;
    for i in 0..STATEMENTS {
        let (a, b, c, d) = (at(i), at(i + 1), at(i + 3), at(i + 6));
        let _ = writeln!(text, "  b{a} := (b{b} AND b{c}) OR b{d};");
        let _ = writeln!(text, "  n{a} := n{b} + n{c};");
        let _ = writeln!(text, "  b{c} := n{a} > n{d};");
    }
    text + "END_PROGRAM\n"
}

const EMPTY: &str = "PROGRAM Main\nEND_PROGRAM\n";

/// An engine that runs a program.
struct Runner {
    engine: Engine,
    time_ns: u64,
}

impl Runner {
    fn new(runtime: &Runtime, text: &str) -> anyhow::Result<Self> {
        let setup = Setup { cycle_ns: Some(CYCLE_NS), ..Setup::default() };
        let source = Source { name: "bench.st".to_owned(), text: text.to_owned() };
        let program = compile_sources(vec![source], &setup)?.program;
        let mut engine = Engine::new(runtime, Some(program), Arc::new(setup))?;
        engine.begin(Stamps::default());
        engine.control(&Sender::default(), &Command::Start(Start::Cold));
        engine.finish();
        Ok(Self { engine, time_ns: 0 })
    }

    /// ns a scan, over a block.
    fn block(&mut self) -> f64 {
        let began = Instant::now();
        for _ in 0..BLOCK {
            self.time_ns += CYCLE_NS;
            let (t_ns, plc_time_ns) = (self.time_ns, self.time_ns as i64);
            self.engine.begin(Stamps { t_ns, plc_time_ns, utc_ns: plc_time_ns });
            self.engine.finish();
        }
        began.elapsed().as_nanos() as f64 / f64::from(BLOCK)
    }
}

pub fn run(bench: &mut Bench) -> anyhow::Result<()> {
    let span = Duration::from_secs(bench.seconds(SECONDS));
    let (runtime, _watchdog) = Runtime::with_watchdog(WATCHDOG)?;
    let mut full = Runner::new(&runtime, &program()).context("the program of 1000 instructions")?;
    let mut empty = Runner::new(&runtime, EMPTY).context("the empty program")?;
    let (mut full_ns, mut empty_ns) = (Samples::default(), Samples::default());
    let began = Instant::now();
    while began.elapsed() < span {
        full_ns.push(full.block());
        empty_ns.push(empty.block());
    }
    anyhow::ensure!(
        full.engine.state() == PlcState::Run && empty.engine.state() == PlcState::Run,
        "a program stopped: {:?}",
        full.engine.fault()
    );
    let (full_ns, empty_ns) = (full_ns.sorted().p50(), empty_ns.sorted().p50());
    bench.goal("1000 instructions", (full_ns - empty_ns) / 1e3, "us", Goal::Below(1.0));
    bench.info("whole scan with them", full_ns / 1e3, "us");
    bench.info("whole scan of an empty program", empty_ns / 1e3, "us");
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_program_has_a_thousand_instructions_and_runs() {
        let text = program();
        let count = |word: &str| text.matches(word).count();
        // Each assignment is an LD and an ST; each operator one instruction more.
        let operators = count(" AND ") + count(" OR ") + count(" + ") + count(" > ");
        assert_eq!(count(":=") - 2 * VARIABLES, 3 * STATEMENTS);
        assert_eq!(2 * 3 * STATEMENTS + operators, 1000);
        let runtime = Runtime::new().unwrap();
        let mut runner = Runner::new(&runtime, &text).unwrap();
        let before = runner.engine.memory().to_vec();
        runner.block();
        assert_eq!(runner.engine.state(), PlcState::Run);
        assert_ne!(before, runner.engine.memory());
    }
}
