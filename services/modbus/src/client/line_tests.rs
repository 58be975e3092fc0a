//! The line against a world of units in virtual time: exact accounts, and properties over random misfortune.

use super::*;
use proptest::prelude::*;
use std::collections::BTreeMap;

const MS: u64 = 1_000_000;
const SERIAL: Settings = Settings { serial: true, turnaround_ns: Some(200 * MS), send_limit_ns: 2000 * MS };
const TCP: Settings = Settings { serial: false, turnaround_ns: None, send_limit_ns: 2000 * MS };

fn unit(timeout_ms: u64, retries: u8) -> UnitSettings {
    UnitSettings { response_timeout_ns: timeout_ms * MS, retries, ..UnitSettings::default() }
}

fn read(address: u16, quantity: u16) -> [u8; 5] {
    let ([a1, a0], [q1, q0]) = (address.to_be_bytes(), quantity.to_be_bytes());
    [3, a1, a0, q1, q0]
}

/// The right answer to a read of holding registers: each shows its address.
fn answer_to(pdu: &[u8]) -> Vec<u8> {
    let (address, quantity) = (u16::from_be_bytes([pdu[1], pdu[2]]), u16::from_be_bytes([pdu[3], pdu[4]]));
    if pdu[0] != 3 {
        return pdu[..5].to_vec();
    }
    let mut answer = vec![3, (quantity * 2) as u8];
    for i in 0..quantity {
        answer.extend((address + i).to_be_bytes());
    }
    answer
}

/// Steps of a line as text, until it waits.
fn steps(line: &mut Line, now_ns: u64) -> Vec<String> {
    let mut said = Vec::new();
    loop {
        match line.step(now_ns) {
            Step::Wait(until) => {
                said.push(until.map_or("wait".into(), |ns| format!("wait {}", ns / MS)));
                return said;
            }
            Step::Send { unit, pdu, .. } => said.push(format!("send {unit} {pdu:02X?}")),
            Step::Done { origin, result, .. } => said.push(match result {
                Ok(pdu) => format!("done {origin:?} {pdu:02X?}"),
                Err(e) => format!("failed {origin:?} {e:?}"),
            }),
            Step::Reset => said.push("reset".into()),
        }
    }
}

#[test]
fn a_read_and_its_period() {
    let mut line = Line::new(SERIAL, unit(100, 0));
    line.add_slot(5, SlotKind::Read, &read(0, 1), Some(50 * MS));
    assert_eq!(steps(&mut line, 0), ["send 5 [03, 00, 00, 00, 01]", "wait 2000"]);
    line.sent(10 * MS);
    assert_eq!(steps(&mut line, 10 * MS), ["wait 110"]);
    line.answer(5, &[3, 2, 0, 7], 20 * MS);
    assert_eq!(steps(&mut line, 20 * MS), ["done Slot(0) [03, 02, 00, 07]", "wait 50"]);
    assert_eq!(line.units().next().unwrap().last_rtt_ns, Some(10 * MS));
    // An exception is an answer too.
    assert_eq!(steps(&mut line, 50 * MS).len(), 2);
    line.sent(51 * MS);
    line.answer(5, &[0x83, 2], 52 * MS);
    assert_eq!(steps(&mut line, 52 * MS), ["done Slot(0) [83, 02]", "wait 100"]);
    let view = line.units().next().unwrap();
    assert_eq!((view.state, view.counters.exceptions, view.last_exception), (UnitState::Ok, 1, Some((2, 3))));
}

#[test]
fn late_answers_are_discarded_and_what_they_would_fit_waits() {
    let mut line = Line::new(SERIAL, unit(100, 0));
    line.push_job(1, 5, &read(0, 1), u64::MAX, false).unwrap();
    line.push_job(2, 5, &read(9, 1), u64::MAX, false).unwrap();
    let other = [4, 0, 9, 0, 2];
    line.push_job(3, 5, &other, u64::MAX, false).unwrap();
    assert_eq!(steps(&mut line, 0)[0], "send 5 [03, 00, 00, 00, 01]");
    line.sent(0);
    // Job 2 would take the late answer of job 1 for its own; job 3, another function, would not.
    let said = steps(&mut line, 100 * MS);
    assert_eq!(said, ["failed Job(1) NoAnswer", "send 5 [04, 00, 09, 00, 02]", "wait 2100"]);
    line.sent(100 * MS);
    line.answer(5, &[3, 2, 0xAA, 0xAA], 110 * MS);
    assert_eq!(line.units().next().unwrap().counters.discarded, 1);
    line.answer(5, &[4, 4, 0, 9, 0, 10], 120 * MS);
    // The late one has come, so job 2 need not wait longer.
    assert_eq!(
        steps(&mut line, 120 * MS)[..2],
        ["done Job(3) [04, 04, 00, 09, 00, 0A]", "send 5 [03, 00, 09, 00, 01]"]
    );
    // Without it: held back for one more response timeout.
    let mut line = Line::new(SERIAL, unit(100, 0));
    line.push_job(1, 5, &read(0, 1), u64::MAX, false).unwrap();
    line.push_job(2, 5, &read(9, 1), u64::MAX, false).unwrap();
    steps(&mut line, 0);
    line.sent(0);
    assert_eq!(steps(&mut line, 100 * MS), ["failed Job(1) NoAnswer", "wait 200"]);
    assert_eq!(steps(&mut line, 200 * MS)[0], "send 5 [03, 00, 09, 00, 01]");
}

