//! The service `canopen-slave`: rail ports, clocks, the loop.

mod boot_up;
mod jobs;

use super::job_port::JobPort;
use super::ports::{Ports, Station};
use super::{EVENTS_A_SECOND, RunError, SEND_AT, TAKE_FRAMES, addressing_near, load, node_ids, plc_of};
use crate::config::SlaveConfig as Config;
use crate::device::Device;
use crate::mistakes::Mistakes;
use crate::protocol::cob_id::predefined;
use crate::protocol::emcy::register;
use crate::protocol::io::Outbox;
use crate::protocol::lss::BIT_TIMING_KBIT;
use crate::protocol::lss::slave::LssSlaveEvent;
use crate::protocol::nmt::NmtState;
use crate::protocol::node::{Node, NodeEvent, NodeParams};
use crate::protocol::time_stamp::TimeOfDay;
use crate::slave::image_map::{self, ImageMap};
use crate::slave::{drop_synchronous, is_late_sync, simulation};
use boot_up::BootUpFirst;
use dinrail_iec::Addressing;
use ipc_types::can_queue::Handed;
use ipc_types::event::{Budget, EventKind, Level};
use ipc_types::outputs::{Change, Guard, SafeOn, Words, gather};
use ipc_types::payload::{CanFrame, Inputs};
use ipc_types::port::Subscriber;
use ipc_types::stack::ServiceEntry;
use ipc_types::topic::TopicKind;
use ipc_types::turns::Turns;
use ipc_types::units::BitRate;
use ipc_types::wiring::{Neighbours, TopicDecl};
use ipc_types::{Context, Finding, Stack, Wiring, clock, plc_table};
use jobs::Errors;
use serde_json::{Value, json};
use std::io::Write as _;
use std::path::{Path, PathBuf};

/// Emergency code of this device: its process image is not alive (CiA 301 V4.2, table 26: FF00h, device specific).
const EMCY_IMAGE: u16 = 0xFF10;
/// What the device does when its image is not alive.
const WORDS: Words =
    Words { entered: "the device reports an error to the network", left: "the device works again" };
/// Jobs that can wait, and bytes of one and of its result.
const MAX_JOBS: u32 = 8;
const JOB_BYTES: u32 = 512;
/// Bit rate of a bus whose table names none.
const DEFAULT_BITRATE: BitRate = BitRate(500_000);
/// A node-id that LSS has yet to give (CiA 305 V3.0).
const UNCONFIGURED: u8 = 255;

fn planned(config: &Config, dir: &Path, addressing: Addressing) -> (Option<Device>, ImageMap, Mistakes) {
    let mut mistakes = Mistakes::default();
    if !matches!(config.node_id, 1..=127 | UNCONFIGURED) {
        let message = format!("node-id {} does not exist", config.node_id);
        mistakes.add("node_id", message, "take 1 to 127, or 255 for a device that LSS configures");
    }
    let device = load::slave(config, dir, &mut mistakes);
    let map = match &device {
        Some(device) => image_map::plan(config, device, addressing, &mut mistakes),
        None => ImageMap::default(),
    };
    if config.simulate.is_some() && !config.map.is_empty() {
        mistakes.add(
            "map",
            "a simulated device has no process image",
            "use eds = \"FILE\" for a device of a PLC",
        );
    }
    (device, map, mistakes)
}

