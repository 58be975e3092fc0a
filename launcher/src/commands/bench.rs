//! `dinrail bench`: measures this machine and sets each figure beside the project's goal.
//!
//! Each bench runs a stack of its own in a scratch folder, started as a user starts one, and leaves nothing
//! behind. Nothing here may assert a time: a missed goal is a figure, not a failure. Exit code 1 means that a
//! bench could not be run.

mod bus;
mod bus_full;
mod bus_peers;
mod canopen;
mod demo;
mod idle;
mod latency;
mod machine;
mod modbus;
mod modbus_gateway;
mod modbus_lines;
mod modbus_unit;
mod recorder;
mod restart;
mod scan;
mod soak;
mod stack;
mod start;
mod stats;

use super::{print, println, table};
use anyhow::{Context as _, ensure};
use clap::{Args, ValueEnum};
use machine::{Machine, MachineMeter};
use serde::{Deserialize, Serialize};
use std::path::PathBuf;
use std::process::{Command, ExitCode, Stdio};

/// CPU of other processes, in per cent of one CPU, from which a report says that the machine was busy.
const BUSY_PERCENT: f64 = 10.0;

/// Arguments of `dinrail bench`.
#[derive(Debug, Clone, Args)]
pub struct BenchArgs {
    /// What to measure
    pub what: What,
    /// How long to measure; each bench has a default of its own. `start` and `restart` count runs instead,
    /// `soak` ends early
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..=3600))]
    pub seconds: Option<u64>,
    /// Folder for scratch files and recordings; default is the system's temporary folder
    #[arg(long, value_name = "FOLDER")]
    pub dir: Option<PathBuf>,
}

/// The benches.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum What {
    /// From a frame on the bus to the register that shows it
    Latency,
    /// Frames a second and round trips on a virtual bus, beside python-can's; the driver's CPU on a full bus
    Bus,
    /// Modbus TCP answers beside libmodbus and pymodbus, gateway, RTU line
    Modbus,
    #[value(hide = true)]
    ModbusGateway,
    #[value(hide = true)]
    ModbusGatewayFifo,
    /// SDO, punctuality of the SYNC, process data, a network of 127 nodes
    Canopen,
    #[value(hide = true)]
    CanopenSdo,
    #[value(hide = true)]
    CanopenSync,
    #[value(hide = true)]
    CanopenSyncFifo,
    #[value(hide = true)]
    CanopenPdo,
    #[value(hide = true)]
    CanopenNetwork,
    /// A scan of 1000 instructions
    Scan,
    /// Four busy buses, a PLC and the recording
    Recorder,
    /// From `up` to the first scan
    Start,
    /// From SIGKILL to back at work
    Restart,
    /// Memory, CPU and recording of a stack without traffic
    Idle,
    /// Memory and descriptors under what a Modbus line carries in 24 hours, as fast as it goes
    Soak,
    /// All of them but `soak`, one after the other
    All,
}

impl What {
    const EACH: [Self; 9] = [
        Self::Latency,
        Self::Bus,
        Self::Modbus,
        Self::Canopen,
        Self::Scan,
        Self::Recorder,
        Self::Start,
        Self::Restart,
        Self::Idle,
    ];
    /// What `modbus` has done in processes of their own.
    const MODBUS_PARTS: [Self; 2] = [Self::ModbusGateway, Self::ModbusGatewayFifo];
    /// What `canopen` consists of.
    const CANOPEN_PARTS: [Self; 5] =
        [Self::CanopenSdo, Self::CanopenSync, Self::CanopenSyncFifo, Self::CanopenPdo, Self::CanopenNetwork];

    fn name(self) -> &'static str {
        match self {
            Self::Latency => "latency",
            Self::Bus => "bus",
            Self::Modbus => "modbus",
            Self::ModbusGateway => "modbus-gateway",
            Self::ModbusGatewayFifo => "modbus-gateway-fifo",
            Self::Canopen => "canopen",
            Self::CanopenSdo => "canopen-sdo",
            Self::CanopenSync => "canopen-sync",
            Self::CanopenSyncFifo => "canopen-sync-fifo",
            Self::CanopenPdo => "canopen-pdo",
            Self::CanopenNetwork => "canopen-network",
            Self::Scan => "scan",
            Self::Recorder => "recorder",
            Self::Start => "start",
            Self::Restart => "restart",
            Self::Idle => "idle",
            Self::Soak => "soak",
            Self::All => "all",
        }
    }
}