#[test]
fn a_connection_is_dropped_after_a_timeout_or_a_mismatch() {
    let mut line = Line::new(TCP, unit(100, 1));
    line.push_job(1, 1, &read(0, 1), u64::MAX, false).unwrap();
    steps(&mut line, 0);
    line.sent(0);
    assert_eq!(steps(&mut line, 100 * MS), ["reset", "send 1 [03, 00, 00, 00, 01]", "wait 2100"]);
    line.sent(100 * MS);
    line.answer(1, &[3, 4, 0, 0, 0, 0], 110 * MS);
    assert_eq!(steps(&mut line, 110 * MS), ["reset", "failed Job(1) Mismatch", "wait"]);
}

#[test]
fn a_broadcast_has_no_answer_but_a_pause() {
    let mut line = Line::new(SERIAL, unit(100, 1));
    line.push_job(1, 0, &[6, 0, 0, 0, 1], u64::MAX, false).unwrap();
    line.push_job(2, 1, &read(0, 1), u64::MAX, false).unwrap();
    assert_eq!(steps(&mut line, 0), ["send 0 [06, 00, 00, 00, 01]", "wait 2000"]);
    line.sent(5 * MS);
    line.answer(0, &[6, 0, 0, 0, 1], 6 * MS);
    assert_eq!(steps(&mut line, 6 * MS), ["wait 205"]);
    assert_eq!(steps(&mut line, 205 * MS)[..2], ["done Job(1) []", "send 1 [03, 00, 00, 00, 01]"]);
    assert_eq!(line.units().next().unwrap().counters.discarded, 1);
    // On a connection unit 0 is a unit.
    let mut line = Line::new(TCP, unit(100, 1));
    line.push_job(1, 0, &[6, 0, 0, 0, 1], u64::MAX, false).unwrap();
    steps(&mut line, 0);
    line.sent(0);
    line.answer(0, &[6, 0, 0, 0, 1], MS);
    assert_eq!(steps(&mut line, MS)[0], "done Job(1) [06, 00, 00, 00, 01]");
}

#[test]
fn writes_go_first_and_only_the_newest_value() {
    let mut line = Line::new(SERIAL, unit(100, 0));
    line.add_slot(1, SlotKind::Read, &read(0, 1), Some(0));
    let write = line.add_slot(1, SlotKind::Write, &[], None);
    assert_eq!(steps(&mut line, 0)[0], "send 1 [03, 00, 00, 00, 01]");
    line.set_write(write, &[6, 0, 0, 0, 1], 0);
    line.set_write(write, &[6, 0, 0, 0, 2], 0);
    line.sent(0);
    line.answer(1, &[3, 2, 0, 0], MS);
    assert_eq!(steps(&mut line, MS)[1], "send 1 [06, 00, 00, 00, 02]");
    // Changed while it is under way: once more.
    line.set_write(write, &[6, 0, 0, 0, 3], MS);
    line.sent(MS);
    line.answer(1, &[6, 0, 0, 0, 2], 2 * MS);
    assert_eq!(steps(&mut line, 2 * MS)[1], "send 1 [06, 00, 00, 00, 03]");
    line.sent(2 * MS);
    line.answer(1, &[6, 0, 0, 0, 3], 3 * MS);
    assert_eq!(steps(&mut line, 3 * MS)[1], "send 1 [03, 00, 00, 00, 01]");
    assert!(!line.is_waiting(write));
}