/// What the service needs of the launcher.
pub fn topics(config: &Config, neighbours: &Neighbours) -> Wiring {
    let plc = neighbours.resolve("plc", config.plc.as_deref()).filter(|_| config.simulate.is_none());
    let addressing = addressing_near(neighbours, plc.as_deref());
    let (_, map, _) = planned(config, &neighbours.dir, addressing);
    let mut wiring = Wiring { plc, ..Wiring::default() };
    if map.ranges() > 0 {
        wiring.topics.push(TopicDecl::new(TopicKind::Inputs).max_tail(map.tail().len() as u32));
    }
    // A device may be one of many: small queues.
    wiring.topics.push(TopicDecl::new(TopicKind::Jobs).depth(MAX_JOBS).max_tail(JOB_BYTES));
    wiring.topics.push(TopicDecl::new(TopicKind::Results).depth(MAX_JOBS).max_tail(JOB_BYTES));
    wiring.read(TopicKind::Jobs.of(&neighbours.name), true, "");
    if let Some(bus) = neighbours.resolve("can", config.bus.as_deref()) {
        wiring.read(TopicKind::CanRx.of(&bus), true, "bus");
        wiring.write(TopicKind::CanTx.of(&bus), "bus");
    }
    if !map.output_ranges.is_empty()
        && let Some(plc) = &wiring.plc
    {
        let topic = TopicKind::Image.of(plc);
        wiring.read(topic, true, "plc");
    }
    if let Some(eds) = &config.eds {
        wiring.files.push((eds.into(), "eds".to_owned()));
    }
    wiring.inputs = map.input_ranges;
    wiring.outputs = map.output_ranges;
    wiring
}

/// Every mistake that can be found without starting.
pub fn check(config: &Config, stack: &Stack, me: &ServiceEntry) -> Vec<Finding> {
    let name = &me.name;
    let (plc, addressing) = plc_of(stack, &me.wiring);
    let (_, _, mistakes) = planned(config, &stack.dir, addressing);
    let mut found: Vec<Finding> = mistakes.0.iter().map(|m| m.finding(name)).collect();
    found.extend(node_ids::check_slave(config, stack, me));
    if config.bus.is_none() {
        found.extend(stack.check_only(name, "bus", "can"));
    }
    if !me.wiring.outputs.is_empty() {
        found.extend(plc.and_then(|plc| plc_table::check_stale_after(name, config.stale_after, plc)));
    }
    found
}

/// What is kept over power-off: the node's stored objects and the node-id that LSS gave.
struct Keep {
    file: Option<PathBuf>,
}

impl Keep {
    fn lss_file(&self) -> Option<PathBuf> {
        self.file.as_ref().map(|f| f.with_added_extension("lss"))
    }

    fn objects(&self) -> Vec<u8> {
        self.file.as_ref().and_then(|f| std::fs::read(f).ok()).unwrap_or_default()
    }

    fn node_id(&self) -> Option<u8> {
        let text = std::fs::read_to_string(self.lss_file()?).ok()?;
        text.trim().parse().ok().filter(|&id: &u8| matches!(id, 1..=127 | UNCONFIGURED))
    }

    /// Whole or not at all: written beside, then renamed.
    fn write(path: &Path, bytes: &[u8]) -> std::io::Result<()> {
        let beside = path.with_added_extension("new");
        let mut file = std::fs::File::create(&beside)?;
        file.write_all(bytes)?;
        file.sync_all()?;
        std::fs::rename(&beside, path)
    }
}

/// The bit rates that LSS may choose, as bits of its table: the one of the bus, which its driver owns.
fn bit_timing(stack: &Stack, wiring: &Wiring) -> u16 {
    let bus = wiring.writes.first().and_then(|(topic, _)| topic.split('/').next());
    let can = bus.and_then(|bus| stack.service(bus));
    let text = can.and_then(|can| can.config.get("bitrate")).and_then(Value::as_str);
    let rate = text.map_or(DEFAULT_BITRATE, |text| text.parse().unwrap_or(DEFAULT_BITRATE));
    let index = BIT_TIMING_KBIT.iter().position(|&kbit| kbit > 0 && u32::from(kbit) * 1000 == rate.0);
    index.map_or(0, |index| 1 << index)
}

