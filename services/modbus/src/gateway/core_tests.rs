//! Masters on one side, units on the other, in virtual time.

use super::*;
use crate::gateway::cache::CacheRange;
use crate::server::Table;
use proptest::prelude::*;
use std::collections::BTreeMap;

const MS: u64 = 1_000_000;

fn setup() -> LineSetup {
    LineSetup {
        settings: Settings { serial: true, turnaround_ns: Some(200 * MS), send_limit_ns: 5000 * MS },
        unit: UnitSettings { response_timeout_ns: 100 * MS, retries: 0, ..UnitSettings::default() },
        queue: 4,
    }
}

const RULES: Rules = Rules { max_wait_ns: 1000 * MS, answer_broadcasts: false };

fn identity() -> [Option<(u8, u8)>; 256] {
    std::array::from_fn(|unit| (unit < 248).then_some((0, unit as u8)))
}

fn core(rules: Rules, ranges: &[CacheRange]) -> Core {
    Core::new(rules, &[setup()], identity(), Cache::new(ranges))
}

fn steps(core: &mut Core, line: usize, now_ns: u64) -> Vec<String> {
    let mut said = Vec::new();
    loop {
        match core.step(line, now_ns) {
            GatewayStep::Wait(_) => return said,
            GatewayStep::Send { unit, pdu } => said.push(format!("send {unit} {pdu:02X?}")),
            GatewayStep::Reply { client, transaction, unit, pdu } => {
                said.push(format!("reply {client}/{transaction} {unit} {pdu:02X?}"));
            }
        }
    }
}

const READ: [u8; 5] = [3, 0, 0, 0, 1];

#[test]
fn requests_go_through_unchanged() {
    let mut core = core(RULES, &[]);
    // A function that the gateway knows nothing of, and its exception.
    for (request, answer) in [(&READ[..], &[3, 2, 1, 2][..]), (&[100, 1, 2], &[100, 9]), (&READ, &[0x83, 4])]
    {
        assert_eq!(core.request(7, 0x1234, 5, request, 0), None);
        assert_eq!(steps(&mut core, 0, 0), [format!("send 5 {request:02X?}")]);
        core.sent(0, MS);
        core.garbage(0);
        core.answer(0, 6, answer, 2 * MS);
        assert!(steps(&mut core, 0, 2 * MS).is_empty());
        core.answer(0, 5, answer, 3 * MS);
        assert_eq!(steps(&mut core, 0, 3 * MS), [format!("reply 7/4660 5 {answer:02X?}")]);
    }
    assert_eq!((core.counters().forwarded, core.line_counters(0).garbage), (3, 3));
}

#[test]
fn exceptions_of_the_gateway_itself() {
    let mut core = core(RULES, &[]);
    assert_eq!(core.request(1, 1, 255, &READ, 0), Some(&[0x83, 0x0A][..]));
    assert_eq!(core.request(1, 1, 1, &[], 0), Some(&[0x80, 3][..]));
    assert_eq!(core.request(1, 1, 1, &[3; 254], 0), Some(&[0x83, 3][..]));
    // No answer, or none but a damaged one: 0B; known to be silent: 0B at once.
    assert_eq!(core.request(1, 1, 9, &READ, 0), None);
    steps(&mut core, 0, 0);
    core.sent(0, 0);
    core.garbage(0);
    assert_eq!(steps(&mut core, 0, 30 * MS), Vec::<String>::new());
    assert_eq!(steps(&mut core, 0, 100 * MS), ["reply 1/1 9 [83, 0B]"]);
    for at_ms in [100, 200] {
        assert_eq!(core.unit_news(0), None);
        core.request(1, 2, 9, &READ, at_ms * MS);
        assert_eq!(steps(&mut core, 0, at_ms * MS), ["send 9 [03, 00, 00, 00, 01]"]);
        core.sent(0, at_ms * MS);
        assert_eq!(steps(&mut core, 0, (at_ms + 100) * MS), ["reply 1/2 9 [83, 0B]"]);
    }
    assert!(core.unit_news(0).is_some_and(|news| news.unit == 9 && news.dead));
    core.request(1, 2, 9, &READ, 301 * MS);
    assert_eq!(steps(&mut core, 0, 301 * MS), ["reply 1/2 9 [83, 0B]"]);
    // The queue has 4 places besides the one in flight... which keeps its own.
    for transaction in 0..4 {
        assert_eq!(core.request(1, transaction, 1, &READ, 500 * MS), None);
    }
    assert_eq!(core.request(1, 9, 1, &READ, 500 * MS), Some(&[0x83, 6][..]));
    // Waiting for too long: 06 as well. The first one is in flight and silent.
    steps(&mut core, 0, 500 * MS);
    core.link_failed(0, 600 * MS);
    assert_eq!(
        steps(&mut core, 0, 600 * MS),
        ["reply 1/0 1 [83, 0A]", "reply 1/1 1 [83, 0A]", "reply 1/2 1 [83, 0A]", "reply 1/3 1 [83, 0A]"]
    );
    for transaction in 0..2 {
        assert_eq!(core.request(1, transaction, 1, &READ, 800 * MS), None);
    }
    steps(&mut core, 0, 800 * MS);
    let said = steps(&mut core, 0, 1800 * MS);
    assert_eq!(said, ["reply 1/1 1 [83, 06]"]);
    let counters = core.counters();
    assert_eq!((counters.no_path, counters.no_answer, counters.busy), (5, 4, 2));
}

