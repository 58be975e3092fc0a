use super::*;
use crate::identity::Identity;
use crate::line_state::LineState;
use crate::map_config::{MapConfig, Preset};
use crate::protocol::pdu::MAX_PDU;
use crate::server::{Unit, answer};
use crate::testing::{hex, to_hex};
use dinrail_iec::Addressing;
use ipc_types::image_write::{self, Op};
use ipc_types::wiring::Area;
use ipc_types::wiring::AreaSizes;

const MS: u64 = 1_000_000;

/// A rail and a PLC that applies writes when told to scan.
#[derive(Default)]
struct FakeRail {
    now_ns: u64,
    image: Option<(payload::Image, Vec<u8>)>,
    queue: Vec<Vec<u8>>,
    queue_limit: usize,
    no_reader: bool,
    seq: u64,
    inputs: Vec<Vec<u8>>,
}

impl Rail for FakeRail {
    fn now_ns(&self) -> u64 {
        self.now_ns
    }
    fn newest(&mut self, take: &mut dyn FnMut(&payload::Image, &[u8])) {
        if let Some((header, tail)) = self.image.take() {
            take(&header, &tail);
        }
    }
    fn write(&mut self, write: &Builder) -> Result<u64, NotQueued> {
        if self.no_reader {
            return Err(NotQueued::NoReader);
        }
        if self.queue.len() == self.queue_limit {
            return Err(NotQueued::Full);
        }
        self.queue.push(write.tail().to_vec());
        self.seq += 1;
        Ok(self.seq)
    }
    fn publish_inputs(&mut self, ranges: u32, _: u64, tail: &[u8]) -> bool {
        assert!(ranges > 0);
        self.inputs.push(tail.to_vec());
        true
    }
}

struct Bench {
    image: ProcessImage<FakeRail>,
    marker: [u8; 16],
    output: [u8; 16],
}

impl Bench {
    fn new(map: &MapConfig, on_stop: OnStop, watchdog: Option<Watchdog>) -> Self {
        let rail = FakeRail { now_ns: 1000 * MS, queue_limit: 4, ..FakeRail::default() };
        let map = map.build(AreaSizes::MAX, Addressing::Element).unwrap();
        let image = ProcessImage::new(rail, View::new(7, 1, 200 * MS), map, on_stop, watchdog);
        Self { image, marker: [0; 16], output: [0; 16] }
    }

    fn running() -> Self {
        let mut bench = Self::new(&MapConfig::Preset(Preset::Dinrail), OnStop::Exception, None);
        bench.scan(PlcState::Run);
        bench
    }

    /// The PLC takes all writes and publishes its image.
    fn scan(&mut self, state: PlcState) {
        let rail = &mut self.image.rail;
        for tail in rail.queue.drain(..) {
            for op in image_write::parse(&tail).unwrap() {
                let area = if op.area() == Area::Marker { &mut self.marker } else { &mut self.output };
                assert!(op.apply(area));
            }
        }
        let seq = rail.seq;
        self.publish(state, 1, seq);
    }

    fn publish(&mut self, state: PlcState, generation: u32, seq: u64) {
        let mut header = payload::Image {
            state: state as u32,
            input_bytes: 16,
            output_bytes: 16,
            marker_bytes: 16,
            n: 48,
            ..payload::Image::default()
        };
        header.stamp.t_ns = self.image.rail.now_ns;
        header.stamp.generation = generation;
        (header.ack_writer[0], header.ack_generation[0], header.ack_seq[0]) = (7, 1, seq);
        let tail = [&[0; 16], &self.output[..], &self.marker[..]].concat();
        self.image.rail.image = Some((header, tail));
    }

    fn after(&mut self, ms: u64) -> &mut Self {
        self.image.rail.now_ns += ms * MS;
        self
    }

    fn ask(&mut self, pdu: &str) -> String {
        let mut out = [0; MAX_PDU];
        self.image.begin();
        let (mut line, identity) = (LineState::default(), Identity::default());
        let mut unit = Unit { line: &mut line, identity: &identity };
        let outcome = answer(&hex(pdu), &mut unit, &mut self.image, &mut out);
        to_hex(&out[..outcome.len])
    }

    fn tick(&mut self) -> Vec<Change> {
        let mut changes = Vec::new();
        self.image.tick(|change| changes.push(change));
        changes
    }
}

