use super::*;
use crate::device::Shared;
use crate::protocol::mbap;
use crate::testing::{DEVICE_FRAMES, MemoryImage, hex, matrix, rows, to_hex};
use proptest::prelude::*;

const WRITER: u32 = 7;

struct Bench {
    line: Line,
    image: MemoryImage,
    seq: u64,
    sent: Vec<Vec<u8>>,
    refuse: bool,
}

impl Bench {
    fn new(mode: Mode, units: &[(u8, usize)]) -> Self {
        let device = Device::line(units, false, Shared::open());
        let line = Line::new(mode, 0, device, WRITER, 1);
        Self { line, image: MemoryImage::new(0x2000), seq: 0, sent: Vec::new(), refuse: false }
    }

    fn rtu() -> Self {
        Self::new(Mode::Rtu, &[(5, 0)])
    }

    fn chunk(&mut self, flags: u32, bytes: &[u8]) {
        let header = SerialChunk { flags, ..SerialChunk::default() };
        self.take(header, bytes);
    }

    fn take(&mut self, mut header: SerialChunk, bytes: &[u8]) {
        self.seq += 1;
        (header.stamp.seq, header.stamp.generation) = (self.seq, 1);
        let (sent, refuse) = (&mut self.sent, self.refuse);
        self.line.chunk(&header, bytes, &mut self.image, &mut |frame| {
            if !refuse {
                sent.push(frame.to_vec());
            }
            !refuse
        });
    }

    /// The driver tells that an answer of this service has left.
    fn echo(&mut self, flags: u32, bytes: &[u8]) {
        let flags = flags | serial_flag::TX_ECHO;
        self.take(
            SerialChunk { flags, tx_writer: WRITER, tx_generation: 1, ..SerialChunk::default() },
            bytes,
        );
    }

    fn frame(&mut self, bytes: &[u8]) -> Vec<Vec<u8>> {
        self.chunk(serial_flag::END, bytes);
        std::mem::take(&mut self.sent)
    }
}

fn rtu_of(unit: u8, pdu: &[u8]) -> Vec<u8> {
    let mut out = [0; rtu::MAX_ADU];
    let len = rtu::encode(unit, pdu, &mut out);
    out[..len].to_vec()
}

fn ascii_of(unit: u8, pdu: &[u8]) -> Vec<u8> {
    let mut out = [0; ascii::MAX_ADU];
    let len = ascii::encode(unit, pdu, &mut out);
    out[..len].to_vec()
}

fn of(mode: Mode, unit: u8, pdu: &[u8]) -> Vec<u8> {
    match mode {
        Mode::Rtu => rtu_of(unit, pdu),
        Mode::Ascii => ascii_of(unit, pdu),
    }
}

#[test]
fn the_matrix_of_disagreements_on_both_kinds_of_line() {
    for mode in [Mode::Rtu, Mode::Ascii] {
        for (request, response) in matrix() {
            let mut bench = Bench::new(mode, &[(1, 0)]);
            let expected = vec![of(mode, 1, &response)];
            // 124 registers make a frame one byte longer than the longest: it is none.
            let expected = if request.len() > MAX_PDU { vec![] } else { expected };
            assert_eq!(bench.frame(&of_any(mode, 1, &request)), expected, "{mode:?} {request:02X?}");
            let good = of(mode, 1, &hex("03 0000 0001"));
            assert_eq!(bench.frame(&good), [of(mode, 1, &hex("03 02 0000"))], "after {request:02X?}");
        }
        // What the matrix asks of streams, on a line: units 0 and 255, and byte by byte.
        let mut bench = Bench::new(mode, &[(1, 0)]);
        assert!(bench.frame(&of(mode, 0, &hex("06 0000 0001"))).is_empty());
        assert_eq!(bench.image.holding[0], 1);
        assert!(bench.frame(&of(mode, 0, &hex("03 0000 0001"))).is_empty());
        assert!(bench.frame(&of(mode, 255, &hex("03 0000 0001"))).is_empty());
        let request = of(mode, 1, &hex("03 0000 0001"));
        let (last, first) = request.split_last().unwrap();
        for byte in first {
            bench.chunk(0, &[*byte]);
        }
        bench.chunk(serial_flag::END, &[*last]);
        assert_eq!(bench.sent, [of(mode, 1, &hex("03 02 0001"))]);
    }
}

