//! Nothing is allocated between a request and its answer, whatever the request is.

use dinrail_iec::Addressing;
use dinrail_modbus::config::OnStop;
use dinrail_modbus::device::{Device, Shared};
use dinrail_modbus::line::{Line, Mode};
use dinrail_modbus::map_config::MapConfig;
use dinrail_modbus::process_image::{NotQueued, ProcessImage, Rail};
use dinrail_modbus::protocol::{ascii, mbap, rtu};
use dinrail_modbus::rights::Peer;
use dinrail_modbus::session::{Next, Session};
use dinrail_modbus::tcp::Backend;
use dinrail_modbus::view::View;
use ipc_types::image_write::Builder;
use ipc_types::payload::{Image, PlcState, SerialChunk, serial_flag};
use ipc_types::testing::allocations::{Counting, allocations};
use ipc_types::wiring::AreaSizes;

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// A PLC that takes every write with its next image.
struct Plc {
    now_ns: u64,
    seq: u64,
    tail: Vec<u8>,
}

impl Rail for Plc {
    fn now_ns(&self) -> u64 {
        self.now_ns
    }
    fn newest(&mut self, take: &mut dyn FnMut(&Image, &[u8])) {
        self.now_ns += 1_000_000;
        let bytes = self.tail.len() as u32 / 3;
        let mut header = Image {
            state: PlcState::Run as u32,
            input_bytes: bytes,
            output_bytes: bytes,
            marker_bytes: bytes,
            n: bytes * 3,
            ..Image::default()
        };
        header.stamp.t_ns = self.now_ns;
        (header.ack_writer[0], header.ack_generation[0]) = (1, 1);
        // Some writes always wait, so that the overlay is at work.
        header.ack_seq[0] = self.seq.saturating_sub(5);
        take(&header, &self.tail);
    }
    fn write(&mut self, _: &Builder) -> Result<u64, NotQueued> {
        self.seq += 1;
        Ok(self.seq)
    }
    fn publish_inputs(&mut self, _: u32, _: u64, _: &[u8]) -> bool {
        true
    }
}

#[test]
fn requests_allocate_nothing() {
    let map: MapConfig = serde_json::from_str(
        r#"[ { "table": "holding", "at": 0, "count": 1000, "area": "%MD0", "word_order": "high_first" },
             { "table": "holding", "at": 1000, "count": 100, "area": "%IW0", "own": true },
             { "table": "coils", "at": 0, "count": 4000, "area": "%QX0.1" },
             { "table": "input", "at": 0, "count": 100, "area": "%IW0" } ]"#,
    )
    .unwrap();
    let map = map.build(AreaSizes::MAX, Addressing::Element).unwrap();
    let plc = Plc { now_ns: 0, seq: 0, tail: vec![0; 3 * 4096] };
    let mut image = ProcessImage::new(plc, View::new(1, 1, 200_000_000), map, OnStop::Exception, None);
    let requests: [&[u8]; 20] = [
        &[3, 0, 1, 0, 100],
        &[4, 0, 0, 0, 10],
        &[1, 0, 3, 7, 0],
        &[5, 0, 3, 0xFF, 0],
        &[6, 0, 7, 1, 2],
        &[6, 3, 0xE9, 1, 2],
        &[15, 0, 3, 0, 10, 2, 0xCD, 1],
        &[16, 0, 1, 0, 2, 4, 1, 2, 3, 4],
        &[22, 0, 1, 0, 0xF2, 0, 0x25],
        &[23, 0, 0, 0, 20, 0, 3, 0, 1, 2, 9, 9],
        &[3, 0xFF, 0xFF, 0, 2],
        &[43, 14, 1, 0],
        &[7],
        &[8, 0, 0, 1, 2],
        &[11],
        &[12],
        &[17],
        &[20, 7, 6, 0, 1, 0, 0, 0, 2],
        &[21, 9, 6, 0, 1, 0, 0, 0, 1, 1, 2],
        &[24, 0, 0],
    ];
    let stream: Vec<u8> = requests
        .iter()
        .flat_map(|pdu| {
            let mut frame = [0; mbap::MAX_ADU];
            let len = mbap::encode(1, 1, pdu, &mut frame).unwrap();
            frame[..len].to_vec()
        })
        .collect();
    let mut device = Device::tcp(Some(&[1]), &[], Shared::open());
    let peer = Peer::Ip(std::net::IpAddr::V4(std::net::Ipv4Addr::LOCALHOST));
    let mut session = Session::default();
    let mut answers = 0;
    let allocated = allocations(|| {
        for _ in 0..1000 {
            session.space()[..stream.len()].copy_from_slice(&stream);
            session.received(stream.len());
            image.begin();
            // Sixteen at a time.
            for next in [Next::Again, Next::Read] {
                assert_eq!(session.process(&mut device, &peer, &mut image), next);
                answers += session.output().len();
                session.sent(session.output().len());
            }
        }
    });
    assert_eq!(allocated, 0);
    assert!(answers > 1000 * 20 * 9);
    // Beyond the map, no file, no queue.
    assert_eq!((session.counts().requests, session.counts().exceptions), (20_000, 4_000));
    assert!(image.view().pending() > 0);

    // The same on a serial line, both ways of framing.
    for mode in [Mode::Rtu, Mode::Ascii] {
        let device = Device::line(&[(1, 0)], true, Shared::open());
        let mut line = Line::new(mode, 0, device, 1, 1);
        let frames: Vec<Vec<u8>> = requests.iter().map(|pdu| serial_frame(mode, pdu)).collect();
        let (mut sent, mut seq) = (0, 0);
        let allocated = allocations(|| {
            for frame in frames.iter().cycle().take(2000) {
                seq += 1;
                let mut chunk = SerialChunk { flags: serial_flag::END, ..SerialChunk::default() };
                chunk.stamp.seq = seq;
                image.begin();
                line.chunk(&chunk, frame, &mut image, &mut |answer| {
                    sent += answer.len();
                    true
                });
            }
        });
        assert_eq!(allocated, 0, "{mode:?}");
        assert!(sent > 2000 * 5, "{mode:?}");
    }
}

fn serial_frame(mode: Mode, pdu: &[u8]) -> Vec<u8> {
    if mode == Mode::Rtu {
        let mut out = [0; rtu::MAX_ADU];
        let len = rtu::encode(1, pdu, &mut out);
        return out[..len].to_vec();
    }
    let mut out = [0; ascii::MAX_ADU];
    let len = ascii::encode(1, pdu, &mut out);
    out[..len].to_vec()
}
