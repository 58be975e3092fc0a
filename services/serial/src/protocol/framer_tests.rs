//! Frames under any chunking of reads, with noise, gaps and broken senders.

use super::answer::Expected;
use super::framer::*;
use super::timing::Timing;
use super::{crc, length};
use ipc_types::payload::serial_flag::{END, GAP, OVERRUN, PARITY};
use proptest::prelude::*;

const MS: u64 = 1_000_000;

#[derive(Debug, Clone, PartialEq, Eq)]
struct Seen {
    flags: u32,
    bytes: Vec<u8>,
}

struct Line {
    framer: Framer,
    seen: Vec<Seen>,
    ends: Vec<(u64, u64)>,
}

fn settings(mode: Mode) -> Settings {
    let timing = Timing::new(9600, 11);
    let max_frame = match mode {
        Mode::Rtu { .. } => length::MAX_RTU,
        Mode::Ascii => MAX_ASCII,
        _ => 3000,
    };
    Settings { mode, timing, silence_ns: timing.t35_ns, timeout_ns: 1000 * MS, max_frame, timed: true }
}

impl Line {
    fn new(settings: Settings) -> Self {
        Self { framer: Framer::new(settings), seen: Vec::new(), ends: Vec::new() }
    }
    fn rtu(grace_ns: u64) -> Self {
        Self::new(settings(Mode::Rtu { strict_t15: false, grace_ns }))
    }
    fn push(&mut self, t: u64, bytes: &[u8]) {
        let Self { framer, seen, ends } = self;
        framer.push(t, bytes, &mut |c| {
            seen.push(Seen { flags: c.flags, bytes: c.bytes.to_vec() });
            ends.push((c.first_ns, c.end_ns));
        });
    }
    fn turn(&mut self, t: u64) {
        let Self { framer, seen, ends } = self;
        framer.turn(t, &mut |c| {
            seen.push(Seen { flags: c.flags, bytes: c.bytes.to_vec() });
            ends.push((c.first_ns, c.end_ns));
        });
    }
    fn good(&self) -> Vec<Vec<u8>> {
        self.seen.iter().filter(|s| crc::fits(&s.bytes)).map(|s| s.bytes.clone()).collect()
    }
}

fn frame(bytes: &[u8]) -> Vec<u8> {
    let mut frame = bytes.to_vec();
    frame.extend(crc::crc16(bytes).to_le_bytes());
    frame
}

fn seen(flags: u32, bytes: &[u8]) -> Seen {
    Seen { flags, bytes: bytes.to_vec() }
}

#[test]
fn silence_ends_an_rtu_frame() {
    let mut line = Line::rtu(0);
    let request = frame(&[1, 3, 0, 0, 0, 2]);
    line.push(100 * MS, &request);
    assert!(line.seen.is_empty());
    let due = line.framer.deadline().unwrap();
    assert_eq!(due, 100 * MS + Timing::new(9600, 11).t35_ns);
    line.turn(due - 1);
    assert!(line.seen.is_empty());
    line.turn(due);
    assert_eq!(line.seen, [seen(END, &request)]);
    // Eight characters before the read that brought them.
    assert_eq!(line.ends[0], (100 * MS - 8 * Timing::new(9600, 11).char_ns, due));
    assert_eq!(line.framer.deadline(), None);
    assert_eq!(line.framer.counters().frames, 1);
}

#[test]
fn a_late_thread_still_sees_the_silence_between_two_reads() {
    let mut line = Line::rtu(0);
    let (a, b) = (frame(&[1, 100, 7]), frame(&[2, 101, 8]));
    line.push(100 * MS, &a);
    line.push(200 * MS, &b);
    line.turn(300 * MS);
    assert_eq!(line.seen, [seen(END, &a), seen(END, &b)]);
}

