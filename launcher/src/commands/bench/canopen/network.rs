//! Process data of 64 PDOs, and a network of 127 nodes. The nodes are simulated in this process.

use super::super::machine::CpuMeter;
use super::super::stack::{BenchStack, PATIENCE};
use super::super::stats::Samples;
use super::super::{Bench, Goal};
use super::{EDS, EDS_FILE, Master, observe, with_fleet};
use anyhow::{Context as _, ensure};
use ipc_types::Context;
use ipc_types::payload::CanFrame;
use serde_json::{Value, json};
use std::time::{Duration, Instant};

const SECONDS: u64 = 10;
const PDOS: u8 = 64;
/// Node-ids 2 to 127: with the master 127 nodes, the most that a network can have.
const LAST: u8 = 127;
const SYNC: u32 = 0x80;
/// From one question for the master's figure to the next.
const LOOK: Duration = Duration::from_millis(25);

const STACK: &str = r#"
[stack]
name = "NAME"

[[service]]
name = "can0"
kind = "can"
backend = "virtual"

[[service]]
name = "io"
kind = "canopen-master"
sync_period = "10ms"
boot_time = "30s"
NODES

[[service]]
name = "plc"
kind = "plc"
cycle = "10ms"
"#;

/// Nodes 2 to `last`, each with a PDO to it and, where `both`, one from it.
fn text(last: u8, both: bool) -> String {
    let node = |id: u8| {
        let at = id - 2;
        let input =
            if both { format!("{{ object = \"6000:01\", to = \"%IB{at}\" }}, ") } else { String::new() };
        let output = format!("{{ object = \"6200:01\", from = \"%QB{at}\" }}");
        let keys = format!("id = {id}\neds = \"{EDS_FILE}\"\nmandatory = true\nheartbeat = \"1s\"");
        format!("\n[[service.node]]\n{keys}\nmap = [{input}{output}]\n")
    };
    STACK.replace("NODES", &(2..=last).map(node).collect::<String>())
}

/// From the SYNC to the last PDO that the master sends for it, in the driver's queue: the master's own clock. On the
/// virtual bus all of them have one stamp, since the driver takes them together.
pub fn process_data(bench: &mut Bench) -> anyhow::Result<()> {
    let span = Duration::from_secs(bench.seconds(SECONDS));
    let last = PDOS + 1;
    let mut stack = BenchStack::up_unready(&bench.dir, "pdo", &text(last, false), &[(EDS_FILE, EDS)])?;
    {
        let mut ctx = stack.join()?;
        let root = ctx.stack.root.clone();
        let mut rx = ctx.subscriber::<CanFrame>("can0/rx")?;
        let (mut handed, mut on_bus) = (Samples::default(), Samples::default());
        let mut syncs = 0u64;
        with_fleet(&root, "can0", 2..=last, || {
            let mut master = Master::open(&mut ctx, "io")?;
            master.wait_operational(&mut stack, usize::from(PDOS))?;
            observe(&mut stack, &mut rx, Duration::from_millis(200), |_, _| ())?;
            let (mut sync_ns, mut count) = (None, 0);
            let began = Instant::now();
            while began.elapsed() < span {
                observe(&mut stack, &mut rx, LOOK, |t_ns, frame| match frame.id() {
                    SYNC => (sync_ns, count, syncs) = (Some(t_ns), 0, syncs + 1),
                    // The first RPDO of each node.
                    0x202..=0x27F => {
                        count += 1;
                        if let Some(sync_ns) = sync_ns.filter(|_| count == PDOS) {
                            on_bus.push(t_ns.saturating_sub(sync_ns) as f64 / 1e3);
                        }
                    }
                    _ => {}
                })?;
                handed.push(count_of(&master.status()?, "/sync_out_us/last")?);
            }
            Ok(())
        })?;
        ensure!(on_bus.len() > 0, "{PDOS} PDOs were never seen behind one SYNC");
        bench.info(format!("SYNCs with all {PDOS} PDOs"), on_bus.len() as f64 / syncs as f64 * 100.0, "%");
        let (handed, on_bus) = (handed.sorted(), on_bus.sorted());
        let what = format!("SYNC -> last of {PDOS} PDOs");
        bench.goal(format!("{what} handed out, p50"), handed.p50(), "us", Goal::Below(200.0));
        bench.goal(format!("{what} handed out, p99"), handed.p99(), "us", Goal::Below(200.0));
        bench.info(format!("{what}, by their stamps on the bus, p99"), on_bus.p99(), "us");
    }
    stack.down()?;
    Ok(())
}

