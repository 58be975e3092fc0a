use super::*;
use proptest::prelude::*;

const MS: u64 = 1_000_000;

fn field(pdo_bit: u16, bits: u16, at: u32, bytes: u8, range: u16) -> Field {
    Field { pdo_bit, bits, at, bytes, signed: false, range }
}

fn rx(cob_id: u32, node: u8, transmission: u8, fields: Vec<Field>) -> RxPdo {
    let bits = fields.iter().map(|f| f.pdo_bit + f.bits).max().unwrap_or(0);
    RxPdo {
        cob_id,
        node,
        length: bits.div_ceil(8) as u8,
        transmission,
        deadline_ns: None,
        poll_ns: None,
        fields,
    }
}

fn tx(cob_id: u32, node: u8, transmission: u8, fields: Vec<Field>) -> TxPdo {
    let bits = fields.iter().map(|f| f.pdo_bit + f.bits).max().unwrap_or(0);
    TxPdo {
        cob_id,
        node,
        length: bits.div_ceil(8) as u8,
        transmission,
        inhibit_ns: 0,
        event_ns: None,
        fields,
    }
}

fn frames(out: &mut Outbox) -> Vec<(u32, Vec<u8>)> {
    out.drain().map(|f| (f.can_id, f.payload().to_vec())).collect()
}

#[test]
fn an_event_driven_pdo_is_published_at_once() {
    let plan = Plan {
        rx: vec![rx(0x185, 5, 255, vec![field(0, 8, 0, 1, 0), field(8, 16, 1, 2, 1)])],
        input_bytes: vec![1, 2],
        ..Plan::default()
    };
    let mut exchange = Exchange::new(plan, 0);
    assert_eq!(exchange.tail(), [0, 0, 0, 2, 2]);
    let frame = CanFrame::classic(0x185, &[7, 0x34, 0x12]);
    assert!(exchange.on_frame(1, &frame));
    assert_eq!((exchange.take_sample(), exchange.counters().not_operational), (None, 1));
    exchange.set_operational(5, true, 1);
    assert!(exchange.on_frame(2, &frame));
    assert_eq!(exchange.take_sample(), Some(Sample { sync: false }));
    assert_eq!(exchange.tail(), [7, 0x34, 0x12, 0, 0]);
    // Too short, unknown, remote, error: nothing changes.
    assert!(exchange.on_frame(3, &CanFrame::classic(0x185, &[9, 9])));
    assert!(!exchange.on_frame(3, &CanFrame::classic(0x186, &[9, 9, 9])));
    assert!(!exchange.on_frame(3, &CanFrame { can_id: 0x185 | id_flag::RTR, ..frame }));
    assert_eq!((exchange.take_sample(), exchange.counters().short), (None, 1));
    exchange.set_operational(5, false, 4);
    assert_eq!(exchange.take_sample(), Some(Sample { sync: false }));
    assert_eq!(exchange.tail(), [7, 0x34, 0x12, 1, 1]);
}

#[test]
fn a_sample_never_mixes_two_syncs() {
    let pdos = (0..4u32).map(|i| rx(0x181 + i, i as u8 + 1, 1, vec![field(0, 8, i, 1, i as u16)])).collect();
    let plan = Plan { rx: pdos, input_bytes: vec![1; 4], ..Plan::default() };
    let mut exchange = Exchange::new(plan, 5 * MS);
    let mut out = Outbox::default();
    for node in 1..=4 {
        exchange.set_operational(node, true, 0);
    }
    exchange.on_sync(10 * MS);
    for i in 0..3 {
        exchange.on_frame(10 * MS + 1, &CanFrame::classic(0x181 + i, &[1]));
        assert_eq!(exchange.take_sample(), None);
    }
    exchange.on_frame(10 * MS + 2, &CanFrame::classic(0x184, &[1]));
    assert_eq!(exchange.take_sample(), Some(Sample { sync: true }));
    assert_eq!(exchange.tail(), [1, 1, 1, 1, 0, 0, 0, 0]);
    // The third node is silent: at the end of the window its input is stale, the others are of this SYNC.
    exchange.on_sync(20 * MS);
    for id in [0x181, 0x182, 0x184] {
        exchange.on_frame(20 * MS + 1, &CanFrame::classic(id, &[2]));
    }
    assert_eq!(exchange.take_sample(), None);
    assert_eq!(exchange.next_deadline(), Some(25 * MS));
    exchange.on_time(25 * MS, &mut out);
    assert_eq!(exchange.take_sample(), Some(Sample { sync: true }));
    assert_eq!(exchange.tail(), [2, 2, 1, 2, 0, 0, 1, 0]);
    // What comes behind the window is of no SYNC.
    exchange.on_frame(26 * MS, &CanFrame::classic(0x183, &[2]));
    assert_eq!((exchange.take_sample(), exchange.counters().outside_window), (None, 1));
    assert_eq!((exchange.counters().complete_samples, exchange.counters().incomplete_samples), (1, 1));
}

