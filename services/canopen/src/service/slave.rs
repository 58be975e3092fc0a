//! The service `canopen-slave`: rail ports, clocks, the loop.

use super::outputs::{Unsafe, gather, judge};
use super::{
    BEAT, EVENTS_A_SECOND, REPEAT_NS, RunError, STATUS_BEATS, TAKE_FRAMES, addressing_near, load,
    no_only_bus, plc_of,
};
use crate::config::{SafeOn, SlaveConfig as Config};
use crate::device::Device;
use crate::mistakes::Mistakes;
use crate::protocol::cob_id::predefined;
use crate::protocol::emcy::register;
use crate::protocol::io::Outbox;
use crate::protocol::lss::slave::LssSlaveEvent;
use crate::protocol::nmt::NmtState;
use crate::protocol::node::{Node, NodeEvent, NodeParams};
use crate::slave::image_map::{self, ImageMap};
use crate::slave::{drop_synchronous, is_late_sync, simulation};
use dinrail_iec::Addressing;
use ipc_types::event::{EventKind, Level};
use ipc_types::inbox::Inbox;
use ipc_types::payload::{CanFrame, Image, Inputs, can_flag};
use ipc_types::port::{Publisher, SendError, Subscriber};
use ipc_types::reactor::{Reactor, Wake};
use ipc_types::stack::{ServiceEntry, Severity};
use ipc_types::topic::TopicKind;
use ipc_types::wiring::{Neighbours, TopicDecl};
use ipc_types::{Context, Finding, Stack, Wiring, clock, plc_table};
use serde_json::{Value, json};
use std::collections::VecDeque;
use std::io::Write as _;
use std::path::{Path, PathBuf};

/// Frames that wait for room in the driver's queue; more are dropped and counted.
const MAX_WAITING: usize = 1024;
/// A full queue of the driver is tried again after this time.
const RETRY_NS: u64 = 1_000_000;
/// Emergency code of this device: its process image is not alive (CiA 301 V4.2, table 26: FF00h, device specific).
const EMCY_IMAGE: u16 = 0xFF10;
/// A node-id that LSS has yet to give (CiA 305 V3.0, 4.3.3).
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
    let mut found: Vec<Finding> = mistakes
        .0
        .iter()
        .map(|m| Finding {
            severity: if m.warning { Severity::Warning } else { Severity::Error },
            ..Finding::error(name, &m.key, &m.message, &m.help)
        })
        .collect();
    if config.bus.is_none() {
        found.extend(no_only_bus(stack, name));
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
        (lss.store, lss.bit_timing) = (config.store.is_some(), 0);
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
    let read =
        |suffix: &str| wiring.reads.iter().find(|r| r.topic.ends_with(suffix)).map(|r| r.topic.clone());
    let rx = read("/rx").map(|topic| ctx.subscriber(&topic)).transpose()?;
    let image = read("/image").map(|topic| ctx.subscriber(&topic)).transpose()?;
    let tx = wiring.writes.first().map(|(topic, _)| ctx.publisher(topic)).transpose()?;
    let name = ctx.service.clone();
    let published = if map.ranges() == 0 { None } else { Some(ctx.publisher(&TopicKind::Inputs.of(&name))?) };
    let mut inbox = ctx.inbox()?;
    let mut reactor = Reactor::new()?;
    let wakes = Wakes {
        inbox: reactor.add(inbox.fd())?,
        stop: reactor.add(ctx.shutdown_fd())?,
        beat: reactor.add_timer(BEAT)?,
        alarm: reactor.add_alarm()?,
    };
    let mut service = Service {
        unechoed: 0,
        serial,
        gathered: vec![0; map.gathered_bytes()],
        safe: image.is_some().then_some(Unsafe::Waiting),
        ctx,
        config,
        node,
        map,
        keep,
        rx,
        image,
        tx,
        published,
        out: Outbox::default(),
        waiting: VecDeque::with_capacity(MAX_WAITING),
        dropped: 0,
        published_ns: 0,
        data_t_ns: 0,
        image_ns: 0,
        event_budget: EVENTS_A_SECOND,
        events_left_out: 0,
    };
    service.begin();
    service.work(&mut reactor, &mut inbox, &wakes)
}

struct Wakes {
    inbox: Wake,
    stop: Wake,
    beat: Wake,
    alarm: Wake,
}

struct Service {
    ctx: Context,
    config: Config,
    /// Error control messages sent whose echo has not come.
    unechoed: u32,
    /// Serial number, which a reset to defaults would lose.
    serial: Option<u32>,
    node: Node,
    map: ImageMap,
    keep: Keep,
    rx: Option<Subscriber<CanFrame>>,
    image: Option<Subscriber<Image>>,
    tx: Option<Publisher<CanFrame>>,
    published: Option<Publisher<Inputs>>,
    gathered: Vec<u8>,
    out: Outbox,
    waiting: VecDeque<CanFrame>,
    dropped: u64,
    published_ns: u64,
    data_t_ns: u64,
    image_ns: u64,
    safe: Option<Unsafe>,
    event_budget: u32,
    events_left_out: u32,
}

