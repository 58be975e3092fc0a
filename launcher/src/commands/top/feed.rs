//! What is known of a running stack, gathered once a refresh: rows of the control socket, statuses, images and
//! events of the rail. Reads only topics that replace the oldest message, so it disturbs nobody.

use crate::supervise::client::{Client, ClientError, observe, with_room};
use crate::supervise::control::{LogLine, Reply, Request, ServiceRow, StackStatus};
use crate::supervise::state_dir::RunningStack;
use crate::supervise::watch;
use dinrail_iec::Addressing;
use dinrail_modbus::service::addressing_of;
use dinrail_plc::program::address_text;
use ipc_types::Context;
use ipc_types::clock;
use ipc_types::event::EventBody;
use ipc_types::payload::{Event, Image, PlcState, Status, event_flag};
use ipc_types::port::Subscriber;
use ipc_types::rail::RailError;
use ipc_types::topic::{EVENTS, TopicKind};
use ipc_types::wiring::{Area, ImageRange};
use serde_json::Value;
use std::time::{Duration, Instant};

/// A launcher answers within this, or it is taken for gone.
const ANSWER_LIMIT: Duration = Duration::from_secs(3);
/// Named points of one image.
const POINTS_MAX: usize = 512;
/// Events taken at one look.
const EVENTS_MAX: usize = 256;
/// Lines of a log that are fetched.
const LOG_LINES: u32 = 1000;
/// Pause between two looks for statuses.
const LOOK: Duration = Duration::from_millis(20);

/// The last status of a service.
#[derive(Debug, Clone, PartialEq)]
pub struct Told {
    pub service: String,
    pub generation: u32,
    /// CLOCK_MONOTONIC in ns when the service said so.
    pub t_ns: u64,
    pub body: Value,
}

/// A process image.
#[derive(Debug, Clone, PartialEq)]
pub struct Shot {
    pub plc: String,
    pub state: PlcState,
    pub scan: u64,
    /// Points that services exchange with the image.
    pub points: Vec<Point>,
    /// %I, %Q, %M, each up to its last byte that is not 0.
    pub areas: Vec<(char, Vec<u8>)>,
}

/// A point of an image.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Point {
    pub address: String,
    pub symbol: Option<String>,
    pub type_name: String,
    pub service: String,
    pub value: String,
}

/// Everything of one moment.
#[derive(Debug, Clone, Default)]
pub struct Snapshot {
    /// CLOCK_MONOTONIC and UTC in ns.
    pub t_ns: u64,
    pub utc_ns: i64,
    pub stack: Option<StackStatus>,
    pub rows: Vec<ServiceRow>,
    pub told: Vec<Told>,
    pub images: Vec<Shot>,
    /// New since the snapshot before, oldest first.
    pub events: Vec<EventBody>,
}