/// What a figure is to be.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Goal {
    Below(f64),
    AtMost(f64),
    AtLeast(f64),
}

impl Goal {
    fn met(self, value: f64) -> bool {
        match self {
            Self::Below(limit) => value < limit,
            Self::AtMost(limit) => value <= limit,
            Self::AtLeast(limit) => value >= limit,
        }
    }

    fn text(self, unit: &str) -> String {
        let (sign, limit) = match self {
            Self::Below(limit) => ("<", limit),
            Self::AtMost(limit) => ("<=", limit),
            Self::AtLeast(limit) => (">=", limit),
        };
        format!("{sign} {}", stats::with_unit(limit, unit))
    }
}

/// One measured value.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Figure {
    pub bench: String,
    pub name: String,
    pub value: f64,
    /// Empty for ratios and counts.
    pub unit: String,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub goal: Option<Goal>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub met: Option<bool>,
}

/// What a bench, or several, brought.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Report {
    pub machine: Machine,
    pub figures: Vec<Figure>,
    pub notes: Vec<String>,
}

/// What a bench is given, and where it puts its figures.
pub struct Bench {
    what: What,
    seconds: Option<u64>,
    dir: PathBuf,
    figures: Vec<Figure>,
    notes: Vec<String>,
}

impl Bench {
    /// Seconds to measure.
    fn seconds(&self, default: u64) -> u64 {
        self.seconds.unwrap_or(default)
    }

    /// A figure without a goal.
    fn info(&mut self, name: impl Into<String>, value: f64, unit: &str) {
        self.push(name.into(), value, unit, None);
    }

    /// A figure with a goal.
    fn goal(&mut self, name: impl Into<String>, value: f64, unit: &str, goal: Goal) {
        self.push(name.into(), value, unit, Some(goal));
    }

    fn push(&mut self, name: String, value: f64, unit: &str, goal: Option<Goal>) {
        self.figures.push(Figure {
            bench: self.what.name().to_owned(),
            name,
            value,
            unit: unit.to_owned(),
            goal,
            met: goal.map(|g| g.met(value)),
        });
    }

    fn note(&mut self, text: impl Into<String>) {
        self.notes.push(format!("{}: {}", self.what.name(), text.into()));
    }

    /// Runs parts, each in a process of its own, and takes over their figures.
    fn parts(&mut self, parts: &[What]) -> anyhow::Result<()> {
        for part in parts {
            let mut child = Command::new(stack::OWN_EXECUTABLE);
            child.args(["--json", "bench", part.name()]).stdin(Stdio::null()).stderr(Stdio::inherit());
            if let Some(seconds) = self.seconds {
                child.args(["--seconds", &seconds.to_string()]);
            }
            let output =
                child.arg("--dir").arg(&self.dir).output().context("starting a part of the bench")?;
            ensure!(
                output.status.success(),
                "{} could not be run, {}; see above",
                part.name(),
                output.status
            );
            let report: Report =
                serde_json::from_slice(&output.stdout).context("reading the report of a part")?;
            let what = self.what.name();
            let own = |figure| Figure { bench: what.to_owned(), ..figure };
            self.figures.extend(report.figures.into_iter().map(own));
            self.notes.extend(report.notes);
        }
        Ok(())
    }
}

/// Runs one bench, or all of them.
pub fn run(args: &BenchArgs, json: bool) -> anyhow::Result<ExitCode> {
    let (report, failed) = if args.what == What::All { all(args)? } else { (one(args)?, false) };
    if json {
        println(&serde_json::to_string_pretty(&report)?);
    } else {
        print(&report_text(&report));
    }
    Ok(if failed { ExitCode::FAILURE } else { ExitCode::SUCCESS })
}

fn one(args: &BenchArgs) -> anyhow::Result<Report> {
    let machine = Machine::read();
    let dir = args.dir.clone().unwrap_or_else(std::env::temp_dir);
    let mut bench =
        Bench { what: args.what, seconds: args.seconds, dir, figures: Vec::new(), notes: Vec::new() };
    let measure = match args.what {
        What::Latency => latency::run,
        What::Bus => bus::run,
        What::Modbus => modbus::run,
        What::ModbusGateway => modbus_gateway::other,
        What::ModbusGatewayFifo => modbus_gateway::fifo,
        What::Canopen => canopen::run,
        What::CanopenSdo => canopen::sdo,
        What::CanopenSync => canopen::other,
        What::CanopenSyncFifo => canopen::fifo,
        What::CanopenPdo => canopen::process_data,
        What::CanopenNetwork => canopen::full,
        What::Scan => scan::run,
        What::Recorder => recorder::run,
        What::Start => start::run,
        What::Restart => restart::run,
        What::Idle => idle::run,
        What::Soak => soak::run,
        What::All => anyhow::bail!("'all' is no bench of its own"),
    };
    let meter = MachineMeter::start();
    measure(&mut bench).with_context(|| format!("bench {} could not be run", args.what.name()))?;
    let others = meter.others();
    if others >= BUSY_PERCENT {
        bench.note(format!(
            "other processes took {others:.0} % of a CPU meanwhile; a quiet machine gives better figures"
        ));
    }
    Ok(Report { machine, figures: bench.figures, notes: bench.notes })
}