/// A frame around any PDU, also one that is too long.
fn of_any(mode: Mode, unit: u8, pdu: &[u8]) -> Vec<u8> {
    if pdu.len() <= MAX_PDU {
        return of(mode, unit, pdu);
    }
    let mut bytes = vec![unit];
    bytes.extend(pdu);
    if mode == Mode::Rtu {
        bytes.extend(dinrail_serial::protocol::crc::crc16(&bytes).to_le_bytes());
        return bytes;
    }
    bytes.push(ascii::lrc(&bytes));
    [b":".to_vec(), to_hex(&bytes).into_bytes(), b"\r\n".to_vec()].concat()
}

#[test]
fn device_frames_are_answered_byte_for_byte() {
    let mut answered = 0;
    for row in rows(DEVICE_FRAMES).filter(|row| row[1] == "rtu" && row[4] != "-") {
        let mut bench = Bench::new(Mode::Rtu, &[(1, 0)]);
        let image = &mut bench.image;
        match row[0] {
            "G" => {
                image.coils[1] = true;
                (image.discrete[0], image.discrete[7]) = (true, true);
                image.holding[1..4].copy_from_slice(&[0x020B, 0, 0x64]);
                image.input[0] = 0x0FFB;
            }
            _ => {
                image.coils[..3].fill(true);
                image.discrete[4] = true;
                (image.holding[0], image.input[0]) = (15, 15);
            }
        }
        assert_eq!(bench.frame(&hex(row[3])), [hex(row[4])], "{row:?}");
        answered += 1;
    }
    assert_eq!(answered, 14);
}

#[test]
fn damaged_frames_are_counted_and_not_requests() {
    let mut bench = Bench::rtu();
    let good = rtu_of(5, &hex("06 0000 0001"));
    for flag in [serial_flag::PARITY, serial_flag::FRAMING, serial_flag::OVERRUN, serial_flag::BREAK] {
        bench.chunk(flag | serial_flag::END, &good);
        // The damage may lie in any chunk of the frame.
        bench.chunk(flag, &good[..3]);
        bench.chunk(serial_flag::END, &good[3..]);
    }
    let mut wrong = good.clone();
    wrong[2] ^= 1;
    bench.frame(&wrong);
    bench.frame(&good[..3]);
    bench.frame(&[&good[..], &[0; 300]].concat());
    assert!(bench.sent.is_empty() && bench.image.writes == 0);
    let counters = *bench.line.counters();
    assert_eq!((counters.parity, counters.framing, counters.overrun, counters.breaks), (2, 2, 2, 2));
    assert_eq!((counters.crc_errors, counters.malformed, counters.bus_messages), (1, 2, 0));
    // Gaps inside a frame are only counted, and the next frame is whole.
    bench.chunk(serial_flag::GAP | serial_flag::END, &good);
    assert_eq!((bench.sent.len(), bench.line.counters().gaps), (1, 1));
    bench.sent.clear();
    let told = |bench: &mut Bench, sub: &str| {
        to_hex(&bench.frame(&rtu_of(5, &hex(&format!("08 00{sub} 0000"))))[0][4..6])
    };
    assert_eq!(told(&mut bench, "0C"), "0009");
    assert_eq!(told(&mut bench, "12"), "0002");
    assert_eq!(told(&mut bench, "0B"), "0004");
}

