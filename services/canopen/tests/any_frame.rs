//! Any frame at any moment: no panic, no storm, no state that a reset does not end.

mod bed;

use bed::{Bed, Step};
use ipc_types::payload::id_flag;
use proptest::prelude::*;

/// Mostly identifiers that mean something to a master or to a device.
fn steps() -> impl Strategy<Value = Vec<Step>> {
    let functions = prop::sample::select(vec![
        0_u32, 0x80, 0x100, 0x180, 0x200, 0x280, 0x300, 0x480, 0x580, 0x600, 0x700,
    ]);
    let id = prop_oneof![
        6 => (functions, 0_u32..5).prop_map(|(function, node)| function + node),
        1 => 0_u32..0x800,
        1 => (0_u32..0x800).prop_map(|id| id | id_flag::RTR),
        1 => any::<u32>(),
    ];
    let known = prop::sample::select(vec![
        vec![0x23, 0x16, 0x10, 1],
        vec![0x2B, 0x17, 0x10, 0],
        vec![0x23, 0x05, 0x10, 0],
        vec![0x2F, 0x00, 0x1A, 0],
        vec![0x23, 0x00, 0x18, 1],
        vec![0x23, 0x10, 0x10, 1],
        vec![0x40, 0x18, 0x10, 1],
        vec![0xA0, 0x08, 0x10, 0],
        vec![0xC0, 0x10, 0x10, 1],
        vec![0x80, 0x18, 0x10, 1],
        vec![0x81],
        vec![0x82],
        vec![2],
        vec![1],
        vec![0x7F],
    ]);
    let bytes = |n| prop::collection::vec(any::<u8>(), n);
    let data = prop_oneof![bytes(0..9), (known, bytes(0..5)).prop_map(|(head, tail)| [head, tail].concat()),];
    let pause = prop_oneof![4 => 0_u64..3, 1 => 0_u64..700];
    let step = (pause, id, data).prop_map(|(pause_ms, can_id, data)| Step { pause_ms, can_id, data });
    prop::collection::vec(step, 0..80)
}

proptest! {
    #![proptest_config(ProptestConfig { cases: ProptestConfig::default().cases / 4, ..ProptestConfig::default() })]
    #[test]
    fn a_network_survives_any_frames(steps in steps()) {
        prop_assert!(Bed::new().unwrap().survives(steps), "the network is not whole again after a reset of its nodes");
    }
}
