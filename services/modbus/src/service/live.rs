//! The service at work: ports, descriptors, loop.

use super::status::{self, LineStatus};
use super::{KIND, LISTENER, RTU_LISTENER, ServiceError, addressing_of};
use crate::buffers::Buffers;
use crate::config::Config;
use crate::device::{Device, Shared};
use crate::line::Line;
use crate::process::{RunError, Wake, Wakes, listener, run_here};
use crate::process_image::{BitPlace, Change, NotQueued, ProcessImage, Rail};
use crate::rights::Rights;
use crate::session::Framing;
use crate::tcp::{Backend, Happening, Hub, Options};
use crate::view::View;
use crate::watchdog::Watchdog;
use ipc_types::event::{EventKind, Level};
use ipc_types::image_write::Builder;
use ipc_types::payload::{Image, ImageWrite, Inputs, Job, JobResult, SerialChunk};
use ipc_types::port::{Publisher, SendError, Subscriber};
use ipc_types::rail::RailError;
use ipc_types::topic::TopicKind;
use ipc_types::turns::STATUS_BEATS;
use ipc_types::wiring::AreaSizes;
use ipc_types::{Context, clock};
use serde_json::{Value, json};
use std::cell::RefCell;
use std::net::SocketAddr;
use std::rc::Rc;

/// Chunks taken from a line at one wake; more wait for the next turn.
const CHUNKS_PER_WAKE: usize = 256;
const JOBS_PER_WAKE: usize = 16;

/// The ports to the plc.
pub(super) struct Ports {
    pub(super) image: Subscriber<Image>,
    writes: Publisher<ImageWrite>,
    inputs: Option<Publisher<Inputs>>,
}

impl Rail for Ports {
    fn now_ns(&self) -> u64 {
        clock::mono_ns()
    }

    fn newest(&mut self, take: &mut dyn FnMut(&Image, &[u8])) {
        self.image.newest(take);
    }

    fn write(&mut self, write: &Builder) -> Result<u64, NotQueued> {
        let header = ImageWrite { ops: write.ops(), ..ImageWrite::default() };
        self.writes.send_tail(header, write.tail()).map_err(|error| match error {
            SendError::Full(_) => NotQueued::Full,
            SendError::NoReader(_) | SendError::TooLong { .. } | SendError::Middleware { .. } => {
                NotQueued::NoReader
            }
        })
    }

    fn publish_inputs(&mut self, ranges: u32, data_t_ns: u64, tail: &[u8]) -> bool {
        let Some(port) = &mut self.inputs else { return true };
        let sent = port.send_tail(Inputs { data_t_ns, ranges, ..Inputs::default() }, tail).is_ok();
        port.ring();
        sent
    }
}

pub(super) type Served = ProcessImage<Ports>;

/// A serial line with its ports.
struct Port {
    name: String,
    rx: Subscriber<SerialChunk>,
    tx: Publisher<SerialChunk>,
    answer_within_ns: u64,
    line: Line,
}

impl Port {
    /// Takes what the driver has, answers it. Returns whether there may be more.
    fn serve(&mut self, image: &RefCell<Served>, enabled: bool) -> bool {
        let Self { rx, tx, line, answer_within_ns, .. } = self;
        let mut sent = false;
        let taken = rx.drain(CHUNKS_PER_WAKE, |chunk, bytes| {
            if !enabled {
                return line.switched_off();
            }
            let mut image = image.borrow_mut();
            image.begin();
            line.chunk(chunk, bytes, &mut *image, &mut |frame| {
                let header = SerialChunk {
                    first_t_ns: clock::mono_ns() + *answer_within_ns,
                    ..SerialChunk::default()
                };
                let queued = tx.send_tail(header, frame).is_ok();
                sent |= queued;
                queued
            });
        });
        if sent {
            tx.ring();
        }
        taken == CHUNKS_PER_WAKE
    }
}

/// Everything that lives.
struct Live {
    config: Config,
    plc: String,
    image: Rc<RefCell<Served>>,
    tcp: Option<(Rc<Hub<Served>>, Option<SocketAddr>)>,
    rtu: Option<(Rc<Hub<Served>>, Option<SocketAddr>)>,
    ports: Vec<Port>,
    jobs: Subscriber<Job>,
    results: Publisher<JobResult>,
    /// What `enable` or the last command says.
    wanted: bool,
    enable_bit: Option<BitPlace>,
    /// What the bit said when the image was fresh.
    bit: bool,
    enabled: bool,
}