/// Runs until the launcher says stop.
pub fn run(mut ctx: Context) -> Result<(), RunError> {
    let config: Config = ctx.config()?;
    let wiring = ctx.entry().map(|entry| entry.wiring.clone()).unwrap_or_default();
    let (_, addressing) = plc_of(&ctx.stack, &wiring);
    let (device, map, mistakes) = planned(&config, &ctx.stack.dir, addressing);
    if let Some(mistake) = mistakes.0.into_iter().find(|m| !m.warning) {
        return Err(RunError::Config { key: mistake.key, message: mistake.message });
    }
    let refused = |key: &str, message: String| RunError::Config { key: key.to_owned(), message };
    let device = device.ok_or_else(|| refused("eds", "no device".to_owned()))?;
    let keep = Keep { file: config.store.as_ref().map(|f| ctx.stack.dir.join(f)) };
    let mut params = NodeParams::new(keep.node_id().unwrap_or(config.node_id));
    if let Some(lss) = &mut params.lss {
        (lss.store, lss.bit_timing) = (config.store.is_some(), bit_timing(&ctx.stack, &wiring));
    }
    let serial = device.od.u32(0x1018, 4);
    let node = match Node::new(device.od.clone(), params, &keep.objects()) {
        Ok(node) => node,
        Err(e) => {
            // A file that was damaged must not keep the device from working.
            let message = format!("what was stored is not used: {e}");
            ctx.event(EventKind::NodeState, Level::Fault, message, Value::Null);
            Node::new(device.od, params, &[]).map_err(|e| refused("node_id", e.to_string()))?
        }
    };
    let guard = Guard::new(config.stale_after, &SafeOn::ALL);
    let ports = Ports::open(&mut ctx, &wiring, guard)?;
    let jobs = JobPort::open(&mut ctx)?;
    let mut turns = Turns::new(ctx.inbox()?, ctx.shutdown_fd())?;
    let mut service = Service {
        ctx,
        config,
        unechoed: 0,
        first: BootUpFirst::default(),
        serial,
        node,
        gathered: vec![0; map.gathered_bytes()],
        map,
        keep,
        ports,
        jobs,
        errors: Errors::default(),
        silent_until_ns: 0,
        time: None,
        out: Outbox::default(),
        data_t_ns: 0,
        events: Budget::new(EVENTS_A_SECOND),
    };
    service.introduce();
    if !service.await_driver(&mut turns)? {
        return Ok(());
    }
    service.begin();
    service.work(turns)
}

struct Service {
    ctx: Context,
    config: Config,
    /// Error control messages sent whose echo has not come.
    unechoed: u32,
    first: BootUpFirst,
    /// Serial number, which a reset to defaults would lose.
    serial: Option<u32>,
    node: Node,
    map: ImageMap,
    keep: Keep,
    ports: Ports,
    jobs: JobPort,
    errors: Errors,
    /// The bit timing is being activated: neither sends nor hears until then.
    silent_until_ns: u64,
    /// The last TIME message it consumed.
    time: Option<TimeOfDay>,
    gathered: Vec<u8>,
    out: Outbox,
    data_t_ns: u64,
    events: Budget,
}

impl Station for Service {
    fn parts(&mut self) -> (&mut Ports, &mut Context) {
        (&mut self.ports, &mut self.ctx)
    }

    fn publish(&mut self, fresh: bool) {
        let header = Inputs { data_t_ns: self.data_t_ns, ranges: self.map.ranges(), ..Inputs::default() };
        self.ports.inputs.publish(header, self.map.tail(), fresh);
    }

    fn status(&mut self) {
        self.report();
    }
}

impl Service {
    fn begin(&mut self) {
        self.node.start(clock::mono_ns(), &mut self.out);
        self.after(clock::mono_ns());
        self.status();
    }

    fn work(&mut self, mut turns: Turns) -> Result<(), RunError> {
        loop {
            let due = turns.wait()?;
            if due.stop {
                return Ok(());
            }
            turns.drain();
            let more = self.take_frames();
            self.take_image();
            self.take_jobs();
            let now_ns = clock::mono_ns();
            let change = self.ports.image.on_time(now_ns);
            self.follow(change);
            self.node.on_time(now_ns, &mut self.out);
            self.after(now_ns);
            self.regular(due);
            let next_ns = self.node.next_deadline().into_iter().chain(self.first.next_ns()).min();
            let next_ns = self.ports.next_ns(now_ns, more, next_ns);
            turns.come_again(next_ns)?;
        }
    }

