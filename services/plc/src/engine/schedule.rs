//! Which tasks are due: a pure function of the scan's stamp, its trigger, the task table and what ran before.

use dinrail_iec::artifact::Task;
use ipc_types::scan_record::TaskState;

/// One task of the table.
#[derive(Debug, Clone)]
pub(crate) struct Slot {
    pub index: usize,
    priority: u32,
    interval_ns: Option<i64>,
    /// It has neither INTERVAL nor SINGLE, and the stack file names an event that triggers such tasks.
    on_event: bool,
    /// Offset of the BOOL and its bit, when the task is triggered by an edge.
    single: Option<SingleBit>,
    /// [`NEVER`] while it waits for an event.
    next_ns: i64,
    last_single: bool,
    pub skipped: u64,
}

/// Where the BOOL of a SINGLE lies.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct SingleBit {
    pub offset: u32,
    pub mask: u8,
}

/// No PLC time makes a task due.
const NEVER: i64 = i64::MAX;

/// The task table with its state, highest priority first, then as declared.
#[derive(Debug, Clone, Default)]
pub(crate) struct Schedule {
    slots: Vec<Slot>,
}

/// A due task.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Due {
    pub task: usize,
    /// Periods that were skipped because the scan came late, or events that triggered no scan.
    pub skipped: u64,
}

impl Schedule {
    /// `on_event`: tasks without INTERVAL and SINGLE wait for a trigger; else they run in every scan.
    pub(crate) fn new(tasks: &[Task], on_event: bool, single: impl Fn(&str) -> Option<SingleBit>) -> Self {
        let mut slots: Vec<Slot> = tasks
            .iter()
            .enumerate()
            .map(|(index, task)| Slot {
                index,
                priority: task.priority,
                interval_ns: task.interval_ns.and_then(|ns| i64::try_from(ns).ok()).filter(|ns| *ns > 0),
                on_event: on_event && task.interval_ns.is_none() && task.single.is_none(),
                single: task.single.as_deref().and_then(&single),
                next_ns: i64::MIN,
                last_single: false,
                skipped: 0,
            })
            .collect();
        slots.sort_by_key(|slot| (slot.priority, slot.index));
        Self { slots }
    }

    pub(crate) fn len(&self) -> usize {
        self.slots.len()
    }

    /// At a start: periods count from this scan on, which is the first of every task that is not triggered by a BOOL.
    pub(crate) fn start(&mut self, plc_time_ns: i64) {
        for slot in &mut self.slots {
            slot.next_ns = plc_time_ns;
            slot.last_single = false;
            slot.skipped = 0;
        }
    }

    /// Whether the slot at this place of the order is due, and takes note of it. Call once a scan for each.
    /// `trigger`: the event came, so many were missed before.
    pub(crate) fn due(
        &mut self,
        place: usize,
        plc_time_ns: i64,
        trigger: Option<u64>,
        memory: &[u8],
    ) -> Option<Due> {
        let slot = self.slots.get_mut(place)?;
        let level =
            slot.single.map(|bit| memory.get(bit.offset as usize).is_some_and(|byte| byte & bit.mask != 0));
        let edge = level.is_some_and(|now| now && !slot.last_single);
        if let Some(now) = level {
            slot.last_single = now;
        }
        let mut skipped = 0;
        let mut periodic = false;
        if let Some(interval) = slot.interval_ns {
            if plc_time_ns >= slot.next_ns {
                let late = plc_time_ns.saturating_sub(slot.next_ns) / interval;
                slot.next_ns = slot.next_ns.saturating_add(interval.saturating_mul(late + 1));
                // IEC 61131-3 2.7.2: with SINGLE, periodic only while it stands at 0.
                periodic = level != Some(true);
                if periodic {
                    skipped = late as u64;
                }
            }
        } else if slot.on_event {
            periodic = trigger.is_some() || plc_time_ns >= slot.next_ns;
            skipped = trigger.unwrap_or(0);
            slot.next_ns = NEVER;
        } else if slot.single.is_none() {
            periodic = true;
        }
        slot.skipped += skipped;
        (edge || periodic).then_some(Due { task: slot.index, skipped })
    }

    /// PLC time of the next periodic task; `None` when no task has a period.
    pub(crate) fn next_ns(&self) -> Option<i64> {
        self.slots.iter().filter(|s| s.interval_ns.is_some()).map(|s| s.next_ns).min()
    }

    /// Smallest period.
    pub(crate) fn shortest_ns(&self) -> Option<i64> {
        self.slots.iter().filter_map(|s| s.interval_ns).min()
    }