#[test]
fn synchronous_pdos_come_from_one_image_in_their_turn() {
    let plan = Plan {
        tx: vec![
            tx(0x201, 1, 1, vec![field(0, 8, 0, 1, 0)]),
            tx(0x202, 2, 2, vec![field(0, 8, 0, 1, 0)]),
            tx(0x203, 3, 0, vec![field(4, 4, 0, 1, 0)]),
        ],
        output_bytes: 1,
        ..Plan::default()
    };
    let mut exchange = Exchange::new(plan, 0);
    let mut out = Outbox::default();
    for node in 1..=3 {
        exchange.set_operational(node, true, 0);
    }
    exchange.set_outputs(&[5]);
    exchange.on_time(0, &mut out);
    assert!(out.is_empty());
    exchange.sync_pdos(1, &mut out);
    let (a, b, c) = ((0x201, vec![5]), (0x202, vec![5]), (0x203, vec![0x50]));
    assert_eq!(frames(&mut out), [a.clone(), b.clone(), c]);
    exchange.sync_pdos(2, &mut out);
    assert_eq!(frames(&mut out), [a]);
    exchange.set_outputs(&[6]);
    exchange.sync_pdos(3, &mut out);
    assert_eq!(frames(&mut out), [(0x201, vec![6]), (0x202, vec![6]), (0x203, vec![0x60])]);
}

#[test]
fn an_event_driven_output_is_inhibited_and_repeated() {
    let pdo = TxPdo { inhibit_ns: 10, event_ns: Some(100), ..tx(0x201, 1, 255, vec![field(0, 8, 0, 1, 0)]) };
    let mut exchange = Exchange::new(Plan { tx: vec![pdo], output_bytes: 1, ..Plan::default() }, 0);
    let mut out = Outbox::default();
    assert_eq!(exchange.next_deadline(), None);
    exchange.set_operational(1, true, 0);
    exchange.set_outputs(&[1]);
    exchange.on_time(0, &mut out);
    exchange.set_outputs(&[2]);
    exchange.on_time(5, &mut out);
    assert_eq!(frames(&mut out), [(0x201, vec![1])]);
    assert_eq!(exchange.next_deadline(), Some(10));
    exchange.on_time(10, &mut out);
    assert_eq!(frames(&mut out), [(0x201, vec![2])]);
    assert_eq!(exchange.next_deadline(), Some(110));
    exchange.on_time(110, &mut out);
    assert_eq!(frames(&mut out), [(0x201, vec![2])]);
}

#[test]
fn a_pdo_by_remote_frame_is_asked_for() {
    let pdo =
        RxPdo { poll_ns: Some(50), deadline_ns: Some(80), ..rx(0x185, 5, 253, vec![field(0, 8, 0, 1, 0)]) };
    let mut exchange = Exchange::new(Plan { rx: vec![pdo], input_bytes: vec![1], ..Plan::default() }, 0);
    let mut out = Outbox::default();
    exchange.set_operational(5, true, 0);
    exchange.on_time(0, &mut out);
    assert_eq!(out.drain().map(|f| f.can_id).collect::<Vec<_>>(), [0x185 | id_flag::RTR]);
    exchange.on_frame(1, &CanFrame::classic(0x185, &[3]));
    assert_eq!(exchange.take_sample(), Some(Sample { sync: false }));
    exchange.on_time(50, &mut out);
    assert_eq!(out.drain().count(), 1);
    exchange.on_time(81, &mut out);
    assert_eq!(exchange.tail(), [3, 1]);
}

