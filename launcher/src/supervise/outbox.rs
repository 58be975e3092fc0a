//! Events that wait until every recorder hears them, so that the start of the stack and a recorder's own death are in
//! the recording. Their stamps are those of when they happened. Sans-I/O.

use super::rail_thread::Beat;
use ipc_types::Stack;
use ipc_types::event::{EventBody, EventKind};
use ipc_types::payload::HealthState;
use serde_json::Value;
use std::collections::VecDeque;

/// Events that may wait.
const WAITING_MAX: usize = 256;
/// How long they wait at most, in ns.
const WAITING_LIMIT_NS: u64 = 10_000_000_000;

/// A recorder, as far as events are concerned.
#[derive(Debug)]
struct Listening {
    service: usize,
    name: String,
    /// Its generation from which on it counts.
    from: u32,
    ready: bool,
    /// It is down until somebody starts it again: nothing waits for it.
    held: bool,
}

/// Events on their way to the rail.
#[derive(Debug)]
pub struct Outbox {
    recorders: Vec<Listening>,
    waiting: VecDeque<EventBody>,
}

impl Outbox {
    pub fn new(stack: &Stack) -> Self {
        let recorders = stack.services.iter().enumerate().filter(|(_, s)| s.wiring.records);
        Self::with(recorders.map(|(service, entry)| (service, entry.name.clone())))
    }

    fn with(recorders: impl Iterator<Item = (usize, String)>) -> Self {
        let recorders = recorders
            .map(|(service, name)| Listening { service, name, from: 1, ready: false, held: false })
            .collect();
        Self { recorders, waiting: VecDeque::new() }
    }

    /// Takes an event; [`Self::due`] says when it may go.
    pub fn take(&mut self, body: EventBody) {
        if let Some(recorder) = self.recorders.iter_mut().find(|r| r.name == body.service) {
            match body.event {
                EventKind::Died => {
                    let generation = body.detail.get("generation").and_then(Value::as_u64).unwrap_or(0);
                    recorder.from = generation as u32 + 1;
                    recorder.ready = false;
                }
                EventKind::Held => recorder.held = true,
                EventKind::Started => recorder.held = false,
                _ => {}
            }
        }
        self.waiting.push_back(body);
    }

    /// What may be published now, in order: all when every recorder is ready, else what waited for too long or is
    /// too much.
    pub fn due(&mut self, beats: &[Beat], now: u64) -> Vec<EventBody> {
        for beat in beats.iter().filter(|b| matches!(b.state, HealthState::Ready | HealthState::Degraded)) {
            for recorder in self.recorders.iter_mut().filter(|r| r.service == beat.service) {
                recorder.ready |= beat.generation >= recorder.from;
            }
        }
        if self.recorders.iter().all(|r| r.ready || r.held) {
            return self.rest();
        }
        let too_long =
            self.waiting.iter().take_while(|b| now.saturating_sub(b.t_ns) > WAITING_LIMIT_NS).count();
        let count = too_long.max(self.waiting.len().saturating_sub(WAITING_MAX));
        self.waiting.drain(..count).collect()
    }

    /// All that waits.
    pub fn rest(&mut self) -> Vec<EventBody> {
        self.waiting.drain(..).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ipc_types::event::Level;

    fn event(service: &str, kind: EventKind, generation: u32, t_ns: u64) -> EventBody {
        let detail = serde_json::json!({ "generation": generation });
        EventBody { t_ns, ..EventBody::now(kind, Level::Info, service, "", detail) }
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
        outbox.take(event("plc", EventKind::Started, 1, 0));
        assert!(
            outbox.due(&[beat(1, 1, HealthState::Starting), beat(0, 1, HealthState::Ready)], 0).is_empty()
        );
        assert_eq!(kinds(&outbox.due(&[beat(1, 1, HealthState::Ready)], 0)), [EventKind::Started]);
        outbox.take(event("plc", EventKind::Died, 1, 0));
        assert_eq!(kinds(&outbox.due(&[], 0)), [EventKind::Died], "another's death does not wait");
        outbox.take(event("rec", EventKind::Died, 1, 0));
        outbox.take(event("rec", EventKind::Started, 2, 0));
        assert!(outbox.due(&[beat(1, 1, HealthState::Ready)], 0).is_empty(), "a heartbeat from before");
        let heard = outbox.due(&[beat(1, 2, HealthState::Ready)], 0);
        assert_eq!(kinds(&heard), [EventKind::Died, EventKind::Started]);
    }

    #[test]
    fn events_wait_neither_for_ever_nor_without_bound() {
        let mut outbox = Outbox::with([(0, "rec".to_owned())].into_iter());
        outbox.take(event("a", EventKind::Started, 1, 0));
        outbox.take(event("b", EventKind::Ready, 1, 5));
        assert_eq!(kinds(&outbox.due(&[], WAITING_LIMIT_NS + 5)), [EventKind::Started]);
        for _ in 0..WAITING_MAX {
            outbox.take(event("c", EventKind::Died, 1, 5));
        }
        assert_eq!(kinds(&outbox.due(&[], 5)), [EventKind::Ready]);
        assert_eq!(outbox.rest().len(), WAITING_MAX);
    }

    #[test]
    fn a_recorder_that_is_held_delays_nobody() {
        let mut outbox = Outbox::with([(0, "rec".to_owned())].into_iter());
        assert!(outbox.due(&[beat(0, 1, HealthState::Ready)], 0).is_empty());
        outbox.take(event("rec", EventKind::Died, 1, 0));
        outbox.take(event("rec", EventKind::Held, 1, 0));
        assert_eq!(kinds(&outbox.due(&[], 0)), [EventKind::Died, EventKind::Held]);
        outbox.take(event("plc", EventKind::Died, 1, 0));
        assert_eq!(kinds(&outbox.due(&[], 0)), [EventKind::Died]);
        // Started by hand, it is waited for again.
        outbox.take(event("rec", EventKind::Started, 2, 0));
        assert!(outbox.due(&[], 0).is_empty());
        assert_eq!(kinds(&outbox.due(&[beat(0, 2, HealthState::Ready)], 0)), [EventKind::Started]);
    }

    #[test]
    fn without_a_recorder_nothing_waits() {
        let mut outbox = Outbox::with(std::iter::empty());
        outbox.take(event("a", EventKind::Started, 1, 0));
        assert_eq!(outbox.due(&[], 0).len(), 1);
    }
}
