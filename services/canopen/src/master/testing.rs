//! A small device for tests of the master: an object dictionary behind an SDO server, NMT, a heartbeat.

use crate::device::{Device, Named};
use crate::protocol::data_type::DataType;
use crate::protocol::io::Outbox;
use crate::protocol::nmt::{NmtCommand, NmtState, boot_up_frame, heartbeat_frame};
use crate::protocol::od::{Access, EntryDef, NoHooks, ObjectDictionary, OdBuilder};
use crate::protocol::sdo::{Channel, SdoServer, ServerConfig};
use ipc_types::payload::CanFrame;

fn pdo(builder: &mut OdBuilder, comm: u16, cob_id: u32, mapping: &[u32]) {
    let u8_ = || EntryDef::new(DataType::Unsigned8, Access::Rw);
    let u16_ = || EntryDef::new(DataType::Unsigned16, Access::Rw);
    let u32_ = || EntryDef::new(DataType::Unsigned32, Access::Rw);
    let cob = u32_().value_plus_node_id(cob_id);
    builder.record(
        comm,
        Access::Ro,
        vec![(1, cob), (2, u8_().value(255)), (3, u16_()), (5, u16_()), (6, u8_())],
    );
    let mut fields: Vec<(u8, EntryDef)> = (1..=8).map(|i| (i, u32_())).collect();
    for (i, word) in mapping.iter().enumerate() {
        fields[i].1 = u32_().value(i64::from(*word));
    }
    builder.record(comm + 0x200, Access::Rw, fields);
    if let Some(object) = builder.object_mut(comm + 0x200) {
        object.subs[0].1 = u8_().value(mapping.len() as i64);
    }
}

/// An I/O device: two input and output bytes, an analogue value each way, two PDOs each way of which the second are
/// free.
pub fn dictionary(node: u8) -> ObjectDictionary {
    let mut b = OdBuilder::new();
    let var = |data_type, access| EntryDef::new(data_type, access);
    let ro32 = || var(DataType::Unsigned32, Access::Ro);
    b.var(0x1000, ro32().value(0x0003_0191));
    b.var(0x1001, var(DataType::Unsigned8, Access::Ro));
    b.var(0x1005, var(DataType::Unsigned32, Access::Rw).value(0x80));
    let u32_array =
        || vec![(1, var(DataType::Unsigned32, Access::Rw)), (2, var(DataType::Unsigned32, Access::Rw))];
    b.record(0x1011, Access::Ro, vec![(1, var(DataType::Unsigned32, Access::Rw))]);
    b.record(0x1016, Access::Ro, vec![(1, var(DataType::Unsigned32, Access::Rw))]);
    b.var(0x1017, var(DataType::Unsigned16, Access::Rw));
    let identity = (1u8..=4).map(|i| (i, ro32().value(i64::from(i) * 0x11))).collect();
    b.record(0x1018, Access::Ro, identity);
    b.record(0x1020, Access::Ro, u32_array());
    pdo(&mut b, 0x1400, 0x200, &[0x6200_0108, 0x6200_0208]);
    pdo(&mut b, 0x1401, 0x8000_0300, &[]);
    pdo(&mut b, 0x1800, 0x180, &[0x6000_0108, 0x6000_0208]);
    pdo(&mut b, 0x1801, 0x8000_0280, &[]);
    let digital = |access| {
        vec![
            (1, var(DataType::Unsigned8, access).mappable()),
            (2, var(DataType::Unsigned8, access).mappable()),
        ]
    };
    b.record(0x6000, Access::Ro, digital(Access::Ro));
    b.record(0x6200, Access::Ro, digital(Access::Rw));
    b.record(0x6401, Access::Ro, vec![(1, var(DataType::Integer16, Access::Ro).mappable())]);
    b.record(0x6411, Access::Ro, vec![(1, var(DataType::Integer16, Access::Rw).mappable())]);
    b.var(0x2000, var(DataType::Unsigned32, Access::Rw));
    b.build(node).unwrap()
}

/// The same as an EDS gives it.
pub fn device(node: u8) -> Device {
    let named = |index, sub, name: &str| Named { index, sub, name: name.to_owned() };
    Device {
        name: "Test I/O".to_owned(),
        od: dictionary(node),
        names: vec![
            named(0x6000, 1, "Digital inputs, Inputs 1-8"),
            named(0x6000, 2, "Digital inputs, Inputs 9-16"),
            named(0x6200, 1, "Digital outputs, Outputs 1-8"),
        ],
        values: Vec::new(),
    }
}

pub struct Slave {
    pub id: u8,
    pub od: ObjectDictionary,
    server: SdoServer,
    pub state: NmtState,
    pub dead: bool,
    next_ns: u64,
    pub resets: u32,
    /// PDO data received, with its identifier.
    pub pdos: Vec<(u32, Vec<u8>)>,
}

impl Slave {
    pub fn new(id: u8) -> Self {
        let od = dictionary(id);
        let server = SdoServer::new(Channel::default_of(id), ServerConfig::default(), &od);
        Self {
            id,
            od,
            server,
            state: NmtState::PreOperational,
            dead: false,
            next_ns: 0,
            resets: 0,
            pdos: Vec::new(),
        }
    }

    pub fn on_frame(&mut self, t_ns: u64, frame: &CanFrame, out: &mut Outbox) {
        if self.dead {
            return;
        }
        if let Some((command, node)) = NmtCommand::parse(frame) {
            if node == 0 || node == self.id {
                match command {
                    NmtCommand::Start => self.state = NmtState::Operational,
                    NmtCommand::Stop => self.state = NmtState::Stopped,
                    NmtCommand::EnterPreOperational => self.state = NmtState::PreOperational,
                    NmtCommand::ResetNode | NmtCommand::ResetCommunication => self.boot(out),
                }
            }
            return;
        }
        if self.state.communicates() {
            self.server.on_frame(t_ns, frame, &mut self.od, &mut NoHooks, out);
        }
        let id = frame.id();
        if self.state.has_pdo() && (0x200..0x580).contains(&id) && id & 0x7F == u32::from(self.id) {
            self.pdos.push((id, frame.payload().to_vec()));
        }
    }

    /// As after a reset or power-on.
    pub fn boot(&mut self, out: &mut Outbox) {
        self.resets += 1;
        self.dead = false;
        self.server.reset();
        self.od.reset_to_defaults(0x1000..=0x1FFF);
        self.state = NmtState::PreOperational;
        out.push(boot_up_frame(self.id));
    }

    pub fn on_time(&mut self, t_ns: u64, out: &mut Outbox) {
        let period_ns = u64::from(self.od.u16(0x1017, 0).unwrap_or(0)) * 1_000_000;
        if !self.dead && period_ns > 0 && t_ns >= self.next_ns {
            self.next_ns = t_ns + period_ns;
            out.push(heartbeat_frame(self.id, self.state));
        }
    }
}
