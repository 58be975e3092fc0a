//! Ready devices without process image, for demonstrations and tests.

use crate::config::Simulation;
use crate::protocol::io::Outbox;
use crate::protocol::node::{Node, NodeEvent};

/// The EDS of the simulated CiA 401 device: digital and analogue inputs and outputs.
pub const CIA_401_EDS: &str = include_str!("io401.eds");

/// Text of a simulation's EDS.
pub fn eds(simulation: Simulation) -> &'static str {
    match simulation {
        Simulation::Cia401 => CIA_401_EDS,
    }
}

/// Digital inputs show the digital outputs, analogue inputs 1 to 3 the analogue outputs, analogue input 4 the counter
/// of the last SYNC: so a master sees an effect of everything it does.
pub fn react(node: &mut Node, event: &NodeEvent, t_ns: u64, out: &mut Outbox) {
    let copy = |node: &mut Node, from: (u16, u8), to: (u16, u8), out: &mut Outbox| {
        let mut value = [0; 8];
        let Ok(data) = node.read(from.0, from.1) else { return };
        let n = data.len().min(8);
        value[..n].copy_from_slice(&data[..n]);
        // An EDS without such an object has nothing to show there.
        let _ = node.write(t_ns, to.0, to.1, &value[..n], out);
    };
    match *event {
        NodeEvent::Received { .. } | NodeEvent::Written { .. } | NodeEvent::Reset { .. } => {
            for sub in 1..=2 {
                copy(node, (0x6200, sub), (0x6000, sub), out);
            }
            for sub in 1..=3 {
                copy(node, (0x6411, sub), (0x6401, sub), out);
            }
        }
        NodeEvent::Sync { counter } => {
            let _ = node.write(t_ns, 0x6401, 4, &u16::from(counter).to_le_bytes(), out);
        }
        _ => {}
    }
}
