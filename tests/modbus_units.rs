//! The Modbus master between processes, as the units of a line see it: what is written first, what is written when
//! the plc stops, and what a dead unit costs the others.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::cast_possible_truncation)]

mod support;

use std::time::Duration;
use support::rtu_line::{Noted, Units, is_write};
use support::{PATIENCE, Stack, wait_for};

const HEAD: &str = r#"
[stack]
name = "NAME"

[[service]]
name = "plc"
kind = "plc"
cycle = "10ms"
"#;

/// A line with a master; its keys and its tables. `stale_after`: a machine with much to do may keep the plc from its turn
/// for the 0.2 s that are the default.
fn line(number: u8, keys: &str, tables: &str) -> String {
    format!(
        "\n[[service]]\nname = \"com{number}\"\nkind = \"serial\"\ndevice = \"pty:com{number}\"\nbaud = 115200\npace = true\n\
         \n[[service]]\nname = \"master{number}\"\nkind = \"modbus-client\"\nserial = \"com{number}\"\n\
         stale_after = \"10s\"\n{keys}{tables}"
    )
}

fn read(unit: u8, to: u32) -> String {
    format!(
        "\n[[service.read]]\nunit = {unit}\ntable = \"holding\"\nat = 0\nto = \"%IW{to}\"\nperiod = \"0s\"\n"
    )
}

fn write(unit: u8, at: u16, from: u32, more: &str) -> String {
    format!(
        "\n[[service.write]]\nunit = {unit}\ntable = \"holding\"\nat = {at}\nfrom = \"%QW{from}\"\n{more}\n"
    )
}

fn units(stack: &Stack, number: u8, dead: &[u8], delay: Duration) -> Units {
    let path = stack.scratch.0.join(format!("com{number}"));
    wait_for("the pseudo-terminal", PATIENCE, || path.exists().then_some(()));
    Units::start(&path, dead, delay)
}

#[test]
fn writes_go_before_reads_and_leave_reads_their_turn() {
    const READS: u8 = 10;
    // As many as one command changes in one scan.
    const WRITES: u16 = 16;
    let mut tables: String = (1..=READS).map(|unit| read(unit, u32::from(unit))).collect();
    tables.extend((0..WRITES).map(|n| write(1, 100 + n, u32::from(n), "")));
    let stack = Stack::up("mbfirst", &(HEAD.to_owned() + &line(1, "", &tables)), &[]);
    // Slow units, so that all ten reads are always due.
    let units = units(&stack, 1, &[], Duration::from_millis(50));
    let written = |noted: &[Noted]| noted.iter().filter(|n| is_write(n)).count();
    stack.wait("the first values", || (written(&units.noted()) >= usize::from(WRITES)).then_some(()));
    stack.wait("reads again", || {
        let noted = units.noted();
        let last: Vec<u8> = noted.iter().rev().take(usize::from(READS)).map(|n| n.0).collect();
        (noted.iter().rev().take(usize::from(READS)).all(|n| !is_write(n)) && last.len() == 10).then_some(())
    });
    let before = units.count();
    let values: Vec<String> = (0..WRITES).map(|n| format!("%QW{n}={}", 1000 + n)).collect();
    let mut args = vec!["plc", "write"];
    args.extend(values.iter().map(String::as_str));
    stack.ok(&args);
    let seen = units.count();
    stack.wait("all values", || (written(&units.noted()[before..]) >= usize::from(WRITES)).then_some(()));
    let after = units.noted().split_off(before);
    // From the moment at which the plc had the values, the request in flight is over, and one that began before the
    // image came; in the order of their turns nine more reads would stand before the first write.
    let first = after.iter().position(is_write).unwrap();
    let waited = first.saturating_sub(seen - before);
    assert!(waited <= 4, "{waited} reads before the first write: {after:02X?}");
    // Every value once, and after eight writes at the most a read has its turn.
    let values: Vec<(u16, u16)> = after
        .iter()
        .filter(|n| is_write(n))
        .map(|(_, pdu)| (u16::from_be_bytes([pdu[1], pdu[2]]), u16::from_be_bytes([pdu[3], pdu[4]])))
        .collect();
    let mut sorted = values.clone();
    sorted.sort_unstable();
    assert_eq!(sorted, (0..WRITES).map(|n| (100 + n, 1000 + n)).collect::<Vec<_>>());
    let last = after.iter().rposition(is_write).unwrap();
    let runs: Vec<usize> = after[first..=last].split(|n| !is_write(n)).map(<[Noted]>::len).collect();
    assert!(runs.iter().all(|run| *run <= 8) && runs.len() >= 2, "{runs:?}");
    // The values came at once, so the writes go at once: eight, a read, eight.
    assert!(after[first..=last].len() <= usize::from(WRITES) + 8, "{runs:?}");
}