impl Service {
    fn begin(&mut self) {
        self.publish(true);
        self.ctx.ready();
        self.node.start(clock::mono_ns(), &mut self.out);
        self.after(clock::mono_ns());
        self.status();
    }

    fn work(&mut self, reactor: &mut Reactor, inbox: &mut Inbox, wakes: &Wakes) -> Result<(), RunError> {
        let mut beats = 0u32;
        let mut alarm_ns = None;
        loop {
            let (mut rang, mut beat) = (false, false);
            for &wake in reactor.wait(None)? {
                rang |= wake == wakes.inbox;
                beat |= wake == wakes.beat;
                if wake == wakes.alarm {
                    alarm_ns = None;
                }
                if wake == wakes.stop {
                    return Ok(());
                }
            }
            if rang {
                inbox.drain();
            }
            let more = self.take_frames();
            self.take_image();
            let now_ns = clock::mono_ns();
            self.watch(now_ns);
            self.node.on_time(now_ns, &mut self.out);
            self.after(now_ns);
            if beat {
                beats += 1;
                self.ctx.beat();
                if now_ns.saturating_sub(self.published_ns) >= REPEAT_NS {
                    self.publish(false);
                }
                if beats.is_multiple_of(STATUS_BEATS) {
                    self.status();
                }
            }
            if let Some(next_ns) = self.next_ns(now_ns, more)
                && alarm_ns != Some(next_ns)
            {
                reactor.set_alarm(wakes.alarm, next_ns)?;
                alarm_ns = Some(next_ns);
            }
        }
    }

    fn next_ns(&self, now_ns: u64, more: bool) -> Option<u64> {
        if more {
            return Some(now_ns);
        }
        let watched = self.image.is_some() && self.safe.is_none();
        let stale_ns = watched.then(|| self.image_ns.saturating_add(self.config.stale_after.ns()));
        let retry_ns = (!self.waiting.is_empty()).then(|| now_ns.saturating_add(RETRY_NS));
        let next = self.node.next_deadline().into_iter().chain(stale_ns).chain(retry_ns).min();
        next.map(|at_ns| at_ns.max(now_ns + 1))
    }

    /// Takes frames of the bus; true when more may wait.
    fn take_frames(&mut self) -> bool {
        let Some(mut rx) = self.rx.take() else { return false };
        let mut last_ns = 0;
        let taken = rx.drain(TAKE_FRAMES, |frame, _| {
            if frame.fault().is_none() && !self.is_own(frame) {
                last_ns = frame.stamp.t_ns;
                self.node.on_frame(frame.stamp.t_ns, frame, &mut self.out);
                self.react(frame.stamp.t_ns);
                if is_late_sync(&self.node, frame, clock::mono_ns()) {
                    drop_synchronous(&mut self.out);
                }
            }
        });
        self.rx = Some(rx);
        if last_ns > 0 {
            self.data_t_ns = last_ns;
        }
        self.after(clock::mono_ns());
        taken == TAKE_FRAMES
    }

    /// Whether this is the echo of an error control message of this device, which would otherwise look like another
    /// device with its node-id. Echoes of one stack do not tell who sent them, so they are counted.
    fn is_own(&mut self, frame: &CanFrame) -> bool {
        let own = frame.flags & can_flag::TX_ECHO != 0
            && frame.can_id == predefined::ERROR_CONTROL + u32::from(self.node.node_id())
            && self.unechoed > 0;
        self.unechoed -= u32::from(own);
        own
    }