#[test]
fn endless_writes_and_jobs_leave_reads_their_turn() {
    let mut line = Line::new(SERIAL, unit(100, 0));
    line.add_slot(1, SlotKind::Read, &read(0, 1), Some(0));
    let write = line.add_slot(1, SlotKind::Write, &[], None);
    let (mut now_ns, mut reads, mut writes, mut jobs, mut id) = (0, 0, 0, 0, 0);
    for turn in 0..900 {
        if turn < 300 {
            line.set_write(write, &[6, 0, 0, 0, turn as u8], now_ns);
        } else if turn >= 600 {
            while line.jobs() < 5 {
                id += 1;
                line.push_job(id, 2, &read(7, 3), u64::MAX, false).unwrap();
            }
        }
        loop {
            match line.step(now_ns) {
                Step::Send { unit, pdu, origin } => {
                    let (unit, pdu) = (unit, pdu.to_vec());
                    match origin {
                        Origin::Slot(0) => reads += 1,
                        Origin::Slot(_) => writes += 1,
                        Origin::Job(_) => jobs += 1,
                    }
                    line.sent(now_ns);
                    now_ns += MS;
                    line.answer(unit, &answer_to(&pdu), now_ns);
                    break;
                }
                Step::Wait(until) => now_ns = until.unwrap(),
                _ => {}
            }
        }
    }
    // 8 writes a read; then reads only; then reads and jobs in turns.
    assert_eq!((reads, writes, jobs), (33 + 300 + 150, 267, 150));
}

#[test]
fn the_queue_has_a_limit_and_deadlines_end_jobs() {
    let mut line = Line::new(SERIAL, unit(100, 0));
    for id in 0..MAX_JOBS as u64 {
        line.push_job(id, 1, &read(0, 1), 50 * MS, false).unwrap();
    }
    assert_eq!(line.push_job(99, 1, &read(0, 1), 50 * MS, false), Err(QueueFull));
    steps(&mut line, 0);
    line.sent(0);
    let said = steps(&mut line, 60 * MS);
    assert_eq!(said.len(), MAX_JOBS, "{said:?}");
    assert!(said[..MAX_JOBS - 1].iter().all(|s| s.ends_with("Expired")), "{said:?}");
    assert_eq!(steps(&mut line, 100 * MS), ["failed Job(0) NoAnswer", "wait"]);
}

#[test]
fn a_broken_link_pauses_and_ends_jobs_at_once() {
    let mut line = Line::new(TCP, unit(100, 3));
    line.add_slot(1, SlotKind::Read, &read(0, 1), Some(0));
    steps(&mut line, 0);
    line.push_job(1, 1, &read(0, 1), u64::MAX, false).unwrap();
    line.link_failed(MS);
    assert_eq!(steps(&mut line, MS), ["failed Slot(0) Link", "failed Job(1) Link", "wait 101"]);
    let mut now_ns = 101 * MS;
    for pause_ms in [200, 400, 800, 1600, 3200, 5000, 5000] {
        assert_eq!(steps(&mut line, now_ns)[0], "send 1 [03, 00, 00, 00, 01]");
        line.link_failed(now_ns);
        let said = steps(&mut line, now_ns);
        now_ns += pause_ms * MS;
        assert_eq!(said[1], format!("wait {}", now_ns / MS));
    }
    // A request that never leaves the port is a broken link too.
    steps(&mut line, now_ns);
    assert_eq!(steps(&mut line, now_ns + 2000 * MS)[0], "failed Slot(0) Link");
}

#[test]
fn a_write_outlives_a_broken_link() {
    let mut line = Line::new(TCP, unit(100, 3));
    let write = line.add_slot(1, SlotKind::Write, &[], None);
    line.set_write(write, &[6, 0, 0, 0, 1], 0);
    assert_eq!(steps(&mut line, 0)[0], "send 1 [06, 00, 00, 00, 01]");
    line.link_failed(MS);
    assert_eq!(steps(&mut line, MS), ["failed Slot(0) Link", "wait 101"]);
    // Its newest value goes out when the link stands again, unless it was forgotten meanwhile.
    line.set_write(write, &[6, 0, 0, 0, 2], 50 * MS);
    assert_eq!(steps(&mut line, 101 * MS)[0], "send 1 [06, 00, 00, 00, 02]");
    line.drop_write(write);
    line.link_failed(102 * MS);
    assert_eq!(steps(&mut line, 102 * MS)[0], "failed Slot(0) Link");
    assert_eq!(steps(&mut line, 1000 * MS), ["wait"]);
}

