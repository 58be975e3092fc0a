use super::*;
use crate::device::Shared;
use crate::protocol::mbap::encode;
use crate::testing::{DEVICE_FRAMES, MemoryImage, hex, matrix, rows, tcp_device};
use proptest::prelude::*;

fn frame(transaction: u16, pdu: &str) -> Vec<u8> {
    frame_of(transaction, 1, &hex(pdu))
}

fn frame_of(transaction: u16, unit: u8, pdu: &[u8]) -> Vec<u8> {
    let mut out = [0; MAX_ADU];
    let len = encode(transaction, unit, pdu, &mut out).unwrap();
    out[..len].to_vec()
}

const PEER: Peer = Peer::Ip(std::net::IpAddr::V4(std::net::Ipv4Addr::LOCALHOST));

/// Feeds a stream in pieces and returns all answers and the last verdict.
fn feed(
    session: &mut Session,
    image: &mut MemoryImage,
    device: &mut Device,
    mut bytes: &[u8],
    piece: usize,
) -> (Vec<u8>, Next) {
    let mut answers = Vec::new();
    let mut next = Next::Read;
    while !bytes.is_empty() {
        let n = bytes.len().min(piece).min(session.space().len());
        assert!(n > 0, "no room to read into");
        session.space()[..n].copy_from_slice(&bytes[..n]);
        session.received(n);
        bytes = &bytes[n..];
        loop {
            next = session.process(device, &PEER, image);
            answers.extend(session.output());
            session.sent(session.output().len());
            assert!(session.output().is_empty());
            match next {
                Next::Again => {}
                Next::Read => break,
                Next::BadLength(_) => return (answers, next),
            }
        }
    }
    (answers, next)
}

fn feed_all(bytes: &[u8]) -> (Vec<u8>, Next) {
    feed(&mut Session::default(), &mut MemoryImage::new(100), &mut tcp_device(), bytes, usize::MAX)
}

#[test]
fn device_frames_are_answered_byte_for_byte() {
    // The state each device was in when its manual's frames were taken.
    let mut answered = 0;
    for row in rows(DEVICE_FRAMES).filter(|row| row[1] == "tcp" && row[3] != "-") {
        let mut image = MemoryImage::new(0x2000);
        match (row[0], row[2]) {
            ("G", _) => {
                image.coils[1] = true;
                (image.discrete[0], image.discrete[7]) = (true, true);
                image.holding[1..4].copy_from_slice(&[0x020B, 0, 0x64]);
                image.input[0] = 0x0FFB;
            }
            _ => {
                (image.coils[0], image.discrete[0]) = (true, true);
                image.holding[..3].copy_from_slice(&[5, 6, 0]);
                image.input[..2].copy_from_slice(&[11, 22]);
            }
        }
        let (answers, _) =
            feed(&mut Session::default(), &mut image, &mut tcp_device(), &hex(row[3]), usize::MAX);
        assert_eq!(answers, hex(row[4]), "{row:?}");
        answered += 1;
    }
    assert_eq!(answered, 15);
}

#[test]
fn pipelined_requests_are_answered_in_order_sixteen_at_a_time() {
    let (mut session, mut device) = (Session::default(), tcp_device());
    let mut image = MemoryImage::new(100);
    let stream: Vec<u8> = (0..40).flat_map(|i| frame(i, "03 0000 0001")).collect();
    session.space()[..stream.len()].copy_from_slice(&stream);
    session.received(stream.len());
    let mut transactions = Vec::new();
    for (expected, answers) in [(Next::Again, 16), (Next::Again, 16), (Next::Read, 8)] {
        assert_eq!(session.process(&mut device, &PEER, &mut image), expected);
        assert_eq!(session.output().len(), answers * 11);
        transactions.extend(session.output().chunks(11).map(|a| u16::from_be_bytes([a[0], a[1]])));
        session.sent(session.output().len());
    }
    assert_eq!(transactions, (0..40).collect::<Vec<_>>());
    assert_eq!(session.counts().requests, 40);
}

#[test]
fn sixteen_of_the_largest_answers_fit_one_batch() {
    let stream: Vec<u8> = (0..17).flat_map(|i| frame(i, "03 0000 007D")).collect();
    let mut image = MemoryImage::new(1000);
    let (answers, _) = feed(&mut Session::default(), &mut image, &mut tcp_device(), &stream, usize::MAX);
    assert_eq!(answers.len(), 17 * (7 + 2 + 250));
}

#[test]
fn another_protocol_is_dropped_without_an_answer() {
    let mut foreign = frame(1, "03 0000 0001");
    foreign[3] = 1;
    foreign.extend(frame(2, "03 0000 0001"));
    let mut session = Session::default();
    let (answers, next) =
        feed(&mut session, &mut MemoryImage::new(10), &mut tcp_device(), &foreign, usize::MAX);
    assert_eq!((answers, next), (hex("0002 0000 0005 01 03 02 0000"), Next::Read));
    assert_eq!((session.counts().foreign, session.counts().requests), (1, 1));
}