    pub(crate) fn skipped_total(&self) -> u64 {
        self.slots.iter().map(|s| s.skipped).sum()
    }

    pub(crate) fn states(&self) -> impl Iterator<Item = TaskState> + '_ {
        self.slots.iter().map(|slot| TaskState {
            task: slot.index as u16,
            next_ns: slot.next_ns,
            single: slot.last_single,
            skipped: slot.skipped,
        })
    }

    pub(crate) fn restore(&mut self, state: &TaskState) {
        if let Some(slot) = self.slots.iter_mut().find(|s| s.index == usize::from(state.task)) {
            slot.next_ns = state.next_ns;
            slot.last_single = state.single;
            slot.skipped = state.skipped;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn task(priority: u32, interval_ms: Option<u64>, single: Option<&str>) -> Task {
        Task {
            name: String::new(),
            export: String::new(),
            priority,
            interval_ns: interval_ms.map(|ms| ms * 1_000_000),
            single: single.map(str::to_owned),
            programs: Vec::new(),
        }
    }

    fn ran(schedule: &mut Schedule, t_ms: i64, memory: &[u8]) -> Vec<(usize, u64)> {
        (0..schedule.len())
            .filter_map(|i| schedule.due(i, t_ms * 1_000_000, None, memory))
            .map(|d| (d.task, d.skipped))
            .collect()
    }

    #[test]
    fn an_event_runs_the_tasks_that_have_no_time_of_their_own() {
        let tasks = [task(3, Some(10), None), task(0, None, None), task(1, None, Some("go"))];
        let mut schedule = Schedule::new(&tasks, true, |_| Some(SingleBit { offset: 0, mask: 1 }));
        let mut state = Vec::new();
        schedule.start(0);
        for (t_ms, trigger, expected) in [
            (0, None, vec![(1, 0), (0, 0)]), // the start
            (4, None, vec![]),
            (5, Some(0), vec![(1, 0)]),
            (6, None, vec![]),
            (10, Some(3), vec![(1, 3), (0, 0)]),
            (20, None, vec![(0, 0)]),
            (21, Some(0), vec![(1, 0)]),
        ] {
            // Whoever continues from a keyframe comes to the same.
            let mut again = Schedule::new(&tasks, true, |_| Some(SingleBit { offset: 0, mask: 1 }));
            for task in &state {
                again.restore(task);
            }
            let now = |schedule: &mut Schedule| -> Vec<(usize, u64)> {
                (0..schedule.len())
                    .filter_map(|i| schedule.due(i, t_ms * 1_000_000, trigger, &[0]))
                    .map(|d| (d.task, d.skipped))
                    .collect()
            };
            if !state.is_empty() {
                assert_eq!(now(&mut again), expected, "again at {t_ms} ms");
            }
            assert_eq!(now(&mut schedule), expected, "at {t_ms} ms");
            state = schedule.states().collect();
        }
        assert_eq!((schedule.skipped_total(), schedule.next_ns()), (3, Some(30_000_000)));
    }

    #[test]
    fn priority_orders_and_late_scans_skip_periods() {
        let tasks = [task(5, Some(10), None), task(1, Some(25), None), task(1, None, None)];
        let mut schedule = Schedule::new(&tasks, false, |_| None);
        schedule.start(100_000_000);
        for (t_ms, expected) in [
            (100, vec![(1, 0), (2, 0), (0, 0)]),
            (105, vec![(2, 0)]),
            (110, vec![(2, 0), (0, 0)]),
            (125, vec![(1, 0), (2, 0), (0, 0)]), // 120 came at 125: late, not skipped
            (130, vec![(2, 0), (0, 0)]),
            (171, vec![(1, 0), (2, 0), (0, 3)]), // 140, 150, 160 never came
            (180, vec![(1, 0), (2, 0), (0, 0)]),
        ] {
            assert_eq!(ran(&mut schedule, t_ms, &[]), expected, "at {t_ms} ms");
        }
        assert_eq!(schedule.skipped_total(), 3);
        assert_eq!(schedule.next_ns(), Some(190_000_000));
    }

    #[test]
    fn single_runs_on_the_rising_edge_and_the_period_only_while_it_is_low() {
        let mut schedule =
            Schedule::new(&[task(0, Some(10), Some("go"))], true, |_| Some(SingleBit { offset: 0, mask: 2 }));
        schedule.start(0);
        for (t_ms, byte, runs) in
            [(0, 0, true), (5, 2, true), (10, 2, false), (15, 0, false), (20, 0, true), (21, 2, true)]
        {
            assert_eq!(!ran(&mut schedule, t_ms, &[byte]).is_empty(), runs, "at {t_ms} ms");
        }
    }
}