#[test]
fn a_write_that_is_refused_for_now_is_repeated_and_one_refused_for_good_is_not() {
    for (code, again) in [(1, false), (2, false), (3, false), (4, true), (5, false), (6, true)] {
        let mut line = Line::new(TCP, unit(100, 0));
        let write = line.add_slot(1, SlotKind::Write, &[], None);
        line.set_write(write, &[6, 0, 0, 0, 1], 0);
        steps(&mut line, 0);
        line.sent(0);
        line.answer(1, &[0x86, code], MS);
        let wait = if again { "wait 1001" } else { "wait" };
        assert_eq!(steps(&mut line, MS), [format!("done Slot(0) [86, {code:02X}]"), wait.to_owned()]);
        assert_eq!(line.unit_state(1), UnitState::Ok);
        // A new value does not wait for that.
        line.set_write(write, &[6, 0, 0, 0, 2], 500 * MS);
        assert_eq!(steps(&mut line, 500 * MS)[0], "send 1 [06, 00, 00, 00, 02]");
        line.sent(500 * MS);
        // Forgotten while it was under way.
        line.drop_write(write);
        line.answer(1, &[0x86, code], 501 * MS);
        assert_eq!(steps(&mut line, 501 * MS)[1], "wait");
    }
}

#[test]
fn what_a_gateway_says_of_a_unit_is_no_answer_of_the_unit() {
    for code in [0x0A, 0x0B] {
        let mut line = Line::new(TCP, unit(100, 1));
        line.add_slot(1, SlotKind::Read, &read(0, 1), Some(0));
        let write = line.add_slot(1, SlotKind::Write, &[], None);
        line.set_write(write, &[6, 0, 0, 0, 1], 0);
        steps(&mut line, 0);
        for at_ms in [0, 50] {
            line.sent(at_ms * MS);
            let end_ns = (at_ms + 50) * MS;
            line.answer(1, &[0x86, code], end_ns);
            // The connection stays, nothing is repeated but the write, which is kept.
            let said = steps(&mut line, end_ns);
            assert_eq!(said[..2], ["failed Slot(1) NoAnswer", "send 1 [06, 00, 00, 00, 01]"]);
            assert_eq!((line.unit_state(1), line.unit_news()), (UnitState::Failing, None));
        }
        line.sent(100 * MS);
        line.answer(1, &[0x86, code], 150 * MS);
        assert_eq!(steps(&mut line, 150 * MS), ["failed Slot(1) NoAnswer", "wait 1150"]);
        let news = UnitNews { unit: 1, dead: true, by_gateway: Some(code) };
        assert_eq!((line.unit_news(), line.unit_news()), (Some(news), None));
        let view = line.units().next().unwrap();
        assert_eq!(
            (view.state, view.counters.timeouts, view.last_exception),
            (UnitState::Dead, 0, Some((code, 6)))
        );
        // A job gets the exception as it is, and changes nothing about the unit.
        line.push_job(1, 1, &read(0, 1), u64::MAX, false).unwrap();
        steps(&mut line, 160 * MS);
        line.sent(160 * MS);
        line.answer(1, &[0x83, code], 170 * MS);
        assert_eq!(
            steps(&mut line, 170 * MS),
            [format!("done Job(1) [83, {code:02X}]"), "wait 1150".to_owned()]
        );
        assert_eq!(line.unit_state(1), UnitState::Dead);
        assert_eq!(steps(&mut line, 1150 * MS)[0], "send 1 [06, 00, 00, 00, 01]");
        line.sent(1150 * MS);
        line.answer(1, &[6, 0, 0, 0, 1], 1160 * MS);
        assert_eq!(
            steps(&mut line, 1160 * MS)[..2],
            ["done Slot(1) [06, 00, 00, 00, 01]", "send 1 [03, 00, 00, 00, 01]"]
        );
        let back = UnitNews { unit: 1, dead: false, by_gateway: None };
        assert_eq!((line.unit_news().map(|n| n.dead), line.unit_news()), (Some(back.dead), None));
    }
}

#[test]
fn lost_answers_cost_their_own_time_until_they_are_three_in_a_row() {
    let mut line = Line::new(SERIAL, unit(100, 0));
    // Another unit is well, so that a dead one is left alone for 25 times its cost.
    line.add_slot(1, SlotKind::Read, &read(0, 1), Some(3_600_000 * MS));
    steps(&mut line, 0);
    line.sent(0);
    line.answer(1, &[3, 2, 0, 0], 0);
    steps(&mut line, 0);
    let mut now_ns = 0;
    let mut ask = |line: &mut Line, id: u64, answered: bool| {
        line.push_job(id, 2, &read(0, 1), u64::MAX, true).unwrap();
        let said = steps(line, now_ns).remove(0);
        if !said.starts_with("send") {
            return said;
        }
        line.sent(now_ns);
        if answered {
            line.answer(2, &[3, 2, 0, 0], now_ns + MS);
        }
        let said = steps(line, now_ns + 100 * MS).remove(0);
        // Behind everything that may come late.
        now_ns += 1000 * MS;
        said
    };
    for (id, answered) in [(1, true), (2, false), (3, false), (4, true), (5, false), (6, false)] {
        let said = ask(&mut line, id, answered);
        assert_eq!(said.starts_with("done"), answered, "{said}");
        assert_eq!(line.unit_news(), None);
    }
    assert!(ask(&mut line, 7, false).ends_with("NoAnswer"));
    assert_eq!(line.unit_news(), Some(UnitNews { unit: 2, dead: true, by_gateway: None }));
    assert!(ask(&mut line, 8, true).ends_with("UnitDown"));
    assert_eq!(line.unit_news(), None);
}

