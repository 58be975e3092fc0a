//! The service `canopen-master`: rail ports, clocks, the loop.

use super::jobs::{self, FAILED, MAX_FILE, MAX_INLINE, Request, Transfer};
use super::outputs::{Unsafe, gather, judge, values};
use super::{
    BEAT, EVENTS_A_SECOND, REPEAT_NS, RunError, STATUS_BEATS, TAKE_FRAMES, addressing_near, load,
    no_only_bus, plc_of, words,
};
use crate::config::{MasterConfig as Config, Number, ObjectRef, OnStop, OnStopWord};
use crate::device::Device;
use crate::master::exchange::Exchange;
use crate::master::network::{Event, Network, NodeRun, state_name};
use crate::master::plan::{Plan, encode, plan};
use crate::master::transfers::{JobEnd, Owner, Request as Wanted, Transfers};
use crate::protocol::cob_id::predefined;
use crate::protocol::data_type::DataType;
use crate::protocol::io::Outbox;
use crate::protocol::nmt::NmtCommand;
use crate::protocol::sdo::{Direction, Mode, Options};
use crate::protocol::time_stamp::TimeOfDay;
use ipc_types::event::{EventKind, Level};
use ipc_types::inbox::Inbox;
use ipc_types::payload::{CanFrame, HealthState, Image, Inputs, Job, JobResult};
use ipc_types::port::{Publisher, SendError, Subscriber};
use ipc_types::reactor::{Reactor, Wake};
use ipc_types::stack::{ServiceEntry, Severity};
use ipc_types::topic::TopicKind;
use ipc_types::wiring::{ImageRange, Neighbours, TopicDecl};
use ipc_types::{Context, Finding, Stack, Wiring, clock, plc_table};
use serde_json::{Value, json};
use std::collections::{BTreeMap, VecDeque};

/// Frames that wait for room in the driver's queue; more are dropped and counted.
const MAX_WAITING: usize = 1024;
/// A full queue of the driver is tried again after this time.
const RETRY_NS: u64 = 1_000_000;
/// So long the first frames wait for a driver that still starts.
const DRIVER_NS: u64 = 1_000_000_000;
/// Jobs under way; more are refused.
const MAX_JOBS: usize = 64;
/// Values of up to so many bytes are not worth a block transfer (protocol switch threshold).
const SHORT: u8 = 21;
/// What a node takes of the state of the network, with the reason of a failed boot: 512 bytes are seldom reached.
const RESULT_BYTES_A_NODE: u32 = 768;
/// Longest state of the network that is published every second (the limit of `<svc>/status`); a longer one goes
/// without the reasons of failed boots.
const STATUS_BYTES: usize = 16_384;
/// Jobs taken from the rail before other work has its turn.
const TAKE_JOBS: usize = 16;

/// What the service needs of the launcher.
pub fn topics(config: &Config, neighbours: &Neighbours) -> Wiring {
    let plc = neighbours.resolve("plc", config.plc.as_deref());
    let (devices, _) = load::devices(config, &neighbours.dir);
    let plan = plan(config, &devices, addressing_near(neighbours, plc.as_deref()), &neighbours.name);
    let mut wiring = Wiring { plc, ..Wiring::default() };
    if !plan.inputs.is_empty() {
        let tail =
            plan.exchange.input_bytes.iter().map(|&n| u32::from(n)).sum::<u32>() + plan.inputs.len() as u32;
        wiring.topics.push(TopicDecl::new(TopicKind::Inputs).max_tail(tail.max(1)));
    }
    wiring.own(TopicKind::Jobs);
    let results = TopicKind::Results.row().max_tail + RESULT_BYTES_A_NODE * config.nodes.len() as u32;
    wiring.topics.push(TopicDecl::new(TopicKind::Results).max_tail(results));
    wiring.read(TopicKind::Jobs.of(&neighbours.name), true, "");
    if let Some(bus) = neighbours.resolve("can", config.bus.as_deref()) {
        wiring.read(TopicKind::CanRx.of(&bus), true, "bus");
        wiring.write(TopicKind::CanTx.of(&bus), "bus");
    }
    if !plan.outputs.is_empty()
        && let Some(plc) = &wiring.plc
    {
        let topic = TopicKind::Image.of(plc);
        wiring.read(topic, true, "plc");
    }
    for (i, node) in config.nodes.iter().enumerate() {
        if let Some(eds) = &node.eds {
            wiring.files.push((eds.into(), format!("node[{i}].eds")));
        }
    }
    wiring.inputs = plan.inputs;
    wiring.outputs = plan.outputs;
    wiring
}

