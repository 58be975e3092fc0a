//! From a frame on the bus to the register that shows it, with a scan triggered by its inputs.
//!
//! The observer sends frames that carry a counter; the driver stamps each when it is on the bus, can-io takes
//! the counter into %I, the program copies it to %M, the engine stamps the image as it publishes it. Both stamps
//! are CLOCK_MONOTONIC, so the difference holds every hop between and nothing of the observer.

use super::modbus::Client;
use super::stack::{BenchStack, PATIENCE, free_port};
use super::stats::Samples;
use super::{Bench, Goal};
use anyhow::{Context as _, ensure};
use ipc_types::clock::mono_ns;
use ipc_types::payload::{CanFrame, Image};
use ipc_types::port::{Publisher, Subscriber};
use std::time::Duration;

const SAMPLES: u64 = 2000;
const SAMPLES_MODBUS: u64 = 500;
const PERIOD_NS: u64 = 2_000_000;
/// The observer looks so long after a frame: it must not run while the stack works on it.
const FIRST_LOOK: Duration = Duration::from_micros(1200);
const NEXT_LOOK: Duration = Duration::from_micros(300);
const CAN_ID: u32 = 0x100;

const STACK: &str = r#"
[stack]
name = "NAME"

[[service]]
name = "can0"
kind = "can"
backend = "virtual"

[[service]]
name = "io"
kind = "can-io"
echo = true            # frames of this process are the stack's own

[[service.in]]
id = 0x100
start = 0
len = 32
to = "%ID0"
type = "UDINT"
symbol = "Counter"

[[service]]
name = "plc"
kind = "plc"
program = ["main.st"]
trigger = "inputs"

[[service]]
name = "modbus"
kind = "modbus-server"
tcp = { address = "127.0.0.1", port = PORT }
"#;

const PROGRAM: &str = "
PROGRAM Main
  VAR
    Shown AT %MD0 : UDINT;
  END_VAR
  Shown := Counter;
END_PROGRAM
";

pub fn run(bench: &mut Bench) -> anyhow::Result<()> {
    let port = free_port()?;
    let toml = STACK.replace("PORT", &port.to_string());
    let mut stack = BenchStack::up(&bench.dir, "latency", &toml, &[("main.st", PROGRAM)])?;
    let samples = bench.seconds.map_or(SAMPLES, |s| s * 1_000_000_000 / PERIOD_NS);
    {
        let mut ctx = stack.join()?;
        let mut probe = Probe {
            tx: ctx.publisher("can0/tx")?,
            rx: ctx.subscriber("can0/rx")?,
            image: ctx.subscriber("plc/image")?,
            counter: 0,
        };
        image_latency(bench, &mut stack, &mut probe, samples)?;
        modbus_latency(bench, &mut stack, &mut probe, port)?;
    }
    stack.down()?;
    Ok(())
}

struct Probe {
    tx: Publisher<CanFrame>,
    rx: Subscriber<CanFrame>,
    image: Subscriber<Image>,
    counter: u32,
}

impl Probe {
    /// Sends the next counter.
    fn send(&mut self) -> anyhow::Result<()> {
        self.counter += 1;
        self.tx.send(CanFrame::classic(CAN_ID, &self.counter.to_le_bytes()))?;
        self.tx.ring();
        Ok(())
    }

    /// When the counter was on the bus, if it was.
    fn on_bus_ns(&mut self) -> Option<u64> {
        let (mut found, wanted) = (None, self.counter.to_le_bytes());
        self.rx.drain(4096, |frame, _| {
            if frame.payload() == wanted {
                found = Some(frame.stamp.t_ns);
            }
        });
        found
    }

    /// When the first image that holds it was published, if there is one.
    fn in_image_ns(&mut self) -> Option<u64> {
        let (mut found, wanted) = (None, self.counter.to_le_bytes());
        self.image.drain(16, |image, tail| {
            let shown = image.areas(tail).and_then(|(_, _, markers)| markers.get(..4));
            if found.is_none() && shown == Some(&wanted[..]) {
                found = Some(image.stamp.t_ns);
            }
        });
        found
    }
}

fn sleep_until(t_ns: u64) {
    std::thread::sleep(Duration::from_nanos(t_ns.saturating_sub(mono_ns())));
}

/// One frame: from the bus to the image, in us.
fn one(stack: &mut BenchStack, probe: &mut Probe) -> anyhow::Result<f64> {
    probe.send()?;
    std::thread::sleep(FIRST_LOOK);
    let limit_ns = mono_ns() + PATIENCE.as_nanos() as u64;
    let (mut on_bus, mut in_image) = (None, None);
    loop {
        on_bus = on_bus.or_else(|| probe.on_bus_ns());
        in_image = in_image.or_else(|| probe.in_image_ns());
        if let (Some(from), Some(to)) = (on_bus, in_image) {
            return Ok(to.saturating_sub(from) as f64 / 1e3);
        }
        stack.check()?;
        ensure!(mono_ns() < limit_ns, "frame {} never reached the image", probe.counter);
        std::thread::sleep(NEXT_LOOK);
    }
}

fn image_latency(
    bench: &mut Bench,
    stack: &mut BenchStack,
    probe: &mut Probe,
    samples: u64,
) -> anyhow::Result<()> {
    // The first ones warm caches and connections up.
    for _ in 0..50 {
        one(stack, probe)?;
    }
    let mut all = Samples::default();
    let mut next_ns = mono_ns();
    for _ in 0..samples {
        sleep_until(next_ns);
        all.push(one(stack, probe)?);
        next_ns = (next_ns + PERIOD_NS).max(mono_ns());
    }
    bench.info("samples", all.len() as f64, "");
    let all = all.sorted();
    bench.goal("frame on bus -> image, p50", all.p50(), "us", Goal::Below(100.0));
    bench.goal("frame on bus -> image, p99", all.p99(), "us", Goal::Below(500.0));
    bench.info("frame on bus -> image, max", all.max(), "us");
    Ok(())
}

/// To the answer in a client's hands that shows the counter: the client asks again and again, so this holds one
/// to two round trips, and a CPU that the client takes.
fn modbus_latency(
    bench: &mut Bench,
    stack: &mut BenchStack,
    probe: &mut Probe,
    port: u16,
) -> anyhow::Result<()> {
    let mut client = Client::connect(port)?;
    let mut all = Samples::default();
    for _ in 0..SAMPLES_MODBUS {
        probe.send()?;
        let limit_ns = mono_ns() + PATIENCE.as_nanos() as u64;
        let seen_ns = loop {
            let answer = client.holding(0, 2)?;
            let seen_ns = mono_ns();
            // Low word first, each word high byte first.
            let shown = u32::from(answer[0]) | u32::from(answer[1]) << 16;
            if shown == probe.counter {
                break seen_ns;
            }
            ensure!(seen_ns < limit_ns, "frame {} never reached its register", probe.counter);
        };
        let on_bus_ns = probe.on_bus_ns().context("a frame in a register that was never on the bus")?;
        probe.in_image_ns();
        all.push(seen_ns.saturating_sub(on_bus_ns) as f64 / 1e3);
        stack.check()?;
        sleep_until(mono_ns() + PERIOD_NS);
    }
    let all = all.sorted();
    bench.info("frame on bus -> Modbus answer, p50", all.p50(), "us");
    bench.info("frame on bus -> Modbus answer, p99", all.p99(), "us");
    Ok(())
}