#[test]
fn periods_begin_with_the_first_turn_not_with_the_machine() {
    let up_ns = 400_000_000 * MS;
    let mut line = Line::new(TCP, unit(100, 0));
    line.add_slot(1, SlotKind::Read, &read(0, 1), Some(1000 * MS));
    line.add_slot(1, SlotKind::Read, &read(9, 1), Some(1000 * MS));
    let mut now_ns = up_ns;
    while now_ns < up_ns + 3_500 * MS {
        match line.step(now_ns) {
            Step::Send { unit, pdu, .. } => {
                let answer = answer_to(pdu);
                line.sent(now_ns);
                line.answer(unit, &answer, now_ns + MS);
            }
            Step::Wait(until) => now_ns = until.unwrap(),
            _ => {}
        }
    }
    assert_eq!((line.counters().missed_periods, line.units().next().unwrap().counters.answers), (0, 8));
}

#[test]
fn units_of_a_broken_link_have_no_connection() {
    let mut line = Line::new(TCP, unit(100, 0));
    line.add_slot(1, SlotKind::Read, &read(0, 1), Some(0));
    let state = |line: &Line| line.units().next().unwrap().state;
    assert_eq!(state(&line), UnitState::Unknown);
    steps(&mut line, 0);
    line.link_failed(MS);
    assert_eq!((state(&line), line.is_link_down()), (UnitState::NoConnection, true));
    assert_eq!(serde_json::to_value(state(&line)).unwrap(), "no connection");
    steps(&mut line, MS);
    steps(&mut line, 101 * MS);
    line.sent(101 * MS);
    assert_eq!(state(&line), UnitState::Unknown);
    line.answer(1, &[3, 2, 0, 0], 102 * MS);
    assert_eq!((state(&line), line.is_link_down()), (UnitState::Ok, false));
}

#[test]
fn a_write_forgotten_while_it_was_under_way_does_not_hold_up_its_unit() {
    let mut line = Line::new(SERIAL, unit(100, 3));
    line.add_slot(1, SlotKind::Read, &read(0, 1), Some(50 * MS));
    let write = line.add_slot(1, SlotKind::Write, &[], None);
    line.set_write(write, &[6, 0, 0, 0, 1], 0);
    assert_eq!(steps(&mut line, 0)[0], "send 1 [06, 00, 00, 00, 01]");
    line.sent(0);
    // The plc stops, and the unit does not answer this one.
    line.drop_write(write);
    assert_eq!(
        steps(&mut line, 100 * MS),
        ["failed Slot(1) NoAnswer", "send 1 [03, 00, 00, 00, 01]", "wait 2100"]
    );
    assert_eq!(line.unit_state(1), UnitState::Unknown);
}

#[test]
fn the_most_retries_there_can_be_end() {
    let mut line = Line::new(SERIAL, unit(1, u8::MAX));
    line.push_job(1, 1, &read(0, 1), u64::MAX, false).unwrap();
    let (mut now_ns, mut sent) = (0, 0);
    let failure = loop {
        match line.step(now_ns) {
            Step::Send { .. } => {
                sent += 1;
                line.sent(now_ns);
            }
            Step::Wait(until) => now_ns = until.unwrap(),
            Step::Done { result, .. } => break result.err(),
            Step::Reset => panic!("a serial line has no connection"),
        }
    };
    assert_eq!((failure, sent), (Some(Failure::NoAnswer), 255));
}