#[test]
fn before_the_first_image_everything_is_exception_4() {
    let mut bench = Bench::new(&MapConfig::default(), OnStop::Exception, None);
    assert_eq!((bench.ask("03 0000 0001"), bench.ask("06 0000 0001")), ("8304".into(), "8604".into()));
    let mut bench = Bench::new(&MapConfig::default(), OnStop::Hold, None);
    assert_eq!((bench.ask("03 0000 0001"), bench.ask("06 0000 0001")), ("8304".into(), "8604".into()));
}

#[test]
fn a_request_is_one_message_and_is_read_back_before_and_after_the_scan() {
    let mut bench = Bench::running();
    assert_eq!(bench.ask("10 0000 0003 06 0102 0304 0506"), "1000000003");
    assert_eq!(bench.image.rail.queue.len(), 1);
    let tail = bench.image.rail.queue[0].clone();
    let ops: Vec<_> = image_write::parse(&tail).unwrap().collect();
    assert_eq!(ops, [Op::Set { area: Area::Marker, offset: 0, bytes: &[2, 1, 4, 3, 6, 5] }]);
    assert_eq!(bench.ask("03 0000 0003"), "0306010203040506");
    assert_eq!(bench.image.view().pending(), 1);
    bench.scan(PlcState::Run);
    assert_eq!(bench.ask("03 0000 0003"), "0306010203040506");
    assert_eq!((bench.image.view().pending(), bench.marker[..6].to_vec()), (0, vec![2, 1, 4, 3, 6, 5]));
}

#[test]
fn coils_masks_and_read_write_are_one_message_each() {
    let mut bench = Bench::running();
    assert_eq!(bench.ask("0F 0003 000A 02 CD01"), "0F0003000A");
    assert_eq!(bench.ask("16 0000 00F2 0025"), "16000000F20025");
    assert_eq!(bench.ask("17 0000 0002 0001 0001 02 1234"), "170400051234");
    assert_eq!(bench.image.rail.queue.len(), 3);
    assert_eq!(bench.ask("01 0003 000A"), "0102CD01");
    bench.scan(PlcState::Run);
    assert_eq!(bench.output[..2], [0b0110_1000, 0b0000_1110]);
    assert_eq!(bench.marker[..4], [0x05, 0, 0x34, 0x12]);
}

#[test]
fn an_image_too_old_or_not_running_is_exception_4() {
    let mut bench = Bench::running();
    bench.after(199);
    assert_eq!(bench.ask("03 0000 0001"), "03020000");
    bench.after(1);
    assert_eq!((bench.ask("03 0000 0001"), bench.ask("05 0000 FF00")), ("8304".into(), "8504".into()));
    assert_eq!(bench.ask("03 7FFF 0001"), "8302", "the address is judged first");
    for state in [PlcState::Stop, PlcState::Fault, PlcState::Halted, PlcState::Starting] {
        bench.scan(state);
        assert_eq!(
            (bench.ask("03 0000 0001"), bench.ask("05 0000 FF00")),
            ("8304".into(), "8504".into()),
            "{state:?}"
        );
    }
    bench.scan(PlcState::Run);
    assert_eq!(bench.ask("03 0000 0001"), "03020000");
    assert!(bench.image.rail.queue.is_empty());
}

#[test]
fn hold_shows_the_last_image_and_takes_writes_while_the_engine_lives() {
    let mut bench = Bench::new(&MapConfig::default(), OnStop::Hold, None);
    bench.marker[0] = 9;
    bench.scan(PlcState::Stop);
    assert_eq!(
        (bench.ask("03 0000 0001"), bench.ask("06 0001 0001")),
        ("03020009".into(), "0600010001".into())
    );
    bench.after(1000);
    assert_eq!(
        (bench.ask("03 0000 0002"), bench.ask("06 0001 0001")),
        ("030400090000".into(), "8604".into())
    );
}

#[test]
fn a_full_queue_is_exception_6_and_no_reader_exception_4() {
    let mut bench = Bench::running();
    for _ in 0..4 {
        assert_eq!(bench.ask("06 0000 0001"), "0600000001");
    }
    assert_eq!((bench.ask("06 0001 0005"), bench.ask("03 0001 0001")), ("8606".into(), "03020000".into()));
    bench.scan(PlcState::Run);
    bench.image.rail.no_reader = true;
    assert_eq!(bench.ask("06 0001 0005"), "8604");
    let counters = bench.image.write_counters();
    assert_eq!((counters.queued, counters.full, counters.no_reader), (4, 1, 1));
}