    /// What the node did: events, frames, inputs.
    fn after(&mut self, now_ns: u64) {
        self.react(now_ns);
        self.send();
        let good = self.node.state() == NmtState::Operational;
        if self.published.is_some() && self.map.collect(&self.node, good) {
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
                    if let Some(serial) = self.serial {
                        let _ = self.node.write(t_ns, 0x1018, 4, &serial.to_le_bytes(), &mut self.out);
                    }
                    // The objects have their defaults again: what the image says comes back at once.
                    self.map.apply(t_ns, &mut self.node, &self.gathered, &mut self.out);
                }
                NodeEvent::StoreChanged => self.store(t_ns),
                NodeEvent::Lss(LssSlaveEvent::Store { node_id, .. }) => self.store_lss(node_id),
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
        if self.event_budget == 0 {
            self.events_left_out += 1;
            return;
        }
        self.event_budget -= 1;
        self.ctx.event(kind, level, text, Value::Null);
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

    /// Hands frames to the driver, in order; what finds no room waits.
    fn send(&mut self) {
        let Some(tx) = &mut self.tx else { return };
        for frame in self.out.drain() {
            if self.waiting.len() < MAX_WAITING {
                self.waiting.push_back(frame);
            } else {
                self.dropped += 1;
            }
        }
        let mut any = false;
        while let Some(frame) = self.waiting.front() {
            match tx.send(*frame) {
                Ok(_) => {
                    any = true;
                    let error_control = predefined::ERROR_CONTROL + u32::from(self.node.node_id());
                    self.unechoed += u32::from(frame.can_id == error_control);
                    self.waiting.pop_front();
                }
                // The driver is away or busy: old frames are of no use to anybody.
                Err(SendError::NoReader(_)) => {
                    self.dropped += self.waiting.len() as u64;
                    self.waiting.clear();
                    self.unechoed = 0;
                }
                Err(SendError::Full(_)) => break,
                Err(e) => {
                    tracing::warn!("frame {:03X}: {e}", frame.id());
                    self.waiting.pop_front();
                }
            }
        }
        if any {
            tx.ring();
        }
    }

    /// `fresh`: news, so the plc is woken; otherwise a repetition.
    fn publish(&mut self, fresh: bool) {
        let Some(port) = &mut self.published else { return };
        let header = Inputs { data_t_ns: self.data_t_ns, ranges: self.map.ranges(), ..Inputs::default() };
        if let Err(e) = port.send_tail(header, self.map.tail()) {
            tracing::warn!("inputs: {e}");
        }
        if fresh {
            port.ring();
        }
        self.published_ns = clock::mono_ns();
    }

    fn take_image(&mut self) {
        let Some(port) = &mut self.image else { return };
        let (ranges, gathered) = (&self.map.output_ranges, &mut self.gathered);
        let stale_ns = self.config.stale_after.ns();
        let mut verdict = None;
        let mut image_ns = self.image_ns;
        port.newest(|image, tail| {
            let Some((_, q, m)) = image.areas(tail) else { return };
            image_ns = image.stamp.t_ns;
            let why = judge(image.plc_state(), image.scan, &[SafeOn::Stop, SafeOn::Fault, SafeOn::Halted]);
            let fresh = clock::mono_ns().saturating_sub(image_ns) <= stale_ns;
            let why = why.or((!fresh).then_some(Unsafe::Stale));
            if why.is_none() {
                gather(ranges, q, m, gathered);
            }
            verdict = Some(why);
        });
        self.image_ns = image_ns;
        if let Some(why) = verdict {
            if why.is_none() {
                self.map.apply(clock::mono_ns(), &mut self.node, &self.gathered, &mut self.out);
            }
            self.set_safe(why);
        }
    }

    /// Notices an image that stopped coming.
    fn watch(&mut self, now_ns: u64) {
        let age_ns = now_ns.saturating_sub(self.image_ns);
        if self.image.is_some() && self.safe.is_none() && age_ns > self.config.stale_after.ns() {
            self.set_safe(Some(Unsafe::Stale));
        }
    }

    /// The device tells the network that nobody drives it, and does as 1029h says.
    fn set_safe(&mut self, why: Option<Unsafe>) {
        if self.safe == why {
            return;
        }
        let was = std::mem::replace(&mut self.safe, why);
        let now_ns = clock::mono_ns();
        match (was, why) {
            (None, Some(why)) => {
                self.node.raise(
                    now_ns,
                    EMCY_IMAGE,
                    0,
                    register::GENERIC,
                    [why as u8, 0, 0, 0, 0],
                    &mut self.out,
                );
                self.node.device_failed(now_ns, &mut self.out);
                let message = format!("the device reports an error to the network: {}", why.text());
                self.ctx.event(EventKind::SafeEntered, why.level(), message, json!({ "why": why }));
            }
            (Some(was), None) => {
                self.node.clear(now_ns, EMCY_IMAGE, 0, &mut self.out);
                if was != Unsafe::Waiting {
                    let message = "the device works again";
                    self.ctx.event(EventKind::SafeLeft, Level::Info, message, Value::Null);
                }
            }
            _ => {}
        }
        self.send();
    }

    fn status(&mut self) {
        if self.events_left_out > 0 {
            let message = format!("{} more events in the last second left out", self.events_left_out);
            self.ctx.event(EventKind::NodeState, Level::Warning, message, Value::Null);
        }
        (self.event_budget, self.events_left_out) = (EVENTS_A_SECOND, 0);
        let history: Vec<String> =
            self.node.error_history().iter().take(8).map(|e| format!("{e:08X}h")).collect();
        let status = json!({
            "node_id": self.node.node_id(),
            "state": self.node.state().name(),
            "error_register": self.node.error_register(),
            "errors": history,
            "frames_dropped": self.dropped,
            "frames_waiting": self.waiting.len(),
            "safe": self.safe,
            "rx": self.rx.as_ref().map(Subscriber::counters),
        });
        self.ctx.status(&status);
    }
}