#[test]
fn jobs_of_a_gateway_fail_fast_at_a_dead_unit() {
    let mut line = Line::new(SERIAL, unit(100, 0));
    let ask = |line: &mut Line, id, unit, now_ns: u64| {
        line.push_job(id, unit, &read(0, 1), u64::MAX, true).unwrap();
        let said = steps(line, now_ns);
        line.sent(now_ns);
        if unit == 1 {
            line.answer(1, &[3, 2, 0, 0], now_ns + MS);
        }
        said
    };
    assert!(ask(&mut line, 1, 1, 0)[0].starts_with("send"));
    assert!(steps(&mut line, MS)[0].starts_with("done"));
    for (id, at_ms) in [(2, 10), (3, 110), (4, 210)] {
        assert!(ask(&mut line, id, 2, at_ms * MS)[0].starts_with("send"));
        assert!(steps(&mut line, (at_ms + 100) * MS)[0].ends_with("NoAnswer"));
    }
    // 100 ms lost by the last one, so 25 times as long nobody waits for it again.
    assert_eq!(ask(&mut line, 5, 2, 311 * MS)[0], "failed Job(5) UnitDown");
    assert_eq!(ask(&mut line, 6, 2, 2809 * MS)[0], "failed Job(6) UnitDown");
    assert!(ask(&mut line, 7, 2, 2810 * MS)[0].starts_with("send"));
    line.answer(2, &[3, 2, 0, 0], 2820 * MS);
    assert!(steps(&mut line, 2820 * MS)[0].starts_with("done"));
    assert!(ask(&mut line, 8, 2, 2821 * MS)[0].starts_with("send"));
}

/// Answers per unit after `span_ns` on a line where a request takes `wire_ns`, and `dead` never answers; or a gateway
/// says so after half a timeout.
fn rates(
    units: u8,
    dead: Option<u8>,
    by_gateway: bool,
    timeout_ms: u64,
    wire_ns: u64,
    span_ns: u64,
) -> BTreeMap<u8, u64> {
    let mut line = Line::new(if by_gateway { TCP } else { SERIAL }, unit(timeout_ms, 1));
    for number in 1..=units {
        line.set_unit(number, unit(timeout_ms, 1));
        line.add_slot(number, SlotKind::Read, &read(0, 10), Some(0));
    }
    let (mut now_ns, mut spent_ns, mut idle_ns) = (0, 0, 0);
    while now_ns < span_ns {
        match line.step(now_ns) {
            Step::Send { unit, pdu, .. } => {
                let pdu = pdu.to_vec();
                line.sent(now_ns);
                if Some(unit) != dead {
                    now_ns += wire_ns;
                    spent_ns += wire_ns;
                    line.answer(unit, &answer_to(&pdu), now_ns);
                } else if by_gateway {
                    now_ns += timeout_ms * MS / 2;
                    spent_ns += timeout_ms * MS / 2;
                    line.answer(unit, &[0x83, 0x0B], now_ns);
                }
            }
            Step::Wait(until) => {
                let until_ns = until.unwrap().max(now_ns);
                idle_ns += until_ns - now_ns;
                now_ns = until_ns;
            }
            Step::Done { .. } => {}
            Step::Reset => panic!("nothing comes late"),
        }
    }
    // Time is spent on answered requests or lost on the dead unit, and on nothing else.
    assert_eq!(spent_ns + idle_ns, now_ns);
    let timeouts: u64 = line.units().map(|u| u.counters.timeouts).sum();
    assert_eq!(idle_ns, timeouts * timeout_ms * MS);
    line.units().map(|u| (u.unit, u.counters.answers)).collect()
}

#[test]
fn a_dead_unit_among_ten_costs_the_other_nine_less_than_5_percent() {
    // FC3 x 10 at 9600 and 115200 baud and at 19200 with short timeouts; ten minutes.
    for (timeout_ms, wire_ns) in [(1000, 45_800_000), (1000, 6_700_000), (200, 22_900_000)] {
        let span_ns = 600_000 * MS;
        for by_gateway in [false, true] {
            let nine = rates(9, None, by_gateway, timeout_ms, wire_ns, span_ns);
            let with_dead = rates(10, Some(10), by_gateway, timeout_ms, wire_ns, span_ns);
            assert_eq!(with_dead[&10], 0);
            for number in 1..=9 {
                let (alone, beside) = (nine[&number] as f64, with_dead[&number] as f64);
                assert!(beside > 0.95 * alone, "unit {number}: {beside} of {alone} at {timeout_ms} ms");
            }
            // All alike.
            let (least, most) =
                (1..=9).fold((u64::MAX, 0), |(l, m), n| (l.min(with_dead[&n]), m.max(with_dead[&n])));
            assert!(most - least <= 1, "{with_dead:?}");
        }
    }
}