#[test]
fn a_short_signed_value_is_extended() {
    let wide = Field { signed: true, ..field(4, 24, 0, 4, 0) };
    let plan = Plan { rx: vec![rx(0x185, 5, 255, vec![wide])], input_bytes: vec![4], ..Plan::default() };
    let mut exchange = Exchange::new(plan, 0);
    exchange.set_operational(5, true, 0);
    exchange.on_frame(1, &CanFrame::classic(0x185, &[0xEF, 0xFF, 0xFF, 0x0F]));
    assert_eq!(&exchange.tail()[..4], (-2i32).to_le_bytes());
}

/// A PDO of one counting byte of node 5, event-driven, with a queue.
fn queued(size: u8) -> Exchange {
    let plan = Plan {
        rx: vec![
            rx(0x185, 5, 255, vec![field(0, 8, 0, 1, 0)]),
            rx(0x285, 5, 255, vec![field(0, 8, 1, 1, 1)]),
        ],
        input_bytes: vec![1, 1],
        queues: vec![(0, size)],
        ..Plan::default()
    };
    let mut exchange = Exchange::new(plan, 0);
    exchange.set_operational(5, true, 0);
    exchange
}

/// Publishes what is new.
fn publish(exchange: &mut Exchange, now_ns: u64) -> Option<Sample> {
    let sample = exchange.take_sample()?;
    exchange.published(now_ns);
    Some(sample)
}

fn waiting(exchange: &Exchange) -> (usize, usize, u64) {
    let state = exchange.queues().next().unwrap();
    (state.waiting, state.most, state.dropped)
}

#[test]
fn every_value_of_a_queue_reaches_one_scan_in_order() {
    let mut exchange = queued(64);
    for n in 1..=50 {
        exchange.on_frame(1, &CanFrame::classic(0x185, &[n]));
        exchange.on_frame(1, &CanFrame::classic(0x285, &[n]));
    }
    let mut seen = Vec::new();
    for t_ns in (10..).step_by(10) {
        let published = publish(&mut exchange, t_ns);
        if seen.len() == 50 {
            assert_eq!(published, None);
            break;
        }
        assert_eq!(published, Some(Sample { sync: false }), "at {t_ns}");
        seen.push(exchange.tail()[0]);
        // Without a queue only the last is sure.
        assert_eq!(exchange.tail()[1..], [50, 0, 0]);
        // A scan that looked before it was sent, and the same one again: it stays.
        exchange.on_scan(t_ns - 1);
        exchange.on_scan(t_ns);
        assert_eq!(exchange.take_sample(), None);
        exchange.on_scan(t_ns + 1);
    }
    assert_eq!(seen, (1..=50).collect::<Vec<u8>>());
    assert_eq!(waiting(&exchange), (0, 49, 0));
    // What comes later is shown at once again.
    exchange.on_frame(1000, &CanFrame::classic(0x185, &[51]));
    assert_eq!((publish(&mut exchange, 1001).is_some(), exchange.tail()[0]), (true, 51));
}

#[test]
fn a_value_that_was_not_sent_is_not_taken() {
    let mut exchange = queued(4);
    exchange.on_frame(1, &CanFrame::classic(0x185, &[1]));
    exchange.on_frame(2, &CanFrame::classic(0x185, &[2]));
    assert!(exchange.take_sample().is_some());
    // Sending failed: a scan cannot have seen it.
    exchange.on_scan(100);
    assert_eq!((exchange.take_sample(), exchange.tail()[0]), (None, 1));
    exchange.published(200);
    exchange.on_scan(150);
    assert_eq!(exchange.tail()[0], 1);
    // A repetition changes nothing about when it was there first.
    exchange.published(300);
    exchange.on_scan(250);
    assert_eq!((exchange.take_sample().is_some(), exchange.tail()[0]), (true, 2));
}

