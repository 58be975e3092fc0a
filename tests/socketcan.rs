//! Real SocketCAN: a Linux that runs as an ordinary program (user-mode Linux) with the kernel's own CAN, and in it a stack
//! on vcan0 beside unmodified can-utils.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod support;

use serde_json::Value;
use std::fs;
use support::uml::{Work, boot, can_boot};
use support::{car, cases, peers};

const COUNT: usize = 10_000;
/// What a dump shows first, so that it is known to listen: sent by the bus that it shows, or by another.
const MARK: &str = "7F0#AA";
const MARK_OF_ANOTHER: &str = "7F1#AA";

/// The frames of a dump without the marks.
fn unmarked(work: &Work, file: &str) -> Vec<String> {
    work.frames(file).into_iter().filter(|frame| frame != MARK && frame != MARK_OF_ANOTHER).collect()
}

#[test]
fn a_stack_on_a_kernel_interface() {
    let Some(()) = can_boot() else { return };
    let work = Work::new("stack");
    let Some(()) = boot("socketcan.sh", &work) else { return };
    let told = || format!("{}\n--- up.log\n{}", work.text("script.log"), work.text("up.log"));
    own_transmissions(&work, &told());
    frames_of_others(&work);
    filters(&work);
    ten_thousand_each_way(&work);
    down_and_up(&work, &told());
    a_controller(&work, &told());
    slcan(&work);
}

/// 12,974 frames of a real car: played to the kernel by canplayer, decoded by the program, read by pymodbus, recorded one by
/// one; and the recording, played to the kernel, reaches candump bit by bit.
#[test]
fn a_real_car_through_the_kernel() {
    let (Some(()), Some(cases)) = (can_boot(), cases()) else { return };
    let frames = car::frames_of_log(&fs::read_to_string(cases.join(car::LOG)).unwrap());
    assert_eq!(frames.len(), car::FRAMES);
    let work = Work::new("car");
    // At a pace that the guest keeps up with.
    let played = frames.iter().enumerate().map(|(i, f)| format!("({:.6}) c {f}\n", 1e9 + i as f64 / 1500.0));
    fs::write(work.0.join("played.log"), played.collect::<String>()).unwrap();
    fs::write(work.0.join("stack.toml"), car::on_an_interface("car", "vcan0", 1502)).unwrap();
    fs::write(work.0.join("car.st"), car::PROGRAM).unwrap();
    let registers = car::expected_registers(&frames).iter().map(u16::to_string).collect::<Vec<_>>();
    fs::write(work.0.join("registers"), registers.join(",")).unwrap();
    let Some(()) = boot("car.sh", &work) else { return };

    let sum = work.sum("can0");
    assert!(sum.contains(&format!(" {} received, ", car::FRAMES)), "{sum}");
    assert!(sum.contains(" 0 dropped by the kernel, "), "{sum}");
    let found = fs::read_dir(&work.0).unwrap().map(|entry| entry.unwrap().path());
    let recordings: Vec<_> = found.filter(|path| path.extension().is_some_and(|e| e == "mcap")).collect();
    let Some(mut reader) = peers::peer("frames_of.py") else { return };
    let output = reader.arg("can0/rx").args(&recordings).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let recorded: Vec<_> = String::from_utf8(output.stdout).unwrap().lines().map(str::to_owned).collect();
    same(&recorded, &frames, "the recording");
    for recording in &recordings {
        let verified = support::dinrail().args(["replay", "--verify"]).arg(recording).output().unwrap();
        assert_eq!(verified.status.code(), Some(0), "{}", String::from_utf8_lossy(&verified.stderr));
    }
    same(&work.frames("again.candump"), &frames, &work.text("again.replay"));
}

fn same(got: &[String], wanted: &[String], what: &str) {
    let differs = got.iter().zip(wanted).position(|(a, b)| a != b);
    let shown = differs.map(|n| (n, &got[n], &wanted[n]));
    assert!(
        shown.is_none() && got.len() == wanted.len(),
        "{what}: {} frames, first difference {shown:?}",
        got.len()
    );
}

/// Sent by the stack: on the wire once and in order; on `rx` once, in the same order, marked as ours.
fn own_transmissions(work: &Work, told: &str) {
    let sent: Vec<String> = work.text("own.sent").lines().map(str::to_owned).collect();
    assert_eq!(sent.len(), 205);
    let wire = work.frames("own.candump");
    // candump writes the others' frames behind them.
    assert_eq!(wire[..sent.len().min(wire.len())], sent, "{told}");
    let rx: Vec<Value> =
        work.text("own.dump").lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    let echoes = rx.iter().filter(|f| f["echo"] == true).map(|f| f["frame"].as_str().unwrap());
    let echoes: Vec<&str> = echoes.filter(|frame| *frame != MARK).collect();
    assert_eq!(echoes, sent);
    let stamps: Vec<i64> = rx.iter().map(|f| f["utc_ns"].as_i64().unwrap()).collect();
    assert!(stamps.is_sorted(), "stamps go backwards");
}