/// Every mistake that can be found without starting.
pub fn check(config: &Config, stack: &Stack, me: &ServiceEntry) -> Vec<Finding> {
    let name = &me.name;
    let (plc, addressing) = plc_of(stack, &me.wiring);
    let (devices, mut mistakes) = load::devices(config, &stack.dir);
    mistakes.extend(plan(config, &devices, addressing, name).mistakes);
    let mut found: Vec<Finding> = mistakes
        .iter()
        .map(|m| Finding {
            severity: if m.warning { Severity::Warning } else { Severity::Error },
            ..Finding::error(name, &m.key, &m.message, &m.help)
        })
        .collect();
    found.extend(safe_values(config, &me.wiring.outputs).err().map(|(key, message)| {
        Finding::error(name, &key, message, "name an address that a map entry takes from")
    }));
    if config.bus.is_none() {
        found.extend(no_only_bus(stack, name));
    }
    if !me.wiring.outputs.is_empty() {
        found.extend(plc.and_then(|plc| plc_table::check_stale_after(name, config.stale_after, plc)));
    }
    found
}

/// The gathered outputs of the safe state; `None` where they stay.
fn safe_values(config: &Config, outputs: &[ImageRange]) -> Result<Option<Vec<u8>>, (String, String)> {
    let named = match &config.on_stop {
        OnStop::Word(OnStopWord::Hold) => return Ok(None),
        OnStop::Word(OnStopWord::Zero | OnStopWord::Preop | OnStopWord::Stop) => &[][..],
        OnStop::Values(table) => &table.values,
    };
    let sources: Vec<(&str, &str)> = config
        .nodes
        .iter()
        .enumerate()
        .flat_map(|(n, node)| node.map.iter().enumerate().map(move |(m, map)| (n, m, map)))
        .filter_map(|(n, m, map)| Some((n, m, map.from.as_deref()?)))
        .filter_map(|(n, m, from)| {
            let key = format!("node[{n}].map[{m}].from");
            outputs.iter().find(|r| r.key == key).map(|r| (from, r.key.as_str()))
        })
        .collect();
    let mut list: Vec<(usize, Number)> = Vec::new();
    for (i, value) in named.iter().enumerate() {
        let found = sources.iter().find(|(from, _)| from.eq_ignore_ascii_case(&value.from));
        let place = found.and_then(|(_, key)| outputs.iter().position(|r| r.key == *key));
        match place {
            Some(place) => list.push((place, value.value.clone())),
            None => {
                return Err((
                    format!("on_stop.values[{i}].from"),
                    format!("no node receives {}", value.from),
                ));
            }
        }
    }
    Ok(Some(values(outputs, &list)))
}

