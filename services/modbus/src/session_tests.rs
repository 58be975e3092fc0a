use super::*;
use crate::protocol::mbap::encode;
use crate::testing::{DEVICE_FRAMES, MemoryImage, hex, rows};
use proptest::prelude::*;

fn frame(transaction: u16, pdu: &str) -> Vec<u8> {
    frame_of(transaction, 1, &hex(pdu))
}

fn frame_of(transaction: u16, unit: u8, pdu: &[u8]) -> Vec<u8> {
    let mut out = [0; MAX_ADU];
    let len = encode(transaction, unit, pdu, &mut out).unwrap();
    out[..len].to_vec()
}

/// Feeds a stream in pieces and returns all answers and the last verdict.
fn feed(
    session: &mut Session,
    image: &mut MemoryImage,
    units: &UnitRule,
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
            next = session.process(units, image);
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
    feed(&mut Session::new(), &mut MemoryImage::new(100), &UnitRule::any(), bytes, usize::MAX)
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
        let (answers, _) = feed(&mut Session::new(), &mut image, &UnitRule::any(), &hex(row[3]), usize::MAX);
        assert_eq!(answers, hex(row[4]), "{row:?}");
        answered += 1;
    }
    assert_eq!(answered, 15);
}

#[test]
fn pipelined_requests_are_answered_in_order_sixteen_at_a_time() {
    let mut session = Session::new();
    let mut image = MemoryImage::new(100);
    let stream: Vec<u8> = (0..40).flat_map(|i| frame(i, "03 0000 0001")).collect();
    session.space()[..stream.len()].copy_from_slice(&stream);
    session.received(stream.len());
    let mut transactions = Vec::new();
    for (expected, answers) in [(Next::Again, 16), (Next::Again, 16), (Next::Read, 8)] {
        assert_eq!(session.process(&UnitRule::any(), &mut image), expected);
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
    let (answers, _) = feed(&mut Session::new(), &mut image, &UnitRule::any(), &stream, usize::MAX);
    assert_eq!(answers.len(), 17 * (7 + 2 + 250));
}

#[test]
fn another_protocol_is_dropped_without_an_answer() {
    let mut foreign = frame(1, "03 0000 0001");
    foreign[3] = 1;
    foreign.extend(frame(2, "03 0000 0001"));
    let mut session = Session::new();
    let (answers, next) =
        feed(&mut session, &mut MemoryImage::new(10), &UnitRule::any(), &foreign, usize::MAX);
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
    let only = UnitRule::only(&[1, 17]);
    for (rule, served) in [(UnitRule::any(), (0..=255).collect::<Vec<u8>>()), (only, vec![0, 1, 17, 255])] {
        for unit in 0..=255 {
            let mut session = Session::new();
            let stream = frame_of(1, unit, &hex("03 0000 0001"));
            let (answers, _) = feed(&mut session, &mut MemoryImage::new(10), &rule, &stream, usize::MAX);
            let pdu = if served.contains(&unit) { hex("03 02 0000") } else { hex("83 0A") };
            assert_eq!(answers, frame_of(1, unit, &pdu), "unit {unit}");
            assert_eq!(session.counts().last_unit, unit);
        }
    }
}

#[test]
fn requests_and_exceptions_are_counted() {
    let mut session = Session::new();
    let stream: Vec<u8> =
        ["03 0000 0001", "03 0000 0000", "03 FFFF 0001", "09"].iter().flat_map(|pdu| frame(1, pdu)).collect();
    feed(&mut session, &mut MemoryImage::new(10), &UnitRule::any(), &stream, usize::MAX);
    let counts = session.counts();
    assert_eq!((counts.requests, counts.exceptions, counts.last_function), (4, 3, 9));
    assert_eq!(counts.by_exception[..5], [0, 1, 1, 1, 0]);
}

proptest! {
    /// However a stream is cut, its answers are the same.
    #[test]
    fn pieces_do_not_matter(
        pdus in proptest::collection::vec(proptest::collection::vec(any::<u8>(), 1..=MAX_PDU), 1..40),
        piece in 1_usize..600,
    ) {
        let stream: Vec<u8> = pdus.iter().enumerate().flat_map(|(i, pdu)| frame_of(i as u16, 1, pdu)).collect();
        let run = |piece| {
            feed(&mut Session::new(), &mut MemoryImage::new(65536), &UnitRule::any(), &stream, piece)
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
        feed(&mut Session::new(), &mut MemoryImage::new(65536), &UnitRule::any(), &stream, piece);
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
        feed(&mut Session::new(), &mut MemoryImage::new(65536), &UnitRule::any(), &stream, piece);
    }
}