    /// Takes frames of the bus; true when more may wait.
    fn take_frames(&mut self) -> bool {
        let Some(mut rx) = self.ports.rx.take() else { return false };
        let mut last_ns = 0;
        let taken = rx.drain(TAKE_FRAMES, |frame, _| {
            let hears = frame.stamp.t_ns >= self.silent_until_ns;
            if frame.fault().is_none() && !self.is_own(frame) && hears {
                last_ns = frame.stamp.t_ns;
                self.node.on_frame(frame.stamp.t_ns, frame, &mut self.out);
                self.react(frame.stamp.t_ns);
                if is_late_sync(&self.node, frame, clock::mono_ns()) {
                    drop_synchronous(&mut self.out);
                }
                if self.out.len() >= SEND_AT {
                    self.send();
                }
            }
        });
        self.ports.rx = Some(rx);
        if last_ns > 0 {
            self.data_t_ns = last_ns;
        }
        self.after(clock::mono_ns());
        taken == TAKE_FRAMES
    }

    /// Whether this is the echo of an error control message of this device, which would otherwise look like another
    /// device with its node-id. Echoes that do not tell who sent them are counted.
    fn is_own(&mut self, frame: &CanFrame) -> bool {
        let own = frame.can_id == predefined::ERROR_CONTROL + u32::from(self.node.node_id())
            && frame.echo_of(self.ctx.writer).unwrap_or(self.unechoed > 0);
        self.unechoed = self.unechoed.saturating_sub(u32::from(own));
        if own && BootUpFirst::is_boot_up(frame, frame.can_id) {
            self.first.done();
        }
        own
    }

    /// What the node did: events, frames, inputs.
    fn after(&mut self, now_ns: u64) {
        self.react(now_ns);
        self.send();
        let good = self.node.state() == NmtState::Operational;
        if self.ports.inputs.is_open() && self.map.collect(&self.node, good) {
            self.publish(true);
        }
    }

    fn react(&mut self, t_ns: u64) {
        while let Some(event) = self.node.next_event() {
            if self.config.simulate.is_some() {
                simulation::react(&mut self.node, &event, t_ns, &mut self.out);
            }
            match event {
                NodeEvent::Reset { .. } => {
                    self.errors.forget();
                    if let Some(serial) = self.serial {
                        let _ = self.node.write(t_ns, 0x1018, 4, &serial.to_le_bytes(), &mut self.out);
                    }
                    // The objects have their defaults again: what the image says comes back at once.
                    self.map.apply(t_ns, &mut self.node, &self.gathered, &mut self.out);
                }
                NodeEvent::StoreChanged => self.store(t_ns),
                NodeEvent::Lss(LssSlaveEvent::Store { node_id, .. }) => self.store_lss(node_id),
                NodeEvent::Lss(LssSlaveEvent::ActivateBitTiming { delay_ms, .. }) => {
                    // The only bit rate it takes is the one the bus has: what is left are the pauses (CiA 305 V3.0, 6.4.4).
                    self.silent_until_ns = t_ns.saturating_add(2 * u64::from(delay_ms) * 1_000_000);
                }
                NodeEvent::Time(time) => self.time = Some(time),
                other => self.tell(&other),
            }
        }
    }