/// Serves until the launcher says stop.
pub fn run(ctx: Context) -> Result<(), ServiceError> {
    let service = ctx.service.clone();
    let failed = |source| ServiceError::Run {
        service,
        source: RunError::System { kind: KIND, what: "starting the runtime", source },
    };
    run_here(serve(ctx), failed)
}

async fn serve(mut ctx: Context) -> Result<(), ServiceError> {
    let service = ctx.service.clone();
    let failed = |source| ServiceError::Run { service: service.clone(), source };
    let mut wakes = Wakes::new(KIND, &mut ctx).map_err(failed)?;
    let mut live = Live::open(&mut ctx)?;
    // The owned inputs go out before the service counts as ready, so that the first scan need not wait.
    live.tick(&mut ctx);
    ctx.ready();
    live.turns(&mut ctx, &mut wakes).await.map_err(failed)
}

/// Opens what the transports of a configuration need.
fn hub(
    ctx: &mut Context,
    name: &'static str,
    image: &Rc<RefCell<Served>>,
    device: Device,
    options: Options,
) -> Result<(Rc<Hub<Served>>, Option<SocketAddr>), ServiceError> {
    let (listener, address) = listener(KIND, ctx, name)
        .map_err(|source| ServiceError::Run { service: ctx.service.clone(), source })?;
    let hub = Hub::new(Rc::clone(image), device, options);
    tokio::task::spawn_local(hub.clone().accept(listener));
    Ok((hub, address))
}

/// Time of one character on the line of a serial service.
fn char_ns(ctx: &Context, port: &str) -> u64 {
    let config = ctx.stack.service(port).map(|port| port.config.clone());
    let config = config.and_then(|config| serde_json::from_value::<dinrail_serial::Config>(config).ok());
    config.map_or(0, |config| config.timing().char_ns)
}

impl Live {
    fn open(ctx: &mut Context) -> Result<Self, ServiceError> {
        let service = ctx.service.clone();
        let rail = |source: RailError| ServiceError::Rail { service: service.clone(), source };
        let config: Config = ctx.config().map_err(rail)?;
        let plc = ctx.entry().and_then(|entry| entry.wiring.plc.clone());
        let plc = plc.ok_or_else(|| ServiceError::NoPlc { service: service.clone() })?;
        let addressing = addressing_of(ctx.stack.service(&plc));
        let wrong = |text: String| ServiceError::Config { service: service.clone(), text };
        let enable_bit = config.enable_bit(addressing).map_err(|e| wrong(e.to_string()))?;
        let image = Rc::new(RefCell::new(build_image(ctx, &config, &plc)?));
        let shared = Shared {
            identity: Rc::new(config.identity.build().map_err(|e| wrong(e.to_string()))?),
            rights: Rc::new(Rights::new(&config.rights, &config.lines()).map_err(|e| wrong(e.to_string()))?),
            serial_codes_on_tcp: config.serial_codes_on_tcp,
        };
        let tcp = match config.tcp() {
            None => None,
            Some(tcp) => {
                let device = Device::tcp(config.units.as_deref(), &config.own_units(), shared.clone());
                Some(hub(ctx, LISTENER, &image, device, tcp.options(Framing::Tcp))?)
            }
        };
        let rtu = match &config.rtu_over_tcp {
            None => None,
            Some(rtu) => {
                let device = Device::line(&config.units_of(&rtu.unit), rtu.answer_255, shared.clone());
                Some(hub(ctx, RTU_LISTENER, &image, device, rtu.tcp().options(Framing::Rtu))?)
            }
        };
        let mut ports = Vec::new();
        for (index, serial) in config.serial.iter().enumerate() {
            let device = Device::line(&config.units_of(&serial.unit), serial.answer_255, shared.clone());
            ports.push(Port {
                name: serial.port.clone(),
                rx: ctx.subscriber(&TopicKind::SerialRx.of(&serial.port)).map_err(rail)?,
                tx: ctx.publisher(&TopicKind::SerialTx.of(&serial.port)).map_err(rail)?,
                answer_within_ns: serial.answer_within.ns(),
                line: Line::new(serial.mode, index, device, ctx.writer, ctx.generation)
                    .with_char_ns(char_ns(ctx, &serial.port)),
            });
        }
        let live = Self {
            wanted: config.enable,
            enable_bit,
            bit: false,
            enabled: true,
            jobs: ctx.subscriber(&TopicKind::Jobs.of(&service)).map_err(rail)?,
            results: ctx.publisher(&TopicKind::Results.of(&service)).map_err(rail)?,
            config,
            plc,
            image,
            tcp,
            rtu,
            ports,
        };
        Ok(live)
    }

