//! PDOs to and from the process image, the master's half of them. Sans-I/O.
//!
//! Synchronous PDOs are coherent both ways (the design's section 4): what nodes send after one SYNC is collected and
//! becomes one sample when all of it is in or the window ends; what the master sends after a SYNC comes from one
//! image. Which SYNC a frame belongs to is decided by the order on the bus, where the master's own SYNC comes back
//! as an echo, never by a clock.
//!
//! A PDO with a queue is no part of a sample: each of its values is shown to exactly one scan, in order.
//!
//! Nothing allocates after [`Exchange::new`].

mod model;
mod queue;

pub use model::{Counters, Field, Plan, RxPdo, TxPdo, transmission};
pub use queue::QueueState;

use crate::protocol::io::Outbox;
use ipc_types::payload::{CanFrame, Quality, can_flag, id_flag};
use queue::Queue;

/// Most bytes of a PDO on classic CAN.
pub const PDO_BYTES: usize = 8;
/// Bits of the identifier that count for finding a PDO, with the flag of the extended format.
const ID_MASK: u32 = id_flag::EFF | id_flag::EFF_MASK;

#[derive(Debug, Clone)]
struct Rx {
    pdo: RxPdo,
    data: [u8; PDO_BYTES],
    /// Received since the last SYNC.
    fresh: bool,
    /// Awaited in this window.
    expected: bool,
    /// Its inputs were made bad and nothing has come since.
    bad: bool,
    /// Index of its queue, [`NONE`] for none.
    queue: u16,
    /// SYNCs until it is awaited.
    syncs_left: u16,
    /// One has come since its node became operational: its turns are known.
    known: bool,
    deadline_ns: Option<u64>,
    poll_at_ns: Option<u64>,
}

#[derive(Debug, Clone)]
struct Tx {
    pdo: TxPdo,
    sent: [u8; PDO_BYTES],
    /// Nothing has been sent since its node became operational.
    first: bool,
    syncs_left: u8,
    inhibit_until_ns: u64,
    event_at_ns: Option<u64>,
}

/// What the caller shall publish.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Sample {
    /// It is the one sample of a SYNC.
    pub sync: bool,
}

/// See the module.
#[derive(Debug, Clone)]
pub struct Exchange {
    rx: Vec<Rx>,
    tx: Vec<Tx>,
    /// Receive PDO of a standard identifier, `NONE` for none.
    standard: Vec<u16>,
    extended: Vec<(u32, u16)>,
    states: Vec<(u8, u32, u16)>,
    operational: [bool; 128],
    /// Values, then one quality byte a range.
    tail: Vec<u8>,
    ranges: usize,
    values: usize,
    /// Gathered outputs of the newest image.
    outputs: Vec<u8>,
    /// Those of the image that the last SYNC latched.
    latched: Vec<u8>,
    window_ns: u64,
    window_end_ns: Option<u64>,
    /// Until then PDOs of the last SYNC may come, although its sample was complete without them.
    late_until_ns: u64,
    /// With the index of the PDO in `rx`.
    queues: Vec<(usize, Queue)>,
    /// Fields are in the tail that were not published yet.
    dirty: bool,
    /// SYNCs whose sample was not published yet.
    samples_due: u64,
    /// SYNCs whose sample was.
    samples: u64,
    data_t_ns: u64,
    counters: Counters,
}

const NONE: u16 = u16::MAX;

fn get_bits(data: &[u8; PDO_BYTES], first: u16, bits: u16) -> u64 {
    let all = u64::from_le_bytes(*data);
    let shifted = all.checked_shr(u32::from(first)).unwrap_or(0);
    if bits >= 64 { shifted } else { shifted & ((1u64 << bits) - 1) }
}

fn put_bits(data: &mut [u8; PDO_BYTES], first: u16, bits: u16, value: u64) {
    let mask = if bits >= 64 { u64::MAX } else { (1u64 << bits) - 1 };
    let shift = u32::from(first);
    let mut all = u64::from_le_bytes(*data);
    all &= !mask.checked_shl(shift).unwrap_or(0);
    all |= (value & mask).checked_shl(shift).unwrap_or(0);
    *data = all.to_le_bytes();
}

fn extend(value: u64, bits: u16) -> u64 {
    if bits == 0 || bits >= 64 {
        return value;
    }
    let unused = 64 - u32::from(bits);
    (((value << unused) as i64) >> unused) as u64
}