#[test]
fn echoes_confirm_answers_and_are_never_requests() {
    let mut bench = Bench::rtu();
    let good = rtu_of(5, &hex("06 0000 0001"));
    assert_eq!(bench.frame(&good).len(), 1);
    bench.echo(serial_flag::END, &good);
    // Of another writer: the echo of a master on the same port.
    bench.take(
        SerialChunk {
            flags: serial_flag::TX_ECHO | serial_flag::END,
            tx_writer: 99,
            ..SerialChunk::default()
        },
        &good,
    );
    assert!(bench.sent.is_empty());
    // A request while an answer waits is answered; an answer that did not get out is counted.
    assert_eq!(bench.frame(&good).len(), 1);
    assert_eq!(bench.frame(&good).len(), 1);
    bench.echo(serial_flag::END, &good);
    bench.echo(serial_flag::NOT_SENT, &good);
    bench.refuse = true;
    bench.frame(&good);
    let counters = bench.line.counters();
    assert_eq!((counters.sent, counters.not_sent, counters.overlapped, counters.answers), (2, 2, 1, 4));
}

#[test]
fn an_adapter_that_sends_back_what_it_gets_does_not_make_us_talk_to_ourselves() {
    let mut bench = Bench::rtu();
    for request in ["03 0000 0002", "03 0000 0000", "11", "2B 0E 01 00"] {
        let answer = bench.frame(&rtu_of(5, &hex(request))).remove(0);
        assert!(bench.frame(&answer).is_empty(), "{request}");
    }
    assert_eq!(bench.line.counters().own_answers, 4);
}

#[test]
fn nor_do_answers_that_look_like_requests() {
    const MS: u64 = 1_000_000;
    let write = rtu_of(5, &hex("06 0001 0007"));
    let at = |bench: &mut Bench, first_ms: u64, bytes: &[u8]| {
        bench.take(
            SerialChunk { flags: serial_flag::END, first_t_ns: first_ms * MS, ..SerialChunk::default() },
            bytes,
        );
        std::mem::take(&mut bench.sent)
    };
    let timed = || {
        let mut bench = Bench::rtu();
        bench.line = bench.line.with_char_ns(MS);
        bench
    };
    // 8 bytes of 1 ms each begin to leave, and the driver tells of it.
    let left = |bench: &mut Bench, first_ms: u64, told_ms: u64| {
        let mut echo = SerialChunk {
            flags: serial_flag::TX_ECHO | serial_flag::END,
            first_t_ns: first_ms * MS,
            tx_writer: WRITER,
            tx_generation: 1,
            ..SerialChunk::default()
        };
        echo.stamp.t_ns = told_ms * MS;
        bench.take(echo, &write);
    };
    // A master may write the same value as fast as it likes, and repeat itself.
    let mut bench = timed();
    for n in 1..10 {
        assert_eq!(at(&mut bench, n * 10, &write).len(), 1);
        left(&mut bench, n * 10 + 1, n * 10 + 9);
    }
    // The driver may be late to tell that an answer has left: the line says when it had.
    assert_eq!(at(&mut bench, 150, &write).len(), 1);
    left(&mut bench, 151, 191);
    assert_eq!(at(&mut bench, 160, &write).len(), 1);
    left(&mut bench, 161, 192);
    assert_eq!((bench.image.writes, bench.line.counters().own_answers), (11, 0));
    // What began before our answer had left is that answer.
    assert_eq!(at(&mut bench, 200, &write).len(), 1);
    left(&mut bench, 201, 209);
    assert!(at(&mut bench, 205, &write).is_empty());
    // Now the adapter is known: what comes right behind is one too (a USB adapter held it back), later ones are not.
    assert_eq!(at(&mut bench, 300, &write).len(), 1);
    left(&mut bench, 301, 309);
    assert!(at(&mut bench, 325, &write).is_empty());
    assert_eq!(at(&mut bench, 400, &write).len(), 1);
    assert!(at(&mut bench, 401, &write).is_empty(), "before it is told that the answer has left");
    assert_eq!((bench.image.writes, bench.line.counters().own_answers), (14, 3));
    // An answer that is no request proves it as well.
    let mut bench = timed();
    let answer = at(&mut bench, 0, &rtu_of(5, &hex("03 0000 0001"))).remove(0);
    left(&mut bench, 1, 9);
    assert!(at(&mut bench, 15, &answer).is_empty());
    assert_eq!(at(&mut bench, 100, &write).len(), 1);
    left(&mut bench, 101, 109);
    assert!(at(&mut bench, 115, &write).is_empty());
    // Where bytes take no time, no answer proves anything by its time.
    let mut bench = Bench::rtu();
    for n in 1..10 {
        assert_eq!(at(&mut bench, n * 10, &write).len(), 1);
        left(&mut bench, n * 10, n * 10 + 20);
    }
}

