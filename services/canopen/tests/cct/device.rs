//! The device under test with its application, on a bus in virtual time.

use dinrail_canopen::protocol::io::Outbox;
use dinrail_canopen::protocol::node::{Node, NodeEvent, NodeParams};
use dinrail_canopen::protocol::od::ObjectDictionary;
use ipc_types::payload::{CanFrame, id_flag};

pub const MS: u64 = 1_000_000;
pub const NODE_ID: u8 = 4;

/// A frame that the device sent.
#[derive(Debug, Clone, PartialEq)]
pub struct Sent {
    pub t_ns: u64,
    pub id: u32,
    pub data: Vec<u8>,
}

pub struct Device {
    pub node: Node,
    pub t_ns: u64,
    /// Frames that nobody asked for yet, oldest first.
    pub sent: Vec<Sent>,
    pub events: Vec<NodeEvent>,
    out: Outbox,
}

impl Device {
    pub fn new(od: ObjectDictionary) -> Self {
        let node = Node::new(od, NodeParams::new(NODE_ID), &[]).unwrap();
        let mut device = Self { node, t_ns: 0, sent: Vec::new(), events: Vec::new(), out: Outbox::default() };
        device.node.start(0, &mut device.out);
        device.settle();
        device.sent.clear();
        device
    }
    fn settle(&mut self) {
        for frame in self.out.drain() {
            let data = frame.payload().to_vec();
            self.sent.push(Sent { t_ns: self.t_ns, id: frame.can_id, data });
        }
        assert_eq!(self.out.dropped, 0);
        let mut reset = false;
        while let Some(event) = self.node.next_event() {
            reset |= matches!(event, NodeEvent::Reset { .. });
            self.events.push(event);
        }
        if reset {
            self.application();
        }
    }
    /// What the demo device's application puts into its objects.
    fn application(&mut self) {
        let mut write = |index: u16, sub: u8, data: &[u8]| {
            self.node.write(self.t_ns, index, sub, data, &mut self.out).unwrap();
        };
        write(0x1008, 0, b"CANopenDemoPIC32");
        write(0x1009, 0, b"---");
        write(0x100A, 0, b"---");
        write(0x6000, 1, &[0xFF]);
        for sub in (1..=6).chain(9..=16) {
            write(0x6401, sub, &[0xFF, 0x03]);
        }
        write(0x2100, 0, &[0; 10]);
        write(0x2121, 3, &[0xC8, 0x3D, 0xBB, 0, 0, 0, 0, 0, 0, 0]);
        let domain: Vec<u8> = (0..1024u32).map(|at| at as u8).collect();
        write(0x2122, 0, &domain);
    }
    /// An input of the process changes.
    pub fn application_input(&mut self, value: u8) {
        self.node.write(self.t_ns, 0x6000, 1, &[value], &mut self.out).unwrap();
        self.settle();
    }
    /// Lets time pass.
    pub fn advance(&mut self, t_ns: u64) {
        while let Some(due) = self.node.next_deadline().filter(|&due| due <= t_ns) {
            self.t_ns = self.t_ns.max(due);
            self.node.on_time(self.t_ns, &mut self.out);
            self.settle();
        }
        self.t_ns = self.t_ns.max(t_ns);
    }
    pub fn wait_ms(&mut self, ms: u64) {
        self.advance(self.t_ns + ms * MS);
    }
    pub fn send(&mut self, id: u32, data: &[u8]) {
        self.receive(CanFrame::classic(id, data));
    }
    pub fn remote(&mut self, id: u32) {
        let mut frame = CanFrame::classic(id, &[]);
        frame.can_id |= id_flag::RTR;
        self.receive(frame);
    }
    fn receive(&mut self, frame: CanFrame) {
        self.node.on_frame(self.t_ns, &frame, &mut self.out);
        self.settle();
    }
    /// Takes the first frame that fits; waits for it up to `limit_ms`. Frames before it stay.
    pub fn take(&mut self, limit_ms: u64, fits: impl Fn(&Sent) -> bool) -> Option<Sent> {
        let limit = self.t_ns + limit_ms * MS;
        loop {
            if let Some(at) = self.sent.iter().position(&fits) {
                return Some(self.sent.remove(at));
            }
            let due = self.node.next_deadline().filter(|&due| due <= limit)?;
            self.advance(due.max(self.t_ns));
        }
    }
}