    fn tell(&mut self, event: &NodeEvent) {
        let (kind, level, text) = match event {
            NodeEvent::State { to, .. } => {
                (EventKind::NodeState, Level::Info, format!("the device is {}", to.name()))
            }
            NodeEvent::DuplicateNodeId { node_id } => {
                let text =
                    format!("another device on the bus has node-id {node_id} too; give one of them another");
                (EventKind::NodeState, Level::Fault, text)
            }
            NodeEvent::EmcyRaised(emcy) if emcy.code != 0 => {
                (EventKind::Emcy, Level::Warning, format!("the device sent emergency {:04X}h", emcy.code))
            }
            NodeEvent::SyncTimeout => {
                (EventKind::NodeState, Level::Warning, "no SYNC comes any more (1006h)".to_owned())
            }
            _ => return,
        };
        if self.events.take() {
            self.ctx.event(kind, level, text, Value::Null);
        }
    }

    fn store(&mut self, t_ns: u64) {
        let Some(file) = self.keep.file.clone() else { return };
        let written = Keep::write(&file, self.node.store_image());
        if let Err(e) = &written {
            let message = format!("{}: {e}: the objects are not stored", file.display());
            self.ctx.event(EventKind::NodeState, Level::Fault, message, Value::Null);
        }
        self.node.store_failed(t_ns, written.is_err(), &mut self.out);
    }

    fn store_lss(&mut self, node_id: u8) {
        let Some(file) = self.keep.lss_file() else { return };
        if let Err(e) = Keep::write(&file, format!("{node_id}\n").as_bytes()) {
            let message = format!("{}: {e}: the node-id is not stored", file.display());
            self.ctx.event(EventKind::NodeState, Level::Fault, message, Value::Null);
        }
    }

    fn send(&mut self) {
        let now_ns = clock::mono_ns();
        if now_ns < self.silent_until_ns {
            self.out.drain().for_each(drop);
        }
        let own = predefined::ERROR_CONTROL + u32::from(self.node.node_id());
        let unechoed = &mut self.unechoed;
        let sent = |frame: &CanFrame| *unechoed += u32::from(frame.can_id == own);
        let ready = self.first.pass(now_ns, own, self.out.frames());
        if self.ports.send(self.out.drain_first(ready), sent) == Handed::Dropped {
            // The driver is away, and with it the echoes it owes.
            self.unechoed = 0;
            self.first.done();
        }
    }

    fn take_image(&mut self) {
        let Self { map, node, gathered, out, ports, .. } = self;
        let change = ports.image.take(|q, m| {
            gather(&map.output_ranges, q, m, gathered);
            map.apply(clock::mono_ns(), node, gathered, out);
        });
        self.follow(change);
    }

    /// The device tells the network that nobody drives it, and does as 1029h says.
    fn follow(&mut self, change: Option<Change>) {
        let Some(change) = change else { return };
        let now_ns = clock::mono_ns();
        match (change.was, change.why) {
            (None, Some(why)) => {
                let info = [why as u8, 0, 0, 0, 0];
                self.node.raise(now_ns, EMCY_IMAGE, 0, register::GENERIC, info, &mut self.out);
                self.node.device_failed(now_ns, &mut self.out);
            }
            (Some(_), None) => self.node.clear(now_ns, EMCY_IMAGE, 0, &mut self.out),
            _ => {}
        }
        change.tell(&mut self.ctx, &WORDS);
        self.send();
    }

    fn report(&mut self) {
        if let Some(left_out) = self.events.renew() {
            let message = format!("{left_out} more events in the last second left out");
            self.ctx.event(EventKind::NodeState, Level::Warning, message, Value::Null);
        }
        let history: Vec<String> =
            self.node.error_history().iter().take(8).map(|e| format!("{e:08X}h")).collect();
        let status = json!({
            "node_id": self.node.node_id(),
            "state": self.node.state().name(),
            "error_register": self.node.error_register(),
            "errors": history,
            "time_utc_ms": self.time.map(TimeOfDay::unix_ms),
            "frames_dropped": self.ports.queue.dropped(),
            "frames_waiting": self.ports.queue.len(),
            "safe": self.ports.image.why(),
            "rx": self.ports.rx.as_ref().map(Subscriber::counters),
        });
        self.ctx.status(&status);
    }
}
