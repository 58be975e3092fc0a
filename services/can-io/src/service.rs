//! The process: rail ports, clocks, the loop.

use dinrail_iec::artifact::AreaKind;
use dinrail_iec::{Addressing, LocatedAddress};
use ipc_types::event::{EventKind, Level};
use ipc_types::inbox::Inbox;
use ipc_types::payload::{
    CanFrame, Image, Inputs, PlcState, Quality, can_flag,
    id_flag::{EFF, ERR, RTR},
};
use ipc_types::port::{Publisher, ReadCounters, SendError, Subscriber};
use ipc_types::rail::RailError;
use ipc_types::reactor::{Reactor, Wake};
use ipc_types::stack::ServiceEntry;
use ipc_types::topic::TopicKind;
use ipc_types::wiring::{Area, ImageRange, Neighbours, OnBad, TopicDecl};
use ipc_types::{Context, Finding, Stack, Wiring, clock, plc_table};
use serde::Serialize;
use std::time::Duration;
use thiserror::Error;

use crate::config::{Config, OnBadValue, OnBadWord, SafeOn};
use crate::inputs::{InputCounters, InputTable, RowStatus};
use crate::outputs::{OutputCounters, OutputTable};
use crate::plan::{Plan, id_text, plan};

/// Heartbeat; the launcher wants one every 100 ms.
const BEAT: Duration = Duration::from_millis(50);
/// Beats from one status to the next: one second.
const STATUS_BEATS: u32 = 20;
/// The inputs are repeated at least this often, so that a plc that comes late gets them.
const REPEAT_NS: u64 = 90_000_000;
/// Frames taken from the bus before other work has its turn.
const TAKE_FRAMES: usize = 256;
/// Quality events a second that go to the rail.
const QUALITY_EVENTS: u32 = 20;
/// Frames shown in the status.
const STATUS_ROWS: usize = 64;

