use super::*;
use crate::config::MasterConfig;
use crate::master::exchange::Exchange;
use crate::master::plan::plan;
use crate::master::testing::{Slave, device};
use crate::master::transfers::Transfers;
use crate::protocol::lss::slave::{LssAbilities, LssSlave};
use crate::protocol::lss::{LssAddress, UNCONFIGURED};
use dinrail_iec::Addressing;
use ipc_types::payload::CanFrame;
use std::collections::BTreeMap;

const MS: u64 = 1_000_000;

/// A desk, its network with node 2, and a device without node-id.
struct Bench {
    desk: Desk,
    network: Network,
    slave: Slave,
    lss: LssSlave,
    now_ns: u64,
    jobs: u64,
}

impl Bench {
    fn new() -> Self {
        let config: MasterConfig = serde_json::from_value(json!({ "node_id": 1, "node": [
            { "id": 2, "eds": "x", "heartbeat": "50ms", "mandatory": true },
            { "id": 3, "name": "Drive" },
        ] }))
        .unwrap();
        let devices = BTreeMap::from([(2, device(2))]);
        let plan = plan(&config, &devices, Addressing::Element, "io");
        let names = plan.nodes.iter().map(|n| (n.settings.plan.id, n.name.clone())).collect();
        let transfers = Transfers::new([(2, 500 * MS), (3, 500 * MS)]);
        let nodes = plan.nodes.into_iter().map(|n| n.settings).collect();
        let exchange = Exchange::new(plan.exchange, plan.sync_window_ns);
        let address = LssAddress { vendor: 1, product: 2, revision: 3, serial: 4 };
        let mut bench = Self {
            desk: Desk::new(Book { devices, names }, 500 * MS),
            network: Network::new(plan.settings, nodes, exchange, transfers),
            slave: Slave::new(2),
            lss: LssSlave::new(address, UNCONFIGURED, LssAbilities::default()),
            now_ns: MS,
            jobs: 0,
        };
        let mut out = Outbox::default();
        bench.network.start(bench.now_ns, &mut out);
        bench.pass(out);
        bench
    }

    fn pass(&mut self, mut out: Outbox) {
        loop {
            let frames: Vec<CanFrame> = out.drain().collect();
            if frames.is_empty() {
                return;
            }
            for frame in frames {
                let mut answers = Outbox::default();
                self.slave.on_frame(self.now_ns, &frame, &mut answers);
                self.lss.on_frame(&frame, &mut answers);
                for answer in answers.drain().collect::<Vec<_>>() {
                    self.network.on_frame(self.now_ns, &answer, &mut out);
                }
            }
        }
    }

    fn run(&mut self, ms: u64) {
        for _ in 0..ms {
            self.now_ns += MS;
            let mut out = Outbox::default();
            self.network.on_time(self.now_ns, &mut out);
            self.slave.on_time(self.now_ns, &mut out);
            let beats: Vec<CanFrame> = out.drain().collect();
            for frame in beats {
                if frame.id() & 0x780 == 0x700 {
                    self.network.on_frame(self.now_ns, &frame, &mut out);
                } else {
                    out.push(frame);
                }
            }
            self.pass(out);
            self.desk.collect(&mut self.network);
        }
    }

    /// Hands a job in; its number.
    fn ask(&mut self, job: Value) -> u64 {
        self.jobs += 1;
        let by = Asker { seq: self.jobs, writer: 7, generation: 1 };
        let now = Now { ns: self.now_ns, utc_ns: 1_000_000_000_000 + self.now_ns as i64 };
        let text = job.to_string();
        let job = Taken { by, deadline_ns: self.now_ns + 60_000 * MS, text: text.as_bytes() };
        let mut out = Outbox::default();
        assert_eq!(self.desk.ask(now, job, &mut self.network, &mut out), None);
        self.pass(out);
        self.desk.collect(&mut self.network);
        self.jobs
    }

    /// The answer that has come, if any: number, code, body.
    fn answer(&mut self) -> Option<(u64, u32, Value)> {
        self.desk.take_answer().map(|a| (a.to.seq, a.code, a.body))
    }

    fn at_once(&mut self, job: Value) -> Value {
        let number = self.ask(job);
        let (seq, code, body) = self.answer().unwrap();
        assert_eq!((seq, code), (number, 0), "{body}");
        body["ok"].clone()
    }

    fn emcy(&mut self, node: u8, data: [u8; 8]) {
        let frame = CanFrame::classic(0x80 + u32::from(node), &data);
        self.network.on_frame(self.now_ns, &frame, &mut Outbox::default());
    }
}

#[test]
fn two_lss_jobs_at_once_and_an_sdo_between_them() {
    let mut bench = Bench::new();
    bench.run(300);
    let first = bench.ask(json!({ "do": "lss", "call": "assign", "from": 40 }));
    let second = bench.ask(json!({ "do": "lss", "call": "identify_non_configured" }));
    assert_eq!(bench.answer(), None);
    let sdo = bench.ask(json!({ "do": "sdo_read", "node": 2, "object": "1018:01" }));
    let (seq, code, body) = bench.answer().unwrap();
    assert_eq!((seq, code, &body["ok"]["value"]), (sdo, 0, &json!("17")));
    bench.run(60_000);
    let (seq, code, body) = bench.answer().unwrap();
    assert_eq!((seq, code), (first, 0), "{body}");
    let found = json!({ "vendor": 1, "product": 2, "revision": 3, "serial": 4, "node_id": 40 });
    assert_eq!(body, json!({ "ok": { "found": [found], "more": false } }));
    assert_eq!(bench.answer(), Some((second, 0, json!({ "ok": { "answered": false } }))));
    assert_eq!(bench.answer(), None);
}