/// Why nothing can be gathered.
#[derive(Debug, thiserror::Error)]
pub enum FeedError {
    #[error(transparent)]
    Client(#[from] ClientError),
    #[error(transparent)]
    Rail(#[from] RailError),
    #[error("the launcher gave another answer than asked for; is it of another version?")]
    Answer,
}

struct Plc {
    name: String,
    addressing: Addressing,
    points: Vec<(String, ImageRange)>,
}

/// The image of a plc.
struct Camera {
    plc: Plc,
    port: Subscriber<Image>,
    shot: Option<Shot>,
}

/// The readers of one stack.
pub struct Feed {
    // Before the context: ports go before their node.
    statuses: Vec<(String, Subscriber<Status>, Option<Told>)>,
    plcs: Vec<Camera>,
    events: Subscriber<Event>,
    pub ctx: Context,
    client: Client,
}

impl Feed {
    /// Joins a running stack. Again in the same process only for a stack of the same name.
    pub fn open(stack: &RunningStack) -> Result<Self, FeedError> {
        let client = Client::connect(stack.clone())?;
        let ctx = observe(stack)?;
        let described = ctx.stack.clone();
        let (mut statuses, mut plcs) = (Vec::new(), Vec::new());
        for service in &described.services {
            let status = TopicKind::Status.of(&service.name);
            if described.topic(&status).is_some() {
                let port = with_room(&stack.root, || ctx.subscriber(&status))?;
                statuses.push((service.name.clone(), port, None));
            }
            let image = TopicKind::Image.of(&service.name);
            if described.topic(&image).is_some() {
                let port = with_room(&stack.root, || ctx.subscriber(&image))?;
                let points = points_of(&described, &service.name);
                let plc =
                    Plc { name: service.name.clone(), addressing: addressing_of(Some(service)), points };
                plcs.push(Camera { plc, port, shot: None });
            }
        }
        let events = with_room(&stack.root, || ctx.subscriber(EVENTS))?;
        Ok(Self { statuses, plcs, events, ctx, client })
    }

    /// Names of the stack's services, in its order.
    pub fn services(&self) -> Vec<&str> {
        self.ctx.stack.services.iter().map(|s| s.name.as_str()).collect()
    }

    /// Everything of now.
    pub fn look(&mut self) -> Result<Snapshot, FeedError> {
        let Reply::Status(stack) = self.client.call(&Request::Status {}, ANSWER_LIMIT)? else {
            return Err(FeedError::Answer);
        };
        let Reply::Ps(rows) = self.client.call(&Request::Ps {}, ANSWER_LIMIT)? else {
            return Err(FeedError::Answer);
        };
        self.listen();
        let mut events = Vec::new();
        self.events.drain(EVENTS_MAX, |event, tail| {
            if event.flags & event_flag::AGAIN == 0
                && let Ok(body) = serde_json::from_slice::<EventBody>(tail)
            {
                events.push(body);
            }
        });
        Ok(Snapshot {
            t_ns: clock::mono_ns(),
            utc_ns: clock::utc_ns(),
            stack: Some(stack),
            rows,
            told: self.statuses.iter().filter_map(|(_, _, told)| told.clone()).collect(),
            images: self.plcs.iter().filter_map(|p| p.shot.clone()).collect(),
            events,
        })
    }

    /// Takes statuses and images that wait.
    fn listen(&mut self) {
        for (service, port, told) in &mut self.statuses {
            port.newest(|header, tail| {
                let body = serde_json::from_slice(tail).unwrap_or(Value::Null);
                *told = Some(Told {
                    service: service.clone(),
                    generation: header.stamp.generation,
                    t_ns: header.stamp.t_ns,
                    body,
                });
            });
        }
        for Camera { plc, port, shot } in &mut self.plcs {
            port.newest(|image, tail| {
                *shot = shoot(plc, image, tail).or(shot.take());
            });
        }
    }

    /// Waits until every one of these services has told its status, or the time is over.
    pub fn wait_for_statuses(&mut self, of: &[String], limit: Duration) {
        let begin = Instant::now();
        loop {
            self.listen();
            let missing = |(name, _, told): &(String, _, Option<Told>)| told.is_none() && of.contains(name);
            if !self.statuses.iter().any(missing) || begin.elapsed() >= limit {
                return;
            }
            std::thread::sleep(LOOK);
        }
    }

    /// The last lines of a service's log.
    pub fn log(&mut self, service: &str) -> Result<Vec<LogLine>, FeedError> {
        let request = Request::Logs { service: Some(service.to_owned()), lines: LOG_LINES, follow: false };
        self.client.ask(&request)?;
        let mut lines = Vec::new();
        loop {
            match self.client.next(Some(ANSWER_LIMIT))? {
                Some(Reply::Log(line)) => lines.push(line),
                Some(Reply::End) | None => return Ok(lines),
                Some(_) => return Err(FeedError::Answer),
            }
        }
    }
}

/// What services exchange with this image, in the order of the stack.
fn points_of(stack: &ipc_types::Stack, plc: &str) -> Vec<(String, ImageRange)> {
    stack
        .services
        .iter()
        .filter(|s| s.wiring.plc.as_deref() == Some(plc))
        .flat_map(|s| s.wiring.inputs.iter().chain(&s.wiring.outputs).map(|r| (s.name.clone(), r.clone())))
        .take(POINTS_MAX)
        .collect()
}

fn shoot(plc: &Plc, image: &Image, tail: &[u8]) -> Option<Shot> {
    let addressing = plc.addressing;
    let (input, output, marker) = image.areas(tail)?;
    let used = |area: &[u8]| {
        let end = area.iter().rposition(|b| *b != 0).map_or(0, |last| last + 1);
        area[..end].to_vec()
    };
    let points = plc
        .points
        .iter()
        .filter_map(|(service, range)| {
            Some(Point {
                address: address_text(range, addressing).unwrap_or_else(|_| watch::address(range)),
                symbol: range.symbol.clone(),
                type_name: range.type_name.clone().unwrap_or_default(),
                service: service.clone(),
                value: watch::value(image, tail, range)?,
            })
        })
        .collect();
    let areas = [(Area::Input, input), (Area::Output, output), (Area::Marker, marker)];
    Some(Shot {
        plc: plc.name.clone(),
        state: image.plc_state(),
        scan: image.scan,
        points,
        areas: areas.map(|(area, bytes)| (area.letter(), used(bytes))).into(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use ipc_types::wiring::OnBad;

    #[test]
    fn points_are_named_as_the_stack_file_names_them() {
        let range = |area, byte, bit, bytes, type_name: &str| ImageRange {
            area,
            byte,
            bit,
            bytes,
            type_name: Some(type_name.to_owned()),
            symbol: None,
            label: String::new(),
            key: String::new(),
            on_bad: OnBad::default(),
            status_byte: None,
        };
        let ranges = [
            range(Area::Input, 4, None, 4, "DINT"),
            range(Area::Input, 2, None, 2, "UINT"),
            range(Area::Input, 1, None, 2, "UINT"),
            range(Area::Input, 0, Some(3), 1, "BOOL"),
        ];
        let image = Image { input_bytes: 8, n: 8, ..Image::default() };
        let shown = |addressing| {
            let points = ranges.iter().map(|r| ("io".to_owned(), r.clone())).collect();
            let plc = Plc { name: "plc".to_owned(), addressing, points };
            let shot = shoot(&plc, &image, &[8, 0, 7, 0, 0xFE, 0xFF, 0xFF, 0xFF]).unwrap();
            shot.points.iter().map(|p| format!("{} {}", p.address, p.value)).collect::<Vec<_>>().join(", ")
        };
        assert_eq!(shown(Addressing::Element), "%ID1 -2, %IW1 7, %IB1 1792, %IX0.3 TRUE");
        assert_eq!(shown(Addressing::Byte), "%ID4 -2, %IW2 7, %IW1 1792, %IX0.3 TRUE");
    }
}