#[test]
fn a_unit_that_comes_back_is_polled_again_at_its_period() {
    let mut line = Line::new(SERIAL, unit(100, 1));
    line.add_slot(1, SlotKind::Read, &read(0, 1), Some(100 * MS));
    line.add_slot(2, SlotKind::Read, &read(0, 1), Some(100 * MS));
    let (mut now_ns, mut answers) = (0, Vec::new());
    while now_ns < 60_000 * MS {
        match line.step(now_ns) {
            Step::Send { unit, pdu, .. } => {
                let pdu = pdu.to_vec();
                line.sent(now_ns);
                if unit == 1 || now_ns > 3_000 * MS {
                    now_ns += 10 * MS;
                    answers.push((unit, now_ns));
                    line.answer(unit, &answer_to(&pdu), now_ns);
                }
            }
            Step::Wait(until) => now_ns = until.unwrap().max(now_ns),
            _ => {}
        }
    }
    let first = answers.iter().find(|(unit, _)| *unit == 2).unwrap().1;
    // Dead after four tries at 450 ms, tried again 25 x 100 ms later and once more.
    assert!(first < 6_000 * MS, "{first}");
    let since = answers.iter().filter(|(unit, _)| *unit == 2).count() as u64;
    assert!(since >= (60_000 * MS - first) / (100 * MS) - 1, "{since}");
}

/// What the world does with a request.
#[derive(Debug, Clone)]
enum Fate {
    Answer,
    Lost,
    Late(u64),
    Twice,
    Garbage(Vec<u8>),
    OtherUnit,
    Exception,
    /// A gateway does not reach the unit.
    Unreachable,
    Unsent,
}

fn fates() -> impl Strategy<Value = Vec<Fate>> {
    prop::collection::vec(
        prop_oneof![
            4 => Just(Fate::Answer),
            1 => Just(Fate::Lost),
            2 => (1u64..400).prop_map(Fate::Late),
            1 => Just(Fate::Twice),
            1 => prop::collection::vec(any::<u8>(), 0..9).prop_map(Fate::Garbage),
            1 => Just(Fate::OtherUnit),
            1 => Just(Fate::Exception),
            1 => Just(Fate::Unreachable),
            1 => Just(Fate::Unsent),
        ],
        1..60,
    )
}