#[test]
fn a_full_queue_drops_the_oldest_that_waits_and_counts_it() {
    let mut exchange = queued(4);
    for n in 1..=10 {
        exchange.on_frame(n.into(), &CanFrame::classic(0x185, &[n]));
        // No plc runs: nothing is ever taken, however often it is published.
        publish(&mut exchange, n.into());
        assert_eq!(exchange.tail()[0], 1);
    }
    assert_eq!(waiting(&exchange), (4, 4, 5));
    let mut seen = Vec::new();
    for t_ns in [100, 200, 300, 400, 500, 600] {
        seen.push(exchange.tail()[0]);
        exchange.on_scan(t_ns);
        publish(&mut exchange, t_ns + 1);
    }
    assert_eq!(seen, [1, 7, 8, 9, 10, 10]);
    assert_eq!(waiting(&exchange), (0, 4, 5));
}

#[test]
fn another_generation_of_the_plc_goes_on_where_the_last_one_was() {
    let mut exchange = queued(8);
    for n in 1..=3 {
        exchange.on_frame(1, &CanFrame::classic(0x185, &[n]));
    }
    publish(&mut exchange, 10);
    exchange.on_scan(11);
    publish(&mut exchange, 12);
    // It died; the next one has not run a task yet and says so.
    exchange.on_scan(0);
    assert_eq!((exchange.take_sample(), exchange.tail()[0]), (None, 2));
    exchange.on_scan(50);
    assert_eq!((publish(&mut exchange, 51).is_some(), exchange.tail()[0]), (true, 3));
}

#[test]
fn values_of_a_lost_node_still_come_but_are_bad() {
    let mut exchange = queued(8);
    for n in 1..=3 {
        exchange.on_frame(1, &CanFrame::classic(0x185, &[n]));
    }
    publish(&mut exchange, 10);
    exchange.set_operational(5, false, 20);
    assert!(publish(&mut exchange, 21).is_some());
    assert_eq!(exchange.tail(), [1, 0, 1, 2]);
    exchange.on_scan(30);
    publish(&mut exchange, 31);
    assert_eq!(exchange.tail(), [2, 0, 1, 2]);
    // Good again with its first frame, which waits behind the others.
    exchange.set_operational(5, true, 40);
    exchange.on_frame(41, &CanFrame::classic(0x185, &[4]));
    assert!(publish(&mut exchange, 42).is_some());
    assert_eq!(exchange.tail(), [2, 0, 0, 2]);
    exchange.on_scan(50);
    publish(&mut exchange, 51);
    exchange.on_scan(52);
    assert_eq!(exchange.tail(), [4, 0, 0, 2]);
}

#[test]
fn a_queue_is_no_part_of_the_sample_of_a_sync_and_does_not_delay_it() {
    let plan = Plan {
        rx: vec![rx(0x181, 1, 1, vec![field(0, 8, 0, 1, 0)]), rx(0x182, 2, 1, vec![field(0, 8, 1, 1, 1)])],
        input_bytes: vec![1, 1],
        queues: vec![(1, 8)],
        ..Plan::default()
    };
    let mut exchange = Exchange::new(plan, 5 * MS);
    exchange.set_operational(1, true, 0);
    exchange.set_operational(2, true, 0);
    for sync in 1..=3u8 {
        let t_ns = u64::from(sync) * 10 * MS;
        exchange.on_sync(t_ns);
        exchange.on_frame(t_ns + 1, &CanFrame::classic(0x182, &[sync]));
        assert_eq!(publish(&mut exchange, t_ns + 2).is_some(), sync == 1);
        exchange.on_frame(t_ns + 3, &CanFrame::classic(0x181, &[sync]));
        assert_eq!(publish(&mut exchange, t_ns + 4), Some(Sample { sync: true }));
        // The queue still shows the first: no scan took it.
        assert_eq!(exchange.tail(), [sync, 1, 0, 0]);
        assert_eq!(exchange.samples(), u64::from(sync));
    }
    exchange.on_scan(99 * MS);
    assert_eq!((publish(&mut exchange, 100 * MS), exchange.tail()[1]), (Some(Sample { sync: false }), 2));
    assert_eq!((exchange.samples(), exchange.counters().complete_samples), (3, 3));
}

