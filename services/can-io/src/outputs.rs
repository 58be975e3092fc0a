//! Bytes of %Q and %M in, frames out: on change or cyclic, silent or safe when the PLC does not run.
//!
//! Sans-I/O: told images and time, it says which frames to send. Nothing allocates after [`OutputTable::new`].

use dinrail_iec::LocatedAddress;
use dinrail_iec::artifact::AreaKind;
use ipc_types::outputs::copy_value;

use crate::plan::{OutputFrame, Safe};

/// After a refused frame on change: when to try again.
const RETRY_NS: u64 = 10_000_000;

/// A frame to send.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Sending<'a> {
    /// Identifier with the flag for 29 bits.
    pub can_id: u32,
    /// CAN FD flags.
    pub fd_flags: u8,
    /// Bytes.
    pub payload: &'a [u8],
    /// Only the newest value counts (cyclic).
    pub newest: bool,
}

/// Counters since start.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, serde::Serialize)]
pub struct OutputCounters {
    /// Frames given to the bus.
    pub sent: u64,
    /// Frames the bus refused (queue full or driver down).
    pub refused: u64,
    /// Periods missed because the service was late.
    pub missed: u64,
    /// Images too small for an address.
    pub outside: u64,
}

#[derive(Debug, Clone)]
struct Slot {
    frame: OutputFrame,
    /// What would be sent now.
    payload: [u8; 64],
    /// What was sent last, for `on_change`.
    sent: Option<[u8; 64]>,
    last_sent_ns: Option<u64>,
    /// On change: to be sent, not before this time.
    pending_ns: Option<u64>,
    /// Cyclic: next turn.
    due_ns: Option<u64>,
}

/// See the module.
#[derive(Debug, Clone)]
pub struct OutputTable {
    slots: Vec<Slot>,
    running: bool,
    counters: OutputCounters,
}

impl OutputTable {
    /// Silent until the first image of a running program.
    pub fn new(frames: &[OutputFrame]) -> Self {
        let slots = frames.iter().map(|frame| Slot {
            payload: [frame.fill; 64],
            frame: frame.clone(),
            sent: None,
            last_sent_ns: None,
            pending_ns: None,
            due_ns: None,
        });
        Self { slots: slots.collect(), running: false, counters: OutputCounters::default() }
    }

    /// Whether outputs follow the image.
    pub fn is_running(&self) -> bool {
        self.running
    }

    /// A new image of a program whose outputs count.
    pub fn image(&mut self, outputs: &[u8], markers: &[u8], now_ns: u64) {
        self.running = true;
        for slot in &mut self.slots {
            let mut payload = [slot.frame.fill; 64];
            let mut complete = true;
            for point in &slot.frame.signals {
                let area = if point.from.area == AreaKind::Marker { markers } else { outputs };
                match read(area, point.from) {
                    Some(value) => complete &= point.codec.encode(value, &mut payload),
                    None => complete = false,
                }
            }
            if !complete {
                self.counters.outside += 1;
                continue;
            }
            slot.payload = payload;
            if slot.frame.period_ns.is_some() {
                slot.due_ns.get_or_insert(now_ns);
            } else {
                slot.changed(now_ns);
            }
        }
    }

    /// The image is stale or the program does not run: every frame takes its safe state.
    pub fn safe(&mut self, now_ns: u64) {
        if !self.running {
            return;
        }
        self.running = false;
        for slot in &mut self.slots {
            match slot.frame.safe {
                Safe::Silent => {
                    slot.due_ns = None;
                    slot.pending_ns = None;
                    // The first image afterwards is sent, whatever it holds.
                    slot.sent = None;
                }
                Safe::Hold => slot.pending_ns = None,
                Safe::Payload(payload) => {
                    slot.payload = payload;
                    if slot.frame.period_ns.is_none() {
                        slot.changed(now_ns);
                    }
                }
            }
        }
    }

