//! Units that go and come back, ranges that turn bad: what the rail is told.

use super::super::line::{Failure, UnitState};
use super::super::plan::Batch;
use super::Service;
use super::runner::{Runner, set_write};
use ipc_types::event::{EventKind, Level};
use ipc_types::payload::Quality;
use serde_json::Value;

impl Service {
    /// A request put together of several ranges was refused: from now on they are read one by one.
    pub(super) fn split(&mut self, line: usize, batch: usize, now_ns: u64) {
        let Runner { line: core, plan, batch_slots, .. } = &mut self.runners[line];
        let Batch { unit, table, at, count, ref alone, .. } = plan.batches[batch];
        tracing::warn!(
            "unit {unit} on {} refuses {} {at} + {count} in one request; its ranges are read one by one from now on",
            plan.target,
            table.name()
        );
        core.enable(batch_slots[batch], false, now_ns);
        for &single in alone {
            core.enable(batch_slots[single], true, now_ns);
        }
    }

    /// Follows units that go and come back.
    pub(super) fn unit_news(
        &mut self,
        line: usize,
        unit: u8,
        answered: bool,
        lost: Option<Failure>,
        now_ns: u64,
    ) {
        if lost == Some(Failure::Link) {
            for (read, at) in self.read_units.iter().enumerate() {
                if at.0 == line {
                    self.inputs.failed(read);
                }
            }
        }
        let runner = &mut self.runners[line];
        let is_dead = runner.line.unit_state(unit) == UnitState::Dead;
        let was_dead = runner.dead.contains(&unit);
        if is_dead && !was_dead {
            runner.dead.push(unit);
            for (read, at) in self.read_units.iter().enumerate() {
                if *at == (line, unit) {
                    self.inputs.failed(read);
                }
            }
            let message =
                format!("{} does not answer; it is tried again from time to time", self.name_of(line, unit));
            self.tell(EventKind::BusState, Level::Warning, message);
        } else if was_dead && answered && !is_dead {
            self.runners[line].dead.retain(|&d| d != unit);
            let message = format!("{} answers again", self.name_of(line, unit));
            self.tell(EventKind::BusState, Level::Info, message);
            // It may have been switched off: it gets its values again.
            let Self { writes, runners, write_slots, .. } = self;
            writes.again(line, Some(unit), now_ns, |i, pdu| set_write(runners, write_slots, i, pdu, now_ns));
        }
    }

    /// Writes all outputs of a connection whose server may have started again.
    pub(super) fn rewrite(&mut self, line: usize, now_ns: u64) {
        let Self { writes, runners, write_slots, .. } = self;
        if runners[line].rewrite.take(now_ns) {
            writes.again(line, None, now_ns, |i, pdu| set_write(runners, write_slots, i, pdu, now_ns));
        }
    }

    pub(super) fn name_of(&self, line: usize, unit: u8) -> String {
        let plan = &self.runners[line].plan;
        let name = plan.units.iter().find(|u| u.unit == unit).and_then(|u| u.name.as_deref());
        match name {
            Some(name) => format!("unit {unit} ({name}) on {}", plan.target),
            None => format!("unit {unit} on {}", plan.target),
        }
    }

    pub(super) fn tell(&mut self, kind: EventKind, level: Level, message: String) {
        if self.events.take() {
            self.ctx.event(kind, level, message, Value::Null);
        }
    }

    pub(super) fn tell_quality(&mut self) {
        let changes: Vec<_> = self.inputs.drain_changes().collect();
        for change in changes {
            let (line, unit) = self.read_units[change.read];
            // The unit was told of already.
            if self.runners[line].dead.contains(&unit) || self.runners[line].trouble.is_some() {
                continue;
            }
            let what = &self.reads[change.read];
            let (level, message) = if change.quality == Quality::Good {
                (Level::Info, format!("{what} of {} is good", self.name_of(line, unit)))
            } else {
                (Level::Warning, format!("{what} of {} is stale", self.name_of(line, unit)))
            };
            self.tell(EventKind::InputQuality, level, message);
        }
    }
}