#[test]
fn every_sync_counts_once_even_when_two_are_published_together() {
    let plan = Plan {
        rx: vec![rx(0x181, 1, 1, vec![field(0, 8, 0, 1, 0)])],
        input_bytes: vec![1],
        ..Plan::default()
    };
    let mut exchange = Exchange::new(plan, 5 * MS);
    // No node is there: the sample is due at once.
    exchange.on_sync(10 * MS);
    assert!(exchange.is_sample_due());
    assert_eq!((exchange.take_sample(), exchange.samples()), (Some(Sample { sync: true }), 1));
    exchange.set_operational(1, true, 11 * MS);
    exchange.on_sync(20 * MS);
    assert!(!exchange.is_sample_due());
    exchange.on_frame(20 * MS + 1, &CanFrame::classic(0x181, &[1]));
    exchange.on_sync(30 * MS);
    // The window of the second ends without its PDO.
    exchange.on_time(36 * MS, &mut Outbox::default());
    assert_eq!((exchange.take_sample(), exchange.samples()), (Some(Sample { sync: true }), 3));
    assert_eq!((exchange.take_sample(), exchange.samples()), (None, 3));
}

/// Which of three SYNCs a node takes for its third is its own affair: it is learned from its PDOs.
#[test]
fn a_node_counts_syncs_from_where_it_likes() {
    for phase in 0..3u8 {
        let plan = Plan {
            rx: vec![
                rx(0x182, 2, 1, vec![field(0, 8, 0, 1, 0)]),
                rx(0x183, 3, 3, vec![field(0, 8, 1, 1, 1)]),
            ],
            input_bytes: vec![1, 1],
            ..Plan::default()
        };
        let mut exchange = Exchange::new(plan, 10 * MS);
        for node in [2, 3] {
            exchange.set_operational(node, true, 0);
        }
        for sync in 0..30u8 {
            let t_ns = u64::from(sync) * 10 * MS;
            exchange.on_sync(t_ns);
            // The node whose PDO comes at every SYNC is the first.
            exchange.on_frame(t_ns + MS, &CanFrame::classic(0x182, &[sync]));
            if sync % 3 == phase {
                exchange.on_frame(t_ns + 2 * MS, &CanFrame::classic(0x183, &[sync]));
            }
            if sync >= 6 {
                let third = sync - (sync + 3 - phase) % 3;
                assert_eq!(exchange.tail(), [sync, third, 0, 0], "phase {phase}, SYNC {sync}");
            }
        }
        let counters = exchange.counters();
        assert!(counters.stale == 0 && counters.incomplete_samples == 0, "phase {phase}: {counters:?}");
    }
}

/// A PDO of type 3 and one of type 1 that is always in first.
fn by_threes() -> Exchange {
    let plan = Plan {
        rx: vec![rx(0x182, 2, 1, vec![field(0, 8, 0, 1, 0)]), rx(0x183, 3, 3, vec![field(0, 8, 1, 1, 1)])],
        input_bytes: vec![1, 1],
        ..Plan::default()
    };
    let mut exchange = Exchange::new(plan, 5 * MS);
    exchange.set_operational(2, true, 0);
    exchange.set_operational(3, true, 0);
    exchange
}

/// A SYNC with the PDO of type 1, and the other one if it comes; then the end of the window.
fn turn(exchange: &mut Exchange, sync: u8, comes: bool) {
    let t_ns = u64::from(sync) * 10 * MS;
    exchange.on_sync(t_ns);
    exchange.on_frame(t_ns + 1, &CanFrame::classic(0x182, &[sync]));
    if comes {
        exchange.on_frame(t_ns + 2, &CanFrame::classic(0x183, &[sync]));
    }
    exchange.on_time(t_ns + 5 * MS, &mut Outbox::default());
    assert!(exchange.take_sample().unwrap().sync);
}