/// Why the service ended.
#[derive(Debug, Error)]
pub enum RunError {
    /// The rail.
    #[error(transparent)]
    Rail(#[from] RailError),
    /// The system.
    #[error("can-io: waiting for bus and image: {0}")]
    System(#[from] std::io::Error),
    /// `check` was not heeded.
    #[error("can-io: {key}: {message}; run `dinrail check`")]
    Config {
        /// Key of the service's table.
        key: String,
        /// What is wrong with it.
        message: String,
    },
}

/// What the service needs of the launcher.
pub fn topics(config: &Config, neighbours: &Neighbours) -> Wiring {
    let plc = neighbours.resolve("plc", config.plc.as_deref());
    let plan = plan(config, addressing_named(neighbours.addressing(plc.as_deref())));
    let mut wiring = Wiring { plc, ..Wiring::default() };
    let bus = neighbours.resolve("can", config.bus.as_deref());
    if !config.inputs.is_empty() {
        let tail = InputTable::new(&plan.inputs).tail().len() as u32;
        wiring.topics.push(TopicDecl::new(TopicKind::Inputs).max_tail(tail.max(1)));
        if let Some(bus) = &bus {
            wiring.read(TopicKind::CanRx.of(bus), true, "bus");
        }
    }
    if !config.outputs.is_empty() {
        if let Some(plc) = &wiring.plc {
            let topic = TopicKind::Image.of(plc);
            wiring.read(topic, true, "plc");
        }
        if let Some(bus) = &bus {
            wiring.write(TopicKind::CanTx.of(bus), "bus");
        }
    }
    wiring.inputs = plan.inputs.iter().map(|point| input_range(config, point)).collect();
    for frame in &plan.outputs {
        for (i, point) in frame.signals.iter().enumerate() {
            let label = format!("to frame {}, {}", id_text(frame.can_id), point.codec.signal.label());
            let key = format!("out[{}].signals[{i}].from", frame.index);
            let symbol = config.outputs[frame.index].signals.get(i).and_then(|s| s.symbol.clone());
            wiring.outputs.push(range(point.from, point.codec.iec.name(), symbol, label, key));
        }
    }
    wiring
}

/// A name that is none is the plc service's mistake, and found there.
fn addressing_named(name: &str) -> Addressing {
    Addressing::from_name(name).unwrap_or_default()
}

/// The plc service whose image is exchanged, and how its addresses count.
fn plc_of<'a>(stack: &'a Stack, wiring: &Wiring) -> (Option<&'a ServiceEntry>, Addressing) {
    let plc = wiring.plc.as_deref().and_then(|plc| stack.service(plc)).filter(|plc| plc.kind == "plc");
    let addressing = plc.map(|plc| addressing_named(plc_table::addressing(&plc.config)));
    (plc, addressing.unwrap_or_default())
}

fn input_range(config: &Config, point: &crate::plan::InputPoint) -> ImageRange {
    let input = &config.inputs[point.index];
    let label = format!("from frame {}, {}", id_text(point.can_id), point.codec.signal.label());
    let key = format!("in[{}].to", point.index);
    let mut range = range(point.to, point.codec.iec.name(), input.symbol.clone(), label, key);
    range.on_bad = match input.on_bad {
        OnBadValue::Word(OnBadWord::Zero) => OnBad::Zero,
        // A substitute value is put in by this service; when the service is dead, the last value stays.
        OnBadValue::Word(OnBadWord::Hold) | OnBadValue::Value(_) => OnBad::Hold,
    };
    range.status_byte = point.status_byte;
    range
}

fn range(at: LocatedAddress, iec: &str, symbol: Option<String>, label: String, key: String) -> ImageRange {
    ImageRange {
        area: match at.area {
            AreaKind::Input => Area::Input,
            AreaKind::Output => Area::Output,
            // No address names another area.
            AreaKind::Marker | AreaKind::Retain | AreaKind::Data => Area::Marker,
        },
        byte: at.byte,
        bit: at.bit,
        bytes: at.size.bytes(),
        type_name: Some(iec.to_owned()),
        symbol,
        label,
        key,
        on_bad: OnBad::Hold,
        status_byte: None,
    }
}

/// Every mistake that can be found without starting.
pub fn check(config: &Config, stack: &Stack, me: &ServiceEntry) -> Vec<Finding> {
    let name = &me.name;
    let (plc, addressing) = plc_of(stack, &me.wiring);
    let mistakes = plan(config, addressing).mistakes;
    let mut found: Vec<Finding> =
        mistakes.iter().map(|m| Finding::error(name, &m.key, &m.message, &m.help)).collect();
    if config.inputs.is_empty() && config.outputs.is_empty() {
        let help = "add [[service.in]] or [[service.out]]";
        found.push(Finding::warning(name, "", "the service has neither in nor out: it does nothing", help));
        return found;
    }
    // A named bus or plc that leads nowhere is found by the launcher, who sees it in the wiring.
    if config.bus.is_none() {
        found.extend(no_only_bus(stack, name));
    }
    found.extend(plc.and_then(|plc| plc_table::check_stale_after(name, config.stale_after, plc)));
    found
}

/// Without the key `bus` the stack must have one bus.
fn no_only_bus(stack: &Stack, me: &str) -> Option<Finding> {
    let buses: Vec<&str> =
        stack.services.iter().filter(|s| s.kind == "can").map(|s| s.name.as_str()).collect();
    let (message, help) = match buses.as_slice() {
        [_] => return None,
        [] => (
            "the stack has no service of kind \"can\"".to_owned(),
            "add one, as [[service]] with kind = \"can\"".to_owned(),
        ),
        [first, ..] => (
            format!("the stack has several services of kind \"can\": {}", buses.join(", ")),
            format!("say which one: bus = \"{first}\""),
        ),
    };
    Some(Finding::error(me, "bus", message, help))
}

/// Why outputs are in their safe state.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
enum Unsafe {
    /// No image of a running program yet.
    Waiting,
    Stale,
    Stop,
    Fault,
    Halted,
}

impl Unsafe {
    /// A stop is somebody's will, by `dinrail plc stop` or with the whole stack, and no fault.
    fn level(self) -> Level {
        match self {
            Self::Stop => Level::Info,
            Self::Waiting | Self::Stale | Self::Fault | Self::Halted => Level::Fault,
        }
    }

    fn text(self) -> &'static str {
        match self {
            Self::Waiting => "the PLC has not finished a scan yet",
            Self::Stale => "the image of the PLC is stale: it is dead, hung or too slow",
            Self::Stop => "the PLC is stopped",
            Self::Fault => "the program of the PLC faulted",
            Self::Halted => "the PLC is halted at a breakpoint",
        }
    }
}

/// What an image asks of the outputs; `None`: follow it.
fn judge(state: PlcState, scan: u64, safe_on: &[SafeOn]) -> Option<Unsafe> {
    let asked = |on, why| safe_on.contains(&on).then_some(why);
    match state {
        _ if scan == 0 => Some(Unsafe::Waiting),
        PlcState::Starting => Some(Unsafe::Waiting),
        PlcState::Run => None,
        PlcState::Stop => asked(SafeOn::Stop, Unsafe::Stop),
        PlcState::Fault => asked(SafeOn::Fault, Unsafe::Fault),
        PlcState::Halted => asked(SafeOn::Halted, Unsafe::Halted),
    }
}