#[test]
fn one_master_cannot_take_all_places() {
    let big = LineSetup { queue: 64, ..setup() };
    let mut core = Core::new(RULES, &[big], identity(), Cache::default());
    for transaction in 0..16 {
        assert_eq!(core.request(1, transaction, 1, &READ, 0), None);
    }
    assert_eq!(core.request(1, 16, 1, &READ, 0), Some(&[0x83, 6][..]));
    assert_eq!(core.request(2, 0, 1, &READ, 0), None);
    // When it goes, its requests go.
    steps(&mut core, 0, 0);
    core.client_gone(1);
    assert_eq!((core.waiting(0), core.outstanding(1)), (2, 0));
    core.sent(0, 0);
    core.answer(0, 1, &[3, 2, 0, 0], MS);
    let said = steps(&mut core, 0, MS);
    assert_eq!((said, core.counters().orphaned), (vec!["send 1 [03, 00, 00, 00, 01]".to_owned()], 1));
}

#[test]
fn units_are_mapped_to_lines() {
    let mut routes = identity();
    routes[1] = Some((1, 5));
    routes[200] = Some((0, 1));
    let mut core = Core::new(RULES, &[setup(), setup()], routes, Cache::default());
    core.request(1, 1, 1, &READ, 0);
    core.request(1, 2, 200, &READ, 0);
    assert_eq!(steps(&mut core, 0, 0), ["send 1 [03, 00, 00, 00, 01]"]);
    assert_eq!(steps(&mut core, 1, 0), ["send 5 [03, 00, 00, 00, 01]"]);
    for (line, unit) in [(0, 1), (1, 5)] {
        core.sent(line, 0);
        core.answer(line, unit, &[3, 2, 0, line as u8], MS);
    }
    // The master hears the number it used.
    assert_eq!(steps(&mut core, 0, MS), ["reply 1/2 200 [03, 02, 00, 00]"]);
    assert_eq!(steps(&mut core, 1, MS), ["reply 1/1 1 [03, 02, 00, 01]"]);
}

#[test]
fn broadcasts_are_sent_and_not_answered_unless_asked_for() {
    for answer in [false, true] {
        let mut core = core(Rules { answer_broadcasts: answer, ..RULES }, &[]);
        assert_eq!(core.request(1, 1, 0, &READ, 0), Some(&[0x83, 0x0B][..]));
        assert_eq!(core.request(1, 2, 0, &[16, 0, 1, 0, 1, 2, 0, 9], 0), None);
        assert_eq!(core.request(1, 3, 4, &READ, 0), None);
        assert_eq!(steps(&mut core, 0, 0), ["send 0 [10, 00, 01, 00, 01, 02, 00, 09]"]);
        core.sent(0, 10 * MS);
        assert!(steps(&mut core, 0, 209 * MS).is_empty());
        let mut said = steps(&mut core, 0, 210 * MS);
        if answer {
            assert_eq!(said.remove(0), "reply 1/2 0 [10, 00, 01, 00, 01]");
        }
        assert_eq!(said, ["send 4 [03, 00, 00, 00, 01]"]);
    }
}