    async fn turns(&mut self, ctx: &mut Context, wakes: &mut Wakes) -> Result<(), RunError> {
        let (mut ticks, mut more, mut changed) = (0_u32, false, false);
        loop {
            let mut ticked = false;
            tokio::select! {
                biased;
                wake = wakes.next() => match wake? {
                    Wake::Shutdown => return Ok(()),
                    Wake::Beat => ticked = true,
                    Wake::Rail => {}
                },
                () = std::future::ready(()), if more => {}
            }
            more = self.serve_lines();
            changed |= self.take_jobs(ctx);
            if more {
                tokio::task::yield_now().await;
            }
            if !ticked {
                continue;
            }
            ctx.beat();
            changed |= self.tick(ctx);
            if ticks == 0 {
                self.hubs().for_each(|hub| hub.sweep());
            }
            if ticks == 0 || std::mem::take(&mut changed) {
                self.tell_status(ctx);
            }
            ticks = (ticks + 1) % STATUS_BEATS;
        }
    }

    fn hubs(&self) -> impl Iterator<Item = &Rc<Hub<Served>>> {
        self.tcp.iter().chain(&self.rtu).map(|(hub, _)| hub)
    }

    /// Whether there may be more to take.
    fn serve_lines(&mut self) -> bool {
        let (image, enabled) = (&self.image, self.enabled);
        self.ports.iter_mut().fold(false, |more, port| port.serve(image, enabled) | more)
    }

    /// Whether the command changed something.
    fn take_jobs(&mut self, ctx: &mut Context) -> bool {
        let Self { jobs, results, wanted, .. } = self;
        let (now, before) = (clock::mono_ns(), *wanted);
        jobs.drain(JOBS_PER_WAKE, |job, tail| {
            let (code, body) = if now > job.deadline_t_ns {
                (2, json!({ "error": "expired before it was read" }))
            } else {
                order(tail, wanted)
            };
            let header = JobResult {
                job_seq: job.stamp.seq,
                job_writer: job.stamp.writer,
                job_generation: job.stamp.generation,
                code,
                ..JobResult::default()
            };
            let _ = results.send_tail(header, body.to_string().as_bytes());
        });
        results.ring();
        let changed = before != self.wanted;
        if changed {
            self.follow_enable(ctx);
        }
        changed
    }

    /// Switches on or off what command and bit ask for. Whether that changed something.
    fn follow_enable(&mut self, ctx: &mut Context) -> bool {
        if let Some(place) = self.enable_bit {
            // Without a fresh image the last word counts.
            self.bit = self.image.borrow().bit(place).unwrap_or(self.bit);
        }
        let enabled = self.wanted && (self.enable_bit.is_none() || self.bit);
        if enabled == self.enabled {
            return false;
        }
        self.enabled = enabled;
        self.hubs().for_each(|hub| hub.set_enabled(enabled));
        let why = if self.wanted { "by the bit of enable_from" } else { "by configuration or command" };
        let message = if enabled {
            "the Modbus server is switched on".to_owned()
        } else {
            format!("the Modbus server is switched off {why}: it answers nobody")
        };
        ctx.event(EventKind::BusState, Level::Info, message, json!({ "enabled": enabled }));
        true
    }

    /// Work of every 50 ms. Returns whether the list of clients or the state changed.
    fn tick(&mut self, ctx: &mut Context) -> bool {
        let mut changes = Vec::new();
        {
            let mut image = self.image.borrow_mut();
            if self.config.clients_to.is_some() {
                let mut peers = Vec::new();
                self.hubs().for_each(|hub| hub.for_each_peer(|peer| peers.push(peer)));
                image.list_clients(peers.into_iter());
            }
            image.tick(|change| changes.push(change));
        }
        let switched = self.follow_enable(ctx);
        for change in &changes {
            tell_change(*change, ctx, &self.config, &self.plc);
        }
        let mut news = false;
        for hub in self.hubs() {
            let (happenings, left_out) = hub.take_happenings();
            for happening in &happenings {
                tell_client(happening, ctx);
            }
            if left_out > 0 {
                let message = format!("{left_out} more connections came, went or were refused");
                ctx.event(EventKind::Client, Level::Warning, message, Value::Null);
            }
            news |= !happenings.is_empty();
        }
        switched || news || !changes.is_empty()
    }