/// SYNCs until a PDO is awaited whose node has just become operational. A node counts from where it likes, so one of type
/// n comes at the n-th SYNC or the one behind it; a node with a SYNC start value (sub-index 6 of its communication
/// parameters) first waits for that value of the counter, 240 SYNCs at most (CiA 301 V4.2, clause 7.5.2.22).
fn first_turn(transmission: u8) -> u16 {
    match transmission {
        0 | 1 => 1,
        n => u16::from(n) + 1 + u16::from(transmission::CYCLIC_MAX),
    }
}

impl Exchange {
    /// `window_ns`: time after a SYNC in which PDOs belong to it.
    pub fn new(plan: Plan, window_ns: u64) -> Self {
        let values = plan.input_bytes.iter().map(|&n| usize::from(n)).sum();
        let ranges = plan.input_bytes.len();
        let mut standard = vec![NONE; 0x800];
        let mut extended = Vec::new();
        for (i, pdo) in plan.rx.iter().enumerate() {
            match standard.get_mut(pdo.cob_id as usize) {
                Some(entry) => *entry = i as u16,
                None => extended.push((pdo.cob_id, i as u16)),
            }
        }
        extended.sort_unstable();
        let mut tail = vec![0; values + ranges];
        tail[values..].fill(Quality::NoData as u8);
        for &(_, _, range) in &plan.states {
            if let Some(quality) = tail.get_mut(values + usize::from(range)) {
                *quality = Quality::Good as u8;
            }
        }
        let queue_of = |i: usize| plan.queues.iter().position(|(of, _)| usize::from(*of) == i);
        let rx = plan.rx.into_iter().enumerate().map(|(i, pdo)| Rx {
            pdo,
            data: [0; PDO_BYTES],
            fresh: false,
            expected: false,
            bad: false,
            queue: queue_of(i).map_or(NONE, |queue| queue as u16),
            syncs_left: 1,
            known: false,
            deadline_ns: None,
            poll_at_ns: None,
        });
        let tx = plan.tx.into_iter().map(|pdo| Tx {
            pdo,
            sent: [0; PDO_BYTES],
            first: true,
            syncs_left: 1,
            inhibit_until_ns: 0,
            event_at_ns: None,
        });
        Self {
            rx: rx.collect(),
            tx: tx.collect(),
            standard,
            extended,
            states: plan.states,
            operational: [false; 128],
            tail,
            ranges,
            values,
            outputs: vec![0; plan.output_bytes],
            latched: vec![0; plan.output_bytes],
            window_ns,
            window_end_ns: None,
            late_until_ns: 0,
            queues: plan.queues.iter().map(|&(i, size)| (usize::from(i), Queue::new(size.into()))).collect(),
            dirty: false,
            samples_due: 0,
            samples: 0,
            data_t_ns: 0,
            counters: Counters::default(),
        }
    }

    /// The tail of the `inputs` message.
    pub fn tail(&self) -> &[u8] {
        &self.tail
    }
    /// Ranges in the tail.
    pub fn ranges(&self) -> u32 {
        self.ranges as u32
    }
    /// Time of the newest field data in the tail.
    pub fn data_t_ns(&self) -> u64 {
        self.data_t_ns
    }
    pub fn counters(&self) -> Counters {
        self.counters
    }
    /// What is to be published since the last call.
    pub fn take_sample(&mut self) -> Option<Sample> {
        let sync = self.samples_due > 0;
        self.samples += std::mem::take(&mut self.samples_due);
        (std::mem::take(&mut self.dirty) || sync).then_some(Sample { sync })
    }
    /// Whether the sample of a SYNC waits for [`Self::take_sample`].
    pub fn is_sample_due(&self) -> bool {
        self.samples_due > 0
    }
    /// SYNCs whose sample has been taken for publication, since the start.
    pub fn samples(&self) -> u64 {
        self.samples
    }

    /// The tail was sent, and was with its readers at this time.
    pub fn published(&mut self, t_ns: u64) {
        for (_, queue) in &mut self.queues {
            queue.sent(t_ns);
        }
    }

    /// A scan that ran a task took its inputs after this time: queues show what comes next.
    pub fn on_scan(&mut self, inputs_t_ns: u64) {
        for at in 0..self.queues.len() {
            let (i, queue) = &mut self.queues[at];
            let i = *i;
            if let Some(data) = queue.scanned(inputs_t_ns)
                && let Some(rx) = self.rx.get_mut(i)
            {
                rx.data = data;
                self.decode(i);
                self.dirty = true;
            }
        }
    }