proptest! {
    /// Whatever the line does: one request in flight at a time, every job ends exactly once, and an answer told is
    /// the one to its own request.
    #[test]
    fn every_job_ends_with_its_own_answer_or_an_error(
        fates in fates(), serial: bool, copies: bool, forgets: bool, retries in 0u8..3, jobs in 1u64..40,
    ) {
        let mut line = Line::new(if serial { SERIAL } else { TCP }, unit(100, retries));
        line.add_slot(1, SlotKind::Read, &read(100, 2), Some(70 * MS));
        line.add_slot(2, SlotKind::Read, &read(200, 2), Some(0));
        let write = line.add_slot(3, SlotKind::Write, &[], None);
        let mut asked = BTreeMap::new();
        let mut ended = BTreeMap::new();
        // Until when the request in flight may be answered.
        let (mut now_ns, mut next, mut in_flight): (u64, usize, Option<u64>) = (0, 0, None);
        // Frames on their way: (time, unit, pdu).
        let mut coming: Vec<(u64, u8, Vec<u8>)> = Vec::new();
        let (mut pushed, mut rounds) = (0u64, 0u32);
        while (ended.len() as u64) < jobs || pushed < jobs {
            rounds += 1;
            prop_assert!(rounds < 200_000, "jobs that never end: {:?} of {}", ended.len(), pushed);
            if pushed < jobs && line.jobs() < MAX_JOBS {
                pushed += 1;
                let (unit, pdu) = ((pushed % 4) as u8 + 1, read(pushed as u16 * 10, 1 + (pushed % 3) as u16));
                line.push_job(pushed, unit, &pdu, now_ns + 60_000 * MS, pushed.is_multiple_of(5)).unwrap();
                asked.insert(pushed, pdu);
                line.set_write(write, &[6, 0, 1, 0, pushed as u8], now_ns);
            }
            let mut sending = None;
            let until = loop {
                match line.step(now_ns) {
                    Step::Wait(until) => break until,
                    Step::Reset => {
                        coming.clear();
                        in_flight = None;
                    }
                    Step::Send { unit, pdu, origin } => {
                        prop_assert!(in_flight.is_none_or(|until_ns| now_ns >= until_ns), "two in flight: {origin:?}");
                        in_flight = Some(u64::MAX);
                        sending = Some((unit, pdu.to_vec()));
                        break Some(now_ns);
                    }
                    Step::Done { origin, result, .. } => {
                        in_flight = None;
                        if let Origin::Job(id) = origin {
                            if let Ok(pdu) = result {
                                let own = answer_to(&asked[&id]);
                                let refused = pdu == [0x83, 4] || pdu == [0x83, 0x0B];
                                prop_assert!(pdu == own || refused, "job {id}: {pdu:02X?}");
                            }
                            prop_assert!(ended.insert(id, result.is_ok()).is_none(), "job {id} ended twice");
                        }
                    }
                }
            };
            if let Some((unit, pdu)) = sending {
                let fate = &fates[next % fates.len()];
                next += 1;
                now_ns += MS;
                if matches!(fate, Fate::Unsent) {
                    line.link_failed(now_ns);
                    continue;
                }
                // What arrives before the request has left.
                coming.sort();
                while coming.first().is_some_and(|c| c.0 <= now_ns) {
                    let (_, unit, pdu) = coming.remove(0);
                    line.answer(unit, &pdu, now_ns);
                }
                line.sent(now_ns);
                if forgets && next.is_multiple_of(3) {
                    line.drop_write(write);
                }
                in_flight = Some(now_ns + 100 * MS);
                let right = answer_to(&pdu);
                match fate {
                    Fate::Answer => coming.push((now_ns + 5 * MS, unit, right)),
                    Fate::Lost | Fate::Unsent => {}
                    // Late, but within what the master must expect: one more timeout.
                    Fate::Late(_) if copies => {}
                    Fate::Late(ms) => coming.push((now_ns + ms % 199 * MS, unit, right)),
                    Fate::Twice => {
                        coming.push((now_ns + 5 * MS, unit, right.clone()));
                        // A copy cannot be told from a late answer: one misfortune or the other.
                        if serial && copies {
                            coming.push((now_ns + 5 * MS + MS / 2, unit, right));
                        }
                    }
                    Fate::Garbage(bytes) => {
                        line.garbage();
                        // On a connection garbage under the right number is a mismatch.
                        coming.push((now_ns + 3 * MS, unit ^ 0x80, bytes.clone()));
                        coming.push((now_ns + 5 * MS, unit, right));
                    }
                    Fate::OtherUnit => coming.push((now_ns + 5 * MS, unit + 7, right)),
                    Fate::Exception => coming.push((now_ns + 5 * MS, unit, vec![pdu[0] | 0x80, 4])),
                    Fate::Unreachable => coming.push((now_ns + 5 * MS, unit, vec![pdu[0] | 0x80, 0x0B])),
                }
                continue;
            }
            // The next thing that happens.
            coming.sort();
            match (coming.first().map(|c| c.0), until) {
                (Some(at_ns), until) if until.is_none_or(|u| at_ns <= u) => {
                    now_ns = now_ns.max(at_ns);
                    let (_, unit, pdu) = coming.remove(0);
                    line.answer(unit, &pdu, now_ns);
                }
                (_, Some(until_ns)) => now_ns = now_ns.max(until_ns),
                _ => prop_assert!(pushed < jobs || ended.len() as u64 == jobs, "nothing happens any more"),
            }
        }
        prop_assert_eq!(ended.len() as u64, jobs);
        // Whatever came before: when everything answers, everybody is asked again, and each job gets its answer.
        let (end_ns, mut read_units, mut done) = (now_ns + 200_000 * MS, BTreeMap::new(), 0);
        // Behind the longest pause of a link that did not work.
        let mut coming = 1..=4;
        let begin_ns = now_ns + 6_000 * MS;
        while now_ns < end_ns {
            if now_ns >= begin_ns {
                for unit in coming.by_ref() {
                    line.push_job(1000 + u64::from(unit), unit, &read(7, 1), u64::MAX, false).unwrap();
                }
            }
            match line.step(now_ns) {
                Step::Send { unit, pdu, .. } => {
                    let right = answer_to(pdu);
                    line.sent(now_ns);
                    now_ns += 50 * MS;
                    line.answer(unit, &right, now_ns);
                }
                Step::Done { origin: Origin::Job(id), result, .. } if id > 1000 => {
                    prop_assert_eq!(result, Ok(&[3, 2, 0, 7][..]));
                    done += 1;
                }
                Step::Done { origin: Origin::Slot(_), unit, result: Ok(_) } => {
                    *read_units.entry(unit).or_insert(0u32) += 1;
                }
                // What was in flight at the end of misfortune.
                Step::Done { .. } | Step::Reset => {}
                Step::Wait(until) => now_ns = now_ns.max(until.unwrap_or(end_ns)),
            }
        }
        prop_assert_eq!(done, 4);
        prop_assert!(read_units.get(&1).is_some_and(|n| *n > 10) && read_units.get(&2).is_some_and(|n| *n > 10));
    }
}