#[test]
fn a_restarted_plc_ends_the_overlay() {
    let mut bench = Bench::running();
    bench.ask("06 0000 0001");
    bench.publish(PlcState::Run, 2, 0);
    assert_eq!(bench.ask("03 0000 0001"), "03020000");
}

#[test]
fn addresses_beyond_the_plcs_areas_are_exception_2() {
    let mut bench = Bench::running();
    assert_eq!((bench.ask("03 0007 0001"), bench.ask("03 0008 0001")), ("03020000".into(), "8302".into()));
    assert_eq!(bench.ask("10 0007 0002 04 0000 0000"), "9002");
}

#[test]
fn changes_of_service_are_told_once() {
    let mut bench = Bench::new(&MapConfig::default(), OnStop::Exception, None);
    assert_eq!(bench.tick(), [], "the first look is no change");
    bench.scan(PlcState::Run);
    assert_eq!((bench.tick(), bench.tick()), (vec![Change::Serving], vec![]));
    bench.after(300);
    assert_eq!((bench.tick(), bench.tick()), (vec![Change::NotServing], vec![]));
}

fn watchdog() -> Watchdog {
    let mut values = Builder::default();
    values.push(&Op::Set { area: Area::Output, offset: 0, bytes: &[0, 0] }).unwrap();
    Watchdog::new(500 * MS, values, false, 0)
}

#[test]
fn the_watchdog_writes_its_values_when_clients_stop_writing() {
    let mut bench = Bench::new(&MapConfig::default(), OnStop::Exception, Some(watchdog()));
    bench.scan(PlcState::Run);
    bench.tick();
    assert_eq!(bench.ask("06 8000 0007"), "0680000007");
    bench.scan(PlcState::Run);
    for _ in 0..4 {
        bench.after(100).scan(PlcState::Run);
        assert_eq!(
            (bench.tick(), bench.ask("03 8000 0001")),
            (vec![], "03020007".into()),
            "reading does not feed it"
        );
    }
    bench.after(100).scan(PlcState::Run);
    bench.image.rail.queue_limit = 0;
    assert_eq!(bench.tick(), [], "not fired while the queue is full");
    bench.image.rail.queue_limit = 4;
    assert_eq!((bench.tick(), bench.tick()), (vec![Change::WatchdogFired], vec![]));
    assert_eq!(bench.ask("03 8000 0001"), "03020000");
    bench.scan(PlcState::Run);
    assert_eq!(bench.output[..2], [0, 0]);
    bench.ask("06 8000 0008");
    assert_eq!(bench.tick(), [Change::WatchdogCleared]);
}

#[test]
fn owned_inputs_are_published_whole_with_their_quality() {
    let map: MapConfig = serde_json::from_str(
        r#"[{ "table": "holding", "at": 0, "count": 2, "area": "%IW1", "own": true },
            { "table": "holding", "at": 2, "count": 1, "area": "%IW6", "own": true },
            { "table": "holding", "at": 3, "count": 1, "area": "%MW0" }]"#,
    )
    .unwrap();
    let mut bench = Bench::new(&map, OnStop::Exception, Some(watchdog()));
    bench.tick();
    assert_eq!(bench.image.rail.inputs, [[0, 0, 0, 0, 0, 0, 2, 2]], "no data yet, but there");
    bench.scan(PlcState::Run);
    assert_eq!(bench.ask("10 0001 0002 04 1122 3344"), "1000010002");
    assert_eq!(bench.image.rail.inputs.last().unwrap()[..], [0, 0, 0x22, 0x11, 0x44, 0x33, 0, 0]);
    assert_eq!(bench.ask("03 0000 0003"), "0306000011223344");
    assert_eq!(bench.ask("10 0002 0002 04 1122 3344"), "9002", "two destinations");
    assert_eq!(bench.ask("16 0000 0000 00F0"), "160000000000F0");
    assert_eq!(bench.image.rail.inputs.last().unwrap()[..2], [0xF0, 0]);
    assert!(bench.image.rail.queue.is_empty());
    // Repeated for late readers, and marked old by the watchdog.
    let published = bench.image.rail.inputs.len();
    bench.tick();
    assert_eq!(bench.image.rail.inputs.len(), published);
    bench.after(100).tick();
    assert_eq!(bench.image.rail.inputs.len(), published + 1);
    bench.after(500).tick();
    assert_eq!(bench.image.rail.inputs.last().unwrap()[6..], [1, 1]);
    bench.scan(PlcState::Run);
    bench.ask("06 0000 0001");
    assert_eq!(bench.image.rail.inputs.last().unwrap()[6..], [0, 0]);
}