#[test]
fn when_the_plc_stops_the_safe_values_are_written_once() {
    let tables = [
        read(1, 0),
        write(1, 100, 0, "safe_values = [7]"),
        write(1, 101, 1, ""),
        write(2, 200, 2, "safe_values = [9]\nperiod = \"100ms\""),
    ];
    let stack = Stack::up("mbsafe", &(HEAD.to_owned() + &line(1, "", &tables.concat())), &[]);
    let units = units(&stack, 1, &[], Duration::ZERO);
    let is = |at: u8, value: u8| move |n: &&Noted| n.1[0] == 6 && n.1[1..] == [0, at, 0, value];
    let many = |from: usize, at, value| units.noted()[from..].iter().filter(is(at, value)).count();
    stack.ok(&["plc", "write", "%QW0=21", "%QW1=22", "%QW2=23"]);
    for (at, value) in [(100, 21), (101, 22), (200, 23)] {
        stack.wait("a value of the image", || (many(0, at, value) > 0).then_some(()));
    }
    stack.ok(&["plc", "stop"]);
    stack.wait("the safe values", || (many(0, 100, 7) > 0 && many(0, 200, 9) > 0).then_some(()));
    // Once, and nothing else is written while the reads go on: not even by its period.
    let stopped = units.count();
    stack.wait("reads after the safe values", || (units.count() > stopped + 200).then_some(()));
    let noted = units.noted();
    let safe = noted.iter().position(|n| is(100, 7)(&n)).unwrap();
    let written: Vec<&Noted> = noted[safe..].iter().filter(|n| is_write(n)).collect();
    assert_eq!((many(0, 100, 7), many(0, 200, 9)), (1, 1), "{written:02X?}");
    // The range without safe values keeps what it had, and of the others nothing follows.
    assert!(written.len() <= 2, "{written:02X?}");
    assert!(stack.log().contains("writes went to their safe state: the PLC is stopped"), "{}", stack.log());
    // It goes on: the image's values again, whatever stands in the units.
    let again = units.count();
    stack.ok(&["plc", "run"]);
    for (at, value) in [(100, 21), (101, 22), (200, 23)] {
        stack.wait("the value of the image again", || (many(again, at, value) > 0).then_some(()));
    }
    assert_eq!(many(again, 100, 7), 0);
}

#[test]
fn a_dead_unit_among_ten_costs_the_others_less_than_5_percent() {
    // Both lines at the same time, so that whatever the machine does it does to both. A dead unit may take one 26th
    // of the line (its tries, and 25 times as long for the others); the shortest times that make it so.
    let keys = "response_timeout = \"100ms\"\nretries = 1\nprobe_min = \"100ms\"\nprobe_max = \"100ms\"\n";
    let reads = |to: u32, count: u8| (1..=count).map(|n| read(n, to + u32::from(n))).collect::<String>();
    let toml = HEAD.to_owned() + &line(1, keys, &reads(0, 9)) + &line(2, keys, &reads(100, 10));
    let stack = Stack::up("mbten", &toml, &[]);
    let nine = units(&stack, 1, &[], Duration::ZERO);
    let ten = units(&stack, 2, &[10], Duration::ZERO);
    // Four tries, then it is dead and only looked at.
    stack.wait("the dead unit is known", || (ten.by_unit()[10] >= 5).then_some(()));
    let mut told = Vec::new();
    // A live unit that the machine keeps from answering for two timeouts costs its line more than the dead one does:
    // then the next window counts.
    for _ in 0..4 {
        let before = (nine.by_unit(), ten.by_unit());
        std::thread::sleep(Duration::from_secs(20));
        let after = (nine.by_unit(), ten.by_unit());
        let rates: Vec<(u32, u32)> =
            (1..=9).map(|unit| (after.0[unit] - before.0[unit], after.1[unit] - before.1[unit])).collect();
        let probes = after.1[10] - before.1[10];
        eprintln!("alone and beside a dead unit: {rates:?}, {probes} probes");
        assert!(probes > 0, "the dead unit is looked at no more");
        if rates.iter().all(|(alone, beside)| f64::from(*beside) > 0.95 * f64::from(*alone)) {
            return;
        }
        told.push(rates);
    }
    panic!("alone and beside a dead unit: {told:?}\n{}", stack.log());
}