/// 127 nodes: from the reset of all to the start of the last, then the CPU of process data both ways.
pub fn full(bench: &mut Bench) -> anyhow::Result<()> {
    let span = Duration::from_secs(bench.seconds(SECONDS));
    let mut stack = BenchStack::up_unready(&bench.dir, "network", &text(LAST, true), &[(EDS_FILE, EDS)])?;
    {
        let mut ctx = stack.join()?;
        let root = ctx.stack.root.clone();
        let nodes = usize::from(LAST - 1);
        with_fleet(&root, "can0", 2..=LAST, || {
            let mut master = Master::open(&mut ctx, "io")?;
            master.wait_operational(&mut stack, nodes)?;
            let seconds = boot_time(&mut ctx, &mut stack, &mut master, nodes)?;
            bench.info(
                format!("reset of {} nodes -> the last one started, heartbeat 1 s", nodes + 1),
                seconds,
                "s",
            );
            master.wait_operational(&mut stack, nodes)?;
            let before = master.status()?;
            let meter = CpuMeter::start(stack.processes()?);
            let began = Instant::now();
            while began.elapsed() < span {
                std::thread::sleep(Duration::from_millis(50));
                stack.check()?;
            }
            let cpu = meter.stop();
            let after = master.status()?;
            let of =
                |name: &str| cpu.iter().find(|(n, _)| n == name).map_or(f64::NAN, |(_, percent)| *percent);
            bench.goal(
                format!("CPU of the master of {} nodes, SYNC 10 ms", nodes + 1),
                of("io"),
                "%",
                Goal::Below(30.0),
            );
            bench.info("CPU of the bus driver", of("can0"), "%");
            let grown = |at: &str| anyhow::Ok(count_of(&after, at)? - count_of(&before, at)?);
            let syncs = grown("/network/syncs")?;
            for (name, at) in [("PDOs from the nodes", "/pdo/rx_pdos"), ("PDOs to the nodes", "/pdo/tx_pdos")]
            {
                let got = grown(at)?;
                bench.info(
                    format!("{name}, of one a node and SYNC"),
                    got / (syncs * nodes as f64) * 100.0,
                    "%",
                );
            }
            let whole = grown("/pdo/complete_samples")?;
            bench.info("samples with all PDOs in", whole / syncs * 100.0, "%");
            Ok(())
        })?;
    }
    stack.down()?;
    Ok(())
}

/// From the NMT command that resets all nodes to the one that starts the last of them, on the bus.
fn boot_time(
    ctx: &mut Context,
    stack: &mut BenchStack,
    master: &mut Master,
    nodes: usize,
) -> anyhow::Result<f64> {
    const NMT: u32 = 0;
    let mut rx = ctx.subscriber::<CanFrame>("can0/rx")?;
    master.ask(&[json!({ "do": "nmt", "command": "reset_communication", "node": 0 })], || ())?;
    let (mut reset_ns, mut last_ns, mut started) = (None, 0, [false; 128]);
    let began = Instant::now();
    while started.iter().filter(|s| **s).count() < nodes {
        ensure!(began.elapsed() < PATIENCE, "not all nodes were started again");
        observe(stack, &mut rx, Duration::from_millis(5), |t_ns, frame| {
            match (frame.id(), frame.payload()) {
                (NMT, [130, 0]) => reset_ns = Some(t_ns),
                (NMT, [1, node]) => {
                    if let Some(started) = started.get_mut(usize::from(*node)).filter(|_| reset_ns.is_some())
                    {
                        (*started, last_ns) = (true, t_ns);
                    }
                }
                _ => {}
            }
        })?;
    }
    let reset_ns = reset_ns.context("the reset was not on the bus")?;
    Ok(last_ns.saturating_sub(reset_ns) as f64 / 1e9)
}

fn count_of(status: &Value, at: &str) -> anyhow::Result<f64> {
    status.pointer(at).and_then(Value::as_f64).with_context(|| format!("the master's status has no {at}"))
}
