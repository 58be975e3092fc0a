use super::super::candump::{format, parse};
use super::super::frame::tests::any_frame;
use super::*;
use proptest::prelude::*;

fn read(text: &str) -> Vec<String> {
    let mut reader = Reader::default();
    let lines = text.lines().filter_map(|line| match reader.line(line) {
        Ok(None) => None,
        Ok(Some(f)) => {
            Some(format!("{} {} {}{}", f.t_ns, f.channel, format(&f.frame), if f.tx { " Tx" } else { "" }))
        }
        Err(e) => Some(e.to_string()),
    });
    lines.collect()
}

#[test]
fn a_measurement_with_everything_in_it() {
    let text = "\
date Sat Sep 30 10:06:13.191 pm 2017
base hex  timestamps absolute
no internal events logged
// version 8.5.0
Begin Triggerblock Sat Sep 30 10:06:13.191 pm 2017
   0.000000 Start of measurement
   0.015991 CAN 1 Status:chip status error active
   0.015991 1  Statistic: D 0 R 0 XD 0 XR 0 E 0 O 0 B 0.00%
   1.015991 1  222             Rx   d 8 00 01 02 03 04 05 06 07  Length = 184600 BitCount = 95 ID = 546
   1.015992 2  18EBFF00x       Tx   d 2 AA bb
   1.015993 1  123             Rx   r
   1.015994 1  123x            Rx   r 8
   1.015995 1  123             TxRq d 1 00
   1.015996 1  J1939TP FEE3p 6 0 0 - Rx d 23 A0 0F
   2.501000 1  ErrorFrame
   2.501010 1  ErrorFrame  ECC: 10100010
   3.021000 CANFD   1 Rx        300                                   1 0 9 12 01 02 03 04 05 06 07 08 09 0A 0B 0C   130000  130   203000 80006d 46500250 460a0250 20011736 20010205
   3.021000 CANFD   2 Tx   18FFAA00x  EngineData                       0 1 8  8 01 02 03 04 05 06 07 08        0    0     5000        0        0        0        0        0
   3.022000 CANFD   1 Rx        301                                   0 0 2  2 0A 0B        0    0        0        0        0        0        0        0
   3.023000 CANFD   1 Rx        302                                   0 0 4  0        0    0       10        0        0        0        0        0
   3.024000 CANFD   1 Rx ErrorFrame
   3.024000 Trigger event
End TriggerBlock
";
    insta::assert_snapshot!(read(text).join("\n"), @r#"
1506809174206991000 1 222#0001020304050607
1506809174206992000 2 18EBFF00#AABB Tx
1506809174206993000 1 123#R
1506809174206994000 1 00000123#R8
1506809175692000000 1 20000080#0000000000000000
1506809175692010000 1 20000080#0000000000000000
1506809176212000000 1 300##10102030405060708090A0B0C
1506809176212000000 2 18FFAA00##20102030405060708 Tx
1506809176213000000 1 301#0A0B
1506809176214000000 1 302#R4
1506809176215000000 1 20000080#0000000000000000
"#);
}

#[test]
fn decimal_base_and_relative_stamps() {
    let text = "\
base dec  timestamps relative
0.100000 1 291 Rx d 2 255 16
0.200000 Statistic
0.300000 1 291x Rx d 1 7
";
    assert_eq!(read(text), ["100000000 1 123#FF10", "600000000 1 00000123#07"]);
}

#[test]
fn dates() {
    let utc = |text: &str| date(text.split(' ')).map(|ns| ns / 1_000_000);
    for (text, ms) in [
        ("Sat Sep 30 15:06:13.191 2017", 1_506_783_973_191),
        ("Sat Sep 30 03:06:13.191 PM 2017", 1_506_783_973_191),
        ("Sep 30 03:06:13 pm 2017", 1_506_783_973_000),
        ("Don Okt 1 12:00:00 am 1970", 23_587_200_000),
        ("Mon Mär 2 00:00:00 1970", 5_184_000_000),
        ("Thu Jan 01 00:02:46.000 1970", 166_000),
    ] {
        assert_eq!(utc(text), Ok(ms), "{text}");
    }
    for text in
        ["", "Sat", "Sat Foo 30 15:06:13 2017", "Sat Sep 31 15:06:13 2017", "Sat Sep 30 25:06:13 2017"]
    {
        assert!(utc(text).is_err(), "{text}");
    }
}

#[test]
fn mistakes_are_named() {
    let said: Vec<String> = [
        "date never",
        "base oct",
        "0.1 1 12G Rx d 1 00",
        "0.1 1 800 Rx d 1 00",
        "0.1 1 20000000x Rx d 1 00",
        "0.1 1 123 Rx q 1 00",
        "0.1 1 123 Rx d 10 00",
        "0.1 1 123 Rx d 3 00 01",
        "0.1 1 123 Rx d 1 100",
        "0.1 CANFD 1 Rx 123 2 0 1 1 00",
        "0.1 CANFD 1 Rx 123 name 0 0 9 9 00 00 00 00 00 00 00 00 00 0 0 1000",
        "0.1 CANFD 1 Rx 123 1 0 9 99 00",
        "0.1 CANFD 1 Rx",
    ]
    .iter()
    .map(|text| format!("{text}: {}", read(text).first().map_or("nothing", String::as_str)))
    .collect();
    insta::assert_snapshot!(said.join("\n"), @r#"
date never: date `never` must be like `Sat Sep 30 15:06:13.191 2017` or `Sep 30 03:06:13 pm 2017`
base oct: base `oct` must be hex or dec
0.1 1 12G Rx d 1 00: identifier `12G` must be a number in the file's base, with x behind it when it has 29 bits
0.1 1 800 Rx d 1 00: identifier 800 needs 29 bits: write it with 8 digits, or use at most 7FF for 11 bits
0.1 1 20000000x Rx d 1 00: identifier 20000000 is above 1FFFFFFF, the largest 29-bit identifier
0.1 1 123 Rx q 1 00: `q` must be d (data) or r (remote)
0.1 1 123 Rx d 10 00: data length `10` must be a data length code, 0 to F
0.1 1 123 Rx d 3 00 01: the line announces 3 data bytes, byte 3 is ``
0.1 1 123 Rx d 1 100: the line announces 1 data bytes, byte 1 is `100`
0.1 CANFD 1 Rx 123 2 0 1 1 00: `2` must be 0 or 1: bit rate switch and error state of a CAN FD frame
0.1 CANFD 1 Rx 123 name 0 0 9 9 00 00 00 00 00 00 00 00 00 0 0 1000: code 9 means 12 data bytes, the line says 9
0.1 CANFD 1 Rx 123 1 0 9 99 00: code 9 means 12 data bytes, the line says 99
0.1 CANFD 1 Rx: identifier `` must be a number in the file's base, with x behind it when it has 29 bits
"#);
    assert_eq!(Reader::default().line(&"x".repeat(20_000)), Err(AscError::TooLong(20_000)));
}

#[test]
fn written_as_others_write_it() {
    let writer = Writer::new(1_506_783_973_191_777_888);
    let mut text = writer.header();
    for (us, channel, frame, tx) in [
        (0, 1, "123#DEADBEEF", false),
        (1, 2, "12345678#", true),
        (1_000_002, 1, "123#R4", false),
        (86_400_000_000, 1, "00000123#R", false),
        (86_400_000_001, 1, "20000004#0004000000000000", false),
        (86_400_000_002, 1, "123##1AABB", false),
        (86_400_000_003, 16, "1FFFFFFF##2000102030405060708090A0B", true),
    ] {
        text += &writer.line(1_506_783_973_191_777_888 + us * 1000, channel, &parse(frame).unwrap(), tx);
    }
    text += writer.footer();
    insta::assert_snapshot!(text, @r#"
date Sat Sep 30 15:06:13.191 2017
base hex  timestamps absolute
internal events logged
Begin Triggerblock Sat Sep 30 15:06:13.191 2017
   0.000000 Start of measurement
   0.000777 1  123             Rx   d 4 DE AD BE EF
   0.000778 2  12345678x       Tx   d 0
   1.000779 1  123             Rx   r 4
86400.000777 1  123x            Rx   r 0
86400.000778 1  ErrorFrame
86400.000779 CANFD   1 Rx        123                                   1 0 2  2 AA BB        0    0     3000        0        0        0        0        0
86400.000780 CANFD  16 Tx   1FFFFFFFx                                   0 1 9 12 00 01 02 03 04 05 06 07 08 09 0A 0B        0    0     5000        0        0        0        0        0
End TriggerBlock
"#);
}

proptest! {
    #[test]
    fn what_is_written_is_read(
        frames in prop::collection::vec((any_frame(true), 0u64..10_000_000_000, 1u16..200, any::<bool>()), 1..30),
        start in 0u64..4_000_000_000_000,
    ) {
        let mut us = start;
        let first_ns = (start + frames[0].1) * 1000;
        let writer = Writer::new(first_ns);
        let mut reader = Reader::default();
        for line in writer.header().lines() {
            prop_assert_eq!(reader.line(line), Ok(None));
        }
        for (frame, gap, channel, tx) in frames {
            us += gap;
            let line = writer.line(us * 1000, channel, &frame, tx);
            let read = reader.line(&line).unwrap().unwrap();
            prop_assert_eq!((read.t_ns, read.channel, read.tx), (us * 1000, channel, tx));
            prop_assert_eq!(read.frame, frame);
        }
    }

    #[test]
    fn nothing_panics(lines in prop::collection::vec("[ -~µ]{0,80}", 0..20)) {
        let mut reader = Reader::default();
        for line in lines {
            let _ = reader.line(&line);
        }
    }

    #[test]
    fn nearly_right_lines_never_panic(
        words in prop::collection::vec(
            prop::sample::select(vec!["0.5", "1", "CANFD", "Rx", "Tx", "123", "1x", "x", "d", "r", "F", "64", "0", "date", "Sep", "30", "é"]),
            0..16,
        ),
    ) {
        let mut reader = Reader::default();
        let _ = reader.line(&words.join(" "));
        let _ = reader.line(&format!("0.5 CANFD 1 Rx 123 {}", words.join(" ")));
    }
}
