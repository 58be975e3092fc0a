//! Transmissions in virtual time.

use super::sender::*;
use super::timing::Timing;
use ipc_types::payload::{CHUNK_BYTES, serial_flag};
use proptest::prelude::*;

const MS: u64 = 1_000_000;

fn settings() -> Settings {
    let timing = Timing::new(9600, 10);
    Settings {
        timing,
        half_duplex: true,
        silence_ns: timing.t35_ns,
        reply_delay_ns: 0,
        turnaround_ns: 0,
        give_up_ns: 1000 * MS,
        rts: None,
        timed: true,
        paced: false,
    }
}

fn head(deadline_ns: u64) -> Head {
    Head { seq: 7, writer: 3, generation: 1, deadline_ns, flags: 0 }
}

/// Runs a transmission through a port that takes `room` bytes a time and says what was written when.
struct Port {
    now: u64,
    written: Vec<(u64, usize)>,
    rts: Vec<(u64, bool)>,
    room: usize,
    probes_until_empty: u32,
}

impl Port {
    fn new(now: u64) -> Self {
        Self { now, written: Vec::new(), rts: Vec::new(), room: usize::MAX, probes_until_empty: 0 }
    }
    fn run(&mut self, sender: &mut Sender, heard: Option<u64>) -> Outcome {
        for _ in 0..100_000 {
            match sender.step(self.now, heard, false) {
                Step::Idle => panic!("ended without an outcome"),
                Step::Wait(t) => {
                    assert!(t > self.now, "a wait that is over");
                    self.now = t;
                }
                Step::Rts(on) => self.rts.push((self.now, on)),
                Step::Write(from, to) => {
                    assert!(from < to);
                    let n = (to - from).min(self.room);
                    if n > 0 {
                        self.written.push((self.now, n));
                    }
                    sender.wrote(n, self.now);
                }
                Step::Probe => {
                    let empty = self.probes_until_empty == 0;
                    self.probes_until_empty = self.probes_until_empty.saturating_sub(1);
                    sender.drained(empty, self.now);
                }
                Step::Done(outcome) => return outcome,
            }
        }
        panic!("never ends");
    }
}

#[test]
fn it_waits_for_silence_and_knows_the_end() {
    let t = settings().timing;
    let mut sender = Sender::new(settings());
    assert!(sender.load(head(0), &[1; 10], 100 * MS));
    assert!(!sender.load(head(0), &[1; 10], 100 * MS), "one at a time");
    let mut port = Port::new(100 * MS);
    let heard = 99 * MS;
    let outcome = port.run(&mut sender, Some(heard));
    assert_eq!(outcome.first_ns, heard + t.t35_ns);
    assert_eq!(outcome.end_ns, outcome.first_ns + 10 * t.char_ns);
    assert_eq!(outcome.not_sent, None);
    // The next one keeps its distance from the own end too.
    sender.load(head(0), &[2; 3], outcome.end_ns);
    let next = port.run(&mut sender, Some(heard));
    assert_eq!(next.first_ns, outcome.end_ns + t.t35_ns);
    assert_eq!(sender.counters(), SendCounters { bytes: 13, frames: 2, ..SendCounters::default() });
}

#[test]
fn delays() {
    let mut s = settings();
    s.reply_delay_ns = 20 * MS;
    s.turnaround_ns = 200 * MS;
    let mut sender = Sender::new(s);
    let mut port = Port::new(100 * MS);
    sender.load(head(0), &[1], port.now);
    let first = port.run(&mut sender, Some(100 * MS));
    assert_eq!(first.first_ns, 120 * MS);
    sender.load(head(0), &[1], port.now);
    assert_eq!(port.run(&mut sender, Some(100 * MS)).first_ns, first.end_ns + 200 * MS);
    // AT_ONCE waits for nothing.
    sender.load(Head { flags: serial_flag::AT_ONCE, ..head(0) }, &[1], port.now);
    let now = port.now;
    assert_eq!(port.run(&mut sender, Some(now)).first_ns, now);
    // Full duplex waits for its delays only.
    s.half_duplex = false;
    s.reply_delay_ns = 0;
    let mut sender = Sender::new(s);
    sender.load(head(0), &[1], 50 * MS);
    assert!(matches!(sender.step(50 * MS, Some(50 * MS), true), Step::Write(0, 1)));
}

