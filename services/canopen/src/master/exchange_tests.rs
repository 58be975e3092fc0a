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
}