#[derive(Serialize)]
struct Status<'a> {
    inputs: InputCounters,
    frames: &'a [RowStatus],
    outputs: OutputCounters,
    /// Absent: outputs follow the image.
    #[serde(skip_serializing_if = "Option::is_none")]
    safe: Option<Unsafe>,
    rx: Option<ReadCounters>,
}

struct Service {
    ctx: Context,
    config: Config,
    inputs: InputTable,
    outputs: OutputTable,
    rx: Option<Subscriber<CanFrame>>,
    image: Option<Subscriber<Image>>,
    tx: Option<Publisher<CanFrame>>,
    published: Option<Publisher<Inputs>>,
    published_ns: u64,
    image_ns: u64,
    safe: Option<Unsafe>,
    /// The last `safe_entered` has no `safe_left` yet.
    safe_told: bool,
    event_budget: u32,
    events_left_out: u32,
}

/// Runs until the launcher says stop.
pub fn run(mut ctx: Context) -> Result<(), RunError> {
    let config: Config = ctx.config()?;
    let name = ctx.service.clone();
    let wiring = ctx.entry().map(|entry| entry.wiring.clone()).unwrap_or_default();
    let (_, addressing) = plc_of(&ctx.stack, &wiring);
    let Plan { inputs, outputs, mistakes } = plan(&config, addressing);
    if let Some(mistake) = mistakes.into_iter().next() {
        return Err(RunError::Config { key: mistake.key, message: mistake.message });
    }
    let read =
        |suffix: &str| wiring.reads.iter().find(|r| r.topic.ends_with(suffix)).map(|r| r.topic.clone());
    let rx = read("/rx").map(|topic| ctx.subscriber(&topic)).transpose()?;
    let image = read("/image").map(|topic| ctx.subscriber(&topic)).transpose()?;
    let tx = wiring.writes.first().map(|(topic, _)| ctx.publisher(topic)).transpose()?;
    let published = if inputs.is_empty() { None } else { Some(ctx.publisher(&TopicKind::Inputs.of(&name))?) };
    let mut inbox = ctx.inbox()?;
    let mut reactor = Reactor::new()?;
    let wakes = Wakes {
        inbox: reactor.add(inbox.fd())?,
        stop: reactor.add(ctx.shutdown_fd())?,
        beat: reactor.add_timer(BEAT)?,
        alarm: reactor.add_alarm()?,
    };
    let mut service = Service {
        inputs: InputTable::new(&inputs),
        outputs: OutputTable::new(&outputs),
        ctx,
        config,
        rx,
        image,
        tx,
        published,
        published_ns: 0,
        image_ns: 0,
        safe: Some(Unsafe::Waiting),
        safe_told: false,
        event_budget: QUALITY_EVENTS,
        events_left_out: 0,
    };
    // Tells the plc that its inputs have no data yet, so that its first scan need not wait.
    service.publish(true);
    service.status();
    service.ctx.ready();
    service.work(&mut reactor, &mut inbox, &wakes)
}

struct Wakes {
    inbox: Wake,
    stop: Wake,
    beat: Wake,
    alarm: Wake,
}

