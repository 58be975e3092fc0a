//! The exchange of PDOs allocates nothing once it is made: counted by a global allocator.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use dinrail_canopen::master::exchange::{Exchange, Field, Plan, RxPdo, TxPdo};
use dinrail_canopen::protocol::io::Outbox;
use ipc_types::payload::CanFrame;
use ipc_types::testing::allocations::{Counting, allocations};

#[global_allocator]
static ALLOCATOR: Counting = Counting;

fn field(at: u32, range: u16) -> Field {
    Field { pdo_bit: 0, bits: 16, at, bytes: 2, signed: true, range }
}

fn rx(cob_id: u32, transmission: u8, at: u32, range: u16) -> RxPdo {
    RxPdo {
        cob_id,
        node: 5,
        length: 2,
        transmission,
        deadline_ns: Some(50),
        poll_ns: None,
        fields: vec![field(at, range)],
    }
}

#[test]
fn queues_samples_and_outputs_allocate_nothing() {
    let plan = Plan {
        rx: vec![
            rx(0x185, 255, 0, 0),
            rx(0x285, 1, 2, 1),
            rx(0x385, 255, 4, 2),
            rx(0x485, 3, 6, 3),
            rx(0x486, 0, 8, 4),
        ],
        tx: vec![TxPdo {
            cob_id: 0x205,
            node: 5,
            length: 2,
            transmission: 1,
            inhibit_ns: 0,
            event_ns: None,
            fields: vec![field(0, 0)],
        }],
        input_bytes: vec![2; 5],
        output_bytes: 2,
        states: Vec::new(),
        queues: vec![(0, 16)],
    };
    let mut exchange = Exchange::new(plan, 1000);
    let mut out = Outbox::default();
    exchange.set_operational(5, true, 0);
    let allocated = allocations(|| {
        for t_ns in 1..2000u64 {
            for id in [0x185, 0x185, 0x285, 0x385, 0x485, 0x486] {
                exchange.on_frame(t_ns, &CanFrame::classic(id, &(t_ns as u16).to_le_bytes()));
            }
            if t_ns.is_multiple_of(10) {
                exchange.on_sync(t_ns);
                exchange.sync_pdos(t_ns, &mut out);
                exchange.set_outputs(&[t_ns as u8, 1]);
            }
            exchange.on_time(t_ns, &mut out);
            if exchange.take_sample().is_some() {
                exchange.published(t_ns);
            }
            exchange.on_scan(t_ns + 1);
            assert!(out.drain().count() < 10);
        }
    });
    assert_eq!(allocated, 0);
    let queue = exchange.queues().next().unwrap();
    assert!(queue.dropped > 0 && queue.most == 16, "{queue:?}");
    assert!(exchange.samples() > 100);
}