#[test]
fn an_ascii_frame_that_stops_is_over() {
    let mut bench = Bench::new(Mode::Ascii, &[(5, 0)]);
    let good = ascii_of(5, &hex("06 0000 0001"));
    // The driver hands over what it has when the line was silent for its `timeout`.
    bench.chunk(serial_flag::END, &good[..6]);
    assert_eq!(bench.line.counters().malformed, 1);
    assert!(bench.frame(&good[6..]).is_empty(), "its rest is noise");
    assert_eq!(bench.frame(&good).len(), 1);
    // In parts without an end it goes on.
    bench.chunk(0, &good[..6]);
    assert_eq!(bench.frame(&good[6..]).len(), 1);
    assert_eq!(bench.line.counters().malformed, 1);
}

#[test]
fn a_colon_is_no_delimiter() {
    let mut bench = Bench::new(Mode::Ascii, &[(5, 0)]);
    assert_eq!(bench.frame(&ascii_of(5, &hex("08 0003 3A00"))), [ascii_of(5, &hex("88 03"))]);
    assert_eq!(bench.frame(&ascii_of(5, &hex("03 0000 0001"))).len(), 1);
}

#[test]
fn what_passed_while_it_was_switched_off_is_not_lost_and_nothing_waits() {
    let mut bench = Bench::rtu();
    let good = rtu_of(5, &hex("06 0000 0001"));
    assert_eq!(bench.frame(&good).len(), 1);
    // Neither the echo of its answer nor anything else is seen.
    bench.line.switched_off();
    bench.seq += 7;
    assert_eq!(bench.frame(&good).len(), 1);
    let counters = bench.line.counters();
    assert_eq!((counters.lost, counters.overlapped), (0, 0));
    // Lost otherwise, it is counted, and no answer is waited for any more.
    bench.seq += 7;
    assert_eq!(bench.frame(&good).len(), 1);
    let counters = bench.line.counters();
    assert_eq!((counters.lost, counters.overlapped), (7, 0));
}

#[test]
fn a_lost_part_makes_no_frame_of_its_neighbours() {
    let mut bench = Bench::rtu();
    let good = rtu_of(5, &hex("06 0000 0001"));
    bench.chunk(0, &good[..4]);
    bench.seq += 1;
    bench.chunk(serial_flag::END, &good[4..]);
    assert!(bench.sent.is_empty());
    assert_eq!(bench.line.counters().lost, 1);
    assert_eq!(bench.frame(&good).len(), 1);
}

#[test]
fn the_delimiter_of_ascii_can_be_changed() {
    let mut bench = Bench::new(Mode::Ascii, &[(5, 0)]);
    let change = hex("08 0003 2100");
    assert_eq!(bench.frame(&ascii_of(5, &change)), [ascii_of(5, &change)]);
    let mut request = ascii_of(5, &hex("03 0000 0001"));
    assert!(bench.frame(&request).is_empty(), "LF ends nothing any more");
    *request.last_mut().unwrap() = b'!';
    let mut answer = ascii_of(5, &hex("03 02 0000"));
    *answer.last_mut().unwrap() = b'!';
    assert_eq!(bench.frame(&request), [answer]);
    let mut restart = ascii_of(5, &hex("08 0001 0000"));
    *restart.last_mut().unwrap() = b'!';
    assert_eq!(bench.frame(&restart).len(), 1);
    assert_eq!(bench.frame(&ascii_of(5, &hex("03 0000 0001"))).len(), 1);
}

