//! The process: rail ports, clocks, the loop.

use dinrail_iec::artifact::AreaKind;
use dinrail_iec::{Addressing, LocatedAddress};
use ipc_types::event::{Budget, EventKind, Level};
use ipc_types::inputs::InputsPort;
use ipc_types::outputs::{Change, Guard, OutputImage, Unsafe, Words};
use ipc_types::payload::{
    CanFrame, Inputs, Quality, can_flag,
    id_flag::{EFF, ERR, RTR},
};
use ipc_types::port::{Publisher, ReadCounters, SendError, Subscriber};
use ipc_types::rail::RailError;
use ipc_types::stack::ServiceEntry;
use ipc_types::topic::TopicKind;
use ipc_types::turns::Turns;
use ipc_types::wiring::{Area, ImageRange, Neighbours, OnBad, TopicDecl};
use ipc_types::{Context, Finding, Stack, Wiring, clock, plc_table};
use serde::Serialize;
use thiserror::Error;

use crate::config::{Config, OnBadValue, OnBadWord};
use crate::inputs::{InputCounters, InputTable, RowStatus};
use crate::outputs::{OutputCounters, OutputTable};
use crate::plan::{Plan, id_text, plan};

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
    let plc = stack.plc_of(wiring);
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
    // A named bus that leads nowhere is found by the launcher, who sees it in the wiring.
    if config.bus.is_none() {
        found.extend(stack.check_only(name, "bus", "can"));
    }
    found.extend(plc.and_then(|plc| plc_table::check_stale_after(name, config.stale_after, plc)));
    found
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
    image: OutputImage,
    tx: Option<Publisher<CanFrame>>,
    published: InputsPort,
    events: Budget,
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
    let turns = Turns::new(ctx.inbox()?, ctx.shutdown_fd())?;
    let mut service = Service {
        inputs: InputTable::new(&inputs),
        outputs: OutputTable::new(&outputs),
        rx,
        image: OutputImage::new(image, Guard::new(config.stale_after, &config.safe_on)),
        tx,
        published: InputsPort::new(published),
        events: Budget::new(QUALITY_EVENTS),
        ctx,
        config,
    };
    // Tells the plc that its inputs have no data yet, so that its first scan need not wait.
    service.publish(true);
    service.status();
    service.ctx.ready();
    service.work(turns)
}

impl Service {
    fn work(&mut self, mut turns: Turns) -> Result<(), RunError> {
        loop {
            let due = turns.wait()?;
            if due.stop {
                return Ok(());
            }
            turns.drain();
            let more = self.take_frames();
            self.take_image();
            let now_ns = clock::mono_ns();
            let change = self.image.on_time(now_ns);
            self.follow(change);
            let next_ns = self.send_due(now_ns);
            if due.beat {
                self.ctx.beat();
                if self.published.is_due(now_ns) {
                    self.publish(false);
                }
            }
            if due.status {
                self.status();
            }
            let checked_ns = self.inputs.next_check_ns();
            let next_ns = next_ns.into_iter().chain(checked_ns).chain(self.image.next_deadline()).min();
            turns.come_again(if more { Some(now_ns) } else { next_ns })?;
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
        let header =
            Inputs { data_t_ns: self.inputs.data_t_ns(), ranges: self.inputs.ranges(), ..Inputs::default() };
        self.published.publish(header, self.inputs.tail(), fresh);
    }

    fn report_quality(&mut self) {
        for change in self.inputs.drain_changes() {
            if !self.events.take() {
                continue;
            }
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
        let outputs = &mut self.outputs;
        let change = self.image.take(|q, m| outputs.image(q, m, clock::mono_ns()));
        self.follow(change);
    }

    /// The outputs enter or leave their safe state.
    fn follow(&mut self, change: Option<Change>) {
        let Some(change) = change else { return };
        if change.why.is_some() {
            self.outputs.safe(clock::mono_ns());
        }
        change.tell(&mut self.ctx, &Words::OUTPUTS);
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
        if let Some(left_out) = self.events.renew() {
            let message = format!("{left_out} more quality changes in the last second left out");
            self.ctx.event(EventKind::InputQuality, Level::Warning, message, serde_json::Value::Null);
        }
        let frames = self.inputs.rows(STATUS_ROWS);
        let status = Status {
            inputs: self.inputs.counters(),
            frames: &frames,
            outputs: self.outputs.counters(),
            safe: self.image.why(),
            rx: self.rx.as_ref().map(Subscriber::counters),
        };
        self.ctx.status(&status);
    }
}

#[cfg(test)]
#[path = "service_tests.rs"]
mod tests;