    /// The queues, as the status shows them.
    pub fn queues(&self) -> impl Iterator<Item = QueueState> + '_ {
        self.queues.iter().filter_map(|(i, queue)| {
            let pdo = &self.rx.get(*i)?.pdo;
            Some(queue.state(pdo.node, pdo.cob_id))
        })
    }

    /// The newest outputs, gathered from one image, or the safe state.
    pub fn set_outputs(&mut self, outputs: &[u8]) {
        if outputs.len() == self.outputs.len() {
            self.outputs.copy_from_slice(outputs);
        }
    }

    /// Whether PDOs of a node count. A node that leaves makes its inputs stale.
    pub fn set_operational(&mut self, node: u8, on: bool, now_ns: u64) {
        let Some(was) = self.operational.get_mut(usize::from(node)) else { return };
        if *was == on {
            return;
        }
        *was = on;
        for tx in self.tx.iter_mut().filter(|tx| tx.pdo.node == node) {
            (tx.first, tx.syncs_left, tx.inhibit_until_ns, tx.event_at_ns) = (true, 1, 0, None);
        }
        for i in 0..self.rx.len() {
            if self.rx[i].pdo.node != node {
                continue;
            }
            let rx = &mut self.rx[i];
            (rx.fresh, rx.expected, rx.known) = (false, false, false);
            rx.syncs_left = first_turn(rx.pdo.transmission);
            rx.deadline_ns = rx.pdo.deadline_ns.filter(|_| on).map(|d| now_ns.saturating_add(d));
            rx.poll_at_ns = rx.pdo.poll_ns.filter(|_| on).map(|_| now_ns);
            if !on {
                self.spoil(i, Quality::Stale);
            }
        }
    }

    /// Shows the NMT state of a node to the program.
    pub fn show_state(&mut self, node: u8, state: u8) {
        for &(of, at, _) in &self.states {
            if of == node
                && let Some(byte) = self.tail.get_mut(at as usize)
                && *byte != state
            {
                *byte = state;
                self.dirty = true;
            }
        }
    }

    /// Makes good inputs of a PDO bad.
    fn spoil(&mut self, i: usize, quality: Quality) {
        let mut any = false;
        self.rx[i].bad = true;
        for field in &self.rx[i].pdo.fields {
            if let Some(byte) = self.tail.get_mut(self.values + usize::from(field.range))
                && *byte == Quality::Good as u8
            {
                *byte = quality as u8;
                any = true;
            }
        }
        if any {
            self.counters.stale += 1;
            self.dirty = true;
        }
    }

    /// A PDO counts that came just now: it is shown, or waits in its queue.
    fn accept(&mut self, i: usize) {
        let rx = &self.rx[i];
        if let Some((_, queue)) = self.queues.get_mut(usize::from(rx.queue))
            && !queue.push(rx.data)
        {
            // Values flow again, whichever is shown.
            for field in &rx.pdo.fields {
                if let Some(quality) = self.tail.get_mut(self.values + usize::from(field.range)) {
                    self.dirty |= *quality != Quality::Good as u8;
                    *quality = Quality::Good as u8;
                }
            }
            return;
        }
        self.decode(i);
        self.dirty = true;
    }

    /// Puts the received bytes of a PDO into the tail.
    fn decode(&mut self, i: usize) {
        let rx = &self.rx[i];
        for field in &rx.pdo.fields {
            let mut value = get_bits(&rx.data, field.pdo_bit, field.bits);
            if field.signed {
                value = extend(value, field.bits);
            }
            let (at, bytes) = (field.at as usize, usize::from(field.bytes).min(8));
            if let Some(place) = self.tail.get_mut(at..at + bytes) {
                place.copy_from_slice(&value.to_le_bytes()[..bytes]);
            }
            if !rx.bad
                && let Some(quality) = self.tail.get_mut(self.values + usize::from(field.range))
            {
                *quality = Quality::Good as u8;
            }
        }
    }

    fn find(&self, can_id: u32) -> Option<usize> {
        let id = can_id & ID_MASK;
        match self.standard.get(id as usize) {
            Some(&NONE) => None,
            Some(&i) => Some(usize::from(i)),
            None => {
                let found = self.extended.binary_search_by_key(&id, |(of, _)| *of).ok()?;
                Some(usize::from(self.extended[found].1))
            }
        }
    }

    /// Takes a data frame; true when it is a PDO of the plan. `t_ns` is when it was on the bus.
    pub fn on_frame(&mut self, t_ns: u64, frame: &CanFrame) -> bool {
        if frame.is_remote() || frame.is_error() || frame.is_fd() {
            return false;
        }
        let Some(i) = self.find(frame.can_id) else { return false };
        let payload = frame.payload();
        let rx = &mut self.rx[i];
        if !self.operational[usize::from(rx.pdo.node & 0x7F)] {
            self.counters.not_operational += 1;
            return true;
        }
        if payload.len() < usize::from(rx.pdo.length) {
            self.counters.short += 1;
            return true;
        }
        self.counters.rx_pdos += 1;
        let n = payload.len().min(PDO_BYTES);
        rx.data = [0; PDO_BYTES];
        rx.data[..n].copy_from_slice(&payload[..n]);
        rx.bad = false;
        rx.deadline_ns = rx.pdo.deadline_ns.map(|d| t_ns.saturating_add(d));
        self.data_t_ns = self.data_t_ns.max(t_ns);
        // In a queue every value counts, whenever it came.
        let queued = rx.queue != NONE;
        if queued {
            self.accept(i);
        }
        let rx = &mut self.rx[i];
        if transmission::is_synchronous(rx.pdo.transmission) {
            rx.known = true;
            if !rx.expected {
                // Which SYNCs are its turn is learned from the PDO itself.
                rx.syncs_left = rx.pdo.transmission.max(1).into();
            }
            if self.window_end_ns.is_none_or(|end_ns| t_ns > end_ns) {
                // Of the SYNC whose sample did not wait for it.
                let late = rx.pdo.transmission != 1 && t_ns <= self.late_until_ns;
                // Type 0 tells of an event that may not be lost; a cyclic one comes again.
                if (late || rx.pdo.transmission == transmission::ACYCLIC) && !queued {
                    self.accept(i);
                }
                self.counters.outside_window += u64::from(!late);
                return true;
            }
            rx.fresh = !queued;
            if std::mem::take(&mut rx.expected) && self.rx.iter().all(|rx| !rx.expected) {
                self.close_window();
            }
        } else if !queued {
            self.accept(i);
        }
        true
    }

    /// Everything of this SYNC is in, or will not come.
    fn close_window(&mut self) {
        self.window_end_ns = None;
        if self.rx.iter().any(|rx| rx.expected) {
            self.counters.incomplete_samples += 1;
        } else {
            self.counters.complete_samples += 1;
        }
        for i in 0..self.rx.len() {
            if std::mem::take(&mut self.rx[i].expected) {
                self.spoil(i, Quality::Stale);
            }
            if std::mem::take(&mut self.rx[i].fresh) {
                self.decode(i);
            }
        }
        self.samples_due += 1;
    }

    /// The master's SYNC came back from the bus: what follows belongs to it.
    pub fn on_sync(&mut self, t_ns: u64) {
        if self.window_end_ns.is_some() {
            self.close_window();
        }
        let (mut any, mut open) = (false, false);
        for rx in &mut self.rx {
            let kind = rx.pdo.transmission;
            if !transmission::is_synchronous(kind) || !self.operational[usize::from(rx.pdo.node & 0x7F)] {
                continue;
            }
            any = true;
            rx.fresh = false;
            rx.syncs_left = rx.syncs_left.saturating_sub(1);
            let turn = rx.syncs_left == 0;
            if turn {
                rx.syncs_left = kind.max(1).into();
            }
            let acyclic = kind == transmission::ACYCLIC;
            rx.expected = turn && !acyclic;
            // It may come, and belongs to the sample if it does. A queue is no part of one.
            let possible = (acyclic || !rx.known) && rx.queue == NONE;
            open |= rx.expected || possible;
        }
        self.late_until_ns = t_ns.saturating_add(self.window_ns);
        self.window_end_ns = open.then_some(self.late_until_ns);
        if !open {
            self.samples_due += 1;
            self.counters.complete_samples += u64::from(any);
        }
    }

    fn build(outputs: &[u8], pdo: &TxPdo) -> [u8; PDO_BYTES] {
        let mut data = [0; PDO_BYTES];
        for field in &pdo.fields {
            let (at, bytes) = (field.at as usize, usize::from(field.bytes).min(8));
            let mut value = [0; 8];
            if let Some(from) = outputs.get(at..at + bytes) {
                value[..bytes].copy_from_slice(from);
            }
            put_bits(&mut data, field.pdo_bit, field.bits, u64::from_le_bytes(value));
        }
        data
    }

    fn frame(can_id: u32, data: [u8; PDO_BYTES], length: u8) -> CanFrame {
        let len = length.min(PDO_BYTES as u8);
        // Only the newest value counts: one that still waits for the bus is replaced.
        let mut frame = CanFrame { can_id, len, flags: can_flag::NEWEST, ..CanFrame::default() };
        frame.data[..usize::from(len)].copy_from_slice(&data[..usize::from(len)]);
        frame
    }

    /// The PDOs that follow the SYNC just sent, from the image that is the newest now.
    pub fn sync_pdos(&mut self, now_ns: u64, out: &mut Outbox) {
        self.latched.copy_from_slice(&self.outputs);
        for tx in &mut self.tx {
            if !transmission::is_synchronous(tx.pdo.transmission)
                || !self.operational[usize::from(tx.pdo.node & 0x7F)]
            {
                continue;
            }
            tx.syncs_left = tx.syncs_left.saturating_sub(1);
            let turn = tx.syncs_left == 0;
            if turn {
                tx.syncs_left = tx.pdo.transmission.max(1);
            }
            let data = Self::build(&self.latched, &tx.pdo);
            let acyclic = tx.pdo.transmission == transmission::ACYCLIC;
            // What finds no room is not sent: an acyclic one goes behind the next SYNC, a cyclic one comes again.
            if !turn || (acyclic && !tx.first && data == tx.sent) || out.is_full() {
                continue;
            }
            (tx.sent, tx.first, tx.inhibit_until_ns) = (data, false, now_ns);
            self.counters.tx_pdos += 1;
            out.push(Self::frame(tx.pdo.cob_id, data, tx.pdo.length));
        }
        for rx in &mut self.rx {
            if rx.pdo.transmission == transmission::SYNC_RTR
                && self.operational[usize::from(rx.pdo.node & 0x7F)]
            {
                rx.poll_at_ns = Some(now_ns);
            }
        }
    }

    /// Sends what is due, closes a window that is over, finds what is stale.
    pub fn on_time(&mut self, now_ns: u64, out: &mut Outbox) {
        if self.window_end_ns.is_some_and(|end_ns| now_ns >= end_ns) {
            self.close_window();
        }
        for tx in &mut self.tx {
            let pdo = &tx.pdo;
            if transmission::is_synchronous(pdo.transmission)
                || !self.operational[usize::from(pdo.node & 0x7F)]
            {
                continue;
            }
            let data = Self::build(&self.outputs, pdo);
            let due = tx.event_at_ns.is_some_and(|at_ns| now_ns >= at_ns);
            // What finds no room stays due, and the caller is asked to come again at once.
            if (!tx.first && data == tx.sent && !due) || now_ns < tx.inhibit_until_ns || out.is_full() {
                continue;
            }
            (tx.sent, tx.first) = (data, false);
            tx.inhibit_until_ns = now_ns.saturating_add(pdo.inhibit_ns);
            tx.event_at_ns = pdo.event_ns.map(|every_ns| now_ns.saturating_add(every_ns));
            self.counters.tx_pdos += 1;
            out.push(Self::frame(pdo.cob_id, data, pdo.length));
        }
        for i in 0..self.rx.len() {
            let rx = &mut self.rx[i];
            if rx.deadline_ns.is_some_and(|at_ns| now_ns >= at_ns) {
                rx.deadline_ns = None;
                self.spoil(i, Quality::Stale);
            }
            let rx = &mut self.rx[i];
            if rx.poll_at_ns.is_some_and(|at_ns| now_ns >= at_ns) {
                rx.poll_at_ns = rx.pdo.poll_ns.map(|every_ns| now_ns.saturating_add(every_ns));
                let can_id = rx.pdo.cob_id | id_flag::RTR;
                out.push(CanFrame { can_id, len: rx.pdo.length, ..CanFrame::default() });
            }
        }
    }

    /// When [`Self::on_time`] has something to do next, if nothing else happens.
    pub fn next_deadline(&self) -> Option<u64> {
        let rx = self.rx.iter().flat_map(|rx| [rx.deadline_ns, rx.poll_at_ns]).flatten();
        let tx = self.tx.iter().filter(|tx| self.operational[usize::from(tx.pdo.node & 0x7F)]);
        let tx = tx.filter(|tx| !transmission::is_synchronous(tx.pdo.transmission)).filter_map(|tx| {
            let changed = tx.first || Self::build(&self.outputs, &tx.pdo) != tx.sent;
            let wait = changed.then_some(tx.inhibit_until_ns);
            wait.into_iter().chain(tx.event_at_ns.map(|at_ns| at_ns.max(tx.inhibit_until_ns))).min()
        });
        rx.chain(tx).chain(self.window_end_ns).min()
    }
}

#[cfg(test)]
#[path = "exchange_tests.rs"]
mod tests;