    fn tell_status(&self, ctx: &mut Context) {
        let image = self.image.borrow();
        let lines: Vec<LineStatus<'_>> = self
            .ports
            .iter()
            .map(|port| LineStatus {
                port: &port.name,
                counters: port.line.counters(),
                rail: port.rx.counters(),
            })
            .collect();
        let hub = |hub: &Option<(Rc<Hub<Served>>, Option<SocketAddr>)>| hub.clone();
        ctx.status(&status::body(&image, self.enabled, &hub(&self.tcp), &hub(&self.rtu), &lines));
    }
}

/// Carries out a command.
fn order(tail: &[u8], wanted: &mut bool) -> (u32, Value) {
    let job: Value = match serde_json::from_slice(tail) {
        Ok(job) => job,
        Err(e) => return (1, json!({ "error": format!("the job is no JSON: {e}") })),
    };
    match job.get("do").and_then(Value::as_str) {
        Some("enable") => *wanted = true,
        Some("disable") => *wanted = false,
        other => {
            let what = other.unwrap_or("nothing");
            return (3, json!({ "error": format!("a modbus-server cannot do '{what}': enable, disable") }));
        }
    }
    (0, json!({ "ok": true }))
}

fn build_image(ctx: &mut Context, config: &Config, plc: &str) -> Result<Served, ServiceError> {
    let service = ctx.service.clone();
    let rail = |source| ServiceError::Rail { service: service.clone(), source };
    let wrong = |text: String| ServiceError::Config { service: service.clone(), text };
    let addressing = addressing_of(ctx.stack.service(plc));
    let maps: Result<Vec<_>, _> = config.maps().map(|map| map.build(AreaSizes::MAX, addressing)).collect();
    let mut maps = maps.map_err(|source| ServiceError::Map { service: service.clone(), source })?.into_iter();
    let first = maps.next().ok_or_else(|| wrong("there is no map".to_owned()))?;
    let watchdog = match config.write_watchdog {
        None => None,
        Some(limit) => {
            let values = config
                .watchdog_write(addressing)
                .map_err(|source| ServiceError::Watchdog { service: service.clone(), source })?;
            Some(Watchdog::new(limit.ns(), values, ctx.generation > 1, clock::mono_ns()))
        }
    };
    let buffers = Buffers::new(&config.file, &config.fifo, AreaSizes::MAX, addressing)
        .map_err(|e| wrong(e.to_string()))?;
    let list = config.client_list(addressing).map_err(|e| wrong(e.to_string()))?;
    let status = config.exception_bits(addressing).map_err(|e| wrong(e.to_string()))?;
    let owns = ctx.entry().is_some_and(|entry| !entry.wiring.inputs.is_empty());
    let inputs =
        if owns { Some(ctx.publisher(&TopicKind::Inputs.of(&service)).map_err(rail)?) } else { None };
    let ports = Ports {
        image: ctx.subscriber(&TopicKind::Image.of(plc)).map_err(rail)?,
        writes: ctx.publisher(&TopicKind::Writes.of(plc)).map_err(rail)?,
        inputs,
    };
    let view = View::new(ctx.writer, ctx.generation, config.stale_after.ns());
    Ok(ProcessImage::new(ports, view, first, config.on_stop, watchdog)
        .with_maps(maps.collect(), list)
        .with_buffers(buffers)
        .with_exception_status(status))
}

fn tell_change(change: Change, ctx: &mut Context, config: &Config, plc: &str) {
    let detail = Value::Null;
    match change {
        Change::NotServing => {
            let message = format!(
                "'{plc}' does not run or its image is older than {}: Modbus requests are answered by exception 04",
                config.stale_after
            );
            ctx.event(EventKind::SafeEntered, Level::Fault, message, detail);
        }
        Change::Serving => {
            let message = format!("'{plc}' runs: Modbus requests are carried out");
            ctx.event(EventKind::SafeLeft, Level::Info, message, detail);
        }
        Change::WatchdogFired => {
            let limit = config.write_watchdog.unwrap_or_default();
            let message = format!("no Modbus client has written for {limit}: watchdog_values were written");
            ctx.event(EventKind::SafeEntered, Level::Fault, message, detail);
        }
        Change::WatchdogCleared => {
            ctx.event(EventKind::SafeLeft, Level::Info, "a Modbus client writes again", detail);
        }
    }
}

fn tell_client(happening: &Happening, ctx: &mut Context) {
    let detail = serde_json::to_value(happening).unwrap_or_default();
    let level = if matches!(happening, Happening::Refused { .. }) { Level::Warning } else { Level::Info };
    ctx.event(EventKind::Client, level, happening.to_string(), detail);
}