#[test]
fn a_turn_that_is_missed_is_stale_once_and_turns_are_learned_again() {
    let mut exchange = by_threes();
    let told = |exchange: &Exchange| (exchange.counters().stale, exchange.counters().incomplete_samples);
    for sync in 0..=3 {
        turn(&mut exchange, sync, sync % 3 == 0);
    }
    assert_eq!((exchange.tail(), told(&exchange)), (&[3, 3, 0, 0][..], (0, 0)));
    // One is lost, the next comes in its turn.
    for sync in 4..=8 {
        turn(&mut exchange, sync, false);
        assert_eq!(exchange.tail(), [sync, 3, 0, u8::from(sync >= 6)]);
    }
    turn(&mut exchange, 9, true);
    assert_eq!((exchange.tail(), told(&exchange)), (&[9, 9, 0, 0][..], (1, 1)));
    // The node missed a SYNC: late by one for once, then again at every third.
    for sync in 10..=30 {
        turn(&mut exchange, sync, sync % 3 == 1 && sync > 10);
    }
    assert_eq!((exchange.tail(), told(&exchange)), (&[30, 28, 0, 0][..], (2, 2)));
    // It starts anew, and counts from elsewhere.
    exchange.set_operational(3, false, 305 * MS);
    exchange.set_operational(3, true, 306 * MS);
    for sync in 31..=50 {
        turn(&mut exchange, sync, sync % 3 == 0 && sync > 35);
    }
    assert_eq!((exchange.tail(), told(&exchange)), (&[50, 48, 0, 0][..], (3, 2)));
    assert_eq!(exchange.counters().outside_window, 0);
    assert_eq!(exchange.samples(), 51);
}

/// It may wait for its start value of the SYNC counter, a whole turn of that; but not for ever.
#[test]
fn a_pdo_that_never_comes_is_missed_at_last() {
    let mut exchange = by_threes();
    for sync in 0..=254 {
        turn(&mut exchange, sync, false);
        let missed = (u64::from(sync) + 1).saturating_sub(241) / 3;
        assert_eq!(exchange.counters().incomplete_samples, missed, "SYNC {sync}");
    }
    assert_eq!(exchange.tail(), [254, 0, 0, Quality::NoData as u8]);
}

/// Type 0 comes with a change: it is collected when it comes, and nothing is missing when it does not.
#[test]
fn a_pdo_that_comes_with_a_change_is_never_missing() {
    let acyclic = |cob_id, node, at: u32| rx(cob_id, node, 0, vec![field(0, 8, at, 1, at as u16)]);
    let plan = Plan {
        rx: vec![acyclic(0x181, 1, 0), acyclic(0x182, 2, 1), rx(0x183, 3, 1, vec![field(0, 8, 2, 1, 2)])],
        input_bytes: vec![1, 1, 1],
        ..Plan::default()
    };
    let mut exchange = Exchange::new(plan, 5 * MS);
    let mut out = Outbox::default();
    exchange.set_operational(1, true, 0);
    exchange.set_operational(2, true, 0);
    // Nothing changed.
    exchange.on_sync(10 * MS);
    exchange.on_time(15 * MS, &mut out);
    assert_eq!(exchange.take_sample(), Some(Sample { sync: true }));
    // Both changed: one sample.
    exchange.on_sync(20 * MS);
    for id in [0x181, 0x182] {
        exchange.on_frame(20 * MS + 1, &CanFrame::classic(id, &[2]));
        assert_eq!(exchange.take_sample(), None);
    }
    exchange.on_sync(30 * MS);
    assert_eq!(
        (exchange.take_sample(), exchange.tail()),
        (Some(Sample { sync: true }), &[2, 2, 0, 0, 0, 2][..])
    );
    exchange.on_time(35 * MS, &mut out);
    assert_eq!(exchange.take_sample(), Some(Sample { sync: true }));
    // The sample does not wait for them when all is in that was due; what comes then is shown at once.
    exchange.set_operational(3, true, 36 * MS);
    exchange.on_sync(40 * MS);
    exchange.on_frame(40 * MS + 1, &CanFrame::classic(0x183, &[4]));
    assert_eq!(exchange.take_sample(), Some(Sample { sync: true }));
    exchange.on_frame(40 * MS + 2, &CanFrame::classic(0x181, &[4]));
    assert_eq!(
        (exchange.take_sample(), exchange.tail()),
        (Some(Sample { sync: false }), &[4, 2, 4, 0, 0, 0][..])
    );
    let counters = exchange.counters();
    assert_eq!((counters.complete_samples, counters.incomplete_samples), (4, 0));
    assert_eq!((counters.outside_window, counters.stale), (0, 0));
    // Without the one that is due it is incomplete.
    exchange.on_sync(50 * MS);
    exchange.on_frame(50 * MS + 1, &CanFrame::classic(0x181, &[5]));
    exchange.on_time(55 * MS, &mut out);
    assert_eq!(exchange.counters().incomplete_samples, 1);
    // Behind the window: shown all the same, and counted.
    exchange.on_frame(56 * MS, &CanFrame::classic(0x182, &[5]));
    assert_eq!((exchange.tail(), exchange.counters().outside_window), (&[5, 5, 4, 0, 0, 1][..], 1));
}

