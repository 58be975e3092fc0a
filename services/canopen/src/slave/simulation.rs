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

/// Outputs and the inputs that show them.
const SHOWN: [((u16, u8), (u16, u8)); 5] = [
    ((0x6200, 1), (0x6000, 1)),
    ((0x6200, 2), (0x6000, 2)),
    ((0x6411, 1), (0x6401, 1)),
    ((0x6411, 2), (0x6401, 2)),
    ((0x6411, 3), (0x6401, 3)),
];

/// Digital inputs show the digital outputs, analogue inputs 1 to 3 the analogue outputs, analogue input 4 the counter
/// of the last SYNC: so a master sees an effect of everything it does.
pub fn react(node: &mut Node, event: &NodeEvent, t_ns: u64, out: &mut Outbox) {
    match *event {
        NodeEvent::Received { .. } | NodeEvent::Written { .. } | NodeEvent::Reset { .. } => {
            // First all values, then one event: a PDO of several inputs goes out once.
            let mut changed = [(0, 0); SHOWN.len()];
            let mut count = 0;
            for (from, to) in SHOWN {
                if copy(node, from, to) {
                    changed[count] = to;
                    count += 1;
                }
            }
            node.changed(t_ns, &changed[..count], out);
        }
        NodeEvent::Sync { counter } => {
            let _ = node.write(t_ns, 0x6401, 4, &u16::from(counter).to_le_bytes(), out);
        }
        _ => {}
    }
}

/// True when the value changed. An EDS without such an object has nothing to show there.
fn copy(node: &mut Node, from: (u16, u8), to: (u16, u8)) -> bool {
    let Ok(entry) = node.od().find(to.0, to.1) else { return false };
    let mut value = [0; 8];
    let Ok(data) = node.read(from.0, from.1) else { return false };
    let n = data.len().min(8);
    value[..n].copy_from_slice(&data[..n]);
    node.get(entry) != &value[..n] && node.set_quietly(entry, &value[..n]).is_ok()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::device::Device;
    use crate::protocol::eds::{BuildOptions, Eds};
    use crate::protocol::nmt::NmtCommand;
    use crate::protocol::node::NodeParams;
    use ipc_types::payload::CanFrame;

    /// A simulated device, operational and quiet.
    struct Bench {
        node: Node,
        out: Outbox,
        t_ns: u64,
    }

    impl Bench {
        fn new() -> Self {
            let eds = Eds::parse(CIA_401_EDS.as_bytes()).unwrap();
            let device = Device::from_eds(&eds, 5, &BuildOptions::default()).unwrap();
            let node = Node::new(device.od, NodeParams::new(5), &[]).unwrap();
            let mut bench = Self { node, out: Outbox::default(), t_ns: 0 };
            bench.node.start(0, &mut bench.out);
            bench.frame(&NmtCommand::Start.frame(0));
            bench
        }

        /// What the device sends after a frame.
        fn frame(&mut self, frame: &CanFrame) -> Vec<(u32, Vec<u8>)> {
            self.t_ns += 1_000_000_000;
            self.node.on_frame(self.t_ns, frame, &mut self.out);
            while let Some(event) = self.node.next_event() {
                react(&mut self.node, &event, self.t_ns, &mut self.out);
            }
            self.out.drain().map(|frame| (frame.can_id, frame.payload().to_vec())).collect()
        }
    }

    #[test]
    fn a_change_of_several_outputs_is_one_pdo() {
        let mut bench = Bench::new();
        // Both bytes of 6200h come in one PDO and go back in one.
        assert_eq!(bench.frame(&CanFrame::classic(0x205, &[0x12, 0x34])), [(0x185, vec![0x12, 0x34])]);
        assert_eq!(bench.frame(&CanFrame::classic(0x205, &[0x12, 0x34])), []);
        assert_eq!(bench.frame(&CanFrame::classic(0x205, &[0x12, 0x35])), [(0x185, vec![0x12, 0x35])]);
        let analogue = [1, 0, 2, 0, 3, 0, 4, 0];
        let shown = bench.frame(&CanFrame::classic(0x305, &analogue));
        assert_eq!(shown, [(0x285, vec![1, 0, 2, 0, 3, 0, 0, 0])]);
    }

    #[test]
    fn the_fourth_analogue_input_shows_the_sync() {
        let mut bench = Bench::new();
        bench.node.write(0, 0x1019, 0, &[10], &mut bench.out).unwrap();
        bench.frame(&CanFrame::classic(0x80, &[7]));
        assert_eq!(bench.node.read(0x6401, 4), Ok(&[7, 0][..]));
    }
}