/// Runs until the launcher says stop.
pub fn run(mut ctx: Context) -> Result<(), RunError> {
    let config: Config = ctx.config()?;
    let wiring = ctx.entry().map(|entry| entry.wiring.clone()).unwrap_or_default();
    let name = ctx.service.clone();
    let (_, addressing) = plc_of(&ctx.stack, &wiring);
    let (devices, mistakes) = load::devices(&config, &ctx.stack.dir);
    let mut plan = plan(&config, &devices, addressing, &name);
    let wrong = mistakes.into_iter().chain(std::mem::take(&mut plan.mistakes)).find(|m| !m.warning);
    if let Some(mistake) = wrong {
        return Err(RunError::Config { key: mistake.key, message: mistake.message });
    }
    let safe =
        safe_values(&config, &plan.outputs).map_err(|(key, message)| RunError::Config { key, message })?;
    let read =
        |suffix: &str| wiring.reads.iter().find(|r| r.topic.ends_with(suffix)).map(|r| r.topic.clone());
    let rx = read("/rx").map(|topic| ctx.subscriber(&topic)).transpose()?;
    let image = read("/image").map(|topic| ctx.subscriber(&topic)).transpose()?;
    let tx = wiring.writes.first().map(|(topic, _)| ctx.publisher(topic)).transpose()?;
    let published =
        if plan.inputs.is_empty() { None } else { Some(ctx.publisher(&TopicKind::Inputs.of(&name))?) };
    let jobs = ctx.subscriber(&TopicKind::Jobs.of(&name))?;
    let results = ctx.publisher(&TopicKind::Results.of(&name))?;
    let mut inbox = ctx.inbox()?;
    let mut reactor = Reactor::new()?;
    let wakes = Wakes {
        inbox: reactor.add(inbox.fd())?,
        stop: reactor.add(ctx.shutdown_fd())?,
        beat: reactor.add_timer(BEAT)?,
        alarm: reactor.add_alarm()?,
    };
    plan.settings.takeover = ctx.generation > 1;
    let Plan { settings, sync_window_ns, nodes, exchange, outputs, .. } = plan;
    let transfers = Transfers::new(config.nodes.iter().map(|node| {
        let timeout = node.sdo_timeout.unwrap_or(config.sdo_timeout);
        (node.id, timeout.ns())
    }));
    let names = nodes.iter().map(|n| (n.settings.plan.id, n.name.clone())).collect();
    let settings_of_nodes = nodes.into_iter().map(|n| n.settings).collect();
    let mut service = Service {
        network: Network::new(
            settings,
            settings_of_nodes,
            Exchange::new(exchange, sync_window_ns),
            transfers,
        ),
        gathered: vec![0; outputs.iter().map(|r| r.bytes as usize).sum()],
        outputs,
        safe_values: safe,
        names,
        devices,
        ctx,
        config,
        rx,
        image,
        tx,
        published,
        jobs,
        results,
        out: Outbox::default(),
        waiting: VecDeque::with_capacity(MAX_WAITING),
        driver_until_ns: clock::mono_ns() + DRIVER_NS,
        dropped: 0,
        published_ns: 0,
        image_ns: 0,
        safe: Some(Unsafe::Waiting),
        safe_told: false,
        state: HealthState::Ready,
        event_budget: EVENTS_A_SECOND,
        events_left_out: 0,
        asked: BTreeMap::new(),
        next_job: 0,
        sync_out_ns: (0, 0),
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

/// Who waits for a transfer.
struct Asked {
    seq: u64,
    writer: u32,
    generation: u32,
    file: Option<std::path::PathBuf>,
}

struct Service {
    ctx: Context,
    config: Config,
    network: Network,
    devices: BTreeMap<u8, Device>,
    names: BTreeMap<u8, String>,
    outputs: Vec<ImageRange>,
    gathered: Vec<u8>,
    safe_values: Option<Vec<u8>>,
    rx: Option<Subscriber<CanFrame>>,
    image: Option<Subscriber<Image>>,
    tx: Option<Publisher<CanFrame>>,
    published: Option<Publisher<Inputs>>,
    jobs: Subscriber<Job>,
    results: Publisher<JobResult>,
    out: Outbox,
    waiting: VecDeque<CanFrame>,
    /// Until then frames wait for a driver that was never there yet.
    driver_until_ns: u64,
    /// Frames that found no room for longer than [`MAX_WAITING`] others.
    dropped: u64,
    published_ns: u64,
    image_ns: u64,
    safe: Option<Unsafe>,
    safe_told: bool,
    state: HealthState,
    event_budget: u32,
    events_left_out: u32,
    asked: BTreeMap<u64, Asked>,
    next_job: u64,
    /// From the SYNC to its last PDO in the driver's queue: the last time, and the longest.
    sync_out_ns: (u64, u64),
}

impl Service {
    fn begin(&mut self) {
        // Tells the plc that its inputs have no data yet, so that its first scan need not wait.
        self.publish(true);
        self.ctx.ready();
        let now_ns = clock::mono_ns();
        self.network.start(now_ns, &mut self.out);
        self.send();
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
                    self.end();
                    return Ok(());
                }
            }
            // The SYNC goes before everything else.
            self.sync();
            if rang {
                inbox.drain();
            }
            let more = self.take_frames();
            self.take_image();
            self.take_jobs();
            let now_ns = clock::mono_ns();
            self.watch(now_ns);
            self.on_time();
            self.answer_jobs();
            self.tell_events();
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
            let next_ns = self.next_ns(now_ns, more);
            if let Some(next_ns) = next_ns
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
        let stale_ns =
            (self.safe.is_none()).then(|| self.image_ns.saturating_add(self.config.stale_after.ns()));
        let retry_ns = (!self.waiting.is_empty()).then(|| now_ns.saturating_add(RETRY_NS));
        let next = self.network.next_deadline().into_iter().chain(stale_ns).chain(retry_ns).min();
        // Never in the past: the clock would ring for ever.
        next.map(|at_ns| at_ns.max(now_ns + 1))
    }

    /// The SYNC and its PDOs, if it is due.
    fn sync(&mut self) {
        let (began_ns, before) = (clock::mono_ns(), self.network.counters().syncs);
        self.network.sync(began_ns, &mut self.out);
        self.send();
        if self.network.counters().syncs > before {
            let out_ns = clock::mono_ns().saturating_sub(began_ns);
            self.sync_out_ns = (out_ns, self.sync_out_ns.1.max(out_ns));
        }
    }

    fn on_time(&mut self) {
        let now_ns = clock::mono_ns();
        self.network.on_time(now_ns, &mut self.out);
        if self.network.take_time_due(now_ns) {
            let ms = u64::try_from(clock::utc_ns() / 1_000_000).unwrap_or(0);
            if let Some(time) = TimeOfDay::from_unix_ms(ms) {
                self.out.push(CanFrame::classic(predefined::TIME, &time.encode()));
            }
        }
        self.send();
        self.publish_sample();
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
                    self.driver_until_ns = 0;
                    self.waiting.pop_front();
                }
                // It starts at the same time as the master, and the reset of all nodes must not be lost.
                Err(SendError::NoReader(_)) if clock::mono_ns() < self.driver_until_ns => break,
                // The driver is away or busy: old frames are of no use to anybody.
                Err(SendError::NoReader(_)) => {
                    self.dropped += self.waiting.len() as u64;
                    self.waiting.clear();
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

    /// Takes frames of the bus; true when more may wait.
    fn take_frames(&mut self) -> bool {
        let Some(rx) = &mut self.rx else { return false };
        let (network, out) = (&mut self.network, &mut self.out);
        let taken = rx.drain(TAKE_FRAMES, |frame, _| {
            if frame.fault().is_none() {
                network.on_frame(frame.stamp.t_ns, frame, out);
            }
        });
        self.send();
        self.publish_sample();
        taken == TAKE_FRAMES
    }

    fn publish_sample(&mut self) {
        if self.network.exchange.take_sample().is_some() {
            self.publish(true);
        }
    }

    /// `fresh`: news, so the plc is woken; otherwise a repetition.
    fn publish(&mut self, fresh: bool) {
        let Some(port) = &mut self.published else { return };
        let exchange = &self.network.exchange;
        let header =
            Inputs { data_t_ns: exchange.data_t_ns(), ranges: exchange.ranges(), ..Inputs::default() };
        if let Err(e) = port.send_tail(header, exchange.tail()) {
            tracing::warn!("inputs: {e}");
        }
        if fresh {
            port.ring();
        }
        self.published_ns = clock::mono_ns();
    }

    fn take_image(&mut self) {
        let Some(port) = &mut self.image else { return };
        let (outputs, gathered, safe_on) = (&self.outputs, &mut self.gathered, &self.config.safe_on);
        let stale_ns = self.config.stale_after.ns();
        let mut verdict = None;
        let mut image_ns = self.image_ns;
        port.newest(|image, tail| {
            let Some((_, q, m)) = image.areas(tail) else { return };
            image_ns = image.stamp.t_ns;
            let why = judge(image.plc_state(), image.scan, safe_on);
            let fresh = clock::mono_ns().saturating_sub(image_ns) <= stale_ns;
            // One that waited too long in the queue is as good as none.
            let why = why.or((!fresh).then_some(Unsafe::Stale));
            if why.is_none() {
                gather(outputs, q, m, gathered);
            }
            verdict = Some(why);
        });
        self.image_ns = image_ns;
        if let Some(why) = verdict {
            if why.is_none() {
                self.network.exchange.set_outputs(&self.gathered);
            }
            self.set_safe(why);
        }
    }

    /// Notices an image that stopped coming.
    fn watch(&mut self, now_ns: u64) {
        if self.safe.is_none() && now_ns.saturating_sub(self.image_ns) > self.config.stale_after.ns() {
            self.set_safe(Some(Unsafe::Stale));
        }
    }

    fn set_safe(&mut self, why: Option<Unsafe>) {
        if self.safe == why || self.image.is_none() {
            return;
        }
        let was = std::mem::replace(&mut self.safe, why);
        match why {
            Some(why) => {
                self.enter_safe();
                if was.is_none() {
                    self.safe_told = true;
                    let message = format!("outputs went to their safe state: {}", why.text());
                    self.ctx.event(EventKind::SafeEntered, why.level(), message, json!({ "why": why }));
                }
            }
            None => {
                self.network.set_safe(clock::mono_ns(), None, &mut self.out);
                if std::mem::take(&mut self.safe_told) {
                    let message = "outputs follow the image again";
                    self.ctx.event(EventKind::SafeLeft, Level::Info, message, Value::Null);
                }
            }
        }
        self.send();
    }

    fn enter_safe(&mut self) {
        if let Some(values) = &self.safe_values {
            self.network.exchange.set_outputs(values);
        }
        let command = match self.config.on_stop {
            OnStop::Word(OnStopWord::Preop) => Some(NmtCommand::EnterPreOperational),
            OnStop::Word(OnStopWord::Stop) => Some(NmtCommand::Stop),
            _ => None,
        };
        if command.is_some() {
            self.network.set_safe(clock::mono_ns(), command, &mut self.out);
        }
    }

    /// An orderly end: the safe state goes out once more, synchronous outputs behind a last SYNC.
    fn end(&mut self) {
        self.enter_safe();
        let now_ns = clock::mono_ns();
        self.network.last_outputs(now_ns, &mut self.out);
        self.send();
        if !self.waiting.is_empty() {
            tracing::warn!(
                "{} frames of the safe state found no room in the driver's queue",
                self.waiting.len()
            );
        }
    }

    fn take_jobs(&mut self) {
        let now_ns = clock::mono_ns();
        let mut taken = Vec::new();
        self.jobs.drain(TAKE_JOBS, |job, tail| taken.push((*job, tail.to_vec())));
        for (job, tail) in taken {
            let asked = Asked {
                seq: job.stamp.seq,
                writer: job.stamp.writer,
                generation: job.stamp.generation,
                file: None,
            };
            if job.deadline_t_ns < now_ns {
                self.answer(&asked, 2, &json!({ "error": "the job is older than its deadline" }));
                continue;
            }
            match jobs::parse(&tail).and_then(|request| self.job(now_ns, request, asked.seq, &asked)) {
                Ok(Some(value)) => self.answer(&asked, 0, &json!({ "ok": value })),
                Ok(None) => {}
                Err((code, text)) => self.answer(&asked, code, &json!({ "error": text })),
            }
        }
        self.send();
    }

    /// Carries a job out, or begins to: then there is no answer yet.
    fn job(
        &mut self,
        now_ns: u64,
        request: Request,
        seq: u64,
        by: &Asked,
    ) -> Result<Option<Value>, (u32, String)> {
        let fail = |text: String| (FAILED, text);
        match request {
            Request::Status => Ok(Some(self.network_status())),
            Request::Nmt { command, node } => {
                if node > 127 {
                    return Err(fail(format!("node-id {node} does not exist; 0 is all nodes")));
                }
                self.network.nmt(now_ns, command.command(), node, &mut self.out);
                Ok(Some(json!(true)))
            }
            Request::Boot { node } => {
                if self.network.boot_again(now_ns, node, &mut self.out) {
                    Ok(Some(json!(true)))
                } else {
                    Err(fail(format!("the stack file has no node {node}")))
                }
            }
            Request::SdoRead { node, object, mode, file } => {
                let (index, sub) = self.object(node, &object).map_err(fail)?;
                let options = self.read_options(node, (index, sub), mode);
                self.transfer(now_ns, node, (index, sub), None, options, Asked { seq, file, ..*by })
            }
            Request::SdoWrite { node, object, data, value, file, mode } => {
                let (index, sub) = self.object(node, &object).map_err(fail)?;
                let data = self.data_of(node, (index, sub), data, value, file).map_err(fail)?;
                let options = Options { mode: mode.mode(), ..Options::default() };
                self.transfer(
                    now_ns,
                    node,
                    (index, sub),
                    Some(data),
                    options,
                    Asked { seq, file: None, ..*by },
                )
            }
        }
    }

    fn object(&self, node: u8, object: &ObjectRef) -> Result<(u16, u8), String> {
        if !(1..=127).contains(&node) {
            return Err(format!("node-id {node} does not exist; node-ids are 1 to 127"));
        }
        match (object.number(), self.devices.get(&node)) {
            // A number needs no EDS: devices have objects that theirs does not know.
            (Some(number), _) => Ok(number),
            (None, Some(device)) => device.resolve(object),
            (None, None) => {
                Err(format!("node {node} has no EDS that names objects; write the number of '{object}'"))
            }
        }
    }

    /// Long values are read by block, where the EDS says that the value may be long: asking every device for block
    /// transfer of four bytes would cost the others an abort.
    fn read_options(&self, node: u8, (index, sub): (u16, u8), mode: Transfer) -> Options {
        let entry = self.devices.get(&node).and_then(|d| d.od.entry(d.od.find(index, sub).ok()?));
        let long = entry.is_some_and(|e| e.data_type.size().is_none());
        match mode {
            Transfer::Auto if long => Options { mode: Mode::Block, threshold: SHORT, ..Options::default() },
            _ => Options { mode: mode.mode(), ..Options::default() },
        }
    }

    fn data_of(
        &self,
        node: u8,
        (index, sub): (u16, u8),
        data: Option<String>,
        value: Option<Number>,
        file: Option<std::path::PathBuf>,
    ) -> Result<Vec<u8>, String> {
        match (data, value, file) {
            (Some(hex), None, None) => {
                jobs::from_hex(&hex).ok_or_else(|| format!("'{hex}' is no even number of hex digits"))
            }
            (None, Some(value), None) => {
                let entry = self.devices.get(&node).and_then(|d| d.od.entry(d.od.find(index, sub).ok()?));
                let Some(entry) = entry else {
                    return Err(format!(
                        "no EDS says what type {index:04X}:{sub:02X} has: write the value with its type, or the bytes in hex"
                    ));
                };
                encode(&value, entry, node)
            }
            (None, None, Some(file)) => {
                let told = |e: std::io::Error| format!("{}: {e}", file.display());
                let size = std::fs::metadata(&file).map_err(told)?.len();
                if size > MAX_FILE {
                    return Err(format!("{}: {size} bytes, the limit is {MAX_FILE}", file.display()));
                }
                std::fs::read(&file).map_err(told)
            }
            _ => Err("a write has one of \"data\", \"value\" and \"file\"".to_owned()),
        }
    }

    fn transfer(
        &mut self,
        now_ns: u64,
        node: u8,
        (index, sub): (u16, u8),
        data: Option<Vec<u8>>,
        options: Options,
        asked: Asked,
    ) -> Result<Option<Value>, (u32, String)> {
        if self.asked.len() >= MAX_JOBS {
            return Err((FAILED, format!("{MAX_JOBS} transfers are under way already; try again")));
        }
        self.network.transfers.add(node, self.config.sdo_timeout.ns());
        self.next_job += 1;
        let request = Wanted { index, sub, data, owner: Owner::Job(self.next_job), options };
        if !self.network.transfers.ask(now_ns, node, request, &mut self.out) {
            return Err((FAILED, format!("too many transfers wait for node {node} already; try again")));
        }
        self.asked.insert(self.next_job, asked);
        Ok(None)
    }

    fn answer_jobs(&mut self) {
        while let Some(end) = self.network.transfers.take_job_end() {
            let Some(asked) = self.asked.remove(&end.job) else { continue };
            match self.job_value(&end, asked.file.as_deref()) {
                Ok(value) => self.answer(&asked, 0, &json!({ "ok": value })),
                Err(error) => self.answer(&asked, FAILED, &error),
            }
        }
    }

    fn job_value(&self, end: &JobEnd, file: Option<&std::path::Path>) -> Result<Value, Value> {
        let object = self.object_text(end.node, end.index, end.sub);
        let data = match &end.result {
            Ok(data) => data,
            Err(failure) => {
                let text = format!("node {}, {object}: {failure}", end.node);
                return Err(
                    json!({ "error": text, "abort": failure.abort.0, "timeout": failure.is_timeout() }),
                );
            }
        };
        let mut value = json!({ "object": object, "bytes": end.bytes });
        if end.direction == Direction::Write {
            return Ok(value);
        }
        if let Some(file) = file {
            if let Err(e) = std::fs::write(file, data) {
                return Err(json!({ "error": format!("{}: {e}", file.display()) }));
            }
        } else if data.len() > MAX_INLINE {
            let text = format!("the value has {} bytes: give a file for more than {MAX_INLINE}", data.len());
            return Err(json!({ "error": text }));
        } else {
            value["data"] = json!(jobs::to_hex(data));
        }
        let entry = self.devices.get(&end.node).and_then(|d| d.od.entry(d.od.find(end.index, end.sub).ok()?));
        if let Some(entry) = entry {
            value["type"] = json!(entry.data_type.name());
            if let Some(number) = entry.data_type.number(data) {
                value["value"] = json!(number.to_string());
            } else if entry.data_type == DataType::VisibleString {
                value["value"] = json!(String::from_utf8_lossy(data));
            }
        }
        Ok(value)
    }

    fn object_text(&self, node: u8, index: u16, sub: u8) -> String {
        match self.devices.get(&node).and_then(|d| d.name_of(index, sub)) {
            Some(name) => format!("{index:04X}:{sub:02X} {name}"),
            None => format!("{index:04X}:{sub:02X}"),
        }
    }

    fn answer(&mut self, asked: &Asked, code: u32, value: &Value) {
        let header = JobResult {
            job_seq: asked.seq,
            job_writer: asked.writer,
            job_generation: asked.generation,
            code,
            ..JobResult::default()
        };
        let text = serde_json::to_vec(value).unwrap_or_default();
        if let Err(e) = self.results.send_tail(header, &text) {
            tracing::warn!("answer to a job: {e}");
        }
        self.results.ring();
    }

    fn tell_events(&mut self) {
        let events: Vec<Event> = self.network.drain_events().collect();
        for event in events {
            if self.event_budget == 0 {
                self.events_left_out += 1;
                continue;
            }
            self.event_budget -= 1;
            let node = match &event {
                Event::BootFailed { node, .. } => *node,
                _ => 0,
            };
            let (kind, level, text, detail) =
                words::event(&event, |n| self.node_text(n), |i, s| self.object_text(node, i, s));
            self.ctx.event(kind, level, text, detail);
        }
        let whole = self.network.is_whole() && !self.network.is_bus_off();
        let state = if whole { HealthState::Ready } else { HealthState::Degraded };
        if state != self.state {
            self.state = state;
            self.ctx.set_state(state);
        }
    }

    fn node_text(&self, node: u8) -> String {
        match self.names.get(&node).filter(|name| !name.is_empty()) {
            Some(name) => format!("node {node} ({name})"),
            None => format!("node {node}"),
        }
    }

    fn node_status(&self, run: &NodeRun) -> Value {
        let id = run.id();
        let mut value = json!({
            "id": id,
            "name": self.names.get(&id),
            "state": run.state.map_or("unknown", state_name),
            "boot": run.boot.step_text(),
            "operational": run.is_operational(),
            "mandatory": run.settings.mandatory,
        });
        if run.losses > 0 {
            value["losses"] = json!(run.losses);
        }
        if run.emcys > 0 {
            value["emcys"] = json!(run.emcys);
            value["last_emcy"] = json!(run.last_emcy.map(|(code, _)| format!("{code:04X}h")));
        }
        if let Some(failure) = &run.last_failure {
            value["letter"] = json!(failure.letter);
            value["failure"] = json!(words::failure_text(failure, |i, s| self.object_text(id, i, s)));
        }
        value
    }

    fn network_status(&self) -> Value {
        json!({
            "node_id": self.config.node_id,
            "state": state_name(self.network.state()),
            "started": self.network.is_started(),
            "whole": self.network.is_whole(),
            "bus_off": self.network.is_bus_off(),
            "nodes": self.network.nodes().iter().map(|n| self.node_status(n)).collect::<Vec<_>>(),
            "network": self.network.counters(),
            "pdo": self.network.exchange.counters(),
            "sync_out_us": { "last": self.sync_out_ns.0 / 1000, "max": self.sync_out_ns.1 / 1000 },
            "frames_dropped": self.dropped,
            "frames_waiting": self.waiting.len(),
            "safe": self.safe.filter(|_| self.image.is_some()),
            "rx": self.rx.as_ref().map(Subscriber::counters),
        })
    }

    fn status(&mut self) {
        if self.events_left_out > 0 {
            let message = format!("{} more events in the last second left out", self.events_left_out);
            self.ctx.event(EventKind::NodeState, Level::Warning, message, Value::Null);
        }
        (self.event_budget, self.events_left_out) = (EVENTS_A_SECOND, 0);
        let mut status = self.network_status();
        if status.to_string().len() > STATUS_BYTES {
            for node in status["nodes"].as_array_mut().into_iter().flatten().filter_map(Value::as_object_mut)
            {
                node.remove("failure");
                node.remove("name");
            }
        }
        self.ctx.status(&status);
    }
}