#[test]
fn gaps_are_counted_and_reject_only_when_strict() {
    let request = frame(&[1, 3, 0, 0, 0, 2]);
    for strict in [false, true] {
        let mut line = Line::new(settings(Mode::Rtu { strict_t15: strict, grace_ns: 0 }));
        let char_ns = Timing::new(9600, 11).char_ns;
        line.push(100 * MS, &request[..4]);
        // Four characters and two of silence.
        line.push(100 * MS + 6 * char_ns, &request[4..]);
        line.turn(200 * MS);
        let expected = if strict { vec![] } else { vec![seen(END | GAP, &request)] };
        assert_eq!(line.seen, expected);
        let counters = line.framer.counters();
        assert_eq!((counters.t15_gaps, counters.rejected_t15), (1, u64::from(strict)));
        // The next frame bears no mark.
        line.push(300 * MS, &request);
        line.turn(400 * MS);
        assert_eq!(line.seen.last(), Some(&seen(END, &request)));
    }
}

#[test]
fn a_frame_in_parts_is_waited_for_as_long_as_the_grace() {
    let answer = frame(&[1, 3, 8, 0, 1, 0, 2, 0, 3, 0, 4]);
    let mut line = Line::rtu(20 * MS);
    line.push(100 * MS, &answer[..5]);
    line.turn(110 * MS);
    assert!(line.seen.is_empty());
    assert_eq!(line.framer.deadline(), Some(120 * MS));
    line.push(119 * MS, &answer[5..]);
    line.turn(124 * MS);
    assert_eq!(line.seen, [seen(END | GAP, &answer)]);
    assert_eq!(line.framer.counters().late, 1);
    // A whole frame is not kept waiting.
    line.push(200 * MS, &answer);
    line.turn(205 * MS);
    assert_eq!(line.seen.len(), 2);
    // Nor is what can be no beginning.
    line.push(300 * MS, &[1, 3, 0, 9, 9, 9, 9, 9, 9, 9, 9]);
    line.turn(305 * MS);
    assert_eq!(line.seen.len(), 3);
}

#[test]
fn after_a_torn_frame_the_next_one_is_found() {
    for grace in [0, 20 * MS] {
        let mut line = Line::rtu(grace);
        let request = frame(&[7, 3, 0, 0, 0, 2]);
        line.push(100 * MS, &request[..5]);
        line.turn(106 * MS);
        line.push(115 * MS, &request);
        line.turn(160 * MS);
        assert_eq!(line.good(), std::slice::from_ref(&request), "grace {grace}");
        assert_eq!(line.seen[0].bytes, &request[..5]);
        let counters = line.framer.counters();
        assert_eq!((counters.frames, counters.crc_errors), (1, 1));
    }
}

#[test]
fn noise_without_end_is_cut_and_silence_heals() {
    let mut line = Line::rtu(20 * MS);
    let char_ns = Timing::new(9600, 11).char_ns;
    let mut t = 100 * MS;
    for _ in 0..500 {
        t += 10 * char_ns;
        line.push(t, &[0xAA; 10]);
    }
    assert_eq!(line.seen.len(), 1);
    assert_eq!((line.seen[0].bytes.len(), line.seen[0].flags), (256, END | OVERRUN));
    let counters = line.framer.counters();
    assert_eq!((counters.bytes, counters.too_long), (5000, 1));
    assert_eq!(counters.bytes_cut, 5000 - 256);
    line.turn(t + 100 * MS);
    let request = frame(&[1, 6, 0, 1, 0, 2]);
    line.push(t + 200 * MS, &request);
    line.turn(t + 300 * MS);
    assert_eq!(line.good(), [request]);
}

#[test]
fn a_backlog_longer_than_the_buffer_keeps_its_frames() {
    let mut line =
        Line::new(Settings { timed: false, ..settings(Mode::Rtu { strict_t15: false, grace_ns: 0 }) });
    let answer = frame(&[&[1u8, 3, 100][..], &[5; 100]].concat());
    let all: Vec<u8> = std::iter::repeat_n(answer.clone(), 30).flatten().collect();
    line.push(100 * MS, &all);
    line.turn(200 * MS);
    assert_eq!(line.good(), vec![answer; 30]);
}