#[test]
fn a_busy_line_ends_by_deadline_or_patience() {
    let mut sender = Sender::new(settings());
    sender.load(head(150 * MS), &[1], 100 * MS);
    assert_eq!(sender.step(100 * MS, Some(100 * MS), true), Step::Wait(150 * MS + 1));
    let done = sender.step(150 * MS + 1, Some(100 * MS), true);
    assert!(matches!(done, Step::Done(Outcome { not_sent: Some(NotSent::Deadline), .. })), "{done:?}");
    sender.load(head(0), &[1], 200 * MS);
    assert_eq!(sender.step(200 * MS, Some(200 * MS), true), Step::Wait(1200 * MS));
    let done = sender.step(1200 * MS, Some(1199 * MS), true);
    assert!(matches!(done, Step::Done(Outcome { not_sent: Some(NotSent::LineBusy), .. })), "{done:?}");
    assert!(sender.is_idle());
    assert_eq!(sender.counters().line_busy, 1);
}

#[test]
fn rts_leads_and_trails() {
    let mut s = settings();
    s.rts = Some((MS, 2 * MS));
    let mut sender = Sender::new(s);
    let mut port = Port::new(100 * MS);
    port.probes_until_empty = 3;
    sender.load(head(0), &[1; 4], port.now);
    let outcome = port.run(&mut sender, None);
    assert_eq!(outcome.first_ns, 101 * MS);
    assert!(outcome.end_ns >= outcome.first_ns + 4 * s.timing.char_ns);
    assert_eq!(port.rts, [(100 * MS, true), (outcome.end_ns + 2 * MS, false)]);
}

#[test]
fn a_port_that_takes_nothing_is_given_up_and_rts_falls() {
    let mut s = settings();
    s.rts = Some((0, 0));
    let mut sender = Sender::new(s);
    let mut port = Port::new(100 * MS);
    port.room = 0;
    sender.load(head(0), &[1; 4], port.now);
    let outcome = port.run(&mut sender, None);
    assert_eq!(outcome.not_sent, Some(NotSent::Blocked));
    assert_eq!(port.rts.last().map(|r| r.1), Some(false));
    assert_eq!(sender.counters().blocked, 1);
    // The port goes while sending.
    sender.load(head(0), &[1; 4], port.now);
    sender.port_gone(port.now);
    let done = sender.step(port.now, None, false);
    assert!(matches!(done, Step::Done(Outcome { not_sent: Some(NotSent::PortGone), .. })));
}

#[test]
fn a_paced_terminal_gets_bytes_at_the_line_s_rate() {
    let mut s = settings();
    s.paced = true;
    let mut sender = Sender::new(s);
    let mut port = Port::new(100 * MS);
    sender.load(head(0), &[1; 50], port.now);
    let outcome = port.run(&mut sender, None);
    assert_eq!(outcome.end_ns, 100 * MS + 50 * s.timing.char_ns);
    let mut count = 0;
    for (t, n) in &port.written {
        count += n;
        assert!(*t >= 100 * MS + count as u64 * s.timing.char_ns);
    }
    assert_eq!((count, port.written.last().unwrap().0), (50, outcome.end_ns));
}

#[test]
fn a_long_frame_is_not_torn() {
    let mut sender = Sender::new(settings());
    let mut port = Port::new(100 * MS);
    sender.load(head(0), &[1; CHUNK_BYTES], port.now);
    let first = port.run(&mut sender, None);
    sender.load(Head { flags: serial_flag::END, ..head(0) }, &[1; 10], port.now);
    assert_eq!(port.run(&mut sender, None).first_ns, first.end_ns);
    sender.load(head(0), &[1; 10], port.now);
    assert!(port.run(&mut sender, None).first_ns > first.end_ns);
    assert!(!sender.load(head(0), &[], port.now) && !sender.load(head(0), &[0; CHUNK_BYTES + 1], port.now));
}

proptest! {
    #[test]
    fn every_transmission_ends(n in 1usize..CHUNK_BYTES, room in 1usize..300, paced in any::<bool>(),
                               rts in prop::option::of((0..3 * MS, 0..3 * MS)), probes in 0u32..20,
                               deadline in prop_oneof![Just(0), 100 * MS..110 * MS], heard in 90 * MS..120 * MS) {
        let mut sender = Sender::new(Settings { rts, paced, ..settings() });
        let mut port = Port::new(100 * MS);
        port.room = room;
        port.probes_until_empty = probes;
        sender.load(head(deadline), &vec![5; n], port.now);
        let outcome = port.run(&mut sender, Some(heard));
        prop_assert!(sender.is_idle());
        let written: usize = port.written.iter().map(|w| w.1).sum();
        prop_assert_eq!(written, if outcome.not_sent.is_none() { n } else { 0 });
        prop_assert_eq!(port.rts.iter().filter(|r| r.1).count(), port.rts.iter().filter(|r| !r.1).count());
    }
}