#[test]
fn an_impossible_length_ends_the_stream_after_the_answers_before_it() {
    for length in [0_u16, 1, 267, 300, 0xFFFF] {
        let mut stream = frame(1, "03 0000 0001");
        stream.extend(hex("0002 0000"));
        stream.extend(length.to_be_bytes());
        stream.extend(frame(3, "03 0000 0001"));
        let (answers, next) = feed_all(&stream);
        assert_eq!(answers, hex("0001 0000 0005 01 03 02 0000"));
        assert_eq!(next, Next::BadLength(length));
    }
}

#[test]
fn trailing_and_missing_bytes_are_exception_3_and_the_next_request_is_answered() {
    for bad in [
        "03 0000 0002 00",
        "03 0000 00",
        "0F 0000 0064 01 FF",
        "0F 0000 0001 02 FFFF",
        "10 0000 0002 02 0001",
    ] {
        let mut stream = frame(1, bad);
        stream.extend(frame(2, "03 0000 0001"));
        let (answers, _) = feed_all(&stream);
        let function = hex(bad)[0] | 0x80;
        assert_eq!(answers[7..9], [function, 3], "{bad}");
        assert_eq!(answers[9..], hex("0002 0000 0005 01 03 02 0000"), "{bad}");
    }
}

#[test]
fn units() {
    let only = Device::tcp(Some(&[1, 17]), &[], Shared::open());
    for (mut rule, served) in [(tcp_device(), (0..=255).collect::<Vec<u8>>()), (only, vec![0, 1, 17, 255])] {
        for unit in 0..=255 {
            let mut session = Session::default();
            let stream = frame_of(1, unit, &hex("03 0000 0001"));
            let (answers, _) = feed(&mut session, &mut MemoryImage::new(10), &mut rule, &stream, usize::MAX);
            let pdu = if served.contains(&unit) { hex("03 02 0000") } else { hex("83 0A") };
            assert_eq!(answers, frame_of(1, unit, &pdu), "unit {unit}");
            assert_eq!(session.counts().last_unit, unit);
        }
    }
}

#[test]
fn requests_and_exceptions_are_counted() {
    let mut session = Session::default();
    let stream: Vec<u8> =
        ["03 0000 0001", "03 0000 0000", "03 FFFF 0001", "09"].iter().flat_map(|pdu| frame(1, pdu)).collect();
    feed(&mut session, &mut MemoryImage::new(10), &mut tcp_device(), &stream, usize::MAX);
    let counts = session.counts();
    assert_eq!((counts.requests, counts.exceptions, counts.last_function), (4, 3, 9));
    assert_eq!(counts.by_exception[..5], [0, 1, 1, 1, 0]);
}

#[test]
fn the_matrix_of_disagreements_is_answered_as_the_specification_says() {
    for (request, response) in matrix() {
        let mut asked = mbap::header(1, 1, 1).to_vec();
        asked[5] = request.len() as u8 + 1;
        asked.extend(&request);
        let stream = [asked, frame(2, "03 0000 0001")].concat();
        let (answers, next) = feed_all(&stream);
        let expected = [frame_of(1, 1, &response), frame(2, "03 02 0000")].concat();
        assert_eq!((answers, next), (expected, Next::Read), "{request:02X?}");
    }
}

fn rtu_of(unit: u8, pdu: &[u8]) -> Vec<u8> {
    let mut out = [0; rtu::MAX_ADU];
    let len = rtu::encode(unit, pdu, &mut out);
    out[..len].to_vec()
}

fn rtu_device() -> Device {
    Device::line(&[(1, 0)], false, Shared::open())
}

#[test]
fn the_matrix_over_rtu_on_a_stream() {
    for (request, response) in matrix() {
        let mut session = Session::new(Framing::Rtu);
        let (mut image, mut device) = (MemoryImage::new(100), rtu_device());
        let ask = |session: &mut Session, image: &mut MemoryImage, device: &mut Device, bytes: &[u8]| {
            feed(session, image, device, bytes, usize::MAX).0
        };
        // 124 registers make a frame one byte longer than the longest: it is none.
        if request.len() > MAX_PDU {
            continue;
        }
        let mut got = ask(&mut session, &mut image, &mut device, &rtu_of(1, &request));
        if session.is_waiting() {
            // More was promised than came. The silence of the line would tell at once, that of the stream later.
            session.silence();
            session.process(&mut device, &PEER, &mut image);
            got = session.output().to_vec();
        }
        assert_eq!(got, rtu_of(1, &response), "{request:02X?}");
        let good = rtu_of(1, &hex("03 0000 0001"));
        let got = ask(&mut session, &mut image, &mut device, &good);
        assert_eq!(got, rtu_of(1, &hex("03 02 0000")), "after {request:02X?}");
    }
}

