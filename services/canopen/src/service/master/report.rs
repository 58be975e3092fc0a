//! What the service tells: events, its status, the state of the network.

use super::Service;
use super::book::Book;
use super::jobs::Now;
use crate::master::boot::Letter;
use crate::master::network::{Event, NodeRun, state_name};
use crate::service::words;
use ipc_types::event::{EventKind, Level};
use ipc_types::payload::HealthState;
use ipc_types::port::Subscriber;
use serde_json::{Value, json};

/// Longest state of the network that is published every second (the limit of `<svc>/status`); a longer one goes
/// without the reasons of failed boots.
const STATUS_BYTES: usize = 16_384;

/// How the boot-up of a node goes or went.
pub(super) fn boot(now: Now, run: &NodeRun, book: &Book) -> Value {
    let id = run.id();
    let mut value = json!({
        "id": id,
        "name": book.names.get(&id),
        "step": run.boot.step_text(),
        "booted": run.boot.is_running(),
        "tries": run.boot.attempts(),
    });
    if run.boot.began_ns() > 0 {
        value["began_utc_ms"] = json!(now.utc_ms(run.boot.began_ns()));
    }
    if let Some((at_ns, took_ns)) = run.booted_ns {
        value["booted_utc_ms"] = json!(now.utc_ms(at_ns));
        value["took_ms"] = json!(took_ns / 1_000_000);
    }
    if run.boot.is_running() && run.kept {
        value["letter"] = json!(Letter::L);
        value["text"] = json!(Letter::L.text());
    }
    if let Some(failure) = &run.last_failure {
        value["letter"] = json!(failure.letter);
        value["text"] = json!(words::failure_text(failure, |i, s| book.object(id, i, s)));
        value["failed_utc_ms"] = json!(run.failed_ns.map(|t_ns| now.utc_ms(t_ns)));
    }
    value
}

impl Service {
    pub(super) fn tell_events(&mut self) {
        let events: Vec<Event> = self.network.drain_events().collect();
        for event in events {
            if !self.events.take() {
                continue;
            }
            let node = match &event {
                Event::BootFailed { node, .. } => *node,
                _ => 0,
            };
            let (kind, level, text, detail) =
                words::event(&event, |n| self.desk.book.node(n), |i, s| self.desk.book.object(node, i, s));
            self.ctx.event(kind, level, text, detail);
        }
        let whole = self.network.is_whole() && !self.network.is_bus_off();
        let state = if whole { HealthState::Ready } else { HealthState::Degraded };
        if state != self.state {
            self.state = state;
            self.ctx.set_state(state);
        }
    }

    fn node_status(&self, run: &NodeRun) -> Value {
        let id = run.id();
        let mut value = json!({
            "id": id,
            "name": self.desk.book.names.get(&id),
            "state": run.state.map_or("unknown", state_name),
            "boot": run.boot.step_text(),
            "operational": run.is_operational(),
            "mandatory": run.settings.mandatory,
            "tries": run.boot.attempts(),
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
            value["failure"] = json!(words::failure_text(failure, |i, s| self.desk.book.object(id, i, s)));
        }
        value
    }

    pub(super) fn network_status(&self) -> Value {
        json!({
            "node_id": self.config.node_id,
            "state": state_name(self.network.state()),
            "started": self.network.is_started(),
            "whole": self.network.is_whole(),
            "bus_off": self.network.is_bus_off(),
            "nodes": self.network.nodes().iter().map(|n| self.node_status(n)).collect::<Vec<_>>(),
            "network": self.network.counters(),
            "pdo": self.network.exchange.counters(),
            "queues": self.network.exchange.queues().collect::<Vec<_>>(),
            "sync_late_us": { "last": self.sync_late_ns.0 / 1000, "max": self.sync_late_ns.1 / 1000 },
            "sync_out_us": { "last": self.sync_out_ns.0 / 1000, "max": self.sync_out_ns.1 / 1000 },
            "lss_jobs": self.network.lss.waiting(),
            "frames_dropped": self.ports.queue.dropped(),
            "frames_waiting": self.ports.queue.len(),
            "safe": self.ports.image.why(),
            "rx": self.ports.rx.as_ref().map(Subscriber::counters),
        })
    }

    pub(super) fn report(&mut self) {
        if let Some(left_out) = self.events.renew() {
            let message = format!("{left_out} more events in the last second left out");
            self.ctx.event(EventKind::NodeState, Level::Warning, message, Value::Null);
        }
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