/// One thing that happens on a shared line.
#[derive(Clone, Debug)]
enum Happens {
    Noise(Vec<u8>, u32),
    /// Another slave is asked and answers.
    Dialog(u8, Vec<u8>, Vec<u8>),
    /// A request to us, cut off.
    Truncated(u16, usize),
    /// A request to us with a bit changed.
    Flipped(u16, usize),
    /// A write to us, in so many pieces.
    Request(u16, u16, usize),
    Broadcast(u16, u16),
    /// The driver tells of an answer that left.
    Echo,
}

fn happens() -> impl Strategy<Value = Happens> {
    let foreign = prop_oneof![1_u8..5, 6_u8..=247];
    let bytes = |n| proptest::collection::vec(any::<u8>(), n);
    prop_oneof![
        (bytes(0..300), prop::sample::select(&[0, serial_flag::PARITY, serial_flag::OVERRUN][..]))
            .prop_map(|(bytes, flags)| Happens::Noise(bytes, flags)),
        (foreign, bytes(1..253), bytes(1..253)).prop_map(|(unit, a, b)| Happens::Dialog(unit, a, b)),
        (0_u16..100, 1_usize..10).prop_map(|(address, cut)| Happens::Truncated(address, cut)),
        (0_u16..100, 0_usize..88).prop_map(|(address, bit)| Happens::Flipped(address, bit)),
        (0_u16..100, any::<u16>(), 1_usize..12)
            .prop_map(|(address, value, piece)| Happens::Request(address, value, piece)),
        (0_u16..100, any::<u16>()).prop_map(|(address, value)| Happens::Broadcast(address, value)),
        Just(Happens::Echo),
    ]
}

fn write_pdu(address: u16, value: u16) -> Vec<u8> {
    [&[16][..], &address.to_be_bytes(), &[0, 1, 2], &value.to_be_bytes()].concat()
}

/// Whether `bytes`, behind all that stood on the line before, end in or hold a whole frame by chance: one in 65,536 of
/// random RTU frames does, and in ASCII a stray LF completes a frame that lacked just that. Then it is one.
fn is_frame_by_chance(mode: Mode, before: &[u8], bytes: &[u8]) -> bool {
    if mode == Mode::Rtu {
        return rtu::is_frame(bytes);
    }
    let mut receiver = Receiver::default();
    for &character in before {
        receiver.push(character);
    }
    let whole = bytes.iter().map(|&character| receiver.push(character) == Received::Frame);
    whole.fold(false, |any, one| any | one)
}

