//! A Modbus TCP connection in front of a process image: every whole request gets exactly one answer, in order,
//! and the answer can be one to it. The first byte chooses map, units and PLC state, the second how the stream is
//! cut.

#![no_main]

use dinrail_iec::Addressing;
use dinrail_modbus::config::OnStop;
use dinrail_modbus::device::{Device, Shared};
use dinrail_modbus::map::RegisterMap;
use dinrail_modbus::map_config::Preset;
use dinrail_modbus::process_image::{NotQueued, ProcessImage, Rail};
use dinrail_modbus::protocol::decode_response;
use dinrail_modbus::protocol::mbap::{self, Frame, Scan};
use dinrail_modbus::protocol::pdu::{EXCEPTION_BIT, Exception, MAX_PDU, decode_request};
use dinrail_modbus::rights::Peer;
use dinrail_modbus::session::{MAX_BATCH, Next, Session};
use dinrail_modbus::tcp::Backend;
use dinrail_modbus::view::View;
use ipc_types::image_write::{self, Builder};
use ipc_types::payload::{self, PlcState};
use ipc_types::wiring::{Area, AreaSizes};
use libfuzzer_sys::fuzz_target;

const AREA: usize = 64;
const WRITER: u32 = 7;

/// A PLC that applies each write at once and shows the image before the next batch.
struct Plc {
    state: PlcState,
    memory: [u8; 3 * AREA],
    now_ns: u64,
    seq: u64,
}

impl Rail for Plc {
    fn now_ns(&self) -> u64 {
        self.now_ns
    }

    fn newest(&mut self, take: &mut dyn FnMut(&payload::Image, &[u8])) {
        self.now_ns += 1_000_000;
        let area = AREA as u32;
        let mut header = payload::Image {
            state: self.state as u32,
            input_bytes: area,
            output_bytes: area,
            marker_bytes: area,
            n: 3 * area,
            ..payload::Image::default()
        };
        (header.stamp.t_ns, header.stamp.generation) = (self.now_ns, 1);
        (header.ack_writer[0], header.ack_generation[0], header.ack_seq[0]) = (WRITER, 1, self.seq);
        take(&header, &self.memory);
    }

    fn write(&mut self, write: &Builder) -> Result<u64, NotQueued> {
        let (output, marker) = self.memory[AREA..].split_at_mut(AREA);
        for op in image_write::parse(write.tail()).unwrap() {
            // What the map lets through lies within the areas, and never in %I.
            let done = match op.area() {
                Area::Output => op.apply(output),
                Area::Marker => op.apply(marker),
                Area::Input => false,
            };
            assert!(done, "{op:?}");
        }
        self.seq += 1;
        Ok(self.seq)
    }

    fn publish_inputs(&mut self, _: u32, _: u64, _: &[u8]) -> bool {
        true
    }
}

fn image(mode: u8) -> ProcessImage<Plc> {
    let bit = |n: u8| mode >> n & 1 == 1;
    let area = AREA as u32;
    let sizes = AreaSizes { input: area, output: area, marker: area };
    let preset = if bit(0) { Preset::Openplc } else { Preset::Dinrail };
    let addressing = if bit(0) { Addressing::OpenPlc } else { Addressing::Element };
    let on_stop = if bit(1) { OnStop::Hold } else { OnStop::Exception };
    let state = if bit(2) { PlcState::Stop } else { PlcState::Run };
    let plc = Plc { state, memory: [0; 3 * AREA], now_ns: 1, seq: 0 };
    let view = View::new(WRITER, 1, 200_000_000);
    ProcessImage::new(plc, view, RegisterMap::preset(preset, sizes, addressing), on_stop, None)
}

/// The whole requests of a stream, up to where it cannot be read any more.
fn requests(mut stream: &[u8]) -> Vec<Frame<'_>> {
    let mut found = Vec::new();
    loop {
        match mbap::scan(stream) {
            Scan::Frame { frame, used } => {
                found.push(frame);
                stream = &stream[used..];
            }
            Scan::Foreign { used } => stream = &stream[used..],
            Scan::Incomplete | Scan::BadLength { .. } => return found,
        }
    }
}

fn answers(mut stream: &[u8], piece: usize, device: &mut Device, image: &mut ProcessImage<Plc>) -> Vec<u8> {
    let mut session = Session::default();
    let peer = Peer::Ip(std::net::IpAddr::V4(std::net::Ipv4Addr::LOCALHOST));
    let mut answers = Vec::new();
    while !stream.is_empty() {
        let n = stream.len().min(piece).min(session.space().len());
        assert!(n > 0, "no room to read into");
        session.space()[..n].copy_from_slice(&stream[..n]);
        session.received(n);
        stream = &stream[n..];
        loop {
            image.begin();
            let next = session.process(device, &peer, image);
            assert!(session.output().len() <= MAX_BATCH * mbap::MAX_ADU);
            answers.extend_from_slice(session.output());
            session.sent(session.output().len());
            match next {
                Next::Again => {}
                Next::Read => break,
                Next::BadLength(_) => return answers,
            }
        }
    }
    answers
}

fuzz_target!(|data: &[u8]| {
    let &[mode, piece, ref stream @ ..] = data else { return };
    let only: Option<&[u8]> = if mode & 8 == 0 { None } else { Some(&[1, 17]) };
    let mut device = Device::tcp(only, &[], Shared::open());
    // Listen-only mode answers less; the fuzz target of the serial line has it.
    let silent = |frame: &Frame<'_>| matches!(frame.pdu, [8, 0, 1 | 4, ..]);
    if requests(stream).iter().any(silent) {
        return;
    }
    let answered = answers(stream, usize::from(piece) + 1, &mut device, &mut image(mode));
    let mut rest = &answered[..];
    for asked in requests(stream) {
        let Scan::Frame { frame, used } = mbap::scan(rest) else { panic!("{asked:?} has no answer") };
        rest = &rest[used..];
        assert_eq!((frame.transaction, frame.unit), (asked.transaction, asked.unit));
        assert!(frame.pdu.len() <= MAX_PDU);
        match decode_request(asked.pdu) {
            Ok(request) => drop(decode_response(&request, frame.pdu).unwrap()),
            Err(refused) => {
                let served = device.serves(asked.unit);
                let why = if served { refused.exception } else { Exception::GatewayPathUnavailable };
                assert_eq!(frame.pdu, [refused.function | EXCEPTION_BIT, why.code()]);
            }
        }
    }
    assert!(rest.is_empty(), "an answer without a request");
});
