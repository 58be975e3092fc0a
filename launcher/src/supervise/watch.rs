//! What the launcher sees of its stack beyond heartbeats: for the progress lines of `up --for` and `demo`, and
//! whether anything was lost. Reads only topics that replace the oldest message, so it disturbs nobody.

use ipc_types::context::Context;
use ipc_types::event::{EventBody, EventKind, Level};
use ipc_types::payload::{CanFrame, Event, Image, PlcState, Status};
use ipc_types::port::Subscriber;
use ipc_types::rail::RailError;
use ipc_types::topic::{EVENTS, TopicKind};
use ipc_types::wiring::{Area, ImageRange};
use serde_json::Value;
use std::time::{Duration, Instant};

/// Values shown in a progress line.
const POINTS_MAX: usize = 3;
/// How often the picture is renewed.
const PERIOD: Duration = Duration::from_millis(250);
/// Most events looked at in one turn.
const EVENTS_MAX: usize = 256;

/// A picture of the stack.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Observed {
    /// Buses: name and frames since the stack's start, over all restarts of the driver.
    pub buses: Vec<(String, u64)>,
    /// PLCs: name, state, scans over all restarts.
    pub plcs: Vec<(String, PlcState, u64)>,
    /// Points of the image with their values.
    pub points: Vec<(String, String)>,
    /// Last status of each recorder.
    pub recorders: Vec<(String, Value)>,
    /// Messages of the recorder's events about losses, oldest first.
    pub losses: Vec<String>,
}

/// A count that begins anew with every process of its service, summed up over all of them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
struct Total {
    before: u64,
    generation: u32,
    now: u64,
}

impl Total {
    fn follow(&mut self, generation: u32, count: u64) {
        if generation != self.generation {
            self.before += self.now;
            self.generation = generation;
        }
        self.now = count;
    }

    fn sum(self) -> u64 {
        self.before + self.now
    }
}

struct Bus {
    name: String,
    rx: Subscriber<CanFrame>,
    frames: Total,
}

struct Plc {
    name: String,
    image: Subscriber<Image>,
    points: Vec<ImageRange>,
    state: PlcState,
    scans: Total,
    values: Vec<(String, String)>,
}

struct Recorder {
    name: String,
    status: Subscriber<Status>,
    last: Value,
}

/// The readers behind [`Observed`].
pub struct Observer {
    buses: Vec<Bus>,
    plcs: Vec<Plc>,
    recorders: Vec<Recorder>,
    events: Subscriber<Event>,
    losses: Vec<String>,
    next: Instant,
}

impl Observer {
    /// With `busy`, also reads frames and images; else only what the exit code depends on.
    pub fn new(ctx: &Context, busy: bool) -> Result<Self, RailError> {
        let stack = ctx.stack.clone();
        let mut this = Self {
            buses: Vec::new(),
            plcs: Vec::new(),
            recorders: Vec::new(),
            events: ctx.subscriber(EVENTS)?,
            losses: Vec::new(),
            next: Instant::now(),
        };
        for service in &stack.services {
            let owns = |kind: TopicKind| service.wiring.topics.iter().any(|t| t.kind == kind);
            let name = service.name.clone();
            if busy && owns(TopicKind::CanRx) {
                let rx = ctx.subscriber(&TopicKind::CanRx.of(&name))?;
                this.buses.push(Bus { name: name.clone(), rx, frames: Total::default() });
            }
            if busy && owns(TopicKind::Image) {
                let image = ctx.subscriber(&TopicKind::Image.of(&name))?;
                this.plcs.push(Plc {
                    points: points_of(&stack, &name),
                    name: name.clone(),
                    image,
                    state: PlcState::Starting,
                    scans: Total::default(),
                    values: Vec::new(),
                });
            }
            if service.wiring.records {
                let status = ctx.subscriber(&TopicKind::Status.of(&name))?;
                this.recorders.push(Recorder { name, status, last: Value::Null });
            }
        }
        Ok(this)
    }