#[test]
fn lss_jobs_are_refused_in_words() {
    let mut bench = Bench::new();
    bench.ask(json!({ "do": "lss", "call": "set_bitrate", "kbit": 300 }));
    bench.ask(json!({ "do": "lss", "call": "jump" }));
    bench.ask(json!({ "do": "lss", "call": "store", "twice": true }));
    let said: Vec<String> = std::iter::from_fn(|| bench.answer())
        .map(|(_, code, body)| format!("{code}: {}", body["error"]))
        .collect();
    insta::assert_snapshot!(said.join("\n"));
    for _ in 0..=crate::master::lss::MAX_CALLS {
        bench.ask(json!({ "do": "lss", "call": "store" }));
    }
    let (_, code, body) = bench.answer().unwrap();
    assert_eq!((code, &body["error"]), (1, &json!("16 LSS jobs wait already; try again")));
}

#[test]
fn emergencies_are_listed_and_forgotten() {
    let mut bench = Bench::new();
    bench.run(10);
    bench.emcy(3, [0x10, 0x42, 0x09, 1, 2, 0, 0, 0]);
    bench.run(10);
    // Of a node that the stack file does not name.
    bench.emcy(77, [0x30, 0x81, 0x11, 0, 0, 0, 0, 0]);
    bench.emcy(3, [0, 0, 0, 0, 0, 0, 0, 0]);
    let all = bench.at_once(json!({ "do": "emcy" }));
    insta::assert_snapshot!(all.to_string(), @r#"{"more":false,"nodes":[{"active":0,"name":"Drive","node":3,"seen":1},{"active":1,"node":77,"seen":1}]}"#);
    let one = bench.at_once(json!({ "do": "emcy", "node": 3 }));
    insta::assert_snapshot!(one.to_string(), @r#"{"active":0,"dropped":0,"entries":[{"bits":["generic","temperature"],"code":"4210h","data":"0102000000","register":"09h","reset_by":"error-reset","reset_utc_ms":1000021,"text":"temperature","utc_ms":1000011}],"more":false,"name":"Drive","node":3,"seen":1}"#);
    assert_eq!(bench.at_once(json!({ "do": "emcy_clear", "node": 3 })), json!({ "cleared": 1 }));
    assert_eq!(bench.at_once(json!({ "do": "emcy", "node": 3 }))["entries"], json!([]));
    bench.ask(json!({ "do": "emcy", "node": 0 }));
    assert_eq!(bench.answer().unwrap().1, 1);
}

#[test]
fn a_long_history_comes_in_parts_that_fit() {
    let mut bench = Bench::new();
    for n in 0..40u8 {
        bench.emcy(3, [n, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF]);
    }
    bench.emcy(3, [0; 8]);
    let (mut codes, mut parts) = (Vec::new(), 0);
    loop {
        let part = bench.at_once(json!({ "do": "emcy", "node": 3, "skip": codes.len() }));
        assert!(part.to_string().len() < 4096 - 20);
        codes.extend(
            part["entries"].as_array().unwrap().iter().map(|e| e["code"].as_str().unwrap().to_owned()),
        );
        parts += 1;
        assert_eq!((&part["seen"], &part["dropped"]), (&json!(40), &json!(24)));
        if part["more"] == false {
            break;
        }
    }
    assert!(parts > 1, "the test wants more than one part");
    assert_eq!((codes.len(), codes[0].as_str(), codes[15].as_str()), (16, "FF27h", "FF18h"));
    for node in 1..=127 {
        bench.emcy(node, [1, 0x10, 1, 0, 0, 0, 0, 0]);
    }
    let mut nodes: Vec<u64> = Vec::new();
    loop {
        let part = bench.at_once(json!({ "do": "emcy", "skip": nodes.last().copied().unwrap_or(0) }));
        assert!(part.to_string().len() < 4096 - 20);
        nodes.extend(part["nodes"].as_array().unwrap().iter().map(|n| n["node"].as_u64().unwrap()));
        if part["more"] == false {
            break;
        }
    }
    assert!(nodes.iter().copied().eq(1..=127));
}

#[test]
fn the_boot_state_tells_step_letter_tries_and_time() {
    let mut bench = Bench::new();
    bench.run(2_700);
    let state = bench.at_once(json!({ "do": "boot_state" }));
    let two = &state[0];
    assert_eq!(
        (&two["id"], &two["booted"], &two["step"], &two["tries"]),
        (&json!(2), &json!(true), &json!("booted"), &json!(1))
    );
    assert!(two["took_ms"].as_u64().unwrap() < 200 && two["booted_utc_ms"].as_i64().unwrap() >= 1_000_000);
    assert_eq!(two.get("letter"), None);
    let three = bench.at_once(json!({ "do": "boot_state", "node": 3 }));
    assert_eq!((&three["booted"], &three["letter"]), (&json!(false), &json!("B")));
    assert!(three["tries"].as_u64().unwrap() >= 1, "{three}");
    assert!(
        three["failed_utc_ms"].as_i64() > three["began_utc_ms"].as_i64().map(|ms| ms - 10_000),
        "{three}"
    );
    assert!(three["text"].as_str().unwrap().starts_with("boot-up failed with letter B"), "{three}");
    bench.ask(json!({ "do": "boot_state", "node": 9 }));
    assert_eq!(bench.answer().unwrap().2, json!({ "error": "the stack file has no node 9" }));
}