#[test]
fn on_an_rtu_stream_noise_and_other_units_are_passed_over() {
    let (mut session, mut image, mut device) =
        (Session::new(Framing::Rtu), MemoryImage::new(10), rtu_device());
    let good = rtu_of(1, &hex("06 0003 0007"));
    let stream = [
        vec![0xFF; 30],
        good.clone(),
        rtu_of(9, &hex("03 0000 0002")),
        rtu_of(9, &hex("03 04 0103 0000")),
        good.clone(),
        rtu_of(0, &hex("06 0004 0009")),
    ]
    .concat();
    let (answers, _) = feed(&mut session, &mut image, &mut device, &stream, usize::MAX);
    assert_eq!(answers, [good.clone(), good].concat());
    assert_eq!(image.holding[3..5], [7, 9]);
    let counts = session.counts();
    assert_eq!((counts.requests, counts.silent, counts.foreign, counts.noise), (3, 1, 2, 30));
}

proptest! {
    /// However a stream of RTU frames is cut, its answers are the same.
    #[test]
    fn pieces_of_an_rtu_stream_do_not_matter(
        values in proptest::collection::vec((0_u16..100, any::<u16>()), 1..40), piece in 1_usize..40,
    ) {
        let frames: Vec<u8> = values
            .iter()
            .flat_map(|(address, value)| {
                let pdu = [&[16][..], &address.to_be_bytes(), &[0, 1, 2], &value.to_be_bytes()].concat();
                rtu_of(1, &pdu)
            })
            .collect();
        let mut session = Session::new(Framing::Rtu);
        let (answers, _) =
            feed(&mut session, &mut MemoryImage::new(100), &mut rtu_device(), &frames, piece);
        prop_assert_eq!(answers.len(), values.len() * 8);
        prop_assert_eq!(session.counts().noise, 0);
    }

    #[test]
    fn any_bytes_of_an_rtu_stream_never_panic(
        stream in proptest::collection::vec(prop_oneof![any::<u8>(), 0_u8..24], 0..3000), piece in 1_usize..600,
    ) {
        let mut session = Session::new(Framing::Rtu);
        let (mut image, mut device) = (MemoryImage::new(65536), rtu_device());
        feed(&mut session, &mut image, &mut device, &stream, piece);
        session.silence();
        while session.process(&mut device, &PEER, &mut image) == Next::Again {}
        prop_assert!(!session.is_waiting());
        // Some noise may have been a request to be silent.
        feed(&mut session, &mut image, &mut device, &rtu_of(1, &hex("08 0001 0000")), usize::MAX);
        let good = rtu_of(1, &hex("03 0000 0001"));
        let (answers, _) = feed(&mut session, &mut image, &mut device, &good, usize::MAX);
        prop_assert_eq!(answers.len(), 7);
    }
}

proptest! {
    /// However a stream is cut, its answers are the same.
    #[test]
    fn pieces_do_not_matter(
        pdus in proptest::collection::vec(proptest::collection::vec(any::<u8>(), 1..=MAX_PDU), 1..40),
        piece in 1_usize..600,
    ) {
        let stream: Vec<u8> = pdus.iter().enumerate().flat_map(|(i, pdu)| frame_of(i as u16, 1, pdu)).collect();
        // Listen-only mode would answer less; it has tests of its own.
        prop_assume!(!pdus.iter().any(|pdu| pdu.starts_with(&[8, 0, 4]) || pdu.starts_with(&[8, 0, 1])));
        let run = |piece| {
            feed(&mut Session::default(), &mut MemoryImage::new(65536), &mut tcp_device(), &stream, piece)
        };
        let (whole, next) = run(usize::MAX);
        prop_assert_eq!(next, Next::Read);
        prop_assert_eq!(run(piece), (whole.clone(), next));
        let mut rest = &whole[..];
        for i in 0..pdus.len() {
            let crate::protocol::mbap::Scan::Frame { frame, used } = crate::protocol::mbap::scan(rest) else {
                panic!("answer {i} is missing");
            };
            prop_assert_eq!(frame.transaction, i as u16);
            rest = &rest[used..];
        }
        prop_assert!(rest.is_empty());
    }

    #[test]
    fn any_bytes_in_any_pieces_never_panic(
        stream in proptest::collection::vec(any::<u8>(), 0..3000), piece in 1_usize..600,
    ) {
        feed(&mut Session::default(), &mut MemoryImage::new(65536), &mut tcp_device(), &stream, piece);
    }

    /// Random bytes with plausible headers, so that frames are found.
    #[test]
    fn bytes_behind_plausible_headers_never_panic(
        frames in proptest::collection::vec(
            (any::<u16>(), 0_u8..3, 0_u16..260, proptest::collection::vec(0_u8..30, 0..40)), 0..60),
        piece in 1_usize..300,
    ) {
        let mut stream = Vec::new();
        for (transaction, protocol, length, bytes) in frames {
            stream.extend(transaction.to_be_bytes());
            stream.extend([0, protocol / 2]);
            stream.extend(if length < 200 { bytes.len() as u16 } else { length }.to_be_bytes());
            stream.extend(bytes);
        }
        feed(&mut Session::default(), &mut MemoryImage::new(65536), &mut tcp_device(), &stream, piece);
    }
}