#[test]
fn a_frame_behind_a_buffer_full_of_beginnings_is_found() {
    // Four pieces of noise, each of which may be the beginning of a longer frame, fill the buffer but for a part of
    // the good frame behind them.
    let answer = frame(&[&[1u8, 3, 200][..], &[5; 200]].concat());
    let char_ns = Timing::new(9600, 11).char_ns;
    for last in [210, 230, 255] {
        let mut line = Line::rtu(20 * MS);
        let mut t = 1000 * MS;
        for len in [255, 255, 255, last] {
            let mut noise = vec![0x77; len];
            noise[1] = 99;
            t += len as u64 * char_ns;
            line.push(t, &noise);
            t += 10 * MS;
            line.turn(t);
        }
        assert!(line.seen.is_empty(), "all of it is kept");
        t += answer.len() as u64 * char_ns;
        line.push(t, &answer);
        line.turn(t + 100 * MS);
        assert_eq!(line.good(), std::slice::from_ref(&answer), "{last}");
    }
}

#[test]
fn line_errors_mark_their_frame() {
    let mut line = Line::rtu(0);
    let request = frame(&[1, 6, 0, 1, 0, 2]);
    line.framer.mark(PARITY);
    line.push(100 * MS, &request);
    line.turn(200 * MS);
    line.push(300 * MS, &request);
    line.turn(400 * MS);
    assert_eq!(line.seen, [seen(END | PARITY, &request), seen(END, &request)]);
}

#[test]
fn ascii_frames() {
    let mut line = Line::new(settings(Mode::Ascii));
    line.push(MS, b"junk:0103");
    line.push(900 * MS, b"00FC\r\n:01:020400FA\r\n\r\n");
    let all = [
        seen(END, b"junk"),
        seen(END, b":010300FC\r\n"),
        seen(END, b":01"),
        seen(END, b":020400FA\r\n"),
        seen(END, b"\r\n"),
    ];
    assert_eq!(line.seen, all);
    // A frame that stops is given up after the timeout.
    line.push(2000 * MS, b":0103");
    line.turn(2999 * MS);
    assert_eq!(line.seen.len(), 5);
    line.turn(3000 * MS);
    assert_eq!(line.seen[5], seen(END, b":0103"));
    // The longest frame, and one that is too long.
    line.push(4000 * MS, &[&b":"[..], &[b'0'; 510], b"\r\n"].concat());
    assert_eq!((line.seen[6].bytes.len(), line.seen[6].flags), (513, END));
    line.push(5000 * MS, &[&b":"[..], &[b'0'; 600], b"\r\n:01\r\n"].concat());
    assert_eq!((line.seen[7].bytes.len(), line.seen[7].flags), (513, END | OVERRUN));
    assert_eq!(line.seen[8], seen(END, b":01\r\n"));
    // With another delimiter than LF; one that is lost, and CR where none belongs.
    line.push(6000 * MS, b":0103FC\r!:0203\r:0304F9\r\n:04\r05\r\n");
    assert_eq!(
        line.seen[9..],
        [
            seen(END, b":0103FC\r!"),
            seen(END, b":0203\r"),
            seen(END, b":0304F9\r\n"),
            seen(END, b":04\r0"),
            seen(END, b"5\r\n"),
        ]
    );
}

#[test]
fn delimiters_lengths_silences_raw() {
    let mut line = Line::new(settings(Mode::delimiter(b"\r\n").unwrap()));
    line.push(MS, b"one\r\ntwo\r");
    line.push(2 * MS, b"\nthree");
    line.turn(1002 * MS);
    assert_eq!(line.seen, [seen(END, b"one\r\n"), seen(END, b"two\r\n"), seen(END, b"three")]);
    assert!(Mode::delimiter(b"").is_none() && Mode::delimiter(b"123456789").is_none());

    let mut line = Line::new(settings(Mode::Length(4)));
    line.push(MS, b"aaaabbbbcc");
    line.turn(1001 * MS);
    assert_eq!(line.seen, [seen(END, b"aaaa"), seen(END, b"bbbb"), seen(END, b"cc")]);

    let mut line = Line::new(settings(Mode::Silence));
    line.push(100 * MS, b"hello ");
    line.push(103 * MS, b"you");
    line.turn(200 * MS);
    assert_eq!(line.seen, [seen(END, b"hello you")]);

    let mut line = Line::new(settings(Mode::Raw));
    line.push(100 * MS, b"hello ");
    line.push(103 * MS, &[7; 1500]);
    assert_eq!(line.seen, [seen(0, b"hello "), seen(0, &[7; 1024]), seen(0, &[7; 476])]);
}

