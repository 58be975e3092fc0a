//! Units that go and come back, ranges that turn bad: what the rail is told.

use super::super::ask::exception_words;
use super::super::image::QualityChange;
use super::super::line::{Failure, UnitNews, UnitState};
use super::super::plan::Batch;
use super::super::wiring::points;
use super::Service;
use super::runner::{Runner, Transport, Use, set_write};
use crate::map_config::traditional_number;
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

    /// A unit refused a read or a write, or does no longer: told once.
    pub(super) fn refusal(&mut self, line: usize, slot: usize, unit: u8, refused: Option<(u8, u8)>) {
        let Runner { places, uses, .. } = &mut self.runners[line];
        let Some(place) = places.get_mut(slot).filter(|place| place.refused != refused) else { return };
        place.changed(refused);
        let done = if matches!(uses.get(slot), Some(Use::Write)) { "written" } else { "read" };
        let what = points(place.table, place.at, place.count);
        let number = traditional_number(place.table, place.at);
        let (at, count) = (place.at, place.count);
        let name = self.name_of(line, unit);
        match refused {
            None => {
                let message = format!("{name}: {what} can be {done} again");
                self.tell(EventKind::BusState, Level::Info, message);
            }
            Some((function, code)) => {
                let words = exception_words(code, function);
                let check = match code {
                    1 => "does the unit have this table, or the other one of its kind?".to_owned(),
                    2 if count == 1 => format!("`at` counts from 0 ({number} is at = {at})"),
                    2 => {
                        format!("`at` counts from 0 ({number} is at = {at}); does the unit have all {count}?")
                    }
                    3 if count == 1 => "may this one stand in a request alone, with this value?".to_owned(),
                    3 => format!("does the unit take {count} in one request?"),
                    _ => "the manual of the unit".to_owned(),
                };
                let message = format!("{name}: {what} cannot be {done}: {words}; check: {check}");
                self.tell(EventKind::BusState, Level::Warning, message);
            }
        }
    }

    /// The port or connection of a line does not work: told once for each reason.
    pub(super) fn link_trouble(&mut self, line: usize, why: &str) {
        let stale = self.fail_reads(|at| at.0 == line);
        let runner = &mut self.runners[line];
        if runner.trouble.as_deref() == Some(why) {
            return;
        }
        runner.trouble = Some(why.to_owned());
        let message = format!("{why}; it is tried again{}", ranges_are_stale(stale));
        self.tell(EventKind::BusState, Level::Warning, message);
    }

    /// ... and works.
    pub(super) fn link_works(&mut self, line: usize) {
        let runner = &mut self.runners[line];
        if runner.trouble.take().is_some() {
            let again = match runner.transport {
                Transport::Tcp(_) => format!("connected to {} again", runner.plan.target),
                Transport::Serial(_) => format!("{} works again", runner.plan.target),
            };
            self.tell(EventKind::BusState, Level::Info, again);
        }
    }

    /// What was read of these lines and units is not good any more. How many ranges are stale.
    fn fail_reads(&mut self, is: impl Fn((usize, u8)) -> bool) -> usize {
        let mut stale = 0;
        for (read, at) in self.read_units.iter().enumerate() {
            if is(*at) {
                self.inputs.failed(read);
                stale += usize::from(self.inputs.quality(read) == Quality::Stale);
            }
        }
        stale
    }

    /// Follows units that go and come back.
    pub(super) fn line_news(&mut self, line: usize, lost: Option<Failure>, now_ns: u64) {
        match lost {
            None => self.link_works(line),
            Some(Failure::Link) if self.runners[line].trouble.is_none() => {
                let target = self.runners[line].plan.target.to_string();
                self.link_trouble(line, &format!("{target} did not send a request in time"));
            }
            Some(_) => {}
        }
        while let Some(UnitNews { unit, dead, by_gateway }) = self.runners[line].line.unit_news() {
            let name = self.name_of(line, unit);
            if dead {
                let stale = ranges_are_stale(self.fail_reads(|at| at == (line, unit)));
                let how = by_gateway.map_or(String::new(), |code| {
                    format!(" (the gateway in front of it says so by exception {code:02X})")
                });
                let message =
                    format!("{name} does not answer{how}; it is tried again from time to time{stale}");
                self.tell(EventKind::BusState, Level::Warning, message);
                continue;
            }
            self.tell(EventKind::BusState, Level::Info, format!("{name} answers again"));
            // It may have been switched off: it gets its values again.
            let Self { writes, runners, write_slots, .. } = self;
            writes.again(line, Some(unit), now_ns, |i, pdu| set_write(runners, write_slots, i, pdu, now_ns));
        }
    }

    /// Whether something is wrong that the status shows.
    pub(super) fn is_degraded(&self) -> bool {
        let line_is = |runner: &Runner| {
            let planned = |unit| runner.plan.units.iter().any(|u| u.unit == unit);
            runner.trouble.is_some()
                || runner.places.iter().any(|place| place.refused.is_some())
                || runner.line.units().any(|u| u.state == UnitState::Dead && planned(u.unit))
        };
        self.runners.iter().any(line_is)
            || (0..self.reads.len()).any(|read| self.inputs.quality(read) == Quality::Stale)
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
        // Line, unit, whether good; reads.
        let mut groups: Vec<((usize, u8, bool), Vec<usize>)> = Vec::new();
        for QualityChange { read, quality } in self.inputs.drain_changes() {
            let (line, unit) = self.read_units[read];
            let runner = &self.runners[line];
            // What makes all of them stale was told with their number.
            let covered = runner.trouble.is_some() || runner.line.unit_state(unit) == UnitState::Dead;
            let good = quality == Quality::Good;
            if self.told[read] == quality || (!good && covered) {
                continue;
            }
            self.told[read] = quality;
            match groups.iter_mut().find(|(of, _)| *of == (line, unit, good)) {
                Some((_, reads)) => reads.push(read),
                None => groups.push(((line, unit, good), vec![read])),
            }
        }
        for ((line, unit, good), reads) in groups {
            let (level, word) = if good { (Level::Info, "good") } else { (Level::Warning, "stale") };
            let first = &self.reads[reads[0]];
            let (more, are) = match reads.len() - 1 {
                0 => (String::new(), "is"),
                1 => (" and 1 more range".to_owned(), "are"),
                n => (format!(" and {n} more ranges"), "are"),
            };
            let message = format!("{first}{more} of {} {are} {word}", self.name_of(line, unit));
            self.tell(EventKind::InputQuality, level, message);
        }
    }
}

/// The end of a sentence about what made them stale.
fn ranges_are_stale(count: usize) -> String {
    match count {
        0 => String::new(),
        1 => "; 1 range is stale".to_owned(),
        n => format!("; {n} ranges are stale"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranges_are_counted_in_words() {
        assert_eq!([0, 1, 2].map(ranges_are_stale), ["", "; 1 range is stale", "; 2 ranges are stale"]);
    }
}