proptest! {
    #[test]
    fn bits_round_trip(data in any::<[u8; 8]>(), first in 0u16..80, bits in 1u16..70, value: u64) {
        let mut changed = data;
        put_bits(&mut changed, first, bits, value);
        if first + bits <= 64 {
            let mask = if bits >= 64 { u64::MAX } else { (1 << bits) - 1 };
            prop_assert_eq!(get_bits(&changed, first, bits), value & mask);
            put_bits(&mut changed, first, bits, get_bits(&data, first, bits));
            prop_assert_eq!(changed, data);
        }
    }

    /// Whatever comes in whatever order: a published sample of synchronous inputs holds one counter in all that is good.
    #[test]
    fn good_inputs_of_a_sample_are_of_one_sync(steps in prop::collection::vec((0u8..8, any::<bool>()), 1..300)) {
        let pdos = (0..4u32).map(|i| rx(0x181 + i, i as u8 + 1, 1, vec![field(0, 8, i, 1, i as u16)])).collect();
        let mut exchange = Exchange::new(Plan { rx: pdos, input_bytes: vec![1; 4], ..Plan::default() }, 5 * MS);
        let mut out = Outbox::default();
        let (mut now, mut counter) = (0, 0u8);
        for (what, flag) in steps {
            now += MS;
            match what {
                0..4 => { exchange.on_frame(now, &CanFrame::classic(0x181 + u32::from(what), &[counter])); }
                4 => { counter = counter.wrapping_add(1); exchange.on_sync(now); }
                5 => exchange.set_operational(counter % 4 + 1, flag, now),
                _ => exchange.on_time(now, &mut out),
            }
            if let Some(Sample { sync: true }) = exchange.take_sample() {
                let (values, quality) = exchange.tail().split_at(4);
                let good: Vec<u8> = values.iter().zip(quality).filter(|(_, q)| **q == 0).map(|(v, _)| *v).collect();
                prop_assert!(good.windows(2).all(|w| w[0] == w[1]), "{good:?}");
            }
        }
    }

    /// However frames, scans and messages between master and plc interleave: every value is seen, in order.
    #[test]
    fn a_queue_loses_and_swaps_nothing(steps in prop::collection::vec(0u8..6, 1..400)) {
        let mut exchange = queued(255);
        let (mut now_ns, mut sent) = (1u64, 0u8);
        // What the plc reads next, what its scans saw, and the images on their way to the master.
        let (mut inputs, mut seen, mut images) = (None::<u8>, Vec::new(), Vec::new());
        for step in steps.into_iter().chain((0..1200u16).map(|i| 2 + (i % 3) as u8)) {
            now_ns += 10;
            match step {
                0 | 1 if sent < 200 => {
                    sent += 1;
                    exchange.on_frame(now_ns, &CanFrame::classic(0x185, &[sent]));
                }
                2 if exchange.take_sample().is_some() => {
                    inputs = Some(exchange.tail()[0]);
                    exchange.published(now_ns);
                }
                3 => {
                    seen.extend(inputs);
                    images.push(now_ns);
                }
                // The newest image counts; a plc that dies takes its images along.
                4 => if let Some(inputs_t_ns) = images.drain(..).next_back() {
                    exchange.on_scan(inputs_t_ns);
                },
                5 if images.len() > 3 => images.clear(),
                _ => {}
            }
        }
        seen.dedup();
        prop_assert_eq!(seen, (1..=sent).collect::<Vec<u8>>());
    }
}
