//! Events, and what recorders missed of them. Everybody else must hear at once who died (the PLC marks its inputs by
//! it), so an event goes out the moment it happens. What happens while a recorder starts or is down is kept as well and
//! said again when it listens, so that the start of the stack and the recorder's own death are in the recording; the
//! stamps are those of when it happened. Sans-I/O.

use super::rail_thread::Beat;
use ipc_types::Stack;
use ipc_types::event::{EventBody, EventKind, Level};
use ipc_types::payload::HealthState;
use serde_json::{Value, json};
use std::collections::VecDeque;

/// Events that are kept for recorders; the oldest go first.
const KEPT_MAX: usize = 256;
/// Most events said again at once: a reader's queue holds four times as many.
const AGAIN_MAX: usize = 64;

/// A recorder, as far as events are concerned.
#[derive(Debug)]
struct Listening {
    service: usize,
    name: String,
    /// Its generation from which on it counts.
    from: u32,
    ready: bool,
}

/// What recorders missed.
#[derive(Debug)]
pub struct Outbox {
    recorders: Vec<Listening>,
    kept: VecDeque<EventBody>,
    forgotten: u64,
}

impl Outbox {
    pub fn new(stack: &Stack) -> Self {
        let recorders = stack.services.iter().enumerate().filter(|(_, s)| s.wiring.records);
        Self::with(recorders.map(|(service, entry)| (service, entry.name.clone())))
    }

    fn with(recorders: impl Iterator<Item = (usize, String)>) -> Self {
        let recorders =
            recorders.map(|(service, name)| Listening { service, name, from: 1, ready: false }).collect();
        Self { recorders, kept: VecDeque::new(), forgotten: 0 }
    }

    /// An event that goes out now: kept when a recorder does not hear it.
    pub fn note(&mut self, body: &EventBody) {
        if let Some(recorder) = self.recorders.iter_mut().find(|r| r.name == body.service) {
            let generation = body.detail.get("generation").and_then(Value::as_u64).unwrap_or(0) as u32;
            match body.event {
                EventKind::Died => (recorder.from, recorder.ready) = (generation.saturating_add(1), false),
                // Restarted by command, which is no death.
                EventKind::Started if generation > recorder.from => {
                    (recorder.from, recorder.ready) = (generation, false);
                }
                _ => {}
            }
        }
        if self.recorders.iter().all(|r| r.ready) {
            return;
        }
        if self.kept.len() == KEPT_MAX {
            self.kept.pop_front();
            self.forgotten += 1;
        }
        self.kept.push_back(body.clone());
    }