fn frames_of_others(work: &Work) {
    let rx = work.text("own.dump");
    let others: Vec<String> = rx
        .lines()
        .map(|line| serde_json::from_str::<Value>(line).unwrap())
        .filter(|f| f["echo"] == false)
        .map(|f| f["frame"].as_str().unwrap().to_owned())
        .collect();
    let expected = [
        "123##3AABBCC",
        "456#R2",
        "20000204#0020000000008000",
        "20000040#0000000000000000",
        "20000100#0000000000000000",
        "20000020#0000000000000000",
        "00000777#01",
    ];
    assert_eq!(others, expected);
    let log = work.text("up.log");
    assert!(
        log.contains("vcan0 is error passive: error passive by transmit errors; TEC 128, REC 0"),
        "{log}"
    );
    assert!(log.contains("vcan0 is bus-off"), "{log}");
    let nobody =
        "vcan0: nobody acknowledges what is sent (no acknowledgement): termination, bit rate, partner?";
    assert!(log.contains(nobody), "{log}");
    assert!(log.contains("there is no interface 'nocan7' (CAN interfaces here: vcan0)"), "{log}");
}

/// What the kernel keeps back never comes; error frames and own frames always do.
fn filters(work: &Work) {
    let all = unmarked(work, "all.dump");
    assert_eq!(all.len(), 10, "{all:?}");
    let some = unmarked(work, "some.dump");
    let wanted = ["5A1#01", "1F0000AA#03", "5AF#R2", "20000080#0000000000000000", "5A2#0A", "124#0B"];
    assert_eq!(some, wanted);
}

/// Bit rate set in the kernel and told to the adapter, bus-off of the controller, restart; the adapter pulled and back.
fn a_controller(work: &Work, told: &str) {
    for round in ["1", "2"] {
        let link = work.text(&format!("kslcan.{round}"));
        assert!(link.contains("bitrate 250000") && link.contains("ERROR-ACTIVE"), "{link}");
    }
    let commands = work.text("fake.log");
    let commands: Vec<&str> =
        commands.lines().filter(|line| ["S5", "O", "C"].contains(line) || line.starts_with('t')).collect();
    let rest = commands.join(" ").replace("C S5 O", "up").replace("S5 O", "up");
    assert_eq!(
        rest.split_whitespace().filter(|c| *c != "C").collect::<Vec<_>>(),
        ["up", "t101101", "t666102", "up", "t200103", "up", "t102101"],
        "{commands:?}\n{told}"
    );
    let sum = work.sum("kern");
    assert!(sum.contains("; 1 times bus-off, 1 restarts, "), "{sum}");
}

/// 10,000 frames in and 10,000 out at the same time: none lost, none twice, order kept, nothing dropped by the kernel.
fn ten_thousand_each_way(work: &Work) {
    let inward: Vec<String> = (0..COUNT).map(|i| format!("{:03X}#{i:08X}", i % 2048)).collect();
    let outward: Vec<String> = (0..COUNT).map(|i| format!("{:08X}#{i:08X}", 0x10000 + i % 2048)).collect();
    for file in ["out.candump", "in.dump"] {
        let (long, short): (Vec<String>, Vec<String>) =
            unmarked(work, file).into_iter().partition(|frame| frame.find('#') == Some(8));
        assert!(short == inward, "{file}: {} frames inward", short.len());
        assert!(long == outward, "{file}: {} frames outward", long.len());
    }
    let sum = work.sum("can0");
    let marks = work.frames("all.dump").iter().filter(|frame| *frame == MARK_OF_ANOTHER).count();
    let received = format!(" {} received, ", COUNT + 15 + marks);
    for expected in [
        received.as_str(),
        " 5 error frames, ",
        " 0 dropped by the kernel, ",
        "; 1 times bus-off, 1 restarts, 4 times down",
    ] {
        assert!(sum.contains(expected), "no '{expected}' in {sum}");
    }
}

fn down_and_up(work: &Work, told: &str) {
    assert_eq!(work.frames("up.send"), ["00B#01", "00B#02", "00B#03", "00C#01"], "{told}");
    // What waited while it was down was sent when it came back, or was too old: never twice.
    for round in 1..=3 {
        let count = work.frames("updown.dump").iter().filter(|f| **f == format!("00A#0{round}")).count();
        assert!(count <= 1, "{count} times {round}");
    }
    let log = work.text("up.log");
    assert!(
        log.contains("interface vcan0 is down: frames wait until it is up again (`ip link set vcan0 up`)"),
        "{log}"
    );
}

fn slcan(work: &Work) {
    let virt = work.frames("virt.dump");
    for frame in ["321#1122", "1ABCDEF0#0102030405060708", "123#R3"] {
        assert!(virt.iter().any(|f| f == frame), "{frame} is not in {virt:?}");
    }
    assert_eq!(
        work.frames("slcan0.candump")
            .split_off(0)
            .into_iter()
            .filter(|f| !f.starts_with("321#"))
            .collect::<Vec<_>>(),
        ["1ABCDEF0#0102030405060708", "123#R3", "7AB#01", "1BCDEF01#", "055#R2"]
    );
    assert_eq!(unmarked(work, "far.dump"), ["123#01", "1ABCDEF0#02"]);
}