impl Service {
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
            // Also without a ring: what was left of the last turn, and what a lost ring would leave.
            let more = self.take_frames();
            self.take_image();
            let now_ns = clock::mono_ns();
            self.watch(now_ns);
            let next_ns = self.send_due(now_ns);
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
            let stale_ns =
                (self.safe.is_none()).then(|| self.image_ns.saturating_add(self.config.stale_after.ns()));
            let next_ns = if more {
                Some(now_ns)
            } else {
                next_ns.into_iter().chain(self.inputs.next_check_ns()).chain(stale_ns).min()
            };
            if let Some(next_ns) = next_ns
                && alarm_ns != Some(next_ns)
            {
                reactor.set_alarm(wakes.alarm, next_ns)?;
                alarm_ns = Some(next_ns);
            }
        }
    }

    /// Takes frames of the bus; true when more may wait.
    fn take_frames(&mut self) -> bool {
        let Some(rx) = &mut self.rx else { return false };
        let (inputs, echo) = (&mut self.inputs, self.config.echo);
        let mut any = false;
        let taken = rx.drain(TAKE_FRAMES, |frame, _| {
            let skip = frame.can_id & (RTR | ERR) != 0 || (!echo && frame.flags & can_flag::TX_ECHO != 0);
            if !skip && frame.fault().is_none() {
                any |= inputs.frame(frame.can_id & (EFF | 0x1FFF_FFFF), frame.payload(), frame.stamp.t_ns);
            }
        });
        let stale = self.inputs.check(clock::mono_ns());
        if any || stale {
            self.publish(true);
            self.report_quality();
        }
        taken == TAKE_FRAMES
    }

    /// `fresh`: news, so the plc is woken; otherwise a repetition.
    fn publish(&mut self, fresh: bool) {
        let Some(port) = &mut self.published else { return };
        let header =
            Inputs { data_t_ns: self.inputs.data_t_ns(), ranges: self.inputs.ranges(), ..Inputs::default() };
        if let Err(e) = port.send_tail(header, self.inputs.tail()) {
            tracing::warn!("inputs: {e}");
        }
        if fresh {
            port.ring();
        }
        self.published_ns = clock::mono_ns();
    }

    fn report_quality(&mut self) {
        for change in self.inputs.drain_changes() {
            if self.event_budget == 0 {
                self.events_left_out += 1;
                continue;
            }
            self.event_budget -= 1;
            let input = &self.config.inputs[change.index];
            let what = input.symbol.as_ref().unwrap_or(&input.to);
            let id = id_text(change.can_id);
            let (level, message) = if change.quality == Quality::Good {
                (Level::Info, format!("frame {id} is back: {what} is good again"))
            } else {
                let age_ms = change.age_ns / 1_000_000;
                (Level::Warning, format!("frame {id} has not come for {age_ms} ms: {what} is stale"))
            };
            self.ctx.event(EventKind::InputQuality, level, message, serde_json::Value::Null);
        }
    }

    fn take_image(&mut self) {
        let Some(port) = &mut self.image else { return };
        let (outputs, safe_on) = (&mut self.outputs, &self.config.safe_on);
        let mut verdict = None;
        let mut image_ns = self.image_ns;
        port.newest(|image, tail| {
            let Some((_, q, m)) = image.areas(tail) else { return };
            image_ns = image.stamp.t_ns;
            let why = judge(image.plc_state(), image.scan, safe_on);
            let fresh = clock::mono_ns().saturating_sub(image_ns) <= self.config.stale_after.ns();
            // One that waited too long in the queue is as good as none.
            let why = why.or((!fresh).then_some(Unsafe::Stale));
            if why.is_none() {
                outputs.image(q, m, clock::mono_ns());
            }
            verdict = Some(why);
        });
        self.image_ns = image_ns;
        if let Some(why) = verdict {
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
        if self.safe == why {
            return;
        }
        self.safe = why;
        if self.image.is_none() {
            return;
        }
        match why {
            Some(why) => {
                let was_running = self.outputs.is_running();
                self.outputs.safe(clock::mono_ns());
                if was_running {
                    self.safe_told = true;
                    let message = format!("outputs went to their safe state: {}", why.text());
                    self.ctx.event(
                        EventKind::SafeEntered,
                        why.level(),
                        message,
                        serde_json::json!({ "why": why }),
                    );
                }
            }
            None if self.safe_told => {
                self.safe_told = false;
                let message = "outputs follow the image again";
                self.ctx.event(EventKind::SafeLeft, Level::Info, message, serde_json::Value::Null);
            }
            None => {}
        }
    }

    /// Sends what is due; returns when something is due next.
    fn send_due(&mut self, now_ns: u64) -> Option<u64> {
        let tx = self.tx.as_mut()?;
        let mut any = false;
        let mut next_ns = self.outputs.due(now_ns, |sending| {
            let mut frame = CanFrame {
                can_id: sending.can_id,
                len: sending.payload.len() as u8,
                fd_flags: sending.fd_flags,
                flags: if sending.newest { can_flag::NEWEST } else { 0 },
                ..CanFrame::default()
            };
            frame.data[..sending.payload.len()].copy_from_slice(sending.payload);
            match tx.send(frame) {
                Ok(_) => {
                    any = true;
                    true
                }
                Err(SendError::Full(_) | SendError::NoReader(_)) => false,
                Err(e) => {
                    tracing::warn!("frame {}: {e}", id_text(sending.can_id));
                    false
                }
            }
        });
        if any {
            tx.ring();
        }
        // Never in the past: the clock would ring for ever.
        if let Some(next_ns) = &mut next_ns {
            *next_ns = (*next_ns).max(now_ns + 1);
        }
        next_ns
    }

    fn status(&mut self) {
        if self.events_left_out > 0 {
            let message =
                format!("{} more quality changes in the last second left out", self.events_left_out);
            self.ctx.event(EventKind::InputQuality, Level::Warning, message, serde_json::Value::Null);
        }
        (self.event_budget, self.events_left_out) = (QUALITY_EVENTS, 0);
        let frames = self.inputs.rows(STATUS_ROWS);
        let status = Status {
            inputs: self.inputs.counters(),
            frames: &frames,
            outputs: self.outputs.counters(),
            safe: self.safe.filter(|_| self.image.is_some()),
            rx: self.rx.as_ref().map(Subscriber::counters),
        };
        self.ctx.status(&status);
    }
}

#[cfg(test)]
#[path = "service_tests.rs"]
mod tests;