    /// What is to be said again now, in order, once every recorder listens; ask again until it is empty.
    pub fn again(&mut self, beats: &[Beat]) -> Vec<EventBody> {
        for beat in beats.iter().filter(|b| matches!(b.state, HealthState::Ready | HealthState::Degraded)) {
            for recorder in self.recorders.iter_mut().filter(|r| r.service == beat.service) {
                recorder.ready |= beat.generation >= recorder.from;
            }
        }
        if self.kept.is_empty() || !self.recorders.iter().all(|r| r.ready) {
            return Vec::new();
        }
        let count = self.kept.len().min(AGAIN_MAX);
        let mut bodies: Vec<EventBody> = self.kept.drain(..count).collect();
        if self.forgotten > 0 && self.kept.is_empty() {
            let forgotten = std::mem::take(&mut self.forgotten);
            let message = format!(
                "{forgotten} events of the time in which no recorder listened are not in the recording"
            );
            let name = self.recorders.first().map_or("", |r| r.name.as_str());
            let detail = json!({ "events": forgotten });
            bodies.push(EventBody::now(EventKind::RecorderFault, Level::Warning, name, message, detail));
        }
        bodies
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn event(service: &str, kind: EventKind, generation: u32) -> EventBody {
        EventBody::now(kind, Level::Info, service, "", json!({ "generation": generation }))
    }

    fn beat(service: usize, generation: u32, state: HealthState) -> Beat {
        Beat { service, generation, state }
    }

    fn kinds(bodies: &[EventBody]) -> Vec<EventKind> {
        bodies.iter().map(|b| b.event).collect()
    }

    #[test]
    fn a_recorder_hears_of_its_own_death() {
        let mut outbox = Outbox::with([(1, "rec".to_owned())].into_iter());
        outbox.note(&event("plc", EventKind::Started, 1));
        let early = [beat(1, 1, HealthState::Starting), beat(0, 1, HealthState::Ready)];
        assert!(outbox.again(&early).is_empty());
        assert_eq!(kinds(&outbox.again(&[beat(1, 1, HealthState::Ready)])), [EventKind::Started]);
        outbox.note(&event("plc", EventKind::Died, 1));
        assert!(outbox.again(&[]).is_empty(), "it heard that");
        let died = event("rec", EventKind::Died, 1);
        outbox.note(&died);
        outbox.note(&event("rec", EventKind::Started, 2));
        assert!(outbox.again(&[beat(1, 1, HealthState::Ready)]).is_empty(), "a heartbeat from before");
        let heard = outbox.again(&[beat(1, 2, HealthState::Ready)]);
        assert_eq!(kinds(&heard), [EventKind::Died, EventKind::Started]);
        assert_eq!((heard[0].t_ns, heard[0].utc_ns), (died.t_ns, died.utc_ns), "stamped when it happened");
        assert!(outbox.again(&[beat(1, 2, HealthState::Ready)]).is_empty(), "once");
    }

    #[test]
    fn a_recorder_that_was_restarted_by_command_hears_what_happens_until_it_listens() {
        let mut outbox = Outbox::with([(0, "rec".to_owned())].into_iter());
        assert!(outbox.again(&[beat(0, 1, HealthState::Ready)]).is_empty());
        outbox.note(&event("rec", EventKind::Restarting, 2));
        outbox.note(&event("rec", EventKind::Started, 2));
        outbox.note(&event("plc", EventKind::Died, 1));
        assert!(outbox.again(&[beat(0, 1, HealthState::Ready)]).is_empty(), "a heartbeat from before");
        let told = outbox.again(&[beat(0, 2, HealthState::Ready)]);
        assert_eq!(kinds(&told), [EventKind::Started, EventKind::Died]);
        outbox.note(&event("plc", EventKind::Started, 2));
        assert!(outbox.again(&[]).is_empty(), "it heard that");
    }

    #[test]
    fn a_recorder_that_stays_away_costs_bounded_memory_and_its_successor_is_told() {
        let mut outbox = Outbox::with([(0, "rec".to_owned())].into_iter());
        outbox.note(&event("a", EventKind::Started, 1));
        outbox.note(&event("b", EventKind::Ready, 1));
        for _ in 1..KEPT_MAX {
            outbox.note(&event("c", EventKind::Died, 1));
        }
        let mut told = outbox.again(&[beat(0, 7, HealthState::Ready)]);
        assert_eq!((told.len(), told[0].event), (AGAIN_MAX, EventKind::Ready));
        (1..KEPT_MAX / AGAIN_MAX).for_each(|_| told.extend(outbox.again(&[])));
        assert!(told.len() == KEPT_MAX + 1 && outbox.again(&[]).is_empty());
        let last = told.last().unwrap();
        assert_eq!((last.event, last.service.as_str()), (EventKind::RecorderFault, "rec"));
        assert!(last.message.starts_with("1 events"), "{}", last.message);
    }

    #[test]
    fn all_recorders_must_listen() {
        let mut outbox = Outbox::with([(0, "rec".to_owned()), (1, "long".to_owned())].into_iter());
        assert!(outbox.again(&[beat(0, 1, HealthState::Ready), beat(1, 1, HealthState::Ready)]).is_empty());
        outbox.note(&event("long", EventKind::Died, 1));
        outbox.note(&event("plc", EventKind::Died, 1));
        assert!(outbox.again(&[beat(0, 1, HealthState::Ready)]).is_empty());
        let told = outbox.again(&[beat(1, 2, HealthState::Degraded)]);
        assert_eq!(kinds(&told), [EventKind::Died, EventKind::Died]);
    }

    #[test]
    fn without_a_recorder_nothing_is_kept() {
        let mut outbox = Outbox::with(std::iter::empty());
        outbox.note(&event("a", EventKind::Started, 1));
        assert!(outbox.kept.is_empty() && outbox.again(&[]).is_empty());
    }
}