    /// Hands what is due to `send` (false: refused). Returns when to call again.
    pub fn due(&mut self, now_ns: u64, mut send: impl FnMut(Sending<'_>) -> bool) -> Option<u64> {
        let mut next_ns: Option<u64> = None;
        for slot in &mut self.slots {
            let newest = slot.frame.period_ns.is_some();
            let due_ns = if newest { slot.due_ns } else { slot.pending_ns };
            if due_ns.is_some_and(|due_ns| due_ns <= now_ns) {
                let accepted = send(Sending {
                    can_id: slot.frame.can_id,
                    fd_flags: slot.frame.fd_flags,
                    payload: &slot.payload[..usize::from(slot.frame.len)],
                    newest,
                });
                self.counters.sent += u64::from(accepted);
                self.counters.refused += u64::from(!accepted);
                if let Some(period_ns) = slot.frame.period_ns {
                    let due_ns = due_ns.unwrap_or(now_ns);
                    let late = (now_ns - due_ns) / period_ns.max(1);
                    self.counters.missed += late;
                    slot.due_ns = Some(due_ns + (late + 1) * period_ns.max(1));
                } else if accepted {
                    slot.pending_ns = None;
                    slot.sent = Some(slot.payload);
                    slot.last_sent_ns = Some(now_ns);
                } else {
                    slot.pending_ns = Some(now_ns + RETRY_NS);
                }
            }
            let wanted = if newest { slot.due_ns } else { slot.pending_ns };
            next_ns = next_ns.into_iter().chain(wanted).min();
        }
        next_ns
    }

    /// Counters since start.
    pub fn counters(&self) -> OutputCounters {
        self.counters
    }
}

impl Slot {
    /// On change: sends unless that was sent last; a value that went back meanwhile needs nothing.
    fn changed(&mut self, now_ns: u64) {
        let len = usize::from(self.frame.len);
        if self.sent.is_some_and(|sent| sent[..len] == self.payload[..len]) {
            self.pending_ns = None;
        } else if self.pending_ns.is_none() {
            let free_ns =
                self.last_sent_ns.map_or(0, |last_ns| last_ns.saturating_add(self.frame.inhibit_ns));
            self.pending_ns = Some(free_ns.max(now_ns));
        }
    }
}

/// The value at an address as little-endian bytes; a bit as 0 or 1.
fn read(area: &[u8], address: LocatedAddress) -> Option<[u8; 8]> {
    let mut value = [0u8; 8];
    let place = value.get_mut(..address.size.bytes() as usize)?;
    copy_value(area, address.byte, address.bit, place).then_some(value)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::plan;
    use proptest::prelude::*;
    use serde_json::{Value, json};

    const MS: u64 = 1_000_000;

    fn table(outputs: Value) -> OutputTable {
        let plan = plan(
            &serde_json::from_value(json!({ "out": outputs })).unwrap(),
            dinrail_iec::Addressing::Element,
        );
        assert_eq!(plan.mistakes, []);
        OutputTable::new(&plan.outputs)
    }

    fn sent(table: &mut OutputTable, now_ns: u64) -> (Vec<String>, Option<u64>) {
        let mut frames = Vec::new();
        let next = table.due(now_ns, |f| {
            let data = f.payload.iter().map(|b| format!("{b:02X}")).collect::<Vec<_>>().concat();
            frames.push(format!("{:X}#{data}{}", f.can_id, if f.newest { " newest" } else { "" }));
            true
        });
        (frames, next)
    }

    fn one(id: u32, mode: &str, rest: Value) -> Value {
        let mut frame = json!({ "id": id, "dlc": 2, "mode": mode, "signals": [
            { "start": 0, "len": 8, "from": "%QB0" }, { "start": 8, "len": 1, "from": "%QX1.3" } ] });
        frame.as_object_mut().unwrap().extend(rest.as_object().unwrap().clone());
        frame
    }

    #[test]
    fn on_change_with_inhibit() {
        let mut table = table(json!([one(0x10, "on_change", json!({ "inhibit": "10ms" }))]));
        assert_eq!(sent(&mut table, 0), (vec![], None));
        table.image(&[1, 0xF7], &[], 0);
        assert_eq!(sent(&mut table, 0), (vec!["10#0100".into()], None));
        table.image(&[1, 0xF7], &[], 1);
        assert_eq!(sent(&mut table, 1), (vec![], None), "nothing changed");
        table.image(&[2, 8], &[], 2 * MS);
        assert_eq!(sent(&mut table, 2 * MS), (vec![], Some(10 * MS)));
        table.image(&[3, 8], &[], 3 * MS);
        assert_eq!(sent(&mut table, 10 * MS), (vec!["10#0301".into()], None), "the newest value");
        // There and back within the inhibit time: nothing to say.
        table.image(&[4, 8], &[], 11 * MS);
        table.image(&[3, 8], &[], 12 * MS);
        assert_eq!(sent(&mut table, 30 * MS), (vec![], None));
    }

    #[test]
    fn a_refused_frame_is_tried_again_with_the_newest_value() {
        let mut table = table(json!([one(0x10, "on_change", json!({}))]));
        table.image(&[1, 0], &[], 0);
        assert_eq!(table.due(0, |_| false), Some(RETRY_NS));
        table.image(&[2, 0], &[], MS);
        assert_eq!(sent(&mut table, RETRY_NS), (vec!["10#0200".into()], None));
        assert_eq!(table.counters(), OutputCounters { sent: 1, refused: 1, ..Default::default() });
    }

    #[test]
    fn cyclic_without_drift() {
        let mut table = table(json!([one(0x10, "cyclic", json!({ "period": "10ms" }))]));
        table.image(&[1, 0], &[], 5 * MS);
        assert_eq!(sent(&mut table, 5 * MS), (vec!["10#0100 newest".into()], Some(15 * MS)));
        table.image(&[2, 0], &[], 6 * MS);
        assert_eq!(sent(&mut table, 6 * MS), (vec![], Some(15 * MS)));
        assert_eq!(sent(&mut table, 16 * MS), (vec!["10#0200 newest".into()], Some(25 * MS)));
        // 34 ms late: one frame now, three periods counted as missed, the grid kept.
        assert_eq!(sent(&mut table, 59 * MS), (vec!["10#0200 newest".into()], Some(65 * MS)));
        assert_eq!(table.counters(), OutputCounters { sent: 3, missed: 3, ..Default::default() });
    }

    #[test]
    fn safe_states() {
        let outputs = json!([
            one(1, "cyclic", json!({ "period": "10ms" })),
            one(2, "cyclic", json!({ "period": "10ms", "on_stop": "hold" })),
            one(3, "cyclic", json!({ "period": "10ms", "on_stop": "not_available" })),
            one(4, "on_change", json!({ "on_stop": { "values": [66, 1] } })),
            one(5, "on_change", json!({ "on_stop": "hold" })),
            one(6, "on_change", json!({ "fill": 255 })),
        ]);
        let mut table = table(outputs);
        // Nothing before the first good image, not even safe values.
        table.safe(0);
        assert_eq!(sent(&mut table, 0), (vec![], None));
        table.image(&[7, 8], &[], 0);
        let all = ["1#0701 newest", "2#0701 newest", "3#0701 newest", "4#0701", "5#0701", "6#07FF"];
        assert_eq!(sent(&mut table, 0).0, all);
        table.image(&[8, 8], &[], MS);
        table.safe(2 * MS);
        assert!(!table.is_running());
        assert_eq!(sent(&mut table, 2 * MS).0, ["4#4201"]);
        assert_eq!(sent(&mut table, 10 * MS).0, ["2#0801 newest", "3#FF01 newest"]);
        table.safe(11 * MS);
        assert_eq!(sent(&mut table, 20 * MS).0, ["2#0801 newest", "3#FF01 newest"]);
        // Back: the silent ones speak at once.
        table.image(&[7, 8], &[], 25 * MS);
        assert_eq!(sent(&mut table, 25 * MS).0, ["1#0701 newest", "4#0701", "6#07FF"]);
        assert_eq!(sent(&mut table, 30 * MS).0, ["2#0701 newest", "3#0701 newest"]);
    }

    #[test]
    fn an_image_too_small_sends_nothing() {
        let mut table =
            table(json!([one(1, "on_change", json!({})), one(2, "cyclic", json!({ "period": "1ms" }))]));
        table.image(&[1], &[], 0);
        assert_eq!(sent(&mut table, 0), (vec![], None));
        assert_eq!(table.counters().outside, 2);
    }

    proptest! {
        #[test]
        fn any_image_any_time(steps in prop::collection::vec((any::<u64>(), prop::collection::vec(any::<u8>(), 0..4), any::<bool>(), any::<bool>()), 0..60)) {
            let mut table = table(json!([
                one(1, "on_change", json!({ "inhibit": "1ms" })),
                one(2, "cyclic", json!({ "period": "1ms", "on_stop": "not_available" })),
            ]));
            let mut now_ns = 0u64;
            for (step_ns, image, safe, accept) in steps {
                now_ns = now_ns.saturating_add(step_ns % (100 * MS));
                if safe {
                    table.safe(now_ns);
                } else {
                    table.image(&image, &image, now_ns);
                }
                let mut frames = 0;
                let next_ns = table.due(now_ns, |_| { frames += 1; accept });
                prop_assert!(frames <= 2);
                prop_assert!(next_ns.is_none_or(|next_ns| next_ns > now_ns));
            }
        }
    }
}