/// Plays the line and says what must have been answered.
fn play(mode: Mode, all: &[Happens]) -> (Bench, Vec<Vec<u8>>, Vec<u16>) {
    let mut bench = Bench::new(mode, &[(5, 0)]);
    let (mut expected, mut holding, mut echoed) = (Vec::new(), vec![0_u16; 100], 0);
    // What stood on the line, for the ASCII receiver that goes on over chunks.
    let mut stood: Vec<u8> = Vec::new();
    for one in all {
        match one {
            Happens::Noise(bytes, flags) => {
                if !is_frame_by_chance(mode, &stood, bytes) {
                    bench.chunk(flags | serial_flag::END, bytes);
                    stood.extend(bytes);
                }
            }
            Happens::Dialog(unit, request, answer) => {
                bench.chunk(serial_flag::END, &of(mode, *unit, request));
                bench.chunk(serial_flag::END, &of(mode, *unit, answer));
                stood.clear();
            }
            Happens::Truncated(address, cut) => {
                let frame = of(mode, 5, &write_pdu(*address, 0xDEAD));
                let cut_off = &frame[..frame.len() - (*cut).min(frame.len() - 1)];
                if !is_frame_by_chance(mode, &stood, cut_off) {
                    bench.chunk(serial_flag::END, cut_off);
                    stood.extend(cut_off);
                }
            }
            Happens::Flipped(address, bit) => {
                let mut frame = of(mode, 5, &write_pdu(*address, 0xDEAD));
                frame[bit / 8] ^= 1 << (bit % 8);
                bench.chunk(serial_flag::END, &frame);
            }
            Happens::Request(address, value, piece) => {
                let frame = of(mode, 5, &write_pdu(*address, *value));
                let pieces = frame.chunks(*piece).count();
                for (i, part) in frame.chunks(*piece).enumerate() {
                    bench.chunk(if i + 1 == pieces { serial_flag::END } else { 0 }, part);
                }
                let pdu = [&[16][..], &address.to_be_bytes(), &[0, 1]].concat();
                expected.push(of(mode, 5, &pdu));
                stood.clear();
                holding[usize::from(*address)] = *value;
            }
            Happens::Broadcast(address, value) => {
                bench.chunk(serial_flag::END, &of(mode, 0, &write_pdu(*address, *value)));
                stood.clear();
                holding[usize::from(*address)] = *value;
            }
            Happens::Echo if echoed < bench.sent.len() => {
                let frame = bench.sent[echoed].clone();
                echoed += 1;
                bench.echo(serial_flag::END, &frame);
            }
            Happens::Echo => {}
        }
    }
    (bench, expected, holding)
}

proptest! {
    #[test]
    fn on_a_shared_line_every_request_is_answered_exactly_once_and_right(
        all in proptest::collection::vec(happens(), 0..60), ascii: bool,
    ) {
        let mode = if ascii { Mode::Ascii } else { Mode::Rtu };
        // An ASCII character changed to another case is the same digit.
        let all: Vec<Happens> = all
            .into_iter()
            .filter(|one| mode == Mode::Rtu || !matches!(one, Happens::Flipped(..)))
            .collect();
        let (bench, expected, holding) = play(mode, &all);
        prop_assert_eq!(&bench.sent, &expected);
        prop_assert_eq!(&bench.image.holding[..100], &holding[..]);
    }

    #[test]
    fn any_chunks_never_panic(
        chunks in proptest::collection::vec((any::<u32>(), proptest::collection::vec(any::<u8>(), 0..600)), 0..40),
        ascii: bool,
    ) {
        let mut bench = Bench::new(if ascii { Mode::Ascii } else { Mode::Rtu }, &[(5, 0), (6, 1)]);
        for (flags, bytes) in chunks {
            bench.chunk(flags, &bytes);
        }
        // And it still works.
        bench.chunk(serial_flag::END, b"");
        let mode = if ascii { Mode::Ascii } else { Mode::Rtu };
        bench.sent.clear();
        bench.chunk(serial_flag::END, &of(mode, 5, &hex("08 0001 0000")));
        bench.sent.clear();
        let good = of(mode, 5, &hex("03 0000 0001"));
        bench.chunk(serial_flag::END, &good);
        prop_assert!(ascii || bench.sent.len() == 1);
    }
}

#[test]
fn the_longest_frame_fits() {
    let mut pdu = hex("10 0000 007B F6");
    pdu.extend([0; 246]);
    assert_eq!(pdu.len(), 252);
    assert_eq!(mbap::MAX_ADU, 260);
    for mode in [Mode::Rtu, Mode::Ascii] {
        let mut bench = Bench::new(mode, &[(5, 0)]);
        assert_eq!(bench.frame(&of(mode, 5, &pdu)), [of(mode, 5, &hex("10 0000 007B"))]);
        assert_eq!(
            bench.frame(&of(mode, 5, &hex("03 0000 007D"))),
            [of(mode, 5, &[&[3, 250][..], &[0; 250]].concat())]
        );
    }
}