    /// Reads what is new; a new picture four times a second, or now when it is the last one.
    pub fn look(&mut self, last: bool) -> Option<Observed> {
        let losses = &mut self.losses;
        self.events.drain(EVENTS_MAX, |_, tail| {
            if let Ok(body) = serde_json::from_slice::<EventBody>(tail)
                && body.event == EventKind::RecorderFault
                && body.level == Level::Fault
                && losses.len() < EVENTS_MAX
            {
                losses.push(format!("{}: {}", body.service, body.message));
            }
        });
        for bus in &mut self.buses {
            bus.rx.newest(|frame, _| bus.frames.follow(frame.stamp.generation, frame.stamp.seq));
        }
        let now = Instant::now();
        if now < self.next && !last {
            return None;
        }
        self.next = now + PERIOD;
        for plc in &mut self.plcs {
            plc.image.newest(|image, tail| {
                plc.state = image.plc_state();
                plc.scans.follow(image.stamp.generation, image.scan);
                plc.values =
                    plc.points.iter().filter_map(|p| Some((label(p), value(image, tail, p)?))).collect();
            });
        }
        for recorder in &mut self.recorders {
            recorder.status.newest(|_, tail| {
                if let Ok(status) = serde_json::from_slice(tail) {
                    recorder.last = status;
                }
            });
        }
        Some(Observed {
            buses: self.buses.iter().map(|b| (b.name.clone(), b.frames.sum())).collect(),
            plcs: self.plcs.iter().map(|p| (p.name.clone(), p.state, p.scans.sum())).collect(),
            points: self.plcs.iter().flat_map(|p| p.values.iter().cloned()).take(POINTS_MAX).collect(),
            recorders: self.recorders.iter().map(|r| (r.name.clone(), r.last.clone())).collect(),
            losses: self.losses.clone(),
        })
    }
}

/// The points of the image worth showing: those with a symbol, else the first marker word.
fn points_of(stack: &ipc_types::Stack, plc: &str) -> Vec<ImageRange> {
    let mut points: Vec<ImageRange> = stack
        .services
        .iter()
        .filter(|s| s.wiring.plc.as_deref() == Some(plc))
        .flat_map(|s| s.wiring.inputs.iter().chain(&s.wiring.outputs))
        .filter(|r| r.symbol.is_some() && r.bytes <= 8)
        .take(POINTS_MAX)
        .cloned()
        .collect();
    if points.is_empty() {
        points.push(ImageRange {
            area: Area::Marker,
            byte: 0,
            bit: None,
            bytes: 2,
            type_name: Some("WORD".into()),
            symbol: None,
            label: String::new(),
            key: String::new(),
            on_bad: ipc_types::wiring::OnBad::Hold,
            status_byte: None,
        });
    }
    points
}

fn label(point: &ImageRange) -> String {
    point.symbol.clone().unwrap_or_else(|| address(point))
}

/// Where a point lies, in bytes: the one notation that is the same for every way of counting.
pub fn address(point: &ImageRange) -> String {
    match point.bit {
        Some(bit) => format!("%{}X{}.{bit}", point.area.letter(), point.byte),
        None => format!("%{}B{}", point.area.letter(), point.byte),
    }
}

/// The value of a point as text; `None` when the image has no such bytes.
pub fn value(image: &Image, tail: &[u8], point: &ImageRange) -> Option<String> {
    let (input, output, marker) = image.areas(tail)?;
    let area = match point.area {
        Area::Input => input,
        Area::Output => output,
        Area::Marker => marker,
    };
    let bytes = area.get(point.byte as usize..(point.byte + point.bytes) as usize)?;
    Some(render(point.type_name.as_deref().unwrap_or(""), point.bit, bytes))
}

fn render(type_name: &str, bit: Option<u8>, bytes: &[u8]) -> String {
    if let Some(bit) = bit {
        return if bytes.first().is_some_and(|b| b >> bit & 1 == 1) { "TRUE" } else { "FALSE" }.to_owned();
    }
    let mut wide = [0u8; 8];
    let n = bytes.len().min(8);
    wide[..n].copy_from_slice(&bytes[..n]);
    let unsigned = u64::from_le_bytes(wide);
    let shift = 64 - 8 * n as u32;
    match type_name {
        "SINT" | "INT" | "DINT" | "LINT" if n > 0 => ((unsigned << shift) as i64 >> shift).to_string(),
        "REAL" if n == 4 => f32::from_bits(unsigned as u32).to_string(),
        "LREAL" if n == 8 => f64::from_bits(unsigned).to_string(),
        "BOOL" => if unsigned & 1 == 1 { "TRUE" } else { "FALSE" }.to_owned(),
        _ => unsigned.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_go_on_over_restarts() {
        let mut total = Total::default();
        // A new process shows its image before its first scan.
        for (generation, count, sum) in [(1, 10, 10), (1, 90, 90), (2, 0, 90), (2, 5, 95), (4, 7, 102)] {
            total.follow(generation, count);
            assert_eq!(total.sum(), sum);
        }
    }

    #[test]
    fn values_are_shown_by_their_type() {
        for (type_name, bit, bytes, text) in [
            ("INT", None, &[0xFE, 0xFF][..], "-2"),
            ("UINT", None, &[0xFE, 0xFF], "65534"),
            ("", None, &[1, 2], "513"),
            ("BOOL", Some(3), &[8], "TRUE"),
            ("BOOL", None, &[2], "FALSE"),
            ("REAL", None, &[0, 0, 0xC0, 0x3F], "1.5"),
            ("LINT", None, &[0xFF; 8], "-1"),
            ("WORD", None, &[], "0"),
        ] {
            assert_eq!(render(type_name, bit, bytes), text, "{type_name} {bytes:?}");
        }
    }
}
