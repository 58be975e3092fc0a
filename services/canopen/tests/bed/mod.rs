//! A master and simulated devices on one bus in virtual time, into which anything may be thrown. The property test
//! `any_frame.rs` and the fuzz target `canopen_bus` play on it.

use dinrail_canopen::config::{MasterConfig, Simulation};
use dinrail_canopen::device::Device;
use dinrail_canopen::master::exchange::Exchange;
use dinrail_canopen::master::network::{Network, NodeRun};
use dinrail_canopen::master::plan::plan;
use dinrail_canopen::master::transfers::Transfers;
use dinrail_canopen::protocol::cob_id::predefined;
use dinrail_canopen::protocol::eds::{BuildOptions, Eds};
use dinrail_canopen::protocol::io::Outbox;
use dinrail_canopen::protocol::nmt::NmtCommand;
use dinrail_canopen::slave::fleet::Fleet;
use dinrail_canopen::slave::simulation;
use dinrail_iec::Addressing;
use ipc_types::payload::CanFrame;
use std::collections::{BTreeMap, VecDeque};

const MS: u64 = 1_000_000;
const NODES: [u8; 2] = [2, 3];
/// Frames that follow from one, at most: more would be a storm.
const STORM: usize = 5_000;
/// What the bus needs to be whole again after a reset, in virtual time: boot-up, its tries and their pauses.
const RECOVERY_MS: u64 = 60_000;

/// Something that happens on the bus.
#[derive(Debug, Clone)]
pub struct Step {
    /// First, nothing happens for so long.
    pub pause_ms: u64,
    /// Identifier with its flags, as `CanFrame::can_id`.
    pub can_id: u32,
    pub data: Vec<u8>,
}

pub struct Bed {
    network: Network,
    fleet: Fleet,
    now_ns: u64,
}

impl Bed {
    /// SYNC every 10 ms, node 2 with a heartbeat and synchronous PDOs, node 3 guarded.
    pub fn new() -> Result<Self, String> {
        let node = |id: u8, control: &str| {
            format!(
                r#"{{ "id": {id}, "eds": "x.eds", "mandatory": true, {control}, "map": [
                    {{ "object": "6000:01", "to": "%IB{}" }}, {{ "object": "6200:01", "from": "%QB{}" }},
                    {{ "object": "6401:01", "to": "%IW{}" }} ] }}"#,
                id * 8,
                id * 8,
                id * 4 + 1
            )
        };
        let text = format!(
            r#"{{ "node_id": 1, "heartbeat": "100ms", "sync_period": "10ms", "node": [ {}, {} ] }}"#,
            node(NODES[0], r#""heartbeat": "50ms""#),
            node(NODES[1], r#""guarding": { "time": "50ms", "factor": 3 }"#),
        );
        let config: MasterConfig = serde_json::from_str(&text).map_err(|e| e.to_string())?;
        let eds = Eds::parse(simulation::eds(Simulation::Cia401).as_bytes()).map_err(|e| e.to_string())?;
        let options = BuildOptions { parameter_values: true, ..BuildOptions::default() };
        let device = |id| Device::from_eds(&eds, id, &options).map_err(|e| e.to_string());
        let devices: BTreeMap<u8, Device> =
            NODES.into_iter().map(|id| device(id).map(|device| (id, device))).collect::<Result<_, _>>()?;
        let plan = plan(&config, &devices, Addressing::Element, "io");
        if let Some(mistake) = plan.mistakes.iter().find(|m| !m.warning) {
            return Err(format!("{mistake:?}"));
        }
        let exchange = Exchange::new(plan.exchange, plan.sync_window_ns);
        let transfers = Transfers::new(plan.nodes.iter().map(|n| (n.settings.plan.id, 500 * MS)));
        let nodes = plan.nodes.into_iter().map(|n| n.settings).collect();
        let network = Network::new(plan.settings, nodes, exchange, transfers);
        let fleet = Fleet::new(Simulation::Cia401, NODES).map_err(|e| e.to_string())?;
        let mut bed = Self { network, fleet, now_ns: 0 };
        let mut out = Outbox::default();
        for id in NODES {
            bed.fleet.power_on(0, id, &mut out);
        }
        bed.network.start(0, &mut out);
        bed.pass(&mut out);
        Ok(bed)
    }

    /// Everybody sees the frames, and what is answered to them.
    fn pass(&mut self, out: &mut Outbox) {
        let mut wait: VecDeque<CanFrame> = out.drain().collect();
        let mut passed = 0;
        while let Some(mut frame) = wait.pop_front() {
            passed += 1;
            assert!(passed < STORM, "frames answer each other for ever");
            frame.stamp.t_ns = self.now_ns;
            self.network.on_frame(self.now_ns, &frame, out);
            self.fleet.on_frame(self.now_ns, &frame, out);
            assert_eq!(out.dropped, 0, "more frames at once than an outbox holds");
            wait.extend(out.drain());
        }
        self.network.drain_events().for_each(drop);
        self.network.exchange.take_sample();
    }

    fn run(&mut self, ms: u64, until_whole: bool) {
        let mut out = Outbox::default();
        for _ in 0..ms {
            if until_whole && self.is_whole() {
                return;
            }
            self.now_ns += MS;
            self.network.on_time(self.now_ns, &mut out);
            self.pass(&mut out);
            self.fleet.on_time(self.now_ns, &mut out);
            self.pass(&mut out);
        }
    }

    fn is_whole(&self) -> bool {
        self.network.is_whole() && self.network.nodes().iter().all(NodeRun::is_operational)
    }

    fn send(&mut self, frame: CanFrame) {
        let mut out = Outbox::default();
        out.push(frame);
        self.pass(&mut out);
    }

    /// Boots, throws the steps at it, resets the nodes and says whether the network is whole again. LSS is left out: it
    /// may give a device another node-id, and then it has one.
    pub fn survives(mut self, steps: impl IntoIterator<Item = Step>) -> bool {
        self.run(RECOVERY_MS, true);
        assert!(self.is_whole(), "it boots undisturbed");
        for step in steps {
            self.run(step.pause_ms, false);
            let mut frame = CanFrame::classic(0x7FF, &step.data[..step.data.len().min(8)]);
            frame.can_id = step.can_id;
            if frame.is_error() || frame.id() != predefined::LSS_MASTER {
                self.send(frame);
            }
        }
        self.send(NmtCommand::ResetNode.frame(0));
        self.run(10, false);
        self.run(RECOVERY_MS, true);
        self.is_whole()
    }
}