#[test]
fn long_frames_travel_in_parts() {
    let mut line = Line::new(settings(Mode::delimiter(b"\n").unwrap()));
    let long = [&[b'x'; 2500][..], b"\n"].concat();
    line.push(MS, &long);
    let parts: Vec<(usize, u32)> = line.seen.iter().map(|s| (s.bytes.len(), s.flags)).collect();
    assert_eq!(parts, [(1024, 0), (1024, 0), (453, END)]);
    line.seen.clear();
    // Beyond the longest: cut, and the delimiter heals.
    line.push(2 * MS, &[b'y'; 5000]);
    line.push(3 * MS, b"\nok\n");
    let all: Vec<u8> = line.seen.iter().flat_map(|s| s.bytes.clone()).collect();
    assert_eq!(all.len(), 3000 + 3);
    assert_eq!(line.seen.last(), Some(&seen(END, b"ok\n")));
    assert!(line.seen.iter().any(|s| s.flags == END | OVERRUN));
}

#[test]
fn a_port_that_goes_gives_up_its_frame() {
    let mut line = Line::rtu(0);
    line.push(MS, &[1, 2, 3]);
    let Line { framer, seen: all, .. } = &mut line;
    framer.reset(2 * MS, &mut |c| all.push(Seen { flags: c.flags, bytes: c.bytes.to_vec() }));
    assert_eq!(line.seen, [seen(END, &[1, 2, 3])]);
    assert!(!line.framer.is_receiving());
}

fn any_mode() -> impl Strategy<Value = Mode> {
    prop_oneof![
        (any::<bool>(), 0..50 * MS).prop_map(|(strict_t15, grace_ns)| Mode::Rtu { strict_t15, grace_ns }),
        Just(Mode::Ascii),
        Just(Mode::delimiter(b"\r\n").unwrap()),
        Just(Mode::delimiter(b"12345678").unwrap()),
        (1usize..3000).prop_map(Mode::Length),
        Just(Mode::Silence),
        Just(Mode::Raw),
    ]
}

fn any_frame() -> impl Strategy<Value = Vec<u8>> {
    prop_oneof![
        (1u8..247, any::<[u8; 4]>()).prop_map(|(unit, d)| frame(&[&[unit, 3][..], &d].concat())),
        (1u8..247, prop::collection::vec(any::<u8>(), 1..250))
            .prop_map(|(unit, d)| frame(&[&[unit, 4, d.len() as u8][..], &d].concat())),
        (1u8..247, 65u8..72, prop::collection::vec(any::<u8>(), 0..200))
            .prop_map(|(unit, f, d)| frame(&[&[unit, f][..], &d].concat())),
    ]
}