/// Each bench in a process of its own: a process belongs to one rail for its whole life.
fn all(args: &BenchArgs) -> anyhow::Result<(Report, bool)> {
    let mut whole = Report { machine: Machine::read(), ..Report::default() };
    let mut failed = false;
    for what in What::EACH {
        eprintln!("measuring {} ...", what.name());
        let mut child = Command::new(stack::OWN_EXECUTABLE);
        child.args(["--json", "bench", what.name()]).stdin(Stdio::null()).stderr(Stdio::inherit());
        if let Some(seconds) = args.seconds {
            child.args(["--seconds", &seconds.to_string()]);
        }
        if let Some(dir) = &args.dir {
            child.arg("--dir").arg(dir);
        }
        let output = child.output().context("starting a bench")?;
        match serde_json::from_slice::<Report>(&output.stdout) {
            Ok(report) => {
                whole.figures.extend(report.figures);
                whole.notes.extend(report.notes);
            }
            Err(_) => {
                failed = true;
                whole.notes.push(format!("{}: could not be run, {}; see above", what.name(), output.status));
            }
        }
    }
    Ok((whole, failed))
}

fn report_text(report: &Report) -> String {
    let rows: Vec<Vec<String>> = report
        .figures
        .iter()
        .map(|f| {
            vec![
                f.bench.clone(),
                f.name.clone(),
                stats::with_unit(f.value, &f.unit),
                f.goal.map_or_else(String::new, |g| g.text(&f.unit)),
                f.met.map_or("", |met| if met { "met" } else { "MISSED" }).to_owned(),
            ]
        })
        .collect();
    let mut text = table(&["BENCH", "FIGURE", "VALUE", "GOAL", ""], &rows);
    for note in &report.notes {
        text += &format!("note: {note}\n");
    }
    text + &format!("machine: {}\n", report.machine)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_goal_knows_its_side() {
        for (goal, value, met, text) in [
            (Goal::Below(100.0), 99.9, true, "< 100 us"),
            (Goal::Below(100.0), 100.0, false, "< 100 us"),
            (Goal::AtMost(1.2), 1.2, true, "<= 1.2 us"),
            (Goal::AtLeast(100_000.0), 99_999.0, false, ">= 100,000 us"),
        ] {
            assert_eq!((goal.met(value), goal.text("us").as_str()), (met, text));
        }
    }

    #[test]
    fn a_report_is_a_table_and_reads_back() {
        let mut bench = Bench {
            what: What::Bus,
            seconds: None,
            dir: PathBuf::new(),
            figures: Vec::new(),
            notes: Vec::new(),
        };
        bench.goal("frames", 123_456.7, "frames/s", Goal::AtLeast(1e5));
        bench.goal("lost", 3.0, "", Goal::AtMost(0.0));
        bench.info("driver CPU", 41.26, "%");
        bench.note("something to know");
        let machine = Machine { cpu: "x".into(), cores: 2, kernel: "6.1".into(), load: 0.5 };
        let report = Report { machine, figures: bench.figures, notes: bench.notes };
        insta::assert_snapshot!(report_text(&report), @r"
        BENCH  FIGURE      VALUE             GOAL
        bus    frames      123,457 frames/s  >= 100,000 frames/s  met
        bus    lost        3                 <= 0                 MISSED
        bus    driver CPU  41.3 %
        note: bus: something to know
        machine: x, 2 cores, Linux 6.1, load 0.50 before
        ");
        let text = serde_json::to_string(&report).unwrap();
        assert_eq!(serde_json::from_str::<Report>(&text).unwrap(), report);
    }

    #[test]
    fn every_bench_is_named_as_on_the_command_line() {
        for what in What::EACH.into_iter().chain(What::CANOPEN_PARTS) {
            assert_eq!(What::from_str(what.name(), false), Ok(what));
        }
    }
}