#[test]
fn cached_ranges_answer_at_once_until_somebody_writes() {
    let range = |table, at, count| CacheRange {
        line: 0,
        unit: 5,
        table,
        at,
        count,
        period_ns: 1000 * MS,
        max_age_ns: 3000 * MS,
    };
    let mut core = core(RULES, &[range(Table::HoldingRegisters, 10, 4), range(Table::Coils, 0, 20)]);
    assert_eq!(core.request(1, 1, 5, &[3, 0, 11, 0, 2], 0), None, "nothing was read yet");
    assert_eq!(steps(&mut core, 0, 0), ["send 5 [03, 00, 0B, 00, 02]"]);
    core.sent(0, 0);
    core.answer(0, 5, &[3, 4, 9, 9, 9, 9], MS);
    assert_eq!(steps(&mut core, 0, MS)[1], "send 5 [03, 00, 0A, 00, 04]");
    core.sent(0, MS);
    core.answer(0, 5, &[3, 8, 0, 1, 0, 2, 0, 3, 0, 4], 2 * MS);
    assert_eq!(steps(&mut core, 0, 2 * MS), ["send 5 [01, 00, 00, 00, 14]"]);
    core.sent(0, 2 * MS);
    core.answer(0, 5, &[1, 3, 0b1010_0000, 0b1, 0], 3 * MS);
    assert!(steps(&mut core, 0, 3 * MS).is_empty());
    for (request, answer) in [
        ([3, 0, 11, 0, 2], Some(&[3, 4, 0, 2, 0, 3][..])),
        ([3, 0, 10, 0, 4], Some(&[3, 8, 0, 1, 0, 2, 0, 3, 0, 4])),
        ([1, 0, 5, 0, 4], Some(&[1, 1, 0b1101])),
        ([3, 0, 10, 0, 5], None),
        ([4, 0, 10, 0, 1], None),
    ] {
        assert_eq!(core.request(9, 9, 5, &request, 4 * MS), answer, "{request:?}");
    }
    core.client_gone(9);
    // A write takes the unit's ranges out; a poll that was under way before it ended does not bring them back.
    assert_eq!(core.request(2, 1, 5, &[6, 0, 10, 0, 7], 1001 * MS), None);
    assert_eq!(core.request(3, 1, 5, &[3, 0, 10, 0, 1], 1001 * MS), None);
    core.client_gone(3);
    assert_eq!(steps(&mut core, 0, 1002 * MS), ["send 5 [06, 00, 0A, 00, 07]"]);
    core.sent(0, 1002 * MS);
    core.answer(0, 5, &[6, 0, 10, 0, 7], 1003 * MS);
    assert_eq!(
        steps(&mut core, 0, 1003 * MS),
        ["reply 2/1 5 [06, 00, 0A, 00, 07]", "send 5 [03, 00, 0A, 00, 04]"]
    );
    core.sent(0, 1003 * MS);
    core.answer(0, 5, &[3, 8, 0, 7, 0, 2, 0, 3, 0, 4], 1004 * MS);
    steps(&mut core, 0, 1004 * MS);
    assert_eq!(core.request(3, 2, 5, &[3, 0, 10, 0, 1], 1005 * MS), Some(&[3, 2, 0, 7][..]));
    // Too old.
    assert_eq!(core.request(3, 2, 5, &[3, 0, 10, 0, 1], 4005 * MS), None);
    assert_eq!(core.counters().cached, 4);
}

proptest! {
    /// Every request is answered exactly once (broadcasts never), to the master that asked, under its number.
    #[test]
    fn everybody_gets_its_own_answer(requests in prop::collection::vec((0u64..4, 0u8..8, 0u16..9, 0u8..6, 1u64..80), 1..80)) {
        let mut core = core(RULES, &[]);
        let mut open: BTreeMap<(u64, u16), (u8, u16)> = BTreeMap::new();
        let mut now_ns = 0;
        let mut coming: Option<(u64, u8, Vec<u8>)> = None;
        let mut list = requests.into_iter().enumerate();
        let mut idle = 0;
        while idle < 200 {
            if let Some((i, (client, unit, at, fate, pause_ms))) = list.next() {
                let pdu = [3, 0, at as u8, 0, 1];
                let refused = core.request(client, i as u16, unit, &pdu, now_ns).map(<[u8]>::to_vec);
                match refused {
                    Some(pdu) => prop_assert!(pdu == [0x83, 6] || pdu == [0x83, 0x0B] && unit == 0),
                    None => { open.insert((client, i as u16), (unit, at)); }
                }
                if fate == 5 {
                    core.client_gone(client);
                    open.retain(|(c, _), _| *c != client);
                }
                now_ns += pause_ms * MS;
            } else {
                idle += 1;
                now_ns += 50 * MS;
            }
            if let Some((at_ns, unit, pdu)) = coming.take() {
                if at_ns <= now_ns { core.answer(0, unit, &pdu, now_ns) } else { coming = Some((at_ns, unit, pdu)) }
            }
            loop {
                match core.step(0, now_ns) {
                    GatewayStep::Wait(_) => break,
                    GatewayStep::Send { unit, pdu } => {
                        let answer = vec![3, 2, unit, pdu[2]];
                        // Unit 3 never answers, unit 4 late.
                        let delay = if unit == 4 { 90 } else { 20 };
                        if unit != 3 { coming = Some((now_ns + delay * MS, unit, answer)) }
                        core.sent(0, now_ns);
                    }
                    GatewayStep::Reply { client, transaction, unit, pdu } => {
                        let asked = open.remove(&(client, transaction));
                        prop_assert!(asked.is_some(), "{client}/{transaction} was not open");
                        let (asked_unit, at) = asked.unwrap();
                        prop_assert_eq!(asked_unit, unit);
                        prop_assert!(pdu == [3, 2, unit, at as u8] || pdu == [0x83, 0x0B] || pdu == [0x83, 6], "{:02X?}", pdu);
                    }
                }
            }
        }
        prop_assert!(open.is_empty(), "{open:?}");
    }
}