proptest! {
    #[test]
    fn never_panics_and_loses_nothing_uncounted(
        mode in any_mode(),
        reads in prop::collection::vec((0..30 * MS, prop::collection::vec(any::<u8>(), 0..400)), 0..20),
        timed in any::<bool>(),
    ) {
        let mut line = Line::new(Settings { timed, ..settings(mode) });
        let mut t = 0;
        let mut sent = 0u64;
        for (wait, bytes) in reads {
            t += wait;
            line.push(t, &bytes);
            sent += bytes.len() as u64;
        }
        line.turn(t + 10_000 * MS);
        let strict = matches!(mode, Mode::Rtu { strict_t15: true, .. });
        let got: u64 = line.seen.iter().map(|s| s.bytes.len() as u64).sum();
        let counters = line.framer.counters();
        prop_assert_eq!(counters.bytes, sent);
        if !strict {
            prop_assert_eq!(got + counters.bytes_cut, sent);
        }
        prop_assert!(!line.framer.is_receiving());
        prop_assert!(line.ends.iter().all(|(first, end)| first <= end));
    }

    #[test]
    fn rtu_frames_under_any_chunking(
        frames in prop::collection::vec(any_frame(), 1..6),
        cuts in prop::collection::vec(1usize..40, 1..20),
        grace in prop_oneof![Just(0), Just(20 * MS)],
    ) {
        let mut line = Line::rtu(grace);
        let char_ns = Timing::new(9600, 11).char_ns;
        let mut t = 100 * MS;
        for frame in &frames {
            let mut rest = &frame[..];
            let mut cut = cuts.iter().cycle();
            while !rest.is_empty() {
                let n = rest.len().min(*cut.next().unwrap());
                t += n as u64 * char_ns;
                line.push(t, &rest[..n]);
                rest = &rest[n..];
            }
            t += 40 * MS;
            line.turn(t);
        }
        prop_assert_eq!(line.seen.iter().map(|s| s.bytes.clone()).collect::<Vec<_>>(), frames);
    }

    #[test]
    fn after_any_noise_a_silence_and_a_frame_is_found(
        noise in prop::collection::vec(prop::collection::vec(any::<u8>(), 0..400), 1..5),
        frame in any_frame(),
        gap in 8 * MS..60 * MS,
        grace in prop_oneof![Just(0), Just(20 * MS)],
    ) {
        let mut line = Line::rtu(grace);
        let mut t = 1000 * MS;
        for bytes in &noise {
            t += bytes.len() as u64 * 2 * MS + gap;
            line.push(t, bytes);
        }
        t += gap + frame.len() as u64 * 2 * MS;
        line.push(t, &frame);
        line.turn(t + 100 * MS);
        prop_assert_eq!(line.good().pop(), Some(frame));
    }
}

#[test]
fn an_awaited_answer_ends_without_silence() {
    let request = frame(&[1, 3, 0, 0, 0, 2]);
    let answer = frame(&[1, 3, 4, 0, 1, 0, 2]);
    let other = frame(&[2, 3, 4, 0, 1, 0, 2]);
    let expected = Expected::of(&request);
    let mut line = Line::rtu(20 * MS);
    line.framer.expect(expected);
    line.push(100 * MS, &answer[..6]);
    assert!(line.seen.is_empty());
    line.push(104 * MS, &answer[6..]);
    assert_eq!(line.seen, [seen(END, &answer)]);
    assert_eq!((line.framer.is_receiving(), line.framer.deadline()), (false, None));
    // The next transmission still waits for the silence behind it.
    assert_eq!(line.framer.last_ns(), Some(104 * MS));
    // It was awaited once.
    line.push(200 * MS, &answer);
    assert_eq!(line.seen.len(), 1);
    line.turn(205 * MS);
    assert_eq!(line.seen.len(), 2);
    // What began before the request had left, another unit's, a gap inside, damage: by silence.
    for case in 0..4 {
        let mut line = Line::rtu(20 * MS);
        let sent = if case == 1 { &other } else { &answer };
        match case {
            0 => line.push(98 * MS, &sent[..1]),
            3 => line.framer.mark(PARITY),
            _ => {}
        }
        line.framer.expect(expected);
        let from = usize::from(case == 0);
        if case == 2 {
            line.push(100 * MS, &sent[..5]);
            line.push(107 * MS, &sent[5..]);
        } else {
            line.push(100 * MS, &sent[from..]);
        }
        assert!(line.seen.is_empty(), "{case}");
        line.turn(130 * MS);
        assert_eq!(line.seen.iter().map(|s| &s.bytes).collect::<Vec<_>>(), [sent], "{case}");
    }
    // What follows is no part of it, and noise before it leaves it awaited.
    let mut line = Line::rtu(0);
    line.framer.expect(expected);
    line.push(100 * MS, &[0]);
    line.turn(110 * MS);
    line.push(150 * MS, &[&answer[..], &[0xFF]].concat());
    assert_eq!(line.seen, [seen(END, &[0]), seen(END, &answer)]);
    line.turn(160 * MS);
    assert_eq!(line.seen[2..], [seen(END, &[0xFF])]);
    assert_eq!(line.framer.counters().fragments, 2);
}
